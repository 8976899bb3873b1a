//! Checks that the names of a sound document exist in the running cell.

mod calls;
mod remote;

use super::types;
use crate::code::Code;
use crate::document::{BindingEntry, Document, VariableEntry};
use crate::environment::{Environment, LiveNode, LiveServer, LiveSpace, LiveTopic};
use crate::findings::MappingFindings;
use crate::mapping::{Binding, Mapping, ServiceRole, Variable};
use crate::read::{given, short};
use crate::topic::SpaceId;
use crate::tree::TextSpan;
use documents::nearest;

/// Checks the environment. `mapping` is made of `document` and has no errors: it has a variable or
/// call for each entry, in the same order.
pub(super) fn check(
    document: &Document,
    mapping: &Mapping,
    environment: &Environment,
    findings: &mut MappingFindings,
) {
    let entries = document.variables.as_ref().and_then(|at| at.value.as_ref());
    let entries = entries.into_iter().flatten();
    for (at, variable) in entries.zip(mapping.variables()) {
        let Some(entry) = &at.value else { continue };
        for binding in &variable.bindings {
            if let Some(space) = environment.spaces.get(&binding.space) {
                let place = topic_place(entry, variable, binding.space).unwrap_or(at.place);
                topic(variable, binding, space, place, findings);
            }
        }
        service(entry, variable, environment, at.place, findings);
        remote::check(entry, variable, environment, findings);
        if let Some(server) = &environment.server {
            node(entry, variable, mapping, server, findings);
        }
    }
    let entries = document.calls.as_ref().and_then(|at| at.value.as_ref());
    let entries = entries.into_iter().flatten();
    for (at, call) in entries.zip(mapping.calls()) {
        if let Some(entry) = &at.value {
            calls::check(entry, call, environment, at.place, findings);
        }
    }
    let entries = document.patterns.as_ref().and_then(|at| at.value.as_ref());
    let entries = entries.into_iter().flatten();
    for (at, pattern) in entries.zip(mapping.patterns()) {
        if let Some(space) = environment.spaces.get(&pattern.origin()) {
            let place = at.value.as_ref().and_then(|entry| given(&entry.topics));
            let place = place.map_or(at.place, |(_, place)| place);
            unmatched(mapping, pattern, space, place, findings);
        }
    }
    if let (Some(server), Some(namespaces)) = (&environment.server, &document.namespaces) {
        for (index, uri) in namespaces.value.iter().flatten() {
            if let (Some(number), Some(text)) = (index.value, &uri.value) {
                namespace(number, text, uri.place, server, findings);
            }
        }
    }
}

/// Returns the entry of the binding of a space.
fn binding_entry<'d>(
    entry: &'d VariableEntry,
    variable: &Variable,
    space: SpaceId,
) -> Option<&'d BindingEntry> {
    let (bindings, _) = given(&entry.ros)?;
    let of_space = |binding: &&BindingEntry| match given(&binding.space) {
        Some((number, _)) => *number == u16::from(space.get()),
        None => variable.topic.space == space,
    };
    let entries = bindings.0.iter().filter_map(|at| at.value.as_ref());
    let mut entries = entries.filter(of_space);
    entries.next()
}

fn topic_place(entry: &VariableEntry, variable: &Variable, space: SpaceId) -> Option<TextSpan> {
    let binding = binding_entry(entry, variable, space)?;
    given(&binding.topic).map(|(_, place)| place)
}

fn topic(
    variable: &Variable,
    binding: &Binding,
    space: &LiveSpace,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let name = &binding.ros_topic;
    let read = binding.space == variable.topic.space;
    let wanted = |topic: &LiveTopic| {
        if read {
            topic.published
        } else {
            topic.subscribed
        }
    };
    let live = space.topics.get(name).filter(|topic| wanted(topic));
    let Some(live) = live else {
        let does = if read { "publishes" } else { "subscribes to" };
        let message = format!("no node {does} `{}` at the moment", short(name));
        let there = space.topics.iter().filter(|(_, topic)| wanted(topic));
        let near = nearest(name, there.map(|(name, _)| name.as_str()));
        let note = findings.warning(Code::TopicAway, place, message);
        note.help(near.map_or_else(
            || absent_help(read).to_owned(),
            |near| format!("did you mean `{}`?", short(near)),
        ));
        return;
    };
    let subject = format!("`{}` is bound", short(name));
    let wanted = binding.message_type.as_str();
    compare_type(&subject, wanted, &live.types, place, findings);
}

/// Warns if a name of the running cell has another type than the mapping has for it.
fn compare_type<'t>(
    subject: &str,
    wanted: &str,
    types: impl IntoIterator<Item = &'t String>,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let other = types.into_iter().find(|of| of.as_str() != wanted);
    if let Some(other) = other.map(|other| short(other)) {
        let message = format!("{subject} as {wanted}, but its current type is {other}");
        findings
            .warning(Code::LiveTypeDiffers, place, message)
            .help(format!("type: {other}"));
    }
}

