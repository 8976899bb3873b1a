//! Definition files of ROS types: where they are, and what is wrong with them.
//!
//! The files of a mapping's `type_paths` are all read when they are opened, so that everything wrong with them is told at
//! once. A ROS installation has thousands: its folders are listed when something is looked for the first time, and a file is
//! read when its type is wanted. What is changed later is seen when they are opened again.

mod index;
mod package;

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mappings::{PathFault, PathFaultKind, Readers, Surroundings};
use messages::{
    DefinitionError, DefinitionText, DefinitionTexts, Dialect, Language, TextKind, TypeName,
    check_text,
};
use tracing::warn;

use self::index::{Index, Walk};

/// Definitions in files, for one program.
#[derive(Debug, Clone)]
pub struct TypeFiles {
    paths: Vec<PathBuf>,
    /// What the `type_paths` have.
    own: Index,
    faults: Vec<PathFault>,
    environment: Environment,
    /// What the installations have, once it was asked for.
    installed: [Option<Index>; 2],
}

/// The ROS installations the program was started in.
#[derive(Debug, Clone, Default)]
pub struct Environment {
    /// Folders with packages somewhere below them, as `ROS_PACKAGE_PATH` lists them.
    pub ros1: Vec<PathBuf>,
    /// Folders with `share/<package>`, as `AMENT_PREFIX_PATH` lists them.
    pub ros2: Vec<PathBuf>,
}

impl Environment {
    /// As the variables of the environment say.
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
}

/// What is beside a mapping on this host: files, definitions, and the environment of this process.
#[derive(Debug, Clone, Copy, Default)]
pub struct Disk;

impl Surroundings for Disk {
    fn read(&self, file: &str) -> Result<String, String> {
        read_mapping(file)
    }

    fn list(&self, folder: &str) -> Result<Vec<String>, String> {
        let folder = if folder.is_empty() { "." } else { folder };
        let entries = std::fs::read_dir(folder).map_err(|error| error.to_string())?;
        let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
        Ok(names.collect())
    }

    fn variable(&self, name: &str) -> Option<String> {
        std::env::var(name).ok()
    }

    fn readers(&self, file: &str) -> Option<Readers> {
        readers(Path::new(file))
    }

    fn types(&self, paths: &[PathBuf]) -> Box<dyn mappings::TypeFiles> {
        Box::new(TypeFiles::open(paths, Environment::from_env()))
    }
}

/// As the mode of the file says.
#[cfg(unix)]
fn readers(file: &Path) -> Option<Readers> {
    use std::os::unix::fs::PermissionsExt as _;
    let mode = file.metadata().ok()?.permissions().mode();
    match (mode & 0o040, mode & 0o004) {
        (0, 0) => None,
        (_, 0) => Some(Readers::Group),
        (_, _) => Some(Readers::Everybody),
    }
}

#[cfg(not(unix))]
const fn readers(_: &Path) -> Option<Readers> {
    None
}

fn read_mapping(file: &str) -> Result<String, String> {
    let file = open(Path::new(file)).map_err(|error| error.to_string())?;
    read_text(file)
}

/// A text that is no longer than a mapping may be, or its beginning, which has a finding (M002).
///
/// # Errors
/// Why it cannot be read, for people.
pub fn read_text(from: impl Read) -> Result<String, String> {
    let mut text = Vec::new();
    let length = from
        .take(MOST_OF_A_MAPPING)
        .read_to_end(&mut text)
        .map_err(|error| error.to_string())?;
    if u64::try_from(length).is_ok_and(|length| length == MOST_OF_A_MAPPING) {
        // It may end within a character.
        return Ok(String::from_utf8_lossy(&text).into_owned());
    }
    String::from_utf8(text).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        format!("it is not UTF-8 from byte {at} on; save it as UTF-8")
    })
}

impl TypeFiles {
    /// Reads all files of `paths`, which are folders with packages at or below them, or single files.
    #[must_use]
    pub fn open(paths: &[PathBuf], environment: Environment) -> Self {
        let mut files = Self {
            paths: paths.to_vec(),
            own: Index::default(),
            faults: Vec::new(),
            environment,
            installed: [None, None],
        };
        let mut walk = Walk::new();
        for (number, path) in paths.iter().enumerate() {
            files.take(number, path, &mut walk);
        }
        files
    }

    /// Reads these `type_paths` in place of those there were, be they the same. What the installations have stays as it was
    /// listed.
    pub fn open_again(&mut self, paths: &[PathBuf]) {
        let environment = std::mem::take(&mut self.environment);
        let installed = std::mem::take(&mut self.installed);
        *self = Self {
            installed,
            ..Self::open(paths, environment)
        };
    }

    /// Whether there are `type_paths`.
    #[must_use]
    pub const fn has_paths(&self) -> bool {
        !self.paths.is_empty()
    }

