//! Queries and changes for other protocols than HTTP. They run in the places and within the limits
//! of the queries over HTTP.

use std::fmt;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::sync::Arc;

use crate::lanes::Lane;
use crate::query::{BoundedResults, Formats, Queries, QueryFault, QueryOrQuestion};
use crate::writes::{SourceFiles, SourceFinding, Writes, file_source, reading_place};
use crate::written::{ResultCut, WrittenResult};

/// Answers queries and makes changes. The caller checks the rights of the client before.
#[derive(Clone)]
pub struct KnowledgeRequests {
    queries: Queries,
    now: fn() -> u64,
    files: Arc<dyn SourceFiles>,
}

impl fmt::Debug for KnowledgeRequests {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("KnowledgeRequests").finish_non_exhaustive()
    }
}

/// A query whose result may end early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QueryRequest<'a> {
    /// The query, as SPARQL.
    pub text: &'a str,
    /// The media type of the result; JSON and N-Triples if empty.
    pub format: &'a str,
    /// Maximum number of rows; that of [`KnowledgeRequests::MOST_ROWS`] if 0.
    pub rows: usize,
    /// The user. All sessions of a user have one share of the places.
    pub user: &'a str,
}

/// Reason for refusing a request.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct KnowledgeRefusal {
    /// The code, as in the responses over HTTP.
    pub code: &'static str,
    /// The reason.
    pub message: String,
    /// The line of the input, from 1, if it is known.
    pub line: Option<usize>,
    /// The findings in the order of the file, if the input is a file.
    pub findings: Vec<SourceFinding>,
}

/// A source that was added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LoadedSource {
    /// Whether the source is new; otherwise it was replaced.
    pub is_new: bool,
    /// The findings in the order of the file.
    pub findings: Vec<SourceFinding>,
}

impl KnowledgeRequests {
    /// Maximum number of rows of a result, after which it is truncated.
    pub const MOST_ROWS: usize = 10_000;
    /// Number of bytes after which a result is truncated.
    pub const MOST_BYTES: usize = 1 << 20;

    /// Creates the requests, which share the places of `queries`.
    #[must_use]
    pub fn new(queries: Queries, writes: &Writes) -> Self {
        Self {
            queries,
            now: writes.now,
            files: Arc::clone(&writes.files),
        }
    }

    /// Answers a query. Dropping the future stops the query.
    ///
    /// # Errors
    /// The reason why there is no result.
    pub async fn query(&self, query: QueryRequest<'_>) -> Result<WrittenResult, KnowledgeRefusal> {
        let accepted = match query.format.trim() {
            "" => Vec::new(),
            format => vec![format.to_ascii_lowercase()],
        };
        let rows = match query.rows {
            0 => Self::MOST_ROWS,
            rows => rows.min(Self::MOST_ROWS),
        };
        let cut = ResultCut {
            rows,
            bytes: Self::MOST_BYTES,
        };
        let asked = QueryOrQuestion::Cut(query.text.to_owned(), Formats::of(&accepted), cut);
        let mut hasher = DefaultHasher::new();
        query.user.hash(&mut hasher);
        match self.queries.run(asked, Lane::User(hasher.finish())).await? {
            BoundedResults::Written(written) => Ok(written),
            BoundedResults::Answer(_) | BoundedResults::Updated(_) => {
                Err(QueryFault::NotAQuery.into())
            }
        }
    }

    /// Runs an update as one change. Returns the number of changed statements.
    ///
    /// # Errors
    /// The reason why nothing was changed.
    pub async fn update(&self, text: String) -> Result<usize, KnowledgeRefusal> {
        let asked = QueryOrQuestion::Update(text, (self.now)());
        match self.queries.run(asked, Lane::Write).await? {
            BoundedResults::Updated(done) => Ok(done.changed),
            BoundedResults::Answer(_) | BoundedResults::Written(_) => {
                Err(QueryFault::ReadOnly.into())
            }
        }
    }

