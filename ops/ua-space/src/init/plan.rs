//! Plans a mapping of the inspected sources: joins topics and nodes, and leaves out topics of ROS
//! itself.

mod models;

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use mappings::{LiveTopic, NodeIdText, SpaceId};
use messages::{TypeName, TypeRegistry};
use uadp::BuiltinType;

use super::calls::{self, CallEntry, CallExecutor, Untyped};
use super::known::{NodeServer, OldMapping, ServerName};
use super::nodes::{Indexes, is_at, is_same, source_of};
use super::topics::{OmittedTopic, ValueForm, camel, normal, registry};
use crate::survey::model::NodeModel;
use crate::survey::{SurveyedGraph, SurveyedNodes, UaServer, UaSource, UaVariable};

/// The contents of the mapping, in order.
#[derive(Default)]
pub(super) struct Proposal {
    pub(super) spaces: Vec<(SpaceId, Option<u16>)>,
    pub(super) namespaces: BTreeMap<u16, String>,
    /// The endpoint of the server of the cell.
    pub(super) endpoint: Option<String>,
    /// Names and endpoints of existing servers.
    pub(super) servers: Vec<(String, String)>,
    pub(super) entries: Vec<ProposedVariable>,
    pub(super) left_out: BTreeMap<(SpaceId, OmittedTopic), BTreeSet<String>>,
    /// Topics to which a variable of the file could be bound additionally.
    pub(super) proposals: Vec<String>,
    pub(super) calls: Vec<CallEntry>,
    pub(super) untyped: Untyped,
}

/// A proposed variable.
#[derive(Clone, Debug)]
pub(super) struct ProposedVariable {
    /// The heading under which the variables of a group are listed.
    pub(super) group: String,
    pub(super) node: NodeIdText,
    pub(super) alias: Option<u16>,
    pub(super) name: String,
    pub(super) value: Option<(BuiltinType, bool)>,
    pub(super) origin: SpaceId,
    pub(super) bindings: Vec<BoundTopic>,
    /// The node of another server that is the source of the value, or its target if ROS produces
    /// the value.
    pub(super) source: Option<UaSource>,
    pub(super) notes: Vec<String>,
    /// True if the join of topics or nodes is a guess.
    pub(super) guessed: bool,
    /// The reason why the entry is a comment.
    pub(super) faulty: Option<String>,
    /// True if the file already has the entry as a comment.
    pub(super) is_set_aside: bool,
}

/// A topic to which the variable is bound.
#[derive(Clone, Debug)]
pub(super) struct BoundTopic {
    pub(super) space: SpaceId,
    pub(super) topic: String,
    pub(super) kind: TypeName,
    pub(super) form: ValueForm,
}

/// The options from the command line.
pub(super) struct Wishes<'a> {
    /// The URI of the namespace for values without a node.
    pub(super) namespace: &'a str,
    pub(super) transforms: bool,
}

impl Proposal {
    /// Plans the values and calls of `models`, and the topics and nodes of `graphs` and `nodes`,
    /// that are not in `known`.
    pub(super) fn new(
        models: &[NodeModel],
        graphs: &[SurveyedGraph],
        nodes: &[SurveyedNodes],
        wishes: &Wishes<'_>,
        known: &mut OldMapping,
    ) -> Self {
        let mut planner = Planner {
            plan: Self::default(),
            registries: [registry(false), registry(true)],
            ua: Vec::new(),
            alike: HashMap::new(),
            modelled: HashSet::new(),
            of_models: HashMap::new(),
            known,
        };
        planner.spaces(graphs);
        planner.models(models, wishes.namespace);
        let servers = planner.servers(nodes);
        planner.nodes(nodes, &servers, wishes.namespace);
        planner.topics(graphs, wishes);
        planner.rest();
        planner.calls(models, graphs, (nodes, &servers), wishes.namespace);
        planner.plan
    }
}

