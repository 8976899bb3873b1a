//! Subscriptions that are restored after a reconnect.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use opcua::client::{MonitoredItem, OnSubscriptionNotification};
use opcua::types::{
    AttributeId, ContentFilterBuilder, DataChangeFilter, DataChangeTrigger, DataValue,
    DeadbandType, EventFilter, ExtensionObject, MonitoredItemCreateRequest, MonitoringMode,
    MonitoringParameters, NodeId, NumericRange, Operand, QualifiedName, ReadValueId,
    SimpleAttributeOperand, StatusCode, TimestampsToReturn, Variant,
};
use tokio::sync::mpsc;
use tracing::warn;

use super::connection_fault::ConnectionFault;
use super::supervisor::{ConnectedClient, ConnectionState};
use super::{ClientError, LimitedService, OpcUaClient};
use crate::limits::MOST_NOTIFICATIONS;

/// A monitored item.
#[derive(Debug, Clone)]
pub enum MonitoredWatch {
    /// The value of a variable, sampled at the interval of the subscription.
    Value(NodeId),
    /// The value of a variable with its own sampling interval, queue and deadband.
    Sampled(Sampled),
    /// The events of an object.
    Events {
        /// The object, for example the Server object.
        node: NodeId,
        /// The selected fields.
        select: Vec<Select>,
        /// Restricts the events to this type and its subtypes.
        of_type: Option<NodeId>,
    },
}

/// A variable and its monitoring parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Sampled {
    /// The variable.
    pub node: NodeId,
    /// The sampling interval.
    pub interval: Duration,
    /// The queue size at the server: maximum number of changes between two notifications. The
    /// oldest changes are discarded.
    pub queue: u32,
    /// The absolute deadband; 0 reports every change.
    pub deadband: f64,
}

impl Sampled {
    fn filter(&self) -> ExtensionObject {
        if self.deadband <= 0.0 {
            return ExtensionObject::null();
        }
        ExtensionObject::from_message(DataChangeFilter {
            trigger: DataChangeTrigger::StatusValue,
            deadband_type: DeadbandType::Absolute as u32,
            deadband_value: self.deadband,
        })
    }
}

/// A field of an event.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Select {
    /// The type that defines the field. With BaseEventType servers consider only the path.
    pub type_id: NodeId,
    /// The browse path of the field.
    pub path: Vec<QualifiedName>,
}

impl Select {
    /// Creates a field of the core namespace by BrowseNames joined by `/`, for example
    /// `ToState/Id`.
    pub fn new(type_id: impl Into<NodeId>, path: &str) -> Self {
        Self {
            type_id: type_id.into(),
            path: path
                .split('/')
                .map(|name| QualifiedName::new(0, name))
                .collect(),
        }
    }
}

/// A notification of a subscription.
#[derive(Debug, Clone, PartialEq)]
pub enum Notice {
    /// The subscription was created or restored. Changes before this notice may be missing. Current
    /// values follow.
    Subscribed,
    /// A value.
    Value {
        /// The index of the monitored item.
        watch: usize,
        /// The value.
        value: DataValue,
    },
    /// An event.
    Event {
        /// The index of the monitored item.
        watch: usize,
        /// The fields in the order of their selection.
        fields: Vec<Variant>,
    },
    /// The server refused a monitored item.
    Refused {
        /// The index of the monitored item.
        watch: usize,
        /// The status code.
        status: StatusCode,
    },
}

/// A subscription, which the server deletes after this handle is dropped.
pub struct ClientSubscription {
    id: u64,
    notices: mpsc::Receiver<Notice>,
    dropped: Arc<AtomicU64>,
    shared: Arc<ConnectionState>,
}

impl ClientSubscription {
    /// Waits for the next notice; `None` when the client is closed.
    pub async fn next(&mut self) -> Option<Notice> {
        self.notices.recv().await
    }

    /// Returns how many notices were discarded because the queue was full.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

impl Drop for ClientSubscription {
    fn drop(&mut self) {
        if let Some(wanted) = self.shared.wanted.lock().get_mut(&self.id) {
            wanted.gone = true;
        }
        self.shared.changed.notify_one();
    }
}

/// A requested subscription and its state at the server.
pub(crate) struct WantedSubscription {
    watches: Arc<[MonitoredWatch]>,
    interval: Duration,
    queue: Queue,
    state: State,
    gone: bool,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum State {
    Waiting,
    Making,
    /// The ids of its subscriptions at the server.
    Made(Vec<u32>),
    /// The server refused all of its subscriptions.
    Refused,
}

impl WantedSubscription {
    /// Resets the state after the loss of a connection, which ends the subscriptions at the server.
    pub(crate) fn forget(&mut self) {
        self.state = State::Waiting;
    }

