//! Peers that call services and methods many times, and peers that execute calls and count them.

use std::time::Duration;

use serde_json::{Value, json};

use crate::cell::{ROSCPP, compiled};
use crate::{Cell, Child, Distribution, SERVER_ENDPOINT, StartedChild, program};

/// The timeout of an order, longer than the longest order of a test takes.
const PATIENCE: Duration = Duration::from_secs(90);

/// A caller: `peers/calls/ros1_asker.py` or another script that takes the same orders.
pub struct CallerScript {
    peer: Child,
    asked: u64,
}

/// An executor that counts: `peers/calls/ros1_executor.py` or another script with the same answers.
pub struct Counting(Child);

/// The kinds of callers in `peers/calls`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CallerKind {
    /// A rospy client.
    Rospy,
    /// A roscpp client.
    Roscpp,
    /// An rclpy client in a domain.
    Rclpy(Distribution, u16),
    /// A client of Cyclone DDS in a domain.
    Cyclone(u16),
    /// An asyncua client of the cell's ua-server.
    Asyncua,
    /// A node-opcua client of the cell's ua-server.
    NodeOpcua,
    /// `ua-space call`.
    UaSpace,
}

/// A type that programs know from files only, as its request and its response.
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
/// A service type that programs know from files only, with an array of messages in its response.
const STATES: [(&str, &str); 2] = [
    (
        "srv/GetAvailableStates.srv",
        "---\nState[] available_states\n",
    ),
    ("msg/State.msg", "uint8 id\nstring label\n"),
];

impl Cell {
    /// Writes a mapping for the bridge of `space`, 1 or 2, with the definitions of the cases
    /// `files` and `messages` and the text `more`. Returns its path.
    ///
    /// # Panics
    /// Panics if the mapping cannot be written.
    #[must_use]
    pub fn call_mapping(&self, space: u16, more: &str) -> String {
        let name = self.call_types(space);
        let yaml =
            format!("spaces: [{{id: 1}}, {{id: 2}}]\ntype_paths: [{name}]\nvariables: []\n{more}");
        let path = self.file(&format!("{name}.yaml"), &yaml);
        path.to_str().unwrap().to_owned()
    }

    /// Writes the definitions of the cases `files` and `messages` for the ROS of `space`, 1 or 2.
    /// Returns the name of their folder.
    ///
    /// # Panics
    /// Panics if the definitions cannot be written.
    #[must_use]
    pub fn call_types(&self, space: u16) -> &'static str {
        let (name, basic) = if space == 1 {
            // The type `byte` of ROS 2 is a uint8; in ROS 1, `byte` is an alias of int8.
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
        name
    }

    /// Starts these callers in parallel.
    #[must_use]
    pub fn askers(&self, askers: &[CallerKind]) -> Vec<CallerScript> {
        let started = askers.iter().map(|of| self.asker_started(*of).told());
        let started: Vec<Child> = started.map(StartedChild::start).collect();
        started.into_iter().map(CallerScript::of).collect()
    }

    fn asker_started(&self, of: CallerKind) -> StartedChild {
        match of {
            CallerKind::Rospy => self.rospy_started("calls/ros1_asker.py", &[]),
            CallerKind::Roscpp => self.roscpp_started(&["ask"]),
            CallerKind::Rclpy(distribution, domain) => self
                .rclpy_started(distribution, "calls/ros2_asker.py", &[])
                .env("ROS_DOMAIN_ID", domain.to_string()),
            CallerKind::Cyclone(domain) => {
                let args = ["ask", "--domain", &domain.to_string()];
                self.cyclone_started("calls/cyclone.py", &args)
            }
            CallerKind::Asyncua => self.asyncua_started("calls/opcua_asker.py", &[SERVER_ENDPOINT]),
            CallerKind::NodeOpcua => self.node_opcua_started("ask.js", &[SERVER_ENDPOINT]),
            CallerKind::UaSpace => self
                .asyncua_started("calls/ua_space_asker.py", &[])
                .args([program("ua-space")]),
        }
    }

    /// Returns the roscpp peer, not started yet.
    #[must_use]
    pub fn roscpp_started(&self, args: &[&str]) -> StartedChild {
        self.with_ros1(StartedChild::new(ROSCPP, &compiled(ROSCPP)))
            .args(args)
    }

