//! The knowledge over HTTP: the SPARQL 1.1 protocol, named questions, the Graph Store Protocol,
//! sources as files, and the statements themselves. `writes` has the changes, `remote` the clients
//! of other hosts.

use std::convert::Infallible;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, LengthLimitError, Limited};
use hyper::body::Incoming;
use hyper::header::{ACCEPT, ALLOW, CONTENT_TYPE, HeaderValue, RETRY_AFTER, WWW_AUTHENTICATE};
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use oxigraph::io::RdfFormat;
use oxigraph::sparql::results::QueryResultsFormat;
use serde_json::json;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;
use tracing::debug;
use uri_text::unescaped;

use crate::lanes::Lane;
use crate::query::{
    BoundedResults, Dataset, Formats, Queries, QueryFault, QueryLimits, QueryOrQuestion,
};
use crate::question::{NamedQuestion, QUESTIONS, QuestionFault};
use crate::remote::{ConnectionSecurity, RemoteAccess, RemoteConnections};
use crate::sign_ins::LOCKED_FOR;
use crate::store::Knowledge;
use crate::writes::{UPDATE, Writes, failed, media, updated};

/// Additional pages by their path: JSON, or `None` for an unknown page.
pub type ExtraPages = Arc<dyn Fn(&str) -> Option<String> + Send + Sync>;

/// A listener that serves requests until it is dropped.
#[derive(Debug)]
pub struct HttpEndpoint {
    address: SocketAddr,
    task: JoinHandle<()>,
}

impl HttpEndpoint {
    /// Listens at a loopback address for queries; port 0 selects a free port.
    ///
    /// # Errors
    /// Fails if the address is in use, or is not a loopback address.
    pub async fn bind(
        address: SocketAddr,
        knowledge: Arc<Knowledge>,
        limits: QueryLimits,
        page: ExtraPages,
    ) -> io::Result<Self> {
        Self::bind_with(address, Queries::new(knowledge, limits), page, None).await
    }

    /// Listens at a loopback address for queries, and for changes if `writes` has their handlers.
    ///
    /// # Errors
    /// Fails if the address is in use, or is not a loopback address.
    pub async fn bind_with(
        address: SocketAddr,
        queries: Queries,
        page: ExtraPages,
        writes: Option<Writes>,
    ) -> io::Result<Self> {
        if !address.ip().is_loopback() {
            let why = format!(
                "{} is not on loopback, and questions are answered there only: who may ask is not checked",
                address.ip()
            );
            return Err(io::Error::new(io::ErrorKind::InvalidInput, why));
        }
        let site = ServedSite {
            queries,
            page,
            writes,
            remote: None,
        };
        Self::listen(address, site).await
    }

    /// Listens at any address for secured connections. Each request carries the name and password
    /// of a user (HTTP Basic).
    ///
    /// # Errors
    /// Fails if the address is in use.
    pub async fn bind_secured(
        address: SocketAddr,
        queries: Queries,
        page: ExtraPages,
        (writes, security): (Writes, Arc<dyn ConnectionSecurity>),
    ) -> io::Result<Self> {
        let site = ServedSite {
            queries,
            page,
            writes: Some(writes),
            remote: Some(RemoteAccess::new(security)),
        };
        Self::listen(address, site).await
    }

    async fn listen(address: SocketAddr, site: ServedSite) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let address = listener.local_addr()?;
        let task = match site.remote.clone() {
            None => tokio::spawn(accept(listener, site)),
            Some(remote) => tokio::spawn(accept_remote(listener, site, remote)),
        };
        Ok(Self { address, task })
    }

    /// Returns the address of the listener.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for HttpEndpoint {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[derive(Clone)]
pub(crate) struct ServedSite {
    pub(crate) queries: Queries,
    page: ExtraPages,
    pub(crate) writes: Option<Writes>,
    /// The access of clients of other hosts; `None` on loopback.
    pub(crate) remote: Option<RemoteAccess>,
}

async fn accept(listener: TcpListener, site: ServedSite) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        // Beyond the limit a connection waits in the listener's queue.
        let Ok(place) = Arc::clone(&places).acquire_owned().await else {
            return;
        };
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                debug!(%error, "a connection for questions was not accepted");
                tokio::time::sleep(ACCEPT_AGAIN).await;
                continue;
            }
        };
        let site = site.clone();
        tokio::spawn(async move {
            let _place = place;
            serve(stream, peer.ip(), site).await;
        });
    }
}

