//! A simulated robot with six axes.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;
use tokio::time::Instant;

use super::Profile;
use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};
use crate::lock::lock;
use crate::parameters::Parameters;

/// Settings of a simulated robot.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmSettings {
    /// Maximum distance of the tool from the base, m.
    pub reach: f64,
    /// Factor by which the simulation is faster than real time.
    pub time_scale: f64,
    /// Initial pose of the tool: m, m, m, rad, rad, rad.
    pub home: [f64; 6],
    /// Maximum turning speed of the tool, rad/s.
    pub turning: f64,
    /// Height of the tool below which a contact force acts, m.
    pub contact: Option<f64>,
    /// A hole in the surface at that height, without a force.
    pub hole: Option<Hole>,
}

/// A round hole in the surface below a tool, as that of a slot for a part. In m, in the frame of
/// the base of the robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hole {
    /// x of the centre.
    pub x: f64,
    /// y of the centre.
    pub y: f64,
    /// Largest distance of the tool from the centre.
    pub radius: f64,
}

impl Hole {
    /// Creates a hole from x, y and the radius.
    #[must_use]
    pub const fn new([x, y, radius]: [f64; 3]) -> Self {
        Self { x, y, radius }
    }

    /// Returns whether a tool at this place fits into the hole.
    #[must_use]
    pub fn admits(&self, x: f64, y: f64) -> bool {
        (x - self.x).hypot(y - self.y) <= self.radius
    }
}

impl Default for ArmSettings {
    fn default() -> Self {
        Self {
            reach: 1.3,
            time_scale: 1.0,
            home: [0.4, 0.0, 0.5, 0.0, 0.0, 0.0],
            turning: 3.0,
            contact: None,
            hole: None,
        }
    }
}

/// The path of the tool to the target.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Path {
    /// All six coordinates move independently, each as fast as allowed, and start and end together.
    PointToPoint,
    /// A straight line.
    Linear,
}

/// A simulated robot. Its drivers share the pose of its tool and the positions of its joints. It
/// has no kinematics: the pose and the joints are independent.
#[derive(Debug, Clone)]
pub struct Arm {
    settings: ArmSettings,
    position: Arc<Mutex<[f64; 6]>>,
    joints: Arc<Mutex<[f64; 6]>>,
}

impl Arm {
    /// Creates a robot with its tool at home.
    #[must_use]
    pub fn new(settings: ArmSettings) -> Self {
        let position = Arc::new(Mutex::new(settings.home));
        Self {
            settings,
            position,
            joints: Arc::default(),
        }
    }

    /// Returns the same robot with other settings; the pose of the tool is kept.
    #[must_use]
    pub fn with(&self, settings: ArmSettings) -> Self {
        Self {
            settings,
            position: Arc::clone(&self.position),
            joints: Arc::clone(&self.joints),
        }
    }

    /// Returns the driver of Cartesian moves along this kind of path.
    #[must_use]
    pub fn moves(&self, path: Path) -> Arc<dyn Driver> {
        Arc::new(Motion {
            arm: self.clone(),
            path,
            yields: false,
        })
    }

    /// Returns the driver of ForceMoveSkillType.
    #[must_use]
    pub fn yields(&self) -> Arc<dyn Driver> {
        Arc::new(Motion {
            arm: self.clone(),
            path: Path::Linear,
            yields: true,
        })
    }

    /// Returns the driver of joint moves.
    #[must_use]
    pub fn turns(&self) -> Arc<dyn Driver> {
        Arc::new(Joints { arm: self.clone() })
    }

    /// Returns the pose of the tool.
    #[must_use]
    pub fn position(&self) -> [f64; 6] {
        *lock(&self.position)
    }
}

struct Motion {
    arm: Arm,
    path: Path,
    /// Whether the move ends at a contact force.
    yields: bool,
}

