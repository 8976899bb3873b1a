//! The service client: finds the servers, sends each a request in its vendor's mapping, and reports
//! failures.

use std::collections::{BTreeMap, BTreeSet, HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use rustdds::dds::WriteError;
use rustdds::{GUID, WriteOptionsBuilder};
use tokio::sync::{mpsc, oneshot};
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep_until, timeout_at};
use tracing::debug;

use super::error::{CallPhase, ServiceError};
use super::mapping::{ClientId, OutgoingServiceSample, ReceivedServiceSample, RequestKey};
use super::met::{Acquaintance, Met, all_in_step};
use super::opening::Opening;
use super::pace::{AwaitedCondition, FRESH, Pace, may_ask};
use super::peers::{ServicePeers, Snapshot};
use super::{ServiceMapping, ServiceName, next, policies};
use crate::domain::{Domain, DomainError};
use crate::raw::{Payload, PayloadReader, PayloadWriter};

/// The limits of a service client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceClientOptions {
    /// The timeout of a whole call: waiting for a server, request and reply. `None` waits until the
    /// server is lost.
    pub timeout: Option<Duration>,
    /// Maximum number of concurrent calls; a further call is refused.
    pub max_calls: usize,
}

impl Default for ServiceClientOptions {
    /// Returns a timeout of 10 seconds and a limit of 1024 calls.
    fn default() -> Self {
        Self {
            timeout: Some(Duration::from_secs(10)),
            max_calls: 1024,
        }
    }
}

/// Calls a service. Clones share its endpoints, which are removed with the last clone.
#[derive(Clone, Debug)]
pub struct ServiceClient {
    shared: Arc<ClientShared>,
}

#[derive(Debug)]
struct ClientShared {
    service: ServiceName,
    options: ServiceClientOptions,
    calls: mpsc::Sender<WaitingCall>,
    ignored: Arc<AtomicU64>,
    servers: Arc<AtomicU64>,
    acquainted: Arc<AtomicU64>,
    task: AbortHandle,
}

impl Drop for ClientShared {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl ServiceClient {
    /// Creates the endpoints and starts to look for servers. Call this on a tokio runtime.
    ///
    /// # Errors
    /// [`DomainError::Endpoint`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        service: &ServiceName,
        options: ServiceClientOptions,
    ) -> Result<Self, DomainError> {
        // The reader comes first: a server that has discovered the writer most likely knows the
        // reader too.
        let reader =
            domain.open_reader(&service.reply_topic(), &service.types.response, &policies())?;
        let writer = domain.open_writer(
            &service.request_topic(),
            &service.types.request,
            &policies(),
        )?;
        let (calls, inbox) = mpsc::channel(QUEUE);
        let (ignored, servers, acquainted) = (Arc::default(), Arc::default(), Arc::default());
        let driver = Driver {
            id: ClientId {
                writer: writer.guid(),
                reader: reader.guid(),
            },
            service: service.clone(),
            peers: peers.clone(),
            writer,
            reader,
            max_calls: options.max_calls,
            servers: BTreeMap::new(),
            other_type: None,
            waiting: VecDeque::new(),
            asked: BTreeMap::new(),
            keys: HashMap::new(),
            count: 0,
            looked: None,
            pace: Pace::new(),
            readers: Vec::new(),
            opening: Opening::new(),
            ignored: Arc::clone(&ignored),
            ready: Arc::clone(&servers),
            acquainted: Arc::clone(&acquainted),
        };
        let task = tokio::spawn(driver.run(inbox)).abort_handle();
        Ok(Self {
            shared: Arc::new(ClientShared {
                service: service.clone(),
                options,
                calls,
                ignored,
                servers,
                acquainted,
                task,
            }),
        })
    }

    /// Returns the ROS name of the service.
    #[must_use]
    pub fn service(&self) -> &str {
        &self.shared.service.name
    }

    /// Returns the number of servers that receive the next request: servers of other participants
    /// with a matched reader and a matched writer.
    #[must_use]
    pub fn servers(&self) -> u64 {
        self.shared.servers.load(Ordering::Relaxed)
    }

    /// Returns how many of these servers name our reader in their HEARTBEATs (RTPS 2.5, 8.3.8.6),
    /// so that their replies reach it. They receive requests at once; other servers get time to
    /// discover the client, because a reply to a reader unknown to the server is lost. The
    /// published `RustDDS` does not report this, so the number is 0.
    #[must_use]
    pub fn acquainted(&self) -> u64 {
        self.shared.acquainted.load(Ordering::Relaxed)
    }