/// Accepts connections of clients of other hosts.
async fn accept_remote(listener: TcpListener, site: ServedSite, remote: RemoteAccess) {
    let mut open = RemoteConnections::default();
    loop {
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                debug!(%error, "a connection of another host was not accepted");
                tokio::time::sleep(ACCEPT_AGAIN).await;
                continue;
            }
        };
        if !open.make_room(peer.ip()) {
            debug!(%peer, "a connection was refused: there are too many");
            continue;
        }
        let access = remote.of_connection();
        let site = ServedSite {
            remote: Some(access.clone()),
            ..site.clone()
        };
        let security = Arc::clone(&access.security);
        let task = tokio::spawn(secured(stream, peer.ip(), (site, security)));
        open.add(peer.ip(), &access, task.abort_handle());
    }
}

/// Secures a connection, and serves it.
async fn secured(
    stream: TcpStream,
    peer: IpAddr,
    (site, security): (ServedSite, Arc<dyn ConnectionSecurity>),
) {
    match tokio::time::timeout(HEADER_TIME, security.secure(stream)).await {
        Ok(Ok(stream)) => serve(stream, peer, site).await,
        Ok(Err(error)) => debug!(%error, %peer, "a connection was not secured"),
        Err(_) => debug!(%peer, "a connection was not secured in time"),
    }
}

/// Serves a connection. At the age of [`CONNECTION_TIME`] it takes no more requests; the request
/// that is being answered then has [`LAST_REQUEST`] to end.
async fn serve<S>(stream: S, peer: IpAddr, site: ServedSite)
where
    S: AsyncRead + AsyncWrite + Send + Unpin,
{
    let service = service_fn(|request| {
        let site = site.clone();
        async move {
            Ok::<_, Infallible>(
                site.answer(request, peer)
                    .await
                    .unwrap_or_else(HttpRefusal::response),
            )
        }
    });
    let connection = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(LARGEST_BUFFER)
        .serve_connection(TokioIo::new(stream), service);
    tokio::pin!(connection);
    let mut served = tokio::time::timeout(CONNECTION_TIME, connection.as_mut()).await;
    if served.is_err() {
        connection.as_mut().graceful_shutdown();
        served = tokio::time::timeout(LAST_REQUEST, connection).await;
    }
    match served {
        Ok(Ok(())) => {}
        Ok(Err(error)) => debug!(%error, "a connection for questions broke off"),
        Err(_) => debug!("a connection for questions was closed for its age"),
    }
}

impl ServedSite {
    async fn answer(
        &self,
        request: Request<Incoming>,
        peer: IpAddr,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        self.admit(&request, peer).await?;
        let path = request.uri().path().to_owned();
        match path.as_str() {
            "/sparql" => return self.sparql(request, peer).await,
            "/update" => return self.update(request).await,
            "/store" => return self.store(request).await,
            path if path == "/sources" || path.starts_with("/sources/") => {
                return self.sources(request).await;
            }
            "/configuration" => return self.configure(request).await,
            path if path.starts_with("/check/") => return self.check(request).await,
            path if path == "/jobs" || path.starts_with("/jobs/") => {
                return self.jobs(request).await;
            }
            _ => {}
        }
        if request.method() != Method::GET {
            return Err(HttpRefusal::method("GET"));
        }
        let pairs = form(request.uri().query().unwrap_or_default())?;
        match path.as_str() {
            "/ask" => Ok(json_page(&catalogue())),
            "/graphs" => Ok(json_page(
                &json!({ "graphs": self.queries.knowledge().sources() }),
            )),
            "/data" => self.data(&pairs).await,
            "/pictures" => self.pictures(&pairs).await,
            "/report" => {
                let accepted = accepted(&request);
                let is_json = accepted.first().is_some_and(|media| media == JSON);
                self.report(is_json, peer).await
            }
            path => match (path.strip_prefix("/ask/"), path.strip_prefix("/picture/")) {
                (Some(name), _) => self.question(name, pairs, accepted(&request)).await,
                (None, Some(iri)) => self.picture(iri).await,
                (None, None) => match self.made_page(path).await? {
                    Some(page) => Ok(content(JSON, page.into_bytes())),
                    None => Err(HttpRefusal::unknown(
                        "there are /sparql, /update, /store, /sources, /check, /configuration, /jobs, /ask, /ask/NAME, /graphs, /data, /pictures, /picture/IRI, /report and /status here"
                            .to_owned(),
                    )),
                },
            },
        }
    }

