//! Calls as seen from the local side: their arguments and results, requests, and outcomes.

use std::fmt;
use std::time::Instant;

use std::collections::BTreeMap;
use std::sync::Arc;

use mappings::{Assigned, FieldMap, Overflow, SpaceId, TopicId};
use messages::{
    ArrayRank, Leaf, MessageType, PlanError, Selected, Selection, ServiceType, TypeName,
};
use uadp::action::{ExecutionId, Refusal};
use uadp::{BuiltinType, StatusCode};

use crate::constant::{self, ConstantFault};
use crate::counters::Counters;

/// The arguments and results of a call, as in its ActionMetaData.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallDescription {
    /// The display name, such as `parallel-gripper.Grasp.Start`; may be empty.
    pub name: String,
    /// The description for users; may be empty.
    pub about: String,
    /// Whether the call is independent or a part of an action.
    pub role: CallRole,
    /// The fields of a request, in this order.
    pub request: Vec<CallField>,
    /// The fields of a response, in this order.
    pub response: Vec<CallField>,
}

/// The role of a call in an action. An action consists of three calls and two values in the same
/// namespace.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CallRole {
    /// An independent call, which is answered at once.
    #[default]
    Call,
    /// Sends a goal.
    Goal(ActionFamily),
    /// Cancels goals of an action.
    Cancel {
        /// The DataSetWriterId of the call that sends the goals.
        of: u16,
    },
    /// Waits for the result of a goal of an action.
    Result {
        /// The DataSetWriterId of the call that sends the goals.
        of: u16,
    },
}

/// The DataSetWriterIds of an action, except the DataSetWriterId of the call that sends the goals.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ActionFamily {
    /// The call that cancels goals.
    pub cancel: u16,
    /// The call that waits for a result.
    pub result: u16,
    /// The value with the feedback of each goal.
    pub feedback: u16,
    /// The value with the status of the goals.
    pub status: u16,
}

impl ActionFamily {
    /// Returns the four DataSetWriterIds that follow the DataSetWriterId of the goals. Returns
    /// `None` if they exceed the range.
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

/// A field of a request or response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallField {
    /// The name, unique in the request or response.
    pub name: String,
    /// The builtin type of the field or of its elements.
    pub builtin: BuiltinType,
    /// Whether the field is an array.
    pub rank: ArrayRank,
    /// For a field of a request: whether it has a default value, which is used if the request has
    /// no fields.
    pub optional: bool,
    /// The fields of a message in this field, if the executor announces them. `None` for calls of
    /// this program.
    pub structure: Option<Arc<CallStructure>>,
    /// The meaning for users. It is announced, and not read from the announcements of others.
    pub note: Option<Box<FieldNote>>,
}

/// The meaning of a field of a call for users.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FieldNote {
    /// The symbol of the unit; empty without a unit.
    pub unit: String,
    /// The lowest and the highest value.
    pub range: Option<(f64, f64)>,
    /// The default value as text.
    pub default: Option<String>,
    /// The description; may be empty.
    pub about: String,
}

// The bounds of a range are finite, because the parsers of skill types and mappings refuse others.
impl Eq for FieldNote {}

/// A message in a field of a call, as defined by the schema of its ActionMetaData.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallStructure {
    /// The name of its type, such as `geometry_msgs/Point`. In the namespace of the call it is also
    /// the TypeId on the wire.
    pub name: String,
    /// The fields, in this order.
    pub fields: Vec<CallField>,
}

/// Identifies a request of the local side. The caller chooses the number and uses it once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct AskId(pub u64);

/// The outcome of a request: the response in the local encoding, or the reason why there is no
/// response.
pub type CallResponse<R = Vec<u8>> = Result<R, AskError>;

/// The reason why a request has no response.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{text}")]
pub struct AskError {
    /// Whether the request was executed, as far as known.
    pub kind: AskErrorKind,
    /// The reason as StatusCode.
    pub status: StatusCode,
    /// The reason as text for users.
    pub text: String,
}

