//! An OPC UA client that supervises its connection and reconnects with all its subscriptions.
//!
//! Reading order: `supervisor` (the life of a connection), `reach` (checks whether the host of a
//! busy server answers), `shown` (the verified identity of the server), `subscription`, `types`
//! (type closures), `connector`.

mod connection_fault;
mod connector;
mod parts;
mod reach;
mod services;
mod shown;
mod subscription;
mod supervisor;
mod types;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use opcua::types::{DateTime, NamespaceMap, StatusCode, TypeLoader};
use tokio::sync::watch;
use trust::Fingerprint;

pub use self::parts::{LimitedService, OperationLimits, PartFault, PartedRequest};
pub use self::services::{
    Browse, BrowsedReferences, CallError, CallOptions, CallResult, MOST_REFERENCES,
};
pub use self::subscription::{ClientSubscription, MonitoredWatch, Notice, Sampled, Select};
pub use self::types::MOST_TYPES;
pub use crate::judge::HostNames;

use self::supervisor::{ConnectionState, failed};

/// The identity, the security and the timing of a client.
#[derive(Debug, Clone)]
pub struct ClientConfig {
    /// The ApplicationUri of the client.
    pub application_uri: String,
    /// The application name.
    pub application_name: String,
    /// The directory of the certificate store; `None` for a client without security.
    pub pki: Option<PathBuf>,
    /// Trusts every server certificate that is otherwise valid. For tests and demonstrations only.
    pub accept_untrusted: bool,
    /// The SHA-256 fingerprint of a certificate that is trusted in addition to the certificates of
    /// the store.
    pub pinned: Option<Fingerprint>,
    /// Accepts a server of a trusted authority without a current revocation list. For connections
    /// to the server that distributes the list.
    pub allow_outdated_lists: bool,
    /// The rule for a server if its trusted certificate does not name its host.
    pub host_names: HostNames,
    /// The required security of the endpoint.
    pub security: SecurityChoice,
    /// The user identity; `None` for anonymous. A password is sent over an unencrypted session only
    /// with [`SecurityChoice::None`].
    pub user: Option<ClientUser>,
    /// The timeout of a request.
    pub timeout: Duration,
    /// The interval of keep-alive requests.
    pub keep_alive: Duration,
    /// The delay before a new connection attempt: the first delay and the longest delay.
    pub backoff: (Duration, Duration),
    /// Longest time without responses while the host of the server is reachable. A server that
    /// handles one request at a time does not answer while it executes a method for another client.
    /// With zero, the connection is dropped after missed keep-alives. During a call of this client,
    /// only the transport decides.
    pub patience: Duration,
}

impl ClientConfig {
    /// Creates the configuration of a client without certificates, with 2 s for each request.
    #[must_use]
    pub fn new(application_uri: &str, application_name: &str) -> Self {
        Self {
            application_uri: application_uri.to_owned(),
            application_name: application_name.to_owned(),
            pki: None,
            accept_untrusted: false,
            pinned: None,
            allow_outdated_lists: false,
            host_names: HostNames::Warn,
            security: SecurityChoice::Best,
            user: None,
            timeout: Duration::from_secs(2),
            keep_alive: Duration::from_millis(500),
            backoff: (Duration::from_millis(250), Duration::from_secs(5)),
            patience: Duration::ZERO,
        }
    }
}

/// The user name and password for a server.
#[derive(Clone)]
pub struct ClientUser {
    /// The user name.
    pub name: String,
    /// The password of the user.
    pub password: String,
}

impl std::fmt::Debug for ClientUser {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClientUser")
            .field("name", &self.name)
            .finish_non_exhaustive()
    }
}

/// The security that a client requires of an endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SecurityChoice {
    /// The best security that the server offers: signed and encrypted if the client has
    /// certificates.
    Best,
    /// SecurityPolicy None.
    None,
    /// SignAndEncrypt with Basic256Sha256.
    Basic256Sha256,
    /// SignAndEncrypt with Aes128_Sha256_RsaOaep.
    Aes128Sha256RsaOaep,
    /// SignAndEncrypt with Aes256_Sha256_RsaPss.
    Aes256Sha256RsaPss,
}

/// The state of the connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Link {
    /// The client connects for the first time.
    Connecting,
    /// The client is connected.
    Up {
        /// Whether the server restarted after the previous connection. Cached data of the server
        /// may be invalid then.
        restarted: bool,
        /// The number of connections so far, including this connection.
        connects: u64,
        /// The EndpointUrl.
        endpoint: String,
        /// Whether the connection is signed and encrypted.
        secured: bool,
        /// The ApplicationUri of the server.
        application_uri: String,
    },
    /// The client is disconnected, and tries to reconnect.
    Down {
        /// The reason.
        reason: String,
        /// The status code if the certificate of the server is refused.
        certificate: Option<StatusCode>,
    },
    /// The client is closed.
    Closed,
}