    /// Returns an additional page. All but the status may plan a process, which takes long.
    async fn made_page(&self, path: &str) -> Result<Option<String>, HttpRefusal> {
        let place = if path == STATUS {
            None
        } else {
            let place = self.queries.place(Lane::Plan).await;
            Some(place.map_err(|_busy| {
                let why = "other plans are being made; ask again";
                HttpRefusal::new(StatusCode::SERVICE_UNAVAILABLE, "busy", why)
            })?)
        };
        let (page, path) = (Arc::clone(&self.page), path.to_owned());
        // A plan is completed after its client has left, and keeps its place.
        let made = tokio::task::spawn_blocking(move || {
            let _place = place;
            page(&path)
        });
        made.await.map_err(|error| failed(&error))
    }

    async fn sparql(
        &self,
        request: Request<Incoming>,
        peer: IpAddr,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        if request.method() == Method::POST && media(&request) == UPDATE {
            return self.update(request).await;
        }
        let formats = Formats::of(&accepted(&request));
        let mut pairs = form(request.uri().query().unwrap_or_default())?;
        if request.method() == Method::POST {
            let media = media(&request);
            let most = self.queries.limits().query;
            match media.as_str() {
                "application/sparql-query" => {
                    pairs.push(("query".to_owned(), body(request, most).await?))
                }
                // Three bytes for each escaped byte.
                "application/x-www-form-urlencoded" => {
                    pairs.extend(form(&body(request, most.saturating_mul(3)).await?)?)
                }
                _ => {
                    let message = "a query is POSTed as application/sparql-query, or as query= in application/x-www-form-urlencoded";
                    return Err(HttpRefusal::new(
                        StatusCode::UNSUPPORTED_MEDIA_TYPE,
                        "media_type",
                        message,
                    ));
                }
            }
        } else if request.method() != Method::GET {
            return Err(HttpRefusal::method("GET, POST"));
        }
        let mut query = None;
        let mut dataset = Dataset::default();
        for (key, value) in pairs {
            match key.as_str() {
                "query" if query.is_some() => {
                    return Err(HttpRefusal::malformed(
                        "there are two queries, and one is answered",
                    ));
                }
                "query" => query = Some(value),
                "default-graph-uri" => dataset.default.push(value),
                "named-graph-uri" => dataset.named.push(value),
                "update" => return Err(QueryFault::NotAQuery.into()),
                _ => {}
            }
        }
        if dataset.default.len() + dataset.named.len() > MAX_GRAPHS {
            return Err(HttpRefusal::malformed("there are too many graphs"));
        }
        let query =
            query.ok_or_else(|| HttpRefusal::malformed("there is no query: give it as query="))?;
        self.found(
            QueryOrQuestion::Sparql(query, dataset, formats),
            Lane::Open(peer),
        )
        .await
    }

    async fn question(
        &self,
        name: &str,
        pairs: Vec<(String, String)>,
        accepted: Vec<String>,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        if let Some(name) = name.strip_suffix(".rq") {
            return Ok(content(
                "application/sparql-query",
                NamedQuestion::of(name)?.sparql.as_bytes().to_vec(),
            ));
        }
        let question = NamedQuestion::of(name)?;
        let sparql = question.with(&pairs)?;
        let formats = Formats::of(&accepted);
        // The first accepted of the two formats.
        let wanted = accepted
            .iter()
            .find(|media| QueryResultsFormat::from_media_type(media).is_some());
        let is_standard = wanted.is_some_and(|media| media != JSON);
        let asked = if is_standard {
            QueryOrQuestion::Sparql(sparql, Dataset::default(), formats)
        } else {
            QueryOrQuestion::Question(question, sparql)
        };
        self.found(asked, Lane::Named).await
    }

    pub(crate) async fn found(
        &self,
        asked: QueryOrQuestion,
        lane: Lane,
    ) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        match self.queries.run(asked, lane).await? {
            BoundedResults::Written(written) => Ok(content(written.media, written.bytes)),
            BoundedResults::Answer(answer) => Ok(json_page(&json!(answer))),
            BoundedResults::Updated(done) => Ok(updated(done.changed)),
        }
    }

    /// Returns all graphs, or one of them.
    async fn data(&self, pairs: &[(String, String)]) -> Result<Response<Full<Bytes>>, HttpRefusal> {
        let graph = pairs.iter().find(|(key, _)| key == "graph");
        let graph = graph.map(|(_, graph)| graph.clone());
        let knowledge = Arc::clone(self.queries.knowledge());
        let written = self.dumped("application/n-quads", move |to| {
            knowledge.write_quads(graph.as_deref(), to)
        });
        written.await?.ok_or_else(|| {
            let why = "there is no such graph; /graphs has those there are";
            HttpRefusal::unknown(why.to_owned())
        })
    }
}