const fn absent_help(read: bool) -> &'static str {
    if read {
        "check that its node runs, and in this graph"
    } else {
        "the bridge publishes it anyway; check that the subscribing node runs"
    }
}

fn service(
    entry: &VariableEntry,
    variable: &Variable,
    environment: &Environment,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let Some(bound) = &variable.service else {
        return;
    };
    let (ServiceRole::Call {
        service,
        service_type,
        ..
    }
    | ServiceRole::Poll {
        service,
        service_type,
        ..
    }) = &bound.role
    else {
        return;
    };
    let live = environment.spaces.get(&bound.space);
    let Some(services) = live.and_then(|live| live.services.as_ref()) else {
        return;
    };
    let binding = binding_entry(entry, variable, bound.space);
    let named = binding.and_then(|one| given(&one.call).or_else(|| given(&one.poll)));
    let place = named.map_or(place, |(_, place)| place);
    let Some(types) = services.get(service) else {
        let message = format!(
            "no node offers the service `{}` at the moment",
            short(service)
        );
        let note = findings.warning(Code::ServiceAway, place, message);
        if let Some(near) = nearest(service, services.keys().map(String::as_str)) {
            note.help(format!("did you mean `{}`?", short(near)));
        }
        return;
    };
    let subject = format!("the service `{}` is called", short(service));
    compare_type(&subject, service_type.as_str(), types, place, findings);
}

fn unmatched(
    mapping: &Mapping,
    pattern: &crate::Pattern,
    space: &LiveSpace,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let published = space.topics.iter().filter(|(_, topic)| topic.published);
    let (mut other_types, mut fits) = (None, false);
    for (name, topic) in published {
        let bound = mapping
            .bindings(pattern.origin())
            .any(|(_, binding)| binding.ros_topic == *name);
        if bound || pattern.matches(name).is_none() {
            continue;
        }
        let takes = |live: &String| {
            let wanted = pattern.message_type.as_ref();
            wanted.is_none_or(|wanted| wanted.as_str() == live)
        };
        if topic.types.is_empty() || topic.types.iter().any(takes) {
            fits = true;
            break;
        }
        let told = topic.types.first().map_or("", String::as_str);
        other_types.get_or_insert((name, told));
    }
    if fits {
        return;
    }
    let message = format!(
        "no topic matches `{}` at the moment",
        short(pattern.topics())
    );
    let note = findings.warning(Code::PatternUnmatched, place, message);
    note.help(match other_types {
        Some((name, told)) => format!(
            "`{}` matches the name, but its type {} differs from `type`",
            short(name),
            short(told)
        ),
        None => "check that a robot with such topics runs; `*` matches within a part, `**` matches parts"
            .to_owned(),
    });
}

fn namespace(
    index: u16,
    uri: &str,
    place: TextSpan,
    server: &LiveServer,
    findings: &mut MappingFindings,
) {
    let there = server.namespaces.get(usize::from(index));
    if there.is_some_and(|there| there == uri) {
        return;
    }
    let found = server.namespaces.iter().position(|other| other == uri);
    let message = match there {
        Some(there) => format!("namespace {index} of the server is `{}`", short(there)),
        None => format!(
            "the server has no namespace {index}: its highest is {}",
            server.namespaces.len().saturating_sub(1)
        ),
    };
    let note = findings.warning(Code::NamespaceIndex, place, message);
    let near = nearest(uri, server.namespaces.iter().map(String::as_str));
    note.help(match (found, near) {
        (Some(other), _) => {
            format!("the server has this URI at index {other}: write ns={other} in the node ids and here")
        }
        (None, Some(near)) => format!("did you mean `{}`?", short(near)),
        (None, None) => "the server does not have this URI".to_owned(),
    });
}

fn node(
    entry: &VariableEntry,
    variable: &Variable,
    mapping: &Mapping,
    server: &LiveServer,
    findings: &mut MappingFindings,
) {
    let text = variable.node.to_string();
    let uri = mapping.namespaces().get(&variable.node.namespace);
    let Some((_, place)) = given(&entry.node) else {
        return;
    };
    // If the namespace differs there, the finding about the namespace is enough.
    if !server.agrees(&variable.node, uri.map(String::as_str)) {
        return;
    }
    match server.nodes.get(&text) {
        None | Some(LiveNode::Variable(None)) => {}
        Some(LiveNode::Away) => {
            let message = format!("the server has no variable `{}`", short(&text));
            findings.warning(Code::NodeAway, place, message);
        }
        Some(LiveNode::Variable(Some(live))) => {
            if let Some(declared) = variable.value_type.filter(|declared| declared != live) {
                let message = format!(
                    "`{}` is {} here and {} in the server",
                    short(&text),
                    types::print(declared),
                    types::print(*live)
                );
                let place = given(&entry.r#type).map_or(place, |(_, place)| place);
                findings
                    .warning(Code::LiveNodeDiffers, place, message)
                    .help(format!("type: {}", types::print(*live)));
            }
        }
    }
}
