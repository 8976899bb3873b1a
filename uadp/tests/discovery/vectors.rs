//! The datagrams `composite_probe_*` and `composite_announce_*` of `tests/vectors`.

use std::path::Path;

use serde_json::{Value, json};
use uadp::discovery::{
    AnnouncedContent, Announcement, ApplicationDescription, ApplicationType, ConfigurationVersion,
    DataSetMetaDataType, DataSetWriterDataType, EndpointDescription, FieldMetaData,
    MessageSecurityMode, NetworkAddressUrlDataType, Probe, PubSubConnectionDataType,
    PubSubGroupDataType, SettingsStructure, UadpDataSetWriterMessageDataType,
    UadpWriterGroupMessageDataType, WireArray, WriterGroupDataType,
};
use uadp::{
    ExtensionObject, Guid, LocalizedText, NetworkMessage, NodeId, PublisherId, Scalar,
    SecurityHeader, StatusCode, Variant,
};

use crate::discovery::{datagram, unhex};

#[test]
fn probes_are_read_as_described_and_written_back() {
    for (name, probe) in [
        ("composite_probe_endpoints", Probe::PublisherEndpoints),
        (
            "composite_probe_metadata",
            Probe::DataSetMetaData(WireArray::new(&[1, 2])),
        ),
        (
            "composite_probe_writerconfig",
            Probe::DataSetWriterConfiguration(WireArray::new(&[1, 2])),
        ),
    ] {
        let bytes = vector(name);
        let message = NetworkMessage::decode(&bytes).unwrap();
        let found = Probe::decode(&message).unwrap();
        let (information_type, ids) = match found {
            Probe::PublisherEndpoints => (1, None),
            Probe::DataSetMetaData(ids) => (2, Some(ids)),
            Probe::DataSetWriterConfiguration(ids) => (3, Some(ids)),
            Probe::WriterGroupConfiguration { .. }
            | Probe::PubSubConnections { .. }
            | Probe::FindApplications => unreachable!("{found:?}"),
        };
        let mut described = json!({ "probeType": 1, "informationType": information_type });
        if let Some(ids) = ids {
            described["dataSetWriterIds"] = ids.iter().collect();
        }
        assert_eq!(described, described_in(name, &message)["probe"], "{name}");

        for probe in [probe, found] {
            let mut written = Vec::new();
            probe
                .encode(
                    message.header().publisher_id,
                    SecurityHeader::NONE,
                    &mut written,
                )
                .unwrap();
            assert_eq!(written, bytes, "{name}");
        }
    }
}

#[test]
fn announcements_are_read_as_described_and_written_back() {
    for name in [
        "composite_announce_connection",
        "composite_announce_endpoints",
        "composite_announce_metadata",
        "composite_announce_metadata_unknown_writer",
        "composite_announce_writerconfig",
    ] {
        let bytes = vector(name);
        let message = NetworkMessage::decode(&bytes).unwrap();
        let found = Announcement::decode(&message).unwrap();
        let json = &described_in(name, &message)["announcement"];
        assert_eq!(json["type"], found.announced.announcement_type());
        assert_eq!(json["sequenceNumber"], found.sequence_number);
        match found.announced {
            AnnouncedContent::PublisherEndpoints { endpoints, status } => {
                assert_eq!(json["endpoints"], endpoints.len());
                assert_eq!(json["statusCode"], status.0);
            }
            AnnouncedContent::DataSetMetaData {
                writer_id, status, ..
            } => {
                assert_eq!(json["dataSetWriterId"], writer_id);
                assert_eq!(json["statusCode"], status.0);
            }
            AnnouncedContent::DataSetWriterConfiguration {
                writer_ids,
                statuses,
                ..
            } => {
                assert_eq!(
                    json["dataSetWriterIds"],
                    writer_ids.iter().collect::<Value>()
                );
                let statuses: Value = statuses.iter().map(|status| status.0).collect();
                assert_eq!(json["statusCodes"], statuses);
            }
            AnnouncedContent::PubSubConnection { status, .. } => {
                assert_eq!(status, StatusCode::GOOD)
            }
            AnnouncedContent::PubSubConnections(_)
            | AnnouncedContent::ApplicationDescription { .. }
            | AnnouncedContent::ApplicationStatus { .. }
            | AnnouncedContent::ActionResponder(_)
            | AnnouncedContent::ActionMetaData(_) => unreachable!("{found:?}"),
        }
        assert_eq!(datagram(&found), bytes, "{name}");
    }
}

