//! Offering a service: reading requests, running the handler, answering each client in its own way.

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
use super::mapping::{self, Outgoing, Received, ReplyTo};
use super::opening::Opening;
use super::peers::ServicePeers;
use super::{BUSY, IDLE, Service, next, policies};
use crate::domain::{Domain, DomainError};
use crate::raw::{Payload, Reader, Writer};

/// What a service does for its clients, at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceOptions {
    /// Requests handled at once.
    pub max_handled: usize,
    /// Requests that wait for that. When they are more, the oldest is dropped: its client has waited longest, and may
    /// have given up.
    pub max_waiting: usize,
    /// How long the handler may take for one request. Past that it is dropped, and the client gets no answer: services
    /// of ROS 2 have no word for failure.
    pub handler_timeout: Option<Duration>,
}

impl Default for ServiceOptions {
    /// 64 requests, 1024 waiting, one minute.
    fn default() -> Self {
        Self {
            max_handled: 64,
            max_waiting: 1024,
            handler_timeout: Some(Duration::from_secs(60)),
        }
    }
}

/// One request, as the handler of a service gets it.
#[derive(Clone, Debug)]
pub struct ServiceRequest {
    /// CDR with its encapsulation header, in the client's byte order. Any bytes may stand behind the header.
    pub bytes: Bytes,
    /// The writer of the request.
    pub client: GUID,
}

/// Offers one service. Dropping it withdraws the service; requests in progress stay unanswered.
#[derive(Debug)]
pub struct ServiceServer {
    service: String,
    counters: Arc<Counters>,
    task: AbortHandle,
}

/// What a service has done so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ServiceCounters {
    /// Requests given to the handler.
    pub calls: u64,
    /// Requests the handler failed at, or took too long for.
    pub failures: u64,
    /// Samples that were no requests.
    pub malformed: u64,
    /// Requests dropped because too many waited.
    pub overflowed: u64,
    /// Replies dropped because the client's reader did not appear, or takes nothing.
    pub undelivered: u64,
}

impl ServiceCounters {
    /// Of two services together.
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
    /// Makes the endpoints and serves. To be called on a tokio runtime. The handler returns CDR in little endian with
    /// its encapsulation header; with an error, which is logged, the client gets no answer.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open<H, F>(
        domain: &Domain,
        peers: &ServicePeers,
        service: &Service,
        options: ServiceOptions,
        handler: H,
    ) -> Result<Self, DomainError>
    where
        H: Fn(ServiceRequest) -> F + Send + Sync + 'static,
        F: Future<Output = Result<Bytes, String>> + Send + 'static,
    {
        let handler = move |request| {
            let reply = handler(request);
            async { reply.await.map(Answer::from) }
        };
        Self::open_told(domain, peers, service, options, handler)
    }

    /// As [`open`](Self::open), for a handler that has to know when its reply is out.
    pub(crate) fn open_told<H, F>(
        domain: &Domain,
        peers: &ServicePeers,
        service: &Service,
        options: ServiceOptions,
        handler: H,
    ) -> Result<Self, DomainError>
    where
        H: Fn(ServiceRequest) -> F + Send + Sync + 'static,
        F: Future<Output = Result<Answer, String>> + Send + 'static,
    {
        let types = &service.types;
        // The writer first: who finds our reader then most likely finds it too.
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

    /// The service's ROS name.
    #[must_use]
    pub fn service(&self) -> &str {
        &self.service
    }

    /// What it has done.
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

/// What a handler answers.
#[derive(Debug)]
pub(crate) struct Answer {
    /// CDR in little endian with its encapsulation header.
    pub(crate) bytes: Bytes,
    /// Dropped once the reply is given to the client's reader, or given up.
    pub(crate) written: Option<oneshot::Sender<Never>>,
}

/// What is never sent: that the sender is gone tells all.
#[derive(Debug)]
pub(crate) enum Never {}

impl From<Bytes> for Answer {
    fn from(bytes: Bytes) -> Self {
        Self {
            bytes,
            written: None,
        }
    }
}

type Pending = Pin<Box<dyn Future<Output = Result<Answer, String>> + Send>>;

/// Owns the endpoints and all requests in progress.
struct Driver {
    service: Service,
    peers: ServicePeers,
    writer: Writer,
    options: ServiceOptions,
    handler: Box<dyn Fn(ServiceRequest) -> Pending + Send + Sync>,
    counters: Arc<Counters>,
    waiting: VecDeque<(ReplyTo, Bytes)>,
    handled: JoinSet<(ReplyTo, Result<Answer, String>)>,
    /// Replies whose client is not matched yet, or that find the send window full, oldest first.
    replies: VecDeque<Reply>,
    audience: Audience,
    opening: Opening,
}

struct Reply {
    to: ReplyTo,
    payload: Payload,
    related: Option<rustdds::rpc::SampleIdentity>,
    until: Instant,
    _written: Option<oneshot::Sender<Never>>,
}

impl Driver {
    async fn run(mut self, reader: Reader) {
        loop {
            // Each branch is cancel-safe: nothing is taken but by the branch that completes.
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

    fn received(&mut self, request: Option<Received>) {
        let opened = match request {
            // Of a client of ours: nobody here is to be asked what others are.
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
                    why, "a sample that is no request"
                );
                count(&self.counters.malformed);
            }
        }
    }

    /// Runs the handler, in a task of its own: a panic ends that alone.
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
                    Err(format!("its handler gave no answer within {limit:?}"))
                }),
            };
            (to, result)
        });
    }

    fn failed(&self, why: &str) {
        if self.counters.failures.fetch_add(1, Ordering::Relaxed) == 0 {
            warn!(
                service = self.service.name,
                why, "a call gets no answer; others are not told of"
            );
        } else {
            debug!(service = self.service.name, why, "a call gets no answer");
        }
    }

    fn done(&mut self, to: ReplyTo, result: Result<Answer, String>, now: Instant) {
        let sealed = result.and_then(|Answer { bytes, written }| {
            let Outgoing { payload, related } =
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

    /// Writes the replies whose clients can take them by now.
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
                    debug!(service = self.service.name, ?client, "a reply nobody takes");
                    count(&self.counters.undelivered);
                }
                None => {}
            }
        }
    }

    /// The readers of a client: the one its request names, else all of its participant, as Cyclone's requests do not say
    /// which. `None` while the client has none that could hear us.
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

    /// Returns the reply when the send window is full.
    fn write(&mut self, reply: Reply, targets: &[GUID], now: Instant) -> Option<Reply> {
        for reader in targets {
            // To them alone: a reply in one vendor's way is garbage to the clients of another.
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
