//! The subscribed topics, with the values that their messages contain.

mod found;
mod reload;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use bridge_node::{PortEvent, Reason, timestamp};
use mappings::TopicId;
use messages::{MessageType, Selection, TypeName};
use tcpros::{
    ConnectionPeer, Inbox, InboxEvent, InboxMessage, NodeError, RequestedType, SubscriberOptions,
};

use super::side::Ros1Side;
use crate::source::{AddedPublisher, MAX_LATCHED, Ros1Source};

/// The subscribed topics.
#[derive(Debug)]
pub(super) struct SubscribedTopics {
    /// The topics, identified by their index. The index of a removed topic is reused.
    list: Vec<Ros1Source>,
    /// The indexes free for reuse.
    vacant: Vec<usize>,
    by_name: BTreeMap<String, usize>,
    inbox: Inbox<usize>,
    /// The topic of the graph that was added last. The next search continues after it, so every
    /// topic gets its turn.
    taken_last: String,
    /// Topics of the graph that were refused because of the limit, and the time of the last log
    /// message.
    refused: Refused,
}

/// The topics that were refused because of the limit, and the time of the last log message.
#[derive(Debug, Default)]
struct Refused {
    topics: usize,
    told: Option<Instant>,
}

impl SubscribedTopics {
    pub(super) fn new() -> Self {
        Self {
            list: Vec::new(),
            vacant: Vec::new(),
            by_name: BTreeMap::new(),
            inbox: Inbox::new(),
            taken_last: String::new(),
            refused: Refused::default(),
        }
    }

    /// Subscribes to a topic of the mapping for a value.
    ///
    /// # Errors
    /// [`NodeError`] if the name of the topic is invalid.
    pub(super) fn take_up(
        &mut self,
        side: &Ros1Side,
        (ros_topic, message_type): (&str, &TypeName),
        value: (TopicId, Selection),
    ) -> Result<(), NodeError> {
        let ros_topic = side.node.resolve(ros_topic)?;
        let index = self.source(ros_topic, Some(message_type.clone()));
        if let Some(source) = self.list.get_mut(index) {
            source.values.push(value);
        }
        self.subscribe(side, index)
    }

