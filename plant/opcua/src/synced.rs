//! Crash-safe replacement of files: after a killed process or a full disk, a file has its old or
//! its new content. Claims of files by one of several processes.

use std::fs::{self, File, TryLockError};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

/// Replaces the content of a file that only its owner may read. A reader sees the old or the new
/// content.
///
/// # Errors
/// Returns an error if the file cannot be written. The old content is then unchanged.
pub fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut beside = path.as_os_str().to_owned();
    beside.push(".new");
    let beside = PathBuf::from(beside);
    write_synced_for_owner(&beside, content)?;
    rename_synced(&beside, path)
}

/// Locks a file until the returned file and its clones, including the clones of child processes,
/// are closed. The file is created if necessary. Returns `None` if another process holds the lock.
///
/// # Errors
/// Returns an error if the file cannot be created or locked.
pub fn claim(path: &Path) -> io::Result<Option<File>> {
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false);
    let file = options.open(path)?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Ok(None),
        // Some network file systems have no locks.
        Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {
            Ok(Some(file))
        }
        Err(TryLockError::Error(error)) => Err(error),
    }
}

pub(crate) fn write_synced(path: &Path, content: &[u8]) -> io::Result<()> {
    let mut file = File::create(path)?;
    file.write_all(content)?;
    file.sync_all()
}

/// Writes a file that only its owner may read, from its creation on.
pub(crate) fn write_synced_for_owner(path: &Path, content: &[u8]) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        Ok(()) | Err(_) => {}
    }
    let mut file = owners_file(path)?;
    file.write_all(content)?;
    file.sync_all()
}

/// Renames a file, and syncs the folder so that the rename survives a power failure.
pub(crate) fn rename_synced(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    match to.parent() {
        // Some file systems cannot sync a folder. The file itself is already synced.
        Some(folder) => {
            drop(File::open(folder).and_then(|folder| folder.sync_all()));
            Ok(())
        }
        None => Ok(()),
    }
}

#[cfg(unix)]
fn owners_file(path: &Path) -> io::Result<File> {
    use std::os::unix::fs::OpenOptionsExt as _;
    fs::OpenOptions::new()
        .write(true)
        .create_new(true)
        .mode(0o600)
        .open(path)
}

#[cfg(not(unix))]
fn owners_file(path: &Path) -> io::Result<File> {
    File::create_new(path)
}
