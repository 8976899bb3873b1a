//! Peers that a program waits for: publishers, servers and other spaces that the mapping needs and
//! that are missing.
//!
//! Pure: the run loop collects the missing peers each second and passes the time. A peer is
//! reported once it has been missing for [`GRACE`], and withdrawn when it arrives.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::time::{Duration, Instant};

/// The peers that are missing at one moment, each with the reason. Holds at most `MOST_PEERS`;
/// further peers are counted.
#[derive(Debug, Default)]
pub struct AwaitedPeers {
    reasons: BTreeMap<String, String>,
    omitted: usize,
}

impl AwaitedPeers {
    /// Adds a missing peer, such as `topic /start`. `reason` is a short statement, such as `no
    /// publisher`; it is called only while there is room.
    pub fn add(&mut self, peer: impl Into<String>, reason: impl FnOnce() -> String) {
        if self.reasons.len() >= MOST_PEERS {
            self.omitted += 1;
            return;
        }
        self.reasons.entry(peer.into()).or_insert_with(reason);
    }

    /// Adds a missing peer with a name that may be misspelt: the reason names the nearest of the
    /// `known` names.
    pub fn add_named<'k>(
        &mut self,
        (kind, name): (&str, &str),
        reason: &str,
        known: impl IntoIterator<Item = &'k str>,
    ) {
        self.add(format!("{kind} {name}"), || match near(name, known) {
            Some(near) => format!("{reason}; did you mean {near}?"),
            None => reason.to_owned(),
        });
    }

    /// Returns the missing peers and their reasons.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &str)> {
        let reasons = self.reasons.iter();
        reasons.map(|(peer, reason)| (peer.as_str(), reason.as_str()))
    }
}

/// Returns the known name that `name` most likely stands for.
#[must_use]
pub fn near<'k>(name: &str, known: impl IntoIterator<Item = &'k str>) -> Option<&'k str> {
    let known = known.into_iter().take(MOST_KNOWN);
    mappings::nearest(name, known.filter(|known| *known != name))
}

/// The peers that a program waits for, and for how long.
#[derive(Debug)]
pub(crate) struct PeerWatch {
    started: Instant,
    peers: BTreeMap<String, MissingPeer>,
    omitted: usize,
}

#[derive(Debug)]
struct MissingPeer {
    reason: String,
    since: Instant,
    /// The reason that was logged last.
    reported: Option<String>,
}

/// Log lines about peers.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct PeerChanges {
    /// All peers that the program waits for, if a further peer is missing.
    pub(crate) missing: Option<String>,
    /// The reported peers that have arrived.
    pub(crate) arrived: Option<String>,
}

impl PeerWatch {
    pub(crate) const fn new(now: Instant) -> Self {
        Self {
            started: now,
            peers: BTreeMap::new(),
            omitted: 0,
        }
    }

    /// Compares the peers that are missing at `now` with the peers that were missing before.
    pub(crate) fn update(&mut self, missing: AwaitedPeers, now: Instant) -> PeerChanges {
        let AwaitedPeers { reasons, omitted } = missing;
        self.omitted = omitted;
        let mut arrived = Vec::new();
        self.peers.retain(|peer, missing| {
            let is_missing = reasons.contains_key(peer);
            if !is_missing && missing.reported.is_some() {
                arrived.push(peer.clone());
            }
            is_missing
        });
        for (peer, reason) in reasons {
            let known = self.peers.entry(peer).or_insert_with(|| MissingPeer {
                reason: String::new(),
                since: now,
                reported: None,
            });
            if known.reason != reason {
                known.reason = reason;
                known.since = now;
            }
        }
        let started = self.started;
        let mut is_new = false;
        for missing in self.peers.values_mut() {
            // Peers that are missing during the start are reported together.
            let is_start = missing.since.saturating_duration_since(started) < GRACE;
            let since = if is_start { started } else { missing.since };
            let is_due = now.saturating_duration_since(since) >= GRACE;
            if is_due && missing.reported.as_ref() != Some(&missing.reason) {
                missing.reported = Some(missing.reason.clone());
                is_new = true;
            }
        }
        PeerChanges {
            missing: is_new.then(|| joined(&self.reported(), self.omitted)),
            arrived: (!arrived.is_empty()).then(|| joined(&arrived, 0)),
        }
    }

    /// Returns the peers that were reported as missing, each with its reason: `topic /start (no
    /// publisher)`.
    pub(crate) fn reported(&self) -> Vec<String> {
        let reported = self.peers.iter().filter_map(|(peer, missing)| {
            let reason = missing.reported.as_ref()?;
            Some(format!("{peer} ({reason})"))
        });
        reported.collect()
    }
}

/// Joins the first [`MOST_LISTED`] texts and counts the others.
fn joined(texts: &[String], omitted: usize) -> String {
    let listed = texts.get(..MOST_LISTED).unwrap_or(texts);
    let mut line = listed.join("; ");
    let more = texts.len() - listed.len() + omitted;
    if more > 0 {
        // Writing to a String does not fail.
        let _written = write!(line, "; and {more} more");
    }
    line
}

