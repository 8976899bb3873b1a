//! Actions between this workspace and the actionlib of ROS 1: actionlib clients with our server,
//! our client with actionlib servers.

use std::time::{Duration, Instant};

use bytes::Bytes;
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, MASTER, Peer, eventually};
use tcpros::actionlib::{
    ActionlibClient, ActionlibClientOptions, ActionlibGoal, ActionlibGoalEvent, ActionlibServer,
    ActionlibServerEvent, ActionlibServerGoal, ActionlibServerOptions, ActionlibStatus,
    ActionlibTypes, CancelSent, ClientType, CommState, GoalLoss, SimpleActionServer,
};
use tcpros::{Node, NodeOptions, TopicType};
use tokio::runtime::{Builder, Runtime};
use tokio::time::timeout;

const SOON: Duration = Duration::from_secs(20);
const START: Duration = Duration::from_secs(30);

fn topic_type(part: &str, md5sum: &str) -> TopicType {
    TopicType {
        name: format!("actionlib/TestAction{part}"),
        md5sum: md5sum.to_owned(),
        definition: String::new(),
    }
}

fn action() -> ActionlibTypes {
    ActionlibTypes {
        goal: topic_type("Goal", "348369c5b403676156094e8c159720bf"),
        result: topic_type("Result", "3d669e3a63aa986c667ea7b0f46ce85e"),
        feedback: topic_type("Feedback", "6d3d0bf7fb3dda24779c010a9f3eb7cb"),
    }
}

/// Returns a runtime. Its threads are created by the test's thread, so they are in its network.
fn runtime() -> Runtime {
    Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap()
}

fn node(name: &str) -> Node {
    let mut options = NodeOptions::from_env(name);
    options.master_uri = format!("http://{MASTER}");
    options.namespace = "/".to_owned();
    options.advertise_as("127.0.0.1");
    Node::start(options).unwrap()
}

fn serve(node: &Node) -> ActionlibServer {
    let options = ActionlibServerOptions::new(Bytes::from_static(&[0; 4]));
    ActionlibServer::new(node, "count", action(), options).unwrap()
}

fn client(node: &Node) -> ActionlibClient {
    let options = ActionlibClientOptions::default();
    ActionlibClient::new(node, "count", action(), options).unwrap()
}

fn number(body: &[u8]) -> i32 {
    i32::from_le_bytes(body.try_into().unwrap())
}

/// Executes a goal as the rospy server does.
async fn work(goal: ActionlibServerGoal) {
    let n = number(goal.body());
    if n == -2 {
        goal.reject("no").unwrap();
        return;
    }
    goal.accept("on it").unwrap();
    if n == -1 {
        goal.abort(Some(&3i32.to_le_bytes()), "failed").unwrap();
    } else if n >= 100 {
        goal.feedback(&(n + 1).to_le_bytes()).unwrap();
        goal.cancel_requested().await;
        goal.cancelled(Some(&7i32.to_le_bytes()), "stopped")
            .unwrap();
    } else {
        goal.succeed(&(2 * n).to_le_bytes(), "done").unwrap();
    }
}

async fn serve_many(mut server: ActionlibServer) {
    loop {
        if let ActionlibServerEvent::Goal(goal) = server.recv().await {
            tokio::spawn(work(goal));
        }
    }
}

async fn serve_simply(mut server: SimpleActionServer) {
    loop {
        let goal = server.next().await;
        let n = number(goal.body());
        if n >= 100 {
            server.preempted(&goal).await;
            goal.cancelled(Some(&7i32.to_le_bytes()), "stopped")
                .unwrap();
        } else {
            goal.succeed(&(2 * n).to_le_bytes(), "done").unwrap();
        }
    }
}

fn rospy_client(cell: &Cell, args: &[&str]) -> Child {
    let args = [&["count"], args].concat();
    let started = cell.rospy_started("ros1_action_client.py", &args);
    started.told().start().ready(START)
}

fn line(child: &mut Child, count: u64, key: &str, value: &Value) {
    child.wait_for_json(&format!("{key} {value} of goal {count}"), SOON, |line| {
        (line.get("count")? == count && line.get(key)? == value).then_some(())
    });
}

fn end(child: &mut Child, count: u64) -> Value {
    child.wait_for_json(&format!("the end of goal {count}"), SOON, |line| {
        (line.get("count")? == count && line.get("end").is_some())
            .then(|| json!([line["end"], line["text"], line["result"]]))
    })
}

