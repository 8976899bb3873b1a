//! The types of the services of the graph.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use messages::TypeName;
use tcpros::{Node, ServiceClientOptions, ServiceError};
use tokio::task::JoinSet;

/// The types of services, which only their servers know.
#[derive(Debug, Default)]
pub(super) struct ServiceTypeLookup {
    known: BTreeMap<String, Kind>,
    asking: JoinSet<(String, Result<TypeName, NoServiceType>)>,
    faults: Vec<(String, String)>,
}

/// The reason why the type of a service is unknown.
#[derive(Debug, thiserror::Error)]
enum NoServiceType {
    #[error(transparent)]
    Probe(ServiceError),
    #[error("its server reports `{}`", .0.escape_debug())]
    Name(String),
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

impl ServiceTypeLookup {
    /// Returns the type of a service, if its server has reported it.
    pub(super) fn of(&self, service: &str) -> Option<&TypeName> {
        self.known.get(service)?.type_name.as_ref()
    }

    /// Queries the types of new services and of services with changed nodes, a few at a time.
    /// Returns the services of unknown type, with the reasons.
    pub(super) fn look<'s>(
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
                let header = client.probe().await.map_err(NoServiceType::Probe);
                let named = header.and_then(|header| {
                    let named = header.get("type").unwrap_or_default();
                    let parsed = named.parse();
                    parsed.map_err(|_| NoServiceType::Name(named.to_owned()))
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
                self.faults.push((service, error.to_string()));
            }
        }
    }
}

/// Maximum number of services with stored types.
const MOST_KINDS: usize = 1024;
/// Maximum number of concurrent queries.
const MOST_ASKED: usize = 16;
const ASKED_WITHIN: Duration = Duration::from_secs(3);
/// Number of comparisons with the graph until a failed query is repeated.
const ASKED_AGAIN: u32 = 10;