/// Whether a request without response was executed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum AskErrorKind {
    /// The request was not executed.
    Refused,
    /// The request was executed and failed, or its response cannot be read.
    Failed,
    /// The request may have been executed, or may still be in execution.
    Unknown,
}

/// A request of another program for the local side to execute.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallExecution<R = Vec<u8>> {
    /// The unique identifier of the execution.
    pub id: ExecutionId,
    /// The topic of the call.
    pub topic: TopicId,
    /// The request in the local encoding. A block of fields is well-formed. The executor checks
    /// whether its fields match the call.
    pub request: R,
    /// The space of the requestor, if known.
    pub requestor: Option<SpaceId>,
    /// The time at which the requestor stops waiting.
    pub deadline: Instant,
    /// The time until which the execution may be started: a later start is a start by a program
    /// that was stopped, while a redundant bridge has taken over.
    pub start_by: Instant,
}

/// The outcome of an execution.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Executed {
    /// The request was executed, with this response in the local encoding.
    Answered(Vec<u8>),
    /// The request was executed and failed.
    Failed(StatusCode),
    /// The request was not executed.
    Refused(Refusal),
    /// Unknown, because the executor was lost.
    Lost,
}

/// A call that the local side executes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OfferedCall {
    /// The arguments and results of the call.
    pub description: CallDescription,
    /// Whether requests from other hosts are executed. If false, only requests from a loopback
    /// address are executed.
    pub open: bool,
}

/// A call that the local side executes as a ROS service. Requests and responses are ROS messages in
/// the local encoding.
#[derive(Debug, Clone)]
pub struct OfferedType {
    /// The type of the service.
    pub service_type: Arc<ServiceType>,
    /// The display name, such as `Conveyor.Switch`; may be empty.
    pub name: String,
    /// The description for users without the name of the type; may be empty.
    pub about: String,
    /// The role of the call in an action.
    pub role: CallRole,
    /// Whether requests from other hosts are executed. If false, only requests from a loopback
    /// address are executed.
    pub open: bool,
}

/// The assignments between the fields of a call and the fields of a service type, for fields that
/// are not assigned by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CallMap {
    /// The sources of the fields of the call's request: fields of the type's request.
    pub request: FieldMap,
    /// The sources of the fields of the type's response: fields of the call's response.
    pub response: FieldMap,
}

/// The source of a field of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum FieldOrigin {
    /// The field at this index of the ROS message.
    Leaf(usize),
    /// A constant, as block with a single field.
    Constant(Vec<u8>),
}

/// The description of a value of the own space that is not in the mapping, for a local side with
/// fields as payload.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ValueDescription {
    /// The display name, such as `parallel-gripper.Grasp.State`; may be empty.
    pub name: String,
    /// The ROS type of the message that the fields form, if they form a message.
    pub message_type: Option<TypeName>,
    /// The description for users and programs; may be empty.
    pub about: String,
    /// The fields, in the order of the values.
    pub fields: Vec<Leaf>,
    /// The behavior of a full queue: the queue of a state has one item, which is repeated; the
    /// queue of an event has several items without repetition.
    pub overflow: Overflow,
}

/// The description of a value that is [bound by name](crate::Router::bind_as) and not in the
/// mapping.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ValueNote {
    /// The display name, such as `Nav.Drive.Feedback`; may be empty.
    pub name: String,
    /// The description for users; may be empty.
    pub about: String,
    /// The behavior of a full queue: the queue of a state has one item, which is repeated; the
    /// queue of an event has several items without repetition.
    pub overflow: Overflow,
    /// For a value of another space: the sources of fields that are not assigned by name.
    pub map: FieldMap,
}

