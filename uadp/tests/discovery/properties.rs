//! Properties of every message: decoding returns the encoded values, no part of a message is
//! accepted as a complete message, and no bytes cause a panic.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use uadp::discovery::{
    ActionMetaData, ActionMethodDataType, ActionTargetDataType, AnnouncedContent, Announcement,
    ApplicationDescription, ApplicationType, ConfigurationVersion, ConnectionState, CyclicStatus,
    DataSetMetaDataType, DataSetReaderDataType, DataSetWriterDataType, DataTypeSchemaHeader,
    EndpointDescription, EnumDefinition, EnumDescription, EnumField, FieldMetaData, KeyValuePair,
    MessageSecurityMode, Probe, PubSubConnectionDataType, PubSubGroupDataType, ReaderGroupDataType,
    SimpleTypeDescription, StructureDefinition, StructureDescription, StructureField,
    StructureType, UserTokenPolicy, UserTokenType, WireArray, WriterGroupDataType,
};
use uadp::{
    DateTime, ExtensionBody, ExtensionObject, Guid, LocalizedText, NetworkMessage, NodeId,
    QualifiedName, Scalar, StatusCode, Variant,
};

use crate::discovery::asyncua::bodies;
use crate::discovery::{body, datagram, probe_body};

/// Leaks the values, because the structures borrow them. The test program is short-lived.
fn leak<T>(values: Vec<T>) -> &'static [T] {
    values.leak()
}

fn list<T: std::fmt::Debug + Clone + 'static>(
    element: impl Strategy<Value = T>,
) -> impl Strategy<Value = WireArray<'static, T>>
where
    WireArray<'static, T>: std::fmt::Debug,
{
    option::weighted(0.8, vec(element, 0..3)).prop_map(|elements| {
        elements.map_or(WireArray::null(), |elements| WireArray::new(leak(elements)))
    })
}

fn text() -> impl Strategy<Value = Option<&'static str>> {
    option::of(".{0,5}").prop_map(|text| text.map(|text| &*text.leak()))
}

fn texts() -> impl Strategy<Value = WireArray<'static, Option<&'static str>>> {
    list(text())
}

fn double() -> impl Strategy<Value = f64> {
    any::<i32>().prop_map(f64::from)
}

fn guid() -> impl Strategy<Value = Guid> {
    any::<[u8; 16]>().prop_map(Guid)
}

fn node_id() -> impl Strategy<Value = NodeId<'static>> {
    prop_oneof![
        (any::<u16>(), any::<u32>()).prop_map(|(namespace, id)| NodeId::numeric(namespace, id)),
        any::<u8>().prop_map(|id| NodeId::numeric(0, id.into())),
        (any::<u16>(), ".{0,5}").prop_map(|(namespace, id)| NodeId::string(namespace, id.leak())),
    ]
}

fn qualified_name() -> impl Strategy<Value = QualifiedName<'static>> {
    (any::<u16>(), text()).prop_map(|(namespace, name)| QualifiedName { namespace, name })
}

fn localized_text() -> impl Strategy<Value = LocalizedText<'static>> {
    (text(), text()).prop_map(|(locale, text)| LocalizedText { locale, text })
}

fn variant() -> impl Strategy<Value = Variant<'static>> {
    prop_oneof![
        Just(Variant::Null),
        any::<u16>().prop_map(|value| Scalar::UInt16(value).into()),
        text().prop_map(|value| Scalar::String(value).into()),
    ]
}

fn extension_object() -> impl Strategy<Value = ExtensionObject<'static>> {
    let body = prop_oneof![
        Just(ExtensionBody::None),
        vec(any::<u8>(), 0..5).prop_map(|body| ExtensionBody::Binary(leak(body))),
        ".{0,5}".prop_map(|body| ExtensionBody::Xml(body.leak())),
    ];
    (node_id(), body).prop_map(|(type_id, body)| ExtensionObject { type_id, body })
}

fn property() -> impl Strategy<Value = KeyValuePair<'static>> {
    (qualified_name(), variant()).prop_map(|(key, value)| KeyValuePair { key, value })
}

fn application() -> impl Strategy<Value = ApplicationDescription<'static>> {
    (
        text(),
        text(),
        localized_text(),
        any::<i32>(),
        text(),
        text(),
        texts(),
    )
        .prop_map(|(uri, product, name, kind, gateway, profile, urls)| {
            ApplicationDescription {
                application_uri: uri,
                product_uri: product,
                application_name: name,
                application_type: ApplicationType(kind),
                gateway_server_uri: gateway,
                discovery_profile_uri: profile,
                discovery_urls: urls,
            }
        })
}

