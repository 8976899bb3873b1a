//! RawData: datagrams of other stacks, the tables of the standard, and rejected input.
//!
//! The standard has no example of a RawData payload. The expected bytes of `RawDialect::Standard`
//! are encoded by hand from OPC 10000-14, 7.2.4.5.11; their structures are the examples of
//! OPC 10000-6, 5.2.7 and 5.2.8.

use std::path::PathBuf;

use allocation_counter::measure;
use serde_json::Value;
use uadp::{
    Array, BuiltinType, DateTime, DecodeError, ExtensionBody, ExtensionObject, FieldEncoding, Guid,
    Matrix, NetworkMessage, NetworkMessageEncoder, NodeId, RawDialect, RawField, RawLayout,
    RawLayoutFault, RawStructure, RawStructureType, RawValue, RawWriteError, RawWriteFault, Scalar,
    StatusCode, Variant,
};

use BuiltinType::{Boolean, Byte, ByteString, Double, Float, Int32, SByte, String as Text, UInt16};
use RawDialect::{Open62541, Standard};

const DIALECTS: [RawDialect; 2] = [Standard, Open62541];

/// Decodes all fields.
fn read<'p>(
    fields: &'p [RawField<'p>],
    payload: &'p [u8],
    dialect: RawDialect,
) -> Result<Vec<RawValue<'p>>, DecodeError> {
    RawLayout::new(fields)
        .unwrap()
        .read(payload, dialect)
        .collect()
}

fn write<'v, V: Into<RawValue<'v>>>(
    fields: &[RawField<'_>],
    values: impl IntoIterator<Item = V>,
    dialect: RawDialect,
) -> Result<Vec<u8>, RawWriteError> {
    let mut payload = Vec::new();
    RawLayout::new(fields)
        .unwrap()
        .write(&mut payload, dialect, values)?;
    Ok(payload)
}

/// Checks that the bytes decode to the values, and that the values encode to the bytes.
#[track_caller]
fn same<'p>(
    fields: &'p [RawField<'p>],
    payload: &'p [u8],
    dialect: RawDialect,
    values: &[Variant<'_>],
) {
    let read = read(fields, payload, dialect).unwrap();
    let read: Vec<_> = read
        .into_iter()
        .map(|value| value.variant().unwrap())
        .collect();
    assert_eq!(read, values);
    assert_eq!(
        write(fields, values.iter().copied(), dialect).unwrap(),
        payload
    );
    if let Some(size) = RawLayout::new(fields).unwrap().fixed_size(dialect) {
        assert_eq!(size, payload.len());
    }
}

fn fault(result: Result<Vec<u8>, RawWriteError>) -> RawWriteFault {
    result.unwrap_err().fault
}

mod other_stacks {
    use super::*;

    #[test]
    fn every_raw_vector_is_read_as_described_and_written_back() {
        let mut count = 0;
        for name in names() {
            let json = load(&format!("{name}.json"));
            let message = &json["dataSetMessages"][0];
            if message["fieldEncoding"] != "RawData" || json["security"].is_object() {
                continue;
            }
            count += 1;
            let datagram =
                hex(&std::fs::read_to_string(folder().join(format!("{name}.hex"))).unwrap());
            let range = range();
            let fields = fields(&name, message, &range);
            let layout = RawLayout::new(&fields).unwrap();
            let expected: Vec<_> = match message["fields"].as_array().unwrap() {
                none if none.is_empty() => vec![format!("{:?}", Scalar::UInt32(0x0403_0201))],
                fields => fields.iter().map(|field| said(&field["value"])).collect(),
            };
            let dialects = if json["contested"].is_string() {
                &DIALECTS[1..]
            } else {
                &DIALECTS[..]
            };
            for dialect in dialects {
                assert_eq!(found(&layout, &datagram, *dialect), expected, "{name}");
                assert_eq!(rewritten(&layout, &datagram, *dialect), datagram, "{name}");
            }
        }
        assert_eq!(count, 13, "vectors of RawData");
    }

    #[test]
    fn the_payload_of_an_encrypted_vector_is_read_when_it_is_open() {
        let json = load("wire_encrypt_raw_aes128.json");
        let open = hex(json["security"]["decryptedPayload"].as_str().unwrap());
        let datagram = [&[0x01], &*open].concat();
        let fields = [RawField::new(Double), RawField::new(Int32)];
        let layout = RawLayout::new(&fields).unwrap();
        let values = found(&layout, &datagram, Standard);
        assert_eq!(values, ["Double(2.5)", "Int32(20260517)"]);
    }

    #[test]
    fn texts_and_arrays_as_long_as_can_be_are_the_same_in_both_dialects_and_matrices_are_not() {
        for (name, same) in [
            ("raw_array_1d", true),
            ("raw_strings_padded", true),
            ("wire_raw_mixed", true),
            ("raw_matrix_2d", false),
        ] {
            let json = load(&format!("{name}.json"));
            let datagram =
                hex(&std::fs::read_to_string(folder().join(format!("{name}.hex"))).unwrap());
            let range = range();
            let fields = fields(name, &json["dataSetMessages"][0], &range);
            let layout = RawLayout::new(&fields).unwrap();
            let read: Result<Vec<_>, _> = layout.read(payload(&datagram), Standard).collect();
            assert_eq!(read.is_ok(), same, "{name}: {read:?}");
        }
    }

    fn payload(datagram: &[u8]) -> &[u8] {
        let network = NetworkMessage::decode(datagram).unwrap();
        let message = network.messages().next().unwrap().unwrap();
        assert_eq!(message.encoding(), FieldEncoding::RawData);
        message.payload()
    }

