//! `bridge-ros1`: bridges topics between a ROS 1 graph and the space.

use std::process::ExitCode;

fn main() -> ExitCode {
    bridge_ros1::entry::run(std::env::args_os().collect())
}
