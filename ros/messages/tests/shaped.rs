//! Parts of arrays and converted values, in both wire formats.
use crate::support;

use messages::{
    ArrayPart, Conversion, Dialect, Literal, MessagePlan, MessageType, PlanError, ReadError,
    Selected, Selection, TypeRegistry, ValueFault, Wire, WriteFault,
};
use proptest::prelude::*;
use std::sync::Arc;
use support::{EventPlayer, RecordedEvent, RecordedValue, Recorder};
use uadp::{BuiltinType, Scalar};

const WIRES: [(Dialect, Wire); 2] = [(Dialect::Ros1, Wire::Ros1), (Dialect::Ros2, Wire::Cdr)];

fn message(dialect: Dialect, text: &str) -> Arc<MessageType> {
    let mut registry = TypeRegistry::bundle(dialect);
    let name = "test_msgs/T".parse().unwrap();
    registry.add(&name, text).unwrap();
    registry.get(&name).unwrap()
}

fn select(text: &str, conversion: Conversion) -> Selection {
    let (field, part) = ArrayPart::split(text).unwrap();
    Selection::Value {
        field: field.to_owned(),
        part,
        conversion,
    }
}

fn written(plan: &MessagePlan, events: &[RecordedEvent]) -> Vec<u8> {
    let mut out = Vec::new();
    plan.write(&mut EventPlayer::new(events), &mut out).unwrap();
    out
}

fn read(plan: &MessagePlan, payload: &[u8]) -> Result<Vec<String>, ReadError<()>> {
    let mut recorder = Recorder::default();
    plan.read(payload, &mut recorder)?;
    Ok(recorder.events.iter().map(ToString::to_string).collect())
}

fn scalar(value: Scalar<'_>) -> RecordedEvent {
    RecordedEvent::Scalar(RecordedValue::of(value))
}

fn text(text: &str) -> RecordedEvent {
    RecordedEvent::Element(RecordedValue::Text(text.to_owned()))
}

fn doubles(values: &[f64]) -> RecordedEvent {
    let bytes = values.iter().flat_map(|value| value.to_le_bytes());
    RecordedEvent::Packed(BuiltinType::Double, values.len(), bytes.collect())
}

/// Names before and after the values, as the order varies between messages.
const JOINTS: &str = "float64[] before\nstring[] name\nuint8 gap\nfloat64[] position\nbool[] on\nuint8[] raw\nduration[] late";

fn joints(dialect: Dialect, wire: Wire) -> (Arc<MessageType>, Vec<u8>) {
    let text_of = match dialect {
        Dialect::Ros1 => JOINTS.to_owned(),
        Dialect::Ros2 => JOINTS.replace("duration", "builtin_interfaces/Duration"),
    };
    let of = message(dialect, &text_of);
    let whole = MessagePlan::compile(&of, &Selection::Whole, wire).unwrap();
    let late = |millis| RecordedEvent::Element(RecordedValue::of(Scalar::Double(millis)));
    let events = [
        doubles(&[7.0, 8.0]),
        RecordedEvent::Array(BuiltinType::String, 3),
        text("joint_1"),
        text("joint_2"),
        text("joint_3"),
        scalar(Scalar::Byte(9)),
        doubles(&[0.25, 0.5, 0.75]),
        RecordedEvent::Packed(BuiltinType::Boolean, 2, vec![0, 1]),
        scalar(Scalar::ByteString(Some(&[1, 2, 3]))),
        RecordedEvent::Array(BuiltinType::Double, 2),
        late(1500.0),
        late(2500.0),
    ];
    let bytes = written(&whole, &events);
    (of, bytes)
}

