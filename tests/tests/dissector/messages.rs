//! Messages written by this project's own encoder.

use system_tests::{CaptureFile, Cell, Dissected, Peer, hex};
use uadp::{
    Array, BuiltinType, DataSetHeader, DataValue, DateTime, DiagnosticInfo, ExpandedNodeId,
    ExtensionBody, ExtensionObject, Extras, FieldEncoder, GroupHeader, Guid, LocalizedText, Matrix,
    Nested, NetworkHeader, NetworkMessageEncoder, NodeId, PublisherId, QualifiedName, Scalar,
    StatusCode, Variant,
};

use crate::dissector::{
    dissected,
    time::ticks,
    vectors::{DissectorVector, unhex},
};

const NOON: DateTime = DateTime(134_234_948_967_890_123);

pub(crate) fn header(publisher: u16, group: u16) -> NetworkHeader<'static> {
    NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(publisher)),
        group: Some(GroupHeader {
            writer_group_id: Some(group),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    }
}

pub(crate) fn numbered(sequence_number: u16) -> DataSetHeader {
    DataSetHeader {
        sequence_number: Some(sequence_number),
        ..DataSetHeader::default()
    }
}

/// Encodes a message of `ua_2_5_10` whose DataSetMessages are written by `write`.
pub(crate) fn message(write: impl FnOnce(&mut NetworkMessageEncoder<'_>)) -> Vec<u8> {
    let mut datagram = Vec::new();
    let mut encoder =
        NetworkMessageEncoder::new(&mut datagram, &header(2, 5), Some(&[10])).unwrap();
    write(&mut encoder);
    encoder.finish().unwrap();
    datagram
}

/// Encodes a key frame of `ua_2_5_10` with sequence number 3.
pub(crate) fn key_frame(write: impl FnOnce(&mut FieldEncoder<'_>)) -> Vec<u8> {
    message(|encoder| {
        let mut fields = encoder.key_frame(&numbered(3)).unwrap();
        write(&mut fields);
        fields.finish().unwrap();
    })
}

pub(crate) fn assert_shown(shown: &Dissected, expected: &[(&str, &str)]) {
    for (field, value) in expected {
        let name = format!("uadp.{field}");
        assert_eq!(shown.all(&name), [*value], "{name}");
    }
}

#[test]
fn every_header_field_is_shown() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let class_id = Guid::from_fields(0x7296_2B91, 0xFA75, 0x4AE6, [1, 2, 3, 4, 5, 6, 7, 8]);
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(2)),
        data_set_class_id: Some(class_id),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            group_version: Some(700_000_000),
            network_message_number: Some(1),
            sequence_number: Some(65_535),
        }),
        timestamp: Some(NOON),
        picoseconds: Some(4500),
    };
    let promoted = [Variant::Scalar(Scalar::UInt32(7))];
    let extras = Extras {
        promoted_fields: Some(&promoted),
        ..Extras::default()
    };
    let mut datagram = Vec::new();
    let mut encoder =
        NetworkMessageEncoder::with(&mut datagram, &header, Some(&[10]), &extras).unwrap();
    let message = DataSetHeader {
        valid: true,
        sequence_number: Some(3),
        timestamp: Some(DateTime(NOON.0 + 1)),
        picoseconds: Some(9999),
        status: Some(0x8034),
        major_version: Some(1),
        minor_version: Some(2),
    };
    let mut fields = encoder.key_frame(&message).unwrap();
    fields.scalar(Scalar::Double(2.5)).unwrap();
    fields.finish().unwrap();
    encoder.finish().unwrap();

    let shown = dissected(&cell, &datagram);
    assert_shown(
        &shown,
        &[
            ("version", "1"),
            ("flags", "0xf1"),
            ("extended_flags1", "0xe9"),
            ("extended_flags2", "0x02"),
            ("message_type", "0"),
            ("publisher_id.type", "1"),
            ("publisher_id", "2"),
            ("data_set_class_id", "72962b91-fa75-4ae6-0102-030405060708"),
            ("group_flags", "0x0f"),
            ("writer_group_id", "5"),
            ("group_version", "700000000"),
            ("network_message_number", "1"),
            ("sequence_number", "65535"),
            ("count", "1"),
            ("dataset_writer_id", "10"),
            ("topic", "ua_2_5_10"),
            ("picoseconds", "4500"),
            ("promoted_fields.size", "5"),
            ("field.uint32", "7"),
            ("dataset.flags1", "0xf9"),
            ("dataset.flags2", "0x30"),
            ("dataset.kind", "0"),
            ("dataset.sequence_number", "3"),
            ("dataset.picoseconds", "9999"),
            ("dataset.status", "0x8034"),
            ("dataset.major_version", "1"),
            ("dataset.minor_version", "2"),
            ("dataset.field_count", "1"),
            ("field.double", "2.5"),
        ],
    );
    assert_eq!(ticks(&shown.one("uadp.timestamp").unwrap()), NOON.0);
    let taken = shown.one("uadp.dataset.timestamp").unwrap();
    assert_eq!(ticks(&taken), NOON.0 + 1);
    for flag in ["group_header", "payload_header", "publisher_id"] {
        assert!(shown.is_set(&format!("uadp.flags.{flag}")), "{flag}");
    }
    assert!(!shown.is_set("uadp.extended_flags1.security"));
    assert!(shown.expert_infos().is_empty());
}

