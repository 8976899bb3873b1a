//! The robot, the tool and the object of a pick and place, looked up for each run.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::time::timeout;

use super::found::FoundSkill;
use super::{Detected, Detector, PeerAccess, SkillClient};
use crate::choosing::{
    Attachment, CandidateRank, NoChoice, SkillCandidate, SkillChoice, UnfitCandidate, choose,
};
use crate::component::{Partner, WorldObject};
use crate::frame::Frame;
use crate::grip::PartShape;
use crate::out_of_workspace::OutOfWorkspace;
use crate::parameters::ParameterType;
use crate::partner_error::{
    AttachedElsewhere, FailedLocator, LocatorError, NotLocated, PartnerError, Unchosen, UnfitGrasp,
};
use crate::runs::RunnableSkill as _;
use crate::shown::RunOutcome;
use crate::tool_state::{ToolState, is_same_endpoint};
use crate::value::SkillValue;
use crate::workspace::RobotWorkspace;

/// A component that has the skills for a part of the work.
#[derive(Debug, Clone, PartialEq)]
struct SkilledComponent {
    endpoint: String,
    application_uri: String,
    /// The workspaces of its moves.
    workspaces: Vec<RobotWorkspace>,
}

/// A component that was chosen, and the reasons for and against the candidates.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Chosen {
    /// The endpoint.
    pub endpoint: String,
    /// The reason, for the trace.
    pub reason: String,
    /// The other candidates, each with the reason why it was not chosen.
    pub others: Vec<String>,
}

/// The requirements of a run for its robot.
#[derive(Debug, Clone, Default)]
pub struct Needs<'a> {
    /// The positions that the robot has to reach, m.
    pub positions: &'a [[f64; 3]],
    /// The preferred ApplicationUris, the most preferred first.
    pub prefer: &'a [String],
}

impl SkilledComponent {
    /// Returns the reason why the component cannot do the work, if any.
    fn reaches(&self, positions: &[[f64; 3]]) -> Result<(), OutOfWorkspace> {
        let workspaces = self.workspaces.iter();
        let mut all = workspaces.map(|of| of.allows_all(positions));
        all.find(Result::is_err).unwrap_or(Ok(()))
    }

    fn candidate(
        &self,
        fits: Result<(), UnfitCandidate>,
        attachment: Attachment,
        prefer: &[String],
    ) -> SkillCandidate<&Self> {
        SkillCandidate {
            of: self,
            name: self.application_uri.clone(),
            fits,
            rank: CandidateRank {
                attachment,
                preference: CandidateRank::preference(prefer, &self.application_uri),
                ..CandidateRank::default()
            },
        }
    }
}

/// Chooses among components, and returns the reasons by their ApplicationUris.
fn chosen(
    what: &'static str,
    candidates: Vec<SkillCandidate<&SkilledComponent>>,
) -> Result<Chosen, Unchosen> {
    match choose(candidates) {
        Ok(SkillChoice {
            chosen,
            reason,
            others,
        }) => Ok(Chosen {
            endpoint: chosen.endpoint.clone(),
            reason,
            others: reasons(others),
        }),
        Err(NoChoice::NoneFits(others)) => Err(Unchosen::NoneFits {
            candidate: what,
            reasons: reasons(others),
        }),
        Err(NoChoice::Equal(equal)) => Err(Unchosen::Several {
            candidate: what,
            list: list(&equal),
        }),
    }
}

fn reasons(others: Vec<(&SkilledComponent, String)>) -> Vec<String> {
    let others = others.into_iter();
    others
        .map(|(of, why)| format!("{}: {why}", of.application_uri))
        .collect()
}

/// The tool of a pick and place.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ChosenTool {
    pub(super) endpoint: String,
    /// The tool plate in the frame of the flange.
    pub(super) plate: Frame,
    /// Why this tool was chosen, for the trace.
    pub(super) reason: String,
}

