//! What a Responder may hold, and what it says of requests.

use std::time::Duration;

use crate::action::Refusal;

/// How a [`Responder`](crate::action::Responder) answers, and what it may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ResponderSettings {
    /// PublishingInterval of the WriterGroup, at which states are said again. Default 100 ms.
    pub publishing_interval: Duration,
    /// How often an answer is said without being asked for again. Default 20.
    pub done_repeats: u32,
    /// How long a request is remembered after it was heard of last: longer than any the network may hold back.
    /// Default 10 s.
    pub remember: Duration,
    /// Deadline of requests that say none. Default 60 s.
    pub timeout: Duration,
    /// Longest deadline that is kept: what is executed for longer goes on, but its answer is not waited for.
    /// Default 1 h.
    pub max_timeout: Duration,
    /// Requests executed at a time; further ones are refused as [`Refusal::Busy`]. Default 256.
    pub max_executing: usize,
    /// Requests remembered with all that is known of them. Default 8192.
    pub max_requests: usize,
    /// Those of one RequestorId. Default 2048.
    pub max_requests_per_requestor: usize,
    /// Requests that are over, beside those: enough of each is kept to know it again, about 100 bytes. Default 131072.
    pub max_over: usize,
    /// Those of one RequestorId. Default 65536.
    pub max_over_per_requestor: usize,
    /// Bytes of all that is remembered, but for those of [`max_over`](Self::max_over). Default 16 MiB.
    pub max_bytes: usize,
    /// Bytes remembered of one RequestorId. Default 4 MiB.
    pub max_bytes_per_requestor: usize,
    /// Bytes of the fields of one answer, which has to fit in a datagram. Default 60000.
    pub max_answer: usize,
    /// Bytes of CorrelationData. Default 64.
    pub max_correlation_data: usize,
}

/// A request as its Responder knows it, unlike all others of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ExecutionId(pub(super) u64);

impl ExecutionId {
    /// That of a Responder that is made up.
    #[must_use]
    pub const fn new(number: u64) -> Self {
        Self(number)
    }
}

/// What is to be done about a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Requested {
    /// Execute it, and say what came out; or refuse it.
    Execute(ExecutionId),
    /// Nothing: it is refused.
    Refused(ExecutionId, Refusal),
    /// Nothing: it was heard before, and is answered once more.
    Repeated(ExecutionId),
    /// The Requestor does not want what is still executed: cancel it where that can be done, and finish it.
    Abandoned(ExecutionId),
    /// Nothing: the Requestor has the answer, or takes a request back that never came.
    Closed(ExecutionId),
}

/// Why a request was not taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum RequestDrop {
    /// It is a response.
    #[error("a response")]
    Response,
    /// A state that a Requestor cannot want.
    #[error("an unexpected state")]
    State,
    /// So many bytes of CorrelationData: more than [`ResponderSettings::max_correlation_data`].
    #[error("{0} bytes of CorrelationData")]
    CorrelationData(usize),
    /// Another request had the same ids.
    #[error("the ids of another request")]
    Reused,
    /// It is over, and not answered any more.
    #[error("a request that is over")]
    Over,
    /// The Requestor has as much as it may have.
    #[error("too many requests of this requestor")]
    RequestorFull,
    /// There is no room to remember it.
    #[error("too many requests")]
    Full,
}

/// Why an outcome is not told to the Requestor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum FinishRefusal {
    /// The request was forgotten: its deadline is long past.
    #[error("the request was forgotten")]
    Forgotten,
    /// What came out was said before.
    #[error("finished before")]
    Finished,
    /// The Requestor does not want it any more.
    #[error("abandoned by the requestor")]
    Abandoned,
    /// The answer is too big. The Requestor is told Bad_ResponseTooLarge.
    #[error("the answer is too big")]
    TooBig,
    /// The answer is in an encoding the Requestor does not know. It is told Bad_EncodingError.
    #[error("the answer is in an encoding the peer does not know")]
    Encoding,
    /// The dialect has no place for a StatusCode: the Requestor is told nothing.
    #[error("the peer cannot be told a status")]
    NoStatus,
}

/// What became of requests and messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct ResponderCounters {
    /// Requests handed out to be executed.
    pub executed: u64,
    /// Requests refused for want of room to execute them.
    pub refused: u64,
    /// Requests heard before.
    pub repeated: u64,
    /// Executions the Requestor gave up.
    pub abandoned: u64,
    /// Answers acknowledged, and requests taken back.
    pub closed: u64,
    /// Executions that were forgotten before they were finished.
    pub lost: u64,
    /// Requests not taken.
    pub dropped: u64,
    /// Responses handed out to be sent.
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
            max_executing: 256,
            max_requests: 8192,
            max_requests_per_requestor: 2048,
            max_over: 131_072,
            max_over_per_requestor: 65_536,
            max_bytes: 16 << 20,
            max_bytes_per_requestor: 4 << 20,
            max_answer: 60_000,
            max_correlation_data: 64,
        }
    }
}
