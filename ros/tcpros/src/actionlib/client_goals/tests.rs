//! The rules of a client's goals, with time as a parameter.

use proptest::prelude::*;

use super::*;
use crate::clock;
use crate::header::ConnectionHeader;

const SECOND: Duration = Duration::from_secs(1);
const LIMITS: GoalLimits = GoalLimits {
    acknowledge: Duration::from_secs(5),
    silence: Duration::from_secs(5),
    reconnect: SECOND,
    result: Duration::from_secs(5),
    feedback_grace: Duration::ZERO,
    feedback_messages: 2,
    feedback_bytes: 1000,
};

fn entry(id: &str, status: ActionlibStatus) -> StatusEntry {
    StatusEntry {
        id: id.to_owned(),
        code: status.code(),
        text: format!("{status:?}"),
    }
}

fn peer() -> Arc<ConnectionPeer> {
    Arc::new(ConnectionPeer {
        caller_id: "/server".to_owned(),
        header: ConnectionHeader::default(),
    })
}

/// Returns goals with a goal `g` sent at `start`, and a connected server.
fn sent() -> (ActionlibClientGoals, Instant) {
    let start = clock::now();
    let mut goals = ActionlibClientGoals::new(LIMITS);
    for topic in [
        ServerTopic::Status,
        ServerTopic::Feedback,
        ServerTopic::Result,
    ] {
        goals.connection("/server", topic, true, start);
    }
    goals.sent("g".to_owned(), start, Arc::default());
    (goals, start)
}

fn status(goals: &mut ActionlibClientGoals, status: ActionlibStatus, now: Instant) {
    goals.status("/server", &[entry("g", status)], now);
}

fn states(goals: &mut ActionlibClientGoals) -> Vec<CommState> {
    let mut states = Vec::new();
    while let Some(event) = goals.next_event("g") {
        match event {
            ActionlibGoalEvent::State(state) => states.push(state),
            ActionlibGoalEvent::Done(_) => states.push(CommState::Done),
            ActionlibGoalEvent::Lost(_) => states.push(CommState::Lost),
            ActionlibGoalEvent::Feedback(_) | ActionlibGoalEvent::FeedbackDropped(_) => {}
        }
    }
    states
}

fn lost(goals: &ActionlibClientGoals) -> Option<GoalLoss> {
    goals.goal("g")?.outcome.clone()?.err()
}

#[test]
fn a_goal_goes_through_its_states_to_its_result() {
    let (mut goals, now) = sent();
    for step in [
        ActionlibStatus::Pending,
        ActionlibStatus::Active,
        ActionlibStatus::Active,
        ActionlibStatus::Succeeded,
    ] {
        status(&mut goals, step, now);
    }
    let body = Bytes::from_static(b"r");
    goals.result(&entry("g", ActionlibStatus::Succeeded), body, peer(), now);
    use CommState as C;
    assert_eq!(
        states(&mut goals),
        [C::Pending, C::Active, C::WaitingForResult, C::Done]
    );
    let result = goals.goal("g").unwrap().outcome.clone().unwrap().unwrap();
    assert_eq!(
        (result.status, &*result.body),
        (ActionlibStatus::Succeeded, b"r".as_slice())
    );
    assert_eq!(result.text, "Succeeded");
}

#[test]
fn a_result_that_overtakes_its_status_passes_the_states_between() {
    let (mut goals, now) = sent();
    goals.result(
        &entry("g", ActionlibStatus::Preempted),
        Bytes::new(),
        peer(),
        now,
    );
    status(&mut goals, ActionlibStatus::Preempted, now);
    use CommState as C;
    assert_eq!(
        states(&mut goals),
        [C::Active, C::Preempting, C::WaitingForResult, C::Done]
    );
}

