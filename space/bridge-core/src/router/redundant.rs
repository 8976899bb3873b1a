//! Redundant bridges of the own space: a standby receives everything and sends nothing, and an
//! active bridge continues where the former active bridge ended.

mod senders;

use std::collections::{BTreeMap, HashMap};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::{Lasting, TopicId, Variable};
use uadp::{MessageKind, NetworkMessage, NetworkMessageType, Timestamp};

pub(super) use self::senders::RedundantSenders;
use super::{About, Router, Values};
use crate::counters::Reason;
use crate::loop_rule::Owned;
use crate::output::{Delivery, Kept, Output};
use crate::place::Place;
use crate::redundancy::{
    Heartbeat, Rank, Redundancy, RoleChange, SenderClocks, SentAt, SwitchRefusal, TakeoverCause,
};
use crate::settings::Now;
use crate::topic::{Item, Role, Topic};
use crate::topics::Handle;
use crate::writer::{MAX_KEPT, Message};

/// The redundancy of the own space.
#[derive(Debug)]
pub(super) struct Redundant {
    state: Redundancy,
    /// The states of other spaces that were received while this bridge was muted.
    held: BTreeMap<TopicId, Vec<HeldState>>,
    /// The reactions to the loss of a commander that were due while this bridge was muted.
    losses: BTreeMap<TopicId, (Instant, Delivery)>,
    /// The number of muted samples of each own topic since the active bridge was last received.
    unsure: BTreeMap<TopicId, u64>,
    /// The last message of the active bridge for each own topic with a state.
    followed: HashMap<TopicId, Followed>,
    /// The last takeover, as long as this program is active.
    took_over: Option<Succession>,
    /// The clocks of the senders in the group.
    clocks: SenderClocks,
    /// Whether the local side takes values while this program is a standby.
    shows_values: bool,
    /// Samples of the own space that were not sent while this bridge was muted.
    muted_sent: u64,
    /// Samples of other spaces that were not published while this bridge was muted.
    muted_delivered: u64,
}

/// A takeover by this program.
#[derive(Debug, Clone, Copy)]
struct Succession {
    at: Now,
    /// Whether another bridge may have been active before.
    is_of_another: bool,
}

/// A state of another space.
#[derive(Debug)]
struct HeldState {
    at: Instant,
    delivery: Delivery,
}

/// A message of the active bridge that no own sample equals yet.
#[derive(Debug)]
struct Followed {
    fields: Vec<u8>,
    stamp: Timestamp,
}

/// What a muted or active bridge did with samples, for the status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MutedSamples {
    /// Samples of the own space that were not sent to the group.
    pub sent: u64,
    /// Samples of other spaces that were not published on the local side.
    pub delivered: u64,
}

impl Router {
    /// Makes this program one of several redundant bridges of its space. It is muted until it takes
    /// over. Call it after [`set_instance`](Self::set_instance).
    pub fn set_redundancy(&mut self, rank: Rank, now: Now) {
        let [.., a, b, c, d] = self.instance;
        let instance = u32::from_le_bytes([a, b, c, d]);
        self.values.redundant = Some(Box::new(Redundant {
            state: Redundancy::new(rank, instance, now),
            held: BTreeMap::new(),
            losses: BTreeMap::new(),
            unsure: BTreeMap::new(),
            followed: HashMap::new(),
            took_over: None,
            clocks: SenderClocks::new(now),
            shows_values: false,
            muted_sent: 0,
            muted_delivered: 0,
        }));
    }

