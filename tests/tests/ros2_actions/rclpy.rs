//! Actions with ROS 2 itself: rclpy over rcl_action and Fast DDS, of each distribution.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::Duration;

use messages::{Dialect, TypeName, TypeRegistry};
use nix::sys::signal::Signal;
use ros2_node::action::{
    ActionClient, ActionName, ActionServerOptions, CancelCode, CancelWhat, GoalId, GoalStatusCode,
    LostReason, Outcome,
};
use ros2_node::domain::can_announce_type_hashes;
use ros2_node::service::ServiceError;
use serde_json::{Value, json};
use system_tests::{Cell, Child, Distribution, Peer, StartedChild};
use tokio::time::timeout;

use crate::ros2_actions::fibonacci::{ACTION, ActionParticipant, DEFINITION, SOON, goal, until};
use crate::ros2_actions::served::{of, options, said, serve_as};
use crate::ros2_actions::{client_of, done, feedback, outcome, story};

const SCRIPT: &str = "ros2_rclpy_action.py";
/// An action of rclpy with nested messages.
const NESTED: &str = "/nested";

fn type_name(name: &str) -> TypeName {
    format!("test_msgs/{name}").parse().unwrap()
}

/// Returns the action with the type hashes that the domain announces.
fn fibonacci(ours: &ActionParticipant) -> ActionName {
    announced(
        ours,
        ACTION,
        "Fibonacci",
        DEFINITION,
        TypeRegistry::bundle(Dialect::Ros2),
    )
}

fn announced(
    ours: &ActionParticipant,
    name: &str,
    kind: &str,
    text: &str,
    mut registry: TypeRegistry,
) -> ActionName {
    let kind = type_name(kind);
    registry.add_action(&kind, text).unwrap();
    let action = ActionName::new(name, &kind);
    action.announce(
        &ours.domain,
        &registry.action_type_hashes(&kind, text).unwrap(),
    );
    action
}

/// Returns an action defined in files of the distribution.
fn nested(ours: &ActionParticipant, distribution: Distribution) -> ActionName {
    let package = distribution.share("test_msgs");
    let read = |path: &str| fs::read_to_string(package.join(path)).unwrap();
    let mut registry = TypeRegistry::bundle(Dialect::Ros2);
    for name in ["Builtins", "BasicTypes"] {
        registry
            .add(&type_name(name), &read(&format!("msg/{name}.msg")))
            .unwrap();
    }
    let text = read("action/NestedMessage.action");
    announced(ours, NESTED, "NestedMessage", &text, registry)
}

fn client(ours: &ActionParticipant) -> ActionClient {
    client_of(ours, &fibonacci(ours))
}

fn started(cell: &Cell, distribution: Distribution, args: &[&str]) -> StartedChild {
    cell.rclpy_started(distribution, SCRIPT, args).told()
}

fn server(cell: &Cell, distribution: Distribution) -> Child {
    started(cell, distribution, &["serve", ACTION])
        .start()
        .ready(SOON)
}

fn caller(cell: &Cell, distribution: Distribution, more: &[&str]) -> Child {
    let args = [&["call", ACTION], more].concat();
    started(cell, distribution, &args).start().ready(SOON)
}

/// Sends a line to a peer and returns its next line of that kind; other lines may come before.
async fn asked(peer: &mut Child, line: &str, kind: &str) -> Value {
    let of_kind = |peer: &Child| -> Vec<Value> {
        let lines = peer.json_lines().into_iter();
        lines.filter(|line| line.get(kind).is_some()).collect()
    };
    let before = of_kind(peer).len();
    peer.tell(line);
    until(line, || of_kind(peer).len() > before).await;
    of_kind(peer).swap_remove(before)
}

/// Repeats a line until the answer is `wanted`.
async fn comes_to(peer: &mut Child, line: &str, kind: &str, wanted: &Value) {
    let comes = async { while asked(peer, line, kind).await != *wanted {} };
    let came = timeout(SOON, comes).await;
    assert!(came.is_ok(), "`{line}` never says {wanted}");
}

