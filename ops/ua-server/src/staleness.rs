//! Ageing of values of other programs: they become uncertain, and then bad.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Instant;

use mappings::{Ages, TopicId};
use opcua::types::StatusCode;

/// The staleness of a topic's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Worn {
    /// The value has its own status.
    Fresh,
    /// The value is the last usable value.
    Last,
    /// The value is the last usable value, and its publisher is offline.
    Away,
    /// The value is too old to be used.
    Over,
}

impl Worn {
    /// Returns the status that replaces the status of the value.
    pub(crate) const fn status(self) -> Option<StatusCode> {
        match self {
            Self::Fresh => None,
            Self::Last => Some(StatusCode::UncertainLastUsableValue),
            Self::Away => Some(StatusCode::UncertainNoCommunicationLastUsableValue),
            Self::Over => Some(StatusCode::BadNoCommunication),
        }
    }
}

/// The age of a topic's value, and its staleness.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wear {
    ages: Ages,
    /// Arrival of the last value; `None` before the first value.
    came: Option<Instant>,
    /// Time since which the writer is silent.
    silent: Option<Instant>,
    /// True if the publisher is offline.
    away: bool,
    /// The staleness that is shown.
    shown: Worn,
    /// Time of the next check.
    look: Option<Instant>,
}

impl Wear {
    pub(crate) const fn new(ages: Ages) -> Self {
        Self {
            ages,
            came: None,
            silent: None,
            away: false,
            shown: Worn::Fresh,
            look: None,
        }
    }

    /// Returns the time since which the writer is silent.
    pub(crate) const fn silent(&self) -> Option<Instant> {
        self.silent
    }

    /// Records a new value, which is fresh.
    pub(crate) const fn came(&mut self, now: Instant) {
        self.came = Some(now);
        self.silent = None;
        self.away = false;
        self.shown = Worn::Fresh;
    }

    /// Records that the writer is silent or active again.
    pub(crate) fn set_silent(&mut self, silent: bool, now: Instant) {
        self.silent = silent.then_some(now);
        self.away &= silent;
    }

    /// Records if the publisher is offline. Ignored if the writer is active.
    pub(crate) const fn set_away(&mut self, away: bool) {
        self.away = away && self.silent.is_some();
    }

    pub(crate) const fn set_ages(&mut self, ages: Ages) {
        self.ages = ages;
    }

    /// Returns the time since which the value is uncertain, if it is.
    fn uncertain(&self, now: Instant) -> Option<Instant> {
        let old = self.old().filter(|old| *old <= now);
        self.silent.into_iter().chain(old).min()
    }

    /// Returns the time at which the value becomes uncertain because of its age.
    fn old(&self) -> Option<Instant> {
        Some(self.came? + self.ages.uncertain_after?)
    }

    /// Returns the current staleness if it differs from the staleness that is shown, and records it
    /// as shown.
    pub(crate) fn turn(&mut self, now: Instant) -> Option<Worn> {
        let worn = match (self.came, self.uncertain(now)) {
            (None, _) | (_, None) => Worn::Fresh,
            (Some(_), Some(since)) => match self.ages.bad_after {
                Some(after) if now >= since + after => Worn::Over,
                Some(_) | None if self.away => Worn::Away,
                Some(_) | None => Worn::Last,
            },
        };
        (std::mem::replace(&mut self.shown, worn) != worn).then_some(worn)
    }

    /// Returns the time of the next change of the staleness.
    fn due(&self, now: Instant) -> Option<Instant> {
        match (self.came, self.uncertain(now)) {
            (None, _) => None,
            (Some(_), None) => self.old(),
            (Some(_), Some(since)) => {
                let over = since + self.ages.bad_after?;
                (over > now).then_some(over)
            }
        }
    }
}

/// The planned checks of topics.
#[derive(Debug, Default)]
pub(crate) struct Looks(BinaryHeap<Reverse<(Instant, TopicId)>>);

impl Looks {
    /// Plans the next check of a topic. An earlier check is kept and plans the following check, so
    /// that the queue does not get an entry for each value.
    pub(crate) fn plan(&mut self, topic: TopicId, wear: &mut Wear, now: Instant) {
        if let Some(due) = wear.due(now)
            && wear.look.is_none_or(|look| due < look)
        {
            wear.look = Some(due);
            self.0.push(Reverse((due, topic)));
        }
    }

