//! Reads the `/status` of other programs.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use bytes::Bytes;
use http_client::header::HOST;
use http_client::{Connection, Request};
use serde_json::Value;
use tokio::net::TcpStream;
use tokio::time::timeout;

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

impl StatusUrl {
    /// Reads the status.
    pub(crate) async fn fetch(&self) -> Result<Value, String> {
        match timeout(LIMIT, self.request()).await {
            Ok(answer) => answer,
            Err(_) => Err(format!("no response within {} s", LIMIT.as_secs())),
        }
    }

    async fn request(&self) -> Result<Value, String> {
        let stream = TcpStream::connect(&self.authority)
            .await
            .map_err(|error| format!("no connection: {error}"))?;
        let request = Request::get("/status")
            .header(HOST, &self.authority)
            .body(Bytes::new())
            .map_err(text)?;
        let connection = Connection::open(stream).await.map_err(text)?;
        let response = connection.send(request, MOST_BYTES).await.map_err(text)?;
        if !response.status().is_success() {
            return Err(format!("the response is {}", response.status()));
        }
        serde_json::from_slice(response.body()).map_err(|error| format!("no status: {error}"))
    }
}

fn text(error: impl fmt::Display) -> String {
    error.to_string()
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
        let why = url.fetch().await.unwrap_err();
        assert!(why.starts_with("no connection"), "{why}");
    }
}
