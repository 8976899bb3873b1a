//! Offers calls of other spaces as services of the graph, and executes services of the graph for
//! other spaces.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use bridge_node::{Executing, Present};
use mappings::TopicId;
use messages::TypeName;
use tcpros::{Node, ServiceClientOptions};
use tokio::task::JoinSet;

use super::Ros1Port;
use crate::services::{Executor, Ros1Graph};

impl Ros1Port {
    /// Offers the known calls as services. A call under a name from the mapping gives way to a
    /// service of another node, because the master keeps a single server per name, the last to
    /// register.
    pub(super) fn offer_calls(&mut self) {
        let (services, own) = (&self.graph.services, self.node.name());
        let is_redundant = self.is_redundant;
        let other = |service: &str| {
            let nodes = services.get(service)?;
            nodes
                .iter()
                .find(|node| *node != own && !(is_redundant && is_redundant_peer(own, node)))
        };
        let is_chosen = |topic: TopicId, service: &str| service != format!("/{topic}");
        for (topic, service) in self.calls.chosen(&self.policy) {
            if let Some(node) = other(&service) {
                self.policy.told.once(&service, "taken", || {
                    format!(
                        "{topic} is not offered as {service}: the node {node} already offers this service; \
                         use another name, or stop the node"
                    )
                });
            }
        }
        let left =
            |topic: TopicId, service: &str| is_chosen(topic, service) && other(service).is_some();
        self.calls.leave(left);
        if !self.calls.is_waiting() {
            return;
        }
        let mut graph = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        };
        // The owners of names are known once the master has responded.
        let has_master = self.has_master;
        let may = |topic: TopicId, service: &str| {
            !left(topic, service) && (has_master || !is_chosen(topic, service))
        };
        let calls = &mut self.calls;
        let events = calls.offer_waiting(&mut graph, &mut self.policy, may, usize::MAX);
        self.events.extend(events);
    }

    /// Offers the services of other nodes that are calls of this space, and withdraws calls of lost
    /// services.
    pub(super) fn find_services(&mut self) {
        let own = self.node.name();
        let services = self.graph.services.iter();
        let others = services.filter(|(_, nodes)| nodes.iter().any(|node| node != own));
        let policy = &self.policy;
        let mapping = Arc::clone(policy.mapping());
        let mapped = Executing::<Executor>::mapped(&mapping, policy);
        let wanted = others.filter(|(service, _)| {
            let named = || Executing::<Executor>::is_named(policy, service);
            service.len() <= MAX_NAME && (mapped.contains(service.as_str()) || named())
        });
        let others: BTreeMap<&str, &[String]> = wanted
            .map(|(service, nodes)| (service.as_str(), nodes.as_slice()))
            .collect();
        for (service, error) in self.kinds.look(&self.node, others.iter()) {
            self.policy.told.once(&service, "type of the service", || {
                format!("the type of the service {service} is unknown: {error}")
            });
        }
        let present: Present = others
            .keys()
            .map(|service| ((*service).to_owned(), self.kinds.of(service).cloned()))
            .collect();
        let mut graph = Ros1Graph {
            node: &self.node,
            definitions: &mut self.definitions,
            ends: &mut self.ends,
        };
        let executing = &mut self.executing;
        let events = executing.reconcile(&mut graph, &mut self.policy, (&present, usize::MAX));
        self.events.extend(events);
    }
}

/// Returns whether a node is a redundant bridge of the space, by its name: NAME, NAME_2 or NAME_3.
/// The master still lists the services of a bridge that was killed.
pub(super) fn is_redundant_peer(own: &str, node: &str) -> bool {
    fn base(name: &str) -> &str {
        let mut ranks = ["_2", "_3"].into_iter();
        let stripped = ranks.find_map(|rank| name.strip_suffix(rank));
        stripped.unwrap_or(name)
    }
    own != node && base(own) == base(node)
}

/// The types of services, which only their servers know.
#[derive(Debug, Default)]
pub(super) struct Kinds {
    known: BTreeMap<String, Kind>,
    asking: JoinSet<(String, Result<TypeName, String>)>,
    faults: Vec<(String, String)>,
}

