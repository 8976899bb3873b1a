//! What becomes of definitions that are incomplete, hostile or a peer's, and of values that do not fit.
#![expect(clippy::unwrap_used, reason = "test code")]

mod support;

use std::sync::Arc;

use messages::{
    DefinitionError, Dialect, Fault, Leaf, MessageType, Plan, PlanError, Rank, ReadError, Registry,
    Selection, SourceError, TypeName, Wire, WriteError, WriteFault, standard_type,
};
use support::{Event, Player, Recorder, Value};
use uadp::{BuiltinType, DateTime, Scalar};

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

fn registry(dialect: Dialect, definitions: &[(&str, &str)]) -> Registry {
    let mut registry = Registry::bundle(dialect);
    for (name_text, text) in definitions {
        registry.add(&name(name_text), text).unwrap();
    }
    registry
}

fn message(dialect: Dialect, text: &str) -> Arc<MessageType> {
    registry(dialect, &[("t/T", text)])
        .get(&name("t/T"))
        .unwrap()
}

fn plan(dialect: Dialect, text: &str) -> Plan {
    let wire = if dialect == Dialect::Ros1 {
        Wire::Ros1
    } else {
        Wire::Cdr
    };
    Plan::compile(&message(dialect, text), &Selection::Whole, wire).unwrap()
}

fn read(plan: &Plan, payload: &[u8]) -> Result<Vec<String>, ReadError<()>> {
    let mut recorder = Recorder::default();
    plan.read(payload, &mut recorder)?;
    Ok(recorder.events.iter().map(ToString::to_string).collect())
}

fn write(plan: &Plan, events: &[Event]) -> Result<Vec<u8>, WriteError> {
    let mut out = Vec::new();
    plan.write(&mut Player::new(events), &mut out)?;
    Ok(out)
}

fn scalar(value: Scalar<'_>) -> Event {
    Event::Scalar(Value::of(value))
}

#[test]
fn a_pose_stamped_is_flattened_by_path_without_the_sequence_number() {
    let leaf = |path: &str, builtin| Leaf {
        path: path.to_owned(),
        builtin,
        rank: Rank::Scalar,
    };
    let mut wanted = vec![
        leaf("header.stamp", BuiltinType::DateTime),
        leaf("header.frame_id", BuiltinType::String),
    ];
    for part in [
        "position.x",
        "position.y",
        "position.z",
        "orientation.x",
        "orientation.y",
        "orientation.z",
        "orientation.w",
    ] {
        wanted.push(leaf(&format!("pose.{part}"), BuiltinType::Double));
    }
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let found = Registry::bundle(dialect)
            .get(&name("geometry_msgs/PoseStamped"))
            .unwrap();
        assert_eq!(found.leaves(), wanted, "{dialect:?}");
        assert_eq!(found.leaf("pose.position.y"), wanted.get(3));
        assert_eq!(found.leaf("pose"), None);
    }
}

#[test]
fn bytes_are_byte_strings_fixed_arrays_keep_their_length_and_messages_become_structures() {
    let text = "byte[] signed\nuint8[4] four\nchar c\nfloat32[3] axes\ngeometry_msgs/Point[2] points\nduration[] waits";
    let shapes: Vec<_> = message(Dialect::Ros1, text)
        .leaves()
        .iter()
        .map(|leaf| (leaf.builtin, leaf.rank))
        .collect();
    assert_eq!(
        shapes,
        [
            (BuiltinType::SByte, Rank::Array { fixed: None }),
            (BuiltinType::ByteString, Rank::Scalar),
            (BuiltinType::Byte, Rank::Scalar),
            (BuiltinType::Float, Rank::Array { fixed: Some(3) }),
            (BuiltinType::ExtensionObject, Rank::Array { fixed: Some(2) }),
            (BuiltinType::Double, Rank::Array { fixed: None }),
        ]
    );
    let ros2 = message(Dialect::Ros2, "byte[] bytes\nbyte one\nwstring wide");
    let builtins: Vec<_> = ros2.leaves().iter().map(|leaf| leaf.builtin).collect();
    assert_eq!(
        builtins,
        [
            BuiltinType::ByteString,
            BuiltinType::Byte,
            BuiltinType::String
        ]
    );
}

