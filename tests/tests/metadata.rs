//! DataSetMetaData that bridges announce for their topics, as used by the bridge of the other ROS
//! and by asyncua.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, SERVER_ENDPOINT, eventually};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const TWIST: &str = "geometry_msgs/Twist";

const CELL: &str = r#"
spaces: [{id: 1}, {id: 2}]
namespaces: {2: urn:my-plant:line}
variables:
  - {node: ns=2;i=10, name: Speed, origin: 1, ros: {topic: /speed, type: geometry_msgs/Twist}}
  - node: ns=2;i=11
    name: Steer
    origin: 1
    ros:
      - {topic: /speed, type: geometry_msgs/Twist, fields: [linear.x, {field: angular.z, scale: 1000}]}
      - {space: 2, topic: /steer, type: geometry_msgs/Twist, fields: [linear.x, {field: angular.z, scale: 1000}]}
  - node: ns=2;i=12
    name: Area
    origin: 1
    ros:
      - {topic: /area, type: geometry_msgs/PolygonStamped, as: structure}
      - {space: 2, topic: /area, type: geometry_msgs/PolygonStamped, as: structure}
  - {node: ns=2;i=13, name: Velocity, origin: 1, unit: m/s, range: [-1, 1.5], ros: {topic: /speed, type: geometry_msgs/Twist, field: linear.x}}
  - {node: ns=2;i=14, name: Mode, origin: 1, enum: {0: idle, 1: moving}, ros: {topic: /mode, type: std_msgs/Int32}}
  - {node: ns=2;i=15, name: Fault, origin: 1, enum: {-1: none, 7: jammed}, ros: {topic: /fault, type: std_msgs/Int32}}
"#;

fn speed() -> Value {
    json!({"linear": {"x": 0.5, "y": 0.25, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": -0.125}})
}

fn area() -> Value {
    let point = |x: f64| json!({"x": x, "y": 0.5, "z": 0.0});
    json!({"header": {"frame_id": "floor"}, "polygon": {"points": [point(1.0), point(2.0)]}})
}

/// Starts a rospy node that publishes the value ten times a second.
fn in_ros1(cell: &Cell, topic: &str, kind: &str, value: &Value) -> Child {
    let (node, value) = (topic.replace('/', "_"), value.to_string());
    let repeat = ["--node", &node, "--repeat", "0", "--value", &value];
    cell.rospy("ros1_pub.py", &[&[topic, kind], &repeat[..]].concat())
}

fn value(line: &Value) -> Option<Value> {
    line.get("value").cloned()
}

#[test]
fn a_mapping_on_one_side_is_enough_for_a_type_both_sides_have() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let _master = cell.roscore();
    let _bridges = (
        cell.bridge_ros1(&[mapping.to_str().unwrap()]),
        cell.bridge_ros2(&[]),
    );
    let mut graph = cell.cyclone("ros2_graph.py", &["--domain", "2"]);
    let _sends = in_ros1(&cell, "/speed", TWIST, &speed());
    // No node of ROS 2 requested the type.
    let dds = json!("geometry_msgs::msg::dds_::Twist_");
    graph.wait_for_json("the topic in ROS 2 as a Twist", SOON, |line| {
        let writers = line["graph"]["publications"].as_object()?;
        let is_it = |one: &Value| one["topic"] == "rt/ua_1_2_10" && one["type"] == dds;
        writers.values().any(is_it).then_some(())
    });
    let mut heard = cell.cyclone("ros2_sub.py", &["/ua_1_2_10", TWIST, "--domain", "2"]);
    let got = heard.wait_for_json("the Twist in ROS 2", SOON, value);
    assert_eq!(got, speed());
}

#[test]
fn several_fields_and_structures_arrive_as_the_messages_they_are_of() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let mapping = mapping.to_str().unwrap();
    let _master = cell.roscore();
    let _bridges = (cell.bridge_ros1(&[mapping]), cell.bridge_ros2(&[mapping]));
    let polygon = "geometry_msgs/PolygonStamped";
    let mut steer = cell.cyclone("ros2_sub.py", &["/steer", TWIST, "--domain", "2"]);
    let mut areas = cell.cyclone("ros2_sub.py", &["/area", polygon, "--domain", "2"]);
    let _sends = (
        in_ros1(&cell, "/speed", TWIST, &speed()),
        in_ros1(&cell, "/area", polygon, &area()),
    );
    let got = steer.wait_for_json("two fields of the Twist in ROS 2", SOON, value);
    assert_eq!(got["linear"], json!({"x": 0.5, "y": 0.0, "z": 0.0}));
    assert_eq!(got["angular"]["z"], -0.125, "scaled there and back");
    let got = areas.wait_for_json("the structure in ROS 2", SOON, value);
    assert_eq!(got["polygon"], area()["polygon"]);
    assert_eq!(got["header"]["frame_id"], "floor");
}

#[test]
fn asyncua_reads_what_topics_consist_of_and_structures_by_it() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let _master = cell.roscore();
    let mut judge = cell.asyncua("uadp_metadata.py", &[]);
    let _bridge = cell.bridge_ros1(&[mapping.to_str().unwrap()]);
    let _sends = (
        in_ros1(&cell, "/speed", TWIST, &speed()),
        in_ros1(&cell, "/area", "geometry_msgs/PolygonStamped", &area()),
        in_ros1(&cell, "/mode", "std_msgs/Int32", &json!(1)),
        in_ros1(&cell, "/fault", "std_msgs/Int32", &json!(7)),
    );
    let mut of = |name: &str| {
        judge.wait_for_json(name, SOON, |line| {
            (line["topic_name"] == name).then(|| line.clone())
        })
    };
    let whole = of("ua_1_2_10");
    assert_eq!(
        (&whole["publisher"], &whole["writer"]),
        (&json!(1), &json!(10))
    );
    assert_eq!(whole["description"], TWIST);
    let names = |said: &Value| -> Vec<String> {
        let fields = said["fields"].as_array().unwrap();
        fields
            .iter()
            .map(|field| field["name"].as_str().unwrap().to_owned())
            .collect()
    };
    assert_eq!(names(&whole)[..2], ["linear.x", "linear.y"]);
    assert_eq!(whole["fields"][0]["data_type"], "i=11");
    assert_eq!(names(&of("ua_1_2_11")), ["linear.x", "angular.z"]);

    let velocity = &of("ua_1_2_13")["fields"][0]["properties"];
    let unit = "http://www.opcfoundation.org/UA/units/un/cefact";
    // The UnitId encodes the characters of "MTS".
    assert_eq!(
        velocity,
        &json!({"EngineeringUnits": [unit, 5_067_859, "m/s", "metre per second"], "EURange": [-1.0, 1.5], "RosTopics": ["1 /speed"], "Command": true})
    );
    let mode = &of("ua_1_2_14")["fields"][0]["properties"];
    assert_eq!(
        mode,
        &json!({"EnumStrings": ["idle", "moving"], "RosTopics": ["1 /mode"]})
    );
    let fault = &of("ua_1_2_15")["fields"][0]["properties"];
    assert_eq!(
        fault,
        &json!({"EnumValues": [[-1, "none"], [7, "jammed"]], "RosTopics": ["1 /fault"]})
    );

    let said = of("ua_1_2_12");
    assert_eq!(
        said["structures"],
        json!([
            "geometry_msgs/PolygonStamped",
            "std_msgs/Header",
            "geometry_msgs/Polygon",
            "geometry_msgs/Point32"
        ])
    );
    // A structure received before its description is shown as bytes.
    let values = judge.wait_for_json("the structure", SOON, |line| {
        let values = &line["values"];
        let is_told = line["topic"] == "ua_1_2_12" && values[0].get("polygon").is_some();
        is_told.then(|| values.clone())
    });
    let points = &values[0]["polygon"]["points"];
    assert_eq!(
        (&points[1]["x"], &points[1]["y"]),
        (&json!(2.0), &json!(0.5))
    );
    assert_eq!(values[0]["header"]["frame_id"], "floor");
}

