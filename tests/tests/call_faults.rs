//! Calls while datagrams are lost, duplicated and delayed, while programs are killed, and while an
//! attacker forges messages.

use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    CallEnd, CallerScript, Cell, CodecAsker, Counting, Distribution, Executes, Executor,
    GroupRelay, METRICS_ROS1, METRICS_ROS2, OTHER_GROUP, Peer, UadpSocket, Weather, drops,
    eventually, metrics, send_from,
};
use uadp::action::{
    ActionAddress, ActionDialect, ActionFields, ActionHeader, ActionKind, ActionState, ActionToSend,
};
use uadp::{Extras, NetworkHeader, NetworkMessage};

const SOON: Duration = Duration::from_secs(40);
/// Time within which a caller learns that the executor is lost.
const BOUND: Duration = Duration::from_secs(8);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Ros2];
const SERVICE: &str = "/ua_1_2_61";
const SERVICE_ID: (u16, u16, u16) = (1, 2, 61);

/// Returns an order for calls of a service, numbered from `first`.
fn order(case: &str, first: u32, count: u32, at_once: u32) -> Value {
    json!({"case": case, "service": SERVICE, "first": first, "count": count, "at_once": at_once})
}

fn one_right(asker: &mut CallerScript, number: u32) {
    let told = asker.ask(order("files", number, 1, 1));
    assert_eq!(told["right"], 1, "{told}");
}

fn running(executor: &mut Counting, count: u64) {
    let deadline = Instant::now() + SOON;
    while executor.counts()["running"] != count {
        assert!(Instant::now() < deadline, "{}", executor.counts());
        std::thread::park_timeout(Duration::from_millis(50));
    }
}

fn each_once(executor: &mut Counting, count: u64) {
    let counts = executor.counts();
    assert_eq!(counts["executed"], count, "{counts}");
    assert_eq!(counts["twice"], json!([]), "{counts}");
}

#[test]
fn a_thousand_calls_over_a_bad_network_are_executed_once_each_and_answered_right() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let relay = GroupRelay::start(Weather {
        lost: 0.05,
        doubled: 0.05,
        late: 0.05,
        delay: Duration::from_millis(150),
    });
    let _core = cell.roscore();
    let mut executor = cell.rospy_executor(&[&format!("files={SERVICE}")]);
    let other = format!("pubsub: {{address: \"opc.udp://{OTHER_GROUP}\"}}\n");
    let _bridges = (
        cell.bridge_ros1(&[&cell.call_mapping(1, "")]),
        cell.bridge_ros2(&[&cell.call_mapping(2, &other)]),
    );
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    let told = asker.ask(order("files", 0, 1000, 25));
    assert_eq!(told["right"], 1000, "{told}");
    each_once(&mut executor, 1000);
    assert!(relay.disturbed() > 200, "{}", relay.disturbed());
}

#[test]
fn a_service_that_is_killed_while_it_executes_is_told_and_what_was_before_and_comes_after_counts() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _core = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[]), cell.bridge_ros2(&[]));
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    let mut executor = cell.rospy_executor(&[&format!("empty={SERVICE}"), "--delay", "1000"]);
    asker.begin(order("empty", 0, 1, 1));
    running(&mut executor, 1);
    executor.child().signal(Signal::SIGKILL);
    let start = Instant::now();
    let told = asker.told();
    assert!(start.elapsed() < BOUND, "{:?}", start.elapsed());
    assert_eq!(
        (&told["right"], &told["wrongs"]),
        (&json!(0), &json!(1)),
        "{told}"
    );
    drop(executor);
    // The next executor with this name executes no request that was sent to the previous executor.
    let mut executor = cell.rospy_executor(&[&format!("empty={SERVICE}")]);
    let told = asker.ask(order("empty", 0, 3, 1));
    assert_eq!(told["right"], 3, "{told}");
    each_executed(&mut executor, 3);
}

fn each_executed(executor: &mut Counting, count: u64) {
    let counts = executor.counts();
    assert_eq!(counts["executed"], count, "{counts}");
}

