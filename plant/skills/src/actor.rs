//! The task that owns a skill. It processes calls and the end of the work sequentially.

use std::any::Any;
use std::collections::VecDeque;
use std::fmt;
use std::future::pending;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use log_limit::LogLimit;
use program::{Ending, Method, Nature, Program, Refused, RunId, State, Transition};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, info, warn};

use crate::authority::{Authority, Owner};
use crate::driver::{Driver, Line, Reins, Results, Signal, Work};
use crate::driver_error::DriverError;
use crate::parameters::Parameters;
use crate::refusal::{Code, Refusal};
use crate::shown::{Diagnostic, LastCall, Observer, Outcome, Shown, Told, Transitioned};
use crate::skill::{Facts, Pending, lock};
use crate::value::Value;

/// A message to the task.
#[derive(Debug)]
pub(crate) enum Order {
    Call(Call),
    /// Closes the component: a run in progress is halted, regardless of the holder of the lease.
    Close(oneshot::Sender<()>),
}

/// A call of a method, waiting for the task.
#[derive(Debug)]
pub(crate) struct Call {
    pub(crate) by: Owner,
    pub(crate) method: Method,
    pub(crate) given: Given,
    pub(crate) reply: oneshot::Sender<Result<u32, Refusal>>,
}

/// The arguments of a Start call.
#[derive(Debug, Default)]
pub(crate) struct Given {
    /// The parameters; `None` uses the parameters that the caller wrote before.
    pub(crate) parameters: Option<Vec<(String, Value)>>,
    /// Time limit of the run. It applies if it is shorter than the limit of the skill.
    pub(crate) within: Option<Duration>,
    /// Whether a Halted skill is reset first.
    pub(crate) readies: bool,
}

/// The driver and the time limit of the next runs.
pub(crate) struct Successor {
    pub(crate) driver: Arc<dyn Driver>,
    pub(crate) timeout: Option<Duration>,
}

impl fmt::Debug for Successor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = f.debug_struct("Successor");
        shown
            .field("timeout", &self.timeout)
            .finish_non_exhaustive()
    }
}

pub(crate) struct Actor {
    facts: Arc<Facts>,
    driver: Arc<dyn Driver>,
    /// Time limit of a run.
    timeout: Option<Duration>,
    successor: Arc<Mutex<Option<Successor>>>,
    authority: Authority,
    pending: Arc<Mutex<Pending>>,
    outcomes: Arc<Mutex<VecDeque<Arc<Outcome>>>>,
    observers: Vec<Box<dyn Observer>>,
    program: Program,
    shown: watch::Sender<Arc<Shown>>,
    now: Shown,
    work: Option<Running>,
    /// Trace lines of the current run.
    trace: Vec<String>,
    /// Rate limit of log messages about refused calls, so that a client that retries in a loop
    /// cannot flood the log.
    refusals: LogLimit,
}

/// The work of a run, kept until the work has ended.
struct Running {
    run: RunId,
    task: JoinHandle<Result<Results, DriverError>>,
    reins: Reins,
    /// Time limit of the run.
    within: Option<Duration>,
    began: Instant,
    /// Time at which the run times out, while it is Running and has a limit.
    deadline: Option<Instant>,
    /// Remaining time of the run, measured when it was suspended.
    left: Option<Duration>,
    /// Result of work that ended while the run was suspended. It is applied when the run is
    /// resumed.
    ended: Option<Result<Results, RunFailure>>,
    /// Set after a stop request to work that is done elsewhere, until that work ends.
    halting: Option<Halting>,
    /// Reason why the end of the work is unknown. The end may never become known.
    unknown: Option<String>,
}

/// State of a run that is done elsewhere between the stop request and the end of its work.
struct Halting {
    /// Reason of the stop, as text for the outcome.
    message: String,
    then: Then,
    /// From this time on, a second Halt ends the run with an unknown outcome.
    over: Instant,
}

/// The transition after the end of a stopped run.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Then {
    /// To Halted, regardless of the result.
    Halt,
    /// The usual transition at the end of a run. The run fails if its work is not done.
    End,
}

