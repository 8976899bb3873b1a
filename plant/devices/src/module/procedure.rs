//! A run of a procedure.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use mtp::state::{Command, State};
use mtp::{ControlRole, ModuleOutput, MtpService, OutputRole, Procedure, ServiceParameter};
use skills::{Driver, DriverError, InvalidParameter, RunResults, SkillValue, Work};
use tokio::sync::Mutex;
use tokio::time::{Instant, sleep};

use super::error::{ModuleError, StateWord};
use super::handshake::{Handshake, HandshakeTiming, ModuleNodes};
use super::is_equal;

/// The driver of a procedure.
pub(super) struct ProcedureRun {
    pub(super) service: Arc<MtpService>,
    pub(super) procedure: Arc<Procedure>,
    pub(super) parameters: Vec<ServiceParameter>,
    pub(super) nodes: Arc<dyn ModuleNodes>,
    pub(super) busy: Arc<Mutex<()>>,
    pub(super) timing: HandshakeTiming,
}

/// Returns the outputs that a run of a procedure reads.
pub(super) fn outputs<'s>(
    service: &'s MtpService,
    procedure: &'s Procedure,
) -> impl Iterator<Item = &'s ModuleOutput> {
    let all = procedure.outputs.iter().chain(&service.outputs);
    all.filter(|output| output.role != OutputRole::ProcessValueIn && output.node.is_some())
}

/// The end of a suspension.
enum Suspended {
    /// The service was continued, or has completed.
    Resumed,
    /// The run is to be stopped.
    Stopped,
}

#[async_trait]
impl Driver for ProcedureRun {
    fn can_suspend(&self) -> bool {
        true
    }

    fn halt_timeout(&self) -> Option<Duration> {
        Some(self.timing.stop + self.timing.handshake)
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let Ok(_alone) = self.busy.try_lock() else {
            let service = self.service.name.clone();
            return Err(ModuleError::Busy { service }.into());
        };
        let shake = Handshake {
            service: &self.service,
            nodes: &*self.nodes,
            timing: self.timing,
        };
        tokio::select! {
            prepared = self.prepare(&shake, &work) => prepared?,
            () = work.stopped() => {
                // A Reset that was written has no effect later.
                let _removed = shake.withdraw().await;
                return Err(ModuleError::StoppedBeforeStart.into());
            }
        }
        self.start(&shake, &work).await?;
        Ok(self.follow(&shake, &work).await?)
    }
}

impl ProcedureRun {
    /// Prepares the service: nothing moves.
    async fn prepare(&self, shake: &Handshake<'_>, work: &Work) -> Result<(), ModuleError> {
        work.step("connect").await;
        let state_node = shake.needed(ControlRole::State, "StateCur")?;
        self.nodes.connect(state_node, self.timing.connect).await?;
        work.step("mode and source").await;
        shake.mode().await?;
        self.make_idle(shake, work).await?;
        work.step("procedure").await;
        shake.select(&self.procedure).await?;
        if !self.parameters.is_empty() {
            work.step("parameters").await;
        }
        for parameter in &self.parameters {
            let value = work.parameters().get(&parameter.name);
            let missing = || InvalidParameter::missing(&parameter.name, "value");
            let value = value.ok_or_else(missing)?;
            shake.parameter(parameter, value).await?;
        }
        work.step("start").await;
        shake.allowed(Command::Start).await
    }

    /// Resets a service after its last run.
    async fn make_idle(&self, shake: &Handshake<'_>, work: &Work) -> Result<(), ModuleError> {
        let state = shake.state().await?;
        let is_at_end = matches!(
            state,
            StateWord::Known(State::Completed | State::Stopped | State::Aborted)
        );
        if is_at_end {
            work.step("reset").await;
            shake.allowed(Command::Reset).await?;
            shake.command(Command::Reset).await?;
            let within = (
                "the service was reset and is to be Idle",
                self.timing.handshake,
            );
            let is_idle = |state| state == StateWord::Known(State::Idle);
            let reached = shake.until(is_idle, within).await;
            shake.withdraw().await?;
            return reached.map(drop);
        }
        match state == StateWord::Known(State::Idle) {
            true => Ok(()),
            false => Err(ModuleError::NotIdle {
                service: self.service.name.clone(),
                state,
            }),
        }
    }

    /// Starts the procedure. A Start that has no effect is withdrawn.
    async fn start(&self, shake: &Handshake<'_>, work: &Work) -> Result<(), ModuleError> {
        if work.is_stopped() {
            return Err(ModuleError::StoppedBeforeStart);
        }
        let sent = shake.command(Command::Start).await;
        let is_idle = |state| state == StateWord::Known(State::Idle);
        let within = ("Start was written", self.timing.handshake);
        let started = tokio::select! {
            started = shake.until(|state| !is_idle(state), within) => started,
            () = work.stopped() => Err(ModuleError::StoppedInIdle),
        };
        let Err(why) = started else {
            return shake.withdraw().await.or(Ok(()));
        };
        let why = match sent {
            Ok(()) => why,
            Err(refused) => refused,
        };
        let state = match shake.withdraw().await {
            Ok(()) => shake.state().await,
            Err(why) => Err(why),
        };
        match state {
            Ok(state) if is_idle(state) => {
                let why = Box::new(why);
                Err(ModuleError::Withdrawn { why })
            }
            Ok(_) => Ok(()),
            Err(silent) => {
                let error = ModuleError::UnknownStart {
                    why: Box::new(why),
                    silent: Box::new(silent),
                };
                work.unknown(error.to_string()).await;
                Err(error)
            }
        }
    }

