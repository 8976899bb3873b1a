//! Structures in the encoding of another stack. `asyncua.hex` was written by `encode_asyncua.py`
//! with asyncua 2.1.0; the values below repeat the values of the script.

use uadp::discovery::{
    ActionMetaData, ActionMethodDataType, ActionTargetDataType, AnnouncedContent, Announcement,
    ApplicationDescription, ApplicationType, ConfigurationVersion, DataSetMetaDataType,
    DataSetOrderingType, DataSetWriterDataType, DatagramConnectionTransport2DataType,
    DatagramConnectionTransportDataType, DatagramWriterGroupTransport2DataType,
    DatagramWriterGroupTransportDataType, EndpointDescription, EnumField, FieldMetaData,
    KeyValuePair, MessageSecurityMode, NetworkAddressUrlDataType, PubSubConnectionDataType,
    SettingsStructure, StructureType, UadpDataSetWriterMessageDataType,
    UadpWriterGroupMessageDataType, UserTokenPolicy, WireArray, WriterGroupDataType,
};
use uadp::{
    BuiltinType, Guid, LocalizedText, NodeId, NodeIdValue, QualifiedName, Scalar, StatusCode,
    Variant,
};

use crate::discovery::{body, unhex};

/// Returns the encoding of a structure.
pub(crate) fn structure(name: &str) -> Vec<u8> {
    let lines = include_str!("asyncua.hex").lines();
    let mut pairs = lines.map(|line| line.split_once(' ').unwrap());
    unhex(pairs.find(|(found, _)| *found == name).unwrap().1)
}

/// Returns bodies of announcements that contain the structures.
pub(crate) fn bodies() -> Vec<Vec<u8>> {
    let good = [0; 4];
    let one = [1, 0, 0, 0];
    let concat = |parts: &[&[u8]]| parts.concat();
    vec![
        concat(&[&[1, 7, 0], &one, &structure("endpoint"), &good]),
        concat(&[&[2, 7, 0], &[10, 0], &structure("meta_data"), &good]),
        concat(&[
            &[3, 7, 0],
            &one,
            &[10, 0],
            &structure("writer_group"),
            &one,
            &good,
        ]),
        concat(&[
            &[4, 7, 0],
            &[2, 0, 0, 0],
            &structure("connection"),
            &structure("old_connection"),
        ]),
        concat(&[&[6, 7, 0], &one, &structure("connection")]),
        concat(&[
            &[7, 7, 0],
            &[10, 0],
            &one,
            &structure("action_target"),
            &structure("meta_data"),
            &structure("meta_data"),
            &one,
            &structure("action_method"),
        ]),
    ]
}

#[test]
fn every_structure_is_written_back_byte_for_byte() {
    for bytes in bodies() {
        let announcement = Announcement::decode_body(&bytes).unwrap();
        assert_eq!(announcement.sequence_number, 7);
        assert_eq!(body(&announcement), bytes, "{announcement:#?}");
    }
}

#[test]
fn the_endpoint_is_read() {
    let bytes = &bodies()[0];
    let AnnouncedContent::PublisherEndpoints { endpoints, status } = announced(bytes) else {
        unreachable!()
    };
    assert_eq!(status, StatusCode::GOOD);
    let tokens = [UserTokenPolicy {
        policy_id: Some("anonymous"),
        ..UserTokenPolicy::default()
    }];
    let urls = [Some("opc.tcp://cell1:4840/"), None];
    let endpoint = endpoint(&tokens, &urls);
    assert_eq!(endpoints, WireArray::new(&[endpoint]));
}

#[test]
fn the_metadata_are_read_and_looked_up() {
    let bytes = &bodies()[1];
    let AnnouncedContent::DataSetMetaData { meta_data, .. } = announced(bytes) else {
        unreachable!()
    };
    check_meta_data(&meta_data);
}

#[test]
fn the_writer_group_is_read_with_its_settings() {
    let bytes = &bodies()[2];
    let AnnouncedContent::DataSetWriterConfiguration {
        writer_group,
        writer_ids,
        ..
    } = announced(bytes)
    else {
        unreachable!()
    };
    assert_eq!(writer_ids, WireArray::new(&[10]));
    check_writer_group(&writer_group);
}

