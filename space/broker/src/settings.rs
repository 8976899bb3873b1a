//! Settings of a connection that are read once, at its start.

use std::collections::hash_map::RandomState;
use std::fs;
use std::hash::{BuildHasher, Hasher};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mappings::Broker;
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, InvalidDnsNameError, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore, crypto};

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
    /// The host cannot be named in a certificate.
    #[error("the host of the broker is not valid in a certificate: {0}")]
    Host(#[from] InvalidDnsNameError),
    /// The client certificate and its key do not belong together.
    #[error("the client certificate cannot be used: {0}")]
    Certificate(#[from] rustls::Error),
}

/// The settings of a connection.
pub(crate) struct BrokerSettings {
    pub(crate) broker: Broker,
    pub(crate) client_id: String,
    pub(crate) publisher: Option<u16>,
    pub(crate) credentials: Option<Credentials>,
    pub(crate) tls: Option<Tls>,
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

/// The configuration of TLS.
pub(crate) struct Tls {
    pub(crate) config: Arc<ClientConfig>,
    pub(crate) host: ServerName<'static>,
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

fn tls(broker: &Broker) -> Result<Tls, OpenError> {
    let provider = Arc::new(crypto::ring::default_provider());
    let mut roots = RootCertStore::empty();
    let path = broker.ca.as_deref().unwrap_or_else(|| Path::new(SYSTEM_CA));
    for certificate in certificates(path)? {
        // An authority that cannot be used is not trusted.
        let _unusable = roots.add(certificate).is_err();
    }
    if roots.is_empty() {
        return Err(OpenError::Content {
            path: path.to_owned(),
            problem: "it contains no certificate of an authority".to_owned(),
        });
    }
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()?
        .with_root_certificates(roots);
    let config = match &broker.client {
        None => config.with_no_client_auth(),
        Some((certificate, key)) => {
            let key_file = key;
            let key =
                PrivateKeyDer::from_pem_file(key_file).map_err(|error| OpenError::Content {
                    path: key_file.clone(),
                    problem: format!("cannot read a private key: {error}"),
                })?;
            config.with_client_auth_cert(certificates(certificate)?, key)?
        }
    };
    Ok(Tls {
        config: Arc::new(config),
        host: ServerName::try_from(broker.address.host.clone())?,
    })
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, OpenError> {
    let content = |error: &dyn std::fmt::Display| OpenError::Content {
        path: path.to_owned(),
        problem: format!("cannot read a certificate: {error}"),
    };
    let all = CertificateDer::pem_file_iter(path).map_err(|error| content(&error))?;
    all.collect::<Result<_, _>>()
        .map_err(|error| content(&error))
}

/// The authorities of Debian and its relatives.
const SYSTEM_CA: &str = "/etc/ssl/certs/ca-certificates.crt";
