//! Actions of ROS 2 between this workspace and the middleware of each vendor, in both roles.

mod fastdds;
mod fibonacci;
mod graph;
mod parts;
mod rclpy;
mod secured;
mod served;

use std::time::Duration;

use nix::sys::signal::Signal;
use ros2_node::action::{
    ActionClient, ActionClientOptions, ActionName, CancelCode, CancelWhat, GoalEvent, GoalHandle,
    GoalId, GoalStatusCode, IdInUse, LostReason, Outcome,
};
use system_tests::{Cell, Child, Peer};
use tokio::time::timeout;

use fibonacci::{ACTION, ActionParticipant, SOON, goal, numbers, until};

fn client(ours: &ActionParticipant) -> ActionClient {
    client_of(ours, &fibonacci::action())
}

fn client_of(ours: &ActionParticipant, action: &ActionName) -> ActionClient {
    let options = ActionClientOptions::default();
    ActionClient::open(&ours.domain, &ours.peers, action, options).unwrap()
}

fn cyclone(cell: &Cell, more: &[&str]) -> Child {
    let own = ["serve", ACTION, "--domain", "2"];
    cell.cyclone("ros2_action.py", &[&own, more].concat())
}

async fn outcome(goal: &mut GoalHandle) -> Outcome {
    timeout(SOON, goal.outcome()).await.unwrap()
}

/// Returns the status and the numbers of a goal's result.
async fn done(goal: &mut GoalHandle) -> (GoalStatusCode, Vec<i32>) {
    match outcome(goal).await {
        Outcome::Done { status, result } => (status, numbers(&result, 4)),
        other => panic!("{other:?}"),
    }
}

/// Returns the result of the next goal that is not lost with the previous server. Until its lease
/// ends, the previous server receives requests, too.
async fn next(client: &ActionClient) -> (GoalStatusCode, Vec<i32>) {
    let served = async {
        loop {
            let mut next = client.send_goal(&goal(3));
            match outcome(&mut next).await {
                Outcome::Done { status, result } => return (status, numbers(&result, 4)),
                Outcome::Lost(reason) if reason.may_run() => {}
                other => panic!("{other:?}"),
            }
        }
    };
    timeout(SOON, served).await.unwrap()
}

/// Waits for the goal's feedback with this count of numbers.
async fn feedback(goal: &mut GoalHandle, count: usize) {
    let heard = async {
        while let Some(event) = goal.recv().await {
            if matches!(&event, GoalEvent::Feedback(body) if numbers(body, 0).len() == count) {
                return;
            }
        }
        panic!("the goal has ended");
    };
    timeout(SOON, heard).await.unwrap();
}