#[test]
fn a_bridge_that_is_killed_while_it_executes_is_told_and_the_next_one_executes_nothing_again() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    // A call is lost when it was not announced for three periods.
    let [one, two] = [1, 2].map(|of| cell.call_mapping(of, "pubsub: {metadata_period: 1s}\n"));
    let _core = cell.roscore();
    let mut executor = cell.rospy_executor(&[&format!("files={SERVICE}"), "--delay", "1"]);
    let mut responder = cell.bridge_ros1(&[&one]);
    let _requestor = cell.bridge_ros2(&[&two]);
    let mut asker = cell.rclpy_asker(Distribution::Kilted);
    one_right(&mut asker, 0);
    // During the loss, the service continues, but its response is lost. Its type has no field for
    // that in ROS 2.
    let before = failed_calls();
    let mut slow = order("files", 1, 1, 1);
    slow["patience"] = json!(6);
    asker.begin(slow);
    running(&mut executor, 1);
    responder.signal(Signal::SIGKILL);
    responder.wait_for_end(SOON);
    eventually("the bridge counts a call that failed", BOUND, || {
        (failed_calls() > before).then_some(())
    });
    let told = asker.told();
    assert_eq!(told["failures"], 1, "{told}");
    each_once(&mut executor, 2);
    // After the loss, requests to the previous bridge are not executed by the next bridge, which
    // receives new requests as soon as it is trusted.
    let _responder = cell.bridge_ros1(&[&one]);
    let mut number = 2;
    eventually("a call of the next bridge is answered", SOON, || {
        let mut next = order("files", number, 1, 1);
        next["patience"] = json!(4);
        number += 1;
        (asker.ask(next)["right"] == 1).then_some(())
    });
    let counts = executor.counts();
    assert_eq!(
        (&counts["executed"], &counts["twice"]),
        (&json!(3), &json!([])),
        "{counts}"
    );
}

/// The time at which a bridge that executes a call is killed.
#[derive(Clone, Copy, PartialEq)]
enum Killed {
    /// The request is in the bridge's socket.
    Before,
    /// The bridge has executed the request, and its response is lost.
    After,
}

/// Checks that the next bridge receives the request, which is still repeated, and that the caller
/// is informed that the result is unknown.
fn a_killed_bridge_and_the_next_one_execute_once(killed: Killed) {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let relay = GroupRelay::start(Weather::FAIR);
    let one = cell.call_mapping(1, "");
    // A request is repeated for this time.
    let two = format!("pubsub: {{address: \"opc.udp://{OTHER_GROUP}\", receive_timeout: 40s}}\n");
    let two = cell.call_mapping(2, &two);
    let _core = cell.roscore();
    let mut executor = cell.rospy_executor(&[&format!("empty={SERVICE}")]);
    let mut responder = cell.bridge_ros1(&[&one]);
    let _requestor = cell.bridge_ros2(&[&two]);
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    assert_eq!(asker.ask(order("empty", 0, 1, 1))["right"], 1);
    let executed = match killed {
        Killed::Before => {
            responder.signal(Signal::SIGSTOP);
            let group = UadpSocket::join();
            asker.begin(order("empty", 0, 1, 1));
            eventually("the request is in the group", SOON, || {
                forged(&group.receive(Duration::from_millis(50))?, SERVICE_ID)
            });
            1
        }
        Killed::After => {
            relay.hush(true);
            asker.begin(order("empty", 0, 1, 1));
            eventually("it is executed", SOON, || {
                let counts = executor.counts();
                (counts["executed"] == 2 && counts["running"] == 0).then_some(())
            });
            2
        }
    };
    responder.signal(Signal::SIGKILL);
    responder.wait_for_end(SOON);
    let _responder = cell.bridge_ros1(&[&one]);
    announced(&cell, SERVICE);
    eventually("the next bridge has heard the request", SOON, || {
        let status = metrics(METRICS_ROS1)?;
        (system_tests::number(&status, "call_refused") > 0).then_some(())
    });
    relay.hush(false);
    let told = asker.told();
    assert_eq!(told["wrongs"], 1, "{told}");
    let why = told["wrong"][0].as_str().unwrap();
    assert!(
        why.contains("success=False") && why.contains("known"),
        "{why}"
    );
    each_executed(&mut executor, executed);
    // The announcement of the next bridge was lost, too. It is requested long before it is
    // repeated.
    let wait = Duration::from_secs(5);
    eventually("the next bridge executes", wait, || {
        (asker.ask(order("empty", 0, 1, 1))["right"] == 1).then_some(())
    });
    let told = asker.ask(order("empty", 0, 3, 1));
    assert_eq!(told["right"], 3, "{told}");
    each_executed(&mut executor, executed + 4);
}

#[test]
fn a_bridge_that_is_killed_before_it_executes_leaves_nothing_to_the_next_one() {
    a_killed_bridge_and_the_next_one_execute_once(Killed::Before);
}

#[test]
fn a_bridge_that_is_killed_before_its_answer_arrives_leaves_nothing_to_the_next_one() {
    a_killed_bridge_and_the_next_one_execute_once(Killed::After);
}

