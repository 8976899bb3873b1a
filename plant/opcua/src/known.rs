//! What a certificate store knows of authorities: those that are trusted, those between, and their revocation lists.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use tracing::warn;
use trust::{Certificate, Crl, Known};

use crate::certificates::StoreFault;

/// Reads what a store knows. A file that is neither a certificate nor a list is left out.
#[must_use]
pub fn read(root: &Path) -> Known {
    let certificates = |folder: &str| -> Vec<Certificate> {
        let all = files(&root.join(folder)).into_iter();
        all.filter_map(|path| Certificate::read(&bytes(&path)?).ok())
            .collect()
    };
    let lists = files(&root.join(CRLS)).into_iter();
    Known {
        trusted: certificates(TRUSTED),
        issuers: certificates(ISSUERS),
        crls: lists
            .filter_map(|path| Crl::read(&bytes(&path)?).ok())
            .collect(),
    }
}

/// Whether an authority is trusted in a store, so that those whom it issued certificates are let in.
#[must_use]
pub fn trusts_authorities(root: &Path) -> bool {
    let trusted = files(&root.join(TRUSTED)).into_iter();
    let mut read = trusted.filter_map(|path| Certificate::read(&bytes(&path)?).ok());
    read.any(|one| one.is_authority())
}

/// The files of a store, with their lengths and the times of their last change.
pub type Stamp = Vec<(PathBuf, u64, Option<SystemTime>)>;

/// What a look at the files of a store says without reading them: another value once one has changed.
#[must_use]
pub fn stamp(root: &Path) -> Stamp {
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

/// Whether a file is a revocation list.
#[must_use]
pub fn is_crl(file: &Path) -> bool {
    bytes(file).is_some_and(|bytes| Crl::read(&bytes).is_ok())
}

/// Keeps a revocation list of an authority, in the place of an older one of it.
///
/// # Errors
/// The file is no list, its authority is not known to the store, or the store cannot be written.
pub fn keep_crl(root: &Path, file: &Path) -> Result<PathBuf, StoreFault> {
    let why = |why: &str| StoreFault::Certificate {
        path: file.to_owned(),
        why: why.to_owned(),
    };
    let read = bytes(file).ok_or_else(|| why("it cannot be read, or is too large"))?;
    let list = Crl::read(&read).map_err(|_| why("it is no revocation list either"))?;
    put_crl(root, &list)?.ok_or_else(|| {
        why("it is the revocation list of an authority that is not known here: trust that first")
    })
}

/// The same of a list that is at hand; `None` where its authority is not known.
///
/// # Errors
/// The store cannot be written.
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
    // Others of the same authority under other names are older, or the same.
    for other in files(&folder) {
        let of_it = bytes(&other).and_then(|bytes| Crl::read(&bytes).ok());
        let Some(of_it) = of_it.filter(|crl| crl.is_of(authority)) else {
            continue;
        };
        if of_it.times().0 > list.times().0 {
            warn!(file = %other.display(), "a newer revocation list of the authority is there already, and stays");
            return Ok(Some(other));
        }
        if other != path {
            fs::remove_file(&other).map_err(failed)?;
        }
    }
    fs::write(&path, list.der()).map_err(failed)?;
    Ok(Some(path))
}

/// The time that certificates are judged by, since 1970.
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

/// Who is trusted: applications, and authorities.
pub const TRUSTED: &str = "trusted";
/// Authorities that are known and not trusted themselves.
pub const ISSUERS: &str = "issuers";
/// Revocation lists of both.
pub const CRLS: &str = "crl";
const MOST_FILES: usize = 10_000;
/// A list of some ten thousand revoked certificates.
const LARGEST: u64 = 1 << 20;
