//! The number of nodes that a face shows.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

/// The nodes that a face shows of all servers together. A server keeps its nodes until it leaves,
/// so that a server with many nodes does not displace others.
#[derive(Debug)]
pub(crate) struct NodeBudget {
    most: usize,
    /// The nodes that are shown of each server, by URL.
    used: Mutex<BTreeMap<String, usize>>,
}

impl Default for NodeBudget {
    fn default() -> Self {
        Self::new(MOST_NODES_OF_ALL)
    }
}

impl NodeBudget {
    pub(crate) fn new(most: usize) -> Self {
        Self {
            most,
            used: Mutex::default(),
        }
    }

    /// Returns the number of nodes that are shown of a server with this many nodes.
    pub(crate) fn grant(&self, url: &str, wanted: usize) -> usize {
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        let others = used.iter().filter(|(known, _)| *known != url);
        let others: usize = others.map(|(_, nodes)| nodes).sum();
        let granted = wanted.min(self.most.saturating_sub(others));
        used.insert(url.to_owned(), granted);
        granted
    }

    /// Releases the nodes of a server that has left.
    pub(crate) fn release(&self, url: &str) {
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        used.remove(url);
    }
}

/// Largest number of nodes that a face shows: about 1 KiB of memory each.
const MOST_NODES_OF_ALL: usize = 300_000;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn servers_share_the_nodes_and_a_server_that_leaves_makes_room() {
        let budget = NodeBudget::new(100);
        assert_eq!(budget.grant("a", 60), 60);
        assert_eq!(budget.grant("b", 60), 40);
        assert_eq!(budget.grant("c", 1), 0);
        assert_eq!(budget.grant("a", 60), 60, "it keeps its nodes");
        budget.release("a");
        assert_eq!(budget.grant("b", 60), 60);
        assert_eq!(budget.grant("c", 1), 1);
    }
}
