//! Calls: node and topic, executor, and the services and actions that offer each call.

mod bindings;
mod fields;
mod method;

use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

use self::bindings::FoundBinding;
use super::nodes::{CheckedNamespaces, NAMESPACE_ZERO, Spaces, checked_name, node_id, space};
use super::quantity::duration;
use super::servers::Servers;
use super::types::MessageTypes;
use super::{permissions, required};
use crate::call::{Call, CallBinding, CallKind, ExecutedBy, MethodTarget};
use crate::code::Code;
use crate::document::{AcknowledgesEntry, CallEntry};
use crate::findings::MappingFindings;
use crate::mapping::Variable;
use crate::node_id::NodeIdText;
use crate::read::{Located, given, short};
use crate::server::Server;
use crate::topic::{SpaceId, TopicId};
use crate::tree::TextSpan;

/// Maximum number of calls of one document.
const MAX_CALLS: usize = 5_000;
/// Timeout of a call without a `timeout`.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Context that calls are checked against.
pub(super) struct CallContext<'k> {
    pub(super) spaces: &'k Spaces,
    pub(super) namespaces: &'k CheckedNamespaces,
    pub(super) variables: &'k [Variable],
    /// The cell's own server.
    pub(super) server: &'k Server,
    pub(super) servers: &'k Servers,
}

pub(super) fn check(
    entries: &[Located<CallEntry>],
    known: CallContext<'_>,
    types: &mut MessageTypes,
    findings: &mut MappingFindings,
) -> Vec<Call> {
    if let Some(first) = entries.get(MAX_CALLS) {
        let message = format!("{} calls; at most {MAX_CALLS} are read", entries.len());
        findings.error(Code::TooLarge, first.place, message);
        return Vec::new();
    }
    let variables = known.variables.iter();
    let mut checker = Checker {
        values: variables.clone().map(|v| (v.topic, &v.name[..])).collect(),
        nodes: variables.map(|v| (&v.node, &v.name[..])).collect(),
        known: &known,
        types,
        topics: HashMap::new(),
        call_nodes: HashMap::new(),
        targets: HashMap::new(),
    };
    let calls = entries.iter().filter_map(|at| {
        let entry = at.value.as_ref()?;
        checker.call(entry, at.place, findings)
    });
    calls.collect()
}

struct Checker<'c> {
    known: &'c CallContext<'c>,
    types: &'c mut MessageTypes,
    values: BTreeMap<TopicId, &'c str>,
    nodes: HashMap<&'c NodeIdText, &'c str>,
    /// Topics and nodes of the calls before, and their positions.
    topics: HashMap<TopicId, TextSpan>,
    call_nodes: HashMap<NodeIdText, TextSpan>,
    /// Names of services and actions, and their positions.
    targets: HashMap<(SpaceId, CallKind, String), TextSpan>,
}

