//! Confirmation that a value has arrived.

use std::collections::HashMap;
use std::time::Duration;

use uadp::BuiltinType;

use super::quantity::duration;
use super::{required, types};
use crate::code::Code;
use crate::document::{ConfirmEntry, ConfirmWhenEntry, ConfirmedEntry, VariableEntry};
use crate::findings::MappingFindings;
use crate::mapping::{Lasting, ServiceRole, Variable};
use crate::node_id::NodeIdText;
use crate::quality::{Confirm, ConfirmingValues};
use crate::read::{given, short};
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

/// Sets the confirmation of each variable. Faults are noted.
pub(super) fn check<'d>(
    entries: impl Iterator<Item = (TopicId, &'d VariableEntry)>,
    variables: &mut [Variable],
    findings: &mut MappingFindings,
) {
    for variable in &mut *variables {
        variable.confirmed_within = is_command(variable).then_some(CONFIRMED_WITHIN);
    }
    let mut confirms = Vec::new();
    let entries = entries.filter_map(|(topic, entry)| Some((topic, entry.confirm.as_ref()?)));
    let mut entries = entries.peekable();
    if entries.peek().is_none() {
        return;
    }
    let by_node: HashMap<&NodeIdText, &Variable> =
        variables.iter().map(|one| (&one.node, one)).collect();
    let by_topic: HashMap<TopicId, usize> = (0..)
        .zip(variables.iter())
        .map(|(at, one)| (one.topic, at))
        .collect();
    for (topic, at) in entries {
        let Some(entry) = &at.value else { continue };
        let Some(index) = by_topic.get(&topic) else {
            continue;
        };
        let Some(written) = variables.get(*index) else {
            continue;
        };
        let confirmed = match entry {
            ConfirmedEntry::None => Some((None, None)),
            ConfirmedEntry::Bridge => {
                let within = by_bridges(None, at.place, written, findings);
                within.map(|within| (Some(within), None))
            }
            ConfirmedEntry::Map(entry) if entry.by.is_none() => {
                let within = by_bridges(Some(entry.as_ref()), at.place, written, findings);
                within.map(|within| (Some(within), None))
            }
            ConfirmedEntry::Map(entry) => {
                let confirm = confirm((entry.as_ref(), at.place), written, &by_node, findings);
                confirm.map(|confirm| {
                    let repeated = is_command(written).then_some(confirm.within);
                    (repeated, Some(confirm))
                })
            }
        };
        confirms.extend(confirmed.map(|confirmed| (*index, confirmed)));
    }
    for (index, (within, confirm)) in confirms {
        if let Some(variable) = variables.get_mut(index) {
            variable.confirmed_within = within;
            variable.confirm = confirm.map(Box::new);
        }
    }
}

/// Returns `true` if the values are events of the OPC UA side, or call a service, in another space.
fn is_command(variable: &Variable) -> bool {
    let called = variable.service.as_ref();
    let calls = called.is_some_and(|of| matches!(of.role, ServiceRole::Call { .. }));
    let is_commanded = calls || variable.topic.space == SpaceId::UA;
    is_commanded && variable.lasting == Lasting::Event && variable.destinations().next().is_some()
}

/// Returns the time in which the bridges have to confirm; `None` for a faulty entry, which is
/// noted.
fn by_bridges(
    entry: Option<&ConfirmEntry>,
    place: TextSpan,
    written: &Variable,
    findings: &mut MappingFindings,
) -> Option<Duration> {
    let answers = entry.and_then(|entry| {
        let when = entry.when.as_ref().map(|when| when.place);
        when.or_else(|| entry.equals.as_ref().map(|equals| equals.place))
    });
    if let Some(place) = answers {
        findings
            .error(
                Code::Confirm,
                place,
                "`when` and `equals` require the variable that confirms",
            )
            .help("add `by` with its node, such as {by: ns=2;i=31}");
        return None;
    }
    if written.destinations().next().is_none() {
        findings
            .error(Code::Confirm, place, "the value is not sent to another space")
            .help("`confirm: bridge` requires a topic or a service in a space other than the `origin`");
        return None;
    }
    if written.lasting == Lasting::State {
        findings
            .error(
                Code::Confirm,
                place,
                "the value is a state, which is repeated while its producer runs",
            )
            .help("remove `queue: keep_latest`, so that it is an event");
        return None;
    }
    let Some(entry) = entry.filter(|entry| entry.within.is_some()) else {
        return Some(CONFIRMED_WITHIN);
    };
    let place = entry.within.as_ref().map_or(place, |within| within.place);
    let within = duration(&entry.within, findings)?;
    if within > LONGEST {
        findings
            .error(
                Code::Confirm,
                place,
                "a value is sent again for a minute at most",
            )
            .help("a command that arrives later can be dangerous");
        return None;
    }
    Some(within)
}

