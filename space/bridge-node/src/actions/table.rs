//! The goals of an action that is executed here: what became of each, and who waits for it.
//!
//! No IO and no clock: requests and events come in, answers come out.

use std::collections::{HashMap, VecDeque};
use std::time::{Duration, Instant};

use bridge_core::ExecutionId;
use bytes::Bytes;
use uadp::Timestamp;

use super::graph::GoalId;
use super::wire::GoalAnswer;

/// Goals by their ids, the ended ones for a while.
#[derive(Debug, Default)]
pub(super) struct Goals {
    known: HashMap<GoalId, Goal>,
    /// In the order in which they came.
    order: VecDeque<GoalId>,
    /// Bytes of the results that are kept.
    kept: usize,
}

#[derive(Debug)]
struct Goal {
    state: State,
    /// When it was accepted; zero before.
    stamp: Timestamp,
    /// Who waits for its result.
    waiting: Vec<Waiting>,
    /// Since when it is withdrawn: it is to be cancelled as soon as its server has accepted it.
    withdrawn: Option<Instant>,
    /// The server refuses to cancel it.
    is_refused: bool,
}

#[derive(Debug)]
enum State {
    /// The server has not decided. Who asked.
    Sent(Vec<ExecutionId>),
    /// With the status of `action_msgs/GoalStatus`.
    Running(i8),
    Rejected {
        why: String,
        since: Instant,
    },
    /// The answer to those who ask for the result.
    Ended {
        status: i8,
        answer: Bytes,
        since: Instant,
    },
}

#[derive(Debug, Clone, Copy)]
struct Waiting {
    execution: ExecutionId,
    /// When it is told to ask anew.
    until: Instant,
}

/// What a request for a goal comes to.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Asked {
    /// It is to be sent; the answer comes when the server has decided.
    Send,
    /// It was sent before; the answer comes likewise.
    Waits,
    /// It was decided before.
    Answer(GoalAnswer),
    /// It was withdrawn, and is not sent again.
    Withdrawn,
    /// There is no room for one more.
    Full,
}

/// What a request for a result comes to.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Wanted {
    /// The answer comes at the end of the goal.
    Waits,
    /// It has ended.
    Answer(Bytes),
    /// There is no such goal.
    NoGoal,
    /// It was rejected, or never sent: with the reason.
    Rejected(String),
    /// As many wait as may.
    Full,
}

/// How far a goal is that is to be cancelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Progress {
    /// None of the space.
    Unknown,
    /// Its server has not decided.
    Undecided,
    Open,
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
    ByAll(GoalId),
}

impl Goals {
    /// Whether no goal is known, and so nobody waits and nothing is to be forgotten.
    pub(super) fn is_empty(&self) -> bool {
        self.known.is_empty()
    }

    /// Somebody asks for a goal.
    pub(super) fn ask(&mut self, id: GoalId, execution: ExecutionId) -> Asked {
        if let Some(goal) = self.known.get_mut(&id) {
            let answer = |accepted, message: &str| {
                Asked::Answer(GoalAnswer {
                    accepted,
                    id,
                    stamp: goal.stamp,
                    message: message.to_owned(),
                })
            };
            return match &mut goal.state {
                State::Sent(_) if goal.withdrawn.is_some() => Asked::Withdrawn,
                State::Sent(asked) if asked.len() >= MOST_WAITING => Asked::Full,
                State::Sent(asked) => {
                    asked.push(execution);
                    Asked::Waits
                }
                State::Running(_) | State::Ended { .. } => answer(true, ""),
                State::Rejected { why, .. } => answer(false, why),
            };
        }
        if !self.has_room() {
            return Asked::Full;
        }
        let goal = Goal {
            state: State::Sent(vec![execution]),
            stamp: Timestamp::from_unix_nanos(0),
            waiting: Vec::new(),
            withdrawn: None,
            is_refused: false,
        };
        self.known.insert(id, goal);
        self.order.push_back(id);
        Asked::Send
    }

    /// Whether one more has room, be it for one that has ended.
    fn has_room(&mut self) -> bool {
        if self.known.len() < MOST_GOALS {
            return true;
        }
        let known = &self.known;
        let ended = |id: &GoalId| known.get(id).is_none_or(Goal::has_ended);
        let Some(oldest) = self.order.iter().position(ended) else {
            return false;
        };
        self.forget(oldest);
        true
    }

