//! Messages about topics that are logged once.

use std::collections::BTreeSet;

use tracing::warn;

/// The messages already logged. Bounded, because any node in a graph can cause messages.
#[derive(Debug, Default)]
pub struct LoggedMessages(BTreeSet<(String, &'static str)>);

impl LoggedMessages {
    /// Logs a message about a topic the first time it occurs; returns whether it was logged. `what`
    /// is the kind of the message.
    pub fn once(
        &mut self,
        topic: &str,
        what: &'static str,
        message: impl FnOnce() -> String,
    ) -> bool {
        if self.0.len() >= MAX_TOLD || !self.0.insert((topic.to_owned(), what)) {
            return false;
        }
        warn!(topic, "{}", message());
        if self.0.len() == MAX_TOLD {
            warn!(
                "too many different warnings about topics: further ones are not logged until the mapping is reloaded"
            );
        }
        true
    }

    /// Allows all messages to be logged again.
    pub fn clear(&mut self) {
        self.0.clear();
    }

    /// Allows messages about these topics to be logged again.
    pub fn forget(&mut self, topics: &BTreeSet<String>) {
        self.0.retain(|(topic, _)| !topics.contains(topic));
    }
}

/// The maximal number of logged messages; further messages are suppressed.
const MAX_TOLD: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_is_told_once_of_a_topic_until_it_is_forgotten() {
        let mut told = LoggedMessages::default();
        let text = String::new;
        assert!(told.once("/a", "type", text));
        assert!(!told.once("/a", "type", || panic!("it is not made in vain")));
        assert!(told.once("/a", "fields", text) && told.once("/b", "type", text));
        told.forget(&BTreeSet::from(["/a".to_owned()]));
        assert!(told.once("/a", "type", text) && !told.once("/b", "type", text));
        told.clear();
        assert!(told.once("/b", "type", text));
    }

    #[test]
    fn what_a_stranger_makes_up_ends() {
        let mut told = LoggedMessages::default();
        let topics = (0..2 * MAX_TOLD).map(|n| format!("/made_up{n}"));
        let lines = topics.filter(|topic| told.once(topic, "type", String::new));
        assert_eq!(lines.count(), MAX_TOLD);
    }
}
