//! The state of a skill, without clocks, tasks or channels.
//!
//! A [`SkillMachine`] owns the state of the program, the run in progress, its time limits, the
//! stop in progress and the calls that wait for it. Inputs are [`call`](SkillMachine::call),
//! [`close`](SkillMachine::close), the reports of the work ([`report`](SkillMachine::report),
//! [`progress`](SkillMachine::progress), [`ended`](SkillMachine::ended)) and
//! [`handle_deadline`](SkillMachine::handle_deadline). Drain
//! [`poll_output`](SkillMachine::poll_output) after each input, and call `handle_deadline` when the
//! time of [`poll_deadline`](SkillMachine::poll_deadline) has passed.
//!
//! The lease ([`Authority`]) is shared by the skills of a component. The machine claims it with the
//! time of its inputs; the end of a run is an output. Of the driver, the machine uses only the
//! methods that return at once.
//!
//! - The work of a run starts only after the work of the run before it has ended.
//! - Every call has one response. A Start or Resume whose caller gave up is not executed and has
//!   none.
//! - While calls wait, there is a deadline.
//! - No signal to go on follows an accepted Halt.
//! - Reports of a run that has ended are ignored and counted.

mod call;
mod history;
mod output;
mod record;
mod refused;
mod run;
mod work;

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use log_limit::LogLimit;
use program::{Nature, ProgramInstance, ProgramMachineState, ProgramMethod, RunId};
use tokio::time::Instant;
use tracing::{debug, info, warn};

pub(crate) use self::call::{CallReply, Given, SkillCallRequest, Successor};
use self::call::{Caller, DriverSlot};
pub(crate) use self::output::{Moment, SkillOutput};
use self::record::SkillRecord;
use self::refused::{no_room, not_now};
pub(crate) use self::run::{RunFailure, WorkEnd};
use self::run::{RunState, Stop, StopCause, StopInProgress};
use self::work::SkillWork;
use crate::authority::{Authority, SkillOwner};
use crate::description::SkillDescription;
use crate::driver::{Driver, Line, Signal};
use crate::driver_error::DriverError;
use crate::outcomes::NewestOutcomes;
use crate::parameters::Parameters;
use crate::pending::PendingParameters;
use crate::refusal::SkillRefusal;
use crate::shown::{LastCall, SkillSnapshot};

/// The parts of a skill that its handle shares.
pub(crate) struct MachineParts {
    pub(crate) facts: Arc<SkillDescription>,
    pub(crate) driver: Arc<dyn Driver>,
    pub(crate) authority: Authority,
    pub(crate) pending: Arc<Mutex<PendingParameters>>,
    pub(crate) outcomes: NewestOutcomes,
    pub(crate) successor: Arc<Mutex<Option<Successor>>>,
    /// Number of the first run.
    pub(crate) first_run: u32,
}

/// The state of a skill. `R` is the way to a caller.
pub(crate) struct SkillMachine<R> {
    work: SkillWork<R>,
    /// The stop of the work that has not been confirmed.
    stopping: Option<StopInProgress<R>>,
    /// Calls that wait for the end of the stop.
    waiting: VecDeque<SkillCallRequest<R>>,
    closing: Option<Closing>,
    /// Number of reports of runs that had ended.
    ignored: u64,
    /// Rate limit of log messages about refused calls, so that a client that retries in a loop
    /// cannot flood the log.
    refusals: LogLimit,
}

/// The end of the component.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Closing {
    /// The run is halted next.
    Halts,
    /// The run was asked to halt.
    Asked,
    /// The work is done elsewhere, and its end is awaited until this time. Then the run is given up.
    Pends(Instant),
    Done,
}

/// The effect of an accepted call.
enum CallEffect {
    Done,
    /// The work is stopped first.
    Stops(StopCause, String),
}

impl<R: CallReply> SkillMachine<R> {
    pub(crate) fn new(parts: MachineParts, created: SystemTime) -> Self {
        let MachineParts {
            facts,
            driver,
            authority,
            pending,
            outcomes,
            successor,
            first_run,
        } = parts;
        let nature = Nature {
            can_suspend: driver.can_suspend(),
            rests_in: facts.rests_in,
        };
        let program = ProgramInstance::counting_from(nature, first_run);
        let slot = DriverSlot::new(driver, facts.timeout, successor);
        let record = SkillRecord::new(facts, authority, outcomes, program, created);
        Self {
            work: SkillWork::new(record, slot, pending),
            stopping: None,
            waiting: VecDeque::new(),
            closing: None,
            ignored: 0,
            refusals: LogLimit::every(TOLD_EVERY),
        }
    }

