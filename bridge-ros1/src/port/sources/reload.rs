//! Switches the subscribed topics to another mapping.

use bridge_node::PortEvent;
use bridge_node::policy::{Policy, Read, TopicMeaning, still_made, taken_up};
use mappings::TopicId;
use messages::{Selection, TypeName};

use super::super::side::Ros1Side;
use super::SubscribedTopics;
use crate::source::Ros1Source;

impl SubscribedTopics {
    /// Removes the values that the new mapping does not make of their topics.
    pub(in crate::port) fn give_up(&mut self, side: &mut Ros1Side, read: &Read) {
        for source in &mut self.list {
            // The new mapping may define a type that was unknown before.
            source.forget_strangers();
        }
        for index in 0..self.list.len() {
            self.give_up_values(side, index, read);
        }
    }

    /// Adds the topics and values of the new mapping; some may exist already.
    pub(in crate::port) fn take_up_all(&mut self, side: &mut Ros1Side, read: Read) {
        for (ros_topic, wanted) in read {
            self.take_up_values(side, ros_topic, wanted);
        }
    }

    /// Removes the values that the new mapping does not make of a topic, and the topic if no values
    /// are left.
    fn give_up_values(&mut self, side: &mut Ros1Side, index: usize, read: &Read) {
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        let named = read.get(&source.ros_topic);
        let found = || {
            let found = source.found.then(|| still_found(&side.policy, source));
            found.flatten()
        };
        let wanted = still_made(named, source.expected.as_ref(), found);
        let named = named.is_some();
        let gone = source
            .values
            .extract_if(.., |value| !wanted.contains(value));
        let gone = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        side.events.extend(gone);
        source.found &= !named;
        if source.values.is_empty() && !source.ros_topic.is_empty() {
            self.vacate(side, index);
        }
    }

    /// Adds the values of a topic that the mapping subscribes to; some may exist already.
    fn take_up_values(
        &mut self,
        side: &mut Ros1Side,
        ros_topic: String,
        (expected, values): (TypeName, Vec<(TopicId, Selection)>),
    ) {
        let index = self.source(ros_topic, Some(expected.clone()));
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        source.expected = Some(expected);
        for (topic, selection) in values {
            if source.values.iter().any(|(known, _)| *known == topic) {
                continue;
            }
            source.values.push((topic, selection.clone()));
            let Some(message_type) = &source.bound else {
                continue;
            };
            side.events.extend(taken_up(
                (topic, selection),
                message_type,
                source.is_live(),
                source.latched(),
                bridge_node::now().utc,
            ));
        }
        if let Err(error) = self.subscribe(side, index) {
            let ros_topic = self.list.get(index).map(|s| s.ros_topic.clone());
            side.policy
                .told
                .once(&ros_topic.unwrap_or_default(), "not subscribed", || {
                    error.to_string()
                });
        }
    }
}

/// Returns the value of a topic found in the graph, if the new mapping also makes a value of
/// it.
fn still_found(policy: &Policy, source: &Ros1Source) -> Option<(TopicId, Selection)> {
    let typed = source.bound.as_ref().map(|bound| bound.name());
    let typed = source.expected.as_ref().or(typed);
    match policy.found(&source.ros_topic, typed) {
        TopicMeaning::Named(topic) => Some((topic, Selection::Whole)),
        TopicMeaning::Made(made) => {
            (made.message_type == source.expected).then_some((made.topic, made.selection))
        }
        TopicMeaning::Tied(_) | TopicMeaning::Fault(_) | TopicMeaning::Nothing => None,
    }
}
