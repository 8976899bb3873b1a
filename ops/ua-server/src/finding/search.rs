//! The search for servers with skills, without clocks, tasks or sockets.
//!
//! A [`ServerSearch`] owns the discovered servers and their numbers. Inputs are the changes of
//! servers in the network ([`heard`](ServerSearch::heard)), the answers to its queries
//! ([`answered`](ServerSearch::answered)) and [`handle_deadline`](ServerSearch::handle_deadline).
//! Drain [`poll_query`](ServerSearch::poll_query) after each input, and call `handle_deadline` when
//! the time of [`poll_deadline`](ServerSearch::poll_deadline) has passed.
//! [`look`](ServerSearch::look) returns the servers with a number.
//!
//! - Each query has one answer. A server or list with a query in progress is not queried again.
//! - At most [`MOST_ASKED`] servers and [`MOST_LISTS`] lists are queried at the same time.
//! - A server gets a number only after it has reported an identity that the mapping accepts.

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use discovery::ServerChange;
use mappings::{Access, Endpoint, FindSkills, Mapping};
use tracing::{info, warn};

use super::numbers::{FreeNumbers, ServerNumbers};
use crate::identity::PRODUCT_URI;

/// A server with a number in the space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Placed {
    pub(crate) name: String,
    pub(crate) namespace: u16,
    pub(crate) open: bool,
    pub(crate) access: Access,
}

/// The state of the search.
pub(super) struct ServerSearch {
    /// The accepted servers; `None` if the search is disabled.
    wanted: Option<FindSkills>,
    numbers: FreeNumbers,
    /// Endpoints of `servers` in the mapping, which get no second number.
    named: Vec<Endpoint>,
    own_uri: String,
    servers: BTreeMap<String, SearchedUrl>,
    /// Components with their own number in the space, by their announced names.
    components: BTreeMap<String, String>,
    /// Discovery servers to read lists from, by their sources.
    lists: BTreeMap<SearchSource, String>,
    /// URLs of servers with a query in progress.
    asked: BTreeSet<String>,
    /// URLs of discovery servers whose lists are to be read.
    due_lists: BTreeSet<String>,
    /// URLs of discovery servers whose lists are being read.
    read_lists: BTreeSet<String>,
    /// Time of the next round.
    round: Instant,
    /// True after a round, until lost servers are marked for a query.
    is_round: bool,
    assigned: ServerNumbers,
    placed: Vec<Placed>,
    /// Servers without a free number, each logged once.
    crowded: BTreeSet<String>,
    /// True if the limit of discovered servers was logged.
    is_full: bool,
}

/// A discovered server, by its URL.
#[derive(Debug, Default)]
struct SearchedUrl {
    by: BTreeSet<SearchSource>,
    /// The ApplicationUri according to announcements and lists.
    hint: Option<String>,
    /// The identity that the server itself reports.
    identity: Option<ReportedIdentity>,
    /// True if the server is to be queried, for the first time or again after a change.
    due: bool,
    /// Number of rounds before the next query, and number of consecutive queries without an answer.
    pause: u32,
    failures: u32,
    /// True if the server should be connected but is not.
    is_missed: bool,
    /// True if the server was found to be a participant of the space itself.
    is_left_alone: bool,
}

/// The source of information about a server.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum SearchSource {
    /// The server is announced under this name.
    Network(String),
    /// The discovery server at this URL lists the server.
    List(String),
    /// The command line names the server.
    Named,
}

/// The identity that a server reports.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct ReportedIdentity {
    pub(super) application_uri: String,
    pub(super) product_uri: String,
}

/// A query that the search wants answered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum SearchQuery {
    /// The identity of the server at a URL.
    Identity(String),
    /// The list of a discovery server.
    List {
        /// The URL of the discovery server.
        lds: String,
        /// True if the command line names the discovery server. Every host can announce a
        /// discovery server, so of other lists only servers nearby are accepted.
        is_named: bool,
    },
}

/// The answer to a query.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum SearchAnswer {
    /// The identity of the server at a URL, or `None` without an answer in time.
    Identity(String, Option<ReportedIdentity>),
    /// The ApplicationUris and URLs of the servers that the discovery server at a URL lists; empty
    /// without an answer in time.
    List(String, Vec<(String, String)>),
}

