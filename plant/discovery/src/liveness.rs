//! Probes of servers: a task for each watched endpoint, which keeps an [`OpenChannel`] to it if the
//! server accepts a channel, and otherwise connects for each probe.
//!
//! The registry decides on the times of probes. The loss of a channel is reported at once.

use std::collections::BTreeMap;
use std::time::Duration;

use registry::ProbeOutcome;
use tokio::sync::mpsc;
use tokio::time::{sleep, timeout};

use crate::client;
use crate::line::{OpenChannel, Reached};
use mdns::Url;

/// A report about an endpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum EndpointReport {
    /// The outcome of a probe.
    Tried { url: String, outcome: ProbeOutcome },
    /// The connection to the endpoint was lost.
    Broken { url: String },
}

/// A probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Try {
    /// Whether a server with a new channel is also queried for its start time.
    pub(crate) ask_start: bool,
}

/// All watched endpoints.
#[derive(Debug)]
pub(crate) struct Liveness {
    endpoints: BTreeMap<String, Watched>,
    under_way: usize,
    tell: mpsc::Sender<EndpointReport>,
    told: mpsc::Receiver<EndpointReport>,
}

#[derive(Debug)]
struct Watched {
    ask: mpsc::Sender<Try>,
    under_way: bool,
}

impl Liveness {
    pub(crate) fn new() -> Self {
        let (tell, told) = mpsc::channel(64);
        Self {
            endpoints: BTreeMap::new(),
            under_way: 0,
            tell,
            told,
        }
    }

    /// Returns whether another probe may start.
    pub(crate) fn has_room(&self) -> bool {
        self.under_way < MOST_TRIES
    }

    /// Starts a probe of an endpoint, unless a probe is in progress.
    pub(crate) fn attempt(&mut self, url: &str, attempt: Try) {
        if !self.endpoints.contains_key(url) {
            let may_hold = self.endpoints.len() < MOST_LINES;
            let watched = Watched::start(url, may_hold, self.tell.clone());
            self.endpoints.insert(url.to_owned(), watched);
        }
        if let Some(watched) = self.endpoints.get_mut(url)
            && !watched.under_way
            && watched.ask.try_send(attempt).is_ok()
        {
            watched.under_way = true;
            self.under_way += 1;
        }
    }

    /// Waits for the next report. Cancel safe.
    pub(crate) async fn next(&mut self) -> EndpointReport {
        loop {
            let Some(told) = self.told.recv().await else {
                // Cannot happen, because `self` holds a sender.
                return std::future::pending().await;
            };
            let url = match &told {
                EndpointReport::Tried { url, .. } | EndpointReport::Broken { url } => url,
            };
            // Reports of endpoints that are no longer watched are dropped.
            let Some(watched) = self.endpoints.get_mut(url) else {
                continue;
            };
            if matches!(told, EndpointReport::Tried { .. }) && watched.under_way {
                watched.under_way = false;
                self.under_way = self.under_way.saturating_sub(1);
            }
            return told;
        }
    }

    /// Stops watching all other endpoints.
    pub(crate) fn keep(&mut self, wanted: impl Fn(&str) -> bool) {
        let under_way = &mut self.under_way;
        self.endpoints.retain(|url, watched| {
            let stays = wanted(url);
            if !stays && watched.under_way {
                *under_way = under_way.saturating_sub(1);
            }
            stays
        });
    }
}

impl Watched {
    /// Starts the task of an endpoint, which ends when this value is dropped.
    fn start(url: &str, may_hold: bool, tell: mpsc::Sender<EndpointReport>) -> Self {
        let (ask, asked) = mpsc::channel(1);
        let endpoint = Endpoint {
            place: Url::parse(url),
            url: url.to_owned(),
            line: None,
            lines_left: if may_hold { LINES } else { 0 },
        };
        tokio::spawn(endpoint.run(asked, tell));
        Self {
            ask,
            under_way: false,
        }
    }
}

struct Endpoint {
    url: String,
    place: Option<Url>,
    line: Option<OpenChannel>,
    /// How many more channels may be opened: some servers close channels without a session.
    lines_left: u32,
}

impl Endpoint {
    async fn run(mut self, mut asked: mpsc::Receiver<Try>, tell: mpsc::Sender<EndpointReport>) {
        loop {
            let broken = async {
                match &mut self.line {
                    Some(line) => line.broken().await,
                    None => std::future::pending().await,
                }
            };
            let told = tokio::select! {
                attempt = asked.recv() => {
                    let Some(attempt) = attempt else { return };
                    // The task ends at once if the endpoint is no longer watched.
                    let outcome = tokio::select! {
                        outcome = self.attempt(attempt) => outcome,
                        () = closed(&mut asked) => return,
                    };
                    EndpointReport::Tried { url: self.url.clone(), outcome }
                }
                () = broken => {
                    self.line = None;
                    // A program that ends closes its sockets one after another; its listener may be
                    // next.
                    sleep(SETTLE).await;
                    EndpointReport::Broken { url: self.url.clone() }
                }
            };
            if tell.send(told).await.is_err() {
                return;
            }
        }
    }

