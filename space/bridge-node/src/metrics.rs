//! The HTTP pages with counters, delays and readiness.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, oneshot};
use tokio::task::AbortHandle;
use tracing::{debug, info};

use crate::clock;
use crate::exit::{Failure, FailureKind};

/// The state of a program at one moment, as the pages show it.
pub trait Told: Send + 'static {
    /// Returns a JSON object, for /status.
    fn json(&self) -> String;

    /// Returns the text exposition format of Prometheus, version 0.0.4, for /metrics.
    fn prometheus(&self) -> String;

    /// Returns the reasons why the program is not ready, a line each; empty if it is ready. For
    /// /readyz.
    fn not_ready(&self) -> Vec<String>;

    /// Returns the peers that the program waits for, a line each. The program is ready without
    /// them. For /readyz.
    fn waiting_for(&self) -> Vec<String> {
        Vec::new()
    }
}

/// The run loops that answer requests, in the order of their spaces.
type Ask<T> = Arc<[mpsc::Sender<oneshot::Sender<T>>]>;
/// The receiver of a run loop: each request carries the sender for its response.
pub type Requests<T> = mpsc::Receiver<oneshot::Sender<T>>;

/// Returns a receiver without requests.
pub(crate) fn never<T>() -> Requests<T> {
    mpsc::channel(1).1
}

/// Listens at `address` for requests to [`Told`] pages. Without an address there are no requests.
///
/// # Errors
/// The address cannot be bound.
pub async fn serve_pages<T: Told>(address: Option<SocketAddr>) -> Result<Requests<T>, Failure> {
    let requests = serve(address, 1).await?.pop();
    Ok(requests.unwrap_or_else(never))
}

/// Listens at `address` and returns the receivers of requests for `loops` run loops. Without an
/// address there are no requests.
pub(crate) async fn serve<T: Told>(
    address: Option<SocketAddr>,
    loops: usize,
) -> Result<Vec<Requests<T>>, Failure> {
    let (ask, mut requests): (Vec<_>, Vec<_>) = (0..loops).map(|_| mpsc::channel(4)).unzip();
    // The caller pops from the end; responses have to be in the order of the spaces.
    requests.reverse();
    let Some(address) = address else {
        return Ok(requests);
    };
    let listener = TcpListener::bind(address).await.map_err(|error| {
        Failure::new(
            FailureKind::Unavailable,
            format!("cannot serve metrics at {address}: {error}; give another --metrics address"),
        )
    })?;
    let at = listener.local_addr().unwrap_or(address);
    info!(
        "metrics at http://{at}/metrics, status at http://{at}/status, readiness at http://{at}/readyz"
    );
    tokio::spawn(accept(listener, ask.into()));
    Ok(requests)
}

async fn accept<T: Told>(listener: TcpListener, ask: Ask<T>) {
    let mut crowd = Crowd::default();
    loop {
        let (stream, peer) = tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok(accepted) => accepted,
                // The process is probably out of descriptors; others may be closed after the pause.
                Err(error) => {
                    debug!(%error, "a connection for metrics was not accepted");
                    tokio::time::sleep(ACCEPT_AGAIN).await;
                    continue;
                }
            },
            () = all_closed(&ask) => return,
        };
        let ask = Arc::clone(&ask);
        let task = tokio::spawn(async move {
            if tokio::time::timeout(CONNECTION_TIME, answer(stream, ask))
                .await
                .is_err()
            {
                debug!("a connection for metrics was closed for its age");
            }
        });
        crowd.admit(peer.ip(), task.abort_handle());
    }
}

/// The open connections, oldest first. A new connection is always admitted: at the limit the oldest
/// connection is closed, from the same address if that address has reached its share. A request
/// takes milliseconds, so an old connection is idle.
#[derive(Debug, Default)]
struct Crowd {
    open: VecDeque<(IpAddr, AbortHandle)>,
}

impl Crowd {
    fn admit(&mut self, address: IpAddr, task: AbortHandle) {
        self.open.retain(|(_, task)| !task.is_finished());
        let same = |(from, _): &&(IpAddr, AbortHandle)| *from == address;
        let has_share = self.open.iter().filter(same).count() >= MAX_PER_ADDRESS;
        if has_share || self.open.len() >= MAX_CONNECTIONS {
            let oldest = self
                .open
                .iter()
                .position(|(from, _)| !has_share || *from == address);
            if let Some((from, task)) = oldest.and_then(|at| self.open.remove(at)) {
                debug!(%from, "a connection for metrics gave way to another");
                task.abort();
            }
        }
        self.open.push_back((address, task));
    }
}

async fn all_closed<T>(ask: &Ask<T>) {
    for ask in ask.iter() {
        ask.closed().await;
    }
}