impl PeerAccess {
    /// Chooses the robot. A given robot counts. Otherwise the robot reaches the positions, and of
    /// several such robots it has a tool at its changer or is the most preferred.
    ///
    /// # Errors
    /// There is no robot, or several are equal; with the reason for each candidate.
    pub async fn robot(
        &self,
        given: Option<&Partner>,
        needs: &Needs<'_>,
    ) -> Result<Chosen, PartnerError> {
        let wrong = PartnerError::Robot;
        if let Some(partner) = given {
            let endpoint = self.endpoint(partner).await?;
            let known = self.detector.as_ref().map(Detector::all);
            let robots = having(&known.unwrap_or_default(), &[]);
            if let Some(robot) = robots.iter().find(|one| is_at(one, &endpoint)) {
                let reached = robot.reaches(needs.positions);
                reached.map_err(|why| {
                    let uri = robot.application_uri.clone();
                    wrong(Unchosen::OutOfWorkspace { uri, why })
                })?;
            }
            return Ok(Chosen {
                endpoint,
                reason: "named".to_owned(),
                others: Vec::new(),
            });
        }
        let detector = self.detector.as_ref();
        let detector = detector.ok_or_else(|| wrong(Unchosen::NoDiscovery))?;
        let robots = candidates(detector, &MOVES).await;
        if robots.is_empty() {
            return Err(wrong(no_robot(detector)));
        }
        let reached: Vec<_> = robots
            .iter()
            .map(|robot| robot.reaches(needs.positions))
            .collect();
        let movers = match reached.iter().filter(|reached| reached.is_ok()).count() {
            0 | 1 => Vec::new(),
            _ => self.movers_with_tools(detector).await,
        };
        let judged = robots.iter().zip(reached).map(|(robot, fits)| {
            let carries = movers.iter().any(|mover| is_at(robot, mover));
            let attachment = match carries {
                true => Attachment::CarriesTool,
                false => Attachment::None,
            };
            let fits = fits.map_err(UnfitCandidate::from);
            robot.candidate(fits, attachment, needs.prefer)
        });
        chosen("robot", judged.collect()).map_err(wrong)
    }

    /// Returns the robot that carries a tool changer: the given robot, or the only robot. It is
    /// chosen neither by its reach nor by its tool, because the changer is on one robot only.
    ///
    /// # Errors
    /// There is no robot, there are several, or the robot does not reach a position, m.
    pub async fn carrier(
        &self,
        given: Option<&Partner>,
        positions: &[[f64; 3]],
    ) -> Result<Chosen, PartnerError> {
        let robot = match given {
            Some(partner) => partner.clone(),
            None => Partner::At(self.only_robot().await.map_err(PartnerError::Robot)?),
        };
        let needs = Needs {
            positions,
            ..Needs::default()
        };
        self.robot(Some(&robot), &needs).await
    }

    /// Returns the endpoint of the only robot.
    async fn only_robot(&self) -> Result<String, Unchosen> {
        let detector = self.detector.as_ref().ok_or(Unchosen::NoDiscovery)?;
        let robots = candidates(detector, &MOVES).await;
        match robots.as_slice() {
            [] => Err(no_robot(detector)),
            [robot] => Ok(robot.endpoint.clone()),
            several => Err(Unchosen::Several {
                candidate: "robot",
                list: list(&several.iter().collect::<Vec<_>>()),
            }),
        }
    }

    /// Returns the robots that carry a tool at a tool changer.
    async fn movers_with_tools(&self, detector: &Detector) -> Vec<String> {
        let changers = self.changers(detector).await.into_iter();
        let carrying = changers.filter(|(_, state)| state.tool().is_some());
        carrying.map(|(_, state)| state.mover).collect()
    }

