//! The goals of an action that is executed here: the state of each goal, and the requests that wait
//! for it.
//!
//! No IO and no clock: requests and events are the input, responses are the output.

mod goal;

use std::collections::{HashMap, VecDeque};
use std::time::Instant;

use bridge_core::ExecutionId;
use bytes::Bytes;
use uadp::Timestamp;

use self::goal::ExecutedGoal;
use super::graph::GraphGoalId;
use super::wire::GoalAnswer;

/// The goals by id. Ended goals are kept for a while.
#[derive(Debug, Default)]
pub(super) struct Goals {
    known: HashMap<GraphGoalId, ExecutedGoal>,
    /// The ids in the order of arrival.
    order: VecDeque<GraphGoalId>,
    /// Total size of the kept results in bytes.
    kept: usize,
}

/// The outcome of a request for a goal.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum GoalDecision {
    /// The goal is to be sent; the response follows the decision of the server.
    Send,
    /// The goal was sent before; the response follows the decision of the server.
    Waits,
    /// The server has decided before.
    Answer(GoalAnswer),
    /// The goal was withdrawn, and is not sent again.
    Withdrawn,
    /// The limit of goals or requests is reached.
    Full,
}

/// The outcome of a request for a result.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum ResultDecision {
    /// The response follows the end of the goal.
    Waits,
    /// The goal has ended.
    Answer(Bytes),
    /// The goal is unknown.
    NoGoal,
    /// The goal was rejected or never sent. Holds the reason.
    Rejected(String),
    /// The limit of waiting requests is reached.
    Full,
}

/// The progress of a goal that is to be cancelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CancelProgress {
    /// Not a goal of the space.
    Unknown,
    /// The server has not decided about the goal.
    Undecided,
    Open,
    /// The server is cancelling the goal, or will cancel it as soon as it has accepted it.
    Cancelling,
    Ended,
}

/// The effect of a request for a goal that is given up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum GivenUp {
    /// The request did not wait for the decision about a goal.
    NotAsked,
    /// Other requests wait for the decision about the same goal.
    ByOne,
    /// No request waits for the decision about this goal.
    ByAll(GraphGoalId),
}

impl Goals {
    /// Returns whether no goal is known: no request waits, and no goal can expire.
    pub(super) fn is_empty(&self) -> bool {
        self.known.is_empty()
    }

    /// Handles a request for a goal.
    pub(super) fn ask(&mut self, id: GraphGoalId, execution: ExecutionId) -> GoalDecision {
        if let Some(goal) = self.known.get_mut(&id) {
            return goal.ask_again(id, execution);
        }
        if !self.has_room() {
            return GoalDecision::Full;
        }
        self.known.insert(id, ExecutedGoal::new(execution));
        self.order.push_back(id);
        GoalDecision::Send
    }

    /// Returns whether there is room for one more goal. Removes the oldest ended goal if necessary.
    fn has_room(&mut self) -> bool {
        if self.known.len() < MOST_GOALS {
            return true;
        }
        let known = &self.known;
        let ended = |id: &GraphGoalId| known.get(id).is_none_or(ExecutedGoal::has_ended);
        let Some(oldest) = self.order.iter().position(ended) else {
            return false;
        };
        self.forget(oldest);
        true
    }

    /// Removes the goal at an index of the order.
    fn forget(&mut self, place: usize) {
        let id = self.order.remove(place);
        if let Some(goal) = id.and_then(|id| self.known.remove(&id)) {
            self.kept -= goal.bytes();
        }
    }

    /// Removes the oldest ended goals, except for `but`, while the results exceed the limit.
    fn make_room(&mut self, but: GraphGoalId) {
        while self.kept > MOST_BYTES {
            let known = &self.known;
            let ended =
                |id: &GraphGoalId| *id != but && known.get(id).is_none_or(ExecutedGoal::has_ended);
            let Some(oldest) = self.order.iter().position(ended) else {
                return;
            };
            self.forget(oldest);
        }
    }

