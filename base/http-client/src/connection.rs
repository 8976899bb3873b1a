//! A request over a stream of the caller.

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::client::conn::http1::{SendRequest, handshake};
use hyper::{Request, Response};
use hyper_util::rt::TokioIo;
use thiserror::Error;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::task::JoinSet;

/// A connection for a single request.
#[derive(Debug)]
pub struct Connection {
    sender: SendRequest<Full<Bytes>>,
    /// Reads and writes until the connection is dropped.
    _driving: JoinSet<hyper::Result<()>>,
}

/// The reason why a request has no response. The request may have been executed.
#[derive(Debug, Error)]
pub enum HttpError {
    /// The connection ended, or the server does not speak HTTP.
    #[error(transparent)]
    Exchange(#[from] hyper::Error),
    /// The body of the response ended early or exceeds the bound.
    #[error("the body of the response cannot be read: {0}")]
    Body(#[source] Box<dyn std::error::Error + Send + Sync>),
}

impl Connection {
    /// Prepares a stream, such as a TCP connection with or without TLS, for a request.
    ///
    /// # Errors
    /// [`HttpError::Exchange`].
    pub async fn open<S>(stream: S) -> Result<Self, HttpError>
    where
        S: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let (sender, connection) = handshake(TokioIo::new(stream)).await?;
        let mut driving = JoinSet::new();
        driving.spawn(connection);
        Ok(Self {
            sender,
            _driving: driving,
        })
    }

    /// Sends the request and returns the response with a body of at most `most` bytes.
    ///
    /// # Errors
    /// [`HttpError`].
    pub async fn send(
        mut self,
        request: Request<Bytes>,
        most: usize,
    ) -> Result<Response<Bytes>, HttpError> {
        let response = self.sender.send_request(request.map(Full::new)).await?;
        let (head, body) = response.into_parts();
        let body = Limited::new(body, most).collect().await;
        let body = body.map_err(HttpError::Body)?.to_bytes();
        Ok(Response::from_parts(head, body))
    }
}

#[cfg(test)]
mod tests {
    use hyper::{StatusCode, header};
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, duplex};

    use super::*;

    async fn answered(answer: &'static str, most: usize) -> Result<Response<Bytes>, HttpError> {
        let (near, mut far) = duplex(1024);
        let serve = async {
            let mut request = [0; 1024];
            let read = far.read(&mut request).await.unwrap();
            assert!(request[..read].starts_with(b"GET /status HTTP/1.1\r\n"));
            far.write_all(answer.as_bytes()).await.unwrap();
            drop(far);
        };
        let ask = async {
            let request = Request::get("/status").header(header::HOST, "cell");
            let request = request.body(Bytes::new()).unwrap();
            Connection::open(near).await?.send(request, most).await
        };
        tokio::join!(ask, serve).0
    }

    #[tokio::test]
    async fn a_response_has_its_status_and_its_whole_body() {
        let answer = "HTTP/1.1 404 Not Found\r\nconnection: close\r\n\r\nno page";
        let response = answered(answer, 7).await.unwrap();
        assert_eq!(response.status(), StatusCode::NOT_FOUND);
        assert_eq!(response.body(), "no page");
    }

    #[tokio::test]
    async fn a_body_above_the_bound_and_a_connection_that_ends_are_errors() {
        let answer = "HTTP/1.1 200 OK\r\nconnection: close\r\n\r\nno page";
        assert!(matches!(answered(answer, 6).await, Err(HttpError::Body(_))));
        assert!(matches!(answered("", 6).await, Err(HttpError::Exchange(_))));
    }
}
