//! The first sample to a new reader, which goes alone.

use std::collections::BTreeSet;
use std::time::Duration;

use rustdds::GUID;
use tokio::time::Instant;

use crate::raw::Writer;

/// Holds a writer up until new readers have had one sample.
///
/// A reader of Cyclone DDS takes what the first heartbeat it hears of a volatile writer announces for older than
/// itself. RustDDS sends that heartbeat ahead of samples that wait to be sent, so of a burst some would be lost in its
/// middle. With a single sample the heartbeat comes behind it.
///
/// RustDDS as published needs this. With the patches, of which `late-readers` is for the same reader, 20 of 20 bursts of 100
/// requests were answered without it; it costs them one acknowledgement per new reader, which may be asked for 20 ms later.
#[derive(Debug)]
pub(crate) struct Opening {
    known: BTreeSet<GUID>,
    /// When a sample was written that some reader is yet to acknowledge as its first.
    since: Option<Instant>,
}

impl Opening {
    pub(crate) const fn new() -> Self {
        Self {
            known: BTreeSet::new(),
            since: None,
        }
    }

    /// Whether a sample may be written now.
    pub(crate) fn is_over(&mut self, writer: &Writer, now: Instant) -> bool {
        if let Some(since) = self.since
            && now.saturating_duration_since(since) < PATIENCE
            // The answer is immediate with a wait of zero.
            && !matches!(writer.wait_for_acknowledgments(Duration::ZERO), Ok(true))
        {
            return false;
        }
        self.since = None;
        true
    }

    /// To be called when a sample was written that all of `readers` get.
    pub(crate) fn written(&mut self, readers: impl Iterator<Item = GUID>, now: Instant) {
        let readers: BTreeSet<GUID> = readers.collect();
        if !readers.is_subset(&self.known) {
            self.since = Some(now);
        }
        self.known = readers;
    }
}

/// How long a reader may take; one that was killed never acknowledges.
const PATIENCE: Duration = Duration::from_millis(250);
