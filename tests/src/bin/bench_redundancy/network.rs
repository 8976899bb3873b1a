//! The hosts: two bridges and a station, at the networks of the group and of ROS.

use std::path::Path;

use serde_json::Value;
use system_tests::{
    Cell, Child, GroupNumbers, PlantSite, Segment, StartedChild, metrics, program, xml_rpc,
};

/// The addresses of the bridges in the group, and in ROS.
const IN_GROUP: [&str; 2] = ["10.78.0.1", "10.78.0.2"];
const IN_ROS: [&str; 2] = ["10.79.0.1", "10.79.0.2"];
/// The addresses of the station, at which the reader, the master and the publisher run.
const READER: &str = "10.78.0.9";
const STATION: &str = "10.79.0.9";
const MASTER: &str = "10.79.0.9:11311";
const METRICS: &str = "127.0.0.1:9101";

/// A host of a bridge or the station, each with an interface at both networks.
pub(crate) struct SwitchedNetwork {
    group: Segment,
    ros: Segment,
    bridges: [PlantSite; 2],
    station: PlantSite,
}

impl SwitchedNetwork {
    pub(crate) fn lay(cell: &Cell) -> Self {
        let network = Self {
            group: cell.segment(),
            ros: cell.segment(),
            bridges: [cell.site(), cell.site()],
            station: cell.site(),
        };
        let [first, second] = &network.bridges;
        let hosts = [
            (first, IN_GROUP[0], IN_ROS[0]),
            (second, IN_GROUP[1], IN_ROS[1]),
            (&network.station, READER, STATION),
        ];
        for (site, in_group, in_ros) in hosts {
            network.group.plug(site, "cell", in_group);
            network.ros.plug(site, "ros", in_ros);
        }
        network
    }

    /// Returns a bridge on its host, not started yet.
    pub(crate) fn bridge(&self, cell: &Cell, at: usize, mapping: &str) -> StartedChild {
        let bridge = StartedChild::new("bridge-ros1", &program("bridge-ros1"));
        of_ros(cell, bridge, IN_ROS[at])
            .args([mapping, "--rank", ["1", "2"][at]])
            .args(["--interface", "cell", "--metrics", METRICS])
            .at(&self.bridges[at])
    }

    /// Starts the master of ROS.
    pub(crate) fn master(&self, cell: &Cell) -> Child {
        let master = StartedChild::new("rosmaster", Path::new("/usr/bin/rosmaster"));
        let master = of_ros(cell, master, STATION).args(["--core", "-p", "11311"]);
        master.at(&self.station).start()
    }

    pub(crate) fn has_master(&self) -> bool {
        let answer = || xml_rpc(MASTER, "getPid", &["/bench"]);
        self.station.within(answer).is_some()
    }

    /// Returns the publisher of numbers, not started yet.
    pub(crate) fn publisher(&self, cell: &Cell, args: &[&str]) -> StartedChild {
        let publisher = cell.rospy_started("ros1_pub.py", args);
        of_ros(cell, publisher, STATION).at(&self.station)
    }

    /// Receives the numbers of a topic in the group.
    pub(crate) fn numbers(&self, triple: (u16, u16, u16)) -> GroupNumbers {
        let reader = READER.parse().unwrap();
        self.station
            .within(move || GroupNumbers::of(triple, reader))
    }

    /// Returns the status of a bridge.
    pub(crate) fn status(&self, at: usize) -> Option<Value> {
        self.bridges[at].within(|| metrics(METRICS))
    }

    /// Cuts a bridge off from the group, or ends it. Its interface keeps its link.
    pub(crate) fn set_group_cut(&self, at: usize, is_cut: bool) {
        self.group.set_cut_off(IN_GROUP[at], is_cut);
    }

    /// Takes away or returns the link of a bridge to ROS.
    pub(crate) fn set_ros_cut(&self, at: usize, is_cut: bool) {
        self.ros.set_link(IN_ROS[at], !is_cut);
    }
}

/// Adds the environment of a ROS 1 program with this address.
fn of_ros(cell: &Cell, started: StartedChild, address: &str) -> StartedChild {
    cell.with_ros1(started)
        .env("ROS_MASTER_URI", format!("http://{MASTER}"))
        .env("ROS_HOSTNAME", address)
}