    /// Lets the local side take the values of other spaces while this program is a standby, as for
    /// a server that shows them to clients. Call it after [`set_redundancy`](Self::set_redundancy).
    pub fn show_values_at_standby(&mut self) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.shows_values = true;
        }
    }

    /// Returns the state of the redundancy; `None` for a program without redundancy.
    #[must_use]
    pub fn redundancy(&self) -> Option<&Redundancy> {
        self.values.redundancy()
    }

    /// Returns whether another redundant bridge of the space publishes on the local side, or may
    /// do so.
    #[must_use]
    pub fn is_standby(&self) -> bool {
        self.values.is_muted_locally()
    }

    /// Returns the number of samples that were muted.
    #[must_use]
    pub fn muted_samples(&self) -> Option<MutedSamples> {
        let redundant = self.values.redundant.as_ref()?;
        Some(MutedSamples {
            sent: redundant.muted_sent,
            delivered: redundant.muted_delivered,
        })
    }

    /// Returns whether this program takes over at the next
    /// [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn takes_over(&self, now: Instant) -> bool {
        self.redundancy().is_some_and(|state| state.takes_over(now))
    }

    /// Defers the takeover, because datagrams that have arrived are not handled yet. A takeover is
    /// deferred for at most 1 s.
    pub fn defer_takeover(&mut self, now: Instant) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.state.defer(now);
        }
    }

    /// Sets whether the local side is within reach.
    pub fn set_fit(&mut self, is_fit: bool) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.state.set_fit(is_fit);
        }
    }

    /// Hands over to a standby.
    ///
    /// # Errors
    /// This program is not active, or there is no standby.
    pub fn switch_over(&mut self, now: Now) -> Result<(), SwitchRefusal> {
        let redundant = self
            .values
            .redundant
            .as_mut()
            .ok_or(SwitchRefusal::NotActive)?;
        // The lease may have ended.
        if let Some(change) = redundant.state.check(now) {
            self.change_role(change, now);
            return Err(SwitchRefusal::NotActive);
        }
        let change = redundant.state.switch_over(now)?;
        self.change_role(change, now);
        self.look_at_redundancy(now);
        Ok(())
    }

    /// Records whether the network took the last heartbeat.
    pub fn heartbeat_sent(&mut self, is_sent: bool, now: Now) {
        let Some(redundant) = &mut self.values.redundant else {
            return;
        };
        let change = match is_sent {
            true => redundant.state.sent(now),
            false => redundant.state.not_sent(now),
        };
        if let Some(change) = change {
            self.change_role(change, now);
        }
    }

    /// Records that there were no keys for a heartbeat.
    pub(super) fn heartbeat_not_sealed(&mut self, now: Now) {
        let redundant = self.values.redundant.as_mut();
        let change = redundant.and_then(|redundant| redundant.state.not_sealed(now));
        if let Some(change) = change {
            self.change_role(change, now);
        }
    }

    pub(super) fn redundancy_due(&self) -> Option<Instant> {
        self.values
            .redundant
            .as_ref()
            .map(|redundant| redundant.state.due())
    }

    /// Mutes this program if its lease has ended. Called before each output.
    pub(super) fn check_lease(&mut self, now: Now) {
        let redundant = self.values.redundant.as_mut();
        if let Some(change) = redundant.and_then(|redundant| redundant.state.check(now)) {
            self.change_role(change, now);
        }
    }

    /// Sends the heartbeat if it is due, and takes over if the active bridge is lost.
    pub(super) fn look_at_redundancy(&mut self, now: Now) {
        self.check_lease(now);
        let Some(redundant) = &mut self.values.redundant else {
            return;
        };
        let (heartbeat, change) = redundant.state.poll(now);
        if let Some(change) = change {
            self.change_role(change, now);
        }
        if heartbeat.is_some() {
            self.send_heartbeat(now);
        }
    }

    /// Queues the heartbeat before all other outputs.
    fn send_heartbeat(&mut self, now: Now) {
        let mut bytes = self.values.buffer();
        let own = self.values.settings.own;
        let Some(redundant) = &self.values.redundant else {
            return;
        };
        let heartbeat = redundant.state.heartbeat();
        match heartbeat.encode(own, now.utc, &mut bytes) {
            Ok(()) => self.values.told.push_front(Output::Heartbeat { bytes }),
            Err(_) => self.values.recycle(bytes),
        }
    }
}

impl Values {
    /// Returns the state of the redundancy.
    pub(super) fn redundancy(&self) -> Option<&Redundancy> {
        self.redundant.as_ref().map(|redundant| &redundant.state)
    }

    /// Returns whether the sender is another bridge of the own space.
    pub(super) fn is_redundant_peer(&self, from: SocketAddr) -> bool {
        self.redundancy().is_some_and(|state| state.is_peer(from))
    }