#[test]
fn a_part_of_an_array_is_an_element_the_one_of_a_name_or_a_slice() {
    for (dialect, wire) in WIRES {
        let (of, bytes) = joints(dialect, wire);
        for (part, expected, builtin) in [
            ("position[2]", "scalar Double 0.75", BuiltinType::Double),
            (
                "position[name=joint_2]",
                "scalar Double 0.5",
                BuiltinType::Double,
            ),
            (
                "before[name=joint_1]",
                "scalar Double 7.0",
                BuiltinType::Double,
            ),
            (
                "position[0:2]",
                "packed Double 2 0.25 0.5",
                BuiltinType::Double,
            ),
            (
                "position[1:]",
                "packed Double 2 0.5 0.75",
                BuiltinType::Double,
            ),
            (
                "position[2:90]",
                "packed Double 1 0.75",
                BuiltinType::Double,
            ),
            ("position[5:9]", "packed Double 0", BuiltinType::Double),
            ("name[1]", "scalar String joint_2", BuiltinType::String),
            ("on[1]", "scalar Boolean true", BuiltinType::Boolean),
            ("raw[1]", "scalar Byte 2", BuiltinType::Byte),
            (
                "raw[1:3]",
                "scalar ByteString 0203",
                BuiltinType::ByteString,
            ),
            ("late[1]", "scalar Double 2500.0", BuiltinType::Double),
        ] {
            let plan =
                MessagePlan::compile(&of, &select(part, Conversion::default()), wire).unwrap();
            assert_eq!(read(&plan, &bytes).unwrap(), [expected], "{part} {wire:?}");
            let [leaf] = plan.leaves() else {
                unreachable!("{part} is one field")
            };
            assert_eq!((leaf.builtin, leaf.path.as_str()), (builtin, part));
        }
        let names =
            MessagePlan::compile(&of, &select("name[1:3]", Conversion::default()), wire).unwrap();
        assert_eq!(
            read(&names, &bytes).unwrap(),
            [
                "array String 2",
                "element String joint_2",
                "element String joint_3"
            ]
        );
    }
}

#[test]
fn what_a_message_has_not_is_told_with_its_field() {
    for (dialect, wire) in WIRES {
        let (of, bytes) = joints(dialect, wire);
        let fault = |part: &str| {
            let plan =
                MessagePlan::compile(&of, &select(part, Conversion::default()), wire).unwrap();
            read(&plan, &bytes).unwrap_err().to_string()
        };
        assert_eq!(
            fault("position[3]"),
            "field `position`: element 3 does not exist: the array has 3 elements"
        );
        assert_eq!(
            fault("name[7]"),
            "field `name`: element 7 does not exist: the array has 3 elements"
        );
        assert_eq!(
            fault("position[name=elbow]"),
            "field `position`: no element has the name `elbow`"
        );
        let cut = &bytes[..bytes.len() / 2];
        let plan =
            MessagePlan::compile(&of, &select("late[0]", Conversion::default()), wire).unwrap();
        assert!(matches!(read(&plan, cut), Err(ReadError::Malformed { .. })));
    }
}

#[test]
fn a_part_that_is_none_of_its_type_is_refused_when_compiled() {
    let of = message(
        Dialect::Ros1,
        "float64[3] fixed\nfloat64 one\nstring[] name\ngeometry_msgs/Point[] points",
    );
    for part in [
        "one[0]",
        "fixed[3]",
        "fixed[one=a]",
        "points[0]",
        "gone[0]",
        "fixed[gone=a]",
    ] {
        let refused = MessagePlan::compile(&of, &select(part, Conversion::default()), Wire::Ros1);
        let refused = refused.map(|plan| plan.leaves().to_vec());
        assert!(
            matches!(
                refused,
                Err(PlanError::Shape { .. } | PlanError::UnknownField { .. })
            ),
            "{part}: {refused:?}"
        );
    }
    for text in [
        "a[",
        "a]",
        "a[]",
        "a[-1]",
        "a[1:1]",
        "a[2:1]",
        "a[x=]",
        "a[=x]",
        "a[1]b",
        "a[+1]",
        "a[4294967296]",
    ] {
        assert_eq!(ArrayPart::split(text), None, "{text}");
    }
}

#[test]
fn a_part_is_not_written() {
    let of = message(Dialect::Ros1, "float64[] x");
    let plan =
        MessagePlan::compile(&of, &select("x[0]", Conversion::default()), Wire::Ros1).unwrap();
    let mut out = Vec::new();
    let error = plan.write(&mut EventPlayer::new(&[doubles(&[1.0])]), &mut out);
    assert_eq!(error.unwrap_err().fault, WriteFault::Part);
    assert!(out.is_empty());
}

