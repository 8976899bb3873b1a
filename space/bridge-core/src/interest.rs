//! The messages of other programs that a program handles.

use std::collections::BTreeSet;

use mappings::SpaceId;

/// The messages of other programs that a [limited](crate::Router::limit_to) program handles. It
/// drops all others by their headers, so a network may drop them earlier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interest {
    /// The namespaces that it uses, and its own. It handles their values, and their probes for
    /// calls.
    pub namespaces: BTreeSet<(SpaceId, u16)>,
    /// The spaces of the announcements that it handles.
    pub announced: BTreeSet<SpaceId>,
}
