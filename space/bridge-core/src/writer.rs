//! What is remembered of one DataSetWriter of our own space.

use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::SpaceId;
use uadp::{DateTime, Timestamp};

use crate::confirm::{Arrival, Awaited, Confirming, Mark};
use crate::output::PublisherKey;
use crate::pace::Pace;

/// The state of a topic we send.
#[derive(Debug)]
pub(crate) struct Writer {
    /// The sequence number of the next DataSetMessage.
    sequence: u16,
    /// When the last sample was taken, as its message says.
    taken: Option<Timestamp>,
    /// When anything was last sent for it.
    sent: Instant,
    /// When its value was last sent; with several, when they were last repeated.
    value_sent: Instant,
    /// Whether the topic has a producer. Without one nothing is repeated, so that readers see it fall silent.
    live: bool,
    /// What is repeated, in the order it was taken: the last sample, or that of each latched publisher. Empty for
    /// topics of events, and before the first sample.
    kept: Vec<Kept>,
    /// Which of those is to be repeated next in this round; past the end, none.
    next: usize,
    /// Whether anything was sent at all.
    started: bool,
    /// The newest event, while it is sent again in case it is lost.
    again: Option<Again>,
    /// The outcome of the newest event, if others confirm it.
    arrival: Option<Arrival>,
    /// Whether the outcome was not reported yet.
    is_news: bool,
}

/// An event that is sent again under its sequence number: twice if it is one datagram, and until it is confirmed where that is
/// awaited.
#[derive(Debug)]
struct Again {
    /// The message, unless it is kept as the last value, too.
    message: Option<Encoded>,
    /// The message, if it is large.
    large: Option<Arc<Encoded>>,
    /// The confirmations that are missing.
    awaited: Option<Awaited>,
    /// When it was sent first.
    since: Instant,
    /// How often it was sent again.
    times: usize,
    /// Whether its next time has come.
    is_due: bool,
}

/// The last sample of one latched publisher, or of all that do not latch.
#[derive(Debug)]
struct Kept {
    publisher: Option<PublisherKey>,
    /// Whether it is repeated as a state: under a new sequence number. The last event is repeated under its own for
    /// readers that show it; readers that have it drop it.
    is_state: bool,
    message: Message,
}

/// What carries one sample.
#[derive(Debug)]
pub(crate) enum Message {
    /// One NetworkMessage.
    Datagram(Encoded),
    /// More than a datagram holds; it goes in chunks, cut from this one buffer.
    Large(Arc<Encoded>),
}

/// A NetworkMessage with one DataSetMessage, and where its numbers stand.
#[derive(Debug, Clone, Default)]
pub(crate) struct Encoded {
    pub(crate) bytes: Vec<u8>,
    /// Position of the NetworkMessage Timestamp, which PicoSeconds follow.
    pub(crate) timestamp_at: usize,
    /// Position of the DataSetMessage.
    pub(crate) payload_at: usize,
    /// Position of the DataSetMessage's sequence number.
    pub(crate) sequence_at: usize,
}

/// What a writer does next, left alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Idle {
    Repeat,
    KeepAlive,
}

impl Message {
    /// For keeping: of a large one the same buffer.
    fn share(&self) -> Self {
        match self {
            Self::Datagram(encoded) => Self::Datagram(encoded.clone()),
            Self::Large(encoded) => Self::Large(Arc::clone(encoded)),
        }
    }

    fn encoded(&self) -> &Encoded {
        match self {
            Self::Datagram(encoded) => encoded,
            Self::Large(encoded) => encoded,
        }
    }

    /// How long sending it takes, if that is worth a thought.
    fn time(&self) -> Duration {
        match self {
            Self::Datagram(_) => Duration::ZERO,
            Self::Large(encoded) => {
                Pace::time_of(u64::try_from(encoded.bytes.len()).unwrap_or(u64::MAX))
            }
        }
    }
}

impl Encoded {
    /// Sets the NetworkMessage Timestamp and PicoSeconds.
    pub(crate) fn stamp(&mut self, at: Timestamp) {
        patch(&mut self.bytes, self.timestamp_at, &at.time.0.to_le_bytes());
        patch(
            &mut self.bytes,
            self.timestamp_at + 8,
            &at.picoseconds.to_le_bytes(),
        );
    }