    /// Returns the time of the next check.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.0.peek().map(|Reverse((at, _))| *at)
    }

    /// Returns the next topic with a due check.
    pub(crate) fn take(&mut self, now: Instant) -> Option<(Instant, TopicId)> {
        let Reverse((at, topic)) = self.0.peek().copied()?;
        (at <= now).then(|| {
            self.0.pop();
            (at, topic)
        })
    }
}

impl Wear {
    /// Handles a due check. Returns true if it is the check that was planned last.
    pub(crate) fn looked(&mut self, at: Instant) -> bool {
        let is_planned = self.look == Some(at);
        if is_planned {
            self.look = None;
        }
        is_planned
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use bridge_node::now;

    use super::*;

    const fn seconds(count: u64) -> Duration {
        Duration::from_secs(count)
    }

    fn wear(uncertain: Option<u64>, bad: Option<u64>) -> Wear {
        Wear::new(Ages {
            uncertain_after: uncertain.map(seconds),
            bad_after: bad.map(seconds),
            ..Ages::default()
        })
    }

    #[test]
    fn a_value_ages_though_its_writer_is_heard_and_the_next_one_is_fresh() {
        let start = now().monotonic;
        let mut wear = wear(Some(2), Some(3));
        assert_eq!(wear.turn(start + seconds(100)), None, "none came yet");
        wear.came(start);
        assert_eq!(wear.due(start), Some(start + seconds(2)));
        assert_eq!(wear.turn(start + seconds(1)), None);
        assert_eq!(wear.turn(start + seconds(2)), Some(Worn::Last));
        assert_eq!(wear.due(start + seconds(2)), Some(start + seconds(5)));
        assert_eq!(wear.turn(start + seconds(4)), None);
        assert_eq!(wear.turn(start + seconds(5)), Some(Worn::Over));
        assert_eq!(wear.due(start + seconds(5)), None);
        wear.came(start + seconds(6));
        assert_eq!(
            wear.turn(start + seconds(6)),
            None,
            "it is shown as it came"
        );
    }

    #[test]
    fn silence_makes_a_value_uncertain_and_bad_and_a_writer_that_lives_undoes_it() {
        let start = now().monotonic;
        let mut wear = wear(None, Some(3));
        wear.came(start);
        assert_eq!(wear.due(start), None);
        wear.set_silent(true, start + seconds(10));
        assert_eq!(wear.turn(start + seconds(10)), Some(Worn::Last));
        wear.set_away(true);
        assert_eq!(wear.turn(start + seconds(11)), Some(Worn::Away));
        wear.set_away(false);
        assert_eq!(wear.turn(start + seconds(12)), Some(Worn::Last));
        assert_eq!(wear.turn(start + seconds(13)), Some(Worn::Over));
        wear.set_silent(false, start + seconds(14));
        assert_eq!(wear.turn(start + seconds(14)), Some(Worn::Fresh));
        wear.set_away(true);
        assert_eq!(wear.turn(start + seconds(14)), None, "its writer is heard");
    }

    #[test]
    fn a_look_is_planned_once_for_many_values_and_again_when_it_comes_early() {
        let start = now().monotonic;
        let topic = TopicId::new(1, 2, 3).unwrap();
        let mut wear = wear(Some(2), None);
        let mut looks = Looks::default();
        for at in 0..3 {
            wear.came(start + Duration::from_millis(at * 500));
            looks.plan(topic, &mut wear, start + Duration::from_millis(at * 500));
        }
        assert_eq!(looks.due(), Some(start + seconds(2)));
        assert_eq!(looks.take(start + seconds(1)), None);
        let at = start + seconds(2);
        assert_eq!(looks.take(at), Some((at, topic)));
        assert!(wear.looked(at));
        assert_eq!(wear.turn(at), None, "the last one came a second ago");
        looks.plan(topic, &mut wear, at);
        assert_eq!(looks.due(), Some(start + seconds(3)));
    }
}
