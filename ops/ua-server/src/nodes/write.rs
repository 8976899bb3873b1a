//! The writes of clients: each is computed, sent to the run loop, and shown.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use mappings::TopicId;
use opcua::server::SubscriptionCache;
use opcua::server::authenticator::UserToken;
use opcua::server::node_manager::{ParsedWriteValue, RequestContext};
use opcua::sync::Mutex;
use opcua::types::{DataValue, DateTime, NumericRange, StatusCode, Variant};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use uadp::Timestamp;

use super::Exits;
use super::live::LiveValues;
use crate::arrivals::PendingWrite;
use crate::budget::LARGEST;
use crate::commanders::Commander;
use crate::confirm::Confirms;
use crate::layout::{FieldNode, TopicNode};
use crate::leaving::{Departing, Departure, LONGEST_WAY_OUT, NOT_ACTIVE, departure};
use crate::properties;
use crate::pubsub::PubSubNodes;
use crate::redundant::ServerRole;
use crate::value;
use crate::values::{SampleStamp, ShownValue};

/// Sends and shows the values that clients write.
pub(crate) struct WritePath {
    live: Arc<LiveValues>,
    /// Serializes the writes of clients.
    writing: Mutex<()>,
    /// Size limit of a written value, in bytes.
    largest: AtomicUsize,
    /// If the channel is full, the client gets an error.
    writes: mpsc::Sender<ClientWrite>,
    /// Limits the total size of the values in the channel, in KiB.
    room: Arc<Semaphore>,
    pubsub: Arc<PubSubNodes>,
    confirms: Arc<Confirms>,
    role: ServerRole,
}

/// A value that a client wrote to a topic of the OPC UA side.
#[derive(Debug)]
pub(crate) struct ClientWrite {
    pub(crate) topic: TopicId,
    /// The fields of the DataSet as a key frame carries them.
    pub(crate) block: Bytes,
    pub(crate) source: Timestamp,
    /// The session of the write.
    pub(crate) commander: Commander,
    /// Released when the value has been sent.
    pub(crate) room: OwnedSemaphorePermit,
    /// Receives the result of sending the value.
    pub(crate) departure: Departure,
    /// Receives the result of the server that the value is written to. Dropped if there is no such
    /// server.
    pub(crate) answer: oneshot::Sender<StatusCode>,
    /// Receives the confirmation of the bridges.
    pub(crate) awaited: Option<PendingWrite>,
}

/// The client of a write.
pub(crate) struct WriteClient {
    pub(crate) subscriptions: Arc<SubscriptionCache>,
    pub(crate) token: UserToken,
    /// Returns the session that commands a topic by a write.
    pub(crate) commander: Box<dyn Fn() -> Commander + Send + Sync>,
}

impl WriteClient {
    pub(super) fn of(context: &RequestContext) -> Self {
        Self {
            subscriptions: Arc::clone(&context.subscriptions),
            token: context.token.clone(),
            commander: Commander::of(context),
        }
    }
}

/// The pending results of a value that is being sent.
struct OnItsWay {
    departing: Departing,
    answered: oneshot::Receiver<StatusCode>,
}

/// A callback for the fields of a write before it is sent, and the confirmation that the write
/// waits for.
type Registration<'r> = (&'r dyn Fn(&[Variant]), Option<PendingWrite>);

impl WritePath {
    pub(super) fn new(live: Arc<LiveValues>, exits: &Exits) -> Self {
        Self {
            live,
            writing: Mutex::new(()),
            largest: AtomicUsize::new(usize::MAX),
            writes: exits.writes.clone(),
            room: Arc::clone(&exits.room),
            pubsub: Arc::clone(&exits.pubsub),
            confirms: Arc::clone(&exits.confirms),
            role: exits.role.clone(),
        }
    }

    /// Sets the size limit of written values, in bytes.
    pub(crate) fn limit(&self, largest: usize) {
        self.largest.store(largest, Ordering::Relaxed);
    }

    /// Shows a written value as uncertain if it is unknown whether it has arrived, until it is
    /// confirmed or a newer value replaces it.
    pub(crate) fn show_arrival(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        has_arrived: bool,
    ) {
        // A write is sent and shown under this lock.
        let _alone = self.writing.lock();
        let mut shown = self.live.shown(topic.topic);
        if let Some(status) = arrived(shown.stamp.status, has_arrived) {
            shown.stamp.status = status;
            shown.stamp.server = DateTime::now();
            self.live.show_again(subscriptions, topic, shown);
        }
    }

    /// Shows a written value as uncertain that was not sent, unless a newer value replaced it.
    fn show_not_sent(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        shown_at: DateTime,
    ) {
        let _alone = self.writing.lock();
        let mut shown = self.live.shown(topic.topic);
        if shown.stamp.server == shown_at && shown.stamp.status == StatusCode::Good {
            shown.stamp.status = UNCONFIRMED;
            shown.stamp.server = DateTime::now();
            self.live.show_again(subscriptions, topic, shown);
        }
    }

