//! The ROS 2 port: binds the topics of a DDS domain to the values of the space.
//!
//! One task owns the state; [`Ros2Port::recv`](Port::recv) is its only wait. Endpoints are created
//! in [`reconcile`], which compares the endpoints of the domain with the open endpoints: every 200
//! ms, and shortly after RustDDS reports a change.

mod action_graph;
mod actions;
mod awaited;
mod bridges;
mod calls;
mod descriptions;
mod drops;
mod inquiry;
mod reconcile;
mod reload;
mod schedule;
mod services;
mod strays;
mod writing;

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::convert::Infallible;
use std::future::poll_fn;
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::task::{Context, Poll};

use bridge_node::policy::{Policy, Read, Step, TYPE_CHANGES, Word, is_bad, type_changes};
use bridge_node::{
    Actions, Answered, AskId, AwaitedPeers, CallDescription, Calls, Delivery, Described, Executed,
    Executing, Execution, ExecutionId, Handover, Kept, Port, PortEvent, Reason, Services,
    TypePaths, hear_log, now,
};
use bytes::Bytes;
use futures_util::StreamExt;
use mappings::{Mapping, SpaceId, TopicId};
use messages::{ActionCalls, DefinitionError, Selection, TextKind, TypeName};
use ros2_node::clock::RosClock;
use ros2_node::domain::{Domain, DomainError, DomainOptions};
use ros2_node::graph::{Graph, dds_topic};
use ros2_node::inbox::{Inbox, Taken};
use ros2_node::limits;
use ros2_node::outlet::{Former, Progress, Refusal};
use ros2_node::parameters::ParameterServer;
use ros2_node::raw::{Payload, RawWriter, Reader};
use ros2_node::security::rejections::{Rejection, Rejections};
use ros2_node::service::{ServicePeers, ServiceServer};
use ros2_node::type_description::TypeServer;
use rustdds::{DomainParticipantStatusEvent, DomainParticipantStatusListener, GUID, StatusEvented};
use tokio::time::Instant;
use tracing::{debug, info, warn};
use uadp::BuiltinType;

use crate::definitions::Definitions;
use crate::descriptors::Descriptors;
use crate::entry::NAME;
use crate::sink::Sink;
use crate::source::{Source, same_participant};

use descriptions::Descriptions;
use drops::Drops;
use reconcile::MAX_BATCH;
use schedule::Schedule;
use services::{Client, Ros2Graph};
use writing::{cause, handover};

/// The options with which a [`Ros2Port`] starts.
#[derive(Debug, Clone)]
pub struct PortOptions {
    /// The DDS domain to join.
    pub domain: DomainOptions,
    /// The space of the values that are produced in this domain.
    pub own: SpaceId,
    /// The mapping of the cell.
    pub mapping: Arc<Mapping>,
    /// The definitions from the `type_paths` of the mapping.
    pub types: Arc<TypePaths>,
    /// Search path for message definitions that are not built in, in the order of
    /// `AMENT_PREFIX_PATH`.
    pub prefixes: Vec<PathBuf>,
}

