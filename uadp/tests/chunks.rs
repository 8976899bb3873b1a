//! Chunks of messages that exceed a datagram, and limits that hold for all errors of a network.

use std::path::PathBuf;
use std::time::Duration;

use allocation_counter::measure;
use proptest::collection::vec;
use proptest::prelude::*;
use uadp::{
    ChunkBudget, ChunkEncoder, ChunkError, ChunkRefusal, DataSetHeader, DataSetMessage,
    DecodeError, Extras, GiveUp, GroupHeader, MessageKind, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, NetworkMessageType, PublisherId, Reassembler, ReassemblyLimits, Scalar,
    SecurityHeader, Variant, Whole,
};

const START: Duration = Duration::ZERO;

fn ms(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

fn vector(name: &str) -> Vec<u8> {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "tests/vectors", name]
        .iter()
        .collect();
    let hex = std::fs::read_to_string(path.with_extension("hex")).unwrap();
    let hex = hex.trim();
    (0..hex.len())
        .step_by(2)
        .map(|at| u8::from_str_radix(&hex[at..at + 2], 16).unwrap())
        .collect()
}

/// Returns the bytes of a chunk NetworkMessage of PublisherId UInt16 `publisher` and
/// DataSetWriterId 10.
fn chunk(publisher: u16, number: u16, offset: u32, total: u32, data: &[u8]) -> Vec<u8> {
    let mut out = vec![0xD1, 0x81, 0x01];
    out.extend(publisher.to_le_bytes());
    out.extend(10_u16.to_le_bytes());
    out.extend(number.to_le_bytes());
    out.extend(offset.to_le_bytes());
    out.extend(total.to_le_bytes());
    out.extend(data);
    out
}

/// Passes a datagram to the reassembler. Returns the whole if it is complete.
fn receive(
    reassembler: &mut Reassembler,
    datagram: &[u8],
    now: Duration,
) -> Result<Option<Vec<u8>>, ChunkRefusal> {
    let message = NetworkMessage::decode(datagram).unwrap();
    let whole = reassembler.receive(&message, now)?;
    Ok(whole.map(|whole| whole.bytes.to_vec()))
}

fn whole(bytes: &[u8]) -> Whole<'_> {
    Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(10),
        message_sequence_number: 3,
        bytes,
    }
}

fn header() -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        ..NetworkHeader::default()
    }
}

fn split(
    header: &NetworkHeader<'_>,
    whole: Whole<'_>,
    budget: usize,
) -> Result<Vec<Vec<u8>>, ChunkError> {
    let extras = Extras::default();
    let budget = ChunkBudget {
        network_message: budget,
        trailer: 0,
    };
    let mut chunks = ChunkEncoder::new(header, &extras, whole, budget)?;
    let mut datagrams = Vec::new();
    let mut buffer = vec![0xA5; 3];
    while let Some(chunk) = chunks.append(&mut buffer, &extras) {
        datagrams.push(buffer.split_off(chunk?.start));
    }
    assert_eq!(buffer, [0xA5; 3]);
    Ok(datagrams)
}

/// Returns the DataSetMessage of the three composite_chunk vectors.
fn composite() -> Vec<u8> {
    let mut out = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None).unwrap();
    let header = DataSetHeader {
        sequence_number: Some(77),
        ..DataSetHeader::default()
    };
    let mut fields = message.key_frame(&header).unwrap();
    let value: Vec<u8> = (0..600_u32).map(|i| (i * 3) as u8).collect();
    fields.scalar(Scalar::ByteString(Some(&value))).unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    out.split_off(1)
}

#[test]
fn the_chunks_of_the_vectors_are_written_byte_by_byte() {
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2234)),
        group: Some(GroupHeader {
            writer_group_id: Some(100),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let bytes = composite();
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(5),
        message_sequence_number: 77,
        bytes: &bytes,
    };
    let datagrams = split(&header, whole, 276).unwrap();
    let vectors = [0, 1, 2].map(|i| vector(&format!("composite_chunk_{i}")));
    assert_eq!(datagrams, vectors);
}