    fn found(layout: &RawLayout<'_>, datagram: &[u8], dialect: RawDialect) -> Vec<String> {
        layout
            .read(payload(datagram), dialect)
            .map(|value| match value.unwrap().variant().unwrap() {
                Variant::Scalar(Scalar::ExtensionObject(object)) => {
                    let ExtensionBody::Binary(body) = object.body else {
                        panic!("{object:?}")
                    };
                    let range = range();
                    assert_eq!(object.type_id, range.type_id());
                    let members = range.members(body, dialect).unwrap();
                    let members: Vec<_> = members
                        .map(|member| scalar(member.unwrap().1.variant().unwrap()))
                        .collect();
                    members.join(" ")
                }
                Variant::Array(array) => elements(array),
                Variant::Matrix(matrix) => format!(
                    "{:?} {}",
                    matrix.dimensions().collect::<Vec<_>>(),
                    elements(matrix.elements())
                ),
                value => scalar(value),
            })
            .collect()
    }

    fn rewritten(layout: &RawLayout<'_>, datagram: &[u8], dialect: RawDialect) -> Vec<u8> {
        let network = NetworkMessage::decode(datagram).unwrap();
        let ids: Option<Vec<u16>> = network.writer_ids().map(Iterator::collect);
        let mut out = Vec::new();
        let mut encoder =
            NetworkMessageEncoder::new(&mut out, &network.header(), ids.as_deref()).unwrap();
        for message in network.messages() {
            let message = message.unwrap();
            let values = layout.read(message.payload(), dialect).map(Result::unwrap);
            let mut raw = Vec::new();
            layout.write(&mut raw, dialect, values).unwrap();
            encoder
                .raw_key_frame(&message.header(), |buf| {
                    buf.extend_from_slice(&raw);
                    Ok(())
                })
                .unwrap();
        }
        encoder.finish().unwrap();
        out
    }

    /// Returns the layout of the metaData in the JSON file. For two vectors the JSON file is not
    /// sufficient.
    fn fields<'a>(name: &str, message: &Value, range: &'a RawStructure<'a>) -> Vec<RawField<'a>> {
        let Some(metadata) = message["metaData"].as_array() else {
            assert_eq!(name, "asyncua_raw");
            return vec![RawField::new(BuiltinType::UInt32)];
        };
        metadata
            .iter()
            .map(|field| {
                let number = |key: &str| field[key].as_i64().unwrap();
                let builtin = u8::try_from(number("builtInType")).unwrap();
                let dimensions: Vec<u32> = field["arrayDimensions"]
                    .as_array()
                    .unwrap()
                    .iter()
                    .map(|size| u32::try_from(size.as_u64().unwrap()).unwrap())
                    .collect();
                let builtin = BuiltinType::from_id(builtin).unwrap();
                RawField {
                    value_rank: i32::try_from(number("valueRank")).unwrap(),
                    array_dimensions: dimensions.leak(),
                    max_string_length: u32::try_from(number("maxStringLength")).unwrap(),
                    structure: (builtin == BuiltinType::ExtensionObject).then_some(range),
                    ..RawField::new(builtin)
                }
            })
            .collect()
    }

    fn range() -> RawStructure<'static> {
        const FIELDS: &[RawField<'_>] = &[RawField::new(Double), RawField::new(Double)];
        RawStructure::new(NodeId::numeric(0, 886), RawStructureType::Structure, FIELDS).unwrap()
    }

    fn scalar(value: Variant<'_>) -> String {
        let Variant::Scalar(value) = value else {
            panic!("{value:?}")
        };
        format!("{value:?}")
    }

    fn elements(array: Array<'_>) -> String {
        let elements: Vec<_> = array.iter().map(|element| format!("{element:?}")).collect();
        elements.join(" ")
    }

    fn said(json: &Value) -> String {
        let builtin = u8::try_from(json["UaType"].as_u64().unwrap()).unwrap();
        let builtin = BuiltinType::from_id(builtin).unwrap();
        let value = &json["Value"];
        if builtin == BuiltinType::ExtensionObject {
            assert_eq!(value["UaTypeId"], "i=884");
            return format!(
                "{} {}",
                said_scalar(Double, &value["Low"]),
                said_scalar(Double, &value["High"])
            );
        }
        let Some(elements) = value.as_array() else {
            return said_scalar(builtin, value);
        };
        let elements: Vec<_> = elements
            .iter()
            .map(|element| said_scalar(builtin, element))
            .collect();
        match json["Dimensions"].as_array() {
            Some(dimensions) if dimensions.len() > 1 => {
                let dimensions: Vec<_> = dimensions.iter().map(Value::to_string).collect();
                format!("[{}] {}", dimensions.join(", "), elements.join(" "))
            }
            _ => elements.join(" "),
        }
    }

    fn said_scalar(builtin: BuiltinType, json: &Value) -> String {
        let text = json.as_str().unwrap_or_default();
        match builtin {
            Double => format!("{:?}", Scalar::Double(json.as_f64().unwrap())),
            Float => format!("Float({:?})", json.as_f64().unwrap()),
            Text => format!("{:?}", Scalar::String(Some(text))),
            ByteString => {
                assert_eq!(text, "AQKAEA==");
                format!("{:?}", Scalar::ByteString(Some(&[1, 2, 0x80, 0x10])))
            }
            BuiltinType::DateTime => {
                let ticks = match text {
                    "2026-05-17T12:34:56.7890123Z" => 134_234_948_967_890_123,
                    "2024-05-12T15:06:40.000000Z" => 133_600_000_000_000_000,
                    _ => panic!("{text}"),
                };
                format!("{:?}", Scalar::DateTime(DateTime(ticks)))
            }
            BuiltinType::Guid => {
                assert_eq!(text, "72962B91-FA75-4AE6-8D28-B404DC7DAF63");
                let tail = [0x8D, 0x28, 0xB4, 0x04, 0xDC, 0x7D, 0xAF, 0x63];
                let guid = Guid::from_fields(0x7296_2B91, 0xFA75, 0x4AE6, tail);
                format!("{:?}", Scalar::Guid(guid))
            }
            BuiltinType::StatusCode => {
                let code = u32::try_from(json["Code"].as_u64().unwrap()).unwrap();
                format!("{:?}", Scalar::StatusCode(StatusCode(code)))
            }
            _ if json.is_string() => format!("{builtin}({text})"),
            _ => format!("{builtin}({json})"),
        }
    }

