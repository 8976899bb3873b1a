//! Values of other spaces that neither the mapping names nor a subscriber wants: they are written while there is room.

use std::collections::BTreeSet;
use std::time::Instant;

use bridge_node::{PortEvent, Reason, now};
use mappings::TopicId;

use super::writing::unwritten;
use super::{MAX_TOPICS, Ros2Port};
use crate::sink::Sink;

impl Ros2Port {
    /// Has a topic for the value; false where there is no room for one that nobody here knows.
    pub(super) fn take_in(&mut self, topic: TopicId) -> bool {
        if self.sinks.contains_key(&topic) {
            return true;
        }
        let sink = Sink::by_name(topic, self.mapping.variable(topic));
        if self.is_stray(topic, &sink) && !self.take_place() {
            self.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "values that the mapping does not name and nobody subscribes to",
                count: 1,
            });
            return false;
        }
        self.sinks.insert(topic, Box::new(sink));
        true
    }

    fn is_stray(&self, topic: TopicId, sink: &Sink) -> bool {
        self.mapping.variable(topic).is_none() && self.graph.readers(&sink.dds_topic).is_empty()
    }

    fn take_place(&mut self) -> bool {
        let now = now().monotonic;
        if self.room.wants_look(now) {
            let there = self.let_strays_go();
            self.room.looked(there, now);
        }
        self.room.take()
    }

    /// Gives up topics of writers that fell silent, those first that are silent longest; says how many strays there are then.
    fn let_strays_go(&mut self) -> usize {
        let strays = self
            .sinks
            .iter()
            .filter(|(topic, sink)| self.is_stray(**topic, sink));
        let strays: Vec<(Option<Instant>, TopicId)> =
            strays.map(|(topic, sink)| (sink.silent, *topic)).collect();
        let silent = strays.iter();
        let mut silent: Vec<(Instant, TopicId)> = silent
            .filter_map(|(since, topic)| since.map(|since| (since, *topic)))
            .collect();
        silent.sort_unstable();
        silent.truncate(MOST_LET_GO);
        let mut names = BTreeSet::new();
        for (_, topic) in &silent {
            if let Some(sink) = self.sinks.remove(topic) {
                // Nobody reads what it wrote.
                let unwritten = sink.open.as_ref().and_then(|open| unwritten(*topic, open));
                self.events.extend(unwritten);
                names.insert(topic.to_string());
                names.insert(sink.dds_topic);
            }
            self.events.push_back(PortEvent::Unbound { topic: *topic });
        }
        // Should they return, what is peculiar is told anew.
        self.told.retain(|(topic, _)| !names.contains(topic));
        strays.len() - silent.len()
    }
}

/// How many are given up at a time: RustDDS takes commands from a bounded queue, and drops what does not fit.
const MOST_LET_GO: usize = MAX_TOPICS / 32;
