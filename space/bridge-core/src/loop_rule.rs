//! The rule that prevents loops: the space in a name is the space that produces the value or
//! executes the call.

use std::collections::BTreeSet;

use mappings::{SpaceId, TopicId};

/// The side of a bridge on which a message was received.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Side {
    /// The own space of the bridge: a ROS graph, or the address space of an OPC UA server.
    Local,
    /// The OPC UA PubSub space.
    Ua,
}

/// The kind of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Crosses {
    /// A value, or metadata of a value or call. It comes from the space in its name.
    Value,
    /// A request. It goes to the space in its name.
    Request,
    /// A response. It comes from the space in its name.
    Response,
}

/// The namespaces of its space that only this program writes. A namespace number (WriterGroupId)
/// belongs to a single program. Space 0 has several programs, every other space has a single
/// program.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Owned {
    /// All namespaces.
    #[default]
    All,
    /// The given namespaces.
    Only(BTreeSet<u16>),
}

impl Owned {
    /// Returns whether the program owns the namespace.
    #[must_use]
    pub fn has(&self, namespace: u16) -> bool {
        match self {
            Self::All => true,
            Self::Only(namespaces) => namespaces.contains(&namespace),
        }
    }

    /// Returns whether a program of space `own` owns the namespace of the topic.
    #[must_use]
    pub fn is_home(&self, own: SpaceId, topic: TopicId) -> bool {
        let (_, namespace, _) = topic.triple();
        topic.space == own && self.has(namespace)
    }
}

/// Returns whether a message may cross a bridge from the side on which it was received. `home` is
/// [`Owned::is_home`]: whether only this bridge writes the topic or executes the call.
///
/// Values: a bridge takes from its local side only values that are produced there, and from the UA
/// side only values that are produced elsewhere. With any set of bridges of distinct spaces, a
/// value therefore crosses UA once and enters each other space once. No memory and no hop count is
/// needed. Calls: a request crosses only towards its executor, a response only away from it. A
/// request therefore crosses UA once and is executed in one place.
#[must_use]
pub const fn may_cross(home: bool, heard_on: Side, what: Crosses) -> bool {
    match (what, heard_on) {
        (Crosses::Value | Crosses::Response, Side::Local) | (Crosses::Request, Side::Ua) => home,
        (Crosses::Value | Crosses::Response, Side::Ua) | (Crosses::Request, Side::Local) => !home,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_own_values_leave_and_only_foreign_ones_enter() {
        assert!(may_cross(true, Side::Local, Crosses::Value));
        assert!(!may_cross(false, Side::Local, Crosses::Value));
        assert!(!may_cross(true, Side::Ua, Crosses::Value));
        assert!(may_cross(false, Side::Ua, Crosses::Value));
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
        assert_eq!(crossing(Crosses::Request), [false, true, true, false]);
        assert_eq!(crossing(Crosses::Response), [true, false, false, true]);
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
