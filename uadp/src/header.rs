//! The headers of a NetworkMessage and their flags.

use crate::reader::ByteReader;
use crate::{DateTime, DecodeError, Guid};

/// The header fields before the payload. Fields that are `None` are not encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NetworkHeader<'a> {
    /// The publisher.
    pub publisher_id: Option<PublisherId<'a>>,
    /// DataSetClass of all DataSetMessages.
    pub data_set_class_id: Option<Guid>,
    /// The group header.
    pub group: Option<GroupHeader>,
    /// Time at which the NetworkMessage was created.
    pub timestamp: Option<DateTime>,
    /// Part of the timestamp below its resolution, in units of 10 ps.
    pub picoseconds: Option<u16>,
}

/// The SecurityHeader, which is never encrypted (OPC 10000-14, 7.2.4.4.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub struct SecurityHeader<'a> {
    /// The message ends with a signature of all its bytes.
    pub signed: bool,
    /// Payload and footer are encrypted.
    pub encrypted: bool,
    /// The publisher requests new keys before the lifetime of the present keys ends.
    pub force_key_reset: bool,
    /// SecurityTokenId of the keys; 0 in a message that is neither signed nor encrypted.
    pub token_id: u32,
    /// MessageNonce: with the AES-CTR policies 4 random bytes and a UInt32 sequence number.
    pub nonce: &'a [u8],
    /// Size of the SecurityFooter in bytes, `None` if not enabled. The AES-CTR policies have no
    /// footer.
    pub footer_size: Option<u16>,
}

/// Type of a NetworkMessage, ExtendedFlags2 bits 2 to 4 (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub enum NetworkMessageType {
    /// DataSetMessages.
    #[default]
    DataSet,
    /// Discovery probe; the discovery request of version 1.04.
    Probe,
    /// Discovery announcement; the discovery response of version 1.04.
    Announcement,
}

/// Identity of a publisher. Two ids are equal if their type and value are equal (OPC 10000-14,
/// 7.2.4.4.2).
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
    /// Number of this NetworkMessage within a publishing interval.
    pub network_message_number: Option<u16>,
    /// Sequence number of the NetworkMessages of the WriterGroup.
    pub sequence_number: Option<u16>,
}

/// The first one to three bytes; an omitted byte is 0.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HeaderFlags {
    pub(crate) uadp: u8,
    pub(crate) extended1: u8,
    pub(crate) extended2: u8,
}

impl HeaderFlags {
    #[inline]
    pub(crate) fn read(reader: &mut ByteReader<'_>) -> Result<Self, DecodeError> {
        let uadp = reader.u8("UADPFlags")?;
        if uadp & VERSION_MASK != VERSION {
            return Err(reserved("UADPVersion", uadp & VERSION_MASK));
        }
        let extended1 = match uadp & EXTENDED_FLAGS1 {
            0 => 0,
            _ => reader.u8("ExtendedFlags1")?,
        };
        let publisher_id_type = extended1 & PUBLISHER_ID_TYPE;
        if publisher_id_type > PUBLISHER_ID_STRING {
            return Err(reserved("PublisherId type", publisher_id_type));
        }
        let extended2 = match extended1 & EXTENDED_FLAGS2 {
            0 => 0,
            _ => read_extended_flags2(reader)?,
        };
        Ok(Self {
            uadp,
            extended1,
            extended2,
        })
    }

    pub(crate) const fn message_type(&self) -> NetworkMessageType {
        match self.extended2 & MESSAGE_TYPE {
            PROBE => NetworkMessageType::Probe,
            ANNOUNCEMENT => NetworkMessageType::Announcement,
            _ => NetworkMessageType::DataSet,
        }
    }
}

fn read_extended_flags2(reader: &mut ByteReader<'_>) -> Result<u8, DecodeError> {
    let flags = reader.u8("ExtendedFlags2")?;
    if flags & EXTENDED2_RESERVED != 0 {
        return Err(reserved("ExtendedFlags2", flags & EXTENDED2_RESERVED));
    }
    let message_type = flags & MESSAGE_TYPE;
    if message_type > ANNOUNCEMENT {
        return Err(reserved("NetworkMessage type", message_type >> 2));
    }
    // Requests and responses are DataSetMessages (OPC 10000-14, 7.2.4.2).
    if flags & ACTION_HEADER != 0 && message_type != 0 {
        return Err(reserved("ActionHeader of a discovery message", flags));
    }
    Ok(flags)
}

fn reserved(field: &'static str, value: u8) -> DecodeError {
    DecodeError::Reserved {
        field,
        value: value.into(),
    }
}

impl<'a> PublisherId<'a> {
    /// Skips and checks an id.
    #[inline]
    pub(crate) fn skip(id_type: u8, reader: &mut ByteReader<'a>) -> Result<(), DecodeError> {
        let size = match id_type {
            PUBLISHER_ID_BYTE => 1,
            PUBLISHER_ID_UINT16 => 2,
            PUBLISHER_ID_UINT32 => 4,
            PUBLISHER_ID_UINT64 => 8,
            _ => return Self::read(id_type, reader).map(|_| ()),
        };
        reader.bytes(size, "PublisherId").map(|_| ())
    }

