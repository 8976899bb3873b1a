//! Inspects a running space: receives the messages of its group without a mapping.

mod all;
mod announcements;
mod application;
mod bandwidth;
pub(crate) mod book;
mod call;
mod carrier;
mod cells;
pub(crate) mod channels;
mod copies;
pub(crate) mod described;
mod echo;
mod list;
mod names;
mod parameters;
pub(crate) mod plain;
mod prober;
mod received;
mod record;
mod replay;
mod robot;
mod run;
mod scalars;
mod sealing;
mod seen;
mod serve;
mod skills;
mod structure;
pub(crate) mod text;
mod top;
mod trace;
mod write;

pub(crate) use all::list;
pub(crate) use application::AnnouncedProgram;
pub(crate) use bandwidth::bandwidth;
pub(crate) use call::call;
pub(crate) use carrier::broker_mapping;
pub(crate) use echo::{echo, hz};
pub(crate) use list::info;
pub(crate) use names::fitting;
pub(crate) use record::record;
pub(crate) use replay::replay;
pub(crate) use robot::ModelSource;
pub(crate) use seen::{SenderTiming, TopicSeen, listened};
pub(crate) use serve::serve;
pub(crate) use skills::{HeardNames, heard_names, skills, types};
pub(crate) use text::{TextTable, harmless, help_within_width, is_coloured, json, wrapped};
pub(crate) use top::{Sort, top};
pub(crate) use trace::trace;
pub(crate) use write::write;

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use mappings::{SpaceId, TopicId};
use tokio::time::Instant;
use transport::{BUFFER, Carrier, OutgoingMessage, Received};
use uadp::{NetworkHeader, NetworkMessage, Timestamp};

use crate::arguments::GroupArguments;
use crate::exit::CommandFailure;
use crate::interrupt::SignalGuard;
use crate::report::warn;
use crate::survey::look;
use book::{Book, DatagramContent};
use prober::Prober;
use sealing::Sealing;

/// A connection to the group.
pub(crate) struct Live {
    carrier: Box<dyn Carrier>,
    /// The origin of its times.
    start: Instant,
    /// The same instant in nanoseconds since 1970.
    start_utc: i128,
    pub(crate) book: Book,
    prober: Prober,
    wants_calls: bool,
    interrupt: SignalGuard,
    buffer: Vec<u8>,
    /// The keys of a secured group.
    sealing: Option<Sealing>,
    shown_group: String,
}

/// The reason why listening ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ListenEnd {
    /// The time is over.
    Time,
    /// The closure requested the end.
    Enough,
    /// SIGINT or SIGTERM.
    Interrupted,
}

/// The result of waiting for a datagram.
#[derive(Debug, Clone, Copy)]
enum Incoming {
    /// A datagram is in the buffer.
    Message(Received),
    /// The time is over.
    Nothing,
    /// SIGINT or SIGTERM.
    Interrupted,
}

/// Continues or ends listening after a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Go {
    On,
    Enough,
}

/// Joins the group and runs `looking` to its end.
pub(crate) fn in_group<T>(
    group: &GroupArguments,
    looking: impl AsyncFnOnce(Live) -> Result<T, CommandFailure>,
) -> Result<T, CommandFailure> {
    look(async {
        let live = Live::join(group)?;
        looking(live).await
    })
}

/// Joins the group and runs `looking` to its end. Own datagrams are received too: the kernel counts
/// each datagram that it filters like one that is lost because the socket is full.
fn in_group_with_own<T>(
    group: &GroupArguments,
    looking: impl AsyncFnOnce(Live) -> Result<T, CommandFailure>,
) -> Result<T, CommandFailure> {
    look(async {
        let live = Live::with(group, carrier::open_with_own(group)?)?;
        looking(live).await
    })
}

/// The programs in a group.
#[derive(Debug, Default)]
pub(crate) struct InGroup {
    /// The number of topics of each sender: its ROS space and address.
    pub(crate) senders: BTreeMap<(u16, String), usize>,
    /// The announced applications, by space and address.
    pub(crate) applications: BTreeMap<(u16, String), AnnouncedProgram>,
}

/// Returns the senders and applications of the group, which are probed and received for `seconds`.
pub(crate) async fn in_the_group(
    group: &GroupArguments,
    seconds: f64,
) -> Result<(InGroup, ()), CommandFailure> {
    let mut live = Live::join(group)?;
    live.want_all();
    let end = until(live.now(), Some(seconds));
    live.listen(end, &mut |_, _| Go::On).await?;
    Ok((live.who(), ()))
}

impl Live {
    fn join(group: &GroupArguments) -> Result<Self, CommandFailure> {
        Self::with(group, carrier::open(group)?)
    }

    /// Creates the connection from a carrier and the address of its group for output.
    fn with(
        group: &GroupArguments,
        (carrier, shown_group): (Box<dyn Carrier>, String),
    ) -> Result<Self, CommandFailure> {
        Ok(Self {
            carrier,
            start: Instant::now(),
            start_utc: unix_nanos(),
            book: Book::new(),
            prober: Prober::default(),
            wants_calls: false,
            interrupt: SignalGuard::catch()?,
            buffer: vec![0; BUFFER],
            sealing: match &group.keys {
                Some(path) => Some(Sealing::read(path, group.sign)?),
                None => None,
            },
            shown_group,
        })
    }