    /// Returns the state, as clients see it.
    pub(crate) fn snapshot(&self) -> &SkillSnapshot {
        self.work.record().snapshot()
    }

    /// Returns the next output. Calls that wait, and the end of the component, continue when all
    /// outputs before them are carried out.
    pub(crate) fn poll_output(&mut self, now: Moment) -> Option<SkillOutput<R>> {
        loop {
            let output = self.work.record_mut().output();
            if output.is_some() || !self.go_on(now) {
                return output;
            }
        }
    }

    /// Returns the time of the next [`handle_deadline`](Self::handle_deadline).
    pub(crate) fn poll_deadline(&self) -> Option<Instant> {
        if let Some(stopping) = &self.stopping {
            return Some(stopping.until);
        }
        let closes = match self.closing {
            Some(Closing::Pends(until)) => Some(until),
            Some(Closing::Halts | Closing::Asked | Closing::Done) | None => None,
        };
        // A run that has ended has no time limit, even if its work has not ended.
        if !self.work.record().is_at_work() {
            return None;
        }
        let late = self.work.current().and_then(RunState::deadline);
        [closes, late].into_iter().flatten().min()
    }

    /// Returns whether the skill has ended.
    pub(crate) fn is_closed(&self) -> bool {
        self.closing == Some(Closing::Done)
    }

    /// Takes a call. It waits while the work is being stopped.
    pub(crate) fn call(&mut self, call: SkillCallRequest<R>) {
        let refusal = if self.closing.is_some() {
            SkillRefusal::closed()
        } else if self.waiting.len() < MOST_WAITING {
            self.waiting.push_back(call);
            return;
        } else {
            self.without_room(&call)
        };
        let reply = SkillOutput::Reply(call.reply, Err(refusal));
        self.work.record_mut().push(reply);
    }

    /// Ends the skill: a run in progress is halted, regardless of the holder of the lease. Waiting
    /// and later calls are refused.
    pub(crate) fn close(&mut self) {
        if self.closing.is_some() {
            return;
        }
        self.closing = Some(Closing::Halts);
        for call in std::mem::take(&mut self.waiting) {
            self.work
                .record_mut()
                .push(SkillOutput::Reply(call.reply, Err(SkillRefusal::closed())));
        }
    }

    /// Ends the skill at once, without its work: the outcome of a run in progress is unknown.
    pub(crate) fn abandon(&mut self, now: Moment) {
        self.close();
        self.closing = Some(Closing::Done);
        if let Some(caller) = self.stopping.take().and_then(|stopping| stopping.caller) {
            let reply = SkillOutput::Reply(caller.reply, Err(SkillRefusal::closed()));
            self.work.record_mut().push(reply);
        }
        let record = self.work.record_mut();
        if record.is_at_work() {
            record.require_reset();
            let message = "the skill broke down; the outcome is unknown, check the machine";
            record.halt_without_work(message.to_owned(), now);
        }
    }

    /// Processes a report of the work of a run.
    pub(crate) fn report(&mut self, run: RunId, line: Line, now: Moment) {
        if !self.work.is_in_progress(run) {
            return self.ignore(run, "a report");
        }
        let refused = match &line {
            Line::Refused(why) => Some(why.clone()),
            Line::Step(_) | Line::Note(_) | Line::Pending(_) | Line::Unknown(_) => None,
        };
        self.work.report(line, now);
        let is_asked = |stopping: &mut StopInProgress<R>| !stopping.is_aborted;
        if let Some(why) = refused
            && self.work.is_done_elsewhere()
            && let Some(stopping) = self.stopping.take_if(is_asked)
        {
            self.stopped(stopping, Stop::Refused(why), now);
        }
    }

    /// Processes the progress of a run, from 0 to 1.
    pub(crate) fn progress(&mut self, run: RunId, done: f32) {
        if self.work.is_in_progress(run) {
            self.work.record_mut().progress(done);
        } else {
            self.ignore(run, "the progress");
        }
    }

