//! The port: connects the topics of a ROS 1 graph with the values of the space.
//!
//! A single task owns all state; [`Ros1Port::recv`](Port::recv) is its only wait.

mod actions;
mod awaited;
mod calls;
mod found;
mod opening;
mod reload;
mod strays;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::SystemTime;

use bridge_node::policy::{NO_SUBSCRIBER, Policy, Step, TYPE_CHANGES, Word, is_bad, type_changes};
use bridge_node::{
    Actions, Answered, AskId, AwaitedPeers, CallDescription, Calls, Delivery, Described, Executed,
    Executing, Execution, ExecutionId, Handover, Kept, Port, PortEvent, Reason, Services,
    TypePaths, timestamp,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId, Variable};
use messages::{ActionCalls, DefinitionError, MessageType, Selection, TextKind, TypeName};
use tcpros::{
    Graph, Inbox, InboxEvent, Latched, Message, Node, NodeError, NodeOptions, Peer, ServiceServer,
    SubscriberOptions, TopicType, Wanted,
};
use tracing::info;
use uadp::{BuiltinType, Timestamp};

use self::calls::Kinds;
use self::found::Refused;
use self::opening::{FLUSH, until};
use crate::definitions::Definitions;
use crate::ends::Ends;
use crate::services::{Executor, Ros1Graph};
use crate::sink::{Open, Opening, Sink};
use crate::source::{MAX_LATCHED, Met, Source};
use crate::watcher::{Seen, Watcher};

/// The options of a [`Ros1Port`].
#[derive(Debug, Clone)]
pub struct PortOptions {
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
    node: Node,
    policy: Policy,
    definitions: Definitions,
    watcher: Watcher,
    graph: Arc<Graph>,
    /// The number of comparisons since the last search for topics in the graph.
    unsearched: u32,
    /// The subscribed topics, identified by their index. The index of a removed topic is reused.
    sources: Vec<Source>,
    /// The indexes free for reuse.
    vacant: Vec<usize>,
    source_of: BTreeMap<String, usize>,
    inbox: Inbox<usize>,
    /// The published topics.
    sinks: HashMap<TopicId, Sink>,
    /// Services that are called for values.
    services: Services,
    /// Calls of other spaces, offered as services.
    calls: Calls<ServiceServer>,
    /// Whether this bridge is one of several redundant bridges of its space.
    is_redundant: bool,
    /// Services of the graph, executed for other spaces.
    executing: Executing<Executor>,
    /// Actions of other spaces, and action servers of the graph that are executed for other spaces.
    actions: Actions,
    /// The action clients and servers of `actions`.
    ends: Ends,
    /// The types of services with a name of the space.
    kinds: Kinds,
    /// The events that `recv` returns next; filled by a message or by a comparison with the graph.
    events: VecDeque<PortEvent>,
    /// The topic of the graph that was added last. The next search continues after it, so every
    /// topic gets its turn.
    taken_last: String,
    /// The address of this node as other nodes see it; `None` if it is a host name.
    address: Option<IpAddr>,
    master: String,
    /// True if the master responded to the last query.
    has_master: bool,
    /// Topics of the graph that were refused because of the limit, and the time of the last log
    /// message.
    refused: Refused,
    /// When to look at events that wait for subscribers to connect.
    flush_at: Option<tokio::time::Instant>,
    /// The values with such events.
    opening: BTreeSet<TopicId>,
}

