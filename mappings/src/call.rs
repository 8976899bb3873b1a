//! The calls of the mapping: what is executed where, and as what it is asked for elsewhere.

use std::time::Duration;

use messages::{Literal, TypeName};

use crate::node_id::{ExpandedNodeIdText, NodeIdText};
use crate::permission::Role;
use crate::remote::Access;
use crate::topic::{SpaceId, TopicId};

/// One call of the space: an OPC UA Method, the service or action that executes it, and those that ask for it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Call {
    /// Origin, namespace index, and the node's numeric identifier or alias. Of an action the first of five identifiers, see
    /// [`CallKind::Action`].
    pub topic: TopicId,
    /// The OPC UA node.
    pub node: NodeIdText,
    /// Its name for people, with dots between the folders.
    pub name: String,
    /// What it does, for people; may be empty.
    pub about: String,
    /// Whether it has an answer at once or takes its time.
    pub kind: CallKind,
    /// Who executes it.
    pub executed: ExecutedBy,
    /// As what the other spaces ask for it; a space that is not among them has it under its topic.
    pub asked: Vec<CallBinding>,
    /// Whether requests of other hosts are executed too; else only those from a loopback address.
    pub open: bool,
    /// How long the execution of a service may take, and how long who asks waits.
    pub timeout: Duration,
    /// Which roles may call it at the server; `None` where nothing is said.
    pub callers: Option<Vec<Role>>,
}

/// Whether a call has an answer at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum CallKind {
    /// A request has one response.
    Service,
    /// A goal is accepted, has feedback and, later, a result; it can be cancelled. The identifiers behind that of the goal are
    /// those of its cancel (+1), its result (+2), its feedback (+3) and its status (+4).
    Action,
}

/// Who executes a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ExecutedBy {
    /// A service or action in the ROS graph of the call's space.
    Ros(CallTarget),
    /// A Method of an OPC UA server, called by the cell's server.
    OpcUa(MethodTarget),
    /// Somebody else in the space, such as a component.
    Elsewhere,
}

/// A service or action of a ROS graph.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CallTarget {
    /// With its leading `/`.
    pub name: String,
    /// The type of the service or action.
    pub type_name: TypeName,
}

/// A Method of an OPC UA server.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MethodTarget {
    /// How the server is reached.
    pub access: Access,
    /// Its name, if it is one of `servers`.
    pub server: Option<String>,
    /// The Object the Method is called on.
    pub object: ExpandedNodeIdText,
    /// The Method.
    pub method: ExpandedNodeIdText,
}

/// As what a space asks for a call.
///
/// The fields of an action are those of [`messages::ActionCalls`]: `goal.order` of its goal, `result.sequence` of its result,
/// `feedback.share` of its feedback. What stands beside those messages, as `goal_id`, is in no map and goes by name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CallBinding {
    /// Whose ROS graph the service or action is offered in.
    pub space: SpaceId,
    /// What is offered there.
    pub target: CallTarget,
    /// What the request of the call, or of its goal, is made of.
    pub request: FieldMap,
    /// What the response here, or that with the result, is made of.
    pub response: FieldMap,
    /// What the value with the feedback here is made of; of a service it is empty.
    pub feedback: FieldMap,
}

/// What the fields of a message are made of. A field that it does not name is made of the field of the same name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FieldMap(pub Vec<Assignment>);

/// What one field is made of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// Path of the field that is written, or of a message with several.
    pub target: String,
    /// Where it comes from.
    pub value: Assigned,
}

/// Where a field comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Assigned {
    /// A field of the other side, or a message with fields of the same names.
    Field(String),
    /// Always the same.
    Constant(Literal),
}

impl FieldMap {
    /// Whether every field is made of the one of the same name, and there is none without.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// What a field is made of; `None` where that of the same name is meant. The longest target that is the field, or a message
    /// around it, counts. Neither ROS tells large letters from small in names that the other writes so.
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
    /// What people call it in ROS: `service` or `action`.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Service => "service",
            Self::Action => "action",
        }
    }

    /// What the topics of such a call are of, in their order; nothing of the call itself.
    pub(crate) const fn parts(self) -> &'static [&'static str] {
        match self {
            Self::Service => &[""],
            Self::Action => &["", "cancel", "result", "feedback", "status"],
        }
    }

    /// The topics of such a call; fewer where the numbers end.
    pub(crate) fn topics(self, first: TopicId) -> impl Iterator<Item = TopicId> + use<> {
        let (space, namespace, id) = first.triple();
        let parts = self.parts().iter().zip(0..);
        parts.filter_map(move |(_, n): (_, u16)| TopicId::new(space, namespace, id.checked_add(n)?))
    }
}

impl Call {
    /// Every topic the call takes: of an action five.
    pub fn topics(&self) -> impl Iterator<Item = TopicId> + use<> {
        self.kind.topics(self.topic)
    }

    /// As what that space asks for it.
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
