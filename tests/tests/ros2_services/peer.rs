//! The peers of services, by vendor.

use std::time::Duration;

use ros2_node::domain::{Domain, DomainOptions};
use ros2_node::service::ServicePeers;
use system_tests::{Cell, Child, Peer};

/// The timeout of a peer.
pub(crate) const SOON: Duration = Duration::from_secs(20);
/// A reply of `std_srvs/SetBool`: success, `done`.
pub(crate) const DONE: &[u8] = b"\0\x01\0\0\x01\0\0\0\x05\0\0\0done\0\0\0\0";

/// A participant of this workspace on the cell's loopback.
pub(crate) struct ServiceParticipant {
    pub(crate) peers: ServicePeers,
    pub(crate) domain: Domain,
}

impl ServiceParticipant {
    pub(crate) fn join() -> Self {
        let domain = Domain::join(&DomainOptions {
            domain: 2,
            enclave: None,
            networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
            peers: Vec::new(),
            node: "services".into(),
        })
        .unwrap();
        Self {
            peers: ServicePeers::new(&domain),
            domain,
        }
    }
}

/// The vendor of the peer's middleware.
#[derive(Clone, Copy)]
pub(crate) enum Vendor {
    Cyclone,
    FastDds,
}

impl Vendor {
    pub(crate) fn needs(self) -> &'static [Peer] {
        match self {
            Self::Cyclone => &[Peer::Python],
            Self::FastDds => &[Peer::FastDds],
        }
    }

    /// Starts a server of `std_srvs/SetBool` that answers success and `done`.
    pub(crate) fn serves(self, cell: &Cell, service: &str) -> Child {
        match self {
            Self::Cyclone => cyclone_serves(cell, service, &[]),
            Self::FastDds => {
                let done = "0100000005000000646f6e6500";
                cell.fastdds(&["serve", service, SET_BOOL, "--hex", done])
            }
        }
    }

    /// Returns the `data` of the requests that a server has received.
    pub(crate) fn asked(self, server: &Child) -> Vec<bool> {
        let lines = server.json_lines();
        match self {
            Self::Cyclone => server
                .values()
                .iter()
                .map(|value| value["data"] == true)
                .collect(),
            Self::FastDds => lines
                .iter()
                .filter_map(|line| Some(line.get("request")?.as_str()?.starts_with("01")))
                .collect(),
        }
    }

    /// Starts a client that calls with true `count` times: with Cyclone DDS all at once, with Fast
    /// DDS in sequence.
    pub(crate) fn calls(self, cell: &Cell, service: &str, count: usize) -> Child {
        let count = count.to_string();
        match self {
            Self::Cyclone => {
                let value = ["--value", r#"{"data":true}"#, "--at-once", &count];
                cyclone_calls(cell, service, &value)
            }
            Self::FastDds => {
                let value = ["call", service, SET_BOOL, "--hex", "01", "--count", &count];
                cell.fastdds(&value)
            }
        }
    }

    /// Returns the numbers of `done` replies and of unrelated samples that a client received, once
    /// the client is done.
    pub(crate) fn answers(self, client: &Child) -> Option<(usize, u64)> {
        let lines = client.json_lines();
        let end = if matches!(self, Self::Cyclone) {
            "strange"
        } else {
            "of_others"
        };
        let strange = lines.iter().find_map(|line| line.get(end)?.as_u64())?;
        let done = match self {
            Self::Cyclone => client
                .values()
                .iter()
                .filter(|value| value["message"] == "done")
                .count(),
            Self::FastDds => lines
                .iter()
                .filter_map(|line| line.get("reply")?.as_str())
                .filter(|reply| reply.starts_with("0100000005000000646f6e65"))
                .count(),
        };
        Some((done, strange))
    }
}

pub(crate) fn cyclone_serves(cell: &Cell, service: &str, more: &[&str]) -> Child {
    let answer = r#"{"success":true,"message":"done"}"#;
    let own = [
        "serve", service, SET_BOOL, "--domain", "2", "--answer", answer,
    ];
    cell.cyclone_started("ros2_service.py", &[&own, more].concat())
        .told()
        .start()
        .ready(SOON)
}

pub(crate) fn cyclone_calls(cell: &Cell, service: &str, more: &[&str]) -> Child {
    let own = ["call", service, SET_BOOL, "--domain", "2"];
    cell.cyclone("ros2_service.py", &[&own, more].concat())
}

pub(crate) const SET_BOOL: &str = "std_srvs/SetBool";

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
