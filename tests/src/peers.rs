//! The peers: ROS 1, Fast DDS and Cyclone DDS from Debian, Cyclone DDS and asyncua from PyPI,
//! node-opcua from npm, and rosrust.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use nix::sys::signal::Signal;

use crate::{
    Cell, Child, GROUP, StartedChild,
    cell::{CYCLONE, Distribution, FASTDDS, MQTT_PYTHON, NODE_OPCUA, NODE_OPCUA_PUBSUB, compiled},
    eventually, program, xml_rpc,
};

/// The address of the ROS 1 master of a cell.
pub const MASTER: &str = "127.0.0.1:11311";

/// The time that Python and a ROS graph need to start on a busy machine.
const START: Duration = Duration::from_secs(30);

/// Returns a Cyclone DDS configuration that is bound to an interface, with more elements in its
/// section `Discovery`.
pub(crate) fn cyclone_uri(interface: &str, discovery: &str) -> String {
    format!(
        "<CycloneDDS><Domain id=\"any\">\
         <General><Interfaces><NetworkInterface name=\"{interface}\" multicast=\"true\"/></Interfaces></General>\
         <Discovery><ParticipantIndex>auto</ParticipantIndex>\
         <MaxAutoParticipantIndex>60</MaxAutoParticipantIndex>{discovery}</Discovery></Domain></CycloneDDS>"
    )
}

const NAVIGATE: &str = "\
geometry_msgs/PoseStamped pose
string behavior_tree
---
uint16 error_code
string error_msg
---
geometry_msgs/PoseStamped current_pose
builtin_interfaces/Duration navigation_time
builtin_interfaces/Duration estimated_time_remaining
int16 number_of_recoveries
float32 distance_remaining
";

impl Cell {
    /// Starts a ROS 1 master and waits until it answers `getPid`.
    #[must_use]
    pub fn roscore(&self) -> Child {
        let master = self.roscore_unwatched();
        eventually("the ROS 1 master answers getPid", START, || {
            xml_rpc(MASTER, "getPid", &["/system_tests"])
                .filter(|answer| answer.contains("<int>1</int>"))
        });
        master
    }

    fn roscore_unwatched(&self) -> Child {
        let port = MASTER.rsplit(':').next().unwrap_or("11311");
        self.with_ros1(StartedChild::new(
            "rosmaster",
            Path::new("/usr/bin/rosmaster"),
        ))
        .args(["--core", "-p", port])
        .start()
    }

    /// Starts a rospy script of `peers/` and waits until it is ready.
    #[must_use]
    pub fn rospy(&self, script: &str, args: &[&str]) -> Child {
        self.rospy_started(script, args).start().ready(START)
    }

    /// Returns a rospy script of `peers/`, not started yet.
    #[must_use]
    pub fn rospy_started(&self, script: &str, args: &[&str]) -> StartedChild {
        self.with_ros1(StartedChild::new(script, Path::new("/usr/bin/python3")))
            .args([peer_script(script)])
            .args(args)
    }

    /// Returns a program of ROS 1 under `/usr`, such as `bin/rostopic` or
    /// `lib/topic_tools/throttle`, not started yet.
    #[must_use]
    pub fn ros1_started(&self, program: &str, args: &[&str]) -> StartedChild {
        let name = program.rsplit('/').next().unwrap_or(program);
        self.with_ros1(StartedChild::new(name, &Path::new("/usr").join(program)))
            .args(args)
            .ends_on(Signal::SIGINT)
    }

    /// Runs a command line tool of ROS 1 that ends by itself, such as `rosservice`, and returns its
    /// lines.
    ///
    /// # Panics
    /// Panics if the program fails.
    #[must_use]
    pub fn ros1_tool(&self, name: &str, args: &[&str]) -> Vec<String> {
        let path = Path::new("/usr/bin").join(name);
        let mut tool = self
            .with_ros1(StartedChild::new(name, &path))
            .args(args)
            .start();
        let status = tool.wait_for_end(START);
        assert!(status.success(), "{name} ended with {status}: {tool}");
        tool.lines()
    }

    /// Starts roscpp's `topic_tools relay` between two topics. It does not report when it is ready.
    #[must_use]
    pub fn topic_tools_relay(&self, from: &str, to: &str) -> Child {
        // On SIGTERM, roscpp leaves its registrations in the master.
        self.with_ros1(StartedChild::new(
            "relay",
            Path::new("/usr/lib/topic_tools/relay"),
        ))
        .args([from, to])
        .ends_on(Signal::SIGINT)
        .start()
    }

    /// Starts a rosrust publisher or subscriber of `std_msgs/String` and waits until it is ready.
    #[must_use]
    pub fn rosrust(&self, args: &[&str]) -> Child {
        self.with_ros1(StartedChild::new("rosrust-peer", &program("rosrust-peer")))
            .args(args)
            .start()
            .ready(START)
    }

