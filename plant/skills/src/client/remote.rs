//! Pick and place with the skills of other components.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;

use super::choice::{Chosen, Needs, fitting_grasp};
use super::{PartnerError, PeerAccess, SkillClient, SkillHandle};
use crate::component::{Partner, Partners, World, WorldObject};
use crate::composite::{Job, PickAndPlace};
use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::{DriverError, InvalidParameter};
use crate::frame::Frame;
use crate::parameters::{ParameterType, Parameters};
use crate::runs::COMPOSITE_HALT_TIMEOUT;

/// The driver of PickAndPlaceSkillType that runs the skills of a robot and a gripper on separate
/// servers. It holds their leases during a run.
#[derive(Debug, Clone)]
pub struct Remote {
    partners: Partners,
    world: World,
    peers: PeerAccess,
}

impl Remote {
    /// Creates a driver. Partners that are not given are found for each run, and objects are looked
    /// up in `world` first.
    #[must_use]
    pub fn new(partners: Partners, world: World, peers: PeerAccess) -> Self {
        Self {
            partners,
            world,
            peers,
        }
    }
}

#[async_trait]
impl Driver for Remote {
    /// Halt waits for the end of the skills that do the work.
    fn halt_timeout(&self) -> Option<Duration> {
        Some(COMPOSITE_HALT_TIMEOUT)
    }

    fn check(&self, parameters: &Parameters) -> Result<(), InvalidParameter> {
        numbers(parameters, "PlacePosition")?;
        for name in [TOOL, MOVER] {
            named(parameters, name)?;
        }
        let id = parameters.text("ObjectId").unwrap_or_default();
        if pick(parameters).is_some() {
            return Ok(());
        }
        let expected = if id.is_empty() {
            "or PickPosition must be given: neither says what to pick".to_owned()
        } else if self.peers.detector.is_none() && !self.world.contains_key(id) {
            format!("`{id}` is not in the world of this component")
        } else {
            return Ok(());
        };
        Err(InvalidParameter::Unexpected {
            name: "ObjectId".to_owned(),
            given: Some(id.into()),
            expected,
        })
    }

    fn uses(&self) -> Vec<String> {
        let Partners { robot, gripper, .. } = &self.partners;
        let of = |partner: &Option<Partner>, types: [&str; 2]| {
            let who = partner
                .as_ref()
                .map_or_else(|| "any".to_owned(), Partner::to_string);
            types.map(|of| format!("{who} {of}"))
        };
        let moves = of(robot, ["PtpMoveSkillType", "LinearMoveSkillType"]);
        let grips = of(gripper, ["GraspSkillType", "ReleaseSkillType"]);
        moves.into_iter().chain(grips).collect()
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let found = tokio::select! {
            found = self.find(&work) => found?,
            () = work.stopped() => return Err(DriverError::Stopped),
        };
        let robot = self.peers.connect(&found.mover).await?;
        if found.mover == found.tool {
            // A component has one lease, so one session is used for both.
            let done = self.with(&robot, &robot, &found, &work).await;
            robot.close().await;
            return done;
        }
        let done = match self.peers.connect(&found.tool).await {
            Ok(gripper) => {
                let done = self.with(&robot, &gripper, &found, &work).await;
                gripper.close().await;
                done
            }
            Err(why) => Err(why.into()),
        };
        robot.close().await;
        done
    }
}

/// The object, the robot and the tool of a run.
struct Found {
    job: Job,
    mover: String,
    tool: String,
    plate: Frame,
}

impl Remote {
    /// Finds the object, the robot and the tool. Nothing moves before all of them are found.
    async fn find(&self, work: &Work) -> Result<Found, DriverError> {
        let parameters = work.parameters();
        let object = self.object(parameters, work).await?;
        let given = named(parameters, MOVER)?;
        let given = given.or_else(|| self.partners.robot.clone());
        let place = numbers(parameters, "PlacePosition")?;
        let positions = [object.pose, place].map(|[x, y, z, ..]| [x, y, z]);
        let needs = Needs {
            positions: &positions,
            prefer: &self.partners.prefer,
        };
        let Chosen {
            endpoint: mover,
            reason,
            others,
        } = self.peers.robot(given.as_ref(), &needs).await?;
        work.note(format!("robot at {mover}: {reason}")).await;
        for other in others {
            work.note(format!("robot not chosen: {other}")).await;
        }
        let given = named(parameters, TOOL)?;
        let given = given.or_else(|| self.partners.gripper.clone());
        let prefer = &self.partners.prefer;
        let tool = self.peers.tool(given.as_ref(), &mover, prefer).await?;
        work.note(format!("tool at {}: {}", tool.endpoint, tool.reason))
            .await;
        let plate = self.partners.plate.map_or(tool.plate, Frame::of_pose);
        let job = Job {
            pick: object.pose,
            place,
            approach: parameters
                .number("ApproachOffset")
                .ok_or_else(|| InvalidParameter::missing("ApproachOffset", "number"))?,
            shape: object.shape,
        };
        Ok(Found {
            job,
            mover,
            tool: tool.endpoint,
            plate,
        })
    }

