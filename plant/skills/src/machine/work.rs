//! The program of a skill with its driver and the work in progress: the start and the end of runs.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use program::{ProgramMachineState, ProgramMethod, RunId};
use tracing::{info, warn};

use super::call::{DriverSlot, Given};
use super::output::{Moment, SkillOutput};
use super::record::SkillRecord;
use super::refused::{is_stopped, still_at_work};
use super::run::{Halting, RunState, Stop, StopCause, Then, WorkEnd};
use crate::authority::SkillOwner;
use crate::driver::{Driver, Line, Signal};
use crate::lock::lock;
use crate::panics::panic_text;
use crate::parameters::{Parameters, SkillParameter};
use crate::pending::PendingParameters;
use crate::refusal::{RefusalCode, SkillRefusal};
use crate::value::SkillValue;

/// The program of a skill, its driver and the work of its newest run.
pub(super) struct SkillWork<R> {
    record: SkillRecord<R>,
    slot: DriverSlot,
    pending: Arc<Mutex<PendingParameters>>,
    /// The work of the newest run, until it has ended. The run itself may end before its work.
    work: Option<RunState>,
}

impl<R> SkillWork<R> {
    pub(super) const fn new(
        record: SkillRecord<R>,
        slot: DriverSlot,
        pending: Arc<Mutex<PendingParameters>>,
    ) -> Self {
        Self {
            record,
            slot,
            pending,
            work: None,
        }
    }

    pub(super) fn record(&self) -> &SkillRecord<R> {
        &self.record
    }

    pub(super) fn record_mut(&mut self) -> &mut SkillRecord<R> {
        &mut self.record
    }

    pub(super) fn current(&self) -> Option<&RunState> {
        self.work.as_ref()
    }

    /// Returns the work of this run, if it has not ended.
    pub(super) fn of(&mut self, run: RunId) -> Option<&mut RunState> {
        self.work.as_mut().filter(|work| work.run == run)
    }

    /// Removes the work, which has ended.
    pub(super) fn remove(&mut self) {
        self.work = None;
    }

    /// Returns whether the reports of a run count.
    pub(super) fn is_in_progress(&self, run: RunId) -> bool {
        let is_current = self.work.as_ref().is_some_and(|work| work.run == run);
        is_current && self.record.is_at_work()
    }

    /// Returns `None` if the run is not being stopped, otherwise whether the next Halt ends it with
    /// an unknown outcome.
    pub(super) fn is_halting(&self, now: Moment) -> Option<bool> {
        self.work.as_ref()?.is_halting(now.monotonic)
    }

    /// Returns whether the work is done elsewhere. Such work is never aborted while it may end.
    pub(super) fn is_done_elsewhere(&self) -> bool {
        self.slot.driver().halt_timeout().is_some()
    }

    /// Starts a run, from Halted by way of Ready.
    pub(super) fn start(
        &mut self,
        by: &SkillOwner,
        given: Given,
        now: Moment,
    ) -> Result<(), SkillRefusal> {
        if let Some(work) = &self.work {
            return Err(still_at_work(work.run));
        }
        if self.slot.adopt() {
            let can_suspend = self.slot.driver().can_suspend();
            self.record.set_can_suspend(can_suspend);
        }
        let limit = self.slot.limit(given.within);
        let given = given
            .parameters
            .unwrap_or_else(|| lock(&self.pending).given(by));
        let driver = Arc::clone(self.slot.driver());
        let facts = Arc::clone(self.record.facts());
        let parameters = accepted(&*driver, &facts.parameters, given.clone())?;
        self.record.authority().begin(&facts.name)?;
        let run = self.begin(by, &parameters, now);
        let run = run.inspect_err(|_| self.record.authority().end(&facts.name, now.monotonic))?;
        // The configuration may differ at the next run.
        lock(&self.pending).kept(by, &given);
        self.work = Some(RunState::new(run, limit, now.monotonic));
        // The work starts after the transition is published, so that observers see the start of a
        // run before its end, even if the driver finishes immediately.
        self.record.push(SkillOutput::Run {
            run,
            driver,
            parameters,
        });
        Ok(())
    }

    fn begin(
        &mut self,
        by: &SkillOwner,
        parameters: &Parameters,
        now: Moment,
    ) -> Result<RunId, SkillRefusal> {
        if self.record.state() == ProgramMachineState::Halted {
            self.reset(by, now)?;
        }
        self.record.start(by, parameters, now)
    }

    /// Performs the transition to Ready while there is no work.
    pub(super) fn reset(&mut self, by: &SkillOwner, now: Moment) -> Result<(), SkillRefusal> {
        if let Some(work) = &self.work {
            return Err(still_at_work(work.run));
        }
        let message = format!("reset by {by}");
        self.record.take(ProgramMethod::Reset, &message, now)
    }

