//! Queries whose only value is needed, such as the value of a parameter.

use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use oxigraph::model::Term;
use oxigraph::sparql::{CancellationToken, QueryEvaluationError, QueryResults, SparqlEvaluator};
use serde_json::Value;
use spargebra::Query;
use spargebra::algebra::GraphPattern;
use thiserror::Error;

use crate::bounds;
use crate::query::{self, QueryFault};
use crate::question;
use crate::store::Knowledge;

/// A SELECT query with a single variable, whose result must have a single row.
#[derive(Debug, Clone)]
pub struct ValueQuery(Query);

/// The reason why a query has no value.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ValueQueryFault {
    /// The text is no query that may run.
    #[error("{0}")]
    Query(String),
    /// It has another form.
    #[error("it is no SELECT; use SELECT with one variable")]
    Form,
    /// It does not select one variable.
    #[error("it selects {0} variables; select one")]
    Variables(usize),
    /// There is no row.
    #[error("it has no row")]
    NoRow,
    /// There are several rows.
    #[error("it has several rows, {first} and {second} among them; narrow it down to one")]
    SeveralRows {
        /// The value of a row.
        first: String,
        /// The value of another row.
        second: String,
    },
    /// The row has no value, or a blank node.
    #[error("its row has no value")]
    NoValue,
    /// The time limit has passed.
    #[error("it took longer than {} s and was stopped; narrow it down", limit.as_secs_f64())]
    Time {
        /// The limit.
        limit: Duration,
    },
    /// The memory of the program grew by too much while it ran.
    #[error("it takes more than {} MiB of memory; narrow it down", most >> 20)]
    Memory {
        /// The limit in bytes.
        most: u64,
    },
    /// The evaluator failed.
    #[error("it fails: {0}")]
    Failed(String),
}

impl ValueQuery {
    /// Reads the text of a query.
    ///
    /// # Errors
    /// The reason why it cannot have a value.
    pub fn read(text: &str) -> Result<Self, ValueQueryFault> {
        let fault = |fault: QueryFault| ValueQueryFault::Query(fault.to_string());
        if text.len() > LONGEST {
            return Err(fault(QueryFault::TooLong { most: LONGEST }));
        }
        bounds::nests(text).map_err(fault)?;
        let query = query::parsed(text).map_err(fault)?;
        bounds::check(&query).map_err(fault)?;
        let Query::Select { pattern, .. } = &query else {
            return Err(ValueQueryFault::Form);
        };
        match selected(pattern) {
            Some(1) => Ok(Self(query)),
            selected => Err(ValueQueryFault::Variables(selected.unwrap_or_default())),
        }
    }

    /// Evaluates the query. Takes at most [`TIME`](Self::TIME).
    ///
    /// # Errors
    /// The reason why it has no value.
    pub fn value(&self, knowledge: &Arc<Knowledge>) -> Result<Value, ValueQueryFault> {
        self.value_within(knowledge, &mut query::resident)
    }

    /// Evaluates the query. `resident` returns the memory of the program in bytes.
    ///
    /// The memory may have grown for another reason, such as a NodeSet that is loaded. Therefore a
    /// query that was stopped because of memory is evaluated once more in the remaining time.
    fn value_within(
        &self,
        knowledge: &Arc<Knowledge>,
        resident: &mut dyn FnMut() -> Option<u64>,
    ) -> Result<Value, ValueQueryFault> {
        let end = now() + Self::TIME;
        match self.attempt(knowledge, end, resident) {
            Err(ValueQueryFault::Memory { .. }) => self.attempt(knowledge, end, resident),
            done => done,
        }
    }

