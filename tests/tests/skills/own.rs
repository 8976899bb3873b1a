//! The examples of `docs/own-components.md`, run as the page says.

use std::path::{Path, PathBuf};

use nix::sys::signal::Signal;
use system_tests::{Cell, Child, Distribution, Peer, StartedChild, eventually, program};

use super::{EXAMPLES, SOON, component};

fn example(name: &str) -> PathBuf {
    Path::new(EXAMPLES).join(name)
}

/// Starts a skill. Returns the exit code and the lines.
fn start(skill: &str, more: &[&str]) -> (i32, String) {
    let mut child = StartedChild::new("ua-space", &program("ua-space"))
        .args(["skills", "start", skill])
        .args(more)
        .args(["--interface", "lo"])
        .start();
    let code = child.wait_for_end(SOON).code().unwrap();
    (code, child.lines().join("\n"))
}

fn is_gripped((code, told): &(i32, String)) {
    assert!(
        *code == 0 && told.contains("Gripped: true"),
        "{code} {told}"
    );
}

fn python(script: &str) -> Child {
    StartedChild::new(script, Path::new("python3"))
        .args([example(script)])
        .start()
}

#[test]
fn a_program_of_the_user_and_a_device_with_http_are_skills() {
    let Some(_cell) = Cell::with(&[]) else { return };
    let program_of_user = component(&example("own-gripper.yaml"));
    is_gripped(&start("own-gripper.Grasp", &["Force=12.5"]));
    drop(program_of_user);

    let device = python("own-device.py");
    eventually("the device serves", SOON, || {
        std::net::TcpStream::connect("127.0.0.1:8080").ok()
    });
    let _component = component(&example("own-device.yaml"));
    let done = start("own-device.Grasp", &["Force=12.5"]);
    is_gripped(&done);
    assert!(
        done.1.contains("%, grasp"),
        "the step of the device: {}",
        done.1
    );
    drop(device);
    let (code, told) = start("own-device.Grasp", &[]);
    assert!(code == 1 && told.contains("cannot be reached"), "{told}");
}

#[test]
fn a_service_of_a_node_is_a_skill_until_the_node_ends() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let mut node = StartedChild::new("own-node", &Distribution::Kilted.python())
        .env("ROS_DOMAIN_ID", "2")
        .env("PYTHONUNBUFFERED", "1")
        .env("ROS_LOG_DIR", cell.folder().join("log"))
        .args([example("own-node.py")])
        .ends_on(Signal::SIGINT)
        .start();
    let mapping = Path::new(EXAMPLES).join("../../mappings/own-node.yaml");
    let _bridge = cell.bridge_ros2_alone(&[mapping.to_str().unwrap()]).start();
    let _component = component(&example("own-node.yaml"));
    eventually("the node is found", SOON, || {
        (start("own-node.Grasp", &[]).0 == 0).then_some(())
    });
    node.wait_for_line("closes", SOON);
    is_gripped(&start("own-node.Grasp", &[]));
    drop(node);
    eventually("the run fails without the node", SOON, || {
        let (code, told) = start("own-node.Grasp", &[]);
        (code == 1 && told.contains("nobody in the space executes ua_2_2_70")).then_some(())
    });
}
