//! Calling a service: lookup, connection, request and response.

mod error;

use std::io::{self, IoSlice};
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

pub use self::error::{CallPhase, ServiceError};
use super::DEFAULT_MAX_BODY;
use crate::clock;
use crate::frame::{FrameTooLong, Frames};
use crate::header::{ConnectionHeader, HeaderError, clipped};
use crate::link::prepare;
use crate::master::{Master, MasterError};
use crate::rpc;

/// Type, connection and time limits of a service client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServiceClientOptions {
    /// Checksum of the service's type. `None` sends `*`, which servers of roscpp, rospy and this
    /// crate accept.
    pub md5sum: Option<String>,
    /// Name, such as `std_srvs/SetBool`. Servers do not need it; it is for the analysis of traffic.
    pub type_name: Option<String>,
    /// Keeps a connection for all calls, which are then made in sequence. If the server
    /// closes the connection, the next call looks up the server and connects again.
    pub persistent: bool,
    /// Time limit of a whole call: waiting for earlier calls, lookup, connecting, request and
    /// response.
    pub timeout: Duration,
    /// Maximum length of a response, in bytes. A longer response closes the connection.
    pub max_response: usize,
}

impl Default for ServiceClientOptions {
    /// Returns options for any type, a connection per call, 10 seconds and 64 MiB.
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

/// Calls a service. Clones share the connection of a persistent client. The client may outlive
/// its node.
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
    /// The connection of a persistent client between two calls. A call takes the connection out, so
    /// that a dropped call also drops the connection.
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

    /// Creates a client for a caller that is not a node of the graph. The master at `uri`
    /// (`http://host:port`) resolves the address of the service. `service` is the full name.
    ///
    /// # Errors
    /// Fails if the URI is invalid.
    pub fn of_master(
        uri: &str,
        caller_id: &str,
        service: &str,
        options: ServiceClientOptions,
    ) -> Result<Self, MasterError> {
        let master = Master::at(uri, caller_id)?;
        Ok(Self::new(service.to_owned(), options, caller_id, master))
    }

    /// Returns the number of requests that were sent as a whole, answered or not.
    pub fn requests_sent(&self) -> u64 {
        self.shared.sent.load(Ordering::Relaxed)
    }

    /// Returns the resolved name of the service.
    pub fn service(&self) -> &str {
        &self.shared.service
    }

    /// Sends a serialized request, without its length, and returns the serialized response.
    ///
    /// The request is never sent twice. After an error, [`ServiceError::may_have_run`] returns
    /// whether the server may have executed the call. Dropping the future aborts the call and
    /// closes its connection; the server may still execute the call.
    pub async fn call(&self, request: Bytes) -> Result<Bytes, ServiceError> {
        self.call_by(request, None).await
    }

    /// Calls as [`call`](Self::call) does. After `start_by`, no byte of the request is sent any
    /// more, so the call ends with [`ServiceError::TooLate`] unless the server has the whole
    /// request.
    pub async fn call_by(
        &self,
        request: Bytes,
        start_by: Option<Instant>,
    ) -> Result<Bytes, ServiceError> {
        let length = u32::try_from(request.len()).map_err(|_| ServiceError::RequestTooLong {
            service: self.service().to_owned(),
            bytes: request.len(),
        })?;
        let wire = Wire {
            length: length.to_le_bytes(),
            request,
            start_by,
        };
        let deadline = self.shared.deadline();
        // The futures are large: they are boxed to keep them out of the caller's future.
        if self.shared.options.persistent {
            Box::pin(self.shared.call_kept(&wire, deadline)).await
        } else {
            Box::pin(self.shared.call_once(&wire, deadline)).await
        }
    }