fn endpoint() -> impl Strategy<Value = EndpointDescription<'static>> {
    let token = (text(), any::<i32>(), text(), text()).prop_map(|(id, kind, issued, url)| {
        UserTokenPolicy {
            policy_id: id,
            token_type: UserTokenType(kind),
            issued_token_type: issued,
            issuer_endpoint_url: url,
            security_policy_uri: id,
        }
    });
    (
        text(),
        application(),
        option::of(vec(any::<u8>(), 0..5)),
        any::<i32>(),
        list(token),
        any::<u8>(),
    )
        .prop_map(
            |(url, server, certificate, mode, tokens, level)| EndpointDescription {
                endpoint_url: url,
                server,
                server_certificate: certificate.map(leak),
                security_mode: MessageSecurityMode(mode),
                security_policy_uri: url,
                user_identity_tokens: tokens,
                transport_profile_uri: url,
                security_level: level,
            },
        )
}

fn field() -> impl Strategy<Value = FieldMetaData<'static>> {
    (
        (text(), localized_text(), any::<u16>(), any::<u8>()),
        (node_id(), any::<i32>(), list(any::<u32>())),
        (any::<u32>(), guid(), list(property())),
    )
        .prop_map(|(a, b, c)| FieldMetaData {
            name: a.0,
            description: a.1,
            field_flags: a.2,
            built_in_type: a.3,
            data_type: b.0,
            value_rank: b.1,
            array_dimensions: b.2,
            max_string_length: c.0,
            data_set_field_id: c.1,
            properties: c.2,
        })
}

fn structure() -> impl Strategy<Value = StructureDescription<'static>> {
    let field = (
        (text(), localized_text(), node_id()),
        (
            any::<i32>(),
            list(any::<u32>()),
            any::<u32>(),
            any::<bool>(),
        ),
    )
        .prop_map(|(a, b)| StructureField {
            name: a.0,
            description: a.1,
            data_type: a.2,
            value_rank: b.0,
            array_dimensions: b.1,
            max_string_length: b.2,
            is_optional: b.3,
        });
    (
        node_id(),
        qualified_name(),
        node_id(),
        any::<i32>(),
        list(field),
    )
        .prop_map(|(id, name, encoding, kind, fields)| StructureDescription {
            data_type_id: id,
            name,
            structure_definition: StructureDefinition {
                default_encoding_id: encoding,
                base_data_type: id,
                structure_type: StructureType(kind),
                fields,
            },
        })
}

fn schema() -> impl Strategy<Value = DataTypeSchemaHeader<'static>> {
    let value = (any::<i64>(), localized_text(), text()).prop_map(|(value, display_name, name)| {
        EnumField {
            value,
            display_name,
            description: display_name,
            name,
        }
    });
    let enumeration = (node_id(), qualified_name(), list(value), any::<u8>()).prop_map(
        |(data_type_id, name, fields, built_in_type)| EnumDescription {
            data_type_id,
            name,
            enum_definition: EnumDefinition { fields },
            built_in_type,
        },
    );
    let simple = (node_id(), qualified_name(), any::<u8>()).prop_map(
        |(data_type_id, name, built_in_type)| SimpleTypeDescription {
            data_type_id,
            name,
            base_data_type: data_type_id,
            built_in_type,
        },
    );
    (texts(), list(structure()), list(enumeration), list(simple)).prop_map(
        |(namespaces, structures, enumerations, simple)| DataTypeSchemaHeader {
            namespaces,
            structure_data_types: structures,
            enum_data_types: enumerations,
            simple_data_types: simple,
        },
    )
}

fn meta_data() -> impl Strategy<Value = DataSetMetaDataType<'static>> {
    (
        schema(),
        text(),
        localized_text(),
        list(field()),
        guid(),
        any::<(u32, u32)>(),
    )
        .prop_map(
            |(schema, name, description, fields, class_id, (major, minor))| DataSetMetaDataType {
                schema,
                name,
                description,
                fields,
                data_set_class_id: class_id,
                configuration_version: ConfigurationVersion { major, minor },
            },
        )
}

fn group() -> impl Strategy<Value = PubSubGroupDataType<'static>> {
    (
        text(),
        any::<bool>(),
        any::<i32>(),
        list(endpoint()),
        any::<u32>(),
        list(property()),
    )
        .prop_map(
            |(name, enabled, mode, services, size, properties)| PubSubGroupDataType {
                name,
                enabled,
                security_mode: MessageSecurityMode(mode),
                security_group_id: name,
                security_key_services: services,
                max_network_message_size: size,
                group_properties: properties,
            },
        )
}

