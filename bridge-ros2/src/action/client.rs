//! The client: sends goals, and hands each what its server says of it.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use rustdds::GUID;
use tokio::sync::Notify;
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep, timeout};
use tracing::debug;

use super::client_goals::{ClientCounters, ClientGoals, Limits, Outcome};
use super::error::{ActionError, IdInUse, LostReason, NoServer};
use super::goal::GoalHandle;
use super::types::{CancelAnswer, CancelWhat, GoalId, Status};
use super::{Action, STATUS_TYPE, status_policies, wire};
use crate::cdr::Malformed;
use crate::domain::Domain;
use crate::raw::Reader;
use crate::service::{
    BUSY, IDLE, Received, ServiceClient, ServiceClientOptions, ServiceError, ServicePeers, next,
    policies,
};

/// How long a client waits, in steady time, and how much it holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionClientOptions {
    /// How long a goal waits for a server before it is sent, and, once it is accepted, for one to come back when there
    /// is none.
    pub server_timeout: Duration,
    /// How long the server may take to accept or reject a goal; `None` waits until the server is gone. A goal that was
    /// not answered in time may still be accepted.
    pub answer_timeout: Option<Duration>,
    /// How long a request to cancel may take.
    pub cancel_timeout: Duration,
    /// Goals that have not ended, at most; one more is lost at once.
    pub max_goals: usize,
    /// How many reports of progress may wait per goal; then the oldest are dropped.
    pub feedback_messages: usize,
    /// How many bytes of them may wait per goal; then the oldest are dropped. The newest is always kept.
    pub feedback_bytes: usize,
}

impl Default for ActionClientOptions {
    /// 10 seconds for a server, a minute for its decision, 10 seconds for one about cancelling; 1000 goals; 100 reports
    /// of progress and 16 MiB.
    fn default() -> Self {
        Self {
            server_timeout: Duration::from_secs(10),
            answer_timeout: Some(Duration::from_secs(60)),
            cancel_timeout: Duration::from_secs(10),
            max_goals: 1000,
            feedback_messages: 100,
            feedback_bytes: 16 * 1024 * 1024,
        }
    }
}

/// Sends goals to the server of an action. Dropping it ends its goals as lost; it does not cancel them.
///
/// With several servers of one name, all get each goal, as everywhere in ROS 2, and the first answer counts.
#[derive(Debug)]
pub struct ActionClient {
    shared: Arc<Shared>,
    task: AbortHandle,
}

impl ActionClient {
    /// Makes the action's endpoints; the server need not be there yet, and may come and go. To be called on a tokio
    /// runtime.
    ///
    /// # Errors
    /// [`ActionError::Domain`].
    pub fn open(
        domain: &Domain,
        peers: &ServicePeers,
        action: &Action,
        options: ActionClientOptions,
    ) -> Result<Self, ActionError> {
        action.announce_shared(domain);
        // Before what asks for goals: a server that knows the latter knows these too.
        let feedback_type = action.feedback_type();
        let feedback = domain.open_reader(&action.feedback_topic(), &feedback_type, &policies())?;
        let status = domain.open_reader(&action.status_topic(), STATUS_TYPE, &status_policies())?;
        let open = |service, timeout| {
            let max_calls = options.max_goals;
            let options = ServiceClientOptions { timeout, max_calls };
            ServiceClient::open(domain, peers, &service, options)
        };
        // A goal takes as long as it takes.
        let result = open(action.get_result(), None)?;
        let cancel = open(action.cancel_goal(), Some(options.cancel_timeout))?;
        let send = open(action.send_goal(), options.answer_timeout)?;
        let shared = Arc::new(Shared {
            action: action.clone(),
            options,
            participant: domain.guid(),
            peers: peers.clone(),
            send,
            cancel,
            result,
            state: Mutex::new(State {
                goals: ClientGoals::new(Limits {
                    goals: options.max_goals,
                    feedback_messages: options.feedback_messages,
                    feedback_bytes: options.feedback_bytes,
                }),
                tasks: BTreeMap::new(),
                servers: BTreeMap::new(),
            }),
        });
        let task = tokio::spawn(listen(Arc::clone(&shared), status, feedback)).abort_handle();
        Ok(Self { shared, task })
    }

    /// Sends a goal, the `X_Goal` as CDR in little endian with its encapsulation header. Never waits: what becomes of it
    /// is told by the handle. To be called on a tokio runtime.
    #[must_use]
    pub fn send_goal(&self, body: &[u8]) -> GoalHandle {
        let id = self.shared.new_id();
        self.send_new(self.shared.lock(), id, body)
    }

