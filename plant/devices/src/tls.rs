//! TLS for the HTTP client: the certificate of a device is verified by its host and its authority.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{ClientConfig, RootCertStore, crypto};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;

/// The verification of the certificate of a device.
#[derive(Clone)]
pub(crate) struct DeviceTls {
    config: Arc<ClientConfig>,
    host: ServerName<'static>,
}

impl fmt::Debug for DeviceTls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tls")
            .field("host", &self.host)
            .finish_non_exhaustive()
    }
}

impl DeviceTls {
    /// Creates the verification for a host, with the trusted authorities.
    ///
    /// # Errors
    /// The reason for users: the host is not a name or address.
    pub(crate) fn new(host: &str, authorities: RootCertStore) -> Result<Self, String> {
        let host = host
            .trim_start_matches('[')
            .trim_end_matches(']')
            .to_owned();
        let host = ServerName::try_from(host).map_err(|error| error.to_string())?;
        let provider = Arc::new(crypto::ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| error.to_string())?
            .with_root_certificates(authorities)
            .with_no_client_auth();
        Ok(Self {
            config: Arc::new(config),
            host,
        })
    }

    /// Makes a connection secure. Nothing of a request is sent before that.
    ///
    /// # Errors
    /// The certificate is not trusted, or the connection is lost.
    pub(crate) async fn connect(&self, stream: TcpStream) -> io::Result<TlsStream<TcpStream>> {
        let connector = TlsConnector::from(Arc::clone(&self.config));
        connector.connect(self.host.clone(), stream).await
    }
}

/// Returns the trusted authorities: those of the PEM file in SSL_CERT_FILE, or of the system.
///
/// # Errors
/// The reason for users: there is no such file, or no authority in it.
pub(crate) fn authorities() -> Result<RootCertStore, String> {
    let given = std::env::var_os("SSL_CERT_FILE").map(PathBuf::from);
    read(&given.unwrap_or_else(|| PathBuf::from(SYSTEM_AUTHORITIES)))
}

fn read(path: &Path) -> Result<RootCertStore, String> {
    let shown = path.display();
    let all = CertificateDer::pem_file_iter(path)
        .map_err(|error| format!("cannot read the authorities in {shown}: {error}"))?;
    let mut authorities = RootCertStore::empty();
    for certificate in all.flatten() {
        // An authority that cannot be used is not trusted.
        let _unusable = authorities.add(certificate).is_err();
    }
    match authorities.is_empty() {
        true => Err(format!("{shown} contains no certificate of an authority")),
        false => Ok(authorities),
    }
}

const SYSTEM_AUTHORITIES: &str = "/etc/ssl/certs/ca-certificates.crt";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_without_authorities_is_named() {
        let why = read(Path::new("/nowhere/ca.pem")).unwrap_err();
        assert!(
            why.starts_with("cannot read the authorities in /nowhere/ca.pem"),
            "{why}"
        );
        let why = read(Path::new("/dev/null")).unwrap_err();
        assert_eq!(why, "/dev/null contains no certificate of an authority");
    }
}
