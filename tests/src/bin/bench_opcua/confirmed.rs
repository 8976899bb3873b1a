//! Writes to ua-server that a bridge confirms, beside writes that are answered when their value has
//! been sent.

use std::time::Instant;

use plant_opcua::client::{OpcUaClient, SecurityChoice};
use plant_opcua::types::{NodeId, StatusCode, Variant};
use system_tests::{Cell, Distribution, SERVER_ENDPOINT, Times};

use crate::servers::{START, connected};

const MAPPING: &str = "
namespaces: {2: 'urn:ua-bridge:bench'}
spaces: [{id: 2}]
server: {security: [None, Basic256Sha256]}
variables:
  - node: ns=2;i=5
    name: sent
    type: Double
    origin: 0
    confirm: none
    ros: {space: 2, topic: /bench/sent, type: std_msgs/Float64, field: data}
  - node: ns=2;i=6
    name: confirmed
    type: Double
    origin: 0
    confirm: bridge
    ros: {space: 2, topic: /bench/setpoint, type: std_msgs/Float64, field: data}
";

pub(crate) async fn measure(cell: &Cell, requests: usize) {
    let mapping = cell.file("confirmed.yaml", MAPPING);
    let mapping = mapping.to_string_lossy().into_owned();
    let _server = cell.ua_server(&[&mapping, "--trust-any-client-certificate"]);
    let _bridge = cell.bridge_ros2(&[&mapping]);
    let topics = ["/bench/setpoint", "/bench/reached"];
    let _robot = cell.rclpy(Distribution::Jazzy, "ros2_arm.py", &topics);
    println!(
        "\n{requests} writes to ua-server, one at a time, with bridge-ros2 and a subscriber of rclpy; microseconds:\n"
    );
    println!("| security | confirm | p50 | p99 | writes/s |");
    println!("|---|---|---|---|---|");
    for (security, shown) in [
        (SecurityChoice::None, "None"),
        (SecurityChoice::Basic256Sha256, "Basic256Sha256"),
    ] {
        let client = connected(cell, SERVER_ENDPOINT, security).await;
        for (number, confirm) in [(5_u32, "none"), (6, "bridge")] {
            let node = NodeId::new(2, number);
            until_good(&client, &node).await;
            let (mut times, began) = (Times::default(), Instant::now());
            for value in 0..requests {
                let sent = Instant::now();
                let status = write(&client, &node, value as f64).await;
                assert!(status.is_good(), "{confirm}: {status}");
                times.add(sent.elapsed());
            }
            let rate = requests as f64 / began.elapsed().as_secs_f64();
            println!(
                "| {shown} | {confirm} | {:.0} | {:.0} | {rate:.0} |",
                times.at(0.5),
                times.at(0.99)
            );
        }
        client.close().await;
    }
}

async fn write(client: &OpcUaClient, node: &NodeId, value: f64) -> StatusCode {
    let values = [(node.clone(), Variant::Double(value))];
    let told = client.write(&values).await.unwrap();
    told.first().copied().unwrap_or(StatusCode::Bad)
}

/// Writes until a write succeeds: the bridge discovers the subscriber.
async fn until_good(client: &OpcUaClient, node: &NodeId) {
    let until = Instant::now() + START;
    while !write(client, node, -1.0).await.is_good() {
        assert!(Instant::now() < until, "no write to {node} is confirmed");
    }
}
