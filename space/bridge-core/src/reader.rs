//! The state of a DataSetWriter of another space.

mod held_sample;

use std::collections::VecDeque;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::Lasting;
use uadp::{BuiltinType, DataSetMessage, SequenceOrder, Timestamp};

pub(crate) use self::held_sample::HeldSample;
use crate::base::KeyFrame;
use crate::confirm::Receipt;
use crate::counters::Reason;
use crate::output::ValueRelation;
use crate::place::SequencePosition;
use crate::settings::Local;
use crate::writer::MAX_KEPT;

/// The state of a received topic.
#[derive(Debug)]
pub(crate) struct ReceivedTopicState {
    /// The sequence number of the newest accepted DataSetMessage.
    sequence: Option<u16>,
    /// The Timestamp of the last sample that was not a repetition.
    stamp: Option<Timestamp>,
    /// The sender of the last message; `None` before the first.
    from: Option<SocketAddr>,
    /// The number of sender changes since the last call of [`take_moved`](Self::take_moved).
    moved: u64,
    /// The time of the last message of the writer, including keep-alives.
    heard: Instant,
    /// The last time at which the value was valid: the local side accepted a value, or the writer
    /// repeated it or sent a keep-alive.
    good: Instant,
    /// The reason why the newest message after this time was dropped.
    dropped: Option<Reason>,
    /// Whether the topic is silent.
    silent: bool,
    /// The delivered samples in their order, if their stamps are precise enough to distinguish
    /// them; at most [`MAX_KNOWN`].
    known: VecDeque<DeliveredSample>,
    /// The last time at which the writer repeated a value other than the newest. `Some` while the
    /// writer repeats several values, as for several latched publishers.
    several: Option<Instant>,
    /// Whether the writer repeats its values as states, which is learned from its messages.
    lasting: bool,
    /// Whether the writer has sent a sample right after it was taken. Its stamps then distinguish
    /// stored values from new values.
    prompt: bool,
    /// Whether different values had the same stamp, so that the stamp does not identify a sample.
    still: bool,
    /// Whether the writer has ended or timed out after its last message, so that its sequence
    /// numbers may restart.
    over: bool,
    /// A stored value that turned out not to be a state.
    withdrawn: Option<Timestamp>,
    /// A sample that waits for its local type.
    pub(crate) held: Option<Box<HeldSample>>,
    /// The newest event, if this space confirms it.
    pub(crate) receipt: Option<Receipt>,
    /// The state to which delta frames apply.
    pub(crate) base: Option<Box<KeyFrame>>,
    /// Whether the writer has sent a delta frame.
    pub(crate) deltas: bool,
    /// Whether the local side lacks the value, because it was not delivered or not accepted.
    pub(crate) owed: bool,
    /// The time of the last request to the writer for the fields of its messages.
    pub(crate) asked_layout: Option<Instant>,
    /// The time of the last request to the port for the local type.
    pub(crate) asked: Option<Instant>,
    /// The builtin type of each field in the current version, and whether the field is an array.
    pub(crate) shape: Option<Vec<(BuiltinType, bool)>>,
    /// The MajorVersion of its messages (OPC 10000-14, 6.2.3.2.6).
    major_version: Option<u32>,
    /// The time of the last accepted change of the announced type, and the number of changes.
    renamed: Option<(Instant, u32)>,
    /// The pending notifications of the port about the topic.
    pub(crate) news: PendingNotifications,
}

/// The pending notifications of the port about a topic, in this order.
#[derive(Debug, Default)]
pub(crate) struct PendingNotifications {
    /// Whether the topic is in the Router's list of topics with news.
    pub(crate) queued: bool,
    /// Whether the silence of the writer has changed.
    pub(crate) silence: bool,
    /// The pending request for a local type.
    pub(crate) ask: Option<LocalTypeRequest>,
}

/// The condition for a request to the port for the local type of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LocalTypeRequest {
    /// Only if the writer announces its type, because a local type exists.
    IfDescribed,
    /// Always, because no local type exists.
    Always,
}