#[test]
fn the_chunks_of_the_vectors_make_the_message_in_any_order() {
    let vectors = [0, 1, 2].map(|i| vector(&format!("composite_chunk_{i}")));
    for order in [
        [0, 1, 2],
        [0, 2, 1],
        [1, 0, 2],
        [1, 2, 0],
        [2, 0, 1],
        [2, 1, 0],
    ] {
        let mut reassembler = Reassembler::default();
        let [first, second, last] = order.map(|at| NetworkMessage::decode(&vectors[at]).unwrap());
        assert_eq!(reassembler.receive(&first, START), Ok(None));
        assert_eq!(reassembler.receive(&second, START), Ok(None));
        let whole = reassembler.receive(&last, START).unwrap().unwrap();
        assert_eq!(whole.header.publisher_id, Some(PublisherId::UInt16(2234)));
        assert_eq!(whole.message_sequence_number, 77);
        let message = whole.data_set_message().unwrap();
        assert_eq!(message.writer_id, Some(5));
        assert_eq!(message.kind, MessageKind::KeyFrame);
        assert_eq!(message.header().sequence_number, Some(77));
        let fields: Vec<_> = message.fields().unwrap().map(Result::unwrap).collect();
        let value: Vec<u8> = (0..600_u32).map(|i| ((i * 3) & 255) as u8).collect();
        assert_eq!(
            fields,
            [Variant::Scalar(Scalar::ByteString(Some(&value)))],
            "{order:?}"
        );
    }
}

#[test]
fn a_chunk_with_a_count_in_its_payload_header_never_becomes_a_message() {
    // asyncua writes a Count, which shifts the following fields: they announce 512000 bytes of
    // DataSetWriter 1281.
    let datagram = vector("asyncua_chunk");
    let mut reassembler = Reassembler::default();
    let message = NetworkMessage::decode(&datagram).unwrap();
    assert_eq!(message.chunk().unwrap().total_size, 512_000);
    assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
    assert!(reassembler.held() < 1000);
    reassembler.expire(ms(2000));
    assert_eq!(reassembler.counters().expired, 1);
    assert_eq!(reassembler.held(), 0);
}

#[test]
fn all_chunks_but_the_last_are_equally_long_and_fit_the_budget() {
    let bytes: Vec<u8> = (0..1000_u32).map(|i| i as u8).collect();
    for budget in [18, 50, 117, 118, 119, 1016, 1017, 5000] {
        let datagrams = split(&header(), whole(&bytes), budget).unwrap();
        let (last, others) = datagrams.split_last().unwrap();
        assert!(others.iter().all(|datagram| datagram.len() == budget));
        assert!(last.len() <= budget);
        let data: usize = datagrams.iter().map(|datagram| datagram.len() - 17).sum();
        assert_eq!(data, 1000, "budget {budget}");
    }
}

#[test]
fn chunks_written_one_at_a_time_are_those_written_at_once() {
    let bytes: Vec<u8> = (0..1000_u32).map(|i| i as u8).collect();
    let budget = ChunkBudget {
        network_message: 100,
        trailer: 0,
    };
    let extras = Extras::default();
    let mut datagrams = Vec::new();
    let mut offset = 0;
    loop {
        let chunks = ChunkEncoder::new(&header(), &extras, whole(&bytes), budget).unwrap();
        let mut chunks = chunks.resumed_at(offset);
        let mut datagram = Vec::new();
        let Some(written) = chunks.append(&mut datagram, &extras) else {
            break;
        };
        written.unwrap();
        offset = chunks.offset();
        datagrams.push(datagram);
    }
    assert_eq!(offset, bytes.len());
    assert_eq!(datagrams, split(&header(), whole(&bytes), 100).unwrap());
}

#[test]
fn a_budget_that_leaves_no_room_for_a_byte_is_refused() {
    let no_room = |budget| {
        Err(ChunkError::NoRoom {
            budget,
            overhead: 17,
        })
    };
    for budget in [0, 1, 16, 17] {
        assert_eq!(split(&header(), whole(&[1, 2]), budget), no_room(budget));
    }
    assert_eq!(split(&header(), whole(&[1, 2]), 18).unwrap().len(), 2);
    assert_eq!(split(&header(), whole(&[]), 1472), Err(ChunkError::Empty));
}

#[test]
fn every_chunk_is_a_network_message_with_numbers_of_its_own() {
    let header = NetworkHeader {
        group: Some(GroupHeader {
            network_message_number: Some(1),
            sequence_number: Some(65535),
            ..GroupHeader::default()
        }),
        ..header()
    };
    let datagrams = split(&header, whole(&[0; 30]), 32).unwrap();
    let numbers: Vec<_> = datagrams
        .iter()
        .map(|datagram| NetworkMessage::decode(datagram).unwrap().header().group)
        .map(|group| group.unwrap())
        .map(|group| (group.network_message_number, group.sequence_number))
        .collect();
    assert_eq!(
        numbers,
        [
            (Some(1), Some(65535)),
            (Some(2), Some(0)),
            (Some(3), Some(1))
        ]
    );
}

