//! The Requestor: repeats each request until the Responder reacts, and ends each call.

use alloc::boxed::Box;
use alloc::collections::{BTreeMap, VecDeque};
use core::time::Duration;

use super::sending::KeptFields;
use super::timers::Timers;
use super::{
    ActionAddress, ActionDialect, ActionEncoding, ActionFields, ActionHeader, ActionKind,
    ActionMessage, ActionOutcome, ActionState, ActionToSend, Unknown,
};
use crate::{DecodeError, Fields, OwnedPublisherId};

/// Calls Actions over a network that can lose, duplicate, delay and reorder messages (OPC 10000-14,
/// 6.2.11.2.2).
///
/// The Requestor repeats a request at the publishing interval until it receives the first response.
/// After that it stops: the Responder repeats its state by itself, and a Responder that has
/// forgotten the request must not execute it again. The Requestor acknowledges a response with
/// ActionState Idle until the Responder is idle too, at most
/// [`idle_repeats`](RequestorSettings::idle_repeats) times. Every call ends, at its deadline at the
/// latest, with one [`ActionOutcome`]: from [`handle_response`](Self::handle_response), or from
/// [`poll_given_up`](Self::poll_given_up) if it is unknown. The Requestor then asks the Responder
/// to forget the call.
///
/// With [`ActionDialect::UaNetStandard`] a request is sent once, because the peer executes every
/// repetition.
///
/// `now` counts from any fixed time. The caller polls until nothing more is due:
/// ```
/// use std::time::Duration;
/// use uadp::action::{
///     ActionAddress, ActionDialect, ActionFields, ActionRequest, Requestor, RequestorSettings,
/// };
/// use uadp::{Extras, NetworkHeader, NetworkMessage, OwnedPublisherId};
///
/// let own = OwnedPublisherId::UInt16(1);
/// let mut requestor = Requestor::new(own, [7; 16], RequestorSettings::default()); // 16 random bytes
/// let address = ActionAddress {
///     publisher_id: OwnedPublisherId::UInt16(2),
///     writer_group_id: Some(5),
///     writer_id: 61,
///     target_id: 1,
/// };
/// let request = ActionRequest {
///     address,
///     dialect: ActionDialect::Standard,
///     fields: ActionFields::NONE,
///     timeout: Duration::from_secs(3),
/// };
/// let now = Duration::ZERO;
/// let call = requestor.call(request, now)?;
///
/// let mut datagram = Vec::new();
/// while let Some(request) = requestor.poll_transmit(now) {
///     request.encode(&mut datagram, &NetworkHeader::default(), &Extras::default())?.finish()?;
/// }
/// assert!(NetworkMessage::decode(&datagram)?.is_action());
/// assert_eq!(requestor.poll_timeout(), Some(Duration::from_millis(100)));
///
/// // No responder answers.
/// requestor.handle_timeout(Duration::from_secs(3));
/// assert_eq!(requestor.poll_given_up().map(|(id, _)| id), Some(call));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Requestor {
    id: OwnedPublisherId,
    settings: RequestorSettings,
    instance: [u8; INSTANCE],
    next: u64,
    calls: BTreeMap<u64, Call>,
    timers: Timers,
    given_up: VecDeque<(CallId, Unknown)>,
    /// Total bytes of the arguments of all calls.
    held: usize,
    /// CorrelationData of the request being sent.
    correlation_data: [u8; CORRELATION_DATA],
    counters: RequestorCounters,
}

/// Timing and limits of a [`Requestor`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RequestorSettings {
    /// PublishingInterval of the Responder's WriterGroup; requests are repeated at this interval.
    /// Default 100 ms.
    pub publishing_interval: Duration,
    /// Time without a message after which the Responder is considered lost. [`Duration::MAX`]
    /// leaves this to the deadline, for Responders that do not repeat Executing. Default 2 s.
    pub receive_timeout: Duration,
    /// Maximum number of transmissions of an acknowledgement. Default 5.
    pub idle_repeats: u8,
    /// ResponseAddress of the requests. With `None` the Responder chooses the address. Default
    /// `None`.
    pub response_address: Option<Box<str>>,
    /// Number of argument bytes above which all repetitions of a request are identical, so that
    /// chunks of one repetition replace lost chunks of another (OPC 10000-14, 7.2.4.4.4). Default
    /// 1000.
    pub large: usize,
    /// Maximum number of open calls, including calls that wait for their acknowledgement, and
    /// outcomes that were not polled. Default 1024.
    pub max_calls: usize,
    /// Maximum number of argument bytes of all calls. Default 4 MiB.
    pub max_bytes: usize,
}