    /// Returns the received senders and applications.
    pub(crate) fn who(&self) -> InGroup {
        let mut senders = BTreeMap::new();
        for (topic, heard) in self.book.topics() {
            if topic.space != SpaceId::UA {
                let key = (topic.space.get().into(), heard.from.to_string());
                *senders.entry(key).or_default() += 1;
            }
        }
        let applications = self.book.applications();
        let applications =
            applications.map(|((space, from), one)| ((*space, from.to_string()), one.clone()));
        InGroup {
            senders,
            applications: applications.collect(),
        }
    }

    /// Returns the time since the group was joined.
    pub(crate) fn now(&self) -> Duration {
        self.start.elapsed()
    }

    /// Returns the time at which the group was joined, in nanoseconds since 1970.
    pub(crate) const fn start_utc(&self) -> i128 {
        self.start_utc
    }

    /// Returns the address of the group for output.
    pub(crate) fn group(&self) -> &str {
        &self.shown_group
    }

    /// Probes for the calls of all received spaces and of the given spaces.
    pub(crate) fn want_calls(&mut self, spaces: impl IntoIterator<Item = u16>) {
        self.wants_calls = true;
        for space in spaces {
            self.prober.want_calls(space, self.start.elapsed());
        }
    }

    /// Probes for all applications.
    pub(crate) fn want_all(&mut self) {
        self.prober.want_all();
    }

    /// Probes for the description of a topic or call.
    pub(crate) fn want(&mut self, topic: TopicId) {
        let (space, _, writer_id) = topic.triple();
        self.prober.want(space, writer_id, self.start.elapsed());
    }

    /// Probes for the description of a topic again and again, while this function is called.
    pub(crate) fn insist(&mut self, topic: TopicId) {
        let (space, _, writer_id) = topic.triple();
        self.prober.insist(space, writer_id, self.start.elapsed());
    }

    /// Returns the header of a request. Executors drop requests over a broker without the time of
    /// sending.
    pub(crate) fn action_header(&self) -> NetworkHeader<'static> {
        if self.carrier.within().is_none() {
            return NetworkHeader::default();
        }
        let now = Timestamp::from_unix_nanos(self.utc(self.now()));
        NetworkHeader {
            timestamp: Some(now.time),
            picoseconds: Some(now.picoseconds),
            ..NetworkHeader::default()
        }
    }

    pub(crate) fn send(&mut self, datagram: &[u8]) {
        let sealed = self.sealing.as_mut().map(|sealing| sealing.seal(datagram));
        let sent = match sealed.transpose() {
            Ok(sealed) => {
                let datagram = sealed.as_deref().unwrap_or(datagram);
                let message = OutgoingMessage {
                    within: self.carrier.within(),
                    ..OutgoingMessage::new(datagram)
                };
                self.carrier
                    .try_send(&message)
                    .map_err(|error| error.to_string())
            }
            Err(error) => Err(error.to_string()),
        };
        if let Err(error) = sent {
            warn(&format!("a datagram was not sent: {error}"));
        }
    }

    /// Receives messages until the given time, or until `each` ends it. Probes for the description
    /// of every received topic.
    pub(crate) async fn listen(
        &mut self,
        until: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>, Duration) -> Go,
    ) -> Result<ListenEnd, CommandFailure> {
        let mut asked = Duration::ZERO;
        loop {
            let now = self.now();
            if now >= asked {
                asked = now + LOOK;
                self.probe(now);
            }
            if now >= until {
                return match self.carrier.lost() {
                    Some(why) => Err(CommandFailure::Unavailable(why)),
                    None => Ok(ListenEnd::Time),
                };
            }
            if let Some(ended) = self.step(until.min(now + LOOK), each).await? {
                return Ok(ended);
            }
        }
    }

    /// Receives one datagram, or waits until the given time.
    async fn step(
        &mut self,
        until: Duration,
        each: &mut dyn FnMut(DatagramContent<'_>, Duration) -> Go,
    ) -> Result<Option<ListenEnd>, CommandFailure> {
        match self.receive(until).await? {
            Incoming::Interrupted => Ok(Some(ListenEnd::Interrupted)),
            Incoming::Nothing => Ok(None),
            Incoming::Message(received @ Received { length, from, .. }) => {
                let arrived = self.arrived(&received);
                let datagram = self.buffer.get(..length).unwrap_or_default();
                let read = (&mut self.book, self.sealing.as_mut());
                Ok(take(read, (datagram, from), arrived, each))
            }
        }
    }

    /// Receives one datagram into the buffer, or waits until the given time.
    async fn receive(&mut self, until: Duration) -> Result<Incoming, CommandFailure> {
        let until = self.start + until;
        tokio::select! {
            biased;
            () = self.interrupt.received() => Ok(Incoming::Interrupted),
            () = tokio::time::sleep_until(until) => Ok(Incoming::Nothing),
            received = self.carrier.recv(&mut self.buffer) => received
                .map(Incoming::Message)
                .map_err(|error| CommandFailure::Io(format!("cannot hear the group: {error}"))),
        }
    }

    /// Returns the time at which the kernel received a message, since the group was joined. Without
    /// it, and if the clock was set meanwhile, it is the present time.
    fn arrived(&self, received: &Received) -> Duration {
        let now = self.now();
        let stamp = received.stamp.map(of_system_time);
        let stamp = stamp.and_then(|stamp| u64::try_from(stamp - self.start_utc).ok());
        let stamp = stamp.map(Duration::from_nanos);
        let waited = |stamp: &Duration| now.checked_sub(*stamp);
        let fits = |stamp: &Duration| waited(stamp).is_some_and(|waited| waited <= LONGEST_WAIT);
        stamp.filter(fits).unwrap_or(now)
    }

    /// Returns whether an address is the source of own messages.
    fn is_own(&self, from: SocketAddr) -> bool {
        self.carrier.source().is_some_and(|source| {
            let ip = source.ip();
            source.port() == from.port() && (ip.is_unspecified() || ip == from.ip())
        })
    }

    /// Returns the nanoseconds since 1970 at a time since the group was joined.
    fn utc(&self, now: Duration) -> i128 {
        utc(self.start_utc, now)
    }

    /// Sends the probes that are due.
    fn probe(&mut self, now: Duration) {
        self.ask_for_all(now);
        self.probe_what_is_due(now);
    }

    /// Probes for all topics that have values but no description.
    fn ask_for_all(&mut self, now: Duration) {
        let (mut known, mut wanted) = (BTreeSet::new(), BTreeSet::new());
        for (topic, _) in self.book.topics().filter(|(_, heard)| !heard.secured) {
            let (space, _, writer_id) = topic.triple();
            let is_known = self.book.described(topic).is_some();
            let writers = if is_known { &mut known } else { &mut wanted };
            writers.insert((space, writer_id));
        }
        for (space, writer_id) in &wanted {
            self.prober.want(*space, *writer_id, now);
        }
        // If several programs use a DataSetWriterId, probing continues until all have answered.
        for (space, writer_id) in known.difference(&wanted) {
            self.prober.answered(*space, *writer_id);
        }
        if self.wants_calls {
            for space in self.book.spaces() {
                self.prober.want_calls(space, now);
            }
        }
    }

    fn probe_what_is_due(&mut self, now: Duration) {
        if self.carrier.lost().is_some() {
            return;
        }
        if let Some(datagram) = self.prober.poll(now) {
            self.send(&datagram);
        }
    }

    /// Reports the messages that were dropped.
    pub(crate) fn tell_dropped(&self) {
        for (drop, count) in self.book.dropped() {
            warn(&format!("{count} left out: {}", drop.label()));
        }
    }
}

