//! Definition files of ROS types: their locations and their errors.
//!
//! The files of a mapping's `type_paths` are all read at the same time, so that all their errors
//! are reported at once. The files are kept; later changes take effect when they are read again. A
//! ROS installation has thousands of files: its folders are listed with the first lookup, and a
//! file is read when its type is needed.

mod index;
mod package;
mod paths;

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

pub use documents::{FileError, read_bounded};
use mappings::{FileReaders, PathFault, Surroundings};
use messages::{DefinitionText, DefinitionTexts, Dialect, Language, TextKind, TypeName};
use tracing::warn;

use self::index::{FolderWalk, Index};
pub use self::paths::TypePaths;

/// Definitions in files, for a program.
#[derive(Debug, Clone)]
pub struct TypeFiles {
    own: Arc<TypePaths>,
    environment: RosEnvironment,
    /// The files of the installations, after the first lookup.
    installed: [Option<Index<PathBuf>>; 2],
}

/// The ROS installations in the environment of the program.
#[derive(Debug, Clone, Default)]
pub struct RosEnvironment {
    /// Folders with packages at any depth, as in `ROS_PACKAGE_PATH`.
    pub ros1: Vec<PathBuf>,
    /// Folders with `share/<package>`, as in `AMENT_PREFIX_PATH`.
    pub ros2: Vec<PathBuf>,
}

impl RosEnvironment {
    /// Reads the environment variables.
    #[must_use]
    pub fn from_env() -> Self {
        let list = |variable: &str| {
            let list = std::env::var_os(variable).unwrap_or_default();
            let paths = std::env::split_paths(&list);
            paths.filter(|path| !path.as_os_str().is_empty()).collect()
        };
        Self {
            ros1: list(ROS_PACKAGE_PATH),
            ros2: list(AMENT_PREFIX_PATH),
        }
    }

    /// Returns whether no ROS installation is known.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.ros1.is_empty() && self.ros2.is_empty()
    }

    /// Returns the folder of a package; `None` if it is not installed. Reads the folders of
    /// `ROS_PACKAGE_PATH`.
    #[must_use]
    pub fn package(&self, name: &str) -> Option<PathBuf> {
        let mut shared = self.ros2.iter().map(|prefix| prefix.join("share"));
        if let Some(folder) = shared.find_map(|share| index::entry(&share, name)) {
            return Some(folder);
        }
        let mut unseen = |_: &Path| {};
        let mut walk = FolderWalk::new(&mut unseen);
        let mut roots = self.ros1.iter();
        roots.find_map(|root| walk.package_named(name, root, DEEPEST))
    }
}

/// The surroundings of a mapping on this host: files, definitions, and the environment of this
/// process.
#[derive(Debug, Clone, Copy, Default)]
pub struct Disk;

impl Surroundings for Disk {
    fn read(&self, file: &str) -> io::Result<String> {
        read_text(open(Path::new(file))?)
    }

    fn list(&self, folder: &str) -> io::Result<Vec<String>> {
        let folder = if folder.is_empty() { "." } else { folder };
        let entries = std::fs::read_dir(folder)?;
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        Ok(names.collect())
    }

    fn variable(&self, name: &str) -> Option<String> {
        std::env::var(name).ok()
    }

    fn readers(&self, file: &str) -> Option<FileReaders> {
        readers(Path::new(file))
    }

    fn types(&self, paths: &[PathBuf]) -> Box<dyn mappings::OpenTypeFiles> {
        let own = TypePaths::read(paths, &mut |_| {});
        Box::new(TypeFiles::new(Arc::new(own), RosEnvironment::from_env()))
    }
}

/// Returns the readers according to the mode of the file.
#[cfg(unix)]
fn readers(file: &Path) -> Option<FileReaders> {
    use std::os::unix::fs::PermissionsExt as _;
    let mode = file.metadata().ok()?.permissions().mode();
    match (mode & 0o040, mode & 0o004) {
        (0, 0) => None,
        (_, 0) => Some(FileReaders::Group),
        (_, _) => Some(FileReaders::Everybody),
    }
}

#[cfg(not(unix))]
const fn readers(_: &Path) -> Option<FileReaders> {
    None
}

/// Reads a text up to the limit of a mapping. A longer text is cut, which gives a finding (M002).
///
/// # Errors
/// The text cannot be read, or is not UTF-8.
pub fn read_text(from: impl Read) -> io::Result<String> {
    let mut text = Vec::new();
    let length = from.take(MOST_OF_A_MAPPING).read_to_end(&mut text)?;
    if u64::try_from(length).is_ok_and(|length| length == MOST_OF_A_MAPPING) {
        // The cut may be within a character.
        return Ok(String::from_utf8_lossy(&text).into_owned());
    }
    utf8(text)
}