/// Input of [`Requestor::call`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionRequest<'a> {
    /// Responder and target.
    pub address: ActionAddress,
    /// Dialect of the Responder.
    pub dialect: ActionDialect,
    /// Encoded arguments.
    pub fields: ActionFields<'a>,
    /// Time to wait for the response. Each request carries the remaining time as its TimeoutHint;
    /// [large](RequestorSettings::large) requests always carry the remaining time of their first
    /// transmission.
    pub timeout: Duration,
}

/// Identifies a call within its [`Requestor`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CallId(u64);

/// Meaning of a response.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ResponseMeaning<'a> {
    /// The Responder has received the request and is executing it.
    Executing(CallId),
    /// The call is finished.
    Done(CallId, ActionOutcome<'a>),
    /// The Responder has forgotten a finished call.
    Closed(CallId),
}

/// Reason why a call was not started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CallRefusal {
    /// The limit [`RequestorSettings::max_calls`] is reached.
    #[error("the limit of {0} simultaneous calls is reached")]
    TooManyCalls(usize),
    /// The arguments would exceed [`RequestorSettings::max_bytes`].
    #[error("{bytes} bytes of arguments exceed the limit")]
    TooManyBytes {
        /// Total argument bytes, including the new call.
        bytes: usize,
    },
    /// The timeout is 0.
    #[error("a timeout of 0")]
    NoTime,
    /// The arguments are not a valid block of Variants.
    #[error("arguments: {0}")]
    Malformed(DecodeError),
    /// The dialect does not support the encoding of the arguments, or requires a FieldCount for
    /// RawData.
    #[error("the peer does not support the encoding of the arguments")]
    Encoding,
}

/// Reason why a response was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ResponseDrop {
    /// The message is a request.
    #[error("a request")]
    Request,
    /// The response belongs to another Requestor, or to an earlier instance of this Requestor.
    #[error("a response to another requestor")]
    Foreign,
    /// No open call has this id.
    #[error("a response to an unknown call")]
    NoCall,
    /// The response has another address or dialect than the call.
    #[error("a response from another address")]
    Elsewhere,
    /// The call has its response already.
    #[error("a repeated response")]
    Repeated,
    /// The call was given up.
    #[error("a late response")]
    Late,
    /// The state is not valid in the present phase.
    #[error("an unexpected state")]
    State,
}

/// Counters of calls and messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct RequestorCounters {
    /// Started calls.
    pub calls: u64,
    /// Requests returned for sending, including acknowledgements and repetitions.
    pub sent: u64,
    /// Repetitions among the sent requests.
    pub repeated: u64,
    /// Calls that were executed or refused.
    pub answered: u64,
    /// Calls with unknown outcome.
    pub unknown: u64,
    /// Calls abandoned by the caller.
    pub abandoned: u64,
    /// Acknowledgements without response.
    pub unacknowledged: u64,
    /// Dropped responses.
    pub dropped: u64,
}

#[derive(Debug)]
struct Call {
    address: ActionAddress,
    dialect: ActionDialect,
    /// Empty if only the acknowledgement is pending.
    fields: KeptFields,
    phase: Phase,
    next_send: Option<Duration>,
    sent: bool,
    wake: Duration,
}

#[derive(Debug, Clone, Copy)]
enum Phase {
    /// The Requestor requests Executing.
    Asking {
        deadline: Duration,
        /// Time at which the Responder is considered lost.
        silent: Duration,
        /// TimeoutHint of a large request after its first transmission.
        hint: Option<f64>,
    },
    /// The Requestor requests Idle, `left` more times.
    Closing { left: u8, given_up: bool },
}

impl Default for RequestorSettings {
    fn default() -> Self {
        Self {
            publishing_interval: Duration::from_millis(100),
            receive_timeout: Duration::from_secs(2),
            idle_repeats: 5,
            response_address: None,
            large: 1000,
            max_calls: 1024,
            max_bytes: 4 << 20,
        }
    }
}

impl Requestor {
    /// Sets [`RequestorSettings::receive_timeout`]. It applies to new calls, and to open calls from
    /// the next response on.
    pub const fn set_receive_timeout(&mut self, receive_timeout: Duration) {
        self.settings.receive_timeout = receive_timeout;
    }