    /// Requests the header of the server without calling the service: `type`, `md5sum`, `callerid`,
    /// and from roscpp and this crate also `request_type` and `response_type`.
    pub async fn probe(&self) -> Result<ConnectionHeader, ServiceError> {
        let deadline = self.shared.deadline();
        let probing = self.shared.connect(deadline, Purpose::Probe);
        let (mut connection, header) = Box::pin(probing).await?;
        connection.sound = true;
        Ok(header)
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
    /// The time after which nothing of it is sent.
    start_by: Option<Instant>,
}

impl Wire {
    /// Sends the request. The time is compared directly before each write, because the process may
    /// not have run for a while. A request that was sent in part does not reach the service: the
    /// connection is closed.
    async fn send(&self, stream: &TcpStream) -> Result<(), SendError> {
        let mut data = Buf::chain(self.length.as_slice(), &*self.request);
        while data.has_remaining() {
            stream.writable().await?;
            if self
                .start_by
                .is_some_and(|start_by| clock::now() > start_by)
            {
                return Err(SendError::TooLate);
            }
            let mut parts = [IoSlice::new(&[]), IoSlice::new(&[])];
            let filled = data.chunks_vectored(&mut parts);
            match stream.try_write_vectored(parts.get(..filled).unwrap_or(&parts)) {
                Ok(0) => return Err(io::Error::from(io::ErrorKind::WriteZero).into()),
                Ok(written) => data.advance(written),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }
}

/// The reason why a request was not sent as a whole.
#[derive(Debug, Error)]
enum SendError {
    #[error(transparent)]
    Io(#[from] io::Error),
    #[error("too late")]
    TooLate,
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
            // The server has not received the whole request, so it has not executed the call: a new
            // connection may be used.
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

    /// Sends a request and receives its response on a connection.
    async fn exchange(
        &self,
        connection: &mut Connection,
        wire: &Wire,
        deadline: Instant,
    ) -> Result<Bytes, ServiceError> {
        connection.sound = false;
        let sending = wire.send(&connection.stream);
        let sent = self.within(CallPhase::Request, deadline, sending).await?;
        sent.map_err(|error| match error {
            SendError::Io(source) => self.lost(CallPhase::Request, source),
            SendError::TooLate => ServiceError::TooLate {
                service: self.service.clone(),
            },
        })?;
        self.sent.fetch_add(1, Ordering::Relaxed);
        let reading = connection.answer(self.options.max_response);
        let phase = CallPhase::Answer;
        let read = self.within(phase, deadline, reading).await?;
        let (ok, body) = read.map_err(|error| match error {
            AnswerError::Io(source) => self.lost(phase, source),
            AnswerError::OkByte(byte) => self.malformed(
                phase,
                format!("the response begins with {byte}, not with 0 or 1"),
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
    /// Whether the last exchange ended with its last byte, so that another exchange may follow.
    sound: bool,
}

impl Drop for Connection {
    /// Discards a request that was not answered and may still wait in the socket: it would reach
    /// the server late, after its caller has given it up.
    fn drop(&mut self) {
        if !self.sound {
            let _closed_already = SockRef::from(&self.stream).set_linger(Some(Duration::ZERO));
        }
    }
}

impl Connection {
    fn if_sound(self) -> Option<Self> {
        self.sound.then_some(self)
    }

    /// Returns whether the connection is open and has no unexpected data.
    ///
    /// A server that does not grant a persistent connection closes it right after its first
    /// response, and its header does not announce this. A second call that follows quickly
    /// therefore waits for a moment.
    async fn is_open(&mut self) -> bool {
        if !self.is_quiet() {
            return false;
        }
        let rest = match self.answers {
            1 => CLOSING_TIME.saturating_sub(self.answered.elapsed()),
            _ => Duration::ZERO,
        };
        if rest.is_zero() {
            return true;
        }
        let closing = timeout(rest, self.stream.peek(&mut [0])).await;
        // The time of a process that did not run for a while ends before its runtime polls the
        // socket.
        closing.is_err() && self.is_quiet()
    }

    /// Returns whether nothing was received: neither data nor the end of the connection. Reads from
    /// the system itself: the runtime may not have polled the socket after the last response.
    fn is_quiet(&self) -> bool {
        let mut byte = [MaybeUninit::uninit()];
        let peeked = SockRef::from(&self.stream).peek(&mut byte);
        peeked.is_err_and(|error| error.kind() == io::ErrorKind::WouldBlock)
    }

    /// Reads the ok byte and the body of a response.
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
    #[error("{0} is not a valid ok byte")]
    OkByte(u8),
}

/// Connections of one client that are opened at the same time. The accept queues of a rospy node
/// and of rosmaster hold five connections. The kernel drops the packets of further connections, and
/// repeats them with growing pauses.
const MOST_OPENING: usize = 4;
/// Time within which a server that closes after its response is expected to have closed.
const CLOSING_TIME: Duration = Duration::from_millis(50);