#[test]
fn the_connections_are_read_with_their_settings() {
    let bytes = &bodies()[3];
    let AnnouncedContent::PubSubConnections(connections) = announced(bytes) else {
        unreachable!()
    };
    assert_eq!(connections.len(), 2);
    check_connection(&connections.get(0).unwrap());
    check_old_connection(&connections.get(1).unwrap());
    assert_eq!(connections.get(2), None);
}

#[test]
fn the_action_is_read() {
    let bytes = &bodies()[5];
    let AnnouncedContent::ActionMetaData(action) = announced(bytes) else {
        unreachable!()
    };
    let ActionMetaData {
        writer_id: 10,
        action_targets,
        request,
        response,
        action_methods,
    } = action
    else {
        unreachable!("{action:?}")
    };
    let target = ActionTargetDataType {
        action_target_id: 9,
        name: Some("target"),
        description: text("en", "it"),
    };
    assert_eq!(action_targets, WireArray::new(&[target]));
    let method = ActionMethodDataType {
        object_id: NodeId::string(2, "Robot"),
        method_id: NodeId::numeric(2, 7001),
    };
    assert_eq!(action_methods, WireArray::new(&[method]));
    check_meta_data(&request);
    assert_eq!(request, response);
}

fn announced(bytes: &[u8]) -> AnnouncedContent<'_> {
    Announcement::decode_body(bytes).unwrap().announced
}

fn text(locale: &'static str, text: &'static str) -> LocalizedText<'static> {
    LocalizedText {
        locale: Some(locale),
        text: Some(text),
    }
}

fn endpoint<'a>(
    tokens: &'a [UserTokenPolicy<'a>],
    urls: &'a [Option<&'a str>],
) -> EndpointDescription<'a> {
    EndpointDescription {
        endpoint_url: Some("opc.tcp://cell1:4840/"),
        server: ApplicationDescription {
            application_uri: Some("urn:cell:server"),
            product_uri: Some("urn:product"),
            application_name: text("en", "server"),
            application_type: ApplicationType::CLIENT_AND_SERVER,
            gateway_server_uri: None,
            discovery_profile_uri: None,
            discovery_urls: WireArray::new(urls),
        },
        server_certificate: Some(&[0x30, 0x82, 0x01]),
        security_mode: MessageSecurityMode::SIGN_AND_ENCRYPT,
        security_policy_uri: Some("http://opcfoundation.org/UA/SecurityPolicy#Basic256Sha256"),
        user_identity_tokens: WireArray::new(tokens),
        transport_profile_uri: Some(
            "http://opcfoundation.org/UA-Profile/Transport/uatcp-uasc-uabinary",
        ),
        security_level: 3,
    }
}

fn check_meta_data(meta_data: &DataSetMetaDataType<'_>) {
    assert_eq!(meta_data.name, Some("robot_status"));
    assert_eq!(meta_data.description, text("en", "the robot"));
    let version = ConfigurationVersion {
        major: 700_000_000,
        minor: 700_000_060,
    };
    assert_eq!(meta_data.configuration_version, version);
    let class_id = Guid::from_fields(0, 0, 0, [0, 0, 0, 0, 0, 0, 0, 1]);
    assert_eq!(meta_data.data_set_class_id, class_id);
    let field_id = Guid::from_fields(
        0x7296_2B91,
        0xFA75,
        0x4AE6,
        [0x8D, 0x28, 0xB4, 0x04, 0xDC, 0x7D, 0xAF, 0x63],
    );
    let properties = [KeyValuePair {
        key: QualifiedName {
            namespace: 0,
            name: Some("unit"),
        },
        value: Variant::Scalar(Scalar::Int32(42)),
    }];
    let pose = FieldMetaData {
        name: Some("pose"),
        description: text("en", "where it is"),
        field_flags: 1,
        built_in_type: 22,
        data_type: NodeId::numeric(1, 3001),
        value_rank: -1,
        array_dimensions: WireArray::new(&[]),
        max_string_length: 0,
        data_set_field_id: field_id,
        properties: WireArray::new(&properties),
    };
    assert_eq!(meta_data.fields, WireArray::new(&[pose]));
    assert_eq!(pose.builtin_type(), Some(BuiltinType::ExtensionObject));
    assert_eq!(meta_data.field(0), Some(pose));
    assert_eq!(meta_data.field(1), None);
    assert_eq!(meta_data.field_by_name("pose"), Some((0, pose)));
    assert_eq!(meta_data.field_by_name("post"), None);
    assert_eq!(meta_data.field_by_id(field_id), Some((0, pose)));
    assert_eq!(meta_data.field_by_id(class_id), None);
    check_schema(meta_data);
}

