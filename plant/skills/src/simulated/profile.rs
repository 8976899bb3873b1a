//! The speed profile of a motion.

use std::time::Duration;

/// A trapezoidal speed profile: constant acceleration, constant speed, the same deceleration. Short
/// motions have no constant part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Profile {
    distance: f64,
    /// Time to reach the speed, s.
    ramp: f64,
    /// Time at that speed, s.
    cruise: f64,
    acceleration: f64,
}

impl Profile {
    /// Creates the profile of a motion over `distance` at up to `speed`, with this acceleration and
    /// deceleration.
    ///
    /// The units are the caller's, per second. A distance of zero takes no time; speed and
    /// acceleration must be above 0.
    #[must_use]
    pub fn new(distance: f64, speed: f64, acceleration: f64) -> Self {
        let distance = distance.abs();
        let to_speed = speed * speed / acceleration;
        let (ramp, cruise) = if distance <= to_speed {
            ((distance / acceleration).sqrt(), 0.0)
        } else {
            (speed / acceleration, (distance - to_speed) / speed)
        };
        Self {
            distance,
            ramp,
            cruise,
            acceleration,
        }
    }

    /// Returns the duration of the motion, s.
    #[must_use]
    pub fn seconds(&self) -> f64 {
        2.0 * self.ramp + self.cruise
    }

    /// Returns the duration of the motion.
    #[must_use]
    pub fn time(&self) -> Duration {
        Duration::try_from_secs_f64(self.seconds()).unwrap_or(Duration::MAX)
    }

    /// Returns the share of the distance that is covered after `seconds`, from 0 to 1.
    #[must_use]
    pub fn share(&self, seconds: f64) -> f64 {
        let total = self.seconds();
        if seconds >= total || self.distance <= 0.0 {
            return 1.0;
        }
        let a = self.acceleration;
        let way = if seconds <= 0.0 {
            0.0
        } else if seconds < self.ramp {
            0.5 * a * seconds * seconds
        } else if seconds < self.ramp + self.cruise {
            a * self.ramp * (seconds - 0.5 * self.ramp)
        } else {
            let left = total - seconds;
            self.distance - 0.5 * a * left * left
        };
        (way / self.distance).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_way_is_a_trapezoid_and_a_short_one_a_triangle() {
        let long = Profile::new(1.0, 0.5, 1.0);
        assert!((long.seconds() - 2.5).abs() < 1e-9);
        let short = Profile::new(-0.04, 0.5, 1.0);
        assert!((short.seconds() - 0.4).abs() < 1e-9);
        assert!(Profile::new(0.0, 0.5, 1.0).time().is_zero());
        assert!((Profile::new(0.0, 0.5, 1.0).share(0.0) - 1.0).abs() < 1e-9);
    }

    #[test]
    fn neither_speed_nor_acceleration_is_passed_on_the_way() {
        for (distance, speed, acceleration) in [(1.0, 0.5, 1.0), (0.04, 0.5, 1.0), (3.0, 2.0, 0.7)]
        {
            let profile = Profile::new(distance, speed, acceleration);
            let step = profile.seconds() / 1000.0;
            let mut last = (0.0, 0.0);
            for k in 1..=1000 {
                let way = profile.share(step * f64::from(k)) * distance;
                let now = (way - last.0) / step;
                assert!(now >= 0.0 && now <= speed * (1.0 + 1e-6), "{now}");
                assert!(
                    (now - last.1).abs() <= acceleration * step * (1.0 + 1e-3),
                    "{now} after {}",
                    last.1
                );
                last = (way, now);
            }
            assert!((last.0 - distance).abs() < 1e-9);
        }
    }
}