    fn take(&mut self, number: usize, path: &Path, walk: &mut Walk) {
        let mut fault = |what| {
            if self.faults.len() < MOST_FAULTS {
                self.faults.push(PathFault { path: number, what });
            }
        };
        let found = match walk.all(path) {
            Ok(found) if found.is_empty() => {
                let why = format!("{}: no definition files in it", path.display());
                return fault(PathFaultKind::Empty(why));
            }
            Ok(found) => found,
            Err(error) => {
                let why = format!("{}: {error}", path.display());
                return fault(PathFaultKind::Empty(why));
            }
        };
        for file in found {
            let Some(name) = file.name() else {
                let why = format!(
                    "{}: package and file are no name of a type: letters, digits and `_`, a letter first",
                    file.path.display()
                );
                fault(PathFaultKind::File(why));
                continue;
            };
            let text = match read(&file.path) {
                Ok(text) => text,
                Err(error) => {
                    let why = format!("{}: {error}", file.path.display());
                    fault(PathFaultKind::File(why));
                    continue;
                }
            };
            let text = definition(text, &file.path);
            let mut refused = None;
            let mut fits = false;
            for dialect in [Dialect::Ros1, Dialect::Ros2] {
                if !file.of(dialect) {
                    continue;
                }
                match check_text(dialect, file.kind, &name, &text) {
                    Ok(()) => {
                        self.own.insert(dialect, &file, &name);
                        fits = true;
                    }
                    Err(error) => refused = refused.or(Some(error)),
                }
            }
            if let (false, Some(error)) = (fits, refused) {
                fault(PathFaultKind::File(told(&file.path, &error)));
            }
        }
    }

    fn installed(&mut self, dialect: Dialect) -> &Index {
        let [ros1, ros2] = &mut self.installed;
        let environment = &self.environment;
        match dialect {
            Dialect::Ros1 => ros1.get_or_insert_with(|| {
                let mut walk = Walk::new();
                let roots = environment.ros1.iter();
                Index::of(dialect, roots.flat_map(|root| walk.packages(root, DEEPEST)))
            }),
            Dialect::Ros2 => ros2.get_or_insert_with(|| {
                let mut walk = Walk::new();
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
        let path = match self.own.get(dialect, kind, name) {
            Some(path) => path.to_owned(),
            None => self.installed(dialect).get(dialect, kind, name)?.to_owned(),
        };
        match read(&path) {
            Ok(text) => Some(definition(text, &path)),
            Err(error) => {
                warn!(file = %path.display(), %error, "definition not readable");
                None
            }
        }
    }

    fn names(&mut self, dialect: Dialect, kind: TextKind) -> Vec<TypeName> {
        let mut names: Vec<TypeName> = self.own.names(dialect, kind).cloned().collect();
        names.extend(self.installed(dialect).names(dialect, kind).cloned());
        names
    }

    fn places(&self, dialect: Dialect) -> Vec<String> {
        let paths = self.paths.iter().map(|path| path.display().to_string());
        let (variable, roots) = match dialect {
            Dialect::Ros1 => (ROS_PACKAGE_PATH, &self.environment.ros1),
            Dialect::Ros2 => (AMENT_PREFIX_PATH, &self.environment.ros2),
        };
        paths
            .chain((!roots.is_empty()).then(|| variable.to_owned()))
            .collect()
    }
}

impl mappings::TypeFiles for TypeFiles {
    fn faults(&mut self) -> Vec<PathFault> {
        std::mem::take(&mut self.faults)
    }
}

/// `file:line: why`
fn told(file: &Path, error: &DefinitionError) -> String {
    match error {
        DefinitionError::Syntax {
            line, reason, text, ..
        } => format!("{}:{line}: {reason}: `{text}`", file.display()),
        DefinitionError::Unknown { .. }
        | DefinitionError::Cyclic { .. }
        | DefinitionError::TooDeep { .. }
        | DefinitionError::TooBig { .. }
        | DefinitionError::OtherHash { .. } => format!("{}: {error}", file.display()),
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

/// A regular file, or a link to one: opening a pipe would wait for whoever writes into it.
pub(crate) fn open(path: &Path) -> std::io::Result<File> {
    if path.metadata()?.is_file() {
        File::open(path)
    } else {
        Err(std::io::Error::other(
            "it is no regular file, or link to one; nothing else is read",
        ))
    }
}

fn read(path: &Path) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    open(path)?.take(MOST_BYTES).read_to_end(&mut bytes)?;
    // Comments are in any encoding; what counts is ASCII.
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}

const ROS_PACKAGE_PATH: &str = "ROS_PACKAGE_PATH";
const AMENT_PREFIX_PATH: &str = "AMENT_PREFIX_PATH";
/// More than a mapping may have.
const MOST_OF_A_MAPPING: u64 = 8 << 20;
/// More than any definition has.
const MOST_BYTES: u64 = 1 << 20;
/// Faults that are told; more are of one cause.
const MOST_FAULTS: usize = 100;
/// How deep a package may lie in a workspace.
const DEEPEST: usize = 8;

#[cfg(test)]
mod tests;
