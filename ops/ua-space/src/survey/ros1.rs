//! Inspects the graph of a ROS 1 master.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use mappings::{LiveSpace, LiveTopic};
use messages::TypeName;
use tcpros::{MasterError, RpcError, ServiceClient, ServiceClientOptions};
use tokio::task::JoinSet;
use tokio::time::timeout;

use super::{MOST, away};
use crate::exit::CommandFailure;

/// Returns `ROS_MASTER_URI`, or the default of ROS.
pub(crate) fn master_uri() -> String {
    std::env::var("ROS_MASTER_URI")
        .ok()
        .filter(|uri| !uri.is_empty())
        .unwrap_or_else(|| "http://localhost:11311".to_owned())
}

/// Queries the master at `uri` without registering a node.
pub(crate) async fn survey(uri: &str) -> Result<LiveSpace, CommandFailure> {
    let asked = timeout(LIMIT, tcpros::MasterGraph::of_master(uri, CALLER)).await;
    let graph = match asked {
        Ok(Ok(graph)) => graph,
        Ok(Err(MasterError::Rpc(RpcError::Uri))) => {
            return Err(CommandFailure::Usage(format!(
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
        services: Some(services(uri, graph.services).await),
        ..LiveSpace::default()
    };
    for (ends, published) in [(graph.publishers, true), (graph.subscribers, false)] {
        for (name, nodes) in ends {
            // Topics of bridges only are left out, because they follow from an existing mapping.
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

/// Returns the services except the services of bridges, each with the type from its server. The
/// master does not know the types.
async fn services(
    uri: &str,
    offered: BTreeMap<String, Vec<String>>,
) -> BTreeMap<String, BTreeSet<String>> {
    let others = offered
        .into_iter()
        .filter(|(_, nodes)| !nodes.iter().all(|node| node.starts_with(BRIDGE)));
    let names: Vec<String> = others.map(|(name, _)| name).take(MOST).collect();
    let mut services: BTreeMap<String, BTreeSet<String>> = names
        .iter()
        .map(|name| (name.clone(), BTreeSet::new()))
        .collect();
    let mut left = names.into_iter();
    let mut asking = JoinSet::new();
    let asked = async {
        loop {
            while asking.len() < AT_ONCE
                && let Some(name) = left.next()
            {
                asking.spawn(service_type(uri.to_owned(), name));
            }
            match asking.join_next().await {
                Some(Ok((name, Some(told)))) => {
                    services.entry(name).or_default().insert(told);
                }
                Some(_) => {}
                None => return,
            }
        }
    };
    // Services have no type if their servers did not respond in time.
    let _over = timeout(PROBING, asked).await;
    services
}

/// Returns the name of a service, and its type from its server.
async fn service_type(uri: String, name: String) -> (String, Option<String>) {
    let options = ServiceClientOptions {
        timeout: PROBE,
        ..ServiceClientOptions::default()
    };
    let Ok(client) = ServiceClient::of_master(&uri, CALLER, &name, options) else {
        return (name, None);
    };
    let told = client.probe().await.ok();
    let told = told.and_then(|header| header.get("type").map(str::to_owned));
    (name, told.filter(|told| told.parse::<TypeName>().is_ok()))
}

/// Adds a type; a subscriber of any type has the type `*`.
fn learn(topic: &mut LiveTopic, told: &str) {
    if told != "*" {
        topic.types.insert(told.to_owned());
    }
}

const CALLER: &str = "/ua_space";
/// The default node name of `bridge-ros1`.
const BRIDGE: &str = "/ua_bridge_ros1";
const HELP: &str =
    "is roscore running there? ROS_MASTER_URI or the argument of --ros1 names the master";
/// Two calls of 3 s, and the time to resolve the host.
const LIMIT: Duration = Duration::from_secs(8);
/// Limits of the queries for service types: number of concurrent queries, time of each query, and
/// time of all queries.
const AT_ONCE: usize = 32;
const PROBE: Duration = Duration::from_secs(2);
const PROBING: Duration = Duration::from_secs(10);