    /// Looks up the object: PickPosition, the table of this component, then other components.
    async fn object(
        &self,
        parameters: &Parameters,
        work: &Work,
    ) -> Result<WorldObject, PartnerError> {
        let id = parameters.text("ObjectId").unwrap_or_default();
        let known = self.world.get(id).cloned();
        if let Some(pose) = pick(parameters) {
            let unknown = WorldObject {
                pose,
                shape: None,
                mass: None,
            };
            return Ok(WorldObject {
                pose,
                ..known.unwrap_or(unknown)
            });
        }
        if let Some(object) = known {
            work.note(format!("object {id}: listed in `world`")).await;
            return Ok(object);
        }
        let located = self.peers.locate(id).await;
        let object = located.map_err(|why| PartnerError::Object {
            id: id.to_owned(),
            why,
        })?;
        work.note(format!("object {id}: located")).await;
        Ok(object)
    }

    async fn with(
        &self,
        robot: &SkillClient,
        gripper: &SkillClient,
        found: &Found,
        work: &Work,
    ) -> Result<RunResults, DriverError> {
        let (grasp, unfit) = fitting_grasp(gripper, found.job.shape.as_ref()).await?;
        for unfit in unfit {
            work.note(unfit.to_string()).await;
        }
        let grasp = gripper.handle(&grasp);
        let ptp = one(robot, "PtpMoveSkillType").await?;
        // Both components are locked before the work starts, so that a waiting client cannot
        // acquire one of them during the work.
        let apart = robot.endpoint() != gripper.endpoint();
        for first in [Some(&ptp), apart.then_some(&grasp)].into_iter().flatten() {
            let locked = first.lock("pick and place").await;
            locked.map_err(PartnerError::from)?;
        }
        let composite = PickAndPlace {
            ptp: Arc::new(ptp),
            linear: Arc::new(one(robot, "LinearMoveSkillType").await?),
            grasp: Arc::new(grasp),
            release: Arc::new(one(gripper, "ReleaseSkillType").await?),
            plate: found.plate,
            within: self.partners.within,
        };
        composite.run(&found.job, work).await?;
        Ok(Vec::new())
    }
}

/// Returns the pose of the object, unless it is left to ObjectId.
fn pick(parameters: &Parameters) -> Option<[f64; 6]> {
    let pose = parameters.six("PickPosition")?;
    pose.iter().any(|number| *number != 0.0).then_some(pose)
}

fn numbers(parameters: &Parameters, name: &str) -> Result<[f64; 6], InvalidParameter> {
    let numbers = parameters.six(name);
    numbers.ok_or_else(|| InvalidParameter::missing(name, "six numbers"))
}

/// Returns the component that a parameter names.
fn named(parameters: &Parameters, name: &str) -> Result<Option<Partner>, InvalidParameter> {
    match parameters.text(name).unwrap_or_default() {
        "" => Ok(None),
        uri if uri.starts_with("urn:") => Ok(Some(Partner::Called(uri.to_owned()))),
        url if url.starts_with("opc.tcp://") => Ok(Some(Partner::At(url.to_owned()))),
        other => Err(InvalidParameter::Unexpected {
            name: name.to_owned(),
            given: Some(other.into()),
            expected: format!(
                "is an endpoint, an ApplicationUri or empty, and `{}` was given",
                crate::parameters::shortened(other)
            ),
        }),
    }
}

/// Returns the first skill of a type.
async fn one(client: &SkillClient, of: &str) -> Result<SkillHandle, PartnerError> {
    let found = client
        .skills_of(&ParameterType::own(of))
        .await
        .map_err(|fault| PartnerError::Component {
            endpoint: client.endpoint().to_owned(),
            fault,
        })?;
    let first = found.first().ok_or_else(|| PartnerError::NoSkill {
        endpoint: client.endpoint().to_owned(),
        skill_type: of.to_owned(),
    })?;
    Ok(client.handle(first))
}

const TOOL: &str = "ToolSkillControllerEndpoint";
const MOVER: &str = "MoveSkillControllerEndpoint";
/// Time limit to find a partner.
pub(super) const FOUND_WITHIN: Duration = Duration::from_secs(10);
