//! The page for browsers of other hosts, by TLS with the certificate of the program.

use std::io;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

use bridge_node::{BoxFuture, Failure, FailureKind, Stream, serve_secure};
use rustls::ServerConfig;
use rustls::client::verify_server_name;
use rustls::crypto::ring;
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::server::{ClientHello, ParsedCertificate, ResolvesServerCert};
use rustls::sign::CertifiedKey;
use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;
use tracing::{info, warn};

use crate::page::Page;

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
enum PairError {
    #[error("cannot read {path}: {source}")]
    Read { path: PathBuf, source: io::Error },
    #[error("{path}: {why}")]
    Key { path: PathBuf, why: String },
    #[error("{path}: {source}")]
    Certificate {
        path: PathBuf,
        source: rustls::Error,
    },
}

impl Page {
    /// Serves the page by TLS at an address, for browsers of all hosts. Each user signs in, also to
    /// read.
    ///
    /// # Errors
    /// The certificate cannot be used, or the address cannot be bound.
    pub async fn serve_tls(
        self: Arc<Self>,
        address: SocketAddr,
        pair: CertificateFiles,
    ) -> Result<(), Failure> {
        let resolver = CertificateResolver::open(pair)
            .map_err(|error| Failure::new(FailureKind::Configuration, error.to_string()))?;
        let resolver = Arc::new(resolver);
        let _first = self.tls.set(Arc::clone(&resolver));
        let provider = Arc::new(ring::default_provider());
        let config = ServerConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| Failure::new(FailureKind::Configuration, error.to_string()))?
            .with_no_client_auth()
            .with_cert_resolver(resolver);
        let acceptor = TlsAcceptor::from(Arc::new(config));
        let secure = move |stream: TcpStream| -> BoxFuture<io::Result<Box<dyn Stream>>> {
            let acceptor = acceptor.clone();
            Box::pin(async move {
                let stream = acceptor.accept(stream).await?;
                Ok(Box::new(stream) as Box<dyn Stream>)
            })
        };
        let served = serve_secure(address, self, Arc::new(secure)).await;
        let at = served.map_err(|error| {
            Failure::new(
                FailureKind::Unavailable,
                format!("cannot serve the page at {address}: {error}; give another --page-tls"),
            )
        })?;
        info!("page at https://{at}/, by the names in the certificate, for signed-in users");
        Ok(())
    }
}

/// The certificate of the page. A renewed certificate is read at the next connection.
#[derive(Debug)]
pub(crate) struct CertificateResolver {
    pair: CertificateFiles,
    current: Mutex<Current>,
}

#[derive(Debug)]
struct Current {
    key: Arc<CertifiedKey>,
    /// The times of modification of both files.
    modified: [Option<SystemTime>; 2],
    /// The times of the files that could not be read, which is logged once.
    refused: Option<[Option<SystemTime>; 2]>,
}

impl CertificateResolver {
    fn open(pair: CertificateFiles) -> Result<Self, PairError> {
        let modified = pair.modified();
        let key = pair.read()?;
        Ok(Self {
            pair,
            current: Mutex::new(Current {
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
        let modified = self.pair.modified();
        if modified != current.modified {
            match self.pair.read() {
                Ok(key) => {
                    *current = Current {
                        key,
                        modified,
                        refused: None,
                    };
                    info!("the page uses the renewed certificate");
                }
                Err(error) if current.refused != Some(modified) => {
                    warn!(%error, "the page keeps the previous certificate");
                    current.refused = Some(modified);
                }
                Err(_) => {}
            }
        }
        Arc::clone(&current.key)
    }

    /// Returns whether the certificate is for this name or address.
    pub(crate) fn is_for(&self, name: &str) -> bool {
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

    fn read(&self) -> Result<Arc<CertifiedKey>, PairError> {
        let bytes = std::fs::read(&self.certificate).map_err(|source| PairError::Read {
            path: self.certificate.clone(),
            source,
        })?;
        let key = PrivateKeyDer::from_pem_file(&self.key).map_err(|error| PairError::Key {
            path: self.key.clone(),
            why: error.to_string(),
        })?;
        let chain = vec![CertificateDer::from(bytes)];
        let key = CertifiedKey::from_der(chain, key, &ring::default_provider());
        let key = key.map_err(|source| PairError::Certificate {
            path: self.certificate.clone(),
            source,
        })?;
        Ok(Arc::new(key))
    }
}
