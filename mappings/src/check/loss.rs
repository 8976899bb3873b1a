//! Reaction to the loss of a value's commander.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use messages::{MessagePlan, MessageType, Selection, TypeName, Wire};

use super::quantity::duration;
use super::required;
use super::types::{MessageTypes, dialect};
use crate::code::Code;
use crate::document::{OnLossEntry, Request, VariableEntry};
use crate::findings::MappingFindings;
use crate::loss::{Loss, LossAction, Motion};
use crate::mapping::{Binding, Lasting, ServiceRole, Variable};
use crate::node_id::NodeIdText;
use crate::read::short;
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

/// Reads `on_loss` and `hold`, and warns of commands that move a robot without an end. Faults are
/// noted.
pub(super) fn check<'d>(
    entries: impl Iterator<Item = (TopicId, &'d VariableEntry)>,
    variables: &mut [Variable],
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) {
    let by_node: HashMap<NodeIdText, TopicId> = variables
        .iter()
        .filter(|variable| is_stop_call(variable))
        .map(|variable| (variable.node.clone(), variable.topic))
        .collect();
    let at: HashMap<TopicId, usize> = (0..)
        .zip(variables.iter())
        .map(|(at, variable)| (variable.topic, at))
        .collect();
    for (topic, entry) in entries {
        let Some(variable) = at.get(&topic).and_then(|at| variables.get_mut(*at)) else {
            continue;
        };
        variable.loss = loss(entry, variable, (&by_node, types), findings).map(Box::new);
        warn(entry, variable, findings);
    }
}

/// Returns `None` without `on_loss`, or for a faulty entry, which is noted.
fn loss(
    entry: &VariableEntry,
    variable: &Variable,
    (by_node, types): (&HashMap<NodeIdText, TopicId>, &mut MessageTypes),
    findings: &mut MappingFindings,
) -> Option<Loss> {
    let hold = duration(&entry.hold, findings);
    let Some(at) = &entry.on_loss else {
        if let Some(hold) = &entry.hold {
            findings
                .error(Code::OnLoss, hold.place, "`hold` stands without `on_loss`")
                .help("add the value that is published after this time, such as `on_loss: zero`");
        }
        return None;
    };
    let said = at.value.as_ref()?;
    if entry.hold.is_some() && hold.is_none() {
        return None;
    }
    let written: Vec<&Binding> = commanded(variable).collect();
    let called = called(variable);
    if written.is_empty() && called.is_none() {
        findings
            .error(
                Code::OnLoss,
                at.place,
                "the value is not published to a ROS topic and does not call a service",
            )
            .help("`on_loss` requires a topic or a `call` in a space other than the `origin`");
        return None;
    }
    let action = match said {
        OnLossEntry::Zero => LossAction::Message(BTreeMap::new()),
        OnLossEntry::Value(literal) => LossAction::Field(literal.clone()),
        OnLossEntry::Fields(Request(all)) => {
            let fields = all.iter();
            let fields = fields.map(|(path, _, literal)| (path.clone(), literal.clone()));
            LossAction::Message(fields.collect())
        }
        OnLossEntry::Call(call) => LossAction::Call(stop_call(call, at.place, by_node, findings)?),
    };
    if !matches!(action, LossAction::Call(_)) {
        for binding in written {
            fits(binding, &action, (at.place, types), findings)?;
        }
        if let Some(called) = called {
            fits_request(called, &action, (at.place, types), findings)?;
        }
    }
    Some(Loss { action, hold })
}

/// Returns the variable with the service that stops the robot.
fn stop_call(
    call: &crate::document::StopCallEntry,
    place: TextSpan,
    by_node: &HashMap<NodeIdText, TopicId>,
    findings: &mut MappingFindings,
) -> Option<TopicId> {
    let (node, at) = required(&call.call, "call", "`on_loss`", place, findings)?;
    let found = node.parse::<NodeIdText>().ok();
    let found = found.and_then(|node| by_node.get(&node));
    if found.is_none() {
        let message = format!(
            "the node `{}` does not belong to a variable that can stop the robot",
            short(node)
        );
        findings
            .error(Code::OnLoss, at, message)
            .help("use a variable with a `call` without `field`, such as {call: /stop, type: std_srvs/Trigger}");
    }
    found.copied()
}