    /// Returns all topics, and unused entries without values.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Ros1Source> {
        self.list.iter()
    }

    /// Returns the index of the source of the topic; creates the source if necessary.
    fn source(&mut self, ros_topic: String, expected: Option<TypeName>) -> usize {
        if let Some(index) = self.by_name.get(&ros_topic) {
            return *index;
        }
        let source = Ros1Source::new(ros_topic.clone(), expected, Vec::new());
        let index = match self.vacant.pop() {
            Some(index) if index < self.list.len() => index,
            _ => {
                self.list.push(Ros1Source::vacant());
                self.list.len() - 1
            }
        };
        if let Some(place) = self.list.get_mut(index) {
            *place = source;
        }
        self.by_name.insert(ros_topic, index);
        index
    }

    fn subscribe(&mut self, side: &Ros1Side, index: usize) -> Result<(), NodeError> {
        let Some(source) = self
            .list
            .get_mut(index)
            .filter(|s| s.subscription.is_none())
        else {
            return Ok(());
        };
        // The subscription accepts any MD5 sum, so a publisher of another type connects and is
        // logged with the expected type, instead of refusing the connection.
        let wanted = RequestedType {
            type_name: source.expected.as_ref().map(ToString::to_string),
            md5sum: None,
        };
        let options = SubscriberOptions::default();
        let subscription =
            side.node
                .subscribe(&source.ros_topic, wanted, options, index, &self.inbox)?;
        source.subscription = Some(subscription);
        Ok(())
    }

    /// Removes a source; its index may be reused.
    fn vacate(&mut self, side: &mut Ros1Side, index: usize) {
        let Some(place) = self.list.get_mut(index) else {
            return;
        };
        // Messages queued for the source do not come out of the inbox any more.
        let source = std::mem::replace(place, Ros1Source::vacant());
        self.by_name.remove(&source.ros_topic);
        self.vacant.push(index);
        // A source that was never bound is not reported as unbound.
        let gone = source.values.into_iter().filter(|_| source.bound.is_some());
        let gone = gone.map(|(topic, _)| PortEvent::Unbound { topic });
        side.events.extend(gone);
    }

    /// Waits for a message or a change of the connections of a topic. Cancel-safe.
    pub(super) async fn recv(&mut self) -> (usize, InboxEvent) {
        self.inbox.recv().await
    }

    /// Handles an event of the inbox.
    pub(super) fn handle(&mut self, side: &mut Ros1Side, (index, event): (usize, InboxEvent)) {
        match event {
            InboxEvent::Message(message) => self.message(side, index, message),
            InboxEvent::Peer {
                connected: true,
                peer,
                ..
            } => {
                self.meet(side, index, &peer);
            }
            InboxEvent::Peer {
                connected: false,
                peer,
                publishers,
            } => {
                let Some(source) = self.list.get_mut(index) else {
                    return;
                };
                let was_live = source.is_live();
                source.part(&peer, publishers);
                report_live(source, side, was_live);
            }
            InboxEvent::Dropped(count) => {
                self.lost(side, index, (Reason::Overflow, "read too slowly"), count);
            }
        }
    }

    fn message(&mut self, side: &mut Ros1Side, index: usize, message: InboxMessage) {
        let InboxMessage {
            bytes,
            peer,
            received,
        } = message;
        let known = self.list.get(index).and_then(|source| source.knows(&peer));
        if !known.unwrap_or_else(|| self.meet(side, index, &peer)) {
            let cause = (Reason::Mismatch, "publisher of another type");
            self.lost(side, index, cause, 1);
            return;
        }
        let received = timestamp(received);
        let Some(source) = self.list.get_mut(index) else {
            return;
        };
        if let Some(publisher) = source.make_room(&peer) {
            let left = source.values.iter().map(|(topic, _)| PortEvent::Left {
                topic: *topic,
                publisher,
            });
            side.events.extend(left);
        }
        let latched_by = source.latched_by(&peer, &bytes);
        let unlatched = peer.header.latching() && latched_by.is_none();
        for (topic, _) in &source.values {
            let payload = bytes.clone();
            side.events.push_back(PortEvent::Sample {
                topic: *topic,
                payload,
                received,
                latched_by,
            });
        }
        if unlatched {
            side.policy.told.once(&source.ros_topic, "too many latched", || {
                format!(
                    "more than {MAX_LATCHED} latched publishers are connected: late subscribers do not \
                     receive the last message of {}",
                    peer.caller_id
                )
            });
        }
    }

    /// Adds a publisher. Returns true if its messages can be read.
    fn meet(&mut self, side: &mut Ros1Side, index: usize, peer: &Arc<ConnectionPeer>) -> bool {
        let Some(source) = self
            .list
            .get_mut(index)
            .filter(|source| source.knows(peer).is_none())
        else {
            return false;
        };
        let found = side.definitions.of_publisher(&peer.header, !source.found);
        if let Err(error) = &found {
            side.policy
                .told
                .once(&source.ros_topic, "unreadable type", || {
                    format!("messages of {} are dropped: {error}", peer.caller_id)
                });
        }
        // The type is reported first, so the Router knows it when the topic becomes live.
        let was_live = source.is_live();
        let understood = found.is_ok();
        match source.meet(peer, found.ok()) {
            AddedPublisher::Known => {}
            AddedPublisher::Bound(message_type) => report_bound(source, side, &message_type),
            AddedPublisher::Stranger => {
                if understood {
                    tell_stranger(source, side, peer);
                }
                return false;
            }
        }
        report_live(source, side, was_live);
        true
    }

    fn lost(&self, side: &mut Ros1Side, index: usize, cause: (Reason, &'static str), count: u64) {
        let source = self.list.get(index);
        for (topic, _) in source.into_iter().flat_map(|source| &source.values) {
            side.lost(*topic, cause, count);
        }
    }

    /// Counts a comparison with the graph.
    pub(super) fn looked_at(&mut self) {
        for source in &mut self.list {
            source.looked_at();
        }
    }

    /// Reports the latching publishers that do not return.
    pub(super) fn drop_gone(&mut self, side: &mut Ros1Side) {
        for source in &mut self.list {
            let named = side.graph.publishers.get(&source.ros_topic);
            for publisher in source.gone_for_good(named.map_or(&[], Vec::as_slice)) {
                let values = source.values.iter();
                side.events.extend(values.map(|(topic, _)| PortEvent::Left {
                    topic: *topic,
                    publisher,
                }));
            }
        }
    }
}

