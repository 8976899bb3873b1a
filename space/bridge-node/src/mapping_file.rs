//! The mapping file, which users edit while the program runs.

mod configuration;
mod look;
mod reading;
mod stamps;

use std::collections::BTreeSet;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use mappings::{Diagnostic, Mapping, NodeSets, Severity, SpaceId};
use serde::Serialize;
use service::{Failure, FailureKind};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tracing::{error, info, warn};
use type_files::TypePaths;

pub use self::configuration::ConfigurationFile;
use self::look::{Before, PollParameters};
use self::reading::{DefinedTypes, Reading, UnreadMapping, read};
use self::stamps::SeenFiles;
use crate::clock::now;

/// Reads NodeSet2 files for the check of a mapping.
pub type NodeSetReader = fn(&[PathBuf]) -> Box<dyn NodeSets>;

/// The running mapping with its definitions and status.
#[derive(Debug, Clone)]
pub(crate) struct RunningMapping {
    pub(crate) mapping: Arc<Mapping>,
    /// The definitions of its `type_paths`.
    pub(crate) types: Arc<TypePaths>,
    pub(crate) about: Arc<About>,
}

/// The status of the mapping.
#[derive(Debug, Clone, Default, Serialize)]
pub(crate) struct About {
    /// The path of the file; `None` without a mapping (zero configuration).
    file: Option<String>,
    /// The first 8 bytes of the SHA-256 of all its files, in hexadecimal.
    hash: String,
    /// Time of adoption, in seconds since 1970.
    loaded: i64,
    variables: usize,
    /// Number of adopted reloads.
    reloads: u64,
    /// Number of refused reloads.
    refused: u64,
    /// The reason why the file is newer than the running mapping.
    stale: Option<String>,
    /// The changes of the last adopted reload, a line each, of a program with a configuration of
    /// its own.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    changes: Vec<String>,
}

impl About {
    /// Returns the values for Prometheus, each with its name.
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

/// The mapping file and the mapping last adopted from it.
#[derive(Debug)]
pub(crate) struct MappingFile {
    file: Option<PathBuf>,
    /// The configuration of a program without a mapping, which is in `file`.
    configuration: Option<Arc<dyn ConfigurationFile>>,
    /// The reader of the NodeSets that the mapping names.
    nodesets: Option<NodeSetReader>,
    /// The files as they were when they were last read.
    files: Arc<SeenFiles>,
    /// Hash of the last reading, adopted or refused.
    hash: String,
    /// Fingerprint of the last reading, adopted or refused.
    fingerprint: u64,
    /// Types named in the running mapping that files define.
    known: Arc<DefinedTypes>,
    /// The logged reasons why earlier definitions stay in use.
    told: BTreeSet<String>,
    /// Whether the loss of the file was logged.
    gone: bool,
    /// The spaces that the program serves. Errors that concern only other spaces do not stop it.
    spaces: Vec<SpaceId>,
    running: RunningMapping,
}

impl MappingFile {
    /// Returns a mapping without a file, which never changes.
    pub(crate) fn none(mapping: Mapping) -> Self {
        let running = RunningMapping {
            mapping: Arc::new(mapping),
            types: Arc::default(),
            about: Arc::default(),
        };
        Self {
            file: None,
            configuration: None,
            nodesets: None,
            files: Arc::default(),
            hash: String::new(),
            fingerprint: 0,
            known: Arc::default(),
            told: BTreeSet::new(),
            gone: false,
            spaces: Vec::new(),
            running,
        }
    }

