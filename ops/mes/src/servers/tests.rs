use std::path::Path;
use std::time::SystemTime;

use ::knowledge::{KnowledgeSource, SourceKind};

use super::graph::ServerUris;
use super::*;
use crate::search_limits::SearchLimits;
use crate::settings::Settings;

fn present(name: &str, url: &str, uri: Option<&str>) -> (String, PresentServer) {
    let server = PresentServer {
        name: name.to_owned(),
        url: url.to_owned(),
        capabilities: vec!["DA".to_owned()],
        application_uri: uri.map(str::to_owned),
        since: SystemTime::UNIX_EPOCH,
        started: None,
        number: None,
    };
    (name.to_owned(), server)
}

fn wanted(servers: &str) -> WantedServers {
    let text = format!("mes: m\napplication_uri: urn:mes\nnamespace: 5\nservers:\n{servers}");
    let settings = Settings::from_yaml(&text, Path::new(""))
        .unwrap_or_else(|findings| panic!("{}", findings.render("mes.yaml", &text)));
    WantedServers {
        entries: settings.servers,
        ..WantedServers::default()
    }
}

/// Returns the names, endpoints and limits of the planned servers, and the names of the missing.
fn plan(wanted: &WantedServers) -> (Vec<(String, String, usize)>, Vec<String>) {
    let (planned, missing) = wanted.plan("urn:mes");
    let planned = planned.into_iter();
    let planned = planned.map(|(name, one)| (name, one.endpoint, one.entry.limits.nodes));
    (planned.collect(), missing.into_keys().collect())
}

#[test]
fn a_discovered_server_with_an_entry_of_its_own_is_followed_once() {
    let mut wanted = wanted(
        "  - discovered\n  - opc.tcp://127.0.0.1:1\n  - {server: urn:press, nodes: 7}\n  - urn:away\n",
    );
    wanted.present = BTreeMap::from([
        present("a", "opc.tcp://127.0.0.1:1/", Some("urn:first")),
        present("b", "opc.tcp://127.0.0.1:2/", Some("urn:press")),
        present("c", "opc.tcp://127.0.0.1:3/", None),
        present("d", "opc.tcp://127.0.0.1:4/", Some("urn:mes")),
    ]);
    let usual = SearchLimits::default().nodes;
    let expected = [
        ("opc.tcp://127.0.0.1:1", "opc.tcp://127.0.0.1:1", usual),
        ("opc.tcp://127.0.0.1:3/", "opc.tcp://127.0.0.1:3/", usual),
        ("urn:press", "opc.tcp://127.0.0.1:2/", 7),
    ]
    .map(|(name, endpoint, nodes)| (name.to_owned(), endpoint.to_owned(), nodes));
    assert_eq!(
        plan(&wanted),
        (expected.to_vec(), vec!["urn:away".to_owned()])
    );
    let discovery = "a discovered server that is lost";
    wanted.present.clear();
    let (planned, missing) = plan(&wanted);
    assert_eq!((planned.len(), missing.len()), (1, 2), "{discovery}");
}

#[test]
fn the_number_of_servers_is_limited() {
    let mut wanted = wanted("  - discovered\n");
    for port in 1..=MOST_SERVERS + 5 {
        let url = format!("opc.tcp://127.0.0.1:{port}/");
        wanted.present.extend([present(&url, &url, None)]);
    }
    let (planned, missing) = plan(&wanted);
    assert_eq!(planned.len(), MOST_SERVERS);
    assert_eq!(missing, ["discovered"]);
}

#[test]
fn an_entry_with_other_settings_is_another_search() {
    let one = |text: &str| wanted(&format!("  - {{server: 'opc.tcp://h:1', {text}}}\n")).entries;
    let usual = one("depth: 32");
    let is_same = |text: &str| {
        let other = one(text);
        usual[0].is_same(&other[0])
    };
    assert!(is_same("nodes: 20000"));
    for text in ["depth: 31", "nodes: 5", "every: 5 s", "start: [i=2253]"] {
        assert!(!is_same(text), "{text}");
    }
    assert_eq!(usual[0].every, Duration::from_secs(600));
}

