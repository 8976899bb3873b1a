//! The certificate of the discovery server, and the certificates admitted to its secured channels
//! (OPC 10000-6, 6.2 and 6.7).

use std::path::{Path, PathBuf};
use std::time::Duration;

use log_limit::LogLimit;
use opcua::crypto::{CertificateStore, PrivateKey, X509};
use opcua::sync::Mutex;
use opcua::types::StatusCode;
use plant_opcua::judge::{CertificateJudge, RefusedCertificate};
use plant_opcua::pki::Pki;
use service::{Failure, FailureKind};
use tracing::warn;
use trust::RequiredNames;
use x509_cert::Certificate;
use x509_cert::der::Decode as _;
use x509_cert::ext::pkix::SubjectAltName;
use x509_cert::ext::pkix::name::GeneralName;

use crate::clock;

/// The certificate store of a discovery server, with the folders `own`, `private` and `trusted`.
#[derive(Debug)]
pub(crate) struct ChannelSecurity {
    pub(crate) certificate: X509,
    pub(crate) key: PrivateKey,
    judge: CertificateJudge,
    /// Limits the log messages for refused certificates, by certificate and reason.
    refused: Mutex<LogLimit>,
}

impl ChannelSecurity {
    /// Opens the store under `root`, and creates missing parts.
    pub(crate) fn open(
        root: &Path,
        application_uri: &str,
        host: &str,
        trust_any: bool,
    ) -> Result<Self, Failure> {
        let failed = |what: &dyn std::fmt::Display| {
            let message = format!(
                "cannot use the certificate store {}: {what}",
                root.display()
            );
            Failure::new(FailureKind::Io, message)
        };
        let pki = Pki::open(root.to_owned()).map_err(|error| failed(&error))?;
        pki.ensure_own_named(application_uri, &[host.to_owned()], NAME)
            .map_err(|error| failed(&error))?;
        let (certificate, key) = pair(root);
        if trust_any {
            warn!("this program trusts every client certificate: use this for tests only");
        }
        Ok(Self {
            certificate: CertificateStore::read_cert(&certificate)
                .map_err(|error| failed(&error))?,
            key: CertificateStore::read_pkey(&key).map_err(|error| failed(&error))?,
            judge: CertificateJudge::of(root, trust_any),
            refused: Mutex::new(LogLimit::every(TOLD_EVERY)),
        })
    }

    /// Opens the store of an application with an existing certificate and key; nothing is created.
    pub(crate) fn existing(root: &Path) -> Result<Self, Failure> {
        let failed = |error| {
            let message = format!("the certificate store {}: {error}", root.display());
            Failure::new(FailureKind::Io, message)
        };
        let (certificate, key) = pair(root);
        Ok(Self {
            certificate: CertificateStore::read_cert(&certificate).map_err(failed)?,
            key: CertificateStore::read_pkey(&key).map_err(failed)?,
            judge: CertificateJudge::of(root, false),
            refused: Mutex::new(LogLimit::every(TOLD_EVERY)),
        })
    }

    /// Uses the store at another root to decide on trust.
    pub(crate) fn judging_by(self, root: Option<PathBuf>, trust_any: bool) -> Self {
        Self {
            judge: root.map_or(self.judge, |root| CertificateJudge::of(&root, trust_any)),
            ..self
        }
    }

    /// Judges the certificate of a server with this ApplicationUri. An undecided certificate is
    /// stored in `rejected`. The host name is not checked, because the registration contains no
    /// secret.
    pub(crate) fn trusts(
        &self,
        der: &[u8],
        application_uri: &str,
    ) -> Result<(), RefusedCertificate> {
        let names = RequiredNames {
            host: None,
            application_uri: Some(application_uri),
        };
        self.judge.take(der, names).map(drop)
    }

    /// Checks that a channel may be opened, or stay open, with this certificate.
    pub(crate) fn admit(&self, der: &[u8]) -> Result<(), StatusCode> {
        let Err(refused) = self.judge.take(der, RequiredNames::default()) else {
            return Ok(());
        };
        let told = refused.to_string();
        if let Some(suppressed) = self.refused.lock().admit(&told, clock::now()) {
            warn!(suppressed, "rejected a client: {told}");
        }
        // An untrusted client does not learn which check failed (OPC 10000-4, 6.1.3).
        if refused.may_be_told {
            Err(refused.status)
        } else {
            Err(StatusCode::BadSecurityChecksFailed)
        }
    }
}

/// Returns the ApplicationUri of a certificate (OPC 10000-6, 6.2.2): the first URI of its subject
/// alternative names, at any position. Some stacks put host names first.
pub(crate) fn application_uri(der: &[u8]) -> Option<String> {
    let certificate = Certificate::from_der(der).ok()?;
    let (_, names) = certificate.tbs_certificate.get::<SubjectAltName>().ok()??;
    names.0.iter().find_map(|name| match name {
        GeneralName::UniformResourceIdentifier(uri) => Some(uri.as_str().to_owned()),
        GeneralName::OtherName(_)
        | GeneralName::Rfc822Name(_)
        | GeneralName::DnsName(_)
        | GeneralName::DirectoryName(_)
        | GeneralName::EdiPartyName(_)
        | GeneralName::IpAddress(_)
        | GeneralName::RegisteredId(_) => None,
    })
}

/// Returns the paths of the own certificate and its key.
fn pair(root: &Path) -> (PathBuf, PathBuf) {
    (root.join("own/cert.der"), root.join("private/private.pem"))
}

/// The common name of the certificate.
const NAME: &str = "UA bridge discovery server";

/// Shortest interval between two log messages for the same client.
pub(crate) const TOLD_EVERY: Duration = Duration::from_secs(10);
