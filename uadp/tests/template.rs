//! A message encoded once and patched: it is what encoding it anew would give, and what does not fit is refused.

use allocation_counter::measure;
use uadp::{
    BuiltinType, DataSetHeader, DateTime, DecodeError, Extras, GroupHeader, Guid, MessageTemplate,
    NetworkHeader, NetworkMessageEncoder, PatchError, PublisherId, Scalar, SecurityHeader,
    StatusCode, Variant,
};

/// What differs from one sending to the next.
#[derive(Clone, Copy)]
struct Values {
    group_sequence_number: u16,
    sequence_number: u16,
    time: i64,
    status: u16,
    double: f64,
    ints: [i32; 3],
    bytes: [u8; 4],
}

const FIRST: Values = Values {
    group_sequence_number: 1,
    sequence_number: 2,
    time: 3,
    status: 0,
    double: 4.0,
    ints: [5, 6, 7],
    bytes: [8, 9, 10, 11],
};

const SECOND: Values = Values {
    group_sequence_number: 0xFFFF,
    sequence_number: 0x1234,
    time: 134_234_948_967_890_123,
    status: 0x8034,
    double: -2.5,
    ints: [i32::MIN, -1, i32::MAX],
    bytes: [0xFF; 4],
};

/// Two DataSetMessages behind every header field there is; in front of the values a text, whose size varies.
fn encode(values: Values) -> Vec<u8> {
    let time = Some(DateTime(values.time));
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::String("cell 4")),
        data_set_class_id: Some(Guid([3; 16])),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            group_version: Some(6),
            network_message_number: Some(7),
            sequence_number: Some(values.group_sequence_number),
        }),
        timestamp: time,
        picoseconds: Some(8),
    };
    let data_set_header = DataSetHeader {
        sequence_number: Some(values.sequence_number),
        timestamp: time,
        picoseconds: Some(9),
        status: Some(values.status),
        major_version: Some(10),
        minor_version: Some(11),
        ..DataSetHeader::default()
    };
    let mut datagram = Vec::new();
    let mut encoder = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[10, 11])).unwrap();
    for _ in 0..2 {
        let mut fields = encoder.key_frame(&data_set_header).unwrap();
        fields.scalar(Scalar::String(Some("text"))).unwrap();
        fields.scalar(Scalar::Double(values.double)).unwrap();
        for int in values.ints {
            fields.scalar(Scalar::Int32(int)).unwrap();
        }
        fields
            .packed_array(BuiltinType::Byte, 4, &values.bytes)
            .unwrap();
        fields.finish().unwrap();
    }
    encoder.finish().unwrap();
    datagram
}

fn patch(template: &mut MessageTemplate, values: Values) {
    let time = DateTime(values.time);
    template
        .group_sequence_number(values.group_sequence_number)
        .unwrap();
    template.timestamp(time).unwrap();
    for index in 0..2 {
        let mut message = template.message(index).unwrap();
        message.sequence_number(values.sequence_number).unwrap();
        message.timestamp(time).unwrap();
        message
            .status(StatusCode::from_status(values.status))
            .unwrap();
        message.field(1, Scalar::Double(values.double)).unwrap();
        message.fields(2, &values.ints).unwrap();
        message
            .packed_array(5, BuiltinType::Byte, &values.bytes)
            .unwrap();
    }
}

/// A message of one DataSetMessage with these fields and no optional header field.
fn plain(values: &[Variant<'_>]) -> MessageTemplate {
    let mut datagram = Vec::new();
    let header = NetworkHeader::default();
    let mut encoder = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[1])).unwrap();
    let mut fields = encoder.key_frame(&DataSetHeader::default()).unwrap();
    for value in values {
        fields.variant(value).unwrap();
    }
    fields.finish().unwrap();
    encoder.finish().unwrap();
    MessageTemplate::new(datagram).unwrap()
}

#[test]
fn a_patched_message_is_the_one_encoded_with_the_new_values() {
    let mut template = MessageTemplate::new(encode(FIRST)).unwrap();
    patch(&mut template, SECOND);
    assert_eq!(template.bytes(), encode(SECOND));
    patch(&mut template, FIRST);
    assert_eq!(template.bytes(), encode(FIRST));
    assert!(template.message(2).is_none());
}

