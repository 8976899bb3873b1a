//! bridge-ros1 in a graph that changes while it runs.

use std::time::{Duration, Instant};

use bytes::Bytes;
use serde_json::json;
use system_tests::{Cell, Child, MASTER, Peer, UaSide, eventually};
use tcpros::{Node, NodeOptions, Publisher, PublisherOptions, TopicType};
use tokio::runtime::Runtime;
use uadp::Scalar;

const SOON: Duration = Duration::from_secs(30);

const PATTERNS: &str = r#"
spaces: [{id: 1}]
namespaces: {2: "urn:cell"}
patterns:
  - {topics: "/robot*/temperature", exclude: ["/robot9/**"], origin: 1, node: "ns=2;i=10{1}", name: "Robot{1}Temperature", field: data}
"#;

/// A node of this process in a cell's graph.
struct OwnNode {
    runtime: Runtime,
    node: Node,
}

impl OwnNode {
    fn start(name: &str) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()
            .unwrap();
        let mut options = NodeOptions::from_env(name);
        options.master_uri = format!("http://{MASTER}");
        options.advertise_as("127.0.0.1");
        let entered = runtime.enter();
        let node = Node::start(options).unwrap();
        drop(entered);
        Self { runtime, node }
    }

    fn latched(&self, topic: &str, topic_type: TopicType, message: &[u8]) -> Publisher {
        let _entered = self.runtime.enter();
        let options = PublisherOptions {
            latch: true,
            ..PublisherOptions::default()
        };
        let publisher = self.node.advertise(topic, topic_type, options).unwrap();
        assert_eq!(
            publisher
                .publish(Bytes::copy_from_slice(message))
                .dropped_oldest,
            0
        );
        publisher
    }
}

fn float32() -> TopicType {
    TopicType {
        name: "std_msgs/Float32".to_owned(),
        md5sum: "73fcbf46b49191e672908e50842a83d4".to_owned(),
        definition: "float32 data\n".to_owned(),
    }
}

fn lines(bridge: &Child, part: &str) -> usize {
    bridge.lines().iter().filter(|l| l.contains(part)).count()
}

#[test]
fn topics_that_appear_while_the_bridge_runs_cross_without_a_restart() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let side = UaSide::join();
    let _bridge = cell.bridge_ros1(&[]);
    let node = OwnNode::start("late");
    for id in 1..=5u16 {
        let start = Instant::now();
        let _publisher = node.latched(&format!("/ua_1_2_{id}"), float32(), &[0; 4]);
        side.hear_scalar((1, 2, id), Scalar::Float(0.0));
        println!(
            "ua_1_2_{id}: heard {:?} after it was advertised",
            start.elapsed()
        );
    }
}

#[test]
fn topics_of_a_pattern_become_values_as_they_appear() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let side = UaSide::join();
    let mapping = cell.file("patterns.yaml", PATTERNS);
    let bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    let node = OwnNode::start("robots");
    let _excluded = node.latched("/robot9/temperature", float32(), &[0; 4]);
    let _first = node.latched("/robot1/temperature", float32(), &[0; 4]);
    side.hear_scalar((1, 2, 101), Scalar::Float(0.0));
    let _second = node.latched("/robot2/temperature", float32(), &[0; 4]);
    side.hear_scalar((1, 2, 102), Scalar::Float(0.0));
    let heard = side.triples_for(Duration::from_secs(2));
    assert!(heard.contains(&(1, 2, 101)) && !heard.contains(&(1, 2, 109)));

    // A name from which the pattern gets no number is logged, and does not affect other names.
    let _odd = node.latched("/robot_b/temperature", float32(), &[0; 4]);
    eventually("the odd name is told of", SOON, || {
        (lines(&bridge, "/robot_b/temperature") > 0).then_some(())
    });
    side.hear_scalar((1, 2, 101), Scalar::Float(0.0));
    assert_eq!(lines(&bridge, "/robot_b/temperature"), 1, "told once");
}

#[test]
fn a_type_that_cannot_be_read_is_named_once_with_the_reason() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let side = UaSide::join();
    let bridge = cell.bridge_ros1(&[]);
    let node = OwnNode::start("odd");
    let unreadable = TopicType {
        name: "odd_msgs/Odd".to_owned(),
        md5sum: "0".repeat(32),
        definition: "missing_msgs/Thing thing\n".to_owned(),
    };
    let odd = node.latched("/ua_1_2_1", unreadable.clone(), &[0; 4]);
    eventually("the reason is told", SOON, || {
        (lines(&bridge, "missing_msgs/Thing") > 0).then_some(())
    });
    // The topic comes and goes, and is not logged again.
    drop(odd);
    for _ in 0..3 {
        let _odd = node.latched("/ua_1_2_1", unreadable.clone(), &[0; 4]);
        let _good = node.latched("/ua_1_2_2", float32(), &[0; 4]);
        side.hear_scalar((1, 2, 2), Scalar::Float(0.0));
    }
    assert_eq!(lines(&bridge, "missing_msgs/Thing"), 1);
}

#[test]
fn headers_of_messages_made_of_one_field_carry_the_time_of_the_graph() {
    let Some(cell) = Cell::with(&[Peer::Ros1]) else {
        return;
    };
    let _master = cell.roscore();
    let mut simulation = cell
        .rospy_started("ros1_params.py", &[])
        .told()
        .start()
        .ready(SOON);
    simulation.tell(r#"{"set": "/use_sim_time", "value": true}"#);
    simulation.tell(r#"{"clock": [1234, 5]}"#);
    let mapping = cell.file(
        "stamp.yaml",
        r#"
spaces: [{id: 1}]
namespaces: {2: "urn:cell"}
variables:
  - node: ns=2;i=5
    name: Rate
    type: Double
    origin: 0
    ros: {space: 1, topic: /rate, type: sensor_msgs/Imu, field: angular_velocity.z}
"#,
    );
    let _bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    let heard = cell.rospy("ros1_sub.py", &["/rate", "sensor_msgs/Imu"]);
    let mut side = UaSide::join();
    let mut rate = 0.0;
    let stamp = eventually("a message with the simulated time", SOON, || {
        rate += 1.0;
        side.write((0, 2, 5), Scalar::Double(rate));
        std::thread::sleep(Duration::from_millis(50));
        let values = heard.values();
        let stamps = values.iter().map(|value| value["header"]["stamp"].clone());
        stamps.into_iter().find(|stamp| stamp["secs"] == 1234)
    });
    assert_eq!(stamp, json!({"secs": 1234, "nsecs": 5}));
}
