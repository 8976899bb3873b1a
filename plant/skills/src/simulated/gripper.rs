//! A simulated gripper.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use async_trait::async_trait;

use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};

/// Settings of a simulated gripper.
#[derive(Debug, Clone, PartialEq)]
pub struct GripperSettings {
    /// Duration of closing and opening, before the time scale.
    pub duration: Duration,
    /// Whether there is an object to grasp.
    pub object: bool,
    /// Factor by which the simulation is faster than real time.
    pub time_scale: f64,
}

impl Default for GripperSettings {
    fn default() -> Self {
        Self {
            duration: Duration::from_millis(400),
            object: true,
            time_scale: 1.0,
        }
    }
}

/// A simulated gripper. Its drivers share whether it holds an object.
#[derive(Debug, Clone, Default)]
pub struct Gripper {
    settings: GripperSettings,
    holds: Arc<AtomicBool>,
}

impl Gripper {
    /// Creates a gripper that holds no object.
    #[must_use]
    pub fn new(settings: GripperSettings) -> Self {
        Self {
            settings,
            holds: Arc::default(),
        }
    }

    /// Returns the driver of GraspSkillType and its subtypes. `settings` override the settings of
    /// the gripper.
    #[must_use]
    pub fn grasp(&self, settings: Option<GripperSettings>) -> Arc<dyn Driver> {
        self.motion(true, settings)
    }

    /// Returns the driver of ReleaseSkillType and its subtypes. `settings` override the settings of
    /// the gripper.
    #[must_use]
    pub fn release(&self, settings: Option<GripperSettings>) -> Arc<dyn Driver> {
        self.motion(false, settings)
    }

    /// Returns the driver of MoveGripperSkillType and its subtypes. `settings` override the
    /// settings of the gripper.
    #[must_use]
    pub fn moves(&self, settings: Option<GripperSettings>) -> Arc<dyn Driver> {
        let settings = settings.unwrap_or_else(|| self.settings.clone());
        Arc::new(Width {
            settings,
            holds: Arc::clone(&self.holds),
        })
    }

    /// Returns whether the gripper holds an object.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.holds.load(Ordering::SeqCst)
    }

    fn motion(&self, closes: bool, settings: Option<GripperSettings>) -> Arc<dyn Driver> {
        let settings = settings.unwrap_or_else(|| self.settings.clone());
        Arc::new(Motion {
            closes,
            settings,
            holds: Arc::clone(&self.holds),
        })
    }
}

/// The gripper closed without an object.
#[derive(Debug, thiserror::Error)]
#[error("nothing is between the fingers")]
struct NothingGrasped;

/// Opens or closes the gripper.
#[derive(Debug)]
struct Motion {
    closes: bool,
    settings: GripperSettings,
    holds: Arc<AtomicBool>,
}

#[async_trait]
impl Driver for Motion {
    fn can_suspend(&self) -> bool {
        true
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let (step, holds) = if self.closes {
            ("Close", self.settings.object)
        } else {
            ("Open", false)
        };
        work.step(step).await;
        self.settings.take_time(&work, step).await?;
        self.holds.store(holds, Ordering::SeqCst);
        if !self.closes {
            return Ok(Vec::new());
        }
        if !holds {
            return Err(DriverError::device(NothingGrasped));
        }
        Ok(vec![("Gripped".to_owned(), true.into())])
    }
}

/// Moves the fingers to a width.
#[derive(Debug)]
struct Width {
    settings: GripperSettings,
    holds: Arc<AtomicBool>,
}

#[async_trait]
impl Driver for Width {
    fn can_suspend(&self) -> bool {
        true
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let width = work
            .parameters()
            .number("Width")
            .ok_or_else(|| InvalidParameter::missing("Width", "number"))?;
        work.step("Move").await;
        self.settings.take_time(&work, "move").await?;
        self.holds.store(false, Ordering::SeqCst);
        Ok(vec![
            ("Width".to_owned(), width.into()),
            ("Gripped".to_owned(), false.into()),
        ])
    }
}

impl GripperSettings {
    async fn take_time(&self, work: &Work, what: &str) -> Result<(), DriverError> {
        let piece = self.duration.div_f64(self.time_scale * f64::from(PIECES));
        for done in 1..=PIECES {
            work.spend(piece).await.map_err(|_| {
                let what = what.to_lowercase();
                DriverError::StoppedWith(format!("while the fingers {what}"))
            })?;
            work.progress(f32::from(done) / f32::from(PIECES));
        }
        Ok(())
    }
}

const PIECES: u8 = 10;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;

    fn quick(object: bool) -> Gripper {
        let duration = Duration::from_millis(40);
        Gripper::new(GripperSettings {
            duration,
            object,
            time_scale: 1.0,
        })
    }

    #[tokio::test]
    async fn its_drivers_are_as_drivers_should_be() {
        for (skill_type, driver) in [
            ("GraspSkillType", quick(true).grasp(None)),
            ("ReleaseSkillType", quick(true).release(None)),
            ("MoveGripperSkillType", quick(true).moves(None)),
        ] {
            conformance::check(skill_type, driver, Vec::new)
                .await
                .unwrap();
        }
    }

    #[tokio::test]
    async fn it_holds_a_thing_from_grasp_to_release_and_says_if_there_is_none() {
        let gripper = quick(true);
        let grasped = conformance::run_once("GraspSkillType", gripper.grasp(None), Vec::new())
            .await
            .unwrap();
        assert_eq!(grasped.results, [("Gripped".to_owned(), true.into())]);
        assert!(gripper.holds());
        conformance::run_once("ReleaseSkillType", gripper.release(None), Vec::new())
            .await
            .unwrap();
        assert!(!gripper.holds());
        let empty = conformance::run_once("GraspSkillType", quick(false).grasp(None), Vec::new())
            .await
            .unwrap();
        assert_eq!(
            (empty.succeeded, empty.message.as_str()),
            (false, "nothing is between the fingers")
        );
    }
}