#[async_trait]
impl Driver for Motion {
    fn can_suspend(&self) -> bool {
        true
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        let [x, y, z, ..] = parameters
            .six(TARGET)
            .ok_or_else(|| InvalidParameter::missing(TARGET, "six numbers"))?;
        let (far, reach) = (length(&[x, y, z]), self.arm.settings.reach);
        if far > reach {
            return Err(InvalidParameter::OutOfRange {
                name: TARGET.to_owned(),
                given: format!("{far:.3} m from the base"),
                limit: format!("the tool comes {reach} m far"),
            });
        }
        Ok(())
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let parameters = work.parameters();
        let target = parameters.six(TARGET);
        let target = target.ok_or_else(|| InvalidParameter::missing(TARGET, "six numbers"))?;
        let speed = number(parameters, "MaxVelocity")?;
        let acceleration = number(parameters, "MaxAcceleration")?;
        let from = self.arm.position();
        let profile = self.profile(from, target, (speed, acceleration));
        let touches = self.touches(parameters);
        work.step("Move").await;
        let mut moved = Duration::ZERO;
        let touched = loop {
            let seconds = moved.as_secs_f64() * self.arm.settings.time_scale;
            let share = profile.share(seconds);
            *lock(&self.arm.position) = between(from, target, share);
            #[expect(clippy::cast_possible_truncation, reason = "a share for people to see")]
            work.progress(share as f32);
            let [x, y, z, ..] = self.arm.position();
            let is_over_hole = self.arm.settings.hole.is_some_and(|hole| hole.admits(x, y));
            let touched = touches.is_some_and(|height| z < height && !is_over_hole);
            if touched || seconds >= profile.seconds() {
                break touched;
            }
            // The robot does not move while it is suspended.
            work.going().await.map_err(|_| self.stopped())?;
            let began = Instant::now();
            work.spend(TICK).await.map_err(|_| self.stopped())?;
            moved += began.elapsed().min(2 * TICK);
        };
        let mut results = vec![("Position".to_owned(), self.arm.position().into())];
        if self.yields {
            let pushes = work.parameters().numbers("MaxForce").unwrap_or_default();
            let force = match (touched, pushes.last()) {
                (true, Some(along_z)) => vec![0.0, 0.0, *along_z],
                _ => vec![0.0; 3],
            };
            results.push(("ForceExceeded".to_owned(), touched.into()));
            results.push(("Force".to_owned(), force.into()));
        }
        Ok(results)
    }
}

impl Motion {
    /// Returns the height below which a contact force stops the move.
    fn touches(&self, parameters: &Parameters) -> Option<f64> {
        let counts = self.yields
            && parameters
                .numbers("MaxForce")
                .is_some_and(|force| force.last().is_some_and(|along_z| *along_z > 0.0));
        self.arm.settings.contact.filter(|_| counts)
    }

    /// Returns the profile of the slowest coordinate, which determines the pace of the others.
    fn profile(
        &self,
        from: [f64; 6],
        target: [f64; 6],
        (speed, acceleration): (f64, f64),
    ) -> Profile {
        let way: Vec<f64> = target
            .iter()
            .zip(from)
            .map(|(to, from)| to - from)
            .collect();
        let (places, turns) = way.split_at(3);
        let turning = self.arm.settings.turning;
        let along = match self.path {
            Path::Linear => vec![length(places)],
            Path::PointToPoint => places.to_vec(),
        };
        let moves = along
            .into_iter()
            .map(|way| Profile::new(way, speed, acceleration));
        // The turning accelerates within the same time as the translation.
        let turns = turns
            .iter()
            .map(|way| Profile::new(*way, turning, turning * acceleration / speed));
        moves
            .chain(turns)
            .max_by(|a, b| a.seconds().total_cmp(&b.seconds()))
            .unwrap_or_else(|| Profile::new(0.0, speed, acceleration))
    }

    fn stopped(&self) -> DriverError {
        let [x, y, z, ..] = self.arm.position();
        DriverError::StoppedWith(format!("at {x:.3}, {y:.3}, {z:.3} m"))
    }
}

/// The driver of joint moves.
struct Joints {
    arm: Arm,
}

