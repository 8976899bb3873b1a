//! Checks that the executor of a call exists, and that the names that offer the call are free.

use std::collections::{BTreeMap, BTreeSet};

use crate::call::{Call, CallKind, CallTarget, ExecutedBy};
use crate::code::Code;
use crate::document::{CallBindingEntry, CallEntry};
use crate::environment::{Environment, LiveSpace};
use crate::findings::MappingFindings;
use crate::read::{given, short};
use crate::topic::SpaceId;
use crate::tree::TextSpan;
use documents::nearest;

pub(super) fn check(
    entry: &CallEntry,
    call: &Call,
    environment: &Environment,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let at = |space: SpaceId| name_place(entry, call, space).unwrap_or(place);
    match &call.executed {
        ExecutedBy::Ros(target) => {
            let space = call.topic.space;
            if let Some(there) = environment
                .spaces
                .get(&space)
                .and_then(|s| offered(s, call.kind))
            {
                executed(call.kind, target, &there, at(space), findings);
            }
        }
        ExecutedBy::OpcUa(target) => {
            let mut asked = environment.methods.iter();
            if let Some((_, Some(why))) = asked.find(|(method, _)| method == target) {
                let named = given(&entry.opcua).and_then(|(target, _)| given(&target.method));
                let place = named.map_or(place, |(_, place)| place);
                findings
                    .warning(Code::MethodAway, place, why.clone())
                    .help("the call is offered only while the server has the Method");
            }
        }
        ExecutedBy::Acknowledging | ExecutedBy::Elsewhere => {}
    }
    for binding in &call.asked {
        let live = environment.spaces.get(&binding.space);
        let Some(there) = live.and_then(|live| offered(live, call.kind)) else {
            continue;
        };
        let name = &binding.target.name;
        if there.contains_key(name.as_str()) {
            let word = call.kind.word();
            let message = format!(
                "another node offers the {word} `{}` at the moment",
                short(name)
            );
            findings
                .warning(Code::NameTaken, at(binding.space), message)
                .help("clients would reach either of the two: use another name");
        }
    }
}

/// Returns the services or actions that the graph offers, with their types; `None` if the graph was
/// not queried.
fn offered(live: &LiveSpace, kind: CallKind) -> Option<BTreeMap<&str, BTreeSet<String>>> {
    match kind {
        CallKind::Service => {
            let services = live.services.as_ref()?.iter();
            Some(
                services
                    .map(|(name, types)| (name.as_str(), types.clone()))
                    .collect(),
            )
        }
        CallKind::Action => Some(live.actions()),
    }
}

fn executed(
    kind: CallKind,
    target: &CallTarget,
    there: &BTreeMap<&str, BTreeSet<String>>,
    place: TextSpan,
    findings: &mut MappingFindings,
) {
    let (word, name) = (kind.word(), target.name.as_str());
    let Some(types) = there.get(name) else {
        let message = format!("no node offers the {word} `{}` at the moment", short(name));
        let note = findings.warning(Code::ServiceAway, place, message);
        note.help(match nearest(name, there.keys().copied()) {
            Some(near) => format!("did you mean `{}`?", short(near)),
            None => "check that its node runs, and in this graph".to_owned(),
        });
        return;
    };
    let subject = format!("the {word} `{}` is bound", short(name));
    super::compare_type(&subject, target.type_name.as_str(), types, place, findings);
}

/// Returns the position of the name of the service or action of a space.
fn name_place(entry: &CallEntry, call: &Call, space: SpaceId) -> Option<TextSpan> {
    let (bindings, _) = given(&entry.ros)?;
    let of_space = |binding: &&CallBindingEntry| match given(&binding.space) {
        Some((number, _)) => *number == u16::from(space.get()),
        None => call.topic.space == space,
    };
    let mut entries = bindings.0.iter().filter_map(|at| at.value.as_ref());
    let binding = entries.find(of_space)?;
    let named = given(&binding.service).or_else(|| given(&binding.action));
    named.map(|(_, place)| place)
}
