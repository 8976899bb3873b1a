//! Every type of the bundle is converted to UADP fields according to its leaves, and back.
use crate::inventor;

use bridge_core::{decode_fields, encode_fields};
use messages::{ArrayRank, Dialect, MessagePlan, Selection, TypeRegistry, Wire};
use proptest::test_runner::TestRunner;
use uadp::{
    BuiltinType, DataSetHeader, Fields, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    Variant,
};

fn encode(plan: &MessagePlan, message: &[u8]) -> Vec<u8> {
    let mut datagram = Vec::new();
    let network = NetworkHeader::default();
    let mut encoder = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[1])).unwrap();
    let mut frame = encoder.key_frame(&DataSetHeader::default()).unwrap();
    encode_fields(plan, message, 2, &mut frame).unwrap();
    frame.finish().unwrap();
    encoder.finish().unwrap();
    datagram
}

fn fields(datagram: &[u8]) -> Fields<'_> {
    let network = NetworkMessage::decode(datagram).unwrap();
    let message = network.messages().next().unwrap().unwrap();
    message.fields().unwrap()
}

fn shape(field: &Variant<'_>) -> (Option<BuiltinType>, bool) {
    (field.builtin_type(), matches!(field, Variant::Array(_)))
}

#[test]
fn random_messages_of_every_type_cross_and_return() {
    let mut runner = TestRunner::deterministic();
    let mut types = 0;
    for (dialect, wire) in [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)] {
        let registry = TypeRegistry::bundle(dialect);
        for name in registry.names() {
            let message = registry.get(name).unwrap();
            let plan = MessagePlan::compile(&message, &Selection::Whole, wire).unwrap();
            let shapes = plan.leaves().iter().map(|leaf| {
                (
                    Some(leaf.builtin),
                    matches!(leaf.rank, ArrayRank::Array { .. }),
                )
            });
            let shapes: Vec<_> = shapes.collect();
            for _ in 0..10 {
                let (_, bytes) = inventor::invent(&plan, &runner.new_rng());
                let datagram = encode(&plan, &bytes);
                let found: Vec<_> = fields(&datagram)
                    .map(|field| shape(&field.unwrap()))
                    .collect();
                assert_eq!(found, shapes, "{name} {wire:?}");
                let mut back = Vec::new();
                decode_fields(&plan, fields(&datagram), &mut back).unwrap();
                assert_eq!(back, bytes, "{name} {wire:?}");
            }
            types += 1;
        }
    }
    assert!(types > 250, "{types}");
}

/// The message types of `test_msgs` with arrays of messages without fields, and a type that ends in
/// such arrays.
const WITH_EMPTY_ELEMENTS: [(&str, &str); 4] = [
    ("nothing_msgs/Constants", "int32 ONE=1\n"),
    (
        "nothing_msgs/Arrays",
        "nothing_msgs/Constants[3] three\nnothing_msgs/Constants[] many\n",
    ),
    (
        "nothing_msgs/Nested",
        "nothing_msgs/Arrays[2] fixed\nnothing_msgs/Arrays[] open\nnothing_msgs/Constants one\n",
    ),
    (
        "nothing_msgs/MultiNested",
        "int32 before\nnothing_msgs/Nested[] nested\nnothing_msgs/Nested one\n",
    ),
];

#[test]
fn arrays_of_messages_without_fields_cross_with_their_lengths() {
    let mut runner = TestRunner::deterministic();
    for (dialect, wire) in [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)] {
        let mut registry = TypeRegistry::empty(dialect);
        for (name, text) in WITH_EMPTY_ELEMENTS {
            registry.add(&name.parse().unwrap(), text).unwrap();
        }
        for (name, _) in WITH_EMPTY_ELEMENTS {
            let message = registry.get(&name.parse().unwrap()).unwrap();
            let whole = MessagePlan::compile(&message, &Selection::Whole, wire).unwrap();
            for selection in [Selection::Whole, Selection::Structure(None)] {
                let plan = MessagePlan::compile(&message, &selection, wire).unwrap();
                for _ in 0..20 {
                    let (_, bytes) = inventor::invent(&whole, &runner.new_rng());
                    let datagram = encode(&plan, &bytes);
                    let mut back = Vec::new();
                    decode_fields(&plan, fields(&datagram), &mut back)
                        .unwrap_or_else(|error| panic!("{name} {selection:?} {wire:?}: {error}"));
                    assert_eq!(back, bytes, "{name} {selection:?} {wire:?}");
                }
            }
        }
    }
}

#[test]
fn what_one_datagram_claims_of_messages_without_fields_is_bounded() {
    let mut registry = TypeRegistry::empty(Dialect::Ros2);
    for (name, text) in WITH_EMPTY_ELEMENTS {
        registry.add(&name.parse().unwrap(), text).unwrap();
    }
    let message = registry
        .get(&"nothing_msgs/Arrays".parse().unwrap())
        .unwrap();
    let plan = MessagePlan::compile(&message, &Selection::Structure(None), Wire::Cdr).unwrap();
    let claim = |many: u32| {
        let mut datagram = Vec::new();
        let network = NetworkHeader::default();
        let mut encoder = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[1])).unwrap();
        let mut frame = encoder.key_frame(&DataSetHeader::default()).unwrap();
        let of = uadp::NodeId::string(2, "nothing_msgs/Arrays");
        frame.begin_structure(of).unwrap();
        for count in [3, many] {
            frame.inline_structures(count as usize).unwrap();
        }
        frame.end_structure().unwrap();
        frame.finish().unwrap();
        encoder.finish().unwrap();
        let mut out = Vec::new();
        decode_fields(&plan, fields(&datagram), &mut out).map(|()| out.len())
    };
    // The fixed three, the count and the elements of a byte each, and the encapsulation, padded to
    // a multiple of four.
    assert_eq!(claim(5).unwrap(), 4 + 16);
    assert_eq!(claim(65_533).unwrap(), 4 + 65_544);
    claim(65_534).unwrap_err();
    claim(i32::MAX as u32).unwrap_err();
}

#[test]
fn a_field_of_another_type_among_numbers_is_named() {
    let message = TypeRegistry::bundle(Dialect::Ros1)
        .get(&"geometry_msgs/Vector3".parse().unwrap())
        .unwrap();
    let plan = MessagePlan::compile(&message, &Selection::Whole, Wire::Ros1).unwrap();
    let mut datagram = Vec::new();
    let network = NetworkHeader::default();
    let mut encoder = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[1])).unwrap();
    let mut frame = encoder.key_frame(&DataSetHeader::default()).unwrap();
    for value in [
        uadp::Scalar::Double(1.0),
        uadp::Scalar::Float(2.0),
        uadp::Scalar::Double(3.0),
    ] {
        frame.scalar(value).unwrap();
    }
    frame.finish().unwrap();
    encoder.finish().unwrap();
    let mut out = vec![7];
    let error = decode_fields(&plan, fields(&datagram), &mut out).unwrap_err();
    assert_eq!(error.to_string(), "field `y`: Double expected, found Float");
    assert_eq!(out, [7]);
}
