//! The port: the topics of a DDS domain tied to the values of the space.
//!
//! One task owns everything; [`Ros2Port::recv`](Port::recv) is its only wait. Endpoints are made in
//! [`reconcile`](Ros2Port::reconcile), which compares what the domain holds with what is open: every 200 ms, and soon
//! after RustDDS reports a change.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::future::poll_fn;
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use bridge_node::{Delivery, Port, PortEvent, now};
use futures_util::StreamExt;
use mappings::{Mapping, SpaceId, TopicId};
use messages::{MessageType, Selection, TypeName};
use rustdds::{DomainParticipantStatusEvent, DomainParticipantStatusListener, StatusEvented};
use tokio::time::{Instant, Sleep};
use tracing::{debug, info, warn};
use uadp::BuiltinType;

use crate::definitions::Definitions;
use crate::domain::{Domain, DomainError, DomainOptions};
use crate::graph::{Endpoint, Graph, dds_topic, ros_topic};
use crate::inbox::{Inbox, Taken};
use crate::outlet::{Outlet, Refusal};
use crate::qos::Requested;
use crate::raw::{Payload, Reader};
use crate::sink::{Open, Sink};
use crate::source::{Reading, Source, same_participant};

/// What a [`Ros2Port`] is started with.
#[derive(Debug, Clone)]
pub struct PortOptions {
    /// The domain to join.
    pub domain: DomainOptions,
    /// The space whose values are produced there.
    pub own: SpaceId,
    /// The cell.
    pub mapping: Arc<Mapping>,
    /// Where to look for message definitions that are not built in, as `AMENT_PREFIX_PATH` lists.
    pub prefixes: Vec<PathBuf>,
}

/// The ROS 2 side of a bridge.
pub struct Ros2Port {
    domain: Domain,
    discovery: DomainParticipantStatusListener,
    own: SpaceId,
    mapping: Arc<Mapping>,
    definitions: Definitions,
    graph: Graph,
    /// Topics we read; a source never goes away, so that its index names it.
    sources: Vec<Source>,
    source_of: BTreeMap<String, usize>,
    inbox: Inbox<usize>,
    /// Topics we write.
    sinks: HashMap<TopicId, Sink>,
    /// Readers that were replaced; they hear on until their successor is matched.
    retired: VecDeque<(Instant, Reader)>,
    /// What `recv` hands out next; filled only while it is empty, or by one pass over the topics.
    events: VecDeque<PortEvent>,
    /// Endpoints that may still be made before the next [`reconcile`](Self::reconcile).
    budget: usize,
    /// What was already told, so that it is told once.
    told: BTreeSet<(String, &'static str)>,
    schedule: Schedule,
}

/// When to look again.
struct Schedule {
    timer: Pin<Box<Sleep>>,
    reconciled: Instant,
    /// Something changed: reconcile soon.
    changed: bool,
    /// Endpoints are left to be made.
    unfinished: bool,
    /// Samples wait in an outlet.
    waiting: bool,
}

impl Ros2Port {
    /// Joins the domain and prepares the endpoints the mapping names.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn start(options: PortOptions) -> Result<Self, DomainError> {
        let PortOptions {
            domain: domain_options,
            own,
            mapping,
            prefixes,
        } = options;
        let domain = Domain::join(&domain_options)?;
        info!(
            domain = domain_options.domain,
            space = %own,
            node = domain.node_name(),
            networks = ?domain_options.networks,
            "joined the DDS domain"
        );
        let mut port = Self {
            discovery: domain.status_listener(),
            domain,
            own,
            mapping: Arc::clone(&mapping),
            definitions: Definitions::new(prefixes),
            graph: Graph::default(),
            sources: Vec::new(),
            source_of: BTreeMap::new(),
            inbox: Inbox::new(),
            sinks: HashMap::new(),
            retired: VecDeque::new(),
            events: VecDeque::new(),
            budget: MAX_BATCH,
            told: BTreeSet::new(),
            schedule: Schedule::new(),
        };
        port.take_bindings(&mapping);
        Ok(port)
    }

