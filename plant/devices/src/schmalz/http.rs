//! Requests to an IO-Link master: one connection per request, responses bounded in time and size.

use std::fmt;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::header::{CONTENT_TYPE, HOST};
use hyper::{Request, Response, body::Incoming};
use hyper_util::rt::TokioIo;
use serde_json::Value;
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::modbus::connected;

/// A master, by its host and port.
#[derive(Debug)]
pub(super) struct Master {
    address: String,
}

impl fmt::Display for Master {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "http://{}", self.address)
    }
}

impl Master {
    pub(super) fn new(address: &str) -> Self {
        Self {
            address: address.to_owned(),
        }
    }

    /// Sends a request and returns its response; null for a response without a body.
    pub(super) async fn ask(
        &self,
        method: &str,
        path: &str,
        body: Option<&Value>,
    ) -> Result<Value, String> {
        match timeout(ANSWER, self.asked(method, path, body)).await {
            Ok(answer) => answer,
            Err(_) => Err(format!(
                "no answer from {self} within {} ms",
                ANSWER.as_millis()
            )),
        }
    }

    async fn asked(&self, method: &str, path: &str, body: Option<&Value>) -> Result<Value, String> {
        let unreachable = |error: &dyn fmt::Display| format!("{self} cannot be reached: {error}");
        let stream = connected(&self.address)
            .await
            .map_err(|error| unreachable(&error))?;
        let (mut send, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream))
            .await
            .map_err(|error| unreachable(&error))?;
        // Ends with this request.
        let mut driving = JoinSet::new();
        driving.spawn(connection);
        let body = body.map(Value::to_string).unwrap_or_default();
        let request = Request::builder()
            .method(method)
            .uri(path)
            .header(HOST, &self.address)
            .header(CONTENT_TYPE, "application/json")
            .body(Full::new(Bytes::from(body)))
            .map_err(|error| format!("{path} cannot be asked for: {error}"))?;
        let answer = send.send_request(request).await;
        let answer = answer.map_err(|error| format!("the answer of {self} is damaged: {error}"))?;
        self.read(answer).await
    }

    async fn read(&self, answer: Response<Incoming>) -> Result<Value, String> {
        let status = answer.status();
        let body = Limited::new(answer.into_body(), LONGEST).collect().await;
        let body = body.map_err(|error| format!("the answer of {self} is damaged: {error}"))?;
        let bytes = body.to_bytes();
        let json = serde_json::from_slice::<Value>(&bytes);
        if !status.is_success() {
            let message = json.ok().and_then(|json| {
                let message = json.get("message")?.as_str()?;
                Some(message.chars().take(120).collect::<String>())
            });
            return Err(format!(
                "{self} refuses with {status}: {}",
                message.unwrap_or_default()
            ));
        }
        if bytes.is_empty() {
            return Ok(Value::Null);
        }
        json.map_err(|error| format!("the answer of {self} is damaged: {error}"))
    }
}

/// Halt leaves a driver a second, enough for two requests.
const ANSWER: Duration = Duration::from_millis(400);
const LONGEST: usize = 64 * 1024;
