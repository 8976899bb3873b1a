//! The execution of a Program: the goal that was sent, and the resulting state.

use std::sync::Arc;
use std::time::Duration;

use bridge_node::AskErrorKind;
use mappings::TopicId;
use opcua::sync::Mutex;
use opcua::types::{ByteString, DateTime, NodeId, StatusCode, Variant};
use program::{Ending, Nature, ProgramInstance, ProgramMachineState, ProgramMethod, Rest, RunId};
use tokio::sync::watch;
use tokio::time::{Instant, sleep, timeout};
use tracing::{info, warn};
use uadp::Fields;

use super::nodes::{GoalOutcome, ProgramNodes, SUCCEEDED, whole};
use super::unknown::UnknownOutcomes;
use crate::asking::{CallFailure, Callable, Drive, Questions};
use crate::value;

/// A Program. Its methods are executed one at a time.
pub(crate) struct Run {
    name: String,
    nodes: ProgramNodes,
    send: Callable,
    cancel: Callable,
    result: Callable,
    /// The call that sends the goals.
    goal: TopicId,
    /// The Programs that need a Reset after a restart.
    unknown: Arc<UnknownOutcomes>,
    inner: Mutex<Inner>,
    /// The state, for tasks that wait for a change. Never closed.
    state: watch::Sender<ProgramMachineState>,
}

struct Inner {
    program: ProgramInstance,
    /// The current goal, which is executed or being sent.
    goal: Option<ByteString>,
    /// The goal is being sent: only Halt may be called.
    starting: bool,
    /// The goal is being cancelled, and its end is not known.
    halting: Option<Halting>,
    /// The action was removed, or the server stops.
    left: bool,
}

/// A pending cancellation.
struct Halting {
    why: String,
    /// Time after which a second Halt ends the run with an unknown outcome.
    over: Instant,
    /// The action server has lost the goal: a second Halt ends the run at once.
    is_lost: bool,
}

impl Inner {
    /// Returns the pending cancellation, which is created if necessary.
    fn cancel(&mut self) -> &mut Halting {
        self.halting.get_or_insert_with(|| Halting {
            why: PENDING.to_owned(),
            over: Instant::now() + HALT_TIMEOUT,
            is_lost: false,
        })
    }
}

impl Run {
    /// Creates a Program in Ready, or in Halted after a goal with an unknown outcome.
    pub(super) fn new(
        (name, goal): (String, TopicId),
        nodes: ProgramNodes,
        [send, cancel, result]: [Callable; 3],
        unknown: &Arc<UnknownOutcomes>,
    ) -> Arc<Self> {
        let needs_reset = unknown.has(goal);
        let mut program = ProgramInstance::new(Nature {
            can_suspend: false,
            rests_in: Rest::Ready,
        });
        if !needs_reset {
            // An announced action is ready.
            let _ready = program.call(ProgramMethod::Reset);
        }
        let (state, _) = watch::channel(program.state());
        nodes.show_first(program.state());
        if needs_reset {
            nodes.show_outcome(&GoalOutcome::lost(BEFORE_RESTART.to_owned()));
        }
        Arc::new(Self {
            name,
            nodes,
            send,
            cancel,
            result,
            goal,
            unknown: Arc::clone(unknown),
            inner: Mutex::new(Inner {
                program,
                goal: None,
                starting: false,
                halting: None,
                left: false,
            }),
            state,
        })
    }

    /// Returns a method of the Program, for clients that may call the Method at `goal`.
    pub(super) fn drive(
        self: &Arc<Self>,
        method: ProgramMethod,
        questions: &Questions,
        goal: NodeId,
    ) -> Drive {
        let (run, questions) = (Arc::clone(self), questions.clone());
        Drive {
            goal,
            carry_out: Arc::new(move |arguments| {
                let called = Arc::clone(&run).call(method, arguments, questions.clone());
                Box::pin(called)
            }),
        }
    }

