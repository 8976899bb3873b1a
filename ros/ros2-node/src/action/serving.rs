//! The parts of an action server behind its handles: the three services, the two topics, and the
//! periodic task.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{Notify, oneshot, watch};
use tokio::time::{Instant, sleep, sleep_until, timeout, timeout_at};
use tracing::debug;

use super::feedback::FeedbackWriter;
use super::server_goals::{
    GoalError, MOST_WAITING, NewGoalDecision, ResultRequest, ServerGoals, Ticket,
};
use super::types::{CancelAnswer, CancelCode, CancelWhat, GoalId, GoalInfo, GoalStatusCode};
use super::{ActionName, STATUS_TYPE, wire};
use crate::cdr::Malformed;
use crate::clock::{Ros2Clock, Ros2Time};
use crate::domain::{Domain, DomainError};
use crate::outlet::{Outlet, OutletRefusal};
use crate::qos::Offered;
use crate::raw::Payload;
use crate::service::{
    BUSY, HandlerResult, IDLE, NoValue, ServiceOptions, ServicePeers, ServiceRequest,
    ServiceServer, policies,
};

/// The limits of an action server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActionServerOptions {
    /// An `X_GetResult_Response` with default field values, little-endian CDR with its
    /// encapsulation header. It is sent for unknown goals and for goals that end without a result
    /// from the user. Clients of the type have to be able to decode it.
    pub empty_result: Bytes,
    /// How long the result of a goal is kept after its end, in steady time; `None` keeps it until
    /// room is needed. The default of `rcl_action_server_get_default_options` is 10 seconds, up to
    /// ROS 2 Humble 15 minutes.
    pub result_timeout: Option<Duration>,
    /// Maximum number of known goals, including ended goals. Beyond it, ended goals are removed
    /// early; if no goal has ended, new goals are rejected.
    pub max_goals: usize,
    /// How long a cancel request waits for the user's decision. After that, it counts as rejected.
    pub cancel_timeout: Duration,
}

impl ActionServerOptions {
    /// Returns options that keep results for 10 seconds, allow 1000 goals, and allow 5 seconds for
    /// the decision about a cancel request.
    #[must_use]
    pub const fn new(empty_result: Bytes) -> Self {
        Self {
            empty_result,
            result_timeout: Some(Duration::from_secs(10)),
            max_goals: 1000,
            cancel_timeout: Duration::from_secs(5),
        }
    }
}

/// The state that the server, its services, its task and its goals share.
#[derive(Debug)]
pub(super) struct ActionServerShared {
    action: ActionName,
    options: ActionServerOptions,
    clock: Ros2Clock,
    state: Mutex<ActionServerState>,
    /// Notifies [`ActionServer::recv`](super::ActionServer::recv).
    pub(super) arrival: Notify,
    /// Notifies all goals that a goal has changed.
    pub(super) changed: watch::Sender<()>,
    /// Notifies the task that a message waits to be sent.
    unsent: Notify,
}

#[derive(Debug)]
pub(super) struct ActionServerState {
    pub(super) goals: Goals,
    /// `None` once the server is dropped.
    outputs: Option<Outputs>,
    pub(super) arrived: VecDeque<Arrived>,
}

type Goals = ServerGoals<oneshot::Sender<Bytes>>;

#[derive(Debug)]
struct Outputs {
    peers: ServicePeers,
    feedback: FeedbackWriter,
    status: Outlet,
}

/// A request that waits for the user.
#[derive(Debug)]
pub(super) enum Arrived {
    Goal {
        ticket: Ticket,
        body: Bytes,
        answer: oneshot::Sender<Acceptance>,
    },
    Cancel {
        ticket: Ticket,
        answer: oneshot::Sender<CancelAgreed>,
    },
}

/// The acceptance of a goal, and the sender to drop when its client was notified.
#[derive(Debug)]
pub(super) struct Acceptance {
    pub(super) stamp: Ros2Time,
    pub(super) written: oneshot::Sender<NoValue>,
}

/// The agreement to cancel a goal.
#[derive(Debug)]
pub(super) struct CancelAgreed;

