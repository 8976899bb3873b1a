//! Judges the certificate of a peer by the content of a certificate store: chain, trust, dates,
//! names, key usage and revocation (OPC 10000-4, 6.1.3).
//!
//! A refusal states the reason and the command that solves it. Changes of the store's files take
//! effect at once.

use std::collections::BTreeSet;
use std::fmt;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use opcua::sync::Mutex;
use opcua::types::StatusCode;
use tracing::{debug, warn};
use trust::{Certificate, CertificateFault, Fingerprint, RequiredNames, TrustedCertificates};

use crate::certificates;
use crate::known::{self, StoreStamp};

/// A certificate, and the issuer certificates that the peer sent.
pub type PresentedChain = (Certificate, Vec<Certificate>);

/// Judges certificates by the store at a root.
#[derive(Debug)]
pub struct CertificateJudge {
    root: PathBuf,
    trusts_all: bool,
    /// A certificate that is trusted in addition to the store.
    pinned: Option<Fingerprint>,
    /// Whether a missing or outdated revocation list is accepted.
    allows_outdated_lists: bool,
    host_names: HostNames,
    /// The pairs of certificate and host for which a warning was logged.
    warned: Mutex<BTreeSet<(String, String)>>,
    /// The content that was read last, and the state of the files at that time.
    read: Mutex<Option<(StoreStamp, Arc<TrustedCertificates>)>>,
}

/// The rule for a server if its certificate does not name its host. The rule applies to
/// certificates that are trusted themselves and have the expected ApplicationUri. A client may
/// suppress this check (OPC 10000-4, 6.1.3), because DHCP may change the address while the
/// certificate stays.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum HostNames {
    /// The client connects and logs a warning.
    #[default]
    Warn,
    /// The client refuses the server.
    Refuse,
}

/// The refusal of a peer's certificate.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub struct RefusedCertificate {
    /// The status code.
    pub status: StatusCode,
    /// Whether the peer may receive the status code (OPC 10000-4, 6.1.3).
    pub may_be_told: bool,
    /// The common name in the certificate. The creator of the certificate chose it freely.
    pub name: String,
    /// The reason and its solution.
    pub why: String,
}

impl fmt::Display for RefusedCertificate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            status, name, why, ..
        } = self;
        write!(f, "its certificate {name:?} is refused ({status}): {why}")
    }
}

impl CertificateJudge {
    /// Creates the judge of a store. With `trusts_all` every valid certificate is trusted, for
    /// tests and demonstrations.
    #[must_use]
    pub fn of(root: &Path, trusts_all: bool) -> Self {
        Self {
            root: root.to_owned(),
            trusts_all,
            pinned: None,
            allows_outdated_lists: false,
            host_names: HostNames::Refuse,
            warned: Mutex::default(),
            read: Mutex::default(),
        }
    }

    /// Sets the rule for host names.
    #[must_use]
    pub fn host_names(self, host_names: HostNames) -> Self {
        Self { host_names, ..self }
    }

    /// Trusts the certificate with this fingerprint in addition.
    #[must_use]
    pub fn pinned(self, pinned: Option<Fingerprint>) -> Self {
        Self { pinned, ..self }
    }

    /// Accepts certificates of an authority without a current revocation list. For connections to
    /// the server that distributes the list.
    #[must_use]
    pub fn outdated_lists(self, allows_outdated_lists: bool) -> Self {
        Self {
            allows_outdated_lists,
            ..self
        }
    }

    /// Returns the root of the store.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Returns the current content of the store.
    #[must_use]
    pub fn known(&self) -> Arc<TrustedCertificates> {
        // The stamp is taken before reading, so that changes during the reading are detected later.
        let stamp = known::stamp(&self.root);
        let mut read = self.read.lock();
        if let Some((before, known)) = &*read
            && *before == stamp
        {
            return Arc::clone(known);
        }
        let known = Arc::new(known::read(&self.root));
        *read = Some((stamp, Arc::clone(&known)));
        known
    }

