//! The namespaces of other programs that a program uses.

use std::collections::BTreeSet;

use mappings::{SpaceId, TopicId};

/// The namespaces of other programs whose values and calls this program uses. Everything else that
/// other programs send is dropped by its header, which is no loss.
#[derive(Debug, Default)]
pub(crate) enum Concern {
    /// All namespaces, such as for a bridge or a server.
    #[default]
    All,
    /// The given namespaces of spaces, such as for a component.
    Only(BTreeSet<(SpaceId, u16)>),
}

impl Concern {
    /// Returns whether the program uses the namespace of the space.
    pub(crate) fn has(&self, space: SpaceId, namespace: u16) -> bool {
        match self {
            Self::All => true,
            Self::Only(namespaces) => namespaces.contains(&(space, namespace)),
        }
    }

    /// Returns whether the program uses the namespace of the topic.
    pub(crate) fn has_topic(&self, topic: TopicId) -> bool {
        self.has(topic.space, topic.triple().1)
    }

    /// Returns whether the program uses the given namespaces only.
    pub(crate) const fn is_limited(&self) -> bool {
        matches!(self, Self::Only(_))
    }

    /// Limits the program to no namespaces, unless it is limited already.
    pub(crate) fn limit(&mut self) {
        if matches!(self, Self::All) {
            *self = Self::Only(BTreeSet::new());
        }
    }

    /// Adds the namespace of a topic.
    pub(crate) fn add(&mut self, topic: TopicId) {
        if let Self::Only(namespaces) = self {
            namespaces.insert((topic.space, topic.triple().1));
        }
    }

    /// Returns the namespaces; `None` for all of them.
    pub(crate) const fn namespaces(&self) -> Option<&BTreeSet<(SpaceId, u16)>> {
        match self {
            Self::All => None,
            Self::Only(namespaces) => Some(namespaces),
        }
    }
}
