//! What a server shows of itself before anything is said to it: its certificate, judged here. The library compares certificates
//! with files, and knows neither authorities nor revocation lists; it is given a store of its own, with that one certificate.

use std::fs;
use std::io;
use std::path::Path;
use std::process;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use opcua::crypto::{CertificateStore, X509, X509Data};
use opcua::sync::RwLock;
use opcua::types::{EndpointDescription, MessageSecurityMode, StatusCode};
use trust::{Certificate, Names};

use super::ClientConfig;
use crate::endpoint::EndpointUrl;
use crate::judge::{Judge, Refused, Shown};
use crate::known;
use crate::pki::{OWN_CERTIFICATE, OWN_KEY};

/// Judges the servers that a client connects to.
pub(super) struct Servers {
    judge: Judge,
}

/// What a server has shown, and what it is judged by as long as the connection lasts.
pub(super) struct Taken {
    shown: Shown,
    host: String,
    application_uri: String,
}

impl Servers {
    /// `None` for a client that has no certificates.
    pub(super) fn of(config: &ClientConfig) -> Option<Self> {
        let root = config.pki.as_ref()?;
        Some(Self {
            judge: Judge::of(root, config.accept_untrusted)
                .host_names(config.host_names)
                .pinned(config.pinned)
                .outdated_lists(config.allow_outdated_lists),
        })
    }

    /// Judges the certificate of an endpoint; `None` for one without security.
    ///
    /// # Errors
    /// It is refused.
    pub(super) fn take(&self, endpoint: &EndpointDescription) -> Result<Option<Taken>, Refused> {
        if endpoint.security_mode == MessageSecurityMode::None {
            return Ok(None);
        }
        let url: &str = endpoint.endpoint_url.as_ref();
        let url: Result<EndpointUrl, _> = url.parse();
        let host = url.map_or_else(|_| String::new(), |url| url.host().to_owned());
        let application_uri = endpoint.server.application_uri.as_ref().to_owned();
        let der = endpoint.server_certificate.value.as_deref();
        let names = Names {
            host: Some(&host),
            application_uri: Some(&application_uri),
        };
        let shown = self.judge.take(der.unwrap_or_default(), names)?;
        Ok(Some(Taken {
            shown,
            host,
            application_uri,
        }))
    }

    /// Judges it by what the store knows by now.
    ///
    /// # Errors
    /// It is refused.
    pub(super) fn again(&self, taken: &Taken) -> Result<(), Refused> {
        let names = Names {
            host: Some(&taken.host),
            application_uri: Some(&taken.application_uri),
        };
        self.judge.judge(&taken.shown, names)
    }

    /// A store for the library that has what was taken, and the client's own pair.
    ///
    /// # Errors
    /// It cannot be written.
    pub(super) fn store(&self, taken: &Taken) -> Result<Arc<RwLock<CertificateStore>>, String> {
        let root = std::path::absolute(self.judge.root()).map_err(|error| error.to_string())?;
        let folder = root.join(JUDGED);
        put(&folder, &taken.shown.0)
            .map_err(|error| format!("{} cannot be written: {error}", folder.display()))?;
        let own = [root.join(OWN_CERTIFICATE), root.join(OWN_KEY)];
        let [certificate, key] = own.each_ref().map(|path| Some(path.as_path()));
        let (mut store, ..) =
            CertificateStore::new_with_x509_data(&folder, false, certificate, key, NONE_IS_MADE);
        store.set_skip_verify_certs(true);
        Ok(Arc::new(RwLock::new(store)))
    }
}

/// Puts a certificate where the library looks for it, whole at once: other clients of the store do the same.
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

/// Why there is no connection.
pub(super) struct Why {
    pub(super) reason: String,
    /// The status, where the certificate of the server is refused.
    pub(super) certificate: Option<StatusCode>,
}

impl From<String> for Why {
    fn from(reason: String) -> Self {
        Self {
            reason,
            certificate: None,
        }
    }
}

impl From<Refused> for Why {
    fn from(refused: Refused) -> Self {
        Self {
            reason: refused.to_string(),
            certificate: Some(refused.status),
        }
    }
}

static NUMBERS: AtomicU64 = AtomicU64::new(0);
const NONE_IS_MADE: Option<X509Data> = None;
/// The library's store, below the client's. Nobody is trusted for being there.
const JUDGED: &str = "judged";
