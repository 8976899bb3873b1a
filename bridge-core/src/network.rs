//! The NetworkMessages a bridge sends: one DataSetMessage each, since common subscribers handle only the first of
//! several.

use mappings::TopicId;
use uadp::{
    DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Timestamp,
};

use crate::counters::Reason;
use crate::fields;
use crate::writer::Encoded;

/// Writes the one NetworkMessage of a sample. The stamp of sending is patched in when it is polled.
pub(crate) fn encode(
    encoded: &mut Encoded,
    topic: TopicId,
    header: &DataSetHeader,
    utc: Timestamp,
    sample: &fields::Payload<'_>,
) -> Result<(), (Reason, String)> {
    let too_big = |error: uadp::EncodeError| (Reason::TooBig, error.to_string());
    let (space, namespace, identifier) = topic.triple();
    let network = network_header(space, namespace, utc);
    let mut message = NetworkMessageEncoder::new(&mut encoded.bytes, &network, Some(&[identifier]))
        .map_err(too_big)?;
    let timestamp_at = message.timestamp_offset();
    let mut frame = message.key_frame(header).map_err(too_big)?;
    let sequence_at = frame.sequence_offset();
    fields::read(sample, namespace, &mut frame)?;
    frame.finish().map_err(too_big)?;
    message.finish().map_err(too_big)?;
    encoded.timestamp_at = timestamp_at.unwrap_or(usize::MAX);
    encoded.sequence_at = sequence_at.unwrap_or(usize::MAX);
    if encoded.bytes.len() > MAX_DATAGRAM {
        let detail = format!(
            "{} bytes are more than one UDP datagram carries ({MAX_DATAGRAM})",
            encoded.bytes.len()
        );
        return Err((Reason::TooBig, detail));
    }
    Ok(())
}

/// Writes a keep-alive; the stamp of sending is patched in when it is polled.
pub(crate) fn keep_alive(
    mut bytes: Vec<u8>,
    topic: TopicId,
    expected_sequence: u16,
    utc: Timestamp,
) -> Option<Encoded> {
    let (space, namespace, identifier) = topic.triple();
    let network = network_header(space, namespace, utc);
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[identifier])).ok()?;
    let timestamp_at = message.timestamp_offset().unwrap_or(usize::MAX);
    let header = DataSetHeader {
        sequence_number: Some(expected_sequence),
        ..DataSetHeader::default()
    };
    message.keep_alive(&header).ok()?;
    message.finish().ok()?;
    Some(Encoded {
        bytes,
        timestamp_at,
        sequence_at: usize::MAX,
    })
}

fn network_header(space: u16, namespace: u16, utc: Timestamp) -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(space)),
        group: Some(GroupHeader {
            writer_group_id: Some(namespace),
            ..GroupHeader::default()
        }),
        timestamp: Some(utc.time),
        picoseconds: Some(utc.picoseconds),
        ..NetworkHeader::default()
    }
}

/// The header of a sample taken from the local side at `taken`.
pub(crate) fn data_set_header(sequence: u16, taken: Timestamp) -> DataSetHeader {
    DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: Some(taken.time),
        picoseconds: Some(taken.picoseconds),
        status: Some(0),
        ..DataSetHeader::default()
    }
}

/// The largest UDP payload over IPv4.
const MAX_DATAGRAM: usize = 65_507;
