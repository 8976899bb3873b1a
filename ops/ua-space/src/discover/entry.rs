//! A discovered program or server; findings of the same program are merged.

use std::collections::BTreeSet;

use serde::Serialize;

/// The kind of a discovered program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum DiscoveredKind {
    /// A discovery server.
    Lds,
    /// The server of a cell, `ua-server`.
    Cell,
    /// A server of this project with skills, or a server that coordinates such servers.
    Component,
    /// Any other OPC UA server.
    Server,
    /// The publisher of the values of a ROS space.
    Bridge,
    /// A listener that is not an OPC UA server.
    Other,
}

impl DiscoveredKind {
    pub(crate) const fn word(self) -> &'static str {
        match self {
            Self::Lds => "discovery server",
            Self::Cell => "cell server",
            Self::Component => "component",
            Self::Server => "server",
            Self::Bridge => "bridge",
            Self::Other => "other",
        }
    }

    /// Returns the kind from the ProductUri of a server.
    pub(super) fn of_product(uri: &str) -> Self {
        match uri {
            "urn:ua-bridge:server" => Self::Cell,
            "urn:ua-bridge:plant" => Self::Component,
            _ => Self::Server,
        }
    }
}

/// The way in which an entry was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum DiscoveryMethod {
    Mdns,
    Lds,
    Scan,
    Group,
}

impl DiscoveryMethod {
    const fn word(self) -> &'static str {
        match self {
            Self::Mdns => "mdns",
            Self::Lds => "lds",
            Self::Scan => "scan",
            Self::Group => "group",
        }
    }
}

/// A discovered program or server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct DiscoveredEntry {
    pub(crate) kind: DiscoveredKind,
    pub(crate) name: String,
    /// The ApplicationUri; empty if it is unknown.
    pub(crate) uri: String,
    /// The URLs of the server, starting with the URL at which it was first reached.
    pub(crate) urls: Vec<String>,
    pub(crate) capabilities: BTreeSet<String>,
    /// The SecurityModes and SecurityPolicies of its endpoints.
    pub(crate) security: Vec<String>,
    pub(crate) found_by: BTreeSet<DiscoveryMethod>,
    /// The reason why the server was not reached or its response was not understood.
    pub(crate) fault: Option<String>,
    /// The space of the values that the program carries or publishes, if known.
    pub(crate) space: Option<u16>,
    /// The number of topics received from a bridge.
    pub(crate) topics: Option<usize>,
    /// The PubSub group that a bridge announces as its own.
    pub(crate) group: Option<String>,
}

/// An entry as JSON.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
pub(crate) struct EntryJson<'e> {
    pub(crate) kind: &'static str,
    name: &'e str,
    uri: &'e str,
    urls: &'e [String],
    pub(crate) capabilities: Vec<&'e str>,
    security: &'e [String],
    pub(crate) found_by: Vec<&'static str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    fault: Option<&'e str>,
    #[serde(skip_serializing_if = "Option::is_none")]
    space: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    topics: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    group: Option<&'e str>,
}

impl DiscoveredEntry {
    pub(super) fn new(kind: DiscoveredKind, by: DiscoveryMethod, url: String) -> Self {
        Self {
            kind,
            name: String::new(),
            uri: String::new(),
            urls: vec![url],
            capabilities: BTreeSet::new(),
            security: Vec::new(),
            found_by: BTreeSet::from([by]),
            fault: None,
            space: None,
            topics: None,
            group: None,
        }
    }

    pub(crate) fn shown(&self) -> EntryJson<'_> {
        EntryJson {
            kind: self.kind.word(),
            name: &self.name,
            uri: &self.uri,
            urls: &self.urls,
            capabilities: self.capabilities.iter().map(String::as_str).collect(),
            security: &self.security,
            found_by: self.found_by.iter().map(|by| by.word()).collect(),
            fault: self.fault.as_deref(),
            space: self.space,
            topics: self.topics,
            group: self.group.as_deref(),
        }
    }

    /// Returns true if both entries are the same program: if their ApplicationUris are equal, or a
    /// URL is equal where an ApplicationUri is unknown. Bridges of different spaces are different
    /// programs.
    fn is(&self, other: &Self) -> bool {
        if (self.kind, other.kind) == (DiscoveredKind::Bridge, DiscoveredKind::Bridge)
            && self.space != other.space
        {
            return false;
        }
        if self.uri.is_empty() || other.uri.is_empty() {
            self.urls.iter().any(|url| other.urls.contains(url))
        } else {
            self.uri == other.uri
        }
    }

    /// Merges another finding of the same program.
    fn join(&mut self, other: Self) {
        // The finding that reached the program precedes a finding that did not.
        let better = self.fault.is_some() && other.fault.is_none();
        let (mut first, second) = if better {
            (other, self.clone())
        } else {
            (self.clone(), other)
        };
        for url in second.urls {
            if !first.urls.contains(&url) {
                first.urls.push(url);
            }
        }
        first.kind = match (first.kind, second.kind) {
            (DiscoveredKind::Server, kind) | (kind, DiscoveredKind::Server) => kind,
            (kind, _) => kind,
        };
        if first.name.is_empty() {
            first.name = second.name;
        }
        if first.uri.is_empty() {
            first.uri = second.uri;
        }
        if first.security.is_empty() {
            first.security = second.security;
        }
        first.space = first.space.or(second.space);
        first.topics = first.topics.or(second.topics);
        first.group = first.group.or(second.group);
        first.capabilities.extend(second.capabilities);
        first.found_by.extend(second.found_by);
        *self = first;
    }
}

/// Merges entries of the same program and sorts them by kind and name.
pub(super) fn merged(found: impl IntoIterator<Item = DiscoveredEntry>) -> Vec<DiscoveredEntry> {
    let mut entries: Vec<DiscoveredEntry> = Vec::new();
    for one in found {
        match entries.iter_mut().find(|entry| entry.is(&one)) {
            Some(entry) => entry.join(one),
            None => entries.push(one),
        }
    }
    let order = |entry: &DiscoveredEntry| (entry.kind, entry.name.clone(), entry.urls.clone());
    entries.sort_by_cached_key(order);
    entries
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(by: DiscoveryMethod, uri: &str, url: &str) -> DiscoveredEntry {
        DiscoveredEntry {
            uri: uri.to_owned(),
            ..DiscoveredEntry::new(DiscoveredKind::Server, by, url.to_owned())
        }
    }

    #[test]
    fn a_server_that_is_found_three_ways_is_one() {
        let mut away = entry(DiscoveryMethod::Lds, "", "opc.tcp://plc:4840");
        away.fault = Some("no answer".to_owned());
        let mut told = entry(DiscoveryMethod::Mdns, "urn:plc", "opc.tcp://plc:4840");
        told.kind = DiscoveredKind::Component;
        told.capabilities.insert("DA".to_owned());
        let all = merged([
            away,
            told,
            entry(DiscoveryMethod::Scan, "urn:plc", "opc.tcp://10.0.0.7:4840"),
            entry(
                DiscoveryMethod::Scan,
                "urn:other",
                "opc.tcp://10.0.0.8:4840",
            ),
        ]);
        let [plc, other] = all.as_slice() else {
            panic!("{all:?}")
        };
        assert_eq!(
            (plc.kind, plc.fault.as_deref()),
            (DiscoveredKind::Component, None)
        );
        assert_eq!(plc.urls, ["opc.tcp://plc:4840", "opc.tcp://10.0.0.7:4840"]);
        assert_eq!(plc.found_by.len(), 3);
        assert_eq!(other.uri, "urn:other");
    }
}