impl Formats {
    /// Selects the first accepted format of each kind; JSON and N-Triples if all formats are
    /// accepted.
    pub(crate) fn of(accepted: &[String]) -> Self {
        let is_any = accepted.is_empty()
            || accepted
                .iter()
                .any(|media| matches!(media.as_str(), "*/*" | "application/*"));
        let solutions = accepted
            .iter()
            .find_map(|media| QueryResultsFormat::from_media_type(media));
        let triples = accepted
            .iter()
            .find_map(|media| RdfFormat::from_media_type(media));
        Self {
            solutions: solutions.or_else(|| is_any.then_some(QueryResultsFormat::Json)),
            triples: triples.or_else(|| is_any.then_some(RdfFormat::NTriples)),
        }
    }
}

/// Reason for refusing a request.
#[derive(Debug)]
pub(crate) struct HttpRefusal {
    status: StatusCode,
    code: &'static str,
    message: String,
    allow: Option<&'static str>,
}

impl HttpRefusal {
    pub(crate) fn new(status: StatusCode, code: &'static str, message: &str) -> Self {
        Self {
            status,
            code,
            message: message.to_owned(),
            allow: None,
        }
    }

    pub(crate) fn malformed(message: &str) -> Self {
        Self::new(StatusCode::BAD_REQUEST, "malformed", message)
    }

    pub(crate) fn unknown(message: String) -> Self {
        Self::new(StatusCode::NOT_FOUND, "unknown", &message)
    }

    pub(crate) fn method(allowed: &'static str) -> Self {
        let message = format!("this is asked for by {allowed}");
        Self {
            allow: Some(allowed),
            ..Self::new(StatusCode::METHOD_NOT_ALLOWED, "method", &message)
        }
    }

    fn response(self) -> Response<Full<Bytes>> {
        let page = json!({ "error": self.code, "message": self.message });
        let mut response = json_page(&page);
        *response.status_mut() = self.status;
        if let Some(allow) = self.allow {
            response
                .headers_mut()
                .insert(ALLOW, HeaderValue::from_static(allow));
        }
        if self.status == StatusCode::UNAUTHORIZED {
            response.headers_mut().insert(
                WWW_AUTHENTICATE,
                HeaderValue::from_static("Basic realm=\"ua-mes\""),
            );
        }
        if self.status == StatusCode::SERVICE_UNAVAILABLE {
            response
                .headers_mut()
                .insert(RETRY_AFTER, HeaderValue::from_static("1"));
        }
        if self.status == StatusCode::TOO_MANY_REQUESTS {
            let seconds = HeaderValue::from(LOCKED_FOR.as_secs());
            response.headers_mut().insert(RETRY_AFTER, seconds);
        }
        response
    }
}

