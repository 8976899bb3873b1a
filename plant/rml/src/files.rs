//! The files that a mapping reads.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Read as _};
use std::path::{Path, PathBuf};

/// Reason for which a file of a mapping cannot be read, with the remedy.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MappingFileFault {
    /// The name is a URL.
    #[error("it is a URL, and nothing is fetched; save the file beside the mapping and name it")]
    Url,
    /// The path does not exist, or cannot be resolved.
    #[error("cannot open {}: {error}", path.display())]
    Open {
        /// The path of the file or folder.
        path: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// The file is outside of the folder of the mapping.
    #[error("it is outside of the folder {}; move it there, or give it as NAME=FILE", .0.display())]
    Outside(PathBuf),
    /// The path is a folder or a device.
    #[error("{} is no file", .0.display())]
    NoFile(PathBuf),
    /// The file cannot be read.
    #[error("cannot read {}: {error}", path.display())]
    Read {
        /// The path of the file.
        path: PathBuf,
        /// The error of the system.
        error: io::Error,
    },
    /// The file is too large.
    #[error("it has {bytes} bytes, more than the {most} that are read")]
    Size {
        /// The size of the file.
        bytes: u64,
        /// The limit.
        most: u64,
    },
}

/// Access to the files that a mapping names.
pub trait Files {
    /// Returns the contents of a file.
    ///
    /// # Errors
    /// [`MappingFileFault`].
    fn read(&mut self, name: &str) -> Result<Vec<u8>, MappingFileFault>;
}

/// The files of a folder, and contents that take the place of named files.
#[derive(Debug, Clone)]
pub struct Folder {
    root: PathBuf,
    given: BTreeMap<String, Vec<u8>>,
}

impl Folder {
    /// Creates the access to the folder of a mapping.
    #[must_use]
    pub fn of(mapping: &Path) -> Self {
        let parent = mapping.parent().filter(|parent| *parent != Path::new(""));
        Self {
            root: parent.unwrap_or_else(|| Path::new(".")).to_owned(),
            given: BTreeMap::new(),
        }
    }

    /// Gives contents where the mapping names `name`.
    #[must_use]
    pub fn with(mut self, name: &str, contents: Vec<u8>) -> Self {
        self.given.insert(name.to_owned(), contents);
        self
    }

    fn path(&self, name: &str) -> Result<PathBuf, MappingFileFault> {
        if name.contains("://") {
            return Err(MappingFileFault::Url);
        }
        let resolved = |path: &Path| {
            path.canonicalize().map_err(|error| MappingFileFault::Open {
                path: path.to_owned(),
                error,
            })
        };
        let root = resolved(&self.root)?;
        let found = resolved(&root.join(name))?;
        if !found.starts_with(&root) {
            return Err(MappingFileFault::Outside(root));
        }
        Ok(found)
    }
}

impl Files for Folder {
    fn read(&mut self, name: &str) -> Result<Vec<u8>, MappingFileFault> {
        if let Some(given) = self.given.get(name) {
            check_size(u64::try_from(given.len()).unwrap_or(u64::MAX))?;
            return Ok(given.clone());
        }
        let path = self.path(name)?;
        let cannot = |error: io::Error| MappingFileFault::Read {
            path: path.clone(),
            error,
        };
        let metadata = path.metadata().map_err(cannot)?;
        if !metadata.is_file() {
            return Err(MappingFileFault::NoFile(path));
        }
        check_size(metadata.len())?;
        let mut bytes = Vec::new();
        let mut file = File::open(&path).map_err(cannot)?.take(MAX_FILE);
        file.read_to_end(&mut bytes).map_err(cannot)?;
        Ok(bytes)
    }
}

fn check_size(bytes: u64) -> Result<(), MappingFileFault> {
    if bytes > MAX_FILE {
        Err(MappingFileFault::Size {
            bytes,
            most: MAX_FILE,
        })
    } else {
        Ok(())
    }
}

/// Maximum size of a file in bytes.
const MAX_FILE: u64 = 64 << 20;
