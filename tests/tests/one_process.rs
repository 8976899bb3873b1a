//! Both bridges and the server of a cell in one process.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{Cell, Child, METRICS_CELL, Peer, SERVER_ENDPOINT, eventually, metrics};

const SOON: Duration = Duration::from_secs(30);
const BOTH: &[Peer] = &[Peer::Ros1, Peer::Python];
const STRING: &str = "std_msgs/String";
const COUNT: usize = 100;
/// The metrics address of the bridge in a process of its own.
const METRICS_FOREIGN: &str = "127.0.0.1:9109";

/// Returns the part of a program in the status of the process.
fn part(program: &str) -> Option<Value> {
    let status = metrics(METRICS_CELL)?;
    let parts = status.as_array()?;
    parts
        .iter()
        .find(|part| part["program"] == program)
        .cloned()
}

/// Returns the reasons why a program is not ready, in one text.
fn hindrances(program: &str) -> Option<String> {
    let part = part(program)?;
    let reasons = part["not_ready"].as_array()?.iter();
    Some(
        reasons
            .filter_map(Value::as_str)
            .collect::<Vec<_>>()
            .join("; "),
    )
}

/// Returns the numbers that a subscriber received.
fn numbers_of(subscriber: &Child) -> Vec<String> {
    let values = subscriber.values().into_iter();
    let texts = values.filter_map(|value| value["data"].as_str().map(str::to_owned));
    texts.filter(|text| text != "warm").collect()
}

/// The arguments of a publisher that sends numbers when it is ordered to, and other texts until
/// then.
fn numbered(topic: &str) -> [&str; 8] {
    [
        topic,
        STRING,
        "--numbered",
        "100",
        "--rate",
        "100",
        "--warm-up",
        "\"warm\"",
    ]
}

/// Returns the number of datagrams that a program received twice, over all its topics.
fn duplicates(status: &Value) -> u64 {
    let topics = status["topics"].as_object().unwrap();
    let counts = topics
        .values()
        .map(|topic| topic["dropped"]["duplicate"].as_u64());
    counts.map(Option::unwrap_or_default).sum()
}

#[test]
fn values_cross_both_ways_in_one_process_and_a_foreign_bridge_receives_each_once() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let file = cell.file(
        "cell.yaml",
        "spaces: [{id: 1}, {id: 2}, {id: 3}]\nnamespaces: {5: urn:test}\nvariables:\n\
         \x20 - {node: ns=5;i=10, name: One, origin: 1, queue: {drop_oldest: 200}}\n\
         \x20 - {node: ns=5;i=11, name: Two, origin: 2, queue: {drop_oldest: 200}}\n",
    );
    let file = file.to_str().unwrap();
    let mut process = cell
        .ua_cell_started(&[file, "--only", "bridge-ros1,bridge-ros2"])
        .start();
    let foreign = ["--domain", "3"];
    let _foreign = cell
        .bridge_ros2_at(&[&[file][..], &foreign].concat(), METRICS_FOREIGN)
        .start();
    eventually("both bridges run", SOON, || {
        let running = |program| part(program).filter(|part| part["mapping"].is_object());
        running("bridge-ros1").and_then(|_| running("bridge-ros2"))
    });
    eventually("the foreign bridge runs", SOON, || metrics(METRICS_FOREIGN));

    let mut subscribers = [
        cell.rospy("ros1_sub.py", &["/ua_2_5_11", STRING]),
        cell.cyclone("ros2_sub.py", &["/ua_1_5_10", STRING, "--domain", "2"]),
        cell.cyclone("ros2_sub.py", &["/ua_1_5_10", STRING, "--domain", "3"]),
        cell.cyclone("ros2_sub.py", &["/ua_2_5_11", STRING, "--domain", "3"]),
    ];
    let mut publishers = [
        cell.rospy_started("ros1_pub.py", &numbered("/ua_1_5_10"))
            .told()
            .start(),
        cell.cyclone_started(
            "ros2_pub.py",
            &[&numbered("/ua_2_5_11")[..], &["--domain", "2"]].concat(),
        )
        .told()
        .start(),
    ];
    for subscriber in &mut subscribers {
        subscriber.wait_for_line("warm", SOON);
    }
    for publisher in &mut publishers {
        publisher.tell("");
    }
    let all: Vec<String> = (0..COUNT).map(|n| format!("{n}")).collect();
    for subscriber in &subscribers {
        eventually("all numbers arrive", SOON, || {
            (numbers_of(subscriber).len() >= COUNT).then_some(())
        });
    }
    for subscriber in &subscribers {
        assert_eq!(numbers_of(subscriber), all, "each number once and in order");
    }
    for status in [
        part("bridge-ros1").unwrap(),
        part("bridge-ros2").unwrap(),
        metrics(METRICS_FOREIGN).unwrap(),
    ] {
        assert_eq!(duplicates(&status), 0, "{status}");
    }
    // A value between two programs of the process is counted on both sides.
    let one = |program: &str, count: &str| {
        let part = part(program).unwrap();
        part["topics"]["ua_1_5_10"][count].as_u64().unwrap()
    };
    assert!(one("bridge-ros1", "sent") >= 100 && one("bridge-ros2", "delivered") >= 100);

    process.signal(Signal::SIGTERM);
    assert!(process.wait_for_end(SOON).success());
}