type Store = (Arc<Mutex<Pending>>, Arc<Mutex<VecDeque<Arc<Outcome>>>>);

impl Actor {
    pub(crate) fn new(
        (facts, driver): (Arc<Facts>, Arc<dyn Driver>),
        authority: Authority,
        (pending, outcomes): Store,
        (observers, first_run): (Vec<Box<dyn Observer>>, u32),
        successor: Arc<Mutex<Option<Successor>>>,
    ) -> (Self, watch::Receiver<Arc<Shown>>) {
        let nature = Nature {
            can_suspend: driver.can_suspend(),
            rests_in: facts.rests_in,
        };
        let program = Program::counting_from(nature, first_run);
        let created = clock();
        let now = Shown {
            state: program.state(),
            last: None,
            since: created,
            run: 0,
            progress: 0.0,
            step: String::new(),
            parameters: Arc::default(),
            outcome: None,
            pending: None,
            needs_reset: false,
            diagnostic: Diagnostic {
                created,
                last_call: None,
            },
            executable: Method::ALL.map(|method| program.is_executable(method)),
        };
        let (shown, watched) = watch::channel(Arc::new(now.clone()));
        let actor = Self {
            timeout: facts.timeout,
            facts,
            driver,
            successor,
            authority,
            pending,
            outcomes,
            observers,
            program,
            shown,
            now,
            work: None,
            trace: Vec::new(),
            refusals: LogLimit::every(TOLD_EVERY),
        };
        (actor, watched)
    }

    pub(crate) async fn run(mut self, mut orders: mpsc::Receiver<Order>) {
        loop {
            let happened = tokio::select! {
                order = orders.recv() => match order {
                    Some(Order::Call(call)) => Happened::Call(call),
                    Some(Order::Close(closed)) => {
                        self.close().await;
                        // The caller of the close may not wait for the reply.
                        let _told = closed.send(());
                        return;
                    }
                    None => break,
                },
                happened = happens(&mut self.work) => happened,
            };
            match happened {
                Happened::Call(call) => self.obey(call).await,
                Happened::Line(line) => self.line(line),
                Happened::Progress(done) => self.progress(done),
                Happened::Ended(result) => self.settle(result),
                Happened::Late => self.late().await,
            }
        }
        // All handles are dropped: the machine is stopped.
        self.close().await;
    }

    async fn close(&mut self) {
        if !self.program.is_executable(Method::Halt) {
            return;
        }
        if let Err(refusal) = self.halt("the end of the component").await {
            warn!(skill = self.facts.name, "{refusal}");
        }
        if self.is_halting().is_none() {
            return;
        }
        // The run loop of the component forwards the requests to other components meanwhile.
        let ended = timeout(PENDING_AT_END, async {
            while self.work.is_some() {
                match happens(&mut self.work).await {
                    Happened::Line(line) => self.line(line),
                    Happened::Ended(result) => self.settle(result),
                    Happened::Call(_) | Happened::Progress(_) | Happened::Late => {}
                }
            }
        });
        if ended.await.is_err() {
            let run = self.now.run;
            let why = self.now.pending.clone().unwrap_or_default();
            warn!(
                skill = self.facts.name,
                run,
                why,
                "the component stops with a pending cancellation: the outcome of the run is unknown; check the machine"
            );
            self.give_up("the end of the component");
        }
    }

    async fn obey(&mut self, call: Call) {
        let Call {
            by,
            method,
            given,
            reply,
        } = call;
        let answer = self.call(&by, method, given).await;
        self.authority.settle();
        self.now.diagnostic.last_call = Some(LastCall {
            method,
            by: by.clone(),
            at: clock(),
            refused: answer.as_ref().err().cloned(),
        });
        self.tell(Told::Called);
        if let Err(refusal) = &answer
            && let Some(untold) = self.refusals.admit("", Instant::now().into_std())
        {
            info!(
                skill = self.facts.name,
                untold, "{method} by {by} is refused: {refusal}"
            );
        }
        // The caller may have gone; the call has taken effect.
        let _told = reply.send(answer);
    }

