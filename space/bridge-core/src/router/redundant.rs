//! The state of a redundant bridge of the own space: its role, and the values that it holds for a
//! takeover.

mod succession;

use std::collections::{BTreeMap, HashMap};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::TopicId;
use uadp::Timestamp;

pub(super) use self::succession::SinceTakeover;
use self::succession::Succession;
use crate::output::{Delivery, ValueRelation};
use crate::place::SequencePosition;
use crate::redundancy::{
    Heartbeat, LocalSide, Redundancy, RedundancyRank, RoleChange, SenderClocks, SwitchRefusal,
    TakeoverCause,
};
use crate::settings::Now;
use crate::writer::{MAX_KEPT, SentTopicState};

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
    muted: MutedSamples,
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

/// The samples that a muted or active bridge handled, for the status.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MutedSamples {
    /// Samples of the own space that were not sent to the group.
    pub sent: u64,
    /// Samples of other spaces that were not published on the local side.
    pub delivered: u64,
}

/// The values that a new active bridge takes over from the former active bridge.
#[derive(Debug)]
pub(super) struct Inheritance {
    /// The number of samples of each own topic that the former active bridge may not have sent.
    pub(super) unsure: BTreeMap<TopicId, u64>,
    /// The states of other spaces.
    pub(super) states: Vec<Delivery>,
    /// The reactions to losses that the former active bridge may not have published.
    pub(super) losses: Vec<Delivery>,
    /// The buffers of the reactions that the former active bridge has published.
    pub(super) spent: Vec<Vec<u8>>,
}

impl Redundant {
    pub(super) fn new(rank: RedundancyRank, instance: u32, now: Now) -> Self {
        Self {
            state: Redundancy::new(rank, instance, now),
            held: BTreeMap::new(),
            losses: BTreeMap::new(),
            unsure: BTreeMap::new(),
            followed: HashMap::new(),
            took_over: None,
            clocks: SenderClocks::new(now),
            shows_values: false,
            muted: MutedSamples::default(),
        }
    }

    /// Lets the local side take values while this program is a standby.
    pub(super) const fn show_values(&mut self) {
        self.shows_values = true;
    }

    /// Defers the takeover at most for 1 s.
    pub(super) fn defer(&mut self, now: Instant) {
        self.state.defer(now);
    }

    /// Sets whether the local side is within reach.
    pub(super) const fn set_side(&mut self, side: LocalSide) {
        self.state.set_side(side);
    }

    /// Sets the ServiceLevel of this OPC UA server.
    pub(super) const fn set_service_level(&mut self, level: Option<u8>) {
        self.state.set_service_level(level);
    }

    /// Checks the lease.
    pub(super) fn check(&mut self, now: Now) -> Option<RoleChange> {
        self.state.check(now)
    }

    /// Returns whether a heartbeat is due, and the change of the role.
    pub(super) fn poll(&mut self, now: Now) -> (bool, Option<RoleChange>) {
        let (heartbeat, change) = self.state.poll(now);
        (heartbeat.is_some(), change)
    }

    /// Hands over to a standby.
    pub(super) fn switch_over(&mut self, now: Now) -> Result<RoleChange, SwitchRefusal> {
        self.state.switch_over(now)
    }

    /// Records whether the network took the last heartbeat.
    pub(super) fn heartbeat_sent(&mut self, is_sent: bool, now: Now) -> Option<RoleChange> {
        if is_sent {
            self.state.sent(now)
        } else {
            self.state.not_sent(now)
        }
    }

    /// Records that there were no keys for a heartbeat.
    pub(super) fn heartbeat_not_sealed(&mut self, now: Now) -> Option<RoleChange> {
        self.state.not_sealed(now)
    }

    /// Records the heartbeat of another bridge of the own space. Its samples up to this time were
    /// sent if it is the active bridge.
    pub(super) fn hear(
        &mut self,
        heartbeat: Heartbeat,
        from: SocketAddr,
        now: Now,
    ) -> Option<RoleChange> {
        let change = self.state.hear(heartbeat, from, now);
        if self.state.is_followed(from) && heartbeat.is_active() {
            self.unsure.clear();
        }
        change
    }

    /// Makes this bridge the active bridge, and returns the values that the former active bridge
    /// left. `gap` is the time since its last heartbeat.
    pub(super) fn take_over(
        &mut self,
        (gap, cause): (Option<Duration>, TakeoverCause),
        now: Now,
    ) -> Inheritance {
        self.took_over = Some(Succession {
            at: now,
            is_of_another: cause != TakeoverCause::Start,
        });
        self.followed.clear();
        // The former active bridge was received at this time, and its next heartbeat was missed.
        let unsure_since = gap.and_then(|gap| now.monotonic.checked_sub(gap));
        let is_unsure = |at: Instant| unsure_since.is_none_or(|since| at >= since);
        let held = std::mem::take(&mut self.held).into_values().flatten();
        let states = held.map(|HeldState { at, mut delivery }| {
            if !is_unsure(at) {
                // The former active bridge has published it: it is for late joiners only.
                delivery.kept = ValueRelation::Again;
            }
            delivery
        });
        let states = states.collect();
        let losses = std::mem::take(&mut self.losses).into_values();
        let (losses, spent): (Vec<_>, Vec<_>) = losses.partition(|(at, _)| is_unsure(*at));
        Inheritance {
            unsure: std::mem::take(&mut self.unsure),
            states,
            losses: losses.into_iter().map(|(_, delivery)| delivery).collect(),
            spent: spent.into_iter().map(|(_, of)| of.payload).collect(),
        }
    }