impl SearchQuery {
    /// Returns the answer to the query of a server that did not answer.
    pub(super) fn unanswered(self) -> SearchAnswer {
        match self {
            Self::Identity(url) => SearchAnswer::Identity(url, None),
            Self::List { lds, .. } => SearchAnswer::List(lds, Vec::new()),
        }
    }
}

impl ServerSearch {
    /// Creates the state from the mapping, with the discovery server of the command line. The first
    /// round is due at once.
    pub(super) fn new(mapping: &Mapping, lds: Option<&str>, now: Instant) -> Self {
        let lds = lds.filter(|lds| Endpoint::parse(lds).is_some());
        let named = lds.map(|lds| (SearchSource::Named, lds.to_owned()));
        let mut search = Self {
            wanted: None,
            numbers: FreeNumbers::default(),
            named: Vec::new(),
            own_uri: String::new(),
            servers: BTreeMap::new(),
            components: BTreeMap::new(),
            lists: named.into_iter().collect(),
            asked: BTreeSet::new(),
            due_lists: BTreeSet::new(),
            read_lists: BTreeSet::new(),
            round: now,
            is_round: false,
            assigned: ServerNumbers::default(),
            placed: Vec::new(),
            crowded: BTreeSet::new(),
            is_full: false,
        };
        search.reload(mapping);
        search
    }

    /// Switches to another mapping.
    pub(super) fn reload(&mut self, mapping: &Mapping) {
        let server = mapping.server();
        self.wanted.clone_from(&server.find_skills);
        self.own_uri.clone_from(&server.application_uri);
        let servers = mapping.servers().iter();
        self.named = servers
            .clone()
            .map(|server| server.access.endpoint.clone())
            .collect();
        let namespaces = self.wanted.as_ref().map(FindSkills::namespaces);
        let kept = mapping.namespaces().iter();
        let kept = kept.filter(|(namespace, _)| {
            let mut of = namespaces.iter();
            of.any(|namespaces| namespaces.contains(namespace))
        });
        self.numbers = FreeNumbers {
            kept: kept
                .map(|(namespace, uri)| (*namespace, uri.clone()))
                .collect(),
            named: servers.map(|server| server.name.clone()).collect(),
            namespaces,
        };
        self.crowded.clear();
        self.is_full = false;
    }

    /// Handles a change of a server in the network.
    pub(super) fn heard(&mut self, found: &ServerChange) {
        let known = found.known();
        let source = SearchSource::Network(known.name.clone());
        let (is_there, is_new) = match found {
            ServerChange::Seen(_) => (true, false),
            ServerChange::Restarted(_) => (true, true),
            ServerChange::Gone { .. } => (false, false),
        };
        self.lists.remove(&source);
        self.components.remove(&known.name);
        if is_there && known.is_lds() {
            self.lists.insert(source, known.url.clone());
            return;
        }
        let url = normalized(&known.url).filter(|_| is_there && known.number.is_none());
        if let (Some(_), Some(uri)) = (known.number, &known.application_uri)
            && is_there
        {
            self.components.insert(known.name.clone(), uri.clone());
        }
        for (at, server) in &mut self.servers {
            if Some(at) != url.as_ref() {
                server.by.remove(&source);
            }
        }
        if let Some(url) = url {
            self.add(url, source, known.application_uri.as_deref(), is_new);
        }
    }

    fn add(&mut self, url: String, by: SearchSource, hint: Option<&str>, is_new: bool) {
        let is_known = self.servers.contains_key(&url);
        if !is_known && self.servers.len() >= MOST_SEARCHED {
            if !std::mem::replace(&mut self.is_full, true) {
                warn!(
                    url,
                    most = MOST_SEARCHED,
                    "the limit of servers that are searched for skills is reached: ignored this server, and will ignore others without a log entry"
                );
            }
            return;
        }
        let server = self.servers.entry(url).or_default();
        if is_new {
            (server.pause, server.failures) = (0, 0);
        }
        if is_new || server.by.is_empty() {
            server.due = server.pause == 0;
            server.is_left_alone = false;
        }
        server.by.insert(by);
        if let Some(hint) = hint {
            server.hint = Some(hint.to_owned());
        }
    }

