//! DataSetMessage: one writer's header, and its fields read one by one.

use crate::reader::Reader;
use crate::{DateTime, DecodeError, Variant};

/// One DataSetMessage whose header was read (OPC 10000-14, 7.2.4.5.4).
///
/// With [`header.valid`](DataSetHeader::valid) false the standard forbids to process the rest: skip it.
#[derive(Debug, Clone)]
pub struct DataSetMessage<'a> {
    /// DataSetWriter within the publisher; `None` without payload header.
    pub writer_id: Option<u16>,
    /// The header fields.
    pub header: DataSetHeader,
    /// What the payload is.
    pub kind: MessageKind,
    encoding: FieldEncoding,
    payload: Reader<'a>,
}

/// The header fields of a DataSetMessage. What is `None` is not on the wire.
///
/// The default has none and is valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DataSetHeader {
    /// False: the publisher could not make the message; nothing else in it counts.
    pub valid: bool,
    /// Counts the messages of the writer. In a keep-alive, the number the next one will have.
    pub sequence_number: Option<u16>,
    /// When the values were taken.
    pub timestamp: Option<DateTime>,
    /// Refines the timestamp, in units of 10 ps.
    pub picoseconds: Option<u16>,
    /// Upper half of a StatusCode, see [`StatusCode::from_status`](crate::StatusCode::from_status).
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
    /// The changed fields (OPC 10000-14, 7.2.4.5.6). Its fields are not read.
    DeltaFrame,
    /// The fields of one event (OPC 10000-14, 7.2.4.5.7). Its fields are not read.
    Event,
    /// A header only: the writer lives and has nothing new (OPC 10000-14, 7.2.4.5.8).
    KeepAlive,
}

/// The fields of a key frame, read one by one.
///
/// Ends after the first `Err`. Zero bytes behind the last field are the padding to a ConfiguredSize
/// (OPC 10000-14, 6.3.1.3.3) and skipped; others are a last [`DecodeError::TrailingBytes`].
#[derive(Debug, Clone)]
pub struct Fields<'a> {
    block: &'a [u8],
    reader: Reader<'a>,
    count: u16,
    left: u16,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FieldEncoding {
    Variant,
    RawData,
    DataValue,
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
    /// Reads the header of a DataSetMessage that stands alone, as reassembled chunks give it. `writer_id` is the
    /// DataSetWriterId of the chunks.
    ///
    /// # Errors
    /// Fails as an item of [`NetworkMessage::messages`](crate::NetworkMessage::messages) does.
    pub fn decode(writer_id: Option<u16>, bytes: &'a [u8]) -> Result<Self, DecodeError> {
        Self::read(writer_id, Reader::new(bytes))
    }

    /// Reads the header of the message that `reader` holds and nothing else.
    #[inline]
    pub(crate) fn read(
        writer_id: Option<u16>,
        mut reader: Reader<'a>,
    ) -> Result<Self, DecodeError> {
        let flags1 = reader.u8("DataSetFlags1")?;
        let valid = flags1 & VALID != 0;
        let head = match Head::read(flags1, &mut reader) {
            Ok(head) => head,
            // Nothing behind a cleared valid bit means anything, not even the flags.
            Err(_) if !valid => Head::INVALID,
            Err(error) => return Err(error),
        };
        if valid && head.kind == MessageKind::KeepAlive {
            check_padding(reader.rest())?;
        }
        let Head {
            header,
            kind,
            encoding,
        } = head;
        Ok(Self {
            writer_id,
            header,
            kind,
            encoding,
            payload: reader,
        })
    }

    /// The fields. A keep-alive and a heartbeat, with or without its FieldCount, have none.
    ///
    /// # Errors
    /// [`DecodeError::Unsupported`] for delta frames, events, and the RawData and DataValue field encodings;
    /// else fails when the FieldCount is cut off or cannot be met by the bytes that follow.
    #[inline]
    pub fn fields(&self) -> Result<Fields<'a>, DecodeError> {
        match (self.kind, self.encoding) {
            (MessageKind::KeepAlive, _) => Ok(Fields::NONE),
            (MessageKind::DeltaFrame, _) => Err(DecodeError::Unsupported("delta frame")),
            (MessageKind::Event, _) => Err(DecodeError::Unsupported("event message")),
            (MessageKind::KeyFrame, FieldEncoding::RawData) => {
                Err(DecodeError::Unsupported("RawData field encoding"))
            }
            (MessageKind::KeyFrame, FieldEncoding::DataValue) => {
                Err(DecodeError::Unsupported("DataValue field encoding"))
            }
            // open62541 leaves out the FieldCount of a heartbeat, the tables of the standard do not.
            (MessageKind::KeyFrame, FieldEncoding::Variant) if self.payload.remaining() == 0 => {
                Ok(Fields::NONE)
            }
            (MessageKind::KeyFrame, FieldEncoding::Variant) => Fields::parse(self.payload.rest()),
        }
    }
}

impl<'a> Fields<'a> {
    const NONE: Self = Self {
        block: &[0, 0],
        reader: Reader::new(&[]),
        count: 0,
        left: 0,
    };

