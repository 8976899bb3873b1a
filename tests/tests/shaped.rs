//! Parts of messages, structures and converted values, with real peers on both ends and checks of
//! the UADP messages between them.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, UaSide, eventually};
use uadp::{ExtensionBody, Scalar, Variant};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];

/// The same patterns for both ROS, numbered from 100 for topics of ROS 1 and from 600 for topics of
/// ROS 2. The patterns of ROS 2 are bound by the types of their topics.
const PATTERNS: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:test}
patterns:
  - {topics: "/robot*/joints", origin: 1, node: "ns=2;i=10{1}", name: "Elbow{1}", type: sensor_msgs/JointState, field: "position[name=elbow]", scale: 1000}
  - {topics: "/robot*/gate", origin: 1, node: "ns=2;i=20{1}", name: "Closed{1}", type: std_msgs/Bool, field: data, invert: true}
  - {topics: "/robot*/speed", origin: 1, node: "ns=2;i=30{1}", name: "Speed{1}", type: geometry_msgs/Twist, fields: [{field: linear.x, scale: 100}, angular.z]}
  - {topics: "/robot*/goal", origin: 1, node: "ns=2;i=40{1}", name: "Goal{1}", type: geometry_msgs/Twist, as: structure}
  - {topics: "/robot*/effort", origin: 1, node: "ns=2;i=50{1}", name: "Effort{1}", type: sensor_msgs/JointState, field: "effort[1:3]", scale: 0.5, offset: 1}
  - {topics: "/robot*/turn", origin: 1, node: "ns=2;i=55{1}", name: "Turn{1}", type: geometry_msgs/Twist, fields: [linear.x, angular.z]}
  - {topics: "/robot*/stamped", origin: 1, node: "ns=2;i=56{1}", name: "Stamped{1}", type: geometry_msgs/TwistStamped, fields: [twist.linear.x, twist.angular.z]}
  - {topics: "/arm*/stamped", origin: 2, node: "ns=2;i=98{1}", name: "ArmStamped{1}", fields: [twist.linear.x, twist.angular.z]}
  - {topics: "/arm*/joints", origin: 2, node: "ns=2;i=60{1}", name: "ArmElbow{1}", field: "position[name=elbow]", scale: 1000}
  - {topics: "/arm*/gate", origin: 2, node: "ns=2;i=70{1}", name: "ArmClosed{1}", field: data, invert: true}
  - {topics: "/arm*/speed", origin: 2, node: "ns=2;i=80{1}", name: "ArmSpeed{1}", fields: [{field: linear.x, scale: 100}, angular.z]}
  - {topics: "/arm*/goal", origin: 2, node: "ns=2;i=90{1}", name: "ArmGoal{1}", as: structure}
  - {topics: "/arm*/effort", origin: 2, node: "ns=2;i=95{1}", name: "ArmEffort{1}", field: "effort[1:3]", scale: 0.5, offset: 1}
  - {topics: "/arm*/turn", origin: 2, node: "ns=2;i=97{1}", name: "ArmTurn{1}", fields: [linear.x, angular.z]}
"#;

fn twist() -> Value {
    json!({"linear": {"x": 0.25, "y": 1.0, "z": 2.0}, "angular": {"x": 3.0, "y": 4.0, "z": -0.5}})
}

/// The message made of the fields `linear.x` and `angular.z`.
fn turn() -> Value {
    json!({"linear": {"x": 0.25, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.5}})
}

/// Returns the parts of a robot's topics that match the patterns: topic, type and value.
fn robot() -> [(&'static str, &'static str, Value); 6] {
    let joints = "sensor_msgs/JointState";
    let twists = "geometry_msgs/Twist";
    [
        (
            "joints",
            joints,
            json!({"name": ["wrist", "elbow"], "position": [9.0, 1.25]}),
        ),
        ("gate", "std_msgs/Bool", json!(true)),
        ("speed", twists, twist()),
        ("goal", twists, twist()),
        ("turn", twists, twist()),
        (
            "effort",
            joints,
            json!({"effort": [100.0, 8.0, 16.0, 100.0]}),
        ),
    ]
}

fn in_ros1(cell: &Cell, topic: &str, kind: &str, value: &Value) -> Child {
    let (node, value) = (topic.replace('/', "_"), value.to_string());
    let args = ["--node", &node, "--repeat", "0", "--value", &value];
    cell.rospy("ros1_pub.py", &[&[topic, kind][..], &args].concat())
}

fn in_ros2(cell: &Cell, topic: &str, kind: &str, value: &Value) -> Child {
    let value = value.to_string();
    let args = ["--domain", "2", "--repeat", "0", "--value", &value];
    cell.cyclone("ros2_pub.py", &[&[topic, kind][..], &args].concat())
}

fn heard_in_ros1(cell: &Cell, topic: &str, kind: &str) -> Child {
    let node = format!("hears{}", topic.replace('/', "_"));
    cell.rospy("ros1_sub.py", &[topic, kind, "--node", &node])
}

fn heard_in_ros2(cell: &Cell, topic: &str, kind: &str) -> Child {
    cell.cyclone("ros2_sub.py", &[topic, kind, "--domain", "2"])
}

