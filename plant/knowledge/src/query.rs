//! Any query, within limits of time, memory, size and number.
//!
//! Each query has a thread of its own, because the evaluator never yields, and the parser needs a
//! stack for nesting. A query beyond its time limit is cancelled and reported as such; it counts as
//! running until its thread has ended. `lanes` decides which queries run.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use oxigraph::io::{RdfFormat, RdfSerializer};
use oxigraph::model::{GraphName, NamedNode};
use oxigraph::sparql::results::{QueryResultsFormat, QueryResultsSerializer};
use oxigraph::sparql::{
    CancellationToken, QueryEvaluationError, QueryResults, QuerySolutionIter, QueryTripleIter,
    SparqlEvaluator,
};
use spargebra::SparqlParser;
use thiserror::Error;
use tokio::sync::{AcquireError, OwnedSemaphorePermit, Semaphore, oneshot};
use tokio::time::Instant;

use crate::bounds;
use crate::dump::DUMPS;
use crate::lanes::{Lane, Lanes, Seat};
use crate::question::{MOST_ROWS, NamedQuestion, QuestionAnswer};
use crate::store::{Knowledge, KnowledgeFault};
use crate::update::{self, Updated};
use crate::written::{Bounded, ResultCut, ResultSize, WrittenResult};

/// Limits of a query.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct QueryLimits {
    /// Time limit.
    pub time: Duration,
    /// Maximum number of concurrent queries that take longer than a moment. A client can have half
    /// of them.
    pub parallel: usize,
    /// Maximum number of rows or statements in a result.
    pub rows: usize,
    /// Maximum size of a result in bytes.
    pub bytes: usize,
    /// Maximum size of the document of a graph or of all graphs in bytes.
    pub dump: usize,
    /// Maximum size of a query in bytes.
    pub query: usize,
    /// Maximum growth of the program in bytes while queries run, of all of them together. The
    /// memory of a query alone is not known: the growth includes that of all other work.
    pub memory: u64,
}

impl Default for QueryLimits {
    fn default() -> Self {
        Self {
            time: Duration::from_secs(10),
            parallel: 4,
            rows: 100_000,
            bytes: 16 << 20,
            dump: 64 << 20,
            query: 16 << 10,
            memory: 512 << 20,
        }
    }
}

/// The dataset of a query: `default-graph-uri` and `named-graph-uri` of the SPARQL protocol. Empty
/// for all graphs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Dataset {
    /// The graphs of the default graph.
    pub(crate) default: Vec<String>,
    /// The named graphs.
    pub(crate) named: Vec<String>,
}

/// Result formats; `None` if the client does not accept that kind of result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Formats {
    /// SELECT and ASK.
    pub(crate) solutions: Option<QueryResultsFormat>,
    /// CONSTRUCT and DESCRIBE.
    pub(crate) triples: Option<RdfFormat>,
}

/// Result of a query.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum BoundedResults {
    /// Encoded result of SELECT, ASK, CONSTRUCT or DESCRIBE.
    Written(WrittenResult),
    /// Result of a named question.
    Answer(QuestionAnswer),
    /// Result of an update.
    Updated(Updated),
}

/// Error of a query.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub(crate) enum QueryFault {
    /// The text is not SPARQL.
    #[error("the query cannot be read: {0}")]
    Malformed(String),
    /// The text is an update.
    #[error(
        "this is an update: POST it to /update as application/sparql-update, or as update= in application/x-www-form-urlencoded"
    )]
    NotAQuery,
    /// Updates are not served.
    #[error("updates are not served here")]
    ReadOnly,
    /// The update reads another server.
    #[error(
        "LOAD is not run: no other server is asked from here; PUT the document to /store?graph=IRI"
    )]
    Load,
    /// The graph is read-only.
    #[error("{0}")]
    Protected(String),
    /// The change was not made.
    #[error("{0}")]
    Change(String),
    /// The query calls another server.
    #[error("SERVICE is not answered: no other server is asked from here")]
    Service,
    /// The name of a graph is not an IRI.
    #[error("`{0}` is no IRI of a graph")]
    Graph(String),
    /// The query is too long.
    #[error("the query has more than {most} bytes")]
    TooLong {
        /// The limit.
        most: usize,
    },
    /// The query would exceed time or memory.
    #[error("the query is not run: {0}")]
    TooComplex(String),
    /// The time limit has passed.
    #[error("the query took longer than {} s and was stopped; narrow it down", limit.as_secs_f64())]
    Time {
        /// The limit.
        limit: Duration,
    },
    /// The query used too much memory.
    #[error("the queries took more than {} MiB of memory, and the oldest, this one, was stopped; narrow it down", limit >> 20)]
    Memory {
        /// The limit.
        limit: u64,
    },
    /// Too many queries are running.
    #[error(
        "{0} long queries can run at a time, half of them for one client, and all are in use; ask again"
    )]
    Busy(usize),
    /// The result is too large.
    #[error("the result is larger than {rows} rows or {bytes} bytes; add a LIMIT")]
    Result {
        /// Limit of rows.
        rows: usize,
        /// Limit of bytes.
        bytes: usize,
    },
    /// The client accepts no format for this kind of result.
    #[error("no format that is accepted can hold the result of {0}")]
    NotAcceptable(&'static str),
    /// The evaluator failed.
    #[error("the query fails: {0}")]
    Failed(String),
}