#[test]
fn an_actionlib_client_is_served_with_every_kind_of_end() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let robot = node("robot");
    runtime.spawn(serve_many(serve(&robot)));
    let mut client = rospy_client(&cell, &[]);
    client.tell("send 5");
    assert_eq!(end(&mut client, 0), json!(["SUCCEEDED", "done", 10]));
    client.tell("send -1");
    assert_eq!(end(&mut client, 1), json!(["ABORTED", "failed", 3]));
    client.tell("send -2");
    assert_eq!(end(&mut client, 2), json!(["REJECTED", "no", 0]));
    for count in 3..6 {
        client.tell("send 100");
        line(&mut client, count, "state", &json!("ACTIVE"));
        line(&mut client, count, "feedback", &json!(101));
    }
    client.tell("cancel 4");
    assert_eq!(end(&mut client, 4), json!(["PREEMPTED", "stopped", 7]));
    client.tell("cancel_all");
    for count in [3, 5] {
        assert_eq!(end(&mut client, count), json!(["PREEMPTED", "stopped", 7]));
    }
    let ends = client
        .json_lines()
        .iter()
        .filter(|line| line.get("end").is_some())
        .count();
    assert_eq!(ends, 6);
}

#[test]
fn a_simple_actionlib_client_preempts_its_goal_with_the_next_one() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let robot = node("robot");
    runtime.spawn(serve_simply(SimpleActionServer::new(serve(&robot))));
    // A client with a clock an hour ahead, and a client with a clock an hour behind.
    let mut other = rospy_client(&cell, &["--node", "late", "--clock-offset", "-3600"]);
    let mut client = rospy_client(&cell, &["--simple", "--clock-offset", "3600"]);
    other.tell("send 100");
    line(&mut other, 0, "state", &json!("ACTIVE"));
    client.tell("send 101");
    line(&mut client, 0, "state", &json!("ACTIVE"));
    assert_eq!(end(&mut other, 0), json!(["PREEMPTED", "stopped", 7]));
    client.tell("send 4");
    assert_eq!(end(&mut client, 1), json!(["SUCCEEDED", "done", 8]));
    assert_eq!(
        client
            .json_lines()
            .iter()
            .filter(|line| line.get("end").is_some())
            .count(),
        1
    );
}

fn send(client: &ActionlibClient, goal: i32) -> ActionlibGoal {
    client.send_goal(&goal.to_le_bytes())
}

/// Returns the result of a goal: status, text and number.
async fn outcome(handle: &mut ActionlibGoal) -> (ActionlibStatus, String, i32) {
    let result = timeout(SOON, handle.outcome()).await.unwrap().unwrap();
    (result.status, result.text, number(&result.body))
}

async fn state(handle: &mut ActionlibGoal, wanted: CommState) {
    timeout(SOON, async {
        while !matches!(handle.recv().await.unwrap(), ActionlibGoalEvent::State(state) if state == wanted) {}
    })
    .await
    .unwrap();
}

async fn progress(handle: &mut ActionlibGoal) -> i32 {
    let feedback = timeout(SOON, async {
        loop {
            if let ActionlibGoalEvent::Feedback(feedback) = handle.recv().await.unwrap() {
                return feedback;
            }
        }
    });
    number(&feedback.await.unwrap().body)
}

async fn every_kind_of_end(client: &ActionlibClient) {
    let done = outcome(&mut send(client, 5)).await;
    assert_eq!(done, (ActionlibStatus::Succeeded, "done".to_owned(), 10));
    let aborted = outcome(&mut send(client, -1)).await;
    assert_eq!(aborted, (ActionlibStatus::Aborted, "failed".to_owned(), 3));
    let rejected = outcome(&mut send(client, -2)).await;
    assert_eq!(rejected, (ActionlibStatus::Rejected, "no".to_owned(), 2));
    let stopped = (ActionlibStatus::Preempted, "stopped".to_owned(), 7);
    let mut held = [100, 101, 102, 103].map(|goal| send(client, goal));
    for (handle, goal) in held.iter_mut().zip(100..) {
        assert_eq!(progress(handle).await, goal + 1);
    }
    assert!(held[2].cancel());
    assert_eq!(outcome(&mut held[2]).await, stopped);
    client.cancel_before(held[0].goal_id().stamp);
    assert_eq!(outcome(&mut held[0]).await, stopped);
    assert!(!held[1].state().is_end());
    client.cancel_all();
    for at in [1, 3] {
        assert_eq!(outcome(&mut held[at]).await, stopped);
    }
    let counters = client.counters();
    assert_eq!((counters.malformed, counters.late_results), (0, 0));
}

#[test]
fn an_actionlib_server_serves_our_client_with_every_kind_of_end_whatever_its_clock_says() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let _server = cell.rospy(
        "ros1_action_server.py",
        &["count", "--clock-offset", "-86400"],
    );
    let here = node("here");
    let client = client(&here);
    runtime.block_on(async {
        let server = client.wait_for_server(START).await.unwrap();
        assert_eq!(server, "/rospy_action_server");
        every_kind_of_end(&client).await;
    });
}