#[test]
fn a_converted_value_crosses_both_ways_and_what_does_not_fit_does_not() {
    for (dialect, wire) in WIRES {
        let of = message(dialect, "uint8 first\nint16 raw\nbool open\nint16[] many");
        let scaled = Conversion::default()
            .scaled(0.1, -5.0)
            .to(BuiltinType::Double);
        let plan = MessagePlan::compile(&of, &select("raw", scaled), wire).unwrap();
        let bytes = written(&plan, &[scalar(Scalar::Double(18.0))]);
        let raw = MessagePlan::compile(&of, &Selection::Field("raw".to_owned()), wire).unwrap();
        assert_eq!(read(&raw, &bytes).unwrap(), ["scalar Int16 230"]);
        assert_eq!(read(&plan, &bytes).unwrap(), ["scalar Double 18.0"]);
        let mut out = vec![1];
        let refused = plan.write(
            &mut EventPlayer::new(&[scalar(Scalar::Double(1e6))]),
            &mut out,
        );
        assert_eq!(
            refused.unwrap_err().to_string(),
            "field `raw`: 10000050 does not fit Int16"
        );
        assert_eq!(out, [1]);

        let inverted = select("open", Conversion::default().inverted());
        let inverted = MessagePlan::compile(&of, &inverted, wire).unwrap();
        let bytes = written(&inverted, &[scalar(Scalar::Boolean(false))]);
        let open = MessagePlan::compile(&of, &Selection::Field("open".to_owned()), wire).unwrap();
        assert_eq!(read(&open, &bytes).unwrap(), ["scalar Boolean true"]);
        assert_eq!(read(&inverted, &bytes).unwrap(), ["scalar Boolean false"]);

        let many = MessagePlan::compile(&of, &select("many", scaled), wire).unwrap();
        let element = |value| RecordedEvent::Element(RecordedValue::of(Scalar::Double(value)));
        let events = [
            RecordedEvent::Array(BuiltinType::Double, 2),
            element(-5.0),
            element(0.5),
        ];
        let bytes = written(&many, &events);
        let whole = MessagePlan::compile(&of, &Selection::Field("many".to_owned()), wire).unwrap();
        assert_eq!(read(&whole, &bytes).unwrap(), ["packed Int16 2 0 55"]);
        assert_eq!(
            read(&many, &bytes).unwrap(),
            [
                "array Double 2",
                "element Double -5.0",
                "element Double 0.5"
            ]
        );
        let slice = MessagePlan::compile(&of, &select("many[1:]", scaled), wire).unwrap();
        assert_eq!(
            read(&slice, &bytes).unwrap(),
            ["array Double 1", "element Double 0.5"]
        );
    }
}

#[test]
fn a_value_out_of_range_is_named_with_its_field() {
    let of = message(Dialect::Ros1, "float64 x");
    let to = Conversion::default().to(BuiltinType::Byte);
    let plan = MessagePlan::compile(&of, &select("x", to), Wire::Ros1).unwrap();
    let fault = ValueFault::OutOfRange {
        value: "300".to_owned(),
        to: BuiltinType::Byte,
    };
    let field = "x".to_owned();
    assert_eq!(
        read(&plan, &300f64.to_le_bytes()),
        Err(ReadError::Value { field, fault })
    );
    let plan = MessagePlan::compile(&of, &select("x", to.clamped()), Wire::Ros1).unwrap();
    assert_eq!(
        read(&plan, &300f64.to_le_bytes()).unwrap(),
        ["scalar Byte 255"]
    );
}

proptest! {
    #[test]
    fn an_element_is_what_stands_there_in_the_whole(values in proptest::collection::vec(any::<i32>(), 0..20), at in 0u32..24) {
        for (dialect, wire) in WIRES {
            let of = message(dialect, "bool odd\nint32[] x\nuint8 after");
            let whole = MessagePlan::compile(&of, &Selection::Field("x".to_owned()), wire).unwrap();
            let bytes = values.iter().flat_map(|value| value.to_le_bytes()).collect();
            let bytes = written(&whole, &[RecordedEvent::Packed(BuiltinType::Int32, values.len(), bytes)]);
            let plan = MessagePlan::compile(&of, &select(&format!("x[{at}]"), Conversion::default()), wire).unwrap();
            let expected = values.get(at as usize).map(|value| vec![format!("scalar Int32 {value}")]);
            prop_assert_eq!(read(&plan, &bytes).ok(), expected);
            let slice = MessagePlan::compile(&of, &select(&format!("x[3:{}]", at + 4), Conversion::default()), wire).unwrap();
            let picked: Vec<String> = values.iter().skip(3).take(at as usize + 1).map(ToString::to_string).collect();
            let expected = [vec![format!("packed Int32 {}", picked.len())], picked].concat().join(" ");
            prop_assert_eq!(read(&slice, &bytes).unwrap(), [expected]);
        }
    }
}

