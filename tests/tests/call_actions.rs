//! Actions of ROS 2 across the space: clients of rclpy in a domain, servers of rclpy in another,
//! and a bridge in each domain.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Distribution, Judge, Peer, StartedChild, eventually, metrics, program,
};

/// The time that programs of ROS need to start on a busy machine.
const SOON: Duration = Duration::from_secs(60);
const SCRIPT: &str = "ros2_rclpy_action.py";
const OF_TWO: &str = "/ua_2_2_70";
/// The type name as `ros2 action` prints it.
const FIBONACCI: &str = "test_msgs/action/Fibonacci";

/// Starts the bridge of a space in a domain.
fn bridge(space: u16, domain: u16, args: &[&str]) -> Child {
    let name = format!("bridge_of_{space}");
    let address = format!("127.0.0.1:{}", 9200 + space);
    let (space, domain) = (space.to_string(), domain.to_string());
    let started = StartedChild::new(&name, &program("bridge-ros2"))
        .args(args)
        .args(["--domain", &domain, "--space", &space, "--interface", "lo"])
        .args(["--metrics", &address, "--ros-args", "-r"])
        .args([format!("__node:={name}")])
        .start();
    eventually("the bridge answers", SOON, || metrics(&address));
    started
}

fn rclpy(cell: &Cell, distribution: Distribution, domain: &str, args: &[&str]) -> StartedChild {
    cell.rclpy_started(distribution, SCRIPT, args)
        .env("ROS_DOMAIN_ID", domain)
        .told()
}

/// Starts a server in domain 2.
fn server(cell: &Cell, distribution: Distribution, action: &str) -> Child {
    let server = rclpy(cell, distribution, "2", &["serve", action]);
    server.start().ready(SOON)
}

/// Starts a server in domain 2 with a lease of three seconds.
fn mortal(cell: &Cell, action: &str) -> Child {
    let profile = cell.file(
        "lease.xml",
        r#"<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="lease" is_default_profile="true"><rtps><builtin><discovery_config>
    <leaseDuration><sec>3</sec></leaseDuration>
    <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
  </discovery_config></builtin></rtps></participant>
</profiles>"#,
    );
    rclpy(cell, Distribution::Jazzy, "2", &["serve", action])
        .env("FASTRTPS_DEFAULT_PROFILES_FILE", &profile)
        .env("FASTDDS_DEFAULT_PROFILES_FILE", &profile)
        .start()
        .ready(SOON)
}

/// Starts a client in domain 3 and waits until it has found a server.
fn client(cell: &Cell, distribution: Distribution, action: &str) -> Child {
    let args = ["call", action, "--results", "--wait", "50"];
    rclpy(cell, distribution, "3", &args).start().ready(SOON)
}

/// Returns the first line of a peer, printed before or after the call, with this value of `key`.
fn says(peer: &mut Child, key: &str, wanted: &Value) -> Value {
    let what = format!("{key} {wanted}");
    peer.wait_for_json(&what, SOON, |line| {
        (line.get(key)? == wanted).then(|| line.clone())
    })
}

/// Sends a cancel request and returns the client's report about it: the first new `cancel` line.
fn cancels(client: &mut Child, line: &str) -> Value {
    let told = |client: &Child| -> Vec<Value> {
        let lines = client.json_lines().into_iter();
        lines.filter(|line| line.get("cancel").is_some()).collect()
    };
    let before = told(client).len();
    client.tell(line);
    eventually(line, SOON, || told(client).get(before).cloned())
}

/// Sends goal `number`, and waits for its third feedback.
fn runs(client: &mut Child, number: usize, order: i32) {
    client.tell(&format!("send {order}"));
    assert_eq!(says(client, "goal", &json!(number))["accepted"], true);
    client.wait_for_json("the third feedback", SOON, |line| {
        (line.get("feedback")? == number && line["sequence"] == json!([1, 1, 2])).then_some(())
    });
}

/// Returns the status and the sequence of the result of goal `number`.
fn ended(client: &mut Child, number: usize) -> (String, Value) {
    let told = says(client, "result", &json!(number));
    let status = told["status"].as_str().unwrap().to_owned();
    (status, told["sequence"].clone())
}

fn feedback_of(client: &Child, number: usize) -> Vec<Value> {
    let lines = client.json_lines().into_iter();
    let of = lines.filter(|line| line.get("feedback") == Some(&json!(number)));
    of.map(|line| line["sequence"].clone()).collect()
}

