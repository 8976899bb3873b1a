//! The HTTP pages with counters, delays and readiness.

mod parts;

use std::collections::VecDeque;
use std::convert::Infallible;
use std::fmt;
use std::io;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock, PoisonError, RwLock};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::combinators::UnsyncBoxBody;
use http_body_util::{BodyExt as _, Full};
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, oneshot};
use tokio::task::AbortHandle;
use tracing::{debug, info};

pub use self::parts::{Ask, RunLoops, loops};
use self::parts::{PageAnswers, PageParts, ShownPart};
use crate::clock::fault_of_host;
use crate::exit::{Failure, FailureKind};

/// The state of a program at one moment, as the pages show it.
pub trait PageState: Send + 'static {
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

/// A future of a trait object.
pub type BoxFuture<T> = Pin<Box<dyn Future<Output = T> + Send>>;
/// The body of a page.
pub type PageBody = UnsyncBoxBody<Bytes, Infallible>;
/// Requests the status of each run loop, as `/status` has it.
pub type Statuses = Arc<dyn Fn() -> BoxFuture<Vec<String>> + Send + Sync>;

/// Pages that a program serves beside its status. The thread of the run loops serves them, so a
/// page leaves longer work to a thread of its own.
pub trait Site: Send + Sync + 'static {
    /// Receives the access to the status of the program, before the first request.
    fn start(&self, statuses: Statuses);

    /// Answers a request for a path that is none of the status pages.
    fn answer(
        self: Arc<Self>,
        request: Request<Incoming>,
        visit: Visit,
    ) -> BoxFuture<Response<PageBody>>;

    /// Describes the pages at an address, for the log.
    fn describe(&self, at: SocketAddr) -> String;
}

/// A page with the newest events of the run loops.
pub trait LivePage: Send + Sync + 'static {
    /// Returns the path, as `/tap`.
    fn path(&self) -> &'static str;

    /// Answers a query of a client at an address.
    fn answer(&self, query: &str, peer: SocketAddr) -> LiveAnswer;
}

/// The response of a [`LivePage`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LiveAnswer {
    /// The status code.
    pub status: StatusCode,
    /// The body, as text or JSON.
    pub body: String,
    /// Whether each run loop is to wake up, and to record events, before the response is sent.
    pub wakes: bool,
}

impl LiveAnswer {
    /// Returns a response that needs no run loop.
    #[must_use]
    pub const fn new(status: StatusCode, body: String) -> Self {
        Self {
            status,
            body,
            wakes: false,
        }
    }
}

/// A stream of a connection, such as a TLS stream.
pub trait Stream: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> Stream for S {}

/// Secures a connection, such as by a TLS handshake.
pub type Secure = Arc<dyn Fn(TcpStream) -> BoxFuture<io::Result<Box<dyn Stream>>> + Send + Sync>;

/// The connection of a request.
#[derive(Debug, Clone)]
pub struct Visit {
    /// The address of the client.
    pub peer: SocketAddr,
    /// Whether the connection is secured.
    pub is_secure: bool,
    is_long: Arc<AtomicBool>,
}

impl From<SocketAddr> for Visit {
    /// Returns a connection from an address without security.
    fn from(peer: SocketAddr) -> Self {
        Self {
            peer,
            is_secure: false,
            is_long: Arc::default(),
        }
    }
}

impl Visit {
    /// Keeps the connection open for longer than a request takes: for a stream of events, or for a
    /// request that waits for other programs.
    pub fn keep_open(&self) {
        self.is_long.store(true, Ordering::Relaxed);
    }
}

/// Returns a body that is complete.
#[must_use]
pub fn full(bytes: impl Into<Bytes>) -> PageBody {
    Full::new(bytes.into()).boxed_unsync()
}

/// The receiver of a run loop: each request carries the sender for its response.
pub type Requests<T> = mpsc::Receiver<oneshot::Sender<T>>;

/// Returns a receiver without requests.
#[must_use]
pub fn never<T>() -> Requests<T> {
    mpsc::channel(1).1
}

/// Listens at `address` for requests to [`PageState`] pages. Without an address there are no
/// requests.
///
/// # Errors
/// The address cannot be bound.
pub async fn serve_pages<T: PageState>(
    address: Option<SocketAddr>,
) -> Result<Requests<T>, Failure> {
    let pages = Pages::alone("", None);
    let RunLoops { asks, mut requests } = loops(1);
    pages.run("", asks);
    pages.listen(address).await?;
    Ok(requests.pop().unwrap_or_else(never))
}

