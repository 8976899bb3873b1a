//! The state of the page, and the events of the run loop.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
use std::time::{Duration, Instant};

use bridge_node::{CallDescription, LocalDelivery, Observer, PortEvent, Statuses, now};
use bytes::Bytes;
use hyper::Uri;
use mappings::{Mapping, SpaceId, TopicId};
use serde_json::Value;
use tls_server::TlsServer;
use tokio::time::{MissedTickBehavior, interval};
use tracing::warn;
use uadp::discovery::{Probe, WireArray};
use uadp::{NetworkMessage, PublisherId, SecurityHeader, Timestamp};

use crate::announced::{self, AnnouncedValue};
use crate::board::{BoardSample, CellBoard, EventTime};
use crate::fetch::{FetchFault, StatusUrl};
use crate::hops::TapFollower;
use crate::mes::{MesClient, RequestSlots};
use crate::operations::Operations;
use crate::program::ProgramStatus;
use crate::proxy::ProxyUrl;
use crate::session::BrowserSessions;
use crate::stream::Worker;
use crate::timeline;
use crate::view::Viewer;

/// The page of a program.
pub struct Page {
    /// The name of the program that serves it.
    pub(crate) program: &'static str,
    /// The reverse proxy through which browsers reach the page, if there is one.
    pub(crate) proxy: Option<ProxyUrl>,
    /// The certificate of the page for browsers of other hosts, if it is served by TLS.
    pub(crate) tls: OnceLock<TlsServer>,
    /// The users and the commands of the program, if it has any.
    pub(crate) operations: OnceLock<Arc<dyn Operations>>,
    pub(crate) sessions: Mutex<BrowserSessions>,
    /// The requests to the MES at the same time.
    pub(crate) places: RequestSlots,
    board: Mutex<CellBoard>,
    /// Whether the page shows a recording instead of the group.
    shows_recording: AtomicBool,
    started: Instant,
    /// The locations of the status of other programs.
    others: Vec<StatusUrl>,
    viewers: AtomicUsize,
    /// Reads the status of this program.
    statuses: OnceLock<Statuses>,
    /// Started for the first browser.
    worker: OnceLock<Option<Worker>>,
}

impl std::fmt::Debug for Page {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Page")
            .field("program", &self.program)
            .finish_non_exhaustive()
    }
}

impl Page {
    /// Creates the page of a program. `others` are the locations of the status of other programs.
    /// Browsers reach the page on loopback, and through `proxy`.
    #[must_use]
    pub fn new(
        program: &'static str,
        others: Vec<StatusUrl>,
        proxy: Option<ProxyUrl>,
    ) -> Arc<Self> {
        Arc::new(Self {
            program,
            proxy,
            tls: OnceLock::new(),
            operations: OnceLock::new(),
            sessions: Mutex::default(),
            places: RequestSlots::default(),
            board: Mutex::default(),
            shows_recording: AtomicBool::new(false),
            started: now().monotonic,
            others,
            viewers: AtomicUsize::new(0),
            statuses: OnceLock::new(),
            worker: OnceLock::new(),
        })
    }

    /// Shows the recording with this name instead of the group.
    pub fn show_recording(&self, name: &str) {
        self.shows_recording.store(true, Ordering::Relaxed);
        self.board().timeline.set_recording(name);
    }

    /// Takes a datagram of the recording that was received `since` its first datagram.
    pub fn recorded_datagram(&self, datagram: &[u8], from: SocketAddr, at: (Duration, Timestamp)) {
        self.read(datagram, from, recorded_at(at));
    }

    /// Takes a value of the recording that was received `since` its first datagram.
    pub fn recorded_value(&self, value: &Recorded<'_>, at: (Duration, Timestamp)) {
        let sample = BoardSample {
            topic: value.topic,
            block: &Bytes::copy_from_slice(value.block),
            source: value.source,
            status: value.status,
        };
        self.board().take(sample, recorded_at(at));
    }

    /// Reads the announcement and the calls of a datagram.
    fn read(&self, datagram: &[u8], from: SocketAddr, at: EventTime) {
        let Ok(message) = NetworkMessage::decode(datagram) else {
            return;
        };
        if let Some((topic, description)) = announced::read(&message, from) {
            self.board().announce(topic, description);
        }
        for call in timeline::calls(&message) {
            self.board().called(call, at);
        }
    }

    fn is_live(&self) -> bool {
        !self.shows_recording.load(Ordering::Relaxed)
    }

    /// Lets signed-in users operate the cell.
    pub fn operate(&self, operations: Arc<dyn Operations>) {
        // A program sets its users once.
        let _first = self.operations.set(operations);
    }

    /// Notes how the status of this program is read.
    pub(crate) fn read_by(&self, statuses: Statuses) {
        // A program has one server of pages.
        let _first = self.statuses.set(statuses);
    }

    /// Returns the thread of the page, and starts it for the first browser. Returns `None` if the
    /// system refuses another thread.
    pub(crate) fn worker(self: &Arc<Self>) -> Option<&Worker> {
        let start = || {
            let worker = Worker::start()
                .inspect_err(|error| warn!("cannot start the thread of the page: {error}"))
                .ok()?;
            if let Some(statuses) = self.statuses.get() {
                worker.spawn(follow(Arc::downgrade(self), Arc::clone(statuses)));
            }
            Some(worker)
        };
        self.worker.get_or_init(start).as_ref()
    }