/// Handles a datagram. Returns [`ListenEnd::Enough`] if `each` ends the listening.
fn take(
    (book, sealing): (&mut Book, Option<&mut Sealing>),
    (datagram, from): (&[u8], SocketAddr),
    now: Duration,
    each: &mut dyn FnMut(DatagramContent<'_>, Duration) -> Go,
) -> Option<ListenEnd> {
    let mut go = Go::On;
    let mut each = |news: DatagramContent<'_>| {
        if go == Go::On {
            go = each(news, now);
        }
    };
    let Ok(message) = NetworkMessage::decode(datagram) else {
        book.malformed();
        return None;
    };
    let mut scratch = Vec::new();
    let message = match sealing {
        Some(sealing) => sealing.open(message, &mut scratch),
        None => message,
    };
    book.handle((&message, from), now, &mut each);
    (go == Go::Enough).then_some(ListenEnd::Enough)
}

#[expect(clippy::disallowed_methods, reason = "the one read of this clock")]
pub(crate) fn unix_nanos() -> i128 {
    of_system_time(SystemTime::now())
}

/// Returns the nanoseconds since 1970.
fn of_system_time(time: SystemTime) -> i128 {
    let since = time.duration_since(UNIX_EPOCH);
    i128::try_from(since.unwrap_or_default().as_nanos()).unwrap_or_default()
}

/// Returns the nanoseconds since 1970 at a time since `start`, which has the same origin.
fn utc(start: i128, elapsed: Duration) -> i128 {
    let elapsed = i128::try_from(elapsed.as_nanos()).unwrap_or(i128::MAX);
    start.saturating_add(elapsed)
}

/// Returns the time `seconds` after `now`; without `seconds`, a time that is never reached.
pub(crate) fn until(now: Duration, seconds: Option<f64>) -> Duration {
    let seconds = seconds.map(Duration::try_from_secs_f64);
    match seconds {
        None | Some(Err(_)) => Duration::MAX / 4,
        Some(Ok(seconds)) => now.saturating_add(seconds),
    }
}

/// The longest time that a message waits in the socket.
const LONGEST_WAIT: Duration = Duration::from_secs(10);
/// The interval at which due probes are sent.
const LOOK: Duration = Duration::from_millis(100);
