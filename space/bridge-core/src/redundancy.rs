//! Redundant bridges of a space: a single bridge is active, the others are ready to take over.
//!
//! Each bridge sends a [`Heartbeat`] every 20 ms to the group. The active bridge sends values
//! to both sides. A standby receives everything and sends nothing but heartbeats. It becomes active
//! when it misses the heartbeats of the active bridge, with a higher epoch.
//!
//! The active bridge holds a lease: it may send while its last heartbeat is at most 70 ms old,
//! which is shorter than the time after which a standby takes over. A process that was
//! stopped therefore mutes itself before its next message. A standby does not count the time for
//! which it did not run itself, because heartbeats may wait in its socket.
//!
//! The module has no clock and no socket: times are inputs, and [`Redundancy::due`] returns the
//! time of the next [`poll`](Redundancy::poll).

mod address;
mod clocks;
mod heartbeat;
mod role;

use std::net::SocketAddr;
use std::time::{Duration, Instant};

pub(crate) use self::address::SenderAddress;
pub(crate) use self::clocks::{SenderClocks, SentAt};
pub use self::heartbeat::Heartbeat;
pub use self::role::{
    LocalSide, MuteCause, RedundancyRank, RedundancyRole, RoleChange, SwitchRefusal, TakeoverCause,
};
use crate::settings::Now;

/// Another bridge of the space.
#[derive(Debug, Clone, Copy)]
pub struct RedundantPeer {
    heartbeat: Heartbeat,
    address: SenderAddress,
    heard: Instant,
    /// The number of heartbeats in a row that reported a ROS side within reach.
    fit_in_row: u32,
}

impl RedundantPeer {
    fn new(heartbeat: Heartbeat, from: SocketAddr, now: Instant) -> Self {
        Self {
            heartbeat,
            address: SenderAddress::new(from, now),
            heard: now,
            fit_in_row: u32::from(heartbeat.is_fit),
        }
    }

    /// Records a heartbeat. Returns the heartbeat before it.
    fn note(&mut self, heartbeat: Heartbeat, from: SocketAddr, now: Instant) -> Heartbeat {
        self.fit_in_row = match (heartbeat.is_fit, self.is_present(now)) {
            (false, _) => 0,
            (true, true) => self.fit_in_row.saturating_add(1),
            // The state of its ROS side in the meantime is unknown.
            (true, false) => 1,
        };
        self.address.note(from, now);
        self.heard = now;
        std::mem::replace(&mut self.heartbeat, heartbeat)
    }

    /// Returns the rank.
    #[must_use]
    pub const fn rank(&self) -> RedundancyRank {
        self.heartbeat.rank
    }

    /// Returns the role.
    #[must_use]
    pub const fn role(&self) -> RedundancyRole {
        self.heartbeat.role
    }

    /// Returns the epoch.
    #[must_use]
    pub const fn epoch(&self) -> u32 {
        self.heartbeat.epoch
    }

    /// Returns whether the ROS side of the peer is within reach.
    #[must_use]
    pub const fn is_fit(&self) -> bool {
        self.heartbeat.is_fit
    }

    /// Returns the ServiceLevel of an OPC UA server; `None` for a bridge.
    #[must_use]
    pub const fn service_level(&self) -> Option<u8> {
        self.heartbeat.service_level
    }

    /// Returns whether the last heartbeat is so recent that the peer takes part in a takeover.
    #[must_use]
    pub fn is_present(&self, now: Instant) -> bool {
        self.age(now) < PRESENT
    }

    /// Returns the address.
    #[must_use]
    pub const fn from(&self) -> SocketAddr {
        self.address.last()
    }

    /// Returns the time since the last heartbeat.
    #[must_use]
    pub fn age(&self, now: Instant) -> Duration {
        now.saturating_duration_since(self.heard)
    }
}

/// The number of events since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RedundancyCounts {
    /// Takeovers by this bridge.
    pub takeovers: u64,
    /// Times at which this bridge muted itself, because it did not run for longer than its lease.
    pub stalls: u64,
    /// Times at which another bridge was active at once. Values may have been doubled then.
    pub rivals: u64,
}