/// A sample that was delivered, or that was not delivered because its writer had stored it.
#[derive(Debug)]
struct DeliveredSample {
    stamp: Timestamp,
    heard: Instant,
    repeated: bool,
    /// Whether the sample is a current value of the topic.
    live: bool,
    /// The way in which the sample was delivered.
    handed: Handed,
}

/// The way in which a sample was delivered to the local side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Handed {
    /// Not delivered: the writer stored it, and it may be an event.
    No,
    /// Delivered to present subscribers.
    Once,
    /// Delivered to present subscribers and late joiners.
    Lasting,
}

/// The way in which the values of a topic are delivered to the local side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Handling {
    /// The last value is shown, whether event or state.
    Shown,
    /// Each value is published once in ROS.
    Event,
    /// The value is published in ROS and stored for late joiners.
    State,
    /// A state if its writer repeats it as a state, else an event.
    AsSource,
}

impl Handling {
    pub(crate) const fn of(local: Local, lasting: Lasting) -> Self {
        match (local, lasting) {
            (Local::Fields, _) => Self::Shown,
            (_, Lasting::Event) => Self::Event,
            (_, Lasting::State) => Self::State,
            (_, Lasting::AsSource) => Self::AsSource,
        }
    }
}

/// The relation of an accepted message to the other messages of its writer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AcceptedMessage {
    /// The number of messages that are missing before it.
    pub(crate) missing: u16,
    /// The relation to the topic's other values.
    pub(crate) kept: ValueRelation,
    /// Whether late joiners receive the value.
    pub(crate) lasting: bool,
}

impl ReceivedTopicState {
    pub(crate) const fn new(from: Option<SocketAddr>, now: Instant) -> Self {
        Self {
            sequence: None,
            stamp: None,
            from,
            moved: 0,
            heard: now,
            good: now,
            dropped: None,
            silent: false,
            known: VecDeque::new(),
            several: None,
            lasting: false,
            prompt: false,
            still: false,
            over: false,
            withdrawn: None,
            held: None,
            receipt: None,
            base: None,
            deltas: false,
            owed: true,
            asked_layout: None,
            asked: None,
            shape: None,
            major_version: None,
            renamed: None,
            news: PendingNotifications {
                queued: false,
                silence: false,
                ask: None,
            },
        }
    }

    /// Returns the time of the last message of the writer.
    pub(crate) const fn heard_at(&self) -> Instant {
        self.heard
    }

    /// Returns whether the writer has ever been received.
    pub(crate) const fn was_heard(&self) -> bool {
        self.from.is_some()
    }

    /// Returns whether the topic is silent.
    pub(crate) const fn is_silent(&self) -> bool {
        self.silent
    }

    /// Returns the number of sender changes since the last call.
    pub(crate) const fn take_moved(&mut self) -> u64 {
        std::mem::replace(&mut self.moved, 0)
    }

    /// Records a message of the writer.
    pub(crate) const fn heard(&mut self, now: Instant) {
        self.heard = now;
    }

    /// Records that the topic has a good value. Returns whether it was silent before.
    pub(crate) fn is_good(&mut self, now: Instant) -> bool {
        self.good = now;
        self.dropped = None;
        std::mem::take(&mut self.silent)
    }

    /// Records a sign of life without a value: the last value is valid unless a newer value was
    /// dropped. Returns whether this ends a silence.
    pub(crate) fn lives(&mut self, now: Instant) -> bool {
        match self.dropped {
            // Duplicate and stale messages do not affect the current value.
            None | Some(Reason::Duplicate | Reason::Stale) => self.is_good(now),
            Some(_) => false,
        }
    }

    /// Records that a message of the writer was dropped, if the topic is left with an old value.
    pub(crate) const fn dropped(&mut self, reason: Reason) {
        let says_nothing = matches!(reason, Reason::Duplicate | Reason::Stale);
        if reason.is_loss() && !(says_nothing && self.dropped.is_some()) {
            self.dropped = Some(reason);
        }
    }