/// The pages of the programs of a process.
pub struct Pages<T> {
    parts: PageParts<T>,
    /// Answers further paths.
    site: Arc<RwLock<Option<Arc<dyn Site>>>>,
    /// The newest events of the run loops.
    live: Option<Arc<dyn LivePage>>,
    /// The address of the pages, while they are served.
    at: OnceLock<SocketAddr>,
    /// Whether the pages outlive their programs, which may be started again.
    is_cell: bool,
}

impl<T> fmt::Debug for Pages<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pages")
            .field("parts", &self.parts)
            .field("at", &self.at)
            .finish_non_exhaustive()
    }
}

impl<T: PageState> Pages<T> {
    /// Returns the pages of a program that does not run yet. They end with its run loops.
    #[must_use]
    pub fn alone(program: &'static str, live: Option<Arc<dyn LivePage>>) -> Self {
        Self {
            parts: PageParts::new(&[program]),
            site: Arc::default(),
            live,
            at: OnceLock::new(),
            is_cell: false,
        }
    }

    /// Returns the pages of programs that do not run yet, and that may be started again.
    #[must_use]
    pub fn of_cell(programs: &[&'static str], live: Arc<dyn LivePage>) -> Self {
        Self {
            parts: PageParts::new(programs),
            is_cell: true,
            ..Self::alone("", Some(live))
        }
    }

    /// Notes that a program runs with these run loops.
    pub fn run(&self, program: &str, asks: Vec<Ask<T>>) {
        self.parts.run(program, asks);
    }

    /// Notes that a program does not run, for this reason.
    pub fn down(&self, program: &str, why: String) {
        self.parts.down(program, why);
    }

    /// Listens at `address`. Without an address there are no requests.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn listen(&self, address: Option<SocketAddr>) -> Result<(), Failure> {
        let Some(address) = address else {
            return Ok(());
        };
        let listener = TcpListener::bind(address).await.map_err(|error| {
            Failure::new(
                FailureKind::Unavailable,
                format!(
                    "cannot serve metrics at {address}: {error}; give another --metrics address"
                ),
            )
        })?;
        let at = listener.local_addr().unwrap_or(address);
        info!(
            "metrics at http://{at}/metrics, status at http://{at}/status, readiness at http://{at}/readyz"
        );
        // The pages listen once.
        let _first = self.at.set(at);
        let served = Served {
            parts: self.parts.clone(),
            site: Arc::clone(&self.site),
            live: self.live.clone(),
            is_cell: self.is_cell,
        };
        drop(tokio::spawn(serve_all(listener, served)));
        Ok(())
    }

    /// Lets a site answer further paths, if the pages are served.
    pub fn show(&self, site: Arc<dyn Site>) {
        let Some(at) = self.at.get() else {
            return;
        };
        info!("{}", site.describe(*at));
        let parts = self.parts.clone();
        site.start(Arc::new(move || {
            let parts = parts.clone();
            Box::pin(async move {
                let shown = parts.answers().await.shown;
                shown.iter().map(ShownPart::json).collect()
            })
        }));
        *self.site.write().unwrap_or_else(PoisonError::into_inner) = Some(site);
    }
}

/// Serves all pages until the run loops end; in a cell, until the program ends.
async fn serve_all<T: PageState>(listener: TcpListener, served: Served<T>) {
    let (parts, is_cell) = (served.parts.clone(), served.is_cell);
    let respond = move |request, visit| -> BoxFuture<_> {
        let served = served.clone();
        Box::pin(page(request, served, visit))
    };
    tokio::select! {
        () = accept(listener, None, Arc::new(respond)) => {}
        () = parts.all_closed(), if !is_cell => {}
    }
}

/// Serves the pages of `site` alone at a further address, over connections that `secure` secures,
/// until the program ends.
///
/// # Errors
/// The address cannot be bound.
pub async fn serve_secure(
    address: SocketAddr,
    site: Arc<dyn Site>,
    secure: Secure,
) -> io::Result<SocketAddr> {
    let listener = TcpListener::bind(address).await?;
    let at = listener.local_addr().unwrap_or(address);
    let respond = move |request, visit| Arc::clone(&site).answer(request, visit);
    drop(tokio::spawn(accept(
        listener,
        Some(secure),
        Arc::new(respond),
    )));
    Ok(at)
}

