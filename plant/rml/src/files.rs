//! The files that a mapping reads.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// Access to the files that a mapping names.
pub trait Files {
    /// Returns the contents of a file.
    ///
    /// # Errors
    /// A text with the reason and the remedy.
    fn read(&mut self, name: &str) -> Result<Vec<u8>, String>;
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

    fn path(&self, name: &str) -> Result<PathBuf, String> {
        if name.contains("://") {
            return Err(
                "it is a URL, and nothing is fetched; save the file beside the mapping and name it"
                    .to_owned(),
            );
        }
        let root = self.root.canonicalize();
        let root = root.map_err(|error| format!("cannot open {}: {error}", self.root.display()))?;
        let path = root.join(name);
        let found = path
            .canonicalize()
            .map_err(|error| format!("cannot open {}: {error}", path.display()))?;
        if !found.starts_with(&root) {
            return Err(format!(
                "it is outside of the folder {}; move it there, or give it as NAME=FILE",
                root.display()
            ));
        }
        Ok(found)
    }
}

impl Files for Folder {
    fn read(&mut self, name: &str) -> Result<Vec<u8>, String> {
        if let Some(given) = self.given.get(name) {
            check_size(u64::try_from(given.len()).unwrap_or(u64::MAX))?;
            return Ok(given.clone());
        }
        let path = self.path(name)?;
        let cannot = |error: std::io::Error| format!("cannot read {}: {error}", path.display());
        let metadata = path.metadata().map_err(cannot)?;
        if !metadata.is_file() {
            return Err(format!("{} is no file", path.display()));
        }
        check_size(metadata.len())?;
        let mut bytes = Vec::new();
        let mut file = File::open(&path).map_err(cannot)?.take(MAX_FILE);
        file.read_to_end(&mut bytes).map_err(cannot)?;
        Ok(bytes)
    }
}

fn check_size(bytes: u64) -> Result<(), String> {
    if bytes > MAX_FILE {
        Err(format!(
            "it has {bytes} bytes, more than the {MAX_FILE} that are read"
        ))
    } else {
        Ok(())
    }
}

/// Maximum size of a file in bytes.
const MAX_FILE: u64 = 64 << 20;
