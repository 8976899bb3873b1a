//! How the readers are, as the program notices it.

use std::collections::HashMap;

use mappings::TopicId;

use super::states::State;

/// What became of what was heard last of each topic.
#[derive(Debug, Default)]
pub(crate) struct Readers {
    states: HashMap<TopicId, State>,
    /// Messages that came while a reader was disabled.
    ignored: HashMap<TopicId, u64>,
}

impl Readers {
    /// A value of a topic came.
    pub(crate) fn heard(&mut self, topic: TopicId) {
        self.states.insert(topic, State::Operational);
    }

    /// It was not taken, for its reader is disabled.
    pub(crate) fn ignored(&mut self, topic: TopicId) {
        *self.ignored.entry(topic).or_default() += 1;
    }

    /// The writer of a topic is silent, or speaks again.
    pub(crate) fn silent(&mut self, topic: TopicId, silent: bool) {
        let state = if silent {
            State::Error
        } else {
            State::Operational
        };
        self.states.insert(topic, state);
    }

    /// Knows nothing of these topics any longer.
    pub(crate) fn forget(&mut self, gone: &[TopicId]) {
        for topic in gone {
            self.states.remove(topic);
            self.ignored.remove(topic);
        }
    }

    /// How the reader of a topic is: it waits for its first value at first.
    pub(crate) fn of(&self, topic: TopicId) -> State {
        let state = self.states.get(&topic).copied();
        state.unwrap_or(State::PreOperational)
    }

    /// How many messages were not taken for that reason.
    pub(super) fn count_ignored(&self, topic: TopicId) -> u64 {
        self.ignored.get(&topic).copied().unwrap_or_default()
    }
}