    /// Writes a value to a topic or to one of its fields. The client may write it.
    pub(super) async fn write(
        &self,
        writer: &WriteClient,
        (topic, field): (&TopicNode, Option<usize>),
        write: &ParsedWriteValue,
    ) -> Result<StatusCode, StatusCode> {
        let place = (topic, field);
        if let Some(rule) = self.confirms.of(topic.topic) {
            let send =
                |register: &dyn Fn(&[Variant])| self.send_written(writer, place, write, register);
            let arrived = self.confirms.write(topic.topic, &rule, send).await?;
            // The value has arrived, even if there is not enough memory to show it.
            let _shown = self.live.show(&writer.subscriptions, topic, arrived);
            return Ok(StatusCode::Good);
        }
        let arrivals = &self.confirms.arrivals;
        let (awaited, awaiting) = arrivals.await_write(topic.topic, field).unzip();
        if topic.targeted {
            let (sent, on_its_way) = {
                let _alone = self.writing.lock();
                self.send_alone(writer, place, write, (&|_| {}, awaited))?
            };
            let left = on_its_way.departing.left().await;
            // The other server may have the value although the group does not.
            let status = match tokio::time::timeout(LONGEST_WAY_OUT, on_its_way.answered).await {
                Ok(Ok(status)) => status,
                // A reload of the mapping or a change of the role dropped the value.
                Ok(Err(_)) => left.err().unwrap_or(StatusCode::BadNoCommunication),
                Err(_) => StatusCode::BadTimeout,
            };
            if status.is_bad() {
                return Err(status);
            }
            let _shown = self.live.show(&writer.subscriptions, topic, sent);
            if let Some(awaiting) = awaiting {
                awaiting.arrived().await?;
            }
            return Ok(status);
        }
        let (on_its_way, shown_at) = self.write_and_show(writer, place, (write, awaited))?;
        if let Err(status) = on_its_way.departing.left().await {
            self.show_not_sent(&writer.subscriptions, topic, shown_at);
            return Err(status);
        }
        if let Some(awaiting) = awaiting {
            awaiting.arrived().await?;
        }
        Ok(StatusCode::Good)
    }

    /// Sends a value and shows it. Returns the server timestamp of the shown value.
    fn write_and_show(
        &self,
        writer: &WriteClient,
        place: (&TopicNode, Option<usize>),
        (write, awaited): (&ParsedWriteValue, Option<PendingWrite>),
    ) -> Result<(OnItsWay, DateTime), StatusCode> {
        // No other write may come between sending and showing, because a write of a single field
        // keeps the current values of the other fields.
        let _alone = self.writing.lock();
        let (sent, on_its_way) = self.send_alone(writer, place, write, (&|_| {}, awaited))?;
        let shown_at = sent.stamp.server;
        let _shown = self.live.show(&writer.subscriptions, place.0, sent);
        Ok((on_its_way, shown_at))
    }

    /// Calls [`send_alone`](Self::send_alone) with the write lock held. The confirmation replaces
    /// the result of sending.
    fn send_written(
        &self,
        writer: &WriteClient,
        place: (&TopicNode, Option<usize>),
        write: &ParsedWriteValue,
        register: &dyn Fn(&[Variant]),
    ) -> Result<ShownValue, StatusCode> {
        let _alone = self.writing.lock();
        let (sent, _on_its_way) = self.send_alone(writer, place, write, (register, None))?;
        Ok(sent)
    }

    /// Computes all fields of the topic after a write, registers and sends them. Returns the value
    /// to show afterwards, and the pending results of sending. The caller holds the write lock.
    fn send_alone(
        &self,
        writer: &WriteClient,
        (topic, at): (&TopicNode, Option<usize>),
        write: &ParsedWriteValue,
        (register, awaited): Registration<'_>,
    ) -> Result<(ShownValue, OnItsWay), StatusCode> {
        if self.pubsub.is_off(topic.topic) || self.role.is_standby() {
            // The writer of the topic is disabled, or another server is active: the value would
            // not be sent.
            return Err(NOT_ACTIVE);
        }
        if write
            .value
            .status
            .is_some_and(|status| status != StatusCode::Good)
        {
            return Err(StatusCode::BadWriteNotSupported);
        }
        let value = write
            .value
            .value
            .as_ref()
            .ok_or(StatusCode::BadTypeMismatch)?;
        let shown = self.live.shown(topic.topic);
        let field = at.and_then(|field| topic.fields.get(field));
        let fields = new_fields(&shown, topic, field, (value, &write.index_range))?;
        if !properties::are_within(topic, &fields) {
            return Err(StatusCode::BadOutOfRange);
        }
        let block = Bytes::from(value::fields_block(&fields)?);
        register(&fields);
        drop(fields);
        let source = source_of(&write.value);
        let value = (block.clone(), source);
        let on_its_way = self.send((topic, at), value, ((writer.commander)(), awaited))?;
        let stamp = SampleStamp {
            status: StatusCode::Good,
            source: Some(source),
            server: DateTime::now(),
        };
        let block = Some(block);
        Ok((ShownValue { block, stamp }, on_its_way))
    }

