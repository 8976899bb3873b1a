//! The encoded messages of the samples of the own space.

use std::sync::Arc;
use std::time::Duration;

use uadp::{DateTime, DecodeError, NetworkMessage, Timestamp};

use crate::confirm::Mark;
use crate::pace::ChunkPace;

/// The message of a sample.
#[derive(Debug)]
pub(crate) enum SampleMessage {
    /// A single NetworkMessage.
    Datagram(EncodedSample),
    /// A message larger than a datagram. Its chunks are read from this shared buffer.
    Large(Arc<EncodedSample>),
}

/// A NetworkMessage with a single DataSetMessage, and the offsets of its variable numbers.
#[derive(Debug, Clone, Default)]
pub(crate) struct EncodedSample {
    pub(crate) bytes: Vec<u8>,
    /// The offset of the NetworkMessage Timestamp, which is followed by PicoSeconds.
    pub(crate) timestamp_at: usize,
    /// The offset of the DataSetMessage.
    pub(crate) payload_at: usize,
    /// The offset of the DataSetMessage's sequence number.
    pub(crate) sequence_at: usize,
}

impl SampleMessage {
    /// Returns a copy to keep. A large message shares its buffer.
    pub(crate) fn share(&self) -> Self {
        match self {
            Self::Datagram(encoded) => Self::Datagram(encoded.clone()),
            Self::Large(encoded) => Self::Large(Arc::clone(encoded)),
        }
    }

    pub(crate) fn encoded(&self) -> &EncodedSample {
        match self {
            Self::Datagram(encoded) => encoded,
            Self::Large(encoded) => encoded,
        }
    }

    /// Returns the transmission time; zero for a datagram.
    pub(crate) fn time(&self) -> Duration {
        match self {
            Self::Datagram(_) => Duration::ZERO,
            Self::Large(encoded) => {
                ChunkPace::time_of(u64::try_from(encoded.bytes.len()).unwrap_or(u64::MAX))
            }
        }
    }
}

impl EncodedSample {
    /// Sets the NetworkMessage Timestamp and PicoSeconds.
    pub(crate) fn stamp(&mut self, at: Timestamp) {
        patch(&mut self.bytes, self.timestamp_at, &at.time.0.to_le_bytes());
        patch(
            &mut self.bytes,
            self.timestamp_at + 8,
            &at.picoseconds.to_le_bytes(),
        );
    }

    /// Returns the NetworkMessage Timestamp.
    pub(crate) fn time(&self) -> Option<Timestamp> {
        let (time, rest) = self.bytes.get(self.timestamp_at..)?.split_first_chunk()?;
        Some(Timestamp {
            time: DateTime(i64::from_le_bytes(*time)),
            picoseconds: u16::from_le_bytes(*rest.first_chunk()?),
        })
    }

    /// Returns the DataSetMessage.
    pub(crate) fn data_set_message(&self) -> &[u8] {
        self.bytes.get(self.payload_at..).unwrap_or_default()
    }

    /// Returns the encoded fields of the DataSetMessage.
    pub(crate) fn fields(&self) -> Result<&[u8], DecodeError> {
        let network = NetworkMessage::decode(&self.bytes)?;
        let message = network.messages().next().transpose()?;
        let fields = message.map(|message| message.fields()).transpose()?;
        Ok(fields.map(|fields| fields.bytes()).unwrap_or_default())
    }

    /// Returns the sequence number of the DataSetMessage.
    pub(crate) fn sequence(&self) -> u16 {
        let number = self.bytes.get(self.sequence_at..).unwrap_or_default();
        number
            .first_chunk()
            .map_or(0, |number| u16::from_le_bytes(*number))
    }

    /// Returns the identity of the DataSetMessage among all messages of its writer. In all sent
    /// messages the sequence number is followed by Timestamp and PicoSeconds.
    pub(crate) fn mark(&self) -> Option<Mark> {
        let stamp = self.bytes.get(self.sequence_at.checked_add(2)?..)?;
        let (ticks, rest) = stamp.split_first_chunk()?;
        Some(Mark {
            sequence: self.sequence(),
            stamp: Timestamp {
                time: DateTime(i64::from_le_bytes(*ticks)),
                picoseconds: u16::from_le_bytes(*rest.first_chunk()?),
            },
        })
    }

    /// Returns whether it is a keep-alive.
    pub(crate) const fn is_keep_alive(&self) -> bool {
        self.sequence_at == usize::MAX
    }

    /// Sets the Timestamp and PicoSeconds of the DataSetMessage.
    pub(crate) fn take_at(&mut self, stamp: Timestamp) {
        let at = self.sequence_at.saturating_add(2);
        patch(&mut self.bytes, at, &stamp.time.0.to_le_bytes());
        let at = at.saturating_add(8);
        patch(&mut self.bytes, at, &stamp.picoseconds.to_le_bytes());
    }

    pub(crate) fn number(&mut self, sequence: u16) {
        patch(&mut self.bytes, self.sequence_at, &sequence.to_le_bytes());
    }
}

fn patch(bytes: &mut [u8], at: usize, with: &[u8]) {
    if let Some(place) = bytes.get_mut(at..at.saturating_add(with.len())) {
        place.copy_from_slice(with);
    }
}