    /// Decodes and judges the certificate of a peer. An undecided certificate is stored in
    /// `rejected`.
    ///
    /// # Errors
    /// Returns an error if the certificate is refused.
    pub fn take(
        &self,
        der: &[u8],
        names: RequiredNames<'_>,
    ) -> Result<PresentedChain, RefusedCertificate> {
        let shown = Certificate::read_chain(der).map_err(|unfit| RefusedCertificate {
            status: StatusCode::BadCertificateInvalid,
            may_be_told: false,
            name: String::new(),
            why: unfit.to_string(),
        })?;
        self.judge(&shown, names)?;
        if !shown.1.is_empty() {
            // The library does not support certificate chains.
            return Err(RefusedCertificate {
                status: StatusCode::BadCertificateInvalid,
                may_be_told: true,
                name: shown.0.name(),
                why: "it sends issuer certificates together with its own; configure it to send only its own \
                      certificate".to_owned(),
            });
        }
        Ok(shown)
    }

    /// Judges a decoded certificate by the current content of the store.
    ///
    /// # Errors
    /// Returns an error if the certificate is refused.
    pub fn judge(
        &self,
        shown: &PresentedChain,
        names: RequiredNames<'_>,
    ) -> Result<(), RefusedCertificate> {
        let (certificate, sent) = shown;
        let mut known = self.known();
        let is_pinned = self.pinned == Some(certificate.fingerprint());
        if (self.trusts_all || is_pinned) && !known.trusted.contains(certificate) {
            Arc::make_mut(&mut known).trusted.push(certificate.clone());
        }
        let now = known::now();
        let mut checked = trust::check_named(certificate, sent, &known, (names, now));
        let is_trusted_itself = known.trusted.contains(certificate);
        if checked == Err(CertificateFault::Host)
            && self.host_names == HostNames::Warn
            && is_trusted_itself
            && names.application_uri.is_some()
        {
            let others = RequiredNames {
                host: None,
                ..names
            };
            checked = trust::check_named(certificate, sent, &known, (others, now));
            if checked.is_ok() {
                self.warn_of_host(certificate, names.host.unwrap_or_default());
            }
        }
        if self.allows_outdated_lists && checked == Err(CertificateFault::RevocationUnknown) {
            checked = Ok(());
        }
        checked.map_err(|fault| RefusedCertificate {
            status: StatusCode::from(fault.status()),
            may_be_told: fault.may_be_told(),
            name: certificate.name(),
            why: format!("{fault}; {}", self.help(certificate, fault, names)),
        })
    }

    /// Logs one warning per host and certificate.
    fn warn_of_host(&self, certificate: &Certificate, host: &str) {
        let mut warned = self.warned.lock();
        if warned.len() >= MOST_WARNED {
            warned.clear();
        }
        if warned.insert((certificate.serial().to_string(), host.to_owned())) {
            warn!(
                host, certificate = ?certificate.name(), hosts = ?certificate.hosts(),
                application_uri = ?certificate.application_uri().unwrap_or_default(),
                "the trusted certificate of the server does not include the host of its URL"
            );
        }
    }

