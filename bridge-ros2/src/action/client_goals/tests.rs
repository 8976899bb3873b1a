use super::*;

const fn id(number: u8) -> GoalId {
    GoalId::from_bytes([number; 16])
}

const STAMP: RosTime = RosTime { sec: 3, nanosec: 0 };

fn body(number: u8) -> Bytes {
    Bytes::from(vec![0, 1, 0, 0, number])
}

fn done(status: Status) -> Outcome {
    Outcome::Done {
        status,
        result: body(9),
    }
}

/// Goals 1 and 2, just sent.
fn sent() -> ClientGoals {
    let mut goals = ClientGoals::new(Limits {
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
    assert_eq!(goals.known_status(id(1)), Status::Unknown);
    goals.accepted(id(1), STAMP);
    assert_eq!(goals.known_status(id(1)), Status::Accepted);
    goals.status(id(1), Status::Executing);
    goals.feedback(id(1), body(1));
    goals.status(id(1), Status::Canceling);
    goals.end(id(1), done(Status::Canceled));
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::Status(Status::Executing),
            GoalEvent::Feedback(body(1)),
            GoalEvent::Status(Status::Canceling),
            GoalEvent::Ended(done(Status::Canceled)),
        ]
    );
    assert_eq!(goals.known_status(id(1)), Status::Canceled);
    assert_eq!(goals.outcome(id(1)), Some(&done(Status::Canceled)));
    assert_eq!(events(&mut goals, 2), []);
}

#[test]
fn what_comes_before_the_answer_is_told_after_it() {
    let mut goals = sent();
    goals.feedback(id(1), body(1));
    goals.status(id(1), Status::Executing);
    assert_eq!(events(&mut goals, 1), []);
    assert_eq!(goals.known_status(id(1)), Status::Unknown);
    goals.accepted(id(1), STAMP);
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::Feedback(body(1)),
            GoalEvent::Status(Status::Executing),
        ]
    );
    assert_eq!(goals.known_status(id(1)), Status::Executing);
}

#[test]
fn of_a_rejected_goal_nothing_else_is_told() {
    let mut goals = sent();
    goals.feedback(id(1), body(1));
    goals.end(id(1), Outcome::Rejected);
    goals.accepted(id(1), STAMP);
    assert_eq!(events(&mut goals, 1), [GoalEvent::Ended(Outcome::Rejected)]);
}

#[test]
fn an_old_status_changes_nothing() {
    let mut goals = sent();
    goals.accepted(id(1), STAMP);
    goals.status(id(1), Status::Canceling);
    goals.status(id(1), Status::Executing);
    goals.status(id(1), Status::Canceling);
    goals.status(id(1), Status::Succeeded);
    goals.status(id(1), Status::Canceled);
    assert_eq!(
        events(&mut goals, 1),
        [
            GoalEvent::Accepted(STAMP),
            GoalEvent::Status(Status::Canceling)
        ],
        "an end is told with the result"
    );
    assert_eq!(goals.known_status(id(1)), Status::Succeeded);
    goals.end(id(1), done(Status::Aborted));
    assert_eq!(goals.known_status(id(1)), Status::Aborted);
}

#[test]
fn feedback_for_others_and_after_the_end_is_counted_and_not_told() {
    let mut goals = sent();
    goals.feedback(id(7), body(1));
    goals.accepted(id(1), STAMP);
    goals.end(id(1), done(Status::Succeeded));
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
    goals.accepted(id(1), STAMP);
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
    goals.end(id(1), Outcome::Rejected);
    goals.sent(id(4), Arc::default());
    assert_eq!(goals.outcome(id(4)), None);
}

#[test]
fn goals_are_lost_together_but_for_those_that_have_ended() {
    let mut goals = sent();
    goals.accepted(id(1), STAMP);
    goals.end(id(1), done(Status::Succeeded));
    goals.end_all(&Outcome::Lost(LostReason::ClientClosed));
    assert_eq!(goals.outcome(id(1)), Some(&done(Status::Succeeded)));
    assert_eq!(
        events(&mut goals, 2),
        [GoalEvent::Ended(Outcome::Lost(LostReason::ClientClosed))]
    );
}
