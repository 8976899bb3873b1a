//! The redundancy of a bridge: heartbeats, changes of its role, and the requests of the operator.

use std::net::SocketAddr;
use std::time::Duration;

use bridge_core::{LocalSide, MuteCause, RedundancyRank, RoleChange, TakeoverCause};
use mappings::Mapping;
use tracing::{error, info, warn};
use transport::OutgoingMessage;

use super::Shell;
use crate::clock::now;
use crate::port::Port;
use crate::redundancy::uncovered;

impl<P: Port> Shell<P> {
    /// Handles the datagrams that wait in the socket before a takeover: the heartbeats of the
    /// active bridge may be among them. If they are too many, the takeover is deferred.
    pub(super) fn read_waiting(&mut self, buffer: &mut Vec<u8>) {
        for _ in 0..READ_AT_ONCE {
            if !self.router.takes_over(now().monotonic) {
                return;
            }
            let Some(received) = self.carrier.try_recv(buffer) else {
                return;
            };
            self.heard(received, buffer);
            self.drain();
        }
        self.router.defer_takeover(now().monotonic);
    }

    pub(super) fn send_heartbeat(&mut self, bytes: Vec<u8>) {
        let now = now();
        let is_sent = self.send(&OutgoingMessage::new(&bytes)).is_ok();
        self.router.heartbeat_sent(is_sent, now);
        self.router.recycle(bytes);
    }

    pub(super) fn tell_role(&mut self, change: RoleChange) {
        let rank = self.router.redundancy().map(|state| state.rank().get());
        match change {
            RoleChange::TookOver { cause, epoch, gap } => {
                self.port.role_changed(true);
                self.offer_calls_of_others(true);
                tell_active(rank, (cause, epoch, gap));
                self.router.set_service_level(self.port.service_level());
            }
            RoleChange::Follows { rank: other, from } => tell_standby(rank, (other, from)),
            RoleChange::Muted { cause } => {
                let is_planned = matches!(cause, MuteCause::Released | MuteCause::Unfit);
                self.port.role_changed(false);
                self.port.drop_waiting(!is_planned);
                if self.router.is_standby() {
                    self.offer_calls_of_others(false);
                }
                tell_muted(rank, cause);
                self.router.set_service_level(self.port.service_level());
            }
            RoleChange::Rival { rank: other, from } => tell_rival(rank, (other, from)),
            RoleChange::SameRank { from } => tell_same_rank(rank, from),
            RoleChange::CutOff => {
                warn!(
                    rank,
                    "the group is out of reach: a standby takes over the values, and this bridge publishes `on_loss` \
                     on its ROS side"
                );
            }
        }
    }

    /// Hands over to a standby on request of the operator.
    pub(super) fn switch_over(&mut self) {
        match self.router.switch_over(now()) {
            Ok(()) => info!("handing over to the standby"),
            Err(refusal) => warn!("cannot hand over: {refusal}"),
        }
    }

    /// Hands over to a standby at the end of the program.
    pub(super) fn hand_over_at_end(&mut self) {
        if self.router.switch_over(now()).is_ok() {
            info!("handing over to the standby");
            while self.drain() {}
        }
    }

    /// Returns the time to the next check of the links of the ROS side. A redundant bridge that
    /// lost its link hands over within the time of a takeover.
    pub(super) fn link_pause(&self) -> Duration {
        let is_urgent = self.router.redundancy().is_some() || self.links.is_lost();
        let period = if is_urgent {
            LINK_LOOK
        } else {
            LINK_LOOK_ALONE
        };
        self.links.pause(period)
    }

    /// Checks the links of the ROS side. Changes are reported by the check of each second, so that
    /// a link that is down for a moment does not end the program.
    pub(super) fn look_at_links(&mut self) {
        if self.side.is_watched() {
            let before = now().monotonic;
            self.side.refresh();
            self.links.took(now().monotonic.duration_since(before));
        }
        self.look_at_fitness();
    }

    /// Sets whether the ROS side is within reach.
    pub(super) fn look_at_fitness(&mut self) {
        let is_redundant = self.router.redundancy().is_some();
        if let Some(lost) = self.side.lost_addresses() {
            // A standby must not become active with values that wait in a connection.
            let patience = if is_redundant {
                Duration::ZERO
            } else {
                PATIENCE
            };
            if let Some(lost) = self.links.look(&lost, patience, now().monotonic) {
                self.port.links_lost(lost);
            }
        }
        if !is_redundant {
            return;
        }
        let is_held = self.side.lost().is_none();
        let side = match (is_held, self.port.hindrance()) {
            (false, _) => LocalSide::NoLink,
            (true, Some(_)) => LocalSide::Silent,
            (true, None) => LocalSide::Reached,
        };
        self.router.set_side(side);
        self.router.set_service_level(self.port.service_level());
    }

    /// Returns the reasons for which the redundancy does not work.
    pub(super) fn redundancy_faults(&self) -> impl Iterator<Item = String> {
        let now = now().monotonic;
        let state = self.router.redundancy();
        let double = state.filter(|state| state.has_double(now));
        double.into_iter().map(|state| {
            let rank = state.rank().get();
            format!("another bridge has rank {rank} too: give one of them another --rank")
        })
    }

    /// Returns the parts of a new mapping that a redundant bridge does not carry.
    pub(super) fn not_redundant(&self, mapping: &Mapping) -> Option<String> {
        self.router.redundancy()?;
        uncovered(mapping, self.own)
    }
}

fn tell_active(rank: Option<u8>, (cause, epoch, gap): (TakeoverCause, u32, Option<Duration>)) {
    let gap_ms = gap.map(|gap| u64::try_from(gap.as_millis()).unwrap_or(u64::MAX));
    info!(
        rank,
        epoch,
        gap_ms,
        "this bridge is active: {}",
        cause.text()
    );
}

fn tell_standby(rank: Option<u8>, (active, from): (RedundancyRank, SocketAddr)) {
    info!(rank, active_rank = active.get(), active = %from, "this bridge is a standby");
}

fn tell_muted(rank: Option<u8>, cause: MuteCause) {
    warn!(
        rank,
        "this bridge is not active any more and sends nothing: {}",
        cause.text()
    );
}

fn tell_rival(rank: Option<u8>, (other, from): (RedundancyRank, SocketAddr)) {
    warn!(
        rank,
        other_rank = other.get(),
        other = %from,
        "another bridge was active at the same time: values may be doubled; check the network between \
         the hosts"
    );
}

fn tell_same_rank(rank: Option<u8>, from: SocketAddr) {
    error!(rank, other = %from, "another bridge has the same rank; give one of them another --rank");
}

/// The interval in which redundant bridges check the links of the ROS side. Listing the interfaces
/// takes less than 0.1 ms on a host with few.
const LINK_LOOK: Duration = Duration::from_millis(25);
/// The interval in which a bridge that runs alone does so.
const LINK_LOOK_ALONE: Duration = Duration::from_millis(100);
/// How long a link may be down until a bridge that runs alone closes connections. What is sent in
/// this time arrives late.
const PATIENCE: Duration = Duration::from_millis(200);
/// The maximum number of datagrams that are handled in a row before a takeover.
const READ_AT_ONCE: usize = 256;