fn selected(text: &str, conversion: Conversion) -> Selected {
    let (field, part) = ArrayPart::split(text).unwrap();
    Selected {
        field: field.to_owned(),
        part,
        conversion,
    }
}

#[test]
fn several_fields_cross_in_the_order_given_with_their_parts_and_conversions() {
    for (dialect, wire) in WIRES {
        let (of, bytes) = joints(dialect, wire);
        let none = Conversion::default();
        let fields = vec![
            selected("late", none),
            selected("position[name=joint_3]", none.scaled(1000.0, 1.0)),
            selected("gap", none),
        ];
        let plan = MessagePlan::compile(&of, &Selection::Fields(fields), wire).unwrap();
        let paths: Vec<&str> = plan
            .leaves()
            .iter()
            .map(|leaf| leaf.path.as_str())
            .collect();
        assert_eq!(paths, ["late", "position[name=joint_3]", "gap"]);
        assert_eq!(
            read(&plan, &bytes).unwrap(),
            [
                "array Double 2",
                "element Double 1500.0",
                "element Double 2500.0",
                "scalar Double 751.0",
                "scalar Byte 9"
            ]
        );
        let refused = plan.write(&mut EventPlayer::new(&[]), &mut Vec::new());
        assert_eq!(refused.unwrap_err().fault, WriteFault::Part);
    }
}

#[test]
fn several_fields_are_written_between_zeros_and_each_is_converted_by_its_own() {
    let text_of = "float64 a\nint32[] b\nstring c\ngeometry_msgs/Point d\nint16 e";
    for (dialect, wire) in WIRES {
        let of = message(dialect, text_of);
        let none = Conversion::default();
        let plan =
            |fields: Vec<Selected>| MessagePlan::compile(&of, &Selection::Fields(fields), wire);
        let fields = vec![
            selected("b", none.scaled(10.0, 0.0)),
            selected("d", none),
            selected("e", none.to(BuiltinType::Double)),
        ];
        let whole = MessagePlan::compile(&of, &Selection::Whole, wire).unwrap();
        let some = plan(fields).unwrap();
        let real = |value| RecordedEvent::Scalar(RecordedValue::of(Scalar::Double(value)));
        let whole_number = |value| RecordedEvent::Element(RecordedValue::of(Scalar::Int32(value)));
        let events = [
            RecordedEvent::Array(BuiltinType::Int32, 2),
            whole_number(20),
            whole_number(-30),
            real(1.0),
            real(2.0),
            real(3.0),
            real(7.0),
        ];
        let bytes = written(&some, &events);
        assert_eq!(
            read(&whole, &bytes).unwrap(),
            [
                "scalar Double 0.0",
                "packed Int32 2 2 -3",
                "scalar String ",
                "scalar Double 1.0",
                "scalar Double 2.0",
                "scalar Double 3.0",
                "scalar Int16 7"
            ]
        );
        let back = read(&some, &bytes).unwrap();
        assert_eq!(back.len(), events.len());
        assert_eq!(
            back[0..3],
            ["array Int32 2", "element Int32 20", "element Int32 -30"]
        );

        let turned = plan(vec![selected("d", none), selected("a", none)]).unwrap();
        let refused = turned.write(&mut EventPlayer::new(&[]), &mut Vec::new());
        assert_eq!(refused.unwrap_err().fault, WriteFault::Order);
        assert!(plan(vec![selected("x", none)]).is_err());
    }
}