    async fn call(&mut self, by: &Owner, method: Method, given: Given) -> Result<u32, Refusal> {
        self.authority.claim(by)?;
        // The state is checked before the capability: a skill without Suspend refuses it with
        // BadNotSupported only while it is Running.
        let is_running = self.program.state() == State::Running;
        let is_its_capability = method == Method::Suspend && is_running;
        let is_made_ready = given.readies && self.program.state() == State::Halted;
        if is_made_ready && self.now.needs_reset {
            return Err(unknown_outcome(self.now.run));
        }
        if !self.program.is_executable(method) && !is_its_capability && !is_made_ready {
            return Err(not_now(method, self.program.state()));
        }
        match method {
            Method::Start => self.start(by, given).await?,
            Method::Halt => self.halt(&by.to_string()).await?,
            Method::Reset => self.reset(by).await?,
            Method::Suspend => {
                self.take(Method::Suspend, &format!("suspended by {by}"))?;
                self.signal(Signal::StandStill);
                if let Some(work) = &mut self.work {
                    let deadline = work.deadline.take();
                    work.left =
                        deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
                }
            }
            Method::Resume => {
                self.take(Method::Resume, &format!("resumed by {by}"))?;
                self.signal(Signal::Go);
                if let Some(work) = &mut self.work {
                    work.deadline = work.left.take().map(|left| Instant::now() + left);
                }
                let ended = self.work.as_mut().and_then(|work| work.ended.take());
                if let Some(result) = ended {
                    self.settle(result);
                }
            }
        }
        Ok(self.now.run)
    }

    async fn start(&mut self, by: &Owner, given: Given) -> Result<(), Refusal> {
        let is_halted = self.program.state() == State::Halted;
        if let Some(work) = &self.work
            && !(is_halted && work.task.is_finished())
        {
            return Err(still_at_work(work.run));
        }
        self.adopt_successor();
        let within = [given.within, self.timeout].into_iter().flatten().min();
        let given = given
            .parameters
            .unwrap_or_else(|| lock(&self.pending).given(by));
        let prepared = self.driver.prepared(&self.facts.parameters, given.clone());
        let parameters = Parameters::complete(&self.facts.parameters, prepared)?;
        self.driver
            .check(&parameters)
            .map_err(|why| Refusal::new(Code::InvalidArgument, why.to_string()))?;
        self.authority.begin(&self.facts.name)?;
        let begun = self.begin(by, is_halted).await;
        let (transition, run) = begun.inspect_err(|_| self.authority.end(&self.facts.name))?;
        self.trace.clear();
        // The configuration may differ at the next run.
        lock(&self.pending).kept(by, &given);
        self.now.parameters = Arc::new(parameters.clone());
        self.now.run = run.number();
        self.now.progress = 0.0;
        self.now.step.clear();
        self.tell(Told::Parameters(&parameters));
        self.transition(
            transition,
            format!("run {} is started by {by}", run.number()),
        );
        // The work starts after the transition is published, so that observers see the start of a
        // run before its end, even if the driver finishes immediately.
        let (work, reins) = Work::new(run.number(), parameters);
        let driver = Arc::clone(&self.driver);
        self.work = Some(Running {
            run,
            task: tokio::spawn(async move { driver.run(work).await }),
            reins,
            within,
            began: Instant::now(),
            deadline: within.map(|within| Instant::now() + within),
            left: None,
            ended: None,
            halting: None,
            unknown: None,
        });
        Ok(())
    }

    /// Adopts a replaced driver. Called while there is no work.
    fn adopt_successor(&mut self) {
        if let Some(Successor { driver, timeout }) = lock(&self.successor).take() {
            self.program.set_can_suspend(driver.can_suspend());
            self.driver = driver;
            self.timeout = timeout;
        }
    }

    /// Performs the transition to Running, from Halted by way of Ready.
    async fn begin(
        &mut self,
        by: &Owner,
        is_halted: bool,
    ) -> Result<(&'static Transition, RunId), Refusal> {
        if is_halted {
            self.reset(by).await?;
        }
        let transition = self.program.call(Method::Start).map_err(refusal)?;
        let run = self.program.run();
        let run = run.ok_or_else(|| not_now(Method::Start, self.program.state()))?;
        Ok((transition, run))
    }