    /// Forgets the goal at that place of the order.
    fn forget(&mut self, place: usize) {
        let id = self.order.remove(place);
        if let Some(goal) = id.and_then(|id| self.known.remove(&id)) {
            self.kept -= goal.state.bytes();
        }
    }

    /// Forgets the oldest that ended, but for one, while the results take too much.
    fn make_room(&mut self, but: GoalId) {
        while self.kept > MOST_BYTES {
            let known = &self.known;
            let ended = |id: &GoalId| *id != but && known.get(id).is_none_or(Goal::has_ended);
            let Some(oldest) = self.order.iter().position(ended) else {
                return;
            };
            self.forget(oldest);
        }
    }

    /// The server works on the goal. Returns who asked for it.
    pub(super) fn accepted(
        &mut self,
        id: GoalId,
        stamp: Timestamp,
    ) -> Option<(Vec<ExecutionId>, GoalAnswer)> {
        let goal = self.known.get_mut(&id)?;
        let State::Sent(asked) = &mut goal.state else {
            return None;
        };
        let asked = std::mem::take(asked);
        goal.state = State::Running(ACCEPTED);
        goal.stamp = stamp;
        let answer = GoalAnswer {
            accepted: true,
            id,
            stamp,
            message: String::new(),
        };
        Some((asked, answer))
    }

    /// The server does not take the goal. Returns who asked for it, and who waits for its result.
    pub(super) fn rejected(
        &mut self,
        id: GoalId,
        why: String,
        now: Instant,
    ) -> Option<(Vec<ExecutionId>, GoalAnswer, Vec<ExecutionId>)> {
        let goal = self.known.get_mut(&id)?;
        let State::Sent(asked) = &mut goal.state else {
            return None;
        };
        let asked = std::mem::take(asked);
        let answer = GoalAnswer {
            accepted: false,
            id,
            stamp: goal.stamp,
            message: why.clone(),
        };
        goal.state = State::Rejected { why, since: now };
        Some((asked, answer, goal.take_waiting()))
    }

    /// Notes that the goal was never sent. Returns the requests for the goal and for its result. The goal may be sent anew,
    /// unless it was withdrawn.
    pub(super) fn failed(
        &mut self,
        id: GoalId,
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
        let asked = match &mut goal.state {
            State::Sent(asked) => std::mem::take(asked),
            State::Running(_) | State::Rejected { .. } | State::Ended { .. } => Vec::new(),
        };
        (asked, goal.take_waiting())
    }

    /// How far the server is. False where that is not new.
    pub(super) fn status(&mut self, id: GoalId, status: i8) -> bool {
        match self.known.get_mut(&id).map(|goal| &mut goal.state) {
            Some(State::Running(known)) => std::mem::replace(known, status) != status,
            Some(State::Sent(_) | State::Rejected { .. } | State::Ended { .. }) | None => false,
        }
    }

    /// The goal has ended. Returns who waits for its result, and who asked for it where that was not known before.
    pub(super) fn ended(
        &mut self,
        id: GoalId,
        (status, answer): (i8, Bytes),
        now: Instant,
    ) -> (Vec<ExecutionId>, Vec<ExecutionId>) {
        let Some(goal) = self.known.get_mut(&id) else {
            return (Vec::new(), Vec::new());
        };
        let state = State::Ended {
            status,
            answer,
            since: now,
        };
        self.kept += state.bytes();
        let before = std::mem::replace(&mut goal.state, state);
        self.kept -= before.bytes();
        let asked = match before {
            State::Sent(asked) => asked,
            State::Running(_) | State::Rejected { .. } | State::Ended { .. } => Vec::new(),
        };
        let waiting = goal.take_waiting();
        self.make_room(id);
        (waiting, asked)
    }

