//! Calling a service: finding it, connecting, asking, and telling what went wrong.

use std::fmt;
use std::io;
use std::mem::MaybeUninit;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::{Buf, Bytes};
use socket2::SockRef;
use thiserror::Error;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Mutex, Semaphore};
use tokio::time::{Instant, timeout, timeout_at};

use super::DEFAULT_MAX_BODY;
use crate::clock;
use crate::frame::{FrameTooLong, Frames};
use crate::header::{ConnectionHeader, HeaderError, clipped};
use crate::link::prepare;
use crate::master::{Master, MasterError};
use crate::rpc;

/// What a client asks for, and how long it waits.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceClientOptions {
    /// Checksum of the service's type. `None` sends `*`, which servers of roscpp, rospy and this crate take.
    pub md5sum: Option<String>,
    /// Such as `std_srvs/SetBool`. Servers do not need it; it is for people who look at the wire.
    pub type_name: Option<String>,
    /// Keeps one connection for all calls, which are then made one after another. A server that closes it is looked
    /// up and connected to again by the next call.
    pub persistent: bool,
    /// For a whole call: waiting for calls before it, lookup, connecting, request and answer.
    pub timeout: Duration,
    /// Longest answer taken, in bytes. A longer one closes the connection.
    pub max_response: usize,
}

impl Default for ServiceClientOptions {
    /// Any type, a connection per call, 10 seconds, 64 MiB.
    fn default() -> Self {
        Self {
            md5sum: None,
            type_name: None,
            persistent: false,
            timeout: Duration::from_secs(10),
            max_response: DEFAULT_MAX_BODY,
        }
    }
}

/// Calls one service. Clones share the kept connection of a persistent client. It may outlive its node.
#[derive(Clone, Debug)]
pub struct ServiceClient {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    service: String,
    options: ServiceClientOptions,
    caller_id: String,
    master: Master,
    /// Of a persistent client between two calls. Who calls takes it out, so that a call given up takes it along.
    kept: Mutex<Option<Connection>>,
    /// Permits to look the service up, connect and exchange headers, see [`MOST_OPENING`].
    opening: Semaphore,
    /// How many requests were sent as a whole.
    sent: AtomicU64,
}

impl ServiceClient {
    pub(crate) fn new(
        service: String,
        options: ServiceClientOptions,
        caller_id: &str,
        master: Master,
    ) -> Self {
        Self {
            shared: Arc::new(Shared {
                service,
                options,
                caller_id: caller_id.to_owned(),
                master,
                kept: Mutex::default(),
                opening: Semaphore::new(MOST_OPENING),
                sent: AtomicU64::new(0),
            }),
        }
    }

    /// A client of one that is no node of the graph: the master at `uri` (`http://host:port`) tells it where the service is.
    /// `service` is the full name.
    ///
    /// # Errors
    /// The URI is none.
    pub fn of_master(
        uri: &str,
        caller_id: &str,
        service: &str,
        options: ServiceClientOptions,
    ) -> Result<Self, MasterError> {
        let master = Master::at(uri, caller_id)?;
        Ok(Self::new(service.to_owned(), options, caller_id, master))
    }

    /// Returns how many requests were sent as a whole, answered or not.
    pub fn requests_sent(&self) -> u64 {
        self.shared.sent.load(Ordering::Relaxed)
    }

    /// The service's resolved name.
    pub fn service(&self) -> &str {
        &self.shared.service
    }

    /// Sends a serialized request, without its length, and returns the serialized answer.
    ///
    /// It is never sent twice: when it fails, [`ServiceError::may_have_run`] tells whether the server may have acted.
    /// Dropping the future gives the call up and closes its connection; the server may still act.
    pub async fn call(&self, request: Bytes) -> Result<Bytes, ServiceError> {
        let length = u32::try_from(request.len()).map_err(|_| ServiceError::RequestTooLong {
            service: self.service().to_owned(),
            bytes: request.len(),
        })?;
        let wire = Wire {
            length: length.to_le_bytes(),
            request,
        };
        let deadline = self.shared.deadline();
        // The futures are large: they stay out of the caller's.
        if self.shared.options.persistent {
            Box::pin(self.shared.call_kept(&wire, deadline)).await
        } else {
            Box::pin(self.shared.call_once(&wire, deadline)).await
        }
    }

