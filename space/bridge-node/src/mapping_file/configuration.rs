//! Follows the configuration file of a program without a mapping.

use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;

use mappings::Mapping;
use sha2::{Digest as _, Sha256};
use tokio::signal::unix::Signal;
use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval};
use tracing::info;
use type_files::read_text_file;

use super::reading::shortened;
use super::stamps::{FileStamp, stamp};
use super::{About, LOOK, MappingFile, RunningMapping, seconds};

/// The configuration file of a program without a mapping.
///
/// The file is read again when it is saved, and at each SIGHUP.
pub trait ConfigurationFile: Debug + Send + Sync + 'static {
    /// Returns the path of the file.
    fn path(&self) -> &Path;

    /// Returns the text of the file at the start of the program.
    fn text(&self) -> &str;

    /// Checks a text of the file as a whole, and keeps its configuration for the port, which adopts
    /// it in [`Port::reload`](crate::Port::reload). Returns the changes since the last kept
    /// configuration, a line each. Called in a thread that may wait.
    ///
    /// # Errors
    /// The reason why the text is refused, after its findings were logged.
    fn take(&self, text: String) -> Result<Vec<String>, String>;
}

impl MappingFile {
    /// Returns a mapping that a program made from its own configuration, which is followed if the
    /// program names its file.
    pub(crate) fn made(
        mapping: Mapping,
        configuration: Option<Arc<dyn ConfigurationFile>>,
    ) -> Self {
        let Some(configuration) = configuration else {
            return Self::none(mapping);
        };
        let hash = hash_of(configuration.text());
        let about = About {
            file: Some(configuration.path().display().to_string()),
            hash: hash.clone(),
            loaded: seconds(),
            ..About::default()
        };
        let mut file = Self::none(mapping);
        file.file = Some(configuration.path().to_owned());
        file.hash = hash;
        file.running.about = Arc::new(about);
        file.configuration = Some(configuration);
        file
    }

    /// Follows the file as [`follow`](Self::follow) follows a mapping. Never ends.
    pub(super) async fn follow_configuration(
        mut self,
        configuration: Arc<dyn ConfigurationFile>,
        mut hangup: Signal,
        shells: watch::Sender<RunningMapping>,
    ) {
        let mut polls = interval(LOOK);
        polls.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut polled = Polled::default();
        loop {
            let asked = tokio::select! {
                Some(()) = hangup.recv() => true,
                _ = polls.tick() => false,
            };
            let poll = Poll {
                configuration: Arc::clone(&configuration),
                hash: self.hash.clone(),
                before: polled,
                asked,
                gone: self.gone,
            };
            let looked = tokio::task::spawn_blocking(|| poll.take()).await;
            let (now, found) = looked.unwrap_or_else(|error| {
                let broken = Found::Refused(error.to_string(), String::new());
                let read = polled.seen;
                (Polled { read, ..polled }, broken)
            });
            polled = now;
            if self.adopt_found(found) {
                shells.send_replace(self.running.clone());
            }
        }
    }

    /// Adopts or refuses the result of a poll. Returns whether the shells have to be notified.
    fn adopt_found(&mut self, found: Found) -> bool {
        match found {
            Found::Nothing => return false,
            Found::Gone if self.gone => return false,
            Found::Gone => self.lose(),
            Found::Refused(why, hash) => {
                self.gone = false;
                self.hash = hash;
                self.refuse(why);
            }
            Found::Adopted(changes, hash) => {
                self.gone = false;
                self.hash.clone_from(&hash);
                let file = self.file.clone().unwrap_or_default();
                let about = Arc::make_mut(&mut self.running.about);
                info!(
                    hash,
                    changes = changes.len(),
                    "{} was read again",
                    file.display()
                );
                for change in &changes {
                    info!("{change}");
                }
                about.hash = hash;
                about.loaded = seconds();
                about.reloads += 1;
                about.stale = None;
                about.changes = changes;
                // The run loop passes each new mapping to the port, which adopts the configuration.
                self.running.mapping = Arc::new(Mapping::clone(&self.running.mapping));
            }
        }
        true
    }
}

/// The stamps of the last polls.
#[derive(Debug, Clone, Copy, Default)]
struct Polled {
    /// The stamp of the file at its last reading.
    read: Option<FileStamp>,
    /// The stamp of the file at the last poll.
    seen: Option<FileStamp>,
}

/// The parameters of a poll.
#[derive(Debug)]
struct Poll {
    configuration: Arc<dyn ConfigurationFile>,
    /// Hash of the last text, adopted or refused.
    hash: String,
    before: Polled,
    /// Whether the file is to be read even if it is unchanged.
    asked: bool,
    /// Whether the loss of the file was logged.
    gone: bool,
}

