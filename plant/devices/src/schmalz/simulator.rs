//! Simulates an IO-Link master with a vacuum gripper at a port.

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use http_body_util::{BodyExt as _, Full, Limited};
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio::time::Instant;
use tracing::debug;

use super::{BLOW_OFF, DEVICES, VACUUM};

/// Settings of the simulated gripper.
#[derive(Debug, Clone, PartialEq)]
pub struct SchmalzSettings {
    /// The alias of its port.
    pub alias: String,
    /// Whether there is a part below its cups.
    pub part: bool,
    /// Speed factor of the simulated time.
    pub time_scale: f64,
}

impl Default for SchmalzSettings {
    fn default() -> Self {
        Self {
            alias: "master1port1".to_owned(),
            part: true,
            time_scale: 1.0,
        }
    }
}

/// A simulated master with its gripper; clones share the same master.
#[derive(Debug, Clone)]
pub struct SchmalzSimulator {
    gripper: Arc<Mutex<Gripper>>,
}

#[derive(Debug)]
struct Gripper {
    settings: SchmalzSettings,
    out: [u8; 2],
    /// mbar
    vacuum: f64,
    held: bool,
    detached: bool,
    seen: Instant,
    faults: SchmalzFaults,
}

/// Faults of the simulator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SchmalzFaults {
    /// The master does not answer.
    pub silent: bool,
    /// Its responses are not JSON.
    pub damaged: bool,
    /// The gripper is not connected to its port.
    pub unplugged: bool,
    /// The gripper reports that it does not work.
    pub broken: bool,
}

impl SchmalzSimulator {
    /// Creates a gripper without a held part.
    #[must_use]
    pub fn new(settings: SchmalzSettings) -> Self {
        let gripper = Gripper {
            settings,
            out: [0; 2],
            vacuum: 0.0,
            held: false,
            detached: false,
            seen: Instant::now(),
            faults: SchmalzFaults::default(),
        };
        Self {
            gripper: Arc::new(Mutex::new(gripper)),
        }
    }

    /// Sets the faults.
    pub fn set_faults(&self, faults: SchmalzFaults) {
        self.lock().faults = faults;
    }

    /// Switches the gripper off and on: the vacuum and all commands are lost.
    pub fn reboot(&self) {
        let mut gripper = self.lock();
        gripper.out = [0; 2];
        gripper.vacuum = 0.0;
        gripper.held = false;
    }

    /// Returns whether the gripper holds a part.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.lock().held
    }

    fn lock(&self) -> MutexGuard<'_, Gripper> {
        let mut gripper = self.gripper.lock().unwrap_or_else(PoisonError::into_inner);
        gripper.advance();
        gripper
    }

    fn answer(&self, method: &Method, path: &str, body: &[u8]) -> (StatusCode, Option<Value>) {
        let mut gripper = self.lock();
        let Some((alias, tail)) = path
            .strip_prefix(DEVICES)
            .and_then(|rest| rest.strip_prefix('/'))
            .and_then(|rest| rest.split_once('/'))
        else {
            return refused(StatusCode::NOT_FOUND, 101, "Resource not found");
        };
        if alias != gripper.settings.alias {
            return refused(StatusCode::NOT_FOUND, 103, "deviceAlias not found");
        }
        if gripper.faults.unplugged {
            return refused(
                StatusCode::NOT_FOUND,
                301,
                "IO-Link Device is not accessible",
            );
        }
        match (method, tail) {
            (&Method::GET, "processdata/getdata/value") => {
                let data =
                    json!({"ioLink": {"valid": true, "value": gripper.tells()}, "iqValue": false});
                (StatusCode::OK, Some(data))
            }
            (&Method::GET, "processdata/setdata/value") => {
                let data = json!({"ioLink": {"valid": true, "value": gripper.out}});
                (StatusCode::OK, Some(data))
            }
            (&Method::GET, "identification") => (StatusCode::OK, Some(identification())),
            (&Method::POST, "processdata/value") => {
                let bytes: Option<[u8; 2]> =
                    serde_json::from_slice::<Value>(body).ok().and_then(|data| {
                        serde_json::from_value(data.get("ioLink")?.get("value")?.clone()).ok()
                    });
                match bytes {
                    Some(out) => {
                        gripper.take(out);
                        (StatusCode::NO_CONTENT, None)
                    }
                    None => refused(StatusCode::BAD_REQUEST, 203, "JSON data type invalid"),
                }
            }
            (
                _,
                "processdata/getdata/value" | "processdata/setdata/value" | "processdata/value",
            ) => refused(
                StatusCode::METHOD_NOT_ALLOWED,
                102,
                "Operation not available",
            ),
            _ => refused(StatusCode::NOT_FOUND, 101, "Resource not found"),
        }
    }
}