    /// Marks the goal as accepted by the server. Returns the requests for the goal.
    pub(super) fn accepted(
        &mut self,
        id: GraphGoalId,
        stamp: Timestamp,
    ) -> Option<(Vec<ExecutionId>, GoalAnswer)> {
        let goal = self.known.get_mut(&id)?;
        let asked = goal.accept(stamp)?;
        Some((asked, goal.answer(id, None)))
    }

    /// Marks the goal as rejected by the server. Returns the requests for the goal, and the
    /// requests for its result.
    pub(super) fn rejected(
        &mut self,
        id: GraphGoalId,
        why: String,
        now: Instant,
    ) -> Option<(Vec<ExecutionId>, GoalAnswer, Vec<ExecutionId>)> {
        let goal = self.known.get_mut(&id)?;
        let asked = goal.reject(why.clone(), now)?;
        let answer = goal.answer(id, Some(why));
        Some((asked, answer, goal.take_waiting()))
    }

    /// Removes a goal that was never sent. Returns the requests for the goal and for its result.
    /// The goal may be sent again, unless it was withdrawn.
    pub(super) fn failed(
        &mut self,
        id: GraphGoalId,
        why: &str,
        now: Instant,
    ) -> (Vec<ExecutionId>, Vec<ExecutionId>) {
        if self.is_withdrawn(id) {
            let rejected = self.rejected(id, why.to_owned(), now);
            return rejected.map_or_else(Default::default, |(asked, _, waiting)| (asked, waiting));
        }
        let Some(mut goal) = self.known.remove(&id) else {
            return (Vec::new(), Vec::new());
        };
        self.order.retain(|of| *of != id);
        (goal.take_asked(), goal.take_waiting())
    }

    /// Sets the status of a running goal. Returns false if the status has not changed.
    pub(super) fn status(&mut self, id: GraphGoalId, status: i8) -> bool {
        let goal = self.known.get_mut(&id);
        goal.is_some_and(|goal| goal.set_status(status))
    }

    /// Marks the goal as ended. Returns the requests for its result, and the requests for the goal
    /// that were not answered before.
    pub(super) fn ended(
        &mut self,
        id: GraphGoalId,
        (status, answer): (i8, Bytes),
        now: Instant,
    ) -> (Vec<ExecutionId>, Vec<ExecutionId>) {
        let Some(goal) = self.known.get_mut(&id) else {
            return (Vec::new(), Vec::new());
        };
        let before = goal.bytes();
        let asked = goal.end((status, answer), now);
        self.kept += goal.bytes();
        self.kept -= before;
        let waiting = goal.take_waiting();
        self.make_room(id);
        (waiting, asked)
    }

    /// Handles a request for the result of a goal that waits until `until`.
    pub(super) fn want(
        &mut self,
        id: GraphGoalId,
        execution: ExecutionId,
        until: Instant,
    ) -> ResultDecision {
        let waiting: usize = self.known.values().map(ExecutedGoal::waiting).sum();
        let goal = self.known.get_mut(&id);
        goal.map_or(ResultDecision::NoGoal, |goal| {
            goal.want((execution, until), waiting >= MOST_WAITING)
        })
    }

    /// Removes a request for a result. Returns false if the request was not waiting.
    pub(super) fn give_up(&mut self, execution: ExecutionId) -> bool {
        let mut goals = self.known.values_mut();
        goals.any(|goal| goal.give_up(execution))
    }

    /// Withdraws a goal that its server has not decided about. Returns the requests for the goal.
    pub(super) fn withdraw(&mut self, id: GraphGoalId, now: Instant) -> Vec<ExecutionId> {
        let goal = self.known.get_mut(&id);
        goal.map_or_else(Vec::new, |goal| goal.withdraw(now))
    }

    /// Returns the goals that their server has not decided about.
    pub(super) fn undecided(&self) -> Vec<GraphGoalId> {
        let sent = self.order.iter().filter(|id| {
            let goal = self.known.get(*id);
            goal.is_some_and(ExecutedGoal::is_undecided)
        });
        sent.copied().collect()
    }

    /// Removes a request that waits for the decision about a goal. A goal without requests is
    /// withdrawn, because it would start late.
    pub(super) fn give_up_asking(&mut self, execution: ExecutionId, now: Instant) -> GivenUp {
        for (id, goal) in &mut self.known {
            match goal.give_up_asking(execution, now) {
                Some(0) => return GivenUp::ByAll(*id),
                Some(_) => return GivenUp::ByOne,
                None => {}
            }
        }
        GivenUp::NotAsked
    }

