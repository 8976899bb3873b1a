//! The run loop: the only module in which a bridge waits.

mod awaited;
mod calls;
mod fixed;
mod links;
mod network;
mod outbox;
mod redundancy;
mod side;
mod taps;
mod turn;

use std::collections::BTreeMap;
use std::future::poll_fn;
use std::io;
use std::pin::pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::{Duration, Instant};

use bridge_core::{DropNotice, Handover, Interest, LocalMessage, Output, Owned, Reason, Router};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};
use service::{Failure, FailureKind, PageState as _, Requests};
use tokio::sync::watch;
use tokio::time::{Instant as TokioInstant, Sleep};
use tracing::{debug, info, warn};
use transport::{BUFFER, Carrier, OutgoingMessage, Received, SendError};
use uadp::Timestamp;

use crate::awaited::PeerWatch;
use crate::busy_poll::BusyPoll;
use crate::carrier::NO_SOURCE;
use crate::clock::{now, timestamp};
use crate::keys::{self, KeyRing, NewKeys};
use crate::mapping_file::RunningMapping;
use crate::observer::Observer;
use crate::policy::NO_SUBSCRIBER;
use crate::port::{LocalDelivery, Port, PortEvent};
use crate::status::{AnnouncedNames, Interfaces, Readiness, RedundancyStatus, StatusSnapshot};
use crate::tap::Taps;

pub(crate) use fixed::Fixed;
pub(crate) use links::LinkLoss;
pub(crate) use outbox::DatagramOutbox;
use outbox::Parcel;
pub(crate) use side::SideInterfaces;
pub(crate) use turn::Turn;

/// The run loop of one space, with its Router, port and carrier, and the requests for the status.
pub(crate) struct Shell<P> {
    pub(crate) program: &'static str,
    /// The start of the program.
    pub(crate) started: Instant,
    /// The library of the port, for the status.
    pub(crate) library: Option<&'static str>,
    pub(crate) own: SpaceId,
    pub(crate) router: Router,
    pub(crate) port: P,
    pub(crate) carrier: Box<dyn Carrier>,
    /// The messages that the carrier does not drop; `None` for all of them.
    pub(crate) interest: Option<Interest>,
    /// The datagrams to send together.
    pub(crate) outbox: DatagramOutbox,
    /// The network interfaces of the local side.
    pub(crate) side: SideInterfaces,
    pub(crate) links: LinkLoss,
    /// Returns the namespaces that only this program writes, by the mapping.
    pub(crate) owned: fn(&Mapping) -> Owned,
    /// Whether it listens for other writers in these namespaces before it sends.
    pub(crate) claims: bool,
    pub(crate) requests: Requests<StatusSnapshot>,
    pub(crate) names: AnnouncedNames,
    /// The tapped topics.
    pub(crate) taps: Arc<Taps>,
    pub(crate) changes: watch::Receiver<RunningMapping>,
    /// The requests of the operator to hand over to a standby.
    pub(crate) switches: watch::Receiver<u64>,
    pub(crate) keys: KeyRing,
    pub(crate) fixed: Fixed,
    /// The keys of the mapping that take effect at the next start.
    pub(crate) restart: Vec<String>,
    /// The namespaces that another participant writes, each with its message.
    pub(crate) taken: BTreeMap<u16, String>,
    /// The peers that are missing.
    pub(crate) awaited: PeerWatch,
    pub(crate) busy: BusyPoll,
    /// The number of datagrams or events that are handled in a row.
    pub(crate) turn: Turn,
    pub(crate) dry_run: bool,
    pub(crate) observer: Option<Arc<dyn Observer>>,
    /// Announces the space outside the group until it is dropped.
    pub(crate) _told: Option<Box<dyn Send + Sync>>,
}

/// Whether the program runs or is about to end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    Running,
    /// Only pending cancellations are awaited.
    Closing,
}