    /// Creates a Requestor without calls. `instance` are random bytes, different at each start of
    /// the program. They distinguish its requests from requests of earlier instances that a
    /// Responder may remember.
    #[must_use]
    pub const fn new(
        id: OwnedPublisherId,
        instance: [u8; 16],
        settings: RequestorSettings,
    ) -> Self {
        Self {
            id,
            settings,
            instance,
            next: 0,
            calls: BTreeMap::new(),
            timers: Timers::new(),
            given_up: VecDeque::new(),
            held: 0,
            correlation_data: [0; CORRELATION_DATA],
            counters: RequestorCounters {
                calls: 0,
                sent: 0,
                repeated: 0,
                answered: 0,
                unknown: 0,
                abandoned: 0,
                unacknowledged: 0,
                dropped: 0,
            },
        }
    }

    /// Starts a call. Its request is due immediately.
    ///
    /// # Errors
    /// The reason why the call was not started.
    pub fn call(
        &mut self,
        request: ActionRequest<'_>,
        now: Duration,
    ) -> Result<CallId, CallRefusal> {
        let ActionRequest {
            address,
            dialect,
            fields,
            timeout,
        } = request;
        if timeout.is_zero() {
            return Err(CallRefusal::NoTime);
        }
        check(dialect, fields)?;
        if self.calls.len() + self.given_up.len() >= self.settings.max_calls {
            return Err(CallRefusal::TooManyCalls(self.settings.max_calls));
        }
        let bytes = self.held + fields.bytes().len();
        if bytes > self.settings.max_bytes {
            return Err(CallRefusal::TooManyBytes { bytes });
        }
        self.held = bytes;
        let id = self.next;
        self.next += 1;
        let deadline = now.saturating_add(timeout);
        let silent = match dialect {
            ActionDialect::Standard => now.saturating_add(self.settings.receive_timeout),
            // This dialect sends nothing before the result.
            ActionDialect::UaNetStandard(_) => deadline,
        };
        let mut call = Call {
            address,
            dialect,
            fields: fields.into(),
            phase: Phase::Asking {
                deadline,
                silent,
                hint: None,
            },
            next_send: Some(now),
            sent: false,
            wake: now,
        };
        self.timers.move_to(id, &mut call.wake, now);
        self.calls.insert(id, call);
        self.counters.calls += 1;
        Ok(CallId(id))
    }

    /// Abandons a call: its outcome is not reported, and the Responder is asked to forget it.
    /// Returns false if the call is finished.
    pub fn abandon(&mut self, call: CallId, now: Duration) -> bool {
        match self.calls.get(&call.0).map(|call| call.phase) {
            Some(Phase::Asking { .. }) => {
                self.close(call.0, true, now);
                self.counters.abandoned += 1;
                true
            }
            Some(Phase::Closing { .. }) | None => false,
        }
    }

    /// Returns whether the Responder has reported that it executes the call. Its request is not
    /// sent again then.
    #[must_use]
    pub fn is_received(&self, call: CallId) -> bool {
        let call = self.calls.get(&call.0);
        call.is_some_and(|call| {
            matches!(call.phase, Phase::Asking { .. }) && call.sent && call.next_send.is_none()
        })
    }

