//! Variables in the document: the values of the cell.

use std::collections::BTreeMap;

use messages::Literal;
use schemars::JsonSchema;

use super::alarm::{AlarmEntry, ReportsEntry};
use super::binding::Bindings;
use super::patterns::DURATION;
use super::permissions::PermissionsEntry;
use super::request::{Request, is_scalar};
use super::servers::{FromEntry, ToEntry};
use crate::code::Code;
use crate::mapping::UaField;
use crate::read::{
    FromNode, Located, NodeReader, choice, document, help_octal, inline_schema, is_octal, short,
};
use crate::tree::{YamlKind, YamlNode};

document! {
    /// A value of the cell.
    struct VariableEntry {
        /// The OPC UA node, such as ns=2;i=10.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        node: String,
        /// Name of the node; dots separate its folders, such as Line.Conveyor.Speed.
        #[schemars(required, length(min = 1, max = 512))]
        name: String,
        /// OPC UA builtin type, such as Boolean or Double[]. Default: the type of the bound ROS
        /// field.
        r#type: String,
        /// For a publisher that is not a bridge and sends several fields in the DataSetMessages of
        /// this value: the field of the value, by its index from 0 or by its name in the
        /// DataSetMetaData of the publisher. Default: the only field, or the field with the `name`
        /// of this variable.
        ua_field: UaFieldEntry,
        /// Text for users: the Description of the node. Default: the name of its topic.
        #[schemars(length(min = 1, max = 1000))]
        description: String,
        /// Number of decimal places to show (ValuePrecision), for a number.
        #[schemars(range(max = 15))]
        precision: u16,
        /// `true` copies the fields of the value into the headers of its MQTT messages, as user
        /// properties of MQTT 5 (promoted fields), and marks them in its metadata.
        promoted: bool,
        /// Unit of the value in OPC UA: a symbol such as m/s, a UNECE code such as MTS, or a name.
        unit: String,
        /// Lowest and highest expected value in OPC UA, such as [0, 1.5].
        range: Vec<Located<f64>>,
        /// Texts for the numbers of the value, such as {0: idle, 1: moving}.
        #[schemars(with = "Option<BTreeMap<String, String>>")]
        r#enum: EnumTexts,
        /// The space that produces the value: 0 for the OPC UA side, otherwise an id of `spaces`.
        #[schemars(required, range(max = 232))]
        origin: u16,
        /// Replaces the identifier in topic names if the node id is not a number from 1 to 65535,
        /// or is in namespace 0. In the topic names of nodes of namespace 0 the namespace is 65535.
        #[schemars(range(min = 1, max = 65535))]
        alias: u16,
        /// The ROS topics and services of the value, a single binding or a list, at most one per
        /// space. The topic is read in the space of its origin and written elsewhere. Default: a
        /// topic with the name of the space, such as /ua_1_2_10.
        ros: Bindings,
        /// With `origin: 0`: the node of another OPC UA server that the value comes from. The
        /// server of the cell receives each change and passes it on with its time and quality;
        /// while the other server is lost, the value is bad.
        from: FromEntry,
        /// The node of another OPC UA server that each value is written to, from this space or
        /// another.
        to: ToEntry,
        /// `keep_latest` for a state: only the newest value matters, and late ROS subscribers
        /// receive it. `{drop_oldest: 100}` for events: each value is delivered once, to present
        /// subscribers. Default: an event for values of origin 0 and values that call a service;
        /// otherwise a state if the ROS publisher is latched or transient-local, and an event if
        /// not.
        queue: Queue,
        /// Published once into ROS, or sent to the service that the value calls, when the commander
        /// of the value has stopped or timed out after it published a value: `zero`, a value of the
        /// bound `field`, fields of the message or request such as {linear.x: 0.1}, or {call:
        /// ns=2;i=48} for the service of that variable.
        on_loss: OnLossEntry,
        /// With `on_loss`: the value is also lost if it is not renewed within this time, such as
        /// 500ms.
        #[schemars(regex(pattern = DURATION))]
        hold: String,
        /// Values that the origin sends: `always` (the default) every value, `on_change` only
        /// values that differ from the last sent value.
        publish: PublishEntry,
        /// As `publish: on_change`, but numbers (each element of an array) must differ by more than
        /// this.
        deadband: f64,
        /// Highest rate at which the origin sends the value, such as 10 Hz: of faster values, the
        /// newest is sent after the period.
        #[schemars(regex(pattern = r"^[0-9]+(\.[0-9]+)? ?Hz$"))]
        at_most: String,
        /// The longest time between two values of a periodic value, such as 100ms. Each program
        /// counts longer times (`deadline_missed`), and the server shows the value as uncertain
        /// after this time, unless `quality` has another.
        #[schemars(regex(pattern = DURATION))]
        deadline: String,
        /// Age limits after which the server no longer shows the value as good.
        quality: QualityEntry,
        /// Values that raise an alarm at the server, such as {high: 70, high_high: 90} or {normal:
        /// false}.
        alarm: AlarmEntry,
        /// `alarms`, with `origin: 0`: the value is a diagnostic_msgs/DiagnosticArray that the
        /// server makes of its conditions, once a second and when one changes. Diagnostics of
        /// robots are not in it.
        reports: ReportsEntry,
        /// Confirmation that a value has arrived. `bridge`, the default for events of origin 0 and
        /// for values that call a service: each bridge with a binding of the value confirms when a
        /// present subscriber or the service has received it; the value is sent again until then,
        /// for 1 s at most, and the result of a write states the outcome. `none`: a write succeeds
        /// when the value has been sent. {within: 2s} for another time; {by: ns=2;i=31} with
        /// `origin: 0` for a variable that the robot sends as confirmation.
        confirm: ConfirmedEntry,
        /// Number of past values that the server keeps, 0 to 65535. Default: as in
        /// `server.history`.
        history: u16,
        /// Permissions of roles for the node.
        permissions: PermissionsEntry,
    }

    /// Age limits after which the server no longer shows a value as good.
    struct QualityEntry {
        /// A value is uncertain (UncertainLastUsableValue) after this time without a newer value,
        /// even while messages of its writer are received: for periodic values. Default: no age
        /// limit while messages of its writer are received.
        #[schemars(regex(pattern = DURATION))]
        uncertain_after: String,
        /// A value becomes bad (BadNoCommunication) and is not shown after being uncertain for this
        /// time, because of its age or the loss of its writer. Default: as in `server.bad_after`.
        #[schemars(regex(pattern = DURATION))]
        bad_after: String,
    }

    /// A service that stops the robot.
    struct StopCallEntry {
        /// Node of the variable whose values call it with a fixed request, such as ns=2;i=48.
        #[schemars(required, regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        call: String,
    }

    /// Confirmation that a value has arrived. With `by`, a write without a confirmation in time
    /// returns BadTimeout, the variable shows its previous value, and the value is not sent to late
    /// subscribers.
    struct ConfirmEntry {
        /// Node of the variable that confirms, such as ns=2;i=31: a variable of another space, or
        /// with `from`. It is sent again for each write. Default: the bridges confirm.
        #[schemars(regex(pattern = r"^(ns=[0-9]+;)?[isgb]="))]
        by: String,
        /// Time limit of the confirmation; default 2s, and 1s for confirmations of the bridges.
        #[schemars(regex(pattern = DURATION))]
        within: String,
        /// The value that confirms: `same` (the default) a value that equals the written value,
        /// `any` every later value.
        when: ConfirmWhenEntry,
        /// Instead of `when`: the value that confirms, such as true, 3 or done.
        equals: String,
    }
}

