//! The contents of the existing file.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use mappings::{Mapping, NodeIdText, SpaceId, TopicId};
use messages::TypeName;

use super::nodes::is_same;
use super::topics::OmittedTopic;
use super::yaml;
use crate::survey::UaSource;

/// A mapping with the names in its comments. Topics and nodes that a user left out on purpose are
/// not proposed again.
#[derive(Default)]
pub(super) struct OldMapping {
    pub(super) mapping: Mapping,
    nodes: HashSet<NodeIdText>,
    names: HashSet<(u16, String)>,
    /// The last number tried as the suffix of a name.
    numbered: HashMap<(u16, String), u32>,
    /// Identifiers in topic names, by namespace.
    numbers: HashMap<u16, BTreeSet<u16>>,
    /// Words of comments that begin with a slash.
    mentioned: HashSet<String>,
    /// Words that begin with a slash, in comments that `init` wrote because something was missing,
    /// such as the definition of a type.
    set_aside: HashSet<String>,
    /// Nodes of other servers that are sources or targets of variables: the name of the server, and
    /// the node.
    sources: HashSet<(String, String)>,
    /// Names assigned to new servers.
    servers: HashSet<String>,
    /// Methods in comments, as written: `object: .., method: ..`.
    methods: HashSet<String>,
    /// Node ids in comments, as written.
    written: HashSet<String>,
    /// The namespace of the last node id read, as in topic names: `u16::MAX` stands for namespace
    /// 0.
    hearing: u16,
}

/// The server of a node that is already in use by a variable.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum NodeServer {
    Same,
    Other,
}

/// The name of a server.
pub(super) enum ServerName {
    /// A name in the mapping.
    Known(String),
    New(String),
}

impl OldMapping {
    /// Collects the names of `mapping`, which was read from `text`.
    pub(super) fn of(mapping: Mapping, text: &str) -> Self {
        let mut known = Self::default();
        for variable in mapping.variables() {
            known.nodes.insert(variable.node.clone());
            let namespace = variable.node.namespace;
            known.names.insert((namespace, variable.name.clone()));
            if let Some(from) = &variable.from {
                let source = (from.server.clone(), from.node.to_string());
                known.sources.insert(source);
            }
            if let Some(to) = &variable.to {
                let source = (to.server.clone(), to.node.to_string());
                known.sources.insert(source);
            }
            let TopicId {
                namespace,
                identifier,
                ..
            } = variable.topic;
            known.use_number(namespace.get(), identifier.get());
        }
        for call in mapping.calls() {
            known.nodes.insert(call.node.clone());
            known.names.insert((call.node.namespace, call.name.clone()));
            for topic in call.topics() {
                known.use_number(topic.namespace.get(), topic.identifier.get());
            }
        }
        let mut is_set_aside = false;
        for line in text.lines() {
            let Some((before, comment)) = line.split_once('#') else {
                is_set_aside = false;
                continue;
            };
            is_set_aside &= before.trim().is_empty();
            is_set_aside |= begins_set_aside(comment);
            known.hear(comment, is_set_aside);
        }
        known.mapping = mapping;
        known
    }

    fn hear(&mut self, comment: &str, is_set_aside: bool) {
        let is_name = |c: char| c.is_ascii_alphanumeric() || c == '/' || c == '_';
        let words = comment.split(|c: char| !is_name(c));
        let topics = words.filter(|word| word.starts_with('/') && word.len() > 1);
        let known = if is_set_aside {
            &mut self.set_aside
        } else {
            &mut self.mentioned
        };
        known.extend(topics.map(str::to_owned));
        if let Some(source) = source_in(comment) {
            self.sources.insert(source);
        } else if let Some((_, written)) = comment.split_once("node: ") {
            let written = written.trim();
            let index = written.trim_start_matches('"').strip_prefix("ns=");
            let index = index.and_then(|rest| rest.split(';').next());
            self.hearing = index
                .and_then(|index| index.parse().ok())
                .unwrap_or(u16::MAX);
            let node = written.parse::<NodeIdText>().ok();
            if let Some(number) = node.and_then(|node| node.writer_id()) {
                self.use_number(self.hearing, number.get());
            }
            self.written.insert(written.to_owned());
        } else if let Some((_, target)) = comment.split_once("object: ") {
            let target = target.trim().trim_end_matches('}');
            self.methods.insert(format!("object: {target}"));
        } else if let Some((_, alias)) = comment.split_once("alias: ")
            && let Ok(alias) = alias.trim().parse()
        {
            self.use_number(self.hearing, alias);
        }
    }

