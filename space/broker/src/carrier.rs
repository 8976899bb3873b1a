//! The carrier: topics of sent messages, and admission of received messages.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use mappings::{Broker, MqttVersion, TopicId};
use tokio::sync::mpsc;
use tokio::time::{Sleep, sleep};
use transport::{Carrier, CarrierChange, OutgoingMessage, Received, SendError, Senders};
use uadp::discovery::ConnectionState;
use uadp::{NetworkMessage, Timestamp};

use crate::address::{self, Addressed, alone};
use crate::connection::{BrokerLink, SharedState, instant};
use crate::echo::Echo;
use crate::json::{Json, PromotedTexts};
use crate::links::BrokerLinks;
use crate::packets::ReceivedPublish;
use crate::producers::Producers;
use crate::queue::QueuedPublish;
use crate::reports::BrokerReports;
use crate::settings::{BrokerIdentity, BrokerSettings, OpenError};
use crate::topics::{self, Address, JSON, TopicMessageType, UADP};

/// A connection with an MQTT broker that carries the NetworkMessages of a program.
pub struct Mqtt {
    settings: Arc<BrokerSettings>,
    links: BrokerLinks,
    received: mpsc::Receiver<(ReceivedPublish, SocketAddr)>,
    /// Messages for the caller.
    ready: VecDeque<(Vec<u8>, SocketAddr)>,
    producers: Producers,
    echo: Echo,
    reports: BrokerReports,
    json: Json,
    /// Numbers of dropped messages by reason.
    dropped: BTreeMap<&'static str, u64>,
    /// The last reported state of the connection; `None` before the first report.
    connected: Option<bool>,
    /// Polls the end of the connection.
    closing: Option<std::pin::Pin<Box<Sleep>>>,
}

impl fmt::Debug for Mqtt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let broker = self.settings.broker.address.to_string();
        f.debug_struct("Mqtt")
            .field("broker", &broker)
            .finish_non_exhaustive()
    }
}

impl Mqtt {
    /// Starts to connect with the broker. A broker that is not there is waited for.
    ///
    /// Must be called within a tokio runtime.
    ///
    /// # Errors
    /// An [`OpenError`] if a file with certificates or the log-in cannot be used.
    pub fn open(broker: &Broker, identity: &BrokerIdentity) -> Result<Self, OpenError> {
        let settings = Arc::new(BrokerSettings::read(broker, identity)?);
        let confirmed = BrokerSettings::of_confirmed(broker, identity)?;
        let reports = BrokerReports::new(settings.will.is_some());
        let (out, received) = mpsc::channel(MAX_RECEIVED);
        let links = BrokerLinks::open(&settings, confirmed, out);
        Ok(Self {
            settings,
            links,
            received,
            ready: VecDeque::new(),
            producers: Producers::default(),
            echo: Echo::default(),
            reports,
            json: Json::new(broker.encoding),
            dropped: BTreeMap::new(),
            connected: None,
            closing: None,
        })
    }

    fn broker(&self) -> &Broker {
        &self.settings.broker
    }

    /// Returns whether values are sent as JSON.
    fn writes_json(&self) -> bool {
        topics::encoding(self.broker().encoding) == JSON
    }

    fn publication(&self, encoding: &str, address: Address, payload: Vec<u8>) -> QueuedPublish {
        let retained = address.kind.is_retained();
        let broker = self.broker();
        // Discovery messages are published again, and a broker that cannot retain them may end the
        // connection of the values.
        let is_value = address.kind == TopicMessageType::Data;
        QueuedPublish {
            topic: topics::name(broker, encoding, address),
            payload,
            retained,
            confirmed: broker.at_least_once && is_value,
            replaceable: retained,
            outlasts: false,
            within: retained.then_some(RETAINED),
            message_type: message_type(address.kind),
            content_type: if encoding == JSON {
                CONTENT_JSON
            } else {
                CONTENT_UADP
            },
            promoted: PromotedTexts::default(),
        }
    }

