//! The Programs with an unknown outcome of their last goal. They are stored in a file, so that they
//! need a Reset after a restart of the server too.

use std::collections::BTreeSet;
use std::io;
use std::path::PathBuf;

use mappings::TopicId;
use opcua::sync::Mutex;
use plant_opcua::synced::replace;
use tracing::warn;

/// The calls that send the goals of these Programs. The file has a line for each call.
pub(crate) struct UnknownOutcomes {
    file: PathBuf,
    goals: Mutex<BTreeSet<TopicId>>,
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
                    warn!(%file, %error, "cannot read the Programs that need a Reset: all are Ready");
                }
                BTreeSet::new()
            }
        };
        Self {
            file,
            goals: Mutex::new(goals),
        }
    }

    /// Returns true if the Program of a goal needs a Reset.
    pub(crate) fn has(&self, goal: TopicId) -> bool {
        self.goals.lock().contains(&goal)
    }

    pub(crate) fn insert(&self, goal: TopicId) {
        let mut goals = self.goals.lock();
        if goals.len() < MOST && goals.insert(goal) {
            self.write(&goals);
        }
    }

    pub(crate) fn remove(&self, goal: TopicId) {
        let mut goals = self.goals.lock();
        if goals.remove(&goal) {
            self.write(&goals);
        }
    }

    fn write(&self, goals: &BTreeSet<TopicId>) {
        let text: String = goals.iter().map(|goal| format!("{goal}\n")).collect();
        if let Err(error) = replace(&self.file, text.as_bytes()) {
            let file = self.file.display();
            warn!(%file, %error, "cannot keep the Programs that need a Reset: a restart forgets them");
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
}
