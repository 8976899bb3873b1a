//! Outputs other than samples: drops to log, and notifications about topics of other spaces.

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::{DropCause, Reason, is_told};
use crate::output::{DropNotice, Output};
use crate::reader::{LocalTypeRequest, ReceivedTopicState};
use crate::settings::Now;
use crate::topics::Handle;

impl TopicQueues {
    /// Counts drops, and reports them at the 1st, 10th, 100th ... occurrence of their cause.
    pub(super) fn count(
        &mut self,
        DropSite { topic, from }: DropSite,
        cause: impl Into<DropCause>,
        count: u64,
        detail: impl FnOnce() -> String,
    ) {
        let cause = cause.into();
        if let Some(reader) = topic.and_then(|topic| self.topics.reader_of(topic)) {
            reader.dropped(cause.reason);
        }
        self.count_only(DropSite { topic, from }, cause, count, detail);
    }

    /// Counts drops as [`count`](Self::count) does, without an effect on the reader of the topic.
    pub(super) fn count_only(
        &mut self,
        DropSite { topic, from }: DropSite,
        cause: impl Into<DropCause>,
        count: u64,
        detail: impl FnOnce() -> String,
    ) {
        let cause = cause.into();
        let total = self.topics.counters(topic).add(cause, count);
        let before = total.saturating_sub(count);
        if let Some(topic) = topic.filter(|topic| self.tap.taps(*topic)) {
            let detail = detail();
            self.tap.note_drop((topic, from), cause, (count, &detail));
            let about = DropSite {
                topic: Some(topic),
                from,
            };
            return self.tell_of_drop(about, cause, (before, total), || detail);
        }
        self.tell_of_drop(DropSite { topic, from }, cause, (before, total), detail);
    }

    /// Reports drops for a cause if a logged occurrence lies between the previous and the new
    /// total.
    pub(super) fn tell_of_drop(
        &mut self,
        DropSite { topic, from }: DropSite,
        cause: DropCause,
        (before, total): (u64, u64),
        detail: impl FnOnce() -> String,
    ) {
        let told =
            !cause.reason.is_routine() && (before + 1..=total).take(MAX_TOLD_STEPS).any(is_told);
        if told {
            let detail = detail();
            if !detail.is_empty() {
                self.tell(Output::Notice(DropNotice {
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
            self.topics.others_mut().add((Reason::Overflow, "told"), 1);
        }
    }

    /// Notifies the port that the silence of a topic has changed. The notification contains the
    /// state at the time of its output.
    pub(super) fn tell_silence(&mut self, at: Handle) {
        self.tell_of(at, |reader| reader.news.silence = true);
    }

    /// Requests the local type of a topic from the port, with the description known at the time of
    /// output. A pending request is not repeated.
    pub(super) fn tell_unbound(&mut self, at: Handle) {
        self.tell_of(at, |reader| {
            reader.news.ask = Some(LocalTypeRequest::Always)
        });
    }

    /// Requests a check of the writer's description from the port, because the values of an open
    /// topic may have changed.
    pub(super) fn tell_described(&mut self, at: Handle) {
        self.tell_of(at, |reader| {
            reader.news.ask.get_or_insert(LocalTypeRequest::IfDescribed);
        });
    }

    fn tell_of(&mut self, at: Handle, news: impl FnOnce(&mut ReceivedTopicState)) {
        if let Some(reader) = self.topics.reader(at) {
            news(reader);
            if !std::mem::replace(&mut reader.news.queued, true) {
                self.news.push_back(at);
            }
        }
    }

    /// Returns the next notification about any topic.
    pub(super) fn next_news(&mut self, now: Now) -> Option<Output> {
        while let Some(at) = self.news.front().copied() {
            if let Some(told) = self.news_of(at, now) {
                return Some(told);
            }
            self.news.pop_front();
            if let Some(reader) = self.topics.reader(at) {
                reader.news.queued = false;
            }
        }
        None
    }

    /// Returns the next notification about a topic, which precedes its values.
    pub(super) fn news_of(&mut self, at: Handle, now: Now) -> Option<Output> {
        let topic = at.topic();
        let reader = self.topics.reader(at)?;
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

/// The maximum number of queued outputs, except notifications about topics. It is limited, because
/// any sender in the group can cause outputs.
const MAX_TOLD: usize = 4_096;
/// The maximum number of occurrences that are searched for a logged occurrence after a jump of a
/// counter.
const MAX_TOLD_STEPS: usize = 1_000;
