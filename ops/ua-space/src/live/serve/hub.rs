//! The channels that are offered to viewers, and the queues of the viewers.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use mappings::TopicId;
use serde_json::{Value, json};
use tokio::sync::Notify;

use super::assets::{AssetRequest, Assets};
use crate::live::channels::{ChannelMismatch, TopicChannel};
use crate::report::warn;

/// Connects the values of a group with the viewers.
#[derive(Debug)]
pub(super) struct ViewerHub {
    /// The name of the server for users.
    name: String,
    pub(super) assets: Assets,
    state: Mutex<ViewerHubState>,
}

#[derive(Debug, Default)]
struct ViewerHubState {
    /// The channels of each topic, as they are advertised: one for each description of the topic.
    /// The models of robots have no topic.
    offered: BTreeMap<Option<TopicId>, Vec<Offered>>,
    /// The values that each new subscriber gets, by channel.
    kept: BTreeMap<u16, LastValue>,
    clients: BTreeMap<u64, Arc<ConnectedViewer>>,
    last_client: u64,
    /// The reasons that were reported.
    told: Vec<ChannelMismatch>,
}

/// A channel as it is advertised.
#[derive(Debug)]
struct Offered {
    channel: u16,
    shown: Value,
}

/// A value for new subscribers.
#[derive(Debug)]
struct LastValue {
    time: u64,
    data: Vec<u8>,
}

/// A value in its channel.
#[derive(Debug, Clone, Copy)]
pub(super) struct Publication<'a> {
    pub(super) channel: u16,
    /// The time of arrival, in nanoseconds since 1970.
    pub(super) time: u64,
    pub(super) data: &'a [u8],
}

/// A connected viewer.
#[derive(Debug, Default)]
pub(super) struct ConnectedViewer {
    queue: Mutex<Queue>,
    /// Wakes the sender of the connection.
    pub(super) wake: Notify,
    /// Ends the connection of a viewer that does not read.
    pub(super) given_up: Notify,
    /// Announces that the file that the viewer asked for is sent.
    pub(super) asset_sent: Notify,
}

/// The messages that wait for a viewer.
#[derive(Debug, Default)]
struct Queue {
    /// Messages of the protocol.
    control: VecDeque<String>,
    /// The size of all messages of the protocol.
    control_weight: usize,
    /// The file that the viewer asked for.
    asset: Option<Vec<u8>>,
    /// Values, oldest first.
    values: VecDeque<Vec<u8>>,
    /// The size of all waiting values.
    weight: usize,
    /// Values that were dropped since the last report to the viewer.
    dropped: u64,
    /// The channels of the subscriptions, by the number that the viewer chose.
    subscriptions: BTreeMap<u32, u16>,
    closed: bool,
}

/// A message to send to a viewer.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Next {
    Text(String),
    /// A value or a file.
    Binary(Vec<u8>),
    /// Nothing waits.
    Nothing,
    /// The connection ends.
    Closed,
}

impl ViewerHub {
    /// Creates the hub of a group.
    pub(super) fn new(group: &str, assets: Assets) -> Self {
        Self {
            name: format!("ua-space live of {group}"),
            assets,
            state: Mutex::default(),
        }
    }

    /// Adds a viewer; `None` if there are too many.
    pub(super) fn connect(&self) -> Option<(u64, Arc<ConnectedViewer>)> {
        let mut state = self.state();
        if state.clients.len() >= MOST_CLIENTS {
            return None;
        }
        state.last_client += 1;
        let id = state.last_client;
        let client = Arc::new(ConnectedViewer::default());
        let capabilities: &[&str] = match self.assets.is_empty() {
            true => &[],
            false => &["assets"],
        };
        let info = json!({
            "op": "serverInfo",
            "name": self.name,
            "capabilities": capabilities,
            "supportedEncodings": [],
            "metadata": {},
            "sessionId": format!("{}-{id}", std::process::id()),
        });
        client.tell(&info);
        let offered = state.offered.values().flatten();
        let channels: Vec<&Value> = offered.map(|one| &one.shown).collect();
        if !channels.is_empty() {
            client.tell(&json!({"op": "advertise", "channels": channels}));
        }
        state.clients.insert(id, Arc::clone(&client));
        Some((id, client))
    }

    /// Removes a viewer.
    pub(super) fn disconnect(&self, id: u64) {
        self.state().clients.remove(&id);
    }

    /// Ends all connections.
    pub(super) fn close(&self) {
        for client in self.state().clients.values() {
            client.queue().closed = true;
            client.wake.notify_one();
        }
    }

    /// Returns whether no viewer is connected.
    pub(super) fn is_empty(&self) -> bool {
        self.state().clients.is_empty()
    }

