//! The NetworkMessages that a bridge sends. By default each has a single DataSetMessage, because
//! common subscribers handle only the first of several.

use mappings::{SpaceId, TopicId};
use uadp::{
    ChunkBudget, ChunkEncoder, ChunkError, DataSetHeader, EncodeError, Extras, GroupHeader,
    NetworkHeader, NetworkMessageEncoder, NetworkMessageType, PublisherId, SecurityHeader,
    Timestamp, Whole,
};

use crate::counters::{DropCause, Reason};
use crate::fields;
use crate::message::EncodedSample;

/// Writes the NetworkMessage of a sample. The time of sending is patched in when the message is
/// polled.
pub(crate) fn encode(
    encoded: &mut EncodedSample,
    topic: TopicId,
    header: &DataSetHeader,
    utc: Timestamp,
    sample: &fields::LocalPayload<'_>,
) -> Result<(), (DropCause, String)> {
    let too_big = |error: EncodeError| (Reason::TooBig.into(), error.to_string());
    let (space, namespace, identifier) = topic.triple();
    let network = network_header(space, namespace, utc);
    let mut message = NetworkMessageEncoder::new(&mut encoded.bytes, &network, Some(&[identifier]))
        .map_err(too_big)?;
    let timestamp_at = message.timestamp_offset();
    let payload_at = message.payload_offset();
    let mut frame = message.key_frame(header).map_err(too_big)?;
    let sequence_at = frame.sequence_offset();
    fields::read(sample, namespace, &mut frame)?;
    frame.finish().map_err(too_big)?;
    message.finish().map_err(too_big)?;
    encoded.timestamp_at = timestamp_at.unwrap_or(usize::MAX);
    encoded.payload_at = payload_at;
    encoded.sequence_at = sequence_at.unwrap_or(usize::MAX);
    Ok(())
}

/// Writes one NetworkMessage with several DataSetMessages of the same WriterGroup.
pub(crate) fn join<'a>(
    bytes: &mut Vec<u8>,
    utc: Timestamp,
    messages: impl Iterator<Item = (TopicId, &'a EncodedSample)> + Clone,
) -> Result<(), EncodeError> {
    let triples = messages.clone().map(|(topic, _)| topic.triple());
    let (space, namespace, _) = triples.clone().next().unwrap_or_default();
    let writer_ids: Vec<u16> = triples.map(|(_, _, identifier)| identifier).collect();
    let network = network_header(space, namespace, utc);
    let mut message = NetworkMessageEncoder::new(bytes, &network, Some(&writer_ids))?;
    for (_, sample) in messages {
        message.encoded(sample.data_set_message())?;
    }
    message.finish()
}

/// A DataSetMessage is larger than the mapping allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a message of {size} bytes; `pubsub.max_message` allows {} MiB", max_message >> 20)]
pub(crate) struct MessageTooBig {
    size: usize,
    max_message: u32,
}

/// Checks that a DataSetMessage has at most `max_message` bytes. It is called for DataSetMessages
/// that are too big for a datagram.
pub(crate) fn check_size(encoded: &EncodedSample, max_message: u32) -> Result<(), MessageTooBig> {
    let size = encoded.data_set_message().len();
    if u32::try_from(size).is_ok_and(|size| size <= max_message) {
        return Ok(());
    }
    Err(MessageTooBig { size, max_message })
}

/// Writes the chunk that starts at `offset` bytes in the DataSetMessage of a sample. Returns the
/// offset of the next chunk.
pub(crate) fn chunk(
    bytes: &mut Vec<u8>,
    topic: TopicId,
    (sample, offset): (&EncodedSample, usize),
    max_datagram: u16,
    utc: Timestamp,
) -> Result<usize, ChunkError> {
    let (space, namespace, identifier) = topic.triple();
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(identifier),
        message_sequence_number: sample.sequence(),
        bytes: sample.data_set_message(),
    };
    let budget = ChunkBudget {
        network_message: max_datagram.into(),
        trailer: 0,
    };
    let header = network_header(space, namespace, utc);
    let extras = Extras::default();
    let mut chunks = ChunkEncoder::new(&header, &extras, whole, budget)?.resumed_at(offset);
    chunks.append(bytes, &extras).transpose()?;
    Ok(chunks.offset())
}

/// Returns the chunks of an announcement that is larger than a datagram.
pub(crate) fn announcement_chunks(
    space: SpaceId,
    sequence_number: u16,
    body: &[u8],
    (max_datagram, utc): (u16, Timestamp),
) -> Result<Vec<Vec<u8>>, ChunkError> {
    let whole = Whole {
        message_type: NetworkMessageType::Announcement,
        writer_id: None,
        message_sequence_number: sequence_number,
        bytes: body,
    };
    let budget = ChunkBudget {
        network_message: max_datagram.into(),
        trailer: 0,
    };
    let header = NetworkHeader {
        group: None,
        timestamp: None,
        picoseconds: None,
        ..network_header(space.into(), 0, utc)
    };
    let extras = Extras {
        security: Some(SecurityHeader::NONE),
        ..Extras::default()
    };
    let mut chunks = ChunkEncoder::new(&header, &extras, whole, budget)?;
    let mut datagrams = Vec::new();
    loop {
        let mut bytes = Vec::new();
        match chunks.append(&mut bytes, &extras) {
            Some(written) => {
                written?;
                datagrams.push(bytes);
            }
            None => return Ok(datagrams),
        }
    }
}

/// Writes a keep-alive. The time of sending is patched in when the message is polled.
pub(crate) fn keep_alive(
    mut bytes: Vec<u8>,
    topic: TopicId,
    expected_sequence: u16,
    utc: Timestamp,
) -> Option<EncodedSample> {
    let (space, namespace, identifier) = topic.triple();
    let network = network_header(space, namespace, utc);
    let mut message = NetworkMessageEncoder::new(&mut bytes, &network, Some(&[identifier])).ok()?;
    let timestamp_at = message.timestamp_offset().unwrap_or(usize::MAX);
    let payload_at = message.payload_offset();
    let header = DataSetHeader {
        sequence_number: Some(expected_sequence),
        ..DataSetHeader::default()
    };
    message.keep_alive(&header).ok()?;
    message.finish().ok()?;
    Some(EncodedSample {
        bytes,
        timestamp_at,
        payload_at,
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

/// Returns the header of a sample with the time `taken` at which the local side provided it, and
/// its status.
pub(crate) fn data_set_header(
    sequence: u16,
    (taken, status): (Timestamp, u16),
    major_version: Option<u32>,
) -> DataSetHeader {
    DataSetHeader {
        sequence_number: Some(sequence),
        timestamp: Some(taken.time),
        picoseconds: Some(taken.picoseconds),
        status: Some(status),
        major_version,
        ..DataSetHeader::default()
    }
}

/// Returns the number of a PublisherId, and whether it is a UInt16.
pub(crate) fn number_of(publisher: Option<PublisherId<'_>>) -> (u64, bool) {
    match publisher {
        Some(PublisherId::UInt16(number)) => (u64::from(number), true),
        Some(PublisherId::Byte(number)) => (u64::from(number), false),
        Some(PublisherId::UInt32(number)) => (u64::from(number), false),
        Some(PublisherId::UInt64(number)) => (number, false),
        Some(PublisherId::String(_)) | None => (u64::MAX, false),
    }
}
