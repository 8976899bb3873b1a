//! Index of the definition files.

use std::collections::BTreeMap;
use std::io;
use std::path::{Component, Path, PathBuf};

use messages::{Dialect, TextKind, TypeName};

use crate::package::{MANIFEST, PackageFolder};

/// Files, or their contents, by their definitions; the first file of a name counts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Index<F> {
    files: BTreeMap<(Dialect, TextKind, TypeName), F>,
}

impl<F> Default for Index<F> {
    fn default() -> Self {
        Self {
            files: BTreeMap::new(),
        }
    }
}

impl Index<PathBuf> {
    pub(crate) fn of(dialect: Dialect, files: impl Iterator<Item = DefinitionFile>) -> Self {
        let mut index = Self::default();
        for file in files.filter(|file| file.of(dialect)) {
            if let Some(name) = file.name() {
                index.insert(dialect, file.kind, &name, file.path);
            }
        }
        index
    }
}

impl<F> Index<F> {
    pub(crate) fn insert(&mut self, dialect: Dialect, kind: TextKind, name: &TypeName, file: F) {
        let key = (dialect, kind, name.clone());
        self.files.entry(key).or_insert(file);
    }

    /// Sets the file of a name, replacing any previous file.
    pub(crate) fn set(&mut self, key: (Dialect, TextKind, TypeName), file: F) {
        self.files.insert(key, file);
    }

    pub(crate) fn get(&self, dialect: Dialect, kind: TextKind, name: &TypeName) -> Option<&F> {
        self.files.get(&(dialect, kind, name.clone()))
    }

    pub(crate) fn all(&self) -> impl Iterator<Item = (&(Dialect, TextKind, TypeName), &F)> {
        self.files.iter()
    }

    pub(crate) fn names(
        &self,
        dialect: Dialect,
        kind: TextKind,
    ) -> impl Iterator<Item = &TypeName> {
        self.files
            .keys()
            .filter(move |(of, what, _)| *of == dialect && *what == kind)
            .map(|(_, _, name)| name)
    }
}

/// A definition file, classified by its path: `<package>/msg/<Name>.msg`.
#[derive(Debug, Clone)]
pub(crate) struct DefinitionFile {
    pub(crate) path: PathBuf,
    pub(crate) kind: TextKind,
    package: String,
    /// The only ROS version of the file, if it is limited to one.
    only: Option<Dialect>,
}

impl DefinitionFile {
    /// Classifies a file. Returns `None` if its extension is not that of a definition.
    fn of_path(path: PathBuf, package: &PackageFolder, folder: Option<TextKind>) -> Option<Self> {
        let ending = path.extension()?.to_str()?;
        let own = TextKind::ALL.into_iter().find(|kind| kind.word() == ending);
        let (kind, only) = match own {
            Some(kind) => (kind, package.dialect),
            None if ending == "idl" => (folder.unwrap_or(TextKind::Message), Some(Dialect::Ros2)),
            None => return None,
        };
        Some(Self {
            path,
            kind,
            package: package.name.clone(),
            only,
        })
    }

    pub(crate) fn of(&self, dialect: Dialect) -> bool {
        self.only.is_none_or(|only| only == dialect)
    }

    pub(crate) fn name(&self) -> Option<TypeName> {
        TypeName::new(&self.package, self.path.file_stem()?.to_str()?).ok()
    }
}

/// A directory walk with a limited number of folders.
pub(crate) struct FolderWalk<'s> {
    folders: usize,
    files: usize,
    /// Folders that cannot be listed, with the reason.
    unlisted: Vec<(PathBuf, String)>,
    /// Callback for each folder and file before it is read.
    see: &'s mut dyn FnMut(&Path),
}

impl<'s> FolderWalk<'s> {
    pub(crate) fn new(see: &'s mut dyn FnMut(&Path)) -> Self {
        Self {
            folders: MOST_FOLDERS,
            files: MOST_FILES,
            unlisted: Vec::new(),
            see,
        }
    }

    pub(crate) fn see(&mut self, path: &Path) {
        (self.see)(path);
    }