#[test]
fn an_opc_ua_client_reads_unit_range_and_texts_beside_the_value() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let mapping = cell.file("cell.yaml", CELL);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let nodes = [
        "ns=2;s=13.EngineeringUnits",
        "ns=2;s=13.EURange",
        "ns=2;s=14.EnumStrings",
        "ns=2;s=15.EnumValues",
    ];
    let read = eventually("the server answers", SOON, || {
        cell.asyncua_try("opcua_read.py", &[&[SERVER_ENDPOINT], &nodes[..]].concat())
    });
    let values: Vec<String> = read.iter().map(|line| line["value"].to_string()).collect();
    for (value, part) in values
        .iter()
        .zip(["5067859", "High=1.5", "moving", "jammed"])
    {
        assert!(value.contains(part), "{part} in {value}");
    }
}

#[test]
fn asyncua_reads_what_the_values_are_that_clients_write() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let written = CELL.to_owned()
        + "  - {node: ns=2;i=20, name: Wanted, type: Double, origin: 0, unit: m/s, range: [0, 2]}\n  \
           - {node: ns=2;i=21, name: Command, origin: 0, ros: {space: 2, topic: /cmd_vel, type: geometry_msgs/Twist}}\n";
    let mapping = cell.file("cell.yaml", &written);
    let mut judge = cell.asyncua("uadp_metadata.py", &[]);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let mut of = |name: &str| {
        judge.wait_for_json(name, SOON, |line| {
            (line["topic_name"] == name).then(|| line.clone())
        })
    };
    let wanted = of("ua_0_2_20");
    assert_eq!(wanted["publisher"], 0);
    let field = &wanted["fields"][0];
    assert_eq!(
        (&field["name"], &field["type"]),
        (&json!("Wanted"), &json!(11))
    );
    assert_eq!(field["properties"]["EURange"], json!([0.0, 2.0]));
    let command = of("ua_0_2_21");
    assert_eq!(command["description"], TWIST);
    assert_eq!(command["fields"].as_array().unwrap().len(), 6);
}
