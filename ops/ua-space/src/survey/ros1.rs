//! The graph of a ROS 1 master.

use std::collections::BTreeSet;
use std::time::Duration;

use mappings::{LiveSpace, LiveTopic};
use tcpros::{MasterError, RpcError};
use tokio::time::timeout;

use super::{MOST, away};
use crate::exit::Failure;

/// `ROS_MASTER_URI`, or what ROS takes without it.
pub(crate) fn master_uri() -> String {
    std::env::var("ROS_MASTER_URI")
        .ok()
        .filter(|uri| !uri.is_empty())
        .unwrap_or_else(|| "http://localhost:11311".to_owned())
}

/// Asks the master at `uri`; becomes no node of the graph.
pub(crate) async fn survey(uri: &str) -> Result<LiveSpace, Failure> {
    let asked = timeout(LIMIT, tcpros::Graph::of_master(uri, CALLER)).await;
    let graph = match asked {
        Ok(Ok(graph)) => graph,
        Ok(Err(MasterError::Rpc(RpcError::Uri))) => {
            return Err(Failure::Usage(format!(
                "`{uri}` is no URI of a ROS 1 master, such as http://localhost:11311"
            )));
        }
        Ok(Err(error)) => {
            return Err(away(
                format!("no ROS 1 master answers at {uri}: {error}"),
                HELP,
            ));
        }
        Err(_over) => {
            let what = format!("the ROS 1 master at {uri} did not answer within {LIMIT:?}");
            return Err(away(what, HELP));
        }
    };
    let mut live = LiveSpace {
        // The master knows no types of them.
        services: Some(
            graph
                .services
                .into_keys()
                .take(MOST)
                .map(|name| (name, BTreeSet::new()))
                .collect(),
        ),
        ..LiveSpace::default()
    };
    for (ends, published) in [(graph.publishers, true), (graph.subscribers, false)] {
        for (name, nodes) in ends {
            // What a bridge does there, it does for a mapping that is there already.
            if nodes.iter().all(|node| node.starts_with(BRIDGE)) || live.topics.len() >= MOST {
                continue;
            }
            let topic = live.topics.entry(name).or_default();
            topic.published |= published;
            topic.subscribed |= !published;
        }
    }
    for (name, told) in graph.types {
        if let Some(topic) = live.topics.get_mut(&name) {
            learn(topic, &told);
        }
    }
    Ok(live)
}

/// A subscriber of any type says `*`.
fn learn(topic: &mut LiveTopic, told: &str) {
    if told != "*" {
        topic.types.insert(told.to_owned());
    }
}

const CALLER: &str = "/ua_space";
/// How `bridge-ros1` is called unless told otherwise.
const BRIDGE: &str = "/ua_bridge_ros1";
const HELP: &str =
    "is roscore running there? ROS_MASTER_URI or the argument of --ros1 names the master";
/// Two calls of 3 s, and the time to find the host.
const LIMIT: Duration = Duration::from_secs(8);
