//! The reasons why a service or an action of a graph is not used for the space.

use std::error::Error;

use bridge_core::CallTypeError;
use mappings::TopicId;
use messages::{DefinitionError, PlanError, WriteError};
use uadp::BuiltinType;

/// The reason why a service or an action of a graph is not used for the space.
#[derive(Debug, thiserror::Error)]
pub enum GraphError {
    /// The definition of a type is missing, with the place where it must be.
    #[error("{0}")]
    MissingType(String),
    /// The definition of a type cannot be used.
    #[error(transparent)]
    Definition(Box<DefinitionError>),
    /// A message cannot be made from a template.
    #[error(transparent)]
    Plan(Box<PlanError>),
    /// A message cannot be encoded.
    #[error(transparent)]
    Write(Box<WriteError>),
    /// A type does not fit a call.
    #[error(transparent)]
    Fit(Box<CallTypeError>),
    /// The library of the graph refuses.
    #[error(transparent)]
    Library(Box<dyn Error + Send + Sync>),
    /// The goal has an answer already.
    #[error("the goal was already accepted or rejected")]
    GoalAnswered,
    /// A variable is bound to another part of a service.
    #[error("it has no {expected}")]
    OtherRole {
        /// The expected part.
        expected: &'static str,
    },
    /// A response is taken from a variable that calls no service.
    #[error("{of} calls no service")]
    CallsNothing {
        /// The variable.
        of: TopicId,
    },
    /// A variable that is compared has no type.
    #[error("a variable needs a `type` if its value is not part of the request")]
    NoValueType,
    /// A variable that is compared has a type without a message type.
    #[error("a value of type {builtin:?} cannot be compared with `when`")]
    NotComparable {
        /// The type.
        builtin: BuiltinType,
    },
    /// The limit of services or actions is reached.
    #[error("the limit of {most} offered {ends} is reached")]
    Full {
        /// The limit.
        most: usize,
        /// `services` or `actions`.
        ends: &'static str,
    },
    /// The executor announces no service type, and no standard type fits.
    #[error(
        "its executor announces no service type, and no type of std_srvs has its fields: request ({request}), \
         response ({response})"
    )]
    NoServiceType {
        /// The names of the fields of the request.
        request: String,
        /// The names of the fields of the response.
        response: String,
    },
    /// The executor announces no action type.
    #[error("its executor announces no action type")]
    NoActionType,
    /// Fewer than five identifiers follow that of an action.
    #[error("an action takes five consecutive identifiers, and fewer follow its own")]
    NoFamily,
    /// A topic of the action belongs to something else.
    #[error(
        "it takes the topics {first} to {last}, but {taken} belongs to a variable or another action"
    )]
    TopicTaken {
        /// The first topic of the action.
        first: TopicId,
        /// The last topic of the action.
        last: TopicId,
        /// The topic of something else.
        taken: TopicId,
    },
    /// A value of the action is a variable, too.
    #[error("its {topic} is also a variable of the mapping")]
    IsVariable {
        /// The topic of the value.
        topic: TopicId,
    },
}

impl GraphError {
    /// Returns the error of a library.
    #[must_use]
    pub fn library(error: impl Error + Send + Sync + 'static) -> Self {
        Self::Library(Box::new(error))
    }
}

impl From<DefinitionError> for GraphError {
    fn from(error: DefinitionError) -> Self {
        Self::Definition(Box::new(error))
    }
}

impl From<PlanError> for GraphError {
    fn from(error: PlanError) -> Self {
        Self::Plan(Box::new(error))
    }
}

impl From<WriteError> for GraphError {
    fn from(error: WriteError) -> Self {
        Self::Write(Box::new(error))
    }
}

impl From<CallTypeError> for GraphError {
    fn from(error: CallTypeError) -> Self {
        Self::Fit(Box::new(error))
    }
}