    /// Returns the tool at the flange of a robot.
    pub(super) async fn tool(
        &self,
        given: Option<&Partner>,
        mover: &str,
        prefer: &[String],
    ) -> Result<ChosenTool, PartnerError> {
        let wrong = PartnerError::Tool;
        let Some(detector) = &self.detector else {
            let partner = given.ok_or_else(|| wrong(Unchosen::NoDiscovery))?;
            return Ok(ChosenTool {
                endpoint: self.endpoint(partner).await?,
                plate: Frame::IDENTITY,
                reason: "named".to_owned(),
            });
        };
        let changers = self.changers(detector).await;
        let uri = uri_at(detector, mover);
        let mounted = changers
            .iter()
            .find(|(_, state)| state.is_at((&uri, mover)));
        let named = match given {
            Some(partner) => Some(self.endpoint(partner).await?),
            None => None,
        };
        if let Some((changer, state)) = mounted {
            let changer = changer.clone();
            let Some(current) = &state.current else {
                return Err(wrong(Unchosen::UnknownTool { changer }));
            };
            if current.is_empty() {
                return Err(wrong(Unchosen::NoTool { changer }));
            }
            let attached = self.endpoint(&Partner::Called(current.clone())).await?;
            if let Some(named) = named.filter(|named| !is_same_endpoint(named, &attached)) {
                return Err(wrong(Unchosen::OtherTool {
                    named,
                    changer,
                    current: current.clone(),
                }));
            }
            return Ok(ChosenTool {
                endpoint: attached,
                plate: Frame::of_pose(state.plate),
                reason: format!("{current} is attached to {changer}"),
            });
        }
        let at_flange = |endpoint: String, reason: &str| ChosenTool {
            endpoint,
            plate: Frame::IDENTITY,
            reason: reason.to_owned(),
        };
        if let Some(named) = named {
            let gripper = uri_at(detector, &named);
            let elsewhere = attached_elsewhere(&changers, &gripper);
            elsewhere.map_err(|why| wrong(why.into()))?;
            return Ok(at_flange(named, "named"));
        }
        let grippers = candidates(detector, &["GraspSkillType", "ReleaseSkillType"]).await;
        if let Some(own) = grippers.iter().find(|one| is_at(one, mover)) {
            return Ok(at_flange(own.endpoint.clone(), "the gripper of the robot"));
        }
        if grippers.is_empty() {
            let unreadable = detector.unreadable();
            let candidate = "gripper".to_owned();
            return Err(wrong(Unchosen::Missing {
                candidate,
                unreadable,
            }));
        }
        let all = grippers.iter();
        let judged = all.map(|gripper| {
            let fits = attached_elsewhere(&changers, &gripper.application_uri);
            let fits = fits.map_err(UnfitCandidate::from);
            gripper.candidate(fits, Attachment::None, prefer)
        });
        let Chosen {
            endpoint, reason, ..
        } = chosen("gripper", judged.collect()).map_err(wrong)?;
        Ok(at_flange(endpoint, &reason))
    }

    /// Reads the state of all tool changers.
    async fn changers(&self, detector: &Detector) -> Vec<(String, ToolState)> {
        let of = ParameterType::own("ToolSkillType");
        let mut endpoints: BTreeMap<String, (String, ToolState)> = BTreeMap::new();
        for found in detector.of_type(&of) {
            if let Some(state) = found.skill.tool_state {
                endpoints.insert(found.endpoint, (found.application_uri, state));
            }
        }
        let mut states = Vec::new();
        for (endpoint, (application_uri, known)) in endpoints {
            // The state may be newer than discovery. The tool of a changer that does not answer is
            // unknown.
            let state = timeout(READ_WITHIN, self.tool_state(&endpoint)).await;
            let state = state.ok().flatten();
            let state = state.unwrap_or(ToolState {
                current: None,
                ..known
            });
            states.push((application_uri, state));
        }
        states
    }

    async fn tool_state(&self, endpoint: &str) -> Option<ToolState> {
        let client = self.connect(endpoint).await.ok()?;
        let found = client.skills_of(&ParameterType::own("ToolSkillType")).await;
        client.close().await;
        found.ok()?.into_iter().find_map(|skill| skill.tool_state)
    }

    /// Finds an object by the skills of other components that locate objects. `ua-mes`, which knows
    /// the graph of the plant, is asked first.
    pub(super) async fn locate(&self, id: &str) -> Result<WorldObject, NotLocated> {
        let detector = self.detector.as_ref().ok_or(NotLocated::NoDiscovery)?;
        let of = ParameterType::own("LocateObjectSkillType");
        let some = detector.one(&of, FOUND_WITHIN, |_| true).await;
        some.map_err(|_| NotLocated::NoLocator)?;
        let mut locators = detector.of_type(&of);
        let executes = ParameterType::own("ExecuteProcessSkillType");
        let executors = detector.of_type(&executes);
        locators.sort_by_key(|one| !executors.iter().any(|of| of.endpoint == one.endpoint));
        let mut failed = Vec::new();
        for locator in locators {
            match self.located(&locator, id).await {
                Ok(object) => return Ok(object),
                Err(why) => failed.push(FailedLocator {
                    skill: name_of(&locator.skill),
                    why,
                }),
            }
        }
        Err(NotLocated::Failed { failed })
    }

