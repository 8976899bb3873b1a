//! Action clients and servers of this crate with each other, and with hand-made messages, around a
//! master in this process.

#![expect(clippy::unwrap_used, clippy::panic, reason = "test code")]

use std::future::Future;
use std::net::SocketAddr;
use std::time::Duration;

use bytes::Bytes;
use tcpros::actionlib::{
    ActionlibClient, ActionlibClientOptions, ActionlibError, ActionlibGoal, ActionlibGoalError,
    ActionlibGoalEvent, ActionlibServer, ActionlibServerEvent, ActionlibServerGoal,
    ActionlibServerOptions, ActionlibStatus, ActionlibTypes, ClientType, CommState, GoalLoss,
    SimpleActionServer, goal_id_type, goal_status_array_type,
};
use tcpros::{
    Core, Inbox, InboxEvent, Node, NodeOptions, Publisher, PublisherOptions, RequestedType,
    Ros1Time, SubscriberOptions, TopicType,
};
use tokio::time::timeout;

const DEADLINE: Duration = Duration::from_secs(20);

fn core() -> Core {
    Core::start(SocketAddr::from(([127, 0, 0, 1], 0))).unwrap()
}

fn node(name: &str, core: &Core) -> Node {
    let mut options = NodeOptions::from_env(name);
    core.uri().clone_into(&mut options.master_uri);
    "/".clone_into(&mut options.namespace);
    options.advertise_as("127.0.0.1");
    Node::start(options).unwrap()
}

fn topic_type(name: &str, digit: char) -> TopicType {
    TopicType {
        name: format!("test/{name}"),
        md5sum: digit.to_string().repeat(32),
        definition: String::new(),
    }
}

fn action() -> ActionlibTypes {
    ActionlibTypes {
        goal: topic_type("CountActionGoal", '1'),
        result: topic_type("CountActionResult", '2'),
        feedback: topic_type("CountActionFeedback", '3'),
    }
}

fn serve(node: &Node) -> ActionlibServer {
    let options = ActionlibServerOptions::new(Bytes::from_static(b"empty"));
    ActionlibServer::new(node, "count", action(), options).unwrap()
}

fn client(node: &Node, options: ActionlibClientOptions) -> ActionlibClient {
    ActionlibClient::new(node, "count", action(), options).unwrap()
}

async fn within<T>(what: &str, future: impl Future<Output = T>) -> T {
    match timeout(DEADLINE, future).await {
        Ok(value) => value,
        Err(_) => panic!("waited {DEADLINE:?} for {what}"),
    }
}

async fn ready(client: &ActionlibClient) {
    client.wait_for_server(DEADLINE).await.unwrap();
}

async fn goal(server: &mut ActionlibServer) -> ActionlibServerGoal {
    match within("a goal", server.recv()).await {
        ActionlibServerEvent::Goal(goal) => goal,
        ActionlibServerEvent::Cancel(id) => panic!("a request to cancel {id:?} instead of a goal"),
    }
}

async fn cancelled(server: &mut ActionlibServer) -> String {
    match within("a request to cancel", server.recv()).await {
        ActionlibServerEvent::Cancel(id) => id.id,
        ActionlibServerEvent::Goal(goal) => panic!("{goal:?} instead of a request to cancel"),
    }
}

async fn state(handle: &mut ActionlibGoal, wanted: CommState) {
    within(&format!("{wanted:?}"), async {
        loop {
            match handle.recv().await {
                Some(ActionlibGoalEvent::State(state)) if state == wanted => return,
                Some(_) => {}
                None => panic!("the goal ended before it was {wanted:?}"),
            }
        }
    })
    .await;
}

async fn ended(handle: &mut ActionlibGoal) -> (ActionlibStatus, String, Bytes) {
    let result = within("the result", handle.outcome()).await.unwrap();
    (result.status, result.text, result.body)
}

async fn lost(handle: &mut ActionlibGoal) -> GoalLoss {
    match within("the loss", handle.outcome()).await {
        Err(reason) => reason,
        Ok(result) => panic!("{result:?} instead of a loss"),
    }
}