    pub(crate) fn sessions(&self) -> MutexGuard<'_, BrowserSessions> {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn board(&self) -> MutexGuard<'_, CellBoard> {
        self.board.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn at(&self) -> EventTime {
        let now = now();
        EventTime {
            since: now.monotonic.saturating_duration_since(self.started),
            utc: now.utc,
        }
    }

    /// Returns the MES among the programs with a status.
    pub(crate) async fn mes(&self) -> Option<MesClient> {
        let known = self.board().mes();
        if known.is_some() {
            return known;
        }
        for url in &self.others {
            if url
                .fetch()
                .await
                .is_ok_and(|status| MesClient::is_status(&status))
            {
                return Some(MesClient::new(url.clone()));
            }
        }
        None
    }

    /// Reads the delays of the topics that browsers show. A program of another host refuses, and so
    /// does a program whose topics are tapped by many others.
    async fn follow_taps(&self, taps: &mut TapFollower) {
        let mut shown = self.board().watched(self.at().since);
        shown.truncate(MOST_TAPPED);
        taps.keep(&shown);
        let (mut of, mut requests) = (Vec::new(), Vec::new());
        for topic in &shown {
            for url in &self.others {
                let source = url.to_string();
                if let Ok(path) = taps.request(*topic, &source).parse() {
                    of.push((*topic, source));
                    requests.push((url, path));
                }
            }
        }
        for ((topic, source), response) in of.into_iter().zip(read_all(requests).await) {
            if let Ok(response) = response {
                taps.take(topic, &source, &response);
            }
        }
        let hops = shown.into_iter().map(|topic| (topic, taps.shown(topic)));
        self.board().hops = hops.collect();
    }

    /// Counts a browser.
    pub(crate) fn came(&self) {
        self.viewers.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a browser that has left.
    pub(crate) fn left(&self) {
        self.viewers.fetch_sub(1, Ordering::Relaxed);
    }

    /// Returns the next event of a browser.
    pub(crate) fn next_event(&self, viewer: &mut Viewer) -> Option<String> {
        let now = self.at().since;
        // Conditions are read without the lock of the board.
        let conditions = if viewer.shows_conditions() {
            self.operations.get().map(|one| one.conditions())
        } else {
            None
        };
        let mut board = self.board();
        if viewer.shows_conditions() {
            board.conditions = conditions;
        }
        viewer.next(&mut board, now)
    }
}

/// Reads paths of programs, all at the same time. A program that does not respond does not delay
/// the reading of the others.
async fn read_all(requests: Vec<(&StatusUrl, Uri)>) -> Vec<Result<Value, FetchFault>> {
    let requests = requests.into_iter().map(|(url, path)| url.get(path));
    futures_util::future::join_all(requests).await
}

/// Reads the status of all programs while browsers are present.
async fn follow(page: Weak<Page>, statuses: Statuses) {
    let mut taps = TapFollower::default();
    let mut ticks = interval(LOOK);
    ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        ticks.tick().await;
        let Some(page) = page.upgrade() else {
            return;
        };
        if page.viewers.load(Ordering::Relaxed) == 0 {
            continue;
        }
        let mut programs = own(statuses().await);
        let requests = page.others.iter().map(|url| (url, StatusUrl::path()));
        for (url, status) in page.others.iter().zip(read_all(requests.collect()).await) {
            programs.extend(other(url, status.map_err(|fault| fault.to_string())));
        }
        page.board().set_programs(programs);
        page.follow_taps(&mut taps).await;
    }
}

impl Observer for Page {
    fn mapped(&self, mapping: &Arc<Mapping>) {
        self.board().map(mapping);
    }

    fn datagram(&self, datagram: &[u8], from: SocketAddr) {
        if self.is_live() {
            self.read(datagram, from, self.at());
        }
    }

