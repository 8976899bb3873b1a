//! What a text ends with: 8 digits of a topic, 12 of a number, and 16 of when it was sent, as the peers in C++ write it.

use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Stamp {
    pub(crate) topic: usize,
    pub(crate) number: u64,
    /// On the machine's monotonic clock.
    pub(crate) sent: Duration,
}

impl Stamp {
    /// A text of `size` characters with a stamp of now.
    pub(crate) fn text(topic: usize, number: u64, size: usize) -> String {
        let padding = size.saturating_sub(LENGTH);
        let sent = now().as_nanos();
        format!("{:.<padding$}{topic:08}{number:012}{sent:016}", "")
    }

    /// That of a text's end, if it has one.
    pub(crate) fn of(text: &[u8]) -> Option<Self> {
        let (_, stamp) = text.split_last_chunk::<LENGTH>()?;
        let stamp = std::str::from_utf8(stamp).ok()?;
        Some(Self {
            topic: stamp.get(..8)?.parse().ok()?,
            number: stamp.get(8..20)?.parse().ok()?,
            sent: Duration::from_nanos(stamp.get(20..)?.parse().ok()?),
        })
    }
}

/// The machine's monotonic clock, which all processes share.
pub(crate) fn now() -> Duration {
    clock_gettime(ClockId::CLOCK_MONOTONIC).unwrap().into()
}

const LENGTH: usize = 36;
