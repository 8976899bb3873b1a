//! The status of a discovery server, as its pages show it.

use std::collections::{BTreeMap, VecDeque};

use serde::Serialize;

use crate::listing::ListingStatus;

/// The status of a discovery server.
#[derive(Debug, Clone, Serialize)]
pub struct LdsStatus {
    pub(super) program: &'static str,
    pub(super) version: &'static str,
    pub(super) library: &'static str,
    pub(super) application_uri: String,
    pub(super) endpoint: String,
    pub(super) interface: String,
    pub(super) since_ms: u64,
    pub(super) not_ready: Vec<String>,
    pub(super) servers: Vec<ServerStatus>,
    pub(super) network: Vec<RecordStatus>,
    pub(super) losses: VecDeque<LossStatus>,
    pub(super) counters: BTreeMap<&'static str, u64>,
    /// The Global Discovery Server; its servers are listed too.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) gds: Option<ListingStatus>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) level: Option<serde_json::Value>,
    /// The certificate of the discovery server.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(super) certificate: Option<serde_json::Value>,
}

/// A registered server.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ServerStatus {
    pub(super) uri: String,
    pub(super) name: String,
    pub(super) urls: Vec<String>,
    pub(super) since_ms: u64,
}

/// A server that is announced on the network.
#[derive(Debug, Clone, Serialize)]
pub(super) struct RecordStatus {
    pub(super) record_id: u32,
    pub(super) name: String,
    pub(super) url: String,
    /// `registration`, `multicast`, or `gds` for a server that a Global Discovery Server lists.
    pub(super) source: &'static str,
    pub(super) capabilities: Vec<String>,
    pub(super) since_ms: u64,
    /// The start time of its program, if known.
    pub(super) started_ms: Option<u64>,
}

/// A server that was lost.
#[derive(Debug, Clone, Serialize)]
pub(super) struct LossStatus {
    /// The ApplicationUri of a registered server, or the mDNS name of an announced server.
    pub(super) name: String,
    pub(super) url: String,
    pub(super) loss: &'static str,
    pub(super) at_ms: u64,
    /// The time since its last answer, if it ever answered.
    pub(super) silent_ms: Option<u64>,
}

impl service::PageState for LdsStatus {
    fn json(&self) -> String {
        // Serialization cannot fail: all keys are strings, and all numbers are finite.
        serde_json::to_string(self).unwrap_or_default()
    }

    fn prometheus(&self) -> String {
        let lines = self
            .counters
            .iter()
            .map(|(name, count)| format!("ua_lds_{name} {count}\n"));
        let sizes = [
            ("registered", self.servers.len()),
            ("on_network", self.network.len()),
        ];
        let sizes = sizes.map(|(name, size)| format!("ua_lds_{name} {size}\n"));
        lines.chain(sizes).collect()
    }

    fn not_ready(&self) -> Vec<String> {
        self.not_ready
            .iter()
            .map(|why| format!("{}: {why}\n", self.program))
            .collect()
    }
}
