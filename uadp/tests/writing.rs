//! Calls that an encoder accepts, and calls that it rejects.

use uadp::{
    BuiltinType, DataSetHeader, DataValue, DateTime, DecodeError, EncodeError, ExtensionBody,
    Extras, FieldEncoder, Fields, Nested, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    NodeId, Scalar, SecurityHeader, StatusCode, Variant,
};

/// Encodes a key frame behind the smallest header. Returns the bytes behind the header, or the
/// error.
fn block(
    write: impl FnOnce(&mut FieldEncoder<'_>) -> Result<(), EncodeError>,
) -> Result<Vec<u8>, EncodeError> {
    let mut out = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None)?;
    let mut fields = message.key_frame(&DataSetHeader::default())?;
    write(&mut fields)?;
    fields.finish()?;
    message.finish()?;
    Ok(out.split_off(2))
}

/// Encodes a DataSetMessage behind the smallest header. Returns its bytes, or the error.
fn message(
    write: impl FnOnce(&mut NetworkMessageEncoder<'_>) -> Result<(), EncodeError>,
) -> Result<Vec<u8>, EncodeError> {
    let mut out = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None)?;
    write(&mut message)?;
    message.finish()?;
    Ok(out.split_off(1))
}

#[test]
fn a_structure_is_an_extension_object_with_the_length_of_its_body() {
    let bytes = block(|fields| {
        fields.begin_structure(NodeId::numeric(2, 5001))?;
        fields.scalar(Scalar::Byte(7))?;
        fields.packed_array(BuiltinType::UInt16, 1, &[8, 0])?;
        fields.array(BuiltinType::String, 1)?;
        fields.element(Scalar::String(Some("x")))?;
        fields.end_structure()?;
        fields.scalar(Scalar::Byte(9))
    });
    let expected = [
        &[2, 0, 22, 1, 2, 0x89, 0x13, 1, 16, 0, 0, 0][..], // two fields; body of 16 bytes
        &[7, 1, 0, 0, 0, 8, 0],
        &[1, 0, 0, 0, 1, 0, 0, 0, b'x'],
        &[3, 9],
    ];
    assert_eq!(bytes.unwrap(), expected.concat());
}

#[test]
fn an_array_of_structures_holds_structures_with_arrays_of_structures() {
    let type_id = NodeId::numeric(0, 200);
    let bytes = block(|fields| {
        fields.structures(2)?;
        for value in [1, 2] {
            fields.begin_structure(type_id)?;
            fields.structures(1)?;
            fields.begin_structure(type_id)?;
            fields.scalar(Scalar::Byte(value))?;
            fields.end_structure()?;
            fields.end_structure()?;
        }
        Ok(())
    })
    .unwrap();
    let element = |value| {
        [
            0, 200, 1, 12, 0, 0, 0, 1, 0, 0, 0, 0, 200, 1, 1, 0, 0, 0, value,
        ]
    };
    let expected = [&[1, 0, 0x96, 2, 0, 0, 0][..], &element(1), &element(2)].concat();
    assert_eq!(bytes, expected);
    let Some(Ok(Variant::Array(array))) = Fields::parse(&bytes).unwrap().next() else {
        unreachable!("an array was written")
    };
    let bodies: Vec<_> = array
        .iter()
        .map(|element| match element {
            Scalar::ExtensionObject(object) => object.body,
            other => unreachable!("{other:?} among structures"),
        })
        .collect();
    let body = |value| [1, 0, 0, 0, 0, 200, 1, 1, 0, 0, 0, value];
    assert_eq!(
        bodies,
        [
            ExtensionBody::Binary(&body(1)),
            ExtensionBody::Binary(&body(2))
        ]
    );
}

#[test]
fn structures_nest_to_the_stated_depth_and_no_deeper() {
    let nest = |depth: usize| {
        block(|fields| {
            for _ in 0..depth {
                fields.begin_structure(NodeId::NULL)?;
            }
            for _ in 0..depth {
                fields.end_structure()?;
            }
            Ok(())
        })
    };
    assert!(nest(FieldEncoder::MAX_DEPTH).is_ok());
    assert_eq!(nest(FieldEncoder::MAX_DEPTH + 1), Err(EncodeError::TooDeep));
}