    /// Returns the number of ignored replies: replies to other clients, to abandoned calls, or
    /// malformed replies.
    #[must_use]
    pub fn ignored(&self) -> u64 {
        self.shared.ignored.load(Ordering::Relaxed)
    }

    /// Sends a request, which is CDR with its encapsulation header, and returns the reply in the
    /// same form. Like any ROS 2 client, it sends the request to all servers, and the first reply
    /// counts.
    ///
    /// A request is never sent twice. On failure, [`ServiceError::may_have_run`] returns whether a
    /// server may have acted on it. Dropping the future abandons the call; a server may still act.
    ///
    /// # Errors
    /// [`ServiceError`].
    pub async fn call(&self, request: Bytes) -> Result<Bytes, ServiceError> {
        self.call_by(request, None).await
    }

    /// Calls as [`call`](Self::call) does, but never sends the request after `start_by`. The call
    /// then ends with [`ServiceError::TooLate`], when it would be sent.
    ///
    /// # Errors
    /// [`ServiceError`].
    pub async fn call_by(
        &self,
        request: Bytes,
        start_by: Option<Instant>,
    ) -> Result<Bytes, ServiceError> {
        let recall = Recall::after(start_by);
        let answer = self.call_recallable(request, None, &recall).await?;
        Ok(answer.reply)
    }

    /// Calls as [`call`](Self::call) does, but first waits up to [`COMPANION`] for a server of the
    /// participant that has `endpoint`. Used when a service of a participant refers to another
    /// service of the same participant, which may be discovered later.
    pub(crate) async fn call_after(
        &self,
        request: Bytes,
        endpoint: Option<GUID>,
    ) -> Result<Replied, ServiceError> {
        let recall = Recall::default();
        self.call_recallable(request, endpoint, &recall).await
    }

    /// Calls the service, after the server of `endpoint` was discovered, with a request that can be
    /// [recalled](Recall::recall) until it is sent.
    ///
    /// # Errors
    /// [`ServiceError`].
    pub async fn call_recallable(
        &self,
        request: Bytes,
        endpoint: Option<GUID>,
        Recall { phase, start_by }: &Recall,
    ) -> Result<Replied, ServiceError> {
        let (done, reply) = oneshot::channel();
        let call = WaitingCall {
            request,
            companion: endpoint.map(|endpoint| (endpoint, Instant::now() + COMPANION)),
            phase: Arc::clone(phase),
            start_by: *start_by,
            done,
        };
        let at = || CallPhase::from(phase.load(Ordering::Relaxed));
        let exchange = async {
            match self.shared.calls.send(call).await {
                Ok(()) => reply.await.unwrap_or(Err(Failure::Closed)),
                Err(_) => Err(Failure::Closed),
            }
        };
        let Some(limit) = self.shared.options.timeout else {
            return exchange.await.map_err(|failure| self.error(failure, at()));
        };
        match timeout_at(Instant::now() + limit, exchange).await {
            Ok(done) => done.map_err(|failure| self.error(failure, at())),
            Err(_) => Err(ServiceError::Timeout {
                service: self.service().to_owned(),
                phase: at(),
                limit,
            }),
        }
    }

    fn error(&self, failure: Failure, phase: CallPhase) -> ServiceError {
        let service = self.service().to_owned();
        match failure {
            Failure::Busy => ServiceError::Busy {
                service,
                limit: self.shared.options.max_calls,
            },
            Failure::Request(why) => ServiceError::Request { service, why },
            Failure::OtherType(theirs) => ServiceError::OtherType {
                service,
                theirs,
                ours: self.shared.service.types.request.clone(),
            },
            Failure::TooLate => ServiceError::TooLate { service },
            Failure::Lost => ServiceError::Lost { service },
            Failure::Closed => ServiceError::Closed { service, phase },
        }
    }
}

/// Recalls a request that was not sent yet.
#[derive(Debug, Clone)]
pub struct Recall {
    phase: Arc<AtomicU8>,
    /// The time after which the request is not sent.
    start_by: Option<Instant>,
}

impl Default for Recall {
    fn default() -> Self {
        Self {
            phase: Arc::new(AtomicU8::new(CallPhase::Queue.into())),
            start_by: None,
        }
    }
}

impl Recall {
    /// Returns a handle of a request that is not sent after `start_by`.
    #[must_use]
    pub fn after(start_by: Option<Instant>) -> Self {
        Self {
            start_by,
            ..Self::default()
        }
    }

    /// Returns whether the request was sent.
    #[must_use]
    pub fn is_sent(&self) -> bool {
        self.phase.load(Ordering::Acquire) == u8::from(CallPhase::Answer)
    }