#[test]
fn patching_allocates_nothing() {
    let mut template = MessageTemplate::new(encode(FIRST)).unwrap();
    let allocations = measure(|| patch(&mut template, SECOND));
    assert_eq!(template.bytes(), encode(SECOND));
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn one_field_of_every_fixed_size_is_replaced_and_its_neighbours_are_not() {
    let before = [
        Scalar::Boolean(false),
        Scalar::SByte(1),
        Scalar::Byte(1),
        Scalar::Int16(1),
        Scalar::UInt16(1),
        Scalar::Int32(1),
        Scalar::UInt32(1),
        Scalar::Int64(1),
        Scalar::UInt64(1),
        Scalar::Float(1.0),
        Scalar::Double(1.0),
        Scalar::DateTime(DateTime(1)),
        Scalar::Guid(Guid([1; 16])),
        Scalar::StatusCode(StatusCode(1)),
    ];
    let after = [
        Scalar::Boolean(true),
        Scalar::SByte(-2),
        Scalar::Byte(0xFE),
        Scalar::Int16(-2),
        Scalar::UInt16(0xFFFE),
        Scalar::Int32(-2),
        Scalar::UInt32(0xFFFF_FFFE),
        Scalar::Int64(-2),
        Scalar::UInt64(u64::MAX - 1),
        Scalar::Float(-2.5),
        Scalar::Double(-2.5),
        Scalar::DateTime(DateTime(-2)),
        Scalar::Guid(Guid([0xFE; 16])),
        Scalar::StatusCode(StatusCode(0x8034_0000)),
    ];
    for (index, value) in after.into_iter().enumerate() {
        let mut expected = before.map(Variant::Scalar);
        *expected.get_mut(index).unwrap() = value.into();
        let mut template = plain(&before.map(Variant::Scalar));
        template.message(0).unwrap().field(index, value).unwrap();
        assert_eq!(template.bytes(), plain(&expected).bytes(), "{value:?}");
    }
}

#[test]
fn what_does_not_fit_is_refused_and_changes_nothing() {
    let byte = |value| Variant::Scalar(Scalar::Byte(value));
    let fields = [
        byte(1),
        byte(2),
        Scalar::String(Some("text")).into(),
        Scalar::Int16(3).into(),
    ];
    let mut template = plain(&fields);
    let mut message = template.message(0).unwrap();
    let wrong = |field, found| Err(PatchError::Type { field, found });
    let text = Scalar::String(Some("tell"));
    assert_eq!(
        message.field(0, Scalar::SByte(9)),
        wrong(0, BuiltinType::SByte)
    );
    assert_eq!(message.field(2, text), wrong(2, BuiltinType::String));
    assert_eq!(
        message.field(4, Scalar::Byte(9)),
        Err(PatchError::NoField(4))
    );
    // The first two would fit.
    assert_eq!(message.fields(0, &[9_u8; 3]), wrong(2, BuiltinType::Byte));
    assert_eq!(message.fields(3, &[9_i16; 2]), Err(PatchError::NoField(5)));
    assert_eq!(
        message.packed_array(0, BuiltinType::Byte, &[9]),
        wrong(0, BuiltinType::Byte)
    );
    assert_eq!(
        message.sequence_number(9),
        Err(PatchError::Absent("DataSetMessageSequenceNumber"))
    );
    assert!(message.timestamp(DateTime(9)).is_err());
    assert!(message.status(StatusCode::GOOD).is_err());
    assert!(template.group_sequence_number(9).is_err());
    assert!(template.timestamp(DateTime(9)).is_err());
    assert_eq!(template.bytes(), plain(&fields).bytes());
}

#[test]
fn an_array_keeps_its_length_and_its_type() {
    let mut template = MessageTemplate::new(encode(FIRST)).unwrap();
    let mut message = template.message(1).unwrap();
    assert_eq!(
        message.packed_array(5, BuiltinType::Byte, &[1, 2, 3]),
        Err(PatchError::Size {
            field: 5,
            expected: 4,
            found: 3
        })
    );
    assert!(
        message
            .packed_array(5, BuiltinType::SByte, &[1; 4])
            .is_err()
    );
    assert!(message.field(5, Scalar::Byte(1)).is_err());
    assert_eq!(template.bytes(), encode(FIRST));
}

#[test]
fn the_bytes_of_raw_data_are_replaced_within_the_message() {
    let encode = |raw: [u8; 4]| {
        let mut datagram = Vec::new();
        let header = NetworkHeader::default();
        let mut encoder =
            NetworkMessageEncoder::new(&mut datagram, &header, Some(&[1, 2])).unwrap();
        for _ in 0..2 {
            encoder
                .raw_key_frame(&DataSetHeader::default(), |buf| {
                    buf.extend_from_slice(&raw);
                    Ok(())
                })
                .unwrap();
        }
        encoder.finish().unwrap();
        datagram
    };
    let mut template = MessageTemplate::new(encode([1, 2, 3, 4])).unwrap();
    for index in 0..2 {
        let mut message = template.message(index).unwrap();
        message.raw(1, &[7, 8, 9]).unwrap();
        assert!(message.raw(2, &[0; 3]).is_err());
        assert!(message.raw(5, &[]).is_err());
        assert!(message.raw(usize::MAX, &[0]).is_err());
        assert!(message.field(0, Scalar::Byte(1)).is_err());
    }
    assert_eq!(template.bytes(), encode([1, 7, 8, 9]));
}

#[test]
fn what_has_no_fixed_layout_makes_no_template() {
    let header = NetworkHeader::default();
    let frame = DataSetHeader::default();
    let misread = |datagram| {
        let refused = MessageTemplate::new(datagram).unwrap_err();
        assert!(matches!(refused, DecodeError::Misread(_)), "{refused}");
    };
    let mut delta = Vec::new();
    let mut encoder = NetworkMessageEncoder::new(&mut delta, &header, Some(&[1])).unwrap();
    encoder.delta_frame(&frame).unwrap().finish().unwrap();
    encoder.finish().unwrap();
    misread(delta);
    for extras in [
        Extras {
            security: Some(SecurityHeader::NONE),
            ..Extras::default()
        },
        Extras {
            promoted_fields: Some(&[Variant::Null]),
            ..Extras::default()
        },
    ] {
        let mut datagram = Vec::new();
        let mut encoder =
            NetworkMessageEncoder::with(&mut datagram, &header, Some(&[1]), &extras).unwrap();
        encoder.heartbeat(&frame).unwrap();
        encoder.finish().unwrap();
        misread(datagram);
    }
    assert!(MessageTemplate::new(vec![0x41]).is_err());
}
