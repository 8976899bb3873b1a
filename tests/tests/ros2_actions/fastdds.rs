//! Actions with a peer on Fast DDS.

use ros2_node::action::{CancelCode, GoalStatusCode, Outcome};
use serde_json::{Value, json};
use system_tests::{Cell, Peer};

use crate::ros2_actions::fibonacci::{ACTION, ActionParticipant, goal, until};
use crate::ros2_actions::served::{options, serve};
use crate::ros2_actions::{client, done, feedback, outcome, story};

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_fast_dds_ends_our_goals_in_every_way() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let _server = cell.fastdds(&["action-serve", ACTION]);
    let mut reached = client.send_goal(&goal(5));
    let told = story(&mut reached).await;
    assert_eq!(told[0], "accepted");
    assert!(told.iter().any(|one| one == "[1, 1, 2]"), "{told:?}");
    assert_eq!(
        done(&mut reached).await,
        (GoalStatusCode::Succeeded, vec![1, 1, 2, 3, 5])
    );
    let mut aborted = client.send_goal(&goal(-2));
    assert_eq!(done(&mut aborted).await, (GoalStatusCode::Aborted, vec![]));
    let mut rejected = client.send_goal(&goal(-1));
    assert_eq!(outcome(&mut rejected).await, Outcome::Rejected);
    let mut stopped = client.send_goal(&goal(100));
    feedback(&mut stopped, 3).await;
    let answer = stopped.cancel().await.unwrap();
    assert_eq!((answer.code, answer.goals.len()), (CancelCode::None, 1));
    assert_eq!(
        done(&mut stopped).await,
        (GoalStatusCode::Canceled, vec![1, 1, 2])
    );
    let again = stopped.cancel().await.unwrap();
    assert_eq!(again.code, CancelCode::Terminated);
    assert_eq!(client.counters().malformed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_of_fast_dds_sees_its_goals_end_in_every_way() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let serving = serve(&ours, options());
    let orders = ["5", "-2", "-1", "100", "0"].map(|order| ["--order", order]);
    let client = cell.fastdds(&[&["action-call", ACTION], orders.as_flattened()].concat());
    let done = || client.json_lines().iter().any(|line| line["done"] == true);
    until("the client is done", done).await;
    let lines = client.json_lines();
    let with = |key: &str| -> Vec<Value> {
        let lines = lines.iter().filter(|line| line.get(key).is_some());
        lines.cloned().collect()
    };
    let accepted: Vec<_> = with("accepted")
        .iter()
        .map(|line| line["accepted"].clone())
        .collect();
    assert_eq!(json!(accepted), json!([true, true, false, true, true]));
    let ends: Vec<_> = with("status")
        .iter()
        .map(|end| json!([end["order"], end["status"], end["result"], end["feedback"]]))
        .collect();
    let all = [
        json!([5, 4, [1, 1, 2, 3, 5], [1, 1, 2, 3, 5]]),
        json!([-2, 6, [], []]),
        json!([100, 5, [1, 1, 2], [1, 1, 2]]),
        json!([0, 4, [], []]),
    ];
    assert_eq!(ends, all);
    assert_eq!(with("cancel"), [json!({"cancel": 0, "goals": 1})]);
    // The status topic also reported each end.
    assert!(with("status").iter().all(|end| end["told"] == true));
    assert_eq!(serving.counters(), Default::default());
}
