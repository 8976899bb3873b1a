//! The messages of other programs that a program handles.

use std::collections::BTreeSet;

use mappings::SpaceId;

/// The messages of other programs that a [limited](crate::Router::limit_to) program handles. It
/// drops all others by their headers, so a network may drop them earlier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interest {
    /// The namespaces whose values, and whose probes for calls, it handles: those that it uses and
    /// its own.
    pub namespaces: BTreeSet<(SpaceId, u16)>,
    /// The spaces whose announcements it handles.
    pub announced: BTreeSet<SpaceId>,
}