    /// Somebody asks for the result of a goal, and waits for it until then.
    pub(super) fn want(&mut self, id: GoalId, execution: ExecutionId, until: Instant) -> Wanted {
        let waiting: usize = self.known.values().map(|goal| goal.waiting.len()).sum();
        match self.known.get_mut(&id) {
            None => Wanted::NoGoal,
            Some(Goal {
                state: State::Rejected { why, .. },
                ..
            }) => Wanted::Rejected(why.clone()),
            Some(Goal {
                state: State::Ended { answer, .. },
                ..
            }) => Wanted::Answer(answer.clone()),
            Some(_) if waiting >= MOST_WAITING => Wanted::Full,
            Some(goal) => {
                goal.waiting.push(Waiting { execution, until });
                Wanted::Waits
            }
        }
    }

    /// Somebody does not wait for a result any longer. False where that one did not.
    pub(super) fn give_up(&mut self, execution: ExecutionId) -> bool {
        self.known.values_mut().any(|goal| {
            let before = goal.waiting.len();
            goal.waiting.retain(|one| one.execution != execution);
            goal.waiting.len() < before
        })
    }

    /// Withdraws a goal that its server has not decided about. Returns who asked for it.
    pub(super) fn withdraw(&mut self, id: GoalId, now: Instant) -> Vec<ExecutionId> {
        let Some(goal) = self.known.get_mut(&id) else {
            return Vec::new();
        };
        match &mut goal.state {
            State::Sent(asked) => {
                goal.withdrawn.get_or_insert(now);
                std::mem::take(asked)
            }
            State::Running(_) | State::Rejected { .. } | State::Ended { .. } => Vec::new(),
        }
    }

    /// The goals that their server has not decided about.
    pub(super) fn undecided(&self) -> Vec<GoalId> {
        let sent = self.order.iter().filter(|id| {
            let goal = self.known.get(*id);
            goal.is_some_and(|goal| matches!(goal.state, State::Sent(_)))
        });
        sent.copied().collect()
    }

    /// Removes a request that waits for the decision about a goal. A goal without requests is withdrawn, since it would begin
    /// late.
    pub(super) fn give_up_asking(&mut self, execution: ExecutionId, now: Instant) -> GivenUp {
        for (id, goal) in &mut self.known {
            let State::Sent(asked) = &mut goal.state else {
                continue;
            };
            let before = asked.len();
            asked.retain(|one| *one != execution);
            if asked.len() == before {
                continue;
            }
            if asked.is_empty() {
                goal.withdrawn.get_or_insert(now);
                return GivenUp::ByAll(*id);
            }
            return GivenUp::ByOne;
        }
        GivenUp::NotAsked
    }

    /// The server refuses to cancel a withdrawn goal.
    pub(super) fn cancel_refused(&mut self, id: GoalId) {
        if let Some(goal) = self.known.get_mut(&id) {
            goal.is_refused = true;
        }
    }

    /// Whether a goal is to be cancelled as soon as it is accepted.
    pub(super) fn is_withdrawn(&self, id: GoalId) -> bool {
        self.known
            .get(&id)
            .is_some_and(|goal| goal.withdrawn.is_some())
    }

    /// The withdrawn goals of which the server has not said that it cancels them, or refuses to, and since when. The oldest
    /// come first.
    pub(super) fn pending(&self) -> Vec<(GoalId, Instant)> {
        let pending = self.order.iter().filter_map(|id| {
            let goal = self.known.get(id).filter(|goal| !goal.is_refused)?;
            let is_open = match goal.state {
                State::Sent(_) => true,
                State::Running(status) => status != CANCELING,
                State::Rejected { .. } | State::Ended { .. } => false,
            };
            goal.withdrawn.filter(|_| is_open).map(|since| (*id, since))
        });
        pending.collect()
    }

    /// How far a goal is.
    pub(super) fn progress(&self, id: GoalId) -> Progress {
        match self.known.get(&id).map(|goal| &goal.state) {
            None => Progress::Unknown,
            Some(State::Sent(_)) => Progress::Undecided,
            Some(State::Running(_)) => Progress::Open,
            Some(State::Rejected { .. } | State::Ended { .. }) => Progress::Ended,
        }
    }

    /// The goals that have not ended and were accepted then or before.
    pub(super) fn open_until(&self, until: Timestamp) -> Vec<GoalId> {
        let open = self.known.iter().filter(|(_, goal)| {
            matches!(goal.state, State::Running(_)) && goal.stamp.unix_nanos() <= until.unix_nanos()
        });
        open.map(|(id, _)| *id).collect()
    }

