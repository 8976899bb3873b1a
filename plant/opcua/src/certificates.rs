//! The certificates of a certificate store: list, trust, reject.

use std::fs;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

use opcua::crypto::{CertificateStore, X509};
use x509_cert::Certificate as Parsed;
use x509_cert::der::Decode as _;
use x509_cert::ext::pkix::SubjectAltName;
use x509_cert::ext::pkix::name::GeneralName;

/// The role of a certificate in the store, which decides on access.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Standing {
    /// The application's own certificate.
    Own,
    /// A trusted certificate: its holder may connect.
    Trusted,
    /// The certificate of an authority that completes chains and is not trusted itself.
    Issuer,
    /// A rejected certificate: its holder is refused until an operator trusts the certificate.
    Rejected,
}

impl Standing {
    /// Returns the name of the role, which is also the name of the folder.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Own => "own",
            Self::Trusted => "trusted",
            Self::Issuer => "issuers",
            Self::Rejected => "rejected",
        }
    }
}

/// A certificate in a store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stored {
    /// The role of the certificate.
    pub standing: Standing,
    /// The path of the file.
    pub path: PathBuf,
    /// The SHA-1 thumbprint in lower-case hexadecimal.
    pub thumbprint: String,
    /// The common name of the subject. The creator of the certificate chose it freely.
    pub name: String,
    /// The ApplicationUri of the certificate.
    pub application_uri: Option<String>,
    /// The last day of the validity, for example 2031-11-25.
    pub until: String,
    /// Whether the certificate is valid at the moment.
    pub is_valid: bool,
    /// Whether the certificate belongs to an authority. If trusted, it covers all certificates that
    /// the authority issues.
    pub is_authority: bool,
}

/// An error of the certificate store.
#[derive(Debug, thiserror::Error)]
pub enum StoreFault {
    /// The store cannot be read or written.
    #[error("{path}: {source}")]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The error of the operating system.
        #[source]
        source: io::Error,
    },
    /// The file is not a certificate.
    #[error("{path} is not a certificate: {why}")]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The reason.
        why: String,
    },
    /// No connection can use the certificate, so it cannot be trusted.
    #[error("{path} is not usable: {why}")]
    Useless {
        /// The file.
        path: PathBuf,
        /// The reason.
        why: String,
    },
    /// No certificate has a thumbprint with this prefix.
    #[error(
        "no {standing} certificate has a thumbprint that begins with `{given}`, and no file has this name"
    )]
    Unknown {
        /// The folder that was searched.
        standing: &'static str,
        /// The given prefix.
        given: String,
    },
    /// Several certificates have a thumbprint with this prefix.
    #[error("several certificates have a thumbprint that begins with `{0}`: give more digits")]
    Several(String),
}

/// Returns the certificates of a store: own, trusted, issuers and rejected. Files that are not
/// certificates are skipped.
///
/// # Errors
/// Returns an error if an existing directory cannot be read.
pub fn list(root: &Path) -> Result<Vec<Stored>, StoreFault> {
    let mut found: Vec<Stored> = stored(&root.join(OWN), Standing::Own).into_iter().collect();
    for standing in [Standing::Trusted, Standing::Issuer, Standing::Rejected] {
        let folder = root.join(standing.name());
        let entries = match fs::read_dir(&folder) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            Err(source) => {
                return Err(StoreFault::Io {
                    path: folder,
                    source,
                });
            }
        };
        let mut here: Vec<Stored> = entries
            .take(MOST_LISTED)
            .filter_map(|entry| stored(&entry.ok()?.path(), standing))
            .collect();
        here.sort_by(|a, b| (&a.name, &a.thumbprint).cmp(&(&b.name, &b.thumbprint)));
        found.extend(here);
    }
    Ok(found)
}