fn writer_group() -> impl Strategy<Value = WriterGroupDataType<'static>> {
    let writer = (
        (text(), any::<bool>(), any::<u16>(), any::<u32>()),
        (any::<u32>(), list(property())),
        (extension_object(), extension_object()),
    )
        .prop_map(|(a, b, c)| DataSetWriterDataType {
            name: a.0,
            enabled: a.1,
            data_set_writer_id: a.2,
            data_set_field_content_mask: a.3,
            key_frame_count: b.0,
            data_set_name: a.0,
            data_set_writer_properties: b.1,
            transport_settings: c.0,
            message_settings: c.1,
        });
    (
        group(),
        (any::<u16>(), double(), double(), any::<u8>()),
        (texts(), text()),
        (extension_object(), extension_object()),
        list(writer),
    )
        .prop_map(|(group, a, b, c, writers)| WriterGroupDataType {
            group,
            writer_group_id: a.0,
            publishing_interval: a.1,
            keep_alive_time: a.2,
            priority: a.3,
            locale_ids: b.0,
            header_layout_uri: b.1,
            transport_settings: c.0,
            message_settings: c.1,
            data_set_writers: writers,
        })
}

fn reader_group() -> impl Strategy<Value = ReaderGroupDataType<'static>> {
    let reader = (
        (text(), any::<bool>(), variant(), any::<(u16, u16)>()),
        (meta_data(), any::<(u32, u32)>(), double(), any::<i32>()),
        (list(endpoint()), list(property())),
        (extension_object(), extension_object(), extension_object()),
    )
        .prop_map(|(a, b, c, d)| DataSetReaderDataType {
            name: a.0,
            enabled: a.1,
            publisher_id: a.2,
            writer_group_id: a.3.0,
            data_set_writer_id: a.3.1,
            data_set_meta_data: b.0,
            data_set_field_content_mask: b.1.0,
            message_receive_timeout: b.2,
            key_frame_count: b.1.1,
            header_layout_uri: a.0,
            security_mode: MessageSecurityMode(b.3),
            security_group_id: a.0,
            security_key_services: c.0,
            data_set_reader_properties: c.1,
            transport_settings: d.0,
            message_settings: d.1,
            subscribed_data_set: d.2,
        });
    (
        group(),
        extension_object(),
        extension_object(),
        list(reader),
    )
        .prop_map(|(group, transport, message, readers)| ReaderGroupDataType {
            group,
            transport_settings: transport,
            message_settings: message,
            data_set_readers: readers,
        })
}

fn connection() -> impl Strategy<Value = PubSubConnectionDataType<'static>> {
    (
        (text(), any::<bool>(), variant(), text()),
        (extension_object(), list(property()), extension_object()),
        list(writer_group()),
        list(reader_group()),
    )
        .prop_map(
            |(a, b, writer_groups, reader_groups)| PubSubConnectionDataType {
                name: a.0,
                enabled: a.1,
                publisher_id: a.2,
                transport_profile_uri: a.3,
                address: b.0,
                connection_properties: b.1,
                transport_settings: b.2,
                writer_groups,
                reader_groups,
            },
        )
}

fn action() -> impl Strategy<Value = ActionMetaData<'static>> {
    let target = (any::<u16>(), text(), localized_text()).prop_map(|(id, name, description)| {
        ActionTargetDataType {
            action_target_id: id,
            name,
            description,
        }
    });
    let method = (node_id(), node_id()).prop_map(|(object_id, method_id)| ActionMethodDataType {
        object_id,
        method_id,
    });
    (
        any::<u16>(),
        vec((target, method), 0..3),
        meta_data(),
        meta_data(),
        any::<bool>(),
    )
        .prop_map(|(writer_id, targets, request, response, with_methods)| {
            let (targets, methods): (Vec<_>, Vec<_>) = targets.into_iter().unzip();
            ActionMetaData {
                writer_id,
                action_targets: WireArray::new(leak(targets)),
                request,
                response,
                action_methods: if with_methods {
                    WireArray::new(leak(methods))
                } else {
                    WireArray::null()
                },
            }
        })
}