    fn take_bindings(&mut self, mapping: &Mapping) {
        for (variable, binding) in mapping.bindings(self.own) {
            let selection = binding.selection.clone();
            if variable.topic.space == self.own {
                let name = binding.message_type.clone();
                let index = self.source(dds_topic(&binding.ros_topic), name);
                if let Some(source) = self.sources.get_mut(index) {
                    source.values.push((variable.topic, selection));
                }
            } else {
                let name = binding.message_type.clone();
                let sink = Sink::mapped(&binding.ros_topic, name, selection, variable.overflow);
                self.sinks.insert(variable.topic, sink);
            }
        }
    }

    /// The index of the source of that topic, made when there is none.
    fn source(&mut self, dds_topic: String, message_type: TypeName) -> usize {
        let next = self.sources.len();
        let index = *self.source_of.entry(dds_topic.clone()).or_insert(next);
        if index == next {
            self.sources.push(Source::new(dds_topic, message_type));
        }
        index
    }

    fn poll_event(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Poll::Ready(event);
            }
            // Before the samples, so that a flood of them does not keep new topics out.
            if self.schedule.is_due(cx) {
                self.look_again();
                continue;
            }
            match self.inbox.poll_recv(cx) {
                Poll::Ready(taken) => self.taken(taken),
                Poll::Pending if self.noticed_change(cx) => {}
                Poll::Pending => return Poll::Pending,
            }
        }
    }

    /// Whether discovery reported a change that is not scheduled for a look yet.
    fn noticed_change(&mut self, cx: &mut Context<'_>) -> bool {
        let before = self.schedule.changed;
        let mut events = self.discovery.as_async_status_stream();
        while let Poll::Ready(Some(event)) = events.poll_next_unpin(cx) {
            self.schedule.changed |= is_change(&event);
        }
        self.schedule.changed && !before
    }

    fn taken(&mut self, taken: Taken<usize>) {
        match taken {
            Taken::Sample {
                key,
                payload,
                writer,
                missing,
            } => {
                let Some(source) = self.sources.get(key) else {
                    return;
                };
                // Our own publication, which RustDDS hands to our own reader as well.
                if same_participant(writer, self.domain.participant()) {
                    return;
                }
                let received = now().utc;
                let stranger = source.strangers.contains(&writer);
                let payload = payload.into_bytes();
                for (topic, _) in &source.values {
                    let topic = *topic;
                    if missing > 0 {
                        self.events
                            .push_back(lost(topic, "lost before they were read", missing));
                    }
                    self.events.push_back(if stranger {
                        lost(topic, "publisher of another type", 1)
                    } else {
                        PortEvent::Sample {
                            topic,
                            payload: payload.clone(),
                            received,
                        }
                    });
                }
            }
            Taken::Unreadable { key, why } => {
                let Some(source) = self.sources.get(key) else {
                    return;
                };
                debug!(topic = source.dds_topic, why, "unreadable sample");
                for (topic, _) in &source.values {
                    self.events
                        .push_back(lost(*topic, "unreadable encoding", 1));
                }
            }
        }
    }

    /// The timer rang: send what waits, and compare the domain with what is open.
    fn look_again(&mut self) {
        let now = Instant::now();
        if self.schedule.waiting {
            self.flush(now);
        }
        if now >= self.schedule.next_reconcile() {
            self.reconcile(now);
        }
        self.schedule.arm(now);
    }

    fn flush(&mut self, now: Instant) {
        let mut waiting = false;
        for (topic, sink) in &mut self.sinks {
            let Some(open) = &mut sink.open else { continue };
            if let Err(refusal) = open.outlet.flush(now) {
                self.events.push_back(lost(*topic, refusal.label(), 1));
            }
            waiting |= open.outlet.is_waiting();
        }
        self.schedule.waiting = waiting;
    }

    /// Makes what is open fit what the domain holds, at most [`MAX_BATCH`] endpoints at a time: RustDDS' discovery
    /// takes commands from a bounded queue and drops what does not fit.
    fn reconcile(&mut self, now: Instant) {
        self.schedule.reconciled = now;
        self.schedule.changed = false;
        self.schedule.unfinished = false;
        self.budget = MAX_BATCH;
        while self.retired.front().is_some_and(|(until, _)| *until <= now) {
            self.retired.pop_front();
        }
        self.graph = Graph::snapshot(self.domain.participant());
        self.find_topics_of_the_space();
        for index in 0..self.sources.len() {
            self.reconcile_source(index, now);
        }
        let topics: Vec<TopicId> = self.sinks.keys().copied().collect();
        for topic in topics {
            self.reconcile_sink(topic, now);
        }
    }

    /// Zero configuration: a topic named in our part of the space crosses as soon as somebody writes it.
    fn find_topics_of_the_space(&mut self) {
        let found: Vec<(String, TopicId)> = self
            .graph
            .written_topics()
            .filter(|topic| !self.source_of.contains_key(*topic))
            .filter_map(|topic| Some((topic.to_owned(), ros_topic(topic)?.parse().ok()?)))
            .filter(|(_, topic): &(_, TopicId)| topic.space == self.own)
            .collect();
        for (dds_topic, topic) in found {
            if self.is_tied(topic) {
                self.tell_once(&dds_topic, "tied elsewhere", || {
                    format!("{topic} comes from another ROS topic, as the mapping says; this one is left alone")
                });
                continue;
            }
            if self.sources.len() >= MAX_TOPICS {
                self.tell_once("", "too many topics", || {
                    format!("more than {MAX_TOPICS} topics of the space: the rest is left alone")
                });
                return;
            }
            let types: Vec<String> = self
                .graph
                .writers(&dds_topic)
                .iter()
                .map(|writer| writer.type_name.clone())
                .collect();
            let known = types
                .iter()
                .find_map(|name| self.message_type(topic, &dds_topic, name));
            if let Some(message_type) = known {
                let index = self.source(dds_topic, message_type.name().clone());
                if let Some(source) = self.sources.get_mut(index) {
                    source.values.push((topic, Selection::Whole));
                }
            }
        }
    }

    /// Whether the mapping gives this value to another ROS topic of our domain.
    fn is_tied(&self, topic: TopicId) -> bool {
        self.mapping
            .variable(topic)
            .is_some_and(|variable| variable.binding(self.own).is_some())
    }

    /// The type a peer names, or `None` after saying once why it cannot be used.
    fn message_type(
        &mut self,
        topic: TopicId,
        dds_topic: &str,
        dds_type: &str,
    ) -> Option<Arc<MessageType>> {
        let found = match TypeName::from_dds(dds_type) {
            Ok(name) => self
                .definitions
                .get(&name)
                .map_err(|error| error.to_string()),
            Err(error) => Err(error.to_string()),
        };
        match found {
            Ok(message_type) => Some(message_type),
            Err(error) => {
                let first = self.tell_once(dds_topic, "unknown type", || {
                    format!(
                        "the topic cannot cross: {error}. Start the bridge where the ROS workspace that defines it \
                         is sourced (AMENT_PREFIX_PATH), or map the topic to a known type"
                    )
                });
                if first {
                    self.events
                        .push_back(lost(topic, "type without a definition", 1));
                }
                None
            }
        }
    }

    fn reconcile_source(&mut self, index: usize, now: Instant) {
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let writers = self.graph.writers(&source.dds_topic);
        let ours = source.meet(writers);
        let strange = writers
            .iter()
            .find(|writer| !ours.contains(writer))
            .cloned();
        let requested = Requested::from_writers(&ours);
        match source.reading {
            Reading::Pending => self.open_source(index, requested),
            Reading::Open {
                requested: before, ..
            } if before != requested && !ours.is_empty() => {
                self.reopen_source(index, requested, now);
            }
            Reading::Open { slot, .. } => self
                .inbox
                .retain_writers(slot, |writer| writers.iter().any(|w| w.guid == *writer)),
        }
        self.set_live(index, !ours.is_empty());
        if let Some(stranger) = strange {
            self.tell_stranger(index, &stranger);
        }
    }

    fn open_source(&mut self, index: usize, requested: Requested) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.clone());
        let message_type = match self.definitions.get(&name) {
            Ok(message_type) => message_type,
            Err(error) => {
                self.tell_once(&topic, "unknown type", || {
                    format!("the topic cannot cross: {error}")
                });
                return;
            }
        };
        let Some(reader) = self.make(|domain| domain.reader(&topic, &name.dds(), requested)) else {
            return;
        };
        let slot = self.inbox.insert(index, reader);
        if let Some(source) = self.sources.get_mut(index) {
            source.reading = Reading::Open { slot, requested };
            info!(topic, message_type = %name, ?requested, "subscribed");
            for (topic, selection) in &source.values {
                self.events.push_back(PortEvent::Bound {
                    topic: *topic,
                    message_type: Arc::clone(&message_type),
                    selection: selection.clone(),
                });
            }
        }
    }

    /// Another QoS needs another reader. The one before stays for a while: it fills the cache both share, until the
    /// writers have matched the new one.
    fn reopen_source(&mut self, index: usize, requested: Requested, now: Instant) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let Reading::Open { slot, .. } = source.reading else {
            return;
        };
        let (topic, dds_type) = (source.dds_topic.clone(), source.message_type.dds());
        let Some(reader) = self.make(|domain| domain.reader(&topic, &dds_type, requested)) else {
            return;
        };
        if let Some(before) = self.inbox.replace(slot, reader) {
            self.retired.push_back((now + RETIRE_AFTER, before));
        }
        if let Some(source) = self.sources.get_mut(index) {
            source.reading = Reading::Open { slot, requested };
            debug!(
                topic,
                ?requested,
                "subscribed anew, as its publishers changed"
            );
        }
    }

    fn set_live(&mut self, index: usize, live: bool) {
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        if source.live == live || source.reading == Reading::Pending {
            return;
        }
        source.live = live;
        for (topic, _) in &source.values {
            self.events.push_back(PortEvent::Live {
                topic: *topic,
                live,
            });
        }
    }

    fn tell_stranger(&mut self, index: usize, stranger: &Endpoint) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let (topic, name) = (source.dds_topic.clone(), source.message_type.to_string());
        self.tell_once(&topic, "publisher of another type", || {
            format!(
                "a publisher has type {}, but the topic crosses as {name}: its messages are dropped",
                stranger.type_name
            )
        });
    }

    fn reconcile_sink(&mut self, topic: TopicId, now: Instant) {
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        let readers = self.graph.readers(&sink.dds_topic);
        if let Some(open) = &mut sink.open {
            match open.outlet.set_readers(readers, now) {
                Ok(()) => {}
                Err(refusal) => self.events.push_back(lost(topic, refusal.label(), 1)),
            }
            self.schedule.waiting |= open.outlet.is_waiting();
        }
        if !sink.serves(readers) {
            self.open_sink(topic);
        }
    }

    /// Opens a sink in the best type there is; one that is open in a lesser type is opened anew.
    fn open_sink(&mut self, topic: TopicId) {
        let Some(sink) = self.sinks.get(&topic) else {
            return;
        };
        let (dds_topic, offered, selection) =
            (sink.dds_topic.clone(), sink.offered, sink.selection());
        let mut found = None;
        for name in sink.candidates(self.graph.readers(&sink.dds_topic)) {
            match self.definitions.get(&name) {
                Ok(message_type) => {
                    found = Some(message_type);
                    break;
                }
                Err(error) => {
                    self.tell_once(&dds_topic, "unknown type", || {
                        format!("no value can be written in the type asked for: {error}")
                    });
                }
            }
        }
        let Some(message_type) = found else { return };
        let dds_type = message_type.name().dds();
        if self.is_open_as(topic, &message_type) {
            self.tell_once(&dds_topic, "subscriber of another type", || {
                format!("a subscriber asks for another type than {dds_type}, in which the topic is written")
            });
            return;
        }
        let Some(writer) = self.make(|domain| domain.writer(&dds_topic, &dds_type, offered)) else {
            return;
        };
        info!(topic = dds_topic, message_type = %message_type.name(), ?offered, "advertised");
        let mut outlet = Outlet::new(writer, offered);
        if let Err(refusal) = outlet.set_readers(self.graph.readers(&dds_topic), Instant::now()) {
            self.events.push_back(lost(topic, refusal.label(), 1));
        }
        if let Some(sink) = self.sinks.get_mut(&topic) {
            sink.open = Some(Open {
                message_type: Arc::clone(&message_type),
                outlet,
            });
        }
        self.events.push_back(PortEvent::Bound {
            topic,
            message_type,
            selection,
        });
    }

    fn is_open_as(&self, topic: TopicId, message_type: &MessageType) -> bool {
        self.sinks
            .get(&topic)
            .and_then(|sink| sink.open.as_ref())
            .is_some_and(|open| open.message_type.name() == message_type.name())
    }

    /// Makes an endpoint if the budget allows; `None` when it does not, or when RustDDS fails, which is told once.
    fn make<E>(&mut self, make: impl FnOnce(&Domain) -> Result<E, DomainError>) -> Option<E> {
        let Some(left) = self.budget.checked_sub(1) else {
            self.schedule.unfinished = true;
            return None;
        };
        self.budget = left;
        match make(&self.domain) {
            Ok(endpoint) => Some(endpoint),
            Err(error) => {
                let text = error.to_string();
                self.tell_once(&text, "endpoint", || text.clone());
                None
            }
        }
    }

    /// Logs something about a topic the first time it happens; says whether it was.
    fn tell_once(
        &mut self,
        topic: &str,
        what: &'static str,
        message: impl FnOnce() -> String,
    ) -> bool {
        if self.told.len() >= MAX_TOLD || !self.told.insert((topic.to_owned(), what)) {
            return false;
        }
        warn!(topic, "{}", message());
        true
    }
}

