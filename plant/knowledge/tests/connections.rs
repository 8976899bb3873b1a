//! The connections of clients: their users, their age, and their limits.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

use knowledge::{
    Configuring, ConnectionSecurity, HttpEndpoint, JobRunner, Knowledge, PasswordRefusal, Queries,
    QueryLimits, SecuringConnection, SourceCheck, SourceFiles, SourceKind, Writes,
};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::sync::Semaphore;
use tokio::time::Instant;

use crate::http::send;
use crate::writes::{Clear, request, writes};

async fn secured_site(users: Writes, security: Arc<dyn ConnectionSecurity>) -> HttpEndpoint {
    HttpEndpoint::bind_secured(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(Arc::new(Knowledge::new().unwrap()), QueryLimits::default()),
        Arc::new(|_: &str| None),
        (users, security),
    )
    .await
    .unwrap()
}

/// The credentials of `otto:x` and `eve:x`.
const OTTO: &str = "b3R0bzp4";
const EVE: &str = "ZXZlOng=";

/// Returns a request of a user for the list of questions.
fn ask(user: &str, connection: &str) -> String {
    format!(
        "GET /ask HTTP/1.1\r\nHost: mes.example\r\nAuthorization: Basic {user}\r\n\
         Connection: {connection}\r\n\r\n"
    )
}

/// Sends a text on a connection, and returns the statuses of the answers.
async fn statuses(at: SocketAddr, text: &str) -> Vec<u16> {
    let mut stream = TcpStream::connect(at).await.unwrap();
    stream.write_all(text.as_bytes()).await.unwrap();
    let mut answers = String::new();
    stream.read_to_string(&mut answers).await.unwrap();
    let answers = answers.split("HTTP/1.1 ").skip(1);
    answers
        .filter_map(|answer| answer.get(..3)?.parse().ok())
        .collect()
}

#[tokio::test]
async fn another_user_of_a_connection_is_checked() {
    let checked: Arc<Mutex<Vec<String>>> = Arc::default();
    let names = Arc::clone(&checked);
    let users = Writes {
        may_read: Arc::new(move |user| {
            let name = user.map(|(name, _)| name).unwrap_or_default();
            let is_otto = name == "otto";
            names.lock().unwrap().push(name);
            Box::pin(async move { is_otto })
        }),
        ..writes(false)
    };
    let endpoint = secured_site(users, Arc::new(Clear::default())).await;
    let three = [
        ask(OTTO, "keep-alive"),
        ask(OTTO, "keep-alive"),
        ask(EVE, "close"),
    ];
    let statuses = statuses(endpoint.address(), &three.concat()).await;
    assert_eq!(statuses, [200, 200, 401]);
    assert_eq!(*checked.lock().unwrap(), ["otto", "eve"]);
}

#[tokio::test]
async fn many_connections_of_a_user_at_the_same_time_are_not_wrong_passwords() {
    let go = Arc::new(Semaphore::new(0));
    let wait = Arc::clone(&go);
    let security = Arc::new(Clear::default());
    let users = Writes {
        may_read: Arc::new(move |_user| {
            let wait = Arc::clone(&wait);
            Box::pin(async move { wait.acquire().await.is_ok() })
        }),
        ..writes(false)
    };
    let of_clear = Arc::clone(&security) as Arc<dyn ConnectionSecurity>;
    let endpoint = secured_site(users, of_clear).await;
    let at = endpoint.address();
    let (answered, mut answers) = tokio::sync::mpsc::channel(30);
    for _ in 0..30 {
        let answered = answered.clone();
        tokio::spawn(async move {
            let answer = send(at, ask(OTTO, "close")).await;
            answered.send((answer.status, answer.body)).await.unwrap();
        });
    }
    for _ in 0..10 {
        let (status, body) = answers.recv().await.unwrap();
        assert_eq!(status, 503, "{body}");
        assert!(body.contains("\"busy\""), "{body}");
    }
    go.add_permits(1);
    for _ in 0..20 {
        assert_eq!(answers.recv().await.unwrap().0, 200);
    }
    assert_eq!(send(at, ask(OTTO, "close")).await.status, 200);
    let counts = [&security.wrong, &security.too_many].map(|count| count.load(Ordering::Relaxed));
    assert_eq!(counts, [0, 0]);
}