impl ActionServerShared {
    /// Creates the writers of the topics.
    pub(super) fn new(
        domain: &Domain,
        peers: &ServicePeers,
        action: &ActionName,
        options: ActionServerOptions,
    ) -> Result<Self, DomainError> {
        let feedback = domain.open_writer(
            &action.feedback_topic(),
            &action.feedback_type(),
            &policies(),
        )?;
        let offered = Offered::KeepLatest;
        let status = domain.writer(&action.status_topic(), STATUS_TYPE, offered)?;
        let outputs = Outputs {
            peers: peers.clone(),
            feedback: FeedbackWriter::new(feedback),
            status: Outlet::new(status, offered, domain.joined()),
        };
        Ok(Self {
            action: action.clone(),
            clock: domain.clock(),
            state: Mutex::new(ActionServerState {
                goals: ServerGoals::new(options.max_goals, options.result_timeout),
                outputs: Some(outputs),
                arrived: VecDeque::new(),
            }),
            options,
            arrival: Notify::new(),
            changed: watch::Sender::new(()),
            unsent: Notify::new(),
        })
    }

    /// Opens the services. Each service may handle as many requests as can wait for their replies,
    /// and some more that are answered at once, so no request waits for another.
    pub(super) fn serve(
        self: &Arc<Self>,
        domain: &Domain,
        peers: &ServicePeers,
    ) -> Result<[ServiceServer; 3], DomainError> {
        let goals = self.options.max_goals;
        let options = |waiting: usize| ServiceOptions {
            max_handled: waiting.saturating_add(AT_ONCE),
            handler_timeout: None,
            ..ServiceOptions::default()
        };
        let [send, cancel, result] = [(); 3].map(|()| Arc::clone(self));
        Ok([
            ServiceServer::open_told(
                domain,
                peers,
                &self.action.send_goal(),
                options(goals),
                move |request| Arc::clone(&send).goal_requested(request),
            )?,
            ServiceServer::open(
                domain,
                peers,
                &self.action.cancel_goal(),
                options(0),
                move |request| Arc::clone(&cancel).cancel_requested(request),
            )?,
            ServiceServer::open(
                domain,
                peers,
                &self.action.get_result(),
                options(goals.saturating_mul(MOST_WAITING)),
                move |request| Arc::clone(&result).result_requested(request),
            )?,
        ])
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, ActionServerState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn action_name(&self) -> &str {
        self.action.name()
    }

    pub(super) fn empty_result(&self) -> Bytes {
        self.options.empty_result.clone()
    }

    pub(super) fn is_open(&self) -> bool {
        self.lock().outputs.is_some()
    }

    /// Closes the topics and drops the requests that the user has not received.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        let left = (state.outputs.take(), std::mem::take(&mut state.arrived));
        drop(state);
        // Without the lock: RustDDS may log during the drop.
        drop(left);
        self.changed.send_replace(());
    }

    /// Accepts a goal; returns the time of acceptance.
    pub(super) fn accept(&self, ticket: Ticket) -> Result<Ros2Time, GoalError> {
        let stamp = self.clock.now();
        let mut state = self.lock();
        state.open()?;
        state.goals.accept(ticket, stamp)?;
        Ok(stamp)
    }

    /// Records that the client of a goal was notified of its acceptance.
    pub(super) fn accepted(&self) {
        let mut guard = self.lock();
        let state = &mut *guard;
        if let Some(outputs) = &mut state.outputs {
            // The client's feedback reader may be new.
            self.note(outputs.meet(&self.action, Instant::now(), BUSY));
        }
        self.publish_status(state);
    }

    /// Applies a decision, publishes the status, and sends the result to the requests that waited
    /// for it.
    pub(super) fn decide(
        &self,
        decision: impl FnOnce(&mut Goals) -> Result<Vec<(oneshot::Sender<Bytes>, Bytes)>, GoalError>,
    ) -> Result<(), GoalError> {
        let mut state = self.lock();
        state.open()?;
        let results = decision(&mut state.goals)?;
        self.publish_status(&mut state);
        drop(state);
        for (who, result) in results {
            // The receiver is closed if the client has left.
            drop(who.send(result));
        }
        self.changed.send_replace(());
        Ok(())
    }

