//! The staleness of the values of other programs: they become uncertain, and then bad. No clocks,
//! tasks or nodes.
//!
//! [`StaleValues`] owns the ages of all values. Inputs are values ([`received`]), the silence of
//! writers ([`set_silent`]), the last messages of publishers ([`set_last_messages`]) and
//! [`handle_deadline`]. Drain [`poll_change`] after each input, and call `handle_deadline` when the
//! time of [`poll_deadline`] has passed.
//!
//! [`received`]: StaleValues::received
//! [`set_silent`]: StaleValues::set_silent
//! [`set_last_messages`]: StaleValues::set_last_messages
//! [`handle_deadline`]: StaleValues::handle_deadline
//! [`poll_change`]: StaleValues::poll_change
//! [`poll_deadline`]: StaleValues::poll_deadline

#[cfg(test)]
mod tests;

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, VecDeque};
use std::time::{Duration, Instant};

use mappings::{Ages, SpaceId, TopicId};
use opcua::types::StatusCode;

/// The staleness of a topic's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Staleness {
    /// The value has its own status.
    Fresh,
    /// The value is the last usable value.
    Stale,
    /// The value is the last usable value, and its publisher is offline.
    Offline,
    /// The value is too old to be used.
    Expired,
}

impl Staleness {
    /// Returns the status that replaces the status of the value.
    pub(crate) const fn status(self) -> Option<StatusCode> {
        match self {
            Self::Fresh => None,
            Self::Stale => Some(StatusCode::UncertainLastUsableValue),
            Self::Offline => Some(StatusCode::UncertainNoCommunicationLastUsableValue),
            Self::Expired => Some(StatusCode::BadNoCommunication),
        }
    }
}

/// The ages of the values, and the changes of their staleness.
#[derive(Debug, Default)]
pub(crate) struct StaleValues {
    ages: HashMap<TopicId, ValueAge>,
    /// The planned checks. A topic has one valid check at most ([`ValueAge::is_planned`]).
    checks: BinaryHeap<Reverse<(Instant, TopicId)>>,
    /// Topics with a writer that is active again, but without a new value.
    returned: Vec<TopicId>,
    changes: VecDeque<(TopicId, Staleness)>,
}

impl StaleValues {
    /// Adds a topic that waits for its first value, or replaces it.
    pub(crate) fn add(&mut self, topic: TopicId, ages: Ages) {
        self.ages.insert(topic, ValueAge::new(ages));
    }

    /// Removes a topic.
    pub(crate) fn remove(&mut self, topic: TopicId) {
        self.ages.remove(&topic);
    }

    /// Sets the maximum ages of a topic's value.
    pub(crate) fn set_ages(&mut self, topic: TopicId, ages: Ages, now: Instant) {
        if let Some(age) = self.ages.get_mut(&topic) {
            age.ages = ages;
            self.update(topic, now);
        }
    }

    /// Records a new value, which is fresh. The new value itself is no change.
    pub(crate) fn received(&mut self, topic: TopicId, now: Instant) {
        if let Some(age) = self.ages.get_mut(&topic) {
            age.received(now);
            self.plan(topic, now);
        }
        self.returned.retain(|returned| *returned != topic);
    }

    /// Records that the writer of a topic is silent or active again. A new value probably follows
    /// at once if it is active; otherwise [`settle`](Self::settle) reports the change.
    pub(crate) fn set_silent(&mut self, topic: TopicId, silent: bool, now: Instant) {
        let Some(age) = self.ages.get_mut(&topic) else {
            return;
        };
        if age.silent.is_some() == silent {
            return;
        }
        age.set_silent(silent, now);
        if silent {
            self.update(topic, now);
        } else {
            self.returned.push(topic);
        }
    }

    /// Reports the values of writers that are active again without a new value.
    pub(crate) fn settle(&mut self, now: Instant) {
        for topic in std::mem::take(&mut self.returned) {
            self.update(topic, now);
        }
    }

    /// Records the times of the last messages. A publisher that has sent nothing for `timeout` is
    /// offline.
    pub(crate) fn set_last_messages(
        &mut self,
        messages: impl Iterator<Item = (TopicId, Instant)>,
        timeout: Duration,
        now: Instant,
    ) {
        if self.ages.values().all(|age| age.silent.is_none()) {
            return;
        }
        let mut last: HashMap<(SpaceId, Option<u16>), Instant> = HashMap::new();
        for (topic, at) in messages {
            let of = last.entry(publisher(topic)).or_insert(at);
            *of = at.max(*of);
        }
        let mut silent = Vec::new();
        for (topic, age) in &mut self.ages {
            if age.silent.is_some() {
                let at = last.get(&publisher(*topic));
                age.is_offline = at.is_none_or(|at| now.saturating_duration_since(*at) >= timeout);
                silent.push(*topic);
            }
        }
        for topic in silent {
            self.update(topic, now);
        }
    }