#[tokio::test]
async fn a_goal_is_accepted_reports_progress_and_succeeds() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let (mut server, client) = (
        serve(&robot),
        client(&cell, ActionlibClientOptions::default()),
    );
    assert_eq!(client.wait_for_server(DEADLINE).await.unwrap(), "/robot");
    let mut handle = client.send_goal(b"to ten");
    assert!(handle.goal_id().id.starts_with("/cell-"));
    let goal = goal(&mut server).await;
    assert_eq!(goal.body(), b"to ten".as_slice());
    assert_eq!(goal.goal_id(), handle.goal_id());
    state(&mut handle, CommState::Pending).await;
    goal.accept("counting").unwrap();
    state(&mut handle, CommState::Active).await;
    assert_eq!(handle.status().text, "counting");
    goal.feedback(b"five").unwrap();
    let Some(ActionlibGoalEvent::Feedback(feedback)) = within("feedback", handle.recv()).await
    else {
        panic!("no feedback");
    };
    assert_eq!(feedback.body, b"five".as_slice());
    assert_eq!(
        feedback.peer.header.type_name(),
        Some("test/CountActionFeedback")
    );
    goal.succeed(b"ten", "done").unwrap();
    let (status, text, body) = ended(&mut handle).await;
    assert_eq!(
        (status, &*text, &*body),
        (ActionlibStatus::Succeeded, "done", b"ten".as_slice())
    );
    assert_eq!(
        (handle.state(), handle.status().status),
        (CommState::Done, ActionlibStatus::Succeeded)
    );
    assert!(handle.recv().await.is_none());
    let refused = goal.feedback(b"late").unwrap_err();
    assert!(refused.to_string().contains("Succeeded"), "{refused}");
}

#[tokio::test]
async fn a_client_that_knows_only_the_goals_type_is_told_the_others() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let mut server = serve(&robot);
    let open = ClientType::of_goal(action().goal);
    let client =
        ActionlibClient::new(&cell, "count", open, ActionlibClientOptions::default()).unwrap();
    ready(&client).await;
    let mut handle = client.send_goal(b"");
    goal(&mut server).await.reject("busy").unwrap();
    let result = within("the result", handle.outcome()).await.unwrap();
    assert_eq!(
        (result.status, &*result.text),
        (ActionlibStatus::Rejected, "busy")
    );
    assert_eq!(result.body, b"empty".as_slice());
    assert_eq!(result.peer.header.md5sum(), Some("2".repeat(32).as_str()));
}

#[tokio::test]
async fn two_clients_get_their_own_results_and_no_other() {
    let core = core();
    let (robot, cells) = (node("robot", &core), [node("a", &core), node("b", &core)]);
    let mut server = serve(&robot);
    let clients = cells
        .each_ref()
        .map(|cell| client(cell, ActionlibClientOptions::default()));
    for client in &clients {
        ready(client).await;
    }
    let mut handles = clients
        .each_ref()
        .map(|client| client.send_goal(client.name().as_bytes()));
    let goals = [goal(&mut server).await, goal(&mut server).await];
    for goal in &goals {
        goal.accept("").unwrap();
        goal.succeed(goal.goal_id().id.as_bytes(), "").unwrap();
    }
    for handle in &mut handles {
        let id = handle.goal_id().id.clone();
        assert_eq!(ended(handle).await.2, id.as_bytes());
    }
    assert_eq!(clients[0].counters(), clients[1].counters());
    assert_eq!(clients[0].counters().late_results, 0);
}

#[tokio::test]
async fn a_request_to_cancel_reaches_the_goal_and_its_end_is_the_servers_decision() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let (mut server, client) = (
        serve(&robot),
        client(&cell, ActionlibClientOptions::default()),
    );
    ready(&client).await;
    let mut handles = [client.send_goal(b"1"), client.send_goal(b"2")];
    let goals = [goal(&mut server).await, goal(&mut server).await];
    goals[0].accept("").unwrap();
    state(&mut handles[0], CommState::Active).await;
    assert!(handles[0].cancel());
    assert_eq!(cancelled(&mut server).await, handles[0].goal_id().id);
    within("the request", goals[0].cancel_requested()).await;
    state(&mut handles[0], CommState::Preempting).await;
    assert!(!handles[0].cancel(), "the server knows already");
    goals[0].cancelled(Some(b"half"), "stopped").unwrap();
    let (status, _, body) = ended(&mut handles[0]).await;
    assert_eq!(
        (status, &*body),
        (ActionlibStatus::Preempted, b"half".as_slice())
    );
    assert_eq!(client.cancel_all(), 1);
    assert_eq!(cancelled(&mut server).await, handles[1].goal_id().id);
    assert_eq!(goals[1].status(), ActionlibStatus::Recalling);
    goals[1].accept("too late to recall").unwrap();
    goals[1].succeed(b"", "was done anyway").unwrap();
    assert_eq!(ended(&mut handles[1]).await.0, ActionlibStatus::Succeeded);
}

