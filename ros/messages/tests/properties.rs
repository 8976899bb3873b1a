//! Random values in both directions, and bytes that are not a message.
use crate::inventor;
use crate::support;

use inventor::{invent, unnamed};
use messages::{
    Dialect, Leaf, MessageFault, MessagePlan, ReadError, Selection, TypeRegistry, Wire,
};
use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use support::{EventPlayer, RecordedEvent, RecordedValue, Recorder};
use uadp::BuiltinType;

fn plans() -> Vec<(String, Wire, MessagePlan)> {
    let mut plans = Vec::new();
    for (dialect, wire) in [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)] {
        let registry = TypeRegistry::bundle(dialect);
        for name in registry.names() {
            let plan = MessagePlan::compile(&registry.get(name).unwrap(), &Selection::Whole, wire)
                .unwrap();
            plans.push((format!("{name} {wire:?}"), wire, plan));
        }
    }
    plans
}

fn runner() -> TestRunner {
    TestRunner::deterministic()
}

#[test]
fn random_values_of_every_type_of_the_bundle_return_from_either_wire() {
    let mut runner = runner();
    for (what, _, plan) in plans() {
        for _ in 0..20 {
            let (made, bytes) = invent(&plan, &runner.new_rng());
            let mut recorder = Recorder::default();
            plan.read(&bytes, &mut recorder)
                .unwrap_or_else(|error| panic!("{what}: {error}"));
            let mut again = Vec::new();
            plan.write(&mut EventPlayer::new(&recorder.events), &mut again)
                .unwrap();
            assert_eq!(again, bytes, "{what}");
            assert_eq!(unnamed(recorder.events), made, "{what}");
        }
    }
}

#[test]
fn a_message_cut_short_errs_unless_only_padding_was_cut() {
    let mut runner = runner();
    for (what, wire, plan) in plans() {
        let (made, bytes) = invent(&plan, &runner.new_rng());
        for cut in 0..bytes.len() {
            let mut recorder = Recorder::default();
            match plan.read(&bytes[..cut], &mut recorder) {
                Ok(()) => {
                    assert_eq!(wire, Wire::Cdr, "{what} cut at {cut} of {}", bytes.len());
                    assert!(
                        bytes.len() - cut <= 3 && bytes[cut..].iter().all(|byte| *byte == 0),
                        "{what} at {cut}"
                    );
                    assert_eq!(unnamed(recorder.events), made, "{what}");
                }
                Err(ReadError::Malformed {
                    fault: MessageFault::Truncated,
                    at,
                    ..
                }) => assert!(at <= cut, "{what}"),
                Err(error) => panic!("{what} cut at {cut}: {error}"),
            }
        }
    }
}

#[test]
fn bytes_after_a_ros_1_message_err_and_after_cdr_do_not() {
    let mut runner = runner();
    for (what, wire, plan) in plans() {
        let (made, mut bytes) = invent(&plan, &runner.new_rng());
        bytes.extend([0; 5]);
        let mut recorder = Recorder::default();
        let done = plan.read(&bytes, &mut recorder);
        match wire {
            Wire::Ros1 => {
                let wanted = ReadError::Malformed {
                    field: String::new(),
                    at: bytes.len() - 5,
                    fault: MessageFault::TrailingBytes(5),
                };
                assert_eq!(done, Err(wanted), "{what}");
            }
            Wire::Cdr => assert_eq!((done, unnamed(recorder.events)), (Ok(()), made), "{what}"),
        }
    }
}

#[test]
fn a_field_alone_is_what_it_is_in_the_whole_and_the_rest_is_zero() {
    let mut runner = runner();
    for (dialect, wire) in [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)] {
        let registry = TypeRegistry::bundle(dialect);
        for name in registry.names() {
            let message = registry.get(name).unwrap();
            let whole = MessagePlan::compile(&message, &Selection::Whole, wire).unwrap();
            let (_, bytes) = invent(&whole, &runner.new_rng());
            let mut all = Recorder::default();
            whole.read(&bytes, &mut all).unwrap();
            let paths = |path: fn(&Leaf) -> &str| {
                let mut paths: Vec<&str> = message.leaves().iter().map(path).collect();
                paths.dedup();
                paths
            };
            let each = paths(|leaf| &leaf.path);
            // A name without a dot is a field of the message itself: a value, or a nested message.
            let outer = paths(|leaf| leaf.path.split('.').next().unwrap());
            for paths in [each, outer] {
                let pieces = paths.into_iter().flat_map(|path| {
                    let selection = Selection::Field(path.to_owned());
                    let plan = MessagePlan::compile(&message, &selection, wire).unwrap();
                    alone(&plan, &whole, &bytes, &format!("{name} {path}"))
                });
                assert_eq!(pieces.collect::<Vec<_>>(), all.events, "{name}");
            }
        }
    }
}