    /// Sends the feedback of a goal that has not ended.
    pub(super) fn feedback(
        &self,
        ticket: Ticket,
        message: Payload,
        now: Instant,
    ) -> Result<(), GoalError> {
        let mut guard = self.lock();
        let state = &mut *guard;
        let outputs = state.outputs.as_mut().ok_or(GoalError::Closed)?;
        match state.goals.status(ticket) {
            None => return Err(GoalError::Forgotten(ticket.id)),
            Some(from) if from.is_terminal() => {
                return Err(GoalError::NotFrom {
                    goal: ticket.id,
                    from,
                    wanted: "given feedback",
                });
            }
            Some(_) => {}
        }
        state.goals.counters.feedback_dropped += outputs.feedback.offer(message, now);
        if outputs.feedback.is_waiting() {
            self.unsent.notify_one();
        }
        Ok(())
    }

    async fn goal_requested(
        self: Arc<Self>,
        request: ServiceRequest,
    ) -> Result<HandlerResult, String> {
        let (id, body) = wire::split(&request.bytes).map_err(|Malformed| self.malformed())?;
        let accepted = match self.arrive(id, body) {
            Some(decision) => decision.await.ok(),
            None => None,
        };
        if accepted.is_some()
            && let Some(outputs) = &mut self.lock().outputs
        {
            outputs.feedback.expect(request.client, Instant::now());
        }
        Ok(match accepted {
            Some(Acceptance { stamp, written }) => HandlerResult {
                bytes: wire::goal_answer(true, stamp),
                written: Some(written),
            },
            None => wire::goal_answer(false, self.clock.now()).into(),
        })
    }

    /// Passes a goal to the user and returns the receiver of the decision; `None` if the goal is
    /// rejected at once.
    fn arrive(&self, id: GoalId, body: Bytes) -> Option<oneshot::Receiver<Acceptance>> {
        let mut state = self.lock();
        let ticket = match state.goals.arrive(id) {
            NewGoalDecision::New(ticket) => ticket,
            refused @ (NewGoalDecision::Known | NewGoalDecision::Full) => {
                debug!(action = self.action.name(), %id, ?refused, "rejected a goal");
                return None;
            }
        };
        let (answer, decision) = oneshot::channel();
        state.arrived.push_back(Arrived::Goal {
            ticket,
            body,
            answer,
        });
        drop(state);
        self.arrival.notify_one();
        Some(decision)
    }

    async fn cancel_requested(self: Arc<Self>, request: ServiceRequest) -> Result<Bytes, String> {
        let what =
            wire::read_cancel_request(&request.bytes).map_err(|Malformed| self.malformed())?;
        let asked = match self.ask_to_cancel(what) {
            Ok(asked) => asked,
            Err(code) => {
                let goals = Vec::new();
                return Ok(wire::cancel_answer(&CancelAnswer { code, goals }));
            }
        };
        let now = Instant::now();
        let deadline = now.checked_add(self.options.cancel_timeout);
        let deadline = deadline.unwrap_or_else(|| now + LONGEST);
        let none = asked.is_empty();
        let mut goals = Vec::new();
        for (info, decision) in asked {
            if let Ok(Ok(CancelAgreed)) = timeout_at(deadline, decision).await {
                goals.push(info);
            }
        }
        let code = if goals.is_empty() && !none {
            CancelCode::Rejected
        } else {
            CancelCode::None
        };
        Ok(wire::cancel_answer(&CancelAnswer { code, goals }))
    }

    /// Passes a cancel request to the user, once for each selected goal.
    fn ask_to_cancel(
        &self,
        what: CancelWhat,
    ) -> Result<Vec<(GoalInfo, oneshot::Receiver<CancelAgreed>)>, CancelCode> {
        let mut guard = self.lock();
        let state = &mut *guard;
        let mut asked = Vec::new();
        for (ticket, info) in state.goals.to_cancel(what)? {
            let (answer, decision) = oneshot::channel();
            if state.arrived.len() < self.options.max_goals.saturating_mul(2) {
                let arrived = Arrived::Cancel { ticket, answer };
                state.arrived.push_back(arrived);
            } else {
                // Without a decision, the request counts as rejected.
                state.goals.counters.refused += 1;
            }
            asked.push((info, decision));
        }
        drop(guard);
        self.arrival.notify_one();
        Ok(asked)
    }