#[test]
fn values_of_a_template_are_converted_between_its_constants() {
    let text = "uint8 id\nbool open\nint16 speed\nstring note\nfloat32[] levels";
    for (dialect, wire) in WIRES {
        let message = message(dialect, text);
        let one = |text: &str| Literal::One(text.to_owned());
        let rest = [("id", one("12")), ("note", one("by hand"))];
        let template = |fields: Vec<Selected>| Selection::Template {
            fields,
            rest: rest
                .clone()
                .map(|(path, value)| (path.to_owned(), value))
                .into(),
        };
        let tenths = Conversion::default()
            .scaled(0.1, 0.0)
            .to(BuiltinType::Double);
        let fields = vec![
            selected("open", Conversion::default().inverted()),
            selected("speed", tenths),
            selected("levels", Conversion::default().scaled(2.0, 0.0)),
        ];
        let plan = MessagePlan::compile(&message, &template(fields.clone()), wire).unwrap();
        let outside: Vec<BuiltinType> = plan.leaves().iter().map(|leaf| leaf.builtin).collect();
        assert_eq!(
            outside,
            [
                BuiltinType::Boolean,
                BuiltinType::Double,
                BuiltinType::Float
            ]
        );
        let events = [
            scalar(Scalar::Boolean(false)),
            scalar(Scalar::Double(-20.04)),
            RecordedEvent::Array(BuiltinType::Float, 1),
            RecordedEvent::Element(RecordedValue::of(Scalar::Float(3.0))),
        ];
        let bytes = written(&plan, &events);
        let whole = MessagePlan::compile(&message, &Selection::Whole, wire).unwrap();
        assert_eq!(
            read(&whole, &bytes).unwrap()[..4],
            [
                "scalar Byte 12",
                "scalar Boolean true",
                "scalar Int16 -200",
                "scalar String by hand"
            ]
        );
        assert_eq!(read(&plan, &bytes).unwrap()[0], "scalar Boolean false");
        let big = [
            scalar(Scalar::Boolean(false)),
            scalar(Scalar::Double(4000.0)),
        ];
        let error = plan
            .write(&mut EventPlayer::new(&big), &mut Vec::new())
            .unwrap_err();
        assert_eq!(error.to_string(), "field `speed`: 40000 does not fit Int16");
        let twice = template(vec![selected("id", Conversion::default())]);
        let error = MessagePlan::compile(&message, &twice, wire).unwrap_err();
        assert!(
            matches!(error, PlanError::ConstantOfField { .. }),
            "{error}"
        );
        let part = vec![selected("levels[0]", Conversion::default())];
        let plan = MessagePlan::compile(&message, &template(part), wire).unwrap();
        let one = [scalar(Scalar::Float(1.0))];
        let error = plan
            .write(&mut EventPlayer::new(&one), &mut Vec::new())
            .unwrap_err();
        assert_eq!(error.fault, WriteFault::Part);
    }
}

#[test]
fn a_part_behind_the_end_of_an_array_of_bytes_of_one_length_is_refused() {
    let text = "uint8[16] uuid\nunique_identifier_msgs/UUID goal\nuint8[] any";
    let message = message(Dialect::Ros2, text);
    let compiled = |field: &str| {
        let selection = select(field, Conversion::default());
        MessagePlan::compile(&message, &selection, Wire::Cdr).map(|_| ())
    };
    for field in [
        "uuid[15]",
        "uuid[15:]",
        "uuid[0:20]",
        "goal.uuid[15]",
        "any[20]",
    ] {
        assert_eq!(compiled(field), Ok(()), "{field}");
    }
    for field in ["uuid[16]", "uuid[16:]", "goal.uuid[16]", "goal.uuid[20:30]"] {
        let error = compiled(field).unwrap_err().to_string();
        assert!(
            error.ends_with("always has fewer elements"),
            "{field}: {error}"
        );
    }
}

#[test]
fn a_message_is_one_structure_with_the_messages_in_it_inline() {
    for (dialect, wire) in WIRES {
        let name = "geometry_msgs/Polygon".parse().unwrap();
        let of = TypeRegistry::bundle(dialect).get(&name).unwrap();
        let plan = MessagePlan::compile(&of, &Selection::Structure(None), wire).unwrap();
        let point = |values: [f32; 3]| values.map(|value| scalar(Scalar::Float(value)));
        let mut events = vec![
            RecordedEvent::Begin("geometry_msgs/Polygon".to_owned()),
            RecordedEvent::Array(BuiltinType::ExtensionObject, 2),
        ];
        events.extend(point([1.0, 2.0, 3.0]));
        events.extend(point([4.0, 5.0, 6.0]));
        events.push(RecordedEvent::End);
        let bytes = written(&plan, &events);
        let expected: Vec<String> = events.iter().map(ToString::to_string).collect();
        assert_eq!(read(&plan, &bytes).unwrap(), expected);
        let leaf = &plan.leaves()[0];
        assert_eq!(leaf.builtin, BuiltinType::ExtensionObject);
    }
    let stamped = "geometry_msgs/PointStamped".parse().unwrap();
    let of = TypeRegistry::bundle(Dialect::Ros2).get(&stamped).unwrap();
    let compile = |path: &str| {
        let selection = Selection::Structure(Some(path.to_owned()));
        MessagePlan::compile(&of, &selection, Wire::Cdr)
    };
    assert_eq!(compile("point").unwrap().leaves()[0].path, "point");
    assert!(matches!(
        compile("header.frame_id"),
        Err(PlanError::Shape { .. })
    ));
    assert!(matches!(
        compile("nothing"),
        Err(PlanError::UnknownField { .. })
    ));
}

