//! Parameters, simulated time, names and IPv6 with rosmaster, rosparam and rospy.

use std::collections::BTreeMap;
use std::time::Duration;

use bytes::Bytes;
use serde_json::{Value, json};
use system_tests::{Cell, Child, MASTER, Peer, UadpSocket, eventually, xml_rpc};
use tcpros::{
    Inbox, InboxEvent, MasterState, Node, NodeOptions, ParamSubscription, ParamValue,
    PublisherOptions, RequestedType, Ros1Time, SubscriberOptions, TopicType,
};
use tokio::runtime::Runtime;

const SOON: Duration = Duration::from_secs(30);
const ROS1: &[Peer] = &[Peer::Ros1];

/// A node of this process. It works in a separate thread, so a test may wait for peers meanwhile.
struct Ours {
    node: Option<Node>,
    runtime: Runtime,
}

impl Ours {
    fn start(words: &[&str]) -> Self {
        Self::with(words, &format!("http://{MASTER}"), "127.0.0.1", false)
    }

    fn with(words: &[&str], master: &str, address: &str, ipv6: bool) -> Self {
        // The runtime's threads are created by this thread, so they are in the network of the test.
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let mut options = NodeOptions::from_env("ours");
        options.master_uri = master.to_owned();
        options.namespace = "/".to_owned();
        options.ipv6 = ipv6;
        options.advertise_as(address);
        assert_eq!(options.apply_arguments(words).unwrap().len(), 0);
        let node = runtime.block_on(async { Node::start(options).unwrap() });
        let ours = Self {
            node: Some(node),
            runtime,
        };
        ours.reaches(MasterState::Registered);
        ours
    }

    fn node(&self) -> &Node {
        self.node.as_ref().unwrap()
    }

    fn reaches(&self, wanted: MasterState) {
        let state = self.node().master_state();
        eventually(&format!("{wanted:?}"), SOON, || {
            (*state.borrow() == wanted).then_some(())
        });
    }

    fn get(&self, name: &str) -> Option<ParamValue> {
        let parameters = self.node().parameters();
        self.runtime.block_on(parameters.get(name)).unwrap()
    }

    fn set(&self, name: &str, value: impl Into<ParamValue>) {
        let parameters = self.node().parameters();
        self.runtime.block_on(parameters.set(name, value)).unwrap();
    }

    fn subscribe(&self, name: &str) -> ParamSubscription {
        self.node().parameters().subscribe(name).unwrap()
    }

    fn shut_down(mut self) {
        if let Some(node) = self.node.take() {
            self.runtime.block_on(node.shutdown());
        }
    }
}

impl Drop for Ours {
    fn drop(&mut self) {
        let _inside = self.runtime.enter();
        drop(self.node.take());
    }
}

fn rosparam(cell: &Cell, args: &[&str]) -> String {
    let mut child = cell.ros1_started("bin/rosparam", args).start();
    let status = child.wait_for_end(SOON);
    assert!(status.success(), "rosparam {args:?} ended with {status}");
    child.lines().join("\n")
}

/// Orders the rospy node to do something, and waits until it is done.
fn tell(peer: &mut Child, asked: &Value) -> Value {
    peer.tell(&asked.to_string());
    peer.wait_for_json("it is done", SOON, |line| {
        (line.get("asked") == Some(asked)).then(|| line["value"].clone())
    })
}

fn becomes(subscription: &ParamSubscription, value: Option<ParamValue>) {
    let name = subscription.name().to_owned();
    eventually(&format!("{name} is {value:?}"), SOON, || {
        (subscription.current() == value).then_some(())
    });
}

fn map(members: &[(&str, ParamValue)]) -> ParamValue {
    let owned = members.iter().map(|(n, v)| ((*n).to_owned(), v.clone()));
    ParamValue::Map(owned.collect::<BTreeMap<_, _>>())
}

fn string() -> TopicType {
    TopicType {
        name: "std_msgs/String".to_owned(),
        md5sum: "992ce8a1687cec8c8bd883ec73ca41d1".to_owned(),
        definition: "string data\n".to_owned(),
    }
}

/// Returns a `std_msgs/String` as bytes.
fn text(text: &str) -> Bytes {
    let length = u32::try_from(text.len()).unwrap().to_le_bytes();
    Bytes::from([&length, text.as_bytes()].concat())
}