/// Returns the fields that `plan` reads from a message, after they were written and read again on
/// their own, with zeros around them.
fn alone(plan: &MessagePlan, whole: &MessagePlan, bytes: &[u8], what: &str) -> Vec<RecordedEvent> {
    let read = |plan: &MessagePlan, bytes: &[u8]| {
        let mut recorder = Recorder::default();
        plan.read(bytes, &mut recorder)
            .unwrap_or_else(|error| panic!("{what}: {error}"));
        recorder.events
    };
    let one = read(plan, bytes);
    let mut written = Vec::new();
    plan.write(&mut EventPlayer::new(&one), &mut written)
        .unwrap();
    assert_eq!(read(plan, &written), one, "{what}");
    let rest = read(whole, &written);
    assert!(is_zero_but(&rest, &one), "{what}: {rest:?}");
    one
}

/// Returns whether all of `events` outside of one run of `carried` are zeros.
fn is_zero_but(events: &[RecordedEvent], carried: &[RecordedEvent]) -> bool {
    let epoch = 116_444_736_000_000_000i64.to_le_bytes();
    let zero = |event: &RecordedEvent| match event {
        RecordedEvent::Scalar(value) | RecordedEvent::Element(value) => match value {
            RecordedValue::Fixed(BuiltinType::DateTime, bytes) => *bytes == epoch,
            RecordedValue::Fixed(_, bytes) | RecordedValue::Bytes(bytes) => {
                bytes.iter().all(|byte| *byte == 0)
            }
            RecordedValue::Text(text) => text.is_empty(),
        },
        RecordedEvent::Packed(_, _, bytes) => bytes.iter().all(|byte| *byte == 0),
        RecordedEvent::Array(..) | RecordedEvent::Begin(_) | RecordedEvent::End => true,
        RecordedEvent::Structures(..) => true,
    };
    (0..=events.len() - carried.len()).any(|at| {
        let (before, rest) = events.split_at(at);
        let (run, after) = rest.split_at(carried.len());
        run == carried && before.iter().chain(after).all(zero)
    })
}

#[test]
fn a_length_beyond_the_payload_is_refused_before_the_sink_hears_of_it() {
    for (dialect, wire, header) in [
        (Dialect::Ros1, Wire::Ros1, &[][..]),
        (Dialect::Ros2, Wire::Cdr, &[0, 1, 0, 0][..]),
        (Dialect::Ros2, Wire::Cdr, &[0, 0, 0, 0][..]),
    ] {
        let mut registry = TypeRegistry::bundle(dialect);
        for kind in [
            "string",
            "uint8[]",
            "bool[]",
            "float64[]",
            "string[]",
            "std_msgs/ColorRGBA[]",
            "std_msgs/String[]",
        ] {
            let name = "test_msgs/T".parse().unwrap();
            registry.add(&name, &format!("{kind} x")).unwrap();
            let plan = MessagePlan::compile(&registry.get(&name).unwrap(), &Selection::Whole, wire)
                .unwrap();
            for count in [1u32, 0x7FFF_FFFF, 0x8000_0000, 0x8000_0080, u32::MAX] {
                let mut payload = header.to_vec();
                let big = header.get(1) == Some(&0);
                payload.extend(if big {
                    count.to_be_bytes()
                } else {
                    count.to_le_bytes()
                });
                let mut recorder = Recorder::default();
                let wanted = ReadError::Malformed {
                    field: "x".to_owned(),
                    at: payload.len(),
                    fault: MessageFault::Truncated,
                };
                assert_eq!(
                    plan.read(&payload, &mut recorder),
                    Err(wanted),
                    "{kind} {count:#x}"
                );
                assert_eq!(recorder.events, [], "{kind}");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn random_bytes_never_panic(bytes in proptest::collection::vec(prop_oneof![Just(0u8), Just(1u8), any::<u8>()], 0..300)) {
        for (_, wire, plan) in plans() {
            let mut payload = if wire == Wire::Cdr { vec![0, bytes.len() as u8 % 2, 0, 0] } else { Vec::new() };
            payload.extend(&bytes);
            let mut recorder = Recorder::default();
            if plan.read(&payload, &mut recorder).is_ok() {
                let mut out = Vec::new();
                // A text with a NUL and an unnormalised time are read but not written.
                drop(plan.write(&mut EventPlayer::new(&recorder.events), &mut out));
            }
        }
    }

    #[test]
    fn a_message_with_a_byte_changed_never_panics(seed in any::<u64>(), flips in proptest::collection::vec((any::<usize>(), any::<u8>()), 1..4)) {
        let plans = plans();
        let (_, _, plan) = &plans[(seed % plans.len() as u64) as usize];
        let (_, mut bytes) = invent(plan, &runner().new_rng());
        for (at, to) in flips {
            if let Some(length) = bytes.len().checked_sub(1) {
                bytes[at % (length + 1)] = to;
            }
        }
        drop(plan.read(&bytes, &mut Recorder::default()));
    }
}