#[test]
fn a_missing_type_is_named_with_who_needs_it_and_what_may_be_meant() {
    let registry = registry(
        Dialect::Ros1,
        &[
            ("t/T", "geometry_msgs/Pont p"),
            ("t/U", "nowhere/Unheard x"),
        ],
    );
    let error = registry.get(&name("t/T")).unwrap_err();
    assert_eq!(
        error.to_string(),
        "no definition of `geometry_msgs/Pont`, which `t/T` needs; did you mean `geometry_msgs/Point`?"
    );
    assert_eq!(
        registry.get(&name("t/U")).unwrap_err(),
        DefinitionError::Unknown {
            name: name("nowhere/Unheard"),
            needed_by: Some(name("t/U")),
            suggestion: None
        }
    );
    assert_eq!(
        registry.suggest(&name("sensor_msgs/Twist")),
        Some(name("geometry_msgs/Twist"))
    );
    assert_eq!(
        registry.suggest(&name("sensor_msgs/JointStates")),
        Some(name("sensor_msgs/JointState"))
    );
}

#[test]
fn types_that_contain_themselves_or_nest_without_end_are_refused() {
    let registry = registry(
        Dialect::Ros1,
        &[("t/Self", "Self[] more"), ("t/A", "B b"), ("t/B", "A[] a")],
    );
    assert_eq!(
        registry.get(&name("t/Self")).unwrap_err(),
        DefinitionError::Cyclic {
            name: name("t/Self")
        }
    );
    assert_eq!(
        registry.get(&name("t/B")).unwrap_err(),
        DefinitionError::Cyclic { name: name("t/B") }
    );

    let mut deep = Registry::empty(Dialect::Ros2);
    deep.add(&name("t/L1"), "int8 x").unwrap();
    for level in 2..=33 {
        deep.add(
            &name(&format!("t/L{level}")),
            &format!("L{} below", level - 1),
        )
        .unwrap();
    }
    assert_eq!(deep.get(&name("t/L32")).unwrap().leaves().len(), 1);
    assert_eq!(
        deep.get(&name("t/L33")).unwrap_err(),
        DefinitionError::TooDeep { name: name("t/L1") }
    );
}

#[test]
fn a_time_defined_by_itself_is_still_a_time() {
    let registry = registry(
        Dialect::Ros2,
        &[
            ("builtin_interfaces/Time", "Time again"),
            ("t/T", "builtin_interfaces/Time at"),
        ],
    );
    for type_name in ["t/T", "builtin_interfaces/Time"] {
        let found = registry.get(&name(type_name)).unwrap();
        assert_eq!(
            found.leaves().first().unwrap().builtin,
            BuiltinType::DateTime
        );
    }
}

#[test]
fn a_text_of_very_many_fields_is_refused_where_the_limit_is_passed() {
    let text: String = (0..5000).map(|field| format!("int8 f{field}\n")).collect();
    let error = Registry::empty(Dialect::Ros1)
        .add(&name("t/T"), &text)
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        "`t/T` line 4097: more than 4096 fields: `int8 f4096`"
    );
}

#[test]
fn types_that_multiply_are_refused_before_they_are_built() {
    let mut registry = Registry::empty(Dialect::Ros2);
    registry.add(&name("t/L1"), "int8 x").unwrap();
    for level in 2..=20 {
        let text: String = (0..8)
            .map(|field| format!("L{} f{field}\n", level - 1))
            .collect();
        registry.add(&name(&format!("t/L{level}")), &text).unwrap();
    }
    let too_many = DefinitionError::TooBig {
        name: name("t/L5"),
        what: "more than 4096 fields",
    };
    assert_eq!(registry.get(&name("t/L20")).unwrap_err(), too_many);
    registry
        .add(&name("t/Big"), "float64[4294967295] x")
        .unwrap();
    let too_big = DefinitionError::TooBig {
        name: name("t/Big"),
        what: "fixed arrays of more than 64 MiB",
    };
    assert_eq!(registry.get(&name("t/Big")).unwrap_err(), too_big);
}