/// Returns `None` for a faulty entry, which is noted.
fn confirm(
    (entry, place): (&ConfirmEntry, TextSpan),
    written: &Variable,
    by_node: &HashMap<&NodeIdText, &Variable>,
    findings: &mut MappingFindings,
) -> Option<Confirm> {
    if !is_written(written) {
        findings
            .error(Code::Confirm, place, "no client writes this variable")
            .help("`confirm` with `by` requires `origin: 0`, and excludes `from`");
        return None;
    }
    let within = duration(&entry.within, findings);
    if entry.within.is_some() && within.is_none() {
        return None;
    }
    let (node, at) = required(&entry.by, "by", "`confirm`", place, findings)?;
    let Ok(node) = node.parse::<NodeIdText>() else {
        let message = format!("`{}` is not a node id", short(node));
        findings.error(Code::NodeId, at, message);
        return None;
    };
    let Some(by) = by_node.get(&node) else {
        let message = format!("no variable has the node `{}`", short(&node.to_string()));
        findings.error(Code::Confirm, at, message).help(
            "give the node of the variable with the response of the robot, such as ns=2;i=31",
        );
        return None;
    };
    if is_written(by) {
        findings
            .error(
                Code::Confirm,
                at,
                "the confirming variable is written by clients, not by the robot",
            )
            .help("use a variable of another space, or a variable with `from`");
        return None;
    }
    let answer = answer(entry, (written, by), at, findings)?;
    Some(Confirm {
        by: by.topic,
        within: within.unwrap_or(WITHIN),
        answer,
    })
}

fn answer(
    entry: &ConfirmEntry,
    (written, by): (&Variable, &Variable),
    place: TextSpan,
    findings: &mut MappingFindings,
) -> Option<ConfirmingValues> {
    if let Some((text, at)) = given(&entry.equals) {
        if entry.when.is_some() {
            findings
                .error(Code::Confirm, at, "`when` and `equals` exclude each other")
                .help("remove one of them");
            return None;
        }
        if !is_value(text, by.value_type) {
            let told = by.value_type.map(types::print);
            let message = format!(
                "`{}` is not a value of the confirming variable, which is {}",
                short(text),
                told.unwrap_or_else(|| "a message of several fields".to_owned())
            );
            findings
                .error(Code::Confirm, at, message)
                .help("it must be one Boolean, number or text; bind a single `field`");
            return None;
        }
        return Some(ConfirmingValues::Equals(text.clone()));
    }
    match given(&entry.when) {
        Some((ConfirmWhenEntry::Any, _)) => Some(ConfirmingValues::Any),
        Some((ConfirmWhenEntry::Same, _)) | None => {
            if !are_comparable(written, by) {
                findings
                    .error(
                        Code::Confirm,
                        place,
                        "the confirming variable has another type than the written value, so they are never equal",
                    )
                    .help("give the value that confirms, such as `equals: true`; or use `when: any`");
                return None;
            }
            if by.publish.on_change {
                findings
                    .warning(
                        Code::Confirm,
                        place,
                        "the confirming variable is sent only on change: the second write of the same value \
                         is not confirmed",
                    )
                    .help("remove `publish: on_change` and `deadband` of the confirming variable");
            }
            Some(ConfirmingValues::Same)
        }
    }
}

/// Returns `true` if clients write the variable.
fn is_written(variable: &Variable) -> bool {
    variable.topic.space == SpaceId::UA && variable.from.is_none()
}

/// Returns `true` also if the fields are not known beforehand.
fn are_comparable(written: &Variable, by: &Variable) -> bool {
    if written.fields.is_empty() || by.fields.is_empty() {
        return true;
    }
    let fields = written.fields.iter().zip(&by.fields);
    written.fields.len() == by.fields.len()
        && fields
            .map(|(one, other)| (types::value_type(one), types::value_type(other)))
            .all(|(one, other)| {
                let numbers = one.0.is_number() && other.0.is_number();
                one == other || (numbers && one.1 == other.1)
            })
}

/// Returns `true` if the text is one value of the type.
fn is_value(text: &str, value_type: Option<types::ValueType>) -> bool {
    match value_type {
        Some((BuiltinType::Boolean, false)) => matches!(text, "true" | "false"),
        Some((BuiltinType::String, false)) => true,
        Some((builtin, false)) if builtin.is_number() => text.parse::<f64>().is_ok(),
        Some(_) | None => false,
    }
}

/// Default time for an answer.
const WITHIN: Duration = Duration::from_secs(2);
/// Default time for the confirmation of a bridge.
const CONFIRMED_WITHIN: Duration = Duration::from_secs(1);
/// Longest time for which a value is sent again.
const LONGEST: Duration = Duration::from_secs(60);