    /// Follows the procedure to its end.
    async fn follow(&self, shake: &Handshake<'_>, work: &Work) -> Result<RunResults, ModuleError> {
        let run_time = match has_run_time(&self.procedure, &self.parameters) {
            true => work.parameters().number(RUN_TIME).unwrap_or_default(),
            false => 0.0,
        };
        let run_time = Duration::try_from_secs_f64(run_time).unwrap_or_default();
        let mut shown = None;
        let mut executed = Duration::ZERO;
        let mut has_executed = false;
        let mut completing: Option<Instant> = None;
        let mut answered = Instant::now();
        loop {
            let before = Instant::now();
            let state = shake.state().await;
            let executes = matches!(state, Ok(StateWord::Known(State::Execute)));
            if let Ok(state) = state {
                answered = Instant::now();
                if shown != Some(state) {
                    shown = Some(state);
                    work.step(state.to_string()).await;
                }
            }
            match state {
                Ok(StateWord::Known(State::Completed)) => return self.results(shake, work).await,
                Ok(StateWord::Known(end @ (State::Stopped | State::Aborted))) => {
                    return Err(ModuleError::NotCompleted { end });
                }
                Ok(StateWord::Known(State::Idle)) => {
                    return Err(ModuleError::IdleAgain);
                }
                Ok(StateWord::Known(State::Execute)) => {
                    if !has_executed {
                        has_executed = true;
                        self.compare(work).await;
                    }
                    let is_over = !run_time.is_zero() && executed >= run_time;
                    let completed = match is_over {
                        true => self.complete(shake, &mut completing).await,
                        false => Ok(()),
                    };
                    if let Err(why) = completed {
                        return Err(self.stop_for(why, shake, work).await);
                    }
                }
                Ok(_) => {}
                Err(why) if answered.elapsed() > self.timing.lost => {
                    let lost = self.timing.lost;
                    let why = Box::new(why);
                    let error = ModuleError::Lost { lost, why };
                    work.unknown(error.to_string()).await;
                    return Err(error);
                }
                Err(_) => {}
            }
            tokio::select! {
                biased;
                () = work.held() => {
                    let suspended = match work.is_stopped() {
                        true => Ok(Suspended::Stopped),
                        false => self.suspend(shake, work).await,
                    };
                    // The service does not run on without its skill.
                    match suspended {
                        Ok(Suspended::Resumed) => {}
                        Ok(Suspended::Stopped) => return Err(self.stop(shake, work).await),
                        Err(why) => return Err(self.stop_for(why, shake, work).await),
                    }
                    // A service that was held executes again.
                    completing = None;
                }
                () = sleep(self.timing.poll) => {}
            }
            if executes {
                executed += before.elapsed();
                show_progress(work, executed, run_time);
            }
        }
    }

    /// Completes a procedure that does not complete by itself: once, and with a time limit.
    async fn complete(
        &self,
        shake: &Handshake<'_>,
        since: &mut Option<Instant>,
    ) -> Result<(), ModuleError> {
        match *since {
            None => {
                *since = Some(Instant::now());
                shake.allowed(Command::Complete).await?;
                shake.command(Command::Complete).await
            }
            Some(since) if since.elapsed() > self.timing.handshake => {
                Err(ModuleError::CompleteIgnored)
            }
            Some(_) => Ok(()),
        }
    }

    /// Pauses or holds the service, and continues it.
    ///
    /// # Errors
    /// The service did neither.
    async fn suspend(&self, shake: &Handshake<'_>, work: &Work) -> Result<Suspended, ModuleError> {
        let can_pause = shake.allows(Command::Pause).await?;
        let (command, rest, resume) = match can_pause {
            true => (Command::Pause, State::Paused, Command::Resume),
            false => (Command::Hold, State::Held, Command::Unhold),
        };
        shake.allowed(command).await?;
        shake.command(command).await?;
        let within = (command.name(), self.timing.handshake);
        let is_at_rest = |state| matches!(state, StateWord::Known(known) if known == rest || known == State::Completed);
        let reached = shake.until(is_at_rest, within).await?;
        shake.withdraw().await?;
        if reached == StateWord::Known(State::Completed) {
            return Ok(Suspended::Resumed);
        }
        work.step(rest.name()).await;
        if work.going().await.is_err() {
            return Ok(Suspended::Stopped);
        }
        shake.allowed(resume).await?;
        shake.command(resume).await?;
        let within = (resume.name(), self.timing.handshake);
        shake
            .until(|state| state != StateWord::Known(rest), within)
            .await?;
        shake.withdraw().await?;
        Ok(Suspended::Resumed)
    }