    pub(crate) fn is_made(&self) -> bool {
        matches!(self.state, State::Made(_))
    }
}

#[derive(Clone)]
struct Queue {
    notices: mpsc::Sender<Notice>,
    dropped: Arc<AtomicU64>,
}

impl Queue {
    fn put(&self, notice: Notice) {
        if let Err(mpsc::error::TrySendError::Full(_)) = self.notices.try_send(notice) {
            let total = self.dropped.fetch_add(1, Ordering::Relaxed) + 1;
            if 10_u64.pow(total.ilog10()) == total {
                warn!(
                    total,
                    "dropped notifications of a subscription: the program does not process them"
                );
            }
        }
    }
}

/// The callback of the library for notifications.
struct Sink(Queue);

/// Returns the client handle of a monitored item. Handle 0 is reserved by the library.
fn handle(watch: usize) -> u32 {
    u32::try_from(watch).map_or(u32::MAX, |watch| watch.saturating_add(1))
}

fn watch_of(item: &MonitoredItem) -> usize {
    usize::try_from(item.client_handle()).map_or(0, |handle| handle.saturating_sub(1))
}

impl OnSubscriptionNotification for Sink {
    fn on_data_value(&mut self, value: DataValue, item: &MonitoredItem) {
        let watch = watch_of(item);
        self.0.put(Notice::Value { watch, value });
    }

