use proptest::prelude::*;

use super::*;

const KEPT: Duration = Duration::from_secs(10);

fn now() -> Instant {
    Instant::now()
}

const fn id(number: u8) -> GoalId {
    GoalId::from_bytes([number; 16])
}

const fn stamp(sec: i32) -> Ros2Time {
    Ros2Time { sec, nanosec: 0 }
}

fn result(number: u8) -> Bytes {
    Bytes::from(vec![0, 1, 0, 0, number])
}

fn goals(most: usize) -> ServerGoals<u8> {
    ServerGoals::new(most, Some(KEPT))
}

/// Adds a goal with this number, accepted at the second of the same number.
fn accepted(goals: &mut ServerGoals<u8>, number: u8) -> Ticket {
    let NewGoalDecision::New(ticket) = goals.arrive(id(number)) else {
        panic!("goal {number} is not new");
    };
    goals.accept(ticket, stamp(number.into())).unwrap();
    ticket
}

/// Adds a goal in this state.
fn with_status(goals: &mut ServerGoals<u8>, number: u8, status: GoalStatusCode) -> Ticket {
    let ticket = accepted(goals, number);
    match status {
        GoalStatusCode::Accepted => {}
        GoalStatusCode::Executing => goals.execute(ticket).unwrap(),
        GoalStatusCode::Canceling => goals.cancel(ticket).unwrap(),
        GoalStatusCode::Succeeded | GoalStatusCode::Aborted => {
            goals.execute(ticket).unwrap();
            let end = [End::Succeed, End::Abort][usize::from(status == GoalStatusCode::Aborted)];
            goals.end(ticket, end, result(0), now()).unwrap();
        }
        GoalStatusCode::Canceled => {
            goals.cancel(ticket).unwrap();
            goals.end(ticket, End::Cancel, result(0), now()).unwrap();
        }
        GoalStatusCode::Unknown => panic!("an accepted goal is known"),
    }
    assert_eq!(goals.status(ticket), Some(status));
    ticket
}

fn all() -> impl Iterator<Item = GoalStatusCode> {
    (1..=6).filter_map(GoalStatusCode::from_code)
}

#[test]
fn each_step_is_taken_from_the_states_of_rcl_and_no_other() {
    use GoalStatusCode as S;
    type Step = fn(&mut ServerGoals<u8>, Ticket) -> Result<(), GoalError>;
    fn end(goals: &mut ServerGoals<u8>, ticket: Ticket, end: End) -> Result<(), GoalError> {
        goals.end(ticket, end, result(1), now()).map(drop)
    }
    let steps: [(Step, &[S], S); 5] = [
        (ServerGoals::execute, &[S::Accepted], S::Executing),
        (
            ServerGoals::cancel,
            &[S::Accepted, S::Executing, S::Canceling],
            S::Canceling,
        ),
        (
            |goals, ticket| end(goals, ticket, End::Succeed),
            &[S::Executing, S::Canceling],
            S::Succeeded,
        ),
        (
            |goals, ticket| end(goals, ticket, End::Abort),
            &[S::Executing, S::Canceling],
            S::Aborted,
        ),
        (
            |goals, ticket| end(goals, ticket, End::Cancel),
            &[S::Canceling],
            S::Canceled,
        ),
    ];
    for (step, allowed, to) in steps {
        for from in all() {
            let mut goals = goals(10);
            let ticket = with_status(&mut goals, 1, from);
            let taken = step(&mut goals, ticket);
            assert_eq!(taken.is_ok(), allowed.contains(&from), "{from:?} to {to:?}");
            let then = if taken.is_ok() { to } else { from };
            assert_eq!(goals.status(ticket), Some(then));
        }
    }
}

#[test]
fn a_refused_step_says_what_the_goal_is() {
    let mut goals = goals(10);
    let ticket = accepted(&mut goals, 0xab);
    let error = goals
        .end(ticket, End::Succeed, result(1), now())
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        format!(
            "the goal {} is Accepted: it cannot be succeeded",
            "ab".repeat(16)
        )
    );
}

