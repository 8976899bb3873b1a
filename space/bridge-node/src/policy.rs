//! Decisions shared by the ports of both ROS: which topics of a graph are values of the space, in
//! which type values of other spaces are written, which topics are dropped at the limit, which
//! changes a new mapping causes, and which messages are logged once.
//!
//! No IO and no clock: a port reports the state of its graph, and carries out the decisions with
//! its library.

mod calls;
mod choice;
mod found;
mod reload;
mod told;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use bridge_core::{Room, TopicMetaData};
use mappings::{Mapping, SpaceId, TopicId};
use messages::{MessageType, Selection, TypeName};

pub use self::calls::{action_type, call_type};
pub use self::choice::{Choice, PortStep, Word};
pub use self::found::TopicMeaning;
pub use self::reload::{Destination, Read, still_made, taken_up};
pub use self::told::LoggedMessages;
use crate::PortEvent;

/// The knowledge of a port about its own space, apart from the content of its graph.
#[derive(Debug)]
pub struct Policy {
    own: SpaceId,
    mapping: Arc<Mapping>,
    /// Messages that are logged once.
    pub told: LoggedMessages,
    /// The places for strays: values that neither the mapping nor a subscriber asks for.
    room: Room,
}

/// The decision about a value that neither the mapping names nor a local subscriber requests.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Admission {
    /// Whether the value gets a place.
    pub admitted: bool,
    /// The strays to be dropped, to make room for this value and later values.
    pub gone: Vec<TopicId>,
}

impl Policy {
    /// Creates the policy of a port for the graph of the space `own`.
    #[must_use]
    pub fn new(own: SpaceId, mapping: Arc<Mapping>) -> Self {
        Self {
            own,
            mapping,
            told: LoggedMessages::default(),
            room: Room::new(MAX_TOPICS),
        }
    }

    /// Returns the space with the values that are produced in the graph.
    #[must_use]
    pub const fn own(&self) -> SpaceId {
        self.own
    }

    /// Returns the mapping of the cell.
    #[must_use]
    pub const fn mapping(&self) -> &Arc<Mapping> {
        &self.mapping
    }

    /// Replaces the mapping and returns the previous mapping. Messages are logged again.
    pub fn replace(&mut self, mapping: &Arc<Mapping>) -> Arc<Mapping> {
        self.told.clear();
        std::mem::replace(&mut self.mapping, Arc::clone(mapping))
    }

    /// Returns whether a value is a stray: the mapping does not name it, and it has no local
    /// subscriber. Any publisher on the network can invent such values.
    #[must_use]
    pub fn is_stray(&self, topic: TopicId, subscribed: bool) -> bool {
        !subscribed && self.mapping.variable(topic).is_none()
    }

    /// Requests a place for one more stray. `strays` returns the present strays, each with the time
    /// since which its writer is silent; it is called only if no place is free. Then the longest
    /// silent strays are dropped, at most [`MOST_LET_GO`] of them. A stray with an
    /// active writer is never dropped.
    pub fn admit_stray<I>(&mut self, now: Instant, strays: impl FnOnce(&Self) -> I) -> Admission
    where
        I: IntoIterator<Item = (Option<Instant>, TopicId)>,
    {
        let mut gone = Vec::new();
        if self.room.wants_look(now) {
            let mut there = 0_usize;
            gone = longest_silent(strays(self).into_iter().inspect(|_| there += 1));
            self.room.looked(there - gone.len(), now);
        }
        Admission {
            admitted: self.room.take(),
            gone,
        }
    }

    /// Returns the described type of a value and the part of its messages that the value is.
    /// Returns `None`, and logs it once, if the type has other fields here.
    pub fn learned(
        &mut self,
        topic: TopicId,
        described: &TopicMetaData,
        message_type: &MessageType,
    ) -> Option<(TypeName, Selection)> {
        let name = &described.message_type;
        let selection = described.selection(message_type);
        if selection.is_none() {
            self.told.once(&topic.to_string(), "other fields", || {
                format!(
                    "its writer announces the type {name}, but the definition here has other fields"
                )
            });
        }
        Some((name.clone(), selection?))
    }
}

/// Returns the strays to be dropped, longest silent first, at most [`MOST_LET_GO`]. A stray with an
/// active writer is not dropped.
#[must_use]
pub fn longest_silent(
    strays: impl IntoIterator<Item = (Option<Instant>, TopicId)>,
) -> Vec<TopicId> {
    let silent = strays.into_iter();
    let silent = silent.filter_map(|(since, topic)| since.map(|since| (since, topic)));
    let mut silent: Vec<(Instant, TopicId)> = silent.collect();
    silent.sort_unstable();
    silent.truncate(MOST_LET_GO);
    silent.into_iter().map(|(_, topic)| topic).collect()
}

