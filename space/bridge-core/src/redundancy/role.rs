//! The rank and the role of a redundant bridge, and the changes of the role.

use std::net::SocketAddr;
use std::time::Duration;

/// The rank of a bridge among the redundant bridges of its space; 1 takes over first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RedundancyRank(u8);

impl RedundancyRank {
    /// The highest rank. It bounds the time of a takeover.
    pub const MOST: u8 = 3;

    /// Returns `None` unless the number is 1 to [`MOST`](Self::MOST).
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if number == 0 || number > Self::MOST {
            return None;
        }
        Some(Self(number))
    }

    /// Returns the number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }

    /// Returns the time for which a bridge listens at its start.
    pub(super) fn listening(self) -> Duration {
        LISTENED + STARTED_LATER * (u32::from(self.0) - 1)
    }
}

/// The role of a redundant bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RedundancyRole {
    /// It listens for an active bridge after its start.
    Starting,
    /// It follows the active bridge and sends no values.
    Standby,
    /// It sends values.
    Active,
}

impl RedundancyRole {
    /// Returns the role in lower case.
    #[must_use]
    pub const fn label(self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Standby => "standby",
            Self::Active => "active",
        }
    }

    pub(super) const fn number(self) -> u8 {
        match self {
            Self::Starting => 0,
            Self::Standby => 1,
            Self::Active => 2,
        }
    }

    pub(super) const fn of(number: u8) -> Option<Self> {
        match number {
            0 => Some(Self::Starting),
            1 => Some(Self::Standby),
            2 => Some(Self::Active),
            _ => None,
        }
    }
}

/// The state of the ROS side of a redundant bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LocalSide {
    /// It is within reach.
    Reached,
    /// It does not respond, such as a ROS 1 master.
    Silent,
    /// The network interface has no link.
    NoLink,
}

impl LocalSide {
    pub(super) const fn is_reached(self) -> bool {
        matches!(self, Self::Reached)
    }
}

/// The cause of a takeover.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TakeoverCause {
    /// No other bridge was active at the start.
    Start,
    /// The heartbeats of the active bridge were missed.
    Lost,
    /// The active bridge has handed over, as for an upgrade.
    Released,
    /// This bridge was active before, and no other bridge has taken over.
    Resumed,
}

impl TakeoverCause {
    /// Returns the cause as text for the user.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Start => "no other bridge was active at the start",
            Self::Lost => "the active bridge was lost",
            Self::Released => "the active bridge handed over",
            Self::Resumed => "no other bridge took over",
        }
    }
}

/// The cause for which an active bridge stops sending values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MuteCause {
    /// The process did not run for longer than the lease, or its clock jumped.
    Stalled,
    /// Another bridge is active with a higher epoch.
    Outranked,
    /// The operator or the end of the program hands over.
    Released,
    /// The ROS side is out of reach, and a standby reaches it.
    Unfit,
    /// The group was out of reach and is back: another bridge may be active.
    Reconnected,
    /// There are no keys for the heartbeat.
    NoKeys,
}

impl MuteCause {
    /// Returns the cause as text for the user.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::Stalled => "the process did not run for longer than its lease",
            Self::Outranked => "another bridge is active with a higher epoch",
            Self::Released => "it hands over",
            Self::Unfit => "its ROS side is out of reach, and the standby reaches it",
            Self::Reconnected => "the group was out of reach",
            Self::NoKeys => "there are no keys for the heartbeat",
        }
    }
}

/// A change of the redundancy of a bridge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoleChange {
    /// This bridge is active.
    TookOver {
        /// The cause.
        cause: TakeoverCause,
        /// The new epoch.
        epoch: u32,
        /// The time since the last heartbeat of the active bridge; `None` at the start.
        gap: Option<Duration>,
    },
    /// This bridge is a standby and follows an active bridge.
    Follows {
        /// The rank of the active bridge.
        rank: RedundancyRank,
        /// The address of the active bridge.
        from: SocketAddr,
    },
    /// This bridge was active and sends no values any more.
    Muted {
        /// The cause.
        cause: MuteCause,
    },
    /// Another bridge was active at the same time.
    Rival {
        /// The rank of the other bridge.
        rank: RedundancyRank,
        /// The address of the other bridge.
        from: SocketAddr,
    },
    /// Another bridge has the same rank.
    SameRank {
        /// The address of the other bridge.
        from: SocketAddr,
    },
    /// The group is out of reach while this bridge is active.
    CutOff,
}

/// A request to switch over that cannot be fulfilled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SwitchRefusal {
    /// This bridge is not active.
    #[error("this bridge is not the active one; send the request to the active bridge")]
    NotActive,
    /// No standby is ready.
    #[error("no standby was received for the time of a takeover; start one with another --rank")]
    NoStandby,
}

/// The time for which a bridge listens at its start, and by which each further rank listens longer.
const LISTENED: Duration = Duration::from_millis(300);
const STARTED_LATER: Duration = Duration::from_millis(100);