    /// Handles a response from any Responder.
    ///
    /// # Errors
    /// The reason why the response was dropped without effect.
    pub fn handle_response<'a>(
        &mut self,
        response: &ActionMessage<'a>,
        now: Duration,
    ) -> Result<ResponseMeaning<'a>, ResponseDrop> {
        self.handle_timeout(now);
        let heard = self.hear(response, now);
        match heard {
            Ok(ResponseMeaning::Done(..)) => self.counters.answered += 1,
            Ok(ResponseMeaning::Executing(_) | ResponseMeaning::Closed(_)) => {}
            Err(_) => self.counters.dropped += 1,
        }
        heard
    }

    /// Returns true if the response belongs to an open call, regardless of its sender.
    #[must_use]
    pub fn is_awaited(&self, response: &ActionMessage<'_>) -> bool {
        let id = self.id_of(response);
        id.is_ok_and(|id| self.calls.contains_key(&id))
    }

    /// Ends calls that are past their deadline or whose Responder is lost.
    pub fn handle_timeout(&mut self, now: Duration) {
        // Each due entry is removed, moved behind `now`, or due for sending, which ends the loop.
        while let Some(id) = self.timers.due(now) {
            let Some(call) = self.calls.get(&id) else {
                return;
            };
            match call.phase {
                Phase::Asking {
                    deadline, silent, ..
                } if now >= deadline.min(silent) => {
                    let why = if now >= deadline {
                        Unknown::Deadline
                    } else {
                        Unknown::Silent
                    };
                    self.given_up.push_back((CallId(id), why));
                    self.counters.unknown += 1;
                    self.close(id, true, now);
                }
                Phase::Closing { left: 0, .. } => {
                    self.counters.unacknowledged += 1;
                    self.forget(id);
                }
                Phase::Asking { .. } | Phase::Closing { .. } => return,
            }
        }
    }

    /// Returns the next request that is due.
    pub fn poll_transmit(&mut self, now: Duration) -> Option<ActionToSend<'_>> {
        self.handle_timeout(now);
        let id = self.timers.due(now)?;
        let interval = self.settings.publishing_interval.max(LEAST_INTERVAL);
        let call = self.calls.get_mut(&id)?;
        let again = now.saturating_add(interval);
        let (state, timeout_hint, left) = match &mut call.phase {
            Phase::Asking { deadline, hint, .. } => {
                call.next_send = match call.dialect {
                    ActionDialect::Standard => Some(again),
                    ActionDialect::UaNetStandard(_) => None,
                };
                let left = deadline.saturating_sub(now).as_secs_f64() * 1000.0;
                let hint = if call.fields.as_fields().bytes().len() > self.settings.large {
                    *hint.get_or_insert(left)
                } else {
                    left
                };
                (ActionState::Executing, Some(hint), Some(left))
            }
            Phase::Closing { left, .. } => {
                *left = left.saturating_sub(1);
                call.next_send = Some(again);
                (ActionState::Idle, None, None)
            }
        };
        self.counters.sent += 1;
        self.counters.repeated += u64::from(call.sent);
        call.sent = true;
        let next = call.next_wake();
        self.timers.move_to(id, &mut call.wake, next);
        let request_id = request_id(id);
        self.correlation_data = correlation_data(self.instance, id);
        Some(ActionToSend {
            address: &call.address,
            action: ActionHeader {
                kind: ActionKind::Request,
                response_address: self.settings.response_address.as_deref(),
                correlation_data: Some(&self.correlation_data),
                requestor_id: Some(self.id.as_id()),
                timeout_hint,
            },
            left,
            request_id,
            call: id,
            state,
            status: None,
            fields: call.fields.as_fields(),
            dialect: call.dialect,
        })
    }

    /// Returns the next call with unknown outcome. Each call is returned once.
    pub fn poll_given_up(&mut self) -> Option<(CallId, Unknown)> {
        self.given_up.pop_front()
    }

    /// Returns the time of the next call of [`poll_transmit`](Self::poll_transmit).
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        self.timers.next()
    }

    /// Returns the number of open calls, including calls that wait for their acknowledgement.
    #[must_use]
    pub fn open_calls(&self) -> usize {
        self.calls.len()
    }

    /// Returns the counters.
    #[must_use]
    pub const fn counters(&self) -> &RequestorCounters {
        &self.counters
    }

    fn hear<'a>(
        &mut self,
        response: &ActionMessage<'a>,
        now: Duration,
    ) -> Result<ResponseMeaning<'a>, ResponseDrop> {
        let id = self.id_of(response)?;
        let receive_timeout = self.settings.receive_timeout;
        let call = self.calls.get_mut(&id).ok_or(ResponseDrop::NoCall)?;
        if call.dialect != response.dialect || !call.address.is_of(response) {
            return Err(ResponseDrop::Elsewhere);
        }
        match (&mut call.phase, response.state) {
            (Phase::Asking { silent, .. }, ActionState::Executing) => {
                *silent = now.saturating_add(receive_timeout);
                call.next_send = None;
                let next = call.next_wake();
                self.timers.move_to(id, &mut call.wake, next);
                Ok(ResponseMeaning::Executing(CallId(id)))
            }
            (Phase::Asking { .. }, ActionState::Done) => {
                self.close(id, false, now);
                let outcome = ActionOutcome::of(response.header().status, response.fields);
                Ok(ResponseMeaning::Done(CallId(id), outcome))
            }
            (Phase::Closing { .. }, ActionState::Idle) => {
                self.forget(id);
                Ok(ResponseMeaning::Closed(CallId(id)))
            }
            (Phase::Closing { given_up, .. }, ActionState::Done) => Err(if *given_up {
                ResponseDrop::Late
            } else {
                ResponseDrop::Repeated
            }),
            (Phase::Asking { .. }, ActionState::Idle)
            | (Phase::Closing { .. }, ActionState::Executing) => Err(ResponseDrop::State),
        }
    }

    /// Returns the id of the call that a response belongs to.
    fn id_of(&self, response: &ActionMessage<'_>) -> Result<u64, ResponseDrop> {
        let action = &response.action;
        if action.kind == ActionKind::Request {
            return Err(ResponseDrop::Request);
        }
        // Some Responders do not return the RequestorId.
        if action.requestor_id.is_some_and(|id| id != self.id.as_id()) {
            return Err(ResponseDrop::Foreign);
        }
        let lap = action
            .correlation_data
            .and_then(|data| data.strip_prefix(&self.instance))
            .and_then(|lap| lap.try_into().ok())
            .map(u32::from_le_bytes)
            .ok_or(ResponseDrop::Foreign)?;
        Ok(u64::from(lap) << 16 | u64::from(response.request_id))
    }

    /// Starts the acknowledgement, if the dialect supports it.
    fn close(&mut self, id: u64, given_up: bool, now: Duration) {
        let left = self.settings.idle_repeats;
        let Some(call) = self.calls.get_mut(&id) else {
            return;
        };
        // A request that was never sent does not have to be forgotten.
        if left == 0 || call.dialect != ActionDialect::Standard || !call.sent {
            self.forget(id);
            return;
        }
        self.held -= call.fields.as_fields().bytes().len();
        call.fields = KeptFields::None;
        call.phase = Phase::Closing { left, given_up };
        call.next_send = Some(now);
        call.sent = false;
        self.timers.move_to(id, &mut call.wake, now);
    }

    fn forget(&mut self, id: u64) {
        if let Some(call) = self.calls.remove(&id) {
            self.timers.remove(id, call.wake);
            if let Phase::Asking { .. } = call.phase {
                self.held -= call.fields.as_fields().bytes().len();
            }
        }
    }
}

