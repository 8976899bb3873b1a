//! The values of the space as the address space shows them.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::{
    ConfirmedArrival, LocalDelivery, PortEvent, Reason, Router, TypePaths, ValueRelation,
};
use bytes::Bytes;
use mappings::{Mapping, SpaceId, TopicId};
use opcua::server::SubscriptionCache;
use opcua::types::StatusCode;

use crate::alarms::Alarms;
use crate::layout::{Layout, LayoutError};
use crate::nodes::SpaceManager;
use crate::pubsub::{PubSubNodeState, PubSubNodes, Readers};
use crate::sources::{self, Sourced};
use crate::space::SpaceWriter;
use crate::structures::{MappedTypes, Structure};

/// The values of the space, with the states of their readers and conditions.
pub(super) struct ShownValues {
    space: SpaceWriter,
    /// The namespaces at the start of the server.
    namespaces: Vec<String>,
    types: MappedTypes,
    /// The PubSub configuration, and the state of its readers.
    pubsub: Arc<PubSubNodes>,
    readers: Readers,
    /// The conditions of values, robots and publishers.
    alarms: Arc<Alarms>,
    /// Topics that were removed or replaced.
    unbound: VecDeque<TopicId>,
    /// Time without messages after which a publisher counts as offline.
    receive_timeout: Duration,
}

/// The changes of the address space after a change of the mapping.
pub(super) struct Exchanged {
    /// The keys of the mapping that take effect at the next start.
    pub(super) restart: Vec<String>,
    /// The removed topics.
    pub(super) gone: Vec<TopicId>,
    /// The added topics.
    pub(super) new: Vec<TopicId>,
}

/// The next step of the shown values.
pub(super) enum ShownStep {
    /// Values have become uncertain with their age.
    Old,
    /// Clients have enabled or disabled writers or readers.
    Switched,
    /// Conditions are due.
    Conditions,
}

impl ShownValues {
    pub(super) fn new(
        (mapping, layout): (&Mapping, &Layout),
        (manager, subscriptions): (Arc<SpaceManager>, Arc<SubscriptionCache>),
        (pubsub, alarms): (Arc<PubSubNodes>, Arc<Alarms>),
        types: MappedTypes,
    ) -> Self {
        Self {
            space: SpaceWriter::new(layout, manager, subscriptions).with_ages(mapping),
            namespaces: layout.namespaces.clone(),
            types,
            pubsub,
            readers: Readers::default(),
            alarms,
            unbound: VecDeque::new(),
            receive_timeout: mapping.pubsub().receive_timeout,
        }
    }

    /// Returns the node manager of the space.
    pub(super) const fn manager(&self) -> &Arc<SpaceManager> {
        self.space.manager()
    }

    /// Returns the conditions.
    pub(super) const fn alarms(&self) -> &Arc<Alarms> {
        &self.alarms
    }

    /// Returns the structures of the address space.
    pub(super) fn structures(&self) -> &[Structure] {
        self.space.structures()
    }

    /// Shows the values that were received, and returns the next topic that was removed.
    pub(super) fn settle(&mut self) -> Option<PortEvent> {
        self.space.settle();
        let topic = self.unbound.pop_front()?;
        Some(PortEvent::Unbound { topic })
    }

    /// Waits for the next step that is due. Cancel-safe.
    pub(super) async fn wait(&self) -> ShownStep {
        tokio::select! {
            () = at(self.space.due()) => ShownStep::Old,
            () = self.pubsub.called() => ShownStep::Switched,
            () = self.alarms.elapsed() => ShownStep::Conditions,
        }
    }

    /// Shows the values that have become uncertain with their age.
    pub(super) fn grow_old(&mut self) {
        self.space.grow_old();
    }

    /// Enables and disables readers as clients requested, and returns the writers that clients
    /// enabled or disabled.
    pub(super) fn switched(&mut self) -> Vec<(TopicId, bool)> {
        let mut writers = Vec::new();
        for (topic, on) in self.pubsub.switched() {
            if topic.space == SpaceId::UA {
                writers.push((topic, on));
            } else {
                // Values of a disabled reader are not updated.
                let silent = !on || self.readers.of(topic) == PubSubNodeState::Error;
                self.space.set_silent(topic, silent);
            }
        }
        writers
    }

