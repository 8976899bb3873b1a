//! The service server: reads requests, runs the handler, and replies to each client in its vendor's
//! mapping.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use rustdds::dds::WriteError;
use rustdds::{GUID, WriteOptionsBuilder};
use tokio::sync::oneshot;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, warn};

use super::audience::Audience;
use super::mapping::{self, OutgoingServiceSample, ReceivedServiceSample, ReplyTo};
use super::opening::Opening;
use super::peers::ServicePeers;
use super::{BUSY, IDLE, ServiceName, next, policies};
use crate::domain::{Domain, DomainError};
use crate::raw::{Payload, PayloadReader, PayloadWriter};

/// The limits of a service server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceOptions {
    /// Maximum number of requests handled concurrently.
    pub max_handled: usize,
    /// Maximum number of waiting requests. Beyond it, the oldest request is dropped: its client has
    /// waited longest and may have given up.
    pub max_waiting: usize,
    /// The timeout of the handler for one request. When it expires, the handler is dropped and the
    /// client gets no reply: ROS 2 services cannot report a failure.
    pub handler_timeout: Option<Duration>,
}

impl Default for ServiceOptions {
    /// Returns limits of 64 handled and 1024 waiting requests, and a timeout of one minute.
    fn default() -> Self {
        Self {
            max_handled: 64,
            max_waiting: 1024,
            handler_timeout: Some(Duration::from_secs(60)),
        }
    }
}

/// A request, as passed to the handler of a service.
#[derive(Clone, Debug)]
pub struct ServiceRequest {
    /// CDR with its encapsulation header, in the client's byte order. The bytes after the header
    /// are not validated.
    pub bytes: Bytes,
    /// The writer of the request.
    pub client: GUID,
}

/// Offers a service. Dropping it withdraws the service; requests in progress stay unanswered.
#[derive(Debug)]
pub struct ServiceServer {
    service: String,
    counters: Arc<Counters>,
    task: AbortHandle,
}

/// The counters of a service.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ServiceCounters {
    /// Requests passed to the handler.
    pub calls: u64,
    /// Requests for which the handler failed or timed out.
    pub failures: u64,
    /// Samples that were not valid requests.
    pub malformed: u64,
    /// Requests dropped because too many waited.
    pub overflowed: u64,
    /// Replies dropped because the client's reader did not appear or did not accept them.
    pub undelivered: u64,
}

impl ServiceCounters {
    /// Returns the sums of the counters of two services.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            calls: self.calls + other.calls,
            failures: self.failures + other.failures,
            malformed: self.malformed + other.malformed,
            overflowed: self.overflowed + other.overflowed,
            undelivered: self.undelivered + other.undelivered,
        }
    }
}

#[derive(Debug, Default)]
struct Counters {
    calls: AtomicU64,
    failures: AtomicU64,
    malformed: AtomicU64,
    overflowed: AtomicU64,
    undelivered: AtomicU64,
}

impl ServiceServer {
    /// Creates the endpoints and starts to serve. Call this on a tokio runtime. The handler returns
    /// little-endian CDR with its encapsulation header; its errors are logged, and the client gets
    /// no reply.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open<H, F>(
        domain: &Domain,
        peers: &ServicePeers,
        service: &ServiceName,
        options: ServiceOptions,
        handler: H,
    ) -> Result<Self, DomainError>
    where
        H: Fn(ServiceRequest) -> F + Send + Sync + 'static,
        F: Future<Output = Result<Bytes, String>> + Send + 'static,
    {
        let handler = move |request| {
            let reply = handler(request);
            async { reply.await.map(HandlerResult::from) }
        };
        Self::open_told(domain, peers, service, options, handler)
    }

    /// Opens a server as [`open`](Self::open) does, for a handler that has to know when its reply
    /// was written.
    pub(crate) fn open_told<H, F>(
        domain: &Domain,
        peers: &ServicePeers,
        service: &ServiceName,
        options: ServiceOptions,
        handler: H,
    ) -> Result<Self, DomainError>
    where
        H: Fn(ServiceRequest) -> F + Send + Sync + 'static,
        F: Future<Output = Result<HandlerResult, String>> + Send + 'static,
    {
        let types = &service.types;
        // The writer comes first: a client that has discovered the reader most likely knows the
        // writer too.
        let writer = domain.open_writer(&service.reply_topic(), &types.response, &policies())?;
        let reader = domain.open_reader(&service.request_topic(), &types.request, &policies())?;
        let counters: Arc<Counters> = Arc::default();
        let driver = Driver {
            service: service.clone(),
            peers: peers.clone(),
            writer,
            options,
            handler: Box::new(move |request| Box::pin(handler(request))),
            counters: Arc::clone(&counters),
            waiting: VecDeque::new(),
            handled: JoinSet::new(),
            replies: VecDeque::new(),
            audience: Audience::default(),
            opening: Opening::new(),
        };
        let task = tokio::spawn(driver.run(reader)).abort_handle();
        Ok(Self {
            service: service.name.clone(),
            counters,
            task,
        })
    }

    /// Returns the ROS name of the service.
    #[must_use]
    pub fn service(&self) -> &str {
        &self.service
    }

    /// Returns the counters.
    #[must_use]
    pub fn counters(&self) -> ServiceCounters {
        let Counters {
            calls,
            failures,
            malformed,
            overflowed,
            undelivered,
        } = &*self.counters;
        let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        ServiceCounters {
            calls: read(calls),
            failures: read(failures),
            malformed: read(malformed),
            overflowed: read(overflowed),
            undelivered: read(undelivered),
        }
    }
}