/// The last takeover by this bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Takeover {
    /// The cause.
    pub cause: TakeoverCause,
    /// The time of the takeover.
    pub at: Instant,
    /// The time since the last heartbeat of the bridge that was active before.
    pub gap: Option<Duration>,
}

/// The state of a redundant bridge.
#[derive(Debug)]
pub struct Redundancy {
    rank: RedundancyRank,
    instance: u32,
    role: RedundancyRole,
    epoch: u32,
    side: LocalSide,
    /// The ServiceLevel of this OPC UA server.
    service_level: Option<u8>,
    /// The number of heartbeats with a ROS side out of reach.
    unfit: u32,
    /// Whether this bridge has handed over and no other bridge was active since.
    is_released: bool,
    /// Whether the group is out of reach while this bridge is active.
    is_cut: bool,
    /// The time of the next heartbeat.
    next: Instant,
    /// The time of the last heartbeat that was sent.
    leased: Instant,
    /// The last readings of both clocks.
    seen: Now,
    /// The time at which this bridge takes over, unless it receives an active bridge before.
    deadline: Instant,
    /// The time since which the takeover is deferred.
    deferred: Option<Instant>,
    /// The cause of the next takeover.
    cause: TakeoverCause,
    /// The instance of the active bridge that is followed.
    followed: Option<u32>,
    /// The last heartbeat of an active bridge, including this bridge.
    active_at: Option<Instant>,
    /// The other bridges, in the order in which they were met.
    peers: Vec<RedundantPeer>,
    counts: RedundancyCounts,
    last: Option<Takeover>,
}

impl Redundancy {
    /// Creates the state of a bridge that starts. `instance` distinguishes the bridges of a space.
    #[must_use]
    pub fn new(rank: RedundancyRank, instance: u32, now: Now) -> Self {
        Self {
            rank,
            instance,
            role: RedundancyRole::Starting,
            epoch: 0,
            side: LocalSide::Reached,
            service_level: None,
            unfit: 0,
            is_released: false,
            is_cut: false,
            next: now.monotonic,
            leased: now.monotonic,
            seen: now,
            deadline: now.monotonic + rank.listening(),
            deferred: None,
            cause: TakeoverCause::Start,
            followed: None,
            active_at: None,
            peers: Vec::new(),
            counts: RedundancyCounts::default(),
            last: None,
        }
    }

    /// Returns the rank of this bridge.
    #[must_use]
    pub const fn rank(&self) -> RedundancyRank {
        self.rank
    }

    /// Returns the role of this bridge.
    #[must_use]
    pub const fn role(&self) -> RedundancyRole {
        self.role
    }

    /// Returns the epoch, which increases with each takeover.
    #[must_use]
    pub const fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Returns the counts since the start.
    #[must_use]
    pub const fn counts(&self) -> RedundancyCounts {
        self.counts
    }

    /// Returns the last takeover by this bridge.
    #[must_use]
    pub const fn last_takeover(&self) -> Option<Takeover> {
        self.last
    }

    /// Returns the other bridges that were received within the last seconds.
    pub fn peers(&self, now: Instant) -> impl Iterator<Item = &RedundantPeer> {
        let shown = move |peer: &&RedundantPeer| peer.age(now) < FORGOTTEN;
        self.peers.iter().filter(shown)
    }

    /// Returns whether another present bridge has the rank of this bridge.
    #[must_use]
    pub fn has_double(&self, now: Instant) -> bool {
        let double = |peer: &RedundantPeer| peer.rank() == self.rank && peer.is_present(now);
        self.peers.iter().any(double)
    }

    /// Returns whether nothing may be sent to the group.
    #[must_use]
    pub fn mutes_group(&self) -> bool {
        self.role != RedundancyRole::Active || self.is_cut
    }

    /// Returns whether nothing may be published on the local side.
    #[must_use]
    pub fn mutes_local(&self) -> bool {
        self.role != RedundancyRole::Active
    }