/// Returns all events of a goal, except its end.
async fn story(goal: &mut GoalHandle) -> Vec<String> {
    let mut told = Vec::new();
    while let Some(event) = timeout(SOON, goal.recv()).await.unwrap() {
        told.push(match event {
            GoalEvent::Accepted(_) => "accepted".to_owned(),
            GoalEvent::Status(status) => format!("{status:?}"),
            GoalEvent::Feedback(body) => format!("{:?}", numbers(&body, 0)),
            GoalEvent::FeedbackDropped(count) => format!("dropped {count}"),
            GoalEvent::Overdue(limit) => format!("overdue after {limit:?}"),
            GoalEvent::CancelRefused => "cancel refused".to_owned(),
            GoalEvent::Ended(_) => "ended".to_owned(),
        });
    }
    told
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_cyclone_ends_our_goals_in_every_way() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    // Sent before a server exists: the client waits for the server.
    let mut early = client.send_goal(&goal(5));
    let _server = cyclone(&cell, &[]);
    let mut told = story(&mut early).await;
    assert_eq!(told[0], "accepted");
    assert_eq!(
        done(&mut early).await,
        (GoalStatusCode::Succeeded, vec![1, 1, 2, 3, 5])
    );
    assert_eq!(early.status(), GoalStatusCode::Succeeded);
    // Feedback is volatile, and the server may have started before it knew our reader.
    let known = async {
        while !told.iter().any(|one| one == "[1, 1, 2, 3, 5]") {
            told = story(&mut client.send_goal(&goal(5))).await;
        }
    };
    timeout(SOON, known).await.unwrap();
    let told = story(&mut client.send_goal(&goal(5))).await;
    for numbers in [
        "[1]",
        "[1, 1]",
        "[1, 1, 2]",
        "[1, 1, 2, 3]",
        "[1, 1, 2, 3, 5]",
    ] {
        assert!(told.iter().any(|one| one == numbers), "{told:?}");
    }
    let mut aborted = client.send_goal(&goal(-2));
    assert_eq!(done(&mut aborted).await, (GoalStatusCode::Aborted, vec![]));
    let mut rejected = client.send_goal(&goal(-1));
    assert_eq!(outcome(&mut rejected).await, Outcome::Rejected);
    assert_eq!(story(&mut rejected).await, [""; 0]);
    let mut stopped = client.send_goal(&goal(100));
    feedback(&mut stopped, 3).await;
    let answer = stopped.cancel().await.unwrap();
    assert_eq!(answer.code, CancelCode::None);
    assert_eq!(answer.goals[0].id, stopped.id());
    assert_eq!(
        done(&mut stopped).await,
        (GoalStatusCode::Canceled, vec![1, 1, 2])
    );
    assert_eq!(client.counters().malformed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_server_of_cyclone_is_asked_to_cancel_one_some_and_all() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let _server = cyclone(&cell, &[]);
    let mut goals = Vec::new();
    let mut stamps = Vec::new();
    for order in [100, 101, 102, 103] {
        let mut goal = client.send_goal(&goal(order));
        let Some(GoalEvent::Accepted(stamp)) = timeout(SOON, goal.recv()).await.unwrap() else {
            panic!("goal {order} is accepted first");
        };
        feedback(&mut goal, 3).await;
        goals.push(goal);
        stamps.push(stamp);
    }
    // Goals with odd orders continue.
    let refused = goals[1].cancel().await.unwrap();
    assert_eq!(
        (refused.code, refused.goals.len()),
        (CancelCode::Rejected, 0)
    );
    let some = client.cancel(CancelWhat::Until(stamps[1])).await.unwrap();
    assert_eq!(some.code, CancelCode::None);
    let ids = |answer: &ros2_node::action::CancelAnswer| -> Vec<_> {
        answer.goals.iter().map(|info| info.id).collect()
    };
    assert_eq!(ids(&some), [goals[0].id()]);
    assert_eq!(done(&mut goals[0]).await.0, GoalStatusCode::Canceled);
    let ended = goals[0].cancel().await.unwrap();
    assert_eq!(ended.code, CancelCode::Terminated);
    let all = client.cancel(CancelWhat::All).await.unwrap();
    assert_eq!(ids(&all), [goals[2].id()]);
    assert_eq!(done(&mut goals[2]).await.0, GoalStatusCode::Canceled);
    let nobody = GoalId::from_bytes([9; 16]);
    let unknown = client.cancel(CancelWhat::Goal(nobody)).await.unwrap();
    assert_eq!(unknown.code, CancelCode::UnknownGoal);
    assert_eq!(goals[1].status(), GoalStatusCode::Executing);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_goal_has_the_id_that_was_chosen_for_it_and_there_is_one_of_each() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let _server = cyclone(&cell, &[]);
    let id = GoalId::from_bytes(*b"chosen elsewhere");
    let mut first = client.send_goal_as(id, &goal(100)).unwrap();
    assert_eq!(client.send_goal_as(id, &goal(2)).unwrap_err(), IdInUse(id));
    feedback(&mut first, 3).await;
    assert_eq!(first.id(), id);
    // Cancelled by its id as known to the server.
    let cancelled = client.cancel(CancelWhat::Goal(id)).await.unwrap();
    assert_eq!(cancelled.goals[0].id, id);
    assert_eq!(
        done(&mut first).await,
        (GoalStatusCode::Canceled, vec![1, 1, 2])
    );
    drop(first);
    let mut again = client.send_goal_as(id, &goal(2)).unwrap();
    // The server remembers the goal id.
    assert_eq!(outcome(&mut again).await, Outcome::Rejected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn what_a_server_says_before_it_answers_is_told_after() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let _server = cyclone(&cell, &["--hasty"]);
    let mut goal = client.send_goal(&goal(2));
    let told = story(&mut goal).await;
    assert_eq!(told[0], "accepted", "{told:?}");
    assert!(told.iter().any(|one| one == "[1]"), "{told:?}");
    assert!(told.iter().any(|one| one == "Executing"), "{told:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn many_goals_of_two_clients_run_at_once_and_hear_of_themselves_alone() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let others = ActionParticipant::join();
    let clients = [client(&ours), client(&others)];
    let _server = cyclone(&cell, &[]);
    let mut goals = Vec::new();
    for order in 0..40 {
        let client = &clients[order % 2];
        let goal = client.send_goal(&goal(i32::try_from(order % 10).unwrap()));
        goals.push((order % 10, goal));
    }
    for (order, goal) in &mut goals {
        let (status, numbers) = done(goal).await;
        assert_eq!((status, numbers.len()), (GoalStatusCode::Succeeded, *order));
    }
    for client in &clients {
        let counters = client.counters();
        assert!(counters.others_feedback > 0, "{counters:?}");
        assert_eq!((counters.malformed, counters.feedback_dropped), (0, 0));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_goal_whose_server_is_killed_is_lost_and_the_next_one_is_served_again() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let server = cyclone(&cell, &["--lease", "3"]);
    let mut running = client.send_goal(&goal(100));
    feedback(&mut running, 3).await;
    server.signal(Signal::SIGKILL);
    // A new server at once: it does not know the goal, and the lease of the old server may not have
    // ended.
    let _server = cyclone(&cell, &[]);
    assert_eq!(
        next(&client).await,
        (GoalStatusCode::Succeeded, vec![1, 1, 2])
    );
    let lost = outcome(&mut running).await;
    let Outcome::Lost(reason @ LostReason::ServerLost(_)) = &lost else {
        panic!("{lost:?}");
    };
    assert!(reason.may_run());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn a_goal_without_a_server_is_lost_in_time_and_was_not_sent() {
    let Some(_cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let options = ActionClientOptions {
        server_timeout: Duration::from_millis(500),
        ..ActionClientOptions::default()
    };
    let client =
        ActionClient::open(&ours.domain, &ours.peers, &fibonacci::action(), options).unwrap();
    let mut goal = client.send_goal(&goal(3));
    let lost = outcome(&mut goal).await;
    let Outcome::Lost(reason @ LostReason::NoServer(_)) = &lost else {
        panic!("{lost:?}");
    };
    assert!(!reason.may_run());
    assert!(
        reason.to_string().contains("/count/_action/send_goal"),
        "{reason}"
    );
    let mut garbage = client.send_goal(b"no CDR");
    let lost = outcome(&mut garbage).await;
    assert_eq!(lost, Outcome::Lost(LostReason::Message));
    let mut left = client.send_goal(&fibonacci::goal(3));
    drop(client);
    let lost = outcome(&mut left).await;
    assert_eq!(lost, Outcome::Lost(LostReason::ClientClosed));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn feedback_and_statuses_that_do_not_read_are_counted() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let ours = ActionParticipant::join();
    let client = client(&ours);
    let _server = cyclone(&cell, &[]);
    let _garbage = cell.cyclone("ros2_action.py", &["garbage", ACTION, "--domain", "2"]);
    until("garbage is counted", || client.counters().malformed >= 4).await;
    let mut goal = client.send_goal(&goal(3));
    assert_eq!(
        done(&mut goal).await,
        (GoalStatusCode::Succeeded, vec![1, 1, 2])
    );
}