impl Drop for ServiceServer {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The result of a handler.
#[derive(Debug)]
pub(crate) struct HandlerResult {
    /// Little-endian CDR with its encapsulation header.
    pub(crate) bytes: Bytes,
    /// Dropped once the reply is written for the client's reader, or given up.
    pub(crate) written: Option<oneshot::Sender<NoValue>>,
}

/// A type without values: only the drop of the sender is signalled.
#[derive(Debug)]
pub(crate) enum NoValue {}

impl From<Bytes> for HandlerResult {
    fn from(bytes: Bytes) -> Self {
        Self {
            bytes,
            written: None,
        }
    }
}

type Pending = Pin<Box<dyn Future<Output = Result<HandlerResult, String>> + Send>>;

/// Owns the endpoints and all requests in progress.
struct Driver {
    service: ServiceName,
    peers: ServicePeers,
    writer: PayloadWriter,
    options: ServiceOptions,
    handler: Box<dyn Fn(ServiceRequest) -> Pending + Send + Sync>,
    counters: Arc<Counters>,
    waiting: VecDeque<(ReplyTo, Bytes)>,
    handled: JoinSet<(ReplyTo, Result<HandlerResult, String>)>,
    /// Replies that wait for the match of their client or for the send window; oldest first.
    replies: VecDeque<Reply>,
    audience: Audience,
    opening: Opening,
}

struct Reply {
    to: ReplyTo,
    payload: Payload,
    related: Option<rustdds::rpc::SampleIdentity>,
    until: Instant,
    _written: Option<oneshot::Sender<NoValue>>,
}

impl Driver {
    async fn run(mut self, reader: PayloadReader) {
        loop {
            // Each branch is cancel-safe: only the branch that completes takes an item.
            let tick = Instant::now() + BUSY;
            tokio::select! {
                request = next(&reader) => self.received(request),
                Some(done) = self.handled.join_next() => match done {
                    Ok((to, result)) => self.done(to, result, Instant::now()),
                    Err(error) => self.failed(&error.to_string()),
                },
                () = sleep_until(tick), if !self.replies.is_empty() => {}
            }
            while self.handled.len() < self.options.max_handled
                && let Some((to, bytes)) = self.waiting.pop_front()
            {
                self.handle(to, bytes);
            }
            self.send(Instant::now());
        }
    }

    fn received(&mut self, request: Option<ReceivedServiceSample>) {
        let opened = match request {
            // A request of a client of this bridge: the server is for requests of other
            // participants only.
            Some(request) if self.peers.is_own(request.writer) => return,
            Some(request) => {
                let mapping = self.peers.mapping_of(request.writer);
                mapping::open_request(mapping, request).map_err(mapping::Fault::label)
            }
            None => Err("an unknown encoding"),
        };
        match opened {
            Ok(request) => {
                if self.waiting.len() >= self.options.max_waiting {
                    self.waiting.pop_front();
                    count(&self.counters.overflowed);
                }
                self.waiting.push_back(request);
            }
            Err(why) => {
                debug!(
                    service = self.service.name,
                    why, "dropped a sample that is not a request"
                );
                count(&self.counters.malformed);
            }
        }
    }

