//! Calls as the local side has them: what one takes and gives, who asks, and what became of it.

use std::fmt;
use std::time::Instant;

use std::collections::BTreeMap;
use std::sync::Arc;

use mappings::{Assigned, FieldMap, Overflow, SpaceId, TopicId};
use messages::{Leaf, MessageType, Rank, Selected, Selection, ServiceType, TypeName};
use uadp::action::{ExecutionId, Refusal};
use uadp::{BuiltinType, StatusCode};

use crate::constant;
use crate::counters::Counters;

/// What a call takes and gives, as its ActionMetaData say it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallDescription {
    /// Its name for people, as `parallel-gripper.Grasp.Start`; may be empty.
    pub name: String,
    /// What it is, for people; may be empty.
    pub about: String,
    /// Whether it is a call of its own, or a part of an action.
    pub role: CallRole,
    /// What a request has in it, in this order.
    pub request: Vec<CallField>,
    /// What an answer has in it, in this order.
    pub response: Vec<CallField>,
}

/// What a call is to an action, which takes three calls and two values of one namespace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CallRole {
    /// Nothing: it has an answer at once.
    #[default]
    Call,
    /// It sends a goal.
    Goal(ActionFamily),
    /// It cancels goals of the action with that DataSetWriterId.
    Cancel {
        /// Of the call that sends the goals.
        of: u16,
    },
    /// It waits for the result of a goal of the action with that DataSetWriterId.
    Result {
        /// Of the call that sends the goals.
        of: u16,
    },
}

/// The DataSetWriterIds of an action beside that of its goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ActionFamily {
    /// The call that cancels.
    pub cancel: u16,
    /// The call that waits for a result.
    pub result: u16,
    /// The value with the feedback of each goal.
    pub feedback: u16,
    /// The value with the status of the goals.
    pub status: u16,
}

impl ActionFamily {
    /// Those behind the DataSetWriterId of the goals, in their order; `None` where there are not as many.
    #[must_use]
    pub const fn behind(goal: u16) -> Option<Self> {
        match goal.checked_add(4) {
            None => None,
            Some(status) => Some(Self {
                cancel: goal + 1,
                result: goal + 2,
                feedback: goal + 3,
                status,
            }),
        }
    }
}

/// One field of a request or response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallField {
    /// Unique in the request or response.
    pub name: String,
    /// The builtin type of it, or of its elements.
    pub builtin: BuiltinType,
    /// Whether it is an array.
    pub rank: Rank,
    /// Of a request: it has a value of its own where the request has no fields at all.
    pub optional: bool,
    /// What is in it where it is a message, as far as who executes the call says that. Of a call of one's own nothing is said
    /// here.
    pub structure: Option<Arc<CallStructure>>,
}

/// A message in a field of a call, as the schema of its ActionMetaData defines it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallStructure {
    /// The name of its type, as `geometry_msgs/Point`, which is also its TypeId on the wire, in the namespace of the call.
    pub name: String,
    /// What is in it, in this order.
    pub fields: Vec<CallField>,
}

/// One request of the local side, by a number that the port chooses and uses once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct AskId(pub u64);

/// What became of a request: the response in the local encoding, or why there is none.
pub type Answered<R = Vec<u8>> = Result<R, AskError>;

/// Why a request has no response.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text}")]
pub struct AskError {
    /// Whether it was executed, as far as that is known.
    pub kind: AskErrorKind,
    /// The same for machines.
    pub status: StatusCode,
    /// The same for people.
    pub text: String,
}

/// Whether a request without response was executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AskErrorKind {
    /// It was not.
    Refused,
    /// It was, and went wrong, or its response cannot be read here.
    Failed,
    /// It may have been, or may be still.
    Unknown,
}

/// A request of another program that the local side is to execute.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Execution<R = Vec<u8>> {
    /// Tells it from all others.
    pub id: ExecutionId,
    /// Which call.
    pub topic: TopicId,
    /// The request, in the local encoding. A block of fields is well-formed, and whether they are those of the call is for
    /// who executes it to say.
    pub request: R,
    /// The space that asks, if it says so.
    pub requestor: Option<SpaceId>,
    /// Who asks does not wait any longer.
    pub deadline: Instant,
}

/// What an execution came to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Executed {
    /// It was executed, with this response in the local encoding.
    Answered(Vec<u8>),
    /// It was executed and went wrong.
    Failed(StatusCode),
    /// It was not executed.
    Refused(Refusal),
    /// Nobody knows: what executed it is gone.
    Lost,
}

/// A call that the local side executes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Offered {
    /// What it takes and gives.
    pub description: CallDescription,
    /// Whether requests from other hosts are executed too; else only those from a loopback address.
    pub open: bool,
}