    /// Returns whether the sender may be the writer. If the writer was not received for `timeout`,
    /// any sender may be.
    pub(crate) fn may_be(&self, from: SocketAddr, now: Instant, timeout: Duration) -> bool {
        self.from.is_none_or(|known| known == from)
            || now.saturating_duration_since(self.heard) >= timeout
    }

    /// Records the version of a message. Returns whether the version has changed, so that the known
    /// content is invalid.
    pub(crate) fn is_changed(&mut self, major_version: Option<u32>) -> bool {
        let before = std::mem::replace(&mut self.major_version, major_version);
        let changed = before.is_some() && before != major_version;
        if changed {
            self.shape = None;
        }
        changed
    }

    /// Returns whether an announced type of the topic may be applied. `known` is whether a type was
    /// known before.
    ///
    /// Each change makes the port reopen the topic, and any sender that forges the writer's address
    /// can announce changes. The first type and the first change are accepted at once. Each further
    /// change is accepted only after twice the waiting time of the previous change.
    pub(crate) fn may_be_renamed(&mut self, known: bool, now: Instant) -> bool {
        let (since, times) = match self.renamed {
            Some(renamed) => renamed,
            None if known => (now, 0),
            None => {
                self.renamed = Some((now, 0));
                return true;
            }
        };
        let passed = now.saturating_duration_since(since);
        let wait = match times.checked_sub(1) {
            Some(again) => RENAME_AFTER * (1_u32 << again.min(MOST_DOUBLINGS)),
            None => Duration::ZERO,
        };
        if passed < wait {
            return false;
        }
        let forgiven = passed >= RENAME_AFTER * (1_u32 << MOST_DOUBLINGS);
        let times = if forgiven { 1 } else { times.saturating_add(1) };
        self.renamed = Some((now, times));
        true
    }

    /// Returns true once per silence, when the topic has had no good value for `timeout`.
    pub(crate) fn fell_silent(&mut self, now: Instant, timeout: Duration) -> bool {
        let fell = !self.silent && now.saturating_duration_since(self.good) >= timeout;
        self.silent |= fell;
        if fell {
            // After its return the writer may send other content.
            self.shape = None;
            self.over = true;
            self.receipt = None;
        }
        fell
    }

    /// Records that the writer announced its end. Returns whether the topic was not silent before.
    pub(crate) fn leave(&mut self) -> bool {
        self.shape = None;
        self.over = true;
        self.receipt = None;
        !std::mem::replace(&mut self.silent, true)
    }

    /// Returns the reason why the newest message after the last good value was dropped, if it was.
    pub(crate) const fn loss(&self) -> Option<Reason> {
        self.dropped
    }

    /// Returns the time of the next check for silence; `None` while the topic is silent.
    pub(crate) fn due(&self, timeout: Duration) -> Option<Instant> {
        (!self.silent).then(|| self.good + timeout)
    }