    /// Probes the endpoint within a second: on the line, and if the answer is delayed, also on
    /// another connection.
    async fn attempt(&mut self, attempt: Try) -> ProbeOutcome {
        let Some(place) = self.place.clone() else {
            // The endpoint has another transport, for example HTTPS.
            return ProbeOutcome::Untried;
        };
        let alive = ProbeOutcome::Alive { start_time: None };
        let line = self.line.take().filter(OpenChannel::is_good);
        let asking = ask(line);
        tokio::pin!(asking);
        let soon = timeout(SOON, &mut asking).await;
        if let Ok(Some(line)) = soon {
            self.line = Some(line);
            return alive;
        }
        let hold = self.lines_left > 0;
        let rest = match soon {
            Ok(_) => LIMIT,
            Err(_) => LIMIT.saturating_sub(SOON),
        };
        let anew = OpenChannel::reach(&self.url, &place, hold, rest);
        tokio::pin!(anew);
        let reached = tokio::select! {
            Some(line) = &mut asking, if soon.is_err() => {
                self.line = Some(line);
                return alive;
            }
            reached = &mut anew => reached,
        };
        match reached {
            Reached::Line(line) => {
                self.lines_left = self.lines_left.saturating_sub(1);
                self.line = Some(*line);
                let start_time = if attempt.ask_start {
                    client::start_time(&self.url, START_LIMIT).await.ok()
                } else {
                    None
                };
                ProbeOutcome::Alive { start_time }
            }
            Reached::Answers => alive,
            Reached::Accepts => ProbeOutcome::Hanging,
            Reached::Refused => ProbeOutcome::Refused,
            Reached::Nobody => ProbeOutcome::Silent,
            Reached::Untried => ProbeOutcome::Untried,
        }
    }
}

async fn ask(line: Option<OpenChannel>) -> Option<OpenChannel> {
    line?.ask().await
}

async fn closed(asked: &mut mpsc::Receiver<Try>) {
    // No second probe is sent meanwhile, so the channel closes next.
    while asked.recv().await.is_some() {}
}

/// Maximum number of concurrent probes: more than the number of waiting probes after a cut cable,
/// except in large plants.
const MOST_TRIES: usize = 256;
/// Maximum number of lines. The default limit of a process is 1024 file descriptors.
const MOST_LINES: usize = 600;
const LINES: u32 = 4;
const SETTLE: Duration = Duration::from_millis(30);
/// An answer on an open connection takes milliseconds, or about 200 ms after a lost packet.
const SOON: Duration = Duration::from_millis(400);
/// Two probes that time out fit into the time for reporting a loss.
const LIMIT: Duration = Duration::from_secs(1);
const START_LIMIT: Duration = Duration::from_secs(2);

#[cfg(test)]
mod tests {
    use tokio::net::TcpListener;

    use super::*;
    use crate::description::ServerDescription;
    use crate::presence::be_there;

    async fn tried(liveness: &mut Liveness, url: &str) -> ProbeOutcome {
        liveness.attempt(url, Try { ask_start: false });
        match liveness.next().await {
            EndpointReport::Tried { outcome, .. } => outcome,
            EndpointReport::Broken { .. } => panic!("there is no line"),
        }
    }

    #[tokio::test]
    async fn what_comes_of_a_try_says_what_kind_of_silence_it_is() {
        let mut liveness = Liveness::new();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("opc.tcp://{}", listener.local_addr().unwrap());
        assert_eq!(tried(&mut liveness, &url).await, ProbeOutcome::Hanging);
        drop(listener);
        assert_eq!(tried(&mut liveness, &url).await, ProbeOutcome::Refused);
        for url in [
            "https://127.0.0.1:1/",
            "opc.tcp://no-such-host.invalid:4840",
        ] {
            assert_eq!(
                tried(&mut liveness, url).await,
                ProbeOutcome::Untried,
                "{url}"
            );
        }
        assert_eq!(liveness.endpoints.len(), 3);
        liveness.keep(|known| known == url);
        assert_eq!(liveness.endpoints.len(), 1);
        assert!(liveness.has_room());
        assert_eq!(liveness.under_way, 0);
    }

    #[tokio::test]
    async fn a_line_breaks_off_in_the_moment_in_which_the_server_ends() {
        let mut liveness = Liveness::new();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("opc.tcp://{}", listener.local_addr().unwrap());
        let server = ServerDescription {
            application_uri: "urn:here".to_owned(),
            product_uri: String::new(),
            name: "here".to_owned(),
            url: url.clone(),
            capabilities: Vec::new(),
            number: None,
        };
        // A separate runtime, which closes all its connections when it ends.
        let runtime = std::thread::spawn(|| {
            tokio::runtime::Builder::new_multi_thread()
                .worker_threads(1)
                .enable_all()
                .build()
                .unwrap()
        });
        let runtime = runtime.join().unwrap();
        let listener = listener.into_std().unwrap();
        runtime.spawn(async move {
            be_there(TcpListener::from_std(listener).unwrap(), &server).await;
        });
        let alive = ProbeOutcome::Alive { start_time: None };
        for _ in 0..3 {
            assert_eq!(tried(&mut liveness, &url).await, alive);
        }
        runtime.shutdown_background();
        let told = timeout(Duration::from_secs(5), liveness.next()).await;
        assert_eq!(told, Ok(EndpointReport::Broken { url: url.clone() }));
        // The sockets of the runtime may close one after another.
        let gone = async { while tried(&mut liveness, &url).await != ProbeOutcome::Refused {} };
        timeout(Duration::from_secs(5), gone).await.unwrap();
    }

    #[tokio::test]
    async fn who_accepts_and_closes_is_there() {
        let mut liveness = Liveness::new();
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("opc.tcp://{}", listener.local_addr().unwrap());
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                drop(stream);
            }
        });
        let alive = ProbeOutcome::Alive { start_time: None };
        assert_eq!(tried(&mut liveness, &url).await, alive);
    }
}