#[async_trait]
impl Driver for Joints {
    fn can_suspend(&self) -> bool {
        true
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        target_joints(parameters).map(drop)
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let target = target_joints(work.parameters())?;
        let speed = number(work.parameters(), "MaxJointVelocity")?;
        let acceleration = number(work.parameters(), "MaxJointAcceleration")?;
        let from = *lock(&self.arm.joints);
        let profile = target
            .iter()
            .zip(from)
            .map(|(to, from)| Profile::new(to - from, speed, acceleration))
            .max_by(|a, b| a.seconds().total_cmp(&b.seconds()))
            .unwrap_or_else(|| Profile::new(0.0, speed, acceleration));
        work.step("Move").await;
        for piece in 1..=PIECES {
            let share = f32::from(piece) / f32::from(PIECES);
            let seconds = profile.seconds() / self.arm.settings.time_scale / f64::from(PIECES);
            work.spend(Duration::from_secs_f64(seconds))
                .await
                .map_err(|_| DriverError::StoppedWith("on the way".to_owned()))?;
            *lock(&self.arm.joints) = between(
                from,
                target,
                profile.share(profile.seconds() * f64::from(share)),
            );
            work.progress(share);
        }
        Ok(vec![("JointPosition".to_owned(), target.into())])
    }
}

fn target_joints(parameters: &Parameters) -> Result<[f64; 6], InvalidParameter> {
    let target = parameters.six(JOINT_TARGET);
    target.ok_or_else(|| InvalidParameter::missing(JOINT_TARGET, "six numbers"))
}

fn number(parameters: &Parameters, name: &str) -> Result<f64, InvalidParameter> {
    let number = parameters.number(name);
    number.ok_or_else(|| InvalidParameter::missing(name, "number"))
}

fn between(from: [f64; 6], target: [f64; 6], share: f64) -> [f64; 6] {
    let mut at = target;
    if share < 1.0 {
        for (at, from) in at.iter_mut().zip(from) {
            *at = from + (*at - from) * share;
        }
    }
    at
}

fn length(of: &[f64]) -> f64 {
    of.iter().map(|part| part * part).sum::<f64>().sqrt()
}

