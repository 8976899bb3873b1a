//! Decoding of the datagrams that a receiver can get from a network.

use uadp::{
    Array, BuiltinType, Chunk, DataSetMessage, DataValue, DateTime, DecodeError, DiagnosticInfo,
    ExpandedNodeId, FieldEncoding, FieldValue, Fields, LocalizedText, Matrix, MessageKind, Nested,
    NetworkMessage, NetworkMessageType, NodeId, PublisherId, QualifiedName, Scalar, SecurityHeader,
    StatusCode, Variant,
};

fn messages(datagram: &[u8]) -> Vec<Result<DataSetMessage<'_>, DecodeError>> {
    NetworkMessage::decode(datagram)
        .unwrap()
        .messages()
        .collect()
}

/// Returns the fields of a message behind the smallest NetworkMessage header.
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

const fn cut(field: &'static str, expected: usize, found: usize) -> DecodeError {
    DecodeError::Truncated {
        field,
        expected,
        found,
    }
}

/// Returns the values and indexes of a single message behind the smallest NetworkMessage header.
fn values(message: &[u8]) -> Result<Vec<String>, DecodeError> {
    let datagram = [&[0x01], message].concat();
    let message = messages(&datagram).remove(0)?;
    let describe = |field: FieldValue<'_>| format!("{}: {:?}", field.index, field.value);
    message.values()?.map(|field| field.map(describe)).collect()
}

/// Checks a block with a single field.
fn field(variant: &[u8]) -> Result<(), DecodeError> {
    let block = [&[1, 0], variant].concat();
    Fields::parse(&block)?.try_for_each(|field| field.map(|_| ()))
}

#[test]
fn a_heartbeat_has_no_fields_with_and_without_a_field_count() {
    assert_eq!(fields(&[0x01]), Ok(vec![]));
    assert_eq!(fields(&[0x01, 0, 0]), Ok(vec![]));
    assert_eq!(fields(&[0x01, 0]), Err(cut("FieldCount", 2, 1)));
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
    assert_eq!(first.fields().unwrap().next(), Some(Err(cut("Byte", 1, 0))));
}