    /// Reads the mapping for the first time and prints its findings for a program that serves
    /// `spaces`. Without a file the program runs with zero configuration. With `only_check`, the
    /// mapping is only checked, and `None` means that it can run; if `spaces` fails, it is checked
    /// for all spaces.
    ///
    /// # Errors
    /// A file that cannot be read, or a mapping that cannot run.
    pub(crate) fn open(
        (file, nodesets): (Option<&Path>, Option<NodeSetReader>),
        only_check: bool,
        spaces: impl FnOnce(&Mapping) -> Result<Vec<SpaceId>, Failure>,
    ) -> Result<Option<Self>, Failure> {
        let Some(file) = file else {
            return Ok((!only_check).then(|| Self::none(Mapping::default())));
        };
        let mut reading = read(
            (file, nodesets),
            &TypePaths::default(),
            &DefinedTypes::new(),
        )
        .map_err(|error| Failure::new(FailureKind::Io, error.to_string()))?;
        let spaces = reading.checked.outline().map(spaces).transpose();
        let mut own = Vec::new();
        if let Ok(Some(spaces)) = &spaces {
            own.clone_from(spaces);
            reading.checked = reading.checked.for_spaces(&own);
        }
        if !only_check && reading.checked.mapping.is_some() {
            let _rendered_no_more = reading.leave_to_the_run(file);
        }
        // The program runs even if stderr is closed.
        let _printed = io::stderr().write_all(reading.checked.render_all().as_bytes());
        if !only_check {
            spaces?;
        }
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
                    configuration: None,
                    nodesets,
                    files: Arc::new(reading.files),
                    hash: reading.hash,
                    fingerprint: reading.fingerprint,
                    known: Arc::new(reading.known),
                    told: BTreeSet::new(),
                    gone: false,
                    spaces: own,
                    running: RunningMapping {
                        mapping: Arc::new(mapping),
                        types: reading.types,
                        about: Arc::new(about),
                    },
                }))
            }
            None => Err(Failure::new(
                FailureKind::Configuration,
                format!(
                    "{} has errors (see the findings above): correct them and start again",
                    file.display()
                ),
            )),
        }
    }

    /// Returns the running mapping.
    pub(crate) const fn running(&self) -> &RunningMapping {
        &self.running
    }

    /// Reads the files again whenever a file was saved, and at each SIGHUP, and sends the adopted
    /// mapping to `shells`. Never ends.
    ///
    /// The files are polled instead of watched with inotify. Polling notices changes that inotify
    /// does not, such as a remounted folder of a container and files on a network. It costs a
    /// handful of system calls, and it is needed anyway to wait until a file is written completely.
    /// There may be thousands of definitions, so each poll checks a bounded number of them in turn.
    pub(crate) async fn follow(self, hangup: Signal, shells: watch::Sender<RunningMapping>) {
        match self.configuration.clone() {
            Some(configuration) => {
                self.follow_configuration(configuration, hangup, shells)
                    .await;
            }
            None => self.follow_mapping(hangup, shells).await,
        }
    }

    async fn follow_mapping(mut self, mut hangup: Signal, shells: watch::Sender<RunningMapping>) {
        let mut pause = Duration::ZERO;
        let mut before = Before::default();
        let mut turn = 0_usize;
        let mut again = None;
        loop {
            let asked = tokio::select! {
                Some(()) = hangup.recv() => true,
                () = idle_ticks::sleep(pause), if self.file.is_some() => false,
            };
            pause = LOOK;
            let Some(file) = self.file.clone() else {
                if asked {
                    info!("ignored SIGHUP: this program runs without a mapping");
                }
                continue;
            };
            let look = PollParameters {
                file,
                nodesets: self.nodesets,
                files: Arc::clone(&self.files),
                before: std::mem::take(&mut before),
                turn,
                asked,
                gone: self.gone,
                again: again.is_some_and(|since| turn.wrapping_sub(since) >= AGAIN),
                running: Arc::clone(&self.running.types),
                known: Arc::clone(&self.known),
            };
            turn = turn.wrapping_add(1);
            // One poll at a time: a file saved meanwhile differs from the stamp taken before the
            // reading, and a signal stays queued.
            let looked = look.take_elsewhere().await;
            if looked.gone && !self.gone {
                self.lose();
                shells.send_replace(self.running.clone());
            }
            let Some(reading) = looked.reading else {
                before = looked.before;
                if !self.gone && before.is_unchanged(&self.files) {
                    pause = IDLE_LOOK;
                }
                continue;
            };
            // A file that cannot be read is reported once.
            let files = Arc::make_mut(&mut self.files);
            if let Some(mapping) = looked.before.mapping {
                files.mapping = mapping;
            }
            if let Some((types, _)) = looked.before.types {
                files.types = types;
            }
            self.gone = false;
            if let Ok(reading) = &reading {
                let without = reading.types.is_without_folder();
                again = without.then_some(turn);
            }
            if self.take(reading, asked) {
                shells.send_replace(self.running.clone());
            }
        }
    }

    /// Adopts or refuses a reading. Returns whether the shells have to be notified.
    fn take(&mut self, reading: Result<Reading, UnreadMapping>, asked: bool) -> bool {
        let Some(file) = self.file.clone() else {
            return false;
        };
        let mut reading = match reading {
            Ok(reading) => reading,
            Err(why) => {
                self.refuse(why.to_string());
                // Once the file is readable again, the same text counts as new, which clears the
                // stale status.
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
        let kept = reading.types.kept().to_vec();
        let same = reading.hash == self.running.about.hash && reading.differing == 0;
        if let Some(why) = reason(&kept).filter(|_| same) {
            for why in kept.iter().skip(1).take(MOST_TOLD) {
                error!("{why}");
            }
            self.told = kept.into_iter().collect();
            self.refuse(why);
            return true;
        }
        let untold = kept.iter().filter(|why| asked || !self.told.contains(*why));
        for why in untold.take(MOST_TOLD) {
            error!("{why}: the previous definitions stay in use");
        }
        self.told = kept.into_iter().collect();
        self.judge(&file, reading);
        true
    }

    /// Adopts a reading if it can run.
    fn judge(&mut self, file: &Path, mut reading: Reading) {
        reading.checked = reading.checked.for_spaces(&self.spaces);
        if reading.checked.mapping.is_some() {
            // Unknown types were reported at the start.
            let _rendered_no_more = reading.leave_to_the_run(file);
        }
        tell(&reading.checked.findings);
        match reading.checked.mapping.take() {
            Some(mapping) => self.adopt(file, &mapping, reading),
            None => {
                let errors = reading.checked.findings.iter();
                let errors = errors.filter(|f| f.severity == Severity::Error).count();
                let s = if errors == 1 { "" } else { "s" };
                self.refuse(format!("{} cannot run ({errors} error{s})", file.display()));
            }
        }
    }

    fn refuse(&mut self, why: String) {
        let about = Arc::make_mut(&mut self.running.about);
        error!(
            running = about.hash,
            "{why}: the running mapping stays in use"
        );
        about.refused += 1;
        about.stale = Some(why);
    }

    /// Logs that the file is missing. Once it exists again, it is read as a changed file.
    fn lose(&mut self) {
        let Some(file) = &self.file else {
            return;
        };
        let about = Arc::make_mut(&mut self.running.about);
        let why = format!("{} is missing or empty", file.display());
        warn!(
            running = about.hash,
            "{why}: the running mapping stays in use"
        );
        about.stale = Some(why);
        self.gone = true;
        self.hash.clear();
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
            "reloaded {}",
            file.display()
        );
        let about = Arc::make_mut(&mut self.running.about);
        about.hash = reading.hash;
        about.loaded = seconds();
        about.variables = mapping.variables().len();
        about.reloads += 1;
        about.stale = reason(reading.types.kept());
        // A copy made by this thread: the original was allocated by the thread that read the files
        // and would keep the memory around it in use.
        self.running.mapping = Arc::new(mapping.clone());
        self.running.types = reading.types;
        self.known = Arc::new(reading.known);
    }
}

