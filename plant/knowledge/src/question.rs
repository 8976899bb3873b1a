//! Named questions: SPARQL in files, and their answers as plain JSON.

use std::collections::BTreeMap;

use oxigraph::model::{Literal, NamedNode, Term};
use oxigraph::sparql::{QueryEvaluationError, QueryResults, QuerySolutionIter, SparqlEvaluator};
use serde::Serialize;
use serde_json::Value;
use thiserror::Error;

use crate::store::Knowledge;

/// A question with a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NamedQuestion {
    /// Its name.
    pub name: &'static str,
    /// Its SPARQL, a complete query for any SPARQL endpoint. Lines that begin with `#:` contain its
    /// description.
    pub sparql: &'static str,
}

/// The answer: rows in order, each with all columns.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct QuestionAnswer {
    /// The name of the question.
    pub question: String,
    /// The names of the columns in order.
    pub columns: Vec<String>,
    /// The rows. A value is a text, a number, a boolean, null, or a list of texts.
    pub rows: Vec<BTreeMap<String, Value>>,
}

/// Error of a question.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum QuestionFault {
    /// There is no question of this name.
    #[error("there is no question `{name}`; there are {known}")]
    Unknown {
        /// The requested name.
        name: String,
        /// The available names.
        known: String,
    },
    /// The question has no such parameter.
    #[error("`{question}` has no parameter `{parameter}`; {known}")]
    Parameter {
        /// The question.
        question: &'static str,
        /// The given parameter.
        parameter: String,
        /// The available parameters.
        known: String,
    },
    /// A parameter is not an IRI.
    #[error("`{parameter}` is to be an IRI, and `{value}` is none: {why}")]
    Iri {
        /// The parameter.
        parameter: String,
        /// The given value.
        value: String,
        /// Description of the error.
        why: String,
    },
    /// The query of the question is invalid.
    #[error("the question `{question}` cannot be asked: {why}")]
    Sparql {
        /// The question.
        question: &'static str,
        /// Description of the error.
        why: String,
    },
}