impl<P: Port> Shell<P> {
    /// Carries samples until `stop` is ready or the port cannot continue, then shuts the port down.
    pub(crate) async fn run(
        mut self,
        stop: impl Future<Output = ()> + Send,
    ) -> Result<(), Failure> {
        if self.claims {
            self.router.claim(now());
        }
        let mut ended = self.carry(stop, Phase::Running).await;
        self.hand_over_at_end();
        // Callers are not to wait for calls that are not executed any more.
        self.router.withdraw_all(now());
        while self.drain() {}
        if ended.is_ok() {
            self.port.closing();
            let limit = tokio::time::sleep(PENDING_AT_END);
            ended = self.carry(limit, Phase::Closing).await;
        }
        self.log_unknown_outcomes();
        self.log_end();
        self.close().await;
        self.port.shutdown().await;
        ended
    }

    fn log_unknown_outcomes(&self) {
        for pending in self.port.pending() {
            warn!("stopping with an unknown outcome, so check the machine: {pending}");
        }
    }

    fn log_end(&mut self) {
        let status = self.status();
        let [topics, sent, delivered, dropped] = status.summary();
        info!(topics, sent, delivered, dropped, "stopping");
        debug!(status = %status.json(), "last status");
    }

    /// Runs the loop of one phase. All branches of the `select!` are cancel-safe: a socket, and
    /// bounded channels that keep unread items.
    async fn carry(
        &mut self,
        stop: impl Future<Output = ()> + Send,
        phase: Phase,
    ) -> Result<(), Failure> {
        let mut stop = pin!(stop);
        let mut timer = pin!(tokio::time::sleep(FAR));
        let mut looks = pin!(tokio::time::sleep(Duration::ZERO));
        let mut links = pin!(tokio::time::sleep(Duration::ZERO));
        let mut buffer = vec![0; BUFFER];
        let mut more = false;
        loop {
            if phase == Phase::Closing && self.port.pending().is_empty() {
                return Ok(());
            }
            // The inbox of a process has no budget of its own, unlike a socket: a flood from
            // another thread must not keep the other tasks of this thread from running.
            tokio::task::consume_budget().await;
            self.arm(timer.as_mut());
            let yields = std::mem::take(&mut more) || self.busy.looks(|| now().monotonic);
            tokio::select! {
                // Poll all branches once more: a long drain has left work, or the next sample is
                // near.
                () = tokio::task::yield_now(), if yields => {}
                () = &mut stop => return Ok(()),
                heard = self.carrier.recv(&mut buffer) => more = self.heard_all(heard, &mut buffer),
                event = self.port.recv() => more = self.port_events(event).await?,
                () = links.as_mut(), if self.side.is_watched() => {
                    links.as_mut().reset(TokioInstant::now() + self.link_pause());
                    self.look_at_links();
                }
                () = timer.as_mut() => {
                    self.read_waiting(&mut buffer);
                    self.router.handle_timeout(now());
                }
                () = looks.as_mut() => {
                    looks.as_mut().reset(idle_ticks::next(TokioInstant::now(), transport::LOOK));
                    self.follow_group();
                    self.side.report()?;
                    self.port.counted(&self.router);
                    self.look_at_fitness();
                    self.look_for_peers();
                    self.send_probes();
                }
                Ok(()) = self.changes.changed() => self.reload(),
                Ok(()) = self.switches.changed() => self.switch_over(),
                Some(NewKeys { group, delivery }) = self.keys.next() => {
                    keys::give(&mut self.router, &group, &delivery);
                }
                // The client may have disconnected.
                Some(reply) = self.requests.recv() => drop(reply.send(self.status())),
            }
            more |= self.drain();
            if more {
                // The other tasks of the thread pass on the values of this turn first: the event
                // loop of DDS, or another program. The budget of a task counts polls, and a poll
                // handles many datagrams.
                tokio::task::yield_now().await;
            }
            if self.taps.is_on() || self.router.is_tapped() {
                self.follow_taps();
            }
            // A tap that begins sees all messages.
            self.follow_interest();
        }
    }

