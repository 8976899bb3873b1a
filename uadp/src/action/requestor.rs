//! The asking side: requests repeated until something is heard, and an end to every one.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::sending::KeptFields;
use super::timers::Timers;
use super::{
    ActionAddress, ActionDialect, ActionEncoding, ActionFields, ActionHeader, ActionKind,
    ActionMessage, ActionState, ActionToSend, Outcome, Unknown,
};
use crate::{DecodeError, Fields, OwnedPublisherId};

/// Asks for Actions over a network that may lose, double, delay and reorder what is sent (OPC 10000-14, 6.2.11.2.2).
///
/// A request is repeated at the publishing interval until something is heard of it, and not after that: the Responder
/// repeats its state by itself, and one that has forgotten the request must not be made to execute it again. An answer is
/// acknowledged with ActionState Idle, until the Responder is idle too or for
/// [`idle_repeats`](RequestorSettings::idle_repeats). Every call ends, by its deadline at the latest, in one [`Outcome`]:
/// from [`handle_response`](Self::handle_response), or from [`poll_given_up`](Self::poll_given_up) when it is unknown.
/// After that the Responder is told to forget it.
///
/// With [`ActionDialect::UaNetStandard`] a request is sent once, as the peer would execute every repetition.
///
/// `now` counts from any fixed time. What is due is asked for until there is nothing more:
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
/// // Nobody answers.
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
    /// Bytes of the arguments of all calls.
    held: usize,
    /// CorrelationData of the request that is sent.
    correlation_data: [u8; CORRELATION_DATA],
    counters: RequestorCounters,
}

/// How a [`Requestor`] asks, and what it may hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RequestorSettings {
    /// PublishingInterval of the Responder's WriterGroup, at which requests are repeated. Default 100 ms.
    pub publishing_interval: Duration,
    /// When nothing was heard of the Responder for so long it is taken for lost. [`Duration::MAX`] leaves that to the
    /// deadline, for Responders that do not repeat Executing by themselves. Default 2 s.
    pub receive_timeout: Duration,
    /// How often an acknowledgement is sent at most. Default 5.
    pub idle_repeats: u8,
    /// ResponseAddress to send; `None` to be answered where the Responder answers by itself. Default `None`.
    pub response_address: Option<Box<str>>,
    /// A request with more bytes of arguments than that is repeated byte for byte, so that the chunks of one repetition fill in
    /// those lost of another (OPC 10000-14, 7.2.4.4.4). Default 1000.
    pub large: usize,
    /// Calls at a time, those that are only to be acknowledged or told still included. Default 1024.
    pub max_calls: usize,
    /// Bytes of the arguments of all calls. Default 4 MiB.
    pub max_bytes: usize,
}

/// What a [`Requestor`] is to ask for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionRequest<'a> {
    /// Of whom, and on what.
    pub address: ActionAddress,
    /// How the Responder has it.
    pub dialect: ActionDialect,
    /// The arguments.
    pub fields: ActionFields<'a>,
    /// How long an answer is waited for. What is left of it goes with every request as its TimeoutHint; what was left at
    /// first, where arguments are [large](RequestorSettings::large).
    pub timeout: Duration,
}

/// A call of a [`Requestor`], unlike all others of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CallId(u64);

/// What a response meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Heard<'a> {
    /// The Responder has the request and executes it.
    Executing(CallId),
    /// The call is over.
    Done(CallId, Outcome<'a>),
    /// The Responder has forgotten a call that was over.
    Closed(CallId),
}

/// Why there is no call.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CallRefusal {
    /// There are [`RequestorSettings::max_calls`].
    #[error("{0} calls at a time are all there may be")]
    TooManyCalls(usize),
    /// With these arguments there would be more bytes than [`RequestorSettings::max_bytes`].
    #[error("{bytes} bytes of arguments are too many")]
    TooManyBytes {
        /// Bytes of all arguments there would be.
        bytes: usize,
    },
    /// A call cannot be answered in no time.
    #[error("a timeout of 0")]
    NoTime,
    /// Arguments that are no block of Variants.
    #[error("arguments: {0}")]
    Malformed(DecodeError),
    /// Arguments in an encoding that the dialect has not, or RawData without a FieldCount where it is needed.
    #[error("arguments in an encoding the peer does not know")]
    Encoding,
}