    fn attempt(
        &self,
        knowledge: &Arc<Knowledge>,
        end: Instant,
        resident: &mut dyn FnMut() -> Option<u64>,
    ) -> Result<Value, ValueQueryFault> {
        let (knowledge, query) = (Arc::clone(knowledge), self.0.clone());
        let token = CancellationToken::new();
        let stop = token.clone();
        let (tell, told) = mpsc::sync_channel(1);
        let thread = std::thread::Builder::new().name("value query".to_owned());
        let before = resident();
        let started = thread.stack_size(query::STACK).spawn(move || {
            // The receiver may have been dropped.
            let _told = tell.send(evaluated(&knowledge, query, token));
        });
        started.map_err(|error| ValueQueryFault::Failed(error.to_string()))?;
        loop {
            match told.recv_timeout(LOOK) {
                Ok(value) => return value,
                Err(mpsc::RecvTimeoutError::Disconnected) => {
                    return Err(ValueQueryFault::Failed("its thread ended".to_owned()));
                }
                Err(mpsc::RecvTimeoutError::Timeout) => {}
            }
            if now() >= end {
                stop.cancel();
                return Err(ValueQueryFault::Time { limit: Self::TIME });
            }
            let grown = before.zip(resident());
            if grown.is_some_and(|(before, now)| now.saturating_sub(before) > MOST_MEMORY) {
                stop.cancel();
                // The memory of this attempt is free before the next attempt measures.
                let rest = end.saturating_duration_since(now());
                return match told.recv_timeout(rest) {
                    Ok(Ok(value)) => Ok(value),
                    Ok(Err(_)) | Err(_) => Err(ValueQueryFault::Memory { most: MOST_MEMORY }),
                };
            }
        }
    }

    /// Time limit of an evaluation.
    pub const TIME: Duration = Duration::from_secs(1);
}

fn evaluated(
    knowledge: &Knowledge,
    query: Query,
    token: CancellationToken,
) -> Result<Value, ValueQueryFault> {
    let failed = |error: QueryEvaluationError| ValueQueryFault::Failed(error.to_string());
    let evaluator = SparqlEvaluator::new().with_cancellation_token(token);
    let store = knowledge.store();
    let prepared = evaluator.for_query(query).on_store(&store);
    let QueryResults::Solutions(mut solutions) = prepared.execute().map_err(failed)? else {
        return Err(ValueQueryFault::Form);
    };
    let mut next = || -> Result<Option<Option<Term>>, ValueQueryFault> {
        let solution = solutions.next().transpose().map_err(failed)?;
        Ok(solution.map(|solution| solution.values().first().cloned().flatten()))
    };
    let first = next()?.ok_or(ValueQueryFault::NoRow)?;
    if let Some(second) = next()? {
        let shown = |term: Option<Term>| {
            let text = term.map_or_else(|| "no value".to_owned(), |term| term.to_string());
            text.chars().take(SHOWN).collect()
        };
        return Err(ValueQueryFault::SeveralRows {
            first: shown(first),
            second: shown(second),
        });
    }
    match first {
        None | Some(Term::BlankNode(_)) => Err(ValueQueryFault::NoValue),
        Some(term) => Ok(question::plain(Some(&term))),
    }
}

/// Returns the number of variables that a SELECT has.
fn selected(pattern: &GraphPattern) -> Option<usize> {
    match pattern {
        GraphPattern::Project { variables, .. } => Some(variables.len()),
        GraphPattern::Distinct { inner }
        | GraphPattern::Reduced { inner }
        | GraphPattern::Slice { inner, .. }
        | GraphPattern::OrderBy { inner, .. }
        | GraphPattern::Extend { inner, .. }
        | GraphPattern::Filter { inner, .. } => selected(inner),
        GraphPattern::Bgp { .. }
        | GraphPattern::Path { .. }
        | GraphPattern::Join { .. }
        | GraphPattern::Lateral { .. }
        | GraphPattern::LeftJoin { .. }
        | GraphPattern::Union { .. }
        | GraphPattern::Graph { .. }
        | GraphPattern::Minus { .. }
        | GraphPattern::Values { .. }
        | GraphPattern::Group { .. }
        | GraphPattern::Service { .. } => None,
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "the limit of the wait for another thread, which no caller can give"
)]
fn now() -> Instant {
    Instant::now()
}