fn announced() -> impl Strategy<Value = AnnouncedContent<'static>> {
    let status = || any::<u32>().prop_map(StatusCode);
    prop_oneof![
        (list(endpoint()), status()).prop_map(|(endpoints, status)| {
            AnnouncedContent::PublisherEndpoints { endpoints, status }
        }),
        (any::<u16>(), meta_data(), status()).prop_map(|(writer_id, meta_data, status)| {
            AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data,
                status,
            }
        }),
        (vec((any::<u16>(), status()), 0..3), writer_group()).prop_map(|(writers, group)| {
            let (ids, statuses): (Vec<_>, Vec<_>) = writers.into_iter().unzip();
            AnnouncedContent::DataSetWriterConfiguration {
                writer_ids: WireArray::new(leak(ids)),
                writer_group: group,
                statuses: WireArray::new(leak(statuses)),
            }
        }),
        list(connection()).prop_map(AnnouncedContent::PubSubConnections),
        (application(), texts()).prop_map(|(description, capabilities)| {
            AnnouncedContent::ApplicationDescription {
                description,
                capabilities,
            }
        }),
        (any::<i32>(), option::of(any::<(i64, i64)>())).prop_map(|(state, times)| {
            AnnouncedContent::ApplicationStatus {
                state: ConnectionState(state),
                cyclic: times.map(|(next, now)| CyclicStatus {
                    next_report_time: DateTime(next),
                    timestamp: DateTime(now),
                }),
            }
        }),
        list(connection()).prop_map(AnnouncedContent::ActionResponder),
        action().prop_map(AnnouncedContent::ActionMetaData),
    ]
}

fn announcement() -> impl Strategy<Value = Announcement<'static>> {
    (any::<u16>(), announced()).prop_map(|(sequence_number, announced)| Announcement {
        sequence_number,
        announced,
    })
}

fn probe() -> impl Strategy<Value = Probe<'static>> {
    prop_oneof![
        Just(Probe::PublisherEndpoints),
        Just(Probe::FindApplications),
        list(any::<u16>()).prop_map(Probe::DataSetMetaData),
        list(any::<u16>()).prop_map(Probe::DataSetWriterConfiguration),
        any::<(u16, bool)>().prop_map(|(id, writers)| Probe::WriterGroupConfiguration {
            writer_group_id: id,
            include_data_set_writers: writers,
        }),
        (texts(), any::<(bool, bool)>()).prop_map(|(uris, (groups, writers))| {
            Probe::PubSubConnections {
                transport_profile_uris: uris,
                include_writer_groups: groups,
                include_data_set_writers: writers,
            }
        }),
    ]
}

/// Reads everything. A decoded message always has the same encoding.
fn read_on(bytes: &[u8]) {
    if let Ok(announcement) = Announcement::decode_body(bytes) {
        let written = body(&announcement);
        assert!(!format!("{announcement:?}").is_empty());
        let again = Announcement::decode_body(&written).unwrap();
        assert_eq!(body(&again), written);
    }
    if let Ok(probe) = Probe::decode_body(bytes) {
        assert_eq!(Probe::decode_body(&probe_body(&probe)), Ok(probe));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn an_announcement_comes_back_as_it_was_written(sent in announcement()) {
        let bytes = datagram(&sent);
        let message = NetworkMessage::decode(&bytes).unwrap();
        let heard = Announcement::decode(&message).unwrap();
        prop_assert_eq!(heard, sent);
        prop_assert_eq!(datagram(&heard), bytes);
    }

    #[test]
    fn a_probe_comes_back_as_it_was_written(sent in probe()) {
        let bytes = probe_body(&sent);
        prop_assert_eq!(Probe::decode_body(&bytes), Ok(sent));
        for len in 0..bytes.len() {
            prop_assert!(Probe::decode_body(&bytes[..len]).is_err());
        }
    }

    #[test]
    fn an_announcement_cut_short_does_not_pass_for_a_whole_one(sent in announcement()) {
        let mut bytes = body(&sent);
        for len in 0..bytes.len() {
            prop_assert!(Announcement::decode_body(&bytes[..len]).is_err(), "{} of {}", len, bytes.len());
        }
        bytes.push(1);
        prop_assert!(Announcement::decode_body(&bytes).is_err());
    }

    #[test]
    fn random_bytes_do_not_panic(kind in 0..9u8, bytes in vec(any::<u8>(), 0..200)) {
        read_on(&bytes);
        read_on(&[&[kind, 0, 0], &*bytes].concat());
    }

    #[test]
    fn changed_bytes_do_not_panic(
        which in 0..6usize,
        changes in vec((any::<proptest::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let mut bytes = bodies().swap_remove(which);
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        read_on(&bytes);
    }
}
