//! Alarms of variables.

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use messages::Leaf;
use uadp::BuiltinType;

use super::quantity::duration;
use super::types::{self, ValueType};
use crate::alarm::{Alarm, AlarmLimits, AlarmTrigger, AlarmValue};
use crate::code::Code;
use crate::document::{AlarmEntry, ReportsEntry, VariableEntry};
use crate::findings::MappingFindings;
use crate::mapping::{Binding, Variable};
use crate::read::{Located, OptionalKey, given, short};
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

/// Properties of the variable of an alarm.
struct Subject<'a> {
    /// The OPC UA type of the value; `None` if there are several fields or the type is unknown.
    value_type: Option<ValueType>,
    fields: &'a [Leaf],
    bindings: &'a [Binding],
    /// Texts of single values.
    texts: &'a BTreeMap<i64, String>,
}

impl<'a> Subject<'a> {
    fn of(variable: &'a Variable) -> Self {
        Self {
            value_type: variable.value_type,
            fields: &variable.fields,
            bindings: &variable.bindings,
            texts: &variable.meaning.texts,
        }
    }
}

/// Sets the alarm of each variable. Faults are noted.
pub(super) fn check<'d>(
    entries: impl Iterator<Item = (TopicId, &'d VariableEntry)>,
    variables: &mut [Variable],
    findings: &mut MappingFindings,
) {
    let has_alarm = |entry: &VariableEntry| entry.alarm.is_some() || entry.reports.is_some();
    let entries: HashMap<TopicId, &VariableEntry> =
        entries.filter(|(_, entry)| has_alarm(entry)).collect();
    if entries.is_empty() {
        return;
    }
    let mut count = 0;
    for variable in variables {
        let Some(entry) = entries.get(&variable.topic) else {
            continue;
        };
        let subject = Subject::of(variable);
        let alarm = alarm(entry, &subject, findings);
        let reports = reports(entry, (variable.topic.space, &subject), findings);
        variable.alarm = alarm.map(Box::new);
        variable.reports_alarms = reports.is_some();
        count += usize::from(entry.alarm.is_some());
        if count == MAX_ALARMS + 1
            && let Some(at) = &entry.alarm
        {
            let message = format!("more than {MAX_ALARMS} variables have an alarm");
            findings.error(Code::Alarm, at.place, message);
        }
    }
}

/// Returns `None` without an alarm, and for a faulty entry, which is noted.
fn alarm(
    entry: &VariableEntry,
    subject: &Subject<'_>,
    findings: &mut MappingFindings,
) -> Option<Alarm> {
    let at = entry.alarm.as_ref()?;
    let said = at.value.as_ref()?;
    let trigger = trigger((said, at.place), subject, findings);
    let severity = severity(said, findings);
    let delay = match &said.delay {
        None => Some(Duration::ZERO),
        Some(_) => duration(&said.delay, findings),
    };
    let message = message(said, findings);
    Some(Alarm {
        trigger: trigger?,
        severity: severity?,
        confirm: given(&said.confirm).is_some_and(|(confirm, _)| *confirm),
        delay: delay?,
        message: message?,
    })
}

fn severity(said: &AlarmEntry, findings: &mut MappingFindings) -> Option<u16> {
    let Some((severity, place)) = given(&said.severity) else {
        return said.severity.is_none().then_some(USUAL_SEVERITY);
    };
    if (1..=1000).contains(severity) {
        return Some(*severity);
    }
    findings
        .error(Code::Alarm, place, format!("{severity} is not a severity"))
        .label("1 to 1000");
    None
}

fn message(said: &AlarmEntry, findings: &mut MappingFindings) -> Option<Option<String>> {
    let Some((text, place)) = given(&said.message) else {
        return said.message.is_none().then_some(None);
    };
    if text.trim().is_empty() || text.chars().count() > 1000 {
        let message = "the message of an alarm has 1 to 1000 characters";
        findings.error(Code::Alarm, place, message);
        return None;
    }
    Some(Some(text.clone()))
}