/// Why a response was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum ResponseDrop {
    /// It is a request.
    #[error("a request")]
    Request,
    /// It answers another Requestor, or an earlier life of this one.
    #[error("an answer to another requestor")]
    Foreign,
    /// No call of this id, or not any more.
    #[error("an answer to no call")]
    NoCall,
    /// It does not come from where the call went, or in another dialect.
    #[error("an answer from elsewhere")]
    Elsewhere,
    /// The call was answered before.
    #[error("an answer once more")]
    Repeated,
    /// The call was given up before.
    #[error("an answer too late")]
    Late,
    /// A state that means nothing now.
    #[error("an unexpected state")]
    State,
}

/// What became of calls and messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct RequestorCounters {
    /// Calls begun.
    pub calls: u64,
    /// Requests handed out to be sent, acknowledgements and repetitions included.
    pub sent: u64,
    /// Those of them that repeat one.
    pub repeated: u64,
    /// Calls that were answered or refused.
    pub answered: u64,
    /// Calls whose outcome is unknown.
    pub unknown: u64,
    /// Calls given up by whoever made them.
    pub abandoned: u64,
    /// Acknowledgements that were not answered.
    pub unacknowledged: u64,
    /// Responses not taken.
    pub dropped: u64,
}

#[derive(Debug)]
struct Call {
    address: ActionAddress,
    dialect: ActionDialect,
    /// Empty when only the acknowledgement is left.
    fields: KeptFields,
    phase: Phase,
    next_send: Option<Duration>,
    sent: bool,
    wake: Duration,
}

#[derive(Debug, Clone, Copy)]
enum Phase {
    /// Executing is wanted.
    Asking {
        deadline: Duration,
        /// When the Responder is taken for lost.
        silent: Duration,
        /// TimeoutHint of a large request, once it was sent.
        hint: Option<f64>,
    },
    /// Idle is wanted, so many more times.
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
    /// Takes another [`RequestorSettings::receive_timeout`]: for new calls, and for those there are from the next word of their
    /// Responder on.
    pub const fn set_receive_timeout(&mut self, receive_timeout: Duration) {
        self.settings.receive_timeout = receive_timeout;
    }

    /// A Requestor without calls. `instance` are random bytes, others each time a program starts: they tell its requests
    /// from those of its earlier lives, which a Responder may still remember.
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

    /// Begins a call, which is due to be sent at once.
    ///
    /// # Errors
    /// Nothing is begun, for the reason given.
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
            // It says nothing before the answer.
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

    /// Gives a call up: its outcome will not be told, and the Responder is told to forget it. False for a call that is
    /// over.
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