impl Call {
    fn next_wake(&self) -> Duration {
        let end = match self.phase {
            Phase::Asking {
                deadline, silent, ..
            } => deadline.min(silent),
            Phase::Closing { .. } => Duration::MAX,
        };
        self.next_send.map_or(end, |at| at.min(end))
    }
}

/// Checks that the dialect supports the encoding of the arguments.
fn check(dialect: ActionDialect, fields: ActionFields<'_>) -> Result<(), CallRefusal> {
    match (dialect, fields) {
        (
            ActionDialect::Standard | ActionDialect::UaNetStandard(ActionEncoding::Variant),
            ActionFields::Variants(block),
        ) => match Fields::parse(block) {
            Ok(_) => Ok(()),
            Err(error) => Err(CallRefusal::Malformed(error)),
        },
        (ActionDialect::Standard, ActionFields::RawData { count: Some(_), .. })
        | (ActionDialect::UaNetStandard(ActionEncoding::RawData), ActionFields::RawData { .. }) => {
            Ok(())
        }
        (
            ActionDialect::Standard | ActionDialect::UaNetStandard(_),
            ActionFields::RawData { .. } | ActionFields::Variants(_),
        ) => Err(CallRefusal::Encoding),
    }
}

/// Returns the RequestId. After 65536 ids the CorrelationData changes and the RequestIds start
/// over.
fn request_id(id: u64) -> u16 {
    let [low, high, ..] = id.to_le_bytes();
    u16::from_le_bytes([low, high])
}

fn correlation_data(instance: [u8; INSTANCE], id: u64) -> [u8; CORRELATION_DATA] {
    let [_, _, lap @ .., _, _] = id.to_le_bytes();
    let mut data = [0; CORRELATION_DATA];
    if let Some((head, tail)) = data.split_first_chunk_mut() {
        *head = instance;
        tail.copy_from_slice(&lap);
    }
    data
}

const INSTANCE: usize = 16;
const CORRELATION_DATA: usize = INSTANCE + size_of::<u32>();

/// Minimum of the publishing interval, which prevents endless sending at an interval of 0.
const LEAST_INTERVAL: Duration = Duration::from_millis(1);
