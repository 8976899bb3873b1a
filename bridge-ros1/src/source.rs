//! A topic of the graph. This bridge sends its values to the space.

use std::sync::Arc;

use bridge_node::PublisherKey;
use bytes::Bytes;
use mappings::TopicId;
use messages::{MessageType, Selection, TypeName};
use tcpros::{ConnectionPeer, Subscription};

/// A topic that is or may be published, and the values that its messages contain.
#[derive(Debug)]
pub(crate) struct Ros1Source {
    pub(crate) ros_topic: String,
    /// The type in the mapping; without it the first publisher decides.
    pub(crate) expected: Option<TypeName>,
    /// The values made of a message; a single value unless the mapping binds several variables to
    /// the topic.
    pub(crate) values: Vec<(TopicId, Selection)>,
    /// True if the topic was found in the graph by its name or a pattern, and the mapping does not
    /// name it.
    pub(crate) found: bool,
    /// `None` while a topic found in the graph is not published.
    pub(crate) subscription: Option<Subscription>,
    /// The type with which the values are bridged.
    pub(crate) bound: Option<Arc<MessageType>>,
    /// Connected publishers of this type.
    peers: Vec<Arc<ConnectionPeer>>,
    /// Connected publishers of another type; their messages cannot be read.
    strangers: Vec<Arc<ConnectionPeer>>,
    /// Latching publishers that have sent a message, including disconnected publishers.
    latched: Vec<LatchedPeer>,
    /// The key of the next latching publisher.
    next_key: u32,
    /// Number of comparisons with the graph since the topic was last published.
    silent: u32,
}

/// A latching publisher.
#[derive(Debug)]
struct LatchedPeer {
    caller_id: String,
    key: PublisherKey,
    /// The last message, for values that are added later.
    last: Bytes,
    /// Number of comparisons with the graph since its connection was lost.
    looks: u32,
}

impl Ros1Source {
    pub(crate) const fn new(
        ros_topic: String,
        expected: Option<TypeName>,
        values: Vec<(TopicId, Selection)>,
    ) -> Self {
        Self {
            ros_topic,
            expected,
            values,
            found: false,
            subscription: None,
            bound: None,
            peers: Vec::new(),
            strangers: Vec::new(),
            latched: Vec::new(),
            next_key: 0,
            silent: 0,
        }
    }

    /// Returns an unused entry without a topic.
    pub(crate) const fn vacant() -> Self {
        Self::new(String::new(), None, Vec::new())
    }

    /// Counts a comparison with the graph.
    pub(crate) const fn looked_at(&mut self) {
        self.silent = if self.is_live() {
            0
        } else {
            self.silent.saturating_add(1)
        };
    }

    /// Returns true if another topic may replace this topic: it was found in the graph and has not
    /// been published for a while, even if the master lists a publisher.
    pub(crate) const fn gives_way(&self) -> bool {
        self.found && !self.is_live() && (self.silent > MAX_LOOKS || self.subscription.is_none())
    }

    /// Removes a disconnected latching publisher if the limit is reached and `peer` is a new
    /// latching publisher. Returns the key of the removed publisher.
    pub(crate) fn make_room(&mut self, peer: &ConnectionPeer) -> Option<PublisherKey> {
        let known = |latched: &LatchedPeer| latched.caller_id == peer.caller_id;
        if self.latched.len() < MAX_LATCHED
            || !peer.header.latching()
            || self.latched.iter().any(known)
        {
            return None;
        }
        let peers = &self.peers;
        let connected =
            |latched: &LatchedPeer| peers.iter().any(|peer| peer.caller_id == latched.caller_id);
        let gone = self.latched.iter().position(|latched| !connected(latched));
        gone.map(|at| self.latched.remove(at).key)
    }

    /// Returns the key of the publisher of a message for the Router, if the publisher latches and
    /// the limit is not reached. The key stays the same over a reconnection.
    pub(crate) fn latched_by(
        &mut self,
        peer: &ConnectionPeer,
        message: &Bytes,
    ) -> Option<PublisherKey> {
        if !peer.header.latching() {
            return None;
        }
        let mut latched = self.latched.iter_mut();
        if let Some(known) = latched.find(|l| l.caller_id == peer.caller_id) {
            known.last.clone_from(message);
            return Some(known.key);
        }
        if self.latched.len() >= MAX_LATCHED {
            return None;
        }
        let key = PublisherKey(self.next_key);
        self.next_key = self.next_key.wrapping_add(1);
        self.latched.push(LatchedPeer {
            caller_id: peer.caller_id.clone(),
            key,
            last: message.clone(),
            looks: 0,
        });
        Some(key)
    }

