//! Reads status pages of programs over HTTP.

use std::time::Duration;

use bytes::Bytes;
use http_client::{HttpHost, HttpLimits, Request, RequestError};
use serde::de::DeserializeOwned;
use thiserror::Error;

/// Reads the status page of a program on this host.
pub(crate) async fn fetch<T: DeserializeOwned>(port: u16) -> Result<T, PageError> {
    let host = HttpHost::plain(format!("127.0.0.1:{port}"));
    let request = Request::get("/status")
        .body(Bytes::new())
        .map_err(|error| PageError::Answer(error.to_string()))?;
    let response = host.send(request, LIMITS).await?;
    if !response.status().is_success() {
        return Err(PageError::Answer(response.status().to_string()));
    }
    serde_json::from_slice(response.body()).map_err(|error| PageError::Answer(error.to_string()))
}

/// The reason why a page is not available.
#[derive(Debug, Error)]
pub(crate) enum PageError {
    #[error(transparent)]
    Http(#[from] RequestError),
    #[error("the answer was not understood: {0}")]
    Answer(String),
}

const LIMITS: HttpLimits = HttpLimits {
    within: Duration::from_secs(2),
    most: 1024 * 1024,
};

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    use super::*;
    use crate::stage::hops::{BridgeHop, BridgeStatus};

    async fn answered(answer: &'static str) -> Result<BridgeStatus, PageError> {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let serve = async {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut request = [0; 1024];
            let read = stream.read(&mut request).await.unwrap();
            assert!(request[..read].starts_with(b"GET /status HTTP/1.1\r\n"));
            stream.write_all(answer.as_bytes()).await.unwrap();
        };
        tokio::join!(fetch(port), serve).0
    }

    #[tokio::test]
    async fn the_hops_are_read_from_the_page_and_the_rest_is_left() {
        let page = "HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n\
            {\"program\":\"bridge-ros1\",\"hops\":{\"out\":{\"count\":3,\"negative\":0,\
            \"p50_us\":1.5,\"p99_us\":2.5,\"max_us\":3.5}}}";
        let status = answered(page).await.unwrap();
        let hop = BridgeHop {
            p50_us: 1.5,
            p99_us: 2.5,
            max_us: 3.5,
            count: 3,
        };
        assert_eq!(status.hops.get("out"), Some(&hop));
    }

    #[tokio::test]
    async fn a_page_that_is_not_there_is_an_error() {
        let page = "HTTP/1.1 404 Not Found\r\ncontent-length: 0\r\n\r\n";
        assert!(matches!(answered(page).await, Err(PageError::Answer(_))));
        assert!(matches!(answered("").await, Err(PageError::Http(_))));
    }
}