    /// Publishes a retained message now and with each connection.
    fn keep(&mut self, publication: QueuedPublish) {
        self.echo.sent(&publication.topic, &publication.payload);
        let shared = self.links.main();
        let mut state = shared.state();
        let SharedState {
            queue, kept, link, ..
        } = &mut *state;
        if matches!(link, BrokerLink::Connected { .. }) {
            // The message is published again later if the queue is full.
            let _full = queue.push(publication.clone(), instant()).is_err();
        }
        if kept.len() < MAX_KEPT || kept.contains_key(&publication.topic) {
            kept.insert(publication.topic.clone(), publication);
        }
        drop(state);
        shared.wake();
    }

    /// Returns whether a message is an own retained message.
    fn is_kept(&self, topic: &str, payload: &[u8]) -> bool {
        self.links.keeps(topic, |own| own == payload)
    }

    /// Clears a retained message.
    fn clear(&self, topic: String) {
        let shared = self.links.main();
        let mut state = shared.state();
        state.kept.remove(&topic);
        let cleared = QueuedPublish {
            topic,
            payload: Vec::new(),
            retained: true,
            confirmed: false,
            replaceable: true,
            outlasts: false,
            within: None,
            message_type: "",
            content_type: "",
            promoted: PromotedTexts::default(),
        };
        if matches!(state.link, BrokerLink::Connected { .. }) {
            // With MQTT 5 the message expires if it cannot be cleared.
            let _full = state.queue.push(cleared, instant()).is_err();
        }
        drop(state);
        shared.wake();
    }

    /// Clears the discovery messages of a topic.
    fn withdraw(&self, topic: TopicId) {
        let (publisher, group, writer) = topic.triple();
        for kind in [TopicMessageType::MetaData, TopicMessageType::ActionMetaData] {
            let address = Address {
                kind,
                publisher,
                group: Some(group),
                writer: Some(writer),
            };
            for encoding in [UADP, JSON] {
                let name = topics::name(self.broker(), encoding, address);
                if self.links.keeps(&name, |_| true) {
                    self.clear(name);
                }
            }
        }
    }

    fn count(&mut self, reason: &'static str) {
        *self.dropped.entry(reason).or_default() += 1;
    }

    /// Handles a received message, and queues the messages for the caller.
    fn admit(&mut self, message: ReceivedPublish, from: SocketAddr) {
        match self.judge(&message, from) {
            Ok(true) => self.ready.push_back((message.payload, from)),
            Ok(false) => {}
            Err(reason) => self.count(reason),
        }
    }