/// All questions, by their names.
pub const QUESTIONS: &[NamedQuestion] = &[
    NamedQuestion {
        name: "access-of",
        sparql: include_str!("../queries/access-of.rq"),
    },
    NamedQuestion {
        name: "action-parameters",
        sparql: include_str!("../queries/action-parameters.rq"),
    },
    NamedQuestion {
        name: "actions",
        sparql: include_str!("../queries/actions.rq"),
    },
    NamedQuestion {
        name: "candidates",
        sparql: include_str!("../queries/candidates.rq"),
    },
    NamedQuestion {
        name: "commands",
        sparql: include_str!("../queries/commands.rq"),
    },
    NamedQuestion {
        name: "components",
        sparql: include_str!("../queries/components.rq"),
    },
    NamedQuestion {
        name: "components-of",
        sparql: include_str!("../queries/components-of.rq"),
    },
    NamedQuestion {
        name: "goals",
        sparql: include_str!("../queries/goals.rq"),
    },
    NamedQuestion {
        name: "modules-with",
        sparql: include_str!("../queries/modules-with.rq"),
    },
    NamedQuestion {
        name: "objects",
        sparql: include_str!("../queries/objects.rq"),
    },
    NamedQuestion {
        name: "operations",
        sparql: include_str!("../queries/operations.rq"),
    },
    NamedQuestion {
        name: "outputs-of",
        sparql: include_str!("../queries/outputs-of.rq"),
    },
    NamedQuestion {
        name: "parameters",
        sparql: include_str!("../queries/parameters.rq"),
    },
    NamedQuestion {
        name: "parameters-of",
        sparql: include_str!("../queries/parameters-of.rq"),
    },
    NamedQuestion {
        name: "process-conditions",
        sparql: include_str!("../queries/process-conditions.rq"),
    },
    NamedQuestion {
        name: "process-loops",
        sparql: include_str!("../queries/process-loops.rq"),
    },
    NamedQuestion {
        name: "process-parameters",
        sparql: include_str!("../queries/process-parameters.rq"),
    },
    NamedQuestion {
        name: "process-steps",
        sparql: include_str!("../queries/process-steps.rq"),
    },
    NamedQuestion {
        name: "processes",
        sparql: include_str!("../queries/processes.rq"),
    },
    NamedQuestion {
        name: "run-steps",
        sparql: include_str!("../queries/run-steps.rq"),
    },
    NamedQuestion {
        name: "run-values",
        sparql: include_str!("../queries/run-values.rq"),
    },
    NamedQuestion {
        name: "runs",
        sparql: include_str!("../queries/runs.rq"),
    },
    NamedQuestion {
        name: "services-of",
        sparql: include_str!("../queries/services-of.rq"),
    },
    NamedQuestion {
        name: "skills",
        sparql: include_str!("../queries/skills.rq"),
    },
    NamedQuestion {
        name: "skills-for",
        sparql: include_str!("../queries/skills-for.rq"),
    },
    NamedQuestion {
        name: "sources",
        sparql: include_str!("../queries/sources.rq"),
    },
    NamedQuestion {
        name: "state-of",
        sparql: include_str!("../queries/state-of.rq"),
    },
    NamedQuestion {
        name: "transitions-now",
        sparql: include_str!("../queries/transitions-now.rq"),
    },
    NamedQuestion {
        name: "types",
        sparql: include_str!("../queries/types.rq"),
    },
    NamedQuestion {
        name: "what-can-hold",
        sparql: include_str!("../queries/what-can-hold.rq"),
    },
    NamedQuestion {
        name: "what-can-run",
        sparql: include_str!("../queries/what-can-run.rq"),
    },
    NamedQuestion {
        name: "where-is",
        sparql: include_str!("../queries/where-is.rq"),
    },
    NamedQuestion {
        name: "who-provides",
        sparql: include_str!("../queries/who-provides.rq"),
    },
];

impl NamedQuestion {
    /// Returns the question of a name.
    ///
    /// # Errors
    /// [`QuestionFault::Unknown`].
    pub fn of(name: &str) -> Result<Self, QuestionFault> {
        let known = || {
            QUESTIONS
                .iter()
                .map(|question| question.name)
                .collect::<Vec<_>>()
                .join(", ")
        };
        QUESTIONS
            .iter()
            .find(|question| question.name == name)
            .copied()
            .ok_or_else(|| QuestionFault::Unknown {
                name: name.chars().take(100).collect(),
                known: known(),
            })
    }

