//! NetworkMessage: the headers of a datagram, and access to its DataSetMessages.

use crate::action::{ActionDialect, Actions};
use crate::data_set_message::check_padding;
use crate::header::{self, HeaderFlags};
use crate::reader::ByteReader;
use crate::{
    DataSetMessage, DateTime, DecodeError, GroupHeader, Guid, NetworkHeader, NetworkMessageType,
    PublisherId, SecurityHeader, Variant,
};

/// A datagram with decoded headers (OPC 10000-14, 7.2.4.4.2). The payload is decoded on demand.
///
/// The payload of a signed or encrypted message is readable after it was opened with the keys of
/// its SecurityGroup, the payload of a chunk after reassembly. [`actions`](Self::actions) decodes
/// an Action message.
#[derive(Debug, Clone)]
pub struct NetworkMessage<'a> {
    datagram: &'a [u8],
    flags: HeaderFlags,
    /// Offsets of the header fields, which are all within the datagram.
    publisher_at: usize,
    group_at: usize,
    timestamp_at: usize,
    payload_at: usize,
    writer_ids: Option<&'a [[u8; 2]]>,
    payload: ByteReader<'a>,
    rest: Option<Rest<'a>>,
}

/// Rarely used headers.
#[derive(Debug, Clone, Copy)]
struct Rest<'a> {
    message_type: NetworkMessageType,
    chunk: bool,
    action: bool,
    promoted: Option<&'a [u8]>,
    security: Option<SecurityHeader<'a>>,
    /// Signed or encrypted, and not opened yet.
    sealed: bool,
    footer: &'a [u8],
}

/// A part of a DataSetMessage or discovery message that exceeds a NetworkMessage (OPC 10000-14,
/// 7.2.4.4.4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Chunk<'a> {
    /// DataSetWriterId of the message; `None` without payload header, as in discovery messages.
    pub writer_id: Option<u16>,
    /// Number of the message that this is a part of.
    pub message_sequence_number: u16,
    /// Offset of the part in the message, in bytes.
    pub offset: u32,
    /// Size of the message in bytes.
    pub total_size: u32,
    /// Bytes of the part.
    pub data: &'a [u8],
}

/// Iterator over the PromotedFields of a NetworkMessage (OPC 10000-14, 7.2.4.4.2). It ends after
/// the first `Err`.
#[derive(Debug, Clone)]
pub struct PromotedFields<'a> {
    reader: ByteReader<'a>,
}

/// Iterator over the DataSetMessages of a [`NetworkMessage`], in the order of the DataSetWriterIds.
///
/// A malformed message among several is returned as an `Err`, and the iteration continues with the
/// next message. The iteration ends with an `Err` if a size exceeds the datagram or if bytes are
/// left after the last message.
#[derive(Debug, Clone)]
pub struct Messages<'a> {
    step: Step<'a>,
    payload: ByteReader<'a>,
}

#[derive(Debug, Clone)]
enum Step<'a> {
    /// A single message spans the whole payload.
    Single {
        writer_id: Option<u16>,
    },
    /// Count is above 1: the payload starts with the Sizes, one per DataSetWriterId.
    Sizes {
        writer_ids: &'a [[u8; 2]],
    },
    Sized {
        writer_ids: &'a [[u8; 2]],
        sizes: &'a [[u8; 2]],
    },
    /// The NetworkMessage has no DataSetMessages that can be decoded here.
    Misread(&'static str),
    Done,
}

