//! Queries over HTTP, and the isolation of concurrent queries.
#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    reason = "a test may"
)]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use knowledge::{HttpEndpoint, Knowledge, KnowledgeSource, QueryLimits, SourceKind};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

/// Returns a store in which no join of three patterns ends.
async fn site(limits: QueryLimits) -> (HttpEndpoint, Arc<Knowledge>) {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let many: String = (0..300)
        .map(|number| format!("<urn:s{number}> <urn:p> {number} .\n"))
        .collect();
    knowledge
        .replace_turtle(&KnowledgeSource::new(SourceKind::File, "many"), &many, 5)
        .unwrap();
    let page = Arc::new(|path: &str| (path == "/status").then(|| "{\"run\":null}".to_owned()));
    let endpoint = HttpEndpoint::bind(
        "127.0.0.1:0".parse().unwrap(),
        Arc::clone(&knowledge),
        limits,
        page,
    )
    .await
    .unwrap();
    (endpoint, knowledge)
}

pub(super) struct Answered {
    pub(super) status: u16,
    pub(super) head: String,
    pub(super) body: String,
}

impl Answered {
    pub(super) fn json(&self) -> serde_json::Value {
        serde_json::from_str(&self.body).unwrap_or_else(|_| panic!("{}", self.body))
    }

    pub(super) fn code(&self) -> (u16, String) {
        (
            self.status,
            self.json()["error"].as_str().unwrap_or_default().to_owned(),
        )
    }
}

pub(super) async fn send(at: SocketAddr, request: String) -> Answered {
    let mut stream = TcpStream::connect(at).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut bytes = Vec::new();
    tokio::time::timeout(Duration::from_secs(60), stream.read_to_end(&mut bytes))
        .await
        .unwrap()
        .unwrap();
    let text = String::from_utf8(bytes).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap_or((&text, ""));
    let status = head
        .split(' ')
        .nth(1)
        .and_then(|status| status.parse().ok())
        .unwrap_or(0);
    Answered {
        status,
        head: head.to_lowercase(),
        body: body.to_owned(),
    }
}

pub(super) async fn get(at: SocketAddr, path: &str, accept: &str) -> Answered {
    send(
        at,
        format!(
            "GET {path} HTTP/1.1\r\nHost: {at}\r\nAccept: {accept}\r\nConnection: close\r\n\r\n"
        ),
    )
    .await
}

async fn post(at: SocketAddr, media: &str, body: &str) -> Answered {
    let length = body.len();
    send(at, format!("POST /sparql HTTP/1.1\r\nHost: localhost:{}\r\nContent-Type: {media}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n{body}", at.port())).await
}

async fn query(at: SocketAddr, sparql: &str) -> Answered {
    post(at, "application/sparql-query", sparql).await
}

/// Reads statements for longer than any time limit, and keeps none of them.
const ENDLESS: &str = "SELECT (COUNT(*) AS ?n) { ?a ?p ?b . ?c ?p ?d . ?e ?p ?f . ?g ?p ?h }";
const COUNT: &str = "SELECT (COUNT(*) AS ?n) { ?s ?p ?o }";

fn count(answer: &Answered) -> String {
    answer.json()["results"]["bindings"][0]["n"]["value"]
        .as_str()
        .unwrap_or_default()
        .to_owned()
}

#[tokio::test]
async fn a_query_that_never_ends_is_stopped_while_others_are_answered() {
    let limits = QueryLimits {
        time: Duration::from_millis(1500),
        parallel: 2,
        memory: u64::MAX,
        ..QueryLimits::default()
    };
    let (endpoint, _) = site(limits).await;
    let at = endpoint.address();
    let endless = tokio::spawn(async move { query(at, ENDLESS).await });
    // Both slots are in use at times, so some queries are refused as busy; all others are answered.
    let mut answered = 0;
    while !endless.is_finished() {
        let other = query(at, COUNT).await;
        if other.status == 200 {
            assert_eq!(count(&other), "300");
            answered += 1;
        }
    }
    let stopped = endless.await.unwrap();
    assert_eq!(stopped.code(), (503, "time_limit".to_owned()));
    assert!(stopped.body.contains("1.5 s"), "{}", stopped.body);
    assert!(answered > 0);
    // Its slot is free again: as many queries as there are slots can run.
    free(at).await;
}