/// Returns the only trigger of the entry.
fn trigger(
    (said, place): (&AlarmEntry, TextSpan),
    subject: &Subject<'_>,
    findings: &mut MappingFindings,
) -> Option<AlarmTrigger> {
    let limits = [&said.low_low, &said.low, &said.high, &said.high_high];
    let has_limits = limits.iter().any(|limit| limit.is_some());
    let diagnostics = given(&said.diagnostics).is_some_and(|(on, _)| *on);
    let given_ways = [
        has_limits,
        said.normal.is_some(),
        said.when.is_some(),
        diagnostics,
    ];
    let count = given_ways.iter().filter(|given| **given).count();
    if count != 1 {
        let message = match count {
            0 => "the alarm has no trigger",
            _ => "the alarm has several triggers",
        };
        findings
            .error(Code::Alarm, place, message)
            .help("limits such as `high: 70`, or `normal: false`, or `when: [2, 3]`, or `diagnostics: true`");
        return None;
    }
    if !has_limits {
        let only_limits = [
            ("exclusive", said.exclusive.as_ref().map(|at| at.place)),
            ("deadband", said.deadband.as_ref().map(|at| at.place)),
        ];
        for (key, place) in only_limits {
            if let Some(place) = place {
                let message = format!("`{key}` requires limits");
                findings.error(Code::Alarm, place, message);
                return None;
            }
        }
    }
    if has_limits {
        return levels((said, place), limits, subject, findings).map(AlarmTrigger::Limits);
    }
    if let Some((text, at)) = given(&said.normal) {
        return value(text, at, subject, findings).map(AlarmTrigger::Normal);
    }
    if let Some((list, at)) = given(&said.when) {
        return values(&list.0, at, subject, findings).map(AlarmTrigger::When);
    }
    if !diagnostics {
        return None;
    }
    subject
        .is_diagnostics("diagnostics", place, findings)
        .map(|()| AlarmTrigger::Diagnostics)
}

/// Returns `Some` if the server makes the values of its conditions. Faults are noted.
fn reports(
    entry: &VariableEntry,
    (origin, subject): (SpaceId, &Subject<'_>),
    findings: &mut MappingFindings,
) -> Option<()> {
    let at = entry.reports.as_ref()?;
    let ReportsEntry::Alarms = at.value.as_ref()?;
    let others = [
        entry.from.as_ref().map(|_| "from"),
        entry.alarm.as_ref().map(|_| "alarm"),
    ];
    let other = others.into_iter().flatten().next();
    if origin != SpaceId::UA || other.is_some() {
        let message = match other {
            Some(other) => format!("`reports` stands beside `{other}`"),
            None => "the server produces only values of origin 0".to_owned(),
        };
        findings
            .error(Code::Alarm, at.place, message)
            .help("`reports: alarms` requires `origin: 0`, and excludes `from` and `alarm`");
        return None;
    }
    subject.is_diagnostics("reports", at.place, findings)
}

impl Subject<'_> {
    /// Notes a value that is no whole DiagnosticArray, for a key that needs one.
    fn is_diagnostics(
        &self,
        key: &str,
        place: TextSpan,
        findings: &mut MappingFindings,
    ) -> Option<()> {
        let is_array = |binding: &Binding| binding.message_type.to_string() == DIAGNOSTICS;
        let is_status =
            |leaf: &Leaf| leaf.path == "status" && leaf.builtin == BuiltinType::ExtensionObject;
        if self.bindings.iter().any(is_array) && self.fields.iter().any(is_status) {
            return Some(());
        }
        let message =
            format!("`{key}` requires the whole message of a diagnostic_msgs/DiagnosticArray");
        findings.error(Code::Alarm, place, message).help(
            "ros: {topic: /diagnostics, type: diagnostic_msgs/DiagnosticArray}, without `field` and `as`",
        );
        None
    }
}

