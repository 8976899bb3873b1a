//! The policy of both sides in one process, with graphs that have no network.

mod fakes;
mod space;

use std::time::Duration;

use bridge_core::{AskError, AskErrorKind, AskId, CallRole};
use bytes::Bytes;
use messages::Wire;
use tokio::time::timeout;
use uadp::{StatusCode, Timestamp};

use self::fakes::FakeReport;
use self::space::{SimulatedSpace, offers};
use super::*;
use crate::now;
use crate::services::MayHaveRun;

const NAME: &str = "demo_msgs/Count";
const TEXT: &str = "int32 order\n---\nint32 last\n---\nint32 so_far\n";
const GOAL: &str = "ua_1_2_70";
const ID: GraphGoalId = [9; 16];
const QUICK: &str = "
spaces: [{id: 1}, {id: 2}]
pubsub: {receive_timeout: 300ms, keep_alive_period: 100ms, key_frame_period: 100ms}
";

fn of_goals() -> TopicId {
    GOAL.parse().unwrap()
}

fn number(number: i32) -> Bytes {
    Bytes::copy_from_slice(&number.to_le_bytes())
}

#[tokio::test]
async fn a_goal_goes_to_its_server_and_its_feedback_and_result_come_back() {
    let mut space = SimulatedSpace::offered();
    let (goal, mut heard) = space.running().await;
    assert_eq!((goal.id, &goal.body), (ID, &number(7)));
    for so_far in 1..=3 {
        let feedback = GraphGoalEvent::Feedback(number(so_far));
        goal.say.send(feedback).await.unwrap();
        assert_eq!(
            space.told(&mut heard).await,
            FakeReport::Feedback(number(so_far))
        );
    }
    let ended = GraphGoalEvent::Ended {
        status: 4,
        message: "done".to_owned(),
        result: number(42),
    };
    goal.say.send(ended).await.unwrap();
    let end = FakeReport::Ended(4, "done".to_owned(), Some(number(42)));
    assert_eq!(space.told(&mut heard).await, end);
    // The status is accepted, then succeeded.
    let status = |status: u8| {
        let mut value = vec![16, 0, 0, 0];
        value.extend(ID);
        value.extend([1, 0, 0, 0, status]);
        Bytes::from(value)
    };
    assert_eq!(space.statuses, [status(1), status(4)]);
}

#[tokio::test]
async fn a_goal_that_its_server_does_not_take_is_rejected_with_the_reason() {
    let mut space = SimulatedSpace::offered();
    let mut heard = space.client().await;
    let goal = space.server().await;
    let rejected = GraphGoalEvent::Rejected("too far".to_owned());
    goal.say.send(rejected).await.unwrap();
    let told = space.told(&mut heard).await;
    assert_eq!(told, FakeReport::Rejected("too far".to_owned()));
    // A rejected goal is rejected again.
    let mut heard = space.client().await;
    let FakeReport::Rejected(_) = space.told(&mut heard).await else {
        panic!("a goal that was rejected is rejected again");
    };
}

#[tokio::test]
async fn a_goal_is_cancelled_where_its_server_agrees() {
    let mut space = SimulatedSpace::offered();
    let (goal, mut heard) = space.running().await;
    for code in [1, 0] {
        let agreed = space.cancel().await;
        let cancel = space.cancelled().await;
        assert_eq!(cancel.what, GraphCancelSelection::Goal(ID));
        let goals = vec![ID];
        cancel
            .answer
            .send(Ok(GraphCancelResponse { code, goals }))
            .ok();
        let agreed = space.until(agreed).await.unwrap();
        assert_eq!(agreed, code == 0);
    }
    let ended = GraphGoalEvent::Ended {
        status: 5,
        message: String::new(),
        result: number(3),
    };
    goal.say.send(ended).await.unwrap();
    let end = FakeReport::Ended(5, String::new(), Some(number(3)));
    assert_eq!(space.told(&mut heard).await, end);
    // A request to cancel an ended goal is rejected without asking the server.
    let agreed = space.cancel().await;
    assert!(!space.until(agreed).await.unwrap());
}