/// Waits until our node has these actions in the graph of rclpy, as `ros2 node info` lists them.
async fn lists(peer: &mut Child, servers: Value, clients: Value) {
    let wanted = json!({"node": "actions", "servers": servers, "clients": clients});
    comes_to(peer, "node actions", "node", &wanted).await;
}

/// Returns the endpoints of an action in the graph of rclpy: by topic, writers and readers.
async fn ends_of(peer: &mut Child, action: &str) -> BTreeMap<String, BTreeMap<String, Vec<Value>>> {
    let seen = asked(peer, &format!("action {action}"), "action").await;
    let mut topics: BTreeMap<_, BTreeMap<_, Vec<_>>> = BTreeMap::new();
    for end in seen["endpoints"].as_array().unwrap() {
        let kinds = topics.entry(end["topic"].to_string()).or_default();
        let ends = kinds.entry(end["kind"].to_string()).or_default();
        ends.push(end.clone());
    }
    topics
}

/// Waits until rclpy finds matching endpoints of an action, with the same type, hash and QoS on
/// both sides.
async fn fits(peer: &mut Child, action: &str) {
    let whole = async {
        loop {
            let topics = ends_of(peer, action).await;
            if topics.len() == 8 && topics.values().all(|kinds| kinds.len() == 2) {
                return topics;
            }
        }
    };
    for (topic, kinds) in timeout(SOON, whole).await.unwrap() {
        let ends: Vec<_> = kinds.values().flatten().collect();
        let of = |key| -> BTreeSet<_> { ends.iter().map(|end| end[key].to_string()).collect() };
        assert!(of("node").contains("\"actions\""), "{topic}: {ends:?}");
        let keys: &[_] = if can_announce_type_hashes() {
            &["type", "reliability", "durability", "hash"]
        } else {
            &["type", "reliability", "durability"]
        };
        for key in keys {
            assert_eq!(of(key).len(), 1, "{topic}: {ends:?}");
        }
    }
}

async fn a_server_of_rclpy_ends_our_goals_in_every_way(distribution: Distribution) {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    // Sent before a server exists: the client waits for the server.
    let mut early = client.send_goal(&goal(5));
    let mut server = server(&cell, distribution);
    let mut told = story(&mut early).await;
    assert_eq!(
        (told[0].as_str(), told.last().unwrap().as_str()),
        ("accepted", "ended")
    );
    assert_eq!(
        done(&mut early).await,
        (GoalStatusCode::Succeeded, vec![1, 1, 2, 3, 5])
    );
    // Feedback is volatile, and the server may have started before it knew our reader.
    let known = async {
        while !told.iter().any(|one| one == "[1, 1, 2, 3, 5]") {
            told = story(&mut client.send_goal(&goal(5))).await;
        }
    };
    timeout(SOON, known).await.unwrap();
    let told = story(&mut client.send_goal(&goal(5))).await;
    let progress: Vec<_> = told.iter().filter(|one| one.starts_with('[')).collect();
    assert_eq!(
        progress,
        [
            "[1]",
            "[1, 1]",
            "[1, 1, 2]",
            "[1, 1, 2, 3]",
            "[1, 1, 2, 3, 5]"
        ]
    );
    let mut aborted = client.send_goal(&goal(-2));
    assert_eq!(done(&mut aborted).await, (GoalStatusCode::Aborted, vec![]));
    let mut rejected = client.send_goal(&goal(-1));
    assert_eq!(outcome(&mut rejected).await, Outcome::Rejected);
    end_cancelled(&client).await;
    end_at_once(&client).await;
    let unknown = client
        .cancel(CancelWhat::Goal(GoalId::from_bytes([9; 16])))
        .await
        .unwrap();
    assert_eq!(unknown.code, CancelCode::UnknownGoal);
    let mut obstinate = client.send_goal(&goal(101));
    feedback(&mut obstinate, 3).await;
    let refused = obstinate.cancel().await.unwrap();
    assert_eq!(
        (refused.code, refused.goals.len()),
        (CancelCode::Rejected, 0)
    );
    assert_eq!(obstinate.status(), GoalStatusCode::Executing);
    assert_eq!(
        (
            client.counters().malformed,
            client.counters().feedback_dropped
        ),
        (0, 0)
    );
    lists(
        &mut server,
        json!([]),
        json!([[ACTION, ["test_msgs/action/Fibonacci"]]]),
    )
    .await;
    fits(&mut server, ACTION).await;
    // A server that leaves as rclpy does ends its goals.
    server.tell("leave");
    let lost = outcome(&mut obstinate).await;
    assert!(
        matches!(lost, Outcome::Lost(LostReason::ServerLost(_))),
        "{lost:?}"
    );
}

