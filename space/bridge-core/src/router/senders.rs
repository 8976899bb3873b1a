//! The redundant bridges of other spaces: messages of a bridge that is not active are dropped.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use mappings::SpaceId;

use super::about::DropSite;
use super::security::MessageSecurity;
use super::values::TopicQueues;
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
    /// The bridges of the space, in the order in which they were met.
    members: Vec<Member>,
}

/// A redundant bridge of another space.
#[derive(Debug)]
struct Member {
    instance: u32,
    address: SenderAddress,
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
        let mut members = sender.into_iter().flat_map(|sender| &sender.members);
        let member = members.find(|member| member.instance == heartbeat.instance());
        member.is_some_and(|member| member.address.is_forged(from, at))
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
            members: Vec::new(),
        });
        sender.note((heartbeat.instance(), from), at);
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
        values: &mut TopicQueues,
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
            && sender.members.iter().any(|of| of.address.last() == from);
        if is_superseded {
            let active = sender.from;
            let cause = (Reason::Takeover, "superseded");
            values.count(DropSite::sender(from), cause, 1, || {
                format!("{active} is the active bridge of space {space}, and {from} sent a value")
            });
        }
        is_superseded
    }

    /// Returns whether the sender is known to be the active bridge of another space, because its
    /// heartbeat was secured as its message is.
    pub(super) fn is_active(
        &self,
        security: &MessageSecurity,
        (space, from): (SpaceId, SocketAddr),
    ) -> bool {
        let sender = self.of.get(&space);
        let is_active =
            sender.is_some_and(|sender| sender.from == from && sender.heartbeat.is_active());
        is_active && security.is_authentic()
    }
}

impl ActiveSender {
    /// Records a bridge of the space. If there are too many, the bridge that was met last is
    /// removed, so that invented bridges do not displace a bridge that is known.
    fn note(&mut self, (instance, from): (u32, SocketAddr), at: Instant) {
        let mut members = self.members.iter_mut();
        if let Some(known) = members.find(|member| member.instance == instance) {
            return known.address.note(from, at);
        }
        if self.members.len() >= MOST_MEMBERS {
            self.members
                .retain(|member| !member.address.is_forgotten(at));
            self.members.truncate(MOST_MEMBERS - 1);
        }
        self.members.push(Member {
            instance,
            address: SenderAddress::new(from, at),
        });
    }
}

/// The time after which the active bridge of another space counts as lost.
const SENDER_LOST: Duration = Duration::from_secs(1);
/// The maximum number of known bridges of another space. It is limited, because any sender in an
/// unsecured group can send heartbeats.
const MOST_MEMBERS: usize = 8;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::redundancy::{Redundancy, RedundancyRank};

    #[test]
    #[expect(clippy::disallowed_methods, reason = "some instant to count from")]
    fn invented_heartbeats_do_not_displace_a_bridge_that_is_known() {
        let now = Now {
            monotonic: Instant::now(),
            utc: uadp::Timestamp::from_unix_nanos(1_700_000_000_000_000_000),
        };
        let address = |port: u16| SocketAddr::from(([127, 0, 0, 1], port));
        let of =
            |instance| Redundancy::new(RedundancyRank::new(1).unwrap(), instance, now).heartbeat();
        let space = SpaceId::new(3).unwrap();
        let mut senders = RedundantSenders::default();
        senders.meet(space, of(1), (address(1), now.monotonic));
        for instance in 100..120 {
            senders.meet(space, of(instance), (address(2), now.monotonic));
        }
        let is_forged = |of| senders.is_forged(space, &of, (address(3), now.monotonic));
        assert!(is_forged(of(1)));
        // Of the others, the bridges that were met first and the newest are known.
        assert!(is_forged(of(100)) && is_forged(of(119)));
        assert!(!is_forged(of(110)));
    }
}
