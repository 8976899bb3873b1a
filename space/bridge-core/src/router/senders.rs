//! The redundant bridges of other spaces: messages of a bridge that is not active are dropped.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::SpaceId;

use super::about::About;
use super::security::Security;
use super::values::Values;
use crate::counters::Reason;
use crate::redundancy::{Heartbeat, SenderAddress};
use crate::settings::Now;

/// The redundant bridges of other spaces.
#[derive(Debug, Default)]
pub(super) struct RedundantSenders {
    of: BTreeMap<SpaceId, ActiveSender>,
}

/// The redundant bridges of another space.
#[derive(Debug)]
struct ActiveSender {
    heartbeat: Heartbeat,
    from: SocketAddr,
    at: Instant,
    /// The addresses of all bridges of the space, by instance.
    members: BTreeMap<u32, SenderAddress>,
}

impl RedundantSenders {
    /// Returns whether a heartbeat has the instance of a bridge that sends from another address.
    pub(super) fn is_forged(
        &self,
        space: SpaceId,
        heartbeat: &Heartbeat,
        (from, at): (SocketAddr, Instant),
    ) -> bool {
        let sender = self.of.get(&space);
        let member = sender.and_then(|sender| sender.members.get(&heartbeat.instance()));
        member.is_some_and(|member| member.is_forged(from, at))
    }

    /// Records the heartbeat of a bridge of another space.
    pub(super) fn meet(
        &mut self,
        space: SpaceId,
        heartbeat: Heartbeat,
        (from, at): (SocketAddr, Instant),
    ) {
        let sender = self.of.entry(space).or_insert_with(|| ActiveSender {
            heartbeat,
            from,
            at,
            members: BTreeMap::new(),
        });
        let is_known = sender.members.contains_key(&heartbeat.instance());
        if !is_known && sender.members.len() >= MOST_MEMBERS {
            sender.members.clear();
        }
        let member = sender.members.entry(heartbeat.instance());
        member
            .or_insert_with(|| SenderAddress::new(from, at))
            .note(from, at);
        let same = sender.heartbeat.instance() == heartbeat.instance();
        let before = sender.heartbeat.precedence();
        let stale = at.saturating_duration_since(sender.at) >= SENDER_LOST;
        let replaces = heartbeat.is_active()
            && (!sender.heartbeat.is_active() || stale || heartbeat.precedence() > before);
        if same || replaces {
            (sender.heartbeat, sender.from, sender.at) = (heartbeat, from, at);
        }
    }

    /// Returns whether a redundant bridge of another space sends values although another bridge of
    /// the space is active: its message was under way at the takeover. Counts it.
    pub(super) fn is_superseded(
        &self,
        values: &mut Values,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) -> bool {
        let Some(sender) = self.of.get(&space) else {
            return false;
        };
        let is_known = sender.heartbeat.is_active()
            && now.monotonic.saturating_duration_since(sender.at) < SENDER_LOST;
        let is_superseded = is_known
            && sender.from != from
            && sender.members.values().any(|member| member.last() == from);
        if is_superseded {
            let active = sender.from;
            let cause = (Reason::Takeover, "superseded");
            values.count(About::sender(from), cause, 1, || {
                format!("{active} is the active bridge of space {space}, and {from} sent a value")
            });
        }
        is_superseded
    }

    /// Returns whether the sender is known to be the active bridge of another space, because its
    /// heartbeat was secured as its message is.
    pub(super) fn is_active(
        &self,
        security: &Security,
        (space, from): (SpaceId, SocketAddr),
    ) -> bool {
        let sender = self.of.get(&space);
        let is_active =
            sender.is_some_and(|sender| sender.from == from && sender.heartbeat.is_active());
        is_active && security.is_authentic()
    }
}

/// The time after which the active bridge of another space counts as lost.
const SENDER_LOST: Duration = Duration::from_secs(1);
/// The maximum number of known bridges of another space. It is limited, because any sender in an
/// unsecured group can send heartbeats.
const MOST_MEMBERS: usize = 8;
