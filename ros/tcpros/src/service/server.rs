//! Offering a service: admission of clients, reading requests, running the handler, responding.

use std::fmt;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use bytes::{BufMut, Bytes, BytesMut};
use log_limit::Throttle;
use thiserror::Error;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use super::{DEFAULT_MAX_BODY, ServiceTypeSum};
use crate::clock;
use crate::events;
use crate::frame::{FrameTooLong, Frames};
use crate::header::{ConnectionHeader, clipped};
use crate::inbox::ConnectionPeer;
use crate::node::Inner;
use crate::outbox::lock;
use crate::refusal::ConnectionRefusal;
use crate::topic_server::{ConnectionEnd, DRAIN_LIMIT, STALL_LIMIT, until_closed, write};

/// Limits of a service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceOptions {
    /// Maximum length of a request, in bytes. A longer request is answered with an error and closes
    /// its connection.
    pub max_request: usize,
    /// Maximum number of connected clients, including idle persistent clients. A further client is
    /// refused with an error.
    pub max_clients: usize,
    /// Time limit of the handler for a request. Beyond it the handler is dropped and the client
    /// receives an error.
    pub handler_timeout: Duration,
}

impl Default for ServiceOptions {
    /// Returns limits of 64 MiB, 256 clients and 60 seconds.
    fn default() -> Self {
        Self {
            max_request: DEFAULT_MAX_BODY,
            max_clients: 256,
            handler_timeout: Duration::from_secs(60),
        }
    }
}

/// A request, as passed to the handler of a service.
#[derive(Clone, Debug)]
pub struct ServiceRequest {
    /// The serialized request without its length. Its type is that of the service, unless the
    /// client connected with the checksum `*`.
    pub bytes: Bytes,
    /// The client.
    pub client: Arc<ConnectionPeer>,
}

/// Offers a service. Dropping it withdraws the service: idle clients are disconnected at once,
/// and a client with a request in progress gets its response if that takes no more than a second.
#[derive(Debug)]
pub struct ServiceServer {
    served: Arc<OfferedService>,
    node: Arc<Inner>,
}

impl ServiceServer {
    pub(crate) const fn new(served: Arc<OfferedService>, node: Arc<Inner>) -> Self {
        Self { served, node }
    }

    /// Returns the resolved name of the service.
    pub fn service(&self) -> &str {
        &self.served.service
    }

    /// Returns the number of received requests, including failed requests.
    pub fn calls(&self) -> u64 {
        self.served.counters.calls.load(Ordering::Relaxed)
    }

    /// Returns the number of requests that were answered with an error text.
    pub fn failures(&self) -> u64 {
        self.served.counters.failures.load(Ordering::Relaxed)
    }

    /// Returns the number of received request bytes, without lengths.
    pub fn bytes_received(&self) -> u64 {
        self.served.counters.received.load(Ordering::Relaxed)
    }

    /// Returns the number of sent response bytes, including error texts, without lengths.
    pub fn bytes_sent(&self) -> u64 {
        self.served.counters.sent.load(Ordering::Relaxed)
    }

    /// Returns the number of refused clients: for their checksum, their number, or protocol
    /// violations.
    pub fn refused(&self) -> u64 {
        self.served.counters.refused.load(Ordering::Relaxed)
    }

    /// Returns the number of connected clients.
    pub fn clients(&self) -> usize {
        let free = self.served.places.available_permits();
        self.served.options.max_clients.saturating_sub(free)
    }
}

impl Drop for ServiceServer {
    fn drop(&mut self) {
        self.served.close();
        self.node.withdraw_service(&self.served);
    }
}