/// The ROS 2 side of a bridge.
pub struct Ros2Port {
    domain: Domain,
    joined: Instant,
    /// Announces this bridge to the other bridges of the domain.
    presence: RawWriter,
    discovery: DomainParticipantStatusListener,
    rejections: Rejections,
    policy: Policy,
    domain_id: u16,
    /// The addresses to which RustDDS binds its sockets; empty means all addresses.
    networks: Vec<IpAddr>,
    definitions: Definitions,
    descriptions: Descriptions,
    /// Serves the descriptions of the types that this bridge reads and writes.
    told_types: TypeServer,
    graph: Graph,
    /// Topics that this bridge reads. A source is never removed, so its index identifies it.
    #[expect(
        clippy::vec_box,
        reason = "a vector that grows has room for twice what is in it"
    )]
    sources: Vec<Box<Source>>,
    source_of: BTreeMap<String, usize>,
    inbox: Inbox<usize>,
    /// Services that are called for values.
    services: Services,
    /// Calls of other spaces, offered as services.
    calls: Calls<ServiceServer>,
    /// Whether this bridge is one of several redundant bridges of its space.
    is_redundant: bool,
    /// Services of the domain, executed for other spaces.
    executing: Executing<Client>,
    /// Actions in both directions.
    actions: Actions,
    /// The endpoints of other participants on the topics of services and actions.
    peers: ServicePeers,
    parameters: ParameterServer,
    /// Topics that this bridge writes.
    /// The sinks are boxed because the table reserves room for up to twice the number of entries.
    sinks: HashMap<TopicId, Box<Sink>>,
    /// Replaced readers, which receive until their successors are matched.
    retired: VecDeque<(Instant, Reader)>,
    /// Writers that were given up while their readers may still miss samples.
    former: VecDeque<Former>,
    /// Events that `recv` returns next; filled only while it is empty, or by one pass over the
    /// topics.
    events: VecDeque<PortEvent>,
    /// Endpoints that may be created before the next [`reconcile`](Self::reconcile).
    budget: usize,
    descriptors: Descriptors,
    clock: RosClock,
    /// Remote endpoints that were logged and counted as incompatible with ours.
    incompatible: BTreeSet<GUID>,
    /// Remote readers that were logged and counted because their definition of a type differs from
    /// ours.
    misreading: BTreeSet<GUID>,
    drops: Drops,
    schedule: Schedule,
}