#[test]
fn a_field_of_one_message_of_an_array_is_found_by_place_and_by_name() {
    let text_of = "int32 before\ndiagnostic_msgs/DiagnosticStatus[] status\nint32 after";
    let level = |dialect| match dialect {
        Dialect::Ros1 => Scalar::SByte(2),
        Dialect::Ros2 => Scalar::Byte(2),
    };
    let zero = |dialect| match dialect {
        Dialect::Ros1 => Scalar::SByte(0),
        Dialect::Ros2 => Scalar::Byte(0),
    };
    for (dialect, wire) in WIRES {
        let of = message(dialect, text_of);
        let whole = MessagePlan::compile(&of, &Selection::Whole, wire).unwrap();
        let string = |text: &str| RecordedEvent::Scalar(RecordedValue::Text(text.to_owned()));
        let status = |name: &str, level| {
            let begin = RecordedEvent::Begin("diagnostic_msgs/DiagnosticStatus".to_owned());
            let values = RecordedEvent::Array(BuiltinType::ExtensionObject, 0);
            let texts = [name, "said", "id"].map(string);
            let [name, said, id] = texts;
            vec![
                begin,
                scalar(level),
                name,
                said,
                id,
                values,
                RecordedEvent::End,
            ]
        };
        let mut events = vec![
            scalar(Scalar::Int32(1)),
            RecordedEvent::Structures("diagnostic_msgs/DiagnosticStatus".to_owned(), 2),
        ];
        events.extend(status("imu", zero(dialect)));
        events.extend(status("lidar", level(dialect)));
        events.push(scalar(Scalar::Int32(2)));
        let bytes = written(&whole, &events);
        let part =
            |text: &str| MessagePlan::compile(&of, &select(text, Conversion::default()), wire);
        let expected = scalar(level(dialect)).to_string();
        for text in ["status[name=lidar].level", "status[1].level"] {
            let plan = part(text).unwrap();
            assert_eq!(plan.leaves()[0].path, text);
            assert_eq!(read(&plan, &bytes).unwrap(), [expected.as_str()]);
        }
        let said = part("status[0].name").unwrap();
        assert_eq!(read(&said, &bytes).unwrap(), ["scalar String imu"]);
        let absent = read(&part("status[2].level").unwrap(), &bytes).unwrap_err();
        let fault = ValueFault::Absent { at: 2, found: 2 };
        assert!(matches!(&absent, ReadError::Value { fault: found, .. } if *found == fault));
        let missing = read(&part("status[name=gps].level").unwrap(), &bytes).unwrap_err();
        assert!(matches!(
            missing,
            ReadError::Value {
                fault: ValueFault::NoName(_),
                ..
            }
        ));
        assert!(matches!(
            part("status[0].nothing"),
            Err(PlanError::UnknownField { .. })
        ));
        for text in ["before[0].x", "status[0].values"] {
            assert!(matches!(part(text), Err(PlanError::Shape { .. })), "{text}");
        }
        let scaled = select("status[1].level", Conversion::default().scaled(10.0, 0.0));
        let scaled = MessagePlan::compile(&of, &scaled, wire).unwrap();
        assert!(read(&scaled, &bytes).unwrap()[0].ends_with("20"));
    }
    for text in ["a[0:2].x", "a[0]x", "a[0].", "a[0].b[1]"] {
        assert_eq!(ArrayPart::split(text), None, "{text}");
    }
}