/// Answers the requests of a listener.
type Respond = dyn Fn(Request<Incoming>, Visit) -> BoxFuture<Response<PageBody>> + Send + Sync;

/// The sources of the pages.
struct Served<T> {
    parts: PageParts<T>,
    site: Arc<RwLock<Option<Arc<dyn Site>>>>,
    live: Option<Arc<dyn LivePage>>,
    is_cell: bool,
}

impl<T> Served<T> {
    fn site(&self) -> Option<Arc<dyn Site>> {
        let site = self.site.read();
        site.unwrap_or_else(PoisonError::into_inner).clone()
    }
}

impl<T> Clone for Served<T> {
    fn clone(&self) -> Self {
        Self {
            parts: self.parts.clone(),
            site: Arc::clone(&self.site),
            live: self.live.clone(),
            is_cell: self.is_cell,
        }
    }
}

/// Accepts connections until the runtime ends.
async fn accept(listener: TcpListener, secure: Option<Secure>, respond: Arc<Respond>) {
    let mut crowd = Crowd::default();
    loop {
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            // The process is probably out of descriptors; others may be closed after the pause.
            Err(error) => {
                debug!(%error, "cannot accept a connection for metrics");
                tokio::time::sleep(ACCEPT_AGAIN).await;
                continue;
            }
        };
        let (secure, respond) = (secure.clone(), Arc::clone(&respond));
        let visit = Visit {
            is_secure: secure.is_some(),
            ..Visit::from(peer)
        };
        let is_long = Arc::clone(&visit.is_long);
        let task = tokio::spawn(async move {
            let is_long = Arc::clone(&visit.is_long);
            let answered = async move {
                match secure {
                    None => answer(stream, respond, visit).await,
                    Some(secure) => match secure(stream).await {
                        Ok(stream) => answer(stream, respond, visit).await,
                        Err(error) => debug!(%error, "cannot secure a connection"),
                    },
                }
            };
            let mut answered = Box::pin(answered);
            let in_time = tokio::time::timeout(CONNECTION_TIME, &mut answered).await;
            match in_time {
                Ok(()) => {}
                Err(_) if is_long.load(Ordering::Relaxed) => answered.await,
                Err(_) => debug!("closed a connection for metrics after its time limit"),
            }
        });
        crowd.admit(Connection {
            from: peer.ip(),
            task: task.abort_handle(),
            is_long,
        });
    }
}

/// The open connections, oldest first. A new connection is always admitted: at the limit the oldest
/// connection is closed, from the same address if that address has reached its share. A request
/// takes milliseconds, so an old connection is idle. Long connections have limits of their own.
#[derive(Debug, Default)]
struct Crowd {
    open: VecDeque<Connection>,
}

/// An open connection.
#[derive(Debug)]
struct Connection {
    from: IpAddr,
    task: AbortHandle,
    is_long: Arc<AtomicBool>,
}

impl Connection {
    fn is_long(&self) -> bool {
        self.is_long.load(Ordering::Relaxed)
    }
}

impl Crowd {
    fn admit(&mut self, connection: Connection) {
        self.open.retain(|open| !open.task.is_finished());
        let from = connection.from;
        self.make_room(from, false, (MAX_CONNECTIONS, MAX_PER_ADDRESS));
        self.make_room(from, true, (MAX_LONG, MAX_LONG_PER_ADDRESS));
        self.open.push_back(connection);
    }

    /// Closes the oldest connection of a kind if there is no room for another one.
    fn make_room(&mut self, address: IpAddr, long: bool, (most, share): (usize, usize)) {
        let of_kind = |open: &&Connection| open.is_long() == long;
        let all = self.open.iter().filter(of_kind).count();
        let same = self.open.iter().filter(of_kind);
        let has_share = same.filter(|open| open.from == address).count() >= share;
        if !has_share && all < most {
            return;
        }
        let oldest = self
            .open
            .iter()
            .position(|open| open.is_long() == long && (!has_share || open.from == address));
        if let Some(open) = oldest.and_then(|at| self.open.remove(at)) {
            debug!(from = %open.from, "closed a connection for metrics in favour of a new connection");
            open.task.abort();
        }
    }
}

