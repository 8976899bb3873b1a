//! The connection with the broker: a task that reconnects.

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use mappings::MqttVersion;
use mqtt_protocol_core::mqtt;
use mqtt_protocol_core::mqtt::common::Cursor;
use mqtt_protocol_core::mqtt::connection::{ConnectionOptions, GenericEvent, TimerKind};
use mqtt_protocol_core::mqtt::packet::{GenericPacketTrait as _, Packet};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::{Notify, mpsc};
use tokio::time::{Instant as TokioInstant, sleep, sleep_until, timeout};
use tracing::{debug, info, warn};

use crate::packets::{self, ConnectAck, PacketEvent, ReceivedPublish};
use crate::queue::{QueuedMessage, QueuedPublish, SendQueue};
use crate::settings::{BrokerSettings, random};
use crate::stream::{BrokerStream, connect};
use crate::subscriptions::{Response, Subscriptions};
use crate::version::{VersionChoice, VersionResponse};

/// The state that the task shares with the carrier.
#[derive(Debug, Default)]
pub(crate) struct ConnectionShared {
    state: Mutex<SharedState>,
    /// Wakes the task, because the queue has messages or the connection is to be closed.
    wake: Notify,
}

#[derive(Debug, Default)]
pub(crate) struct SharedState {
    pub(crate) queue: SendQueue,
    pub(crate) link: BrokerLink,
    /// Number of connections so far.
    pub(crate) connections: u64,
    /// The retained messages by topic. They are published again with each connection, because a
    /// broker may lose them.
    pub(crate) kept: BTreeMap<String, QueuedPublish>,
    /// Number of received messages that were dropped because the program is too slow.
    pub(crate) overflow: u64,
    closing: bool,
    closed: bool,
}

/// The state of the connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum BrokerLink {
    /// There is no connection, for this reason.
    Waiting(String),
    /// The broker accepted the connection.
    Connected {
        at: SocketAddr,
        version: MqttVersion,
        /// The largest packet that the broker takes.
        max_packet: Option<u32>,
    },
}

impl Default for BrokerLink {
    fn default() -> Self {
        Self::Waiting("not connected yet".to_owned())
    }
}

impl ConnectionShared {
    /// Returns the state. It stays consistent if a holder of the lock panics.
    pub(crate) fn state(&self) -> MutexGuard<'_, SharedState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Wakes the task for queued messages.
    pub(crate) fn wake(&self) {
        self.wake.notify_one();
    }

    /// Closes the connection after the queued messages.
    pub(crate) fn close(&self) {
        self.state().closing = true;
        self.wake.notify_one();
    }

    /// Records that there is no connection, and what the last connection had not sent. Returns
    /// false if the connection is to be closed.
    fn waits(&self, why: &str, unsent: Unsent) -> bool {
        let mut state = self.state();
        state.queue.lose(unsent.in_flight, unsent.unwritten);
        state.link = BrokerLink::Waiting(why.to_owned());
        !state.closing
    }

    /// Records that the connection is closed.
    pub(crate) fn closed(&self) {
        let mut state = self.state();
        state.link = BrokerLink::Waiting("closed".to_owned());
        state.closed = true;
    }

    pub(crate) fn is_closed(&self) -> bool {
        self.state().closed
    }
}

/// The messages that a connection had not sent when it ended.
struct Unsent {
    /// Messages without a confirmation, in their order.
    in_flight: Vec<QueuedMessage>,
    /// Number of messages that were not written and need no confirmation.
    unwritten: usize,
}

/// The reason why a connection ended.
enum BrokerConnectionEnd {
    Closed,
    Lost(String),
}

