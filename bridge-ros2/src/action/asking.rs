//! What a client of an action asks its server, and what its goals share.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use rustdds::GUID;
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep, timeout};
use tracing::debug;

use super::client_goals::{ClientGoals, Limits, Outcome};
use super::error::{LostReason, NoServer};
use super::types::{CancelAnswer, CancelWhat, GoalId, Status};
use super::{Action, wire};
use crate::cdr::Malformed;
use crate::domain::Domain;
use crate::service::{BUSY, IDLE, Received, ServiceClient, ServiceError, ServicePeers};

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

/// The three services of an action, as its client asks them.
#[derive(Debug)]
pub(super) struct Asked {
    pub(super) send: ServiceClient,
    pub(super) cancel: ServiceClient,
    pub(super) result: ServiceClient,
}

/// What the client, its tasks and its goals share.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) action: Action,
    options: ActionClientOptions,
    participant: GUID,
    peers: ServicePeers,
    asked: Asked,
    state: Mutex<State>,
}

#[derive(Debug)]
pub(super) struct State {
    pub(super) goals: ClientGoals,
    /// Of goals that somebody holds.
    pub(super) tasks: BTreeMap<GoalId, AbortHandle>,
    /// An endpoint of the server that has accepted a goal, while it runs.
    servers: BTreeMap<GoalId, GUID>,
}

impl Shared {
    pub(super) fn new(
        (domain, peers): (&Domain, &ServicePeers),
        action: &Action,
        options: ActionClientOptions,
        asked: Asked,
    ) -> Self {
        Self {
            action: action.clone(),
            options,
            participant: domain.guid(),
            peers: peers.clone(),
            asked,
            state: Mutex::new(State {
                goals: ClientGoals::new(Limits {
                    goals: options.max_goals,
                    feedback_messages: options.feedback_messages,
                    feedback_bytes: options.feedback_bytes,
                }),
                tasks: BTreeMap::new(),
                servers: BTreeMap::new(),
            }),
        }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
        let server = match what {
            CancelWhat::Goal(id) => self.lock().servers.get(&id).copied(),
            CancelWhat::All | CancelWhat::Until(_) | CancelWhat::GoalAndUntil(..) => None,
        };
        let request = wire::cancel_request(what);
        let answer = self.asked.cancel.call_after(request, server).await?;
        match wire::read_cancel_answer(&answer.reply) {
            Ok(answer) => Ok(answer.to(what)),
            Err(Malformed) => Err(ServiceError::Reply {
                service: self.asked.cancel.service().to_owned(),
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
    pub(super) fn new_id(&self) -> GoalId {
        static COUNT: AtomicU32 = AtomicU32::new(1);
        let mut bytes = self.participant.to_bytes();
        if let Some(end) = bytes.last_chunk_mut::<4>() {
            *end = COUNT.fetch_add(1, Ordering::Relaxed).to_be_bytes();
        }
        GoalId::from_bytes(bytes)
    }

    pub(super) fn server(&self) -> Result<(), NoServer> {
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
        for client in [&self.asked.send, &self.asked.cancel, &self.asked.result] {
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

    pub(super) async fn wait_for_server(&self, limit: Duration) -> Result<(), NoServer> {
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
            if self.asked.result.servers() > 0 {
                since = Instant::now();
            }
        }
    }

    /// Sees a goal through to its end.
    pub(super) async fn drive(self: Arc<Self>, id: GoalId, request: Bytes) {
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
        let answer = match self.asked.send.call_after(request, None).await {
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
            .asked
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

    pub(super) fn hear_status(&self, sample: Option<Received>) {
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

    pub(super) fn hear_feedback(&self, sample: Option<Received>) {
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
