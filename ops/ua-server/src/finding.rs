//! Servers with skills that are found by discovery. Servers are discovered by mDNS and in the lists
//! of discovery servers; accepted servers get a namespace number in the space.
//!
//! Discovery data is unauthenticated, so each server is queried for its identity before it gets a
//! number. [`ServerSearch`] owns the state; [`DiscoveredServers`] carries out its queries.

mod numbers;
mod search;

use std::collections::HashMap;
use std::time::Duration;

use bridge_node::now;
use discovery::{MdnsInterface, ServerChange, client};
use mappings::{Access, Endpoint, Mapping};
use tokio::task::{Id, JoinSet};

pub(crate) use self::search::Placed;
use self::search::{MOST_SEARCHED, ReportedIdentity, SearchAnswer, SearchQuery, ServerSearch};

/// The search for servers, and its queries in progress.
pub(crate) struct DiscoveredServers {
    search: ServerSearch,
    /// Allowed locations of servers that an announced discovery server lists.
    near: Option<MdnsInterface>,
    tasks: JoinSet<SearchAnswer>,
    queries: HashMap<Id, SearchQuery>,
}

impl DiscoveredServers {
    /// Creates the state from the mapping, with the discovery server of the command line.
    pub(crate) fn new(mapping: &Mapping, lds: Option<&str>, near: Option<MdnsInterface>) -> Self {
        Self {
            search: ServerSearch::new(mapping, lds, now().monotonic),
            near,
            tasks: JoinSet::new(),
            queries: HashMap::new(),
        }
    }

    /// Switches to another mapping.
    pub(crate) fn reload(&mut self, mapping: &Mapping) {
        self.search.reload(mapping);
    }

    /// Handles a change of a server in the network.
    pub(crate) fn heard(&mut self, found: &ServerChange) {
        self.search.heard(found);
    }

    /// Excludes a server that is a participant of the space itself. The server gets no number until
    /// its program restarts.
    pub(crate) fn leave_alone(&mut self, access: &Access) {
        self.search.leave_alone(access);
    }

    /// Returns the servers with a number. A server without any source keeps its number as long as
    /// `is_up` returns true.
    pub(crate) fn look(&mut self, is_up: impl Fn(&Access) -> bool) -> &[Placed] {
        self.search.look(is_up)
    }

    /// Waits until the numbered servers may have changed. Cancel-safe; pends if discovery of skills
    /// is disabled.
    pub(crate) async fn changed(&mut self) {
        while let Some(query) = self.search.poll_query() {
            let task = self.tasks.spawn(ask(query.clone(), self.near.clone()));
            self.queries.insert(task.id(), query);
        }
        let round = async {
            match self.search.poll_deadline() {
                Some(round) => tokio::time::sleep_until(round.into()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            Some(ended) = self.tasks.join_next_with_id(), if !self.tasks.is_empty() => {
                let (id, answer) = match ended {
                    Ok((id, answer)) => (id, Some(answer)),
                    Err(error) => (error.id(), None),
                };
                let query = self.queries.remove(&id);
                // A query with a failed task has no answer.
                if let Some(answer) = answer.or_else(|| query.map(SearchQuery::unanswered)) {
                    self.search.answered(answer);
                }
            }
            () = round => self.search.handle_deadline(now().monotonic),
        }
    }
}

/// Carries out a query.
async fn ask(query: SearchQuery, near: Option<MdnsInterface>) -> SearchAnswer {
    match query {
        SearchQuery::Identity(url) => {
            let identity = identity(&url).await;
            SearchAnswer::Identity(url, identity)
        }
        SearchQuery::List { lds, is_named } => {
            let servers = listed(&lds, near.filter(|_| !is_named)).await;
            SearchAnswer::List(lds, servers)
        }
    }
}

/// Returns the identity that a server reports.
async fn identity(url: &str) -> Option<ReportedIdentity> {
    let described = client::describe(url, ANSWERS_WITHIN).await.ok()?;
    Some(ReportedIdentity {
        application_uri: described.application.application_uri,
        product_uri: described.product_uri,
    })
}

/// Reads the list of a discovery server; without an answer the list is empty. Only servers that
/// `near` accepts are returned.
async fn listed(lds: &str, near: Option<MdnsInterface>) -> Vec<(String, String)> {
    let listed = client::find_servers(lds, ANSWERS_WITHIN).await;
    let listed = listed.unwrap_or_default().into_iter().take(MOST_SEARCHED);
    let servers = listed
        .filter(|server| !server.is_discovery_server)
        .filter_map(|server| {
            let mut urls = server.discovery_urls.into_iter();
            let url = urls.find(|url| Endpoint::parse(url).is_some())?;
            Some((server.application_uri, url))
        });
    let mut accepted = Vec::new();
    for (uri, url) in servers {
        let is_accepted = match &near {
            Some(near) => near.accepts(&url).await,
            None => true,
        };
        if is_accepted {
            accepted.push((uri, url));
        }
    }
    accepted
}

/// Time limit of a query. A busy server takes seconds.
const ANSWERS_WITHIN: Duration = Duration::from_secs(3);