/// The outcomes of the requests of a call.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CallCounters {
    /// Requests of the local side.
    pub asked: u64,
    /// Requests that were executed, with any result.
    pub answered: u64,
    /// Requests that were not executed.
    pub refused: u64,
    /// Requests with an unknown outcome.
    pub unknown: u64,
    /// Requests of other programs that were passed to the local side.
    pub executed: u64,
    /// Requests and responses that were dropped or refused by this program, by reason.
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
            note: None,
        }
    }

    /// Creates a scalar field.
    #[must_use]
    pub fn scalar(name: &str, builtin: BuiltinType) -> Self {
        Self {
            name: name.to_owned(),
            builtin,
            rank: ArrayRank::Scalar,
            optional: false,
            structure: None,
            note: None,
        }
    }

    /// Creates an array field.
    #[must_use]
    pub fn array(name: &str, builtin: BuiltinType) -> Self {
        Self {
            rank: ArrayRank::Array { fixed: None },
            ..Self::scalar(name, builtin)
        }
    }

    /// Sets the meaning for users.
    #[must_use]
    pub fn with_note(self, note: FieldNote) -> Self {
        Self {
            note: Some(Box::new(note)),
            ..self
        }
    }

    /// Sets the field as optional: it has a default value, which is used if the request has no
    /// fields.
    #[must_use]
    pub fn optional(self) -> Self {
        Self {
            optional: true,
            ..self
        }
    }
}

/// Reason for which a call does not have the fields of a ROS type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CallTypeError {
    /// A constant of the mapping does not fit a field of the request.
    #[error(transparent)]
    Constant(#[from] ConstantFault),
    /// The type has no field for a field of the call's request.
    #[error("its request has the field {field}, which {lacked_by} lacks")]
    NoRequestField {
        /// The field of the call with its type.
        field: String,
        /// The request of the service type.
        lacked_by: TypeName,
    },
    /// The type has no field of the name in the mapping.
    #[error(
        "its request takes {field} from `{path}`, but {lacked_by} has no such field of this type"
    )]
    NoAssignedField {
        /// The field of the call with its type.
        field: String,
        /// The name in the mapping.
        path: String,
        /// The request of the service type.
        lacked_by: TypeName,
    },
    /// The call's request has no field for a field of the type.
    #[error("{message} has the field `{path}`, which its request lacks")]
    NotRequested {
        /// The request of the service type.
        message: TypeName,
        /// The field of the service type.
        path: String,
    },
    /// The call's response has no field for a field of the type.
    #[error(
        "{message} has the field `{field}` ({kind}), but its response has no `{path}` of this type"
    )]
    NotAnswered {
        /// The response of the service type.
        message: TypeName,
        /// The field of the service type.
        field: String,
        /// The type of the field.
        kind: String,
        /// The field that the response lacks.
        path: String,
    },
    /// The messages of the type cannot be converted.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The payloads of the local side are fields.
    #[error("the local side has no ROS types")]
    NoRosTypes,
}

impl CallDescription {
    /// Returns whether a request may have no fields.
    #[must_use]
    pub fn may_be_empty(&self) -> bool {
        self.request.iter().all(|field| field.optional)
    }

    /// Checks whether the call can be requested with a ROS service type.
    ///
    /// Each field of the type's response needs a field of the call's response, and the fields of
    /// the requests need to be the same in any order. A type without request fields also fits if
    /// all fields of the call's request are optional. An optional request field that the type does
    /// not have is sent as null. Further fields of the call's response are ignored. Fields in `map`
    /// are assigned as specified there. If `map` assigns request fields, further fields of the
    /// type's request are ignored.
    ///
    /// # Errors
    /// Returns the reason if the type does not fit.
    pub fn fits(&self, service: &ServiceType, map: &CallMap) -> Result<(), CallTypeError> {
        self.request_order(service.request(), &map.request)?;
        self.response_order(service.response(), &map.response)?;
        Ok(())
    }

