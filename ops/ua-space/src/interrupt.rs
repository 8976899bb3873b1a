//! The signals by which users end a command.

use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::exit::CommandFailure;

/// SIGINT and SIGTERM, which do not end the process while this value exists.
#[derive(Debug)]
pub(crate) struct SignalGuard {
    interrupt: Signal,
    terminate: Signal,
}

impl SignalGuard {
    /// Catches the signals from here on.
    ///
    /// # Errors
    /// [`CommandFailure::Io`] if the signals cannot be caught.
    pub(crate) fn catch() -> Result<Self, CommandFailure> {
        let on = |kind| {
            signal(kind)
                .map_err(|error| CommandFailure::Io(format!("cannot catch signals: {error}")))
        };
        Ok(Self {
            interrupt: on(SignalKind::interrupt())?,
            terminate: on(SignalKind::terminate())?,
        })
    }

    /// Waits for a signal. Dropping the future loses none.
    pub(crate) async fn received(&mut self) {
        tokio::select! {
            biased;
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}