    /// Starts a Cyclone DDS script of `peers/` and waits until it is ready.
    #[must_use]
    pub fn cyclone(&self, script: &str, args: &[&str]) -> Child {
        self.cyclone_started(script, args).start().ready(START)
    }

    /// Returns a Cyclone DDS script of `peers/`, not started yet.
    #[must_use]
    pub fn cyclone_started(&self, script: &str, args: &[&str]) -> StartedChild {
        self.python(script, args)
            .env("CYCLONEDDS_URI", cyclone_uri("lo", ""))
    }

    /// Starts the Fast DDS peer in domain 2 and waits until it is ready. `peers/dds/README.md`
    /// lists its commands.
    #[must_use]
    pub fn fastdds(&self, args: &[&str]) -> Child {
        self.fastdds_started(args).start().ready(START)
    }

    /// Returns the Fast DDS peer in domain 2, not started yet.
    #[must_use]
    pub fn fastdds_started(&self, args: &[&str]) -> StartedChild {
        StartedChild::new("fastdds-peer", &compiled(FASTDDS))
            .args(args)
            .args(["--domain", "2"])
            .told()
    }

    /// Starts the Cyclone DDS peer in C in domain 2 and waits until it is ready.
    /// `peers/dds/README.md` lists its commands.
    #[must_use]
    pub fn cyclone_c(&self, args: &[&str]) -> Child {
        self.cyclone_c_started(args).start().ready(START)
    }

    /// Returns the Cyclone DDS peer in C in domain 2, not started yet.
    #[must_use]
    pub fn cyclone_c_started(&self, args: &[&str]) -> StartedChild {
        StartedChild::new("cyclone-peer", &compiled(CYCLONE))
            .env("CYCLONEDDS_URI", cyclone_uri("lo", ""))
            .args(args)
            .args(["--domain", "2"])
            .told()
    }

    /// Starts an rclpy script of `peers/` in domain 2 and waits until it is ready.
    #[must_use]
    pub fn rclpy(&self, distribution: Distribution, script: &str, args: &[&str]) -> Child {
        self.rclpy_started(distribution, script, args)
            .start()
            .ready(START)
    }

    /// Returns an rclpy script of `peers/` in domain 2, not started yet.
    #[must_use]
    pub fn rclpy_started(
        &self,
        distribution: Distribution,
        script: &str,
        args: &[&str],
    ) -> StartedChild {
        StartedChild::new(script, &distribution.python())
            .env("PYTHONUNBUFFERED", "1")
            .env("ROS_DOMAIN_ID", "2")
            .env("ROS_HOME", self.folder().join("ros"))
            .env("ROS_LOG_DIR", self.folder().join("ros/log"))
            .args([peer_script(script)])
            .args(args)
    }

    /// Starts an asyncua script of `peers/` that keeps running, and waits until it is ready.
    #[must_use]
    pub fn asyncua(&self, script: &str, args: &[&str]) -> Child {
        self.asyncua_started(script, args).start().ready(START)
    }

    /// Returns an asyncua script of `peers/`, not started yet.
    #[must_use]
    pub fn asyncua_started(&self, script: &str, args: &[&str]) -> StartedChild {
        self.python(script, args)
    }

    /// Runs an asyncua script of `peers/` that ends by itself, and returns its JSON lines.
    ///
    /// # Panics
    /// Panics if the program fails.
    #[must_use]
    pub fn asyncua_once(&self, script: &str, args: &[&str]) -> Vec<serde_json::Value> {
        let mut child = self.python(script, args).start();
        let status = child.wait_for_end(START);
        assert!(status.success(), "{script} ended with {status}");
        child.json_lines()
    }

    /// Runs a script like [`Self::asyncua_once`]. Returns `None` if it fails, for a server that may
    /// not be running yet.
    #[must_use]
    pub fn asyncua_try(&self, script: &str, args: &[&str]) -> Option<Vec<serde_json::Value>> {
        let mut child = self.python(script, args).start();
        let status = child.wait_for_end(START);
        status.success().then(|| child.json_lines())
    }

    /// Starts a node-opcua script of `peers/node-opcua` that keeps running, and waits until it is
    /// ready.
    #[must_use]
    pub fn node_opcua(&self, script: &str, args: &[&str]) -> Child {
        self.node_opcua_started(script, args).start().ready(START)
    }

