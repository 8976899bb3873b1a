//! Sends HTTP requests with limits on size and time.

use std::time::Duration;

use bytes::Bytes;
use http_client::header::{ACCEPT, AUTHORIZATION, CONTENT_TYPE, HeaderValue};
use http_client::{
    HttpHost, HttpLimits, InvalidRequest, Method, Request, RequestError, basic_authorization,
};

use crate::exit::CommandFailure;

/// The reason why a request has no response.
#[derive(Debug, thiserror::Error)]
enum ExchangeFault {
    #[error(transparent)]
    Request(#[from] InvalidRequest),
    #[error(transparent)]
    Host(#[from] RequestError),
    #[error("an answer that is no text")]
    NoText,
}

/// An HTTP response.
pub(crate) struct HttpResponse {
    pub(crate) status: u16,
    pub(crate) content_type: String,
    pub(crate) body: String,
}

/// A request that changes something.
pub(crate) struct ChangeRequest {
    pub(crate) method: &'static str,
    pub(crate) content_type: &'static str,
    pub(crate) body: Vec<u8>,
    /// The name and the password of the user.
    pub(crate) user: Option<(String, String)>,
}

/// An HTTP server: `http://host:port`, or `host:port` alone.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct HttpServer {
    /// `host:port`.
    authority: String,
    /// The prefix of every path, without a slash at its end.
    prefix: String,
}

impl HttpServer {
    /// Parses the URL of a server.
    ///
    /// # Errors
    /// [`CommandFailure::Usage`] if the URL is malformed.
    pub(crate) fn parse(url: &str) -> Result<Self, CommandFailure> {
        let rest = url.strip_prefix("http://").unwrap_or(url);
        let (authority, path) = rest.split_once('/').unwrap_or((rest, ""));
        let (host, port) = match authority.rsplit_once(':') {
            Some((host, port)) if !host.is_empty() => (host, port.parse::<u16>().ok()),
            Some(_) | None => (authority, Some(80)),
        };
        let plain = |c: char| c.is_ascii_graphic() && !matches!(c, '@' | '?' | '#' | '/');
        match port {
            Some(port) if !host.is_empty() && host.chars().all(plain) => Ok(Self {
                authority: format!("{host}:{port}"),
                prefix: path.trim_end_matches('/').to_owned(),
            }),
            Some(_) | None => Err(CommandFailure::Usage(format!(
                "{url}: for example http://127.0.0.1:8087"
            ))),
        }
    }

    /// Returns `host:port`.
    pub(crate) fn authority(&self) -> &str {
        &self.authority
    }

    /// Requests a path, which begins with a slash.
    ///
    /// # Errors
    /// [`CommandFailure::Unavailable`] if the server does not respond in time.
    pub(crate) async fn get(&self, path: &str) -> Result<HttpResponse, CommandFailure> {
        self.request(Method::GET, path, (JSON, "", Bytes::new()))
            .await
    }

    /// Requests a page as Turtle.
    ///
    /// # Errors
    /// See [`get`](Self::get).
    pub(crate) async fn get_turtle(&self, path: &str) -> Result<HttpResponse, CommandFailure> {
        self.request(Method::GET, path, ("text/turtle", "", Bytes::new()))
            .await
    }

    /// Sends a SPARQL query.
    ///
    /// # Errors
    /// See [`get`](Self::get).
    pub(crate) async fn query(
        &self,
        path: &str,
        query: String,
    ) -> Result<HttpResponse, CommandFailure> {
        let content = (RESULTS, "application/sparql-query", query.into());
        self.request(Method::POST, path, content).await
    }

    /// Sends a change.
    ///
    /// # Errors
    /// See [`get`](Self::get).
    pub(crate) async fn change(
        &self,
        path: &str,
        change: ChangeRequest,
    ) -> Result<HttpResponse, CommandFailure> {
        let method = Method::from_bytes(change.method.as_bytes())
            .map_err(|error| CommandFailure::Usage(error.to_string()))?;
        let content = (JSON, change.content_type, change.body.into());
        let user = change.user.as_ref();
        let user = user.map(|(name, password)| basic_authorization(name, password));
        let user = user.transpose();
        let user = user.map_err(|error| CommandFailure::Usage(error.to_string()))?;
        self.request_as(method, path, content, (user, CHANGE_LIMIT))
            .await
    }