#[test]
fn more_chunks_than_network_message_numbers_are_refused() {
    let numbered = |first| NetworkHeader {
        group: Some(GroupHeader {
            network_message_number: Some(first),
            ..GroupHeader::default()
        }),
        ..header()
    };
    let bytes = [0; 10];
    let budget = 17 + 3 + 1;
    assert_eq!(
        split(&numbered(65526), whole(&bytes), budget)
            .unwrap()
            .len(),
        10
    );
    assert_eq!(
        split(&numbered(65527), whole(&bytes), budget),
        Err(ChunkError::TooBig(10))
    );
}

#[test]
fn a_secured_chunk_leaves_room_for_its_signature_and_says_what_to_encrypt() {
    let bytes: Vec<u8> = (0..3000_u32).map(|i| i as u8).collect();
    let nonces: [[u8; 8]; 3] = [[1; 8], [2; 8], [3; 8]];
    let extras = nonces.each_ref().map(|nonce| Extras {
        security: Some(SecurityHeader {
            signed: true,
            encrypted: true,
            token_id: 7,
            nonce,
            ..SecurityHeader::default()
        }),
        ..Extras::default()
    });
    let budget = ChunkBudget::IPV4.with_trailer(32);
    let mut chunks = ChunkEncoder::new(&header(), &extras[0], whole(&bytes), budget).unwrap();
    assert_eq!(chunks.remaining(), 3);
    let mut buffer = Vec::new();
    let mut sealed = Vec::new();
    for (extras, nonce) in extras.iter().zip(&nonces) {
        let placed = chunks.append(&mut buffer, extras).unwrap().unwrap();
        assert_eq!(buffer[placed.payload_at - 8..placed.payload_at], *nonce);
        assert_eq!(buffer[placed.payload_at..][..2], 3_u16.to_le_bytes());
        buffer.extend([0; 32]);
        sealed.push(buffer.len() - placed.start);
        let datagram = &buffer[placed.start..];
        let message = NetworkMessage::decode(datagram).unwrap();
        assert!(message.is_chunk() && message.is_sealed());
        assert_eq!(message.payload().len(), buffer.len() - placed.payload_at);
    }
    assert!(chunks.append(&mut buffer, &extras[0]).is_none());
    assert_eq!(sealed[..2], [1472, 1472]);
}

#[test]
fn a_longer_nonce_than_was_reckoned_with_is_refused_and_leaves_the_buffer_alone() {
    let secured = |nonce| Extras {
        security: Some(SecurityHeader {
            signed: true,
            nonce,
            ..SecurityHeader::default()
        }),
        ..Extras::default()
    };
    let mut chunks = ChunkEncoder::new(
        &header(),
        &secured(&[1; 8]),
        whole(&[0; 100]),
        ChunkBudget {
            network_message: 90,
            trailer: 32,
        },
    )
    .unwrap();
    let mut buffer = vec![7];
    let refused = chunks.append(&mut buffer, &secured(&[1; 9])).unwrap();
    assert!(matches!(refused, Err(ChunkError::NoRoom { .. })));
    assert_eq!(buffer, [7]);
    chunks
        .append(&mut buffer, &secured(&[1; 8]))
        .unwrap()
        .unwrap();
    assert_eq!(buffer.len(), 1 + 90 - 32);
}

#[test]
fn chunks_of_uneven_length_are_accepted_in_any_order() {
    let mut reassembler = Reassembler::default();
    for (offset, data) in [(4, &[4, 5, 6, 7, 8][..]), (9, &[9]), (0, &[0])] {
        let datagram = chunk(2, 1, offset, 10, data);
        assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
    }
    let whole = receive(&mut reassembler, &chunk(2, 1, 1, 10, &[1, 2, 3]), START);
    assert_eq!(whole, Ok(Some((0..10).collect())));
}

#[test]
fn a_chunk_that_comes_again_is_refused_before_and_after_the_whole_is_complete() {
    let mut reassembler = Reassembler::default();
    let first = chunk(2, 1, 0, 4, &[0, 1]);
    let last = chunk(2, 1, 2, 4, &[2, 3]);
    let again = Err(ChunkRefusal::Duplicate);
    assert_eq!(receive(&mut reassembler, &first, START), Ok(None));
    assert_eq!(receive(&mut reassembler, &first, START), again);
    let whole = receive(&mut reassembler, &last, START);
    assert_eq!(whole, Ok(Some(vec![0, 1, 2, 3])));
    for datagram in [&first, &last] {
        assert_eq!(receive(&mut reassembler, datagram, ms(1999)), again);
    }
    assert_eq!(reassembler.counters().duplicates, 3);
    assert_eq!(reassembler.counters().completed, 1);
}