    /// Returns whether the group is out of reach while this bridge is active.
    #[must_use]
    pub const fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// Returns whether the address belongs to another bridge of the space.
    pub(crate) fn is_peer(&self, from: SocketAddr) -> bool {
        self.peers.iter().any(|peer| peer.from() == from)
    }

    /// Returns whether the address belongs to the followed active bridge.
    pub(crate) fn is_followed(&self, from: SocketAddr) -> bool {
        let followed = |peer: &RedundantPeer| {
            peer.from() == from && Some(peer.heartbeat.instance) == self.followed
        };
        self.role != RedundancyRole::Active && self.peers.iter().any(followed)
    }

    /// Returns the time of the next [`poll`](Self::poll).
    #[must_use]
    pub fn due(&self) -> Instant {
        match self.role {
            RedundancyRole::Active => self.next,
            RedundancyRole::Starting | RedundancyRole::Standby => self.next.min(self.deadline),
        }
    }

    /// Returns whether this bridge takes over at the next [`poll`](Self::poll).
    #[must_use]
    pub fn takes_over(&self, now: Instant) -> bool {
        self.role != RedundancyRole::Active && now >= self.deadline
    }

    /// Defers the takeover, because messages that have arrived are not handled yet: a heartbeat of
    /// the active bridge may be among them. A takeover is deferred for at most 1 s, so that a flood
    /// in the group does not prevent it.
    pub fn defer(&mut self, now: Instant) {
        if !self.takes_over(now) {
            return;
        }
        let since = *self.deferred.get_or_insert(now);
        if now.saturating_duration_since(since) < LONGEST_DEFERRAL {
            self.deadline = now + DEFERRED;
        }
    }

    /// Sets whether the ROS side is within reach.
    pub const fn set_side(&mut self, side: LocalSide) {
        self.side = side;
    }

    /// Sets the ServiceLevel of this OPC UA server, which its heartbeats carry.
    pub const fn set_service_level(&mut self, level: Option<u8>) {
        self.service_level = level;
    }

    /// Checks the lease. Call it before each message that is sent: an active bridge that did not
    /// run, or with a clock that jumped, is muted.
    pub fn check(&mut self, now: Now) -> Option<RoleChange> {
        let seen = std::mem::replace(&mut self.seen, now);
        if self.role != RedundancyRole::Active {
            let stopped = now.monotonic.saturating_duration_since(seen.monotonic);
            if stopped > TOLERATED {
                self.deadline = (self.deadline + stopped).max(now.monotonic + QUIET);
            }
            return None;
        }
        let passed = now.monotonic.saturating_duration_since(seen.monotonic);
        let idle = match self.is_cut {
            // It sends no heartbeats.
            true => passed,
            false => now.monotonic.saturating_duration_since(self.leased),
        };
        let told = now.utc.unix_nanos() - seen.utc.unix_nanos();
        let jumped = told - i128::try_from(passed.as_nanos()).unwrap_or(i128::MAX);
        let lease = i128::try_from(LEASE.as_nanos()).unwrap_or(i128::MAX);
        if idle <= LEASE && jumped <= lease {
            return None;
        }
        self.counts.stalls += 1;
        let alone = idle < ALONE
            && jumped <= lease
            && !self
                .peers
                .iter()
                .any(|peer| peer.age(now.monotonic) < FORGOTTEN);
        let patience = if alone { QUIET } else { PATIENCE + STALLED };
        Some(self.mute(MuteCause::Stalled, patience, now))
    }

    /// Advances to `now`: returns the heartbeat to send, if it is due, and the change of the role.
    /// Report the heartbeat with [`sent`](Self::sent) or [`not_sent`](Self::not_sent).
    pub fn poll(&mut self, now: Now) -> (Option<Heartbeat>, Option<RoleChange>) {
        let change = match self.role {
            RedundancyRole::Starting | RedundancyRole::Standby
                if now.monotonic >= self.deadline =>
            {
                self.next = now.monotonic;
                Some(self.take_over(now))
            }
            RedundancyRole::Active if now.monotonic >= self.next => self.look_at_sides(now),
            RedundancyRole::Starting | RedundancyRole::Standby | RedundancyRole::Active => None,
        };
        if now.monotonic < self.next {
            return (None, None);
        }
        // Missed heartbeats are not made up for.
        self.next = now.monotonic + PERIOD;
        (Some(self.heartbeat()), change)
    }