    /// Returns whether nothing is sent to the group.
    pub(super) fn is_muted(&self) -> bool {
        let redundant = self.redundant.as_ref();
        redundant.is_some_and(|redundant| redundant.state.mutes_group())
    }

    /// Returns whether the local side takes values while this program is a standby.
    pub(super) fn shows_values(&self) -> bool {
        let redundant = self.redundant.as_ref();
        redundant.is_some_and(|redundant| redundant.shows_values)
    }

    /// Returns whether nothing is published on the local side.
    pub(super) fn is_muted_locally(&self) -> bool {
        let redundant = self.redundant.as_ref();
        redundant.is_some_and(|redundant| !redundant.shows_values && redundant.state.mutes_local())
    }
}

impl Router {
    /// Returns whether an output is dropped, because another bridge sends it. Samples are muted
    /// where they are polled.
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "all other outputs are for this program"
    )]
    pub(super) fn mutes(&mut self, output: &Output) -> bool {
        match output {
            Output::Retired { topic, instance } => self.drop_held_states(*topic, Some(*instance)),
            Output::Silent {
                topic,
                silent: true,
                ..
            } => self.drop_held_states(*topic, None),
            _ => {}
        }
        if !self.values.is_muted() {
            return false;
        }
        match output {
            Output::Action { .. } => true,
            // Probes are sent, so that a standby learns what the active bridge knows.
            Output::Discovery { bytes } => !NetworkMessage::decode(bytes)
                .is_ok_and(|message| message.message_type() == NetworkMessageType::Probe),
            _ => false,
        }
    }

    /// Takes back the buffer of a muted output.
    pub(super) fn drop_muted(&mut self, output: Output) {
        if let Output::Action { bytes, .. } | Output::Discovery { bytes } = output {
            self.values.recycle(bytes);
        }
    }

    /// Handles the heartbeat of a redundant bridge. Returns false for all other messages.
    pub(super) fn is_heartbeat(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) -> bool {
        let Some((space, heartbeat)) = Heartbeat::decode(message) else {
            return false;
        };
        if self.security.is_on() && !self.security.is_authentic() {
            let cause = (Reason::Unsecured, "heartbeat");
            self.values.count(About::sender(from), cause, 1, || {
                "its heartbeat is in clear, and there are secured groups".to_owned()
            });
            return true;
        }
        // In space 0, other programs share the space with redundant servers.
        let is_shared = self.values.redundant.is_none() && self.values.owned != Owned::All;
        if space != self.values.settings.own || is_shared {
            let at = (from, now.monotonic);
            self.redundant_senders.meet(space, heartbeat, at);
            return true;
        }
        let Some(redundant) = &mut self.values.redundant else {
            self.values.drop_own(None, from, now);
            return true;
        };
        let change = redundant.state.hear(heartbeat, from, now);
        if redundant.state.is_followed(from) && heartbeat.is_active() {
            redundant.unsure.clear();
        }
        if let Some(change) = change {
            self.change_role(change, now);
        }
        true
    }

    /// Follows a message of the own space from another bridge. Returns false if the sender is no
    /// redundant bridge of the space.
    pub(super) fn follow_peer(
        &mut self,
        message: &NetworkMessage<'_>,
        namespace: Option<u16>,
        from: SocketAddr,
        now: Now,
    ) -> bool {
        let Some(redundant) = &self.values.redundant else {
            return false;
        };
        if !redundant.state.is_peer(from) {
            return false;
        }
        if message.message_type() != NetworkMessageType::DataSet || message.is_action() {
            return true;
        }
        if !redundant.state.is_followed(from) {
            if redundant.state.mutes_group() {
                return true;
            }
            let cause = (Reason::Takeover, "rival");
            self.values.count(About::sender(from), cause, 1, || {
                format!("{from} sent a value while this bridge was active: it may be doubled")
            });
            return true;
        }
        let Some(namespace) = namespace else {
            return true;
        };
        let space = u16::from(self.values.settings.own.get());
        if message.is_chunk() {
            let writer = message.writer_ids().and_then(|mut ids| ids.next());
            let topic = writer.and_then(|writer| TopicId::new(space, namespace, writer));
            if let (Some(topic), Ok(chunk)) = (topic, message.chunk()) {
                let next = chunk.message_sequence_number.wrapping_add(1);
                self.follow_number(topic, next, None);
            }
            return true;
        }
        for message in message.messages().filter_map(Result::ok) {
            let writer = message.writer_id.unwrap_or_default();
            let Some(topic) = TopicId::new(space, namespace, writer) else {
                continue;
            };
            let header = message.header();
            let Some(sequence) = header.sequence_number else {
                continue;
            };
            if message.kind == MessageKind::KeepAlive {
                self.follow_number(topic, sequence, None);
                continue;
            }
            let stamp = header.timestamp.map(|time| Timestamp {
                time,
                picoseconds: header.picoseconds.unwrap_or_default(),
            });
            self.follow_number(topic, sequence.wrapping_add(1), stamp);
            if let (Some(stamp), Ok(fields)) = (stamp, message.fields()) {
                self.follow_state(topic, fields.bytes(), (stamp, now));
            }
        }
        true
    }

    /// Continues with the sequence number and the time of the active bridge.
    fn follow_number(&mut self, topic: TopicId, next: u16, stamp: Option<Timestamp>) {
        // Topics of unknown names are not created: any sender in the group can invent names.
        if let Some(writer) = self.values.topics.writer_of(topic) {
            writer.follow(next, stamp);
        }
    }

    /// Takes the stamp of the active bridge for an equal state, so that readers recognise the
    /// repetitions of this bridge after a takeover.
    fn follow_state(&mut self, topic: TopicId, fields: &[u8], (stamp, now): (Timestamp, Now)) {
        let Some(Topic {
            role: Role::Ours(writer),
            lasting,
            ..
        }) = self.values.topics.get_mut(&topic)
        else {
            return;
        };
        let Some(redundant) = self
            .values
            .redundant
            .as_mut()
            .filter(|_| *lasting != Lasting::Event)
        else {
            return;
        };
        if writer.adopt(fields, stamp) {
            redundant.followed.remove(&topic);
            return;
        }
        writer.disown(now.utc);
        let followed = redundant.followed.entry(topic);
        let followed = followed.or_insert_with(|| Followed {
            fields: Vec::new(),
            stamp,
        });
        followed.stamp = stamp;
        followed.fields.clear();
        followed.fields.extend_from_slice(fields);
    }
}