fn goals_end_in_every_way(serving: Distribution, asking: Distribution) {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let _bridges = (bridge(2, 2, &[]), bridge(3, 3, &[]));
    let mut server = server(&cell, serving, OF_TWO);
    let mut client = client(&cell, asking, OF_TWO);
    client.tell("send 5");
    let succeeded = ("SUCCEEDED".to_owned(), json!([1, 1, 2, 3, 5]));
    assert_eq!(ended(&mut client, 0), succeeded);
    client.tell("send -1");
    assert_eq!(says(&mut client, "goal", &json!(1))["accepted"], false);
    client.tell("send -2");
    assert_eq!(ended(&mut client, 2), ("ABORTED".to_owned(), json!([])));
    // The server decides how a cancelled goal ends.
    for (number, order, end) in [
        (3, 100, "CANCELED"),
        (4, 110, "SUCCEEDED"),
        (5, 112, "ABORTED"),
    ] {
        runs(&mut client, number, order);
        let answer = cancels(&mut client, &format!("cancel {number}"));
        assert_eq!(
            answer,
            json!({"cancel": "NONE", "goals": [number]}),
            "{order}"
        );
        assert_eq!(
            ended(&mut client, number),
            (end.to_owned(), json!([1, 1, 2]))
        );
        let again = cancels(&mut client, &format!("cancel {number}"));
        assert_eq!(again["cancel"], "GOAL_TERMINATED");
    }
    // A client of rclpy drops unread feedback when the result arrives, so only the goals that kept
    // running have all feedback.
    let progress = [json!([1]), json!([1, 1]), json!([1, 1, 2])];
    for number in [3, 4, 5] {
        assert_eq!(feedback_of(&client, number), progress);
    }
    let unknown = cancels(&mut client, "cancel_unknown");
    assert_eq!(unknown["cancel"], "UNKNOWN_GOAL_ID");
    // A goal that refuses cancellation, and two goals that accept it.
    for (number, order) in [(6, 101), (7, 102), (8, 104)] {
        runs(&mut client, number, order);
    }
    assert_eq!(cancels(&mut client, "cancel 6")["goals"], json!([]));
    let all = cancels(&mut client, "cancel_all");
    assert_eq!(
        (&all["cancel"], &all["goals"]),
        (&json!("NONE"), &json!([7, 8]))
    );
    for number in [7, 8] {
        assert_eq!(ended(&mut client, number).0, "CANCELED");
    }
    assert!(
        client
            .json_lines()
            .iter()
            .all(|line| line.get("result") != Some(&json!(6)))
    );
    let goals: Vec<Value> = server
        .json_lines()
        .into_iter()
        .filter(|line| line.get("goal").is_some())
        .collect();
    assert_eq!(goals.len(), 9, "each goal is sent once: {goals:?}");
    // A server that leaves as rclpy does removes its goals and its action; the next server is
    // served again.
    server.tell("leave");
    assert_eq!(ended(&mut client, 6).0, "ABORTED");
    client.tell("gone");
    says(&mut client, "gone", &json!(true));
}

#[test]
fn goals_of_kilted_end_in_every_way_at_a_server_of_jazzy() {
    goals_end_in_every_way(Distribution::Jazzy, Distribution::Kilted);
}

#[test]
fn goals_of_jazzy_end_in_every_way_at_a_server_of_kilted() {
    goals_end_in_every_way(Distribution::Kilted, Distribution::Jazzy);
}

#[test]
fn a_goal_outlives_its_client_and_others_can_cancel_it() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let _bridges = (bridge(2, 2, &[]), bridge(3, 3, &[]));
    let mut server = server(&cell, Distribution::Jazzy, OF_TWO);
    let mut first = client(&cell, Distribution::Jazzy, OF_TWO);
    runs(&mut first, 0, 100);
    first.signal(Signal::SIGKILL);
    first.wait_for_end(SOON);
    let mut second = client(&cell, Distribution::Kilted, OF_TWO);
    runs(&mut second, 0, 2 + 100);
    let cancelled = |server: &Child, order: i32| {
        let lines = server.json_lines();
        lines
            .iter()
            .any(|line| line.get("cancel") == Some(&json!(order)))
    };
    assert!(!cancelled(&server, 100), "it goes on");
    let all = cancels(&mut second, "cancel_all");
    assert_eq!(all, json!({"cancel": "NONE", "goals": [null, 0]}));
    for order in [100, 102] {
        says(&mut server, "cancel", &json!(order));
    }
    assert_eq!(ended(&mut second, 0).0, "CANCELED");
}

