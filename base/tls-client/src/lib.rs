//! TLS of clients: the certificate of a host is verified by its name or address and its authority.
//!
//! - [`TlsAuthorities`] are the trusted authorities of a PEM file.
//! - [`TlsIdentity`] is a client certificate with its key, for hosts that ask for one.
//! - [`TlsVerification`] verifies a host, and makes a connection with it secure.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::pki_types::pem::{self, PemObject as _};
use rustls::pki_types::{CertificateDer, InvalidDnsNameError, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, RootCertStore, crypto};
use thiserror::Error;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

/// The authorities whose certificates are trusted.
#[derive(Debug, Clone)]
pub struct TlsAuthorities(Arc<RootCertStore>);

/// A client certificate with its issuers and its private key.
#[derive(Debug)]
pub struct TlsIdentity {
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
}

/// The verification of the certificate of a host.
#[derive(Clone)]
pub struct TlsVerification {
    config: Arc<ClientConfig>,
    host: ServerName<'static>,
}

/// The reason why no certificate can be verified or presented.
#[derive(Debug, Error)]
pub enum TlsError {
    /// The file of the authorities cannot be read.
    #[error("cannot read the authorities in {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: pem::Error,
    },
    /// The file has no certificate that can be used.
    #[error("{} contains no certificate of an authority", .0.display())]
    NoAuthority(PathBuf),
    /// The file of a client certificate cannot be read.
    #[error("cannot read a certificate in {}: {source}", path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: pem::Error,
    },
    /// The file of a private key cannot be read.
    #[error("cannot read a private key in {}: {source}", path.display())]
    Key {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: pem::Error,
    },
    /// The client certificate and its key do not belong together.
    #[error("the client certificate cannot be used: {0}")]
    Identity(#[source] rustls::Error),
    /// The host is neither a name nor an address.
    #[error("`{host}` is no name and no address of a host: {source}")]
    Host {
        /// The host.
        host: String,
        /// The reason.
        source: InvalidDnsNameError,
    },
    /// The versions of TLS are not supported.
    #[error("cannot use TLS: {0}")]
    Versions(#[from] rustls::Error),
}

impl TlsAuthorities {
    /// Returns the authorities of the PEM file in `SSL_CERT_FILE`, or of the system.
    ///
    /// # Errors
    /// [`TlsError::Read`] and [`TlsError::NoAuthority`].
    pub fn usual() -> Result<Self, TlsError> {
        let given = std::env::var_os("SSL_CERT_FILE").map(PathBuf::from);
        Self::read(&given.unwrap_or_else(|| PathBuf::from(SYSTEM_AUTHORITIES)))
    }

    /// Reads the authorities of a PEM file.
    ///
    /// # Errors
    /// [`TlsError::Read`] and [`TlsError::NoAuthority`].
    pub fn read(path: &Path) -> Result<Self, TlsError> {
        let all = CertificateDer::pem_file_iter(path).map_err(|source| TlsError::Read {
            path: path.to_owned(),
            source,
        })?;
        let read = Self::of(all.flatten());
        match read.0.is_empty() {
            true => Err(TlsError::NoAuthority(path.to_owned())),
            false => Ok(read),
        }
    }

    /// Returns the authorities with these certificates. Certificates that cannot be used are left
    /// out, and so are not trusted.
    pub fn of(certificates: impl IntoIterator<Item = CertificateDer<'static>>) -> Self {
        let mut roots = RootCertStore::empty();
        let (_added, _unusable) = roots.add_parsable_certificates(certificates);
        Self(Arc::new(roots))
    }
}

impl TlsIdentity {
    /// Reads the certificate, followed by those of its issuers, and its private key from PEM files.
    ///
    /// # Errors
    /// [`TlsError::Certificate`] and [`TlsError::Key`].
    pub fn read(certificate: &Path, key: &Path) -> Result<Self, TlsError> {
        let unread = |source| TlsError::Certificate {
            path: certificate.to_owned(),
            source,
        };
        let all = CertificateDer::pem_file_iter(certificate).map_err(unread)?;
        let chain: Result<_, _> = all.collect();
        let private = PrivateKeyDer::from_pem_file(key).map_err(|source| TlsError::Key {
            path: key.to_owned(),
            source,
        })?;
        Ok(Self {
            chain: chain.map_err(unread)?,
            key: private,
        })
    }
}

impl fmt::Debug for TlsVerification {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TlsVerification")
            .field("host", &self.host)
            .finish_non_exhaustive()
    }
}

