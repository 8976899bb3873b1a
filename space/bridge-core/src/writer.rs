//! The state of a DataSetWriter of the own space.

use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::SpaceId;
use uadp::Timestamp;

use crate::confirm::{AwaitedEvent, ConfirmedArrival, Confirming, Mark};
use crate::message::{EncodedSample, SampleMessage};
use crate::output::PublisherKey;

/// The state of a sent topic.
#[derive(Debug)]
pub(crate) struct SentTopicState {
    /// The sequence number of the next DataSetMessage.
    sequence: u16,
    /// The time at which the last sample was taken, as in its message.
    taken: Option<Timestamp>,
    /// The time of the last sent message of the topic.
    sent: Instant,
    /// The time at which the value was last sent; with several values, the start of the last
    /// repetition.
    value_sent: Instant,
    /// Whether the topic has a producer. Without a producer nothing is repeated, so that readers
    /// detect the silence.
    live: bool,
    /// The samples to repeat in the order in which they were taken: the last sample, or the last
    /// sample of each latched publisher. Empty for topics of events, and before the first sample.
    kept: Vec<LastSample>,
    /// The index of the next sample in the current round of repetitions; past the end if the round
    /// is complete.
    next: usize,
    /// Whether any sample was sent.
    started: bool,
    /// Whether the repetitions of the value are spread among the repetitions of other topics.
    is_spread: bool,
    /// The newest event, while it is repeated in case it is lost.
    again: Option<Again>,
    /// The outcome of the newest event, if other spaces confirm it.
    arrival: Option<ConfirmedArrival>,
    /// Whether the outcome was not reported yet.
    is_news: bool,
}

/// An event that is repeated under its sequence number: twice for a single datagram, or until it is
/// confirmed if a confirmation is awaited.
#[derive(Debug)]
struct Again {
    /// The message, unless it is also kept as the last value.
    message: Option<EncodedSample>,
    /// The message, if it is large.
    large: Option<Arc<EncodedSample>>,
    /// The missing confirmations.
    awaited: Option<AwaitedEvent>,
    /// The time at which it was first sent.
    since: Instant,
    /// The number of repetitions.
    times: usize,
    /// Whether the next repetition is due.
    is_due: bool,
}

/// The last sample of a latched publisher, or of all publishers that do not latch.
#[derive(Debug)]
struct LastSample {
    publisher: Option<PublisherKey>,
    /// Whether it is repeated as a state, under a new sequence number. The last event is repeated
    /// under its own number for readers that show it; readers that already have it drop it.
    is_state: bool,
    message: SampleMessage,
    /// Whether its stamp is the stamp of another bridge, which sends this topic while this bridge
    /// is muted.
    is_adopted: bool,
}

/// The next action of a writer without new samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Idle {
    Repeat,
    KeepAlive,
}

