//! `bridge-ros2`: carries topics between a ROS 2 domain and the space.

use std::process::ExitCode;

fn main() -> ExitCode {
    bridge_ros2::entry::run(std::env::args_os().collect())
}