fn report_bound(source: &Ros1Source, side: &mut Ros1Side, message_type: &Arc<MessageType>) {
    for (topic, selection) in &source.values {
        side.events.push_back(PortEvent::Bound {
            topic: *topic,
            message_type: Arc::clone(message_type),
            selection: selection.clone(),
        });
    }
}

/// Reports that a topic has become live, or is no longer live.
fn report_live(source: &Ros1Source, side: &mut Ros1Side, before: bool) {
    let live = source.is_live();
    if live == before {
        return;
    }
    let values = source.values.iter();
    side.events.extend(values.map(|(topic, _)| PortEvent::Live {
        topic: *topic,
        live,
    }));
}

fn tell_stranger(source: &Ros1Source, side: &mut Ros1Side, peer: &ConnectionPeer) {
    let bound = source.bound.as_deref();
    let ours = source
        .expected
        .as_ref()
        .or_else(|| bound.map(MessageType::name));
    let ours = ours.map(ToString::to_string);
    let bound = bound.map(MessageType::md5);
    side.policy
        .told
        .once(&source.ros_topic, "publisher of another type", || {
            let theirs = (peer.header.type_name(), peer.header.md5sum());
            stranger(&peer.caller_id, theirs, (ours.as_deref(), bound))
        });
}

/// Returns the reason for dropping the messages of a publisher with another type or definition than
/// the topic. The MD5 sums distinguish two definitions of the same name.
fn stranger(
    caller: &str,
    (theirs, sum): (Option<&str>, Option<&str>),
    (ours, bound): (Option<&str>, Option<&str>),
) -> String {
    let (theirs, sum) = (theirs.unwrap_or("?"), sum.unwrap_or("none"));
    match (ours, bound) {
        (Some(name), Some(md5)) if name == theirs => format!(
            "messages of {caller} are dropped: its definition of {theirs} has the MD5 sum {sum}, but the \
             topic uses the definition with the MD5 sum {md5}; build both sides from the same definition"
        ),
        (Some(name), _) if name == theirs => format!(
            "messages of {caller} are dropped: its definition of {theirs} (MD5 sum {sum}) differs from the \
             definition of the topic"
        ),
        (ours, _) => format!(
            "messages of {caller} are dropped: it publishes {theirs}, but the topic uses {}",
            ours.unwrap_or("another type"),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::stranger;

    #[test]
    fn two_definitions_of_one_name_are_named_with_their_checksums() {
        let theirs = (Some("arm_msgs/Joint"), Some("aaaa"));
        let told = stranger("/arm", theirs, (Some("arm_msgs/Joint"), Some("bbbb")));
        assert!(told.contains("aaaa") && told.contains("bbbb"), "{told}");
        let told = stranger("/arm", theirs, (Some("arm_msgs/Joint"), None));
        assert!(
            told.contains("aaaa") && told.contains("differs from the definition of the topic"),
            "{told}"
        );
        let told = stranger("/arm", theirs, (Some("arm_msgs/Other"), Some("bbbb")));
        assert!(
            told.ends_with("it publishes arm_msgs/Joint, but the topic uses arm_msgs/Other"),
            "{told}"
        );
    }
}