    /// Prevents the request from being sent. Returns false if it was sent or is being sent.
    pub fn recall(&self) -> bool {
        let before = |phase: u8| (phase < CallPhase::Request.into()).then_some(RECALLED);
        let moved = self
            .phase
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, before);
        moved.is_ok() || self.phase.load(Ordering::Acquire) == RECALLED
    }
}

/// The reply of a server and the writer that sent it.
#[derive(Debug)]
pub struct Replied {
    /// The reply, with its encapsulation header.
    pub reply: Bytes,
    /// The writer of the server.
    pub writer: GUID,
}

#[derive(Debug)]
struct WaitingCall {
    request: Bytes,
    /// An endpoint of the participant that has to be among the servers, and the time limit for
    /// this.
    companion: Option<(GUID, Instant)>,
    phase: Arc<AtomicU8>,
    /// The time after which the request is not sent.
    start_by: Option<Instant>,
    done: oneshot::Sender<Result<Replied, Failure>>,
}

impl WaitingCall {
    /// Enters a phase. Returns false if the request was recalled and must not be sent.
    fn enter(&self, phase: CallPhase) -> bool {
        let moved = |now: u8| (now != RECALLED).then_some(phase.into());
        let entered = self
            .phase
            .fetch_update(Ordering::AcqRel, Ordering::Acquire, moved);
        entered.is_ok()
    }

    /// Returns whether the request must not be sent any more. Reads the clock itself, because the
    /// process may not have run for a while.
    fn is_late(&self) -> bool {
        self.start_by
            .is_some_and(|start_by| Instant::now() > start_by)
    }

    /// Returns whether to send the request to these servers at `now`.
    fn is_for(&self, servers: &BTreeMap<GUID, Met>, now: Instant) -> bool {
        self.companion.is_none_or(|(endpoint, until)| {
            now >= until
                || servers
                    .keys()
                    .any(|server| server.prefix == endpoint.prefix)
        })
    }

    fn end(self, result: Result<Replied, Failure>) {
        // The receiver is closed if the caller abandoned the call.
        drop(self.done.send(result));
    }
}

/// The reason for which a call failed, except for a timeout.
#[derive(Debug)]
enum Failure {
    Busy,
    Request(&'static str),
    OtherType(String),
    TooLate,
    Lost,
    Closed,
}

/// Owns the endpoints and all calls in progress.
struct Driver {
    service: ServiceName,
    id: ClientId,
    peers: ServicePeers,
    writer: PayloadWriter,
    reader: PayloadReader,
    max_calls: usize,
    /// The servers, keyed by the reader of the requests.
    servers: BTreeMap<GUID, Met>,
    /// The type of a server that differs from our type.
    other_type: Option<String>,
    /// Calls that wait for a server, for its capacity, or for the send window; oldest first.
    waiting: VecDeque<WaitingCall>,
    /// Calls that wait for a reply.
    asked: BTreeMap<u64, Asked>,
    keys: HashMap<RequestKey, u64>,
    count: u64,
    looked: Option<Instant>,
    pace: Pace,
    /// All readers of the request topic.
    readers: Vec<GUID>,
    opening: Opening,
    ignored: Arc<AtomicU64>,
    ready: Arc<AtomicU64>,
    acquainted: Arc<AtomicU64>,
}

struct Asked {
    call: WaitingCall,
    keys: Vec<RequestKey>,
    servers: Vec<GUID>,
    since: Instant,
}

impl Driver {
    async fn run(mut self, mut calls: mpsc::Receiver<WaitingCall>) {
        loop {
            // Each branch is cancel-safe: only the branch that completes takes an item.
            let tick = self.next_look().unwrap_or_else(Instant::now);
            tokio::select! {
                reply = next(&self.reader) => self.replied(reply),
                call = calls.recv() => match call {
                    Some(call) => self.called(call),
                    None => return,
                },
                () = sleep_until(tick) => self.look(Instant::now()),
            }
        }
    }

    fn awaited(&self) -> AwaitedCondition {
        match (self.waiting.is_empty(), self.servers.is_empty()) {
            (true, _) => AwaitedCondition::Nothing,
            (false, true) => AwaitedCondition::Server,
            (false, false) => AwaitedCondition::Turn,
        }
    }

    fn next_look(&self) -> Option<Instant> {
        let pause = self.pace.pause(self.awaited());
        self.looked.map(|looked| looked + pause)
    }