    /// Admits a message into the sequence.
    ///
    /// The order of sequence numbers is as in OPC 10000-14, 7.2.3. A restarted writer has numbers
    /// that look old; its stamps or its new address show the restart. A writer with a clock that
    /// was set back seems to repeat older values; the continued sequence numbers and a fresh sample
    /// show the difference.
    ///
    /// # Errors
    /// Returns the reason to drop the message: its number was already received, a newer message was
    /// received, it repeats a value that the local side has, or it is a stored value that may be an
    /// event.
    pub(crate) fn admit(
        &mut self,
        place: SequencePosition,
        message: Option<&DataSetMessage<'_>>,
        handling: Handling,
        now: Instant,
    ) -> Result<AcceptedMessage, Reason> {
        let is_elsewhere = self.from.is_some_and(|from| from != place.from);
        let moved = is_elsewhere && !self.is_copy(&place);
        if is_elsewhere && !moved {
            self.moved += 1;
            self.from = Some(place.from);
        }
        let again = place.stamp.is_some() && place.stamp == self.stamp;
        let restarted = moved
            || (self.over && !again && !self.came_before(&place, handling))
            || matches!((place.stamp, self.stamp), (Some(new), Some(last)) if new > last);
        let first = self.sequence.is_none() || moved || self.over;
        let mut next = false;
        let missing = match (self.sequence, place.sequence) {
            (Some(last), Some(sequence)) => match SequenceOrder::of_u16(last, sequence) {
                // The local side does not have the value yet.
                SequenceOrder::Same if handling == Handling::Shown && self.owed => 0,
                SequenceOrder::Same if !restarted => return Err(self.again(&place)),
                SequenceOrder::Older { .. } if !restarted => return Err(Reason::Stale),
                SequenceOrder::Newer { missed } => {
                    next = true;
                    // Another sender counts on its own, or skips numbers.
                    if moved {
                        0
                    } else {
                        u16::try_from(missed).unwrap_or(u16::MAX)
                    }
                }
                SequenceOrder::Same | SequenceOrder::Older { .. } | SequenceOrder::Invalid => 0,
            },
            (_, _) => 0,
        };
        self.sequence = place.sequence;
        self.over = false;
        self.from = Some(place.from);
        self.moved += u64::from(moved);
        if moved {
            self.lasting = false;
            self.prompt = false;
            self.still = false;
        }
        self.prompt |= place.is_fresh();
        if next && self.is_set_back(place) {
            self.forget_all();
            self.stamp = None;
        }
        let stamp = place.instance().filter(|_| !self.still);
        let same = stamp.is_none_or(|stamp| self.is_same(stamp, message));
        if !same {
            // Another value has the same stamp.
            self.still = true;
            self.known.clear();
        }
        let stamp = stamp.filter(|_| same);
        let kept = match stamp {
            // The sample is newer than all previous samples, as nearly every sample is.
            Some(stamp) if self.several.is_none() && self.stamp.is_none_or(|last| stamp > last) => {
                ValueRelation::Alone
            }
            Some(stamp) => self.recognise((stamp, &place), handling, now)?,
            None => ValueRelation::Alone,
        };
        if kept != ValueRelation::Again {
            self.stamp = place.stamp.or(self.stamp);
        }
        let lasting = match handling {
            Handling::State => true,
            Handling::AsSource => self.lasting,
            Handling::Shown | Handling::Event => false,
        };
        let into_ros = matches!(handling, Handling::Event | Handling::AsSource);
        // Clients of an OPC UA server set the stamps of its values.
        let is_stored = place.is_stored() && stamp.is_some() && !place.by_clients;
        if into_ros && !lasting && is_stored && (first || self.prompt) {
            if let Some(stamp) = stamp {
                self.note(stamp, (kept, Handed::No), now);
            }
            return Err(Reason::Repeat);
        }
        Ok(AcceptedMessage {
            missing,
            kept,
            lasting,
        })
    }

    /// Returns whether a message is a copy of the newest message, by its number and its precise
    /// stamp. A restarted writer takes its samples anew, so a copy from another address is of the
    /// same writer, which has another socket: its network interface was lost and is back.
    fn is_copy(&self, place: &SequencePosition) -> bool {
        let stamp = place.instance().filter(|_| !self.still);
        place.sequence.is_some()
            && place.sequence == self.sequence
            && stamp.is_some()
            && stamp == self.stamp
    }

    /// Handles a repetition of the newest message under its own number. Writers repeat events in
    /// case they are lost, and stored values for readers that show them.
    fn again(&mut self, place: &SequencePosition) -> Reason {
        let (Some(stamp), Some(last)) = (place.instance(), self.stamp) else {
            return Reason::Duplicate;
        };
        if stamp != last {
            return Reason::Duplicate;
        }
        if place.is_stored() && std::mem::take(&mut self.lasting) {
            self.withdrawn = Some(stamp);
        }
        Reason::Repeat
    }

