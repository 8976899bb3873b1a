//! A client that receives the tool position of a robot.

use super::of_robot;
use super::rtde::{Rtde, RtdeError};
use super::wire::RecipeValue;

/// A client that receives the tool position of a robot.
#[derive(Debug)]
pub struct Follower(Rtde);

impl Follower {
    /// Connects to the robot with RTDE at `host:port`.
    ///
    /// # Errors
    /// The robot does not answer.
    pub async fn open(rtde: &str) -> Result<Self, RtdeError> {
        Rtde::open(rtde, FOLLOWED, &["actual_TCP_pose"], &[])
            .await
            .map(Self)
    }

    /// Returns the next position: m, and rotations about x, y and z in rad. Not cancel-safe.
    ///
    /// # Errors
    /// Fails if the connection is lost, or silent for a second.
    pub async fn position(&mut self) -> Result<[f64; 6], RtdeError> {
        match self.0.next().await?.as_slice() {
            [RecipeValue::Vector(pose)] => Ok(of_robot(*pose)),
            _ => Err(self.0.damaged("a position of another type")),
        }
    }
}

/// Rate of the positions, Hz.
const FOLLOWED: f64 = 500.0;
