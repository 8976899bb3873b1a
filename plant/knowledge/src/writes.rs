//! Changes over HTTP: SPARQL 1.1 Update, the Graph Store Protocol, and sources as files.

use std::fmt;
use std::pin::Pin;
use std::sync::Arc;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, LengthLimitError, Limited};
use hyper::body::Incoming;
use hyper::header::{AUTHORIZATION, CONTENT_TYPE};
use hyper::{Method, Request, Response, StatusCode};
use oxigraph::io::RdfFormat;
use serde::Serialize;
use serde_json::json;
use tokio::sync::{AcquireError, Semaphore, SemaphorePermit};
use uri_text::unescaped;

use crate::http::{HttpRefusal, ServedSite, UPLOAD_TIME, accepted, form, json_page};
use crate::lanes::Lane;
use crate::query::{LARGEST_UPDATE, QueryFault, QueryOrQuestion};
use crate::source::{SourceKind, UNNAMED};
use crate::store::KnowledgeFault;
use crate::update::writable;

/// The changes that a server accepts.
#[derive(Clone)]
pub struct Writes {
    /// Returns the time in milliseconds since 1970.
    pub now: fn() -> u64,
    /// Returns whether a user with a password may read over a secured connection.
    pub may_read: May,
    /// Returns whether a user with a password, or a client without them, may write.
    pub may: May,
    /// Returns whether a client may start and stop jobs.
    pub may_run: May,
    /// The sources that are files of their own formats.
    pub files: Arc<dyn SourceFiles>,
    /// The jobs: runs of processes.
    pub jobs: Arc<dyn JobRunner>,
}

/// Decides whether a client may do something.
pub type May = Arc<
    dyn Fn(Option<(String, String)>) -> Pin<Box<dyn Future<Output = bool> + Send>> + Send + Sync,
>;

/// Sources that are read from files: NodeSets, manifests, Turtle and processes.
pub trait SourceFiles: Send + Sync {
    /// Adds or replaces a source. Returns whether it is new.
    ///
    /// # Errors
    /// The reason, with the line if there is one. Then nothing has changed.
    fn put(&self, kind: SourceKind, name: &str, contents: &[u8]) -> Result<bool, String>;

    /// Checks the contents of a source, and changes nothing.
    fn check(&self, kind: SourceKind, name: &str, contents: &[u8]) -> SourceCheck;

    /// Removes a source. Returns whether it existed.
    ///
    /// # Errors
    /// The reason why it stays.
    fn remove(&self, kind: SourceKind, name: &str) -> Result<bool, String>;

    /// Returns all sources and the findings about them, as JSON.
    fn list(&self) -> serde_json::Value;
}

/// The result of a check of a source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SourceCheck {
    /// Whether the source can be added.
    pub accepted: bool,
    /// Whether it would replace a source.
    pub replaces: bool,
    /// The findings in the order of the file.
    pub findings: Vec<SourceFinding>,
}

/// A finding in the contents of a source.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SourceFinding {
    /// The line, from 1, if it is known.
    pub line: Option<usize>,
    /// Description of the finding.
    pub what: String,
    /// Whether the source cannot be added because of it.
    pub refused: bool,
}

/// Runs of processes that clients start and stop.
pub trait JobRunner: Send + Sync {
    /// Starts a process. Returns the number of the job; `None` if too many jobs are running.
    ///
    /// # Errors
    /// The reason why the process cannot run.
    fn start(&self, process: &str) -> Result<Option<u64>, String>;

    /// Stops a running job, or gives back the components of a job with an unknown outcome. Returns
    /// whether there is such a job.
    fn stop(&self, number: u64) -> bool;

    /// Returns all jobs as JSON.
    fn list(&self) -> serde_json::Value;

