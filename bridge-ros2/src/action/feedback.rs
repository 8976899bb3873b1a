//! The writer of an action's feedback, which never waits and goes to whoever listens.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use rustdds::GUID;
use rustdds::dds::WriteError;
use tokio::time::Instant;

use crate::graph::Endpoint;
use crate::raw::{Payload, Writer};
use crate::service::{Audience, Opening};

/// Feedback waits here while the send window is full, a client of a goal is yet to be matched, or a new reader could
/// miss it ([`Opening`]).
pub(super) struct FeedbackWriter {
    writer: Writer,
    audience: Audience,
    /// Clients whose participant is yet to have a reader that is matched, and until when that is waited for.
    expected: BTreeMap<GUID, Instant>,
    opening: Opening,
    /// Oldest first.
    waiting: VecDeque<Payload>,
    /// Bytes of what waits.
    bytes: usize,
}

impl FeedbackWriter {
    pub(super) fn new(writer: Writer) -> Self {
        Self {
            writer,
            audience: Audience::default(),
            expected: BTreeMap::new(),
            opening: Opening::new(),
            waiting: VecDeque::new(),
            bytes: 0,
        }
    }

    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Takes note of the readers there are by now.
    pub(super) fn meet(&mut self, readers: &[Endpoint], now: Instant) {
        self.audience
            .meet(readers.iter().map(|reader| reader.guid), now);
    }

    /// A client whose goal is accepted hears its feedback from the first on, if its participant has a reader for it.
    pub(super) fn expect(&mut self, client: GUID, now: Instant) {
        self.expected.retain(|_, until| now < *until);
        self.expected.entry(client).or_insert(now + PATIENCE);
    }

    /// Writes a sample, or queues it. Returns how many older ones were dropped to make room.
    pub(super) fn offer(&mut self, sample: Payload, now: Instant) -> u64 {
        self.bytes += sample.len();
        self.waiting.push_back(sample);
        let lost = self.flush(now);
        let mut dropped = 0;
        while self.waiting.len() > 1 && (self.waiting.len() > ROOM || self.bytes > ROOM_BYTES) {
            self.pop();
            dropped += 1;
        }
        lost + dropped
    }

    /// Sends what waits, as far as there is room. Returns how many were lost because RustDDS failed.
    pub(super) fn flush(&mut self, now: Instant) -> u64 {
        let mut lost = 0;
        while !self.waiting.is_empty() && self.is_heard(now) {
            let Some(sample) = self.pop() else { break };
            match self.writer.write(sample, None) {
                Ok(()) => self.opening.written(self.audience.readers(), now),
                Err(WriteError::WouldBlock { data }) => {
                    self.bytes += data.len();
                    self.waiting.push_front(data);
                    break;
                }
                Err(
                    WriteError::Serialization { .. }
                    | WriteError::Poisoned { .. }
                    | WriteError::Io(_)
                    | WriteError::Internal { .. },
                ) => lost += 1,
            }
        }
        lost
    }

    /// Whether those who are to hear what is written now do.
    fn is_heard(&mut self, now: Instant) -> bool {
        self.audience.listen(&self.writer, now);
        let audience = &self.audience;
        self.expected
            .retain(|client, until| now < *until && !audience.hears_one_of(*client, now));
        self.expected.is_empty() && self.opening.is_over(&self.writer, now)
    }

    fn pop(&mut self) -> Option<Payload> {
        let sample = self.waiting.pop_front()?;
        self.bytes -= sample.len();
        Some(sample)
    }
}

impl std::fmt::Debug for FeedbackWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FeedbackWriter")
            .field("waiting", &self.waiting.len())
            .finish_non_exhaustive()
    }
}

/// How long a client of a goal may be without a reader of feedback; nobody has to have one.
const PATIENCE: Duration = Duration::from_millis(250);
/// What may wait, beside the send window of RustDDS.
const ROOM: usize = 512;
const ROOM_BYTES: usize = 16 * 1024 * 1024;
