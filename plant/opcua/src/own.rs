//! The application's own certificate: the reasons for making a new certificate, and its
//! description.
//!
//! A self-made certificate is kept as long as possible, because other applications trust this very
//! file. It is replaced by command ([`Pki::renew`]), when the ApplicationUri changes, when it has
//! expired, and when it was made before the clock was set. [`crate::enrolment`] replaces it by a
//! certificate of an authority.
//!
//! [`Pki::renew`]: crate::pki::Pki::renew

use std::fmt;
use std::fs;
use std::io::{self, Write as _};
use std::path::Path;
use std::time::Duration;

use opcua::crypto::X509Data;
#[cfg(feature = "server")]
use serde_json::{Value, json};
use tracing::info;
use trust::Certificate;

use crate::pair::OWN_CERTIFICATE;

/// The reason why an application has its present certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CertificateCause {
    /// The application had no certificate.
    Missing,
    /// The key of the previous certificate was missing.
    KeyMissing,
    /// The certificate of the key was missing.
    CertificateMissing,
    /// The previous certificate was made before the clock was set, and has expired.
    EarlyClock,
    /// The previous certificate has expired.
    Expired,
    /// The previous certificate named another ApplicationUri.
    ApplicationUri,
    /// An operator requested it.
    Command,
    /// A Global Discovery Server issued it.
    Enrolment,
    /// The authority of the plant issued it for its own server.
    Authority,
    /// An administrator installed it over OPC UA.
    Administrator,
}

impl fmt::Display for CertificateCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Missing => "no certificate existed",
            Self::KeyMissing => "the key of the previous certificate was missing",
            Self::CertificateMissing => "the certificate of the key was missing",
            Self::EarlyClock => {
                "the previous certificate was made before the clock was set and has expired"
            }
            Self::Expired => "the previous certificate has expired",
            Self::ApplicationUri => "the previous certificate named another ApplicationUri",
            Self::Command => "a person asked for it",
            Self::Enrolment => "the Global Discovery Server issued it",
            Self::Authority => "the authority of the plant issued it to its own server",
            Self::Administrator => "an administrator replaced it over OPC UA",
        })
    }
}

/// The role of the application that owns a certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CertificateOwner {
    /// A server, which does not share its store.
    Server,
    /// A client, which may share the store of a server with a different ApplicationUri.
    Client,
}

/// Returns the reason for replacing a certificate; `None` if it is kept. Certificates of
/// authorities are kept, because a self-made certificate would not be trusted.
pub(crate) fn outdated(
    certificate: &Certificate,
    (application_uri, owner): (&str, CertificateOwner),
    now: Duration,
) -> Option<CertificateCause> {
    if !is_self_made(certificate) {
        return None;
    }
    let (from, until) = certificate.validity();
    let is_other = certificate.application_uri().as_deref() != Some(application_uri);
    match () {
        () if until <= now && from < PLAUSIBLE => Some(CertificateCause::EarlyClock),
        () if until <= now => Some(CertificateCause::Expired),
        () if is_other && owner == CertificateOwner::Server => {
            Some(CertificateCause::ApplicationUri)
        }
        () => None,
    }
}

/// Returns whether the certificate is self-signed and was made by this project.
pub(crate) fn is_self_made(certificate: &Certificate) -> bool {
    certificate.is_self_signed() && certificate.name().contains(ORGANIZATION)
}

/// Reads the application's own certificate below the root of a store.
#[must_use]
pub fn read(root: &Path) -> Option<Certificate> {
    Certificate::read(&fs::read(root.join(OWN_CERTIFICATE)).ok()?).ok()
}

/// Replaces the application's own certificate. The key stays the same.
///
/// # Errors
/// Returns an error if the certificate cannot be written.
pub fn replace(root: &Path, certificate: &Certificate, cause: &CertificateCause) -> io::Result<()> {
    crate::pair::write(root, certificate.der(), None)?;
    report(root, cause);
    Ok(())
}

/// Logs a new certificate, and stores its cause for [`status`].
pub(crate) fn report(root: &Path, cause: &CertificateCause) {
    let Some(certificate) = read(root) else {
        return;
    };
    if let Err(error) = note(root, &certificate, cause) {
        tracing::warn!(%error, "cannot record why the certificate was made");
    }
    info!(
        name = ?certificate.name(), application_uri = ?certificate.application_uri().unwrap_or_default(),
        made_by = ?maker(&certificate), until = day(certificate.validity().1),
        "the application has a new certificate: {cause}"
    );
}

/// Describes the application's own certificate for `/status`: name, ApplicationUri, issuer, last
/// day of validity and cause.
#[cfg(feature = "server")]
#[must_use]
pub fn status(root: &Path) -> Option<Value> {
    let certificate = read(root)?;
    let noted = fs::read_to_string(root.join(NOTE)).unwrap_or_default();
    let cause = noted
        .split_once('\n')
        .filter(|(of, _)| *of == certificate.fingerprint().to_string())
        .map(|(_, cause)| cause.trim().to_owned());
    Some(json!({
        "name": certificate.name(),
        "application_uri": certificate.application_uri(),
        "made_by": maker(&certificate),
        "until": day(certificate.validity().1),
        "reason": cause,
    }))
}

/// Returns `itself`, or the name of the authority.
fn maker(certificate: &Certificate) -> String {
    match certificate.is_self_signed() {
        true => "itself".to_owned(),
        false => certificate.issuer_name(),
    }
}