    /// Sets the fields of the components that a product configuration in AutomationML names, or
    /// only checks them. Returns what became of each component, as JSON.
    ///
    /// # Errors
    /// The reason why the document cannot be read, or why it is not applied at the moment.
    fn configure(&self, document: Vec<u8>, checks_only: bool) -> Configuring {
        let _both = (document, checks_only);
        Box::pin(async { Err("no components are configured here".to_owned()) })
    }
}

/// The configuration of a product in progress.
pub type Configuring =
    Pin<Box<dyn Future<Output = Result<serde_json::Value, String>> + Send + 'static>>;

impl fmt::Debug for Writes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Writes").finish_non_exhaustive()
    }
}

/// The media types of updates.
pub(crate) const UPDATE: &str = "application/sparql-update";

impl ServedSite {
    /// Checks whether updates are served, and the client may write.
    async fn may_write(&self, request: &Request<Incoming>) -> Result<&Writes, HttpRefusal> {
        let writes = self.writes.as_ref().ok_or(QueryFault::ReadOnly)?;
        let why = "a change needs the name and password of a user with the role engineer";
        self.require(&writes.may, request, why).await?;
        Ok(writes)
    }

    /// Lists, starts and stops jobs: `/jobs`, `/jobs/NUMBER`.
    pub(crate) async fn jobs(
        &self,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let writes = self.writes.clone().ok_or(QueryFault::ReadOnly)?;
        let path = request.uri().path().to_owned();
        let number = path.strip_prefix("/jobs/").unwrap_or_default();
        let method = request.method().clone();
        if method == Method::GET && number.is_empty() {
            return Ok(json_page(&writes.jobs.list()));
        }
        let why = "a job needs the name and password of a user with the role operator";
        match (method, number) {
            (Method::POST, "") => {
                self.require(&writes.may_run, &request, why).await?;
                let body = self.upload(request, LARGEST_JOB).await?;
                let asked: Option<serde_json::Value> = serde_json::from_slice(&body).ok();
                let process = asked
                    .as_ref()
                    .and_then(|asked| asked.get("process")?.as_str());
                let process = process.ok_or_else(|| {
                    HttpRefusal::malformed("a job is JSON: {\"process\": \"IRI of the process\"}")
                })?;
                let (jobs, process) = (Arc::clone(&writes.jobs), process.to_owned());
                // The sequence of a goal is searched, which takes long.
                let started = tokio::task::spawn_blocking(move || jobs.start(&process)).await;
                let started = started
                    .map_err(|error| failed(&error))?
                    .map_err(HttpRefusal::unknown)?;
                let job = started.ok_or_else(|| {
                    let why = "too many jobs are running; start it when one of them has ended";
                    HttpRefusal::new(StatusCode::SERVICE_UNAVAILABLE, "busy", why)
                })?;
                let mut response = json_page(&json!({ "job": job }));
                *response.status_mut() = StatusCode::CREATED;
                Ok(response)
            }
            (Method::DELETE, number) => {
                self.require(&writes.may_run, &request, why).await?;
                if number.parse().is_ok_and(|number| writes.jobs.stop(number)) {
                    Ok(status(StatusCode::NO_CONTENT))
                } else {
                    Err(HttpRefusal::unknown("there is no such job".to_owned()))
                }
            }
            _ => Err(HttpRefusal::method(
                "GET, POST at /jobs, DELETE at /jobs/NUMBER",
            )),
        }
    }

    /// Configures the components of a product: `/configuration`, with `?check=true` for a check.
    pub(crate) async fn configure(
        &self,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let pairs = form(request.uri().query().unwrap_or_default())?;
        let writes = self.may_write(&request).await?.clone();
        if request.method() != Method::POST {
            return Err(HttpRefusal::method("POST"));
        }
        let checks_only = match pairs.as_slice() {
            [] => false,
            [(name, value)] if name == "check" && value == "true" => true,
            _ => return Err(HttpRefusal::malformed("the only parameter is check=true")),
        };
        let document = self.upload(request, LARGEST_CONFIGURATION).await?;
        let report = writes.jobs.configure(document, checks_only).await;
        let report = report.map_err(|why| HttpRefusal::malformed(&why))?;
        Ok(json_page(&report))
    }

