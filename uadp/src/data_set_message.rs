//! DataSetMessage: decodes the header and iterates over the fields.

use crate::reader::ByteReader;
use crate::{DataValue, DateTime, DecodeError, DeltaNull, Variant};

/// A DataSetMessage with decoded header (OPC 10000-14, 7.2.4.5.4).
///
/// If [`is_valid`](Self::is_valid) is false, the standard forbids processing the message: skip it.
#[derive(Debug, Clone)]
pub struct DataSetMessage<'a> {
    /// DataSetWriterId within the publisher; `None` without payload header.
    pub writer_id: Option<u16>,
    /// Kind of the payload.
    pub kind: MessageKind,
    head: Head<'a>,
    payload: ByteReader<'a>,
}

/// The header fields of a DataSetMessage. Fields that are `None` are not encoded.
///
/// The default has no fields and is valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DataSetHeader {
    /// False if the publisher could not create the message; the other fields are then meaningless.
    pub valid: bool,
    /// Sequence number of the message; a keep-alive has the number of the next message.
    pub sequence_number: Option<u16>,
    /// Time of the values.
    pub timestamp: Option<DateTime>,
    /// Part of the timestamp below its resolution, in units of 10 ps.
    pub picoseconds: Option<u16>,
    /// Upper 16 bits of a StatusCode, see
    /// [`StatusCode::from_status`](crate::StatusCode::from_status).
    pub status: Option<u16>,
    /// Major version of the configuration, a VersionTime: seconds since 2000-01-01 UTC.
    pub major_version: Option<u32>,
    /// Minor version of the configuration, a VersionTime.
    pub minor_version: Option<u32>,
}

/// Type of a DataSetMessage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MessageKind {
    /// All fields (OPC 10000-14, 7.2.4.5.5). Without fields it is a heartbeat.
    KeyFrame,
    /// The changed fields, each with its index (OPC 10000-14, 7.2.4.5.6).
    DeltaFrame,
    /// The fields of an event (OPC 10000-14, 7.2.4.5.7).
    Event,
    /// A header without fields: the writer is alive and has no new values (OPC 10000-14,
    /// 7.2.4.5.8).
    KeepAlive,
}

/// Field encoding of a DataSetMessage: DataSetFlags1 bits 1 and 2 (OPC 10000-14, 7.2.4.5.4).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum FieldEncoding {
    /// Each field carries its type.
    #[default]
    Variant,
    /// Fields without types, decoded with the DataSetMetaData (OPC 10000-14, 7.2.4.5.11).
    RawData,
    /// Each field carries its type, quality and times.
    DataValue,
}

/// Iterator over the Variants of a key frame or event.
///
/// The iterator ends after the first `Err`. Zero bytes behind the last field are the padding to a
/// ConfiguredSize (OPC 10000-14, 6.3.1.3.3) and are skipped; other bytes cause a final
/// [`DecodeError::TrailingBytes`].
#[derive(Debug, Clone)]
pub struct Fields<'a> {
    block: &'a [u8],
    reader: ByteReader<'a>,
    count: u16,
    left: u16,
}

/// Iterator over the fields of a DataSetMessage, except RawData. It ends like [`Fields`].
#[derive(Debug, Clone)]
pub struct FieldValues<'a> {
    reader: ByteReader<'a>,
    next: u16,
    left: u16,
    indexed: bool,
    encoding: FieldEncoding,
}

/// A field and its index in the DataSet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FieldValue<'a> {
    /// Index in the DataSetMetaData.
    pub index: u16,
    /// The value; a Variant has no quality or times.
    pub value: DataValue<'a>,
}

impl Default for DataSetHeader {
    fn default() -> Self {
        Self {
            valid: true,
            sequence_number: None,
            timestamp: None,
            picoseconds: None,
            status: None,
            major_version: None,
            minor_version: None,
        }
    }
}

impl<'a> DataSetMessage<'a> {
    /// Decodes the header of a single DataSetMessage, for example from reassembled chunks.
    /// `writer_id` is the DataSetWriterId of the chunks.
    ///
    /// # Errors
    /// Fails like an item of [`NetworkMessage::messages`](crate::NetworkMessage::messages).
    pub fn decode(writer_id: Option<u16>, bytes: &'a [u8]) -> Result<Self, DecodeError> {
        Self::read(writer_id, ByteReader::new(bytes))
    }