    /// Returns the folders that could not be listed after the previous call, with the reason.
    pub(crate) fn take_unlisted(&mut self) -> Vec<(PathBuf, String)> {
        std::mem::take(&mut self.unlisted)
    }

    fn package(&mut self, folder: &Path) -> PackageFolder {
        self.see(&folder.join(MANIFEST));
        PackageFolder::of(folder)
    }

    /// Returns the definitions at or below a path: of packages, and of files beside a `package.xml`
    /// or in a folder named after their package.
    pub(crate) fn all(&mut self, path: &Path) -> io::Result<Vec<DefinitionFile>> {
        self.see(path);
        if path.metadata()?.is_file() {
            let folder = path.parent().unwrap_or_else(|| Path::new(""));
            let (folder, kind) = match (kind_of(folder), folder.parent()) {
                (Some(kind), Some(package)) => (package, Some(kind)),
                _ => (folder, None),
            };
            let folder = folder.canonicalize()?;
            let package = self.package(&folder);
            let file = DefinitionFile::of_path(path.to_owned(), &package, kind);
            return Ok(file.into_iter().collect());
        }
        let mut found = Vec::new();
        // For a path to the `msg` folder itself the package is the parent folder.
        match (kind_of(path), path.parent()) {
            (Some(kind), Some(around)) => {
                let package = self.package(&around.canonicalize()?);
                self.folder_of(&package, (path, Some(kind)), &mut found);
            }
            _ => self.walk(path, (crate::DEEPEST, true), None, &mut found),
        }
        Ok(found)
    }

    /// Returns the definitions of the packages at or below a folder. Packages contain no packages.
    pub(crate) fn packages(&mut self, root: &Path, depth: usize) -> Vec<DefinitionFile> {
        let mut found = Vec::new();
        self.walk(root, (depth, false), None, &mut found);
        found
    }

    /// Returns the folder of the package `name` at or below a folder.
    pub(crate) fn package_named(
        &mut self,
        name: &str,
        folder: &Path,
        depth: usize,
    ) -> Option<PathBuf> {
        let entries = self.entries(folder)?;
        if entries.iter().any(|entry| entry.ends_with(MANIFEST)) {
            let package = self.package(folder);
            return (package.name == name).then(|| folder.to_owned());
        }
        if ignored(Dialect::Ros1)
            .iter()
            .any(|marker| entries.iter().any(|entry| entry.ends_with(marker)))
        {
            return None;
        }
        let depth = depth.checked_sub(1)?;
        let mut folders = entries.iter().filter(|entry| is_real_folder(entry));
        folders.find_map(|entry| self.package_named(name, entry, depth))
    }

    /// Walks a folder. `only`: the only ROS version for which the folder counts.
    fn walk(
        &mut self,
        folder: &Path,
        (depth, loose): (usize, bool),
        only: Option<Dialect>,
        found: &mut Vec<DefinitionFile>,
    ) {
        let Some(entries) = self.entries(folder) else {
            return;
        };
        let holds = |name: &str| entries.iter().any(|entry| entry.ends_with(name));
        let hides = |dialect: Dialect| {
            let other = only.is_some_and(|only| only != dialect);
            other || ignored(dialect).iter().any(|name| holds(name))
        };
        let only = match (hides(Dialect::Ros1), hides(Dialect::Ros2)) {
            (true, true) => return,
            (true, false) => Some(Dialect::Ros2),
            (false, true) => Some(Dialect::Ros1),
            (false, false) => None,
        };
        let folders: Vec<&PathBuf> = entries
            .iter()
            .filter(|entry| is_real_folder(entry))
            .collect();
        let kinds: Vec<(&Path, TextKind)> = folders
            .iter()
            .filter_map(|path| Some((path.as_path(), kind_of(path)?)))
            .collect();
        let is_package = holds(MANIFEST);
        let mut here = Vec::new();
        if loose || is_package || !kinds.is_empty() {
            let named = folder.canonicalize();
            let package = self.package(named.as_deref().unwrap_or(folder));
            for (path, kind) in &kinds {
                self.folder_of(&package, (path, Some(*kind)), &mut here);
            }
            if loose {
                self.files_of(&package, &entries, None, &mut here);
            }
        }
        if let Some(only) = only {
            here.retain(|file| file.of(only));
            for file in &mut here {
                file.only = Some(only);
            }
        }
        found.append(&mut here);
        if is_package && !loose {
            return;
        }
        let Some(depth) = depth.checked_sub(1) else {
            return;
        };
        for below in folders {
            if kind_of(below).is_none() && !is_hidden(below) {
                self.walk(below, (depth, loose), only, found);
            }
        }
    }

