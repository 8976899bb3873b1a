//! The types of an action's topics, and the status of goals in its messages.

use thiserror::Error;

use crate::node::NodeError;
use crate::publisher::TopicType;
use crate::subscription::RequestedType;
use crate::time::Ros1Time;

/// The types of an action's own topics, such as `pkg/XActionGoal`, `pkg/XActionResult` and
/// `pkg/XActionFeedback`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActionlibTypes {
    /// Type of the topic `goal`.
    pub goal: TopicType,
    /// Type of the topic `result`.
    pub result: TopicType,
    /// Type of the topic `feedback`.
    pub feedback: TopicType,
}

/// The types that a client has to know: the type of its goals. The types that it receives may be
/// left open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ClientType {
    /// Type of the topic `goal`.
    pub goal: TopicType,
    /// Type of the topic `result`.
    pub result: RequestedType,
    /// Type of the topic `feedback`.
    pub feedback: RequestedType,
}

impl ClientType {
    /// Returns a client type that accepts results and feedback of any type. The connection header
    /// of the server contains their types.
    pub fn of_goal(goal: TopicType) -> Self {
        Self {
            goal,
            result: RequestedType::default(),
            feedback: RequestedType::default(),
        }
    }
}

impl From<ActionlibTypes> for ClientType {
    fn from(action: ActionlibTypes) -> Self {
        Self {
            goal: action.goal,
            result: wanted(action.result),
            feedback: wanted(action.feedback),
        }
    }
}

/// Returns a subscription request for exactly this type.
pub(super) fn wanted(topic_type: TopicType) -> RequestedType {
    RequestedType {
        type_name: Some(topic_type.name),
        md5sum: Some(topic_type.md5sum),
    }
}

/// Refuses the type of a bare `XGoal` where the type of the `XActionGoal` around it is required.
pub(super) fn check_wrapper(type_name: &str, ending: &'static str) -> Result<(), ActionlibError> {
    if type_name.ends_with(ending) {
        Ok(())
    } else {
        Err(ActionlibError::NotAWrapper {
            type_name: type_name.to_owned(),
            ending,
        })
    }
}

/// Reason for which a client or a server could not start.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ActionlibError {
    /// A topic of the action could not be advertised or subscribed to.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The type of a topic is not the wrapper message with goal id or status.
    #[error(
        "the type `{type_name}` does not end in `{ending}`: give the wrapper's type, such as pkg/X{ending}"
    )]
    NotAWrapper {
        /// The given type.
        type_name: String,
        /// Required end of the type name.
        ending: &'static str,
    },
}

/// Identity of a goal: `actionlib_msgs/GoalID`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct ActionlibGoalId {
    /// Time of the request, by the clock of the client.
    pub stamp: Ros1Time,
    /// Id, unique among all goals of the action.
    pub id: String,
}

/// Progress of a goal: `actionlib_msgs/GoalStatus`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GoalStatus {
    /// Identity of the goal.
    pub goal_id: ActionlibGoalId,
    /// Status code.
    pub status: ActionlibStatus,
    /// Text of the server about the status, for people.
    pub text: String,
}

/// The codes of `actionlib_msgs/GoalStatus`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ActionlibStatus {
    /// 0: received and not decided.
    Pending,
    /// 1: active.
    Active,
    /// 2, final: cancelled while active.
    Preempted,
    /// 3, final: reached.
    Succeeded,
    /// 4, final: failed while active.
    Aborted,
    /// 5, final: rejected.
    Rejected,
    /// 6: active, with a cancel request.
    Preempting,
    /// 7: not decided, with a cancel request.
    Recalling,
    /// 8, final: cancelled before any work.
    Recalled,
    /// 9, final: concluded by the client, never sent.
    Lost,
}

impl ActionlibStatus {
    /// Returns the code on the wire.
    pub const fn code(self) -> u8 {
        match self {
            Self::Pending => 0,
            Self::Active => 1,
            Self::Preempted => 2,
            Self::Succeeded => 3,
            Self::Aborted => 4,
            Self::Rejected => 5,
            Self::Preempting => 6,
            Self::Recalling => 7,
            Self::Recalled => 8,
            Self::Lost => 9,
        }
    }

    /// Returns the status of a code, or `None` from 10 on.
    pub const fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            0 => Self::Pending,
            1 => Self::Active,
            2 => Self::Preempted,
            3 => Self::Succeeded,
            4 => Self::Aborted,
            5 => Self::Rejected,
            6 => Self::Preempting,
            7 => Self::Recalling,
            8 => Self::Recalled,
            9 => Self::Lost,
            _ => return None,
        })
    }

    /// Returns whether the status is final.
    pub const fn is_terminal(self) -> bool {
        match self {
            Self::Preempted
            | Self::Succeeded
            | Self::Aborted
            | Self::Rejected
            | Self::Recalled
            | Self::Lost => true,
            Self::Pending | Self::Active | Self::Preempting | Self::Recalling => false,
        }
    }
}

/// Returns the type of the topic `cancel`.
pub fn goal_id_type() -> TopicType {
    TopicType {
        name: "actionlib_msgs/GoalID".to_owned(),
        md5sum: "302881f31927c1df708a2dbab0e80ee8".to_owned(),
        definition: GOAL_ID.to_owned(),
    }
}

/// Returns the type of the topic `status`.
pub fn goal_status_array_type() -> TopicType {
    let separator = "=".repeat(80);
    let definition = format!(
        "Header header\nGoalStatus[] status_list\n\
         {separator}\nMSG: std_msgs/Header\n{HEADER}\
         {separator}\nMSG: actionlib_msgs/GoalStatus\n{GOAL_STATUS}\
         {separator}\nMSG: actionlib_msgs/GoalID\n{GOAL_ID}"
    );
    TopicType {
        name: "actionlib_msgs/GoalStatusArray".to_owned(),
        md5sum: "8b2b82f13216d0a8ea88bd3af735e619".to_owned(),
        definition,
    }
}

const HEADER: &str = "uint32 seq\ntime stamp\nstring frame_id\n";
const GOAL_ID: &str = "time stamp\nstring id\n";
const GOAL_STATUS: &str = "GoalID goal_id\nuint8 status\nuint8 PENDING=0\nuint8 ACTIVE=1\nuint8 PREEMPTED=2\n\
    uint8 SUCCEEDED=3\nuint8 ABORTED=4\nuint8 REJECTED=5\nuint8 PREEMPTING=6\nuint8 RECALLING=7\n\
    uint8 RECALLED=8\nuint8 LOST=9\nstring text\n";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_of_the_message_has_its_status_and_no_other_has() {
        for code in 0..10 {
            assert_eq!(ActionlibStatus::from_code(code).unwrap().code(), code);
        }
        assert_eq!(ActionlibStatus::from_code(10), None);
    }

    #[test]
    fn the_bare_goal_is_no_type_of_the_goal_topic() {
        assert!(check_wrapper("pkg/MoveActionGoal", "ActionGoal").is_ok());
        let refused = check_wrapper("pkg/MoveGoal", "ActionGoal").unwrap_err();
        assert!(refused.to_string().contains("pkg/XActionGoal"), "{refused}");
    }
}
