//! A writer that never waits.
//!
//! RustDDS stops a reliable writer while its send window is full ([`Offered::policies`]): samples it does not take
//! then wait here, in a queue as long as the topic's overflow policy says, and go out when the window opens.

use std::collections::VecDeque;

use rustdds::dds::WriteError;
use rustdds::{DataWriterStatus, GUID, RTPSEntity, StatusEvented, Timestamp};

use crate::graph::Endpoint;
use crate::qos::Offered;
use crate::raw::{Payload, Writer};

/// The writing end of one topic.
pub struct Outlet {
    writer: Writer,
    offered: Offered,
    audience: Audience,
    /// Samples for which the send window had no room, oldest first.
    waiting: VecDeque<Sample>,
}

#[derive(Debug)]
struct Sample {
    payload: Payload,
    source: Option<Timestamp>,
}

/// Who listens.
#[derive(Debug)]
enum Audience {
    /// Nobody. A state topic holds its last value back: written to a writer without readers it would stay in RustDDS'
    /// history, whose pruning spares what nobody acknowledged, and a late joiner would be given a trail of old values.
    Nobody { held: Option<Sample> },
    /// Somebody, with the size from which a sample may fail to reach them.
    Present { reliable_size: usize },
}

/// Why a sample was not, or perhaps not, delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refusal {
    /// The send window is full, and the waiting room too: the oldest waiting sample made room for this one.
    Overflow,
    /// Handed to RustDDS, but larger than this: when a receiver's socket buffer overflows, RustDDS repairs too slowly
    /// for the sample ever to be complete.
    TooLarge(usize),
    /// RustDDS failed; it does so only when one of its threads has died.
    Failed,
}

impl Refusal {
    /// The label under which it is counted.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Overflow => "subscriber too slow",
            Self::TooLarge(_) => "too large for DDS",
            Self::Failed => "DDS writer failed",
        }
    }
}

impl Outlet {
    /// Wraps a writer created with the policies of `offered`.
    #[must_use]
    pub fn new(writer: Writer, offered: Offered) -> Self {
        Self {
            writer,
            offered,
            audience: Audience::Nobody { held: None },
            waiting: VecDeque::new(),
        }
    }

    /// The writer's GUID.
    #[must_use]
    pub fn guid(&self) -> GUID {
        self.writer.guid()
    }

    /// Whether samples wait for room; [`flush`](Self::flush) sends them when there is some.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Writes a sample, or queues it. Never waits.
    ///
    /// # Errors
    /// [`Refusal`]: one sample was lost, this or an older one, or this one may be.
    pub fn offer(&mut self, payload: Payload, source: Option<Timestamp>) -> Result<(), Refusal> {
        let sample = Sample { payload, source };
        if matches!(self.audience, Audience::Nobody { .. }) {
            self.notice_matches();
        }
        let reliable_size = match &mut self.audience {
            Audience::Nobody { held } if self.offered == Offered::KeepLatest => {
                *held = Some(sample);
                return Ok(());
            }
            Audience::Nobody { .. } => usize::MAX,
            Audience::Present { reliable_size } => *reliable_size,
        };
        let size = sample.payload.len();
        if !self.waiting.is_empty() {
            return self.queue(sample);
        }
        match self.write(sample)? {
            Some(unsent) => self.queue(unsent),
            None if size > reliable_size => Err(Refusal::TooLarge(reliable_size)),
            None => Ok(()),
        }
    }

    /// Sends what waits, as far as there is room.
    ///
    /// # Errors
    /// [`Refusal::Failed`], with the sample lost.
    pub fn flush(&mut self) -> Result<(), Refusal> {
        while let Some(sample) = self.waiting.pop_front() {
            if let Some(unsent) = self.write(sample)? {
                self.waiting.push_front(unsent);
                break;
            }
        }
        Ok(())
    }

    /// Takes note of the readers the domain has for this topic by now, and gives the first of them the value that was
    /// held back.
    ///
    /// # Errors
    /// [`Refusal`] of the value held back.
    pub fn set_readers(&mut self, readers: &[Endpoint]) -> Result<(), Refusal> {
        // Statuses are read so that their channel never fills up; the snapshot is the newer knowledge.
        while self.writer.try_recv_status().is_some() {}
        if readers.is_empty() {
            if !matches!(self.audience, Audience::Nobody { .. }) {
                self.audience = Audience::Nobody { held: None };
            }
            return Ok(());
        }
        self.greet(if readers.iter().any(Endpoint::is_fast_dds) {
            FAST_DDS_SIZE
        } else {
            RELIABLE_SIZE
        })
    }

    /// A reader may match between two snapshots; what comes after the match is for it.
    fn notice_matches(&mut self) {
        while let Some(status) = self.writer.try_recv_status() {
            if let DataWriterStatus::PublicationMatched { current, .. } = status
                && current.count() > 0
            {
                // The held value is older than the one about to be written, and that one replaces it.
                self.audience = Audience::Present {
                    reliable_size: FAST_DDS_SIZE,
                };
            }
        }
    }

    fn greet(&mut self, reliable_size: usize) -> Result<(), Refusal> {
        let before = std::mem::replace(&mut self.audience, Audience::Present { reliable_size });
        match before {
            Audience::Nobody { held: Some(sample) } => self.offer(sample.payload, sample.source),
            Audience::Nobody { held: None } | Audience::Present { .. } => Ok(()),
        }
    }

    fn queue(&mut self, sample: Sample) -> Result<(), Refusal> {
        let overflow = self.waiting.len() >= self.offered.waiting_room();
        if overflow {
            self.waiting.pop_front();
        }
        self.waiting.push_back(sample);
        if overflow {
            Err(Refusal::Overflow)
        } else {
            Ok(())
        }
    }

    /// Gives a sample to RustDDS; returns it when the send window is full.
    fn write(&self, sample: Sample) -> Result<Option<Sample>, Refusal> {
        let Sample { payload, source } = sample;
        match self.writer.write(payload, source) {
            Ok(()) => Ok(None),
            Err(WriteError::WouldBlock { data }) => Ok(Some(Sample {
                payload: data,
                source,
            })),
            Err(
                WriteError::Serialization { .. }
                | WriteError::Poisoned { .. }
                | WriteError::Io(_)
                | WriteError::Internal { .. },
            ) => Err(Refusal::Failed),
        }
    }
}

impl std::fmt::Debug for Outlet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Outlet")
            .field("writer", &self.guid())
            .field("offered", &self.offered)
            .field("audience", &self.audience)
            .field("waiting", &self.waiting.len())
            .finish_non_exhaustive()
    }
}

/// Measured: one sample in ten of 1 MiB reached a Fast DDS reader with the system's default socket buffers, and all of
/// 262 kB did.
const FAST_DDS_SIZE: usize = 256 * 1024;
/// Measured: Cyclone DDS readers received 2 MiB and lost 3 MiB.
const RELIABLE_SIZE: usize = 2 * 1024 * 1024;
