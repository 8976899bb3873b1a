//! Requests that are refused before space is allocated. Enough of each is kept to repeat the
//! refusal, and to execute no repetition even if the owner permits it by then.

use alloc::collections::VecDeque;
use core::time::Duration;

use super::entry::ActionRequestKey;
use super::over::{RequestCounts, hash};
use super::{RequestDrop, RequestOrigin, RequiredAction, ResponderSettings};
use crate::OwnedPublisherId;
use crate::action::{
    ActionAddress, ActionDialect, ActionFields, ActionHeader, ActionKind, ActionMessage,
    ActionState, ActionToSend, Refusal,
};
use crate::hashing::HashMap;

/// Refused requests, by the hash of their key.
#[derive(Debug)]
pub(super) struct RefusedRequests<P> {
    known: HashMap<u64, RefusedEntry<P>>,
    /// Expiry times and hashes in the order of insertion.
    queue: VecDeque<(Duration, u64)>,
    counts: RequestCounts<P>,
    /// Responses to send, at most one for each refused request.
    answers: VecDeque<RefusalResponse<P>>,
}

#[derive(Debug)]
struct RefusedEntry<P> {
    origin: RequestOrigin<P>,
    refusal: Refusal,
    /// Time of the last response.
    answered: Duration,
    /// Remaining number of responses to repetitions.
    left: u8,
}

/// A response to a refused request.
#[derive(Debug)]
pub(super) struct RefusalResponse<P> {
    pub(super) origin: RequestOrigin<P>,
    key: ActionRequestKey,
    address: ActionAddress,
    state: ActionState,
    status: Option<u16>,
    due: Duration,
}

impl<P> RefusalResponse<P> {
    pub(super) fn to_send(&self) -> ActionToSend<'_> {
        ActionToSend {
            address: &self.address,
            action: ActionHeader {
                correlation_data: self.key.correlation_data.as_deref(),
                requestor_id: self.key.requestor_id.as_ref().map(OwnedPublisherId::as_id),
                ..ActionHeader::new(ActionKind::Response)
            },
            left: None,
            request_id: self.key.request_id,
            // A response without fields fits every datagram, so no chunk needs a sequence number.
            call: u64::MAX,
            state: self.state,
            status: self.status,
            fields: ActionFields::NONE,
            dialect: ActionDialect::Standard,
        }
    }
}

impl<P: Ord + Clone> RefusedRequests<P> {
    pub(super) fn new() -> Self {
        Self {
            known: HashMap::new(),
            queue: VecDeque::new(),
            counts: RequestCounts::new(),
            answers: VecDeque::new(),
        }
    }

    /// Refuses a new request.
    pub(super) fn refuse(
        &mut self,
        key: ActionRequestKey,
        (request, (origin, refusal)): (&ActionMessage<'_>, (RequestOrigin<P>, Refusal)),
        settings: &ResponderSettings,
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        let limits = (settings.max_refused, settings.max_refused_per_sender);
        self.counts.check(&origin, limits)?;
        let hash = hash(&key);
        let until = now.saturating_add(settings.remember);
        self.counts.add(&origin);
        self.queue.push_back((until, hash));
        let known = RefusedEntry {
            origin: origin.clone(),
            refusal,
            answered: now,
            left: settings.refusal_repeats,
        };
        self.known.insert(hash, known);
        self.answer((key, origin, refusal), request, now);
        Ok(RequiredAction::Declined(refusal))
    }

    /// Responds to a repetition of a refused request; returns `None` for any other request.
    pub(super) fn repeated(
        &mut self,
        key: &ActionRequestKey,
        request: &ActionMessage<'_>,
        settings: &ResponderSettings,
        now: Duration,
    ) -> Option<RequestDrop> {
        if self.known.is_empty() {
            return None;
        }
        let known = self.known.get_mut(&hash(key))?;
        let again = known.answered.saturating_add(settings.publishing_interval);
        // The acknowledgement follows immediately, and gets a response like a repetition.
        let is_due = now >= again || request.state == ActionState::Idle;
        if known.left > 0 && is_due {
            known.left -= 1;
            known.answered = now;
            let answer = (key.clone(), known.origin.clone(), known.refusal);
            self.answer(answer, request, now);
        }
        Some(RequestDrop::Refused)
    }

    /// Queues the refusal, or the response to an acknowledgement. The UA-.NETStandard dialect has
    /// no field for a status.
    fn answer(
        &mut self,
        (key, origin, refusal): (ActionRequestKey, RequestOrigin<P>, Refusal),
        request: &ActionMessage<'_>,
        now: Duration,
    ) {
        if request.dialect != ActionDialect::Standard {
            return;
        }
        let (state, status) = match request.state {
            ActionState::Idle => (ActionState::Idle, None),
            ActionState::Executing | ActionState::Done => {
                (ActionState::Done, Some(refusal.status_code().status()))
            }
        };
        self.answers.push_back(RefusalResponse {
            origin,
            key,
            address: request.into(),
            state,
            status,
            due: now,
        });
    }

    /// Returns the next response.
    pub(super) fn pop(&mut self) -> Option<RefusalResponse<P>> {
        self.answers.pop_front()
    }

    /// Returns the time at which the next response is due.
    pub(super) fn due(&self) -> Option<Duration> {
        Some(self.answers.front()?.due)
    }

    /// Removes expired requests.
    pub(super) fn forget_until(&mut self, now: Duration) {
        while let Some((until, _)) = self.queue.front()
            && *until <= now
            && let Some((_, hash)) = self.queue.pop_front()
        {
            if let Some(known) = self.known.remove(&hash) {
                self.counts.remove(&known.origin);
            }
        }
    }

    pub(super) fn len(&self) -> usize {
        self.queue.len()
    }
}