    /// Returns the time since which the writer of a topic is silent.
    pub(crate) fn silent_since(&self, topic: TopicId) -> Option<Instant> {
        self.ages.get(&topic)?.silent
    }

    /// Returns the time of the next [`handle_deadline`](Self::handle_deadline).
    pub(crate) fn poll_deadline(&self) -> Option<Instant> {
        self.checks.peek().map(|Reverse((at, _))| *at)
    }

    /// Checks the values that may have become too old.
    pub(crate) fn handle_deadline(&mut self, now: Instant) {
        while let Some(Reverse((at, topic))) = self.checks.peek().copied()
            && at <= now
        {
            self.checks.pop();
            let age = self.ages.get_mut(&topic);
            if age.is_some_and(|age| age.is_planned(at)) {
                self.update(topic, now);
            }
        }
    }

    /// Returns the next change of a value's staleness.
    pub(crate) fn poll_change(&mut self) -> Option<(TopicId, Staleness)> {
        self.changes.pop_front()
    }

    /// Plans the next check of a topic, and reports a change of its staleness.
    fn update(&mut self, topic: TopicId, now: Instant) {
        self.plan(topic, now);
        let age = self.ages.get_mut(&topic);
        if let Some(change) = age.and_then(|age| age.change(now)) {
            self.changes.push_back((topic, change));
        }
    }

    /// Plans the next check of a topic. An earlier check is kept and plans the following check, so
    /// that the queue does not get an entry for each value.
    fn plan(&mut self, topic: TopicId, now: Instant) {
        if let Some(age) = self.ages.get_mut(&topic)
            && let Some(due) = age.due(now)
            && age.check.is_none_or(|check| due < check)
        {
            age.check = Some(due);
            self.checks.push(Reverse((due, topic)));
        }
    }
}

/// The age of a topic's value, and its staleness.
#[derive(Debug, Clone, Copy)]
struct ValueAge {
    ages: Ages,
    /// Arrival of the last value; `None` before the first value.
    received: Option<Instant>,
    /// Time since which the writer is silent.
    silent: Option<Instant>,
    /// True if the publisher is offline.
    is_offline: bool,
    /// The staleness that was reported last.
    reported: Staleness,
    /// Time of the next check.
    check: Option<Instant>,
}

impl ValueAge {
    const fn new(ages: Ages) -> Self {
        Self {
            ages,
            received: None,
            silent: None,
            is_offline: false,
            reported: Staleness::Fresh,
            check: None,
        }
    }

    const fn received(&mut self, now: Instant) {
        self.received = Some(now);
        self.silent = None;
        self.is_offline = false;
        self.reported = Staleness::Fresh;
    }

    fn set_silent(&mut self, silent: bool, now: Instant) {
        self.silent = silent.then_some(now);
        self.is_offline &= silent;
    }

    /// Returns the time at which the value becomes uncertain because of its age.
    fn old(&self) -> Option<Instant> {
        Some(self.received? + self.ages.uncertain_after?)
    }

    /// Returns the time since which the value is uncertain, if it is.
    fn uncertain(&self, now: Instant) -> Option<Instant> {
        let old = self.old().filter(|old| *old <= now);
        self.silent.into_iter().chain(old).min()
    }

    fn staleness(&self, now: Instant) -> Staleness {
        let Some(since) = self.received.and_then(|_| self.uncertain(now)) else {
            return Staleness::Fresh;
        };
        match self.ages.bad_after {
            Some(after) if now >= since + after => Staleness::Expired,
            Some(_) | None if self.is_offline => Staleness::Offline,
            Some(_) | None => Staleness::Stale,
        }
    }

    /// Returns the staleness if it differs from the reported staleness, and records it as reported.
    fn change(&mut self, now: Instant) -> Option<Staleness> {
        let staleness = self.staleness(now);
        let before = std::mem::replace(&mut self.reported, staleness);
        (before != staleness).then_some(staleness)
    }

    /// Returns the time of the next change of the staleness.
    fn due(&self, now: Instant) -> Option<Instant> {
        self.received?;
        let Some(since) = self.uncertain(now) else {
            return self.old();
        };
        let expiry = since + self.ages.bad_after?;
        (expiry > now).then_some(expiry)
    }

    /// Returns true for the check that was planned last, which is no longer planned then.
    fn is_planned(&mut self, at: Instant) -> bool {
        let is_planned = self.check == Some(at);
        if is_planned {
            self.check = None;
        }
        is_planned
    }
}

/// Returns the publisher of a topic. A program publishes a whole space, or a namespace of space 0.
fn publisher(topic: TopicId) -> (SpaceId, Option<u16>) {
    let namespace = (topic.space == SpaceId::UA).then(|| topic.namespace.get());
    (topic.space, namespace)
}