impl Ros2Port {
    /// Joins the domain and prepares the endpoints that the mapping names.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn start(options: PortOptions) -> Result<Self, DomainError> {
        let PortOptions {
            domain: domain_options,
            own,
            mapping,
            types,
            prefixes,
        } = options;
        let domain = Domain::join(&domain_options)?;
        info!(
            domain = domain_options.domain,
            space = %own,
            node = domain.node_name(),
            networks = ?domain_options.networks,
            peers = ?domain_options.peers,
            dds = limits::RUSTDDS,
            "joined the DDS domain"
        );
        if let Some(log) = domain.rosout() {
            hear_log(NAME, &log);
        }
        let presence = domain.announce_bridge(own.into())?;
        let mut definitions = Definitions::new(types, prefixes);
        let peers = ServicePeers::new(&domain);
        let declared =
            services::parameters(own, domain_options.domain, domain_options.node.use_sim_time);
        let parameters = ParameterServer::open(&domain, &peers, declared)?;
        let mut graph = Ros2Graph {
            peers: &peers,
            domain: &domain,
            definitions: &mut definitions,
        };
        let (services, bound) = Services::start(&mut graph, own, &mapping);
        let told_types = TypeServer::open(&domain, &peers)?;
        let clock = domain.clock();
        let mut port = Self {
            discovery: domain.status_listener(),
            joined: Instant::now(),
            rejections: Rejections::default(),
            domain,
            presence,
            policy: Policy::new(own, mapping),
            domain_id: domain_options.domain,
            networks: domain_options.networks,
            definitions,
            descriptions: Descriptions::new(peers.clone()),
            told_types,
            services,
            calls: Calls::default(),
            is_redundant: false,
            executing: Executing::default(),
            actions: Actions::default(),
            peers,
            parameters,
            graph: Graph::default(),
            sources: Vec::new(),
            source_of: BTreeMap::new(),
            inbox: Inbox::new(),
            sinks: HashMap::new(),
            retired: VecDeque::new(),
            former: VecDeque::new(),
            events: bound.into(),
            budget: MAX_BATCH,
            descriptors: Descriptors::of_process(),
            clock,
            incompatible: BTreeSet::new(),
            misreading: BTreeSet::new(),
            drops: Drops::default(),
            schedule: Schedule::new(),
        };
        port.take_bindings();
        let wanted = port.calls.ask_for_mapped(&port.policy);
        port.events.extend(wanted);
        Ok(port)
    }

    fn take_bindings(&mut self) {
        for (dds_topic, (message_type, values)) in self.read() {
            let index = self.source(dds_topic, message_type);
            if let Some(source) = self.sources.get_mut(index) {
                // Most topics have a single value.
                source.values.reserve_exact(values.len());
                source.values.extend(values);
            }
        }
        self.take_up_sinks();
    }

    /// Returns the topics that the mapping reads.
    fn read(&self) -> Read {
        let name = |ros_topic: &str| Ok::<_, Infallible>(dds_topic(ros_topic));
        self.policy.read(name)
    }

    /// Adds sinks for the values of other spaces that the mapping binds to topics of this domain.
    fn take_up_sinks(&mut self) {
        for topic in self.policy.written() {
            if !self.sinks.contains_key(&topic) {
                let sink = Sink::new(self.policy.destination(topic));
                self.sinks.insert(topic, Box::new(sink));
            }
        }
    }

    /// Returns the changes of a mapping that require a restart.
    fn fixed(&self, mapping: &Mapping) -> Vec<String> {
        let declared = mapping
            .space(self.policy.own())
            .and_then(|space| space.domain);
        let other = declared.filter(|domain| *domain != self.domain_id);
        let fixed = other.map(|domain| {
            format!(
                "spaces (space {} in domain {domain}, not {})",
                self.policy.own(),
                self.domain_id
            )
        });
        fixed.into_iter().collect()
    }

    /// Returns the index of the source of the topic; creates the source if it is missing.
    fn source(&mut self, dds_topic: String, message_type: TypeName) -> usize {
        let next = self.sources.len();
        let index = *self.source_of.entry(dds_topic.clone()).or_insert(next);
        if index == next {
            let source = Source::new(dds_topic, message_type);
            self.sources.push(Box::new(source));
        }
        index
    }

    fn poll_event(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Poll::Ready(event);
            }
            // The schedule comes before the samples, so that a flood of samples does not delay new
            // topics.
            if self.schedule.is_due(cx) {
                self.look_again();
                continue;
            }
            if let Poll::Ready(outcome) = self.services.poll_recv(cx) {
                let events = self.services.ended(outcome, now().utc);
                self.events.extend(events);
                continue;
            }
            if let Poll::Ready(events) = self.executing.poll_recv(cx) {
                self.events.extend(events);
                continue;
            }
            if let Poll::Ready(events) = self.actions.poll_recv(cx) {
                self.events.extend(events);
                continue;
            }
            if let Poll::Ready(event) = self.calls.poll_recv::<Ros2Graph<'_>>(cx) {
                return Poll::Ready(event);
            }
            match self.inbox.poll_recv(cx) {
                Poll::Ready(taken) => self.taken(taken),
                Poll::Pending if self.noticed_change(cx) => {}
                Poll::Pending => return self.domain.poll_end(cx).map(PortEvent::Ended),
            }
        }
    }

    /// Returns whether discovery reported a change for which no pass is scheduled yet.
    fn noticed_change(&mut self, cx: &mut Context<'_>) -> bool {
        let before = self.schedule.changed;
        let now = Instant::now();
        let mut kept_out = Vec::new();
        let mut events = self.discovery.as_async_status_stream();
        while let Poll::Ready(Some(event)) = events.poll_next_unpin(cx) {
            self.schedule.changed |= is_change(&event);
            kept_out.extend(self.rejections.note(&event, now));
        }
        self.report_rejections(&kept_out);
        self.schedule.changed && !before || !kept_out.is_empty()
    }

    fn report_rejections(&mut self, rejections: &[Rejection]) {
        for rejection in rejections {
            if self.rejections.is_new(rejection) {
                warn!("DDS Security: {rejection}");
            }
            self.events.push_back(PortEvent::Lost {
                topic: None,
                reason: Reason::Unsecured,
                why: KEPT_OUT,
                count: 1,
            });
        }
    }

    fn taken(&mut self, taken: Taken<usize>) {
        match taken {
            Taken::Sample {
                key,
                payload,
                writer,
                missing,
            } => {
                let Some(source) = self.sources.get_mut(key) else {
                    return;
                };
                // The bridge's own publication, which RustDDS delivers to the bridge's own reader
                // as well.
                if same_participant(writer, self.domain.participant()) {
                    return;
                }
                if self.graph.is_bridge(writer) {
                    for (topic, _) in &source.values {
                        self.events.push_back(lost(*topic, BY_BRIDGE, 1));
                    }
                    return;
                }
                let received = now().utc;
                let stranger = source.strangers.get(&writer).copied();
                let payload = payload.into_bytes();
                let latched_by = match stranger {
                    Some(_) => None,
                    None => source.latched_by(writer, &payload),
                };
                for (topic, _) in &source.values {
                    let topic = *topic;
                    if missing > 0 {
                        self.events.push_back(lost(topic, UNREAD, missing));
                    }
                    self.events.push_back(match stranger {
                        Some(why) => lost(topic, (Reason::Mismatch, why), 1),
                        None => PortEvent::Sample {
                            topic,
                            payload: payload.clone(),
                            received,
                            latched_by,
                        },
                    });
                }
            }
            Taken::Unreadable { key, why } => {
                let Some(source) = self.sources.get(key) else {
                    return;
                };
                debug!(topic = source.dds_topic, why, "unreadable sample");
                for (topic, _) in &source.values {
                    self.events.push_back(lost(
                        *topic,
                        (Reason::Malformed, "unreadable encoding"),
                        1,
                    ));
                }
            }
        }
    }

    /// Handles the timer: sends waiting samples and compares the domain with the open endpoints.
    fn look_again(&mut self) {
        let now = Instant::now();
        if self.schedule.is_waiting() {
            self.flush(now);
        }
        let overdue = self.rejections.overdue(now);
        self.report_rejections(&overdue);
        if now >= self.schedule.next_reconcile() {
            self.reconcile(now);
        }
        if self.domain.is_mute() {
            let why = "the thread of the ROS node has ended".to_owned();
            self.events.push_back(PortEvent::Ended(why));
        }
        self.schedule.arm(now);
    }

    fn flush(&mut self, now: Instant) {
        for topic in self.schedule.waiting() {
            let sink = self.sinks.get_mut(&topic);
            let Some(open) = sink.and_then(|sink| sink.open.as_mut()) else {
                self.schedule.note_waiting(topic, false);
                continue;
            };
            if let Err(refusal) = open.outlet.flush(now) {
                self.events.push_back(lost(topic, cause(refusal), 1));
            }
            self.schedule.note_waiting(topic, open.outlet.is_waiting());
        }
    }

    /// Returns the local type that a publisher of the space names, if the type is known and has the
    /// named fields.
    fn learned(&mut self, topic: TopicId, described: &Described) -> Option<(TypeName, Selection)> {
        let name = &described.message_type;
        if ActionCalls::is_value(name) {
            // The action server takes this value.
            return None;
        }
        match self.definitions.get(name) {
            Ok(found) => self.policy.learned(topic, described, &found.message_type),
            Err(error) => {
                let dds_topic = self.sinks.get(&topic).map(|sink| sink.dds_topic.as_str());
                let readers = self.graph.readers(dds_topic.unwrap_or_default());
                let dds_type = name.dds();
                // Nodes that serve type descriptions are asked when the sink is opened.
                if !readers
                    .iter()
                    .any(|r| r.type_name == dds_type && r.type_hash.is_some())
                {
                    let said = "the type that the writer announces cannot be used";
                    self.tell_unknown_type(&topic.to_string(), said, &error);
                }
                None
            }
        }
    }

    /// Logs an unknown type once per topic; returns whether it was logged.
    fn tell_unknown_type(&mut self, topic: &str, what: &str, error: &DefinitionError) -> bool {
        let definitions = &mut self.definitions;
        self.policy.told.once(topic, "unknown type", || {
            format!("{what}: {}", definitions.explain(TextKind::Message, error))
        })
    }
}

