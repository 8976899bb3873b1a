//! Writing a datagram that was read, in three ways that have to come to the same bytes.

use uadp::{
    Array, BuiltinType, DecodeError, ExtensionBody, ExtensionObject, FieldEncoder, Fields,
    MessageKind, NetworkMessage, NetworkMessageEncoder, NodeId, Scalar, Variant,
};

pub(crate) type WriteFields = fn(&mut FieldEncoder<'_>, Fields<'_>);

pub(crate) fn rewrite(datagram: &[u8], fields: WriteFields) -> Result<Vec<u8>, DecodeError> {
    let message = NetworkMessage::decode(datagram)?;
    let writer_ids: Option<Vec<u16>> = message.writer_ids().map(Iterator::collect);
    // Not from the start of the buffer: every position in it is relative.
    let mut out = vec![0xAA; 3];
    let mut encoder =
        NetworkMessageEncoder::new(&mut out, message.header(), writer_ids.as_deref()).unwrap();
    for data_set_message in message.messages() {
        let data_set_message = data_set_message?;
        if data_set_message.kind == MessageKind::KeepAlive {
            encoder.keep_alive(&data_set_message.header).unwrap();
            continue;
        }
        let mut field_encoder = encoder.key_frame(&data_set_message.header).unwrap();
        fields(&mut field_encoder, data_set_message.fields()?);
        field_encoder.finish().unwrap();
    }
    encoder.finish().unwrap();
    Ok(out.split_off(3))
}

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
