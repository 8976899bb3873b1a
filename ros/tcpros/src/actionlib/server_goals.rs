//! The server's side of goals: the known goals, the effect of a cancel request on each goal, and
//! the allowed transitions.
//!
//! This module uses no clock and no network. Its inputs are messages, decisions and time, its
//! outputs are the statuses to publish.

use std::time::Duration;

use thiserror::Error;
use tokio::time::Instant;

use super::types::{ActionlibGoalId, ActionlibStatus, GoalStatus};
use crate::clock;
use crate::time::Ros1Time;

/// Decision of a server about a goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Decision {
    Accept,
    Reject,
    Cancelled,
    Abort,
    Succeed,
}

/// Reason for which a goal refused a decision.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ActionlibGoalError {
    /// The decision cannot follow the status of the goal.
    #[error("the goal {goal} is {from:?}: it cannot be {wanted}")]
    NotFrom {
        /// Id of the goal.
        goal: String,
        /// Status of the goal, which does not change.
        from: ActionlibStatus,
        /// Requested decision.
        wanted: &'static str,
    },
    /// The goal has ended and left the status of the server.
    #[error("the goal has ended and expired")]
    Forgotten,
    /// The server was dropped, which has ended its goals.
    #[error("the action server was closed")]
    Closed,
}

/// Counts of received data that a server could not use.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActionlibServerCounters {
    /// Messages that cannot be decoded.
    pub malformed: u64,
    /// Goals rejected and cancel requests ignored because too many goals are open.
    pub refused: u64,
    /// Ended goals that left the status early because the list was full.
    pub forgotten: u64,
    /// Goals and cancel requests that were lost because this process did not keep up.
    pub overrun: u64,
}

/// Outcome of a received goal.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum GoalArrival {
    /// A new goal, to be decided by the user.
    New(GoalKey, ActionlibGoalId),
    /// The goal has ended before its start, with this status.
    Ended(GoalStatus),
    /// A goal with this id was received before.
    Known,
}

/// Distinguishes a goal from an earlier goal of the same id that has left the status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct GoalKey(u64);

/// All goals of the status, in the order of arrival.
#[derive(Debug)]
pub(super) struct ActionlibServerGoals {
    entries: Vec<Entry>,
    /// The latest time of a request to cancel all goals up to a time.
    last_cancel: Ros1Time,
    most: usize,
    linger: Duration,
    next_key: u64,
    pub(super) counters: ActionlibServerCounters,
}

/// A goal, or a cancel request for a goal that was not received yet. The cancel request is an entry
/// with the status recalling and an end time.
#[derive(Debug)]
struct Entry {
    key: GoalKey,
    status: GoalStatus,
    /// Start of the period in which no more decisions about the goal are made.
    ended: Option<Instant>,
}

impl ActionlibServerGoals {
    /// Creates a list of at most `most` goals that keeps ended goals for `linger`.
    pub(super) fn new(most: usize, linger: Duration) -> Self {
        Self {
            entries: Vec::new(),
            last_cancel: Ros1Time::default(),
            most,
            linger,
            next_key: 0,
            counters: ActionlibServerCounters::default(),
        }
    }

    /// Adds a received goal. `fallback` supplies a missing id or stamp.
    pub(super) fn goal(
        &mut self,
        mut id: ActionlibGoalId,
        fallback: ActionlibGoalId,
        now: Instant,
    ) -> GoalArrival {
        let mut entries = self.entries.iter_mut();
        let known = entries.find(|entry| entry.status.goal_id.id == id.id && !id.id.is_empty());
        if let Some(known) = known {
            return known.seen_again(now);
        }
        let recalled = id.stamp != Ros1Time::default() && id.stamp <= self.last_cancel;
        if id.id.is_empty() {
            id.id = fallback.id;
        }
        if id.stamp == Ros1Time::default() {
            id.stamp = fallback.stamp;
        }
        let mut status = GoalStatus {
            goal_id: id.clone(),
            status: ActionlibStatus::Pending,
            text: String::new(),
        };
        if !self.has_room() {
            status.status = ActionlibStatus::Rejected;
            TOO_MANY.clone_into(&mut status.text);
            return GoalArrival::Ended(status);
        }
        if recalled {
            status.status = ActionlibStatus::Recalled;
            RECALLED.clone_into(&mut status.text);
        }
        let key = self.push(status.clone(), recalled.then_some(now));
        if recalled {
            GoalArrival::Ended(status)
        } else {
            GoalArrival::New(key, id)
        }
    }