#[tokio::test]
async fn goals_up_to_a_time_are_cancelled_those_to_come_included() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let (mut server, client) = (
        serve(&robot),
        client(&cell, ActionlibClientOptions::default()),
    );
    ready(&client).await;
    let mut first = client.send_goal(b"1");
    let held = goal(&mut server).await;
    let mut far = first.goal_id().stamp;
    far.secs += 1000;
    assert_eq!(client.cancel_before(far), 1);
    assert_eq!(cancelled(&mut server).await, first.goal_id().id);
    held.cancelled(None, "").unwrap();
    assert_eq!(ended(&mut first).await.0, ActionlibStatus::Recalled);
    let mut second = client.send_goal(b"2");
    let (status, _, body) = ended(&mut second).await;
    assert_eq!(
        (status, &*body),
        (ActionlibStatus::Recalled, b"empty".as_slice())
    );
    assert!(server.try_recv().is_none());
}

#[tokio::test]
async fn a_goal_with_an_id_of_the_caller_is_stamped_by_its_server() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let (mut server, client) = (
        serve(&robot),
        client(&cell, ActionlibClientOptions::default()),
    );
    ready(&client).await;
    let mut ahead = client.send_goal(b"1").goal_id().stamp;
    let first = goal(&mut server).await;
    first.accept("").unwrap();
    first.succeed(b"", "").unwrap();
    ahead.secs += 1000;
    assert_eq!(client.cancel_before(ahead), 1);
    // Any stamp of this host is earlier than the last cancel time at the server: the goal would be
    // recalled.
    let _handle = client.send_goal_as("mine".to_owned(), b"2").unwrap();
    let held = goal(&mut server).await;
    assert_eq!(held.goal_id().id, "mine");
    let stamp = held.goal_id().stamp;
    assert!(Ros1Time::default() < stamp && stamp < ahead, "{stamp:?}");
}

#[tokio::test]
async fn a_goal_that_the_server_drops_is_aborted_and_so_are_all_when_it_stops() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let (mut server, client) = (
        serve(&robot),
        client(&cell, ActionlibClientOptions::default()),
    );
    ready(&client).await;
    let mut handle = client.send_goal(b"1");
    drop(goal(&mut server).await);
    let (status, text, body) = ended(&mut handle).await;
    assert_eq!(
        (status, &*body),
        (ActionlibStatus::Aborted, b"empty".as_slice())
    );
    assert!(text.contains("abandoned the goal"), "{text}");
    let mut handle = client.send_goal(b"2");
    let held = goal(&mut server).await;
    drop(server);
    assert_eq!(ended(&mut handle).await.0, ActionlibStatus::Aborted);
    assert_eq!(held.accept(""), Err(ActionlibGoalError::Closed));
}

#[tokio::test]
async fn a_goal_for_no_server_is_lost_at_once_and_the_reason_names_the_topic() {
    let core = core();
    let cell = node("cell", &core);
    let client = client(&cell, ActionlibClientOptions::default());
    let missing = client
        .wait_for_server(Duration::from_millis(50))
        .await
        .unwrap_err();
    assert!(
        missing
            .to_string()
            .contains("/count: no server has published its status"),
        "{missing}"
    );
    let mut handle = client.send_goal(b"");
    let reason = lost(&mut handle).await;
    assert!(reason.to_string().contains("/count/goal"), "{reason}");
    assert_eq!(handle.state(), CommState::Lost);
    assert!(!handle.cancel());
}