impl TlsVerification {
    /// Creates the verification of a host, which is a name or an address, also in brackets.
    ///
    /// # Errors
    /// [`TlsError::Host`] and [`TlsError::Versions`].
    pub fn new(host: &str, authorities: &TlsAuthorities) -> Result<Self, TlsError> {
        Self::with_identity(host, authorities, None)
    }

    /// Creates the verification of a host as [`new`](Self::new). The identity is presented to a
    /// host that asks for it.
    ///
    /// # Errors
    /// As [`new`](Self::new), and [`TlsError::Identity`].
    pub fn with_identity(
        host: &str,
        authorities: &TlsAuthorities,
        identity: Option<TlsIdentity>,
    ) -> Result<Self, TlsError> {
        let plain = host.trim_start_matches('[').trim_end_matches(']');
        let name = ServerName::try_from(plain.to_owned());
        let name = name.map_err(|source| TlsError::Host {
            host: host.to_owned(),
            source,
        })?;
        let provider = Arc::new(crypto::ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()?
            .with_root_certificates(Arc::clone(&authorities.0));
        let config = match identity {
            None => config.with_no_client_auth(),
            Some(TlsIdentity { chain, key }) => config
                .with_client_auth_cert(chain, key)
                .map_err(TlsError::Identity)?,
        };
        Ok(Self {
            config: Arc::new(config),
            host: name,
        })
    }

    /// Makes a connection secure. Nothing of a request is sent before that.
    ///
    /// # Errors
    /// The certificate is not trusted, or the connection is lost.
    pub async fn connect<S>(&self, stream: S) -> io::Result<TlsStream<S>>
    where
        S: AsyncRead + AsyncWrite + Unpin,
    {
        let connector = TlsConnector::from(Arc::clone(&self.config));
        connector.connect(self.host.clone(), stream).await
    }
}

/// The authorities of Debian and its relatives.
const SYSTEM_AUTHORITIES: &str = "/etc/ssl/certs/ca-certificates.crt";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_without_authorities_is_named() {
        let read = |path: &str| {
            TlsAuthorities::read(Path::new(path))
                .unwrap_err()
                .to_string()
        };
        let why = read("/nowhere/ca.pem");
        let expected = "cannot read the authorities in /nowhere/ca.pem";
        assert!(why.starts_with(expected), "{why}");
        let expected = "/dev/null contains no certificate of an authority";
        assert_eq!(read("/dev/null"), expected);
    }

    #[test]
    fn a_client_certificate_that_cannot_be_read_is_named() {
        let none = Path::new("/nowhere/client.pem");
        let why = TlsIdentity::read(none, none).unwrap_err().to_string();
        let expected = "cannot read a certificate in /nowhere/client.pem";
        assert!(why.starts_with(expected), "{why}");
        let empty = Path::new("/dev/null");
        let why = TlsIdentity::read(empty, empty).unwrap_err().to_string();
        let expected = "cannot read a private key in /dev/null";
        assert!(why.starts_with(expected), "{why}");
    }

    #[test]
    fn a_host_is_a_name_or_an_address() {
        let none = TlsAuthorities::of([]);
        for host in ["h", "press.example", "10.0.0.9", "::1", "[::1]"] {
            assert!(TlsVerification::new(host, &none).is_ok(), "{host}");
        }
        let why = TlsVerification::new("a b", &none).unwrap_err().to_string();
        assert!(why.starts_with("`a b` is no name"), "{why}");
    }
}
