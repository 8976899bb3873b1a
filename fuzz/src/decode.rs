//! Fuzzes the decoder with arbitrary bytes as a datagram.

use uadp::{
    Array, DataSetMessage, DataValue, DiagnosticInfo, Extras, FieldEncoding, MessageKind,
    NetworkMessage, NetworkMessageEncoder, Scalar, Variant,
};

/// Decodes all parts of a datagram. A datagram that is decoded completely is encoded again and must
/// decode to the same message.
pub fn decode(datagram: &[u8]) {
    let Ok(network) = NetworkMessage::decode(datagram) else {
        return;
    };
    let header = network.header();
    assert_eq!(header.publisher_id, network.publisher_id());
    assert_eq!(header.group, network.group());
    assert!(network.payload_offset() + network.payload().len() <= datagram.len());
    let _ = network.chunk();
    let _ = network.data_set_message_at(network.payload_offset(), 4);
    if network
        .messages()
        .all(|message| message.is_ok_and(|message| is_readable(&message)))
        && let Some(written) = write(&network)
    {
        let again = NetworkMessage::decode(&written).expect("what was written can be read");
        assert_eq!(
            write(&again).as_ref(),
            Some(&written),
            "writing is not canonical"
        );
        same(&network, &again);
    }
}

/// Visits every value at any depth; returns false if a part cannot be decoded.
fn is_readable(message: &DataSetMessage<'_>) -> bool {
    if message.is_valid() {
        let number = message.header().sequence_number;
        assert_eq!(message.sequence_number(), number);
    }
    if let Ok(fields) = message.fields() {
        let block = fields.clone().checked_bytes();
        let mut good = true;
        for field in fields {
            good &= field.is_ok_and(|field| visit(field, 0));
        }
        assert_eq!(
            block.is_ok(),
            good,
            "the check of all fields is not that of each"
        );
    }
    match message.values() {
        Ok(values) => {
            let mut good = true;
            for value in values {
                good &= value.is_ok_and(|value| visit_data_value(&value.value, 0));
            }
            good
        }
        Err(_) => message.encoding() == FieldEncoding::RawData,
    }
}

fn visit(variant: Variant<'_>, depth: usize) -> bool {
    assert!(
        depth <= usize::from(uadp::MAX_NESTING) + 1,
        "nesting is bounded"
    );
    match variant {
        Variant::Null => true,
        Variant::Scalar(scalar) => visit_scalar(scalar, depth),
        Variant::Array(array) => visit_array(array, depth),
        Variant::Matrix(matrix) => {
            let product: u64 = matrix.dimensions().map(u64::from).product();
            let elements = matrix.elements();
            assert!(product == elements.len() as u64 || elements.is_empty());
            visit_array(elements, depth)
        }
    }
}

fn visit_array(array: Array<'_>, depth: usize) -> bool {
    let mut count = 0;
    for element in array {
        assert_eq!(element.builtin_type(), array.element());
        assert!(visit_scalar(element, depth));
        count += 1;
    }
    assert_eq!(
        count,
        array.len(),
        "elements were checked when the array was read"
    );
    true
}

/// Nested values were checked when they were decoded, so `get` cannot fail.
fn visit_scalar(scalar: Scalar<'_>, depth: usize) -> bool {
    match scalar {
        Scalar::Variant(inner) => visit(inner.get().expect("checked"), depth + 1),
        Scalar::DataValue(inner) => visit_data_value(&inner.get().expect("checked"), depth + 1),
        Scalar::DiagnosticInfo(inner) => {
            visit_diagnostic_info(&inner.get().expect("checked"), depth + 1)
        }
        _ => true,
    }
}

fn visit_data_value(value: &DataValue<'_>, depth: usize) -> bool {
    value.value.is_none_or(|value| visit(value, depth))
}

fn visit_diagnostic_info(info: &DiagnosticInfo<'_>, depth: usize) -> bool {
    assert!(
        depth <= usize::from(uadp::MAX_NESTING) + 1,
        "nesting is bounded"
    );
    info.inner
        .is_none_or(|inner| visit_diagnostic_info(&inner.get().expect("checked"), depth + 1))
}