    /// Notes that the server refuses to cancel a withdrawn goal. Returns false if the goal is being
    /// cancelled: servers refuse a second cancellation.
    pub(super) fn cancel_refused(&mut self, id: GraphGoalId) -> bool {
        let goal = self.known.get_mut(&id);
        goal.is_none_or(ExecutedGoal::refuse_cancel)
    }

    /// Notes that the server has agreed to cancel the goal.
    pub(super) fn cancel_agreed(&mut self, id: GraphGoalId) {
        if let Some(goal) = self.known.get_mut(&id) {
            goal.agree_to_cancel();
        }
    }

    /// Returns whether a goal is to be cancelled as soon as it is accepted.
    pub(super) fn is_withdrawn(&self, id: GraphGoalId) -> bool {
        self.known.get(&id).is_some_and(ExecutedGoal::is_withdrawn)
    }

    /// Returns the withdrawn goals that the server has neither started nor refused to cancel, each
    /// with the time of withdrawal, oldest goal first.
    pub(super) fn pending(&self) -> Vec<(GraphGoalId, Instant)> {
        let pending = self.order.iter().filter_map(|id| {
            let since = self.known.get(id)?.pending_since()?;
            Some((*id, since))
        });
        pending.collect()
    }

    /// Returns the progress of a goal.
    pub(super) fn progress(&self, id: GraphGoalId) -> CancelProgress {
        let goal = self.known.get(&id);
        goal.map_or(CancelProgress::Unknown, ExecutedGoal::progress)
    }

    /// Returns the running goals that were accepted at `until` or before.
    pub(super) fn open_until(&self, until: Timestamp) -> Vec<GraphGoalId> {
        let known = self.known.iter();
        let open = known.filter(|(_, goal)| goal.is_open_until(until));
        open.map(|(id, _)| *id).collect()
    }

    /// Returns the statuses of the newest goals, oldest goal first.
    pub(super) fn statuses(&self) -> Vec<(GraphGoalId, i8)> {
        let newest = self.order.iter().rev();
        let newest = newest.filter_map(|id| {
            let status = self.known.get(id)?.status()?;
            Some((*id, status))
        });
        let mut newest: Vec<(GraphGoalId, i8)> = newest.take(MOST_STATUSES).collect();
        newest.reverse();
        newest
    }

    /// Removes goals that ended long ago. Returns the requests for results that wait too long, and
    /// whether any goal was removed.
    pub(super) fn tidy(&mut self, now: Instant) -> (Vec<ExecutionId>, bool) {
        let known = &mut self.known;
        let before = known.len();
        known.retain(|_, goal| !goal.is_expired(now));
        self.kept = known.values().map(ExecutedGoal::bytes).sum();
        let forgotten = known.len() < before;
        if forgotten {
            self.order.retain(|id| known.contains_key(id));
        }
        let mut late = Vec::new();
        for goal in known.values_mut() {
            late.extend(goal.take_late(now));
        }
        (late, forgotten)
    }

    /// Removes and returns all waiting requests for goals and results, because no further event can
    /// arrive.
    pub(super) fn all_waiting(&mut self) -> Vec<ExecutionId> {
        let mut all = Vec::new();
        for goal in self.known.values_mut() {
            all.extend(goal.take_waiting());
            all.extend(goal.take_asked());
        }
        all
    }
}

