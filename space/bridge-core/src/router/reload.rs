//! Replacement of the mapping at run time.

use std::sync::Arc;

use mappings::{Lasting, Mapping, Overflow, TopicId};
use messages::Wire;

use super::{DropSite, Router, TopicQueues};
use crate::confirm::Confirming;
use crate::counters::Reason;
use crate::deadline::Deadline;
use crate::gate::Gate;
use crate::queue::SampleQueue;
use crate::settings::{Local, Now};
use crate::takes::UsedFields;
use crate::topic::{PolledSample, Topic, TopicSide};

impl Router {
    /// Returns the current mapping.
    #[must_use]
    pub const fn mapping(&self) -> &Arc<Mapping> {
        &self.values.mapping
    }

    /// Replaces the mapping. A topic with the same variable continues unchanged. If its queue or
    /// its publishing rule differs, it is changed and the sequence numbers continue. If its
    /// metadata differs, it is announced again.
    ///
    /// The port handles changed bindings: it calls [`unbind`](Self::unbind) for removed bindings
    /// and [`bind`](Self::bind) for new bindings.
    pub fn replace_mapping(&mut self, mapping: Arc<Mapping>, now: Now) {
        let before = std::mem::replace(&mut self.values.mapping, mapping);
        self.reassembly.renew(&mut self.values, before.pubsub());
        self.security.replace(self.values.mapping.security());
        self.values.overhead = self.security.overhead();
        let receive_timeout = self.values.mapping.pubsub().receive_timeout;
        if let Some(calls) = &mut self.calls {
            calls.set_receive_timeout(receive_timeout);
        }
        let renamed = before.namespaces() != self.values.mapping.namespaces();
        for at in self.values.topics.handles() {
            let topic = at.topic();
            let rules = |mapping: &Mapping| {
                let variable = mapping.variable(topic);
                variable
                    .map(|variable| {
                        let queue = (variable.overflow, variable.lasting);
                        (queue, variable.publish)
                    })
                    .unwrap_or_default()
            };
            let (was, is) = (rules(&before), rules(&self.values.mapping));
            if was.0 != is.0 {
                self.values.requeue(topic, is.0);
            }
            if was.1 != is.1 {
                self.values.regate(topic, now);
            }
            let (was, is) = (before.variable(topic), self.values.mapping.variable(topic));
            if let Some(entry) = self.values.topics.get_mut(&topic)
                && was != is
            {
                entry.takes = UsedFields::of(is);
                entry.confirming = Confirming::of(is);
                entry.deadline = Deadline::of(is);
                entry.held_back = is.map(|is| is.publish.period).unwrap_or_default();
                if let TopicSide::Theirs(reader) = &mut entry.role {
                    // The selected field may have changed.
                    reader.owed = true;
                }
            }
            let reacts = is.is_some_and(|v| v.service.is_some());
            if reacts || was.map(|v| &v.loss) != is.map(|v| &v.loss) {
                self.values.react_again(topic);
            }
            let (was, is) = (before.variable(topic), self.values.mapping.variable(topic));
            let meant = was.map(|v| &v.meaning) != is.map(|v| &v.meaning);
            // For this kind of local side only the mapping describes the values.
            let typed = self.values.settings.local == Local::Fields && was != is;
            if renamed || meant || typed {
                self.describe_again(topic, now);
            }
            // The new mapping may have shorter periods.
            self.values.schedule(at);
        }
        self.inquire(now);
    }

    /// Removes the binding of a topic that the local side does not have any more, or before it is
    /// [bound](Self::bind) to something else. A topic of the own space is silent until its next
    /// sample, which uses the next sequence number. For a topic of another space, the next value
    /// requests a local type again. The counters are kept.
    pub fn unbind(&mut self, topic: TopicId, now: Now) {
        // The sample that waits for its time is the last sample.
        self.values.regate(topic, now);
        self.inquire(now);
        let Some(entry) = self.values.topics.get_mut(&topic) else {
            return;
        };
        entry.plan = None;
        entry.bound = None;
        entry.transcoder = None;
        entry.by_name = None;
        entry.loss = None;
        entry.trigger = None;
        match &mut entry.role {
            TopicSide::Ours(writer) => {
                writer.keep_nothing();
                writer.set_live(false);
                self.values.settle_arrival(topic);
            }
            TopicSide::Theirs(reader) => {
                reader.held = None;
                reader.shape = None;
                reader.forget_all();
                self.values.drop_deliveries(
                    topic,
                    "the mapping binds it to another topic or service now",
                );
            }
        }
    }

    /// Updates the description of a topic of the own space after a change of the mapping.
    fn describe_again(&mut self, topic: TopicId, now: Now) {
        if !self.values.is_home(topic) {
            return;
        }
        let bound = self
            .values
            .topics
            .get(&topic)
            .and_then(|entry| entry.bound.clone());
        if let Some((message_type, selection)) = bound.as_deref() {
            self.describe(topic, Some((message_type, selection)), now);
        } else if self.values.settings.local == Local::Fields {
            self.describe(topic, None, now);
        }
    }
}

impl TopicQueues {
    /// Drops the deliveries that wait for the local side, because they have the previous type.
    pub(super) fn drop_deliveries(&mut self, topic: TopicId, why: &str) {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        let waiting = std::iter::from_fn(|| entry.queue.pop()).count();
        let count = waiting.try_into().unwrap_or(u64::MAX);
        if count > 0 {
            self.count(DropSite::topic(topic), Reason::NotPublished, count, || {
                why.to_owned()
            });
        }
    }

    /// Updates the reaction to the loss of a commander after a change of the mapping.
    fn react_again(&mut self, topic: TopicId) {
        let wire = match self.settings.local {
            Local::Ros1 => Wire::Ros1,
            Local::Cdr => Wire::Cdr,
            Local::Fields => return,
        };
        let bound = self.topics.get(&topic).and_then(|of| of.bound.clone());
        let Some((message_type, selection)) = bound.as_deref() else {
            return;
        };
        let reactions = self.reactions(topic, (message_type, selection), wire);
        if let (Some(entry), Ok(reactions)) = (self.topics.get_mut(&topic), reactions) {
            // The check of the mapping reports reactions that cannot be made.
            entry.react(reactions);
        }
    }

    /// Replaces the queue of a topic and keeps the waiting samples.
    pub(super) fn requeue(&mut self, topic: TopicId, (overflow, lasting): (Overflow, Lasting)) {
        let Some(entry) = self.topics.get_mut(&topic) else {
            return;
        };
        entry.overflow = overflow;
        entry.lasting = lasting;
        let mut before = std::mem::replace(&mut entry.queue, SampleQueue::new(overflow));
        if let TopicSide::Ours(writer) = &mut entry.role
            && lasting == Lasting::Event
        {
            writer.keep_nothing();
        }
        self.settle_arrival(topic);
        let waiting: Vec<PolledSample> = std::iter::from_fn(|| before.pop()).collect();
        for item in waiting {
            self.push_to(topic, item);
        }
    }

    /// Replaces the publishing rule of a topic. A held sample is sent.
    fn regate(&mut self, topic: TopicId, now: Now) {
        let Some(at) = self.topics.find(topic) else {
            return;
        };
        let Some(Topic {
            role: TopicSide::Ours(_),
            gate,
            ..
        }) = self.topics.at_mut(at)
        else {
            return;
        };
        let held = gate.as_mut().and_then(|gate| gate.hurry(now.monotonic));
        let rule = self.mapping.variable(topic).map(|v| v.publish);
        *gate = Gate::new(rule.unwrap_or_default());
        self.let_go(at, held, now);
    }
}