/// A query or question.
#[derive(Debug, Clone)]
pub(crate) enum QueryOrQuestion {
    /// A query of a client.
    Sparql(String, Dataset, Formats),
    /// A query of a client, whose result may end early.
    Cut(String, Formats, ResultCut),
    /// A question with its parameters filled in, for an answer in plain JSON.
    Question(NamedQuestion, String),
    /// An update at a time in milliseconds since 1970.
    Update(String, u64),
}

impl QueryFault {
    /// Returns the code of the fault for clients.
    pub(crate) const fn code(&self) -> &'static str {
        match self {
            Self::Malformed(_) | Self::Graph(_) => "malformed",
            Self::NotAQuery => "not_a_query",
            Self::Service | Self::Load => "service",
            Self::ReadOnly => "read_only",
            Self::Protected(_) => "protected",
            Self::Change(_) => "storage",
            Self::TooComplex(_) => "too_complex",
            Self::TooLong { .. } => "too_large",
            Self::Time { .. } => "time_limit",
            Self::Memory { .. } => "memory_limit",
            Self::Busy(_) => "busy",
            Self::Result { .. } => "result_limit",
            Self::NotAcceptable(_) => "not_acceptable",
            Self::Failed(_) => "failed",
        }
    }
}

impl From<KnowledgeFault> for QueryFault {
    fn from(fault: KnowledgeFault) -> Self {
        match fault {
            KnowledgeFault::Protected(_) | KnowledgeFault::Derived => {
                Self::Protected(fault.to_string())
            }
            KnowledgeFault::Iri { .. }
            | KnowledgeFault::TooMany { .. }
            | KnowledgeFault::TooManySources { .. }
            | KnowledgeFault::Turtle(_)
            | KnowledgeFault::Journal(_)
            | KnowledgeFault::Store(_) => Self::Change(fault.to_string()),
        }
    }
}

/// The running queries. Clones share their places and limits.
#[derive(Debug, Clone)]
pub struct Queries {
    knowledge: Arc<Knowledge>,
    limits: QueryLimits,
    lanes: Arc<Lanes>,
    /// The places of dumps.
    dumps: Arc<Semaphore>,
}

impl Queries {
    /// Creates the places for queries on `knowledge`.
    #[must_use]
    pub fn new(knowledge: Arc<Knowledge>, limits: QueryLimits) -> Self {
        Self {
            knowledge,
            limits,
            lanes: Lanes::new(limits.parallel),
            dumps: Arc::new(Semaphore::new(DUMPS)),
        }
    }

    pub(crate) fn limits(&self) -> QueryLimits {
        self.limits
    }

    pub(crate) fn knowledge(&self) -> &Arc<Knowledge> {
        &self.knowledge
    }

    /// Waits for a place of a dump.
    pub(crate) async fn dump_place(&self) -> Result<OwnedSemaphorePermit, AcquireError> {
        Arc::clone(&self.dumps).acquire_owned().await
    }

    /// Waits for a place of work that is no query.
    ///
    /// # Errors
    /// [`QueryFault::Busy`] if there is none in time.
    pub(crate) async fn place(&self, lane: Lane) -> Result<Seat, QueryFault> {
        self.lanes.enter(lane, "", resident()).await
    }

