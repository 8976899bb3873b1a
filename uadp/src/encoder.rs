//! Writing a NetworkMessage: headers first, then one DataSetMessage after the other, in one pass.

use crate::data_set_message as message;
use crate::field_encoder::FieldEncoder;
use crate::network_message as network;
use crate::{DataSetHeader, EncodeError, GroupHeader, NetworkHeader, PublisherId, writer};

/// Appends one NetworkMessage to a buffer (OPC 10000-14, 7.2.4.4.2).
///
/// The flags follow from what the headers hold. After an error the buffer holds an unfinished message.
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct NetworkMessageEncoder<'b> {
    buf: &'b mut Vec<u8>,
    progress: Progress,
    timestamp_at: Option<usize>,
}

/// What is finished of the payload.
#[derive(Debug)]
pub(crate) struct Progress {
    /// DataSetMessages the payload header announces.
    announced: usize,
    written: usize,
    /// Where the Sizes start; there are none for a single message.
    sizes_at: Option<usize>,
    /// Where the last finished DataSetMessage ends.
    end: usize,
}

impl Progress {
    /// Counts the DataSetMessage that ends with the buffer and patches its size.
    #[inline]
    pub(crate) fn message_finished(&mut self, buf: &mut [u8]) -> Result<(), EncodeError> {
        if let Some(sizes_at) = self.sizes_at {
            let len = buf.len() - self.end;
            let size = u16::try_from(len).map_err(|_| EncodeError::TooBig {
                what: "DataSetMessage",
                len,
            })?;
            writer::patch(buf, sizes_at + self.written * 2, size.to_le_bytes());
        }
        self.written += 1;
        self.end = buf.len();
        Ok(())
    }
}

impl<'b> NetworkMessageEncoder<'b> {
    /// Appends the headers to `buf`. `writer_ids` make the payload header, one DataSetMessage each;
    /// with `None` there is no payload header and exactly one DataSetMessage.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] when `writer_ids` is empty, [`EncodeError::TooBig`] when it is longer than 255
    /// or the PublisherId longer than a String can be.
    pub fn new(
        buf: &'b mut Vec<u8>,
        header: &NetworkHeader<'_>,
        writer_ids: Option<&[u16]>,
    ) -> Result<Self, EncodeError> {
        write_flags(buf, header, writer_ids.is_some());
        if let Some(publisher_id) = &header.publisher_id {
            write_publisher_id(buf, publisher_id)?;
        }
        if let Some(class_id) = header.data_set_class_id {
            buf.extend_from_slice(&class_id.0);
        }
        if let Some(group) = &header.group {
            write_group_header(buf, group);
        }
        if let Some(ids) = writer_ids {
            write_payload_header(buf, ids)?;
        }
        let timestamp_at = header.timestamp.map(|timestamp| {
            let at = buf.len();
            buf.extend_from_slice(&timestamp.0.to_le_bytes());
            at
        });
        if let Some(picoseconds) = header.picoseconds {
            buf.extend_from_slice(&picoseconds.to_le_bytes());
        }
        let announced = writer_ids.map_or(1, <[u16]>::len);
        let sizes_at = (announced > 1).then(|| {
            let at = buf.len();
            buf.resize(at + announced * 2, 0);
            at
        });
        let progress = Progress {
            announced,
            written: 0,
            sizes_at,
            end: buf.len(),
        };
        Ok(Self {
            buf,
            progress,
            timestamp_at,
        })
    }

