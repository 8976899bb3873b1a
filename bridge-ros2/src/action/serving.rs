//! What serves an action behind its handles: the three services, the two topics, and the task that keeps time.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::{Notify, oneshot, watch};
use tokio::time::{Instant, sleep, sleep_until, timeout, timeout_at};
use tracing::debug;

use super::feedback::FeedbackWriter;
use super::server_goals::{Arrival, Asked, GoalError, MOST_WAITING, ServerGoals, Ticket};
use super::types::{CancelAnswer, CancelCode, CancelWhat, GoalId, GoalInfo, Status};
use super::{Action, STATUS_TYPE, wire};
use crate::cdr::Malformed;
use crate::clock::{RosClock, RosTime};
use crate::domain::{Domain, DomainError};
use crate::outlet::{Outlet, Refusal};
use crate::qos::Offered;
use crate::raw::Payload;
use crate::service::{
    Answer, BUSY, IDLE, Never, ServiceOptions, ServicePeers, ServiceRequest, ServiceServer,
    policies,
};

/// What a server holds, and for how long.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActionServerOptions {
    /// An `X_GetResult_Response` with nothing in it, little endian CDR with its encapsulation header: for goals that are
    /// unknown, and those that end without a result of yours. Clients of the type have to be able to read it.
    pub empty_result: Bytes,
    /// How long the result of a goal is kept after its end, by the steady clock; `None` keeps it until there is no
    /// room. `rcl_action_server_get_default_options` says 10 seconds, up to ROS 2 Humble 15 minutes.
    pub result_timeout: Option<Duration>,
    /// How many goals are known at once, ended ones included. When there are more, ended ones are forgotten early; when
    /// none has ended, goals are rejected.
    pub max_goals: usize,
    /// How long a request to cancel waits for your decision. Past that it counts as rejected.
    pub cancel_timeout: Duration,
}

impl ActionServerOptions {
    /// Results are kept for 10 seconds; 1000 goals; 5 seconds to decide about cancelling.
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

/// What the server, its services, its task and its goals share.
#[derive(Debug)]
pub(super) struct Shared {
    action: Action,
    options: ActionServerOptions,
    clock: RosClock,
    state: Mutex<State>,
    /// Rings for [`ActionServer::recv`](super::ActionServer::recv).
    pub(super) arrival: Notify,
    /// Tells all goals that one has changed.
    pub(super) changed: watch::Sender<()>,
    /// Rings for the task when something waits to be sent.
    unsent: Notify,
}

#[derive(Debug)]
pub(super) struct State {
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

/// What waits for the user.
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

/// That a goal was accepted, and what to drop when its client knows.
#[derive(Debug)]
pub(super) struct Acceptance {
    pub(super) stamp: RosTime,
    pub(super) written: oneshot::Sender<Never>,
}

/// That a goal is being cancelled.
#[derive(Debug)]
pub(super) struct CancelAgreed;

impl Shared {
    /// Makes the topics' writers.
    pub(super) fn new(
        domain: &Domain,
        peers: &ServicePeers,
        action: &Action,
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
            state: Mutex::new(State {
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

    /// Opens the services. Each may handle as many requests as can wait for their answers here, and some more that are
    /// answered at once: none waits for another.
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

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
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

    /// Lets go of the topics, and of what nobody has taken.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        let left = (state.outputs.take(), std::mem::take(&mut state.arrived));
        drop(state);
        // Without the lock: RustDDS may have something to say about it.
        drop(left);
        self.changed.send_replace(());
    }

    /// Accepts a goal; returns when.
    pub(super) fn accept(&self, ticket: Ticket) -> Result<RosTime, GoalError> {
        let stamp = self.clock.now();
        let mut state = self.lock();
        state.open()?;
        state.goals.accept(ticket, stamp)?;
        Ok(stamp)
    }

    /// A goal's client knows that it was accepted.
    pub(super) fn accepted(&self) {
        let mut guard = self.lock();
        let state = &mut *guard;
        if let Some(outputs) = &mut state.outputs {
            // Its reader of feedback may be new.
            self.note(outputs.meet(&self.action, Instant::now(), BUSY));
        }
        self.publish_status(state);
    }

    /// Applies a decision, tells the status, and gives those who waited for it their result.
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
            // A client that went away asks no more.
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

    async fn goal_requested(self: Arc<Self>, request: ServiceRequest) -> Result<Answer, String> {
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
            Some(Acceptance { stamp, written }) => Answer {
                bytes: wire::goal_answer(true, stamp),
                written: Some(written),
            },
            None => wire::goal_answer(false, self.clock.now()).into(),
        })
    }