    async fn call(
        self: Arc<Self>,
        method: ProgramMethod,
        arguments: Vec<Variant>,
        questions: Questions,
    ) -> Result<Vec<Variant>, CallFailure> {
        match method {
            ProgramMethod::Start => self.start(arguments, questions).await,
            ProgramMethod::Halt => self.halt(&questions).await,
            ProgramMethod::Reset => self.reset(),
            ProgramMethod::Suspend | ProgramMethod::Resume => Err(NOT_NOW_AND_NEVER),
        }
    }

    pub(super) const fn nodes(&self) -> &ProgramNodes {
        &self.nodes
    }

    /// Sends a goal, and starts the Program when the goal is accepted.
    async fn start(
        self: Arc<Self>,
        arguments: Vec<Variant>,
        questions: Questions,
    ) -> Result<Vec<Variant>, CallFailure> {
        // The first argument is the goal id, which is generated here.
        let most = self.send.description().request.len().saturating_sub(1);
        if arguments.len() > most {
            return Err(CallFailure::Status(StatusCode::BadTooManyArguments));
        }
        let id = opcua::crypto::random::byte_string(16);
        {
            let mut inner = self.inner.lock();
            if inner.left || inner.starting || !inner.program.is_executable(ProgramMethod::Start) {
                return Err(CallFailure::Status(StatusCode::BadInvalidState));
            }
            inner.starting = true;
            // Feedback may arrive before the answer.
            inner.goal = Some(id.clone());
        }
        // If the server is killed during the goal, its outcome is unknown to the next one.
        self.unknown.begin(self.goal).await;
        // The goal is stored first; a Halt meanwhile must not be overtaken by it.
        let is_withdrawn = {
            let inner = self.inner.lock();
            inner.left || inner.halting.is_some()
        };
        let accepted = if is_withdrawn {
            let refused = CallFailure::Status(StatusCode::BadRequestCancelledByRequest);
            Err((refused, Some("halted before the goal was sent".to_owned())))
        } else {
            let mut goal = vec![Variant::from(id.clone())];
            goal.extend(arguments);
            match self.send.call(&goal, &questions, || false).await {
                Ok(answer) => self.is_accepted(&answer),
                Err(refused) => Err((in_terms_of_start(refused), None)),
            }
        };
        let mut inner = self.inner.lock();
        inner.starting = false;
        if inner.left {
            return Err(CallFailure::Status(StatusCode::BadNoCommunication));
        }
        // If the Program runs already, it was halted in the meantime, and the outcome of the goal
        // is awaited.
        let runs = inner.program.state() == ProgramMachineState::Running;
        match accepted {
            Ok(()) if runs => {}
            Ok(()) => self.runs(&mut inner, &id, ("the goal is accepted", &questions))?,
            Err((refused, _)) if is_unknown(&refused) => {
                if !runs {
                    let why = "whether the goal is accepted is not known: it is being cancelled";
                    self.runs(&mut inner, &id, (why, &questions))?;
                }
                self.pends(&mut inner, PENDING);
                let again = Arc::clone(&self).cancel_until_ended(id, questions.clone());
                tokio::spawn(again);
                return Err(refused);
            }
            Err((refused, why)) => {
                let outcome = GoalOutcome::never_ran(why.unwrap_or_default());
                match inner.program.run().filter(|_| runs) {
                    Some(run) => {
                        drop(inner);
                        self.ended(run, outcome);
                    }
                    None => {
                        inner.goal = None;
                        self.unknown.end(self.goal);
                        self.nodes.show_goal(&id);
                        self.nodes.show_outcome(&outcome);
                    }
                }
                return Err(refused);
            }
        }
        Ok(vec![Variant::from(id)])
    }

    /// Starts the Program and waits for the end of the goal.
    fn runs(
        self: &Arc<Self>,
        inner: &mut Inner,
        id: &ByteString,
        (why, questions): (&str, &Questions),
    ) -> Result<(), CallFailure> {
        let started = inner.program.call(ProgramMethod::Start);
        let transition = started.map_err(|_| CallFailure::Status(StatusCode::BadInvalidState))?;
        inner.halting = None;
        self.nodes.show_goal(id);
        self.nodes.show_transition(transition, why);
        self.state.send_replace(inner.program.state());
        if let Some(run) = inner.program.run() {
            tokio::spawn(Arc::clone(self).follow(id.clone(), run, questions.clone()));
        }
        Ok(())
    }

