//! NetworkMessage: the header of a datagram, and where its DataSetMessages lie.

use crate::reader::Reader;
use crate::{DataSetMessage, DateTime, DecodeError, Guid};

/// A datagram whose headers were read (OPC 10000-14, 7.2.4.4.2). Its DataSetMessages are read on demand.
///
/// Message security, chunks, PromotedFields, discovery messages and Actions are [`DecodeError::Unsupported`].
#[derive(Debug, Clone)]
pub struct NetworkMessage<'a> {
    header: NetworkHeader<'a>,
    writer_ids: Option<&'a [[u8; 2]]>,
    payload: Reader<'a>,
}

/// The header fields before the payload. What is `None` is not on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NetworkHeader<'a> {
    /// Who sends.
    pub publisher_id: Option<PublisherId<'a>>,
    /// DataSetClass all DataSetMessages belong to.
    pub data_set_class_id: Option<Guid>,
    /// The group header.
    pub group: Option<GroupHeader>,
    /// When the NetworkMessage was made.
    pub timestamp: Option<DateTime>,
    /// Refines the timestamp, in units of 10 ps.
    pub picoseconds: Option<u16>,
}

/// Identity of a publisher; equal only with equal type and value (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[expect(missing_docs, reason = "the names are those of the builtin types")]
pub enum PublisherId<'a> {
    Byte(u8),
    UInt16(u16),
    UInt32(u32),
    UInt64(u64),
    String(&'a str),
}

/// The group header (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct GroupHeader {
    /// WriterGroup within the publisher.
    pub writer_group_id: Option<u16>,
    /// VersionTime of the layout: seconds since 2000-01-01 UTC.
    pub group_version: Option<u32>,
    /// Number of this NetworkMessage among those of one publishing interval.
    pub network_message_number: Option<u16>,
    /// Counts the NetworkMessages of the WriterGroup.
    pub sequence_number: Option<u16>,
}

/// The DataSetMessages of a [`NetworkMessage`], in the order of the DataSetWriterIds.
///
/// With several messages a malformed one is an `Err` in its place and the next ones follow.
/// Sizes that reach past the datagram end the iteration with one `Err`, as do bytes that belong to no message.
#[derive(Debug, Clone)]
pub struct Messages<'a> {
    step: Step<'a>,
    payload: Reader<'a>,
}

#[derive(Debug, Clone)]
enum Step<'a> {
    /// One message takes the whole payload.
    Single {
        writer_id: Option<u16>,
    },
    /// Count is above one: the payload starts with the Sizes, one per DataSetWriterId.
    Sizes {
        writer_ids: &'a [[u8; 2]],
    },
    Sized {
        writer_ids: &'a [[u8; 2]],
        sizes: &'a [[u8; 2]],
    },
    Done,
}

impl<'a> NetworkMessage<'a> {
    /// Reads the headers of a datagram.
    ///
    /// # Errors
    /// Fails when a header is cut off, uses a reserved value, or announces what this crate does not read.
    pub fn decode(datagram: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = Reader::new(datagram);
        let flags = Flags::read(&mut reader)?;
        let publisher_id = match flags.uadp & PUBLISHER_ID {
            0 => None,
            _ => Some(PublisherId::read(
                flags.extended1 & PUBLISHER_ID_TYPE,
                &mut reader,
            )?),
        };
        let data_set_class_id = match flags.extended1 & DATA_SET_CLASS_ID {
            0 => None,
            _ => Some(Guid(reader.array("DataSetClassId")?)),
        };
        let group = match flags.uadp & GROUP_HEADER {
            0 => None,
            _ => Some(GroupHeader::read(&mut reader)?),
        };
        let writer_ids = match flags.uadp & PAYLOAD_HEADER {
            0 => None,
            _ => Some(read_writer_ids(&mut reader)?),
        };
        let timestamp = match flags.extended1 & TIMESTAMP {
            0 => None,
            _ => Some(DateTime(reader.i64("Timestamp")?)),
        };
        let picoseconds = match flags.extended1 & PICOSECONDS {
            0 => None,
            _ => Some(reader.u16("PicoSeconds")?),
        };
        let header = NetworkHeader {
            publisher_id,
            data_set_class_id,
            group,
            timestamp,
            picoseconds,
        };
        Ok(Self {
            header,
            writer_ids,
            payload: reader,
        })
    }

