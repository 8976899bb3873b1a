//! The values of a muted bridge: it receives everything and sends nothing, and follows the messages
//! of the active bridge.

use std::net::SocketAddr;

use mappings::{Lasting, TopicId, Variable};
use uadp::{MessageKind, NetworkMessage, NetworkMessageType, Timestamp};

use super::about::DropSite;
use super::redundant::SinceTakeover;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::message::SampleMessage;
use crate::output::{Delivery, Output};
use crate::place::SequencePosition;
use crate::redundancy::Redundancy;
use crate::settings::Now;
use crate::topic::{PolledSample, Topic, TopicSide};
use crate::topics::Handle;

impl TopicQueues {
    /// Returns the state of the redundancy.
    pub(super) fn redundancy(&self) -> Option<&Redundancy> {
        self.redundant.as_ref().map(|redundant| redundant.state())
    }

    /// Returns whether the sender is another bridge of the own space.
    pub(super) fn is_redundant_peer(&self, from: SocketAddr) -> bool {
        self.redundancy().is_some_and(|state| state.is_peer(from))
    }

    /// Returns whether nothing is sent to the group.
    pub(super) fn is_muted(&self) -> bool {
        self.redundancy().is_some_and(Redundancy::mutes_group)
    }

    /// Returns whether the local side takes values while this program is a standby.
    pub(super) fn shows_values(&self) -> bool {
        let redundant = self.redundant.as_ref();
        redundant.is_some_and(|redundant| redundant.shows_values())
    }

    /// Returns whether nothing is published on the local side.
    pub(super) fn is_muted_locally(&self) -> bool {
        let redundant = self.redundant.as_ref();
        redundant.is_some_and(|redundant| redundant.mutes_local())
    }

    /// Returns whether an output is dropped, because another bridge sends it. Samples are muted
    /// where they are polled.
    pub(super) fn mutes(&mut self, output: &Output) -> bool {
        if let Output::Retired { topic, instance } = output {
            self.drop_held(*topic, Some(*instance));
        }
        if let Output::Silent {
            topic,
            silent: true,
            ..
        } = output
        {
            self.drop_held(*topic, None);
        }
        if !self.is_muted() {
            return false;
        }
        match output {
            Output::Action { .. } => true,
            // Probes are sent: a standby needs the announcements that the active bridge has.
            Output::Discovery { bytes } => !NetworkMessage::decode(bytes)
                .is_ok_and(|message| message.message_type() == NetworkMessageType::Probe),
            // Datagrams are muted where they are polled. All other outputs are for this program.
            Output::Datagram { .. }
            | Output::Heartbeat { .. }
            | Output::Role(_)
            | Output::Delivery(_)
            | Output::Unbound { .. }
            | Output::Silent { .. }
            | Output::CommanderLost { .. }
            | Output::Retired { .. }
            | Output::Answer { .. }
            | Output::CallKnown { .. }
            | Output::CallGone { .. }
            | Output::Execute(_)
            | Output::Abandoned { .. }
            | Output::Settled { .. }
            | Output::HandoverWanted { .. }
            | Output::Taken { .. }
            | Output::KeysWanted { .. }
            | Output::Notice(_) => false,
        }
    }

    /// Takes back the buffer of a muted output.
    pub(super) fn drop_muted(&mut self, output: Output) {
        if let Output::Action { bytes, .. } | Output::Discovery { bytes } = output {
            self.recycle(bytes);
        }
    }

    /// Drops the held states of a topic that are no current values any more.
    fn drop_held(&mut self, topic: TopicId, instance: Option<Timestamp>) {
        if let Some(redundant) = &mut self.redundant {
            redundant.drop_held(topic, instance);
        }
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
        let Some(state) = self.redundancy().filter(|state| state.is_peer(from)) else {
            return false;
        };
        if message.message_type() != NetworkMessageType::DataSet || message.is_action() {
            return true;
        }
        if !state.is_followed(from) {
            if state.mutes_group() {
                return true;
            }
            let cause = (Reason::Takeover, "rival");
            self.count(DropSite::sender(from), cause, 1, || {
                format!("{from} sent a value while this bridge was active: it may be doubled")
            });
            return true;
        }
        let Some(namespace) = namespace else {
            return true;
        };
        let space = u16::from(self.settings.own.get());
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
        if let Some(writer) = self.topics.writer_of(topic) {
            writer.follow(next, stamp);
        }
    }