    /// Handles a datagram and the datagrams queued behind it, up to a number of datagrams and of
    /// bytes, and carries out each before the next is read. Under a flood, the other branches are
    /// then polled once for many datagrams. Returns whether more datagrams may be queued.
    fn heard_all(&mut self, first: io::Result<Received>, buffer: &mut Vec<u8>) -> bool {
        let mut heard = first;
        let mut limits = self.turn.limits();
        loop {
            let size = heard.as_ref().map_or(0, |received| received.length);
            self.heard(heard, buffer);
            if self.drain() || !limits.goes_on_after(size) {
                return true;
            }
            match self.carrier.try_recv(buffer) {
                None => return false,
                Some(next) => heard = next,
            }
        }
    }

    /// Handles the events of the port as [`heard_all`](Self::heard_all) handles datagrams. If
    /// samples may share a datagram, all queued samples are collected before a datagram is sent.
    async fn port_events(&mut self, first: PortEvent) -> Result<bool, Failure> {
        let mut event = first;
        for _ in 0..self.turn.length() {
            if self.port_event_and_drain(event)? {
                return Ok(true);
            }
            let next = poll_fn(|cx| {
                let next = pin!(self.port.recv()).poll(cx);
                Poll::Ready(next)
            });
            match next.await {
                Poll::Ready(next) => event = next,
                Poll::Pending => return Ok(false),
            }
        }
        // The last event was received and must not be lost.
        self.port_event_and_drain(event)?;
        Ok(true)
    }

    /// Handles an event and drains the Router. Returns whether more outputs may be queued, not
    /// counting samples that are to share a datagram.
    fn port_event_and_drain(&mut self, event: PortEvent) -> Result<bool, Failure> {
        if self.router.mapping().pubsub().messages_per_datagram == 1 {
            self.port_event(event)?;
            return Ok(self.drain());
        }
        // No event is lost by waiting, and no event overtakes queued samples.
        let joins =
            matches!(&event, PortEvent::Sample { topic, .. } if !self.router.is_full(*topic));
        let more = !joins && self.drain();
        self.port_event(event)?;
        Ok(more)
    }

    fn status(&mut self) -> StatusSnapshot {
        let about = Arc::clone(&self.changes.borrow().about);
        let interfaces = Interfaces {
            pubsub: u8::from(self.carrier.lost().is_none()),
            local: self.side.up(),
        };
        StatusSnapshot::of(
            (self.program, self.own),
            &self.router,
            (&about, &self.restart),
            Readiness {
                not_ready: self
                    .lost_carriers()
                    .chain(self.side.lost())
                    .chain(self.port.hindrance())
                    .chain(self.taken.values().cloned())
                    .chain(self.keyless())
                    .chain(self.redundancy_faults())
                    .collect(),
                waiting_for: self.awaited.reported(),
                interfaces,
            },
        )
        .with_library(self.library)
        .with_time(now().utc)
        .with_uptime(now().monotonic.saturating_duration_since(self.started))
        .with_links(self.port.links())
        .with_certificate(self.port.certificate())
        .with_pending(self.port.pending())
        .with_carrier(self.carrier.interface(), self.carrier.dropped())
        .with_carriers(self.carrier.states())
        .with_redundancy(RedundancyStatus::of(&self.router, now().monotonic))
        .with_names(&self.router, &mut self.names)
    }

    /// Returns the messages about secured groups without keys.
    fn keyless(&self) -> impl Iterator<Item = String> {
        let groups = self.router.groups();
        let keyless = groups.filter(|state| state.token_id.is_none());
        keyless.map(|state| format!("no keys of the group `{}` yet", state.group))
    }

