//! The knowledge of the plant, which `ua-mes` keeps: queries, named questions, the plans of
//! processes, the pictures of modules, and sources as files.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_client::header::{ACCEPT, AUTHORIZATION, CONTENT_TYPE, HeaderValue};
use http_client::{
    HttpError, HttpLimits, Method, Request, RequestError, Response, StatusCode, basic_authorization,
};
use hyper::header::InvalidHeaderValue;
use hyper::http::uri::InvalidUri;
use serde::Deserialize;
use serde_json::Value;
use thiserror::Error;
use tokio::sync::Semaphore;
use uri_text::escaped;

use crate::fetch::StatusUrl;
use crate::table;

/// The program `ua-mes` at its address for queries.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct MesClient(StatusUrl);

/// The requests that are passed on at the same time; each has its result or file in memory.
#[derive(Debug)]
pub(crate) struct RequestSlots {
    pub(crate) queries: Semaphore,
    pub(crate) files: Arc<Semaphore>,
}

impl Default for RequestSlots {
    fn default() -> Self {
        Self {
            queries: Semaphore::new(4),
            files: Arc::new(Semaphore::new(2)),
        }
    }
}

/// A file for the knowledge of the plant.
#[derive(Debug, Clone)]
pub(crate) struct SourceFile {
    /// The kind of source, see [`source_kind`].
    pub(crate) kind: &'static str,
    /// The name of the source.
    pub(crate) name: String,
    pub(crate) contents: Bytes,
}

/// The name and password of a user of `ua-mes`.
#[derive(Clone)]
pub(crate) struct MesCredentials {
    pub(crate) user: String,
    pub(crate) password: String,
}