/// A call that the local side executes as a ROS service: requests and responses are its messages in the local encoding.
#[derive(Debug, Clone)]
pub struct OfferedType {
    /// What it takes and gives.
    pub service_type: Arc<ServiceType>,
    /// Its name for people, as `Conveyor.Switch`; may be empty.
    pub name: String,
    /// What it is, for people, without the name of the type; may be empty.
    pub about: String,
    /// What it is to an action.
    pub role: CallRole,
    /// Whether requests from other hosts are executed too; else only those from a loopback address.
    pub open: bool,
}

/// What the request of a call and the response of the type it is asked for as are made of, where not all goes by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CallMap {
    /// The fields of the call's request, of those of the type's.
    pub request: FieldMap,
    /// The fields of the type's response, of those of the call's.
    pub response: FieldMap,
}

/// What a field of a request is made of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Origin {
    /// The field at that place of the ROS message.
    Leaf(usize),
    /// Always the same: a block of that one field.
    Constant(Vec<u8>),
}

/// What a value of our own space is, where no mapping says it and the local side speaks in fields.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ValueDescription {
    /// Its name for people, as `parallel-gripper.Grasp.State`; may be empty.
    pub name: String,
    /// The ROS type that the fields make, if they make one.
    pub message_type: Option<TypeName>,
    /// What it is, for people and programs; may be empty.
    pub about: String,
    /// The fields, in the order of the values.
    pub fields: Vec<Leaf>,
    /// What its queue does when full: a state has one place and is repeated, events have several and are not.
    pub overflow: Overflow,
}

/// What is said of a value that is [bound by name](crate::Router::bind_as), where no mapping says it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ValueNote {
    /// Its name for people, as `Nav.Drive.Feedback`; may be empty.
    pub name: String,
    /// What it is, for people; may be empty.
    pub about: String,
    /// What its queue does when full: a state has one place and is repeated, events have several and are not.
    pub overflow: Overflow,
    /// Of a value of another space: what is not made of the field of the same name.
    pub map: FieldMap,
}

/// What became of the requests of one call.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CallCounters {
    /// Requests of the local side.
    pub asked: u64,
    /// Those that were executed, whatever came out.
    pub answered: u64,
    /// Those that were not executed.
    pub refused: u64,
    /// Those of which nobody knows.
    pub unknown: u64,
    /// Requests of others that were handed to the local side.
    pub executed: u64,
    /// Requests and responses that were dropped, or refused here, by reason.
    pub drops: Counters,
}

impl CallField {
    pub(crate) fn of(leaf: &Leaf) -> Self {
        Self {
            name: leaf.path.clone(),
            builtin: leaf.builtin,
            rank: leaf.rank,
            optional: false,
            structure: None,
        }
    }

    /// A single value.
    #[must_use]
    pub fn scalar(name: &str, builtin: BuiltinType) -> Self {
        Self {
            name: name.to_owned(),
            builtin,
            rank: Rank::Scalar,
            optional: false,
            structure: None,
        }
    }

    /// An array.
    #[must_use]
    pub fn array(name: &str, builtin: BuiltinType) -> Self {
        Self {
            rank: Rank::Array { fixed: None },
            ..Self::scalar(name, builtin)
        }
    }

    /// The same, which has a value of its own in a request without fields.
    #[must_use]
    pub fn optional(self) -> Self {
        Self {
            optional: true,
            ..self
        }
    }
}

impl CallDescription {
    /// Whether it can be asked for without any field.
    #[must_use]
    pub fn may_be_empty(&self) -> bool {
        self.request.iter().all(|field| field.optional)
    }

    /// Whether it can be asked for as that ROS type: each field of the type's response is in the response of the call, and
    /// the fields of the requests are the same, in whatever order; or the type's request has none, and the call can be
    /// asked for so. A field of the request that is optional and that the type has not is not given. Further fields of the response
    /// are left out. What `map` names is made as it says; where it says anything
    /// of the request, further fields of the type's request are left out.
    ///
    /// # Errors
    /// Why not, for people.
    pub fn fits(&self, service: &ServiceType, map: &CallMap) -> Result<(), String> {
        self.request_order(service.request(), &map.request)?;
        self.response_order(service.response(), &map.response)?;
        Ok(())
    }

