//! The address of a redundant bridge, in groups in which any sender can send heartbeats.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

/// The address of a bridge.
///
/// The first address counts while the bridge sends from it: a heartbeat from another address is
/// forged. A bridge with a changed interface sends from another address only.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SenderAddress {
    first: SocketAddr,
    /// The last heartbeat from the first address.
    heard: Instant,
    last: SocketAddr,
}

impl SenderAddress {
    pub(crate) const fn new(from: SocketAddr, now: Instant) -> Self {
        Self {
            first: from,
            heard: now,
            last: from,
        }
    }

    /// Returns the address of the last heartbeat.
    pub(crate) const fn last(&self) -> SocketAddr {
        self.last
    }

    /// Returns whether a heartbeat from this address is forged.
    pub(crate) fn is_forged(&self, from: SocketAddr, now: Instant) -> bool {
        from != self.first && now.saturating_duration_since(self.heard) < MOVED
    }

    /// Returns whether the first address has been silent for so long that it is forgotten.
    pub(crate) fn is_forgotten(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.heard) >= FORGOTTEN
    }

    /// Records a heartbeat that is not forged.
    pub(crate) fn note(&mut self, from: SocketAddr, now: Instant) {
        if from == self.first || self.is_forgotten(now) {
            (self.first, self.heard) = (from, now);
        }
        self.last = from;
    }
}

/// The silence of the first address after which the bridge may have moved: two heartbeats, and less
/// than the time of a takeover.
const MOVED: Duration = Duration::from_millis(50);
/// The silence after which the first address is forgotten.
const FORGOTTEN: Duration = Duration::from_secs(10);