    /// Takes the stamp of the active bridge for an equal state.
    fn follow_state(&mut self, topic: TopicId, fields: &[u8], at: (Timestamp, Now)) {
        let Some(Topic {
            role: TopicSide::Ours(writer),
            lasting,
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return;
        };
        if let Some(redundant) = &mut self.redundant
            && *lasting != Lasting::Event
        {
            redundant.follow_state((topic, writer), fields, at);
        }
    }

    /// Takes the stamp of the active bridge for a sample of this muted bridge, if the message of
    /// the active bridge was received first.
    pub(super) fn adopt_followed(&mut self, topic: TopicId) {
        if let Some(redundant) = &mut self.redundant
            && let Some(writer) = self.topics.writer_of(topic)
        {
            redundant.adopt_followed(topic, writer);
        }
    }

    /// Returns the relation of a received message to the last takeover, as long as this program is
    /// active and the network may still hold messages that precede the takeover.
    pub(super) fn since_takeover(
        &self,
        place: &SequencePosition,
        now: Now,
    ) -> Option<SinceTakeover> {
        self.redundant.as_ref()?.since_takeover(place, now)
    }

    /// Empties the queue of a topic if it is muted. Returns false if it is not muted.
    pub(super) fn mute_topic(&mut self, topic: TopicId, now: Now) -> bool {
        let is_muted = if self.is_home(topic) {
            self.is_muted()
        } else {
            self.is_muted_locally()
        };
        if is_muted {
            self.empty_topic(topic, now);
        }
        is_muted
    }

    /// Empties the queue of a topic, because another bridge sends or delivers its samples.
    pub(super) fn empty_topic(&mut self, topic: TopicId, now: Now) {
        if self.is_home(topic) {
            return self.mute_own(topic);
        }
        while let Some(item) = self.topics.get_mut(&topic).and_then(|of| of.queue.pop()) {
            if let PolledSample::Delivery(delivery) = item {
                self.mute_delivery(delivery, now);
            }
        }
        if let Some(entry) = self.topics.get_mut(&topic) {
            entry.ready = false;
        }
    }

    /// Drops the waiting samples of an own topic, because another bridge sends them.
    fn mute_own(&mut self, topic: TopicId) {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        entry.ready = false;
        if let TopicSide::Ours(writer) = &mut entry.role {
            writer.end_repetitions();
        }
        let mut dropped = u64::from(entry.sending.take().is_some());
        while let Some(item) = self.topics.get_mut(&topic).and_then(|of| of.queue.pop()) {
            if let PolledSample::Message(SampleMessage::Datagram(encoded)) = item {
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
        if redundant.state().is_cut() {
            let cause = (Reason::NotSent, "cut off");
            self.count(DropSite::topic(topic), cause, dropped, || {
                "the group is out of reach".to_owned()
            });
            return;
        }
        redundant.note_unsent(topic, dropped);
    }

    /// Takes a delivery that another bridge publishes. A state is held for a takeover.
    fn mute_delivery(&mut self, delivery: Delivery, now: Now) {
        // The local side has the value from the active bridge.
        if let Some(at) = self.topics.find(delivery.topic) {
            self.is_good(at, now);
        }
        if let Some(redundant) = &mut self.redundant
            && let Some(unused) = redundant.hold(delivery, now)
        {
            self.recycle(unused);
        }
    }

    /// Holds the reaction to the loss of a commander for a takeover.
    pub(super) fn mute_loss(&mut self, delivery: Delivery, now: Now) {
        if let Some(redundant) = &mut self.redundant {
            redundant.hold_loss(delivery, now);
        }
    }

    /// Lets the next repetition of a state of another space reach the late joiners of the local
    /// side, which drops its stored values when this bridge is muted. A command is not delivered
    /// again.
    pub(super) fn withdraw_states(&mut self, at: Handle) {
        if let Some(Topic {
            role: TopicSide::Theirs(reader),
            confirming: None,
            ..
        }) = self.topics.at_mut(at)
        {
            reader.withdraw();
        }
    }

    /// Continues the sequence numbers of an own topic, and repeats its state. A state that clients
    /// of a server wrote is forgotten: another server may have sent a newer value.
    pub(super) fn continue_own(&mut self, at: Handle, now: Now) {
        let written = self.written_by_clients(at.topic());
        let is_written = written.is_some();
        let stops = written.is_some_and(|of| of.loss.is_some());
        let Some(Topic {
            role: TopicSide::Ours(writer),
            queue,
            gate,
            lasting,
            announce_at,
            ready,
            ..
        }) = self.topics.at_mut(at)
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
            self.ready.push_back(at);
        }
        if let Some((outdated, _)) = outdated {
            self.recycle(outdated.bytes);
            let cause = (Reason::Takeover, "gap");
            self.count_only(DropSite::topic(at.topic()), cause, 1, String::new);
        }
        self.schedule(at);
    }

    /// Returns the variable of a topic that clients of this server write. They are connected to a
    /// single server; values of other servers and reports of alarms reach all redundant servers.
    fn written_by_clients(&self, topic: TopicId) -> Option<&Variable> {
        let variable = self.mapping.variable(topic);
        let written = variable.filter(|of| of.from.is_none() && !of.reports_alarms);
        written.filter(|_| self.shows_values())
    }
}

/// The number of sequence numbers that are skipped at a takeover: more than the former active
/// bridge can have sent after its last message that this bridge received, and less than readers
/// take for a restart (OPC 10000-14, 7.2.3).
const SKIPPED: u16 = 1_024;
