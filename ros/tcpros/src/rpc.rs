//! XML-RPC over HTTP, client and server, with a time limit on every operation.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt, Full, Limited};
use http_client::{Connection, HttpError};
use hyper::body::{Body, Incoming};
use hyper::header::{CONTENT_TYPE, HOST, HeaderValue};
use hyper::service::service_fn;
use hyper::{Method, Request, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use thiserror::Error;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::crowd::{ConnectionAdmission, ConnectionLimits, Crowd};
use crate::events;
use crate::xmlrpc::{
    MethodCall, MethodResponse, XmlError, XmlRpcFault, XmlRpcValue, encode_response, parse_response,
};

/// Address of an XML-RPC server.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(crate) struct RpcEndpoint {
    host: String,
    port: u16,
    path: String,
    ipv6_first: bool,
}

impl RpcEndpoint {
    /// Parses `http://host:port[/path]`.
    pub(crate) fn parse(uri: &str) -> Option<Self> {
        let (host, port, path) = parts(uri, "http://")?;
        Some(Self {
            host: host.to_owned(),
            port,
            path: path.to_owned(),
            ipv6_first: false,
        })
    }

    /// Selects whether the IPv6 addresses of the host are tried before the other addresses.
    pub(crate) const fn ipv6_first(mut self, ipv6_first: bool) -> Self {
        self.ipv6_first = ipv6_first;
        self
    }

    pub(crate) const fn prefers_ipv6(&self) -> bool {
        self.ipv6_first
    }
}

/// Returns a host as written before a port: an IPv6 address in brackets.
pub(crate) fn bracketed(host: &str) -> String {
    if host.contains(':') {
        format!("[{host}]")
    } else {
        host.to_owned()
    }
}

/// Returns host, port and path of a URI of this scheme.
pub(crate) fn parts<'a>(uri: &'a str, scheme: &str) -> Option<(&'a str, u16, &'a str)> {
    let rest = uri.trim().strip_prefix(scheme)?;
    let (authority, path) = rest.find('/').map_or((rest, "/"), |at| rest.split_at(at));
    let (host, port) = authority.rsplit_once(':')?;
    let host = host
        .strip_prefix('[')
        .and_then(|h| h.strip_suffix(']'))
        .unwrap_or(host);
    let plain = |text: &str| text.bytes().all(|b| b.is_ascii_graphic());
    if host.is_empty() || !plain(host) || !plain(path) {
        return None;
    }
    Some((host, port.parse().ok()?, path))
}

/// Calls a method and waits for its result at most `limit`.
pub(crate) async fn call(
    endpoint: &RpcEndpoint,
    method: &str,
    params: Vec<XmlRpcValue>,
    limit: Duration,
) -> Result<XmlRpcValue, RpcError> {
    read(&fetch(endpoint, method, params, limit).await?)
}

/// Calls a method as [`call`] does, and returns the document of its result for [`read`].
pub(crate) async fn fetch(
    endpoint: &RpcEndpoint,
    method: &str,
    params: Vec<XmlRpcValue>,
    limit: Duration,
) -> Result<Bytes, RpcError> {
    let body = MethodCall {
        method: method.to_owned(),
        params,
    }
    .encode();
    let exchange = Box::pin(exchange(endpoint, body));
    timeout(limit, exchange)
        .await
        .map_err(|_| RpcError::Timeout(limit))?
}

/// Reads the result of a call.
pub(crate) fn read(document: &[u8]) -> Result<XmlRpcValue, RpcError> {
    Ok(parse_response(document)??)
}

async fn exchange(endpoint: &RpcEndpoint, body: String) -> Result<Bytes, RpcError> {
    let stream = connect(&endpoint.host, endpoint.port, endpoint.ipv6_first)
        .await
        .map_err(RpcError::Connect)?;
    let host = format!("{}:{}", bracketed(&endpoint.host), endpoint.port);
    let request = Request::post(&endpoint.path)
        .header(HOST, host)
        .header(CONTENT_TYPE, XML)
        .header("Connection", "close")
        .body(Bytes::from(body))
        .map_err(|_| RpcError::Uri)?;
    let connection = Connection::open(stream).await?;
    let response = connection.send(request, MAX_BODY).await?;
    match response.status() {
        StatusCode::OK => Ok(response.into_body()),
        status => Err(RpcError::Status(status.as_u16())),
    }
}

