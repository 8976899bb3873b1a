//! The values that clients get: in responses, and at monitored items. Large values are refused when
//! they exceed the limits of [`crate::budget`].

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use opcua::server::{MonitoredItemHandle, SubscriptionCache};
use opcua::sync::Mutex;
use opcua::types::{AttributeId, DataValue, NodeId, NumericRange, StatusCode};
use tracing::warn;

use crate::budget::{Answers, LARGEST, MonitoredMemory, SMALL};
use crate::values::NodeView;

/// The monitored items, and the memory of values for clients.
#[derive(Debug, Default)]
pub(super) struct ClientValues {
    watched: Mutex<MonitoredMemory>,
    answers: Mutex<Answers>,
    /// Number of values that were refused to clients because of their size.
    refused: AtomicU64,
}

impl ClientValues {
    /// Adds a monitored item.
    pub(super) fn insert(&self, handle: MonitoredItemHandle, unfiltered: bool, queue: usize) {
        self.watched.lock().insert(handle, unfiltered, queue);
    }

    /// Changes the queue sizes of monitored items.
    pub(super) fn resize(&self, items: impl Iterator<Item = (MonitoredItemHandle, usize)>) {
        let mut watched = self.watched.lock();
        for (handle, queue) in items {
            watched.resize(handle, queue);
        }
    }

    /// Removes monitored items.
    pub(super) fn remove(&self, items: impl Iterator<Item = MonitoredItemHandle>) {
        let mut watched = self.watched.lock();
        for handle in items {
            watched.remove(handle);
        }
    }

    /// Reserves memory for a value of a response. Returns false if there is not enough left.
    pub(super) fn take(&self, weight: usize) -> bool {
        self.answers.lock().take(weight, now())
    }

    /// Returns a range of a value for a response, or the reason why it is refused.
    pub(super) fn answer(&self, view: NodeView<'_>, range: &NumericRange) -> DataValue {
        let (view, range) = view.narrowed(range);
        let weight = view.weight();
        let refused = match weight {
            ..=SMALL => None,
            LARGEST.. => Some(StatusCode::BadResponseTooLarge),
            _ if self.take(weight) => None,
            _ => Some(StatusCode::BadOutOfMemory),
        };
        match refused {
            Some(status) => self.refuse(&view, weight, status),
            None => view.data_value(&range),
        }
    }

    /// Notifies the monitored items of a node. For an item without a filter the unpatched library
    /// compares values only, although a changed status has to be reported too (OPC 10000-4, 7.22.2:
    /// the default trigger is StatusValue). A DataValue without a value in between makes it report
    /// both; clients with a queue size of 1 see only the second.
    pub(super) fn notify(
        &self,
        subscriptions: &SubscriptionCache,
        node: &NodeId,
        view: &NodeView<'_>,
        before: &NodeView<'_>,
    ) {
        let mut notifier = subscriptions.data_notifier();
        let Some(mut items) = notifier.notify_for(node, AttributeId::Value) else {
            return;
        };
        let flipped = !plant_opcua::patches::are_applied()
            && before.stamp().status != view.stamp().status
            && before.has_value_of(view);
        let between = flipped.then(|| view.between());
        let weight = view.weight();
        if weight <= SMALL {
            if let Some(between) = between {
                let watched = self.watched.lock();
                for (handle, _) in items.entries() {
                    if watched.is_unfiltered(*handle) {
                        items.data_value_to_item(between.clone(), handle);
                    }
                }
            }
            items.data_value(view.data_value(&NumericRange::None));
            return;
        }
        let mut decoded = None;
        for (handle, _) in items.entries() {
            let (value, unfiltered) = self.for_item(*handle, view, &mut decoded);
            if let Some(between) = &between
                && unfiltered
            {
                items.data_value_to_item(between.clone(), handle);
            }
            items.data_value_to_item(value, handle);
        }
    }

    /// Returns the value for a monitored item, or the reason why it is refused, and if the item has
    /// no filter. The value is decoded once for all items.
    pub(super) fn for_item(
        &self,
        handle: MonitoredItemHandle,
        view: &NodeView<'_>,
        decoded: &mut Option<DataValue>,
    ) -> (DataValue, bool) {
        let weight = view.weight();
        let (status, unfiltered) = {
            let mut watched = self.watched.lock();
            let status = match weight {
                LARGEST.. => Some(StatusCode::BadResponseTooLarge),
                _ if watched.take(handle, weight) => None,
                _ => Some(StatusCode::BadOutOfMemory),
            };
            (status, watched.is_unfiltered(handle))
        };
        let value = match status {
            Some(status) => self.refuse(view, weight, status),
            None => decoded
                .get_or_insert_with(|| view.data_value(&NumericRange::None))
                .clone(),
        };
        (value, unfiltered)
    }

    /// Returns the DataValue of a refused value. The refusal is logged at the 1st, 10th, 100th ...
    /// time.
    fn refuse(&self, view: &NodeView<'_>, weight: usize, status: StatusCode) -> DataValue {
        let total = self.refused.fetch_add(1, Ordering::Relaxed) + 1;
        if 10_u64.pow(total.ilog10()) == total {
            warn!(
                total,
                "a client receives {status} instead of a value of {} MiB, which exceeds its limit; it can read fewer elements with an IndexRange",
                weight >> 20
            );
        }
        view.refused(status)
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "answers to clients are given now"
)]
fn now() -> Instant {
    Instant::now()
}