/// The reason why a request has no response. The client gets its text.
#[derive(Debug, thiserror::Error)]
enum FailedRequest {
    /// The handler gave this text.
    #[error("{0}")]
    Handler(String),
    #[error(transparent)]
    TooLong(#[from] FrameTooLong),
    #[error("service [{service}]: {given_up}")]
    Aborted {
        service: String,
        given_up: AbortedRequest,
    },
}

/// The reason why a handler was aborted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
enum AbortedRequest {
    #[error("its handler panicked")]
    Panicked,
    #[error("its handler did not respond within {limit:?}")]
    Slow { limit: Duration },
    #[error("it is being withdrawn")]
    Withdrawn,
}

type Answer = Pin<Box<dyn Future<Output = Result<Bytes, String>> + Send>>;

/// An offered service, shared by its server and the tasks that serve its clients.
pub(crate) struct OfferedService {
    pub(crate) service: String,
    /// Distinguishes this registration from earlier registrations of the same service.
    pub(crate) generation: u64,
    pub(crate) counters: ServiceServerCounters,
    service_type: ServiceTypeSum,
    options: ServiceOptions,
    handler: Box<dyn Fn(ServiceRequest) -> Answer + Send + Sync>,
    places: Arc<Semaphore>,
    /// Rate limit of the log entries about aborted requests.
    faults: Mutex<Throttle>,
    closed: watch::Sender<bool>,
    /// The node's count of connections to other nodes.
    draining: watch::Sender<usize>,
}

/// Counters of a service.
#[derive(Debug, Default)]
pub(crate) struct ServiceServerCounters {
    pub(crate) calls: AtomicU64,
    pub(crate) failures: AtomicU64,
    pub(crate) received: AtomicU64,
    pub(crate) sent: AtomicU64,
    pub(crate) refused: AtomicU64,
}

/// Outcome of a client's handshake.
#[derive(Debug)]
pub(crate) enum ClientHandshake {
    /// The client only requested the header.
    Probe,
    /// The client may send requests.
    Client(ServiceSession),
}

impl OfferedService {
    #[expect(
        clippy::too_many_arguments,
        reason = "the properties of a service, given by the only caller"
    )]
    pub(crate) fn new<H, F>(
        service: String,
        service_type: ServiceTypeSum,
        options: ServiceOptions,
        generation: u64,
        draining: watch::Sender<usize>,
        handler: H,
    ) -> Self
    where
        H: Fn(ServiceRequest) -> F + Send + Sync + 'static,
        F: Future<Output = Result<Bytes, String>> + Send + 'static,
    {
        Self {
            service,
            generation,
            counters: ServiceServerCounters::default(),
            service_type,
            // Limits the number of clients to the maximum of the semaphore.
            options: ServiceOptions {
                max_clients: options.max_clients.min(Semaphore::MAX_PERMITS),
                ..options
            },
            handler: Box::new(move |request| Box::pin(handler(request))),
            places: Arc::new(Semaphore::new(
                options.max_clients.min(Semaphore::MAX_PERMITS),
            )),
            faults: Mutex::new(Throttle::new(Duration::from_secs(10))),
            closed: watch::Sender::new(false),
            draining,
        }
    }

    /// Ends the connections of idle clients, and the other connections once they have their
    /// response.
    pub(crate) fn close(&self) {
        self.closed.send_replace(true);
    }

    /// Returns the reply header and the session of a client, or the reason for which it is refused.
    pub(crate) fn admit(
        self: &Arc<Self>,
        request: ConnectionHeader,
        own_name: &str,
    ) -> Result<(ConnectionHeader, ClientHandshake), ConnectionRefusal> {
        let admitted = self.check(&request).and_then(|()| self.take_in(request));
        if admitted.is_err() {
            self.counters.refused.fetch_add(1, Ordering::Relaxed);
        }
        let ours = &self.service_type;
        let reply = ConnectionHeader::default()
            .with("callerid", own_name)
            .with("service", &*self.service)
            .with("md5sum", &*ours.md5sum)
            .with("type", &*ours.name)
            .with("request_type", &*ours.request_type)
            .with("response_type", &*ours.response_type);
        Ok((reply, admitted?))
    }

    fn check(&self, request: &ConnectionHeader) -> Result<(), ConnectionRefusal> {
        let Some(md5sum) = request.md5sum() else {
            return Err(ConnectionRefusal::ClientHeader);
        };
        let ours = &self.service_type.md5sum;
        if md5sum == "*" || md5sum == ours {
            return Ok(());
        }
        Err(ConnectionRefusal::ServiceType {
            service: self.service.clone(),
            wanted: clipped(md5sum).to_owned(),
            ours: ours.clone(),
        })
    }

    fn take_in(
        self: &Arc<Self>,
        request: ConnectionHeader,
    ) -> Result<ClientHandshake, ConnectionRefusal> {
        if *self.closed.borrow() {
            return Err(ConnectionRefusal::NoService(self.service.clone()));
        }
        if request.get("probe") == Some("1") {
            return Ok(ClientHandshake::Probe);
        }
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| ConnectionRefusal::Full {
            service: self.service.clone(),
            clients: self.options.max_clients,
        })?;
        let persistent = request
            .get("persistent")
            .is_some_and(|asked| asked == "1" || asked.eq_ignore_ascii_case("true"));
        self.draining.send_modify(|open| *open += 1);
        Ok(ClientHandshake::Client(ServiceSession {
            served: Arc::clone(self),
            client: Arc::new(ConnectionPeer {
                caller_id: request.caller_id().to_owned(),
                header: request,
            }),
            persistent,
            _place: place,
        }))
    }

    async fn withdrawn(&self) {
        // An error would be the end as well, and cannot occur: the sender belongs to `self`.
        let _end = self
            .closed
            .subscribe()
            .wait_for(|closed| *closed)
            .await
            .is_ok();
    }
}