impl Port for Ros2Port {
    async fn recv(&mut self) -> PortEvent {
        poll_fn(|cx| self.poll_event(cx)).await
    }

    fn publish(&mut self, sample: Delivery) -> Result<(), &'static str> {
        if type_changes(&self.events, sample.topic) {
            return Err(TYPE_CHANGES);
        }
        if self.actions.takes(&self.policy, sample.topic) {
            return self.actions.publish(&sample);
        }
        let Delivery {
            topic,
            payload,
            source,
            status,
            kept,
            lasting,
            ..
        } = sample;
        if kept == Kept::Again {
            // A service is not a late subscriber, and a writer of depth 1 has room for the newest
            // value only.
            let sink = self.sinks.get(&topic).and_then(|sink| sink.open.as_ref());
            let stores_newer =
                sink.is_none_or(|open| open.outlet.stores_newer_than(source.map(dds_time)));
            if !lasting || self.services.takes(topic) || stores_newer {
                return Ok(());
            }
        }
        if is_bad(status) {
            return Err("bad status");
        }
        if let Some(replaced) = self.services.hand_over(topic, &payload) {
            if replaced > 0 {
                self.events.push_back(lost(
                    topic,
                    (Reason::Overflow, "service too slow"),
                    replaced,
                ));
            }
            return Ok(());
        }
        if self.is_at_home(topic.space) {
            // Subscribers of this domain receive from the node that produces the value.
            return Err("served by another bridge of this domain");
        }
        let Some(Sink {
            open: Some(open),
            dds_topic,
            ..
        }) = self.sinks.get_mut(&topic).map(Box::as_mut)
        else {
            return Err("no writer yet");
        };
        let payload = open.stamped(payload, || self.clock.now());
        let payload = Payload::to_write(payload).map_err(|error| error.label())?;
        let size = payload.len();
        let (source, now) = (source.map(dds_time), Instant::now());
        let variable = self.policy.mapping().variable(topic);
        let confirmed = variable.and_then(|variable| variable.confirmed_within);
        let offered = match (lasting, confirmed) {
            (true, _) => open.outlet.offer(payload, source, now),
            (false, None) => open.outlet.offer_once(payload, source, now),
            (false, Some(within)) => open.outlet.offer_in_time(payload, source, (now, within)),
        };
        self.schedule.note_waiting(topic, open.outlet.is_waiting());
        let offered = match offered {
            // An older sample was lost: the new sample must not be offered again.
            Err(Refusal::Overflow) if confirmed.is_some() => {
                let cause = cause(Refusal::Overflow);
                self.events.push_back(lost(topic, cause, 1));
                Ok(())
            }
            offered => offered,
        };
        if let Err(Refusal::TooLarge(limit)) = offered {
            let dds_topic = dds_topic.clone();
            self.policy.told.once(&dds_topic, "too large", || {
                format!(
                    "a message of {size} bytes is not sent: subscribers of this topic may not be able to \
                     reassemble more than {limit} bytes ({})",
                    limits::RUSTDDS
                )
            });
        }
        offered.map_err(|refusal| cause(refusal).1)
    }

    fn handover(&self, topic: TopicId) -> Handover {
        let sink = self.sinks.get(&topic).and_then(|sink| sink.open.as_ref());
        let outlet = || {
            let progress = sink.map_or(Progress::NoReader, |open| open.outlet.progress());
            handover(progress)
        };
        self.services.handover(topic).unwrap_or_else(outlet)
    }

    fn wanted(
        &mut self,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&Described>,
    ) {
        if self.actions.takes(&self.policy, topic) {
            // The value is bound when its action is served.
            return;
        }
        let at_home = topic.space == self.policy.own() || self.is_at_home(topic.space);
        if at_home || self.services.takes(topic) {
            return;
        }
        self.schedule.look_next();
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
        let open = sink.open.as_ref().map(|open| {
            let subscribed = !self.graph.readers(&sink.dds_topic).is_empty();
            (open.definition.name(), subscribed)
        });
        match sink.choice.hear(word, open) {
            Step::Stay => {}
            Step::Open => self.open_sink(topic, Instant::now()),
            Step::Select(selection) => {
                let Some(open) = &mut sink.open else { return };
                let message_type = Arc::clone(&open.definition.message_type);
                open.stamps = sink.choice.stamps(&message_type);
                self.events.push_back(PortEvent::Bound {
                    topic,
                    message_type,
                    selection,
                });
            }
        }
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        debug!(%topic, silent, "the writer in the space");
        if let Some(sink) = self.sinks.get_mut(&topic) {
            // The value stays with the subscribers that have it and is sent to no further
            // subscriber.
            if let Some(open) = sink.open.as_mut().filter(|_| silent) {
                open.outlet.forget_stored(Instant::now());
                self.schedule.note_waiting(topic, open.outlet.is_waiting());
            }
            sink.silent = silent.then(|| now().monotonic);
        }
    }

    fn drop_waiting(&mut self, at_once: bool) {
        let now = Instant::now();
        for (topic, sink) in &mut self.sinks {
            let Some(open) = sink.open.as_mut() else {
                continue;
            };
            let count = open.outlet.drop_waiting(at_once, now);
            self.schedule.note_waiting(*topic, open.outlet.is_waiting());
            if count > 0 {
                let cause = (Reason::Takeover, "waited in its writer");
                self.events.push_back(lost(*topic, cause, count));
            }
        }
    }

    fn role_changed(&mut self, _is_active: bool) {
        self.is_redundant = true;
    }

    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        self.calls.known(topic, Arc::clone(description));
        self.actions.known(topic, description);
        self.schedule.look_next();
    }

    fn call_gone(&mut self, topic: TopicId) {
        let now = now().monotonic;
        self.calls.gone(topic, now);
        self.actions.gone(topic, now);
    }

    fn answered(&mut self, ask: AskId, _: TopicId, answer: Answered<Bytes>) {
        self.calls.answered(ask, answer);
    }

    fn execute(&mut self, execution: Execution) -> bool {
        let id = execution.id;
        let begun = match self.actions.serves(execution.topic) {
            true => self.actions.execute(execution),
            false => self.executing.execute(execution),
        };
        if let Err(refusal) = begun {
            let outcome = Executed::Refused(refusal);
            let execution = id;
            let event = PortEvent::Executed { execution, outcome };
            self.events.push_back(event);
        }
        true
    }

    fn abandoned(&mut self, execution: ExecutionId, _: TopicId) {
        self.actions.abandoned(execution);
    }

    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String> {
        let restart = self.fixed(mapping);
        self.go_over_to(mapping, types);
        restart
    }

    fn add_awaited(&self, missing: &mut AwaitedPeers) {
        self.add_missing(missing);
    }

    fn addresses(&self) -> Option<&[IpAddr]> {
        // RustDDS joins multicast groups and announces its addresses only when the participant is
        // created.
        Some(&self.networks)
    }

    fn pending(&self) -> Vec<String> {
        self.actions.pending()
    }

    async fn shutdown(self) {
        let Self {
            domain,
            presence,
            discovery,
            inbox,
            sinks,
            retired,
            former,
            services,
            calls,
            executing,
            actions,
            peers,
            parameters,
            descriptions,
            told_types,
            ..
        } = self;
        // They hold the participant.
        drop((
            discovery,
            services,
            calls,
            executing,
            actions,
            peers,
            parameters,
            descriptions,
            told_types,
        ));
        if !domain
            .leave((inbox, sinks, retired, former, presence))
            .await
        {
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

fn lost(topic: TopicId, (reason, why): (Reason, &'static str), count: u64) -> PortEvent {
    PortEvent::Lost {
        topic: Some(topic),
        reason,
        why,
        count,
    }
}

/// The reason for dropped samples that another bridge published: they are values of the space.
const BY_BRIDGE: (Reason, &str) = (Reason::Looped, "published by another bridge");
/// The reason for samples that RustDDS reports as lost.
const UNREAD: (Reason, &str) = (Reason::Overflow, "lost before they were read");

/// The reason under which rejected participants are counted.
const KEPT_OUT: &str = "participant not authenticated";

/// Returns whether a discovery event may change the set of endpoints.
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

/// Converts a time to RTPS: seconds since 1970 and fractions of 2^-32 s (RTPS 2.5, 9.3.2.1). Times
/// outside the range are clamped.
fn dds_time(time: uadp::Timestamp) -> rustdds::Timestamp {
    let nanos = u64::try_from(time.unix_nanos().max(0)).unwrap_or(u64::MAX);
    let seconds = (nanos / NANOS).min(u64::from(u32::MAX) - 1);
    let fraction = ((nanos % NANOS) << 32) / NANOS;
    rustdds::Timestamp::from_ticks((seconds << 32) | fraction)
}

const NANOS: u64 = 1_000_000_000;

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