    /// Returns the last message of each latching publisher.
    pub(crate) fn latched(&self) -> impl Iterator<Item = (PublisherKey, &Bytes)> {
        self.latched.iter().map(|known| (known.key, &known.last))
    }

    /// Removes and returns the latching publishers that are lost: disconnected, and not registered
    /// at the master or disconnected for more than [`MAX_LOOKS`] comparisons. Must be called with
    /// each comparison.
    pub(crate) fn gone_for_good(&mut self, named: &[String]) -> Vec<PublisherKey> {
        let peers = &self.peers;
        self.latched
            .extract_if(.., |latched| {
                if peers.iter().any(|peer| peer.caller_id == latched.caller_id) {
                    latched.looks = 0;
                    return false;
                }
                latched.looks += 1;
                latched.looks > MAX_LOOKS || !named.contains(&latched.caller_id)
            })
            .map(|latched| latched.key)
            .collect()
    }

    /// Returns true if messages of a publisher can be read; `None` if the publisher is new.
    pub(crate) fn knows(&self, peer: &Arc<ConnectionPeer>) -> Option<bool> {
        if self.peers.iter().any(|known| Arc::ptr_eq(known, peer)) {
            Some(true)
        } else if self.strangers.iter().any(|known| Arc::ptr_eq(known, peer)) {
            Some(false)
        } else {
            None
        }
    }

    /// Forgets publishers of another type, so they are checked again with their next message.
    pub(crate) fn forget_strangers(&mut self) {
        self.strangers.clear();
    }

    /// Adds a publisher. `found` is its type, `None` if the type cannot be read.
    pub(crate) fn meet(
        &mut self,
        peer: &Arc<ConnectionPeer>,
        found: Option<Arc<MessageType>>,
    ) -> AddedPublisher {
        let expected = |found: &Arc<MessageType>| {
            self.expected
                .as_ref()
                .is_none_or(|expected| expected == found.name())
        };
        let Some(found) = found.filter(expected) else {
            self.strangers.push(Arc::clone(peer));
            return AddedPublisher::Stranger;
        };
        let same = self
            .bound
            .as_ref()
            .is_some_and(|bound| bound.md5() == found.md5() && bound.name() == found.name());
        if !same && !self.peers.is_empty() {
            self.strangers.push(Arc::clone(peer));
            return AddedPublisher::Stranger;
        }
        self.peers.push(Arc::clone(peer));
        if same {
            return AddedPublisher::Known;
        }
        self.bound = Some(Arc::clone(&found));
        AddedPublisher::Bound(found)
    }

    /// Removes a publisher that disconnected; `publishers` is the number of remaining connections.
    pub(crate) fn part(&mut self, peer: &Arc<ConnectionPeer>, publishers: usize) {
        self.peers
            .retain(|known| publishers > 0 && !Arc::ptr_eq(known, peer));
        self.strangers
            .retain(|known| publishers > 0 && !Arc::ptr_eq(known, peer));
    }

    /// Returns true if a publisher of another type is connected.
    pub(crate) const fn has_strangers(&self) -> bool {
        !self.strangers.is_empty()
    }

    /// Returns true if the topic is published with a type that can be read.
    pub(crate) const fn is_live(&self) -> bool {
        !self.peers.is_empty()
    }
}

/// About ten seconds, the time limit for a publisher that died without unregistering.
const MAX_LOOKS: u32 = 20;

/// Maximum number of latching publishers of a topic.
pub(crate) const MAX_LATCHED: usize = 256;

/// The result of adding a publisher.
#[derive(Debug)]
pub(crate) enum AddedPublisher {
    /// The publisher has the type with which the values are bridged.
    Known,
    /// The values are bridged with the type of this publisher from now on.
    Bound(Arc<MessageType>),
    /// The publisher has another type.
    Stranger,
}

#[cfg(test)]
mod tests {
    use messages::{Dialect, TypeRegistry};
    use tcpros::ConnectionHeader;

    use super::*;

    fn peer() -> Arc<ConnectionPeer> {
        Arc::new(ConnectionPeer {
            caller_id: "/p".to_owned(),
            header: ConnectionHeader::default(),
        })
    }

    fn of(name: &str) -> Option<Arc<MessageType>> {
        Some(
            TypeRegistry::bundle(Dialect::Ros1)
                .get(&name.parse().unwrap())
                .unwrap(),
        )
    }

