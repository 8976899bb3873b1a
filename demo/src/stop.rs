//! The end of a child process: on a signal, or when its parent process has ended.

use std::io;
use std::time::Duration;

use rustix::process::{Pid, getppid};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::time::{Interval, interval};

/// Waits for a reason to end.
pub(crate) struct EndSignal {
    terminate: Signal,
    interrupt: Signal,
    parent: Option<Pid>,
    look: Interval,
}

impl EndSignal {
    pub(crate) fn new() -> io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            parent: getppid(),
            look: interval(Duration::from_millis(500)),
        })
    }

    /// Returns when the process has to end. Cancel-safe.
    pub(crate) async fn wait(&mut self) {
        loop {
            tokio::select! {
                _ = self.terminate.recv() => return,
                _ = self.interrupt.recv() => return,
                // A killed demo does not signal its children, but they get another parent.
                _ = self.look.tick() => if getppid() != self.parent { return },
            }
        }
    }
}
