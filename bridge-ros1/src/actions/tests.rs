//! Tests goals to and from nodes besides the bridge, with a master in this process.

use std::collections::BTreeSet;
use std::net::SocketAddr;

use messages::{Dialect, TypeRegistry};
use tcpros::{Core, Node, NodeOptions};
use tokio::time::timeout;

use super::*;
use crate::ends::Ends;

#[test]
fn an_id_of_the_space_comes_back_from_its_text_and_others_have_one_of_their_own() {
    let id: GraphGoalId = *b"\x00\x01goal of a plant"[..16].first_chunk().unwrap();
    assert_eq!(spelled(id).len(), 32);
    assert_eq!(read(&spelled(id)), id);
    let texts = [
        "",
        "/client-1-12.3",
        "/client-2-12.3",
        "0123456789ABCDEF0123456789abcdef",
        "+123456789abcdef0123456789abcdef",
    ];
    let read: BTreeSet<GraphGoalId> = texts.iter().map(|id| read(id)).collect();
    assert_eq!(read.len(), texts.len());
}

#[test]
fn a_result_with_nothing_in_it_has_the_length_of_its_type() {
    let registry = TypeRegistry::bundle(Dialect::Ros1);
    let of = |name: &str| {
        let action = registry.action(&name.parse().unwrap()).unwrap();
        empty(action.result()).unwrap().to_vec()
    };
    assert_eq!(of("actionlib/TwoInts"), [0; 8]);
    assert_eq!(of("actionlib_tutorials/Fibonacci"), [0; 4]);
    assert!(of("move_base_msgs/MoveBase").is_empty());
}

const SOON: Duration = Duration::from_secs(20);
const WAITS: Waits = Waits {
    answer: Duration::from_secs(5),
    silence: Duration::from_secs(5),
};
const ID: GraphGoalId = [0xa5; 16];

struct Cell {
    _core: Core,
    bridge: Node,
    robot: Node,
    definitions: Ros1Definitions,
    ends: Ends,
}

impl Cell {
    fn start() -> Self {
        let core = Core::start(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap();
        let node = |name: &str| {
            let mut options = NodeOptions::from_env(name);
            core.uri().clone_into(&mut options.master_uri);
            "/".clone_into(&mut options.namespace);
            options.advertise_as("127.0.0.1");
            Node::start(options).unwrap()
        };
        Self {
            bridge: node("bridge"),
            robot: node("robot"),
            _core: core,
            definitions: Ros1Definitions::new(Arc::default(), Vec::new()),
            ends: Ends::default(),
        }
    }

    fn graph(&mut self) -> Ros1Graph<'_> {
        Ros1Graph {
            node: &self.bridge,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        }
    }

    fn sender(&mut self, waits: Waits) -> GoalSender {
        let made = self.graph().action_client("/count", &test(), waits);
        made.unwrap()
    }

    /// Returns an action server of the robot.
    fn server(&self) -> tcpros::actionlib::ActionlibServer {
        let options = ActionlibServerOptions::new(Bytes::from_static(&[0; 4]));
        tcpros::actionlib::ActionlibServer::new(&self.robot, "/count", test_types(), options)
            .unwrap()
    }
}

fn test() -> TypeName {
    "actionlib/Test".parse().unwrap()
}

fn test_types() -> tcpros::actionlib::ActionlibTypes {
    types(&TypeRegistry::bundle(Dialect::Ros1).action(&test()).unwrap())
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    match timeout(SOON, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited {SOON:?} for {what}"),
    }
}

async fn next_goal(server: &mut tcpros::actionlib::ActionlibServer) -> ActionlibServerGoal {
    within("a goal", async {
        loop {
            if let tcpros::actionlib::ActionlibServerEvent::Goal(goal) = server.recv().await {
                return goal;
            }
        }
    })
    .await
}

/// Returns the next event except statuses, which may arrive at any time.
async fn heard(goal: &mut SentActionlibGoal) -> Option<GraphGoalEvent> {
    within("an event", async {
        loop {
            match goal.recv().await {
                Some(GraphGoalEvent::Status(_)) => {}
                event => return event,
            }
        }
    })
    .await
}

/// A time that no goal of a test exceeds.
fn later() -> std::time::Instant {
    bridge_node::now().monotonic + Duration::from_secs(3600)
}

async fn is_accepted(goal: &mut SentActionlibGoal) {
    let event = heard(goal).await;
    assert!(
        matches!(event, Some(GraphGoalEvent::Accepted(_))),
        "{event:?}"
    );
}

fn ended(status: i8, message: &str, result: i32) -> Option<GraphGoalEvent> {
    Some(GraphGoalEvent::Ended {
        status,
        message: message.to_owned(),
        result: Bytes::copy_from_slice(&result.to_le_bytes()),
    })
}