fn note(root: &Path, certificate: &Certificate, cause: &CertificateCause) -> io::Result<()> {
    let mut file = fs::File::create(root.join(NOTE))?;
    write!(file, "{}\n{cause}\n", certificate.fingerprint())
}

/// Formats a day, for example 2031-11-25.
#[must_use]
pub fn day(at: Duration) -> String {
    let seconds = i64::try_from(at.as_secs()).unwrap_or_default();
    let ticks = seconds.saturating_mul(10_000_000);
    let time = opcua::types::DateTime::from(ticks.saturating_add(TICKS_TO_1970));
    time.as_chrono().format("%Y-%m-%d").to_string()
}

/// Returns the validity in days of a certificate made at this time. A certificate that is made
/// while the clock is not set is valid at once, and for the usual time from the first plausible
/// day.
pub(crate) fn days_from(now: Duration) -> u32 {
    let early = PLAUSIBLE.saturating_sub(now).as_secs() / 86_400;
    CERTIFICATE_DAYS.saturating_add(u32::try_from(early).unwrap_or_default())
}

/// Describes a certificate of the application for these hosts and for the loopback addresses.
pub(crate) fn described(
    application_uri: &str,
    hosts: &[String],
    name: &str,
    now: Duration,
) -> X509Data {
    let mut addresses: Vec<String> = Vec::new();
    for host in hosts.iter().map(String::as_str).chain(["127.0.0.1", "::1"]) {
        if !addresses.iter().any(|one| one == host) {
            addresses.push(host.to_owned());
        }
    }
    X509Data {
        key_size: 2048,
        common_name: name.to_owned(),
        organization: ORGANIZATION.to_owned(),
        organizational_unit: ORGANIZATION.to_owned(),
        country: "XX".to_owned(),
        state: "-".to_owned(),
        // The addresses of the host name are omitted, because resolving them needs a name service,
        // which may not answer.
        alt_host_names: X509Data::alt_host_names(
            application_uri,
            Some(addresses),
            true,
            true,
            false,
        ),
        certificate_duration_days: days_from(now),
    }
}

/// The file with the fingerprint of the own certificate and its cause.
const NOTE: &str = "own/reason";
/// Five years, as in other OPC UA stacks: clients trust this very file, so a new certificate causes
/// manual work.
pub(crate) const CERTIFICATE_DAYS: u32 = 1826;
const ORGANIZATION: &str = "UA bridge";
/// The earliest plausible time of a clock: 2026-01-01, before this version was made.
pub(crate) const PLAUSIBLE: Duration = Duration::from_secs(1_767_225_600);
/// Units of 100 ns from 1601 to 1970.
const TICKS_TO_1970: i64 = 116_444_736_000_000_000;

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use opcua::crypto::{PrivateKey, X509};

    use super::*;

    const DAY: Duration = Duration::from_secs(86_400);

    /// Returns a certificate of `urn:a`, made at this moment.
    fn made() -> Certificate {
        let data = described("urn:a", &["localhost".to_owned()], "UA bridge", DAY);
        let key = PrivateKey::new(2048).unwrap();
        let made = X509::from_pkey(&key, &data).unwrap();
        Certificate::read(&made.to_der().unwrap()).unwrap()
    }

    #[test]
    fn a_certificate_made_in_1970_is_valid_once_the_clock_is_set() {
        let until = |now: Duration| now + DAY * days_from(now);
        assert_eq!(days_from(PLAUSIBLE + DAY), CERTIFICATE_DAYS);
        assert!(until(DAY) >= PLAUSIBLE + DAY * (CERTIFICATE_DAYS - 1));
    }

    #[test]
    fn a_self_made_certificate_is_made_anew_for_another_uri_and_after_its_end_alone() {
        let certificate = made();
        let (from, until) = certificate.validity();
        let why = |uri, owner, now| outdated(&certificate, (uri, owner), now);
        assert_eq!(why("urn:a", CertificateOwner::Server, from + DAY), None);
        assert_eq!(why("urn:a", CertificateOwner::Server, until - DAY), None);
        assert_eq!(
            why("urn:a", CertificateOwner::Server, until + DAY),
            Some(CertificateCause::Expired)
        );
        assert_eq!(
            why("urn:b", CertificateOwner::Server, from + DAY),
            Some(CertificateCause::ApplicationUri)
        );
        assert_eq!(why("urn:b", CertificateOwner::Client, from + DAY), None);
    }

    #[test]
    fn the_status_says_who_made_the_certificate_and_why() {
        let root: PathBuf = std::env::temp_dir().join(format!("plant-own-{}", std::process::id()));
        drop(fs::remove_dir_all(&root));
        fs::create_dir_all(root.join("own")).unwrap();
        assert_eq!(status(&root), None);
        fs::write(root.join(OWN_CERTIFICATE), made().der()).unwrap();
        report(&root, &CertificateCause::Command);
        let said = status(&root).unwrap();
        assert_eq!(said["application_uri"], "urn:a");
        assert_eq!(said["made_by"], "itself");
        assert_eq!(said["reason"], "a person asked for it");
        assert_eq!(said["until"].as_str().unwrap().len(), 10);
        // A stored cause of another certificate is ignored.
        fs::write(root.join(NOTE), "0000\nit was found\n").unwrap();
        assert_eq!(status(&root).unwrap()["reason"], Value::Null);
        fs::remove_dir_all(root).unwrap();
    }
}
