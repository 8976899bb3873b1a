//! Each kind of probe and announcement, and other messages.

use uadp::discovery::{
    AnnouncedContent, Announcement, ApplicationDescription, ConfigurationVersion, ConnectionState,
    CyclicStatus, DataSetMetaDataType, Probe, PubSubConnectionDataType, VersionMatch, WireArray,
    WriterGroupDataType,
};
use uadp::{
    DataSetHeader, DateTime, DecodeError, EncodeError, NetworkMessage, NodeId, PublisherId,
    SecurityHeader, StatusCode,
};

use crate::discovery::{body, probe_body};

#[test]
fn probes_are_laid_out_as_in_the_tables() {
    for (probe, bytes) in [
        (Probe::PublisherEndpoints, &[1, 1][..]),
        (
            Probe::DataSetMetaData(WireArray::new(&[10])),
            &[1, 2, 1, 0, 0, 0, 10, 0],
        ),
        (
            Probe::DataSetWriterConfiguration(WireArray::new(&[])),
            &[1, 3, 0, 0, 0, 0],
        ),
        (
            Probe::WriterGroupConfiguration {
                writer_group_id: 0x0105,
                include_data_set_writers: true,
            },
            &[1, 4, 5, 1, 1],
        ),
        (
            Probe::PubSubConnections {
                transport_profile_uris: WireArray::new(&[Some("u")]),
                include_writer_groups: true,
                include_data_set_writers: false,
            },
            &[1, 5, 1, 0, 0, 0, 1, 0, 0, 0, b'u', 1, 0],
        ),
        (Probe::FindApplications, &[2]),
    ] {
        assert_eq!(probe_body(&probe), bytes);
        assert_eq!(Probe::decode_body(bytes), Ok(probe));
    }
}

#[test]
fn an_endpoints_probe_of_version_1_04_ends_with_no_ids() {
    for ids in [[0xFF; 4], [0; 4]] {
        let bytes = [&[1, 1][..], &ids].concat();
        assert_eq!(Probe::decode_body(&bytes), Ok(Probe::PublisherEndpoints));
    }
    let ids = [1, 1, 1, 0, 0, 0, 10, 0];
    assert!(Probe::decode_body(&ids).is_err(), "it asks for no writer");
}

#[test]
fn an_unknown_kind_is_refused_by_its_name() {
    let reserved = |field, value| DecodeError::Reserved { field, value };
    for (bytes, error) in [
        (&[0][..], reserved("ProbeType", 0)),
        (&[3], reserved("ProbeType", 3)),
        (&[1, 0], reserved("InformationType", 0)),
        (&[1, 6], reserved("InformationType", 6)),
    ] {
        assert_eq!(Probe::decode_body(bytes), Err(error));
    }
    for (bytes, error) in [
        (&[0, 0, 0][..], reserved("AnnouncementType", 0)),
        (&[8, 0, 0], reserved("AnnouncementType", 8)),
        (&[5, 0, 0, 0, 0], reserved("ApplicationInformationType", 0)),
        (&[5, 0, 0, 3, 0], reserved("ApplicationInformationType", 3)),
    ] {
        assert_eq!(Announcement::decode_body(bytes), Err(error));
    }
}

#[test]
fn find_applications_asks_no_publisher_in_particular() {
    let mut datagram = Vec::new();
    Probe::FindApplications
        .encode(None, SecurityHeader::NONE, &mut datagram)
        .unwrap();
    assert_eq!(datagram, [0x91, 0x90, 0x04, 0, 0, 0, 0, 0, 0, 0, 2]);
    let message = NetworkMessage::decode(&datagram).unwrap();
    assert_eq!(Probe::decode(&message), Ok(Probe::FindApplications));
}

#[test]
fn application_information_says_what_it_is_or_how_it_is() {
    let description = AnnouncedContent::ApplicationDescription {
        description: ApplicationDescription::default(),
        capabilities: WireArray::new(&[Some("NA")]),
    };
    let bytes = announced(description);
    assert_eq!(bytes[..5], [5, 1, 0, 1, 0]);
    assert_eq!(
        bytes[bytes.len() - 10..],
        [1, 0, 0, 0, 2, 0, 0, 0, b'N', b'A']
    );

    let on_change = AnnouncedContent::ApplicationStatus {
        state: ConnectionState::ERROR,
        cyclic: None,
    };
    assert_eq!(announced(on_change), [5, 1, 0, 2, 0, 0, 3, 0, 0, 0]);
    let cyclic = AnnouncedContent::ApplicationStatus {
        state: ConnectionState::OPERATIONAL,
        cyclic: Some(CyclicStatus {
            next_report_time: DateTime(2),
            timestamp: DateTime(1),
        }),
    };
    let times = [2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0];
    let status = [&[5, 1, 0, 2, 0, 1, 2, 0, 0, 0][..], &times].concat();
    assert_eq!(announced(cyclic), status);
}

