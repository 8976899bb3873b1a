//! HTTP/1.1 requests: a connection for each request, with or without TLS, and responses bounded in
//! time and size.
//!
//! - [`HttpHost`] sends a request within a time limit.
//! - [`HttpUrl`] is a parsed URL of `http` or `https`.
//! - [`Connection`] sends a request over a stream of the caller.
//! - `TlsAuthorities` and `TlsVerification`, with the feature `tls`, verify the certificates of
//!   hosts.
//!
//! No redirection is followed.

mod connection;
mod host;
mod url;

pub use connection::{Connection, HttpError};
pub use host::{HttpHost, HttpLimits, RequestError};
pub use hyper::http::Error as InvalidRequest;
pub use hyper::{Method, Request, Response, StatusCode, header};
#[cfg(feature = "tls")]
pub use tls_client::{TlsAuthorities, TlsError, TlsVerification};
pub use url::{HttpUrl, HttpUrlError};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use header::{HeaderValue, InvalidHeaderValue};

/// Returns the value of `Authorization` with a name and a password (RFC 7617), which logs do not
/// show.
///
/// # Errors
/// The text is too long for a header.
pub fn basic_authorization(user: &str, password: &str) -> Result<HeaderValue, InvalidHeaderValue> {
    let encoded = STANDARD.encode(format!("{user}:{password}"));
    let mut value = HeaderValue::from_str(&format!("Basic {encoded}"))?;
    value.set_sensitive(true);
    Ok(value)
}
