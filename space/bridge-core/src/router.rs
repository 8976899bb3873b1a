//! The Router: checks samples, queues them per topic, repeats values, and detects silent topics.

mod about;
mod announce;
mod announcements;
mod batch;
mod by_name;
mod call_api;
mod calls;
mod chunks;
mod claims;
mod confirm;
mod content;
mod discovery;
mod due;
mod follow;
mod guarded;
mod held;
mod inquiries;
mod late;
mod local;
mod local_sample;
mod metadata;
mod muted;
mod names;
mod own;
mod parts;
mod reassembly;
mod receive;
mod redundancy_api;
mod redundant;
mod reload;
mod roles;
mod security;
mod send;
mod senders;
mod told;
mod values;
mod way;

use std::sync::Arc;
use std::time::Instant;

use mappings::{Mapping, TopicId};
use messages::{MessageType, PlanError, Selection};
use uadp::Timestamp;

use self::about::DropSite;
use self::announcements::PlannedAnnouncements;
use self::calls::RouterCalls;
use self::reassembly::Reassembly;
pub use self::redundant::MutedSamples;
use self::security::MessageSecurity;
use self::senders::RedundantSenders;
use self::values::TopicQueues;
use crate::confirm::Handover;
use crate::counters::{Counters, Reason, Verdict};
use crate::hops::{Hop, Hops};
use crate::output::{GOOD, LocalMessage, PublisherKey};
use crate::part::OtherParts;
use crate::settings::{Local, Now, RouterSettings};
use crate::tap::{Crossing, Tapped};

/// Decides which messages cross between a space and UADP. The crate documentation describes its
/// use.
///
/// The Router wires types that own their state and know each other only downwards: the redundancy
/// of the own space, the values of topics, the reassembly of chunks, announcements and probes,
/// calls, security, and the changes of the role. After each input it plans the probes that values
/// need.
///
/// # Inputs
/// - samples: [`handle_local`](Self::handle_local), [`handle_local_as`](Self::handle_local_as),
///   [`left`](Self::left), [`set_live`](Self::set_live),
///   [`handle_datagram`](Self::handle_datagram), [`handle_received`](Self::handle_received).
/// - types and metadata: [`bind`](Self::bind), [`bind_as`](Self::bind_as),
///   [`unbind`](Self::unbind), [`describe_value`](Self::describe_value),
///   [`introduce`](Self::introduce), [`call_the_roll`](Self::call_the_roll),
///   [`limit_to`](Self::limit_to).
/// - calls: [`bind_call`](Self::bind_call), [`unbind_call`](Self::unbind_call),
///   [`want_call`](Self::want_call), [`ask`](Self::ask), [`give_up`](Self::give_up),
///   [`offer`](Self::offer), [`offer_type`](Self::offer_type), [`withdraw`](Self::withdraw),
///   [`withdraw_all`](Self::withdraw_all), [`executed`](Self::executed).
/// - the fate of an output: [`published`](Self::published),
///   [`not_published`](Self::not_published), [`handed`](Self::handed),
///   [`call_failed`](Self::call_failed), [`not_sent`](Self::not_sent),
///   [`not_called`](Self::not_called), [`not_announced`](Self::not_announced),
///   [`heartbeat_sent`](Self::heartbeat_sent), [`recycle`](Self::recycle).
/// - losses outside the Router: [`lost`](Self::lost), [`dropped`](Self::dropped),
///   [`unmatched`](Self::unmatched).
/// - settings: [`replace_mapping`](Self::replace_mapping), [`set_owned`](Self::set_owned),
///   [`claim`](Self::claim), [`set_part`](Self::set_part), [`set_source`](Self::set_source),
///   [`set_relay`](Self::set_relay), [`set_link`](Self::set_link),
///   [`set_arrival`](Self::set_arrival), [`set_instance`](Self::set_instance),
///   [`set_keys`](Self::set_keys), [`tap`](Self::tap).
/// - redundancy: [`set_redundancy`](Self::set_redundancy),
///   [`show_values_at_standby`](Self::show_values_at_standby), [`set_side`](Self::set_side),
///   [`switch_over`](Self::switch_over).
///
/// # Outputs
/// - in their order: [`poll_output`](Self::poll_output).
/// - steps of tapped topics: [`next_tapped`](Self::next_tapped),
///   [`take_lost_taps`](Self::take_lost_taps).
///
/// # Timers
/// - the time of the next call, and the call: [`poll_timeout`](Self::poll_timeout),
///   [`handle_timeout`](Self::handle_timeout).
/// - a takeover that the next call would begin: [`takes_over`](Self::takes_over),
///   [`defer_takeover`](Self::defer_takeover).
///
/// # Queries
/// - topics: [`topics`](Self::topics), [`heard`](Self::heard), [`is_full`](Self::is_full),
///   [`is_state`](Self::is_state), [`is_command`](Self::is_command),
///   [`is_to_confirm`](Self::is_to_confirm), [`expiry`](Self::expiry),
///   [`is_tapped`](Self::is_tapped).
/// - calls and programs: [`calls`](Self::calls), [`described_call`](Self::described_call),
///   [`applications`](Self::applications), [`name_of`](Self::name_of),
///   [`names_without_values`](Self::names_without_values).
/// - the Router: [`mapping`](Self::mapping), [`others`](Self::others), [`hops`](Self::hops),
///   [`groups`](Self::groups), [`redundancy`](Self::redundancy), [`is_standby`](Self::is_standby),
///   [`muted_samples`](Self::muted_samples), [`interest`](Self::interest).
#[derive(Debug)]
pub struct Router {
    /// Topics with their queues, turns and timers, and outputs about them.
    values: TopicQueues,
    /// Received chunks of large messages.
    reassembly: Reassembly,
    /// Planned announcements and pending probes.
    announcements: PlannedAnnouncements,
    /// Requested and executed calls; `None` before the first use.
    calls: Option<Box<RouterCalls>>,
    /// Random bytes that distinguish own requests from requests of other programs.
    instance: [u8; 16],
    /// Secured groups.
    security: MessageSecurity,
    /// The redundant bridges of other spaces.
    redundant_senders: RedundantSenders,
    /// The bridges of other spaces that carry a part of their space.
    other_parts: OtherParts,
    /// Whether a value was polled before a call last time.
    value_first: bool,
}