    pub(super) fn use_number(&mut self, namespace: u16, number: u16) {
        self.numbers.entry(namespace).or_default().insert(number);
    }

    /// Returns the next free number, above all used numbers, so a number that was removed from the
    /// file is not used again.
    pub(super) fn next_number(&mut self, namespace: u16) -> Option<u16> {
        self.next_numbers(namespace, 1)
    }

    /// Returns the first of `count` consecutive free numbers.
    pub(super) fn next_numbers(&mut self, namespace: u16, count: u16) -> Option<u16> {
        let used = self.numbers.entry(namespace).or_default();
        let last_of = |first: u16| first.checked_add(count.saturating_sub(1));
        let above = used.last().map_or(Some(1), |last| last.checked_add(1));
        let above = above.filter(|first| last_of(*first).is_some());
        let free = |first: &u16| {
            last_of(*first).is_some_and(|last| used.range(*first..=last).next().is_none())
        };
        let first = above.or_else(|| (1..=u16::MAX).find(free))?;
        used.extend(first..=last_of(first)?);
        Some(first)
    }

    pub(super) fn has_node(&self, node: &NodeIdText) -> bool {
        self.nodes.contains(node) || self.written.contains(&yaml::scalar(&node.to_string()))
    }

    /// Returns true if a variable or a comment has this node of another server as its source or
    /// target.
    pub(super) fn has_source(&self, source: &UaSource) -> bool {
        let UaSource { server, node } = source;
        let written = yaml::scalar(node);
        [node, &written]
            .into_iter()
            .any(|node| self.sources.contains(&(server.clone(), node.clone())))
    }

    /// Returns the server of the variable with the node, compared with `server`; `None` if the node
    /// is not in use.
    pub(super) fn has_node_of(&self, node: &NodeIdText, server: &str) -> Option<NodeServer> {
        if !self.has_node(node) {
            return None;
        }
        let mut variables = self.mapping.variables().iter();
        let same = variables.find(|variable| variable.node == *node);
        let from = same.and_then(|same| same.from.as_ref().map(|from| &from.server));
        let to = same.and_then(|same| same.to.as_ref().map(|to| &to.server));
        Some(match from.or(to) {
            Some(other) if other != server => NodeServer::Other,
            Some(_) | None => NodeServer::Same,
        })
    }

    /// Returns the name of the server at an endpoint, from the mapping or new.
    pub(super) fn server(&mut self, endpoint: &str, wanted: &str) -> ServerName {
        let servers = self.mapping.servers().iter();
        let mut there =
            servers.filter(|server| is_same(&server.access.endpoint.to_string(), endpoint));
        if let Some(there) = there.next() {
            return ServerName::Known(there.name.clone());
        }
        let mut plain: String = wanted
            .chars()
            .map(|c| {
                if c.is_ascii_alphanumeric() {
                    c.to_ascii_lowercase()
                } else {
                    '-'
                }
            })
            .take(40)
            .collect();
        while plain.contains("--") {
            plain = plain.replace("--", "-");
        }
        let plain = match plain.trim_matches('-') {
            "" => "server",
            plain => plain,
        };
        let taken = |name: &String| {
            let mut all = self.mapping.servers().iter().map(|server| &server.name);
            self.servers.contains(name) || all.any(|other| other == name)
        };
        let numbered = (2..u32::MAX).map(|number| format!("{plain}-{number}"));
        let mut names = std::iter::once(plain.to_owned()).chain(numbered);
        let name = names.find(|name| !taken(name)).unwrap_or_default();
        self.servers.insert(name.clone());
        ServerName::New(name)
    }