fn graph() -> String {
    xml_rpc(MASTER, "getSystemState", &["/system_tests"]).unwrap()
}

#[test]
fn rosparam_reads_every_kind_of_value_that_we_set() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start(&[]);
    let inner = map(&[("deep", map(&[("er", 3.into())])), ("empty", "".into())]);
    let all = map(&[
        ("flag", true.into()),
        ("count", (-5).into()),
        ("ratio", 0.25.into()),
        ("text", "a <b> & ä".into()),
        (
            "list",
            ParamValue::List(vec![1.into(), 2.5.into(), "x".into()]),
        ),
        ("inner", inner),
    ]);
    ours.set("/all", all.clone());
    for (name, read) in [
        ("/all/flag", "true"),
        ("/all/count", "-5"),
        ("/all/ratio", "0.25"),
        ("/all/text", "a <b> & "),
        ("/all/inner/deep/er", "3"),
    ] {
        assert!(rosparam(&cell, &["get", name]).contains(read), "{name}");
    }
    let listed = rosparam(&cell, &["list"]);
    assert!(listed.contains("/all/inner/deep/er") && !listed.contains("/all/inner/deep\n"));
    // rosparam dumps the parameters that we set, and loads them again.
    let dump = cell.folder().join("dump.yaml");
    let dump = dump.to_str().unwrap();
    rosparam(&cell, &["dump", dump, "/all"]);
    rosparam(&cell, &["delete", "/all"]);
    assert_eq!(ours.get("/all"), None);
    rosparam(&cell, &["load", dump, "/again"]);
    assert_eq!(ours.get("/again"), Some(all));
}

#[test]
fn we_read_every_kind_of_value_that_rosparam_sets() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start(&[]);
    let file = cell.file(
        "theirs.yaml",
        "flag: false\ncount: 2147483647\nratio: 1.0e-3\ntext: '5'\nlist: [1, [true, x]]\n\
         bytes: !!binary aGn/\nwhen: 2026-11-21 23:59:59\ninner: {deep: {er: 3}}\n",
    );
    rosparam(&cell, &["load", file.to_str().unwrap(), "/theirs"]);
    let nested = ParamValue::List(vec![true.into(), "x".into()]);
    let theirs = map(&[
        ("flag", false.into()),
        ("count", i32::MAX.into()),
        ("ratio", 0.001.into()),
        ("text", "5".into()),
        ("list", ParamValue::List(vec![1.into(), nested])),
        ("bytes", ParamValue::Binary(b"hi\xff".to_vec())),
        ("when", ParamValue::DateTime("20261121T23:59:59".to_owned())),
        ("inner", map(&[("deep", map(&[("er", 3.into())]))])),
    ]);
    assert_eq!(ours.get("/theirs"), Some(theirs));
    assert_eq!(ours.get("/theirs/inner/deep/er"), Some(3.into()));
    let deleted = ours
        .runtime
        .block_on(ours.node().parameters().delete("/theirs/inner"));
    assert!(deleted.unwrap());
    assert!(!rosparam(&cell, &["list"]).contains("/theirs/inner"));
}

#[test]
fn a_subscribed_parameter_follows_rospy_and_a_restart_of_the_master() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let master = cell.roscore();
    let ours = Ours::start(&["_rate:=5"]);
    let mut rospy = cell
        .rospy_started("ros1_params.py", &[])
        .told()
        .start()
        .ready(SOON);
    let (gains, p) = (ours.subscribe("/gains"), ours.subscribe("/gains/p"));
    tell(
        &mut rospy,
        &json!({"set": "/gains", "value": {"p": 1.5, "i": 2}}),
    );
    becomes(&gains, Some(map(&[("p", 1.5.into()), ("i", 2.into())])));
    becomes(&p, Some(1.5.into()));
    tell(&mut rospy, &json!({"set": "/gains/p", "value": "off"}));
    becomes(&gains, Some(map(&[("p", "off".into()), ("i", 2.into())])));
    becomes(&p, Some("off".into()));
    tell(&mut rospy, &json!({"delete": "/gains/i"}));
    becomes(&gains, Some(map(&[("p", "off".into())])));
    tell(&mut rospy, &json!({"delete": "/gains"}));
    becomes(&gains, None);
    becomes(&p, None);
    // Our subscription also receives the values that we set ourselves, and rospy reads them.
    ours.set("/gains/p", 4);
    becomes(&p, Some(4.into()));
    assert_eq!(tell(&mut rospy, &json!({"get": "/gains"})), json!({"p": 4}));
    let found = ours
        .runtime
        .block_on(ours.node().parameters().search("gains"));
    assert_eq!(found.unwrap().as_deref(), Some("/gains"));
    let found = tell(&mut rospy, &json!({"search": "gains"}));
    assert_eq!(found, json!("/gains"));

    drop(master);
    ours.reaches(MasterState::Awaited);
    let _master = cell.roscore();
    ours.reaches(MasterState::Registered);
    becomes(&p, None);
    tell(&mut rospy, &json!({"set": "/gains", "value": {"p": 7}}));
    becomes(&p, Some(7.into()));
    assert_eq!(rosparam(&cell, &["get", "/ours/rate"]), "5");
    // After the node has unsubscribed and shut down, the master does not know it.
    drop((gains, p));
    ours.shut_down();
    let gone = xml_rpc(MASTER, "lookupNode", &["/system_tests", "/ours"]).unwrap();
    assert!(gone.contains("-1"), "{gone}");
}