    async fn result_requested(self: Arc<Self>, request: ServiceRequest) -> Result<Bytes, String> {
        let id = wire::read_result_request(&request.bytes).map_err(|Malformed| self.malformed())?;
        let (who, result) = oneshot::channel();
        let asked = self.lock().goals.ask(id, || who);
        let result = match asked {
            ResultRequest::Ended(result) => Ok(result),
            ResultRequest::Unknown => {
                wire::with_status(&self.options.empty_result, GoalStatusCode::Unknown)
                    .ok_or_else(|| "the empty result in the options is not CDR".to_owned())
            }
            ResultRequest::Waits(displaced) => {
                drop(displaced);
                let why =
                    "too many clients wait for the result of this goal, or the server was closed";
                result.await.map_err(|_| why.to_owned())
            }
        };
        self.feedback_first().await;
        result
    }

    /// Waits until queued feedback is sent: a client ignores feedback after the result. A reader
    /// that accepts no sample delays a result by half a second.
    async fn feedback_first(&self) {
        let is_waiting = || {
            let state = self.lock();
            let outputs = state.outputs.as_ref();
            outputs.is_some_and(|outputs| outputs.feedback.is_waiting())
        };
        let sent = async {
            while is_waiting() {
                sleep(BUSY).await;
            }
        };
        let _is_sent = timeout(FEEDBACK_FIRST, sent).await.is_ok();
    }

    fn malformed(&self) -> String {
        self.lock().goals.counters.malformed += 1;
        "dropped a malformed request".to_owned()
    }

    fn publish_status(&self, state: &mut ActionServerState) {
        let Some(outputs) = &mut state.outputs else {
            return;
        };
        let list = wire::status_array(&state.goals.list());
        if let Ok(list) = Payload::to_write(list) {
            self.note(outputs.status.offer(list, None, Instant::now()));
        }
        if outputs.status.is_waiting() {
            self.unsent.notify_one();
        }
    }

    /// Does the due work; returns the time of the next call.
    fn tick(&self, now: Instant) -> Instant {
        let mut guard = self.lock();
        let state = &mut *guard;
        let expired = state.goals.expire(now);
        if let Some(outputs) = &mut state.outputs {
            self.note(outputs.meet(&self.action, now, IDLE));
            state.goals.counters.feedback_dropped += outputs.feedback.flush(now);
        }
        if expired {
            self.publish_status(state);
        }
        let waits =
            |outputs: &Outputs| outputs.feedback.is_waiting() || outputs.status.is_waiting();
        now + if state.outputs.as_ref().is_some_and(waits) {
            BUSY
        } else {
            IDLE
        }
    }

    /// Logs a failure to publish the status. The next status repeats the complete list.
    fn note(&self, sent: Result<(), OutletRefusal>) {
        match sent {
            // At most the newest status waits.
            Ok(()) | Err(OutletRefusal::Overflow | OutletRefusal::NoReader) => {}
            Err(
                refusal
                @ (OutletRefusal::TooLarge(_) | OutletRefusal::Late | OutletRefusal::Failed),
            ) => {
                let (action, why) = (self.action.name(), refusal.label());
                debug!(action, why, "cannot publish the status of the goals");
            }
        }
    }
}

impl ActionServerState {
    const fn open(&self) -> Result<(), GoalError> {
        match self.outputs {
            Some(_) => Ok(()),
            None => Err(GoalError::Closed),
        }
    }
}

impl Outputs {
    /// Updates the known readers from a snapshot no older than `age`, and sends the waiting status.
    fn meet(
        &mut self,
        action: &ActionName,
        now: Instant,
        age: Duration,
    ) -> Result<(), OutletRefusal> {
        let seen = self.peers.look(now, age);
        self.feedback
            .meet(seen.readers(&action.feedback_topic()), now);
        let readers = seen.readers(&action.status_topic());
        self.status.set_readers(readers, now)?;
        self.status.flush(now)
    }
}

/// Runs the periodic work until aborted: expires results, updates the readers, and sends waiting
/// messages.
pub(super) async fn run(shared: Arc<ActionServerShared>) {
    let mut due = Instant::now();
    loop {
        tokio::select! {
            () = sleep_until(due) => due = shared.tick(Instant::now()),
            () = shared.unsent.notified() => due = due.min(Instant::now() + BUSY),
        }
    }
}

/// Requests that are answered at once, in addition to waiting requests.
const AT_ONCE: usize = 64;
/// How long a result waits for feedback that is not sent yet.
const FEEDBACK_FIRST: Duration = Duration::from_millis(500);
/// Replaces a timeout too long for the clock.
const LONGEST: Duration = Duration::from_secs(86_400 * 365);
