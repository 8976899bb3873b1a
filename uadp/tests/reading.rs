//! What a receiver meets on a network, datagram by datagram.

#![expect(clippy::unwrap_used, reason = "test code")]

use uadp::{
    Array, BuiltinType, DataSetMessage, DecodeError, ExpandedNodeId, Fields, LocalizedText,
    MessageKind, NetworkMessage, NodeId, PublisherId, QualifiedName, Scalar, Variant,
};

fn messages(datagram: &[u8]) -> Vec<Result<DataSetMessage<'_>, DecodeError>> {
    NetworkMessage::decode(datagram)
        .unwrap()
        .messages()
        .collect()
}

/// The fields of a datagram of the smallest header and one message of these bytes.
fn fields(message: &[u8]) -> Result<Vec<String>, DecodeError> {
    let datagram = [&[0x01], message].concat();
    let message = NetworkMessage::decode(&datagram)?
        .messages()
        .next()
        .unwrap()?;
    message
        .fields()?
        .map(|field| field.map(|field| format!("{field:?}")))
        .collect()
}

/// The one field of a block.
fn field(variant: &[u8]) -> Result<(), DecodeError> {
    let block = [&[1, 0], variant].concat();
    Fields::parse(&block)?.try_for_each(|field| field.map(|_| ()))
}

#[test]
fn a_heartbeat_has_no_fields_with_and_without_a_field_count() {
    assert_eq!(fields(&[0x01]), Ok(vec![]));
    assert_eq!(fields(&[0x01, 0, 0]), Ok(vec![]));
    assert_eq!(
        fields(&[0x01, 0]),
        Err(DecodeError::Truncated {
            field: "FieldCount",
            ..
        })
    );
}

#[test]
fn the_block_of_a_heartbeat_without_field_count_reads_as_no_fields() {
    let datagram = [0x01, 0x01];
    let message = NetworkMessage::decode(&datagram)
        .unwrap()
        .messages()
        .next()
        .unwrap()
        .unwrap();
    let block = message.fields().unwrap().bytes();
    assert_eq!(block, [0, 0]);
    assert!(Fields::parse(block).unwrap().is_empty());
}

#[test]
fn zero_padding_behind_the_fields_is_skipped_and_other_bytes_are_not() {
    let padded = [0x01, 1, 0, 0x03, 7, 0, 0, 0];
    assert_eq!(fields(&padded).unwrap().len(), 1);
    let behind = [0x01, 1, 0, 0x03, 7, 0, 0, 9];
    assert_eq!(fields(&behind), Err(DecodeError::TrailingBytes(3)));
    let block = [1, 0, 0x03, 7, 0, 0];
    let parsed = Fields::parse(&block).unwrap();
    assert_eq!(parsed.bytes(), block);
    assert_eq!(parsed.checked_bytes().unwrap(), [1, 0, 0x03, 7]);
    let block = [1, 0, 0x03, 7, 0, 1];
    let parsed = Fields::parse(&block).unwrap();
    assert_eq!(parsed.checked_bytes(), Err(DecodeError::TrailingBytes(2)));
}

#[test]
fn padding_of_one_message_does_not_shift_the_next() {
    let datagram = [
        0x41, 2, 1, 0, 2, 0, // DataSetWriterIds 1 and 2
        7, 0, 5, 0, // Sizes
        0x01, 1, 0, 0x03, 7, 0, 0, // Byte 7, two bytes of padding
        0x01, 1, 0, 0x03, 8, // Byte 8
    ];
    let values: Vec<_> = messages(&datagram)
        .into_iter()
        .flat_map(|message| message.unwrap().fields().unwrap())
        .map(Result::unwrap)
        .collect();
    assert_eq!(values, [Scalar::Byte(7).into(), Scalar::Byte(8).into()]);
}

