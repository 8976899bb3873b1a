//! What the `type_paths` of a mapping have.

use std::collections::BTreeSet;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mappings::{PathFault, PathFaultKind};
use messages::{DefinitionError, DefinitionText, Dialect, TextKind, TypeName, check_text};

use crate::index::{DefinitionFile, Index, Walk};
use crate::{definition, read};

/// The definition files of a mapping's `type_paths`, as they were when they were read.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct TypePaths {
    pub(crate) paths: Vec<PathBuf>,
    pub(crate) index: Index<Arc<DefinitionText>>,
    faults: Vec<Fault>,
    /// Of all texts.
    bytes: usize,
}

#[derive(Debug, PartialEq, Eq)]
struct Fault {
    /// Which of the paths, from 0.
    path: usize,
    /// The file that does not count; `None` where the path itself is at fault.
    file: Option<String>,
    /// Which line of which file and why, for people.
    why: String,
}

impl TypePaths {
    /// Reads all files of `paths`, which are folders with packages at or below them, or single files. `see` is told of
    /// each file and folder before it is looked at: as long as all of them stay what they are, so does what was read.
    #[must_use]
    pub fn read(paths: &[PathBuf], see: &mut dyn FnMut(&Path)) -> Self {
        let mut read = Self {
            paths: paths.to_vec(),
            ..Self::default()
        };
        let mut walk = Walk::new(see);
        for (number, path) in paths.iter().enumerate() {
            read.take(number, path, &mut walk);
        }
        read
    }

    /// Whether there are no `type_paths`.
    #[must_use]
    pub const fn is_none(&self) -> bool {
        self.paths.is_empty()
    }

    /// What is wrong with them, up to a bound.
    pub(crate) fn faults(&self) -> Vec<PathFault> {
        let told = self.faults.iter().take(MOST_FAULTS);
        told.map(|fault| PathFault {
            path: fault.path,
            what: match fault.file {
                Some(_) => PathFaultKind::File(fault.why.clone()),
                None => PathFaultKind::Empty(fault.why.clone()),
            },
        })
        .collect()
    }

    /// What is wrong, for people, with files that counted in `before` and do not count here.
    #[must_use]
    pub fn spoiled(&self, before: &Self) -> Vec<&str> {
        if self.faults.is_empty() {
            return Vec::new();
        }
        let counted: BTreeSet<&str> = before.index.all().map(|(_, text)| &*text.file).collect();
        let faults = self.faults.iter();
        faults
            .filter(|fault| fault.file.as_deref().is_some_and(|f| counted.contains(f)))
            .map(|fault| fault.why.as_str())
            .collect()
    }

    /// The file a message, or else a service, of that name is from.
    #[must_use]
    pub fn file(&self, dialect: Dialect, name: &TypeName) -> Option<&str> {
        let of = |kind| self.index.get(dialect, kind, name);
        let text = of(TextKind::Message).or_else(|| of(TextKind::Service))?;
        Some(&text.file)
    }

    /// How many definitions only one of both has, or both have otherwise.
    #[must_use]
    pub fn differing(&self, other: &Self) -> usize {
        let mut differing = BTreeSet::new();
        for (these, those) in [(self, other), (other, self)] {
            for ((dialect, kind, name), text) in these.index.all() {
                if those.index.get(*dialect, *kind, name) != Some(text) {
                    differing.insert((kind, name));
                }
            }
        }
        differing.len()
    }

    /// A number that is another one where anything in them is, for as long as the program runs.
    #[must_use]
    pub fn fingerprint(&self) -> u64 {
        let mut all = DefaultHasher::new();
        for (key, text) in self.index.all() {
            (key, &text.file, &text.text).hash(&mut all);
        }
        for fault in &self.faults {
            fault.why.hash(&mut all);
        }
        all.finish()
    }

    fn take(&mut self, number: usize, path: &Path, walk: &mut Walk<'_>) {
        let found = match walk.all(path) {
            Ok(found) if found.is_empty() => Err("no definition files in it".to_owned()),
            Ok(found) => Ok(found),
            Err(error) => Err(error.to_string()),
        };
        match found {
            Ok(found) => {
                for file in found {
                    walk.see(&file.path);
                    if let Err(why) = self.add(&file) {
                        let file = file.path.display().to_string();
                        self.fault(number, Some(file), why);
                    }
                }
            }
            Err(why) => self.fault(number, None, format!("{}: {why}", path.display())),
        }
    }

    fn fault(&mut self, path: usize, file: Option<String>, why: String) {
        self.faults.push(Fault { path, file, why });
    }

    /// Reads one file, which counts in each ROS that it is a definition of.
    fn add(&mut self, file: &DefinitionFile) -> Result<(), String> {
        let path = file.path.display();
        let name = file.name().ok_or_else(|| {
            format!("{path}: package and file are no name of a type: letters, digits and `_`, a letter first")
        })?;
        let text = read(&file.path).map_err(|error| format!("{path}: {error}"))?;
        let bytes = self.bytes.saturating_add(text.len());
        if bytes > MOST_TOGETHER {
            return Err(format!(
                "{path}: with it the definitions are more than {MOST_TOGETHER} bytes; name the packages that are needed"
            ));
        }
        let text = Arc::new(definition(text, &file.path));
        let mut refused = None;
        let mut fits = false;
        for dialect in [Dialect::Ros1, Dialect::Ros2] {
            if !file.of(dialect) {
                continue;
            }
            match check_text(dialect, file.kind, &name, &text) {
                Ok(()) => {
                    self.index
                        .insert(dialect, file.kind, &name, Arc::clone(&text));
                    fits = true;
                }
                Err(error) => refused = refused.or(Some(error)),
            }
        }
        self.bytes = bytes;
        match refused {
            Some(error) if !fits => Err(told(&file.path, &error)),
            Some(_) | None => Ok(()),
        }
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

/// Faults that are told; more are of one cause.
const MOST_FAULTS: usize = 100;
/// Bytes of all definitions, which are kept: a large installation has some ten million.
const MOST_TOGETHER: usize = 64 << 20;