    async fn located(&self, locator: &Detected, id: &str) -> Result<WorldObject, LocatorError> {
        let connected = SkillClient::connect(&locator.endpoint, &self.options).await;
        let client = connected.map_err(|fault| LocatorError::Component {
            endpoint: locator.endpoint.clone(),
            fault,
        })?;
        let handle = client.handle(&locator.skill);
        let given = vec![("ObjectId".to_owned(), SkillValue::from(id))];
        let ran = handle.run(given, LOCATED_WITHIN).await;
        client.close().await;
        let outcome = ran?;
        if !outcome.succeeded {
            let message = outcome.message;
            return Err(LocatorError::Failed { message });
        }
        object_of(&outcome).ok_or(LocatorError::NoPose)
    }
}

/// Returns the pose of the tool plate of a gripper in the frame of the flange of a robot: that of
/// the tool changer between them, or zeros without one. The robot is given by its ApplicationUri
/// and its endpoint, the gripper by its ApplicationUri, and the tool changers by their names.
///
/// # Errors
/// The tool changer of the robot has another tool, no tool or an unknown one, or the gripper is
/// attached to the tool changer of another robot.
pub fn plate_between(
    changers: &[(String, ToolState)],
    robot: (&str, &str),
    gripper: &str,
) -> Result<[f64; 6], Unchosen> {
    let mut all = changers.iter();
    let Some((changer, state)) = all.find(|(_, state)| state.is_at(robot)) else {
        attached_elsewhere(changers, gripper)?;
        return Ok([0.0; 6]);
    };
    let changer = changer.clone();
    match state.current.as_deref() {
        None => Err(Unchosen::UnknownTool { changer }),
        Some("") => Err(Unchosen::NoTool { changer }),
        Some(current) if current == gripper => Ok(state.plate),
        Some(current) => Err(Unchosen::OtherTool {
            named: gripper.to_owned(),
            changer,
            current: current.to_owned(),
        }),
    }
}

/// Checks that a gripper is attached to no tool changer, so that it may be at a flange.
fn attached_elsewhere(
    changers: &[(String, ToolState)],
    gripper: &str,
) -> Result<(), AttachedElsewhere> {
    let mut all = changers.iter();
    let holder = all.find(|(_, state)| state.tool() == Some(gripper));
    holder.map_or(Ok(()), |(changer, state)| {
        Err(AttachedElsewhere {
            tool: gripper.to_owned(),
            changer: changer.clone(),
            robot: state.mover.clone(),
        })
    })
}

fn no_robot(detector: &Detector) -> Unchosen {
    Unchosen::Missing {
        candidate: format!("robot with {}", MOVES.join(" and ")),
        unreadable: detector.unreadable(),
    }
}

/// Returns the object in the results of a skill that locates objects. Zeros are unknown lengths.
fn object_of(outcome: &RunOutcome) -> Option<WorldObject> {
    let numbers = |name: &str| {
        let mut results = outcome.results.iter();
        let found = results.find(|(known, _)| known == name);
        found.and_then(|(_, value)| value.as_f64s())
    };
    let known = |numbers: Vec<f64>| Some(numbers).filter(|all| all.iter().all(|one| *one > 0.0));
    let cuboid: Option<[f64; 3]> = numbers("Box")
        .and_then(known)
        .and_then(|all| all.try_into().ok());
    let cylinder: Option<[f64; 2]> = numbers("Cylinder")
        .and_then(known)
        .and_then(|all| all.try_into().ok());
    let shape = cuboid.map(PartShape::Box);
    let mass = outcome.results.iter().find(|(name, _)| name == "Mass");
    Some(WorldObject {
        pose: numbers("Pose")?.try_into().ok()?,
        shape: shape.or_else(|| {
            cylinder.map(|[diameter, height]| PartShape::Cylinder { diameter, height })
        }),
        mass: mass
            .and_then(|(_, mass)| mass.as_f64())
            .filter(|mass| *mass > 0.0),
    })
}

