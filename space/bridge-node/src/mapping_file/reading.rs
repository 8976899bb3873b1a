//! Reads the files of a mapping, and records the stamps of all files that the reading depends on.

use std::cell::{Cell, RefCell};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mappings::{
    Checked, Code, Diagnostic, FileReaders, Mapping, NodeSets, Severity, Surroundings, TypeOrigin,
    TypeUse,
};
use messages::{Dialect, TextKind, TypeName};
use sha2::{Digest as _, Sha256};
use tokio::task::JoinError;
use tracing::info;
use type_files::{RosEnvironment, TypeFiles, TypePaths};

use super::NodeSetReader;
use super::stamps::{SeenFiles, see};

/// A reading of the mapping's files.
#[derive(Debug)]
pub(super) struct Reading {
    pub(super) checked: Checked,
    pub(super) hash: String,
    /// Fingerprint of the definitions in the `type_paths`.
    pub(super) fingerprint: u64,
    pub(super) types: Arc<TypePaths>,
    /// Types named in the mapping that files define.
    pub(super) known: DefinedTypes,
    /// Number of definitions that differ from the running definitions.
    pub(super) differing: usize,
    pub(super) files: SeenFiles,
}

impl Reading {
    /// Removes the findings about types that are not built in, and returns whether there were any.
    /// Such types are normal for robots of a vendor, and the run loop reports problems with them
    /// when the types are used.
    pub(super) fn leave_to_the_run(&mut self, file: &Path) -> bool {
        let findings = &mut self.checked.findings;
        let before = findings.len();
        findings.retain(|finding| !is_left_to_the_run(finding));
        let left = before - findings.len();
        if left > 0 {
            info!(
                "{left} bindings of {} use types that are not built in; they are checked \
                 when their definitions are available (--check lists them)",
                file.display()
            );
        }
        left > 0
    }
}

/// The reason why a mapping cannot be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum UnreadMapping {
    /// The file cannot be read.
    #[error("cannot read the mapping {name}: {error}")]
    File {
        /// The file.
        name: String,
        /// The error of the system.
        error: io::Error,
    },
    /// The thread that reads the file failed.
    #[error(transparent)]
    Thread(#[from] JoinError),
}

/// Types that are named in a mapping and defined in files.
pub(super) type DefinedTypes = BTreeSet<(Dialect, TextKind, TypeName)>;

/// Reads the mapping, its includes, and the definitions of its `type_paths`.
///
/// # Errors
/// The file cannot be read.
pub(super) fn read(
    (file, nodesets): (&Path, Option<NodeSetReader>),
    running: &TypePaths,
    known: &DefinedTypes,
) -> Result<Reading, UnreadMapping> {
    let disk = Disk {
        running,
        nodesets: (nodesets, Cell::default()),
        seen: RefCell::default(),
        types: RefCell::default(),
    };
    let name = file.display().to_string();
    let text = disk.read(&name).map_err(|error| UnreadMapping::File {
        name: name.clone(),
        error,
    })?;
    let mut checked = Mapping::from_text(&text, &name, &disk);
    let mut types = disk.types();
    let lost: Vec<&TypeUse> = checked
        .types
        .iter()
        .filter(|used| used.source == TypeOrigin::Unknown && known.contains(&key(used)))
        .filter(|used| types.file(used.dialect, used.kind, &used.name).is_some())
        .collect();
    if !lost.is_empty() {
        let mut whole = TypePaths::clone(&types);
        for used in lost {
            whole.keep_whole(running, used.dialect, used.kind, &used.name);
        }
        types = Arc::new(whole);
        disk.types.replace(Some(Arc::clone(&types)));
        checked = Mapping::from_text(&text, &name, &disk);
    }
    let mut all = Sha256::new();
    for source in &checked.sources {
        all.update(&source.text);
        // Separates a file from the next.
        all.update([0]);
    }
    // The content of the NodeSets counts as content of the mapping.
    all.update(disk.nodesets.1.get().to_le_bytes());
    let hash = shortened(all);
    let defined = checked.types.iter();
    let defined = defined.filter(|used| matches!(used.source, TypeOrigin::File(_)));
    let defined = defined.map(key).collect();
    Ok(Reading {
        checked,
        hash,
        fingerprint: types.fingerprint(),
        differing: types.differing(running),
        types,
        known: defined,
        files: disk.seen.into_inner(),
    })
}

/// Returns the first 8 bytes of a hash in hexadecimal.
pub(super) fn shortened(all: Sha256) -> String {
    let mut hash = String::new();
    for byte in all.finalize().iter().take(8) {
        // Writing to a string does not fail.
        let _written = write!(hash, "{byte:02x}");
    }
    hash
}

fn key(used: &TypeUse) -> (Dialect, TextKind, TypeName) {
    (used.dialect, used.kind, used.name.clone())
}

/// The files and the environment of this process. Records each requested file and folder with its
/// stamp from before it was read.
#[derive(Debug)]
struct Disk<'r> {
    /// The running definitions, for definitions that cannot be read.
    running: &'r TypePaths,
    seen: RefCell<SeenFiles>,
    /// The definitions of the `type_paths`, once they were read.
    types: RefCell<Option<Arc<TypePaths>>>,
    /// The reader of NodeSets, and the fingerprint of the NodeSets read.
    nodesets: (Option<NodeSetReader>, Cell<u64>),
}

impl Disk<'_> {
    fn types(&self) -> Arc<TypePaths> {
        self.types.borrow().clone().unwrap_or_default()
    }

    fn see(&self, path: &str) {
        see(&mut self.seen.borrow_mut().mapping, Path::new(path));
    }
}

impl Surroundings for Disk<'_> {
    fn read(&self, file: &str) -> io::Result<String> {
        self.see(file);
        type_files::Disk.read(file)
    }

    fn list(&self, folder: &str) -> io::Result<Vec<String>> {
        self.see(if folder.is_empty() { "." } else { folder });
        type_files::Disk.list(folder)
    }

    fn variable(&self, name: &str) -> Option<String> {
        type_files::Disk.variable(name)
    }

    fn readers(&self, file: &str) -> Option<FileReaders> {
        type_files::Disk.readers(file)
    }

    fn types(&self, paths: &[PathBuf]) -> Box<dyn mappings::OpenTypeFiles> {
        let read = || {
            let mut seen = self.seen.borrow_mut();
            let mut own = TypePaths::read(paths, &mut |path| see(&mut seen.types, path));
            own.keep(self.running);
            Arc::new(own)
        };
        let own = Arc::clone(self.types.borrow_mut().get_or_insert_with(read));
        Box::new(TypeFiles::new(own, RosEnvironment::from_env()))
    }

    fn nodesets(&self, files: &[PathBuf]) -> Option<Box<dyn NodeSets>> {
        let (reader, fingerprint) = &self.nodesets;
        let reader = (*reader)?;
        for file in files {
            see(&mut self.seen.borrow_mut().mapping, file);
        }
        let sets = reader(files);
        fingerprint.set(sets.fingerprint());
        Some(sets)
    }
}

fn is_left_to_the_run(finding: &Diagnostic) -> bool {
    let help = finding.help.as_ref();
    let doubtful = help.is_some_and(|help| help.starts_with("did you mean"));
    finding.severity != Severity::Error
        && finding.needed_by.is_empty()
        && !doubtful
        && matches!(
            finding.code,
            Code::UnknownMessageType | Code::UnknownServiceType | Code::UnknownActionType
        )
}