    #[inline]
    pub(crate) fn read(id_type: u8, reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Ok(match id_type {
            PUBLISHER_ID_BYTE => Self::Byte(reader.u8("PublisherId")?),
            PUBLISHER_ID_UINT16 => Self::UInt16(reader.u16("PublisherId")?),
            PUBLISHER_ID_UINT32 => Self::UInt32(reader.u32("PublisherId")?),
            PUBLISHER_ID_UINT64 => Self::UInt64(u64::from_le_bytes(reader.array("PublisherId")?)),
            _ => match reader.text("PublisherId")? {
                Some(text) => Self::String(text),
                // A null String is not a valid PublisherId.
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
    /// Skips and checks a group header.
    #[inline]
    pub(crate) fn skip(reader: &mut ByteReader<'_>) -> Result<(), DecodeError> {
        let mut ahead = *reader;
        let flags = ahead.u8("GroupFlags")?;
        let size = usize::from(flags & WRITER_GROUP_ID) * 2
            + usize::from(flags & GROUP_VERSION) * 2
            + usize::from(flags & NETWORK_MESSAGE_NUMBER) / 2
            + usize::from(flags & GROUP_SEQUENCE_NUMBER) / 4;
        if flags & GROUP_RESERVED == 0 && ahead.bytes(size, "GroupHeader").is_ok() {
            *reader = ahead;
            return Ok(());
        }
        // Decodes field by field, so that the error has the name of the invalid field.
        Self::read(reader).map(|_| ())
    }

    #[inline]
    pub(crate) fn read(reader: &mut ByteReader<'_>) -> Result<Self, DecodeError> {
        let flags = reader.u8("GroupFlags")?;
        let reserved = flags & GROUP_RESERVED;
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

impl<'a> SecurityHeader<'a> {
    /// Header without security, as in unsecured discovery messages (OPC 10000-14, 7.2.4.6).
    pub const NONE: Self = Self {
        signed: false,
        encrypted: false,
        force_key_reset: false,
        token_id: 0,
        nonce: &[],
        footer_size: None,
    };

    /// Returns true if the message is signed or encrypted.
    #[must_use]
    pub const fn is_secured(&self) -> bool {
        self.signed || self.encrypted
    }

    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let flags = reader.u8("SecurityFlags")?;
        let unknown = flags & !(SIGNED | ENCRYPTED | FOOTER | KEY_RESET);
        if unknown != 0 {
            return Err(reserved("SecurityFlags", unknown));
        }
        let token_id = reader.u32("SecurityTokenId")?;
        let nonce_length = reader.u8("NonceLength")?;
        let nonce = reader.bytes(nonce_length.into(), "MessageNonce")?;
        let footer_size = match flags & FOOTER {
            0 => None,
            _ => Some(reader.u16("SecurityFooterSize")?),
        };
        Ok(Self {
            signed: flags & SIGNED != 0,
            encrypted: flags & ENCRYPTED != 0,
            force_key_reset: flags & KEY_RESET != 0,
            token_id,
            nonce,
            footer_size,
        })
    }
}

pub(crate) const VERSION: u8 = 1;
const VERSION_MASK: u8 = 0x0F;
pub(crate) const PUBLISHER_ID: u8 = 0x10;
pub(crate) const GROUP_HEADER: u8 = 0x20;
pub(crate) const PAYLOAD_HEADER: u8 = 0x40;
pub(crate) const EXTENDED_FLAGS1: u8 = 0x80;

pub(crate) const PUBLISHER_ID_TYPE: u8 = 0x07;
const PUBLISHER_ID_BYTE: u8 = 0;
const PUBLISHER_ID_UINT16: u8 = 1;
const PUBLISHER_ID_UINT32: u8 = 2;
const PUBLISHER_ID_UINT64: u8 = 3;
const PUBLISHER_ID_STRING: u8 = 4;
pub(crate) const DATA_SET_CLASS_ID: u8 = 0x08;
pub(crate) const SECURITY: u8 = 0x10;
pub(crate) const TIMESTAMP: u8 = 0x20;
pub(crate) const PICOSECONDS: u8 = 0x40;
pub(crate) const EXTENDED_FLAGS2: u8 = 0x80;

pub(crate) const CHUNK: u8 = 0x01;
pub(crate) const PROMOTED_FIELDS: u8 = 0x02;
const MESSAGE_TYPE: u8 = 0x1C;
pub(crate) const PROBE: u8 = 1 << 2;
pub(crate) const ANNOUNCEMENT: u8 = 2 << 2;
pub(crate) const ACTION_HEADER: u8 = 0x20;
const EXTENDED2_RESERVED: u8 = 0xC0;

pub(crate) const WRITER_GROUP_ID: u8 = 0x01;
pub(crate) const GROUP_VERSION: u8 = 0x02;
pub(crate) const NETWORK_MESSAGE_NUMBER: u8 = 0x04;
pub(crate) const GROUP_SEQUENCE_NUMBER: u8 = 0x08;
const GROUP_RESERVED: u8 = 0xF0;

pub(crate) const SIGNED: u8 = 0x01;
pub(crate) const ENCRYPTED: u8 = 0x02;
pub(crate) const FOOTER: u8 = 0x04;
pub(crate) const KEY_RESET: u8 = 0x08;
