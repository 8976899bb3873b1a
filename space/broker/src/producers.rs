//! The state of the publishers, and their retained messages, which wait until they are Operational.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use uadp::discovery::{ConnectionState, CyclicStatus};
use uadp::{DateTime, Timestamp};

/// The known publishers.
#[derive(Debug, Default)]
pub(crate) struct Producers {
    known: BTreeMap<u16, Producer>,
    held: usize,
}

/// A publisher.
#[derive(Debug, Default)]
struct Producer {
    operational: bool,
    /// The time at which the next status is overdue.
    until: Option<Instant>,
    /// The retained messages by topic.
    held: BTreeMap<String, Vec<u8>>,
}

impl Producers {
    /// Handles a status. Returns the retained messages that may be read from now on.
    pub(crate) fn status(
        &mut self,
        publisher: u16,
        (state, cyclic): (ConnectionState, Option<CyclicStatus>),
        (now, utc): (Instant, Timestamp),
    ) -> BTreeMap<String, Vec<u8>> {
        let Some(producer) = self.entry(publisher) else {
            return BTreeMap::new();
        };
        let left = cyclic.map(|cyclic| time_left(cyclic.next_report_time, utc));
        producer.until = left.flatten().map(|left| now + left);
        // A status with an overdue successor is of a publisher that ended.
        producer.operational = state == ConnectionState::OPERATIONAL && left != Some(None);
        self.release(publisher)
    }

    /// Handles a sign of life: a message that is not retained.
    pub(crate) fn lives(&mut self, publisher: u16) -> BTreeMap<String, Vec<u8>> {
        let producer = self.known.get_mut(&publisher);
        let released = producer
            .filter(|producer| !producer.held.is_empty())
            .map(|producer| std::mem::take(&mut producer.held));
        self.take_held(released)
    }

    /// Returns whether the publisher is Operational.
    pub(crate) fn is_operational(&self, publisher: u16, now: Instant) -> bool {
        let producer = self.known.get(&publisher);
        producer.is_some_and(|producer| {
            producer.operational && producer.until.is_none_or(|until| now <= until)
        })
    }

    /// Keeps a retained message until its publisher is Operational. Returns false if there is no
    /// room for it.
    pub(crate) fn hold(&mut self, publisher: u16, topic: &str, payload: &[u8]) -> bool {
        if self.held >= MAX_HELD || payload.len() > MAX_HELD_BYTES {
            return false;
        }
        let Some(producer) = self.entry(publisher) else {
            return false;
        };
        let replaced = producer.held.insert(topic.to_owned(), payload.to_vec());
        if replaced.is_none() {
            self.held += 1;
        }
        true
    }

    fn release(&mut self, publisher: u16) -> BTreeMap<String, Vec<u8>> {
        let producer = self.known.get_mut(&publisher);
        let released = producer
            .filter(|producer| producer.operational)
            .map(|producer| std::mem::take(&mut producer.held));
        self.take_held(released)
    }

    fn take_held(
        &mut self,
        released: Option<BTreeMap<String, Vec<u8>>>,
    ) -> BTreeMap<String, Vec<u8>> {
        let released = released.unwrap_or_default();
        self.held = self.held.saturating_sub(released.len());
        released
    }

    fn entry(&mut self, publisher: u16) -> Option<&mut Producer> {
        if self.known.len() >= MAX_PRODUCERS && !self.known.contains_key(&publisher) {
            return None;
        }
        Some(self.known.entry(publisher).or_default())
    }
}

/// Returns the time until a status is overdue; `None` if it is.
pub(crate) fn time_left(next: DateTime, utc: Timestamp) -> Option<Duration> {
    let next = Timestamp::from(next).unix_nanos() + MARGIN;
    let left = u64::try_from(next - utc.unix_nanos()).ok()?;
    Some(Duration::from_nanos(left))
}

/// The tolerated lateness of a status in nanoseconds.
const MARGIN: i128 = 3_000_000_000;
const MAX_PRODUCERS: usize = 1024;
const MAX_HELD: usize = 2_048;
const MAX_HELD_BYTES: usize = 65_536;

#[cfg(test)]
mod tests {
    use super::*;

    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn start() -> (Instant, Timestamp) {
        (
            Instant::now(),
            Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
        )
    }

    fn after(utc: Timestamp, seconds: i64) -> DateTime {
        DateTime(utc.time.0 + seconds * 10_000_000)
    }

    #[test]
    fn retained_messages_wait_until_their_publisher_is_operational() {
        let mut producers = Producers::default();
        let (now, utc) = start();
        assert!(producers.hold(1, "m", b"1"));
        assert!(producers.hold(1, "m", b"2"));
        let failed = (ConnectionState::ERROR, None);
        assert!(producers.status(1, failed, (now, utc)).is_empty());
        let overdue = CyclicStatus {
            next_report_time: after(utc, -4),
            timestamp: after(utc, -9),
        };
        let ended = (ConnectionState::OPERATIONAL, Some(overdue));
        assert!(producers.status(1, ended, (now, utc)).is_empty());
        assert!(!producers.is_operational(1, now));
        let cyclic = CyclicStatus {
            next_report_time: after(utc, 5),
            timestamp: utc.time,
        };
        let running = (ConnectionState::OPERATIONAL, Some(cyclic));
        let released = producers.status(1, running, (now, utc));
        assert_eq!(released.into_values().collect::<Vec<_>>(), [b"2"]);
        assert!(producers.is_operational(1, now + Duration::from_secs(8)));
        assert!(!producers.is_operational(1, now + Duration::from_secs(9)));
        assert_eq!(producers.held, 0);
    }

    #[test]
    fn a_publisher_without_status_shows_by_any_message_that_it_runs() {
        let mut producers = Producers::default();
        assert!(producers.hold(3, "m", b"1"));
        assert!(producers.lives(2).is_empty());
        assert_eq!(producers.lives(3).len(), 1);
        assert!(producers.lives(3).is_empty());
    }
}