    /// Asks the server for its header, without calling it: `type`, `md5sum`, `callerid`, and from roscpp and this
    /// crate also `request_type` and `response_type`.
    pub async fn probe(&self) -> Result<ConnectionHeader, ServiceError> {
        let deadline = self.shared.deadline();
        let probing = self.shared.connect(deadline, Purpose::Probe);
        Ok(Box::pin(probing).await?.1)
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Purpose {
    Call,
    Probe,
}

/// A request with its length.
struct Wire {
    length: [u8; 4],
    request: Bytes,
}

impl Shared {
    fn deadline(&self) -> Instant {
        clock::after(clock::now(), self.options.timeout)
    }

    async fn call_once(&self, wire: &Wire, deadline: Instant) -> Result<Bytes, ServiceError> {
        let (mut connection, _) = self.connect(deadline, Purpose::Call).await?;
        self.exchange(&mut connection, wire, deadline).await
    }

    async fn call_kept(&self, wire: &Wire, deadline: Instant) -> Result<Bytes, ServiceError> {
        let waiting = self.kept.lock();
        let mut kept = self.within(CallPhase::Queue, deadline, waiting).await?;
        if let Some(mut connection) = kept.take()
            && connection.is_open().await
        {
            let answer = self.exchange(&mut connection, wire, deadline).await;
            let broken = ServiceError::is_lost_in_request;
            if !answer.as_ref().is_err_and(broken) {
                *kept = connection.if_sound();
                return answer;
            }
            // The server has not had the whole request, so it has not acted on it: a new connection may.
        }
        let (mut connection, _) = self.connect(deadline, Purpose::Call).await?;
        let answer = self.exchange(&mut connection, wire, deadline).await;
        *kept = connection.if_sound();
        answer
    }

    /// Looks the service up, connects, and exchanges headers. The server has accepted the
    /// connection then.
    async fn connect(
        &self,
        deadline: Instant,
        purpose: Purpose,
    ) -> Result<(Connection, ConnectionHeader), ServiceError> {
        let waiting = self.opening.acquire();
        let _permit = self.within(CallPhase::Queue, deadline, waiting).await?;
        let looking = self.master.lookup_service(&self.service);
        let found = self.within(CallPhase::Lookup, deadline, looking).await?;
        let uri = found
            .map_err(|source| ServiceError::Master {
                service: self.service.clone(),
                uri: self.master.uri().to_owned(),
                source,
            })?
            .ok_or_else(|| ServiceError::NotAdvertised {
                service: self.service.clone(),
            })?;
        let (host, port, _) = rpc::parts(&uri, "rosrpc://").ok_or_else(|| {
            let what = format!(
                "its registered address `{}` is not rosrpc://host:port",
                clipped(&uri)
            );
            self.malformed(CallPhase::Lookup, what)
        })?;
        let opening = async {
            let stream = rpc::connect(host, port, self.master.prefers_ipv6()).await?;
            prepare(&stream)?;
            Ok(stream)
        };
        let mut stream = self
            .within(CallPhase::Connect, deadline, opening)
            .await?
            .map_err(|source: io::Error| ServiceError::NoConnection {
                service: self.service.clone(),
                host: host.to_owned(),
                port,
                source,
            })?;
        let shaking = self.shake_hands(&mut stream, purpose);
        let header = self
            .within(CallPhase::Handshake, deadline, shaking)
            .await??;
        let connection = Connection {
            stream,
            answers: 0,
            answered: clock::now(),
            sound: false,
        };
        Ok((connection, header))
    }

    async fn shake_hands(
        &self,
        stream: &mut TcpStream,
        purpose: Purpose,
    ) -> Result<ConnectionHeader, ServiceError> {
        let phase = CallPhase::Handshake;
        let probe = purpose == Purpose::Probe;
        let asked = self.options.md5sum.as_deref().filter(|_| !probe);
        let mut request = ConnectionHeader::default()
            .with("callerid", &*self.caller_id)
            .with("service", &*self.service)
            .with("md5sum", asked.unwrap_or("*"))
            .with("tcp_nodelay", "1");
        if let Some(name) = &self.options.type_name {
            request = request.with("type", name);
        }
        if probe {
            request = request.with("probe", "1");
        } else if self.options.persistent {
            request = request.with("persistent", "1");
        }
        let exchanged = async {
            stream.write_all(&request.encode()?).await?;
            ConnectionHeader::read(stream).await
        };
        let reply = exchanged.await.map_err(|error| match error {
            HeaderError::Io(source) => self.lost(phase, source),
            HeaderError::Truncated
            | HeaderError::NoEquals
            | HeaderError::TooLong(_)
            | HeaderError::TooManyFields => self.malformed(phase, error.to_string()),
        })?;
        if let Some(message) = reply.get("error") {
            return Err(ServiceError::Refused {
                service: self.service.clone(),
                message: clipped(message).to_owned(),
            });
        }
        match (asked, reply.md5sum()) {
            (Some(ours), Some(theirs)) if ours != "*" && theirs != "*" && ours != theirs => {
                Err(ServiceError::OtherType {
                    service: self.service.clone(),
                    theirs: format!(
                        "{}/{}",
                        clipped(reply.type_name().unwrap_or("?")),
                        clipped(theirs)
                    ),
                    ours: format!(
                        "{}/{ours}",
                        self.options.type_name.as_deref().unwrap_or("?")
                    ),
                })
            }
            _ => Ok(reply),
        }
    }

    /// One request and its answer on a connection.
    async fn exchange(
        &self,
        connection: &mut Connection,
        wire: &Wire,
        deadline: Instant,
    ) -> Result<Bytes, ServiceError> {
        connection.sound = false;
        let mut data = Buf::chain(wire.length.as_slice(), wire.request.clone());
        let writing = connection.stream.write_all_buf(&mut data);
        self.within(CallPhase::Request, deadline, writing)
            .await?
            .map_err(|source| self.lost(CallPhase::Request, source))?;
        self.sent.fetch_add(1, Ordering::Relaxed);
        let reading = connection.answer(self.options.max_response);
        let phase = CallPhase::Answer;
        let read = self.within(phase, deadline, reading).await?;
        let (ok, body) = read.map_err(|error| match error {
            AnswerError::Io(source) => self.lost(phase, source),
            AnswerError::OkByte(byte) => self.malformed(
                phase,
                format!("the answer begins with {byte}, not with 0 or 1"),
            ),
            AnswerError::TooLong(FrameTooLong { announced, limit }) => {
                ServiceError::AnswerTooLong {
                    service: self.service.clone(),
                    announced,
                    limit,
                }
            }
        })?;
        if ok {
            return Ok(body);
        }
        Err(ServiceError::Failed {
            service: self.service.clone(),
            message: String::from_utf8_lossy(&body).into_owned(),
        })
    }

    async fn within<T>(
        &self,
        phase: CallPhase,
        deadline: Instant,
        work: impl Future<Output = T>,
    ) -> Result<T, ServiceError> {
        let done = timeout_at(deadline, work).await;
        done.map_err(|_| ServiceError::Timeout {
            service: self.service.clone(),
            phase,
            limit: self.options.timeout,
        })
    }

    fn lost(&self, phase: CallPhase, source: io::Error) -> ServiceError {
        ServiceError::Lost {
            service: self.service.clone(),
            phase,
            source,
        }
    }

    fn malformed(&self, phase: CallPhase, what: String) -> ServiceError {
        ServiceError::Malformed {
            service: self.service.clone(),
            phase,
            what,
        }
    }
}

#[derive(Debug)]
struct Connection {
    stream: TcpStream,
    answers: u64,
    answered: Instant,
    /// Whether the last exchange ended with its last byte, so that another may follow.
    sound: bool,
}

impl Connection {
    fn if_sound(self) -> Option<Self> {
        self.sound.then_some(self)
    }

    /// Whether the server is still there and has said nothing out of turn.
    ///
    /// One that does not grant a persistent connection closes it right after its first answer, and nothing in its
    /// header says so: a second call that comes as quickly gives it a moment to do that.
    async fn is_open(&mut self) -> bool {
        let mut byte = [MaybeUninit::uninit()];
        // Asked of the system itself: the runtime may not have looked since the last answer.
        match SockRef::from(&self.stream).peek(&mut byte) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Ok(_) | Err(_) => return false,
        }
        let rest = match self.answers {
            1 => CLOSING_TIME.saturating_sub(self.answered.elapsed()),
            _ => Duration::ZERO,
        };
        rest.is_zero() || timeout(rest, self.stream.peek(&mut [0])).await.is_err()
    }

    /// The ok byte and the body of an answer.
    async fn answer(&mut self, limit: usize) -> Result<(bool, Bytes), AnswerError> {
        let ok = match self.stream.read_u8().await? {
            0 => false,
            1 => true,
            other => return Err(AnswerError::OkByte(other)),
        };
        let mut frames = Frames::new(limit);
        loop {
            if let Some(body) = frames.next()? {
                self.sound = frames.is_empty();
                self.answers += 1;
                self.answered = clock::now();
                return Ok((ok, body));
            }
            match self.stream.read_buf(frames.room()).await? {
                0 => return Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()),
                read => frames.filled(read),
            }
        }
    }
}

