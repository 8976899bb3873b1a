//! Confirmations of events: sent for events of other spaces, and awaited for events of this
//! program.

use std::net::SocketAddr;

use mappings::{SpaceId, TopicId};
use uadp::Timestamp;
use uadp::action::ActionMessage;

use super::{DropSite, Router, TopicQueues};
use crate::confirm::{self, ConfirmedArrival, Confirmer, Handover, Mark, Receipt, Reply};
use crate::counters::{Reason, Verdict};
use crate::output::{Output, ValueRelation};
use crate::place::SequencePosition;
use crate::reader::AcceptedMessage;
use crate::settings::Now;
use crate::topic::{Topic, TopicSide};
use crate::topics::Handle;

impl Router {
    /// Returns whether a delivery needs a confirmation. The caller then reports its [`Handover`]
    /// with [`handed`](Self::handed).
    #[must_use]
    pub fn is_to_confirm(&self, topic: TopicId, instance: Option<Timestamp>) -> bool {
        self.values
            .receipt(topic)
            .is_some_and(|receipt| Some(receipt.mark.stamp) == instance)
    }

    /// Handles the handover of a delivery that [needs a confirmation](Self::is_to_confirm). A
    /// delivery that has arrived is confirmed. A delivery without a subscriber is delivered again
    /// when its writer repeats it in time.
    pub fn handed(&mut self, topic: TopicId, instance: Option<Timestamp>, handover: Handover) {
        let Some(reader) = self.values.topics.reader_of(topic) else {
            return;
        };
        let receipt = reader.receipt.as_mut();
        let Some(receipt) = receipt.filter(|receipt| Some(receipt.mark.stamp) == instance) else {
            return;
        };
        receipt.handed(handover);
        let mark = receipt.mark;
        match handover {
            Handover::Done => self.values.send_confirmation(topic, mark),
            Handover::Waiting => {}
            Handover::Nobody => reader.forget(instance),
        }
    }

    /// Handles a confirmation of the space. Returns false for a response to a request.
    pub(super) fn is_confirmation(
        &mut self,
        response: &ActionMessage<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) -> bool {
        let Some((topic, mark)) = confirm::decode(response) else {
            return false;
        };
        // Confirmations go to the whole group.
        let is_own = self.values.settings.source.is_some() && self.values.is_source(from);
        if !self.values.is_home(topic) || is_own {
            return true;
        }
        let Some(writer) = self.values.topics.writer_of(topic) else {
            return true;
        };
        let about = DropSite {
            topic: Some(topic),
            from: Some(from),
        };
        if !writer.is_awaited(mark, space) {
            let cause = (Reason::NotAsked, "confirmation");
            self.values.count_only(about, cause, 1, String::new);
            return true;
        }
        let confirmer = self.values.confirmers.get_mut(&space);
        let counts = confirmer.is_some_and(|of| of.counts(from, now.monotonic));
        let (_, namespace, _) = topic.triple();
        let is_carrier = self.other_parts.is_carrier((space, namespace), from);
        let is_active = self
            .redundant_senders
            .is_active(&self.security, (space, from));
        if !counts && !is_carrier && !is_active {
            // The announcement of the bridge may have been lost.
            self.announcements.probe_applications(now);
            let cause = (Reason::Forged, "confirmation");
            self.values.count_only(about, cause, 1, || {
                format!("{from} confirms for space {space}, but did not announce the space, or another sender announced it first")
            });
            return true;
        }
        if let Some(writer) = self.values.topics.writer_of(topic) {
            writer.confirm(space);
        }
        self.values.settle_arrival(topic);
        true
    }
}

impl TopicQueues {
    fn receipt(&self, topic: TopicId) -> Option<&Receipt> {
        match &self.topics.get(&topic)?.role {
            TopicSide::Theirs(reader) => reader.receipt.as_ref(),
            TopicSide::Ours(_) => None,
        }
    }