#[tokio::test]
async fn a_wrong_password_counts_if_its_client_leaves_during_the_check() {
    let (begun, go) = (Arc::new(Semaphore::new(0)), Arc::new(Semaphore::new(0)));
    let (begins, wait) = (Arc::clone(&begun), Arc::clone(&go));
    let security = Arc::new(Clear::default());
    let users = Writes {
        may_read: Arc::new(move |_user| {
            let (begins, wait) = (Arc::clone(&begins), Arc::clone(&wait));
            Box::pin(async move {
                begins.add_permits(1);
                wait.acquire().await.unwrap().forget();
                false
            })
        }),
        ..writes(false)
    };
    let of_clear = Arc::clone(&security) as Arc<dyn ConnectionSecurity>;
    let endpoint = secured_site(users, of_clear).await;
    let at = endpoint.address();
    for number in 1..=20 {
        let mut stream = TcpStream::connect(at).await.unwrap();
        let asked = ask(EVE, "close");
        stream.write_all(asked.as_bytes()).await.unwrap();
        begun.acquire().await.unwrap().forget();
        // The server closes its side when it has noticed that the client leaves.
        stream.shutdown().await.unwrap();
        assert_eq!(stream.read_to_end(&mut Vec::new()).await.unwrap(), 0);
        go.add_permits(1);
        let counted = async {
            while security.wrong.load(Ordering::Relaxed) < number {
                tokio::task::yield_now().await;
            }
        };
        let counted = tokio::time::timeout(Duration::from_secs(20), counted).await;
        assert!(counted.is_ok(), "attempt {number} is not counted");
    }
    assert_eq!(send(at, ask(EVE, "close")).await.status, 429);
}

/// A security whose handshakes do not end.
struct Endless;

impl ConnectionSecurity for Endless {
    fn secure(&self, stream: TcpStream) -> SecuringConnection {
        Box::pin(async move {
            let _stream = stream;
            std::future::pending().await
        })
    }

    fn is_for(&self, _host: &str) -> bool {
        true
    }

    fn refused(&self, _client: IpAddr, _refusal: PasswordRefusal) {}
}

#[tokio::test(start_paused = true)]
async fn a_connection_that_is_not_secured_in_time_is_closed() {
    let endpoint = secured_site(writes(false), Arc::new(Endless)).await;
    let start = Instant::now();
    let mut stream = TcpStream::connect(endpoint.address()).await.unwrap();
    let mut nothing = Vec::new();
    // The server may reset the connection.
    let _ended = stream.read_to_end(&mut nothing).await;
    assert!(nothing.is_empty());
    let seconds = start.elapsed().as_secs();
    assert!((5..=6).contains(&seconds), "{seconds} s");
}

/// Configures for a time.
struct Configures(Duration);

impl JobRunner for Configures {
    fn start(&self, _process: &str) -> Result<Option<u64>, String> {
        Ok(None)
    }

    fn stop(&self, _number: u64) -> bool {
        false
    }

    fn list(&self) -> serde_json::Value {
        serde_json::json!([])
    }

    fn configure(&self, _document: Vec<u8>, _checks_only: bool) -> Configuring {
        let time = self.0;
        Box::pin(async move {
            tokio::time::sleep(time).await;
            Ok(serde_json::json!({ "seconds": time.as_secs() }))
        })
    }
}

async fn configuring_site(seconds: u64) -> HttpEndpoint {
    let writes = Writes {
        jobs: Arc::new(Configures(Duration::from_secs(seconds))),
        ..writes(true)
    };
    HttpEndpoint::bind_with(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(Arc::new(Knowledge::new().unwrap()), QueryLimits::default()),
        Arc::new(|_: &str| None),
        Some(writes),
    )
    .await
    .unwrap()
}