    /// Runs a query. Dropping the future stops the query.
    pub(crate) async fn run(
        &self,
        asked: QueryOrQuestion,
        lane: Lane,
    ) -> Result<BoundedResults, QueryFault> {
        let mut limits = self.limits;
        if let QueryOrQuestion::Cut(.., cut) = &asked {
            // The last row fits, unless it is larger than all others together.
            limits.bytes = limits.bytes.min(cut.bytes.saturating_mul(2));
        }
        let text = match &asked {
            QueryOrQuestion::Sparql(query, ..) | QueryOrQuestion::Cut(query, ..)
                if query.len() > limits.query =>
            {
                return Err(QueryFault::TooLong { most: limits.query });
            }
            QueryOrQuestion::Update(text, _) if text.len() > LARGEST_UPDATE => {
                return Err(QueryFault::TooLong {
                    most: LARGEST_UPDATE,
                });
            }
            QueryOrQuestion::Sparql(text, ..)
            | QueryOrQuestion::Cut(text, ..)
            | QueryOrQuestion::Question(_, text)
            | QueryOrQuestion::Update(text, _) => text.clone(),
        };
        let seat = self.lanes.enter(lane, &text, resident()).await?;
        let watch = self.lanes.watch(&seat);
        let (tell, mut told) = oneshot::channel();
        let token = CancellationToken::new();
        let running = Stopping(token.clone());
        let work = Work {
            knowledge: Arc::clone(&self.knowledge),
            asked,
            limits,
            token,
        };
        let thread = std::thread::Builder::new()
            .name("sparql".to_owned())
            .stack_size(STACK);
        let started = thread.spawn(move || {
            let _seat = seat;
            // The receiver may have been dropped.
            let _told = tell.send(work.run());
        });
        if started.is_err() {
            return Err(QueryFault::Busy(limits.parallel));
        }
        let begin = Instant::now();
        let mut looks = tokio::time::interval(LOOK);
        let over = tokio::time::sleep(limits.time);
        tokio::pin!(over);
        let fault = loop {
            tokio::select! {
                result = &mut told => {
                    watch.ended(&text, begin.elapsed());
                    return result.unwrap_or_else(|_gone| Err(QueryFault::Failed("its thread ended".to_owned())));
                }
                () = &mut over => break QueryFault::Time { limit: limits.time },
                _ = looks.tick() => {
                    if watch.exceeds(resident(), limits.memory) {
                        break QueryFault::Memory { limit: limits.memory };
                    }
                    if let Err(fault) = watch.lengthen(begin.elapsed()) {
                        break fault;
                    }
                }
            }
        };
        drop(running);
        watch.stopped();
        if lane == Lane::Write {
            // The update may have been made in the last moment.
            if let Ok(Ok(done)) = told.await {
                return Ok(done);
            }
        }
        Err(fault)
    }
}

/// Stops the query when its future is dropped.
struct Stopping(CancellationToken);

impl Drop for Stopping {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// Parses a query. An update is a fault of its own.
pub(crate) fn parsed(text: &str) -> Result<spargebra::Query, QueryFault> {
    match SparqlParser::new().parse_query(text) {
        Ok(query) => Ok(query),
        Err(_)
            if SparqlParser::new()
                .parse_update(text)
                .is_ok_and(|update| !update.operations.is_empty()) =>
        {
            Err(QueryFault::NotAQuery)
        }
        Err(error) => Err(QueryFault::Malformed(error.to_string())),
    }
}

struct Work {
    knowledge: Arc<Knowledge>,
    asked: QueryOrQuestion,
    limits: QueryLimits,
    token: CancellationToken,
}

impl Work {
    fn run(self) -> Result<BoundedResults, QueryFault> {
        let evaluator = SparqlEvaluator::new().with_cancellation_token(self.token.clone());
        let (text, dataset) = match &self.asked {
            QueryOrQuestion::Sparql(text, dataset, _) => (text, dataset.clone()),
            QueryOrQuestion::Question(_, text) | QueryOrQuestion::Cut(text, ..) => {
                (text, Dataset::default())
            }
            QueryOrQuestion::Update(text, at) => {
                let update = update::read(text)?;
                return match self.knowledge.update(&update, &self.token, *at) {
                    Err(QueryFault::Failed(_)) if self.token.is_cancelled() => {
                        let limit = self.limits.time;
                        Err(QueryFault::Time { limit })
                    }
                    updated => updated.map(BoundedResults::Updated),
                };
            }
        };
        bounds::nests(text)?;
        let query = parsed(text)?;
        bounds::check(&query)?;
        let mut prepared = evaluator.for_query(query);
        if !dataset.default.is_empty() || !dataset.named.is_empty() {
            let default = graphs(&dataset.default)?;
            let named = graphs(&dataset.named)?;
            let (default, named) = (default.into_iter(), named.into_iter());
            // The dataset of the protocol takes precedence over FROM in the query.
            prepared
                .dataset_mut()
                .set_default_graph(default.map(GraphName::from).collect());
            let named = named.map(Into::into).collect();
            prepared.dataset_mut().set_available_named_graphs(named);
        }
        let results = prepared
            .on_store(&self.knowledge.store())
            .execute()
            .map_err(|error| self.fault(&error))?;
        self.written(results)
    }

