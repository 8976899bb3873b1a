//! The staleness of values with simulated time, and with messages that are lost.

use bridge_node::now;

use super::*;
use crate::dice::Dice;

const fn seconds(count: u64) -> Duration {
    Duration::from_secs(count)
}

fn ages(uncertain: Option<u64>, bad: Option<u64>) -> Ages {
    Ages {
        uncertain_after: uncertain.map(seconds),
        bad_after: bad.map(seconds),
        ..Ages::default()
    }
}

fn topic(space: u16, namespace: u16, identifier: u16) -> TopicId {
    TopicId::new(space, namespace, identifier).unwrap()
}

/// Values, and the time in seconds.
struct Values {
    values: StaleValues,
    start: Instant,
    now: Instant,
}

impl Values {
    fn new(topics: &[(TopicId, Ages)]) -> Self {
        let start = now().monotonic;
        let mut values = StaleValues::default();
        for (topic, ages) in topics {
            values.add(*topic, *ages);
        }
        let now = start;
        Self { values, start, now }
    }

    /// Lets the time pass until `second`, with all deadlines on the way. Returns the changes with
    /// their seconds.
    fn until(&mut self, second: u64) -> Vec<(u64, TopicId, Staleness)> {
        let end = self.start + seconds(second);
        let mut changes = Vec::new();
        while let Some(due) = self.values.poll_deadline().filter(|due| *due <= end) {
            self.now = due.max(self.now);
            self.values.handle_deadline(self.now);
            let second = (self.now - self.start).as_secs();
            changes.extend(self.changes().into_iter().map(|(of, to)| (second, of, to)));
        }
        self.now = end;
        changes
    }

    fn changes(&mut self) -> Vec<(TopicId, Staleness)> {
        std::iter::from_fn(|| self.values.poll_change()).collect()
    }

    fn received(&mut self, topic: TopicId) {
        self.values.received(topic, self.now);
    }

    fn set_silent(&mut self, topic: TopicId, silent: bool) -> Vec<(TopicId, Staleness)> {
        self.values.set_silent(topic, silent, self.now);
        self.changes()
    }

    /// Reports the last messages, with their seconds.
    fn set_last_messages(&mut self, messages: &[(TopicId, u64)]) -> Vec<(TopicId, Staleness)> {
        let messages = messages.iter();
        let messages = messages.map(|(topic, second)| (*topic, self.start + seconds(*second)));
        self.values.set_last_messages(messages, TIMEOUT, self.now);
        self.changes()
    }
}

/// Time without messages after which a publisher is offline.
const TIMEOUT: Duration = seconds(3);

#[test]
fn a_value_ages_though_its_writer_is_active_and_the_next_value_is_fresh() {
    let of = topic(2, 2, 10);
    let mut values = Values::new(&[(of, ages(Some(2), Some(3)))]);
    assert!(values.until(100).is_empty(), "there is no value");
    values.received(of);
    let changes = values.until(110);
    let expected = [(102, of, Staleness::Stale), (105, of, Staleness::Expired)];
    assert_eq!(changes, expected);
    assert_eq!(values.values.poll_deadline(), None);
    values.received(of);
    assert!(values.changes().is_empty(), "it is shown as it arrived");
    assert!(values.until(111).is_empty());
    assert_eq!(values.until(112), [(112, of, Staleness::Stale)]);
}

#[test]
fn a_value_that_arrives_in_time_never_changes_and_has_one_planned_check() {
    let of = topic(2, 2, 10);
    let mut values = Values::new(&[(of, ages(Some(2), Some(3)))]);
    for second in 0..100 {
        assert!(values.until(second).is_empty());
        values.received(of);
        assert_eq!(values.values.checks.len(), 1);
    }
}

#[test]
fn silence_makes_a_value_uncertain_and_bad_and_an_active_writer_restores_it() {
    let of = topic(2, 2, 10);
    let mut values = Values::new(&[(of, ages(None, Some(3)))]);
    values.received(of);
    values.until(10);
    assert_eq!(values.set_silent(of, true), [(of, Staleness::Stale)]);
    assert!(
        values.set_silent(of, true).is_empty(),
        "it is silent already"
    );
    values.until(11);
    assert_eq!(values.set_last_messages(&[]), [(of, Staleness::Offline)]);
    assert_eq!(
        values.set_last_messages(&[(of, 9)]),
        [(of, Staleness::Stale)]
    );
    assert_eq!(values.until(20), [(13, of, Staleness::Expired)]);
    // A writer that is active again probably sends a value at once, so nothing changes before.
    assert!(values.set_silent(of, false).is_empty());
    values.values.settle(values.now);
    assert_eq!(values.changes(), [(of, Staleness::Fresh)]);
    assert!(
        values.set_last_messages(&[]).is_empty(),
        "its writer is active"
    );
}

