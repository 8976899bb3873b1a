//! The mapping as a file that people edit while the program runs.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use mappings::{Checked, Code, Diagnostic, Mapping, Readers, Severity, Surroundings, TypeOrigin};
use messages::{Dialect, TypeName};
use serde::Serialize;
use sha2::{Digest, Sha256};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval, timeout};
use tracing::{error, info, warn};
use type_files::{Environment, TypeFiles, TypePaths};

use crate::clock::now;
use crate::exit::{Failure, FailureKind};

/// The mapping that runs, and what is to be told of it.
#[derive(Debug, Clone)]
pub(crate) struct Running {
    pub(crate) mapping: Arc<Mapping>,
    /// What its `type_paths` have.
    pub(crate) types: Arc<TypePaths>,
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
    /// Of what the `type_paths` have.
    fingerprint: u64,
    types: Arc<TypePaths>,
    /// Types the mapping names that are defined by files.
    known: Known,
    /// What is wrong with definitions that run.
    spoiled: Vec<String>,
    /// Definitions that are not what runs.
    differing: usize,
    files: Seen,
}

type Known = BTreeSet<(Dialect, TypeName)>;

/// What was read, or would have been, and how each file and folder was before that.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Seen {
    /// The mapping and what it includes.
    mapping: Stamps,
    /// What is at and below the `type_paths`.
    types: Stamps,
}

impl Seen {
    /// How the same files are by now.
    fn again(&self) -> Self {
        let look = |stamps: &Stamps| {
            let files = stamps.keys();
            files.map(|file| (file.clone(), stamp(file))).collect()
        };
        Self {
            mapping: look(&self.mapping),
            types: look(&self.types),
        }
    }

    /// Whether one of them is another by now: of the mapping's any, of the others those whose turn it is.
    fn differ(&self, turn: usize) -> bool {
        let turns = self.types.len().div_ceil(LOOKED_AT_ONCE).max(1);
        let first = turn % turns * LOOKED_AT_ONCE;
        let types = self.types.iter().skip(first).take(LOOKED_AT_ONCE);
        let mut looked_at = self.mapping.iter().chain(types);
        looked_at.any(|(file, was)| stamp(file) != *was)
    }
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

/// Reads the mapping, what it includes, and the definitions of its `type_paths`.
///
/// # Errors
/// Why the file cannot be read.
fn read(file: &Path, running: &TypePaths, known: &Known) -> Result<Reading, String> {
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
    let types = disk.types.into_inner();
    let mut spoiled: Vec<String> = types.spoiled(running).into_iter().map(Into::into).collect();
    let mut defined = Known::new();
    for used in &checked.types {
        let key = (used.dialect, used.name.clone());
        match &used.source {
            TypeOrigin::File(_) => {
                defined.insert(key);
            }
            TypeOrigin::Unknown if known.contains(&key) => {
                let file = types.file(used.dialect, &used.name);
                spoiled.extend(file.map(|file| {
                    format!("{file}: what `{}` needs is not defined any more", used.name)
                }));
            }
            TypeOrigin::Unknown | TypeOrigin::BuiltIn => {}
        }
    }
    Ok(Reading {
        rendered: checked.render_all(),
        checked,
        hash,
        fingerprint: types.fingerprint(),
        differing: types.differing(running),
        types,
        known: defined,
        spoiled,
        files: disk.seen.into_inner(),
    })
}

/// What one look at the files found.
#[derive(Debug)]
struct Looked {
    /// How they are, as long as that is not how they were read.
    seen: Option<Seen>,
    reading: Option<Result<Reading, String>>,
}

/// What is looked for.
#[derive(Debug)]
struct Look {
    file: PathBuf,
    /// As they were read last.
    files: Arc<Seen>,
    /// As they were at the last look, where that is not how they were read.
    before: Option<Seen>,
    turn: usize,
    /// Whether they are to be read whatever they are.
    asked: bool,
    running: Arc<TypePaths>,
    known: Arc<Known>,
}

impl Look {
    /// [`take`](Self::take) in another thread, since no sample should wait for a disk.
    async fn take_elsewhere(self) -> Looked {
        let mut looking = tokio::task::spawn_blocking(|| self.take());
        let looked = match timeout(SLOW, &mut looking).await {
            Ok(looked) => looked,
            Err(_) => {
                warn!(
                    "the files of the mapping have not been read within {} s: what runs stays as it is until they are",
                    SLOW.as_secs()
                );
                looking.await
            }
        };
        looked.unwrap_or_else(|error| Looked {
            seen: None,
            reading: Some(Err(error.to_string())),
        })
    }