#[test]
fn a_chunk_with_another_total_size_is_refused_and_the_others_still_make_the_whole() {
    let mut reassembler = Reassembler::default();
    receive(&mut reassembler, &chunk(2, 1, 0, 4, &[0, 1]), START).unwrap();
    let refused = receive(&mut reassembler, &chunk(2, 1, 2, 5, &[2, 3, 4]), START);
    assert_eq!(
        refused,
        Err(ChunkRefusal::TotalSize {
            expected: 4,
            found: 5
        })
    );
    let whole = receive(&mut reassembler, &chunk(2, 1, 2, 4, &[2, 3]), START);
    assert_eq!(whole, Ok(Some(vec![0, 1, 2, 3])));
}

#[test]
fn a_chunk_over_parts_of_others_is_refused() {
    let mut reassembler = Reassembler::default();
    receive(&mut reassembler, &chunk(2, 1, 4, 12, &[4, 5, 6, 7]), START).unwrap();
    for (offset, len) in [(3, 2), (3, 6), (5, 2), (7, 2), (4, 3), (0, 5), (4, 8)] {
        let refused = receive(
            &mut reassembler,
            &chunk(2, 1, offset, 12, &vec![9; len]),
            START,
        );
        assert_eq!(refused, Err(ChunkRefusal::Overlap), "{len} at {offset}");
    }
    receive(&mut reassembler, &chunk(2, 1, 0, 12, &[0, 1, 2, 3]), START).unwrap();
    let whole = receive(
        &mut reassembler,
        &chunk(2, 1, 8, 12, &[8, 9, 10, 11]),
        START,
    );
    assert_eq!(whole, Ok(Some((0..12).collect())));
}

#[test]
fn a_number_in_use_again_begins_a_new_whole_and_mixes_nothing() {
    let mut reassembler = Reassembler::default();
    receive(&mut reassembler, &chunk(2, 0, 0, 6, &[1, 1]), START).unwrap();
    receive(&mut reassembler, &chunk(2, 0, 2, 6, &[1, 1]), START).unwrap();
    // The last chunk is lost, and the publisher restarts with number 0.
    for offset in [0, 2] {
        let datagram = chunk(2, 0, offset, 6, &[2, 2]);
        assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
    }
    let whole = receive(&mut reassembler, &chunk(2, 0, 4, 6, &[2, 2]), START);
    assert_eq!(whole, Ok(Some(vec![2; 6])));
    assert_eq!(reassembler.counters().contradicted, 1);
    // The same after a complete whole.
    receive(&mut reassembler, &chunk(2, 0, 0, 6, &[3, 3, 3]), START).unwrap();
    let whole = receive(&mut reassembler, &chunk(2, 0, 3, 6, &[3, 3, 3]), START);
    assert_eq!(whole, Ok(Some(vec![3; 6])));
    // A longer whole with the same start is a different whole.
    for offset in [0, 3, 6] {
        let datagram = chunk(2, 0, offset, 12, &[3, 3, 3]);
        assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
    }
    let whole = receive(&mut reassembler, &chunk(2, 0, 9, 12, &[3, 3, 3]), START);
    assert_eq!(whole, Ok(Some(vec![3; 12])));
}

#[test]
fn wholes_of_other_publishers_and_numbers_do_not_meet() {
    let mut reassembler = Reassembler::default();
    for (publisher, number) in [(2, 1), (2, 2), (3, 1)] {
        let value = [publisher as u8, number as u8];
        let datagram = chunk(publisher, number, 0, 4, &value);
        assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
    }
    for (publisher, number) in [(3, 1), (2, 1), (2, 2)] {
        let value = [publisher as u8, number as u8];
        let whole = receive(
            &mut reassembler,
            &chunk(publisher, number, 2, 4, &value),
            START,
        );
        assert_eq!(whole, Ok(Some([value, value].concat())));
    }
}

#[test]
fn a_publisher_id_of_another_type_is_another_publisher() {
    let bytes = [0; 40];
    let mut reassembler = Reassembler::default();
    for id in [
        PublisherId::Byte(2),
        PublisherId::UInt16(2),
        PublisherId::UInt32(2),
        PublisherId::UInt64(2),
        PublisherId::String("2"),
    ] {
        let header = NetworkHeader {
            publisher_id: Some(id),
            ..NetworkHeader::default()
        };
        let datagrams = split(&header, whole(&bytes), 50).unwrap();
        assert_eq!(datagrams.len(), 2);
        assert_eq!(receive(&mut reassembler, &datagrams[0], START), Ok(None));
        let whole = receive(&mut reassembler, &datagrams[1], START);
        assert_eq!(whole, Ok(Some(bytes.to_vec())), "{id:?}");
    }
}

