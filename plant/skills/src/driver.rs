//! The interface of drivers, which do the work of skills.

use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::{mpsc, watch};

use crate::driver_error::{DriverError, InvalidParameter, Stopped};
use crate::parameters::{Parameters, SkillParameter};
use crate::value::SkillValue;

/// The results of a run, by their names in the skill type.
pub type RunResults = Vec<(String, SkillValue)>;

/// Does the work of one skill: a device, a simulation, or a composite of other skills.
///
/// [`conformance`](crate::conformance) tests the requirements.
#[async_trait]
pub trait Driver: Send + Sync + 'static {
    /// Returns whether the work can be suspended and resumed. Otherwise Suspend is refused.
    fn can_suspend(&self) -> bool {
        false
    }

    /// Returns the time after Halt during which the end of work that is done elsewhere is awaited.
    /// Such work is never aborted: the skill stays Running until the end is known. A second Halt
    /// after this time ends the run with an unknown outcome.
    ///
    /// `None` for work that is done here, which ends when its future ends.
    fn halt_timeout(&self) -> Option<Duration> {
        None
    }

    /// Checks parameters that match the type, before anything moves.
    ///
    /// # Errors
    /// [`InvalidParameter`]. The client receives BadInvalidArgument.
    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        let _any = parameters;
        Ok(())
    }

    /// Changes the given parameters of a run before they are completed by defaults and checked.
    fn prepared(
        &self,
        declared: &[SkillParameter],
        given: Vec<(String, SkillValue)>,
    ) -> Vec<(String, SkillValue)> {
        let _all = declared;
        given
    }

    /// Returns the skills of other components that do the work, as `<endpoint> <type>`, for
    /// display.
    fn uses(&self) -> Vec<String> {
        Vec::new()
    }

    /// Does the work of one run. [`Work::stopped`] completes on Halt. The driver then has one
    /// second to stop the machine; after that, the future is dropped unless there is a
    /// [`halt_timeout`](Self::halt_timeout).
    ///
    /// # Errors
    /// The reason why the work is not done. [`DriverError::Stopped`] is work that ended because of
    /// Halt, with nothing to add.
    async fn run(&self, work: Work) -> Result<RunResults, DriverError>;
}

/// A run, as its driver sees it.
#[derive(Debug, Clone)]
pub struct Work {
    run: u32,
    parameters: Parameters,
    configuration: RunResults,
    signal: watch::Receiver<Signal>,
    steps: mpsc::Sender<Line>,
    progress: watch::Sender<f32>,
}

/// A report of the driver during a run.
#[derive(Debug)]
pub(crate) enum Line {
    Step(String),
    /// A part of the step, for the trace only.
    Note(String),
    /// The work was cancelled and has not ended.
    Pending(String),
    /// The executor of the work refuses to cancel it.
    Refused(String),
    /// The end of the work, past or future, is unknown.
    Unknown(String),
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Signal {
    Go,
    StandStill,
    Stop,
}

/// The actor's end of a [`Work`].
#[derive(Debug)]
pub(crate) struct Reins {
    pub(crate) signal: watch::Sender<Signal>,
    pub(crate) steps: mpsc::Receiver<Line>,
    pub(crate) progress: watch::Receiver<f32>,
}

impl Work {
    pub(crate) fn new(run: u32, parameters: Parameters) -> (Self, Reins) {
        let (signal, signals) = watch::channel(Signal::Go);
        let (steps, steps_told) = mpsc::channel(MOST_STEPS);
        let (progress, progressed) = watch::channel(0.0);
        let work = Self {
            run,
            parameters,
            configuration: Vec::new(),
            signal: signals,
            steps,
            progress,
        };
        let reins = Reins {
            signal,
            steps: steps_told,
            progress: progressed,
        };
        (work, reins)
    }

    /// Returns the number of the run.
    #[must_use]
    pub fn run(&self) -> u32 {
        self.run
    }

    /// Returns the parameters of the run, complete and checked.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Returns the configured values of the component that act on the skill.
    #[must_use]
    pub fn configuration(&self) -> &[(String, SkillValue)] {
        &self.configuration
    }

    pub(crate) fn with_configuration(self, configuration: Vec<(String, SkillValue)>) -> Self {
        Self {
            configuration,
            ..self
        }
    }

    /// Reports the current step of the run. Waits while the queue of reports is full; no step is
    /// dropped.
    pub async fn step(&self, step: impl Into<String>) {
        self.say(Line::Step(step.into())).await;
    }

    /// Adds a line to the trace of the run.
    pub async fn note(&self, what: impl Into<String>) {
        self.say(Line::Note(what.into())).await;
    }

    /// Reports that the work is being cancelled, and why it has not ended.
    pub async fn pending(&self, why: impl Into<String>) {
        self.say(Line::Pending(why.into())).await;
    }

    /// Reports that the executor refuses to cancel the work: the work goes on.
    pub async fn cancel_refused(&self, why: impl Into<String>) {
        self.say(Line::Refused(why.into())).await;
    }

    /// Reports that the end of the work is unknown and may stay unknown. The skill cannot be
    /// started before a Reset.
    pub async fn unknown(&self, why: impl Into<String>) {
        self.say(Line::Unknown(why.into())).await;
    }

    /// Returns whether the run is to end without finishing its work.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        *self.signal.borrow() == Signal::Stop
    }

    async fn say(&self, line: Line) {
        tokio::select! {
            biased;
            // The receiver is dropped with the skill; `stopped` completes then too.
            _told = self.steps.send(line) => {}
            () = self.stopped() => {}
        }
    }

    /// Reports the progress, from 0 to 1. Newer values replace older values.
    pub fn progress(&self, done: f32) {
        let done = if done.is_finite() {
            done.clamp(0.0, 1.0)
        } else {
            0.0
        };
        self.progress.send_replace(done);
    }

    /// Completes when the run is to end without finishing its work.
    pub async fn stopped(&self) {
        // Without the skill, the run is stopped too.
        let mut signal = self.signal.clone();
        let _stopped_or_alone = signal.wait_for(|signal| *signal == Signal::Stop).await;
    }

    /// Completes while the work may go on: immediately, or when a suspended run is resumed.
    ///
    /// # Errors
    /// [`Stopped`].
    pub async fn going(&self) -> Result<(), Stopped> {
        let mut signal = self.signal.clone();
        let signal = signal
            .wait_for(|signal| *signal != Signal::StandStill)
            .await;
        match signal.map(|signal| *signal) {
            Ok(Signal::Go) => Ok(()),
            Ok(Signal::Stop | Signal::StandStill) | Err(_) => Err(Stopped),
        }
    }

    /// Waits for `time`, not counting the time in which the run is suspended.
    ///
    /// # Errors
    /// [`Stopped`].
    pub async fn spend(&self, time: Duration) -> Result<(), Stopped> {
        let mut left = time;
        loop {
            self.going().await?;
            if left.is_zero() {
                return Ok(());
            }
            let began = tokio::time::Instant::now();
            tokio::select! {
                () = tokio::time::sleep(left) => return self.going().await,
                () = self.held() => left = left.saturating_sub(began.elapsed()),
            }
        }
    }

    /// Completes when the run is suspended or stopped: the machine has to stop.
    /// [`going`](Self::going) then distinguishes the two cases.
    pub async fn held(&self) {
        let mut signal = self.signal.clone();
        let _held_or_alone = signal.wait_for(|signal| *signal != Signal::Go).await;
    }
}

/// Maximum number of waiting reports.
pub(crate) const MOST_STEPS: usize = 64;