    /// Returns whether a message is for the caller, or the reason why it is dropped.
    fn judge(&mut self, message: &ReceivedPublish, from: SocketAddr) -> Result<bool, &'static str> {
        let ReceivedPublish {
            topic,
            payload,
            retained,
        } = message;
        let read = topics::parse(self.broker(), topic).ok_or("other_topic")?;
        let Address {
            kind, publisher, ..
        } = read.address;
        if self.echo.is_own(topic, payload) || self.is_kept(topic, payload) {
            return Err("own");
        }
        if payload.is_empty() {
            // A retained message was cleared.
            return Ok(false);
        }
        // Names of the space have no level for the encoding.
        if read.is_json || payload.starts_with(b"{") || payload.starts_with(b"[") {
            return self.judge_json(message, read.address, from);
        }
        // The caller counts malformed messages.
        let Ok(network) = NetworkMessage::decode(payload) else {
            return Ok(true);
        };
        // The access rules of a broker refer to topics.
        if address::publisher(&network) != Some(publisher)
            || !address::agrees(&network, read.address)
        {
            return Err("other_publisher");
        }
        let now = instant();
        if kind == TopicMessageType::Connection {
            if *retained && self.settings.publisher == Some(publisher) {
                self.reports.stray(topic, now);
            }
            return Ok(false);
        }
        if kind == TopicMessageType::Status {
            let status = address::status(&network).ok_or("malformed_status")?;
            let is_own = self.settings.publisher == Some(publisher);
            if is_own && status.0 != ConnectionState::OPERATIONAL {
                // Another program of the space has ended.
                self.reports.hurry();
            }
            let released = self.producers.status(publisher, status, (now, utc()));
            self.release(released, from);
            return Ok(false);
        }
        if !retained {
            let released = self.producers.lives(publisher);
            self.release(released, from);
            if kind == TopicMessageType::MetaData {
                self.json.learn(&network);
            }
            return Ok(true);
        }
        self.judge_retained(message, (&network, read.address))
    }

    /// Judges a retained message, which may be old.
    fn judge_retained(
        &mut self,
        message: &ReceivedPublish,
        (network, address): (&NetworkMessage<'_>, Address),
    ) -> Result<bool, &'static str> {
        let Address {
            kind, publisher, ..
        } = address;
        let ReceivedPublish { topic, payload, .. } = message;
        let now = instant();
        if !kind.is_retained() {
            // A value that another stack retains. It counts only while its publisher runs, and its
            // age decides later.
            let is_state = kind == TopicMessageType::Data;
            let runs = self.producers.is_operational(publisher, now);
            return if is_state && runs {
                Ok(true)
            } else {
                Err("retained")
            };
        }
        if self.settings.publisher == Some(publisher) {
            self.reports.stray(topic, now);
            return Ok(false);
        }
        if self.producers.is_operational(publisher, now) {
            if kind == TopicMessageType::MetaData {
                self.json.learn(network);
            }
            return Ok(true);
        }
        if self.producers.hold(publisher, topic, payload) {
            Ok(false)
        } else {
            Err("no_room")
        }
    }

    /// Judges a message of the JSON mapping, and queues its values as UADP.
    fn judge_json(
        &mut self,
        message: &ReceivedPublish,
        address: Address,
        from: SocketAddr,
    ) -> Result<bool, &'static str> {
        let ReceivedPublish {
            topic,
            payload,
            retained,
        } = message;
        let now = instant();
        let Address {
            kind, publisher, ..
        } = address;
        if !matches!(
            kind,
            TopicMessageType::Data | TopicMessageType::MetaData | TopicMessageType::Status
        ) {
            return Err("other_topic");
        }
        let is_own = self.settings.publisher == Some(publisher);
        if *retained && kind != TopicMessageType::Status {
            let runs = self.producers.is_operational(publisher, now);
            match kind.is_retained() {
                true if is_own => {
                    self.reports.stray(topic, now);
                    return Ok(false);
                }
                true if !runs => {
                    return if self.producers.hold(publisher, topic, payload) {
                        Ok(false)
                    } else {
                        Err("no_room")
                    };
                }
                false if !runs => return Err("retained"),
                true | false => {}
            }
        }
        let reading = self.json.read(payload, address)?;
        if reading.status.is_some() != (kind == TopicMessageType::Status) {
            return Err("other_publisher");
        }
        for fault in reading.faults {
            self.count(fault);
        }
        if let Some(status) = reading.status {
            let released = self.producers.status(publisher, status, (now, utc()));
            self.release(released, from);
        } else if !retained {
            let released = self.producers.lives(publisher);
            self.release(released, from);
        }
        let values = reading.messages.into_iter().map(|bytes| (bytes, from));
        self.ready.extend(values);
        Ok(false)
    }

    /// Handles the retained messages of an Operational publisher.
    fn release(&mut self, released: BTreeMap<String, Vec<u8>>, from: SocketAddr) {
        for (topic, payload) in released {
            let message = ReceivedPublish {
                topic,
                payload,
                retained: false,
            };
            self.admit(message, from);
        }
    }

    /// Publishes a message that the broker keeps, as UADP, and as JSON if the mapping wants JSON.
    fn announce(&mut self, network: &NetworkMessage<'_>, address: Address) {
        self.keep(self.publication(UADP, address, network.datagram().to_vec()));
        if address.kind == TopicMessageType::MetaData {
            self.json.learn_own(network);
        }
        if !self.writes_json() {
            return;
        }
        let json = match (address.kind, address::status(network)) {
            (TopicMessageType::Status, Some(status)) => {
                Some(self.json.status(address.publisher, status, utc()))
            }
            (TopicMessageType::MetaData, _) => self.json.describe(network, utc()),
            _ => None,
        };
        if let Some(json) = json {
            self.keep(self.publication(JSON, address, json));
        }
    }

    /// Publishes the own status.
    fn announce_status(&mut self, publisher: u16, status: &[u8]) {
        if let Ok(network) = NetworkMessage::decode(status) {
            let address = alone(TopicMessageType::Status, publisher);
            self.announce(&network, address);
        }
    }

    /// Publishes the status if it is due, and clears the discovery messages of earlier runs.
    fn report(&mut self) {
        let Some(publisher) = self.settings.publisher else {
            return;
        };
        let now = instant();
        if let Some(status) = self.reports.status(publisher, (now, utc())) {
            self.announce_status(publisher, &status);
        }
        if publisher != 0
            && let Some(connection) = self.reports.connection(publisher, now)
        {
            let address = alone(TopicMessageType::Connection, publisher);
            let publication = self.publication(UADP, address, connection);
            self.keep(publication);
        }
        // Several programs share space 0, so the discovery messages of others are not strays. With
        // MQTT 5 they expire.
        if publisher == 0 {
            return;
        }
        for topic in self.reports.take_strays(now) {
            if !self.links.keeps(&topic, |_| true) {
                self.clear(topic);
            }
        }
    }

    /// Clears the retained messages, publishes the last status, and closes the connections.
    fn end(&mut self) {
        let kept = self.links.kept_topics();
        let status = self
            .settings
            .publisher
            .map(|of| alone(TopicMessageType::Status, of));
        let stays: Vec<String> = [UADP, JSON]
            .into_iter()
            .filter_map(|encoding| Some(topics::name(self.broker(), encoding, status?)))
            .collect();
        for topic in kept {
            if !stays.contains(&topic) {
                self.clear(topic);
            }
        }
        if let Some(publisher) = self.settings.publisher
            && let Some(last) = self.reports.last_status(publisher)
        {
            self.announce_status(publisher, &last);
        }
        self.links.close();
    }

    fn take(&mut self, buffer: &mut Vec<u8>) -> Option<Received> {
        let (bytes, from) = self.ready.pop_front()?;
        if buffer.len() < bytes.len() {
            buffer.resize(bytes.len(), 0);
        }
        let start = buffer.get_mut(..bytes.len())?;
        start.copy_from_slice(&bytes);
        Some(Received {
            length: bytes.len(),
            from,
            stamp: None,
        })
    }
}

