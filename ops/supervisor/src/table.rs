//! Results of SPARQL as a table for the browser.
//!
//! Pure: the media type and the body of a response are parameters.

use std::collections::HashMap;

use serde::Deserialize;
use serde::de::{Deserializer, IgnoredAny, SeqAccess, Visitor};
use serde_json::{Map, Value, json};
use thiserror::Error;

use crate::value::cut;

/// The media types that are read: solutions, and statements.
pub(crate) const ACCEPTED: &str = "application/sparql-results+json, application/ld+json";

/// The reason why a result is no table.
#[derive(Debug, Error)]
pub(crate) enum TableFault {
    /// The media type is unknown.
    #[error("`{0}` is no format of results")]
    Media(String),
    /// The body does not follow its format.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
}

/// The result of SELECT or ASK (SPARQL 1.1 Query Results JSON Format).
#[derive(Deserialize)]
struct Results {
    #[serde(default)]
    head: Head,
    results: Option<Solutions>,
    boolean: Option<bool>,
}

#[derive(Default, Deserialize)]
struct Head {
    #[serde(default)]
    vars: Vec<String>,
}

#[derive(Deserialize)]
struct Solutions {
    bindings: Bindings,
}

/// The first [`MOST_ROWS`] solutions, and the number of all.
#[derive(Default)]
struct Bindings {
    rows: Vec<HashMap<String, Term>>,
    total: usize,
}

impl<'de> Deserialize<'de> for Bindings {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(BindingsVisitor)
    }
}

struct BindingsVisitor;

impl<'de> Visitor<'de> for BindingsVisitor {
    type Value = Bindings;

    fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("a list of solutions")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut all: A) -> Result<Bindings, A::Error> {
        let mut read = Bindings::default();
        while read.rows.len() < MOST_ROWS {
            match all.next_element()? {
                Some(row) => read.rows.push(row),
                None => break,
            }
        }
        read.total = read.rows.len();
        while all.next_element::<IgnoredAny>()?.is_some() {
            read.total += 1;
        }
        Ok(read)
    }
}

#[derive(Deserialize)]
struct Term {
    #[serde(rename = "type")]
    kind: String,
    value: Value,
    datatype: Option<String>,
    #[serde(rename = "xml:lang")]
    language: Option<String>,
}

/// Reads a result as `{"kind", "columns", "rows", "total"}`. A cell is null or
/// `{"is", "value", "datatype", "language"}`; `is` is `uri`, `literal`, `bnode` or `triple`. There
/// are at most [`MOST_ROWS`] rows; `total` counts all rows.
///
/// # Errors
/// [`TableFault`].
pub(crate) fn read(media: &str, body: &[u8]) -> Result<Value, TableFault> {
    match media.split(';').next().unwrap_or_default().trim() {
        "application/sparql-results+json" => Ok(solutions(serde_json::from_slice(body)?)),
        "application/ld+json" => Ok(statements(&serde_json::from_slice(body)?)),
        other => Err(TableFault::Media(cut(other, 100))),
    }
}

fn solutions(results: Results) -> Value {
    if let Some(answer) = results.boolean {
        let cell = cell("literal", &answer.into(), (None, None));
        return table("ask", &["answer".to_owned()], vec![vec![cell]], 1);
    }
    let columns = results.head.vars;
    let all = results.results.map(|solutions| solutions.bindings);
    let all = all.unwrap_or_default();
    let rows = all.rows.iter().map(|row| {
        let cells = columns.iter().map(|column| {
            row.get(column).map_or(Value::Null, |term| {
                let of = (term.datatype.as_deref(), term.language.as_deref());
                cell(&term.kind, &term.value, of)
            })
        });
        cells.collect()
    });
    table("select", &columns, rows.collect(), all.total)
}

/// Reads expanded JSON-LD, which has its nodes in a list.
fn statements(document: &Value) -> Value {
    let nodes = document.get("@graph").unwrap_or(document).as_array();
    let mut rows = Vec::new();
    let mut total = 0;
    for node in nodes.into_iter().flatten().filter_map(Value::as_object) {
        let subject = node.get("@id").map_or(Value::Null, node_cell);
        for (predicate, object) in node.iter().flat_map(objects) {
            total += 1;
            if rows.len() < MOST_ROWS {
                let predicate = cell("uri", &predicate.into(), (None, None));
                rows.push(vec![subject.clone(), predicate, object]);
            }
        }
    }
    let columns = ["subject", "predicate", "object"].map(str::to_owned);
    table("construct", &columns, rows, total)
}

/// Returns the statements of an entry of a node: their predicate and object.
fn objects<'n>((key, values): (&'n String, &'n Value)) -> Vec<(&'n str, Value)> {
    let predicate = match key.as_str() {
        "@type" => TYPE,
        key if key.starts_with('@') => return Vec::new(),
        key => key,
    };
    let all = values.as_array().map(Vec::as_slice);
    let all = all.unwrap_or_else(|| std::slice::from_ref(values));
    let objects = all.iter().map(|object| match object.as_object() {
        Some(object) => (predicate, object_cell(object)),
        None => (predicate, node_cell(object)),
    });
    objects.collect()
}

