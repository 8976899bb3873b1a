//! A topic of the graph whose values are ours to send out.

use std::sync::Arc;

use bridge_node::PublisherKey;
use bytes::Bytes;
use mappings::TopicId;
use messages::{MessageType, Selection, TypeName};
use tcpros::{Peer, Subscription};

/// A topic somebody publishes or is expected to, and which of our values its messages hold.
#[derive(Debug)]
pub(crate) struct Source {
    pub(crate) ros_topic: String,
    /// The type the mapping says; without one the first publisher decides.
    pub(crate) expected: Option<TypeName>,
    /// Which values are made of a message; one unless a mapping ties several variables to one topic.
    pub(crate) values: Vec<(TopicId, Selection)>,
    /// Whether it was found in the graph, by its name or a pattern, and not named by the mapping.
    pub(crate) found: bool,
    /// `None` while nobody publishes a topic that was found.
    pub(crate) subscription: Option<Subscription>,
    /// The type its values cross as.
    pub(crate) bound: Option<Arc<MessageType>>,
    /// Connected publishers of that type.
    peers: Vec<Arc<Peer>>,
    /// Connected publishers of another, whose messages cannot be read.
    strangers: Vec<Arc<Peer>>,
    /// Publishers that latch and have sent something, also while they are not connected.
    latched: Vec<LatchedPeer>,
    /// The key for the next of them.
    next_key: u32,
    /// For how many looks at the graph nobody has published it.
    silent: u32,
}

/// A publisher that latches.
#[derive(Debug)]
struct LatchedPeer {
    caller_id: String,
    key: PublisherKey,
    /// What it sent last, for values that come to be made of it.
    last: Bytes,
    /// How often the graph was looked at since its connection ended.
    looks: u32,
}

impl Source {
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

    /// A place without a topic.
    pub(crate) const fn vacant() -> Self {
        Self::new(String::new(), None, Vec::new())
    }

    /// The graph has been looked at again.
    pub(crate) const fn looked_at(&mut self) {
        self.silent = if self.is_live() {
            0
        } else {
            self.silent.saturating_add(1)
        };
    }

    /// Whether another topic may have its place: it was found in the graph, and nobody has published it for a while,
    /// whatever the master says.
    pub(crate) const fn gives_way(&self) -> bool {
        self.found && !self.is_live() && (self.silent > MAX_LOOKS || self.subscription.is_none())
    }

    /// Of too many latched publishers, one that is not connected gives way to another that latches. Returns its key.
    pub(crate) fn make_room(&mut self, peer: &Peer) -> Option<PublisherKey> {
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

    /// What the publisher of a message is called to the Router, if it latches and there is room for it. It keeps that name
    /// over a lost connection.
    pub(crate) fn latched_by(&mut self, peer: &Peer, message: &Bytes) -> Option<PublisherKey> {
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

    /// The last message of each latched publisher.
    pub(crate) fn latched(&self) -> impl Iterator<Item = (PublisherKey, &Bytes)> {
        self.latched.iter().map(|known| (known.key, &known.last))
    }

    /// The latched publishers that are not connected and will not be again: the master no longer names them, or their
    /// connection has been gone for [`MAX_LOOKS`] looks at the graph. To be asked with each.
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

    /// Whether messages of a publisher can be read; `None` when it has not been met.
    pub(crate) fn knows(&self, peer: &Arc<Peer>) -> Option<bool> {
        if self.peers.iter().any(|known| Arc::ptr_eq(known, peer)) {
            Some(true)
        } else if self.strangers.iter().any(|known| Arc::ptr_eq(known, peer)) {
            Some(false)
        } else {
            None
        }
    }

    /// Has publishers that were not taken in looked at again, with their next message.
    pub(crate) fn forget_strangers(&mut self) {
        self.strangers.clear();
    }

    /// Takes a publisher in. `found` is its type, unless there is none that can be read.
    pub(crate) fn meet(&mut self, peer: &Arc<Peer>, found: Option<Arc<MessageType>>) -> Met {
        let expected = |found: &Arc<MessageType>| {
            self.expected
                .as_ref()
                .is_none_or(|expected| expected == found.name())
        };
        let Some(found) = found.filter(expected) else {
            self.strangers.push(Arc::clone(peer));
            return Met::Stranger;
        };
        let same = self
            .bound
            .as_ref()
            .is_some_and(|bound| bound.md5() == found.md5() && bound.name() == found.name());
        if !same && !self.peers.is_empty() {
            self.strangers.push(Arc::clone(peer));
            return Met::Stranger;
        }
        self.peers.push(Arc::clone(peer));
        if same {
            return Met::Known;
        }
        self.bound = Some(Arc::clone(&found));
        Met::Bound(found)
    }

    /// A publisher has gone; `publishers` are left.
    pub(crate) fn part(&mut self, peer: &Arc<Peer>, publishers: usize) {
        self.peers
            .retain(|known| publishers > 0 && !Arc::ptr_eq(known, peer));
        self.strangers
            .retain(|known| publishers > 0 && !Arc::ptr_eq(known, peer));
    }

    /// Whether a publisher of another type is connected.
    pub(crate) const fn has_strangers(&self) -> bool {
        !self.strangers.is_empty()
    }

    /// Whether somebody publishes it in a type that can be read.
    pub(crate) const fn is_live(&self) -> bool {
        !self.peers.is_empty()
    }
}

/// About ten seconds: a publisher that died without a word to the master is not waited for any longer.
const MAX_LOOKS: u32 = 20;

/// Latched publishers of a topic that are told apart.
pub(crate) const MAX_LATCHED: usize = 256;

/// What a publisher is to a source.
#[derive(Debug)]
pub(crate) enum Met {
    /// Of the type the values cross as.
    Known,
    /// The one whose type they cross as from now on.
    Bound(Arc<MessageType>),
    /// Of another type.
    Stranger,
}

#[cfg(test)]
mod tests {
    use messages::{Dialect, Registry};
    use tcpros::ConnectionHeader;

    use super::*;

    fn peer() -> Arc<Peer> {
        Arc::new(Peer {
            caller_id: "/p".to_owned(),
            header: ConnectionHeader::default(),
        })
    }

    fn of(name: &str) -> Option<Arc<MessageType>> {
        Some(
            Registry::bundle(Dialect::Ros1)
                .get(&name.parse().unwrap())
                .unwrap(),
        )
    }

    fn source(expected: Option<&str>) -> Source {
        Source::new(
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
            Met::Bound(_)
        ));
        assert!(matches!(
            source.meet(&second, of("std_msgs/Bool")),
            Met::Known
        ));
        assert!(matches!(
            source.meet(&third, of("std_msgs/String")),
            Met::Stranger
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
            Met::Bound(_)
        ));
    }

    fn latching(name: &str) -> Arc<Peer> {
        Arc::new(Peer {
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
        // Publishers that are made up and leave at once.
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
            Met::Stranger
        ));
        assert!(matches!(source.meet(&peer(), None), Met::Stranger));
        assert!(matches!(
            source.meet(&peer(), of("std_msgs/String")),
            Met::Bound(_)
        ));
    }
}