#[test]
fn a_whole_in_one_chunk_is_complete_at_once_and_only_once() {
    let mut reassembler = Reassembler::default();
    let datagram = chunk(2, 1, 0, 3, &[7, 8, 9]);
    let whole = receive(&mut reassembler, &datagram, START);
    assert_eq!(whole, Ok(Some(vec![7, 8, 9])));
    let again = receive(&mut reassembler, &datagram, START);
    assert_eq!(again, Err(ChunkRefusal::Duplicate));
}

#[test]
fn a_whole_network_message_in_chunks_is_read_from_the_bytes() {
    // UA-.NETStandard sends chunks of an encoded NetworkMessage, without payload header.
    let mut inner = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut inner, &header(), Some(&[10])).unwrap();
    message.keep_alive(&DataSetHeader::default()).unwrap();
    message.finish().unwrap();
    let outer = Whole {
        writer_id: None,
        ..whole(&inner)
    };
    let datagrams = split(&header(), outer, 20).unwrap();
    let mut reassembler = Reassembler::default();
    let messages: Vec<_> = datagrams
        .iter()
        .map(|datagram| NetworkMessage::decode(datagram).unwrap())
        .collect();
    let (last, others) = messages.split_last().unwrap();
    for message in others {
        assert_eq!(reassembler.receive(message, START), Ok(None));
    }
    let whole = reassembler.receive(last, START).unwrap().unwrap();
    assert_eq!(whole.writer_id, None);
    let network = NetworkMessage::decode(whole.bytes).unwrap();
    let message = network.messages().next().unwrap().unwrap();
    assert_eq!(message.writer_id, Some(10));
    assert_eq!(message.kind, MessageKind::KeepAlive);
}

#[test]
fn a_discovery_announcement_comes_back_as_bytes_and_not_as_a_data_set_message() {
    let announcement = Whole {
        message_type: NetworkMessageType::Announcement,
        writer_id: None,
        message_sequence_number: 9,
        bytes: &[5; 100],
    };
    let extras = Extras {
        security: Some(SecurityHeader::NONE),
        ..Extras::default()
    };
    let budget = ChunkBudget {
        network_message: 80,
        trailer: 0,
    };
    let mut chunks = ChunkEncoder::new(&header(), &extras, announcement, budget).unwrap();
    let mut buffer = Vec::new();
    let mut reassembler = Reassembler::default();
    let first = chunks.append(&mut buffer, &extras).unwrap().unwrap();
    let second = chunks.append(&mut buffer, &extras).unwrap().unwrap();
    let datagrams = [&buffer[first.start..second.start], &buffer[second.start..]];
    // PublisherId and ExtendedFlags1 only, with a SecurityHeader; the announcement of a chunk.
    assert_eq!(datagrams[0][..3], [0x91, 0x91, 0x09]);
    let [first, second] = datagrams.map(|datagram| NetworkMessage::decode(datagram).unwrap());
    assert_eq!(reassembler.receive(&first, START), Ok(None));
    let whole = reassembler.receive(&second, START).unwrap().unwrap();
    assert_eq!(whole.message_type, NetworkMessageType::Announcement);
    assert_eq!(whole.bytes, [5; 100]);
    assert_eq!(
        whole.data_set_message().err(),
        Some(DecodeError::Misread("a discovery announcement"))
    );
}

#[test]
fn what_is_no_chunk_is_refused_and_counted() {
    let mut reassembler = Reassembler::default();
    let refused = receive(&mut reassembler, &[0x01, 0x01], START);
    assert_eq!(
        refused,
        Err(ChunkRefusal::Malformed(DecodeError::Misread("no chunk")))
    );
    let sealed = [0x81, 0x90, 0x01, 0x01, 0, 0, 0, 0, 0, 1, 0, 0, 0];
    let refused = receive(&mut reassembler, &sealed, START);
    assert!(matches!(
        refused,
        Err(ChunkRefusal::Malformed(DecodeError::Misread(_)))
    ));
    let past_the_end = chunk(2, 1, 3, 4, &[0, 1]);
    assert!(receive(&mut reassembler, &past_the_end, START).is_err());
    assert_eq!(reassembler.counters().malformed, 3);
}

#[test]
fn a_whole_is_given_up_when_it_takes_too_long() {
    let mut reassembler = Reassembler::default();
    assert_eq!(reassembler.poll_timeout(), None);
    receive(&mut reassembler, &chunk(2, 1, 0, 4, &[0, 1]), ms(100)).unwrap();
    receive(&mut reassembler, &chunk(2, 2, 0, 4, &[0, 1]), ms(300)).unwrap();
    assert_eq!(reassembler.poll_timeout(), Some(ms(2100)));
    reassembler.expire(ms(2099));
    assert_eq!(reassembler.counters().expired, 0);
    reassembler.expire(ms(2100));
    assert_eq!(reassembler.counters().expired, 1);
    assert_eq!(reassembler.poll_timeout(), Some(ms(2300)));
    // A late chunk does not complete the whole, even without a call of `expire`.
    let late = receive(&mut reassembler, &chunk(2, 2, 2, 4, &[2, 3]), ms(2300));
    assert_eq!(late, Ok(None));
    assert_eq!(reassembler.counters().expired, 2);
}

