use super::*;

const fn id(number: u8) -> GoalId {
    GoalId::from_bytes([number; 16])
}

const STAMP: Ros2Time = Ros2Time { sec: 3, nanosec: 0 };

fn now() -> Instant {
    Instant::now()
}

fn body(number: u8) -> Bytes {
    Bytes::from(vec![0, 1, 0, 0, number])
}

fn done(status: GoalStatusCode) -> Outcome {
    Outcome::Done {
        status,
        result: body(9),
    }
}

/// Returns goals 1 and 2, which were just sent.
fn sent() -> ClientGoals {
    let mut goals = ClientGoals::new(ClientGoalLimits {
        goals: 2,
        feedback_messages: 3,
        feedback_bytes: 1000,
    });
    for number in [1, 2] {
        goals.sent(id(number), Arc::default());
    }
    goals
}

fn events(goals: &mut ClientGoals, number: u8) -> Vec<GoalEvent> {
    std::iter::from_fn(|| goals.next_event(id(number))).collect()
}

#[test]
fn a_goal_is_accepted_and_goes_on_to_its_end() {
    let mut goals = sent();
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Unknown);
    goals.accepted(id(1), STAMP, now());
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Accepted);
    goals.status(id(1), (GoalStatusCode::Executing, STAMP), now());
    goals.feedback(id(1), body(1));
    goals.status(id(1), (GoalStatusCode::Canceling, STAMP), now());
    let _is_left = goals.end(id(1), done(GoalStatusCode::Canceled));
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::Status(GoalStatusCode::Executing),
            GoalEvent::Feedback(body(1)),
            GoalEvent::Status(GoalStatusCode::Canceling),
            GoalEvent::Ended(done(GoalStatusCode::Canceled)),
        ]
    );
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Canceled);
    assert_eq!(goals.outcome(id(1)), Some(&done(GoalStatusCode::Canceled)));
    assert_eq!(events(&mut goals, 2), []);
}

#[test]
fn what_comes_before_the_acceptance_is_told_after_it() {
    let mut goals = sent();
    goals.feedback(id(1), body(1));
    assert_eq!(events(&mut goals, 1), []);
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Unknown);
    // The status implies the acceptance too; the reply to the goal may be lost.
    goals.status(id(1), (GoalStatusCode::Executing, STAMP), now());
    goals.accepted(id(1), STAMP, now());
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::Feedback(body(1)),
            GoalEvent::Status(GoalStatusCode::Executing),
        ]
    );
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Executing);
}

#[test]
fn of_a_rejected_goal_nothing_else_is_told() {
    let mut goals = sent();
    goals.feedback(id(1), body(1));
    let _is_left = goals.end(id(1), Outcome::Rejected);
    goals.accepted(id(1), STAMP, now());
    assert_eq!(events(&mut goals, 1), [GoalEvent::Ended(Outcome::Rejected)]);
}

#[test]
fn an_old_status_changes_nothing() {
    let mut goals = sent();
    goals.accepted(id(1), STAMP, now());
    goals.status(id(1), (GoalStatusCode::Canceling, STAMP), now());
    goals.status(id(1), (GoalStatusCode::Executing, STAMP), now());
    goals.status(id(1), (GoalStatusCode::Canceling, STAMP), now());
    goals.status(id(1), (GoalStatusCode::Succeeded, STAMP), now());
    goals.status(id(1), (GoalStatusCode::Canceled, STAMP), now());
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::Status(GoalStatusCode::Canceling)
        ],
        "an end is told with the result"
    );
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Succeeded);
    let _is_left = goals.end(id(1), done(GoalStatusCode::Aborted));
    assert_eq!(goals.known_status(id(1)), GoalStatusCode::Aborted);
}

#[test]
fn feedback_for_others_and_after_the_end_is_counted_and_not_told() {
    let mut goals = sent();
    goals.feedback(id(7), body(1));
    goals.accepted(id(1), STAMP, now());
    let _is_left = goals.end(id(1), done(GoalStatusCode::Succeeded));
    goals.feedback(id(1), body(1));
    assert_eq!(goals.counters.others_feedback, 2);
    assert_eq!(events(&mut goals, 1).len(), 2);
}

