//! Switches to another mapping; parts that are equal in both mappings stay unchanged.

use std::sync::Arc;

use bridge_node::policy::{Found, Read, still_made, taken_up};
use bridge_node::{PortEvent, TypePaths};
use mappings::{Mapping, TopicId};
use messages::{Selection, TypeName};

use super::Ros1Port;
use crate::services::Ros1Graph;
use crate::sink::Sink;
use crate::source::Source;

impl Ros1Port {
    /// Applies the new mapping. Everything obsolete is removed before new parts are added, because
    /// a value or topic may only have moved.
    pub(super) fn go_over_to(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) {
        let before = self.policy.replace(mapping);
        self.definitions.replace(types);
        // The new mapping may define a type that was unknown before.
        for source in &mut self.sources {
            source.forget_strangers();
        }
        let read = self.policy.read(|ros_topic| self.node.resolve(ros_topic));
        for index in 0..self.sources.len() {
            self.give_up_values(index, &read);
        }
        self.give_up_sinks();
        let mut graph = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        };
        let services = &mut self.services;
        let events = services.reload(&mut graph, self.policy.own(), (&before, mapping));
        self.events.extend(events);
        self.calls.look_again(&mut graph, &self.policy);
        self.offer_calls();
        let mut graph = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        };
        let events = self.executing.look_again(&mut graph);
        self.events.extend(events);
        let events = self.actions.look_again(&mut graph, &mut self.policy);
        self.events.extend(events);
        self.find_services();
        self.find_actions();
        self.offer_actions();
        self.events.extend(self.calls.ask_for_mapped(&self.policy));
        for (ros_topic, wanted) in read {
            self.take_up_values(ros_topic, wanted);
        }
        for topic in self.policy.written() {
            if !self.sinks.contains_key(&topic) {
                self.take_up_sink(topic);
            }
        }
        // Topics of the space that only the previous mapping named, and topics of new patterns.
        self.find_sources();
    }

    /// Removes the values that the new mapping does not make of a topic, and the topic if no values
    /// are left.
    fn give_up_values(&mut self, index: usize, read: &Read) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let named = read.get(&source.ros_topic);
        let found = || {
            let found = source.found.then(|| self.still_found(source));
            found.flatten()
        };
        let wanted = still_made(named, source.expected.as_ref(), found);
        let named = named.is_some();
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let gone = source
            .values
            .extract_if(.., |value| !wanted.contains(value));
        let gone = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        self.events.extend(gone);
        source.found &= !named;
        if source.values.is_empty() && !source.ros_topic.is_empty() {
            self.vacate(index);
        }
    }

    /// Returns the value of a topic found in the graph, if the new mapping also makes a value of
    /// it.
    fn still_found(&self, source: &Source) -> Option<(TopicId, Selection)> {
        let typed = source.bound.as_ref().map(|bound| bound.name());
        let typed = source.expected.as_ref().or(typed);
        match self.policy.found(&source.ros_topic, typed) {
            Found::Named(topic) => Some((topic, Selection::Whole)),
            Found::Made(made) => {
                (made.message_type == source.expected).then_some((made.topic, made.selection))
            }
            Found::Tied(_) | Found::Fault(_) | Found::Nothing => None,
        }
    }

    fn give_up_sinks(&mut self) {
        let (policy, definitions) = (&self.policy, &mut self.definitions);
        let gone = self.sinks.extract_if(|topic, sink| {
            // The definition may have changed when the files were read again.
            let outdated = sink.open.as_ref().is_some_and(|open| {
                let now = definitions.get(open.message_type.name());
                now.is_ok_and(|now| now.md5() != open.message_type.md5())
            });
            policy.is_for_service(*topic)
                || outdated
                || !sink.is_like(&Sink::new(policy.destination(*topic)))
        });
        // The publishers end here, so their topics can be advertised with another type.
        let gone = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        self.events.extend(gone);
    }

    /// Adds the values of a topic that the mapping subscribes to; some may exist already.
    fn take_up_values(
        &mut self,
        ros_topic: String,
        (expected, values): (TypeName, Vec<(TopicId, Selection)>),
    ) {
        let index = self.source(ros_topic, Some(expected.clone()));
        let Some(source) = self.sources.get_mut(index) else {
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
            self.events.extend(taken_up(
                (topic, selection),
                message_type,
                source.is_live(),
                source.latched(),
                bridge_node::now().utc,
            ));
        }
        if let Err(error) = self.subscribe(index) {
            let ros_topic = self.sources.get(index).map(|s| s.ros_topic.clone());
            self.policy
                .told
                .once(&ros_topic.unwrap_or_default(), "not subscribed", || {
                    error.to_string()
                });
        }
    }
}