const PEER: &str = "Header header\nmine/Thing[] things\n\n\
    ================================================================================\nMSG: std_msgs/Header\n\
    uint32 seq\ntime stamp\nstring frame_id\n\n\
    ================================================================================\nMSG: mine/Thing\nint32 MAX=7\nuint16 id\n";

#[test]
fn a_connection_header_brings_its_own_definition() {
    let mut registry = Registry::bundle(Dialect::Ros1);
    let found = registry
        .add_ros1_definition(&name("mine/Things"), PEER)
        .unwrap();
    let paths: Vec<_> = found
        .leaves()
        .iter()
        .map(|leaf| leaf.path.as_str())
        .collect();
    assert_eq!(paths, ["header.stamp", "header.frame_id", "things"]);
    assert_eq!(found.definition(), PEER);
    let known = registry.get(&name("mine/Things")).unwrap();
    assert_eq!(known.md5(), found.md5());
    assert_eq!(registry.get(&name("mine/Thing")).unwrap().leaves().len(), 1);
}

#[test]
fn a_peer_cannot_replace_a_definition() {
    let mut registry = Registry::bundle(Dialect::Ros1);
    let before = registry.get(&name("geometry_msgs/Point")).unwrap();
    let found = registry
        .add_ros1_definition(&name("geometry_msgs/Point"), "float32 x\n")
        .unwrap();
    assert_eq!(found.leaves().len(), 1);
    assert_eq!(
        registry.get(&name("geometry_msgs/Point")).unwrap().md5(),
        before.md5()
    );
    registry
        .add(&name("geometry_msgs/Point"), "float32 x\n")
        .unwrap();
    assert_eq!(
        registry.get(&name("geometry_msgs/Point")).unwrap().md5(),
        found.md5()
    );
}

#[test]
fn a_broken_connection_header_is_refused_and_leaves_nothing_behind() {
    let mut registry = Registry::empty(Dialect::Ros1);
    let rule = "=".repeat(80);
    for text in [
        format!("int8 x\n{rule}\nno heading\nint8 y\n"),
        format!("int8 x\n{rule}\nMSG: not a name\nint8 y\n"),
        format!("mine/Missing x\n{rule}\nMSG: mine/Other\nint8 y\n"),
        format!("int8 x\n{rule}\nMSG: mine/Other\nint8[99999999999999999999] y\n"),
    ] {
        assert!(
            registry
                .add_ros1_definition(&name("mine/T"), &text)
                .is_err(),
            "{text}"
        );
        assert_eq!(registry.names().count(), 0, "{text}");
    }
    assert!(
        registry
            .add_ros1_definition(&name("mine/T"), &format!("int8 x\n{rule}"))
            .is_ok()
    );
}

#[test]
fn a_wrong_path_lists_the_paths_there_are() {
    let found = Registry::bundle(Dialect::Ros1)
        .get(&name("geometry_msgs/Vector3"))
        .unwrap();
    let error = Plan::compile(&found, &Selection::Field("X".to_owned()), Wire::Ros1).unwrap_err();
    assert_eq!(
        error.to_string(),
        "`geometry_msgs/Vector3` has no field `X`; it has x, y, z"
    );
    let error = Plan::compile(&found, &Selection::Whole, Wire::Cdr).unwrap_err();
    assert_eq!(
        error,
        PlanError::Wire {
            name: found.name().clone()
        }
    );
}