    /// Applies a cancel request. Returns the goals that have to be notified.
    ///
    /// - Without id and time, the request applies to all goals.
    /// - A time selects all goals with this stamp or an earlier stamp, including goals received
    ///   later.
    /// - An id selects the goal with this id, which may be received later.
    pub(super) fn cancel(&mut self, request: &ActionlibGoalId, now: Instant) -> Vec<GoalKey> {
        let timed = request.stamp != Ros1Time::default();
        let all = request.id.is_empty() && !timed;
        let mut told = Vec::new();
        let mut found = request.id.is_empty();
        for entry in &mut self.entries {
            let this = !request.id.is_empty() && entry.status.goal_id.id == request.id;
            found |= this;
            let before = timed && entry.status.goal_id.stamp <= request.stamp;
            if (all || this || before) && entry.ask_to_cancel(now) {
                told.push(entry.key);
            }
        }
        if !found && self.has_room() {
            let status = GoalStatus {
                goal_id: request.clone(),
                status: ActionlibStatus::Recalling,
                text: String::new(),
            };
            self.push(status, Some(now));
        }
        self.last_cancel = self.last_cancel.max(request.stamp);
        told
    }

    /// Applies a decision and returns the new status.
    pub(super) fn decide(
        &mut self,
        key: GoalKey,
        decision: Decision,
        text: &str,
        now: Instant,
    ) -> Result<GoalStatus, ActionlibGoalError> {
        let entry = self.entries.iter_mut().find(|entry| entry.key == key);
        // A goal that has left the status had ended.
        let entry = entry.ok_or(ActionlibGoalError::Forgotten)?;
        let from = entry.status.status;
        let to = follows(from, decision).ok_or_else(|| ActionlibGoalError::NotFrom {
            goal: entry.status.goal_id.id.clone(),
            from,
            wanted: decision.name(),
        })?;
        Ok(entry.set(to, text, now))
    }

    /// Ends a goal that is not going to be decided. Returns `None` if it has ended already.
    pub(super) fn abandon(&mut self, key: GoalKey, text: &str, now: Instant) -> Option<GoalStatus> {
        let mut entries = self.entries.iter_mut();
        let entry = entries.find(|entry| entry.key == key && entry.ended.is_none())?;
        Some(entry.set(ActionlibStatus::Aborted, text, now))
    }

    /// Returns the goals that have not ended.
    pub(super) fn open(&self) -> Vec<GoalKey> {
        let open = self.entries.iter().filter(|entry| entry.ended.is_none());
        open.map(|entry| entry.key).collect()
    }

    /// Returns the status of a goal while it is known.
    pub(super) fn status(&self, key: GoalKey) -> Option<&GoalStatus> {
        let entry = self.entries.iter().find(|entry| entry.key == key)?;
        Some(&entry.status)
    }

    /// Returns the statuses to publish, without the goals beyond their retention time.
    pub(super) fn list(&mut self, now: Instant) -> impl Iterator<Item = &GoalStatus> {
        let linger = self.linger;
        self.entries
            .retain(|entry| entry.ended.is_none_or(|at| clock::after(at, linger) >= now));
        self.entries.iter().map(|entry| &entry.status)
    }

    fn push(&mut self, status: GoalStatus, ended: Option<Instant>) -> GoalKey {
        let key = GoalKey(self.next_key);
        self.next_key += 1;
        self.entries.push(Entry { key, status, ended });
        key
    }

    /// Frees an entry by removing the goal that ended first; its end has been published. Returns
    /// false if all goals are open.
    fn has_room(&mut self) -> bool {
        if self.entries.len() < self.most {
            return true;
        }
        let ended = self.entries.iter().enumerate();
        let oldest = ended
            .filter_map(|(at, entry)| Some((entry.ended?, at)))
            .min();
        if let Some((_, at)) = oldest {
            self.entries.remove(at);
            self.counters.forgotten += 1;
            true
        } else {
            self.counters.refused += 1;
            false
        }
    }
}

impl Entry {
    /// Handles a received goal with the id of this entry.
    fn seen_again(&mut self, now: Instant) -> GoalArrival {
        if self.ended.is_none() {
            return GoalArrival::Known;
        }
        self.ended = Some(now);
        if self.status.status == ActionlibStatus::Recalling {
            GoalArrival::Ended(self.set(ActionlibStatus::Recalled, RECALLED, now))
        } else {
            GoalArrival::Known
        }
    }

