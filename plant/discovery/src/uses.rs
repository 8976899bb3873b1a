//! The order in which connections were used, so that an unused connection gives way first.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// The last use of a connection: its start, or a message of its client. A greater number is later.
#[derive(Debug, Clone, Default)]
pub(crate) struct ConnectionUse(Arc<AtomicU64>);

impl ConnectionUse {
    pub(crate) fn last(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Counts the uses of all connections.
#[derive(Debug, Default)]
pub(crate) struct UseOrder(AtomicU64);

impl UseOrder {
    /// Returns the use of a new connection, which is the latest of all.
    pub(crate) fn begin(&self) -> ConnectionUse {
        let used = ConnectionUse::default();
        self.note(&used);
        used
    }

    /// Notes that a connection is used.
    pub(crate) fn note(&self, used: &ConnectionUse) {
        let now = self.0.fetch_add(1, Ordering::Relaxed);
        used.0.store(now, Ordering::Relaxed);
    }
}
