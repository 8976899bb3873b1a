//! The limits of the search through the address space of a server.

use std::time::Duration;

/// The limits of a search.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SearchLimits {
    /// Maximum number of nodes.
    pub(crate) nodes: usize,
    /// Maximum number of references from a start node.
    pub(crate) depth: usize,
    /// Time after which the search ends.
    pub(crate) within: Duration,
}

impl Default for SearchLimits {
    fn default() -> Self {
        Self {
            nodes: 20_000,
            depth: 32,
            within: Duration::from_secs(120),
        }
    }
}