impl Ros1Port {
    /// Starts the node, and subscribes and publishes the topics of the mapping. The master may
    /// become available later. Must be called inside a tokio runtime.
    ///
    /// # Errors
    /// [`NodeError`] if the node cannot be started or a name is invalid.
    pub fn start(options: PortOptions) -> Result<Self, NodeError> {
        let PortOptions {
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
        let mut definitions = Definitions::new(types, packages);
        let mut ends = Ends::default();
        let mut graph = Ros1Graph {
            node: &node,
            definitions: &mut definitions,
            ends: &mut ends,
        };
        let (services, bound) = Services::start(&mut graph, own, &mapping);
        let mut port = Self {
            watcher: Watcher::of(&node),
            node,
            policy: Policy::new(own, mapping),
            definitions,
            services,
            calls: Calls::default(),
            is_redundant: false,
            executing: Executing::default(),
            actions: Actions::default(),
            ends,
            kinds: Kinds::default(),
            graph: Arc::default(),
            unsearched: 0,
            sources: Vec::new(),
            vacant: Vec::new(),
            source_of: BTreeMap::new(),
            inbox: Inbox::new(),
            sinks: HashMap::new(),
            events: bound.into(),
            taken_last: String::new(),
            address,
            master,
            has_master: false,
            refused: Refused::default(),
            flush_at: None,
            opening: BTreeSet::new(),
        };
        port.take_bindings()?;
        let wanted = port.calls.ask_for_mapped(&port.policy);
        port.events.extend(wanted);
        Ok(port)
    }

    fn take_bindings(&mut self) -> Result<(), NodeError> {
        let mapping = Arc::clone(self.policy.mapping());
        for (variable, binding) in mapping.bindings(self.policy.own()) {
            let topic = variable.topic;
            if topic.space == self.policy.own() {
                let ros_topic = self.node.resolve(&binding.ros_topic)?;
                let index = self.source(ros_topic, Some(binding.message_type.clone()));
                if let Some(source) = self.sources.get_mut(index) {
                    source.values.push((topic, binding.selection.clone()));
                }
                self.subscribe(index)?;
            } else {
                self.take_up_sink(topic);
            }
        }
        Ok(())
    }

    /// Publishes the values of another space on the topic of the mapping.
    fn take_up_sink(&mut self, topic: TopicId) {
        let sink = Sink::new(self.policy.destination(topic));
        self.sinks.insert(topic, sink);
        self.open_sink(topic);
    }

    /// Returns the index of the source of the topic; creates the source if necessary.
    fn source(&mut self, ros_topic: String, expected: Option<TypeName>) -> usize {
        if let Some(index) = self.source_of.get(&ros_topic) {
            return *index;
        }
        let source = Source::new(ros_topic.clone(), expected, Vec::new());
        let index = match self.vacant.pop() {
            Some(index) if index < self.sources.len() => index,
            _ => {
                self.sources.push(Source::vacant());
                self.sources.len() - 1
            }
        };
        if let Some(place) = self.sources.get_mut(index) {
            *place = source;
        }
        self.source_of.insert(ros_topic, index);
        index
    }

    fn subscribe(&mut self, index: usize) -> Result<(), NodeError> {
        let Some(source) = self
            .sources
            .get_mut(index)
            .filter(|s| s.subscription.is_none())
        else {
            return Ok(());
        };
        // The subscription accepts any MD5 sum, so a publisher of another type connects and is
        // logged with the expected type, instead of refusing the connection.
        let wanted = Wanted {
            type_name: source.expected.as_ref().map(ToString::to_string),
            md5sum: None,
        };
        let options = SubscriberOptions::default();
        let subscription =
            self.node
                .subscribe(&source.ros_topic, wanted, options, index, &self.inbox)?;
        source.subscription = Some(subscription);
        Ok(())
    }

    fn taken(&mut self, index: usize, event: InboxEvent) {
        match event {
            InboxEvent::Message(message) => self.message(index, message),
            InboxEvent::Peer {
                connected: true,
                peer,
                ..
            } => {
                self.meet(index, &peer);
            }
            InboxEvent::Peer {
                connected: false,
                peer,
                publishers,
            } => {
                self.with_live(index, |source| source.part(&peer, publishers));
            }
            InboxEvent::Dropped(count) => {
                self.lost(index, (Reason::Overflow, "read too slowly"), count);
            }
        }
    }

    fn message(&mut self, index: usize, message: Message) {
        let Message {
            bytes,
            peer,
            received,
        } = message;
        let known = self
            .sources
            .get(index)
            .and_then(|source| source.knows(&peer));
        if !known.unwrap_or_else(|| self.meet(index, &peer)) {
            self.lost(index, (Reason::Mismatch, "publisher of another type"), 1);
            return;
        }
        let received = timestamp(received);
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        if let Some(publisher) = source.make_room(&peer) {
            self.events
                .extend(source.values.iter().map(|(topic, _)| PortEvent::Left {
                    topic: *topic,
                    publisher,
                }));
        }
        let latched_by = source.latched_by(&peer, &bytes);
        let unlatched = peer.header.latching() && latched_by.is_none();
        let ros_topic = unlatched.then(|| source.ros_topic.clone());
        for (topic, _) in &source.values {
            let payload = bytes.clone();
            self.events.push_back(PortEvent::Sample {
                topic: *topic,
                payload,
                received,
                latched_by,
            });
        }
        if let Some(ros_topic) = ros_topic {
            self.policy.told.once(&ros_topic, "too many latched", || {
                format!(
                    "more than {MAX_LATCHED} latched publishers are connected: late subscribers do not \
                     receive the last message of {}",
                    peer.caller_id
                )
            });
        }
    }

    /// Adds a publisher. Returns true if its messages can be read.
    fn meet(&mut self, index: usize, peer: &Arc<Peer>) -> bool {
        let Some(source) = self
            .sources
            .get(index)
            .filter(|source| source.knows(peer).is_none())
        else {
            return false;
        };
        let (ros_topic, mapped) = (source.ros_topic.clone(), !source.found);
        let found = self.definitions.of_publisher(&peer.header, mapped);
        if let Err(error) = &found {
            self.policy.told.once(&ros_topic, "unreadable type", || {
                format!("messages of {} are dropped: {error}", peer.caller_id)
            });
        }
        let mut met = Met::Stranger;
        // The type is reported first, so the Router knows it when the topic becomes live.
        let was_live = self.sources.get(index).is_some_and(Source::is_live);
        let understood = found.is_ok();
        if let Some(source) = self.sources.get_mut(index) {
            met = source.meet(peer, found.ok());
        }
        match met {
            Met::Known => {}
            Met::Bound(message_type) => self.bound(index, &message_type),
            Met::Stranger => {
                if understood {
                    self.tell_stranger(index, peer);
                }
                return false;
            }
        }
        self.report_live(index, was_live);
        true
    }

    fn bound(&mut self, index: usize, message_type: &Arc<MessageType>) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        for (topic, selection) in &source.values {
            self.events.push_back(PortEvent::Bound {
                topic: *topic,
                message_type: Arc::clone(message_type),
                selection: selection.clone(),
            });
        }
    }