    /// The DataSetMessage alone.
    pub(crate) fn data_set_message(&self) -> &[u8] {
        self.bytes.get(self.payload_at..).unwrap_or_default()
    }

    /// The DataSetMessage's sequence number.
    pub(crate) fn sequence(&self) -> u16 {
        let number = self.bytes.get(self.sequence_at..).unwrap_or_default();
        number
            .first_chunk()
            .map_or(0, |number| u16::from_le_bytes(*number))
    }

    /// Returns the identity of the DataSetMessage among all of its writer. Its sequence number is followed by Timestamp and
    /// PicoSeconds in all that is sent here.
    fn mark(&self) -> Option<Mark> {
        let stamp = self.bytes.get(self.sequence_at.checked_add(2)?..)?;
        let (ticks, rest) = stamp.split_first_chunk()?;
        Some(Mark {
            sequence: self.sequence(),
            stamp: Timestamp {
                time: DateTime(i64::from_le_bytes(*ticks)),
                picoseconds: u16::from_le_bytes(*rest.first_chunk()?),
            },
        })
    }

    pub(crate) fn number(&mut self, sequence: u16) {
        patch(&mut self.bytes, self.sequence_at, &sequence.to_le_bytes());
    }
}

impl Writer {
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
            again: None,
            arrival: None,
            is_news: false,
        }
    }

    /// The number for the next DataSetMessage.
    pub(crate) const fn next_sequence(&mut self) -> u16 {
        let sequence = self.sequence;
        self.sequence = sequence.wrapping_add(1);
        sequence
    }

    /// The stamp for a sample taken at `taken`: that, or just after the sample before if it is not later.
    ///
    /// Two samples never share a stamp, since readers know repetitions by it. A clock that was set back is followed.
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

    /// The number a keep-alive carries: that of the next message to expect (OPC 10000-14 7.2.4.5.8).
    pub(crate) const fn expected_sequence(&self) -> u16 {
        self.sequence
    }

    /// Takes note of a sample sent.
    pub(crate) fn sent(&mut self, now: Instant) {
        self.sent = now;
        self.live = true;
        self.started = true;
        if self.kept.len() <= 1 {
            self.value_sent = now;
        }
    }

    /// Keeps a sample for repeating, in the place of the one before of that publisher. Says whether the oldest one
    /// gave way, since there are [`MAX_KEPT`].
    pub(crate) fn keep(
        &mut self,
        (publisher, is_state): (Option<PublisherKey>, bool),
        message: &Message,
    ) -> bool {
        let found = self
            .kept
            .iter()
            .position(|kept| kept.publisher == publisher);
        let mut gave_way = false;
        match found.and_then(|at| Some((at, self.kept.get_mut(at)?))) {
            Some((at, kept)) => {
                kept.is_state = is_state;
                match (&mut kept.message, message) {
                    (Message::Datagram(last), Message::Datagram(new)) => {
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
                self.kept.push(Kept {
                    publisher,
                    is_state,
                    message: message.share(),
                });
            }
        }
        if self.kept.len() == 1 {
            // It is just being sent.
            self.next = usize::MAX;
        }
        gave_way
    }

    /// No longer repeats anything.
    pub(crate) fn keep_nothing(&mut self) {
        self.kept.clear();
        self.end_again();
        self.next = usize::MAX;
    }

    /// No longer repeats the sample of a publisher that has gone.
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

    /// Takes note that something was sent that is no value: a keep-alive, or a piece of one.
    pub(crate) const fn spoke(&mut self, now: Instant) {
        self.sent = now;
    }

    /// Begins to repeat what is kept.
    pub(crate) const fn begin_round(&mut self, now: Instant) {
        self.next = 0;
        self.sent = now;
        self.value_sent = now;
    }

    /// Whether the round is not over.
    pub(crate) fn repeats(&self) -> bool {
        self.next < self.kept.len() || self.is_again_due()
    }

    /// What the round repeats next, unless it is large and still on its way.
    pub(crate) fn next_repeated(&self) -> Option<&Message> {
        if self.is_again_due() {
            // Alone: it is short and must not wait.
            return None;
        }
        self.kept.get(self.next).map(|kept| &kept.message)
    }

    /// The newest event once more if its time has come, else the next sample of the round: a state with a fresh sequence
    /// number, an event under its own. `buffer` gives one to write a datagram into.
    pub(crate) fn repeat(&mut self, buffer: impl FnOnce() -> Vec<u8>) -> Option<Message> {
        if self.is_again_due() {
            return self.event_again(buffer);
        }
        let next = self.sequence;
        let newest = next.wrapping_sub(1);
        let kept = loop {
            let kept = self.kept.get_mut(self.next)?;
            self.next += 1;
            // One that is still on its way needs no repetition.
            let Some(sequence) = (match &mut kept.message {
                Message::Large(last) => Arc::get_mut(last).map(|last| {
                    if kept.is_state {
                        last.number(next);
                    }
                    last.sequence()
                }),
                Message::Datagram(last) => Some(last.sequence()),
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
            Message::Datagram(last) => {
                let mut bytes = buffer();
                bytes.clone_from(&last.bytes);
                let mut again = Encoded { bytes, ..*last };
                if kept.is_state {
                    again.number(next);
                }
                Message::Datagram(again)
            }
            large @ Message::Large(_) => large.share(),
        })
    }

    /// The newest event, once more.
    fn event_again(&mut self, buffer: impl FnOnce() -> Vec<u8>) -> Option<Message> {
        let again = self.again.as_mut()?;
        again.is_due = false;
        if let Some(large) = &again.large {
            let kept = self.kept.iter().filter(
                |kept| matches!(&kept.message, Message::Large(kept) if Arc::ptr_eq(kept, large)),
            );
            // One that is still on its way needs no repetition.
            let is_sent = Arc::strong_count(large) == 1 + kept.count();
            return is_sent.then(|| Message::Large(Arc::clone(large)));
        }
        let mut kept = self.kept.iter();
        let message = match &again.message {
            Some(message) => Some(message),
            None => kept.find_map(|kept| match &kept.message {
                Message::Datagram(message) if kept.publisher.is_none() => Some(message),
                Message::Datagram(_) | Message::Large(_) => None,
            }),
        };
        let message = message.map(|message| {
            let mut bytes = buffer();
            bytes.clone_from(&message.bytes);
            Message::Datagram(Encoded { bytes, ..*message })
        });
        if again.awaited.is_none() && again.times >= AGAIN.len() {
            self.again = None;
        }
        message
    }

    /// Whether it is time to send the newest event again.
    fn is_again_due(&self) -> bool {
        self.again.as_ref().is_some_and(|again| again.is_due)
    }

    /// Plans to send a sample again if it is an event of one datagram, or `confirmed`. It replaces the event before, which is not
    /// sent again.
    pub(crate) fn send_again(
        &mut self,
        message: &Message,
        (is_state, is_kept): (bool, bool),
        confirmed: Option<&Confirming>,
        now: Instant,
    ) {
        self.supersede_arrival();
        let confirmed = confirmed.filter(|_| !is_state);
        let mark = message.encoded().mark();
        let awaited = confirmed.and_then(|confirmed| Some(confirmed.await_event(mark?, now)));
        let large = match message {
            Message::Large(large) => Some(Arc::clone(large)),
            Message::Datagram(_) => None,
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
        let Message::Datagram(message) = message else {
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

    /// When the newest event is sent again next.
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

    /// Returns whether the newest event is to be sent again now. An overdue event is given up, because it would come late.
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
            // Times that were missed are not made up for.
            while self.again_at().is_some_and(|at| at <= now) {
                if let Some(again) = &mut self.again {
                    again.times += 1;
                }
            }
        }
        true
    }

    /// Stops to repeat the newest event. The outcome is unknown for spaces that have not confirmed it.
    fn end_again(&mut self) {
        let awaited = self.again.take().and_then(|again| again.awaited);
        if let Some(awaited) = awaited {
            self.arrival = Some(Arrival::Unknown(awaited.spaces));
            self.is_news = true;
        }
    }

    /// A newer sample than the newest event waits for its time: the event is not sent again.
    pub(crate) fn supersede(&mut self) {
        self.supersede_arrival();
        self.again = None;
    }

    fn supersede_arrival(&mut self) {
        (self.arrival, self.is_news) = (None, false);
    }

    /// Returns whether the confirmation of that event by that space is missing.
    pub(crate) fn is_awaited(&self, mark: Mark, space: SpaceId) -> bool {
        let again = self.again.as_ref();
        let awaited = again.and_then(|again| again.awaited.as_ref());
        awaited.is_some_and(|awaited| awaited.is_awaited(mark, space))
    }

    /// Notes that a space has confirmed the newest event.
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
        self.arrival = Some(Arrival::Confirmed);
        self.is_news = true;
    }

    /// Returns the outcome of the newest event, if others confirm it and it is known.
    pub(crate) const fn arrival(&self) -> Option<&Arrival> {
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

    /// Whether the topic has a producer.
    pub(crate) const fn is_live(&self) -> bool {
        self.live
    }

    /// When the writer has to speak again, and how. Large values are repeated so seldom that this takes up no more
    /// than a tenth of the pace of chunks.
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
        // A repeated key frame says all that a keep-alive says.
        let repeats_first = !self.kept.is_empty() && repeat.0 <= keep_alive.0;
        Some(if repeats_first { repeat } else { keep_alive })
    }

    /// What was kept at `at` is elsewhere or gone; the round goes on behind it.
    const fn leave_round(&mut self, at: usize) {
        if self.next != usize::MAX && at < self.next {
            self.next -= 1;
        }
    }
}

/// When an event is sent again after it was sent first.
const AGAIN: [Duration; 2] = [Duration::from_millis(30), Duration::from_millis(80)];
/// How often after that while it is not confirmed, and how often if it is large.
const AWAITED: Duration = Duration::from_millis(50);
const LARGE_AWAITED: Duration = Duration::from_millis(250);
/// From then on it is not sent again unless it is to be confirmed.
const AGAIN_WITHIN: Duration = Duration::from_millis(150);
/// Samples kept per topic: more latched publishers of one topic are not known of any graph.
pub(crate) const MAX_KEPT: usize = 32;
/// Samples of one topic come from several publishers, whose stamps may cross by as much; in nanoseconds.
const STEP_BACK: i128 = 1_000_000_000;

fn patch(bytes: &mut [u8], at: usize, with: &[u8]) {
    if let Some(place) = bytes.get_mut(at..at.saturating_add(with.len())) {
        place.copy_from_slice(with);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Encoded {
        Encoded {
            bytes: vec![0; 20],
            timestamp_at: 2,
            payload_at: 14,
            sequence_at: 16,
        }
    }

    #[expect(
        clippy::disallowed_methods,
        reason = "a test needs some instant to count from"
    )]
    fn writer() -> (Writer, Instant) {
        let now = Instant::now();
        (Writer::new(now), now)
    }

    fn keep(writer: &mut Writer, publisher: Option<PublisherKey>, now: Instant) -> bool {
        let mut sample = sample();
        if let (Some(PublisherKey(key)), Some(byte)) = (publisher, sample.bytes.last_mut()) {
            *byte = u8::try_from(key).unwrap();
        }
        let gave_way = writer.keep((publisher, true), &Message::Datagram(sample));
        writer.sent(now);
        gave_way
    }

    /// The sequence number and the last byte of each repetition.
    fn round(writer: &mut Writer) -> Vec<(u16, u8)> {
        std::iter::from_fn(|| writer.repeat(Vec::new))
            .map(|message| match message {
                Message::Datagram(again) => (again.sequence(), *again.bytes.last().unwrap()),
                Message::Large(_) => unreachable!("none was kept"),
            })
            .collect()
    }

    #[test]
    fn the_last_sample_of_each_latched_publisher_is_repeated_until_it_leaves() {
        let (mut writer, now) = writer();
        for publisher in [1, 2, 3, 1] {
            keep(&mut writer, Some(PublisherKey(publisher)), now);
        }
        writer.begin_round(now);
        assert_eq!(round(&mut writer), [(0, 2), (1, 3), (2, 1)]);
        writer.forget(PublisherKey(3));
        writer.begin_round(now);
        assert_eq!(round(&mut writer), [(3, 2), (4, 1)]);
        assert!(!writer.repeats());
    }

    #[test]
    fn publishers_come_and_go_within_a_round_and_none_is_left_out() {
        let (mut writer, now) = writer();
        for publisher in 1..=4 {
            keep(&mut writer, Some(PublisherKey(publisher)), now);
        }
        writer.begin_round(now);
        assert!(writer.repeat(Vec::new).is_some());
        assert!(writer.repeat(Vec::new).is_some());
        writer.forget(PublisherKey(1));
        keep(&mut writer, Some(PublisherKey(2)), now);
        let rest: Vec<u8> = round(&mut writer)
            .into_iter()
            .map(|(_, byte)| byte)
            .collect();
        assert_eq!(rest, [3, 4, 2]);
    }

    #[test]
    fn of_too_many_latched_publishers_the_one_that_spoke_first_gives_way() {
        let (mut writer, now) = writer();
        let all = u32::try_from(MAX_KEPT).unwrap();
        assert!(!(0..all).any(|publisher| keep(&mut writer, Some(PublisherKey(publisher)), now)));
        assert!(keep(&mut writer, Some(PublisherKey(all)), now));
        writer.begin_round(now);
        assert_eq!(round(&mut writer).first(), Some(&(0, 1)));
    }

    #[test]
    fn a_large_value_is_repeated_seldom_and_from_the_same_buffer() {
        let (mut writer, now) = writer();
        let large = Arc::new(Encoded {
            bytes: vec![0; 20_000_000],
            ..sample()
        });
        writer.keep((None, true), &Message::Large(Arc::clone(&large)));
        writer.sent(now);
        let minute = SECOND * 60;
        assert_eq!(
            writer.due(SECOND, minute),
            Some((now + SECOND * 2, Idle::Repeat))
        );
        writer.begin_round(now);
        assert!(writer.repeat(Vec::new).is_none(), "it is still being sent");
        let place = large.bytes.as_ptr();
        drop(large);
        writer.begin_round(now);
        let Some(Message::Large(again)) = writer.repeat(Vec::new) else {
            unreachable!("a large one was kept")
        };
        assert_eq!(again.bytes.as_ptr(), place);
    }

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_repetition_has_a_number_of_its_own_and_the_same_value() {
        let (mut writer, now) = writer();
        assert_eq!(writer.next_sequence(), 0);
        keep(&mut writer, None, now);
        writer.begin_round(now + SECOND);
        assert_eq!(round(&mut writer), [(1, 0)]);
        assert_eq!(writer.expected_sequence(), 2);
    }

    #[test]
    fn values_are_repeated_with_keep_alives_between_when_those_are_more_frequent() {
        let (mut writer, now) = writer();
        assert_eq!(
            writer.due(SECOND, SECOND),
            None,
            "nothing to repeat before the first value"
        );
        keep(&mut writer, None, now);
        assert_eq!(
            writer.due(SECOND, SECOND),
            Some((now + SECOND, Idle::Repeat))
        );
        assert_eq!(
            writer.due(SECOND * 2, SECOND),
            Some((now + SECOND, Idle::KeepAlive))
        );
        writer.spoke(now + SECOND);
        assert_eq!(
            writer.due(SECOND * 2, SECOND),
            Some((now + SECOND * 2, Idle::Repeat))
        );
    }

    #[test]
    fn events_are_not_repeated_and_a_topic_without_producer_falls_silent() {
        let (mut writer, now) = writer();
        writer.sent(now);
        assert_eq!(
            writer.due(SECOND, SECOND),
            Some((now + SECOND, Idle::KeepAlive))
        );
        writer.set_live(false);
        assert_eq!(writer.due(SECOND, SECOND), None);
        writer.sent(now);
        assert!(
            writer.due(SECOND, SECOND).is_some(),
            "a sample shows that it has one again"
        );
    }

    #[test]
    fn two_samples_never_share_a_stamp_and_a_clock_set_back_is_followed() {
        let (mut writer, _) = writer();
        let at = |nanos: i128| Timestamp::from_unix_nanos(1_700_000_000_000_000_000 + nanos);
        let stamps = [5, 5, 3, 900].map(|nanos| writer.stamp(at(nanos)));
        assert_eq!(stamps, [at(5), at(6), at(7), at(900)]);
        let an_hour_back = at(-3_600_000_000_000);
        assert_eq!(writer.stamp(an_hour_back), an_hour_back);
    }

    #[test]
    fn the_send_time_is_written_where_the_header_has_it() {
        let mut encoded = sample();
        encoded.stamp(Timestamp {
            time: DateTime(0x0102),
            picoseconds: 0x0304,
        });
        assert_eq!(encoded.bytes[2..12], [2, 1, 0, 0, 0, 0, 0, 0, 4, 3]);
    }
}