/// The maximal number of known goals of one action; ended goals give way to new goals.
const MOST_GOALS: usize = 1000;
/// The maximal size in bytes of the kept results of one action. The oldest results give way; the
/// newest is kept at any size.
const MOST_BYTES: usize = 64 << 20;
/// The maximal number of requests that wait for results of one action: each occupies a place of the
/// Responder.
const MOST_WAITING: usize = 128;
/// The maximal number of goals in the value with the statuses.
const MOST_STATUSES: usize = 100;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::goal::{CANCELING, KEPT};
    use super::*;

    fn id(number: u16) -> GraphGoalId {
        let mut id = [0; 16];
        id[..2].copy_from_slice(&number.to_le_bytes());
        id
    }

    fn run(number: u64) -> ExecutionId {
        ExecutionId::new(number)
    }

    fn at(nanos: i128) -> Timestamp {
        Timestamp::from_unix_nanos(nanos)
    }

    #[test]
    fn a_goal_that_is_asked_for_twice_is_sent_once_and_has_one_answer() {
        let mut goals = Goals::default();
        assert_eq!(goals.ask(id(1), run(1)), GoalDecision::Send);
        assert_eq!(goals.ask(id(1), run(2)), GoalDecision::Waits);
        let (asked, answer) = goals.accepted(id(1), at(500)).unwrap();
        assert_eq!(asked, [run(1), run(2)]);
        assert!(answer.accepted && answer.stamp == at(500));
        assert_eq!(
            goals.ask(id(1), run(3)),
            GoalDecision::Answer(answer.clone())
        );
        let now = crate::now().monotonic;
        goals.ended(id(1), (4, Bytes::new()), now);
        assert_eq!(goals.ask(id(1), run(4)), GoalDecision::Answer(answer));
        // A rejected goal is answered again too.
        goals.ask(id(2), run(5));
        let (asked, answer, _) = goals.rejected(id(2), "no".to_owned(), now).unwrap();
        assert_eq!((asked, answer.accepted), (vec![run(5)], false));
        assert_eq!(goals.ask(id(2), run(6)), GoalDecision::Answer(answer));
        let why = "no".to_owned();
        assert_eq!(
            goals.want(id(2), run(7), now),
            ResultDecision::Rejected(why)
        );
        // A goal that was never sent may be sent again.
        goals.ask(id(3), run(8));
        assert_eq!(goals.failed(id(3), "none", now), (vec![run(8)], vec![]));
        assert_eq!(goals.ask(id(3), run(9)), GoalDecision::Send);
    }

    #[test]
    fn a_goal_that_nobody_waits_for_is_withdrawn_before_it_is_accepted() {
        let mut goals = Goals::default();
        let now = crate::now().monotonic;
        goals.ask(id(1), run(1));
        goals.ask(id(1), run(2));
        assert_eq!(goals.give_up_asking(run(1), now), GivenUp::ByOne);
        assert_eq!(goals.pending(), []);
        assert_eq!(goals.give_up_asking(run(2), now), GivenUp::ByAll(id(1)));
        assert_eq!(goals.give_up_asking(run(2), now), GivenUp::NotAsked);
        assert_eq!(goals.pending(), [(id(1), now)]);
        // A repeated request does not revive the goal.
        assert_eq!(goals.ask(id(1), run(3)), GoalDecision::Withdrawn);
        let soon = now + Duration::from_secs(30);
        assert_eq!(goals.want(id(1), run(4), soon), ResultDecision::Waits);
        let (asked, _) = goals.accepted(id(1), at(1)).unwrap();
        assert_eq!((asked, goals.pending()), (vec![], vec![(id(1), now)]));
        goals.status(id(1), CANCELING);
        assert_eq!(goals.pending(), []);
        let (waiting, _) = goals.ended(id(1), (5, Bytes::new()), now);
        assert_eq!(waiting, [run(4)]);
        // An accepted goal goes on without its caller.
        goals.ask(id(2), run(5));
        goals.accepted(id(2), at(2));
        assert_eq!(goals.give_up_asking(run(5), now), GivenUp::NotAsked);
        assert_eq!(goals.withdraw(id(2), now), []);
        assert_eq!(goals.pending(), []);
    }

    #[test]
    fn a_withdrawn_goal_that_never_came_to_be_is_known_as_rejected() {
        let mut goals = Goals::default();
        let now = crate::now().monotonic;
        goals.ask(id(1), run(1));
        assert_eq!(goals.withdraw(id(1), now), [run(1)]);
        assert_eq!(goals.want(id(1), run(2), now), ResultDecision::Waits);
        assert_eq!(goals.failed(id(1), "not sent", now), (vec![], vec![run(2)]));
        let why = "not sent".to_owned();
        assert_eq!(
            goals.want(id(1), run(3), now),
            ResultDecision::Rejected(why)
        );
        assert_eq!(
            (goals.progress(id(1)), goals.pending()),
            (CancelProgress::Ended, vec![])
        );
        // A refused cancellation is not pending.
        goals.ask(id(2), run(4));
        goals.withdraw(id(2), now);
        goals.accepted(id(2), at(1));
        goals.cancel_refused(id(2));
        assert_eq!(goals.pending(), []);
    }

    #[test]
    fn a_result_is_waited_for_and_stays_readable_for_a_while() {
        let mut goals = Goals::default();
        let start = crate::now().monotonic;
        let soon = start + Duration::from_secs(30);
        assert_eq!(goals.want(id(1), run(1), soon), ResultDecision::NoGoal);
        goals.ask(id(1), run(2));
        goals.accepted(id(1), at(1));
        assert_eq!(goals.want(id(1), run(3), soon), ResultDecision::Waits);
        assert_eq!(goals.want(id(1), run(4), soon), ResultDecision::Waits);
        assert_eq!(
            goals.want(id(1), run(5), soon + KEPT),
            ResultDecision::Waits
        );
        assert!(goals.give_up(run(4)) && !goals.give_up(run(4)));
        assert_eq!(goals.tidy(soon), (vec![run(3)], false));
        let answer = Bytes::from_static(b"result");
        let (waiting, _) = goals.ended(id(1), (4, answer.clone()), soon);
        assert_eq!(waiting, [run(5)]);
        assert_eq!(
            goals.want(id(1), run(6), soon),
            ResultDecision::Answer(answer)
        );
        assert_eq!(goals.statuses(), [(id(1), 4)]);
        assert_eq!(goals.tidy(soon + KEPT), (vec![], true));
        assert_eq!(goals.want(id(1), run(7), soon), ResultDecision::NoGoal);
        assert_eq!(goals.statuses(), []);
    }

    #[test]
    fn the_oldest_results_give_way_where_they_take_too_much() {
        let mut goals = Goals::default();
        let now = crate::now().monotonic;
        let result = Bytes::from(vec![0; MOST_BYTES / 2]);
        for number in 1..=4 {
            goals.ask(id(number), run(1));
            goals.accepted(id(number), at(number.into()));
        }
        for number in [2, 1, 3] {
            goals.ended(id(number), (4, result.clone()), now);
        }
        let of = |goals: &Goals| [1, 2, 3, 4].map(|number| goals.progress(id(number)));
        let (open, ended, unknown) = (
            CancelProgress::Open,
            CancelProgress::Ended,
            CancelProgress::Unknown,
        );
        assert_eq!(of(&goals), [unknown, ended, ended, open]);
        let large = Bytes::from(vec![0; MOST_BYTES + 1]);
        goals.ended(id(4), (4, large.clone()), now);
        assert_eq!(of(&goals), [unknown, unknown, unknown, ended]);
        assert_eq!(
            goals.want(id(4), run(2), now),
            ResultDecision::Answer(large)
        );
        goals.tidy(now + KEPT);
        assert_eq!(goals.kept, 0);
    }

    #[test]
    fn ended_goals_give_way_and_open_ones_do_not() {
        let mut goals = Goals::default();
        let now = crate::now().monotonic;
        for number in 1..=1000 {
            assert_eq!(goals.ask(id(number), run(1)), GoalDecision::Send);
            goals.accepted(id(number), at(number.into()));
        }
        assert_eq!(goals.ask(id(1001), run(1)), GoalDecision::Full);
        goals.ended(id(700), (4, Bytes::new()), now);
        goals.ended(id(30), (5, Bytes::new()), now);
        assert_eq!(goals.ask(id(1001), run(1)), GoalDecision::Send);
        assert_eq!(goals.progress(id(30)), CancelProgress::Unknown);
        assert_eq!(goals.progress(id(700)), CancelProgress::Ended);
        assert_eq!(goals.open_until(at(30)).len(), 29);
        assert_eq!(goals.statuses().len(), MOST_STATUSES);
        assert_eq!(goals.statuses().last(), Some(&(id(1000), 1)));
    }
}