#[tokio::test]
async fn a_request_to_cancel_waits_for_a_goal_that_is_on_its_way() {
    let mut space = SimulatedSpace::offered();
    let agreed = space.cancel().await;
    let cancel = space.cancelled().await;
    let unknown = GraphCancelResponse {
        code: 2,
        goals: Vec::new(),
    };
    cancel.answer.send(Ok(unknown)).ok();
    let _goal = space.running().await;
    let cancel = space.cancelled().await;
    let goals = vec![ID];
    cancel
        .answer
        .send(Ok(GraphCancelResponse { code: 0, goals }))
        .ok();
    assert!(space.until(agreed).await.unwrap());
}

#[tokio::test]
async fn a_goal_whose_server_dies_ends_with_the_reason() {
    let mut space = SimulatedSpace::offered();
    let (goal, mut heard) = space.running().await;
    let lost = GraphGoalEvent::Lost {
        text: "the server has left".to_owned(),
        ran: MayHaveRun::Perhaps,
    };
    goal.say.send(lost).await.unwrap();
    let FakeReport::Ended(6, why, None) = space.told(&mut heard).await else {
        panic!("it is aborted");
    };
    assert_eq!(why, "the server has left");
    // The client of a goal that was never sent receives the reason.
    let mut space = SimulatedSpace::offered();
    let mut heard = space.client().await;
    let goal = space.server().await;
    let lost = GraphGoalEvent::Lost {
        text: "no server".to_owned(),
        ran: MayHaveRun::No,
    };
    goal.say.send(lost).await.unwrap();
    let FakeReport::Rejected(why) = space.told(&mut heard).await else {
        panic!("it is rejected");
    };
    assert!(why.starts_with("not executed"), "{why}");
}

#[tokio::test]
async fn a_goal_waits_for_a_server_that_is_started_anew_and_is_rejected_where_none_is() {
    const PATIENT: &str = "spaces: [{id: 1}, {id: 2}]\npubsub: {receive_timeout: 60s}\n";
    let mut space = SimulatedSpace::offered_by(PATIENT);
    space.offering.gone(of_goals(), now().monotonic);
    space.deserted = true;
    let mut heard = space.client().await;
    let pause = tokio::time::sleep(Duration::from_millis(300));
    space.until(pause).await;
    assert!(heard.try_recv().is_err(), "it waits");
    space.deserted = false;
    let events = SimulatedSpace::new(PATIENT).reconcile();
    space.announce(&events);
    let goal = space.server().await;
    let accepted = GraphGoalEvent::Accepted(Timestamp::from_unix_nanos(1_000));
    goal.say.send(accepted).await.unwrap();
    assert_eq!(space.told(&mut heard).await, FakeReport::Accepted);

    for is_gone in [true, false] {
        let mut space = SimulatedSpace::offered();
        space.deserted = true;
        if is_gone {
            space.offering.gone(of_goals(), now().monotonic);
        }
        let mut heard = space.client().await;
        let told = space.told(&mut heard).await;
        assert_eq!(
            told,
            FakeReport::Rejected("not executed: nobody executes it".to_owned())
        );
    }
}

#[tokio::test]
async fn a_goal_goes_on_while_its_action_is_withdrawn_for_a_moment() {
    const PATIENT: &str = "spaces: [{id: 1}, {id: 2}]\npubsub: {receive_timeout: 60s}\n";
    let mut space = SimulatedSpace::offered_by(PATIENT);
    let (goal, mut heard) = space.running().await;
    space.offering.gone(of_goals(), now().monotonic);
    // The request for the result is refused, because the action is not known.
    let asked: Vec<AskId> = space.asked.values().copied().collect();
    for ask in asked {
        let refused = AskError {
            kind: AskErrorKind::Refused,
            status: StatusCode::GOOD,
            text: "nobody executes it".to_owned(),
        };
        space.calls.answered(ask, Err(refused));
    }
    space.deserted = true;
    space
        .until(tokio::time::sleep(Duration::from_millis(300)))
        .await;
    while let Ok(told) = heard.try_recv() {
        assert!(!matches!(told, FakeReport::Ended(..)), "{told:?}");
    }
    space.deserted = false;
    let events = SimulatedSpace::new(PATIENT).reconcile();
    space.announce(&events);
    let ended = GraphGoalEvent::Ended {
        status: 4,
        message: String::new(),
        result: number(3),
    };
    goal.say.send(ended).await.unwrap();
    let end = FakeReport::Ended(4, String::new(), Some(number(3)));
    assert_eq!(space.told(&mut heard).await, end);
}