#[test]
fn the_whole_begun_first_makes_place_for_a_new_one() {
    let mut reassembler = Reassembler::new(ReassemblyLimits {
        open: 2,
        ..ReassemblyLimits::default()
    });
    for publisher in [1, 2, 3] {
        let datagram = chunk(publisher, 1, 0, 2, &[0]);
        assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
    }
    assert_eq!(reassembler.counters().out_of_places, 1);
    let whole = |reassembler: &mut _, publisher| {
        receive(reassembler, &chunk(publisher, 1, 1, 2, &[1]), START).unwrap()
    };
    assert_eq!(whole(&mut reassembler, 3), Some(vec![0, 1]));
    assert_eq!(whole(&mut reassembler, 2), Some(vec![0, 1]));
    assert_eq!(whole(&mut reassembler, 1), None);
}

#[test]
fn a_writer_that_loses_chunks_does_not_push_out_the_wholes_of_others() {
    let mut reassembler = Reassembler::default();
    receive(&mut reassembler, &chunk(1, 1, 0, 2, &[0]), START).unwrap();
    for number in 0..200 {
        receive(&mut reassembler, &chunk(2, number, 0, 2, &[0]), START).unwrap();
    }
    assert_eq!(reassembler.counters().superseded, 196);
    let told = std::iter::from_fn(|| reassembler.poll_given_up()).last();
    let told = told.unwrap();
    assert_eq!(told.why, GiveUp::Superseded);
    assert_eq!(told.publisher_id, Some(PublisherId::UInt16(2).into()));
    assert_eq!((told.writer_id, told.writer_group_id), (Some(10), None));
    assert_eq!(reassembler.counters().out_of_places, 0);
    let whole = receive(&mut reassembler, &chunk(1, 1, 1, 2, &[1]), START);
    assert_eq!(whole, Ok(Some(vec![0, 1])));
    let newest = receive(&mut reassembler, &chunk(2, 199, 1, 2, &[1]), START);
    assert_eq!(newest, Ok(Some(vec![0, 1])));
}

#[test]
fn the_bytes_of_all_wholes_stay_below_the_limit() {
    let total = 10_000;
    let mut reassembler = Reassembler::new(ReassemblyLimits {
        total,
        ..ReassemblyLimits::default()
    });
    for publisher in 0..50 {
        let datagram = chunk(publisher, 1, 0, 5000, &[0; 3000]);
        assert_eq!(receive(&mut reassembler, &datagram, START), Ok(None));
        assert!(reassembler.held() <= total);
    }
    assert_eq!(reassembler.counters().out_of_bytes, 47);
    let whole = receive(
        &mut reassembler,
        &chunk(49, 1, 3000, 5000, &[1; 2000]),
        START,
    );
    assert_eq!(whole.unwrap().unwrap().len(), 5000);
    // A whole that exceeds the limit alone is given up too.
    receive(
        &mut reassembler,
        &chunk(60, 1, 0, 30_000, &[0; 9000]),
        START,
    )
    .unwrap();
    receive(
        &mut reassembler,
        &chunk(60, 1, 9000, 30_000, &[0; 9000]),
        START,
    )
    .unwrap();
    assert_eq!(reassembler.held(), 0);
}

#[test]
fn pieces_of_one_byte_are_bounded_in_number() {
    let mut reassembler = Reassembler::new(ReassemblyLimits {
        pieces: 100,
        ..ReassemblyLimits::default()
    });
    let refused = (0..200)
        .map(|offset| receive(&mut reassembler, &chunk(2, 1, offset * 2, 500, &[0]), START))
        .filter(|refused| *refused == Err(ChunkRefusal::TooManyPieces))
        .count();
    assert_eq!(refused, 100);
    assert!(reassembler.held() < 100 * 200);
}