    /// Returns the heartbeat of this bridge.
    #[must_use]
    pub const fn heartbeat(&self) -> Heartbeat {
        Heartbeat {
            rank: self.rank,
            role: self.role,
            epoch: self.epoch,
            instance: self.instance,
            is_fit: self.side.is_reached(),
            is_released: self.is_released,
            service_level: self.service_level,
        }
    }

    /// Records that a heartbeat was sent.
    pub fn sent(&mut self, now: Now) -> Option<RoleChange> {
        if self.role == RedundancyRole::Active && self.is_cut {
            // Another bridge may have taken over in the meantime.
            return Some(self.mute(MuteCause::Reconnected, PATIENCE + STALLED, now));
        }
        self.leased = now.monotonic;
        if self.role == RedundancyRole::Active {
            self.active_at = Some(now.monotonic);
        }
        None
    }

    /// Records that the network did not take a heartbeat. A standby that is cut off does not take
    /// over. The active bridge stays responsible for its local side.
    pub fn not_sent(&mut self, now: Now) -> Option<RoleChange> {
        self.deadline = now.monotonic + PATIENCE + STALLED;
        let is_new = self.role == RedundancyRole::Active && !self.is_cut;
        self.is_cut |= is_new;
        is_new.then_some(RoleChange::CutOff)
    }

    /// Records that there were no keys for a heartbeat.
    pub fn not_sealed(&mut self, now: Now) -> Option<RoleChange> {
        self.deadline = now.monotonic + self.rank.listening();
        let was_active = self.role == RedundancyRole::Active;
        was_active.then(|| self.mute(MuteCause::NoKeys, self.rank.listening(), now))
    }

    /// Returns whether a heartbeat has the instance of another bridge, which sends from another
    /// address. Only for groups in which any sender can send heartbeats.
    pub(crate) fn is_forged(&self, heartbeat: &Heartbeat, from: SocketAddr, now: Instant) -> bool {
        let mut peers = self.peers.iter();
        let known = peers.find(|peer| peer.heartbeat.instance == heartbeat.instance);
        known.is_some_and(|peer| peer.address.is_forged(from, now))
    }

    /// Handles the heartbeat of another bridge of the space.
    pub fn hear(&mut self, heartbeat: Heartbeat, from: SocketAddr, now: Now) -> Option<RoleChange> {
        if heartbeat.instance == self.instance {
            return None;
        }
        // A bridge that was stopped is no rival of the bridge that took over.
        let muted = self.check(now);
        let change = self.hear_other(heartbeat, from, now);
        muted.or(change)
    }

    fn hear_other(
        &mut self,
        heartbeat: Heartbeat,
        from: SocketAddr,
        now: Now,
    ) -> Option<RoleChange> {
        let before = self.meet(heartbeat, from, now.monotonic);
        if heartbeat.is_active() {
            return self.hear_active(heartbeat, from, (before, now));
        }
        if heartbeat.is_released
            && self.role != RedundancyRole::Active
            && self.followed == Some(heartbeat.instance)
        {
            // The former active bridge sends nothing any more; its last values may be under way.
            self.cause = TakeoverCause::Released;
            let after = now.monotonic + QUIET + self.turn_of_release(now.monotonic);
            self.deadline = self.deadline.min(after);
        }
        let is_new = before.is_none_or(|before| before.rank != self.rank);
        (is_new && heartbeat.rank == self.rank).then_some(RoleChange::SameRank { from })
    }