#[test]
fn what_comes_after_the_end_changes_nothing_and_is_counted() {
    let (mut goals, now) = sent();
    for end in [ActionlibStatus::Aborted, ActionlibStatus::Succeeded] {
        let body = Bytes::new();
        goals.feedback("g", Feedback { body, peer: peer() });
        goals.result(&entry("g", end), Bytes::new(), peer(), now);
    }
    assert_eq!(goals.goal("g").unwrap().status, ActionlibStatus::Aborted);
    let counted = (goals.counters.late_results, goals.counters.late_feedback);
    assert_eq!(counted, (1, 1));
}

#[test]
fn feedback_that_its_result_overtakes_is_told_before_it() {
    let grace = Duration::from_millis(10);
    for lost in [false, true] {
        let (mut goals, now) = sent();
        goals.limits.feedback_grace = grace;
        status(&mut goals, ActionlibStatus::Active, now);
        goals.result(
            &entry("g", ActionlibStatus::Succeeded),
            Bytes::new(),
            peer(),
            now,
        );
        let body = Bytes::from_static(b"f");
        goals.feedback("g", Feedback { body, peer: peer() });
        assert_eq!(goals.deadline(), Some(now + grace));
        goals.expire(now + grace - Duration::from_millis(1));
        assert!(goals.goal("g").unwrap().outcome.is_none());
        if lost {
            goals.lose("g", GoalLoss::NotAcknowledged(grace));
        } else {
            goals.expire(now + grace);
        }
        let events = std::iter::from_fn(|| goals.next_event("g"));
        let told: Vec<bool> = events
            .filter_map(|event| match event {
                ActionlibGoalEvent::Feedback(_) => Some(false),
                ActionlibGoalEvent::Done(_) => Some(true),
                ActionlibGoalEvent::State(_)
                | ActionlibGoalEvent::FeedbackDropped(_)
                | ActionlibGoalEvent::Lost(_) => None,
            })
            .collect();
        assert_eq!(told, [false, true]);
    }
}

#[test]
fn a_result_that_says_active_ends_the_goal_as_lost_with_its_body() {
    let (mut goals, now) = sent();
    goals.result(
        &entry("g", ActionlibStatus::Active),
        Bytes::from_static(b"r"),
        peer(),
        now,
    );
    let result = goals.goal("g").unwrap().outcome.clone().unwrap().unwrap();
    assert_eq!(
        (result.status, result.body.len()),
        (ActionlibStatus::Lost, 1)
    );
    assert_eq!(goals.counters.invalid_transitions, 1);
}

#[test]
fn a_goal_that_no_server_lists_is_lost_after_its_time_and_not_before() {
    let (mut goals, start) = sent();
    goals.status("/server", &[], start + 4 * SECOND);
    assert_eq!(goals.deadline(), Some(start + 5 * SECOND));
    goals.expire(start + 5 * SECOND - Duration::from_millis(1));
    assert_eq!(lost(&goals), None);
    goals.expire(start + 5 * SECOND);
    assert_eq!(lost(&goals), Some(GoalLoss::NotAcknowledged(5 * SECOND)));
    assert_eq!(goals.deadline(), None);
}

#[test]
fn a_goal_that_was_listed_and_is_missing_is_lost_at_once() {
    let (mut goals, now) = sent();
    status(&mut goals, ActionlibStatus::Active, now);
    goals.status("/other", &[], now);
    assert_eq!(lost(&goals), None);
    goals.status(
        "/server",
        &[entry("of another client", ActionlibStatus::Active)],
        now,
    );
    assert!(matches!(lost(&goals), Some(GoalLoss::Forgotten { .. })));
}

#[test]
fn cancelling_before_the_first_status_does_not_lose_the_goal() {
    let (mut goals, now) = sent();
    assert!(goals.cancel("g"));
    goals.status("/server", &[], now);
    assert_eq!(lost(&goals), None);
    status(&mut goals, ActionlibStatus::Active, now);
    assert_eq!(
        goals.goal("g").unwrap().state,
        CommState::WaitingForCancelAck
    );
    status(&mut goals, ActionlibStatus::Preempting, now);
    assert!(!goals.cancel("g"), "the server knows");
}

