//! Nodes of servers and files, as a mapping names them.

use std::collections::{BTreeMap, HashMap, HashSet};

use mappings::NodeIdText;

use crate::survey::{Nodes, UaSource};

/// What the indexes in node ids mean.
pub(super) struct Indexes {
    all: BTreeMap<u16, String>,
    by_uri: HashMap<String, u16>,
    /// Those that are new.
    pub(super) given: BTreeMap<u16, String>,
}

impl Indexes {
    pub(super) fn of(known: &BTreeMap<u16, String>) -> Self {
        let mut by_uri = HashMap::new();
        for (index, uri) in known {
            by_uri.entry(uri.clone()).or_insert(*index);
        }
        Self {
            all: known.clone(),
            by_uri,
            given: BTreeMap::new(),
        }
    }

    /// Gives every namespace of variables its index in the mapping, by that in the source: the same for the cell's server, from
    /// 2 on for those of files and other servers, since 1 is each server's own.
    pub(super) fn give(&mut self, source: &Nodes) -> HashMap<u16, u16> {
        let is_cell = source.server.as_ref().is_some_and(|server| server.is_cell);
        let variables = source.variables.iter();
        let used: HashSet<u16> = variables.map(|one| one.node.namespace).collect();
        let mut indexes = HashMap::new();
        // From the index that is wanted on, then below it; none is given back, so nothing is free before them.
        let (mut above, mut below) = (0, 2);
        for (index, uri) in (0..=u16::MAX).zip(&source.namespaces).skip(1) {
            if !used.contains(&index) {
                continue;
            }
            let given = self.by_uri.get(uri).copied().or_else(|| {
                let wanted = index.saturating_add(u16::from(!is_cell));
                let free = |at: &u16| !self.all.contains_key(at);
                above = wanted.max(above);
                let found = match (above..=u16::MAX).find(free) {
                    Some(found) => {
                        above = found;
                        found
                    }
                    None => {
                        above = u16::MAX;
                        below = (below..=u16::MAX).find(free)?;
                        below
                    }
                };
                self.all.insert(found, uri.clone());
                self.by_uri.insert(uri.clone(), found);
                self.given.insert(found, uri.clone());
                Some(found)
            });
            if let Some(given) = given {
                indexes.insert(index, given);
            }
        }
        indexes
    }
}

/// A node as a server of another namespace table knows it.
pub(super) fn source_of(server: &str, node: &NodeIdText, namespaces: &[String]) -> UaSource {
    let uri = namespaces.get(usize::from(node.namespace));
    let namespace = match uri {
        Some(uri) => mappings::NamespaceText::Uri(uri.clone()),
        None => mappings::NamespaceText::Index(node.namespace),
    };
    let identifier = node.identifier.clone();
    let node = mappings::ExpandedNodeIdText {
        namespace,
        identifier,
    };
    UaSource {
        server: server.to_owned(),
        node: node.to_string(),
    }
}

/// Whether an endpoint is at that port of this host.
pub(super) fn is_at(endpoint: &str, port: u16) -> bool {
    let place = endpoint.trim_start_matches("opc.tcp://");
    let place = place.split('/').next().unwrap_or_default();
    let hosts = ["127.0.0.1", "localhost", "[::1]"];
    hosts.iter().any(|host| {
        let rest = place.strip_prefix(host);
        rest.and_then(|rest| rest.strip_prefix(':')) == Some(&port.to_string())
    })
}