/// Encodes the message from its values; `None` if it has no values to encode or they do not fit.
fn write(network: &NetworkMessage<'_>) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    let ids: Option<Vec<u16>> = network.writer_ids().map(Iterator::collect);
    let promoted: Option<Vec<Variant<'_>>> = match network.promoted_fields() {
        Some(fields) => Some(fields.collect::<Result<_, _>>().ok()?),
        None => None,
    };
    if !network.footer().is_empty()
        || network
            .security()
            .is_some_and(|it| it.footer_size.is_some())
    {
        return None;
    }
    let extras = Extras {
        promoted_fields: promoted.as_deref(),
        security: network.security(),
    };
    let mut encoder =
        NetworkMessageEncoder::with(&mut out, &network.header(), ids.as_deref(), &extras).ok()?;
    for message in network.messages() {
        write_message(&mut encoder, &message.ok()?)?;
    }
    encoder.finish().ok()?;
    Some(out)
}

fn write_message(
    encoder: &mut NetworkMessageEncoder<'_>,
    message: &DataSetMessage<'_>,
) -> Option<()> {
    let header = message.header();
    if !header.valid {
        return None;
    }
    match (message.kind, message.encoding()) {
        (MessageKind::KeepAlive, _) => encoder.keep_alive(&header).ok(),
        (MessageKind::KeyFrame, FieldEncoding::RawData) => {
            let bytes = message.payload();
            encoder
                .raw_key_frame(&header, |buf| {
                    buf.extend_from_slice(bytes);
                    Ok(())
                })
                .ok()
        }
        (MessageKind::KeyFrame | MessageKind::Event, FieldEncoding::Variant) => {
            let mut fields = match message.kind {
                MessageKind::Event => encoder.event(&header),
                _ => encoder.key_frame(&header),
            }
            .ok()?;
            for field in message.fields().ok()? {
                fields.variant(&field.ok()?).ok()?;
            }
            fields.finish().ok()
        }
        (MessageKind::DeltaFrame, FieldEncoding::Variant) => {
            let mut fields = encoder.delta_frame(&header).ok()?;
            for value in message.values().ok()? {
                let value = value.ok()?;
                let field = fields.field(value.index).ok()?;
                field.variant(&value.value.value?).ok()?;
            }
            fields.finish().ok()
        }
        (MessageKind::KeyFrame, FieldEncoding::DataValue) => {
            let mut fields = encoder.data_values(&header).ok()?;
            for value in message.values().ok()? {
                fields.value(&value.ok()?.value).ok()?;
            }
            fields.finish().ok()
        }
        (MessageKind::DeltaFrame, FieldEncoding::DataValue) => {
            let mut fields = encoder.delta_data_values(&header).ok()?;
            for value in message.values().ok()? {
                let value = value.ok()?;
                fields.changed(value.index, &value.value).ok()?;
            }
            fields.finish().ok()
        }
        _ => None,
    }
}

/// Asserts that both messages are equal. NaN is not equal to itself, so values are compared by
/// their debug output.
fn same(one: &NetworkMessage<'_>, other: &NetworkMessage<'_>) {
    assert_eq!(one.header(), other.header());
    let ids = |network: &NetworkMessage<'_>| network.writer_ids().map(Iterator::collect::<Vec<_>>);
    assert_eq!(ids(one), ids(other));
    for (one, other) in one.messages().zip(other.messages()) {
        let (one, other) = (one.expect("read before"), other.expect("written"));
        assert_eq!(one.header(), other.header());
        assert_eq!(one.kind, other.kind);
        if let (Ok(one), Ok(other)) = (one.values(), other.values()) {
            for (one, other) in one.zip(other) {
                let (one, other) = (one.expect("read before"), other.expect("written"));
                assert_eq!(one.index, other.index);
                let (one, other) = (as_written(one.value), other.value);
                assert_eq!(format!("{one:?}"), format!("{other:?}"));
            }
        }
    }
}

/// Returns the value as it is encoded: a matrix of fewer than two dimensions, or without elements,
/// is encoded as an array.
fn as_written(mut value: DataValue<'_>) -> DataValue<'_> {
    if let Some(Variant::Matrix(matrix)) = value.value
        && (matrix.dimensions().len() < 2 || matrix.elements().is_empty())
    {
        value.value = Some(Variant::Array(matrix.elements()));
    }
    value
}
