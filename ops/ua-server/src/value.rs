//! Conversion of values between the two codecs: the borrowed Variants of UADP and the owned
//! Variants of the OPC UA server.
//!
//! A received null array becomes an empty array, because the type of the server cannot express
//! null. Sent values are encoded unchanged (OPC 10000-6, 5.2.2.16). A Variant directly in a Variant
//! is refused, because UADP cannot carry it.

use opcua::types::type_loader::{ByteStringBody, XmlBody};
use opcua::types::{
    Array, BinaryEncodable as _, ByteString, ContextOwned, DataValue, DateTime, DiagnosticInfo,
    ExpandedNodeId, ExtensionObject, Guid, Identifier, LocalizedText, NodeId, QualifiedName,
    StatusCode, UAString, Variant, VariantScalarTypeId, XmlElement,
};
use uadp::{BuiltinType, ExtensionBody, Scalar};

/// Converts the value of a field into a Variant of the server.
pub(crate) fn from_field(field: &uadp::Variant<'_>) -> Variant {
    match field {
        uadp::Variant::Null => Variant::Empty,
        uadp::Variant::Scalar(value) => scalar(value),
        uadp::Variant::Array(array) => Variant::Array(Box::new(Array {
            value_type: scalar_type(array.element()),
            values: array.iter().map(|element| scalar(&element)).collect(),
            dimensions: None,
        })),
        uadp::Variant::Matrix(matrix) => Variant::Array(Box::new(Array {
            value_type: scalar_type(matrix.elements().element()),
            values: matrix
                .elements()
                .iter()
                .map(|element| scalar(&element))
                .collect(),
            dimensions: Some(matrix.dimensions().collect()),
        })),
    }
}

/// Encodes the fields of a DataSet as a key frame carries them: their number (UInt16), then a
/// Variant for each field.
///
/// # Errors
/// Returns `BadNotSupported` for a value that UADP does not carry, and `BadOutOfRange` for more
/// than 65535 fields.
pub(crate) fn fields_block(fields: &[Variant]) -> Result<Vec<u8>, StatusCode> {
    let count = u16::try_from(fields.len()).map_err(|_| StatusCode::BadOutOfRange)?;
    let context = ContextOwned::default();
    let context = context.context();
    let mut block = Vec::from(count.to_le_bytes());
    for field in fields {
        field
            .encode(&mut block, &context)
            .map_err(|_| StatusCode::BadNotSupported)?;
    }
    let readable = uadp::Fields::parse(&block)
        .is_ok_and(|mut parsed| parsed.len() == fields.len() && parsed.all(|field| field.is_ok()));
    if readable {
        Ok(block)
    } else {
        Err(StatusCode::BadNotSupported)
    }
}

/// Returns the value of a field that was never set: zero, empty, or null if the type has a null
/// value.
pub(crate) fn zero(shape: Option<(BuiltinType, bool)>) -> Variant {
    let Some((builtin, array)) = shape else {
        return Variant::Empty;
    };
    if array {
        return Variant::Array(Box::new(Array {
            value_type: scalar_type(builtin),
            values: Vec::new(),
            dimensions: None,
        }));
    }
    match builtin {
        BuiltinType::Boolean => Variant::Boolean(false),
        BuiltinType::SByte => Variant::SByte(0),
        BuiltinType::Byte => Variant::Byte(0),
        BuiltinType::Int16 => Variant::Int16(0),
        BuiltinType::UInt16 => Variant::UInt16(0),
        BuiltinType::Int32 => Variant::Int32(0),
        BuiltinType::UInt32 => Variant::UInt32(0),
        BuiltinType::Int64 => Variant::Int64(0),
        BuiltinType::UInt64 => Variant::UInt64(0),
        BuiltinType::Float => Variant::Float(0.0),
        BuiltinType::Double => Variant::Double(0.0),
        BuiltinType::String => Variant::String(UAString::from("")),
        BuiltinType::DateTime => Variant::from(DateTime::null()),
        BuiltinType::Guid => Variant::from(Guid::null()),
        BuiltinType::ByteString => Variant::ByteString(ByteString::from(Vec::new())),
        BuiltinType::XmlElement => Variant::XmlElement(XmlElement::from("")),
        BuiltinType::NodeId => Variant::from(NodeId::null()),
        BuiltinType::ExpandedNodeId => Variant::from(ExpandedNodeId::null()),
        BuiltinType::StatusCode => Variant::StatusCode(StatusCode::Good),
        BuiltinType::QualifiedName => Variant::from(QualifiedName::null()),
        BuiltinType::LocalizedText => Variant::from(LocalizedText::null()),
        BuiltinType::ExtensionObject => Variant::ExtensionObject(ExtensionObject::null()),
        BuiltinType::DataValue | BuiltinType::Variant | BuiltinType::DiagnosticInfo => {
            Variant::Empty
        }
    }
}