#[test]
fn an_array_takes_exactly_its_elements() {
    let byte = Scalar::Byte(1);
    let wanted = EncodeError::Misplaced("an open array wants more elements");
    assert_eq!(
        block(|fields| fields.array(BuiltinType::Byte, 1)),
        Err(wanted)
    );
    assert_eq!(
        block(|fields| {
            fields.array(BuiltinType::Byte, 1)?;
            fields.scalar(byte)
        }),
        Err(wanted)
    );
    assert_eq!(
        block(|fields| {
            fields.begin_structure(NodeId::NULL)?;
            fields.array(BuiltinType::Byte, 1)?;
            fields.end_structure()
        }),
        Err(wanted)
    );
    let none = EncodeError::Misplaced("element without an open array");
    assert_eq!(
        block(|fields| {
            fields.array(BuiltinType::Byte, 1)?;
            fields.element(byte)?;
            fields.element(byte)
        }),
        Err(none)
    );
    assert_eq!(
        block(|fields| {
            fields.array(BuiltinType::SByte, 1)?;
            fields.element(byte)
        }),
        Err(EncodeError::ElementType {
            expected: BuiltinType::SByte,
            found: BuiltinType::Byte
        })
    );
    assert_eq!(
        block(|fields| {
            fields.array(BuiltinType::Byte, 1)?;
            fields.begin_structure(NodeId::NULL)
        }),
        Err(EncodeError::ElementType {
            expected: BuiltinType::Byte,
            found: BuiltinType::ExtensionObject
        })
    );
}

#[test]
fn a_packed_array_needs_the_bytes_of_its_elements() {
    for (element, count, bytes) in [
        (BuiltinType::Int32, 2, &[0; 7][..]),
        (BuiltinType::Int32, usize::MAX, &[0; 4]),
        (BuiltinType::String, 1, &[0; 4]),
    ] {
        let error = EncodeError::PackedSize {
            element,
            count,
            bytes: bytes.len(),
        };
        assert_eq!(
            block(|fields| fields.packed_array(element, count, bytes)),
            Err(error)
        );
    }
}

#[test]
fn calls_out_of_place_are_refused() {
    let misplaced = |write: fn(&mut FieldEncoder<'_>) -> Result<(), EncodeError>| {
        assert!(matches!(block(write), Err(EncodeError::Misplaced(_))));
    };
    misplaced(|fields| fields.end_structure());
    misplaced(|fields| fields.begin_structure(NodeId::NULL));
    misplaced(|fields| {
        fields.begin_structure(NodeId::NULL)?;
        fields.null()
    });
    misplaced(|fields| {
        fields.null()?;
        fields.fields_block(&[0, 0])
    });
    misplaced(|fields| fields.fields_block(&[0]));
    misplaced(|fields| {
        let value = Nested::new(&[0]).unwrap();
        fields.scalar(Scalar::Variant(value))
    });
}

#[test]
fn a_block_of_fields_is_copied_as_it_is() {
    let read = [2, 0, 3, 7, 0x86, 0xFF, 0xFF, 0xFF, 0xFF];
    assert_eq!(block(|fields| fields.fields_block(&read)).unwrap(), read);
}

#[test]
fn the_number_of_messages_has_to_be_that_of_the_writer_ids() {
    let header = NetworkHeader::default();
    let keep_alive = DataSetHeader::default();
    let count = |announced, written| Err(EncodeError::MessageCount { announced, written });
    let mut out = Vec::new();
    assert_eq!(
        NetworkMessageEncoder::new(&mut out, &header, Some(&[])).map(|_| ()),
        count(0, 0)
    );
    let many = vec![1; 256];
    assert_eq!(
        NetworkMessageEncoder::new(&mut out, &header, Some(&many)).map(|_| ()),
        Err(EncodeError::TooBig {
            what: "DataSetWriterIds",
            len: 256
        })
    );
    let mut message = NetworkMessageEncoder::new(&mut out, &header, Some(&[1, 2])).unwrap();
    message.keep_alive(&keep_alive).unwrap();
    assert_eq!(message.finish(), count(2, 1));
    let mut message = NetworkMessageEncoder::new(&mut out, &header, None).unwrap();
    message.keep_alive(&keep_alive).unwrap();
    assert_eq!(message.keep_alive(&keep_alive), count(1, 2));
}

