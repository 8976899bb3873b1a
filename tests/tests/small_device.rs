//! A device with the codec only: the example `publisher` of `uadp`, which needs no
//! standard library for its messages.

use std::time::Duration;

use system_tests::{Cell, Peer, StartedChild, program};

#[test]
fn a_value_of_a_small_device_reaches_ros() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let _bridge = cell.bridge_ros1(&[]);
    let mut receives = cell.rospy("ros1_sub.py", &["/ua_3_5_11", "std_msgs/Float64"]);
    let _device = StartedChild::new("publisher", &program("examples/publisher")).start();
    let celsius = receives.wait_for_json("a temperature", Duration::from_secs(30), |line| {
        line["value"]["data"].as_f64()
    });
    assert!((20.0..21.0).contains(&celsius), "{celsius}");
}