pub(crate) fn date_time(time: uadp::DateTime) -> DateTime {
    DateTime::from(time.0)
}

pub(crate) fn ticks(time: DateTime) -> uadp::DateTime {
    uadp::DateTime(time.checked_ticks())
}

fn scalar(value: &Scalar<'_>) -> Variant {
    match *value {
        Scalar::Boolean(v) => Variant::Boolean(v),
        Scalar::SByte(v) => Variant::SByte(v),
        Scalar::Byte(v) => Variant::Byte(v),
        Scalar::Int16(v) => Variant::Int16(v),
        Scalar::UInt16(v) => Variant::UInt16(v),
        Scalar::Int32(v) => Variant::Int32(v),
        Scalar::UInt32(v) => Variant::UInt32(v),
        Scalar::Int64(v) => Variant::Int64(v),
        Scalar::UInt64(v) => Variant::UInt64(v),
        Scalar::Float(v) => Variant::Float(v),
        Scalar::Double(v) => Variant::Double(v),
        Scalar::String(v) => Variant::String(string(v)),
        Scalar::DateTime(v) => Variant::from(date_time(v)),
        Scalar::Guid(v) => Variant::from(guid(v)),
        Scalar::ByteString(v) => Variant::ByteString(byte_string(v)),
        Scalar::XmlElement(v) => Variant::XmlElement(XmlElement::from(string(v))),
        Scalar::NodeId(v) => Variant::from(node_id(v)),
        Scalar::ExpandedNodeId(v) => Variant::from(ExpandedNodeId {
            node_id: node_id(v.node_id),
            namespace_uri: string(v.namespace_uri),
            server_index: v.server_index,
        }),
        Scalar::StatusCode(v) => Variant::StatusCode(StatusCode::from(v.0)),
        Scalar::QualifiedName(v) => Variant::from(QualifiedName {
            namespace_index: v.namespace,
            name: string(v.name),
        }),
        Scalar::LocalizedText(v) => Variant::from(LocalizedText {
            locale: string(v.locale),
            text: string(v.text),
        }),
        Scalar::ExtensionObject(v) => Variant::ExtensionObject(extension_object(v)),
        // Nested values were validated with the message, so reading them cannot fail.
        Scalar::Variant(v) => {
            let inner = v.get().unwrap_or(uadp::Variant::Null);
            Variant::Variant(Box::new(from_field(&inner)))
        }
        Scalar::DataValue(v) => {
            Variant::DataValue(Box::new(data_value(&v.get().unwrap_or_default())))
        }
        Scalar::DiagnosticInfo(v) => {
            Variant::DiagnosticInfo(Box::new(diagnostic_info(&v.get().unwrap_or_default())))
        }
    }
}

fn data_value(value: &uadp::DataValue<'_>) -> DataValue {
    DataValue {
        value: value.value.as_ref().map(from_field),
        status: value.status.map(|status| StatusCode::from(status.0)),
        source_timestamp: value.source_timestamp.map(date_time),
        source_picoseconds: value.source_picoseconds,
        server_timestamp: value.server_timestamp.map(date_time),
        server_picoseconds: value.server_picoseconds,
    }
}