#[test]
fn a_malformed_message_does_not_hide_the_next() {
    let datagram = [
        0x41, 2, 1, 0, 2, 0, // DataSetWriterIds 1 and 2
        3, 0, 5, 0, // Sizes
        0x07, 1, 0, // reserved field encoding
        0x01, 1, 0, 0x03, 8, // Byte 8
    ];
    let messages = messages(&datagram);
    assert_eq!(messages.len(), 2);
    let reserved = DecodeError::Reserved {
        field: "field encoding",
        value: 3,
    };
    assert_eq!(messages.first().unwrap().as_ref().unwrap_err(), &reserved);
    let second = messages.get(1).unwrap().as_ref().unwrap();
    assert_eq!(second.writer_id, Some(2));
    assert_eq!(
        second.fields().unwrap().next(),
        Some(Ok(Scalar::Byte(8).into()))
    );
}

#[test]
fn a_message_cannot_read_into_its_neighbour() {
    let datagram = [
        0x41, 2, 1, 0, 2, 0, // DataSetWriterIds 1 and 2
        4, 0, 6, 0, // Sizes, the first one byte short
        0x01, 1, 0, 0x03, 7, 0x01, 1, 0, 0x03, 8,
    ];
    let messages = messages(&datagram);
    let first = messages.first().unwrap().as_ref().unwrap();
    assert_eq!(
        first.fields().unwrap().next(),
        Some(Err(DecodeError::Truncated { field: "Byte", .. }))
    );
}

#[test]
fn sizes_past_the_datagram_and_bytes_behind_the_last_message_are_errors() {
    let long = [0x41, 2, 1, 0, 2, 0, 1, 0, 9, 0, 0x01, 0x01];
    let errors: Vec<_> = messages(&long).into_iter().map(Result::err).collect();
    assert_eq!(
        errors,
        [
            None,
            Some(DecodeError::Truncated {
                field: "DataSetMessage",
                ..
            })
        ]
    );
    let short = [0x41, 2, 1, 0, 2, 0, 1, 0, 1, 0, 0x01, 0x01, 0];
    let errors: Vec<_> = messages(&short).into_iter().map(Result::err).collect();
    assert_eq!(errors, [None, None, Some(DecodeError::TrailingBytes(1))]);
    let cut = [0x41, 2, 1, 0, 2, 0, 1, 0, 1];
    let errors: Vec<_> = messages(&cut).into_iter().map(Result::err).collect();
    assert_eq!(
        errors,
        [Some(DecodeError::Truncated { field: "Sizes", .. })]
    );
}

#[test]
fn an_invalid_message_is_yielded_as_such_whatever_stands_in_it() {
    for datagram in [
        &[0x01, 0x00][..],
        &[0x01, 0x06, 0xFF],
        &[0x01, 0x88, 0xFF, 1],
    ] {
        let message = NetworkMessage::decode(datagram)
            .unwrap()
            .messages()
            .next()
            .unwrap()
            .unwrap();
        assert!(!message.header.valid);
    }
}

#[test]
fn reserved_values_are_refused() {
    let reserved = |field, value| Err(DecodeError::Reserved { field, value });
    let decode = |datagram: &[u8]| NetworkMessage::decode(datagram).map(|_| ());
    for version in [0, 2, 15] {
        assert_eq!(
            decode(&[version, 1]),
            reserved("UADPVersion", version.into())
        );
    }
    for id_type in 5..=7 {
        assert_eq!(
            decode(&[0x91, id_type, 1]),
            reserved("PublisherId type", id_type.into())
        );
    }
    for message_type in 3..=7 {
        let datagram = [0x81, 0x80, message_type << 2];
        assert_eq!(
            decode(&datagram),
            reserved("NetworkMessage type", message_type.into())
        );
    }
    assert_eq!(
        decode(&[0x81, 0x80, 0x40]),
        reserved("ExtendedFlags2", 0x40)
    );
    assert_eq!(decode(&[0x21, 0x30]), reserved("GroupFlags", 0x30));
    assert_eq!(decode(&[0x41, 0]), reserved("DataSetMessage Count", 0));
    assert_eq!(
        decode(&[0x91, 4, 0xFF, 0xFF, 0xFF, 0xFF]),
        reserved("PublisherId length", u32::MAX)
    );
    assert_eq!(
        fields(&[0x81, 0x06]),
        Err(DecodeError::Reserved {
            field: "DataSetMessage type",
            value: 6
        })
    );
    assert_eq!(
        fields(&[0x81, 0x40]),
        Err(DecodeError::Reserved {
            field: "DataSetFlags2",
            value: 0x40
        })
    );
}