    /// Looks at the files, and reads them if they are other ones that are no longer being written.
    fn take(self) -> Looked {
        let reading = || Some(read(&self.file, &self.running, &self.known));
        if !self.asked && self.before.is_none() && !self.files.differ(self.turn) {
            return Looked {
                seen: None,
                reading: None,
            };
        }
        let is = self.files.again();
        // Written to until just now, or about to be: a file that is saved is gone or empty for a moment.
        let at = is.mapping.get(&self.file).copied().flatten();
        let settled = self.before.as_ref() == Some(&is) && at.is_some_and(|at| at.len > 0);
        let differs = is != *self.files;
        let wanted = self.asked || (settled && differs);
        Looked {
            seen: (differs || wanted).then_some(is),
            reading: if wanted { reading() } else { None },
        }
    }
}

/// The files and the environment of this process. Remembers each file and folder it was asked for, and how that was
/// before it was read.
#[derive(Debug, Default)]
struct Disk {
    seen: RefCell<Seen>,
    types: RefCell<Arc<TypePaths>>,
}

impl Disk {
    fn see(&self, path: &str) {
        see(&mut self.seen.borrow_mut().mapping, Path::new(path));
    }
}

/// How it was at first counts, as something is read by then.
fn see(seen: &mut Stamps, path: &Path) {
    if !seen.contains_key(path) {
        seen.insert(path.to_owned(), stamp(path));
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

    fn types(&self, paths: &[PathBuf]) -> Box<dyn mappings::TypeFiles> {
        let mut seen = self.seen.borrow_mut();
        let own = TypePaths::read(paths, &mut |path| see(&mut seen.types, path));
        let own = Arc::new(own);
        self.types.replace(Arc::clone(&own));
        Box::new(TypeFiles::new(own, Environment::from_env()))
    }
}

/// The file and the mapping last taken from it.
#[derive(Debug)]
pub(crate) struct MappingFile {
    file: Option<PathBuf>,
    /// The files as they were when they were last read.
    files: Arc<Seen>,
    /// Of the last reading, taken or refused.
    hash: String,
    /// Likewise.
    fingerprint: u64,
    /// Of the types that what runs names, those that are defined by files.
    known: Arc<Known>,
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
                types: Arc::default(),
                about: Arc::default(),
            };
            let without = Self {
                file: None,
                files: Arc::default(),
                hash: String::new(),
                fingerprint: 0,
                known: Arc::default(),
                running,
            };
            return Ok((!only_check).then_some(without));
        };
        let mut reading = read(file, &TypePaths::default(), &Known::new())
            .map_err(|error| Failure::new(FailureKind::Io, error))?;
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
                    files: Arc::new(reading.files),
                    hash: reading.hash,
                    fingerprint: reading.fingerprint,
                    known: Arc::new(reading.known),
                    running: Running {
                        mapping: Arc::new(mapping),
                        types: reading.types,
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

    /// Reads the files again whenever one of them was saved, and at each SIGHUP, and tells `shells` of what is to run. Never
    /// ends.
    ///
    /// The files are looked at, not listened to: that sees what inotify does not, as a folder of a container that is
    /// mounted anew and files on a network, costs a handful of system calls, and is how a file that is being written is
    /// waited for in any case. Of the definitions, of which there may be thousands, a bounded number has its turn with
    /// each look.
    pub(crate) async fn follow(mut self, mut hangup: Signal, shells: watch::Sender<Running>) {
        let mut looks = interval(LOOK);
        looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut before = None;
        let mut turn = 0_usize;
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
            let look = Look {
                file,
                files: Arc::clone(&self.files),
                before: before.take(),
                turn,
                asked,
                running: Arc::clone(&self.running.types),
                known: Arc::clone(&self.known),
            };
            turn = turn.wrapping_add(1);
            // One at a time: what is saved meanwhile differs from what was seen before the reading, and a signal is kept.
            let Looked { seen, reading } = look.take_elsewhere().await;
            let Some(reading) = reading else {
                before = seen;
                continue;
            };
            if let Some(seen) = seen {
                // One that cannot be read is told of once.
                self.files = Arc::new(seen);
            }
            if self.take(reading, asked) {
                shells.send_replace(self.running.clone());
            }
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
        self.files = Arc::new(std::mem::take(&mut reading.files));
        if (&reading.hash, reading.fingerprint) == (&self.hash, self.fingerprint) && !asked {
            return false;
        }
        self.hash.clone_from(&reading.hash);
        self.fingerprint = reading.fingerprint;
        if let Some((first, more)) = reading.spoiled.split_first() {
            for why in more.iter().take(MOST_TOLD) {
                error!("{why}");
            }
            let more = match more.len() {
                0 => String::new(),
                more => format!(" (and {more} more)"),
            };
            self.refuse(format!("a definition that runs is faulty: {first}{more}"));
            return true;
        }
        if reading.checked.mapping.is_some() {
            // What is doubted was told at the start.
            let _rendered_no_more = reading.leave_to_the_run(&file);
        }
        tell(&reading.checked.findings);
        match reading.checked.mapping.take() {
            Some(mapping) => self.adopt(&file, &mapping, reading),
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

    fn adopt(&mut self, file: &Path, mapping: &Mapping, reading: Reading) {
        let difference = mapping.difference(&self.running.mapping);
        info!(
            hash = reading.hash,
            added = difference.added.len(),
            changed = difference.changed.len(),
            removed = difference.removed.len(),
            same = difference.same,
            definitions = reading.differing,
            "{} was read again",
            file.display()
        );
        let about = Arc::make_mut(&mut self.running.about);
        about.hash = reading.hash;
        about.loaded = seconds();
        about.variables = mapping.variables().len();
        about.reloads += 1;
        about.stale = None;
        // A copy, made by this thread: that of the thread that read lies among what it left, whose room would stay taken.
        self.running.mapping = Arc::new(mapping.clone());
        self.running.types = reading.types;
        self.known = Arc::new(reading.known);
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
/// After that time a disk is said not to answer.
const SLOW: Duration = Duration::from_secs(5);
/// Faulty definitions named in one go; more are of one cause.
const MOST_TOLD: usize = 10;
/// Definition files and folders looked at with each look: some 1000 a second, of which each costs a microsecond or two.
const LOOKED_AT_ONCE: usize = 256;
