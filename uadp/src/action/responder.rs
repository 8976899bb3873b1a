//! The Responder: executes each request at most once, and repeats its response on request.

mod entry;
mod over;
mod refused;
mod settings;
mod space;

use alloc::collections::{BTreeMap, BTreeSet};
use core::hash::{Hash, Hasher};
use core::time::Duration;

use super::sending::KeptFields;
use super::timers::Timers;
use super::{
    ActionDialect, ActionFields, ActionHeader, ActionKind, ActionMessage, ActionOutcome,
    ActionState, ActionToSend, Refusal,
};
use crate::hashing::DefaultHasher;
use crate::{OwnedPublisherId, StatusCode};
use entry::{ActionRequestKey, Phase, RequestEntry};
use over::Over;
use refused::{RefusalResponse, RefusedRequests};
pub use settings::{
    ExecutionId, FinishRefusal, RequestDrop, RequestOrigin, RequiredAction, ResponderCounters,
    ResponderSettings,
};
use space::{RequestSpace, SpaceLeft};

/// Responds to requests over a network that can lose, duplicate, delay and reorder messages
/// (OPC 10000-14, 6.2.11.2.2).
///
/// A request is identified by RequestorId, CorrelationData and RequestId, and executed at most
/// once. The owner of the Responder executes the requests that
/// [`handle_request`](Self::handle_request) returns, and reports the results with
/// [`finish`](Self::finish) or [`refuse`](Self::refuse). Until then the Responder sends Executing
/// at every publishing interval. Afterwards it sends Done, until the Requestor requests Idle or
/// Done was repeated [`done_repeats`](ResponderSettings::done_repeats) times. It also responds to
/// repetitions, at most once per interval.
///
/// A request is remembered for [`remember`](ResponderSettings::remember) after its last message,
/// including refused and acknowledged requests. A request is executed again if the network
/// duplicates and delays it for longer, or if it is repeated to a restarted Responder. With message
/// security, [`Opener`](crate::Opener) accepts no message twice, however late.
///
/// When space is short, only a few bytes of each finished request are kept, so that thousands of
/// requests per second can be remembered. Such requests are not acknowledged again. If there is no
/// space to remember a request, it is dropped without response: a repetition of a refused and
/// forgotten request could be executed.
///
/// The owner decides where responses go. `P` is the address to send to, passed with the request. If
/// the owner responded to the address in the request, any sender could direct responses to other
/// hosts.
///
/// Each [`RequestOrigin`] has separate limits, independent of the RequestorId in the request: a
/// sender cannot exhaust the space of other senders, and a group of senders cannot exhaust the
/// space of another group. A request that the owner refuses in
/// [`handle_judged`](Self::handle_judged) is remembered by its hash and gets one response.
///
/// A peer with [`ActionDialect::UaNetStandard`] gets one response without repetition. Its messages
/// have no status, so an outcome that needs a status is not sent.
///
/// `now` counts from any fixed time.
/// ```
/// use std::time::Duration;
/// use uadp::action::{
///     ActionAddress, ActionDialect, ActionFields, ActionRequest, ResponseMeaning, ActionOutcome,
///     RequiredAction, Requestor, RequestorSettings, Responder, ResponderSettings, }; use
///     uadp::{Extras, NetworkHeader, NetworkMessage, OwnedPublisherId, StatusCode};
///
/// const STANDARD: ActionDialect = ActionDialect::Standard;
/// let mut requestor = Requestor::new(OwnedPublisherId::UInt16(1), [7; 16], RequestorSettings::default());
/// let mut responder = Responder::new(ResponderSettings::default());
/// let address = ActionAddress {
///     publisher_id: OwnedPublisherId::UInt16(2),
///     writer_group_id: Some(5),
///     writer_id: 61,
///     target_id: 1,
/// };
/// let now = Duration::ZERO;
/// let request = ActionRequest {
///     address,
///     dialect: STANDARD,
///     fields: ActionFields::NONE,
///     timeout: Duration::from_secs(3),
/// };
/// let call = requestor.call(request, now)?;
///
/// let mut datagram = Vec::new();
/// let request = requestor.poll_transmit(now).unwrap();
/// request.encode(&mut datagram, &NetworkHeader::default(), &Extras::default())?.finish()?;
///
/// let received = NetworkMessage::decode(&datagram)?;
/// let request = received.actions(STANDARD)?.next().unwrap()?;
/// let RequiredAction::Execute(execution) = responder.handle_request(&request, "the group", now)?
/// else { panic!("a new request"); }; let answer = ActionOutcome::Answered { status:
/// StatusCode::GOOD, fields: ActionFields::NONE }; responder.finish(execution, answer, now)?;
///
/// datagram.clear();
/// let (to, response) = responder.poll_transmit(now).unwrap();
/// assert_eq!(*to, "the group");
/// response.encode(&mut datagram, &NetworkHeader::default(), &Extras::default())?.finish()?;
///
/// let received = NetworkMessage::decode(&datagram)?;
/// let response = received.actions(STANDARD)?.next().unwrap()?;
/// assert_eq!(requestor.handle_response(&response, now)?, ResponseMeaning::Done(call, answer));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Responder<P> {
    settings: ResponderSettings,
    next: u64,
    entries: BTreeMap<u64, RequestEntry<P>>,
    ids: BTreeMap<ActionRequestKey, u64>,
    timers: Timers,
    /// The space that the entries use.
    space: RequestSpace<P>,
    /// Finished requests of which only a hash is kept.
    over: Over<P>,
    /// Requests that were refused before space was allocated.
    refused: RefusedRequests<P>,
    /// The response to a refused request that is being sent.
    answer: Option<RefusalResponse<P>>,
    /// Executions past their deadline that were not yet polled.
    overdue: BTreeSet<u64>,
    counters: ResponderCounters,
}

