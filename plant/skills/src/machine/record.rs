//! The state of the program of a skill, as clients see it, and the lease that follows it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use program::{Ending, ProgramInstance, ProgramMachineState, ProgramMethod, RunId, Transition};
use tracing::{debug, warn};

use super::history::SkillHistory;
use super::output::{Moment, SkillNotice, SkillOutput};
use super::refused::{not_now, refusal};
use super::run::WorkEnd;
use crate::authority::{Authority, SkillOwner};
use crate::description::SkillDescription;
use crate::driver::{Line, Signal};
use crate::outcomes::NewestOutcomes;
use crate::parameters::Parameters;
use crate::refusal::SkillRefusal;
use crate::shown::{LastCall, RunOutcome, SkillSnapshot, Transitioned, is_work};

/// The state of the program, its snapshot, its outcomes, and the outputs that report them.
pub(super) struct SkillRecord<R> {
    facts: Arc<SkillDescription>,
    authority: Authority,
    history: SkillHistory,
    program: ProgramInstance,
    now: SkillSnapshot,
    outputs: VecDeque<SkillOutput<R>>,
}

impl<R> SkillRecord<R> {
    pub(super) fn new(
        facts: Arc<SkillDescription>,
        authority: Authority,
        outcomes: NewestOutcomes,
        program: ProgramInstance,
        created: SystemTime,
    ) -> Self {
        let now = SkillSnapshot::first(program.state(), executable(&program), created);
        Self {
            facts,
            authority,
            history: SkillHistory::new(outcomes),
            program,
            now,
            outputs: VecDeque::new(),
        }
    }

    pub(super) fn facts(&self) -> &Arc<SkillDescription> {
        &self.facts
    }

    pub(super) fn authority(&self) -> &Authority {
        &self.authority
    }

    pub(super) fn snapshot(&self) -> &SkillSnapshot {
        &self.now
    }

    pub(super) fn state(&self) -> ProgramMachineState {
        self.program.state()
    }

    /// Returns whether a run is in progress.
    pub(super) fn is_at_work(&self) -> bool {
        is_work(self.program.state())
    }

    pub(super) fn is_executable(&self, method: ProgramMethod) -> bool {
        self.program.is_executable(method)
    }

    pub(super) fn set_can_suspend(&mut self, can_suspend: bool) {
        self.program.set_can_suspend(can_suspend);
    }

    /// Returns the number of the newest run, in progress or ended; 0 before the first.
    pub(super) fn run_number(&self) -> u32 {
        self.now.run
    }

    pub(super) fn output(&mut self) -> Option<SkillOutput<R>> {
        self.outputs.pop_front()
    }

    pub(super) fn push(&mut self, output: SkillOutput<R>) {
        self.outputs.push_back(output);
    }

    pub(super) fn signal(&mut self, signal: Signal) {
        self.push(SkillOutput::Signal(signal));
    }

    /// Performs the transition of a method.
    pub(super) fn take(
        &mut self,
        method: ProgramMethod,
        message: &str,
        now: Moment,
    ) -> Result<(), SkillRefusal> {
        let transition = self.program.call(method).map_err(refusal)?;
        self.transition(transition, message.to_owned(), now);
        Ok(())
    }

    /// Performs the transition to Running, with these parameters. Observers receive the parameters
    /// first.
    pub(super) fn start(
        &mut self,
        by: &SkillOwner,
        parameters: &Parameters,
        now: Moment,
    ) -> Result<RunId, SkillRefusal> {
        let transition = self.program.call(ProgramMethod::Start).map_err(refusal)?;
        let run = self.program.run();
        let run = run.ok_or_else(|| not_now(ProgramMethod::Start, self.program.state()))?;
        self.history.clear_trace();
        let parameters = Arc::new(parameters.clone());
        self.now.parameters = Arc::clone(&parameters);
        self.now.run = run.number();
        self.now.progress = 0.0;
        self.now.step.clear();
        self.tell(SkillNotice::Parameters(parameters));
        let message = format!("run {} is started by {by}", run.number());
        self.transition(transition, message, now);
        Ok(run)
    }

