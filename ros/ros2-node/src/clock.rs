//! The clock of the node: the wall clock, or the simulated time of `/clock`.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// The clock of a node: the wall clock, or with `use_sim_time` the time of `/clock`, which is zero
/// until the first message (design.ros2.org, "Clock and Time").
///
/// The clock provides stamps of messages. Simulated time can stop and jump, so timeouts never use
/// it.
#[derive(Debug, Clone, Default)]
pub struct Ros2Clock(Arc<Simulation>);

/// A time in the format of `builtin_interfaces/Time`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Ros2Time {
    /// Whole seconds since 1970, or since the start of the simulation.
    pub sec: i32,
    /// The remainder in nanoseconds, below 1 000 000 000.
    pub nanosec: u32,
}

#[derive(Debug, Default)]
struct Simulation {
    runs: AtomicBool,
    /// Seconds in the upper half and nanoseconds in the lower half, so that both change at once.
    time: AtomicU64,
    malformed: AtomicU64,
}

impl Ros2Clock {
    pub(crate) fn new(use_sim_time: bool) -> Self {
        let clock = Self::default();
        clock.0.runs.store(use_sim_time, Ordering::Release);
        clock
    }

    /// Returns the current time.
    #[must_use]
    pub fn now(&self) -> Ros2Time {
        if !self.is_simulated() {
            return Ros2Time::from_unix_nanos(unix_nanos());
        }
        let [a, b, c, d, e, f, g, h] = self.0.time.load(Ordering::Acquire).to_be_bytes();
        Ros2Time {
            sec: i32::from_be_bytes([a, b, c, d]),
            nanosec: u32::from_be_bytes([e, f, g, h]),
        }
    }

    /// Returns whether the time comes from `/clock`.
    #[must_use]
    pub fn is_simulated(&self) -> bool {
        self.0.runs.load(Ordering::Acquire)
    }

    /// Returns the number of invalid `/clock` messages.
    #[must_use]
    pub fn malformed(&self) -> u64 {
        self.0.malformed.load(Ordering::Relaxed)
    }

    /// Reads a `rosgraph_msgs/msg/Clock` after its encapsulation header: seconds and nanoseconds.
    pub(crate) fn hear(&self, payload: &[u8]) {
        let words = match payload {
            [0, 1, _, _, a, b, c, d, e, f, g, h, ..] => Some(([*d, *c, *b, *a], [*h, *g, *f, *e])),
            [0, 0, _, _, a, b, c, d, e, f, g, h, ..] => Some(([*a, *b, *c, *d], [*e, *f, *g, *h])),
            _ => None,
        };
        match words {
            Some((sec, nanosec)) if u32::from_be_bytes(nanosec) < NANOS_PER_SEC => {
                let time = u64::from(u32::from_be_bytes(sec)) << 32
                    | u64::from(u32::from_be_bytes(nanosec));
                self.0.time.store(time, Ordering::Release);
            }
            _ => {
                self.0.malformed.fetch_add(1, Ordering::Relaxed);
            }
        }
    }
}

impl Ros2Time {
    /// Converts nanoseconds since 1970 to a time, clamped to its range.
    #[must_use]
    pub fn from_unix_nanos(nanos: i128) -> Self {
        let per_sec = i128::from(NANOS_PER_SEC);
        i32::try_from(nanos.div_euclid(per_sec)).map_or(
            Self {
                sec: if nanos < 0 { i32::MIN } else { i32::MAX },
                nanosec: 0,
            },
            |sec| Self {
                sec,
                nanosec: u32::try_from(nanos.rem_euclid(per_sec)).unwrap_or_default(),
            },
        )
    }
}

/// Returns the wall clock time in nanoseconds since 1970; a time before 1970 is 0.
#[expect(
    clippy::disallowed_methods,
    reason = "the only place of the node that reads the wall clock"
)]
pub(crate) fn unix_nanos() -> i128 {
    let since = SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default();
    i128::try_from(since.as_nanos()).unwrap_or(i128::MAX)
}

/// The topic of the simulated time.
pub(crate) const TOPIC: &str = "rt/clock";
/// The DDS type of the topic.
pub(crate) const TYPE: &str = "rosgraph_msgs::msg::dds_::Clock_";
const NANOS_PER_SEC: u32 = 1_000_000_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn simulated_time_is_zero_at_first_and_then_what_the_last_message_said() {
        let clock = Ros2Clock::new(true);
        assert_eq!(clock.now(), Ros2Time::default());
        clock.hear(&[0, 1, 0, 0, 7, 0, 0, 0, 9, 0, 0, 0]);
        assert_eq!(clock.now(), Ros2Time { sec: 7, nanosec: 9 });
        clock.hear(&[0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 1]);
        assert_eq!(clock.now(), Ros2Time { sec: 3, nanosec: 1 });
    }

    #[test]
    fn a_message_that_says_no_time_is_counted_and_not_taken() {
        let clock = Ros2Clock::new(true);
        clock.hear(&[0, 1, 0, 0, 7, 0, 0, 0]);
        clock.hear(&[0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0xFF]);
        assert_eq!((clock.now(), clock.malformed()), (Ros2Time::default(), 2));
    }

    #[test]
    fn without_simulation_it_is_the_wall_clock() {
        let clock = Ros2Clock::new(false);
        clock.hear(&[0, 1, 0, 0, 7, 0, 0, 0, 9, 0, 0, 0]);
        assert!(clock.now().sec > 1_700_000_000);
    }
}