/// Connects without Nagle's algorithm. The IPv4 addresses of a name are tried first unless IPv6 is
/// configured, because ROS 1 peers listen on IPv4 by default.
pub(crate) async fn connect(host: &str, port: u16, ipv6_first: bool) -> std::io::Result<TcpStream> {
    let mut addresses: Vec<SocketAddr> = tokio::net::lookup_host((host, port)).await?.collect();
    addresses.sort_by_key(|address| address.is_ipv6() != ipv6_first);
    let stream = TcpStream::connect(addresses.as_slice()).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Serves calls on a listener until it is dropped. The handler must not wait: it runs in the
/// connection's task.
///
/// A call takes milliseconds, so a new connection is always admitted. Beyond the limit the oldest
/// connection is closed; its caller makes a new connection for its next call.
pub(crate) async fn serve<H>(listener: TcpListener, places: ConnectionLimits, handler: H)
where
    H: Fn(MethodCall) -> MethodResponse + Send + Sync + 'static,
{
    let handler = Arc::new(handler);
    let mut crowd = Crowd::new(places);
    // Dropping the set ends the connections with the server.
    let mut connections = JoinSet::new();
    let mut refusals = events::Refusals::new("XML-RPC");
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            Some(_) = connections.join_next() => continue,
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                refusals.accept_failed(&error).await;
                continue;
            }
        };
        let handler = Arc::clone(&handler);
        let admission = crowd.admit(peer.ip(), |_| {
            connections.spawn(answer_connection(stream, handler))
        });
        match admission {
            ConnectionAdmission::Free => {}
            ConnectionAdmission::InPlaceOf(address) => refusals.gave_way(address),
            ConnectionAdmission::Full(limit) => refusals.too_many(limit),
        }
    }
}

async fn answer_connection<H>(stream: TcpStream, handler: Arc<H>)
where
    H: Fn(MethodCall) -> MethodResponse + Send + Sync + 'static,
{
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%error, "an XML-RPC client disconnected at once");
        return;
    }
    let service = service_fn(move |request| answer(request, Arc::clone(&handler)));
    let served = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(READ_LIMIT)
        // Old versions of XmlRpc++ search for `Content-length` in various cases.
        .title_case_headers(true)
        .serve_connection(TokioIo::new(stream), service)
        .await;
    if let Err(error) = served {
        tracing::debug!(%error, "dropped an XML-RPC client");
    }
}

async fn answer<H>(
    request: Request<Incoming>,
    handler: Arc<H>,
) -> Result<hyper::Response<Full<Bytes>>, std::convert::Infallible>
where
    H: Fn(MethodCall) -> MethodResponse + Send + Sync + 'static,
{
    if request.method() != Method::POST {
        return Ok(plain(StatusCode::METHOD_NOT_ALLOWED));
    }
    if usize::try_from(request.body().size_hint().lower()).map_or(true, |size| size > MAX_BODY) {
        return Ok(plain(StatusCode::PAYLOAD_TOO_LARGE));
    }
    let body = Limited::new(request.into_body(), MAX_BODY).collect();
    let document = match timeout(READ_LIMIT, body).await {
        Ok(Ok(body)) => body.to_bytes(),
        Ok(Err(error)) if error.is::<http_body_util::LengthLimitError>() => {
            return Ok(plain(StatusCode::PAYLOAD_TOO_LARGE));
        }
        Ok(Err(_)) => return Ok(plain(StatusCode::BAD_REQUEST)),
        Err(_) => return Ok(plain(StatusCode::REQUEST_TIMEOUT)),
    };
    let response = match MethodCall::parse(&document) {
        Ok(call) => handler(call),
        Err(error) => Err(XmlRpcFault {
            code: -1,
            message: format!("malformed call: {error}"),
        }),
    };
    let mut reply = hyper::Response::new(Full::new(Bytes::from(encode_response(&response))));
    reply
        .headers_mut()
        .insert(CONTENT_TYPE, HeaderValue::from_static(XML));
    Ok(reply)
}

fn plain(status: StatusCode) -> hyper::Response<Full<Bytes>> {
    let mut response = hyper::Response::new(Full::default());
    *response.status_mut() = status;
    response
}