/// How long a peer may be missing before it is reported.
pub(crate) const GRACE: Duration = Duration::from_secs(5);
/// The most missing peers that are tracked.
const MOST_PEERS: usize = 64;
/// The maximal number of missing peers in a log line.
const MOST_LISTED: usize = 8;
/// The most names that one misspelt name is compared with: peers in a graph can invent names.
const MOST_KNOWN: usize = 2048;

#[cfg(test)]
mod tests {
    use super::*;

    fn missing(peers: &[(&str, &str)]) -> AwaitedPeers {
        let mut missing = AwaitedPeers::default();
        for (peer, reason) in peers {
            missing.add(*peer, || (*reason).to_owned());
        }
        missing
    }

    /// Updates each second from `from` to `to`; returns the log lines with their seconds.
    fn look(
        watch: &mut PeerWatch,
        start: Instant,
        (from, to): (u64, u64),
        peers: &[(&str, &str)],
    ) -> Vec<(u64, PeerChanges)> {
        let seconds = (from..=to).map(|second| {
            let now = start + Duration::from_secs(second);
            (second, watch.update(missing(peers), now))
        });
        seconds
            .filter(|(_, changes)| *changes != PeerChanges::default())
            .collect()
    }

    fn lines(missing: Option<&str>, arrived: Option<&str>) -> PeerChanges {
        PeerChanges {
            missing: missing.map(str::to_owned),
            arrived: arrived.map(str::to_owned),
        }
    }

    #[test]
    fn a_missing_peer_is_reported_once_five_seconds_after_the_start_and_withdrawn() {
        let start = crate::now().monotonic;
        let mut watch = PeerWatch::new(start);
        let topic = [("topic /a", "no publisher")];
        // The graph is known a second after the start.
        assert_eq!(look(&mut watch, start, (0, 0), &[]), []);
        let reported = look(&mut watch, start, (1, 60), &topic);
        let line = lines(Some("topic /a (no publisher)"), None);
        assert_eq!(reported, [(5, line)]);
        assert_eq!(watch.reported(), ["topic /a (no publisher)"]);
        let arrived = look(&mut watch, start, (61, 70), &[]);
        assert_eq!(arrived, [(61, lines(None, Some("topic /a")))]);
        assert!(watch.reported().is_empty());
    }

    #[test]
    fn a_peer_that_is_lost_later_is_reported_with_all_others() {
        let start = crate::now().monotonic;
        let mut watch = PeerWatch::new(start);
        let both = [
            ("space 2", "nothing received"),
            ("topic /a", "no publisher"),
        ];
        assert_eq!(look(&mut watch, start, (0, 30), &both[..1]).len(), 1);
        let line = "space 2 (nothing received); topic /a (no publisher)";
        let reported = look(&mut watch, start, (31, 60), &both);
        assert_eq!(reported, [(36, lines(Some(line), None))]);
        // A peer that is missing for less than the grace period is not mentioned.
        assert_eq!(look(&mut watch, start, (61, 61), &both[..1]).len(), 1);
        assert_eq!(look(&mut watch, start, (62, 65), &both), []);
        assert_eq!(look(&mut watch, start, (66, 80), &both[..1]), []);
    }

    #[test]
    fn another_reason_is_reported_again() {
        let start = crate::now().monotonic;
        let mut watch = PeerWatch::new(start);
        look(&mut watch, start, (0, 20), &[("topic /a", "no publisher")]);
        let reported = look(&mut watch, start, (21, 40), &[("topic /a", "another type")]);
        let line = lines(Some("topic /a (another type)"), None);
        assert_eq!(reported, [(26, line)]);
    }

    #[test]
    fn many_missing_peers_are_one_line_of_bounded_length() {
        let names: Vec<String> = (0..1000).map(|n| format!("topic /{n:03}")).collect();
        let peers: Vec<(&str, &str)> = names.iter().map(|name| (name.as_str(), "none")).collect();
        let start = crate::now().monotonic;
        let mut watch = PeerWatch::new(start);
        let reported = look(&mut watch, start, (0, 100), &peers);
        let [(5, changes)] = reported.as_slice() else {
            panic!("{reported:?}")
        };
        let line = changes.missing.as_deref().unwrap();
        assert!(line.ends_with("topic /007 (none); and 992 more"), "{line}");
    }

    #[test]
    fn a_misspelt_name_is_reported_with_its_neighbour() {
        let mut missing = AwaitedPeers::default();
        let known = ["/robot/joint_states", "/start_button", "/start_buton"];
        missing.add_named(("topic", "/start_buton"), "no publisher", known);
        missing.add_named(("service", "/grip"), "no server", known);
        let all: Vec<_> = missing.iter().collect();
        assert_eq!(
            all,
            [
                ("service /grip", "no server"),
                (
                    "topic /start_buton",
                    "no publisher; did you mean /start_button?"
                ),
            ]
        );
    }
}
