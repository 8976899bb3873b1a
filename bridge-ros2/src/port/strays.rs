//! Values of other spaces that neither the mapping names nor a subscriber wants: they are written while there is room.

use std::collections::BTreeSet;

use bridge_node::policy::{Admission, Policy};
use bridge_node::{PortEvent, Reason, now};
use mappings::TopicId;

use super::Ros2Port;
use super::writing::unwritten;
use crate::graph::Graph;
use crate::sink::Sink;

impl Ros2Port {
    /// Has a topic for the value; false where there is no room for one that nobody here knows.
    pub(super) fn take_in(&mut self, topic: TopicId) -> bool {
        if self.sinks.contains_key(&topic) {
            return true;
        }
        let sink = Sink::new(self.policy.destination(topic));
        let subscribed = is_subscribed(&sink, &self.graph);
        let is_stray = self.policy.is_stray(topic, subscribed);
        if is_stray && !self.has_descriptors() {
            self.tell_scarce();
            self.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "values that there are no file descriptors for",
                count: 1,
            });
            return false;
        }
        if is_stray && !self.take_place() {
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

    /// Returns whether the process has descriptors for another writer of a value that the mapping does not name.
    fn has_descriptors(&self) -> bool {
        let sinks = self.sinks.values();
        let pending = sinks.filter(|sink| sink.open.is_none()).count();
        pending < self.descriptors.free().found
    }

    fn take_place(&mut self) -> bool {
        let (sinks, graph) = (&self.sinks, &self.graph);
        let strays = |policy: &Policy| {
            let strays = sinks
                .iter()
                .filter(|(topic, sink)| policy.is_stray(**topic, is_subscribed(sink, graph)));
            let strays = strays.map(|(topic, sink)| (sink.silent, *topic));
            strays.collect::<Vec<_>>()
        };
        let now = now().monotonic;
        let Admission { admitted, gone } = self.policy.admit_stray(now, strays);
        let mut names = BTreeSet::new();
        for topic in gone {
            if let Some(sink) = self.sinks.remove(&topic) {
                // Nobody reads what it wrote.
                let unwritten = sink.open.as_ref().and_then(|open| unwritten(topic, open));
                self.events.extend(unwritten);
                names.extend([topic.to_string(), sink.dds_topic]);
            }
            self.events.push_back(PortEvent::Unbound { topic });
        }
        // Should they return, what is peculiar is told anew.
        self.policy.told.forget(&names);
        admitted
    }
}

fn is_subscribed(sink: &Sink, graph: &Graph) -> bool {
    !graph.readers(&sink.dds_topic).is_empty()
}
