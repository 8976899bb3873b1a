//! Encodes a datagram again from its decoded content only.

use uadp::{
    DataSetMessage, DecodeError, Extras, FieldEncoder, FieldEncoding, Fields, MessageKind,
    NetworkMessage, NetworkMessageEncoder, Variant,
};

/// Writes the fields of a key frame or event.
pub(crate) type WriteFields = fn(&mut FieldEncoder<'_>, Fields<'_>);

pub(crate) fn rewrite(datagram: &[u8], fields: WriteFields) -> Result<Vec<u8>, DecodeError> {
    let network = NetworkMessage::decode(datagram)?;
    let writer_ids: Option<Vec<u16>> = network.writer_ids().map(Iterator::collect);
    let promoted = network.promoted_fields();
    let promoted: Option<Vec<_>> = promoted.map(Iterator::collect).transpose()?;
    let extras = Extras {
        promoted_fields: promoted.as_deref(),
        security: network.security(),
    };
    // The offset in the buffer is not 0, because all positions have to be relative.
    let mut out = vec![0xAA; 3];
    let ids = writer_ids.as_deref();
    let mut encoder =
        NetworkMessageEncoder::with(&mut out, &network.header(), ids, &extras).unwrap();
    for message in network.messages() {
        rewrite_message(&message?, &mut encoder, fields)?;
    }
    encoder.finish_with_footer(network.footer()).unwrap();
    Ok(out.split_off(3))
}

pub(crate) fn rewrite_message(
    message: &DataSetMessage<'_>,
    encoder: &mut NetworkMessageEncoder<'_>,
    fields: WriteFields,
) -> Result<(), DecodeError> {
    let header = &message.header();
    match (message.kind, message.encoding()) {
        (MessageKind::KeepAlive, _) => encoder.keep_alive(header).unwrap(),
        (MessageKind::KeyFrame, FieldEncoding::Variant) if message.payload().is_empty() => {
            encoder.heartbeat(header).unwrap();
        }
        (MessageKind::KeyFrame, FieldEncoding::Variant) => {
            let mut frame = encoder.key_frame(header).unwrap();
            fields(&mut frame, message.fields()?);
            frame.finish().unwrap();
        }
        (MessageKind::Event, FieldEncoding::Variant) => {
            let mut event = encoder.event(header).unwrap();
            fields(&mut event, message.fields()?);
            event.finish().unwrap();
        }
        (MessageKind::DeltaFrame, FieldEncoding::Variant) => {
            let mut delta = encoder.delta_frame(header).unwrap();
            for field in message.values()? {
                let field = field?;
                let value = field.value.value.unwrap_or(Variant::Null);
                delta.field(field.index).unwrap().variant(&value).unwrap();
            }
            delta.finish().unwrap();
        }
        (MessageKind::KeyFrame, FieldEncoding::DataValue) => {
            let mut frame = encoder.data_values(header).unwrap();
            for field in message.values()? {
                frame.value(&field?.value).unwrap();
            }
            frame.finish().unwrap();
        }
        (MessageKind::DeltaFrame, FieldEncoding::DataValue) => {
            let mut delta = encoder.delta_data_values(header).unwrap();
            for field in message.values()? {
                let field = field?;
                delta.changed(field.index, &field.value).unwrap();
            }
            delta.finish().unwrap();
        }
        (MessageKind::KeyFrame, FieldEncoding::RawData) => {
            let copy = |out: &mut Vec<u8>| {
                out.extend_from_slice(message.payload());
                Ok(())
            };
            encoder.raw_key_frame(header, copy).unwrap();
        }
        (MessageKind::DeltaFrame, FieldEncoding::RawData)
        | (MessageKind::Event, FieldEncoding::RawData | FieldEncoding::DataValue) => {
            unreachable!("the standard has no such message")
        }
    }
    Ok(())
}