/// Runs the connection until it is closed.
pub(crate) async fn run(
    settings: Arc<BrokerSettings>,
    shared: Arc<ConnectionShared>,
    received: mpsc::Sender<(ReceivedPublish, SocketAddr)>,
) {
    let mut pause = FIRST_PAUSE;
    let mut version = VersionChoice::new(settings.broker.version);
    let mut retains = true;
    loop {
        let before = shared.state().connections;
        let began = TokioInstant::now();
        let mut session = Session::new(&settings, &shared, (version.next(), retains));
        let ended = session.run(&received).await;
        version.ended(match session.accepted {
            Some(_) => VersionResponse::Accepted,
            None => session.response,
        });
        retains &= session.retains;
        // A broker that accepts and closes at once is no reason to hurry.
        if shared.state().connections > before && began.elapsed() > LAST_PAUSE {
            pause = FIRST_PAUSE;
        }
        match ended {
            BrokerConnectionEnd::Lost(why)
                if !received.is_closed() && shared.waits(&why, session.take_unsent()) =>
            {
                debug!(broker = %settings.broker.address, "cannot connect: {why}");
            }
            BrokerConnectionEnd::Lost(_) | BrokerConnectionEnd::Closed => return shared.closed(),
        }
        // Programs that lost the same broker return at different times.
        let jitter = Duration::from_millis(random() % 100);
        tokio::select! {
            () = sleep(pause + jitter) => {}
            () = session.closing() => {}
        }
        pause = (pause * 2).min(LAST_PAUSE);
    }
}

/// A connection with the broker, from its start to its end.
struct Session<'a> {
    settings: &'a BrokerSettings,
    shared: &'a ConnectionShared,
    version: MqttVersion,
    protocol: mqtt::Connection<mqtt::role::Client>,
    /// Bytes to write, and the number of them that are written.
    out: (Vec<u8>, usize),
    /// The ends in the bytes to write of the messages that need no confirmation.
    unconfirmed_ends: Vec<usize>,
    timers: BTreeMap<u8, (TimerKind, TokioInstant)>,
    /// The time of the next ping.
    next_ping: TokioInstant,
    /// The time of the first ping after which nothing was received.
    unanswered: Option<TokioInstant>,
    /// Publications that the broker has not confirmed, by their packet identifiers and in their
    /// order; at most [`MAX_UNCONFIRMED`].
    in_flight: VecDeque<(u16, QueuedMessage)>,
    /// Whether the broker has accepted the connection.
    accepted: Option<ConnectAck>,
    subscriptions: Subscriptions,
    at: SocketAddr,
    /// The response to the version, until the broker accepts it.
    response: VersionResponse,
    /// Whether the broker takes retained messages.
    retains: bool,
    /// The time at which a broker that retains no messages receives those messages again that
    /// others would retain.
    next_kept: Option<TokioInstant>,
    over: Option<String>,
    messages: Vec<ReceivedPublish>,
}

impl<'a> Session<'a> {
    fn new(
        settings: &'a BrokerSettings,
        shared: &'a ConnectionShared,
        (version, retains): (MqttVersion, bool),
    ) -> Self {
        let protocol_version = match version {
            MqttVersion::V3_1_1 => mqtt::Version::V3_1_1,
            MqttVersion::V5 => mqtt::Version::V5_0,
        };
        let options = ConnectionOptions::new().maximum_packet_size_recv(packets::MAX_RECEIVED);
        let mut protocol = mqtt::Connection::with_options(protocol_version, options);
        protocol.set_auto_pub_response(true);
        // The library pings only if nothing else is sent, so a broker that does not read would not
        // be noticed.
        let _no_events = protocol.set_pingreq_send_interval(Some(0));
        Self {
            settings,
            shared,
            version,
            protocol,
            out: (Vec::new(), 0),
            unconfirmed_ends: Vec::new(),
            timers: BTreeMap::new(),
            next_ping: TokioInstant::now() + PING,
            unanswered: None,
            in_flight: VecDeque::new(),
            accepted: None,
            subscriptions: Subscriptions::default(),
            at: SocketAddr::from(([0, 0, 0, 0], 0)),
            response: VersionResponse::Unknown,
            retains,
            next_kept: None,
            over: None,
            messages: Vec::new(),
        }
    }

