//! The signals by which users end a command.

use tokio::signal::unix::{Signal, SignalKind, signal};

use crate::exit::Failure;

/// SIGINT and SIGTERM, which do not end the process while this value exists.
#[derive(Debug)]
pub(crate) struct Interrupt {
    interrupt: Signal,
    terminate: Signal,
}

impl Interrupt {
    /// Catches the signals from here on.
    ///
    /// # Errors
    /// [`Failure::Io`] if the signals cannot be caught.
    pub(crate) fn catch() -> Result<Self, Failure> {
        let on = |kind| {
            signal(kind).map_err(|error| Failure::Io(format!("cannot catch signals: {error}")))
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