    fn hear_active(
        &mut self,
        heartbeat: Heartbeat,
        from: SocketAddr,
        (before, now): (Option<Heartbeat>, Now),
    ) -> Option<RoleChange> {
        if self.role == RedundancyRole::Active {
            if heartbeat.precedence() > self.heartbeat().precedence() {
                self.counts.rivals += 1;
                let muted = self.mute(MuteCause::Outranked, PATIENCE, now);
                self.follow(heartbeat, now);
                return Some(muted);
            }
            let is_new =
                before.is_none_or(|before| !before.is_active() || before.epoch != heartbeat.epoch);
            if !is_new {
                return None;
            }
            self.counts.rivals += 1;
            return Some(RoleChange::Rival {
                rank: heartbeat.rank,
                from,
            });
        }
        if heartbeat.epoch < self.epoch {
            // A bridge that was active before; it mutes itself.
            return None;
        }
        let is_new =
            self.role == RedundancyRole::Starting || self.followed != Some(heartbeat.instance);
        self.follow(heartbeat, now);
        is_new.then_some(RoleChange::Follows {
            rank: heartbeat.rank,
            from,
        })
    }

    fn follow(&mut self, heartbeat: Heartbeat, now: Now) {
        self.role = RedundancyRole::Standby;
        self.epoch = heartbeat.epoch;
        self.followed = Some(heartbeat.instance);
        self.active_at = Some(now.monotonic);
        self.is_released = false;
        self.deadline = now.monotonic + PATIENCE + self.turn(now.monotonic);
        self.deferred = None;
        self.cause = TakeoverCause::Lost;
    }

    /// Returns the time by which this bridge takes over later than the standbys of lower ranks.
    fn turn(&self, now: Instant) -> Duration {
        let before = self.peers.iter().filter(|peer| {
            peer.role() == RedundancyRole::Standby
                && peer.is_present(now)
                && peer.rank() < self.rank
        });
        LATER * u32::try_from(before.count()).unwrap_or(u32::MAX)
    }

    /// Returns the time by which this bridge takes over later than others after a release: first
    /// the standbys that reach their ROS side, then the others, each by their ranks.
    fn turn_of_release(&self, now: Instant) -> Duration {
        let own = (self.side != LocalSide::Reached, self.rank);
        let before = self.peers.iter().filter(|peer| {
            peer.role() == RedundancyRole::Standby
                && peer.is_present(now)
                && (!peer.is_fit(), peer.rank()) < own
        });
        LATER * u32::try_from(before.count()).unwrap_or(u32::MAX)
    }

    /// Hands over to a standby.
    ///
    /// # Errors
    /// This bridge is not active, or there is no standby.
    pub fn switch_over(&mut self, now: Now) -> Result<RoleChange, SwitchRefusal> {
        if self.role != RedundancyRole::Active {
            return Err(SwitchRefusal::NotActive);
        }
        if !self.has_standby(0, now.monotonic) {
            return Err(SwitchRefusal::NoStandby);
        }
        Ok(self.release(MuteCause::Released, now))
    }

    fn release(&mut self, cause: MuteCause, now: Now) -> RoleChange {
        let muted = self.mute(cause, self.rank.listening(), now);
        self.is_released = true;
        self.next = now.monotonic;
        muted
    }

    /// Returns whether a standby was received within the time of a takeover, whose last
    /// heartbeats, `fit` in number, reported a ROS side within reach.
    fn has_standby(&self, fit: u32, now: Instant) -> bool {
        self.peers.iter().any(|peer| {
            peer.role() == RedundancyRole::Standby && peer.is_present(now) && peer.fit_in_row >= fit
        })
    }

    /// Hands over if the ROS side is out of reach and a standby reaches it, both for the same
    /// number of heartbeats: the ROS side of a standby that was lost a moment ago may be lost
    /// again, or both sides return together.
    fn look_at_sides(&mut self, now: Now) -> Option<RoleChange> {
        let patience = match self.side {
            LocalSide::Reached => {
                self.unfit = 0;
                return None;
            }
            LocalSide::Silent => UNFIT,
            LocalSide::NoLink => UNLINKED,
        };
        self.unfit = self.unfit.saturating_add(1);
        let hands_over = self.unfit >= patience && self.has_standby(patience, now.monotonic);
        hands_over.then(|| self.release(MuteCause::Unfit, now))
    }

