//! Proposes services and actions of ROS, and Methods of OPC UA servers, as `calls` of a mapping.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use mappings::{CallKind, ExecutedBy, Mapping, NodeIdText, ServiceRole, SpaceId, TopicId};

use super::known::{OldMapping, UNTYPED};
use super::topics::camel;
use super::yaml::{comment, scalar, wrapped};
use crate::survey::model::{ModelCall, NodeModel};
use crate::survey::{SurveyedGraph, SurveyedNodes, UaMethod};

/// A proposed call.
#[derive(Clone, Debug)]
pub(super) struct CallEntry {
    pub(super) node: NodeIdText,
    pub(super) name: String,
    pub(super) origin: SpaceId,
    pub(super) what: CallExecutor,
    /// The reason why the entry is a comment.
    pub(super) faulty: Option<String>,
    /// True if the file already has the entry as a comment.
    pub(super) is_set_aside: bool,
}

/// The executor of a call.
#[derive(Clone, Debug)]
pub(super) enum CallExecutor {
    /// A service or action of the origin, with its name and type.
    Ros(CallKind, String, String),
    /// A Method of a server.
    Method { server: CallServer, target: String },
}

/// A server in a call.
#[derive(Clone, Debug)]
pub(super) enum CallServer {
    /// The name of the server in `servers`.
    Named(String),
    /// The endpoint of the server.
    At(String),
}

/// A call without a node.
pub(super) struct CallCandidate {
    pub(super) name: String,
    pub(super) origin: SpaceId,
    pub(super) what: CallExecutor,
}

impl CallCandidate {
    /// Returns the number of identifiers that the call uses.
    pub(super) const fn numbers(&self) -> u16 {
        match self.what {
            CallExecutor::Ros(CallKind::Action, ..) => 5,
            CallExecutor::Ros(CallKind::Service, ..) | CallExecutor::Method { .. } => 1,
        }
    }

    /// Returns true if both are the same service or action.
    pub(super) fn is_same(&self, other: &Self) -> bool {
        match (&self.what, &other.what) {
            (CallExecutor::Ros(kind, name, _), CallExecutor::Ros(other_kind, other_name, _)) => {
                self.origin == other.origin && kind == other_kind && name == other_name
            }
            _ => false,
        }
    }
}

/// Services without a unique type, by space.
pub(super) type Untyped = BTreeMap<SpaceId, BTreeSet<String>>;

/// Returns the calls of the models that are not in `known`, in order.
pub(super) fn modelled(models: &[NodeModel], known: &OldMapping) -> Vec<CallCandidate> {
    let calls = models.iter().flat_map(|model| &model.calls);
    let new = calls.filter(|call| {
        let names = Names::of(&known.mapping, call.origin);
        !names.has(call.kind, &call.server) && !known.mentions(&call.server)
    });
    let candidate = |call: &ModelCall| CallCandidate {
        name: call.name.clone(),
        origin: call.origin,
        what: CallExecutor::Ros(call.kind, call.server.clone(), call.type_name.clone()),
    };
    new.map(candidate).collect()
}

/// Returns the calls of `graphs` and `nodes` that are not in `known`, in order.
pub(super) fn candidates(
    graphs: &[SurveyedGraph],
    (nodes, servers): (&[SurveyedNodes], &[Option<String>]),
    known: &OldMapping,
) -> (Vec<CallCandidate>, Untyped) {
    let (mut found, mut untyped) = (Vec::new(), Untyped::new());
    for graph in graphs {
        let names = Names::of(&known.mapping, graph.space);
        let is_new = |kind: CallKind, name: &str| {
            !names.has(kind, name) && !known.mentions(name) && !is_of_space(name)
        };
        for (name, types) in graph.live.services.iter().flatten() {
            if !is_new(CallKind::Service, name) || serves_its_node(name, types) {
                continue;
            }
            match types.first().filter(|_| types.len() == 1) {
                Some(kind) => found.push(ros(CallKind::Service, graph.space, name, kind)),
                None if known.is_set_aside(name) => {}
                None => {
                    let all = untyped.entry(graph.space).or_default();
                    all.insert(name.clone());
                }
            }
        }
        for (name, types) in graph.live.actions() {
            if is_new(CallKind::Action, name)
                && let Some(kind) = types.first().filter(|_| types.len() == 1)
            {
                found.push(ros(CallKind::Action, graph.space, name, kind));
            }
        }
    }
    for (nodes, name) in nodes.iter().zip(servers) {
        let Some(server) = &nodes.server else {
            continue;
        };
        let at = match name {
            Some(name) => CallServer::Named(name.clone()),
            None => CallServer::At(server.endpoint.clone()),
        };
        let methods = nodes.methods.iter();
        found.extend(methods.filter_map(|one| method(one, (nodes, &at), known)));
    }
    (found, untyped)
}

fn ros(kind: CallKind, origin: SpaceId, name: &str, type_name: &str) -> CallCandidate {
    let parts = name.split('/').filter(|part| !part.is_empty()).map(camel);
    CallCandidate {
        name: parts.collect::<Vec<_>>().join("."),
        origin,
        what: CallExecutor::Ros(kind, name.to_owned(), type_name.to_owned()),
    }
}

