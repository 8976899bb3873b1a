//! Going over to another mapping: what both say alike is left as it is.

use std::sync::Arc;

use bridge_node::policy::{Found, Read, still_made, taken_up};
use bridge_node::{PortEvent, TypePaths, now};
use mappings::{Mapping, TopicId};
use messages::{Selection, TypeName};
use tokio::time::Instant;

use super::Ros2Port;
use super::services::Ros2Graph;
use super::writing::unwritten;
use crate::sink::Sink;
use crate::source::{Reading, Source};

impl Ros2Port {
    /// Everything is given up before anything is taken up, as a value or a topic may only have changed hands. Endpoints
    /// are made with the next look at the domain.
    pub(super) fn go_over_to(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) {
        let before = self.policy.replace(mapping);
        self.definitions.replace(types);
        let read = self.read();
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
        let events = services.reload(&mut graph, self.policy.own(), (&before, mapping));
        self.events.extend(events);
        self.calls.look_again(&mut graph, &self.policy);
        let events = self.executing.look_again(&mut graph);
        self.events.extend(events);
        let events = self.actions.look_again(&mut graph, &mut self.policy);
        self.events.extend(events);
        self.events.extend(self.calls.ask_for_mapped(&self.policy));
        for (topic, (message_type, values)) in read {
            self.take_up_values(topic, message_type, values);
        }
        self.take_up_sinks();
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
        let wanted = match outdated {
            true => Vec::new(),
            false => still_made(read.get(&dds_topic), Some(&message_type), || {
                self.found_value(&dds_topic, &message_type)
            }),
        };
        let Some(source) = self.sources.get_mut(index) else {
            return;
        };
        let gone = source
            .values
            .extract_if(.., |value| !wanted.contains(value));
        let unbound = gone.map(|(topic, _)| PortEvent::Unbound { topic });
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

    /// The value that a topic is which was found, in that type.
    fn found_value(
        &self,
        dds_topic: &str,
        message_type: &TypeName,
    ) -> Option<(TopicId, Selection)> {
        match self.found(dds_topic, &message_type.dds()) {
            Found::Named(topic) => Some((topic, Selection::Whole)),
            Found::Made(made) => Some((made.topic, made.selection)),
            Found::Tied(_) | Found::Fault(_) | Found::Nothing => None,
        }
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
        let is_written = self.is_written(&dds_topic);
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
        let (policy, definitions) = (&self.policy, &mut self.definitions);
        let gone = self.sinks.extract_if(|topic, sink| {
            let outdated = sink.open.as_ref().is_some_and(|open| {
                !definitions.is_current(&open.definition, open.definition.hash)
            });
            policy.is_for_service(*topic)
                || outdated
                || !sink.is_like(&Sink::new(policy.destination(*topic)))
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
        for value in new {
            let latched = source.latched();
            let events = taken_up(value, &message_type, source.live, latched, received);
            self.events.extend(events);
        }
    }
}

/// Writers that were given up and stay for a while.
const MOST_FORMER: usize = 256;