    /// Returns true if the goal has to be notified.
    fn ask_to_cancel(&mut self, now: Instant) -> bool {
        if self.ended.is_some() {
            self.ended = Some(now);
            return false;
        }
        let asked = match self.status.status {
            ActionlibStatus::Pending => ActionlibStatus::Recalling,
            ActionlibStatus::Active => ActionlibStatus::Preempting,
            ActionlibStatus::Preempted
            | ActionlibStatus::Succeeded
            | ActionlibStatus::Aborted
            | ActionlibStatus::Rejected
            | ActionlibStatus::Preempting
            | ActionlibStatus::Recalling
            | ActionlibStatus::Recalled
            | ActionlibStatus::Lost => return false,
        };
        self.status.status = asked;
        true
    }

    fn set(&mut self, status: ActionlibStatus, text: &str, now: Instant) -> GoalStatus {
        self.status.status = status;
        text.clone_into(&mut self.status.text);
        self.ended = status.is_terminal().then_some(now);
        self.status.clone()
    }
}

impl Decision {
    const fn name(self) -> &'static str {
        match self {
            Self::Accept => "accepted",
            Self::Reject => "rejected",
            Self::Cancelled => "cancelled",
            Self::Abort => "aborted",
            Self::Succeed => "succeeded",
        }
    }
}

/// Returns the status that follows a decision, or `None` if the decision is not allowed.
const fn follows(from: ActionlibStatus, decision: Decision) -> Option<ActionlibStatus> {
    let waiting = matches!(from, ActionlibStatus::Pending | ActionlibStatus::Recalling);
    let at_work = matches!(from, ActionlibStatus::Active | ActionlibStatus::Preempting);
    match decision {
        Decision::Accept if matches!(from, ActionlibStatus::Pending) => {
            Some(ActionlibStatus::Active)
        }
        Decision::Accept if waiting => Some(ActionlibStatus::Preempting),
        Decision::Reject if waiting => Some(ActionlibStatus::Rejected),
        Decision::Cancelled if waiting => Some(ActionlibStatus::Recalled),
        Decision::Cancelled if at_work => Some(ActionlibStatus::Preempted),
        Decision::Abort if at_work => Some(ActionlibStatus::Aborted),
        Decision::Succeed if at_work => Some(ActionlibStatus::Succeeded),
        Decision::Accept
        | Decision::Reject
        | Decision::Cancelled
        | Decision::Abort
        | Decision::Succeed => None,
    }
}

