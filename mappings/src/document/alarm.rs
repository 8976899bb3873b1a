//! `alarm` of a variable in the document.

use super::patterns::DURATION;
use crate::read::{FromNode, Located, NodeReader, choice, document, inline_schema};
use crate::tree::{YamlKind, YamlNode};

document! {
    /// An alarm of the value at the server of the cell (OPC 10000-9): limits of a number, `normal`
    /// or `when` of a Boolean, an integer or a text, or `diagnostics`.
    struct AlarmEntry {
        /// The alarm is at LowLow while the value is below this limit.
        low_low: f64,
        /// The alarm is at Low while the value is below this limit.
        low: f64,
        /// The alarm is at High while the value is above this limit.
        high: f64,
        /// The alarm is at HighHigh while the value is above this limit.
        high_high: f64,
        /// `true` (the default): the alarm is at the outermost limit that the value exceeds
        /// (ExclusiveLevelAlarmType). `false`: it is at each limit that the value exceeds
        /// (NonExclusiveLevelAlarmType).
        exclusive: bool,
        /// Distance that a value has to return from a limit before the alarm ends; default 0.
        deadband: f64,
        /// The alarm is active while the value differs from this value, such as false, 0 or a text
        /// of `enum` (OffNormalAlarmType).
        #[schemars(extend("type" = ["string", "boolean", "number", "null"]))]
        normal: String,
        /// The alarm is active while the value equals this value or a value of this list, such as
        /// [2, 3] or texts of `enum` (DiscreteAlarmType).
        when: ValueList,
        /// `true`: each status of a diagnostic_msgs/DiagnosticArray is an alarm of its own, by its
        /// hardware_id and name, and active unless its level is OK (SystemDiagnosticAlarmType).
        diagnostics: bool,
        /// Severity, 1 to 1000; default 500. At LowLow and HighHigh it is halfway between this and
        /// 1000.
        #[schemars(range(min = 1, max = 1000))]
        severity: u16,
        /// Whether an acknowledged alarm has to be confirmed too; default false.
        confirm: bool,
        /// Time that the value has to be beyond a limit before the alarm is active, such as 500ms.
        /// Default: it is active at once.
        #[schemars(regex(pattern = DURATION))]
        delay: String,
        /// Text of the active alarm. Default: the name of the variable, its value and the limit.
        #[schemars(length(min = 1, max = 1000))]
        message: String,
    }
}

choice! {
    enum ReportsEntry {
        /// A diagnostic_msgs/DiagnosticArray with a status for each condition of the server.
        Alarms = "alarms",
    }
}

choice! {
    enum AcknowledgesEntry {
        /// The alarms of the server.
        Alarms = "alarms",
    }
}

/// A value or a list of values, as texts.
#[derive(Clone, Debug)]
pub(crate) struct ValueList(pub(crate) Vec<Located<String>>);

impl FromNode for ValueList {
    fn read(node: &YamlNode<'_>, reader: &mut NodeReader<'_>) -> Option<Self> {
        let is_one = matches!(node.kind, YamlKind::Scalar(_));
        let wanted = "a value such as `3`, or a list of them";
        reader.one_or_list(node, is_one, wanted).map(Self)
    }
}

inline_schema!(ValueList, _generator => {
    let one = schemars::json_schema!({ "type": ["string", "boolean", "number"] });
    schemars::json_schema!({ "anyOf": [one, { "type": "array", "items": one, "minItems": 1 }] })
});
