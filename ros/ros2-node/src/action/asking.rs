//! The requests of an action client to its server, and the state that its goals share.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::pin::pin;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use rustdds::GUID;
use tokio::sync::{Notify, mpsc};
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tracing::{debug, info};

use super::client_goals::{ClientGoalLimits, ClientGoals, Outcome};
use super::error::{LostReason, NoServer};
use super::types::{CancelAnswer, CancelCode, CancelWhat, GoalId, GoalInfo, GoalStatusCode};
use super::{ActionName, wire};
use crate::cdr::Malformed;
use crate::clock::Ros2Time;
use crate::domain::Domain;
use crate::service::{
    BUSY, CallPhase, IDLE, Recall, ReceivedServiceSample, Replied, ServiceClient, ServiceError,
    ServicePeers,
};

/// The timeouts of an action client, in steady time, and its limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActionClientOptions {
    /// How long a goal waits for a server before it is sent. An accepted goal waits as long for a
    /// lost server to return.
    pub server_timeout: Duration,
    /// How long the server may take to accept or reject a goal; `None` waits until the server is
    /// lost. A goal without a decision in time is withdrawn: it is cancelled as soon as it is
    /// accepted.
    pub answer_timeout: Option<Duration>,
    /// The timeout of a cancel request.
    pub cancel_timeout: Duration,
    /// Maximum number of goals that have not ended; a further goal is lost at once.
    pub max_goals: usize,
    /// Maximum number of waiting feedback messages per goal; beyond it, the oldest are dropped.
    pub feedback_messages: usize,
    /// Maximum size of the waiting feedback per goal in bytes; beyond it, the oldest messages are
    /// dropped. The newest is always kept.
    pub feedback_bytes: usize,
}

impl Default for ActionClientOptions {
    /// Returns timeouts of 10 seconds for a server, one minute for its decision about a goal, and
    /// 10 seconds for a cancel request. The limits are 1000 goals, 100 feedback messages and 16 MiB
    /// of feedback.
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

/// The service clients of the three services of an action.
#[derive(Debug)]
pub(super) struct ActionServiceClients {
    pub(super) send: ServiceClient,
    pub(super) cancel: ServiceClient,
    pub(super) result: ServiceClient,
}

/// The state that the client, its tasks and its goals share.
#[derive(Debug)]
pub(super) struct ActionClientShared {
    pub(super) action: ActionName,
    options: ActionClientOptions,
    participant: GUID,
    peers: ServicePeers,
    asked: ActionServiceClients,
    /// Goals that end once all feedback received before their results is delivered.
    ends: mpsc::Sender<GoalEnd>,
    state: Mutex<ActionClientState>,
}

/// The end of a goal.
#[derive(Debug)]
pub(super) struct GoalEnd {
    id: GoalId,
    outcome: Outcome,
    /// Distinguishes the goal from a later goal with the same id.
    changed: Arc<Notify>,
}

#[derive(Debug)]
pub(super) struct ActionClientState {
    pub(super) goals: ClientGoals,
    /// The tasks of goals that have a handle.
    pub(super) tasks: BTreeMap<GoalId, AbortHandle>,
    /// An endpoint of the server that has accepted a goal, while the goal runs.
    servers: BTreeMap<GoalId, GUID>,
}

impl ActionClientShared {
    pub(super) fn new(
        (domain, peers): (&Domain, &ServicePeers),
        action: &ActionName,
        options: ActionClientOptions,
        (asked, ends): (ActionServiceClients, mpsc::Sender<GoalEnd>),
    ) -> Self {
        Self {
            action: action.clone(),
            options,
            participant: domain.guid(),
            peers: peers.clone(),
            asked,
            ends,
            state: Mutex::new(ActionClientState {
                goals: ClientGoals::new(ClientGoalLimits {
                    goals: options.max_goals,
                    feedback_messages: options.feedback_messages,
                    feedback_bytes: options.feedback_bytes,
                }),
                tasks: BTreeMap::new(),
                servers: BTreeMap::new(),
            }),
        }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, ActionClientState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Requests to cancel goals. Withdraws the goals that the server has not decided about.
    pub(super) async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
        let withdrawn = self.withdraw(what);
        if let (CancelWhat::Goal(_), [_, ..]) = (what, &withdrawn[..]) {
            return Ok(CancelAnswer {
                code: CancelCode::None,
                goals: withdrawn,
            });
        }
        let mut answer = self.ask_to_cancel(what).await?;
        answer.goals.extend(withdrawn);
        Ok(answer)
    }

    fn withdraw(&self, what: CancelWhat) -> Vec<GoalInfo> {
        let mut state = self.lock();
        let meant = match what {
            CancelWhat::Goal(id) | CancelWhat::GoalAndUntil(id, _) => vec![id],
            CancelWhat::All => state.goals.undecided(),
            CancelWhat::Until(_) => Vec::new(),
        };
        let now = Instant::now();
        let meant = meant.into_iter();
        let withdrawn = meant.filter(|id| state.goals.withdraw(*id, now));
        let stamp = Ros2Time::default();
        withdrawn.map(|id| GoalInfo { id, stamp }).collect()
    }

