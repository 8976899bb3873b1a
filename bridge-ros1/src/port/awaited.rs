//! Lists the peers in the ROS graph that the mapping needs and that are missing.

use std::net::IpAddr;

use bridge_node::{AwaitedPeers, BridgeActions, ExecutedServices, near};
use mappings::{Mapping, ServiceRole, SpaceId};

use super::action_servers::{served, server};
use super::side::Ros1Side;
use super::sinks::AdvertisedTopics;
use super::sources::SubscribedTopics;
use crate::services::ServiceExecutor;
use crate::sink::Ros1Sink;
use crate::source::Ros1Source;

/// The node and its topics, for the search of missing peers.
pub(super) struct Ros1MissingPeers<'p> {
    pub(super) side: &'p Ros1Side,
    /// The address of this node as other nodes see it; `None` if it is a host name.
    pub(super) address: Option<IpAddr>,
    pub(super) sources: &'p SubscribedTopics,
    pub(super) sinks: &'p AdvertisedTopics,
}

impl Ros1MissingPeers<'_> {
    /// Adds the missing peers.
    pub(super) fn add(&self, missing: &mut AwaitedPeers) {
        if let Some(address) = self.address.filter(|address| !is_local(*address)) {
            missing.add("other ROS nodes", || {
                format!(
                    "this node announces the address {address}, which is not an address of this host; \
                     correct ROS_IP or ROS_HOSTNAME"
                )
            });
        }
        // Without a master no peers are known; this is reported as not ready.
        if !self.side.has_master {
            return;
        }
        for source in self.sources.iter() {
            self.add_publisher(source, missing);
        }
        for (topic, sink) in self.sinks.iter() {
            let is_named = sink.ros_topic != format!("/{topic}");
            if is_named && self.side.policy.mapping().variable(*topic).is_some() {
                self.add_mistaken(sink, missing);
            }
            self.add_subscribers(sink, missing);
        }
        self.add_servers(missing);
    }

    /// Adds the publisher of a topic that the mapping subscribes to.
    fn add_publisher(&self, source: &Ros1Source, missing: &mut AwaitedPeers) {
        if source.found || source.values.is_empty() || source.is_live() {
            return;
        }
        let (publishers, topic) = (&self.side.graph.publishers, source.ros_topic.as_str());
        let Some(publisher) = self.side.others(publishers, topic).next() else {
            let known = self.side.names(publishers);
            missing.add_named(("topic", topic), "no publisher", known);
            return;
        };
        missing.add(format!("topic {topic}"), || {
            let typed = source.expected.as_ref().filter(|_| source.has_strangers());
            match typed {
                Some(expected) => match self.side.graph.types.get(topic) {
                    Some(of) if *of != expected.to_string() => format!(
                        "{publisher} publishes it as {of}, but the mapping has the type {expected}"
                    ),
                    Some(_) | None => format!("{publisher} does not publish it as {expected}"),
                },
                None => format!(
                    "its publisher {publisher} is not connected: the node is unreachable, or it has died \
                     (remove it with `rosnode cleanup`)"
                ),
            }
        });
    }

    /// Adds a topic that the mapping publishes and no node subscribes to, if another node publishes
    /// it or subscribes to a topic with a similar name.
    fn add_mistaken(&self, sink: &Ros1Sink, missing: &mut AwaitedPeers) {
        let topic = sink.ros_topic.as_str();
        let subscribers = &self.side.graph.subscribers;
        if self.side.others(subscribers, topic).next().is_some() {
            return;
        }
        let peer = format!("subscriber of {topic}");
        if let Some(publisher) = self.side.others(&self.side.graph.publishers, topic).next() {
            missing.add(peer, || {
                format!(
                    "no node subscribes to it, and {publisher} publishes it too; if {publisher} produces \
                     the value, set its `origin` to {}",
                    self.side.policy.own()
                )
            });
        } else if let Some(near) = near(topic, self.side.names(subscribers)) {
            missing.add(peer, || format!("no subscriber; did you mean {near}?"));
        }
    }

    /// Adds the subscribers of a topic of this node that are registered at the master and do not
    /// connect.
    fn add_subscribers(&self, sink: &Ros1Sink, missing: &mut AwaitedPeers) {
        let Some(open) = &sink.open else { return };
        let publisher = &open.publisher;
        let others = self
            .side
            .others(&self.side.graph.subscribers, publisher.topic());
        for node in others.filter(|node| !publisher.is_subscribed_by(node)) {
            missing.add(format!("subscriber {node}"), || {
                if let Some(refused) = publisher.refused_type() {
                    return format!(
                        "it subscribes to {} as {refused}, but the bridge publishes {}",
                        publisher.topic(),
                        open.message_type.name()
                    );
                }
                if publisher.asks_for_udp(node) {
                    return format!(
                        "it requests {} over UDPROS only; configure it for TCPROS",
                        publisher.topic()
                    );
                }
                format!(
                    "it cannot reach {} (set ROS_IP to an address that it can reach), or it has died \
                     (remove it with `rosnode cleanup`)",
                    self.side.node.uri()
                )
            });
        }
    }

    /// Adds the services and actions that the mapping calls and no node serves.
    fn add_servers(&self, missing: &mut AwaitedPeers) {
        let (mapping, services) = (self.side.policy.mapping(), &self.side.graph.services);
        let executed =
            ExecutedServices::<ServiceExecutor>::mapped(mapping, &self.side.policy).into_iter();
        for service in executed.chain(called(mapping, self.side.policy.own())) {
            if self.side.others(services, service).next().is_none() {
                let known = self.side.names(services);
                missing.add_named(("service", service), "no server", known);
            }
        }
        for action in BridgeActions::mapped(mapping, &self.side.policy) {
            if server(&self.side.graph, self.side.node.name(), action).is_none() {
                let known = served(&self.side.graph, self.side.node.name());
                missing.add_named(("action", action), "no server", known);
            }
        }
    }
}

/// Returns the services that values call.
fn called(mapping: &Mapping, own: SpaceId) -> impl Iterator<Item = &str> {
    mapping
        .services(own)
        .filter_map(|(_, binding)| match &binding.role {
            ServiceRole::Call { service, .. } | ServiceRole::Poll { service, .. } => {
                Some(service.as_str())
            }
            ServiceRole::Answer { .. } => None,
        })
}

/// Returns true if an interface of this host has the address, or the interfaces cannot be listed.
fn is_local(address: IpAddr) -> bool {
    let IpAddr::V4(address) = address else {
        return true;
    };
    let interfaces = transport::interfaces().unwrap_or_default();
    address.is_loopback()
        || interfaces.is_empty()
        || interfaces.iter().any(|one| one.address == address)
}