impl Checker<'_> {
    fn call(
        &mut self,
        entry: &CallEntry,
        place: TextSpan,
        findings: &mut MappingFindings,
    ) -> Option<Call> {
        let title = match given(&entry.name).or_else(|| given(&entry.node)) {
            Some((text, _)) => format!("the call `{}`", short(text)),
            None => "the call".to_owned(),
        };
        let node = required(&entry.node, "node", &title, place, findings)
            .and_then(|(text, place)| node_id(text, place, self.known.namespaces, findings));
        let origin =
            required(&entry.origin, "origin", &title, place, findings).and_then(|(number, at)| {
                Some((
                    space(*number, at, "origin", self.known.spaces, findings)?,
                    at,
                ))
            });
        let name = required(&entry.name, "name", &title, place, findings)
            .and_then(|(name, place)| checked_name(name, place, findings));
        let timeout = match &entry.timeout {
            Some(_) => duration(&entry.timeout, findings)?,
            None => TIMEOUT,
        };
        let callers = permissions::of_call(&entry.permissions, findings)?;
        let found = self.bindings(entry, origin.map(|(origin, _)| origin), findings);
        let method = self.method(entry, node.as_ref(), origin, findings);
        let kind = bindings::kind_of(found.as_deref(), entry, findings);
        let topic = match (&node, origin) {
            (Some((node, at)), Some((origin, _))) => {
                let kind = kind.unwrap_or(CallKind::Service);
                self.topic(entry, (node, *at), (origin, kind), findings)
            }
            _ => None,
        };
        let (node, topic, (origin, _), kind) = (node?.0, topic?, origin?, kind?);
        let method = method.ok()?;
        let acknowledges = acknowledges(entry, (origin, kind), findings)?;
        let (executed, asked) = settle(origin, found?, method, findings)?;
        let executed = if acknowledges {
            ExecutedBy::Acknowledging
        } else {
            executed
        };
        Some(Call {
            topic,
            node,
            name: name?,
            about: given(&entry.about).map_or_else(String::new, |(text, _)| text.clone()),
            kind,
            executed,
            asked,
            open: given(&entry.open).is_some_and(|(open, _)| *open),
            timeout,
            callers,
        })
    }

    fn topic(
        &mut self,
        entry: &CallEntry,
        (node, place): (&NodeIdText, TextSpan),
        (space, kind): (SpaceId, CallKind),
        findings: &mut MappingFindings,
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
        let topics: Vec<TopicId> = kind.topics(topic).collect();
        if topics.len() < kind.parts().len() {
            let message = format!("`{topic}` is an action, but fewer than four numbers follow it");
            findings
                .error(Code::CallTopic, place, message)
                .help("an action takes five consecutive numbers: use 65531 or less");
            return None;
        }
        for (topic, part) in topics.into_iter().zip(kind.parts()) {
            let taken = match self.values.get(&topic) {
                Some(name) => Some(format!("the variable `{}` uses it", short(name))),
                None => self
                    .topics
                    .insert(topic, place)
                    .map(|first| format!("first at {}", findings.line(first, place))),
            };
            let Some(label) = taken else { continue };
            let what = match *part {
                "" => String::new(),
                part => format!(", the {part} of the action,"),
            };
            findings
                .error(
                    Code::CallTopic,
                    place,
                    format!("`{topic}`{what} is already in use"),
                )
                .label(label)
                .help("give one of the two another node, or an `alias`");
            return None;
        }
        self.free_node(node, place, findings).map(|()| topic)
    }

    /// Returns `None` if another variable or call has the node.
    fn free_node(
        &mut self,
        node: &NodeIdText,
        place: TextSpan,
        findings: &mut MappingFindings,
    ) -> Option<()> {
        let label = match (
            self.nodes.get(node),
            self.call_nodes.insert(node.clone(), place),
        ) {
            (Some(name), _) => format!("the variable `{}` uses it", short(name)),
            (None, Some(first)) => format!("first at {}", findings.line(first, place)),
            (None, None) => return Some(()),
        };
        let message = format!("the node `{}` is already in use", short(&node.to_string()));
        findings
            .error(Code::CallTopic, place, message)
            .label(label)
            .help("give one of the two another node");
        None
    }
}

/// Separates the executor of a call from the bindings that offer it, and compares their types.
fn settle(
    origin: SpaceId,
    found: Vec<FoundBinding>,
    method: Option<MethodTarget>,
    findings: &mut MappingFindings,
) -> Option<(ExecutedBy, Vec<CallBinding>)> {
    let (executes, asks): (Vec<FoundBinding>, Vec<FoundBinding>) =
        found.into_iter().partition(|one| one.space == origin);
    let executor = executes.into_iter().next();
    if let Some(executor) = &executor
        && let Some(place) = executor.maps.place()
    {
        let message = format!(
            "the {} that executes the call uses its own fields",
            executor.kind.word()
        );
        findings
            .error(Code::CallMap, place, message)
            .help("move this key to the bindings of other spaces, which request the call");
        return None;
    }
    let mut asked = Vec::new();
    for one in asks {
        findings.of_part([origin, one.space]);
        fields::compare(executor.as_ref(), &one, findings);
        findings.of_part(None);
        let of = |map: Option<(crate::call::FieldMap, TextSpan)>| {
            map.map_or_else(Default::default, |(map, _)| map)
        };
        asked.push(CallBinding {
            space: one.space,
            target: one.target,
            request: of(one.maps.request),
            response: of(one.maps.response),
            feedback: of(one.maps.feedback),
        });
    }
    let executed = match (executor, method) {
        (Some(one), _) => ExecutedBy::Ros(one.target),
        (None, Some(method)) => ExecutedBy::OpcUa(method),
        (None, None) => ExecutedBy::Elsewhere,
    };
    Some((executed, asked))
}

/// Returns whether the server executes the call by acknowledging an alarm. Returns `None` for a
/// fault, which is noted.
fn acknowledges(
    entry: &CallEntry,
    (origin, kind): (SpaceId, CallKind),
    findings: &mut MappingFindings,
) -> Option<bool> {
    let Some(at) = &entry.acknowledges else {
        return Some(false);
    };
    let AcknowledgesEntry::Alarms = at.value.as_ref()?;
    let message = if entry.opcua.is_some() {
        "`acknowledges` stands beside `opcua`".to_owned()
    } else if origin != SpaceId::UA {
        format!("the call is executed in space {origin}, not by the server")
    } else if kind == CallKind::Action {
        "an alarm is acknowledged by a service, not by an action".to_owned()
    } else {
        return Some(true);
    };
    findings
        .error(Code::Alarm, at.place, message)
        .help("`acknowledges: alarms` requires `origin: 0`, excludes `opcua`, and has services as bindings");
    None
}
