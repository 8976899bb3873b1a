//! The Cyclone DDS peer, and payloads in the format of both ends.

use std::time::Duration;

use ros2_node::domain::DomainOptions;
use system_tests::{Cell, Child};

/// The domain of the tests.
pub(crate) const DOMAIN: u16 = 2;
/// The timeout of a peer.
pub(crate) const SOON: Duration = Duration::from_secs(10);

/// Returns the options of a participant on the cell's loopback.
pub(crate) fn options() -> DomainOptions {
    DomainOptions {
        domain: DOMAIN,
        enclave: None,
        networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
        peers: Vec::new(),
        node: "endpoints".into(),
    }
}

/// Starts a Cyclone DDS writer and waits until it is ready. The writer stays until it receives a
/// line, and then leaves in order.
pub(crate) fn writes(cell: &Cell, topic: &str, kind: &str, more: &[&str]) -> Child {
    let arguments = [&[topic, kind, "--domain", "2"], more].concat();
    cell.cyclone_started("ros2_pub.py", &arguments)
        .told()
        .start()
        .ready(SOON)
}

/// Starts a Cyclone DDS reader and waits until it is ready.
pub(crate) fn reads(cell: &Cell, topic: &str, kind: &str, more: &[&str]) -> Child {
    cell.cyclone(
        "ros2_sub.py",
        &[&[topic, kind, "--domain", "2"], more].concat(),
    )
}

/// Returns the `data` of the samples that a Cyclone DDS reader has received.
pub(crate) fn heard(reader: &Child) -> Vec<String> {
    reader
        .values()
        .iter()
        .map(|value| value["data"].as_str().unwrap().to_owned())
        .collect()
}

/// Encodes a `std_msgs/String` in little-endian CDR, without trailing padding.
pub(crate) fn string(text: &str) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend_from_slice(&u32::try_from(text.len() + 1).unwrap().to_le_bytes());
    bytes.extend_from_slice(text.as_bytes());
    bytes.push(0);
    bytes
}

/// Returns whether these are the bytes of a `std_msgs/String` with that text, padded or not.
///
/// The second half of the encapsulation header is not compared, because writers may encode the
/// padding there.
pub(crate) fn is_string(bytes: &[u8], text: &str) -> bool {
    let wanted = string(text);
    bytes[..2] == wanted[..2] && bytes[4..].starts_with(&wanted[4..])
}