#[test]
fn time_is_that_of_a_rospy_clock_while_use_sim_time_is_true() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let master = cell.roscore();
    let ours = Ours::start(&[]);
    let mut rospy = cell
        .rospy_started("ros1_params.py", &[])
        .told()
        .start()
        .ready(SOON);
    assert!(!ours.node().clock().is_simulated());
    rosparam(&cell, &["set", "/use_sim_time", "true"]);
    let simulated = |wanted: bool| {
        eventually(&format!("simulated: {wanted}"), SOON, || {
            (ours.node().clock().is_simulated() == wanted).then_some(())
        });
    };
    simulated(true);
    let mut time_is = |secs: u32, nsecs: u32| {
        tell(&mut rospy, &json!({"clock": [secs, nsecs]}));
        eventually("the time", SOON, || {
            (ours.node().now() == Ros1Time { secs, nsecs }).then_some(())
        });
    };
    time_is(1000, 5);
    time_is(3, 999_999_999);
    // Time stands still from here on, but the node still detects that the master is lost and
    // returns.
    drop(master);
    ours.reaches(MasterState::Awaited);
    assert_eq!(ours.node().now().secs, 3);
    let _master = cell.roscore();
    ours.reaches(MasterState::Registered);
    simulated(false);
    // A node that starts in a simulation has simulated time as soon as it is registered.
    rosparam(&cell, &["set", "/use_sim_time", "true"]);
    simulated(true);
    let late = Ours::start(&["__name:=late"]);
    assert!(late.node().clock().is_simulated());
    assert_eq!(late.node().now(), Ros1Time::default());
    rosparam(&cell, &["set", "/use_sim_time", "false"]);
    simulated(false);
}

#[test]
fn a_rospy_node_of_our_name_has_us_leave_without_losing_anything_of_its_own() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let ours = Ours::start(&[]);
    let asked = ours.node().shutdown_requested();
    let held = ours.runtime.block_on(async {
        let options = PublisherOptions::default();
        ours.node().advertise("/t", string(), options).unwrap()
    });
    eventually("our topic", SOON, || graph().contains("/t<").then_some(()));
    let before = cell.slave_api("/ours").unwrap();

    let mut twin = cell.rospy(
        "ros1_pub.py",
        &[
            "/t",
            "std_msgs/String",
            "--node",
            "ours",
            "--value",
            "\"x\"",
            "--repeat",
            "0",
        ],
    );
    let reason = ours.runtime.block_on(asked);
    assert!(reason.contains("/ours"), "{reason}");
    drop(held);
    ours.shut_down();
    let after = cell.slave_api("/ours").unwrap();
    assert_ne!(before, after);
    assert!(graph().contains("/t<"), "{}", graph());
    assert!(twin.runs());
    let listener = Ours::start(&["__name:=listener"]);
    let mut inbox: Inbox<()> = Inbox::new();
    let _heard = listener.runtime.block_on(async {
        let options = SubscriberOptions::default();
        listener
            .node()
            .subscribe("/t", RequestedType::default(), options, (), &inbox)
            .unwrap()
    });
    assert_eq!(
        listener.runtime.block_on(next_message(&mut inbox)),
        text("x")
    );
}