/// Trusts a certificate: a rejected certificate, by the first digits of its thumbprint, or a
/// certificate in a DER or PEM file.
///
/// # Errors
/// Returns an error if no certificate matches, if no connection can use the certificate, or if the
/// store cannot be written.
pub fn trust(root: &Path, given: &str) -> Result<Stored, StoreFault> {
    let file = Path::new(given);
    if file.is_file() {
        let certificate = read(file)?;
        check_use(&certificate, file)?;
        let kept = keep(root, &certificate, Standing::Trusted)?;
        let all = list(root)?;
        let refused = all
            .iter()
            .filter(|one| one.standing == Standing::Rejected && one.thumbprint == kept.thumbprint);
        remove(refused)?;
        return Ok(kept);
    }
    transfer(root, given, (Standing::Rejected, Standing::Trusted))
}

/// Moves a trusted certificate to the rejected certificates, by the first digits of its thumbprint.
/// Its holder is refused from the next connection on.
///
/// # Errors
/// Returns an error if no certificate matches or if the store cannot be written.
pub fn reject(root: &Path, given: &str) -> Result<Stored, StoreFault> {
    transfer(root, given, (Standing::Trusted, Standing::Rejected))
}

fn transfer(
    root: &Path,
    given: &str,
    (from, to): (Standing, Standing),
) -> Result<Stored, StoreFault> {
    let begin = given.to_lowercase();
    let is_hex = begin.len() >= FEWEST_DIGITS && begin.bytes().all(|b| b.is_ascii_hexdigit());
    let all = list(root)?;
    let mut fitting = all
        .iter()
        .filter(|one| is_hex && one.standing == from && one.thumbprint.starts_with(&begin));
    let Some(first) = fitting.next() else {
        return Err(StoreFault::Unknown {
            standing: from.name(),
            given: given.chars().take(64).collect(),
        });
    };
    if fitting.any(|other| other.thumbprint != first.thumbprint) {
        return Err(StoreFault::Several(begin));
    }
    let certificate = read(&first.path)?;
    if to == Standing::Trusted {
        check_use(&certificate, &first.path)?;
    }
    let kept = keep(root, &certificate, to)?;
    // The library refuses a certificate that is both trusted and rejected.
    let same = all
        .iter()
        .filter(|one| one.standing == from && one.thumbprint == first.thumbprint);
    remove(same)?;
    Ok(kept)
}

fn remove<'s>(gone: impl Iterator<Item = &'s Stored>) -> Result<(), StoreFault> {
    for one in gone {
        fs::remove_file(&one.path).map_err(|source| StoreFault::Io {
            path: one.path.clone(),
            source,
        })?;
    }
    Ok(())
}

/// Stores a rejected certificate so that an operator can decide on it. The oldest rejected
/// certificates are deleted beyond the limit, because any peer can add certificates.
///
/// # Errors
/// Returns an error if the library cannot read the certificate or if the store cannot be written.
pub fn keep_refused(root: &Path, certificate: &trust::Certificate) -> Result<Stored, StoreFault> {
    let folder = root.join(Standing::Rejected.name());
    let of_library =
        X509::from_der(certificate.der()).map_err(|error| StoreFault::Certificate {
            path: folder.clone(),
            why: error.to_string(),
        })?;
    let path = folder.join(CertificateStore::cert_file_name(&of_library));
    if let Some(there) = stored(&path, Standing::Rejected) {
        return Ok(there);
    }
    let entries = fs::read_dir(&folder).into_iter().flatten().flatten();
    let mut all: Vec<_> = entries
        .filter_map(|entry| Some((entry.metadata().ok()?.modified().ok()?, entry.path())))
        .collect();
    all.sort();
    let room = REJECTED_KEPT.saturating_sub(1);
    for (_, oldest) in all.iter().take(all.len().saturating_sub(room)) {
        fs::remove_file(oldest).map_err(|source| StoreFault::Io {
            path: oldest.clone(),
            source,
        })?;
    }
    keep(root, &of_library, Standing::Rejected)
}

/// Writes a certificate to the folder and file name that the library expects.
fn keep(root: &Path, certificate: &X509, standing: Standing) -> Result<Stored, StoreFault> {
    let folder = root.join(standing.name());
    let path = folder.join(CertificateStore::cert_file_name(certificate));
    let der = certificate
        .to_der()
        .map_err(|error| StoreFault::Certificate {
            path: path.clone(),
            why: error.to_string(),
        })?;
    let written = fs::create_dir_all(&folder).and_then(|()| fs::write(&path, der));
    written.map_err(|source| StoreFault::Io {
        path: path.clone(),
        source,
    })?;
    stored(&path, standing).ok_or_else(|| StoreFault::Certificate {
        path,
        why: "the written file cannot be read again".to_owned(),
    })
}

