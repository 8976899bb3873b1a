//! `cargo xtask bench`: measurements, with optimised programs.

use anyhow::ensure;

use crate::{
    namespace::{Namespaces, REFUSED},
    peers,
    shell::{Ended, run as must, status, step},
    workspace::Workspace,
};

/// Measures one hop of each bridge beside the floor and roscpp's relay, all in one run.
pub(crate) fn hop(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<Ended> {
    let namespaces = Namespaces::try_out();
    ensure!(namespaces != Namespaces::Refused, "{REFUSED}");
    ensure!(
        peers::install(workspace) == Ended::WELL,
        "the measurement needs all peers"
    );
    step("building the programs with optimisation (some minutes the first time)");
    let packages = [
        "-p",
        "bridge-ros1",
        "-p",
        "bridge-ros2",
        "-p",
        "system-tests",
    ];
    must(
        &mut workspace
            .cargo(&[&["build", "--release", "--bins", "--locked"][..], &packages].concat()),
    )?;
    let programs = workspace.target.join("release");
    let bench = programs.join("bench-hop");
    ensure!(
        bench.is_file(),
        "package system-tests has built no bench-hop in {}",
        programs.display()
    );
    step("measuring");
    let mut command = namespaces.command(bench);
    command
        .current_dir(&workspace.root)
        .args(arguments)
        .env("UA_BIN_DIR", &programs)
        .env("UA_PEERS_PYTHON", peers::python(workspace));
    Ok(status(&mut command)?.into())
}