    async fn run(
        &mut self,
        received: &mpsc::Sender<(ReceivedPublish, SocketAddr)>,
    ) -> BrokerConnectionEnd {
        let connected = tokio::select! {
            connected = connect(self.settings) => connected,
            () = self.closing() => return BrokerConnectionEnd::Closed,
        };
        let mut stream = match connected {
            Ok((stream, at)) => {
                self.at = at;
                stream
            }
            Err(error) => return BrokerConnectionEnd::Lost(error.to_string()),
        };
        match packets::connect(self.settings, (self.version, self.retains)) {
            Ok(packet) => self.send(packet),
            Err(error) => return BrokerConnectionEnd::Lost(format!("cannot connect: {error:?}")),
        }
        let ended = self.exchange(&mut stream, received).await;
        if let BrokerConnectionEnd::Closed = ended {
            self.finish(&mut stream).await;
        }
        ended
    }

    /// Completes when the carrier is to be closed.
    async fn closing(&self) {
        loop {
            if self.shared.state().closing {
                return;
            }
            self.shared.wake.notified().await;
        }
    }

    /// Exchanges packets until the connection ends.
    async fn exchange(
        &mut self,
        stream: &mut Box<dyn BrokerStream>,
        received: &mpsc::Sender<(ReceivedPublish, SocketAddr)>,
    ) -> BrokerConnectionEnd {
        let begin = TokioInstant::now();
        let (mut reader, mut writer) = tokio::io::split(stream);
        let mut buffer = vec![0; READ];
        loop {
            if let Some(why) = self.over.take() {
                return BrokerConnectionEnd::Lost(why);
            }
            for message in std::mem::take(&mut self.messages) {
                match received.try_send((message, self.at)) {
                    Ok(()) => {}
                    // Waiting would stop the connection in both directions.
                    Err(TrySendError::Full(_)) => self.shared.state().overflow += 1,
                    Err(TrySendError::Closed(_)) => return BrokerConnectionEnd::Closed,
                }
            }
            if self.fill() {
                return BrokerConnectionEnd::Closed;
            }
            let connected = self.is_connected();
            // A cluster may need seconds for each subscription.
            let ready = match self.accepted {
                None => begin + ACCEPT,
                Some(_) => begin + SUBSCRIBE,
            };
            let timer = self.next_timer((!connected).then_some(ready));
            let pending = self.out.0.len() > self.out.1;
            tokio::select! {
                read = reader.read(&mut buffer) => match read {
                    Ok(0) => {
                        self.response = VersionResponse::Silent;
                        return BrokerConnectionEnd::Lost("the broker closed the connection".to_owned());
                    }
                    Ok(length) => self.receive(buffer.get(..length).unwrap_or_default()),
                    Err(error) => return BrokerConnectionEnd::Lost(lost(&error)),
                },
                written = writer.write(self.out.0.get(self.out.1..).unwrap_or_default()), if pending => {
                    match written {
                        Ok(0) => return BrokerConnectionEnd::Lost("the broker closed the connection".to_owned()),
                        Ok(length) => self.written(length),
                        Err(error) => return BrokerConnectionEnd::Lost(lost(&error)),
                    }
                }
                () = sleep_until(timer) => {
                    if !connected && TokioInstant::now() >= ready {
                        return BrokerConnectionEnd::Lost("the broker does not respond".to_owned());
                    }
                    self.fire(TokioInstant::now());
                }
                () = self.shared.wake.notified(), if !pending => {}
            }
        }
    }

    /// Returns the time of the next timeout. `ready` is set until the broker has confirmed the
    /// subscriptions.
    fn next_timer(&self, ready: Option<TokioInstant>) -> TokioInstant {
        let timers = self.timers.values().map(|(_, at)| *at);
        let stalled = self.unanswered.map(|since| since + self.patience());
        let ping = ready.is_none().then_some(self.next_ping);
        let retry = self.subscriptions.poll_timeout().map(TokioInstant::from);
        let retry = retry.filter(|_| ready.is_none());
        let kept = self.next_kept;
        let all = timers
            .chain(stalled)
            .chain(ready)
            .chain(ping)
            .chain(retry)
            .chain(kept);
        all.min().unwrap_or(self.next_ping)
    }