    pub(super) fn suspend(&mut self, by: &SkillOwner, now: Moment) -> Result<(), SkillRefusal> {
        self.refuse_while_halting(ProgramMethod::Suspend, now)?;
        let message = format!("suspended by {by}");
        self.record.take(ProgramMethod::Suspend, &message, now)?;
        if let Some(work) = &mut self.work {
            work.suspend(now.monotonic);
            self.record.signal(Signal::StandStill);
        }
        Ok(())
    }

    pub(super) fn resume(&mut self, by: &SkillOwner, now: Moment) -> Result<(), SkillRefusal> {
        self.refuse_while_halting(ProgramMethod::Resume, now)?;
        let message = format!("resumed by {by}");
        self.record.take(ProgramMethod::Resume, &message, now)?;
        let Some(work) = &mut self.work else {
            return Ok(());
        };
        match work.resume(now.monotonic) {
            Some(result) => self.settle(result, now),
            None => self.record.signal(Signal::Go),
        }
        Ok(())
    }

    /// A Go after Stop would let the machine move on after Halt was accepted.
    fn refuse_while_halting(&self, method: ProgramMethod, now: Moment) -> Result<(), SkillRefusal> {
        match &self.work {
            Some(work) if work.is_halting(now.monotonic).is_some() => {
                Err(is_stopped(method, work.run))
            }
            Some(_) | None => Ok(()),
        }
    }

    /// Lets a run that is being stopped end in Halted, even if its work gets done.
    pub(super) fn halt_at_end(&mut self) {
        let halting = self.work.as_mut().and_then(|work| work.halting.as_mut());
        if let Some(halting) = halting {
            halting.then = Then::Halt;
        }
    }

    /// Takes the result of work that ended while its run was suspended.
    pub(super) fn take_ended(&mut self) -> Option<WorkEnd> {
        let ended = self.work.as_mut()?.ended.take()?;
        self.work = None;
        Some(ended)
    }

    /// Ends the time limit of the run. Returns it.
    pub(super) fn exceed(&mut self) -> Duration {
        let limit = self.work.as_mut().map(RunState::exceed);
        limit.unwrap_or_default()
    }

    /// Handles the reaction of the work to a stop request.
    ///
    /// # Errors
    /// The refusal for the caller that asked for the stop.
    pub(super) fn stopped(
        &mut self,
        (cause, message): (StopCause, String),
        by: Option<&SkillOwner>,
        stop: Stop,
        now: Moment,
    ) -> Result<(), SkillRefusal> {
        match cause {
            StopCause::Halt => self.halted(message, stop, now),
            StopCause::Reset => self.suspended_reset(message, by, stop, now),
            StopCause::Late => {
                self.late(message, stop, now);
                Ok(())
            }
            StopCause::GiveUp => {
                let (skill, run) = (&self.record.facts().name, self.record.run_number());
                warn!(skill, run, "{message}");
                self.record.halt_without_work(message, now);
                Ok(())
            }
        }
    }

    fn halted(&mut self, mut message: String, stop: Stop, now: Moment) -> Result<(), SkillRefusal> {
        match stop {
            Stop::Pending => {
                self.await_end(message, Then::Halt, now);
                return Ok(());
            }
            Stop::Refused(why) => {
                return Err(SkillRefusal::new(RefusalCode::RequestNotAllowed, why));
            }
            // The work finished before it could be stopped.
            Stop::Done(results) if self.record.state() == ProgramMachineState::Running => {
                self.finish(Ok(results), now);
            }
            Stop::Done(_) | Stop::Stopped => {}
            Stop::BrokenOff(how) => message = format!("{message}; {how}"),
        }
        if self.record.is_at_work() {
            self.record.end_without_work(message.clone());
        }
        // A run that finished may rest in Halted.
        if self.record.state() == ProgramMachineState::Halted {
            return Ok(());
        }
        self.record.take(ProgramMethod::Halt, &message, now)
    }

    /// Completes the Reset of a suspended run.
    fn suspended_reset(
        &mut self,
        mut message: String,
        by: Option<&SkillOwner>,
        stop: Stop,
        now: Moment,
    ) -> Result<(), SkillRefusal> {
        match stop {
            Stop::Pending => self.await_end(message.clone(), Then::Halt, now),
            Stop::BrokenOff(how) => message = format!("{message}; {how}"),
            // The run stays suspended, and can be resumed.
            Stop::Refused(why) => {
                return Err(SkillRefusal::new(RefusalCode::RequestNotAllowed, why));
            }
            Stop::Done(_) | Stop::Stopped => {}
        }
        // Aborted work that blocks its thread may still move the machine: its run ends, so that it
        // cannot be resumed, and the work is kept until its end.
        let is_unknown = self.record.snapshot().needs_reset;
        if let Some(work) = &self.work
            && !is_unknown
        {
            return Err(still_at_work(work.run));
        }
        self.record.end_without_work(message.clone());
        if is_unknown {
            self.record.take(ProgramMethod::Halt, &message, now)?;
            return Err(SkillRefusal::unknown_outcome(self.record.run_number()));
        }
        let message = by.map_or(message, |by| format!("reset by {by}"));
        self.record.take(ProgramMethod::Reset, &message, now)
    }