#[test]
fn messages_encoded_before_are_put_together_as_if_written_at_once() {
    let header = NetworkHeader::default();
    let numbered = |number| DataSetHeader {
        sequence_number: Some(number),
        ..DataSetHeader::default()
    };
    let write = |message: &mut NetworkMessageEncoder<'_>, number: u16| {
        let mut frame = message.key_frame(&numbered(number))?;
        frame.scalar(Scalar::UInt16(number))?;
        frame.finish()
    };
    let mut at_once = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut at_once, &header, Some(&[7, 8])).unwrap();
    write(&mut message, 1).unwrap();
    write(&mut message, 2).unwrap();
    message.finish().unwrap();

    let alone = [1, 2].map(|number| {
        let mut out = Vec::new();
        let mut message = NetworkMessageEncoder::new(&mut out, &header, Some(&[7])).unwrap();
        let start = message.payload_offset();
        write(&mut message, number).unwrap();
        message.finish().unwrap();
        out.split_off(start)
    });
    let mut together = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut together, &header, Some(&[7, 8])).unwrap();
    for one in &alone {
        message.encoded(one).unwrap();
    }
    let third = message.encoded(&alone[0]);
    message.finish().unwrap();
    assert_eq!(together, at_once);
    let (announced, written) = (2, 3);
    assert_eq!(third, Err(EncodeError::MessageCount { announced, written }));
}

#[test]
fn a_key_frame_left_open_is_not_a_message() {
    let mut out = Vec::new();
    let mut message =
        NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None).unwrap();
    let mut fields = message.key_frame(&DataSetHeader::default()).unwrap();
    fields.scalar(Scalar::Byte(1)).unwrap();
    let left = message.key_frame(&DataSetHeader::default()).unwrap();
    left.finish().unwrap();
    message.finish().unwrap();
    assert_eq!(out, [0x01, 0x01, 0, 0]);

    out.clear();
    let mut message =
        NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None).unwrap();
    drop(message.key_frame(&DataSetHeader::default()).unwrap());
    assert_eq!(
        message.finish(),
        Err(EncodeError::MessageCount {
            announced: 1,
            written: 0
        })
    );
}

#[test]
fn among_several_messages_none_may_exceed_its_size_field() {
    let write = |len: usize, ids: &[u16]| {
        let mut out = Vec::new();
        let header = NetworkHeader::default();
        let mut message = NetworkMessageEncoder::new(&mut out, &header, Some(ids))?;
        for _ in ids {
            let mut fields = message.key_frame(&DataSetHeader::default())?;
            fields.packed_array(BuiltinType::Byte, len, &vec![0; len])?;
            fields.finish()?;
        }
        message.finish()
    };
    let overhead = 1 + 2 + 5;
    assert_eq!(write(65_535 - overhead, &[1, 2]), Ok(()));
    let too_big = EncodeError::TooBig {
        what: "DataSetMessage",
        len: 65_536,
    };
    assert_eq!(write(65_536 - overhead, &[1, 2]), Err(too_big));
    assert_eq!(write(65_536 - overhead, &[1]), Ok(()));
}

#[test]
fn too_many_fields_are_refused() {
    let nulls = |count: usize| block(|fields| (0..count).try_for_each(|_| fields.null()));
    assert!(nulls(65_535).is_ok());
    assert_eq!(
        nulls(65_536),
        Err(EncodeError::TooBig {
            what: "FieldCount",
            len: 65_536
        })
    );
}