#[test]
fn all_types_of_publisher_ids_are_shown_and_only_numbers_name_a_topic() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let ids = [
        PublisherId::Byte(2),
        PublisherId::UInt16(0xFFFF),
        PublisherId::UInt32(70_000),
        PublisherId::UInt64(u64::MAX),
        PublisherId::String("2"),
    ];
    let datagrams = ids.map(|id| {
        let header = NetworkHeader {
            publisher_id: Some(id),
            ..header(0, 5)
        };
        let mut datagram = Vec::new();
        let mut encoder = NetworkMessageEncoder::new(&mut datagram, &header, Some(&[10])).unwrap();
        encoder.keep_alive(&numbered(4)).unwrap();
        encoder.finish().unwrap();
        datagram
    });
    let capture = CaptureFile::of(datagrams);
    let shown = cell.dissect(&capture, &[]);
    let numbers = ["2", "65535", "70000", "18446744073709551615"];
    for (shown, id) in shown.iter().zip(numbers) {
        assert_shown(shown, &[("publisher_id", id)]);
        assert_shown(shown, &[("topic", &format!("ua_{id}_5_10"))]);
    }
    assert_shown(&shown[4], &[("publisher_id.string", "2")]);
    assert!(!shown[4].has("uadp.publisher_id") && !shown[4].has("uadp.topic"));
    assert_eq!(
        cell.columns(&capture, &[])[3..],
        [
            "UADP PublisherId 18446744073709551615 WriterGroup 5: 10 keep-alive seq 4",
            "UADP PublisherId \"2\" WriterGroup 5: 10 keep-alive seq 4",
        ]
    );
}