impl Gripper {
    fn take(&mut self, out: [u8; 2]) {
        self.out = out;
        let [flags, _] = out;
        if flags & VACUUM != 0 {
            self.detached = false;
        }
    }

    fn advance(&mut self) {
        let now = Instant::now();
        let passed = now.duration_since(self.seen).as_secs_f64() * self.settings.time_scale;
        self.seen = now;
        let [flags, _] = self.out;
        let (aim, within) = match (flags & VACUUM != 0, flags & BLOW_OFF != 0) {
            // Blowing off takes precedence over suction.
            (_, true) => (0.0, 0.05),
            (true, false) if self.settings.part => (600.0, 0.3),
            (true, false) => (40.0, 0.1),
            (false, false) => (0.0, 0.5),
        };
        self.vacuum += (aim - self.vacuum) * (1.0 - (-passed / within).exp());
        if self.vacuum > PART_PRESENT {
            self.held = true;
        } else if self.held && self.vacuum < NOTHING {
            self.held = false;
            self.detached = true;
        }
    }

    fn tells(&self) -> [u8; 4] {
        let health = if self.faults.broken { 3 } else { 0 };
        let flags = u8::from(self.held)
            | u8::from(self.vacuum > IN_CONTROL_RANGE) << 1
            | u8::from(self.detached) << 5
            | health << 6;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "from 0 to 600"
        )]
        let [high, low] = (self.vacuum.round() as u16).to_be_bytes();
        let [out, _] = self.out;
        let power = if out & VACUUM != 0 { 60 } else { 0 };
        [flags, power, high, low]
    }
}

fn identification() -> Value {
    json!({
        "vendorId": 234, "deviceId": 100_260, "iolinkRevision": "1.1", "vendorName": "J. Schmalz GmbH",
        "productName": "ECBPi (simulated)", "serialNumber": "0"
    })
}

fn refused(status: StatusCode, code: u16, message: &str) -> (StatusCode, Option<Value>) {
    (status, Some(json!({"code": code, "message": message})))
}

/// A master that is served, until it is dropped.
#[derive(Debug)]
pub struct ServedMaster {
    address: SocketAddr,
    _tasks: JoinSet<()>,
}

impl ServedMaster {
    /// Serves a master; port 0 selects a free port. Needs a tokio runtime.
    ///
    /// # Errors
    /// Fails if the address cannot be used.
    pub async fn start(simulator: &SchmalzSimulator, address: &str) -> io::Result<Self> {
        let listener = TcpListener::bind(address).await?;
        let address = listener.local_addr()?;
        let mut tasks = JoinSet::new();
        tasks.spawn(accept(listener, simulator.clone()));
        Ok(Self {
            address,
            _tasks: tasks,
        })
    }

    /// Returns the address of the server.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

async fn accept(listener: TcpListener, simulator: SchmalzSimulator) {
    let mut clients = JoinSet::new();
    loop {
        let Ok((stream, from)) = listener.accept().await else {
            tokio::time::sleep(LATER).await;
            continue;
        };
        while clients.try_join_next().is_some() {}
        if clients.len() >= MOST_CLIENTS {
            continue;
        }
        let simulator = simulator.clone();
        clients.spawn(async move {
            let service = service_fn(|request| respond(request, &simulator));
            let served = hyper::server::conn::http1::Builder::new()
                .timer(TokioTimer::new())
                .header_read_timeout(Duration::from_secs(5))
                .serve_connection(TokioIo::new(stream), service)
                .await;
            debug!("{from} has gone: {served:?}");
        });
    }
}

async fn respond(
    request: Request<Incoming>,
    simulator: &SchmalzSimulator,
) -> Result<Response<Full<Bytes>>, Infallible> {
    let (head, body) = request.into_parts();
    let body = Limited::new(body, LONGEST).collect().await;
    let faults = simulator.lock().faults;
    if faults.silent {
        std::future::pending::<()>().await;
    }
    let (status, answer) = match body {
        Ok(body) => simulator.answer(&head.method, head.uri.path(), &body.to_bytes()),
        Err(_) => refused(StatusCode::BAD_REQUEST, 201, "JSON parsing failed"),
    };
    let text = match (faults.damaged, answer) {
        (true, _) => "{\"ioLink\":".to_owned(),
        (false, answer) => answer.map(|answer| answer.to_string()).unwrap_or_default(),
    };
    let mut response = Response::new(Full::new(Bytes::from(text)));
    *response.status_mut() = status;
    let json = hyper::header::HeaderValue::from_static("application/json");
    response
        .headers_mut()
        .insert(hyper::header::CONTENT_TYPE, json);
    Ok(response)
}

/// mbar
const PART_PRESENT: f64 = 550.0;
const IN_CONTROL_RANGE: f64 = 450.0;
const NOTHING: f64 = 20.0;
const LATER: Duration = Duration::from_millis(50);
const MOST_CLIENTS: usize = 16;
const LONGEST: usize = 64 * 1024;
