//! The end of a scenario before its last step.

use std::process::ExitStatus;

use tokio::sync::mpsc;

use super::failure::Failure;
use super::interrupt::Interrupt;
use super::programs::{Programs, Report};

/// The reason why a scenario stops.
pub(crate) enum Stop {
    Failed(Failure),
    /// A step did not have the expected result.
    Broken(String),
    /// A program ended unexpectedly.
    Ended(&'static str, ExitStatus),
    Interrupted,
}

impl From<Failure> for Stop {
    fn from(failure: Failure) -> Self {
        Self::Failed(failure)
    }
}

impl Stop {
    /// Returns the failure of the scenario. `standing` describes its progress after an
    /// interruption.
    pub(crate) fn failure(self, programs: &Programs, standing: impl FnOnce() -> String) -> Failure {
        let logs = programs.directory().to_owned();
        match self {
            Self::Failed(failure) => failure,
            Self::Broken(why) => Failure::Broken { why, logs },
            Self::Ended(name, status) => Failure::ChildEnded {
                name,
                status,
                last_lines: programs.last_lines(name),
                logs,
            },
            Self::Interrupted => Failure::Interrupted {
                standing: standing(),
            },
        }
    }
}

/// Plays a scenario until it ends, a program ends unexpectedly, or a signal stops it.
pub(crate) async fn watched(
    played: impl Future<Output = Result<(), Stop>>,
    reports: &mut mpsc::Receiver<Report>,
) -> Result<(), Stop> {
    let mut interrupt = Interrupt::listen()?;
    let ended = tokio::select! {
        played = played => played,
        (name, status) = unexpected(reports) => Err(Stop::Ended(name, status)),
        () = interrupt.come() => Err(Stop::Interrupted),
    };
    // No reports are read after this point, and no process may block on sending them.
    reports.close();
    ended
}

/// Returns the first program that ends unexpectedly.
async fn unexpected(reports: &mut mpsc::Receiver<Report>) -> (&'static str, ExitStatus) {
    loop {
        match reports.recv().await {
            Some(Report::Ended { name, status }) => return (name, status),
            Some(Report::Killed { .. } | Report::Told(_) | Report::Garbled { .. }) => {}
            // The programs hold a sender, so the channel does not close before them.
            None => std::future::pending().await,
        }
    }
}

impl Programs {
    /// Ends the programs of a scenario. The logs are kept after a failure.
    pub(crate) async fn conclude(&mut self, outcome: Result<(), Failure>) -> Result<(), Failure> {
        self.end().await;
        if matches!(outcome, Ok(()) | Err(Failure::Interrupted { .. }))
            && let Err(error) = self.clean_up()
        {
            tracing::debug!(%error, "the logs were not removed");
        }
        outcome
    }
}
