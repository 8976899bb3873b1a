//! The writer of an action's feedback, which never waits and sends to all matched readers.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use rustdds::GUID;
use rustdds::dds::WriteError;
use tokio::time::Instant;

use crate::graph::RemoteEndpoint;
use crate::raw::{Payload, PayloadWriter};
use crate::service::{Audience, Opening};

/// Writes feedback. Feedback waits here while the send window is full, a client of a goal is not
/// matched yet, or a new reader could miss it ([`Opening`]).
pub(super) struct FeedbackWriter {
    writer: PayloadWriter,
    audience: Audience,
    expected: Expected,
    opening: Opening,
    /// The waiting feedback, oldest first.
    waiting: VecDeque<Payload>,
    /// The size of the waiting feedback in bytes.
    bytes: usize,
}

impl FeedbackWriter {
    pub(super) fn new(writer: PayloadWriter) -> Self {
        Self {
            writer,
            audience: Audience::default(),
            expected: Expected::default(),
            opening: Opening::new(),
            waiting: VecDeque::new(),
            bytes: 0,
        }
    }

    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Updates the known readers.
    pub(super) fn meet(&mut self, readers: &[RemoteEndpoint], now: Instant) {
        self.audience
            .meet(readers.iter().map(|reader| reader.guid), now);
    }

    /// Expects a reader of the client of an accepted goal, so that the client receives all feedback
    /// if its participant has such a reader.
    pub(super) fn expect(&mut self, client: GUID, now: Instant) {
        self.expected.add(client, now);
    }

    /// Writes a sample, or queues it. Returns the number of older samples that were dropped to make
    /// room.
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

    /// Sends the waiting samples as the send window allows. Returns the number of samples lost
    /// because RustDDS failed.
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

    /// Returns whether the expected readers receive samples written at `now`.
    fn is_heard(&mut self, now: Instant) -> bool {
        self.audience.listen(&self.writer, now);
        let hears = |client| self.audience.hears_one_of(client, now);
        self.expected.are_there(hears, now) && self.opening.is_over(&self.writer, now)
    }

    fn pop(&mut self) -> Option<Payload> {
        let sample = self.waiting.pop_front()?;
        self.bytes -= sample.len();
        Some(sample)
    }
}

/// Clients of participants without a reachable reader so far.
#[derive(Debug, Default)]
struct Expected {
    /// The clients with the end of their wait.
    clients: BTreeMap<GUID, Instant>,
    /// The time at which feedback began to wait for a client.
    held: Option<Instant>,
}

impl Expected {
    fn add(&mut self, client: GUID, now: Instant) {
        self.clients.retain(|_, until| now < *until);
        self.clients.entry(client).or_insert(now + PATIENCE);
    }

    /// Returns whether no client is waited for. Further clients do not prolong the wait: a client
    /// need not have a reader.
    fn are_there(&mut self, hears: impl Fn(GUID) -> bool, now: Instant) -> bool {
        self.clients
            .retain(|client, until| now < *until && !hears(*client));
        if self.clients.is_empty() {
            self.held = None;
            return true;
        }
        let held = *self.held.get_or_insert(now);
        if now.saturating_duration_since(held) < PATIENCE {
            return false;
        }
        *self = Self::default();
        true
    }
}

impl std::fmt::Debug for FeedbackWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FeedbackWriter")
            .field("waiting", &self.waiting.len())
            .finish_non_exhaustive()
    }
}

/// How long feedback waits for the reader of a goal's client; the reader is optional.
const PATIENCE: Duration = Duration::from_millis(250);
/// Capacity of the queue in front of the send window of RustDDS, in samples and bytes.
const ROOM: usize = 512;
const ROOM_BYTES: usize = 16 * 1024 * 1024;

#[cfg(test)]
mod tests {
    use super::*;

    const NOBODY: fn(GUID) -> bool = |_| false;

    fn client(number: u8) -> GUID {
        GUID::from_bytes([number; 16])
    }

    #[test]
    fn feedback_waits_for_the_reader_of_a_client_but_not_for_ever() {
        let start = Instant::now();
        let mut expected = Expected::default();
        assert!(expected.are_there(NOBODY, start));
        expected.add(client(1), start);
        expected.add(client(2), start);
        assert!(!expected.are_there(NOBODY, start));
        assert!(!expected.are_there(|one| one == client(1), start));
        assert!(expected.are_there(|one| one == client(2), start));
        expected.add(client(3), start);
        assert!(!expected.are_there(NOBODY, start));
        assert!(expected.are_there(NOBODY, start + PATIENCE));
    }

    #[test]
    fn clients_that_keep_coming_without_a_reader_hold_up_nobody_for_ever() {
        let start = Instant::now();
        let mut expected = Expected::default();
        let passed = (0..100_u8).filter(|number| {
            let now = start + PATIENCE / 10 * u32::from(*number);
            expected.add(client(*number), now);
            expected.are_there(NOBODY, now)
        });
        assert_eq!(passed.count(), 9);
    }
}