    /// Runs an update of the SPARQL protocol.
    pub(crate) async fn update(
        &self,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        if request.method() != Method::POST {
            return Err(HttpRefusal::method("POST"));
        }
        let writes = self.may_write(&request).await?;
        let at = (writes.now)();
        let media = media(&request);
        let text = self
            .upload(request, LARGEST_UPDATE.saturating_mul(3))
            .await?;
        let text = String::from_utf8(text)
            .map_err(|_| HttpRefusal::malformed("the update is not in UTF-8"))?;
        let text = if media == UPDATE {
            text
        } else {
            let mut updates = form(&text)?.into_iter().filter(|(key, _)| key == "update");
            match (updates.next(), updates.next()) {
                (Some((_, text)), None) => text,
                _ => return Err(HttpRefusal::malformed("give one update as update=")),
            }
        };
        self.found(QueryOrQuestion::Update(text, at), Lane::Write)
            .await
    }

    /// Reads and writes a graph by the Graph Store Protocol.
    pub(crate) async fn store(
        &self,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let pairs = form(request.uri().query().unwrap_or_default())?;
        let graph = match pairs.as_slice() {
            [(key, _)] if key == "default" => UNNAMED.to_owned(),
            [(key, graph)] if key == "graph" => graph.clone(),
            _ => {
                let why = "name one graph as ?graph=IRI, or ?default for the graph without a name";
                return Err(HttpRefusal::malformed(why));
            }
        };
        if !crate::is_iri(&graph) {
            return Err(QueryFault::Graph(graph).into());
        }
        let knowledge = Arc::clone(self.queries.knowledge());
        let method = request.method().clone();
        match method {
            Method::GET | Method::HEAD => {
                let accepted = accepted(&request);
                let format = accepted
                    .iter()
                    .find_map(|media| RdfFormat::from_media_type(media))
                    .filter(|format| !format.supports_datasets())
                    .unwrap_or(RdfFormat::Turtle);
                let written = self.dumped(format.media_type(), move |to| {
                    knowledge.write_triples(&graph, format, to)
                });
                written
                    .await?
                    .ok_or_else(|| HttpRefusal::unknown("there is no such graph".to_owned()))
            }
            Method::PUT | Method::POST => {
                let at = (self.may_write(&request).await?.now)();
                let source = writable(&graph)?;
                let media = media(&request);
                let format = match media.as_str() {
                    "" => Some(RdfFormat::Turtle),
                    media => RdfFormat::from_media_type(media),
                };
                let format = format.ok_or_else(|| {
                    let why = "send text/turtle, application/n-triples or application/rdf+xml";
                    HttpRefusal::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "media_type", why)
                })?;
                let document = self.upload(request, LARGEST_FILE).await?;
                let adds = method == Method::POST;
                let taken = tokio::task::spawn_blocking(move || {
                    knowledge.take(&source, (format, &document), adds, at)
                });
                match taken.await {
                    Ok(is_new) => Ok(status(if is_new? {
                        StatusCode::CREATED
                    } else {
                        StatusCode::NO_CONTENT
                    })),
                    Err(error) => Err(failed(&error)),
                }
            }
            Method::DELETE => {
                self.may_write(&request).await?;
                if knowledge.remove(&writable(&graph)?)? {
                    Ok(status(StatusCode::NO_CONTENT))
                } else {
                    Err(HttpRefusal::unknown("there is no such graph".to_owned()))
                }
            }
            _ => Err(HttpRefusal::method("GET, HEAD, PUT, POST, DELETE")),
        }
    }

    /// Lists, adds, replaces and removes sources: `/sources`, `/sources/KIND/NAME`.
    pub(crate) async fn sources(
        &self,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let path = request.uri().path().to_owned();
        let files = self
            .writes
            .as_ref()
            .map(|writes| Arc::clone(&writes.files))
            .ok_or(QueryFault::ReadOnly)?;
        let rest = path.strip_prefix("/sources").unwrap_or_default();
        if rest.is_empty() {
            if request.method() != Method::GET {
                return Err(HttpRefusal::method("GET"));
            }
            return Ok(json_page(&files.list()));
        }
        let (kind, name) = named(rest)?;
        let method = request.method().clone();
        self.may_write(&request).await?;
        let done = match method {
            Method::PUT => {
                // A file that waits to be read takes no memory.
                let place = reading_place(kind).await.map_err(|error| failed(&error))?;
                let contents = self.upload(request, LARGEST_FILE).await?;
                let put = tokio::task::spawn_blocking(move || {
                    let _place = place;
                    files.put(kind, &name, &contents)
                });
                put.await
            }
            Method::DELETE => {
                let removed = tokio::task::spawn_blocking(move || files.remove(kind, &name)).await;
                if let Ok(Ok(false)) = removed {
                    return Err(HttpRefusal::unknown("there is no such source".to_owned()));
                }
                removed.map(|removed| removed.map(|_| false))
            }
            _ => return Err(HttpRefusal::method("PUT, DELETE")),
        };
        match done {
            Ok(Ok(true)) => Ok(status(StatusCode::CREATED)),
            Ok(Ok(false)) => Ok(status(StatusCode::NO_CONTENT)),
            Ok(Err(why)) => Err(HttpRefusal::new(StatusCode::BAD_REQUEST, "source", &why)),
            Err(error) => Err(failed(&error)),
        }
    }

    /// Checks the contents of a source: `/check/KIND/NAME`. It needs the rights of a change,
    /// because a check reads a file of any contents.
    pub(crate) async fn check(
        &self,
        request: Request<Incoming>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        if request.method() != Method::POST {
            return Err(HttpRefusal::method("POST"));
        }
        let path = request.uri().path().to_owned();
        let (kind, name) = named(path.strip_prefix("/check").unwrap_or_default())?;
        let files = Arc::clone(&self.may_write(&request).await?.files);
        let place = reading_place(kind).await.map_err(|error| failed(&error))?;
        let contents = self.upload(request, LARGEST_FILE).await?;
        // A check goes on after its client has left, and keeps its place.
        let checked = tokio::task::spawn_blocking(move || {
            let _place = place;
            files.check(kind, &name, &contents)
        });
        match checked.await {
            Ok(checked) => Ok(json_page(&json!(checked))),
            Err(error) => Err(failed(&error)),
        }
    }

    /// Reads the body of a change.
    async fn upload(
        &self,
        request: Request<Incoming>,
        most: usize,
    ) -> Result<Vec<u8>, HttpRefusal> {
        let place = UPLOADS.acquire().await;
        let _place = place.map_err(|error| failed(&error))?;
        let body = Limited::new(request.into_body(), most).collect();
        let body = tokio::time::timeout(UPLOAD_TIME, body).await;
        let body = body.map_err(|_late| {
            let why = "the request took too long to come";
            HttpRefusal::new(StatusCode::REQUEST_TIMEOUT, "slow", why)
        })?;
        match body {
            Ok(body) => Ok(body.to_bytes().into()),
            Err(error) if error.is::<LengthLimitError>() => {
                Err(QueryFault::TooLong { most }.into())
            }
            Err(_) => Err(HttpRefusal::malformed("the request broke off")),
        }
    }
}