    /// Returns the time without an answer after which the broker is left. A message may take
    /// `within`, and receivers drop later messages.
    fn patience(&self) -> Duration {
        STALL.max(self.settings.broker.within)
    }

    fn is_connected(&self) -> bool {
        matches!(self.shared.state().link, BrokerLink::Connected { .. })
    }

    fn written(&mut self, length: usize) {
        self.out.1 += length;
        if self.out.1 >= self.out.0.len() {
            self.out.0.clear();
            self.out.1 = 0;
            self.unconfirmed_ends.clear();
        }
    }

    /// Takes the messages that were not sent.
    fn take_unsent(&mut self) -> Unsent {
        let (_, written) = self.out;
        let ends = self.unconfirmed_ends.iter();
        Unsent {
            unwritten: ends.filter(|end| **end > written).count(),
            in_flight: self.in_flight.drain(..).map(|(_, of)| of).collect(),
        }
    }

    /// Fills the write buffer with waiting messages, if it is empty: a message is taken as late as
    /// possible, so that it expires in the queue. Returns whether the connection is to be closed.
    fn fill(&mut self) -> bool {
        if !self.out.0.is_empty() || !self.is_connected() {
            return self.out.0.is_empty() && self.shared.state().closing;
        }
        while self.out.0.len() < WRITE {
            let now = TokioInstant::now().into_std();
            let is_full = self.in_flight.len() >= MAX_UNCONFIRMED
                || self.protocol.get_receive_maximum_vacancy_for_send() == Some(0);
            let mut state = self.shared.state();
            let Some(message) = state.queue.pop(now, !is_full) else {
                return state.closing && state.queue.is_empty() && self.out.0.is_empty();
            };
            drop(state);
            self.publish(message);
        }
        false
    }

    fn publish(&mut self, message: QueuedMessage) {
        let mut publication = with_time_left(&message);
        publication.retained &= self.retains;
        let id = match publication.confirmed {
            // All identifiers are used only if the broker confirms nothing.
            true => self.protocol.acquire_packet_id().ok(),
            false => None,
        };
        if let Some(id) = id {
            self.in_flight.push_back((id, message));
        }
        match packets::publish(publication, (self.version, id)) {
            Ok(packet) => {
                let before = self.out.0.len();
                self.send(packet);
                if self.out.0.len() == before {
                    // The library refuses the packet.
                    self.confirmed(id);
                    self.shared.state().queue.refused += 1;
                    warn!(
                        "cannot publish a message: the broker does not accept its size; raise the size limit of the broker"
                    );
                } else if id.is_none() {
                    self.unconfirmed_ends.push(self.out.0.len());
                }
            }
            Err(error) => {
                self.confirmed(id);
                self.shared.state().queue.refused += 1;
                warn!(?error, "cannot publish a message to the broker");
            }
        }
    }

    /// Removes a publication that the broker has confirmed or will not confirm.
    fn confirmed(&mut self, id: Option<u16>) {
        self.in_flight.retain(|(other, _)| Some(*other) != id);
    }

    fn send(&mut self, packet: Packet) {
        let events = self.protocol.send(packet);
        self.handle(events);
    }

    fn receive(&mut self, bytes: &[u8]) {
        self.unanswered = None;
        let mut cursor = Cursor::new(bytes);
        let length = u64::try_from(bytes.len()).unwrap_or(u64::MAX);
        while cursor.position() < length && self.over.is_none() {
            let events = self.protocol.recv(&mut cursor);
            self.handle(events);
        }
    }

