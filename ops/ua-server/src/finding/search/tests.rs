//! The search with simulated time, and with answers that are late or lost.

use std::time::SystemTime;

use bridge_node::now;
use discovery::{PresentServer, ServerLoss};

use super::*;
use crate::dice::Dice;

const MAPPING: &str = "
namespaces: {41: 'urn:v:oven'}
server: {find_skills: {uris: ['urn:v:*'], first: 40, most: 4, security: None}}
servers: [{name: press, endpoint: 'opc.tcp://127.0.0.1:5000'}]
";
const LDS: &str = "opc.tcp://lds:4840";

fn mapping(text: &str) -> Mapping {
    Mapping::from_yaml(text, "m.yaml").mapping.unwrap()
}

/// A search, and the network in which its queries are answered.
struct SimulatedNetwork {
    search: ServerSearch,
    now: Instant,
    /// The servers that answer: their URLs, ApplicationUris and ProductUris.
    online: BTreeMap<String, (String, String)>,
    /// The servers that discovery servers list, by the URLs of the discovery servers.
    lists: BTreeMap<String, Vec<(String, String)>>,
    /// URLs of the servers to which there are connections.
    connected: BTreeSet<String>,
    /// Number of queries of each URL.
    queries: BTreeMap<String, usize>,
}

impl SimulatedNetwork {
    fn new(lds: Option<&str>) -> Self {
        let now = now().monotonic;
        Self {
            search: ServerSearch::new(&mapping(MAPPING), lds, now),
            now,
            online: BTreeMap::new(),
            lists: BTreeMap::new(),
            connected: BTreeSet::new(),
            queries: BTreeMap::new(),
        }
    }

    fn start(&mut self, port: u16, uri: &str) {
        self.start_product(port, uri, "");
    }

    fn start_product(&mut self, port: u16, uri: &str, product: &str) {
        self.online
            .insert(at(port), (uri.to_owned(), product.to_owned()));
    }

    /// Returns the answer of the network to a query.
    fn answer(&self, query: &SearchQuery) -> SearchAnswer {
        match query {
            SearchQuery::Identity(url) => {
                let identity = self.online.get(url);
                let identity = identity.map(|(uri, product)| ReportedIdentity {
                    application_uri: uri.clone(),
                    product_uri: product.clone(),
                });
                SearchAnswer::Identity(url.clone(), identity)
            }
            SearchQuery::List { lds, .. } => SearchAnswer::List(
                lds.clone(),
                self.lists.get(lds).cloned().unwrap_or_default(),
            ),
        }
    }

    /// Answers all queries, and returns the servers with a number.
    fn settle(&mut self) -> Vec<(String, u16)> {
        self.look();
        while let Some(query) = self.search.poll_query() {
            let (SearchQuery::Identity(url) | SearchQuery::List { lds: url, .. }) = &query;
            *self.queries.entry(url.clone()).or_default() += 1;
            let answer = self.answer(&query);
            self.search.answered(answer);
        }
        self.look()
    }

    fn look(&mut self) -> Vec<(String, u16)> {
        let connected = &self.connected;
        let is_up = |access: &Access| connected.contains(&access.endpoint.to_string());
        let placed = self.search.look(is_up).iter();
        placed
            .map(|one| (one.access.endpoint.to_string(), one.namespace))
            .collect()
    }

    /// Lets the time pass until the next round, and answers its queries.
    fn round(&mut self) -> Vec<(String, u16)> {
        self.now = self.search.poll_deadline().unwrap();
        self.search.handle_deadline(self.now);
        self.settle()
    }

    fn queried(&self, port: u16) -> usize {
        self.queries.get(&at(port)).copied().unwrap_or_default()
    }
}

fn at(port: u16) -> String {
    format!("opc.tcp://127.0.0.1:{port}")
}

fn present(name: &str, port: u16, number: u16) -> PresentServer {
    PresentServer {
        name: name.to_owned(),
        url: format!("{}/", at(port)),
        capabilities: Vec::new(),
        application_uri: Some(format!("urn:v:{name}")),
        since: SystemTime::UNIX_EPOCH,
        started: None,
        number: std::num::NonZeroU16::new(number),
    }
}

fn seen(name: &str, port: u16, number: u16) -> ServerChange {
    ServerChange::Seen(present(name, port, number))
}

fn gone(name: &str, port: u16) -> ServerChange {
    ServerChange::Gone {
        known: present(name, port, 0),
        loss: ServerLoss::Goodbye,
    }
}

#[test]
fn a_server_has_a_number_from_its_answer_until_it_is_lost_and_disconnected() {
    let mut network = SimulatedNetwork::new(None);
    network.search.heard(&seen("oven", 5001, 0));
    assert!(network.look().is_empty(), "it has not answered");
    network.start(5001, "urn:v:oven");
    let oven = [(at(5001), 41)];
    assert_eq!(network.settle(), oven);
    network.connected.insert(at(5001));
    network.search.heard(&gone("oven", 5001));
    assert_eq!(network.round(), oven, "it is connected");
    network.connected.clear();
    assert!(network.look().is_empty());
    network.search.heard(&seen("oven", 5001, 0));
    assert_eq!(network.settle(), oven, "it returns to its number");
}