    fn names() -> Vec<String> {
        let manifest = load("MANIFEST.json");
        let entries = manifest.as_array().unwrap().iter();
        entries
            .map(|entry| entry["name"].as_str().unwrap().to_owned())
            .collect()
    }

    fn folder() -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/vectors")
    }

    fn load(file: &str) -> Value {
        serde_json::from_str(&std::fs::read_to_string(folder().join(file)).unwrap()).unwrap()
    }

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u8> = text
            .trim()
            .chars()
            .map(|c| u8::try_from(c.to_digit(16).unwrap()).unwrap())
            .collect();
        digits
            .chunks_exact(2)
            .map(|pair| pair[0] << 4 | pair[1])
            .collect()
    }
}

#[test]
fn a_text_is_padded_to_its_maximum_behind_its_real_length() {
    let fields = [
        RawField::new(Text).with_max_string_length(6),
        RawField::new(ByteString).with_max_string_length(2),
        RawField::new(Text).with_max_string_length(2),
        RawField::new(Text).with_max_string_length(3),
        RawField::new(Byte),
    ];
    let payload = [
        4, 0, 0, 0, b'c', b'e', b'l', b'l', 0, 0, // shorter
        2, 0, 0, 0, 0, 0, // maximum length, bytes are zero
        0, 0, 0, 0, 0, 0, // empty
        0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, // null
        9,
    ];
    let values = [
        Scalar::String(Some("cell")),
        Scalar::ByteString(Some(&[0, 0])),
        Scalar::String(Some("")),
        Scalar::String(None),
        Scalar::Byte(9),
    ];
    for dialect in DIALECTS {
        same(&fields, &payload, dialect, &values.map(Variant::from));
    }
}

#[test]
fn a_text_without_maximum_is_not_padded() {
    let fields = [RawField::new(Text), RawField::new(Byte)];
    let payload = [2, 0, 0, 0, b'h', b'i', 9];
    let values = [Scalar::String(Some("hi")), Scalar::Byte(9)];
    for dialect in DIALECTS {
        same(&fields, &payload, dialect, &values.map(Variant::from));
        let layout = RawLayout::new(&fields).unwrap();
        assert_eq!(layout.fixed_size(dialect), None);
        assert_eq!(layout.field_offset(0, dialect), Some(0));
        assert_eq!(layout.field_offset(1, dialect), None);
    }
}

#[test]
fn the_standard_pads_a_short_array_behind_its_real_length() {
    let fields = [
        RawField::new(UInt16).with_dimensions(&[3]),
        RawField::new(Byte).with_dimensions(&[2]),
        RawField::new(Byte),
    ];
    let payload = [
        2, 0, 0, 0, 7, 0, 8, 0, 0, 0, // two of three
        0xFF, 0xFF, 0xFF, 0xFF, 0, 0, // null
        9,
    ];
    let values = [
        Array::new(UInt16, 2, &[7, 0, 8, 0]).unwrap().into(),
        Array::null(Byte).into(),
        Scalar::Byte(9).into(),
    ];
    same(&fields, &payload, Standard, &values);
    let layout = RawLayout::new(&fields).unwrap();
    assert_eq!(layout.field_offset(2, Standard), Some(16));
    assert_eq!(layout.field_offset(3, Standard), None);
}

