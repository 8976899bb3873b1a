//! Secured clients of both vendors.

use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::security::Enclave;
use ros2_node::service::{ServiceOptions, ServicePeers};
use system_tests::{Cell, Keystore, Peer};

use crate::ros2_services::peer::{SET_BOOL, ServiceParticipant, until};
use crate::ros2_services::{GRIP, server};

#[tokio::test(flavor = "multi_thread", worker_threads = 1)]
async fn calls_of_secured_clients_of_both_makers_are_answered_by_our_server() {
    let Some(cell) = Cell::secured(&[Peer::CycloneC, Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let domain = Domain::join(&DomainOptions {
        domain: 2,
        enclave: Some(Enclave {
            name: "/bridge".into(),
            folder: keystore.enclave("bridge"),
        }),
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node: "services".into(),
    })
    .unwrap();
    let ours = ServiceParticipant {
        peers: ServicePeers::new(&domain),
        domain,
    };
    let server = server(&ours, ServiceOptions::default());
    let cyclone = cell
        .secured_cyclone(&keystore, &["call", GRIP, "--count", "20"])
        .start();
    until("Cyclone DDS is done", || {
        cyclone.json_lines().iter().any(|line| line["done"] == true)
    })
    .await;
    let lines = cyclone.json_lines();
    let replies = lines.iter().filter(|line| line["text"] == "done");
    assert_eq!(replies.count(), 20, "{lines:?}");
    let call = ["call", GRIP, SET_BOOL, "--hex", "01", "--count", "20"];
    let fast = cell.secured_fastdds(&keystore, &call).start();
    until("Fast DDS is done", || {
        fast.json_lines()
            .iter()
            .any(|line| line.get("done").is_some())
    })
    .await;
    let lines = fast.json_lines();
    let replies = lines.iter().filter(|line| line["reply"].is_string());
    assert_eq!(replies.count(), 20, "{lines:?}");
    let counters = server.counters();
    assert_eq!((counters.calls, counters.undelivered), (40, 0));
}