fn name_of(skill: &FoundSkill) -> String {
    format!("{}.{}", skill.component, skill.name)
}

fn is_at(one: &SkilledComponent, place: &str) -> bool {
    is_same_endpoint(&one.endpoint, place) || one.application_uri == place
}

fn uri_at(detector: &Detector, endpoint: &str) -> String {
    let all = detector.all();
    let found = all
        .into_iter()
        .find(|one| is_same_endpoint(&one.endpoint, endpoint));
    found.map(|one| one.application_uri).unwrap_or_default()
}

fn list(candidates: &[&SkilledComponent]) -> String {
    let each = candidates
        .iter()
        .map(|one| format!("{} at {}", one.application_uri, one.endpoint));
    each.collect::<Vec<_>>().join(", ")
}

/// Returns the components that have skills of all these types. Waits until there is one.
async fn candidates(detector: &Detector, types: &[&str]) -> Vec<SkilledComponent> {
    let mut changes = detector.changes();
    let find = async {
        loop {
            changes.borrow_and_update();
            let found = having(&detector.all(), types);
            if !found.is_empty() {
                return found;
            }
            // The sender is owned by the detector.
            let _changed = changes.changed().await;
        }
    };
    timeout(FOUND_WITHIN, find).await.unwrap_or_default()
}

fn having(all: &[Detected], types: &[&str]) -> Vec<SkilledComponent> {
    let mut components: BTreeMap<&str, (&str, Vec<&FoundSkill>)> = BTreeMap::new();
    for one in all {
        let entry = components.entry(&one.endpoint);
        let (_, skills) = entry.or_insert((&one.application_uri, Vec::new()));
        skills.push(&one.skill);
    }
    let has_all = |skills: &[&FoundSkill]| {
        let has = |name: &&str| {
            skills
                .iter()
                .any(|skill| skill.is_of(&ParameterType::own(name)))
        };
        types.iter().all(has)
    };
    let found = components
        .into_iter()
        .filter(|(_, (_, skills))| has_all(skills));
    found
        .map(|(endpoint, (application_uri, skills))| SkilledComponent {
            endpoint: endpoint.to_owned(),
            application_uri: application_uri.to_owned(),
            workspaces: skills
                .iter()
                .filter_map(|skill| skill.workspace.clone())
                .collect(),
        })
        .collect()
}

/// Opens the grasp skill of a tool that fits a part. Returns it with the skills that do not fit.
pub(super) async fn fitting_grasp(
    client: &SkillClient,
    shape: Option<&PartShape>,
) -> Result<(FoundSkill, Vec<UnfitGrasp>), PartnerError> {
    let of = ParameterType::own("GraspSkillType");
    let endpoint = || client.endpoint().to_owned();
    let found = client.skills_of(&of).await;
    let found = found.map_err(|fault| PartnerError::Component {
        endpoint: endpoint(),
        fault,
    })?;
    if found.is_empty() {
        return Err(PartnerError::NoSkill {
            endpoint: endpoint(),
            skill_type: "GraspSkillType".to_owned(),
        });
    }
    let mut unfit = Vec::new();
    for skill in found {
        let fits = skill
            .grip_point
            .map_or(Ok(()), |grip| grip.on(shape).map(drop));
        match fits {
            Ok(()) => return Ok((skill, unfit)),
            Err(why) => unfit.push(UnfitGrasp {
                skill: name_of(&skill),
                why,
            }),
        }
    }
    Err(PartnerError::NoFittingGrasp { unfit })
}

/// The skills of a robot.
const MOVES: [&str; 2] = ["PtpMoveSkillType", "LinearMoveSkillType"];
/// Time limit to find a component.
const FOUND_WITHIN: Duration = Duration::from_secs(10);
/// Time limit to read the state of a tool changer.
const READ_WITHIN: Duration = Duration::from_secs(5);
/// Time limit for the run of a skill that locates an object.
const LOCATED_WITHIN: Duration = Duration::from_secs(30);