/// Checks that the server decides how a cancelled goal ends.
async fn end_cancelled(client: &ActionClient) {
    for (order, end) in [
        (100, GoalStatusCode::Canceled),
        (110, GoalStatusCode::Succeeded),
        (112, GoalStatusCode::Aborted),
    ] {
        let mut stopped = client.send_goal(&goal(order));
        feedback(&mut stopped, 3).await;
        let answer = stopped.cancel().await.unwrap();
        assert_eq!(
            (answer.code, answer.goals[0].id),
            (CancelCode::None, stopped.id())
        );
        assert_eq!(done(&mut stopped).await, (end, vec![1, 1, 2]));
        let again = stopped.cancel().await.unwrap();
        assert_eq!((again.code, again.goals.len()), (CancelCode::Terminated, 0));
    }
}

/// Sends more goals at once than a server of rmw keeps requests, and cancels some of them at once.
async fn end_at_once(client: &ActionClient) {
    let mut many: Vec<_> = (0..20)
        .map(|order| client.send_goal(&goal(order)))
        .collect();
    for (count, goal) in many.iter_mut().enumerate() {
        let (status, numbers) = done(goal).await;
        assert_eq!((status, numbers.len()), (GoalStatusCode::Succeeded, count));
    }
    let mut all = [100, 102].map(|order| client.send_goal(&goal(order)));
    for goal in &mut all {
        feedback(goal, 3).await;
    }
    let answer = client.cancel(CancelWhat::All).await.unwrap();
    let ids: BTreeSet<_> = answer.goals.iter().map(|info| info.id).collect();
    assert_eq!(
        (answer.code, ids),
        (CancelCode::None, all.iter().map(|goal| goal.id()).collect())
    );
    for goal in &mut all {
        assert_eq!(done(goal).await.0, GoalStatusCode::Canceled);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_jazzy_ends_our_goals_in_every_way() {
    a_server_of_rclpy_ends_our_goals_in_every_way(Distribution::Jazzy).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_kilted_ends_our_goals_in_every_way() {
    a_server_of_rclpy_ends_our_goals_in_every_way(Distribution::Kilted).await;
}

/// Starts a server with a lease of three seconds.
fn mortal(cell: &Cell, distribution: Distribution) -> Child {
    let profile = cell.file(
        "lease.xml",
        r#"<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="lease" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseDuration><sec>3</sec></leaseDuration>
    <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
</profiles>"#,
    );
    started(cell, distribution, &["serve", ACTION])
        .env("FASTRTPS_DEFAULT_PROFILES_FILE", &profile)
        .env("FASTDDS_DEFAULT_PROFILES_FILE", &profile)
        .start()
        .ready(SOON)
}

async fn a_goal_whose_server_is_killed_is_lost_and_the_next_one_is_served_again(
    distribution: Distribution,
) {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let killed = mortal(&cell, distribution);
    let mut running = client.send_goal(&goal(100));
    feedback(&mut running, 3).await;
    killed.signal(Signal::SIGKILL);
    // A new server at once: it does not know the goal, and the lease of the old server has not
    // ended.
    let _server = server(&cell, distribution);
    let next = async {
        loop {
            match outcome(&mut client.send_goal(&goal(3))).await {
                Outcome::Done { status, .. } => return status,
                // The new server is not discovered yet, and the old server never answers.
                Outcome::Lost(LostReason::Unanswered(ServiceError::Lost { .. })) => {}
                other => panic!("{other:?}"),
            }
        }
    };
    assert_eq!(
        timeout(SOON, next).await.unwrap(),
        GoalStatusCode::Succeeded
    );
    let lost = outcome(&mut running).await;
    let Outcome::Lost(reason @ LostReason::ServerLost(_)) = &lost else {
        panic!("{lost:?}");
    };
    assert!(reason.may_run());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_goal_whose_server_of_jazzy_is_killed_is_lost() {
    a_goal_whose_server_is_killed_is_lost_and_the_next_one_is_served_again(Distribution::Jazzy)
        .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_goal_whose_server_of_kilted_is_killed_is_lost() {
    a_goal_whose_server_is_killed_is_lost_and_the_next_one_is_served_again(Distribution::Kilted)
        .await;
}

async fn a_client_of_rclpy_sees_its_goals_end_in_every_way(distribution: Distribution) {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let nested = client_of(&ours, &nested(&ours, distribution));
    let serving = serve_as(&ours, &fibonacci(&ours), options());
    let mut client = caller(&cell, distribution, &["--results", "--nested", NESTED]);
    client.tell("send 55");
    // Before the end, because rclpy ignores feedback for a goal once it has the result.
    until("all feedback is heard", || {
        of(&client.json_lines(), "feedback", 0).count() == 5
    })
    .await;
    serving.end_a_goal();
    ends(&client, 0, "SUCCEEDED", &[1, 1, 2, 3, 5]).await;
    said(&client, &json!({"state": 0, "status": "SUCCEEDED"})).await;
    let lines = client.json_lines();
    for (count, heard) in of(&lines, "feedback", 0).enumerate() {
        assert_eq!(heard["sequence"], json!([1, 1, 2, 3, 5][..=count]));
    }
    // Late joiners receive the status of the ended goal.
    client.tell("watch");
    said(&client, &json!({"list": ["SUCCEEDED"]})).await;
    client.tell("send -2");
    ends(&client, 1, "ABORTED", &[]).await;
    client.tell("send -1");
    said(&client, &json!({"goal": 2, "accepted": false})).await;
    for (number, order, end) in [
        (3, 100, "CANCELED"),
        (4, 110, "SUCCEEDED"),
        (5, 112, "ABORTED"),
    ] {
        client.tell(&format!("send {order}"));
        said(&client, &json!({"feedback": number, "sequence": [1, 1, 2]})).await;
        said(&client, &json!({"state": number, "status": "EXECUTING"})).await;
        client.tell(&format!("cancel {number}"));
        said(&client, &json!({"cancel": "NONE", "goals": [number]})).await;
        ends(&client, number, end, &[1, 1, 2]).await;
        said(&client, &json!({"state": number, "status": end})).await;
    }
    let answer = asked(&mut client, "cancel 3", "cancel").await;
    assert_eq!(answer, json!({"cancel": "GOAL_TERMINATED", "goals": []}));
    cancels_many(&mut client).await;
    let answer = asked(&mut client, "cancel_unknown", "cancel").await;
    assert_eq!(answer, json!({"cancel": "UNKNOWN_GOAL_ID", "goals": []}));
    let answer = asked(&mut client, "result 3", "result").await;
    assert_eq!(
        answer,
        json!({"result": 3, "status": "CANCELED", "sequence": [1, 1, 2]})
    );
    let answer = asked(&mut client, "result_unknown", "result").await;
    assert_eq!(
        answer,
        json!({"result": null, "status": "UNKNOWN", "sequence": []})
    );
    assert_eq!(of(&client.json_lines(), "result", 7).count(), 0);
    assert_eq!(serving.counters(), Default::default());
    let servers = json!([[ACTION, ["test_msgs/action/Fibonacci"]]]);
    let clients = json!([[NESTED, ["test_msgs/action/NestedMessage"]]]);
    lists(&mut client, servers, clients).await;
    fits(&mut client, ACTION).await;
    fits(&mut client, NESTED).await;
    until("a server of nested messages is found", || {
        nested.server().is_ok()
    })
    .await;
}

/// Of four goals, a single goal refuses cancellation; five goals have ended before.
async fn cancels_many(client: &mut Child) {
    for (number, order) in [(6, 100), (7, 101), (8, 102), (9, 104)] {
        client.tell(&format!("send {order}"));
        said(client, &json!({"feedback": number, "sequence": [1, 1, 2]})).await;
    }
    client.tell("cancel 7");
    said(client, &json!({"cancel": "REJECTED", "goals": []})).await;
    client.tell("cancel_until 8");
    said(client, &json!({"cancel": "NONE", "goals": [6, 8]})).await;
    client.tell("cancel_all");
    said(client, &json!({"cancel": "NONE", "goals": [9]})).await;
    for number in [6, 8, 9] {
        ends(client, number, "CANCELED", &[1, 1, 2]).await;
    }
    let before = ["SUCCEEDED", "ABORTED", "CANCELED", "SUCCEEDED", "ABORTED"];
    let now = ["CANCELED", "EXECUTING", "CANCELED", "CANCELED"];
    let list = [&before[..], &now].concat();
    said(client, &json!({"list": list})).await;
}

async fn ends(client: &Child, goal: u64, status: &str, sequence: &[i32]) {
    let end = said(client, &json!({"result": goal})).await;
    assert_eq!(
        (&end["status"], &end["sequence"]),
        (&json!(status), &json!(sequence))
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_of_jazzy_sees_its_goals_end_in_every_way() {
    a_client_of_rclpy_sees_its_goals_end_in_every_way(Distribution::Jazzy).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_of_kilted_sees_its_goals_end_in_every_way() {
    a_client_of_rclpy_sees_its_goals_end_in_every_way(Distribution::Kilted).await;
}

async fn a_server_that_comes_back_serves_a_client_that_stayed(distribution: Distribution) {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let brief = ActionServerOptions {
        result_timeout: Some(Duration::from_secs(1)),
        ..options()
    };
    let ours = ActionParticipant::join();
    let serving = serve_as(&ours, &fibonacci(&ours), brief.clone());
    let mut client = caller(&cell, distribution, &[]);
    client.tell("watch");
    client.tell("send 100");
    said(&client, &json!({"feedback": 0, "sequence": [1, 1, 2]})).await;
    said(&client, &json!({"list": ["EXECUTING"]})).await;
    // The action's endpoints are withdrawn although the participant stays. Then the participant is
    // withdrawn, too.
    serving.end().await;
    let answer = asked(&mut client, "gone", "gone").await;
    assert_eq!(answer, json!({"gone": true}));
    let ActionParticipant { peers, domain } = ours;
    drop(peers);
    assert!(domain.leave(()).await);
    let alone = json!({"participants": 1});
    comes_to(&mut client, "participants", "participants", &alone).await;
    let again = ActionParticipant::join();
    let _serving = serve_as(&again, &fibonacci(&again), brief);
    let answer = asked(&mut client, "back", "back").await;
    assert_eq!(answer, json!({"back": true}));
    // The restarted server does not know the earlier goals.
    let unknown = |goal| json!({"result": goal, "status": "UNKNOWN", "sequence": []});
    assert_eq!(asked(&mut client, "result 0", "result").await, unknown(0));
    client.tell("send 3");
    said(&client, &json!({"feedback": 1, "sequence": [1, 1, 2]})).await;
    said(&client, &json!({"list": ["SUCCEEDED"]})).await;
    client.tell("result 1");
    let kept = json!({"result": 1, "status": "SUCCEEDED", "sequence": [1, 1, 2]});
    said(&client, &kept).await;
    // Ended goals are removed.
    said(&client, &json!({"list": []})).await;
    assert_eq!(asked(&mut client, "result 1", "result").await, unknown(1));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_that_comes_back_serves_a_client_of_jazzy_that_stayed() {
    a_server_that_comes_back_serves_a_client_that_stayed(Distribution::Jazzy).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_that_comes_back_serves_a_client_of_kilted_that_stayed() {
    a_server_that_comes_back_serves_a_client_that_stayed(Distribution::Kilted).await;
}
