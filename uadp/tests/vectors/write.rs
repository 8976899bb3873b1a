//! Three ways of encoding decoded fields, which have to result in the same bytes.

use uadp::{
    Array, BuiltinType, ExtensionBody, ExtensionObject, FieldEncoder, Fields, Matrix, Nested,
    NodeId, Scalar, Variant,
};

pub(crate) fn by_variant(encoder: &mut FieldEncoder<'_>, fields: Fields<'_>) {
    for field in fields {
        encoder.variant(&field.unwrap()).unwrap();
    }
}

pub(crate) fn by_block(encoder: &mut FieldEncoder<'_>, fields: Fields<'_>) {
    assert_eq!(fields.checked_bytes().unwrap(), fields.bytes());
    encoder.fields_block(fields.bytes()).unwrap();
}

pub(crate) fn by_parts(encoder: &mut FieldEncoder<'_>, fields: Fields<'_>) {
    for field in fields {
        match field.unwrap() {
            Variant::Null => encoder.null().unwrap(),
            Variant::Scalar(Scalar::ExtensionObject(ExtensionObject {
                type_id,
                body: ExtensionBody::Binary(body),
            })) => write_structure(encoder, type_id, body),
            Variant::Scalar(scalar) => encoder.scalar(scalar).unwrap(),
            Variant::Array(array) if array.is_null() => {
                encoder.variant(&Variant::Array(array)).unwrap();
            }
            Variant::Array(array) if array.element().fixed_size().is_some() => {
                encoder
                    .packed_array(array.element(), array.len(), array.bytes())
                    .unwrap();
            }
            Variant::Array(array) => write_elements(encoder, array),
            Variant::Matrix(matrix) => {
                let sizes: Vec<_> = matrix.dimensions().map(u32::to_le_bytes).collect();
                let matrix = Matrix::new(matrix.elements(), &sizes).unwrap();
                encoder.variant(&Variant::Matrix(matrix)).unwrap();
            }
        }
    }
}

fn write_elements(encoder: &mut FieldEncoder<'_>, array: Array<'_>) {
    if array.element() == BuiltinType::ExtensionObject {
        encoder.structures(array.len()).unwrap();
    } else {
        encoder.array(array.element(), array.len()).unwrap();
    }
    for element in array {
        match element {
            Scalar::ExtensionObject(ExtensionObject {
                type_id,
                body: ExtensionBody::Binary(body),
            }) => write_structure(encoder, type_id, body),
            Scalar::Variant(value) => {
                let mut buffer = Vec::new();
                let value = Nested::variant(&value.get().unwrap(), &mut buffer).unwrap();
                encoder.element(Scalar::Variant(value)).unwrap();
            }
            other => encoder.element(other).unwrap(),
        }
    }
}

fn write_structure(encoder: &mut FieldEncoder<'_>, type_id: NodeId<'_>, body: &[u8]) {
    encoder.begin_structure(type_id).unwrap();
    for byte in body {
        encoder.scalar(Scalar::Byte(*byte)).unwrap();
    }
    encoder.end_structure().unwrap();
}