    /// Returns the description of the question in a single sentence.
    #[must_use]
    pub fn about(self) -> &'static str {
        self.told("about").next().unwrap_or_default()
    }

    /// Returns the names of its parameters.
    pub fn parameters(self) -> impl Iterator<Item = &'static str> {
        self.told("parameter").chain(self.told("text"))
    }

    /// Returns the columns that are lists of texts.
    pub fn lists(self) -> impl Iterator<Item = &'static str> {
        self.told("list").flat_map(str::split_whitespace)
    }

    /// Returns its SPARQL with values for some of its parameters.
    ///
    /// # Errors
    /// [`QuestionFault::Parameter`] and [`QuestionFault::Iri`].
    pub fn with(self, parameters: &[(String, String)]) -> Result<String, QuestionFault> {
        let mut sparql = self.sparql.to_owned();
        for (name, value) in parameters {
            if !self.parameters().any(|known| known == name) {
                let all: Vec<_> = self.parameters().collect();
                return Err(QuestionFault::Parameter {
                    question: self.name,
                    parameter: name.chars().take(100).collect(),
                    known: if all.is_empty() {
                        "it has none".to_owned()
                    } else {
                        format!("it has {}", all.join(", "))
                    },
                });
            }
            let term: Term = if self.told("text").any(|text| text == name) {
                Literal::new_simple_literal(value).into()
            } else {
                let why = |error: oxigraph::model::IriParseError| QuestionFault::Iri {
                    parameter: name.clone(),
                    value: value.chars().take(200).collect(),
                    why: error.to_string(),
                };
                NamedNode::new(value).map_err(why)?.into()
            };
            // The printed form of a term escapes all characters that could end it.
            let given = format!("VALUES ?for_{name} {{ {term} }}");
            sparql = sparql.replace(
                &format!("VALUES ?for_{name} {{ UNDEF }}"),
                &match self.narrowed(name, value) {
                    Some(pattern) => format!("{given} {pattern}"),
                    None => given,
                },
            );
        }
        Ok(sparql)
    }

    /// Returns the pattern that leads from the value of a parameter to its nodes: without it, the
    /// query would look at all nodes and leave out the others afterwards. It is in the lines
    /// `#: narrow PARAMETER PATTERN`, in which `$text` is the value as text, and `$iri` the value as
    /// IRI. A line with `$iri` is left out if the value is no IRI.
    fn narrowed(self, parameter: &str, value: &str) -> Option<String> {
        let text = Literal::new_simple_literal(value).to_string();
        let iri = NamedNode::new(value).ok().map(|iri| iri.to_string());
        let mut pattern = String::new();
        for line in self.told("narrow") {
            let Some((of, line)) = line.split_once(' ') else {
                continue;
            };
            if of != parameter || (line.contains("$iri") && iri.is_none()) {
                continue;
            }
            // The text is last, since a value may contain `$iri`.
            let line = line.replace("$iri", iri.as_deref().unwrap_or_default());
            pattern.push_str(&line.replace("$text", &text));
            pattern.push(' ');
        }
        (!pattern.is_empty()).then_some(pattern)
    }

    fn told(self, key: &'static str) -> impl Iterator<Item = &'static str> {
        let lines = self
            .sparql
            .lines()
            .filter_map(|line| line.strip_prefix("#: "));
        lines.filter_map(move |line| line.strip_prefix(key)?.strip_prefix(' '))
    }

    /// Converts solutions to the answer. Stops at the first error, such as that of a cancelled
    /// query.
    pub(crate) fn answer(
        self,
        solutions: QuerySolutionIter<'_>,
    ) -> Result<QuestionAnswer, QueryEvaluationError> {
        let columns: Vec<String> = solutions
            .variables()
            .iter()
            .map(|variable| variable.as_str().to_owned())
            .collect();
        let lists: Vec<&str> = self.lists().collect();
        let mut rows = Vec::new();
        for solution in solutions.take(MOST_ROWS) {
            let solution = solution?;
            let value = |column: &String| {
                let term = solution.get(column.as_str());
                if lists.contains(&column.as_str()) {
                    list(term)
                } else {
                    plain(term)
                }
            };
            rows.push(
                columns
                    .iter()
                    .map(|column| (column.clone(), value(column)))
                    .collect::<BTreeMap<_, _>>(),
            );
        }
        rows.sort_by_cached_key(|row| {
            columns
                .iter()
                .filter_map(|column| row.get(column))
                .map(key)
                .collect::<Vec<_>>()
        });
        Ok(QuestionAnswer {
            question: self.name.to_owned(),
            columns,
            rows,
        })
    }
}