impl Port for Ros2Port {
    async fn recv(&mut self) -> PortEvent {
        poll_fn(|cx| self.poll_event(cx)).await
    }

    fn publish(&mut self, sample: Delivery) -> Result<(), &'static str> {
        let Delivery {
            topic,
            payload,
            source,
            status,
        } = sample;
        if status & STATUS_BAD != 0 {
            return Err("bad status");
        }
        let payload = Payload::to_write(payload).map_err(|error| error.label())?;
        let Some(Sink {
            open: Some(open),
            dds_topic,
            ..
        }) = self.sinks.get_mut(&topic)
        else {
            return Err("no writer yet");
        };
        let size = payload.len();
        let offered = open
            .outlet
            .offer(payload, source.map(dds_time), Instant::now());
        self.schedule.waiting |= open.outlet.is_waiting();
        if let Err(Refusal::TooLarge(limit)) = offered {
            let dds_topic = dds_topic.clone();
            self.tell_once(&dds_topic, "too large", || {
                format!(
                    "a message of {size} bytes may not arrive: above {limit} bytes the DDS stack repairs a lost \
                     fragment too slowly. Larger socket buffers at the subscriber (net.core.rmem_max, \
                     net.core.rmem_default) help"
                )
            });
        }
        offered.map_err(Refusal::label)
    }

    fn wanted(&mut self, topic: TopicId, shape: &[(BuiltinType, bool)]) {
        if topic.space == self.own {
            return;
        }
        if !self.sinks.contains_key(&topic) {
            if self.sinks.len() >= MAX_TOPICS {
                self.tell_once("", "too many values", || {
                    format!("more than {MAX_TOPICS} values of other spaces: the rest is left alone")
                });
                return;
            }
            let sink = Sink::by_name(topic, self.mapping.variable(topic));
            self.sinks.insert(topic, sink);
        }
        let standard = match shape {
            [(builtin, array)] => self.definitions.standard_type(*builtin, *array),
            _ => None,
        };
        let Some(sink) = self.sinks.get_mut(&topic) else {
            return;
        };
        if sink.open.is_none() {
            sink.standard = standard;
            self.open_sink(topic);
        }
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        // DDS has no word for it; the last value stays with its subscribers.
        debug!(%topic, silent, "the writer in the space");
    }

    async fn shutdown(self) {
        let Self {
            domain,
            discovery,
            inbox,
            sinks,
            retired,
            ..
        } = self;
        // It holds the participant.
        drop(discovery);
        if !domain.leave((inbox, sinks, retired)).await {
            warn!("the DDS endpoints were not disposed in time; peers notice when the lease ends");
        }
    }
}