#[tokio::test]
async fn a_server_that_goes_loses_its_goals_and_the_next_one_is_found() {
    let core = core();
    let cell = node("cell", &core);
    let client = client(&cell, ActionlibClientOptions::default());
    let robot = node("robot", &core);
    let mut server = serve(&robot);
    ready(&client).await;
    let mut handle = client.send_goal(b"1");
    let held = goal(&mut server).await;
    held.accept("").unwrap();
    state(&mut handle, CommState::Active).await;
    // As when the process dies: the connections end without any further message.
    std::mem::forget((held, server));
    drop(robot);
    let reason = lost(&mut handle).await;
    let server = "/robot".to_owned();
    assert_eq!(reason, GoalLoss::Disconnected { server });
    let robot = node("robot", &core);
    let mut server = serve(&robot);
    ready(&client).await;
    let mut handle = client.send_goal(b"2");
    let held = goal(&mut server).await;
    held.accept("").unwrap();
    held.succeed(b"again", "").unwrap();
    assert_eq!(ended(&mut handle).await.2, b"again".as_slice());
}

#[tokio::test]
async fn closing_a_client_ends_its_goals() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let (mut server, client) = (
        serve(&robot),
        client(&cell, ActionlibClientOptions::default()),
    );
    ready(&client).await;
    let mut handle = client.send_goal(b"1");
    let _held = goal(&mut server).await;
    drop(client);
    assert_eq!(lost(&mut handle).await, GoalLoss::ClientClosed);
}

/// A hand-made server: publishes the topics of an action, and receives goals and cancel requests.
struct ByHand {
    status: Publisher,
    feedback: Publisher,
    result: Publisher,
    goals: Inbox<()>,
    _subscribed: [tcpros::Subscription; 2],
}

impl ByHand {
    fn server(node: &Node) -> Self {
        let publish = |topic, topic_type| {
            let options = PublisherOptions::default();
            node.advertise(topic, topic_type, options).unwrap()
        };
        let goals = Inbox::new();
        let subscribe = |topic| {
            let options = SubscriberOptions::default();
            node.subscribe(topic, RequestedType::default(), options, (), &goals)
                .unwrap()
        };
        Self {
            status: publish("count/status", goal_status_array_type()),
            feedback: publish("count/feedback", action().feedback),
            result: publish("count/result", action().result),
            _subscribed: [subscribe("count/goal"), subscribe("count/cancel")],
            goals,
        }
    }

    async fn heard(&mut self) {
        within("a goal", async {
            while !matches!(self.goals.recv().await.1, InboxEvent::Message(_)) {}
        })
        .await;
    }

    fn send(publisher: &Publisher, message: Vec<u8>) {
        let _sent = publisher.publish(message.into());
    }

    fn list(&self, goals: &[(&str, u8)]) {
        let mut message = vec![0; 16];
        message.extend(u32::try_from(goals.len()).unwrap().to_le_bytes());
        for (id, code) in goals {
            message.extend(status(id, *code));
        }
        Self::send(&self.status, message);
    }
}

fn status(id: &str, code: u8) -> Vec<u8> {
    let mut out = vec![0; 8];
    out.extend(u32::try_from(id.len()).unwrap().to_le_bytes());
    out.extend(id.as_bytes());
    out.extend([code, 0, 0, 0, 0]);
    out
}

fn impatient() -> ActionlibClientOptions {
    ActionlibClientOptions {
        acknowledge_timeout: Duration::from_millis(200),
        silence_timeout: Duration::from_millis(400),
        result_timeout: Duration::from_millis(200),
        ..ActionlibClientOptions::default()
    }
}