#[test]
fn the_offsets_point_at_what_a_repeated_message_changes() {
    let header = NetworkHeader {
        timestamp: Some(DateTime(1)),
        ..NetworkHeader::default()
    };
    let data_set_header = DataSetHeader {
        sequence_number: Some(2),
        timestamp: Some(DateTime(3)),
        ..DataSetHeader::default()
    };
    let mut out = vec![0xAA; 5];
    let mut message = NetworkMessageEncoder::new(&mut out, &header, Some(&[1])).unwrap();
    let network_timestamp = message.timestamp_offset().unwrap();
    let fields = message.key_frame(&data_set_header).unwrap();
    let sequence = fields.sequence_offset().unwrap();
    let timestamp = fields.timestamp_offset().unwrap();
    fields.finish().unwrap();
    message.finish().unwrap();
    out[network_timestamp..][..8].copy_from_slice(&4_i64.to_le_bytes());
    out[sequence..][..2].copy_from_slice(&5_u16.to_le_bytes());
    out[timestamp..][..8].copy_from_slice(&6_i64.to_le_bytes());

    let network = NetworkMessage::decode(&out[5..]).unwrap();
    assert_eq!(network.header().timestamp, Some(DateTime(4)));
    let read = network.messages().next().unwrap().unwrap().header();
    assert_eq!(
        (read.sequence_number, read.timestamp),
        (Some(5), Some(DateTime(6)))
    );

    let mut message =
        NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), None).unwrap();
    assert_eq!(message.timestamp_offset(), None);
    let fields = message.key_frame(&DataSetHeader::default()).unwrap();
    assert_eq!(
        (fields.sequence_offset(), fields.timestamp_offset()),
        (None, None)
    );
}

#[test]
fn a_delta_frame_has_the_index_before_each_value() {
    let bytes = message(|message| {
        let mut delta = message.delta_frame(&DataSetHeader::default())?;
        delta.field(3)?.scalar(Scalar::Byte(7))?;
        delta
            .field(0x102)?
            .packed_array(BuiltinType::Byte, 1, &[8])?;
        delta.finish()
    });
    let expected = [
        &[0x81, 0x01, 2, 0][..],
        &[3, 0, 3, 7],
        &[2, 1, 0x83, 1, 0, 0, 0, 8],
    ];
    assert_eq!(bytes.unwrap(), expected.concat());
}