    /// Adopts the mapping if it has changed.
    fn reload(&mut self) {
        let RunningMapping { mapping, types, .. } = self.changes.borrow_and_update().clone();
        if Arc::ptr_eq(&mapping, &self.fixed.taken) {
            return;
        }
        self.fixed.taken = Arc::clone(&mapping);
        self.observe(|observer| observer.mapped(&mapping));
        let mapping = self.keys.applied(mapping);
        self.router.replace_mapping(Arc::clone(&mapping), now());
        self.keys.follow(&mapping);
        self.router.set_owned((self.owned)(&mapping), now());
        self.restart = self.fixed.differing(&mapping);
        self.restart.extend(self.not_redundant(&mapping));
        self.restart.extend(self.port.reload(&mapping, &types));
        if !self.restart.is_empty() {
            warn!(
                "restart needed for changes of: {}; all other changes of the mapping are in use",
                self.restart.join(", ")
            );
        }
    }

    fn arm(&self, mut timer: std::pin::Pin<&mut Sleep>) {
        let due = self
            .router
            .poll_timeout()
            .map_or_else(|| TokioInstant::now() + FAR, TokioInstant::from_std);
        // Only an earlier deadline needs the timer wheel; a later deadline is found when the timer
        // fires.
        if timer.is_elapsed() || due < timer.deadline() {
            timer.as_mut().reset(due);
        }
    }

    fn heard(&mut self, heard: io::Result<Received>, buffer: &[u8]) {
        match heard {
            Ok(Received {
                length,
                from,
                stamp,
            }) => {
                let datagram = buffer.get(..length).unwrap_or_default();
                let now = now();
                self.busy.arrived(now.monotonic);
                self.observe(|observer| observer.datagram(datagram, from));
                let (relay, forwarding) = network::arrival(self.carrier.as_ref());
                self.router.set_arrival(relay, forwarding);
                let received = stamp.map(timestamp);
                self.router.handle_received(datagram, (from, received), now);
            }
            // Probably an ICMP error for a unicast peer; the socket stays usable.
            Err(error) => debug!(%error, "receiving failed"),
        }
    }

    /// Handles an event of the port; fails when the port cannot continue.
    fn port_event(&mut self, event: PortEvent) -> Result<(), Failure> {
        self.observe(|observer| observer.event(&event));
        match event {
            PortEvent::Sample {
                topic,
                payload,
                received,
                latched_by,
            } => {
                let heard = LocalMessage {
                    topic,
                    payload: &payload,
                    received,
                    latched_by,
                };
                let now = now();
                self.busy.arrived(now.monotonic);
                let verdict = self.router.handle_local(heard, now);
                // The Router has counted a drop.
                self.port.handled(topic, verdict, &self.router);
            }
            PortEvent::Qualified {
                topic,
                payload,
                taken,
                status,
            } => {
                let heard = LocalMessage {
                    topic,
                    payload: &payload,
                    received: taken,
                    latched_by: None,
                };
                // The Router counts the verdict.
                let _verdict = self.router.handle_local_as(heard, status, now());
            }
            PortEvent::Bound {
                topic,
                message_type,
                selection,
            } => match self.router.bind(topic, &message_type, &selection, now()) {
                Ok(()) => {
                    let name = self.router.name_of(topic);
                    info!(%topic, message_type = %message_type.name(), name, "bridging");
                }
                Err(error) => {
                    let name = self.router.name_of(topic);
                    warn!(%topic, %error, name, "cannot bridge the topic");
                    // Values would be misread with the previous binding.
                    self.router.unbind(topic, now());
                }
            },
            PortEvent::Unbound { topic } => self.unbound(topic),
            PortEvent::Left { topic, publisher } => self.router.left(topic, publisher, now()),
            PortEvent::Live { topic, live } => self.router.set_live(topic, live, now()),
            PortEvent::Lost {
                topic,
                reason,
                why,
                count,
            } => self.router.lost(topic, count, (reason, why)),
            PortEvent::Dropped { reason, why, count } => self.router.dropped(reason, count, why),
            PortEvent::Unmatched { topic } => self.router.unmatched(topic),
            PortEvent::CallFailed { topic, detail } => self.router.call_failed(topic, &detail),
            event @ (PortEvent::Described { .. }
            | PortEvent::BoundAs { .. }
            | PortEvent::CallBound { .. }
            | PortEvent::CallUnbound { .. }
            | PortEvent::CallWanted { .. }
            | PortEvent::Ask { .. }
            | PortEvent::AskGivenUp { .. }
            | PortEvent::Offer { .. }
            | PortEvent::OfferTyped { .. }
            | PortEvent::Withdrawn { .. }
            | PortEvent::Executed { .. }) => self.call_event(event),
            PortEvent::Ended(why) => return Err(Failure::new(FailureKind::Unavailable, why)),
        }
        Ok(())
    }

