//! The wall clock of programs, set by a test.

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::PathBuf;

use crate::cell::{CLOCK, Cell, compiled};
use crate::child::StartedChild;

/// A wall clock that runs at the speed of the machine's clock with an offset.
#[derive(Debug)]
pub struct WallClock {
    path: PathBuf,
    file: File,
}

impl Cell {
    /// Creates a clock without offset. Needs [`Peer::Clock`](crate::Peer::Clock).
    #[must_use]
    pub fn wall_clock(&self) -> WallClock {
        let path = self.file("clock", "\0\0\0\0\0\0\0\0");
        let file = File::options().write(true).open(&path).unwrap();
        WallClock { path, file }
    }
}

impl WallClock {
    /// Sets the offset to `ahead` seconds; the clock jumps.
    pub fn set(&self, ahead: i64) {
        let shift = (ahead * 1_000_000_000).to_ne_bytes();
        self.file.write_all_at(&shift, 0).unwrap();
    }
}

impl StartedChild {
    /// Runs the process with that clock.
    #[must_use]
    pub fn by(self, clock: &WallClock) -> Self {
        self.env("LD_PRELOAD", compiled(CLOCK))
            .env("UA_CLOCK_SHIFT", &clock.path)
    }
}