impl fmt::Debug for OfferedService {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Served")
            .field("service", &self.service)
            .field("service_type", &self.service_type)
            .field("counters", &self.counters)
            .finish_non_exhaustive()
    }
}

/// The session of a client of a service, which ends on drop.
#[derive(Debug)]
pub(crate) struct ServiceSession {
    served: Arc<OfferedService>,
    client: Arc<ConnectionPeer>,
    persistent: bool,
    _place: OwnedSemaphorePermit,
}

impl ServiceSession {
    /// Receives and answers requests until the client or the service ends the session.
    pub(crate) async fn serve(self, stream: &mut TcpStream) -> Result<(), ClientFault> {
        let served = &self.served;
        let (mut reader, mut writer) = stream.split();
        let mut frames = Frames::new(served.options.max_request);
        loop {
            // Requests that a client has sent ahead do not delay the withdrawal of a service.
            if *served.closed.borrow() {
                return Ok(());
            }
            let request = match self.request(&mut reader, &mut frames).await {
                Ok(Some(request)) => request,
                Ok(None) => return Ok(()),
                Err(fault) => {
                    served.counters.refused.fetch_add(1, Ordering::Relaxed);
                    if let ClientFault::TooLong(length) = fault {
                        let refused = Err(FailedRequest::TooLong(length));
                        self.answer(&mut writer, refused).await?;
                        // A client that is still writing would not read the response of a
                        // connection that is reset.
                        let gone = timeout(DRAIN_LIMIT, until_closed(&mut reader)).await;
                        tracing::trace!(?gone, "a client with too long a request has been told");
                    }
                    return Err(fault);
                }
            };
            let result = self.handle(request).await;
            self.answer(&mut writer, result).await?;
            if !self.persistent {
                return Ok(());
            }
        }
    }