impl<'a> NetworkMessage<'a> {
    /// Decodes the headers of a datagram.
    ///
    /// # Errors
    /// Fails if a header is truncated, has a reserved value, or announces an unsupported feature.
    #[inline]
    pub fn decode(datagram: &'a [u8]) -> Result<Self, DecodeError> {
        let start = ByteReader::new(datagram);
        let mut reader = start;
        let flags = HeaderFlags::read(&mut reader)?;
        let publisher_at = reader.since_start(&start);
        if flags.uadp & header::PUBLISHER_ID != 0 {
            PublisherId::skip(flags.extended1 & header::PUBLISHER_ID_TYPE, &mut reader)?;
        }
        if flags.extended1 & header::DATA_SET_CLASS_ID != 0 {
            reader.bytes(16, "DataSetClassId")?;
        }
        let group_at = reader.since_start(&start);
        if flags.uadp & header::GROUP_HEADER != 0 {
            GroupHeader::skip(&mut reader)?;
        }
        let writer_ids = match flags.uadp & header::PAYLOAD_HEADER {
            0 => None,
            _ if flags.extended2 & header::CHUNK != 0 => Some(reader.u16s(1, "DataSetWriterId")?),
            _ => Some(read_writer_ids(&mut reader)?),
        };
        let timestamp_at = reader.since_start(&start);
        if flags.extended1 & header::TIMESTAMP != 0 {
            reader.bytes(8, "Timestamp")?;
        }
        if flags.extended1 & header::PICOSECONDS != 0 {
            reader.bytes(2, "PicoSeconds")?;
        }
        let rest = if flags.extended1 & header::SECURITY != 0 || flags.extended2 != 0 {
            Some(Rest::read(flags, &mut reader)?)
        } else {
            None
        };
        let footer = rest.as_ref().map_or(0, |rest| rest.footer.len());
        Ok(Self {
            datagram,
            flags,
            publisher_at,
            group_at,
            timestamp_at,
            payload_at: reader.since_start(&start) - footer,
            writer_ids,
            payload: reader,
            rest,
        })
    }

