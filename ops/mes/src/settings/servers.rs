//! The running servers whose nodes are in the graph.

use std::time::Duration;

use knowledge::{NodeName, is_iri};
use plant_opcua::client::ClientUser;
use skills::yaml::{DocumentKind, DocumentNode, YamlFindingCode, whole};
use skills::{checked_endpoint, read_user};

use super::{Reading, shortened};
use crate::search_limits::SearchLimits;

/// Servers that the YAML names.
#[derive(Debug, Clone)]
pub(crate) struct ServerEntry {
    pub(crate) which: NamedServers,
    /// The user: its own, or that of the MES; `None` for anonymous.
    pub(crate) user: Option<ClientUser>,
    /// The nodes at which the search begins; the Objects folder if there are none.
    pub(crate) start: Vec<NodeName>,
    pub(crate) limits: SearchLimits,
    /// Time between two searches.
    pub(crate) every: Duration,
}

/// The way in which servers are named.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum NamedServers {
    /// The server at an endpoint.
    Endpoint(String),
    /// The server that discovery finds with an ApplicationUri.
    Application(String),
    /// All servers that discovery finds.
    Discovered,
}

/// Gives servers without a user that of the MES.
pub(super) fn give_user(servers: &mut [ServerEntry], user: Option<&ClientUser>) {
    for server in servers {
        server.user = server.user.take().or_else(|| user.cloned());
    }
}

impl ServerEntry {
    /// Returns whether both entries lead to the same search.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        let user = |entry: &Self| {
            let user = entry.user.as_ref();
            user.map(|user| (user.name.clone(), user.password.clone()))
        };
        user(self) == user(other)
            && (&self.which, &self.start, &self.limits, self.every)
                == (&other.which, &other.start, &other.limits, other.every)
    }
}

impl NamedServers {
    /// Returns the text of the YAML.
    pub(crate) fn text(&self) -> &str {
        match self {
            Self::Endpoint(text) | Self::Application(text) => text,
            Self::Discovered => DISCOVERED,
        }
    }
}

impl Reading<'_, '_> {
    /// Reads a server: its endpoint or ApplicationUri, `discovered`, or a map.
    pub(super) fn server(&mut self, node: &DocumentNode) -> Option<ServerEntry> {
        let keys = ["server", "user", "start", "nodes", "depth", "every"];
        let [server, user, start, nodes, depth, every] =
            if matches!(node.kind, DocumentKind::Map(_)) {
                self.reader.map(node, keys)?
            } else {
                [Some(node), None, None, None, None, None]
            };
        let which = self
            .reader
            .needed(server, "server", node.place)
            .and_then(|node| self.named_servers(node));
        let user = user.map(|node| read_user(node, self.folder, self.reader));
        let start = start.map_or_else(Vec::new, |node| self.each(node, Self::start_node));
        let usual = SearchLimits::default();
        let nodes = nodes.map_or(Some(usual.nodes), |node| self.number(node, MOST_NODES));
        let depth = depth.map_or(Some(usual.depth), |node| self.number(node, MOST_DEPTH));
        let every = every.map_or(Some(USUALLY_EVERY), |node| self.interval(node));
        Some(ServerEntry {
            which: which?,
            user: whole(user)?,
            start,
            limits: SearchLimits {
                nodes: nodes?,
                depth: depth?,
                ..usual
            },
            every: every?,
        })
    }

    fn named_servers(&mut self, node: &DocumentNode) -> Option<NamedServers> {
        let text = self
            .reader
            .text(node, "an endpoint, an ApplicationUri or `discovered`")?;
        if text == DISCOVERED {
            return Some(NamedServers::Discovered);
        }
        if text.starts_with("opc.tcp:") {
            return checked_endpoint(text, node, self.reader).map(NamedServers::Endpoint);
        }
        if is_iri(text) && text.len() <= 256 {
            return Some(NamedServers::Application(text.to_owned()));
        }
        let why = format!(
            "expected an endpoint as opc.tcp://HOST:4840, an ApplicationUri or `{DISCOVERED}`, found `{}`",
            shortened(text)
        );
        self.reader.refuse(node, YamlFindingCode::Endpoint, why)
    }

    fn start_node(&mut self, node: &DocumentNode) -> Option<NodeName> {
        let text = self.reader.text(node, "a node")?;
        // The index of a namespace may be another one after a restart of the server.
        NodeName::parse(text).or_else(|| {
            let why = format!(
                "expected a node with the URI of its namespace, as nsu=urn:example:press;i=5001, \
                 or a node of OPC UA as i=85, found `{}`",
                shortened(text)
            );
            self.reader.refuse(node, YamlFindingCode::WrongValue, why)
        })
    }

    fn number(&mut self, node: &DocumentNode, most: usize) -> Option<usize> {
        let text = self.reader.text(node, "a number")?;
        let number = text.parse().ok();
        number
            .filter(|number| (1..=most).contains(number))
            .or_else(|| {
                let why = format!(
                    "expected a number from 1 to {most}, found `{}`",
                    shortened(text)
                );
                self.reader.refuse(node, YamlFindingCode::WrongValue, why)
            })
    }

    fn interval(&mut self, node: &DocumentNode) -> Option<Duration> {
        let every = self.reader.duration(node)?;
        if every >= SHORTEST_EVERY {
            return Some(every);
        }
        let why = "a server is searched every second at most".to_owned();
        self.reader.refuse(node, YamlFindingCode::Duration, why)
    }
}

const DISCOVERED: &str = "discovered";
const USUALLY_EVERY: Duration = Duration::from_secs(600);
const SHORTEST_EVERY: Duration = Duration::from_secs(1);
/// The limit of nodes keeps the statements of a server within the limit of a graph.
const MOST_NODES: usize = 100_000;
const MOST_DEPTH: usize = 100;
