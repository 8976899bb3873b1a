//! Recorded datagrams in the form in which they are sent again.

use uadp::{
    DateTime, DecodeError, NetworkMessage, NetworkMessageEncoder, NetworkMessageType,
    SecurityHeader, Timestamp,
};

use super::clock::ReplayClock;
use crate::messages::{self, PayloadMessage};

/// Returns the bytes of a message without its security. The message is opened, or was never
/// secured.
pub(super) fn plain(message: &NetworkMessage<'_>) -> Vec<u8> {
    let datagram = message.datagram();
    let Some(security) = message.security().filter(SecurityHeader::is_secured) else {
        return datagram.to_vec();
    };
    // The SecurityHeader is the last header.
    let headers = message.payload_offset().checked_sub(size(&security));
    let headers = headers.and_then(|end| datagram.get(..end));
    let mut plain = headers.unwrap_or_default().to_vec();
    if let Some(flags) = plain.get_mut(1) {
        *flags &= !SECURITY;
    }
    plain.extend(message.payload());
    plain
}

/// Removes the values that `keeps` refuses. Returns `None` if no value is left. Messages other than
/// values stay unchanged.
///
/// # Errors
/// [`DecodeError`] if the message is malformed.
pub(super) fn filtered(
    plain: Vec<u8>,
    mut keeps: impl FnMut(u16) -> bool,
) -> Result<Option<Vec<u8>>, DecodeError> {
    let message = NetworkMessage::decode(&plain)?;
    if message.is_chunk() {
        let writer_id = message.writer_ids().and_then(|mut ids| ids.next());
        let kept = writer_id.is_none_or(keeps);
        return Ok(kept.then_some(plain));
    }
    let parts = parts(&message)?;
    let of_kept = parts.iter().filter_map(|part| {
        let id = part.writer_id?;
        keeps(id).then_some((id, part.bytes))
    });
    let (ids, kept): (Vec<u16>, Vec<&[u8]>) = of_kept.unzip();
    if ids.is_empty() {
        return Ok(None);
    }
    if kept.len() == parts.len() {
        return Ok(Some(plain));
    }
    let unwritable = |_| DecodeError::Misread("more bytes than a NetworkMessage takes");
    let mut out = Vec::new();
    let mut writer =
        NetworkMessageEncoder::new(&mut out, &message.header(), Some(&ids)).map_err(unwritable)?;
    for bytes in kept {
        writer.encoded(bytes).map_err(unwritable)?;
    }
    writer.finish().map_err(unwritable)?;
    Ok(Some(out))
}

/// Moves the times of a message and its values to the present. Times in the fields stay.
pub(super) fn move_times(plain: &mut [u8], clock: &ReplayClock) {
    let mut places = Vec::new();
    if let Ok(message) = NetworkMessage::decode(plain) {
        places.extend(network_stamp(&message));
        if let Ok(parts) = parts(&message) {
            let starts = parts.iter().map(|part| (part.offset, part.bytes));
            places.extend(starts.filter_map(|(offset, bytes)| Some(offset + stamp_at(bytes)?)));
        }
    }
    for at in places {
        if let Some(place) = plain.get_mut(at..).and_then(<[u8]>::first_chunk_mut) {
            let time = DateTime(i64::from_le_bytes(*place));
            // Some writers never fill in the time.
            if time.0 != 0 {
                let moved = Timestamp::from_unix_nanos(clock.moved(time));
                *place = moved.time.0.to_le_bytes();
            }
        }
    }
}

/// Returns the DataSetMessages of a message, or the first part of one in a chunk.
fn parts<'a>(message: &NetworkMessage<'a>) -> Result<Vec<PayloadMessage<'a>>, DecodeError> {
    if message.message_type() != NetworkMessageType::DataSet || message.is_action() {
        return Ok(Vec::new());
    }
    if message.is_chunk() {
        let chunk = message.chunk()?;
        let first = chunk.writer_id.filter(|_| chunk.offset == 0);
        let part = first.map(|writer_id| PayloadMessage {
            writer_id: Some(writer_id),
            offset: message.payload_offset() + CHUNK_HEADER,
            bytes: chunk.data,
        });
        return Ok(part.into_iter().collect());
    }
    let (parts, fault) = messages::split(message);
    match fault {
        None => Ok(parts),
        Some(_) => Err(DecodeError::Misread("a NetworkMessage of wrong sizes")),
    }
}

/// Returns the offset of the time in the headers of an unsecured NetworkMessage.
fn network_stamp(message: &NetworkMessage<'_>) -> Option<usize> {
    let header = message.header();
    header.timestamp?;
    if message.promoted_fields().is_some() {
        return None;
    }
    let picoseconds = header.picoseconds.map_or(0, |_| 2);
    let security = message.security().as_ref().map_or(0, size);
    message
        .payload_offset()
        .checked_sub(security + picoseconds + 8)
}

/// Returns the offset of the time in a DataSetMessage (OPC 10000-14, 7.2.4.5.4).
fn stamp_at(message: &[u8]) -> Option<usize> {
    let &[flags1, flags2, ..] = message else {
        return None;
    };
    let sequence = usize::from(flags1 & SEQUENCE_NUMBER != 0) * 2;
    let has_stamp = flags1 & FLAGS2 != 0 && flags2 & TIMESTAMP != 0;
    has_stamp.then_some(2 + sequence)
}

/// Returns the size of a SecurityHeader in bytes.
fn size(security: &SecurityHeader<'_>) -> usize {
    let footer = security.footer_size.map_or(0, |_| 2);
    1 + 4 + 1 + security.nonce.len() + footer
}