    /// Stops the service for a reason.
    async fn stop_for(&self, why: ModuleError, shake: &Handshake<'_>, work: &Work) -> ModuleError {
        ModuleError::StoppedFor {
            why: Box::new(why),
            end: Box::new(self.stop(shake, work).await),
        }
    }

    /// Stops the service: Stop, or Abort if Stop is not allowed. Returns the reason for the end.
    async fn stop(&self, shake: &Handshake<'_>, work: &Work) -> ModuleError {
        let is_at_end = |state| {
            matches!(
                state,
                StateWord::Known(State::Stopped | State::Aborted | State::Completed | State::Idle)
            )
        };
        let end = Instant::now() + self.timing.stop;
        let mut command = Command::Stop;
        // A connection that is lost for a moment comes back.
        let sent = loop {
            let sent = match shake.state().await {
                Ok(StateWord::Known(State::Stopping | State::Aborting)) => Ok(()),
                Ok(state) if is_at_end(state) => Ok(()),
                Ok(_) => {
                    command = match shake.allows(Command::Stop).await {
                        Ok(false) => Command::Abort,
                        Ok(true) | Err(_) => Command::Stop,
                    };
                    shake.command(command).await
                }
                Err(why) => Err(why),
            };
            if sent.is_ok() || Instant::now() >= end {
                break sent;
            }
            sleep(self.timing.poll).await;
        };
        let left = end.saturating_duration_since(Instant::now());
        let within = ("the service is to be Stopped", left);
        match shake.until(is_at_end, within).await {
            Ok(state) => {
                // The end is known; a command that stays in place is removed by the next run.
                let _removed = shake.withdraw().await;
                ModuleError::Stopped { state }
            }
            Err(why) => {
                let why = Box::new(sent.err().unwrap_or(why));
                let error = ModuleError::NotStopped { command, why };
                work.unknown(error.to_string()).await;
                error
            }
        }
    }

    /// Notes parameters with an effective value other than the written value.
    async fn compare(&self, work: &Work) {
        for parameter in &self.parameters {
            let (Some(node), Some(written)) =
                (&parameter.read, work.parameters().get(&parameter.name))
            else {
                continue;
            };
            let Ok(read) = self.nodes.read(&[node]).await else {
                return;
            };
            if let Some(read) = read.into_iter().next().flatten()
                && !is_equal(written, &read)
            {
                let name = &parameter.name;
                work.note(format!(
                    "{name} has the effect {read}, and {written} was written"
                ))
                .await;
            }
        }
    }

    async fn results(&self, shake: &Handshake<'_>, work: &Work) -> Result<RunResults, ModuleError> {
        work.progress(1.0);
        // The procedure is done; a command that stays in place is removed by the next run.
        let _removed = shake.withdraw().await;
        let end = Instant::now() + self.timing.lost;
        let mut results = Vec::new();
        for output in outputs(&self.service, &self.procedure) {
            let Some(node) = &output.node else { continue };
            let value = match self.result(node, end).await {
                Ok(value) => value,
                Err(why) => {
                    let error = ModuleError::NoResult {
                        name: output.name.clone(),
                        why: Box::new(why),
                    };
                    work.unknown(error.to_string()).await;
                    return Err(error);
                }
            };
            let value = match (output.kind, value.as_f64()) {
                (mtp::ParameterKind::Analog, Some(number)) => SkillValue::Double(number),
                _ => value,
            };
            results.push((output.name.clone(), value));
        }
        Ok(results)
    }

    /// Reads a result. A connection that is lost for a moment comes back.
    async fn result(&self, node: &mtp::OpcUaNode, end: Instant) -> Result<SkillValue, ModuleError> {
        loop {
            let why = match self.nodes.read(&[node]).await {
                Ok(read) => match read.into_iter().next().flatten() {
                    Some(value) => return Ok(value),
                    None => ModuleError::ResultWithoutValue,
                },
                Err(why) => why.into(),
            };
            if Instant::now() >= end {
                return Err(why);
            }
            sleep(self.timing.poll).await;
        }
    }
}

fn show_progress(work: &Work, executed: Duration, run_time: Duration) {
    if !run_time.is_zero() {
        let share = executed.as_secs_f64() / run_time.as_secs_f64();
        // A share of 1 has enough digits.
        #[expect(clippy::cast_possible_truncation, reason = "a share from 0 to 1")]
        work.progress(share.min(1.0) as f32);
    }
}

/// Returns whether a skill has the parameter [`RUN_TIME`]: its procedure does not complete by
/// itself, and has no parameter of this name.
pub(super) fn has_run_time<'p>(
    procedure: &Procedure,
    parameters: impl IntoIterator<Item = &'p ServiceParameter>,
) -> bool {
    let mut parameters = parameters.into_iter();
    !procedure.is_self_completing && !parameters.any(|one| one.name == RUN_TIME)
}

/// The parameter of procedures that do not complete by themselves.
pub(super) const RUN_TIME: &str = "RunTime";