/// Waits for a place to read a source of a kind.
pub(crate) async fn reading_place(
    kind: SourceKind,
) -> Result<SemaphorePermit<'static>, AcquireError> {
    let places = if kind == SourceKind::Product {
        &PRODUCT_READINGS
    } else {
        &READINGS
    };
    places.acquire().await
}

/// Returns the source in a path `/KIND/NAME`.
fn named(path: &str) -> Result<(SourceKind, String), HttpRefusal> {
    let named = path.trim_start_matches('/').split_once('/');
    let named = named.and_then(|(kind, name)| file_source(kind, &unescaped(name)?));
    named.ok_or_else(|| {
        let why = "a source is /sources/KIND/NAME; the kinds are nodeset, mtp, file, process \
                   and product";
        HttpRefusal::unknown(why.to_owned())
    })
}

/// Returns the kind and name of a source that is read from a file.
pub(crate) fn file_source(kind: &str, name: &str) -> Option<(SourceKind, String)> {
    let kind: SourceKind = kind.parse().ok()?;
    let is_file = matches!(
        kind,
        SourceKind::NodeSet
            | SourceKind::Mtp
            | SourceKind::File
            | SourceKind::Process
            | SourceKind::Product
    );
    let is_name = !name.is_empty() && name.len() <= LONGEST_NAME;
    (is_file && is_name).then(|| (kind, name.to_owned()))
}

