//! The tools of ROS 1, and roscpp and rosrust nodes, with a node of `tcpros`.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use serde_json::json;
use system_tests::{Cell, Child, Peer, eventually};
use tcpros::Publisher;
use tokio::task::JoinHandle;

use crate::ros1::support::{Ros1Node, SOON, string, string_type, twist, twist_type};

const PERIOD: Duration = Duration::from_millis(20);
/// Messages per topic in a bag.
const RECORDED: u8 = 10;
const TRIPS: u32 = 50;

/// Publishes a `Twist` fifty times a second, with an increasing forward speed.
fn driving(ours: &Ros1Node, publisher: &Arc<Publisher>) -> JoinHandle<()> {
    let publisher = Arc::clone(publisher);
    ours.runtime.spawn(async move {
        let mut ticks = tokio::time::interval(PERIOD);
        for number in 0u32.. {
            ticks.tick().await;
            // Delivered to the present subscribers.
            let _published = publisher.publish(twist(f64::from(number)));
        }
    })
}

/// Returns the output of a tool that ends by itself.
fn said(mut tool: Child) -> String {
    tool.wait_for_end(SOON);
    tool.lines().join("\n")
}

fn shows(printed: &str, expected: &[&str]) {
    for text in expected {
        assert!(printed.contains(text), "no `{text}` in:\n{printed}");
    }
}

/// Requirement: the slave API answers all requests of `rosnode` and `rostopic`, and the topics work
/// with all their measurements.
#[test]
fn the_tools_of_ros_see_and_hear_a_node() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let chatter = ours.advertise("/chatter", string_type(), true);
    let cmd = Arc::new(ours.advertise("/cmd", twist_type(), false));
    let mut heard = ours.subscribe("/in");
    let _sent = chatter.publish(string("greeting"));
    let _driving = driving(&ours, &cmd);
    eventually("the registration", SOON, || {
        ours.is_registered().then_some(())
    });
    let rostopic = |args: &[&str]| cell.ros1_started("bin/rostopic", args).start();
    let rosnode = |args: &[&str]| cell.ros1_started("bin/rosnode", args).start();

    let mut hz = rostopic(&["hz", "/cmd"]);
    let mut bw = rostopic(&["bw", "/cmd"]);
    let put = rostopic(&["pub", "-1", "/in", "std_msgs/String", "data: back"]);
    let echo = rostopic(&["echo", "-n", "1", "/chatter"]);
    assert_eq!(heard.next("what rostopic published").bytes, string("back"));
    shows(&said(echo), &["data: \"greeting\""]);
    hz.wait_for_line("average rate: ", SOON);
    bw.wait_for_line("average: ", SOON);

    let (nodes, topics) = (rosnode(&["list"]), rostopic(&["list"]));
    shows(&said(nodes), &["/ours"]);
    shows(&said(topics), &["/chatter", "/cmd", "/in"]);
    let (info, kind) = (rostopic(&["info", "/chatter"]), rostopic(&["type", "/cmd"]));
    shows(
        &said(info),
        &[
            "Type: std_msgs/String",
            "Publishers:",
            " * /ours (http://127.0.0.1:",
        ],
    );
    shows(&said(kind), &["geometry_msgs/Twist"]);
    let (found, ping) = (
        rostopic(&["find", "geometry_msgs/Twist"]),
        rosnode(&["ping", "-c", "2", "/ours"]),
    );
    shows(&said(found), &["/cmd"]);
    shows(
        &said(ping),
        &["xmlrpc reply from http://127.0.0.1:", "ping average"],
    );
    let info = said(rosnode(&["info", "/ours"]));
    shows(
        &info,
        &[
            " * /chatter [std_msgs/String]",
            " * /cmd [geometry_msgs/Twist]",
            &format!("Pid: {}", std::process::id()),
            " * topic: /cmd",
            "    * to: /rostopic_",
            "    * direction: outbound (",
            "    * transport: TCPROS",
        ],
    );
    assert!(!info.contains("direction: unknown"), "{info}");
    said(put);

    shows(&said(rosnode(&["kill", "/ours"])), &["killed"]);
    let asked = ours.node().shutdown_requested();
    ours.runtime.block_on(asked);
    ours.end();
    let left = said(rosnode(&["list"]));
    assert!(!left.contains("/ours"), "{left}");
}

