//! Going over to another mapping: what both say alike is left as it is.

use std::collections::BTreeMap;
use std::sync::Arc;

use bridge_node::{PortEvent, TypePaths};
use mappings::{Mapping, TopicId, Variable};
use messages::{Selection, TypeName};
use tracing::warn;

use super::Ros1Port;
use crate::services::Ros1Graph;
use crate::sink::Sink;
use crate::source::Source;

/// The topics the mapping reads: the type each is to have, and the values made of it.
type Read = BTreeMap<String, (TypeName, Vec<(TopicId, Selection)>)>;

impl Ros1Port {
    /// Everything is given up before anything is taken up, as a value or a topic may only have changed hands.
    pub(super) fn go_over_to(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) {
        let before = std::mem::replace(&mut self.mapping, Arc::clone(mapping));
        // What is peculiar under the new mapping is told anew.
        self.told.clear();
        self.definitions.replace(types);
        // A type that nobody knew may be known now.
        for source in &mut self.sources {
            source.forget_strangers();
        }
        let read = self.read(mapping);
        for index in 0..self.sources.len() {
            self.give_up_values(index, &read);
        }
        self.give_up_sinks();
        let mut graph = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
        };
        let services = &mut self.services;
        let events = services.reload(&mut graph, self.own, (&before, mapping));
        self.events.extend(events);
        for (ros_topic, wanted) in read {
            self.take_up_values(ros_topic, wanted);
        }
        self.take_up_sinks(mapping);
        // Topics of the space that the mapping no longer names, and those of new patterns.
        self.find_sources();
    }

    fn read(&self, mapping: &Mapping) -> Read {
        let mut read = Read::new();
        for (variable, binding) in mapping.bindings(self.own) {
            if variable.topic.space != self.own {
                continue;
            }
            match self.node.resolve(&binding.ros_topic) {
                Ok(ros_topic) => {
                    let (_, values) = read
                        .entry(ros_topic)
                        .or_insert_with(|| (binding.message_type.clone(), Vec::new()));
                    values.push((variable.topic, binding.selection.clone()));
                }
                Err(error) => warn!(topic = %variable.topic, "the value cannot be read: {error}"),
            }
        }
        read
    }

    /// Lets go of the values of a topic that are no longer made of it, and of the topic where none is left.
    fn give_up_values(&mut self, index: usize, read: &Read) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        let wanted = match read.get(&source.ros_topic) {
            // Another type: everything of it is different.
            Some((expected, _)) if source.expected.as_ref() != Some(expected) => Vec::new(),
            Some((_, values)) => values.clone(),
            None if source.found => self.still_found(source),
            None => Vec::new(),
        };
        let named = read.contains_key(&source.ros_topic);
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

    /// The value of a topic that was found in the graph, if it is one by the new mapping as well.
    fn still_found(&self, source: &Source) -> Vec<(TopicId, Selection)> {
        let name = source.ros_topic.strip_prefix('/').unwrap_or_default();
        let found = match name.parse::<TopicId>() {
            Ok(topic) => {
                let variable = self.mapping.variable(topic);
                let bound =
                    variable.is_some_and(|v| v.binding(self.own).is_some() || v.service.is_some());
                (!bound).then_some((topic, Selection::Whole))
            }
            Err(_) => {
                let typed = source.bound.as_ref().map(|bound| bound.name());
                let typed = source.expected.as_ref().or(typed);
                let made = self.mapping.matching(self.own, &source.ros_topic, typed);
                made.and_then(Result::ok)
                    .filter(|made| made.message_type == source.expected)
                    .map(|made| (made.topic, made.selection))
            }
        };
        found.into_iter().collect()
    }

    fn give_up_sinks(&mut self) {
        let (mapping, own, definitions) = (&self.mapping, self.own, &mut self.definitions);
        let gone = self.sinks.extract_if(|topic, sink| {
            // Its definition may be another since the files were read again.
            let outdated = sink.open.as_ref().is_some_and(|open| {
                let now = definitions.get(open.message_type.name());
                now.is_ok_and(|now| now.md5() != open.message_type.md5())
            });
            let variable = mapping.variable(*topic);
            let tied = variable.and_then(|variable| mapped(variable, own));
            let called = variable
                .and_then(|variable| variable.service.as_ref())
                .is_some_and(|service| service.space == own);
            // Values for a service have no topic.
            called
                || outdated
                || !sink.is_like(&tied.unwrap_or_else(|| Sink::by_name(*topic, variable)))
        });
        // Their publishers end here, so that their topics may be advertised in another type.
        let gone = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        self.events.extend(gone);
    }

    fn take_up_sinks(&mut self, mapping: &Mapping) {
        for variable in mapping.variables() {
            let topic = variable.topic;
            if topic.space != self.own
                && !self.sinks.contains_key(&topic)
                && let Some(sink) = mapped(variable, self.own)
            {
                self.sinks.insert(topic, sink);
                self.open_sink(topic);
            }
        }
    }

    /// Makes values of a topic that the mapping reads, of which some may be made already.
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
            self.events.push_back(PortEvent::Bound {
                topic,
                message_type: Arc::clone(message_type),
                selection,
            });
            if source.is_live() {
                self.events.push_back(PortEvent::Live { topic, live: true });
            }
            // They were sent before and will not be again.
            let received = bridge_node::now().utc;
            let latched = source.latched().map(|(key, message)| PortEvent::Sample {
                topic,
                payload: message.clone(),
                received,
                latched_by: Some(key),
            });
            self.events.extend(latched);
        }
        if let Err(error) = self.subscribe(index) {
            let ros_topic = self.sources.get(index).map(|s| s.ros_topic.clone());
            self.tell_once(&ros_topic.unwrap_or_default(), "not subscribed", || {
                error.to_string()
            });
        }
    }
}

/// Where the values of a variable of another space are written, if the mapping says it.
fn mapped(variable: &Variable, own: mappings::SpaceId) -> Option<Sink> {
    let binding = variable.binding(own)?;
    Some(Sink::mapped(
        binding.ros_topic.clone(),
        binding.message_type.clone(),
        binding.selection.clone(),
        variable.overflow,
    ))
}