fn diagnostic_info(info: &uadp::DiagnosticInfo<'_>) -> DiagnosticInfo {
    DiagnosticInfo {
        symbolic_id: info.symbolic_id,
        namespace_uri: info.namespace_uri,
        locale: info.locale,
        localized_text: info.localized_text,
        additional_info: info.additional_info.map(string),
        inner_status_code: info
            .inner_status_code
            .map(|status| StatusCode::from(status.0)),
        inner_diagnostic_info: info
            .inner
            .and_then(|inner| inner.get().ok())
            .map(|inner| Box::new(diagnostic_info(&inner))),
    }
}

fn extension_object(object: uadp::ExtensionObject<'_>) -> ExtensionObject {
    let type_id = node_id(object.type_id);
    match object.body {
        // The type of the server cannot express a type id without a body.
        ExtensionBody::None => ExtensionObject::null(),
        ExtensionBody::Binary(bytes) => ExtensionObject::new(ByteStringBody::new(
            ByteString::from(bytes.to_vec()),
            type_id,
        )),
        ExtensionBody::Xml(text) => ExtensionObject::new(XmlBody::new(
            text.as_bytes().to_vec(),
            type_id,
            "XmlElement".to_owned(),
        )),
    }
}

fn node_id(node: uadp::NodeId<'_>) -> NodeId {
    let identifier = match node.identifier {
        uadp::NodeIdValue::Numeric(number) => Identifier::Numeric(number),
        uadp::NodeIdValue::String(text) => Identifier::String(string(text)),
        uadp::NodeIdValue::Guid(value) => Identifier::Guid(guid(value)),
        uadp::NodeIdValue::Opaque(bytes) => Identifier::ByteString(byte_string(bytes)),
    };
    NodeId {
        namespace: node.namespace,
        identifier,
    }
}

fn guid(value: uadp::Guid) -> Guid {
    // The text form is used, because the type of the server cannot be created from bytes.
    value.to_string().parse().unwrap_or_default()
}

fn string(text: Option<&str>) -> UAString {
    text.map_or_else(UAString::null, UAString::from)
}

fn byte_string(bytes: Option<&[u8]>) -> ByteString {
    bytes.map_or_else(ByteString::null, |bytes| ByteString::from(bytes.to_vec()))
}