#[derive(Debug)]
struct Kind {
    /// The nodes that offered the service at the last query.
    nodes: Vec<String>,
    type_name: Option<TypeName>,
    /// Number of comparisons with the graph until the next query.
    wait: u32,
    asked: bool,
}

impl Kinds {
    fn of(&self, service: &str) -> Option<&TypeName> {
        self.known.get(service)?.type_name.as_ref()
    }

    /// Queries the types of new services and of services with changed nodes, a few at a time.
    /// Returns the services of unknown type, with the reasons.
    fn look<'s>(
        &mut self,
        node: &Node,
        wanted: impl Iterator<Item = (&'s &'s str, &'s &'s [String])>,
    ) -> Vec<(String, String)> {
        let mut there = BTreeSet::new();
        for (service, nodes) in wanted.take(MOST_KINDS) {
            there.insert((*service).to_owned());
            let kind = self.known.entry((*service).to_owned()).or_insert(Kind {
                nodes: Vec::new(),
                type_name: None,
                wait: 0,
                asked: false,
            });
            if kind.nodes != *nodes {
                (kind.nodes, kind.type_name, kind.wait) = (nodes.to_vec(), None, 0);
            }
            kind.wait = kind.wait.saturating_sub(1);
            let is_due = kind.type_name.is_none() && kind.wait == 0 && !kind.asked;
            if !is_due || self.asking.len() >= MOST_ASKED {
                continue;
            }
            let options = ServiceClientOptions {
                timeout: ASKED_WITHIN,
                ..ServiceClientOptions::default()
            };
            let client = match node.service_client(service, options) {
                Ok(client) => client,
                Err(error) => {
                    self.faults.push(((*service).to_owned(), error.to_string()));
                    kind.wait = ASKED_AGAIN;
                    continue;
                }
            };
            kind.asked = true;
            let service = (*service).to_owned();
            self.asking.spawn(async move {
                let header = client.probe().await.map_err(|error| error.to_string());
                let named = header.and_then(|header| {
                    let named = header.get("type").unwrap_or_default();
                    let parsed = named.parse();
                    parsed.map_err(|_| format!("its server reports `{}`", named.escape_debug()))
                });
                (service, named)
            });
        }
        self.known.retain(|service, _| there.contains(service));
        std::mem::take(&mut self.faults)
    }

    /// Waits for a type, or for a failed query. Cancel-safe; pends while no query is running.
    pub(super) async fn recv(&mut self) {
        let answered = match self.asking.join_next().await {
            Some(answered) => answered,
            None => std::future::pending().await,
        };
        let Ok((service, named)) = answered else {
            return;
        };
        let Some(kind) = self.known.get_mut(&service) else {
            return;
        };
        kind.asked = false;
        match named {
            Ok(type_name) => kind.type_name = Some(type_name),
            Err(error) => {
                kind.wait = ASKED_AGAIN;
                self.faults.push((service, error));
            }
        }
    }
}

/// Maximum length of a name, in bytes.
const MAX_NAME: usize = 255;
/// Maximum number of services with stored types.
const MOST_KINDS: usize = 1024;
/// Maximum number of concurrent queries.
const MOST_ASKED: usize = 16;
const ASKED_WITHIN: Duration = Duration::from_secs(3);
/// Number of comparisons with the graph until a failed query is repeated.
const ASKED_AGAIN: u32 = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nodes_of_redundant_bridges_differ_by_their_rank() {
        for (own, node) in [
            ("/cell", "/cell_2"),
            ("/cell_3", "/cell"),
            ("/cell_2", "/cell_3"),
        ] {
            assert!(is_redundant_peer(own, node), "{own} {node}");
        }
        for (own, node) in [
            ("/cell", "/cell"),
            ("/cell", "/cell_4"),
            ("/cell_2", "/arm_2"),
        ] {
            assert!(!is_redundant_peer(own, node), "{own} {node}");
        }
    }
}