fn object_cell(object: &Map<String, Value>) -> Value {
    let text = |key: &str| object.get(key).and_then(Value::as_str);
    match (object.get("@id"), object.get("@value")) {
        (Some(id), _) => node_cell(id),
        (None, Some(value)) => cell("literal", value, (text("@type"), text("@language"))),
        (None, None) => Value::Null,
    }
}

fn node_cell(id: &Value) -> Value {
    match id.as_str().and_then(|id| id.strip_prefix("_:")) {
        Some(blank) => cell("bnode", &blank.into(), (None, None)),
        None => cell("uri", id, (None, None)),
    }
}

fn cell(is: &str, value: &Value, (datatype, language): (Option<&str>, Option<&str>)) -> Value {
    let text = match value.as_str() {
        Some(text) => cut(text, LONGEST_TEXT),
        None => cut(&value.to_string(), LONGEST_TEXT),
    };
    json!({ "is": is, "value": text, "datatype": datatype, "language": language })
}

fn table(kind: &str, columns: &[String], rows: Vec<Vec<Value>>, total: usize) -> Value {
    json!({ "kind": kind, "columns": columns, "rows": rows, "total": total })
}

const TYPE: &str = "http://www.w3.org/1999/02/22-rdf-syntax-ns#type";
/// The largest number of rows that a browser is sent.
pub(crate) const MOST_ROWS: usize = 1000;
const LONGEST_TEXT: usize = 2000;

#[cfg(test)]
mod tests {
    use super::*;

    const RESULTS: &str = "application/sparql-results+json";

    #[test]
    fn solutions_are_rows_in_the_order_of_the_columns() {
        let body = br#"{"head":{"vars":["s","n"]},"results":{"bindings":[
            {"n":{"type":"literal","value":"Greifer","xml:lang":"de"},"s":{"type":"uri","value":"urn:a"}},
            {"s":{"type":"bnode","value":"b0"}}]}}"#;
        let table = read(RESULTS, body).unwrap();
        assert_eq!(table["columns"], json!(["s", "n"]));
        assert_eq!(
            (&table["kind"], &table["total"]),
            (&json!("select"), &json!(2))
        );
        assert_eq!(table["rows"][0][0]["value"], "urn:a");
        assert_eq!(table["rows"][0][1]["language"], "de");
        assert_eq!(table["rows"][1][0]["is"], "bnode");
        assert_eq!(table["rows"][1][1], Value::Null, "an unbound variable");
    }

    #[test]
    fn an_answer_of_ask_is_a_row() {
        let table = read(RESULTS, br#"{"head":{},"boolean":false}"#).unwrap();
        assert_eq!(
            (&table["kind"], &table["total"]),
            (&json!("ask"), &json!(1))
        );
        assert_eq!(table["rows"][0][0]["value"], "false");
    }

    #[test]
    fn statements_are_rows_of_three_columns() {
        let body = br#"[{"@id":"urn:a","@type":["urn:C"],"urn:p":[{"@id":"_:b1"},
            {"@type":"http://www.w3.org/2001/XMLSchema#integer","@value":"7"}]}]"#;
        let table = read("application/ld+json; charset=utf-8", body).unwrap();
        let values = |row: usize| -> Vec<&str> {
            let cells = table["rows"][row].as_array().unwrap().iter();
            cells.map(|cell| cell["value"].as_str().unwrap()).collect()
        };
        assert_eq!(
            (&table["kind"], &table["total"]),
            (&json!("construct"), &json!(3))
        );
        assert_eq!(values(0), ["urn:a", TYPE, "urn:C"]);
        assert_eq!(values(1), ["urn:a", "urn:p", "b1"]);
        assert_eq!(table["rows"][1][2]["is"], "bnode");
        assert_eq!(values(2), ["urn:a", "urn:p", "7"]);
    }

    #[test]
    fn rows_beyond_the_limit_are_counted_only() {
        let row = r#"{"s":{"type":"uri","value":"urn:a"}}"#;
        let all = vec![row; MOST_ROWS + 1].join(",");
        let body = format!(r#"{{"head":{{"vars":["s"]}},"results":{{"bindings":[{all}]}}}}"#);
        let table = read(RESULTS, body.as_bytes()).unwrap();
        assert_eq!(table["rows"].as_array().unwrap().len(), MOST_ROWS);
        assert_eq!(table["total"], MOST_ROWS + 1);
    }

    #[test]
    fn other_formats_and_broken_bodies_are_reasons() {
        let fault = read("text/html", b"<p>").unwrap_err().to_string();
        assert_eq!(fault, "`text/html` is no format of results");
        assert!(read(RESULTS, b"{").is_err());
    }
}
