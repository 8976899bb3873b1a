//! The force limit of a move.

use std::fmt;

use skills::frame::Frame;
use skills::{InvalidParameter, Parameters, RunResults};

use super::pose::of_robot;

/// Compares the force at the tool with the parameter MaxForce.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ForceGuard {
    /// The highest force along x, y and z of the tool, N; 0 for no limit.
    most: [f64; 3],
    /// The force before the move, in the frame of the base.
    zero: [f64; 3],
    /// The greatest force, in the frame of the tool.
    greatest: [f64; 3],
    exceeded: bool,
}

impl ForceGuard {
    /// Creates the guard of a run.
    ///
    /// # Errors
    /// MaxForce has no limit, or not three.
    pub(super) fn of(parameters: &Parameters) -> Result<Self, InvalidParameter> {
        let most = parameters
            .get(MAX_FORCE)
            .and_then(skills::SkillValue::as_f64s);
        let most: Option<[f64; 3]> = most.and_then(|most| most.try_into().ok());
        let most = most.ok_or_else(|| InvalidParameter::missing(MAX_FORCE, "three numbers"))?;
        if most.iter().any(|limit| *limit < 0.0) || most.iter().all(|limit| *limit <= 0.0) {
            return Err(InvalidParameter::Unexpected {
                name: MAX_FORCE.to_owned(),
                given: Some(most.to_vec().into()),
                expected: "needs a limit above 0 N for a direction".to_owned(),
            });
        }
        Ok(Self {
            most,
            zero: [0.0; 3],
            greatest: [0.0; 3],
            exceeded: false,
        })
    }

    /// Sets the force of the tool without contact.
    pub(super) fn zero(&mut self, [x, y, z, ..]: [f64; 6]) {
        self.zero = [x, y, z];
    }

    /// Takes a force and torque in the frame of the base. Returns whether it is above the limit.
    pub(super) fn exceeded(&mut self, force: [f64; 6], pose: [f64; 6]) -> bool {
        let [_, _, _, a, b, c] = of_robot(pose);
        let tool = Frame::of_pose([0.0, 0.0, 0.0, a, b, c]);
        let mut of_contact = [0.0; 3];
        for ((of_contact, force), zero) in of_contact.iter_mut().zip(force).zip(self.zero) {
            *of_contact = force - zero;
        }
        let of_tool = tool.inverse().then(&Frame::at(of_contact)).position();
        for ((force, greatest), most) in of_tool.iter().zip(&mut self.greatest).zip(self.most) {
            if force.abs() > greatest.abs() {
                *greatest = *force;
            }
            self.exceeded |= most > 0.0 && force.abs() > most;
        }
        self.exceeded
    }

    /// Returns the results of a move.
    pub(super) fn results(&self) -> RunResults {
        vec![
            ("ForceExceeded".to_owned(), self.exceeded.into()),
            ("Force".to_owned(), self.greatest.to_vec().into()),
        ]
    }
}

/// The parameter with the limits.
const MAX_FORCE: &str = "MaxForce";

impl fmt::Display for ForceGuard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.greatest;
        write!(
            f,
            "the force along x, y, z of the tool was {x:.1}, {y:.1}, {z:.1} N"
        )
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    fn guard(most: [f64; 3]) -> Result<ForceGuard, InvalidParameter> {
        let of = skills::model::find("ForceMoveSkillType")
            .unwrap()
            .parameters();
        let given = vec![
            ("TargetPosition".to_owned(), [0.0; 6].into()),
            ("MaxForce".to_owned(), most.to_vec().into()),
        ];
        ForceGuard::of(&Parameters::complete(&of, given).unwrap())
    }

    #[test]
    fn the_force_counts_in_the_frame_of_the_tool_and_without_its_weight() {
        let mut guard = guard([0.0, 0.0, 10.0]).unwrap();
        guard.zero([0.0, 0.0, -5.0, 0.0, 0.0, 0.0]);
        // The tool points down.
        let down = [0.0, 0.0, 0.0, PI, 0.0, 0.0];
        assert!(!guard.exceeded([40.0, 0.0, 4.0, 0.0, 0.0, 0.0], down));
        assert!(guard.exceeded([0.0, 0.0, 7.0, 0.0, 0.0, 0.0], down));
        let [_, (_, force)] = &guard.results()[..] else {
            panic!("two results")
        };
        let force = force.as_f64s().unwrap();
        let expected = [40.0, 0.0, -12.0];
        assert!(
            force
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-9),
            "{force:?}"
        );
    }

    #[test]
    fn a_move_without_a_limit_is_refused() {
        assert!(guard([0.0; 3]).is_err());
        assert!(guard([-1.0, 0.0, 5.0]).is_err());
        assert!(guard([0.0, 0.0, 5.0]).is_ok());
    }
}