#[test]
fn open62541_reads_a_short_array_unpadded_and_writes_none() {
    let fields = [
        RawField::new(UInt16).with_dimensions(&[3]),
        RawField::new(Byte),
    ];
    let payload = [2, 0, 0, 0, 7, 0, 8, 0, 9];
    let short = Array::new(UInt16, 2, &payload[4..8]).unwrap();
    let values: [Variant<'_>; 2] = [short.into(), Scalar::Byte(9).into()];
    let read = read(&fields, &payload, Open62541).unwrap();
    assert_eq!(read, values.map(RawValue::from));
    let expected = RawWriteFault::ArrayDimensions {
        expected: 3,
        len: 2,
    };
    assert_eq!(fault(write(&fields, values, Open62541)), expected);
}

#[test]
fn open62541_has_no_null_array() {
    let fields = [RawField::new(UInt16).with_dimensions(&[3])];
    let null = [Variant::from(Array::null(UInt16))];
    let expected = RawWriteFault::NullArray;
    assert_eq!(fault(write(&fields, null, Open62541)), expected);
    let expected = DecodeError::Reserved {
        field: "array length",
        value: u32::MAX,
    };
    let payload = [0xFF, 0xFF, 0xFF, 0xFF];
    assert_eq!(read(&fields, &payload, Open62541), Err(expected));
}

#[test]
fn the_elements_of_a_fixed_size_array_are_borrowed_from_the_payload() {
    let fields = [RawField::new(Double).with_dimensions(&[2])];
    let mut payload = vec![2, 0, 0, 0];
    payload.extend([1.5_f64, 2.5].map(f64::to_le_bytes).as_flattened());
    for dialect in DIALECTS {
        let values = read(&fields, &payload, dialect).unwrap();
        let Some(Variant::Array(array)) = values[0].variant() else {
            panic!("{values:?}")
        };
        assert_eq!(array.bytes().as_ptr(), payload[4..].as_ptr());
        assert_eq!(array.len(), 2);
    }
}

#[test]
fn the_standard_writes_a_matrix_inline_with_the_number_of_its_dimensions() {
    let fields = [RawField::new(Byte).with_dimensions(&[2, 3])];
    let payload = [2, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, 1, 2, 3, 4, 5, 6];
    let elements = Array::new(Byte, 6, &[1, 2, 3, 4, 5, 6]).unwrap();
    let matrix = Matrix::new(elements, &[[2, 0, 0, 0], [3, 0, 0, 0]]).unwrap();
    same(&fields, &payload, Standard, &[matrix.into()]);
    same(&fields, &payload[4..], Open62541, &[matrix.into()]);
}

#[test]
fn the_standard_pads_a_matrix_with_rows_missing_and_one_without_elements() {
    let fields = [RawField::new(Byte).with_dimensions(&[2, 3])];
    let one_row = [2, 0, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 1, 2, 3, 0, 0, 0];
    let elements = Array::new(Byte, 3, &[1, 2, 3]).unwrap();
    let matrix = Matrix::new(elements, &[[1, 0, 0, 0], [3, 0, 0, 0]]).unwrap();
    same(&fields, &one_row, Standard, &[matrix.into()]);
    let empty = [2, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0];
    let elements = Array::new(Byte, 0, &[]).unwrap();
    let matrix = Matrix::new(elements, &[[2, 0, 0, 0], [0; 4]]).unwrap();
    same(&fields, &empty, Standard, &[matrix.into()]);
}

#[test]
fn a_padded_matrix_with_short_rows_is_refused_as_its_elements_could_stand_in_two_places() {
    let fields = [RawField::new(Byte).with_dimensions(&[2, 3])];
    let payload = [2, 0, 0, 0, 2, 0, 0, 0, 2, 0, 0, 0, 1, 2, 3, 4, 0, 0];
    let error = read(&fields, &payload, Standard).unwrap_err();
    assert!(matches!(error, DecodeError::Unsupported(_)), "{error}");
    let elements = Array::new(Byte, 4, &[1, 2, 3, 4]).unwrap();
    let matrix = Matrix::new(elements, &[[2, 0, 0, 0], [2, 0, 0, 0]]).unwrap();
    let expected = RawWriteFault::ArrayDimensions {
        expected: 3,
        len: 2,
    };
    let written = write(&fields, [Variant::from(matrix)], Standard);
    assert_eq!(fault(written), expected);

    let cube = [RawField::new(Byte).with_dimensions(&[1, 2, 2])];
    let payload_of_cube = [3, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 1, 2, 0, 0];
    assert_eq!(read(&cube, &payload_of_cube, Standard), Err(error));

    let unknown = [RawField::new(Byte).with_dimensions(&[0, 3])];
    same(&unknown, &payload[..16], Standard, &[matrix.into()]);
}

#[test]
fn each_text_of_an_array_is_padded_and_then_the_array() {
    let fields = [
        RawField::new(Text)
            .with_max_string_length(3)
            .with_dimensions(&[3]),
        RawField::new(Byte),
    ];
    let standard = [
        2, 0, 0, 0, // two of three
        1, 0, 0, 0, b'x', 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, // "x", null
        0, 0, 0, 0, 0, 0, 0, // no third element
        9,
    ];
    let values = read(&fields, &standard, Standard).unwrap();
    let RawValue::Array(array) = values[0] else {
        panic!("{values:?}")
    };
    assert_eq!(array.len(), 2);
    let texts: Vec<_> = array.iter().collect();
    assert_eq!(texts, [Scalar::String(Some("x")), Scalar::String(None)]);
    assert_eq!(values[0].variant(), None);
    assert_eq!(write(&fields, values, Standard).unwrap(), standard);

    let packed = [1, 0, 0, 0, b'x', 0xFF, 0xFF, 0xFF, 0xFF];
    let packed = Array::new(Text, 2, &packed).unwrap();
    let values: [Variant<'_>; 2] = [packed.into(), Scalar::Byte(9).into()];
    assert_eq!(write(&fields, values, Standard).unwrap(), standard);
}

/// TypeA of OPC 10000-6, 5.2.7: Int32 X, optional Int32 O1, SByte Y, optional Int32 O2.
const TYPE_A: &[RawField<'_>] = &[
    RawField::new(Int32),
    RawField::new(Int32).as_optional(),
    RawField::new(SByte),
    RawField::new(Int32).as_optional(),
];
/// The 13 bytes of the example: O2 is present, O1 is absent.
const TYPE_A_PLAIN: [u8; 13] = [2, 0, 0, 0, 5, 0, 0, 0, 0xFD, 6, 0, 0, 0];
/// The same structure with padding for O1.
const TYPE_A_PADDED: [u8; 17] = [2, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0, 0xFD, 6, 0, 0, 0];

fn type_a() -> RawStructure<'static> {
    let with_optional_fields = RawStructureType::StructureWithOptionalFields;
    RawStructure::new(NodeId::numeric(1, 1), with_optional_fields, TYPE_A).unwrap()
}

fn body<'a>(value: &RawValue<'a>) -> &'a [u8] {
    match value.variant() {
        Some(Variant::Scalar(Scalar::ExtensionObject(ExtensionObject {
            body: ExtensionBody::Binary(body),
            ..
        }))) => body,
        other => panic!("{other:?}"),
    }
}

fn object<'a>(structure: &RawStructure<'a>, body: &'a [u8]) -> Variant<'a> {
    Variant::Scalar(Scalar::ExtensionObject(ExtensionObject {
        type_id: structure.type_id(),
        body: ExtensionBody::Binary(body),
    }))
}

#[test]
fn an_optional_field_that_is_not_there_is_padding_of_its_size() {
    let type_a = type_a();
    let fields = [RawField::structure(&type_a), RawField::new(Byte)];
    for (dialect, inline) in [
        (Standard, &TYPE_A_PADDED[..]),
        (Open62541, &TYPE_A_PLAIN[..]),
    ] {
        let payload = [inline, &[9]].concat();
        let values = read(&fields, &payload, dialect).unwrap();
        assert_eq!(body(&values[0]), inline);
        let members = type_a.members(body(&values[0]), dialect).unwrap();
        let members: Vec<_> = members
            .map(|member| member.map(|(field, value)| (field, value.variant().unwrap())))
            .collect::<Result<_, _>>()
            .unwrap();
        let expected = [
            (0, Scalar::Int32(5).into()),
            (2, Scalar::SByte(-3).into()),
            (3, Variant::from(Scalar::Int32(6))),
        ];
        assert_eq!(members, expected);
        assert_eq!(write(&fields, values, dialect).unwrap(), payload);
    }
    let layout = RawLayout::new(&fields).unwrap();
    assert_eq!(layout.field_offset(1, Standard), Some(17));
    assert_eq!(layout.field_offset(1, Open62541), None);
}