#[tokio::test]
async fn a_goal_waits_for_its_server_to_connect_and_is_followed_to_its_end() {
    let mut cell = Cell::start();
    let mut server = cell.server();
    let sender = cell.sender(WAITS);
    // No server is connected yet.
    let mut goal = sender.send_goal(ID, &5i32.to_le_bytes(), later());
    let events = tokio::spawn(async move {
        is_accepted(&mut goal).await;
        let report = Some(GraphGoalEvent::Feedback(Bytes::from_static(&[7, 0, 0, 0])));
        assert_eq!(heard(&mut goal).await, report);
        assert_eq!(heard(&mut goal).await, ended(SUCCEEDED, "there", 10));
        assert_eq!(heard(&mut goal).await, None);
    });
    let goal = next_goal(&mut server).await;
    assert_eq!(goal.goal_id().id, spelled(ID));
    assert_eq!(goal.body().as_ref(), 5i32.to_le_bytes());
    goal.accept("").unwrap();
    goal.feedback(&7i32.to_le_bytes()).unwrap();
    goal.succeed(&10i32.to_le_bytes(), "there").unwrap();
    within("the end", events).await.unwrap();
}

#[tokio::test]
async fn a_goal_is_rejected_with_the_words_of_its_server_and_one_left_undecided_is_aborted() {
    let mut cell = Cell::start();
    let mut server = cell.server();
    let sender = cell.sender(WAITS);
    let mut goal = sender.send_goal(ID, &1i32.to_le_bytes(), later());
    let events = tokio::spawn(async move { heard(&mut goal).await });
    next_goal(&mut server).await.reject("no way").unwrap();
    let rejected = Some(GraphGoalEvent::Rejected("no way".to_owned()));
    assert_eq!(within("the answer", events).await.unwrap(), rejected);

    let mut goal = sender.send_goal([1; 16], &1i32.to_le_bytes(), later());
    let undecided = next_goal(&mut server).await;
    // The goal counts as accepted after a while, so its client does not wait any longer.
    is_accepted(&mut goal).await;
    undecided.reject("after all").unwrap();
    assert_eq!(heard(&mut goal).await, ended(ABORTED, "after all", 0));
}

#[tokio::test]
async fn goals_are_cancelled_one_by_one_and_all_together() {
    let mut cell = Cell::start();
    let mut server = cell.server();
    let sender = cell.sender(WAITS);
    let ids: [GraphGoalId; 3] = [[1; 16], [2; 16], [3; 16]];
    let mut sent = Vec::new();
    let mut taken = Vec::new();
    for id in ids {
        let mut goal = sender.send_goal(id, &100i32.to_le_bytes(), later());
        let accepted = tokio::spawn(async move {
            is_accepted(&mut goal).await;
            goal
        });
        let there = next_goal(&mut server).await;
        there.accept("").unwrap();
        taken.push(there);
        sent.push(within("its word", accepted).await.unwrap());
    }
    let cancel = async |what| within("the answer", sender.cancel(what)).await.unwrap();
    let told = |code, goals: &[GraphGoalId]| GraphCancelResponse {
        code,
        goals: goals.to_vec(),
    };
    assert_eq!(
        cancel(GraphCancelSelection::Goal([9; 16])).await,
        told(2, &[])
    );
    assert_eq!(
        cancel(GraphCancelSelection::Goal(ids[1])).await,
        told(0, &ids[1..2])
    );
    within("the request", taken[1].cancel_requested()).await;
    assert!(!taken[0].is_cancel_requested());
    taken[1].cancelled(Some(&[4, 0, 0, 0]), "stopped").unwrap();
    assert_eq!(heard(&mut sent[1]).await, ended(CANCELED, "stopped", 4));
    assert_eq!(
        cancel(GraphCancelSelection::Goal(ids[1])).await,
        told(3, &[])
    );
    let mut all = cancel(GraphCancelSelection::All).await;
    all.goals.sort_unstable();
    assert_eq!(all, told(0, &[ids[0], ids[2]]));
    for goal in [&taken[0], &taken[2]] {
        within("the request", goal.cancel_requested()).await;
    }
}

#[tokio::test]
async fn a_goal_without_a_server_was_not_executed_and_a_client_is_shared() {
    let mut cell = Cell::start();
    let waits = Waits {
        answer: Duration::from_millis(200),
        ..WAITS
    };
    let sender = cell.sender(waits);
    let mut goal = sender.send_goal(ID, &[], later());
    let event = heard(&mut goal).await;
    let Some(GraphGoalEvent::Lost {
        text,
        ran: MayHaveRun::No,
    }) = event
    else {
        panic!("{event:?}");
    };
    assert!(text.contains("/count"), "{text}");
    assert_eq!(heard(&mut goal).await, None);
    let other = cell.sender(waits);
    assert!(Arc::ptr_eq(&sender.client, &other.client));
    let wrong = "actionlib/TwoInts".parse().unwrap();
    let made = cell.graph().action_client("/count", &wrong, waits);
    assert!(made.is_err(), "it has goals of another type");
    drop((goal, sender, other));
    assert!(cell.graph().action_client("/count", &wrong, waits).is_ok());
}

