//! The set of tracked topics. Topics of the own space, of the mapping and of the port are always
//! tracked, other topics only up to a limit.

use std::net::SocketAddr;
use std::time::Instant;

use mappings::{Lasting, Overflow, SpaceId, TopicId};

use super::values::MAX_STRAYS;
use super::{DropSite, Router, TopicQueues};
use crate::confirm::Confirming;
use crate::counters::Reason;
use crate::deadline::Deadline;
use crate::gate::Gate;
use crate::reader::ReceivedTopicState;
use crate::settings::Now;
use crate::takes::UsedFields;
use crate::topic::{Topic, TopicSide};
use crate::topics::Handle;
use crate::writer::SentTopicState;

impl Router {
    /// Returns the time of the last message of each topic of another space that was received at
    /// least once.
    pub fn heard(&self) -> impl Iterator<Item = (TopicId, Instant)> {
        self.values
            .topics
            .iter()
            .filter_map(|(topic, entry)| match &entry.role {
                TopicSide::Theirs(reader) if reader.was_heard() => Some((topic, reader.heard_at())),
                TopicSide::Theirs(_) | TopicSide::Ours(_) => None,
            })
    }
}

impl TopicQueues {
    /// Returns the handle of a topic of a received message, and adds the topic if necessary.
    /// Returns `None` for an unknown topic if the limit is reached.
    pub(super) fn entry(&mut self, topic: TopicId, from: SocketAddr, now: Now) -> Option<Handle> {
        if let Some(at) = self.topics.find(topic) {
            return Some(at);
        }
        let is_stray = !self.is_home(topic) && self.mapping.variable(topic).is_none();
        if is_stray && !self.take_place(now) {
            self.count(DropSite::sender(from), Reason::TooManyTopics, 1, || {
                format!(
                    "ignored {topic}: more than {MAX_STRAYS} topics are received that the mapping does not \
                     name and that have no subscriber here"
                )
            });
            return None;
        }
        Some(self.add(topic, Some(from), now))
    }

    /// Returns the handle of a topic, and adds the topic if necessary. It is for topics that the
    /// mapping or the port limits.
    pub(super) fn follow(&mut self, topic: TopicId, now: Now) -> Handle {
        let at = self.topics.find(topic);
        at.unwrap_or_else(|| self.add(topic, None, now))
    }

    fn add(&mut self, topic: TopicId, from: Option<SocketAddr>, now: Now) -> Handle {
        let is_home = self.is_home(topic);
        let variable = self.mapping.variable(topic);
        let rules = match variable {
            Some(found) => (found.overflow, found.lasting),
            // A command, unless the local side describes it as a state.
            None if topic.space == SpaceId::UA && is_home => (Overflow::default(), Lasting::Event),
            None => <(Overflow, Lasting)>::default(),
        };
        let role = if is_home {
            TopicSide::Ours(Box::new(SentTopicState::new(now.monotonic)))
        } else {
            TopicSide::Theirs(Box::new(ReceivedTopicState::new(from, now.monotonic)))
        };
        let mut entry = Topic::new(role, rules);
        entry.takes = UsedFields::of(variable);
        entry.confirming = Confirming::of(variable);
        entry.deadline = Deadline::of(variable);
        entry.held_back = variable
            .map(|found| found.publish.period)
            .unwrap_or_default();
        entry.gate = match variable {
            Some(variable) if is_home => Gate::new(variable.publish),
            Some(_) | None => None,
        };
        let at = self.topics.insert(topic, entry);
        if from.is_some() {
            self.schedule(at);
            self.inquiries.meet(topic);
        }
        at
    }

    /// Removes a topic.
    pub(super) fn remove(&mut self, topic: TopicId) {
        if let Some(entry) = self.topics.remove(topic)
            && let TopicSide::Theirs(reader) = entry.role
            && let Some(base) = reader.base
        {
            self.base_bytes = self.base_bytes.saturating_sub(base.weight());
        }
    }

    fn take_place(&mut self, now: Now) -> bool {
        if self.room.wants_look(now.monotonic) {
            let strays = self.let_strays_go(now.monotonic);
            self.room.looked(strays, now.monotonic);
        }
        self.room.take()
    }

    /// Removes silent topics of other spaces that are not in the mapping and have no local type,
    /// beginning with the longest silence. Returns the number of remaining topics of this kind. The
    /// counters of removed topics are kept in total.
    fn let_strays_go(&mut self, now: Instant) -> usize {
        let (_, _, silence) = self.periods();
        let mut strays = 0_usize;
        let mut silent: Vec<(Instant, TopicId)> = Vec::new();
        for (topic, entry) in self.topics.iter() {
            if let TopicSide::Theirs(reader) = &entry.role
                && entry.plan.is_none()
                && self.mapping.variable(topic).is_none()
            {
                strays += 1;
                let told = !reader.news.queued && !entry.ready;
                let heard = reader.heard_at();
                if told && now.saturating_duration_since(heard) >= silence {
                    silent.push((heard, topic));
                }
            }
        }
        silent.sort_unstable();
        silent.truncate(MOST_LET_GO);
        for (_, topic) in &silent {
            self.remove(*topic);
        }
        strays - silent.len()
    }
}

/// The maximum number of unknown topics that are removed at a time.
const MOST_LET_GO: usize = MAX_STRAYS / 8;
