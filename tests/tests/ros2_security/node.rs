//! The node of a secured bridge, and nodes of ROS 2 itself.

use serde_json::json;
use system_tests::{Cell, Distribution, Keystore, METRICS_ROS2, Peer, UaSide, eventually, metrics};

use crate::ros2_security::{BACK, SOON, STRING, THERE, answering, reaches};

const NODE: &str = "/ua_bridge_ros2";

/// Calls a parameter service of the bridge. Request and reply are hexadecimal digits of CDR.
fn ask(cell: &Cell, keystore: &Keystore, service: &str, kind: &str, request: &str) -> String {
    let (service, kind) = (
        format!("{NODE}/{service}"),
        format!("rcl_interfaces/{kind}"),
    );
    let call = ["call", &service, &kind, "--hex", request];
    let mut client = cell.secured_fastdds(keystore, &call).start();
    client.wait_for_json("a reply", SOON, |line| {
        Some(line.get("reply")?.as_str()?.to_owned())
    })
}

fn hex(text: &str) -> String {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn secured_peers_list_and_get_the_parameters_of_the_bridge() {
    let Some(cell) = Cell::secured(&[Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let _bridge = answering(cell.secured_bridge(&keystore, &["--use-sim-time"]));
    let ask =
        |service: &str, kind: &str, request: &str| ask(&cell, &keystore, service, kind, request);
    // No prefixes, any depth.
    let all = ask("list_parameters", "ListParameters", &"0".repeat(32));
    for name in ["domain", "space", "use_sim_time"] {
        assert!(all.contains(&hex(name)), "{all}");
    }
    let name = format!("010000000d000000{}00", hex("use_sim_time"));
    let got = ask("get_parameters", "GetParameters", &name);
    // A single value: of type 1, true.
    assert!(got.starts_with("010000000101"), "{got}");
}

/// The wheels of ROS 2 contain a Fast DDS without DDS Security, so their nodes cannot be secured.
#[test]
fn a_node_of_ros_2_without_an_enclave_gets_and_gives_nothing_and_is_told_of() {
    for distribution in Distribution::ALL {
        let Some(cell) = Cell::secured(&[Peer::Ros2, Peer::CycloneC]) else {
            return;
        };
        let keystore = Keystore::make(&cell, "keystore");
        let mut ua = UaSide::join();
        let mut bridge = answering(cell.secured_bridge(&keystore, &[]));
        let mut judge = cell.judge(distribution, &["judge"]);
        let string = "std_msgs/msg/String";
        judge.ask(json!({"subscribe": THERE.1, "type": string}));
        let publish = json!({"publish": BACK.1, "type": string, "value": {"data": "in the open"}});
        judge.ask(publish.clone());
        bridge.wait_for_line("is rejected: it has no DDS Security", SOON);
        // Peers in the enclave are served throughout.
        let reader = cell
            .secured_cyclone(&keystore, &["sub", THERE.1, STRING])
            .start()
            .ready(SOON);
        reaches(&mut ua, "for the enclave", &reader);
        judge.ask(publish);
        let nodes = judge.ask(json!({"nodes": 1}));
        assert_eq!(nodes, json!(["/judge/judge"]));
        let lines = judge.child().json_lines();
        let heard = lines.iter().filter(|line| line.get("heard").is_some());
        assert_eq!(heard.count(), 0, "{lines:?}");
        ua.drain();
        let values = ua.triples_for(std::time::Duration::from_millis(500));
        assert!(!values.contains(&BACK.0), "{values:?}");
        eventually("a refused participant is counted", SOON, || {
            let status = metrics(METRICS_ROS2)?;
            (status["others"]["dropped"]["unsecured"] == 1).then_some(())
        });
    }
}
