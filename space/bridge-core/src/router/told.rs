//! Outputs other than samples: drops to log, and notifications about topics of other spaces.

use std::net::SocketAddr;

use mappings::TopicId;

use super::Values;
use crate::counters::{Cause, Reason, is_told};
use crate::output::{Notice, Output};
use crate::reader::Ask;
use crate::settings::Now;
use crate::topic::{Role, Topic};

impl Values {
    /// Counts drops, and reports them at the 1st, 10th, 100th ... occurrence of their cause.
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

    /// Counts drops as [`count`](Self::count) does, without an effect on the reader of the topic.
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
        if let Some(topic) = topic.filter(|topic| self.taps(*topic)) {
            let detail = detail();
            self.note_drop((topic, from), cause, (count, &detail));
            let about = About {
                topic: Some(topic),
                from,
            };
            return self.tell_of_drop(about, cause, (before, total), || detail);
        }
        self.tell_of_drop(About { topic, from }, cause, (before, total), detail);
    }

    /// Reports drops for a cause if a logged occurrence lies between the previous and the new
    /// total.
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

    /// Queues an output. If the queue is full, the output is only counted.
    pub(super) fn tell(&mut self, output: Output) {
        if self.told.len() < MAX_TOLD {
            self.told.push_back(output);
        } else {
            self.others.add((Reason::Overflow, "told"), 1);
        }
    }

    /// Notifies the port that the silence of a topic has changed. The notification contains the
    /// state at the time of its output.
    pub(super) fn tell_silence(&mut self, topic: TopicId) {
        self.tell_of(topic, |reader| reader.news.silence = true);
    }

    /// Requests the local type of a topic from the port, with the description known at the time of
    /// output. A pending request is not repeated.
    pub(super) fn tell_unbound(&mut self, topic: TopicId) {
        self.tell_of(topic, |reader| reader.news.ask = Some(Ask::Always));
    }

    /// Requests a check of the writer's description from the port, because the values of an open
    /// topic may have changed.
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

    /// Returns the next notification about any topic.
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

    /// Returns the next notification about a topic, which precedes its values.
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
            // The values have changed; the next value requests the type at once.
            reader.asked = None;
            return None;
        };
        self.asked(topic, ask, shape, now)
    }
}

/// The topic and sender of a drop.
#[derive(Clone, Copy)]
pub(super) struct About {
    pub(super) topic: Option<TopicId>,
    pub(super) from: Option<SocketAddr>,
}

impl About {
    pub(super) const NOTHING: Self = Self {
        topic: None,
        from: None,
    };

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

/// The maximum number of queued outputs, except notifications about topics. It is limited, because
/// any sender in the group can cause outputs.
const MAX_TOLD: usize = 4_096;
/// The maximum number of occurrences that are searched for a logged occurrence after a jump of a
/// counter.
const MAX_TOLD_STEPS: usize = 1_000;
