//! The authorities in a certificate store: trusted certificates, issuer certificates and revocation
//! lists.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use tracing::warn;
use trust::{Certificate, Crl, TrustedCertificates};

use crate::certificates::StoreFault;

/// Reads the content of a store. Files that are neither certificates nor revocation lists are
/// skipped.
#[must_use]
pub fn read(root: &Path) -> TrustedCertificates {
    let certificates = |folder: &str| -> Vec<Certificate> {
        let all = files(&root.join(folder)).into_iter();
        all.filter_map(|path| Certificate::read(&bytes(&path)?).ok())
            .collect()
    };
    let lists = files(&root.join(CRLS)).into_iter();
    TrustedCertificates {
        trusted: certificates(TRUSTED),
        issuers: certificates(ISSUERS),
        crls: lists
            .filter_map(|path| Crl::read(&bytes(&path)?).ok())
            .collect(),
    }
}

/// Returns whether a store trusts an authority, so that certificates of the authority are accepted.
#[must_use]
pub fn trusts_authorities(root: &Path) -> bool {
    let trusted = files(&root.join(TRUSTED)).into_iter();
    let mut read = trusted.filter_map(|path| Certificate::read(&bytes(&path)?).ok());
    read.any(|one| one.is_authority())
}

/// The files of a store with their lengths and modification times.
pub type StoreStamp = Vec<(PathBuf, u64, Option<SystemTime>)>;

/// Returns the state of the files of a store without reading them. The value changes when a file
/// changes.
#[must_use]
pub fn stamp(root: &Path) -> StoreStamp {
    let mut all = Vec::new();
    for folder in [TRUSTED, ISSUERS, CRLS] {
        for path in files(&root.join(folder)) {
            if let Ok(about) = fs::metadata(&path) {
                all.push((path, about.len(), about.modified().ok()));
            }
        }
    }
    all
}

/// Returns whether a file is a revocation list.
#[must_use]
pub fn is_crl(file: &Path) -> bool {
    bytes(file).is_some_and(|bytes| Crl::read(&bytes).is_ok())
}

/// Stores the revocation list of an authority, and replaces an older list of the authority.
///
/// # Errors
/// Returns an error if the file is not a revocation list, if the store does not contain its
/// authority, or if the store cannot be written.
pub fn keep_crl(root: &Path, file: &Path) -> Result<PathBuf, StoreFault> {
    let why = |why: &str| StoreFault::Certificate {
        path: file.to_owned(),
        why: why.to_owned(),
    };
    let read = bytes(file).ok_or_else(|| why("it cannot be read, or is too large"))?;
    let list = Crl::read(&read).map_err(|_| why("it is not a revocation list either"))?;
    put_crl(root, &list)?.ok_or_else(|| {
        why("it is the revocation list of an unknown authority: trust the authority first")
    })
}

/// Stores a decoded revocation list. Returns `None` if the store does not contain its authority.
///
/// # Errors
/// Returns an error if the store cannot be written.
pub fn put_crl(root: &Path, list: &Crl) -> Result<Option<PathBuf>, StoreFault> {
    let known = read(root);
    let mut authorities = known.trusted.iter().chain(&known.issuers);
    let Some(authority) = authorities.find(|one| list.is_of(one)) else {
        return Ok(None);
    };
    let folder = root.join(CRLS);
    let path = folder.join(format!("{}.crl", authority.serial()));
    let failed = |source| StoreFault::Io {
        path: path.clone(),
        source,
    };
    fs::create_dir_all(&folder).map_err(failed)?;
    // Older lists of the same authority are removed. A newer list stays, and the given list is
    // ignored.
    for other in files(&folder) {
        let of_it = bytes(&other).and_then(|bytes| Crl::read(&bytes).ok());
        let Some(of_it) = of_it.filter(|crl| crl.is_of(authority)) else {
            continue;
        };
        if of_it.times().0 > list.times().0 {
            warn!(file = %other.display(), "kept the stored revocation list of the authority, which is newer");
            return Ok(Some(other));
        }
        if other != path {
            fs::remove_file(&other).map_err(failed)?;
        }
    }
    fs::write(&path, list.der()).map_err(failed)?;
    Ok(Some(path))
}

/// Returns the time for judging certificates, since 1970.
#[must_use]
pub fn now() -> Duration {
    let now = opcua::types::DateTime::now().as_chrono().timestamp();
    Duration::from_secs(u64::try_from(now).unwrap_or_default())
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().take(MOST_FILES);
    let mut all: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    all.sort();
    all
}

fn bytes(path: &Path) -> Option<Vec<u8>> {
    let about = fs::metadata(path).ok()?;
    let fits = about.is_file() && about.len() <= LARGEST;
    fits.then(|| fs::read(path).ok()).flatten()
}

/// The folder of trusted certificates, of applications and of authorities.
pub const TRUSTED: &str = "trusted";
/// The folder of issuer certificates, which are not trusted themselves.
pub const ISSUERS: &str = "issuers";
/// The folder of revocation lists of trusted authorities and of issuers.
pub const CRLS: &str = "crl";
const MOST_FILES: usize = 10_000;
/// Largest file, in bytes: a list of about ten thousand revoked certificates.
const LARGEST: u64 = 1 << 20;
