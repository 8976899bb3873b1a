//! TLS 1.2 and 1.3 for servers of HTTP, with the certificate of a program.
//!
//! [`TlsServer`] accepts connections. A certificate that is renewed while the program runs is used
//! from the next connection on.

use std::fmt;
use std::io;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use rustls::ServerConfig;
use rustls::client::verify_server_name;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::server::{ClientHello, ParsedCertificate, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tracing::{info, warn};

/// The files of a certificate and its private key.
#[derive(Debug, Clone)]
pub struct CertificateFiles {
    /// The certificate, in DER.
    pub certificate: PathBuf,
    /// The private key, in PEM.
    pub key: PathBuf,
}

/// A certificate that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CertificateError {
    /// A file cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: io::Error,
    },
    /// The file of the key has no key.
    #[error("{path}: {why}")]
    Key {
        /// The file.
        path: PathBuf,
        /// The reason.
        why: String,
    },
    /// The certificate is not valid, or not that of the key.
    #[error("{path}: {source}")]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: rustls::Error,
    },
}

/// Secures connections with a certificate. Clones share it.
#[derive(Clone)]
pub struct TlsServer {
    resolver: Arc<CertificateResolver>,
    acceptor: TlsAcceptor,
}

impl fmt::Debug for TlsServer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TlsServer")
            .field("resolver", &self.resolver)
            .finish_non_exhaustive()
    }
}

impl TlsServer {
    /// Reads a certificate.
    ///
    /// # Errors
    /// The file that cannot be used.
    pub fn open(files: CertificateFiles) -> Result<Self, CertificateError> {
        let path = files.certificate.clone();
        let resolver = Arc::new(CertificateResolver::open(files)?);
        let provider = Arc::new(ring::default_provider());
        let config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|source| CertificateError::Certificate { path, source })?
            .with_no_client_auth()
            .with_cert_resolver(Arc::clone(&resolver) as Arc<dyn ResolvesServerCert>);
        Ok(Self {
            resolver,
            acceptor: TlsAcceptor::from(Arc::new(config)),
        })
    }

    /// Makes the handshake of a connection. The caller limits its time.
    ///
    /// # Errors
    /// The handshake fails.
    pub async fn accept(&self, stream: TcpStream) -> io::Result<TlsStream<TcpStream>> {
        self.acceptor.accept(stream).await
    }

    /// Returns whether the certificate is for a name or address.
    #[must_use]
    pub fn is_for(&self, name: &str) -> bool {
        self.resolver.is_for(name)
    }
}

/// The certificate. A renewed certificate is read at the next connection.
#[derive(Debug)]
struct CertificateResolver {
    files: CertificateFiles,
    current: Mutex<CurrentCertificate>,
}

#[derive(Debug)]
struct CurrentCertificate {
    key: Arc<CertifiedKey>,
    /// The times of modification of both files.
    modified: [Option<SystemTime>; 2],
    /// The times of the files that could not be read, which is logged once.
    refused: Option<[Option<SystemTime>; 2]>,
}

impl CertificateResolver {
    fn open(files: CertificateFiles) -> Result<Self, CertificateError> {
        let modified = files.modified();
        let key = files.read()?;
        Ok(Self {
            files,
            current: Mutex::new(CurrentCertificate {
                key,
                modified,
                refused: None,
            }),
        })
    }

    /// Returns the present certificate with its key. If the renewed files cannot be read, for
    /// example because only one of them is written, the previous certificate stays in use.
    fn key(&self) -> Arc<CertifiedKey> {
        let mut current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        let modified = self.files.modified();
        if modified != current.modified {
            match self.files.read() {
                Ok(key) => {
                    *current = CurrentCertificate {
                        key,
                        modified,
                        refused: None,
                    };
                    info!("connections by TLS use the renewed certificate");
                }
                Err(error) if current.refused != Some(modified) => {
                    warn!(%error, "connections by TLS keep the previous certificate");
                    current.refused = Some(modified);
                }
                Err(_) => {}
            }
        }
        Arc::clone(&current.key)
    }

    fn is_for(&self, name: &str) -> bool {
        let Ok(name) = ServerName::try_from(name) else {
            return false;
        };
        let key = self.key();
        let Some(certificate) = key.cert.first() else {
            return false;
        };
        let certificate = ParsedCertificate::try_from(certificate);
        certificate.is_ok_and(|certificate| verify_server_name(&certificate, &name).is_ok())
    }
}

impl ResolvesServerCert for CertificateResolver {
    fn resolve(&self, _hello: ClientHello<'_>) -> Option<Arc<CertifiedKey>> {
        Some(self.key())
    }
}

impl CertificateFiles {
    fn modified(&self) -> [Option<SystemTime>; 2] {
        [&self.certificate, &self.key].map(|path| {
            let modified = std::fs::metadata(path).and_then(|data| data.modified());
            modified.ok()
        })
    }

    fn read(&self) -> Result<Arc<CertifiedKey>, CertificateError> {
        let bytes = std::fs::read(&self.certificate).map_err(|source| CertificateError::Read {
            path: self.certificate.clone(),
            source,
        })?;
        let key =
            PrivateKeyDer::from_pem_file(&self.key).map_err(|error| CertificateError::Key {
                path: self.key.clone(),
                why: error.to_string(),
            })?;
        let chain = vec![CertificateDer::from(bytes)];
        let key = CertifiedKey::from_der(chain, key, &ring::default_provider());
        let key = key.map_err(|source| CertificateError::Certificate {
            path: self.certificate.clone(),
            source,
        })?;
        Ok(Arc::new(key))
    }
}
