//! The validation of certificates (OPC 10000-4, 6.1.3).

use std::time::Duration;

use crate::KEY_BITS;
use crate::certificate::{Certificate, LONGEST_CHAIN};
use crate::crl::Crl;

/// The trusted certificates, the issuer certificates and the revocation lists for a validation.
#[derive(Debug, Clone, Default)]
pub struct TrustedCertificates {
    /// Trusted certificates: of applications, and of authorities together with all certificates
    /// that they issue.
    pub trusted: Vec<Certificate>,
    /// Issuer certificates, which are not trusted themselves and complete the chain to a trusted
    /// certificate.
    pub issuers: Vec<Certificate>,
    /// The revocation lists of these authorities.
    pub crls: Vec<Crl>,
}

impl TrustedCertificates {
    /// Returns whether an authority is trusted.
    #[must_use]
    pub fn trusts_authorities(&self) -> bool {
        self.trusted.iter().any(Certificate::is_authority)
    }

    fn is_trusted(&self, certificate: &Certificate) -> bool {
        self.trusted.contains(certificate)
    }
}

/// The fault of a certificate, in the order of the checks. The faults up to
/// [`CertificateFault::Untrusted`] are not revealed to the peer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum CertificateFault {
    /// The certificate cannot be decoded, or its key or signature is invalid.
    #[error("the certificate is damaged, or its signature is not from its issuer")]
    Invalid,
    /// An authority of the chain is missing.
    #[error("the certificate of an issuing authority is missing")]
    Incomplete,
    /// The key is too short or too long, or the signature algorithm is insecure.
    #[error(
        "the key is shorter than 2048 bits or longer than 4096, or the signature is older than SHA-256"
    )]
    Policy,
    /// Neither the certificate nor an authority of its chain is trusted.
    #[error("neither the certificate nor an authority above it is trusted")]
    Untrusted,
    /// The certificate is not valid at the moment.
    #[error("the certificate is not valid now")]
    Time,
    /// The certificate of an authority of its chain is not valid at the moment.
    #[error("the certificate of the authority is not valid now")]
    IssuerTime,
    /// The certificate does not name the host of the server.
    #[error("the certificate does not include the host of the server")]
    Host,
    /// The certificate names another ApplicationUri.
    #[error("the certificate has another ApplicationUri")]
    Uri,
    /// The key usage does not permit OPC UA applications.
    #[error("the certificate does not allow this use")]
    Use,
    /// An issuer of its chain may not issue certificates.
    #[error("the issuer of the certificate is not an authority")]
    IssuerUse,
    /// A current revocation list of its authority is missing.
    #[error("no valid revocation list of the authority is available")]
    RevocationUnknown,
    /// A current revocation list of a higher authority is missing.
    #[error("no valid revocation list of the superior authority is available")]
    IssuerRevocationUnknown,
    /// The certificate is revoked.
    #[error("the certificate is revoked")]
    Revoked,
    /// An authority of its chain is revoked.
    #[error("the authority is revoked")]
    IssuerRevoked,
}

impl CertificateFault {
    /// Returns the OPC UA StatusCode (OPC 10000-4, table of 6.1.3).
    #[must_use]
    pub const fn status(self) -> u32 {
        match self {
            Self::Invalid => 0x8012_0000,
            Self::Incomplete => 0x810D_0000,
            Self::Policy => 0x8114_0000,
            Self::Untrusted => 0x801A_0000,
            Self::Time => 0x8014_0000,
            Self::IssuerTime => 0x8015_0000,
            Self::Host => 0x8016_0000,
            Self::Uri => 0x8017_0000,
            Self::Use => 0x8018_0000,
            Self::IssuerUse => 0x8019_0000,
            Self::RevocationUnknown => 0x801B_0000,
            Self::IssuerRevocationUnknown => 0x801C_0000,
            Self::Revoked => 0x801D_0000,
            Self::IssuerRevoked => 0x801E_0000,
        }
    }

    /// Returns whether the peer may learn the fault: only if the certificate is trusted otherwise.
    #[must_use]
    pub fn may_be_told(self) -> bool {
        self > Self::Untrusted
    }
}

/// The names that a certificate must contain, if known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RequiredNames<'n> {
    /// The host of the server's URL: a DNS name or an IP address.
    pub host: Option<&'n str>,
    /// The ApplicationUri that the peer claims.
    pub application_uri: Option<&'n str>,
}

/// Validates the certificate of an application at a point in time. `sent` are the issuer
/// certificates that the peer sent.
///
/// The authority of a certificate that is trusted itself may be unknown. If its authority is known,
/// revocations apply.
///
/// # Errors
/// Returns the first fault.
pub fn check(
    certificate: &Certificate,
    sent: &[Certificate],
    known: &TrustedCertificates,
    now: Duration,
) -> Result<(), CertificateFault> {
    check_named(certificate, sent, known, (RequiredNames::default(), now))
}

