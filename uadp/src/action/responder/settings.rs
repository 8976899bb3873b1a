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
    /// How often the answer to a request that [`handle_judged`](crate::action::Responder::handle_judged) refuses is said
    /// again, each time for a repetition of the request. Default 3.
    pub refusal_repeats: u8,
    /// How long a request is remembered after it was heard of last: longer than any the network may hold back.
    /// Default 10 s.
    pub remember: Duration,
    /// Deadline of requests that say none. Default 60 s.
    pub timeout: Duration,
    /// Longest deadline that is kept: what is executed for longer goes on, but its answer is not waited for.
    /// Default 1 h.
    pub max_timeout: Duration,
    /// Requests of a group executed at a time; further ones are refused as [`Refusal::Busy`]. Default 256.
    pub max_executing: usize,
    /// Requests of one sender executed at a time; further ones are refused as [`Refusal::Busy`]. Default 256.
    pub max_executing_per_sender: usize,
    /// Requests of a group remembered with all that is known of them. Default 8192.
    pub max_requests: usize,
    /// Requests of one sender remembered with all that is known of them. Default 2048.
    pub max_requests_per_sender: usize,
    /// Requests of a group that are over, beside those: enough of each is kept to know it again, about 100 bytes.
    /// Default 131072.
    pub max_over: usize,
    /// Requests of one sender that are over. Default 65536.
    pub max_over_per_sender: usize,
    /// Refused requests of a group that are remembered, about 100 bytes each. Default 4096.
    pub max_refused: usize,
    /// Refused requests of one sender that are remembered. Further ones are dropped without an answer. Default 512.
    pub max_refused_per_sender: usize,
    /// Bytes of all that is remembered of a group, but for those of [`max_over`](Self::max_over). Default 16 MiB.
    pub max_bytes: usize,
    /// Bytes remembered of one sender. Default 4 MiB.
    pub max_bytes_per_sender: usize,
    /// Bytes of the fields of one answer, which has to fit in a datagram. Default 60000.
    pub max_answer: usize,
    /// Bytes of CorrelationData. Default 64.
    pub max_correlation_data: usize,
}

/// The sender of a request, as the carrier distinguishes senders. The request takes up its room.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RequestOrigin<P> {
    /// Number of the group of senders that shares the limits of a group in [`ResponderSettings`], such as a SecurityGroup.
    pub group: usize,
    /// The sender, and where its answers go.
    pub sender: P,
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
    /// Nothing: the owner refuses it, and that is answered once.
    Declined(Refusal),
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
    /// The sender has as much room as it may have.
    #[error("too many requests of this sender")]
    SenderFull,
    /// The request was refused before.
    #[error("a request that was refused")]
    Refused,
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
    /// Requests refused by the owner before room was taken for them, or for want of room to execute them.
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
