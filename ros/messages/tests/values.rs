//! Bytes that are read as documented, and values and bytes that do not fit.
use crate::support;

use std::collections::BTreeMap;
use std::sync::Arc;

use messages::{
    Dialect, Leaf, Literal, MessageFault, MessagePlan, MessageType, ReadError, Selected, Selection,
    SourceError, TypeName, TypeRegistry, Wire, WriteError, WriteFault,
};
use support::{EventPlayer, RecordedEvent, RecordedValue, Recorder};
use uadp::{BuiltinType, DateTime, Scalar};

fn name(text: &str) -> TypeName {
    text.parse().unwrap()
}

fn registry(dialect: Dialect, definitions: &[(&str, &str)]) -> TypeRegistry {
    let mut registry = TypeRegistry::bundle(dialect);
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

fn plan(dialect: Dialect, text: &str) -> MessagePlan {
    let wire = if dialect == Dialect::Ros1 {
        Wire::Ros1
    } else {
        Wire::Cdr
    };
    MessagePlan::compile(&message(dialect, text), &Selection::Whole, wire).unwrap()
}

fn read(plan: &MessagePlan, payload: &[u8]) -> Result<Vec<String>, ReadError<()>> {
    let mut recorder = Recorder::default();
    plan.read(payload, &mut recorder)?;
    Ok(recorder.events.iter().map(ToString::to_string).collect())
}

fn write(plan: &MessagePlan, events: &[RecordedEvent]) -> Result<Vec<u8>, WriteError> {
    let mut out = Vec::new();
    plan.write(&mut EventPlayer::new(events), &mut out)?;
    Ok(out)
}

fn scalar(value: Scalar<'_>) -> RecordedEvent {
    RecordedEvent::Scalar(RecordedValue::of(value))
}

#[test]
fn an_array_of_messages_without_fields_keeps_its_length() {
    let events = [
        "structures std_msgs/Empty 2",
        "begin std_msgs/Empty",
        "end",
        "begin std_msgs/Empty",
        "end",
    ];
    let ros1 = plan(Dialect::Ros1, "std_msgs/Empty[] nothings");
    assert_eq!(read(&ros1, &[2, 0, 0, 0]).unwrap(), events);
    let fixed = plan(Dialect::Ros1, "std_msgs/Empty[2] nothings");
    assert_eq!(read(&fixed, &[]).unwrap(), events);
    let ros2 = plan(Dialect::Ros2, "std_msgs/Empty[] nothings");
    let payload = [0, 1, 0, 0, 2, 0, 0, 0, 9, 9];
    assert_eq!(read(&ros2, &payload).unwrap(), events);
}

#[test]
fn elements_without_bytes_are_believed_up_to_a_number_all_arrays_together() {
    let plan = plan(
        Dialect::Ros1,
        "std_msgs/Empty[] nothings\nstd_msgs/Empty[] more",
    );
    let payload = |counts: [u32; 2]| counts.map(u32::to_le_bytes).concat();
    assert!(read(&plan, &payload([65_535, 1])).is_ok());
    for counts in [[u32::MAX, 0], [65_535, 2]] {
        let error = read(&plan, &payload(counts)).unwrap_err();
        let many = matches!(
            error,
            ReadError::Malformed {
                fault: MessageFault::WithoutBytes(_),
                ..
            }
        );
        assert!(many, "{error:?}");
    }
}

#[test]
fn an_empty_message_is_no_byte_on_ros_1_and_one_in_cdr() {
    assert!(write(&plan(Dialect::Ros1, ""), &[]).unwrap().is_empty());
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
            &[RecordedEvent::Packed(
                BuiltinType::Boolean,
                3,
                vec![0, 1, 9]
            )]
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
    assert_eq!(fault(read(&plan, &alone)), MessageFault::Text);
}

fn fault(result: Result<Vec<String>, ReadError<()>>) -> MessageFault {
    match result {
        Err(ReadError::Malformed { fault, .. }) => fault,
        other => unreachable!("{other:?}"),
    }
}

#[test]
fn texts_that_are_not_valid_are_refused() {
    assert_eq!(
        fault(read(&plan(Dialect::Ros1, "string s"), &[1, 0, 0, 0, 0xFF])),
        MessageFault::Text
    );
    let cdr = plan(Dialect::Ros2, "string<=2 s");
    assert_eq!(
        fault(read(&cdr, &[0, 1, 0, 0, 1, 0, 0, 0, b'a'])),
        MessageFault::Terminator
    );
    assert_eq!(
        fault(read(&cdr, &[0, 1, 0, 0, 4, 0, 0, 0, b'a', b'b', b'c', 0])),
        MessageFault::Bound { bound: 2, found: 3 }
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
        MessageFault::Bound { bound: 1, found: 2 }
    );
}

#[test]
fn a_cdr_of_another_representation_is_refused_by_its_number() {
    let plan = plan(Dialect::Ros2, "int8 x");
    for (identifier, low) in [(3, 3), (7, 7), (0x0A, 0x0A)] {
        let error = ReadError::Malformed {
            field: String::new(),
            at: 0,
            fault: MessageFault::Encapsulation(identifier),
        };
        assert_eq!(read(&plan, &[0, low, 0, 0, 1]), Err(error));
    }
    assert_eq!(fault(read(&plan, &[0, 1])), MessageFault::Truncated);
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

/// Returns seconds and nanoseconds, little endian.
fn clock(sec: i64, nanosec: u32) -> Vec<u8> {
    let [a, b, c, d, ..] = sec.to_le_bytes();
    [[a, b, c, d], nanosec.to_le_bytes()].concat()
}

#[test]
fn the_longest_shortest_and_negative_durations_and_times_of_each_ros_reach_the_other() {
    let (most, least) = (i64::from(i32::MAX), i64::from(i32::MIN));
    let unsigned = i64::from(u32::MAX);
    let ros1 = |payload: Vec<u8>| (Dialect::Ros1, payload);
    let ros2 = |payload: Vec<u8>| (Dialect::Ros2, payload);
    let longest = clock(most, 999_999_999);
    let shortest = clock(least, 0);
    let latest = |sec| clock(sec, 999_999_900);
    let cases = [
        ("duration", ros1(longest.clone()), longest.clone()),
        ("duration", ros2(longest.clone()), longest.clone()),
        ("duration", ros1(shortest.clone()), shortest.clone()),
        ("duration", ros2(shortest.clone()), shortest),
        (
            "duration",
            ros1(clock(-1, 500_000_000)),
            clock(-1, 500_000_000),
        ),
        // ROS 1 has signed nanoseconds; in neither ROS version should they reach a second.
        ("duration", ros1(clock(0, u32::MAX)), clock(-1, 999_999_999)),
        ("duration", ros2(clock(most, u32::MAX)), longest),
        ("time", ros1(clock(unsigned, 999_999_999)), latest(most)),
        ("time", ros2(clock(most, 999_999_999)), latest(most)),
        ("time", ros2(clock(-1, 500_000_000)), clock(0, 0)),
        ("time", ros2(clock(least, 0)), clock(0, 0)),
        ("time", ros1(clock(most, u32::MAX)), latest(most)),
    ];
    let of = |dialect, name: &str| match (dialect, name) {
        (Dialect::Ros1, name) => plan(Dialect::Ros1, &format!("{name} value")),
        (_, "time") => plan(Dialect::Ros2, "builtin_interfaces/Time value"),
        (..) => plan(Dialect::Ros2, "builtin_interfaces/Duration value"),
    };
    for (name, (from, payload), expected) in cases {
        let other = match from {
            Dialect::Ros1 => Dialect::Ros2,
            Dialect::Ros2 => Dialect::Ros1,
        };
        let head = |dialect| match dialect {
            Dialect::Ros1 => &[][..],
            Dialect::Ros2 => &[0, 1, 0, 0][..],
        };
        let payload = [head(from), &payload].concat();
        let mut recorder = Recorder::default();
        of(from, name).read(&payload, &mut recorder).unwrap();
        let written = write(&of(other, name), &recorder.events).unwrap();
        assert_eq!(
            written,
            [head(other), &expected].concat(),
            "{name} {from:?} {payload:?}"
        );
    }
}

#[test]
fn values_that_do_not_fit_are_refused_and_nothing_is_appended() {
    let duration = plan(Dialect::Ros1, "duration d");
    let text = plan(Dialect::Ros2, "string s");
    let fixed = plan(Dialect::Ros1, "float32[3] axes");
    let bytes = plan(Dialect::Ros1, "uint8[2] id");
    let cases = [
        (
            &duration,
            scalar(Scalar::Double(f64::NAN)),
            WriteFault::Duration,
        ),
        (
            &duration,
            scalar(Scalar::Double(2_147_483_648_001.0)),
            WriteFault::Duration,
        ),
        (&text, scalar(Scalar::String(Some("a\0b"))), WriteFault::Nul),
        (
            &fixed,
            RecordedEvent::Packed(BuiltinType::Float, 2, vec![0; 8]),
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
            RecordedEvent::Packed(BuiltinType::Float, 3, vec![0; 8]),
            WriteFault::Source(SourceError::Malformed("3 elements in 8 bytes".to_owned())),
        ),
    ];
    for (plan, event, fault) in cases {
        let mut out = vec![1, 2, 3];
        let field = plan.leaves().first().unwrap().path.clone();
        let done = plan.write(&mut EventPlayer::new(&[event]), &mut out);
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
    let plan = MessagePlan::compile(
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
    let registry = TypeRegistry::bundle(Dialect::Ros2);
    let time = registry
        .standard_type(BuiltinType::DateTime, false)
        .unwrap();
    let plan =
        MessagePlan::compile(&registry.get(&time).unwrap(), &Selection::Whole, Wire::Cdr).unwrap();
    let payload = [0, 1, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0];
    assert_eq!(
        read(&plan, &payload).unwrap(),
        ["scalar DateTime 116444735990000000"]
    );
    assert_eq!(plan.leaves().first().unwrap().path, "data");
}

#[test]
fn a_message_may_cross_as_it_is() {
    for (dialect, wire) in [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)] {
        let message = message(dialect, "bool b\nstring s");
        let plan = MessagePlan::compile(&message, &Selection::Bytes, wire).unwrap();
        assert_eq!(plan.leaves(), [Leaf::bytes()]);
        // Not a message of the type: the bytes are not checked.
        let payload = [9, 8, 7];
        assert_eq!(read(&plan, &payload).unwrap(), ["scalar ByteString 090807"]);
        let events = [scalar(Scalar::ByteString(Some(&payload)))];
        assert_eq!(write(&plan, &events).unwrap(), payload);
        let two = [events[0].clone(), events[0].clone()];
        assert_eq!(
            write(&plan, &two).unwrap_err().to_string(),
            "1 fields too many"
        );
        assert!(write(&plan, &[scalar(Scalar::Byte(1))]).is_err());
    }
}

fn template(field: Option<&str>, rest: &[(&str, Literal)]) -> Selection {
    let rest = rest.iter().cloned();
    Selection::Template {
        fields: field.map(Selected::whole).into_iter().collect(),
        rest: rest
            .map(|(path, literal)| (path.to_owned(), literal))
            .collect::<BTreeMap<_, _>>(),
    }
}

fn one(text: &str) -> Literal {
    Literal::One(text.to_owned())
}

fn list(texts: &[&str]) -> Literal {
    Literal::List(texts.iter().map(|&text| text.to_owned()).collect())
}

const REQUEST: &str = "int8 FORWARD=1\nint8 BACKWARD=-1\nuint8 id\nbool run\nint16 speed\nint8 direction\nstring note\n\
                       std_msgs/ColorRGBA colour\nuint8[3] key\nfloat32[] levels\nstring[] words\nduration wait\nbool[] flags";

#[test]
fn a_template_is_its_constants_with_the_value_in_its_place() {
    let message = message(Dialect::Ros1, REQUEST);
    let rest = [
        ("id", one("12")),
        ("speed", one("-2")),
        ("direction", one("BACKWARD")),
        ("note", one("ä")),
        ("colour.g", one("0.5")),
        ("key", list(&["1", "FORWARD", "0x03"])),
        ("levels", list(&["1", "2"])),
        ("words", list(&["a", ""])),
        ("wait", one("1.5s")),
        ("flags", list(&["true", "false"])),
    ];
    let wanted = |run: u8| {
        let mut bytes = vec![12, run, 0xFE, 0xFF, 0xFF, 2, 0, 0, 0, 0xC3, 0xA4];
        for colour in [0.0f32, 0.5, 0.0, 0.0] {
            bytes.extend(colour.to_le_bytes());
        }
        bytes.extend([1, 1, 3, 2, 0, 0, 0]);
        bytes.extend(1f32.to_le_bytes());
        bytes.extend(2f32.to_le_bytes());
        bytes.extend([2, 0, 0, 0, 1, 0, 0, 0, b'a', 0, 0, 0, 0]);
        bytes.extend([1, 0, 0, 0]);
        bytes.extend(500_000_000u32.to_le_bytes());
        bytes.extend([2, 0, 0, 0, 1, 0]);
        bytes
    };
    let plan = MessagePlan::compile(&message, &template(Some("run"), &rest), Wire::Ros1).unwrap();
    assert_eq!(plan.leaves().len(), 1);
    let written = write(&plan, &[scalar(Scalar::Boolean(true))]).unwrap();
    assert_eq!(written, wanted(1));
    assert_eq!(read(&plan, &written).unwrap(), ["scalar Boolean true"]);
    let constant = MessagePlan::compile(&message, &template(None, &rest), Wire::Ros1).unwrap();
    assert_eq!(constant.leaves(), []);
    assert_eq!(write(&constant, &[]).unwrap(), wanted(0));
    assert!(write(&constant, &[scalar(Scalar::Boolean(true))]).is_err());
    let empty = MessagePlan::compile(&message, &template(None, &[]), Wire::Ros1).unwrap();
    assert!(write(&empty, &[]).unwrap().iter().all(|byte| *byte == 0));
}

#[test]
fn a_template_is_aligned_in_cdr() {
    let message = message(Dialect::Ros2, "uint8 a\nstring s\nfloat64 x\nint32[] n");
    let rest = [("s", one("b")), ("n", list(&["-1"]))];
    let plan = MessagePlan::compile(&message, &template(Some("x"), &rest), Wire::Cdr).unwrap();
    let mut wanted = vec![
        0, 1, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, b'b', 0, 0, 0, 0, 0, 0, 0,
    ];
    wanted.extend(1f64.to_le_bytes());
    wanted.extend([1, 0, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF]);
    assert_eq!(
        write(&plan, &[scalar(Scalar::Double(1.0))]).unwrap(),
        wanted
    );
}

#[test]
fn a_constant_that_does_not_fit_its_field_is_told_with_what_would() {
    let ros1 = registry(
        Dialect::Ros1,
        &[(
            "t/T",
            &format!("{REQUEST}\ntime when\nstd_msgs/Header[] many"),
        )],
    );
    let message = ros1.get(&name("t/T")).unwrap();
    let [with, without] = [&[("many", list(&[]))][..], &[]].map(|rest| {
        let plan = MessagePlan::compile(&message, &template(None, rest), Wire::Ros1);
        write(&plan.unwrap(), &[]).unwrap()
    });
    assert_eq!(with, without, "no messages are none");
    for (path, literal, told) in [
        (
            "id",
            one("256"),
            "field `id` of `t/T`: `256` is not a number from 0 to 255 or one of FORWARD",
        ),
        (
            "direction",
            one("UP"),
            "`UP` is not a number from -128 to 127 or one of FORWARD, BACKWARD",
        ),
        (
            "run",
            one("on"),
            "`on` is not true or false or one of FORWARD",
        ),
        (
            "speed",
            list(&["1"]),
            "`a list` is not a number from -32768 to 32767",
        ),
        ("words", one("a"), "`a` is not a list, as [1, 2]"),
        (
            "key",
            list(&["1"]),
            "field `key` of `t/T`: 1 elements, but the type has 3",
        ),
        (
            "levels",
            list(&["1", "x"]),
            "`x` is not a number within the range of a float32",
        ),
        ("wait", one("5"), "`5` is not a duration with its unit"),
        ("when", one("5"), "a time cannot be a constant"),
        (
            "many",
            list(&["1"]),
            "[] is the only constant of an array of messages",
        ),
        (
            "colour",
            one("1"),
            "`t/T` has no field `colour`; it has id, run",
        ),
        (
            "note",
            one("x"),
            "field `note` of `t/T` takes the value, so it cannot be a constant",
        ),
    ] {
        let selection = template(Some("note"), &[(path, literal)]);
        let error = MessagePlan::compile(&message, &selection, Wire::Ros1).unwrap_err();
        assert!(error.to_string().contains(told), "{error}");
    }
}