/// Validates a certificate that must contain these names, such as the certificate of a server that
/// a client connects to.
///
/// # Errors
/// Returns the first fault.
pub fn check_named(
    certificate: &Certificate,
    sent: &[Certificate],
    known: &TrustedCertificates,
    (names, now): (RequiredNames<'_>, Duration),
) -> Result<(), CertificateFault> {
    let chain = chain(certificate, sent, known)?;
    let is_strong = |one: &&Certificate| {
        one.key_bits().is_some_and(|bits| KEY_BITS.contains(&bits)) && one.has_strong_signature()
    };
    if !chain.iter().all(is_strong) {
        return Err(CertificateFault::Policy);
    }
    if !chain.iter().any(|one| known.is_trusted(one)) {
        return Err(CertificateFault::Untrusted);
    }
    let issuers = chain.get(1..).unwrap_or_default();
    if !certificate.is_valid_at(now) {
        return Err(CertificateFault::Time);
    }
    if !issuers.iter().all(|one| one.is_valid_at(now)) {
        return Err(CertificateFault::IssuerTime);
    }
    if names
        .host
        .is_some_and(|host| !certificate.is_for_host(host))
    {
        return Err(CertificateFault::Host);
    }
    let uri = names.application_uri;
    if uri.is_some() && certificate.application_uri().as_deref() != uri {
        return Err(CertificateFault::Uri);
    }
    used(certificate, issuers)?;
    revoked(&chain, known, now)
}

/// Returns the certificate and its issuers up to a self-signed certificate.
fn chain<'c>(
    certificate: &'c Certificate,
    sent: &'c [Certificate],
    known: &'c TrustedCertificates,
) -> Result<Vec<&'c Certificate>, CertificateFault> {
    let mut chain = vec![certificate];
    let mut last = certificate;
    while !last.is_self_signed() {
        let all = known.trusted.iter().chain(&known.issuers).chain(sent);
        let mut named = all
            .filter(|one| one.is_authority() && one.is_named_issuer_of(last))
            .peekable();
        let is_named = named.peek().is_some();
        let Some(issuer) = named.find(|one| one.has_signed(last)) else {
            return match () {
                // This very certificate is explicitly trusted.
                () if chain.len() == 1 && known.is_trusted(certificate) && !is_named => Ok(chain),
                () if is_named => Err(CertificateFault::Invalid),
                () => Err(CertificateFault::Incomplete),
            };
        };
        if chain.len() >= LONGEST_CHAIN || chain.contains(&issuer) {
            return Err(CertificateFault::Incomplete);
        }
        chain.push(issuer);
        last = issuer;
    }
    Ok(chain)
}

/// Checks the key usages of the chain.
fn used(certificate: &Certificate, issuers: &[&Certificate]) -> Result<(), CertificateFault> {
    let signs = certificate
        .usage()
        .is_none_or(|usage| usage.digital_signature());
    if !signs || !certificate.is_for_applications() {
        return Err(CertificateFault::Use);
    }
    for (between, issuer) in issuers.iter().enumerate() {
        let constraints = issuer
            .constraints()
            .filter(|one| one.ca)
            .ok_or(CertificateFault::IssuerUse)?;
        let is_short = constraints
            .path_len_constraint
            .is_none_or(|most| between <= usize::from(most));
        let may_sign = issuer.usage().is_none_or(|usage| usage.key_cert_sign());
        if !is_short || !may_sign {
            return Err(CertificateFault::IssuerUse);
        }
    }
    Ok(())
}

/// Checks that each authority has a current revocation list, and that no certificate of the chain
/// is revoked.
fn revoked(
    chain: &[&Certificate],
    known: &TrustedCertificates,
    now: Duration,
) -> Result<(), CertificateFault> {
    let mut unknown = None;
    for (place, pair) in chain.windows(2).enumerate() {
        let [below, authority] = pair else { continue };
        let (missing, revoked) = match place {
            0 => (
                CertificateFault::RevocationUnknown,
                CertificateFault::Revoked,
            ),
            _ => (
                CertificateFault::IssuerRevocationUnknown,
                CertificateFault::IssuerRevoked,
            ),
        };
        let of_it: Vec<&Crl> = known
            .crls
            .iter()
            .filter(|crl| crl.is_of(authority))
            .collect();
        // Revocations in an outdated list stay effective.
        if of_it.iter().any(|crl| crl.revokes(below)) {
            return Err(revoked);
        }
        if !of_it.iter().any(|crl| crl.is_current(now)) {
            unknown.get_or_insert(missing);
        }
    }
    unknown.map_or(Ok(()), Err)
}