    /// Returns the source of each field of the request; `None` for a request without fields.
    pub(crate) fn request_order(
        &self,
        message: &MessageType,
        map: &FieldMap,
    ) -> Result<Option<Vec<FieldOrigin>>, CallTypeError> {
        let leaves = message.leaves();
        if leaves.is_empty() && map.is_empty() && self.may_be_empty() {
            return Ok(None);
        }
        let origin = |field: &CallField| -> Result<FieldOrigin, CallTypeError> {
            let path = match map.source(&field.name) {
                Some(Assigned::Constant(literal)) => {
                    let block = constant::block(field, (field.builtin, field.rank), &literal)?;
                    return Ok(FieldOrigin::Constant(block));
                }
                Some(Assigned::Field(path)) => path,
                None => field.name.clone(),
            };
            let find = |leaf: &Leaf| {
                path.eq_ignore_ascii_case(&leaf.path)
                    && takes(field.rank, leaf.rank)
                    && field.builtin == leaf.builtin
            };
            let found = leaves.iter().position(find).map(FieldOrigin::Leaf);
            let is_same_name = path == field.name;
            // An optional field without a source is sent as null, so that its default value is
            // used.
            let found = found.or_else(|| {
                let is_left_out = field.optional
                    && is_same_name
                    && !leaves
                        .iter()
                        .any(|leaf| path.eq_ignore_ascii_case(&leaf.path));
                is_left_out.then(|| FieldOrigin::Constant(constant::NULL.to_vec()))
            });
            found.ok_or_else(|| {
                let (field, lacked_by) = (field.to_string(), message.name().clone());
                if is_same_name {
                    CallTypeError::NoRequestField { field, lacked_by }
                } else {
                    CallTypeError::NoAssignedField {
                        field,
                        path,
                        lacked_by,
                    }
                }
            })
        };
        let order = self.request.iter().map(origin);
        let order: Vec<FieldOrigin> = order.collect::<Result<_, _>>()?;
        let missing = leaves
            .iter()
            .enumerate()
            .find(|(at, _)| !order.contains(&FieldOrigin::Leaf(*at)));
        match missing {
            Some((_, leaf)) if map.is_empty() => Err(CallTypeError::NotRequested {
                message: message.name().clone(),
                path: leaf.path.clone(),
            }),
            Some(_) | None => Ok(Some(order)),
        }
    }

    /// Returns the fields of the ROS message that are made from fields of the response, and the
    /// index of the response field for each.
    pub(crate) fn response_order(
        &self,
        message: &MessageType,
        map: &FieldMap,
    ) -> Result<(Selection, Vec<usize>), CallTypeError> {
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
            order.push(found.ok_or_else(|| CallTypeError::NotAnswered {
                message: message.name().clone(),
                field: leaf.path.clone(),
                kind: kind(leaf.builtin, leaf.rank),
                path,
            })?);
            fields.push(Selected::whole(&leaf.path));
        }
        let selection = if rest.is_empty() {
            Selection::Whole
        } else {
            Selection::Template { fields, rest }
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

/// Splits the name of a DataSet or Action into the topic and the display name. The name starts with
/// the topic, because an announcement has no WriterGroupId.
#[must_use]
pub fn split_name(name: &str) -> Option<(TopicId, &str)> {
    let (topic, name) = name.split_once(' ').unwrap_or((name, ""));
    Some((topic.parse().ok()?, name))
}

/// Returns the name of the DataSet or Action of a topic.
pub(crate) fn join_name(topic: TopicId, name: &str) -> String {
    match name {
        "" => topic.to_string(),
        name => format!("{topic} {name}"),
    }
}

/// Returns whether values of rank `given` can be assigned to a field of rank `wanted`.
fn takes(wanted: ArrayRank, given: ArrayRank) -> bool {
    match (wanted, given) {
        (ArrayRank::Scalar, ArrayRank::Scalar) => true,
        (ArrayRank::Array { fixed: None }, ArrayRank::Array { .. }) => true,
        (ArrayRank::Array { fixed }, ArrayRank::Array { fixed: given }) => fixed == given,
        (ArrayRank::Scalar, ArrayRank::Array { .. })
        | (ArrayRank::Array { .. }, ArrayRank::Scalar) => false,
    }
}

fn kind(builtin: BuiltinType, rank: ArrayRank) -> String {
    match rank {
        ArrayRank::Scalar => format!("{builtin}"),
        ArrayRank::Array { .. } => format!("{builtin}[]"),
    }
}