    fn unbound(&mut self, topic: TopicId) {
        info!(%topic, name = self.router.name_of(topic), "stopped bridging");
        self.router.unbind(topic, now());
    }

    /// Carries out the outputs of the Router, up to a limit; returns whether more may be queued.
    fn drain(&mut self) -> bool {
        for _ in 0..DRAINED_AT_ONCE {
            let Some(output) = self.router.poll_output(now()) else {
                self.flush();
                let is_muted = self.is_muted();
                self.port.drained(is_muted, &self.router);
                return false;
            };
            if !matches!(output, Output::Datagram { .. }) {
                self.flush();
            }
            match output {
                Output::Datagram { topic, with, bytes } => {
                    let parcel = Parcel {
                        replaceable: with.is_empty() && self.router.is_state(topic),
                        command: self.router.is_command(topic),
                        within: self.router.expiry(topic),
                        topic,
                        with,
                        bytes,
                    };
                    self.post(parcel);
                }
                Output::Discovery { bytes } => {
                    match self.send(&OutgoingMessage::new(&bytes)) {
                        // The network does not return own datagrams.
                        Ok(()) => {
                            let from = self.carrier.source().unwrap_or(NO_SOURCE);
                            self.observe(|observer| observer.datagram(&bytes, from));
                        }
                        Err(error) => self
                            .router
                            .not_announced(not_sent(error), &error.to_string()),
                    }
                    self.router.recycle(bytes);
                }
                Output::Heartbeat { bytes } => self.send_heartbeat(bytes),
                Output::Role(change) => self.tell_role(change),
                Output::Delivery(delivery) => self.deliver(delivery),
                Output::Unbound {
                    topic,
                    shape,
                    described,
                } => self.port.wanted(topic, &shape, described.as_deref()),
                Output::Silent {
                    topic,
                    silent,
                    dropped,
                } => self.silent(topic, silent, dropped),
                Output::Retired { topic, instance } => self.port.retired(topic, instance),
                Output::Settled { topic, arrival } => self.port.settled(topic, &arrival),
                Output::HandoverWanted { topic, instance } => {
                    let _reported = self.handed(topic, Some(instance));
                }
                Output::CommanderLost { topic } => {
                    let name = self.router.name_of(topic);
                    warn!(%topic, name, "the commander is lost: published the value of `on_loss`");
                }
                Output::Notice(notice) => {
                    let name = notice.topic.and_then(|topic| self.router.name_of(topic));
                    tell(&notice, name);
                }
                Output::KeysWanted { group } => self.keys.want(&group),
                Output::Action { topic, bytes } => self.send_action(topic, bytes),
                Output::Answer { ask, topic, answer } => {
                    self.port.answered(ask, topic, answer.map(Bytes::from));
                }
                Output::CallKnown { topic, description } => self.call_known(topic, &description),
                Output::CallGone { topic } => self.call_gone(topic),
                Output::Execute(execution) => self.execute(execution),
                Output::Abandoned { execution, topic } => self.port.abandoned(execution, topic),
                Output::Taken {
                    namespace,
                    by,
                    name,
                } => self.taken(namespace, by, &name),
            }
        }
        self.flush();
        true
    }

