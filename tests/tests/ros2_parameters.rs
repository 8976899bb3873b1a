//! The parameters of the bridge's node, in requests of `ros2 param` on the middleware of each
//! vendor.

use std::time::Duration;

use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::parameters::{DeclaredParameter, ParameterServer, ParameterValue};
use ros2_node::service::ServicePeers;
use serde_json::{Value, json};
use system_tests::{Cell, Child, METRICS_ROS2, Peer, eventually, metrics, number};

const SOON: Duration = Duration::from_secs(20);
const NODE: &str = "/ua_bridge_ros2";

/// Calls a parameter service of the bridge through Cyclone DDS.
fn ask(cell: &Cell, service: &str, kind: &str, request: &Value) -> Value {
    let service = format!("{NODE}/{service}");
    let kind = format!("rcl_interfaces/{kind}");
    let request = request.to_string();
    let mut client: Child = cell.cyclone(
        "ros2_service.py",
        &[
            "call", &service, &kind, "--domain", "2", "--value", &request,
        ],
    );
    client.wait_for_json("a reply", SOON, |line| line.get("value").cloned())
}

#[test]
fn cyclone_lists_describes_and_gets_the_parameters_of_the_bridge() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&[]);
    let listed = ask(&cell, "list_parameters", "ListParameters", &json!({}));
    assert_eq!(
        listed["result"]["names"],
        json!(["domain", "space", "use_sim_time"])
    );
    let names = json!({"names": ["space", "use_sim_time"]});
    let described = ask(&cell, "describe_parameters", "DescribeParameters", &names);
    let read_only = |at: usize| described["descriptors"][at]["read_only"].clone();
    assert_eq!((read_only(0), read_only(1)), (json!(true), json!(true)));
    let types = ask(&cell, "get_parameter_types", "GetParameterTypes", &names);
    assert_eq!(types["types"], json!([2, 1]));
    let space = |cell: &Cell| {
        let got = ask(cell, "get_parameters", "GetParameters", &names);
        got["values"][0]["integer_value"].clone()
    };
    assert_eq!(space(&cell), json!(2));
    // As in rclpy, the response is empty if any of the names is not declared, and `ros2 param get`
    // prints "Parameter not set".
    let names = json!({"names": ["space", "nothing"]});
    for (service, kind, list) in [
        ("describe_parameters", "DescribeParameters", "descriptors"),
        ("get_parameter_types", "GetParameterTypes", "types"),
        ("get_parameters", "GetParameters", "values"),
    ] {
        let told = ask(&cell, service, kind, &names);
        assert_eq!(told[list], json!([]), "{service}");
    }
}

/// Calls a parameter service of the bridge through Fast DDS. Request and reply are hexadecimal
/// digits of CDR.
fn call(cell: &Cell, service: &str, kind: &str, request: &str) -> String {
    let service = format!("{NODE}/{service}");
    let kind = format!("rcl_interfaces/{kind}");
    let mut client = cell.fastdds(&["call", &service, &kind, "--hex", request]);
    client.wait_for_json("a reply", SOON, |line| {
        Some(line.get("reply")?.as_str()?.to_owned())
    })
}

fn hex(text: &str) -> String {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

/// Sets a parameter to true.
fn set_true(cell: &Cell, name: &str) -> String {
    // A single parameter, its name, and a value of type 1 that is true; the rest of the value is
    // empty.
    let mut request = format!("01000000{:02x}000000{}00", name.len() + 1, hex(name));
    // The type and the Boolean follow the text directly.
    request.push_str("0101");
    request.push_str(&"00".repeat(64));
    call(cell, "set_parameters", "SetParameters", &request)
}

#[test]
fn fast_dds_lists_and_gets_the_parameters_of_the_bridge_and_is_told_that_none_can_be_set() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&["--use-sim-time"]);
    let call = |service: &str, kind: &str, request: &str| call(&cell, service, kind, request);
    // No prefixes, any depth.
    let all = call("list_parameters", "ListParameters", &"0".repeat(32));
    for name in ["domain", "space", "use_sim_time"] {
        assert!(all.contains(&hex(name)), "{all}");
    }
    // A single result: not successful, and the reason.
    for name in ["use_sim_time", "space"] {
        let refused = set_true(&cell, name);
        assert!(refused.starts_with("0100000000"), "{refused}");
        assert!(refused.contains(&hex("read-only")), "{refused}");
    }
    let got = call(
        "get_parameters",
        "GetParameters",
        &format!("010000000d000000{}00", hex("use_sim_time")),
    );
    // A single value: of type 1, true.
    assert!(got.starts_with("010000000101"), "{got}");
}

/// The bridge's own parameters cannot be set, so this test runs a similar node with a parameter
/// that can be set.
#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn who_listens_to_parameter_events_is_told_what_was_set_and_of_which_node() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::FastDds]) else {
        return;
    };
    let domain = Domain::join(&DomainOptions {
        domain: 2,
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node: "ua_bridge_ros2".into(),
        enclave: None,
    })
    .unwrap();
    let peers = ServicePeers::new(&domain);
    let parameter = |name: &str, read_only| DeclaredParameter {
        name: name.to_owned(),
        value: ParameterValue::Bool(false),
        description: String::new(),
        read_only,
    };
    let declared = vec![parameter("enabled", false), parameter("fixed", true)];
    let server = ParameterServer::open(&domain, &peers, declared).unwrap();
    let event = ["/parameter_events", "rcl_interfaces/ParameterEvent"];
    let mut listener = cell.cyclone("ros2_sub.py", &[&event[..], &["--domain", "2"]].concat());
    listener.wait_for_line("\"ready\"", SOON);
    // The listener may not be matched yet at the first attempt.
    let heard = eventually("an event", SOON, || {
        // A single result each: not successful, and successful.
        assert!(set_true(&cell, "fixed").starts_with("0100000000"));
        assert!(set_true(&cell, "enabled").starts_with("0100000001"));
        listener.values().first().cloned()
    });
    assert_eq!(server.value("enabled"), Some(ParameterValue::Bool(true)));
    assert_eq!(heard["node"], NODE);
    let changed = heard["changed_parameters"].as_array().unwrap();
    assert_eq!(changed.len(), 1, "{heard}");
    assert_eq!(changed[0]["name"], "enabled");
    assert_eq!(changed[0]["value"]["type"], 1);
    assert_eq!(changed[0]["value"]["bool_value"], true);
    assert_eq!(heard["new_parameters"], json!([]));
    assert!(heard["stamp"]["sec"].as_i64().unwrap() > 1_600_000_000);
}

#[test]
fn a_request_that_is_none_is_counted_in_the_status() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&[]);
    // A sequence of two billion missing names, which gets no answer.
    let service = format!("{NODE}/get_parameters");
    let kind = "rcl_interfaces/GetParameters";
    let _client = cell.fastdds(&["call", &service, kind, "--hex", "ffffff7f"]);
    eventually("the request is counted", SOON, || {
        let status = metrics(METRICS_ROS2)?;
        (number(&status["others"], "malformed") == 1).then_some(())
    });
}
