//! A plain browser for the page: requests with headers, and streams of events.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use serde_json::Value;

const PATIENCE: Duration = Duration::from_secs(30);

/// The answer to a request of a [`Browser`].
#[derive(Debug)]
pub struct WebAnswer {
    /// The status code.
    pub code: u16,
    /// The status line and the headers.
    pub head: String,
    /// The body.
    pub body: String,
}

/// A browser with one cookie and the token of its session.
#[derive(Debug, Default)]
pub struct Browser {
    /// The address of the page.
    pub address: String,
    /// The Host header; the address without it.
    pub host: Option<String>,
    /// The Cookie header.
    pub cookie: String,
    /// The header x-csrf-token.
    pub csrf: String,
}

/// A stream of events of the page.
#[derive(Debug)]
pub struct EventStream(BufReader<TcpStream>);

impl Browser {
    /// Returns a browser for the page at an address.
    #[must_use]
    pub fn of(address: &str) -> Self {
        Self {
            address: address.to_owned(),
            ..Self::default()
        }
    }

    /// Requests a page.
    ///
    /// # Panics
    /// Panics if there is no answer.
    #[must_use]
    pub fn get(&self, path: &str) -> WebAnswer {
        self.exchange(&self.head("GET", path, ""))
    }

    /// Sends JSON.
    ///
    /// # Panics
    /// Panics if there is no answer.
    #[must_use]
    pub fn post(&self, path: &str, body: &Value) -> WebAnswer {
        let body = body.to_string();
        let more = format!(
            "content-type: application/json\r\ncontent-length: {}\r\n",
            body.len()
        );
        self.exchange(&(self.head("POST", path, &more) + &body))
    }

    /// Sends a file. `more` has further headers, each with its line end.
    ///
    /// # Panics
    /// Panics if there is no answer.
    #[must_use]
    pub fn upload(&self, path: &str, more: &str, contents: &str) -> WebAnswer {
        let more = format!(
            "content-type: application/octet-stream\r\ncontent-length: {}\r\n{more}",
            contents.len()
        );
        self.exchange(&(self.head("POST", path, &more) + contents))
    }

    /// Opens a stream of events, as `view=values&count=20`.
    ///
    /// # Panics
    /// Panics if the page does not answer with a stream.
    #[must_use]
    pub fn events(&self, query: &str) -> EventStream {
        let stream = self.send(&self.head("GET", &format!("/events?{query}"), ""));
        let mut stream = BufReader::new(stream);
        let mut line = String::new();
        stream.read_line(&mut line).unwrap();
        assert!(line.starts_with("HTTP/1.1 200"), "{line}");
        EventStream(stream)
    }

    fn head(&self, method: &str, path: &str, more: &str) -> String {
        let host = self.host.as_ref().unwrap_or(&self.address);
        format!(
            "{method} {path} HTTP/1.1\r\nhost: {host}\r\ncookie: {}\r\nx-csrf-token: {}\r\nconnection: close\r\n{more}\r\n",
            self.cookie, self.csrf
        )
    }

    fn send(&self, request: &str) -> TcpStream {
        let mut stream = TcpStream::connect(&self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        stream
    }

    fn exchange(&self, request: &str) -> WebAnswer {
        let mut answer = Vec::new();
        self.send(request).read_to_end(&mut answer).unwrap();
        let answer = String::from_utf8(answer).unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        WebAnswer {
            code: head.split_whitespace().nth(1).unwrap().parse().unwrap(),
            head: head.to_owned(),
            body: body.to_owned(),
        }
    }
}

impl WebAnswer {
    /// Returns the body as JSON.
    ///
    /// # Panics
    /// Panics if the body is not JSON.
    #[must_use]
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.body).unwrap_or_else(|error| panic!("{error}: {self:?}"))
    }

    /// Returns the value of a header.
    #[must_use]
    pub fn header(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines().filter_map(|line| line.split_once(": "));
        lines.find_map(|(found, value)| found.eq_ignore_ascii_case(name).then_some(value))
    }
}

impl EventStream {
    /// Returns the first view for which `is` returns a value.
    ///
    /// # Panics
    /// Panics if no such view arrives in time.
    pub fn until<T>(&mut self, what: &str, mut is: impl FnMut(&Value) -> Option<T>) -> T {
        let began = Instant::now();
        let mut last = Value::Null;
        while began.elapsed() < PATIENCE {
            let mut line = String::new();
            let read = self.0.read_line(&mut line);
            assert!(matches!(read, Ok(1..)), "{what}: {read:?}, after {last}");
            let Some(data) = line.strip_prefix("data: ") else {
                continue;
            };
            last = serde_json::from_str(data.trim_end()).unwrap();
            if let Some(found) = is(&last) {
                return found;
            }
        }
        panic!("{what}: not within {PATIENCE:?}, after {last}");
    }
}
