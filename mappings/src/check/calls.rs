//! Calls: node, topic, what executes each and as what it is asked for.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use messages::{Leaf, ServiceType, TypeName};

use super::bindings::ros_name;
use super::network::duration;
use super::required;
use super::services::{built_in, type_name};
use super::types::{self, Types, dialect};
use super::variables::{NAMESPACE_ZERO, Namespaces, Spaces, checked_name, node_id, space};
use crate::call::{
    Assigned, Assignment, Call, CallBinding, CallKind, CallTarget, ExecutedBy, FieldMap,
};
use crate::code::Code;
use crate::document::{CallBindingEntry, CallEntry, FieldMapEntry};
use crate::findings::Findings;
use crate::mapping::Variable;
use crate::node_id::NodeIdText;
use crate::read::{At, Field, given, short};
use crate::topic::{SpaceId, TopicId};
use crate::tree::Place;

/// Most calls of one document.
const MAX_CALLS: usize = 5_000;
/// How long a call may take where nothing is said.
const TIMEOUT: Duration = Duration::from_secs(30);

/// A service under `ros`, as far as it goes.
struct Found {
    space: SpaceId,
    place: Place,
    target: CallTarget,
    service_type: Option<Arc<ServiceType>>,
    request: Option<(FieldMap, Place)>,
    response: Option<(FieldMap, Place)>,
}

pub(super) fn check(
    entries: &[At<CallEntry>],
    (spaces, namespaces, variables): (&Spaces, &Namespaces, &[Variable]),
    types: &mut Types,
    findings: &mut Findings,
) -> Vec<Call> {
    if let Some(first) = entries.get(MAX_CALLS) {
        let message = format!("{} calls; at most {MAX_CALLS} are read", entries.len());
        findings.error(Code::TooLarge, first.place, message);
        return Vec::new();
    }
    let mut checker = Checker {
        spaces,
        namespaces,
        types,
        topics: HashMap::new(),
        values: variables.iter().map(|v| (v.topic, &v.name[..])).collect(),
        services: HashMap::new(),
    };
    let calls = entries.iter().filter_map(|at| {
        let entry = at.value.as_ref()?;
        checker.call(entry, at.place, findings)
    });
    calls.collect()
}

struct Checker<'c> {
    spaces: &'c Spaces,
    namespaces: &'c Namespaces,
    types: &'c mut Types,
    /// Topics of the calls before, and where they are said.
    topics: HashMap<TopicId, Place>,
    values: BTreeMap<TopicId, &'c str>,
    services: HashMap<(SpaceId, String), Place>,
}

