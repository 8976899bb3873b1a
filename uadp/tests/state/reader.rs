//! The states of a reader, and its handling of the content of messages.

use serde_json::Value;
use uadp::MessageKind::{DeltaFrame, Event, KeepAlive, KeyFrame};
use uadp::PubSubState::{Disabled, Error, Operational, Paused, PreOperational};
use uadp::{
    Accepted, Arrival, ConfigurationVersion, DataSetMessage, DataSetReaderState, DateTime,
    DeltaNull, GroupHeader, Merged, NetworkHeader, NetworkMessage, ReaderDrop, ReaderSettings,
    Timestamp,
};

use crate::state::{datagram, description, message, ms, settings, start_reader, versioned};

#[test]
fn a_reader_is_operational_from_its_first_key_frame_or_event_on() {
    for kind in [KeyFrame, Event] {
        let mut reader = start_reader(settings());
        reader.receive(&message(KeepAlive, 0), ms(1)).unwrap();
        let delta = reader.receive(&message(DeltaFrame, 0), ms(1));
        assert_eq!(delta, Err(ReaderDrop::NeedsKeyFrame));
        assert_eq!(reader.state(), PreOperational);
        reader.receive(&message(kind, 1), ms(1)).unwrap();
        assert_eq!(reader.state(), Operational);
    }
}

#[test]
fn no_time_runs_before_the_first_key_frame() {
    let mut reader = start_reader(settings());
    assert_eq!(reader.poll_timeout(), None);
    assert!(!reader.handle_timeout(ms(100_000)));
    assert_eq!(reader.state(), PreOperational);
}

#[test]
fn a_reader_without_messages_is_in_error_until_the_next_one() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 0), ms(500)).unwrap();
    assert_eq!(reader.poll_timeout(), Some(ms(1500)));
    reader.receive(&message(KeepAlive, 1), ms(1400)).unwrap();
    assert_eq!(reader.poll_timeout(), Some(ms(2400)));
    assert!(!reader.handle_timeout(ms(2399)));
    assert!(reader.handle_timeout(ms(2400)));
    assert_eq!(reader.state(), Error);
    assert_eq!(reader.poll_timeout(), None);
    assert!(!reader.handle_timeout(ms(9000)), "it is said once");
    reader.receive(&message(KeyFrame, 1), ms(9000)).unwrap();
    assert_eq!(reader.state(), Operational);
    assert_eq!(reader.counters().timeouts, 1);
}

#[test]
fn a_delta_frame_ends_the_error_while_its_key_frame_is_known() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 0), ms(0)).unwrap();
    reader.handle_timeout(ms(1500));
    let accepted = reader.receive(&message(DeltaFrame, 1), ms(1500)).unwrap();
    assert!(!accepted.incomplete);
    assert_eq!(reader.state(), Operational);
    // After two timeouts the reader has no information about the writer.
    reader.handle_timeout(ms(3500));
    let delta = reader.receive(&message(DeltaFrame, 2), ms(3500));
    assert_eq!(delta, Err(ReaderDrop::NeedsKeyFrame));
    assert_eq!(reader.state(), PreOperational);
    reader.receive(&message(KeyFrame, 3), ms(3600)).unwrap();
    assert_eq!(reader.state(), Operational);
}

#[test]
fn a_message_that_is_not_new_does_not_put_off_the_timeout() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 7), ms(0)).unwrap();
    reader.receive(&message(KeyFrame, 7), ms(900)).unwrap_err();
    reader.receive(&message(KeyFrame, 6), ms(900)).unwrap_err();
    let mut invalid = message(KeyFrame, 8);
    invalid.header.valid = false;
    assert_eq!(reader.receive(&invalid, ms(900)), Err(ReaderDrop::Invalid));
    assert_eq!(reader.poll_timeout(), Some(ms(1000)));
    assert_eq!(
        reader.receive(&message(KeyFrame, 7), ms(1000)),
        Err(ReaderDrop::Duplicate)
    );
    assert_eq!(reader.state(), Error);
}

#[test]
fn a_timeout_nobody_looked_for_is_noticed_with_the_next_message() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 0), ms(0)).unwrap();
    reader.receive(&message(KeyFrame, 1), ms(1200)).unwrap();
    assert_eq!(reader.counters().timeouts, 1);
    assert_eq!(reader.state(), Operational);
}

#[test]
fn a_paused_reader_takes_nothing_and_starts_anew_afterwards() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 5), ms(0)).unwrap();
    assert_eq!(reader.set_parent(Paused, ms(10)), Paused);
    let refused = reader.receive(&message(KeyFrame, 6), ms(20));
    assert_eq!(refused, Err(ReaderDrop::Inactive));
    assert_eq!(reader.poll_timeout(), None);
    assert_eq!(reader.set_parent(Operational, ms(30)), PreOperational);
    let delta = reader.receive(&message(DeltaFrame, 4), ms(40));
    assert_eq!(delta, Err(ReaderDrop::NeedsKeyFrame));
    reader.receive(&message(KeyFrame, 5), ms(50)).unwrap();
    assert_eq!(reader.disable(), Ok(Disabled));
    let refused = reader.receive(&message(KeyFrame, 6), ms(60));
    assert_eq!(refused, Err(ReaderDrop::Inactive));
    assert_eq!(reader.counters().inactive, 2);
}