/// Waits until the peer has that value.
fn has(peer: &Child, expected: &Value) {
    eventually(&format!("the peer has {expected}"), SOON, || {
        let values = peer.values();
        values.contains(expected).then_some(())
    });
}

fn scalars(ua: &UaSide, triple: (u16, u16, u16), expected: &[Scalar<'_>]) {
    ua.hear(triple, &format!("{expected:?}"), |fields| {
        let found = fields.iter().zip(expected);
        let same = found.fold(fields.len() == expected.len(), |same, (found, expected)| {
            same && matches!(found, Variant::Scalar(found) if found == expected)
        });
        same.then_some(())
    });
}

/// Checks the UADP values of a robot, by the numbers of its variables.
fn carried(ua: &UaSide, space: u16, [elbow, closed, speed, goal, effort, turn]: [u16; 6]) {
    scalars(ua, (space, 2, elbow), &[Scalar::Double(1250.0)]);
    scalars(ua, (space, 2, closed), &[Scalar::Boolean(false)]);
    let both = [Scalar::Double(25.0), Scalar::Double(-0.5)];
    scalars(ua, (space, 2, speed), &both);
    let both = [Scalar::Double(0.25), Scalar::Double(-0.5)];
    scalars(ua, (space, 2, turn), &both);
    let doubles = [0.25, 1.0, 2.0, 3.0, 4.0, -0.5].map(f64::to_le_bytes);
    ua.hear((space, 2, goal), "one structure", |fields| match fields {
        [Variant::Scalar(Scalar::ExtensionObject(structure))] => {
            let ExtensionBody::Binary(body) = structure.body else {
                return None;
            };
            assert_eq!(body, doubles.concat());
            Some(())
        }
        _ => None,
    });
    let parts = [Scalar::Double(5.0), Scalar::Double(9.0)];
    ua.hear((space, 2, effort), "two of four", |fields| match fields {
        [Variant::Array(array)] => {
            let found: Vec<Scalar<'_>> = array.iter().collect();
            assert_eq!(found, parts);
            Some(())
        }
        _ => None,
    });
}

#[test]
fn what_patterns_take_of_messages_reaches_the_peers_of_the_other_side() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let file = cell.file("cell.yaml", PATTERNS);
    let file = file.to_str().unwrap();
    let _bridges = (cell.bridge_ros1(&[file]), cell.bridge_ros2(&[file]));
    let ua = UaSide::join();
    let elbow = heard_in_ros2(&cell, "/ua_1_2_101", "std_msgs/Float64");
    let closed = heard_in_ros2(&cell, "/ua_1_2_201", "std_msgs/Bool");
    let goal = heard_in_ros2(&cell, "/ua_1_2_401", "geometry_msgs/Twist");
    let turned = heard_in_ros2(&cell, "/ua_1_2_551", "geometry_msgs/Twist");
    let _robot = robot().map(|(name, kind, value)| {
        let topic = format!("/robot1/{name}");
        in_ros1(&cell, &topic, kind, &value)
    });
    carried(&ua, 1, [101, 201, 301, 401, 501, 551]);
    has(&elbow, &json!({"data": 1250.0}));
    has(&closed, &json!({"data": false}));
    has(&goal, &twist());
    has(&turned, &turn());

    let elbow = heard_in_ros1(&cell, "/ua_2_2_601", "std_msgs/Float64");
    let closed = heard_in_ros1(&cell, "/ua_2_2_701", "std_msgs/Bool");
    let goal = heard_in_ros1(&cell, "/ua_2_2_901", "geometry_msgs/Twist");
    let turned = heard_in_ros1(&cell, "/ua_2_2_971", "geometry_msgs/Twist");
    let _arm = robot().map(|(name, kind, value)| {
        let topic = format!("/arm1/{name}");
        in_ros2(&cell, &topic, kind, &value)
    });
    carried(&ua, 2, [601, 701, 801, 901, 951, 971]);
    has(&elbow, &json!({"data": 1250.0}));
    has(&closed, &json!({"data": false}));
    has(&goal, &twist());
    has(&turned, &turn());
}

/// The subscriber starts before the value is known, so the value sent then is not the whole
/// message.
#[test]
fn a_header_that_is_no_part_of_the_value_is_stamped_by_the_bridge() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let file = cell.file("cell.yaml", PATTERNS);
    let file = file.to_str().unwrap();
    let _bridges = (cell.bridge_ros1(&[file]), cell.bridge_ros2(&[file]));
    let kind = "geometry_msgs/TwistStamped";
    let sent = json!({"twist": twist()});
    let stamp = |reader: &Child| {
        eventually("the twist has come", SOON, || {
            let values = reader.values();
            let value = values.iter().find(|value| value["twist"] == turn())?;
            Some(value["header"]["stamp"].clone())
        })
    };
    let in_two = heard_in_ros2(&cell, "/ua_1_2_561", kind);
    let in_one = heard_in_ros1(&cell, "/ua_2_2_981", kind);
    let _robot = in_ros1(&cell, "/robot1/stamped", kind, &sent);
    assert!(stamp(&in_two)["sec"].as_i64() > Some(0));
    let _arm = in_ros2(&cell, "/arm1/stamped", kind, &sent);
    assert!(stamp(&in_one)["secs"].as_i64() > Some(0));
}