    /// As [`send_goal`](Self::send_goal), under an id that was chosen elsewhere. A server rejects one that it knows already.
    ///
    /// # Errors
    /// [`IdInUse`] while somebody holds a goal of that id: nothing is sent.
    pub fn send_goal_as(&self, id: GoalId, body: &[u8]) -> Result<GoalHandle, IdInUse> {
        let state = self.shared.lock();
        if state.goals.is_held(id) {
            return Err(IdInUse(id));
        }
        Ok(self.send_new(state, id, body))
    }

    fn send_new(&self, mut state: MutexGuard<'_, State>, id: GoalId, body: &[u8]) -> GoalHandle {
        let wake: Arc<Notify> = Arc::default();
        state.goals.sent(id, Arc::clone(&wake));
        match wire::join(id, body) {
            None => state.goals.end(id, Outcome::Lost(LostReason::Message)),
            Some(request) if state.goals.outcome(id).is_none() => {
                let task = tokio::spawn(Arc::clone(&self.shared).drive(id, request));
                state.tasks.insert(id, task.abort_handle());
            }
            Some(_) => {}
        }
        drop(state);
        GoalHandle::new(Arc::clone(&self.shared), id, wake)
    }

    /// Asks the server to cancel goals, those of other clients too where `what` includes them. The goals tell what
    /// comes of it.
    ///
    /// # Errors
    /// [`ServiceError`]; a server may have heard the request where [`ServiceError::may_have_run`] says so.
    pub async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
        self.shared.cancel(what).await
    }

    /// Whether there is a server whose every service and topic is known here.
    ///
    /// # Errors
    /// [`NoServer`] tells what is missing.
    pub fn server(&self) -> Result<(), NoServer> {
        self.shared.server()
    }

    /// Waits until there is a [`Self::server`]. Cancel-safe.
    ///
    /// # Errors
    /// [`NoServer`] after `limit`.
    pub async fn wait_for_server(&self, limit: Duration) -> Result<(), NoServer> {
        self.shared.wait_for_server(limit).await
    }

    /// The action's ROS name.
    #[must_use]
    pub fn name(&self) -> &str {
        self.shared.action.name()
    }

    /// What was received so far and could not be used.
    #[must_use]
    pub fn counters(&self) -> ClientCounters {
        self.shared.lock().goals.counters
    }
}

impl Drop for ActionClient {
    fn drop(&mut self) {
        self.task.abort();
        let mut state = self.shared.lock();
        for task in state.tasks.values() {
            task.abort();
        }
        let closed = Outcome::Lost(LostReason::ClientClosed);
        state.goals.end_all(&closed);
    }
}

/// What the client, its tasks and its goals share.
#[derive(Debug)]
pub(super) struct Shared {
    action: Action,
    options: ActionClientOptions,
    participant: GUID,
    peers: ServicePeers,
    send: ServiceClient,
    cancel: ServiceClient,
    result: ServiceClient,
    state: Mutex<State>,
}

#[derive(Debug)]
pub(super) struct State {
    pub(super) goals: ClientGoals,
    /// Of goals that somebody holds.
    tasks: BTreeMap<GoalId, AbortHandle>,
    /// An endpoint of the server that has accepted a goal, while it runs.
    servers: BTreeMap<GoalId, GUID>,
}

