//! When a child process ends: on a signal, or when the demo that started it is gone.

use std::io;
use std::time::Duration;

use rustix::process::{Pid, getppid};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::time::{Interval, interval};

/// Waits for the reason to end.
pub(crate) struct Stop {
    terminate: Signal,
    interrupt: Signal,
    parent: Option<Pid>,
    look: Interval,
}

impl Stop {
    pub(crate) fn new() -> io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            parent: getppid(),
            look: interval(Duration::from_millis(500)),
        })
    }

    /// Returns when it is time to end. Cancel-safe.
    pub(crate) async fn wait(&mut self) {
        loop {
            tokio::select! {
                _ = self.terminate.recv() => return,
                _ = self.interrupt.recv() => return,
                // A killed demo tells nobody; its children get another parent.
                _ = self.look.tick() => if getppid() != self.parent { return },
            }
        }
    }
}
