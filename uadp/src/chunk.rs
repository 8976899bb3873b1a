//! Sending what is too big for one NetworkMessage in chunks (OPC 10000-14, 7.2.4.4.4).

use crate::header_writer::{self, Extras, Form, PayloadHeader};
use crate::{EncodeError, NetworkHeader, NetworkMessageType};

/// What is to be sent in chunks: one encoded DataSetMessage, or the body of a discovery announcement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Whole<'a> {
    /// What the bytes are.
    pub message_type: NetworkMessageType,
    /// The DataSetWriter, which makes the payload header. `None` in discovery messages, which have none.
    pub writer_id: Option<u16>,
    /// The DataSetMessageSequenceNumber or the announcement's SequenceNumber. No other whole of the writer may have
    /// it at the same time.
    pub message_sequence_number: u16,
    /// The encoded message, without NetworkMessage headers and Sizes.
    pub bytes: &'a [u8],
}

/// How big a chunk NetworkMessage may become.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ChunkBudget {
    /// Bytes of one NetworkMessage with everything in it: the payload of a UDP datagram
    /// (MaxNetworkMessageSize: OPC 10000-14, 6.2.5.5).
    pub network_message: usize,
    /// Bytes that sealing appends behind the payload: SecurityFooter and signature. 0 without security, 32 with the
    /// AES-CTR policies. The SecurityHeader is not part of it; it counts among the headers.
    pub trailer: usize,
}

/// Where a chunk NetworkMessage stands in the buffer; it ends where the buffer does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PlacedChunk {
    /// Position of its first byte.
    pub start: usize,
    /// Position of its payload, from which on it is encrypted.
    pub payload_at: usize,
}

/// Writes a [`Whole`] as chunk NetworkMessages, all but the last with equally much of it
/// (OPC 10000-14, 7.2.4.4.4).
///
/// The chunks have the headers given first; of a group header with SequenceNumber and NetworkMessageNumber both
/// count on from chunk to chunk, since each is a NetworkMessage of its own (OPC 10000-14, 7.2.4.4.2 and 6.3.1.3.4).
/// ```
/// use std::time::Duration;
/// use uadp::{
///     ChunkBudget, Chunks, DataSetHeader, DataSetMessage, Extras, NetworkHeader, NetworkMessage,
///     NetworkMessageEncoder, NetworkMessageType, PublisherId, Reassembler, Scalar, Variant, Whole,
/// };
///
/// // A DataSetMessage alone: what stands behind the smallest NetworkMessage header, its one byte of flags.
/// let mut encoded = Vec::new();
/// let mut message = NetworkMessageEncoder::new(&mut encoded, &NetworkHeader::default(), None)?;
/// let mut fields = message.key_frame(&DataSetHeader { sequence_number: Some(7), ..DataSetHeader::default() })?;
/// let image = vec![0xAB; 4000];
/// fields.scalar(Scalar::ByteString(Some(&image)))?;
/// fields.finish()?;
/// message.finish()?;
/// let whole = Whole {
///     message_type: NetworkMessageType::DataSet,
///     writer_id: Some(10),
///     message_sequence_number: 7,
///     bytes: &encoded[1..],
/// };
///
/// let header = NetworkHeader { publisher_id: Some(PublisherId::UInt16(2)), ..NetworkHeader::default() };
/// let mut chunks = Chunks::new(&header, &Extras::default(), whole, ChunkBudget::IPV4)?;
/// let mut datagrams = Vec::new();
/// let mut buffer = Vec::new();
/// while let Some(chunk) = chunks.append(&mut buffer, &Extras::default()) {
///     let chunk = chunk?; // here a secured one is sealed, from `chunk.start` and `chunk.payload_at`
///     datagrams.push(buffer.split_off(chunk.start));
/// }
/// assert_eq!(datagrams.len(), 3);
///
/// let mut reassembler = Reassembler::default();
/// for datagram in &datagrams {
///     let received = NetworkMessage::decode(datagram)?;
///     let Some(whole) = reassembler.receive(&received, Duration::ZERO)? else { continue };
///     let message = whole.data_set_message()?;
///     assert_eq!(message.writer_id, Some(10));
///     let field = message.fields()?.next().unwrap()?;
///     assert_eq!(field, Variant::Scalar(Scalar::ByteString(Some(&image))));
/// }
/// assert_eq!(reassembler.counters().completed, 1);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct Chunks<'a> {
    header: NetworkHeader<'a>,
    whole: Whole<'a>,
    total_size: u32,
    budget: ChunkBudget,
    /// Bytes of the whole in each chunk but the last.
    room: usize,
    offset: usize,
}

/// Why something cannot be sent in chunks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChunkError {
    /// The budget leaves not a byte for the message.
    #[error("{budget} bytes are no room beside {overhead} bytes of headers and trailer")]
    NoRoom {
        /// Bytes one NetworkMessage may have.
        budget: usize,
        /// Bytes it has without any of the message.
        overhead: usize,
    },
    /// There is nothing to send.
    #[error("nothing to send in chunks")]
    Empty,
    /// More bytes than TotalSize can say, or more chunks than NetworkMessageNumber can count.
    #[error("{0} bytes are too many for chunks")]
    TooBig(usize),
    /// A header could not be written.
    #[error(transparent)]
    Header(#[from] EncodeError),
}

impl ChunkBudget {
    /// An Ethernet frame over UDP and IPv4, without security (OPC 10000-14, 7.3.2).
    pub const IPV4: Self = Self {
        network_message: 1472,
        trailer: 0,
    };

