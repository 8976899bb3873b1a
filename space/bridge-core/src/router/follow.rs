//! The set of tracked topics. Topics of the own space, of the mapping and of the port are always
//! tracked, other topics only up to a limit.

use std::net::SocketAddr;
use std::time::Instant;

use mappings::{Lasting, Overflow, SpaceId, TopicId};

use super::{About, Router, Values};
use crate::confirm::Confirming;
use crate::counters::Reason;
use crate::gate::Gate;
use crate::reader::Reader;
use crate::settings::Now;
use crate::takes::Takes;
use crate::topic::{Role, Topic};
use crate::writer::Writer;

impl Router {
    /// Returns the time of the last message of each topic of another space that was received at
    /// least once.
    pub fn heard(&self) -> impl Iterator<Item = (TopicId, Instant)> {
        self.values
            .topics
            .iter()
            .filter_map(|(topic, entry)| match &entry.role {
                Role::Theirs(reader) if reader.was_heard() => Some((*topic, reader.heard_at())),
                Role::Theirs(_) | Role::Ours(_) => None,
            })
    }
}

impl Values {
    /// Returns the entry of a topic and creates it if necessary. Returns `None` for an unknown
    /// topic if the limit is reached.
    pub(super) fn entry(
        &mut self,
        topic: TopicId,
        from: SocketAddr,
        now: Now,
    ) -> Option<&mut Topic> {
        let is_stray = !self.is_home(topic) && self.mapping.variable(topic).is_none();
        if is_stray && !self.topics.contains_key(&topic) && !self.take_place(now) {
            self.count(About::sender(from), Reason::TooManyTopics, 1, || {
                format!(
                    "{topic} is not followed: more than {MAX_STRAYS} topics speak that the mapping does not name and \
                     nobody here takes"
                )
            });
            return None;
        }
        self.follow(topic, Some(from), now)
    }

    /// Returns the entry of a topic and creates it if necessary. It is for topics that the mapping
    /// or the port limits.
    pub(super) fn follow(
        &mut self,
        topic: TopicId,
        from: Option<SocketAddr>,
        now: Now,
    ) -> Option<&mut Topic> {
        if !self.topics.contains_key(&topic) {
            let variable = self.mapping.variable(topic);
            let rules = match variable {
                Some(found) => (found.overflow, found.lasting),
                // A command, unless the local side describes it as a state.
                None if topic.space == SpaceId::UA && self.is_home(topic) => {
                    (Overflow::default(), Lasting::Event)
                }
                None => <(Overflow, Lasting)>::default(),
            };
            let role = if self.is_home(topic) {
                Role::Ours(Box::new(Writer::new(now.monotonic)))
            } else {
                Role::Theirs(Box::new(Reader::new(from, now.monotonic)))
            };
            let mut entry = Topic::new(role, rules);
            entry.takes = Takes::of(variable);
            entry.confirming = Confirming::of(variable);
            entry.held_back = variable
                .map(|found| found.publish.period)
                .unwrap_or_default();
            entry.gate = match variable {
                Some(variable) if self.is_home(topic) => Gate::new(variable.publish),
                Some(_) | None => None,
            };
            self.topics.insert(topic, entry);
            if from.is_some() {
                self.schedule(topic);
                self.inquiries.meet(topic);
            }
        }
        self.topics.get_mut(&topic)
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
        for (topic, entry) in &self.topics {
            if let Role::Theirs(reader) = &entry.role
                && entry.plan.is_none()
                && self.mapping.variable(*topic).is_none()
            {
                strays += 1;
                let told = !reader.news.queued && !entry.ready;
                let heard = reader.heard_at();
                if told && now.saturating_duration_since(heard) >= silence {
                    silent.push((heard, *topic));
                }
            }
        }
        silent.sort_unstable();
        silent.truncate(MOST_LET_GO);
        for (_, topic) in &silent {
            if let Some(entry) = self.topics.remove(topic) {
                self.others.absorb(&entry.counters);
                if let Role::Theirs(reader) = entry.role
                    && let Some(base) = reader.base
                {
                    self.base_bytes = self.base_bytes.saturating_sub(base.weight());
                }
            }
        }
        strays - silent.len()
    }
}

/// The maximum number of unknown topics of other spaces. It limits memory, because any sender in
/// the group can invent topics.
pub(super) const MAX_STRAYS: usize = 16_384;
/// The maximum number of unknown topics that are removed at a time.
const MOST_LET_GO: usize = MAX_STRAYS / 8;
