//! Decoding a datagram, and encoding into a used buffer, allocate nothing.

use crate::everything;

use allocation_counter::measure;
use everything::read_everything;
use uadp::{
    Array, BuiltinType, DataSetHeader, DataValue, DateTime, GroupHeader, Matrix, Nested,
    NetworkHeader, NetworkMessage, NetworkMessageEncoder, NodeId, PublisherId, Scalar, StatusCode,
    Variant,
};

#[test]
fn an_allocation_would_be_counted() {
    assert_eq!(
        measure(|| drop(std::hint::black_box(vec![1_u8]))).count_total,
        1
    );
}

#[test]
fn reading_allocates_nothing() {
    let mut datagram = Vec::new();
    write(&mut datagram, &mut Vec::new());
    let messages = NetworkMessage::decode(&datagram).unwrap().messages();
    assert_eq!(messages.filter(Result::is_ok).count(), 5);
    let mut values = 0;
    let allocations = measure(|| values = read_everything(&datagram));
    assert!(values > 40, "{values} values read");
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn refusing_allocates_nothing() {
    let mut datagram = Vec::new();
    write(&mut datagram, &mut Vec::new());
    let mut errors = 0;
    let allocations = measure(|| {
        for len in 0..datagram.len() {
            let (datagram, _) = datagram.split_at(len);
            let Ok(network) = NetworkMessage::decode(datagram) else {
                errors += 1;
                continue;
            };
            for message in network.messages() {
                match message.and_then(|message| message.values()) {
                    Ok(values) => errors += values.filter(Result::is_err).count(),
                    Err(_) => errors += 1,
                }
            }
        }
    });
    assert!(errors >= datagram.len(), "every prefix lacks something");
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn writing_into_a_used_buffer_allocates_nothing() {
    let mut datagram = Vec::new();
    let mut inner = Vec::new();
    write(&mut datagram, &mut inner);
    let first = datagram.clone();
    let allocations = measure(|| {
        datagram.clear();
        write(&mut datagram, &mut inner);
    });
    assert_eq!(datagram, first);
    assert_eq!(allocations.count_total, 0);
}

/// Encodes a DataSetMessage of every kind. `inner` is a buffer for nested values.
fn write(datagram: &mut Vec<u8>, inner: &mut Vec<u8>) {
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::String("cell 4")),
        group: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let data_set_header = DataSetHeader {
        sequence_number: Some(1),
        timestamp: Some(DateTime(134_234_948_967_890_123)),
        ..DataSetHeader::default()
    };
    let ids = [10, 11, 12, 13, 14];
    let mut encoder = NetworkMessageEncoder::new(datagram, &header, Some(&ids)).unwrap();
    write_key_frame(&mut encoder, &data_set_header);
    let mut fields = encoder.event(&data_set_header).unwrap();
    let value = DataValue::from(Variant::from(Scalar::Boolean(true)));
    let value = Nested::data_value(&value, inner).unwrap();
    fields.scalar(Scalar::DataValue(value)).unwrap();
    fields.finish().unwrap();
    let mut fields = encoder.delta_frame(&data_set_header).unwrap();
    let elements = Array::new(BuiltinType::Byte, 4, &[1, 2, 3, 4]).unwrap();
    let sizes = [2_u32.to_le_bytes(); 2];
    let matrix = Matrix::new(elements, &sizes).unwrap();
    fields.field(7).unwrap().variant(&matrix.into()).unwrap();
    fields.finish().unwrap();
    let bad = DataValue {
        status: Some(StatusCode(0x8000_0000)),
        source_timestamp: data_set_header.timestamp,
        ..DataValue::default()
    };
    let mut fields = encoder.data_values(&data_set_header).unwrap();
    fields.value(&bad).unwrap();
    fields.finish().unwrap();
    let mut fields = encoder.delta_data_values(&data_set_header).unwrap();
    fields.changed(7, &bad).unwrap();
    fields.finish().unwrap();
    encoder.finish().unwrap();
}

fn write_key_frame(encoder: &mut NetworkMessageEncoder<'_>, header: &DataSetHeader) {
    let mut fields = encoder.key_frame(header).unwrap();
    fields.scalar(Scalar::Double(2.5)).unwrap();
    fields.scalar(Scalar::String(Some("text"))).unwrap();
    fields
        .scalar(Scalar::NodeId(NodeId::string(2, "Robot.Axis1")))
        .unwrap();
    fields.packed_array(BuiltinType::Int16, 3, &[0; 6]).unwrap();
    fields.array(BuiltinType::String, 2).unwrap();
    fields.element(Scalar::String(None)).unwrap();
    fields.element(Scalar::String(Some("text"))).unwrap();
    fields.array(BuiltinType::Variant, 2).unwrap();
    for bytes in [&[3, 7][..], &[0x98, 2, 0, 0, 0, 0, 4, 1, 1]] {
        let value = Nested::new(bytes).unwrap();
        fields.element(Scalar::Variant(value)).unwrap();
    }
    let info = Nested::new(&[0x40, 0x41, 1, 0, 0, 0, 0]).unwrap();
    fields.scalar(Scalar::DiagnosticInfo(info)).unwrap();
    fields.structures(2).unwrap();
    for _ in 0..2 {
        fields.begin_structure(NodeId::numeric(2, 5001)).unwrap();
        fields.scalar(Scalar::Float(1.0)).unwrap();
        fields.end_structure().unwrap();
    }
    fields.finish().unwrap();
}
