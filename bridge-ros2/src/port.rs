//! The ROS 2 port: binds the topics of a DDS domain to the values of the space.
//!
//! One task owns the state; [`Ros2Port::recv`](Port::recv) is its only wait. Endpoints are created
//! in [`Ros2Port::reconcile`], which compares the endpoints of the domain with the open endpoints:
//! every 200 ms, and shortly after RustDDS reports a change.
//!
//! The port wires types that own their state: the topics that the bridge reads ([`ReadTopics`]),
//! the topics that it writes ([`WrittenTopics`]), and services and actions ([`Ros2Requests`]). They
//! share the node and its view of the domain ([`Ros2Side`]).

mod action_graph;
mod awaited;
mod bridges;
mod descriptions;
mod drops;
mod inquiry;
mod requests;
mod schedule;
mod services;
mod side;
mod sinks;
mod sources;
mod type_hashes;

use std::collections::BTreeSet;
use std::future::poll_fn;
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::task::{Context, Poll};

use bridge_node::policy::{Policy, TYPE_CHANGES, type_changes};
use bridge_node::{
    AskId, AwaitedPeers, CallDescription, CallResponse, Execution, ExecutionId, Handover,
    LocalDelivery, Port, PortEvent, Reason, TopicMetaData, TypePaths, hear_log,
};
use bytes::Bytes;
use futures_util::StreamExt;
use mappings::{Mapping, SpaceId, TopicId};
use ros2_node::domain::{Domain, DomainError, DomainOptions};
use ros2_node::graph::Graph;
use ros2_node::limits;
use ros2_node::parameters::ParameterServer;
use ros2_node::raw::RawWriter;
use ros2_node::security::rejections::{Rejection, Rejections};
use ros2_node::service::ServicePeers;
use ros2_node::type_description::TypeServer;
use rustdds::{DomainParticipantStatusEvent, DomainParticipantStatusListener, StatusEvented};
use tokio::time::Instant;
use tracing::{info, warn};
use uadp::BuiltinType;

use self::awaited::Ros2MissingPeers;
use self::descriptions::TypeDescriptions;
use self::drops::Drops;
use self::requests::Ros2Requests;
use self::schedule::Schedule;
use self::side::Ros2Side;
use self::sinks::WrittenTopics;
use self::sources::ReadTopics;
use crate::NAME;
use crate::definitions::Ros2Definitions;
use crate::descriptors::Descriptors;

/// The options with which a [`Ros2Port`] starts.
#[derive(Debug, Clone)]
pub struct Ros2PortOptions {
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
    side: Ros2Side,
    /// The topics that this bridge reads.
    sources: ReadTopics,
    /// The topics that this bridge writes.
    sinks: WrittenTopics,
    /// Services and actions in both directions.
    requests: Ros2Requests,
    discovery: DomainParticipantStatusListener,
    rejections: Rejections,
    /// Announces this bridge to the other bridges of the domain.
    presence: RawWriter,
    parameters: ParameterServer,
    /// The addresses to which RustDDS binds its sockets; empty means all addresses.
    networks: Vec<IpAddr>,
    drops: Drops,
}