    /// Adds or replaces a source as its file. A load goes on after its client has left.
    ///
    /// # Errors
    /// The first reason why nothing was changed, with all findings.
    pub async fn load(
        &self,
        (kind, name): (&str, &str),
        contents: Vec<u8>,
    ) -> Result<LoadedSource, KnowledgeRefusal> {
        let Some((kind, name)) = file_source(kind, name) else {
            let shown: String = kind.chars().take(SHOWN).collect();
            let why = format!(
                "the source has the kind `{shown}` and a name of {} bytes: the kinds are nodeset, mtp, \
                 file, process and product, and a name has 1 to 256 bytes",
                name.len()
            );
            return Err(KnowledgeRefusal::new("unknown", why));
        };
        let failed = |error: &dyn fmt::Display| KnowledgeRefusal::new("failed", error.to_string());
        let place = reading_place(kind).await.map_err(|error| failed(&error))?;
        let files = Arc::clone(&self.files);
        let done = tokio::task::spawn_blocking(move || {
            let _place = place;
            let checked = files.check(kind, &name, &contents);
            let put = checked.accepted.then(|| files.put(kind, &name, &contents));
            (put, checked.findings)
        });
        let (put, findings) = done.await.map_err(|error| failed(&error))?;
        match put {
            Some(Ok(is_new)) => Ok(LoadedSource { is_new, findings }),
            Some(Err(why)) => Err(KnowledgeRefusal {
                findings,
                ..KnowledgeRefusal::new("source", why)
            }),
            None => {
                let first = findings.iter().find(|found| found.refused);
                let (message, line) = first
                    .map(|found| (found.what.clone(), found.line))
                    .unwrap_or_default();
                Err(KnowledgeRefusal {
                    code: "source",
                    message,
                    line,
                    findings,
                })
            }
        }
    }
}

impl KnowledgeRefusal {
    fn new(code: &'static str, message: String) -> Self {
        Self {
            code,
            line: line_of(&message),
            message,
            findings: Vec::new(),
        }
    }
}

impl From<QueryFault> for KnowledgeRefusal {
    fn from(fault: QueryFault) -> Self {
        Self::new(fault.code(), fault.to_string())
    }
}

/// Returns the line that a message names: `line 7` of files, `error at 7:15` of SPARQL.
#[must_use]
pub fn line_of(message: &str) -> Option<usize> {
    let number_behind = |before: &str| {
        let (_, rest) = message.split_once(before)?;
        let end = rest.find(|c: char| !c.is_ascii_digit());
        rest.get(..end.unwrap_or(rest.len()))?.parse().ok()
    };
    number_behind("line ").or_else(|| number_behind("error at "))
}

