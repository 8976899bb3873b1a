//! What a text ends with: 8 digits of a topic, 12 of a number, and 16 of when it was sent, as the peers in C++ write it.

use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

/// Which text it is, and when it was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// The number of its topic among those of its sender, from 0.
    pub topic: usize,
    /// Counted by its sender.
    pub number: u64,
    /// On the machine's monotonic clock.
    pub sent: Duration,
}

impl Stamp {
    /// A text of `size` characters with a stamp of now.
    #[must_use]
    pub fn text(topic: usize, number: u64, size: usize) -> String {
        let padding = size.saturating_sub(LENGTH);
        let sent = now().as_nanos();
        format!("{:.<padding$}{topic:08}{number:012}{sent:016}", "")
    }

    /// That of a text's end, if it has one.
    #[must_use]
    pub fn of(text: &[u8]) -> Option<Self> {
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
///
/// # Panics
/// When there is none.
#[must_use]
pub fn now() -> Duration {
    clock_gettime(ClockId::CLOCK_MONOTONIC).unwrap().into()
}

const LENGTH: usize = 36;