    /// An Ethernet frame over UDP and IPv6, without security (OPC 10000-14, 7.3.2).
    pub const IPV6: Self = Self {
        network_message: 1452,
        trailer: 0,
    };

    /// The same with so many bytes of footer and signature.
    #[must_use]
    pub const fn with_trailer(self, trailer: usize) -> Self {
        Self { trailer, ..self }
    }
}

impl<'a> Chunks<'a> {
    /// Prepares the chunks. `header` is that of the first one, `extras` are like those each chunk will get: a nonce
    /// as long as theirs.
    ///
    /// # Errors
    /// [`ChunkError::NoRoom`] when the headers and the trailer take up the budget, [`ChunkError::Empty`] without
    /// bytes, [`ChunkError::TooBig`] past 2^32-1 bytes or when NetworkMessageNumber would not hold, and
    /// [`ChunkError::Header`] as [`NetworkMessageEncoder::with`](crate::NetworkMessageEncoder::with).
    pub fn new(
        header: &NetworkHeader<'a>,
        extras: &Extras<'_>,
        whole: Whole<'a>,
        budget: ChunkBudget,
    ) -> Result<Self, ChunkError> {
        let total = whole.bytes.len();
        let too_big = ChunkError::TooBig(total);
        let total_size = u32::try_from(total).map_err(|_| too_big)?;
        if total == 0 {
            return Err(ChunkError::Empty);
        }
        let mut headers = Vec::new();
        write_headers(&mut headers, header, whole, extras)?;
        let overhead = headers.len() + CHUNK_FIELDS + budget.trailer;
        let room = budget.network_message.saturating_sub(overhead);
        if room == 0 {
            return Err(ChunkError::NoRoom {
                budget: budget.network_message,
                overhead,
            });
        }
        let first = header.group.and_then(|group| group.network_message_number);
        if let Some(first) = first
            && total.div_ceil(room) > usize::from(u16::MAX - first) + 1
        {
            return Err(too_big);
        }
        Ok(Self {
            header: *header,
            whole,
            total_size,
            budget,
            room,
            offset: 0,
        })
    }

    /// Goes on at byte `offset` of the whole, as [`offset`](Self::offset) said of chunks of the same whole, headers
    /// and budget: what is sent over a time need not stay borrowed.
    #[must_use]
    pub const fn resumed_at(mut self, offset: usize) -> Self {
        self.offset = offset;
        self
    }

    /// How many bytes of the whole are written.
    #[must_use]
    pub const fn offset(&self) -> usize {
        self.offset
    }

    /// Appends the next chunk NetworkMessage to `buf`; `None` when all are written. `extras` are its own: with
    /// security a nonce that no other NetworkMessage has. After an error `buf` is as before.
    pub fn append(
        &mut self,
        buf: &mut Vec<u8>,
        extras: &Extras<'_>,
    ) -> Option<Result<PlacedChunk, ChunkError>> {
        if self.remaining() == 0 {
            return None;
        }
        let start = buf.len();
        let placed = self.write(buf, extras);
        if placed.is_err() {
            buf.truncate(start);
        }
        Some(placed)
    }

    /// How many chunks are still to be written: the SequenceNumbers of the WriterGroup they will use up.
    #[must_use]
    pub const fn remaining(&self) -> usize {
        self.whole
            .bytes
            .len()
            .saturating_sub(self.offset)
            .div_ceil(self.room)
    }

    fn write(&mut self, buf: &mut Vec<u8>, extras: &Extras<'_>) -> Result<PlacedChunk, ChunkError> {
        let start = buf.len();
        write_headers(buf, &self.header, self.whole, extras)?;
        let payload_at = buf.len();
        let overhead = payload_at - start + CHUNK_FIELDS + self.budget.trailer;
        let rest = self.whole.bytes.get(self.offset..).unwrap_or_default();
        let data = rest.get(..self.room).unwrap_or(rest);
        if overhead + data.len() > self.budget.network_message {
            return Err(ChunkError::NoRoom {
                budget: self.budget.network_message,
                overhead,
            });
        }
        let offset = u32::try_from(self.offset).unwrap_or(u32::MAX);
        buf.reserve(CHUNK_FIELDS + data.len() + self.budget.trailer);
        buf.extend_from_slice(&self.whole.message_sequence_number.to_le_bytes());
        buf.extend_from_slice(&offset.to_le_bytes());
        buf.extend_from_slice(&self.total_size.to_le_bytes());
        buf.extend_from_slice(data);
        self.offset += data.len();
        self.count_on();
        Ok(PlacedChunk { start, payload_at })
    }

    /// Makes the group header that of the next NetworkMessage.
    const fn count_on(&mut self) {
        if let Some(group) = &mut self.header.group {
            if let Some(number) = &mut group.sequence_number {
                *number = number.wrapping_add(1);
            }
            if let Some(number) = &mut group.network_message_number {
                *number = number.wrapping_add(1);
            }
        }
    }
}

fn write_headers(
    buf: &mut Vec<u8>,
    header: &NetworkHeader<'_>,
    whole: Whole<'_>,
    extras: &Extras<'_>,
) -> Result<(), EncodeError> {
    let form = Form {
        message_type: whole.message_type,
        chunk: true,
        action: false,
        extras,
    };
    let writer_id = whole
        .writer_id
        .map_or(PayloadHeader::None, PayloadHeader::Chunk);
    header_writer::write(buf, header, writer_id, form).map(|_| ())
}

/// Bytes of MessageSequenceNumber, ChunkOffset and TotalSize.
const CHUNK_FIELDS: usize = 10;