    /// Returns the header fields.
    #[inline]
    #[must_use]
    pub fn header(&self) -> NetworkHeader<'a> {
        let mut times = self.reader_at(self.timestamp_at);
        let timestamp = match self.flags.extended1 & header::TIMESTAMP {
            0 => None,
            _ => times.i64("Timestamp").ok().map(DateTime),
        };
        let picoseconds = match self.flags.extended1 & header::PICOSECONDS {
            0 => None,
            _ => times.u16("PicoSeconds").ok(),
        };
        NetworkHeader {
            publisher_id: self.publisher_id(),
            data_set_class_id: self.data_set_class_id(),
            group: self.group(),
            timestamp,
            picoseconds,
        }
    }

    /// Returns the PublisherId. This is cheaper than decoding the whole header.
    #[inline]
    #[must_use]
    pub fn publisher_id(&self) -> Option<PublisherId<'a>> {
        match self.flags.uadp & header::PUBLISHER_ID {
            0 => None,
            _ => {
                let id_type = self.flags.extended1 & header::PUBLISHER_ID_TYPE;
                PublisherId::read(id_type, &mut self.reader_at(self.publisher_at)).ok()
            }
        }
    }

    /// Returns the group header. This is cheaper than decoding the whole header.
    #[inline]
    #[must_use]
    pub fn group(&self) -> Option<GroupHeader> {
        match self.flags.uadp & header::GROUP_HEADER {
            0 => None,
            _ => GroupHeader::read(&mut self.reader_at(self.group_at)).ok(),
        }
    }

    #[inline]
    fn data_set_class_id(&self) -> Option<Guid> {
        match self.flags.extended1 & header::DATA_SET_CLASS_ID {
            0 => None,
            // It ends at the start of the group header.
            _ => {
                let mut reader = self.reader_at(self.group_at.checked_sub(16)?);
                reader.array("DataSetClassId").ok().map(Guid)
            }
        }
    }

    #[inline]
    fn reader_at(&self, at: usize) -> ByteReader<'a> {
        ByteReader::new(self.datagram.get(at..).unwrap_or_default())
    }

    /// Returns the DataSetWriterIds of the payload header, at least one; `None` without payload
    /// header.
    #[inline]
    #[must_use]
    pub fn writer_ids(&self) -> Option<impl ExactSizeIterator<Item = u16> + Clone + use<'a>> {
        self.writer_ids
            .map(|ids| ids.iter().map(|id| u16::from_le_bytes(*id)))
    }

    /// Returns the type of the NetworkMessage.
    #[must_use]
    pub fn message_type(&self) -> NetworkMessageType {
        self.rest
            .map_or_else(Default::default, |rest| rest.message_type)
    }

    /// Returns true for a chunk: decode it with [`chunk`](Self::chunk).
    #[inline]
    #[must_use]
    pub fn is_chunk(&self) -> bool {
        self.rest.is_some_and(|rest| rest.chunk)
    }

    /// Returns true for requests or responses of Actions: decode them with
    /// [`actions`](Self::actions).
    #[inline]
    #[must_use]
    pub fn is_action(&self) -> bool {
        self.rest.is_some_and(|rest| rest.action)
    }

    /// Returns the SecurityHeader. The message is secured only if `signed` or `encrypted` is set.
    #[must_use]
    pub fn security(&self) -> Option<SecurityHeader<'a>> {
        self.rest.and_then(|rest| rest.security)
    }

    /// Returns the SecurityFooter; empty without footer, and until the message is opened.
    #[must_use]
    pub fn footer(&self) -> &'a [u8] {
        self.rest.map_or(&[], |rest| rest.footer)
    }

    /// Returns true if the payload is signed or encrypted and was not opened.
    #[inline]
    #[must_use]
    pub fn is_sealed(&self) -> bool {
        self.rest.is_some_and(|rest| rest.sealed)
    }

    /// Returns the PromotedFields, or `None` if they are not enabled.
    #[must_use]
    pub fn promoted_fields(&self) -> Option<PromotedFields<'a>> {
        let promoted = self.rest?.promoted?;
        Some(PromotedFields {
            reader: ByteReader::new(promoted),
        })
    }

    /// Returns the bytes behind the headers. In a sealed message these are the ciphertext, the
    /// footer and the signature. The ActionHeader of an Action message is part of the payload.
    #[must_use]
    pub const fn payload(&self) -> &'a [u8] {
        self.payload.rest()
    }

    /// Returns the offset of the payload in the datagram.
    #[must_use]
    pub const fn payload_offset(&self) -> usize {
        self.payload_at
    }

    /// Returns all bytes, from the first flags on.
    #[must_use]
    pub const fn datagram(&self) -> &'a [u8] {
        self.datagram
    }

    /// Returns the message with its opened payload and footer.
    pub(crate) fn opened<'b>(&self, payload: &'b [u8], footer: &'b [u8]) -> NetworkMessage<'b>
    where
        'a: 'b,
    {
        NetworkMessage {
            payload: ByteReader::new(payload),
            rest: self.rest.map(|rest| Rest {
                sealed: false,
                footer,
                ..rest
            }),
            ..self.clone()
        }
    }

    /// Returns the part in a chunk NetworkMessage.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] if the message is not a chunk or is still sealed;
    /// [`DecodeError::Unsupported`] for a chunk with an ActionHeader. Otherwise fails if the header
    /// of the chunk is truncated, the part is empty, or it exceeds the TotalSize.
    pub fn chunk(&self) -> Result<Chunk<'a>, DecodeError> {
        if self.is_sealed() {
            return Err(DecodeError::Misread(SEALED));
        }
        if !self.is_chunk() {
            return Err(DecodeError::Misread("no chunk"));
        }
        if self.is_action() {
            return Err(DecodeError::Unsupported("a chunk with an ActionHeader"));
        }
        let mut payload = self.payload;
        let message_sequence_number = payload.u16("MessageSequenceNumber")?;
        let offset = payload.u32("ChunkOffset")?;
        let total_size = payload.u32("TotalSize")?;
        let exceeded = DecodeError::Limit {
            field: "ChunkOffset",
            value: offset,
        };
        let rest = payload.rest();
        // The frame of a short last part may be padded.
        let most = total_size.checked_sub(offset).ok_or(exceeded)?;
        let most = usize::try_from(most).unwrap_or(usize::MAX);
        let (data, padding) = rest.split_at(rest.len().min(most));
        if data.is_empty() || check_padding(padding).is_err() {
            return Err(exceeded);
        }
        Ok(Chunk {
            writer_id: self.writer_ids().and_then(|mut ids| ids.next()),
            message_sequence_number,
            offset,
            total_size,
            data,
        })
    }

    /// Returns the DataSetMessages. Without payload header there is a single message without
    /// DataSetWriterId; for several configured messages without payload header see
    /// [`data_set_message_at`](Self::data_set_message_at).
    ///
    /// A chunk, a discovery message, an Action message and a sealed message return a single
    /// [`DecodeError::Misread`].
    #[inline]
    #[must_use]
    pub fn messages(&self) -> Messages<'a> {
        let step = match (self.writer_ids, self.misread()) {
            (_, Some(why)) => Step::Misread(why),
            (None, None) => Step::Single { writer_id: None },
            (Some([id]), None) => Step::Single {
                writer_id: Some(u16::from_le_bytes(*id)),
            },
            (Some(writer_ids), None) => Step::Sizes { writer_ids },
        };
        Messages {
            step,
            payload: self.payload,
        }
    }

    /// Returns the DataSetMessage of `size` bytes at `offset` in the NetworkMessage, as configured
    /// in the DataSetReader of a fixed layout (DataSetOffset and ConfiguredSize: OPC 10000-14,
    /// 6.3.1.3.3 and 6.3.1.3.5).
    ///
    /// # Errors
    /// As for [`messages`](Self::messages); [`DecodeError::Truncated`] if the range is not within
    /// the payload.
    pub fn data_set_message_at(
        &self,
        offset: usize,
        size: usize,
    ) -> Result<DataSetMessage<'a>, DecodeError> {
        if let Some(why) = self.misread() {
            return Err(DecodeError::Misread(why));
        }
        let headers = self.payload_at;
        let cut = DecodeError::Truncated {
            field: "DataSetMessage",
            expected: offset.saturating_add(size),
            found: headers + self.payload.remaining(),
        };
        let start = offset.checked_sub(headers).ok_or(cut)?;
        let end = start.checked_add(size).ok_or(cut)?;
        let message = self.payload().get(start..end).ok_or(cut)?;
        DataSetMessage::read(None, ByteReader::new(message))
    }

    /// Returns the requests or responses of an Action message (OPC 10000-14, 7.2.4.5.9 and
    /// 7.2.4.5.10), in the dialect of the peer.
    ///
    /// # Errors
    /// - [`DecodeError::Misread`] if the message is not an Action message, is a chunk, or is still
    ///   sealed.
    /// - [`DecodeError::Reserved`] without PublisherId or payload header, which identify the
    ///   Responder.
    /// - Otherwise if the ActionHeader is truncated or malformed.
    pub fn actions(&self, dialect: ActionDialect) -> Result<Actions<'a>, DecodeError> {
        match self.rest.as_ref() {
            Some(rest) if rest.sealed => Err(DecodeError::Misread(SEALED)),
            Some(rest) if rest.chunk => Err(DecodeError::Misread(CHUNK)),
            Some(rest) if rest.action => {
                let header = self.header();
                Actions::read(&header, self.writer_ids, self.payload, dialect)
            }
            Some(_) | None => Err(DecodeError::Misread("not an Action message")),
        }
    }

    #[inline]
    fn misread(&self) -> Option<&'static str> {
        self.rest.as_ref().and_then(Rest::misread)
    }
}