    /// Decodes the header of the message. `reader` holds exactly this message.
    #[inline]
    pub(crate) fn read(
        writer_id: Option<u16>,
        mut reader: ByteReader<'a>,
    ) -> Result<Self, DecodeError> {
        let flags1 = reader.u8("DataSetFlags1")?;
        let valid = flags1 & VALID != 0;
        let (head, kind) = match Head::read(flags1, &mut reader, read_kind) {
            Ok(read) => read,
            // Nothing behind a cleared valid bit is meaningful, not even the flags.
            Err(_) if !valid => (Head::INVALID, MessageKind::KeyFrame),
            Err(error) => return Err(error),
        };
        if valid && kind == MessageKind::KeepAlive {
            check_padding(reader.rest())?;
        }
        Ok(Self {
            writer_id,
            kind,
            head,
            payload: reader,
        })
    }

    /// Returns the header fields.
    #[inline]
    #[must_use]
    pub fn header(&self) -> DataSetHeader {
        self.head.fields()
    }

    /// Returns the DataSetMessageSequenceNumber. This is cheaper than decoding the whole header.
    #[inline]
    #[must_use]
    pub fn sequence_number(&self) -> Option<u16> {
        match self.head.flags1 & SEQUENCE_NUMBER {
            0 => None,
            // It is the first field.
            _ => ByteReader::new(self.head.fields)
                .u16("DataSetMessageSequenceNumber")
                .ok(),
        }
    }

    /// Returns false if the publisher could not create the message; the other fields are then
    /// meaningless.
    #[inline]
    #[must_use]
    pub const fn is_valid(&self) -> bool {
        self.head.flags1 & VALID != 0
    }

    /// Returns the field encoding.
    #[inline]
    #[must_use]
    pub const fn encoding(&self) -> FieldEncoding {
        match self.head.flags1 & FIELD_ENCODING {
            RAW_FIELDS => FieldEncoding::RawData,
            DATA_VALUE_FIELDS => FieldEncoding::DataValue,
            _ => FieldEncoding::Variant,
        }
    }

    /// Returns the bytes behind the header, including padding.
    /// [`RawLayout::read`](crate::RawLayout::read) decodes the payload of a RawData message.
    #[inline]
    #[must_use]
    pub const fn payload(&self) -> &'a [u8] {
        self.payload.rest()
    }

    /// Returns the fields of a Variant encoded key frame or event. A keep-alive and a heartbeat
    /// have no fields, with or without FieldCount. [`values`](Self::values) also returns the fields
    /// of other messages.
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for delta frames and for the RawData and DataValue field encodings.
    /// Otherwise fails if the FieldCount is truncated or exceeds the number of following bytes.
    #[inline]
    pub fn fields(&self) -> Result<Fields<'a>, DecodeError> {
        match (self.kind, self.encoding()) {
            (MessageKind::KeepAlive, _) => Ok(Fields::NONE),
            (_, FieldEncoding::RawData) => Err(RAW_DATA),
            // A heartbeat is a header only (OPC 10000-14, 7.2.4.5.5); most peers support only a
            // heartbeat with a FieldCount of 0.
            (MessageKind::KeyFrame, _) if self.payload.remaining() == 0 => Ok(Fields::NONE),
            (_, FieldEncoding::DataValue) => Err(DecodeError::Misread("encoded as DataValues")),
            (MessageKind::DeltaFrame, FieldEncoding::Variant) => Err(DecodeError::Misread(
                "a delta frame, its fields have indexes",
            )),
            (MessageKind::KeyFrame | MessageKind::Event, FieldEncoding::Variant) => {
                Fields::parse(self.payload.rest())
            }
        }
    }

    /// Returns the fields with their indexes. A delta frame contains the changed fields only.
    ///
    /// open62541 1.5 pads a delta frame with entries that change nothing: see
    /// [`FieldValue::is_filler`].
    ///
    /// # Errors
    /// [`DecodeError::Misread`] for the RawData field encoding. Otherwise fails if the FieldCount
    /// is truncated or exceeds the number of following bytes.
    pub fn values(&self) -> Result<FieldValues<'a>, DecodeError> {
        let mut reader = self.payload;
        let count = match self.kind {
            MessageKind::KeepAlive => 0,
            _ if self.encoding() == FieldEncoding::RawData => return Err(RAW_DATA),
            MessageKind::KeyFrame if reader.remaining() == 0 => 0,
            MessageKind::KeyFrame | MessageKind::DeltaFrame | MessageKind::Event => {
                reader.u16("FieldCount")?
            }
        };
        if usize::from(count) > reader.remaining() {
            return Err(DecodeError::Limit {
                field: "FieldCount",
                value: count.into(),
            });
        }
        Ok(FieldValues {
            reader,
            next: 0,
            left: count,
            indexed: self.kind == MessageKind::DeltaFrame,
            encoding: self.encoding(),
        })
    }
}

