//! The writer of an action's feedback, which never waits and goes to whoever listens.

use std::collections::VecDeque;

use rustdds::GUID;
use rustdds::dds::WriteError;
use tokio::time::Instant;

use crate::graph::Endpoint;
use crate::raw::{Payload, Writer};
use crate::service::Opening;

/// Feedback waits here while the send window is full, or a new reader is yet to have its first sample ([`Opening`]).
pub(super) struct FeedbackWriter {
    writer: Writer,
    readers: Vec<GUID>,
    opening: Opening,
    /// Oldest first.
    waiting: VecDeque<Payload>,
    /// Bytes of what waits.
    bytes: usize,
}

impl FeedbackWriter {
    pub(super) const fn new(writer: Writer) -> Self {
        Self {
            writer,
            readers: Vec::new(),
            opening: Opening::new(),
            waiting: VecDeque::new(),
            bytes: 0,
        }
    }

    pub(super) fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Takes note of the readers there are by now.
    pub(super) fn meet(&mut self, readers: &[Endpoint]) {
        self.readers = readers.iter().map(|reader| reader.guid).collect();
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
        while !self.waiting.is_empty() && self.opening.is_over(&self.writer, now) {
            let Some(sample) = self.pop() else { break };
            match self.writer.write(sample, None) {
                Ok(()) => self.opening.written(self.readers.iter().copied(), now),
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

/// What may wait, beside the send window of RustDDS.
const ROOM: usize = 512;
const ROOM_BYTES: usize = 16 * 1024 * 1024;