#[test]
fn a_total_size_costs_nothing_before_the_bytes_are_there() {
    let datagram = chunk(2, 1, 0, u32::MAX, &[0; 13]);
    assert_eq!(datagram.len(), 30);
    let message = NetworkMessage::decode(&datagram).unwrap();
    let mut strict = Reassembler::default();
    let mut lax = Reassembler::new(ReassemblyLimits {
        whole: u32::MAX,
        ..ReassemblyLimits::default()
    });
    let allocated = measure(|| {
        let refused = strict.receive(&message, START);
        let too_big = ChunkRefusal::TooBig {
            total_size: u32::MAX,
        };
        assert_eq!(refused, Err(too_big));
    });
    assert_eq!(allocated.count_total, 0);
    let allocated = measure(|| assert_eq!(lax.receive(&message, START), Ok(None)));
    assert!(
        allocated.bytes_total < 4096,
        "{} bytes",
        allocated.bytes_total
    );
}

#[test]
fn a_datagram_of_64_kib_makes_it_allocate_little_more_than_that() {
    let mut reassembler = Reassembler::default();
    let data = vec![0; 65_000];
    // The order is descending, so that no bytes before a piece are present.
    for at in (0..200).rev() {
        let datagram = chunk(2, 1, 1_000_000 + at * 65_000, 16 << 20, &data);
        let message = NetworkMessage::decode(&datagram).unwrap();
        let allocated = measure(|| assert_eq!(reassembler.receive(&message, START), Ok(None)));
        assert!(
            allocated.bytes_total < 70_000,
            "{} bytes",
            allocated.bytes_total
        );
    }
    assert!(reassembler.held() > 200 * 65_000);
}

#[test]
fn the_buffer_of_a_whole_is_used_again_or_moved_out() {
    let mut reassembler = Reassembler::default();
    let send = |reassembler: &mut Reassembler, number| {
        receive(reassembler, &chunk(2, number, 0, 2000, &[1; 1000]), START).unwrap();
        let last = chunk(2, number, 1000, 2000, &[2; 1000]);
        let message = NetworkMessage::decode(&last).unwrap();
        let allocated = measure(|| {
            let whole = reassembler.receive(&message, START).unwrap().unwrap();
            assert_eq!(whole.bytes.len(), 2000);
        });
        allocated.bytes_total
    };
    let first = send(&mut reassembler, 1);
    let second = send(&mut reassembler, 2);
    assert!(second + 2000 <= first, "{second} after {first}");
    let whole = reassembler.take_whole();
    assert_eq!(whole, [[1; 1000], [2; 1000]].concat());
    assert!(reassembler.take_whole().is_empty());
}

#[test]
fn a_data_set_message_alone_is_read_like_one_in_a_network_message() {
    let bytes = composite();
    let message = DataSetMessage::decode(Some(5), &bytes).unwrap();
    assert_eq!(message.writer_id, Some(5));
    assert_eq!(message.header().sequence_number, Some(77));
    assert_eq!(message.fields().unwrap().len(), 1);
    assert_eq!(
        DataSetMessage::decode(None, &[]).err(),
        Some(DecodeError::Truncated {
            field: "DataSetFlags1",
            expected: 1,
            found: 0
        })
    );
}

/// Events of a hostile or broken network.
#[derive(Debug, Clone)]
enum Step {
    Chunk {
        publisher: u16,
        number: u16,
        offset: u32,
        total: u32,
        len: usize,
        fill: u8,
    },
    Wait(u64),
}

fn step() -> impl Strategy<Value = Step> {
    let chunk = (
        0..3_u16,
        0..4_u16,
        0..60_u32,
        0..60_u32,
        0..30_usize,
        0..2_u8,
    )
        .prop_map(
            |(publisher, number, offset, total, len, fill)| Step::Chunk {
                publisher,
                number,
                offset,
                total,
                len,
                fill,
            },
        );
    prop_oneof![9 => chunk, 1 => (0..1500_u64).prop_map(Step::Wait)]
}