    /// Passes a written value to the run loop.
    fn send(
        &self,
        (topic, field): (&TopicNode, Option<usize>),
        (block, source): (Bytes, Timestamp),
        (commander, awaited): (Commander, Option<PendingWrite>),
    ) -> Result<OnItsWay, StatusCode> {
        if block.len() > self.largest.load(Ordering::Relaxed) {
            return Err(StatusCode::BadRequestTooLarge);
        }
        let full = StatusCode::BadResourceUnavailable;
        let size = u32::try_from(block.len() >> 10).map_err(|_| full)?;
        let room = Arc::clone(&self.room);
        let room = room.try_acquire_many_owned(size).map_err(|_| full)?;
        let (departure, departing) = departure(field);
        let (answer, answered) = oneshot::channel();
        let write = ClientWrite {
            topic: topic.topic,
            block,
            source,
            commander,
            room,
            departure,
            answer,
            awaited,
        };
        self.writes.try_send(write).map_err(|_| full)?;
        Ok(OnItsWay {
            departing,
            answered,
        })
    }
}

/// Returns the new status of a written value, or `None` if its status stays.
fn arrived(shown: StatusCode, has_arrived: bool) -> Option<StatusCode> {
    let (before, after) = if has_arrived {
        (UNCONFIRMED, StatusCode::Good)
    } else {
        (StatusCode::Good, UNCONFIRMED)
    };
    (shown == before).then_some(after)
}

/// Returns the source timestamp of a client's value, or the current time.
fn source_of(value: &DataValue) -> Timestamp {
    let picoseconds = value.source_picoseconds.unwrap_or_default().min(9_999);
    let (time, picoseconds) = match value.source_timestamp {
        Some(time) => (time, picoseconds),
        None => (DateTime::now(), 0),
    };
    Timestamp {
        time: value::ticks(time),
        picoseconds,
    }
}

/// Returns all fields of a topic after a write to the topic or to one of its fields.
fn new_fields(
    shown: &ShownValue,
    topic: &TopicNode,
    field: Option<&FieldNode>,
    (value, range): (&Variant, &NumericRange),
) -> Result<Vec<Variant>, StatusCode> {
    let current = |field: Option<usize>| {
        let view = shown.view(topic, field);
        let weight = view.weight();
        // The written value is as large and was accepted.
        (weight <= LARGEST).then(|| view.data_value(&NumericRange::None).value)?
    };
    let current = |field| current(field).filter(|value| !matches!(value, Variant::Empty));
    let at = |field: &FieldNode| topic.fields.iter().position(|one| one.node == field.node);
    let value = if range.has_range() {
        let whole = match field.and_then(at) {
            None if topic.compound => None,
            place => current(place.filter(|_| topic.compound)),
        };
        let mut whole = whole.ok_or(StatusCode::BadIndexRangeNoData)?;
        whole.set_range_of(range, value)?;
        whole
    } else {
        value.clone()
    };
    let fields: Vec<Variant> = match (field, topic.compound) {
        (None, true) => members(value)?,
        (None, false) => vec![value],
        (Some(written), _) => topic
            .fields
            .iter()
            .enumerate()
            .map(|(at, other)| match current(Some(at)) {
                _ if other.node == written.node => value.clone(),
                Some(known) => known,
                None => value::zero(other.shape.0),
            })
            .collect(),
    };
    let fit = fields.len() == topic.fields.len()
        && topic
            .fields
            .iter()
            .zip(&fields)
            .all(|(field, value)| field.shape.accepts(value));
    if fit {
        Ok(fields)
    } else {
        Err(StatusCode::BadTypeMismatch)
    }
}

/// Returns the elements of a Variant array.
fn members(value: Variant) -> Result<Vec<Variant>, StatusCode> {
    let Variant::Array(array) = value else {
        return Err(StatusCode::BadTypeMismatch);
    };
    Ok(array
        .values
        .into_iter()
        .map(|value| {
            if let Variant::Variant(inner) = value {
                *inner
            } else {
                value
            }
        })
        .collect())
}

/// Status of a written value while it is unknown if it has arrived.
const UNCONFIRMED: StatusCode = StatusCode::UncertainLastUsableValue;
