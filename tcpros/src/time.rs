//! Time as ROS messages carry it.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// A point in time, as the `time` of a message: since the Unix epoch, or since the start of a simulation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RosTime {
    /// Whole seconds.
    pub secs: u32,
    /// The rest in nanoseconds, below 1 000 000 000.
    pub nsecs: u32,
}

impl RosTime {
    /// Reads the wall clock. What lies outside the 136 years a ROS time can say becomes the nearer end.
    pub fn from_system(time: SystemTime) -> Self {
        let since = time.duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO);
        u32::try_from(since.as_secs()).map_or(
            Self {
                secs: u32::MAX,
                nsecs: 999_999_999,
            },
            |secs| Self {
                secs,
                nsecs: since.subsec_nanos(),
            },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wall_clock_reads_as_seconds_and_nanoseconds() {
        let at = UNIX_EPOCH + Duration::new(1_700_000_000, 5);
        let read = RosTime::from_system(at);
        assert_eq!((read.secs, read.nsecs), (1_700_000_000, 5));
        assert_eq!(
            RosTime::from_system(UNIX_EPOCH - Duration::from_secs(1)),
            RosTime::default()
        );
    }
}
