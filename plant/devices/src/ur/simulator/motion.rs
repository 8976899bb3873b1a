//! A motion of the tool along a straight line, or of the joints: it accelerates, keeps its speed
//! and decelerates.

use super::tidy;
use crate::ur::REACH;
use crate::ur::pose::{Quaternion, angle, between, of_vector, to_vector};

#[derive(Debug, Clone)]
pub(super) struct SimulatedMotion {
    from: [f64; 6],
    to: [f64; 6],
    turn: (Quaternion, Quaternion),
    /// Whether the coordinates are positions of the joints.
    is_of_joints: bool,
    /// Length of the path: of the tool in m, or of its rotation in rad if that is larger; of the
    /// joint that turns most in rad.
    length: f64,
    done: f64,
    speed: f64,
    most: f64,
    acceleration: f64,
    stops: bool,
}

impl SimulatedMotion {
    pub(super) fn new(from: [f64; 6], to: [f64; 6], most: f64, acceleration: f64) -> Self {
        let [x, y, z, rx, ry, rz] = from;
        let [tx, ty, tz, trx, try_, trz] = to;
        let turn = (of_vector([rx, ry, rz]), of_vector([trx, try_, trz]));
        let way = ((tx - x).powi(2) + (ty - y).powi(2) + (tz - z).powi(2)).sqrt();
        Self {
            from,
            to: tidy(to),
            turn,
            is_of_joints: false,
            length: way.max(angle(turn.0, turn.1)),
            done: 0.0,
            speed: 0.0,
            most,
            acceleration,
            stops: false,
        }
    }

    /// Creates a motion of the joints, which start and end together.
    pub(super) fn of_joints(from: [f64; 6], to: [f64; 6], most: f64, acceleration: f64) -> Self {
        let ways = from.iter().zip(to).map(|(from, to)| (to - from).abs());
        Self {
            to,
            is_of_joints: true,
            length: ways.fold(0.0, f64::max),
            ..Self::new(from, to, most, acceleration)
        }
    }

    /// Returns the positions of the joints; `None` for a motion of the tool.
    pub(super) fn joints(&self) -> Option<[f64; 6]> {
        let share = self.share();
        let mut at = self.from;
        for (at, to) in at.iter_mut().zip(self.to) {
            *at += (to - *at) * share;
        }
        let at = if share >= 1.0 { self.to } else { at };
        self.is_of_joints.then_some(at)
    }

    /// Returns the same motion, braking from now on.
    pub(super) fn interrupted(mut self) -> Self {
        self.stops = true;
        self.acceleration = self.acceleration.max(BRAKES);
        self
    }

    /// Advances by some seconds. Returns true at the end.
    pub(super) fn step(&mut self, seconds: f64) -> bool {
        let left = self.length - self.done;
        let brakes = self.speed * self.speed / (2.0 * self.acceleration);
        let gain = self.acceleration * seconds;
        self.speed = if self.stops || left <= brakes {
            (self.speed - gain).max(0.0)
        } else {
            (self.speed + gain).min(self.most)
        };
        self.done = (self.done + self.speed * seconds).min(self.length);
        // Steps end a little early or late.
        let arrived = self.length - self.done <= NEAR || (left <= NEAR_END && self.speed <= 0.0);
        if arrived && !self.stops {
            self.done = self.length;
            self.speed = 0.0;
        }
        arrived || (self.stops && self.speed <= 0.0)
    }

    fn share(&self) -> f64 {
        if self.length > 0.0 {
            self.done / self.length
        } else {
            1.0
        }
    }

    pub(super) fn pose(&self) -> [f64; 6] {
        let share = self.share();
        if share >= 1.0 {
            return self.to;
        }
        let mut at = self.from;
        for (at, to) in at.iter_mut().zip(self.to) {
            *at += (to - *at) * share;
        }
        let [x, y, z, ..] = at;
        let [rx, ry, rz] = to_vector(between(self.turn.0, self.turn.1, share));
        [x, y, z, rx, ry, rz]
    }

    /// Returns the velocity of the tool, m/s, without rotation.
    pub(super) fn velocity(&self) -> [f64; 6] {
        if self.is_of_joints {
            // A joint that turns by v moves the tool by v times the reach.
            return [self.speed * REACH, 0.0, 0.0, 0.0, 0.0, 0.0];
        }
        if self.length <= 0.0 {
            return [0.0; 6];
        }
        let along = |from: f64, to: f64| (to - from) / self.length * self.speed;
        let [x, y, z, ..] = self.from;
        let [tx, ty, tz, ..] = self.to;
        [along(x, tx), along(y, ty), along(z, tz), 0.0, 0.0, 0.0]
    }
}

const BRAKES: f64 = 3.0;
const NEAR: f64 = 1e-6;
const NEAR_END: f64 = 2e-3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_takes_the_time_of_a_trapezoid_and_is_never_faster_than_it_was_told() {
        let to = [0.5, 0.0, 0.0, 0.0, 0.0, 0.0];
        let mut motion = SimulatedMotion::new([0.0; 6], to, 0.25, 1.0);
        let mut steps = 0;
        while !motion.step(0.002) {
            steps += 1;
            let [x, ..] = motion.velocity();
            assert!(x <= 0.25 + 1e-9);
            assert!(steps < 2000, "it does not arrive: {motion:?}");
        }
        // 0.25 s to accelerate, 0.25 s to decelerate, 1.75 s between.
        assert!((f64::from(steps) * 0.002 - 2.25).abs() < 0.02, "{steps}");
        assert_eq!(motion.pose(), to);
    }

    #[test]
    fn one_that_is_interrupted_brakes_on_its_way() {
        let mut motion = SimulatedMotion::new([0.0; 6], [0.5, 0.0, 0.0, 0.0, 0.0, 0.0], 0.3, 1.0);
        for _ in 0..300 {
            assert!(!motion.step(0.002));
        }
        let [before, ..] = motion.pose();
        let mut motion = motion.interrupted();
        while !motion.step(0.002) {}
        let [after, ..] = motion.pose();
        assert!(
            (after - before - 0.015).abs() < 0.002,
            "{before} to {after}"
        );
        assert!(motion.velocity().iter().all(|part| *part == 0.0));
    }
}