fn check_schema(meta_data: &DataSetMetaDataType<'_>) {
    let schema = &meta_data.schema;
    assert_eq!(
        schema.namespace_uri(0),
        Some("http://opcfoundation.org/UA/")
    );
    assert_eq!(schema.namespace_uri(1), Some("urn:cell:robot"));
    assert_eq!(schema.namespace_uri(2), None);

    let pose = schema.structure(NodeId::numeric(1, 3001)).unwrap();
    assert_eq!(pose.name.name, Some("Pose"));
    let definition = pose.structure_definition;
    assert_eq!(definition.default_encoding_id, NodeId::numeric(1, 5001));
    assert_eq!(
        definition.structure_type,
        StructureType::STRUCTURE_WITH_OPTIONAL_FIELDS
    );
    let [position, frame] = [0, 1].map(|index| definition.fields.get(index).unwrap());
    assert_eq!(position.name, Some("position"));
    assert_eq!(position.description, text("en", "in metres"));
    assert_eq!(position.array_dimensions, WireArray::new(&[3]));
    assert!(!position.is_optional);
    assert_eq!(frame.data_type, NodeId::string(1, "Frame"));
    assert_eq!(frame.max_string_length, 16);
    assert!(frame.is_optional);

    assert_eq!(schema.structure(NodeId::string(1, "Mode")), None);
    check_enumeration(meta_data);
}

fn check_enumeration(meta_data: &DataSetMetaDataType<'_>) {
    let schema = &meta_data.schema;
    let mode = schema.enumeration(NodeId::string(1, "Mode")).unwrap();
    assert_eq!(mode.built_in_type, BuiltinType::Int32.id());
    let works: EnumField<'_> = mode.enum_definition.field(-7).unwrap();
    assert_eq!(works.name, Some("Works"));
    assert_eq!(works.display_name.text, Some("works"));
    assert_eq!(mode.enum_definition.field(1), None);

    let frame = schema.simple_type(NodeId::string(1, "Frame")).unwrap();
    assert_eq!(frame.base_data_type.identifier, NodeIdValue::Numeric(12));
    assert_eq!(frame.built_in_type, BuiltinType::String.id());

    assert_eq!(schema.enumeration(NodeId::numeric(1, 3001)), None);
    assert_eq!(schema.simple_type(NodeId::NULL), None);
}