    /// Processes the end of the work of a run. All its reports come first.
    pub(crate) fn ended(&mut self, run: RunId, result: WorkEnd, now: Moment) {
        let Some(work) = self.work.of(run) else {
            return self.ignore(run, "the end");
        };
        if let Err(why) = &result
            && why.is_unknown()
        {
            work.unknown.get_or_insert_with(|| why.to_string());
        }
        let is_unknown = work.unknown.is_some();
        let stopping = self.stopping.take();
        // The end of an aborted task is no result.
        let is_late =
            !self.work.record().is_at_work() || stopping.as_ref().is_some_and(|of| of.is_aborted);
        if is_late && !matches!(result, Err(RunFailure::Aborted)) {
            self.ignore(run, "the end");
        }
        if let Some(stopping) = stopping {
            self.ended_stopping(stopping, result, is_unknown, now);
        } else if self.work.record().is_at_work() {
            if is_unknown && result.is_err() {
                self.work.record_mut().require_reset();
            }
            self.work.settle(result, now);
        } else {
            // The run was halted, but its task could not be aborted then.
            self.work.remove();
        }
    }

    /// Processes time limits that have passed.
    pub(crate) fn handle_deadline(&mut self, now: Moment) {
        while self
            .poll_deadline()
            .is_some_and(|deadline| deadline <= now.monotonic)
        {
            self.expire(now);
        }
    }

    /// Returns the number of reports and ends that came after the end of their run.
    #[cfg(test)]
    pub(crate) const fn ignored(&self) -> u64 {
        self.ignored
    }

    /// Continues with the end of the component or the next waiting call, unless the work is being
    /// stopped. Returns whether there was anything to do.
    fn go_on(&mut self, now: Moment) -> bool {
        if self.stopping.is_some() {
            return false;
        }
        if let Some(closing) = self.closing {
            let next = self.close_next(closing, now);
            self.closing = Some(next);
            return next != closing;
        }
        let Some(call) = self.waiting.pop_front() else {
            return false;
        };
        self.obey(call, now);
        true
    }

    fn close_next(&mut self, closing: Closing, now: Moment) -> Closing {
        match closing {
            Closing::Halts if !self.work.record().is_executable(ProgramMethod::Halt) => {
                Closing::Done
            }
            Closing::Halts => {
                match self.halt("halted by the end of the component".to_owned(), now) {
                    Ok(CallEffect::Done) => {}
                    Ok(CallEffect::Stops(cause, message)) => {
                        self.stop(cause, message, None, now);
                    }
                    Err(refusal) => warn!(skill = self.work.record().facts().name, "{refusal}"),
                }
                Closing::Asked
            }
            // The cancellation is in progress, or is refused: the run ends with an outcome anyway.
            Closing::Asked if self.work.record().is_at_work() => {
                Closing::Pends(now.monotonic + PENDING_AT_END)
            }
            Closing::Asked => Closing::Done,
            // A run that ended as done is in Ready.
            Closing::Pends(_) if !self.work.record().is_at_work() => Closing::Halts,
            Closing::Pends(_) | Closing::Done => closing,
        }
    }

    fn obey(&mut self, call: SkillCallRequest<R>, now: Moment) {
        if call.is_withdrawn() {
            let (method, by) = (call.method, call.by);
            debug!(
                skill = self.work.record().facts().name,
                "{method} by {by} is not executed: its caller gave up"
            );
            return;
        }
        let SkillCallRequest {
            by,
            method,
            given,
            reply,
        } = call;
        let effect = self.effect(&by, method, given, now);
        let caller = Caller { by, method, reply };
        match effect {
            Ok(CallEffect::Done) => self.answer(caller, Ok(()), now),
            Ok(CallEffect::Stops(cause, message)) => {
                self.stop(cause, message, Some(caller), now);
            }
            Err(refusal) => self.answer(caller, Err(refusal), now),
        }
    }

    fn answer(&mut self, caller: Caller<R>, result: Result<(), SkillRefusal>, now: Moment) {
        let Caller { by, method, reply } = caller;
        self.work.record().authority().settle();
        if let Err(refusal) = &result
            && let Some(suppressed) = self.refusals.admit("", now.monotonic.into_std())
        {
            info!(
                skill = self.work.record().facts().name,
                suppressed, "{method} by {by} is refused: {refusal}"
            );
        }
        self.work.record_mut().called(LastCall {
            method,
            by,
            at: now.wall,
            refused: result.as_ref().err().cloned(),
        });
        let run = self.work.record().run_number();
        self.work
            .record_mut()
            .push(SkillOutput::Reply(reply, result.map(|()| run)));
    }