#[test]
fn connections_are_an_array_without_a_status() {
    let connections = [PubSubConnectionDataType::default(); 2];
    let bytes = announced(AnnouncedContent::PubSubConnections(WireArray::new(
        &connections,
    )));
    assert_eq!(bytes[..7], [4, 1, 0, 2, 0, 0, 0]);
    let one = (bytes.len() - 7) / 2;
    assert_eq!(bytes[7..7 + one], bytes[7 + one..]);

    // The form of other stacks is recognized, and any other form is rejected.
    let single = announced(AnnouncedContent::PubSubConnection {
        connection: connections[0],
        status: StatusCode::GOOD,
    });
    assert_eq!(single.len(), 3 + one + 4);
    assert!(Announcement::decode_body(&bytes[..bytes.len() - 1]).is_err());
    assert_eq!(
        Announcement::decode_body(&[4, 1, 0, 0, 0, 0, 0, 9]),
        Err(DecodeError::TrailingBytes(1))
    );
    let padded = Announcement::decode_body(&[4, 1, 0, 0, 0, 0, 0, 0, 0]);
    assert_eq!(padded, Announcement::decode_body(&[4, 1, 0, 0, 0, 0, 0]));
    assert!(padded.is_ok());
}

#[test]
fn every_data_set_writer_has_a_status() {
    let uneven = Announcement {
        sequence_number: 0,
        announced: AnnouncedContent::DataSetWriterConfiguration {
            writer_ids: WireArray::new(&[1, 2]),
            writer_group: WriterGroupDataType::default(),
            statuses: WireArray::new(&[StatusCode::GOOD]),
        },
    };
    let refused = uneven.encode_body(&mut Vec::new());
    assert!(matches!(refused, Err(EncodeError::Misplaced(_))));

    let mut bytes = announced(AnnouncedContent::DataSetWriterConfiguration {
        writer_ids: WireArray::new(&[1]),
        writer_group: WriterGroupDataType::default(),
        statuses: WireArray::new(&[StatusCode::GOOD]),
    });
    bytes.truncate(bytes.len() - 8);
    bytes.extend([0; 4]);
    let error = DecodeError::Reserved {
        field: "number of statusCodes",
        value: 0,
    };
    assert_eq!(Announcement::decode_body(&bytes), Err(error));
}

#[test]
fn null_and_empty_lists_stay_apart() {
    let with = |fields| {
        announced(AnnouncedContent::DataSetMetaData {
            writer_id: 1,
            meta_data: DataSetMetaDataType {
                fields,
                ..DataSetMetaDataType::default()
            },
            status: StatusCode::GOOD,
        })
    };
    assert_ne!(with(WireArray::null()), with(WireArray::new(&[])));
    assert_ne!(WireArray::<u16>::null(), WireArray::new(&[]));
}

#[test]
fn other_messages_are_not_taken_for_discovery() {
    let data = [0x01, 0x01, 0x00, 0x00];
    let data = NetworkMessage::decode(&data).unwrap();
    assert!(matches!(Probe::decode(&data), Err(DecodeError::Misread(_))));
    assert!(matches!(
        Announcement::decode(&data),
        Err(DecodeError::Misread(_))
    ));

    let mut probe = Vec::new();
    Probe::PublisherEndpoints
        .encode(Some(PublisherId::Byte(1)), SecurityHeader::NONE, &mut probe)
        .unwrap();
    let message = NetworkMessage::decode(&probe).unwrap();
    assert_eq!(
        Announcement::decode(&message),
        Err(DecodeError::Misread("not a discovery announcement"))
    );

    let signed = SecurityHeader {
        signed: true,
        ..SecurityHeader::NONE
    };
    let mut sealed = Vec::new();
    Probe::PublisherEndpoints
        .encode(Some(PublisherId::Byte(1)), signed, &mut sealed)
        .unwrap();
    let message = NetworkMessage::decode(&sealed).unwrap();
    assert!(matches!(
        Probe::decode(&message),
        Err(DecodeError::Misread(_))
    ));

    // ExtendedFlags2 bit 0 marks a chunk.
    probe[2] |= 1;
    let message = NetworkMessage::decode(&probe).unwrap();
    assert_eq!(
        Probe::decode(&message),
        Err(DecodeError::Misread("a chunk, to be reassembled first"))
    );
}