    /// Ends a run that exceeded its time limit.
    fn late(&mut self, message: String, stop: Stop, now: Moment) {
        match stop {
            Stop::Done(results) => self.finish(Ok(results), now),
            Stop::Pending | Stop::Refused(_) => self.await_end(message, Then::End, now),
            Stop::Stopped => self.record.fail_without_work(message, now),
            Stop::BrokenOff(how) => {
                let message = format!("{message}; {how}");
                self.record.fail_without_work(message, now);
            }
        }
    }

    /// Keeps the run going until the end of its work is known.
    fn await_end(&mut self, message: String, then: Then, now: Moment) {
        let Some(work) = &mut self.work else {
            return;
        };
        let patience = self.slot.driver().halt_timeout().unwrap_or_default();
        let over = now.monotonic.checked_add(patience);
        let over = over.unwrap_or_else(|| now.monotonic + LONGEST_PATIENCE);
        let why = self.record.snapshot().pending.clone();
        let why = why.unwrap_or_else(|| "cancellation pending: the work has not ended".to_owned());
        let (skill, run) = (&self.record.facts().name, self.record.run_number());
        info!(skill, run, "{message}; {why}");
        work.halting = Some(Halting {
            message,
            then,
            is_late: then == Then::End,
            over,
        });
        self.record.pends(why);
    }

    /// Handles the end of work that was not asked to stop, or was asked and did not end in time.
    pub(super) fn settle(&mut self, result: WorkEnd, now: Moment) {
        let halting = self.work.as_mut().and_then(|work| work.halting.take());
        let is_suspended = self.record.state() == ProgramMachineState::Suspended;
        match (halting, result) {
            (Some(halting), result) => self.settle_halted(halting, result, now),
            // Suspended work cannot finish: the result waits for Resume.
            (None, Ok(results)) if is_suspended => {
                if let Some(work) = &mut self.work {
                    work.ended = Some(Ok(results));
                }
            }
            (None, result) => self.finish(result, now),
        }
    }

    /// Handles the end of the work of a run that was asked to stop.
    fn settle_halted(&mut self, halting: Halting, result: WorkEnd, now: Moment) {
        let Halting { message, then, .. } = halting;
        let is_suspended = self.record.state() == ProgramMachineState::Suspended;
        match (result, then) {
            (Ok(_), _) if is_suspended => {
                self.work = None;
                self.record.halt_without_work(message, now);
            }
            (Ok(results), then) => {
                self.finish(Ok(results), now);
                if then == Then::Halt
                    && self.record.state() == ProgramMachineState::Ready
                    && let Err(refusal) = self.record.take(ProgramMethod::Halt, &message, now)
                {
                    warn!(skill = self.record.facts().name, "{refusal}");
                }
            }
            (Err(why), Then::End) => self.finish(Err(why.after(message)), now),
            (Err(why), Then::Halt) => {
                self.work = None;
                let message = why.after(message).to_string();
                self.record.halt_without_work(message, now);
            }
        }
    }

    fn finish(&mut self, result: WorkEnd, now: Moment) {
        self.work = None;
        self.record.finish(result, now);
    }

    /// Processes a report of the run in progress.
    pub(super) fn report(&mut self, line: Line, now: Moment) {
        let Some(work) = &mut self.work else {
            return;
        };
        let since_start = now.monotonic.saturating_duration_since(work.began);
        self.record.trace(since_start, &line);
        match line {
            Line::Step(step) => self.record.step(step),
            Line::Note(_) => {}
            Line::Pending(why) => self.record.pends(why),
            Line::Refused(why) => {
                // The Halt has no effect. A run that exceeded its limit stays in its stop, so that
                // a later Halt can give it up.
                match &mut work.halting {
                    Some(halting) if halting.is_late => halting.then = Then::End,
                    halting => *halting = None,
                }
                self.record.pends_once(why);
            }
            Line::Unknown(why) => {
                work.unknown = Some(why.clone());
                self.record.pends_once(why);
            }
        }
    }
}

/// Returns the complete parameters of a run, if the driver accepts them. A driver that panics
/// accepts nothing.
fn accepted(
    driver: &dyn Driver,
    declared: &[SkillParameter],
    given: Vec<(String, SkillValue)>,
) -> Result<Parameters, SkillRefusal> {
    let invalid = |why: String| SkillRefusal::new(RefusalCode::InvalidArgument, why);
    let checked = catch_unwind(AssertUnwindSafe(|| {
        let prepared = driver.prepared(declared, given);
        let parameters = Parameters::complete(declared, prepared)?;
        let checked = driver.check(&parameters);
        checked.map_err(|why| invalid(why.to_string()))?;
        Ok(parameters)
    }));
    checked.unwrap_or_else(|panic| {
        let panic = panic_text(&*panic);
        Err(invalid(format!(
            "the driver broke down while it checked the parameters: {panic}"
        )))
    })
}

/// Halt timeout of a driver whose own exceeds the range of the clock.
const LONGEST_PATIENCE: Duration = Duration::from_secs(365 * 24 * 3_600);
