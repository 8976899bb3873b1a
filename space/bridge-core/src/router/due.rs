//! Repetitions, keep-alives, silences, and the timers of topics.

use std::cmp::Reverse;
use std::time::{Duration, Instant};

use mappings::TopicId;

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::Reason;
use crate::loss::{Reaction, ReactionFault};
use crate::message::SampleMessage;
use crate::network::keep_alive;
use crate::output::{Delivery, GOOD, Output, ValueRelation};
use crate::settings::{Local, Now};
use crate::topic::{PolledSample, TopicSide};
use crate::topics::Handle;
use crate::writer::Idle;

impl TopicQueues {
    /// Repeats a value, sends a keep-alive, or detects the silence of a topic. Repetitions and
    /// keep-alives are sent if they are due at `until`. Returns whether one is sent.
    pub(super) fn handle_due(&mut self, at: Handle, until: Instant, now: Now) -> bool {
        self.expire_held(at.topic(), now);
        let (key_frames, keep_alives, silence) = self.periods();
        let muted = self.is_muted();
        let leads = [key_frames, keep_alives].map(|period| self.topics.lead(at, period));
        let [repeat_lead, keep_alive_lead] = leads;
        let Some(entry) = self.topics.at_mut(at) else {
            return false;
        };
        match &mut entry.role {
            TopicSide::Theirs(reader) => {
                if reader.fell_silent(now.monotonic, silence) {
                    if self.settings.local != Local::Fields {
                        reader.withdraw();
                    }
                    self.tell_silence(at);
                    self.forget_base(at);
                    self.lose(at, now);
                } else if (entry.loss.as_ref().and_then(|loss| loss.due()))
                    .is_some_and(|at| at <= now.monotonic)
                {
                    self.lose(at, now);
                }
                false
            }
            TopicSide::Ours(writer) => {
                if let Some(held) = entry
                    .gate
                    .as_mut()
                    .and_then(|gate| gate.release(now.monotonic))
                {
                    self.let_go(at, Some(held), now);
                    return false;
                }
                if writer.look_again(now.monotonic) && !entry.ready {
                    entry.ready = true;
                    self.ready.push_back(at);
                }
                let Some((due, idle)) = writer.due(key_frames, keep_alives) else {
                    return false;
                };
                if due > until {
                    return false;
                }
                match idle {
                    Idle::Repeat => {
                        writer.begin_round(now.monotonic);
                        writer.spread(idle, repeat_lead);
                    }
                    Idle::KeepAlive => {
                        writer.spoke(now.monotonic);
                        writer.spread(idle, keep_alive_lead);
                        let expected = writer.expected_sequence();
                        // Waiting items contain more information than a keep-alive.
                        let buffer = self.buffers.take();
                        if !muted
                            && !entry.has_more()
                            && let Some(datagram) =
                                keep_alive(buffer, at.topic(), expected, now.utc)
                        {
                            entry.counters.keep_alives += 1;
                            let item = PolledSample::Message(SampleMessage::Datagram(datagram));
                            let bytes = item.bytes();
                            // The queue is empty, so nothing is dropped.
                            drop(entry.queue.push(item, bytes));
                        }
                    }
                }
                if !entry.ready && entry.has_more() {
                    entry.ready = true;
                    self.ready.push_back(at);
                }
                true
            }
        }
    }

    /// Delivers the reaction to the loss of a commander from the mapping, if a value was delivered
    /// after the last reaction.
    pub(super) fn lose(&mut self, at: Handle, now: Now) {
        let loss = self.topics.at_mut(at).and_then(|of| of.loss.as_mut());
        let Some(reaction) = loss.and_then(|loss| loss.take()) else {
            return;
        };
        let (of, stop) = match reaction {
            Reaction::Publish(stop) => (at.topic(), Some(stop)),
            Reaction::Call(by) => {
                let trigger = self.topics.get(&by).and_then(|of| of.trigger.as_deref());
                (by, trigger.cloned())
            }
        };
        let muted = self.is_muted_locally();
        if !muted {
            self.tell(Output::CommanderLost { topic: at.topic() });
        }
        let mut payload = self.buffer();
        let written = match stop {
            Some(stop) => stop.write(now.utc, &mut payload),
            None => Err(ReactionFault::UnknownService(of)),
        };
        if let Err(detail) = written {
            self.recycle(payload);
            self.count(
                DropSite::topic(at.topic()),
                (Reason::NotPublished, "on_loss"),
                1,
                || format!("`on_loss`: {detail}"),
            );
            return;
        }
        let delivery = Delivery {
            topic: of,
            payload,
            source: Some(now.utc),
            status: GOOD,
            arrived: now.utc,
            instance: None,
            kept: ValueRelation::Alone,
            lasting: false,
        };
        if muted {
            self.mute_loss(delivery, now);
        } else {
            self.push_to(of, PolledSample::Delivery(delivery));
        }
    }