impl Ros2Port {
    /// Joins the domain and prepares the endpoints that the mapping names.
    ///
    /// # Errors
    /// [`DomainError`].
    pub fn start(options: Ros2PortOptions) -> Result<Self, DomainError> {
        let Ros2PortOptions {
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
        let mut definitions = Ros2Definitions::new(types, prefixes);
        let peers = ServicePeers::new(&domain);
        let declared =
            services::parameters(own, domain_options.domain, domain_options.node.use_sim_time);
        let parameters = ParameterServer::open(&domain, &peers, declared)?;
        let told_types = TypeServer::open(&domain, &peers)?;
        let descriptions = TypeDescriptions::new(peers.clone());
        let (requests, bound) =
            Ros2Requests::start(&domain, peers, &mut definitions, (own, &mapping));
        let mut port = Self {
            discovery: domain.status_listener(),
            sources: ReadTopics::new(),
            sinks: WrittenTopics::new(domain.clock()),
            requests,
            side: Ros2Side {
                domain,
                domain_id: domain_options.domain,
                joined: Instant::now(),
                graph: Graph::default(),
                policy: Policy::new(own, mapping),
                definitions,
                descriptions,
                told_types,
                budget: MAX_BATCH,
                descriptors: Descriptors::of_process(),
                incompatible: BTreeSet::new(),
                schedule: Schedule::new(),
                events: bound.into(),
            },
            rejections: Rejections::default(),
            presence,
            parameters,
            networks: domain_options.networks,
            drops: Drops::default(),
        };
        let read = port.side.read();
        port.sources.take_up(read);
        port.sinks.take_up(&port.side);
        port.requests.ask_for_mapped(&mut port.side);
        Ok(port)
    }

    fn poll_event(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        loop {
            if let Some(event) = self.side.events.pop_front() {
                return Poll::Ready(event);
            }
            // The schedule comes before the samples, so that a flood of samples does not delay new
            // topics.
            if self.side.schedule.is_due(cx) {
                self.look_again();
                continue;
            }
            if self.requests.poll_events(&mut self.side, cx).is_ready() {
                continue;
            }
            match self.sources.poll_recv(cx) {
                Poll::Ready(taken) => self.sources.handle(&mut self.side, taken),
                Poll::Pending if self.noticed_change(cx) => {}
                Poll::Pending => return self.side.domain.poll_end(cx).map(PortEvent::Ended),
            }
        }
    }

    /// Returns whether discovery reported a change for which no pass is scheduled yet.
    fn noticed_change(&mut self, cx: &mut Context<'_>) -> bool {
        let before = self.side.schedule.changed;
        let now = Instant::now();
        let mut kept_out = Vec::new();
        let mut events = self.discovery.as_async_status_stream();
        while let Poll::Ready(Some(event)) = events.poll_next_unpin(cx) {
            self.side.schedule.changed |= is_change(&event);
            kept_out.extend(self.rejections.note(&event, now));
        }
        self.report_rejections(&kept_out);
        self.side.schedule.changed && !before || !kept_out.is_empty()
    }

    fn report_rejections(&mut self, rejections: &[Rejection]) {
        for rejection in rejections {
            if self.rejections.is_new(rejection) {
                warn!("DDS Security: {rejection}");
            }
            self.side.events.push_back(PortEvent::Lost {
                topic: None,
                reason: Reason::Unsecured,
                why: KEPT_OUT,
                count: 1,
            });
        }
    }

    /// Handles the timer: sends waiting samples and compares the domain with the open endpoints.
    fn look_again(&mut self) {
        let now = Instant::now();
        if self.side.schedule.is_waiting() {
            self.sinks.flush(&mut self.side, now);
        }
        let overdue = self.rejections.overdue(now);
        self.report_rejections(&overdue);
        if now >= self.side.schedule.next_reconcile() {
            self.reconcile(now);
        }
        if self.side.domain.is_mute() {
            let why = "the thread of the ROS node has ended".to_owned();
            self.side.events.push_back(PortEvent::Ended(why));
        }
        self.side.schedule.arm(now);
    }

    /// Reconciles the open endpoints with the domain, if either may have changed. Creates at most
    /// [`MAX_BATCH`] endpoints at a time: the discovery of RustDDS takes commands from a bounded
    /// queue and drops commands that do not fit.
    fn reconcile(&mut self, now: Instant) {
        let side = &mut self.side;
        let domain = side.domain.changes();
        let is_due = side.schedule.is_look_due(domain, now);
        side.schedule.reconciled = now;
        let free = side.descriptors.free();
        side.budget = MAX_BATCH.min(free.mapped);
        if free.found == 0 {
            side.tell_scarce();
        }
        self.sources.drop_retired(now);
        self.sinks.drop_former(now);
        self.report_drops();
        let side = &mut self.side;
        self.requests.tidy(side);
        if is_due {
            side.graph = side.domain.graph();
        }
        self.requests.offer(side);
        if !is_due {
            return;
        }
        side.schedule.looks(domain, now);
        let graph = &side.graph;
        side.incompatible.retain(|guid| graph.holds(*guid));
        self.sinks.forget_left(graph);
        side.tell_of_bridges();
        self.announce_anew(now);
        let side = &mut self.side;
        side.take_descriptions(now);
        let is_written = |topic: &str| self.sinks.is_written(topic);
        self.sources.find(side, is_written, now);
        self.requests.find(side);
        self.sources.reconcile(side, now);
        self.sinks.reconcile(side, now);
        if side.descriptions.is_asking(now) {
            // Replies are taken in a pass.
            side.schedule.look_next();
        }
    }

    /// Recreates the endpoints that RustDDS left out of its announcements.
    fn announce_anew(&mut self, now: Instant) {
        let lost = self.side.domain.unannounced(&self.side.graph);
        if lost.is_empty() {
            return;
        }
        let made = self.sources.announce_anew(&mut self.side, &lost, now)
            + self.sinks.announce_anew(&mut self.side, &lost, now);
        // The remaining endpoints are service endpoints, endpoints of the node itself, and replaced
        // readers that still receive.
        if made == 0 {
            let count = lost.len();
            self.side.policy.told.once("", "unannounced", || {
                format!(
                    "the DDS stack did not announce {count} endpoints of services or of the node; \
                         restart the bridge"
                )
            });
        } else {
            warn!(
                endpoints = made,
                "the DDS stack did not announce readers and writers of this bridge; created them again"
            );
        }
    }

    /// Reports the drops after the last report.
    pub(super) fn report_drops(&mut self) {
        let served = self
            .parameters
            .counters()
            .plus(self.side.told_types.counters());
        let calls = self.requests.counters();
        let totals = [
            (Reason::Malformed, "request of a call", calls.malformed),
            (
                Reason::CallFailed,
                "call without a response",
                calls.failures,
            ),
            (Reason::Overflow, "request of a call", calls.overflowed),
            (
                Reason::NotPublished,
                "response to a call",
                calls.undelivered,
            ),
            (
                Reason::Malformed,
                "list of nodes",
                self.side.domain.malformed_lists(),
            ),
            (Reason::Malformed, "clock", self.sinks.malformed_clocks()),
            (Reason::Malformed, "service request", served.malformed),
            // Services of the bridge fail only at a request that they cannot decode.
            (
                Reason::Malformed,
                "body of a service request",
                served.failures,
            ),
            (Reason::Overflow, "service request", served.overflowed),
            (Reason::NotPublished, "service reply", served.undelivered),
        ];
        self.side.events.extend(self.drops.since(totals));
    }
}

impl Port for Ros2Port {
    async fn recv(&mut self) -> PortEvent {
        poll_fn(|cx| self.poll_event(cx)).await
    }

