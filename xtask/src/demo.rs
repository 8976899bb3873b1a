//! `cargo xtask demo`: runs a demo story with the shipped programs in one command.

use std::process::Command;

use crate::{
    links,
    patches::Patched,
    shell::{CommandOutcome, run as must, status, step},
    workspace::Workspace,
};

pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    build(workspace)?;
    step("running the demo");
    let mut demo = Command::new(workspace.target.join("debug/demo"));
    Ok(status(demo.current_dir(&workspace.root).args(arguments))?.into())
}

/// Builds the programs that the stories start.
pub(crate) fn build(workspace: &Workspace) -> anyhow::Result<()> {
    step("building the programs (some minutes the first time)");
    let mut build = vec!["build", "--locked"];
    for package in PACKAGES {
        build.extend(["-p", package]);
    }
    let patched = Patched::prepare(workspace)?;
    must(&mut patched.cargo(workspace, &build))?;
    links::make(&workspace.target.join("debug"))
}

/// The packages of the programs that the stories start.
const PACKAGES: [&str; 4] = ["bridge-ros1", "bridge-ros2", links::TARGET, "demo"];