impl Values {
    /// Takes the stamp of the active bridge for a sample of this muted bridge, if the message of
    /// the active bridge was received first.
    pub(super) fn adopt_followed(&mut self, topic: TopicId) {
        let Some(redundant) = &mut self.redundant else {
            return;
        };
        let Some(writer) = self.topics.writer_of(topic) else {
            return;
        };
        if let Some(followed) = redundant.followed.get(&topic)
            && writer.adopt(&followed.fields, followed.stamp)
        {
            redundant.followed.remove(&topic);
        }
    }

    /// Drops the waiting samples of an own topic, because another bridge sends them.
    pub(super) fn mute_own(&mut self, topic: TopicId) {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        entry.ready = false;
        if let Role::Ours(writer) = &mut entry.role {
            writer.end_repetitions();
        }
        let mut dropped = u64::from(entry.sending.take().is_some());
        while let Some(item) = self.topics.get_mut(&topic).and_then(|of| of.queue.pop()) {
            if let Item::Message(Message::Datagram(encoded)) = item {
                dropped += u64::from(!encoded.is_keep_alive());
                // The next message in the buffer must not follow this one.
                self.recycle(encoded.bytes);
            } else {
                dropped += 1;
            }
        }
        let Some(redundant) = self.redundant.as_mut().filter(|_| dropped > 0) else {
            return;
        };
        if redundant.state.is_cut() {
            let cause = (Reason::NotSent, "cut off");
            self.count(About::topic(topic), cause, dropped, || {
                "the group is out of reach".to_owned()
            });
            return;
        }
        redundant.muted_sent += dropped;
        let unsure = redundant.unsure.entry(topic).or_default();
        *unsure = unsure.saturating_add(dropped);
    }