    /// Ends the time as the active bridge.
    pub(super) fn stand_by(&mut self) {
        self.followed.clear();
        self.unsure.clear();
        self.took_over = None;
    }

    /// Counts samples of an own topic that are not sent, because another bridge sends them. They
    /// are unsure until its next heartbeat.
    pub(super) fn note_unsent(&mut self, topic: TopicId, count: u64) {
        self.muted.sent += count;
        let unsure = self.unsure.entry(topic).or_default();
        *unsure = unsure.saturating_add(count);
    }

    /// Holds a delivery that another bridge publishes, if it is a state. Returns the buffer of a
    /// delivery that is not held.
    pub(super) fn hold(&mut self, delivery: Delivery, now: Now) -> Option<Vec<u8>> {
        let topic = delivery.topic;
        self.muted.delivered += 1;
        self.losses.remove(&topic);
        if !delivery.lasting {
            return Some(delivery.payload);
        }
        let held = self.held.entry(topic).or_default();
        let is_again = delivery.kept == ValueRelation::Again;
        if delivery.kept == ValueRelation::Alone {
            held.clear();
        }
        let same = held
            .iter()
            .position(|one| one.delivery.instance == delivery.instance);
        match same {
            Some(_) if is_again => return Some(delivery.payload),
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
        None
    }

    /// Holds the reaction to the loss of a commander.
    pub(super) fn hold_loss(&mut self, delivery: Delivery, now: Now) {
        let topic = delivery.topic;
        self.losses.insert(topic, (now.monotonic, delivery));
    }

    /// Drops the held states of a topic that are outdated: the states of an instance, or all states
    /// of the topic.
    pub(super) fn drop_held(&mut self, topic: TopicId, instance: Option<Timestamp>) {
        match (instance, self.held.get_mut(&topic)) {
            (Some(_), Some(held)) => held.retain(|one| one.delivery.instance != instance),
            (None, Some(_)) => {
                self.held.remove(&topic);
            }
            (_, None) => {}
        }
    }

    /// Takes the stamp of the active bridge for an equal state, so that readers recognise the
    /// repetitions of this bridge after a takeover.
    pub(super) fn follow_state(
        &mut self,
        (topic, writer): (TopicId, &mut SentTopicState),
        fields: &[u8],
        (stamp, now): (Timestamp, Now),
    ) {
        if writer.adopt(fields, stamp) {
            self.followed.remove(&topic);
            return;
        }
        writer.disown(now.utc);
        let followed = self.followed.entry(topic);
        let followed = followed.or_insert_with(|| Followed {
            fields: Vec::new(),
            stamp,
        });
        followed.stamp = stamp;
        followed.fields.clear();
        followed.fields.extend_from_slice(fields);
    }

    /// Takes the stamp of the active bridge for a sample of this muted bridge, if the message of
    /// the active bridge was received first.
    pub(super) fn adopt_followed(&mut self, topic: TopicId, writer: &mut SentTopicState) {
        if let Some(followed) = self.followed.get(&topic)
            && writer.adopt(&followed.fields, followed.stamp)
        {
            self.followed.remove(&topic);
        }
    }

    /// Records the clock of the sender of a message.
    pub(super) fn note_clock(&mut self, from: SocketAddr, sent: Timestamp, now: Now) {
        self.clocks.note(from, sent, now.monotonic);
    }

    /// Returns the time of the next [`poll`](Self::poll).
    pub(super) fn due(&self) -> Instant {
        self.state.due()
    }

    /// Returns the role and the other bridges.
    pub(super) const fn state(&self) -> &Redundancy {
        &self.state
    }

    /// Returns whether the local side takes values while this program is a standby.
    pub(super) const fn shows_values(&self) -> bool {
        self.shows_values
    }

    /// Returns whether nothing is published on the local side.
    pub(super) fn mutes_local(&self) -> bool {
        !self.shows_values && self.state.mutes_local()
    }

    /// Returns the number of samples that were muted.
    pub(super) const fn muted_samples(&self) -> MutedSamples {
        self.muted
    }

    /// Returns the relation of a received message to the last takeover, as long as this program is
    /// active and the network may still hold messages that precede the takeover.
    pub(super) fn since_takeover(
        &self,
        place: &SequencePosition,
        now: Now,
    ) -> Option<SinceTakeover> {
        self.took_over?.relation(place, &self.clocks, now)
    }
}