    async fn request(
        &self,
        method: Method,
        path: &str,
        content: (&str, &str, Bytes),
    ) -> Result<HttpResponse, CommandFailure> {
        self.request_as(method, path, content, (None, LIMIT)).await
    }

    async fn request_as(
        &self,
        method: Method,
        path: &str,
        content: (&str, &str, Bytes),
        user: (Option<HeaderValue>, Duration),
    ) -> Result<HttpResponse, CommandFailure> {
        let answer = self.asked(method, path, content, user).await;
        answer.map_err(|why| {
            let help = "start the program, or give the address at which it runs";
            CommandFailure::Unavailable(format!(
                "http://{}: {why}\n  = help: {help}",
                self.authority
            ))
        })
    }

    async fn asked(
        &self,
        method: Method,
        path: &str,
        (accept, content_type, body): (&str, &str, Bytes),
        (user, within): (Option<HeaderValue>, Duration),
    ) -> Result<HttpResponse, ExchangeFault> {
        let is_protobuf = content_type == PROTOBUF;
        let mut request = Request::builder()
            .method(method)
            .uri(format!("{}{path}", self.prefix_path()))
            .header(ACCEPT, accept);
        if !content_type.is_empty() {
            request = request.header(CONTENT_TYPE, content_type);
        }
        if let Some(user) = user {
            request = request.header(AUTHORIZATION, user);
        }
        let request = request.body(body)?;
        let limits = HttpLimits {
            within,
            most: MOST_BYTES,
        };
        let host = HttpHost::plain(self.authority.clone());
        let response = host.send(request, limits).await?;
        let status = response.status().as_u16();
        let content_type = response.headers().get(CONTENT_TYPE);
        let content_type = content_type.and_then(|value| value.to_str().ok());
        let content_type = content_type.unwrap_or_default().to_owned();
        let body = match String::from_utf8(response.into_body().into()) {
            Ok(body) => body,
            // A collector of OTLP answers in protobuf, too. The texts in it are legible.
            Err(wrong) if is_protobuf => String::from_utf8_lossy(wrong.as_bytes()).into_owned(),
            Err(_) => return Err(ExchangeFault::NoText),
        };
        Ok(HttpResponse {
            status,
            content_type,
            body,
        })
    }

    fn prefix_path(&self) -> String {
        match self.prefix.as_str() {
            "" => String::new(),
            prefix => format!("/{prefix}"),
        }
    }
}

/// Plain JSON, which is accepted even where the server also offers the SPARQL results format.
const JSON: &str = "application/json";
const RESULTS: &str = "application/sparql-results+json, application/n-triples";
/// The content of a request with an answer that need not be text.
pub(crate) const PROTOBUF: &str = "application/x-protobuf";
/// The time limit of a request, longer than the time limit of a query.
const LIMIT: Duration = Duration::from_secs(15);
/// The time limit of a change, which may be large.
const CHANGE_LIMIT: Duration = Duration::from_secs(60);
const MOST_BYTES: usize = 32 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_is_an_url_or_an_address() {
        let of =
            |url: &str| HttpServer::parse(url).map(|it| (it.authority.clone(), it.prefix_path()));
        for url in [
            "http://127.0.0.1:9100",
            "127.0.0.1:9100",
            "http://127.0.0.1:9100/",
        ] {
            assert_eq!(
                of(url).unwrap(),
                ("127.0.0.1:9100".to_owned(), String::new())
            );
        }
        assert_eq!(
            of("http://mes/knowledge/").unwrap(),
            ("mes:80".to_owned(), "/knowledge".to_owned())
        );
        for url in ["", "http://", "http://a:b", "http://u@h:1", "http://h:1 2"] {
            assert!(of(url).is_err(), "{url}");
        }
    }
}
