//! Writing the headers of a NetworkMessage. Which flags are set follows from what there is to write.

use crate::header::{
    self, GroupHeader, NetworkHeader, NetworkMessageType, PublisherId, SecurityHeader,
};
use crate::writer::{self, flag};
use crate::{EncodeError, Variant};

/// The headers few NetworkMessages have. The default has none.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Extras<'a> {
    /// Values repeated from the DataSet so that brokers can filter by them; only with a single DataSetMessage
    /// (OPC 10000-14, 7.2.4.4.2).
    pub promoted_fields: Option<&'a [Variant<'a>]>,
    /// The SecurityHeader.
    pub security: Option<SecurityHeader<'a>>,
}

/// What names the DataSetWriters.
#[derive(Debug, Clone, Copy)]
pub(crate) enum PayloadHeader<'a> {
    None,
    /// Count and DataSetWriterIds.
    Count(&'a [u16]),
    /// The bare DataSetWriterId of a chunk.
    Chunk(u16),
}

/// What a NetworkMessage is besides a plain one with DataSetMessages.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Form<'a> {
    pub(crate) message_type: NetworkMessageType,
    pub(crate) chunk: bool,
    pub(crate) extras: &'a Extras<'a>,
}

/// Appends everything before the payload; the position of the Timestamp, if there is one.
#[inline]
pub(crate) fn write(
    buf: &mut Vec<u8>,
    header: &NetworkHeader<'_>,
    payload_header: PayloadHeader<'_>,
    form: Form<'_>,
) -> Result<Option<usize>, EncodeError> {
    write_flags(buf, header, payload_header, form);
    if let Some(publisher_id) = &header.publisher_id {
        write_publisher_id(buf, publisher_id)?;
    }
    if let Some(class_id) = header.data_set_class_id {
        buf.extend_from_slice(&class_id.0);
    }
    if let Some(group) = &header.group {
        write_group_header(buf, group);
    }
    match payload_header {
        PayloadHeader::None => {}
        PayloadHeader::Count(ids) => write_payload_header(buf, ids)?,
        PayloadHeader::Chunk(id) => buf.extend_from_slice(&id.to_le_bytes()),
    }
    let timestamp_at = header.timestamp.map(|timestamp| {
        let at = buf.len();
        buf.extend_from_slice(&timestamp.0.to_le_bytes());
        at
    });
    if let Some(picoseconds) = header.picoseconds {
        buf.extend_from_slice(&picoseconds.to_le_bytes());
    }
    if let Some(fields) = form.extras.promoted_fields {
        write_promoted_fields(buf, fields)?;
    }
    if let Some(security) = &form.extras.security {
        security.write(buf)?;
    }
    Ok(timestamp_at)
}

#[inline]
fn write_flags(
    buf: &mut Vec<u8>,
    header: &NetworkHeader<'_>,
    payload_header: PayloadHeader<'_>,
    form: Form<'_>,
) {
    let extended2 = flag(form.chunk, header::CHUNK)
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
    match (extended1, extended2) {
        (0, _) => buf.push(uadp),
        (_, 0) => buf.extend_from_slice(&[uadp, extended1]),
        _ => buf.extend_from_slice(&[uadp, extended1, extended2]),
    }
}

#[inline]
fn write_publisher_id(buf: &mut Vec<u8>, id: &PublisherId<'_>) -> Result<(), EncodeError> {
    match *id {
        PublisherId::Byte(id) => buf.push(id),
        PublisherId::UInt16(id) => buf.extend_from_slice(&id.to_le_bytes()),
        PublisherId::UInt32(id) => buf.extend_from_slice(&id.to_le_bytes()),
        PublisherId::UInt64(id) => buf.extend_from_slice(&id.to_le_bytes()),
        PublisherId::String(id) => {
            return writer::byte_string(buf, Some(id.as_bytes()), "PublisherId");
        }
    }
    Ok(())
}

#[inline]
fn write_group_header(buf: &mut Vec<u8>, group: &GroupHeader) {
    buf.push(
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
    );
    if let Some(id) = group.writer_group_id {
        buf.extend_from_slice(&id.to_le_bytes());
    }
    if let Some(version) = group.group_version {
        buf.extend_from_slice(&version.to_le_bytes());
    }
    if let Some(number) = group.network_message_number {
        buf.extend_from_slice(&number.to_le_bytes());
    }
    if let Some(number) = group.sequence_number {
        buf.extend_from_slice(&number.to_le_bytes());
    }
}

#[inline]
fn write_payload_header(buf: &mut Vec<u8>, ids: &[u16]) -> Result<(), EncodeError> {
    if let [id] = ids {
        let [low, high] = id.to_le_bytes();
        buf.extend_from_slice(&[1, low, high]);
        return Ok(());
    }
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
    fn write(&self, buf: &mut Vec<u8>) -> Result<(), EncodeError> {
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