/// Checks that the security policies and the rules of OPC UA (OPC 10000-6, 6.2.2) permit to use a
/// certificate at all.
fn check_use(certificate: &X509, path: &Path) -> Result<(), StoreFault> {
    let useless = |why: String| StoreFault::Useless {
        path: path.to_owned(),
        why,
    };
    let der = certificate.to_der().unwrap_or_default();
    let Ok(certificate) = trust::Certificate::read(&der) else {
        return Err(useless("it cannot be decoded".to_owned()));
    };
    match certificate.key_bits() {
        None => {
            let why = "its key is not an RSA key, which the security policies of this server need";
            return Err(useless(why.to_owned()));
        }
        Some(bits) if !(2048..=4096).contains(&bits) => {
            return Err(useless(format!(
                "its RSA key has {bits} bits, but the security policies of this server need 2048 to 4096"
            )));
        }
        Some(_) => {}
    }
    if !certificate.is_authority() && certificate.application_uri().is_none() {
        let why = "it has no ApplicationUri (a URI among its subject alternative names)";
        return Err(useless(why.to_owned()));
    }
    Ok(())
}

fn read(path: &Path) -> Result<X509, StoreFault> {
    let why = |why: &str| StoreFault::Certificate {
        path: path.to_owned(),
        why: why.to_owned(),
    };
    let mut bytes = Vec::new();
    fs::File::open(path)
        .and_then(|file| file.take(LARGEST_CERTIFICATE + 1).read_to_end(&mut bytes))
        .map_err(|source| StoreFault::Io {
            path: path.to_owned(),
            source,
        })?;
    if u64::try_from(bytes.len()).is_ok_and(|length| length > LARGEST_CERTIFICATE) {
        return Err(why("it is too large"));
    }
    let certificate = match bytes.starts_with(b"-----BEGIN") {
        true => X509::from_pem(&bytes),
        false => X509::from_der(&bytes),
    };
    certificate.map_err(|_| why("neither DER nor PEM"))
}

/// Reads the certificate in a file, and returns its description.
#[must_use]
pub fn stored(path: &Path, standing: Standing) -> Option<Stored> {
    let certificate = read(path).ok()?;
    let now = opcua::types::DateTime::now().as_chrono();
    Some(Stored {
        standing,
        path: path.to_owned(),
        thumbprint: certificate.thumbprint().as_hex_string().to_lowercase(),
        name: certificate.common_name().unwrap_or_default(),
        application_uri: application_uri(&certificate),
        until: certificate
            .not_after()
            .map_or_else(|_| String::new(), |day| day.format("%Y-%m-%d").to_string()),
        is_valid: certificate.is_time_valid(&now).is_ok(),
        is_authority: is_authority(&certificate),
    })
}

fn is_authority(certificate: &X509) -> bool {
    let der = certificate.to_der().unwrap_or_default();
    trust::Certificate::read(&der).is_ok_and(|one| one.is_authority())
}

/// Stores the certificate of an authority that completes chains, from a DER or PEM file.
///
/// # Errors
/// Returns an error if the certificate does not belong to an authority or if the store cannot be
/// written.
pub fn keep_issuer(root: &Path, file: &Path) -> Result<Stored, StoreFault> {
    let certificate = read(file)?;
    if !is_authority(&certificate) {
        return Err(StoreFault::Certificate {
            path: file.to_owned(),
            why: "it is not the certificate of an authority".to_owned(),
        });
    }
    keep(root, &certificate, Standing::Issuer)
}

/// Returns the ApplicationUri of a certificate: the URI of its subject alternative names (OPC
/// 10000-6, 6.2.2).
#[must_use]
pub fn application_uri(certificate: &X509) -> Option<String> {
    let der = certificate.to_der().ok()?;
    let parsed = Parsed::from_der(&der).ok()?;
    let (_, names) = parsed.tbs_certificate.get::<SubjectAltName>().ok()??;
    names.0.iter().find_map(|name| {
        let GeneralName::UniformResourceIdentifier(uri) = name else {
            return None;
        };
        Some(uri.as_str().to_owned())
    })
}