    async fn halt(&mut self, by: &str) -> Result<(), Refusal> {
        let goes_on = matches!(self.program.state(), State::Running | State::Suspended);
        let mut message = format!("halted by {by}");
        if goes_on {
            if let Some(over) = self.is_halting() {
                if over {
                    self.give_up(&message);
                }
                // The work is being cancelled already.
                return Ok(());
            }
            match self.stop_work().await {
                Stop::Pending => {
                    self.await_end(message, Then::Halt);
                    return Ok(());
                }
                Stop::Refused(why) => return Err(Refusal::new(Code::RequestNotAllowed, why)),
                // The work finished before it could be stopped.
                Stop::Done(result) if self.program.state() == State::Running => {
                    self.settle(Ok(result))
                }
                Stop::Done(_) | Stop::Stopped => {}
                Stop::BrokenOff(how) => message = format!("{message}; {how}"),
            }
            if self.program.state() != State::Ready {
                self.end_without_work(message.clone());
            }
        }
        self.take(Method::Halt, &message)
    }

    async fn reset(&mut self, by: &Owner) -> Result<(), Refusal> {
        if self.program.state() == State::Suspended {
            // Cancels the suspended work.
            let mut message = format!("reset by {by} while it was suspended");
            if let Stop::BrokenOff(how) = self.stop_work().await {
                message = format!("{message}; {how}");
            }
            if self.work.is_none() {
                self.end_without_work(message.clone());
                if self.now.needs_reset {
                    self.take(Method::Halt, &message)?;
                    return Err(unknown_outcome(self.now.run));
                }
            }
        }
        if let Some(work) = &mut self.work {
            if !work.task.is_finished() {
                return Err(still_at_work(work.run));
            }
            self.work = None;
        }
        self.take(Method::Reset, &format!("reset by {by}"))
    }

    /// Handles a run that exceeded its time limit.
    async fn late(&mut self) {
        let within = self.work.as_ref().and_then(|work| work.within);
        let within = within.unwrap_or_default();
        if let Some(work) = &mut self.work {
            work.deadline = None;
        }
        let message = format!("the work was not done within {within:?}");
        match self.stop_work().await {
            Stop::Done(result) => self.settle(Ok(result)),
            Stop::Pending | Stop::Refused(_) => self.await_end(message, Then::End),
            Stop::Stopped => self.fail_without_work(message),
            Stop::BrokenOff(how) => self.fail_without_work(format!("{message}; {how}")),
        }
    }

    /// Stops the work and waits up to [`TIME_TO_STOP`] for its end; then the work is aborted.
    async fn stop_work(&mut self) -> Stop {
        self.signal(Signal::Stop);
        let Some(work) = &mut self.work else {
            return Stop::Stopped;
        };
        if let Some(ended) = work.ended.take() {
            self.work = None;
            return ended.map_or(Stop::Stopped, Stop::Done);
        }
        if self.driver.halt_timeout().is_some() {
            return self.stop_elsewhere().await;
        }
        if let Ok(ended) = timeout(TIME_TO_STOP, &mut work.task).await {
            let ended = outcome_of(ended, &mut work.unknown);
            return match (self.end_stopped(), ended) {
                (_, Ok(results)) => Stop::Done(results),
                (true, Err(why)) => Stop::BrokenOff(why.to_string()),
                (false, Err(_)) => Stop::Stopped,
            };
        }
        work.task.abort();
        let ended = timeout(TIME_TO_BREAK_OFF, &mut work.task).await;
        let how = format!(
            "the outcome is unknown: its work did not stop within {TIME_TO_STOP:?} and was broken off"
        );
        warn!(skill = self.facts.name, "run {}: {how}", work.run.number());
        if ended.is_ok() {
            self.end_stopped();
        }
        // A dropped future does not stop the machine.
        self.now.needs_reset = true;
        Stop::BrokenOff(how)
    }