#[test]
fn the_info_column_tells_kinds_sequence_numbers_and_fields() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let two_fields = key_frame(|fields| {
        fields.scalar(Scalar::Boolean(true)).unwrap();
        fields.null().unwrap();
    });
    let delta = message(|encoder| {
        let mut delta = encoder.delta_frame(&numbered(4)).unwrap();
        delta.field(7).unwrap().scalar(Scalar::Byte(1)).unwrap();
        delta.finish().unwrap();
    });
    let event = message(|encoder| {
        let mut event = encoder.event(&DataSetHeader::default()).unwrap();
        event.scalar(Scalar::String(Some("alarm"))).unwrap();
        event.finish().unwrap();
    });
    let mut several = Vec::new();
    let mut encoder =
        NetworkMessageEncoder::new(&mut several, &header(2, 5), Some(&[10, 11])).unwrap();
    encoder.key_frame(&numbered(1)).unwrap().finish().unwrap();
    encoder.keep_alive(&numbered(9)).unwrap();
    encoder.finish().unwrap();

    let capture = CaptureFile::of([two_fields, delta, event, several]);
    assert_eq!(
        cell.columns(&capture, &[]),
        [
            "UADP PublisherId 2 WriterGroup 5: 10 key frame seq 3 (2 fields)",
            "UADP PublisherId 2 WriterGroup 5: 10 delta frame seq 4 (1 field)",
            "UADP PublisherId 2 WriterGroup 5: 10 event (1 field)",
            "UADP PublisherId 2 WriterGroup 5: 10 key frame seq 1 (0 fields), 11 keep-alive seq 9",
        ]
    );
    let shown = cell.dissect(&capture, &[]);
    assert_shown(
        &shown[1],
        &[
            ("dataset.kind", "1"),
            ("field.index", "7"),
            ("field.byte", "1"),
        ],
    );
    assert_shown(
        &shown[2],
        &[("dataset.kind", "2"), ("field.string", "alarm")],
    );
    assert_eq!(shown[3].all("uadp.dataset.kind"), ["0", "3"]);
    assert_eq!(shown[3].all("uadp.dataset.size"), ["5", "4"]);
    assert_eq!(shown[3].all("uadp.topic"), ["ua_2_5_10", "ua_2_5_11"]);
}

#[test]
fn plain_values_are_shown_under_their_types() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let guid = Guid::from_fields(1, 2, 3, [4; 8]);
    let scalars = [
        (Scalar::SByte(-128), "-128"),
        (Scalar::Byte(255), "255"),
        (Scalar::Int16(-32_768), "-32768"),
        (Scalar::UInt16(65_535), "65535"),
        (Scalar::Int32(i32::MIN), "-2147483648"),
        (Scalar::UInt32(u32::MAX), "4294967295"),
        (Scalar::Int64(i64::MIN), "-9223372036854775808"),
        (Scalar::UInt64(u64::MAX), "18446744073709551615"),
        (Scalar::Float(-0.5), "-0.5"),
        (Scalar::Double(1e300), "1e+300"),
        (Scalar::String(Some("grüß\"e\" 🤖")), "grüß\"e\" 🤖"),
        (Scalar::String(Some("a\0b")), "a␀b"),
        (Scalar::Guid(guid), "00000001-0002-0003-0404-040404040404"),
        (Scalar::ByteString(Some(&[0, 1, 255])), "00:01:ff"),
        (Scalar::XmlElement(Some("<a/>")), "<a/>"),
        (Scalar::NodeId(NodeId::string(2, "Robot")), "ns=2;s=Robot"),
        (Scalar::StatusCode(StatusCode(0x8034_0000)), "0x80340000"),
    ];
    let datagram = key_frame(|fields| {
        for (scalar, _) in scalars {
            fields.scalar(scalar).unwrap();
        }
        fields.scalar(Scalar::Boolean(true)).unwrap();
        fields.scalar(Scalar::DateTime(NOON)).unwrap();
    });
    let shown = dissected(&cell, &datagram);
    assert!(shown.expert_infos().is_empty());
    let fields = shown.parts("uadp.field");
    for (field, (scalar, text)) in fields.iter().zip(scalars) {
        let builtin = scalar.builtin_type();
        let name = format!("field.{}", builtin.name().to_lowercase());
        assert_shown(
            field,
            &[(&name, text), ("field.type", &builtin.id().to_string())],
        );
    }
    let [boolean, time] = &fields[scalars.len()..] else {
        panic!("{} fields", fields.len());
    };
    assert!(boolean.is_set("uadp.field.boolean"));
    assert_eq!(ticks(&time.one("uadp.field.datetime").unwrap()), NOON.0);
}