    /// Takes a delivery that another bridge publishes. A state is held for a takeover.
    pub(super) fn mute_delivery(&mut self, delivery: Delivery, now: Now) {
        let topic = delivery.topic;
        // The local side has the value from the active bridge.
        if let Some(at) = self.topics.find(topic) {
            self.is_good(at, now);
        }
        let Some(redundant) = &mut self.redundant else {
            return;
        };
        redundant.muted_delivered += 1;
        redundant.losses.remove(&topic);
        if !delivery.lasting {
            self.recycle(delivery.payload);
            return;
        }
        let held = redundant.held.entry(topic).or_default();
        let is_again = delivery.kept == Kept::Again;
        if delivery.kept == Kept::Alone {
            held.clear();
        }
        let same = held
            .iter()
            .position(|one| one.delivery.instance == delivery.instance);
        match same {
            Some(_) if is_again => return,
            Some(same) => {
                held.remove(same);
            }
            None if held.len() >= MAX_KEPT => {
                held.remove(0);
            }
            None => {}
        }
        held.push(HeldState {
            at: now.monotonic,
            delivery,
        });
    }

    /// Holds the reaction to the loss of a commander for a takeover.
    pub(super) fn mute_loss(&mut self, delivery: Delivery, now: Now) {
        if let Some(redundant) = &mut self.redundant {
            let held = (now.monotonic, delivery);
            redundant.losses.insert(held.1.topic, held);
        }
    }
}

impl Router {
    /// Drops the held states of a topic that are no current values any more.
    fn drop_held_states(&mut self, topic: TopicId, instance: Option<Timestamp>) {
        let Some(redundant) = &mut self.values.redundant else {
            return;
        };
        match (instance, redundant.held.get_mut(&topic)) {
            (Some(_), Some(held)) => held.retain(|one| one.delivery.instance != instance),
            (None, Some(_)) => {
                redundant.held.remove(&topic);
            }
            (_, None) => {}
        }
    }
}

impl Values {
    /// Returns the relation of a received message to the last takeover, as long as this program is
    /// active and the network may still hold messages that precede the takeover.
    pub(super) fn since_takeover(&self, place: &Place, now: Now) -> Option<SinceTakeover> {
        let redundant = self.redundant.as_ref()?;
        let Succession { at, is_of_another } = redundant.took_over?;
        if now.monotonic.saturating_duration_since(at.monotonic) >= HELD_AT_MOST {
            return None;
        }
        let sent_at = place
            .sent
            .and_then(|sent| redundant.clocks.sent_at(place.from, sent, at.monotonic));
        Some(SinceTakeover {
            at,
            is_of_another,
            sent_at,
            now,
        })
    }
}

impl Router {
    /// Records the clock of the sender of a message that was processed.
    pub(super) fn note_clock(&mut self, sent: Option<Timestamp>, from: SocketAddr, now: Now) {
        // Unsecured messages of a secured group can be forged.
        let is_trusted = !self.security.is_on() || self.security.is_authentic();
        if let Some(redundant) = self.values.redundant.as_mut().filter(|_| is_trusted)
            && let Some(sent) = sent.filter(|sent| sent.time.0 != 0)
        {
            redundant.clocks.note(from, sent, now.monotonic);
        }
    }

    fn change_role(&mut self, change: RoleChange, now: Now) {
        match change {
            RoleChange::TookOver { gap, cause, .. } => self.unmute((gap, cause), now),
            RoleChange::Muted { .. } => self.mute_all(now),
            RoleChange::CutOff
            | RoleChange::Follows { .. }
            | RoleChange::Rival { .. }
            | RoleChange::SameRank { .. } => {}
        }
        self.values.tell(Output::Role(change));
    }

    /// Empties all queues.
    fn mute_all(&mut self, now: Now) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.followed.clear();
            redundant.unsure.clear();
            redundant.took_over = None;
        }
        self.call_traffic().end_term(now);
        for at in self.values.topics.handles() {
            self.values.mute_topic(at.topic(), now);
            self.values.withdraw_states(at);
        }
        self.values.paced.clear();
        // A heartbeat that was made before is outdated.
        self.values.told.retain(|told| {
            !matches!(
                told,
                Output::CommanderLost { .. } | Output::Heartbeat { .. }
            )
        });
    }
}

