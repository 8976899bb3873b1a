//! Processing of received datagrams: header, loop rule, sequence, route, payload, in this order.

use std::net::SocketAddr;
use std::time::Duration;

use mappings::{PublisherIdRule, SpaceId, TopicId};
use uadp::{
    DataSetMessage, DecodeError, MessageKind, NetworkHeader, NetworkMessage, NetworkMessageType,
    Timestamp,
};

use super::content::ValueQuality;
use super::local_sample::LocalSample;
use super::{DropSite, Router, TopicQueues};
use crate::confirm::Confirming;
use crate::counters::Reason;
use crate::fields;
use crate::late;
use crate::loop_rule::{Crosses, Owned, Side, may_cross};
use crate::network::number_of;
use crate::output::{Delivery, Output};
use crate::place::SequencePosition;
use crate::reader::{AcceptedMessage, Handling};
use crate::settings::{Forwarding, Local, Now};
use crate::tap::Crossing;
use crate::topic::{PolledSample, Topic, TopicSide};
use crate::topics::Handle;

impl Router {
    /// Handles a datagram from the UA side. The values of its messages are queued, and errors are
    /// counted.
    pub fn handle_datagram(&mut self, datagram: &[u8], from: SocketAddr, now: Now) {
        self.handle_received(datagram, (from, None), now);
    }

    /// Handles a datagram like [`handle_datagram`](Self::handle_datagram). Its delays are measured
    /// to and from the time at which the kernel received it, if that is known. The age of a message
    /// ends at `now` in any case.
    pub fn handle_received(
        &mut self,
        datagram: &[u8],
        (from, received): (SocketAddr, Option<Timestamp>),
        now: Now,
    ) {
        self.values.received = received;
        match NetworkMessage::decode(datagram) {
            Ok(message) if self.security.is_on() => self.handle_guarded(&message, from, now),
            Ok(message) => self.handle_network_message(&message, from, now),
            Err(error) => self.values.drop_undecoded(None, from, &error),
        }
        self.values.received = None;
        self.inquire(now);
    }

    pub(super) fn handle_network_message(
        &mut self,
        message: &NetworkMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) {
        self.sort_network_message(message, from, now);
        // Chunks of a repeated request, and the request in them, have an old time.
        let may_be_repeated =
            message.is_action() || (message.is_chunk() && message.writer_ids().is_none());
        if self.values.redundant.is_some() && !may_be_repeated {
            self.roles().note_clock(sent(&message.header()), from, now);
        }
    }

    fn sort_network_message(&mut self, message: &NetworkMessage<'_>, from: SocketAddr, now: Now) {
        let header = message.header();
        let late = self
            .values
            .arrival
            .and_then(|relay| relay.judge_message(sent(&header), now.utc));
        if let Some((case, detail)) = late {
            return self
                .values
                .count(DropSite::sender(from), late::cause(case), 1, || detail);
        }
        if self.is_for_all(message, from, now)
            || self.roles().is_heartbeat(message, from, now)
            || self.is_part(message, from, now)
        {
            return;
        }
        let Some(space) = self.values.space_of(&header, from) else {
            return;
        };
        if message.message_type() != NetworkMessageType::DataSet {
            self.handle_discovery(message, (space, from), now);
            return;
        }
        let sender = (space, from);
        if self
            .redundant_senders
            .is_superseded(&mut self.values, sender, now)
        {
            return;
        }
        if message.is_action() {
            self.handle_actions(message, (space, from), now);
            return;
        }
        let namespace = header.group.and_then(|group| group.writer_group_id);
        if namespace.is_some_and(|namespace| self.values.is_unused(space, namespace)) {
            return;
        }
        if self.values.is_ours(space, namespace) {
            // A large request for an own call has the PublisherId of the own space, as a small
            // request has.
            let is_request = message.is_chunk()
                && !message.is_sealed()
                && self.calls.is_some()
                && message.writer_ids().is_none();
            let is_muted = self.values.is_muted();
            match (is_request && !is_muted, namespace) {
                (true, Some(namespace)) if self.call_traffic().may_request(namespace, from) => {
                    self.handle_chunk(message, (space, namespace), from, now);
                }
                (true, Some(_)) => {
                    let cause = (Reason::CallRefused, "chunk");
                    let about = DropSite::sender(from);
                    self.values.count(about, cause, 1, || closed_to(from));
                }
                _ if self.values.follow_peer(message, namespace, from, now) => {}
                _ if is_request && is_muted => {
                    let cause = (Reason::Takeover, "standby");
                    self.values
                        .count(DropSite::sender(from), cause, 1, String::new);
                }
                _ => self.values.drop_own(namespace, from, now),
            }
            return;
        }
        let Some(namespace) = namespace else {
            let about = DropSite::sender(from);
            return self.values.count(about, Reason::NotInSpace, 1, String::new);
        };
        // A chunk without a payload header may belong to a response, and the responding program
        // need not send values.
        let may_be_value = !message.is_chunk() || message.writer_ids().is_some();
        if let Some(calls) = &mut self.calls
            && may_be_value
        {
            calls.heard(space, namespace, from, now);
        }
        if message.is_chunk() && !message.is_sealed() {
            self.handle_chunk(message, (space, namespace), from, now);
            return;
        }
        self.handle_values(message, (space, namespace), from, now);
    }

