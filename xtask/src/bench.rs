//! `cargo xtask bench`: measures optimised programs.

use std::{
    io::Write as _,
    path::PathBuf,
    process::{Command, Stdio},
};

use anyhow::{Context as _, ensure};

use crate::{
    chart, instructions, links,
    namespace::{NamespacePermission, REFUSED},
    patches::Patched,
    peers,
    shell::{CommandOutcome, run as must, step},
    workspace::{SHIPPED, Workspace},
};

/// Measures one hop of each bridge, with the floor and the relay of roscpp in the same run.
pub(crate) fn hop(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let packages = ["bridge-ros1", "bridge-ros2", "system-tests"];
    measured(workspace, "bench-hop", &packages, arguments)
}

/// Measures relays of ROS 1 messages with a raw echo, and bridge-ros1 with many topics, all in one
/// run.
pub(crate) fn ros1(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let packages = ["tcpros", "bridge-ros1", "system-tests"];
    measured(workspace, "bench-ros1", &packages, arguments)
}

/// Measures relays of DDS samples with a UDP echo, and both bridges between ROS 1 and ROS 2, all in
/// one run.
pub(crate) fn ros2(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let packages = [
        "bridge-ros1",
        "bridge-ros2",
        "ros2-node",
        links::TARGET,
        "system-tests",
    ];
    measured(workspace, "bench-ros2", &packages, arguments)
}

/// Measures ua-server with servers of other vendors, and values from the space to clients, all in
/// one run.
pub(crate) fn opcua(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    measured(
        workspace,
        "bench-opcua",
        &[links::TARGET, "system-tests"],
        arguments,
    )
}

/// Measures the gaps of random faults of two redundant bridges.
pub(crate) fn redundancy(
    workspace: &Workspace,
    arguments: &[&str],
) -> anyhow::Result<CommandOutcome> {
    let packages = ["bridge-ros1", "system-tests"];
    measured(workspace, "bench-redundancy", &packages, arguments)
}

/// Runs all programs of a cell for hours with random faults.
pub(crate) fn soak(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    let packages = [links::TARGET, "bridge-ros1", "bridge-ros2", "system-tests"];
    measured(workspace, "soak", &packages, arguments)
}

/// Measures round trips over an MQTT broker beside those of paho.
pub(crate) fn mqtt(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    measured(workspace, "bench-mqtt", &["system-tests"], arguments)
}

/// Measures many cells at one broker.
pub(crate) fn plant(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    measured(workspace, "bench-plant", &["system-tests"], arguments)
}

/// Measures the response times of skills, and a server with many skills.
pub(crate) fn skills(workspace: &Workspace, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
    measured(
        workspace,
        "bench-skills",
        &[links::TARGET, "system-tests"],
        arguments,
    )
}

/// Measures manifests, NodeSets and questions of the knowledge of the plant.
pub(crate) fn knowledge(
    workspace: &Workspace,
    arguments: &[&str],
) -> anyhow::Result<CommandOutcome> {
    let packages = [links::TARGET, "system-tests"];
    measured(workspace, "bench-knowledge", &packages, arguments)
}

/// Measures conversions between ROS bytes and UADP fields, and Python serializers for the ROS half
/// of the conversion.
pub(crate) fn messages(
    workspace: &Workspace,
    arguments: &[&str],
) -> anyhow::Result<CommandOutcome> {
    instructions::run(workspace, "messages", arguments, |bench| {
        step("the same messages in Python, without UADP");
        let dump = Command::new(bench).arg("dump").output()?;
        for (python, library) in [
            (PathBuf::from("/usr/bin/python3"), "genpy"),
            (peers::python(workspace), "rosbags"),
        ] {
            let script = workspace.root.join("ros/messages/bench/serializers.py");
            let mut measured = Command::new(&python)
                .arg(script)
                .arg(library)
                .stdin(Stdio::piped())
                .spawn()
                .with_context(|| {
                    format!("{}: `cargo xtask peers` installs it", python.display())
                })?;
            if let Some(mut to) = measured.stdin.take() {
                to.write_all(&dump.stdout)?;
            }
            ensure!(measured.wait()?.success(), "{library} was not measured");
        }
        Ok(())
    })
}

/// Builds the packages with all their programs, then runs the measurement.
fn measured(
    workspace: &Workspace,
    bench: &str,
    packages: &[&str],
    arguments: &[&str],
) -> anyhow::Result<CommandOutcome> {
    let namespaces = NamespacePermission::try_out();
    ensure!(namespaces != NamespacePermission::Refused, "{REFUSED}");
    ensure!(
        peers::install(workspace) == CommandOutcome::WELL,
        "the measurement needs all peers"
    );
    step("building the programs with optimisation (some minutes the first time)");
    let patched = Patched::prepare(workspace)?;
    let mut build = patched.cargo(
        workspace,
        &[
            "build",
            "--profile",
            SHIPPED,
            "--bins",
            "--examples",
            "--locked",
        ],
    );
    for package in packages {
        build.args(["--package", package]);
    }
    must(&mut build)?;
    let programs = workspace.target.join(SHIPPED);
    if packages.contains(&links::TARGET) {
        links::make(&programs)?;
    }
    let program = programs.join(bench);
    ensure!(
        program.is_file(),
        "package system-tests has built no {bench} in {}",
        programs.display()
    );
    step("measuring");
    let mut command = namespaces.command(program);
    command
        .current_dir(&workspace.root)
        .args(arguments)
        .env("UA_BIN_DIR", &programs)
        .env("UA_PEERS_PYTHON", peers::python(workspace))
        .env("UA_PEERS", workspace.peers());
    chart::measured(&mut command, workspace, bench)
}
