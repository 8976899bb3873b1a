//! A topic of the graph whose values are ours to send out.

use std::sync::Arc;

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
    /// `None` while nobody publishes a topic that is known by its name alone.
    pub(crate) subscription: Option<Subscription>,
    /// The type its values cross as.
    pub(crate) bound: Option<Arc<MessageType>>,
    /// Connected publishers of that type.
    peers: Vec<Arc<Peer>>,
    /// Connected publishers of another, whose messages cannot be read.
    strangers: Vec<Arc<Peer>>,
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
            subscription: None,
            bound: None,
            peers: Vec::new(),
            strangers: Vec::new(),
        }
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

    /// Whether somebody publishes it in a type that can be read.
    pub(crate) const fn is_live(&self) -> bool {
        !self.peers.is_empty()
    }
}

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