/// The path of the application's own certificate below the root.
pub(crate) const OWN: &str = "own/cert.der";
/// Minimum number of digits of a thumbprint that identify a certificate.
const FEWEST_DIGITS: usize = 4;
/// Maximum number of rejected certificates in the store.
pub(crate) const REJECTED_KEPT: usize = 100;
const LARGEST_CERTIFICATE: u64 = 64 << 10;
/// Maximum number of files of a folder that are read.
const MOST_LISTED: usize = 10_000;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pki::Pki;

    fn scratch(name: &str) -> PathBuf {
        let path =
            std::env::temp_dir().join(format!("plant-opcua-store-{}-{name}", std::process::id()));
        drop(fs::remove_dir_all(&path));
        path
    }

    #[test]
    fn a_refused_certificate_is_trusted_by_its_thumbprint_and_refused_again() {
        let root = scratch("decided");
        let pki = Pki::open(root.clone()).unwrap();
        pki.ensure_own("urn:cell:server", "localhost").unwrap();
        fs::copy(root.join(OWN), root.join("rejected/somebody.der")).unwrap();
        let all = list(&root).unwrap();
        let standings: Vec<Standing> = all.iter().map(|one| one.standing).collect();
        assert_eq!(standings, [Standing::Own, Standing::Rejected]);
        assert_eq!(all[1].application_uri.as_deref(), Some("urn:cell:server"));
        assert!(all[1].is_valid);

        let digits = all[1].thumbprint[..8].to_uppercase();
        let trusted = trust(&root, &digits).unwrap();
        assert_eq!(trusted.standing, Standing::Trusted);
        let standings: Vec<Standing> = list(&root)
            .unwrap()
            .iter()
            .map(|one| one.standing)
            .collect();
        assert_eq!(standings, [Standing::Own, Standing::Trusted]);
        assert!(matches!(
            trust(&root, &digits),
            Err(StoreFault::Unknown { .. })
        ));

        reject(&root, &digits).unwrap();
        assert_eq!(list(&root).unwrap()[1].standing, Standing::Rejected);
        let file = root.join(OWN);
        assert_eq!(
            trust(&root, file.to_str().unwrap()).unwrap().standing,
            Standing::Trusted
        );
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn a_certificate_that_no_connection_can_use_is_not_trusted() {
        use opcua::crypto::X509Data;

        let root = scratch("useless");
        let _pki = Pki::open(root.clone()).unwrap();
        let file = root.join("rejected/client.der");
        let refused = |key_size: u32, uri: Option<&str>| {
            let mut data = X509Data {
                key_size,
                ..X509Data::sample_cert()
            };
            let _names = std::mem::take(&mut data.alt_host_names);
            if let Some(uri) = uri {
                data.alt_host_names.add_uri(uri);
            }
            data.alt_host_names.add_dns("localhost");
            let (certificate, _) = X509::cert_and_pkey(&data).unwrap();
            fs::write(&file, certificate.to_der().unwrap()).unwrap();
            let thumbprint = certificate.thumbprint().as_hex_string();
            let by_file = trust(&root, file.to_str().unwrap());
            let by_digits = trust(&root, &thumbprint);
            match (by_file, by_digits) {
                (Err(StoreFault::Useless { why, .. }), Err(StoreFault::Useless { .. })) => {
                    Some(why)
                }
                _ => None,
            }
        };
        let short = refused(1024, Some("urn:client")).unwrap();
        assert!(short.contains("1024 bits"), "{short}");
        let nameless = refused(2048, None).unwrap();
        assert!(nameless.contains("ApplicationUri"), "{nameless}");
        assert_eq!(refused(2048, Some("urn:client")), None);
        fs::remove_dir_all(root).unwrap();
    }

    #[test]
    fn what_is_no_thumbprint_and_no_file_is_said_to_be_unknown() {
        let root = scratch("unknown");
        for given in ["", "12", "../../etc/passwd", "zzzzzzzz"] {
            assert!(trust(&root, given).is_err(), "{given}");
        }
    }
}