/// The parameters with the targets of moves.
const TARGET: &str = "TargetPosition";
const JOINT_TARGET: &str = "TargetJointPosition";
/// Number of pieces of a joint move.
const PIECES: u8 = 50;
/// Interval between updates of the position.
const TICK: Duration = Duration::from_millis(10);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;
    use crate::value::SkillValue;

    fn to(target: [f64; 6], more: &[(&str, f64)]) -> Vec<(String, SkillValue)> {
        let more = more
            .iter()
            .map(|(name, value)| ((*name).to_owned(), SkillValue::from(*value)));
        std::iter::once(("TargetPosition".to_owned(), target.into()))
            .chain(more)
            .collect()
    }

    fn quick() -> Arm {
        Arm::new(ArmSettings {
            time_scale: 20.0,
            ..ArmSettings::default()
        })
    }

    #[tokio::test]
    async fn its_drivers_are_as_drivers_should_be() {
        let mut corners = [[-0.5, 0.3, 0.2], [0.5, 0.3, -0.2], [0.1, -0.6, 0.4]];
        let mut around = || {
            corners.rotate_left(1);
            let [x, y, z] = corners[0];
            to([x, y, z, 0.0, x, 0.0], &[])
        };
        for (skill_type, path) in [
            ("PtpMoveSkillType", Path::PointToPoint),
            ("LinearMoveSkillType", Path::Linear),
        ] {
            conformance::check(skill_type, quick().moves(path), &mut around)
                .await
                .unwrap();
        }
    }

    #[tokio::test]
    async fn its_tool_arrives_and_the_next_move_begins_there() {
        let arm = quick();
        let target = [0.2, 0.3, 0.1, 0.0, 0.5, 0.0];
        let moved = conformance::run_once(
            "PtpMoveSkillType",
            arm.moves(Path::PointToPoint),
            to(target, &[]),
        )
        .await
        .unwrap();
        assert!(moved.succeeded, "{}", moved.message);
        assert_eq!(moved.results, [("Position".to_owned(), target.into())]);
        assert_eq!(arm.position(), target);
        let up = [0.2, 0.3, 0.4, 0.0, 0.5, 0.0];
        conformance::run_once("LinearMoveSkillType", arm.moves(Path::Linear), to(up, &[]))
            .await
            .unwrap();
        assert_eq!(arm.position(), up);
    }

    #[test]
    fn a_straight_line_takes_the_time_of_its_length_and_a_free_way_that_of_its_slowest_part() {
        let motion = |path| Motion {
            arm: quick(),
            path,
            yields: false,
        };
        let (from, target) = ([0.0; 6], [0.3, 0.4, 0.0, 0.0, 0.0, 0.0]);
        let seconds = |path| motion(path).profile(from, target, (0.2, 1.0)).seconds();
        assert!((seconds(Path::Linear) - Profile::new(0.5, 0.2, 1.0).seconds()).abs() < 1e-9);
        assert!((seconds(Path::PointToPoint) - Profile::new(0.4, 0.2, 1.0).seconds()).abs() < 1e-9);
    }

    #[tokio::test]
    async fn what_it_cannot_reach_is_refused_before_it_moves() {
        let arm = quick();
        let run = conformance::run_once(
            "PtpMoveSkillType",
            arm.moves(Path::PointToPoint),
            to([2.0; 6], &[]),
        )
        .await;
        let refusal = run.unwrap_err().to_string();
        assert!(
            refusal.starts_with("BadInvalidArgument: TargetPosition is 3.464 m"),
            "{refusal}"
        );
        assert_eq!(arm.position(), ArmSettings::default().home);
    }

    #[tokio::test]
    async fn its_joints_and_its_yielding_moves_are_driven_as_drivers_should_be() {
        let mut turns = [[0.5; 6], [-0.5; 6], [0.1, 0.2, 0.3, -0.4, -0.5, -0.6]];
        let mut around = || {
            turns.rotate_left(1);
            vec![("TargetJointPosition".to_owned(), turns[0].into())]
        };
        for skill_type in ["JointPtpMoveSkillType", "JointLinearMoveSkillType"] {
            conformance::check(skill_type, quick().turns(), &mut around)
                .await
                .unwrap();
        }
        let mut heights = [0.3, 0.5, 0.4];
        let up_and_down = || {
            heights.rotate_left(1);
            pushing([0.4, 0.0, heights[0], 0.0, 0.0, 0.0])
        };
        conformance::check("ForceMoveSkillType", quick().yields(), up_and_down)
            .await
            .unwrap();
    }

    fn pushing(target: [f64; 6]) -> Vec<(String, SkillValue)> {
        let mut parameters = to(target, &[]);
        parameters.push(("MaxForce".to_owned(), vec![0.0, 0.0, 20.0].into()));
        parameters
    }

    #[tokio::test]
    async fn a_yielding_move_ends_where_something_pushes_back() {
        let arm = Arm::new(ArmSettings {
            time_scale: 20.0,
            contact: Some(0.3),
            ..ArmSettings::default()
        });
        let target = [0.4, 0.0, 0.1, 0.0, 0.0, 0.0];
        let moved = conformance::run_once("ForceMoveSkillType", arm.yields(), pushing(target))
            .await
            .unwrap();
        assert!(moved.succeeded, "{}", moved.message);
        assert_eq!(moved.results[1], ("ForceExceeded".to_owned(), true.into()));
        let [_, _, z, ..] = arm.position();
        assert!(z < 0.3 && z > 0.1, "{z}");
    }

    #[tokio::test]
    async fn a_yielding_move_goes_through_a_hole_and_stops_beside_it() {
        for (x, is_through) in [(0.4, true), (0.41, false)] {
            let arm = Arm::new(ArmSettings {
                time_scale: 20.0,
                contact: Some(0.3),
                hole: Some(Hole::new([0.4, 0.0, 0.002])),
                home: [x, 0.0, 0.5, 0.0, 0.0, 0.0],
                ..ArmSettings::default()
            });
            let target = [x, 0.0, 0.2, 0.0, 0.0, 0.0];
            let moved = conformance::run_once("ForceMoveSkillType", arm.yields(), pushing(target))
                .await
                .unwrap();
            let blocked = ("ForceExceeded".to_owned(), (!is_through).into());
            assert_eq!(moved.results[1], blocked, "at {x} m");
            assert_eq!(arm.position() == target, is_through, "at {x} m");
        }
    }
}