/// The reason why `ua-mes` has not executed a request.
#[derive(Debug, Error)]
pub(crate) enum MesFault {
    /// There is no response.
    #[error("ua-mes does not answer: {0}")]
    Request(#[source] RequestError),
    /// The response is too large, or ended early.
    #[error("the response of ua-mes has more than {} MiB, or ended early: a query may need a LIMIT", LARGEST_RESULT >> 20)]
    TooLarge,
    /// `ua-mes` has refused the request.
    #[error("{message}")]
    Refused {
        /// The status of the response.
        status: StatusCode,
        /// The reason in words.
        message: String,
    },
    /// The response is not as expected.
    #[error("cannot read the response of ua-mes: {0}")]
    Unreadable(String),
    /// The request is no valid request of HTTP.
    #[error("cannot send the request to ua-mes: {0}")]
    Uri(#[from] InvalidUri),
    /// The user has a name or password that no header holds.
    #[error("cannot send the request to ua-mes: {0}")]
    Header(#[from] InvalidHeaderValue),
}

/// The body of a refusal.
#[derive(Deserialize)]
struct Refusal {
    message: String,
}

impl MesClient {
    pub(crate) const fn new(at: StatusUrl) -> Self {
        Self(at)
    }

    /// Returns whether `ua-mes` has sent a status.
    pub(crate) fn is_status(status: &Value) -> bool {
        status.get("processes").is_some()
    }

    /// Returns the host of the address.
    pub(crate) fn authority(&self) -> &str {
        self.0.authority()
    }

    /// Returns the named questions with their parameters.
    pub(crate) async fn questions(&self) -> Result<Value, MesFault> {
        json(&self.send(get("/ask")?, LIMIT).await?)
    }

    /// Returns the plan of a process, with the reason for each choice.
    pub(crate) async fn plan(&self, process: &str) -> Result<Value, MesFault> {
        let path = format!("/plan/{}", escaped(process));
        json(&self.send(get(&path)?, LIMIT).await?)
    }

    /// Returns the pictures of modules, with their names.
    pub(crate) async fn pictures(&self) -> Result<Value, MesFault> {
        json(&self.send(get("/pictures")?, LIMIT).await?)
    }

    /// Returns the drawing of a picture as SVG.
    pub(crate) async fn picture(&self, picture: &str) -> Result<Bytes, MesFault> {
        let path = format!("/picture/{}", escaped(picture));
        let response = self.send(get(&path)?, LIMIT).await?;
        let media = response.headers().get(CONTENT_TYPE);
        if media.is_none_or(|media| media != SVG) {
            let why = format!("it is no drawing of the type {SVG}");
            return Err(MesFault::Unreadable(why));
        }
        Ok(response.into_body())
    }

    /// Answers a query of SPARQL as a table.
    pub(crate) async fn query(&self, query: String) -> Result<Value, MesFault> {
        let mut request = Request::new(Bytes::from(query));
        *request.method_mut() = Method::POST;
        *request.uri_mut() = "/sparql".parse()?;
        let media = HeaderValue::from_static("application/sparql-query");
        request.headers_mut().insert(CONTENT_TYPE, media);
        self.table(request).await
    }

    /// Answers a named question as a table.
    pub(crate) async fn ask<'p>(
        &self,
        question: &str,
        parameters: impl Iterator<Item = (&'p String, &'p String)>,
    ) -> Result<Value, MesFault> {
        let given = parameters.filter(|(_, value)| !value.is_empty());
        let pairs = given.map(|(name, value)| format!("{}={}", escaped(name), escaped(value)));
        let pairs: Vec<String> = pairs.collect();
        let path = format!("/ask/{}?{}", escaped(question), pairs.join("&"));
        self.table(get(&path)?).await
    }

    /// Checks a file, and changes nothing. Returns the findings.
    pub(crate) async fn check(
        &self,
        file: &SourceFile,
        by: Option<&MesCredentials>,
    ) -> Result<Value, MesFault> {
        let request = upload((Method::POST, "check"), file, by)?;
        json(&self.send(request, UPLOAD_LIMIT).await?)
    }

    /// Adds or replaces a source.
    pub(crate) async fn load(
        &self,
        file: &SourceFile,
        by: Option<&MesCredentials>,
    ) -> Result<(), MesFault> {
        let request = upload((Method::PUT, "sources"), file, by)?;
        self.send(request, UPLOAD_LIMIT).await.map(drop)
    }

    async fn table(&self, mut request: Request<Bytes>) -> Result<Value, MesFault> {
        let accepted = HeaderValue::from_static(table::ACCEPTED);
        request.headers_mut().insert(ACCEPT, accepted);
        let response = self.send(request, LIMIT).await?;
        // A large table would keep the thread of the page.
        let read = tokio::task::spawn_blocking(move || {
            let media = response.headers().get(CONTENT_TYPE);
            let media = media.and_then(|media| media.to_str().ok());
            table::read(media.unwrap_or_default(), response.body())
        });
        let read = read.await;
        let read = read.map_err(|error| MesFault::Unreadable(error.to_string()))?;
        read.map_err(|error| MesFault::Unreadable(error.to_string()))
    }

    async fn send(
        &self,
        request: Request<Bytes>,
        limit: Duration,
    ) -> Result<Response<Bytes>, MesFault> {
        let limits = HttpLimits {
            within: limit,
            most: LARGEST_RESULT,
        };
        let sent = self.0.send(request, limits).await;
        let response = sent.map_err(|error| {
            if matches!(error, RequestError::Exchange(HttpError::Body(_))) {
                MesFault::TooLarge
            } else {
                MesFault::Request(error)
            }
        })?;
        let status = response.status();
        if status.is_success() {
            return Ok(response);
        }
        let told: Option<Refusal> = serde_json::from_slice(response.body()).ok();
        let message = told.map_or_else(
            || format!("ua-mes answers {status}"),
            |refusal| refusal.message,
        );
        Err(MesFault::Refused { status, message })
    }
}

fn get(path: &str) -> Result<Request<Bytes>, MesFault> {
    let mut request = Request::new(Bytes::new());
    *request.uri_mut() = path.parse()?;
    Ok(request)
}

fn upload(
    (method, verb): (Method, &str),
    file: &SourceFile,
    by: Option<&MesCredentials>,
) -> Result<Request<Bytes>, MesFault> {
    let mut request = Request::new(file.contents.clone());
    *request.method_mut() = method;
    let path = format!("/{verb}/{}/{}", file.kind, escaped(&file.name));
    *request.uri_mut() = path.parse()?;
    if let Some(MesCredentials { user, password }) = by {
        let basic = basic_authorization(user, password)?;
        request.headers_mut().insert(AUTHORIZATION, basic);
    }
    Ok(request)
}

fn json(response: &Response<Bytes>) -> Result<Value, MesFault> {
    serde_json::from_slice(response.body()).map_err(|error| MesFault::Unreadable(error.to_string()))
}

/// Returns the kind of a source of the knowledge of the plant, by the name and the contents of its
/// file: `file` (Turtle), `mtp`, `nodeset` or `process` (a recipe). Returns `None` for other files.
#[must_use]
pub fn source_kind(file: &str, contents: &[u8]) -> Option<&'static str> {
    let ending = Path::new(file).extension();
    let ending = ending
        .and_then(|ending| ending.to_str())
        .unwrap_or_default();
    let has = |text: &[u8]| contents.windows(text.len()).any(|window| window == text);
    match ending.to_ascii_lowercase().as_str() {
        "ttl" | "nt" => Some("file"),
        "aml" | "mtp" | "amlx" => Some("mtp"),
        "xml" if has(b"UANodeSet") => Some("nodeset"),
        "xml" if has(b"CAEXFile") => Some("mtp"),
        "step" | "stp" | "p21" => Some("product"),
        "bpmn" | "batchml" => Some("process"),
        "xml" if has(b"http://www.mesa.org/xml/B2MML") || has(b"/spec/BPMN/20100524/MODEL") => {
            Some("process")
        }
        _ => None,
    }
}

/// The time limit of a response, longer than that of a query.
const LIMIT: Duration = Duration::from_secs(15);
/// The time limit of a file that is checked or loaded.
const UPLOAD_LIMIT: Duration = Duration::from_secs(60);
const LARGEST_RESULT: usize = 8 << 20;
/// The media type of a drawing.
const SVG: &str = "image/svg+xml";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kind_of_a_source_is_found_by_its_file() {
        for (file, contents, kind) in [
            ("a.ttl", "", Some("file")),
            ("A.MTP", "", Some("mtp")),
            ("di.xml", "<UANodeSet>", Some("nodeset")),
            ("m.xml", "<c:CAEXFile>", Some("mtp")),
            (
                "b.xml",
                "<B xmlns='http://www.mesa.org/xml/B2MML'>",
                Some("process"),
            ),
            ("b.bpmn", "", Some("process")),
            ("Part.STP", "", Some("product")),
            ("x.xml", "<html>", None),
            ("-", "", None),
        ] {
            assert_eq!(source_kind(file, contents.as_bytes()), kind, "{file}");
        }
    }

    #[test]
    fn a_file_is_sent_by_its_escaped_name_with_the_user_of_the_mes() {
        let file = SourceFile {
            kind: "mtp",
            name: "a module/1.aml".to_owned(),
            contents: Bytes::from_static(b"x"),
        };
        let by = MesCredentials {
            user: "anna".to_owned(),
            password: "secret: 1".to_owned(),
        };
        let request = upload((Method::PUT, "sources"), &file, Some(&by)).unwrap();
        assert_eq!(request.uri(), "/sources/mtp/a%20module%2F1.aml");
        assert_eq!(
            request.headers()[AUTHORIZATION],
            "Basic YW5uYTpzZWNyZXQ6IDE="
        );
        let request = upload((Method::POST, "check"), &file, None).unwrap();
        assert_eq!(request.uri(), "/check/mtp/a%20module%2F1.aml");
        assert!(!request.headers().contains_key(AUTHORIZATION));
    }
}
