//! Detects changes of the files of a mapping.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::timeout;
use tracing::warn;
use type_files::TypePaths;

use super::NodeSetReader;
use super::reading::{DefinedTypes, Reading, UnreadMapping, read};
use super::stamps::{SeenFiles, Stamps, again};

/// The state from the last poll.
#[derive(Debug, Default)]
pub(super) struct Before {
    pub(super) mapping: Option<Stamps>,
    /// The stamps of the definitions if they have changed since the reading, with the turn at which
    /// the change was seen.
    pub(super) types: Option<(Stamps, usize)>,
}

impl Before {
    /// Returns whether the last poll found all files as they were read.
    pub(super) fn is_unchanged(&self, files: &SeenFiles) -> bool {
        self.mapping.as_ref() == Some(&files.mapping) && self.types.is_none()
    }
}

/// The result of a poll of the files.
#[derive(Debug, Default)]
pub(super) struct Looked {
    pub(super) before: Before,
    /// Whether the mapping is missing or empty, and was so at the last poll.
    pub(super) gone: bool,
    pub(super) reading: Option<Result<Reading, UnreadMapping>>,
}

/// The parameters of a poll.
#[derive(Debug)]
pub(super) struct PollParameters {
    pub(super) file: PathBuf,
    pub(super) nodesets: Option<NodeSetReader>,
    /// The stamps from the last reading.
    pub(super) files: Arc<SeenFiles>,
    pub(super) before: Before,
    /// The number of the poll.
    pub(super) turn: usize,
    /// Whether the files are to be read even if they are unchanged.
    pub(super) asked: bool,
    /// Whether the mapping was missing, and is to be read when it exists.
    pub(super) gone: bool,
    /// Whether the definitions are to be read even if they are unchanged.
    pub(super) again: bool,
    pub(super) running: Arc<TypePaths>,
    pub(super) known: Arc<DefinedTypes>,
}

impl PollParameters {
    /// Runs [`take`](Self::take) in another thread, so that no sample waits for a disk.
    pub(super) async fn take_elsewhere(self) -> Looked {
        let mut looking = tokio::task::spawn_blocking(|| self.take());
        let looked = match timeout(SLOW, &mut looking).await {
            Ok(looked) => looked,
            Err(_) => {
                warn!(
                    "cannot read the files of the mapping within {} s: the running mapping stays in use \
                     until they are read",
                    SLOW.as_secs()
                );
                looking.await
            }
        };
        looked.unwrap_or_else(|error| Looked {
            reading: Some(Err(error.into())),
            ..Looked::default()
        })
    }

    /// Polls the files, and reads them if they have changed and are written completely. The
    /// definitions do not prevent the reading of a mapping, and the wait until they are stable is
    /// bounded.
    fn take(self) -> Looked {
        let mapping = again(&self.files.mapping);
        // The file is being written: a file that is saved may be missing or empty for a moment.
        let at = mapping.get(&self.file).copied().flatten();
        let is_there = at.is_some_and(|at| at.len > 0);
        let settled = self.before.mapping.as_ref() == Some(&mapping);
        if !is_there && !self.asked {
            return Looked {
                before: Before {
                    mapping: Some(mapping),
                    types: None,
                },
                gone: settled,
                reading: None,
            };
        }
        let same = mapping == self.files.mapping && !self.gone;
        let (types, types_settled) = self.types();
        let wanted = if same {
            types_settled || self.again
        } else {
            settled
        };
        Looked {
            before: Before {
                mapping: Some(mapping),
                types,
            },
            gone: false,
            reading: (wanted || self.asked)
                .then(|| read((&self.file, self.nodesets), &self.running, &self.known)),
        }
    }

    /// Returns the stamps of the definition files if they have changed since the reading, and
    /// whether they are stable or were waited for long enough.
    fn types(&self) -> (Option<(Stamps, usize)>, bool) {
        let before = self.before.types.as_ref();
        if before.is_none() && !self.files.types_differ(self.turn) {
            return (None, false);
        }
        let is = again(&self.files.types);
        if is == self.files.types {
            return (None, false);
        }
        let since = before.map_or(self.turn, |(_, since)| *since);
        let settled =
            before.is_some_and(|(was, _)| *was == is) || self.turn.wrapping_sub(since) >= PATIENCE;
        (Some((is, since)), settled)
    }
}

