//! A node of ROS 2 itself that tells what it sees.

use std::time::Duration;

use serde_json::{Value, json};

use crate::{Cell, Child, Distribution};

/// More than the 15 s after which the node itself gives up.
const PATIENCE: Duration = Duration::from_secs(30);

/// `peers/ros2_node.py`: what `ros2` on the command line asks, asked through rclpy.
pub struct Judge {
    node: Child,
    asked: u64,
}

impl Cell {
    /// An rclpy node `/judge/NAME` in domain 2, for the first of `args`, which may be followed by options.
    #[must_use]
    pub fn judge(&self, distribution: Distribution, args: &[&str]) -> Judge {
        let node = self.rclpy_started(distribution, "ros2_node.py", args);
        Judge::of(node.told().start())
    }
}

impl Judge {
    /// Of a process that runs `ros2_node.py` and can be told lines.
    #[must_use]
    pub fn of(process: Child) -> Self {
        Self {
            node: process.ready(PATIENCE),
            asked: 0,
        }
    }

    /// The node's answer to a command, see `peers/ros2_node.py`.
    ///
    /// # Panics
    /// When there is none in time, or the command failed.
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

    /// What `pick` makes of the node's answer, asked again until it is not `None`.
    ///
    /// # Panics
    /// When that takes too long.
    pub fn until<T>(&mut self, command: &Value, mut pick: impl FnMut(&Value) -> Option<T>) -> T {
        let mut last = Value::Null;
        let start = std::time::Instant::now();
        while start.elapsed() < PATIENCE {
            last = self.ask(command.clone());
            if let Some(found) = pick(&last) {
                return found;
            }
            // The graph changes by what comes over the network.
            std::thread::park_timeout(Duration::from_millis(50));
        }
        panic!("{command}: at last {last}");
    }

    /// The first value heard on a topic that `pick` does not answer `None` to, from now or before.
    ///
    /// # Panics
    /// When none comes in time.
    pub fn hears<T>(&mut self, topic: &str, mut pick: impl FnMut(&Value) -> Option<T>) -> T {
        let what = format!("a value on {topic}");
        self.node.wait_for_json(&what, PATIENCE, |line| {
            (line.get("heard")? == topic)
                .then(|| pick(&line["value"]))
                .flatten()
        })
    }

    /// The process.
    pub const fn child(&mut self) -> &mut Child {
        &mut self.node
    }
}