    /// The newest goals with their statuses, the oldest of them first.
    pub(super) fn statuses(&self) -> Vec<(GoalId, i8)> {
        let newest = self.order.iter().rev();
        let newest = newest.filter_map(|id| {
            let status = match &self.known.get(id)?.state {
                State::Sent(_) | State::Rejected { .. } => return None,
                State::Running(status) => *status,
                State::Ended { status, .. } => *status,
            };
            Some((*id, status))
        });
        let mut newest: Vec<(GoalId, i8)> = newest.take(MOST_STATUSES).collect();
        newest.reverse();
        newest
    }

    /// Forgets goals that ended long ago. Returns who waits too long for a result, and whether any goal was forgotten.
    pub(super) fn tidy(&mut self, now: Instant) -> (Vec<ExecutionId>, bool) {
        let known = &mut self.known;
        let before = known.len();
        known.retain(|_, goal| match &goal.state {
            State::Rejected { since, .. } | State::Ended { since, .. } => *since + KEPT > now,
            State::Sent(_) | State::Running(_) => true,
        });
        self.kept = known.values().map(|goal| goal.state.bytes()).sum();
        let forgotten = known.len() < before;
        if forgotten {
            self.order.retain(|id| known.contains_key(id));
        }
        let mut late = Vec::new();
        for goal in known.values_mut() {
            let over = goal.waiting.extract_if(.., |one| one.until <= now);
            late.extend(over.map(|one| one.execution));
        }
        (late, forgotten)
    }

    /// Everybody who waits for a goal or a result: nothing more is heard of any.
    pub(super) fn all_waiting(&mut self) -> Vec<ExecutionId> {
        let mut all = Vec::new();
        for goal in self.known.values_mut() {
            all.extend(goal.take_waiting());
            if let State::Sent(asked) = &mut goal.state {
                all.append(asked);
            }
        }
        all
    }
}

impl State {
    /// Of the result that is kept.
    const fn bytes(&self) -> usize {
        match self {
            Self::Ended { answer, .. } => answer.len(),
            Self::Sent(_) | Self::Running(_) | Self::Rejected { .. } => 0,
        }
    }
}

impl Goal {
    const fn has_ended(&self) -> bool {
        match &self.state {
            State::Rejected { .. } | State::Ended { .. } => true,
            State::Sent(_) | State::Running(_) => false,
        }
    }

    fn take_waiting(&mut self) -> Vec<ExecutionId> {
        let waiting = std::mem::take(&mut self.waiting);
        waiting.into_iter().map(|one| one.execution).collect()
    }
}

/// Goals of one action that are known; ended ones give way to new ones.
const MOST_GOALS: usize = 1000;
/// Bytes of the results of one action that are kept; the oldest give way, and the newest stays whatever its size.
const MOST_BYTES: usize = 64 << 20;
/// How long a goal is known after its end.
const KEPT: Duration = Duration::from_secs(15 * 60);
/// Who waits for results of one action: each request is held up by a place of the Responder.
const MOST_WAITING: usize = 128;
/// Goals in the value with the statuses.
const MOST_STATUSES: usize = 100;
/// `action_msgs/GoalStatus`, STATUS_ACCEPTED.
const ACCEPTED: i8 = 1;
/// `action_msgs/GoalStatus`, STATUS_CANCELING.
const CANCELING: i8 = 3;

#[cfg(test)]
mod tests {
    use super::*;