impl Values {
    /// Empties the queue of a topic if it is muted. Returns false if it is not muted.
    pub(super) fn mute_topic(&mut self, topic: TopicId, now: Now) -> bool {
        let is_muted = match self.is_home(topic) {
            true => self.is_muted(),
            false => self.is_muted_locally(),
        };
        if is_muted {
            self.empty_topic(topic, now);
        }
        is_muted
    }

    /// Lets the next repetition of a state of another space reach the late joiners of the local
    /// side, which drops its stored values when this bridge is muted. A command is not delivered
    /// again.
    fn withdraw_states(&mut self, at: Handle) {
        if let Some(Topic {
            role: Role::Theirs(reader),
            confirming: None,
            ..
        }) = self.topics.at_mut(at)
        {
            reader.withdraw();
        }
    }

    /// Returns the variable of a topic that clients of this server write. They are connected to a
    /// single server; values of other servers and reports of alarms reach all redundant servers.
    fn written_by_clients(&self, topic: TopicId) -> Option<&Variable> {
        let variable = self.mapping.variable(topic);
        let written = variable.filter(|of| of.from.is_none() && !of.reports_alarms);
        written.filter(|_| self.shows_values())
    }

    fn empty_topic(&mut self, topic: TopicId, now: Now) {
        if self.is_home(topic) {
            return self.mute_own(topic);
        }
        while let Some(item) = self.topics.get_mut(&topic).and_then(|of| of.queue.pop()) {
            if let Item::Delivery(delivery) = item {
                self.mute_delivery(delivery, now);
            }
        }
        if let Some(entry) = self.topics.get_mut(&topic) {
            entry.ready = false;
        }
    }
}

impl Router {
    /// Continues where the former active bridge ended. `gap` is the time since its last heartbeat.
    fn unmute(&mut self, (gap, cause): (Option<Duration>, TakeoverCause), now: Now) {
        // The former active bridge may have sent or published what waits since the last output.
        let topics = self.values.topics.handles();
        for at in &topics {
            self.values.empty_topic(at.topic(), now);
        }
        let Some(redundant) = &mut self.values.redundant else {
            return;
        };
        redundant.took_over = Some(Succession {
            at: now,
            is_of_another: cause != TakeoverCause::Start,
        });
        redundant.followed.clear();
        let held = std::mem::take(&mut redundant.held);
        let losses = std::mem::take(&mut redundant.losses);
        let unsure = std::mem::take(&mut redundant.unsure);
        // The former active bridge was received at this time, and its next heartbeat was missed.
        let unsure_since = gap.and_then(|gap| now.monotonic.checked_sub(gap));
        let is_unsure = |at: Instant| unsure_since.is_none_or(|since| at >= since);
        for (topic, count) in unsure {
            let cause = (Reason::Takeover, "gap");
            self.values
                .count_only(About::topic(topic), cause, count, String::new);
        }
        for at in topics {
            self.continue_own(at, now);
        }
        for (topic, states) in held {
            for HeldState { at, mut delivery } in states {
                if !is_unsure(at) {
                    // The former active bridge has published it: it is for late joiners only.
                    delivery.kept = Kept::Again;
                }
                self.values.push_to(topic, Item::Delivery(delivery));
            }
        }
        for (topic, (at, delivery)) in losses {
            if is_unsure(at) {
                self.values.tell(Output::CommanderLost { topic });
                self.values.push_to(topic, Item::Delivery(delivery));
            } else {
                self.values.recycle(delivery.payload);
            }
        }
        // Its confirmations count after its announcement.
        self.announcements.plan_application(now);
        self.call_traffic().begin_term(now);
    }