#[test]
fn a_parent_in_error_does_not_stop_a_reader() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 5), ms(0)).unwrap();
    assert_eq!(reader.set_parent(Error, ms(1)), Operational);
    let again = reader.receive(&message(KeyFrame, 5), ms(2));
    assert_eq!(again, Err(ReaderDrop::Duplicate));
}

#[test]
fn a_gap_makes_the_delta_frames_incomplete_until_the_next_key_frame() {
    let mut reader = start_reader(settings());
    let mut incomplete = |kind, number| {
        let accepted = reader.receive(&message(kind, number), ms(1)).unwrap();
        accepted.incomplete
    };
    assert!(!incomplete(KeyFrame, 0));
    assert!(!incomplete(DeltaFrame, 1));
    assert!(incomplete(DeltaFrame, 3));
    assert!(incomplete(DeltaFrame, 4));
    assert!(!incomplete(KeyFrame, 5));
    assert!(!incomplete(DeltaFrame, 6));
    assert!(!incomplete(KeepAlive, 9));
    assert!(incomplete(DeltaFrame, 9));
}

#[test]
fn another_major_version_is_dropped_and_asks_for_metadata() {
    let metadata = ConfigurationVersion {
        major: 100,
        minor: 100,
    };
    let mut reader = start_reader(ReaderSettings {
        metadata: Some(metadata),
        ..settings()
    });
    reader
        .receive(&versioned(KeyFrame, 0, 100, 100), ms(0))
        .unwrap();
    assert_eq!(reader.metadata_needed(), None);
    let refused = reader.receive(&versioned(KeyFrame, 1, 200, 200), ms(800));
    let other = ReaderDrop::MajorVersion {
        expected: 100,
        found: 200,
    };
    assert_eq!(refused, Err(other));
    assert_eq!(reader.metadata_needed(), Some(200));
    // The reader is in Error if the metadata does not arrive within the timeout, even though
    // messages arrive.
    assert_eq!(reader.poll_timeout(), Some(ms(1800)));
    assert_eq!(
        reader.receive(&versioned(KeyFrame, 2, 200, 200), ms(1700)),
        Err(other)
    );
    assert!(reader.handle_timeout(ms(1800)));
    assert_eq!(
        reader.receive(&versioned(KeyFrame, 3, 200, 200), ms(1900)),
        Err(other)
    );
    assert_eq!(reader.state(), Error);
    // With the metadata it continues from a key frame; dropped messages do not count as lost.
    reader.set_metadata(Some(ConfigurationVersion {
        major: 200,
        minor: 200,
    }));
    assert_eq!(reader.metadata_needed(), None);
    let delta = reader.receive(&versioned(DeltaFrame, 4, 200, 200), ms(2000));
    assert_eq!(delta, Err(ReaderDrop::NeedsKeyFrame));
    assert_eq!(reader.state(), PreOperational);
    let accepted = reader.receive(&versioned(KeyFrame, 5, 200, 200), ms(2100));
    assert_eq!(accepted, Ok(Accepted::default()));
    assert_eq!(reader.state(), Operational);
    assert_eq!(reader.counters().missed, 0);
    assert_eq!(reader.counters().major_version, 3);
}

#[test]
fn metadata_that_is_missing_from_the_start_is_an_error_after_the_timeout() {
    let mut reader = start_reader(ReaderSettings {
        metadata: Some(ConfigurationVersion::default()),
        ..settings()
    });
    reader
        .receive(&versioned(KeyFrame, 0, 5, 5), ms(300))
        .unwrap_err();
    assert_eq!(reader.poll_timeout(), Some(ms(1300)));
    assert!(reader.handle_timeout(ms(1300)));
    assert_eq!(reader.state(), Error);
}

#[test]
fn another_minor_version_is_accepted_and_told_of() {
    let mut reader = start_reader(ReaderSettings {
        metadata: Some(ConfigurationVersion {
            major: 100,
            minor: 100,
        }),
        ..settings()
    });
    let minor = |reader: &mut DataSetReaderState, number, minor| {
        let arrival = versioned(KeyFrame, number, 100, minor);
        reader.receive(&arrival, ms(1)).unwrap().minor_version
    };
    assert_eq!(minor(&mut reader, 0, 100), None);
    assert_eq!(minor(&mut reader, 1, 150), Some(150));
    // A message without versions cannot be compared.
    let accepted = reader.receive(&message(KeyFrame, 2), ms(1)).unwrap();
    assert_eq!(accepted.minor_version, None);
}

#[test]
fn a_delta_frame_of_another_major_version_than_its_key_frame_is_dropped() {
    let mut reader = start_reader(settings());
    reader
        .receive(&versioned(KeyFrame, 0, 1, 1), ms(0))
        .unwrap();
    reader
        .receive(&versioned(DeltaFrame, 1, 1, 2), ms(0))
        .unwrap();
    let refused = reader.receive(&versioned(DeltaFrame, 2, 3, 3), ms(0));
    assert_eq!(refused, Err(ReaderDrop::NeedsKeyFrame));
}

