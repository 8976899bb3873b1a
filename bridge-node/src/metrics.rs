//! The HTTP page with counters and delays.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use http_body_util::Full;
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc, oneshot};
use tracing::{debug, info};

use crate::exit::{Failure, FailureKind};
use crate::status::Status;

/// The run loops that answer, in the order of their spaces.
type Ask = Arc<[mpsc::Sender<oneshot::Sender<Status>>]>;
/// A run loop's end: each request brings the place for its answer.
pub(crate) type Requests = mpsc::Receiver<oneshot::Sender<Status>>;

/// The requests of nobody.
pub(crate) fn never() -> Requests {
    mpsc::channel(1).1
}

/// Listens at `address` and gives each of so many run loops its requests to answer. Without an address there are
/// never any.
pub(crate) async fn serve(
    address: Option<SocketAddr>,
    loops: usize,
) -> Result<Vec<Requests>, Failure> {
    let (ask, mut requests): (Vec<_>, Vec<_>) = (0..loops).map(|_| mpsc::channel(4)).unzip();
    // The last is taken first; answers are to be in the order of the spaces.
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
    info!("metrics at http://{at}/metrics, status at http://{at}/status");
    tokio::spawn(accept(listener, ask.into()));
    Ok(requests)
}

async fn accept(listener: TcpListener, ask: Ask) {
    let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
    loop {
        let Ok(place) = Arc::clone(&places).acquire_owned().await else {
            return;
        };
        let stream = tokio::select! {
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => stream,
                // Out of descriptors, most likely: others may be closed by then.
                Err(error) => {
                    debug!(%error, "a connection for metrics was not accepted");
                    tokio::time::sleep(ACCEPT_AGAIN).await;
                    continue;
                }
            },
            () = all_closed(&ask) => return,
        };
        let ask = Arc::clone(&ask);
        tokio::spawn(async move {
            if tokio::time::timeout(CONNECTION_TIME, answer(stream, ask))
                .await
                .is_err()
            {
                debug!("a connection for metrics was closed for its age");
            }
            drop(place);
        });
    }
}

async fn all_closed(ask: &Ask) {
    for ask in ask.iter() {
        ask.closed().await;
    }
}

async fn answer(stream: TcpStream, ask: Ask) {
    let service = service_fn(|request| {
        let ask = Arc::clone(&ask);
        async move { Ok::<_, Infallible>(page(&request, &ask).await) }
    });
    let served = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(CONNECTION_TIME)
        .serve_connection(TokioIo::new(stream), service)
        .await;
    if let Err(error) = served {
        debug!(%error, "a connection for metrics broke off");
    }
}

async fn page(request: &Request<Incoming>, ask: &Ask) -> Response<Full<Bytes>> {
    let json = match request.uri().path() {
        "/metrics" => false,
        "/status" => true,
        _ => {
            return text(
                StatusCode::NOT_FOUND,
                "there are /metrics and /status here\n".into(),
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
    match all.as_slice() {
        [] => text(
            StatusCode::SERVICE_UNAVAILABLE,
            "the program is ending\n".into(),
        ),
        all if !json => text(
            StatusCode::OK,
            all.iter().map(Status::prometheus).collect::<String>(),
        ),
        [only] if ask.len() == 1 => text(StatusCode::OK, only.json()),
        all => {
            let each: Vec<String> = all.iter().map(Status::json).collect();
            text(StatusCode::OK, format!("[{}]", each.join(",")))
        }
    }
}

fn text(status: StatusCode, body: String) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(Bytes::from(body)));
    *response.status_mut() = status;
    response
}

const MAX_CONNECTIONS: usize = 16;
const CONNECTION_TIME: Duration = Duration::from_secs(30);
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