#[test]
fn of_too_much_feedback_the_oldest_goes_and_is_told_as_a_number() {
    let mut goals = sent();
    for number in 0..5 {
        goals.feedback(id(1), body(number));
    }
    goals.accepted(id(1), STAMP, now());
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::FeedbackDropped(2),
            GoalEvent::Feedback(body(2)),
            GoalEvent::Feedback(body(3)),
            GoalEvent::Feedback(body(4)),
        ]
    );
    goals.feedback(id(1), body(5));
    goals.feedback(id(1), Bytes::from(vec![0; 2000]));
    assert_eq!(goals.counters.feedback_dropped, 3);
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::FeedbackDropped(1),
            GoalEvent::Feedback(Bytes::from(vec![0; 2000])),
        ],
        "the newest is kept whatever its size"
    );
}

#[test]
fn of_more_goals_than_allowed_the_next_is_lost_until_one_has_ended() {
    let mut goals = sent();
    goals.sent(id(3), Arc::default());
    let busy = Outcome::Lost(LostReason::Busy(2));
    assert_eq!(events(&mut goals, 3), [GoalEvent::Ended(busy)]);
    let _is_left = goals.end(id(1), Outcome::Rejected);
    goals.sent(id(4), Arc::default());
    assert_eq!(goals.outcome(id(4)), None);
}

#[test]
fn goals_are_lost_together_but_for_those_that_have_ended() {
    let mut goals = sent();
    goals.accepted(id(1), STAMP, now());
    let _is_left = goals.end(id(1), done(GoalStatusCode::Succeeded));
    goals.end_all(&Outcome::Lost(LostReason::ClientClosed));
    assert_eq!(goals.outcome(id(1)), Some(&done(GoalStatusCode::Succeeded)));
    assert_eq!(
        events(&mut goals, 2),
        [GoalEvent::Ended(Outcome::Lost(LostReason::ClientClosed))]
    );
}

#[test]
fn a_goal_that_is_withdrawn_is_to_be_cancelled_once_it_is_accepted() {
    for by_status in [false, true] {
        let mut goals = sent();
        let start = now();
        assert_eq!(goals.undecided(), [id(1), id(2)]);
        assert!(goals.withdraw(id(1), start));
        assert!(goals.is_withdrawn(id(1)) && !goals.is_withdrawn(id(2)));
        assert_eq!(goals.cancel_due(id(1)), None);
        let late = start + Duration::from_secs(3);
        if by_status {
            goals.status(id(1), (GoalStatusCode::Accepted, STAMP), late)
        } else {
            goals.accepted(id(1), STAMP, late)
        }
        assert_eq!(goals.cancel_due(id(1)), Some(late));
        assert!(goals.is_accepted(id(1)) && goals.undecided() == [id(2)]);
        assert_eq!(goals.pending(late), [(id(1), late - start)]);
        assert!(
            !goals.withdraw(id(1), late),
            "it is asked to cancel at once"
        );
        assert!(goals.withdrawal(id(1)).unwrap().take_due(late));
        goals.cancel_answered(id(1), Some(CancelCode::Rejected), late);
        assert_eq!(
            events(&mut goals, 1),
            [GoalEvent::Accepted(STAMP), GoalEvent::CancelRefused]
        );
    }
}

#[test]
fn a_goal_that_is_not_decided_about_in_time_is_withdrawn_and_told_so() {
    let mut goals = sent();
    let limit = Duration::from_secs(1);
    goals.overdue(id(1), limit, now());
    assert_eq!(events(&mut goals, 1), [GoalEvent::Overdue(limit)]);
    assert!(goals.is_withdrawn(id(1)));
    let _is_left = goals.end(id(1), Outcome::Rejected);
    assert_eq!(events(&mut goals, 1), [GoalEvent::Ended(Outcome::Rejected)]);
    // A goal with a decision is not overdue.
    goals.accepted(id(2), STAMP, now());
    goals.overdue(id(2), limit, now());
    assert_eq!(events(&mut goals, 2), [GoalEvent::Accepted(STAMP)]);
}

#[test]
fn a_withdrawn_goal_is_kept_until_its_end_when_nobody_holds_it() {
    let mut goals = sent();
    assert!(goals.forget(id(2)));
    assert!(!goals.is_held(id(2)));
    goals.withdraw(id(1), now());
    assert!(!goals.forget(id(1)));
    goals.accepted(id(1), STAMP, now());
    assert!(goals.cancel_due(id(1)).is_some());
    assert!(goals.end(id(1), done(GoalStatusCode::Canceled)));
    assert!(!goals.is_held(id(1)));
}
