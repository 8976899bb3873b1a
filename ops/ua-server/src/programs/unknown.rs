//! The Programs with an open goal, or with an unknown outcome of their last goal. They are stored
//! in a file, so that they need a Reset after a restart of the server, and also if the server was
//! killed during the goal.

use std::collections::BTreeSet;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use mappings::TopicId;
use opcua::sync::Mutex;
use plant_opcua::synced::replace;
use tracing::warn;

/// The calls that send the goals of these Programs. The file has a line for each call.
pub(crate) struct UnknownOutcomes {
    file: PathBuf,
    goals: Mutex<BTreeSet<TopicId>>,
    /// Serializes the writes of the file.
    writing: Mutex<()>,
}

impl UnknownOutcomes {
    /// Reads the file. A file that cannot be read counts as empty, with a warning.
    pub(crate) fn open(file: PathBuf) -> Self {
        let goals = match std::fs::read_to_string(&file) {
            Ok(text) => {
                let goals = text.lines().filter_map(|line| line.parse().ok());
                goals.take(MOST).collect()
            }
            Err(error) => {
                if error.kind() != io::ErrorKind::NotFound {
                    let file = file.display();
                    warn!(%file, %error, "cannot read the list of Programs that need a Reset: all Programs start as Ready, so check the machine");
                }
                BTreeSet::new()
            }
        };
        Self {
            file,
            goals: Mutex::new(goals),
            writing: Mutex::new(()),
        }
    }

    /// Returns true if the Program of a goal needs a Reset after a restart.
    pub(crate) fn has(&self, goal: TopicId) -> bool {
        self.goals.lock().contains(&goal)
    }

    pub(crate) fn insert(&self, goal: TopicId) {
        if self.add(goal) {
            self.write();
        }
    }

    pub(crate) fn remove(&self, goal: TopicId) {
        if self.goals.lock().remove(&goal) {
            self.write();
        }
    }

    /// Stores that a goal is about to be sent. Returns when the file is written.
    pub(crate) async fn begin(self: &Arc<Self>, goal: TopicId) {
        if self.add(goal) {
            let outcomes = Arc::clone(self);
            // The write is synced, which takes long on some disks.
            let written = tokio::task::spawn_blocking(move || outcomes.write());
            let _is_over = written.await.is_err();
        }
    }

    /// Removes a goal with a known end. The file is written later.
    pub(crate) fn end(self: &Arc<Self>, goal: TopicId) {
        if self.goals.lock().remove(&goal) {
            let outcomes = Arc::clone(self);
            drop(tokio::task::spawn_blocking(move || outcomes.write()));
        }
    }

    /// Returns true if the goal is new.
    fn add(&self, goal: TopicId) -> bool {
        let mut goals = self.goals.lock();
        goals.len() < MOST && goals.insert(goal)
    }

    /// Writes the goals as they are now, so that the last write has all changes.
    fn write(&self) {
        let _turn = self.writing.lock();
        let goals = self.goals.lock().clone();
        let text: String = goals.iter().map(|goal| format!("{goal}\n")).collect();
        if let Err(error) = replace(&self.file, text.as_bytes()) {
            let file = self.file.display();
            warn!(%file, %error, "cannot store the list of Programs that need a Reset: they will be Ready after a restart");
        }
    }
}

/// Largest number of Programs. The limit exists because every participant of the space can announce
/// Programs.
const MOST: usize = 3 * 256;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_goal_with_an_unknown_outcome_is_known_after_a_restart_until_the_reset() {
        let name = format!("ua-server-unknown-{}", std::process::id());
        let file = std::env::temp_dir().join(name);
        drop(std::fs::remove_file(&file));
        let goal: TopicId = "ua_2_2_70".parse().unwrap();
        let other: TopicId = "ua_2_2_80".parse().unwrap();
        let outcomes = UnknownOutcomes::open(file.clone());
        assert!(!outcomes.has(goal));
        outcomes.insert(goal);
        outcomes.insert(other);

        let restarted = UnknownOutcomes::open(file.clone());
        assert!(restarted.has(goal) && restarted.has(other));
        restarted.remove(goal);

        let restarted = UnknownOutcomes::open(file.clone());
        assert!(!restarted.has(goal) && restarted.has(other));
        std::fs::remove_file(file).unwrap();
    }

    #[tokio::test]
    async fn a_goal_is_in_the_file_before_it_is_sent_and_until_its_end() {
        let name = format!("ua-server-open-{}", std::process::id());
        let file = std::env::temp_dir().join(name);
        drop(std::fs::remove_file(&file));
        let goal: TopicId = "ua_2_2_70".parse().unwrap();
        let outcomes = Arc::new(UnknownOutcomes::open(file.clone()));
        outcomes.begin(goal).await;
        assert!(UnknownOutcomes::open(file.clone()).has(goal));
        outcomes.end(goal);
        assert!(!outcomes.has(goal));
        // The next write is after that of the end.
        let other: TopicId = "ua_2_2_80".parse().unwrap();
        outcomes.begin(other).await;
        let restarted = UnknownOutcomes::open(file.clone());
        assert!(!restarted.has(goal) && restarted.has(other));
        std::fs::remove_file(file).unwrap();
    }
}