impl<P: Ord + Clone> Responder<P> {
    /// Creates a Responder without requests.
    #[must_use]
    pub fn new(settings: ResponderSettings) -> Self {
        Self {
            settings,
            next: 0,
            entries: BTreeMap::new(),
            ids: BTreeMap::new(),
            timers: Timers::new(),
            space: RequestSpace::new(),
            over: Over::new(),
            refused: RefusedRequests::new(),
            answer: None,
            overdue: BTreeSet::new(),
            counters: ResponderCounters::default(),
        }
    }

    /// Handles a request and responds to `reply_to`. The response to a repetition goes to
    /// the address of the first request.
    ///
    /// # Errors
    /// The reason why the request was dropped without response.
    pub fn handle_request(
        &mut self,
        request: &ActionMessage<'_>,
        reply_to: P,
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        let origin = RequestOrigin {
            group: 0,
            sender: reply_to,
        };
        self.handle_judged(request, (origin, Ok(())), now)
    }

    /// Handles a request as [`handle_request`](Self::handle_request), with the owner's verdict on a
    /// new request. A refused request is remembered by its hash and gets one response. Its
    /// repetitions get a response up to [`refusal_repeats`](ResponderSettings::refusal_repeats)
    /// times. The verdict does not apply to a known request.
    ///
    /// # Errors
    /// The reason why the request was dropped without response.
    pub fn handle_judged(
        &mut self,
        request: &ActionMessage<'_>,
        (origin, verdict): (RequestOrigin<P>, Result<(), Refusal>),
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        self.handle_timeout(now);
        let requested = self.hear(request, (origin, verdict), now);
        match requested {
            Ok(RequiredAction::Execute(_)) => self.counters.executed += 1,
            Ok(RequiredAction::Refused(..) | RequiredAction::Declined(_)) => {
                self.counters.refused += 1
            }
            Ok(RequiredAction::Repeated(_)) => self.counters.repeated += 1,
            Ok(RequiredAction::Abandoned(_)) => self.counters.abandoned += 1,
            Ok(RequiredAction::Closed(_)) => self.counters.closed += 1,
            Err(_) => self.counters.dropped += 1,
        }
        requested
    }