impl std::fmt::Debug for Ros2Port {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ros2Port")
            .field("domain", &self.domain)
            .field("sources", &self.sources)
            .field("sinks", &self.sinks)
            .finish_non_exhaustive()
    }
}

impl Schedule {
    fn new() -> Self {
        Self {
            timer: Box::pin(tokio::time::sleep(Duration::ZERO)),
            reconciled: Instant::now(),
            changed: true,
            unfinished: false,
            waiting: false,
        }
    }

    fn next_reconcile(&self) -> Instant {
        self.reconciled
            + match (self.unfinished, self.changed) {
                (true, _) => BATCH_PAUSE,
                (false, true) => SETTLE,
                (false, false) => POLL,
            }
    }

    fn next(&self, now: Instant) -> Instant {
        let reconcile = self.next_reconcile();
        if self.waiting {
            reconcile.min(now + FLUSH)
        } else {
            reconcile
        }
    }

    fn arm(&mut self, now: Instant) {
        let next = self.next(now);
        self.timer.as_mut().reset(next);
    }

    /// Whether there is something to do; otherwise the task is woken when there is.
    fn is_due(&mut self, cx: &mut Context<'_>) -> bool {
        // `publish` and discovery make it earlier than it was set for.
        if self.changed || self.unfinished || self.waiting {
            let now = Instant::now();
            if self.next(now) < self.timer.deadline() {
                self.arm(now);
            }
        }
        self.timer.as_mut().poll(cx).is_ready()
    }
}

