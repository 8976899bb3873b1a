//! The stamp at the end of a text, as the peers in C++ write it: 8 digits of a topic, 12 of a
//! number, and 16 of the time of sending.

use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

/// The topic, the number and the time of sending of a text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TextStamp {
    /// The index of the topic among the topics of its sender, from 0.
    pub topic: usize,
    /// The number, counted by the sender.
    pub number: u64,
    /// The time of sending on the machine's monotonic clock.
    pub sent: Duration,
}

impl TextStamp {
    /// Returns a text of `size` characters with a stamp of the current time.
    #[must_use]
    pub fn text(topic: usize, number: u64, size: usize) -> String {
        let padding = size.saturating_sub(LENGTH);
        let sent = now().as_nanos();
        format!("{:.<padding$}{topic:08}{number:012}{sent:016}", "")
    }

    /// Writes a stamp of the current time over the end of a text. Large texts are made once.
    pub fn renew(text: &mut [u8], number: u64) {
        if let Some((_, stamp)) = text.split_last_chunk_mut::<LENGTH>() {
            stamp.copy_from_slice(Self::text(0, number, LENGTH).as_bytes());
        }
    }

    /// Reads the stamp at the end of a text, if there is a stamp.
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

/// Returns the machine's monotonic clock, which all processes share.
///
/// # Panics
/// Panics if the system has no monotonic clock.
#[must_use]
pub fn now() -> Duration {
    clock_gettime(ClockId::CLOCK_MONOTONIC).unwrap().into()
}

const LENGTH: usize = 36;