    /// The header fields.
    #[inline]
    #[must_use]
    pub const fn header(&self) -> &NetworkHeader<'a> {
        &self.header
    }

    /// DataSetWriterIds of the payload header, at least one; `None` without payload header.
    #[inline]
    #[must_use]
    pub fn writer_ids(&self) -> Option<impl ExactSizeIterator<Item = u16> + Clone + use<'a>> {
        self.writer_ids
            .map(|ids| ids.iter().map(|id| u16::from_le_bytes(*id)))
    }

    /// The DataSetMessages. Without payload header that is one, without a DataSetWriterId.
    #[inline]
    #[must_use]
    pub const fn messages(&self) -> Messages<'a> {
        let step = match self.writer_ids {
            None => Step::Single { writer_id: None },
            Some([id]) => Step::Single {
                writer_id: Some(u16::from_le_bytes(*id)),
            },
            Some(writer_ids) => Step::Sizes { writer_ids },
        };
        Messages {
            step,
            payload: self.payload,
        }
    }
}

impl<'a> Iterator for Messages<'a> {
    type Item = Result<DataSetMessage<'a>, DecodeError>;

    #[inline]
    fn next(&mut self) -> Option<Self::Item> {
        match self.step {
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
            return match self.payload.remaining() {
                0 => None,
                left => Some(Err(DecodeError::TrailingBytes(left))),
            };
        };
        let size = u16::from_le_bytes(*size).into();
        let message = match self.payload.bytes(size, "DataSetMessage") {
            Ok(message) => message,
            Err(error) => return Some(Err(error)),
        };
        self.step = Step::Sized { writer_ids, sizes };
        let writer_id = u16::from_le_bytes(*writer_id);
        Some(DataSetMessage::read(Some(writer_id), Reader::new(message)))
    }
}

impl std::iter::FusedIterator for Messages<'_> {}

/// The first one to three bytes; a byte left out is 0.
struct Flags {
    uadp: u8,
    extended1: u8,
}

impl Flags {
    fn read(reader: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let uadp = reader.u8("UADPFlags")?;
        if uadp & VERSION_MASK != VERSION {
            return Err(DecodeError::Reserved {
                field: "UADPVersion",
                value: (uadp & VERSION_MASK).into(),
            });
        }
        let extended1 = match uadp & EXTENDED_FLAGS1 {
            0 => 0,
            _ => reader.u8("ExtendedFlags1")?,
        };
        let publisher_id_type = extended1 & PUBLISHER_ID_TYPE;
        if publisher_id_type > PUBLISHER_ID_STRING {
            return Err(DecodeError::Reserved {
                field: "PublisherId type",
                value: publisher_id_type.into(),
            });
        }
        let extended2 = match extended1 & EXTENDED_FLAGS2 {
            0 => 0,
            _ => reader.u8("ExtendedFlags2")?,
        };
        check_extended_flags2(extended2)?;
        if extended1 & SECURITY != 0 {
            return Err(DecodeError::Unsupported("message security"));
        }
        Ok(Self { uadp, extended1 })
    }
}

fn check_extended_flags2(flags: u8) -> Result<(), DecodeError> {
    match (flags & MESSAGE_TYPE) >> 2 {
        0 => {}
        1 => return Err(DecodeError::Unsupported("discovery probe")),
        2 => return Err(DecodeError::Unsupported("discovery announcement")),
        reserved => {
            return Err(DecodeError::Reserved {
                field: "NetworkMessage type",
                value: reserved.into(),
            });
        }
    }
    let reserved = flags & EXTENDED2_RESERVED;
    if reserved != 0 {
        return Err(DecodeError::Reserved {
            field: "ExtendedFlags2",
            value: reserved.into(),
        });
    }
    if flags & CHUNK != 0 {
        return Err(DecodeError::Unsupported("chunk"));
    }
    if flags & PROMOTED_FIELDS != 0 {
        return Err(DecodeError::Unsupported("PromotedFields"));
    }
    if flags & ACTION_HEADER != 0 {
        return Err(DecodeError::Unsupported("Action"));
    }
    Ok(())
}

