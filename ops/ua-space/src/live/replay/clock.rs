//! The times of a recording in the present.

use uadp::{DateTime, Timestamp};

/// Converts times of a recording to the present. Equal times stay equal and keep their order, so
/// that receivers recognise repetitions.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReplayClock {
    /// The time of the first message of the recording, in nanoseconds since 1970.
    recorded: i128,
    /// The time at which the first message is sent.
    sent: i128,
    speed: f64,
}

impl ReplayClock {
    pub(super) const fn new(recorded: i128, sent: i128, speed: f64) -> Self {
        Self {
            recorded,
            sent,
            speed,
        }
    }

    /// Returns the time in nanoseconds since 1970.
    pub(super) fn moved(&self, time: DateTime) -> i128 {
        self.at(Timestamp::from(time).unix_nanos())
    }

    /// Returns the time at which a message that arrived at `recorded` is sent.
    pub(super) fn at(&self, recorded: i128) -> i128 {
        let since = recorded - self.recorded;
        self.sent + slower(since, self.speed)
    }
}

/// Returns a duration at the given speed. The normal speed loses no nanosecond.
#[expect(
    clippy::float_cmp,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    reason = "the default is exact; other speeds need no nanosecond"
)]
fn slower(nanos: i128, speed: f64) -> i128 {
    if speed == 1.0 {
        nanos
    } else {
        (nanos as f64 / speed) as i128
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_are_kept_or_scaled() {
        let normal = ReplayClock::new(1_000, 9_000_000_000_000_000_001, 1.0);
        assert_eq!(normal.at(1_007), 9_000_000_000_000_000_008);
        assert_eq!(normal.at(900), 8_999_999_999_999_999_901);
        let fast = ReplayClock::new(1_000, 5_000, 2.0);
        assert_eq!((fast.at(1_000), fast.at(3_000)), (5_000, 6_000));
    }
}