#[test]
fn the_endpoint_of_the_vector_is_what_open62541_was_given() {
    let endpoints = [EndpointDescription {
        endpoint_url: Some("opc.tcp://cell1:4840/"),
        server: ApplicationDescription {
            application_uri: Some("urn:x:server"),
            application_name: LocalizedText {
                locale: Some("en"),
                text: Some("srv"),
            },
            application_type: ApplicationType::SERVER,
            ..ApplicationDescription::default()
        },
        security_mode: MessageSecurityMode::NONE,
        security_policy_uri: Some("http://opcfoundation.org/UA/SecurityPolicy#None"),
        ..EndpointDescription::default()
    }];
    let announced = AnnouncedContent::PublisherEndpoints {
        endpoints: WireArray::new(&endpoints),
        status: StatusCode::GOOD,
    };
    same("composite_announce_endpoints", announced);
}

#[test]
fn the_metadata_of_the_vector_are_what_open62541_was_given() {
    let battery = FieldMetaData {
        name: Some("battery"),
        built_in_type: 11,
        data_type: NodeId::numeric(0, 11),
        value_rank: -1,
        data_set_field_id: Guid::from_fields(
            0x7296_2B91,
            0xFA75,
            0x4AE6,
            [0x8D, 0x28, 0xB4, 0x04, 0xDC, 0x7D, 0xAF, 0x63],
        ),
        ..FieldMetaData::default()
    };
    let pose = FieldMetaData {
        name: Some("pose"),
        built_in_type: 11,
        data_type: NodeId::numeric(0, 11),
        value_rank: 1,
        array_dimensions: WireArray::new(&[3]),
        ..FieldMetaData::default()
    };
    let text = FieldMetaData {
        name: Some("text"),
        description: LocalizedText {
            locale: Some("en"),
            text: Some("state text"),
        },
        field_flags: 1,
        built_in_type: 12,
        data_type: NodeId::numeric(0, 12),
        value_rank: -1,
        max_string_length: 32,
        ..FieldMetaData::default()
    };
    let fields = [battery, pose, text];
    let meta_data = DataSetMetaDataType {
        name: Some("robot_status"),
        fields: WireArray::new(&fields),
        configuration_version: ConfigurationVersion {
            major: 700_000_000,
            minor: 700_000_001,
        },
        ..DataSetMetaDataType::default()
    };
    for (name, writer_id, status) in [
        ("composite_announce_metadata", 1, StatusCode::GOOD),
        (
            "composite_announce_metadata_unknown_writer",
            999,
            StatusCode(0x8035_0000),
        ),
    ] {
        let announced = AnnouncedContent::DataSetMetaData {
            writer_id,
            meta_data,
            status,
        };
        same(name, announced);
    }
    assert!(text.is_promoted() && !pose.is_promoted());
}