/// Error of a call.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RpcError {
    /// The URI of the server is not `http://host:port`.
    #[error("the URI is not http://host:port")]
    Uri,
    /// No server listens at the address, or the name does not resolve.
    #[error("no connection: {0}")]
    Connect(#[source] std::io::Error),
    /// No response in time.
    #[error("no response within {0:?}")]
    Timeout(Duration),
    /// The peer does not use HTTP, or stopped midway.
    #[error("HTTP failed: {0}")]
    Http(#[source] hyper::Error),
    /// The body of the response was not received or is longer than 4 MiB.
    #[error("cannot read the response: {0}")]
    Body(String),
    /// A status other than 200.
    #[error("HTTP status {0}")]
    Status(u16),
    /// The response is not XML-RPC.
    #[error("the response is not XML-RPC: {0}")]
    Xml(#[from] XmlError),
    /// The method failed at the peer.
    #[error(transparent)]
    Fault(#[from] XmlRpcFault),
}

impl From<HttpError> for RpcError {
    fn from(error: HttpError) -> Self {
        match error {
            HttpError::Exchange(error) => Self::Http(error),
            HttpError::Body(error) => Self::Body(error.to_string()),
        }
    }
}

const XML: &str = "text/xml";
const MAX_BODY: usize = 4 * 1024 * 1024;
/// Time limit for the header of a call, from the previous call on a persistent connection, and for
/// its body.
const READ_LIMIT: Duration = Duration::from_secs(5);

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    use super::*;

    async fn echo_server() -> (u16, JoinSet<()>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        let mut tasks = JoinSet::new();
        let places = ConnectionLimits {
            total: 4,
            per_address: 2,
        };
        tasks.spawn(serve(listener, places, |call| {
            Ok(XmlRpcValue::Array(call.params))
        }));
        (port, tasks)
    }

    fn endpoint(port: u16) -> RpcEndpoint {
        RpcEndpoint::parse(&format!("http://127.0.0.1:{port}/")).unwrap()
    }

    async fn raw(port: u16, request: &str) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        let read = stream.read_to_string(&mut answer);
        timeout(Duration::from_secs(5), read)
            .await
            .expect("the connection stays open")
            .unwrap();
        answer
    }

    #[test]
    fn an_endpoint_is_host_and_port() {
        let parsed = RpcEndpoint::parse("http://robot.local:4711/RPC2").unwrap();
        assert_eq!(
            (parsed.host.as_str(), parsed.port, parsed.path.as_str()),
            ("robot.local", 4711, "/RPC2")
        );
        assert_eq!(RpcEndpoint::parse("http://[::1]:1").unwrap().host, "::1");
        for bad in [
            "robot:1",
            "http://robot",
            "http://:1",
            "https://a:1",
            "http://a:70000",
            "http://a b:1",
        ] {
            assert_eq!(RpcEndpoint::parse(bad), None, "{bad}");
        }
    }

    #[tokio::test]
    async fn a_call_comes_back() {
        let (port, _tasks) = echo_server().await;
        let params = vec![XmlRpcValue::Int(1), "<&>".into()];
        let result = call(&endpoint(port), "echo", params.clone(), READ_LIMIT)
            .await
            .unwrap();
        assert_eq!(result, XmlRpcValue::Array(params));
    }

    #[tokio::test]
    async fn a_caller_of_http_1_0_is_answered_and_the_connection_closed() {
        let (port, _tasks) = echo_server().await;
        let body = MethodCall {
            method: "m".to_owned(),
            params: vec![],
        }
        .encode();
        let request = format!(
            "POST /RPC2 HTTP/1.0\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        );
        let answer = raw(port, &request).await;
        assert!(answer.starts_with("HTTP/1.0 200"), "{answer}");
        assert!(answer.contains("<methodResponse>"), "{answer}");
    }

    #[tokio::test]
    async fn a_caller_that_asks_to_close_is_not_left_hanging() {
        let (port, _tasks) = echo_server().await;
        let body = "garbage";
        let request = format!(
            "POST / HTTP/1.1\r\nHost: x\r\nConnection: close\r\nContent-Length: 7\r\n\r\n{body}"
        );
        let answer = raw(port, &request).await;
        assert!(
            answer.contains("<fault>") && answer.contains("malformed call"),
            "{answer}"
        );
    }

    #[tokio::test]
    async fn a_body_past_the_limit_and_a_get_are_refused() {
        let (port, _tasks) = echo_server().await;
        let answer = raw(
            port,
            "POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 99999999\r\nConnection: close\r\n\r\n",
        )
        .await;
        assert!(answer.starts_with("HTTP/1.1 413"), "{answer}");
        let answer = raw(
            port,
            "GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n",
        )
        .await;
        assert!(answer.starts_with("HTTP/1.1 405"), "{answer}");
    }

    #[test]
    fn an_ipv6_address_stands_in_brackets_before_its_port() {
        assert_eq!(bracketed("::1"), "[::1]");
        assert_eq!(bracketed("127.0.0.1"), "127.0.0.1");
        assert_eq!(bracketed("robot"), "robot");
    }

    #[tokio::test]
    async fn callers_that_say_nothing_keep_no_other_waiting() {
        let (port, _tasks) = echo_server().await;
        let mut silent = Vec::new();
        for n in 0..20 {
            let mut stream = TcpStream::connect(("127.0.0.1", port)).await.unwrap();
            let half = "POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n<";
            stream.write_all(&half.as_bytes()[..2 * n]).await.unwrap();
            silent.push(stream);
        }
        let limit = Duration::from_secs(2);
        let result = call(&endpoint(port), "echo", vec![XmlRpcValue::Int(1)], limit).await;
        assert_eq!(
            result.unwrap(),
            XmlRpcValue::Array(vec![XmlRpcValue::Int(1)])
        );
    }

    #[tokio::test]
    async fn a_server_that_never_answers_ends_in_a_timeout() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let silent = endpoint(listener.local_addr().unwrap().port());
        let result = call(&silent, "m", vec![], Duration::from_millis(50)).await;
        assert!(matches!(result, Err(RpcError::Timeout(_))));
    }
}
