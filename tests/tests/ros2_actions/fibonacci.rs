//! The Fibonacci action as bytes.

use std::time::Duration;

use bytes::Bytes;
use ros2_node::action::ActionName;
use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::service::ServicePeers;

/// The timeout of a peer.
pub(crate) const SOON: Duration = Duration::from_secs(20);
pub(crate) const ACTION: &str = "/count";

/// A participant of this workspace on the cell's loopback.
pub(crate) struct ActionParticipant {
    pub(crate) peers: ServicePeers,
    pub(crate) domain: Domain,
}

impl ActionParticipant {
    pub(crate) fn join() -> Self {
        let domain = Domain::join(&DomainOptions {
            domain: 2,
            networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
            peers: Vec::new(),
            node: "actions".into(),
            enclave: None,
        })
        .unwrap();
        Self {
            peers: ServicePeers::new(&domain),
            domain,
        }
    }
}

pub(crate) fn action() -> ActionName {
    ActionName::new(ACTION, &"demo_msgs/Fibonacci".parse().unwrap())
}

pub(crate) const DEFINITION: &str = "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n";

/// Encodes a `Fibonacci_Goal`.
pub(crate) fn goal(order: i32) -> Vec<u8> {
    [&[0, 1, 0, 0], &order.to_le_bytes()[..]].concat()
}

/// Encodes a `Fibonacci_Feedback`.
pub(crate) fn feedback(numbers: &[i32]) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0];
    bytes.extend_from_slice(&u32::try_from(numbers.len()).unwrap().to_le_bytes());
    for number in numbers {
        bytes.extend_from_slice(&number.to_le_bytes());
    }
    bytes
}

/// Encodes a `Fibonacci_GetResult_Response` without its status.
pub(crate) fn result(numbers: &[i32]) -> Vec<u8> {
    let mut bytes = vec![0, 1, 0, 0, 0, 0, 0, 0];
    bytes.extend_from_slice(&feedback(numbers)[4..]);
    bytes
}

/// Decodes the numbers of a sequence at offset `at` of a message's body.
pub(crate) fn numbers(message: &Bytes, at: usize) -> Vec<i32> {
    let (count, numbers) = message[4 + at..].split_first_chunk::<4>().unwrap();
    let count = usize::try_from(u32::from_le_bytes(*count)).unwrap();
    let numbers: Vec<i32> = numbers
        .chunks_exact(4)
        .take(count)
        .map(|number| i32::from_le_bytes(number.try_into().unwrap()))
        .collect();
    assert_eq!(numbers.len(), count);
    numbers
}

/// Waits until the condition holds, and fails after [`SOON`]. Lets other tasks run.
pub(crate) async fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let deadline = tokio::time::Instant::now() + SOON;
    while !condition() {
        assert!(
            tokio::time::Instant::now() < deadline,
            "within {SOON:?} not so: {what}"
        );
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}