    fn tell_stranger(&mut self, index: usize, peer: &Peer) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let ros_topic = source.ros_topic.clone();
        let bound = source.bound.as_deref();
        let ours = source
            .expected
            .as_ref()
            .or_else(|| bound.map(MessageType::name));
        let ours = ours.map(ToString::to_string);
        let bound = bound.map(|bound| bound.md5().to_owned());
        self.policy
            .told
            .once(&ros_topic, "publisher of another type", || {
                let theirs = (peer.header.type_name(), peer.header.md5sum());
                stranger(&peer.caller_id, theirs, (ours.as_deref(), bound.as_deref()))
            });
    }

    /// Changes a source and reports if it becomes live or is no longer live.
    fn with_live(&mut self, index: usize, change: impl FnOnce(&mut Source)) {
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let before = source.is_live();
        change(source);
        self.report_live(index, before);
    }

    fn report_live(&mut self, index: usize, before: bool) {
        let Some(source) = self.sources.get(index).filter(|s| s.is_live() != before) else {
            return;
        };
        let live = source.is_live();
        let values = source.values.iter();
        self.events.extend(values.map(|(topic, _)| PortEvent::Live {
            topic: *topic,
            live,
        }));
    }

    fn lost(&mut self, index: usize, (reason, why): (Reason, &'static str), count: u64) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        for (topic, _) in &source.values {
            self.events.push_back(PortEvent::Lost {
                topic: Some(*topic),
                reason,
                why,
                count,
            });
        }
    }

    /// Compares the graph with the open topics. `None` stands for an unavailable master; then the
    /// topics stay unchanged.
    fn look(&mut self, graph: Option<Arc<Graph>>) {
        self.has_master = graph.is_some();
        if let Some(graph) = graph {
            // An unchanged graph is searched too, but less often: a subscription may be lost, and a
            // topic that the limit refused may find room.
            let unchanged = Arc::ptr_eq(&self.graph, &graph);
            self.graph = graph;
            for source in &mut self.sources {
                source.looked_at();
            }
            self.unsearched += 1;
            if !unchanged || self.unsearched >= SEARCH {
                self.unsearched = 0;
                self.find_sources();
            }
            self.find_services();
            self.find_actions();
            self.offer_calls();
            self.offer_actions();
            self.tell_refused();
        }
        for source in &mut self.sources {
            let named = self.graph.publishers.get(&source.ros_topic);
            for publisher in source.gone_for_good(named.map_or(&[], Vec::as_slice)) {
                let values = source.values.iter();
                self.events.extend(values.map(|(topic, _)| PortEvent::Left {
                    topic: *topic,
                    publisher,
                }));
            }
        }
        let now = bridge_node::now().monotonic;
        self.calls.tidy(now);
        self.actions.tidy(&self.policy, now);
        let topics: Vec<TopicId> = self.sinks.keys().copied().collect();
        for topic in topics {
            self.reconcile_sink(topic);
        }
    }

    fn reconcile_sink(&mut self, topic: TopicId) {
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        if let Some(open) = &mut sink.open {
            let count = open.publisher.dropped().saturating_sub(open.reported);
            if count > 0 {
                open.reported += count;
                let why = "subscriber too slow or late";
                self.events.push_back(PortEvent::Lost {
                    topic: Some(topic),
                    reason: Reason::Overflow,
                    why,
                    count,
                });
            }
        }
        if !sink.serves() {
            self.open_sink(topic);
        }
    }

    /// Opens a sink with the best available type. A sink that is open with another type is
    /// reopened.
    fn open_sink(&mut self, topic: TopicId) {
        let Some(sink) = self.sinks.get(&topic) else {
            return;
        };
        let ros_topic = sink.ros_topic.clone();
        // Once the topic is published by this node, the master returns the type of this node.
        let subscribed = sink.open.is_none() && self.graph.subscribers.contains_key(&ros_topic);
        let asked_for = self.graph.types.get(&ros_topic).filter(|_| subscribed);
        let mut found = None;
        for name in sink.candidates(asked_for.map(String::as_str)) {
            match self.definitions.get(&name) {
                Ok(message_type) => {
                    found = Some(message_type);
                    break;
                }
                Err(error) => self.tell_unknown(
                    &ros_topic,
                    "the requested type cannot hold the value",
                    &error,
                ),
            }
        }
        let Some(message_type) = found else { return };
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        let open_as = sink.open.as_ref().map(|open| open.message_type.name());
        if open_as == Some(message_type.name()) {
            return;
        }
        // The node publishes a topic with a single type.
        sink.open = None;
        let topic_type = TopicType {
            name: message_type.name().to_string(),
            md5sum: message_type.md5().to_owned(),
            definition: message_type.definition().to_owned(),
        };
        match self.node.advertise(&ros_topic, topic_type, sink.options()) {
            Ok(publisher) => {
                info!(
                    topic = publisher.topic(),
                    message_type = %message_type.name(),
                    definition = self.definitions.source(message_type.name()),
                    "advertised"
                );
                let open = Open {
                    message_type: Arc::clone(&message_type),
                    publisher,
                    reported: 0,
                    reached: false,
                    stamps: sink.choice.stamps(&message_type),
                    opening: Opening::of(
                        self.graph.subscribers.get(&ros_topic),
                        self.node.name(),
                        bridge_node::now().monotonic,
                    ),
                };
                sink.open = Some(open);
                let selection = sink.choice.selection(message_type.name());
                self.events.push_back(PortEvent::Bound {
                    topic,
                    message_type,
                    selection,
                });
            }
            Err(error) => {
                self.policy
                    .told
                    .once(&ros_topic, "not published", || error.to_string());
            }
        }
    }

    /// Returns the local type that a writer announces for its value, if the type is known and has
    /// the announced fields.
    fn learned(&mut self, topic: TopicId, described: &Described) -> Option<(TypeName, Selection)> {
        if ActionCalls::is_value(&described.message_type) {
            // Values of actions are handled by the action server.
            return None;
        }
        match self.definitions.get(&described.message_type) {
            Ok(message_type) => self.policy.learned(topic, described, &message_type),
            Err(error) => {
                let said = "the type that the writer announces cannot be used";
                self.tell_unknown(&topic.to_string(), said, &error);
                None
            }
        }
    }

    /// Logs once per topic that a type is unknown.
    fn tell_unknown(&mut self, topic: &str, what: &str, error: &DefinitionError) {
        let definitions = &mut self.definitions;
        self.policy.told.once(topic, "unknown type", || {
            format!("{what}: {}", definitions.explain(TextKind::Message, error))
        });
    }
}