    /// Returns whether a sample was delivered, by its stamp or its sequence number. After the end
    /// of a writer this distinguishes a datagram delayed by the network from the first datagram of
    /// a restarted writer. A stored value of a restarted writer is not an event.
    fn came_before(&self, place: &SequencePosition, handling: Handling) -> bool {
        let is_known = |stamp| self.known.iter().any(|known| known.stamp == stamp);
        let stored = place.is_stored() && handling != Handling::Event;
        match place.instance() {
            Some(stamp) => !stored && is_known(stamp),
            None => self.is_resent(place, handling),
        }
    }

    /// Returns whether a sample without a precise stamp is one of the last samples that a broker
    /// delivered. After a lost connection to the broker, a writer sends the states again that were
    /// not confirmed.
    fn is_resent(&self, place: &SequencePosition, handling: Handling) -> bool {
        let (Some(last), Some(sequence)) = (self.sequence, place.sequence) else {
            return false;
        };
        let order = SequenceOrder::of_u16(last, sequence);
        let is_near = matches!(
            order,
            SequenceOrder::Older {
                by: 1..=MOST_RESENT
            }
        );
        let is_older = matches!((place.stamp, self.stamp), (Some(of), Some(last)) if of <= last);
        place.is_relayed && handling != Handling::Event && is_near && is_older
    }

    /// Returns the stamp of the value that the local side must not store any more.
    pub(crate) const fn take_withdrawn(&mut self) -> Option<Timestamp> {
        self.withdrawn.take()
    }

    /// Returns whether a message with the stamp of the newest message has the same value, if both
    /// values are known.
    fn is_same(&self, stamp: Timestamp, message: Option<&DataSetMessage<'_>>) -> bool {
        if self.stamp != Some(stamp) {
            return true;
        }
        match (&self.base, message) {
            (Some(base), Some(message)) => base.is_same(message, stamp),
            (_, _) => true,
        }
    }

    /// Returns whether a sample that follows the last sample was taken before it, because the clock
    /// was set back.
    fn is_set_back(&self, place: SequencePosition) -> bool {
        let older = matches!((place.stamp, self.stamp), (Some(new), Some(last)) if new < last);
        let known = || {
            self.known
                .iter()
                .any(|known| Some(known.stamp) == place.stamp)
        };
        older && place.is_fresh() && !known()
    }

    /// Determines the relation of a sample that may be a repetition.
    fn recognise(
        &mut self,
        (stamp, place): (Timestamp, &SequencePosition),
        handling: Handling,
        now: Instant,
    ) -> Result<ValueRelation, Reason> {
        let newest = self.stamp == Some(stamp);
        let older = self.stamp.is_some_and(|last| stamp < last);
        let known = self.known.iter_mut().find(|known| known.stamp == stamp);
        // An older value is repeated after a newer value, so the writer has several values.
        if (known.is_some() && !newest) || (known.is_none() && older) {
            self.several = Some(now);
        }
        let Some(known) = known else {
            return Ok(if self.several.is_some() {
                ValueRelation::Beside
            } else {
                ValueRelation::Alone
            });
        };
        known.heard = now;
        known.repeated = true;
        // Only states are repeated under new sequence numbers.
        self.lasting = true;
        let handed = known.handed;
        match (handling, handed) {
            (Handling::Event, _) if place.is_stored() => Err(Reason::Repeat),
            // The same event is sent twice with the same stamp.
            (Handling::Event, _) | (_, Handed::No) => {
                self.known.retain(|known| known.stamp != stamp);
                Ok(match self.several {
                    Some(_) => ValueRelation::Beside,
                    None => ValueRelation::Alone,
                })
            }
            (Handling::AsSource, Handed::Once) => Ok(ValueRelation::Again),
            (_, Handed::Once | Handed::Lasting) if known.live => Err(Reason::Repeat),
            (_, Handed::Once | Handed::Lasting) => Ok(ValueRelation::Again),
        }
    }