impl Checker<'_> {
    fn call(&mut self, entry: &CallEntry, place: Place, findings: &mut Findings) -> Option<Call> {
        let title = match given(&entry.name).or_else(|| given(&entry.node)) {
            Some((text, _)) => format!("the call `{}`", short(text)),
            None => "the call".to_owned(),
        };
        let node = required(&entry.node, "node", &title, place, findings)
            .and_then(|(text, place)| node_id(text, place, self.namespaces, findings));
        let origin = required(&entry.origin, "origin", &title, place, findings)
            .and_then(|(number, place)| space(*number, place, "origin", self.spaces, findings));
        let name = required(&entry.name, "name", &title, place, findings)
            .and_then(|(name, place)| checked_name(name, place, findings));
        let timeout = match &entry.timeout {
            Some(_) => duration(&entry.timeout, findings)?,
            None => TIMEOUT,
        };
        let topic = match (&node, origin) {
            (Some((node, at)), Some(origin)) => self.topic(entry, (node, *at), origin, findings),
            _ => None,
        };
        let found = self.bindings(entry, origin, findings);
        let (node, topic, origin) = (node?.0, topic?, origin?);
        let (executed, asked) = settle(origin, found?, findings)?;
        Some(Call {
            topic,
            node,
            name: name?,
            about: given(&entry.about).map_or_else(String::new, |(text, _)| text.clone()),
            kind: CallKind::Service,
            executed,
            asked,
            open: given(&entry.open).is_some_and(|(open, _)| *open),
            timeout,
        })
    }

    fn topic(
        &mut self,
        entry: &CallEntry,
        (node, place): (&NodeIdText, Place),
        space: SpaceId,
        findings: &mut Findings,
    ) -> Option<TopicId> {
        let alias = given(&entry.alias).and_then(|(alias, _)| std::num::NonZeroU16::new(*alias));
        let Some(identifier) = node.writer_id().or(alias) else {
            let message = format!("node `{}` needs an alias", short(&node.to_string()));
            findings
                .error(Code::AliasNeeded, place, message)
                .help("add `alias:` and a number from 1 to 65535");
            return None;
        };
        let namespace = std::num::NonZeroU16::new(node.namespace).unwrap_or(NAMESPACE_ZERO);
        let topic = TopicId {
            space,
            namespace,
            identifier,
        };
        let taken = match self.values.get(&topic) {
            Some(name) => Some(format!("the variable `{}` has it", short(name))),
            None => self
                .topics
                .insert(topic, place)
                .map(|first| format!("first at {}", findings.line(first, place))),
        };
        if let Some(label) = taken {
            findings
                .error(Code::CallTopic, place, format!("`{topic}` is taken"))
                .label(label)
                .help("give one of them another node, or an `alias`");
            return None;
        }
        Some(topic)
    }

    /// `None` where one of them is faulty.
    fn bindings(
        &mut self,
        entry: &CallEntry,
        origin: Option<SpaceId>,
        findings: &mut Findings,
    ) -> Option<Vec<Found>> {
        let entries = entry.ros.as_ref().and_then(|at| at.value.as_ref());
        let entries = entries.map_or(&[][..], |bindings| &bindings.0);
        let mut all: Option<Vec<Found>> = Some(Vec::new());
        for at in entries {
            let found = at.value.as_ref().and_then(|binding| {
                let found = self.binding(binding, at.place, origin, findings)?;
                let others = all.as_deref().unwrap_or_default();
                if others.iter().any(|other| other.space == found.space) {
                    let message = format!("the call has two services in space {}", found.space);
                    findings
                        .error(Code::CallExecutor, at.place, message)
                        .help("leave one of them out");
                    return None;
                }
                Some(found)
            });
            match (found, &mut all) {
                (Some(found), Some(all)) => all.push(found),
                _ => all = None,
            }
        }
        all
    }

    fn binding(
        &mut self,
        entry: &CallBindingEntry,
        place: Place,
        origin: Option<SpaceId>,
        findings: &mut Findings,
    ) -> Option<Found> {
        let of = match &entry.space {
            Some(at) => {
                let number = at.value?;
                (
                    space(number, at.place, "space", self.spaces, findings)?,
                    at.place,
                )
            }
            None => (origin?, place),
        };
        if of.0 == SpaceId::UA {
            findings
                .error(
                    Code::OpcUaBinding,
                    of.1,
                    "space 0 is the OPC UA side and has no services of ROS",
                )
                .help("say whose service it is with `space`");
            return None;
        }
        let dialect = dialect(of.0);
        let service = required(&entry.service, "service", "the binding", place, findings);
        let service = service.and_then(|(text, place)| {
            ros_name(text, place, (dialect, "service"), findings)?;
            Some((text.clone(), place))
        });
        let named = required(&entry.r#type, "type", "the binding", place, findings);
        let named = named.and_then(|(text, place)| {
            let name = type_name(text);
            if name.is_none() {
                findings
                    .error(
                        Code::MessageTypeName,
                        place,
                        format!("`{}` is no service type name", short(text)),
                    )
                    .help("package and name, as std_srvs/SetBool");
            }
            Some((name?, place))
        });
        let ((name, at), (type_name, type_place)) = (service?, named?);
        findings.of_part([of.0]);
        let service_type = built_in(&type_name, (dialect, type_place), self.types, findings);
        findings.of_part(None);
        if let Some(first) = self.services.insert((of.0, name.clone()), at) {
            let line = findings.line(first, at);
            findings
                .error(
                    Code::CallTwice,
                    at,
                    format!("`{name}` is the service of two calls"),
                )
                .label(format!("first at {line}"));
            return None;
        }
        Some(Found {
            space: of.0,
            place,
            target: CallTarget { name, type_name },
            service_type,
            request: field_map(&entry.request),
            response: field_map(&entry.response),
        })
    }
}

fn field_map(entry: &Field<FieldMapEntry>) -> Option<(FieldMap, Place)> {
    let (entry, place) = given(entry)?;
    let assigned = entry.0.iter();
    let assigned = assigned.map(|(target, _, value)| Assignment {
        target: target.clone(),
        value: value.clone(),
    });
    Some((FieldMap(assigned.collect()), place))
}