    fn on_event(&mut self, fields: Option<Vec<Variant>>, item: &MonitoredItem) {
        let watch = watch_of(item);
        let fields = fields.unwrap_or_default();
        self.0.put(Notice::Event { watch, fields });
    }
}

impl OpcUaClient {
    /// Subscribes to values and events with the publishing interval `interval` and a queue of
    /// `queue` notices. The subscription is created on the current connection and on each later
    /// connection.
    #[must_use]
    pub fn subscribe(
        &self,
        watches: Vec<MonitoredWatch>,
        interval: Duration,
        queue: usize,
    ) -> ClientSubscription {
        let (tell, notices) = mpsc::channel(queue.max(1));
        let dropped = Arc::new(AtomicU64::new(0));
        let shared = Arc::clone(&self.shared);
        let mut wanted = shared.wanted.lock();
        let id = wanted.last_key_value().map_or(0, |(id, _)| id + 1);
        wanted.insert(
            id,
            WantedSubscription {
                watches: watches.into(),
                interval,
                queue: Queue {
                    notices: tell,
                    dropped: Arc::clone(&dropped),
                },
                state: State::Waiting,
                gone: false,
            },
        );
        drop(wanted);
        shared.changed.notify_one();
        ClientSubscription {
            id,
            notices,
            dropped,
            shared,
        }
    }
}

/// Creates the requested subscriptions and deletes the dropped subscriptions.
///
/// # Errors
/// Returns the reason if the connection is not usable.
pub(crate) async fn renew(
    shared: &ConnectionState,
    connected: &ConnectedClient,
) -> Result<(), ConnectionFault> {
    loop {
        let mut gone = None;
        let mut new = None;
        {
            let mut wanted = shared.wanted.lock();
            let id = wanted.iter().find_map(|(id, one)| one.gone.then_some(*id));
            if let Some(id) = id {
                gone = wanted.remove(&id).map(|one| one.state);
            } else if let Some((id, one)) = wanted
                .iter_mut()
                .find(|(_, one)| matches!(one.state, State::Waiting))
            {
                one.state = State::Making;
                new = Some((
                    *id,
                    Arc::clone(&one.watches),
                    one.interval,
                    one.queue.clone(),
                ));
            }
        }
        match (gone, new) {
            (Some(State::Made(ids)), _) => {
                for id in ids {
                    connected.session.delete_subscription(id).await?;
                }
            }
            (Some(State::Waiting | State::Making | State::Refused), _) => {}
            (None, Some((id, watches, interval, queue))) => {
                let made = make(connected, &watches, interval, queue).await?;
                if let Some(wanted) = shared.wanted.lock().get_mut(&id) {
                    wanted.state = made;
                }
            }
            (None, None) => return Ok(()),
        }
    }
}

/// Creates a subscription for monitored items, and further subscriptions for the items that do not
/// fit into it.
async fn make(
    connected: &ConnectedClient,
    watches: &[MonitoredWatch],
    interval: Duration,
    queue: Queue,
) -> Result<State, ConnectionFault> {
    let mut left: Vec<(usize, &MonitoredWatch)> = watches.iter().enumerate().collect();
    let mut made = Vec::new();
    loop {
        let id = match create(connected, interval, &queue).await {
            Ok(id) => id,
            Err(error) if error.status() == StatusCode::BadTooManySubscriptions => {
                refuse(&queue, &left, error.status());
                break;
            }
            Err(error) => return Err(error.into()),
        };
        if made.is_empty() {
            queue.put(Notice::Subscribed);
        }
        let before = left.len();
        left = fill(connected, (id, interval), left, &queue).await?;
        if left.is_empty() {
            made.push(id);
            break;
        }
        let is_stuck = left.len() == before;
        if is_stuck && !made.is_empty() {
            connected.session.delete_subscription(id).await?;
        } else {
            made.push(id);
        }
        if is_stuck || made.len() >= MOST_SUBSCRIPTIONS {
            refuse(&queue, &left, StatusCode::BadTooManyMonitoredItems);
            break;
        }
    }
    Ok(match made.is_empty() {
        true => State::Refused,
        false => State::Made(made),
    })
}

fn refuse(queue: &Queue, watches: &[(usize, &MonitoredWatch)], status: StatusCode) {
    for (watch, _) in watches {
        let watch = *watch;
        queue.put(Notice::Refused { watch, status });
    }
}

async fn create(
    connected: &ConnectedClient,
    interval: Duration,
    queue: &Queue,
) -> Result<u32, opcua::types::Error> {
    let keep_alive = count(KEEP_ALIVE, interval);
    let created = connected.session.create_subscription(
        interval,
        keep_alive.saturating_mul(LIFETIME),
        keep_alive,
        u32::try_from(MOST_NOTIFICATIONS).unwrap_or(u32::MAX),
        0,
        true,
        Sink(queue.clone()),
    );
    created.await
}

/// Adds monitored items to a subscription, and returns the items that do not fit.
async fn fill<'w>(
    connected: &ConnectedClient,
    (id, interval): (u32, Duration),
    watches: Vec<(usize, &'w MonitoredWatch)>,
    queue: &Queue,
) -> Result<Vec<(usize, &'w MonitoredWatch)>, ConnectionFault> {
    let requests: Vec<_> = watches
        .iter()
        .map(|(at, watch)| request(handle(*at), watch, interval))
        .collect();
    let mut parts = connected
        .limits
        .parts(LimitedService::MonitoredItems, &requests);
    while let Some(part) = parts.next_part() {
        let both = TimestampsToReturn::Both;
        let made = connected
            .session
            .create_monitored_items(id, both, part.to_vec());
        let made = made.await;
        let statuses = made.map(|items| items.iter().map(|item| item.result.status_code).collect());
        let Err(fault) = parts.answered(statuses) else {
            continue;
        };
        match ClientError::from(fault) {
            ClientError::Status(full @ StatusCode::BadTooManyMonitoredItems) => {
                parts.skip_all(&full);
            }
            ClientError::Status(status) => parts.skip(&status),
            lost @ (ClientError::NotConnected(_)
            | ClientError::Lost(_)
            | ClientError::Answer(_)) => return Err(lost.into()),
        }
    }
    let mut left = Vec::new();
    for ((watch, what), status) in watches.into_iter().zip(parts.into_answers()) {
        if status == StatusCode::BadTooManyMonitoredItems {
            left.push((watch, what));
        } else if status.is_bad() {
            queue.put(Notice::Refused { watch, status });
        }
    }
    Ok(left)
}

/// Returns the number of intervals in `time`, at least 1.
fn count(time: Duration, interval: Duration) -> u32 {
    let interval = interval.max(Duration::from_millis(1));
    u32::try_from(time.as_millis() / interval.as_millis().max(1)).map_or(u32::MAX, |n| n.max(1))
}

fn request(handle: u32, watch: &MonitoredWatch, interval: Duration) -> MonitoredItemCreateRequest {
    let (node, attribute, filter, queue_size) = match watch {
        MonitoredWatch::Value(node) => (node, AttributeId::Value, ExtensionObject::null(), VALUES),
        MonitoredWatch::Sampled(one) => (&one.node, AttributeId::Value, one.filter(), one.queue),
        MonitoredWatch::Events {
            node,
            select,
            of_type,
        } => {
            let filter = EventFilter {
                select_clauses: Some(
                    select
                        .iter()
                        .map(|field| SimpleAttributeOperand {
                            type_definition_id: field.type_id.clone(),
                            browse_path: Some(field.path.clone()),
                            attribute_id: AttributeId::Value as u32,
                            index_range: NumericRange::None,
                        })
                        .collect(),
                ),
                where_clause: of_type
                    .as_ref()
                    .map(|of_type| {
                        let filter = ContentFilterBuilder::new();
                        filter.of_type(Operand::literal(of_type.clone())).build()
                    })
                    .unwrap_or_default(),
            };
            let filter = ExtensionObject::from_message(filter);
            (node, AttributeId::EventNotifier, filter, EVENTS)
        }
    };
    MonitoredItemCreateRequest {
        item_to_monitor: ReadValueId {
            node_id: node.clone(),
            attribute_id: attribute as u32,
            ..ReadValueId::default()
        },
        monitoring_mode: MonitoringMode::Reporting,
        requested_parameters: MonitoringParameters {
            client_handle: handle,
            // Events have no sampling interval.
            sampling_interval: match watch {
                MonitoredWatch::Value(_) => interval.as_secs_f64() * 1e3,
                MonitoredWatch::Sampled(one) => one.interval.as_secs_f64() * 1e3,
                MonitoredWatch::Events { .. } => 0.0,
            },
            filter,
            queue_size,
            discard_oldest: true,
        },
    }
}

/// Maximum number of subscriptions for a list of monitored items.
const MOST_SUBSCRIPTIONS: usize = 100;
/// Longest time between two notifications or keep-alives of a subscription.
const KEEP_ALIVE: Duration = Duration::from_secs(1);
/// Lifetime of a subscription without a client, in keep-alive intervals.
const LIFETIME: u32 = 10;
/// Queue size of a value at the server.
const VALUES: u32 = 10;
/// Queue size of an event item at the server.
const EVENTS: u32 = 1_000;
