//! Inputs of a check beside the document's text. The caller provides them: this crate opens no file
//! and reads no environment.

use std::io;
use std::path::{Component, Path, PathBuf};

use messages::{DefinitionTexts, NoTexts};

use crate::environment::Environment;
use crate::nodesets::NodeSets;

/// Files beside a document and the variables of its environment.
pub trait Surroundings {
    /// Returns the text of a file, for `include`.
    ///
    /// # Errors
    /// The file cannot be read, or is not text.
    fn read(&self, file: &str) -> io::Result<String>;

    /// Returns the names in a folder, in no order, for an `include` with a wildcard.
    ///
    /// # Errors
    /// The folder cannot be read.
    fn list(&self, folder: &str) -> io::Result<Vec<String>>;

    /// Returns the value of an environment variable, for `${NAME}`; `None` if it is not set.
    fn variable(&self, name: &str) -> Option<String>;

    /// Returns the readers of a file beside its owner; `None` if there are no others, or if they
    /// are not known.
    fn readers(&self, file: &str) -> Option<FileReaders> {
        let _ = file;
        None
    }

    /// Returns definition files beside the built-in definitions. `paths` are the `type_paths` of
    /// the document; a relative path is below the folder of the file that contains it.
    fn types(&self, paths: &[PathBuf]) -> Box<dyn OpenTypeFiles> {
        let _ = paths;
        Box::new(NoTexts)
    }

    /// Returns the NodeSet2 files that the document names, read; `None` if this program does not
    /// read them.
    fn nodesets(&self, files: &[PathBuf]) -> Option<Box<dyn NodeSets>> {
        let _ = files;
        None
    }

    /// Returns the state of the running cell; `None` if it was not queried.
    fn environment(&self) -> Option<&Environment> {
        None
    }
}

/// Readers of a file beside its owner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileReaders {
    /// Users of its group.
    Group,
    /// Every user of the host.
    Everybody,
}

/// Definition files, as [`Surroundings::types`] opens them.
pub trait OpenTypeFiles: DefinitionTexts {
    /// Returns the faults of the `type_paths`; called once.
    fn faults(&mut self) -> Vec<PathFault>;
}

impl OpenTypeFiles for NoTexts {
    fn faults(&mut self) -> Vec<PathFault> {
        Vec::new()
    }
}

/// Fault of one of the `type_paths`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PathFault {
    /// Index of the path in `type_paths`, from 0.
    pub path: usize,
    /// Kind of the fault.
    pub what: PathFaultKind,
}

/// Kind of a fault of one of the `type_paths`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PathFaultKind {
    /// The path does not exist, cannot be read, or has no definitions. The text is the reason, for
    /// users.
    Empty(String),
    /// A file of the path is ignored. The text gives file, line and reason, for users.
    File(String),
}

/// A document that stands alone.
pub(crate) struct Alone;

impl Surroundings for Alone {
    fn read(&self, _: &str) -> io::Result<String> {
        Err(io::Error::other("only this text is available"))
    }

    fn list(&self, _: &str) -> io::Result<Vec<String>> {
        self.read("").map(|_| Vec::new())
    }

    fn variable(&self, _: &str) -> Option<String> {
        None
    }
}

/// Returns the path of a file that another file names, without `.` and, if possible, without `..`.
pub(crate) fn beside(file: &str, named: &str) -> String {
    let folder = Path::new(file).parent().unwrap_or_else(|| Path::new(""));
    let mut path = PathBuf::new();
    for part in folder.join(named).components() {
        match part {
            Component::CurDir => {}
            Component::ParentDir
                if matches!(path.components().next_back(), Some(Component::Normal(_))) =>
            {
                path.pop();
            }
            Component::Prefix(_)
            | Component::RootDir
            | Component::ParentDir
            | Component::Normal(_) => path.push(part),
        }
    }
    path.to_string_lossy().into_owned()
}

/// Returns `true` if a name matches a pattern with `*` for any characters.
pub(crate) fn fits(pattern: &str, name: &str) -> bool {
    let mut parts = pattern.split('*');
    let Some(mut rest) = parts.next().and_then(|first| name.strip_prefix(first)) else {
        return false;
    };
    let mut parts: Vec<&str> = parts.collect();
    let Some(last) = parts.pop() else {
        return rest.is_empty();
    };
    for part in parts {
        match rest.split_once(part) {
            Some((_, behind)) => rest = behind,
            None => return false,
        }
    }
    rest.ends_with(last)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_named_from_the_one_that_names_it() {
        for (file, named, path) in [
            ("cell.yaml", "robots.yaml", "robots.yaml"),
            ("a/cell.yaml", "./robots.yaml", "a/robots.yaml"),
            ("a/b/cell.yaml", "../robots.yaml", "a/robots.yaml"),
            ("cell.yaml", "../robots.yaml", "../robots.yaml"),
            ("a/cell.yaml", "/etc/robots.yaml", "/etc/robots.yaml"),
        ] {
            assert_eq!(beside(file, named), path);
        }
    }

    #[test]
    fn a_wildcard_stands_for_any_characters() {
        assert!(fits("*.yaml", "a.yaml") && fits("r*b*.y", "rxbyb.y") && fits("a", "a"));
        assert!(!fits("*.yaml", "a.yml") && !fits("a*a", "a") && !fits("a", "ab"));
    }
}