    /// Removes stopped work that has ended. Returns whether its end is unknown; the skill then
    /// needs a Reset.
    fn end_stopped(&mut self) -> bool {
        self.take_steps();
        let work = self.work.take();
        let is_unknown = work.is_some_and(|work| work.unknown.is_some());
        self.now.needs_reset |= is_unknown;
        is_unknown
    }

    /// Waits up to [`TIME_TO_STOP`] for the end of work that is done elsewhere. Such work is never
    /// aborted.
    async fn stop_elsewhere(&mut self) -> Stop {
        let until = Instant::now() + TIME_TO_STOP;
        loop {
            let Some(work) = &mut self.work else {
                return Stop::Stopped;
            };
            let happened = tokio::select! {
                biased;
                Some(line) = work.reins.steps.recv() => Happened::Line(line),
                ended = &mut work.task => Happened::Ended(outcome_of(ended, &mut work.unknown)),
                () = sleep_until(until) => return Stop::Pending,
            };
            match happened {
                Happened::Line(line) => {
                    let refused = match &line {
                        Line::Refused(why) => Some(why.clone()),
                        Line::Step(_) | Line::Note(_) | Line::Pending(_) | Line::Unknown(_) => None,
                    };
                    self.line(line);
                    if let Some(why) = refused {
                        return Stop::Refused(why);
                    }
                }
                Happened::Ended(ended) => {
                    self.end_stopped();
                    return match ended {
                        Ok(results) => Stop::Done(results),
                        Err(RunFailure::Driver(DriverError::Stopped)) => Stop::Stopped,
                        Err(why) => Stop::BrokenOff(why.to_string()),
                    };
                }
                Happened::Call(_) | Happened::Progress(_) | Happened::Late => {}
            }
        }
    }

    /// Keeps the run going until the end of its work is known.
    fn await_end(&mut self, message: String, then: Then) {
        let limit = self.driver.halt_timeout().unwrap_or_default();
        let Some(work) = &mut self.work else {
            return;
        };
        work.halting = Some(Halting {
            message: message.clone(),
            then,
            over: Instant::now() + limit,
        });
        let why = self.now.pending.clone();
        let why = why.unwrap_or_else(|| "cancellation pending: the work has not ended".to_owned());
        info!(
            skill = self.facts.name,
            run = self.now.run,
            "{message}; {why}"
        );
        self.pends(why);
    }

    /// Returns `None` if the run is not being stopped, otherwise whether the next Halt ends it with
    /// an unknown outcome.
    fn is_halting(&self) -> Option<bool> {
        let work = self.work.as_ref()?;
        let halting = work.halting.as_ref()?;
        Some(work.unknown.is_some() || halting.over <= Instant::now())
    }

    /// Ends a run while its work goes on elsewhere, or may go on. The outcome is unknown.
    fn give_up(&mut self, message: &str) {
        let Some(work) = self.work.take() else {
            return;
        };
        work.task.abort();
        let why = work.unknown.or_else(|| self.now.pending.clone());
        let why = why.unwrap_or_else(|| "the work has not ended".to_owned());
        let message = format!("{message}; the outcome is unknown: {why}");
        warn!(skill = self.facts.name, run = self.now.run, "{message}");
        self.now.needs_reset = true;
        self.end_without_work(message.clone());
        if let Err(refusal) = self.take(Method::Halt, &message) {
            warn!(skill = self.facts.name, "{refusal}");
        }
    }

    /// Publishes the reason why a stopped run has not ended.
    fn pends(&mut self, why: String) {
        self.now.step.clone_from(&why);
        self.now.pending = Some(why.clone());
        self.tell(Told::Pending(&why));
    }