fn lost(topic: TopicId, why: &'static str, count: u64) -> PortEvent {
    PortEvent::Lost {
        topic: Some(topic),
        why,
        count,
    }
}

/// Whether a discovery event may mean another set of endpoints.
fn is_change(event: &DomainParticipantStatusEvent) -> bool {
    matches!(
        event,
        DomainParticipantStatusEvent::ReaderDetected { .. }
            | DomainParticipantStatusEvent::WriterDetected { .. }
            | DomainParticipantStatusEvent::ReaderLost { .. }
            | DomainParticipantStatusEvent::WriterLost { .. }
            | DomainParticipantStatusEvent::ParticipantLost { .. }
    )
}

/// The time as RTPS has it: seconds since 1970 and 2^-32 fractions (RTPS 2.5, 9.3.2.1). Times it cannot express are
/// cut to its ends.
fn dds_time(time: uadp::Timestamp) -> rustdds::Timestamp {
    let nanos = u64::try_from(time.unix_nanos().max(0)).unwrap_or(u64::MAX);
    let seconds = (nanos / NANOS).min(u64::from(u32::MAX) - 1);
    let fraction = ((nanos % NANOS) << 32) / NANOS;
    rustdds::Timestamp::from_ticks((seconds << 32) | fraction)
}

const NANOS: u64 = 1_000_000_000;
/// The severity bit of a Bad StatusCode (OPC 10000-4, 7.39.1) in its upper 16 bits.
const STATUS_BAD: u16 = 0x8000;
/// How often the domain is looked at when nothing is reported.
const POLL: Duration = Duration::from_millis(200);
/// After a change: how long to let further ones come.
const SETTLE: Duration = Duration::from_millis(20);
/// Between two batches of endpoints.
const BATCH_PAUSE: Duration = Duration::from_millis(100);
/// How often a full send window is tried again.
const FLUSH: Duration = Duration::from_millis(2);
/// How long a replaced reader hears on.
const RETIRE_AFTER: Duration = Duration::from_secs(2);
/// Endpoints made in one go. RustDDS queues two commands for each, and has room for 1024.
const MAX_BATCH: usize = 200;
/// Topics of the space that are read, and likewise written: anybody in the domain can invent names.
const MAX_TOPICS: usize = 4096;
/// Peculiarities told; a domain with more of them is told about no further ones.
const MAX_TOLD: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_time_keeps_its_nanoseconds() {
        let nanos = 1_700_000_000_123_456_789_i128;
        let ticks = dds_time(uadp::Timestamp::from_unix_nanos(nanos)).to_ticks();
        let back = u128::from(ticks >> 32) * 1_000_000_000
            + ((u128::from(ticks & 0xffff_ffff) * 1_000_000_000) >> 32);
        assert!(nanos.unsigned_abs().abs_diff(back) <= 1, "{back}");
    }
}