fn levels(
    (said, place): (&AlarmEntry, TextSpan),
    limits: [&OptionalKey<f64>; 4],
    subject: &Subject<'_>,
    findings: &mut MappingFindings,
) -> Option<AlarmLimits> {
    let is_number = matches!(subject.value_type, Some((builtin, false)) if builtin.is_number());
    if !is_number {
        let message = format!("limits require a number, but this is {}", told(subject));
        findings
            .error(Code::Alarm, place, message)
            .help("bind a single `field`, or give the `type`");
        return None;
    }
    let mut before: Option<f64> = None;
    let mut sound = true;
    for (limit, at) in limits.into_iter().filter_map(given) {
        if !limit.is_finite() || before.is_some_and(|before| *limit <= before) {
            findings
                .error(
                    Code::Alarm,
                    at,
                    format!("the limit {limit} is not above the previous limit"),
                )
                .help("low_low < low < high < high_high");
            sound = false;
        }
        before = Some(*limit);
    }
    let deadband = given(&said.deadband);
    if let Some((deadband, at)) = deadband
        && !(deadband.is_finite() && *deadband >= 0.0)
    {
        let message = format!("the deadband {deadband} is not a number from 0");
        findings.error(Code::Alarm, at, message);
        sound = false;
    }
    let is_faulty = limits
        .iter()
        .any(|limit| limit.is_some() && given(limit).is_none());
    if !sound || is_faulty {
        return None;
    }
    let limits = limits.map(|limit| given(limit).map(|(limit, _)| *limit));
    let exclusive = given(&said.exclusive).is_none_or(|(exclusive, _)| *exclusive);
    let deadband = deadband.map_or(0.0, |(deadband, _)| *deadband);
    Some(AlarmLimits::new(limits, deadband, exclusive))
}

fn values(
    texts: &[Located<String>],
    place: TextSpan,
    subject: &Subject<'_>,
    findings: &mut MappingFindings,
) -> Option<Vec<AlarmValue>> {
    if texts.is_empty() || texts.len() > MOST_VALUES {
        let message = format!("{} values trigger the alarm", texts.len());
        findings
            .error(Code::Alarm, place, message)
            .label("1 to 1000");
        return None;
    }
    let read = texts.iter().map(|text| {
        let said = text.value.as_ref()?;
        value(said, text.place, subject, findings)
    });
    let read: Vec<Option<AlarmValue>> = read.collect();
    read.into_iter().collect()
}

/// Returns a text as a value of the variable.
fn value(
    text: &str,
    place: TextSpan,
    subject: &Subject<'_>,
    findings: &mut MappingFindings,
) -> Option<AlarmValue> {
    let named = || {
        let mut texts = subject.texts.iter();
        texts.find_map(|(number, name)| (name == text).then_some(i128::from(*number)))
    };
    let found = match subject.value_type {
        Some((BuiltinType::Boolean, false)) => text.parse().ok().map(AlarmValue::Boolean),
        Some((BuiltinType::String, false)) => Some(AlarmValue::Text(text.to_owned())),
        Some((BuiltinType::Float | BuiltinType::Double, false)) => None,
        Some((builtin, false)) if builtin.is_number() => {
            let number = text.parse().ok().or_else(named);
            number.map(AlarmValue::Integer)
        }
        Some(_) | None => None,
    };
    if found.is_none() {
        let message = format!("`{}` is not a value of {}", short(text), told(subject));
        findings.error(Code::Alarm, place, message).help(
            "`normal` and `when` require a Boolean, an integer (or a text of its `enum`) or a text",
        );
    }
    found
}

fn told(subject: &Subject<'_>) -> String {
    match subject.value_type {
        Some(value_type) => types::print(value_type),
        None => "a message of several fields, or of an unknown type".to_owned(),
    }
}

/// Default severity: the middle of "medium" (OPC 10000-5, 6.4.2).
const USUAL_SEVERITY: u16 = 500;
const MOST_VALUES: usize = 1000;
/// Maximum number of variables with an alarm.
const MAX_ALARMS: usize = 5_000;
const DIAGNOSTICS: &str = "diagnostic_msgs/DiagnosticArray";
