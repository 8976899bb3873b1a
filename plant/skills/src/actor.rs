//! The task that owns a skill. It processes calls and the end of the work sequentially.

mod history;
mod order;
mod refused;
mod work;

use std::sync::{Arc, Mutex};
use std::time::Duration;

use log_limit::LogLimit;
use program::{
    Ending, Nature, ProgramInstance, ProgramMachineState, ProgramMethod, RunId, Transition,
};
use tokio::sync::{mpsc, watch};
use tokio::time::{Instant, sleep_until, timeout};
use tracing::{debug, info, warn};

use self::history::SkillHistory;
pub(crate) use self::order::{Given, Order, SkillCallRequest, Successor};
use self::refused::{not_now, refusal, still_at_work, unknown_outcome};
use self::work::{
    Halting, RunFailure, Running, Started, Stop, Then, WorkEvent, happens, outcome_of,
};
use crate::authority::{Authority, SkillOwner};
use crate::description::SkillDescription;
use crate::driver::{Driver, Line, RunResults, Signal, Work};
use crate::driver_error::DriverError;
use crate::lock::lock;
use crate::outcomes::NewestOutcomes;
use crate::parameters::Parameters;
use crate::pending::PendingParameters;
use crate::refusal::{RefusalCode, SkillRefusal};
use crate::shown::{
    LastCall, RunOutcome, SkillEvent, SkillObserver, SkillSnapshot, Transitioned, clock, is_work,
};

pub(crate) struct Actor {
    facts: Arc<SkillDescription>,
    driver: Arc<dyn Driver>,
    /// Time limit of a run.
    timeout: Option<Duration>,
    successor: Arc<Mutex<Option<Successor>>>,
    authority: Authority,
    pending: Arc<Mutex<PendingParameters>>,
    history: SkillHistory,
    observers: Vec<Box<dyn SkillObserver>>,
    program: ProgramInstance,
    shown: watch::Sender<Arc<SkillSnapshot>>,
    now: SkillSnapshot,
    work: Option<Running>,
    /// Rate limit of log messages about refused calls, so that a client that retries in a loop
    /// cannot flood the log.
    refusals: LogLimit,
}

impl Actor {
    pub(crate) fn new(
        (facts, driver): (Arc<SkillDescription>, Arc<dyn Driver>),
        authority: Authority,
        (pending, outcomes): (Arc<Mutex<PendingParameters>>, NewestOutcomes),
        (observers, first_run): (Vec<Box<dyn SkillObserver>>, u32),
        successor: Arc<Mutex<Option<Successor>>>,
    ) -> (Self, watch::Receiver<Arc<SkillSnapshot>>) {
        let nature = Nature {
            can_suspend: driver.can_suspend(),
            rests_in: facts.rests_in,
        };
        let program = ProgramInstance::counting_from(nature, first_run);
        let now = SkillSnapshot::first(program.state(), executable(&program), clock());
        let (shown, watched) = watch::channel(Arc::new(now.clone()));
        let actor = Self {
            timeout: facts.timeout,
            facts,
            driver,
            successor,
            authority,
            pending,
            history: SkillHistory::new(outcomes),
            observers,
            program,
            shown,
            now,
            work: None,
            refusals: LogLimit::every(TOLD_EVERY),
        };
        (actor, watched)
    }