    /// Hands a goal to the user, whose decision is to come; `None` where it is rejected without.
    fn arrive(&self, id: GoalId, body: Bytes) -> Option<oneshot::Receiver<Acceptance>> {
        let mut state = self.lock();
        let ticket = match state.goals.arrive(id) {
            Arrival::New(ticket) => ticket,
            refused @ (Arrival::Known | Arrival::Full) => {
                debug!(action = self.action.name(), %id, ?refused, "a goal is rejected");
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

    /// Hands a request to cancel to the user, once for each goal that it is about.
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
                // Without an answer it counts as rejected.
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
            Asked::Ended(result) => Ok(result),
            Asked::Unknown => wire::with_status(&self.options.empty_result, Status::Unknown)
                .ok_or_else(|| "the empty result of the options is no CDR".to_owned()),
            Asked::Waits(displaced) => {
                drop(displaced);
                let why = "too many wait for the result of one goal, or the server has gone";
                result.await.map_err(|_| why.to_owned())
            }
        };
        self.feedback_first().await;
        result
    }

    /// Waits until queued feedback is sent: a client reports none after the result. A reader that
    /// takes nothing holds up a result for half a second.
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
        "a request that does not read".to_owned()
    }

    fn publish_status(&self, state: &mut State) {
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

    /// Does what is due, and returns when it is to be done again.
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

    /// The next status says all again.
    fn note(&self, sent: Result<(), Refusal>) {
        match sent {
            // One status waits, which is the newest.
            Ok(()) | Err(Refusal::Overflow | Refusal::NoReader) => {}
            Err(refusal @ (Refusal::TooLarge(_) | Refusal::Late | Refusal::Failed)) => {
                let (action, why) = (self.action.name(), refusal.label());
                debug!(action, why, "the status of its goals is not published");
            }
        }
    }
}

impl State {
    const fn open(&self) -> Result<(), GoalError> {
        match self.outputs {
            Some(_) => Ok(()),
            None => Err(GoalError::Closed),
        }
    }
}

impl Outputs {
    /// Takes note of who listens, looked at no longer than `age` ago, and sends the status that waits.
    fn meet(&mut self, action: &Action, now: Instant, age: Duration) -> Result<(), Refusal> {
        let seen = self.peers.look(now, age);
        self.feedback
            .meet(seen.readers(&action.feedback_topic()), now);
        let readers = seen.readers(&action.status_topic());
        self.status.set_readers(readers, now)?;
        self.status.flush(now)
    }
}

/// Keeps time until aborted: forgets results, takes note of readers, sends what waits.
pub(super) async fn run(shared: Arc<Shared>) {
    let mut due = Instant::now();
    loop {
        tokio::select! {
            () = sleep_until(due) => due = shared.tick(Instant::now()),
            () = shared.unsent.notified() => due = due.min(Instant::now() + BUSY),
        }
    }
}

/// Requests that are answered at once, beside those that wait.
const AT_ONCE: usize = 64;
/// How long a result waits for feedback that is yet to be sent.
const FEEDBACK_FIRST: Duration = Duration::from_millis(500);
/// Stands for a time limit too long for the clock.
const LONGEST: Duration = Duration::from_secs(86_400 * 365);