impl<'a> FieldValues<'a> {
    fn read(&mut self) -> Result<FieldValue<'a>, DecodeError> {
        let index = if self.indexed {
            self.reader.u16("FieldIndex")?
        } else {
            self.next
        };
        self.next = self.next.wrapping_add(1);
        let value = match self.encoding {
            FieldEncoding::DataValue => DataValue::read(&mut self.reader)?,
            FieldEncoding::Variant | FieldEncoding::RawData => {
                Variant::read(&mut self.reader)?.into()
            }
        };
        Ok(FieldValue { index, value })
    }

    fn stop(&mut self) {
        self.left = 0;
        self.reader = ByteReader::new(&[]);
    }
}

impl<'a> Iterator for FieldValues<'a> {
    type Item = Result<FieldValue<'a>, DecodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        let Some(left) = self.left.checked_sub(1) else {
            let padding = self.reader.rest();
            self.stop();
            return check_padding(padding).err().map(Err);
        };
        self.left = left;
        let field = self.read();
        if field.is_err() {
            self.stop();
        }
        Some(field)
    }
}

impl core::iter::FusedIterator for FieldValues<'_> {}

impl FieldValue<'_> {
    /// Returns true for index 0 and a null Variant. open62541 1.5 pads delta frames with such
    /// entries up to the number of fields of the DataSet, so they should not be handled as changes
    /// of field 0.
    #[must_use]
    pub fn is_filler(&self) -> bool {
        let is_null = self.value == DataValue::from(Variant::Null);
        !DeltaNull::Filler.applies(self.index, is_null)
    }
}

impl<'a> Fields<'a> {
    const NONE: Self = Self {
        block: &[0, 0],
        reader: ByteReader::new(&[]),
        count: 0,
        left: 0,
    };

    /// Parses a block as returned by [`bytes`](Self::bytes): FieldCount (UInt16) and that many
    /// Variants.
    ///
    /// # Errors
    /// Fails if the FieldCount is truncated or exceeds the number of following bytes.
    #[inline]
    pub fn parse(block: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = ByteReader::new(block);
        let count = reader.u16("FieldCount")?;
        if usize::from(count) > reader.remaining() {
            return Err(DecodeError::Limit {
                field: "FieldCount",
                value: count.into(),
            });
        }
        Ok(Self {
            block,
            reader,
            count,
            left: count,
        })
    }

