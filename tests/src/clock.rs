//! The wall clock of programs, which a test sets.

use std::fs::File;
use std::os::unix::fs::FileExt as _;
use std::path::PathBuf;

use crate::cell::{CLOCK, Cell, compiled};
use crate::child::Started;

/// A wall clock that goes as the machine's, so much ahead of it or behind.
#[derive(Debug)]
pub struct WallClock {
    path: PathBuf,
    file: File,
}

impl Cell {
    /// A clock that is right. Needs [`Peer::Clock`](crate::Peer::Clock).
    #[must_use]
    pub fn wall_clock(&self) -> WallClock {
        let path = self.file("clock", "\0\0\0\0\0\0\0\0");
        let file = File::options().write(true).open(&path).unwrap();
        WallClock { path, file }
    }
}

impl WallClock {
    /// It jumps: so many seconds ahead from now on.
    pub fn set(&self, ahead: i64) {
        let shift = (ahead * 1_000_000_000).to_ne_bytes();
        self.file.write_all_at(&shift, 0).unwrap();
    }
}

impl Started {
    /// The process lives by that clock.
    #[must_use]
    pub fn by(self, clock: &WallClock) -> Self {
        self.env("LD_PRELOAD", compiled(CLOCK))
            .env("UA_CLOCK_SHIFT", &clock.path)
    }
}
