//! The facts about ROS: the master, the hosts of its nodes, and the settings of the environment.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;
use std::time::Duration;

use serde::Serialize;
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::host::HostFacts;
use crate::survey::master_uri;

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct Ros1 {
    /// The URI of the master.
    pub(super) master: String,
    /// True if the environment names the master, or a bridge of ROS 1 runs here.
    pub(super) is_wanted: bool,
    /// The reason why the master does not answer; `None` if it answers or was not asked.
    pub(super) fault: Option<String>,
    pub(super) nodes: usize,
    /// The nodes on hosts that do not resolve from here: node, and host.
    pub(super) unresolved: Vec<(String, String)>,
    /// The addresses of the host of the master.
    pub(super) master_addresses: Vec<IpAddr>,
    pub(super) ros_ip: Option<String>,
    pub(super) ros_hostname: Option<String>,
    /// The addresses of ROS_HOSTNAME, or of the name of this host without it.
    pub(super) own_name_addresses: Vec<IpAddr>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct Ros2 {
    /// The variables that set discovery and the middleware.
    pub(super) variables: BTreeMap<String, String>,
}

impl Ros2 {
    pub(super) fn get(&self, name: &str) -> Option<&str> {
        let value = self.variables.get(name).map(String::as_str);
        value.filter(|value| !value.is_empty())
    }
}

const VARIABLES: [&str; 8] = [
    "ROS_DOMAIN_ID",
    "RMW_IMPLEMENTATION",
    "ROS_LOCALHOST_ONLY",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "CYCLONEDDS_URI",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
];

pub(super) fn ros2() -> Ros2 {
    let variables = VARIABLES.iter();
    let set = variables.filter_map(|name| Some(((*name).to_owned(), variable(name)?)));
    Ros2 {
        variables: set.collect(),
    }
}

fn variable(name: &str) -> Option<String> {
    std::env::var(name).ok().filter(|value| !value.is_empty())
}

/// Asks the master for its nodes, and resolves the names of their hosts.
pub(super) async fn ros1(host: &HostFacts) -> Ros1 {
    let bridged = host
        .processes
        .iter()
        .any(|one| one.program == "bridge-ros1");
    let mut facts = Ros1 {
        master: master_uri(),
        is_wanted: bridged || variable("ROS_MASTER_URI").is_some(),
        ros_ip: variable("ROS_IP"),
        ros_hostname: variable("ROS_HOSTNAME"),
        ..Ros1::default()
    };
    if !facts.is_wanted {
        return facts;
    }
    let own_name = facts.ros_hostname.as_ref().unwrap_or(&host.name);
    facts.own_name_addresses = resolved(own_name).await;
    if let Some(name) = host_of(&facts.master) {
        facts.master_addresses = resolved(name).await;
    }
    let graph = timeout(LIMIT, tcpros::MasterGraph::of_master(&facts.master, CALLER)).await;
    let graph = match graph {
        Ok(Ok(graph)) => graph,
        Ok(Err(error)) => {
            facts.fault = Some(error.to_string());
            return facts;
        }
        Err(_over) => {
            facts.fault = Some(format!("no answer within {LIMIT:?}"));
            return facts;
        }
    };
    let ends = [&graph.publishers, &graph.subscribers, &graph.services];
    let nodes: BTreeSet<&String> = ends
        .into_iter()
        .flat_map(BTreeMap::values)
        .flatten()
        .collect();
    facts.nodes = nodes.len();
    let mut asking = JoinSet::new();
    for node in nodes.into_iter().take(MOST_NODES).cloned() {
        let master = facts.master.clone();
        asking.spawn(async move {
            let uri = tcpros::MasterGraph::node_uri(&master, CALLER, &node);
            let uri = timeout(LIMIT, uri).await.ok()?.ok()??;
            let name = host_of(&uri)?.to_owned();
            resolved(&name).await.is_empty().then_some((node, name))
        });
    }
    facts.unresolved = asking.join_all().await.into_iter().flatten().collect();
    facts.unresolved.sort();
    facts
}

/// Returns the host of a URI as `http://host:port/`.
pub(super) fn host_of(uri: &str) -> Option<&str> {
    let authority = uri.split_once("://")?.1.split('/').next()?;
    let host = match authority.rsplit_once(':') {
        Some((host, port)) if port.chars().all(|c| c.is_ascii_digit()) => host,
        _ => authority,
    };
    Some(host.trim_start_matches('[').trim_end_matches(']')).filter(|host| !host.is_empty())
}

/// Returns the addresses of a name; empty if it does not resolve in time.
async fn resolved(name: &str) -> Vec<IpAddr> {
    let found = timeout(LIMIT, tokio::net::lookup_host((name, 0))).await;
    let found = found.ok().and_then(Result::ok).into_iter().flatten();
    let all: BTreeSet<IpAddr> = found.map(|address| address.ip()).collect();
    all.into_iter().collect()
}

const CALLER: &str = "/ua_space_doctor";
const LIMIT: Duration = Duration::from_secs(4);
const MOST_NODES: usize = 200;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_host_of_a_node_is_a_part_of_its_uri() {
        assert_eq!(host_of("http://ned:45013/"), Some("ned"));
        assert_eq!(host_of("http://10.0.0.7:1"), Some("10.0.0.7"));
        assert_eq!(host_of("http://[::1]:1/"), Some("::1"));
        assert_eq!(host_of("ned"), None);
    }
}