/// Returns the sum of `call_failed` in the status of bridge-ros2.
fn failed_calls() -> u64 {
    metrics(METRICS_ROS2).map_or(0, |status| system_tests::number(&status, "call_failed"))
}

#[test]
fn a_requestor_that_is_killed_has_its_calls_executed_once_and_the_next_one_is_not_mistaken_for_it()
{
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let [one, two] = [1, 2].map(|of| cell.call_mapping(of, ""));
    let _core = cell.roscore();
    let mut executor = cell.rospy_executor(&[&format!("files={SERVICE}"), "--delay", "2"]);
    let _responder = cell.bridge_ros1(&[&one]);
    let mut requestor = cell.bridge_ros2(&[&two]);
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    let mut twenty = order("files", 0, 20, 20);
    twenty["patience"] = json!(4);
    asker.begin(twenty);
    running(&mut executor, 20);
    requestor.signal(Signal::SIGKILL);
    requestor.wait_for_end(SOON);
    running(&mut executor, 0);
    each_once(&mut executor, 20);
    let _requestor = cell.bridge_ros2(&[&two]);
    assert_eq!(asker.told()["failures"], 20);
    // DDS considers a killed participant alive for a while, and clients that discovered it would
    // still send requests to it.
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    let told = asker.ask(order("files", 100, 5, 5));
    assert_eq!(told["right"], 5, "{told}");
    each_once(&mut executor, 25);
}

/// Waits until each requestor has `count` ended calls, and returns the ends.
fn ended(askers: &mut [CodecAsker], count: usize) -> Vec<Vec<CallEnd>> {
    let mut all = vec![Vec::new(); askers.len()];
    eventually("all calls end", SOON, || {
        for (asker, ended) in askers.iter_mut().zip(&mut all) {
            ended.extend(asker.turn().into_iter().map(|(_, ended)| ended));
        }
        (all.iter().map(Vec::len).sum::<usize>() == count).then_some(())
    });
    all
}

fn announced(cell: &Cell, service: &str) {
    eventually("the bridge executes the service", SOON, || {
        let status = metrics(METRICS_ROS1)?;
        status.to_string().contains(&service[1..]).then_some(())
    });
    // The folder is not needed, but the cell has to live as long as the calls in it.
    assert!(cell.folder().exists());
}

#[test]
fn two_requestors_with_equal_correlation_data_each_get_their_own_answer() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _core = cell.roscore();
    let mut executor = cell.rospy_executor(&[&format!("empty={SERVICE}"), "--delay", "0.3"]);
    let _responder = cell.bridge_ros1(&[]);
    announced(&cell, SERVICE);
    let mut askers = [CodecAsker::new(5, 7), CodecAsker::new(6, 7)];
    for asker in &mut askers {
        asker.call(SERVICE_ID, NOTHING, SOON);
    }
    for ended in ended(&mut askers, 2) {
        assert!(matches!(ended[..], [CallEnd::Answered(_)]), "{ended:?}");
    }
    each_executed(&mut executor, 2);
}

#[test]
fn an_answer_after_its_deadline_is_dropped_and_counted_and_answers_no_other_call() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _core = cell.roscore();
    let mut executor = cell.rospy_executor(&[&format!("empty={SERVICE}"), "--delay", "2"]);
    let _responder = cell.bridge_ros1(&[]);
    announced(&cell, SERVICE);
    let mut asker = [CodecAsker::new(5, 7)];
    asker[0].call(SERVICE_ID, NOTHING, Duration::from_secs(1));
    assert_eq!(ended(&mut asker, 1), [[CallEnd::Unknown]]);
    running(&mut executor, 0);
    asker[0].call(SERVICE_ID, NOTHING, SOON);
    let [ended] = &ended(&mut asker, 1)[..] else {
        panic!("one asker")
    };
    assert!(matches!(ended[..], [CallEnd::Answered(_)]), "{ended:?}");
    each_executed(&mut executor, 2);
}

/// Forges the response of the executor to a request, with `success` and `message`.
fn forged(datagram: &[u8], id: (u16, u16, u16)) -> Option<Vec<u8>> {
    let message = NetworkMessage::decode(datagram).ok()?;
    let requests = message.actions(ActionDialect::Standard).ok()?;
    let mut requests = requests.flatten();
    let request = requests.find(|request| {
        request.writer_id == id.2
            && request.action.kind == ActionKind::Request
            && request.state == ActionState::Executing
    })?;
    let fields = [&[3, 0, 1, 1, 12, 4, 0, 0, 0][..], b"lies", &[7, 1, 0, 0, 0]].concat();
    let address = ActionAddress::from(&request);
    let response = ActionToSend {
        address: &address,
        action: ActionHeader {
            correlation_data: request.action.correlation_data,
            requestor_id: request.action.requestor_id,
            ..ActionHeader::new(ActionKind::Response)
        },
        left: None,
        request_id: request.request_id,
        call: 0,
        state: ActionState::Done,
        status: Some(0),
        fields: ActionFields::Variants(&fields),
        dialect: ActionDialect::Standard,
    };
    let mut datagram = Vec::new();
    let (header, extras) = (NetworkHeader::default(), Extras::default());
    let encoder = response.encode(&mut datagram, &header, &extras).ok()?;
    encoder.finish().ok()?;
    Some(datagram)
}

