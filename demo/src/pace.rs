//! The durations of the robots' actions at a given speed.

use std::time::Duration;

/// The speed of a scenario: all durations of the robots are divided by it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Speed(f64);

impl Speed {
    /// Creates a speed from a factor between 0.1 and 1000. At higher speeds the robots would be
    /// faster than the values that they wait for.
    pub(crate) fn new(factor: f64) -> Option<Self> {
        (0.1..=1000.0).contains(&factor).then_some(Self(factor))
    }

    pub(crate) const fn factor(self) -> f64 {
        self.0
    }

    /// Converts seconds of the scenario to a real duration.
    pub(crate) fn real(self, story_seconds: f64) -> Duration {
        Duration::try_from_secs_f64(story_seconds / self.0).unwrap_or(Duration::MAX)
    }

    /// Converts real nanoseconds to seconds of the scenario.
    pub(crate) fn story_seconds(self, real_nanos: i64) -> f64 {
        // Exact up to 2^53 ns, which is about a hundred days.
        #[expect(
            clippy::cast_precision_loss,
            reason = "a story lasts less than a hundred days"
        )]
        let nanos = real_nanos as f64;
        nanos / 1e9 * self.0
    }
}

impl std::str::FromStr for Speed {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let factor = text.parse().map_err(|_| "not a number")?;
        Self::new(factor).ok_or("the speed is a factor from 0.1 to 1000")
    }
}

/// The duration of each action, in real time.
///
/// With four covers and the conveyor switched off at second 25, the arm holds the third cover at
/// that time. Two covers go by conveyor and two by TurtleBot3. The last cycle is long, because
/// TurtleBot3 is away with the third cover.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct LinePace {
    /// Before the first cycle.
    pub(crate) first_rest: Duration,
    /// Between two cycles.
    pub(crate) rest: Duration,
    /// Half of a pick-and-place cycle for the first, third... cover, which lie far from the arm.
    pub(crate) far_half: Duration,
    /// Half of a cycle for the other covers, which lie near.
    pub(crate) near_half: Duration,
    /// From the placement of the cover in the bucket to the departure.
    pub(crate) load: Duration,
    /// From the park to the worker, and back.
    pub(crate) drive: Duration,
    /// Unloading at the worker.
    pub(crate) unload: Duration,
    /// Age after which a report that the bucket is free is newer than the placed cover.
    pub(crate) report_age: Duration,
}

impl LinePace {
    /// Returns all durations at a speed.
    pub(crate) fn at(speed: Speed) -> Self {
        Self {
            first_rest: speed.real(2.0),
            rest: speed.real(3.0),
            far_half: speed.real(3.5),
            near_half: speed.real(2.5),
            load: speed.real(2.0),
            drive: speed.real(7.0),
            unload: speed.real(3.0),
            // Network delays do not depend on the speed of the robots.
            report_age: speed.real(20.0).max(Duration::from_secs(5)),
        }
    }

    /// Returns the duration of half of a cycle, by the number of the cycle from 0.
    pub(crate) const fn half_cycle(&self, cycle: u32) -> Duration {
        if cycle.is_multiple_of(2) {
            self.far_half
        } else {
            self.near_half
        }
    }
}

/// Returns the seconds of the scenario after which a line with this many covers is overdue.
/// TurtleBot3 could deliver all covers in sequence within half of the time.
pub(crate) fn overdue_after(covers: u32, conveyor_off_at: f64) -> f64 {
    conveyor_off_at + 60.0 + 60.0 * f64::from(covers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_take_seven_and_five_seconds_in_turn() {
        let pace = LinePace::at(Speed::new(1.0).unwrap());
        assert_eq!(pace.half_cycle(0) * 2, Duration::from_secs(7));
        assert_eq!(pace.half_cycle(1) * 2, Duration::from_secs(5));
    }

    #[test]
    fn speed_divides_times() {
        let speed: Speed = "20".parse().unwrap();
        assert_eq!(LinePace::at(speed).drive, Duration::from_millis(350));
        assert!((speed.story_seconds(1_250_000_000) - 25.0).abs() < 1e-9);
    }

    #[test]
    fn a_speed_of_nothing_is_refused() {
        for text in ["0", "-1", "nan", "inf", "fast", "1001"] {
            assert!(text.parse::<Speed>().is_err(), "{text}");
        }
    }
}