    fn fire(&mut self, now: TokioInstant) {
        let patience = self.patience();
        if self.unanswered.is_some_and(|since| now >= since + patience) {
            let seconds = patience.as_secs();
            self.over = Some(format!("no response from the broker for {seconds} s"));
            return;
        }
        if self.is_connected() && now >= self.next_ping {
            self.next_ping = now + PING;
            self.unanswered.get_or_insert(now);
            match packets::ping(self.version) {
                Ok(packet) => self.send(packet),
                Err(error) => warn!(?error, "cannot ping the broker"),
            }
        }
        for filter in self.subscriptions.take_due(now.into_std()) {
            self.subscribe(filter);
        }
        if self.next_kept.is_some_and(|next| next <= now) {
            self.next_kept = Some(now + KEPT_REPEATED);
            let mut state = self.shared.state();
            let SharedState { queue, kept, .. } = &mut *state;
            for publication in kept.values() {
                // What does not fit into the queue is published the next time.
                let _full = queue.push(publication.clone(), now.into_std()).is_err();
            }
        }
        let due: Vec<TimerKind> = self
            .timers
            .values()
            .filter(|(_, at)| *at <= now)
            .map(|(kind, _)| *kind)
            .collect();
        for kind in due {
            self.timers.remove(&key(kind));
            let events = self.protocol.notify_timer_fired(kind);
            self.handle(events);
        }
    }

    fn handle(&mut self, events: Vec<GenericEvent<u16>>) {
        for event in events {
            match event {
                GenericEvent::RequestSendPacket { packet, .. } => {
                    self.out.0.extend_from_slice(&packet.to_continuous_buffer());
                }
                GenericEvent::NotifyPacketReceived(packet) => self.packet(packet),
                GenericEvent::NotifyPacketIdReleased(id) => {
                    self.confirmed(Some(id));
                }
                GenericEvent::RequestTimerReset { kind, duration_ms } => {
                    let at = TokioInstant::now() + Duration::from_millis(duration_ms);
                    self.timers.insert(key(kind), (kind, at));
                }
                GenericEvent::RequestTimerCancel(kind) => {
                    self.timers.remove(&key(kind));
                }
                GenericEvent::NotifyError(error) => {
                    debug!(?error, "rejected a packet of the broker");
                }
                GenericEvent::RequestClose => {
                    let why = "the broker violated the protocol, or refused the protocol version";
                    self.over.get_or_insert_with(|| why.to_owned());
                }
            }
        }
    }

    fn packet(&mut self, packet: Packet) {
        match packets::event(packet) {
            PacketEvent::Accepted(accepted) => self.accepted(accepted),
            PacketEvent::Refused {
                why,
                version,
                retained_will,
            } => {
                if version {
                    self.response = VersionResponse::Refused;
                }
                self.retains &= !retained_will;
                self.over = Some(why);
            }
            PacketEvent::Message(message) => self.messages.push(message),
            PacketEvent::Subscribed { id, refused } => self.subscribed(id, refused),
            PacketEvent::Ended(why) => self.over = Some(why),
            PacketEvent::Other => {}
        }
    }

    fn accepted(&mut self, accepted: ConnectAck) {
        self.retains &= accepted.retains;
        self.accepted = Some(accepted);
        for filter in 0..self.settings.filters.len() {
            self.subscribe(filter);
        }
        self.settle();
    }

    /// Requests a subscription.
    fn subscribe(&mut self, filter: usize) {
        let settings = self.settings;
        let Some(wanted) = settings.filters.get(filter) else {
            return;
        };
        let Ok(id) = self.protocol.acquire_packet_id() else {
            return;
        };
        match packets::subscribe(wanted, (self.version, id)) {
            Ok(packet) => {
                self.subscriptions.request(id, filter);
                self.send(packet);
            }
            Err(error) => warn!(
                ?error,
                filter = wanted.name,
                "cannot subscribe at the broker"
            ),
        }
    }

    /// Handles the response to a subscription.
    fn subscribed(&mut self, id: u16, refused: bool) {
        let response = self.subscriptions.respond(id, refused, instant());
        self.report(response);
        self.settle();
    }