impl Router {
    /// Creates a Router for a space. `mapping` defines the queue of each topic and the period of
    /// repetitions.
    #[must_use]
    pub fn new(settings: RouterSettings, mapping: Arc<Mapping>) -> Self {
        let security = MessageSecurity::new(mapping.security());
        let overhead = security.overhead();
        let own = settings.own;
        Self {
            values: TopicQueues::new(settings, mapping, overhead),
            reassembly: Reassembly::default(),
            announcements: PlannedAnnouncements::new(own),
            calls: None,
            instance: [0; 16],
            security,
            redundant_senders: RedundantSenders::default(),
            other_parts: OtherParts::default(),
            value_first: false,
        }
    }

    /// Binds a topic to its local message type and compiles the plan. Binding again restarts the
    /// topic with the new type. A sample that waited for a type is delivered.
    ///
    /// # Errors
    /// Returns a [`PlanError`] if the selection is not in the type; the topic is then unchanged.
    pub fn bind(
        &mut self,
        topic: TopicId,
        message_type: &Arc<MessageType>,
        selection: &Selection,
        now: Now,
    ) -> Result<(), PlanError> {
        let is_own = self
            .values
            .bind_type(topic, (message_type, selection), now)?;
        if is_own {
            self.describe(topic, Some((message_type, selection)), now);
        }
        self.inquire(now);
        Ok(())
    }

    /// Handles a sample received on the local side.
    pub fn handle_local(&mut self, heard: LocalMessage<'_>, now: Now) -> Verdict {
        self.handle_local_as(heard, GOOD, now)
    }

    /// Handles a sample as [`handle_local`](Self::handle_local) does, with the quality of the
    /// sample: the upper 16 bits of a StatusCode, which are sent as the Status of the
    /// DataSetMessage (OPC 10000-14, 7.2.4.5.4).
    pub fn handle_local_as(&mut self, heard: LocalMessage<'_>, status: u16, now: Now) -> Verdict {
        let topic = heard.topic;
        let verdict = self.values.take_local(heard, status, now);
        self.inquire(now);
        self.values.settle_verdict(topic, verdict);
        verdict
    }

    /// Removes a latched publisher of a topic of the own space. Its last message is not repeated
    /// any more.
    pub fn left(&mut self, topic: TopicId, publisher: PublisherKey, now: Now) {
        self.values.left(topic, publisher, now);
        self.inquire(now);
    }

    /// Sets whether a topic of the own space has a producer. Without a producer its value is not
    /// repeated, so that readers detect the silence. The next sample sets a producer again.
    pub fn set_live(&mut self, topic: TopicId, live: bool, now: Now) {
        if self.values.set_live(topic, live, now) {
            if live && self.values.settings.local == Local::Fields {
                // No local type will describe the topic.
                self.describe(topic, None, now);
            }
            self.values.settle_arrival(topic);
            self.values.schedule_topic(topic);
        }
        self.inquire(now);
    }

    /// Repeats values, sends keep-alives, and detects silent topics that are due by `now`.
    pub fn handle_timeout(&mut self, now: Now) {
        if self.values.redundant.is_some() {
            self.roles().handle_timeout(now);
        }
        self.look_at_part(now);
        let mut repeated = 0;
        while let Some(at) = self.values.next_due(now) {
            let topic = at.topic();
            self.announcements
                .announce_again(&mut self.values, topic, now);
            repeated += usize::from(self.values.handle_due(at, now.monotonic, now));
            self.values.settle_arrival(topic);
            self.values.schedule(at);
        }
        self.values.send_early(repeated, now);
        self.look_at_claims(now);
        self.call_traffic().look_at_calls(now);
        self.inquire(now);
        self.announce_due(now);
        self.reassembly.expire(&mut self.values, now);
        self.security.turn(now.monotonic);
        self.want_keys(now);
    }

