//! The wait until readers have discovered a writer.

use std::time::Duration;

use tokio::time::Instant;

use crate::raw::PayloadWriter;

/// The wait for readers to discover the writer.
#[derive(Debug, Clone, Copy)]
pub(super) struct Settling {
    pub(super) since: Instant,
    /// How long to wait for a silent reader.
    pub(super) patience: Duration,
}

impl Settling {
    /// Returns whether the readers receive written samples, according to their acknowledgements.
    #[cfg(feature = "patched-dds")]
    pub(super) fn is_over(
        &self,
        writer: &PayloadWriter,
        seen: usize,
        joined: Instant,
        now: Instant,
    ) -> bool {
        let readers = writer.matched_readers();
        let age = now.saturating_duration_since(self.since);
        let told = readers.silent + readers.greeting == 0 && readers.in_step > 0;
        // Readers that were present before us are not all known when the first of them has
        // responded, and discovered readers may not have matched yet.
        let all = readers.in_step >= seen && now.saturating_duration_since(joined) >= SETTLE;
        let some = readers.in_step + readers.greeting + readers.best_effort > 0;
        told && readers.best_effort == 0 && all
            || some && readers.silent == 0 && age >= SETTLE
            || age >= self.patience
    }

    /// Returns whether the readers most likely receive written samples.
    #[cfg(not(feature = "patched-dds"))]
    pub(super) fn is_over(
        &self,
        _writer: &PayloadWriter,
        _seen: usize,
        _joined: Instant,
        now: Instant,
    ) -> bool {
        now.saturating_duration_since(self.since) >= SETTLE.min(self.patience)
    }
}

/// How long peers take to discover our writer after we discovered their reader: 30 to 190 ms
/// measured.
pub(super) const SETTLE: Duration = Duration::from_millis(250);
/// How long to wait for a first reader that is silent: the announcement of our writer may have been
/// lost and repeated.
pub(super) const PATIENCE: Duration = Duration::from_secs(3);
