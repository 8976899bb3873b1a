//! Requests to a host within a time limit.

use std::fmt;
use std::io;
use std::time::Duration;

use bytes::Bytes;
use hyper::header::{HOST, HeaderValue, InvalidHeaderValue};
use hyper::{Request, Response};
use thiserror::Error;
#[cfg(feature = "tls")]
use tls_client::{TlsAuthorities, TlsError, TlsVerification};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::time::{Instant, timeout_at};

#[cfg(feature = "tls")]
use crate::url::HttpUrl;
use crate::{Connection, HttpError};

/// An HTTP server, with or without TLS. As text it is the beginning of its URLs.
#[derive(Debug, Clone)]
pub struct HttpHost {
    /// The host and the port.
    address: String,
    /// `None` for plain HTTP.
    #[cfg(feature = "tls")]
    tls: Option<TlsVerification>,
}

/// The limits of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HttpLimits {
    /// The longest time for the connection and the whole response.
    pub within: Duration,
    /// The largest body of a response, in bytes.
    pub most: usize,
}

/// The reason why a request has no response.
#[derive(Debug, Error)]
pub enum RequestError {
    /// The address is no value of the header `Host`.
    #[error("`{address}` is no host with a port: {source}")]
    Address {
        /// The address.
        address: String,
        /// The reason.
        source: InvalidHeaderValue,
    },
    /// There is no connection.
    #[error("no connection: {0}")]
    Connect(#[source] io::Error),
    /// The certificate is not trusted, or the host has no TLS.
    #[error("no secure connection: {0}")]
    Tls(#[source] io::Error),
    /// There is no connection within the time limit.
    #[error("no connection within {} ms", .0.as_millis())]
    ConnectTimeout(Duration),
    /// The caller has withdrawn the request.
    #[error("the request was withdrawn before it was sent")]
    Withdrawn,
    /// The response is not complete within the time limit.
    #[error("no response within {} ms", .0.as_millis())]
    ResponseTimeout(Duration),
    /// The response is no HTTP, or its body ended early or is too large.
    #[error(transparent)]
    Exchange(#[from] HttpError),
}

impl RequestError {
    /// Returns whether nothing of the request was sent. Otherwise it may have been executed.
    #[must_use]
    pub const fn is_unsent(&self) -> bool {
        match self {
            Self::Address { .. }
            | Self::Connect(_)
            | Self::Tls(_)
            | Self::ConnectTimeout(_)
            | Self::Withdrawn => true,
            Self::ResponseTimeout(_) | Self::Exchange(_) => false,
        }
    }
}

impl HttpHost {
    /// Creates a host without TLS from a host with its port, as `10.0.0.9:80` or `[::1]:80`.
    #[must_use]
    pub const fn plain(address: String) -> Self {
        Self {
            address,
            #[cfg(feature = "tls")]
            tls: None,
        }
    }

    /// Creates a host with TLS.
    #[cfg(feature = "tls")]
    #[must_use]
    pub const fn secured(address: String, tls: TlsVerification) -> Self {
        Self {
            address,
            tls: Some(tls),
        }
    }

    /// Creates the host of a URL. The host of `https` must have a certificate of one of the
    /// [usual authorities](TlsAuthorities::usual).
    ///
    /// # Errors
    /// [`TlsError`].
    #[cfg(feature = "tls")]
    pub fn of(url: &HttpUrl) -> Result<Self, TlsError> {
        let tls = match url.is_secure() {
            true => Some(TlsVerification::new(url.host(), &TlsAuthorities::usual()?)?),
            false => None,
        };
        Ok(Self {
            address: url.address(),
            tls,
        })
    }

    /// Returns the host and the port.
    #[must_use]
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Sends a request with a URI that is a path with its query. Adds the header `Host`.
    ///
    /// # Errors
    /// [`RequestError`].
    pub async fn send(
        &self,
        request: Request<Bytes>,
        limits: HttpLimits,
    ) -> Result<Response<Bytes>, RequestError> {
        self.send_unless(request, limits, || false).await
    }

    /// As [`send`](Self::send). The request is not sent if it is withdrawn when the connection has
    /// been made.
    ///
    /// # Errors
    /// [`RequestError`].
    pub async fn send_unless(
        &self,
        mut request: Request<Bytes>,
        limits: HttpLimits,
        withdrawn: impl Fn() -> bool + Send,
    ) -> Result<Response<Bytes>, RequestError> {
        let host = HeaderValue::from_str(&self.address);
        let host = host.map_err(|source| RequestError::Address {
            address: self.address.clone(),
            source,
        })?;
        request.headers_mut().insert(HOST, host);
        // The handshake of TLS has a large state.
        exchange(Box::pin(self.connect()), request, limits, withdrawn).await
    }

    async fn connect(&self) -> Result<Connection, RequestError> {
        let stream = TcpStream::connect(&self.address).await;
        let stream = stream.map_err(RequestError::Connect)?;
        // A request is small, and would wait for the confirmation of the handshake.
        stream.set_nodelay(true).map_err(RequestError::Connect)?;
        self.open(stream).await
    }

    async fn open<S>(&self, stream: S) -> Result<Connection, RequestError>
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        #[cfg(feature = "tls")]
        if let Some(tls) = &self.tls {
            let secured = tls.connect(stream).await.map_err(RequestError::Tls)?;
            return opened(secured).await;
        }
        opened(stream).await
    }

    #[cfg(feature = "tls")]
    const fn is_secure(&self) -> bool {
        self.tls.is_some()
    }

    #[cfg(not(feature = "tls"))]
    #[expect(clippy::unused_self, reason = "the feature `tls` uses it")]
    const fn is_secure(&self) -> bool {
        false
    }
}

impl PartialEq for HttpHost {
    /// Compares the URLs; the authorities are not compared.
    fn eq(&self, other: &Self) -> bool {
        (&self.address, self.is_secure()) == (&other.address, other.is_secure())
    }
}

impl Eq for HttpHost {}

impl fmt::Display for HttpHost {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.is_secure() { "https" } else { "http" };
        write!(f, "{scheme}://{}", self.address)
    }
}

async fn opened<S>(stream: S) -> Result<Connection, RequestError>
where
    S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
{
    let opened = Connection::open(stream).await;
    opened.map_err(|error| RequestError::Connect(io::Error::other(error)))
}

/// Sends a request over a connection that is being made.
async fn exchange(
    connecting: impl Future<Output = Result<Connection, RequestError>>,
    request: Request<Bytes>,
    HttpLimits { within, most }: HttpLimits,
    withdrawn: impl Fn() -> bool,
) -> Result<Response<Bytes>, RequestError> {
    let until = Instant::now() + within;
    let connection = timeout_at(until, connecting).await;
    let connection = connection.map_err(|_| RequestError::ConnectTimeout(within))??;
    if withdrawn() {
        return Err(RequestError::Withdrawn);
    }
    let response = timeout_at(until, connection.send(request, most)).await;
    Ok(response.map_err(|_| RequestError::ResponseTimeout(within))??)
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;

    const LIMITS: HttpLimits = HttpLimits {
        within: Duration::from_secs(2),
        most: 7,
    };

    fn host() -> HttpHost {
        HttpHost::plain("h:80".to_owned())
    }

    /// Sends a request to a peer in memory, which sends an answer as soon as it receives something.
    /// Returns the result, and all that the peer has received.
    async fn sent(
        host: &HttpHost,
        answer: &str,
        is_withdrawn: bool,
    ) -> (Result<Response<Bytes>, RequestError>, Vec<u8>) {
        let (near, mut far) = duplex(4096);
        let peer = async {
            let mut received = vec![0; 4096];
            let count = far.read(&mut received).await.unwrap();
            received.truncate(count);
            if count > 0 {
                far.write_all(answer.as_bytes()).await.unwrap();
                far.read_to_end(&mut received).await.unwrap();
            }
            received
        };
        let request = Request::get("/a").body(Bytes::new()).unwrap();
        let sending = exchange(host.open(near), request, LIMITS, || is_withdrawn);
        tokio::join!(sending, peer)
    }

    #[tokio::test(start_paused = true)]
    async fn a_response_is_bounded_in_time_and_size() {
        let answer = "HTTP/1.1 200 OK\r\ncontent-length: 7\r\n\r\nno page";
        let (response, _) = sent(&host(), answer, false).await;
        assert_eq!(response.unwrap().body(), "no page");
        let larger = "HTTP/1.1 200 OK\r\ncontent-length: 8\r\n\r\nno page!";
        let (response, _) = sent(&host(), larger, false).await;
        let error = response.unwrap_err();
        assert!(matches!(error, RequestError::Exchange(HttpError::Body(_))));
        assert!(!error.is_unsent());
        // The beginning of a response does not extend the limit.
        for beginning in ["", "HTTP/1.1 200 OK\r\ncontent-length: 7\r\n\r\nno"] {
            let (response, _) = sent(&host(), beginning, false).await;
            let error = response.unwrap_err();
            assert!(matches!(error, RequestError::ResponseTimeout(_)), "{error}");
            assert!(!error.is_unsent());
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_host_that_accepts_no_connection_is_late() {
        let request = Request::get("/a").body(Bytes::new()).unwrap();
        let never = std::future::pending();
        let error = exchange(never, request, LIMITS, || false).await;
        let error = error.unwrap_err();
        assert_eq!(error.to_string(), "no connection within 2000 ms");
        assert!(error.is_unsent());
    }

    #[tokio::test]
    async fn nothing_of_a_withdrawn_request_is_sent() {
        let (response, received) = sent(&host(), "", true).await;
        assert!(matches!(response, Err(RequestError::Withdrawn)));
        assert_eq!(received, b"");
    }

    #[cfg(feature = "tls")]
    #[tokio::test(start_paused = true)]
    async fn nothing_of_a_request_is_sent_to_a_host_without_tls() {
        let authorities = TlsAuthorities::of([]);
        let tls = TlsVerification::new("h", &authorities).unwrap();
        let host = HttpHost::secured("h:443".to_owned(), tls);
        assert_eq!(host.to_string(), "https://h:443");
        let answer = "HTTP/1.1 400 Bad Request\r\n\r\n";
        let (response, received) = sent(&host, answer, false).await;
        let error = response.unwrap_err();
        assert!(matches!(error, RequestError::Tls(_)), "{error}");
        assert!(error.is_unsent());
        let received = String::from_utf8_lossy(&received);
        assert!(!received.contains("GET"), "{received}");
    }
}