#[test]
fn a_silent_server_loses_its_goals_and_one_that_speaks_does_not() {
    let (mut goals, start) = sent();
    for second in 0..20 {
        status(&mut goals, ActionlibStatus::Active, start + second * SECOND);
        goals.expire(start + second * SECOND);
    }
    assert_eq!(lost(&goals), None);
    goals.expire(start + 24 * SECOND);
    assert!(matches!(lost(&goals), Some(GoalLoss::Silent { server, .. }) if server == "/server"));
}

#[test]
fn a_connection_that_comes_back_in_time_loses_nothing() {
    let (mut goals, now) = sent();
    status(&mut goals, ActionlibStatus::Active, now);
    goals.connection("/server", ServerTopic::Status, false, now);
    assert_eq!(goals.deadline(), Some(now + SECOND));
    goals.connection("/server", ServerTopic::Status, true, now);
    goals.expire(now + SECOND);
    assert_eq!(lost(&goals), None);
    for topic in [
        ServerTopic::Status,
        ServerTopic::Feedback,
        ServerTopic::Result,
    ] {
        goals.connection("/server", topic, false, now);
    }
    goals.expire(now + SECOND);
    assert!(matches!(lost(&goals), Some(GoalLoss::Disconnected { .. })));
    assert_eq!(goals.servers.len(), 0);
}

#[test]
fn an_end_without_its_result_is_lost_even_when_the_server_forgets_the_goal() {
    let (mut goals, start) = sent();
    status(&mut goals, ActionlibStatus::Succeeded, start);
    for second in 0..5 {
        goals.status("/server", &[], start + second * SECOND);
    }
    goals.expire(start + 4 * SECOND);
    assert_eq!(lost(&goals), None);
    goals.expire(start + 5 * SECOND);
    let status = ActionlibStatus::Succeeded;
    let waited = 5 * SECOND;
    assert_eq!(lost(&goals), Some(GoalLoss::NoResult { status, waited }));
}

#[test]
fn feedback_gives_way_to_newer_and_never_a_result_or_a_state() {
    let (mut goals, now) = sent();
    status(&mut goals, ActionlibStatus::Active, now);
    for n in 0..5u8 {
        let body = Bytes::from(vec![n]);
        goals.feedback("g", Feedback { body, peer: peer() });
    }
    goals.result(
        &entry("g", ActionlibStatus::Succeeded),
        Bytes::new(),
        peer(),
        now,
    );
    let mut seen = Vec::new();
    while let Some(event) = goals.next_event("g") {
        seen.push(match event {
            ActionlibGoalEvent::State(state) => format!("{state:?}"),
            ActionlibGoalEvent::Feedback(feedback) => format!("{}", feedback.body[0]),
            ActionlibGoalEvent::FeedbackDropped(lost) => format!("-{lost}"),
            ActionlibGoalEvent::Done(_) => "Done".to_owned(),
            ActionlibGoalEvent::Lost(_) => "Lost".to_owned(),
        });
    }
    assert_eq!(seen, ["-3", "Active", "3", "4", "WaitingForResult", "Done"]);
    assert_eq!(goals.counters.feedback_dropped, 3);
}

#[test]
fn a_server_is_ready_with_all_three_topics_and_a_status() {
    let now = clock::now();
    let mut goals = ActionlibClientGoals::new(LIMITS);
    goals.connection("/server", ServerTopic::Status, true, now);
    assert!(goals.ready_server(now).unwrap_err().contains("status"));
    goals.status("/server", &[], now);
    assert!(goals.ready_server(now).unwrap_err().contains("feedback"));
    goals.connection("/server", ServerTopic::Feedback, true, now);
    goals.connection("/other", ServerTopic::Result, true, now);
    assert!(goals.ready_server(now).unwrap_err().contains("result"));
    goals.connection("/server", ServerTopic::Result, true, now);
    goals.status("/server", &[], now + STATUS_AFTER);
    assert_eq!(goals.ready_server(now + STATUS_AFTER), Ok("/server"));
}

