//! Encodes the headers of a NetworkMessage. The flags follow from the present fields.

use crate::header::{
    self, GroupHeader, NetworkHeader, NetworkMessageType, PublisherId, SecurityHeader,
};
use crate::writer::{self, ReservedSpace, flag};
use crate::{EncodeError, Variant};
use alloc::vec::Vec;

/// Rarely used headers of NetworkMessages. The default has no such headers.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Extras<'a> {
    /// Values repeated from the DataSet so that brokers can filter by them; only with a single
    /// DataSetMessage (OPC 10000-14, 7.2.4.4.2).
    pub promoted_fields: Option<&'a [Variant<'a>]>,
    /// The SecurityHeader.
    pub security: Option<SecurityHeader<'a>>,
}

/// Form of the payload header.
#[derive(Debug, Clone, Copy)]
pub(crate) enum PayloadHeader<'a> {
    None,
    /// Count and DataSetWriterIds.
    Count(&'a [u16]),
    /// DataSetWriterId of a chunk, without Count.
    Chunk(u16),
}

/// Properties of a NetworkMessage that differ from a plain message with DataSetMessages.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MessageForm<'a> {
    pub(crate) message_type: NetworkMessageType,
    pub(crate) chunk: bool,
    /// The payload starts with an ActionHeader.
    pub(crate) action: bool,
    pub(crate) extras: &'a Extras<'a>,
}

/// Maximum number of contiguous bytes of fixed size: flags, PublisherId, DataSetClassId, group
/// header, a single DataSetWriterId, Timestamp and PicoSeconds.
const ROOM: usize = 64;
type Fixed<'b> = ReservedSpace<'b, ROOM>;

/// Appends all headers before the payload. Returns the offset of the Timestamp, if there is a
/// Timestamp.
#[inline]
pub(crate) fn write(
    buf: &mut Vec<u8>,
    header: &NetworkHeader<'_>,
    payload_header: PayloadHeader<'_>,
    form: MessageForm<'_>,
) -> Result<Option<usize>, EncodeError> {
    let start = buf.len();
    let timestamp_at = match (header.publisher_id, payload_header) {
        (Some(PublisherId::String(_)), _) | (_, PayloadHeader::Count([] | [_, _, ..])) => {
            write_in_parts(buf, header, payload_header, form)?
        }
        _ => writer::with_room(buf, |fixed| {
            write_flags(fixed, header, payload_header, form);
            write_ids(fixed, header);
            write_writer_id(fixed, payload_header);
            write_times(fixed, header).map(|at| start + at)
        })
        .flatten(),
    };
    if let Some(fields) = form.extras.promoted_fields {
        write_promoted_fields(buf, fields)?;
    }
    if let Some(security) = &form.extras.security {
        security.write(buf)?;
    }
    Ok(timestamp_at)
}

/// Appends the headers as [`write`], for a PublisherId of type String or a number of
/// DataSetWriterIds other than 1.
#[cold]
fn write_in_parts(
    buf: &mut Vec<u8>,
    header: &NetworkHeader<'_>,
    payload_header: PayloadHeader<'_>,
    form: MessageForm<'_>,
) -> Result<Option<usize>, EncodeError> {
    writer::with_room(buf, |fixed| {
        write_flags(fixed, header, payload_header, form);
    });
    if let Some(PublisherId::String(id)) = header.publisher_id {
        writer::byte_string(buf, Some(id.as_bytes()), "PublisherId")?;
    }
    writer::with_room(buf, |fixed| write_ids(fixed, header));
    match payload_header {
        PayloadHeader::Count(ids @ ([] | [_, _, ..])) => write_writer_ids(buf, ids)?,
        PayloadHeader::None | PayloadHeader::Count(_) | PayloadHeader::Chunk(_) => {
            writer::with_room(buf, |fixed: &mut Fixed<'_>| {
                write_writer_id(fixed, payload_header);
            });
        }
    }
    let start = buf.len();
    let timestamp = writer::with_room(buf, |fixed| write_times(fixed, header));
    Ok(timestamp.flatten().map(|at| start + at))
}

/// Appends PublisherId unless it is a String, DataSetClassId and group header.
#[inline]
fn write_ids(fixed: &mut Fixed<'_>, header: &NetworkHeader<'_>) {
    match header.publisher_id {
        None | Some(PublisherId::String(_)) => {}
        Some(PublisherId::Byte(id)) => fixed.put([id]),
        Some(PublisherId::UInt16(id)) => fixed.put(id.to_le_bytes()),
        Some(PublisherId::UInt32(id)) => fixed.put(id.to_le_bytes()),
        Some(PublisherId::UInt64(id)) => fixed.put(id.to_le_bytes()),
    }
    if let Some(class_id) = header.data_set_class_id {
        fixed.put(class_id.0);
    }
    if let Some(group) = &header.group {
        write_group_header(fixed, group);
    }
}

#[inline]
fn write_writer_id(fixed: &mut Fixed<'_>, payload_header: PayloadHeader<'_>) {
    match payload_header {
        PayloadHeader::Count(&[id]) => {
            let [low, high] = id.to_le_bytes();
            fixed.put([1, low, high]);
        }
        PayloadHeader::Chunk(id) => fixed.put(id.to_le_bytes()),
        PayloadHeader::None | PayloadHeader::Count(_) => {}
    }
}