    /// Continues the sequence numbers of an own topic, and repeats its state. A state that clients
    /// of a server wrote is forgotten: another server may have sent a newer value.
    fn continue_own(&mut self, at: Handle, now: Now) {
        let written = self.values.written_by_clients(at.topic());
        let is_written = written.is_some();
        let stops = written.is_some_and(|of| of.loss.is_some());
        let Some(Topic {
            role: Role::Ours(writer),
            queue,
            gate,
            lasting,
            announce_at,
            ready,
            ..
        }) = self.values.topics.at_mut(at)
        else {
            return;
        };
        while queue.pop().is_some() {}
        if is_written {
            writer.keep_nothing();
        }
        if stops {
            // Its commander had a session with the former active server.
            writer.set_live(false);
        }
        writer.continue_after(SKIPPED);
        if writer.is_live() {
            writer.begin_round(now.monotonic);
        }
        *announce_at = announce_at.map(|_| now.monotonic);
        // The former active bridge may have sent it.
        let is_outdated = is_written || *lasting == Lasting::Event;
        let held = gate.as_mut().filter(|_| is_outdated);
        let outdated = held.and_then(|gate| gate.drop_held());
        let repeats = writer.repeats();
        if repeats && !*ready {
            *ready = true;
            self.values.ready.push_back(at);
        }
        if let Some((outdated, _)) = outdated {
            self.values.recycle(outdated.bytes);
            let cause = (Reason::Takeover, "gap");
            self.values
                .count_only(About::topic(at.topic()), cause, 1, String::new);
        }
        self.values.schedule(at);
    }
}

/// The relation of a received message to the last takeover.
#[derive(Debug, Clone, Copy)]
pub(super) struct SinceTakeover {
    at: Now,
    is_of_another: bool,
    /// The time at which the message was sent, if the clock of its sender was known before the
    /// takeover.
    sent_at: Option<SentAt>,
    now: Now,
}

impl SinceTakeover {
    /// Returns whether an event was first sent before the takeover: the former active bridge may
    /// have delivered it. `within` is the time for which a command is repeated until it is
    /// confirmed; `None` for other events.
    ///
    /// A command that cannot be dated counts as earlier for a second after another bridge was
    /// active.
    pub(super) fn is_preceded_by(
        self,
        place: &Place,
        (lasting, within): (Lasting, Option<Duration>),
    ) -> bool {
        let age = place.stamp.zip(place.sent).map(|(stamp, sent)| {
            let age = sent.unix_nanos() - stamp.unix_nanos();
            Duration::from_nanos(u64::try_from(age.max(0)).unwrap_or(u64::MAX))
        });
        // The repetitions of an event end after this time. A longer age is that of a stored state,
        // or the stamp is from another clock.
        let longest = within.unwrap_or_default().max(OLDEST_EVENT);
        let is_event = match lasting {
            Lasting::State => false,
            Lasting::Event => true,
            Lasting::AsSource => age.is_none_or(|age| age < longest),
        };
        if !is_event {
            return false;
        }
        let (Some(age), Some(sent)) = (age, place.sent) else {
            let is_command = within.is_some() && self.is_of_another;
            let passed = self.now.monotonic - self.at.monotonic;
            return is_command && passed < CLOCKS_DIFFER;
        };
        let age = age.min(longest);
        let first = match (self.sent_at, within.filter(|_| self.is_of_another)) {
            (Some(SentAt::BeforeStart), _) => None,
            (Some(SentAt::Since(sent)), _) => sent.checked_sub(age),
            // Only the clocks of the two hosts can be compared.
            (None, Some(_)) => {
                let age = i128::try_from(age.as_nanos()).unwrap_or(i128::MAX);
                let since = sent.unix_nanos() - age - self.at.utc.unix_nanos();
                return since < i128::try_from(CLOCKS_DIFFER.as_nanos()).unwrap_or(i128::MAX);
            }
            (None, None) => self.now.monotonic.checked_sub(age),
        };
        first.is_none_or(|first| first + SLACK < self.at.monotonic)
    }
}

/// The number of sequence numbers that are skipped at a takeover: more than the former active
/// bridge can have sent after its last message that this bridge received, and less than readers
/// take for a restart (OPC 10000-14, 7.2.3).
const SKIPPED: u16 = 1_024;
/// The age from which a value is a stored state and no event. Events without confirmation are
/// repeated for a shorter time.
const OLDEST_EVENT: Duration = Duration::from_millis(500);
/// The time by which the clocks of the writer and of the network may differ. The former active
/// bridge has sent nothing for longer at a takeover.
const SLACK: Duration = Duration::from_millis(5);
/// The time by which the clocks of two hosts may differ.
const CLOCKS_DIFFER: Duration = Duration::from_secs(1);
/// The longest time for which a network holds a datagram back.
const HELD_AT_MOST: Duration = Duration::from_secs(10);
