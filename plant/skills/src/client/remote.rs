//! Pick and place with the skills of two servers.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;

use super::{PeerAccess, SkillClient, SkillHandle};
use crate::component::{Partner, Partners};
use crate::composite::{self, PickAndPlace};
use crate::driver::{Driver, Results, Work};
use crate::frame::Frame;
use crate::parameters::{Parameters, TypeName};
use crate::runs::COMPOSITE_HALT_TIMEOUT;

/// The driver of PickAndPlaceSkillType that runs the skills of a robot and a gripper on separate
/// servers. It holds their leases during a run.
#[derive(Debug, Clone)]
pub struct Remote {
    partners: Partners,
    peers: PeerAccess,
}

impl Remote {
    /// Creates a driver for these partners.
    #[must_use]
    pub fn new(partners: Partners, peers: PeerAccess) -> Self {
        Self { partners, peers }
    }
}

#[async_trait]
impl Driver for Remote {
    /// Halt waits for the end of the skills that do the work.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(COMPOSITE_HALT_TIMEOUT)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), String> {
        composite::job(parameters).map(drop)
    }

    fn uses(&self) -> Vec<String> {
        let Partners { robot, gripper, .. } = &self.partners;
        vec![
            format!("{robot} PtpMoveSkillType"),
            format!("{robot} LinearMoveSkillType"),
            format!("{gripper} GraspSkillType"),
            format!("{gripper} ReleaseSkillType"),
        ]
    }

    async fn run(&self, work: Work) -> Result<Results, String> {
        let robot_at = self.place(&self.partners.robot, &work).await?;
        let gripper_at = self.place(&self.partners.gripper, &work).await?;
        let robot = self.peers.connect(&robot_at).await?;
        if robot_at == gripper_at {
            // A component has one lease, so one session is used for both.
            let done = self.with(&robot, &robot, &work).await;
            robot.close().await;
            return done;
        }
        let done = match self.peers.connect(&gripper_at).await {
            Ok(gripper) => {
                let done = self.with(&robot, &gripper, &work).await;
                gripper.close().await;
                done
            }
            Err(why) => Err(why),
        };
        robot.close().await;
        done
    }
}

impl Remote {
    /// Waits for a partner and returns its endpoint.
    async fn place(&self, partner: &Partner, work: &Work) -> Result<String, String> {
        let endpoint = tokio::select! {
            endpoint = self.peers.endpoint(partner) => endpoint?,
            () = work.stopped() => return Err("stopped".to_owned()),
        };
        if let Partner::Called(uri) = partner {
            work.note(format!("{uri} is at {endpoint}")).await;
        }
        Ok(endpoint)
    }

    async fn with(
        &self,
        robot: &SkillClient,
        gripper: &SkillClient,
        work: &Work,
    ) -> Result<Results, String> {
        let (ptp, grasp) = (
            one(robot, "PtpMoveSkillType").await?,
            one(gripper, "GraspSkillType").await?,
        );
        // Both components are locked before the work starts, so that a waiting client cannot
        // acquire one of them during the work.
        let apart = robot.endpoint() != gripper.endpoint();
        for first in [Some(&ptp), apart.then_some(&grasp)].into_iter().flatten() {
            let locked = first.lock("pick and place").await;
            locked.map_err(|fault| fault.to_string())?;
        }
        let composite = PickAndPlace {
            ptp: Arc::new(ptp),
            linear: Arc::new(one(robot, "LinearMoveSkillType").await?),
            grasp: Arc::new(grasp),
            release: Arc::new(one(gripper, "ReleaseSkillType").await?),
            plate: Frame::IDENTITY,
            within: self.partners.within,
        };
        let job = composite::job(work.parameters())?;
        composite
            .run(&job, work)
            .await
            .map_err(|broken| broken.to_string())?;
        Ok(Vec::new())
    }
}

/// Returns the first skill of a type.
async fn one(client: &SkillClient, of: &str) -> Result<SkillHandle, String> {
    let found = client
        .skills_of(&TypeName::own(of))
        .await
        .map_err(|fault| format!("{}: {fault}", client.endpoint()))?;
    let first = found
        .first()
        .ok_or_else(|| format!("{} has no skill of {of}", client.endpoint()))?;
    Ok(client.handle(first))
}

/// Time limit to find a partner.
pub(super) const FOUND_WITHIN: Duration = Duration::from_secs(10);