#[test]
fn another_layout_than_the_configured_one_is_dropped() {
    let mut reader = start_reader(ReaderSettings {
        group_version: Some(9),
        network_message_number: Some(2),
        ..settings()
    });
    let arrival = |group_version, network_message_number| Arrival {
        group: GroupHeader {
            group_version,
            network_message_number,
            ..GroupHeader::default()
        },
        ..message(KeyFrame, 0)
    };
    for found in [None, Some(8)] {
        let refused = reader.receive(&arrival(found, Some(2)), ms(0));
        let reason = ReaderDrop::GroupVersion { expected: 9, found };
        assert_eq!(refused, Err(reason));
    }
    for found in [None, Some(1)] {
        let refused = reader.receive(&arrival(Some(9), found), ms(0));
        let reason = ReaderDrop::NetworkMessageNumber { expected: 2, found };
        assert_eq!(refused, Err(reason));
    }
    reader.receive(&arrival(Some(9), Some(2)), ms(0)).unwrap();
    assert_eq!(reader.counters().other_layout, 4);
}

#[test]
fn the_delta_frames_of_open62541_are_taken_and_their_filler_wipes_nothing() {
    let mut reader = start_reader(settings());
    let mut fields: Vec<Value> = Vec::new();
    let mut values = Vec::new();
    for round in 0..6 {
        let name = format!("wire_delta_r{round}");
        let datagram = datagram(&name);
        let network = NetworkMessage::decode(&datagram).unwrap();
        let message = network.messages().next().unwrap().unwrap();
        let arrival = Arrival::of(&network.header(), 0, &message);
        let accepted = reader.receive(&arrival, ms(30 * round));
        assert_eq!(accepted, Ok(Accepted::default()), "{name}");

        let said = &description(&name)["dataSetMessages"][0];
        let entries = said["fields"].as_array().unwrap();
        let value = |entry: &Value| entry["value"]["Value"].clone();
        if message.kind == KeyFrame {
            fields = entries.iter().map(value).collect();
        } else {
            let index = |entry: &Value| u16::try_from(entry["index"].as_u64().unwrap()).unwrap();
            let entries = entries.iter().map(|entry| (index(entry), value(entry)));
            let merged = DeltaNull::Filler.merge(&mut fields, entries, Value::is_null);
            assert_eq!(merged.applied + merged.filler, 4, "{name}");
        }
        values.push(Value::Array(fields.clone()));
    }
    let expected = serde_json::json!([
        [true, "cell", 2.5, 20_260_517],
        [true, "cell", 2.5, 20_260_518],
        [true, "cell", 2.5, 20_260_519],
        [true, "cell", 5.0, 20_260_520],
        [true, "cell", 5.0, 20_260_521],
        [true, "cell", 5.0, 20_260_522],
    ]);
    assert_eq!(Value::Array(values), expected);
}

#[test]
fn by_the_tables_a_null_in_a_delta_frame_is_a_value() {
    let is_null = |value: &Option<u8>| value.is_none();
    let entries = [(0, None), (2, None), (9, Some(1))];
    let mut fields = [Some(1), Some(2), Some(3)];
    let merged = DeltaNull::Value.merge(&mut fields, entries, is_null);
    assert_eq!(fields, [None, Some(2), None]);
    assert_eq!(
        merged,
        Merged {
            applied: 2,
            filler: 0,
            unknown: 1
        }
    );
    let mut fields = [Some(1), Some(2), Some(3)];
    let merged = DeltaNull::Filler.merge(&mut fields, entries, is_null);
    assert_eq!(fields, [Some(1), Some(2), None]);
    assert_eq!(merged.filler, 1);
}

#[test]
fn what_the_headers_say_is_found_in_datagrams() {
    let datagram = datagram("nm_everything");
    let network = NetworkMessage::decode(&datagram).unwrap();
    let group = network.header().group.unwrap();
    let stamp = network.header().timestamp.unwrap();
    let message = network.messages().next().unwrap().unwrap();
    let arrival = Arrival::of(&network.header(), 3, &message);
    assert_eq!(arrival.group, group);
    assert_eq!(arrival.position, 3);
    assert_eq!(arrival.header, message.header());
    match message.header().timestamp {
        Some(own) => assert_eq!(arrival.timestamp.unwrap().time, own),
        None => assert_eq!(arrival.timestamp.unwrap().time, stamp),
    }
    // The Timestamp of the DataSetMessage has priority over the Timestamp of the NetworkMessage.
    let with_time = [0x81, 0x30, 5, 0, 0, 0, 0, 0, 0, 0, 6, 0, 0, 0];
    let own = DataSetMessage::decode(None, &with_time).unwrap();
    let arrival = Arrival::of(&network.header(), 0, &own);
    assert_eq!(
        arrival.timestamp,
        Some(Timestamp {
            time: DateTime(5),
            picoseconds: 6
        })
    );
    let arrival = Arrival::of(&NetworkHeader::default(), 0, &message);
    assert_eq!(arrival.group, GroupHeader::default());
}
