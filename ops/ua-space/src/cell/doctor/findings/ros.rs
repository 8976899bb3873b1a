//! The ROS 1 master and the names of its nodes, and the settings of ROS 2.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use super::super::facts::CellFacts;
use super::DoctorSeverity::{Error, Note, Warning};
use super::{DoctorFinding, finding};

pub(super) fn master(facts: &CellFacts) -> Vec<DoctorFinding> {
    let ros = &facts.ros1;
    let Some(fault) = ros.fault.as_ref().filter(|_| ros.is_wanted) else {
        return Vec::new();
    };
    let severity = if facts.has_program("bridge-ros1") {
        Error
    } else {
        Warning
    };
    vec![finding(
        ("D010", severity),
        format!("no ROS 1 master answers at {}: {fault}", ros.master),
        "bridge-ros1 waits for the master, and nothing crosses from or to ROS 1",
        "start roscore, or set ROS_MASTER_URI to the master that the robot uses (`echo \
         $ROS_MASTER_URI` there)",
    )]
}

pub(super) fn unresolved_nodes(facts: &CellFacts) -> Vec<DoctorFinding> {
    let mut by_host: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (node, host) in &facts.ros1.unresolved {
        by_host.entry(host).or_default().push(node);
    }
    let each = by_host.into_iter().map(|(host, nodes)| {
        let first = nodes.first().copied().unwrap_or_default();
        let others = match nodes.len() {
            0 | 1 => String::new(),
            many => format!(" and {} more", many - 1),
        };
        finding(
            ("D011", Error),
            format!("the host `{host}` of ROS 1 node {first}{others} does not resolve from here"),
            "ROS 1 peers connect to the name that a node registered: topics of this node are listed \
             and stay silent",
            format!(
                "add `ADDRESS {host}` to /etc/hosts of this host, or set ROS_IP to an address on \
                 the node's host and restart the node"
            ),
        )
    });
    each.collect()
}

pub(super) fn own_ros_address(facts: &CellFacts) -> Vec<DoctorFinding> {
    let ros = &facts.ros1;
    if !ros.is_wanted {
        return Vec::new();
    }
    let own = |address: &IpAddr| {
        let text = address.to_string();
        address.is_loopback() || facts.host.interfaces.iter().any(|one| one.address == text)
    };
    let is_remote = ros.master_addresses.iter().any(|address| !own(address));
    let why = "other nodes connect to this address to receive what bridge-ros1 publishes";
    if let Some(ip) = &ros.ros_ip {
        let parsed: Option<IpAddr> = ip.parse().ok();
        if !parsed.as_ref().is_some_and(own) {
            return vec![finding(
                ("D012", Error),
                format!("ROS_IP is {ip}, which is no address of this host"),
                why,
                "set ROS_IP to an address that `ip -4 address` shows, in the network of the robot",
            )];
        }
        if parsed.is_some_and(|ip| ip.is_loopback()) && is_remote {
            return vec![finding(
                ("D012", Error),
                format!("ROS_IP is {ip}, and the master is on another host"),
                why,
                "set ROS_IP to the address of this host in the network of the robot",
            )];
        }
        return Vec::new();
    }
    let name = ros.ros_hostname.as_ref().unwrap_or(&facts.host.name);
    let is_loopback = ros.own_name_addresses.iter().all(IpAddr::is_loopback);
    if is_remote && is_loopback {
        let what = match ros.own_name_addresses.is_empty() {
            true => format!("the name `{name}` of this host does not resolve"),
            false => format!("the name `{name}` of this host resolves to loopback"),
        };
        return vec![finding(
            ("D012", Error),
            format!("{what}, and the ROS 1 master is on another host"),
            why,
            "set ROS_IP to the address of this host in the network of the robot",
        )];
    }
    Vec::new()
}

pub(super) fn discovery_range(facts: &CellFacts) -> Vec<DoctorFinding> {
    let localhost = facts
        .ros2
        .get("ROS_LOCALHOST_ONLY")
        .filter(|value| *value == "1");
    let range = facts.ros2.get("ROS_AUTOMATIC_DISCOVERY_RANGE");
    let range = range.filter(|value| ["LOCALHOST", "OFF"].contains(&value.to_uppercase().as_str()));
    let set = match (localhost, range) {
        (Some(_), _) => "ROS_LOCALHOST_ONLY is 1".to_owned(),
        (None, Some(range)) => format!("ROS_AUTOMATIC_DISCOVERY_RANGE is {range}"),
        (None, None) => return Vec::new(),
    };
    vec![finding(
        ("D020", Warning),
        set,
        "ROS 2 nodes with this setting are not found from other hosts",
        "unset it where the nodes start, or run bridge-ros2 on the host of the nodes",
    )]
}

pub(super) fn discovery_server(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(server) = facts.ros2.get("ROS_DISCOVERY_SERVER") else {
        return Vec::new();
    };
    vec![finding(
        ("D021", Warning),
        format!("ROS_DISCOVERY_SERVER is {server}"),
        "nodes that use a discovery server do not announce themselves by multicast, so bridge-ros2 \
         does not find them",
        "unset it for the nodes of the cell",
    )]
}

pub(super) fn middleware(facts: &CellFacts) -> Vec<DoctorFinding> {
    let name = facts.ros2.get("RMW_IMPLEMENTATION");
    let Some(name) = name.filter(|name| !DDS.contains(name)) else {
        return Vec::new();
    };
    vec![finding(
        ("D022", Error),
        format!("RMW_IMPLEMENTATION is {name}, which does not speak DDS as bridge-ros2 does"),
        "nodes with this middleware and bridge-ros2 do not find each other",
        "start the nodes with RMW_IMPLEMENTATION=rmw_cyclonedds_cpp or rmw_fastrtps_cpp",
    )]
}

pub(super) fn domain(facts: &CellFacts) -> Vec<DoctorFinding> {
    let Some(domain) = facts.ros2.get("ROS_DOMAIN_ID") else {
        return Vec::new();
    };
    let bridges = facts
        .pages
        .iter()
        .filter(|page| page.program == "bridge-ros2");
    let spaces: BTreeSet<String> = bridges.map(|page| page.space.to_string()).collect();
    if spaces.is_empty() || spaces.contains(domain) {
        return Vec::new();
    }
    let spaces: Vec<String> = spaces.into_iter().collect();
    vec![finding(
        ("D023", Note),
        format!(
            "ROS_DOMAIN_ID is {domain}, and bridge-ros2 here serves space {}",
            spaces.join(", ")
        ),
        "a ROS 2 node of another domain is not bridged; the domain of a space is its number unless \
         the mapping names another",
        "start nodes in the domain of the space, or set `domain` of the space in the mapping",
    )]
}

const DDS: [&str; 4] = [
    "rmw_cyclonedds_cpp",
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_connextdds",
];
