//! Events that readers have not acknowledged while a link is lost.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

/// How long an event may wait for its readers while a link is lost. Readers within reach
/// acknowledge within 20 ms.
const UNRECEIVED: Duration = Duration::from_millis(300);

/// Counts the written samples, and follows them while a link is lost.
#[derive(Debug, Default)]
pub(super) struct UnreceivedSamples {
    written: u64,
    /// The times of the calls of [`look`](Self::look) while a link is lost, each with the number of
    /// samples written before. Only the first one may be older than [`UNRECEIVED`].
    looks: VecDeque<(Instant, u64)>,
    /// Whether a reader was silent at the last call.
    is_silent: bool,
    /// Whether the last written sample was dropped.
    is_dropped: bool,
}

/// Samples to be dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct DroppedSamples {
    pub(super) count: usize,
    /// The number of newer samples, which stay.
    pub(super) kept: usize,
}

impl UnreceivedSamples {
    /// Counts a written sample.
    pub(super) const fn wrote(&mut self) {
        self.written += 1;
        self.is_dropped = false;
    }

    /// Returns whether a link is lost.
    pub(super) fn is_followed(&self) -> bool {
        !self.looks.is_empty()
    }

    /// Returns whether the last written sample was dropped.
    pub(super) const fn is_dropped(&self) -> bool {
        self.is_dropped
    }

    /// Returns the samples that are to be dropped while a link is lost: of the unacknowledged
    /// samples those that were written before [`UNRECEIVED`], if a reader is silent for this time,
    /// or was at the last call. A slow reader within reach is not silent.
    pub(super) fn look(
        &mut self,
        (unacknowledged, silent): (usize, Duration),
        now: Instant,
    ) -> Option<DroppedSamples> {
        let was_silent = std::mem::replace(&mut self.is_silent, silent >= UNRECEIVED);
        let is_old = |at: Instant| now.duration_since(at) >= UNRECEIVED;
        self.looks.push_back((now, self.written));
        while self.looks.get(1).is_some_and(|(at, _)| is_old(*at)) {
            self.looks.pop_front();
        }
        let (_, before) = self.looks.front().filter(|(at, _)| is_old(*at))?;
        let kept = usize::try_from(self.written - before).unwrap_or(usize::MAX);
        let count = unacknowledged.saturating_sub(kept);
        if count == 0 || !(was_silent || self.is_silent) {
            return None;
        }
        self.is_dropped |= kept == 0;
        Some(DroppedSamples { count, kept })
    }

    /// Notes that the link is back.
    pub(super) fn end(&mut self) {
        self.looks.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_are_dropped_once_they_waited_for_a_lost_link_for_a_while() {
        let start = Instant::now();
        let at = |ms| start + Duration::from_millis(ms);
        let mut samples = UnreceivedSamples::default();
        samples.wrote();
        // A reader out of reach acknowledges nothing.
        let mut unacknowledged = 1;
        let mut dropped = Vec::new();
        for ms in (0..=600).step_by(100) {
            let silent = Duration::from_millis(ms);
            if let Some(found) = samples.look((unacknowledged, silent), at(ms)) {
                dropped.push((ms, found.count, found.kept));
                unacknowledged = found.kept;
            }
            samples.wrote();
            unacknowledged += 1;
        }
        let expected = [(300, 1, 3), (400, 1, 3), (500, 1, 3), (600, 1, 3)];
        assert_eq!(dropped, expected);
        assert!(samples.is_followed() && !samples.is_dropped());
        // The link is back, and the reader is heard again.
        assert!(samples.look((4, Duration::ZERO), at(700)).is_some());
        for ms in [800, 900, 1000] {
            samples.look((1, Duration::from_millis(ms - 700)), at(ms));
        }
        samples.end();
        // The last event was dropped, so it must not be confirmed.
        assert!(!samples.is_followed() && samples.is_dropped());
        samples.wrote();
        assert!(!samples.is_dropped());
    }

    #[test]
    fn events_of_a_slow_reader_are_not_dropped_while_another_link_is_lost() {
        let start = Instant::now();
        let mut samples = UnreceivedSamples::default();
        for turn in 0..100 {
            samples.wrote();
            let now = start + Duration::from_millis(25 * turn);
            let silent = Duration::from_millis(20);
            assert_eq!(samples.look((50, silent), now), None, "{turn}");
            assert!(samples.looks.len() < 15);
        }
    }
}
