//! The files of an application's own certificate and private key. Files are written beside the old
//! files, synced and renamed, the key first. After a killed process or a full disk, the next start
//! therefore finds a usable pair.

use std::fs;
use std::io;
use std::path::Path;

use trust::Certificate;
use x509_cert::der::pem::{self, LineEnding};

use crate::certificates;
use crate::synced::{rename_synced, write_synced, write_synced_for_owner};

/// The path of the application's own certificate below the root.
pub const OWN_CERTIFICATE: &str = certificates::OWN;
/// The path of its private key below the root.
pub const OWN_KEY: &str = "private/private.pem";

/// The existing files of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PairFiles {
    /// Certificate and key exist.
    Both,
    /// Only the key exists.
    Key,
    /// Only the certificate exists.
    Certificate,
    /// Neither exists.
    Neither,
}

/// Replaces the certificate below `root`, and the private key (DER of PKCS #8) if a new key is
/// given.
///
/// # Errors
/// Returns an error if a file cannot be written. The previous pair is then unchanged.
pub(crate) fn write(root: &Path, certificate: &[u8], key: Option<&[u8]>) -> io::Result<()> {
    let (path, key_path) = (root.join(OWN_CERTIFICATE), root.join(OWN_KEY));
    let beside = path.with_extension(BESIDE);
    let key_beside = key_path.with_extension(BESIDE);
    let written = write_synced(&beside, certificate).and_then(|()| match key {
        Some(key) => {
            let pem = pem::encode_string("PRIVATE KEY", LineEnding::LF, key);
            let pem = pem.map_err(|error| io::Error::other(error.to_string()))?;
            write_synced_for_owner(&key_beside, pem.as_bytes())
        }
        None => Ok(()),
    });
    if let Err(error) = written {
        for path in [&beside, &key_beside] {
            // The next start removes remaining files.
            drop(fs::remove_file(path));
        }
        return Err(error);
    }
    if key.is_some() {
        rename_synced(&key_beside, &key_path)?;
    }
    rename_synced(&beside, &path)
}

/// Completes or removes the result of an interrupted [`write`], and restricts the key to its owner.
///
/// # Errors
/// Returns an error if a file cannot be read, renamed or removed.
pub(crate) fn settle(root: &Path) -> io::Result<PairFiles> {
    let (path, key_path) = (root.join(OWN_CERTIFICATE), root.join(OWN_KEY));
    let beside = path.with_extension(BESIDE);
    if let Some(waiting) = content(&beside)?
        && let Ok(waiting) = Certificate::read(&waiting)
        && let Some(key) = content(&key_path)?
        && let Some(key) = from_pem(&key)
        && waiting.is_of_private_key(&key)
    {
        let current = content(&path)?.and_then(|bytes| Certificate::read(&bytes).ok());
        // The key was renamed, but its certificate was not.
        if !current.is_some_and(|current| current.is_of_private_key(&key)) {
            rename_synced(&beside, &path)?;
        }
    }
    for path in [&beside, &key_path.with_extension(BESIDE)] {
        match fs::remove_file(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            Ok(()) | Err(_) => {}
        }
    }
    let (certificate, key) = (content(&path)?, content(&key_path)?);
    if key.is_some() {
        for_owner_alone(&key_path)?;
    }
    Ok(match (certificate.is_some(), key.is_some()) {
        (true, true) => PairFiles::Both,
        (true, false) => PairFiles::Certificate,
        (false, true) => PairFiles::Key,
        (false, false) => PairFiles::Neither,
    })
}

/// Decodes a PEM key into the DER of PKCS #8.
pub(crate) fn from_pem(bytes: &[u8]) -> Option<Vec<u8>> {
    let key = opcua::crypto::PrivateKey::from_pem(bytes).ok()?;
    Some(key.to_der().ok()?.as_bytes().to_vec())
}

/// Reads a file. Returns `None` for a missing file and for an empty file, which a full disk leaves.
fn content(path: &Path) -> io::Result<Option<Vec<u8>>> {
    match fs::read(path) {
        Ok(bytes) => Ok(Some(bytes).filter(|bytes| !bytes.is_empty())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error),
    }
}

/// Removes the access of other users to a key. A key that belongs to another user is not changed.
#[cfg(unix)]
fn for_owner_alone(path: &Path) -> io::Result<()> {
    use std::os::unix::fs::PermissionsExt as _;
    let mode = fs::metadata(path)?.permissions().mode();
    if mode & 0o077 == 0 {
        return Ok(());
    }
    match fs::set_permissions(path, fs::Permissions::from_mode(0o600)) {
        Ok(()) => {
            tracing::info!(key = %path.display(), "restricted the private key to its owner");
        }
        Err(error) => {
            tracing::warn!(key = %path.display(), %error, "other users can read the private key: `chmod 600` it");
        }
    }
    Ok(())
}

#[cfg(not(unix))]
fn for_owner_alone(_path: &Path) -> io::Result<()> {
    Ok(())
}

/// The extension of files during writing.
const BESIDE: &str = "new";
