//! The observable facts of a cell in which components are plugged in.

use serde::{Deserialize, Serialize};

use super::skill_messages::{SkillResult, SkillState};

/// A component of the scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum PlugComponent {
    Robot,
    Gripper,
    Vacuum,
}

impl PlugComponent {
    pub(crate) const ALL: [Self; 3] = [Self::Robot, Self::Gripper, Self::Vacuum];

    /// Returns the name in its YAML, which is the name of its log too.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Robot => "robot",
            Self::Gripper => "parallel-gripper",
            Self::Vacuum => "vacuum-gripper",
        }
    }

    /// Returns the ApplicationUri.
    pub(crate) const fn uri(self) -> &'static str {
        match self {
            Self::Robot => "urn:example:robot",
            Self::Gripper => "urn:example:gripper",
            Self::Vacuum => "urn:example:vacuum-gripper",
        }
    }

    /// Returns the namespace number in the space.
    pub(crate) const fn namespace(self) -> u16 {
        match self {
            Self::Robot => 6,
            Self::Gripper => 7,
            Self::Vacuum => 8,
        }
    }

    pub(crate) fn of_uri(uri: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|part| part.uri() == uri)
    }

    pub(crate) fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|part| part.name() == name)
    }

    pub(crate) fn of_namespace(namespace: u16) -> Option<Self> {
        Self::ALL
            .into_iter()
            .find(|part| part.namespace() == namespace)
    }
}

/// A place where a component becomes known, or stops being known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum VisibilityLevel {
    /// Its mDNS announcement was received.
    Announced,
    /// It is registered at the discovery server.
    Registered,
    /// The MES has read its skills.
    Listed,
    /// It is in the graph.
    InGraph,
    /// A value of the component was on the network.
    InSpace,
    /// The OPC UA server of the cell has a value of the component.
    AtServer,
    /// A ROS 1 node has received a value of the component.
    Ros1,
    /// A ROS 2 node has received a value of the component.
    Ros2,
}

impl VisibilityLevel {
    pub(crate) const ALL: [Self; 8] = [
        Self::Announced,
        Self::Registered,
        Self::Listed,
        Self::InGraph,
        Self::InSpace,
        Self::AtServer,
        Self::Ros1,
        Self::Ros2,
    ];

    /// Returns the label for reaching or missing this level.
    pub(crate) const fn label(self) -> &'static str {
        match self {
            Self::Announced => "heard by mDNS",
            Self::Registered => "in the list of ua-lds",
            Self::Listed => "skills listed by ua-mes",
            Self::InGraph => "in the graph",
            Self::InSpace => "values in the space",
            Self::AtServer => "seen by ua-server",
            Self::Ros1 => "a topic in ROS 1",
            Self::Ros2 => "a topic in ROS 2",
        }
    }

    /// Returns the text for the place that a component has left.
    pub(crate) const fn gone_from(self) -> &'static str {
        match self {
            Self::Announced => "what mDNS tells",
            Self::Registered => "the list of ua-lds",
            Self::Listed => "the list of ua-mes",
            Self::InGraph => "the graph",
            Self::InSpace => "the space",
            Self::AtServer => "ua-server",
            Self::Ros1 => "the services of ROS 1",
            Self::Ros2 => "the services of ROS 2",
        }
    }
}

/// Selects the ROS 1 or the ROS 2 node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Ros {
    Ros1,
    Ros2,
}

impl Ros {
    /// Returns the name of the process.
    pub(crate) const fn node(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1-node",
            Self::Ros2 => "ros2-node",
        }
    }

    pub(crate) const fn label(self) -> &'static str {
        match self {
            Self::Ros1 => "the ROS 1 node",
            Self::Ros2 => "the ROS 2 node",
        }
    }
}

/// An event of the ROS 1 or ROS 2 node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "node", rename_all = "snake_case")]
pub(crate) enum NodeEvent {
    /// The node has joined its graph and listens.
    Up { ros: Ros },
    /// A state was received, of the first skill of the component with this namespace.
    State {
        ros: Ros,
        namespace: u16,
        state: String,
        run: u32,
    },
    /// The node requests Reset of the gripper's first skill, which is Halted.
    Resets { ros: Ros },
    /// The node requests Start of the gripper's first skill.
    Asks { ros: Ros },
    /// The response to Start, or to a refused Reset.
    Answered {
        ros: Ros,
        success: bool,
        message: String,
    },
    /// The final result of a run was received.
    Result {
        ros: Ros,
        namespace: u16,
        run: u32,
        succeeded: bool,
        message: String,
    },
}

impl NodeEvent {
    pub(crate) fn state(ros: Ros, namespace: u16, state: SkillState) -> Self {
        Self::State {
            ros,
            namespace,
            state: state.state,
            run: state.run,
        }
    }

    /// Returns whether the gripper's first skill is Halted, which requires a Reset before Start;
    /// `None` for other events.
    pub(crate) fn halted(&self) -> Option<bool> {
        match self {
            Self::State {
                namespace, state, ..
            } if *namespace == PlugComponent::Gripper.namespace() => Some(state == "Halted"),
            Self::State { .. }
            | Self::Up { .. }
            | Self::Resets { .. }
            | Self::Asks { .. }
            | Self::Answered { .. }
            | Self::Result { .. } => None,
        }
    }

    pub(crate) fn result(ros: Ros, namespace: u16, result: SkillResult) -> Self {
        Self::Result {
            ros,
            namespace,
            run: result.run,
            succeeded: result.succeeded,
            message: result.message,
        }
    }
}

/// A fact. Its time is passed separately, in nanoseconds since 1970.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Fact {
    /// The status page of a program is available.
    Ready(&'static str),
    /// The process of a component was started.
    Started(PlugComponent),
    Reached(PlugComponent, VisibilityLevel),
    /// A component is no longer known at this level.
    Left(PlugComponent, VisibilityLevel),
    Node(NodeEvent),
    /// A component was killed.
    Killed(PlugComponent),
    /// The MES has a new state of a run, counted from 0.
    Run(usize, MesRun),
    /// `ua-space call` has ended, for the run with this number.
    CallEnded {
        run: usize,
        succeeded: bool,
        why: String,
    },
    /// The result of the query.
    Asked(CanRunAnswer),
}

/// A run of the MES, with the fields of its status page that the scenario needs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub(crate) struct MesRun {
    pub(crate) process: String,
    pub(crate) started_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    pub(crate) outcome: String,
    pub(crate) reason: Option<String>,
    pub(crate) waits_for: Option<String>,
    pub(crate) plans: Vec<RunPlan>,
}

/// A plan of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub(crate) struct RunPlan {
    pub(crate) at_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    pub(crate) outcome: String,
    pub(crate) reason: Option<String>,
    pub(crate) retreated: Option<bool>,
    pub(crate) ran: Vec<ExecutedSkill>,
}

/// A skill that a plan has run.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(default)]
pub(crate) struct ExecutedSkill {
    pub(crate) step: String,
    /// The ApplicationUri.
    pub(crate) component: String,
    pub(crate) started_ms: u64,
    pub(crate) ended_ms: Option<u64>,
    pub(crate) outcome: String,
}

/// The result of `ua-space ask what-can-run`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct CanRunAnswer {
    pub(crate) skills: usize,
    pub(crate) services: usize,
    /// Rows without capabilities, endpoint or name.
    pub(crate) incomplete: Vec<String>,
}