    fn publish(&mut self, sample: LocalDelivery) -> Result<(), &'static str> {
        if type_changes(&self.side.events, sample.topic) {
            return Err(TYPE_CHANGES);
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
        let side = &mut self.side;
        let at_home = topic.space == side.policy.own() || side.is_at_home(topic.space);
        // The values of an action are bound when the action is served.
        if !at_home && !self.requests.takes(side, topic) {
            self.sinks.wanted(side, topic, shape, described);
        }
    }

    fn silent(&mut self, topic: TopicId, silent: bool) {
        self.sinks.silent(&mut self.side, topic, silent);
    }

    fn drop_waiting(&mut self, at_once: bool) {
        self.sinks.drop_waiting(&mut self.side, at_once);
    }

    fn links_lost(&mut self, lost: &[IpAddr]) {
        self.sinks.drop_unreceived(&mut self.side, !lost.is_empty());
    }

    fn role_changed(&mut self, _is_active: bool) {
        self.requests.is_one_of_several();
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

    /// Gives up all outdated bindings before it adds new bindings, because a value or a topic may
    /// only have moved. Endpoints are created in the next pass over the domain.
    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String> {
        let side = &mut self.side;
        let restart = side.fixed(mapping);
        let before = side.policy.replace(mapping);
        side.definitions.replace(types);
        let read = side.read();
        self.sources.give_up(side, &read);
        self.sinks.give_up(side);
        self.requests.reload(side, &before);
        self.sinks.take_up(side);
        let is_written = |topic: &str| self.sinks.is_written(topic);
        self.sources.take_up_again(side, read, is_written);
        side.schedule.changed = true;
        restart
    }

    fn add_awaited(&self, missing: &mut AwaitedPeers) {
        let found = Ros2MissingPeers {
            side: &self.side,
            sources: &self.sources,
            sinks: &self.sinks,
            peers: self.requests.peers(),
            networks: &self.networks,
        };
        found.add(missing);
    }

    fn addresses(&self) -> Option<&[IpAddr]> {
        // RustDDS joins multicast groups and announces its addresses only when the participant is
        // created.
        Some(&self.networks)
    }

    fn pending(&self) -> Vec<String> {
        self.requests.pending()
    }

    async fn shutdown(self) {
        let Self {
            side,
            sources,
            sinks,
            requests,
            discovery,
            presence,
            parameters,
            ..
        } = self;
        let Ros2Side {
            domain,
            descriptions,
            told_types,
            ..
        } = side;
        // They hold the participant.
        drop((discovery, requests, parameters, descriptions, told_types));
        if !domain.leave((sources, sinks, presence)).await {
            warn!("the DDS endpoints were not disposed in time; peers notice when the lease ends");
        }
    }
}

impl std::fmt::Debug for Ros2Port {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Ros2Port")
            .field("domain", &self.side.domain)
            .field("sources", &self.sources)
            .field("sinks", &self.sinks)
            .finish_non_exhaustive()
    }
}

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

/// The reason under which rejected participants are counted.
const KEPT_OUT: &str = "participant not authenticated";
/// Maximum number of endpoints created in one pass. RustDDS queues two commands for each and has
/// room for 1024.
const MAX_BATCH: usize = 200;