#[test]
fn a_missing_master_and_a_bad_mapping_leave_the_server_and_the_other_bridge_at_work() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let plant = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml"));
    let plant = plant.unwrap();
    let file = cell.file("cell.yaml", &plant);
    let mut process = cell.ua_cell_started(&[file.to_str().unwrap()]).start();
    let missing = eventually("the missing master is reported", SOON, || {
        hindrances("bridge-ros1").filter(|why| why.contains("master"))
    });
    assert!(!missing.is_empty());

    let mut in_ros2 = cell.cyclone(
        "ros2_sub.py",
        &["/ua_0_2_30", "std_msgs/Bool", "--domain", "2"],
    );
    let write = |value: &str| {
        let arguments = [SERVER_ENDPOINT, "ns=2;i=30", "Boolean", value];
        eventually("the server answers", SOON, || {
            cell.asyncua_try("opcua_write.py", &arguments)
        })[0]["status"]
            .clone()
    };
    let data =
        |wanted: bool| move |line: &Value| (line["value"] == json!({"data": wanted})).then_some(());
    write("true");
    in_ros2.wait_for_json("the switch in ROS 2", SOON, data(true));

    // A mapping that cannot run is refused by all programs, which keep the previous mapping.
    let _bad = cell.file("cell.yaml", "variables: 7\n");
    for program in ["bridge-ros1", "bridge-ros2", "ua-server"] {
        eventually("the mapping is refused", SOON, || {
            part(program).filter(|part| part["mapping"]["refused"] == 1)
        });
    }
    let _good = cell.file("cell.yaml", &plant);
    process.signal(Signal::SIGHUP);
    for program in ["bridge-ros1", "bridge-ros2", "ua-server"] {
        eventually("the mapping is good again", SOON, || {
            part(program).filter(|part| part["mapping"]["stale"].is_null())
        });
    }

    let _master = cell.roscore();
    let mut in_ros1 = cell.rospy("ros1_sub.py", &["/conveyor/switch", "std_msgs/Bool"]);
    eventually("the bridge meets the master", SOON, || {
        hindrances("bridge-ros1").filter(String::is_empty)
    });
    assert_eq!(write("false"), "Good");
    in_ros1.wait_for_json("the switch in ROS 1", SOON, data(false));
    in_ros2.wait_for_json("the switch in ROS 2", SOON, data(false));

    process.signal(Signal::SIGTERM);
    assert!(process.wait_for_end(SOON).success());
}

#[test]
fn a_program_that_cannot_start_is_shown_and_leaves_the_others_at_work() {
    let Some(cell) = Cell::with(BOTH) else {
        return;
    };
    let _master = cell.roscore();
    let plant = concat!(env!("CARGO_MANIFEST_DIR"), "/cells/plant.yaml");
    let _process = cell
        .ua_cell_started(&[plant, "--bridge-ros2", "--ros-interface absent0"])
        .start();
    let why = eventually("the missing interface is reported", SOON, || {
        hindrances("bridge-ros2").filter(|why| why.contains("absent0"))
    });
    assert!(why.contains("it is started again"), "{why}");
    let mut in_ros1 = cell.rospy("ros1_sub.py", &["/conveyor/switch", "std_msgs/Bool"]);
    let arguments = [SERVER_ENDPOINT, "ns=2;i=30", "Boolean", "true"];
    eventually("the server answers", SOON, || {
        cell.asyncua_try("opcua_write.py", &arguments)
    });
    in_ros1.wait_for_json("the switch in ROS 1", SOON, |line| {
        (line["value"] == json!({"data": true})).then_some(())
    });
}
