//! The role of a bridge among the redundant bridges of its space.

use std::fmt::Display;
use std::time::{Duration, Instant};

use bridge_core::{RedundancyRole, Router};
use serde::Serialize;

/// The role of the program among the redundant bridges of its space.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct RedundancyStatus {
    role: &'static str,
    rank: u8,
    epoch: u32,
    /// Whether the group is out of reach while this bridge is active.
    cut_off: bool,
    takeovers: u64,
    /// Times at which this bridge muted itself, because it did not run.
    stalls: u64,
    /// Times at which another bridge was active at once.
    rivals: u64,
    /// Samples of the own space that were not sent while this bridge was muted.
    muted_sent: u64,
    /// Samples of other spaces that were not published while this bridge was muted.
    muted_delivered: u64,
    /// The last takeover by this bridge.
    #[serde(skip_serializing_if = "Option::is_none")]
    last_takeover: Option<TakeoverStatus>,
    peers: Vec<RedundantPeerStatus>,
}

#[derive(Debug, Clone, Serialize)]
struct TakeoverStatus {
    reason: &'static str,
    seconds_ago: u64,
    /// Milliseconds since the last heartbeat of the former active bridge.
    #[serde(skip_serializing_if = "Option::is_none")]
    gap_ms: Option<u64>,
}

#[derive(Debug, Clone, Serialize)]
struct RedundantPeerStatus {
    rank: u8,
    role: &'static str,
    epoch: u32,
    address: String,
    /// Milliseconds since its last heartbeat.
    age_ms: u64,
    /// Whether its ROS side is within reach.
    ros_side: bool,
}

impl RedundancyStatus {
    /// Returns `None` for a program without redundancy.
    pub(crate) fn of(router: &Router, now: Instant) -> Option<Self> {
        let state = router.redundancy()?;
        let muted = router.muted_samples().unwrap_or_default();
        let counts = state.counts();
        let last = state.last_takeover().map(|last| TakeoverStatus {
            reason: last.cause.text(),
            seconds_ago: now.saturating_duration_since(last.at).as_secs(),
            gap_ms: last.gap.map(milliseconds),
        });
        let peers = state.peers(now).map(|peer| RedundantPeerStatus {
            rank: peer.rank().get(),
            role: peer.role().label(),
            epoch: peer.epoch(),
            address: peer.from().to_string(),
            age_ms: milliseconds(peer.age(now)),
            ros_side: peer.is_fit(),
        });
        Some(Self {
            role: state.role().label(),
            rank: state.rank().get(),
            epoch: state.epoch(),
            cut_off: state.is_cut(),
            takeovers: counts.takeovers,
            stalls: counts.stalls,
            rivals: counts.rivals,
            muted_sent: muted.sent,
            muted_delivered: muted.delivered,
            last_takeover: last,
            peers: peers.collect(),
        })
    }

    /// Passes the name, the labels and the value of each figure to `line`.
    pub(super) fn figures(&self, own: &str, line: &mut impl FnMut(&str, &str, &dyn Display)) {
        for role in [
            RedundancyRole::Starting,
            RedundancyRole::Standby,
            RedundancyRole::Active,
        ]
        .map(RedundancyRole::label)
        {
            let labels = format!("{own},role=\"{role}\"");
            line("redundancy_role", &labels, &u8::from(role == self.role));
        }
        line("redundancy_epoch", own, &self.epoch);
        line("redundancy_peers", own, &self.peers.len());
        line("redundancy_takeovers_total", own, &self.takeovers);
        line("redundancy_stalls_total", own, &self.stalls);
        line("redundancy_rivals_total", own, &self.rivals);
        line("redundancy_muted_sent_total", own, &self.muted_sent);
        line(
            "redundancy_muted_delivered_total",
            own,
            &self.muted_delivered,
        );
    }
}

fn milliseconds(time: Duration) -> u64 {
    u64::try_from(time.as_millis()).unwrap_or(u64::MAX)
}