async fn next_message(inbox: &mut Inbox<()>) -> Bytes {
    let message = async {
        loop {
            if let ((), InboxEvent::Message(message)) = inbox.recv().await {
                return message.bytes;
            }
        }
    };
    tokio::time::timeout(SOON, message).await.unwrap()
}

#[test]
fn private_parameters_namespace_and_remappings_of_the_bridge_are_seen_in_the_graph() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    let _master = cell.roscore();
    let group = UadpSocket::join();
    let bridge = cell.bridge_ros1(&[
        concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml"),
        "__ns:=/line",
        "__name:=cell",
        "_rate:=5",
        "_frame:=map",
        "_gains:={p: 0.5, on: true}",
        "/arm/joint_states:=/robot/joint_states",
        "__log:=/nowhere/x.log",
    ]);
    eventually("the remapped topic", SOON, || {
        let graph = graph();
        (graph.contains("/robot/joint_states") && graph.contains("/line/cell")).then_some(())
    });
    assert!(!graph().contains("/arm/joint_states"));
    assert_eq!(rosparam(&cell, &["get", "/line/cell/rate"]), "5");
    assert_eq!(rosparam(&cell, &["get", "/line/cell/frame"]), "map");
    assert_eq!(rosparam(&cell, &["get", "/line/cell/gains/p"]), "0.5");
    assert_eq!(rosparam(&cell, &["get", "/line/cell/gains/on"]), "true");
    assert!(bridge.lines().iter().all(|line| !line.contains("ignored")));
    group.drain();
    let _robot = cell.rospy(
        "ros1_pub.py",
        &[
            "/robot/joint_states",
            "sensor_msgs/JointState",
            "--value",
            "{\"name\": [\"remapped_joint\"]}",
            "--repeat",
            "0",
        ],
    );
    eventually("the value on the group", SOON, || {
        let datagram = group.receive(Duration::from_millis(100))?;
        let name = b"remapped_joint";
        datagram
            .windows(name.len())
            .any(|part| part == name)
            .then_some(())
    });
}

#[test]
fn a_word_that_remaps_no_name_ends_the_bridge_with_a_usage_error() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    for word in ["/a:=1b", "_rate:=3000000000"] {
        let mut bridge = cell.bridge_ros1_started(&[word]).start();
        assert_eq!(bridge.wait_for_end(SOON).code(), Some(64));
        assert!(
            bridge.lines().iter().any(|line| line.contains(word)),
            "{bridge}"
        );
    }
}

#[test]
fn topics_go_to_and_from_rospy_over_ipv6() {
    let Some(cell) = Cell::with(ROS1) else {
        return;
    };
    const URI: &str = "http://[::1]:11311";
    let _master = cell
        .ros1_started("bin/rosmaster", &["--core", "-p", "11311"])
        .env("ROS_IPV6", "on")
        .env("ROS_HOSTNAME", "::1")
        .env("ROS_MASTER_URI", URI)
        .start();
    let ours = Ours::with(&[], URI, "::1", true);
    let publisher = ours.runtime.block_on(async {
        let options = PublisherOptions {
            latch: true,
            ..Default::default()
        };
        ours.node().advertise("/down", string(), options).unwrap()
    });
    assert_eq!(publisher.publish(text("down")).sent_to, 0);
    let mut inbox: Inbox<()> = Inbox::new();
    let _heard = ours.runtime.block_on(async {
        let options = SubscriberOptions::default();
        ours.node()
            .subscribe("/up", RequestedType::default(), options, (), &inbox)
            .unwrap()
    });
    let rospy = |script: &str, args: &[&str]| {
        cell.rospy_started(script, args)
            .env("ROS_IPV6", "on")
            .env("ROS_HOSTNAME", "::1")
            .env("ROS_MASTER_URI", URI)
            .start()
            .ready(SOON)
    };
    let mut sub = rospy("ros1_sub.py", &["/down", "std_msgs/String"]);
    let heard = sub.wait_for_json("the message", SOON, |line| line.get("value").cloned());
    assert_eq!(heard, json!({"data": "down"}));
    let up = ["/up", "std_msgs/String", "--latch", "--value", "\"up\""];
    let _talker = rospy("ros1_pub.py", &up);
    assert_eq!(ours.runtime.block_on(next_message(&mut inbox)), text("up"));
}