fn scalar_type(builtin: BuiltinType) -> VariantScalarTypeId {
    match builtin {
        BuiltinType::Boolean => VariantScalarTypeId::Boolean,
        BuiltinType::SByte => VariantScalarTypeId::SByte,
        BuiltinType::Byte => VariantScalarTypeId::Byte,
        BuiltinType::Int16 => VariantScalarTypeId::Int16,
        BuiltinType::UInt16 => VariantScalarTypeId::UInt16,
        BuiltinType::Int32 => VariantScalarTypeId::Int32,
        BuiltinType::UInt32 => VariantScalarTypeId::UInt32,
        BuiltinType::Int64 => VariantScalarTypeId::Int64,
        BuiltinType::UInt64 => VariantScalarTypeId::UInt64,
        BuiltinType::Float => VariantScalarTypeId::Float,
        BuiltinType::Double => VariantScalarTypeId::Double,
        BuiltinType::String => VariantScalarTypeId::String,
        BuiltinType::DateTime => VariantScalarTypeId::DateTime,
        BuiltinType::Guid => VariantScalarTypeId::Guid,
        BuiltinType::ByteString => VariantScalarTypeId::ByteString,
        BuiltinType::XmlElement => VariantScalarTypeId::XmlElement,
        BuiltinType::NodeId => VariantScalarTypeId::NodeId,
        BuiltinType::ExpandedNodeId => VariantScalarTypeId::ExpandedNodeId,
        BuiltinType::StatusCode => VariantScalarTypeId::StatusCode,
        BuiltinType::QualifiedName => VariantScalarTypeId::QualifiedName,
        BuiltinType::LocalizedText => VariantScalarTypeId::LocalizedText,
        BuiltinType::ExtensionObject => VariantScalarTypeId::ExtensionObject,
        BuiltinType::DataValue => VariantScalarTypeId::DataValue,
        BuiltinType::Variant => VariantScalarTypeId::Variant,
        BuiltinType::DiagnosticInfo => VariantScalarTypeId::DiagnosticInfo,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a value of every builtin type that a field can have, in both forms.
    #[expect(
        clippy::too_many_lines,
        reason = "one entry for each of the builtin types"
    )]
    fn samples() -> Vec<(Scalar<'static>, Variant)> {
        let guid_bytes = [
            0x91, 0x2B, 0x96, 0x72, 0x75, 0xFA, 0xE6, 0x4A, 0x8D, 0x28, 0xB4, 0x04, 0xDC, 0x7D,
            0xAF, 0x63,
        ];
        let guid_text: Guid = "72962b91-fa75-4ae6-8d28-b404dc7daf63".parse().unwrap();
        let body = ByteStringBody::new(ByteString::from(vec![1, 2, 3]), NodeId::new(5, 77));
        vec![
            (Scalar::Boolean(true), Variant::Boolean(true)),
            (Scalar::SByte(-7), Variant::SByte(-7)),
            (Scalar::Byte(200), Variant::Byte(200)),
            (Scalar::Int16(-300), Variant::Int16(-300)),
            (Scalar::UInt16(60_000), Variant::UInt16(60_000)),
            (Scalar::Int32(-70_000), Variant::Int32(-70_000)),
            (
                Scalar::UInt32(4_000_000_000),
                Variant::UInt32(4_000_000_000),
            ),
            (Scalar::Int64(i64::MIN), Variant::Int64(i64::MIN)),
            (Scalar::UInt64(u64::MAX), Variant::UInt64(u64::MAX)),
            (Scalar::Float(1.5), Variant::Float(1.5)),
            (Scalar::Double(-2.25), Variant::Double(-2.25)),
            (Scalar::String(Some("grün")), Variant::from("grün")),
            (
                Scalar::DateTime(uadp::DateTime(134_234_948_967_890_123)),
                Variant::from(DateTime::from(134_234_948_967_890_123i64)),
            ),
            (
                Scalar::Guid(uadp::Guid(guid_bytes)),
                Variant::from(guid_text.clone()),
            ),
            (
                Scalar::ByteString(Some(&[0, 255])),
                Variant::ByteString(ByteString::from(vec![0, 255])),
            ),
            (
                Scalar::XmlElement(Some("<a/>")),
                Variant::XmlElement(XmlElement::from("<a/>")),
            ),
            (
                Scalar::NodeId(uadp::NodeId::string(3, "pump")),
                Variant::from(NodeId::new(3, "pump")),
            ),
            (
                Scalar::ExpandedNodeId(uadp::ExpandedNodeId {
                    node_id: uadp::NodeId {
                        namespace: 0,
                        identifier: uadp::NodeIdValue::Guid(uadp::Guid(guid_bytes)),
                    },
                    namespace_uri: Some("urn:x"),
                    server_index: 2,
                }),
                Variant::from(ExpandedNodeId {
                    node_id: NodeId::new(0, guid_text),
                    namespace_uri: UAString::from("urn:x"),
                    server_index: 2,
                }),
            ),
            (
                Scalar::StatusCode(uadp::StatusCode(0x8034_0000)),
                Variant::StatusCode(StatusCode::BadNodeIdUnknown),
            ),
            (
                Scalar::QualifiedName(uadp::QualifiedName {
                    namespace: 4,
                    name: Some("q"),
                }),
                Variant::from(QualifiedName::new(4, "q")),
            ),
            (
                Scalar::LocalizedText(uadp::LocalizedText {
                    locale: Some("de"),
                    text: Some("ein"),
                }),
                Variant::from(LocalizedText::new("de", "ein")),
            ),
            (
                Scalar::ExtensionObject(uadp::ExtensionObject {
                    type_id: uadp::NodeId::numeric(5, 77),
                    body: ExtensionBody::Binary(&[1, 2, 3]),
                }),
                Variant::ExtensionObject(ExtensionObject::new(body)),
            ),
        ]
    }

    fn only_field(block: &[u8]) -> uadp::Variant<'_> {
        let mut fields = uadp::Fields::parse(block).unwrap();
        let field = fields.next().unwrap().unwrap();
        assert!(fields.next().is_none());
        field
    }

    #[test]
    fn a_value_of_every_builtin_type_is_the_same_on_both_sides() {
        let samples = samples();
        for (wire, server) in &samples {
            assert_eq!(from_field(&uadp::Variant::Scalar(*wire)), *server);
            let block = fields_block(std::slice::from_ref(server)).unwrap();
            assert_eq!(only_field(&block), uadp::Variant::Scalar(*wire));
        }
        let types: Vec<u8> = samples
            .iter()
            .map(|(wire, _)| wire.builtin_type().id())
            .collect();
        assert_eq!(
            types,
            (1..=22).collect::<Vec<u8>>(),
            "a type without a sample"
        );
    }

    #[test]
    fn an_array_of_every_builtin_type_is_the_same_on_both_sides() {
        for (wire, server) in samples() {
            let array = Variant::Array(Box::new(Array {
                value_type: scalar_type(wire.builtin_type()),
                values: vec![server.clone(), server],
                dimensions: None,
            }));
            let block = fields_block(std::slice::from_ref(&array)).unwrap();
            let field = only_field(&block);
            let uadp::Variant::Array(elements) = field else {
                panic!("{wire:?} became {field:?}");
            };
            assert_eq!(elements.iter().collect::<Vec<_>>(), [wire, wire]);
            assert_eq!(from_field(&field), array);
        }
    }

    #[test]
    fn null_strings_stay_null_and_empty_ones_empty() {
        for text in [None, Some("")] {
            let wire = uadp::Variant::Scalar(Scalar::String(text));
            let block = fields_block(&[from_field(&wire)]).unwrap();
            assert_eq!(only_field(&block), wire);
        }
    }

    #[test]
    fn a_matrix_keeps_its_dimensions_both_ways() {
        let values = (0..6).map(Variant::Int32).collect::<Vec<_>>();
        let matrix = Array::new_multi(VariantScalarTypeId::Int32, values, vec![2, 3]).unwrap();
        let matrix = Variant::Array(Box::new(matrix));
        let block = fields_block(std::slice::from_ref(&matrix)).unwrap();
        let field = only_field(&block);
        let uadp::Variant::Matrix(found) = field else {
            panic!("{field:?} is no matrix");
        };
        assert_eq!(found.dimensions().collect::<Vec<_>>(), [2, 3]);
        assert_eq!(from_field(&field), matrix);
    }

    #[test]
    fn values_in_values_are_the_same_on_both_sides() {
        let info = DiagnosticInfo {
            symbolic_id: Some(3),
            inner_diagnostic_info: Some(Box::new(DiagnosticInfo {
                additional_info: Some(UAString::from("below")),
                ..DiagnosticInfo::null()
            })),
            ..DiagnosticInfo::null()
        };
        let value = DataValue {
            value: Some(Variant::Double(1.5)),
            status: Some(StatusCode::BadNoCommunication),
            source_timestamp: Some(date_time(uadp::DateTime(134_234_948_967_890_000))),
            ..DataValue::null()
        };
        let variants = Array::new(
            VariantScalarTypeId::Variant,
            vec![Variant::Variant(Box::new(Variant::Boolean(true)))],
        );
        for server in [
            Variant::DiagnosticInfo(Box::new(info)),
            Variant::DataValue(Box::new(value)),
            Variant::Array(Box::new(variants.unwrap())),
        ] {
            let block = fields_block(std::slice::from_ref(&server)).unwrap();
            assert_eq!(from_field(&only_field(&block)), server);
        }
    }

    #[test]
    fn the_zero_of_every_shape_fits_the_shape_and_goes_out() {
        use crate::layout::VariableShape;
        for builtin in BuiltinType::ALL.into_iter().take(22) {
            for array in [false, true] {
                let value = zero(Some((builtin, array)));
                assert!(
                    VariableShape(Some((builtin, array))).accepts(&value),
                    "{builtin} {array}"
                );
                assert!(fields_block(&[value]).is_ok(), "{builtin} {array}");
            }
        }
    }
}
