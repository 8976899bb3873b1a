//! Lists the peers in the DDS domain that the mapping needs and that are missing.

use std::collections::BTreeSet;
use std::net::IpAddr;

use bridge_node::{AwaitedPeers, BridgeActions, ExecutedServices, near};
use mappings::ServiceRole;
use ros2_node::graph::{RemoteEndpoint, ros_topic};
use ros2_node::service::ServicePeers;
use tokio::time::Instant;

use super::services::DomainServiceClient;
use super::side::Ros2Side;
use super::sinks::WrittenTopics;
use super::sources::ReadTopics;
use crate::sink::Ros2Sink;
use crate::source::Ros2Source;

/// The node and its topics, for the search of missing peers.
pub(super) struct Ros2MissingPeers<'p> {
    pub(super) side: &'p Ros2Side,
    pub(super) sources: &'p ReadTopics,
    pub(super) sinks: &'p WrittenTopics,
    pub(super) peers: &'p ServicePeers,
    /// The addresses to which RustDDS binds its sockets; empty means all addresses.
    pub(super) networks: &'p [IpAddr],
}

impl Ros2MissingPeers<'_> {
    /// Adds the missing peers.
    pub(super) fn add(&self, missing: &mut AwaitedPeers) {
        let bridges = self.side.graph.bridges().count();
        if self.side.graph.participants().len() <= bridges {
            missing.add(format!("nodes in DDS domain {}", self.side.domain_id), || {
                let networks = match self.networks {
                    [] => "all interfaces".to_owned(),
                    networks => {
                        let networks: Vec<String> = networks.iter().map(ToString::to_string).collect();
                        networks.join(", ")
                    }
                };
                format!(
                    "no participant was discovered on {networks}; compare ROS_DOMAIN_ID, the network and the discovery \
                     settings of the robot"
                )
            });
            return;
        }
        for source in self.sources.iter() {
            self.add_publisher(source, missing);
        }
        for (topic, sink) in self.sinks.iter() {
            let name = ros_topic(&sink.dds_topic);
            if name != Some(topic.to_string().as_str())
                && self.side.policy.mapping().variable(*topic).is_some()
            {
                self.add_mistaken(sink, missing);
            }
        }
        self.add_servers(missing);
    }

    /// Adds the publisher of a topic that the mapping reads.
    fn add_publisher(&self, source: &Ros2Source, missing: &mut AwaitedPeers) {
        let mapping = self.side.policy.mapping();
        let mut values = source.values.iter();
        if source.live || !values.any(|(topic, _)| mapping.variable(*topic).is_some()) {
            return;
        }
        let Some(name) = ros_topic(&source.dds_topic) else {
            return;
        };
        let writers = self.side.graph.writers(&source.dds_topic);
        let dds_type = source.message_type.dds();
        if writers.is_empty() {
            let known = self.side.graph.written_topics().filter_map(ros_topic);
            add_topic(("topic", name), "no publisher", known, missing);
        } else {
            missing.add(format!("topic /{name}"), || {
                match writers.iter().any(|writer| writer.type_name == dds_type) {
                    true => format!(
                        "the publisher uses another definition of {}",
                        source.message_type
                    ),
                    false => format!("no publisher of type {}", source.message_type),
                }
            });
        }
    }

    /// Adds a topic that the mapping writes and no node reads, if another node publishes it or
    /// reads a topic with a similar name.
    fn add_mistaken(&self, sink: &Ros2Sink, missing: &mut AwaitedPeers) {
        let Some(name) = ros_topic(&sink.dds_topic) else {
            return;
        };
        if !self.side.graph.readers(&sink.dds_topic).is_empty() {
            return;
        }
        let peer = format!("subscriber of /{name}");
        if let Some(writer) = self.side.graph.writers(&sink.dds_topic).first() {
            missing.add(peer, || {
                let owner = self.side.domain.owner(writer.guid);
                format!(
                    "no node subscribes to it, and {} publishes it too; if that node produces the value, \
                     set its `origin` to {}",
                    owner.as_deref().unwrap_or("an unnamed node"),
                    self.side.policy.own()
                )
            });
        } else if let Some(near) = near(name, self.side.graph.read_topics().filter_map(ros_topic)) {
            missing.add(peer, || format!("no subscriber; did you mean /{near}?"));
        }
    }

    /// Adds the services and actions that the mapping calls and no node serves.
    fn add_servers(&self, missing: &mut AwaitedPeers) {
        let mapping = self.side.policy.mapping();
        let services = ExecutedServices::<DomainServiceClient>::mapped(mapping, &self.side.policy);
        let called = mapping.services(self.side.policy.own());
        let called = called.filter_map(|(_, binding)| match &binding.role {
            ServiceRole::Call { service, .. } | ServiceRole::Poll { service, .. } => {
                Some(service.as_str())
            }
            ServiceRole::Answer { .. } => None,
        });
        let services: Vec<&str> = services.into_iter().chain(called).collect();
        let actions = BridgeActions::mapped(mapping, &self.side.policy);
        if services.is_empty() && actions.is_empty() {
            return;
        }
        let snapshot = self.peers.current(Instant::now());
        let served = self.of_nodes(snapshot.offered());
        add_unserved("service", services, &served, missing);
        let served = self.of_nodes(snapshot.served_actions());
        add_unserved("action", actions, &served, missing);
    }

    /// Returns the names of the servers that are not bridges.
    fn of_nodes<'s>(
        &self,
        served: impl Iterator<Item = (&'s str, &'s [RemoteEndpoint])>,
    ) -> BTreeSet<&'s str> {
        let is_node = |one: &RemoteEndpoint| !self.side.graph.is_bridge(one.guid);
        let of_nodes = served.filter(|(_, servers)| servers.iter().any(is_node));
        of_nodes.map(|(name, _)| name).collect()
    }
}

fn add_unserved<'n>(
    kind: &str,
    wanted: impl IntoIterator<Item = &'n str>,
    served: &BTreeSet<&str>,
    missing: &mut AwaitedPeers,
) {
    for name in wanted {
        let name = name.trim_start_matches('/');
        if !served.contains(name) {
            add_topic((kind, name), "no server", served.iter().copied(), missing);
        }
    }
}

/// Adds a ROS name that has no leading slash, as in DDS topic names.
fn add_topic<'k>(
    (kind, name): (&str, &str),
    reason: &str,
    known: impl Iterator<Item = &'k str>,
    missing: &mut AwaitedPeers,
) {
    missing.add(format!("{kind} /{name}"), || match near(name, known) {
        Some(near) => format!("{reason}; did you mean /{near}?"),
        None => reason.to_owned(),
    });
}
