//! What a writer may ask for, and what it is refused.

#![expect(clippy::wildcard_enum_match_arm, reason = "test code")]

use uadp::{
    BuiltinType, DataSetHeader, DateTime, EncodeError, ExtensionBody, FieldEncoder, Fields,
    NetworkHeader, NetworkMessage, NetworkMessageEncoder, NodeId, Scalar, Variant,
};

/// What a key frame of the smallest header becomes: bytes behind the header, or why not.
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
    assert_eq!(
        block(|fields| fields.array(BuiltinType::Variant, 0)),
        Err(EncodeError::Unsupported(BuiltinType::Variant))
    );
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
    let read = network.messages().next().unwrap().unwrap().header;
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