    /// Returns the FieldCount, independent of the progress of the iteration.
    #[inline]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.count as usize
    }

    /// Returns true without fields, as in a heartbeat or keep-alive.
    #[inline]
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Returns the encoded block without checks: FieldCount, Variants, and padding if present.
    #[inline]
    #[must_use]
    pub const fn bytes(&self) -> &'a [u8] {
        self.block
    }

    /// Takes the next `count` fields at once, if each is a single value of `builtin`, a type of
    /// fixed size. Returns the encoded Variants: an encoding byte and a little-endian value for
    /// each. Returns `None` and takes nothing if a field is missing or has another type.
    #[inline]
    pub fn take_scalars(&mut self, builtin: crate::BuiltinType, count: u16) -> Option<&'a [u8]> {
        let left = self.left.checked_sub(count)?;
        let size = 1 + builtin.fixed_size()?;
        let mut reader = self.reader;
        let taken = reader
            .bytes(usize::from(count).checked_mul(size)?, "Variant")
            .ok()?;
        let id = builtin.id();
        if !taken.chunks_exact(size).all(|one| one.first() == Some(&id)) {
            return None;
        }
        (self.reader, self.left) = (reader, left);
        Some(taken)
    }

    /// Checks all fields, and returns the block without padding.
    ///
    /// # Errors
    /// Fails with the error of the first invalid field.
    pub fn checked_bytes(&self) -> Result<&'a [u8], DecodeError> {
        let start = ByteReader::new(self.block);
        let mut reader = start;
        reader.u16("FieldCount")?;
        for _ in 0..self.count {
            Variant::read(&mut reader)?;
        }
        check_padding(reader.rest())?;
        Ok(reader.since(&start))
    }
}

impl<'a> Iterator for Fields<'a> {
    type Item = Result<Variant<'a>, DecodeError>;

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        match self.left.checked_sub(1) {
            Some(left) => {
                self.left = left;
                let field = Variant::read(&mut self.reader);
                if field.is_err() {
                    self.left = 0;
                    self.reader = ByteReader::new(&[]);
                }
                Some(field)
            }
            None if self.reader.remaining() == 0 => None,
            None => {
                let padding = self.reader.rest();
                self.reader = ByteReader::new(&[]);
                check_padding(padding).err().map(Err)
            }
        }
    }
}

impl core::iter::FusedIterator for Fields<'_> {}

/// The flags and the bytes of the header fields, which are checked for their length.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Head<'a> {
    flags1: u8,
    flags2: u8,
    fields: &'a [u8],
}

impl<'a> Head<'a> {
    const INVALID: Self = Self {
        flags1: 0,
        flags2: 0,
        fields: &[],
    };

    /// Reads the header after DataSetFlags1. `read_kind` converts the message type of
    /// DataSetFlags2.
    #[inline]
    pub(crate) fn read<K>(
        flags1: u8,
        reader: &mut ByteReader<'a>,
        read_kind: impl FnOnce(u8) -> Result<K, DecodeError>,
    ) -> Result<(Self, K), DecodeError> {
        let flags2 = match flags1 & FLAGS2 {
            0 => 0,
            _ => reader.u8("DataSetFlags2")?,
        };
        if flags1 & FIELD_ENCODING == FIELD_ENCODING {
            return Err(DecodeError::Reserved {
                field: "field encoding",
                value: 3,
            });
        }
        let reserved = flags2 & FLAGS2_RESERVED;
        if reserved != 0 {
            return Err(DecodeError::Reserved {
                field: "DataSetFlags2",
                value: reserved.into(),
            });
        }
        let kind = read_kind(flags2 & KIND)?;
        let sizes = [
            (flags1 & SEQUENCE_NUMBER, 2),
            (flags2 & TIMESTAMP, 8),
            (flags2 & PICOSECONDS, 2),
            (flags1 & STATUS, 2),
            (flags1 & MAJOR_VERSION, 4),
            (flags1 & MINOR_VERSION, 4),
        ];
        let mut size = 0;
        for (present, bytes) in sizes {
            // The branches are predicted, so the fields are read before the size is known. A sum of
            // bits would have to be waited for.
            size += match present {
                0 => 0,
                _ => bytes,
            };
        }
        let head = Self {
            flags1,
            flags2,
            fields: reader.rest(),
        };
        match reader.bytes(size, "DataSetMessage header") {
            Ok(fields) => Ok((Self { fields, ..head }, kind)),
            // Reads field by field, so that the error has the name of the truncated field.
            Err(_) => Err(head.read_fields().err().unwrap_or(CUT_OFF)),
        }
    }

    #[inline]
    pub(crate) fn fields(&self) -> DataSetHeader {
        match self.read_fields() {
            Ok(fields) => fields,
            // Only possible for an invalid message, which has no meaningful fields.
            Err(_) => DataSetHeader {
                valid: self.flags1 & VALID != 0,
                ..DataSetHeader::default()
            },
        }
    }

