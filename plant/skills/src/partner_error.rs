//! The reasons why the components of a pick and place are not found, or do not fit.

use crate::grip::GripError;
use crate::out_of_workspace::OutOfWorkspace;
use crate::skill_fault::SkillFault;

/// The reason why a composite skill has no robot, no tool or no object.
#[derive(Debug, thiserror::Error)]
pub enum PartnerError {
    /// A component refuses the connection, or does not answer.
    #[error("{endpoint}: {fault}")]
    Component {
        /// The endpoint of the component.
        endpoint: String,
        /// The reason.
        fault: SkillFault,
    },
    /// A request to a skill failed.
    #[error(transparent)]
    Skill(#[from] SkillFault),
    /// The component is named by its ApplicationUri, and discovery is not running.
    #[error("{uri} cannot be found: discovery is not running")]
    Undiscoverable {
        /// The ApplicationUri.
        uri: String,
    },
    /// No server has the ApplicationUri.
    #[error("{uri} is not found{unreadable}")]
    NotFound {
        /// The ApplicationUri.
        uri: String,
        /// The servers that could not be read.
        unreadable: String,
    },
    /// No robot can be chosen.
    #[error("MoveSkillControllerEndpoint: {0}")]
    Robot(Unchosen),
    /// No tool can be chosen.
    #[error("ToolSkillControllerEndpoint: {0}")]
    Tool(Unchosen),
    /// The component has no skill of a type.
    #[error("{endpoint} has no skill of {skill_type}")]
    NoSkill {
        /// The endpoint of the component.
        endpoint: String,
        /// The skill type.
        skill_type: String,
    },
    /// No grasp skill of the tool fits the object.
    #[error("{}", each(unfit))]
    NoFittingGrasp {
        /// The skills with the reasons.
        unfit: Vec<UnfitGrasp>,
    },
    /// The object is not found.
    #[error("ObjectId `{id}` is not in the world of this component, and {why}")]
    Object {
        /// The identifier of the object.
        id: String,
        /// The reason.
        why: NotLocated,
    },
}

/// The reason why no robot or no tool is chosen.
#[derive(Debug, thiserror::Error)]
pub enum Unchosen {
    /// Discovery is not running.
    #[error("discovery is not running")]
    NoDiscovery,
    /// The named robot does not reach a position.
    #[error("{uri}: {why}")]
    OutOfWorkspace {
        /// The ApplicationUri of the robot.
        uri: String,
        /// The position and the limit.
        why: OutOfWorkspace,
    },
    /// There is no candidate.
    #[error("no {candidate} is found{unreadable}")]
    Missing {
        /// The kind of component, as `gripper`.
        candidate: String,
        /// The servers that could not be read.
        unreadable: String,
    },
    /// No candidate fits.
    #[error("no {candidate} fits: {}", reasons.join("; "))]
    NoneFits {
        /// The kind of component, as `gripper`.
        candidate: &'static str,
        /// The candidates with their reasons.
        reasons: Vec<String>,
    },
    /// Several candidates are equal.
    #[error("several {candidate}s are found, give one of {list}")]
    Several {
        /// The kind of component, as `gripper`.
        candidate: &'static str,
        /// The candidates.
        list: String,
    },
    /// The state of the tool changer is unknown.
    #[error("the tool at {changer} is unknown")]
    UnknownTool {
        /// The ApplicationUri of the changer.
        changer: String,
    },
    /// The tool changer has no tool.
    #[error("no tool is attached to {changer}")]
    NoTool {
        /// The ApplicationUri of the changer.
        changer: String,
    },
    /// The tool is attached to a tool changer that is not known to be at the robot.
    #[error(transparent)]
    AttachedElsewhere(#[from] AttachedElsewhere),
    /// The named tool is not attached.
    #[error("{named} is not attached to {changer}, which has {current}")]
    OtherTool {
        /// The endpoint of the named tool.
        named: String,
        /// The ApplicationUri of the changer.
        changer: String,
        /// The ApplicationUri of the attached tool.
        current: String,
    },
}

/// A tool that is attached to a tool changer that is not known to be at the robot.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{tool} is attached to {changer}, {}", match &**robot {
    "" => "which does not show its robot".to_owned(),
    robot => format!("which is at another robot, {robot}"),
})]
pub struct AttachedElsewhere {
    /// The ApplicationUri of the tool.
    pub tool: String,
    /// The ApplicationUri of the changer.
    pub changer: String,
    /// The robot that the changer shows; empty if it shows none.
    pub robot: String,
}

/// A grasp skill that does not fit an object.
#[derive(Debug, thiserror::Error)]
#[error("{skill} does not fit: {why}")]
pub struct UnfitGrasp {
    /// The component and the name of the skill.
    pub skill: String,
    /// The reason.
    pub why: GripError,
}

/// The reason why an object is not located.
#[derive(Debug, thiserror::Error)]
pub enum NotLocated {
    /// Discovery is not running.
    #[error("discovery is not running")]
    NoDiscovery,
    /// No component locates objects.
    #[error("no component with a skill that locates objects is found")]
    NoLocator,
    /// All skills that locate objects failed.
    #[error("{}", each(failed))]
    Failed {
        /// The skills with the reasons.
        failed: Vec<FailedLocator>,
    },
}

/// A skill that did not locate an object.
#[derive(Debug, thiserror::Error)]
#[error("{skill}: {why}")]
pub struct FailedLocator {
    /// The component and the name of the skill.
    pub skill: String,
    /// The reason.
    pub why: LocatorError,
}

/// The reason why one skill did not locate an object.
#[derive(Debug, thiserror::Error)]
pub enum LocatorError {
    /// The component refuses the connection, or does not answer.
    #[error("{endpoint}: {fault}")]
    Component {
        /// The endpoint of the component.
        endpoint: String,
        /// The reason.
        fault: SkillFault,
    },
    /// There is no outcome.
    #[error(transparent)]
    Skill(#[from] SkillFault),
    /// The run failed with this message.
    #[error("{message}")]
    Failed {
        /// The message of the run.
        message: String,
    },
    /// The results have no pose.
    #[error("the result has no Pose")]
    NoPose,
}

fn each<T: std::fmt::Display>(all: &[T]) -> String {
    let texts: Vec<String> = all.iter().map(T::to_string).collect();
    texts.join("; ")
}