    /// Returns `wanted`, with a number appended if the name is in use.
    pub(super) fn free_name(&mut self, namespace: u16, wanted: &str) -> String {
        let wanted = if wanted.trim().is_empty() {
            "Value"
        } else {
            wanted
        };
        let wanted: String = wanted
            .chars()
            .filter(|c| !c.is_control())
            .take(500)
            .collect();
        if self.names.insert((namespace, wanted.clone())) {
            return wanted;
        }
        let last = self
            .numbered
            .entry((namespace, wanted.clone()))
            .or_insert(1);
        loop {
            *last = last.saturating_add(1);
            let name = format!("{wanted}{last}");
            if self.names.insert((namespace, name.clone())) || *last == u32::MAX {
                return name;
            }
        }
    }

    /// Returns true if a variable has the name.
    pub(super) fn has_name(&self, name: &str) -> bool {
        let mut variables = self.mapping.variables().iter();
        variables.any(|variable| variable.name == name)
    }

    /// Returns true if a comment names the topic.
    pub(super) fn mentions(&self, topic: &str) -> bool {
        self.mentioned.contains(topic)
    }

    /// Returns true if `init` wrote the topic or service as a comment because something was
    /// missing.
    pub(super) fn is_set_aside(&self, name: &str) -> bool {
        self.set_aside.contains(name)
    }

    /// Returns true if a comment contains the Method, as `object: .., method: ..`.
    pub(super) fn mentions_method(&self, target: &str) -> bool {
        self.methods.contains(target)
    }

    /// Returns true if a variable is bound to the topic, or a pattern matches it.
    pub(super) fn bound(&self, space: SpaceId, topic: &str, kind: Option<&TypeName>) -> bool {
        self.mapping
            .bindings(space)
            .any(|(_, binding)| binding.ros_topic == topic)
            || self.mapping.matching(space, topic, kind).is_some()
    }

    /// Returns the name of the variable that is bound to the topic in any space.
    pub(super) fn variable_of(&self, topic: &str) -> Option<&str> {
        let variables = self.mapping.variables().iter();
        let mut bound = variables.filter(|variable| {
            let bindings = &variable.bindings;
            bindings.iter().any(|binding| binding.ros_topic == topic)
        });
        bound.next().map(|variable| variable.name.as_str())
    }

    /// Returns the namespace that most variables with a ROS topic use.
    pub(super) fn ros_namespace(&self) -> Option<u16> {
        let mut counts: BTreeMap<u16, usize> = BTreeMap::new();
        for variable in self.mapping.variables() {
            if !variable.bindings.is_empty() && variable.node.namespace != 0 {
                *counts.entry(variable.node.namespace).or_default() += 1;
            }
        }
        let most = counts.values().max()?;
        counts
            .iter()
            .find(|(_, count)| *count == most)
            .map(|(namespace, _)| *namespace)
    }
}

/// Returns true if the comment starts a block that `init` left out because something was missing:
/// it begins with the code of a finding, or is the heading of names without a type.
fn begins_set_aside(comment: &str) -> bool {
    let comment = comment.trim();
    let has_code = comment.split_once(": ").is_some_and(|(code, _)| {
        let number = code.strip_prefix('M');
        number.is_some_and(|number| number.len() == 3 && number.bytes().all(|b| b.is_ascii_digit()))
    });
    has_code || comment.ends_with(OmittedTopic::Untyped.heading()) || comment.ends_with(UNTYPED)
}

/// Returns the node of another server named in a comment, in the notation of `render`.
fn source_in(comment: &str) -> Option<(String, String)> {
    let (_, source) = comment.split_once(": {server: ")?;
    let (server, node) = source.split_once(", node: ")?;
    let node = node.trim_end().strip_suffix('}')?;
    Some((server.to_owned(), node.to_owned()))
}

/// The end of the heading of services without a type.
pub(super) const UNTYPED: &str = "whose type is not known, or differs";