const CONFIGURE: &str =
    "POST /configuration HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\n\r\nx";

#[tokio::test(start_paused = true)]
async fn the_last_request_of_an_old_connection_is_answered() {
    let endpoint = configuring_site(40).await;
    // The second request is in progress at the age of 60 s, and the third is not taken.
    let answered = statuses(endpoint.address(), &CONFIGURE.repeat(3)).await;
    assert_eq!(answered, [200, 200]);
    let start = Instant::now();
    let endpoint = configuring_site(1000).await;
    let answered = statuses(endpoint.address(), CONFIGURE).await;
    assert_eq!(answered, [0; 0], "the last request has a limit of time");
    let seconds = start.elapsed().as_secs();
    assert!((150..=151).contains(&seconds), "{seconds} s");
}

#[tokio::test]
async fn a_head_of_more_than_64_kib_is_refused() {
    let endpoint = configuring_site(0).await;
    let at = endpoint.address();
    let head = |bytes: usize| {
        let x = "x".repeat(bytes);
        format!("GET /ask HTTP/1.1\r\nHost: localhost\r\nX: {x}\r\nConnection: close\r\n\r\n")
    };
    assert_eq!(send(at, head(60 << 10)).await.status, 200);
    let mut large = head(70 << 10);
    large.truncate(64 << 10);
    assert_eq!(statuses(at, &large).await, [431]);
}

/// Reads a product until the test ends the reading.
struct SlowProducts {
    begun: AtomicUsize,
    end: Mutex<mpsc::Receiver<()>>,
}

impl SourceFiles for SlowProducts {
    fn put(&self, kind: SourceKind, _name: &str, _contents: &[u8]) -> Result<bool, String> {
        if kind == SourceKind::Product {
            self.begun.fetch_add(1, Ordering::SeqCst);
            let end = self.end.lock().map_err(|error| error.to_string())?;
            end.recv().map_err(|error| error.to_string())?;
        }
        Ok(true)
    }

    fn check(&self, _kind: SourceKind, _name: &str, _contents: &[u8]) -> SourceCheck {
        SourceCheck {
            accepted: true,
            replaces: false,
            findings: Vec::new(),
        }
    }

    fn remove(&self, _kind: SourceKind, _name: &str) -> Result<bool, String> {
        Ok(false)
    }

    fn list(&self) -> serde_json::Value {
        serde_json::json!([])
    }
}

#[tokio::test]
async fn sources_are_read_beside_products_which_are_read_one_after_the_other() {
    let (end, ends) = mpsc::channel();
    let files = Arc::new(SlowProducts {
        begun: AtomicUsize::new(0),
        end: Mutex::new(ends),
    });
    let writes = Writes {
        files: Arc::clone(&files) as Arc<dyn SourceFiles>,
        ..writes(true)
    };
    let endpoint = HttpEndpoint::bind_with(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(Arc::new(Knowledge::new().unwrap()), QueryLimits::default()),
        Arc::new(|_: &str| None),
        Some(writes),
    )
    .await
    .unwrap();
    let at = endpoint.address();
    let put = |line: &'static str| async move { request(at, line, &[], "x").await.status };
    let products: Vec<_> = (0..3)
        .map(|_| tokio::spawn(put("PUT /sources/product/x.step")))
        .collect();
    while files.begun.load(Ordering::SeqCst) == 0 {
        tokio::task::yield_now().await;
    }
    // Products wait for their place before they are sent, and take none of the uploads.
    let others = async {
        for _ in 0..3 {
            assert_eq!(put("PUT /sources/mtp/x").await, 201);
            assert_eq!(put("POST /check/mtp/x").await, 200);
        }
    };
    let others = tokio::time::timeout(Duration::from_secs(20), others).await;
    assert!(others.is_ok(), "other sources wait for products");
    for number in 1..=products.len() {
        assert!(files.begun.load(Ordering::SeqCst) <= number);
        end.send(()).unwrap();
    }
    for product in products {
        assert_eq!(product.await.unwrap(), 201);
    }
}