    /// Sets the outcome of an execution, which is sent to the Requestor.
    ///
    /// # Errors
    /// The reason why the outcome is not sent.
    pub fn finish(
        &mut self,
        execution: ExecutionId,
        outcome: ActionOutcome<'_>,
        now: Duration,
    ) -> Result<(), FinishRefusal> {
        self.handle_timeout(now);
        let id = execution.0;
        let entry = self.entries.get(&id).ok_or(FinishRefusal::Forgotten)?;
        let Phase::Executing { abandoned, .. } = entry.phase else {
            return Err(FinishRefusal::Finished);
        };
        let dialect = entry.dialect;
        let entry_said = entry.last_sent.is_some();
        let (mut status, mut fields) = outcome.to_response();
        let mut told = Ok(());
        if abandoned {
            (status, fields) = (StatusCode::GOOD, ActionFields::NONE);
            told = Err(FinishRefusal::Abandoned);
        } else if !is_written_in(dialect, fields) {
            (status, fields) = (BAD_ENCODING_ERROR, ActionFields::NONE);
            told = Err(FinishRefusal::Encoding);
        } else if !self.has_room_for(id, fields.bytes().len()) {
            (status, fields) = (BAD_RESPONSE_TOO_LARGE, ActionFields::NONE);
            told = Err(FinishRefusal::TooBig);
        }
        if told.is_ok() && dialect != ActionDialect::Standard && status != StatusCode::GOOD {
            told = Err(FinishRefusal::NoStatus);
        }
        // A Requestor without a response repeats its request, and each repetition gets a response.
        let is_repeated = entry_said || !matches!(outcome, ActionOutcome::Refused(_));
        let repeats = if is_repeated {
            self.settings.done_repeats
        } else {
            ONCE
        };
        self.conclude(id, (status, fields), repeats, now);
        told
    }

    /// Refuses to execute a request.
    ///
    /// # Errors
    /// As [`finish`](Self::finish).
    pub fn refuse(
        &mut self,
        execution: ExecutionId,
        refusal: Refusal,
        now: Duration,
    ) -> Result<(), FinishRefusal> {
        self.finish(execution, ActionOutcome::Refused(refusal), now)
    }

    /// Removes expired requests, and records executions that are past their deadline.
    pub fn handle_timeout(&mut self, now: Duration) {
        self.over.forget_until(now);
        self.refused.forget_until(now);
        while let Some(id) = self.timers.due(now) {
            let Some(entry) = self.entries.get_mut(&id) else {
                return;
            };
            if now >= entry.expires(self.settings.remember) {
                if let Phase::Executing { .. } = entry.phase {
                    self.counters.lost += 1;
                }
                self.forget(id);
                continue;
            }
            if entry.is_overdue(now) {
                self.overdue.insert(id);
            }
            if entry.next_send.is_some_and(|at| at <= now) {
                return;
            }
            self.schedule(id);
        }
    }

    /// Returns the next response that is due, and its destination.
    pub fn poll_transmit(&mut self, now: Duration) -> Option<(&P, ActionToSend<'_>)> {
        self.handle_timeout(now);
        if let Some(answer) = self.refused.pop() {
            self.counters.sent += 1;
            let answer = self.answer.insert(answer);
            return Some((&answer.origin.sender, answer.to_send()));
        }
        let id = self.timers.due(now)?;
        let interval = self.interval();
        self.entries.get_mut(&id)?.sent(now, interval);
        self.schedule(id);
        self.counters.sent += 1;
        let entry = self.entries.get(&id)?;
        let (state, status, fields) = match &entry.phase {
            Phase::Executing { .. } => (ActionState::Executing, None, ActionFields::NONE),
            Phase::Done { status, fields, .. } => {
                (ActionState::Done, Some(status.status()), fields.as_fields())
            }
            Phase::Closed => (ActionState::Idle, None, ActionFields::NONE),
        };
        let response = ActionToSend {
            address: &entry.address,
            action: ActionHeader {
                correlation_data: entry.key.correlation_data.as_deref(),
                requestor_id: entry.key.requestor_id.as_ref().map(OwnedPublisherId::as_id),
                ..ActionHeader::new(ActionKind::Response)
            },
            left: None,
            request_id: entry.key.request_id,
            call: id,
            state,
            status: match entry.dialect {
                ActionDialect::Standard => status,
                ActionDialect::UaNetStandard(_) => None,
            },
            fields,
            dialect: entry.dialect,
        };
        Some((&entry.origin.sender, response))
    }

