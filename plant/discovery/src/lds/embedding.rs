//! The connection between a discovery server and the program that embeds it.

use registry::RegistrationRequest;
use tokio::sync::{mpsc, watch};

/// A server of another level that is reached through this server (OPC 10000-4, 7.2:
/// GatewayServerUri).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Gated {
    /// The ApplicationUri.
    pub application_uri: String,
    /// The application name.
    pub name: String,
    /// The ApplicationUri of the gateway, which forwards requests.
    pub gateway_uri: String,
    /// The URL of the gateway on this level.
    pub url: String,
}

/// The information that an embedding program adds to the discovery server.
#[derive(Debug, Clone, Default)]
pub struct Added {
    /// Servers to list in FindServers.
    pub gated: Vec<Gated>,
    /// The value of `level` in `/status`.
    pub status: Option<serde_json::Value>,
    /// The reasons why the program is not ready.
    pub not_ready: Vec<String>,
}

/// The connection between an embedding program and its discovery server.
#[derive(Debug)]
pub struct LdsEmbedding {
    /// The name of the program in `/status`.
    pub program: &'static str,
    /// Receives changes of the servers. Events that do not fit into the channel are dropped, and
    /// counted as `level_missed_total`: the discovery server never waits.
    pub events: mpsc::Sender<OnLevel>,
    /// The added information.
    pub added: watch::Receiver<Added>,
}

/// A change of the servers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OnLevel {
    /// A source, which is an ApplicationUri or an mDNS name, reports a server.
    Told {
        /// The source.
        source: String,
        /// The URL of the server.
        url: String,
        /// Whether the server is registered; otherwise it is announced by mDNS only.
        registered: bool,
    },
    /// A source no longer reports a server.
    Left {
        /// The source.
        source: String,
    },
    /// The program behind a URL restarted.
    Restarted {
        /// The URL.
        url: String,
    },
}

/// The embedding program as the discovery server sees it; none for the program `ua-lds`.
#[derive(Debug, Default)]
pub(super) struct EmbeddingProgram {
    embedding: Option<LdsEmbedding>,
    /// Number of changes that did not fit into the channel.
    missed: u64,
}

impl EmbeddingProgram {
    pub(super) const fn new(embedding: Option<LdsEmbedding>) -> Self {
        Self {
            embedding,
            missed: 0,
        }
    }

    /// Returns the name of the program in `/status`.
    pub(super) fn name(&self) -> &'static str {
        let embedding = self.embedding.as_ref();
        embedding.map_or("ua-lds", |embedding| embedding.program)
    }

    /// Returns the number of changes that were dropped.
    pub(super) const fn missed(&self) -> u64 {
        self.missed
    }

    /// Returns the information that the program adds.
    pub(super) fn added(&self) -> Added {
        let embedding = self.embedding.as_ref();
        let added = embedding.map(|embedding| embedding.added.borrow().clone());
        added.unwrap_or_default()
    }

    /// Reports a change of the servers.
    pub(super) fn report(&mut self, change: OnLevel) {
        if let Some(embedding) = &self.embedding
            && embedding.events.try_send(change).is_err()
        {
            self.missed += 1;
        }
    }

    /// Returns the servers of other levels with these URIs, or all, in the form of registrations.
    pub(super) fn gated(&self, uris: &[&str]) -> Vec<RegistrationRequest> {
        let Some(embedding) = &self.embedding else {
            return Vec::new();
        };
        let added = embedding.added.borrow();
        let wanted = |one: &&Gated| uris.is_empty() || uris.contains(&&*one.application_uri);
        let gated = added.gated.iter().filter(wanted);
        gated.map(Gated::registration).collect()
    }
}

impl Gated {
    fn registration(&self) -> RegistrationRequest {
        RegistrationRequest {
            server_uri: self.application_uri.clone(),
            product_uri: String::new(),
            names: vec![(String::new(), self.name.clone())],
            application_type: registry::ApplicationType::Server,
            gateway_server_uri: self.gateway_uri.clone(),
            discovery_urls: vec![self.url.clone()],
            semaphore_file_path: String::new(),
            is_online: true,
            mdns: None,
        }
    }
}
