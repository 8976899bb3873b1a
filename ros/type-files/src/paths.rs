//! The definitions in the `type_paths` of a mapping.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mappings::{PathFault, PathFaultKind};
use messages::{
    DefinitionError, DefinitionText, DefinitionTexts, Dialect, Library, TextKind, TypeName,
    TypeRegistry, check_text,
};

use crate::index::{DefinitionFile, FolderWalk, Index};
use crate::{definition, read};

/// The definition files of a mapping's `type_paths`, as they were when they were read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TypePaths {
    pub(crate) paths: Vec<PathBuf>,
    pub(crate) index: Index<Arc<DefinitionText>>,
    faults: Vec<Fault>,
    /// Subfolders that cannot be listed, with the reason.
    unlisted: Vec<(PathBuf, String)>,
    /// Errors in files and folders for which the previous definitions are kept.
    kept: Vec<String>,
    /// Whether a folder is among them.
    without_folder: bool,
    /// Size of all texts.
    bytes: usize,
}

/// The texts of each file, with the types that they define.
type Texts<'t> =
    BTreeMap<&'t Path, Vec<(&'t (Dialect, TextKind, TypeName), &'t Arc<DefinitionText>)>>;

#[derive(Debug, Clone, PartialEq, Eq)]
struct Fault {
    /// Index of the path.
    path: usize,
    /// The invalid file; `None` if the path itself is invalid.
    file: Option<String>,
    /// Location and reason for users.
    why: String,
}

impl TypePaths {
    /// Reads all files of `paths`, which are folders with packages at or below them, or single
    /// files. `see` is called for each file and folder before it is read: while all of them are
    /// unchanged, the result is unchanged, too.
    #[must_use]
    pub fn read(paths: &[PathBuf], see: &mut dyn FnMut(&Path)) -> Self {
        let mut read = Self {
            paths: paths.to_vec(),
            ..Self::default()
        };
        let mut walk = FolderWalk::new(see);
        for (number, path) in paths.iter().enumerate() {
            read.take(number, path, &mut walk);
        }
        read
    }

    /// Returns whether there are no `type_paths`.
    #[must_use]
    pub const fn is_none(&self) -> bool {
        self.paths.is_empty()
    }

    /// Returns the errors, up to a limit.
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

    /// Keeps the definitions of `before` that are now unavailable: the texts of invalid files, and
    /// the texts below folders that cannot be listed or have no definitions left. Their errors then
    /// belong to [`kept`](Self::kept) and are not faults.
    pub fn keep(&mut self, before: &Self) {
        let mut texts = Texts::new();
        for (key, text) in before.index.all() {
            let of_file = texts.entry(Path::new(&*text.file)).or_default();
            of_file.push((key, text));
        }
        for fault in std::mem::take(&mut self.faults) {
            let place = match &fault.file {
                Some(file) => Some(PathBuf::from(file)),
                None => self.paths.get(fault.path).cloned(),
            };
            if place.is_some_and(|place| self.take_over(&texts, &place)) {
                self.without_folder |= fault.file.is_none();
                self.kept.push(fault.why);
            } else {
                self.faults.push(fault);
            }
        }
        for (folder, why) in std::mem::take(&mut self.unlisted) {
            if self.take_over(&texts, &folder) {
                self.without_folder = true;
                self.kept.push(format!("{}: {why}", folder.display()));
            }
        }
    }

    /// Keeps the definitions of `before` for a type and all types it needs, if the type is in a
    /// file and its current definition is incomplete.
    pub fn keep_whole(&mut self, before: &Self, dialect: Dialect, kind: TextKind, name: &TypeName) {
        let Some(file) = self.file(dialect, kind, name) else {
            return;
        };
        self.kept
            .push(format!("{file}: a type that `{name}` uses is not defined"));
        let mut asked = FoundTypeNames {
            of: before,
            found: Vec::new(),
        };
        let mut library = Library::new(TypeRegistry::bundle(dialect));
        // The result does not matter, only the requested names.
        let _known = match kind {
            TextKind::Message => library.message(name, &mut asked).is_ok(),
            TextKind::Service => library.service(name, &mut asked).is_ok(),
            TextKind::Action => library.action_messages(name, &mut asked).is_ok(),
        };
        for (kind, name) in asked.found {
            // A file counts in both ROS versions.
            for dialect in [Dialect::Ros1, Dialect::Ros2] {
                if let Some(text) = before.index.get(dialect, kind, &name) {
                    let key = (dialect, kind, name.clone());
                    self.index.set(key, Arc::clone(text));
                }
            }
        }
    }

