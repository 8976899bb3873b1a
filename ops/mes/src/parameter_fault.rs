//! The reasons why a skill cannot have the parameters or the results of a step.

use knowledge::ValueQueryFault;
use serde_json::Value;
use skills::{InvalidParameter, OutOfWorkspace, ValueError};

/// The reason why a skill cannot do a step: its parameters, or the results that other steps take.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum ParameterFault {
    #[error("its component is gone")]
    Gone,
    #[error("{skill} needs the parameter {parameter}, and the step does not give it")]
    Missing { skill: String, parameter: String },
    #[error("{skill} has no {kind} {name}; {}", has(known))]
    Unknown {
        skill: String,
        kind: &'static str,
        name: String,
        /// The names that the skill has.
        known: Vec<String>,
    },
    /// The name of the parameter, with that of its query.
    #[error("{0}: {1}")]
    Given(String, GivenFault),
    #[error(transparent)]
    Workspace(#[from] OutOfWorkspace),
    #[error(transparent)]
    Target(#[from] InvalidParameter),
    #[error("{result} is {has}, and {wanted} is expected")]
    Kind {
        result: String,
        has: &'static str,
        wanted: &'static str,
    },
    #[error("{result} has the unit {unit}, which cannot be converted to {to}")]
    ResultUnit {
        result: String,
        unit: String,
        to: String,
    },
    #[error("{result} has the unit {unit}, and the skill gives no unit")]
    SkillWithoutUnit { result: String, unit: String },
}

/// The reason why a parameter of a step has no value that its skill takes.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub(crate) enum GivenFault {
    #[error(transparent)]
    Query(#[from] ValueQueryFault),
    #[error(transparent)]
    Shape(#[from] ValueError),
    #[error("{0} is not a number")]
    Unreal(Value),
    #[error("{number} is not from {low} to {high}{}", spaced(unit))]
    OutOfRange {
        number: f64,
        low: f64,
        high: f64,
        /// The unit of the skill; empty if it has none.
        unit: String,
    },
    #[error("the skill gives no unit, and {0} is given")]
    NoUnit(String),
    #[error("`{value}` with the unit {unit} is no number")]
    NoNumber { value: Value, unit: String },
    #[error("its unit is {to}, and {from} cannot be converted to it")]
    Unit { from: String, to: String },
    #[error("its step is not done")]
    NotDone,
    #[error("{skill} returned no result {result}")]
    NoResult { skill: String, result: String },
}

fn spaced(unit: &str) -> String {
    match unit {
        "" => String::new(),
        unit => format!(" {unit}"),
    }
}

fn has(known: &[String]) -> String {
    match known {
        [] => "it has none".to_owned(),
        known => format!("it has {}", known.join(", ")),
    }
}