    /// Shows why a cancellation is pending.
    fn pends(&self, inner: &mut Inner, why: &str) {
        info!(program = self.name, "{why}");
        self.nodes.show_pending(why, inner.program.state());
        why.clone_into(&mut inner.cancel().why);
    }

    /// Returns why a cancelled goal has not ended, or `None` if no cancellation is pending.
    pub(super) fn pending(&self) -> Option<String> {
        let inner = self.inner.lock();
        let halting = inner.halting.as_ref()?;
        Some(format!("Program {}: {}", self.name, halting.why))
    }

    /// Checks if a goal is accepted. The error has the reason of a rejection as text for the
    /// operator.
    fn is_accepted(&self, answer: &[Variant]) -> Result<(), (CallFailure, Option<String>)> {
        match answer {
            [Variant::Boolean(true), ..] => Ok(()),
            [Variant::Boolean(false), rest @ ..] => {
                let why = rest.last().map(ToString::to_string).unwrap_or_default();
                info!(program = self.name, "a goal is rejected: {why}");
                let refused = CallFailure::Status(StatusCode::BadRequestNotAllowed);
                Err((refused, Some(why)))
            }
            _ => Err((CallFailure::Status(StatusCode::BadDecodingError), None)),
        }
    }

    /// Waits for the end of a goal.
    async fn follow(self: Arc<Self>, id: ByteString, run: RunId, questions: Questions) {
        let mut pause = FIRST_PAUSE;
        loop {
            let asked = [Variant::from(id.clone())];
            match self.result.call(&asked, &questions, || false).await {
                Ok(answer) => {
                    let outcome = GoalOutcome::of(answer);
                    if outcome.status != UNKNOWN || !self.is_lost(&outcome.said()) {
                        return self.ended(run, outcome);
                    }
                }
                Err(CallFailure::Asked(error)) if error.kind == AskErrorKind::Failed => {
                    return self.ended(run, GoalOutcome::lost(error.text));
                }
                Err(CallFailure::Arguments(_)) => {
                    let why = "the result cannot be asked for".to_owned();
                    return self.ended(run, GoalOutcome::lost(why));
                }
                // The goal continues, or the action server is unreachable for the moment. If it is
                // lost permanently, the action is removed.
                Err(CallFailure::Status(_) | CallFailure::Asked(_)) => {}
            }
            if self.is_over(run) {
                return;
            }
            sleep(pause).await;
            pause = (pause * 2).min(LAST_PAUSE);
        }
    }

    fn is_over(&self, run: RunId) -> bool {
        let inner = self.inner.lock();
        let runs = inner.program.state() == ProgramMachineState::Running
            && inner.program.run() == Some(run);
        inner.left || !runs
    }

    /// Handles that the action server does not know the goal. Returns true if the goal is being
    /// cancelled: the Program then stays Running until a client acknowledges the loss by a second
    /// Halt.
    fn is_lost(&self, said: &str) -> bool {
        let mut inner = self.inner.lock();
        let Some(halting) = &mut inner.halting else {
            return false;
        };
        if !std::mem::replace(&mut halting.is_lost, true) {
            let why = format!("the outcome is unknown: {said}; Halt ends the Program");
            self.pends(&mut inner, &why);
        }
        true
    }

    /// Repeats the cancellation until the action server agrees or the goal has ended, because a
    /// request may arrive before the goal or be lost.
    async fn cancel_until_ended(self: Arc<Self>, id: ByteString, questions: Questions) {
        loop {
            let answer = self.ask_to_cancel(&id, &questions).await;
            let is_current = {
                let mut inner = self.inner.lock();
                let is_current = inner.goal.as_ref() == Some(&id) && inner.halting.is_some();
                if is_current && matches!(answer, Ok(REJECTED)) {
                    self.refused(&mut inner);
                }
                is_current && inner.halting.is_some() && !matches!(answer, Ok(AGREED))
            };
            if !is_current {
                return;
            }
            sleep(LAST_PAUSE).await;
        }
    }

