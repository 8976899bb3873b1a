//! How values of other programs become old: uncertain, and then bad.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Instant;

use mappings::{Ages, TopicId};
use opcua::types::StatusCode;

/// What a topic is shown as for want of a newer value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Worn {
    /// It has the status it came with.
    Fresh,
    /// It is the last one there was.
    Last,
    /// So it is, and nothing at all is heard of its publisher.
    Away,
    /// It is too old to be of use.
    Over,
}

impl Worn {
    /// The status in the place of the value's own.
    pub(crate) const fn status(self) -> Option<StatusCode> {
        match self {
            Self::Fresh => None,
            Self::Last => Some(StatusCode::UncertainLastUsableValue),
            Self::Away => Some(StatusCode::UncertainNoCommunicationLastUsableValue),
            Self::Over => Some(StatusCode::BadNoCommunication),
        }
    }
}

/// Since when a topic is without a newer value, and what follows from it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Wear {
    ages: Ages,
    /// When its last value came; `None` before the first.
    came: Option<Instant>,
    /// Since when its writer is silent.
    silent: Option<Instant>,
    /// Whether nothing is heard of its publisher.
    away: bool,
    /// What it is shown as.
    shown: Worn,
    /// When it is looked at next.
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

    /// Since when its writer is silent.
    pub(crate) const fn silent(&self) -> Option<Instant> {
        self.silent
    }

    /// A value came, which is shown as it is.
    pub(crate) const fn came(&mut self, now: Instant) {
        self.came = Some(now);
        self.silent = None;
        self.away = false;
        self.shown = Worn::Fresh;
    }

    /// Its writer is silent, or speaks again.
    pub(crate) fn set_silent(&mut self, silent: bool, now: Instant) {
        self.silent = silent.then_some(now);
        self.away &= silent;
    }

    /// Whether nothing is heard of its publisher; says nothing of one whose writer is heard.
    pub(crate) const fn set_away(&mut self, away: bool) {
        self.away = away && self.silent.is_some();
    }

    pub(crate) const fn set_ages(&mut self, ages: Ages) {
        self.ages = ages;
    }

    /// Since when it is uncertain, if it is.
    fn uncertain(&self, now: Instant) -> Option<Instant> {
        let old = self.old().filter(|old| *old <= now);
        self.silent.into_iter().chain(old).min()
    }

    /// When it is older than it may be.
    fn old(&self) -> Option<Instant> {
        Some(self.came? + self.ages.uncertain_after?)
    }

    /// What it is now, if that is something else than it is shown as; it is taken to be shown so.
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

    /// When it becomes something else by itself.
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

/// When topics are to be looked at.
#[derive(Debug, Default)]
pub(crate) struct Looks(BinaryHeap<Reverse<(Instant, TopicId)>>);

impl Looks {
    /// Plans the next look at a topic. An earlier one stays, and plans the next: that spares an
    /// entry for each value.
    pub(crate) fn plan(&mut self, topic: TopicId, wear: &mut Wear, now: Instant) {
        if let Some(due) = wear.due(now)
            && wear.look.is_none_or(|look| due < look)
        {
            wear.look = Some(due);
            self.0.push(Reverse((due, topic)));
        }
    }

    /// When the next one is due.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.0.peek().map(|Reverse((at, _))| *at)
    }

    /// The next topic whose look is due.
    pub(crate) fn take(&mut self, now: Instant) -> Option<(Instant, TopicId)> {
        let Reverse((at, topic)) = self.0.peek().copied()?;
        (at <= now).then(|| {
            self.0.pop();
            (at, topic)
        })
    }
}

impl Wear {
    /// A look is due: whether it is the one that was planned last.
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
