//! The run in progress: its time limits, its end, and the stop of its work.

use std::time::Duration;

use program::RunId;
use tokio::time::Instant;

use super::call::Caller;
use crate::driver::RunResults;
use crate::driver_error::DriverError;

/// The result of the work of a run.
pub(crate) type WorkEnd = Result<RunResults, RunFailure>;

/// The work of a run, kept until the work has ended.
pub(super) struct RunState {
    pub(super) run: RunId,
    /// Time limit of the run.
    within: Option<Duration>,
    pub(super) began: Instant,
    /// Time at which the run times out, while it is Running and has a limit.
    deadline: Option<Instant>,
    /// Remaining time of the run, measured when it was suspended.
    left: Option<Duration>,
    /// Result of work that ended while the run was suspended. It is applied when the run is
    /// resumed.
    pub(super) ended: Option<WorkEnd>,
    /// Set after a stop request to work that is done elsewhere, until that work ends.
    pub(super) halting: Option<Halting>,
    /// Reason why the end of the work is unknown. The end may never become known.
    pub(super) unknown: Option<String>,
}

impl RunState {
    pub(super) fn new(run: RunId, within: Option<Duration>, now: Instant) -> Self {
        Self {
            run,
            within,
            began: now,
            // A limit beyond the range of the clock is no limit.
            deadline: within.and_then(|within| now.checked_add(within)),
            left: None,
            ended: None,
            halting: None,
            unknown: None,
        }
    }

    /// Stops the time limit of the run.
    pub(super) fn suspend(&mut self, now: Instant) {
        let deadline = self.deadline.take();
        self.left = deadline.map(|deadline| deadline.saturating_duration_since(now));
    }

    /// Continues the time limit of the run. Returns the result of work that ended meanwhile.
    pub(super) fn resume(&mut self, now: Instant) -> Option<WorkEnd> {
        self.deadline = self.left.take().and_then(|left| now.checked_add(left));
        self.ended.take()
    }

    /// Returns the time at which the run times out. A run that is being stopped does not time out.
    pub(super) fn deadline(&self) -> Option<Instant> {
        self.deadline.filter(|_| self.halting.is_none())
    }

    /// Ends the time limit. Returns it.
    pub(super) fn exceed(&mut self) -> Duration {
        self.deadline = None;
        self.within.unwrap_or_default()
    }

    /// Returns `None` if the run is not being stopped, otherwise whether the next Halt ends it with
    /// an unknown outcome.
    pub(super) fn is_halting(&self, now: Instant) -> Option<bool> {
        let halting = self.halting.as_ref()?;
        Some(self.unknown.is_some() || halting.over <= now)
    }
}

/// State of a run that is done elsewhere between the stop request and the end of its work.
pub(super) struct Halting {
    /// Reason of the stop, as text for the outcome.
    pub(super) message: String,
    pub(super) then: Then,
    /// Whether the run exceeded its time limit. Its stop is not withdrawn by a refusal.
    pub(super) is_late: bool,
    /// From this time on, a second Halt ends the run with an unknown outcome.
    pub(super) over: Instant,
}

/// The transition after the end of a stopped run.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Then {
    /// To Halted, regardless of the result.
    Halt,
    /// The usual transition at the end of a run. The run fails if its work is not done.
    End,
}

/// A stop of the work that has not been confirmed. Calls wait meanwhile.
pub(super) struct StopInProgress<R> {
    pub(super) cause: StopCause,
    /// Reason of the stop, as text for the outcome.
    pub(super) message: String,
    /// The caller that waits for the stop; `None` for a time limit and for the end of the
    /// component.
    pub(super) caller: Option<Caller<R>>,
    /// Whether the work was aborted, because it did not react to the stop request.
    pub(super) is_aborted: bool,
    /// Time at which the phase ends.
    pub(super) until: Instant,
}

/// The cause of a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StopCause {
    Halt,
    /// Reset of a suspended run.
    Reset,
    /// The run exceeded its time limit.
    Late,
    /// Halt of a run whose work is done elsewhere and does not end, or may not end.
    GiveUp,
}

/// The reaction of work to a stop request.
pub(super) enum Stop {
    /// The work finished.
    Done(RunResults),
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
pub(crate) enum RunFailure {
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
    pub(super) fn after(self, message: String) -> Self {
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

    /// Returns whether the driver has not stopped its machine.
    pub(super) const fn is_unknown(&self) -> bool {
        matches!(self, Self::Panicked { .. } | Self::Aborted)
    }
}