    fn received(&self, sample: &LocalDelivery) {
        if !self.is_live() {
            return;
        }
        let at = self.at();
        let sample = BoardSample {
            topic: sample.topic,
            block: &sample.payload,
            source: sample.source,
            status: sample.status,
        };
        self.board().take(sample, at);
    }

    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "the other events are not shown"
    )]
    fn event(&self, event: &PortEvent) {
        if !self.is_live() {
            return;
        }
        let (topic, block, source, status) = match event {
            PortEvent::Sample {
                topic,
                payload,
                received,
                ..
            } => (*topic, payload, *received, 0),
            PortEvent::Qualified {
                topic,
                payload,
                taken,
                status,
            } => (*topic, payload, *taken, *status),
            PortEvent::Described { topic, description } => {
                let type_name = description.message_type.as_ref();
                let shown = AnnouncedValue {
                    name: description.name.clone(),
                    type_name: type_name.map_or_else(String::new, ToString::to_string),
                    about: description.about.clone(),
                    unit: String::new(),
                    fields: description
                        .fields
                        .iter()
                        .map(|leaf| leaf.path.clone())
                        .collect(),
                    from: None,
                };
                return self.board().describe(*topic, shown);
            }
            PortEvent::Offer { topic, offered } => {
                let description = Arc::new(offered.description.clone());
                return self.board().offer(*topic, &description, true);
            }
            PortEvent::Withdrawn { topic } => return self.board().withdraw(*topic),
            _ => return,
        };
        let at = self.at();
        let sample = BoardSample {
            topic,
            block,
            source: Some(source),
            status,
        };
        self.board().take(sample, at);
    }

    fn silent(&self, topic: TopicId, is_silent: bool) {
        if !self.is_live() {
            return;
        }
        self.board().set_silent(topic, is_silent);
    }

    fn call_known(&self, topic: TopicId, description: &Arc<CallDescription>) {
        if !self.is_live() {
            return;
        }
        self.board().offer(topic, description, false);
    }

    fn call_gone(&self, topic: TopicId) {
        self.board().withdraw(topic);
    }

    fn probe(&self) -> Option<Vec<u8>> {
        if !self.is_live() {
            return None;
        }
        let topics = self.board().nameless();
        let space = topics.first()?.space;
        probe(space, topics.iter().filter(|topic| topic.space == space))
    }
}

/// A value of a recording.
#[derive(Debug)]
pub struct Recorded<'a> {
    /// The topic of the value.
    pub topic: TopicId,
    /// The block of fields.
    pub block: &'a [u8],
    /// The time at which the producer's bridge took the value.
    pub source: Option<Timestamp>,
    /// The upper half of the StatusCode.
    pub status: u16,
}

fn recorded_at((since, utc): (Duration, Timestamp)) -> EventTime {
    EventTime { since, utc }
}

/// Returns a probe for the descriptions of topics of a space.
fn probe<'t>(space: SpaceId, topics: impl Iterator<Item = &'t TopicId>) -> Option<Vec<u8>> {
    let ids: Vec<u16> = topics.map(|topic| topic.identifier.get()).collect();
    let mut datagram = Vec::new();
    let publisher = Some(PublisherId::UInt16(space.into()));
    let probe = Probe::DataSetMetaData(WireArray::new(&ids));
    let encoded = probe.encode(publisher, SecurityHeader::NONE, &mut datagram);
    encoded.ok().map(|_| datagram)
}

/// Returns the status of each run loop of this program.
fn own(statuses: Vec<String>) -> Vec<ProgramStatus> {
    let statuses = statuses.into_iter();
    statuses
        .map(|text| ProgramStatus {
            source: "this program".to_owned(),
            status: serde_json::from_str(&text).map_err(|error| error.to_string()),
        })
        .collect()
}

/// Returns the status of another program; a program with several spaces has several.
fn other(url: &StatusUrl, status: Result<Value, String>) -> Vec<ProgramStatus> {
    let source = url.to_string();
    let each = match status {
        Ok(Value::Array(all)) => all.into_iter().map(Ok).collect(),
        other => vec![other],
    };
    each.into_iter()
        .map(|status| ProgramStatus {
            source: source.clone(),
            status,
        })
        .collect()
}

/// The maximum number of topics whose delays are read.
const MOST_TAPPED: usize = 4;
/// The period in which the status of programs is read.
const LOOK: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use serde_json::json;
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    use tokio::net::TcpListener;

    use super::*;

    #[test]
    fn a_program_with_several_spaces_is_several_rows() {
        let url: StatusUrl = "127.0.0.1:9100".parse().unwrap();
        let two = other(&url, Ok(json!([{ "space": 2 }, { "space": 3 }])));
        assert_eq!(two.len(), 2);
        assert_eq!(two[1].space(), Some(3));
        assert!(!other(&url, Err("gone".to_owned()))[0].is_ready());
        assert_eq!(own(vec!["{}".to_owned(), "?".to_owned()]).len(), 2);
    }

    #[tokio::test]
    async fn a_program_is_read_while_another_one_does_not_respond() {
        let listeners = [
            TcpListener::bind("127.0.0.1:0").await.unwrap(),
            TcpListener::bind("127.0.0.1:0").await.unwrap(),
        ];
        let urls = listeners.each_ref().map(|listener| {
            let url = listener.local_addr().unwrap().to_string();
            url.parse::<StatusUrl>().unwrap()
        });
        let [slow, quick] = &listeners;
        let answer = b"HTTP/1.1 200 OK\r\nconnection: close\r\n\r\n{}";
        let serve = async {
            // The first program responds after the second one.
            let (mut waiting, _) = slow.accept().await.unwrap();
            let (mut other, _) = quick.accept().await.unwrap();
            for stream in [&mut other, &mut waiting] {
                assert_ne!(stream.read(&mut [0; 1024]).await.unwrap(), 0);
                stream.write_all(answer).await.unwrap();
                stream.shutdown().await.unwrap();
            }
        };
        let requests = urls.iter().map(|url| (url, StatusUrl::path())).collect();
        let (read, ()) = tokio::join!(read_all(requests), serve);
        assert!(read.iter().all(Result::is_ok), "{read:?}");
    }
}
