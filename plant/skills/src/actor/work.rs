//! The work of a run: its task, its reports, its time limits and its end.

use std::any::Any;
use std::future::pending;
use std::sync::Arc;
use std::time::Duration;

use program::RunId;
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Instant, sleep_until};

use super::order::SkillCallRequest;
use crate::driver::{Driver, Line, Reins, RunResults, Work};
use crate::driver_error::DriverError;

/// The work of a run, kept until the work has ended.
pub(super) struct Running {
    pub(super) run: RunId,
    pub(super) task: JoinHandle<Result<RunResults, DriverError>>,
    pub(super) reins: Reins,
    /// Time limit of the run.
    pub(super) within: Option<Duration>,
    pub(super) began: Instant,
    /// Time at which the run times out, while it is Running and has a limit.
    pub(super) deadline: Option<Instant>,
    /// Remaining time of the run, measured when it was suspended.
    left: Option<Duration>,
    /// Result of work that ended while the run was suspended. It is applied when the run is
    /// resumed.
    pub(super) ended: Option<Result<RunResults, RunFailure>>,
    /// Set after a stop request to work that is done elsewhere, until that work ends.
    pub(super) halting: Option<Halting>,
    /// Reason why the end of the work is unknown. The end may never become known.
    pub(super) unknown: Option<String>,
}

/// A run that is about to start.
pub(super) struct Started {
    pub(super) run: RunId,
    pub(super) work: Work,
    pub(super) reins: Reins,
}

impl Running {
    /// Starts the work of a run.
    pub(super) fn new(started: Started, driver: Arc<dyn Driver>, within: Option<Duration>) -> Self {
        let Started { run, work, reins } = started;
        let began = Instant::now();
        Self {
            run,
            task: tokio::spawn(async move { driver.run(work).await }),
            reins,
            within,
            began,
            deadline: within.map(|within| began + within),
            left: None,
            ended: None,
            halting: None,
            unknown: None,
        }
    }

    /// Stops the time limit of the run.
    pub(super) fn suspend(&mut self) {
        let deadline = self.deadline.take();
        self.left = deadline.map(|deadline| deadline.saturating_duration_since(Instant::now()));
    }

    /// Continues the time limit of the run. Returns the result of work that ended meanwhile.
    pub(super) fn resume(&mut self) -> Option<Result<RunResults, RunFailure>> {
        self.deadline = self.left.take().map(|left| Instant::now() + left);
        self.ended.take()
    }

    /// Returns the next waiting report.
    pub(super) fn report(&mut self) -> Option<Line> {
        self.reins.steps.try_recv().ok()
    }
}

/// State of a run that is done elsewhere between the stop request and the end of its work.
pub(super) struct Halting {
    /// Reason of the stop, as text for the outcome.
    pub(super) message: String,
    pub(super) then: Then,
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

pub(super) enum WorkEvent {
    Call(SkillCallRequest),
    Line(Line),
    Progress(f32),
    Ended(Result<RunResults, RunFailure>),
    Late,
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
pub(super) enum RunFailure {
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
}

/// Returns the next event of the work. Pends while there is no work.
pub(super) async fn happens(work: &mut Option<Running>) -> WorkEvent {
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
        Some(line) = reins.steps.recv() => WorkEvent::Line(line),
        ended = task => WorkEvent::Ended(outcome_of(ended, unknown)),
        Ok(()) = reins.progress.changed() => WorkEvent::Progress(*reins.progress.borrow_and_update()),
        () = late => WorkEvent::Late,
    }
}

/// Returns the result of ended work. A driver that panicked has not stopped its machine: `unknown`
/// then receives the reason.
pub(super) fn outcome_of(
    ended: Result<Result<RunResults, DriverError>, JoinError>,
    unknown: &mut Option<String>,
) -> Result<RunResults, RunFailure> {
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