    /// Handles the DataSetMessages of a message of another space.
    fn handle_values(
        &mut self,
        message: &NetworkMessage<'_>,
        (space, namespace): (SpaceId, u16),
        from: SocketAddr,
        now: Now,
    ) {
        let about = DropSite::sender(from);
        let sent = sent(&message.header());
        for message in message.messages() {
            let message = match message {
                Ok(message) => message,
                Err(error) => {
                    self.values.drop_undecoded(None, from, &error);
                    continue;
                }
            };
            let writer_id = message.writer_id.unwrap_or_default();
            match TopicId::new(u16::from(space.get()), namespace, writer_id) {
                Some(topic) => {
                    self.values
                        .handle_message(topic, &message, (from, sent), now);
                }
                None => self.values.count(about, Reason::NotInSpace, 1, String::new),
            }
        }
    }

    /// Sets the source address of own datagrams, for example after a change of the network
    /// interface.
    pub fn set_source(&mut self, source: SocketAddr) {
        self.values.settings.source = Some(source);
    }
}

impl TopicQueues {
    /// Returns the space of a NetworkMessage, or counts the reason why it cannot be read.
    fn space_of(&mut self, header: &NetworkHeader<'_>, from: SocketAddr) -> Option<SpaceId> {
        let (number, exact) = number_of(header.publisher_id);
        let Some(space) = u16::try_from(number).ok().and_then(SpaceId::new) else {
            self.count(DropSite::sender(from), Reason::NotInSpace, 1, String::new);
            return None;
        };
        if exact || self.mapping.pubsub().publisher_id == PublisherIdRule::AnyWidth {
            return Some(space);
        }
        self.count(DropSite::sender(from), Reason::PublisherWidth, 1, || {
            format!(
                "PublisherId {number} is not a UInt16; if that writer is meant to be space {space}, \
                 set `publisher_id: any_width`"
            )
        });
        None
    }

    /// Returns whether only this program writes messages of the group. A message without a group
    /// counts as own only if this program owns the whole space.
    pub(super) fn is_ours(&self, space: SpaceId, namespace: Option<u16>) -> bool {
        let home = namespace.map_or(self.owned == Owned::All, |namespace| {
            self.owned.has(namespace)
        });
        !may_cross(space == self.settings.own && home, Side::Ua, Crosses::Value)
    }

    /// Counts a message in the name of this program, from this program itself or from another
    /// sender.
    pub(super) fn drop_own(&mut self, namespace: Option<u16>, from: SocketAddr, now: Now) {
        let own = self.settings.own;
        if self.is_source(from) {
            self.count(DropSite::sender(from), Reason::Looped, 1, String::new);
            return;
        }
        let shared = namespace.filter(|_| self.owned != Owned::All);
        if let Some(namespace) = shared {
            self.contend(namespace, from, now);
        }
        // `Output::Taken` already reported that nothing is sent in the namespace.
        let told = shared.is_some_and(|namespace| self.claims.is_taken(namespace));
        self.count(DropSite::sender(from), Reason::SpaceTaken, 1, || match shared {
            Some(_) if told => String::new(),
            Some(namespace) => format!(
                "another program writes namespace {namespace} of space {own}, so every sample is sent \
                 twice; give one of the programs another namespace"
            ),
            None => format!(
                "another program sends as space {own}, so every sample is sent twice; stop one of the programs"
            ),
        });
    }

    /// Returns whether the address is the source of own datagrams, or may be if the source is
    /// unknown.
    pub(super) fn is_source(&self, from: SocketAddr) -> bool {
        self.settings.source.is_none_or(|source| {
            source.port() == from.port()
                && (source.ip().is_unspecified() || source.ip() == from.ip())
        })
    }