    fn source(expected: Option<&str>) -> Ros1Source {
        Ros1Source::new(
            "/t".to_owned(),
            expected.map(|name| name.parse().unwrap()),
            Vec::new(),
        )
    }

    #[test]
    fn the_first_publisher_decides_and_others_of_its_type_join() {
        let mut source = source(None);
        let (first, second, third) = (peer(), peer(), peer());
        assert!(matches!(
            source.meet(&first, of("std_msgs/Bool")),
            AddedPublisher::Bound(_)
        ));
        assert!(matches!(
            source.meet(&second, of("std_msgs/Bool")),
            AddedPublisher::Known
        ));
        assert!(matches!(
            source.meet(&third, of("std_msgs/String")),
            AddedPublisher::Stranger
        ));
        assert_eq!(
            (source.knows(&second), source.knows(&third)),
            (Some(true), Some(false))
        );
    }

    #[test]
    fn once_all_have_gone_another_type_may_come() {
        let mut source = source(None);
        let (first, second) = (peer(), peer());
        source.meet(&first, of("std_msgs/Bool"));
        source.part(&first, 0);
        assert!(!source.is_live());
        assert!(matches!(
            source.meet(&second, of("std_msgs/String")),
            AddedPublisher::Bound(_)
        ));
    }

    fn latching(name: &str) -> Arc<ConnectionPeer> {
        Arc::new(ConnectionPeer {
            caller_id: name.to_owned(),
            header: ConnectionHeader::default().with("latching", "1"),
        })
    }

    #[test]
    fn a_latched_publisher_is_gone_when_neither_connected_nor_named() {
        let mut source = source(None);
        assert_eq!(
            source.latched_by(&peer(), &Bytes::new()),
            None,
            "it does not latch"
        );
        let (a, b) = (latching("/a"), latching("/b"));
        source.meet(&a, of("std_msgs/Bool"));
        source.meet(&b, of("std_msgs/Bool"));
        let keys = [&a, &b].map(|peer| source.latched_by(peer, &Bytes::new()).unwrap());
        assert_ne!(keys[0], keys[1]);
        assert_eq!(source.gone_for_good(&[]), [], "both are connected");
        source.part(&a, 1);
        let named = ["/a".to_owned(), "/b".to_owned()];
        assert_eq!(source.gone_for_good(&named), [], "it may come back");
        let back = latching("/a");
        source.meet(&back, of("std_msgs/Bool"));
        assert_eq!(source.latched_by(&back, &Bytes::new()), Some(keys[0]));
        source.part(&back, 1);
        assert_eq!(source.gone_for_good(&named[1..]), [keys[0]]);
        source.part(&b, 0);
        let looks = (0..100).position(|_| source.gone_for_good(&named) == [keys[1]]);
        assert_eq!(looks, Some(20), "it died without a word to the master");
    }

    #[test]
    fn of_too_many_latched_publishers_those_that_have_gone_give_way() {
        let mut source = source(None);
        let message = Bytes::new();
        let connected: Vec<_> = (1..MAX_LATCHED)
            .map(|n| latching(&format!("/p{n}")))
            .collect();
        for peer in &connected {
            source.meet(peer, of("std_msgs/Bool"));
            assert!(source.latched_by(peer, &message).is_some());
        }
        // Made-up publishers that disconnect at once.
        let mut gave_way = Vec::new();
        for n in 0..10 {
            let made_up = latching(&format!("/made_up{n}"));
            gave_way.extend(source.make_room(&made_up));
            assert!(source.latched_by(&made_up, &message).is_some());
        }
        assert_eq!(gave_way.len(), 9);
        assert_eq!(source.latched().count(), MAX_LATCHED);
        let last = latching("/last");
        source.meet(&last, of("std_msgs/Bool"));
        assert!(source.make_room(&last).is_some());
        assert!(source.latched_by(&last, &message).is_some());
        let one_more = latching("/one_more");
        assert_eq!(source.make_room(&one_more), None, "all are connected");
        assert_eq!(source.latched_by(&one_more, &message), None);
        assert!(source.latched_by(&last, &message).is_some(), "it is known");
    }

    #[test]
    fn the_mapping_decides_before_any_publisher() {
        let mut source = source(Some("std_msgs/String"));
        assert!(matches!(
            source.meet(&peer(), of("std_msgs/Bool")),
            AddedPublisher::Stranger
        ));
        assert!(matches!(
            source.meet(&peer(), None),
            AddedPublisher::Stranger
        ));
        assert!(matches!(
            source.meet(&peer(), of("std_msgs/String")),
            AddedPublisher::Bound(_)
        ));
    }
}