#[test]
fn a_value_of_a_writer_that_is_active_again_is_reported_once() {
    let of = topic(2, 2, 10);
    let mut values = Values::new(&[(of, ages(None, None))]);
    values.received(of);
    assert_eq!(values.set_silent(of, true), [(of, Staleness::Stale)]);
    values.set_silent(of, false);
    values.received(of);
    values.values.settle(values.now);
    assert!(values.changes().is_empty(), "the value itself is shown");
}

#[test]
fn a_publisher_is_offline_when_none_of_its_topics_has_messages() {
    let (one, other) = (topic(2, 2, 10), topic(2, 3, 11));
    let (first, second) = (topic(0, 12, 1), topic(0, 13, 1));
    let all = [one, other, first, second];
    let mut values = Values::new(&all.map(|topic| (topic, Ages::default())));
    for of in all {
        values.received(of);
    }
    values.until(5);
    for silent in [one, first] {
        assert_eq!(
            values.set_silent(silent, true),
            [(silent, Staleness::Stale)]
        );
    }
    // A space has one publisher; each namespace of space 0 has its own.
    let mut changes = values.set_last_messages(&[(one, 1), (other, 4), (first, 1), (second, 4)]);
    assert_eq!(changes, [(first, Staleness::Offline)]);
    values.until(7);
    changes = values.set_last_messages(&[(one, 1), (other, 4), (first, 1), (second, 4)]);
    assert_eq!(changes, [(one, Staleness::Offline)]);
}

#[test]
fn other_ages_of_a_mapping_hold_at_once_and_removed_topics_do_not_change() {
    let (of, other) = (topic(2, 2, 10), topic(2, 2, 11));
    let mut values = Values::new(&[(of, Ages::default()), (other, ages(Some(1), None))]);
    values.received(of);
    values.received(other);
    values.values.remove(other);
    assert!(values.until(10).is_empty());
    let now = values.now;
    values.values.set_ages(of, ages(Some(4), Some(7)), now);
    assert_eq!(values.changes(), [(of, Staleness::Stale)]);
    values.values.set_ages(of, ages(Some(20), None), now);
    assert_eq!(values.changes(), [(of, Staleness::Fresh)]);
    assert_eq!(values.until(30), [(20, of, Staleness::Stale)]);
    // A topic that is added again waits for its first value.
    values.values.add(of, ages(Some(1), None));
    assert!(values.until(60).is_empty());
    assert_eq!(values.values.silent_since(of), None);
}

/// The reported changes, together with the values that arrive, always give the staleness that
/// follows from the ages: no deadline is missed, whatever is lost.
#[test]
fn the_changes_at_the_deadlines_give_the_staleness_at_every_second() {
    let limits = [
        (None, None),
        (Some(2), None),
        (None, Some(5)),
        (Some(3), Some(4)),
    ];
    for seed in 1..=200 {
        let mut dice = Dice(seed * 0x9e37_79b9);
        let topics: Vec<(TopicId, Ages)> = (10..)
            .zip(limits)
            .map(|(id, (uncertain, bad))| (topic(2, 2, id), ages(uncertain, bad)))
            .collect();
        let mut values = Values::new(&topics);
        let mut shown: HashMap<TopicId, Staleness> = HashMap::new();
        let mut sent: HashMap<TopicId, u64> = HashMap::new();
        for second in 1..=100 {
            for (_, of, staleness) in values.until(second) {
                shown.insert(of, staleness);
            }
            let (of, _) = topics[usize::try_from(dice.below(4)).unwrap()];
            match dice.below(5) {
                0 => {
                    values.received(of);
                    shown.insert(of, Staleness::Fresh);
                    sent.insert(of, second);
                }
                1 => shown.extend(values.set_silent(of, true)),
                2 => {
                    values.set_silent(of, false);
                    values.values.settle(values.now);
                    shown.extend(values.changes());
                }
                3 => {
                    let sent: Vec<(TopicId, u64)> = sent.clone().into_iter().collect();
                    shown.extend(values.set_last_messages(&sent));
                }
                _ => {}
            }
            for (of, _) in &topics {
                let expected = values.values.ages[of].staleness(values.now);
                let shown = shown.get(of).copied().unwrap_or(Staleness::Fresh);
                assert_eq!(shown, expected, "seed {seed}, second {second}, {of}");
            }
        }
    }
}
