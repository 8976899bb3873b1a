//! Who does the work of a skill.

use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::{mpsc, watch};

use crate::parameters::Parameters;
use crate::value::Value;

/// What a run says at its end: the results of the skill's type by their names.
pub type Results = Vec<(String, Value)>;

/// Does the work of one skill: a device, a simulation, or a composite of other skills.
///
/// What keeps to this is checked by [`conformance`](crate::conformance).
#[async_trait]
pub trait Driver: Send + Sync + 'static {
    /// Whether the work can stand still and go on. Without it Suspend is refused.
    fn can_suspend(&self) -> bool {
        false
    }

    /// How long the end of work that is done elsewhere is waited for after Halt. Such work is never broken off before: the
    /// skill stays Running until its end is known, and a second Halt after this time ends it with an unknown outcome. `None`
    /// for work that is done here, which ends with its future.
    fn halt_timeout(&self) -> Option<Duration> {
        None
    }

    /// Looks at parameters that fit the type, before anything moves.
    ///
    /// # Errors
    /// What is wrong with them, beginning with the name of one: the client is refused with BadInvalidArgument.
    fn check(&self, parameters: &Parameters) -> Result<(), String> {
        let _any = parameters;
        Ok(())
    }

    /// The skills of other components that its work is done with, as `<endpoint> <type>`, for people to see.
    fn uses(&self) -> Vec<String> {
        Vec::new()
    }

    /// Does the work of one run. It is told of Halt by [`Work::stopped`], and has a second to bring the machine to a stand;
    /// then the future is dropped, unless there is a [`halt_timeout`](Self::halt_timeout).
    ///
    /// # Errors
    /// Why the work is not done, for people.
    async fn run(&self, work: Work) -> Result<Results, String>;
}

/// One run, as its driver sees it.
#[derive(Debug, Clone)]
pub struct Work {
    run: u32,
    parameters: Parameters,
    signal: watch::Receiver<Signal>,
    steps: mpsc::Sender<Line>,
    progress: watch::Sender<f32>,
}

/// What is said of the way of a run.
#[derive(Debug)]
pub(crate) enum Line {
    Step(String),
    /// Of a part of the step, for the trace only.
    Note(String),
    /// The work was cancelled, and has not ended.
    Pending(String),
    /// Whoever does the work refuses to cancel it.
    Refused(String),
    /// How the work ends, or has ended, is not known.
    Unknown(String),
}

/// The work was stopped by Halt, Reset, or the end of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("stopped")]
pub struct Stopped;

impl From<Stopped> for String {
    fn from(stopped: Stopped) -> Self {
        stopped.to_string()
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Signal {
    Go,
    StandStill,
    Stop,
}

/// The other end of a [`Work`].
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

    /// The number of the run.
    #[must_use]
    pub fn run(&self) -> u32 {
        self.run
    }

    /// What it was started with, complete and checked.
    #[must_use]
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// Says what the run is about now. Waits while too much of that is not told yet; no step is left out.
    pub async fn step(&self, step: impl Into<String>) {
        self.say(Line::Step(step.into())).await;
    }

    /// Puts something that was done on the way into the trace of the run.
    pub async fn note(&self, what: impl Into<String>) {
        self.say(Line::Note(what.into())).await;
    }

    /// Reports that the work is being cancelled, and why it has not ended.
    pub async fn pending(&self, why: impl Into<String>) {
        self.say(Line::Pending(why.into())).await;
    }

    /// Reports that whoever does the work refuses to cancel it: the work goes on.
    pub async fn cancel_refused(&self, why: impl Into<String>) {
        self.say(Line::Refused(why.into())).await;
    }

    /// Reports that the end of the work is not known, and may never be. The skill is not started again before a Reset.
    pub async fn unknown(&self, why: impl Into<String>) {
        self.say(Line::Unknown(why.into())).await;
    }

    /// Whether the run is to end without its work being done.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        *self.signal.borrow() == Signal::Stop
    }

    async fn say(&self, line: Line) {
        tokio::select! {
            biased;
            // Nobody is left to be told where the skill is gone, and `stopped` says so.
            _told = self.steps.send(line) => {}
            () = self.stopped() => {}
        }
    }

    /// Says how much is done, from 0 to 1. Of several the newest counts.
    pub fn progress(&self, done: f32) {
        let done = if done.is_finite() {
            done.clamp(0.0, 1.0)
        } else {
            0.0
        };
        self.progress.send_replace(done);
    }

    /// Ready when the run is to end without its work being done.
    pub async fn stopped(&self) {
        // Without the skill there is nobody who could want it to go on.
        let mut signal = self.signal.clone();
        let _stopped_or_alone = signal.wait_for(|signal| *signal == Signal::Stop).await;
    }

    /// Ready while the work may go on: at once, or when a suspended run is resumed.
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

    /// Waits while work goes on: time in which the run is suspended does not count.
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

    /// Ready when the run is suspended or stopped: what moves has to be brought to a stand. [`going`](Self::going) then says
    /// which of the two it is.
    pub async fn held(&self) {
        let mut signal = self.signal.clone();
        let _held_or_alone = signal.wait_for(|signal| *signal != Signal::Go).await;
    }
}

/// So many steps may wait to be told.
const MOST_STEPS: usize = 64;