    fn written(&self, results: QueryResults<'_>) -> Result<BoundedResults, QueryFault> {
        let (formats, cut) = match &self.asked {
            QueryOrQuestion::Question(question, _) => return self.answer(*question, results),
            QueryOrQuestion::Sparql(.., formats) => (formats, None),
            QueryOrQuestion::Cut(_, formats, cut) => (formats, Some(*cut)),
            QueryOrQuestion::Update(..) => return Err(QueryFault::ReadOnly),
        };
        let written = match results {
            QueryResults::Solutions(solutions) => {
                let format = formats.solutions;
                let format = format.ok_or(QueryFault::NotAcceptable("SELECT"))?;
                self.solutions(solutions, format, cut)
            }
            QueryResults::Boolean(value) => {
                let format = formats.solutions.ok_or(QueryFault::NotAcceptable("ASK"))?;
                let written = QueryResultsSerializer::from_format(format)
                    .serialize_boolean_to_writer(Vec::new(), value);
                let bytes = written.map_err(|error| self.broken(&error))?;
                Ok(WrittenResult {
                    media: format.media_type(),
                    bytes,
                    rows: 1,
                    is_truncated: false,
                })
            }
            QueryResults::Graph(triples) => {
                let format = formats.triples;
                let format = format.ok_or(QueryFault::NotAcceptable("CONSTRUCT"))?;
                self.triples(triples, format, cut)
            }
        };
        written.map(BoundedResults::Written)
    }

    fn answer(
        &self,
        question: NamedQuestion,
        results: QueryResults<'_>,
    ) -> Result<BoundedResults, QueryFault> {
        let QueryResults::Solutions(solutions) = results else {
            return Err(QueryFault::Failed(format!(
                "the question `{}` is no SELECT",
                question.name
            )));
        };
        let answer = question.answer(solutions);
        let answer = answer.map_err(|error| self.fault(&error))?;
        if answer.rows.len() < MOST_ROWS {
            Ok(BoundedResults::Answer(answer))
        } else {
            Err(self.too_much())
        }
    }

    fn solutions(
        &self,
        solutions: QuerySolutionIter<'_>,
        format: QueryResultsFormat,
        cut: Option<ResultCut>,
    ) -> Result<WrittenResult, QueryFault> {
        let to = Bounded::new(self.limits.bytes);
        let mut size = ResultSize::new(self.limits, cut, &to);
        let variables = solutions.variables().to_vec();
        let mut writer = QueryResultsSerializer::from_format(format)
            .serialize_solutions_to_writer(to, variables)
            .map_err(|error| self.broken(&error))?;
        for solution in solutions {
            let solution = solution.map_err(|error| self.fault(&error))?;
            if !size.takes_another().ok_or_else(|| self.too_much())? {
                break;
            }
            writer
                .serialize(&solution)
                .map_err(|error| self.broken(&error))?;
        }
        let to = writer.finish().map_err(|error| self.broken(&error))?;
        Ok(size.written(format.media_type(), to.bytes))
    }

    fn triples(
        &self,
        triples: QueryTripleIter<'_>,
        format: RdfFormat,
        cut: Option<ResultCut>,
    ) -> Result<WrittenResult, QueryFault> {
        let to = Bounded::new(self.limits.bytes);
        let mut size = ResultSize::new(self.limits, cut, &to);
        let mut to = RdfSerializer::from_format(format).for_writer(to);
        for triple in triples {
            let triple = triple.map_err(|error| self.fault(&error))?;
            if !size.takes_another().ok_or_else(|| self.too_much())? {
                break;
            }
            to.serialize_triple(&triple)
                .map_err(|error| self.broken(&error))?;
        }
        let to = to.finish().map_err(|error| self.broken(&error))?;
        Ok(size.written(format.media_type(), to.bytes))
    }