#[test]
fn a_body_goes_from_raw_data_to_an_extension_object_and_back() {
    let type_a = type_a();
    let mut plain = vec![0xA5];
    type_a
        .to_plain(&TYPE_A_PADDED, Standard, &mut plain)
        .unwrap();
    assert_eq!(plain[1..], TYPE_A_PLAIN);
    let mut padded = Vec::new();
    type_a
        .from_plain(&TYPE_A_PLAIN, Standard, &mut padded)
        .unwrap();
    assert_eq!(padded, TYPE_A_PADDED);
    let cut = type_a.to_plain(&TYPE_A_PADDED[..16], Standard, &mut plain);
    assert!(matches!(cut, Err(RawWriteFault::Body(_))), "{cut:?}");
    assert_eq!(plain.len(), 14, "nothing was added");
}

#[test]
fn a_union_is_padded_to_its_biggest_field() {
    let two = [RawField::new(Int32), RawField::new(Int32)];
    let type2 =
        RawStructure::new(NodeId::numeric(1, 2), RawStructureType::Structure, &two).unwrap();
    let fields = [RawField::new(Int32), RawField::structure(&type2)];
    let type1 = RawStructure::new(NodeId::numeric(1, 1), RawStructureType::Union, &fields).unwrap();
    let layout = [RawField::structure(&type1), RawField::new(Byte)];
    for (payload, plain) in [
        ([0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9], 4),
        ([1, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 9], 8),
        ([2, 0, 0, 0, 7, 0, 0, 0, 8, 0, 0, 0, 9], 12),
    ] {
        let values = read(&layout, &payload, Standard).unwrap();
        let members = type1.members(body(&values[0]), Standard).unwrap();
        let members: Vec<_> = members.map(|member| member.unwrap().0).collect();
        assert_eq!(members, [&[][..], &[0], &[1]][usize::from(payload[0])]);
        assert_eq!(write(&layout, values, Standard).unwrap(), payload);
        let unpadded = [&payload[..plain], &[9]].concat();
        let values = read(&layout, &unpadded, Open62541).unwrap();
        assert_eq!(write(&layout, values, Open62541).unwrap(), unpadded);
    }
    let error = read(&layout, &[3; 13], Standard).unwrap_err();
    let expected = DecodeError::Reserved {
        field: "SwitchField",
        value: 0x0303_0303,
    };
    assert_eq!(error, expected);
}

#[test]
fn texts_inside_of_structures_are_padded_by_the_standard_and_not_by_open62541() {
    let inner = [RawField::new(Text).with_max_string_length(2)];
    let structure =
        RawStructure::new(NodeId::numeric(1, 1), RawStructureType::Structure, &inner).unwrap();
    let fields = [RawField::structure(&structure).with_dimensions(&[2])];
    let standard = [
        1, 0, 0, 0, // one of two
        1, 0, 0, 0, b'x', 0, //
        0, 0, 0, 0, 0, 0,
    ];
    let values = read(&fields, &standard, Standard).unwrap();
    let RawValue::Array(array) = values[0] else {
        panic!("{values:?}")
    };
    let bodies: Vec<_> = array
        .iter()
        .map(|element| body(&Variant::Scalar(element).into()))
        .collect();
    assert_eq!(bodies, [&standard[4..10]]);
    assert_eq!(write(&fields, values, Standard).unwrap(), standard);

    let open62541 = [2, 0, 0, 0, 1, 0, 0, 0, b'x', 3, 0, 0, 0, b'y', b'y', b'y'];
    let values = read(&fields, &open62541, Open62541).unwrap();
    assert_eq!(
        write(&fields, values.clone(), Open62541).unwrap(),
        open62541
    );
    let too_long = RawWriteFault::MaxStringLength { most: 2, len: 3 };
    assert_eq!(fault(write(&fields, values, Standard)), too_long);
}

#[test]
fn open62541_does_not_mind_maxima_inside_of_structures() {
    let inner = [RawField::new(Byte).with_dimensions(&[1])];
    let structure =
        RawStructure::new(NodeId::numeric(1, 1), RawStructureType::Structure, &inner).unwrap();
    let fields = [RawField::structure(&structure)];
    let payload = [2, 0, 0, 0, 7, 8];
    let values = read(&fields, &payload, Open62541).unwrap();
    assert_eq!(body(&values[0]), payload);
    assert_eq!(write(&fields, values, Open62541).unwrap(), payload);
    let error = read(&fields, &payload, Standard).unwrap_err();
    assert!(matches!(error, DecodeError::Limit { .. }), "{error}");
}

#[test]
fn arrays_of_texts_are_equal_by_elements_and_dimensions() {
    let text = RawField::new(Text).with_max_string_length(1);
    let one = [text.with_dimensions(&[1])];
    let read_one = |payload: &'static [u8]| read(&one, payload, Standard).unwrap()[0];
    let empty = read_one(&[0, 0, 0, 0, 0, 0, 0, 0, 0]);
    let null = read_one(&[0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0, 0]);
    let x = read_one(&[1, 0, 0, 0, 1, 0, 0, 0, b'x']);
    assert_eq!(x, x);
    assert_ne!(empty, null);
    assert_ne!(empty, x);
    let two = [text.with_dimensions(&[0, 0])];
    let row = [
        2, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
    ];
    let mut column = row;
    column.swap(4, 8);
    let row = read(&two, &row, Standard).unwrap();
    let column = read(&two, &column, Standard).unwrap();
    assert_ne!(row, column);
}

