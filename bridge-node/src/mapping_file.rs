//! The mapping as a file that people edit while the program runs.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use mappings::{Checked, Code, Diagnostic, Mapping, Readers, Severity, Surroundings, TypeFiles};
use serde::Serialize;
use sha2::{Digest, Sha256};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{error, info, warn};

use crate::clock::now;
use crate::exit::{Failure, FailureKind};

/// The mapping that runs, and what is to be told of it.
#[derive(Debug, Clone)]
pub(crate) struct Running {
    pub(crate) mapping: Arc<Mapping>,
    pub(crate) about: Arc<About>,
}

/// What the status says of the mapping.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct About {
    /// `None` for zero configuration.
    file: Option<String>,
    /// The beginning of the SHA-256 of all its files.
    hash: String,
    /// When it was taken, in seconds since 1970.
    loaded: i64,
    variables: usize,
    /// How often another one took its place.
    reloads: u64,
    /// How often one was refused.
    refused: u64,
    /// Why the file is newer than what runs.
    stale: Option<String>,
}

impl About {
    /// What Prometheus asks for: name and value.
    pub(crate) fn figures(&self) -> [(&'static str, u64); 4] {
        [
            (
                "mapping_loaded_seconds",
                self.loaded.try_into().unwrap_or(0),
            ),
            ("mapping_reloads_total", self.reloads),
            ("mapping_refused_total", self.refused),
            ("mapping_stale", u64::from(self.stale.is_some())),
        ]
    }

    pub(crate) fn hash(&self) -> &str {
        &self.hash
    }
}

/// One reading of the mapping's files.
#[derive(Debug)]
struct Reading {
    checked: Checked,
    /// As rustc tells it.
    rendered: String,
    hash: String,
    /// What was read, or would have been, and how each was before it was read.
    files: Stamps,
}

/// How files were when they were looked at; `None` for one that is not there.
type Stamps = BTreeMap<PathBuf, Option<Stamp>>;

/// What changes when a file is written, renamed over, or the link to it is turned to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stamp {
    device: u64,
    inode: u64,
    len: u64,
    modified: (i64, i64),
    changed: (i64, i64),
}

fn stamp(file: &Path) -> Option<Stamp> {
    let found = std::fs::metadata(file).ok()?;
    Some(Stamp {
        device: found.dev(),
        inode: found.ino(),
        len: found.len(),
        modified: (found.mtime(), found.mtime_nsec()),
        changed: (found.ctime(), found.ctime_nsec()),
    })
}

/// Reads the mapping and what it includes.
///
/// # Errors
/// Why the file cannot be read.
fn read(file: &Path) -> Result<Reading, String> {
    let disk = Disk::default();
    let name = file.display().to_string();
    let text = disk
        .read(&name)
        .map_err(|error| format!("cannot read the mapping {name}: {error}"))?;
    let checked = Mapping::from_text(&text, &name, &disk);
    let mut all = Sha256::new();
    for source in &checked.sources {
        all.update(&source.text);
        // Where one ends and the next begins.
        all.update([0]);
    }
    let mut hash = String::new();
    for byte in all.finalize().iter().take(8) {
        // Writing to a string does not fail.
        let _written = write!(hash, "{byte:02x}");
    }
    Ok(Reading {
        rendered: checked.render_all(),
        checked,
        hash,
        files: disk.seen.into_inner(),
    })
}

/// The files and the environment of this process. Remembers each file and folder it was asked for, and how that was
/// before it was read.
#[derive(Debug, Default)]
struct Disk {
    seen: RefCell<Stamps>,
}

impl Disk {
    fn see(&self, path: &str) {
        let path = PathBuf::from(path);
        let stamp = stamp(&path);
        self.seen.borrow_mut().insert(path, stamp);
    }
}

impl Surroundings for Disk {
    fn read(&self, file: &str) -> Result<String, String> {
        self.see(file);
        type_files::Disk.read(file)
    }