async fn answer(stream: impl Stream + 'static, respond: Arc<Respond>, visit: Visit) {
    let service = service_fn(|request| {
        let responded = respond(request, visit.clone());
        async move { Ok::<_, Infallible>(responded.await) }
    });
    let served = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADER_TIME)
        .max_buf_size(LARGEST_BUFFER)
        .serve_connection(TokioIo::new(stream), service)
        .await;
    if let Err(error) = served {
        debug!(%error, "a connection for metrics failed");
    }
}

async fn page<T: PageState>(
    request: Request<Incoming>,
    served: Served<T>,
    visit: Visit,
) -> Response<PageBody> {
    let page = match request.uri().path() {
        "/metrics" => Page::Metrics,
        "/status" => Page::Status,
        "/readyz" => Page::Ready,
        path => {
            if let Some(live) = served.live.as_ref().filter(|live| live.path() == path) {
                return answered(&request, visit.peer, (&served.parts, live)).await;
            }
            return match served.site() {
                Some(site) => site.answer(request, visit).await,
                None => text(
                    StatusCode::NOT_FOUND,
                    "not found: this server has /metrics, /status and /readyz\n".into(),
                ),
            };
        }
    };
    let PageAnswers { shown, expected } = served.parts.answers().await;
    if shown.is_empty() || (page == Page::Ready && shown.len() < expected) {
        let ending = "the program is stopping\n".to_owned();
        return text(StatusCode::SERVICE_UNAVAILABLE, ending);
    }
    match page {
        Page::Metrics => text(
            StatusCode::OK,
            shown.iter().map(ShownPart::prometheus).collect::<String>(),
        ),
        Page::Ready => {
            let clock = fault_of_host().map(|fault| format!("{fault}\n"));
            let reasons: String = clock
                .into_iter()
                .chain(shown.iter().flat_map(ShownPart::not_ready))
                .collect();
            let waiting: String = shown.iter().flat_map(ShownPart::waiting_for).collect();
            if reasons.is_empty() {
                text(StatusCode::OK, format!("ready\n{waiting}"))
            } else {
                text(StatusCode::SERVICE_UNAVAILABLE, reasons + &waiting)
            }
        }
        Page::Status => match shown.as_slice() {
            [only] if expected == 1 => text(StatusCode::OK, only.json()),
            all => {
                let each: Vec<String> = all.iter().map(ShownPart::json).collect();
                text(StatusCode::OK, format!("[{}]", each.join(",")))
            }
        },
    }
}

/// Returns the answer of a page with the newest events.
async fn answered<T: PageState>(
    request: &Request<Incoming>,
    peer: SocketAddr,
    (parts, live): (&PageParts<T>, &Arc<dyn LivePage>),
) -> Response<PageBody> {
    let answer = live.answer(request.uri().query().unwrap_or_default(), peer);
    if answer.wakes {
        let _answers = parts.answers().await;
    }
    text(answer.status, answer.body)
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Page {
    Metrics,
    Status,
    Ready,
}

fn text(status: StatusCode, body: String) -> Response<PageBody> {
    let mut response = Response::new(full(body));
    *response.status_mut() = status;
    response
}

const MAX_CONNECTIONS: usize = 16;
const MAX_PER_ADDRESS: usize = 8;
/// Limits of connections that are kept open.
const MAX_LONG: usize = 128;
const MAX_LONG_PER_ADDRESS: usize = 64;
/// The limit of a request header, and of bytes that wait for a client.
const LARGEST_BUFFER: usize = 64 << 10;
const HEADER_TIME: Duration = Duration::from_secs(5);
const CONNECTION_TIME: Duration = Duration::from_secs(10);
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpSocket;

    use super::*;

    struct Nothing;

    impl PageState for Nothing {
        fn json(&self) -> String {
            "{}".to_owned()
        }

        fn prometheus(&self) -> String {
            String::new()
        }

        fn not_ready(&self) -> Vec<String> {
            Vec::new()
        }
    }

    /// Serves pages without run loops. Returns the address, and the receiver that keeps the server
    /// running.
    async fn served() -> (SocketAddr, Requests<Nothing>) {
        let pages = Pages::alone("", None);
        let RunLoops { asks, mut requests } = loops(1);
        pages.run("", asks);
        let requests = requests.pop().unwrap();
        let any = "127.0.0.1:0".parse().unwrap();
        pages.listen(Some(any)).await.unwrap();
        (*pages.at.get().unwrap(), requests)
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