    /// Starts a rospy client of the cases in `peers/calls/cases.py`.
    #[must_use]
    pub fn rospy_asker(&self) -> CallerScript {
        CallerScript::of(
            self.rospy_started("calls/ros1_asker.py", &[])
                .told()
                .start(),
        )
    }

    /// Starts an rclpy client of the cases in `peers/calls/cases.py`.
    #[must_use]
    pub fn rclpy_asker(&self, distribution: Distribution) -> CallerScript {
        let peer = self.rclpy_started(distribution, "calls/ros2_asker.py", &[]);
        CallerScript::of(peer.told().start())
    }

    /// Starts a rospy server of services, each `CASE=/name`, with options.
    #[must_use]
    pub fn rospy_executor(&self, args: &[&str]) -> Counting {
        let peer = self.rospy_started("calls/ros1_executor.py", args);
        Counting(peer.told().start().ready(PATIENCE))
    }

    /// Starts these executors in parallel.
    #[must_use]
    pub fn executors(&self, started: impl IntoIterator<Item = StartedChild>) -> Vec<Counting> {
        let started = started.into_iter().map(|started| started.told().start());
        let started: Vec<Child> = started.collect();
        let ready = started.into_iter().map(|child| child.ready(PATIENCE));
        ready.map(Counting).collect()
    }

    /// Starts an rclpy server of services, each `CASE=/name`, with options.
    #[must_use]
    pub fn rclpy_executor(&self, distribution: Distribution, args: &[&str]) -> Counting {
        let peer = self.rclpy_started(distribution, "calls/ros2_executor.py", args);
        Counting(peer.told().start().ready(PATIENCE))
    }
}

impl CallerKind {
    /// Returns the name of the caller in the tables of `docs/calls.md`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Rospy => "rospy",
            Self::Roscpp => "roscpp",
            Self::Rclpy(Distribution::Jazzy, _) => "rclpy (Jazzy)",
            Self::Rclpy(Distribution::Kilted, _) => "rclpy (Kilted)",
            Self::Cyclone(_) => "Cyclone DDS",
            Self::Asyncua => "asyncua",
            Self::NodeOpcua => "node-opcua",
            Self::UaSpace => "ua-space",
        }
    }
}

impl CallerScript {
    fn of(peer: Child) -> Self {
        Self {
            peer: peer.ready(PATIENCE),
            asked: 0,
        }
    }

    /// Sends an order to the caller, see `peers/calls/ros2_asker.py`. [`Self::told`] returns its
    /// result.
    pub fn begin(&mut self, mut order: Value) {
        self.asked += 1;
        order["id"] = json!(self.asked);
        self.peer.tell(&order.to_string());
    }

    /// Returns the result of the last order: `right`, `wrongs` and `failures` are numbers of calls.
    ///
    /// # Panics
    /// Panics if the order does not end in time.
    pub fn told(&mut self) -> Value {
        let id = json!(self.asked);
        self.peer
            .wait_for_json("what became of the calls", PATIENCE, |line| {
                (line.get("id")? == &id).then(|| line["answer"].clone())
            })
    }

    /// Sends an order and returns its result.
    ///
    /// # Panics
    /// Panics as [`Self::told`] does.
    pub fn ask(&mut self, order: Value) -> Value {
        self.begin(order);
        self.told()
    }

    /// Returns the process.
    pub const fn child(&mut self) -> &mut Child {
        &mut self.peer
    }
}

impl Counting {
    /// Returns the executor's counts: `executed`, the number of `different` requests, the requests
    /// executed `twice`, and the `most` and `running` calls at a time.
    ///
    /// # Panics
    /// Panics if the executor does not answer in time.
    pub fn counts(&mut self) -> Value {
        self.0.ask("counts", PATIENCE)
    }

    /// Ends all running calls at once.
    ///
    /// # Panics
    /// Panics as [`Self::counts`] does.
    pub fn end(&mut self) {
        self.0.ask("end", PATIENCE);
    }

    /// Returns the process.
    pub const fn child(&mut self) -> &mut Child {
        &mut self.0
    }
}
