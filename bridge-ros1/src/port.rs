//! The port: connects the topics of a ROS 1 graph with the values of the space.
//!
//! A single task owns all state; [`Ros1Port::recv`](Port::recv) is its only wait. The port wires
//! types that own their state: the subscribed topics ([`SubscribedTopics`]), the published topics
//! ([`AdvertisedTopics`]), and services and actions ([`Ros1Requests`]). They share the node and its
//! view of the graph ([`Ros1Side`]).

mod action_servers;
mod awaited;
mod kinds;
mod requests;
mod side;
mod sinks;
mod sources;

use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;

use bridge_node::policy::{Policy, TYPE_CHANGES, is_bad, type_changes};
use bridge_node::{
    AskId, AwaitedPeers, CallDescription, CallResponse, Execution, ExecutionId, Handover,
    LocalDelivery, Port, PortEvent, TopicMetaData, TypePaths,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId, Variable};
use tcpros::{MasterGraph, Node, NodeError, NodeOptions};
use tracing::info;
use uadp::{BuiltinType, Timestamp};

use self::awaited::Ros1MissingPeers;
use self::requests::Ros1Requests;
use self::side::Ros1Side;
use self::sinks::AdvertisedTopics;
use self::sources::SubscribedTopics;
use crate::definitions::Ros1Definitions;
use crate::watcher::{MasterWatcher, WatcherEvent};

/// The options of a [`Ros1Port`].
#[derive(Debug, Clone)]
pub struct Ros1PortOptions {
    /// The options of the node, including the URI of the master.
    pub node: NodeOptions,
    /// The space of the values produced in the graph.
    pub own: SpaceId,
    /// The mapping of the cell.
    pub mapping: Arc<Mapping>,
    /// The definitions of the `type_paths` of the mapping.
    pub types: Arc<TypePaths>,
    /// Folders with message definitions that are not built in, from `ROS_PACKAGE_PATH`.
    pub packages: Vec<PathBuf>,
}

/// The ROS 1 side of a bridge.
#[derive(Debug)]
pub struct Ros1Port {
    side: Ros1Side,
    /// The subscribed topics.
    sources: SubscribedTopics,
    /// The published topics.
    sinks: AdvertisedTopics,
    /// Services and actions in both directions.
    requests: Ros1Requests,
    watcher: MasterWatcher,
    /// The number of comparisons since the last search for topics in the graph.
    unsearched: u32,
    /// The address of this node as other nodes see it; `None` if it is a host name.
    address: Option<IpAddr>,
    master: String,
}

impl Ros1Port {
    /// Starts the node, and subscribes and publishes the topics of the mapping. The master may
    /// become available later. Must be called inside a tokio runtime.
    ///
    /// # Errors
    /// [`NodeError`] if the node cannot be started or a name is invalid.
    pub fn start(options: Ros1PortOptions) -> Result<Self, NodeError> {
        let Ros1PortOptions {
            node,
            own,
            mapping,
            types,
            packages,
        } = options;
        let master = node.master_uri.clone();
        let address = node.hostname.parse().ok();
        let node = Node::start(node)?;
        info!(node = node.name(), uri = node.uri(), master, space = %own, "started the ROS 1 node");
        let mut definitions = Ros1Definitions::new(types, packages);
        let (requests, bound) = Ros1Requests::start(&node, &mut definitions, (own, &mapping));
        let mut port = Self {
            watcher: MasterWatcher::of(&node),
            side: Ros1Side {
                node,
                policy: Policy::new(own, mapping),
                definitions,
                graph: Arc::default(),
                has_master: false,
                events: bound.into(),
            },
            sources: SubscribedTopics::new(),
            sinks: AdvertisedTopics::default(),
            requests,
            unsearched: 0,
            address,
            master,
        };
        port.take_bindings()?;
        port.requests.ask_for_mapped(&mut port.side);
        Ok(port)
    }

    fn take_bindings(&mut self) -> Result<(), NodeError> {
        let own = self.side.policy.own();
        let mapping = Arc::clone(self.side.policy.mapping());
        for (variable, binding) in mapping.bindings(own) {
            let topic = variable.topic;
            if topic.space == own {
                let named = (binding.ros_topic.as_str(), &binding.message_type);
                let value = (topic, binding.selection.clone());
                self.sources.take_up(&self.side, named, value)?;
            } else {
                self.sinks.take_up(&mut self.side, topic);
            }
        }
        Ok(())
    }

    /// Compares the graph with the open topics. `None` stands for an unavailable master; then the
    /// topics stay unchanged.
    fn look(&mut self, graph: Option<Arc<MasterGraph>>) {
        self.side.has_master = graph.is_some();
        if let Some(graph) = graph {
            // An unchanged graph is searched too, but less often: a subscription may be lost, and a
            // topic that the limit refused may find room.
            let unchanged = Arc::ptr_eq(&self.side.graph, &graph);
            self.side.graph = graph;
            self.sources.looked_at();
            self.unsearched += 1;
            if !unchanged || self.unsearched >= SEARCH {
                self.unsearched = 0;
                self.find_sources();
            }
            self.requests.look(&mut self.side);
            self.sources.tell_refused();
        }
        self.sources.drop_gone(&mut self.side);
        self.requests.tidy(&self.side);
        self.sinks.reconcile(&mut self.side);
    }