#[tokio::test]
async fn of_two_cancellations_of_one_moment_a_server_hears_one() {
    let mut space = SimulatedSpace::offered();
    let (goal, mut heard) = space.running().await;
    let first = space.cancel().await;
    let cancel = space.cancelled().await;
    let second = space.cancel().await;
    space.passes(200).await;
    assert!(space.cancels.try_recv().is_err(), "the server hears one");
    let goals = vec![ID];
    cancel
        .answer
        .send(Ok(GraphCancelResponse { code: 0, goals }))
        .ok();
    assert!(space.until(first).await.unwrap());
    assert!(space.until(second).await.unwrap());
    // A further request is answered without asking the server, which would refuse it.
    let third = space.cancel().await;
    assert!(space.until(third).await.unwrap());
    let ended = GraphGoalEvent::Ended {
        status: 5,
        message: String::new(),
        result: number(3),
    };
    goal.say.send(ended).await.unwrap();
    let end = FakeReport::Ended(5, String::new(), Some(number(3)));
    assert_eq!(space.told(&mut heard).await, end);
}

#[tokio::test]
async fn the_goals_of_a_bridge_that_is_gone_are_aborted_and_its_server_withdrawn() {
    let mut space = SimulatedSpace::offered();
    let (_goal, mut heard) = space.running().await;
    // The bridge is silent: requests are not answered any more.
    space.executing = BridgeActions::default();
    space.offering.gone(of_goals(), now().monotonic);
    let end = async {
        loop {
            match heard.recv().await {
                Some(FakeReport::Ended(status, why, None)) => return (status, why),
                Some(_) => {}
                None => panic!("it has an end"),
            }
        }
    };
    // Its open requests fail, as with a silent responder.
    let asked: Vec<AskId> = space.asked.values().copied().collect();
    for ask in asked {
        let silent = AskError {
            kind: AskErrorKind::Unknown,
            status: StatusCode::GOOD,
            text: "the responder is lost".to_owned(),
        };
        space.calls.answered(ask, Err(silent));
    }
    let (status, why) = space.until(end).await;
    assert_eq!(status, 6);
    assert!(why.contains("the executor of the action is lost"), "{why}");
    let [_, policy] = &space.policies;
    space.offering.tidy(policy, now().monotonic);
    assert_eq!(space.served.lock().unwrap().len(), 1);
    let later = now().monotonic + Duration::from_secs(3);
    space.offering.tidy(policy, later);
    assert_eq!(space.offering.offered().len(), 0);
    let events = space.offering.recv().await;
    assert_eq!(events.len(), 5, "{events:?}");
    let withdrawn = async {
        while !space.served.lock().unwrap().is_empty() {
            tokio::task::yield_now().await;
        }
    };
    timeout(Duration::from_secs(5), withdrawn).await.unwrap();
}