/// Parts who executes a call from those who ask for it, and holds their types against each other.
fn settle(
    origin: SpaceId,
    found: Vec<Found>,
    findings: &mut Findings,
) -> Option<(ExecutedBy, Vec<CallBinding>)> {
    let (executes, asks): (Vec<Found>, Vec<Found>) =
        found.into_iter().partition(|one| one.space == origin);
    let executor = executes.into_iter().next();
    if let Some(executor) = &executor {
        let maps = [&executor.request, &executor.response];
        if let Some((_, place)) = maps.into_iter().flatten().next() {
            findings
                .error(
                    Code::CallMap,
                    *place,
                    "the service that executes the call has its fields as they are",
                )
                .help("write it beside the services of other spaces, which ask for it");
            return None;
        }
    } else if origin != SpaceId::UA && asks.is_empty() {
        return Some((ExecutedBy::Elsewhere, Vec::new()));
    }
    let service_type = executor.as_ref().and_then(|one| one.service_type.clone());
    let mut asked = Vec::new();
    for one in asks {
        if let (Some(there), Some(here)) = (&service_type, &one.service_type) {
            findings.of_part([origin, one.space]);
            compare((there, here), &one, findings);
            findings.of_part(None);
        }
        asked.push(CallBinding {
            space: one.space,
            target: one.target,
            request: one.request.map(|(map, _)| map).unwrap_or_default(),
            response: one.response.map(|(map, _)| map).unwrap_or_default(),
            feedback: FieldMap::default(),
        });
    }
    let executed = executor.map_or(ExecutedBy::Elsewhere, |one| ExecutedBy::Ros(one.target));
    Some((executed, asked))
}

/// Notes where a field of the call's request, or of the response here, is made of nothing.
fn compare((there, here): (&ServiceType, &ServiceType), one: &Found, findings: &mut Findings) {
    let none = FieldMap::default();
    let map = |map: &Option<(FieldMap, Place)>| {
        map.as_ref()
            .map_or((None, one.place), |(_, at)| (Some(()), *at))
            .1
    };
    let said = |field: &'_ Option<(FieldMap, Place)>| field.as_ref().map(|(map, _)| map.clone());
    let request = said(&one.request).unwrap_or_else(|| none.clone());
    let response = said(&one.response).unwrap_or(none);
    let (leaves, given) = (there.request().leaves(), here.request().leaves());
    let fault = made(&request, (leaves, given)).or_else(|| {
        let spare =
            request.is_empty() && !leaves.is_empty() || leaves.is_empty() && !given.is_empty();
        spare.then(|| unused((leaves, given))).flatten()
    });
    let names = (there.name(), here.name());
    note(
        "request",
        (names.0, names.1),
        fault,
        map(&one.request),
        findings,
    );
    let fault = made(
        &response,
        (here.response().leaves(), there.response().leaves()),
    );
    note(
        "response",
        (names.1, names.0),
        fault,
        map(&one.response),
        findings,
    );
}

fn note(
    key: &str,
    (target, source): (&TypeName, &TypeName),
    fault: Option<String>,
    place: Place,
    findings: &mut Findings,
) {
    let Some(fault) = fault else { return };
    let message = format!("the {key} of `{target}` cannot be made of that of `{source}`: {fault}");
    findings.error(Code::CallMap, place, message).help(format!(
        "say what it is made of: `{key}: {{a: {{field: b}}, c: 1}}`"
    ));
}

/// Which field is made of nothing, or of one of another type.
fn made(map: &FieldMap, (targets, sources): (&[Leaf], &[Leaf])) -> Option<String> {
    for Assignment { target, .. } in &map.0 {
        let within = |leaf: &Leaf| {
            let head = leaf.path.get(..target.len());
            head.is_some_and(|head| head.eq_ignore_ascii_case(target))
        };
        if !targets.iter().any(within) {
            return Some(format!("there is no field `{}`", short(target)));
        }
    }
    targets.iter().find_map(|leaf| {
        let path = match map.source(&leaf.path) {
            Some(Assigned::Constant(_)) => return None,
            Some(Assigned::Field(path)) => path,
            None => leaf.path.clone(),
        };
        let wanted = types::print(types::value_type(leaf));
        let source = sources
            .iter()
            .find(|source| source.path.eq_ignore_ascii_case(&path));
        match source {
            None => Some(format!("`{}` ({wanted}) is made of nothing", leaf.path)),
            Some(source) if types::value_type(source) != types::value_type(leaf) => Some(format!(
                "`{}` is {wanted}, and `{path}` {}",
                leaf.path,
                types::print(types::value_type(source))
            )),
            Some(_) => None,
        }
    })
}

/// Which field of who asks nothing is made of, where nothing says that it is left out.
fn unused((targets, sources): (&[Leaf], &[Leaf])) -> Option<String> {
    let lost = sources.iter().find(|source| {
        let mut targets = targets.iter();
        !targets.any(|target| target.path.eq_ignore_ascii_case(&source.path))
    })?;
    Some(format!("nothing is made of `{}`", lost.path))
}
