//! Samples of the local side on their way to their queues.

use std::sync::Arc;

use mappings::{Lasting, TopicId};
use uadp::Timestamp;

use super::about::DropSite;
use super::values::TopicQueues;
use crate::counters::{DropCause, Reason, Verdict};
use crate::fields;
use crate::gate::{Passage, Waiting};
use crate::hops::Hop;
use crate::loop_rule::{Crosses, Side};
use crate::message::{EncodedSample, SampleMessage};
use crate::network::{check_size, data_set_header, encode};
use crate::output::{LocalMessage, PublisherKey};
use crate::settings::{Local, Now};
use crate::tap::Crossing;
use crate::topic::{PolledSample, Topic, TopicSide};
use crate::topics::Handle;
use crate::writer::MAX_KEPT;

impl TopicQueues {
    /// Handles a sample of the local side.
    pub(super) fn take_local(&mut self, heard: LocalMessage<'_>, status: u16, now: Now) -> Verdict {
        let LocalMessage {
            topic,
            payload,
            received,
            latched_by,
        } = heard;
        self.tap.note(topic, || Crossing::Taken {
            bytes: payload.len(),
        });
        if !self.may_cross(Side::Local, Crosses::Value, topic) {
            return self.refuse(topic, Reason::Looped, String::new());
        }
        if self.is_elsewhere(topic.triple().1) {
            return Verdict::Drop(Reason::SpaceTaken);
        }
        let mut encoded = EncodedSample {
            bytes: self.buffer(),
            ..EncodedSample::default()
        };
        let local = self.settings.local;
        let (max_datagram, max_message) = self.sizes();
        let at = self.follow(topic, now);
        let Some(Topic {
            role: TopicSide::Ours(writer),
            plan,
            gate,
            description,
            ..
        }) = self.topics.at_mut(at)
        else {
            // Not a topic of the own space.
            return Verdict::Drop(Reason::Looped);
        };
        let sample = match (local, plan) {
            (Local::Fields, _) => fields::LocalPayload::Block(payload),
            (Local::Ros1 | Local::Cdr, Some(plan)) => fields::LocalPayload::Ros(plan, payload),
            (Local::Ros1 | Local::Cdr, None) => {
                let detail = "its message type is not known yet".to_owned();
                return self.refuse(topic, Reason::Untyped, detail);
            }
        };
        let stamp = writer.stamp(received);
        let version = description.as_ref().map(|said| said.major_version());
        let header = data_set_header(writer.expected_sequence(), (stamp, status), version);
        let mut written = encode(&mut encoded, topic, &header, now.utc, &sample);
        let large = encoded.bytes.len() > usize::from(max_datagram);
        if written.is_ok() && large {
            written = check_size(&encoded, max_message)
                .map_err(|error| ((Reason::TooBig, "max_message").into(), error.to_string()));
        }
        if let Err((cause, detail)) = written {
            self.recycle(encoded.bytes);
            return self.refuse(topic, cause, detail);
        }
        let (passage, outpaced) = gate.as_mut().map_or((Passage::Passes, None), |gate| {
            gate.judge(&encoded, latched_by, now.monotonic)
        });
        self.outpaced(topic, outpaced);
        match passage {
            Passage::Passes => self.forward(at, encoded, (received, latched_by), now),
            Passage::Unchanged => {
                self.recycle(encoded.bytes);
                self.refuse(topic, Reason::Unchanged, String::new())
            }
            Passage::TooEarly => {
                if let Some(writer) = self.topics.writer(at) {
                    writer.supersede();
                }
                let gate = self.topics.at_mut(at).and_then(|entry| entry.gate.as_mut());
                let outpaced = gate.and_then(|gate| gate.hold((encoded, latched_by)));
                self.outpaced(topic, outpaced);
                self.schedule(at);
                Verdict::Forward
            }
        }
    }

    /// Counts a waiting sample that a newer sample replaced.
    fn outpaced(&mut self, topic: TopicId, sample: Option<Waiting>) {
        if let Some((outpaced, _)) = sample {
            self.recycle(outpaced.bytes);
            self.count(DropSite::topic(topic), Reason::Outpaced, 1, String::new);
        }
    }