impl From<QueryFault> for HttpRefusal {
    fn from(fault: QueryFault) -> Self {
        let status = match &fault {
            QueryFault::Malformed(_)
            | QueryFault::Graph(_)
            | QueryFault::NotAQuery
            | QueryFault::Service
            | QueryFault::Load
            | QueryFault::TooComplex(_) => StatusCode::BAD_REQUEST,
            QueryFault::ReadOnly | QueryFault::Protected(_) => StatusCode::FORBIDDEN,
            QueryFault::Change(_) | QueryFault::Memory { .. } | QueryFault::Result { .. } => {
                StatusCode::INSUFFICIENT_STORAGE
            }
            QueryFault::TooLong { .. } => StatusCode::PAYLOAD_TOO_LARGE,
            QueryFault::Time { .. } | QueryFault::Busy(_) => StatusCode::SERVICE_UNAVAILABLE,
            QueryFault::NotAcceptable(_) => StatusCode::NOT_ACCEPTABLE,
            QueryFault::Failed(_) => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self::new(status, fault.code(), &fault.to_string())
    }
}

impl From<QuestionFault> for HttpRefusal {
    fn from(fault: QuestionFault) -> Self {
        match &fault {
            QuestionFault::Unknown { .. } => Self::unknown(fault.to_string()),
            QuestionFault::Parameter { .. } | QuestionFault::Iri { .. } => {
                Self::malformed(&fault.to_string())
            }
            QuestionFault::Sparql { .. } => Self::new(
                StatusCode::INTERNAL_SERVER_ERROR,
                "failed",
                &fault.to_string(),
            ),
        }
    }
}

/// Returns the accepted media types in order, without refused types (q=0).
pub(crate) fn accepted(request: &Request<Incoming>) -> Vec<String> {
    let all = request
        .headers()
        .get_all(ACCEPT)
        .iter()
        .filter_map(|accept| accept.to_str().ok());
    let ranges = all.flat_map(|accept| accept.split(',')).take(MAX_MEDIA);
    ranges
        .filter(|range| {
            !range
                .split(';')
                .skip(1)
                .any(|parameter| matches!(parameter.trim(), "q=0" | "q=0.0"))
        })
        .filter_map(|range| range.split(';').next())
        .map(|media| media.trim().to_ascii_lowercase())
        .filter(|media| !media.is_empty())
        .collect()
}

async fn body(request: Request<Incoming>, most: usize) -> Result<String, HttpRefusal> {
    let body = tokio::time::timeout(BODY_TIME, Limited::new(request.into_body(), most).collect());
    let body = body.await.map_err(|_late| {
        HttpRefusal::new(
            StatusCode::REQUEST_TIMEOUT,
            "slow",
            "the request took too long to come",
        )
    })?;
    let bytes = match body {
        Ok(body) => body.to_bytes(),
        Err(error) if error.is::<LengthLimitError>() => {
            return Err(QueryFault::TooLong { most }.into());
        }
        Err(_) => return Err(HttpRefusal::malformed("the request broke off")),
    };
    String::from_utf8(bytes.into())
        .map_err(|_| HttpRefusal::malformed("the request is not in UTF-8"))
}

/// Returns the pairs of a form or of the query of a URL.
pub(crate) fn form(text: &str) -> Result<Vec<(String, String)>, HttpRefusal> {
    let pairs: Vec<&str> = text.split('&').filter(|pair| !pair.is_empty()).collect();
    if pairs.len() > MAX_PAIRS {
        return Err(HttpRefusal::malformed("there are too many parameters"));
    }
    let pair = |pair: &&str| {
        let (key, value) = pair.split_once('=').unwrap_or((pair, ""));
        Some((unescaped(key)?, unescaped(value)?))
    };
    let pairs: Option<Vec<_>> = pairs.iter().map(pair).collect();
    pairs.ok_or_else(|| HttpRefusal::malformed("a parameter is not escaped as %XX of UTF-8"))
}

/// Returns all questions with their parameters.
fn catalogue() -> serde_json::Value {
    let questions = QUESTIONS.iter().map(|question| {
        json!({
            "name": question.name,
            "about": question.about(),
            "parameters": question.parameters().collect::<Vec<_>>(),
            "lists": question.lists().collect::<Vec<_>>(),
        })
    });
    json!({ "questions": questions.collect::<Vec<_>>() })
}

pub(crate) fn json_page(page: &serde_json::Value) -> Response<Full<Bytes>> {
    let mut text = page.to_string();
    text.push('\n');
    content(JSON, text.into_bytes())
}

pub(crate) fn content(media: &'static str, bytes: Vec<u8>) -> Response<Full<Bytes>> {
    content_of(media, bytes.into())
}

pub(crate) fn content_of(media: &'static str, bytes: Bytes) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(bytes));
    response
        .headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static(media));
    response
}

const JSON: &str = "application/json";
/// The additional page that is made at once.
const STATUS: &str = "/status";
const MAX_CONNECTIONS: usize = 256;
const MAX_PAIRS: usize = 256;
const MAX_GRAPHS: usize = 100;
const MAX_MEDIA: usize = 32;
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
const HEADER_TIME: Duration = Duration::from_secs(5);
const BODY_TIME: Duration = Duration::from_secs(5);
/// Time for the body of a change.
pub(crate) const UPLOAD_TIME: Duration = Duration::from_secs(45);
/// Age at which a connection takes no further requests.
const CONNECTION_TIME: Duration = Duration::from_secs(60);
/// Time limit of the last request of a connection: its upload, the wait for a place, and the
/// reading of a source.
const LAST_REQUEST: Duration = Duration::from_secs(90);
/// Largest head of a request, in bytes.
const LARGEST_BUFFER: usize = 64 << 10;