fn check_writer_group(writer_group: &WriterGroupDataType<'_>) {
    let group = &writer_group.group;
    assert_eq!(group.name, Some("group"));
    assert!(group.enabled);
    assert_eq!(group.security_mode, MessageSecurityMode::SIGN);
    assert_eq!(group.security_group_id, Some("keys"));
    assert_eq!(group.security_key_services.len(), 1);
    assert_eq!(group.max_network_message_size, 1472);
    let note = group.group_properties.get(0).unwrap();
    assert_eq!(note.key.namespace, 2);
    assert_eq!(note.value, Scalar::String(Some("text")).into());
    assert_eq!(writer_group.writer_group_id, 5);
    assert_eq!(
        (
            writer_group.publishing_interval,
            writer_group.keep_alive_time
        ),
        (100.0, 1000.0)
    );
    assert_eq!(writer_group.priority, 7);
    assert_eq!(
        writer_group.locale_ids,
        WireArray::new(&[Some("en"), Some("de")])
    );
    let transport =
        DatagramWriterGroupTransport2DataType::from_object(&writer_group.transport_settings);
    let transport = transport.unwrap().unwrap();
    assert_eq!(transport.message_repeat_count, 2);
    assert_eq!(transport.datagram_qos.len(), 1);
    assert_eq!(transport.discovery_announce_rate, 60);
    assert_eq!(transport.topic, Some("topic"));
    let message = UadpWriterGroupMessageDataType {
        group_version: 700_000_000,
        data_set_ordering: DataSetOrderingType::ASCENDING_WRITER_ID,
        network_message_content_mask: 0x47,
        sampling_offset: -1.0,
        publishing_offset: WireArray::new(&[0.5, 1.5]),
    };
    assert_eq!(
        UadpWriterGroupMessageDataType::from_object(&writer_group.message_settings),
        Ok(Some(message))
    );
    check_writer(&writer_group.data_set_writers.get(0).unwrap());
}

fn check_writer(writer: &DataSetWriterDataType<'_>) {
    assert_eq!(writer.data_set_writer_id, 10);
    assert_eq!(writer.data_set_field_content_mask, 0x20);
    assert_eq!(writer.key_frame_count, 5);
    let message = UadpDataSetWriterMessageDataType {
        data_set_message_content_mask: 0x25,
        configured_size: 64,
        network_message_number: 1,
        data_set_offset: 15,
    };
    assert_eq!(
        UadpDataSetWriterMessageDataType::from_object(&writer.message_settings),
        Ok(Some(message))
    );
}

fn check_connection(connection: &PubSubConnectionDataType<'_>) {
    assert_eq!(connection.name, Some("connection"));
    assert_eq!(connection.publisher_id, Scalar::UInt16(2).into());
    let address = NetworkAddressUrlDataType {
        network_interface: Some("eth0"),
        url: Some("opc.udp://239.0.0.1:4840"),
    };
    assert_eq!(
        NetworkAddressUrlDataType::from_object(&connection.address),
        Ok(Some(address))
    );
    let transport =
        DatagramConnectionTransport2DataType::from_object(&connection.transport_settings);
    let transport = transport.unwrap().unwrap();
    assert_eq!(transport.discovery_max_message_size, 4096);
    assert_eq!(discovery_url(&transport.discovery_address), Some(DISCOVERY));
    check_writer_group(&connection.writer_groups.get(0).unwrap());
    let readers = connection.reader_groups.get(0).unwrap();
    assert_eq!(readers.group.name, Some("readers"));
    let reader = readers.data_set_readers.get(0).unwrap();
    assert_eq!(reader.publisher_id, Scalar::UInt16(2).into());
    assert_eq!((reader.writer_group_id, reader.data_set_writer_id), (5, 10));
    assert_eq!(reader.message_receive_timeout, 250.0);
    check_meta_data(&reader.data_set_meta_data);
}

fn check_old_connection(connection: &PubSubConnectionDataType<'_>) {
    assert_eq!(connection.publisher_id, Scalar::String(Some("cell")).into());
    let transport =
        DatagramConnectionTransportDataType::from_object(&connection.transport_settings);
    let transport = transport.unwrap().unwrap();
    assert_eq!(discovery_url(&transport.discovery_address), Some(DISCOVERY));
    let group = connection.writer_groups.get(0).unwrap();
    let transport = DatagramWriterGroupTransportDataType {
        message_repeat_count: 3,
        message_repeat_delay: 2.5,
    };
    assert_eq!(
        DatagramWriterGroupTransportDataType::from_object(&group.transport_settings),
        Ok(Some(transport))
    );
}

fn discovery_url<'a>(address: &uadp::ExtensionObject<'a>) -> Option<&'a str> {
    NetworkAddressUrlDataType::from_object(address)
        .unwrap()
        .and_then(|address| address.url)
}

const DISCOVERY: &str = "opc.udp://224.0.2.14:4840";