#[test]
fn values_of_several_parts_are_shown_part_by_part() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let scalars = [
        Scalar::ExpandedNodeId(ExpandedNodeId {
            node_id: NodeId::numeric(0, 7),
            namespace_uri: Some("urn:x"),
            server_index: 9,
        }),
        Scalar::QualifiedName(QualifiedName {
            namespace: 1,
            name: Some("Speed"),
        }),
        Scalar::LocalizedText(LocalizedText {
            locale: Some("de"),
            text: Some("auf"),
        }),
        Scalar::ExtensionObject(ExtensionObject {
            type_id: NodeId::numeric(3, 5),
            body: ExtensionBody::Binary(&[1, 2, 3]),
        }),
    ];
    let datagram = key_frame(|fields| {
        for scalar in scalars {
            fields.scalar(scalar).unwrap();
        }
    });
    assert_shown(
        &dissected(&cell, &datagram),
        &[
            ("field.expandednodeid", "svr=9;nsu=urn:x;i=7"),
            ("field.qualifiedname", "1:Speed"),
            ("field.localizedtext.locale", "de"),
            ("field.localizedtext.text", "auf"),
            ("field.extensionobject.type_id", "ns=3;i=5"),
            ("field.extensionobject.body", "01:02:03"),
        ],
    );
}

#[test]
fn values_in_values_are_shown_below_them() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let inner = Variant::Scalar(Scalar::UInt16(77));
    let data_value = DataValue {
        value: Some(inner),
        status: Some(StatusCode(0x4090_0000)),
        ..DataValue::default()
    };
    let diagnostic_info = DiagnosticInfo {
        symbolic_id: Some(-1),
        locale: Some(3),
        localized_text: Some(4),
        additional_info: Some(Some("more")),
        inner_status_code: Some(StatusCode(0x8000_0000)),
        ..DiagnosticInfo::default()
    };
    let (mut variant, mut value, mut diagnostic) = (Vec::new(), Vec::new(), Vec::new());
    let datagram = key_frame(|fields| {
        let encoded = Nested::data_value(&data_value, &mut value).unwrap();
        fields.scalar(Scalar::DataValue(encoded)).unwrap();
        let encoded = Nested::diagnostic_info(&diagnostic_info, &mut diagnostic).unwrap();
        fields.scalar(Scalar::DiagnosticInfo(encoded)).unwrap();
        let encoded = Nested::variant(&inner, &mut variant).unwrap();
        let nested = Array::new(BuiltinType::Variant, 1, encoded.bytes()).unwrap();
        fields.variant(&nested.into()).unwrap();
    });
    let shown = dissected(&cell, &datagram);
    let data_values = shown.parts("uadp.field.datavalue");
    assert_shown(
        &data_values[0],
        &[("field.uint16", "77"), ("field.status", "0x40900000")],
    );
    assert_shown(
        &shown.parts("uadp.field.diagnosticinfo")[0],
        &[
            ("field.diagnosticinfo.symbolic_id", "-1"),
            ("field.diagnosticinfo.locale", "3"),
            ("field.diagnosticinfo.localized_text", "4"),
            ("field.diagnosticinfo.additional_info", "more"),
            ("field.diagnosticinfo.inner_status_code", "0x80000000"),
        ],
    );
    let variants = shown.parts("uadp.field.variant");
    assert_shown(&variants[0], &[("field.uint16", "77"), ("field.type", "5")]);
}

#[test]
fn arrays_matrices_and_nulls_are_told_apart() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let numbers: Vec<u8> = (1..=6_i16).flat_map(i16::to_le_bytes).collect();
    let array = Array::new(BuiltinType::Int16, 6, &numbers).unwrap();
    let dimensions = [2_i32.to_le_bytes(), 3_i32.to_le_bytes()];
    let datagram = key_frame(|fields| {
        fields.variant(&array.into()).unwrap();
        fields
            .variant(&Matrix::new(array, &dimensions).unwrap().into())
            .unwrap();
        fields
            .variant(&Array::null(BuiltinType::Int16).into())
            .unwrap();
        fields.packed_array(BuiltinType::Int16, 0, &[]).unwrap();
        fields.scalar(Scalar::String(None)).unwrap();
        fields.scalar(Scalar::String(Some(""))).unwrap();
        fields.null().unwrap();
    });
    let shown = dissected(&cell, &datagram);
    let fields = shown.parts("uadp.field");
    let one_to_six = ["1", "2", "3", "4", "5", "6"];
    for field in &fields[..2] {
        assert_eq!(field.all("uadp.field.int16"), one_to_six);
        assert_shown(field, &[("field.array_length", "6")]);
    }
    assert!(!fields[0].has("uadp.field.dimension"));
    assert_eq!(fields[1].all("uadp.field.dimension"), ["2", "3"]);
    assert_shown(&fields[2], &[("field.array_length", "-1")]);
    assert_shown(&fields[3], &[("field.array_length", "0")]);
    assert_shown(&fields[5], &[("field.string", "")]);
    assert!(!fields[4].has("uadp.field.string"));
    let null = [false, false, true, false, true, false, true];
    for (field, null) in fields.iter().zip(null) {
        assert_eq!(field.is_set("uadp.field.null"), null);
    }
}