#[test]
fn a_server_without_answer_is_queried_after_1_2_4_and_up_to_32_rounds_and_at_once_after_a_restart()
{
    let mut network = SimulatedNetwork::new(None);
    network.search.heard(&seen("saw", 5001, 0));
    network.settle();
    assert_eq!(network.queried(5001), 1);
    let mut rounds = Vec::new();
    for round in 1..=130 {
        let before = network.queried(5001);
        network.round();
        if network.queried(5001) > before {
            rounds.push(round);
        }
    }
    assert_eq!(rounds, [2, 6, 14, 30, 62, 94, 126]);
    network.start(5001, "urn:v:saw");
    let restarted = ServerChange::Restarted(present("saw", 5001, 0));
    network.search.heard(&restarted);
    assert_eq!(network.settle().len(), 1);
    // An identified server is not queried again while it is connected.
    network.connected.insert(at(5001));
    let before = network.queried(5001);
    for _ in 0..10 {
        network.round();
    }
    assert_eq!(network.queried(5001), before);
}

#[test]
fn a_server_that_is_not_connected_is_queried_in_each_round_and_keeps_its_number_while_it_answers() {
    let mut network = SimulatedNetwork::new(None);
    network.start(5001, "urn:v:saw");
    network.search.heard(&seen("saw", 5001, 0));
    assert_eq!(network.settle().len(), 1);
    for _ in 0..3 {
        let before = network.queried(5001);
        assert_eq!(network.round().len(), 1);
        assert_eq!(network.queried(5001), before + 1);
    }
    network.online.clear();
    assert!(network.round().is_empty(), "it does not answer");
}

#[test]
fn a_connected_server_that_is_too_busy_to_answer_keeps_its_number() {
    let mut network = SimulatedNetwork::new(None);
    network.start(5001, "urn:v:saw");
    network.search.heard(&seen("saw", 5001, 0));
    assert_eq!(network.settle().len(), 1);
    network.connected.insert(at(5001));
    network.online.clear();
    let restarted = ServerChange::Restarted(present("saw", 5001, 0));
    network.search.heard(&restarted);
    assert_eq!(network.settle().len(), 1);
    assert_eq!(network.queried(5001), 2);
}

#[test]
fn participants_of_the_space_and_unwanted_servers_have_no_number() {
    let mut network = SimulatedNetwork::new(Some(LDS));
    for (name, port, number, uri, product) in [
        ("press", 5000, 0, "urn:v:press", ""),
        ("gripper", 5002, 7, "urn:v:gripper", ""),
        ("cell", 5003, 0, "urn:v:cell", PRODUCT_URI),
        ("thief", 5004, 0, "urn:w:thief", ""),
    ] {
        network.search.heard(&seen(name, port, number));
        network.start_product(port, uri, product);
    }
    // A discovery server does not know that one of its servers has a number.
    let listed = [("urn:v:gripper", 5002), ("urn:v:saw", 5005)];
    let listed = listed.map(|(uri, port)| (uri.to_owned(), at(port)));
    network.lists.insert(LDS.to_owned(), listed.to_vec());
    network.start(5005, "urn:v:saw");
    let placed = network.round();
    assert_eq!(placed.len(), 1, "{placed:?}");
    assert_eq!(placed[0].0, at(5005));
    // A component of the space that is found late is excluded until it restarts.
    let access = network.search.look(|_| false)[0].access.clone();
    network.search.leave_alone(&access);
    assert!(network.round().is_empty());
}

#[test]
fn the_list_of_the_named_discovery_server_is_read_in_each_round_one_query_at_a_time() {
    let mut network = SimulatedNetwork::new(Some(LDS));
    network.search.handle_deadline(network.now);
    let query = network.search.poll_query().unwrap();
    let expected = SearchQuery::List {
        lds: LDS.to_owned(),
        is_named: true,
    };
    assert_eq!(query, expected);
    for _ in 0..3 {
        network.now += ROUND;
        network.search.handle_deadline(network.now);
        assert_eq!(network.search.poll_query(), None, "it is being read");
    }
    network.start(5005, "urn:v:saw");
    let saw = ("urn:v:saw".to_owned(), at(5005));
    network.lists.insert(LDS.to_owned(), vec![saw]);
    let answer = network.answer(&query);
    network.search.answered(answer);
    assert_eq!(network.settle().len(), 1);
    // A lost answer is an empty list. The server keeps its number while it is connected.
    network.connected.insert(at(5005));
    network.lists.clear();
    assert_eq!(network.round().len(), 1);
    network.connected.clear();
    assert!(network.round().is_empty());
}

