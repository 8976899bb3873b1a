//! Nodes of servers and NodeSet files, in the notation of a mapping.

use std::collections::{BTreeMap, HashMap, HashSet};

use mappings::NodeIdText;

use crate::survey::{Nodes, UaSource};

/// The namespace indexes of node ids.
pub(super) struct Indexes {
    all: BTreeMap<u16, String>,
    by_uri: HashMap<String, u16>,
    /// The new indexes.
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

    /// Assigns an index in the mapping to each namespace that has variables, preferably its index
    /// at the server. For NodeSet files and for servers other than the server of the cell the index
    /// is at least 2, because index 1 is the own namespace of each server.
    pub(super) fn give(&mut self, source: &Nodes) -> HashMap<u16, u16> {
        let variables = source.variables.iter();
        let used: HashSet<u16> = variables.map(|one| one.node.namespace).collect();
        let mut indexes = HashMap::new();
        // The search continues from the wanted index upwards, then from 2. Indexes are never
        // released, so earlier positions are not free.
        let (mut above, mut below) = (0, 2);
        for (index, uri) in (0..=u16::MAX).zip(&source.namespaces).skip(1) {
            if !used.contains(&index) {
                continue;
            }
            let given = self.by_uri.get(uri).copied().or_else(|| {
                let wanted = match &source.server {
                    None => index.saturating_add(1),
                    Some(server) if server.is_cell => index,
                    Some(_) => index.max(2),
                };
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

/// Returns the node with its namespace URI, for a server with another namespace table.
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

/// Returns true if the endpoint is at this port of this host.
pub(super) fn is_at(endpoint: &str, port: u16) -> bool {
    let (host, at, _) = place(endpoint);
    at == port.to_string() && ["127.0.0.1", "localhost", "[::1]"].contains(&host.as_str())
}

/// Returns true if both endpoints are equal after normalization.
pub(super) fn is_same(one: &str, other: &str) -> bool {
    place(one) == place(other)
}

/// Returns host, port and path; the default port is 4840 (OPC 10000-6, 7.2).
fn place(endpoint: &str) -> (String, String, &str) {
    let rest = endpoint.trim_start_matches("opc.tcp://");
    let (place, path) = rest.split_once('/').unwrap_or((rest, ""));
    let (host, port) = match place.rsplit_once(':') {
        Some((host, port)) if !port.contains(']') => (host, port),
        Some(_) | None => (place, "4840"),
    };
    (host.to_ascii_lowercase(), port.to_owned(), path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_is_the_same_however_it_is_written() {
        assert!(is_same("opc.tcp://PLC", "opc.tcp://plc:4840"));
        assert!(is_same("opc.tcp://[::1]/a", "opc.tcp://[::1]:4840/a"));
        assert!(!is_same("opc.tcp://plc:4841", "opc.tcp://plc"));
        assert!(!is_same("opc.tcp://plc/a", "opc.tcp://plc/b"));
        assert!(is_at("opc.tcp://localhost/a", 4840) && !is_at("opc.tcp://plc", 4840));
    }
}