    /// Handles that the action server refuses to cancel the goal, which continues.
    fn refused(&self, inner: &mut Inner) {
        inner.halting = None;
        let why = "the action server refuses to cancel the goal, which goes on";
        info!(program = self.name, "{why}");
        self.nodes.show_pending(why, inner.program.state());
    }

    fn ended(&self, run: RunId, outcome: GoalOutcome) {
        let mut inner = self.inner.lock();
        if inner.left {
            return;
        }
        let halted = inner.halting.is_some();
        let message = self.nodes.said(&outcome);
        let ended = match outcome.status {
            _ if inner.program.run() != Some(run) => return,
            SUCCEEDED => inner.program.ended(run, Ending::Success).ok(),
            _ if halted => inner.program.call(ProgramMethod::Halt).ok(),
            _ => inner.program.ended(run, Ending::Failure).ok(),
        };
        inner.goal = None;
        inner.halting = None;
        if outcome.status != UNKNOWN {
            self.unknown.end(self.goal);
        }
        // Clients that see the state change can read the result.
        self.nodes.show_outcome(&outcome);
        if let Some(transition) = ended {
            self.nodes.show_transition(transition, &message);
        }
        self.state.send_replace(inner.program.state());
    }

    /// Cancels the goal. Returns when the cancellation has been sent, after a short wait for the
    /// end of the goal. A second Halt after [`HALT_TIMEOUT`], or when the action server has lost
    /// the goal, ends the run with an unknown outcome. A Program that is Ready becomes Halted.
    async fn halt(self: &Arc<Self>, questions: &Questions) -> Result<Vec<Variant>, CallFailure> {
        let (id, is_first) = {
            let mut inner = self.inner.lock();
            if inner.left || !(inner.starting || inner.program.is_executable(ProgramMethod::Halt)) {
                return Err(CallFailure::Status(StatusCode::BadInvalidState));
            }
            let Some(id) = inner.goal.clone() else {
                return self.called(&mut inner, ProgramMethod::Halt);
            };
            if inner.program.state() != ProgramMachineState::Running {
                let why = "halted before the action server has decided about the goal";
                self.runs(&mut inner, &id, (why, questions))?;
            }
            if let Some(halting) = &inner.halting
                && (halting.is_lost || halting.over <= Instant::now())
            {
                return self.give_up(&mut inner);
            }
            let is_first = inner.halting.is_none();
            inner.cancel();
            (id, is_first)
        };
        let answer = self.ask_to_cancel(&id, questions).await;
        if let Ok(REJECTED) = answer {
            self.refused(&mut self.inner.lock());
            return Err(CallFailure::Status(StatusCode::BadRequestNotAllowed));
        }
        if is_first && !matches!(answer, Ok(AGREED)) {
            let again = Arc::clone(self).cancel_until_ended(id, questions.clone());
            tokio::spawn(again);
        }
        answer?;
        let mut state = self.state.subscribe();
        let ends = timeout(
            AT_ONCE,
            state.wait_for(|now| *now != ProgramMachineState::Running),
        );
        if ends.await.is_err() {
            let mut inner = self.inner.lock();
            if inner
                .halting
                .as_ref()
                .is_some_and(|halting| !halting.is_lost)
            {
                self.pends(&mut inner, PENDING);
            }
        }
        Ok(Vec::new())
    }

    /// Ends a run although its goal continues or may continue elsewhere.
    fn give_up(&self, inner: &mut Inner) -> Result<Vec<Variant>, CallFailure> {
        let halting = inner.halting.take();
        let why = halting.map(|halting| halting.why).unwrap_or_default();
        let message = format!("the outcome is unknown, the goal may go on: {why}");
        warn!(program = self.name, "{message}");
        inner.goal = None;
        self.unknown.insert(self.goal);
        self.nodes.show_outcome(&GoalOutcome::lost(message));
        self.called(inner, ProgramMethod::Halt)
    }