    /// Opens a key frame. One left without [`FieldEncoder::finish`] is taken back by the next call.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] when all announced messages are written.
    #[inline]
    pub fn key_frame(&mut self, header: &DataSetHeader) -> Result<FieldEncoder<'_>, EncodeError> {
        self.begin_message()?;
        let offsets = write_data_set_header(self.buf, header, message::KIND_KEY_FRAME);
        Ok(FieldEncoder::new(self.buf, &mut self.progress, offsets))
    }

    /// Appends a keep-alive. Its sequence number is the one the next message will have
    /// (OPC 10000-14, 7.2.4.5.8).
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] when all announced messages are written.
    pub fn keep_alive(&mut self, header: &DataSetHeader) -> Result<(), EncodeError> {
        self.begin_message()?;
        write_data_set_header(self.buf, header, message::KIND_KEEP_ALIVE);
        self.progress.message_finished(self.buf)
    }

    /// Ends the NetworkMessage.
    ///
    /// # Errors
    /// [`EncodeError::MessageCount`] when an announced message was not written.
    #[inline]
    pub fn finish(self) -> Result<(), EncodeError> {
        let Progress {
            announced,
            written,
            end,
            ..
        } = self.progress;
        if announced != written || end != self.buf.len() {
            return Err(EncodeError::MessageCount { announced, written });
        }
        Ok(())
    }

    /// Position in the buffer of the NetworkMessage's Timestamp (Int64), for patching it before sending.
    #[must_use]
    pub const fn timestamp_offset(&self) -> Option<usize> {
        self.timestamp_at
    }

    #[inline]
    fn begin_message(&mut self) -> Result<(), EncodeError> {
        let Progress {
            announced,
            written,
            end,
            ..
        } = self.progress;
        if written == announced {
            return Err(EncodeError::MessageCount {
                announced,
                written: written + 1,
            });
        }
        self.buf.truncate(end);
        Ok(())
    }
}

/// Positions in the buffer of the header fields that are patched when a message is sent again.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Offsets {
    pub(crate) sequence_number: Option<usize>,
    pub(crate) timestamp: Option<usize>,
}

#[inline]
fn write_flags(buf: &mut Vec<u8>, header: &NetworkHeader<'_>, payload_header: bool) {
    let extended1 = header.publisher_id.map_or(0, |id| id.type_bits())
        | flag(
            header.data_set_class_id.is_some(),
            network::DATA_SET_CLASS_ID,
        )
        | flag(header.timestamp.is_some(), network::TIMESTAMP)
        | flag(header.picoseconds.is_some(), network::PICOSECONDS);
    let uadp = network::VERSION
        | flag(header.publisher_id.is_some(), network::PUBLISHER_ID)
        | flag(header.group.is_some(), network::GROUP_HEADER)
        | flag(payload_header, network::PAYLOAD_HEADER)
        | flag(extended1 != 0, network::EXTENDED_FLAGS1);
    match extended1 {
        0 => buf.push(uadp),
        _ => buf.extend_from_slice(&[uadp, extended1]),
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
        flag(group.writer_group_id.is_some(), network::WRITER_GROUP_ID)
            | flag(group.group_version.is_some(), network::GROUP_VERSION)
            | flag(
                group.network_message_number.is_some(),
                network::NETWORK_MESSAGE_NUMBER,
            )
            | flag(
                group.sequence_number.is_some(),
                network::GROUP_SEQUENCE_NUMBER,
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

#[inline]
fn write_data_set_header(buf: &mut Vec<u8>, header: &DataSetHeader, kind: u8) -> Offsets {
    let flags2 = kind
        | flag(header.timestamp.is_some(), message::TIMESTAMP)
        | flag(header.picoseconds.is_some(), message::PICOSECONDS);
    let flags1 = flag(header.valid, message::VALID)
        | flag(header.sequence_number.is_some(), message::SEQUENCE_NUMBER)
        | flag(header.status.is_some(), message::STATUS)
        | flag(header.major_version.is_some(), message::MAJOR_VERSION)
        | flag(header.minor_version.is_some(), message::MINOR_VERSION)
        | flag(flags2 != 0, message::FLAGS2);
    match flags2 {
        0 => buf.push(flags1),
        _ => buf.extend_from_slice(&[flags1, flags2]),
    }
    let sequence_number = header.sequence_number.map(|number| {
        let at = buf.len();
        buf.extend_from_slice(&number.to_le_bytes());
        at
    });
    let timestamp = header.timestamp.map(|timestamp| {
        let at = buf.len();
        buf.extend_from_slice(&timestamp.0.to_le_bytes());
        at
    });
    if let Some(picoseconds) = header.picoseconds {
        buf.extend_from_slice(&picoseconds.to_le_bytes());
    }
    if let Some(status) = header.status {
        buf.extend_from_slice(&status.to_le_bytes());
    }
    if let Some(version) = header.major_version {
        buf.extend_from_slice(&version.to_le_bytes());
    }
    if let Some(version) = header.minor_version {
        buf.extend_from_slice(&version.to_le_bytes());
    }
    Offsets {
        sequence_number,
        timestamp,
    }
}

#[inline]
const fn flag(present: bool, bit: u8) -> u8 {
    match present {
        true => bit,
        false => 0,
    }
}