/// Returns the reason why the running mapping uses earlier definitions, if it does.
fn reason(kept: &[String]) -> Option<String> {
    let (first, more) = kept.split_first()?;
    let more = match more.len() {
        0 => String::new(),
        more => format!(" (and {more} more)"),
    };
    Some(format!(
        "the previous definitions stay in use: {first}{more}"
    ))
}

/// Logs findings, each with its remedy.
fn tell(findings: &[Diagnostic]) {
    for finding in findings {
        let help = finding.help.as_ref().map(tracing::field::display);
        match finding.severity {
            Severity::Error => error!(help, "{finding}"),
            Severity::Warning => warn!(help, "{finding}"),
        }
    }
}

fn seconds() -> i64 {
    let seconds = now().utc.unix_nanos() / 1_000_000_000;
    seconds.try_into().unwrap_or(i64::MAX)
}

/// Interval of the polls after a change. A file with the same stamp in two polls is written
/// completely.
const LOOK: Duration = Duration::from_millis(250);
/// Interval of the polls while nothing changes. Each poll wakes the program three times.
const IDLE_LOOK: Duration = Duration::from_secs(1);
/// After this number of polls, ten seconds at most, folders of definitions that could not be listed
/// are read again, even if their stamps are unchanged.
const AGAIN: usize = 10;
/// The maximal number of faulty definitions logged at a time; further faults usually have the same
/// cause.
const MOST_TOLD: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_faulty_definition_keeps_its_text_and_no_mapping_from_being_taken() {
        let folder = std::env::temp_dir().join(format!("bridge-mapping-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("types/my_msgs/msg")).unwrap();
        let write = |file: &str, text: &str| std::fs::write(folder.join(file), text).unwrap();
        write("types/my_msgs/msg/Arm.msg", "bool x\n");
        write("cell.yaml", "spaces: [{id: 1}]\ntype_paths: [types]\n");
        let file = folder.join("cell.yaml");
        let mut mapping =
            MappingFile::open((Some(&file), None), false, |_| Ok(vec![SpaceId::ROS1]))
                .unwrap()
                .unwrap();
        let mut take = || {
            let reading = read((&file, None), &mapping.running.types, &mapping.known);
            assert!(mapping.take(reading, false));
            let about = &mapping.running.about;
            let stale = about.stale.clone().unwrap_or_default();
            (about.reloads, about.refused, stale.contains("Arm.msg:1: "))
        };
        write("types/my_msgs/msg/Arm.msg", "bool 9x\n");
        assert_eq!(take(), (0, 1, true));
        write("cell.yaml", "spaces: [{id: 2}]\ntype_paths: [types]\n");
        assert_eq!(take(), (1, 1, true));
        write("types/my_msgs/msg/Arm.msg", "bool y\n");
        assert_eq!(take(), (2, 1, false));
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_mapping_runs_where_only_another_space_needs_what_is_not_here_and_goes_on_when_it_is_saved()
    {
        let folder = std::env::temp_dir().join(format!("bridge-part-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let file = folder.join("cell.yaml");
        let cell = |topic: &str| {
            let text = format!(
                "spaces: [{{id: 1}}, {{id: 2}}]\nnamespaces: {{2: urn:x}}\nvariables:\n\
                 - {{node: ns=2;i=1, name: Arm, origin: 1, ros: [{{topic: {topic}, type: std_msgs/Bool}}, \
                 {{space: 2, topic: /arm, type: their_msgs/Arm}}]}}\n"
            );
            std::fs::write(&file, text).unwrap();
        };
        cell("/arm");
        let open = |number: u16| {
            let serves = |_: &Mapping| Ok(vec![SpaceId::new(number).unwrap_or(SpaceId::UA)]);
            MappingFile::open((Some(&file), None), false, serves)
        };
        let stopped = open(2).unwrap_err();
        assert_eq!(stopped.kind(), FailureKind::Configuration);
        open(0).unwrap().unwrap();
        let mut mapping = open(1).unwrap().unwrap();
        cell("/other");
        let reading = read((&file, None), &mapping.running.types, &mapping.known);
        assert!(mapping.take(reading, false));
        let about = &mapping.running.about;
        assert_eq!((about.reloads, about.refused), (1, 0));
        // Without a known space, the whole cell is checked.
        let nobody = |_: &Mapping| Err(Failure::new(FailureKind::Usage, "which?"));
        let checked = MappingFile::open((Some(&file), None), true, nobody).unwrap_err();
        assert_eq!(checked.kind(), FailureKind::Configuration);
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
