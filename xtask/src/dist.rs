//! `cargo xtask dist`: builds the shipped programs.

use std::fs;

use anyhow::Context as _;

use crate::{
    links,
    patches::Patched,
    shell::{Ended, run as must, step},
    workspace::{SHIPPED, Workspace},
};

/// The shipped programs, named like their packages. All other programs are links to the last.
const PROGRAMS: [&str; 3] = ["bridge-ros1", "bridge-ros2", links::TARGET];

/// Builds the programs without optimisation into `target/debug`.
pub(crate) fn build(workspace: &Workspace) -> anyhow::Result<Ended> {
    let patched = Patched::prepare(workspace)?;
    step("building the programs (some minutes the first time)");
    let mut build = patched.cargo(workspace, &["build", "--locked", "--bins"]);
    for package in PROGRAMS {
        build.args(["--package", package]);
    }
    must(&mut build)?;
    links::make(&workspace.target.join("debug"))?;
    Ok(Ended::WELL)
}

/// Builds the programs with optimisation and puts them into `target/dist`.
pub(crate) fn run(workspace: &Workspace) -> anyhow::Result<Ended> {
    let patched = Patched::prepare(workspace)?;
    step("building the programs with optimisation (some minutes the first time)");
    let mut build = patched.cargo(
        workspace,
        &["build", "--profile", SHIPPED, "--locked", "--bins"],
    );
    for package in PROGRAMS {
        build.args(["--package", package]);
    }
    must(&mut build)?;
    let folder = workspace.target.join("dist");
    fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    for program in PROGRAMS {
        let target = folder.join(program);
        fs::copy(workspace.target.join(SHIPPED).join(program), &target)
            .with_context(|| target.display().to_string())?;
        println!("{}", target.display());
    }
    links::make(&folder)?;
    for link in links::paths(&folder) {
        println!("{} -> {}", link.display(), links::TARGET);
    }
    Ok(Ended::WELL)
}