/// A service with converted request and response, in both ROS; the numbers for ROS 2 are higher by
/// twenty.
const SERVICES: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:test}
type_paths: [types]
variables:
  - {node: ns=2;i=1, name: Move, origin: 0, queue: {drop_oldest: 10}, ros: {space: 1, call: /move, type: robot_msgs/Move, fields: [{field: speed, scale: 1000, out_of_range: refuse}, {field: dry, invert: true}], request: {mode: slow}}}
  - {node: ns=2;i=2, name: Moved, origin: 1, ros: [{answer: ns=2;i=1, field: refused, invert: true}, {space: 2, topic: /moved, type: std_msgs/Bool}]}
  - {node: ns=2;i=3, name: Took, origin: 1, type: Int32, ros: [{answer: ns=2;i=1, field: took, scale: 1000, out_of_range: clamp}, {space: 2, topic: /took, type: std_msgs/Float64, scale: 1000}]}
  - {node: ns=2;i=4, name: Code, origin: 1, ros: {answer: ns=2;i=1, fields: ["codes[1]", {field: took, scale: 2}]}}
  - {node: ns=2;i=21, name: Move2, origin: 0, queue: {drop_oldest: 10}, ros: {space: 2, call: /move, type: robot_msgs/Move, fields: [{field: speed, scale: 1000, out_of_range: refuse}, {field: dry, invert: true}], request: {mode: slow}}}
  - {node: ns=2;i=22, name: Moved2, origin: 2, ros: [{answer: ns=2;i=21, field: refused, invert: true}, {space: 1, topic: /moved, type: std_msgs/Bool}]}
  - {node: ns=2;i=23, name: Took2, origin: 2, type: Int32, ros: [{answer: ns=2;i=21, field: took, scale: 1000, out_of_range: clamp}, {space: 1, topic: /took, type: std_msgs/Float64, scale: 1000}]}
  - {node: ns=2;i=24, name: Code2, origin: 2, ros: {answer: ns=2;i=21, fields: ["codes[1]", {field: took, scale: 2}]}}
"#;

const MOVE: &str = "float32 speed
bool dry
string mode
---
bool refused
int32[] codes
float64 took
";

#[test]
fn what_services_are_asked_and_answer_is_converted_on_the_way() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let types = cell.folder().join("types/robot_msgs/srv");
    std::fs::create_dir_all(&types).unwrap();
    std::fs::write(types.join("Move.srv"), MOVE).unwrap();
    let file = cell.file("cell.yaml", SERVICES);
    let file = file.to_str().unwrap();
    let _bridges = (cell.bridge_ros1(&[file]), cell.bridge_ros2(&[file]));
    let mut ua = UaSide::join();
    let answer = json!({"refused": true, "codes": [7, -8, 9], "took": 1.5}).to_string();
    let types = cell.folder().join("types");
    let definitions = types.to_str().unwrap();
    let asked = json!({"speed": 0.25, "dry": true, "mode": "slow"});
    let values = [Scalar::Float(250.0), Scalar::Boolean(false)];
    let (moved, took) = (json!({"data": false}), json!({"data": 1.5}));

    let args = ["/move", "robot_msgs/Move", definitions, "--answer", &answer];
    let server = cell.rospy("ros1_answer.py", &args);
    let heard = ["/moved", "/took"].map(|topic| {
        let kind = if topic == "/moved" {
            "std_msgs/Bool"
        } else {
            "std_msgs/Float64"
        };
        (
            heard_in_ros1(&cell, topic, kind),
            heard_in_ros2(&cell, topic, kind),
        )
    });
    ua.write_fields((0, 2, 1), &values);
    scalars(&ua, (1, 2, 2), &[Scalar::Boolean(false)]);
    scalars(&ua, (1, 2, 3), &[Scalar::Int32(1500)]);
    scalars(&ua, (1, 2, 4), &[Scalar::Int32(-8), Scalar::Double(3.0)]);
    has(&server, &asked);
    assert_eq!(server.values().len(), 1);
    has(&heard[0].1, &moved);
    has(&heard[1].1, &took);

    let args = ["serve", "/move", "robot_msgs/Move", "--domain", "2"];
    let args = [&args[..], &["--answer", &answer]].concat();
    let server = cell.cyclone("ros2_service.py", &args);
    ua.write_fields((0, 2, 21), &values);
    scalars(&ua, (2, 2, 22), &[Scalar::Boolean(false)]);
    scalars(&ua, (2, 2, 23), &[Scalar::Int32(1500)]);
    scalars(&ua, (2, 2, 24), &[Scalar::Int32(-8), Scalar::Double(3.0)]);
    has(&server, &asked);
    assert_eq!(server.values().len(), 1);
    has(&heard[0].0, &moved);
    has(&heard[1].0, &took);
}