    fn id(number: u16) -> GoalId {
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
        assert_eq!(goals.ask(id(1), run(1)), Asked::Send);
        assert_eq!(goals.ask(id(1), run(2)), Asked::Waits);
        let (asked, answer) = goals.accepted(id(1), at(500)).unwrap();
        assert_eq!(asked, [run(1), run(2)]);
        assert!(answer.accepted && answer.stamp == at(500));
        assert_eq!(goals.ask(id(1), run(3)), Asked::Answer(answer.clone()));
        let now = crate::now().monotonic;
        goals.ended(id(1), (4, Bytes::new()), now);
        assert_eq!(goals.ask(id(1), run(4)), Asked::Answer(answer));
        // Rejected ones too.
        goals.ask(id(2), run(5));
        let (asked, answer, _) = goals.rejected(id(2), "no".to_owned(), now).unwrap();
        assert_eq!((asked, answer.accepted), (vec![run(5)], false));
        assert_eq!(goals.ask(id(2), run(6)), Asked::Answer(answer));
        let why = "no".to_owned();
        assert_eq!(goals.want(id(2), run(7), now), Wanted::Rejected(why));
        // One that never came to be may.
        goals.ask(id(3), run(8));
        assert_eq!(goals.failed(id(3), "none", now), (vec![run(8)], vec![]));
        assert_eq!(goals.ask(id(3), run(9)), Asked::Send);
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
        // Asking anew does not revive it.
        assert_eq!(goals.ask(id(1), run(3)), Asked::Withdrawn);
        let soon = now + Duration::from_secs(30);
        assert_eq!(goals.want(id(1), run(4), soon), Wanted::Waits);
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
        assert_eq!(goals.want(id(1), run(2), now), Wanted::Waits);
        assert_eq!(goals.failed(id(1), "not sent", now), (vec![], vec![run(2)]));
        let why = "not sent".to_owned();
        assert_eq!(goals.want(id(1), run(3), now), Wanted::Rejected(why));
        assert_eq!(
            (goals.progress(id(1)), goals.pending()),
            (Progress::Ended, vec![])
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
        assert_eq!(goals.want(id(1), run(1), soon), Wanted::NoGoal);
        goals.ask(id(1), run(2));
        goals.accepted(id(1), at(1));
        assert_eq!(goals.want(id(1), run(3), soon), Wanted::Waits);
        assert_eq!(goals.want(id(1), run(4), soon), Wanted::Waits);
        assert_eq!(goals.want(id(1), run(5), soon + KEPT), Wanted::Waits);
        assert!(goals.give_up(run(4)) && !goals.give_up(run(4)));
        assert_eq!(goals.tidy(soon), (vec![run(3)], false));
        let answer = Bytes::from_static(b"result");
        let (waiting, _) = goals.ended(id(1), (4, answer.clone()), soon);
        assert_eq!(waiting, [run(5)]);
        assert_eq!(goals.want(id(1), run(6), soon), Wanted::Answer(answer));
        assert_eq!(goals.statuses(), [(id(1), 4)]);
        assert_eq!(goals.tidy(soon + KEPT), (vec![], true));
        assert_eq!(goals.want(id(1), run(7), soon), Wanted::NoGoal);
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
        let (open, ended, unknown) = (Progress::Open, Progress::Ended, Progress::Unknown);
        assert_eq!(of(&goals), [unknown, ended, ended, open]);
        let large = Bytes::from(vec![0; MOST_BYTES + 1]);
        goals.ended(id(4), (4, large.clone()), now);
        assert_eq!(of(&goals), [unknown, unknown, unknown, ended]);
        assert_eq!(goals.want(id(4), run(2), now), Wanted::Answer(large));
        goals.tidy(now + KEPT);
        assert_eq!(goals.kept, 0);
    }

    #[test]
    fn ended_goals_give_way_and_open_ones_do_not() {
        let mut goals = Goals::default();
        let now = crate::now().monotonic;
        for number in 1..=1000 {
            assert_eq!(goals.ask(id(number), run(1)), Asked::Send);
            goals.accepted(id(number), at(number.into()));
        }
        assert_eq!(goals.ask(id(1001), run(1)), Asked::Full);
        goals.ended(id(700), (4, Bytes::new()), now);
        goals.ended(id(30), (5, Bytes::new()), now);
        assert_eq!(goals.ask(id(1001), run(1)), Asked::Send);
        assert_eq!(goals.progress(id(30)), Progress::Unknown);
        assert_eq!(goals.progress(id(700)), Progress::Ended);
        assert_eq!(goals.open_until(at(30)).len(), 29);
        assert_eq!(goals.statuses().len(), MOST_STATUSES);
        assert_eq!(goals.statuses().last(), Some(&(id(1000), 1)));
    }
}