impl Carrier for Mqtt {
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        let network = NetworkMessage::decode(message.bytes).map_err(|_| SendError::Refused)?;
        let Addressed { address, withdrawn } =
            address::of(&network, self.settings.publisher).ok_or(SendError::Refused)?;
        if let Some(topic) = withdrawn {
            self.withdraw(topic);
        }
        if address.kind.is_retained() {
            self.announce(&network, address);
            return Ok(());
        }
        // A forwarded value is of another publisher.
        if address.kind == TopicMessageType::Data
            && self.settings.publisher == Some(address.publisher)
        {
            self.reports.uses(address, instant());
        }
        let is_json =
            address.kind == TopicMessageType::Data && !message.command && self.writes_json();
        let json = is_json.then(|| self.json.value(&network, utc())).flatten();
        let mut publication = match json {
            Some(json) => self.publication(JSON, address, json),
            None => self.publication(UADP, address, message.bytes.to_vec()),
        };
        if address.kind == TopicMessageType::Data {
            publication.promoted = self.json.promoted(&network);
        }
        publication.replaceable = message.replaceable && !network.is_chunk();
        publication.within = message.within;
        // Commands are never queued for an absent reader.
        publication.confirmed &= message.replaceable && !message.command;
        // The time bounds the wait.
        publication.outlasts =
            publication.replaceable && !message.command && message.within.is_some();
        let shared = self.links.of(publication.confirmed);
        let mut state = shared.state();
        let (version, max_packet) = match state.link {
            BrokerLink::Connected {
                version,
                max_packet,
                ..
            } => (version, max_packet),
            BrokerLink::Waiting(_) if publication.outlasts => (MqttVersion::V3_1_1, None),
            BrokerLink::Waiting(_) => return Err(SendError::Unreachable),
        };
        let size = publication.payload.len()
            + publication.topic.len()
            + publication.promoted.size()
            + OVERHEAD;
        if max_packet.is_some_and(|most| u32::try_from(size).is_ok_and(|size| size > most)) {
            return Err(SendError::TooBig);
        }
        if self.links.is_returned(version, publication.confirmed) {
            self.echo.sent(&publication.topic, &publication.payload);
        }
        state.queue.push(publication, instant())?;
        drop(state);
        shared.wake();
        Ok(())
    }

    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        loop {
            if let Some(received) = self.take(buffer) {
                return Poll::Ready(Ok(received));
            }
            match self.received.poll_recv(cx) {
                Poll::Ready(Some((message, from))) => self.admit(message, from),
                // The connection is closed: nothing more comes.
                Poll::Ready(None) | Poll::Pending => return Poll::Pending,
            }
        }
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        loop {
            if let Some(received) = self.take(buffer) {
                return Some(Ok(received));
            }
            let (message, from) = self.received.try_recv().ok()?;
            self.admit(message, from);
        }
    }

    fn follow(&mut self) -> Option<CarrierChange> {
        self.report();
        let is_connected = self.lost().is_none();
        if self.connected.replace(is_connected) == Some(is_connected) {
            return None;
        }
        Some(match self.lost() {
            Some(why) => CarrierChange::Lost(why),
            None => CarrierChange::Back(self.interface()),
        })
    }

    fn lost(&self) -> Option<String> {
        self.links.lost(self.broker())
    }

    fn source(&self) -> Option<SocketAddr> {
        None
    }

    fn interface(&self) -> String {
        self.broker().address.to_string()
    }

    fn senders(&self) -> Senders {
        if self.broker().acl {
            Senders::Authorized
        } else {
            Senders::Hidden
        }
    }

    fn within(&self) -> Option<Duration> {
        Some(self.broker().within)
    }

    fn limit(&self) -> Option<usize> {
        let most = usize::try_from(self.links.max_packet()?).unwrap_or(usize::MAX);
        Some(most.saturating_sub(self.broker().prefix.len() + OVERHEAD + LONGEST_TOPIC))
    }

    fn dropped(&self) -> Vec<(&'static str, u64)> {
        let received = self.dropped.iter().map(|(reason, count)| (*reason, *count));
        self.links.dropped().into_iter().chain(received).collect()
    }

    fn close(&mut self) {
        self.links.close_confirmed();
        if self.links.main_is_due() {
            self.end();
        }
    }

    fn poll_closed(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        loop {
            if self.links.main_is_due() {
                self.end();
            }
            if self.links.are_closed() {
                return Poll::Ready(());
            }
            let wait = self
                .closing
                .get_or_insert_with(|| Box::pin(sleep(CLOSED_POLL)));
            if wait.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
            self.closing = None;
        }
    }
}