#[test]
fn a_changed_field_has_exactly_one_value() {
    type Write = fn(&mut FieldEncoder<'_>) -> Result<(), EncodeError>;
    let misplaced = |write: Write| {
        let bytes = message(|message| {
            let mut delta = message.delta_frame(&DataSetHeader::default())?;
            write(delta.field(0)?)?;
            delta.finish()
        });
        assert!(matches!(bytes, Err(EncodeError::Misplaced(_))), "{bytes:?}");
    };
    misplaced(|_| Ok(()));
    misplaced(|field| {
        field.null()?;
        field.null()
    });
    misplaced(|field| field.array(BuiltinType::Byte, 1));
    misplaced(|field| field.begin_structure(NodeId::NULL));
    misplaced(|field| field.fields_block(&[1, 0, 0]));
}

#[test]
fn data_values_are_written_with_and_without_index() {
    let value = DataValue {
        value: Some(Scalar::Byte(7).into()),
        status: Some(StatusCode(0x8034_0000)),
        source_picoseconds: Some(5),
        ..DataValue::default()
    };
    let encoded = [0x13, 3, 7, 0, 0, 0x34, 0x80, 5, 0];
    let header = DataSetHeader::default();
    let frame = message(|message| {
        let mut fields = message.data_values(&header)?;
        fields.value(&value)?;
        fields.value(&DataValue::default())?;
        fields.finish()
    });
    assert_eq!(frame.unwrap(), [&[0x05, 2, 0], &encoded[..], &[0]].concat());
    let delta = message(|message| {
        let mut fields = message.delta_data_values(&header)?;
        fields.changed(4, &value)?;
        fields.finish()
    });
    assert_eq!(
        delta.unwrap(),
        [&[0x85, 0x01, 1, 0, 4, 0], &encoded[..]].concat()
    );
    let with_index = message(|message| message.data_values(&header)?.changed(4, &value));
    let without = message(|message| message.delta_data_values(&header)?.value(&value));
    for misplaced in [with_index, without] {
        assert!(matches!(misplaced, Err(EncodeError::Misplaced(_))));
    }
}

#[test]
fn events_and_raw_data_say_what_they_are() {
    let header = DataSetHeader::default();
    let event = message(|message| {
        let mut fields = message.event(&header)?;
        fields.scalar(Scalar::Byte(7))?;
        fields.finish()
    });
    assert_eq!(event.unwrap(), [0x81, 0x02, 1, 0, 3, 7]);
    let raw = message(|message| {
        message.raw_key_frame(&header, |out| {
            out.extend([7, 8]);
            Ok(())
        })
    });
    assert_eq!(raw.unwrap(), [0x03, 7, 8]);
}

#[test]
fn an_array_of_variants_holds_any_of_them() {
    let (mut first, mut second) = (Vec::new(), Vec::new());
    let inner = Variant::from(Scalar::Byte(7));
    let inner = Nested::variant(&inner, &mut first).unwrap();
    let bytes = block(|fields| {
        fields.array(BuiltinType::Variant, 2)?;
        fields.element(Scalar::Variant(inner))?;
        let info = Nested::new(&[0]).unwrap();
        let info = Variant::from(Scalar::DiagnosticInfo(info));
        let info = Nested::variant(&info, &mut second)?;
        fields.element(Scalar::Variant(info))
    });
    assert_eq!(bytes.unwrap(), [1, 0, 0x98, 2, 0, 0, 0, 3, 7, 25, 0]);
}

#[test]
fn what_is_given_as_encoded_has_to_be_one_value() {
    assert!(Nested::<Variant<'_>>::new(&[3, 7]).is_ok());
    assert_eq!(
        Nested::<Variant<'_>>::new(&[3, 7, 0]),
        Err(DecodeError::TrailingBytes(1))
    );
    assert_eq!(
        Nested::<Variant<'_>>::new(&[]),
        Err(DecodeError::Truncated {
            field: "Variant",
            expected: 1,
            found: 0
        })
    );
}

/// Encodes a keep-alive with this SecurityHeader, and the footer if present.
fn secured(security: SecurityHeader<'_>, footer: Option<&[u8]>) -> Result<Vec<u8>, EncodeError> {
    let mut out = Vec::new();
    let extras = Extras {
        security: Some(security),
        ..Extras::default()
    };
    let header = NetworkHeader::default();
    let mut message = NetworkMessageEncoder::with(&mut out, &header, None, &extras)?;
    message.keep_alive(&DataSetHeader::default())?;
    match footer {
        Some(footer) => message.finish_with_footer(footer)?,
        None => message.finish()?,
    }
    Ok(out)
}

#[test]
fn a_footer_is_as_long_as_its_header_says() {
    let two = SecurityHeader {
        footer_size: Some(2),
        ..SecurityHeader::NONE
    };
    let header = [0x81, 0x10, 0x04, 0, 0, 0, 0, 0, 2, 0];
    assert_eq!(
        secured(two, Some(&[8, 9])).unwrap(),
        [&header[..], &[0x81, 0x03, 8, 9]].concat()
    );
    let wrong =
        EncodeError::Misplaced("the size of the SecurityFooter differs from the SecurityHeader");
    assert_eq!(secured(two, Some(&[8])), Err(wrong));
    assert_eq!(secured(two, None), Err(wrong));
    assert_eq!(secured(SecurityHeader::NONE, Some(&[8])), Err(wrong));
    assert!(secured(SecurityHeader::NONE, None).is_ok());
}

#[test]
fn a_message_that_promises_a_signature_is_not_finished_without() {
    for (signed, encrypted) in [(true, false), (false, true), (true, true)] {
        let header = SecurityHeader {
            signed,
            encrypted,
            ..SecurityHeader::NONE
        };
        let unsealed = EncodeError::Misplaced("a secured message left unsealed");
        assert_eq!(secured(header, None), Err(unsealed));
    }
}

#[test]
fn headers_longer_than_their_size_fields_are_refused() {
    let with = |extras: &Extras<'_>| {
        let mut out = Vec::new();
        let header = NetworkHeader::default();
        NetworkMessageEncoder::with(&mut out, &header, Some(&[1]), extras).map(|_| ())
    };
    let too_big = |what, len| Err(EncodeError::TooBig { what, len });
    let nulls = vec![Variant::Null; 65_536];
    let promoted = |count: usize| Extras {
        promoted_fields: Some(&nulls[..count]),
        ..Extras::default()
    };
    assert_eq!(with(&promoted(65_535)), Ok(()));
    assert_eq!(with(&promoted(65_536)), too_big("PromotedFields", 65_536));
    let nonce = [0; 256];
    let security = |len: usize| Extras {
        security: Some(SecurityHeader {
            nonce: &nonce[..len],
            ..SecurityHeader::NONE
        }),
        ..Extras::default()
    };
    assert_eq!(with(&security(255)), Ok(()));
    assert_eq!(with(&security(256)), too_big("MessageNonce", 256));
}

#[test]
fn a_message_longer_than_its_configured_size_becomes_invalid_and_its_neighbours_stay() {
    let mut out = Vec::new();
    let ids = [1, 2, 3];
    let mut network =
        NetworkMessageEncoder::new(&mut out, &NetworkHeader::default(), Some(&ids)).unwrap();
    network.configured_size(10);
    for len in [2, 3, 2] {
        let mut fields = network.key_frame(&DataSetHeader::default()).unwrap();
        fields
            .packed_array(BuiltinType::Byte, len, &vec![7; len])
            .unwrap();
        fields.finish().unwrap();
    }
    network.finish().unwrap();
    let fitting = [0x01, 1, 0, 0x83, 2, 0, 0, 0, 7, 7];
    let payload = [&[10, 0, 10, 0, 10, 0], &fitting[..], &[0; 10], &fitting].concat();
    assert_eq!(out[8..], payload);
    let read = NetworkMessage::decode(&out).unwrap();
    let valid: Vec<_> = read
        .messages()
        .map(|message| message.unwrap().is_valid())
        .collect();
    assert_eq!(valid, [true, false, true]);
}

#[test]
fn a_configured_size_holds_until_another_is_set() {
    let mut out = Vec::new();
    let header = NetworkHeader::default();
    let network = NetworkMessageEncoder::new(&mut out, &header, None).unwrap();
    let mut network = network.fixed_layout(4).unwrap();
    for size in [Some(4), None, Some(0), Some(1)] {
        if let Some(size) = size {
            network.configured_size(size);
        }
        network.keep_alive(&DataSetHeader::default()).unwrap();
    }
    network.finish().unwrap();
    let padded = [0x81, 0x03, 0, 0];
    let expected = [&[0x01], &padded[..], &padded, &[0x81, 0x03], &[0]].concat();
    assert_eq!(out, expected);
}

#[test]
fn a_fixed_layout_has_no_payload_header_and_as_many_messages_as_it_says() {
    let header = NetworkHeader::default();
    let mut out = Vec::new();
    let network = NetworkMessageEncoder::new(&mut out, &header, Some(&[1])).unwrap();
    let misplaced = network.fixed_layout(1).map(|_| ());
    assert!(matches!(misplaced, Err(EncodeError::Misplaced(_))));

    let network = NetworkMessageEncoder::new(&mut out, &header, None).unwrap();
    let mut network = network.fixed_layout(2).unwrap();
    network.keep_alive(&DataSetHeader::default()).unwrap();
    let missing = EncodeError::MessageCount {
        announced: 2,
        written: 1,
    };
    assert_eq!(network.finish(), Err(missing));
}