/// Requirement: the connection header has the type, its definition and the latching that `rosbag`
/// records. A node that publishes and subscribes to a topic receives the messages of other nodes
/// only.
#[test]
fn a_bag_has_all_a_topic_says_and_plays_it_back() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let chatter = ours.advertise("/chatter", string_type(), true);
    let cmd = ours.advertise("/cmd", twist_type(), false);
    let mut heard = ours.subscribe("/cmd");
    let mut latched = ours.subscribe("/chatter");
    let _sent = chatter.publish(string("greeting"));
    let path = cell.folder().join("ours.bag");
    let path = path.to_str().unwrap();

    let count = RECORDED.to_string();
    let record = ["-O", path, "-l", &count, "/chatter", "/cmd"];
    let mut record = cell.ros1_started("lib/rosbag/record", &record).start();
    eventually("rosbag listens", SOON, || {
        (cmd.subscribers() == 1 && chatter.subscribers() == 1).then_some(())
    });
    for number in 0..RECORDED {
        let _sent = cmd.publish(twist(f64::from(number)));
        if number > 0 {
            let _sent = chatter.publish(string("later"));
        }
    }
    assert!(record.wait_for_end(SOON).success());

    let mut bag = cell.rospy_started("ros1_bag.py", &[path]).start();
    assert!(bag.wait_for_end(SOON).success());
    let lines = bag.json_lines();
    for (topic, kind, latching) in [
        ("/chatter", string_type(), "1"),
        ("/cmd", twist_type(), "0"),
    ] {
        let connection = lines.iter().find(|line| line["topic"] == topic).unwrap();
        assert_eq!(connection["type"], json!(kind.name));
        assert_eq!(connection["md5sum"], json!(kind.md5sum));
        assert_eq!(connection["definition"], json!(kind.definition));
        assert_eq!(connection["callerid"], "/ours");
        assert_eq!(connection["latching"], latching);
    }
    let values = |topic: &str| -> Vec<_> {
        let of = lines.iter().filter(|line| line["message"] == topic);
        of.map(|line| line["value"].clone()).collect()
    };
    let greetings = values("/chatter");
    assert_eq!(greetings.len(), RECORDED as usize);
    assert_eq!(greetings[0], json!({"data": "greeting"}));
    let speeds = values("/cmd");
    assert_eq!(speeds.len(), RECORDED as usize);
    assert_eq!(speeds[9]["linear"]["x"], 9.0);
    assert!(heard.try_next().is_none() && latched.try_next().is_none());

    let mut play = cell
        .ros1_started("lib/rosbag/play", &["-q", "-d", "1", path])
        .start();
    for number in 0..RECORDED {
        let message = heard.next("what rosbag plays");
        assert_eq!(message.bytes, twist(f64::from(number)));
        assert!(
            message.peer.caller_id.starts_with("/play_"),
            "{:?}",
            message.peer
        );
    }
    let message = latched.next("the latched message rosbag plays");
    assert_eq!(message.bytes, string("greeting"));
    assert!(message.peer.header.latching());
    play.wait_for_end(SOON);
}

/// Requirement: small messages are sent at once and whole, with their type, through nodes of
/// roscpp.
#[test]
fn roscpp_relays_and_throttles_stand_on_either_side() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let cmd = Arc::new(ours.advertise("/cmd", twist_type(), false));
    let (mut relayed, mut slowed) = (ours.subscribe("/relayed"), ours.subscribe("/slowed"));
    let _relay = cell.topic_tools_relay("/cmd", "/relayed");
    let _throttle = cell
        .ros1_started(
            "lib/topic_tools/throttle",
            &["messages", "/cmd", "5", "/slowed"],
        )
        .start();
    let driving = driving(&ours, &cmd);

    // The type is the type of the publisher before the relay, and the first relayed message has
    // arrived by then.
    let first = relayed.next("a relayed message");
    let header = &first.peer.header;
    assert_eq!(header.type_name(), Some("geometry_msgs/Twist"));
    assert_eq!(header.md5sum(), Some(twist_type().md5sum.as_str()));
    assert_eq!(
        header.message_definition(),
        Some(twist_type().definition.as_str())
    );
    let number = f64::from_le_bytes(first.bytes[..8].try_into().unwrap());
    assert_eq!(relayed.next("the one after it").bytes, twist(number + 1.0));
    assert_eq!(slowed.next("a throttled message").bytes.len(), 48);
    driving.abort();

    // Round trips through roscpp, one at a time: a delay by Nagle's algorithm would show as 40 ms
    // each.
    while relayed.try_next().is_some() {}
    let started = Instant::now();
    for number in 0..TRIPS {
        let _sent = cmd.publish(twist(-f64::from(number)));
        let _back = relayed.next("the message back");
    }
    let took = started.elapsed();
    println!("{TRIPS} round trips through roscpp: {took:?}");
    assert!(took < TRIPS * Duration::from_millis(30), "{took:?}");
}

/// Requirement: topics cross in both directions with a node of a third implementation.
#[test]
fn rosrust_hears_a_node_and_is_heard() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ros1Node::start("ours");
    let chatter = ours.advertise("/chatter", string_type(), false);
    let mut heard = ours.subscribe("/from_rosrust");
    let _sends = cell.rosrust(&["pub", "/from_rosrust", "hello"]);
    assert_eq!(heard.next("rosrust's").bytes, string("hello"));

    let mut hears = cell.rosrust(&["sub", "/chatter"]);
    eventually("rosrust is connected", SOON, || {
        (chatter.subscribers() == 1).then_some(())
    });
    let _sent = chatter.publish(string("to rosrust"));
    let line = hears.wait_for_json("our message", SOON, |line| {
        line.get("value").map(|_| line.clone())
    });
    assert_eq!(line["value"]["data"], "to rosrust");
    assert_eq!(line["callerid"], "/ours");
}
