//! Settings of a connection that are read once, at its start.

use std::collections::hash_map::RandomState;
use std::fs;
use std::hash::{BuildHasher, Hasher};
use std::io;
use std::path::{Path, PathBuf};

use mappings::Broker;
use tls_client::{TlsAuthorities, TlsError, TlsIdentity, TlsVerification};

use crate::reports::BrokerReports;
use crate::topics::{self, Address, TopicFilter, TopicMessageType, UADP};

/// The program that uses a broker.
#[derive(Debug, Clone)]
pub struct BrokerIdentity {
    /// Name of the program, for its ClientId.
    pub program: String,
    /// PublisherId of own messages; their status is reported. `None` for a program that only
    /// looks.
    pub publisher: Option<u16>,
}

/// Reason why the settings of a broker cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// A file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// A file has no usable content.
    #[error("{}: {problem}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The problem.
        problem: String,
    },
    /// TLS cannot be used.
    #[error(transparent)]
    Tls(#[from] TlsError),
}

/// The settings of a connection.
pub(crate) struct BrokerSettings {
    pub(crate) broker: Broker,
    pub(crate) client_id: String,
    pub(crate) publisher: Option<u16>,
    pub(crate) credentials: Option<Credentials>,
    pub(crate) tls: Option<TlsVerification>,
    pub(crate) will: Option<Will>,
    /// The topics to subscribe, in their order.
    pub(crate) filters: Vec<TopicFilter>,
}

/// The status that the broker publishes when the connection is lost.
pub(crate) struct Will {
    pub(crate) topic: String,
    pub(crate) payload: Vec<u8>,
}

/// User name and password of an MQTT client.
pub(crate) struct Credentials {
    pub(crate) user: String,
    pub(crate) password: String,
}

impl BrokerSettings {
    pub(crate) fn read(broker: &Broker, identity: &BrokerIdentity) -> Result<Self, OpenError> {
        let credentials = broker.credentials.as_deref().map(credentials).transpose()?;
        let tls = broker.address.tls.then(|| tls(broker)).transpose()?;
        Ok(Self {
            broker: broker.clone(),
            client_id: client_id(broker, identity),
            publisher: identity.publisher,
            credentials,
            tls,
            will: will(broker, identity),
            filters: topics::filters(broker),
        })
    }

    /// Returns the settings of a connection that only sends messages that the broker confirms;
    /// `None` if the broker confirms none.
    pub(crate) fn of_confirmed(
        broker: &Broker,
        identity: &BrokerIdentity,
    ) -> Result<Option<Self>, OpenError> {
        if !broker.at_least_once || identity.publisher.is_none() {
            return Ok(None);
        }
        let main = Self::read(broker, identity)?;
        Ok(Some(Self {
            client_id: format!("{}-confirmed", main.client_id),
            will: None,
            filters: Vec::new(),
            ..main
        }))
    }
}

/// Returns the will of a program that alone uses its PublisherId. The programs of space 0 share
/// theirs.
fn will(broker: &Broker, identity: &BrokerIdentity) -> Option<Will> {
    let publisher = identity.publisher.filter(|of| broker.will && *of != 0)?;
    let address = Address {
        kind: TopicMessageType::Status,
        publisher,
        group: None,
        writer: None,
    };
    Some(Will {
        topic: topics::name(broker, UADP, address),
        payload: BrokerReports::default().failed(publisher)?,
    })
}

/// Returns a ClientId that no other client has. The broker disconnects the older of two clients
/// with the same ClientId, so the default of the standard, the PublisherId, cannot be used: several
/// programs share it.
fn client_id(broker: &Broker, identity: &BrokerIdentity) -> String {
    let first = broker.client_id.as_deref().unwrap_or("ua-bridge");
    let host = fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let host: String = host
        .chars()
        .filter(|c| c.is_ascii_alphanumeric() || *c == '-')
        .take(32)
        .collect();
    let space = identity
        .publisher
        .map_or_else(|| "tool".to_owned(), |space| space.to_string());
    let random = random() % 0x1_0000_0000;
    format!("{first}-{}-{space}-{host}-{random:08x}", identity.program)
}

/// Returns a random number, for names and pauses only.
pub(crate) fn random() -> u64 {
    RandomState::new().build_hasher().finish()
}

fn credentials(path: &Path) -> Result<Credentials, OpenError> {
    let text = fs::read_to_string(path).map_err(|source| OpenError::File {
        path: path.to_owned(),
        source,
    })?;
    let mut lines = text.lines();
    let user = lines.next().unwrap_or_default().trim_end();
    if user.is_empty() {
        return Err(OpenError::Content {
            path: path.to_owned(),
            problem: "the first line has no user name; the second line is the password".to_owned(),
        });
    }
    Ok(Credentials {
        user: user.to_owned(),
        password: lines.next().unwrap_or_default().trim_end().to_owned(),
    })
}

/// Returns the verification of the broker. Its authorities are those of the mapping, or the usual.
fn tls(broker: &Broker) -> Result<TlsVerification, TlsError> {
    let authorities = match &broker.ca {
        Some(file) => TlsAuthorities::read(file)?,
        None => TlsAuthorities::usual()?,
    };
    let client = broker.client.as_ref();
    let identity = client.map(|(certificate, key)| TlsIdentity::read(certificate, key));
    TlsVerification::with_identity(&broker.address.host, &authorities, identity.transpose()?)
}
