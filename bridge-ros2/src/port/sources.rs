//! The topics of the domain that this bridge reads, with the values that their messages contain.

mod reading;
mod reload;

use std::collections::{BTreeMap, VecDeque};
use std::task::{Context, Poll};

use bridge_node::policy::Read;
use bridge_node::{PortEvent, Reason, now};
use messages::TypeName;
use ros2_node::inbox::{Inbox, InboxTurn};
use ros2_node::raw::PayloadReader;
use tokio::time::Instant;
use tracing::debug;

use super::side::{Ros2Side, lost};
use crate::source::{Ros2Source, same_participant};

/// The topics that this bridge reads.
pub(super) struct ReadTopics {
    /// The topics. A source is never removed, so its index identifies it.
    #[expect(
        clippy::vec_box,
        reason = "a vector that grows has room for twice what is in it"
    )]
    list: Vec<Box<Ros2Source>>,
    by_name: BTreeMap<String, usize>,
    inbox: Inbox<usize>,
    /// Replaced readers, which receive until their successors are matched.
    retired: VecDeque<(Instant, PayloadReader)>,
}

impl ReadTopics {
    pub(super) fn new() -> Self {
        Self {
            list: Vec::new(),
            by_name: BTreeMap::new(),
            inbox: Inbox::new(),
            retired: VecDeque::new(),
        }
    }

    /// Adds the topics that the mapping reads. Their readers are created in the next pass.
    pub(super) fn take_up(&mut self, read: Read) {
        for (dds_topic, (message_type, values)) in read {
            let index = self.source(dds_topic, message_type);
            if let Some(source) = self.list.get_mut(index) {
                // Most topics have a single value.
                source.values.reserve_exact(values.len());
                source.values.extend(values);
            }
        }
    }

    /// Returns all topics.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Ros2Source> {
        self.list.iter().map(Box::as_ref)
    }

    /// Returns the index of the source of the topic; creates the source if it is missing.
    fn source(&mut self, dds_topic: String, message_type: TypeName) -> usize {
        let next = self.list.len();
        let index = *self.by_name.entry(dds_topic.clone()).or_insert(next);
        if index == next {
            let source = Ros2Source::new(dds_topic, message_type);
            self.list.push(Box::new(source));
        }
        index
    }

    /// Polls for the next sample.
    pub(super) fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<InboxTurn<usize>> {
        self.inbox.poll_recv(cx)
    }

    /// Handles a sample.
    pub(super) fn handle(&mut self, side: &mut Ros2Side, taken: InboxTurn<usize>) {
        match taken {
            InboxTurn::Sample {
                key,
                payload,
                writer,
                missing,
            } => {
                let Some(source) = self.list.get_mut(key) else {
                    return;
                };
                // The bridge's own publication, which RustDDS delivers to the bridge's own reader
                // as well.
                if same_participant(writer, side.domain.participant()) {
                    return;
                }
                if side.graph.is_bridge(writer) {
                    for (topic, _) in &source.values {
                        side.events.push_back(lost(*topic, BY_BRIDGE, 1));
                    }
                    return;
                }
                let received = now().utc;
                let stranger = source.strangers.get(&writer).copied();
                let payload = payload.into_bytes();
                let latched_by = match stranger {
                    Some(_) => None,
                    None => source.latched_by(writer, &payload),
                };
                for (topic, _) in &source.values {
                    let topic = *topic;
                    if missing > 0 {
                        side.events.push_back(lost(topic, UNREAD, missing));
                    }
                    side.events.push_back(match stranger {
                        Some(why) => lost(topic, (Reason::Mismatch, why), 1),
                        None => PortEvent::Sample {
                            topic,
                            payload: payload.clone(),
                            received,
                            latched_by,
                        },
                    });
                }
            }
            InboxTurn::Unreadable { key, why } => {
                let Some(source) = self.list.get(key) else {
                    return;
                };
                debug!(topic = source.dds_topic, why, "unreadable sample");
                for (topic, _) in &source.values {
                    side.events.push_back(lost(
                        *topic,
                        (Reason::Malformed, "unreadable encoding"),
                        1,
                    ));
                }
            }
        }
    }

    /// Drops replaced readers after the time in which publishers match the new readers.
    pub(super) fn drop_retired(&mut self, now: Instant) {
        while self.retired.front().is_some_and(|(until, _)| *until <= now) {
            self.retired.pop_front();
        }
    }
}

impl std::fmt::Debug for ReadTopics {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_list().entries(&self.list).finish()
    }
}

/// The reason for dropped samples that another bridge published: they are values of the space.
const BY_BRIDGE: (Reason, &str) = (Reason::Looped, "published by another bridge");
/// The reason for samples that RustDDS reports as lost.
const UNREAD: (Reason, &str) = (Reason::Overflow, "lost before they were read");
