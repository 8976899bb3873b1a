//! Whom a secured channel is opened for, and with which certificate of ours (OPC 10000-6, 6.2 and 6.7).

use std::path::{Path, PathBuf};
use std::time::Duration;

use bridge_node::{Failure, FailureKind};
use log_limit::LogLimit;
use opcua::crypto::{CertificateStore, PrivateKey, X509};
use opcua::sync::Mutex;
use opcua::types::StatusCode;
use plant_opcua::judge::{Judge, Refused};
use plant_opcua::pki::Pki;
use tracing::warn;
use trust::Names;
use x509_cert::Certificate;
use x509_cert::der::Decode as _;
use x509_cert::ext::pkix::SubjectAltName;
use x509_cert::ext::pkix::name::GeneralName;

use crate::clock;

/// The certificate store of a discovery server: `own`, `private` and `trusted` under one directory.
#[derive(Debug)]
pub(crate) struct Security {
    pub(crate) certificate: X509,
    pub(crate) key: PrivateKey,
    judge: Judge,
    /// Who was turned away, by the certificate and why.
    refused: Mutex<LogLimit>,
}

impl Security {
    /// Uses the store under `root`, and makes what is missing of it.
    pub(crate) fn open(
        root: &Path,
        application_uri: &str,
        host: &str,
        trust_any: bool,
    ) -> Result<Self, Failure> {
        let failed = |what: &dyn std::fmt::Display| {
            let message = format!(
                "the certificate store {} cannot be used: {what}",
                root.display()
            );
            Failure::new(FailureKind::Io, message)
        };
        let pki = Pki::open(root.to_owned()).map_err(|error| failed(&error))?;
        pki.ensure_own_named(application_uri, &[host.to_owned()], NAME)
            .map_err(|error| failed(&error))?;
        let (certificate, key) = pair(root);
        if trust_any {
            warn!("every client certificate is trusted: for tests only");
        }
        Ok(Self {
            certificate: CertificateStore::read_cert(&certificate)
                .map_err(|error| failed(&error))?,
            key: CertificateStore::read_pkey(&key).map_err(|error| failed(&error))?,
            judge: Judge::of(root, trust_any),
            refused: Mutex::new(LogLimit::every(TOLD_EVERY)),
        })
    }

    /// The store of an application that has made its pair already; nothing is made here.
    pub(crate) fn existing(root: &Path) -> Result<Self, String> {
        let failed = |error| format!("the certificate store {}: {error}", root.display());
        let (certificate, key) = pair(root);
        Ok(Self {
            certificate: CertificateStore::read_cert(&certificate).map_err(failed)?,
            key: CertificateStore::read_pkey(&key).map_err(failed)?,
            judge: Judge::of(root, false),
            refused: Mutex::new(LogLimit::every(TOLD_EVERY)),
        })
    }

    /// The same, but whom it trusts says the store at that root.
    pub(crate) fn judging_by(self, root: Option<PathBuf>, trust_any: bool) -> Self {
        Self {
            judge: root.map_or(self.judge, |root| Judge::of(&root, trust_any)),
            ..self
        }
    }

    /// Judges the certificate of a server that says it is that application. One that nobody has decided on is kept in `rejected`,
    /// for whoever does. Which host it is reached at is left open: what it is told there is no secret.
    pub(crate) fn trusts(&self, der: &[u8], application_uri: &str) -> Result<(), Refused> {
        let names = Names {
            host: None,
            application_uri: Some(application_uri),
        };
        self.judge.take(der, names).map(drop)
    }

    /// Whether a channel may be opened with this certificate, or may stay.
    pub(crate) fn admit(&self, der: &[u8]) -> Result<(), StatusCode> {
        let Err(refused) = self.judge.take(der, Names::default()) else {
            return Ok(());
        };
        let told = refused.to_string();
        if let Some(untold) = self.refused.lock().admit(&told, clock::now()) {
            warn!(untold, "a client is not talked to: {told}");
        }
        // Not which of the checks it was (OPC 10000-4, 6.1.3).
        match refused.may_be_told {
            true => Err(refused.status),
            false => Err(StatusCode::BadSecurityChecksFailed),
        }
    }
}

/// The ApplicationUri of a certificate (OPC 10000-6, 6.2.2): the first URI among its alternative names, wherever it stands
/// there. Some stacks put the names of the host in front of it.
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

/// The own certificate and its key.
fn pair(root: &Path) -> (PathBuf, PathBuf) {
    (root.join("own/cert.der"), root.join("private/private.pem"))
}

/// The common name of its certificate.
const NAME: &str = "UA bridge discovery server";

/// The same client is told of in the log once in this time.
pub(crate) const TOLD_EVERY: Duration = Duration::from_secs(10);