#[test]
fn a_data_value_is_shown_with_quality_and_times() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let value = DataValue {
        value: Some(Variant::Scalar(Scalar::Double(0.1))),
        status: Some(StatusCode(0x808C_0000)),
        source_timestamp: Some(NOON),
        source_picoseconds: Some(1),
        server_timestamp: Some(DateTime(NOON.0 + 5)),
        server_picoseconds: Some(2),
    };
    let datagram = message(|encoder| {
        let mut values = encoder.data_values(&numbered(3)).unwrap();
        values.value(&value).unwrap();
        values.finish().unwrap();
    });
    let shown = dissected(&cell, &datagram);
    assert_shown(
        &shown,
        &[
            ("dataset.field_encoding", "2"),
            ("field.double", "0.1"),
            ("field.status", "0x808c0000"),
            ("field.source_picoseconds", "1"),
            ("field.server_picoseconds", "2"),
        ],
    );
    let source = shown.one("uadp.field.source_timestamp").unwrap();
    let server = shown.one("uadp.field.server_timestamp").unwrap();
    assert_eq!((ticks(&source), ticks(&server)), (NOON.0, NOON.0 + 5));
}

#[test]
fn padding_and_raw_data_are_bytes() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let padded = message(|encoder| {
        encoder.configured_size(12);
        let mut fields = encoder.key_frame(&DataSetHeader::default()).unwrap();
        fields.scalar(Scalar::Int32(7)).unwrap();
        fields.finish().unwrap();
    });
    let raw = message(|encoder| {
        encoder
            .raw_key_frame(&numbered(3), |bytes| {
                bytes.extend([1, 2, 3]);
                Ok(())
            })
            .unwrap();
    });
    let too_long = message(|encoder| {
        encoder.configured_size(4);
        let mut fields = encoder.key_frame(&DataSetHeader::default()).unwrap();
        fields.scalar(Scalar::Int32(7)).unwrap();
        fields.finish().unwrap();
    });
    let shown = cell.dissect(&CaptureFile::of([padded, raw, too_long]), &[]);
    assert_shown(
        &shown[0],
        &[("field.int32", "7"), ("dataset.padding", "00:00:00:00")],
    );
    assert_shown(
        &shown[1],
        &[
            ("dataset.field_encoding", "1"),
            ("dataset.raw_data", "01:02:03"),
        ],
    );
    assert!(!shown[2].is_set("uadp.dataset.valid") && shown[2].has("uadp.invalid"));
    assert!(shown.iter().all(|shown| !shown.has("uadp.malformed")));
}

#[test]
fn a_signed_payload_is_read_and_an_encrypted_one_is_not() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let signed = DissectorVector::load("wire_sign_aes128").datagram;
    let encrypted = DissectorVector::load("wire_encrypt_aes128_r0").datagram;
    let capture = CaptureFile::of([signed.clone(), encrypted]);
    let shown = cell.dissect(&capture, &[]);
    assert_shown(
        &shown[0],
        &[
            ("security.flags", "0x01"),
            ("security.token_id", "1"),
            ("security.nonce.random", "15:df:be:3a"),
            ("security.nonce.sequence_number", "1"),
            ("field.string", "cell"),
            ("field.double", "2.5"),
            ("field.int32", "20260517"),
            ("security.signature", &hex(&signed[52..])),
        ],
    );
    assert!(!shown[0].has("uadp.encrypted_payload"));
    assert!(shown[1].has("uadp.encrypted_payload") && !shown[1].has("uadp.dataset"));
    assert_shown(&shown[1], &[("topic", "ua_2234_100_1")]);
    assert_eq!(
        cell.columns(&capture, &[])[1],
        "UADP PublisherId 2234 WriterGroup 100: 1 encrypted (token 1, nonce seq 1)"
    );
}

