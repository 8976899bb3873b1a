//! `cargo xtask dist`: the programs as they are handed out.

use std::fs;

use anyhow::Context as _;

use crate::{
    patches::Patched,
    shell::{Ended, run as must, step},
    workspace::{SHIPPED, Workspace},
};

/// Packages, and the program of each that is handed out.
const PROGRAMS: [(&str, &str); 9] = [
    ("bridge-ros1", "bridge-ros1"),
    ("bridge-ros2", "bridge-ros2"),
    ("discovery", "ua-lds"),
    ("ua-component", "ua-component"),
    ("ua-gds", "ua-gds"),
    ("ua-mes", "ua-mes"),
    ("ua-server", "ua-server"),
    ("ua-space", "ua-space"),
    ("ua-station", "ua-station"),
];

/// Builds the programs without optimisation into `target/debug`.
pub(crate) fn build(workspace: &Workspace) -> anyhow::Result<Ended> {
    let patched = Patched::prepare(workspace)?;
    step("building the programs (some minutes the first time)");
    let mut build = patched.cargo(workspace, &["build", "--locked", "--bins"]);
    for (package, _) in PROGRAMS {
        build.args(["--package", package]);
    }
    must(&mut build)?;
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
    for (package, _) in PROGRAMS {
        build.args(["--package", package]);
    }
    must(&mut build)?;
    let folder = workspace.target.join("dist");
    fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    for (_, program) in PROGRAMS {
        let target = folder.join(program);
        fs::copy(workspace.target.join(SHIPPED).join(program), &target)
            .with_context(|| target.display().to_string())?;
        println!("{}", target.display());
    }
    Ok(Ended::WELL)
}