#[test]
fn sizes_past_the_datagram_and_bytes_behind_the_last_message_are_errors() {
    let long = [0x41, 2, 1, 0, 2, 0, 1, 0, 9, 0, 0x01, 0x01];
    let errors: Vec<_> = messages(&long).into_iter().map(Result::err).collect();
    assert_eq!(errors, [None, Some(cut("DataSetMessage", 9, 1))]);
    let short = [0x41, 2, 1, 0, 2, 0, 1, 0, 1, 0, 0x01, 0x01, 7];
    let errors: Vec<_> = messages(&short).into_iter().map(Result::err).collect();
    assert_eq!(errors, [None, None, Some(DecodeError::TrailingBytes(1))]);
    let padded = [0x41, 2, 1, 0, 2, 0, 1, 0, 1, 0, 0x01, 0x01, 0, 0];
    let errors: Vec<_> = messages(&padded).into_iter().map(Result::err).collect();
    assert_eq!(errors, [None, None]);
    let within = [0x41, 2, 1, 0, 2, 0, 1, 0, 1];
    let errors: Vec<_> = messages(&within).into_iter().map(Result::err).collect();
    assert_eq!(errors, [Some(cut("Sizes", 4, 3))]);
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
        assert!(!message.is_valid());
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
        fields(&[0x81, 0x04]),
        Err(DecodeError::Reserved {
            field: "DataSetMessage type",
            value: 4
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

/// OPC 10000-6, 5.2.2.16: decoders treat values of the types 26 to 31 as ByteStrings; encoders do
/// not use them.
#[test]
fn a_variant_of_a_type_yet_to_come_is_read_as_its_bytes() {
    let two = [2, 0, 0, 0, 7, 8];
    let elements = [&two[..], &[0xFF; 4]].concat();
    let array = [&[2, 0, 0, 0][..], &elements].concat();
    let dimensions = [&[2, 0, 0, 0][..], &[1, 0, 0, 0], &[2, 0, 0, 0]].concat();
    let matrix = [&array[..], &dimensions].concat();
    for unassigned in 26..=31 {
        for (form, body) in [(0, &two[..]), (0x80, &array), (0xC0, &matrix)] {
            let of = |id: u8| [&[1, 0, id | form][..], body].concat();
            let (unassigned, known) = (of(unassigned), of(BuiltinType::ByteString.id()));
            let read = |bytes| Fields::parse(bytes).unwrap().next().unwrap().unwrap();
            assert_eq!(read(&unassigned), read(&known));
            assert!(field(&unassigned[2..unassigned.len() - 1]).is_err());
        }
        assert_eq!(
            field(&[0x40 | unassigned, 0, 0, 0, 0]),
            Err(DecodeError::Reserved {
                field: "Variant encoding",
                value: (0x40 | unassigned).into()
            })
        );
    }
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
    for builtin in 1..=25 {
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

/// Returns an array with a single element around `inner`, nested `levels` times.
fn nested(levels: usize, opening: &[u8], inner: &[u8], closing: &[u8]) -> Vec<u8> {
    [&opening.repeat(levels), inner, &closing.repeat(levels)].concat()
}

#[test]
fn values_are_read_ten_levels_deep_and_no_deeper() {
    let array = [0x98, 1, 0, 0, 0];
    let matrix = [0xD8, 1, 0, 0, 0];
    let one_dimension = [1, 0, 0, 0, 1, 0, 0, 0];
    for levels in [1, 2, 9, 10, 11, 1000] {
        let expected = match levels {
            ..=10 => Ok(()),
            _ => Err(DecodeError::TooDeep),
        };
        let variants = nested(levels, &array, &[0], &[]);
        assert_eq!(field(&variants), expected, "{levels} Variants in Variants");
        let matrices = nested(levels, &matrix, &[0], &one_dimension);
        assert_eq!(field(&matrices), expected, "{levels} Variants in matrices");
        let data_values = nested(levels, &[23, 0x03], &[0], &[0; 4]);
        assert_eq!(field(&data_values), expected, "{levels} DataValues");
        let infos = [&[25], &nested(levels - 1, &[0x40], &[0], &[])[..]].concat();
        assert_eq!(field(&infos), expected, "{levels} DiagnosticInfos");
        let elements = [&[0x99, 1, 0, 0, 0], infos.get(1..).unwrap()].concat();
        assert_eq!(field(&elements), expected, "{levels} DiagnosticInfos");
    }
}

#[test]
fn the_innermost_of_ten_levels_is_reached() {
    let block = [
        &[1, 0],
        &nested(9, &[0x98, 1, 0, 0, 0], &[0x98, 1, 0, 0, 0, 3, 7], &[])[..],
    ];
    let block = block.concat();
    let mut value = Fields::parse(&block).unwrap().next().unwrap().unwrap();
    for _ in 0..10 {
        let Variant::Array(array) = value else {
            unreachable!("{value:?} is not an array")
        };
        let Some(Scalar::Variant(inner)) = array.iter().next() else {
            unreachable!("{array:?} holds no Variant")
        };
        value = inner.get().unwrap();
    }
    assert_eq!(value, Scalar::Byte(7).into());

    let infos = nested(9, &[0x41, 9, 0, 0, 0], &[0x01, 5, 0, 0, 0], &[]);
    let mut info = Nested::<DiagnosticInfo<'_>>::new(&infos).unwrap();
    for _ in 0..9 {
        info = info.get().unwrap().inner.unwrap();
    }
    let innermost = DiagnosticInfo {
        symbolic_id: Some(5),
        ..DiagnosticInfo::default()
    };
    assert_eq!(info.get(), Ok(innermost));
}

#[test]
fn ten_levels_take_little_stack() {
    let read = || {
        let array = [0x98, 1, 0, 0, 0];
        let deep = nested(5, &[&array[..], &[23, 0x01]].concat(), &[0], &[]);
        assert_eq!(field(&deep), Ok(()));
    };
    let thread = std::thread::Builder::new().stack_size(64 << 10);
    thread.spawn(read).unwrap().join().unwrap();
}

#[test]
fn a_variant_directly_in_a_variant_is_refused() {
    let refused = Err(DecodeError::Reserved {
        field: "Variant directly in a Variant",
        value: 24,
    });
    assert_eq!(field(&[24, 0]), refused);
    assert_eq!(field(&[0x98, 1, 0, 0, 0, 24, 0]), refused, "in an array");
    assert_eq!(field(&[23, 0x01, 24, 0]), refused, "in a DataValue");
    assert_eq!(field(&[0x98, 2, 0, 0, 0, 3, 7, 0]), Ok(()));
}

#[test]
fn dimensions_have_to_fit_the_elements() {
    let matrix = |elements: u8, dimensions: &[i32]| {
        let mut bytes = vec![0xC3, elements, 0, 0, 0];
        bytes.extend(0..elements);
        bytes.extend(u32::try_from(dimensions.len()).unwrap().to_le_bytes());
        bytes.extend(dimensions.iter().flat_map(|size| size.to_le_bytes()));
        field(&bytes)
    };
    assert_eq!(matrix(6, &[2, 3]), Ok(()));
    assert_eq!(matrix(6, &[1, 6, 1]), Ok(()));
    assert_eq!(matrix(6, &[6]), Ok(()));
    for dimensions in [
        &[2, 2][..],
        &[3, 3],
        &[-2, -3],
        &[6, 0],
        &[],
        &[i32::MAX, i32::MAX, i32::MAX],
        &[65_536, 65_536, 65_536, 65_536],
    ] {
        let refused = Err(DecodeError::Dimensions { elements: 6 });
        assert_eq!(matrix(6, dimensions), refused, "{dimensions:?}");
    }
    let promised = [0xC3, 1, 0, 0, 0, 7, 0xFF, 0xFF, 0xFF, 0x7F];
    let missing = cut("ArrayDimensions", 0x7FFF_FFFF * 4, 0);
    assert_eq!(field(&promised), Err(missing));
    let elements = Array::new(BuiltinType::Byte, 2, &[1, 2]).unwrap();
    let size = |size: i32| size.to_le_bytes();
    let refused = Err(DecodeError::Dimensions { elements: 2 });
    assert_eq!(Matrix::new(elements, &[size(3), size(1)]), refused);
}

#[test]
fn a_matrix_gives_its_elements_row_by_row_and_its_dimensions_outermost_first() {
    let block = [
        1, 0, // FieldCount
        0xC4, 6, 0, 0, 0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6, 0, // six Int16
        2, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, // two rows of three
    ];
    let Some(Ok(Variant::Matrix(matrix))) = Fields::parse(&block).unwrap().next() else {
        unreachable!("a matrix was written")
    };
    let elements: Vec<_> = matrix.elements().iter().collect();
    assert_eq!(elements, [1, 2, 3, 4, 5, 6].map(Scalar::Int16));
    assert_eq!(matrix.dimensions().collect::<Vec<_>>(), [2, 3]);
}

#[test]
fn a_matrix_may_be_null_or_empty() {
    let null = [0xFF; 4];
    let block = [
        &[3, 0][..],
        &[&[0xC6][..], &null, &null].concat(), // null, no dimensions
        &[0xC6, 0, 0, 0, 0, 0, 0, 0, 0],       // empty, no dimensions
        &[0xC6, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0], // no rows of three
    ]
    .concat();
    let matrices: Vec<_> = Fields::parse(&block)
        .unwrap()
        .map(|field| match field.unwrap() {
            Variant::Matrix(matrix) => matrix,
            other => unreachable!("{other:?} is no matrix"),
        })
        .map(|matrix| (matrix.elements().is_null(), matrix.dimensions().collect()))
        .collect();
    assert_eq!(
        matrices,
        [(true, vec![]), (false, vec![]), (false, vec![0, 3])]
    );
}

#[test]
fn reserved_bits_of_what_holds_a_value_are_refused() {
    let reserved = |field, value| Err(DecodeError::Reserved { field, value });
    for bit in [0x40, 0x80] {
        let refused = reserved("DataValue encoding mask", bit.into());
        assert_eq!(field(&[23, bit]), refused);
        assert_eq!(field(&[0x97, 1, 0, 0, 0, bit]), refused, "in an array");
        assert_eq!(values(&[0x05, 1, 0, bit]), refused.map(|()| vec![]));
    }
    assert_eq!(
        field(&[25, 0x80]),
        reserved("DiagnosticInfo encoding mask", 0x80)
    );
    assert_eq!(
        field(&[25, 0x40, 0x80]),
        reserved("DiagnosticInfo encoding mask", 0x80)
    );
}

#[test]
fn a_data_value_is_what_its_mask_says() {
    let full = [
        0x3F, 3, 7, // Byte 7
        0, 0, 0, 0x40, // Uncertain
        1, 0, 0, 0, 0, 0, 0, 0, 2, 0, // SourceTimestamp and its PicoSeconds
        3, 0, 0, 0, 0, 0, 0, 0, 4, 0, // ServerTimestamp and its PicoSeconds
    ];
    let read = |bytes: &'static [u8]| Nested::<DataValue<'_>>::new(bytes).unwrap().get();
    let value = Nested::<DataValue<'_>>::new(&full).unwrap().get().unwrap();
    assert_eq!(
        value,
        DataValue {
            value: Some(Scalar::Byte(7).into()),
            status: Some(StatusCode(0x4000_0000)),
            source_timestamp: Some(DateTime(1)),
            source_picoseconds: Some(2),
            server_timestamp: Some(DateTime(3)),
            server_picoseconds: Some(4),
        }
    );
    let none = DataValue::default();
    assert_eq!(read(&[0]), Ok(none));
    assert_eq!(read(&[0x01, 0]), Ok(Variant::Null.into()));
    let picoseconds = DataValue {
        server_picoseconds: Some(5),
        ..none
    };
    assert_eq!(read(&[0x20, 5, 0]), Ok(picoseconds), "without a timestamp");
    for len in 0..full.len() {
        let error = Nested::<DataValue<'_>>::new(full.get(..len).unwrap()).unwrap_err();
        assert!(matches!(error, DecodeError::Truncated { .. }), "{error}");
    }
}

#[test]
fn a_data_value_around_an_array_ends_behind_its_timestamps() {
    let bytes = [
        0x06, 0, 0, 0, 0x80, 9, 0, 0, 0, 0, 0, 0, 0, // Status Bad, SourceTimestamp
    ];
    let with_array = [&[0x07, 0x8C, 1, 0, 0, 0, 1, 0, 0, 0, b'x'], &bytes[1..]].concat();
    let with_value = Nested::<DataValue<'_>>::new(&with_array)
        .unwrap()
        .get()
        .unwrap();
    let without = Nested::<DataValue<'_>>::new(&bytes).unwrap().get().unwrap();
    let text = [1, 0, 0, 0, b'x'];
    let array = Array::new(BuiltinType::String, 1, &text).unwrap();
    assert_eq!(
        with_value,
        DataValue {
            value: Some(array.into()),
            ..without
        }
    );
}

#[test]
fn a_diagnostic_info_is_what_its_mask_says() {
    let bytes = [
        0x7F, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, 4, 0, 0, 0, // SymbolicId to LocalizedText
        1, 0, 0, 0, b'x', // AdditionalInfo
        0, 0, 0x34, 0x80, // InnerStatusCode
        0x10, 0xFF, 0xFF, 0xFF, 0xFF, // InnerDiagnosticInfo of a null AdditionalInfo
    ];
    let info = Nested::<DiagnosticInfo<'_>>::new(&bytes)
        .unwrap()
        .get()
        .unwrap();
    let inner = info.inner.unwrap().get().unwrap();
    let expected = DiagnosticInfo {
        symbolic_id: Some(1),
        namespace_uri: Some(2),
        locale: Some(3),
        localized_text: Some(4),
        additional_info: Some(Some("x")),
        inner_status_code: Some(StatusCode(0x8034_0000)),
        inner: info.inner,
    };
    assert_eq!(info, expected);
    let none = DiagnosticInfo::default();
    let null = DiagnosticInfo {
        additional_info: Some(None),
        ..none
    };
    assert_eq!(inner, null);
}

#[test]
fn each_index_of_a_diagnostic_info_has_its_bit() {
    let none = DiagnosticInfo::default();
    let nine = Some(9);
    for (mask, expected) in [
        (
            0x01,
            DiagnosticInfo {
                symbolic_id: nine,
                ..none
            },
        ),
        (
            0x02,
            DiagnosticInfo {
                namespace_uri: nine,
                ..none
            },
        ),
        (
            0x04,
            DiagnosticInfo {
                localized_text: nine,
                ..none
            },
        ),
        (
            0x08,
            DiagnosticInfo {
                locale: nine,
                ..none
            },
        ),
    ] {
        let bytes = [mask, 9, 0, 0, 0];
        let info = Nested::<DiagnosticInfo<'_>>::new(&bytes).unwrap().get();
        assert_eq!(info, Ok(expected), "mask {mask:#x}");
    }
}

#[test]
fn what_fills_up_a_delta_frame_is_told_from_a_change_to_null() {
    let delta = [
        0x81, 1, 4, 0, // delta frame of four fields
        2, 0, 3, 7, // field 2 is Byte 7
        1, 0, 0, // field 1 is null
        0, 0, 3, 0, // field 0 is Byte 0
        0, 0, 0, // filler
    ];
    let datagram = [&[0x01], &delta[..]].concat();
    let message = messages(&datagram).remove(0).unwrap();
    assert_eq!(message.kind, MessageKind::DeltaFrame);
    let fields: Vec<_> = message.values().unwrap().map(Result::unwrap).collect();
    let told: Vec<_> = fields
        .iter()
        .map(|field| (field.index, field.is_filler()))
        .collect();
    assert_eq!(told, [(2, false), (1, false), (0, false), (0, true)]);
}

#[test]
fn what_has_indexes_or_qualities_is_not_read_as_plain_fields() {
    let misread = |what| Err(DecodeError::Misread(what));
    let delta = [0x81, 1, 1, 0, 2, 0, 3, 7];
    assert_eq!(
        fields(&delta),
        misread("a delta frame, its fields have indexes")
    );
    let data_values = [0x05, 1, 0, 0x01, 3, 7];
    assert_eq!(fields(&data_values), misread("encoded as DataValues"));
    let raw = misread("encoded as RawData, to be read with its DataSetMetaData");
    assert_eq!(fields(&[0x03, 7]), raw);
    assert_eq!(values(&[0x03, 7]), raw);
    let byte: DataValue<'_> = Variant::from(Scalar::Byte(7)).into();
    assert_eq!(values(&delta), Ok(vec![format!("2: {byte:?}")]));
    assert_eq!(values(&data_values), Ok(vec![format!("0: {byte:?}")]));
    let changed = [0x85, 1, 1, 0, 9, 0, 0x01, 3, 7];
    assert_eq!(values(&changed), Ok(vec![format!("9: {byte:?}")]));
}

#[test]
fn an_event_has_fields_and_always_a_field_count() {
    let event = [0x01, 0x81, 2, 2, 0, 3, 7, 0];
    let message = messages(&event).remove(0).unwrap();
    assert_eq!(message.kind, MessageKind::Event);
    let read: Vec<_> = message.fields().unwrap().map(Result::unwrap).collect();
    assert_eq!(read, [Scalar::Byte(7).into(), Variant::Null]);
    assert_eq!(fields(&[0x81, 2]), Err(cut("FieldCount", 2, 0)));
    assert_eq!(values(&[0x81, 1]), Err(cut("FieldCount", 2, 0)), "delta");
}

#[test]
fn the_values_of_a_heartbeat_and_of_a_keep_alive_are_none() {
    assert_eq!(values(&[0x01]), Ok(vec![]));
    assert_eq!(values(&[0x05]), Ok(vec![]), "of DataValues");
    assert_eq!(fields(&[0x05]), Ok(vec![]), "of DataValues");
    assert_eq!(values(&[0x01, 0, 0]), Ok(vec![]));
    assert_eq!(values(&[0x81, 3]), Ok(vec![]));
}

#[test]
fn values_end_as_fields_do() {
    let null = DataValue::default();
    assert_eq!(
        values(&[0x05, 1, 0, 0, 0, 0]),
        Ok(vec![format!("0: {null:?}")]),
        "padding is skipped"
    );
    assert_eq!(
        values(&[0x05, 1, 0, 0, 0, 9]),
        Err(DecodeError::TrailingBytes(2))
    );
    assert_eq!(
        values(&[0x05, 3, 0, 0, 0]),
        Err(DecodeError::Limit {
            field: "FieldCount",
            value: 3
        })
    );
    let datagram = [0x01, 0x05, 3, 0, 0, 0x80, 0];
    let message = messages(&datagram).remove(0).unwrap();
    assert_eq!(message.encoding(), FieldEncoding::DataValue);
    let read: Vec<_> = message
        .values()
        .unwrap()
        .map(|field| field.is_ok())
        .collect();
    assert_eq!(read, [true, false], "nothing behind an error");
}

#[test]
fn a_secured_message_shows_its_headers_and_no_messages() {
    for (flags, signed, encrypted) in [(1, true, false), (2, false, true), (3, true, true)] {
        let datagram = [
            0xC1, 0x10, 1, 5, 0, // DataSetWriterId 5, SecurityHeader
            flags, 9, 0, 0, 0, 2, 0xAB, 0xCD, // token 9 and a nonce of two bytes
            0x01, 1, 0, 0x03, 7, // content of a key frame
        ];
        let message = NetworkMessage::decode(&datagram).unwrap();
        let header = SecurityHeader {
            signed,
            encrypted,
            token_id: 9,
            nonce: &[0xAB, 0xCD],
            ..SecurityHeader::NONE
        };
        assert_eq!(message.security(), Some(header));
        assert!(header.is_secured() && message.is_sealed());
        assert!(message.writer_ids().unwrap().eq([5]));
        let sealed = DecodeError::Misread("secured, to be opened with its keys first");
        let read: Vec<_> = message.messages().map(Result::unwrap_err).collect();
        assert_eq!(read, [sealed]);
        assert_eq!(message.chunk(), Err(sealed));
        let start = datagram.len() - message.payload().len();
        let placed = message.data_set_message_at(start, 5);
        assert_eq!(placed.unwrap_err(), sealed);
    }
}

#[test]
fn the_footer_of_a_secured_message_is_part_of_what_is_sealed() {
    let datagram = [
        0x81, 0x10, 0x06, 9, 0, 0, 0, 0, 2, 0, // encrypted, with a footer of two bytes
        1, 2, 3,
    ];
    let message = NetworkMessage::decode(&datagram).unwrap();
    assert_eq!(message.security().unwrap().footer_size, Some(2));
    assert!(message.footer().is_empty());
    assert_eq!(message.payload(), [1, 2, 3]);
}

#[test]
fn a_security_header_without_security_hides_nothing() {
    let datagram = [0x81, 0x10, 0, 0, 0, 0, 0, 0, 0x01, 1, 0, 0x03, 7];
    let message = NetworkMessage::decode(&datagram).unwrap();
    assert_eq!(message.security(), Some(SecurityHeader::NONE));
    assert!(!message.is_sealed());
    let fields = message
        .messages()
        .next()
        .unwrap()
        .unwrap()
        .fields()
        .unwrap();
    assert_eq!(fields.len(), 1);
    let reserved = NetworkMessage::decode(&[0x81, 0x10, 0x30, 0, 0, 0, 0, 0]).unwrap_err();
    let bits = DecodeError::Reserved {
        field: "SecurityFlags",
        value: 0x30,
    };
    assert_eq!(reserved, bits);
}

#[test]
fn the_footer_is_no_part_of_the_payload() {
    let datagram = |size: u8| {
        [
            0x81, 0x10, 0x04, 0, 0, 0, 0, 0, size, 0, // SecurityHeader with a footer
            0x01, 1, 0, 0x03, 7, 0xF1, 0xF2, // key frame and two more bytes
        ]
    };
    let with_footer = datagram(2);
    let message = NetworkMessage::decode(&with_footer).unwrap();
    assert_eq!(message.footer(), [0xF1, 0xF2]);
    assert_eq!(message.payload(), [0x01, 1, 0, 0x03, 7]);
    let fields = message
        .messages()
        .next()
        .unwrap()
        .unwrap()
        .fields()
        .unwrap();
    assert!(fields.map(Result::unwrap).eq([Scalar::Byte(7).into()]));
    assert_eq!(
        message.data_set_message_at(10, 5).unwrap().kind,
        MessageKind::KeyFrame
    );
    let into_footer = message.data_set_message_at(10, 6).unwrap_err();
    assert_eq!(into_footer, cut("DataSetMessage", 16, 15));
    let all = datagram(7);
    assert!(NetworkMessage::decode(&all).unwrap().payload().is_empty());
}

#[test]
fn a_footer_longer_than_the_payload_is_refused() {
    let datagram = [0x81, 0x10, 0x04, 0, 0, 0, 0, 0, 3, 0, 0x01, 0];
    let error = NetworkMessage::decode(&datagram).unwrap_err();
    assert_eq!(error, cut("SecurityFooter", 3, 2));
}

#[test]
fn a_chunk_is_a_piece_that_lies_in_the_whole() {
    let datagram = |offset: u32, total: u32, data: &[u8]| {
        let offset = offset.to_le_bytes();
        let total = total.to_le_bytes();
        let header = [0xC1, 0x80, 0x01, 5, 0, 77, 0]; // DataSetWriterId 5, number 77
        [&header[..], &offset, &total, data].concat()
    };
    let read = datagram(6, 10, &[1, 2, 3, 4]);
    let message = NetworkMessage::decode(&read).unwrap();
    assert!(message.is_chunk());
    assert_eq!(
        message.chunk(),
        Ok(Chunk {
            writer_id: Some(5),
            message_sequence_number: 77,
            offset: 6,
            total_size: 10,
            data: &[1, 2, 3, 4],
        })
    );
    let messages: Vec<_> = message.messages().map(Result::unwrap_err).collect();
    let misread = DecodeError::Misread("a chunk, to be reassembled first");
    assert_eq!(messages, [misread]);
    assert_eq!(message.data_set_message_at(7, 1).unwrap_err(), misread);
    for (offset, total, data) in [
        (7, 10, &[1, 2, 3, 4][..]),
        (10, 10, &[1]),
        (u32::MAX, u32::MAX, &[1]),
        (0, 0, &[1]),
        (5, 10, &[]),
    ] {
        let datagram = datagram(offset, total, data);
        let limit = DecodeError::Limit {
            field: "ChunkOffset",
            value: offset,
        };
        let chunk = NetworkMessage::decode(&datagram).unwrap().chunk();
        assert_eq!(chunk, Err(limit), "{offset} of {total}");
    }
    let padded = datagram(8, 10, &[3, 4, 0, 0]);
    let chunk = NetworkMessage::decode(&padded).unwrap().chunk().unwrap();
    assert_eq!(chunk.data, [3, 4], "a short frame is padded");
    let short = NetworkMessage::decode(read.get(..14).unwrap()).unwrap();
    assert_eq!(short.chunk(), Err(cut("TotalSize", 4, 3)));
    let whole = NetworkMessage::decode(&[0x01, 0x01]).unwrap();
    assert_eq!(whole.chunk(), Err(DecodeError::Misread("no chunk")));
}

#[test]
fn promoted_fields_end_where_their_size_says() {
    let datagram = [0x81, 0x80, 0x02, 4, 0, 3, 7, 3, 8, 0x01, 1, 0, 3, 9];
    let message = NetworkMessage::decode(&datagram).unwrap();
    let promoted = message.promoted_fields().unwrap().map(Result::unwrap);
    assert!(promoted.eq([7, 8].map(|byte| Scalar::Byte(byte).into())));
    let fields = message
        .messages()
        .next()
        .unwrap()
        .unwrap()
        .fields()
        .unwrap();
    assert!(fields.map(Result::unwrap).eq([Scalar::Byte(9).into()]));

    let none = NetworkMessage::decode(&[0x81, 0x80, 0x02, 0, 0, 0x01]).unwrap();
    assert_eq!(none.promoted_fields().unwrap().count(), 0);
    let absent = NetworkMessage::decode(&[0x01, 0x01]).unwrap();
    assert!(absent.promoted_fields().is_none());
}

#[test]
fn promoted_fields_past_the_end_are_refused() {
    let error = NetworkMessage::decode(&[0x81, 0x80, 0x02, 4, 0, 3, 7, 3]).unwrap_err();
    assert_eq!(error, cut("PromotedFields", 4, 3));
    // Size 3 truncates the second field; the message behind it is still decoded.
    let datagram = [0x81, 0x80, 0x02, 3, 0, 3, 7, 3, 0x01, 1, 0, 3, 9];
    let message = NetworkMessage::decode(&datagram).unwrap();
    let promoted: Vec<_> = message.promoted_fields().unwrap().collect();
    assert_eq!(
        promoted,
        [Ok(Scalar::Byte(7).into()), Err(cut("Byte", 1, 0))]
    );
    assert!(message.messages().all(|message| message.is_ok()));
}

#[test]
fn messages_of_a_fixed_layout_are_found_by_their_offsets() {
    let datagram = [
        0x21, 0x01, 5, 0, // WriterGroupId 5, no payload header
        0x01, 1, 0, 0x03, 7, 0, 0, // Byte 7, two bytes of padding
        0x00, 0xFF, // not valid
        0x01, 1, 0, 0x03, 8, // Byte 8
    ];
    let network = NetworkMessage::decode(&datagram).unwrap();
    let field = |offset, size| {
        let message = network.data_set_message_at(offset, size)?;
        assert_eq!(message.writer_id, None);
        message.fields()?.next().transpose()
    };
    assert_eq!(field(4, 7), Ok(Some(Scalar::Byte(7).into())));
    assert_eq!(field(13, 5), Ok(Some(Scalar::Byte(8).into())));
    assert!(!network.data_set_message_at(11, 2).unwrap().is_valid());
    for (offset, size) in [
        (3, 5),
        (0, 1),
        (13, 6),
        (19, 0),
        (14, usize::MAX),
        (usize::MAX, 1),
    ] {
        let missing = cut(
            "DataSetMessage",
            offset.saturating_add(size),
            datagram.len(),
        );
        assert_eq!(
            field(offset, size),
            Err(missing),
            "{size} bytes at {offset}"
        );
    }
    let empty = network.data_set_message_at(4, 0).unwrap_err();
    assert_eq!(empty, cut("DataSetFlags1", 1, 0));
}

#[test]
fn discovery_messages_are_told_by_their_type() {
    for (flags, message_type, what) in [
        (0x04, NetworkMessageType::Probe, "a discovery probe"),
        (
            0x08,
            NetworkMessageType::Announcement,
            "a discovery announcement",
        ),
    ] {
        let datagram = [0x81, 0x90, flags, 0, 0, 0, 0, 0, 0, 1];
        let message = NetworkMessage::decode(&datagram).unwrap();
        assert_eq!(message.message_type(), message_type);
        assert_eq!(message.payload(), [1]);
        let read: Vec<_> = message.messages().map(Result::unwrap_err).collect();
        assert_eq!(read, [DecodeError::Misread(what)]);
    }
    let plain = NetworkMessage::decode(&[0x01, 0x01]).unwrap();
    assert_eq!(plain.message_type(), NetworkMessageType::DataSet);
}

#[test]
fn the_sequence_number_alone_is_that_of_the_header() {
    let numbered = [0x89, 0x10, 0x34, 0x12, 1, 2, 3, 4, 5, 6, 7, 8];
    let message = DataSetMessage::decode(None, &numbered).unwrap();
    assert_eq!(message.sequence_number(), Some(0x1234));
    assert_eq!(message.header().sequence_number, Some(0x1234));
    let without = DataSetMessage::decode(None, &[0x01]).unwrap();
    assert_eq!(without.sequence_number(), None);
}