#[test]
fn an_array_of_extension_objects_is_written_as_bodies() {
    let inner = [RawField::new(UInt16)];
    let structure =
        RawStructure::new(NodeId::numeric(0, 7), RawStructureType::Structure, &inner).unwrap();
    let fields = [RawField::structure(&structure).with_dimensions(&[2])];
    let objects = [0, 7, 1, 2, 0, 0, 0, 5, 0, 0, 7, 1, 2, 0, 0, 0, 6, 0];
    let array = Array::new(BuiltinType::ExtensionObject, 2, &objects).unwrap();
    for dialect in DIALECTS {
        let written = write(&fields, [Variant::from(array)], dialect).unwrap();
        assert_eq!(written, [2, 0, 0, 0, 5, 0, 6, 0]);
    }
}

#[test]
fn a_heartbeat_has_no_values() {
    let fields = [RawField::new(Byte)];
    assert_eq!(read(&fields, &[], Standard), Ok(vec![]));
}

#[test]
fn zero_bytes_behind_the_fields_are_skipped_and_others_are_not() {
    let fields = [RawField::new(Byte)];
    assert_eq!(read(&fields, &[7, 0, 0], Standard).unwrap().len(), 1);
    let trailing = Err(DecodeError::TrailingBytes(2));
    assert_eq!(read(&fields, &[7, 0, 1], Standard), trailing);
}

#[test]
fn padding_that_is_not_zero_is_refused() {
    let type_a = type_a();
    let union = [RawField::new(Byte), RawField::new(UInt16)];
    let union = RawStructure::new(NodeId::numeric(1, 1), RawStructureType::Union, &union).unwrap();
    let mut optional = TYPE_A_PADDED;
    optional[9] = 1;
    for (field, payload) in [
        (
            RawField::new(Text).with_max_string_length(2),
            &[1, 0, 0, 0, b'x', 1][..],
        ),
        (
            RawField::new(Byte).with_dimensions(&[2]),
            &[1, 0, 0, 0, 7, 1],
        ),
        (RawField::structure(&type_a), &optional),
        (RawField::structure(&union), &[1, 0, 0, 0, 7, 1]),
    ] {
        let fields = [field];
        let expected = DecodeError::Reserved {
            field: "RawData padding",
            value: 1,
        };
        assert_eq!(read(&fields, payload, Standard), Err(expected));
    }
}

#[test]
fn lengths_above_their_maximum_are_refused() {
    let text = [RawField::new(Text).with_max_string_length(2)];
    let array = [RawField::new(Byte).with_dimensions(&[2])];
    let matrix = [RawField::new(Byte).with_dimensions(&[2, 2])];
    let limit = |field, value| Err(DecodeError::Limit { field, value });
    for dialect in DIALECTS {
        let payload = [3, 0, 0, 0, b'a', b'b', b'c'];
        assert_eq!(read(&text, &payload, dialect), limit("String", 3));
        assert_eq!(read(&array, &payload, dialect), limit("array length", 3));
    }
    let payload = [2, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0, 1, 2, 3, 4, 5, 6];
    assert_eq!(read(&matrix, &payload, Standard), limit("dimension", 3));
    let payload = &payload[4..];
    assert_eq!(read(&matrix, payload, Open62541), limit("dimension", 3));
}

#[test]
fn hostile_counts_are_held_against_the_bytes_that_are_left() {
    let limit = |value| {
        Err(DecodeError::Limit {
            field: "array length",
            value,
        })
    };
    let structure = type_a();
    let union = [RawField::new(Byte)];
    let union = RawStructure::new(NodeId::numeric(1, 1), RawStructureType::Union, &union).unwrap();
    let fields = [
        RawField::new(Byte).with_dimensions(&[0]),
        RawField::new(Text).with_dimensions(&[0]),
        RawField::structure(&structure).with_dimensions(&[0]),
        RawField::structure(&union).with_dimensions(&[0]),
    ];
    let huge = [0xFF, 0xFF, 0xFF, 0x7F, 0, 0];
    for field in fields {
        for dialect in DIALECTS {
            assert_eq!(read(&[field], &huge, dialect), limit(0x7FFF_FFFF));
        }
    }
    let matrix = [RawField::new(Byte).with_dimensions(&[0, 0, 0])];
    let mut huge = vec![3, 0, 0, 0];
    for _ in 0..3 {
        huge.extend([0xFF, 0xFF, 0xFF, 0x7F]);
    }
    assert_eq!(read(&matrix, &huge, Standard), limit(u32::MAX));
    assert_eq!(read(&matrix, &huge[4..], Open62541), limit(u32::MAX));
    huge[4..8].copy_from_slice(&[0xFE, 0xFF, 0xFF, 0xFF]);
    let negative = DecodeError::Reserved {
        field: "dimension",
        value: 0xFFFF_FFFE,
    };
    assert_eq!(read(&matrix, &huge, Standard), Err(negative));
}

#[test]
fn a_matrix_of_another_number_of_dimensions_is_refused() {
    let fields = [RawField::new(Byte).with_dimensions(&[1, 1])];
    let payload = [3, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 5];
    let expected = DecodeError::Reserved {
        field: "number of dimensions",
        value: 3,
    };
    assert_eq!(read(&fields, &payload, Standard), Err(expected));
}

#[test]
fn bits_of_an_encoding_mask_that_name_no_field_are_refused() {
    let type_a = type_a();
    let fields = [RawField::structure(&type_a)];
    let mut payload = TYPE_A_PADDED;
    payload[0] = 6;
    let expected = DecodeError::Reserved {
        field: "EncodingMask",
        value: 4,
    };
    assert_eq!(read(&fields, &payload, Standard), Err(expected));
}

#[test]
fn reading_ends_at_the_first_field_that_cannot_be_read() {
    let fields = [RawField::new(Text), RawField::new(Byte)];
    let layout = RawLayout::new(&fields).unwrap();
    let mut values = layout.read(&[1, 0, 0, 0, 0xFF, 7], Standard);
    assert_eq!(values.next(), Some(Err(DecodeError::Text("String"))));
    assert_eq!(values.next(), None);
}