    fn fault(&self, error: &QueryEvaluationError) -> QueryFault {
        if self.token.is_cancelled() {
            QueryFault::Time {
                limit: self.limits.time,
            }
        } else {
            QueryFault::Failed(error.to_string())
        }
    }

    fn broken(&self, error: &io::Error) -> QueryFault {
        if error.kind() == io::ErrorKind::FileTooLarge {
            self.too_much()
        } else {
            QueryFault::Failed(error.to_string())
        }
    }

    fn too_much(&self) -> QueryFault {
        QueryFault::Result {
            rows: self.limits.rows,
            bytes: self.limits.bytes,
        }
    }
}

/// Returns the memory of this program in bytes, if the system provides it.
pub(crate) fn resident() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kilobytes: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kilobytes << 10)
}

/// Period of the checks of memory and places.
const LOOK: Duration = Duration::from_millis(25);
/// Memory is allocated only for the used part.
pub(crate) const STACK: usize = 256 << 20;
/// An update may contain many statements.
pub(crate) const LARGEST_UPDATE: usize = 16 << 20;

/// Reads the IRIs of graphs.
fn graphs(names: &[String]) -> Result<Vec<NamedNode>, QueryFault> {
    let read = |name: &String| NamedNode::new(name).map_err(|_| QueryFault::Graph(name.clone()));
    names.iter().map(read).collect()
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;
    use crate::source::{KnowledgeSource, SourceKind};

    /// Queries that work on tuples without reading statements, or hold many tuples.
    const LONG: [&str; 9] = [
        "SELECT (COUNT(*) AS ?n) {?a ?b ?c . ?d ?e ?f . ?g ?h ?i}",
        "SELECT (COUNT(*) AS ?n) {{?a ?b ?c} {?d ?e ?f} {?g ?h ?i}}",
        "SELECT (MAX(?c) AS ?m) {?a ?b ?c . ?d ?e ?f . ?g ?h ?i}",
        "SELECT ?a {?a ?b ?c . ?d ?e ?f . ?g ?h ?i FILTER(?c = CONCAT(STR(?f), STR(?i), 'x'))}",
        "SELECT (COUNT(*) AS ?n) {?a ?b ?c OPTIONAL {?d ?e ?f OPTIONAL {?g ?h ?i}}}",
        "SELECT ?a {?a ?b ?c . ?d ?e ?f . ?g ?h ?i} ORDER BY ?f ?c",
        "SELECT DISTINCT ?a ?d ?g {?a ?b ?c . ?d ?e ?f . ?g ?h ?i}",
        "SELECT (COUNT(*) AS ?n) {?a (!<a:b>)* ?b . ?b (!<a:c>)* ?c . ?d (!<a:b>)* ?e}",
        "ASK {?a ?b ?c . ?d ?e ?f . ?g ?h ?i MINUS {?j ?k ?c . ?l ?m ?f FILTER(?j != ?l)} FILTER(?a = ?b)}",
    ];

    #[tokio::test]
    async fn the_thread_of_a_stopped_query_ends() {
        let knowledge = Arc::new(Knowledge::new().unwrap());
        let many: String = (0..3000)
            .map(|number| format!("<urn:s{number}> <urn:p> <urn:s{}> .\n", (number * 7) % 3000))
            .collect();
        let source = KnowledgeSource::new(SourceKind::File, "many");
        knowledge.replace_turtle(&source, &many, 5).unwrap();
        let limits = QueryLimits {
            time: Duration::from_millis(1000),
            ..QueryLimits::default()
        };
        let queries = Queries::new(knowledge, limits);
        let formats = Formats {
            solutions: Some(QueryResultsFormat::Json),
            triples: None,
        };
        for text in LONG {
            let asked = QueryOrQuestion::Sparql(text.to_owned(), Dataset::default(), formats);
            let result = queries.run(asked, Lane::Open(Ipv4Addr::LOCALHOST.into()));
            let fault = result.await.unwrap_err();
            let is_stopped = matches!(
                fault,
                QueryFault::Time { .. } | QueryFault::Memory { .. } | QueryFault::Result { .. }
            );
            assert!(is_stopped, "{text}: {fault}");
            // Without the check in each operator the thread works for minutes.
            let deadline = Instant::now() + Duration::from_secs(1);
            while queries.lanes.running() > 0 {
                assert!(Instant::now() < deadline, "its thread goes on: {text}");
                tokio::time::sleep(LOOK).await;
            }
        }
    }
}