#[tokio::test]
async fn a_server_that_goes_is_withdrawn_and_the_ends_of_its_goals_can_still_be_asked_for() {
    let mut space = SimulatedSpace::offered();
    let (goal, _heard) = space.running().await;
    let present = std::mem::take(&mut space.present);
    let events = space.reconcile();
    let withdrawn = |event: &PortEvent| matches!(event, PortEvent::Withdrawn { .. });
    assert!(
        events.len() == 5 && events.iter().all(withdrawn),
        "{events:?}"
    );
    let lost = GraphGoalEvent::Lost {
        text: "it has left".to_owned(),
        ran: MayHaveRun::Perhaps,
    };
    goal.say.send(lost).await.unwrap();
    space.present = present;
    let events = space.reconcile();
    assert_eq!(events.len(), 5, "{events:?}");
    let role =
        offers(&events).find_map(|(topic, offered)| (topic == of_goals()).then_some(offered.role));
    let Some(CallRole::Goal(family)) = role else {
        panic!("{events:?}");
    };
    assert_eq!((family.cancel, family.status), (71, 74));
    let result = executors::beside(of_goals(), family.result).unwrap();
    let asker = space.calls.asker(result);
    let asked = asker.ask(wire::result_request(Wire::Ros1, ID));
    let answer = space.until(asked).await.unwrap();
    let outcome = wire::read_outcome(Wire::Ros1, &answer).unwrap();
    assert_eq!((outcome.status, &outcome.message[..]), (0, "it has left"));
    assert_eq!(outcome.result, number(0));
}

#[tokio::test]
async fn who_executes_chooses_an_id_and_several_may_wait_for_a_result() {
    let mut space = SimulatedSpace::offered();
    let request = wire::join(Wire::Ros1, NO_GOAL, &number(5)).unwrap();
    let asked = space.calls.asker(of_goals()).ask(request);
    let mut sent = std::mem::replace(&mut space.sent, mpsc::channel(1).1);
    let server = async {
        let goal = sent.recv().await.unwrap();
        let accepted = GraphGoalEvent::Accepted(Timestamp::from_unix_nanos(5_000));
        goal.say.send(accepted).await.unwrap();
        goal
    };
    let (goal, answer) = space.until(async { tokio::join!(server, asked) }).await;
    let answer = wire::read_goal_answer(Wire::Ros1, &answer.unwrap()).unwrap();
    assert!(answer.accepted && answer.id != NO_GOAL && answer.id == goal.id);
    assert_eq!(answer.stamp, Timestamp::from_unix_nanos(5_000));
    let result = executors::beside(of_goals(), 72).unwrap();
    let ask = |space: &SimulatedSpace| {
        let asker = space.calls.asker(result);
        asker.ask(wire::result_request(Wire::Ros1, goal.id))
    };
    let (one, two) = (ask(&space), ask(&space));
    let short = space
        .calls
        .asker(result)
        .within(Duration::from_millis(1200))
        .ask(wire::result_request(Wire::Ros1, goal.id));
    // The deadline of the request is close.
    let why = space.until(short).await.unwrap_err();
    assert!(why.starts_with("not executed"), "{why}");
    let ended = GraphGoalEvent::Ended {
        status: 6,
        message: "no way".to_owned(),
        result: number(8),
    };
    goal.say.send(ended).await.unwrap();
    let (one, two) = space.until(async { tokio::join!(one, two) }).await;
    for answer in [one, two] {
        let outcome = wire::read_outcome(Wire::Ros1, &answer.unwrap()).unwrap();
        assert_eq!((outcome.status, outcome.message), (6, "no way".to_owned()));
        assert_eq!(outcome.result, number(8));
    }
    // A request to cancel all goals that were accepted until a time.
    let cancel = executors::beside(of_goals(), 71).unwrap();
    let request = wire::CancelSelection {
        id: NO_GOAL,
        until: Some(Timestamp::from_unix_nanos(9_000)),
    };
    let asked = space.calls.asker(cancel);
    let asked = asked.ask(wire::cancel_request(Wire::Ros1, request));
    let answer = space.until(asked).await.unwrap();
    let answer = wire::read_cancel_answer(Wire::Ros1, &answer).unwrap();
    // No goal is open any more.
    assert_eq!((answer.code, answer.goals.len()), (0, 0));
}

