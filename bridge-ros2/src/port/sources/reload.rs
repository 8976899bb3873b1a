//! Applies another mapping to the topics that this bridge reads.

use std::sync::Arc;

use bridge_node::policy::{Read, TopicMeaning, still_made, taken_up};
use bridge_node::{PortEvent, now};
use mappings::TopicId;
use messages::{Selection, TypeName};

use super::super::side::Ros2Side;
use super::ReadTopics;
use crate::source::{ReaderState, Ros2Source};

impl ReadTopics {
    /// Gives up the values that the new mapping does not make.
    pub(in crate::port) fn give_up(&mut self, side: &mut Ros2Side, read: &Read) {
        for index in 0..self.list.len() {
            self.give_up_values(side, index, read);
        }
    }

    /// Adds the topics of the new mapping; some may exist already. Then adds the values of topics
    /// that the mapping does not name. `is_written` returns whether values of other spaces are
    /// written to a topic.
    pub(in crate::port) fn take_up_again(
        &mut self,
        side: &mut Ros2Side,
        read: Read,
        is_written: impl Fn(&str) -> bool,
    ) {
        for (topic, (message_type, values)) in read {
            self.take_up_values(side, topic, message_type, values);
        }
        for index in 0..self.list.len() {
            self.take_up_found(side, index, &is_written);
        }
    }

    /// Gives up the values that are no longer made of a topic, and the topic itself if it is read
    /// as another type.
    fn give_up_values(&mut self, side: &mut Ros2Side, index: usize, read: &Read) {
        let Some(source) = self.list.get(index) else {
            return;
        };
        // The definition may have changed because the files were read again.
        let outdated = source
            .definition
            .as_ref()
            .is_some_and(|it| !side.definitions.is_current(it, source.announced));
        let (dds_topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
        let wanted = match outdated {
            true => Vec::new(),
            false => still_made(read.get(&dds_topic), Some(&message_type), || {
                found_value(side, &dds_topic, &message_type)
            }),
        };
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        let gone = source
            .values
            .extract_if(.., |value| !wanted.contains(value));
        let unbound = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        side.events.extend(unbound);
        let read_alike = read
            .get(&dds_topic)
            .is_none_or(|(of, _)| message_type == *of);
        if source.values.is_empty() && (outdated || !read_alike) {
            self.give_up_source(index);
        }
    }

    fn give_up_source(&mut self, index: usize) {
        if let Some(source) = self.list.get_mut(index) {
            if let ReaderState::Open { slot, .. } = source.reading {
                // The publishers of the topic see that the reader is disposed.
                drop(self.inbox.remove(slot));
            }
            // The slot stays, because the inbox uses its index; the name is free for another
            // source.
            let (topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
            **source = Ros2Source::new(topic.clone(), message_type);
            if self.by_name.get(&topic) == Some(&index) {
                self.by_name.remove(&topic);
            }
        }
    }

    /// Creates the value of a topic that the mapping does not name, if all its values were given
    /// up; the reader stays while the type is the same. Gives up the topic if it has no such value.
    fn take_up_found(
        &mut self,
        side: &mut Ros2Side,
        index: usize,
        is_written: impl Fn(&str) -> bool,
    ) {
        let Some(source) = self.list.get(index) else {
            return;
        };
        if !source.values.is_empty() || self.by_name.get(&source.dds_topic) != Some(&index) {
            return;
        }
        let (dds_topic, message_type) = (source.dds_topic.clone(), source.message_type.clone());
        // Other publishers on a topic to which the bridge writes values of other spaces are no
        // value of ours.
        let is_written = is_written(&dds_topic);
        let found = found_value(side, &dds_topic, &message_type);
        let found = found.filter(|(topic, _)| {
            let mut made = self.list.iter().flat_map(|source| &source.values);
            !is_written && made.all(|(other, _)| other != topic)
        });
        match found {
            Some(value) => self.take_up_values(side, dds_topic, message_type, vec![value]),
            None => self.give_up_source(index),
        }
    }

    /// Adds values of a topic that the mapping reads; some may exist already.
    fn take_up_values(
        &mut self,
        side: &mut Ros2Side,
        dds_topic: String,
        message_type: TypeName,
        values: Vec<(TopicId, Selection)>,
    ) {
        let index = self.source(dds_topic, message_type);
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        let known: Vec<TopicId> = source.values.iter().map(|(topic, _)| *topic).collect();
        let new: Vec<_> = values
            .into_iter()
            .filter(|(topic, _)| !known.contains(topic))
            .collect();
        source.values.extend(new.iter().cloned());
        // A source that is not read yet reports all its values when it is opened.
        let ReaderState::Open { .. } = source.reading else {
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
            side.events.extend(events);
        }
    }
}

/// Returns the value of a found topic of that type.
fn found_value(
    side: &Ros2Side,
    dds_topic: &str,
    message_type: &TypeName,
) -> Option<(TopicId, Selection)> {
    match side.found(dds_topic, &message_type.dds()) {
        TopicMeaning::Named(topic) => Some((topic, Selection::Whole)),
        TopicMeaning::Made(made) => Some((made.topic, made.selection)),
        TopicMeaning::Tied(_) | TopicMeaning::Fault(_) | TopicMeaning::Nothing => None,
    }
}
