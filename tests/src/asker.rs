//! Peers that ask for calls many times, or execute them and count.

use std::time::Duration;

use serde_json::{Value, json};

use crate::{Cell, Child, Distribution};

/// More than the longest order of a test takes.
const PATIENCE: Duration = Duration::from_secs(90);

/// `peers/calls/ros1_asker.py` or `ros2_asker.py`.
pub struct Asker {
    peer: Child,
    asked: u64,
}

/// `peers/calls/ros1_executor.py` or `ros2_executor.py`.
pub struct Counting(Child);

/// A type that programs know from files only.
const BASIC_TYPES: &str = "\
bool bool_value
byte byte_value
char char_value
float32 float32_value
float64 float64_value
int8 int8_value
uint8 uint8_value
int16 int16_value
uint16 uint16_value
int32 int32_value
uint32 uint32_value
int64 int64_value
uint64 uint64_value
string string_value
";
/// The same, with an array of messages in its response.
const STATES: [(&str, &str); 2] = [
    (
        "srv/GetAvailableStates.srv",
        "---\nState[] available_states\n",
    ),
    ("msg/State.msg", "uint8 id\nstring label\n"),
];

impl Cell {
    /// A mapping for the bridge of `space`, 1 or 2, that has nothing but the definitions of the cases `files` and `messages`, and
    /// `more`. Gives its path.
    ///
    /// # Panics
    /// When it cannot be written.
    #[must_use]
    pub fn call_mapping(&self, space: u16, more: &str) -> String {
        let (name, basic) = if space == 1 {
            // What ROS 2 calls a byte is an int8 under that name in ROS 1.
            ("ros1", BASIC_TYPES.replace("byte ", "uint8 "))
        } else {
            ("ros2", BASIC_TYPES.to_owned())
        };
        for folder in ["test_msgs/srv", "lifecycle_msgs/srv", "lifecycle_msgs/msg"] {
            std::fs::create_dir_all(self.folder().join(name).join(folder)).unwrap();
        }
        let service = format!("{basic}---\n{basic}");
        let _ = self.file(&format!("{name}/test_msgs/srv/BasicTypes.srv"), &service);
        for (file, text) in STATES {
            let _ = self.file(&format!("{name}/lifecycle_msgs/{file}"), text);
        }
        let yaml =
            format!("spaces: [{{id: 1}}, {{id: 2}}]\ntype_paths: [{name}]\nvariables: []\n{more}");
        let path = self.file(&format!("{name}.yaml"), &yaml);
        path.to_str().unwrap().to_owned()
    }

    /// A rospy client of the cases in `peers/calls/cases.py`.
    #[must_use]
    pub fn rospy_asker(&self) -> Asker {
        Asker::of(
            self.rospy_started("calls/ros1_asker.py", &[])
                .told()
                .start(),
        )
    }

    /// An rclpy client of the same cases.
    #[must_use]
    pub fn rclpy_asker(&self, distribution: Distribution) -> Asker {
        let peer = self.rclpy_started(distribution, "calls/ros2_asker.py", &[]);
        Asker::of(peer.told().start())
    }

    /// A rospy server of services, each `CASE=/name`, with options.
    #[must_use]
    pub fn rospy_executor(&self, args: &[&str]) -> Counting {
        let peer = self.rospy_started("calls/ros1_executor.py", args);
        Counting(peer.told().start().ready(PATIENCE))
    }

    /// An rclpy server of services, each `CASE=/name`, with options.
    #[must_use]
    pub fn rclpy_executor(&self, distribution: Distribution, args: &[&str]) -> Counting {
        let peer = self.rclpy_started(distribution, "calls/ros2_executor.py", args);
        Counting(peer.told().start().ready(PATIENCE))
    }
}

impl Asker {
    fn of(peer: Child) -> Self {
        Self {
            peer: peer.ready(PATIENCE),
            asked: 0,
        }
    }

    /// Begins to ask, see `peers/calls/ros2_asker.py`, for [`Self::told`].
    pub fn begin(&mut self, mut order: Value) {
        self.asked += 1;
        order["id"] = json!(self.asked);
        self.peer.tell(&order.to_string());
    }

    /// What became of the order begun last: `right`, `wrongs` and `failures` are numbers of calls.
    ///
    /// # Panics
    /// When it does not end in time.
    pub fn told(&mut self) -> Value {
        let id = json!(self.asked);
        self.peer
            .wait_for_json("what became of the calls", PATIENCE, |line| {
                (line.get("id")? == &id).then(|| line["answer"].clone())
            })
    }

    /// Both of these.
    ///
    /// # Panics
    /// As [`Self::told`].
    pub fn ask(&mut self, order: Value) -> Value {
        self.begin(order);
        self.told()
    }

    /// The process.
    pub const fn child(&mut self) -> &mut Child {
        &mut self.peer
    }
}

impl Counting {
    /// What it has executed: `executed`, how many `different` requests, which `twice`, `most` and `running` at a time.
    ///
    /// # Panics
    /// When it does not say so in time.
    pub fn counts(&mut self) -> Value {
        self.0.ask("counts", PATIENCE)
    }

    /// The process.
    pub const fn child(&mut self) -> &mut Child {
        &mut self.0
    }
}