    /// Returns the next request, or `None` at the end of the session.
    async fn request(
        &self,
        reader: &mut ReadHalf<'_>,
        frames: &mut Frames,
    ) -> Result<Option<Bytes>, ClientFault> {
        loop {
            if let Some(request) = frames.next()? {
                return Ok(Some(request));
            }
            let begun = !frames.is_empty();
            tokio::select! {
                read = reader.read_buf(frames.room()) => match read {
                    Ok(0) if begun => return Err(ClientFault::Half),
                    Ok(0) => return Ok(None),
                    Ok(read) => frames.filled(read),
                    Err(error) if begun => return Err(error.into()),
                    // The client disconnects without a request: the error does not matter.
                    Err(_) => return Ok(None),
                },
                () = sleep(STALL_LIMIT), if begun || !self.persistent => {
                    return Err(ClientFault::Silent(STALL_LIMIT));
                }
                () = self.served.withdrawn() => return Ok(None),
            }
        }
    }

    /// Runs the handler in a task of its own: a panic ends only this task, and an aborted handler
    /// ends with the set.
    async fn handle(&self, bytes: Bytes) -> Result<Bytes, FailedRequest> {
        let served = Arc::clone(&self.served);
        count(&served.counters.received, bytes.len());
        let request = ServiceRequest {
            bytes,
            client: Arc::clone(&self.client),
        };
        let mut call = JoinSet::new();
        call.spawn(async move { (served.handler)(request).await });
        let limit = self.served.options.handler_timeout;
        let given_up = tokio::select! {
            biased;
            Some(done) = call.join_next() => match done {
                Ok(result) => return result.map_err(FailedRequest::Handler),
                Err(_) => AbortedRequest::Panicked,
            },
            () = sleep(limit) => AbortedRequest::Slow { limit },
            () = self.overdue() => AbortedRequest::Withdrawn,
        };
        if let Some(more) = lock(&self.served.faults).admit(clock::now()) {
            let client = clipped(&self.client.caller_id);
            events::service_failed(&self.served.service, client, &given_up, more);
        }
        let service = self.served.service.clone();
        Err(FailedRequest::Aborted { service, given_up })
    }

    async fn answer(
        &self,
        writer: &mut WriteHalf<'_>,
        result: Result<Bytes, FailedRequest>,
    ) -> Result<(), ClientFault> {
        let too_long = |bytes: &Bytes| u32::try_from(bytes.len()).is_err();
        let (ok, body) = match result {
            Ok(body) if too_long(&body) => (
                0,
                Bytes::from_static(b"the response exceeds the length limit of TCPROS"),
            ),
            Ok(body) => (1, body),
            Err(fault) => (0, Bytes::from(fault.to_string())),
        };
        let counters = &self.served.counters;
        // Counted before the response is sent, so that a client that has its response finds it
        // counted.
        counters.calls.fetch_add(1, Ordering::Relaxed);
        counters
            .failures
            .fetch_add(u64::from(ok == 0), Ordering::Relaxed);
        count(&counters.sent, body.len());
        let mut head = BytesMut::with_capacity(5);
        head.put_u8(ok);
        head.put_u32_le(u32::try_from(body.len()).unwrap_or(u32::MAX));
        let overdue = std::pin::pin!(self.overdue());
        write(writer, head.freeze(), body, overdue)
            .await
            .map_err(ClientFault::Answer)
    }

    /// Waits until the service is withdrawn and the time limit for requests in progress has passed.
    async fn overdue(&self) {
        self.served.withdrawn().await;
        sleep(DRAIN_LIMIT).await;
    }
}

impl Drop for ServiceSession {
    fn drop(&mut self) {
        self.served.draining.send_modify(|open| *open -= 1);
    }
}

fn count(counter: &AtomicU64, bytes: usize) {
    counter.fetch_add(u64::try_from(bytes).unwrap_or(u64::MAX), Ordering::Relaxed);
}

/// Error of a client's connection.
#[derive(Debug, Error)]
pub(crate) enum ClientFault {
    #[error(transparent)]
    TooLong(#[from] FrameTooLong),
    #[error("it closed the connection within a request")]
    Half,
    #[error("it sent no part of its request for {0:?}")]
    Silent(Duration),
    #[error("its request was cut off: {0}")]
    Io(#[from] std::io::Error),
    #[error("it did not receive the response: {0}")]
    Answer(ConnectionEnd),
}