    fn list(&self, folder: &str) -> Result<Vec<String>, String> {
        self.see(if folder.is_empty() { "." } else { folder });
        type_files::Disk.list(folder)
    }

    fn variable(&self, name: &str) -> Option<String> {
        type_files::Disk.variable(name)
    }

    fn readers(&self, file: &str) -> Option<Readers> {
        type_files::Disk.readers(file)
    }

    fn types(&self, paths: &[PathBuf]) -> Box<dyn TypeFiles> {
        type_files::Disk.types(paths)
    }
}

/// The file and the mapping last taken from it.
#[derive(Debug)]
pub(crate) struct MappingFile {
    file: Option<PathBuf>,
    /// The files as they were when they were last read.
    files: Stamps,
    /// Of the last reading, taken or refused.
    hash: String,
    running: Running,
}

impl MappingFile {
    /// Reads the mapping for the first time and prints its findings. Without a file: zero configuration. `None`: with
    /// `only_check`, it was checked and can run.
    ///
    /// # Errors
    /// A file that cannot be read, or a mapping that cannot run.
    pub(crate) fn open(file: Option<&Path>, only_check: bool) -> Result<Option<Self>, Failure> {
        let Some(file) = file else {
            let running = Running {
                mapping: Arc::default(),
                about: Arc::default(),
            };
            let without = Self {
                file: None,
                files: Stamps::new(),
                hash: String::new(),
                running,
            };
            return Ok((!only_check).then_some(without));
        };
        let mut reading = read(file).map_err(|error| Failure::new(FailureKind::Io, error))?;
        if !only_check && reading.checked.mapping.is_some() && reading.leave_to_the_run(file) {
            reading.rendered = reading.checked.render_all();
        }
        // A closed stderr is no reason not to run.
        let _printed = std::io::stderr().write_all(reading.rendered.as_bytes());
        match reading.checked.mapping {
            Some(_) if only_check => {
                info!("{} can run", file.display());
                Ok(None)
            }
            Some(mapping) => {
                let about = About {
                    file: Some(file.display().to_string()),
                    hash: reading.hash.clone(),
                    loaded: seconds(),
                    variables: mapping.variables().len(),
                    ..About::default()
                };
                Ok(Some(Self {
                    file: Some(file.to_owned()),
                    files: reading.files,
                    hash: reading.hash,
                    running: Running {
                        mapping: Arc::new(mapping),
                        about: Arc::new(about),
                    },
                }))
            }
            None => Err(Failure::new(
                FailureKind::Configuration,
                format!("{} cannot run, see the findings above", file.display()),
            )),
        }
    }

    /// What runs now.
    pub(crate) const fn running(&self) -> &Running {
        &self.running
    }

    /// Reads the file again whenever it was saved, and at each SIGHUP, and tells `shells` of what is to run. Never ends.
    ///
    /// The files are looked at, not listened to: that sees what inotify does not, as a folder of a container that is
    /// mounted anew and files on a network, costs a handful of system calls, and is how a file that is being written is
    /// waited for in any case.
    pub(crate) async fn follow(mut self, mut hangup: Signal, shells: watch::Sender<Running>) {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut seen = self.files.clone();
        loop {
            let asked = tokio::select! {
                Some(()) = hangup.recv() => true,
                _ = looks.tick(), if self.file.is_some() => false,
            };
            let Some(file) = self.file.clone() else {
                if asked {
                    info!("SIGHUP: there is no mapping to read again");
                }
                continue;
            };
            let is: Stamps = self
                .files
                .keys()
                .map(|file| (file.clone(), stamp(file)))
                .collect();
            // Written to until just now, or about to be: a file that is saved is gone or empty for a moment.
            let settled = is == seen
                && is
                    .get(&file)
                    .is_some_and(|at| at.is_some_and(|at| at.len > 0));
            let wanted = asked || (settled && is != self.files);
            seen = is;
            if !wanted {
                continue;
            }
            // One that cannot be read is told of once.
            self.files.clone_from(&seen);
            // Elsewhere, since a large one takes longer than a sample should wait.
            let reading = tokio::task::spawn_blocking(move || read(&file)).await;
            let reading = reading.unwrap_or_else(|error| Err(error.to_string()));
            if self.take(reading, asked) {
                shells.send_replace(self.running.clone());
            }
            seen.clone_from(&self.files);
        }
    }