    /// Handles the end of the work of a run that was asked to stop.
    fn settle_halted(&mut self, halting: Halting, result: Result<Results, RunFailure>) {
        let Halting { message, then, .. } = halting;
        match (result, then) {
            (Ok(results), then) => {
                self.finish(Ok(results));
                if then == Then::Halt
                    && self.program.state() == State::Ready
                    && let Err(refusal) = self.take(Method::Halt, &message)
                {
                    warn!(skill = self.facts.name, "{refusal}");
                }
            }
            (Err(why), Then::End) => self.finish(Err(why.after(message))),
            (Err(why), Then::Halt) => {
                let message = why.after(message).to_string();
                self.take_steps();
                self.work = None;
                self.end_without_work(message.clone());
                if let Err(refusal) = self.take(Method::Halt, &message) {
                    warn!(skill = self.facts.name, "{refusal}");
                }
            }
        }
    }

    /// Handles the end of work that was not asked to stop.
    fn settle(&mut self, result: Result<Results, RunFailure>) {
        self.take_steps();
        let work = self.work.as_mut();
        if work.as_ref().is_some_and(|work| work.unknown.is_some()) {
            self.now.needs_reset = true;
        }
        if let Some(halting) = work.and_then(|work| work.halting.take()) {
            return self.settle_halted(halting, result);
        }
        match (self.program.state(), &result) {
            (State::Running, _) | (State::Suspended, Err(_)) => self.finish(result),
            (State::Suspended, Ok(_)) => {
                if let Some(work) = &mut self.work {
                    work.ended = Some(result);
                }
            }
            // The run was halted, but its task could not be aborted then.
            (State::Halted | State::Ready, _) => self.work = None,
        }
    }

    fn finish(&mut self, result: Result<Results, RunFailure>) {
        self.work = None;
        let Some(run) = self.program.run() else {
            return;
        };
        let ending = if result.is_ok() {
            Ending::Success
        } else {
            Ending::Failure
        };
        let message = match &result {
            Ok(_) => format!("run {} is done", run.number()),
            Err(why) => why.to_string(),
        };
        if result.is_ok() {
            self.now.progress = 1.0;
        }
        let outcome = Outcome {
            run: run.number(),
            succeeded: result.is_ok(),
            unknown: result.is_err() && self.now.needs_reset,
            message: if result.is_ok() {
                String::new()
            } else {
                message.clone()
            },
            results: self.in_order(result.unwrap_or_default()),
            trace: std::mem::take(&mut self.trace),
        };
        self.keep(outcome);
        match self.program.ended(run, ending) {
            Ok(transition) => self.transition(transition, message),
            Err(fault) => warn!(skill = self.facts.name, "{fault}"),
        }
    }

    /// Fails a run after its work was stopped.
    fn fail_without_work(&mut self, message: String) {
        let run = self.program.run();
        self.end_without_work(message.clone());
        let ended = run.and_then(|run| self.program.ended(run, Ending::Failure).ok());
        if let Some(transition) = ended {
            self.transition(transition, message);
        }
    }

    /// Records the outcome of a run after its work was stopped. The caller performs the transition.
    fn end_without_work(&mut self, message: String) {
        let Some(run) = self.program.run() else {
            return;
        };
        let outcome = Outcome {
            run: run.number(),
            succeeded: false,
            unknown: self.now.needs_reset,
            message,
            results: Vec::new(),
            trace: std::mem::take(&mut self.trace),
        };
        self.keep(outcome);
    }

    fn keep(&mut self, outcome: Outcome) {
        let outcome = Arc::new(outcome);
        let mut outcomes = lock(&self.outcomes);
        if outcomes.len() >= MOST_OUTCOMES {
            outcomes.pop_front();
        }
        outcomes.push_back(Arc::clone(&outcome));
        drop(outcomes);
        self.now.outcome = Some(Arc::clone(&outcome));
        self.tell(Told::Outcome(&outcome));
    }

    /// Returns the results that the type declares, in the order of the type.
    fn in_order(&self, results: Results) -> Results {
        let mut ordered = Vec::new();
        for declared in &self.facts.results {
            let found = results.iter().find(|(name, _)| *name == declared.name);
            let fits = found.and_then(|(_, value)| declared.shape.take(value.clone()));
            match fits {
                Some(value) => ordered.push((declared.name.clone(), value)),
                None => debug!(
                    skill = self.facts.name,
                    "the driver gave no {}", declared.name
                ),
            }
        }
        ordered
    }