    /// Searches the graph for topics with values of this space.
    fn find_sources(&mut self) {
        let written = |side: &Ros1Side| self.sinks.names(side);
        self.sources.find(&mut self.side, written);
    }
}

/// The number of comparisons with an unchanged graph until it is searched again.
const SEARCH: u32 = 4;

impl Port for Ros1Port {
    async fn recv(&mut self) -> PortEvent {
        loop {
            if let Some(event) = self.side.events.pop_front() {
                return event;
            }
            // All branches are cancel-safe. The graph comes before samples, so a flood of samples
            // does not delay new topics.
            tokio::select! {
                biased;
                () = self.sinks.wait() => self.sinks.flush(&mut self.side),
                seen = self.watcher.recv() => match seen {
                    WatcherEvent::Graph(graph) => self.look(graph),
                    WatcherEvent::Ended(reason) => {
                        let name = self.side.node.name();
                        return PortEvent::Ended(format!("the ROS master or another node shut down the ROS 1 node \
                                                         {name}: {reason}"));
                    }
                },
                has_type = self.requests.recv(&mut self.side.events) => if has_type {
                    self.requests.find_services(&mut self.side);
                },
                event = self.sources.recv() => self.sources.handle(&mut self.side, event),
            }
        }
    }

    fn publish(&mut self, sample: LocalDelivery) -> Result<(), &'static str> {
        if type_changes(&self.side.events, sample.topic) {
            return Err(TYPE_CHANGES);
        }
        if is_bad(sample.status) {
            return Err("bad status");
        }
        match self.requests.publish(&mut self.side, &sample) {
            Some(taken) => taken,
            None => self.sinks.publish(&mut self.side, sample),
        }
    }

    fn handover(&self, topic: TopicId) -> Handover {
        let handover = self.requests.handover(topic);
        handover.unwrap_or_else(|| self.sinks.handover(topic))
    }

    fn wanted(
        &mut self,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&TopicMetaData>,
    ) {
        let policy = &self.side.policy;
        let for_service = |variable: &Variable| variable.service.is_some();
        let is_taken = topic.space == policy.own()
            || policy.mapping().variable(topic).is_some_and(for_service)
            || self.requests.is_of_action(&self.side, topic);
        if !is_taken {
            self.sinks.wanted(&mut self.side, topic, shape, described);
        }
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        self.sinks.silent(topic, silent);
    }

    fn retired(&mut self, topic: TopicId, instance: Timestamp) {
        self.sinks.retired(topic, instance);
    }

    fn drop_waiting(&mut self, _at_once: bool) {
        self.sinks.drop_waiting(&mut self.side);
    }

    fn role_changed(&mut self, _is_active: bool) {
        self.requests.is_one_of_several();
    }

    fn links_lost(&mut self, lost: &[IpAddr]) {
        self.side.node.set_lost_addresses(lost);
    }

    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.requests.known(&mut self.side, topic, description);
    }

    fn call_gone(&mut self, topic: TopicId) {
        self.requests.gone(topic);
    }

    fn answered(&mut self, ask: AskId, _: TopicId, answer: CallResponse<Bytes>) {
        self.requests.answered(ask, answer);
    }

    fn execute(&mut self, execution: Execution) -> bool {
        self.requests.execute(&mut self.side, execution);
        true
    }

    fn abandoned(&mut self, execution: ExecutionId, _: TopicId) {
        self.requests.abandoned(execution);
    }

    /// Applies the new mapping. Everything obsolete is removed before new parts are added, because
    /// a value or topic may only have moved.
    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String> {
        let side = &mut self.side;
        let before = side.policy.replace(mapping);
        side.definitions.replace(types);
        let read = side.policy.read(|ros_topic| side.node.resolve(ros_topic));
        self.sources.give_up(side, &read);
        self.sinks.give_up(side);
        self.requests.reload(side, &before);
        self.sources.take_up_all(side, read);
        self.sinks.take_up_written(side);
        // Topics of the space that only the previous mapping named, and topics of new patterns.
        self.find_sources();
        Vec::new()
    }

    fn hindrance(&self) -> Option<String> {
        (!self.side.has_master).then(|| format!("no ROS master responds at {}", self.master))
    }

    fn add_awaited(&self, missing: &mut AwaitedPeers) {
        let found = Ros1MissingPeers {
            side: &self.side,
            address: self.address,
            sources: &self.sources,
            sinks: &self.sinks,
        };
        found.add(missing);
    }

    fn addresses(&self) -> Option<&[IpAddr]> {
        // Connections break if this address is removed, and the master has announced it to all
        // nodes.
        self.address.as_ref().map(std::slice::from_ref)
    }

    fn pending(&self) -> Vec<String> {
        self.requests.pending()
    }

    async fn shutdown(self) {
        let Self {
            side,
            sinks,
            sources,
            requests,
            watcher,
            ..
        } = self;
        drop((watcher, requests));
        side.node.shutdown().await;
        drop((sinks, sources));
    }
}
