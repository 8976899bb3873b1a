//! Inspects the topics and services of a DDS domain.

use std::time::Duration;

use mappings::{LiveSpace, LiveTopic};
use messages::TypeName;
use ros2_node::domain::{DiscoveryRange, Domain, DomainOptions};
use ros2_node::graph::{Graph, RemoteEndpoint, ros_topic};
use ros2_node::node::NodeOptions;
use ros2_node::security::RequestedSecurity;
use tokio::time::{Instant, sleep};

use super::{MOST, away};
use crate::exit::CommandFailure;

/// Joins `domain` as a node, and leaves when discovery has brought nothing new for a while, at the
/// latest after `wait`.
pub(crate) async fn survey(domain: u16, wait: Duration) -> Result<LiveSpace, CommandFailure> {
    let joined = join(domain)?;
    let end = Instant::now() + wait;
    let (mut graph, mut since) = (joined.graph(), Instant::now());
    let mut services = joined.services(&graph);
    while Instant::now() < end {
        if !graph.participants().is_empty() && since.elapsed() >= SETTLED {
            break;
        }
        sleep(STEP).await;
        let newer = joined.graph();
        let offered = joined.services(&newer);
        if newer != graph || offered != services {
            (graph, services, since) = (newer, offered, Instant::now());
        }
    }
    joined.leave(()).await;
    if graph.participants().is_empty() {
        let what = format!("no participant was discovered in DDS domain {domain} within {wait:?}");
        return Err(away(what, HELP));
    }
    let services = services.into_iter().take(MOST).map(|(name, mut types)| {
        while types.len() > MOST_TYPES {
            types.pop_last();
        }
        (name, types)
    });
    Ok(LiveSpace {
        services: Some(services.collect()),
        ..live(&graph)
    })
}

fn join(domain: u16) -> Result<Domain, CommandFailure> {
    let variable = |name: &str| std::env::var(name).ok();
    let security = RequestedSecurity::from_env(variable, None)
        .map_err(|error| CommandFailure::Unconfigured(error.to_string()))?;
    let range = DiscoveryRange::from_env(
        variable("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref(),
        variable("ROS_LOCALHOST_ONLY").as_deref(),
    )
    .map_err(|error| CommandFailure::Usage(error.to_string()))?;
    let options = DomainOptions {
        domain,
        networks: range.networks(),
        peers: Vec::new(),
        node: NodeOptions::from(NODE),
        enclave: security.enclave().cloned(),
    };
    Domain::join(&options).map_err(|error| away(error, HELP))
}

fn live(graph: &Graph) -> LiveSpace {
    let mut live = LiveSpace::default();
    for (name, published) in graph
        .written_topics()
        .map(|name| (name, true))
        .chain(graph.read_topics().map(|name| (name, false)))
    {
        let all = if published {
            graph.writers(name)
        } else {
            graph.readers(name)
        };
        let mut others = all
            .iter()
            .filter(|one| !graph.is_bridge(one.guid))
            .peekable();
        let Some(ros) = ros_topic(name) else { continue };
        if others.peek().is_none() || live.topics.len() >= MOST {
            continue;
        }
        let topic = live.topics.entry(format!("/{ros}")).or_default();
        topic.published |= published;
        topic.subscribed |= !published;
        others.for_each(|one| learn(topic, one));
    }
    live
}

/// Adds a type; a type name that is not a ROS type is kept as it is.
fn learn(topic: &mut LiveTopic, endpoint: &RemoteEndpoint) {
    if topic.types.len() < MOST_TYPES {
        let named = TypeName::from_dds(&endpoint.type_name);
        topic
            .types
            .insert(named.map_or_else(|_| endpoint.type_name.clone(), |name| name.to_string()));
    }
}

const NODE: &str = "ua_space";
const HELP: &str = "are its nodes running, with the same ROS_DOMAIN_ID, and does multicast reach them? --wait N waits longer";
/// Time without changes after which discovery counts as complete; peers announce themselves within
/// a fraction of it when a participant joins.
const SETTLED: Duration = Duration::from_millis(1500);
const STEP: Duration = Duration::from_millis(50);
const MOST_TYPES: usize = 16;
