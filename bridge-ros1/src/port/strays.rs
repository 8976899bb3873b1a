//! Values of other spaces that are neither in the mapping nor subscribed; they are published up to
//! a limit.

use std::collections::BTreeSet;

use bridge_node::policy::{Admission, Policy};
use bridge_node::{PortEvent, Reason, now};
use mappings::TopicId;
use tcpros::Graph;

use super::Ros1Port;
use crate::sink::Sink;

impl Ros1Port {
    /// Ensures that the value has a topic. Returns false if the value is unknown here and the limit
    /// is reached.
    pub(super) fn take_in(&mut self, topic: TopicId) -> bool {
        if self.sinks.contains_key(&topic) {
            return true;
        }
        let sink = Sink::new(self.policy.destination(topic));
        if self
            .policy
            .is_stray(topic, is_subscribed(&sink, &self.graph))
            && !self.take_place()
        {
            self.events.push_back(PortEvent::Dropped {
                reason: Reason::TooManyTopics,
                why: "values without an entry in the mapping and without a subscriber",
                count: 1,
            });
            return false;
        }
        self.sinks.insert(topic, sink);
        true
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
                names.extend([topic.to_string(), sink.ros_topic]);
            }
            self.events.push_back(PortEvent::Unbound { topic });
        }
        // If these values return, their problems are logged again.
        self.policy.told.forget(&names);
        admitted
    }
}

fn is_subscribed(sink: &Sink, graph: &Graph) -> bool {
    let open = sink.open.as_ref();
    open.is_some_and(|open| open.publisher.subscribers() > 0)
        || graph.subscribers.contains_key(&sink.ros_topic)
}