    async fn ask_to_cancel(&self, what: CancelWhat) -> Result<CancelAnswer, ServiceError> {
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

    /// Records that the handle of the goal was dropped.
    pub(super) fn forget(&self, id: GoalId) {
        let mut state = self.lock();
        if !state.goals.forget(id) {
            return;
        }
        state.servers.remove(&id);
        if let Some(task) = state.tasks.remove(&id) {
            task.abort();
        }
    }

    /// Returns an id made of the participant and a count, which is unique in the domain.
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
            let what = format!("its type is {theirs}, but {wanted} is required");
            return Err(missing(what));
        }
        for client in [&self.asked.send, &self.asked.cancel, &self.asked.result] {
            if client.servers() == 0 {
                return Err(missing(format!("nobody serves {}", client.service())));
            }
        }
        for topic in [self.action.feedback_topic(), self.action.status_topic()] {
            if seen.writers(&topic).is_empty() {
                return Err(missing(format!("no node publishes {topic}")));
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

    /// Returns when no server has been present for the time that a goal waits for a server.
    async fn wait_for_no_server(&self) {
        let mut since = Instant::now();
        while since.elapsed() < self.options.server_timeout {
            sleep(IDLE).await;
            if self.asked.result.servers() > 0 {
                since = Instant::now();
            }
        }
    }

    /// Drives a goal to its end. Its request is not sent after the time, if any.
    pub(super) async fn drive(self: Arc<Self>, id: GoalId, request: (Bytes, Option<Instant>)) {
        let changed = self.lock().goals.changed(id);
        // Both branches are cancel-safe: a cancel request is recorded as sent before it is sent.
        let outcome = tokio::select! {
            outcome = self.outcome(id, request) => outcome,
            never = self.cancel_withdrawn(id) => match never {},
        };
        if let Outcome::Done { .. } = &outcome {
            // Feedback that was sent before the result may wait on another socket, which is read
            // later.
            sleep(FEEDBACK_GRACE).await;
        }
        let end = GoalEnd {
            id,
            outcome,
            changed,
        };
        // The channel is closed together with the client; its goals have ended then.
        let _is_open = self.ends.send(end).await;
    }

    /// Ends a goal, unless its handle was dropped.
    pub(super) fn end(&self, end: GoalEnd) {
        let GoalEnd {
            id,
            outcome,
            changed,
        } = end;
        let mut state = self.lock();
        if !Arc::ptr_eq(&changed, &state.goals.changed(id)) {
            return;
        }
        let age = state.goals.withdrawal(id).map(|of| of.age(Instant::now()));
        if state.goals.end(id, outcome.clone()) {
            let action = self.action.name();
            let end = match &outcome {
                Outcome::Rejected => "rejected".to_owned(),
                Outcome::Done { status, .. } => format!("{status:?}"),
                Outcome::Lost(reason) => format!("unknown: {reason}"),
            };
            info!(action, goal = %id, ?age, end, "withdrawn goal has ended");
        }
        state.servers.remove(&id);
        state.tasks.remove(&id);
    }

    async fn outcome(&self, id: GoalId, request: (Bytes, Option<Instant>)) -> Outcome {
        let found = tokio::select! {
            biased;
            () = self.until(id, ClientGoals::is_withdrawn) => return Outcome::Lost(LostReason::Withdrawn),
            found = self.wait_for_server(self.options.server_timeout) => found,
        };
        if let Err(none) = found {
            return Outcome::Lost(none.into());
        }
        let server = match self.decision(id, request).await {
            Ok(server) => server,
            Err(outcome) => return outcome,
        };
        // After a restart, the former server may still be known while the new server is only partly
        // known: the request goes to the new server.
        let asked = self
            .asked
            .result
            .call_after(wire::result_request(id), server);
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
                Ok(GoalStatusCode::Unknown) => Outcome::Lost(LostReason::Unknown),
                Ok(status) => Outcome::Done { status, result },
                Err(Malformed) => Outcome::Lost(LostReason::Malformed("result")),
            },
        }
    }