    /// Shows a received DataSetMessage to the tap of its topic.
    fn note_received(&mut self, topic: TopicId, message: &DataSetMessage<'_>, from: SocketAddr) {
        self.tap.note(topic, || Crossing::Received {
            from,
            sequence: message.sequence_number(),
            keep_alive: message.kind == MessageKind::KeepAlive,
        });
        let refused = match self.forwarding {
            Forwarding::None => return,
            Forwarding::Forwarded => None,
            Forwarding::Refused(reason) => Some(reason),
        };
        self.tap.note(topic, || Crossing::Forwarded { refused });
    }

    /// Handles a DataSetMessage of another space: checks its sequence, and processes its content if
    /// it is new.
    pub(super) fn handle_message(
        &mut self,
        topic: TopicId,
        message: &DataSetMessage<'_>,
        (from, sent): (SocketAddr, Option<Timestamp>),
        now: Now,
    ) {
        let about = DropSite::message(topic, from);
        self.note_received(topic, message, from);
        if !self.concern.has_topic(topic) {
            return;
        }
        if !message.is_valid() {
            return self.count(about, Reason::Invalid, 1, || {
                "the writer marked its DataSetMessage as invalid".to_owned()
            });
        }
        let relay = self.arrival;
        let waited = self.waited(now);
        let mut place = SequencePosition::of(topic, message, (from, sent), relay.is_some());
        let local = self.settings.local;
        let since_takeover = self.since_takeover(&place, now);
        let Some(at) = self.entry(topic, from, now) else {
            return;
        };
        let Some(Topic {
            role: TopicSide::Theirs(reader),
            counters,
            lasting,
            held_back,
            confirming,
            ..
        }) = self.topics.at_mut(at)
        else {
            return;
        };
        place.held_back = *held_back;
        let is_value = message.kind != MessageKind::KeepAlive;
        let late = relay.filter(|_| is_value).and_then(|relay| {
            relay.judge_value(&place, (confirming.as_deref(), *lasting), now.utc)
        });
        if let Some((case, detail)) = late {
            return self.count(about, late::cause(case), 1, || detail);
        }
        reader.heard(now.monotonic);
        // A keep-alive does not describe the content.
        let changed = is_value && reader.is_changed(message.header().major_version);
        let mut admitted = match message.kind {
            // A keep-alive is only a sign of life.
            MessageKind::KeepAlive => None,
            MessageKind::KeyFrame | MessageKind::DeltaFrame | MessageKind::Event => {
                let handling = Handling::of(local, *lasting);
                Some(reader.admit(place, Some(message), handling, now.monotonic))
            }
        };
        let is_confirmed = confirming.is_some();
        let lasts = (*lasting, confirming.as_deref().map(Confirming::within));
        if matches!(admitted, Some(Ok(_)))
            && since_takeover.is_some_and(|since| since.is_preceded_by(&place, lasts))
        {
            admitted = Some(Err(Reason::Takeover));
        }
        // Its repetitions are known from here on, so that none of them is delivered either.
        let is_withdrawn = confirming
            .as_deref()
            .is_some_and(|confirming| waited >= confirming.within());
        if is_withdrawn && matches!(admitted, Some(Ok(_))) {
            admitted = Some(Err(Reason::Late));
        }
        if let Some(Ok(admitted)) = &admitted {
            counters.missing += u64::from(admitted.missing);
        }
        let withdrawn = reader.take_withdrawn();
        counters.sender_changed += reader.take_moved();
        let returned = match admitted {
            None => reader.lives(now.monotonic),
            Some(Err(Reason::Repeat)) => reader.is_good(now.monotonic),
            Some(_) => false,
        };
        self.follow_up(at, (returned, changed), now);
        if let Some(instance) = withdrawn {
            self.tell(Output::Retired { topic, instance });
        }
        if is_confirmed {
            admitted = admitted.map(|admitted| self.receive(topic, &place, admitted, now));
            if is_withdrawn && matches!(admitted, Some(Ok(_))) {
                admitted = Some(Err(Reason::Late));
            }
        }
        self.take_or_count(at, message, (&place, admitted, sent), now);
    }

    /// Processes a message that was admitted to the sequence, or counts the reason why not.
    fn take_or_count(
        &mut self,
        at: Handle,
        message: &DataSetMessage<'_>,
        (place, admitted, sent): (
            &SequencePosition,
            Option<Result<AcceptedMessage, Reason>>,
            Option<Timestamp>,
        ),
        now: Now,
    ) {
        let about = DropSite::message(at.topic(), place.from);
        match admitted {
            None => {}
            Some(Ok(admitted)) => self.take_in(at, message, (place, &admitted, sent), now),
            Some(Err(Reason::Late)) => {
                let waited = self.waited(now);
                self.count(about, late::cause(late::WAITED), 1, || late::waited(waited));
            }
            Some(Err(reason)) => {
                if reason == Reason::Repeat {
                    self.follow_again(at, message, place);
                }
                self.count(about, reason, 1, String::new);
            }
        }
    }