    /// Returns whether a received value is to be shown.
    ///
    /// # Errors
    /// The reason for which it is dropped.
    pub(super) fn admit(&mut self, sample: &LocalDelivery) -> Result<bool, &'static str> {
        if self.space.is_mapped(sample.topic) {
            self.readers.heard(sample.topic);
        }
        if self.pubsub.is_off(sample.topic) {
            self.readers.ignored(sample.topic);
            return Err("its reader is disabled");
        }
        // A variable shows a single value, the last. If several values are kept for late joiners,
        // an older value may arrive after the last value.
        let is_old = match sample.kept {
            ValueRelation::Again => true,
            ValueRelation::Beside => sample.source < self.space.shown(sample.topic),
            ValueRelation::Alone => false,
        };
        Ok(!is_old)
    }

    /// Shows a received value.
    ///
    /// # Errors
    /// The reason for which the value is not shown.
    pub(super) fn show(&mut self, sample: LocalDelivery) -> Result<(), &'static str> {
        let quality = (sample.source, sample.status);
        let shown = self.space.update(sample.topic, sample.payload, quality);
        self.unbound.extend(self.space.take_gave_way());
        shown
    }

    /// Shows whether a value that a client wrote has arrived.
    pub(super) fn show_arrival(&self, topic: TopicId, arrival: &ConfirmedArrival) {
        let has_arrived = matches!(arrival, ConfirmedArrival::Confirmed);
        self.space.show_arrival(topic, has_arrived);
    }

    /// Shows the silence of a writer.
    pub(super) fn set_silent(&mut self, topic: TopicId, silent: bool) {
        if self.space.is_mapped(topic) {
            self.readers.silent(topic, silent);
        }
        let is_off = self.pubsub.is_off(topic);
        self.space.set_silent(topic, silent || is_off);
    }

    /// Shows the counters of the Router.
    pub(super) fn counted(&mut self, router: &Router) {
        self.pubsub.look(&self.readers, router);
        self.space.hear(router.heard(), self.receive_timeout);
        self.alarms.publishers(router, self.receive_timeout);
    }

    /// Returns the number of topics with a reader, and the number of silent topics among them.
    pub(super) fn silence(&self) -> (usize, usize) {
        self.readers.silence()
    }

    /// Returns the values that report the due conditions.
    pub(super) fn due_reports(&self) -> Vec<Sourced> {
        let reports = self.alarms.elapse().into_iter();
        let taken = bridge_node::now().utc;
        reports
            .map(|(topic, block)| Sourced {
                topic,
                block,
                taken,
                status: StatusCode::Good,
            })
            .collect()
    }

    /// Shows a value of this server or of another server. Returns the event with which the group
    /// receives it, and the loss of a value that is not shown.
    pub(super) fn show_sourced(&mut self, sourced: Sourced) -> (PortEvent, Option<PortEvent>) {
        let Sourced {
            topic,
            block,
            taken,
            status: quality,
        } = sourced;
        let said = status(quality);
        let shown = self.space.update(topic, block.clone(), (Some(taken), said));
        let Err(why) = shown else {
            let event = PortEvent::Qualified {
                topic,
                payload: block,
                taken,
                status: said,
            };
            return (event, None);
        };
        // The group receives the status that the node shows instead of the value.
        let refused = self.space.status(topic);
        let lost = PortEvent::Lost {
            topic: Some(topic),
            reason: Reason::NotPublished,
            why,
            count: 1,
        };
        let event = PortEvent::Qualified {
            topic,
            payload: Bytes::from(sources::no_value(refused)),
            taken,
            status: status(refused),
        };
        (event, Some(lost))
    }

    /// Shows that a value of another server is awaited.
    pub(super) fn show_waiting(&mut self, topic: TopicId) {
        let waiting = StatusCode::BadWaitingForInitialData;
        let block = Bytes::from(sources::no_value(waiting));
        // The block has no large value, so there is enough memory.
        let _shown = self.space.update(topic, block, (None, status(waiting)));
    }

    /// Follows the limits and the definitions of another mapping.
    pub(super) fn follow(&mut self, mapping: &Mapping, types: &Arc<TypePaths>) {
        self.receive_timeout = mapping.pubsub().receive_timeout;
        self.space.limit_writes(largest_write(mapping));
        self.space.limit_past(mapping);
        self.types.replace(types);
    }

    /// Replaces the address space by that of another mapping. `set_rights` sets the rights of the
    /// users before new nodes are shown.
    ///
    /// # Errors
    /// The mapping cannot be shown; the address space is unchanged.
    pub(super) fn exchange(
        &mut self,
        mapping: &Arc<Mapping>,
        set_rights: impl FnOnce(&Layout),
    ) -> Result<Exchanged, LayoutError> {
        let (layout, restart) = Layout::within(&self.namespaces, mapping, &mut self.types)?;
        let layout = Arc::new(layout);
        set_rights(&layout);
        let (gone, new) = self.space.exchange(&layout);
        self.space.set_ages(mapping);
        self.readers.forget(&gone);
        self.unbound.extend(gone.iter().copied());
        self.pubsub.show(mapping, &layout);
        self.alarms.reload(mapping);
        Ok(Exchanged { restart, gone, new })
    }
}

/// Returns the largest size of the fields in a DataSetMessage, without its header, in bytes.
pub(super) fn largest_write(mapping: &Mapping) -> usize {
    let message = usize::try_from(mapping.pubsub().max_message).unwrap_or(usize::MAX);
    message.saturating_sub(MESSAGE_HEADER)
}

/// Returns the upper half of a StatusCode.
fn status(code: StatusCode) -> u16 {
    u16::try_from(code.bits() >> 16).unwrap_or(u16::MAX)
}

/// Waits until a time; pends without a time.
async fn at(time: Option<Instant>) {
    match time {
        Some(time) => tokio::time::sleep_until(time.into()).await,
        None => std::future::pending().await,
    }
}

/// Largest size of a DataSetMessage without its fields, in bytes.
const MESSAGE_HEADER: usize = 64;
