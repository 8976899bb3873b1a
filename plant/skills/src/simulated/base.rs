//! A simulated mobile base.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;

use super::Profile;
use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};
use crate::lock::lock;
use crate::parameters::Parameters;

/// A simulated mobile base, in the frame `map`.
#[derive(Debug, Clone, Default)]
pub struct Base {
    pose: Arc<Mutex<[f64; 3]>>,
}

impl Base {
    /// Returns the driver of NavigateToSkillType; `time_scale` is the factor by which it is faster
    /// than real time.
    #[must_use]
    pub fn navigates(&self, time_scale: f64) -> Arc<dyn Driver> {
        Arc::new(Navigation {
            base: self.clone(),
            time_scale,
        })
    }

    /// Returns x, y and heading.
    #[must_use]
    pub fn pose(&self) -> [f64; 3] {
        *lock(&self.pose)
    }
}

struct Navigation {
    base: Base,
    time_scale: f64,
}

#[async_trait]
impl Driver for Navigation {
    fn can_suspend(&self) -> bool {
        true
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        match parameters.text("Frame") {
            Some("map") => Ok(()),
            frame => Err(InvalidParameter::OutOfRange {
                name: "Frame".to_owned(),
                given: frame.unwrap_or_default().to_owned(),
                limit: "only map is known".to_owned(),
            }),
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let goal = work.parameters().numbers("Goal").unwrap_or_default();
        let goal: [f64; 3] = goal
            .try_into()
            .map_err(|_| InvalidParameter::missing("Goal", "three numbers"))?;
        let from = self.base.pose();
        let ([from_x, from_y, from_heading], [to_x, to_y, to_heading]) = (from, goal);
        let [x, y, heading] = [to_x - from_x, to_y - from_y, to_heading - from_heading];
        let turn = Profile::new(heading, TURNING, 2.0 * TURNING);
        let profile = Profile::new(x.hypot(y), SPEED, 2.0 * SPEED);
        let seconds = profile.seconds().max(turn.seconds()) / self.time_scale;
        work.step("Drive").await;
        let pieces = 50_u8;
        for piece in 1..=pieces {
            let share = f64::from(piece) / f64::from(pieces);
            let takes = Duration::from_secs_f64(seconds / f64::from(pieces));
            work.spend(takes).await.map_err(|_| self.stopped())?;
            *lock(&self.base.pose) = [
                x.mul_add(share, from_x),
                y.mul_add(share, from_y),
                heading.mul_add(share, from_heading),
            ];
            work.progress(f32::from(piece) / f32::from(pieces));
        }
        *lock(&self.base.pose) = goal;
        Ok(vec![("Pose".to_owned(), goal.to_vec().into())])
    }
}

impl Navigation {
    fn stopped(&self) -> DriverError {
        let [x, y, _] = self.base.pose();
        DriverError::StoppedWith(format!("at {x:.2}, {y:.2} m"))
    }
}

/// Speeds in m/s and rad/s.
const SPEED: f64 = 0.5;
const TURNING: f64 = 1.0;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;
    use crate::value::SkillValue;

    fn to(goal: [f64; 3]) -> Vec<(String, SkillValue)> {
        vec![("Goal".to_owned(), goal.to_vec().into())]
    }

    #[tokio::test]
    async fn its_driver_is_as_drivers_should_be() {
        let mut corners = [[1.0, 0.0, 0.0], [0.0, 1.0, 1.5], [-1.0, 0.5, 0.0]];
        let around = || {
            corners.rotate_left(1);
            to(corners[0])
        };
        conformance::check(
            "NavigateToSkillType",
            Base::default().navigates(20.0),
            around,
        )
        .await
        .unwrap();
    }

    #[tokio::test]
    async fn it_arrives_and_knows_one_frame_only() {
        let base = Base::default();
        let goal = [1.0, -0.5, 0.3];
        let arrived = conformance::run_once("NavigateToSkillType", base.navigates(50.0), to(goal))
            .await
            .unwrap();
        assert_eq!(arrived.results, [("Pose".to_owned(), goal.to_vec().into())]);
        assert_eq!(base.pose(), goal);
        let mut elsewhere = to(goal);
        elsewhere.push(("Frame".to_owned(), "odom".into()));
        let refused =
            conformance::run_once("NavigateToSkillType", base.navigates(50.0), elsewhere).await;
        assert_eq!(
            refused.unwrap_err().to_string(),
            "BadInvalidArgument: Frame is odom, and only map is known"
        );
    }
}