    /// Carries out the consequences of a message for its topic: the end of a silence, and a probe
    /// for a changed description.
    fn follow_up(&mut self, at: Handle, (returned, changed): (bool, bool), now: Now) {
        if returned {
            self.tell_returned(at);
        }
        if changed {
            self.ask_what(at.topic());
        }
        self.retire(at, now);
        let entry = self.topics.at(at);
        if entry.is_some_and(|entry| entry.timer.is_none()) {
            // The port created the topic before its writer was received.
            self.schedule(at);
        }
    }

    /// Processes the fields of a message that was admitted to the sequence.
    fn take_in(
        &mut self,
        at: Handle,
        message: &DataSetMessage<'_>,
        (place, admitted, sent): (&SequencePosition, &AcceptedMessage, Option<Timestamp>),
        now: Now,
    ) {
        let topic = at.topic();
        let status = message.header().status.unwrap_or_default();
        let arrived = self.arrival(now);
        let sample = |fields, quality: ValueQuality| LocalSample {
            fields,
            source: quality.source.or(place.stamp),
            instance: place.instance(),
            kept: admitted.kept,
            lasting: admitted.lasting,
            status: quality.status(status),
            arrived,
        };
        let takes = self.take_base(at, message, place);
        match Self::plain(message, takes) {
            Some(Ok(fields)) => {
                self.record_way(topic, (place, sent), now);
                self.route(at, &sample(fields, ValueQuality::default()), now);
                return;
            }
            Some(Err(error)) => {
                self.drop_undecoded(Some(topic), place.from, &error);
                return;
            }
            None => {}
        }
        let mut content = self.buffer();
        match self.content(topic, message, place, &mut content) {
            Ok(Some(quality)) => {
                let message = DataSetMessage::decode(None, &content);
                match message.and_then(|message| message.fields()) {
                    Ok(fields) => {
                        self.record_way(topic, (place, sent), now);
                        self.route(at, &sample(fields, quality), now);
                    }
                    Err(error) => self.drop_undecoded(Some(topic), place.from, &error),
                }
            }
            Ok(None) => {
                self.lives(at, now);
                self.count(DropSite::topic(topic), Reason::Repeat, 1, String::new);
            }
            Err(refusal) => self.refuse_content(topic, place.from, refusal, now),
        }
        self.recycle(content);
    }

    /// Records that the topic has a good value.
    pub(super) fn is_good(&mut self, at: Handle, now: Now) {
        if let Some(reader) = self.topics.reader(at)
            && reader.is_good(now.monotonic)
        {
            self.tell_returned(at);
        }
    }

    /// Records a message of the writer without a new value.
    fn lives(&mut self, at: Handle, now: Now) {
        if let Some(reader) = self.topics.reader(at)
            && reader.lives(now.monotonic)
        {
            self.tell_returned(at);
        }
    }

    /// Reports the end of the silence of a topic.
    pub(super) fn tell_returned(&mut self, at: Handle) {
        self.tell_silence(at);
        self.schedule(at);
    }

    /// Delivers a sample, or holds it until its local type is known.
    fn route(&mut self, at: Handle, sample: &LocalSample<'_>, now: Now) {
        let typed = self.settings.local == Local::Fields;
        let Some(Topic {
            role: TopicSide::Theirs(reader),
            plan,
            ..
        }) = self.topics.at_mut(at)
        else {
            return;
        };
        let anew = !typed && reader.shape.is_none();
        // Until a type is known, each sample updates the shape, because a null value has no type.
        if anew || (!typed && plan.is_none()) {
            let fields = sample.fields.clone().filter_map(Result::ok);
            reader.shape = Some(fields.map(|field| fields::shape(&field)).collect());
        }
        if typed || plan.is_some() {
            // Checked once for each shape instead of for each sample.
            if anew {
                self.tell_described(at);
            }
            self.deliver(at, sample, now);
            return;
        }
        let asks = reader
            .asked
            .is_none_or(|asked| now.monotonic >= asked + ASK_AGAIN);
        if asks {
            reader.asked = Some(now.monotonic);
        }
        self.hold(at.topic(), sample, now);
        if asks {
            self.tell_unbound(at);
        }
        // Not a loss yet, because the newest sample waits. It is not logged, because the port
        // reports topics without a type.
        self.is_good(at, now);
        self.count(DropSite::topic(at.topic()), Reason::Untyped, 1, String::new);
    }