#[test]
fn an_array_of_messages_without_bytes_is_refused_on_ros_1_and_counted_in_cdr() {
    let ros1 = message(Dialect::Ros1, "std_msgs/Empty[] nothings");
    let error = Plan::compile(&ros1, &Selection::Whole, Wire::Ros1).unwrap_err();
    assert_eq!(
        error,
        PlanError::EmptyElements {
            name: name("std_msgs/Empty")
        }
    );
    let ros2 = plan(Dialect::Ros2, "std_msgs/Empty[] nothings");
    let events = read(&ros2, &[0, 1, 0, 0, 2, 0, 0, 0, 9, 9]).unwrap();
    assert_eq!(
        events,
        [
            "structures std_msgs/Empty 2",
            "begin std_msgs/Empty",
            "end",
            "begin std_msgs/Empty",
            "end"
        ]
    );
}

#[test]
fn an_empty_message_is_no_byte_on_ros_1_and_one_in_cdr() {
    assert_eq!(write(&plan(Dialect::Ros1, ""), &[]).unwrap(), []);
    assert_eq!(
        write(&plan(Dialect::Ros2, ""), &[]).unwrap(),
        [0, 1, 0, 0, 0, 0, 0, 0]
    );
    assert_eq!(
        read(&plan(Dialect::Ros2, ""), &[0, 1, 0, 0, 0]).unwrap(),
        [""; 0]
    );
    assert!(read(&plan(Dialect::Ros2, ""), &[0, 1, 0, 0]).is_err());
}

#[test]
fn the_sequence_number_of_a_header_is_skipped_and_written_as_zero() {
    let plan = plan(Dialect::Ros1, "Header header\nbool last");
    let payload = [7, 0, 0, 0, 1, 0, 0, 0, 200, 0, 0, 0, 1, 0, 0, 0, b'm', 2];
    assert_eq!(
        read(&plan, &payload).unwrap(),
        [
            "scalar DateTime 116444736010000002",
            "scalar String m",
            "scalar Boolean true"
        ]
    );
    let mut recorder = Recorder::default();
    plan.read(&payload, &mut recorder).unwrap();
    assert_eq!(
        write(&plan, &recorder.events).unwrap(),
        [0, 0, 0, 0, 1, 0, 0, 0, 200, 0, 0, 0, 1, 0, 0, 0, b'm', 1]
    );
}

#[test]
fn booleans_of_an_array_become_zero_or_one() {
    let plan = plan(Dialect::Ros1, "bool[3] flags");
    assert_eq!(
        read(&plan, &[0, 2, 255]).unwrap(),
        ["packed Boolean 3 false true true"]
    );
    assert_eq!(
        write(
            &plan,
            &[Event::Packed(BuiltinType::Boolean, 3, vec![0, 1, 9])]
        )
        .unwrap(),
        [0, 1, 1]
    );
}

#[test]
fn a_wide_string_is_utf_16_in_words_of_four_bytes() {
    let plan = plan(Dialect::Ros2, "int8 a\nwstring w\nint8 b");
    let little = [
        0, 1, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 0xE9, 0, 0, 0, 0x3E, 0xD8, 0, 0, 0x16, 0xDD, 0, 0, 2,
        0, 0, 0,
    ];
    assert_eq!(
        read(&plan, &little).unwrap(),
        ["scalar SByte 1", "scalar String é🤖", "scalar SByte 2"]
    );
    let mut recorder = Recorder::default();
    plan.read(&little, &mut recorder).unwrap();
    assert_eq!(write(&plan, &recorder.events).unwrap(), little);
    let big = [0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0xE9, 2];
    assert_eq!(
        read(&plan, &big).unwrap(),
        ["scalar SByte 1", "scalar String é", "scalar SByte 2"]
    );
    let alone = [0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0x3E, 0xD8, 0, 0, 2];
    assert_eq!(fault(read(&plan, &alone)), Fault::Text);
}

fn fault(result: Result<Vec<String>, ReadError<()>>) -> Fault {
    match result {
        Err(ReadError::Malformed { fault, .. }) => fault,
        other => unreachable!("{other:?}"),
    }
}