impl<'a> Rest<'a> {
    /// Reads PromotedFields, SecurityHeader, and the SecurityFooter if the message is neither
    /// signed nor encrypted.
    #[cold]
    fn read(flags: HeaderFlags, reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let promoted = match flags.extended2 & header::PROMOTED_FIELDS {
            0 => None,
            _ => {
                let size = reader.u16("PromotedFields Size")?;
                Some(reader.bytes(size.into(), "PromotedFields")?)
            }
        };
        let security = match flags.extended1 & header::SECURITY {
            0 => None,
            _ => Some(SecurityHeader::read(reader)?),
        };
        let sealed = security.is_some_and(|security| security.is_secured());
        let mut footer = ByteReader::new(&[]);
        if !sealed && let Some(size) = security.and_then(|security| security.footer_size) {
            (*reader, footer) = reader.split_end(size.into(), "SecurityFooter")?;
        }
        Ok(Self {
            message_type: flags.message_type(),
            chunk: flags.extended2 & header::CHUNK != 0,
            action: flags.extended2 & header::ACTION_HEADER != 0,
            promoted,
            security,
            sealed,
            footer: footer.rest(),
        })
    }

    #[cold]
    const fn misread(&self) -> Option<&'static str> {
        if self.sealed {
            return Some(SEALED);
        }
        if self.chunk {
            return Some(CHUNK);
        }
        if self.action {
            return Some("an Action message");
        }
        match self.message_type {
            NetworkMessageType::DataSet => None,
            NetworkMessageType::Probe => Some("a discovery probe"),
            NetworkMessageType::Announcement => Some("a discovery announcement"),
        }
    }
}

