//! The parameters of the bridge's node, as `ros2 param` of either vendor asks for them.

use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer};

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
    let names = json!({"names": ["space", "use_sim_time", "nothing"]});
    let described = ask(&cell, "describe_parameters", "DescribeParameters", &names);
    let read_only = |at: usize| described["descriptors"][at]["read_only"].clone();
    assert_eq!((read_only(0), read_only(1)), (json!(true), json!(true)));
    let types = ask(&cell, "get_parameter_types", "GetParameterTypes", &names);
    assert_eq!(types["types"], json!([2, 1, 0]));
    let space = |cell: &Cell| {
        let got = ask(cell, "get_parameters", "GetParameters", &names);
        got["values"][0]["integer_value"].clone()
    };
    assert_eq!(space(&cell), json!(2));
}

#[test]
fn fast_dds_lists_and_gets_the_parameters_of_the_bridge_and_is_told_that_none_can_be_set() {
    let Some(cell) = Cell::with(&[Peer::FastDds]) else {
        return;
    };
    let _bridge = cell.bridge_ros2(&["--use-sim-time"]);
    let call = |service: &str, kind: &str, request: &str| {
        let service = format!("{NODE}/{service}");
        let kind = format!("rcl_interfaces/{kind}");
        let mut client = cell.fastdds(&["call", &service, &kind, "--hex", request]);
        client.wait_for_json("a reply", SOON, |line| {
            Some(line.get("reply")?.as_str()?.to_owned())
        })
    };
    let hex = |text: &str| -> String { text.bytes().map(|byte| format!("{byte:02x}")).collect() };
    // No prefixes, any depth.
    let all = call("list_parameters", "ListParameters", &"0".repeat(32));
    for name in ["domain", "space", "use_sim_time"] {
        assert!(all.contains(&hex(name)), "{all}");
    }
    // One parameter, its name, and a value of type 1 that is true; the rest of the value is empty.
    let set = |name: &str| {
        let mut request = format!("01000000{:02x}000000{}00", name.len() + 1, hex(name));
        // The type and the Boolean follow the text at once.
        request.push_str("0101");
        request.push_str(&"00".repeat(64));
        call("set_parameters", "SetParameters", &request)
    };
    // One result: not successful, and the reason.
    for name in ["use_sim_time", "space"] {
        let refused = set(name);
        assert!(refused.starts_with("0100000000"), "{refused}");
        assert!(refused.contains(&hex("read-only")), "{refused}");
    }
    let got = call(
        "get_parameters",
        "GetParameters",
        &format!("010000000d000000{}00", hex("use_sim_time")),
    );
    // One value: of type 1, true.
    assert!(got.starts_with("010000000101"), "{got}");
}