/// Returns the user and the password of a request (HTTP Basic).
pub(crate) fn basic_user(request: &Request<Incoming>) -> Option<(String, String)> {
    let value = request.headers().get(AUTHORIZATION)?;
    let encoded = value.to_str().ok()?.strip_prefix("Basic ")?;
    let text = String::from_utf8(STANDARD.decode(encoded.trim()).ok()?).ok()?;
    let (name, password) = text.split_once(':')?;
    Some((name.to_owned(), password.to_owned()))
}

impl From<KnowledgeFault> for HttpRefusal {
    fn from(fault: KnowledgeFault) -> Self {
        let (status, code) = match &fault {
            KnowledgeFault::Protected(_) | KnowledgeFault::Derived => {
                (StatusCode::FORBIDDEN, "protected")
            }
            KnowledgeFault::Turtle(_) | KnowledgeFault::Iri { .. } => {
                (StatusCode::BAD_REQUEST, "malformed")
            }
            KnowledgeFault::TooMany { .. }
            | KnowledgeFault::TooManySources { .. }
            | KnowledgeFault::Journal(_) => (StatusCode::INSUFFICIENT_STORAGE, "storage"),
            KnowledgeFault::Store(_) => (StatusCode::INTERNAL_SERVER_ERROR, "failed"),
        };
        Self::new(status, code, &fault.to_string())
    }
}

/// Returns the media type of the body without parameters.
pub(crate) fn media(request: &Request<Incoming>) -> String {
    let media = request.headers().get(CONTENT_TYPE);
    let media = media.and_then(|media| media.to_str().ok());
    let media = media.and_then(|media| media.split(';').next());
    media.unwrap_or_default().trim().to_ascii_lowercase()
}

/// Describes an update for the client.
pub(crate) fn updated(changed: usize) -> Response<Full<Bytes>> {
    json_page(&json!({ "changed": changed }))
}

fn status(status: StatusCode) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::new()));
    *response.status_mut() = status;
    response
}

pub(crate) fn failed(error: &dyn fmt::Display) -> HttpRefusal {
    let status = StatusCode::INTERNAL_SERVER_ERROR;
    HttpRefusal::new(status, "failed", &error.to_string())
}

/// Concurrent uploads, each of which is in memory as a whole.
static UPLOADS: Semaphore = Semaphore::const_new(2);
/// Concurrent readings of sources except products, to check or to add them.
static READINGS: Semaphore = Semaphore::const_new(2);
/// Concurrent readings of products, which take much longer than those of other sources.
static PRODUCT_READINGS: Semaphore = Semaphore::const_new(1);
const LARGEST_FILE: usize = 256 << 20;
const LONGEST_NAME: usize = 256;
const LARGEST_JOB: usize = 4096;
/// Largest product configuration, in bytes.
const LARGEST_CONFIGURATION: usize = 4 << 20;