    pub(crate) async fn run(mut self, mut orders: mpsc::Receiver<Order>) {
        loop {
            let happened = tokio::select! {
                order = orders.recv() => match order {
                    Some(Order::Call(call)) => WorkEvent::Call(call),
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
                WorkEvent::Call(call) => self.obey(call).await,
                WorkEvent::Line(line) => self.line(line),
                WorkEvent::Progress(done) => self.progress(done),
                WorkEvent::Ended(result) => self.settle(result),
                WorkEvent::Late => self.late().await,
            }
        }
        // All handles are dropped: the machine is stopped.
        self.close().await;
    }

    async fn close(&mut self) {
        if !self.program.is_executable(ProgramMethod::Halt) {
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
                    WorkEvent::Line(line) => self.line(line),
                    WorkEvent::Ended(result) => self.settle(result),
                    WorkEvent::Call(_) | WorkEvent::Progress(_) | WorkEvent::Late => {}
                }
            }
        });
        if ended.await.is_err() {
            let why = self.now.pending.clone().unwrap_or_default();
            warn!(
                skill = self.facts.name,
                run = self.now.run,
                why,
                "the component stops with a pending cancellation: the outcome of the run is unknown; check the machine"
            );
            self.give_up("the end of the component");
        }
    }

    async fn obey(&mut self, call: SkillCallRequest) {
        let SkillCallRequest {
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
        self.tell(SkillEvent::Called);
        if let Err(refusal) = &answer
            && let Some(suppressed) = self.refusals.admit("", Instant::now().into_std())
        {
            info!(
                skill = self.facts.name,
                suppressed, "{method} by {by} is refused: {refusal}"
            );
        }
        // The caller may have gone; the call has taken effect.
        let _told = reply.send(answer);
    }

    async fn call(
        &mut self,
        by: &SkillOwner,
        method: ProgramMethod,
        given: Given,
    ) -> Result<u32, SkillRefusal> {
        self.authority.claim(by)?;
        // The state is checked before the capability: a skill without Suspend refuses it with
        // BadNotSupported only while it is Running.
        let is_running = self.program.state() == ProgramMachineState::Running;
        let is_its_capability = method == ProgramMethod::Suspend && is_running;
        let is_halted = self.program.state() == ProgramMachineState::Halted;
        let is_made_ready = given.readies && is_halted;
        if method == ProgramMethod::Start && is_halted && self.now.needs_reset {
            return Err(unknown_outcome(self.now.run));
        }
        if !self.program.is_executable(method) && !is_its_capability && !is_made_ready {
            return Err(not_now(method, self.program.state()));
        }
        match method {
            ProgramMethod::Start => self.start(by, given).await?,
            ProgramMethod::Halt => self.halt(&by.to_string()).await?,
            ProgramMethod::Reset => self.reset(by).await?,
            ProgramMethod::Suspend => {
                self.take(ProgramMethod::Suspend, &format!("suspended by {by}"))?;
                self.signal(Signal::StandStill);
                if let Some(work) = &mut self.work {
                    work.suspend();
                }
            }
            ProgramMethod::Resume => {
                self.take(ProgramMethod::Resume, &format!("resumed by {by}"))?;
                self.signal(Signal::Go);
                if let Some(result) = self.work.as_mut().and_then(Running::resume) {
                    self.settle(result);
                }
            }
        }
        Ok(self.now.run)
    }

    async fn start(&mut self, by: &SkillOwner, given: Given) -> Result<(), SkillRefusal> {
        let is_halted = self.program.state() == ProgramMachineState::Halted;
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
            .map_err(|why| SkillRefusal::new(RefusalCode::InvalidArgument, why.to_string()))?;
        self.authority.begin(&self.facts.name)?;
        let begun = self.begin(by, is_halted).await;
        let (transition, run) = begun.inspect_err(|_| self.authority.end(&self.facts.name))?;
        self.history.clear_trace();
        // The configuration may differ at the next run.
        lock(&self.pending).kept(by, &given);
        self.now.parameters = Arc::new(parameters.clone());
        self.now.run = run.number();
        self.now.progress = 0.0;
        self.now.step.clear();
        self.tell(SkillEvent::Parameters(&parameters));
        self.transition(
            transition,
            format!("run {} is started by {by}", run.number()),
        );
        // The work starts after the transition is published, so that observers see the start of a
        // run before its end, even if the driver finishes immediately.
        let (work, reins) = Work::new(run.number(), parameters);
        let started = Started { run, work, reins };
        self.work = Some(Running::new(started, Arc::clone(&self.driver), within));
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
        by: &SkillOwner,
        is_halted: bool,
    ) -> Result<(&'static Transition, RunId), SkillRefusal> {
        if is_halted {
            self.reset(by).await?;
        }
        let transition = self.program.call(ProgramMethod::Start).map_err(refusal)?;
        let run = self.program.run();
        let run = run.ok_or_else(|| not_now(ProgramMethod::Start, self.program.state()))?;
        Ok((transition, run))
    }

    async fn halt(&mut self, by: &str) -> Result<(), SkillRefusal> {
        let mut message = format!("halted by {by}");
        if is_work(self.program.state()) {
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
                Stop::Refused(why) => {
                    return Err(SkillRefusal::new(RefusalCode::RequestNotAllowed, why));
                }
                // The work finished before it could be stopped.
                Stop::Done(result) if self.program.state() == ProgramMachineState::Running => {
                    self.settle(Ok(result))
                }
                Stop::Done(_) | Stop::Stopped => {}
                Stop::BrokenOff(how) => message = format!("{message}; {how}"),
            }
            if self.program.state() != ProgramMachineState::Ready {
                self.end_without_work(message.clone());
            }
        }
        self.take(ProgramMethod::Halt, &message)
    }

    async fn reset(&mut self, by: &SkillOwner) -> Result<(), SkillRefusal> {
        if self.program.state() == ProgramMachineState::Suspended {
            // Cancels the suspended work.
            let mut message = format!("reset by {by} while it was suspended");
            if let Stop::BrokenOff(how) = self.stop_work().await {
                message = format!("{message}; {how}");
            }
            if self.work.is_none() {
                self.end_without_work(message.clone());
                if self.now.needs_reset {
                    self.take(ProgramMethod::Halt, &message)?;
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
        self.take(ProgramMethod::Reset, &format!("reset by {by}"))
    }

    /// Handles a run that exceeded its time limit.
    async fn late(&mut self) {
        let within = self.work.as_mut().and_then(|work| {
            work.deadline = None;
            work.within
        });
        let within = within.unwrap_or_default();
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
                Some(line) = work.reins.steps.recv() => WorkEvent::Line(line),
                ended = &mut work.task => WorkEvent::Ended(outcome_of(ended, &mut work.unknown)),
                () = sleep_until(until) => return Stop::Pending,
            };
            match happened {
                WorkEvent::Line(line) => {
                    if let Line::Refused(why) = &line {
                        let why = why.clone();
                        self.line(line);
                        return Stop::Refused(why);
                    }
                    self.line(line);
                }
                WorkEvent::Ended(ended) => {
                    self.end_stopped();
                    return match ended {
                        Ok(results) => Stop::Done(results),
                        Err(RunFailure::Driver(DriverError::Stopped)) => Stop::Stopped,
                        Err(why) => Stop::BrokenOff(why.to_string()),
                    };
                }
                WorkEvent::Call(_) | WorkEvent::Progress(_) | WorkEvent::Late => {}
            }
        }
    }

    /// Keeps the run going until the end of its work is known.
    fn await_end(&mut self, message: String, then: Then) {
        let Some(work) = &mut self.work else {
            return;
        };
        work.halting = Some(Halting {
            message: message.clone(),
            then,
            over: Instant::now() + self.driver.halt_timeout().unwrap_or_default(),
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
        if let Err(refusal) = self.take(ProgramMethod::Halt, &message) {
            warn!(skill = self.facts.name, "{refusal}");
        }
    }

    /// Publishes the reason why a stopped run has not ended.
    fn pends(&mut self, why: String) {
        self.now.step.clone_from(&why);
        self.now.pending = Some(why.clone());
        self.tell(SkillEvent::Pending(&why));
    }

    /// Handles the end of the work of a run that was asked to stop.
    fn settle_halted(&mut self, halting: Halting, result: Result<RunResults, RunFailure>) {
        let Halting { message, then, .. } = halting;
        match (result, then) {
            (Ok(results), then) => {
                self.finish(Ok(results));
                if then == Then::Halt
                    && self.program.state() == ProgramMachineState::Ready
                    && let Err(refusal) = self.take(ProgramMethod::Halt, &message)
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
                if let Err(refusal) = self.take(ProgramMethod::Halt, &message) {
                    warn!(skill = self.facts.name, "{refusal}");
                }
            }
        }
    }

    /// Handles the end of work that was not asked to stop.
    fn settle(&mut self, result: Result<RunResults, RunFailure>) {
        self.take_steps();
        let work = self.work.as_mut();
        if work.as_ref().is_some_and(|work| work.unknown.is_some()) {
            self.now.needs_reset = true;
        }
        if let Some(halting) = work.and_then(|work| work.halting.take()) {
            return self.settle_halted(halting, result);
        }
        match (self.program.state(), &result) {
            (ProgramMachineState::Running, _) | (ProgramMachineState::Suspended, Err(_)) => {
                self.finish(result)
            }
            (ProgramMachineState::Suspended, Ok(_)) => {
                if let Some(work) = &mut self.work {
                    work.ended = Some(result);
                }
            }
            // The run was halted, but its task could not be aborted then.
            (ProgramMachineState::Halted | ProgramMachineState::Ready, _) => self.work = None,
        }
    }

    fn finish(&mut self, result: Result<RunResults, RunFailure>) {
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
        let outcome = RunOutcome {
            run: run.number(),
            succeeded: result.is_ok(),
            unknown: result.is_err() && self.now.needs_reset,
            message: result
                .as_ref()
                .err()
                .map(ToString::to_string)
                .unwrap_or_default(),
            results: self.facts.in_order(result.unwrap_or_default()),
            trace: self.history.take_trace(),
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
        let outcome = RunOutcome {
            run: run.number(),
            succeeded: false,
            unknown: self.now.needs_reset,
            message,
            results: Vec::new(),
            trace: self.history.take_trace(),
        };
        self.keep(outcome);
    }

    fn keep(&mut self, outcome: RunOutcome) {
        let outcome = self.history.keep(outcome);
        self.now.end(&outcome);
        self.tell(SkillEvent::Outcome(&outcome));
    }

    fn take(&mut self, method: ProgramMethod, message: &str) -> Result<(), SkillRefusal> {
        let transition = self.program.call(method).map_err(refusal)?;
        self.transition(transition, message.to_owned());
        Ok(())
    }

    fn transition(&mut self, transition: &'static Transition, message: String) {
        let at = clock();
        self.now.executable = executable(&self.program);
        self.now.enter(transition, at);
        if !is_work(transition.to) {
            self.now.step.clear();
            self.now.pending = None;
            if is_work(transition.from) {
                self.authority.end(&self.facts.name);
            }
        }
        debug!(skill = self.facts.name, "{}: {message}", transition.name);
        self.tell(SkillEvent::Transition(&Transitioned {
            transition,
            run: self.now.run,
            message,
            at,
        }));
    }

    fn line(&mut self, line: Line) {
        if let Some(work) = &self.work {
            self.history.add(work.began, &line);
        }
        match line {
            Line::Step(step) => {
                self.now.step = step;
                self.tell(SkillEvent::Step);
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
        self.tell(SkillEvent::Progress);
    }

    /// Processes steps that were reported before the work ended.
    fn take_steps(&mut self) {
        while let Some(line) = self.work.as_mut().and_then(Running::report) {
            self.line(line);
        }
    }

    fn signal(&self, signal: Signal) {
        if let Some(work) = &self.work {
            work.reins.signal.send_replace(signal);
        }
    }

    fn tell(&self, what: SkillEvent<'_>) {
        for observer in &self.observers {
            observer.told(what, &self.now);
        }
        self.shown.send_replace(Arc::new(self.now.clone()));
    }
}

fn executable(program: &ProgramInstance) -> [bool; 5] {
    ProgramMethod::ALL.map(|method| program.is_executable(method))
}

/// Time that the work has to end after it was stopped.
const TIME_TO_STOP: Duration = Duration::from_secs(1);
/// Time that the aborted future has to be dropped; a future that blocks its thread takes longer.
const TIME_TO_BREAK_OFF: Duration = Duration::from_millis(100);
/// Interval in which one refused call of a skill is logged, with the number of suppressed messages.
const TOLD_EVERY: Duration = Duration::from_secs(1);
/// Time that a closing component waits for the end of work that it has cancelled elsewhere.
const PENDING_AT_END: Duration = Duration::from_millis(4_500);