    /// Excludes a server that is a participant of the space itself. The server gets no number until
    /// its program restarts.
    pub(super) fn leave_alone(&mut self, access: &Access) {
        if let Some(server) = self.servers.get_mut(&access.endpoint.to_string()) {
            server.is_left_alone = true;
        }
    }

    /// Returns the next query. Each query needs an [`answered`](Self::answered).
    pub(super) fn poll_query(&mut self) -> Option<SearchQuery> {
        let wanted = self.wanted.as_ref()?;
        if let Some(lds) = self.due_lists.pop_first() {
            self.read_lists.insert(lds.clone());
            let is_named = self.lists.get(&SearchSource::Named) == Some(&lds);
            return Some(SearchQuery::List { lds, is_named });
        }
        if self.asked.len() >= MOST_ASKED {
            return None;
        }
        let (url, server) = self.servers.iter_mut().find(|(url, server)| {
            let may_be = server.hint.as_ref().is_none_or(|uri| wanted.wants(uri));
            server.due && may_be && !self.asked.contains(*url)
        })?;
        server.due = false;
        self.asked.insert(url.clone());
        Some(SearchQuery::Identity(url.clone()))
    }

    /// Handles the answer to a query.
    pub(super) fn answered(&mut self, answer: SearchAnswer) {
        match answer {
            SearchAnswer::Identity(url, identity) => self.identified(&url, identity),
            SearchAnswer::List(lds, servers) => self.listed(lds, servers),
        }
    }

    fn identified(&mut self, url: &str, identity: Option<ReportedIdentity>) {
        self.asked.remove(url);
        let Some(server) = self.servers.get_mut(url) else {
            return;
        };
        server.failures = match identity {
            Some(_) => 0,
            None => (server.failures + 1).min(MOST_DOUBLED),
        };
        server.pause = (1 << server.failures) - 1;
        // A connected server may be too busy to answer; it is not lost.
        if identity.is_some() || server.is_missed {
            server.identity = identity;
        }
    }

    fn listed(&mut self, lds: String, servers: Vec<(String, String)>) {
        self.read_lists.remove(&lds);
        let source = SearchSource::List(lds);
        let servers = servers.into_iter();
        let servers = servers.filter_map(|(uri, at)| Some((normalized(&at)?, uri)));
        let servers: BTreeMap<String, String> = servers.collect();
        for (url, known) in &mut self.servers {
            if !servers.contains_key(url) {
                known.by.remove(&source);
            }
        }
        for (url, uri) in servers {
            self.add(url, source.clone(), Some(&uri), false);
        }
    }

    /// Returns the time of the next [`handle_deadline`](Self::handle_deadline); `None` if the
    /// search is disabled.
    pub(super) fn poll_deadline(&self) -> Option<Instant> {
        self.wanted.is_some().then_some(self.round)
    }

    /// Starts a round if it is due: lists are read, and servers without an answer are queried
    /// again.
    pub(super) fn handle_deadline(&mut self, now: Instant) {
        if self.wanted.is_none() || now < self.round {
            return;
        }
        self.round = now + ROUND;
        self.is_round = true;
        let unidentified = |server: &&mut SearchedUrl| server.identity.is_none();
        for server in self.servers.values_mut().filter(unidentified) {
            server.due |= server.pause == 0;
            server.pause = server.pause.saturating_sub(1);
        }
        let lists: BTreeSet<&String> = self.lists.values().collect();
        let lists = lists.into_iter().take(MOST_LISTS);
        let lists = lists.filter(|lds| !self.read_lists.contains(*lds));
        self.due_lists = lists.cloned().collect();
    }