#[tokio::test]
async fn an_action_has_the_name_and_type_of_the_mapping() {
    let mut space = SimulatedSpace::new(
        "
spaces: [{id: 1}, {id: 2}]
namespaces: {2: 'urn:test:cell'}
calls:
  - node: ns=2;i=70
    name: Count
    origin: 1
    ros:
      - {action: /count, type: demo_msgs/Count}
      - {space: 2, action: /arm/count, type: demo_msgs/Count, goal: {order: 3}}
    open: true
",
    );
    space.present = [("/count".to_owned(), NAME.parse().ok())].into();
    let events = space.reconcile();
    let (_, offered) = offers(&events)
        .find(|(topic, _)| topic.triple().2 == 72)
        .unwrap();
    assert_eq!(offered.name, "Count.Result");
    assert!(offered.open && offered.role == CallRole::Result { of: 70 });
    space.announce(&events);
    let [_, policy] = &space.policies;
    assert_eq!(
        space.offering.chosen(policy),
        [(of_goals(), "/arm/count".to_owned())]
    );
    let bound = space.offer();
    assert_eq!(*space.served.lock().unwrap(), ["/arm/count"]);
    let PortEvent::CallBound { map, .. } = &bound[0] else {
        panic!("{bound:?}");
    };
    assert_eq!(map.request.0.len(), 1);
    assert_eq!(map.request.0[0].target, "goal.order");
}

#[tokio::test]
async fn a_variable_of_the_mapping_is_no_value_of_an_action() {
    let variable = "variables: [{node: ns=2;i=73, name: Speed, origin: 1}]\n";
    let mut space = SimulatedSpace::new(&format!("{QUICK}namespaces: {{2: urn:test}}\n{variable}"));
    assert!(space.reconcile().is_empty(), "its feedback would be that");
    // A bridge with another mapping announces the action all the same.
    let events = SimulatedSpace::new(QUICK).reconcile();
    space.announce(&events);
    assert!(space.offer().is_empty());
    let [feedback, status] = [73, 74].map(|id| TopicId::new(1, 2, id).unwrap());
    let policy = &space.policies[1];
    assert!(!space.offering.takes(policy, feedback) && space.offering.takes(policy, status));
    assert!(space.served.lock().unwrap().is_empty());
}

#[tokio::test]
async fn actions_that_would_have_the_same_calls_are_not_both_offered() {
    let mut space = SimulatedSpace::new(QUICK);
    for name in ["/ua_1_2_66", "/ua_1_2_73", "/ua_1_2_75"] {
        space.present.insert(name.to_owned(), NAME.parse().ok());
    }
    let offered = |events: &[PortEvent]| {
        let goals = offers(events).filter(|(_, offered)| matches!(offered.role, CallRole::Goal(_)));
        let mut goals: Vec<u16> = goals.map(|(topic, _)| topic.triple().2).collect();
        goals.sort_unstable();
        goals
    };
    let events = space.reconcile();
    // The first action occupies 66 to 70, so the action at 70 is not offered, and 75 belongs to the
    // action at 73.
    assert_eq!(offered(&events), [66, 73]);
    assert_eq!(space.reconcile().len(), 0);
}

#[tokio::test]
async fn a_goal_that_is_cancelled_before_its_server_decides_is_withdrawn() {
    let mut space = SimulatedSpace::offered();
    let mut heard = space.client().await;
    let goal = space.server().await;
    let agreed = space.cancel().await;
    let cancel = space.cancelled().await;
    assert_eq!(cancel.what, GraphCancelSelection::Goal(ID));
    assert_eq!(space.until(agreed).await, Ok(true));
    let pending = space.executing.pending();
    assert!(
        matches!(&pending[..], [line] if line.contains(&"09".repeat(16))),
        "{pending:?}"
    );
    // Its outcome is unknown, and it is not sent again.
    let told = space.told(&mut heard).await;
    assert!(matches!(told, FakeReport::Rejected(_)), "{told:?}");
    let accepted = GraphGoalEvent::Accepted(Timestamp::from_unix_nanos(1_000));
    goal.say.send(accepted).await.unwrap();
    goal.say.send(GraphGoalEvent::Status(3)).await.unwrap();
    let deadline = now().monotonic + Duration::from_secs(20);
    while !space.executing.pending().is_empty() {
        assert!(now().monotonic < deadline, "it is being cancelled");
        space.until(tokio::task::yield_now()).await;
    }
}