struct Planner<'k> {
    plan: Proposal,
    /// The registries of ROS 1 and of ROS 2.
    registries: [TypeRegistry; 2],
    /// Nodes without a variable, in the namespaces of the mapping; `None` once the node has a
    /// variable.
    ua: Vec<Option<UaVariable>>,
    /// Positions of the nodes by name, as [`normal`] returns it.
    alike: HashMap<String, Vec<usize>>,
    /// The topics that models bind.
    modelled: HashSet<(SpaceId, String)>,
    /// Positions of the entries of models by their nodes.
    of_models: HashMap<NodeIdText, usize>,
    known: &'k mut OldMapping,
}

impl Planner<'_> {
    fn spaces(&mut self, graphs: &[SurveyedGraph]) {
        for graph in graphs {
            if self.known.mapping.space(graph.space).is_none() {
                self.plan.spaces.push((graph.space, graph.domain));
            }
        }
    }

    /// Returns the names of the servers, `None` for NodeSet files and for the server of the cell.
    fn servers(&mut self, sources: &[SurveyedNodes]) -> Vec<Option<String>> {
        let mut names = Vec::with_capacity(sources.len());
        for source in sources {
            let name = match &source.server {
                Some(server) if server.is_cell => {
                    let endpoint = &mut self.plan.endpoint;
                    endpoint.get_or_insert_with(|| server.endpoint.clone());
                    None
                }
                Some(server) => Some(self.server(server)),
                None => None,
            };
            names.push(name);
        }
        // The server of the cell gets an endpoint that no other server on this host uses.
        let ports = |port: u16| {
            let mut all = self.plan.servers.iter();
            all.any(|(_, endpoint)| is_at(endpoint, port))
        };
        if self.plan.endpoint.is_none() && ports(OWN_PORT) {
            let free = (OWN_PORT..=u16::MAX).find(|port| !ports(*port));
            self.plan.endpoint = free.map(|port| format!("opc.tcp://127.0.0.1:{port}"));
        }
        names
    }

    fn server(&mut self, server: &UaServer) -> String {
        let endpoint = &server.endpoint;
        let mut planned = self.plan.servers.iter();
        if let Some((name, _)) = planned.find(|(_, other)| is_same(other, endpoint)) {
            return name.clone();
        }
        match self.known.server(endpoint, &server.name) {
            ServerName::Known(name) => name,
            ServerName::New(name) => {
                self.plan.servers.push((name.clone(), endpoint.clone()));
                name
            }
        }
    }

    /// Collects the new nodes, in the namespaces of the mapping.
    fn nodes(&mut self, sources: &[SurveyedNodes], servers: &[Option<String>], uri: &str) {
        let mut indexes = self.indexes();
        let mut taken = BTreeSet::new();
        let (mut ua, mut twins) = (Vec::new(), Vec::new());
        for (source, server) in sources.iter().zip(servers) {
            let indexes = indexes.give(source);
            for one in &source.variables {
                // Nodes of a namespace without an index are left out.
                let Some(namespace) = indexes.get(&one.node.namespace) else {
                    continue;
                };
                let node = NodeIdText {
                    namespace: *namespace,
                    identifier: one.node.identifier.clone(),
                };
                if let Some(number) = node.writer_id() {
                    self.known.use_number(*namespace, number.get());
                }
                let from = server.as_deref();
                let from = from.map(|server| source_of(server, &one.node, &source.namespaces));
                if let Some(at) = self.of_models.get(&node) {
                    // The server has the node of the model.
                    if let Some(entry) = self.plan.entries.get_mut(*at) {
                        if entry.source.is_none() && from.is_some() && entry.origin != SpaceId::UA {
                            // The mapping would command the machine of the server.
                            let note = "guess: ROS writes the value into the node of the server";
                            entry.notes.push(note.to_owned());
                            entry.guessed = true;
                        }
                        entry.source = entry.source.take().or(from);
                        entry.value = entry.value.or(one.value);
                    }
                    continue;
                }
                let known = match &from {
                    Some(from) if self.known.has_source(from) => continue,
                    // Two servers of the same model have nodes of the same names.
                    Some(from) => self.known.has_node_of(&node, &from.server),
                    None => self.known.has_node(&node).then_some(NodeServer::Same),
                };
                let one = UaVariable {
                    source: from,
                    ..one.clone()
                };
                match known {
                    Some(NodeServer::Same) => {}
                    None if taken.insert(node.to_string()) => ua.push(UaVariable { node, ..one }),
                    Some(NodeServer::Other) | None if one.source.is_some() => twins.push(one),
                    Some(NodeServer::Other) | None => {}
                }
            }
        }
        self.plan.namespaces.append(&mut indexes.given);
        self.twins(twins, uri, &mut ua);
        let key = |one: &UaVariable| (one.within.clone(), one.name.clone(), one.node.to_string());
        ua.sort_by_cached_key(key);
        for (at, one) in ua.iter().enumerate() {
            let alone = normal(&one.name);
            let within = normal(&format!("{}{}", one.within, one.name));
            if within != alone {
                self.alike.entry(within).or_default().push(at);
            }
            self.alike.entry(alone).or_default().push(at);
        }
        self.ua = ua.into_iter().map(Some).collect();
    }

    /// Assigns numbers in the namespace of values without a node to nodes with a node id that a
    /// node of another server already uses.
    fn twins(&mut self, twins: Vec<UaVariable>, uri: &str, ua: &mut Vec<UaVariable>) {
        for twin in twins {
            let namespace = self.namespace(uri);
            let number = namespace.and_then(|namespace| self.known.next_number(namespace));
            let (Some(namespace), Some(number)) = (namespace, number) else {
                return;
            };
            let identifier = mappings::Identifier::Numeric(number.into());
            let node = NodeIdText {
                namespace,
                identifier,
            };
            ua.push(UaVariable { node, ..twin });
        }
    }

    fn topics(&mut self, graphs: &[SurveyedGraph], wishes: &Wishes<'_>) {
        let mut names: BTreeMap<&str, Vec<(SpaceId, &LiveTopic)>> = BTreeMap::new();
        for graph in graphs {
            for (name, topic) in &graph.live.topics {
                names.entry(name).or_default().push((graph.space, topic));
            }
        }
        let mut found = Vec::new();
        for (name, ends) in names {
            if !self.known.mentions(name) {
                let bound = self.bound(name, ends, wishes.transforms);
                found.extend(candidates(name, bound));
            }
        }
        found.sort_by_key(|one| (one.group.is_empty(), one.group.clone(), one.topic.clone()));
        for one in found {
            self.entry(one, wishes.namespace);
        }
    }

    /// Returns the binding of the topic in each space that has it, and whether it is published
    /// there.
    fn bound(
        &mut self,
        name: &str,
        ends: Vec<(SpaceId, &LiveTopic)>,
        transforms: bool,
    ) -> Vec<(BoundTopic, bool)> {
        let mut bound = Vec::new();
        for (space, topic) in ends {
            let kind = match topic.types.first() {
                Some(kind) if topic.types.len() == 1 => kind.parse::<TypeName>().ok(),
                Some(_) | None => None,
            };
            if let Some(why) = OmittedTopic::of(name, kind.as_ref(), transforms) {
                self.leave_out(space, why, name);
                continue;
            }
            if self.modelled.contains(&(space, name.to_owned())) {
                continue;
            }
            let Some(kind) = kind else {
                if self.known.is_set_aside(name) {
                    continue;
                }
                self.leave_out(space, OmittedTopic::Untyped, name);
                continue;
            };
            if self.known.bound(space, name, Some(&kind)) {
                continue;
            }
            if let Some(variable) = self.known.variable_of(name) {
                self.plan.proposals.push(format!(
                    "{name} is in space {space} too, as {kind}: {variable} could be bound to it"
                ));
                continue;
            }
            let [ros1, ros2] = &self.registries;
            let form = ValueForm::of(&kind, if space.is_ros2() { ros2 } else { ros1 });
            let one = BoundTopic {
                space,
                topic: name.to_owned(),
                kind,
                form,
            };
            bound.push((one, topic.published));
        }
        bound
    }

    fn leave_out(&mut self, space: SpaceId, why: OmittedTopic, name: &str) {
        let topics = self.plan.left_out.entry((space, why)).or_default();
        topics.insert(name.to_owned());
    }

    fn entry(&mut self, candidate: Candidate, namespace: &str) {
        let Candidate {
            group,
            topic,
            origin,
            bindings,
        } = candidate;
        let value = match bindings.first().map(|one| &one.form) {
            Some(ValueForm::Field(_, value)) => *value,
            Some(ValueForm::Whole | ValueForm::Bytes) | None => None,
        };
        let mut notes = Vec::new();
        let mut guessed = bindings.len() > 1;
        if guessed {
            notes.push("guess: one value on both sides".to_owned());
        }
        let alike = self.alike.get(&normal(&topic)).into_iter().flatten();
        let mut alike = alike.filter_map(|at| Some((*at, self.ua.get(*at)?.as_ref()?)));
        let node = match (alike.next(), alike.next(), value) {
            (Some((at, one)), None, Some(value)) if one.value == Some(value) => Some(at),
            (Some((_, one)), None, _) => {
                notes.push(format!(
                    "the node {} is named alike, and is of another type",
                    one.node
                ));
                None
            }
            (Some(_), Some(_), _) => {
                notes.push("several nodes are named alike".to_owned());
                None
            }
            (None, ..) => None,
        };
        let (node, name, source) = match node.and_then(|at| self.ua.get_mut(at)?.take()) {
            Some(one) => {
                guessed = true;
                notes.push("guess: the node has the topic's name and type".to_owned());
                (one.node, one.name, one.source)
            }
            None => {
                let Some(namespace) = self.namespace(namespace) else {
                    return;
                };
                let Some(number) = self.known.next_number(namespace) else {
                    return;
                };
                let identifier = mappings::Identifier::Numeric(number.into());
                (
                    NodeIdText {
                        namespace,
                        identifier,
                    },
                    camel(&topic),
                    None,
                )
            }
        };
        self.push(ProposedVariable {
            group,
            node,
            alias: None,
            name,
            value,
            origin,
            bindings,
            source,
            notes,
            guessed,
            faulty: None,
            is_set_aside: self.known.is_set_aside(&topic),
        });
    }

    /// Returns the namespace indexes of the mapping and of the plan.
    fn indexes(&self) -> Indexes {
        let mut all = self.known.mapping.namespaces().clone();
        all.extend(self.plan.namespaces.clone());
        Indexes::of(&all)
    }

    /// Returns the namespace of values without a node; `None` if no index is free.
    fn namespace(&mut self, uri: &str) -> Option<u16> {
        let all = self.known.mapping.namespaces().iter();
        let all = all.chain(&self.plan.namespaces);
        let there = all.clone().find(|(_, other)| *other == uri);
        if let Some((index, _)) = there {
            return Some(*index);
        }
        if let Some(index) = self.known.ros_namespace() {
            return Some(index);
        }
        let used: BTreeSet<u16> = all.map(|(index, _)| *index).collect();
        let above = used.last().map_or(Some(2), |last| last.checked_add(1));
        let free = || (2..=u16::MAX).find(|index| !used.contains(index));
        let index = above.map(|index| index.max(2)).or_else(free)?;
        self.plan.namespaces.insert(index, uri.to_owned());
        Some(index)
    }

    /// Adds the nodes to which no topic is bound; the OPC UA side writes them.
    fn rest(&mut self) {
        for one in std::mem::take(&mut self.ua).into_iter().flatten() {
            let mut notes = Vec::new();
            if one.value.is_none() {
                notes.push(
                    "its data type and rank are not those of one value or of an array of one dimension"
                        .to_owned(),
                );
            }
            let entry = ProposedVariable {
                group: one.within.clone(),
                name: one.name,
                node: one.node,
                alias: None,
                value: one.value,
                origin: SpaceId::UA,
                bindings: Vec::new(),
                source: one.source,
                notes,
                guessed: false,
                faulty: None,
                is_set_aside: false,
            };
            self.push(entry);
        }
    }

    fn push(&mut self, mut entry: ProposedVariable) {
        let namespace = match entry.node.namespace {
            0 => u16::MAX,
            index => index,
        };
        if entry.node.writer_id().is_none() {
            entry.alias = self.known.next_number(namespace);
        }
        let taken = self.known.free_name(entry.node.namespace, &entry.name);
        entry.name = if taken == entry.name || entry.group.is_empty() {
            taken
        } else {
            let longer = format!("{}.{}", entry.group, entry.name);
            self.known.free_name(entry.node.namespace, &longer)
        };
        self.plan.entries.push(entry);
    }

    fn calls(
        &mut self,
        models: &[NodeModel],
        graphs: &[SurveyedGraph],
        nodes: (&[SurveyedNodes], &[Option<String>]),
        uri: &str,
    ) {
        let mut found = calls::modelled(models, self.known);
        let (others, untyped) = calls::candidates(graphs, nodes, self.known);
        for other in others {
            if !found.iter().any(|one| one.is_same(&other)) {
                found.push(other);
            }
        }
        if !models.is_empty() {
            // The calls of a space share a heading.
            found.sort_by_key(|one| (one.origin == SpaceId::UA, one.origin));
        }
        self.plan.untyped = untyped;
        for one in found {
            let Some(namespace) = self.namespace(uri) else {
                return;
            };
            let Some(number) = self.known.next_numbers(namespace, one.numbers()) else {
                return;
            };
            let node = NodeIdText {
                namespace,
                identifier: mappings::Identifier::Numeric(number.into()),
            };
            let is_set_aside = match &one.what {
                CallExecutor::Ros(_, name, _) => self.known.is_set_aside(name),
                CallExecutor::Method { .. } => false,
            };
            self.plan.calls.push(CallEntry {
                is_set_aside,
                node,
                name: self.known.free_name(namespace, &one.name),
                origin: one.origin,
                what: one.what,
                faulty: None,
            });
        }
    }
}