impl Knowledge {
    /// Evaluates a question in this thread, without a time limit: for the questions of this crate
    /// on data accepted by this crate.
    ///
    /// # Errors
    /// [`QuestionFault`].
    pub fn ask(
        &self,
        name: &str,
        parameters: &[(String, String)],
    ) -> Result<QuestionAnswer, QuestionFault> {
        let question = NamedQuestion::of(name)?;
        let sparql = question.with(parameters)?;
        let fault = |why: String| QuestionFault::Sparql {
            question: question.name,
            why,
        };
        let prepared = SparqlEvaluator::new()
            .parse_query(&sparql)
            .map_err(|error| fault(error.to_string()))?;
        match prepared.on_store(&self.store()).execute() {
            Ok(QueryResults::Solutions(solutions)) => {
                let answer = question
                    .answer(solutions)
                    .map_err(|error| fault(error.to_string()))?;
                if answer.rows.len() >= MOST_ROWS {
                    return Err(fault(format!("it has {MOST_ROWS} rows or more")));
                }
                Ok(answer)
            }
            Ok(QueryResults::Boolean(_) | QueryResults::Graph(_)) => {
                Err(fault("it is no SELECT".to_owned()))
            }
            Err(error) => Err(fault(error.to_string())),
        }
    }
}

impl QuestionAnswer {
    /// Returns the text in a row; empty if missing.
    #[must_use]
    pub fn text<'a>(row: &'a BTreeMap<String, Value>, column: &str) -> &'a str {
        row.get(column).and_then(Value::as_str).unwrap_or_default()
    }

    /// Returns the list of texts in a row; empty if missing.
    #[must_use]
    pub fn texts(row: &BTreeMap<String, Value>, column: &str) -> Vec<String> {
        let all = row
            .get(column)
            .and_then(Value::as_array)
            .into_iter()
            .flatten();
        all.filter_map(Value::as_str).map(str::to_owned).collect()
    }
}

pub(crate) fn plain(term: Option<&Term>) -> Value {
    match term {
        None => Value::Null,
        Some(Term::NamedNode(node)) => node.as_str().into(),
        Some(Term::BlankNode(node)) => node.to_string().into(),
        Some(Term::Literal(literal)) => number(literal).unwrap_or_else(|| literal.value().into()),
    }
}

/// Returns the number or boolean of a literal, if any.
fn number(literal: &Literal) -> Option<Value> {
    let of = literal
        .datatype()
        .as_str()
        .strip_prefix("http://www.w3.org/2001/XMLSchema#")?;
    match of {
        "integer" | "int" | "long" | "short" | "byte" | "nonNegativeInteger"
        | "positiveInteger" | "nonPositiveInteger" | "negativeInteger" | "unsignedLong"
        | "unsignedInt" | "unsignedShort" | "unsignedByte" => {
            let (text, large) = (literal.value(), || literal.value().parse::<u64>());
            let number = text.parse::<i64>().map(Value::from);
            number.or_else(|_| large().map(Value::from)).ok()
        }
        "double" | "float" | "decimal" => literal
            .value()
            .parse::<f64>()
            .ok()
            .filter(|number| number.is_finite())
            .map(Value::from),
        "boolean" => match literal.value() {
            "true" | "1" => Some(true.into()),
            "false" | "0" => Some(false.into()),
            _ => None,
        },
        _ => None,
    }
}

fn list(term: Option<&Term>) -> Value {
    let Some(Term::Literal(all)) = term else {
        return Value::Array(Vec::new());
    };
    let mut all: Vec<&str> = all
        .value()
        .split('\n')
        .filter(|text| !text.is_empty())
        .collect();
    all.sort_unstable();
    all.into()
}

/// Returns the sort key of rows: numbers by value, then texts.
fn key(value: &Value) -> (u64, String) {
    // The larger of two positive doubles has the larger bits; inverting negative doubles extends
    // this to all doubles.
    let order = |number: f64| {
        let bits = number.to_bits();
        if number.is_sign_negative() {
            !bits
        } else {
            bits | (1 << 63)
        }
    };
    match value {
        Value::Number(number) => (number.as_f64().map_or(0, order), String::new()),
        Value::String(text) => (u64::MAX, text.clone()),
        Value::Null => (0, String::new()),
        Value::Bool(_) | Value::Array(_) | Value::Object(_) => (u64::MAX, value.to_string()),
    }
}

/// Maximum number of rows of an answer. An answer with as many rows is incomplete.
pub(crate) const MOST_ROWS: usize = 100_000;
