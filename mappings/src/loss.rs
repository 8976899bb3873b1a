//! The reaction to the loss of a commander.

use std::collections::BTreeMap;
use std::time::Duration;

use messages::{Literal, Selected, Selection, TypeName};

use crate::topic::TopicId;

/// What is published once for a value when its commander has ended or timed out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Loss {
    /// The reaction.
    pub action: LossAction,
    /// The time after which a value that is not renewed counts as lost; `None`: only the end of its commander counts.
    pub hold: Option<Duration>,
}

/// A reaction to the loss of a commander.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LossAction {
    /// A message with these fields, by their paths in it; all others are zero or empty.
    Message(BTreeMap<String, Literal>),
    /// A message in which the bound field has this value.
    Field(Literal),
    /// The service that the values of this variable call.
    Call(TopicId),
}

impl LossAction {
    /// The message for a topic of which the value is `selection`, or the request of a service that is made of the value by it;
    /// `None` for a call, for one value where several are bound, and for a request that has no value in it.
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

    /// A request of which only `fields` are made of the value.
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

/// How the movement that a command of some message type starts is ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// By a message of zeros.
    ByZero,
    /// Not by zeros, which are a movement, too.
    NotByZero,
}

impl Motion {
    /// The motion that messages of a type command; `None` for other types.
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