    /// Queues an encoded sample under the next sequence number.
    fn forward(
        &mut self,
        at: Handle,
        mut encoded: EncodedSample,
        (received, latched_by): (Timestamp, Option<PublisherKey>),
        now: Now,
    ) -> Verdict {
        let (max_datagram, _) = self.sizes();
        let large = encoded.bytes.len() > usize::from(max_datagram);
        let muted = self.is_muted();
        let Some(Topic {
            role: TopicSide::Ours(writer),
            lasting,
            confirming,
            ..
        }) = self.topics.at_mut(at)
        else {
            return Verdict::Drop(Reason::Looped);
        };
        // Only a sent message uses up a sequence number.
        let sequence = if muted {
            writer.expected_sequence()
        } else {
            writer.next_sequence()
        };
        encoded.number(sequence);
        let message = if large {
            SampleMessage::Large(Arc::new(encoded))
        } else {
            SampleMessage::Datagram(encoded)
        };
        writer.sent(now.monotonic);
        let is_state = match lasting {
            Lasting::State => true,
            Lasting::Event => false,
            Lasting::AsSource => latched_by.is_some(),
        };
        let is_kept = *lasting != Lasting::Event;
        let gave_way = is_kept && writer.keep((latched_by, is_state), &message);
        let is_confirmed = confirming.is_some();
        writer.send_again(
            &message,
            (is_state, is_kept),
            confirming.as_deref(),
            now.monotonic,
        );
        if is_confirmed {
            self.look_for_confirmers(at);
        }
        if muted {
            self.adopt_followed(at.topic());
        }
        if gave_way {
            self.count(DropSite::topic(at.topic()), Reason::TooManyPublishers, 1, || {
                format!(
                    "it has more than {MAX_KEPT} latched publishers: late subscribers receive only the messages of the most recent publishers"
                )
            });
        }
        self.record_hop(at.topic(), Hop::Out, (received, now.utc));
        self.schedule(at);
        if self.push(at, PolledSample::Message(message)) {
            Verdict::ForwardAfterDroppingOldest
        } else {
            Verdict::Forward
        }
    }

    /// Removes a latched publisher of a topic.
    pub(super) fn left(&mut self, topic: TopicId, publisher: PublisherKey, now: Now) {
        let Some(at) = self.topics.find(topic) else {
            return;
        };
        let gate = self.topics.at_mut(at).and_then(|entry| entry.gate.as_mut());
        let held = gate.and_then(|gate| gate.left(publisher, now.monotonic));
        self.let_go(at, held, now);
        if let Some(writer) = self.topics.writer(at) {
            writer.forget(publisher);
            self.schedule(at);
        }
    }

    /// Sets whether a topic of the own space has a producer. Returns false for other topics.
    pub(super) fn set_live(&mut self, topic: TopicId, live: bool, now: Now) -> bool {
        if !live && let Some(at) = self.topics.find(topic) {
            // The waiting sample is the last sample.
            let gate = self.topics.at_mut(at).and_then(|entry| entry.gate.as_mut());
            let held = gate.and_then(|gate| gate.hurry(now.monotonic));
            self.let_go(at, held, now);
        }
        let at = self.follow(topic, now);
        let Some(Topic {
            role: TopicSide::Ours(writer),
            announce_at,
            ..
        }) = self.topics.at_mut(at)
        else {
            return false;
        };
        let revived = live && !writer.is_live();
        writer.set_live(live);
        if revived {
            *announce_at = announce_at.map(|_| now.monotonic);
        }
        true
    }

    /// Sends a sample that waited.
    pub(super) fn let_go(&mut self, at: Handle, held: Option<Waiting>, now: Now) {
        if let Some((held, latched_by)) = held {
            // `forward` counts drops itself.
            let _verdict = self.forward(at, held, (now.utc, latched_by), now);
        }
    }

    /// Counts a dropped sample of the local side.
    fn refuse(&mut self, topic: TopicId, cause: impl Into<DropCause>, detail: String) -> Verdict {
        let cause = cause.into();
        self.count(DropSite::topic(topic), cause, 1, || detail);
        Verdict::Drop(cause.reason)
    }
}
