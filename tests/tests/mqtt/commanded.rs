//! A command from an OPC UA client to a robot of ROS 1 over brokers.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use serde_json::Value;
use system_tests::{
    Cell, Child, METRICS_ROS1, SERVER_ENDPOINT, StartedChild, eventually, holds_for, metrics,
};

use super::SOON;

pub(crate) const COMMAND: &str = "
pubsub: {address: \"mqtt://127.0.0.1:1883\"}
namespaces: {2: urn:ua-bridge:system-tests}
spaces: [{id: 1}]
variables:
  - node: ns=2;i=30
    name: setpoint
    type: Double
    origin: 0
    ros: {space: 1, topic: /arm/setpoint, type: std_msgs/Float64, field: data}
server: {security: [None]}
";

/// A server and a robot of ROS 1 with a broker between them.
pub(crate) struct Commanded<'c> {
    cell: &'c Cell,
    robot: Child,
    value: f64,
}

impl<'c> Commanded<'c> {
    /// Starts the robot, which publishes its setpoints.
    pub(crate) fn robot(cell: &'c Cell) -> Self {
        let robot = cell.rospy("ros1_arm.py", &["/arm/setpoint", "/arm/reached"]);
        Self {
            cell,
            robot,
            value: 0.0,
        }
    }

    /// Writes a value and returns the status.
    pub(crate) fn write(&self, value: f64) -> Value {
        let value = value.to_string();
        let args = [SERVER_ENDPOINT, "ns=2;i=30", "Double", &value];
        self.cell.asyncua_once("opcua_write.py", &args)[0]["status"].clone()
    }

    /// Writes new values until the robot confirms a value.
    pub(crate) fn arrives(&mut self) {
        eventually("a command is confirmed", SOON * 2, || {
            self.value += 1.0;
            (self.write(self.value) == "Good").then_some(())
        });
        let wanted = self.value;
        self.robot.wait_for_json("the command", SOON, |line| {
            (line.get("setpoint")?.as_f64()? == wanted).then_some(())
        });
    }

    /// Checks that the robot does not get the value.
    pub(crate) fn never_arrives(&self, value: f64) {
        holds_for(
            "the late command does not arrive",
            Duration::from_secs(4),
            || {
                let lines = self.robot.json_lines();
                let mut got = lines
                    .iter()
                    .filter_map(|line| line.get("setpoint")?.as_f64());
                !got.any(|got| got == value)
            },
        );
    }

    /// Checks that a command that the broker delivers after its time is dropped and counted.
    pub(super) fn copy_is_dropped(&mut self) {
        let mut copy = StartedChild::new("mosquitto_sub", Path::new("/usr/bin/mosquitto_sub"))
            .args([
                "-h",
                "127.0.0.1",
                "-t",
                "opcua/uadp/data/0/2/30",
                "-C",
                "1",
                "-F",
                "%x",
            ])
            .start();
        eventually("a command is copied", SOON, || {
            self.arrives();
            (!copy.runs()).then_some(())
        });
        let hex = copy.lines().remove(0);
        let bytes = (0..hex.len()).step_by(2);
        let bytes: Vec<u8> = bytes
            .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
            .collect();
        let copied = self.cell.folder().join("command");
        std::fs::write(&copied, bytes).unwrap();
        let before = late();
        eventually("the late command is counted", SOON, || {
            let sent = Command::new("mosquitto_pub")
                .args(["-h", "127.0.0.1", "-t", "opcua/uadp/data/0/2/30"])
                .args(["-f", copied.to_str().unwrap()])
                .status();
            assert!(sent.unwrap().success());
            (late() > before).then_some(())
        });
    }
}

/// Returns the number of late messages that the bridge dropped.
fn late() -> u64 {
    let status = metrics(METRICS_ROS1).unwrap_or_default();
    let topics = status["topics"].as_object().into_iter().flatten();
    let all = topics.map(|(_, topic)| topic).chain([&status["others"]]);
    all.filter_map(|topic| topic["dropped"]["late"].as_u64())
        .sum()
}