#[test]
fn a_response_of_somebody_else_is_dropped_and_counted() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let id = (0, 7, 105);
    let executor = Executor::start(id, "gripper.Grasp.Start", Executes::Forever, 1);
    let group = UadpSocket::join();
    let _bridge = cell.bridge_ros2(&[]);
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    let mut asked = order("empty", 0, 1, 1);
    asked["service"] = json!("/ua_0_7_105");
    asker.begin(asked);
    let lie = eventually("the request is heard", SOON, || {
        forged(&group.receive(Duration::from_millis(50))?, id)
    });
    eventually("it is executed", SOON, || {
        (executor.executed() == 1).then_some(())
    });
    let before = metrics(METRICS_ROS2).as_ref().map_or(0, drops);
    for _ in 0..5 {
        send_from(Ipv4Addr::new(127, 0, 0, 2), &lie);
    }
    eventually("the lies are counted", SOON, || {
        (metrics(METRICS_ROS2).as_ref().map_or(0, drops) >= before + 5).then_some(())
    });
    executor.kill();
    let told = asker.told();
    assert_eq!(told["right"], 0, "{told}");
    let text = told["wrong"][0].as_str().unwrap();
    assert!(!text.contains("lies") && text.contains("known"), "{told}");
}

#[test]
fn slow_calls_do_not_delay_values_at_1_khz() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _core = cell.roscore();
    // The calls run until the executor is ordered to end them, which takes time on a loaded
    // machine.
    let mut executor = cell.rospy_executor(&["empty=/slow", "--delay", "1000"]);
    let plant = include_str!("../cells/plant.yaml");
    let slow = "
calls:
  - node: ns=2;i=61
    name: Slow
    origin: 1
    timeout: 80s
    ros:
      - {service: /slow, type: std_srvs/Trigger}
      - {space: 2, service: /slow, type: std_srvs/Trigger}
";
    let plant = cell.file("plant.yaml", &[plant, slow].concat());
    let plant = plant.to_str().unwrap();
    let _bridges = (cell.bridge_ros1(&[plant]), cell.bridge_ros2(&[plant]));
    let mut asker = cell.rclpy_asker(Distribution::Jazzy);
    let mut judge = cell.judge(Distribution::Jazzy, &["judge"]);
    let topic = "/ua_1_2_12";
    // The reader itself drops none of the values, even if it runs after the last one was sent.
    judge.ask(json!({"subscribe": topic, "type": "std_msgs/msg/String", "qos": {"depth": 5000}}));
    let args = [
        topic,
        "std_msgs/String",
        "--numbered",
        "4000",
        "--rate",
        "1000",
        "--warm-up",
        "\"warm-up\"",
    ];
    let mut sends = cell.rospy_started("ros1_pub.py", &args).told().start();
    judge.hears(topic, |value| (value["data"] == "warm-up").then_some(()));
    let mut calls = order("empty", 0, 200, 200);
    calls["service"] = json!("/slow");
    calls["patience"] = json!(85);
    asker.begin(calls);
    running(&mut executor, AT_ONCE);
    sends.tell("go");
    sends.wait_for_line("\"sent\"", SOON);
    // The calls have been running the whole time.
    assert_eq!(executor.counts()["running"], AT_ONCE);
    judge.hears(topic, |value| (value["data"] == "3999").then_some(()));
    let mut heard = judge.child().json_lines();
    heard.retain(|line| line["heard"] == topic && line["value"]["data"] != "warm-up");
    let numbers: Vec<u32> = heard
        .iter()
        .map(|line| line["value"]["data"].as_str().unwrap().parse().unwrap())
        .collect();
    assert_eq!(numbers, (0..4000).collect::<Vec<u32>>());
    executor.end();
    let told = asker.told();
    assert_eq!(told["right"], AT_ONCE, "{told}");
    assert_eq!(executor.counts()["executed"], AT_ONCE);
}

/// Number of slow calls of a service.
const AT_ONCE: u64 = 200;
/// An empty list of fields.
const NOTHING: &[u8] = &[0, 0];