    pub(super) fn deliver(&mut self, at: Handle, sample: &LocalSample<'_>, now: Now) {
        let Some(reader) = self.topics.reader(at) else {
            return;
        };
        let evicted = reader.delivered(
            sample.instance,
            (sample.kept, sample.lasting),
            now.monotonic,
        );
        if let Some(instance) = evicted {
            self.tell(Output::Retired {
                topic: at.topic(),
                instance,
            });
        }
        let mut payload = self.buffer();
        let Some(Topic {
            plan,
            transcoder,
            by_name,
            ..
        }) = self.topics.at_mut(at)
        else {
            return;
        };
        let mut scratch = None;
        let written = match (plan, transcoder.as_deref()) {
            (Some(_), Some(Ok(transcoder))) => {
                let scratch = scratch.insert(self.buffers.take());
                transcoder.run(sample.fields.clone(), scratch, &mut payload)
            }
            (Some(_), Some(Err(why))) => Err((Reason::Mismatch.into(), why.to_string())),
            (Some(plan), None) => match by_name {
                Some(by_name) => by_name.write(plan, sample.fields.bytes(), &mut payload),
                None => fields::write(plan, sample.fields.clone(), &mut payload),
            },
            (None, _) => fields::copy(&sample.fields, &mut payload),
        };
        if let Some(scratch) = scratch {
            self.recycle(scratch);
        }
        if let Err((cause, detail)) = written {
            self.recycle(payload);
            let no_value = sample.no_value();
            let (cause, detail) =
                no_value.map_or((cause, detail), |detail| (Reason::NoValue.into(), detail));
            // The local side does not have the value, so its repetition must be delivered.
            self.forget(at, sample.instance);
            self.count(DropSite::topic(at.topic()), cause, 1, || detail);
            return;
        }
        let LocalSample {
            source,
            instance,
            kept,
            lasting,
            status,
            arrived,
            ..
        } = *sample;
        let loss = self.topics.at_mut(at).and_then(|of| of.loss.as_mut());
        let holds = loss.is_some_and(|loss| {
            loss.deliver(now.monotonic);
            loss.due().is_some()
        });
        if holds {
            self.schedule(at);
        }
        self.push(
            at,
            PolledSample::Delivery(Delivery {
                topic: at.topic(),
                payload,
                source,
                status,
                arrived,
                instance,
                kept,
                lasting,
            }),
        );
    }

    /// Reports values that are not repeated any more beside others.
    fn retire(&mut self, at: Handle, now: Now) {
        let after = self
            .mapping
            .pubsub()
            .key_frame_period
            .saturating_mul(MISSED_ROUNDS);
        let Some(reader) = self.topics.reader(at) else {
            return;
        };
        let gone: Vec<Timestamp> =
            std::iter::from_fn(|| reader.retire(now.monotonic, after)).collect();
        for instance in gone {
            self.tell(Output::Retired {
                topic: at.topic(),
                instance,
            });
        }
    }

    pub(super) fn drop_undecoded(
        &mut self,
        topic: Option<TopicId>,
        from: SocketAddr,
        error: &DecodeError,
    ) {
        self.count(
            DropSite {
                topic,
                from: Some(from),
            },
            (reason_of(error), error.subject()),
            1,
            || error.to_string(),
        );
    }
}

/// Returns the time at which a NetworkMessage was sent.
pub(super) fn sent(header: &NetworkHeader<'_>) -> Option<Timestamp> {
    header.timestamp.map(|time| Timestamp {
        time,
        picoseconds: header.picoseconds.unwrap_or_default(),
    })
}

pub(super) const DISCOVERY: DecodeError = DecodeError::Misread("a discovery message");

const fn reason_of(error: &DecodeError) -> Reason {
    if matches!(error, DecodeError::Unsupported(_) | DecodeError::Misread(_)) {
        Reason::Unsupported
    } else {
        Reason::Malformed
    }
}

/// The number of key frame periods without repetition after which one of several values is retired.
/// Two lost datagrams are tolerated.
const MISSED_ROUNDS: u32 = 3;
/// The minimum time between two requests to the port for the type of a topic.
const ASK_AGAIN: Duration = Duration::from_secs(1);

/// Returns why a large request of another host is not executed.
fn closed_to(from: SocketAddr) -> String {
    format!(
        "{from} is another host, and no call of the namespace is open to other hosts (`open: true`)"
    )
}