#[test]
fn a_goal_is_unknown_until_it_is_accepted_and_when_it_was_rejected() {
    let mut goals = goals(10);
    let NewGoalDecision::New(ticket) = goals.arrive(id(1)) else {
        panic!("it is new");
    };
    assert_eq!(goals.ask(id(1), || 1), ResultRequest::Unknown);
    assert_eq!(
        goals.to_cancel(CancelWhat::Goal(id(1))),
        Err(CancelCode::UnknownGoal)
    );
    assert_eq!(goals.list(), []);
    assert_eq!(goals.arrive(id(1)), NewGoalDecision::Known);
    goals.reject(ticket);
    assert_eq!(goals.ask(id(1), || 1), ResultRequest::Unknown);
    assert!(matches!(goals.arrive(id(1)), NewGoalDecision::New(_)));
    assert_eq!(goals.counters.repeated, 1);
    assert_eq!(
        goals.accept(ticket, stamp(1)),
        Err(GoalError::Forgotten(id(1))),
        "it is another goal of that id"
    );
}

#[test]
fn who_asks_for_a_result_waits_for_it_and_who_asks_later_gets_it_at_once() {
    let mut goals = goals(10);
    let ticket = with_status(&mut goals, 1, GoalStatusCode::Executing);
    assert_eq!(goals.ask(id(1), || 1), ResultRequest::Waits(None));
    assert_eq!(goals.ask(id(1), || 2), ResultRequest::Waits(None));
    let told = goals.end(ticket, End::Succeed, result(7), now());
    assert_eq!(told, Ok(vec![1, 2]));
    assert_eq!(goals.ask(id(1), || 3), ResultRequest::Ended(result(7)));
    assert_eq!(goals.ask(id(2), || 4), ResultRequest::Unknown);
}

#[test]
fn of_too_many_who_wait_for_one_result_the_oldest_go() {
    let mut goals = goals(10);
    let ticket = with_status(&mut goals, 1, GoalStatusCode::Executing);
    for who in 0..8 {
        assert_eq!(goals.ask(id(1), || who), ResultRequest::Waits(None));
    }
    assert_eq!(goals.ask(id(1), || 8), ResultRequest::Waits(Some(0)));
    assert_eq!(goals.counters.displaced, 1);
    let told = goals.end(ticket, End::Abort, result(7), now());
    assert_eq!(told, Ok((1..9).collect()));
}

#[test]
fn a_result_is_kept_for_its_time() {
    let mut goals = goals(10);
    let start = now();
    let ticket = with_status(&mut goals, 1, GoalStatusCode::Executing);
    let other = with_status(&mut goals, 2, GoalStatusCode::Executing);
    goals.end(ticket, End::Succeed, result(7), start).unwrap();
    assert!(!goals.expire(start + KEPT));
    assert_eq!(goals.ask(id(1), || 1), ResultRequest::Ended(result(7)));
    assert!(goals.expire(start + KEPT + Duration::from_millis(1)));
    assert_eq!(goals.ask(id(1), || 1), ResultRequest::Unknown);
    assert_eq!(goals.status(ticket), None);
    assert_eq!(goals.status(other), Some(GoalStatusCode::Executing));
    let mut for_ever = ServerGoals::<u8>::new(10, None);
    with_status(&mut for_ever, 1, GoalStatusCode::Succeeded);
    assert!(!for_ever.expire(start + KEPT * 1000));
}

#[test]
fn one_goal_is_cancelled_by_its_id_while_it_runs() {
    for status in all() {
        let mut goals = goals(10);
        let ticket = with_status(&mut goals, 1, status);
        with_status(&mut goals, 2, GoalStatusCode::Executing);
        let found = goals.to_cancel(CancelWhat::Goal(id(1)));
        if matches!(status, GoalStatusCode::Accepted | GoalStatusCode::Executing) {
            let info = GoalInfo {
                id: id(1),
                stamp: stamp(1),
            };
            assert_eq!(found, Ok(vec![(ticket, info)]));
        } else {
            assert_eq!(found, Err(CancelCode::Terminated), "{status:?}");
        }
    }
}

#[test]
fn goals_are_cancelled_by_time_and_all_at_once_in_the_order_they_came() {
    let mut goals = goals(10);
    for number in [5, 2, 3, 4] {
        with_status(&mut goals, number, GoalStatusCode::Executing);
    }
    with_status(&mut goals, 1, GoalStatusCode::Succeeded);
    let found = |what| -> Vec<u8> {
        let found = goals.to_cancel(what).unwrap().into_iter();
        found.map(|(ticket, _)| ticket.id.to_bytes()[0]).collect()
    };
    assert_eq!(found(CancelWhat::All), [5, 2, 3, 4]);
    assert_eq!(found(CancelWhat::Until(stamp(3))), [2, 3]);
    assert_eq!(found(CancelWhat::GoalAndUntil(id(5), stamp(3))), [5, 2, 3]);
    assert_eq!(found(CancelWhat::Until(stamp(1))), [0; 0]);
}

