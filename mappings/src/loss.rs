//! The reaction to the loss of a commander.

use std::collections::BTreeMap;
use std::time::Duration;

use messages::{Literal, Selected, Selection, TypeName};

use crate::topic::TopicId;

/// Message or call that is published once when the commander of a value has ended or timed out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Loss {
    /// The reaction.
    pub action: LossAction,
    /// Time after which a value that is not renewed counts as lost; `None`: only the end of its
    /// commander counts.
    pub hold: Option<Duration>,
}

/// A reaction to the loss of a commander.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LossAction {
    /// A message with these fields, by path; all other fields are zero or empty.
    Message(BTreeMap<String, Literal>),
    /// A message in which the bound field has this value.
    Field(Literal),
    /// The service that the values of this variable call.
    Call(TopicId),
}

impl LossAction {
    /// Returns the message for a topic whose value is `selection`, or the request that `selection`
    /// makes of the value. Returns `None` for a call, for one value if several are bound, and for a
    /// request without a value in it.
    #[must_use]
    pub fn template(&self, selection: &Selection) -> Option<Selection> {
        if let Selection::Template { fields, rest } = selection {
            return self.request(fields, rest);
        }
        let rest = match self {
            Self::Message(rest) => rest.clone(),
            Self::Field(literal) => {
                let field = match selection {
                    Selection::Field(field) | Selection::Value { field, .. } => field,
                    Selection::Whole
                    | Selection::Fields(_)
                    | Selection::Structure(_)
                    | Selection::Template { .. }
                    | Selection::Bytes => return None,
                };
                BTreeMap::from([(field.clone(), literal.clone())])
            }
            Self::Call(_) => return None,
        };
        let fields = Vec::new();
        Some(Selection::Template { fields, rest })
    }

    /// Returns a request of which only `fields` come from the value.
    fn request(&self, fields: &[Selected], rest: &BTreeMap<String, Literal>) -> Option<Selection> {
        let mut rest = rest.clone();
        match (self, fields) {
            (Self::Message(message), [_, ..]) => rest.extend(message.clone()),
            (Self::Field(literal), [one]) => {
                rest.insert(one.field.clone(), literal.clone());
            }
            (Self::Message(_), []) | (Self::Field(_) | Self::Call(_), _) => return None,
        }
        let fields = Vec::new();
        Some(Selection::Template { fields, rest })
    }
}

/// Way to stop the movement that a command of a message type starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// A message of zeros stops it.
    ByZero,
    /// A message of zeros does not stop it, because zeros are a movement too.
    NotByZero,
}

impl Motion {
    /// Returns the motion that messages of a type command; `None` for other types.
    #[must_use]
    pub fn of(message_type: &TypeName) -> Option<Self> {
        match (message_type.package(), message_type.name()) {
            ("geometry_msgs", "Twist" | "TwistStamped")
            | ("ackermann_msgs", "AckermannDrive" | "AckermannDriveStamped") => Some(Self::ByZero),
            ("sensor_msgs", "Joy") | ("trajectory_msgs", "JointTrajectory") => {
                Some(Self::NotByZero)
            }
            _ => None,
        }
    }
}