    fn help(
        &self,
        certificate: &Certificate,
        fault: CertificateFault,
        names: RequiredNames<'_>,
    ) -> String {
        let pki = &self.root;
        let issuer = certificate.issuer_name();
        let this_one = || {
            let kept = certificates::keep_refused(&self.root, certificate);
            let digits = kept.map_or_else(
                |error| {
                    debug!(%error, "cannot store a rejected certificate");
                    "FILE.der".to_owned()
                },
                |kept| kept.thumbprint.chars().take(SHOWN_DIGITS).collect(),
            );
            format!("`ua-server trust {digits} --pki {pki:?}`")
        };
        match fault {
            CertificateFault::Untrusted => format!("to trust it: {}", this_one()),
            CertificateFault::Incomplete => format!(
                "to trust its issuer {issuer:?}: `ua-server trust AUTHORITY.der --pki {pki:?}`; to trust \
                 only this certificate: {}",
                this_one()
            ),
            CertificateFault::RevocationUnknown => format!(
                "add the revocation list of the authority {issuer:?}: `ua-server trust FILE.crl --pki {pki:?}`"
            ),
            CertificateFault::IssuerRevocationUnknown => format!(
                "add the revocation list of the issuer of {issuer:?}: `ua-server trust FILE.crl --pki {pki:?}`"
            ),
            CertificateFault::Host => format!(
                "its URL has the host {:?}, but its certificate has {:?}: use one of these hosts in the \
                 URL, or issue a certificate for the host",
                names.host.unwrap_or_default(),
                certificate.hosts()
            ),
            CertificateFault::Uri => format!(
                "it announces the ApplicationUri {:?}, but its certificate has {:?}",
                names.application_uri.unwrap_or_default(),
                certificate.application_uri().unwrap_or_default()
            ),
            CertificateFault::Invalid
            | CertificateFault::Policy
            | CertificateFault::Time
            | CertificateFault::IssuerTime
            | CertificateFault::Use
            | CertificateFault::IssuerUse
            | CertificateFault::Revoked
            | CertificateFault::IssuerRevoked => help(fault).to_owned(),
        }
    }
}

/// Returns the solution of a fault that the store cannot solve.
pub(crate) const fn help(fault: CertificateFault) -> &'static str {
    match fault {
        CertificateFault::Revoked | CertificateFault::IssuerRevoked => {
            "it needs another certificate"
        }
        CertificateFault::RevocationUnknown | CertificateFault::IssuerRevocationUnknown => {
            "add the revocation list of the authority: `ua-server trust FILE.crl`"
        }
        CertificateFault::Time => "renew the certificate, or set the clocks of both hosts",
        CertificateFault::IssuerTime => "the authority needs a new certificate",
        CertificateFault::Invalid
        | CertificateFault::Incomplete
        | CertificateFault::Policy
        | CertificateFault::Untrusted
        | CertificateFault::Host
        | CertificateFault::Uri
        | CertificateFault::Use
        | CertificateFault::IssuerUse => "it needs another certificate (OPC 10000-6, 6.2.2)",
    }
}

/// Maximum number of pairs of host and certificate that are stored to suppress repeated warnings.
const MOST_WARNED: usize = 256;
/// Digits of a thumbprint in messages.
const SHOWN_DIGITS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pki::{OWN_CERTIFICATE, Pki};

    #[test]
    fn a_trusted_certificate_of_the_application_may_name_another_host_unless_that_is_refused() {
        let root = std::env::temp_dir().join(format!("plant-opcua-judge-{}", std::process::id()));
        drop(std::fs::remove_dir_all(&root));
        let device = Pki::open(root.join("device")).unwrap();
        device.ensure_own("urn:device", "192.0.2.7").unwrap();
        let der = std::fs::read(device.root().join(OWN_CERTIFICATE)).unwrap();
        let client = Pki::open(root.join("client")).unwrap();
        let names = |uri| RequiredNames {
            host: Some("192.0.2.8"),
            application_uri: Some(uri),
        };
        let judge = |host_names| CertificateJudge::of(client.root(), false).host_names(host_names);
        let status = |host_names, uri| {
            let taken = judge(host_names).take(&der, names(uri));
            taken.map(drop).map_err(|refused| refused.status)
        };
        let untrusted = Err(StatusCode::BadCertificateUntrusted);
        assert_eq!(status(HostNames::Warn, "urn:device"), untrusted);
        std::fs::write(client.root().join("trusted/device.der"), &der).unwrap();
        assert_eq!(status(HostNames::Warn, "urn:device"), Ok(()));
        let host = Err(StatusCode::BadCertificateHostNameInvalid);
        assert_eq!(status(HostNames::Refuse, "urn:device"), host);
        let uri = Err(StatusCode::BadCertificateUriInvalid);
        assert_eq!(status(HostNames::Warn, "urn:another"), uri);
        std::fs::remove_dir_all(root).unwrap();
    }
}