#[test]
fn a_goal_under_an_id_of_our_choice_is_known_to_its_server_and_cancelled_by_it() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let mut server = cell.rospy("ros1_action_server.py", &["count"]);
    let here = node("here");
    let client = client(&here);
    runtime.block_on(async {
        client.wait_for_server(START).await.unwrap();
        let send = |id: &str, goal: i32| client.send_goal_as(id.to_owned(), &goal.to_le_bytes());
        let (mut first, mut second) = (send("a1", 100).unwrap(), send("b2", 101).unwrap());
        assert!(send("a1", 5).is_err(), "one goal has one id");
        assert_eq!(progress(&mut first).await, 101);
        assert_eq!(progress(&mut second).await, 102);
        let mut open = client.open_goals();
        open.sort();
        assert_eq!(open, ["a1", "b2"]);
        assert_eq!(client.cancel_goal("c3"), CancelSent::NotFollowed);
        assert_eq!(client.cancel_goal("b2"), CancelSent::Asked);
        let stopped = (ActionlibStatus::Preempted, "stopped".to_owned(), 7);
        assert_eq!(outcome(&mut second).await, stopped);
        assert_eq!(client.cancel_goal("b2"), CancelSent::Ended);
        assert_eq!(client.open_goals(), ["a1"]);
        assert_eq!(first.state(), CommState::Active);
        drop(first);
        assert_eq!(client.cancel_goal("a1"), CancelSent::NotFollowed);
    });
    for (number, id) in [(100, "a1"), (101, "b2")] {
        let told = |line: &Value| (line.get("goal")? == number).then(|| line["id"].clone());
        assert_eq!(server.wait_for_json("the goal", SOON, told), id);
    }
}

#[test]
fn a_simple_actionlib_server_gives_our_first_goal_up_for_the_second() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let _server = cell.rospy("ros1_action_server.py", &["count", "--simple"]);
    let here = node("here");
    let open = ClientType::of_goal(action().goal);
    let client =
        ActionlibClient::new(&here, "count", open, ActionlibClientOptions::default()).unwrap();
    runtime.block_on(async {
        client.wait_for_server(START).await.unwrap();
        let mut first = send(&client, 100);
        state(&mut first, CommState::Active).await;
        let mut second = send(&client, 4);
        assert_eq!(
            outcome(&mut first).await,
            (ActionlibStatus::Preempted, "stopped".to_owned(), 7)
        );
        let result = second.outcome().await.unwrap();
        assert_eq!(
            (result.status, number(&result.body)),
            (ActionlibStatus::Succeeded, 8)
        );
        assert_eq!(
            result.peer.header.type_name(),
            Some("actionlib/TestActionResult")
        );
    });
}

#[test]
fn a_client_of_ours_and_one_of_actionlib_at_one_server_get_their_own_results() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let _server = cell.rospy("ros1_action_server.py", &["count"]);
    let here = node("here");
    let client = client(&here);
    let mut other = rospy_client(&cell, &[]);
    runtime.block_on(client.wait_for_server(START)).unwrap();
    let mut held = send(&client, 100);
    runtime.block_on(state(&mut held, CommState::Active));
    for n in 0..10 {
        other.tell(&format!("send {n}"));
        let ours = runtime.block_on(outcome(&mut send(&client, 50 + n)));
        assert_eq!(
            ours,
            (ActionlibStatus::Succeeded, "done".to_owned(), 2 * (50 + n))
        );
    }
    for n in 0..10 {
        assert_eq!(end(&mut other, n), json!(["SUCCEEDED", "done", 2 * n]));
    }
    assert_eq!(held.state(), CommState::Active);
    assert_eq!(client.counters().late_results, 0);
}

#[test]
fn a_goal_whose_server_is_killed_or_hangs_is_lost_in_time_and_the_next_goal_works() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let (_master, runtime) = (cell.roscore(), runtime());
    let _inside = runtime.enter();
    let here = node("here");
    let client = client(&here);
    let name = "/rospy_action_server".to_owned();
    let silent = GoalLoss::Silent {
        server: name.clone(),
        silence: Duration::from_secs(5),
    };
    let gone = GoalLoss::Disconnected { server: name };
    for (signal, reason) in [(Signal::SIGKILL, gone), (Signal::SIGSTOP, silent)] {
        let server = cell.rospy("ros1_action_server.py", &["count"]);
        runtime.block_on(client.wait_for_server(START)).unwrap();
        let mut handle = send(&client, 100);
        runtime.block_on(state(&mut handle, CommState::Active));
        server.signal(signal);
        let since = Instant::now();
        let lost = runtime.block_on(async { timeout(SOON, handle.outcome()).await.unwrap() });
        assert_eq!(lost.unwrap_err(), reason);
        assert!(
            since.elapsed() < Duration::from_secs(8),
            "{:?}",
            since.elapsed()
        );
        server.signal(Signal::SIGKILL);
        drop(server);
        eventually("the client sees that nobody serves", SOON, || {
            client.server().is_err().then_some(())
        });
    }
    let _server = cell.rospy("ros1_action_server.py", &["count"]);
    runtime.block_on(async {
        client.wait_for_server(START).await.unwrap();
        assert_eq!(outcome(&mut send(&client, 4)).await.2, 8);
    });
}
