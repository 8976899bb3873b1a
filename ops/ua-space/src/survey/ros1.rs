//! The graph of a ROS 1 master.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use mappings::{LiveSpace, LiveTopic};
use messages::TypeName;
use tcpros::{MasterError, RpcError, ServiceClient, ServiceClientOptions};
use tokio::task::JoinSet;
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
        services: Some(services(uri, graph.services).await),
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

/// The services there are but for those of bridges, each with the type its server tells. The master knows none.
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
    // Those that did not tell it by then have none.
    let _over = timeout(PROBING, asked).await;
    services
}

/// The name of a service, and its type as its server has it.
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
/// Servers of services that are asked for their types side by side, how long one of them has, and how long all have.
const AT_ONCE: usize = 32;
const PROBE: Duration = Duration::from_secs(2);
const PROBING: Duration = Duration::from_secs(10);