#[test]
fn a_server_is_not_ready_before_it_uses_its_connections() {
    let now = clock::now();
    let mut goals = ActionlibClientGoals::new(LIMITS);
    for topic in [
        ServerTopic::Status,
        ServerTopic::Feedback,
        ServerTopic::Result,
    ] {
        goals.connection("/server", topic, true, now);
    }
    // The latched status, which may have been sent before the other connections were made.
    goals.status("/server", &[], now);
    let soon = now + STATUS_AFTER;
    assert!(goals.ready_server(soon).unwrap_err().contains("status"));
    goals.status("/server", &[], soon);
    assert_eq!(goals.ready_server(soon), Ok("/server"));
    goals.connection("/server", ServerTopic::Result, false, soon);
    goals.connection("/server", ServerTopic::Result, true, soon);
    assert!(goals.ready_server(soon).unwrap_err().contains("status"));
    // A server that sends its status on change only.
    assert_eq!(goals.ready_server(soon + SETTLES_WITHIN), Ok("/server"));
}

/// Possible inputs, for a goal of this client or of another client.
#[derive(Clone, Copy, Debug)]
enum Input {
    Status(u8, bool),
    Result(u8, bool),
    Feedback,
    Cancel,
    Connection(bool),
    Wait(u64),
}

fn input() -> impl Strategy<Value = Input> {
    prop_oneof![
        (0u8..12, any::<bool>()).prop_map(|(code, ours)| Input::Status(code, ours)),
        (0u8..12, any::<bool>()).prop_map(|(code, ours)| Input::Result(code, ours)),
        Just(Input::Feedback),
        Just(Input::Cancel),
        any::<bool>().prop_map(Input::Connection),
        (0u64..3000).prop_map(Input::Wait),
    ]
}

fn feed(goals: &mut ActionlibClientGoals, input: Input, now: Instant) {
    let entry = |code, ours: bool| StatusEntry {
        id: if ours { "g" } else { "other" }.to_owned(),
        code,
        text: String::new(),
    };
    match input {
        Input::Status(code, ours) => goals.status("/server", &[entry(code, ours)], now),
        Input::Result(code, ours) => goals.result(&entry(code, ours), Bytes::new(), peer(), now),
        Input::Feedback => goals.feedback(
            "g",
            Feedback {
                body: Bytes::from_static(b"f"),
                peer: peer(),
            },
        ),
        Input::Cancel => drop(goals.cancel("g")),
        Input::Connection(made) => goals.connection("/server", ServerTopic::Status, made, now),
        Input::Wait(_) => {}
    }
}

proptest! {
    #[test]
    fn whatever_comes_a_goal_enters_each_state_once_and_ends_with_one_last_event(
        inputs in prop::collection::vec(input(), 0..60)
    ) {
        let (mut goals, mut now) = sent();
        for input in inputs {
            if let Input::Wait(millis) = input {
                now += Duration::from_millis(millis);
            }
            feed(&mut goals, input, now);
            goals.expire(now);
            let queue = &goals.goal("g").unwrap().events;
            prop_assert!(queue.len() <= 7 + LIMITS.feedback_messages);
            let ended = goals.goal("g").unwrap().state.is_end();
            prop_assert_eq!(goals.deadline().is_none(), ended);
        }
        // Time alone ends the goal.
        goals.expire(now + 6 * SECOND);
        prop_assert!(goals.goal("g").unwrap().outcome.is_some());
        let states = states(&mut goals);
        let unique: std::collections::HashSet<_> = states.iter().collect();
        prop_assert_eq!(unique.len(), states.len());
        let ends = states.iter().filter(|state| state.is_end()).count();
        prop_assert_eq!(ends, 1);
        prop_assert!(states.last().unwrap().is_end());
    }
}