fn method(
    one: &UaMethod,
    (server, at): (&SurveyedNodes, &CallServer),
    known: &OldMapping,
) -> Option<CallCandidate> {
    let expanded = |node: &NodeIdText| {
        let uri = server.namespaces.get(usize::from(node.namespace))?;
        let namespace = match node.namespace {
            0 => mappings::NamespaceText::Index(0),
            _ => mappings::NamespaceText::Uri(uri.clone()),
        };
        let identifier = node.identifier.clone();
        let text = mappings::ExpandedNodeIdText {
            namespace,
            identifier,
        };
        Some(text.to_string())
    };
    let (object, method) = (expanded(&one.object)?, expanded(&one.method)?);
    let target = format!("object: {}, method: {}", scalar(&object), scalar(&method));
    let has = known.mapping.calls().iter().any(|call| {
        matches!(&call.executed, ExecutedBy::OpcUa(target) if target.method.to_string() == method
            && target.object.to_string() == object)
    });
    let name = match one.within.as_str() {
        "" => one.name.clone(),
        within => format!("{within}.{}", one.name),
    };
    (!has && !known.mentions_method(&target)).then(|| CallCandidate {
        name,
        origin: SpaceId::UA,
        what: CallExecutor::Method {
            server: at.clone(),
            target,
        },
    })
}

/// The names of services and actions that a mapping uses in a space.
struct Names<'m>(BTreeSet<(CallWord, &'m str)>);

/// The word of a [`CallKind`], which has an order.
type CallWord = &'static str;

impl<'m> Names<'m> {
    fn of(mapping: &'m Mapping, space: SpaceId) -> Self {
        let executed = mapping.executed_in(space);
        let executed = executed.filter_map(|call| match &call.executed {
            ExecutedBy::Ros(target) => Some((call.kind.word(), target.name.as_str())),
            ExecutedBy::OpcUa(_) | ExecutedBy::Acknowledging | ExecutedBy::Elsewhere => None,
        });
        let asked = mapping.asked_in(space);
        let asked = asked.map(|(call, binding)| (call.kind.word(), binding.target.name.as_str()));
        let values = mapping.services(space);
        let values = values.filter_map(|(_, bound)| match &bound.role {
            ServiceRole::Call { service, .. } | ServiceRole::Poll { service, .. } => {
                Some((CallKind::Service.word(), service.as_str()))
            }
            ServiceRole::Answer { .. } => None,
        });
        Self(executed.chain(asked).chain(values).collect())
    }

    fn has(&self, kind: CallKind, name: &str) -> bool {
        self.0.contains(&(kind.word(), name))
    }
}

/// Returns true for a name of the space, which needs no mapping.
fn is_of_space(name: &str) -> bool {
    name.trim_start_matches('/').parse::<TopicId>().is_ok()
}

/// Returns true if the service administers its node, as its parameters do, or is hidden.
fn serves_its_node(name: &str, types: &BTreeSet<String>) -> bool {
    let last = name.rsplit('/').next().unwrap_or_default();
    let of_node = |kind: &String| {
        let package = kind.split('/').next().unwrap_or_default();
        OF_NODES.contains(&package)
    };
    EACH_NODE.contains(&last)
        || name.split('/').any(|part| part.starts_with('_'))
        || types.iter().any(of_node)
}

/// Returns the lines of the calls, and the line range of each entry.
pub(super) fn render(
    calls: &[CallEntry],
    untyped: &Untyped,
    indent: &str,
) -> (Vec<String>, Vec<Range<usize>>) {
    let (mut lines, mut entries) = (Vec::new(), Vec::new());
    let mut origin = None;
    for call in calls {
        if origin != Some(call.origin) {
            let whose = match call.origin {
                SpaceId::UA => "Methods of other OPC UA servers, which the cell's server calls",
                SpaceId::ROS1 => "services and actions of ROS 1",
                _ => "services and actions of ROS 2",
            };
            lines.extend([String::new(), format!("{indent}# {whose}")]);
            origin = Some(call.origin);
        }
        let from = lines.len();
        entry(call, indent, &mut lines);
        entries.push(from..lines.len());
    }
    let lead = format!("{indent}#   ");
    for (space, services) in untyped {
        lines.extend([
            String::new(),
            format!("{indent}# Services of space {space} {UNTYPED}"),
        ]);
        let services = services.iter().map(|name| comment(name));
        lines.extend(wrapped(&lead, services));
    }
    (lines, entries)
}

fn entry(call: &CallEntry, indent: &str, lines: &mut Vec<String>) {
    let mark = if call.faulty.is_some() { "# " } else { "" };
    let mut say = |text: String| lines.push(format!("{indent}{text}"));
    for note in call.faulty.iter().flat_map(|why| why.lines()) {
        say(format!("# {}", comment(note)));
    }
    say(format!("{mark}- node: {}", scalar(&call.node.to_string())));
    say(format!("{mark}  name: {}", scalar(&call.name)));
    say(format!("{mark}  origin: {}", call.origin));
    say(match &call.what {
        CallExecutor::Ros(kind, name, type_name) => {
            let word = kind.word();
            format!(
                "{mark}  ros: {{{word}: {}, type: {}}}",
                scalar(name),
                scalar(type_name)
            )
        }
        CallExecutor::Method { server, target } => {
            let server = match server {
                CallServer::Named(name) => format!("server: {}", scalar(name)),
                CallServer::At(endpoint) => format!("endpoint: {}", scalar(endpoint)),
            };
            format!("{mark}  opcua: {{{server}, {target}}}")
        }
    });
}

/// Services with which nodes are administered.
const EACH_NODE: [&str; 10] = [
    "describe_parameters",
    "get_loggers",
    "get_parameter_types",
    "get_parameters",
    "get_type_description",
    "list_parameters",
    "set_logger_level",
    "set_parameters",
    "set_parameters_atomically",
    "tf2_frames",
];

/// Packages of services with which nodes are administered.
const OF_NODES: [&str; 8] = [
    "composition_interfaces",
    "diagnostic_msgs",
    "dynamic_reconfigure",
    "lifecycle_msgs",
    "nodelet",
    "rcl_interfaces",
    "roscpp",
    "type_description_interfaces",
];
