//! The reasons why a process of the graph cannot run.

use serde_json::Value;
use skills::NoShape;

use crate::parameter_fault::ParameterFault;
use crate::process::{Loop, MOST_STEPS};

/// The reason why a process cannot run.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(crate) enum ProcessFault {
    #[error("it {0}")]
    Own(#[from] StatementFault),
    #[error("the {part} {iri} {fault}")]
    Part {
        /// A step, a compensation of a step, or a loop.
        part: &'static str,
        iri: String,
        fault: Box<StatementFault>,
    },
    #[error("it has more than {MOST_STEPS} steps")]
    TooManySteps,
    #[error("the steps {one} and {other} have the ua:position {position}")]
    SamePosition {
        one: String,
        other: String,
        position: i64,
    },
    #[error("no step has a need with the ua:role `{0}`")]
    NoRole(&'static str),
    #[error("its ua:{0} is not six numbers: m, m, m, rad, rad, rad")]
    NoPosition(&'static str),
    #[error("its ua:approach is not from 0 to 10 m: {0}")]
    Approach(Value),
    #[error("its ua:shape `{shape}` {fault}")]
    Shape { shape: String, fault: NoShape },
}

impl ProcessFault {
    /// Returns the fault of a part of the process.
    pub(super) fn of(part: &'static str, iri: &str) -> impl FnOnce(StatementFault) -> Self {
        let iri = iri.to_owned();
        move |fault| Self::Part {
            part,
            iri,
            fault: Box::new(fault),
        }
    }
}

/// A fault of the statements about a process, a part of it, or an action. The text begins with a
/// verb.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(crate) enum StatementFault {
    /// The missing property.
    #[error("has no {0}")]
    Missing(&'static str),
    #[error("has two values of {column}: {first} and {other}")]
    TwoValues {
        column: String,
        first: Value,
        other: Value,
    },
    #[error("has a {name} that is not a number of seconds: {value}")]
    NoTime { name: String, value: Value },
    #[error("has {has}, and a pick-and-place process {instead}")]
    NotInPickAndPlace {
        has: &'static str,
        instead: &'static str,
    },
    #[error("names {0}, which is no earlier step")]
    NotEarlier(String),
    #[error("has the ua:when {0} without a ua:condition")]
    NoCondition(String),
    #[error("has a condition that {0}")]
    Condition(Box<Self>),
    #[error("has the ua:compare `{0}`; use ==, !=, <, <=, > or >=")]
    Compare(String),
    #[error("has a ua:valueJson that is no JSON: {0}")]
    ConditionJson(String),
    #[error("has no value, or several")]
    ConditionValue,
    #[error("has the ua:endsAs {0}; use \"failed\" or \"timed out\"")]
    EndsAs(Value),
    #[error("has neither a ua:result nor a ua:endsAs, or both")]
    NoTest,
    #[error("has ua:byComponentOf and ua:byAttachedTool; give one")]
    TwoComponents,
    #[error("has ua:byAttachedTool; give ua:byComponentOf")]
    UndoneByTool,
    #[error("is given twice")]
    Twice,
    #[error("needs several skills, and a step of a sequence is one skill")]
    SeveralSkills,
    #[error("has a need whose ua:role is not ptp, linear, grasp or release")]
    Role,
    #[error("needs the type {0}, which no NodeSet here describes")]
    UnknownType(Value),
    #[error("has a need without a capability or type")]
    EmptyNeed,
    #[error("has a parameter without cask:hasVariableName")]
    NamelessParameter,
    #[error("gives the parameter {0} twice")]
    ParameterTwice(String),
    #[error("has several values for {0}, a query among them")]
    QueryAndValue(String),
    #[error("has the parameter {0}")]
    Parameter(ParameterFault),
    #[error("has a ua:valueJson of {name} that is no JSON: {error}")]
    ParameterJson { name: String, error: String },
    #[error("has a ua:unit for {0}; a result has the unit of its skill")]
    UnitOfResult(String),
    #[error("takes {name} from {step}, which is no earlier step")]
    ResultNotEarlier { name: String, step: String },
    #[error("has no value, or several, for {0}")]
    ParameterValue(String),
    #[error("shares steps with another loop; one has to be within the other")]
    SharedSteps,
    #[error("waits for the step {0}, which waits for the end of the loop")]
    WaitsForItself(String),
    #[error("repeats {0}, which is no step")]
    UnknownStep(String),
    #[error("has a ua:rounds that is not from 1 to {most}: {0}", most = Loop::MOST_ROUNDS)]
    Rounds(Value),
    #[error(
        "has a condition about the step {0}, which may not be over when a round is: name a step of \
         the loop, repeat {0} too (ua:repeats), or let a step of the loop come after it (ua:after)"
    )]
    MayNotBeOver(String),
    #[error(
        "has a ua:when about {0} without a step of the loop, so that it holds after each round or \
         never: add a ua:condition about a step that the loop repeats"
    )]
    ConstantCondition(String),
}