proptest! {
    #[test]
    fn any_message_comes_through_in_any_order_with_any_repetitions(
        bytes in vec(any::<u8>(), 1..3000),
        budget in 18..400_usize,
        shuffle in vec(any::<proptest::sample::Index>(), 0..400),
    ) {
        let sent = Whole { message_sequence_number: 65535, ..whole(&bytes) };
        let datagrams = split(&header(), sent, budget).unwrap();
        let mut order: Vec<usize> = (0..datagrams.len()).collect();
        for (at, with) in shuffle.iter().enumerate() {
            let len = order.len();
            order.swap(at % len, with.index(len));
        }
        order.extend(shuffle.iter().map(|at| at.index(datagrams.len())));
        let mut reassembler = Reassembler::default();
        let wholes: Vec<_> = order
            .iter()
            .filter_map(|at| receive(&mut reassembler, &datagrams[*at], START).ok().flatten())
            .collect();
        prop_assert_eq!(wholes, [bytes]);
        prop_assert_eq!(reassembler.poll_timeout(), None);
    }

    #[test]
    fn nothing_a_network_does_passes_the_limits_or_mixes_wholes(steps in vec(step(), 1..200)) {
        let limits = ReassemblyLimits {
            whole: 50,
            total: 2500,
            total_per_sender: 2500,
            open: 3,
            open_per_sender: 3,
            open_per_writer: 2,
            pieces: 4,
            age: ms(1000),
        };
        let mut reassembler = Reassembler::new(limits);
        let mut now = START;
        let mut given = 0;
        for step in steps {
            match step {
                Step::Wait(millis) => {
                    now += ms(millis);
                    reassembler.expire(now);
                    prop_assert!(reassembler.poll_timeout().is_none_or(|at| at > now));
                }
                Step::Chunk { publisher, number, offset, total, len, fill } => {
                    given += 1;
                    let mark = (publisher << 4 | number << 1) as u8;
                    let datagram = chunk(publisher, number, offset, total, &vec![mark | fill; len]);
                    if let Ok(Some(whole)) = receive(&mut reassembler, &datagram, now) {
                        prop_assert_eq!(whole.len(), total as usize);
                        prop_assert!(whole.len() <= 50);
                        prop_assert!(whole.iter().all(|byte| byte & !1 == mark));
                    }
                }
            }
            prop_assert!(reassembler.held() <= limits.total);
        }
        let c = reassembler.counters();
        let refused = c.malformed + c.too_big + c.total_size + c.duplicates + c.overlaps
            + c.too_many_pieces;
        prop_assert_eq!(c.chunks + refused, given);
        reassembler.expire(now + ms(1000));
        prop_assert_eq!(reassembler.held(), 0);
    }
}

/// Passes a datagram as [`receive`], for several senders.
fn receive_from(
    reassembler: &mut Reassembler<u16>,
    sender: u16,
    datagram: &[u8],
) -> Result<Option<Vec<u8>>, ChunkRefusal> {
    let message = NetworkMessage::decode(datagram).unwrap();
    let whole = reassembler.receive_from(sender, &message, START)?;
    Ok(whole.map(|whole| whole.bytes.to_vec()))
}

#[test]
fn nobody_gets_a_chunk_into_what_another_sends_or_ends_it() {
    let mut reassembler = Reassembler::default();
    let begun = receive_from(&mut reassembler, 1, &chunk(2, 1, 0, 4, &[0, 1]));
    assert_eq!(begun, Ok(None));
    // Other bytes at the same offset, another TotalSize, newer wholes of its writer, and its
    // missing part.
    let other_bytes = chunk(2, 1, 0, 4, &[9, 9]);
    let other_size = chunk(2, 1, 0, 7, &[0, 1]);
    let newer = (2..20).map(|number| chunk(2, number, 0, 4, &[0, 1]));
    let rest = chunk(2, 1, 2, 4, &[8, 8]);
    for forged in [other_bytes, other_size].into_iter().chain(newer) {
        let _refused_or_kept = receive_from(&mut reassembler, 7, &forged);
    }
    let _whole_of_its_own = receive_from(&mut reassembler, 7, &rest);
    let whole = receive_from(&mut reassembler, 1, &chunk(2, 1, 2, 4, &[2, 3]));
    assert_eq!(whole, Ok(Some(vec![0, 1, 2, 3])));
    while let Some(given_up) = reassembler.poll_given_up() {
        assert_eq!(given_up.sender, 7);
    }
}

#[test]
fn a_sender_that_leaves_wholes_unfinished_makes_place_only_for_its_own() {
    let limits = ReassemblyLimits {
        total: 20_000,
        total_per_sender: 10_000,
        open: 40,
        open_per_sender: 20,
        ..ReassemblyLimits::default()
    };
    let first = chunk(1, 1, 0, 9000, &[0; 4000]);
    let last = chunk(1, 1, 4000, 9000, &[1; 5000]);
    for (senders, bytes) in [(1, 4000), (1, 1), (9, 4000)] {
        let mut reassembler = Reassembler::new(limits);
        assert_eq!(receive_from(&mut reassembler, 0, &first), Ok(None));
        for number in 0..600 {
            let (sender, publisher) = (1 + number % senders, 100 + number);
            let forged = chunk(publisher, 1, 0, 9000, &vec![0; bytes]);
            assert_eq!(receive_from(&mut reassembler, sender, &forged), Ok(None));
            assert!(reassembler.held() <= limits.total);
        }
        let whole = receive_from(&mut reassembler, 0, &last);
        let given_up = *reassembler.counters();
        assert_eq!(
            whole.map(|whole| whole.map(|whole| whole.len())),
            Ok(Some(9000)),
            "{senders} others, {bytes} bytes each: {given_up:?}"
        );
    }
}
