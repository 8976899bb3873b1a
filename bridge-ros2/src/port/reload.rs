//! Going over to another mapping: what both say alike is left as it is.

use std::collections::BTreeMap;
use std::sync::Arc;

use bridge_node::{PortEvent, TypePaths, now};
use mappings::{Mapping, SpaceId, TopicId, Variable};
use messages::{Selection, TypeName};
use tokio::time::Instant;

use super::Ros2Port;
use super::services::Ros2Graph;
use super::writing::unwritten;
use crate::graph::{dds_topic, ros_topic};
use crate::sink::Sink;
use crate::source::{Reading, Source};

/// The topics the mapping reads: the type of each, and the values made of it.
type Read = BTreeMap<String, (TypeName, Vec<(TopicId, Selection)>)>;

impl Ros2Port {
    /// Everything is given up before anything is taken up, as a value or a topic may only have changed hands. Endpoints
    /// are made with the next look at the domain.
    pub(super) fn go_over_to(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) {
        let before = std::mem::replace(&mut self.mapping, Arc::clone(mapping));
        // What is peculiar under the new mapping is told anew.
        self.told.clear();
        self.definitions.replace(types);
        let mut read = Read::new();
        for (variable, binding) in mapping.bindings(self.own) {
            if variable.topic.space == self.own {
                let (_, values) = read
                    .entry(dds_topic(&binding.ros_topic))
                    .or_insert_with(|| (binding.message_type.clone(), Vec::new()));
                values.push((variable.topic, binding.selection.clone()));
            }
        }
        for index in 0..self.sources.len() {
            self.give_up_values(index, &read);
        }
        self.give_up_sinks();
        let mut graph = Ros2Graph {
            peers: &self.peers,
            domain: &self.domain,
            definitions: &mut self.definitions,
        };
        let services = &mut self.services;
        let events = services.reload(&mut graph, self.own, (&before, mapping));
        self.events.extend(events);
        for (topic, (message_type, values)) in read {
            self.take_up_values(topic, message_type, values);
        }
        for variable in mapping.variables() {
            let topic = variable.topic;
            if topic.space != self.own
                && !self.sinks.contains_key(&topic)
                && let Some(sink) = mapped(variable, self.own)
            {
                self.sinks.insert(topic, Box::new(sink));
            }
        }
        for index in 0..self.sources.len() {
            self.take_up_found(index);
        }
        self.schedule.changed = true;
    }

    /// Lets go of the values of a topic that are no longer made of it; and of the topic, where it is read as another type.
    fn give_up_values(&mut self, index: usize, read: &Read) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        // Its definition may be another since the files were read again.
        let outdated = source
            .definition
            .as_ref()
            .is_some_and(|it| !self.definitions.is_current(it, source.announced));
        let (dds_topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
        let found = self.found_value(&dds_topic, &message_type);
        let is_wanted = |value: &(TopicId, Selection)| match read.get(&dds_topic) {
            _ if outdated => false,
            Some((of, values)) => message_type == *of && values.contains(value),
            None => found.as_ref() == Some(value),
        };
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let gone = source.values.extract_if(.., |value| !is_wanted(value));
        let gone: Vec<_> = gone.map(|(topic, _)| topic).collect();
        let unbound = gone.into_iter().map(|topic| PortEvent::Unbound { topic });
        self.events.extend(unbound);
        let read_alike = read
            .get(&dds_topic)
            .is_none_or(|(of, _)| message_type == *of);
        if source.values.is_empty() && (outdated || !read_alike) {
            self.give_up_source(index);
        }
    }