#[test]
fn without_room_what_has_ended_goes_first_and_then_goals_are_refused() {
    let mut goals = goals(2);
    let start = now();
    for number in [1, 2] {
        let ticket = with_status(&mut goals, number, GoalStatusCode::Executing);
        let at = start + Duration::from_secs(u64::from(10 - number));
        goals.end(ticket, End::Abort, result(0), at).unwrap();
    }
    accepted(&mut goals, 3);
    assert_eq!(
        goals.ask(id(2), || 1),
        ResultRequest::Unknown,
        "it ended first"
    );
    accepted(&mut goals, 4);
    assert_eq!(goals.arrive(id(5)), NewGoalDecision::Full);
    assert_eq!((goals.counters.forgotten, goals.counters.refused), (2, 1));
}

#[test]
fn a_goal_that_nobody_decides_about_can_be_aborted() {
    for status in all() {
        let mut goals = goals(10);
        let ticket = with_status(&mut goals, 1, status);
        assert_eq!(goals.abandon(ticket), !status.is_terminal(), "{status:?}");
    }
}

#[derive(Clone, Copy, Debug)]
enum Input {
    Arrive(u8),
    Accept(usize),
    Reject(usize),
    Execute(usize),
    Cancel(usize),
    End(usize, End),
    Ask(u8),
    Wait(u64),
}

fn input() -> impl Strategy<Value = Input> {
    let end = prop::sample::select(vec![End::Succeed, End::Abort, End::Cancel]);
    prop_oneof![
        (0u8..6).prop_map(Input::Arrive),
        (0usize..20).prop_map(Input::Accept),
        (0usize..20).prop_map(Input::Reject),
        (0usize..20).prop_map(Input::Execute),
        (0usize..20).prop_map(Input::Cancel),
        (0usize..20, end).prop_map(|(at, end)| Input::End(at, end)),
        (0u8..6).prop_map(Input::Ask),
        (0u64..8000).prop_map(Input::Wait),
    ]
}

proptest! {
    #[test]
    fn whatever_comes_each_who_waits_is_told_once_and_an_end_stays(
        inputs in prop::collection::vec(input(), 0..120)
    ) {
        let mut time = now();
        let mut goals = ServerGoals::<usize>::new(4, Some(KEPT));
        let mut tickets = Vec::new();
        let mut waiting = std::collections::BTreeSet::new();
        for (step, input) in inputs.into_iter().enumerate() {
            let before: Vec<_> = tickets.iter().map(|ticket| goals.status(*ticket)).collect();
            match input {
                Input::Arrive(number) => {
                    if let NewGoalDecision::New(ticket) = goals.arrive(id(number)) {
                        tickets.push(ticket);
                    }
                }
                Input::Accept(at) => drop(tickets.get(at).map(|one| goals.accept(*one, stamp(1)))),
                Input::Reject(at) => drop(tickets.get(at).map(|one| goals.reject(*one))),
                Input::Execute(at) => drop(tickets.get(at).map(|one| goals.execute(*one))),
                Input::Cancel(at) => drop(tickets.get(at).map(|one| goals.cancel(*one))),
                Input::End(at, end) => {
                    let told = tickets.get(at).map(|one| goals.end(*one, end, result(1), time));
                    for who in told.and_then(Result::ok).unwrap_or_default() {
                        prop_assert!(waiting.remove(&who));
                    }
                }
                Input::Ask(number) => {
                    if let ResultRequest::Waits(displaced) = goals.ask(id(number), || step) {
                        waiting.insert(step);
                        prop_assert!(displaced.is_none_or(|who| waiting.remove(&who)));
                    }
                }
                Input::Wait(millis) => {
                    time += Duration::from_millis(millis);
                    goals.expire(time);
                }
            }
            prop_assert!(goals.goals.len() <= 4);
            let owed: usize = goals.goals.values().map(|goal| match &goal.phase {
                Phase::Open { waiting, .. } => waiting.len(),
                Phase::Offered | Phase::Ended { .. } => 0,
            }).sum();
            prop_assert_eq!(owed, waiting.len(), "nobody who waits is lost");
            for (ticket, old) in tickets.iter().zip(before) {
                let new = goals.status(*ticket);
                prop_assert!(!old.is_some_and(GoalStatusCode::is_terminal) || new.is_none() || new == old);
            }
        }
    }
}