impl SentTopicState {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            sequence: 0,
            taken: None,
            sent: now,
            value_sent: now,
            live: true,
            kept: Vec::new(),
            next: usize::MAX,
            started: false,
            is_spread: false,
            again: None,
            arrival: None,
            is_news: false,
        }
    }

    /// Returns the number of the next DataSetMessage and advances it.
    pub(crate) const fn next_sequence(&mut self) -> u16 {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        sequence
    }

    /// Returns the stamp of a sample taken at `taken`, or a stamp just after the previous sample if
    /// `taken` is not later.
    ///
    /// Two samples never share a stamp, because readers recognise repetitions by it. A clock that
    /// was set back is followed.
    pub(crate) fn stamp(&mut self, taken: Timestamp) -> Timestamp {
        let stamp = match self.taken.map(|last| last.unix_nanos()) {
            Some(last) if (0..STEP_BACK).contains(&(last - taken.unix_nanos())) => {
                Timestamp::from_unix_nanos(last + 1)
            }
            _ => taken,
        };
        self.taken = Some(stamp);
        stamp
    }

    /// Continues with the sequence number and the stamp of another bridge, which sends this topic
    /// while this bridge is muted.
    pub(crate) fn follow(&mut self, next: u16, stamp: Option<Timestamp>) {
        self.sequence = next;
        self.started = true;
        let is_later = |taken: Timestamp| stamp.is_some_and(|stamp| stamp > taken);
        if self.taken.is_none_or(is_later) {
            self.taken = stamp.or(self.taken);
        }
    }

    /// Sets the stamp of another bridge for the kept sample with these fields. Readers then
    /// recognise its repetitions. Returns whether there is such a sample.
    pub(crate) fn adopt(&mut self, fields: &[u8], stamp: Timestamp) -> bool {
        for kept in &mut self.kept {
            if let SampleMessage::Datagram(encoded) = &mut kept.message
                && encoded.fields().is_ok_and(|own| own == fields)
            {
                encoded.take_at(stamp);
                kept.is_adopted = true;
                return true;
            }
        }
        false
    }

    /// Gives the only kept sample a stamp of its own, because the other bridge has sent another
    /// value since.
    pub(crate) fn disown(&mut self, utc: Timestamp) {
        let [
            LastSample {
                is_adopted: true, ..
            },
        ] = self.kept.as_slice()
        else {
            return;
        };
        let stamp = self.stamp(utc);
        if let Some(kept) = self.kept.first_mut()
            && let SampleMessage::Datagram(encoded) = &mut kept.message
        {
            encoded.take_at(stamp);
            kept.is_adopted = false;
        }
    }

    /// Ends all repetitions without an outcome for the newest event.
    pub(crate) fn end_repetitions(&mut self) {
        self.supersede();
        self.next = usize::MAX;
    }

    /// Continues after another bridge that has sent this topic: skips sequence numbers that the
    /// other bridge may have used.
    pub(crate) fn continue_after(&mut self, skipped: u16) {
        self.end_repetitions();
        if self.started {
            self.sequence = self.sequence.wrapping_add(skipped);
        }
    }

    /// Returns the sequence number of a keep-alive: the number of the next expected message
    /// (OPC 10000-14 7.2.4.5.8).
    pub(crate) const fn expected_sequence(&self) -> u16 {
        self.sequence
    }

    /// Records a sent sample.
    pub(crate) fn sent(&mut self, now: Instant) {
        self.sent = now;
        self.live = true;
        self.started = true;
        self.is_spread = false;
        if self.kept.len() <= 1 {
            self.value_sent = now;
        }
    }

    /// Keeps a sample for repetition in place of the previous sample of the publisher. Returns
    /// whether the oldest sample was removed because [`MAX_KEPT`] was reached.
    pub(crate) fn keep(
        &mut self,
        (publisher, is_state): (Option<PublisherKey>, bool),
        message: &SampleMessage,
    ) -> bool {
        let found = self
            .kept
            .iter()
            .position(|kept| kept.publisher == publisher);
        let mut gave_way = false;
        match found.and_then(|at| Some((at, self.kept.get_mut(at)?))) {
            Some((at, kept)) => {
                kept.is_state = is_state;
                kept.is_adopted = false;
                match (&mut kept.message, message) {
                    (SampleMessage::Datagram(last), SampleMessage::Datagram(new)) => {
                        last.bytes.clone_from(&new.bytes);
                        last.timestamp_at = new.timestamp_at;
                        last.payload_at = new.payload_at;
                        last.sequence_at = new.sequence_at;
                    }
                    (last, new) => *last = new.share(),
                }
                self.leave_round(at);
                if let Some(later) = self.kept.get_mut(at..) {
                    later.rotate_left(1);
                }
            }
            None => {
                gave_way = self.kept.len() >= MAX_KEPT;
                if gave_way {
                    self.kept.remove(0);
                    self.leave_round(0);
                }
                self.kept.push(LastSample {
                    publisher,
                    is_state,
                    message: message.share(),
                    is_adopted: false,
                });
            }
        }
        if self.kept.len() == 1 {
            // The sample is being sent at this moment.
            self.next = usize::MAX;
        }
        gave_way
    }

    /// Removes all samples to repeat.
    pub(crate) fn keep_nothing(&mut self) {
        self.kept.clear();
        self.end_again();
        self.next = usize::MAX;
    }

    /// Removes the sample of a publisher that has left.
    pub(crate) fn forget(&mut self, publisher: PublisherKey) {
        let found = self
            .kept
            .iter()
            .position(|kept| kept.publisher == Some(publisher));
        if let Some(at) = found {
            self.kept.remove(at);
            self.leave_round(at);
        }
    }

    /// Records a sent message without a value: a keep-alive or a chunk.
    pub(crate) const fn spoke(&mut self, now: Instant) {
        self.sent = now;
    }

    /// Starts a round of repetitions.
    pub(crate) const fn begin_round(&mut self, now: Instant) {
        self.next = 0;
        self.sent = now;
        self.value_sent = now;
    }

    /// Sends the next repetition or keep-alive earlier by `lead` than its period says, once after
    /// each sample: the later ones keep this phase.
    pub(crate) fn spread(&mut self, idle: Idle, lead: Duration) {
        if std::mem::replace(&mut self.is_spread, true) {
            return;
        }
        let last = match idle {
            Idle::Repeat => &mut self.value_sent,
            Idle::KeepAlive => &mut self.sent,
        };
        *last = last.checked_sub(lead).unwrap_or(*last);
    }

    /// Returns whether the round of repetitions is incomplete.
    pub(crate) fn repeats(&self) -> bool {
        self.next < self.kept.len() || self.is_again_due()
    }

    /// Returns the next sample of the round of repetitions; `None` if a repetition of the newest
    /// event is due.
    pub(crate) fn next_repeated(&self) -> Option<&SampleMessage> {
        if self.is_again_due() {
            // A repeated event is sent alone, because it is short and must not wait.
            return None;
        }
        self.kept.get(self.next).map(|kept| &kept.message)
    }

    /// Returns the newest event if its repetition is due, else the next sample of the round: a
    /// state with a new sequence number, an event with its own. `buffer` returns a buffer for the
    /// datagram.
    pub(crate) fn repeat(&mut self, buffer: impl FnOnce() -> Vec<u8>) -> Option<SampleMessage> {
        if self.is_again_due() {
            return self.event_again(buffer);
        }
        let next = self.sequence;
        let newest = next.wrapping_sub(1);
        let kept = loop {
            let kept = self.kept.get_mut(self.next)?;
            self.next += 1;
            // A message that is still being sent needs no repetition.
            let Some(sequence) = (match &mut kept.message {
                SampleMessage::Large(last) => Arc::get_mut(last).map(|last| {
                    if kept.is_state {
                        last.number(next);
                    }
                    last.sequence()
                }),
                SampleMessage::Datagram(last) => Some(last.sequence()),
            }) else {
                continue;
            };
            // An event that is not the newest message would come late.
            if kept.is_state || sequence == newest {
                break kept;
            }
        };
        if kept.is_state {
            self.sequence = next.wrapping_add(1);
        }
        Some(match &kept.message {
            SampleMessage::Datagram(last) => {
                let mut bytes = buffer();
                bytes.clone_from(&last.bytes);
                let mut again = EncodedSample { bytes, ..*last };
                if kept.is_state {
                    again.number(next);
                }
                SampleMessage::Datagram(again)
            }
            large @ SampleMessage::Large(_) => large.share(),
        })
    }

    /// Returns the newest event for repetition.
    fn event_again(&mut self, buffer: impl FnOnce() -> Vec<u8>) -> Option<SampleMessage> {
        let again = self.again.as_mut()?;
        again.is_due = false;
        if let Some(large) = &again.large {
            let kept = self.kept.iter().filter(
                |kept| matches!(&kept.message, SampleMessage::Large(kept) if Arc::ptr_eq(kept, large)),
            );
            // A message that is still being sent needs no repetition.
            let is_sent = Arc::strong_count(large) == 1 + kept.count();
            return is_sent.then(|| SampleMessage::Large(Arc::clone(large)));
        }
        let mut kept = self.kept.iter();
        let message = match &again.message {
            Some(message) => Some(message),
            None => kept.find_map(|kept| match &kept.message {
                SampleMessage::Datagram(message) if kept.publisher.is_none() => Some(message),
                SampleMessage::Datagram(_) | SampleMessage::Large(_) => None,
            }),
        };
        let message = message.map(|message| {
            let mut bytes = buffer();
            bytes.clone_from(&message.bytes);
            SampleMessage::Datagram(EncodedSample { bytes, ..*message })
        });
        if again.awaited.is_none() && again.times >= AGAIN.len() {
            self.again = None;
        }
        message
    }

    /// Returns whether a repetition of the newest event is due.
    fn is_again_due(&self) -> bool {
        self.again.as_ref().is_some_and(|again| again.is_due)
    }

    /// Plans the repetition of a sample if it is an event in a single datagram or `confirmed`. It
    /// replaces the previous event, which is not repeated any more.
    pub(crate) fn send_again(
        &mut self,
        message: &SampleMessage,
        (is_state, is_kept): (bool, bool),
        confirmed: Option<&Confirming>,
        now: Instant,
    ) {
        self.supersede_arrival();
        let confirmed = confirmed.filter(|_| !is_state);
        let mark = message.encoded().mark();
        let awaited = confirmed.and_then(|confirmed| Some(confirmed.await_event(mark?, now)));
        let large = match message {
            SampleMessage::Large(large) => Some(Arc::clone(large)),
            SampleMessage::Datagram(_) => None,
        };
        if is_state || (large.is_some() && awaited.is_none()) {
            self.again = None;
            return;
        }
        let again = self.again.get_or_insert(Again {
            message: None,
            large: None,
            awaited: None,
            since: now,
            times: 0,
            is_due: false,
        });
        (again.since, again.times, again.is_due) = (now, 0, false);
        (again.large, again.awaited) = (large, awaited);
        let SampleMessage::Datagram(message) = message else {
            again.message = None;
            return;
        };
        if is_kept {
            again.message = None;
            return;
        }
        let copy = again.message.get_or_insert_default();
        copy.bytes.clone_from(&message.bytes);
        copy.timestamp_at = message.timestamp_at;
        copy.payload_at = message.payload_at;
        copy.sequence_at = message.sequence_at;
    }

    /// Returns the time of the next repetition of the newest event.
    pub(crate) fn again_at(&self) -> Option<Instant> {
        let again = self.again.as_ref()?;
        let Some(awaited) = &again.awaited else {
            return Some(again.since + *AGAIN.get(again.times)?);
        };
        let period = match again.large {
            Some(_) => LARGE_AWAITED,
            None => AWAITED,
        };
        let early = AGAIN.get(again.times).filter(|_| again.large.is_none());
        let times = u32::try_from(again.times).unwrap_or(u32::MAX);
        let at = early.map_or_else(|| period.saturating_mul(times.saturating_add(1)), |at| *at);
        Some((again.since + at).min(awaited.until))
    }

    /// Returns whether to repeat the newest event. An overdue event is given up, because it would
    /// come late.
    pub(crate) fn look_again(&mut self, now: Instant) -> bool {
        if self.again_at().is_none_or(|at| at > now) {
            return false;
        }
        let Some(again) = &mut self.again else {
            return false;
        };
        let is_over = match &again.awaited {
            Some(awaited) => now >= awaited.until,
            None => now.saturating_duration_since(again.since) > AGAIN_WITHIN,
        };
        if is_over {
            self.end_again();
            return false;
        }
        again.times += 1;
        again.is_due = true;
        if again.awaited.is_some() {
            // Missed repetitions are skipped.
            while self.again_at().is_some_and(|at| at <= now) {
                if let Some(again) = &mut self.again {
                    again.times += 1;
                }
            }
        }
        true
    }

    /// Stops the repetition of the newest event. The outcome is unknown for spaces that have not
    /// confirmed it.
    fn end_again(&mut self) {
        let awaited = self.again.take().and_then(|again| again.awaited);
        if let Some(awaited) = awaited {
            self.arrival = Some(ConfirmedArrival::Unknown(awaited.spaces));
            self.is_news = true;
        }
    }

    /// Stops the repetition of the newest event, because a newer sample waits for its publication.
    pub(crate) fn supersede(&mut self) {
        self.supersede_arrival();
        self.again = None;
    }

    fn supersede_arrival(&mut self) {
        (self.arrival, self.is_news) = (None, false);
    }

    /// Returns whether the confirmation of an event by a space is missing.
    pub(crate) fn is_awaited(&self, mark: Mark, space: SpaceId) -> bool {
        let again = self.again.as_ref();
        let awaited = again.and_then(|again| again.awaited.as_ref());
        awaited.is_some_and(|awaited| awaited.is_awaited(mark, space))
    }

    /// Records that a space has confirmed the newest event.
    pub(crate) fn confirm(&mut self, space: SpaceId) {
        let Some(again) = &mut self.again else { return };
        if !again
            .awaited
            .as_mut()
            .is_some_and(|awaited| awaited.confirm(space))
        {
            return;
        }
        again.awaited = None;
        let is_over = again.large.is_some() || again.times >= AGAIN.len();
        if is_over {
            self.again = None;
        }
        self.arrival = Some(ConfirmedArrival::Confirmed);
        self.is_news = true;
    }

    /// Returns the outcome of the newest event, if others confirm it and it is known.
    pub(crate) const fn arrival(&self) -> Option<&ConfirmedArrival> {
        self.arrival.as_ref()
    }

    /// Returns whether the outcome has become known since the last call.
    pub(crate) const fn take_news(&mut self) -> bool {
        std::mem::replace(&mut self.is_news, false)
    }

    pub(crate) fn set_live(&mut self, live: bool) {
        self.live = live;
        if !live {
            self.next = usize::MAX;
            let is_awaited = |again: &Again| again.awaited.is_some();
            if self.again.as_ref().is_some_and(is_awaited) {
                // A command does not outlive its commander.
                self.end_again();
            }
        }
    }

    /// Returns whether any sample was sent.
    pub(crate) const fn has_sent(&self) -> bool {
        self.started
    }

    /// Returns whether the topic has a producer.
    pub(crate) const fn is_live(&self) -> bool {
        self.live
    }

    /// Returns the time and kind of the next message without a new sample. Large values are
    /// repeated so rarely that they use at most a tenth of the pace of chunks.
    pub(crate) fn due(
        &self,
        key_frames: Duration,
        keep_alives: Duration,
    ) -> Option<(Instant, Idle)> {
        if !self.live || !self.started {
            return None;
        }
        let sending: Duration = self.kept.iter().map(|kept| kept.message.time()).sum();
        let keep_alive = (self.sent + keep_alives, Idle::KeepAlive);
        let repeat = (
            self.value_sent + key_frames.max(sending.saturating_mul(10)),
            Idle::Repeat,
        );
        // A repeated key frame contains all information of a keep-alive.
        let repeats_first = !self.kept.is_empty() && repeat.0 <= keep_alive.0;
        Some(if repeats_first { repeat } else { keep_alive })
    }

    /// Adjusts the round after the sample at `at` was moved or removed.
    const fn leave_round(&mut self, at: usize) {
        if self.next != usize::MAX && at < self.next {
            self.next -= 1;
        }
    }
}

/// The times of the repetitions of an event after it was first sent.
const AGAIN: [Duration; 2] = [Duration::from_millis(30), Duration::from_millis(80)];
/// The period of further repetitions of an event that is not confirmed, for small and for large
/// messages.
const AWAITED: Duration = Duration::from_millis(50);
const LARGE_AWAITED: Duration = Duration::from_millis(250);
/// The maximum age of an event for a repetition, unless a confirmation is awaited.
const AGAIN_WITHIN: Duration = Duration::from_millis(150);
/// The maximum number of kept samples per topic. It exceeds the number of latched publishers of a
/// topic in known graphs.
pub(crate) const MAX_KEPT: usize = 32;
/// The maximum difference in nanoseconds by which stamps of several publishers of a topic may be
/// out of order.
const STEP_BACK: i128 = 1_000_000_000;

#[cfg(test)]
mod tests;