    /// Takes what was read, or refuses it; says whether anything is to be told on.
    fn take(&mut self, reading: Result<Reading, String>, asked: bool) -> bool {
        let Some(file) = self.file.clone() else {
            return false;
        };
        let mut reading = match reading {
            Ok(reading) => reading,
            Err(why) => {
                self.refuse(why);
                // The same text, once it can be read again, is no longer stale.
                self.hash.clear();
                return true;
            }
        };
        self.files = std::mem::take(&mut reading.files);
        if reading.hash == self.hash && !asked {
            return false;
        }
        self.hash.clone_from(&reading.hash);
        if reading.checked.mapping.is_some() {
            // What is doubted was told at the start.
            let _rendered_no_more = reading.leave_to_the_run(&file);
        }
        tell(&reading.checked.findings);
        match &reading.checked.mapping {
            Some(mapping) => self.adopt(&file, mapping, reading.hash),
            None => {
                let errors = reading.checked.findings.iter();
                let errors = errors.filter(|f| f.severity == Severity::Error).count();
                let s = if errors == 1 { "" } else { "s" };
                self.refuse(format!("{} cannot run ({errors} error{s})", file.display()));
            }
        }
        true
    }

    fn refuse(&mut self, why: String) {
        let about = Arc::make_mut(&mut self.running.about);
        error!(
            running = about.hash,
            "{why}: nothing is changed, what runs stays as it is"
        );
        about.refused += 1;
        about.stale = Some(why);
    }

    fn adopt(&mut self, file: &Path, mapping: &Mapping, hash: String) {
        let difference = mapping.difference(&self.running.mapping);
        info!(
            hash,
            added = difference.added.len(),
            changed = difference.changed.len(),
            removed = difference.removed.len(),
            same = difference.same,
            "{} was read again",
            file.display()
        );
        let about = Arc::make_mut(&mut self.running.about);
        about.hash = hash;
        about.loaded = seconds();
        about.variables = mapping.variables().len();
        about.reloads += 1;
        about.stale = None;
        // A copy, made by this thread: that of the thread that read lies among what it left, whose room would stay taken.
        self.running.mapping = Arc::new(mapping.clone());
    }
}

/// Logs findings, each with what to do about it.
fn tell(findings: &[Diagnostic]) {
    for finding in findings {
        let help = finding.help.as_ref().map(tracing::field::display);
        match finding.severity {
            Severity::Error => error!(help, "{finding}"),
            Severity::Warning => warn!(help, "{finding}"),
        }
    }
}

impl Reading {
    /// Types that are not built in are the rule with robots of a make, and what comes of them is told when they are met.
    /// Says whether there are such findings, which are taken out.
    fn leave_to_the_run(&mut self, file: &Path) -> bool {
        let findings = &mut self.checked.findings;
        let before = findings.len();
        findings.retain(|finding| !is_left_to_the_run(finding));
        let left = before - findings.len();
        if left > 0 {
            info!(
                "{left} bindings of {} are of types that are not built in; they are looked at when the definitions \
                 are there (--check names them)",
                file.display()
            );
        }
        left > 0
    }
}

fn is_left_to_the_run(finding: &Diagnostic) -> bool {
    let help = finding.help.as_ref();
    let doubtful = help.is_some_and(|help| help.starts_with("did you mean"));
    finding.severity != Severity::Error
        && !doubtful
        && matches!(
            finding.code,
            Code::UnknownMessageType | Code::UnknownServiceType
        )
}

fn seconds() -> i64 {
    let seconds = now().utc.unix_nanos() / 1_000_000_000;
    seconds.try_into().unwrap_or(i64::MAX)
}

/// How often the files are looked at. One that was the same twice is no longer being written.
const LOOK: Duration = Duration::from_millis(250);