#[test]
fn another_user_of_the_mes_is_another_search_of_the_servers_without_a_user() {
    let one = |user: &str| {
        let own = "{server: 'opc.tcp://h:2', user: {name: own, password: '${PATH}'}}";
        wanted(&format!("  - opc.tcp://h:1\n  - {own}\n{user}")).entries
    };
    let of = |name: &str| format!("user: {{name: {name}, password: '${{PATH}}'}}\n");
    let (anonymous, anna, ben) = (one(""), one(&of("anna")), one(&of("ben")));
    let user = |entries: &[ServerEntry], at: usize| {
        let user = entries[at].user.as_ref();
        user.map(|user| user.name.clone())
    };
    assert_eq!(
        (user(&anonymous, 0), user(&anna, 0)),
        (None, Some("anna".to_owned()))
    );
    assert!(!anna[0].is_same(&ben[0]) && !anna[0].is_same(&anonymous[0]));
    assert!(anna[1].is_same(&ben[1]) && anna[1].is_same(&anonymous[1]));
}

#[tokio::test]
async fn an_application_uri_has_one_server_until_its_graph_is_removed() {
    let uris = ServerUris::default();
    let taken = uris.take("urn:a", "left", false).unwrap();
    assert_eq!(uris.take("urn:a", "right", false).unwrap_err(), "left");
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let graph = graph::ServerGraph::new(Arc::clone(&knowledge), taken);
    let space = || knowledge::ServedSpace {
        application_uri: "urn:a".to_owned(),
        browsed: "2026-11-27T10:00:00Z".to_owned(),
        ..knowledge::ServedSpace::default()
    };
    assert!(graph.write(space(), BTreeSet::new()).await.unwrap() > 0);
    let is_there = || {
        let mut sources = knowledge.sources().into_iter();
        sources.any(|source| source.kind == SourceKind::Server)
    };
    assert!(is_there());
    drop(graph);
    uris.free("urn:a", true).await;
    assert!(!is_there());
    uris.take("urn:a", "right", true).unwrap();
}

#[tokio::test]
async fn an_entry_takes_the_application_uri_from_a_discovered_server() {
    let uris = ServerUris::default();
    let found = uris.take("urn:a", "found", true).unwrap();
    let claim = uris.claim("urn:a", "entry");
    uris.claimed("urn:a").await;
    assert_eq!(uris.take("urn:a", "entry", false).unwrap_err(), "found");
    drop(found);
    assert_eq!(uris.take("urn:a", "found", true).unwrap_err(), "entry");
    uris.free("urn:a", false).await;
    let entry = uris.take("urn:a", "entry", false).unwrap();
    assert_eq!(uris.all(), ["urn:a"]);
    drop((claim, entry));
    uris.free("urn:a", true).await;
    uris.take("urn:a", "found", true).unwrap();
}

#[test]
fn all_servers_share_a_number_of_nodes_and_state_no_types_of_others() {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let sources = Arc::new(MesSources::new(Arc::clone(&knowledge)));
    let servers = LiveServers::new(knowledge, sources, ClientOptions::default(), "urn:mes");
    let board = &servers.board;
    board.status("a", |status| status.nodes = 150_000);
    assert_eq!(board.reserve("b", 40_000), 40_000);
    assert_eq!(board.reserve("c", 40_000), 10_000, "b is being read");
    assert_eq!(board.reserve("d", 40_000), 0);
    assert_eq!(board.reserve("a", 100_000), 100_000, "its own do not count");

    let _other = board.uris.take("urn:other", "a", false).unwrap();
    let _own = board.uris.take("urn:own", "b", false).unwrap();
    let left_out = board.left_out("urn:own");
    assert!(left_out.contains("urn:other") && !left_out.contains("urn:own"));

    let nodesets = board.nodesets.subscribe();
    board.compare_nodesets();
    assert!(!nodesets.has_changed().unwrap());
    let source = KnowledgeSource::new(SourceKind::NodeSet, "urn:maker");
    board
        .knowledge
        .replace_ontology(&source, Vec::new(), 1)
        .unwrap();
    board.compare_nodesets();
    assert!(nodesets.has_changed().unwrap());
}