    /// Begins to send messages, if the broker has responded to all subscriptions.
    fn settle(&mut self) {
        let Some(ConnectAck { max_packet, .. }) = self.accepted else {
            return;
        };
        if !self.subscriptions.is_settled() || self.is_connected() {
            return;
        }
        let now = TokioInstant::now();
        self.next_ping = now + PING;
        self.next_kept = (!self.retains).then(|| now + KEPT_REPEATED);
        let mut state = self.shared.state();
        state.connections += 1;
        let SharedState { queue, kept, .. } = &mut *state;
        queue.begin(kept.values(), instant());
        state.link = BrokerLink::Connected {
            at: self.at,
            version: self.version,
            max_packet,
        };
        let broker = &self.settings.broker.address;
        info!(%broker, version = ?self.version, retains = self.retains, "connected to the MQTT broker");
    }

    /// Logs the first refusal of a subscription, and its end.
    fn report(&self, response: Response) {
        let name = |filter: usize| self.settings.filters.get(filter).map(|of| of.name.as_str());
        match response {
            Response::Refused(filter) => warn!(
                filter = name(filter),
                hint = "allow the client to read the topics of its prefix, or wait until the cluster has a leader",
                "the broker refuses a subscription; it is requested again"
            ),
            Response::Mended(filter) => {
                info!(
                    filter = name(filter),
                    "the broker confirms the subscription"
                );
            }
            Response::Confirmed | Response::RefusedAgain | Response::Unknown => {}
        }
    }

    /// Ends the session in order: the broker discards the will, and everything written arrives.
    async fn finish(&mut self, stream: &mut Box<dyn BrokerStream>) {
        if let Ok(packet) = packets::disconnect(self.version) {
            self.send(packet);
        }
        let last = async {
            let rest = self.out.0.get(self.out.1..).unwrap_or_default();
            stream.write_all(rest).await?;
            stream.shutdown().await?;
            let mut rest = [0; 256];
            while stream.read(&mut rest).await? > 0 {}
            Ok::<_, io::Error>(())
        };
        if timeout(FINISH, last).await.is_err() {
            debug!("the broker did not close the connection in time");
        }
    }
}

fn lost(error: &io::Error) -> String {
    format!("the connection with the broker was lost: {error}")
}

const fn key(kind: TimerKind) -> u8 {
    match kind {
        TimerKind::PingreqSend => 0,
        TimerKind::PingreqRecv => 1,
        TimerKind::PingrespRecv => 2,
    }
}

/// Returns the time for the queue.
pub(crate) fn instant() -> Instant {
    TokioInstant::now().into_std()
}

/// Returns the publication of a message with the time that it has left: the broker stores it no
/// longer.
fn with_time_left((publication, until): &QueuedMessage) -> QueuedPublish {
    let now = TokioInstant::now().into_std();
    let left = until.map(|until| until.saturating_duration_since(now));
    QueuedPublish {
        within: left.or(publication.within),
        ..publication.clone()
    }
}

/// The time without an answer after which a broker is left, or `within` if it is longer.
pub const STALL: Duration = Duration::from_secs(3);
/// The interval of pings.
const PING: Duration = Duration::from_secs(1);
/// The time for the acceptance of a connection.
const ACCEPT: Duration = Duration::from_secs(5);
/// The time for the acceptance of a connection and its subscriptions.
const SUBSCRIBE: Duration = Duration::from_secs(30);
/// The time for the orderly end of a connection.
const FINISH: Duration = Duration::from_secs(1);
/// The interval of the messages for a broker that retains none: who joins later has them within a
/// second.
const KEPT_REPEATED: Duration = Duration::from_millis(700);
/// The first and the longest pause before a reconnection.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LAST_PAUSE: Duration = Duration::from_secs(10);
/// The size of the read buffer, and the number of bytes that are written at once.
const READ: usize = 64 << 10;
const WRITE: usize = 16 << 10;
/// The most publications without confirmation; brokers accept at least 20 at a time by default.
const MAX_UNCONFIRMED: usize = 20;

#[cfg(test)]
mod tests;
