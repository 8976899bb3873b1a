//! Applies another mapping; bindings that are the same in both mappings stay untouched.

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
    /// Gives up all outdated bindings before it adds new bindings, because a value or a topic may
    /// only have moved. Endpoints are created in the next pass over the domain.
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

    /// Gives up the values that are no longer made of a topic, and the topic itself if it is read
    /// as another type.
    fn give_up_values(&mut self, index: usize, read: &Read) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        // The definition may have changed because the files were read again.
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
                // The publishers of the topic see that the reader is disposed.
                drop(self.inbox.remove(slot));
            }
            // The slot stays, because the inbox uses its index; the name is free for another
            // source.
            let (topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
            **source = Source::new(topic.clone(), message_type);
            if self.source_of.get(&topic) == Some(&index) {
                self.source_of.remove(&topic);
            }
        }
    }

    /// Returns the value of a found topic of that type.
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

    /// Creates the value of a topic that the mapping does not name, if all its values were given
    /// up; the reader stays while the type is the same. Gives up the topic if it has no such value.
    fn take_up_found(&mut self, index: usize) {
        let Some(source) = self.sources.get(index) else {
            return;
        };
        if !source.values.is_empty() || self.source_of.get(&source.dds_topic) != Some(&index) {
            return;
        }
        let (dds_topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
        // Other publishers on a topic to which the bridge writes values of other spaces are no
        // value of ours.
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
        // Their writers are disposed here, or once their readers have received all samples.
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

    /// Adds values of a topic that the mapping reads; some may exist already.
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
        // A source that is not read yet reports all its values when it is opened.
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

/// Maximum number of former writers that are kept for a while.
const MOST_FORMER: usize = 256;