/// Returns a hand-made server that a client has found, and a goal sent to it.
async fn sent_by_hand(robot: &Node, client: &ActionlibClient) -> (ByHand, ActionlibGoal) {
    let mut server = ByHand::server(robot);
    within("the server", async {
        while client.server().is_err() {
            server.list(&[]);
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await;
    let handle = client.send_goal(b"");
    server.heard().await;
    (server, handle)
}

#[tokio::test]
async fn every_way_of_a_server_to_fall_silent_ends_the_goal_with_its_reason() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let client = client(&cell, impatient());
    let (server, mut handle) = sent_by_hand(&robot, &client).await;
    assert!(matches!(
        lost(&mut handle).await,
        GoalLoss::NotAcknowledged(_)
    ));
    for (code, end) in [(1, "no status"), (3, "no result")] {
        let mut handle = client.send_goal(b"");
        server.list(&[(&handle.goal_id().id, code)]);
        let reason = lost(&mut handle).await.to_string();
        assert!(reason.contains(end), "{reason}");
    }
    let mut handle = client.send_goal(b"");
    server.list(&[(&handle.goal_id().id, 1)]);
    server.list(&[]);
    assert!(matches!(
        lost(&mut handle).await,
        GoalLoss::Forgotten { .. }
    ));
}

#[tokio::test]
async fn messages_that_do_not_read_are_counted_and_the_goal_goes_on() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let client = client(&cell, ActionlibClientOptions::default());
    let (server, mut handle) = sent_by_hand(&robot, &client).await;
    ByHand::send(&server.status, vec![0xff; 20]);
    ByHand::send(&server.feedback, vec![1, 2, 3]);
    ByHand::send(&server.result, Vec::new());
    within("three counts", async {
        while client.counters().malformed < 3 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    let mut result = vec![0; 16];
    result.extend(status(&handle.goal_id().id, 3));
    result.extend(b"body");
    ByHand::send(&server.result, result);
    assert_eq!(ended(&mut handle).await.2, b"body".as_slice());
}

#[tokio::test]
async fn a_goal_with_no_id_gets_one_and_bad_goals_are_counted() {
    let core = core();
    let (robot, hand) = (node("robot", &core), node("hand", &core));
    let mut server = serve(&robot);
    let goals = hand
        .advertise("count/goal", action().goal, PublisherOptions::default())
        .unwrap();
    let cancels = hand
        .advertise("count/cancel", goal_id_type(), PublisherOptions::default())
        .unwrap();
    within("the server", async {
        while goals.subscribers() + cancels.subscribers() < 2 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    assert!(goals.is_subscribed_by("/robot") && !goals.is_subscribed_by("/hand"));
    ByHand::send(&goals, vec![9; 10]);
    ByHand::send(&cancels, vec![0xff; 12]);
    let mut anonymous = vec![0; 28];
    anonymous.extend(b"body");
    ByHand::send(&goals, anonymous);
    let goal = goal(&mut server).await;
    assert_eq!(goal.body(), b"body".as_slice());
    assert!(goal.goal_id().id.starts_with("/robot-"), "{goal:?}");
    assert!(goal.goal_id().stamp > Ros1Time::default());
    within("two counts", async {
        while server.counters().malformed < 2 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
}

#[tokio::test]
async fn a_simple_server_gives_way_to_the_newest_goal() {
    let core = core();
    let (robot, cell) = (node("robot", &core), node("cell", &core));
    let mut simple = SimpleActionServer::new(serve(&robot));
    let client = client(&cell, ActionlibClientOptions::default());
    ready(&client).await;
    let mut first = client.send_goal(b"1");
    let current = within("the first goal", simple.next()).await;
    let (mut second, mut third) = (client.send_goal(b"2"), client.send_goal(b"3"));
    within("a newer goal", simple.preempted(&current)).await;
    state(&mut third, CommState::Pending).await;
    current.cancelled(None, "").unwrap();
    assert_eq!(ended(&mut first).await.0, ActionlibStatus::Preempted);
    let current = within("the newest goal", simple.next()).await;
    assert_eq!(current.body(), b"3".as_slice());
    assert_eq!(ended(&mut second).await.0, ActionlibStatus::Recalled);
    assert!(third.cancel());
    within("the request", simple.preempted(&current)).await;
    current.cancelled(None, "").unwrap();
    assert_eq!(ended(&mut third).await.0, ActionlibStatus::Preempted);
}

#[tokio::test]
async fn the_type_of_a_bare_goal_is_refused_and_so_is_a_second_client_of_one_node() {
    let core = core();
    let cell = node("cell", &core);
    let bare = ClientType::of_goal(topic_type("CountGoal", '1'));
    let options = ActionlibClientOptions::default();
    let refused = ActionlibClient::new(&cell, "count", bare, options).unwrap_err();
    assert!(matches!(refused, ActionlibError::NotAWrapper { .. }));
    let _first = client(&cell, options);
    let second = ActionlibClient::new(&cell, "count", action(), options).unwrap_err();
    assert!(
        second
            .to_string()
            .contains("/count/goal is already published"),
        "{second}"
    );
}