const SEALED: &str = "secured, to be opened with its keys first";
const CHUNK: &str = "a chunk, to be reassembled first";

impl<'a> Iterator for Messages<'a> {
    type Item = Result<DataSetMessage<'a>, DecodeError>;

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        match self.step {
            Step::Misread(why) => {
                self.step = Step::Done;
                Some(Err(DecodeError::Misread(why)))
            }
            Step::Single { writer_id } => {
                self.step = Step::Done;
                Some(DataSetMessage::read(writer_id, self.payload))
            }
            Step::Sizes { writer_ids } => match self.read_sizes(writer_ids.len()) {
                Ok(sizes) => {
                    self.step = Step::Sized { writer_ids, sizes };
                    self.next_sized(writer_ids, sizes)
                }
                Err(error) => {
                    self.step = Step::Done;
                    Some(Err(error))
                }
            },
            Step::Sized { writer_ids, sizes } => self.next_sized(writer_ids, sizes),
            Step::Done => None,
        }
    }
}

impl<'a> Messages<'a> {
    fn read_sizes(&mut self, count: usize) -> Result<&'a [[u8; 2]], DecodeError> {
        let (sizes, _) = self.payload.bytes(count * 2, "Sizes")?.as_chunks();
        Ok(sizes)
    }

    fn next_sized(
        &mut self,
        writer_ids: &'a [[u8; 2]],
        sizes: &'a [[u8; 2]],
    ) -> Option<Result<DataSetMessage<'a>, DecodeError>> {
        self.step = Step::Done;
        let (Some((writer_id, writer_ids)), Some((size, sizes))) =
            (writer_ids.split_first(), sizes.split_first())
        else {
            return check_padding(self.payload.rest()).err().map(Err);
        };
        let size = u16::from_le_bytes(*size).into();
        let message = match self.payload.bytes(size, "DataSetMessage") {
            Ok(message) => message,
            Err(error) => return Some(Err(error)),
        };
        self.step = Step::Sized { writer_ids, sizes };
        let writer_id = u16::from_le_bytes(*writer_id);
        Some(DataSetMessage::read(
            Some(writer_id),
            ByteReader::new(message),
        ))
    }
}

impl core::iter::FusedIterator for Messages<'_> {}

impl<'a> Iterator for PromotedFields<'a> {
    type Item = Result<Variant<'a>, DecodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.reader.remaining() == 0 {
            return None;
        }
        let field = Variant::read(&mut self.reader);
        if field.is_err() {
            self.reader = ByteReader::new(&[]);
        }
        Some(field)
    }
}

impl core::iter::FusedIterator for PromotedFields<'_> {}

/// Reads Count, which is never 0 (OPC 10000-14, 7.2.4.5.2), and DataSetWriterIds.
#[inline]
fn read_writer_ids<'a>(reader: &mut ByteReader<'a>) -> Result<&'a [[u8; 2]], DecodeError> {
    match reader.u8("DataSetMessage Count")? {
        0 => Err(DecodeError::Reserved {
            field: "DataSetMessage Count",
            value: 0,
        }),
        count => reader.u16s(count, "DataSetWriterIds"),
    }
}