    /// Records that a sample is delivered, so that its repetitions are recognised. Returns the
    /// stamp of the sample that was removed from the record for it, if that sample is still a
    /// current value.
    pub(crate) fn delivered(
        &mut self,
        instance: Option<Timestamp>,
        (kept, lasting): (ValueRelation, bool),
        now: Instant,
    ) -> Option<Timestamp> {
        self.owed = false;
        let Some(stamp) = instance.filter(|_| !self.still) else {
            self.known.clear();
            return None;
        };
        let handed = if lasting {
            Handed::Lasting
        } else {
            Handed::Once
        };
        self.note(stamp, (kept, handed), now)
    }

    fn note(
        &mut self,
        stamp: Timestamp,
        (kept, handed): (ValueRelation, Handed),
        now: Instant,
    ) -> Option<Timestamp> {
        let mut repeated = false;
        match kept {
            ValueRelation::Again => {
                if let Some(known) = self.known.iter_mut().find(|known| known.stamp == stamp) {
                    known.live = true;
                    known.handed = handed;
                }
                return None;
            }
            ValueRelation::Alone => {
                // A topic with a single value has no other current value than the last.
                if let Some(last) = self.known.back_mut() {
                    last.live = false;
                }
            }
            // A newer sample was received before, so this is a repetition of a sample that was
            // missed.
            ValueRelation::Beside => repeated = self.known.iter().any(|known| known.stamp > stamp),
        }
        let evicted = (self.known.len() >= MAX_KNOWN).then(|| self.evict());
        self.known.push_back(DeliveredSample {
            stamp,
            heard: now,
            repeated,
            live: true,
            handed,
        });
        evicted
            .flatten()
            .filter(|known| known.live)
            .map(|known| known.stamp)
    }

    /// Marks all values as not stored by the local side, because the writer has ended or timed out.
    /// A repetition brings the value back.
    pub(crate) fn withdraw(&mut self) {
        for known in &mut self.known {
            known.live = false;
        }
    }

    /// Removes the oldest sample; with several values preferably a sample that was never repeated.
    fn evict(&mut self) -> Option<DeliveredSample> {
        let seldom = match self.several {
            Some(_) => self.known.iter().position(|known| !known.repeated),
            None => None,
        };
        self.known.remove(seldom.unwrap_or(0))
    }

    /// Returns the stamp of the next value that the writer has not repeated for `after` while it
    /// repeated others. Call it after each key frame until it returns `None`.
    pub(crate) fn retire(&mut self, now: Instant, after: Duration) -> Option<Timestamp> {
        let several = self.several?;
        let ended = now.saturating_duration_since(several) >= after;
        let newest = self.stamp;
        let mut live = self.known.iter_mut().filter(|known| known.live);
        let gone = live.find(|known| {
            now.saturating_duration_since(known.heard) >= after
                || (ended && Some(known.stamp) != newest)
        });
        if let Some(gone) = gone {
            gone.live = false;
            return Some(gone.stamp);
        }
        let mut live = self.known.iter().filter(|known| known.live);
        if let (last, None) = (live.next(), live.next()) {
            self.several = None;
            self.stamp = last.map(|known| known.stamp).or(self.stamp);
        }
        None
    }

    /// Records that a sample was not delivered after all, so that its repetition is accepted.
    pub(crate) fn forget(&mut self, instance: Option<Timestamp>) {
        self.owed = true;
        self.known.retain(|known| Some(known.stamp) != instance);
    }

    /// Removes all records of delivered samples, because the local type has changed and the next
    /// repetition is needed.
    pub(crate) fn forget_all(&mut self) {
        self.owed = true;
        self.known.clear();
        self.several = None;
        self.receipt = None;
    }
}

/// The maximum number of states that a writer sends to a broker again. Bridges send at most 20.
const MOST_RESENT: u32 = 32;
/// The number of samples with recognised repetitions: as many as a writer keeps.
const MAX_KNOWN: usize = MAX_KEPT;
/// The waiting time of the second change of an announced type, and the maximum number of its
/// doublings.
const RENAME_AFTER: Duration = Duration::from_secs(10);
const MOST_DOUBLINGS: u32 = 8;

#[cfg(test)]
mod tests;
