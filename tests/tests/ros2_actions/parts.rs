//! Servers that are discovered in parts.

use std::time::Duration;

use bytes::Bytes;
use ros2_node::action::{CancelCode, GoalEvent, GoalStatusCode};
use ros2_node::qos::Offered;
use ros2_node::service::{ServiceName, ServiceOptions, ServiceServer, ServiceTypes};
use system_tests::Cell;
use tokio::time::timeout;

use super::{client, done};
use crate::ros2_actions::fibonacci::{ACTION, ActionParticipant, SOON, goal, until};

/// Creates a part of an action server that gives every request the same answer, or none if `answer`
/// is `None`.
fn part(
    ours: &ActionParticipant,
    name: &str,
    types: [&str; 2],
    answer: Option<&'static [u8]>,
) -> ServiceServer {
    let [request, response] = types.map(|one| format!("{one}_"));
    let service = ServiceName {
        name: format!("{ACTION}/_action/{name}"),
        types: ServiceTypes { request, response },
    };
    let options = ServiceOptions::default();
    ServiceServer::open(
        &ours.domain,
        &ours.peers,
        &service,
        options,
        move |_| async move {
            match answer {
                Some(answer) => Ok(Bytes::from_static(answer)),
                None => std::future::pending().await,
            }
        },
    )
    .unwrap()
}

const SEND_GOAL: [&str; 2] = [
    "demo_msgs::action::dds_::Fibonacci_SendGoal_Request",
    "demo_msgs::action::dds_::Fibonacci_SendGoal_Response",
];
const GET_RESULT: [&str; 2] = [
    "demo_msgs::action::dds_::Fibonacci_GetResult_Request",
    "demo_msgs::action::dds_::Fibonacci_GetResult_Response",
];
const CANCEL_GOAL: [&str; 2] = [
    "action_msgs::srv::dds_::CancelGoal_Request",
    "action_msgs::srv::dds_::CancelGoal_Response",
];
/// The response that the goal is accepted, and the time.
const ACCEPTED: &[u8] = &[0, 1, 0, 0, 1, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0];
/// The result with the status Succeeded and the single number 5.
const RESULT: &[u8] = &[0, 1, 0, 0, 4, 0, 0, 0, 1, 0, 0, 0, 5, 0, 0, 0];
/// The response that the goal has ended, with no goals.
const ENDED: &[u8] = &[0, 1, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0];

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn who_accepted_a_goal_is_asked_for_its_result_though_another_is_known_sooner() {
    let Some(_cell) = Cell::with(&[]) else {
        return;
    };
    let (ours, dead, new) = (
        ActionParticipant::join(),
        ActionParticipant::join(),
        ActionParticipant::join(),
    );
    // Like a killed server with a lease that has not ended.
    let silent = [
        part(&dead, "get_result", GET_RESULT, None),
        part(&dead, "cancel_goal", CANCEL_GOAL, None),
    ];
    let topic = |name: &str, of: &str, offered| {
        let topic = format!("rt{ACTION}/_action/{name}");
        new.domain.writer(&topic, of, offered).unwrap()
    };
    let feedback = "demo_msgs::action::dds_::Fibonacci_FeedbackMessage_";
    let status = "action_msgs::msg::dds_::GoalStatusArray_";
    let _feedback = topic("feedback", feedback, Offered::KeepLatest);
    let _status = topic("status", status, Offered::KeepLatest);
    let _sends = part(&new, "send_goal", SEND_GOAL, Some(ACCEPTED));
    let client = client(&ours);
    until("there is a server of each kind", || client.server().is_ok()).await;
    let mut running = client.send_goal(&goal(3));
    let accepted = timeout(SOON, running.recv()).await.unwrap();
    assert!(
        matches!(accepted, Some(GoalEvent::Accepted(_))),
        "{accepted:?}"
    );

    // The client requests the result and a cancellation before the other parts of the server exist.
    let early = timeout(Duration::from_millis(300), running.cancel()).await;
    assert!(early.is_err(), "{early:?}");
    let asked = silent.each_ref().map(|part| part.counters().calls);
    assert_eq!(asked, [0, 0]);
    let _cancels = part(&new, "cancel_goal", CANCEL_GOAL, Some(ENDED));
    let answer = running.cancel().await.unwrap();
    assert_eq!(answer.code, CancelCode::Terminated);
    let _results = part(&new, "get_result", GET_RESULT, Some(RESULT));
    assert_eq!(
        done(&mut running).await,
        (GoalStatusCode::Succeeded, vec![5])
    );
}
