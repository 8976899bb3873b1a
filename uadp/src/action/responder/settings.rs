//! Limits of a Responder, and its decisions on requests.

use core::time::Duration;

use crate::action::Refusal;

/// Timing and limits of a [`Responder`](crate::action::Responder).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResponderSettings {
    /// PublishingInterval of the WriterGroup; states are repeated at this interval. Default 100 ms.
    pub publishing_interval: Duration,
    /// Number of unprompted repetitions of a result. Default 20.
    pub done_repeats: u32,
    /// Number of repeated responses to a request that
    /// [`handle_judged`](crate::action::Responder::handle_judged) refuses, each triggered by a
    /// repetition of the request. Default 3.
    pub refusal_repeats: u8,
    /// Time for which a request is remembered after its last message. It has to exceed the longest
    /// delay of the network. Default 10 s.
    pub remember: Duration,
    /// Deadline of requests without TimeoutHint. Default 60 s.
    pub timeout: Duration,
    /// Maximum deadline. A longer execution continues, but its Requestor is considered to have
    /// stopped waiting. Default 1 h.
    pub max_timeout: Duration,
    /// Maximum number of concurrent executions of a group; further requests are refused with
    /// [`Refusal::Busy`]. Default 256.
    pub max_executing: usize,
    /// Maximum number of concurrent executions of a sender; further requests are refused with
    /// [`Refusal::Busy`]. Default 256.
    pub max_executing_per_sender: usize,
    /// Maximum number of completely remembered requests of a group. Default 8192.
    pub max_requests: usize,
    /// Maximum number of completely remembered requests of a sender. Default 2048.
    pub max_requests_per_sender: usize,
    /// Maximum number of finished requests of a group that are remembered by hash only, in addition
    /// to `max_requests`. Each uses about 100 bytes. Default 131072.
    pub max_over: usize,
    /// Maximum number of finished requests of a sender that are remembered by hash only. Default
    /// 65536.
    pub max_over_per_sender: usize,
    /// Maximum number of remembered refused requests of a group, about 100 bytes each. Default
    /// 4096.
    pub max_refused: usize,
    /// Maximum number of remembered refused requests of a sender. Further requests are dropped
    /// without response. Default 512.
    pub max_refused_per_sender: usize,
    /// Maximum bytes remembered of a group, without the requests under
    /// [`max_over`](Self::max_over). Default 16 MiB.
    pub max_bytes: usize,
    /// Maximum bytes remembered of a sender. Default 4 MiB.
    pub max_bytes_per_sender: usize,
    /// Maximum bytes of the fields of a response, which has to fit in a datagram. Default 60000.
    pub max_answer: usize,
    /// Maximum bytes of CorrelationData. Default 64.
    pub max_correlation_data: usize,
}

/// Sender of a request, as the transport distinguishes senders. Its requests count against its
/// limits.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RequestOrigin<P> {
    /// Number of the group of senders that share the group limits in [`ResponderSettings`], such as
    /// a SecurityGroup.
    pub group: usize,
    /// Sender, and the destination of its responses.
    pub sender: P,
}

/// Identifies a request within its Responder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ExecutionId(pub(super) u64);

impl ExecutionId {
    /// Creates an id without a Responder, for tests.
    #[must_use]
    pub const fn new(number: u64) -> Self {
        Self(number)
    }
}

/// Action that a request requires of the owner.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RequiredAction {
    /// Execute the request and report the outcome, or refuse it.
    Execute(ExecutionId),
    /// Nothing: the Responder refuses the request.
    Refused(ExecutionId, Refusal),
    /// Nothing: the owner refuses the request, and one response is sent.
    Declined(Refusal),
    /// Nothing: the request is a repetition and gets another response.
    Repeated(ExecutionId),
    /// Cancel the execution if possible, and finish it: the Requestor does not want the result.
    Abandoned(ExecutionId),
    /// Nothing: the Requestor has the result, or ends a request that was never received.
    Closed(ExecutionId),
}

/// Reason why a request was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum RequestDrop {
    /// The message is a response.
    #[error("a response")]
    Response,
    /// The state is not valid in a request.
    #[error("an unexpected state")]
    State,
    /// The CorrelationData has this many bytes, more than
    /// [`ResponderSettings::max_correlation_data`].
    #[error("{0} bytes of CorrelationData")]
    CorrelationData(usize),
    /// Another request has the same ids.
    #[error("the ids belong to another request")]
    Reused,
    /// The request is finished and gets no further response.
    #[error("the request has already ended")]
    Over,
    /// The sender has reached its limit.
    #[error("too many requests of this sender")]
    SenderFull,
    /// The request was refused before.
    #[error("the request was refused")]
    Refused,
    /// The group has reached its limit.
    #[error("too many requests")]
    Full,
}

/// Reason why an outcome is not sent to the Requestor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum FinishRefusal {
    /// The request has expired: its deadline is long past.
    #[error("the request has expired")]
    Forgotten,
    /// The request has its outcome already.
    #[error("finished before")]
    Finished,
    /// The Requestor has abandoned the request.
    #[error("abandoned by the requestor")]
    Abandoned,
    /// The response is too big. The Requestor receives Bad_ResponseTooLarge.
    #[error("the response is too large")]
    TooBig,
    /// The dialect does not support the encoding of the response. The Requestor receives
    /// Bad_EncodingError.
    #[error("the peer does not support the encoding of the response")]
    Encoding,
    /// The dialect has no field for a StatusCode: the Requestor receives nothing.
    #[error("the peer does not support a status")]
    NoStatus,
}

/// Counters of requests and messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ResponderCounters {
    /// Requests returned for execution.
    pub executed: u64,
    /// Requests refused by the owner before space was allocated, or by the limit of concurrent
    /// executions.
    pub refused: u64,
    /// Repeated requests.
    pub repeated: u64,
    /// Executions abandoned by the Requestor.
    pub abandoned: u64,
    /// Acknowledged responses, and ended requests.
    pub closed: u64,
    /// Executions that expired before they were finished.
    pub lost: u64,
    /// Dropped requests.
    pub dropped: u64,
    /// Responses returned for sending.
    pub sent: u64,
}

impl Default for ResponderSettings {
    fn default() -> Self {
        Self {
            publishing_interval: Duration::from_millis(100),
            done_repeats: 20,
            remember: Duration::from_secs(10),
            timeout: Duration::from_secs(60),
            max_timeout: Duration::from_secs(3600),
            refusal_repeats: 3,
            max_executing: 256,
            max_executing_per_sender: 256,
            max_requests: 8192,
            max_requests_per_sender: 2048,
            max_over: 131_072,
            max_over_per_sender: 65_536,
            max_refused: 4_096,
            max_refused_per_sender: 512,
            max_bytes: 16 << 20,
            max_bytes_per_sender: 4 << 20,
            max_answer: 60_000,
            max_correlation_data: 64,
        }
    }
}