#[test]
fn texts_that_are_not_valid_are_refused() {
    assert_eq!(
        fault(read(&plan(Dialect::Ros1, "string s"), &[1, 0, 0, 0, 0xFF])),
        Fault::Text
    );
    let cdr = plan(Dialect::Ros2, "string<=2 s");
    assert_eq!(
        fault(read(&cdr, &[0, 1, 0, 0, 1, 0, 0, 0, b'a'])),
        Fault::Terminator
    );
    assert_eq!(
        fault(read(&cdr, &[0, 1, 0, 0, 4, 0, 0, 0, b'a', b'b', b'c', 0])),
        Fault::Bound { bound: 2, found: 3 }
    );
    assert_eq!(
        read(&cdr, &[0, 1, 0, 0, 3, 0, 0, 0, b'a', b'b', 0]).unwrap(),
        ["scalar String ab"]
    );
    assert_eq!(
        read(&cdr, &[0, 1, 0, 0, 0, 0, 0, 0]).unwrap(),
        ["scalar String "]
    );
    let bounded = plan(Dialect::Ros2, "int8[<=1] few");
    assert_eq!(
        fault(read(&bounded, &[0, 1, 0, 0, 2, 0, 0, 0, 1, 1])),
        Fault::Bound { bound: 1, found: 2 }
    );
}

#[test]
fn a_cdr_of_another_representation_is_refused_by_its_number() {
    let plan = plan(Dialect::Ros2, "int8 x");
    for (identifier, low) in [(3, 3), (7, 7), (0x0A, 0x0A)] {
        let error = ReadError::Malformed {
            field: String::new(),
            at: 0,
            fault: Fault::Encapsulation(identifier),
        };
        assert_eq!(read(&plan, &[0, low, 0, 0, 1]), Err(error));
    }
    assert_eq!(fault(read(&plan, &[0, 1])), Fault::Truncated);
}

#[test]
fn an_error_names_the_field_and_the_byte() {
    let plan = plan(
        Dialect::Ros2,
        "geometry_msgs/Point[] points\nstd_msgs/String text",
    );
    let payload = [0, 1, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, b'a', 0];
    assert_eq!(
        read(&plan, &payload).unwrap_err().to_string(),
        "field `text.data`: the message ends too early (byte 12)"
    );
}

#[test]
fn values_that_do_not_fit_are_refused_and_nothing_is_appended() {
    let before_1970 = scalar(Scalar::DateTime(DateTime(116_444_735_999_999_999)));
    let after_2106 = scalar(Scalar::DateTime(DateTime(200_000_000_000_000_000)));
    let time = plan(Dialect::Ros1, "time t");
    let duration = plan(Dialect::Ros1, "duration d");
    let text = plan(Dialect::Ros2, "string s");
    let fixed = plan(Dialect::Ros1, "float32[3] axes");
    let bytes = plan(Dialect::Ros1, "uint8[2] id");
    let cases = [
        (&time, before_1970, WriteFault::Time),
        (&time, after_2106, WriteFault::Time),
        (
            &duration,
            scalar(Scalar::Double(f64::NAN)),
            WriteFault::Duration,
        ),
        (
            &duration,
            scalar(Scalar::Double(2_147_483_648_000.0)),
            WriteFault::Duration,
        ),
        (&text, scalar(Scalar::String(Some("a\0b"))), WriteFault::Nul),
        (
            &fixed,
            Event::Packed(BuiltinType::Float, 2, vec![0; 8]),
            WriteFault::Length {
                expected: 3,
                found: 2,
            },
        ),
        (
            &bytes,
            scalar(Scalar::ByteString(Some(&[1]))),
            WriteFault::Length {
                expected: 2,
                found: 1,
            },
        ),
        (
            &fixed,
            Event::Packed(BuiltinType::Float, 3, vec![0; 8]),
            WriteFault::Source(SourceError::Malformed("3 elements in 8 bytes".to_owned())),
        ),
    ];
    for (plan, event, fault) in cases {
        let mut out = vec![1, 2, 3];
        let field = plan.leaves().first().unwrap().path.clone();
        let done = plan.write(&mut Player::new(&[event]), &mut out);
        assert_eq!(done, Err(WriteError { field, fault }));
        assert_eq!(out, [1, 2, 3]);
    }
}