/// Appends Timestamp and PicoSeconds. Returns the offset of the Timestamp.
#[inline]
fn write_times(fixed: &mut Fixed<'_>, header: &NetworkHeader<'_>) -> Option<usize> {
    let at = header.timestamp.map(|timestamp| {
        let at = fixed.len();
        fixed.put(timestamp.0.to_le_bytes());
        at
    });
    if let Some(picoseconds) = header.picoseconds {
        fixed.put(picoseconds.to_le_bytes());
    }
    at
}

#[inline]
fn write_flags(
    fixed: &mut Fixed<'_>,
    header: &NetworkHeader<'_>,
    payload_header: PayloadHeader<'_>,
    form: MessageForm<'_>,
) {
    let extended2 = flag(form.chunk, header::CHUNK)
        | flag(form.action, header::ACTION_HEADER)
        | flag(
            form.extras.promoted_fields.is_some(),
            header::PROMOTED_FIELDS,
        )
        | match form.message_type {
            NetworkMessageType::DataSet => 0,
            NetworkMessageType::Probe => header::PROBE,
            NetworkMessageType::Announcement => header::ANNOUNCEMENT,
        };
    let extended1 = header.publisher_id.map_or(0, |id| id.type_bits())
        | flag(
            header.data_set_class_id.is_some(),
            header::DATA_SET_CLASS_ID,
        )
        | flag(form.extras.security.is_some(), header::SECURITY)
        | flag(header.timestamp.is_some(), header::TIMESTAMP)
        | flag(header.picoseconds.is_some(), header::PICOSECONDS)
        | flag(extended2 != 0, header::EXTENDED_FLAGS2);
    let uadp = header::VERSION
        | flag(header.publisher_id.is_some(), header::PUBLISHER_ID)
        | flag(header.group.is_some(), header::GROUP_HEADER)
        | flag(
            !matches!(payload_header, PayloadHeader::None),
            header::PAYLOAD_HEADER,
        )
        | flag(extended1 != 0, header::EXTENDED_FLAGS1);
    fixed.put([uadp]);
    if extended1 != 0 {
        fixed.put([extended1]);
    }
    if extended2 != 0 {
        fixed.put([extended2]);
    }
}

#[inline]
fn write_group_header(fixed: &mut Fixed<'_>, group: &GroupHeader) {
    fixed.put([
        flag(group.writer_group_id.is_some(), header::WRITER_GROUP_ID)
            | flag(group.group_version.is_some(), header::GROUP_VERSION)
            | flag(
                group.network_message_number.is_some(),
                header::NETWORK_MESSAGE_NUMBER,
            )
            | flag(
                group.sequence_number.is_some(),
                header::GROUP_SEQUENCE_NUMBER,
            ),
    ]);
    if let Some(id) = group.writer_group_id {
        fixed.put(id.to_le_bytes());
    }
    if let Some(version) = group.group_version {
        fixed.put(version.to_le_bytes());
    }
    if let Some(number) = group.network_message_number {
        fixed.put(number.to_le_bytes());
    }
    if let Some(number) = group.sequence_number {
        fixed.put(number.to_le_bytes());
    }
}

/// Appends Count and DataSetWriterIds; a single id is handled by `write_writer_id`.
fn write_writer_ids(buf: &mut Vec<u8>, ids: &[u16]) -> Result<(), EncodeError> {
    let count = u8::try_from(ids.len()).map_err(|_| EncodeError::TooBig {
        what: "DataSetWriterIds",
        len: ids.len(),
    })?;
    if count == 0 {
        return Err(EncodeError::MessageCount {
            announced: 0,
            written: 0,
        });
    }
    buf.push(count);
    for id in ids {
        buf.extend_from_slice(&id.to_le_bytes());
    }
    Ok(())
}

#[cold]
fn write_promoted_fields(buf: &mut Vec<u8>, fields: &[Variant<'_>]) -> Result<(), EncodeError> {
    let size_at = buf.len();
    buf.extend_from_slice(&[0; 2]);
    for field in fields {
        field.write(buf)?;
    }
    let len = buf.len() - size_at - 2;
    let size = u16::try_from(len).map_err(|_| EncodeError::TooBig {
        what: "PromotedFields",
        len,
    })?;
    writer::patch(buf, size_at, size.to_le_bytes());
    Ok(())
}

impl SecurityHeader<'_> {
    pub(crate) fn write(&self, buf: &mut Vec<u8>) -> Result<(), EncodeError> {
        let nonce_length = u8::try_from(self.nonce.len()).map_err(|_| EncodeError::TooBig {
            what: "MessageNonce",
            len: self.nonce.len(),
        })?;
        buf.push(
            flag(self.signed, header::SIGNED)
                | flag(self.encrypted, header::ENCRYPTED)
                | flag(self.footer_size.is_some(), header::FOOTER)
                | flag(self.force_key_reset, header::KEY_RESET),
        );
        buf.extend_from_slice(&self.token_id.to_le_bytes());
        buf.push(nonce_length);
        buf.extend_from_slice(self.nonce);
        if let Some(size) = self.footer_size {
            buf.extend_from_slice(&size.to_le_bytes());
        }
        Ok(())
    }
}
