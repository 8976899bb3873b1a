//! Requests to devices with an HTTP interface, with or without TLS: JSON there and back.

use std::fmt;
use std::time::Duration;

use bytes::Bytes;
use http_client::header::CONTENT_TYPE;
use http_client::{HttpHost, HttpLimits, Request, RequestError, Response};
use serde_json::Value;

/// The server of a device.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DeviceHost(HttpHost);

impl fmt::Display for DeviceHost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// A request.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DeviceRequest<'a> {
    pub(crate) method: &'a str,
    /// The path with its query.
    pub(crate) path: &'a str,
    pub(crate) body: Option<&'a Value>,
    /// Time limit for the connection and the response.
    pub(crate) within: Duration,
}

/// A request without a usable response.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub(crate) enum HttpFault {
    /// The request was not sent: there is no connection, or Halt came before.
    #[error("{0}")]
    Unreachable(String),
    /// The request was sent, and the response is missing or damaged.
    #[error("{0}")]
    Lost(String),
    /// The device has responded with a status that is not a success.
    #[error("{why}")]
    Refused {
        /// The status code.
        status: u16,
        /// The description with the message of the device.
        why: String,
    },
}

impl DeviceHost {
    /// Creates the server of a device from its host.
    pub(crate) const fn new(host: HttpHost) -> Self {
        Self(host)
    }

    /// Creates a server without TLS, by its host and port.
    pub(crate) const fn plain(address: String) -> Self {
        Self(HttpHost::plain(address))
    }

    /// Sends a request and returns its response; null for a response without a body.
    ///
    /// # Errors
    /// A [`HttpFault`], which says whether the request may have been executed.
    pub(crate) async fn ask(&self, asked: DeviceRequest<'_>) -> Result<Value, HttpFault> {
        self.ask_unless(asked, || false).await
    }

    /// As [`ask`](Self::ask). The request is not sent if it is withdrawn when the connection has
    /// been made.
    ///
    /// # Errors
    /// As [`ask`](Self::ask); [`HttpFault::Unreachable`] for a withdrawn request.
    pub(crate) async fn ask_unless(
        &self,
        asked: DeviceRequest<'_>,
        withdrawn: impl Fn() -> bool + Send,
    ) -> Result<Value, HttpFault> {
        let body = asked.body.map(Value::to_string).unwrap_or_default();
        let request = Request::builder()
            .method(asked.method)
            .uri(asked.path)
            .header(CONTENT_TYPE, "application/json")
            .body(Bytes::from(body))
            .map_err(|error| {
                HttpFault::Unreachable(format!("{} cannot be asked for: {error}", asked.path))
            })?;
        let limits = HttpLimits {
            within: asked.within,
            most: LONGEST,
        };
        let answer = self.0.send_unless(request, limits, withdrawn).await;
        self.read(&answer.map_err(|error| self.fault(&error, asked.within))?)
    }

    /// Returns the fault of a request without a response.
    fn fault(&self, error: &RequestError, within: Duration) -> HttpFault {
        let why = match error {
            RequestError::Withdrawn => "Halt came before the request was sent".to_owned(),
            RequestError::ConnectTimeout(_) | RequestError::ResponseTimeout(_) => {
                let within = within.as_millis();
                format!("no answer from {self} within {within} ms")
            }
            RequestError::Address { .. } | RequestError::Connect(_) | RequestError::Tls(_) => {
                format!("{self} cannot be reached: {error}")
            }
            RequestError::Exchange(_) => return self.damaged(error),
        };
        match error.is_unsent() {
            true => HttpFault::Unreachable(why),
            false => HttpFault::Lost(why),
        }
    }

    fn read(&self, answer: &Response<Bytes>) -> Result<Value, HttpFault> {
        let (status, bytes) = (answer.status(), answer.body());
        let json = serde_json::from_slice::<Value>(bytes);
        if !status.is_success() {
            let message = json.ok().and_then(|json| {
                let message = json.get("message")?.as_str()?;
                Some(message.chars().take(120).collect::<String>())
            });
            let message = message.unwrap_or_default();
            return Err(HttpFault::Refused {
                status: status.as_u16(),
                why: format!("{self} refuses with {status}: {message}"),
            });
        }
        if bytes.is_empty() {
            return Ok(Value::Null);
        }
        json.map_err(|error| self.damaged(&error))
    }

    fn damaged(&self, error: &dyn fmt::Display) -> HttpFault {
        HttpFault::Lost(format!("the answer of {self} is damaged: {error}"))
    }
}

const LONGEST: usize = 64 * 1024;
