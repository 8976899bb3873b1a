//! Calls of the mapping: the executor of each call, and the services and actions that offer it
//! elsewhere.

use std::time::Duration;

use messages::{Literal, TypeName};

use crate::node_id::{ExpandedNodeIdText, NodeIdText};
use crate::permission::Role;
use crate::remote::Access;
use crate::topic::{SpaceId, TopicId};

/// Call of the space: an OPC UA Method, its executor, and the services or actions that offer it in
/// other spaces.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Call {
    /// Origin, namespace index, and the node's numeric identifier or alias. An action takes five
    /// identifiers and this is the first, see [`CallKind::Action`].
    pub topic: TopicId,
    /// The OPC UA node.
    pub node: NodeIdText,
    /// Name for users, with dots between the folders.
    pub name: String,
    /// Description for users; may be empty.
    pub about: String,
    /// Kind of the call: a service with one response, or an action that takes time.
    pub kind: CallKind,
    /// Executor of the call.
    pub executed: ExecutedBy,
    /// Services and actions that offer the call in other spaces. A space without an entry offers
    /// the call under the name of its topic.
    pub asked: Vec<CallBinding>,
    /// `true` if requests of other hosts are executed too; `false` if only requests from a loopback
    /// address are.
    pub open: bool,
    /// Longest time that a service may take, and that a caller waits.
    pub timeout: Duration,
    /// Roles that may call it at the server; `None` if the document names none.
    pub callers: Option<Vec<Role>>,
}

/// Kind of a call: whether it has a response at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CallKind {
    /// A request has one response.
    Service,
    /// A goal is accepted, sends feedback and, later, a result; a goal can be cancelled. The
    /// identifiers after the goal's are the cancel (+1), the result (+2), the feedback (+3) and the
    /// status (+4).
    Action,
}

/// Executor of a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ExecutedBy {
    /// A service or action in the ROS graph of the call's space.
    Ros(CallTarget),
    /// A Method of an OPC UA server, called by the cell's server.
    OpcUa(MethodTarget),
    /// The cell's server, which acknowledges an alarm.
    Acknowledging,
    /// Another executor in the space, such as a component.
    Elsewhere,
}

/// A service or action of a ROS graph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CallTarget {
    /// Name with its leading `/`.
    pub name: String,
    /// The type of the service or action.
    pub type_name: TypeName,
}

/// A Method of an OPC UA server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MethodTarget {
    /// Endpoint, security and user of the server.
    pub access: Access,
    /// Name of the server, if it is an entry of `servers`.
    pub server: Option<String>,
    /// Object that the Method is called on.
    pub object: ExpandedNodeIdText,
    /// The Method.
    pub method: ExpandedNodeIdText,
}

/// Service or action that offers a call in a space.
///
/// The fields of an action are named as in [`messages::ActionCalls`]: `goal.order` in its goal,
/// `result.sequence` in its result, `feedback.share` in its feedback. Fields beside these messages,
/// such as `goal_id`, are in no map: each is made of the field of the same name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CallBinding {
    /// Space of the ROS graph that offers the service or action.
    pub space: SpaceId,
    /// Service or action that is offered there.
    pub target: CallTarget,
    /// Sources of the fields of the call's request, or of its goal.
    pub request: FieldMap,
    /// Sources of the fields of the offered service's response, or of the response with the
    /// action's result.
    pub response: FieldMap,
    /// Sources of the fields of the offered action's feedback; empty for a service.
    pub feedback: FieldMap,
}

/// Sources of the fields of a message. A field without an entry is made of the field of the same
/// name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FieldMap(pub Vec<Assignment>);

/// Source of one field.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// Path of the field that is written, or of a message with several fields.
    pub target: String,
    /// Source of the value.
    pub value: Assigned,
}

/// Source of a field.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Assigned {
    /// A field of the other message, or a message with fields of the same names.
    Field(String),
    /// A constant.
    Constant(Literal),
}

impl FieldMap {
    /// Returns `true` if every field is made of the field of the same name, and no field has
    /// another source.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the source of a field, or `None` if the field is made of the field of the same name.
    /// The longest target counts that equals the field or a message around it. Names are compared
    /// without regard to case, because ROS 2 writes in lower case some names that ROS 1 writes in
    /// upper case.
    #[must_use]
    pub fn source(&self, field: &str) -> Option<Assigned> {
        let within = |target: &str| match field.get(..target.len()) {
            Some(head) if head.eq_ignore_ascii_case(target) => {
                let rest = field.get(target.len()..).unwrap_or_default();
                (rest.is_empty() || rest.starts_with('.')).then_some(rest)
            }
            _ => None,
        };
        let all = self
            .0
            .iter()
            .filter_map(|one| Some((one, within(&one.target)?)));
        let (one, rest) = all.max_by_key(|(one, _)| one.target.len())?;
        Some(match &one.value {
            Assigned::Field(path) => Assigned::Field(format!("{path}{rest}")),
            Assigned::Constant(literal) => Assigned::Constant(literal.clone()),
        })
    }
}

impl CallKind {
    /// Returns the word of ROS for it: `service` or `action`.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Service => "service",
            Self::Action => "action",
        }
    }

    /// Returns the roles of the topics of such a call, in their order; the call's own topic has an
    /// empty role.
    pub(crate) const fn parts(self) -> &'static [&'static str] {
        match self {
            Self::Service => &[""],
            Self::Action => &["", "cancel", "result", "feedback", "status"],
        }
    }

    /// Returns the topics of such a call; fewer at the end of the number range.
    pub(crate) fn topics(self, first: TopicId) -> impl Iterator<Item = TopicId> + use<> {
        let (space, namespace, id) = first.triple();
        let parts = self.parts().iter().zip(0..);
        parts.filter_map(move |(_, n): (_, u16)| TopicId::new(space, namespace, id.checked_add(n)?))
    }
}

impl Call {
    /// Returns every topic that the call takes; an action takes five.
    pub fn topics(&self) -> impl Iterator<Item = TopicId> + use<> {
        self.kind.topics(self.topic)
    }

    /// Returns the service or action that offers the call in the space.
    #[must_use]
    pub fn binding(&self, space: SpaceId) -> Option<&CallBinding> {
        self.asked.iter().find(|binding| binding.space == space)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field(path: &str) -> Assigned {
        Assigned::Field(path.to_owned())
    }

    #[test]
    fn a_message_stands_for_the_fields_in_it_and_the_longest_target_counts() {
        let one = |target: &str, path: &str| Assignment {
            target: target.to_owned(),
            value: field(path),
        };
        let map = FieldMap(vec![
            one("pose", "target_pose"),
            one("pose.header", "header"),
        ]);
        assert_eq!(map.source("pose.pose.x"), Some(field("target_pose.pose.x")));
        assert_eq!(map.source("pose.header.stamp"), Some(field("header.stamp")));
        assert_eq!(map.source("Pose"), Some(field("target_pose")));
        assert_eq!(map.source("poses"), None);
        assert_eq!(map.source("po"), None);
    }
}