impl<'a> PublisherId<'a> {
    fn read(id_type: u8, reader: &mut Reader<'a>) -> Result<Self, DecodeError> {
        Ok(match id_type {
            PUBLISHER_ID_BYTE => Self::Byte(reader.u8("PublisherId")?),
            PUBLISHER_ID_UINT16 => Self::UInt16(reader.u16("PublisherId")?),
            PUBLISHER_ID_UINT32 => Self::UInt32(reader.u32("PublisherId")?),
            PUBLISHER_ID_UINT64 => Self::UInt64(u64::from_le_bytes(reader.array("PublisherId")?)),
            _ => match reader.text("PublisherId")? {
                Some(text) => Self::String(text),
                // A null String names no publisher.
                None => {
                    return Err(DecodeError::Reserved {
                        field: "PublisherId length",
                        value: u32::MAX,
                    });
                }
            },
        })
    }

    pub(crate) const fn type_bits(&self) -> u8 {
        match self {
            Self::Byte(_) => PUBLISHER_ID_BYTE,
            Self::UInt16(_) => PUBLISHER_ID_UINT16,
            Self::UInt32(_) => PUBLISHER_ID_UINT32,
            Self::UInt64(_) => PUBLISHER_ID_UINT64,
            Self::String(_) => PUBLISHER_ID_STRING,
        }
    }
}

impl GroupHeader {
    fn read(reader: &mut Reader<'_>) -> Result<Self, DecodeError> {
        let flags = reader.u8("GroupFlags")?;
        let reserved = flags
            & !(WRITER_GROUP_ID | GROUP_VERSION | NETWORK_MESSAGE_NUMBER | GROUP_SEQUENCE_NUMBER);
        if reserved != 0 {
            return Err(DecodeError::Reserved {
                field: "GroupFlags",
                value: reserved.into(),
            });
        }
        let writer_group_id = match flags & WRITER_GROUP_ID {
            0 => None,
            _ => Some(reader.u16("WriterGroupId")?),
        };
        let group_version = match flags & GROUP_VERSION {
            0 => None,
            _ => Some(reader.u32("GroupVersion")?),
        };
        let network_message_number = match flags & NETWORK_MESSAGE_NUMBER {
            0 => None,
            _ => Some(reader.u16("NetworkMessageNumber")?),
        };
        let sequence_number = match flags & GROUP_SEQUENCE_NUMBER {
            0 => None,
            _ => Some(reader.u16("SequenceNumber")?),
        };
        Ok(Self {
            writer_group_id,
            group_version,
            network_message_number,
            sequence_number,
        })
    }
}

/// Count, never 0 (OPC 10000-14, 7.2.4.5.2), and DataSetWriterIds.
fn read_writer_ids<'a>(reader: &mut Reader<'a>) -> Result<&'a [[u8; 2]], DecodeError> {
    match reader.u8("DataSetMessage Count")? {
        0 => Err(DecodeError::Reserved {
            field: "DataSetMessage Count",
            value: 0,
        }),
        count => reader.u16s(count, "DataSetWriterIds"),
    }
}

pub(crate) const VERSION: u8 = 1;
const VERSION_MASK: u8 = 0x0F;
pub(crate) const PUBLISHER_ID: u8 = 0x10;
pub(crate) const GROUP_HEADER: u8 = 0x20;
pub(crate) const PAYLOAD_HEADER: u8 = 0x40;
pub(crate) const EXTENDED_FLAGS1: u8 = 0x80;

const PUBLISHER_ID_TYPE: u8 = 0x07;
const PUBLISHER_ID_BYTE: u8 = 0;
const PUBLISHER_ID_UINT16: u8 = 1;
const PUBLISHER_ID_UINT32: u8 = 2;
const PUBLISHER_ID_UINT64: u8 = 3;
const PUBLISHER_ID_STRING: u8 = 4;
pub(crate) const DATA_SET_CLASS_ID: u8 = 0x08;
const SECURITY: u8 = 0x10;
pub(crate) const TIMESTAMP: u8 = 0x20;
pub(crate) const PICOSECONDS: u8 = 0x40;
const EXTENDED_FLAGS2: u8 = 0x80;

const CHUNK: u8 = 0x01;
const PROMOTED_FIELDS: u8 = 0x02;
const MESSAGE_TYPE: u8 = 0x1C;
const ACTION_HEADER: u8 = 0x20;
const EXTENDED2_RESERVED: u8 = 0xC0;

pub(crate) const WRITER_GROUP_ID: u8 = 0x01;
pub(crate) const GROUP_VERSION: u8 = 0x02;
pub(crate) const NETWORK_MESSAGE_NUMBER: u8 = 0x04;
pub(crate) const GROUP_SEQUENCE_NUMBER: u8 = 0x08;
