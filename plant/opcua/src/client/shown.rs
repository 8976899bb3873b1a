//! Checks the certificate of a server before the client sends anything secured to it. The library
//! compares certificates with files only, and supports neither authorities nor revocation lists. It
//! therefore gets a separate store that contains the accepted certificates.

use std::fs;
use std::io;
use std::path::Path;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use opcua::crypto::{CertificateStore, X509, X509Data};
use opcua::sync::RwLock;
use opcua::types::{EndpointDescription, MessageSecurityMode};
use trust::{Certificate, RequiredNames};

use super::ClientConfig;
use super::connection_fault::ConnectionFault;
use crate::endpoint::EndpointUrl;
use crate::judge::{CertificateJudge, PresentedChain, RefusedCertificate};
use crate::known;
use crate::pki::{OWN_CERTIFICATE, OWN_KEY};

/// Judges the certificates of the servers of a client.
pub(super) struct ServerJudge {
    judge: CertificateJudge,
}

/// An accepted server certificate, and the names for checking it again while the connection lasts.
pub(super) struct AcceptedCertificate {
    shown: PresentedChain,
    host: String,
    application_uri: String,
}

impl ServerJudge {
    /// Creates the judge of a client; `None` for a client without certificates.
    pub(super) fn of(config: &ClientConfig) -> Option<Self> {
        let root = config.pki.as_ref()?;
        Some(Self {
            judge: CertificateJudge::of(root, config.accept_untrusted)
                .host_names(config.host_names)
                .pinned(config.pinned)
                .outdated_lists(config.allow_outdated_lists),
        })
    }

    /// Judges the certificate of an endpoint; `None` for an endpoint without security.
    ///
    /// # Errors
    /// Returns an error if the certificate is refused.
    pub(super) fn take(
        &self,
        endpoint: &EndpointDescription,
    ) -> Result<Option<AcceptedCertificate>, RefusedCertificate> {
        if endpoint.security_mode == MessageSecurityMode::None {
            return Ok(None);
        }
        let url: &str = endpoint.endpoint_url.as_ref();
        let url: Result<EndpointUrl, _> = url.parse();
        let host = url.map_or_else(|_| String::new(), |url| url.host().to_owned());
        let application_uri = endpoint.server.application_uri.as_ref().to_owned();
        let der = endpoint.server_certificate.value.as_deref();
        let names = RequiredNames {
            host: Some(&host),
            application_uri: Some(&application_uri),
        };
        let shown = self.judge.take(der.unwrap_or_default(), names)?;
        Ok(Some(AcceptedCertificate {
            shown,
            host,
            application_uri,
        }))
    }

    /// Judges an accepted certificate again, by the current content of the store.
    ///
    /// # Errors
    /// Returns an error if the certificate is refused.
    pub(super) fn again(&self, taken: &AcceptedCertificate) -> Result<(), RefusedCertificate> {
        let names = RequiredNames {
            host: Some(&taken.host),
            application_uri: Some(&taken.application_uri),
        };
        self.judge.judge(&taken.shown, names)
    }

    /// Creates the certificate store of the library, with the accepted certificate and the client's
    /// own certificate and key.
    ///
    /// # Errors
    /// Returns an error if the store cannot be written.
    pub(super) fn store(
        &self,
        taken: &AcceptedCertificate,
    ) -> Result<Arc<RwLock<CertificateStore>>, ConnectionFault> {
        let root = std::path::absolute(self.judge.root()).map_err(ConnectionFault::Path)?;
        let folder = root.join(JUDGED);
        put(&folder, &taken.shown.0).map_err(|error| ConnectionFault::Store {
            folder: folder.clone(),
            error,
        })?;
        let own = [root.join(OWN_CERTIFICATE), root.join(OWN_KEY)];
        let [certificate, key] = own.each_ref().map(|path| Some(path.as_path()));
        let (mut store, ..) =
            CertificateStore::new_with_x509_data(&folder, false, certificate, key, NONE_IS_MADE);
        store.set_skip_verify_certs(true);
        Ok(Arc::new(RwLock::new(store)))
    }
}

/// Writes a certificate atomically to the file name that the library expects, because several
/// clients may share the store.
fn put(folder: &Path, certificate: &Certificate) -> io::Result<()> {
    let of_library =
        X509::from_der(certificate.der()).map_err(|error| io::Error::other(error.to_string()))?;
    let trusted = folder.join(known::TRUSTED);
    for needed in [&trusted, &folder.join("rejected")] {
        fs::create_dir_all(needed)?;
    }
    let name = CertificateStore::cert_file_name(&of_library);
    let path = trusted.join(&name);
    if fs::read(&path).is_ok_and(|there| there == certificate.der()) {
        return Ok(());
    }
    let number = NUMBERS.fetch_add(1, Ordering::Relaxed);
    let whole = folder.join(format!("{}-{number}.new", process::id()));
    fs::write(&whole, certificate.der())?;
    fs::rename(&whole, &path)
}

static NUMBERS: AtomicU64 = AtomicU64::new(0);
const NONE_IS_MADE: Option<X509Data> = None;
/// The folder of the library's store below the root of the client's store. A certificate is not
/// trusted because of its presence in this folder.
const JUDGED: &str = "judged";