/// Reads a file of text, such as the YAML of a program, within the bound of a mapping.
///
/// # Errors
/// The file cannot be read, has more than 8 MiB, or is not UTF-8.
pub fn read_text_file(file: &Path) -> io::Result<String> {
    utf8(read_bounded(file, MOST_OF_A_MAPPING).map_err(io::Error::other)?)
}

fn utf8(bytes: Vec<u8>) -> io::Result<String> {
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        let why = format!("it is not UTF-8 from byte {at} on; save it as UTF-8");
        io::Error::new(io::ErrorKind::InvalidData, why)
    })
}

impl TypeFiles {
    /// Creates the definitions from the files of `own`, and from the installations.
    #[must_use]
    pub const fn new(own: Arc<TypePaths>, environment: RosEnvironment) -> Self {
        Self {
            own,
            environment,
            installed: [None, None],
        }
    }

    /// Returns the files of the `type_paths`.
    #[must_use]
    pub fn paths(&self) -> &TypePaths {
        &self.own
    }

    /// Replaces the files of the `type_paths`. The lists of the installations stay unchanged.
    pub fn replace(&mut self, own: Arc<TypePaths>) {
        self.own = own;
    }

    fn installed(&mut self, dialect: Dialect) -> &Index<PathBuf> {
        let [ros1, ros2] = &mut self.installed;
        let environment = &self.environment;
        match dialect {
            Dialect::Ros1 => ros1.get_or_insert_with(|| {
                let mut unseen = |_: &Path| {};
                let mut walk = FolderWalk::new(&mut unseen);
                let roots = environment.ros1.iter();
                Index::of(dialect, roots.flat_map(|root| walk.packages(root, DEEPEST)))
            }),
            Dialect::Ros2 => ros2.get_or_insert_with(|| {
                let mut unseen = |_: &Path| {};
                let mut walk = FolderWalk::new(&mut unseen);
                let roots = environment.ros2.iter();
                Index::of(
                    dialect,
                    roots.flat_map(|prefix| walk.packages(&prefix.join("share"), 1)),
                )
            }),
        }
    }
}

impl DefinitionTexts for TypeFiles {
    fn find(
        &mut self,
        dialect: Dialect,
        kind: TextKind,
        name: &TypeName,
    ) -> Option<DefinitionText> {
        if let Some(text) = self.own.index.get(dialect, kind, name) {
            return Some(DefinitionText::clone(text));
        }
        let path = self.installed(dialect).get(dialect, kind, name)?;
        match read(path) {
            Ok(text) => Some(definition(text, path)),
            Err(error) => {
                warn!(file = %path.display(), %error, "cannot read a definition");
                None
            }
        }
    }

    fn names(&mut self, dialect: Dialect, kind: TextKind) -> Vec<TypeName> {
        let mut names: Vec<TypeName> = self.own.index.names(dialect, kind).cloned().collect();
        names.extend(self.installed(dialect).names(dialect, kind).cloned());
        names
    }

    fn places(&self, dialect: Dialect) -> Vec<String> {
        let paths = self.own.paths.iter().map(|path| path.display().to_string());
        let (variable, roots) = match dialect {
            Dialect::Ros1 => (ROS_PACKAGE_PATH, &self.environment.ros1),
            Dialect::Ros2 => (AMENT_PREFIX_PATH, &self.environment.ros2),
        };
        paths
            .chain((!roots.is_empty()).then(|| variable.to_owned()))
            .collect()
    }
}

impl mappings::OpenTypeFiles for TypeFiles {
    fn faults(&mut self) -> Vec<PathFault> {
        self.own.faults()
    }
}

fn definition(text: String, path: &Path) -> DefinitionText {
    let idl = path.extension().is_some_and(|ending| ending == "idl");
    DefinitionText {
        text,
        language: if idl { Language::Idl } else { Language::Ros },
        file: Arc::from(path.display().to_string()),
    }
}

/// Opens a regular file or a link to a regular file: opening a pipe would wait for its writer.
pub(crate) fn open(path: &Path) -> io::Result<File> {
    if path.metadata()?.is_file() {
        File::open(path)
    } else {
        Err(io::Error::other(
            "it is not a regular file or a link to a regular file",
        ))
    }
}

fn read(path: &Path) -> io::Result<String> {
    let mut bytes = Vec::new();
    open(path)?.take(MOST_BYTES).read_to_end(&mut bytes)?;
    // Comments have any encoding; the definitions are ASCII.
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

const ROS_PACKAGE_PATH: &str = "ROS_PACKAGE_PATH";
const AMENT_PREFIX_PATH: &str = "AMENT_PREFIX_PATH";
/// Exceeds the limit of a mapping.
const MOST_OF_A_MAPPING: u64 = 8 << 20;
/// Exceeds the size of any definition.
const MOST_BYTES: u64 = 1 << 20;
/// Maximum depth of a package in a workspace.
const DEEPEST: usize = 8;

#[cfg(test)]
mod tests;