#[test]
fn an_announcement_in_chunks_is_read_from_the_whole_of_them() {
    let announcement = Announcement {
        sequence_number: 1,
        announced: AnnouncedContent::ApplicationDescription {
            description: ApplicationDescription {
                application_uri: Some("urn:cell:robot"),
                ..ApplicationDescription::default()
            },
            capabilities: WireArray::null(),
        },
    };
    let sent = body(&announcement);
    let total = u32::try_from(sent.len()).unwrap();
    let mut whole = Vec::new();
    for piece in sent.chunks(20) {
        let offset = u32::try_from(whole.len()).unwrap();
        // Version 1 with PublisherId Byte 7, SecurityHeader, chunk of an announcement; no security.
        let headers = [0x91, 0x90, 0x09, 7, 0, 0, 0, 0, 0, 0];
        let datagram = [
            &headers[..],
            &announcement.sequence_number.to_le_bytes(),
            &offset.to_le_bytes(),
            &total.to_le_bytes(),
            piece,
        ]
        .concat();
        let message = NetworkMessage::decode(&datagram).unwrap();
        assert!(Announcement::decode(&message).is_err());
        let chunk = message.chunk().unwrap();
        assert_eq!((chunk.writer_id, chunk.message_sequence_number), (None, 1));
        whole.extend_from_slice(chunk.data);
    }
    assert_eq!(Announcement::decode_body(&whole), Ok(announcement));
}

#[test]
fn metadata_fit_messages_of_their_major_version() {
    let version = ConfigurationVersion {
        major: 10,
        minor: 20,
    };
    for (major_version, minor_version, found) in [
        (None, None, VersionMatch::Unsaid),
        (Some(10), Some(20), VersionMatch::Same),
        (Some(10), None, VersionMatch::Same),
        (None, Some(20), VersionMatch::Same),
        (Some(10), Some(21), VersionMatch::Minor),
        (Some(10), Some(15), VersionMatch::Minor),
        (Some(11), Some(20), VersionMatch::Major),
        (Some(9), None, VersionMatch::Major),
        (None, Some(21), VersionMatch::Major),
    ] {
        let header = DataSetHeader {
            major_version,
            minor_version,
            ..DataSetHeader::default()
        };
        assert_eq!(version.compare(&header), found, "{header:?}");
    }
}

/// Returns the body with SequenceNumber 1 after a round trip.
fn announced(announced: AnnouncedContent<'_>) -> Vec<u8> {
    let announcement = Announcement {
        sequence_number: 1,
        announced,
    };
    let bytes = body(&announcement);
    assert_eq!(Announcement::decode_body(&bytes), Ok(announcement));
    bytes
}

/// Returns an ActionMetaData announcement from its table (OPC 10000-14, 7.2.4.6.11), with a number
/// of ActionMethods.
fn action_meta_data(methods: i32) -> Vec<u8> {
    let null = [0xFF; 4];
    let meta_data = [
        &null[..],
        &null,
        &null,
        &null,                                 // DataTypeSchemaHeader
        &[4, 0, 0, 0, b'h', b'o', b'm', b'e'], // Name
        &[0],                                  // Description
        &null,                                 // Fields
        &[0; 16],                              // DataSetClassId
        &[1, 0, 0, 0, 2, 0, 0, 0],             // ConfigurationVersion
    ]
    .concat();
    let target = |id| [&[id, 0][..], &[1, 0, 0, 0, b'a' + id], &[0]].concat();
    let method = [0, 85, 1, 2, 0x59, 0x1B]; // ObjectId i=85, MethodId ns=2;i=7001
    let mut body = vec![7, 3, 0]; // ActionMetaData, SequenceNumber 3
    body.extend([61, 0]); // DataSetWriterId
    body.extend([2, 0, 0, 0]);
    body.extend([target(1), target(2)].concat());
    body.extend([&meta_data[..], &meta_data].concat());
    body.extend(methods.to_le_bytes());
    for _ in 0..methods {
        body.extend(method);
    }
    body
}

#[test]
fn an_action_is_announced_with_a_method_for_each_target_or_none() {
    for methods in [-1, 0, 2] {
        let bytes = action_meta_data(methods);
        let announcement = Announcement::decode_body(&bytes).unwrap();
        let AnnouncedContent::ActionMetaData(action) = announcement.announced else {
            unreachable!("{announcement:?}")
        };
        assert_eq!((action.writer_id, action.name()), (61, Some("home")));
        let (target, method) = action.target(2).unwrap();
        assert_eq!(target.name, Some("c"));
        let method_id = method.map(|method| method.method_id);
        assert_eq!(
            method_id,
            (methods == 2).then_some(NodeId::numeric(2, 7001))
        );
        assert_eq!(action.target(3), None);
        assert_eq!(body(&announcement), bytes);
    }
    let fault = DecodeError::Reserved {
        field: "number of ActionMethods",
        value: 1,
    };
    assert_eq!(Announcement::decode_body(&action_meta_data(1)), Err(fault));

    let bytes = action_meta_data(2);
    let announcement = Announcement::decode_body(&bytes).unwrap();
    let AnnouncedContent::ActionMetaData(mut action) = announcement.announced else {
        unreachable!("{announcement:?}")
    };
    action.response.configuration_version.major += 1;
    assert_eq!(action.name(), None, "not of one Action");
    action.action_targets = WireArray::new(&[]);
    let refused = Announcement {
        announced: AnnouncedContent::ActionMetaData(action),
        ..announcement
    }
    .encode_body(&mut Vec::new());
    assert!(matches!(refused, Err(EncodeError::Misplaced(_))));
}
