//! `cargo xtask demo`: a story with the programs people run, in one command.

use std::process::Command;

use crate::{
    patches::Patched,
    shell::{Ended, run as must, status, step},
    workspace::Workspace,
};

pub(crate) fn run(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<Ended> {
    step("building the programs (some minutes the first time)");
    let mut build = vec!["build", "--locked"];
    let by_topics = arguments
        .iter()
        .any(|argument| argument.ends_with("line-by-topics"));
    let others: &[&str] = if by_topics { &[] } else { &COMPONENTS };
    for package in BRIDGES.iter().chain(others) {
        build.extend(["-p", package]);
    }
    let patched = Patched::prepare(workspace)?;
    must(&mut patched.cargo(workspace, &build))?;
    step("running the demo");
    let mut demo = Command::new(workspace.target.join("debug/demo"));
    Ok(status(demo.current_dir(&workspace.root).args(arguments))?.into())
}

/// The packages that every story needs.
const BRIDGES: [&str; 4] = ["bridge-ros1", "bridge-ros2", "ua-server", "demo"];
/// Those of the stories with components beside them.
const COMPONENTS: [&str; 4] = ["discovery", "ua-component", "ua-mes", "ua-space"];
