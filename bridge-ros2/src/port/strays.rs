//! Handles values of other spaces that neither the mapping names nor a subscriber requests: they
//! are written while there is room.

use std::collections::{BTreeSet, HashMap};
use std::time::Instant;

use bridge_node::policy::{Admission, Policy, longest_silent};
use bridge_node::{PortEvent, Reason, now};
use mappings::TopicId;
use ros2_node::graph::Graph;

use super::Ros2Port;
use super::writing::unwritten;
use crate::sink::Sink;

impl Ros2Port {
    /// Creates a sink for the value; returns false if there is no room for a value without a
    /// mapping and subscriber.
    pub(super) fn take_in(&mut self, topic: TopicId) -> bool {
        if self.sinks.contains_key(&topic) {
            return true;
        }
        let sink = Sink::new(self.policy.destination(topic));
        let subscribed = is_subscribed(&sink, &self.graph);
        let is_stray = self.policy.is_stray(topic, subscribed);
        if is_stray && !self.has_descriptors() {
            let (sinks, graph) = (&self.sinks, &self.graph);
            let silent = longest_silent(strays(&self.policy, sinks, graph));
            self.let_go(silent);
        }
        if is_stray && !self.has_descriptors() {
            self.tell_scarce();
            self.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "not enough file descriptors for the value",
                count: 1,
            });
            return false;
        }
        if is_stray && !self.take_place() {
            self.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "values without an entry in the mapping and without a subscriber",
                count: 1,
            });
            return false;
        }
        self.sinks.insert(topic, Box::new(sink));
        true
    }

    /// Returns whether the process has file descriptors for another writer of a value that the
    /// mapping does not name.
    fn has_descriptors(&self) -> bool {
        let sinks = self.sinks.values();
        let pending = sinks.filter(|sink| sink.open.is_none()).count();
        pending < self.descriptors.free().found
    }

    fn take_place(&mut self) -> bool {
        let (sinks, graph) = (&self.sinks, &self.graph);
        let strays = |policy: &Policy| strays(policy, sinks, graph);
        let now = now().monotonic;
        let Admission { admitted, gone } = self.policy.admit_stray(now, strays);
        self.let_go(gone);
        admitted
    }

    /// Closes the writers of strays that are replaced.
    fn let_go(&mut self, gone: Vec<TopicId>) {
        let mut names = BTreeSet::new();
        for topic in gone {
            if let Some(sink) = self.sinks.remove(&topic) {
                // No reader receives their values.
                let unwritten = sink.open.as_ref().and_then(|open| unwritten(topic, open));
                self.events.extend(unwritten);
                names.extend([topic.to_string(), sink.dds_topic]);
            }
            self.events.push_back(PortEvent::Unbound { topic });
        }
        // If the values return, their anomalies are logged again.
        self.policy.told.forget(&names);
    }
}

/// Returns the values that neither the mapping names nor a reader subscribes to, each with the time
/// at which its publisher in the space fell silent.
fn strays(
    policy: &Policy,
    sinks: &HashMap<TopicId, Box<Sink>>,
    graph: &Graph,
) -> Vec<(Option<Instant>, TopicId)> {
    let strays = sinks.iter();
    let strays = strays.filter(|(topic, sink)| {
        let subscribed = is_subscribed(sink, graph);
        policy.is_stray(**topic, subscribed)
    });
    let strays = strays.map(|(topic, sink)| (sink.silent, *topic));
    strays.collect()
}

fn is_subscribed(sink: &Sink, graph: &Graph) -> bool {
    !graph.readers(&sink.dds_topic).is_empty()
}
