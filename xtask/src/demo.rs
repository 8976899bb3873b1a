//! `cargo xtask demo`: the assembly line in one command.

use std::process::Command;

use crate::{
    dds::Rustdds,
    shell::{Ended, run as must, status, step},
    workspace::Workspace,
};

pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<Ended> {
    step("building the programs (some minutes the first time)");
    let packages = [
        "-p",
        "bridge-ros1",
        "-p",
        "bridge-ros2",
        "-p",
        "ua-server",
        "-p",
        "demo",
    ];
    let rustdds = Rustdds::prepare(workspace)?;
    must(&mut rustdds.cargo(workspace, &[&["build", "--locked"][..], &packages].concat()))?;
    step("running the demo");
    let mut demo = Command::new(workspace.target.join("debug/demo"));
    Ok(status(demo.current_dir(&workspace.root).args(arguments))?.into())
}