const RECALLED: &str = "cancelled before it arrived";
const TOO_MANY: &str = "the server has too many open goals";

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::clock;

    const LINGER: Duration = Duration::from_secs(5);

    fn id(secs: u32, id: &str) -> ActionlibGoalId {
        ActionlibGoalId {
            stamp: Ros1Time { secs, nsecs: 0 },
            id: id.to_owned(),
        }
    }

    fn fallback() -> ActionlibGoalId {
        id(99, "made")
    }

    /// Returns goals with these ids, requested at seconds 1, 2, ...
    fn with(ids: &[&str], now: Instant) -> ActionlibServerGoals {
        let mut goals = ActionlibServerGoals::new(10, LINGER);
        for (secs, text) in (1..).zip(ids) {
            let new = goals.goal(id(secs, text), fallback(), now);
            assert!(matches!(new, GoalArrival::New(..)));
        }
        goals
    }

    fn key(goals: &ActionlibServerGoals, id: &str) -> Option<GoalKey> {
        let mut entries = goals.entries.iter();
        let entry = entries.find(|entry| entry.status.goal_id.id == id)?;
        Some(entry.key)
    }

    fn decide(
        goals: &mut ActionlibServerGoals,
        id: &str,
        decision: Decision,
        now: Instant,
    ) -> Result<GoalStatus, ActionlibGoalError> {
        let key = key(goals, id).ok_or(ActionlibGoalError::Forgotten)?;
        goals.decide(key, decision, "", now)
    }

    fn cancel(
        goals: &mut ActionlibServerGoals,
        request: &ActionlibGoalId,
        now: Instant,
    ) -> Vec<String> {
        let told = goals.cancel(request, now).into_iter();
        told.map(|key| goals.status(key).unwrap().goal_id.id.clone())
            .collect()
    }

    fn of(goals: &ActionlibServerGoals, id: &str) -> ActionlibStatus {
        goals.status(key(goals, id).unwrap()).unwrap().status
    }

    #[test]
    fn each_decision_is_taken_from_the_statuses_of_actionlib_and_no_other() {
        use ActionlibStatus as S;
        use Decision as D;
        let allowed = [
            (D::Accept, S::Pending, S::Active),
            (D::Accept, S::Recalling, S::Preempting),
            (D::Reject, S::Pending, S::Rejected),
            (D::Reject, S::Recalling, S::Rejected),
            (D::Cancelled, S::Pending, S::Recalled),
            (D::Cancelled, S::Recalling, S::Recalled),
            (D::Cancelled, S::Active, S::Preempted),
            (D::Cancelled, S::Preempting, S::Preempted),
            (D::Abort, S::Active, S::Aborted),
            (D::Abort, S::Preempting, S::Aborted),
            (D::Succeed, S::Active, S::Succeeded),
            (D::Succeed, S::Preempting, S::Succeeded),
        ];
        for decision in [D::Accept, D::Reject, D::Cancelled, D::Abort, D::Succeed] {
            for from in (0..10).filter_map(ActionlibStatus::from_code) {
                let to = allowed
                    .iter()
                    .find(|(d, f, _)| (*d, *f) == (decision, from))
                    .map(|(_, _, to)| *to);
                assert_eq!(follows(from, decision), to, "{decision:?} from {from:?}");
            }
        }
    }

    #[test]
    fn a_refused_decision_says_what_the_goal_is_and_leaves_it() {
        let now = clock::now();
        let mut goals = with(&["a"], now);
        let refused = decide(&mut goals, "a", Decision::Succeed, now).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "the goal a is Pending: it cannot be succeeded"
        );
        assert_eq!(of(&goals, "a"), ActionlibStatus::Pending);
    }

    #[test]
    fn no_id_and_no_time_cancels_all() {
        let now = clock::now();
        let mut goals = with(&["a", "b", "c"], now);
        decide(&mut goals, "b", Decision::Accept, now).unwrap();
        decide(&mut goals, "c", Decision::Reject, now).unwrap();
        assert_eq!(
            cancel(&mut goals, &ActionlibGoalId::default(), now),
            ["a", "b"]
        );
        assert_eq!(of(&goals, "a"), ActionlibStatus::Recalling);
        assert_eq!(of(&goals, "b"), ActionlibStatus::Preempting);
        assert_eq!(of(&goals, "c"), ActionlibStatus::Rejected);
        assert!(
            cancel(&mut goals, &ActionlibGoalId::default(), now).is_empty(),
            "they know"
        );
    }

    #[test]
    fn a_time_cancels_what_was_requested_until_then_and_what_comes_later_of_that_time() {
        let now = clock::now();
        let mut goals = with(&["a", "b", "c"], now);
        assert_eq!(cancel(&mut goals, &id(2, ""), now), ["a", "b"]);
        let late = goals.goal(id(2, "late"), fallback(), now);
        assert!(
            matches!(late, GoalArrival::Ended(status) if status.status == ActionlibStatus::Recalled)
        );
        let newer = goals.goal(id(3, "newer"), fallback(), now);
        assert!(matches!(newer, GoalArrival::New(..)));
    }

    #[test]
    fn an_id_cancels_that_goal_and_with_a_time_all_until_then_too() {
        let now = clock::now();
        let mut goals = with(&["a", "b", "c"], now);
        assert_eq!(cancel(&mut goals, &id(0, "b"), now), ["b"]);
        assert_eq!(cancel(&mut goals, &id(1, "c"), now), ["a", "c"]);
    }

    #[test]
    fn a_goal_whose_cancel_came_first_is_recalled_on_arrival() {
        let now = clock::now();
        let mut goals = with(&[], now);
        assert!(cancel(&mut goals, &id(0, "a"), now).is_empty());
        assert_eq!(of(&goals, "a"), ActionlibStatus::Recalling);
        let arrival = goals.goal(id(7, "a"), fallback(), now);
        assert!(
            matches!(arrival, GoalArrival::Ended(status) if status.status == ActionlibStatus::Recalled)
        );
        assert_eq!(goals.goal(id(7, "a"), fallback(), now), GoalArrival::Known);
    }

    #[test]
    fn a_goal_that_comes_twice_is_taken_once() {
        let now = clock::now();
        let mut goals = with(&["a"], now);
        cancel(&mut goals, &id(0, "a"), now);
        assert_eq!(goals.goal(id(1, "a"), fallback(), now), GoalArrival::Known);
        assert_eq!(
            of(&goals, "a"),
            ActionlibStatus::Recalling,
            "it is the server's to decide"
        );
    }

    #[test]
    fn a_goal_without_id_and_time_is_given_them() {
        let now = clock::now();
        let mut goals = with(&[], now);
        let arrival = goals.goal(ActionlibGoalId::default(), fallback(), now);
        assert!(matches!(arrival, GoalArrival::New(_, given) if given == fallback()));
    }

    #[test]
    fn an_ended_goal_stays_in_the_status_for_its_time() {
        let now = clock::now();
        let mut goals = with(&["a", "b"], now);
        decide(&mut goals, "a", Decision::Reject, now).unwrap();
        assert_eq!(goals.list(now + LINGER).count(), 2);
        let left: Vec<_> = goals
            .list(now + LINGER + Duration::from_millis(1))
            .collect();
        assert_eq!(left.len(), 1);
        assert_eq!(left[0].goal_id.id, "b");
    }

    #[test]
    fn a_full_status_forgets_ended_goals_first_and_then_rejects() {
        let now = clock::now();
        let mut goals = ActionlibServerGoals::new(2, LINGER);
        for text in ["a", "b", "c"] {
            let new = goals.goal(id(1, text), fallback(), now);
            assert!(matches!(new, GoalArrival::New(..)), "{text}");
            if text == "a" {
                decide(&mut goals, "a", Decision::Reject, now).unwrap();
            }
        }
        let full = goals.goal(id(1, "d"), fallback(), now);
        assert!(
            matches!(full, GoalArrival::Ended(status) if status.status == ActionlibStatus::Rejected)
        );
        assert_eq!((goals.counters.forgotten, goals.counters.refused), (1, 1));
        assert!(key(&goals, "a").is_none() && key(&goals, "d").is_none());
    }

    #[derive(Clone, Copy, Debug)]
    enum Input {
        Goal(u8, u32),
        Cancel(u8, u32),
        Decide(u8, Decision),
        Abandon(u8),
        Wait(u64),
    }

    fn input() -> impl Strategy<Value = Input> {
        let decision = prop::sample::select(vec![
            Decision::Accept,
            Decision::Reject,
            Decision::Cancelled,
            Decision::Abort,
            Decision::Succeed,
        ]);
        prop_oneof![
            (0u8..6, 0u32..4).prop_map(|(id, at)| Input::Goal(id, at)),
            (0u8..6, 0u32..4).prop_map(|(id, at)| Input::Cancel(id, at)),
            (0u8..6, decision).prop_map(|(id, decision)| Input::Decide(id, decision)),
            (0u8..6).prop_map(Input::Abandon),
            (0u64..3000).prop_map(Input::Wait),
        ]
    }

    proptest! {
        #[test]
        fn whatever_comes_a_goal_is_told_to_cancel_at_most_once_and_never_leaves_its_end(
            inputs in prop::collection::vec(input(), 0..80)
        ) {
            let mut now = clock::now();
            let mut goals = ActionlibServerGoals::new(4, LINGER);
            let mut told = std::collections::HashMap::new();
            let name = |n: u8| if n == 0 { String::new() } else { n.to_string() };
            for (step, input) in inputs.into_iter().enumerate() {
                let before: Vec<_> = goals.entries.iter().map(|e| (e.key, e.status.status)).collect();
                match input {
                    Input::Goal(n, at) => {
                        let fallback = id(9, &format!("made {step}"));
                        if let GoalArrival::New(key, _) = goals.goal(id(at, &name(n)), fallback, now) {
                            told.insert(key, 0);
                        }
                    }
                    Input::Cancel(n, at) => {
                        for one in goals.cancel(&id(at, &name(n)), now) {
                            *told.get_mut(&one).unwrap() += 1;
                        }
                    }
                    Input::Decide(n, decision) => {
                        // Only the holder of a goal decides about it.
                        let given = key(&goals, &name(n)).filter(|key| told.contains_key(key));
                        if let Some(key) = given {
                            drop(goals.decide(key, decision, "", now));
                        }
                    }
                    Input::Abandon(n) => {
                        if let Some(key) = key(&goals, &name(n)) {
                            drop(goals.abandon(key, "", now));
                        }
                    }
                    Input::Wait(millis) => {
                        now += Duration::from_millis(millis);
                        prop_assert!(goals.list(now).count() <= 4);
                    }
                }
                prop_assert!(told.values().all(|times| *times <= 1));
                prop_assert!(goals.entries.len() <= 4);
                for (key, old) in before.iter().filter(|(_, old)| old.is_terminal()) {
                    if let Some(now) = goals.status(*key) {
                        prop_assert_eq!(now.status, *old);
                    }
                }
            }
        }
    }
}