    /// Adds the topic to the timer list with its next due time.
    pub(super) fn schedule(&mut self, at: Handle) {
        let (key_frames, keep_alives, silence) = self.periods();
        let Some(entry) = self.topics.at_mut(at) else {
            return;
        };
        let due = match &entry.role {
            TopicSide::Ours(writer) => {
                let held = entry.gate.as_ref().and_then(|gate| gate.due());
                let idle = writer.due(key_frames, keep_alives).map(|(at, _)| at);
                let announce = entry.announce_at;
                let again = writer.again_at();
                let due = held.into_iter().chain(idle).chain(announce);
                due.chain(again).min()
            }
            TopicSide::Theirs(reader) => {
                let hold = entry.loss.as_ref().and_then(|loss| loss.due());
                let held = reader.held.as_ref().and_then(|held| held.expires());
                let due = reader.due(silence).into_iter().chain(hold);
                due.chain(held).min()
            }
        };
        // An earlier entry stays: it finds nothing due and schedules the topic again. This avoids a
        // new entry for each sample.
        if let Some(due) = due
            && entry.timer.is_none_or(|planned| due < planned)
        {
            entry.timer = Some(due);
            self.timers.push(Reverse((due, at)));
        }
    }

    /// Schedules a topic by its name.
    pub(super) fn schedule_topic(&mut self, topic: TopicId) {
        if let Some(at) = self.topics.find(topic) {
            self.schedule(at);
        }
    }

    /// Returns the next topic that is due.
    pub(super) fn next_due(&mut self, now: Now) -> Option<Handle> {
        while let Some(Reverse((due, at))) = self.timers.peek().copied() {
            if due > now.monotonic {
                return None;
            }
            self.timers.pop();
            if let Some(entry) = self.topics.at_mut(at)
                // Otherwise a later entry has replaced this entry.
                && entry.timer == Some(due)
            {
                entry.timer = None;
                return Some(at);
            }
        }
        None
    }

    /// Sends repetitions and keep-alives that are due soon together with those that were `sent`
    /// because they are due. Otherwise the program would wake for each of many topics, whose
    /// repetitions are spread over their period.
    pub(super) fn send_early(&mut self, sent: usize, now: Now) {
        let mut sent = sent;
        let (key_frames, ..) = self.periods();
        let until = now.monotonic + key_frames / EARLY;
        while (1..SENT_TOGETHER).contains(&sent)
            && self.topics.is_spread()
            && let Some(at) = self.next_idle(until)
        {
            let is_sent = self.handle_due(at, until, now);
            self.schedule(at);
            if !is_sent {
                return;
            }
            sent += 1;
        }
    }

    /// Returns the next topic if it is due at `until` and only for a repetition or a keep-alive.
    fn next_idle(&mut self, until: Instant) -> Option<Handle> {
        let (key_frames, keep_alives, _) = self.periods();
        let Reverse((due, at)) = self.timers.peek().copied()?;
        let entry = self.topics.at_mut(at)?;
        let TopicSide::Ours(writer) = &entry.role else {
            return None;
        };
        let idle = writer.due(key_frames, keep_alives).map(|(at, _)| at);
        let is_idle = due <= until && entry.timer == Some(due) && idle == Some(due);
        if !is_idle || entry.gate.is_some() || writer.again_at().is_some() {
            return None;
        }
        entry.timer = None;
        self.timers.pop();
        Some(at)
    }

    /// Returns the time at which the next topic is due.
    pub(super) fn due(&self) -> Option<Instant> {
        self.timers.peek().map(|Reverse((due, _))| *due)
    }

    /// Returns the periods of key frames and keep-alives, and the time after which a topic is
    /// silent.
    pub(super) fn periods(&self) -> (Duration, Duration, Duration) {
        let pubsub = self.mapping.pubsub();
        (
            pubsub.key_frame_period,
            pubsub.keep_alive_period,
            pubsub.receive_timeout,
        )
    }
}

/// Part of the period by which a repetition may be sent early.
const EARLY: u32 = 10;
/// Number of repetitions for which the program wakes once.
const SENT_TOGETHER: usize = 8;