    fn take(&mut self, method: Method, message: &str) -> Result<(), Refusal> {
        let transition = self.program.call(method).map_err(refusal)?;
        self.transition(transition, message.to_owned());
        Ok(())
    }

    fn transition(&mut self, transition: &'static Transition, message: String) {
        let at = clock();
        self.now.state = transition.to;
        self.now.last = Some(transition);
        self.now.since = at;
        self.now.executable = Method::ALL.map(|method| self.program.is_executable(method));
        if matches!(transition.to, State::Halted | State::Ready) {
            self.now.step.clear();
            self.now.pending = None;
        }
        if transition.to == State::Ready {
            self.now.needs_reset = false;
        }
        if matches!(transition.from, State::Running | State::Suspended)
            && !matches!(transition.to, State::Running | State::Suspended)
        {
            self.authority.end(&self.facts.name);
        }
        debug!(skill = self.facts.name, "{}: {message}", transition.name);
        self.tell(Told::Transition(&Transitioned {
            transition,
            run: self.now.run,
            message,
            at,
        }));
    }

    fn line(&mut self, line: Line) {
        let text = match &line {
            Line::Step(text)
            | Line::Note(text)
            | Line::Pending(text)
            | Line::Refused(text)
            | Line::Unknown(text) => text,
        };
        if let Some(work) = &self.work
            && self.trace.len() < MOST_TRACED
        {
            let text: String = text.chars().take(LONGEST_TRACED).collect();
            let seconds = work.began.elapsed().as_secs_f64();
            self.trace.push(format!("{seconds:.3} {text}"));
        }
        match line {
            Line::Step(step) => {
                self.now.step = step;
                self.tell(Told::Step);
            }
            Line::Note(_) => {}
            Line::Pending(why) => self.pends(why),
            Line::Refused(why) | Line::Unknown(why) if self.now.pending.as_ref() == Some(&why) => {}
            Line::Refused(why) => {
                warn!(skill = self.facts.name, run = self.now.run, "{why}");
                if let Some(work) = &mut self.work {
                    work.halting = None;
                }
                self.pends(why);
            }
            Line::Unknown(why) => {
                warn!(skill = self.facts.name, run = self.now.run, "{why}");
                if let Some(work) = &mut self.work {
                    work.unknown = Some(why.clone());
                }
                self.pends(why);
            }
        }
    }

    fn progress(&mut self, done: f32) {
        self.now.progress = done;
        self.tell(Told::Progress);
    }

    /// Processes steps that were reported before the work ended.
    fn take_steps(&mut self) {
        let mut lines = Vec::new();
        if let Some(work) = &mut self.work {
            while let Ok(line) = work.reins.steps.try_recv() {
                lines.push(line);
            }
        }
        for line in lines {
            self.line(line);
        }
    }

    fn signal(&self, signal: Signal) {
        if let Some(work) = &self.work {
            work.reins.signal.send_replace(signal);
        }
    }

    fn tell(&self, what: Told<'_>) {
        for observer in &self.observers {
            observer.told(what, &self.now);
        }
        self.shown.send_replace(Arc::new(self.now.clone()));
    }
}

enum Happened {
    Call(Call),
    Line(Line),
    Progress(f32),
    Ended(Result<Results, RunFailure>),
    Late,
}

/// The reaction of work to a stop request.
enum Stop {
    /// The work finished.
    Done(Results),
    /// The work stopped.
    Stopped,
    /// The work ended with a reason, or did not stop and was aborted.
    BrokenOff(String),
    /// The work is done elsewhere, and its end is not known yet.
    Pending,
    /// The executor of the work refuses to cancel it.
    Refused(String),
}

