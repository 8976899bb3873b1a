//! Nodes of servers and NodeSet files, in the notation of a mapping.

use std::collections::{BTreeMap, HashMap, HashSet};

use mappings::NodeIdText;

use crate::survey::{SurveyedNodes, UaSource};

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
    pub(super) fn give(&mut self, source: &SurveyedNodes) -> HashMap<u16, u16> {
        let variables = source.variables.iter();
        let used: HashSet<u16> = variables.map(|one| one.node.namespace).collect();
        let mut indexes = HashMap::new();
        let mut free = FreeIndexes::default();
        for (index, uri) in (0..=u16::MAX).zip(&source.namespaces).skip(1) {
            if !used.contains(&index) {
                continue;
            }
            let wanted = match &source.server {
                None => index.saturating_add(1),
                Some(server) if server.is_cell => index,
                Some(_) => index.max(2),
            };
            if let Some(given) = self.index_of(uri, wanted, &mut free) {
                indexes.insert(index, given);
            }
        }
        indexes
    }

    /// Returns the index of the namespace: its index in the mapping, or a free index, preferably
    /// `wanted`. `None` if no index is free.
    pub(super) fn index_of(
        &mut self,
        uri: &str,
        wanted: u16,
        free: &mut FreeIndexes,
    ) -> Option<u16> {
        if let Some(known) = self.by_uri.get(uri) {
            return Some(*known);
        }
        let found = free.next(wanted, &self.all)?;
        self.all.insert(found, uri.to_owned());
        self.by_uri.insert(uri.to_owned(), found);
        self.given.insert(found, uri.to_owned());
        Some(found)
    }
}

/// A search for free indexes. It continues from the wanted index upwards, then from 2. Indexes are
/// never released, so earlier positions are not free.
pub(super) struct FreeIndexes {
    above: u16,
    below: u16,
}

impl Default for FreeIndexes {
    fn default() -> Self {
        Self { above: 0, below: 2 }
    }
}

impl FreeIndexes {
    fn next(&mut self, wanted: u16, all: &BTreeMap<u16, String>) -> Option<u16> {
        let free = |at: &u16| !all.contains_key(at);
        self.above = wanted.max(self.above);
        match (self.above..=u16::MAX).find(free) {
            Some(found) => {
                self.above = found;
                Some(found)
            }
            None => {
                self.above = u16::MAX;
                self.below = (self.below..=u16::MAX).find(free)?;
                Some(self.below)
            }
        }
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
