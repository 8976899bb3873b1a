//! Tracks the readers that a writer can reach.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use rustdds::{DataWriterStatus, GUID, StatusEvented};
use tokio::time::Instant;

use crate::raw::PayloadWriter;

/// The readers of a writer, from two sources. RustDDS reports each match in a queue that drops
/// reports when it is full. Discovery knows all readers, shortly before the writer does.
#[derive(Debug, Default)]
pub(crate) struct Audience {
    known: BTreeMap<GUID, KnownClient>,
}

#[derive(Debug)]
struct KnownClient {
    since: Instant,
    matched: bool,
}

impl Audience {
    /// Records the matches that the writer reported after the last call.
    pub(crate) fn listen(&mut self, writer: &PayloadWriter, now: Instant) {
        while let Some(status) = writer.try_recv_status() {
            if let DataWriterStatus::PublicationMatched {
                current, reader, ..
            } = status
            {
                if current.count_change() > 0 {
                    self.matched(reader, now);
                } else {
                    self.lost(reader);
                }
            }
        }
    }

    fn matched(&mut self, reader: GUID, now: Instant) {
        let fresh = KnownClient {
            since: now,
            matched: true,
        };
        self.known.entry(reader).or_insert(fresh).matched = true;
    }

    fn lost(&mut self, reader: GUID) {
        self.known.remove(&reader);
    }

    /// Records the readers that discovery knows, or knew shortly before.
    pub(crate) fn meet(&mut self, readers: impl Iterator<Item = GUID>, now: Instant) {
        let readers: BTreeSet<GUID> = readers.collect();
        self.known.retain(|guid, known| {
            readers.contains(guid) || now.saturating_duration_since(known.since) < FRESH
        });
        for reader in readers {
            let found = KnownClient {
                since: now,
                matched: false,
            };
            self.known.entry(reader).or_insert(found);
        }
    }

    /// Returns whether a sample written at `now` reaches the reader.
    pub(crate) fn hears(&self, reader: GUID, now: Instant) -> bool {
        self.known.get(&reader).is_some_and(|known| {
            known.matched || now.saturating_duration_since(known.since) >= MATCHED
        })
    }

    /// Returns whether a sample written at `now` reaches a reader of the participant of `client`.
    pub(crate) fn hears_one_of(&self, client: GUID, now: Instant) -> bool {
        self.readers()
            .any(|reader| reader.prefix == client.prefix && self.hears(reader, now))
    }

    /// Returns all known readers.
    pub(crate) fn readers(&self) -> impl Iterator<Item = GUID> {
        self.known.keys().copied()
    }
}

/// The maximum delay of RustDDS between the discovery of a reader and the first sample to it.
const MATCHED: Duration = Duration::from_millis(20);
/// The maximum age of a snapshot: a reader matched after the snapshot is missing from it.
const FRESH: Duration = Duration::from_secs(1);

#[cfg(test)]
mod tests {
    use super::*;

    fn reader(number: u8) -> GUID {
        GUID::from_bytes([number; 16])
    }

    #[test]
    fn a_reader_hears_once_it_is_matched_or_was_found_some_time_ago() {
        let start = Instant::now();
        let mut audience = Audience::default();
        audience.meet([reader(1), reader(2)].into_iter(), start);
        audience.matched(reader(1), start);
        audience.matched(reader(3), start);
        let hear = |audience: &Audience, now| [1, 2, 3, 4].map(|n| audience.hears(reader(n), now));
        assert_eq!(hear(&audience, start), [true, false, true, false]);
        assert_eq!(hear(&audience, start + MATCHED), [true, true, true, false]);
    }

    #[test]
    fn a_reader_that_has_left_is_forgotten() {
        let start = Instant::now();
        let mut audience = Audience::default();
        for number in 1..=3 {
            audience.matched(reader(number), start);
        }
        audience.lost(reader(1));
        // The snapshot may be older than the match.
        audience.meet([reader(2)].into_iter(), start + FRESH / 2);
        assert_eq!(audience.readers().collect::<Vec<_>>(), [2, 3].map(reader));
        audience.meet([reader(2)].into_iter(), start + FRESH);
        assert_eq!(audience.readers().collect::<Vec<_>>(), [reader(2)]);
        assert!(!audience.hears(reader(3), start + FRESH));
    }
}
