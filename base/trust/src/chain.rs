//! The check of a certificate that somebody shows (OPC 10000-4, 6.1.3).

use std::time::Duration;

use crate::KEY_BITS;
use crate::certificate::{Certificate, LONGEST_CHAIN};
use crate::crl::Crl;

/// What is known of certificates: whom one trusts, who may stand between, and what is revoked.
#[derive(Debug, Clone, Default)]
pub struct Known {
    /// Those that are trusted: of applications, and of authorities, with all that these have issued.
    pub trusted: Vec<Certificate>,
    /// Authorities that are not trusted themselves, and are needed to reach one that is.
    pub issuers: Vec<Certificate>,
    /// Revocation lists of any of these.
    pub crls: Vec<Crl>,
}

impl Known {
    /// Whether an authority is among those that are trusted.
    #[must_use]
    pub fn trusts_authorities(&self) -> bool {
        self.trusted.iter().any(Certificate::is_authority)
    }

    fn is_trusted(&self, certificate: &Certificate) -> bool {
        self.trusted.contains(certificate)
    }
}

/// Why a certificate is refused, in the order in which it is looked at. Those up to [`Fault::Untrusted`] are nothing that a stranger is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum Fault {
    /// It cannot be read, or its key or signature cannot be used.
    #[error("the certificate is damaged, or its signature is not of the authority that it names")]
    Invalid,
    /// The authority that issued it, or one above that, is not known.
    #[error("an authority above the certificate is not known")]
    Incomplete,
    /// The key is too short or too long, or the signature is of a kind that can be forged.
    #[error(
        "the key is shorter than 2048 bits or longer than 4096, or the signature is older than SHA-256"
    )]
    Policy,
    /// Neither it nor an authority above it is trusted.
    #[error("neither the certificate nor an authority above it is trusted")]
    Untrusted,
    /// It is not valid now.
    #[error("the certificate is not valid now")]
    Time,
    /// An authority above it is not valid now.
    #[error("the certificate of the authority is not valid now")]
    IssuerTime,
    /// It is not for the host that the server is reached at.
    #[error("the certificate is for other hosts than the one that the server is reached at")]
    Host,
    /// It names another application than the one it is shown for.
    #[error("the certificate is of another ApplicationUri")]
    Uri,
    /// It is for something else than OPC UA applications.
    #[error("the certificate is for another use")]
    Use,
    /// What issued it may not issue certificates.
    #[error("what issued the certificate is no authority")]
    IssuerUse,
    /// There is no revocation list of its authority that is up to date.
    #[error("there is no revocation list of the authority that is up to date")]
    RevocationUnknown,
    /// The same, of an authority above it.
    #[error("there is no revocation list of the authority above the authority that is up to date")]
    IssuerRevocationUnknown,
    /// It is revoked.
    #[error("the certificate is revoked")]
    Revoked,
    /// An authority above it is revoked.
    #[error("the authority is revoked")]
    IssuerRevoked,
}

impl Fault {
    /// The StatusCode of OPC UA (OPC 10000-4, table of 6.1.3).
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

    /// Whether who shows the certificate may be told what is wrong with it: only one that is trusted otherwise.
    #[must_use]
    pub fn may_be_told(self) -> bool {
        self > Self::Untrusted
    }
}

/// What a certificate has to say of who shows it, where that is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Names<'n> {
    /// The host of the URL that a server is reached at: a name, or an address.
    pub host: Option<&'n str>,
    /// The ApplicationUri that it says it has.
    pub application_uri: Option<&'n str>,
}

/// Judges the certificate of an application at that time, with the certificates `sent` along.
///
/// One that is trusted itself needs no authority that is known; where its authority is known, it counts whether that has revoked it.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn check(
    certificate: &Certificate,
    sent: &[Certificate],
    known: &Known,
    now: Duration,
) -> Result<(), Fault> {
    check_named(certificate, sent, known, (Names::default(), now))
}

/// The same of a certificate that is to have these names, as that of a server that a client connects to.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn check_named(
    certificate: &Certificate,
    sent: &[Certificate],
    known: &Known,
    (names, now): (Names<'_>, Duration),
) -> Result<(), Fault> {
    let chain = chain(certificate, sent, known)?;
    let is_strong = |one: &&Certificate| {
        one.key_bits().is_some_and(|bits| KEY_BITS.contains(&bits)) && one.has_strong_signature()
    };
    if !chain.iter().all(is_strong) {
        return Err(Fault::Policy);
    }
    if !chain.iter().any(|one| known.is_trusted(one)) {
        return Err(Fault::Untrusted);
    }
    let issuers = chain.get(1..).unwrap_or_default();
    if !certificate.is_valid_at(now) {
        return Err(Fault::Time);
    }
    if !issuers.iter().all(|one| one.is_valid_at(now)) {
        return Err(Fault::IssuerTime);
    }
    if names
        .host
        .is_some_and(|host| !certificate.is_for_host(host))
    {
        return Err(Fault::Host);
    }
    let uri = names.application_uri;
    if uri.is_some() && certificate.application_uri().as_deref() != uri {
        return Err(Fault::Uri);
    }
    used(certificate, issuers)?;
    revoked(&chain, known, now)
}

/// The certificate and those above it, up to one that nobody is above.
fn chain<'c>(
    certificate: &'c Certificate,
    sent: &'c [Certificate],
    known: &'c Known,
) -> Result<Vec<&'c Certificate>, Fault> {
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
                // Somebody has decided on this very one.
                () if chain.len() == 1 && known.is_trusted(certificate) && !is_named => Ok(chain),
                () if is_named => Err(Fault::Invalid),
                () => Err(Fault::Incomplete),
            };
        };
        if chain.len() >= LONGEST_CHAIN || chain.contains(&issuer) {
            return Err(Fault::Incomplete);
        }
        chain.push(issuer);
        last = issuer;
    }
    Ok(chain)
}

/// Whether each is used for what it is for.
fn used(certificate: &Certificate, issuers: &[&Certificate]) -> Result<(), Fault> {
    let signs = certificate
        .usage()
        .is_none_or(|usage| usage.digital_signature());
    if !signs || !certificate.is_for_applications() {
        return Err(Fault::Use);
    }
    for (between, issuer) in issuers.iter().enumerate() {
        let constraints = issuer
            .constraints()
            .filter(|one| one.ca)
            .ok_or(Fault::IssuerUse)?;
        let is_short = constraints
            .path_len_constraint
            .is_none_or(|most| between <= usize::from(most));
        let may_sign = issuer.usage().is_none_or(|usage| usage.key_cert_sign());
        if !is_short || !may_sign {
            return Err(Fault::IssuerUse);
        }
    }
    Ok(())
}

/// Whether a list of each authority is there, and none has the one below it.
fn revoked(chain: &[&Certificate], known: &Known, now: Duration) -> Result<(), Fault> {
    let mut unknown = None;
    for (place, pair) in chain.windows(2).enumerate() {
        let [below, authority] = pair else { continue };
        let (missing, revoked) = match place {
            0 => (Fault::RevocationUnknown, Fault::Revoked),
            _ => (Fault::IssuerRevocationUnknown, Fault::IssuerRevoked),
        };
        let of_it: Vec<&Crl> = known
            .crls
            .iter()
            .filter(|crl| crl.is_of(authority))
            .collect();
        // What was revoked once stays so, also by a list that is out of date.
        if of_it.iter().any(|crl| crl.revokes(below)) {
            return Err(revoked);
        }
        if !of_it.iter().any(|crl| crl.is_current(now)) {
            unknown.get_or_insert(missing);
        }
    }
    unknown.map_or(Ok(()), Err)
}
