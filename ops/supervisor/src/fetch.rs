//! Reads the `/status` of other programs.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use bytes::Bytes;
use http_client::{HttpHost, HttpLimits, Request, RequestError, Response};
use hyper::{StatusCode, Uri};
use serde_json::Value;
use thiserror::Error;

/// The location of the status of a program, as `http://127.0.0.1:9100` or `127.0.0.1:9100`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct StatusUrl {
    authority: String,
}

/// A text that is no location of a status.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StatusUrlError;

impl fmt::Display for StatusUrlError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the address of --metrics of a program is wanted, as http://127.0.0.1:9100")
    }
}

impl std::error::Error for StatusUrlError {}

impl FromStr for StatusUrl {
    type Err = StatusUrlError;

    fn from_str(text: &str) -> Result<Self, StatusUrlError> {
        let rest = text.strip_prefix("http://").unwrap_or(text);
        let rest = rest.strip_suffix("/status").unwrap_or(rest);
        let authority = rest.trim_end_matches('/');
        let (host, port) = authority.rsplit_once(':').ok_or(StatusUrlError)?;
        let is_host = |byte: u8| byte.is_ascii_alphanumeric() || b".-[]:_".contains(&byte);
        if host.is_empty() || !host.bytes().all(is_host) || port.parse::<u16>().is_err() {
            return Err(StatusUrlError);
        }
        Ok(Self {
            authority: authority.to_owned(),
        })
    }
}

impl fmt::Display for StatusUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "http://{}", self.authority)
    }
}

/// The reason why a request to a program has no response.
#[derive(Debug, Error)]
pub(crate) enum FetchFault {
    /// The program was not reached, or its response is late, too large or no HTTP.
    #[error(transparent)]
    Request(#[from] RequestError),
    /// The program refuses to return its status.
    #[error("the response is {0}")]
    Response(StatusCode),
    /// The response is not the status of a program.
    #[error("no status: {0}")]
    Status(#[source] serde_json::Error),
}

impl StatusUrl {
    /// Returns the path of the status.
    pub(crate) fn path() -> Uri {
        Uri::from_static("/status")
    }

    /// Reads the status.
    pub(crate) async fn fetch(&self) -> Result<Value, FetchFault> {
        self.get(Self::path()).await
    }

    /// Reads the JSON of a path beside the status.
    pub(crate) async fn get(&self, path: Uri) -> Result<Value, FetchFault> {
        let mut request = Request::new(Bytes::new());
        *request.uri_mut() = path;
        let limits = HttpLimits {
            within: LIMIT,
            most: MOST_BYTES,
        };
        let response = self.send(request, limits).await?;
        if !response.status().is_success() {
            return Err(FetchFault::Response(response.status()));
        }
        serde_json::from_slice(response.body()).map_err(FetchFault::Status)
    }

    /// Sends a request to the program, and returns the response.
    ///
    /// # Errors
    /// [`RequestError`].
    pub(crate) async fn send(
        &self,
        request: Request<Bytes>,
        limits: HttpLimits,
    ) -> Result<Response<Bytes>, RequestError> {
        let host = HttpHost::plain(self.authority.clone());
        host.send(request, limits).await
    }

    /// Returns the host with its port.
    pub(crate) fn authority(&self) -> &str {
        &self.authority
    }
}

const LIMIT: Duration = Duration::from_secs(2);
const MOST_BYTES: usize = 8 << 20;

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    use super::*;

    #[test]
    fn a_status_has_an_address() {
        for (text, shown) in [
            ("127.0.0.1:9100", "http://127.0.0.1:9100"),
            ("http://cell:9100/status", "http://cell:9100"),
            ("http://[::1]:9100/", "http://[::1]:9100"),
        ] {
            assert_eq!(text.parse::<StatusUrl>().unwrap().to_string(), shown);
        }
        for wrong in ["", "cell", "https://cell:9100", "cell:x", "u@h:1", ":9100"] {
            assert!(wrong.parse::<StatusUrl>().is_err(), "{wrong}");
        }
    }

    #[tokio::test]
    async fn a_status_is_read_and_a_program_that_does_not_answer_is_a_reason() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("127.0.0.1:{}", listener.local_addr().unwrap().port());
        let url: StatusUrl = url.parse().unwrap();
        let serve = async {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut request = [0; 1024];
            let read = stream.read(&mut request).await.unwrap();
            assert!(request[..read].starts_with(b"GET /status HTTP/1.1\r\n"));
            let answer = b"HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n{\"space\":1}";
            stream.write_all(answer).await.unwrap();
        };
        let (status, ()) = tokio::join!(url.fetch(), serve);
        assert_eq!(status.unwrap()["space"], 1);
        drop(listener);
        let why = url.fetch().await.unwrap_err().to_string();
        assert!(why.starts_with("no connection"), "{why}");
    }
}
