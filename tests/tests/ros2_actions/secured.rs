//! Actions with DDS Security on both sides.

use ros2_node::action::{CancelCode, GoalStatusCode, Outcome};
use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::security::Enclave;
use ros2_node::service::ServicePeers;
use serde_json::json;
use system_tests::{Cell, Keystore, Peer};

use crate::ros2_actions::fibonacci::{ACTION, ActionParticipant, goal, until};
use crate::ros2_actions::served::{options, serve};
use crate::ros2_actions::{client, done, feedback, outcome, story};

fn join(keystore: &Keystore) -> ActionParticipant {
    let domain = Domain::join(&DomainOptions {
        domain: 2,
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node: "actions".into(),
        enclave: Some(Enclave {
            name: "/bridge".into(),
            folder: keystore.enclave("bridge"),
        }),
    })
    .unwrap();
    ActionParticipant {
        peers: ServicePeers::new(&domain),
        domain,
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_secured_server_ends_our_goals_in_every_way() {
    let Some(cell) = Cell::secured(&[Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let ours = join(&keystore);
    let client = client(&ours);
    let _server = cell
        .secured_fastdds(&keystore, &["action-serve", ACTION])
        .start();
    let mut reached = client.send_goal(&goal(5));
    let told = story(&mut reached).await;
    assert_eq!(told[0], "accepted");
    assert!(told.iter().any(|one| one == "[1, 1, 2]"), "{told:?}");
    let fifth = (GoalStatusCode::Succeeded, vec![1, 1, 2, 3, 5]);
    assert_eq!(done(&mut reached).await, fifth);
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
    assert_eq!(client.counters().malformed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_secured_client_sees_its_goals_end_in_every_way() {
    let Some(cell) = Cell::secured(&[Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let ours = join(&keystore);
    let serving = serve(&ours, options());
    let orders = ["5", "-1", "100"].map(|order| ["--order", order]);
    let client = cell
        .secured_fastdds(
            &keystore,
            &[&["action-call", ACTION], orders.as_flattened()].concat(),
        )
        .start();
    let done = || client.json_lines().iter().any(|line| line["done"] == true);
    until("the client is done", done).await;
    let lines = client.json_lines();
    let ends: Vec<_> = lines
        .iter()
        .filter(|line| line.get("status").is_some())
        .map(|end| json!([end["order"], end["status"], end["result"], end["feedback"]]))
        .collect();
    let all = [
        json!([5, 4, [1, 1, 2, 3, 5], [1, 1, 2, 3, 5]]),
        json!([100, 5, [1, 1, 2], [1, 1, 2]]),
    ];
    assert_eq!(ends, all);
    assert_eq!(serving.counters(), Default::default());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn secured_ends_of_cyclone_serve_our_goals_and_send_theirs() {
    let Some(cell) = Cell::secured(&[Peer::CycloneC]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let ours = join(&keystore);
    let client = client(&ours);
    let server = cell
        .secured_cyclone(&keystore, &["action-serve", ACTION])
        .start();
    let mut reached = client.send_goal(&goal(5));
    let told = story(&mut reached).await;
    assert_eq!(told[0], "accepted");
    let fifth = (GoalStatusCode::Succeeded, vec![1, 1, 2, 3, 5]);
    assert_eq!(done(&mut reached).await, fifth);
    let mut rejected = client.send_goal(&goal(-1));
    assert_eq!(outcome(&mut rejected).await, Outcome::Rejected);
    assert_eq!(client.counters().malformed, 0);
    drop((client, server));

    let serving = serve(&ours, options());
    let client = cell
        .secured_cyclone(&keystore, &["action-call", ACTION, "--order", "5"])
        .start();
    let told = |key: &str| -> Vec<serde_json::Value> {
        let lines = client.json_lines();
        lines
            .iter()
            .filter_map(|line| line.get(key).cloned())
            .collect()
    };
    until("the goal ends", || !told("status").is_empty()).await;
    assert_eq!(told("status"), [4]);
    assert_eq!(told("result"), [json!([1, 1, 2, 3, 5])]);
    until("all feedback comes", || told("feedback").len() == 5).await;
    assert_eq!(told("feedback"), [1, 2, 3, 4, 5]);
    assert_eq!(serving.counters(), Default::default());
}