#[test]
fn chunks_in_any_order_become_one_message() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let chunk = |number| DissectorVector::load(&format!("composite_chunk_{number}")).datagram;
    let capture = CaptureFile::of([chunk(1), chunk(2), chunk(1), chunk(0)]);
    let expected: Vec<u8> = (0_u16..600).map(|i| (i * 3).to_le_bytes()[0]).collect();
    // In the first pass of tshark, and in the second pass over the same packets.
    for passes in [&[][..], &["-2"]] {
        let shown = cell.dissect(&capture, passes);
        let whole = &shown[3];
        assert_eq!(whole.all("uadp.chunk.frame"), ["1", "2", "4"]);
        assert_shown(
            whole,
            &[
                ("chunk.offset", "0"),
                ("chunk.reassembled_length", "610"),
                ("dataset.sequence_number", "77"),
                ("field.bytestring", &hex(&expected)),
            ],
        );
        assert!(shown[..3].iter().all(|shown| !shown.has("uadp.dataset")));
        assert!(
            shown[2].has("uadp.chunk.not_reassembled"),
            "the repeated one"
        );
        let in_frame = if passes.is_empty() { None } else { Some("4") };
        assert_eq!(
            shown[0].one("uadp.chunk.reassembled_in").as_deref(),
            in_frame
        );
    }
}

#[test]
fn chunks_are_left_alone_when_told_so_or_when_one_is_missing() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let chunk = |number| DissectorVector::load(&format!("composite_chunk_{number}")).datagram;
    let all = CaptureFile::of([chunk(0), chunk(1), chunk(2)]);
    let shown = cell.dissect(&all, &["-o", "uadp.reassemble:FALSE"]);
    assert!(shown.iter().all(|shown| !shown.has("uadp.dataset")));
    let shown = cell.dissect(&all, &["-o", "uadp.max_total:609"]);
    assert!(
        shown
            .iter()
            .all(|shown| shown.has("uadp.chunk.not_reassembled"))
    );
    let shown = cell.dissect(&CaptureFile::of([chunk(0), chunk(2)]), &[]);
    assert!(shown.iter().all(|shown| !shown.has("uadp.dataset")));
}

#[test]
fn an_announcement_names_its_fields_chunked_or_not() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let whole = DissectorVector::load("composite_announce_metadata").datagram;
    let (head, body) = whole.split_at(11);
    let chunks = body.chunks(100).enumerate().map(|(number, piece)| {
        let mut datagram = head.to_vec();
        // ExtendedFlags2 marks a chunk of an announcement.
        datagram[2] |= 1;
        datagram.extend(7_u16.to_le_bytes());
        datagram.extend(u32::try_from(number * 100).unwrap().to_le_bytes());
        datagram.extend(u32::try_from(body.len()).unwrap().to_le_bytes());
        datagram.extend(piece);
        datagram
    });
    let shown = cell.dissect(
        &CaptureFile::of([whole.clone()].into_iter().chain(chunks)),
        &[],
    );
    for shown in [shown.first().unwrap(), shown.last().unwrap()] {
        assert_shown(
            shown,
            &[
                ("announcement.type", "2"),
                ("announcement.sequence_number", "7"),
                ("dataset_writer_id", "1"),
                ("metadata.name", "robot_status"),
                ("metadata.field.array_dimension", "3"),
                ("metadata.field.description", "state text"),
                ("metadata.major_version", "700000000"),
                ("metadata.minor_version", "700000001"),
                ("announcement.status", "0x00000000"),
            ],
        );
        let names = shown.all("uadp.metadata.field.name");
        assert_eq!(names, ["battery", "pose", "text"]);
        let types = shown.all("uadp.metadata.field.builtin_type");
        assert_eq!(types, ["11", "11", "12"]);
    }
}

