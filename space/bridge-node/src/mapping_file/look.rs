//! Whether the files of a mapping are other ones than those that were read.

use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use tokio::time::timeout;
use tracing::warn;
use type_files::TypePaths;

use super::{Known, NodeSetReader, Reading, read};

/// What was read, or would have been, and how each file and folder was before that.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Seen {
    /// The mapping and what it includes.
    pub(super) mapping: Stamps,
    /// What is at and below the `type_paths`.
    pub(super) types: Stamps,
}

impl Seen {
    /// Whether one of the definition files and folders whose turn it is is another by now.
    fn types_differ(&self, turn: usize) -> bool {
        let turns = self.types.len().div_ceil(LOOKED_AT_ONCE).max(1);
        let first = turn % turns * LOOKED_AT_ONCE;
        let mut types = self.types.iter().skip(first).take(LOOKED_AT_ONCE);
        types.any(|(file, was)| stamp(file) != *was)
    }
}

/// How files were when they were looked at; `None` for one that is not there.
pub(super) type Stamps = BTreeMap<PathBuf, Option<Stamp>>;

/// What changes when a file is written, renamed over, or the link to it is turned to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stamp {
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

/// How it was at first counts, as something is read by then.
pub(super) fn see(seen: &mut Stamps, path: &Path) {
    if !seen.contains_key(path) {
        seen.insert(path.to_owned(), stamp(path));
    }
}

/// How the same files are by now.
fn again(stamps: &Stamps) -> Stamps {
    let files = stamps.keys();
    files.map(|file| (file.clone(), stamp(file))).collect()
}

/// What the last look found.
#[derive(Debug, Default)]
pub(super) struct Before {
    pub(super) mapping: Option<Stamps>,
    /// Where they are not as they were read, with the turn at which that was seen.
    pub(super) types: Option<(Stamps, usize)>,
}

/// What one look at the files found.
#[derive(Debug, Default)]
pub(super) struct Looked {
    pub(super) before: Before,
    /// Whether the mapping is not there, or empty, and was so at the last look.
    pub(super) gone: bool,
    pub(super) reading: Option<Result<Reading, String>>,
}

/// What is looked for.
#[derive(Debug)]
pub(super) struct Look {
    pub(super) file: PathBuf,
    pub(super) nodesets: Option<NodeSetReader>,
    /// As they were read last.
    pub(super) files: Arc<Seen>,
    pub(super) before: Before,
    /// Counts the looks.
    pub(super) turn: usize,
    /// Whether they are to be read whatever they are.
    pub(super) asked: bool,
    /// Whether the mapping was gone, and is to be read when it is there.
    pub(super) gone: bool,
    /// Whether the definitions are to be read whatever they are.
    pub(super) again: bool,
    pub(super) running: Arc<TypePaths>,
    pub(super) known: Arc<Known>,
}

impl Look {
    /// [`take`](Self::take) in another thread, since no sample should wait for a disk.
    pub(super) async fn take_elsewhere(self) -> Looked {
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
            reading: Some(Err(error.to_string())),
            ..Looked::default()
        })
    }

    /// Looks at the files, and reads them if they are other ones that are no longer being written.
    /// The definitions do not keep a mapping from being read, and are waited for so long only.
    fn take(self) -> Looked {
        let mapping = again(&self.files.mapping);
        // Written to until just now, or about to be: a file that is saved is gone or empty for a
        // moment.
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

    /// How the definition files are, where that is not how they were read, and whether they have
    /// been waited for.
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

/// After that time a disk is said not to answer.
const SLOW: Duration = Duration::from_secs(5);
/// After so many looks, five seconds, definitions that do not stay the same are read as they are.
const PATIENCE: usize = 20;
/// Definition files and folders looked at with each look: some 1000 a second, of which each costs a
/// microsecond or two.
const LOOKED_AT_ONCE: usize = 256;

#[cfg(test)]
mod tests {
    use super::*;

    /// A mapping with definitions, in a folder of its own that goes away with it, that is looked at
    /// again and again.
    struct Looks {
        folder: PathBuf,
        files: Arc<Seen>,
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
            let look = Look {
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

        /// Whether a look reads, the definition being so long by then.
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