    fn give_up_source(&mut self, index: usize) {
        if let Some(source) = self.sources.get_mut(index) {
            if let Reading::Open { slot, .. } = source.reading {
                // Whoever published to it sees the reader disposed.
                drop(self.inbox.remove(slot));
            }
            // Its index stays, by which the inbox names it; its name is free for another.
            let (topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
            **source = Source::new(topic.clone(), message_type);
            if self.source_of.get(&topic) == Some(&index) {
                self.source_of.remove(&topic);
            }
        }
    }

    /// The value that a topic is which was found, in that type: of the space, and the mapping does not tie it to another; or
    /// by a pattern.
    fn found_value(
        &self,
        dds_topic: &str,
        message_type: &TypeName,
    ) -> Option<(TopicId, Selection)> {
        let name = ros_topic(dds_topic)?;
        if let Ok(topic) = name.parse::<TopicId>() {
            return (topic.space == self.own && !self.is_tied(topic))
                .then_some((topic, Selection::Whole));
        }
        let made = self.made_of(name, &message_type.dds())?.ok()?;
        Some((made.topic, made.selection))
    }

    /// Makes the value of a topic that the mapping does not name, where all it had were given up: while it is read alike its
    /// reader goes on. Lets go of the topic where there is no such value.
    fn take_up_found(&mut self, index: usize) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        if !source.values.is_empty() || self.source_of.get(&source.dds_topic) != Some(&index) {
            return;
        }
        let (dds_topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
        // Others who write where values of other spaces go are not a value of ours.
        let is_written = self.sinks.values().any(|sink| sink.dds_topic == dds_topic);
        let found = self.found_value(&dds_topic, &message_type);
        let found = found.filter(|(topic, _)| {
            let mut made = self.sources.iter().flat_map(|source| &source.values);
            !is_written && made.all(|(other, _)| other != topic)
        });
        match found {
            Some(value) => self.take_up_values(dds_topic, message_type, vec![value]),
            None => self.give_up_source(index),
        }
    }

    fn give_up_sinks(&mut self) {
        let (mapping, own, definitions) = (&self.mapping, self.own, &mut self.definitions);
        let gone = self.sinks.extract_if(|topic, sink| {
            let outdated = sink.open.as_ref().is_some_and(|open| {
                !definitions.is_current(&open.definition, open.definition.hash)
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
        // Their writers are disposed here, or when their readers have what was written.
        let now = Instant::now();
        for (topic, sink) in gone {
            if let Some(open) = sink.open {
                self.events.extend(unwritten(topic, &open));
                self.former.extend(open.outlet.give_up(now));
            }
            self.events.push_back(PortEvent::Unbound { topic });
        }
        let too_many = self.former.len().saturating_sub(MOST_FORMER);
        drop(self.former.drain(..too_many));
    }

    /// Makes values of a topic that the mapping reads, of which some may be made already.
    fn take_up_values(
        &mut self,
        dds_topic: String,
        message_type: TypeName,
        values: Vec<(TopicId, Selection)>,
    ) {
        let index = self.source(dds_topic, message_type);
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let known: Vec<TopicId> = source.values.iter().map(|(topic, _)| *topic).collect();
        let new: Vec<_> = values
            .into_iter()
            .filter(|(topic, _)| !known.contains(topic))
            .collect();
        source.values.extend(new.iter().cloned());
        // One that is not read yet tells of all its values when it is.
        let Reading::Open { .. } = source.reading else {
            return;
        };
        let Some(message_type) = source
            .definition
            .as_ref()
            .map(|d| Arc::clone(&d.message_type))
        else {
            return;
        };
        let received = now().utc;
        for (topic, selection) in new {
            self.events.push_back(PortEvent::Bound {
                topic,
                message_type: Arc::clone(&message_type),
                selection,
            });
            if source.live {
                self.events.push_back(PortEvent::Live { topic, live: true });
            }
            // They were sent before and will not be again.
            let latched = source.latched().map(|(key, payload)| PortEvent::Sample {
                topic,
                payload: payload.clone(),
                received,
                latched_by: Some(key),
            });
            self.events.extend(latched);
        }
    }
}

/// Where the values of a variable of another space are written, if the mapping says it.
fn mapped(variable: &Variable, own: SpaceId) -> Option<Sink> {
    let binding = variable.binding(own)?;
    Some(Sink::mapped(
        &binding.ros_topic,
        binding.message_type.clone(),
        binding.selection.clone(),
        variable.overflow,
    ))
}

/// Writers that were given up and stay for a while.
const MOST_FORMER: usize = 256;