/// DataSetMetaData with described DataTypes before its name, a DataType of each kind, and a field
/// with a property.
const SCHEMA: &str = concat!(
    "919108ba080000000000000201000a00", // announcement 1: DataSetMetaData of DataSetWriterId 10
    "01000000050000007572 6e3a78",      // Namespaces: urn:x
    "0100000001010a00 0100020000005054", // StructureDataTypes: ns=1;i=10, 1:PT
    "01010b00 0016 00000000 01000000",  // its encoding, base type and kind; a field
    "0100000078 00 000b ffffffff 01000000 02000000 00000000 00", // x, Double, dimensions [2]
    "0100000001010c00 01000100000045 01000000", // EnumDataTypes: 1:E with a field
    "0500000000000000 02 02000000 6f6e 00 02000000 6f6e 06", // 5, on
    "0100000001010d00 01000100000053 000c 0c", // SimpleDataTypes: 1:S, a String
    "0400000063656c6c 00 01000000",     // Name: cell; a field
    "01000000 76 00 0000 0b 000b ffffffff ffffffff 00000000", // v, Double
    "01000000000000000000000000000000", // DataSetFieldId
    "01000000 0000 01000000 75 0c 01000000 43", // Properties: 0:u = "C"
    "00000000000000000000000000000000 01000000 02000000 00000000", // class, version 1.2, Good
);

#[test]
fn described_data_types_do_not_shift_what_follows_them() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let shown = dissected(&cell, &unhex(&SCHEMA.replace(' ', "")));
    assert!(shown.expert_infos().is_empty());
    let types = shown.all("uadp.metadata.data_type");
    assert_eq!(types, ["1:PT", "1:E", "1:S"]);
    assert_shown(
        &shown,
        &[
            ("metadata.namespace", "urn:x"),
            ("metadata.name", "cell"),
            ("metadata.field.name", "v"),
            ("metadata.field.builtin_type", "11"),
            ("metadata.field.property", "0:u"),
            ("field.string", "C"),
            ("metadata.major_version", "1"),
            ("metadata.minor_version", "2"),
        ],
    );
}

#[test]
fn other_ports_are_taken_when_told_or_when_nothing_but_uadp_fits() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let good = key_frame(|fields| fields.scalar(Scalar::Int32(7)).unwrap());
    let mut trailing = good.clone();
    trailing.push(1);
    let capture = CaptureFile::of([good, trailing, vec![0xF1; 40]]).to_port(4999);
    let taken = |args: &[&str]| -> Vec<bool> {
        let shown = cell.dissect(&capture, args);
        shown.iter().map(|shown| shown.has("uadp.flags")).collect()
    };
    assert_eq!(taken(&[]), [true, false, false]);
    assert_eq!(taken(&["-o", "uadp.heuristic:FALSE"]), [false; 3]);
    assert_eq!(taken(&["-o", "uadp.ports:4840,4999"]), [true; 3]);
    assert_eq!(taken(&["-d", "udp.port==4999,uadp"]), [true; 3]);
}

#[test]
fn values_are_found_by_filters() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let value = |value: f64| key_frame(|fields| fields.scalar(Scalar::Double(value)).unwrap());
    let capture = CaptureFile::of([value(0.5), value(2.5), value(-1.0)]);
    for (filter, hits) in [
        ("uadp.field.double > 0.6", 1),
        ("uadp.topic == \"ua_2_5_10\" && uadp.publisher_id == 2", 3),
        ("uadp.writer_group_id == 6", 0),
        ("uadp.dataset_writer_id == 10 && uadp.dataset.kind == 0", 3),
        ("uadp.malformed", 0),
    ] {
        assert_eq!(
            cell.columns(&capture, &["-Y", filter]).len(),
            hits,
            "{filter}"
        );
    }
}
