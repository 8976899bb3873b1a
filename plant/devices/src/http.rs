//! HTTP/1.1 client of devices, with or without TLS: one connection per request, responses bounded
//! in time and size.

use std::fmt;
use std::time::Duration;

use bytes::Bytes;
use http_client::header::{CONTENT_TYPE, HOST};
use http_client::{Connection, Request, Response};
use serde_json::Value;
use tokio::time::{Instant, timeout_at};

use crate::modbus::connected;
use crate::tls::DeviceTls;

/// The server of a device.
#[derive(Debug, Clone)]
pub(crate) struct DeviceHost {
    /// Host and port.
    address: String,
    /// `None` for plain HTTP.
    tls: Option<DeviceTls>,
}

impl PartialEq for DeviceHost {
    fn eq(&self, other: &Self) -> bool {
        self.address == other.address && self.tls.is_some() == other.tls.is_some()
    }
}

impl fmt::Display for DeviceHost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.tls.is_some() { "https" } else { "http" };
        write!(f, "{scheme}://{}", self.address)
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
    /// Creates a server without TLS, by its host and port.
    pub(crate) const fn plain(address: String) -> Self {
        Self { address, tls: None }
    }

    /// Creates a server with TLS.
    pub(crate) const fn secured(address: String, tls: DeviceTls) -> Self {
        Self {
            address,
            tls: Some(tls),
        }
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
        let until = Instant::now() + asked.within;
        let late = || {
            let within = asked.within.as_millis();
            format!("no answer from {self} within {within} ms")
        };
        let unreachable = |error: &dyn fmt::Display| {
            HttpFault::Unreachable(format!("{self} cannot be reached: {error}"))
        };
        let connecting = async {
            let stream = connected(&self.address)
                .await
                .map_err(|error| unreachable(&error))?;
            let opened = match &self.tls {
                None => Connection::open(stream).await,
                Some(tls) => {
                    let secured = tls.connect(stream).await;
                    Connection::open(secured.map_err(|error| unreachable(&error))?).await
                }
            };
            opened.map_err(|error| unreachable(&error))
        };
        let connection = timeout_at(until, connecting)
            .await
            .map_err(|_| HttpFault::Unreachable(late()))??;
        let body = asked.body.map(Value::to_string).unwrap_or_default();
        let request = Request::builder()
            .method(asked.method)
            .uri(asked.path)
            .header(HOST, &self.address)
            .header(CONTENT_TYPE, "application/json")
            .body(Bytes::from(body))
            .map_err(|error| {
                HttpFault::Unreachable(format!("{} cannot be asked for: {error}", asked.path))
            })?;
        if withdrawn() {
            let why = "Halt came before the request was sent".to_owned();
            return Err(HttpFault::Unreachable(why));
        }
        let answer = timeout_at(until, connection.send(request, LONGEST))
            .await
            .map_err(|_| HttpFault::Lost(late()))?;
        self.read(&answer.map_err(|error| self.damaged(&error))?)
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