    /// Tracks the newest event of a topic that this space confirms, and answers its repetitions.
    /// The repetition of an event without a subscriber is admitted.
    pub(super) fn receive(
        &mut self,
        topic: TopicId,
        place: &SequencePosition,
        admitted: Result<AcceptedMessage, Reason>,
        now: Now,
    ) -> Result<AcceptedMessage, Reason> {
        let own = self.settings.own;
        let waited = self.waited(now);
        let Some(Topic {
            role: TopicSide::Theirs(reader),
            confirming: Some(confirming),
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return admitted;
        };
        let (Some(sequence), Some(stamp)) = (place.sequence, place.instance()) else {
            return admitted;
        };
        if !confirming.spaces.contains(&own) {
            return admitted;
        }
        let mark = Mark { sequence, stamp };
        let reason = match admitted {
            Ok(admitted) => {
                // The time of the sender goes on while the message waits for this program.
                let since = now.monotonic.checked_sub(waited).unwrap_or(now.monotonic);
                reader.receipt = Some(Receipt::new(mark, since));
                return Ok(admitted);
            }
            Err(reason) => reason,
        };
        let receipt = reader.receipt.as_mut();
        let Some(receipt) = receipt.filter(|receipt| receipt.mark == mark) else {
            return Err(reason);
        };
        match receipt.repeated(confirming.within, now.monotonic) {
            Reply::Nothing => {}
            Reply::Confirm => self.send_confirmation(topic, mark),
            Reply::Ask => self.tell(Output::HandoverWanted {
                topic,
                instance: stamp,
            }),
            Reply::HandOver => {
                return Ok(AcceptedMessage {
                    missing: 0,
                    kept: ValueRelation::Alone,
                    lasting: false,
                });
            }
        }
        Err(reason)
    }

    fn send_confirmation(&mut self, topic: TopicId, mark: Mark) {
        let mut bytes = self.buffer();
        match confirm::encode(self.settings.own, (topic, mark), &mut bytes) {
            Ok(()) => self.tell(Output::Action { topic, bytes }),
            Err(error) => {
                self.recycle(bytes);
                self.count(DropSite::topic(topic), Reason::TooBig, 1, || {
                    error.to_string()
                });
            }
        }
    }

    /// Records a sender that announces a space.
    pub(super) fn meet_confirmer(&mut self, space: SpaceId, from: SocketAddr) {
        self.confirmers
            .entry(space)
            .or_insert_with(|| Confirmer::new(from))
            .announced(from);
    }

    /// Probes for applications if a bridge that confirms the newest event is unknown.
    pub(super) fn look_for_confirmers(&mut self, at: Handle) {
        let confirming = self.topics.at(at);
        let confirming = confirming.and_then(|of| of.confirming.as_deref());
        let is_known = |space: &SpaceId| self.confirmers.contains_key(space);
        if confirming.is_some_and(|of| !of.spaces.iter().all(is_known)) {
            self.inquiries.look_for_applications();
        }
    }

    /// Queues the arrival of the newest event of a topic for the port, once it is known.
    pub(super) fn settle_arrival(&mut self, topic: TopicId) {
        let Some(Topic {
            role: TopicSide::Ours(writer),
            counters,
            ..
        }) = self.topics.get_mut(&topic)
        else {
            return;
        };
        if writer.take_news() {
            if let Some(ConfirmedArrival::Unknown(_)) = writer.arrival() {
                // The port logs it.
                counters.add(Reason::Unconfirmed, 1);
            }
            self.settled.push_back(topic);
        }
    }

    /// Returns the next arrival for the port.
    pub(super) fn next_arrival(&mut self) -> Option<Output> {
        while let Some(topic) = self.settled.pop_front() {
            // A newer event is not settled by the arrival of the event before.
            if let Some(Topic {
                role: TopicSide::Ours(writer),
                ..
            }) = self.topics.get(&topic)
                && let Some(arrival) = writer.arrival().cloned()
            {
                return Some(Output::Settled { topic, arrival });
            }
        }
        None
    }

    /// Reports a sample of the local side that is not sent.
    pub(super) fn settle_verdict(&mut self, topic: TopicId, verdict: Verdict) {
        let Verdict::Drop(reason) = verdict else {
            return;
        };
        let entry = self.topics.get(&topic);
        if entry.is_none_or(|entry| entry.confirming.is_none()) {
            return;
        }
        if reason == Reason::Unchanged {
            // The arrival of the previous sample is valid for this sample.
            self.settled.push_back(topic);
        } else {
            self.tell(Output::Settled {
                topic,
                arrival: ConfirmedArrival::NotSent,
            });
        }
    }
}