    fn silent(&mut self, topic: TopicId, silent: bool, dropped: Option<Reason>) {
        if let Some(reason) = dropped {
            let name = self.router.name_of(topic);
            debug!(%topic, %reason, name, "messages of the writer are received, but its values are dropped");
        }
        self.observe(|observer| observer.silent(topic, silent));
        self.port.silent(topic, silent);
    }

    /// Passes an event to the observer, if there is one.
    fn observe(&self, note: impl FnOnce(&dyn Observer)) {
        if let Some(observer) = &self.observer {
            note(observer.as_ref());
        }
    }

    /// Sends the probes of the observer.
    fn send_probes(&mut self) {
        let Some(observer) = self.observer.clone() else {
            return;
        };
        for _ in 0..MOST_PROBES {
            let Some(probe) = observer.probe() else {
                return;
            };
            if let Err(error) = self.send(&OutgoingMessage::new(&probe)) {
                debug!(%error, "cannot send a probe");
            }
        }
    }

    fn send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        if self.dry_run {
            return Ok(());
        }
        self.carrier.try_send(message)
    }

    /// Withdraws everything that the network stores.
    async fn close(&mut self) {
        self.carrier.close();
        let closed = self.carrier.closed();
        if tokio::time::timeout(CLOSING, closed).await.is_err() {
            debug!("the PubSub network did not confirm the close");
        }
    }

    fn deliver(&mut self, delivery: bridge_core::Delivery) {
        let bridge_core::Delivery {
            topic,
            payload,
            source,
            status,
            arrived,
            instance,
            kept,
            lasting,
        } = delivery;
        if self.dry_run {
            self.router.recycle(payload);
            return;
        }
        let sample = LocalDelivery {
            topic,
            payload: Bytes::from(payload),
            source,
            status,
            instance,
            kept,
            lasting,
        };
        self.observe(|observer| observer.received(&sample));
        match self.port.publish(sample) {
            Ok(()) => {
                self.router.published(topic, arrived, now());
                if self.handed(topic, instance) == Some(Handover::Nobody) {
                    let cause = (Reason::NoSubscriber, NO_SUBSCRIBER);
                    self.router.lost(Some(topic), 1, cause);
                }
            }
            Err(NO_SUBSCRIBER) => {
                self.router.published(topic, arrived, now());
                let cause = (Reason::NoSubscriber, NO_SUBSCRIBER);
                self.router.lost(Some(topic), 1, cause);
                let _reported = self.handed(topic, instance);
            }
            Err(why) => self.router.not_published(topic, instance, why),
        }
    }

    /// Reports the handover of a delivery, if it is to be confirmed, and returns it.
    fn handed(&mut self, topic: TopicId, instance: Option<Timestamp>) -> Option<Handover> {
        if !self.router.is_to_confirm(topic, instance) {
            return None;
        }
        let handover = self.port.handover(topic);
        self.router.handed(topic, instance, handover);
        Some(handover)
    }
}

fn not_sent(error: SendError) -> Reason {
    if error == SendError::TooBig {
        Reason::TooBig
    } else {
        Reason::NotSent
    }
}

fn tell(notice: &DropNotice, name: Option<&str>) {
    let DropNotice {
        topic,
        from,
        reason,
        total,
        detail,
    } = notice;
    let topic = topic.map(tracing::field::display);
    let from = from.map(tracing::field::display);
    warn!(topic, from, reason = %reason, total, name, "dropped: {detail}");
}

/// The maximal number of outputs carried out before the other branches are polled. If sending is
/// slower than the Router produces parts of large messages, there is always a further output.
const DRAINED_AT_ONCE: usize = 64;
/// The maximal number of probes of the observer in a second.
const MOST_PROBES: usize = 8;
/// How long the end of the program waits for pending cancellations.
const PENDING_AT_END: Duration = Duration::from_secs(5);
/// How long the end of the program waits for the network.
const CLOSING: Duration = Duration::from_secs(2);
/// A deadline for when there is nothing to wait for.
const FAR: Duration = Duration::from_secs(3600);
