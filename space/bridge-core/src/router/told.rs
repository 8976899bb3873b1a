//! What is told besides samples: drops to log, and what the port is to know of topics of other spaces.

use std::net::SocketAddr;

use mappings::TopicId;

use super::Router;
use crate::counters::{Cause, Reason, is_told};
use crate::output::{Notice, Output};
use crate::reader::Ask;
use crate::settings::Now;
use crate::topic::{Role, Topic};

impl Router {
    /// Counts drops, and tells of them at the 1st, 10th, 100th ... occurrence of their cause.
    pub(super) fn count(
        &mut self,
        About { topic, from }: About,
        cause: impl Into<Cause>,
        count: u64,
        detail: impl FnOnce() -> String,
    ) {
        let cause = cause.into();
        if let Some(entry) = topic.and_then(|topic| self.topics.get_mut(&topic))
            && let Role::Theirs(reader) = &mut entry.role
        {
            reader.dropped(cause.reason);
        }
        self.count_only(About { topic, from }, cause, count, detail);
    }

    /// As [`count`](Self::count), for drops that leave the reader of the topic as it is.
    pub(super) fn count_only(
        &mut self,
        About { topic, from }: About,
        cause: impl Into<Cause>,
        count: u64,
        detail: impl FnOnce() -> String,
    ) {
        let cause = cause.into();
        let counters = match topic.and_then(|topic| self.topics.get_mut(&topic)) {
            Some(entry) => &mut entry.counters,
            None => &mut self.others,
        };
        let total = counters.add(cause, count);
        let before = total.saturating_sub(count);
        self.tell_of_drop(About { topic, from }, cause, (before, total), detail);
    }

    /// Tells of drops for a cause, of which there were so many before and are so many now.
    pub(super) fn tell_of_drop(
        &mut self,
        About { topic, from }: About,
        cause: Cause,
        (before, total): (u64, u64),
        detail: impl FnOnce() -> String,
    ) {
        let told =
            !cause.reason.is_routine() && (before + 1..=total).take(MAX_TOLD_STEPS).any(is_told);
        if told {
            let detail = detail();
            if !detail.is_empty() {
                self.tell(Output::Notice(Notice {
                    topic,
                    from,
                    reason: cause.reason,
                    total,
                    detail,
                }));
            }
        }
    }

    /// Has something told, unless so much waits already that it is only counted.
    pub(super) fn tell(&mut self, output: Output) {
        if self.told.len() < MAX_TOLD {
            self.told.push_back(output);
        } else {
            self.others.add((Reason::Overflow, "told"), 1);
        }
    }

    /// The writer of a topic fell silent, or speaks again: the port is told how it is by then.
    pub(super) fn tell_silence(&mut self, topic: TopicId) {
        self.tell_of(topic, |reader| reader.news.silence = true);
    }

    /// Has the port find the local type of a topic, with what is known of it by then. What is asked already is not asked
    /// twice.
    pub(super) fn tell_unbound(&mut self, topic: TopicId) {
        self.tell_of(topic, |reader| reader.news.ask = Some(Ask::Always));
    }

    /// A topic that is open may have other values than before: has the port look at what its writer said of them, if it did.
    pub(super) fn tell_described(&mut self, topic: TopicId) {
        self.tell_of(topic, |reader| {
            reader.news.ask.get_or_insert(Ask::IfDescribed);
        });
    }

    fn tell_of(&mut self, topic: TopicId, news: impl FnOnce(&mut crate::reader::Reader)) {
        if let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.topics.get_mut(&topic)
        {
            news(reader);
            if !std::mem::replace(&mut reader.news.queued, true) {
                self.news.push_back(topic);
            }
        }
    }

    /// What is told next of any topic.
    pub(super) fn next_news(&mut self, now: Now) -> Option<Output> {
        while let Some(topic) = self.news.front().copied() {
            if let Some(told) = self.news_of(topic, now) {
                return Some(told);
            }
            self.news.pop_front();
            if let Some(Topic {
                role: Role::Theirs(reader),
                ..
            }) = self.topics.get_mut(&topic)
            {
                reader.news.queued = false;
            }
        }
        None
    }

    /// What is told next of a topic; its values come after it.
    pub(super) fn news_of(&mut self, topic: TopicId, now: Now) -> Option<Output> {
        let Some(Topic {
            role: Role::Theirs(reader),
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return None;
        };
        if std::mem::take(&mut reader.news.silence) {
            let silent = reader.is_silent();
            return Some(Output::Silent {
                topic,
                silent,
                dropped: reader.loss().filter(|_| silent),
            });
        }
        let ask = reader.news.ask.take()?;
        let Some(shape) = reader.shape.clone() else {
            // Its values are others since: the next one asks at once.
            reader.asked = None;
            return None;
        };
        self.asked(topic, ask, shape, now)
    }
}

/// What a drop is about.
#[derive(Clone, Copy)]
pub(super) struct About {
    pub(super) topic: Option<TopicId>,
    pub(super) from: Option<SocketAddr>,
}

impl About {
    pub(super) const fn topic(topic: TopicId) -> Self {
        Self {
            topic: Some(topic),
            from: None,
        }
    }

    pub(super) const fn sender(from: SocketAddr) -> Self {
        Self {
            topic: None,
            from: Some(from),
        }
    }
}

/// What waits to be told, beside the news of topics: whoever sends to the group can give cause for more than is taken.
const MAX_TOLD: usize = 4_096;
/// How far a sudden jump of a counter is searched for a decade to be told at.
const MAX_TOLD_STEPS: usize = 1_000;
