//! The states of the readers.

use std::collections::HashMap;

use mappings::TopicId;

use super::states::PubSubNodeState;

/// The state of the reader of each topic, after its last message.
#[derive(Debug, Default)]
pub(crate) struct Readers {
    states: HashMap<TopicId, PubSubNodeState>,
    /// Numbers of messages that arrived while their reader was disabled.
    ignored: HashMap<TopicId, u64>,
}

impl Readers {
    /// Records that a value of a topic arrived.
    pub(crate) fn heard(&mut self, topic: TopicId) {
        self.states.insert(topic, PubSubNodeState::Operational);
    }

    /// Records that a message was dropped because its reader is disabled.
    pub(crate) fn ignored(&mut self, topic: TopicId) {
        *self.ignored.entry(topic).or_default() += 1;
    }

    /// Records that the writer of a topic is silent or active again.
    pub(crate) fn silent(&mut self, topic: TopicId, silent: bool) {
        let state = if silent {
            PubSubNodeState::Error
        } else {
            PubSubNodeState::Operational
        };
        self.states.insert(topic, state);
    }

    /// Removes these topics.
    pub(crate) fn forget(&mut self, gone: &[TopicId]) {
        for topic in gone {
            self.states.remove(topic);
            self.ignored.remove(topic);
        }
    }

    /// Returns the state of the reader of a topic, which is PreOperational until the first value.
    pub(crate) fn of(&self, topic: TopicId) -> PubSubNodeState {
        let state = self.states.get(&topic).copied();
        state.unwrap_or(PubSubNodeState::PreOperational)
    }

    /// Returns the number of topics with a received value, and how many of them are silent.
    pub(crate) fn silence(&self) -> (usize, usize) {
        let states = self.states.values();
        let silent = states
            .filter(|state| **state == PubSubNodeState::Error)
            .count();
        (self.states.len(), silent)
    }

    /// Returns the number of messages that were dropped because the reader was disabled.
    pub(super) fn count_ignored(&self, topic: TopicId) -> u64 {
        self.ignored.get(&topic).copied().unwrap_or_default()
    }
}