choice! {
    enum ConfirmWhenEntry {
        /// A value that equals the written value.
        Same = "same",
        /// Every value.
        Any = "any",
    }

    enum PublishEntry {
        /// Each value.
        Always = "always",
        /// Values that differ from the last sent value.
        OnChange = "on_change",
    }
}

/// Value and text, each with its position.
pub(crate) type EnumTexts = Vec<(Located<i64>, Located<String>)>;

impl FromNode for EnumTexts {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let pairs = reader.pairs(node, "a map of value and text, as {0: idle, 1: moving}")?;
        let read = pairs.into_iter().map(|pair| {
            let value = pair.key.parse().ok().filter(|_| !is_octal(pair.key));
            if value.is_none() {
                let message = format!("expected a whole number, found `{}`", short(pair.key));
                let note = reader.findings.error(Code::WrongValue, pair.place, message);
                help_octal(note, pair.key);
            }
            let place = pair.place;
            (Located { place, value }, reader.at(pair.value))
        });
        Some(read.collect())
    }
}

/// Reaction to the loss of a value's commander.
#[derive(Clone, Debug)]
pub(crate) enum OnLossEntry {
    /// A message of zeros.
    Zero,
    /// The value of the bound field.
    Value(Literal),
    /// Fields of the message.
    Fields(Request),
    /// A service.
    Call(StopCallEntry),
}

impl FromNode for OnLossEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::Scalar(text) if text == "zero" => Some(Self::Zero),
            YamlKind::Scalar(text) => Some(Self::Value(Literal::One(text.clone().into_owned()))),
            YamlKind::Map(pairs) if pairs.iter().any(|(key, _)| is_scalar(key, "call")) => {
                StopCallEntry::read(node, reader).map(Self::Call)
            }
            YamlKind::Map(_) => Request::read(node, reader).map(Self::Fields),
            YamlKind::Null | YamlKind::List(_) => {
                reader.wrong(
                    node,
                    "`zero`, a value, the fields of a message as {linear.x: 0.1}, or {call: ns=2;i=48}",
                );
                None
            }
        }
    }
}

