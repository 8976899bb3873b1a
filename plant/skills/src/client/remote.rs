//! Pick and place by the skills of two servers.

use std::sync::Arc;

use async_trait::async_trait;

use super::{ClientOptions, SkillClient, SkillHandle};
use crate::component::Partners;
use crate::composite::{self, PickAndPlace};
use crate::driver::{Driver, Results, Work};
use crate::parameters::{Parameters, TypeName};

/// The driver of PickAndPlaceSkillType that runs the skills of a robot and a gripper, each behind its endpoint. It has their
/// leases for as long as a run takes.
#[derive(Debug, Clone)]
pub struct Remote {
    partners: Partners,
}

impl Remote {
    /// One of these two.
    #[must_use]
    pub fn new(partners: Partners) -> Self {
        Self { partners }
    }
}

#[async_trait]
impl Driver for Remote {
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
        let robot = connect(&self.partners.robot).await?;
        let done = match connect(&self.partners.gripper).await {
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
    async fn with(
        &self,
        robot: &SkillClient,
        gripper: &SkillClient,
        work: &Work,
    ) -> Result<Results, String> {
        let composite = PickAndPlace {
            ptp: Arc::new(one(robot, "PtpMoveSkillType").await?),
            linear: Arc::new(one(robot, "LinearMoveSkillType").await?),
            grasp: Arc::new(one(gripper, "GraspSkillType").await?),
            release: Arc::new(one(gripper, "ReleaseSkillType").await?),
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

async fn connect(endpoint: &str) -> Result<SkillClient, String> {
    let connected = SkillClient::connect(endpoint, &ClientOptions::default()).await;
    connected.map_err(|fault| format!("{endpoint}: {fault}"))
}

/// The first skill of a type.
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