    /// Sends the goal and waits until it is accepted: by the reply, which names an endpoint of the
    /// server, or by the status of the server, because the reply can be lost. Otherwise returns the
    /// outcome of the goal.
    async fn decision(
        &self,
        id: GoalId,
        (request, start_by): (Bytes, Option<Instant>),
    ) -> Result<Option<GUID>, Outcome> {
        let recall = Recall::after(start_by);
        let send = &self.asked.send;
        let mut asked = pin!(send.call_recallable(request, None, &recall));
        let mut overdue = pin!(after(self.options.answer_timeout));
        let (mut is_overdue, mut is_withdrawn) = (false, false);
        loop {
            tokio::select! {
                biased;
                answer = &mut asked => return self.decided(id, answer),
                () = self.until(id, ClientGoals::is_accepted) => {
                    let answer = timeout(ANSWER_AFTER_STATUS, asked).await;
                    let answer = answer.ok().and_then(Result::ok);
                    return answer.map_or(Ok(None), |answer| self.decided(id, Ok(answer)));
                }
                () = self.until(id, ClientGoals::is_withdrawn), if !is_withdrawn => {
                    if recall.recall() {
                        return Err(Outcome::Lost(LostReason::Withdrawn));
                    }
                    is_withdrawn = true;
                }
                limit = &mut overdue, if !is_overdue => {
                    if recall.recall() {
                        return Err(Outcome::Lost(LostReason::Unanswered(ServiceError::Timeout {
                            service: send.service().to_owned(),
                            phase: CallPhase::Discovery,
                            limit,
                        })));
                    }
                    is_overdue = true;
                    self.lock().goals.overdue(id, limit, Instant::now());
                }
            }
        }
    }

    fn decided(
        &self,
        id: GoalId,
        answer: Result<Replied, ServiceError>,
    ) -> Result<Option<GUID>, Outcome> {
        let lost = |reason| Err(Outcome::Lost(reason));
        let answer = match answer {
            Ok(answer) => answer,
            Err(error) => return lost(LostReason::Unanswered(error)),
        };
        match wire::read_goal_answer(&answer.reply) {
            Ok(None) => Err(Outcome::Rejected),
            Ok(Some(stamp)) => {
                let mut state = self.lock();
                // Unless the handle of the goal was dropped.
                if state.tasks.contains_key(&id) {
                    state.servers.insert(id, answer.writer);
                }
                state.goals.accepted(id, stamp, Instant::now());
                Ok(Some(answer.writer))
            }
            Err(Malformed) => lost(LostReason::Malformed("answer to the goal")),
        }
    }

    /// Returns when the condition holds for the goal.
    async fn until(&self, id: GoalId, holds: impl Fn(&ClientGoals, GoalId) -> bool) {
        let changed = self.lock().goals.changed(id);
        loop {
            let mut rung = pin!(changed.notified());
            // From here on, no notification is missed.
            let _rung = rung.as_mut().enable();
            if holds(&self.lock().goals, id) {
                return;
            }
            rung.await;
        }
    }

    /// Cancels the goal once it is withdrawn and accepted, until the server agrees or refuses.
    async fn cancel_withdrawn(&self, id: GoalId) -> Infallible {
        let due = |goals: &ClientGoals, id| goals.cancel_due(id).is_some();
        loop {
            self.until(id, due).await;
            let at = self.lock().goals.cancel_due(id);
            sleep_until(at.unwrap_or_else(Instant::now)).await;
            let is_due = {
                let mut state = self.lock();
                let withdrawal = state.goals.withdrawal(id);
                withdrawal.is_some_and(|withdrawal| withdrawal.take_due(Instant::now()))
            };
            if !is_due {
                continue;
            }
            let answer = self.ask_to_cancel(CancelWhat::Goal(id)).await;
            let answer = answer
                .inspect_err(|error| debug!(goal = %id, %error, "cannot cancel withdrawn goal yet"))
                .ok();
            let code = answer.map(|answer| answer.code);
            let mut state = self.lock();
            state.goals.cancel_answered(id, code, Instant::now());
        }
    }

    pub(super) fn hear_status(&self, sample: Option<ReceivedServiceSample>) {
        let goals = sample.ok_or(Malformed);
        let goals = goals.and_then(|sample| wire::read_status_array(&sample.payload));
        let mut state = self.lock();
        match goals {
            Ok(goals) => {
                let now = Instant::now();
                for (GoalInfo { id, stamp }, status) in goals {
                    state.goals.status(id, (status, stamp), now);
                }
            }
            Err(Malformed) => self.malformed(&mut state, "status"),
        }
    }

    pub(super) fn hear_feedback(&self, sample: Option<ReceivedServiceSample>) {
        let feedback = sample.ok_or(Malformed);
        let feedback = feedback.and_then(|sample| wire::split(&sample.payload));
        let mut state = self.lock();
        match feedback {
            Ok((id, body)) => state.goals.feedback(id, body),
            Err(Malformed) => self.malformed(&mut state, "feedback"),
        }
    }

    fn malformed(&self, state: &mut ActionClientState, what: &'static str) {
        state.goals.counters.malformed += 1;
        let action = self.action.name();
        debug!(action, what, "dropped a malformed sample");
    }
}

/// Returns the limit once it has elapsed; never returns for `None`.
async fn after(limit: Option<Duration>) -> Duration {
    match limit {
        Some(limit) => {
            sleep(limit).await;
            limit
        }
        None => std::future::pending().await,
    }
}

/// How long feedback may arrive after a result that was sent after it.
const FEEDBACK_GRACE: Duration = Duration::from_millis(10);
/// How long the reply to a goal may arrive after the status that reports the goal as accepted.
const ANSWER_AFTER_STATUS: Duration = Duration::from_secs(1);
