//! Why nothing loops: the space in a name is where the value is produced, and where the call is executed.

use std::collections::BTreeSet;

use mappings::{SpaceId, TopicId};

/// Which side of a bridge something was heard on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The bridge's own space: a ROS graph, or the address space of an OPC UA server.
    Local,
    /// The OPC UA PubSub space.
    Ua,
}

/// What under a name is heard.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum What {
    /// A value, or what is said of a value or call. It comes from where the name says.
    Value,
    /// A request. It goes to where the name says.
    Request,
    /// A response. It comes from where the name says.
    Response,
}

/// Which namespaces of its space a program alone writes. A namespace number (WriterGroupId) belongs to one program; space 0
/// has several programs, every other space one.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Owned {
    /// All of them.
    #[default]
    All,
    /// These.
    Only(BTreeSet<u16>),
}

impl Owned {
    /// Whether that namespace is among them.
    #[must_use]
    pub fn has(&self, namespace: u16) -> bool {
        match self {
            Self::All => true,
            Self::Only(namespaces) => namespaces.contains(&namespace),
        }
    }

    /// Whether that topic is of what a program of space `own` alone writes.
    #[must_use]
    pub fn is_home(&self, own: SpaceId, topic: TopicId) -> bool {
        let (_, namespace, _) = topic.triple();
        topic.space == own && self.has(namespace)
    }
}

/// Whether something under a name may cross a bridge from the side it was heard on. `home` says whether the bridge alone
/// writes what the name stands for, which is [`Owned::is_home`].
///
/// Values: from its own side a bridge takes only what is produced there, from the UA side only what is produced elsewhere.
/// So a value crosses UA once and enters each other space once, with any set of bridges of distinct spaces, and no memory
/// or hop count is needed. Calls: a request crosses only towards where it is executed, a response only away from there. So a
/// request crosses UA once and is executed in one place.
#[must_use]
pub const fn may_cross(home: bool, heard_on: Side, what: What) -> bool {
    match (what, heard_on) {
        (What::Value | What::Response, Side::Local) | (What::Request, Side::Ua) => home,
        (What::Value | What::Response, Side::Ua) | (What::Request, Side::Local) => !home,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_own_values_leave_and_only_foreign_ones_enter() {
        assert!(may_cross(true, Side::Local, What::Value));
        assert!(!may_cross(false, Side::Local, What::Value));
        assert!(!may_cross(true, Side::Ua, What::Value));
        assert!(may_cross(false, Side::Ua, What::Value));
    }

    #[test]
    fn requests_go_to_where_the_name_says_and_responses_come_from_there() {
        let crossing = |what| {
            [
                (true, Side::Local),
                (true, Side::Ua),
                (false, Side::Local),
                (false, Side::Ua),
            ]
            .map(|(home, heard_on)| may_cross(home, heard_on, what))
        };
        assert_eq!(crossing(What::Request), [false, true, true, false]);
        assert_eq!(crossing(What::Response), [true, false, false, true]);
    }

    #[test]
    fn a_namespace_of_space_0_belongs_to_one_program() {
        let own = Owned::Only(BTreeSet::from([7]));
        let topic = |space, namespace| TopicId::new(space, namespace, 101).unwrap();
        assert!(own.is_home(SpaceId::UA, topic(0, 7)));
        assert!(!own.is_home(SpaceId::UA, topic(0, 8)));
        assert!(!own.is_home(SpaceId::UA, topic(1, 7)));
        assert!(Owned::All.is_home(SpaceId::UA, topic(0, 8)));
    }
}
