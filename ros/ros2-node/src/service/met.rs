//! The servers that a client has discovered, and whether they have discovered the client.

use std::time::Duration;

use rustdds::GUID;
use tokio::time::Instant;

use super::SETTLE;
use crate::raw::{PayloadReader, PayloadWriter};

/// A server from the view of its client.
#[derive(Debug)]
pub(super) struct Met {
    /// The time at which both endpoints of the server were known.
    since: Instant,
    /// The writers from which its replies may come: the reply writers of its participant.
    repliers: Vec<GUID>,
}

/// The evidence that a server would receive a request and its reply would reach the client.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Acquaintance {
    /// Its HEARTBEATs name our reader, and all servers have acknowledged our writer.
    Told,
    /// It has sent HEARTBEATs, which may have been for other readers, or RustDDS does not report
    /// this.
    Likely,
    /// It has sent no HEARTBEAT. The reader requests a HEARTBEAT as soon as it knows the writer.
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

    /// Returns the acquaintance that our reply reader observed.
    #[cfg(feature = "patched-dds")]
    pub(super) fn acquaintance(&self, reader: &PayloadReader, all_in_step: bool) -> Acquaintance {
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

    /// Returns `Likely`, because the published RustDDS does not report contacts.
    #[cfg(not(feature = "patched-dds"))]
    #[expect(clippy::unused_self, reason = "the patched RustDDS tells of each")]
    pub(super) fn acquaintance(&self, _reader: &PayloadReader, _all_in_step: bool) -> Acquaintance {
        Acquaintance::Likely
    }

    /// Returns whether the server is ready for a request.
    pub(super) fn is_ready(&self, acquaintance: Acquaintance, now: Instant) -> bool {
        now.saturating_duration_since(self.since) >= acquaintance.patience()
    }
}

impl Acquaintance {
    /// Returns the delay after the discovery of a server.
    fn patience(self) -> Duration {
        match self {
            Self::Told => Duration::ZERO,
            Self::Likely => SETTLE,
            Self::Silent => PATIENCE,
        }
    }
}

/// Returns whether as many readers as there are servers have acknowledged the writer's
/// announcements.
#[cfg(feature = "patched-dds")]
pub(super) fn all_in_step(writer: &PayloadWriter, servers: usize) -> bool {
    writer.matched_readers().in_step >= servers
}

/// Returns false, because the published RustDDS does not report acknowledgements.
#[cfg(not(feature = "patched-dds"))]
pub(super) fn all_in_step(_writer: &PayloadWriter, _servers: usize) -> bool {
    false
}

/// The maximum delay for a silent server. The announcement to it may have been lost and repeated,
/// or the server never sends a HEARTBEAT.
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