#[derive(Debug, Error)]
enum AnswerError {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error(transparent)]
    TooLong(#[from] FrameTooLong),
    #[error("{0} is no ok byte")]
    OkByte(u8),
}

/// What a call was at when it ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CallPhase {
    /// Waiting for earlier calls: for the persistent connection, or for a turn to connect.
    Queue,
    /// Asking the master where the service is.
    Lookup,
    /// Connecting to the server.
    Connect,
    /// Exchanging connection headers.
    Handshake,
    /// Sending the request.
    Request,
    /// The request is sent, the answer awaited.
    Answer,
}

impl fmt::Display for CallPhase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Queue => "waiting for earlier calls to the same service",
            Self::Lookup => "asking the master for it",
            Self::Connect => {
                "connecting to it (if its node is gone, `rosnode cleanup` removes it from the master)"
            }
            Self::Handshake => "exchanging connection headers",
            Self::Request => "sending the request",
            Self::Answer => "waiting for the answer",
        })
    }
}

/// Why a call brought no answer.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The master knows no node that offers it.
    #[error("no node offers {service}: `rosservice list` shows what the master knows")]
    NotAdvertised {
        /// The resolved service.
        service: String,
    },
    /// The master could not be asked.
    #[error("the ROS master at {uri} could not be asked where {service} is: {source}")]
    Master {
        /// The resolved service.
        service: String,
        /// Where the master should be.
        uri: String,
        /// What went wrong there.
        #[source]
        source: MasterError,
    },
    /// Nobody listens where the master says the service is, or its host name does not resolve.
    #[error(
        "no connection to {host}:{port}, where the master says {service} is: {source}. If that node is gone, \
         `rosnode cleanup` removes it from the master; if it runs, check that {host} resolves and is reached from here"
    )]
    NoConnection {
        /// The resolved service.
        service: String,
        /// The server's host, as registered.
        host: String,
        /// The server's port.
        port: u16,
        /// What the system says.
        #[source]
        source: io::Error,
    },
    /// The server answered the connection header with `error=`: most often another type.
    #[error("the server of {service} refuses: {message}")]
    Refused {
        /// The resolved service.
        service: String,
        /// The server's words.
        message: String,
    },
    /// The server took the connection, and its header names another type.
    #[error("{service} has the type {theirs}, and {ours} is wanted")]
    OtherType {
        /// The resolved service.
        service: String,
        /// Name and checksum of the server's type.
        theirs: String,
        /// Name and checksum of the client's type.
        ours: String,
    },
    /// The server ran the call and answers that it failed.
    #[error("{service} failed: {message}")]
    Failed {
        /// The resolved service.
        service: String,
        /// The server's words; U+FFFD stands for what is not UTF-8.
        message: String,
    },
    /// The time for the call is over.
    #[error("{service}: the call was given up after {limit:?} while {phase}")]
    Timeout {
        /// The resolved service.
        service: String,
        /// What took too long.
        phase: CallPhase,
        /// The time given to the whole call.
        limit: Duration,
    },
    /// The connection ended within the call.
    #[error("the connection to the server of {service} was lost while {phase}: {source}")]
    Lost {
        /// The resolved service.
        service: String,
        /// When it ended.
        phase: CallPhase,
        /// What the system says.
        #[source]
        source: io::Error,
    },
    /// The request has no length on the wire.
    #[error("a request of {bytes} bytes for {service} is longer than TCPROS can say")]
    RequestTooLong {
        /// The resolved service.
        service: String,
        /// Length of the request.
        bytes: usize,
    },
    /// The answer is longer than the options allow.
    #[error("the answer of {service} has {announced} bytes, more than the limit of {limit}")]
    AnswerTooLong {
        /// The resolved service.
        service: String,
        /// Length of the answer.
        announced: u32,
        /// The limit it exceeds.
        limit: usize,
    },
    /// The master or the server broke the protocol.
    #[error("{service}: {what}")]
    Malformed {
        /// The resolved service.
        service: String,
        /// What the call was at.
        phase: CallPhase,
        /// What is wrong.
        what: String,
    },
}

