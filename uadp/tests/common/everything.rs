//! Reads a datagram through every accessor, and checks invariants that hold for all bytes.

use uadp::{
    Array, BuiltinType, DataSetMessage, DataValue, DiagnosticInfo, ExtensionBody, FieldEncoding,
    MessageKind, NetworkMessage, Scalar, StructureReader, Variant,
};

/// Reads a datagram, also behind errors. Returns the number of values, including nested values.
pub(crate) fn read_everything(datagram: &[u8]) -> usize {
    let Ok(network) = NetworkMessage::decode(datagram) else {
        return 0;
    };
    let headers = read_headers(&network);
    let listed = network.messages().flatten();
    let listed: usize = listed.map(|message| read_message(&message)).sum();
    let start = datagram.len() - network.payload().len() - network.footer().len();
    let placed = network.data_set_message_at(start, network.payload().len());
    headers + listed + placed.map_or(0, |message| message.payload().len().min(1))
}

fn read_headers(network: &NetworkMessage<'_>) -> usize {
    assert!(network.datagram().ends_with(network.footer()));
    assert!(network.writer_ids().is_none_or(|ids| ids.len() > 0));
    let security = network.security();
    assert!(!network.is_sealed() || security.is_some_and(|header| header.is_secured()));
    if let Ok(chunk) = network.chunk() {
        let end = chunk.offset as usize + chunk.data.len();
        assert!(network.is_chunk() && !chunk.data.is_empty() && end <= chunk.total_size as usize);
    }
    let sum: u64 = network
        .writer_ids()
        .into_iter()
        .flatten()
        .map(u64::from)
        .sum();
    std::hint::black_box((network.header(), network.message_type(), sum));
    let promoted = network.promoted_fields().into_iter().flatten();
    promoted.flatten().map(|field| read_variant(&field)).sum()
}

fn read_message(message: &DataSetMessage<'_>) -> usize {
    let plain = message.fields().map_or(0, |fields| {
        assert!(fields.bytes().len() >= 2 + fields.len());
        let well_formed = fields.clone().all(|field| field.is_ok());
        assert_eq!(fields.checked_bytes().is_ok(), well_formed);
        fields.flatten().map(|field| read_variant(&field)).sum()
    });
    let indexed = message.values().map_or(0, |values| {
        values
            .flatten()
            .map(|field| usize::from(!field.is_filler()) + read_data_value(&field.value))
            .sum()
    });
    let readable = message.encoding() == FieldEncoding::Variant;
    assert!(plain == 0 || readable && message.kind != MessageKind::DeltaFrame);
    plain + indexed
}

fn read_data_value(value: &DataValue<'_>) -> usize {
    value.value.map_or(1, |value| read_variant(&value))
}

fn read_variant(value: &Variant<'_>) -> usize {
    match value {
        Variant::Null => 1,
        Variant::Scalar(scalar) => {
            assert_eq!(value.builtin_type(), Some(scalar.builtin_type()));
            read_scalar(*scalar)
        }
        Variant::Array(array) => read_array(*array),
        Variant::Matrix(matrix) => {
            let sizes = matrix.dimensions();
            let product = sizes.map(u128::from).fold(1_u128, u128::saturating_mul);
            let len = matrix.elements().len();
            assert!(product == len as u128 || matrix.dimensions().len() == 0);
            read_array(matrix.elements())
        }
    }
}

fn read_array(array: Array<'_>) -> usize {
    assert!(!array.is_null() || array.is_empty());
    let fixed = array.element().fixed_size();
    assert!(fixed.is_none_or(|size| array.bytes().len() == size * array.len()));
    let mut found = 0;
    let mut len = 0;
    for element in array {
        assert_eq!(element.builtin_type(), array.element());
        found += read_scalar(element);
        len += 1;
    }
    assert_eq!(len, array.len());
    found
}

fn read_scalar(scalar: Scalar<'_>) -> usize {
    match scalar {
        Scalar::Variant(value) => read_variant(&value.get().unwrap()),
        Scalar::DataValue(value) => read_data_value(&value.get().unwrap()),
        Scalar::DiagnosticInfo(info) => read_diagnostic_info(&info.get().unwrap()),
        Scalar::ExtensionObject(object) => match object.body {
            ExtensionBody::None => 1,
            ExtensionBody::Xml(_) => 1,
            ExtensionBody::Binary(body) => 1 + read_body(body),
        },
        Scalar::String(text) | Scalar::XmlElement(text) => {
            std::hint::black_box(text);
            1
        }
        leaf @ (Scalar::Boolean(_)
        | Scalar::SByte(_)
        | Scalar::Byte(_)
        | Scalar::Int16(_)
        | Scalar::UInt16(_)
        | Scalar::Int32(_)
        | Scalar::UInt32(_)
        | Scalar::Int64(_)
        | Scalar::UInt64(_)
        | Scalar::Float(_)
        | Scalar::Double(_)
        | Scalar::DateTime(_)
        | Scalar::Guid(_)
        | Scalar::ByteString(_)
        | Scalar::NodeId(_)
        | Scalar::ExpandedNodeId(_)
        | Scalar::StatusCode(_)
        | Scalar::QualifiedName(_)
        | Scalar::LocalizedText(_)) => {
            std::hint::black_box(leaf);
            1
        }
    }
}

/// Returns the number of types that a body could start with.
fn read_body(body: &[u8]) -> usize {
    let body = StructureReader::new(body);
    std::hint::black_box(body.clone().length().is_ok());
    let starts_with = |builtin: &BuiltinType| {
        let value = body.clone().scalar(*builtin).is_ok();
        value || body.clone().array(*builtin).is_ok()
    };
    BuiltinType::ALL
        .iter()
        .filter(|builtin| starts_with(builtin))
        .count()
}

fn read_diagnostic_info(info: &DiagnosticInfo<'_>) -> usize {
    std::hint::black_box((
        info.symbolic_id,
        info.additional_info,
        info.inner_status_code,
    ));
    info.inner.map_or(1, |inner| {
        assert!(!inner.bytes().is_empty());
        1 + read_diagnostic_info(&inner.get().unwrap())
    })
}