    /// Offers a channel with one value, which each subscriber gets once.
    pub(super) fn keep(&self, channel: &TopicChannel, (time, data): (u64, Vec<u8>)) {
        self.state()
            .kept
            .insert(channel.id, LastValue { time, data });
        self.offer(None, channel);
    }

    /// Offers a channel of a topic, or a channel without a topic. The other channels of the topic
    /// stay, because writers with different descriptions may alternate.
    /// [`TopicChannels`](crate::live::channels::TopicChannels) limits their number.
    pub(super) fn offer(&self, topic: Option<TopicId>, channel: &TopicChannel) {
        let mut state = self.state();
        let others = state.offered.entry(topic).or_default();
        if others.iter().any(|one| one.channel == channel.id) {
            return;
        }
        // Viewers refuse a second channel of the same name.
        let name = match others.iter().any(|one| one.name() == channel.name) {
            true => format!("{}/{}", channel.name, others.len() + 1),
            false => channel.name.clone(),
        };
        let shown = json!({
            "id": channel.id,
            "topic": name,
            "encoding": channel.encoding,
            "schemaName": channel.schema_name,
            "schema": channel.schema,
            "schemaEncoding": channel.schema_encoding,
        });
        let news = json!({"op": "advertise", "channels": [&shown]});
        others.push(Offered {
            channel: channel.id,
            shown,
        });
        for client in state.clients.values() {
            client.tell(&news);
        }
    }

    /// Returns whether a viewer subscribes to a channel.
    pub(super) fn is_wanted(&self, channel: u16) -> bool {
        let state = self.state();
        let mut clients = state.clients.values();
        clients.any(|client| {
            let queue = client.queue();
            queue.subscriptions.values().any(|of| *of == channel)
        })
    }

    /// Queues a value for all its subscribers.
    pub(super) fn publish(&self, publication: &Publication<'_>) {
        for client in self.state().clients.values() {
            client.push(publication);
        }
    }

    /// Reports values that are not offered, once for each reason.
    pub(super) fn leave_out(&self, unfit: ChannelMismatch) {
        let mut state = self.state();
        if !state.told.contains(&unfit) {
            state.told.push(unfit);
            warn(&format!("left out: {}", unfit.label()));
        }
    }

    /// Handles a message of a viewer. Returns the request for a file.
    pub(super) fn handle(&self, client: &ConnectedViewer, text: &str) -> Option<AssetRequest> {
        let Ok(message) = serde_json::from_str::<Value>(text) else {
            client.refuse("this is no JSON object");
            return None;
        };
        let numbers = |list: &str, key: Option<&str>| -> Vec<Value> {
            let all = message.get(list).and_then(Value::as_array);
            let all = all.into_iter().flatten().take(MOST_SUBSCRIPTIONS);
            all.filter_map(|one| match key {
                Some(key) => one.get(key).cloned(),
                None => Some(one.clone()),
            })
            .collect()
        };
        match message.get("op").and_then(Value::as_str) {
            Some("subscribe") => {
                let ids = numbers("subscriptions", Some("id"));
                let channels = numbers("subscriptions", Some("channelId"));
                for (id, channel) in ids.iter().zip(&channels) {
                    self.subscribe(client, id, channel);
                }
            }
            Some("unsubscribe") => {
                let mut queue = client.queue();
                for id in numbers("subscriptionIds", None) {
                    let id = id.as_u64().and_then(|id| u32::try_from(id).ok());
                    if let Some(id) = id {
                        queue.subscriptions.remove(&id);
                    }
                }
            }
            Some("fetchAsset") if !self.assets.is_empty() => {
                let id = message.get("requestId").and_then(Value::as_u64);
                let id = id.and_then(|id| u32::try_from(id).ok());
                let uri = message.get("uri").and_then(Value::as_str);
                if let (Some(id), Some(uri)) = (id, uri) {
                    let uri = uri.to_owned();
                    return Some(AssetRequest { id, uri });
                }
                client.refuse("a request for a file has a number as requestId, and a uri");
            }
            Some(_) | None => client.refuse("this server is read-only: subscribe or unsubscribe"),
        }
        None
    }

    fn subscribe(&self, client: &ConnectedViewer, id: &Value, channel: &Value) {
        let id = id.as_u64().and_then(|id| u32::try_from(id).ok());
        let channel = channel.as_u64().and_then(|of| u16::try_from(of).ok());
        let (Some(id), Some(channel)) = (id, channel) else {
            return client.refuse("a subscription has a number as id and as channelId");
        };
        let state = self.state();
        let mut offered = state.offered.values().flatten();
        if !offered.any(|one| one.channel == channel) {
            return client.refuse(&format!("channel {channel} is not offered"));
        }
        if let Err(why) = client.subscribe(id, channel) {
            return client.refuse(&why.to_string());
        }
        if let Some(LastValue { time, data }) = state.kept.get(&channel) {
            client.push(&Publication {
                channel,
                time: *time,
                data,
            });
        }
    }