/// Maximum size of a query in bytes.
const LONGEST: usize = 16 << 10;
/// Maximum growth of the program while a query runs, in bytes.
const MOST_MEMORY: u64 = 256 << 20;
/// Period of the checks of time and memory.
const LOOK: Duration = Duration::from_millis(25);
/// Number of characters of a value in a message.
const SHOWN: usize = 100;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::{KnowledgeSource, SourceKind};

    fn knowledge(turtle: &str) -> Arc<Knowledge> {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let source = KnowledgeSource::new(SourceKind::File, "part");
        knowledge.replace_turtle(&source, turtle, 1).unwrap();
        knowledge
    }

    const PART: &str = "<urn:part> <urn:width> 31.5 , 40 ; <urn:name> \"box\" ; <urn:is> true ;
        <urn:node> [ <urn:depth> 4 ] ; <urn:kind> <urn:box> ;
        <urn:serial> \"18446744073709551615\"^^<http://www.w3.org/2001/XMLSchema#unsignedLong> ;
        <urn:below> \"-5\"^^<http://www.w3.org/2001/XMLSchema#negativeInteger> .";

    #[test]
    fn the_only_value_of_a_query_is_its_value() {
        let knowledge = knowledge(PART);
        for (query, value) in [
            (
                "SELECT ?w { <urn:part> <urn:width> ?w FILTER(?w > 35) }",
                Value::from(40),
            ),
            (
                "SELECT (MIN(?w) AS ?least) { <urn:part> <urn:width> ?w }",
                31.5.into(),
            ),
            (
                "SELECT DISTINCT ?n { <urn:part> <urn:name> ?n } LIMIT 5",
                "box".into(),
            ),
            ("SELECT ?is { <urn:part> <urn:is> ?is }", true.into()),
            ("SELECT ?n { <urn:part> <urn:serial> ?n }", u64::MAX.into()),
            ("SELECT ?n { <urn:part> <urn:below> ?n }", (-5).into()),
            (
                "SELECT ?kind { <urn:part> <urn:kind> ?kind }",
                "urn:box".into(),
            ),
        ] {
            let read = ValueQuery::read(query).unwrap();
            assert_eq!(read.value(&knowledge), Ok(value), "{query}");
        }
    }

    #[test]
    fn a_query_without_one_value_has_a_fault() {
        let knowledge = knowledge(PART);
        for (query, fault) in [
            ("SELECT ?w { <urn:other> <urn:width> ?w }", "it has no row"),
            ("SELECT ?w { <urn:part> <urn:width> ?w }", "several rows"),
            (
                "SELECT ?w { <urn:part> <urn:is> ?is OPTIONAL { ?is <urn:width> ?w } }",
                "no value",
            ),
            ("SELECT ?node { <urn:part> <urn:node> ?node }", "no value"),
        ] {
            let why = ValueQuery::read(query).unwrap().value(&knowledge);
            let why = why.unwrap_err().to_string();
            assert!(why.contains(fault), "{query}: {why}");
        }
        for (query, fault) in [
            (
                "SELECT ?a ?b { ?a ?p ?b }",
                "it selects 2 variables; select one",
            ),
            ("ASK { ?a ?p ?b }", "it is no SELECT"),
            ("SELECT ?a {", "cannot be read: error at 1:12"),
            (
                "SELECT ?a { SERVICE <urn:x> { ?a ?p ?b } }",
                "SERVICE is not answered",
            ),
            ("CLEAR ALL", "this is an update"),
        ] {
            let why = ValueQuery::read(query).unwrap_err().to_string();
            assert!(why.contains(fault), "{query}: {why}");
        }
    }

    const LONG: &str = "SELECT (COUNT(*) AS ?n) { ?a ?b ?c . ?d ?e ?f . ?g ?h ?i }";

    fn many() -> Arc<Knowledge> {
        let many: String = (0..2000)
            .map(|number| format!("<urn:s{number}> <urn:p> {number} .\n"))
            .collect();
        knowledge(&many)
    }

    #[test]
    fn a_query_that_takes_too_long_is_stopped() {
        // The program grows once for another reason, and keeps the memory.
        let mut looks = 0;
        let mut resident = || {
            looks += 1;
            Some(if looks == 1 { 0 } else { 2 * MOST_MEMORY })
        };
        let why = ValueQuery::read(LONG)
            .unwrap()
            .value_within(&many(), &mut resident);
        assert_eq!(
            why,
            Err(ValueQueryFault::Time {
                limit: ValueQuery::TIME
            }),
            "the memory of something else stops no query"
        );
        assert!(looks > 3, "{looks}");
    }

    #[test]
    fn a_query_that_takes_too_much_memory_again_is_stopped() {
        let mut used = 0;
        let mut resident = || {
            used += 2 * MOST_MEMORY;
            Some(used)
        };
        let why = ValueQuery::read(LONG)
            .unwrap()
            .value_within(&many(), &mut resident);
        assert_eq!(why, Err(ValueQueryFault::Memory { most: MOST_MEMORY }));
        assert_eq!(used, 8 * MOST_MEMORY, "two attempts");
    }
}