/// The default port of the server of the cell.
const OWN_PORT: u16 = 4840;

/// A topic that becomes a variable.
struct Candidate {
    group: String,
    topic: String,
    origin: SpaceId,
    bindings: Vec<BoundTopic>,
}

/// Returns the variables of a topic: one variable for all spaces if at most one space publishes the
/// topic, otherwise one variable for each publishing space. Topics of another type become separate
/// variables.
fn candidates(name: &str, bound: Vec<(BoundTopic, bool)>) -> Vec<Candidate> {
    let group = name.trim_start_matches('/').split_once('/');
    let group = group.map_or("", |(first, _)| first);
    let candidate = |origin: SpaceId, bindings: Vec<BoundTopic>| Candidate {
        group: group.to_owned(),
        topic: name.to_owned(),
        origin,
        bindings,
    };
    let published = bound.iter().filter(|(_, published)| *published);
    let producers: Vec<SpaceId> = published.map(|(one, _)| one.space).collect();
    let bindings = bound.into_iter().map(|(one, _)| one);
    if producers.len() > 1 {
        let own = bindings.filter(|one| producers.contains(&one.space));
        return own.map(|one| candidate(one.space, vec![one])).collect();
    }
    let bindings: Vec<BoundTopic> = bindings.collect();
    let origin = producers.first().copied().unwrap_or(SpaceId::UA);
    let first = bindings
        .iter()
        .find(|one| one.space == origin)
        .or_else(|| bindings.first());
    let Some(kind) = first.map(|one| one.kind.clone()) else {
        return Vec::new();
    };
    let (tied, alone): (Vec<BoundTopic>, Vec<BoundTopic>) =
        bindings.into_iter().partition(|one| one.kind == kind);
    let alone = alone
        .into_iter()
        .map(|one| candidate(SpaceId::UA, vec![one]));
    std::iter::once(candidate(origin, tied))
        .chain(alone)
        .collect()
}