#[test]
fn a_layout_names_the_field_raw_data_cannot_have() {
    let allowed = [
        Boolean,
        SByte,
        Byte,
        BuiltinType::Int16,
        UInt16,
        Int32,
        BuiltinType::UInt32,
        BuiltinType::Int64,
        BuiltinType::UInt64,
        Float,
        Double,
        Text,
        BuiltinType::DateTime,
        BuiltinType::Guid,
        ByteString,
        BuiltinType::StatusCode,
    ];
    for builtin in BuiltinType::ALL {
        let fields = [RawField::new(Byte), RawField::new(builtin)];
        let fault = RawLayout::new(&fields).err().map(|error| {
            assert_eq!(error.field, 1);
            error.fault
        });
        let expected = match builtin {
            BuiltinType::ExtensionObject => Some(RawLayoutFault::NoStructure),
            builtin if allowed.contains(&builtin) => None,
            builtin => Some(RawLayoutFault::Type(builtin)),
        };
        assert_eq!(fault, expected);
    }
    let fields = [RawField::new(BuiltinType::NodeId)];
    assert_eq!(
        RawLayout::new(&fields).unwrap_err().to_string(),
        "field 0: NodeId is not allowed in RawData"
    );
}

#[test]
fn a_layout_names_the_field_whose_metadata_do_not_fit_together() {
    let type_a = type_a();
    let rank = |value_rank| RawField {
        value_rank,
        ..RawField::new(Byte)
    };
    for (field, fault) in [
        (rank(0), RawLayoutFault::ValueRank(0)),
        (rank(-2), RawLayoutFault::ValueRank(-2)),
        (
            RawField {
                array_dimensions: &[1],
                ..RawField::new(Byte)
            },
            RawLayoutFault::ArrayDimensions {
                value_rank: -1,
                found: 1,
            },
        ),
        (
            RawField {
                array_dimensions: &[1],
                ..rank(2)
            },
            RawLayoutFault::ArrayDimensions {
                value_rank: 2,
                found: 1,
            },
        ),
        (
            RawField {
                structure: Some(&type_a),
                ..RawField::new(Byte)
            },
            RawLayoutFault::NotAStructure(Byte),
        ),
        (RawField::new(Byte).as_optional(), RawLayoutFault::Optional),
        (
            RawField::new(Text).with_max_string_length(0x7FFF_FFFC),
            RawLayoutFault::TooBig,
        ),
        (
            RawField::new(Byte).with_dimensions(&[0x1_0000, 0x1_0000]),
            RawLayoutFault::TooBig,
        ),
    ] {
        let error = RawLayout::new(&[RawField::new(Byte), field]).unwrap_err();
        assert_eq!((error.field, error.fault), (1, fault));
    }
    let half = RawField::new(Byte).with_dimensions(&[0x4000_0000]);
    let error = RawLayout::new(&[half, half]).unwrap_err();
    assert_eq!((error.field, error.fault), (1, RawLayoutFault::TooBig));
}

#[test]
fn a_structure_names_the_field_it_cannot_have() {
    let new = |structure_type, fields: &[RawField<'_>]| {
        RawStructure::new(NodeId::NULL, structure_type, fields)
            .map(|_| ())
            .map_err(|error| (error.field, error.fault))
    };
    let plain = RawStructureType::Structure;
    let optional = RawField::new(Byte).as_optional();
    let with_optional = RawStructureType::StructureWithOptionalFields;
    assert_eq!(new(plain, &[]), Err((0, RawLayoutFault::NoFields)));
    for structure_type in [plain, RawStructureType::Union] {
        let result = new(structure_type, &[RawField::new(Byte), optional]);
        assert_eq!(result, Err((1, RawLayoutFault::Optional)));
    }
    assert_eq!(new(with_optional, &[optional; 32]), Ok(()));
    let result = new(with_optional, &[optional; 33]);
    assert_eq!(result, Err((32, RawLayoutFault::Optional)));
}

#[test]
fn structures_are_nested_eight_deep_and_no_deeper() {
    fn nest(depth: usize) -> Result<&'static RawStructure<'static>, RawLayoutFault> {
        let field = match depth {
            1 => RawField::new(Byte),
            _ => RawField::structure(nest(depth - 1)?),
        };
        let fields = Box::leak(Box::new([field]));
        let structure = RawStructure::new(NodeId::NULL, RawStructureType::Structure, fields);
        match structure {
            Ok(structure) => Ok(Box::leak(Box::new(structure))),
            Err(error) => Err(error.fault),
        }
    }
    let deepest = [RawField::structure(nest(RawStructure::MAX_DEPTH).unwrap())];
    assert_eq!(body(&read(&deepest, &[7], Standard).unwrap()[0]), [7]);
    let deeper = nest(RawStructure::MAX_DEPTH + 1).err();
    assert_eq!(deeper, Some(RawLayoutFault::TooDeep));
}

#[test]
fn a_value_of_another_type_is_refused_by_name_and_place() {
    let fields = [RawField::new(Int32), RawField::new(Double)];
    let layout = RawLayout::new(&fields).unwrap();
    let mut payload = vec![0xA5];
    for (value, found) in [
        (Variant::Null, None),
        (Scalar::Float(1.0).into(), Some(Float)),
        (Array::null(Float).into(), Some(Float)),
    ] {
        let values = [Scalar::Int32(1).into(), value];
        let error = layout.write(&mut payload, Standard, values).unwrap_err();
        assert_eq!(error.field, 1);
        let expected = RawWriteFault::Type {
            expected: Double,
            found,
        };
        assert_eq!(error.fault, expected);
        assert_eq!(payload, [0xA5], "nothing was added");
    }
    let null = layout.write(&mut payload, Standard, [Variant::Null]);
    assert_eq!(
        null.unwrap_err().to_string(),
        "field 0: null where Int32 is expected"
    );
}

