//! Files of bounded size.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;

/// The reason why a file is not read.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The file cannot be opened or read.
    #[error(transparent)]
    Unreadable(#[from] io::Error),
    /// The file has more bytes than its bound.
    #[error("it is larger than {}", size(*most))]
    TooLarge {
        /// The bound, in bytes.
        most: u64,
    },
}

fn size(bytes: u64) -> String {
    match bytes >> 20 {
        0 => format!("{} KiB", bytes >> 10),
        mebibytes => format!("{mebibytes} MiB"),
    }
}

/// Reads a file of any kind, such as a pipe, within a bound.
///
/// # Errors
/// The file cannot be read, or it has more than `most` bytes.
pub fn read_bounded(file: &Path, most: u64) -> Result<Vec<u8>, FileError> {
    let mut bytes = Vec::new();
    let opened = File::open(file)?;
    opened
        .take(most.saturating_add(1))
        .read_to_end(&mut bytes)?;
    if u64::try_from(bytes.len()).is_ok_and(|length| length <= most) {
        return Ok(bytes);
    }
    Err(FileError::TooLarge { most })
}
