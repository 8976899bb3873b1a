//! Samples that wait for their local type: the newest sample of each topic.

use std::time::Duration;

use mappings::TopicId;
use uadp::Fields;

use super::about::DropSite;
use super::local_sample::LocalSample;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::output::ValueRelation;
use crate::reader::HeldSample;
use crate::settings::Now;
use crate::topics::Handle;

impl TopicQueues {
    /// Stores a sample until its local type is known, in place of the previous sample.
    pub(super) fn hold(&mut self, topic: TopicId, sample: &LocalSample<'_>, now: Now) {
        let held = Box::new(HeldSample {
            fields: sample.fields.bytes().to_vec(),
            source: sample.source,
            instance: sample.instance,
            status: sample.status,
            lasting: sample.lasting,
            until: now.monotonic + MAX_WAIT,
        });
        let large = held.is_large();
        let size = held.fields.len();
        if let Some(reader_held) = self.held_of(topic) {
            *reader_held = Some(held);
        }
        if !large {
            return;
        }
        if self.has_room(topic, size) {
            self.schedule_topic(topic);
            return;
        }
        if let Some(reader_held) = self.held_of(topic) {
            *reader_held = None;
        }
        let cause = (Reason::NoRoom, "before its local type");
        self.count(DropSite::topic(topic), cause, 1, || {
            "the limit of large samples that wait for their local types is reached".to_owned()
        });
    }

    /// Reserves room for a large sample that waits for its type. Returns whether there was room.
    fn has_room(&mut self, topic: TopicId, size: usize) -> bool {
        let mut large = std::mem::take(&mut self.large_held);
        let mut bytes = size;
        large.retain(|other| {
            let held = match self.held_of(*other) {
                Some(Some(held)) if *other != topic && held.is_large() => held,
                _ => return false,
            };
            bytes = bytes.saturating_add(held.fields.len());
            true
        });
        let most = self.mapping.pubsub().max_message;
        let fits = usize::try_from(most).is_ok_and(|most| bytes <= most);
        let has_room = fits && large.len() < MAX_LARGE;
        if has_room {
            large.push(topic);
        }
        self.large_held = large;
        has_room
    }

    fn held_of(&mut self, topic: TopicId) -> Option<&mut Option<Box<HeldSample>>> {
        let reader = self.topics.reader_of(topic)?;
        Some(&mut reader.held)
    }

    /// Removes a large sample if its type was not known in time. A state is received again with its
    /// next repetition.
    pub(super) fn expire_held(&mut self, topic: TopicId, now: Now) {
        let over =
            |held: &mut Box<HeldSample>| held.expires().is_some_and(|at| at <= now.monotonic);
        let expired = self.held_of(topic).and_then(|held| held.take_if(over));
        if let Some(held) = expired.filter(|held| !held.lasting) {
            self.came_too_early(topic, &held);
        }
    }

    /// Delivers a sample that waited for its local type. An event is delivered only until it is too
    /// old.
    pub(super) fn deliver_held(&mut self, at: Handle, held: &HeldSample, now: Now) {
        if !held.lasting && held.until <= now.monotonic {
            self.came_too_early(at.topic(), held);
            return;
        }
        let Ok(fields) = Fields::parse(&held.fields) else {
            return;
        };
        let sample = LocalSample {
            fields,
            source: held.source,
            instance: held.instance,
            kept: ValueRelation::Alone,
            lasting: held.lasting,
            status: held.status,
            // The waiting time is not a delay of this program.
            arrived: now.utc,
        };
        self.deliver(at, &sample, now);
    }

    fn came_too_early(&mut self, topic: TopicId, held: &HeldSample) {
        if let Some(reader) = self.topics.reader_of(topic) {
            reader.forget(held.instance);
        }
        self.count(DropSite::topic(topic), Reason::NotPublished, 1, || {
            "its local type was known too late for an event".to_owned()
        });
    }
}

/// The maximum time for which an event may wait for its local type.
const MAX_WAIT: Duration = Duration::from_secs(1);
/// The maximum number of topics with a waiting large sample. Their total size is limited to the
/// maximum message size.
const MAX_LARGE: usize = 64;
