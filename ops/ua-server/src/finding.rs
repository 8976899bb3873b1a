//! Servers with skills that are found by discovery. Servers are discovered by mDNS and in the lists
//! of discovery servers; accepted servers get a namespace number in the space.
//!
//! Discovery data is unauthenticated, so each server is queried for its identity before it gets a
//! number.

mod numbers;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use discovery::{MdnsInterface, ServerChange, client};
use mappings::{Access, Endpoint, FindSkills, Mapping};
use tokio::task::JoinSet;
use tokio::time::{Interval, MissedTickBehavior, interval};
use tracing::{info, warn};

use self::numbers::{FreeNumbers, ServerNumbers};
use crate::identity::PRODUCT_URI;

/// A server with a number in the space.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Placed {
    pub(crate) name: String,
    pub(crate) namespace: u16,
    pub(crate) open: bool,
    pub(crate) access: Access,
}

/// The discovered servers.
pub(crate) struct DiscoveredServers {
    wanted: Option<FindSkills>,
    room: FreeNumbers,
    /// Endpoints of `servers` in the mapping, which get no second number.
    named: Vec<Endpoint>,
    own_uri: String,
    heard: BTreeMap<String, Heard>,
    /// Components with their own number in the space, by their announced names.
    speaking: BTreeMap<String, String>,
    /// Discovery servers to read lists from, by their sources.
    lists: BTreeMap<Source, String>,
    /// Allowed locations of servers that an announced discovery server lists.
    near: Option<MdnsInterface>,
    asking: JoinSet<Answer>,
    look: Interval,
    /// True if servers that no longer answer are to be queried again.
    is_time: bool,
    places: ServerNumbers,
    placed: Vec<Placed>,
    /// Servers without a free number, each logged once.
    crowded: BTreeSet<String>,
    /// True if the limit of discovered servers was logged.
    is_full: bool,
}

/// A discovered server, by its URL.
#[derive(Debug, Default)]
struct Heard {
    by: BTreeSet<Source>,
    /// The ApplicationUri according to announcements and lists.
    hint: Option<String>,
    /// The identity that the server itself reports.
    says: Option<Says>,
    /// True if the server is to be queried, for the first time or again after a change.
    due: bool,
    /// Number of rounds before the next query, and number of consecutive queries without an answer.
    pause: u32,
    failures: u32,
    is_asked: bool,
    /// True if the server should be connected but is not.
    is_missed: bool,
    /// True if the server was found to be a participant of the space itself.
    is_left_alone: bool,
}

/// The source of information about a server.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
enum Source {
    /// The server is announced under this name.
    Network(String),
    /// The discovery server at this URL lists the server.
    List(String),
    /// The command line names the server.
    Named,
}

/// The identity that a server reports.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Says {
    application_uri: String,
    product_uri: String,
}

enum Answer {
    /// The identity of the server at a URL, or `None` without an answer in time.
    Is(String, Option<Says>),
    /// The servers that a discovery server lists, each with its ApplicationUri.
    Lists(String, Vec<(String, String)>),
}

impl DiscoveredServers {
    /// Creates the state from the mapping, with the discovery server of the command line.
    pub(crate) fn new(mapping: &Mapping, lds: Option<&str>, near: Option<MdnsInterface>) -> Self {
        let mut look = interval(LOOK_AGAIN);
        look.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let lds = lds.filter(|lds| Endpoint::parse(lds).is_some());
        let mut finding = Self {
            wanted: None,
            room: FreeNumbers::default(),
            named: Vec::new(),
            own_uri: String::new(),
            heard: BTreeMap::new(),
            speaking: BTreeMap::new(),
            lists: lds
                .map(|lds| (Source::Named, lds.to_owned()))
                .into_iter()
                .collect(),
            near,
            asking: JoinSet::new(),
            look,
            is_time: false,
            places: ServerNumbers::default(),
            placed: Vec::new(),
            crowded: BTreeSet::new(),
            is_full: false,
        };
        finding.reload(mapping);
        finding
    }