#[test]
fn an_announced_discovery_server_is_read_as_such_until_it_is_lost() {
    let mut network = SimulatedNetwork::new(None);
    let mut lds = present("lds", 4840, 0);
    lds.capabilities = vec!["LDS".to_owned()];
    network.search.heard(&ServerChange::Seen(lds.clone()));
    network.search.handle_deadline(network.now);
    let query = network.search.poll_query().unwrap();
    assert!(
        matches!(
            &query,
            SearchQuery::List {
                is_named: false,
                ..
            }
        ),
        "{query:?}"
    );
    network.start(5005, "urn:v:saw");
    let saw = vec![("urn:v:saw".to_owned(), at(5005))];
    network
        .search
        .answered(SearchAnswer::List(lds.url.clone(), saw));
    assert_eq!(network.settle().len(), 1);
    let loss = ServerLoss::Goodbye;
    network
        .search
        .heard(&ServerChange::Gone { known: lds, loss });
    assert!(
        network.settle().is_empty(),
        "its list is not valid any more"
    );
    assert_eq!(network.search.poll_query(), None);
}

#[test]
fn as_many_servers_have_a_number_as_the_mapping_allows_and_a_free_number_is_assigned_again() {
    let mut network = SimulatedNetwork::new(None);
    // Number 41 is reserved for the oven, so three numbers are free.
    for port in 5001..=5004 {
        let name = format!("saw{port}");
        network.start(port, &format!("urn:v:{name}"));
        network.search.heard(&seen(&name, port, 0));
    }
    let placed = network.settle();
    assert_eq!(placed.len(), 3, "{placed:?}");
    let (lost, number) = placed[0].clone();
    let port: u16 = lost.rsplit(':').next().unwrap().parse().unwrap();
    network.search.heard(&gone(&format!("saw{port}"), port));
    let placed = network.settle();
    assert_eq!(placed.len(), 3, "{placed:?}");
    assert!(placed.iter().any(|(url, of)| *url != lost && *of == number));
}

#[test]
fn no_more_servers_are_kept_and_queried_at_the_same_time_than_the_limits() {
    let mut network = SimulatedNetwork::new(None);
    for port in 1..=300 {
        network.search.heard(&seen(&format!("saw{port}"), port, 0));
    }
    assert_eq!(network.search.servers.len(), MOST_SEARCHED);
    let first = std::iter::from_fn(|| network.search.poll_query());
    let first: Vec<SearchQuery> = first.take(100).collect();
    assert_eq!(first.len(), MOST_ASKED);
    network.search.answered(first[0].clone().unanswered());
    assert!(network.search.poll_query().is_some());
    assert_eq!(network.search.poll_query(), None);
}

#[test]
fn a_search_that_is_disabled_asks_nobody_and_has_no_deadline() {
    let mut network = SimulatedNetwork::new(Some(LDS));
    network.start(5001, "urn:v:saw");
    network.search.heard(&seen("saw", 5001, 0));
    assert_eq!(network.round().len(), 1);
    network
        .search
        .reload(&mapping("server: {endpoint: 'opc.tcp://127.0.0.1:4858'}"));
    assert_eq!(network.search.poll_deadline(), None);
    assert!(network.look().is_empty());
    network.search.handle_deadline(network.now + 10 * ROUND);
    assert_eq!(network.search.poll_query(), None);
    network.search.reload(&mapping(MAPPING));
    assert_eq!(network.round().len(), 1);
}

/// Servers come and go, answers are late or lost. In the end, each online server has a number.
#[test]
fn after_any_losses_the_servers_that_are_online_have_numbers_of_their_own() {
    for seed in 1..=100 {
        let mut dice = Dice(seed * 0x9e37_79b9);
        let mut network = SimulatedNetwork::new(None);
        let mut waiting: Vec<SearchQuery> = Vec::new();
        for _ in 0..300 {
            let port = 5001 + u16::try_from(dice.below(3)).unwrap();
            let name = format!("saw{port}");
            match dice.below(6) {
                0 => {
                    network.start(port, &format!("urn:v:{name}"));
                    network.search.heard(&seen(&name, port, 0));
                }
                1 => {
                    network.online.remove(&at(port));
                    network.connected.remove(&at(port));
                    network.search.heard(&gone(&name, port));
                }
                2 => {
                    network.now += ROUND;
                    network.search.handle_deadline(network.now);
                }
                3 => waiting.extend(network.search.poll_query()),
                4 if !waiting.is_empty() => {
                    let query = waiting.swap_remove(0);
                    let answer = if dice.below(2) == 0 {
                        query.unanswered()
                    } else {
                        network.answer(&query)
                    };
                    network.search.answered(answer);
                }
                _ => {
                    for (url, _) in network.look() {
                        if network.online.contains_key(&url) {
                            network.connected.insert(url);
                        }
                    }
                }
            }
            assert!(waiting.len() <= MOST_ASKED, "seed {seed}");
            let placed = network.look();
            let numbers: BTreeSet<u16> = placed.iter().map(|(_, number)| *number).collect();
            assert_eq!(numbers.len(), placed.len(), "seed {seed}: {placed:?}");
        }
        for query in waiting {
            network.search.answered(query.unanswered());
        }
        for _ in 0..70 {
            network.round();
        }
        let placed = network.look();
        let placed: BTreeSet<String> = placed.into_iter().map(|(url, _)| url).collect();
        let online: BTreeSet<String> = network.online.keys().cloned().collect();
        assert_eq!(placed, online, "seed {seed}");
    }
}