#[test]
fn reserved_encodings_of_values_are_refused() {
    let reserved = |field, value| Err(DecodeError::Reserved { field, value });
    assert_eq!(field(&[0x20]), reserved("Variant encoding", 0x20));
    assert_eq!(field(&[0x80]), reserved("Variant encoding", 0x80));
    assert_eq!(field(&[0x43, 1]), reserved("Variant encoding", 0x43));
    assert_eq!(field(&[17, 6]), reserved("NodeId encoding", 6));
    assert_eq!(
        field(&[17, 0x80, 1, 0, 0, 0, 0]),
        reserved("NodeId encoding", 0x80)
    );
    assert_eq!(field(&[21, 4]), reserved("LocalizedText encoding mask", 4));
    assert_eq!(
        field(&[22, 0, 0, 3]),
        reserved("ExtensionObject encoding", 3)
    );
    assert_eq!(
        field(&[12, 0xFE, 0xFF, 0xFF, 0xFF]),
        reserved("String", 0xFFFF_FFFE)
    );
    assert_eq!(
        field(&[0x86, 0xFE, 0xFF, 0xFF, 0xFF]),
        reserved("array length", 0xFFFF_FFFE)
    );
}

#[test]
fn values_not_read_yet_are_named() {
    let unsupported = |what| Err(DecodeError::Unsupported(what));
    assert_eq!(field(&[23, 0]), unsupported("DataValue"));
    assert_eq!(field(&[24, 0]), unsupported("Variant"));
    assert_eq!(field(&[25, 0]), unsupported("DiagnosticInfo"));
    assert_eq!(field(&[0x98, 0, 0, 0, 0]), unsupported("Variant"));
    assert_eq!(
        field(&[0xC3, 0, 0, 0, 0]),
        unsupported("multi-dimensional array")
    );
    assert_eq!(
        field(&[26, 0, 0, 0, 0]),
        unsupported("Variant of an unassigned builtin type")
    );
    assert_eq!(fields(&[0x81, 4]).map(|_| ()), unsupported("Action"));
}

#[test]
fn counts_are_held_against_the_bytes_that_are_left() {
    assert_eq!(
        Fields::parse(&[3, 0, 0, 0]).err(),
        Some(DecodeError::Limit {
            field: "FieldCount",
            value: 3
        })
    );
    for builtin in 1..=22 {
        let huge = [0x80 | builtin, 0xFF, 0xFF, 0xFF, 0x7F, 0, 0];
        let limit = DecodeError::Limit {
            field: "array length",
            value: 0x7FFF_FFFF,
        };
        assert_eq!(field(&huge), Err(limit), "builtin type {builtin}");
    }
}

#[test]
fn text_that_is_not_utf8_is_refused_wherever_it_stands() {
    let text = Err(DecodeError::Text("String"));
    assert_eq!(field(&[12, 1, 0, 0, 0, 0xFF]), text);
    assert_eq!(field(&[0x8C, 1, 0, 0, 0, 1, 0, 0, 0, 0xFF]), text);
    assert_eq!(
        field(&[15, 1, 0, 0, 0, 0xFF]),
        Ok(()),
        "a ByteString is no text"
    );
}

