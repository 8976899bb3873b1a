//! The end of a scenario before its last step.

use std::process::ExitStatus;

use tokio::sync::mpsc;

use super::failure::DemoFailure;
use super::interrupt::Interrupt;
use super::programs::{ChildReport, RunningPrograms};

/// The reason why a scenario stops.
pub(crate) enum StopReason {
    Failed(DemoFailure),
    /// A step did not have the expected result.
    Broken(String),
    /// A program ended unexpectedly.
    Ended(&'static str, ExitStatus),
    Interrupted,
}

impl From<DemoFailure> for StopReason {
    fn from(failure: DemoFailure) -> Self {
        Self::Failed(failure)
    }
}

impl StopReason {
    /// Returns the failure of the scenario. `standing` describes its progress after an
    /// interruption.
    pub(crate) fn failure(
        self,
        programs: &RunningPrograms,
        standing: impl FnOnce() -> String,
    ) -> DemoFailure {
        let logs = programs.directory().to_owned();
        match self {
            Self::Failed(failure) => failure,
            Self::Broken(why) => DemoFailure::Broken { why, logs },
            Self::Ended(name, status) => DemoFailure::ChildEnded {
                name,
                status,
                last_lines: programs.last_lines(name),
                logs,
            },
            Self::Interrupted => DemoFailure::Interrupted {
                standing: standing(),
            },
        }
    }
}

/// Plays a scenario until it ends, a program ends unexpectedly, or a signal stops it.
pub(crate) async fn watched(
    played: impl Future<Output = Result<(), StopReason>>,
    reports: &mut mpsc::Receiver<ChildReport>,
) -> Result<(), StopReason> {
    let mut interrupt = Interrupt::listen()?;
    let ended = tokio::select! {
        played = played => played,
        (name, status) = unexpected(reports) => Err(StopReason::Ended(name, status)),
        () = interrupt.come() => Err(StopReason::Interrupted),
    };
    // No reports are read after this point, and no process may block on sending them.
    reports.close();
    ended
}

/// Returns the first program that ends unexpectedly.
async fn unexpected(reports: &mut mpsc::Receiver<ChildReport>) -> (&'static str, ExitStatus) {
    loop {
        match reports.recv().await {
            Some(ChildReport::Ended { name, status }) => return (name, status),
            Some(
                ChildReport::Killed { .. } | ChildReport::Told(_) | ChildReport::Garbled { .. },
            ) => {}
            // The programs hold a sender, so the channel does not close before them.
            None => std::future::pending().await,
        }
    }
}

impl RunningPrograms {
    /// Ends the programs of a scenario. The logs are kept after a failure.
    pub(crate) async fn conclude(
        &mut self,
        outcome: Result<(), DemoFailure>,
    ) -> Result<(), DemoFailure> {
        self.end().await;
        if matches!(outcome, Ok(()) | Err(DemoFailure::Interrupted { .. }))
            && let Err(error) = self.clean_up()
        {
            tracing::debug!(%error, "the logs were not removed");
        }
        outcome
    }
}