    /// Returns the errors for which the previous definitions are kept, for users.
    #[must_use]
    pub fn kept(&self) -> &[String] {
        &self.kept
    }

    /// Returns whether folders are among these errors. A folder may become available again without
    /// a visible change of the watched files.
    #[must_use]
    pub const fn is_without_folder(&self) -> bool {
        self.without_folder
    }

    /// Returns the file of a definition.
    #[must_use]
    pub fn file(&self, dialect: Dialect, kind: TextKind, name: &TypeName) -> Option<&str> {
        let text = self.index.get(dialect, kind, name)?;
        Some(&text.file)
    }

    /// Returns the number of definitions that are different or missing in one of the two.
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

    /// Returns a hash that changes with any content of the files. It is valid within one run of the
    /// program.
    #[must_use]
    pub fn fingerprint(&self) -> u64 {
        let mut all = DefaultHasher::new();
        for (key, text) in self.index.all() {
            (key, &text.file, &text.text).hash(&mut all);
        }
        for fault in &self.faults {
            fault.why.hash(&mut all);
        }
        self.kept.hash(&mut all);
        all.finish()
    }

    /// Keeps the texts at or below a path, and returns whether there were any.
    fn take_over(&mut self, before: &Texts<'_>, place: &Path) -> bool {
        let mut any = false;
        let below = before.range(place..);
        for (file, texts) in below.take_while(|(file, _)| file.starts_with(place)) {
            let bytes = texts.first().map_or(0, |(_, text)| text.text.len());
            let bytes = self.bytes.saturating_add(bytes);
            if bytes > MOST_TOGETHER {
                break;
            }
            self.bytes = bytes;
            for (key, text) in texts {
                let (dialect, kind, name) = key;
                // It may have been read by another path.
                if self.file(*dialect, *kind, name).map(Path::new) != Some(*file) {
                    self.index.set((*key).clone(), Arc::clone(text));
                    any = true;
                }
            }
        }
        any
    }

    fn take(&mut self, number: usize, path: &Path, walk: &mut FolderWalk<'_>) {
        let found = walk.all(path);
        let (own, below): (Vec<_>, Vec<_>) = walk
            .take_unlisted()
            .into_iter()
            .partition(|(folder, _)| folder == path);
        self.unlisted.extend(below);
        let found = match (found, own.into_iter().next()) {
            (Ok(_), Some((_, why))) => Err(why),
            (Ok(found), None) if found.is_empty() => {
                Err("it contains no definition files".to_owned())
            }
            (Ok(found), None) => Ok(found),
            (Err(error), _) => Err(error.to_string()),
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

    /// Reads a file, which counts in each ROS version in which it is a valid definition.
    fn add(&mut self, file: &DefinitionFile) -> Result<(), String> {
        let path = file.path.display();
        let name = file.name().ok_or_else(|| {
            format!("{path}: the names of package and file are not valid in ROS: use letters, digits and \
                     `_`, beginning with a letter")
        })?;
        let text = read(&file.path).map_err(|error| format!("{path}: {error}"))?;
        let bytes = self.bytes.saturating_add(text.len());
        if bytes > MOST_TOGETHER {
            return Err(format!(
                "{path}: with this file the definitions exceed {MOST_TOGETHER} bytes; list only the \
                 packages that are needed"
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

/// Records the requested names that are found.
struct FoundTypeNames<'t> {
    of: &'t TypePaths,
    found: Vec<(TextKind, TypeName)>,
}

impl DefinitionTexts for FoundTypeNames<'_> {
    fn find(
        &mut self,
        dialect: Dialect,
        kind: TextKind,
        name: &TypeName,
    ) -> Option<DefinitionText> {
        let text = self.of.index.get(dialect, kind, name)?;
        self.found.push((kind, name.clone()));
        Some(DefinitionText::clone(text))
    }

    fn names(&mut self, _: Dialect, _: TextKind) -> Vec<TypeName> {
        Vec::new()
    }

    fn places(&self, _: Dialect) -> Vec<String> {
        Vec::new()
    }
}

/// Formats `file:line: why`.
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

/// Maximum number of reported errors; further errors have the same cause.
const MOST_FAULTS: usize = 100;
/// Limit of the size of all definitions, which are kept in memory: a large installation has some
/// ten million bytes.
const MOST_TOGETHER: usize = 64 << 20;