    /// Switches to another mapping.
    pub(crate) fn reload(&mut self, mapping: &Mapping) {
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
        self.room = FreeNumbers {
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
    pub(crate) fn heard(&mut self, found: &ServerChange) {
        let known = found.known();
        let source = Source::Network(known.name.clone());
        let (is_there, is_new) = match found {
            ServerChange::Seen(_) => (true, false),
            ServerChange::Restarted(_) => (true, true),
            ServerChange::Gone { .. } => (false, false),
        };
        self.lists.remove(&source);
        self.speaking.remove(&known.name);
        if is_there && known.is_lds() {
            self.lists.insert(source, known.url.clone());
            return;
        }
        let url = url(&known.url).filter(|_| is_there && known.number.is_none());
        if let (Some(_), Some(uri)) = (known.number, &known.application_uri)
            && is_there
        {
            self.speaking.insert(known.name.clone(), uri.clone());
        }
        for (at, heard) in &mut self.heard {
            if Some(at) != url.as_ref() {
                heard.by.remove(&source);
            }
        }
        if let Some(url) = url {
            self.tell(url, source, known.application_uri.as_deref(), is_new);
        }
    }

    fn tell(&mut self, url: String, by: Source, hint: Option<&str>, is_new: bool) {
        let is_known = self.heard.contains_key(&url);
        if !is_known && self.heard.len() >= MOST_HEARD {
            if !std::mem::replace(&mut self.is_full, true) {
                warn!(
                    url,
                    most = MOST_HEARD,
                    "the limit of servers that are searched for skills is reached: ignored this server, and will ignore others without a log entry"
                );
            }
            return;
        }
        let heard = self.heard.entry(url).or_default();
        if is_new {
            (heard.pause, heard.failures) = (0, 0);
        }
        if is_new || heard.by.is_empty() {
            heard.due = heard.pause == 0;
            heard.is_left_alone = false;
        }
        heard.by.insert(by);
        if let Some(hint) = hint {
            heard.hint = Some(hint.to_owned());
        }
    }

    /// Excludes a server that is a participant of the space itself. The server gets no number until
    /// its program restarts.
    pub(crate) fn leave_alone(&mut self, access: &Access) {
        if let Some(heard) = self.heard.get_mut(&access.endpoint.to_string()) {
            heard.is_left_alone = true;
        }
    }

    /// Waits until the numbered servers may have changed. Cancel-safe; pends if discovery of skills
    /// is disabled.
    pub(crate) async fn changed(&mut self) {
        if self.wanted.is_none() {
            return std::future::pending().await;
        }
        self.ask();
        tokio::select! {
            Some(answer) = self.asking.join_next(), if !self.asking.is_empty() => {
                // A query that was aborted has no result and is repeated.
                if let Ok(answer) = answer {
                    self.take(answer);
                }
            }
            _ = self.look.tick() => {
                self.is_time = true;
                for heard in self.heard.values_mut().filter(|heard| heard.says.is_none()) {
                    heard.due |= heard.pause == 0;
                    heard.pause = heard.pause.saturating_sub(1);
                }
                let lists: BTreeSet<String> = self.lists.values().cloned().collect();
                for lds in lists.into_iter().take(MOST_LISTS) {
                    let is_named = self.lists.get(&Source::Named) == Some(&lds);
                    let near = self.near.clone().filter(|_| !is_named);
                    self.asking.spawn(listed(lds, near));
                }
            }
        }
    }

    /// Queries the due servers, a limited number at a time.
    fn ask(&mut self) {
        let Some(wanted) = &self.wanted else {
            return;
        };
        let asked = self.heard.values().filter(|heard| heard.is_asked).count();
        let due = self.heard.iter_mut().filter(|(_, heard)| {
            let may_be = heard.hint.as_ref().is_none_or(|uri| wanted.wants(uri));
            heard.due && !heard.is_asked && may_be
        });
        for (url, heard) in due.take(MOST_ASKED.saturating_sub(asked)) {
            (heard.due, heard.is_asked) = (false, true);
            self.asking.spawn(described(url.clone()));
        }
    }

    fn take(&mut self, answer: Answer) {
        match answer {
            Answer::Is(url, says) => {
                if let Some(heard) = self.heard.get_mut(&url) {
                    heard.is_asked = false;
                    heard.failures = match says {
                        Some(_) => 0,
                        None => (heard.failures + 1).min(MOST_DOUBLED),
                    };
                    heard.pause = (1 << heard.failures) - 1;
                    // A connected server may be too busy to answer; it is not lost.
                    if says.is_some() || heard.is_missed {
                        heard.says = says;
                    }
                }
            }
            Answer::Lists(lds, servers) => {
                let source = Source::List(lds);
                let servers = servers
                    .into_iter()
                    .filter_map(|(uri, at)| Some((url(&at)?, uri)));
                let servers: BTreeMap<String, String> = servers.collect();
                for (url, heard) in &mut self.heard {
                    if !servers.contains_key(url) {
                        heard.by.remove(&source);
                    }
                }
                for (url, uri) in servers {
                    self.tell(url, source.clone(), Some(&uri), false);
                }
            }
        }
    }

    /// Returns the servers with a number. A server without any source keeps its number as long as
    /// `is_up` returns true.
    pub(crate) fn look(&mut self, is_up: impl Fn(&Access) -> bool) -> &[Placed] {
        let lists: BTreeSet<&String> = self.lists.values().collect();
        for heard in self.heard.values_mut() {
            heard.by.retain(|by| match by {
                Source::List(lds) => lists.contains(lds),
                Source::Network(_) | Source::Named => true,
            });
        }
        let is_time = std::mem::take(&mut self.is_time);
        self.heard.retain(|url, heard| {
            let mut placed = self.placed.iter();
            let placed = placed.find(|placed| placed.access.endpoint.to_string() == *url);
            let is_up = placed.is_some_and(|placed| is_up(&placed.access));
            if is_time {
                heard.is_missed = placed.is_some() && !is_up;
                heard.due |= heard.is_missed;
            }
            !heard.by.is_empty() || is_up
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
                "lost a server that had its skills shown"
            );
        }
        self.placed = now;
        &self.placed
    }

    fn place(&mut self, wanted: &FindSkills) -> Vec<Placed> {
        let mut at: BTreeMap<String, Access> = BTreeMap::new();
        for (url, heard) in &self.heard {
            let says = heard.says.as_ref().filter(|_| !heard.is_left_alone);
            let Some(says) = says.filter(|says| self.may(says, wanted)) else {
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
            if is_used || !at.contains_key(&says.application_uri) {
                at.insert(says.application_uri.clone(), access);
            }
        }
        let there: BTreeSet<String> = at.keys().cloned().collect();
        self.crowded.retain(|uri| there.contains(uri));
        let mut all = Vec::new();
        for (uri, access) in at {
            let Some(place) = self.places.give(&uri, &self.room, &there) else {
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
    fn may(&self, says: &Says, wanted: &FindSkills) -> bool {
        let Says {
            application_uri: uri,
            product_uri,
        } = says;
        let mut speaking = self.speaking.values();
        wanted.wants(uri)
            && *uri != self.own_uri
            && product_uri != PRODUCT_URI
            && !speaking.any(|speaking| speaking == uri)
    }
}

/// Normalizes a URL: a path of `/` is removed.
fn url(text: &str) -> Option<String> {
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

async fn described(url: String) -> Answer {
    let described = client::describe(&url, ANSWERS_WITHIN).await;
    let says = described.ok().map(|described| Says {
        application_uri: described.application.application_uri,
        product_uri: described.product_uri,
    });
    Answer::Is(url, says)
}

/// Reads the list of a discovery server; without an answer the list is empty. Every host can
/// announce a discovery server, so only listed servers that `near` accepts are used.
async fn listed(lds: String, near: Option<MdnsInterface>) -> Answer {
    let listed = client::find_servers(&lds, ANSWERS_WITHIN).await;
    let listed = listed.unwrap_or_default().into_iter().take(MOST_HEARD);
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
    Answer::Lists(lds, accepted)
}

/// Interval of reading lists and of repeating unanswered queries.
const LOOK_AGAIN: Duration = Duration::from_secs(3);
/// Largest number of times that the pause of a server without answer doubles, which gives 32
/// rounds.
const MOST_DOUBLED: u32 = 5;
/// Time limit of a query. A busy server takes seconds.
const ANSWERS_WITHIN: Duration = Duration::from_secs(3);
/// Largest number of discovered servers.
const MOST_HEARD: usize = 256;
/// Largest number of simultaneous queries.
const MOST_ASKED: usize = 8;
/// Largest number of discovery servers to read lists from.
const MOST_LISTS: usize = 8;

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use discovery::{PresentServer, ServerLoss};

    use super::*;

    const MAPPING: &str = "
namespaces: {41: 'urn:v:oven'}
server: {find_skills: {uris: ['urn:v:*'], first: 40, most: 4, security: None}}
servers: [{name: press, endpoint: 'opc.tcp://127.0.0.1:5000'}]
";

    fn finding() -> DiscoveredServers {
        let checked = Mapping::from_yaml(MAPPING, "m.yaml");
        DiscoveredServers::new(&checked.mapping.unwrap(), None, None)
    }

    fn seen(name: &str, port: u16, number: u16) -> ServerChange {
        ServerChange::Seen(PresentServer {
            name: name.to_owned(),
            url: format!("opc.tcp://127.0.0.1:{port}/"),
            capabilities: Vec::new(),
            application_uri: Some(format!("urn:v:{name}")),
            since: SystemTime::UNIX_EPOCH,
            started: None,
            number: std::num::NonZeroU16::new(number),
        })
    }

    fn says(finding: &mut DiscoveredServers, port: u16, uri: &str, product: &str) {
        let says = Says {
            application_uri: uri.to_owned(),
            product_uri: product.to_owned(),
        };
        let url = format!("opc.tcp://127.0.0.1:{port}");
        finding.take(Answer::Is(url, Some(says)));
    }

    fn placed(finding: &mut DiscoveredServers, is_up: bool) -> Vec<(String, u16)> {
        let placed = finding.look(|_| is_up).iter();
        placed
            .map(|one| (one.access.endpoint.to_string(), one.namespace))
            .collect()
    }

    #[tokio::test]
    async fn who_has_said_to_be_one_of_those_wanted_has_a_place_until_it_is_gone() {
        let mut finding = finding();
        finding.heard(&seen("oven", 5001, 0));
        assert!(
            placed(&mut finding, false).is_empty(),
            "it has said nothing"
        );
        says(&mut finding, 5001, "urn:v:oven", "");
        let oven = vec![("opc.tcp://127.0.0.1:5001".to_owned(), 41)];
        assert_eq!(placed(&mut finding, false), oven);
        let gone = ServerChange::Gone {
            known: seen("oven", 5001, 0).known().clone(),
            loss: ServerLoss::Goodbye,
        };
        finding.heard(&gone);
        assert_eq!(placed(&mut finding, true), oven, "it still answers");
        assert!(placed(&mut finding, false).is_empty());
    }

    #[tokio::test]
    async fn nobody_has_a_place_who_is_in_the_space_already() {
        let mut finding = finding();
        for (name, port, number, uri, product) in [
            ("press", 5000, 0, "urn:v:press", ""),
            ("gripper", 5002, 7, "urn:v:gripper", ""),
            ("cell", 5003, 0, "urn:v:cell", PRODUCT_URI),
            ("thief", 5004, 0, "urn:w:thief", ""),
        ] {
            finding.heard(&seen(name, port, number));
            says(&mut finding, port, uri, product);
        }
        // A discovery server does not know that one of its servers has a number.
        finding
            .lists
            .insert(Source::Named, "opc.tcp://lds:4840".to_owned());
        finding.take(Answer::Lists(
            "opc.tcp://lds:4840".to_owned(),
            vec![
                (
                    "urn:v:gripper".to_owned(),
                    "opc.tcp://127.0.0.1:5002".to_owned(),
                ),
                (
                    "urn:v:saw".to_owned(),
                    "opc.tcp://127.0.0.1:5005".to_owned(),
                ),
            ],
        ));
        says(&mut finding, 5002, "urn:v:gripper", "");
        says(&mut finding, 5005, "urn:v:saw", "");
        let all = placed(&mut finding, false);
        assert_eq!(all.len(), 1, "{all:?}");
        assert_eq!(all[0].0, "opc.tcp://127.0.0.1:5005");
        finding.take(Answer::Lists("opc.tcp://lds:4840".to_owned(), Vec::new()));
        assert!(placed(&mut finding, false).is_empty());
    }
}