/// The flag of the SecurityHeader in ExtendedFlags1.
const SECURITY: u8 = 0x10;
/// Flags of a DataSetMessage.
const SEQUENCE_NUMBER: u8 = 0x08;
const FLAGS2: u8 = 0x80;
const TIMESTAMP: u8 = 0x10;
/// MessageSequenceNumber, ChunkOffset and TotalSize.
const CHUNK_HEADER: usize = 2 + 4 + 4;

#[cfg(test)]
mod tests {
    use uadp::{
        ChunkBudget, ChunkEncoder, DataSetHeader, Extras, GroupHeader, NetworkHeader, PublisherId,
        Scalar, Whole,
    };

    use super::*;

    const SECOND: i128 = 1_000_000_000;

    fn header() -> NetworkHeader<'static> {
        NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(1)),
            group: Some(GroupHeader {
                writer_group_id: Some(2),
                ..GroupHeader::default()
            }),
            timestamp: Some(Timestamp::from_unix_nanos(100 * SECOND).time),
            picoseconds: Some(7),
            ..NetworkHeader::default()
        }
    }

    fn values(ids: &[u16]) -> Vec<u8> {
        let mut out = Vec::new();
        let mut writer = NetworkMessageEncoder::new(&mut out, &header(), Some(ids)).unwrap();
        for id in ids {
            let header = DataSetHeader {
                sequence_number: Some(*id),
                timestamp: Some(Timestamp::from_unix_nanos(99 * SECOND).time),
                picoseconds: Some(9),
                ..DataSetHeader::default()
            };
            let mut frame = writer.key_frame(&header).unwrap();
            frame.scalar(Scalar::UInt16(*id)).unwrap();
            frame.finish().unwrap();
        }
        writer.finish().unwrap();
        out
    }

    fn clock() -> ReplayClock {
        ReplayClock::new(100 * SECOND, 1000 * SECOND, 1.0)
    }

    fn seconds(time: Option<DateTime>) -> i128 {
        Timestamp::from(time.unwrap()).unix_nanos() / SECOND
    }

    #[test]
    fn times_of_messages_and_values_move_and_all_else_stays() {
        for ids in [&[10][..], &[10, 11, 12]] {
            let before = values(ids);
            let mut after = before.clone();
            move_times(&mut after, &clock());
            let message = NetworkMessage::decode(&after).unwrap();
            assert_eq!(seconds(message.header().timestamp), 1000);
            assert_eq!(message.header().picoseconds, Some(7));
            for (value, id) in message.messages().zip(ids) {
                let value = value.unwrap();
                assert_eq!(seconds(value.header().timestamp), 999);
                assert_eq!(value.header().sequence_number, Some(*id));
                assert_eq!(value.header().picoseconds, Some(9));
                let field = value.fields().unwrap().next().unwrap().unwrap();
                assert_eq!(field, uadp::Variant::Scalar(Scalar::UInt16(*id)));
            }
            move_times(
                &mut after,
                &ReplayClock::new(1000 * SECOND, 100 * SECOND, 1.0),
            );
            assert_eq!(after, before);
        }
    }

    #[test]
    fn the_time_of_a_value_in_chunks_moves_in_its_first_chunk() {
        let mut whole = Vec::new();
        let none = NetworkHeader::default();
        let mut writer = NetworkMessageEncoder::new(&mut whole, &none, None).unwrap();
        let head = DataSetHeader {
            sequence_number: Some(7),
            timestamp: header().timestamp,
            ..DataSetHeader::default()
        };
        let mut frame = writer.key_frame(&head).unwrap();
        frame.scalar(Scalar::ByteString(Some(&[0; 4000]))).unwrap();
        frame.finish().unwrap();
        writer.finish().unwrap();
        let whole = Whole {
            message_type: NetworkMessageType::DataSet,
            writer_id: Some(10),
            message_sequence_number: 7,
            bytes: &whole[1..],
        };
        let extras = Extras::default();
        let mut chunks = ChunkEncoder::new(&header(), &extras, whole, ChunkBudget::IPV4).unwrap();
        let mut buffer = Vec::new();
        let mut reassembler: uadp::Reassembler = uadp::Reassembler::default();
        let mut moved = None;
        while let Some(chunk) = chunks.append(&mut buffer, &extras) {
            let mut datagram = buffer.split_off(chunk.unwrap().start);
            move_times(&mut datagram, &clock());
            let message = NetworkMessage::decode(&datagram).unwrap();
            let received = reassembler.receive(&message, std::time::Duration::ZERO);
            if let Some(whole) = received.unwrap() {
                let value = whole.data_set_message().unwrap();
                moved = Some((seconds(value.header().timestamp), value.fields().is_ok()));
            }
        }
        assert_eq!(moved, Some((1000, true)));
    }

    #[test]
    fn values_that_share_a_datagram_are_left_out_one_by_one() {
        let all = values(&[10, 11, 12]);
        let kept = filtered(all.clone(), |id| id != 11).unwrap().unwrap();
        let message = NetworkMessage::decode(&kept).unwrap();
        assert_eq!(message.header(), header());
        let ids: Vec<u16> = message.writer_ids().unwrap().collect();
        assert_eq!(ids, [10, 12]);
        assert!(message.messages().all(|value| value.is_ok()));
        assert_eq!(filtered(all.clone(), |_| true), Ok(Some(all.clone())));
        assert_eq!(filtered(all, |_| false), Ok(None));
    }
}