#[test]
fn a_goal_whose_server_is_killed_is_aborted_and_the_next_server_is_asked() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let _bridges = (bridge(2, 2, &[]), bridge(3, 3, &[]));
    let mut killed = mortal(&cell, OF_TWO);
    let mut client = client(&cell, Distribution::Jazzy, OF_TWO);
    runs(&mut client, 0, 100);
    killed.signal(Signal::SIGKILL);
    killed.wait_for_end(SOON);
    assert_eq!(ended(&mut client, 0), ("ABORTED".to_owned(), json!([])));
    let _next = server(&cell, Distribution::Kilted, OF_TWO);
    let mut number = 1;
    eventually("a goal is reached at the next server", SOON, || {
        client.tell("send 3");
        let answer = says(&mut client, "goal", &json!(number));
        number += 1;
        (answer["accepted"] == true).then_some(())
    });
    assert_eq!(ended(&mut client, number - 1).0, "SUCCEEDED");
}

/// Waits until a node has these action servers.
fn serves(judge: &mut Judge, node: &str, actions: &Value) {
    judge.until(&json!({"nodes": 1}), |nodes| {
        nodes.as_array()?.contains(&json!(node)).then_some(())
    });
    judge.until(&json!({"info": node}), |info| {
        (info["action servers"] == *actions).then_some(())
    });
}

#[test]
fn of_two_bridges_in_one_domain_one_serves_an_action_and_a_goal_is_sent_once() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    let _bridges = (bridge(2, 2, &[]), bridge(3, 3, &[]), bridge(4, 3, &[]));
    let server = server(&cell, Distribution::Jazzy, OF_TWO);
    let judge = cell.rclpy_started(Distribution::Jazzy, "ros2_node.py", &["judge"]);
    let mut judge = Judge::of(judge.env("ROS_DOMAIN_ID", "3").told().start());
    serves(&mut judge, "/bridge_of_3", &json!([[OF_TWO, [FIBONACCI]]]));
    serves(&mut judge, "/bridge_of_4", &json!([]));
    let mut client = client(&cell, Distribution::Kilted, OF_TWO);
    for number in 0..5 {
        client.tell("send 2");
        assert_eq!(ended(&mut client, number).0, "SUCCEEDED");
    }
    let goals = server.json_lines();
    let goals = goals.iter().filter(|line| line.get("goal").is_some());
    assert_eq!(goals.count(), 5);
}

/// A mapping of the action Count, executed as `/count` in space 2 and served in space 3 according
/// to `asked`.
fn count(asked: &str) -> String {
    format!(
        "
spaces: [{{id: 2, domain: 2}}, {{id: 3, domain: 3}}]
namespaces: {{2: 'urn:test:count'}}
calls:
  - node: ns=2;i=70
    name: Count
    origin: 2
    ros:
      - {{action: /count, type: test_msgs/Fibonacci}}
      - {asked}
"
    )
}

#[test]
fn a_mapping_names_an_action_on_both_sides_and_what_its_goals_say() {
    let Some(cell) = Cell::with(&[Peer::Ros2]) else {
        return;
    };
    // The mapping requests three numbers, whatever the goal of the client.
    let three = "{space: 3, action: /three, type: test_msgs/Fibonacci, goal: {order: 3}}";
    let file = cell.file("cell.yaml", &count(three));
    let path = file.to_str().unwrap();
    let mut server = server(&cell, Distribution::Jazzy, "/count");
    let _bridges = (bridge(2, 2, &[path]), bridge(3, 3, &[path]));
    let mut mapped = client(&cell, Distribution::Kilted, "/three");
    mapped.tell("send 9");
    let three = json!([1, 1, 2]);
    assert_eq!(ended(&mut mapped, 0), ("SUCCEEDED".to_owned(), three));
    says(&mut server, "goal", &json!(3));
    // The mapping is reloaded: the action has another name, and its goals are the goals of the
    // clients.
    let any = "{space: 3, action: /any, type: test_msgs/Fibonacci}";
    let beside = file.with_extension("new");
    std::fs::write(&beside, count(any)).unwrap();
    std::fs::rename(beside, &file).unwrap();
    let mut any = client(&cell, Distribution::Jazzy, "/any");
    any.tell("send 2");
    assert_eq!(ended(&mut any, 0), ("SUCCEEDED".to_owned(), json!([1, 1])));
    mapped.tell("gone");
    says(&mut mapped, "gone", &json!(true));
}
