//! Our action server with clients of other implementations.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use nix::sys::signal::Signal;
use ros2_node::action::{
    ActionName, ActionServer, ActionServerOptions, GoalError, NewGoal, ServerCounters, ServerEvent,
    ServerGoal,
};
use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;

use crate::ros2_actions::fibonacci::{
    self, ACTION, ActionParticipant, SOON, feedback, result, until,
};

/// A running server, until dropped.
pub(crate) struct RunningActionServer {
    counters: watch::Receiver<ServerCounters>,
    ends: Arc<Semaphore>,
    task: JoinHandle<()>,
}

impl Drop for RunningActionServer {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl RunningActionServer {
    /// Ends the server, and returns when all of its entities are removed.
    pub(crate) async fn end(mut self) {
        self.task.abort();
        assert!((&mut self.task).await.unwrap_err().is_cancelled());
    }

    pub(crate) fn counters(&self) -> ServerCounters {
        *self.counters.borrow()
    }

    /// Ends a goal with an order of 50 to 99.
    pub(crate) fn end_a_goal(&self) {
        self.ends.add_permits(1);
    }
}

pub(crate) fn options() -> ActionServerOptions {
    ActionServerOptions::new(Bytes::from(result(&[])))
}

/// Serves goals as the peers do. A goal with an order of 50 to 99 runs like a goal with an order
/// that is lower by 50, but waits for [`RunningActionServer::end_a_goal`] before it ends.
pub(crate) fn serve(ours: &ActionParticipant, options: ActionServerOptions) -> RunningActionServer {
    serve_as(ours, &fibonacci::action(), options)
}

/// Serves an action with the messages of Fibonacci and any name and type.
pub(crate) fn serve_as(
    ours: &ActionParticipant,
    action: &ActionName,
    options: ActionServerOptions,
) -> RunningActionServer {
    let mut server = ActionServer::open(&ours.domain, &ours.peers, action, options).unwrap();
    let (counters, heard) = watch::channel(server.counters());
    let ends = Arc::new(Semaphore::new(0));
    let told = Arc::clone(&ends);
    let task = tokio::spawn(async move {
        let mut orders = HashMap::new();
        let mut tick = tokio::time::interval(Duration::from_millis(20));
        loop {
            tokio::select! {
                _ = tick.tick() => drop(counters.send(server.counters())),
                event = server.recv() => match event {
                    ServerEvent::Goal(goal) => {
                        orders.insert(goal.id(), order(&goal));
                        tokio::spawn(take(goal, Arc::clone(&told)));
                    }
                    ServerEvent::Cancel(request) => match orders[&request.id()] % 2 {
                        0 => request.accept().unwrap(),
                        _ => request.reject(),
                    },
                },
            }
        }
    });
    RunningActionServer {
        counters: heard,
        ends,
        task,
    }
}

fn order(goal: &NewGoal) -> i32 {
    i32::from_le_bytes(goal.body()[4..8].try_into().unwrap())
}

async fn take(goal: NewGoal, told: Arc<Semaphore>) {
    let order = order(&goal);
    if order == -1 {
        goal.reject();
        return;
    }
    work(goal.accept().await.unwrap(), order, &told).await;
}

async fn work(goal: ServerGoal, order: i32, told: &Semaphore) {
    goal.execute().unwrap();
    if order == -2 {
        goal.abort(&result(&[])).unwrap();
        return;
    }
    let mut numbers: Vec<i32> = Vec::new();
    let most = match order {
        100.. => 3,
        50.. => order - 50,
        _ => order,
    };
    for _ in 0..most {
        let next = numbers.iter().rev().take(2).sum::<i32>().max(1);
        numbers.push(next);
        goal.feedback(&feedback(&numbers)).unwrap();
    }
    if order >= 100 {
        goal.cancel_agreed().await;
        let result = result(&numbers);
        let end = match order {
            110 => goal.succeed(&result),
            112 => goal.abort(&result),
            _ => goal.canceled(&result),
        };
        // The server may have been closed.
        assert!(matches!(end, Ok(()) | Err(GoalError::Closed)), "{end:?}");
    } else {
        if order >= 50 {
            told.acquire().await.unwrap().forget();
        }
        goal.succeed(&result(&numbers)).unwrap();
    }
}

fn cyclone(cell: &Cell, more: &[&str]) -> Child {
    let own = ["call", ACTION, "--domain", "2"];
    let started = cell.cyclone_started("ros2_action.py", &[&own, more].concat());
    started.told().start().ready(SOON)
}

/// Waits for a line with these fields.
pub(crate) async fn said(client: &Child, wanted: &Value) -> Value {
    let wanted = wanted.as_object().unwrap();
    let found = || {
        let mut lines = client.json_lines().into_iter();
        lines.find(|line| {
            wanted
                .iter()
                .all(|(key, value)| line.get(key) == Some(value))
        })
    };
    until(&format!("{wanted:?}"), || found().is_some()).await;
    found().unwrap()
}

pub(crate) fn of<'l>(
    lines: &'l [Value],
    key: &'l str,
    goal: u64,
) -> impl Iterator<Item = &'l Value> {
    lines.iter().filter(move |line| line[key] == goal)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_of_cyclone_sees_its_goals_end_in_every_way() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let serving = serve(&ours, options());
    let mut client = cyclone(&cell, &["--results"]);
    client.tell("send 5");
    let end = said(&client, &json!({"result": 0})).await;
    assert_eq!(
        (&end["status"], &end["sequence"]),
        (&json!("SUCCEEDED"), &json!([1, 1, 2, 3, 5]))
    );
    said(
        &client,
        &json!({"feedback": 0, "sequence": [1, 1, 2, 3, 5]}),
    )
    .await;
    said(&client, &json!({"state": 0, "status": "SUCCEEDED"})).await;
    let lines = client.json_lines();
    let feedback: Vec<_> = of(&lines, "feedback", 0).collect();
    assert_eq!(feedback.len(), 5, "{feedback:?}");
    assert_eq!(feedback[0]["sequence"], json!([1]));
    // The client receives the acceptance of the goal before its feedback.
    let at = |key: &str| lines.iter().position(|line| line[key] == 0).unwrap();
    assert!(at("goal") < at("feedback"), "{lines:?}");
    client.tell("send -2");
    said(&client, &json!({"result": 1, "status": "ABORTED"})).await;
    client.tell("send -1");
    said(&client, &json!({"goal": 2, "accepted": false})).await;
    client.tell("repeat 0");
    said(&client, &json!({"repeated": 0, "accepted": false})).await;
    client.tell("send 100");
    said(&client, &json!({"feedback": 3, "sequence": [1, 1, 2]})).await;
    said(&client, &json!({"state": 3, "status": "EXECUTING"})).await;
    client.tell("cancel 3");
    said(&client, &json!({"cancel": "NONE", "goals": [3]})).await;
    let end = said(&client, &json!({"result": 3})).await;
    assert_eq!(
        (&end["status"], &end["sequence"]),
        (&json!("CANCELED"), &json!([1, 1, 2]))
    );
    client.tell("cancel 3");
    said(&client, &json!({"cancel": "GOAL_TERMINATED", "goals": []})).await;
    client.tell("cancel_unknown");
    said(&client, &json!({"cancel": "UNKNOWN_GOAL_ID", "goals": []})).await;
    until("the repeated goal is counted", || {
        serving.counters().repeated == 1
    })
    .await;
    let counters = serving.counters();
    assert_eq!((counters.malformed, counters.feedback_dropped), (0, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_burst_of_feedback_is_heard_whole_by_each_new_client() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let _serving = serve(&ours, options());
    let mut clients = Vec::new();
    for _ in 0..6 {
        let mut client = cyclone(&cell, &["--results"]);
        client.tell("send 46");
        said(&client, &json!({"result": 0, "status": "SUCCEEDED"})).await;
        let heard = || of(&client.json_lines(), "feedback", 0).count();
        until("the last is heard", || heard() == 46).await;
        clients.push(client);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_client_of_cyclone_cancels_until_a_time_and_all() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let _serving = serve(&ours, options());
    let mut client = cyclone(&cell, &["--results"]);
    for (number, order) in [100, 101, 102, 104].into_iter().enumerate() {
        client.tell(&format!("send {order}"));
        said(&client, &json!({"feedback": number, "sequence": [1, 1, 2]})).await;
        said(&client, &json!({"goal": number, "accepted": true})).await;
    }
    client.tell("cancel 1");
    said(&client, &json!({"cancel": "REJECTED", "goals": []})).await;
    client.tell("cancel_until 2");
    said(&client, &json!({"cancel": "NONE", "goals": [0, 2]})).await;
    client.tell("cancel_all");
    said(&client, &json!({"cancel": "NONE", "goals": [3]})).await;
    for number in [0, 2, 3] {
        said(&client, &json!({"result": number, "status": "CANCELED"})).await;
    }
    client.tell("cancel_all");
    until("the odd one alone is left, and goes on", || {
        let lines = client.json_lines();
        let rejected = json!("REJECTED");
        lines
            .iter()
            .filter(|line| line.get("cancel") == Some(&rejected))
            .count()
            == 2
    })
    .await;
    assert_eq!(of(&client.json_lines(), "result", 1).count(), 0);
}

fn kept_for(time: Option<Duration>) -> ActionServerOptions {
    ActionServerOptions {
        result_timeout: time,
        ..options()
    }
}

/// Starts a subscriber of the status.
fn watches(cell: &Cell) -> Child {
    cell.cyclone("ros2_action.py", &["status", ACTION, "--domain", "2"])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_result_and_a_status_are_kept_for_who_comes_late() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let _serving = serve(&ours, kept_for(None));
    let mut client = cyclone(&cell, &[]);
    client.tell("result_unknown");
    let unknown = json!({"result": null, "status": "UNKNOWN", "sequence": []});
    said(&client, &unknown).await;
    client.tell("send 3");
    said(&client, &json!({"state": 0, "status": "SUCCEEDED"})).await;
    said(&watches(&cell), &json!({"list": ["SUCCEEDED"]})).await;
    client.tell("result 0");
    let end = json!({"result": 0, "status": "SUCCEEDED", "sequence": [1, 1, 2]});
    said(&client, &end).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_result_is_forgotten_after_its_time() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let _serving = serve(&ours, kept_for(Some(Duration::from_secs(1))));
    let mut client = cyclone(&cell, &[]);
    let watch = watches(&cell);
    client.tell("send 3");
    said(&client, &json!({"state": 0, "status": "SUCCEEDED"})).await;
    said(&watch, &json!({"list": []})).await;
    client.tell("result 0");
    let unknown = json!({"result": 0, "status": "UNKNOWN", "sequence": []});
    said(&client, &unknown).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn results_that_are_waited_for_do_not_hold_up_other_goals() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let serving = serve(&ours, options());
    let mut waits = cyclone(&cell, &["--results"]);
    for _ in 0..100 {
        waits.tell("send 100");
    }
    until("a hundred goals run", || {
        let lines = waits.json_lines();
        lines.iter().filter(|line| line["accepted"] == true).count() == 100
    })
    .await;
    // The result of a single goal is requested more often than requests are kept.
    for _ in 0..20 {
        waits.tell("result 0");
    }
    until("the oldest requests give way", || {
        serving.counters().displaced > 0
    })
    .await;
    let mut other = cyclone(&cell, &["--results"]);
    other.tell("send 5");
    said(&other, &json!({"result": 0, "status": "SUCCEEDED"})).await;
    waits.signal(Signal::SIGKILL);
    // The goals of a dead client continue; any other client may cancel them.
    other.tell("cancel_all");
    let answer = || {
        let lines = other.json_lines();
        let found = lines.iter().find(|line| line["cancel"] == "NONE")?;
        Some(found["goals"].as_array()?.len())
    };
    until("all are cancelled", || answer() == Some(100)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn of_more_goals_than_allowed_the_next_is_rejected_until_one_ends() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let options = ActionServerOptions {
        max_goals: 2,
        ..options()
    };
    let serving = serve(&ours, options);
    let mut client = cyclone(&cell, &[]);
    for number in 0..3 {
        client.tell("send 100");
        said(&client, &json!({"goal": number, "accepted": number < 2})).await;
    }
    client.tell("cancel 0");
    said(&client, &json!({"state": 0, "status": "CANCELED"})).await;
    client.tell("send 100");
    said(&client, &json!({"goal": 3, "accepted": true})).await;
    until("both are counted", || {
        let counters = serving.counters();
        (counters.refused, counters.forgotten) == (1, 1)
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn garbage_is_counted_and_goals_go_on() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let serving = serve(&ours, options());
    let _garbage = cell.cyclone("ros2_action.py", &["garbage", ACTION, "--domain", "2"]);
    until("three for each service are malformed", || {
        serving.counters().malformed == 9
    })
    .await;
    let mut client = cyclone(&cell, &["--results"]);
    client.tell("send 3");
    said(&client, &json!({"result": 0, "status": "SUCCEEDED"})).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_goal_whose_worker_gives_it_up_is_aborted_and_one_nobody_decides_about_is_rejected() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let action = fibonacci::action();
    let mut server = ActionServer::open(&ours.domain, &ours.peers, &action, options()).unwrap();
    let mut client = cyclone(&cell, &["--results"]);
    client.tell("send 1");
    let ServerEvent::Goal(goal) = server.recv().await else {
        panic!("a goal comes first");
    };
    drop(goal.accept().await.unwrap());
    said(
        &client,
        &json!({"result": 0, "status": "ABORTED", "sequence": []}),
    )
    .await;
    client.tell("send 1");
    drop(server.recv().await);
    said(&client, &json!({"goal": 1, "accepted": false})).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_that_comes_back_serves_a_client_that_stayed_and_knows_no_old_goals() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let serving = serve(&ours, options());
    let mut client = cyclone(&cell, &["--results"]);
    client.tell("send 100");
    said(&client, &json!({"feedback": 0, "sequence": [1, 1, 2]})).await;
    drop((serving, ours));
    let again = ActionParticipant::join();
    let _serving = serve(&again, options());
    // The client does not wait for the server, so requests sent before mutual discovery are lost.
    let asked = async {
        while of(&client.json_lines(), "result", 0).count() == 0 {
            client.tell("result 0");
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    };
    tokio::time::timeout(SOON, asked).await.unwrap();
    said(
        &client,
        &json!({"result": 0, "status": "UNKNOWN", "sequence": []}),
    )
    .await;
    client.tell("send 3");
    said(
        &client,
        &json!({"result": 1, "status": "SUCCEEDED", "sequence": [1, 1, 2]}),
    )
    .await;
    said(&client, &json!({"feedback": 1, "sequence": [1, 1, 2]})).await;
}