    /// Returns an execution that is past its deadline, so that its Requestor has stopped waiting.
    /// Each execution is returned once and may still be finished.
    pub fn poll_overdue(&mut self) -> Option<ExecutionId> {
        self.overdue.pop_first().map(ExecutionId)
    }

    /// Returns the time of the next call of [`poll_transmit`](Self::poll_transmit).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        let next = self.timers.next();
        next.into_iter().chain(self.refused.due()).min()
    }

    /// Returns the number of remembered requests and the bytes that they use.
    #[must_use]
    pub fn held(&self) -> (usize, usize) {
        let (over, refused) = (self.over.len(), self.refused.len());
        let (requests, bytes) = self.space.used();
        (
            requests + over + refused,
            bytes + (over + refused) * over::COST,
        )
    }

    /// Returns the counters.
    #[must_use]
    pub const fn counters(&self) -> &ResponderCounters {
        &self.counters
    }

    fn hear(
        &mut self,
        request: &ActionMessage<'_>,
        (origin, verdict): (RequestOrigin<P>, Result<(), Refusal>),
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        if request.action.kind == ActionKind::Response {
            return Err(RequestDrop::Response);
        }
        let correlation_data = request.action.correlation_data.unwrap_or_default();
        if correlation_data.len() > self.settings.max_correlation_data {
            return Err(RequestDrop::CorrelationData(correlation_data.len()));
        }
        let key = ActionRequestKey::of(request);
        let known = self.ids.get(&key).copied();
        match (request.state, known) {
            (ActionState::Done, _) => Err(RequestDrop::State),
            (_, None) if self.over.has(&key) => Err(RequestDrop::Over),
            (ActionState::Idle, _) if request.dialect != ActionDialect::Standard => {
                Err(RequestDrop::State)
            }
            (ActionState::Executing, Some(id)) => self.repeated(id, request, now),
            (ActionState::Idle, Some(id)) => self.acknowledged(id, request, now),
            (ActionState::Executing | ActionState::Idle, None) => {
                match self.refused.repeated(&key, request, &self.settings, now) {
                    Some(dropped) => Err(dropped),
                    None => match verdict {
                        Ok(()) => self.admit(key, (request, origin), now),
                        Err(refusal) => {
                            let to = (origin, refusal);
                            self.refused.refuse(key, (request, to), &self.settings, now)
                        }
                    },
                }
            }
        }
    }

    /// Admits a new request.
    fn admit(
        &mut self,
        key: ActionRequestKey,
        (request, origin): (&ActionMessage<'_>, RequestOrigin<P>),
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        let cost = key.cost();
        self.make_room(&origin, cost)?;
        let settings = &self.settings;
        let is_busy = self.space.is_busy(&origin, settings);
        let id = self.next;
        self.next += 1;
        let execution = ExecutionId(id);
        let (phase, requested) = match request.state {
            // An Idle request ends a request that is lost or still under way, which is then never
            // executed.
            ActionState::Idle | ActionState::Done => {
                (Phase::Closed, RequiredAction::Closed(execution))
            }
            ActionState::Executing if is_busy => {
                let busy = Refusal::Busy;
                let phase = Phase::done(busy.status_code(), ActionFields::NONE, ONCE);
                (phase, RequiredAction::Refused(execution, busy))
            }
            ActionState::Executing => {
                let hint = request.action.timeout();
                let timeout = hint.map_or(settings.timeout, |hint| hint.min(settings.max_timeout));
                let phase = Phase::Executing {
                    deadline: now.saturating_add(timeout),
                    abandoned: false,
                    overdue: false,
                };
                (phase, RequiredAction::Execute(execution))
            }
        };
        self.space.admit(&origin, (id, &phase), cost);
        let interval = self.interval();
        let mut entry = RequestEntry {
            key: key.clone(),
            address: request.into(),
            dialect: request.dialect,
            origin,
            arguments: fingerprint(request),
            next_send: None,
            phase,
            touched: now,
            last_sent: None,
            answer_bytes: 0,
            wake: now,
        };
        entry.answer(now, interval);
        self.ids.insert(key, id);
        self.entries.insert(id, entry);
        self.schedule(id);
        Ok(requested)
    }

    /// Makes space for a request by reducing closed requests to their hashes.
    fn make_room(&mut self, origin: &RequestOrigin<P>, cost: usize) -> Result<(), RequestDrop> {
        let settings = self.settings;
        loop {
            match self.space.of_sender(origin, cost, &settings) {
                SpaceLeft::Enough => break,
                SpaceLeft::Behind(oldest) => self.shrink(oldest)?,
                SpaceLeft::Full => return Err(RequestDrop::SenderFull),
            }
        }
        loop {
            match self.space.of_group(origin, cost, &settings) {
                SpaceLeft::Enough => return Ok(()),
                // The sender has space, but its group does not.
                SpaceLeft::Behind(oldest) => {
                    self.shrink(oldest).map_err(|_| RequestDrop::Full)?;
                }
                SpaceLeft::Full => return Err(RequestDrop::Full),
            }
        }
    }

    /// Reduces a closed request to its hash.
    fn shrink(&mut self, id: u64) -> Result<(), RequestDrop> {
        let entry = self.entries.get(&id).ok_or(RequestDrop::Full)?;
        let until = entry.expires(self.settings.remember);
        let of = (&entry.key, &entry.origin);
        self.over.keep(of, until, &self.settings)?;
        self.forget(id);
        Ok(())
    }

    /// Handles a repetition of a known request.
    fn repeated(
        &mut self,
        id: u64,
        request: &ActionMessage<'_>,
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        let interval = self.interval();
        let entry = self.entries.get_mut(&id).ok_or(RequestDrop::Full)?;
        let arguments = fingerprint(request);
        // The arguments of a request that was ended before it was received are unknown.
        let same = entry.arguments == arguments || matches!(entry.phase, Phase::Closed);
        if !entry.address.is_of(request) || entry.dialect != request.dialect || !same {
            return Err(RequestDrop::Reused);
        }
        entry.touched = now;
        match entry.phase {
            Phase::Executing { .. } | Phase::Done { .. } => entry.answer(now, interval),
            // A late repetition: the request was acknowledged or ended.
            Phase::Closed => {}
        }
        self.schedule(id);
        Ok(RequiredAction::Repeated(ExecutionId(id)))
    }

    /// Handles an Idle request: the Requestor has the response, or does not want it.
    fn acknowledged(
        &mut self,
        id: u64,
        request: &ActionMessage<'_>,
        now: Duration,
    ) -> Result<RequiredAction, RequestDrop> {
        let interval = self.interval();
        let entry = self.entries.get_mut(&id).ok_or(RequestDrop::Full)?;
        if !entry.address.is_of(request) || entry.dialect != request.dialect {
            return Err(RequestDrop::Reused);
        }
        entry.touched = now;
        let execution = ExecutionId(id);
        let requested = match &mut entry.phase {
            Phase::Executing { abandoned, .. } => {
                let first = !core::mem::replace(abandoned, true);
                entry.answer(now, interval);
                if first {
                    RequiredAction::Abandoned(execution)
                } else {
                    RequiredAction::Repeated(execution)
                }
            }
            Phase::Done { .. } => {
                entry.phase = Phase::Closed;
                entry.last_sent = None;
                entry.next_send = None;
                entry.answer(now, interval);
                self.closed(id);
                RequiredAction::Closed(execution)
            }
            Phase::Closed => {
                entry.answer(now, interval);
                RequiredAction::Repeated(execution)
            }
        };
        self.schedule(id);
        Ok(requested)
    }

    /// Ends an execution with a status and fields.
    fn conclude(
        &mut self,
        id: u64,
        (status, fields): (StatusCode, ActionFields<'_>),
        repeats: u32,
        now: Duration,
    ) {
        let Some(entry) = self.entries.get_mut(&id) else {
            return;
        };
        self.overdue.remove(&id);
        entry.touched = now;
        let Phase::Executing { abandoned, .. } = entry.phase else {
            return;
        };
        if abandoned {
            entry.phase = Phase::Closed;
            entry.next_send = None;
            self.space.conclude(&entry.origin, 0);
            self.closed(id);
        } else {
            let bytes = fields.bytes().len();
            entry.answer_bytes = bytes;
            entry.phase = Phase::done(status, fields, repeats);
            // The result is due immediately, even if Executing was sent within this interval.
            entry.last_sent = None;
            entry.next_send = None;
            entry.answer(now, Duration::ZERO);
            self.space.conclude(&entry.origin, bytes);
        }
        self.schedule(id);
    }

    fn has_room_for(&self, id: u64, bytes: usize) -> bool {
        let entry = self.entries.get(&id);
        entry.is_some_and(|entry| {
            self.space
                .has_room_for(&entry.origin, bytes, &self.settings)
        })
    }

    /// Closes a request: its response is not requested again, so the bytes of the response are
    /// freed.
    fn closed(&mut self, id: u64) {
        if let Some(entry) = self.entries.get_mut(&id) {
            let bytes = core::mem::take(&mut entry.answer_bytes);
            self.space.close(&entry.origin, id, bytes);
        }
    }

    fn forget(&mut self, id: u64) {
        let Some(entry) = self.entries.remove(&id) else {
            return;
        };
        self.timers.remove(id, entry.wake);
        self.ids.remove(&entry.key);
        self.overdue.remove(&id);
        let bytes = entry.key.cost() + entry.answer_bytes;
        self.space.forget(&entry.origin, (id, &entry.phase), bytes);
    }

    fn schedule(&mut self, id: u64) {
        let remember = self.settings.remember;
        if let Some(entry) = self.entries.get_mut(&id) {
            let next = entry.next_wake(remember);
            self.timers.move_to(id, &mut entry.wake, next);
        }
    }

    fn interval(&self) -> Duration {
        self.settings.publishing_interval.max(LEAST_INTERVAL)
    }
}

/// Returns a hash that detects different arguments with the same ids.
fn fingerprint(request: &ActionMessage<'_>) -> u64 {
    let mut hasher = DefaultHasher::new();
    request.fields.hash(&mut hasher);
    hasher.finish()
}

/// Returns true if the dialect supports the encoding of the fields.
fn is_written_in(dialect: ActionDialect, fields: ActionFields<'_>) -> bool {
    use super::ActionEncoding::{RawData, Variant};
    match (dialect, fields) {
        (
            ActionDialect::Standard | ActionDialect::UaNetStandard(Variant),
            ActionFields::Variants(block),
        ) => block.len() >= 2,
        (ActionDialect::Standard, ActionFields::RawData { count, .. }) => count.is_some(),
        (ActionDialect::UaNetStandard(RawData), ActionFields::RawData { .. }) => true,
        // An empty field list is valid in either encoding.
        (ActionDialect::UaNetStandard(RawData), ActionFields::Variants(block)) => block == [0, 0],
        (ActionDialect::UaNetStandard(Variant), ActionFields::RawData { .. }) => false,
    }
}

const BAD_ENCODING_ERROR: StatusCode = StatusCode(0x8006_0000);
const BAD_RESPONSE_TOO_LARGE: StatusCode = StatusCode(0x80B9_0000);

/// Number of unprompted repetitions of a response that only a repeated request triggers again.
const ONCE: u32 = 0;

/// Minimum of the publishing interval, which prevents endless sending at an interval of 0.
const LEAST_INTERVAL: Duration = Duration::from_millis(1);