/// The reason why a run has no results.
#[derive(Debug, thiserror::Error)]
enum RunFailure {
    #[error(transparent)]
    Driver(#[from] DriverError),
    /// The driver panicked and has not stopped its machine.
    #[error("the driver broke down: {panic}; the outcome is unknown, check the machine")]
    Panicked { panic: String },
    /// The task of the driver was aborted.
    #[error("the work was broken off; the outcome is unknown, check the machine")]
    Aborted,
    /// The run was stopped, and its work gave this reason.
    #[error("{message}; {why}")]
    AfterStop { message: String, why: Box<Self> },
    /// The run was stopped, and its work had nothing to add.
    #[error("{0}")]
    Stopped(String),
}

impl RunFailure {
    /// Returns the failure of a run that was stopped with this message.
    fn after(self, message: String) -> Self {
        match self {
            Self::Driver(DriverError::Stopped) => Self::Stopped(message),
            why @ (Self::Driver(_)
            | Self::Panicked { .. }
            | Self::Aborted
            | Self::AfterStop { .. }
            | Self::Stopped(_)) => Self::AfterStop {
                message,
                why: Box::new(why),
            },
        }
    }
}

/// Returns the next event of the work. Pends while there is no work.
async fn happens(work: &mut Option<Running>) -> Happened {
    let Some(Running {
        task,
        reins,
        deadline,
        ended,
        unknown,
        ..
    }) = work
    else {
        return pending().await;
    };
    if ended.is_some() {
        return pending().await;
    }
    let late = async {
        match deadline {
            Some(deadline) => sleep_until(*deadline).await,
            None => pending().await,
        }
    };
    tokio::select! {
        biased;
        Some(line) = reins.steps.recv() => Happened::Line(line),
        ended = task => Happened::Ended(outcome_of(ended, unknown)),
        Ok(()) = reins.progress.changed() => Happened::Progress(*reins.progress.borrow_and_update()),
        () = late => Happened::Late,
    }
}

/// Returns the result of ended work. A driver that panicked has not stopped its machine: `unknown`
/// then receives the reason.
fn outcome_of(
    ended: Result<Result<Results, DriverError>, JoinError>,
    unknown: &mut Option<String>,
) -> Result<Results, RunFailure> {
    let error = match ended {
        Ok(result) => return result.map_err(RunFailure::Driver),
        Err(error) => error,
    };
    let why = match error.try_into_panic() {
        Ok(panic) => RunFailure::Panicked {
            panic: text_of(&*panic).to_owned(),
        },
        Err(_) => RunFailure::Aborted,
    };
    unknown.get_or_insert_with(|| why.to_string());
    Err(why)
}

fn text_of(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    text.or_else(|| panic.downcast_ref::<&str>().copied())
        .unwrap_or("no reason given")
}

#[expect(
    clippy::disallowed_methods,
    reason = "when a machine did something is told by the clock of its host"
)]
fn clock() -> SystemTime {
    SystemTime::now()
}

fn not_now(method: Method, state: State) -> Refusal {
    refusal(Refused::State { method, state })
}

fn refusal(refused: Refused) -> Refusal {
    let code = if refused == Refused::CannotSuspend {
        Code::NotSupported
    } else {
        Code::InvalidState
    };
    Refusal::new(code, refused.to_string())
}

fn unknown_outcome(run: u32) -> Refusal {
    let text = format!("the outcome of run {run} is unknown; Reset makes the skill ready");
    Refusal::new(Code::InvalidState, text)
}

fn still_at_work(run: RunId) -> Refusal {
    let text = format!("the work of run {} has not come to an end", run.number());
    Refusal::new(Code::InvalidState, text)
}

/// Time that the work has to end after it was stopped.
const TIME_TO_STOP: Duration = Duration::from_secs(1);
/// Time that the aborted future has to be dropped; a future that blocks its thread takes longer.
const TIME_TO_BREAK_OFF: Duration = Duration::from_millis(100);
/// Maximum number of trace lines of a run, and the maximum length of each in characters.
const MOST_TRACED: usize = 256;
const LONGEST_TRACED: usize = 240;
/// Interval in which one refused call of a skill is logged, with the number of suppressed messages.
const TOLD_EVERY: Duration = Duration::from_secs(1);
/// Time that a closing component waits for the end of work that it has cancelled elsewhere.
const PENDING_AT_END: Duration = Duration::from_millis(4_500);
/// Number of outcomes that are kept.
const MOST_OUTCOMES: usize = 64;