    /// Returns the time of the next [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let timer = self.values.due();
        let pace = if self.values.paced.is_empty() && !self.is_chunking() {
            None
        } else {
            self.values.pace.opens()
        };
        let chunks = self.reassembly.due();
        let announcements = self.announcements.due();
        let calls = self.calls.as_ref().and_then(|calls| calls.due());
        let (_, _, silence) = self.values.periods();
        let claims = self.values.claims.due(silence);
        let keys = self.security.due();
        let redundancy = self.values.redundant.as_ref().map(|of| of.due());
        let part = self.values.part.as_ref().map(|part| part.due());
        [
            timer,
            pace,
            chunks,
            announcements,
            calls,
            claims,
            keys,
            redundancy,
            part,
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// Records that the local side published a delivery of the topic at `now`. The value is good.
    pub fn published(&mut self, topic: TopicId, arrived: Timestamp, now: Now) {
        self.values.hops.record(Hop::In, arrived, now.utc);
        self.values.tap.note(topic, || Crossing::Published {
            after: now.utc.unix_nanos() - arrived.unix_nanos(),
        });
        if let Some(at) = self.values.topics.find(topic) {
            self.values.is_good(at, now);
        }
    }

    /// Records that the local side did not publish a delivery with the topic and instance. Its
    /// repetition will be delivered.
    pub fn not_published(
        &mut self,
        topic: TopicId,
        instance: Option<Timestamp>,
        why: &'static str,
    ) {
        if let Some(at) = self.values.topics.find(topic) {
            self.values.forget(at, instance);
        }
        self.handed(topic, instance, Handover::Nobody);
        self.values.count(
            DropSite::topic(topic),
            (Reason::NotPublished, why),
            1,
            || why.to_owned(),
        );
    }

    /// Records that a service did not accept a value of the topic, or did not respond.
    pub fn call_failed(&mut self, topic: TopicId, detail: &str) {
        self.values
            .count(DropSite::topic(topic), Reason::CallFailed, 1, || {
                detail.to_owned()
            });
    }

    /// Records a publisher or subscriber of the topic with QoS policies that are incompatible with
    /// the local side.
    pub fn unmatched(&mut self, topic: TopicId) {
        self.values.count(
            DropSite::topic(topic),
            Reason::IncompatibleQos,
            1,
            String::new,
        );
    }

    /// Counts samples that were lost before they reached the Router, such as in a queue of the port
    /// or the kernel. They do not affect the state of a writer.
    pub fn lost(
        &mut self,
        topic: Option<TopicId>,
        count: u64,
        (reason, why): (Reason, &'static str),
    ) {
        self.values
            .count_only(DropSite { topic, from: None }, (reason, why), count, || {
                why.to_owned()
            });
    }

    /// Counts drops of a port that belong to no topic.
    pub fn dropped(&mut self, reason: Reason, count: u64, why: &'static str) {
        let about = DropSite {
            topic: None,
            from: None,
        };
        self.values
            .count(about, (reason, why), count, || why.to_owned());
    }

    /// Takes back the buffer of a datagram or payload after use, so that the next output needs no
    /// allocation.
    pub fn recycle(&mut self, buffer: Vec<u8>) {
        self.values.recycle(buffer);
    }

    /// Returns the counters of each topic in no particular order.
    pub fn topics(&self) -> impl Iterator<Item = (TopicId, &Counters)> {
        self.values
            .topics
            .iter()
            .map(|(topic, entry)| (topic, &entry.counters))
    }

    /// Returns the counters of datagrams and messages without a topic, and of removed topics.
    #[must_use]
    pub const fn others(&self) -> &Counters {
        self.values.topics.others()
    }

    /// Returns the measured delays.
    #[must_use]
    pub const fn hops(&self) -> &Hops {
        &self.values.hops
    }

    /// Sets the tapped topics. Without topics, nothing is recorded.
    pub fn tap(&mut self, topics: &[TopicId]) {
        self.values.tap.set(topics);
    }

    /// Returns whether topics are tapped.
    #[must_use]
    pub const fn is_tapped(&self) -> bool {
        self.values.tap.is_on()
    }

    /// Takes the oldest event of the tapped topics.
    pub fn next_tapped(&mut self) -> Option<Tapped> {
        self.values.tap.next()
    }

    /// Takes the number of events for which there was no room.
    pub fn take_lost_taps(&mut self) -> u64 {
        self.values.tap.take_lost()
    }
}