/// Checks that the message can be made; an unknown type is checked by the host that has it.
fn fits(
    binding: &Binding,
    action: &LossAction,
    (place, types): (TextSpan, &mut MessageTypes),
    findings: &mut MappingFindings,
) -> Option<()> {
    let Some(template) = action.template(&binding.selection) else {
        findings
            .error(
                Code::OnLoss,
                place,
                "a single value for a topic that is bound to several fields",
            )
            .help("give `zero`, or fields of the message, such as {linear.x: 0.1}");
        return None;
    };
    if binding.selection == Selection::Bytes {
        findings
            .error(
                Code::OnLoss,
                place,
                "the message is transferred as bytes, so its fields are unknown",
            )
            .help("remove `as: bytes`");
        return None;
    }
    let dialect = dialect(binding.space);
    let Ok(message) = types.get((dialect, place), &binding.message_type, findings) else {
        return Some(());
    };
    can_be_made(&message, &template, (binding.space, place), findings)
}

/// Checks the request of a service, as [`fits`] does a message.
fn fits_request(
    (space, service_type, request): (SpaceId, &TypeName, &Selection),
    action: &LossAction,
    (place, types): (TextSpan, &mut MessageTypes),
    findings: &mut MappingFindings,
) -> Option<()> {
    let Some(template) = action.template(request) else {
        findings
            .error(
                Code::OnLoss,
                place,
                "the request of the service does not have a single field for the value",
            )
            .help(
                "give fields of the request, such as {data: false}, or {call: ns=2;i=48} for another service",
            );
        return None;
    };
    let Some(service) = types.service((dialect(space), place), service_type, findings) else {
        return Some(());
    };
    can_be_made(service.request(), &template, (space, place), findings)
}

fn can_be_made(
    message: &Arc<MessageType>,
    template: &Selection,
    (space, place): (SpaceId, TextSpan),
    findings: &mut MappingFindings,
) -> Option<()> {
    let wire = match space {
        SpaceId::ROS1 => Wire::Ros1,
        _ => Wire::Cdr,
    };
    match MessagePlan::compile(message, template, wire) {
        Ok(_) => Some(()),
        Err(error) => {
            findings.of_part([space]);
            findings.error(Code::OnLoss, place, error.to_string());
            findings.of_part(None);
            None
        }
    }
}

/// Returns the service in another space that the values of a variable call: its space and type, and
/// the request.
fn called(variable: &Variable) -> Option<(SpaceId, &TypeName, &Selection)> {
    let service = variable.service.as_ref()?;
    let ServiceRole::Call {
        service_type,
        request,
        ..
    } = &service.role
    else {
        return None;
    };
    (service.space != variable.topic.space).then_some((service.space, service_type, request))
}

/// Returns the topics that the values of a variable command.
fn commanded(variable: &Variable) -> impl Iterator<Item = &Binding> {
    let origin = variable.topic.space;
    let bindings = variable.bindings.iter();
    bindings.filter(move |binding| binding.space != origin)
}

/// Returns `true` if the values of a variable call a service with the same request each time.
fn is_stop_call(variable: &Variable) -> bool {
    variable.service.as_ref().is_some_and(|service| {
        matches!(
            &service.role,
            ServiceRole::Call { request: Selection::Template { fields, .. }, .. } if fields.is_empty()
        )
    })
}

/// Warns of a motion that continues after the loss of its commander, and of a motion that is stored
/// for late subscribers.
fn warn(entry: &VariableEntry, variable: &Variable, findings: &mut MappingFindings) {
    let Some(place) = entry.ros.as_ref().map(|at| at.place) else {
        return;
    };
    let types = commanded(variable).map(|binding| &binding.message_type);
    let Some((message_type, motion)) = types
        .filter_map(|name| Some((name, Motion::of(name)?)))
        .next()
    else {
        return;
    };
    if variable.lasting == Lasting::State {
        let place = entry.queue.as_ref().map_or(place, |at| at.place);
        let message = format!(
            "`keep_latest` delivers an old {message_type} to a subscriber that starts late"
        );
        findings
            .warning(Code::StoredMotion, place, message)
            .help("remove `queue`, so that only present subscribers receive it");
    }
    if motion == Motion::NotByZero && entry.on_loss.is_none() {
        let message = format!(
            "the movement of the last {message_type} continues after its commander is lost"
        );
        findings
            .warning(Code::EndlessMotion, place, message)
            .help("zero is a movement for this type: give `on_loss` the fields of a message that stops the \
                   robot, or a `call`");
    }
}