impl Drop for Mqtt {
    fn drop(&mut self) {
        if self.links.main_waits() {
            self.end();
        }
        self.links.close();
    }
}

/// Returns the value of the user property `UAMessageType`.
const fn message_type(kind: TopicMessageType) -> &'static str {
    match kind {
        TopicMessageType::Data => "ua-data",
        TopicMessageType::MetaData => "ua-metadata",
        TopicMessageType::Status => "ua-status",
        TopicMessageType::Connection => "ua-connection",
        TopicMessageType::Application => "ua-application",
        TopicMessageType::Endpoints => "ua-endpoints",
        TopicMessageType::ActionRequest => "ua-action-request",
        TopicMessageType::ActionResponse => "ua-action-response",
        TopicMessageType::ActionMetaData => "ua-action-metadata",
        TopicMessageType::ActionResponder => "ua-action-responder",
        TopicMessageType::Discovery => "ua-discovery",
        TopicMessageType::Probe => "ua-probe",
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "the time of reports at the broker"
)]
pub(crate) fn utc() -> Timestamp {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let nanos = i128::try_from(since.unwrap_or_default().as_nanos()).unwrap_or_default();
    Timestamp::from_unix_nanos(nanos)
}

const CONTENT_UADP: &str = "application/opcua+uadp";
const CONTENT_JSON: &str = "application/json";
/// The lifetime of a retained message with MQTT 5. Programs announce it again much earlier.
const RETAINED: Duration = Duration::from_secs(300);
/// Size in bytes of the headers and properties of a packet.
const OVERHEAD: usize = 160;
const LONGEST_TOPIC: usize = 64;
/// The most messages that wait for the caller; further messages are dropped.
const MAX_RECEIVED: usize = 4096;
const MAX_KEPT: usize = 65_536;
const CLOSED_POLL: Duration = Duration::from_millis(10);

#[cfg(test)]
mod tests;
