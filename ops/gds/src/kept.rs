//! Small lists that the server and the verbs of the command line share: each change reads the file, and writes it as a whole
//! while others wait.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::records::replace;

/// Reads the list in a file; an empty one without the file.
///
/// # Errors
/// A file that cannot be read as the list.
pub(crate) fn read<T: DeserializeOwned + Default>(path: &Path) -> io::Result<T> {
    match fs::read(path) {
        Ok(bytes) => Ok(serde_json::from_slice(&bytes)?),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(T::default()),
        Err(error) => Err(error),
    }
}

/// Waits until no other process holds the lock of a file, and holds it until the file is dropped.
///
/// # Errors
/// The file cannot be made.
pub(crate) fn lock(path: &Path) -> io::Result<File> {
    let file = File::create(path)?;
    match file.lock() {
        // Some network file systems have no locks.
        Err(error) if error.kind() != io::ErrorKind::Unsupported => Err(error),
        Ok(()) | Err(_) => Ok(file),
    }
}

/// Changes the list in a file. Nothing is written if the list stays as it is.
///
/// # Errors
/// A file that cannot be read as the list, or cannot be written.
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