    /// Takes a response of any Responder.
    ///
    /// # Errors
    /// It is not taken, for the reason given: nothing changes by it.
    pub fn handle_response<'a>(
        &mut self,
        response: &ActionMessage<'a>,
        now: Duration,
    ) -> Result<Heard<'a>, ResponseDrop> {
        self.handle_timeout(now);
        let heard = self.hear(response, now);
        match heard {
            Ok(Heard::Done(..)) => self.counters.answered += 1,
            Ok(Heard::Executing(_) | Heard::Closed(_)) => {}
            Err(_) => self.counters.dropped += 1,
        }
        heard
    }

    /// Whether a response answers a call that is open here, whoever sent it.
    #[must_use]
    pub fn is_awaited(&self, response: &ActionMessage<'_>) -> bool {
        let id = self.id_of(response);
        id.is_ok_and(|id| self.calls.contains_key(&id))
    }

    /// Ends calls that are past their deadline or whose Responder is silent.
    pub fn handle_timeout(&mut self, now: Duration) {
        // An entry is moved behind `now` or left to be sent, which stands at the front then.
        while let Some(id) = self.timers.due(now) {
            let Some(call) = self.calls.get(&id) else {
                return;
            };
            match call.phase {
                Phase::Asking {
                    deadline, silent, ..
                } if now >= deadline.min(silent) => {
                    let why = match now >= deadline {
                        true => Unknown::Deadline,
                        false => Unknown::Silent,
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

    /// The next request that is due to be sent.
    pub fn poll_transmit(&mut self, now: Duration) -> Option<ActionToSend<'_>> {
        self.handle_timeout(now);
        let id = self.timers.due(now)?;
        let interval = self.settings.publishing_interval.max(LEAST_INTERVAL);
        let call = self.calls.get_mut(&id)?;
        let again = now.saturating_add(interval);
        let (state, timeout_hint) = match &mut call.phase {
            Phase::Asking { deadline, hint, .. } => {
                call.next_send = match call.dialect {
                    ActionDialect::Standard => Some(again),
                    ActionDialect::UaNetStandard(_) => None,
                };
                let left = deadline.saturating_sub(now).as_secs_f64() * 1000.0;
                let left = match call.fields.as_fields().bytes().len() > self.settings.large {
                    true => *hint.get_or_insert(left),
                    false => left,
                };
                (ActionState::Executing, Some(left))
            }
            Phase::Closing { left, .. } => {
                *left = left.saturating_sub(1);
                call.next_send = Some(again);
                (ActionState::Idle, None)
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
            request_id,
            call: id,
            state,
            status: None,
            fields: call.fields.as_fields(),
            dialect: call.dialect,
        })
    }

    /// The next call whose outcome is unknown. It is told once.
    pub fn poll_given_up(&mut self) -> Option<(CallId, Unknown)> {
        self.given_up.pop_front()
    }

    /// When [`poll_transmit`](Self::poll_transmit) is to be called next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Duration> {
        self.timers.next()
    }

    /// Calls that are not over, and those only to be acknowledged still.
    #[must_use]
    pub fn open_calls(&self) -> usize {
        self.calls.len()
    }

    /// What was counted so far.
    #[must_use]
    pub const fn counters(&self) -> &RequestorCounters {
        &self.counters
    }

    fn hear<'a>(
        &mut self,
        response: &ActionMessage<'a>,
        now: Duration,
    ) -> Result<Heard<'a>, ResponseDrop> {
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
                Ok(Heard::Executing(CallId(id)))
            }
            (Phase::Asking { .. }, ActionState::Done) => {
                self.close(id, false, now);
                let outcome = Outcome::of(response.header().status, response.fields);
                Ok(Heard::Done(CallId(id), outcome))
            }
            (Phase::Closing { .. }, ActionState::Idle) => {
                self.forget(id);
                Ok(Heard::Closed(CallId(id)))
            }
            (Phase::Closing { given_up, .. }, ActionState::Done) => Err(match *given_up {
                true => ResponseDrop::Late,
                false => ResponseDrop::Repeated,
            }),
            (Phase::Asking { .. }, ActionState::Idle)
            | (Phase::Closing { .. }, ActionState::Executing) => Err(ResponseDrop::State),
        }
    }

    /// Which call is answered.
    fn id_of(&self, response: &ActionMessage<'_>) -> Result<u64, ResponseDrop> {
        let action = &response.action;
        if action.kind == ActionKind::Request {
            return Err(ResponseDrop::Request);
        }
        // Not every Responder gives the RequestorId back.
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

    /// Goes on to the acknowledgement, where there is one.
    fn close(&mut self, id: u64, given_up: bool, now: Duration) {
        let left = self.settings.idle_repeats;
        let Some(call) = self.calls.get_mut(&id) else {
            return;
        };
        // A request that was never sent is nothing to be forgotten.
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

/// The arguments can be written in the dialect.
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

/// The RequestIds start over with other CorrelationData when they are used up.
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

/// What keeps a publishing interval of 0 from sending without end.
const LEAST_INTERVAL: Duration = Duration::from_millis(1);