#[tokio::test]
async fn a_goal_is_not_sent_to_a_server_that_connects_after_its_time() {
    let mut cell = Cell::start();
    let sender = cell.sender(WAITS);
    let start_by = bridge_node::now().monotonic + Duration::from_millis(50);
    let mut goal = sender.send_goal(ID, &5i32.to_le_bytes(), start_by);
    let lost = tokio::spawn(async move { heard(&mut goal).await });
    tokio::time::sleep_until(start_by.into()).await;
    let mut server = cell.server();
    let event = within("the end", lost).await.unwrap();
    let Some(GraphGoalEvent::Lost {
        text,
        ran: MayHaveRun::No,
    }) = event
    else {
        panic!("{event:?}");
    };
    assert!(text.contains("the time until which it may start"), "{text}");
    let mut next = sender.send_goal([1; 16], &6i32.to_le_bytes(), later());
    let followed = tokio::spawn(async move { heard(&mut next).await });
    let first = next_goal(&mut server).await;
    assert_eq!(first.goal_id().id, spelled([1; 16]));
    first.accept("").unwrap();
    let accepted = within("the answer", followed).await.unwrap();
    assert!(matches!(accepted, Some(GraphGoalEvent::Accepted(_))));
}

#[tokio::test]
async fn goals_of_the_graph_are_decided_about_and_ended_here() {
    let mut cell = Cell::start();
    let mut taker = cell.graph().serve_action("/count", &test()).unwrap();
    // The previous server is about to be dropped, as when an action is withdrawn and offered in one
    // step.
    let again = cell.graph().serve_action("/count", &test());
    drop(std::mem::replace(&mut taker, again.unwrap()));
    let options = ActionlibClientOptions::default();
    let client =
        tcpros::actionlib::ActionlibClient::new(&cell.robot, "/count", test_types(), options)
            .unwrap();
    within("the server", client.wait_for_server(SOON))
        .await
        .unwrap();
    let send = |number: i32| client.send_goal(&number.to_le_bytes());
    let mut asked = [1, 2, 3, 4].map(send);
    let mut taken = Vec::new();
    while taken.len() < 4 {
        if let GraphServerEvent::Goal(goal) = within("a goal", taker.recv()).await {
            taken.push(goal);
        }
    }
    let ids: Vec<GraphGoalId> = asked.iter().map(|goal| read(&goal.goal_id().id)).collect();
    assert_eq!(taken.iter().map(GraphNewGoal::id).collect::<Vec<_>>(), ids);
    assert_eq!(taken[2].body().as_ref(), 3i32.to_le_bytes());
    let [first, second, third, fourth] = <[NewGraphGoal; 4]>::try_from(taken).unwrap();
    first.reject("not that");
    drop(second);
    let (third, fourth) = (
        third.accept().await.unwrap(),
        fourth.accept().await.unwrap(),
    );
    third.feedback(&[9, 0, 0, 0]).unwrap();
    third.end(SUCCEEDED, "done", Some(&[6, 0, 0, 0])).unwrap();
    assert!(third.end(SUCCEEDED, "", None).is_err(), "it has ended");
    assert!(asked[3].cancel());
    let event = within("the request", taker.recv()).await;
    let GraphServerEvent::Cancel(cancel) = event else {
        panic!("{event:?}");
    };
    assert_eq!(cancel.id(), ids[3]);
    cancel.accept().unwrap();
    fourth.end(CANCELED, "stopped", None).unwrap();
    let mut ends = Vec::new();
    for goal in &mut asked {
        let end = within("the end", goal.outcome()).await.unwrap();
        ends.push((end.status, end.text, end.body.to_vec()));
    }
    let nothing = vec![0; 4];
    assert_eq!(
        ends,
        [
            (
                ActionlibStatus::Rejected,
                "not that".to_owned(),
                nothing.clone()
            ),
            (
                ActionlibStatus::Rejected,
                "the goal was neither accepted nor rejected in time".to_owned(),
                nothing.clone()
            ),
            (
                ActionlibStatus::Succeeded,
                "done".to_owned(),
                vec![6, 0, 0, 0]
            ),
            (ActionlibStatus::Preempted, "stopped".to_owned(), nothing),
        ]
    );
}
