//! Time as in ROS messages, and the clock of a node.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::clock;
use crate::inbox::{ConnectionPeer, Deliver, InboxMessage};

/// A point in time, as the `time` of a message: since the Unix epoch, or since the start of a
/// simulation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Ros1Time {
    /// Whole seconds.
    pub secs: u32,
    /// The rest in nanoseconds, below 1 000 000 000.
    pub nsecs: u32,
}

impl Ros1Time {
    /// Converts a wall clock time. A time outside the 136 years of ROS time becomes the nearer
    /// limit.
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

/// The clock of a node: the wall clock, or the simulated clock of `/clock` while the parameter
/// `/use_sim_time` is true (`wiki.ros.org/Clock`).
///
/// The clock is for the contents of messages. Simulated time stops and jumps back at the will of
/// its publisher, so time limits, the supervision of the master and reconnecting never use it. A
/// `/clock` that this very node publishes is not received, as no node receives its own messages.
#[derive(Clone, Debug, Default)]
pub struct Ros1Clock {
    simulation: Arc<Simulation>,
}

#[derive(Debug, Default)]
struct Simulation {
    runs: AtomicBool,
    /// Seconds in the upper half, nanoseconds in the lower: both change at once.
    time: AtomicU64,
    malformed: AtomicU64,
}

impl Ros1Clock {
    /// Returns the current time. Simulated time is the last received time, and zero before the
    /// first.
    pub fn now(&self) -> Ros1Time {
        if !self.is_simulated() {
            return Ros1Time::from_system(clock::utc());
        }
        let [a, b, c, d, e, f, g, h] = self.simulation.time.load(Ordering::Acquire).to_be_bytes();
        Ros1Time {
            secs: u32::from_be_bytes([a, b, c, d]),
            nsecs: u32::from_be_bytes([e, f, g, h]),
        }
    }

    /// Returns whether the time comes from `/clock`.
    pub fn is_simulated(&self) -> bool {
        self.simulation.runs.load(Ordering::Acquire)
    }

    /// Returns the number of invalid messages of `/clock` since the start.
    pub fn malformed(&self) -> u64 {
        self.simulation.malformed.load(Ordering::Relaxed)
    }

    /// Switches to simulated time, which starts at zero, or back to the wall clock. Returns whether
    /// the source has changed.
    pub(crate) fn simulate(&self, simulated: bool) -> bool {
        if self.is_simulated() == simulated {
            return false;
        }
        self.simulation.time.store(0, Ordering::Release);
        self.simulation.runs.store(simulated, Ordering::Release);
        true
    }

    fn set(&self, clock: &[u8]) {
        // `rosgraph_msgs/Clock` is one `time`: seconds, nanoseconds.
        if let Ok([a, b, c, d, e, f, g, h]) = <[u8; 8]>::try_from(clock) {
            let secs = u32::from_le_bytes([a, b, c, d]);
            let nsecs = u32::from_le_bytes([e, f, g, h]);
            if nsecs < 1_000_000_000 {
                let time = u64::from(secs) << 32 | u64::from(nsecs);
                self.simulation.time.store(time, Ordering::Release);
                return;
            }
        }
        self.simulation.malformed.fetch_add(1, Ordering::Relaxed);
    }
}

/// The messages of `/clock` are passed directly to the clock: nothing is queued, and only the
/// newest message matters.
impl Deliver for Ros1Clock {
    fn message(&self, message: InboxMessage) -> u64 {
        self.set(&message.bytes);
        0
    }

    fn peer(&self, _connected: bool, _publishers: usize, _peer: Arc<ConnectionPeer>) {}

    fn close(&self) {}
}

/// The type of `/clock`.
pub(crate) const CLOCK_TYPE: &str = "rosgraph_msgs/Clock";
pub(crate) const CLOCK_MD5: &str = "a9c97c1d230cfc112e270351a944ee47";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_simulated_clock_begins_at_zero_and_goes_where_it_is_told() {
        let clock = Ros1Clock::default();
        assert!(clock.now().secs > 1_700_000_000);
        assert!(clock.simulate(true) && !clock.simulate(true));
        assert_eq!(clock.now(), Ros1Time::default());
        for (secs, nsecs) in [(7_u32, 999_999_999_u32), (3, 0)] {
            clock.set(&[secs.to_le_bytes(), nsecs.to_le_bytes()].concat());
            assert_eq!(clock.now(), Ros1Time { secs, nsecs });
        }
        assert!(clock.simulate(false));
        assert!(clock.now().secs > 1_700_000_000);
    }

    #[test]
    fn a_clock_message_that_says_no_time_is_counted_and_not_taken() {
        let clock = Ros1Clock::default();
        assert!(clock.simulate(true));
        clock.set(&[1, 0, 0, 0, 0, 0, 0]);
        clock.set(&[[1, 0, 0, 0], 1_000_000_000_u32.to_le_bytes()].concat());
        assert_eq!((clock.now(), clock.malformed()), (Ros1Time::default(), 2));
    }

    #[test]
    fn the_wall_clock_reads_as_seconds_and_nanoseconds() {
        let at = UNIX_EPOCH + Duration::new(1_700_000_000, 5);
        let read = Ros1Time::from_system(at);
        assert_eq!((read.secs, read.nsecs), (1_700_000_000, 5));
        assert_eq!(
            Ros1Time::from_system(UNIX_EPOCH - Duration::from_secs(1)),
            Ros1Time::default()
        );
    }
}
