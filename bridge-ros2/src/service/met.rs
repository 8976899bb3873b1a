//! The servers a client has found, and whether they know it by now.

use std::time::Duration;

use rustdds::GUID;
use tokio::time::Instant;

use super::SETTLE;
use crate::raw::{Reader, Writer};

/// A server as its client sees it.
#[derive(Debug)]
pub(super) struct Met {
    /// Since when both halves are known.
    since: Instant,
    /// The writers its replies may come from: those of its participant.
    repliers: Vec<GUID>,
}

/// What tells whether a server that is asked now gets the request and its reply gets back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Acquaintance {
    /// Its HEARTBEATs name our reader, and all servers have acknowledged our writer.
    Told,
    /// It has sent HEARTBEATs, which may have been for others, or nothing tells.
    Likely,
    /// It has sent no HEARTBEAT, for which our reader asks as soon as it knows the writer.
    #[cfg_attr(
        not(any(feature = "patched-dds", test)),
        expect(dead_code, reason = "nothing tells")
    )]
    Silent,
}

impl Met {
    pub(super) fn new(since: Instant) -> Self {
        Self {
            since,
            repliers: Vec::new(),
        }
    }

    pub(super) fn answer_from(&mut self, repliers: Vec<GUID>) {
        self.repliers = repliers;
    }

    /// What our reader of its replies knows of it.
    #[cfg(feature = "patched-dds")]
    pub(super) fn acquaintance(&self, reader: &Reader, all_in_step: bool) -> Acquaintance {
        use rustdds::WriterContact;

        let each = self
            .repliers
            .iter()
            .map(|writer| match reader.writer_contact(*writer) {
                Some(WriterContact::Addressed) if all_in_step => Acquaintance::Told,
                Some(WriterContact::Addressed | WriterContact::Heard) => Acquaintance::Likely,
                Some(WriterContact::Silent) | None => Acquaintance::Silent,
            });
        each.max().unwrap_or(Acquaintance::Silent)
    }

    /// Nothing, with RustDDS as published.
    #[cfg(not(feature = "patched-dds"))]
    #[expect(clippy::unused_self, reason = "the patched RustDDS tells of each")]
    pub(super) fn acquaintance(&self, _reader: &Reader, _all_in_step: bool) -> Acquaintance {
        Acquaintance::Likely
    }

    /// Whether to ask it now.
    pub(super) fn is_ready(&self, acquaintance: Acquaintance, now: Instant) -> bool {
        now.saturating_duration_since(self.since) >= acquaintance.patience()
    }
}

impl Acquaintance {
    /// How long to wait after a server was found.
    fn patience(self) -> Duration {
        match self {
            Self::Told => Duration::ZERO,
            Self::Likely => SETTLE,
            Self::Silent => PATIENCE,
        }
    }
}

/// Whether as many readers as there are servers have acknowledged what the writer told them.
#[cfg(feature = "patched-dds")]
pub(super) fn all_in_step(writer: &Writer, servers: usize) -> bool {
    writer.matched_readers().in_step >= servers
}

/// Nothing tells, with RustDDS as published.
#[cfg(not(feature = "patched-dds"))]
pub(super) fn all_in_step(_writer: &Writer, _servers: usize) -> bool {
    false
}

/// How long to wait for a server that says nothing. What tells it of us may have been lost, and said again; or it is one
/// that never says anything.
const PATIENCE: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_tells_is_asked_at_once_and_who_is_silent_in_the_end() {
        let found = Instant::now();
        let met = Met::new(found);
        let ready_from = |acquaintance| {
            (0..2000)
                .map(Duration::from_millis)
                .find(|after| met.is_ready(acquaintance, found + *after))
        };
        assert_eq!(ready_from(Acquaintance::Told), Some(Duration::ZERO));
        assert_eq!(ready_from(Acquaintance::Likely), Some(SETTLE));
        assert_eq!(ready_from(Acquaintance::Silent), Some(PATIENCE));
    }
}