#[test]
fn a_field_too_few_or_too_many_is_refused() {
    let plan = plan(Dialect::Ros1, "int8 a\nint8 b");
    let one = scalar(Scalar::SByte(1));
    let missing = WriteError {
        field: "b".to_owned(),
        fault: WriteFault::Source(SourceError::Missing),
    };
    assert_eq!(write(&plan, std::slice::from_ref(&one)), Err(missing));
    let left = WriteError {
        field: String::new(),
        fault: WriteFault::Source(SourceError::LeftOver(1)),
    };
    assert_eq!(write(&plan, &[one.clone(), one.clone(), one]), Err(left));
}

#[test]
fn the_null_time_and_null_texts_are_zero_and_empty() {
    let plan = plan(Dialect::Ros1, "time t\nstring s");
    let events = [
        scalar(Scalar::DateTime(DateTime(0))),
        scalar(Scalar::String(None)),
    ];
    assert_eq!(write(&plan, &events).unwrap(), [0; 12]);
}

#[test]
fn messages_within_elements_are_inline_and_their_arrays_counted() {
    let registry = registry(
        Dialect::Ros1,
        &[
            ("t/Row", "uint8 id\nPair[] pairs"),
            ("t/Pair", "int8 a\nstd_msgs/Int8 b"),
            ("t/T", "Row[] rows"),
        ],
    );
    let plan = Plan::compile(
        &registry.get(&name("t/T")).unwrap(),
        &Selection::Whole,
        Wire::Ros1,
    )
    .unwrap();
    let payload = [1, 0, 0, 0, 5, 2, 0, 0, 0, 1, 2, 3, 4];
    let wanted = [
        "structures t/Row 1",
        "begin t/Row",
        "scalar Byte 5",
        "array ExtensionObject 2",
        "scalar SByte 1",
        "scalar SByte 2",
        "scalar SByte 3",
        "scalar SByte 4",
        "end",
    ];
    assert_eq!(read(&plan, &payload).unwrap(), wanted);
}

#[test]
fn a_ros_2_time_as_a_topic_is_one_date_time() {
    let registry = Registry::bundle(Dialect::Ros2);
    let time = registry
        .standard_type(BuiltinType::DateTime, false)
        .unwrap();
    let plan = Plan::compile(&registry.get(&time).unwrap(), &Selection::Whole, Wire::Cdr).unwrap();
    let payload = [0, 1, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0];
    assert_eq!(
        read(&plan, &payload).unwrap(),
        ["scalar DateTime 116444735990000000"]
    );
    assert_eq!(plan.leaves().first().unwrap().path, "data");
}

#[test]
fn every_standard_type_holds_its_builtin_type_alone() {
    for dialect in [Dialect::Ros1, Dialect::Ros2] {
        let registry = Registry::bundle(dialect);
        let mut found = 0;
        for builtin in (1..=25).filter_map(BuiltinType::from_id) {
            assert_eq!(standard_type(builtin, true), None);
            let Some(standard) = registry.standard_type(builtin, false) else {
                continue;
            };
            let leaves = registry.get(&standard).unwrap().leaves().to_vec();
            assert_eq!(
                leaves,
                [Leaf {
                    path: "data".to_owned(),
                    builtin,
                    rank: Rank::Scalar
                }],
                "{standard}"
            );
            found += 1;
        }
        assert_eq!(found, 13);
    }
    assert_eq!(
        standard_type(BuiltinType::DateTime, false),
        Some(name("std_msgs/Time"))
    );
}