/// Waits until two concurrent queries are answered.
async fn free(at: SocketAddr) {
    let deadline = tokio::time::Instant::now() + Duration::from_secs(10);
    loop {
        let both = tokio::join!(query(at, COUNT), query(at, COUNT));
        if (both.0.status, both.1.status) == (200, 200) {
            return;
        }
        assert!(
            tokio::time::Instant::now() < deadline,
            "the thread of a stopped query did not end"
        );
    }
}

#[tokio::test]
async fn one_long_query_more_than_there_are_places_is_told_to_come_again() {
    let limits = QueryLimits {
        time: Duration::from_secs(20),
        parallel: 1,
        memory: u64::MAX,
        ..QueryLimits::default()
    };
    let (endpoint, _) = site(limits).await;
    let at = endpoint.address();
    let endless = |name: &str| ENDLESS.replace("?n", &format!("?{name}"));
    let (first, second) = (endless("first"), endless("second"));
    let mut first = tokio::spawn(async move { query(at, &first).await });
    let mut second = tokio::spawn(async move { query(at, &second).await });
    let (refused, other) = tokio::select! {
        refused = &mut first => (refused.unwrap(), second),
        refused = &mut second => (refused.unwrap(), first),
    };
    assert_eq!(refused.code(), (503, "busy".to_owned()));
    assert!(refused.head.contains("retry-after: 1"), "{}", refused.head);
    // Short queries and named questions do not need the place of the other.
    assert_eq!(query(at, COUNT).await.status, 200);
    assert_eq!(get(at, "/ask/sources", "*/*").await.status, 200);
    other.abort();
}

#[tokio::test]
async fn named_questions_are_answered_beside_many_clients_with_long_queries() {
    let limits = QueryLimits {
        time: Duration::from_secs(2),
        memory: u64::MAX,
        ..QueryLimits::default()
    };
    let (endpoint, _) = site(limits).await;
    let at = endpoint.address();
    let bad: Vec<_> = (0..50)
        .map(|client| {
            let text = ENDLESS.replace("?n", &format!("?n{client}"));
            tokio::spawn(async move {
                loop {
                    assert_eq!(query(at, &text).await.status, 503);
                }
            })
        })
        .collect();
    for _ in 0..50 {
        let answer = get(at, "/ask/sources", "*/*").await;
        assert_eq!(answer.status, 200, "{}", answer.body);
    }
    for client in bad {
        assert!(!client.is_finished(), "a long query was answered");
        client.abort();
    }
    free(at).await;
}

