//! Sends messages that exceed a NetworkMessage in chunks (OPC 10000-14, 7.2.4.4.4).

use crate::header_writer::{self, Extras, MessageForm, PayloadHeader};
use crate::{EncodeError, NetworkHeader, NetworkMessageType};
use alloc::vec::Vec;

/// A message to send in chunks: an encoded DataSetMessage, or the body of a discovery announcement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Whole<'a> {
    /// Type of the message.
    pub message_type: NetworkMessageType,
    /// The DataSetWriter in the payload header. `None` in discovery messages, which have no payload
    /// header.
    pub writer_id: Option<u16>,
    /// The DataSetMessageSequenceNumber, or the SequenceNumber of the announcement. It has to be
    /// unique among the messages that the writer sends at the same time.
    pub message_sequence_number: u16,
    /// The encoded message, without NetworkMessage headers and Sizes.
    pub bytes: &'a [u8],
}

/// Maximum size of a chunk NetworkMessage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ChunkBudget {
    /// Bytes of a complete NetworkMessage: the payload of a UDP datagram (MaxNetworkMessageSize:
    /// OPC 10000-14, 6.2.5.5).
    pub network_message: usize,
    /// Bytes that sealing appends to the payload: SecurityFooter and signature. 0 without security,
    /// 32 with the AES-CTR policies. The SecurityHeader is not included, because it counts as a
    /// header.
    pub trailer: usize,
}

/// Position of a chunk NetworkMessage in the buffer; it ends at the end of the buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PlacedChunk {
    /// Offset of its first byte.
    pub start: usize,
    /// Offset of its payload, where the encryption starts.
    pub payload_at: usize,
}

/// Encodes a [`Whole`] as chunk NetworkMessages. All chunks except the last hold the same number of
/// bytes (OPC 10000-14, 7.2.4.4.4).
///
/// The chunks have the given headers. SequenceNumber and NetworkMessageNumber of the group header
/// increase from chunk to chunk, because each chunk is a separate NetworkMessage (OPC 10000-14,
/// 7.2.4.4.2 and 6.3.1.3.4).
/// ```
/// use std::time::Duration;
/// use uadp::{
///     ChunkBudget, ChunkEncoder, DataSetHeader, DataSetMessage, Extras, NetworkHeader,
///     NetworkMessage, NetworkMessageEncoder, NetworkMessageType, PublisherId, Reassembler, Scalar,
///     Variant, Whole, };
///
/// // A DataSetMessage alone, without the smallest NetworkMessage header (one byte of flags).
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
/// let mut chunks = ChunkEncoder::new(&header, &Extras::default(), whole, ChunkBudget::IPV4)?;
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
pub struct ChunkEncoder<'a> {
    header: NetworkHeader<'a>,
    whole: Whole<'a>,
    total_size: u32,
    budget: ChunkBudget,
    /// Bytes of the whole in each chunk except the last.
    room: usize,
    offset: usize,
}

/// Reason why a message cannot be sent in chunks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChunkError {
    /// The budget leaves no byte for the message.
    #[error("{budget} bytes are not enough for {overhead} bytes of headers and trailer")]
    NoRoom {
        /// Maximum bytes of a NetworkMessage.
        budget: usize,
        /// Bytes of headers and trailer.
        overhead: usize,
    },
    /// The message is empty.
    #[error("nothing to send in chunks")]
    Empty,
    /// The message has more bytes than TotalSize or more chunks than NetworkMessageNumber can
    /// represent.
    #[error("{0} bytes exceed the limit of chunked messages")]
    TooBig(usize),
    /// A header could not be encoded.
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

    /// Sets the bytes of footer and signature.
    #[must_use]
    pub const fn with_trailer(self, trailer: usize) -> Self {
        Self { trailer, ..self }
    }
}

impl<'a> ChunkEncoder<'a> {
    /// Prepares the chunks. `header` is the header of the first chunk. `extras` have the size of
    /// the extras of each chunk, including the length of the nonce.
    ///
    /// # Errors
    /// - [`ChunkError::NoRoom`] if headers and trailer use up the budget.
    /// - [`ChunkError::Empty`] without bytes.
    /// - [`ChunkError::TooBig`] above 2^32-1 bytes, or if NetworkMessageNumber would overflow.
    /// - [`ChunkError::Header`] as
    ///   [`NetworkMessageEncoder::with`](crate::NetworkMessageEncoder::with).
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

    /// Continues at an [`offset`](Self::offset) of the same whole with the same headers and budget,
    /// so that the whole does not have to stay borrowed while it is sent.
    #[must_use]
    pub const fn resumed_at(mut self, offset: usize) -> Self {
        self.offset = offset;
        self
    }

    /// Returns the number of encoded bytes of the whole.
    #[must_use]
    pub const fn offset(&self) -> usize {
        self.offset
    }

    /// Appends the next chunk NetworkMessage to `buf`. Returns `None` after the last chunk.
    /// `extras` apply to this chunk: with security they hold a nonce that no other NetworkMessage
    /// has. After an error `buf` is unchanged.
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

    /// Returns the number of remaining chunks, which is the number of SequenceNumbers of the
    /// WriterGroup that they use.
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

    /// Updates the group header for the next NetworkMessage.
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
    let form = MessageForm {
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
