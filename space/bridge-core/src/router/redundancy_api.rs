//! The inputs and queries of a Router that concern redundancy. [`SpaceRedundancy`] does the work.

use std::time::Instant;

use super::Router;
use super::redundant::{MutedSamples, Redundant};
use super::roles::SpaceRedundancy;
use crate::redundancy::{LocalSide, Redundancy, RedundancyRank, SwitchRefusal};
use crate::settings::Now;

impl Router {
    /// Returns the redundancy with the parts of the Router that a change of the role affects.
    pub(super) fn roles(&mut self) -> SpaceRedundancy<'_> {
        SpaceRedundancy {
            calls: &mut self.calls,
            values: &mut self.values,
            announcements: &mut self.announcements,
            security: &self.security,
            senders: &mut self.redundant_senders,
            instance: self.instance,
        }
    }

    /// Mutes this program if its lease has ended. Called before each output.
    pub(super) fn check_lease(&mut self, now: Now) {
        if self.values.redundant.is_some() {
            self.roles().check_lease(now);
        }
    }

    /// Makes this program one of several redundant bridges of its space. It is muted until it takes
    /// over. Call it after [`set_instance`](Self::set_instance).
    pub fn set_redundancy(&mut self, rank: RedundancyRank, now: Now) {
        let [.., a, b, c, d] = self.instance;
        let instance = u32::from_le_bytes([a, b, c, d]);
        self.values.redundant = Some(Box::new(Redundant::new(rank, instance, now)));
    }

    /// Lets the local side take the values of other spaces while this program is a standby, as for
    /// a server that shows them to clients. Call it after [`set_redundancy`](Self::set_redundancy).
    pub fn show_values_at_standby(&mut self) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.show_values();
        }
    }

    /// Returns the state of the redundancy; `None` for a program without redundancy.
    #[must_use]
    pub fn redundancy(&self) -> Option<&Redundancy> {
        self.values.redundancy()
    }

    /// Returns whether another redundant bridge of the space publishes on the local side, or may
    /// do so.
    #[must_use]
    pub fn is_standby(&self) -> bool {
        self.values.is_muted_locally()
    }

    /// Returns the number of samples that were muted.
    #[must_use]
    pub fn muted_samples(&self) -> Option<MutedSamples> {
        let redundant = self.values.redundant.as_ref()?;
        Some(redundant.muted_samples())
    }

    /// Returns whether this program takes over at the next
    /// [`handle_timeout`](Self::handle_timeout).
    #[must_use]
    pub fn takes_over(&self, now: Instant) -> bool {
        self.redundancy().is_some_and(|state| state.takes_over(now))
    }

    /// Defers the takeover, because datagrams that have arrived are not handled yet. A takeover is
    /// deferred for at most 1 s.
    pub fn defer_takeover(&mut self, now: Instant) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.defer(now);
        }
    }

    /// Sets whether the local side is within reach.
    pub fn set_side(&mut self, side: LocalSide) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.set_side(side);
        }
    }

    /// Sets the ServiceLevel of this OPC UA server, for the other servers of its redundant set.
    pub fn set_service_level(&mut self, level: Option<u8>) {
        if let Some(redundant) = &mut self.values.redundant {
            redundant.set_service_level(level);
        }
    }

    /// Hands over to a standby.
    ///
    /// # Errors
    /// This program is not active, or there is no standby.
    pub fn switch_over(&mut self, now: Now) -> Result<(), SwitchRefusal> {
        self.roles().switch_over(now)
    }

    /// Records whether the network took the last heartbeat.
    pub fn heartbeat_sent(&mut self, is_sent: bool, now: Now) {
        self.roles().heartbeat_sent(is_sent, now);
    }
}