#[tokio::test]
async fn a_third_plan_is_told_to_come_again_while_the_status_is_answered() {
    let (made, wait) = std::sync::mpsc::channel::<()>();
    let wait = std::sync::Mutex::new(wait);
    // A plan takes until the test ends it.
    let page = Arc::new(move |path: &str| {
        if path != "/status" {
            wait.lock().unwrap().recv().unwrap();
        }
        Some("{}".to_owned())
    });
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let at = "127.0.0.1:0".parse().unwrap();
    let endpoint = HttpEndpoint::bind(at, knowledge, QueryLimits::default(), page);
    let endpoint = endpoint.await.unwrap();
    let at = endpoint.address();
    let plan = || tokio::spawn(async move { get(at, "/plan/urn:p", "*/*").await.status });
    let plans = [plan(), plan(), plan()];
    let refused = async {
        while !plans.iter().any(tokio::task::JoinHandle::is_finished) {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    let refused = tokio::time::timeout(Duration::from_secs(20), refused).await;
    assert!(refused.is_ok(), "all wait");
    assert_eq!(get(at, "/status", "*/*").await.status, 200);
    for _ in 0..2 {
        made.send(()).unwrap();
    }
    let mut statuses = Vec::new();
    for plan in plans {
        statuses.push(plan.await.unwrap());
    }
    statuses.sort_unstable();
    assert_eq!(statuses, [200, 200, 503]);
}

#[tokio::test]
async fn queries_come_by_get_by_post_and_as_a_form() {
    let (endpoint, _) = site(QueryLimits::default()).await;
    let at = endpoint.address();
    let by_get = get(
        at,
        "/sparql?query=SELECT%20(COUNT(*)%20AS%20?n)%20%7B%20?s%20?p%20?o%20%7D",
        "*/*",
    )
    .await;
    assert!(
        by_get
            .head
            .contains("content-type: application/sparql-results+json"),
        "{}",
        by_get.head
    );
    let by_form = post(
        at,
        "application/x-www-form-urlencoded; charset=UTF-8",
        "query=SELECT+(COUNT(*)+AS+%3Fn)+%7B+%3Fs+%3Fp+%3Fo+%7D",
    )
    .await;
    for answer in [by_get, by_form, query(at, COUNT).await] {
        assert_eq!((answer.status, count(&answer)), (200, "300".to_owned()));
    }
    assert_eq!(
        query(at, "ASK { <urn:s1> <urn:p> 1 }").await.json()["boolean"],
        true
    );
    let made = query(
        at,
        "CONSTRUCT { ?s <urn:q> ?o } WHERE { ?s <urn:p> ?o FILTER(?o < 2) } ORDER BY ?o",
    )
    .await;
    assert!(
        made.body
            .contains("<urn:s1> <urn:q> \"1\"^^<http://www.w3.org/2001/XMLSchema#integer> ."),
        "{}",
        made.body
    );
    let csv = get(
        at,
        "/sparql?query=SELECT+?o+%7B+%3Curn:s7%3E+?p+?o%7D",
        "text/csv",
    )
    .await;
    assert_eq!(csv.body, "o\r\n7\r\n");
}

#[tokio::test]
async fn the_default_graph_is_the_merge_and_each_graph_has_its_name() {
    let (endpoint, knowledge) = site(QueryLimits::default()).await;
    let at = endpoint.address();
    knowledge
        .replace_turtle(
            &KnowledgeSource::new(SourceKind::File, "same"),
            "<urn:s1> <urn:p> 1 .",
            5,
        )
        .unwrap();
    assert_eq!(
        count(&query(at, COUNT).await),
        "300",
        "said twice, there once"
    );
    assert_eq!(
        count(&query(at, "SELECT (COUNT(*) AS ?n) { GRAPH ?g { ?s ?p ?o } }").await),
        "301"
    );
    let one = get(at, "/sparql?default-graph-uri=urn:ua-bridge:graph:file:same&query=SELECT+(COUNT(*)+AS+?n)+%7B+?s+?p+?o+%7D", "*/*").await;
    assert_eq!(count(&one), "1");
    let quads = get(at, "/data?graph=urn:ua-bridge:graph:file:same", "*/*").await;
    assert_eq!(
        quads.body.trim(),
        "<urn:s1> <urn:p> \"1\"^^<http://www.w3.org/2001/XMLSchema#integer> <urn:ua-bridge:graph:file:same> ."
    );
    assert_eq!(get(at, "/data", "*/*").await.body.lines().count(), 301);
    assert_eq!(
        get(at, "/data?graph=urn:nothing", "*/*").await.code(),
        (404, "unknown".to_owned())
    );
}

#[tokio::test]
async fn nothing_changes_what_is_known_and_nobody_else_is_asked() {
    let (endpoint, _) = site(QueryLimits::default()).await;
    let at = endpoint.address();
    for update in [
        "INSERT DATA { <urn:a> <urn:b> <urn:c> }",
        "LOAD <http://127.0.0.1/x>",
        "DELETE WHERE { ?s ?p ?o }",
        "DROP ALL",
    ] {
        assert_eq!(
            query(at, update).await.code(),
            (400, "not_a_query".to_owned()),
            "{update}"
        );
        assert_eq!(
            post(at, "application/sparql-update", update).await.code(),
            (403, "read_only".to_owned())
        );
    }
    assert_eq!(
        post(at, "application/x-www-form-urlencoded", "update=DROP+ALL")
            .await
            .code(),
        (400, "not_a_query".to_owned())
    );
    for service in [
        "SELECT * { SERVICE <http://127.0.0.1:1/> { ?s ?p ?o } }",
        "SELECT * { SERVICE SILENT <http://127.0.0.1:1/> { ?s ?p ?o } }",
        "SELECT * { ?s ?p ?o FILTER EXISTS { SERVICE ?s { ?a ?b ?c } } }",
    ] {
        assert_eq!(
            query(at, service).await.code(),
            (400, "service".to_owned()),
            "{service}"
        );
    }
    assert_eq!(count(&query(at, COUNT).await), "300");
}

#[tokio::test]
async fn what_is_wrong_with_a_request_is_told() {
    let limits = QueryLimits {
        rows: 100,
        ..QueryLimits::default()
    };
    let (endpoint, _) = site(limits).await;
    let at = endpoint.address();
    let malformed = query(at, "SELECT ?s WHERE { ?s ?p }").await;
    assert_eq!(malformed.code(), (400, "malformed".to_owned()));
    assert!(
        malformed.body.contains("1:"),
        "the place is told: {}",
        malformed.body
    );
    assert_eq!(
        get(at, "/sparql", "*/*").await.code(),
        (400, "malformed".to_owned())
    );
    assert_eq!(
        get(at, "/sparql?query=%zz", "*/*").await.code(),
        (400, "malformed".to_owned())
    );
    assert_eq!(
        post(at, "text/plain", COUNT).await.code(),
        (415, "media_type".to_owned())
    );
    assert_eq!(
        query(at, "SELECT * { ?s ?p ?o }").await.code(),
        (507, "result_limit".to_owned())
    );
    assert_eq!(
        query(at, "CONSTRUCT WHERE { ?s ?p ?o }").await.code(),
        (507, "result_limit".to_owned())
    );
    assert_eq!(
        query(at, &format!("{COUNT}{}", " ".repeat(70_000)))
            .await
            .code(),
        (413, "too_large".to_owned())
    );
    assert_eq!(
        get(at, "/sparql?query=ASK%7B%7D", "image/png").await.code(),
        (406, "not_acceptable".to_owned())
    );
    let deleted = send(
        at,
        format!("DELETE /sparql HTTP/1.1\r\nHost: {at}\r\nConnection: close\r\n\r\n"),
    )
    .await;
    assert_eq!(deleted.code(), (405, "method".to_owned()));
    assert!(
        deleted.head.contains("allow: get, post"),
        "{}",
        deleted.head
    );
    let elsewhere = send(
        at,
        "GET /ask HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n".to_owned(),
    )
    .await;
    assert_eq!(elsewhere.code(), (421, "host".to_owned()));
    assert_eq!(get(at, "/status", "*/*").await.body, "{\"run\":null}");
    assert_eq!(
        get(at, "/nothing", "*/*").await.code(),
        (404, "unknown".to_owned())
    );
    assert_eq!(
        get(at, "/ask/nothing", "*/*").await.code(),
        (404, "unknown".to_owned())
    );
    assert_eq!(
        get(at, "/ask/sources?x=y", "*/*").await.code(),
        (400, "malformed".to_owned())
    );
}

#[tokio::test]
async fn named_questions_are_listed_shown_and_answered_in_two_forms() {
    let (endpoint, _) = site(QueryLimits::default()).await;
    let at = endpoint.address();
    let listed = get(at, "/ask", "*/*").await.json();
    let names: Vec<_> = listed["questions"]
        .as_array()
        .unwrap()
        .iter()
        .map(|question| question["name"].as_str().unwrap())
        .collect();
    assert!(names.contains(&"what-can-run"), "{names:?}");
    assert!(
        get(at, "/ask/sources.rq", "*/*")
            .await
            .body
            .contains("GROUP BY ?graph")
    );
    let plain = get(at, "/ask/sources", "application/json").await.json();
    assert_eq!(
        plain,
        serde_json::json!({ "question": "sources", "columns": ["graph", "kind", "statements"], "rows": [{ "graph": "urn:ua-bridge:graph:file:many", "kind": "file", "statements": 300 }] })
    );
    let both = "application/json, application/sparql-results+json;q=0.5, */*;q=0.1";
    assert_eq!(get(at, "/ask/sources", both).await.json(), plain);
    let standard = get(at, "/ask/sources", "application/sparql-results+json")
        .await
        .json();
    assert_eq!(standard["results"]["bindings"][0]["kind"]["value"], "file");
}

/// Nested, repeated and growing queries of the maximum length: each gets a response, and the
/// program continues.
#[tokio::test]
async fn monstrous_queries_of_full_length_are_refused() {
    let limits = QueryLimits {
        time: Duration::from_secs(2),
        memory: 256 << 20,
        parallel: 16,
        ..QueryLimits::default()
    };
    let (endpoint, _) = site(limits).await;
    let at = endpoint.address();
    let values = |name: &str| format!("VALUES ?{name} {{ {} }}", "1 ".repeat(400));
    let grown: String = (0..40)
        .map(|step| format!("BIND(CONCAT(?a{step}, ?a{step}) AS ?a{}) ", step + 1))
        .collect();
    let refused = [
        format!("SELECT * {{ ?s ?p ?o FILTER(1{} = 2) }}", "+1".repeat(8000)),
        format!("SELECT * {{ {{}}{} }}", " UNION {}".repeat(1750)),
        format!("SELECT * {{ ?s <urn:p>{} ?o }}", "/<urn:p>".repeat(2000)),
        format!("SELECT * {{ ?s <urn:p>{} ?o }}", "|<urn:p>".repeat(2000)),
        format!("SELECT * {{ {} }}", "?s ?p ?o. ".repeat(1450)),
        format!(
            "SELECT * {{ ?s ?p ?o {} }}",
            "OPTIONAL{?s ?p ?o}".repeat(880)
        ),
        format!(
            "SELECT * {{ ?s ?p ?o FILTER(true{}) }}",
            "&&?o>1".repeat(2600)
        ),
        format!(
            "SELECT * {{ ?s ?p ?o FILTER({}1{}) }}",
            "(".repeat(8000),
            ")".repeat(8000)
        ),
        format!(
            "SELECT (COUNT(*) AS ?n) {{ {} {} {} {} }}",
            values("a"),
            values("b"),
            values("c"),
            values("d")
        ),
        format!("SELECT (STRLEN(?a40) AS ?n) {{ BIND(\"xxxxxxxxxxxxxxxx\" AS ?a0) {grown} }}"),
    ];
    for query_text in &refused {
        let answer = query(at, query_text).await;
        assert_eq!(
            answer.code(),
            (400, "too_complex".to_owned()),
            "{}",
            &query_text[..80]
        );
    }
    // Queries of the largest accepted size.
    let large = [
        format!("SELECT * {{ ?s ?p ?o FILTER(1{} = 2) }}", "+1".repeat(400)),
        format!(
            "SELECT * {{ ?s ?p ?o {} }}",
            "OPTIONAL{?s ?p ?o}".repeat(90)
        ),
        format!("ASK {{ {} }}", "?s ?p ?o. ".repeat(250)),
    ];
    for query_text in &large {
        let answer = query(at, query_text).await;
        assert!(
            [200, 503, 507].contains(&answer.status),
            "{}: {} {}",
            &query_text[..40],
            answer.status,
            answer.body
        );
    }
    assert_eq!(count(&query(at, COUNT).await), "300");
}

#[tokio::test]
async fn it_listens_on_loopback_only() {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let anywhere = HttpEndpoint::bind(
        "0.0.0.0:0".parse().unwrap(),
        knowledge,
        QueryLimits::default(),
        Arc::new(|_: &str| None),
    )
    .await;
    assert!(anywhere.unwrap_err().to_string().contains("loopback"));
}
