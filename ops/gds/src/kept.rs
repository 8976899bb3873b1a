//! Small lists that the server and the command line share. Each change locks and reads the file,
//! and replaces it as a whole.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::records::replace;

/// Reads the list in a file. A missing file is an empty list.
///
/// # Errors
/// Returns an error if the file cannot be read as the list.
pub(crate) fn read<T: DeserializeOwned + Default>(path: &Path) -> io::Result<T> {
    match fs::read(path) {
        Ok(bytes) => Ok(serde_json::from_slice(&bytes)?),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(T::default()),
        Err(error) => Err(error),
    }
}

/// Waits for the lock of a file. The lock is held until the returned file is dropped.
///
/// # Errors
/// Returns an error if the file cannot be created.
pub(crate) fn lock(path: &Path) -> io::Result<File> {
    let file = File::create(path)?;
    match file.lock() {
        // Some network file systems have no locks.
        Err(error) if error.kind() != io::ErrorKind::Unsupported => Err(error),
        Ok(()) | Err(_) => Ok(file),
    }
}

/// Changes the list in a file. An unchanged list is not written.
///
/// # Errors
/// Returns an error if the file cannot be read as the list, or cannot be written.
pub(crate) fn change<T, R>(path: &Path, change: impl FnOnce(&mut T) -> R) -> io::Result<R>
where
    T: Serialize + DeserializeOwned + Default + Clone + PartialEq,
{
    let _alone = lock(&path.with_extension("lock"))?;
    let before: T = read(path)?;
    let mut list = before.clone();
    let changed = change(&mut list);
    if list != before {
        replace(path, &serde_json::to_vec_pretty(&list)?)?;
    }
    Ok(changed)
}