    /// Sends a cancel request and returns the `return_code` of `action_msgs/CancelGoal`.
    async fn ask_to_cancel(
        &self,
        id: &ByteString,
        questions: &Questions,
    ) -> Result<i64, CallFailure> {
        let asked = [Variant::from(id.clone()), Variant::from(DateTime::null())];
        let answer = self.cancel.call(&asked, questions, || false).await?;
        let code = answer.first().and_then(whole);
        code.ok_or(CallFailure::Status(StatusCode::BadDecodingError))
    }

    fn reset(&self) -> Result<Vec<Variant>, CallFailure> {
        let mut inner = self.inner.lock();
        if inner.left || inner.starting {
            return Err(CallFailure::Status(StatusCode::BadInvalidState));
        }
        let reset = self.called(&mut inner, ProgramMethod::Reset)?;
        self.unknown.remove(self.goal);
        Ok(reset)
    }

    fn called(
        &self,
        inner: &mut Inner,
        method: ProgramMethod,
    ) -> Result<Vec<Variant>, CallFailure> {
        let transition = inner.program.call(method);
        let transition =
            transition.map_err(|_| CallFailure::Status(StatusCode::BadInvalidState))?;
        self.nodes.show_transition(transition, "");
        self.state.send_replace(inner.program.state());
        Ok(Vec::new())
    }

    /// Ends the Program because of `why`. The outcome of an open goal is unknown.
    pub(super) fn leave(&self, why: &str) {
        let mut inner = self.inner.lock();
        inner.left = true;
        let is_open = inner.goal.take().is_some();
        if is_open {
            warn!(program = self.name, "{why}");
            self.unknown.insert(self.goal);
        }
        inner.halting = None;
        let run = inner.program.run();
        let ended = run.and_then(|run| inner.program.ended(run, Ending::Failure).ok());
        if let Some(transition) = ended {
            let outcome = GoalOutcome::lost(why.to_owned());
            self.nodes.show_outcome(&outcome);
            self.nodes.show_transition(transition, why);
        }
        self.state.send_replace(ProgramMachineState::Halted);
    }

    /// Shows feedback of the current goal.
    pub(super) fn reported(&self, block: &[u8]) {
        let Ok(fields) = Fields::parse(block) else {
            return;
        };
        let fields = fields.map(|field| field.map(|field| value::from_field(&field)));
        let Ok(fields) = fields.collect::<Result<Vec<Variant>, _>>() else {
            return;
        };
        let inner = self.inner.lock();
        if let Some((Variant::ByteString(id), rest)) = fields.split_first()
            && inner.goal.as_ref() == Some(id)
        {
            self.nodes.show_feedback(rest);
        }
    }
}

/// Returns true if the goal may be executed nevertheless.
fn is_unknown(refused: &CallFailure) -> bool {
    matches!(refused, CallFailure::Asked(error) if error.kind == AskErrorKind::Unknown)
}

/// Converts argument errors to the arguments of Start, which exclude the goal id.
fn in_terms_of_start(refused: CallFailure) -> CallFailure {
    match refused {
        CallFailure::Arguments(mut statuses) => {
            statuses.drain(..statuses.len().min(1));
            CallFailure::Arguments(statuses)
        }
        CallFailure::Status(_) | CallFailure::Asked(_) => refused,
    }
}

const NOT_NOW_AND_NEVER: CallFailure = CallFailure::Status(StatusCode::BadNotSupported);
const PENDING: &str = "cancellation pending: the goal has not ended";
pub(super) const GONE: &str =
    "the executor of the action is lost: the outcome is unknown, the goal may go on";
const BEFORE_RESTART: &str =
    "the outcome of the last goal before the restart is unknown, the goal may go on";
pub(super) const ENDS: &str = "the server ends: the outcome is unknown, the goal may go on";
const UNKNOWN: i64 = 0;
/// ERROR_NONE and ERROR_REJECTED of `action_msgs/CancelGoal`.
const AGREED: i64 = 0;
const REJECTED: i64 = 1;
/// Time that Halt waits for the end of the goal before it reports a pending cancellation.
const AT_ONCE: Duration = Duration::from_secs(1);
/// Time that a cancelled goal has to end before a second Halt ends the run with an unknown outcome.
const HALT_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause before the result is requested again, doubling from the first to the last.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LAST_PAUSE: Duration = Duration::from_secs(1);
