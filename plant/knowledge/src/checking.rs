//! The report of the shapes over HTTP.

use std::io;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::{Response, StatusCode};
use oxigraph::model::{BlankNode, Literal, NamedNode, Term};
use oxigraph::sparql::results::QueryResultsFormat;
use serde::Deserialize;
use tokio::time::Instant;

use crate::http::{HttpRefusal, ServedSite, content, json_page};
use crate::lanes::Lane;
use crate::query::{BoundedResults, Dataset, Formats, QueryFault, QueryOrQuestion};
use crate::shapes::{Check, ShapeReport, Shapes, Violation};
use crate::store::{Knowledge, KnowledgeFault};

impl ServedSite {
    /// Checks the knowledge against the shapes. The report is Turtle, or JSON if that is accepted.
    pub(crate) async fn report(
        &self,
        is_json: bool,
        peer: IpAddr,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let failed =
            |what: String| HttpRefusal::new(StatusCode::INTERNAL_SERVER_ERROR, "failed", &what);
        let knowledge = Arc::clone(self.queries.knowledge());
        let reading = tokio::task::spawn_blocking(move || compiled(&knowledge));
        let read = reading.await.map_err(|error| failed(error.to_string()))?;
        let (shapes, checks, unchecked) = read.map_err(|fault| failed(fault.to_string()))?;
        let mut report = ShapeReport {
            unchecked,
            ..ShapeReport::default()
        };
        let end = Instant::now() + TIME;
        let mut size = 0;
        for check in checks {
            if Instant::now() >= end || size > MAX_SIZE {
                report.not_checked(&check, "the time or the size of the report is over");
                continue;
            }
            let asked = QueryOrQuestion::Sparql(
                check.query.clone(),
                Dataset::default(),
                Formats {
                    solutions: Some(QueryResultsFormat::Json),
                    triples: None,
                },
            );
            let running = self.queries.run(asked, Lane::Open(peer));
            match tokio::time::timeout_at(end, running).await {
                Ok(Ok(BoundedResults::Written(written))) => {
                    let rows = written.bytes;
                    size += rows.len();
                    let each = size_of_each(&check);
                    let reading = tokio::task::spawn_blocking(move || violations_in(&check, &rows));
                    let read = reading.await.map_err(|error| failed(error.to_string()))?;
                    let found = read.map_err(|error| failed(error.to_string()))?;
                    size += found.len() * each;
                    report.violations.extend(found);
                }
                Ok(Ok(_)) => {}
                Ok(Err(fault @ QueryFault::Busy(_))) => return Err(fault.into()),
                Ok(Err(fault)) => report.not_checked(&check, &fault.to_string()),
                Err(_) => report.not_checked(&check, "the time of the report is over"),
            }
        }
        let writing = tokio::task::spawn_blocking(move || page(&report, &shapes, is_json));
        let written = writing.await.map_err(|error| failed(error.to_string()))?;
        written.map_err(|error| failed(error.to_string()))
    }
}

/// The shapes, their checks, and their parts that are not checked.
type Compiled = (Shapes, Vec<Check>, Vec<String>);

/// Reads and compiles the shapes, which takes long for many of them.
fn compiled(knowledge: &Knowledge) -> Result<Compiled, KnowledgeFault> {
    let shapes = Shapes::of(knowledge)?;
    let (checks, unchecked) = shapes.checks();
    Ok((shapes, checks, unchecked))
}

/// Writes a report, which takes long for many violations.
fn page(report: &ShapeReport, shapes: &Shapes, is_json: bool) -> io::Result<Response<Full<Bytes>>> {
    if is_json {
        Ok(json_page(&report.json()))
    } else {
        Ok(content("text/turtle", report.turtle(shapes)?))
    }
}

/// Returns the bytes of the texts that each violation of a constraint repeats.
fn size_of_each(check: &Check) -> usize {
    let path = check.path.as_ref().map_or(0, |(_, path)| path.len());
    check.shape.to_string().len() + check.message.len() + path
}

impl ShapeReport {
    fn not_checked(&mut self, check: &Check, why: &str) {
        let Check {
            shape, component, ..
        } = check;
        self.unchecked.push(format!("{shape}: {component}: {why}"));
    }
}

/// The JSON results format of SPARQL 1.1.
#[derive(Debug, Deserialize)]
struct Solutions {
    results: Bindings,
}

#[derive(Debug, Deserialize)]
struct Bindings {
    bindings: Vec<Row>,
}

#[derive(Debug, Deserialize)]
struct Row {
    this: Option<Found>,
    value: Option<Found>,
    path: Option<Found>,
}

#[derive(Debug, Deserialize)]
struct Found {
    #[serde(rename = "type")]
    kind: String,
    value: String,
    datatype: Option<String>,
    #[serde(rename = "xml:lang")]
    language: Option<String>,
}

/// Reads the violations of a constraint, which takes long for a large result.
fn violations_in(check: &Check, json: &[u8]) -> serde_json::Result<Vec<Violation>> {
    let read: Solutions = serde_json::from_slice(json)?;
    let rows = read.results.bindings.into_iter();
    Ok(rows.filter_map(|row| violation(check, row)).collect())
}

fn violation(check: &Check, row: Row) -> Option<Violation> {
    let path = row.path.map(term).map(|path| {
        let text = path.to_string();
        (path, text)
    });
    Some(Violation {
        focus: row.this.map(term)?,
        value: row.value.map(term),
        path: path.or_else(|| check.path.clone()),
        shape: check.shape.clone(),
        component: check.component.clone(),
        severity: check.severity.clone(),
        message: check.message.clone(),
    })
}

fn term(found: Found) -> Term {
    match (found.kind.as_str(), found.datatype, found.language) {
        ("uri", ..) => NamedNode::new_unchecked(found.value).into(),
        ("bnode", ..) => BlankNode::new_unchecked(found.value).into(),
        (_, _, Some(language)) => {
            Literal::new_language_tagged_literal_unchecked(found.value, language).into()
        }
        (_, Some(datatype), None) => {
            Literal::new_typed_literal(found.value, NamedNode::new_unchecked(datatype)).into()
        }
        (_, None, None) => Literal::new_simple_literal(found.value).into(),
    }
}

/// Time limit of a report, below that of clients.
const TIME: Duration = Duration::from_secs(10);
/// Maximum size of the collected results in bytes. The last constraint may exceed it.
const MAX_SIZE: usize = 32 << 20;