    /// Runs the handler in its own task, so that a panic ends only that task.
    fn handle(&mut self, to: ReplyTo, bytes: Bytes) {
        count(&self.counters.calls);
        let answer = (self.handler)(ServiceRequest {
            bytes,
            client: to.client(),
        });
        let limit = self.options.handler_timeout;
        self.handled.spawn(async move {
            let result = match limit {
                None => answer.await,
                Some(limit) => timeout(limit, answer).await.unwrap_or_else(|_| {
                    Err(format!("its handler did not respond within {limit:?}"))
                }),
            };
            (to, result)
        });
    }

    fn failed(&self, why: &str) {
        if self.counters.failures.fetch_add(1, Ordering::Relaxed) == 0 {
            warn!(
                service = self.service.name,
                why, "a call gets no response; further ones are logged at DEBUG"
            );
        } else {
            debug!(service = self.service.name, why, "a call gets no response");
        }
    }

    fn done(&mut self, to: ReplyTo, result: Result<HandlerResult, String>, now: Instant) {
        let sealed = result.and_then(|HandlerResult { bytes, written }| {
            let OutgoingServiceSample { payload, related } =
                mapping::seal_reply(&to, bytes).map_err(|fault| fault.label().to_owned())?;
            let payload = Payload::to_write(payload).map_err(|error| error.label().to_owned())?;
            Ok((payload, related, written))
        });
        match sealed {
            Ok((payload, related, written)) => {
                if self.replies.len() >= self.options.max_waiting {
                    self.replies.pop_front();
                    count(&self.counters.undelivered);
                }
                self.replies.push_back(Reply {
                    to,
                    payload,
                    related,
                    until: now + DELIVERY,
                    _written: written,
                });
            }
            Err(why) => self.failed(&why),
        }
    }

    /// Writes the replies that their clients can receive by `now`.
    fn send(&mut self, now: Instant) {
        self.audience.listen(&self.writer, now);
        for reply in std::mem::take(&mut self.replies) {
            let kept = match self.targets(&reply.to, now) {
                Some(targets) if self.opening.is_over(&self.writer, now) => {
                    self.write(reply, &targets, now)
                }
                Some(_) | None => Some(reply),
            };
            match kept {
                Some(reply) if now < reply.until => self.replies.push_back(reply),
                Some(reply) => {
                    let client = reply.to.client();
                    debug!(
                        service = self.service.name,
                        ?client,
                        "a response without a recipient"
                    );
                    count(&self.counters.undelivered);
                }
                None => {}
            }
        }
    }

    /// Returns the readers of a client: the reader that its request names, else all readers of its
    /// participant, because requests of Cyclone do not name the reader. Returns `None` while the
    /// client has no reachable reader.
    fn targets(&mut self, to: &ReplyTo, now: Instant) -> Option<Vec<GUID>> {
        let topic = self.service.reply_topic();
        let mut age = IDLE;
        loop {
            let snapshot = self.peers.look(now, age);
            let readers = snapshot.readers(&topic).iter().map(|reader| reader.guid);
            self.audience.meet(readers.clone(), now);
            let of_client = |guid: &GUID| match to.reader() {
                Some(reader) => *guid == reader,
                None => guid.prefix == to.client().prefix,
            };
            let hears = |guid: &GUID| self.audience.hears(*guid, now);
            let found: Vec<GUID> = readers.filter(of_client).filter(hears).collect();
            if !found.is_empty() {
                return Some(found);
            }
            if age == BUSY {
                return None;
            }
            age = BUSY;
        }
    }

    /// Writes the reply to the readers; returns it if the send window is full.
    fn write(&mut self, reply: Reply, targets: &[GUID], now: Instant) -> Option<Reply> {
        for reader in targets {
            // Addressed to these readers only: clients of one vendor cannot read the mapping of
            // another.
            let options = WriteOptionsBuilder::new()
                .related_sample_identity_opt(reply.related)
                .to_single_reader(*reader)
                .build();
            match self
                .writer
                .write_with_options(reply.payload.clone(), options)
            {
                Ok(_) => {}
                Err(WriteError::WouldBlock { .. }) => return Some(reply),
                Err(
                    WriteError::Serialization { .. }
                    | WriteError::Poisoned { .. }
                    | WriteError::Io(_)
                    | WriteError::Internal { .. },
                ) => count(&self.counters.undelivered),
            }
        }
        self.opening.written(self.audience.readers(), now);
        None
    }
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// How long a reply waits for its client's reader; rmw_fastrtps waits 0.1 s.
const DELIVERY: Duration = Duration::from_secs(1);