    fn called(&mut self, call: WaitingCall) {
        if self.waiting.len() + self.asked.len() >= self.max_calls {
            self.forget_given_up();
        }
        if self.waiting.len() + self.asked.len() >= self.max_calls {
            call.end(Err(Failure::Busy));
            return;
        }
        if !call.enter(CallPhase::Discovery) {
            return;
        }
        self.waiting.push_back(call);
        let now = Instant::now();
        if self.looked.is_none_or(|looked| looked + FRESH <= now) {
            self.look(now);
        } else {
            self.ask_waiting(now);
        }
    }

    /// Updates the servers and sends the waiting requests to them.
    fn look(&mut self, now: Instant) {
        self.looked = Some(now);
        self.forget_given_up();
        let snapshot = self.peers.look(now, self.pace.age(self.awaited()));
        self.meet(&snapshot, now);
        self.pace.looked(self.awaited());
        self.give_up_lost();
        let (ready, acquainted) = self.ready(now);
        self.ready.store(ready, Ordering::Relaxed);
        self.acquainted.store(acquainted, Ordering::Relaxed);
        self.ask_waiting(now);
        if self.servers.is_empty()
            && let Some(theirs) = &self.other_type
        {
            for call in self.waiting.drain(..) {
                call.end(Err(Failure::OtherType(theirs.clone())));
            }
        }
    }

    /// Returns how many servers are ready for a request, and how many of them report that they know
    /// the client.
    fn ready(&self, now: Instant) -> (u64, u64) {
        let in_step = all_in_step(&self.writer, self.servers.len());
        let of = |(ready, acquainted): (u64, u64), met: &Met| {
            let acquaintance = met.acquaintance(&self.reader, in_step);
            (
                ready + u64::from(met.is_ready(acquaintance, now)),
                acquainted + u64::from(acquaintance == Acquaintance::Told),
            )
        };
        self.servers.values().fold((0, 0), of)
    }

    fn ask_waiting(&mut self, now: Instant) {
        if self.ready(now).0 == 0 {
            return;
        }
        // New servers are included: the others may be dead while their leases still run.
        let servers: Vec<GUID> = self.servers.keys().copied().collect();
        while self.opening.is_over(&self.writer, now)
            && may_ask(self.asked.values().rev().map(|asked| asked.since), now)
            && let Some(call) = self.next_call(now)
        {
            if call.done.is_closed() || !call.enter(CallPhase::Request) {
                // The caller abandoned the call.
                continue;
            }
            if call.is_late() {
                call.end(Err(Failure::TooLate));
                continue;
            }
            if let Some(unsent) = self.ask(call, &servers, now) {
                let _recalled = !unsent.enter(CallPhase::Discovery);
                self.waiting.push_front(unsent);
                return;
            }
            self.opening.written(self.readers.iter().copied(), now);
        }
    }

    /// Returns the call that has waited longest for the present servers.
    fn next_call(&mut self, now: Instant) -> Option<WaitingCall> {
        let mut waiting = self.waiting.iter();
        let at = waiting.position(|call| call.is_for(&self.servers, now))?;
        self.waiting.remove(at)
    }

    fn meet(&mut self, snapshot: &Snapshot, now: Instant) {
        let readers = snapshot.readers(&self.service.request_topic());
        let reply_topic = self.service.reply_topic();
        let writers = snapshot.writers(&reply_topic);
        let repliers = |server: GUID| -> Vec<GUID> {
            let own = writers.iter().filter(|writer| {
                writer.guid.prefix == server.prefix
                    && writer.type_name == self.service.types.response
            });
            own.map(|writer| writer.guid).collect()
        };
        let found: BTreeMap<GUID, Vec<GUID>> = readers
            .iter()
            .filter(|reader| reader.type_name == self.service.types.request)
            .map(|reader| (reader.guid, repliers(reader.guid)))
            .filter(|(_, repliers)| !repliers.is_empty())
            .collect();
        self.servers.retain(|guid, _| found.contains_key(guid));
        for (guid, repliers) in found {
            let met = self.servers.entry(guid).or_insert_with(|| Met::new(now));
            met.answer_from(repliers);
        }
        self.other_type = readers
            .iter()
            .find(|reader| reader.type_name != self.service.types.request)
            .map(|reader| reader.type_name.clone());
        self.readers = readers.iter().map(|reader| reader.guid).collect();
    }