    /// Returns the refusal of a call for which the queue has no space. Errors that do not depend on
    /// the queue come first.
    fn without_room(&self, call: &SkillCallRequest<R>) -> SkillRefusal {
        if let Err(refusal) = self.work.record().authority().allows(&call.by) {
            return refusal;
        }
        let declared = &self.work.record().facts().parameters;
        let given = call.given.parameters.clone();
        let wrong = given.and_then(|given| Parameters::complete(declared, given).err());
        wrong.unwrap_or_else(no_room)
    }

    fn effect(
        &mut self,
        by: &SkillOwner,
        method: ProgramMethod,
        given: Given,
        now: Moment,
    ) -> Result<CallEffect, SkillRefusal> {
        self.work.record().authority().claim_at(by, now.monotonic)?;
        // The state is checked before the capability: a skill without Suspend refuses it with
        // BadNotSupported only while it is Running.
        let state = self.work.record().state();
        let is_its_capability =
            method == ProgramMethod::Suspend && state == ProgramMachineState::Running;
        let is_halted = state == ProgramMachineState::Halted;
        let is_made_ready = given.readies && is_halted;
        let needs_reset = self.work.record().snapshot().needs_reset;
        if method == ProgramMethod::Start && is_halted && needs_reset {
            return Err(SkillRefusal::unknown_outcome(
                self.work.record().run_number(),
            ));
        }
        if !self.work.record().is_executable(method) && !is_its_capability && !is_made_ready {
            return Err(not_now(method, state));
        }
        match method {
            ProgramMethod::Start => self.work.start(by, given, now)?,
            ProgramMethod::Halt => return self.halt(format!("halted by {by}"), now),
            ProgramMethod::Reset => {
                if state == ProgramMachineState::Suspended && self.work.is_halting(now).is_none() {
                    // The suspended work is cancelled.
                    let message = format!("reset by {by} while it was suspended");
                    return Ok(CallEffect::Stops(StopCause::Reset, message));
                }
                self.work.reset(by, now)?;
            }
            ProgramMethod::Suspend => self.work.suspend(by, now)?,
            ProgramMethod::Resume => self.work.resume(by, now)?,
        }
        Ok(CallEffect::Done)
    }

    fn halt(&mut self, message: String, now: Moment) -> Result<CallEffect, SkillRefusal> {
        if !self.work.record().is_at_work() {
            self.work
                .record_mut()
                .take(ProgramMethod::Halt, &message, now)?;
            return Ok(CallEffect::Done);
        }
        match self.work.is_halting(now) {
            None => Ok(CallEffect::Stops(StopCause::Halt, message)),
            Some(true) => Ok(CallEffect::Stops(StopCause::GiveUp, message)),
            // The work is being cancelled already.
            Some(false) => {
                self.work.halt_at_end();
                Ok(CallEffect::Done)
            }
        }
    }

    /// Asks the work to stop. [`stopped`](Self::stopped) follows.
    fn stop(&mut self, cause: StopCause, message: String, caller: Option<Caller<R>>, now: Moment) {
        let mut stopping = StopInProgress {
            cause,
            message,
            caller,
            is_aborted: false,
            until: now.monotonic + TIME_TO_STOP,
        };
        if cause == StopCause::GiveUp {
            let why = self.work.current().and_then(|work| work.unknown.clone());
            let why = why.or_else(|| self.snapshot().pending.clone());
            let why = why.unwrap_or_else(|| "the work has not ended".to_owned());
            stopping.message = format!("{}; the outcome is unknown: {why}", stopping.message);
            self.abort(stopping, now);
        } else if let Some(ended) = self.work.take_ended() {
            self.stopped(stopping, ended.map_or(Stop::Stopped, Stop::Done), now);
        } else if self.work.current().is_none() {
            self.stopped(stopping, Stop::Stopped, now);
        } else {
            self.work.record_mut().signal(Signal::Stop);
            self.stopping = Some(stopping);
        }
    }

    /// Aborts the work. A dropped future does not stop the machine, so the outcome is unknown.
    fn abort(&mut self, stopping: StopInProgress<R>, now: Moment) {
        self.work.record_mut().require_reset();
        self.work.record_mut().push(SkillOutput::Abort);
        self.stopping = Some(StopInProgress {
            is_aborted: true,
            until: now.monotonic + TIME_TO_BREAK_OFF,
            ..stopping
        });
    }