/// An error of a request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ClientError {
    /// The client is not connected.
    #[error("not connected: {0}")]
    NotConnected(String),
    /// The server does not answer in time, or the connection is lost before the response.
    #[error("the server did not respond: {0}")]
    Lost(String),
    /// The server answers with a Bad status code.
    #[error("the server responds with {0}")]
    Status(StatusCode),
    /// The response does not fit the request.
    #[error("the server responds with {0}")]
    Answer(&'static str),
}

impl From<PartFault> for ClientError {
    fn from(fault: PartFault) -> Self {
        match fault {
            PartFault::Failed(error) => failed(&error),
            PartFault::Short => Self::Answer("a wrong number of results"),
        }
    }
}

/// A client of a server. Clones share the same connection, which is closed when the last clone is
/// dropped.
#[derive(Clone)]
pub struct OpcUaClient {
    shared: Arc<ConnectionState>,
    /// Closes the connection when the last clone is dropped.
    _open: Arc<Open>,
}

struct Open(Arc<ConnectionState>);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl OpcUaClient {
    /// Starts a task that connects to the server at `url`.
    #[must_use]
    pub fn open(config: ClientConfig, url: &str) -> Self {
        Self::start(ConnectionState::new(config, url))
    }

    /// Opens a second connection to the same server, with its own session. Both clients take into
    /// account that the server may be busy with a call of the other client.
    #[must_use]
    pub fn another(&self) -> Self {
        Self::start(self.shared.another())
    }

    /// Returns whether calls wait for their results, on this client or on a client made by
    /// [`another`](Self::another).
    #[must_use]
    pub fn is_calling(&self) -> bool {
        self.shared.calls.any()
    }

    fn start(shared: ConnectionState) -> Self {
        let shared = Arc::new(shared);
        drop(tokio::spawn(supervisor::run(Arc::clone(&shared))));
        Self {
            _open: Arc::new(Open(Arc::clone(&shared))),
            shared,
        }
    }

    /// Returns whether both handles share a connection, and therefore a session.
    #[must_use]
    pub fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.shared, &other.shared)
    }

    /// Returns a receiver of the connection state. A receiver may miss intermediate states;
    /// `connects` counts the connections.
    #[must_use]
    pub fn link(&self) -> watch::Receiver<Link> {
        self.shared.link.subscribe()
    }

    /// Returns the start time of the connected server, which identifies its run; `None` while there
    /// is no connection.
    #[must_use]
    pub fn started(&self) -> Option<DateTime> {
        let connected = self.shared.connected().ok();
        connected.map(|connected| connected.started)
    }

    /// Waits until the client is connected.
    ///
    /// # Errors
    /// Returns the reason if the client is not connected in time.
    pub async fn up(&self, within: Duration) -> Result<(), ClientError> {
        let mut link = self.link();
        let up = link.wait_for(|link| matches!(link, Link::Up { .. } | Link::Closed));
        let waited = tokio::time::timeout(within, up).await;
        match waited {
            Ok(Ok(link)) if matches!(*link, Link::Up { .. }) => Ok(()),
            Ok(_) => Err(ClientError::NotConnected("the client is closed".to_owned())),
            Err(_) => Err(self.shared.not_connected()),
        }
    }

    /// Closes the session, and waits for the end of the session for at most twice the request
    /// timeout.
    pub async fn close(&self) {
        let mut link = self.link();
        self.shared.close();
        let closed = link.wait_for(|link| *link == Link::Closed);
        drop(tokio::time::timeout(self.shared.config.timeout * 2, closed).await);
    }

    /// Returns the NamespaceArray of the server at the start of the connection; empty without a
    /// connection.
    #[must_use]
    pub fn namespaces(&self) -> Vec<String> {
        let connected = self.shared.connected();
        connected.map_or_else(|_| Vec::new(), |one| one.namespaces.clone())
    }

    /// Returns how often the certificate of the server was refused. Each connection attempt counts.
    #[must_use]
    pub fn certificates_refused(&self) -> u64 {
        self.shared.refused.load(Ordering::Relaxed)
    }

    /// Registers a type loader for structures on the current connection.
    ///
    /// # Errors
    /// Returns an error if the client is not connected.
    pub fn knows(&self, types: Arc<dyn TypeLoader>) -> Result<(), ClientError> {
        let connected = self.shared.connected()?;
        let mut namespaces = NamespaceMap::new();
        for uri in &connected.namespaces {
            namespaces.add_namespace(uri);
        }
        connected.session.set_namespaces(namespaces);
        connected.session.add_type_loader(types);
        Ok(())
    }

    /// Returns the index of a namespace at the server.
    #[must_use]
    pub fn namespace(&self, uri: &str) -> Option<u16> {
        let connected = self.shared.connected().ok()?;
        let at = connected.namespaces.iter().position(|one| one == uri)?;
        u16::try_from(at).ok()
    }
}