async fn answer<T: Told>(stream: TcpStream, ask: Ask<T>) {
    let service = service_fn(|request| {
        let ask = Arc::clone(&ask);
        async move { Ok::<_, Infallible>(page(&request, &ask).await) }
    });
    let served = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .serve_connection(TokioIo::new(stream), service)
        .await;
    if let Err(error) = served {
        debug!(%error, "a connection for metrics broke off");
    }
}

async fn page<T: Told>(request: &Request<Incoming>, ask: &Ask<T>) -> Response<Full<Bytes>> {
    let page = match request.uri().path() {
        "/metrics" => Page::Metrics,
        "/status" => Page::Status,
        "/readyz" => Page::Ready,
        _ => {
            return text(
                StatusCode::NOT_FOUND,
                "there are /metrics, /status and /readyz here\n".into(),
            );
        }
    };
    let mut all = Vec::with_capacity(ask.len());
    for ask in ask.iter() {
        let (reply, status) = oneshot::channel();
        if ask.send(reply).await.is_ok()
            && let Ok(status) = status.await
        {
            all.push(status);
        }
    }
    if all.is_empty() || (page == Page::Ready && all.len() < ask.len()) {
        let ending = "the program is ending\n".to_owned();
        return text(StatusCode::SERVICE_UNAVAILABLE, ending);
    }
    match page {
        Page::Metrics => text(
            StatusCode::OK,
            all.iter().map(T::prometheus).collect::<String>(),
        ),
        Page::Ready => {
            let clock = clock::fault(clock::now().utc).map(|fault| format!("{fault}\n"));
            let reasons: String = clock
                .into_iter()
                .chain(all.iter().flat_map(T::not_ready))
                .collect();
            let waiting: String = all.iter().flat_map(T::waiting_for).collect();
            if reasons.is_empty() {
                text(StatusCode::OK, format!("ready\n{waiting}"))
            } else {
                text(StatusCode::SERVICE_UNAVAILABLE, reasons + &waiting)
            }
        }
        Page::Status => match all.as_slice() {
            [only] if ask.len() == 1 => text(StatusCode::OK, only.json()),
            all => {
                let each: Vec<String> = all.iter().map(T::json).collect();
                text(StatusCode::OK, format!("[{}]", each.join(",")))
            }
        },
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Page {
    Metrics,
    Status,
    Ready,
}

fn text(status: StatusCode, body: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::from(body)));
    *response.status_mut() = status;
    response
}

const MAX_CONNECTIONS: usize = 16;
const MAX_PER_ADDRESS: usize = 8;
const HEADER_TIME: Duration = Duration::from_secs(5);
const CONNECTION_TIME: Duration = Duration::from_secs(10);
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpSocket;

    use super::*;
    use crate::status::Status;

    /// Serves pages without run loops. Returns the address, and the receiver that keeps the server
    /// running.
    async fn served() -> (SocketAddr, Requests<Status>) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let (ask, requests) = mpsc::channel(1);
        tokio::spawn(accept(listener, [ask].into()));
        (address, requests)
    }

    async fn connect(from: &str, to: SocketAddr) -> TcpStream {
        let socket = TcpSocket::new_v4().unwrap();
        socket
            .bind(SocketAddr::new(from.parse().unwrap(), 0))
            .unwrap();
        socket.connect(to).await.unwrap()
    }

    async fn status(stream: &mut TcpStream) -> String {
        let asked = async {
            stream
                .write_all(b"GET /nothing HTTP/1.0\r\n\r\n")
                .await
                .unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).await.unwrap();
            answer.lines().next().unwrap_or_default().to_owned()
        };
        let limit = Duration::from_secs(3);
        let answer = tokio::time::timeout(limit, asked).await;
        answer.unwrap_or_else(|_| format!("no answer within {limit:?}"))
    }

    #[tokio::test]
    async fn idle_connections_keep_nobody_waiting() {
        let (address, _requests) = served().await;
        let mut idle = Vec::new();
        for _ in 0..3 * MAX_CONNECTIONS {
            idle.push(connect("127.0.0.1", address).await);
        }
        let mut late = connect("127.0.0.1", address).await;
        assert_eq!(status(&mut late).await, "HTTP/1.0 404 Not Found");
    }

    #[tokio::test]
    async fn one_address_does_not_push_out_another() {
        let (address, _requests) = served().await;
        let mut early = connect("127.0.0.2", address).await;
        let mut idle = Vec::new();
        for _ in 0..3 * MAX_CONNECTIONS {
            idle.push(connect("127.0.0.1", address).await);
        }
        // The response to the last connection shows that all of them were accepted.
        assert_eq!(
            status(&mut idle.pop().unwrap()).await,
            "HTTP/1.0 404 Not Found"
        );
        assert_eq!(status(&mut early).await, "HTTP/1.0 404 Not Found");
    }
}