/// Time after which a warning about a slow disk is logged.
const SLOW: Duration = Duration::from_secs(5);
/// After this number of polls, five seconds, definitions that keep changing are read as they are.
const PATIENCE: usize = 20;

#[cfg(test)]
mod tests {
    use super::*;

    /// A mapping with definitions, in a temporary folder, for repeated polls.
    struct Looks {
        folder: PathBuf,
        files: Arc<SeenFiles>,
        before: Before,
        turn: usize,
    }

    impl Looks {
        fn new(name: &str) -> Self {
            let folder =
                std::env::temp_dir().join(format!("bridge-look-{name}-{}", std::process::id()));
            std::fs::create_dir_all(folder.join("types/my_msgs/msg")).unwrap();
            let mut looks = Self {
                folder,
                files: Arc::default(),
                before: Before::default(),
                turn: 0,
            };
            looks.write("types/my_msgs/msg/Arm.msg", "bool x\n");
            looks.write("cell.yaml", "spaces: [{id: 1}]\ntype_paths: [types]\n");
            let reading = looks.look(true).reading.unwrap().unwrap();
            assert_eq!(reading.checked.findings, []);
            looks.files = Arc::new(reading.files);
            assert!(looks.files.types.len() > 3);
            looks
        }

        fn write(&self, file: &str, text: &str) {
            std::fs::write(self.folder.join(file), text).unwrap();
        }

        fn look(&mut self, asked: bool) -> Looked {
            self.turn += 1;
            let look = PollParameters {
                file: self.folder.join("cell.yaml"),
                nodesets: None,
                files: Arc::clone(&self.files),
                before: std::mem::take(&mut self.before),
                turn: self.turn,
                asked,
                gone: false,
                again: false,
                running: Arc::default(),
                known: Arc::default(),
            };
            look.take()
        }

        /// Returns whether a poll reads the files after a definition of this length was written.
        fn reads(&mut self, definition: usize) -> bool {
            self.write("types/my_msgs/msg/Arm.msg", &"#".repeat(definition));
            let looked = self.look(false);
            self.before = looked.before;
            looked.reading.is_some()
        }
    }

    impl Drop for Looks {
        fn drop(&mut self) {
            std::fs::remove_dir_all(&self.folder).unwrap();
        }
    }

    #[test]
    fn a_poll_reports_whether_all_files_are_as_they_were_read() {
        for file in ["cell.yaml", "types/my_msgs/msg/Arm.msg"] {
            let mut looks = Looks::new(file.split_once('.').unwrap().1);
            for _ in 0..2 {
                let looked = looks.look(false);
                assert!(looked.before.is_unchanged(&looks.files), "{file}");
                looks.before = looked.before;
            }
            looks.write(file, "# being written");
            let looked = looks.look(false);
            assert!(!looked.before.is_unchanged(&looks.files), "{file}");
        }
    }

    #[test]
    fn definitions_that_change_all_the_time_do_not_keep_a_mapping_from_being_read() {
        let mut looks = Looks::new("mapping");
        assert!(!looks.reads(1));
        looks.write("cell.yaml", "spaces: [{id: 2}]\ntype_paths: [types, .]\n");
        assert!(!looks.reads(2), "it may still be written");
        assert!(looks.reads(3));
    }

    #[test]
    fn definitions_that_change_all_the_time_are_read_after_some_seconds() {
        let mut looks = Looks::new("types");
        let first = (1..100).find(|length| looks.reads(*length));
        assert_eq!(first, Some(PATIENCE + 1));
    }

    #[test]
    fn of_a_mapping_that_is_gone_no_definitions_are_looked_at() {
        let mut looks = Looks::new("gone");
        looks.write("cell.yaml", "");
        assert!(!looks.reads(1));
        assert_eq!(looks.before.types, None);
        let looked = looks.look(false);
        assert!(looked.gone && looked.reading.is_none());
    }
}
