//! The present and the past values of the topics, and the notifications of their changes.

use std::sync::Arc;

use mappings::{Mapping, TopicId};
use opcua::server::{MonitoredItemHandle, SubscriptionCache};
use opcua::sync::RwLock;
use opcua::types::{AttributeId, DataValue, NodeId, NumericRange, StatusCode, Variant};

use super::items::ClientValues;
use crate::alarms::Alarms;
use crate::budget::SMALL;
use crate::confirm::Confirms;
use crate::history::{HistoryFile, Past, Series, StoredValue};
use crate::layout::TopicNode;
use crate::values::{CurrentValues, ShownValue};

/// The values of the topics.
pub(crate) struct LiveValues {
    values: RwLock<CurrentValues>,
    past: RwLock<Past>,
    items: ClientValues,
    /// The confirmations of writes.
    confirms: Arc<Confirms>,
    /// The conditions of values.
    alarms: Arc<Alarms>,
}

impl LiveValues {
    /// Creates the values of topics that all wait for their first value.
    pub(super) fn new(confirms: Arc<Confirms>, alarms: Arc<Alarms>) -> Self {
        Self {
            values: RwLock::new(CurrentValues::new(MOST_HELD)),
            past: RwLock::new(Past::new(0, 0)),
            items: ClientValues::default(),
            confirms,
            alarms,
        }
    }

    /// Returns the monitored items of the values.
    pub(super) const fn items(&self) -> &ClientValues {
        &self.items
    }

    /// Removes the values of the topics in `gone`, and describes the topics in `new` to the
    /// history. Returns the lock of the values, to be held until the clients are notified.
    pub(super) fn exchange(&self, gone: &[TopicNode], new: &[TopicNode]) -> impl Sized {
        let mut values = self.values.write();
        let mut past = self.past.write();
        for topic in gone {
            values.remove(topic.topic);
            past.remove(topic.topic);
        }
        for topic in new {
            past.describe(topic);
        }
        values
    }

    /// Sets the limits of past values.
    pub(crate) fn limit_past(&self, mapping: &Mapping) {
        let usual = mapping.server().history;
        let variables = mapping.variables().iter();
        let own = variables.filter_map(|one| Some((one.topic, usize::from(one.history?))));
        let most = (usize::from(usual.values), usual.bytes);
        self.past.write().limit(most, own.collect());
    }

    /// Adds the past values of a file, and stores all further values there.
    pub(crate) fn keep_past_in(&self, (store, stored): (HistoryFile, Vec<StoredValue>)) {
        self.past.write().keep_in(store, stored);
    }

    /// Writes the remaining past values to their file.
    pub(crate) fn close_past(&self) {
        self.past.write().close();
    }

    /// Returns the current value of a topic.
    pub(crate) fn shown(&self, topic: TopicId) -> ShownValue {
        let shown = self.values.read().get(topic).cloned();
        shown.unwrap_or_else(ShownValue::waiting)
    }

    /// Shows a new value of a topic, notifies the monitored items of its nodes, and adds the value
    /// to the history.
    ///
    /// # Errors
    /// Returns `BadOutOfMemory` if there is not enough memory for the value; the nodes then show
    /// this status.
    pub(crate) fn show(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        shown: ShownValue,
    ) -> Result<(), StatusCode> {
        self.put(subscriptions, topic, (shown, true))
    }

    /// Shows the current value of a topic with another status.
    pub(crate) fn show_again(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        shown: ShownValue,
    ) {
        // The value is stored already, so the memory limit does not apply.
        let _kept = self.put(subscriptions, topic, (shown, false));
    }

    fn put(
        &self,
        subscriptions: &SubscriptionCache,
        topic: &TopicNode,
        (shown, is_new): (ShownValue, bool),
    ) -> Result<(), StatusCode> {
        // The lock is held until all items are notified, so that notifications keep their order.
        let mut values = self.values.write();
        let (before, kept) = values.put(topic.topic, shown);
        let Some(shown) = values.get(topic.topic) else {
            return kept;
        };
        if is_new {
            self.past.write().keep(topic.topic, shown);
            self.confirms.heard(topic.topic, shown);
        }
        let before = before.unwrap_or_else(ShownValue::waiting);
        let views = before.views(topic).zip(shown.views(topic));
        for (node, (before, view)) in topic.nodes().zip(views) {
            self.items.notify(subscriptions, node, &view, &before);
        }
        drop(values);
        self.alarms.look(topic.topic, || self.shown(topic.topic));
        kept
    }

    /// Returns the value of a topic or field for a response, or the reason why it is refused.
    pub(super) fn answer(
        &self,
        (topic, field): (&TopicNode, Option<usize>),
        range: &NumericRange,
    ) -> DataValue {
        let shown = self.shown(topic.topic);
        self.items.answer(shown.view(topic, field), range)
    }

    /// Returns the value of a topic or field for a single monitored item.
    pub(super) fn answer_item(
        &self,
        (topic, field): (&TopicNode, Option<usize>),
        handle: MonitoredItemHandle,
    ) -> DataValue {
        let shown = self.shown(topic.topic);
        let view = shown.view(topic, field);
        self.items.for_item(handle, &view, &mut None).0
    }

    /// Returns the value of a topic or field, unless it is large.
    pub(super) fn small(&self, (topic, field): (&TopicNode, Option<usize>)) -> Option<Variant> {
        let shown = self.shown(topic.topic);
        let view = shown.view(topic, field);
        let small = view.weight() <= SMALL;
        small.then(|| view.data_value(&NumericRange::None).value)?
    }

    /// Sends the current value of a node to a single monitored item.
    pub(super) fn look_at(
        &self,
        subscriptions: &SubscriptionCache,
        node: &NodeId,
        (topic, field): (&TopicNode, Option<usize>),
        handle: MonitoredItemHandle,
    ) {
        // The lock is held until the item is notified, as for every value.
        let values = self.values.read();
        if let Some(shown) = values.get(topic.topic) {
            let view = shown.view(topic, field);
            let (value, _) = self.items.for_item(handle, &view, &mut None);
            let mut notifier = subscriptions.data_notifier();
            if let Some(mut batch) = notifier.notify_for(node, AttributeId::Value) {
                batch.data_value_to_item(value, &handle);
            }
        }
    }

    /// Returns the past values of a topic or field.
    pub(super) fn series(&self, place: (Arc<TopicNode>, Option<usize>)) -> Series {
        let kept = self.past.read().of(place.0.topic);
        Series::new(place, kept)
    }
}

/// Size limit of all current values, in bytes.
const MOST_HELD: usize = 512 << 20;
