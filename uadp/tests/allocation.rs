//! Reading a datagram allocates nothing, and writing into a buffer that was used before neither.

#![expect(clippy::unwrap_used, reason = "test code")]

use allocation_counter::measure;
use uadp::{
    BuiltinType, DataSetHeader, DateTime, GroupHeader, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, NodeId, PublisherId, Scalar, Variant,
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
    write(&mut datagram);
    let mut values = 0;
    let allocations = measure(|| {
        let network = NetworkMessage::decode(&datagram).unwrap();
        for message in network.messages() {
            for field in message.unwrap().fields().unwrap() {
                values += match field.unwrap() {
                    Variant::Array(array) => array.iter().count(),
                    Variant::Null | Variant::Scalar(_) => 1,
                };
            }
        }
    });
    assert_eq!(values, 11);
    assert_eq!(allocations.count_total, 0);
}

#[test]
fn refusing_allocates_nothing() {
    let mut datagram = Vec::new();
    write(&mut datagram);
    let mut errors = 0;
    let allocations = measure(|| {
        for len in 0..datagram.len() {
            let (datagram, _) = datagram.split_at(len);
            let Ok(network) = NetworkMessage::decode(datagram) else {
                errors += 1;
                continue;
            };
            for message in network.messages() {
                match message.and_then(|message| message.fields()) {
                    Ok(fields) => errors += fields.filter(Result::is_err).count(),
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
    write(&mut datagram);
    let first = datagram.clone();
    let allocations = measure(|| {
        datagram.clear();
        write(&mut datagram);
    });
    assert_eq!(datagram, first);
    assert_eq!(allocations.count_total, 0);
}

fn write(datagram: &mut Vec<u8>) {
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
    let mut encoder = NetworkMessageEncoder::new(datagram, &header, Some(&[10, 11])).unwrap();
    let mut fields = encoder.key_frame(&data_set_header).unwrap();
    fields.scalar(Scalar::Double(2.5)).unwrap();
    fields.scalar(Scalar::String(Some("text"))).unwrap();
    fields
        .scalar(Scalar::NodeId(NodeId::string(2, "Robot.Axis1")))
        .unwrap();
    fields.packed_array(BuiltinType::Int16, 3, &[0; 6]).unwrap();
    fields.array(BuiltinType::String, 2).unwrap();
    fields.element(Scalar::String(None)).unwrap();
    fields.element(Scalar::String(Some("text"))).unwrap();
    fields.structures(2).unwrap();
    for _ in 0..2 {
        fields.begin_structure(NodeId::numeric(2, 5001)).unwrap();
        fields.scalar(Scalar::Float(1.0)).unwrap();
        fields.end_structure().unwrap();
    }
    fields.finish().unwrap();
    let mut fields = encoder.key_frame(&data_set_header).unwrap();
    fields.scalar(Scalar::Boolean(true)).unwrap();
    fields.finish().unwrap();
    encoder.finish().unwrap();
}