    fn state(&self) -> MutexGuard<'_, ViewerHubState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Offered {
    /// Returns the name for viewers.
    fn name(&self) -> &str {
        self.shown
            .get("topic")
            .and_then(Value::as_str)
            .unwrap_or_default()
    }
}

/// The reason why a viewer does not get a subscription.
#[derive(Debug, thiserror::Error)]
enum NotSubscribed {
    #[error("channel {channel} is subscribed already")]
    Twice { channel: u16 },
    #[error("too many subscriptions")]
    TooMany,
}

impl ConnectedViewer {
    /// Returns the next message for the viewer.
    pub(super) fn next(&self) -> Next {
        let mut queue = self.queue();
        if queue.closed {
            return Next::Closed;
        }
        if let Some(text) = queue.control.pop_front() {
            queue.control_weight -= text.len();
            return Next::Text(text);
        }
        if let Some(asset) = queue.asset.take() {
            self.asset_sent.notify_one();
            return Next::Binary(asset);
        }
        if queue.dropped > 0 {
            let dropped = std::mem::take(&mut queue.dropped);
            let message = format!("{dropped} values dropped: this viewer reads too slowly");
            return Next::Text(status(1, &message));
        }
        match queue.values.pop_front() {
            Some(value) => {
                queue.weight -= value.len();
                Next::Binary(value)
            }
            None => Next::Nothing,
        }
    }

    /// Adds a subscription.
    ///
    /// # Errors
    /// [`NotSubscribed`]: a second subscription to the channel, which would double its values, or
    /// too many subscriptions.
    fn subscribe(&self, id: u32, channel: u16) -> Result<(), NotSubscribed> {
        let mut queue = self.queue();
        if queue.subscriptions.values().any(|of| *of == channel) {
            return Err(NotSubscribed::Twice { channel });
        }
        if queue.subscriptions.len() >= MOST_SUBSCRIPTIONS {
            return Err(NotSubscribed::TooMany);
        }
        queue.subscriptions.insert(id, channel);
        Ok(())
    }

    /// Queues a value if the viewer subscribes to its channel. The oldest values give way.
    fn push(&self, publication: &Publication<'_>) {
        let mut queue = self.queue();
        let mut subscriptions = queue.subscriptions.iter();
        let of = subscriptions.find(|(_, channel)| **channel == publication.channel);
        let Some(id) = of.map(|(id, _)| *id) else {
            return;
        };
        let mut frame = Vec::with_capacity(publication.data.len() + 13);
        frame.push(MESSAGE_DATA);
        frame.extend(id.to_le_bytes());
        frame.extend(publication.time.to_le_bytes());
        frame.extend(publication.data);
        queue.weight += frame.len();
        queue.values.push_back(frame);
        while queue.weight > MOST_WEIGHT || queue.values.len() > MOST_VALUES {
            let Some(oldest) = queue.values.pop_front() else {
                break;
            };
            queue.weight -= oldest.len();
            queue.dropped += 1;
        }
        self.wake.notify_one();
    }

    /// Queues a file that the viewer asked for. At most one waits.
    pub(super) fn push_asset(&self, message: Vec<u8>) {
        self.queue().asset = Some(message);
        self.wake.notify_one();
    }

    fn tell(&self, message: &Value) {
        self.queue_text(message.to_string());
    }

    fn refuse(&self, why: &str) {
        self.queue_text(status(2, why));
    }

    /// Queues a message of the protocol. A viewer that does not read them is disconnected.
    fn queue_text(&self, text: String) {
        let mut queue = self.queue();
        if queue.closed {
            return;
        }
        queue.control_weight += text.len();
        queue.control.push_back(text);
        if queue.control_weight > MOST_CONTROL {
            *queue = Queue {
                closed: true,
                ..Queue::default()
            };
            self.given_up.notify_one();
        }
        self.wake.notify_one();
    }

    fn queue(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns a message for the user of a viewer; level 1 is a warning, 2 an error.
fn status(level: u8, message: &str) -> String {
    json!({"op": "status", "level": level, "message": message}).to_string()
}

/// The opcode of a binary message with a value.
const MESSAGE_DATA: u8 = 1;
const MOST_CLIENTS: usize = 32;
/// Maximum size and number of values that wait for a viewer. A value that is larger than the size
/// alone is dropped.
const MOST_WEIGHT: usize = 8 << 20;
const MOST_VALUES: usize = 4096;
/// Maximum size of the messages of the protocol that wait for a viewer. The descriptions of all
/// channels are one of them.
const MOST_CONTROL: usize = 64 << 20;
const MOST_SUBSCRIPTIONS: usize = 20_000;

#[cfg(test)]
mod tests;