#[test]
fn a_value_of_another_number_of_dimensions_is_refused() {
    let array: Variant<'_> = Array::new(Byte, 1, &[1]).unwrap().into();
    let matrix = Array::new(Byte, 1, &[1]).unwrap();
    let matrix: Variant<'_> = Matrix::new(matrix, &[[1, 0, 0, 0]; 2]).unwrap().into();
    let scalar = RawField::new(Byte);
    let one = scalar.with_dimensions(&[1]);
    let two = scalar.with_dimensions(&[1, 1]);
    for (field, value, expected, found) in [
        (scalar, array, -1, 1),
        (one, Scalar::Byte(1).into(), 1, -1),
        (one, matrix, 1, 2),
        (two, array, 2, 1),
    ] {
        let expected = RawWriteFault::ValueRank { expected, found };
        assert_eq!(fault(write(&[field], [value], Standard)), expected);
    }
}

#[test]
fn as_many_values_as_fields_are_written() {
    let fields = [RawField::new(Byte), RawField::new(Byte)];
    let byte = Variant::from(Scalar::Byte(1));
    let missing = write(&fields, [byte], Standard).unwrap_err();
    assert_eq!((missing.field, missing.fault), (1, RawWriteFault::NoValue));
    let surplus = write(&fields, [byte; 3], Standard).unwrap_err();
    assert_eq!((surplus.field, surplus.fault), (2, RawWriteFault::NoField));
}

#[test]
fn what_is_longer_than_its_field_is_refused_and_not_cut() {
    let text = [RawField::new(Text).with_max_string_length(2)];
    let array = [RawField::new(Byte).with_dimensions(&[2])];
    let three = Array::new(Byte, 3, &[1, 2, 3]).unwrap();
    for dialect in DIALECTS {
        let written = write(&text, [Variant::from(Scalar::String(Some("abc")))], dialect);
        let expected = RawWriteFault::MaxStringLength { most: 2, len: 3 };
        assert_eq!(fault(written), expected);
        let written = write(&array, [Variant::from(three)], dialect);
        let expected = RawWriteFault::ArrayDimensions {
            expected: 2,
            len: 3,
        };
        assert_eq!(fault(written), expected);
    }
}

#[test]
fn only_the_structure_of_the_field_is_written() {
    let type_a = type_a();
    let fields = [RawField::structure(&type_a)];
    let written = write(&fields, [object(&type_a, &TYPE_A_PADDED)], Standard);
    assert_eq!(written.unwrap(), TYPE_A_PADDED);
    let bare =
        |type_id, body| Variant::Scalar(Scalar::ExtensionObject(ExtensionObject { type_id, body }));
    let other = bare(NodeId::numeric(1, 9), ExtensionBody::Binary(&TYPE_A_PADDED));
    let none = bare(type_a.type_id(), ExtensionBody::None);
    let longer = [&TYPE_A_PADDED[..], &[0]].concat();
    for (value, expected) in [
        (other, RawWriteFault::StructureType),
        (none, RawWriteFault::NoBody),
        (
            object(&type_a, &longer),
            RawWriteFault::Body(DecodeError::TrailingBytes(1)),
        ),
    ] {
        assert_eq!(fault(write(&fields, [value], Standard)), expected);
    }
}

#[test]
fn a_field_of_a_fixed_layout_is_patched_at_its_offset() {
    let fields = [
        RawField::new(Text).with_max_string_length(5),
        RawField::new(Int32).with_dimensions(&[2]),
        RawField::new(Double),
    ];
    let layout = RawLayout::new(&fields).unwrap();
    let numbers = Array::new(Int32, 2, &[0; 8]).unwrap();
    let values: [Variant<'_>; 3] = [
        Scalar::String(Some("ab")).into(),
        numbers.into(),
        Scalar::Double(0.0).into(),
    ];
    for dialect in DIALECTS {
        let mut payload = write(&fields, values, dialect).unwrap();
        assert_eq!(layout.fixed_size(dialect), Some(payload.len()));
        let at = layout.field_offset(2, dialect).unwrap();
        payload[at..at + 8].copy_from_slice(&2.5_f64.to_le_bytes());
        let read = read(&fields, &payload, dialect).unwrap();
        assert_eq!(
            read[2].variant(),
            Some(Variant::Scalar(Scalar::Double(2.5)))
        );
    }
}

#[test]
fn reading_and_writing_into_a_used_buffer_allocate_nothing() {
    let type_a = type_a();
    let fields = [
        RawField::new(Double),
        RawField::new(Text).with_max_string_length(8),
        RawField::new(Byte).with_dimensions(&[2, 2]),
        RawField::structure(&type_a).with_dimensions(&[2]),
    ];
    let layout = RawLayout::new(&fields).unwrap();
    let mut payload = 1.5_f64.to_le_bytes().to_vec();
    payload.extend([2, 0, 0, 0, b'h', b'i', 0, 0, 0, 0, 0, 0]);
    payload.extend([2, 0, 0, 0, 2, 0, 0, 0, 2, 0, 0, 0, 1, 2, 3, 4]);
    payload.extend([2, 0, 0, 0]);
    payload.extend(TYPE_A_PADDED);
    payload.extend(TYPE_A_PADDED);
    let mut written = Vec::with_capacity(payload.len());
    let mut elements = 0;
    let allocations = measure(|| {
        RawLayout::new(&fields).unwrap();
        for value in layout.read(&payload, Standard) {
            elements += match value.unwrap() {
                RawValue::Array(array) => array.iter().count(),
                RawValue::Variant(_) => 1,
            };
        }
        for len in 1..payload.len() {
            let mut cut = layout.read(&payload[..len], Standard);
            assert!(cut.any(|value| value.is_err()), "{len} bytes");
        }
        let values = layout.read(&payload, Standard).map(Result::unwrap);
        layout.write(&mut written, Standard, values).unwrap();
    });
    assert_eq!(elements, 5);
    assert_eq!(written, payload);
    assert_eq!(allocations.count_total, 0);
}