    /// Writes a request to the servers; returns it if the send window is full.
    fn ask(&mut self, call: WaitingCall, servers: &[GUID], now: Instant) -> Option<WaitingCall> {
        self.count += 1;
        let (mut keys, mut asked) = (Vec::new(), Vec::new());
        for server in servers {
            match self.write(&call.request, *server) {
                Ok(key) => {
                    keys.push(key);
                    asked.push(*server);
                }
                Err(Unsent::Full) => {}
                // The request itself is invalid, so the first server fails already.
                Err(Unsent::Request(why)) => {
                    call.end(Err(Failure::Request(why)));
                    return None;
                }
            }
        }
        if keys.is_empty() {
            return Some(call);
        }
        let _is_sent = call.enter(CallPhase::Answer);
        for key in &keys {
            self.keys.insert(*key, self.count);
        }
        let asked = Asked {
            call,
            keys,
            servers: asked,
            since: now,
        };
        self.asked.insert(self.count, asked);
        None
    }

    fn write(&self, request: &Bytes, server: GUID) -> Result<RequestKey, Unsent> {
        let mapping = self.peers.mapping_of(server);
        let count = i64::try_from(self.count).unwrap_or(i64::MAX);
        let OutgoingServiceSample { payload, related } = self
            .id
            .seal_request(mapping, count, request.clone())
            .map_err(|fault| Unsent::Request(fault.label()))?;
        let payload = Payload::to_write(payload).map_err(|error| Unsent::Request(error.label()))?;
        // Addressed to each server separately: servers of one vendor cannot read the mapping of
        // another. In addition, RustDDS combines samples for all readers into larger datagrams, and
        // of 100 requests sent at once in this way some never reached Cyclone DDS.
        let options = WriteOptionsBuilder::new()
            .related_sample_identity_opt(related)
            .to_single_reader(server)
            .build();
        match self.writer.write_with_options(payload, options) {
            Ok(identity) => Ok(match mapping {
                ServiceMapping::Cyclone => RequestKey::Counted(count),
                ServiceMapping::Enhanced => {
                    RequestKey::Written(i64::from(identity.sequence_number))
                }
            }),
            Err(WriteError::WouldBlock { .. }) => Err(Unsent::Full),
            Err(
                WriteError::Serialization { .. }
                | WriteError::Poisoned { .. }
                | WriteError::Io(_)
                | WriteError::Internal { .. },
            ) => Err(Unsent::Request("the DDS writer failed")),
        }
    }

    fn replied(&mut self, reply: Option<ReceivedServiceSample>) {
        // Replies of this process as a server are for no client here.
        let foreign = reply.filter(|reply| !self.peers.is_own(reply.writer));
        let opened = foreign.map(|reply| {
            let writer = reply.writer;
            let opened = self.id.open_reply(self.peers.mapping_of(writer), reply);
            (opened, writer)
        });
        if let Some((Ok(Some((key, reply))), writer)) = opened
            && let Some(asked) = self.keys.get(&key).and_then(|id| self.asked.remove(id))
        {
            self.forget_keys(&asked.keys);
            asked.call.end(Ok(Replied { reply, writer }));
            if !self.waiting.is_empty() {
                self.ask_waiting(Instant::now());
            }
            return;
        }
        debug!(
            service = self.service.name,
            "dropped a response to another client"
        );
        self.ignored.fetch_add(1, Ordering::Relaxed);
    }

    fn forget_keys(&mut self, keys: &[RequestKey]) {
        for key in keys {
            self.keys.remove(key);
        }
    }

    fn forget_given_up(&mut self) {
        self.waiting.retain(|call| !call.done.is_closed());
        for asked in self.take_asked(|asked| asked.call.done.is_closed()) {
            self.forget_keys(&asked.keys);
        }
    }

    /// Ends the calls that have lost all their servers.
    fn give_up_lost(&mut self) {
        let servers: BTreeSet<GUID> = self.servers.keys().copied().collect();
        let lost = |asked: &Asked| !asked.servers.iter().any(|guid| servers.contains(guid));
        for asked in self.take_asked(lost) {
            self.forget_keys(&asked.keys);
            asked.call.end(Err(Failure::Lost));
        }
    }

    fn take_asked(&mut self, which: impl Fn(&Asked) -> bool) -> Vec<Asked> {
        let found = self.asked.iter().filter(|(_, asked)| which(asked));
        let found: Vec<u64> = found.map(|(id, _)| *id).collect();
        found
            .iter()
            .filter_map(|id| self.asked.remove(id))
            .collect()
    }
}

enum Unsent {
    Full,
    Request(&'static str),
}

/// How long a call waits for a certain server; after that, it is sent to the other servers.
const COMPANION: Duration = Duration::from_secs(5);
/// The phase of a request that was recalled before it was sent; not a [`CallPhase`].
const RECALLED: u8 = u8::MAX;
/// Capacity of the call queue; further calls wait in [`ServiceClient::call`].
const QUEUE: usize = 64;