#[test]
fn the_configuration_of_the_vectors_is_what_open62541_was_given() {
    let mut buffers = [const { Vec::new() }; 3];
    let [writer_settings, group_settings, address] = &mut buffers;
    let writers = [DataSetWriterDataType {
        name: Some("w1"),
        enabled: true,
        data_set_writer_id: 1,
        key_frame_count: 1,
        data_set_name: Some("robot_status"),
        message_settings: UadpDataSetWriterMessageDataType {
            data_set_message_content_mask: 0x35,
            ..UadpDataSetWriterMessageDataType::default()
        }
        .write_object(writer_settings)
        .unwrap(),
        ..DataSetWriterDataType::default()
    }];
    let groups = [WriterGroupDataType {
        group: PubSubGroupDataType {
            name: Some("wg"),
            enabled: true,
            security_mode: MessageSecurityMode::NONE,
            max_network_message_size: 1400,
            ..PubSubGroupDataType::default()
        },
        writer_group_id: 100,
        publishing_interval: 100.0,
        keep_alive_time: 1000.0,
        message_settings: UadpWriterGroupMessageDataType {
            group_version: 684_931_200,
            network_message_content_mask: 0x47,
            ..UadpWriterGroupMessageDataType::default()
        }
        .write_object(group_settings)
        .unwrap(),
        data_set_writers: WireArray::new(&writers),
        ..WriterGroupDataType::default()
    }];
    let announced = AnnouncedContent::DataSetWriterConfiguration {
        writer_ids: WireArray::new(&[1]),
        writer_group: groups[0],
        statuses: WireArray::new(&[StatusCode::GOOD]),
    };
    same("composite_announce_writerconfig", announced);

    let connection = PubSubConnectionDataType {
        name: Some("conn"),
        enabled: true,
        publisher_id: Variant::Scalar(Scalar::UInt16(2234)),
        transport_profile_uri: Some(
            "http://opcfoundation.org/UA-Profile/Transport/pubsub-udp-uadp",
        ),
        address: NetworkAddressUrlDataType {
            network_interface: None,
            url: Some("opc.udp://224.0.0.22:4840"),
        }
        .write_object(address)
        .unwrap(),
        writer_groups: WireArray::new(&groups),
        ..PubSubConnectionDataType::default()
    };
    let announced = AnnouncedContent::PubSubConnection {
        connection,
        status: StatusCode::GOOD,
    };
    same("composite_announce_connection", announced);
}

#[test]
fn settings_are_decoded_on_demand_and_others_left_alone() {
    let bytes = vector("composite_announce_writerconfig");
    let message = NetworkMessage::decode(&bytes).unwrap();
    let announced = Announcement::decode(&message).unwrap().announced;
    let AnnouncedContent::DataSetWriterConfiguration { writer_group, .. } = announced else {
        unreachable!("{announced:?}")
    };
    let settings = UadpWriterGroupMessageDataType::from_object(&writer_group.message_settings);
    let settings = settings.unwrap().unwrap();
    assert_eq!(settings.network_message_content_mask, 0x47);
    assert!(settings.publishing_offset.is_null());
    let other = UadpDataSetWriterMessageDataType::from_object(&writer_group.message_settings);
    assert_eq!(other, Ok(None), "of another type");
    let null = UadpWriterGroupMessageDataType::from_object(&writer_group.transport_settings);
    assert_eq!(null, Ok(None), "null");

    let mut buffer = Vec::new();
    let object = settings.write_object(&mut buffer).unwrap();
    assert_eq!(object, writer_group.message_settings);
    let uadp::ExtensionBody::Binary(body) = object.body else {
        unreachable!("{object:?}")
    };
    let cut = ExtensionObject {
        body: uadp::ExtensionBody::Binary(&body[..body.len() - 1]),
        ..object
    };
    assert!(UadpWriterGroupMessageDataType::from_object(&cut).is_err());
}

/// Checks that the vector decodes to the announcement, and that the announcement encodes to the
/// vector.
fn same(name: &str, announced: AnnouncedContent<'_>) {
    let announcement = Announcement {
        sequence_number: 7,
        announced,
    };
    let bytes = vector(name);
    let message = NetworkMessage::decode(&bytes).unwrap();
    assert_eq!(Announcement::decode(&message), Ok(announcement), "{name}");
    assert_eq!(datagram(&announcement), bytes, "{name}");
}

/// Returns the description in the JSON file, after checking its header.
fn described_in(name: &str, message: &NetworkMessage<'_>) -> Value {
    let json: Value = serde_json::from_str(&file(&format!("{name}.json"))).unwrap();
    assert_eq!(
        json["publisherId"],
        json!({ "type": "UInt16", "value": 2234 })
    );
    assert_eq!(
        message.header().publisher_id,
        Some(PublisherId::UInt16(2234))
    );
    assert_eq!(message.security(), Some(SecurityHeader::NONE));
    assert_eq!(message.header().group, None);
    json
}

fn vector(name: &str) -> Vec<u8> {
    unhex(&file(&format!("{name}.hex")))
}

fn file(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    std::fs::read_to_string(folder.join(name)).unwrap()
}