    #[inline]
    fn read_fields(&self) -> Result<DataSetHeader, DecodeError> {
        let mut reader = ByteReader::new(self.fields);
        let sequence_number = match self.flags1 & SEQUENCE_NUMBER {
            0 => None,
            _ => Some(reader.u16("DataSetMessageSequenceNumber")?),
        };
        let timestamp = match self.flags2 & TIMESTAMP {
            0 => None,
            _ => Some(DateTime(reader.i64("DataSetMessage Timestamp")?)),
        };
        let picoseconds = match self.flags2 & PICOSECONDS {
            0 => None,
            _ => Some(reader.u16("DataSetMessage PicoSeconds")?),
        };
        let status = match self.flags1 & STATUS {
            0 => None,
            _ => Some(reader.u16("DataSetMessage Status")?),
        };
        let major_version = match self.flags1 & MAJOR_VERSION {
            0 => None,
            _ => Some(reader.u32("ConfigurationVersion MajorVersion")?),
        };
        let minor_version = match self.flags1 & MINOR_VERSION {
            0 => None,
            _ => Some(reader.u32("ConfigurationVersion MinorVersion")?),
        };
        Ok(DataSetHeader {
            valid: self.flags1 & VALID != 0,
            sequence_number,
            timestamp,
            picoseconds,
            status,
            major_version,
            minor_version,
        })
    }
}

const CUT_OFF: DecodeError = DecodeError::Truncated {
    field: "DataSetMessage header",
    expected: 0,
    found: 0,
};

const RAW_DATA: DecodeError =
    DecodeError::Misread("encoded as RawData, to be read with its DataSetMetaData");

#[inline]
fn read_kind(kind: u8) -> Result<MessageKind, DecodeError> {
    match kind {
        KIND_KEY_FRAME => Ok(MessageKind::KeyFrame),
        KIND_DELTA_FRAME => Ok(MessageKind::DeltaFrame),
        KIND_EVENT => Ok(MessageKind::Event),
        KIND_KEEP_ALIVE => Ok(MessageKind::KeepAlive),
        KIND_ACTION_REQUEST | KIND_ACTION_RESPONSE => Err(DecodeError::Misread(
            "an Action, to be read with its ActionHeader",
        )),
        kind => Err(DecodeError::Reserved {
            field: "DataSetMessage type",
            value: kind.into(),
        }),
    }
}

/// Checks that the bytes behind the end of a message are zero, as padding to its ConfiguredSize or
/// to the shortest Ethernet frame.
#[inline]
pub(crate) fn check_padding(rest: &[u8]) -> Result<(), DecodeError> {
    if rest.iter().all(|byte| *byte == 0) {
        Ok(())
    } else {
        Err(DecodeError::TrailingBytes(rest.len()))
    }
}

pub(crate) const VALID: u8 = 0x01;
pub(crate) const FIELD_ENCODING: u8 = 0x06;
pub(crate) const SEQUENCE_NUMBER: u8 = 0x08;
pub(crate) const STATUS: u8 = 0x10;
pub(crate) const MAJOR_VERSION: u8 = 0x20;
pub(crate) const MINOR_VERSION: u8 = 0x40;
pub(crate) const FLAGS2: u8 = 0x80;

/// Field encoding bits.
pub(crate) const RAW_FIELDS: u8 = 0x02;
pub(crate) const DATA_VALUE_FIELDS: u8 = 0x04;

const KIND: u8 = 0x0F;
pub(crate) const KIND_KEY_FRAME: u8 = 0;
pub(crate) const KIND_DELTA_FRAME: u8 = 1;
pub(crate) const KIND_EVENT: u8 = 2;
pub(crate) const KIND_KEEP_ALIVE: u8 = 3;
pub(crate) const KIND_ACTION_REQUEST: u8 = 5;
pub(crate) const KIND_ACTION_RESPONSE: u8 = 6;
pub(crate) const TIMESTAMP: u8 = 0x10;
pub(crate) const PICOSECONDS: u8 = 0x20;
const FLAGS2_RESERVED: u8 = 0xC0;