/// Returns whether queued events change the type of a topic: earlier samples are still in the old
/// type.
#[must_use]
pub fn type_changes(waiting: &VecDeque<PortEvent>, topic: TopicId) -> bool {
    waiting.iter().any(|event| {
        matches!(
            event,
            PortEvent::Bound { topic: other, .. } | PortEvent::Unbound { topic: other }
                if *other == topic
        )
    })
}

/// Returns whether a status, the upper 16 bits of a StatusCode (OPC 10000-4, 7.39.1), is Bad.
#[must_use]
pub const fn is_bad(status: u16) -> bool {
    status & 0x8000 != 0
}

/// The reason why a value is not written while the type of its topic changes.
pub const TYPE_CHANGES: &str = "type changes";
/// The reason why an event is not written. It is counted, and is not a fault.
pub const NO_SUBSCRIBER: &str = "no subscriber is present";
/// The maximal number of topics that are read although the mapping does not name them: any node in
/// a graph can invent names. The same limit holds for written topics of strays.
pub const MAX_TOPICS: usize = 4096;
/// The maximal number of strays dropped at a time: each is reported to the ROS master, and RustDDS
/// has a bounded queue of commands.
pub const MOST_LET_GO: usize = MAX_TOPICS / 32;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn policy(mapping: &str) -> Policy {
        let mapping = Mapping::from_yaml(mapping, "cell.yaml").mapping.unwrap();
        Policy::new(SpaceId::ROS1, Arc::new(mapping))
    }

    fn topic(id: u16) -> TopicId {
        format!("ua_2_9_{id}").parse().unwrap()
    }

    #[test]
    fn what_the_mapping_names_or_somebody_wants_is_no_stray() {
        let policy = policy(
            "
spaces: [{id: 1}, {id: 2}]
namespaces: {9: urn:a:b}
variables:
  - {node: ns=9;i=1, name: Turn, origin: 2, ros: {space: 2, topic: /turn, type: geometry_msgs/Twist}}
",
        );
        assert!(!policy.is_stray(topic(1), false));
        assert!(!policy.is_stray(topic(2), true));
        assert!(policy.is_stray(topic(2), false));
    }

    #[test]
    fn those_silent_longest_give_way_and_those_heard_do_not() {
        let mut policy = Policy::new(SpaceId::ROS1, Arc::default());
        let start = crate::now().monotonic;
        for _ in 0..MAX_TOPICS {
            let admission = policy.admit_stray(start, |_| -> [_; 0] { panic!("there is room") });
            assert!(admission.admitted && admission.gone.is_empty());
        }
        let heard = (1..=10).map(|id| (None, topic(id)));
        let silent = (11..=65_000).map(|id| {
            let since = start + Duration::from_millis(u64::from(id).abs_diff(200));
            (Some(since), topic(id))
        });
        let now = start + Duration::from_secs(60);
        // The strays in use and the silent strays fill all places, and no place becomes free for a
        // while.
        let admission = policy.admit_stray(now, |_| heard.chain(silent));
        assert_eq!(
            (admission.admitted, admission.gone.len()),
            (false, MOST_LET_GO)
        );
        assert_eq!(admission.gone.first(), Some(&topic(200)));
        assert!(
            admission
                .gone
                .iter()
                .all(|gone| gone.identifier.get().abs_diff(200) <= 64)
        );
        // The strays are not checked again for each new stray.
        let again = policy.admit_stray(now, |_| -> [_; 0] { panic!("it was looked a moment ago") });
        assert!(!again.admitted);
        let later = now + Duration::from_secs(2);
        let left = policy.admit_stray(later, |_| [(None, topic(1))]);
        assert!(left.admitted && left.gone.is_empty());
    }

    #[test]
    fn a_type_that_the_router_does_not_know_yet_is_a_change() {
        let mut waiting = VecDeque::from([PortEvent::Live {
            topic: topic(1),
            live: true,
        }]);
        assert!(!type_changes(&waiting, topic(1)));
        waiting.push_back(PortEvent::Unbound { topic: topic(1) });
        assert!(type_changes(&waiting, topic(1)) && !type_changes(&waiting, topic(2)));
        assert!(is_bad(0x8034) && !is_bad(0x4000) && !is_bad(0));
    }
}