    /// For each field of the request what it is made of; `None` where the request goes without fields.
    pub(crate) fn request_order(
        &self,
        message: &MessageType,
        map: &FieldMap,
    ) -> Result<Option<Vec<Origin>>, String> {
        let leaves = message.leaves();
        if leaves.is_empty() && map.is_empty() && self.may_be_empty() {
            return Ok(None);
        }
        let origin = |field: &CallField| {
            let path = match map.source(&field.name) {
                Some(Assigned::Constant(literal)) => {
                    return constant::block(field, (field.builtin, field.rank), &literal)
                        .map(Origin::Constant);
                }
                Some(Assigned::Field(path)) => path,
                None => field.name.clone(),
            };
            let find = |leaf: &Leaf| {
                path.eq_ignore_ascii_case(&leaf.path)
                    && takes(field.rank, leaf.rank)
                    && field.builtin == leaf.builtin
            };
            let found = leaves.iter().position(find).map(Origin::Leaf);
            // Not given, where it has a value of its own.
            let found = found.or_else(|| {
                let is_left_out = field.optional
                    && path == field.name
                    && !leaves
                        .iter()
                        .any(|leaf| path.eq_ignore_ascii_case(&leaf.path));
                is_left_out.then(|| Origin::Constant(constant::NULL.to_vec()))
            });
            found.ok_or_else(|| match path == field.name {
                true => format!("its request has {field}, and {} has not", message.name()),
                false => format!(
                    "its request has {field}, which is to be made of `{path}`, and {} has no such field of that type",
                    message.name()
                ),
            })
        };
        let order: Vec<Origin> = self.request.iter().map(origin).collect::<Result<_, _>>()?;
        let missing = leaves
            .iter()
            .enumerate()
            .find(|(at, _)| !order.contains(&Origin::Leaf(*at)));
        match missing {
            Some((_, leaf)) if map.is_empty() => Err(format!(
                "{} has `{}`, and its request has not",
                message.name(),
                leaf.path
            )),
            Some(_) | None => Ok(Some(order)),
        }
    }

    /// What of the ROS message is made of fields of the response, and for each of those its place there.
    pub(crate) fn response_order(
        &self,
        message: &MessageType,
        map: &FieldMap,
    ) -> Result<(Selection, Vec<usize>), String> {
        let (mut fields, mut rest) = (Vec::new(), BTreeMap::new());
        let mut order = Vec::new();
        for leaf in message.leaves() {
            let path = match map.source(&leaf.path) {
                Some(Assigned::Constant(literal)) => {
                    rest.insert(leaf.path.clone(), literal);
                    continue;
                }
                Some(Assigned::Field(path)) => path,
                None => leaf.path.clone(),
            };
            let find = |field: &CallField| {
                field.name.eq_ignore_ascii_case(&path)
                    && takes(leaf.rank, field.rank)
                    && field.builtin == leaf.builtin
            };
            let found = self.response.iter().position(find);
            order.push(found.ok_or_else(|| {
                let kind = kind(leaf.builtin, leaf.rank);
                format!(
                    "{} has `{}` ({kind}), and its response has no `{path}` of that type",
                    message.name(),
                    leaf.path,
                )
            })?);
            fields.push(Selected::whole(&leaf.path));
        }
        let selection = match rest.is_empty() {
            true => Selection::Whole,
            false => Selection::Template { fields, rest },
        };
        Ok((selection, order))
    }
}

impl fmt::Display for CallField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` ({})", self.name, kind(self.builtin, self.rank))
    }
}

impl AskError {
    pub(crate) fn refused(refusal: Refusal, text: impl Into<String>) -> Self {
        Self {
            kind: AskErrorKind::Refused,
            status: refusal.status_code(),
            text: text.into(),
        }
    }
}

/// The topic and the name for people that the name of a DataSet or Action says; an announcement has no WriterGroupId, so the
/// topic stands in front.
#[must_use]
pub fn split_name(name: &str) -> Option<(TopicId, &str)> {
    let (topic, name) = name.split_once(' ').unwrap_or((name, ""));
    Some((topic.parse().ok()?, name))
}

/// The name of the DataSet or Action of a topic.
pub(crate) fn join_name(topic: TopicId, name: &str) -> String {
    match name {
        "" => topic.to_string(),
        name => format!("{topic} {name}"),
    }
}

/// Whether values of `given` have a place in what is of `wanted`.
fn takes(wanted: Rank, given: Rank) -> bool {
    match (wanted, given) {
        (Rank::Scalar, Rank::Scalar) => true,
        (Rank::Array { fixed: None }, Rank::Array { .. }) => true,
        (Rank::Array { fixed }, Rank::Array { fixed: given }) => fixed == given,
        (Rank::Scalar, Rank::Array { .. }) | (Rank::Array { .. }, Rank::Scalar) => false,
    }
}

fn kind(builtin: BuiltinType, rank: Rank) -> String {
    match rank {
        Rank::Scalar => format!("{builtin}"),
        Rank::Array { .. } => format!("{builtin}[]"),
    }
}