    /// Reads a block as [`bytes`](Self::bytes) gives it: FieldCount (UInt16) and so many Variants.
    ///
    /// # Errors
    /// Fails when the FieldCount is cut off or above the number of bytes that follow.
    #[inline]
    pub fn parse(block: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(block);
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

    /// FieldCount, however many fields were read already.
    #[inline]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.count as usize
    }

    /// True without fields: a heartbeat or keep-alive.
    #[inline]
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The whole block as on the wire, unchecked: FieldCount, Variants, and padding where there is some.
    #[inline]
    #[must_use]
    pub const fn bytes(&self) -> &'a [u8] {
        self.block
    }

    /// Reads all fields to the end; the block without padding.
    ///
    /// # Errors
    /// Fails as the first field that cannot be read does.
    pub fn checked_bytes(&self) -> Result<&'a [u8], DecodeError> {
        let start = Reader::new(self.block);
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
                    self.reader = Reader::new(&[]);
                }
                Some(field)
            }
            None => {
                let padding = self.reader.rest();
                self.reader = Reader::new(&[]);
                check_padding(padding).err().map(Err)
            }
        }
    }
}

impl std::iter::FusedIterator for Fields<'_> {}

struct Head {
    header: DataSetHeader,
    kind: MessageKind,
    encoding: FieldEncoding,
}

impl Head {
    const INVALID: Self = Self {
        header: DataSetHeader {
            valid: false,
            sequence_number: None,
            timestamp: None,
            picoseconds: None,
            status: None,
            major_version: None,
            minor_version: None,
        },
        kind: MessageKind::KeyFrame,
        encoding: FieldEncoding::Variant,
    };

    #[inline]
    fn read(flags1: u8, reader: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let flags2 = match flags1 & FLAGS2 {
            0 => 0,
            _ => reader.u8("DataSetFlags2")?,
        };
        let encoding = match flags1 & FIELD_ENCODING {
            0x00 => FieldEncoding::Variant,
            0x02 => FieldEncoding::RawData,
            0x04 => FieldEncoding::DataValue,
            _ => {
                return Err(DecodeError::Reserved {
                    field: "field encoding",
                    value: 3,
                });
            }
        };
        let kind = read_kind(flags2)?;
        let sequence_number = match flags1 & SEQUENCE_NUMBER {
            0 => None,
            _ => Some(reader.u16("DataSetMessageSequenceNumber")?),
        };
        let timestamp = match flags2 & TIMESTAMP {
            0 => None,
            _ => Some(DateTime(reader.i64("DataSetMessage Timestamp")?)),
        };
        let picoseconds = match flags2 & PICOSECONDS {
            0 => None,
            _ => Some(reader.u16("DataSetMessage PicoSeconds")?),
        };
        let status = match flags1 & STATUS {
            0 => None,
            _ => Some(reader.u16("DataSetMessage Status")?),
        };
        let major_version = match flags1 & MAJOR_VERSION {
            0 => None,
            _ => Some(reader.u32("ConfigurationVersion MajorVersion")?),
        };
        let minor_version = match flags1 & MINOR_VERSION {
            0 => None,
            _ => Some(reader.u32("ConfigurationVersion MinorVersion")?),
        };
        let header = DataSetHeader {
            valid: flags1 & VALID != 0,
            sequence_number,
            timestamp,
            picoseconds,
            status,
            major_version,
            minor_version,
        };
        Ok(Self {
            header,
            kind,
            encoding,
        })
    }
}

#[inline]
fn read_kind(flags2: u8) -> Result<MessageKind, DecodeError> {
    let reserved = flags2 & FLAGS2_RESERVED;
    if reserved != 0 {
        return Err(DecodeError::Reserved {
            field: "DataSetFlags2",
            value: reserved.into(),
        });
    }
    match flags2 & KIND {
        KIND_KEY_FRAME => Ok(MessageKind::KeyFrame),
        1 => Ok(MessageKind::DeltaFrame),
        2 => Ok(MessageKind::Event),
        KIND_KEEP_ALIVE => Ok(MessageKind::KeepAlive),
        4 | 5 => Err(DecodeError::Unsupported("Action")),
        kind => Err(DecodeError::Reserved {
            field: "DataSetMessage type",
            value: kind.into(),
        }),
    }
}

/// What stands behind the end of a message may only be the zero padding to its ConfiguredSize.
#[inline]
fn check_padding(rest: &[u8]) -> Result<(), DecodeError> {
    match rest.iter().all(|byte| *byte == 0) {
        true => Ok(()),
        false => Err(DecodeError::TrailingBytes(rest.len())),
    }
}

pub(crate) const VALID: u8 = 0x01;
const FIELD_ENCODING: u8 = 0x06;
pub(crate) const SEQUENCE_NUMBER: u8 = 0x08;
pub(crate) const STATUS: u8 = 0x10;
pub(crate) const MAJOR_VERSION: u8 = 0x20;
pub(crate) const MINOR_VERSION: u8 = 0x40;
pub(crate) const FLAGS2: u8 = 0x80;

const KIND: u8 = 0x0F;
pub(crate) const KIND_KEY_FRAME: u8 = 0;
pub(crate) const KIND_KEEP_ALIVE: u8 = 3;
pub(crate) const TIMESTAMP: u8 = 0x10;
pub(crate) const PICOSECONDS: u8 = 0x20;
const FLAGS2_RESERVED: u8 = 0xC0;