    /// Handles the passed deadline.
    fn expire(&mut self, now: Moment) {
        match self.stopping.take() {
            // The task blocks its thread. The work is kept, and is not started anew before its end.
            Some(stopping) if stopping.is_aborted => {
                self.stopped(stopping, Stop::BrokenOff(broken_off()), now);
            }
            // Work that is done elsewhere is never aborted.
            Some(stopping) if self.work.is_done_elsewhere() => {
                self.stopped(stopping, Stop::Pending, now);
            }
            Some(stopping) => {
                let (skill, run) = (
                    &self.work.record().facts().name,
                    self.work.record().run_number(),
                );
                warn!(skill, "run {run}: {}", broken_off());
                self.abort(stopping, now);
            }
            None if matches!(self.closing, Some(Closing::Pends(until)) if until <= now.monotonic) =>
            {
                self.give_up_at_end(now);
            }
            None => {
                let limit = self.work.exceed();
                let message = format!("the work was not done within {limit:?}");
                self.stop(StopCause::Late, message, None, now);
            }
        }
    }

    fn give_up_at_end(&mut self, now: Moment) {
        let shown = self.snapshot();
        warn!(
            skill = self.work.record().facts().name,
            run = shown.run,
            why = shown.pending.as_deref().unwrap_or_default(),
            "the component stops before the work has ended: the outcome of the run is unknown; check the machine"
        );
        let message = "the end of the component".to_owned();
        self.stop(StopCause::GiveUp, message, None, now);
    }

    /// Handles the end of the work during its stop.
    fn ended_stopping(
        &mut self,
        stopping: StopInProgress<R>,
        result: WorkEnd,
        is_unknown: bool,
        now: Moment,
    ) {
        self.work.remove();
        if is_unknown && result.is_err() {
            self.work.record_mut().require_reset();
        }
        let is_elsewhere = self.work.is_done_elsewhere();
        let stop = match result {
            _ if stopping.is_aborted => Stop::BrokenOff(broken_off()),
            Ok(results) => Stop::Done(results),
            Err(RunFailure::Driver(DriverError::Stopped)) if is_elsewhere || !is_unknown => {
                Stop::Stopped
            }
            Err(why) if is_elsewhere || is_unknown => Stop::BrokenOff(why.to_string()),
            Err(_) => Stop::Stopped,
        };
        self.stopped(stopping, stop, now);
    }

    /// Handles the reaction of the work to a stop request.
    fn stopped(&mut self, stopping: StopInProgress<R>, stop: Stop, now: Moment) {
        let StopInProgress {
            cause,
            message,
            caller,
            ..
        } = stopping;
        let by = caller.as_ref().map(|caller| &caller.by);
        let result = self.work.stopped((cause, message), by, stop, now);
        match (caller, result) {
            (Some(caller), result) => self.answer(caller, result, now),
            (None, Err(refusal)) => warn!(skill = self.work.record().facts().name, "{refusal}"),
            (None, Ok(())) => {}
        }
    }

    fn ignore(&mut self, run: RunId, what: &str) {
        self.ignored += 1;
        debug!(
            skill = self.work.record().facts().name,
            run = run.number(),
            ignored = self.ignored,
            "{what} of the work came after the end of its run"
        );
    }
}

fn broken_off() -> String {
    format!(
        "the outcome is unknown: its work did not stop within {TIME_TO_STOP:?} and was broken off"
    )
}

/// Time that the work has to end after it was stopped.
const TIME_TO_STOP: Duration = Duration::from_secs(1);
/// Time that the aborted future has to be dropped; a future that blocks its thread takes longer.
const TIME_TO_BREAK_OFF: Duration = Duration::from_millis(100);
/// Interval in which one refused call of a skill is logged, with the number of suppressed messages.
const TOLD_EVERY: Duration = Duration::from_secs(1);
/// Time that a closing component waits for the end of work that it has cancelled elsewhere.
const PENDING_AT_END: Duration = Duration::from_millis(4_500);
/// Maximum number of calls that wait for the end of a stop.
pub(crate) const MOST_WAITING: usize = 16;

#[cfg(test)]
mod tests;
