//! Tables of readers.

use uadp::PubSubState::Paused;
use uadp::{DataSetMessage, GroupHeader, NetworkHeader, PublisherId, ReaderDrop, ReaderTable};

use crate::state::{ms, settings};

fn publisher(id: PublisherId<'_>) -> NetworkHeader<'_> {
    NetworkHeader {
        publisher_id: Some(id),
        ..NetworkHeader::default()
    }
}

/// Returns a key frame without fields.
fn heartbeat(writer_id: u16) -> DataSetMessage<'static> {
    DataSetMessage::decode(Some(writer_id), &[0x01]).unwrap()
}

#[test]
fn each_writer_has_a_reader_of_its_own() {
    let mut table = ReaderTable::new(10, settings());
    for id in [
        PublisherId::UInt16(2),
        PublisherId::Byte(2),
        PublisherId::String("2"),
    ] {
        for group in [None, Some(1), Some(2)] {
            let header = NetworkHeader {
                group: Some(GroupHeader {
                    writer_group_id: group,
                    ..GroupHeader::default()
                }),
                ..publisher(id)
            };
            table.receive(&header, 0, &heartbeat(10), ms(1)).unwrap();
            table.receive(&header, 0, &heartbeat(10), ms(2)).unwrap();
        }
    }
    assert_eq!(table.iter().len(), 9);
    assert!(
        table
            .iter()
            .all(|(_, reader)| reader.counters().accepted == 2)
    );
}

#[test]
fn a_full_table_refuses_new_writers_while_the_known_ones_live() {
    let mut table = ReaderTable::new(2, settings());
    let header = publisher(PublisherId::UInt16(2));
    table.receive(&header, 0, &heartbeat(1), ms(0)).unwrap();
    table.receive(&header, 0, &heartbeat(2), ms(500)).unwrap();
    for writer in 3..100 {
        let refused = table.receive(&header, 0, &heartbeat(writer), ms(1999));
        assert_eq!(refused, Err(ReaderDrop::TableFull));
    }
    assert_eq!(table.refused(), 97);
    table
        .receive(&header, 0, &heartbeat(100), ms(2000))
        .unwrap();
    let writers: Vec<_> = table.iter().map(|(key, _)| key.writer_id).collect();
    assert_eq!(writers, [Some(2), Some(100)]);
    assert_eq!(table.replaced(), 1);
}

#[test]
fn a_long_publisher_id_is_not_kept() {
    let mut table = ReaderTable::new(2, settings());
    let longest = "x".repeat(ReaderTable::MAX_PUBLISHER_ID);
    let header = publisher(PublisherId::String(&longest));
    table.receive(&header, 0, &heartbeat(1), ms(0)).unwrap();
    let too_long = "x".repeat(ReaderTable::MAX_PUBLISHER_ID + 1);
    let header = publisher(PublisherId::String(&too_long));
    let refused = table.receive(&header, 0, &heartbeat(1), ms(0));
    assert_eq!(refused, Err(ReaderDrop::PublisherIdTooLong { len: 1025 }));
    assert_eq!(table.iter().len(), 1);
}

#[test]
fn a_table_tells_which_writers_fell_silent() {
    let mut table = ReaderTable::new(4, settings());
    let header = publisher(PublisherId::UInt16(2));
    assert_eq!(table.poll_timeout(), None);
    table.receive(&header, 0, &heartbeat(1), ms(0)).unwrap();
    table.receive(&header, 0, &heartbeat(2), ms(400)).unwrap();
    assert_eq!(table.poll_timeout(), Some(ms(1000)));
    let mut silent = Vec::new();
    table.handle_timeout(ms(1000), |key| silent.push(key.writer_id));
    table.handle_timeout(ms(1100), |key| silent.push(key.writer_id));
    assert_eq!(silent, [Some(1)]);
    assert_eq!(table.poll_timeout(), Some(ms(1400)));
    table.set_parent(Paused, ms(1200));
    let refused = table.receive(&header, 0, &heartbeat(2), ms(1200));
    assert_eq!(refused, Err(ReaderDrop::Inactive));
    let refused = table.receive(&header, 0, &heartbeat(3), ms(1200));
    assert_eq!(refused, Err(ReaderDrop::Inactive));
}
