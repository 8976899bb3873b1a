//! An rclpy node that reports the ROS 2 graph as it sees it.

use std::time::Duration;

use serde_json::{Value, json};

use crate::{Cell, Child, Distribution};

/// Longer than the 15 s after which the node itself gives up.
const PATIENCE: Duration = Duration::from_secs(30);

/// `peers/ros2_node.py`: the commands of the `ros2` command line through rclpy.
pub struct Judge {
    node: Child,
    asked: u64,
}

impl Cell {
    /// Starts an rclpy node `/judge/NAME` in domain 2. `NAME` is the first of `args`; options may
    /// follow it.
    #[must_use]
    pub fn judge(&self, distribution: Distribution, args: &[&str]) -> Judge {
        let node = self.rclpy_started(distribution, "ros2_node.py", args);
        Judge::of(node.told().start())
    }
}

impl Judge {
    /// Wraps a process that runs `ros2_node.py` and has a standard input.
    #[must_use]
    pub fn of(process: Child) -> Self {
        Self {
            node: process.ready(PATIENCE),
            asked: 0,
        }
    }

    /// Returns the node's answer to a command, see `peers/ros2_node.py`.
    ///
    /// # Panics
    /// Panics if there is no answer in time, or the command failed.
    pub fn ask(&mut self, mut command: Value) -> Value {
        self.asked += 1;
        let id = json!(self.asked);
        command["id"] = id.clone();
        self.node.tell(&command.to_string());
        let what = format!("an answer to {command}");
        let line = self.node.wait_for_json(&what, PATIENCE, |line| {
            (line.get("id")? == &id).then(|| line.clone())
        });
        assert!(
            line.get("error").is_none(),
            "{command}: {line}: {}",
            self.node
        );
        line["answer"].clone()
    }

    /// Repeats a command until `pick` returns a value for the answer, and returns this value.
    ///
    /// # Panics
    /// Panics if there is no such answer in time.
    pub fn until<T>(&mut self, command: &Value, mut pick: impl FnMut(&Value) -> Option<T>) -> T {
        let mut last = Value::Null;
        let start = std::time::Instant::now();
        while start.elapsed() < PATIENCE {
            last = self.ask(command.clone());
            if let Some(found) = pick(&last) {
                return found;
            }
            // The graph changes when messages arrive from the network.
            std::thread::park_timeout(Duration::from_millis(50));
        }
        panic!("{command}: at last {last}");
    }

    /// Returns the first result of `pick`, other than `None`, for the values received on a topic,
    /// before or after the call.
    ///
    /// # Panics
    /// Panics if there is no such value in time.
    pub fn hears<T>(&mut self, topic: &str, mut pick: impl FnMut(&Value) -> Option<T>) -> T {
        let what = format!("a value on {topic}");
        self.node.wait_for_json(&what, PATIENCE, |line| {
            (line.get("heard")? == topic)
                .then(|| pick(&line["value"]))
                .flatten()
        })
    }

    /// Returns the process.
    pub const fn child(&mut self) -> &mut Child {
        &mut self.node
    }
}