    /// Ends the run by the result of its work.
    pub(super) fn finish(&mut self, result: WorkEnd, now: Moment) {
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
            // A driver that reported an unknown end has found the end of its work.
            self.now.needs_reset = false;
        }
        let outcome = RunOutcome {
            run: run.number(),
            succeeded: result.is_ok(),
            unknown: self.now.needs_reset,
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
            Ok(transition) => self.transition(transition, message, now),
            Err(fault) => warn!(skill = self.facts.name, "{fault}"),
        }
    }

    /// Fails a run after its work was stopped.
    pub(super) fn fail_without_work(&mut self, message: String, now: Moment) {
        let run = self.program.run();
        self.end_without_work(message.clone());
        let ended = run.and_then(|run| self.program.ended(run, Ending::Failure).ok());
        if let Some(transition) = ended {
            self.transition(transition, message, now);
        }
    }

    /// Ends a run after its work was stopped, by Halt.
    pub(super) fn halt_without_work(&mut self, message: String, now: Moment) {
        self.end_without_work(message.clone());
        if let Err(refusal) = self.take(ProgramMethod::Halt, &message, now) {
            warn!(skill = self.facts.name, "{refusal}");
        }
    }

    /// Records the outcome of a run after its work was stopped. The caller performs the transition.
    pub(super) fn end_without_work(&mut self, message: String) {
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
        self.tell(SkillNotice::Outcome(outcome));
    }

    fn transition(&mut self, transition: &'static Transition, message: String, now: Moment) {
        self.now.executable = executable(&self.program);
        self.now.enter(transition, now.wall);
        if !is_work(transition.to) {
            self.now.step.clear();
            self.now.pending = None;
            if is_work(transition.from) {
                // A restart of the program reads first whether the component is free, and then
                // whether the outcome is unknown: it is published before.
                let at = now.monotonic;
                self.push(SkillOutput::Release { at });
            }
        }
        debug!(skill = self.facts.name, "{}: {message}", transition.name);
        self.tell(SkillNotice::Transition(Transitioned {
            transition,
            run: self.now.run,
            message,
            at: now.wall,
        }));
    }

    /// Records that the end of the work is unknown: the skill needs a Reset.
    pub(super) fn require_reset(&mut self) {
        self.now.needs_reset = true;
    }

    /// Adds a report to the trace, with the time since the start of the run.
    pub(super) fn trace(&mut self, since_start: Duration, line: &Line) {
        self.history.add(since_start, line);
    }

    pub(super) fn step(&mut self, step: String) {
        self.now.step = step;
        self.tell(SkillNotice::Step);
    }

    pub(super) fn progress(&mut self, done: f32) {
        self.now.progress = done;
        self.tell(SkillNotice::Progress);
    }

    /// Publishes the reason why a stopped run has not ended.
    pub(super) fn pends(&mut self, why: String) {
        self.now.step.clone_from(&why);
        self.now.pending = Some(why.clone());
        self.tell(SkillNotice::Pending(why));
    }

    /// Logs and publishes the reason, unless it is shown already.
    pub(super) fn pends_once(&mut self, why: String) {
        if self.now.pending.as_ref() != Some(&why) {
            warn!(skill = self.facts.name, run = self.now.run, "{why}");
            self.pends(why);
        }
    }

    /// Publishes a call and its result.
    pub(super) fn called(&mut self, call: LastCall) {
        self.now.diagnostic.last_call = Some(call);
        self.tell(SkillNotice::Called);
    }

    fn tell(&mut self, notice: SkillNotice) {
        let shown = Arc::new(self.now.clone());
        self.outputs.push_back(SkillOutput::Event(notice, shown));
    }
}

fn executable(program: &ProgramInstance) -> [bool; 5] {
    ProgramMethod::ALL.map(|method| program.is_executable(method))
}