/// Number of characters of a wrong kind that a message shows.
const SHOWN: usize = 40;

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::source::{KnowledgeSource, SourceKind};
    use crate::{JobRunner, Knowledge, QueryLimits, SourceCheck};

    /// Turtle files, of which those without a dot are refused.
    #[derive(Default)]
    struct Files(Mutex<Vec<String>>);

    impl SourceFiles for Files {
        fn put(&self, kind: SourceKind, name: &str, _: &[u8]) -> Result<bool, String> {
            let mut all = self.0.lock().unwrap();
            let named = format!("{kind} {name}");
            let is_new = !all.contains(&named);
            all.push(named);
            Ok(is_new)
        }

        fn check(&self, _: SourceKind, _: &str, contents: &[u8]) -> SourceCheck {
            let accepted = contents.ends_with(b".");
            SourceCheck {
                accepted,
                replaces: false,
                findings: vec![SourceFinding {
                    line: Some(4),
                    what: "line 4: there is no dot".to_owned(),
                    refused: !accepted,
                }],
            }
        }

        fn remove(&self, _: SourceKind, _: &str) -> Result<bool, String> {
            Ok(false)
        }

        fn list(&self) -> serde_json::Value {
            serde_json::Value::Null
        }
    }

    impl JobRunner for Files {
        fn start(&self, _: &str) -> Result<Option<u64>, String> {
            Ok(None)
        }

        fn stop(&self, _: u64) -> bool {
            false
        }

        fn list(&self) -> serde_json::Value {
            serde_json::Value::Null
        }
    }

    fn requests(statements: usize) -> KnowledgeRequests {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let text: String = (0..statements)
            .map(|number| format!("<urn:s> <urn:p> \"{number:0100}\" .\n"))
            .collect();
        let source = KnowledgeSource::new(SourceKind::File, "many");
        knowledge.replace_turtle(&source, &text, 1).unwrap();
        let writes = Writes {
            now: || 9,
            may_read: Arc::new(|_| Box::pin(async { true })),
            may: Arc::new(|_| Box::pin(async { true })),
            may_run: Arc::new(|_| Box::pin(async { true })),
            files: Arc::new(Files::default()),
            jobs: Arc::new(Files::default()),
        };
        KnowledgeRequests::new(Queries::new(knowledge, QueryLimits::default()), &writes)
    }

    async fn query(
        requests: &KnowledgeRequests,
        text: &str,
        (format, rows): (&str, usize),
    ) -> Result<WrittenResult, KnowledgeRefusal> {
        let user = "anna";
        let request = QueryRequest {
            text,
            format,
            rows,
            user,
        };
        requests.query(request).await
    }

    #[tokio::test]
    async fn a_result_ends_at_its_rows_and_bytes_and_says_so() {
        let requests = requests(12_000);
        let all = "SELECT ?o { ?s <urn:p> ?o }";
        for (text, format, rows, expected, is_truncated) in [
            (all, "text/csv", 3, 3, true),
            (
                "SELECT ?o { ?s <urn:p> ?o } LIMIT 3",
                "text/csv",
                3,
                3,
                false,
            ),
            (
                "CONSTRUCT { ?s <urn:q> ?o } { ?s <urn:p> ?o }",
                "",
                5,
                5,
                true,
            ),
            ("ASK { ?s <urn:p> ?o }", "", 0, 1, false),
        ] {
            let result = query(&requests, text, (format, rows)).await.unwrap();
            assert_eq!(
                (result.rows, result.is_truncated),
                (expected, is_truncated),
                "{text}"
            );
        }
        let csv = query(&requests, all, ("text/csv", 2)).await.unwrap();
        assert_eq!(String::from_utf8(csv.bytes).unwrap().lines().count(), 3);
        // JSON has more bytes for each row: the bytes end the result, which is whole nevertheless.
        let json = query(&requests, all, ("", 0)).await.unwrap();
        assert!(json.is_truncated && json.rows < KnowledgeRequests::MOST_ROWS);
        assert!(json.bytes.len() < KnowledgeRequests::MOST_BYTES + 1_000);
        let read: serde_json::Value = serde_json::from_slice(&json.bytes).unwrap();
        let rows = read["results"]["bindings"].as_array().map(Vec::len);
        assert_eq!(rows, Some(json.rows));
    }

    #[tokio::test]
    async fn a_fault_has_a_code_and_the_line_of_the_input() {
        let requests = requests(1);
        let wrong = "SELECT ?o {\n ?s <urn:p> ?o\n";
        let fault = query(&requests, wrong, ("", 0)).await.unwrap_err();
        assert_eq!((fault.code, fault.line), ("malformed", Some(3)), "{fault}");
        let format = query(&requests, "ASK {}", ("image/png", 0)).await;
        assert_eq!(format.unwrap_err().code, "not_acceptable");
        let update = query(&requests, "CLEAR ALL", ("", 0)).await;
        assert_eq!(update.unwrap_err().code, "not_a_query");
        let wrong = "INSERT DATA {\n<urn:a> <urn:b> }".to_owned();
        let fault = requests.update(wrong).await.unwrap_err();
        assert_eq!((fault.code, fault.line), ("malformed", Some(2)), "{fault}");
        let made = "INSERT DATA { <urn:a> <urn:b> 1 }".to_owned();
        assert_eq!(requests.update(made).await, Ok(1));
    }

    #[tokio::test]
    async fn a_source_is_loaded_only_if_it_is_accepted() {
        let requests = requests(1);
        let load = |kind, name, text: &str| requests.load((kind, name), text.as_bytes().to_vec());
        let fault = load("file", "a.ttl", "<a>").await.unwrap_err();
        assert_eq!((fault.code, fault.line), ("source", Some(4)));
        assert_eq!(fault.findings.len(), 1);
        let first = load("file", "a.ttl", "<a> .").await.unwrap();
        assert!(first.is_new && first.findings.len() == 1);
        assert!(!load("file", "a.ttl", "<a> .").await.unwrap().is_new);
        for (kind, name) in [("run", "a"), ("thing", "a"), ("file", "")] {
            let fault = load(kind, name, "<a> .").await.unwrap_err();
            assert_eq!(fault.code, "unknown", "{kind} {name}");
        }
    }
}