#[test]
fn every_byte_but_zero_is_true() {
    let block = [1, 0, 0x81, 3, 0, 0, 0, 0, 1, 0x80];
    let Some(Ok(Variant::Array(array))) = Fields::parse(&block).unwrap().next() else {
        unreachable!("an array of Boolean was written")
    };
    let values: Vec<_> = array.iter().collect();
    assert_eq!(values, [false, true, true].map(Scalar::Boolean));
    assert_eq!(array.bytes(), [0, 1, 0x80]);
}

#[test]
fn null_and_empty_are_kept_apart() {
    let block = [
        4, 0, // FieldCount
        12, 0xFF, 0xFF, 0xFF, 0xFF, // null String
        12, 0, 0, 0, 0, // empty String
        0x86, 0xFF, 0xFF, 0xFF, 0xFF, // null array
        0x86, 0, 0, 0, 0, // empty array
    ];
    let values: Vec<_> = Fields::parse(&block).unwrap().map(Result::unwrap).collect();
    let empty = Array::new(BuiltinType::Int32, 0, &[]).unwrap();
    assert_eq!(
        values,
        [
            Scalar::String(None).into(),
            Scalar::String(Some("")).into(),
            Array::null(BuiltinType::Int32).into(),
            Variant::Array(empty),
        ]
    );
    assert!(!empty.is_null() && Array::null(BuiltinType::Int32).is_null());
}

#[test]
fn every_long_form_of_a_numeric_node_id_is_the_same_node() {
    let two_byte = [1, 0, 17, 0, 85];
    let four_byte = [1, 0, 17, 1, 0, 85, 0];
    let numeric = [1, 0, 17, 2, 0, 0, 85, 0, 0, 0];
    for block in [&two_byte[..], &four_byte, &numeric] {
        let value = Fields::parse(block).unwrap().next().unwrap().unwrap();
        assert_eq!(value, Scalar::NodeId(NodeId::numeric(0, 85)).into());
    }
}

#[test]
fn parts_left_out_of_a_value_are_none() {
    let block = [
        3, 0, // FieldCount
        18, 0xC0, 7, 1, 0, 0, 0, b'u', 9, 0, 0, 0, // ExpandedNodeId with URI and server index
        20, 1, 0, 0xFF, 0xFF, 0xFF, 0xFF, // QualifiedName without name
        21, 2, 0, 0, 0, 0, // LocalizedText of an empty text, no locale
    ];
    let values: Vec<_> = Fields::parse(&block).unwrap().map(Result::unwrap).collect();
    assert_eq!(
        values,
        [
            Scalar::ExpandedNodeId(ExpandedNodeId {
                node_id: NodeId::numeric(0, 7),
                namespace_uri: Some("u"),
                server_index: 9,
            })
            .into(),
            Scalar::QualifiedName(QualifiedName {
                namespace: 1,
                name: None
            })
            .into(),
            Variant::Scalar(Scalar::LocalizedText(LocalizedText {
                locale: None,
                text: Some("")
            })),
        ]
    );
}

#[test]
fn reading_stops_at_the_first_field_that_cannot_be_read() {
    let block = [3, 0, 3, 7, 0x20, 3, 8];
    let values: Vec<_> = Fields::parse(&block).unwrap().collect();
    assert_eq!(values.len(), 2);
    assert!(values.first().unwrap().is_ok() && values.get(1).unwrap().is_err());
}

#[test]
fn publisher_ids_of_another_width_are_another_publisher() {
    assert_ne!(PublisherId::Byte(2), PublisherId::UInt16(2));
    assert_eq!(PublisherId::UInt16(2), PublisherId::UInt16(2));
}

#[test]
fn a_keep_alive_may_be_padded_but_carries_nothing() {
    let message = messages(&[0x01, 0x81, 0x03, 0, 0]).remove(0).unwrap();
    assert_eq!(message.kind, MessageKind::KeepAlive);
    assert_eq!(message.fields().unwrap().len(), 0);
    let error = messages(&[0x01, 0x81, 0x03, 1]).remove(0).unwrap_err();
    assert_eq!(error, DecodeError::TrailingBytes(1));
}