inline_schema!(OnLossEntry, generator => {
    let call = generator.subschema_for::<StopCallEntry>();
    schemars::json_schema!({
        "anyOf": [{ "const": "zero" }, { "type": ["number", "boolean", "string"] }, call, { "type": "object" }]
    })
});

/// Confirmation that a value has arrived.
#[derive(Clone, Debug)]
pub(crate) enum ConfirmedEntry {
    /// No confirmation.
    None,
    /// Confirmation by the bridges that the value is for.
    Bridge,
    /// Confirmation by the bridges or by a value, as the map says.
    Map(Box<ConfirmEntry>),
}

impl FromNode for ConfirmedEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::Scalar(text) if text == "bridge" => Some(Self::Bridge),
            YamlKind::Scalar(text) if text == "none" => Some(Self::None),
            YamlKind::Map(_) => {
                let read = ConfirmEntry::read(node, reader);
                read.map(|read| Self::Map(Box::new(read)))
            }
            YamlKind::Scalar(_) | YamlKind::Null | YamlKind::List(_) => {
                reader.wrong(
                    node,
                    "`bridge`, `none`, {within: 2s}, or {by: ns=2;i=31, within: 2s}",
                );
                None
            }
        }
    }
}

inline_schema!(ConfirmedEntry, generator => {
    let map = generator.subschema_for::<ConfirmEntry>();
    schemars::json_schema!({ "anyOf": [{ "const": "bridge" }, { "const": "none" }, map] })
});

/// A field of a DataSet, by its index or its name.
#[derive(Clone, Debug)]
pub(crate) struct UaFieldEntry(pub(crate) UaField);

impl FromNode for UaFieldEntry {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let wanted = "the place of a field as 2, or its name as Temperature";
        let text = reader.text(node, wanted)?;
        if !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit()) {
            return Some(Self(UaField::Place(u16::read(node, reader)?)));
        }
        if text.is_empty() || text.len() > MAX_FIELD_NAME {
            let message = format!("expected {wanted}, found `{}`", short(text));
            let note = reader.findings.error(Code::WrongValue, node.place, message);
            note.help(format!("a name has 1 to {MAX_FIELD_NAME} bytes"));
            return None;
        }
        Some(Self(UaField::Name(text.to_owned())))
    }
}

inline_schema!(UaFieldEntry, _generator => schemars::json_schema!({ "anyOf": [
    { "type": "integer", "minimum": 0, "maximum": 65535 },
    { "type": "string", "minLength": 1, "maxLength": MAX_FIELD_NAME }
] }));

/// Longest field name, in bytes, that is kept from the metadata of writers.
const MAX_FIELD_NAME: usize = 255;

/// Overflow policy of a queue.
#[derive(Clone, Copy, Debug, JsonSchema)]
#[schemars(rename_all = "snake_case")]
pub(crate) enum Queue {
    /// A newer value takes the place of the one that waits.
    KeepLatest,
    /// That many values wait, and the oldest goes.
    DropOldest(#[schemars(range(min = 1, max = 65535))] u16),
}

impl FromNode for Queue {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        match &node.kind {
            YamlKind::Scalar(text) if text == "keep_latest" => Some(Self::KeepLatest),
            YamlKind::Map(_) => {
                let [size] = reader.keys(node, ["drop_oldest"])?;
                let size = reader.field::<u16>(size);
                match size.as_ref().map(|at| (at.value, at.place)) {
                    Some((Some(0), place)) => {
                        let message = "a queue of size 0 cannot hold a value";
                        reader
                            .findings
                            .error(Code::WrongValue, place, message)
                            .help("1 to 65535, or `keep_latest`");
                        None
                    }
                    Some((size, _)) => Some(Self::DropOldest(size?)),
                    None => {
                        reader.findings.error(
                            Code::MissingKey,
                            node.place,
                            "`drop_oldest` needs a number",
                        );
                        None
                    }
                }
            }
            YamlKind::Null | YamlKind::Scalar(_) | YamlKind::List(_) => {
                let note = reader.findings.error(
                    Code::WrongValue,
                    node.place,
                    format!(
                        "expected `keep_latest` or `drop_oldest`, found {}",
                        found(node)
                    ),
                );
                note.help("queue: keep_latest, or queue: {drop_oldest: 100}");
                None
            }
        }
    }
}

fn found(node: &YamlNode<'_>) -> String {
    match &node.kind {
        YamlKind::Scalar(text) => format!("`{}`", short(text)),
        YamlKind::Null | YamlKind::List(_) | YamlKind::Map(_) => node.kind.name().to_owned(),
    }
}
