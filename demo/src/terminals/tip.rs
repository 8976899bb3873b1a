//! Follows the fingers of the simulated robot.

use std::sync::{Arc, Mutex, PoisonError};

use devices::ur::{Follower, RtdeError};
use skills::frame::Frame;
use tokio::task::JoinSet;

/// The fingers of the robot: the smallest distance from each point that they had.
pub(super) struct Tip {
    nearest: Arc<Mutex<Vec<f64>>>,
    /// Ends when this value is dropped.
    _following: JoinSet<()>,
}

impl Tip {
    /// Follows the simulated robot by RTDE. The points are in m.
    ///
    /// # Errors
    /// The robot does not answer.
    pub(super) async fn follow(points: Vec<[f64; 3]>) -> Result<Self, RtdeError> {
        let mut follower = Follower::open(RTDE).await?;
        let nearest = Arc::new(Mutex::new(vec![f64::MAX; points.len()]));
        let mut following = JoinSet::new();
        let all = Arc::clone(&nearest);
        following.spawn(async move {
            while let Ok(flange) = follower.position().await {
                let mut all = all.lock().unwrap_or_else(PoisonError::into_inner);
                for (nearest, point) in all.iter_mut().zip(&points) {
                    *nearest = nearest.min(distance(tip(flange), *point));
                }
            }
        });
        Ok(Self {
            nearest,
            _following: following,
        })
    }

    /// Returns the smallest distance from each point, in mm.
    pub(super) fn nearest_mm(&self) -> Vec<f64> {
        let all = self.nearest.lock().unwrap_or_else(PoisonError::into_inner);
        all.iter().map(|metres| metres * 1e3).collect()
    }
}

/// Returns the grip point of the fingers behind the tool changer.
fn tip(flange: [f64; 6]) -> [f64; 3] {
    let tool = Frame::at([0.0, 0.0, PLATE + GRIP_POINT]);
    Frame::of_pose(flange).then(&tool).position()
}

fn distance(one: [f64; 3], other: [f64; 3]) -> f64 {
    let parts = one
        .iter()
        .zip(other)
        .map(|(one, other)| (one - other).powi(2));
    parts.sum::<f64>().sqrt()
}

const RTDE: &str = "127.0.0.1:30004";
/// The tool plate of the changer in the frame of the flange, m.
const PLATE: f64 = 0.047;
/// The grip point of the fingers in the frame of the tool plate, m.
const GRIP_POINT: f64 = 0.2028;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tip_of_a_robot_that_points_down_is_below_its_flange() {
        let [x, y, z] = tip([0.4, 0.1, 0.5, std::f64::consts::PI, 0.0, 0.0]);
        let below = distance([x, y, z], [0.4, 0.1, 0.5 - 0.2498]);
        assert!(below < 1e-9, "{x} {y} {z}");
    }
}
