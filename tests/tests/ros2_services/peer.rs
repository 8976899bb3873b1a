//! The other ends of services, by vendor.

use std::time::Duration;

use bridge_ros2::domain::{Domain, DomainOptions};
use bridge_ros2::service::ServicePeers;
use system_tests::{Cell, Child, Peer};

/// How long a peer may take.
pub(crate) const SOON: Duration = Duration::from_secs(20);
/// A reply of `std_srvs/SetBool`: success, `done`.
pub(crate) const DONE: &[u8] = b"\0\x01\0\0\x01\0\0\0\x05\0\0\0done\0\0\0\0";

/// A participant of ours on the cell's loopback.
pub(crate) struct Ours {
    pub(crate) peers: ServicePeers,
    pub(crate) domain: Domain,
}

impl Ours {
    pub(crate) fn join() -> Self {
        let domain = Domain::join(&DomainOptions {
            domain: 2,
            networks: vec![std::net::Ipv4Addr::LOCALHOST.into()],
            node: "services".into(),
        })
        .unwrap();
        Self {
            peers: ServicePeers::new(&domain),
            domain,
        }
    }
}

/// Whose middleware the other end has.
#[derive(Clone, Copy)]
pub(crate) enum Vendor {
    Cyclone,
}

impl Vendor {
    pub(crate) fn needs(self) -> &'static [Peer] {
        match self {
            Self::Cyclone => &[Peer::Python],
        }
    }

    /// A server of `std_srvs/SetBool` that answers success and `done`, and reports requests as values.
    pub(crate) fn serves(self, cell: &Cell, service: &str, more: &[&str]) -> Child {
        match self {
            Self::Cyclone => {
                let answer = r#"{"success":true,"message":"done"}"#;
                let own = [
                    "serve",
                    service,
                    "std_srvs/SetBool",
                    "--domain",
                    "2",
                    "--answer",
                    answer,
                ];
                cell.cyclone_started("ros2_service.py", &[&own, more].concat())
                    .told()
                    .start()
                    .ready(SOON)
            }
        }
    }

    /// A client of `std_srvs/SetBool` that reports replies as values.
    pub(crate) fn calls(self, cell: &Cell, service: &str, more: &[&str]) -> Child {
        match self {
            Self::Cyclone => {
                let own = ["call", service, "std_srvs/SetBool", "--domain", "2"];
                cell.cyclone("ros2_service.py", &[&own, more].concat())
            }
        }
    }

    /// How many replies a client has reported, when it has said that it is done.
    pub(crate) fn answers(self, client: &Child) -> usize {
        let done = client
            .json_lines()
            .iter()
            .any(|line| line.get("unanswered").is_some());
        if done { client.values().len() } else { 0 }
    }
}

/// Fails when the condition does not hold within [`SOON`]. Lets other tasks run.
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