/// The result of a poll.
#[derive(Debug, PartialEq, Eq)]
enum Found {
    /// The file is unchanged, or is being written.
    Nothing,
    /// The file is missing or empty, and was so at the last poll.
    Gone,
    /// The configuration is kept for the port; its changes and the hash of the text.
    Adopted(Vec<String>, String),
    /// The text is refused; the reason and the hash of the text.
    Refused(String, String),
}

impl Poll {
    /// Polls the file, and reads it if it has changed and is written completely.
    fn take(self) -> (Polled, Found) {
        let path = self.configuration.path();
        let seen = stamp(path);
        let settled = self.before.seen == seen;
        let now = Polled {
            seen,
            ..self.before
        };
        let is_there = seen.is_some_and(|at| at.len > 0);
        if !is_there && !self.asked {
            return (now, if settled { Found::Gone } else { Found::Nothing });
        }
        let is_same = self.before.read == seen && !self.gone;
        if !self.asked && (is_same || !settled) {
            return (now, Found::Nothing);
        }
        let now = Polled { read: seen, seen };
        let text = match read_text_file(path) {
            Ok(text) => text,
            Err(error) => {
                let why = format!("cannot read {}: {error}", path.display());
                return (now, Found::Refused(why, String::new()));
            }
        };
        let hash = hash_of(&text);
        if hash == self.hash && !self.asked && !self.gone {
            return (now, Found::Nothing);
        }
        let found = match self.configuration.take(text) {
            Ok(changes) => Found::Adopted(changes, hash),
            Err(why) => Found::Refused(why, hash),
        };
        (now, found)
    }
}

fn hash_of(text: &str) -> String {
    let mut all = Sha256::new();
    all.update(text);
    shortened(all)
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[derive(Debug)]
    struct Numbers(PathBuf);

    impl ConfigurationFile for Numbers {
        fn path(&self) -> &Path {
            &self.0
        }

        fn text(&self) -> &str {
            "1"
        }

        fn take(&self, text: String) -> Result<Vec<String>, String> {
            let number: u32 = text.parse().map_err(|_| format!("`{text}` is no number"))?;
            Ok(vec![number.to_string()])
        }
    }

    /// A program with its file, for repeated polls.
    struct Follower {
        file: MappingFile,
        numbers: Arc<Numbers>,
        polled: Polled,
    }

    impl Follower {
        fn write(&self, text: &str) {
            std::fs::write(&self.numbers.0, text).unwrap();
        }

        /// Returns whether a poll has news, the numbers of adopted and refused reloads, and the
        /// reason why the file is newer.
        fn poll(&mut self, asked: bool) -> (bool, u64, u64, Option<String>) {
            let poll = Poll {
                configuration: Arc::<Numbers>::clone(&self.numbers),
                hash: self.file.hash.clone(),
                before: self.polled,
                asked,
                gone: self.file.gone,
            };
            let (polled, found) = poll.take();
            self.polled = polled;
            let has_news = self.file.adopt_found(found);
            let about = &self.file.running.about;
            (has_news, about.reloads, about.refused, about.stale.clone())
        }
    }

    #[test]
    fn a_saved_configuration_is_adopted_and_a_bad_one_keeps_the_running_one() {
        let path = std::env::temp_dir().join(format!("bridge-own-{}.yaml", std::process::id()));
        let numbers = Arc::new(Numbers(path.clone()));
        let own = Arc::<Numbers>::clone(&numbers);
        let mut follower = Follower {
            file: MappingFile::made(Mapping::default(), Some(own)),
            numbers,
            polled: Polled::default(),
        };
        follower.write("1");
        assert_eq!(follower.poll(false), (false, 0, 0, None));
        assert_eq!(follower.poll(false), (false, 0, 0, None), "the same text");

        follower.write("22");
        assert_eq!(follower.poll(false), (false, 0, 0, None), "may be written");
        let before = Arc::clone(&follower.file.running.mapping);
        assert_eq!(follower.poll(false), (true, 1, 0, None));
        assert_eq!(follower.file.running.about.changes, ["22"]);
        assert!(!Arc::ptr_eq(&before, &follower.file.running.mapping));

        follower.write("two");
        follower.poll(false);
        let why = Some("`two` is no number".to_owned());
        let before = Arc::clone(&follower.file.running.mapping);
        assert_eq!(follower.poll(false), (true, 1, 1, why.clone()));
        assert!(Arc::ptr_eq(&before, &follower.file.running.mapping));
        assert_eq!(follower.poll(false), (false, 1, 1, why.clone()));
        // SIGHUP reads an unchanged file again.
        assert_eq!(follower.poll(true), (true, 1, 2, why));

        std::fs::remove_file(&path).unwrap();
        follower.poll(false);
        let (has_news, .., stale) = follower.poll(false);
        assert!(has_news && stale.is_some_and(|why| why.ends_with("or empty")));
        follower.write("22");
        follower.poll(false);
        assert_eq!(follower.poll(false), (true, 2, 2, None));
        std::fs::remove_file(&path).unwrap();
    }
}