/// Returns the reason for dropping the messages of a publisher with another type or definition than
/// the topic. The MD5 sums distinguish two definitions of the same name.
fn stranger(
    caller: &str,
    (theirs, sum): (Option<&str>, Option<&str>),
    (ours, bound): (Option<&str>, Option<&str>),
) -> String {
    let (theirs, sum) = (theirs.unwrap_or("?"), sum.unwrap_or("none"));
    match (ours, bound) {
        (Some(name), Some(md5)) if name == theirs => format!(
            "messages of {caller} are dropped: its definition of {theirs} has the MD5 sum {sum}, but the \
             topic uses the definition with the MD5 sum {md5}; build both sides from the same definition"
        ),
        (Some(name), _) if name == theirs => format!(
            "messages of {caller} are dropped: its definition of {theirs} (MD5 sum {sum}) differs from the \
             definition of the topic"
        ),
        (ours, _) => format!(
            "messages of {caller} are dropped: it publishes {theirs}, but the topic uses {}",
            ours.unwrap_or("another type"),
        ),
    }
}

/// The number of comparisons with an unchanged graph until it is searched again.
const SEARCH: u32 = 4;

impl Port for Ros1Port {
    async fn recv(&mut self) -> PortEvent {
        loop {
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            // All branches are cancel-safe. The graph comes before samples, so a flood of samples
            // does not delay new topics.
            let flush_at = self.flush_at;
            tokio::select! {
                biased;
                () = until(flush_at) => self.flush(),
                seen = self.watcher.recv() => match seen {
                    Seen::Graph(graph) => self.look(graph),
                    Seen::Ended(reason) => {
                        let name = self.node.name();
                        return PortEvent::Ended(format!("the ROS master or another node shut down the ROS 1 node \
                                                         {name}: {reason}"));
                    }
                },
                outcome = self.services.recv() => {
                    let events = self.services.ended(outcome, timestamp(utc()));
                    self.events.extend(events);
                }
                event = self.calls.recv::<Ros1Graph<'_>>() => return event,
                events = self.executing.recv() => self.events.extend(events),
                events = self.actions.recv() => self.events.extend(events),
                () = self.kinds.recv() => self.find_services(),
                (index, event) = self.inbox.recv() => self.taken(index, event),
            }
        }
    }

