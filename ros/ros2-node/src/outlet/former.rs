//! A replaced writer of a topic.

use std::time::Duration;

use tokio::time::Instant;

use crate::qos::Offered;
use crate::raw::PayloadWriter;

/// A former writer that only repairs the samples it has written.
pub struct Former {
    writer: PayloadWriter,
    until: Instant,
}

impl Former {
    /// Returns the writer if every value counts and a reader may miss some. Of a state only the
    /// last value counts, with which the next writer starts: an old value must not reach a reader
    /// in addition.
    pub(super) fn of(
        writer: PayloadWriter,
        offered: Offered,
        in_flight: usize,
        now: Instant,
    ) -> Option<Self> {
        (matches!(offered, Offered::DropOldest(_)) && in_flight > 0).then(|| Self {
            writer,
            until: now + REPAIRED_WITHIN,
        })
    }

    /// Returns whether the readers have received all its samples, or had time to request repairs.
    #[must_use]
    pub fn is_done(&self, now: Instant) -> bool {
        // A wait of zero returns immediately.
        let acknowledged = self.writer.wait_for_acknowledgments(Duration::ZERO);
        now >= self.until || !matches!(acknowledged, Ok(false))
    }
}

impl std::fmt::Debug for Former {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Former")
            .field("writer", &self.writer.guid())
            .finish_non_exhaustive()
    }
}

/// How long a replaced writer stays for readers that miss samples. This covers one or two repairs;
/// a killed reader acknowledges nothing.
const REPAIRED_WITHIN: Duration = Duration::from_secs(1);