impl Shared {
    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
        let server = match what {
            CancelWhat::Goal(id) => self.lock().servers.get(&id).copied(),
            CancelWhat::All | CancelWhat::Until(_) | CancelWhat::GoalAndUntil(..) => None,
        };
        let request = wire::cancel_request(what);
        let answer = self.cancel.call_after(request, server).await?;
        match wire::read_cancel_answer(&answer.reply) {
            Ok(answer) => Ok(answer.to(what)),
            Err(Malformed) => Err(ServiceError::Reply {
                service: self.cancel.service().to_owned(),
            }),
        }
    }

    /// Nobody holds the goal any more.
    pub(super) fn forget(&self, id: GoalId) {
        let mut state = self.lock();
        state.goals.forget(id);
        state.servers.remove(&id);
        if let Some(task) = state.tasks.remove(&id) {
            task.abort();
        }
    }

    /// The participant and a count: no other client in the domain has it.
    fn new_id(&self) -> GoalId {
        static COUNT: AtomicU32 = AtomicU32::new(1);
        let mut bytes = self.participant.to_bytes();
        if let Some(end) = bytes.last_chunk_mut::<4>() {
            *end = COUNT.fetch_add(1, Ordering::Relaxed).to_be_bytes();
        }
        GoalId::from_bytes(bytes)
    }

    fn server(&self) -> Result<(), NoServer> {
        let missing = |missing: String| NoServer {
            action: self.action.name().to_owned(),
            missing,
        };
        let seen = self.peers.look(Instant::now(), IDLE);
        let send = self.action.send_goal();
        let readers = seen.readers(&send.request_topic());
        let wanted = &send.types.request;
        if let Some(other) = readers.first()
            && readers.iter().all(|reader| reader.type_name != *wanted)
        {
            let theirs = &other.type_name;
            let what = format!("there is one with {theirs}, and {wanted} is wanted");
            return Err(missing(what));
        }
        for client in [&self.send, &self.cancel, &self.result] {
            if client.servers() == 0 {
                return Err(missing(format!("nobody serves {}", client.service())));
            }
        }
        for topic in [self.action.feedback_topic(), self.action.status_topic()] {
            if seen.writers(&topic).is_empty() {
                return Err(missing(format!("nobody publishes {topic}")));
            }
        }
        Ok(())
    }

    async fn wait_for_server(&self, limit: Duration) -> Result<(), NoServer> {
        let found = async {
            while self.server().is_err() {
                sleep(BUSY).await;
            }
        };
        match timeout(limit, found).await {
            Ok(()) => Ok(()),
            Err(_) => self.server(),
        }
    }

    /// Returns when there has been no server for the time a goal waits for one.
    async fn wait_for_no_server(&self) {
        let mut since = Instant::now();
        while since.elapsed() < self.options.server_timeout {
            sleep(IDLE).await;
            if self.result.servers() > 0 {
                since = Instant::now();
            }
        }
    }

    /// Sees a goal through to its end.
    async fn drive(self: Arc<Self>, id: GoalId, request: Bytes) {
        let outcome = self.outcome(id, request).await;
        let mut state = self.lock();
        state.goals.end(id, outcome);
        state.servers.remove(&id);
        state.tasks.remove(&id);
    }

    async fn outcome(&self, id: GoalId, request: Bytes) -> Outcome {
        if let Err(none) = self.wait_for_server(self.options.server_timeout).await {
            return Outcome::Lost(none.into());
        }
        let answer = match self.send.call_after(request, None).await {
            Ok(answer) => answer,
            Err(error) => return Outcome::Lost(LostReason::Unanswered(error)),
        };
        match wire::read_goal_answer(&answer.reply) {
            Ok(None) => return Outcome::Rejected,
            Ok(Some(stamp)) => {
                let mut state = self.lock();
                // Unless nobody holds it any more.
                if state.tasks.contains_key(&id) {
                    state.servers.insert(id, answer.writer);
                }
                state.goals.accepted(id, stamp);
            }
            Err(Malformed) => {
                return Outcome::Lost(LostReason::Malformed("answer to the goal"));
            }
        }
        // After a restart the old server may still be known, while of the new one not all is: it is the one to ask.
        let asked = self
            .result
            .call_after(wire::result_request(id), Some(answer.writer));
        let result = tokio::select! {
            result = asked => result.map(|answer| answer.reply),
            () = self.wait_for_no_server() => {
                let action = self.action.name().to_owned();
                return Outcome::Lost(LostReason::ServerGone { action });
            }
        };
        match result {
            Err(error) => Outcome::Lost(LostReason::ServerLost(error)),
            Ok(result) => match wire::result_status(&result) {
                Ok(Status::Unknown) => Outcome::Lost(LostReason::Unknown),
                Ok(status) => Outcome::Done { status, result },
                Err(Malformed) => Outcome::Lost(LostReason::Malformed("result")),
            },
        }
    }

    fn hear_status(&self, sample: Option<Received>) {
        let goals = sample.ok_or(Malformed);
        let goals = goals.and_then(|sample| wire::read_status_array(&sample.payload));
        let mut state = self.lock();
        match goals {
            Ok(goals) => {
                for (id, status) in goals {
                    state.goals.status(id, status);
                }
            }
            Err(Malformed) => self.malformed(&mut state, "status"),
        }
    }

    fn hear_feedback(&self, sample: Option<Received>) {
        let feedback = sample.ok_or(Malformed);
        let feedback = feedback.and_then(|sample| wire::split(&sample.payload));
        let mut state = self.lock();
        match feedback {
            Ok((id, body)) => state.goals.feedback(id, body),
            Err(Malformed) => self.malformed(&mut state, "feedback"),
        }
    }

    fn malformed(&self, state: &mut State, what: &'static str) {
        state.goals.counters.malformed += 1;
        let action = self.action.name();
        debug!(action, what, "a sample that does not read");
    }
}

/// Hears what the server says until aborted.
async fn listen(shared: Arc<Shared>, status: Reader, feedback: Reader) {
    loop {
        // Both are cancel-safe.
        tokio::select! {
            sample = next(&status) => shared.hear_status(sample),
            sample = next(&feedback) => shared.hear_feedback(sample),
        }
    }
}