    fn publish(&mut self, sample: Delivery) -> Result<(), &'static str> {
        if type_changes(&self.events, sample.topic) {
            return Err(TYPE_CHANGES);
        }
        if is_bad(sample.status) {
            return Err("bad status");
        }
        if self.actions.takes(&self.policy, sample.topic) {
            return self.actions.publish(&sample);
        }
        // A repeated value is for late joiners, and a service is not a late joiner.
        let again = sample.kept == Kept::Again;
        if again && self.services.takes(sample.topic) {
            return Ok(());
        }
        if let Some(replaced) = self.services.hand_over(sample.topic, &sample.payload) {
            if replaced > 0 {
                self.events.push_back(PortEvent::Lost {
                    topic: Some(sample.topic),
                    reason: Reason::Overflow,
                    why: "service too slow",
                    count: replaced,
                });
            }
            return Ok(());
        }
        let variable = self.policy.mapping().variable(sample.topic);
        let is_confirmed = variable.is_some_and(|variable| variable.confirmed_within.is_some());
        let Some(Sink {
            open: Some(open), ..
        }) = self.sinks.get_mut(&sample.topic)
        else {
            return Err("no publisher yet");
        };
        let payload = open.stamped(sample.payload, self.node.now());
        let key = sample.instance.map_or(0, latch_key);
        let mut lost = match sample.lasting {
            // Before the topic is latched: late subscribers get no events.
            true => open.end_opening(),
            false => 0,
        };
        open.publisher.set_latching(sample.lasting);
        let latched = match sample.kept {
            Kept::Alone => Latched::Alone(key),
            Kept::Beside => Latched::Beside(key),
            Kept::Again => {
                open.publisher.latch(key, payload);
                return Ok(());
            }
        };
        // Losses of slow subscribers are reported with the next comparison with the graph.
        let event = (payload, latched);
        if sample.lasting || is_confirmed {
            // The router hands a command over again until a subscriber has it.
            lost += open.end_opening();
            let (payload, latched) = event;
            let published = open.publisher.publish_latched(payload, latched);
            open.reached = published.sent_to > 0;
        } else {
            lost += open.publish_once(event, bridge_node::now().monotonic);
            open.reached = lost == 0 && open.opening.is_none();
        }
        let is_waiting = open.opening.as_ref().is_some_and(|of| !of.is_empty());
        if is_waiting {
            self.opening.insert(sample.topic);
            self.flush_at
                .get_or_insert_with(|| tokio::time::Instant::now() + FLUSH);
        }
        if lost > 1 {
            self.unheard(sample.topic, lost - 1);
        }
        match lost {
            0 => Ok(()),
            _ => Err(NO_SUBSCRIBER),
        }
    }

    fn handover(&self, topic: TopicId) -> Handover {
        let sink = self.sinks.get(&topic).and_then(|sink| sink.open.as_ref());
        let reached = || match sink {
            Some(open) if open.reached => Handover::Done,
            Some(_) | None => Handover::Nobody,
        };
        self.services.handover(topic).unwrap_or_else(reached)
    }

    fn wanted(
        &mut self,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&Described>,
    ) {
        let for_service = |variable: &Variable| variable.service.is_some();
        if topic.space == self.policy.own()
            || self
                .policy
                .mapping()
                .variable(topic)
                .is_some_and(for_service)
        {
            return;
        }
        if self.actions.takes(&self.policy, topic) {
            return;
        }
        if !self.take_in(topic) {
            return;
        }
        let standard = match shape {
            [(builtin, array)] => self.definitions.standard_type(*builtin, *array),
            _ => None,
        };
        let word = Word {
            described: described.cloned(),
            learned: described.and_then(|described| self.learned(topic, described)),
            standard,
        };
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        let open = sink.open.as_ref();
        let written = open.map(|open| (open.message_type.name(), open.publisher.subscribers() > 0));
        match sink.choice.hear(word, written) {
            Step::Stay => {}
            Step::Open => self.open_sink(topic),
            Step::Select(selection) => {
                let Some(open) = &mut sink.open else { return };
                open.stamps = sink.choice.stamps(&open.message_type);
                self.events.push_back(PortEvent::Bound {
                    topic,
                    message_type: Arc::clone(&open.message_type),
                    selection,
                });
            }
        }
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        tracing::debug!(%topic, silent, "the writer in the space");
        if let Some(sink) = self.sinks.get_mut(&topic) {
            // Subscribers keep the value, and new subscribers do not receive it.
            if let Some(open) = sink.open.as_ref().filter(|_| silent) {
                open.publisher.forget_all_latched();
            }
            sink.silent = silent.then(|| bridge_node::now().monotonic);
        }
    }

    fn retired(&mut self, topic: TopicId, instance: Timestamp) {
        if let Some(Sink {
            open: Some(open), ..
        }) = self.sinks.get(&topic)
        {
            open.publisher.forget_latched(latch_key(instance));
        }
    }

    fn drop_waiting(&mut self, _at_once: bool) {
        self.drop_opening();
        for open in self.sinks.values().filter_map(|sink| sink.open.as_ref()) {
            open.publisher.forget_all_latched();
        }
    }

    fn role_changed(&mut self, _is_active: bool) {
        self.is_redundant = true;
    }

    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.calls.known(topic, Arc::clone(description));
        self.actions.known(topic, description);
        self.offer_calls();
        self.offer_actions();
    }

    fn call_gone(&mut self, topic: TopicId) {
        let now = bridge_node::now().monotonic;
        self.calls.gone(topic, now);
        self.actions.gone(topic, now);
    }

    fn answered(&mut self, ask: AskId, _: TopicId, answer: Answered<Bytes>) {
        self.calls.answered(ask, answer);
    }

    fn execute(&mut self, execution: Execution) -> bool {
        let id = execution.id;
        let executed = if self.actions.serves(execution.topic) {
            self.actions.execute(execution)
        } else {
            self.executing.execute(execution)
        };
        if let Err(refusal) = executed {
            let outcome = Executed::Refused(refusal);
            let execution = id;
            let event = PortEvent::Executed { execution, outcome };
            self.events.push_back(event);
        }
        true
    }

    fn abandoned(&mut self, execution: ExecutionId, topic: TopicId) {
        if self.actions.serves(topic) {
            self.actions.abandoned(execution);
        }
    }

    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String> {
        self.go_over_to(mapping, types);
        Vec::new()
    }

    fn hindrance(&self) -> Option<String> {
        (!self.has_master).then(|| format!("no ROS master responds at {}", self.master))
    }

    fn add_awaited(&self, missing: &mut AwaitedPeers) {
        self.add_missing(missing);
    }

    fn addresses(&self) -> Option<&[IpAddr]> {
        // Connections break if this address is removed, and the master has announced it to all
        // nodes.
        self.address.as_ref().map(std::slice::from_ref)
    }

    fn pending(&self) -> Vec<String> {
        self.actions.pending()
    }

    async fn shutdown(self) {
        let Self {
            node,
            sinks,
            sources,
            watcher,
            services,
            calls,
            executing,
            actions,
            kinds,
            ..
        } = self;
        drop((watcher, services, calls, executing, actions, kinds));
        node.shutdown().await;
        drop((sinks, sources));
    }
}

/// Returns the time at which a service response arrived.
#[expect(
    clippy::disallowed_methods,
    reason = "the stamp of an answer is taken where it is handed on"
)]
fn utc() -> SystemTime {
    SystemTime::now()
}

/// Returns the key of a latched value: the time at which the value was taken, which also orders the
/// values.
fn latch_key(instance: Timestamp) -> u64 {
    u64::try_from(instance.unix_nanos()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::stranger;

    #[test]
    fn two_definitions_of_one_name_are_named_with_their_checksums() {
        let theirs = (Some("arm_msgs/Joint"), Some("aaaa"));
        let told = stranger("/arm", theirs, (Some("arm_msgs/Joint"), Some("bbbb")));
        assert!(told.contains("aaaa") && told.contains("bbbb"), "{told}");
        let told = stranger("/arm", theirs, (Some("arm_msgs/Joint"), None));
        assert!(
            told.contains("aaaa") && told.contains("differs from the definition of the topic"),
            "{told}"
        );
        let told = stranger("/arm", theirs, (Some("arm_msgs/Other"), Some("bbbb")));
        assert!(
            told.ends_with("it publishes arm_msgs/Joint, but the topic uses arm_msgs/Other"),
            "{told}"
        );
    }
}