    /// Returns the servers with a number. A server without any source keeps its number as long as
    /// `is_up` returns true.
    pub(super) fn look(&mut self, is_up: impl Fn(&Access) -> bool) -> &[Placed] {
        let lists: BTreeSet<&String> = self.lists.values().collect();
        for server in self.servers.values_mut() {
            server.by.retain(|by| match by {
                SearchSource::List(lds) => lists.contains(lds),
                SearchSource::Network(_) | SearchSource::Named => true,
            });
        }
        let is_round = std::mem::take(&mut self.is_round);
        self.servers.retain(|url, server| {
            let mut placed = self.placed.iter();
            let placed = placed.find(|placed| placed.access.endpoint.to_string() == *url);
            let is_up = placed.is_some_and(|placed| is_up(&placed.access));
            if is_round {
                server.is_missed = placed.is_some() && !is_up;
                server.due |= server.is_missed;
            }
            !server.by.is_empty() || is_up
        });
        let wanted = self.wanted.clone();
        let now = wanted.map_or_else(Vec::new, |wanted| self.place(&wanted));
        for placed in now.iter().filter(|one| !self.placed.contains(one)) {
            info!(
                server = placed.name,
                url = %placed.access.endpoint,
                namespace = placed.namespace,
                "a server is found, and is asked for its skills"
            );
        }
        for placed in self.placed.iter().filter(|one| !now.contains(one)) {
            info!(
                server = placed.name,
                url = %placed.access.endpoint,
                "lost a server whose skills were shown"
            );
        }
        self.placed = now;
        &self.placed
    }

    /// Assigns numbers to the identified servers that the mapping accepts.
    fn place(&mut self, wanted: &FindSkills) -> Vec<Placed> {
        let mut at: BTreeMap<String, Access> = BTreeMap::new();
        for (url, server) in &self.servers {
            let identity = server.identity.as_ref();
            let identity = identity.filter(|_| !server.is_left_alone);
            let Some(identity) = identity.filter(|said| self.is_allowed(said, wanted)) else {
                continue;
            };
            let Some(access) = access(url, wanted) else {
                continue;
            };
            let mut named = self.named.iter();
            if named.any(|one| one.host == access.endpoint.host && one.port == access.endpoint.port)
            {
                continue;
            }
            // Of several endpoints of a server, the endpoint in use is kept.
            let mut placed = self.placed.iter();
            let is_used = placed.any(|placed| placed.access == access);
            if is_used || !at.contains_key(&identity.application_uri) {
                at.insert(identity.application_uri.clone(), access);
            }
        }
        let there: BTreeSet<String> = at.keys().cloned().collect();
        self.crowded.retain(|uri| there.contains(uri));
        let mut all = Vec::new();
        for (uri, access) in at {
            let Some(place) = self.assigned.give(&uri, &self.numbers, &there) else {
                if self.crowded.insert(uri.clone()) {
                    warn!(
                        uri,
                        url = %access.endpoint,
                        most = wanted.most,
                        "ignored a found server: the limit of server.find_skills.most is reached; raise it in the mapping"
                    );
                }
                continue;
            };
            all.push(Placed {
                name: place.name,
                namespace: place.namespace,
                open: wanted.open,
                access,
            });
        }
        all
    }

    /// Returns true if a server may have a number. Excluded are servers of cells, because their
    /// Programs are in the space already, and participants of the space.
    fn is_allowed(&self, identity: &ReportedIdentity, wanted: &FindSkills) -> bool {
        let ReportedIdentity {
            application_uri: uri,
            product_uri,
        } = identity;
        let mut components = self.components.values();
        wanted.wants(uri)
            && *uri != self.own_uri
            && product_uri != PRODUCT_URI
            && !components.any(|component| component == uri)
    }
}

/// Normalizes a URL: a path of `/` is removed.
fn normalized(text: &str) -> Option<String> {
    let mut endpoint = Endpoint::parse(text)?;
    if endpoint.path == "/" {
        endpoint.path.clear();
    }
    Some(endpoint.to_string())
}

fn access(url: &str, wanted: &FindSkills) -> Option<Access> {
    Some(Access {
        security: wanted.security,
        ..Access::anonymous(Endpoint::parse(url)?)
    })
}

/// Interval of reading lists and of repeating unanswered queries.
const ROUND: Duration = Duration::from_secs(3);
/// Largest number of times that the pause of a server without answer doubles, which gives 32
/// rounds.
const MOST_DOUBLED: u32 = 5;
/// Largest number of discovered servers.
pub(super) const MOST_SEARCHED: usize = 256;
/// Largest number of simultaneous queries.
const MOST_ASKED: usize = 8;
/// Largest number of discovery servers to read lists from.
const MOST_LISTS: usize = 8;