impl ServiceError {
    /// Whether the server may have acted on the request though no answer tells so: the request was sent as a whole,
    /// and the answer was lost or not taken. When this is false, the server either answered, with
    /// [`ServiceError::Failed`], or never had the whole request.
    pub const fn may_have_run(&self) -> bool {
        match self {
            Self::Timeout { phase, .. }
            | Self::Lost { phase, .. }
            | Self::Malformed { phase, .. } => matches!(phase, CallPhase::Answer),
            Self::AnswerTooLong { .. } => true,
            Self::NotAdvertised { .. }
            | Self::Master { .. }
            | Self::NoConnection { .. }
            | Self::Refused { .. }
            | Self::OtherType { .. }
            | Self::Failed { .. }
            | Self::RequestTooLong { .. } => false,
        }
    }

    const fn is_lost_in_request(&self) -> bool {
        matches!(
            self,
            Self::Lost {
                phase: CallPhase::Request,
                ..
            }
        )
    }
}

/// Connections of one client that are opened at the same time. The accept queues of a rospy node
/// and of rosmaster hold five connections. The kernel drops the packets of further connections, and
/// repeats them with growing pauses.
const MOST_OPENING: usize = 4;
/// How quickly a server that closes after its answer is expected to have closed.
const CLOSING_TIME: Duration = Duration::from_millis(50);
