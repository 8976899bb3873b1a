//! A client that connects, watches over its connection, and comes back with all its subscriptions.
//!
//! Reading order: `supervisor` (the life of a connection), `reach` (whether the host of a busy server answers), `shown` (whom the server proves to be), `subscription`, `types` (type
//! closures), `connector`.

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

use opcua::types::{NamespaceMap, StatusCode, TypeLoader};
use tokio::sync::watch;
use trust::Fingerprint;

pub use self::parts::{OperationLimits, PartFault, Parts, Service};
pub use self::services::{Browse, CallError, CallOptions, CallResult, MOST_REFERENCES};
pub use self::subscription::{Notice, Sampled, Select, Subscription, Watch};
pub use self::types::MOST_TYPES;
pub use crate::judge::HostNames;

use self::supervisor::{Shared, failed};

/// Who a client is, and what it bears.
#[derive(Debug, Clone)]
pub struct ClientConfig {
    /// The ApplicationUri.
    pub application_uri: String,
    /// The name for people.
    pub application_name: String,
    /// The directory of certificates; without one nothing is secured.
    pub pki: Option<PathBuf>,
    /// Trusts the certificate of any server that is sound otherwise. For tests and demonstrations only.
    pub accept_untrusted: bool,
    /// The SHA-256 of a certificate that is trusted beside the certificates of the store.
    pub pinned: Option<Fingerprint>,
    /// Accepts a server of a trusted authority without a current revocation list: the server that hands out that list.
    pub allow_outdated_lists: bool,
    /// The rule for servers at hosts that their trusted certificates do not name.
    pub host_names: HostNames,
    /// What it wants of what servers offer.
    pub security: SecurityChoice,
    /// As whom it comes. A password is sent over a session without security only with [`SecurityChoice::None`].
    pub user: Option<ClientUser>,
    /// How long each request may take.
    pub timeout: Duration,
    /// How often it asks the server whether it lives.
    pub keep_alive: Duration,
    /// How long it waits before it connects again: at first, and at most.
    pub backoff: (Duration, Duration),
    /// How long the server may leave requests unanswered while its host is reachable. A server that serves one request at a
    /// time answers nothing while it executes a method for another client. With zero the connection is dropped once
    /// keep-alives are missed; while a call of this client goes on, only the transport decides either way.
    pub patience: Duration,
}

impl ClientConfig {
    /// A client without certificates, with 2 s for each request.
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

/// A user of a server.
#[derive(Clone)]
pub struct ClientUser {
    /// The user name.
    pub name: String,
    /// What proves it.
    pub password: String,
}

impl std::fmt::Debug for ClientUser {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClientUser")
            .field("name", &self.name)
            .finish_non_exhaustive()
    }
}

/// What a client wants of what servers offer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SecurityChoice {
    /// The best that the server offers: signed and encrypted where the client has certificates.
    Best,
    /// No security.
    None,
    /// Signed and encrypted.
    Basic256Sha256,
    /// Signed and encrypted, with AES of 128 bits.
    Aes128Sha256RsaOaep,
    /// Signed with RSA-PSS and encrypted.
    Aes256Sha256RsaPss,
}

/// Whether there is a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Link {
    /// For the first time.
    Connecting,
    /// There is.
    Up {
        /// Whether the server was started again since the last time: what was known of it may be wrong.
        restarted: bool,
        /// How often there has been one.
        connects: u64,
        /// Where.
        endpoint: String,
        /// Whether it is signed and encrypted.
        secured: bool,
        /// The ApplicationUri of the server.
        application_uri: String,
    },
    /// There is none, and it is tried again.
    Down {
        /// Why.
        reason: String,
        /// The status, where the certificate of the server is refused.
        certificate: Option<StatusCode>,
    },
    /// The client is closed.
    Closed,
}

/// Why there is no answer.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ClientError {
    /// There is no connection.
    #[error("there is no connection: {0}")]
    NotConnected(String),
    /// The server does not answer in time, or the connection is lost while it is waited for.
    #[error("the server did not answer: {0}")]
    Lost(String),
    /// The server refuses.
    #[error("the server answers {0}")]
    Status(StatusCode),
    /// The answer is not what was asked for.
    #[error("the server answers with {0}")]
    Answer(&'static str),
}

impl From<PartFault> for ClientError {
    fn from(fault: PartFault) -> Self {
        match fault {
            PartFault::Failed(error) => failed(&error),
            PartFault::Short => Self::Answer("another number of results"),
        }
    }
}

/// A client of one server. Clones are handles to the same one; it is closed when the last is dropped.
#[derive(Clone)]
pub struct Client {
    shared: Arc<Shared>,
    /// Closes it when the last clone is gone.
    _open: Arc<Open>,
}

struct Open(Arc<Shared>);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.close();
    }
}

impl Client {
    /// Connects to the server at `url` from now on, in a task of its own.
    #[must_use]
    pub fn open(config: ClientConfig, url: &str) -> Self {
        Self::start(Shared::new(config, url))
    }

    /// Connects to the same server once more, in a session of its own. Both clients know that the server may be busy with a
    /// call of the other.
    #[must_use]
    pub fn another(&self) -> Self {
        Self::start(self.shared.another())
    }

    /// Returns whether calls of this client, or of one made by [`another`](Self::another), wait for their results.
    #[must_use]
    pub fn is_calling(&self) -> bool {
        self.shared.calls.any()
    }

    fn start(shared: Shared) -> Self {
        let shared = Arc::new(shared);
        drop(tokio::spawn(supervisor::run(Arc::clone(&shared))));
        Self {
            _open: Arc::new(Open(Arc::clone(&shared))),
            shared,
        }
    }

    /// Whether both are handles to one client, and so of one session.
    #[must_use]
    pub fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.shared, &other.shared)
    }

    /// What holds now, and each change. Between two looks there may have been several: `connects` tells.
    #[must_use]
    pub fn link(&self) -> watch::Receiver<Link> {
        self.shared.link.subscribe()
    }

    /// Waits until there is a connection.
    ///
    /// # Errors
    /// Why there was none in time.
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

    /// Closes the session and waits until it is, at most as long as a request may take.
    pub async fn close(&self) {
        let mut link = self.link();
        self.shared.close();
        let closed = link.wait_for(|link| *link == Link::Closed);
        drop(tokio::time::timeout(self.shared.config.timeout * 2, closed).await);
    }

    /// The NamespaceArray of the server, as it was when the connection was made; empty before the first.
    #[must_use]
    pub fn namespaces(&self) -> Vec<String> {
        let connected = self.shared.connected();
        connected.map_or_else(|_| Vec::new(), |one| one.namespaces.clone())
    }

    /// How often the certificate of the server was refused, each attempt to connect counted.
    #[must_use]
    pub fn certificates_refused(&self) -> u64 {
        self.shared.refused.load(Ordering::Relaxed)
    }

    /// Reads structures of these types from now on, over the connection that there is.
    ///
    /// # Errors
    /// There is no connection.
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

    /// The index of a namespace at the server.
    #[must_use]
    pub fn namespace(&self, uri: &str) -> Option<u16> {
        let connected = self.shared.connected().ok()?;
        let at = connected.namespaces.iter().position(|one| one == uri)?;
        u16::try_from(at).ok()
    }
}