    /// Runs a node-opcua script of `peers/node-opcua` that ends by itself, and returns its JSON
    /// lines.
    ///
    /// # Panics
    /// Panics if the program fails.
    #[must_use]
    pub fn node_opcua_once(&self, script: &str, args: &[&str]) -> Vec<serde_json::Value> {
        let mut child = self.node_opcua_started(script, args).start();
        let status = child.wait_for_end(START);
        assert!(status.success(), "{script} ended with {status}: {child}");
        child.json_lines()
    }

    /// Returns a node-opcua script of `peers/node-opcua`, not started yet.
    #[must_use]
    pub fn node_opcua_started(&self, script: &str, args: &[&str]) -> StartedChild {
        self.node_of(NODE_OPCUA, script).args(args)
    }

    /// Starts a script of `peers/node-opcua-pubsub` that reads orders, and waits until it is ready.
    #[must_use]
    pub fn node_opcua_pubsub(&self, script: &str) -> Child {
        let started = self.node_of(NODE_OPCUA_PUBSUB, script);
        started.told().start().ready(START)
    }

    /// Returns a script with the packages of its folder in `peers`.
    fn node_of(&self, folder: &str, script: &str) -> StartedChild {
        StartedChild::new(script, Path::new("node"))
            .env("NODE_PATH", compiled(folder).join("node_modules"))
            // node-opcua prints warnings about its environment, and keeps its certificates below
            // HOME.
            .env("HOME", self.folder())
            .args([peer_script(folder).join(script)])
    }

    /// Starts a PubSub listener of asyncua on the UADP group.
    #[must_use]
    pub fn uadp_listener(&self) -> Child {
        self.asyncua("uadp_listen.py", &[&format!("opc.udp://{GROUP}")])
    }

    /// Returns the Python interpreter that has asyncua.
    #[must_use]
    pub fn asyncua_python(&self) -> &Path {
        &self.python
    }

    /// Creates a folder for `AMENT_PREFIX_PATH` with Nav2's action NavigateToPose, and returns its
    /// path.
    ///
    /// # Panics
    /// Panics if the folder cannot be written.
    #[must_use]
    pub fn nav2_prefix(&self) -> PathBuf {
        let prefix = self.folder().join("nav2");
        let folder = prefix.join("share/nav2_msgs/action");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("NavigateToPose.action"), NAVIGATE).unwrap();
        prefix
    }

    /// Returns a script of `peers/` with the clients and the broker of MQTT in Python, not started
    /// yet.
    #[must_use]
    pub fn mqtt_python_started(&self, script: &str, args: &[&str]) -> StartedChild {
        Self::python_of(&compiled(MQTT_PYTHON), script, args)
    }

    fn python(&self, script: &str, args: &[&str]) -> StartedChild {
        Self::python_of(&self.python, script, args)
    }

    fn python_of(python: &Path, script: &str, args: &[&str]) -> StartedChild {
        StartedChild::new(script, python)
            .env("PYTHONUNBUFFERED", "1")
            .args([peer_script(script)])
            .args(args)
    }

    /// Returns the address of the slave API of the ROS 1 node `name`, such as `127.0.0.1:40001`;
    /// `None` while the master does not know the node.
    #[must_use]
    pub fn slave_api(&self, name: &str) -> Option<String> {
        let answer = xml_rpc(MASTER, "lookupNode", &["/system_tests", name])?;
        let (_, rest) = answer.split_once("http://")?;
        Some(rest.split(['/', '<']).next()?.to_owned())
    }

    /// Returns the TCPROS address at which the ROS 1 node `name` serves the topic; `None` while the
    /// node does not publish it.
    #[must_use]
    pub fn tcpros_port(&self, name: &str, topic: &str) -> Option<String> {
        let tcpros = "<array><data><value><array><data><value><string>TCPROS</string></value></data></array></value>\
                      </data></array>";
        let answer = xml_rpc(
            &self.slave_api(name)?,
            "requestTopic",
            &["/system_tests", topic, tcpros],
        )?;
        // [1, message, ["TCPROS", host, port]]: the port is the last number.
        let (before, _) = answer.rsplit_once("</i")?;
        let (_, port) = before.rsplit_once('>')?;
        let port: u16 = port.parse().ok().filter(|port| *port > 1)?;
        Some(format!("127.0.0.1:{port}"))
    }

    /// Adds the environment of a ROS 1 program in this cell.
    #[must_use]
    pub fn with_ros1(&self, started: StartedChild) -> StartedChild {
        started
            .env("PATH", "/usr/bin:/bin")
            .env("PYTHONUNBUFFERED", "1")
            .env("ROS_MASTER_URI", format!("http://{MASTER}"))
            .env("ROS_HOSTNAME", "127.0.0.1")
            .env("ROS_HOME", self.folder().join("ros"))
            .env("ROS_LOG_DIR", self.folder().join("ros/log"))
    }
}

fn peer_script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("peers")
        .join(name)
}
