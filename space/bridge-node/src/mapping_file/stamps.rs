//! The stamps of files, which tell whether a file has changed.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// The files and folders that were read or looked for, each with its stamp from before the reading.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct SeenFiles {
    /// The mapping and its includes.
    pub(super) mapping: Stamps,
    /// The files and folders at and below the `type_paths`.
    pub(super) types: Stamps,
}

impl SeenFiles {
    /// Returns whether any definition file or folder of this turn has changed.
    pub(super) fn types_differ(&self, turn: usize) -> bool {
        let turns = self.types.len().div_ceil(LOOKED_AT_ONCE).max(1);
        let first = turn % turns * LOOKED_AT_ONCE;
        let mut types = self.types.iter().skip(first).take(LOOKED_AT_ONCE);
        types.any(|(file, was)| stamp(file) != *was)
    }
}

/// The stamps of files; `None` for a missing file.
pub(super) type Stamps = BTreeMap<PathBuf, Option<FileStamp>>;

/// The properties that change when a file is written or replaced, or when the link to it changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FileStamp {
    device: u64,
    inode: u64,
    pub(super) len: u64,
    modified: (i64, i64),
    changed: (i64, i64),
}

pub(super) fn stamp(file: &Path) -> Option<FileStamp> {
    let found = std::fs::metadata(file).ok()?;
    Some(FileStamp {
        device: found.dev(),
        inode: found.ino(),
        len: found.len(),
        modified: (found.mtime(), found.mtime_nsec()),
        changed: (found.ctime(), found.ctime_nsec()),
    })
}

/// Records the stamp of a path. The first stamp counts, because the file may be read afterwards.
pub(super) fn see(seen: &mut Stamps, path: &Path) {
    if !seen.contains_key(path) {
        seen.insert(path.to_owned(), stamp(path));
    }
}

/// Returns the present stamps of the same files.
pub(super) fn again(stamps: &Stamps) -> Stamps {
    let files = stamps.keys();
    files.map(|file| (file.clone(), stamp(file))).collect()
}

/// The maximal number of definition files and folders checked in each poll: about 1000 a second
/// while nothing changes, at a microsecond or two each.
const LOOKED_AT_ONCE: usize = 1024;