    fn take_over(&mut self, now: Now) -> RoleChange {
        let known = self.peers.iter().map(RedundantPeer::epoch).max();
        self.role = RedundancyRole::Active;
        self.epoch = known.unwrap_or(0).max(self.epoch).saturating_add(1);
        self.followed = None;
        self.deferred = None;
        self.is_released = false;
        self.is_cut = false;
        self.unfit = 0;
        self.leased = now.monotonic;
        self.counts.takeovers += 1;
        let gap = self.active_at;
        let gap = gap.map(|at| now.monotonic.saturating_duration_since(at));
        let cause = self.cause;
        self.last = Some(Takeover {
            cause,
            at: now.monotonic,
            gap,
        });
        RoleChange::TookOver {
            cause,
            epoch: self.epoch,
            gap,
        }
    }

    fn mute(&mut self, cause: MuteCause, patience: Duration, now: Now) -> RoleChange {
        self.role = RedundancyRole::Standby;
        self.is_cut = false;
        self.followed = None;
        self.deadline = now.monotonic + patience;
        self.cause = TakeoverCause::Resumed;
        RoleChange::Muted { cause }
    }

    /// Records a peer. Returns its heartbeat before. If there are too many peers, the peer that was
    /// met last is removed, so that invented peers do not displace a bridge that is known.
    fn meet(&mut self, heartbeat: Heartbeat, from: SocketAddr, now: Instant) -> Option<Heartbeat> {
        let known = |peer: &&mut RedundantPeer| peer.heartbeat.instance == heartbeat.instance;
        if let Some(known) = self.peers.iter_mut().find(known) {
            return Some(known.note(heartbeat, from, now));
        }
        self.peers.retain(|peer| peer.age(now) < FORGOTTEN);
        self.peers.truncate(MOST_PEERS - 1);
        self.peers.push(RedundantPeer::new(heartbeat, from, now));
        None
    }
}

/// The period of the heartbeats.
const PERIOD: Duration = Duration::from_millis(20);
/// The time after its last heartbeat for which an active bridge may send.
const LEASE: Duration = Duration::from_millis(70);
/// The time after the last heartbeat of the active bridge at which a standby takes over: 5 missed
/// heartbeats, and longer than the lease.
const PATIENCE: Duration = Duration::from_millis(100);
/// The time by which a standby takes over later than a standby of a lower rank: longer than two
/// heartbeats, of which the last may be lost.
const LATER: Duration = Duration::from_millis(45);
/// The further time for which a bridge that was stopped listens for another bridge.
const STALLED: Duration = Duration::from_millis(60);
/// The time between a release and the takeover.
const QUIET: Duration = Duration::from_millis(30);
/// The longest time between two steps of a bridge that runs.
const TOLERATED: Duration = Duration::from_millis(30);
/// The time by which a takeover is deferred while messages wait, and the longest such time.
const DEFERRED: Duration = Duration::from_millis(2);
const LONGEST_DEFERRAL: Duration = Duration::from_secs(1);
/// The number of heartbeats for which the ROS side is silent before a bridge hands over.
const UNFIT: u32 = 25;
/// The number of heartbeats without a link before a bridge hands over: time for a standby at the
/// same switch to report that it has no link either.
const UNLINKED: u32 = 4;
/// The longest stall after which a bridge without peers resumes at once. A bridge listens longer
/// at its start.
const ALONE: Duration = Duration::from_millis(200);
/// The age of a heartbeat up to which a peer counts as present.
const PRESENT: Duration = Duration::from_millis(120);
/// The time after which a peer is forgotten.
const FORGOTTEN: Duration = Duration::from_secs(10);
/// The maximum number of known peers. It is limited, because any sender in an unsecured group can
/// send heartbeats.
const MOST_PEERS: usize = 8;

#[cfg(test)]
mod tests;