    fn folder_of(
        &mut self,
        package: &PackageFolder,
        (folder, kind): (&Path, Option<TextKind>),
        found: &mut Vec<DefinitionFile>,
    ) {
        if let Some(entries) = self.entries(folder) {
            self.files_of(package, &entries, kind, found);
        }
    }

    fn files_of(
        &mut self,
        package: &PackageFolder,
        entries: &[PathBuf],
        kind: Option<TextKind>,
        found: &mut Vec<DefinitionFile>,
    ) {
        let files = entries
            .iter()
            .filter_map(|path| DefinitionFile::of_path(path.clone(), package, kind))
            .filter(|file| is_file_or_unknown(&file.path));
        let mut files: Vec<DefinitionFile> = files.take(self.files).collect();
        self.files -= files.len().min(self.files);
        // rosidl installs an .idl file derived from each .msg file beside it.
        files.sort_by_key(|file| file.path.extension().is_some_and(|ending| ending == "idl"));
        found.append(&mut files);
    }

    /// Returns the entries in order, or `None` if the folder cannot be read or the limit is
    /// reached.
    fn entries(&mut self, folder: &Path) -> Option<Vec<PathBuf>> {
        self.folders = self.folders.checked_sub(1)?;
        self.see(folder);
        let listed = std::fs::read_dir(folder).and_then(|entries| {
            entries
                .map(|entry| Ok(entry?.path()))
                .collect::<io::Result<Vec<PathBuf>>>()
        });
        match listed {
            Ok(mut paths) => {
                paths.sort();
                Some(paths)
            }
            Err(error) => {
                self.unlisted.push((folder.to_owned(), error.to_string()));
                None
            }
        }
    }
}

/// Returns the folder with this name in a folder. The name is no path.
pub(crate) fn entry(folder: &Path, name: &str) -> Option<PathBuf> {
    let mut parts = Path::new(name).components();
    match (parts.next(), parts.next()) {
        (Some(Component::Normal(_)), None) => {
            Some(folder.join(name)).filter(|found| found.is_dir())
        }
        _ => None,
    }
}

/// Returns whether a path is a folder and not a link, since links may form cycles. A path that
/// cannot be read counts as a folder; the error is reported when it is listed.
fn is_real_folder(path: &Path) -> bool {
    match path.symlink_metadata() {
        Ok(found) => found.is_dir(),
        Err(error) => error.kind() != io::ErrorKind::NotFound,
    }
}

/// Returns whether a path is a file. A path that cannot be read counts as a file; the error is
/// reported when it is read.
fn is_file_or_unknown(path: &Path) -> bool {
    match path.metadata() {
        Ok(found) => found.is_file(),
        Err(error) => error.kind() != io::ErrorKind::NotFound,
    }
}

fn is_hidden(path: &Path) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy());
    name.is_some_and(|name| name.starts_with('.'))
}

/// Returns the kind of the definitions in the folder `msg`, `srv` or `action` of a package.
fn kind_of(folder: &Path) -> Option<TextKind> {
    let name = folder.file_name()?.to_str()?;
    TextKind::ALL.into_iter().find(|kind| kind.word() == name)
}

/// Returns the marker files with which the tools of a ROS version ignore a folder and its
/// subfolders.
const fn ignored(dialect: Dialect) -> &'static [&'static str] {
    match dialect {
        Dialect::Ros1 => &["CATKIN_IGNORE"],
        Dialect::Ros2 => &["AMENT_IGNORE", "COLCON_IGNORE"],
    }
}

/// Limit of folders; a large installation has some thousands.
const MOST_FOLDERS: usize = 20_000;
/// Limit of definitions; a large installation has some thousands.
const MOST_FILES: usize = 20_000;
