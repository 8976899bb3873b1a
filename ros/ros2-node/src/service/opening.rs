//! Delays the first samples to a new reader.

use std::time::Duration;

#[cfg(not(feature = "patched-dds"))]
pub(crate) use self::published::Opening;

/// The maximum delay for a reader; a killed reader never acknowledges.
const PATIENCE: Duration = Duration::from_millis(250);

#[cfg(feature = "patched-dds")]
mod patched {
    use rustdds::GUID;
    use tokio::time::Instant;

    use super::PATIENCE;
    use crate::raw::PayloadWriter;

    /// Holds a writer until its readers have received a HEARTBEAT of it.
    ///
    /// A reader of Cyclone DDS regards the samples that the first HEARTBEAT of a volatile writer
    /// announces as older than itself, so it would miss samples written before that HEARTBEAT.
    #[derive(Debug)]
    pub(crate) struct Opening {
        /// Readers that may not have received a HEARTBEAT at the last check.
        new: usize,
        /// The start of the current wait.
        since: Option<Instant>,
    }

    impl Opening {
        pub(crate) const fn new() -> Self {
            Self {
                new: 0,
                since: None,
            }
        }

        /// Returns whether a sample may be written at `now`.
        pub(crate) fn is_over(&mut self, writer: &PayloadWriter, now: Instant) -> bool {
            let readers = writer.matched_readers();
            self.passes(readers.silent + readers.greeting, now)
        }

        fn passes(&mut self, new: usize, now: Instant) -> bool {
            let more = new > std::mem::replace(&mut self.new, new);
            if new == 0 {
                self.since = None;
                return true;
            }
            match self.since {
                // Further new readers do not prolong the wait: some may never respond.
                Some(since) if now.saturating_duration_since(since) < PATIENCE => false,
                Some(_) => {
                    self.since = None;
                    true
                }
                None if more => {
                    self.since = Some(now);
                    false
                }
                None => true,
            }
        }

        /// Does nothing: RustDDS reports the state of the readers.
        #[expect(
            clippy::unused_self,
            reason = "RustDDS as published has to be told, and is called in the same places"
        )]
        pub(crate) fn written(&self, _readers: impl Iterator<Item = GUID>, _now: Instant) {}
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn a_new_reader_is_waited_for_and_one_that_says_nothing_only_once() {
            let start = Instant::now();
            let late = start + PATIENCE;
            let mut opening = Opening::new();
            assert!(opening.passes(0, start), "nobody is there");
            assert!(!opening.passes(1, start));
            assert!(opening.passes(0, start), "it has heard one");
            assert!(!opening.passes(1, start));
            assert!(opening.passes(1, late));
            assert!(!opening.passes(2, late), "another one is new");
            assert!(!opening.passes(1, late), "either may be that");
            assert!(opening.passes(1, late + PATIENCE));
        }

        #[test]
        fn readers_that_keep_coming_and_say_nothing_stop_nobody_for_ever() {
            let start = Instant::now();
            let mut opening = Opening::new();
            let tick = PATIENCE / 10;
            let passed = (1..=100).filter(|count| {
                opening.passes(*count, start + tick * u32::try_from(*count).unwrap())
            });
            assert!(passed.count() > 0);
        }
    }
}

#[cfg(feature = "patched-dds")]
pub(crate) use self::patched::Opening;

#[cfg(not(feature = "patched-dds"))]
mod published {
    use std::collections::BTreeSet;
    use std::time::Duration;

    use rustdds::GUID;
    use tokio::time::Instant;

    use super::PATIENCE;
    use crate::raw::PayloadWriter;

    /// Holds a writer until new readers have received one sample.
    ///
    /// A reader of Cyclone DDS regards the samples that the first HEARTBEAT of a volatile writer
    /// announces as older than itself. RustDDS sends this HEARTBEAT ahead of samples that wait to
    /// be sent, so samples in the middle of a burst would be lost. With a single sample, the
    /// HEARTBEAT follows the sample.
    #[derive(Debug)]
    pub(crate) struct Opening {
        known: BTreeSet<GUID>,
        /// The time of a written sample that some reader has to acknowledge as its first.
        since: Option<Instant>,
    }

    impl Opening {
        pub(crate) const fn new() -> Self {
            Self {
                known: BTreeSet::new(),
                since: None,
            }
        }

        /// Returns whether a sample may be written at `now`.
        pub(crate) fn is_over(&mut self, writer: &PayloadWriter, now: Instant) -> bool {
            if let Some(since) = self.since
                && now.saturating_duration_since(since) < PATIENCE
                // A wait of zero returns immediately.
                && !matches!(writer.wait_for_acknowledgments(Duration::ZERO), Ok(true))
            {
                return false;
            }
            self.since = None;
            true
        }

        /// Records that a sample was written to all of `readers`.
        pub(crate) fn written(&mut self, readers: impl Iterator<Item = GUID>, now: Instant) {
            let readers: BTreeSet<GUID> = readers.collect();
            if !readers.is_subset(&self.known) {
                self.since = Some(now);
            }
            self.known = readers;
        }
    }
}
