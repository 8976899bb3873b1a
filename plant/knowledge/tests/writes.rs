//! Changes over HTTP: updates, the Graph Store Protocol, and the users that may make them.
#![expect(clippy::unwrap_used, reason = "a test may")]

use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use knowledge::{
    ConnectionSecurity, HttpEndpoint, JobRunner, Knowledge, KnowledgeSource, PasswordRefusal,
    Queries, QueryLimits, SecuredStream, SecuringConnection, SourceCheck, SourceFiles,
    SourceFinding, SourceKind, Writes,
};
use tokio::net::TcpStream;

use crate::http::{Answered, send};

/// Keeps the sources that it is given.
#[derive(Default)]
struct Files(Mutex<Vec<(SourceKind, String, usize)>>);

impl SourceFiles for Files {
    fn put(&self, kind: SourceKind, name: &str, contents: &[u8]) -> Result<bool, String> {
        if contents.is_empty() {
            return Err("line 7: it is empty".to_owned());
        }
        let mut all = self.0.lock().unwrap();
        all.push((kind, name.to_owned(), contents.len()));
        Ok(all.len() == 1)
    }

    fn check(&self, _kind: SourceKind, _name: &str, contents: &[u8]) -> SourceCheck {
        let faults = contents.is_empty().then(|| SourceFinding {
            line: Some(7),
            what: "line 7: it is empty".to_owned(),
            refused: true,
        });
        SourceCheck {
            accepted: !contents.is_empty(),
            replaces: false,
            findings: faults.into_iter().collect(),
        }
    }

    fn remove(&self, kind: SourceKind, name: &str) -> Result<bool, String> {
        let mut all = self.0.lock().unwrap();
        let before = all.len();
        all.retain(|known| (known.0, known.1.as_str()) != (kind, name));
        Ok(all.len() < before)
    }

    fn list(&self) -> serde_json::Value {
        serde_json::json!({ "sources": self.0.lock().unwrap().len() })
    }
}

/// Keeps the processes of the jobs; a job is its position from 1.
#[derive(Default)]
struct Started(Mutex<Vec<String>>);

impl JobRunner for Started {
    fn start(&self, process: &str) -> Result<Option<u64>, String> {
        if process != "urn:p" {
            return Err(format!("`{process}` is no process here"));
        }
        let mut all = self.0.lock().unwrap();
        if all.len() == 2 {
            return Ok(None);
        }
        all.push(process.to_owned());
        Ok(u64::try_from(all.len()).ok())
    }

    fn stop(&self, number: u64) -> bool {
        (1..=self.0.lock().unwrap().len()).any(|known| u64::try_from(known) == Ok(number))
    }

    fn list(&self) -> serde_json::Value {
        serde_json::json!({ "jobs": *self.0.lock().unwrap() })
    }
}

/// Returns handlers with two users: anna writes, otto runs jobs. `may` allows all.
pub(super) fn writes(may: bool) -> Writes {
    Writes {
        now: || 9,
        may_read: Arc::new(|user| {
            let is_known = user.is_some_and(|(name, _)| name == "anna" || name == "otto");
            Box::pin(async move { is_known })
        }),
        may: Arc::new(move |user| {
            let is_anna = user == Some(("anna".to_owned(), "secret: 1".to_owned()));
            Box::pin(async move { may || is_anna })
        }),
        may_run: Arc::new(move |user| {
            let is_otto = user.is_some_and(|(name, _)| name == "otto");
            Box::pin(async move { may || is_otto })
        }),
        files: Arc::new(Files::default()),
        jobs: Arc::new(Started::default()),
    }
}

async fn site(may: bool) -> (HttpEndpoint, Arc<Knowledge>) {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let turtle = "<urn:c:below> <http://www.w3.org/2000/01/rdf-schema#subClassOf> <urn:c:above> .";
    let source = KnowledgeSource::new(SourceKind::File, "classes");
    knowledge.replace_turtle(&source, turtle, 5).unwrap();
    let endpoint = HttpEndpoint::bind_with(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(Arc::clone(&knowledge), QueryLimits::default()),
        Arc::new(|_: &str| None),
        Some(writes(may)),
    )
    .await
    .unwrap();
    (endpoint, knowledge)
}

/// Secures nothing: the connections of a server with one name. It counts the refused passwords.
#[derive(Default)]
pub(super) struct Clear {
    pub(super) wrong: AtomicUsize,
    pub(super) too_many: AtomicUsize,
}

impl ConnectionSecurity for Clear {
    fn secure(&self, stream: TcpStream) -> SecuringConnection {
        Box::pin(async { Ok(Box::new(stream) as Box<dyn SecuredStream>) })
    }

    fn is_for(&self, host: &str) -> bool {
        host == "mes.example"
    }

    fn refused(&self, _client: IpAddr, refusal: PasswordRefusal) {
        let counter = match refusal {
            PasswordRefusal::Wrong => &self.wrong,
            PasswordRefusal::TooMany => &self.too_many,
        };
        counter.fetch_add(1, Ordering::Relaxed);
    }
}

#[tokio::test]
async fn each_request_of_another_host_has_a_user_and_names_the_server() {
    let knowledge = Arc::new(Knowledge::new().unwrap());
    let endpoint = HttpEndpoint::bind_secured(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(Arc::clone(&knowledge), QueryLimits::default()),
        Arc::new(|path: &str| (path == "/status").then(|| "{}".to_owned())),
        // Clients of this host may do all without a user, and nobody else may.
        (writes(true), Arc::new(Clear::default())),
    )
    .await
    .unwrap();
    let at = endpoint.address();
    let ask = async |host: &str, line: &str, headers: &[(&str, &str)]| {
        let mut text = format!("{line} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n");
        for (name, value) in headers {
            text.push_str(&format!("{name}: {value}\r\n"));
        }
        send(at, format!("{text}\r\n")).await.status
    };
    // base64 of `otto:x` and `eve:x`.
    let otto = ("Authorization", "Basic b3R0bzp4");
    let eve = ("Authorization", "Basic ZXZlOng=");
    let here = "mes.example:8443";
    for line in [
        "GET /status",
        "GET /ask/sources",
        "GET /sparql?query=ASK%7B%7D",
        "DELETE /store?default",
        "GET /jobs",
        "GET /nothing",
    ] {
        assert_eq!(ask(here, line, &[]).await, 401, "{line}");
        assert_eq!(ask(here, line, &[eve]).await, 401, "{line}");
        for other in ["127.0.0.1", "evil.example", ""] {
            assert_eq!(ask(other, line, &[otto]).await, 421, "{line}");
        }
    }
    for line in [
        "GET /status",
        "GET /ask/sources",
        "GET /sparql?query=ASK%7B%7D",
    ] {
        assert_eq!(ask(here, line, &[otto]).await, 200, "{line}");
    }
    for (origin, status) in [
        ("https://evil.example", 403),
        ("http://localhost", 403),
        ("https://mes.example:8443", 404),
    ] {
        let origin = ("Origin", origin);
        let removed = ask(here, "DELETE /store?graph=urn:none", &[otto, origin]).await;
        assert_eq!(removed, status, "{origin:?}");
    }
}

#[tokio::test]
async fn a_client_with_too_many_wrong_passwords_is_refused_before_the_check() {
    let checks = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&checks);
    let security = Arc::new(Clear::default());
    let users = Writes {
        may_read: Arc::new(move |user| {
            counted.fetch_add(1, Ordering::Relaxed);
            let is_otto = user.is_some_and(|(name, _)| name == "otto");
            Box::pin(async move { is_otto })
        }),
        ..writes(false)
    };
    let endpoint = HttpEndpoint::bind_secured(
        "127.0.0.1:0".parse().unwrap(),
        Queries::new(Arc::new(Knowledge::new().unwrap()), QueryLimits::default()),
        Arc::new(|_: &str| None),
        (users, Arc::clone(&security) as Arc<dyn ConnectionSecurity>),
    )
    .await
    .unwrap();
    let at = endpoint.address();
    let ask = async |user: &str| {
        let head = "GET /ask HTTP/1.1\r\nHost: mes.example\r\nConnection: close\r\n";
        let answered = send(at, format!("{head}Authorization: Basic {user}\r\n\r\n")).await;
        answered.status
    };
    // base64 of `otto:x` and `eve:x`.
    let (otto, eve) = ("b3R0bzp4", "ZXZlOng=");
    for _ in 0..30 {
        // A right password does not count.
        assert_eq!(ask(otto).await, 200);
    }
    let mut wrong = 0;
    while ask(eve).await == 401 {
        wrong += 1;
        assert!(wrong <= 20, "the number of wrong passwords is not limited");
    }
    assert_eq!(wrong, 20);
    let before = checks.load(Ordering::Relaxed);
    assert_eq!((ask(eve).await, ask(otto).await), (429, 429));
    assert_eq!(checks.load(Ordering::Relaxed), before);
    let counts = [&security.wrong, &security.too_many].map(|count| count.load(Ordering::Relaxed));
    assert_eq!(counts, [20, 3]);
}

/// Sends a request with headers and a body.
pub(super) async fn request(
    at: SocketAddr,
    line: &str,
    headers: &[(&str, &str)],
    body: &str,
) -> Answered {
    let mut text = format!("{line} HTTP/1.1\r\nHost: {at}\r\nConnection: close\r\n");
    for (name, value) in headers {
        text.push_str(&format!("{name}: {value}\r\n"));
    }
    let length = body.len();
    send(at, format!("{text}Content-Length: {length}\r\n\r\n{body}")).await
}

const UPDATE: (&str, &str) = ("Content-Type", "application/sparql-update");
const TURTLE: (&str, &str) = ("Content-Type", "text/turtle");

async fn update(at: SocketAddr, text: &str) -> Answered {
    request(at, "POST /update", &[UPDATE], text).await
}

/// Returns the rows of a query as CSV, sorted.
async fn rows(at: SocketAddr, query: &str) -> Vec<String> {
    let headers = [
        ("Content-Type", "application/sparql-query"),
        ("Accept", "text/csv"),
    ];
    let answer = request(at, "POST /sparql", &headers, query).await;
    assert_eq!(answer.status, 200, "{}", answer.body);
    let mut rows: Vec<String> = answer.body.lines().skip(1).map(str::to_owned).collect();
    rows.sort_unstable();
    rows
}

#[tokio::test]
async fn updates_change_graphs_of_users() {
    let (endpoint, _) = site(true).await;
    let at = endpoint.address();
    let named = "SELECT ?g ?s ?o { GRAPH ?g { ?s <urn:p> ?o } }";
    let done = update(
        at,
        "INSERT DATA { <urn:a> <urn:p> 1 . GRAPH <urn:g> { <urn:b> <urn:p> 2 , 02 } }",
    )
    .await;
    assert_eq!((done.status, done.body.trim()), (200, r#"{"changed":2}"#));
    let expected = ["urn:g,urn:b,2", "urn:ua-bridge:graph:unnamed,urn:a,1"];
    assert_eq!(rows(at, named).await, expected);
    // Several operations see each other, and are one change.
    let modify = "DELETE { GRAPH <urn:g> { ?s <urn:p> ?o } } INSERT { GRAPH <urn:h> { ?s <urn:p> ?more . ?s <urn:q> [] } }
        WHERE { GRAPH <urn:g> { ?s <urn:p> ?o } BIND(?o + 1 AS ?more) } ;
        INSERT { ?s <urn:p> \"seen\" } WHERE { GRAPH <urn:h> { ?s <urn:p> 3 } }";
    assert_eq!(update(at, modify).await.status, 200);
    let expected = [
        "urn:h,urn:b,3",
        "urn:ua-bridge:graph:unnamed,urn:a,1",
        "urn:ua-bridge:graph:unnamed,urn:b,seen",
    ];
    assert_eq!(rows(at, named).await, expected);
    // The merge of all graphs follows.
    assert_eq!(rows(at, "SELECT ?s ?o { ?s <urn:p> ?o }").await.len(), 3);
    // The form of the protocol, and a deletion.
    let form = ("Content-Type", "application/x-www-form-urlencoded");
    let text = "update=DELETE+DATA+%7B+%3Curn%3Aa%3E+%3Curn%3Ap%3E+1+%7D";
    let done = request(at, "POST /update", &[form], text).await;
    assert_eq!(done.status, 200, "{}", done.body);
    assert_eq!(update(at, "DROP GRAPH <urn:h>").await.status, 200);
    let expected = ["urn:ua-bridge:graph:unnamed,urn:b,seen"];
    assert_eq!(rows(at, named).await, expected);
    // Classes that users add have their superclasses, and lose them again.
    let sub = "<http://www.w3.org/2000/01/rdf-schema#subClassOf>";
    let data = format!("{{ <urn:c:new> {sub} <urn:c:below> }}");
    let above = format!("SELECT ?above {{ <urn:c:new> {sub} ?above }}");
    assert_eq!(update(at, &format!("INSERT DATA {data}")).await.status, 200);
    let expected = ["urn:c:above", "urn:c:below", "urn:c:new"];
    assert_eq!(rows(at, &above).await, expected);
    assert_eq!(update(at, &format!("DELETE DATA {data}")).await.status, 200);
    assert!(rows(at, &above).await.is_empty());
    assert_eq!(update(at, "CLEAR ALL").await.status, 200);
    assert!(rows(at, named).await.is_empty());
    assert!(
        !rows(at, &format!("SELECT ?s {{ ?s {sub} ?o }}"))
            .await
            .is_empty()
    );
}

#[tokio::test]
async fn an_update_changes_all_or_nothing_and_no_graph_of_a_source() {
    let (endpoint, _) = site(true).await;
    let at = endpoint.address();
    let source = "urn:ua-bridge:graph:file:classes";
    for (text, status, code) in [
        (
            format!("INSERT DATA {{ <urn:a> <urn:p> 1 }} ; CLEAR GRAPH <{source}>"),
            403,
            "protected",
        ),
        (
            format!("DELETE WHERE {{ GRAPH <{source}> {{ ?s ?p ?o }} }}"),
            403,
            "protected",
        ),
        (
            "INSERT { GRAPH ?g { ?s ?p ?o } } WHERE { GRAPH ?g { ?s ?p ?o } }".to_owned(),
            403,
            "protected",
        ),
        ("LOAD <http://127.0.0.1/x>".to_owned(), 400, "service"),
        (
            "INSERT { ?s ?p ?o } WHERE { SERVICE <urn:x> { ?s ?p ?o } }".to_owned(),
            400,
            "service",
        ),
        (
            "INSERT DATA { <urn:a> <urn:p> }".to_owned(),
            400,
            "malformed",
        ),
    ] {
        let refused = update(at, &text).await;
        assert_eq!(refused.status, status, "{text}: {}", refused.body);
        assert!(refused.body.contains(code), "{text}: {}", refused.body);
    }
    assert!(rows(at, "SELECT ?s { ?s <urn:p> ?o }").await.is_empty());
    let graph = format!("SELECT ?s {{ GRAPH <{source}> {{ ?s ?p ?o }} }}");
    assert_eq!(rows(at, &graph).await, ["urn:c:below"]);
}

#[tokio::test]
async fn a_graph_is_put_posted_read_and_deleted() {
    let (endpoint, _) = site(true).await;
    let at = endpoint.address();
    let path = "/store?graph=urn%3Ag";
    let of = |verb: &str| format!("{verb} {path}");
    let document = "<urn:a> <urn:p> 1 .";
    assert_eq!(request(at, &of("GET"), &[], "").await.status, 404);
    let put = request(at, &of("PUT"), &[TURTLE], document).await;
    assert_eq!(put.status, 201, "{}", put.body);
    let post = request(at, &of("POST"), &[TURTLE], "<urn:b> <urn:p> 2 .").await;
    assert_eq!(post.status, 204);
    let accept = ("Accept", "application/n-triples");
    let read = request(at, &of("GET"), &[accept], "").await;
    let mut lines: Vec<&str> = read.body.lines().collect();
    lines.sort_unstable();
    let integer = "\"^^<http://www.w3.org/2001/XMLSchema#integer> .";
    let expected = [
        format!("<urn:a> <urn:p> \"1{integer}"),
        format!("<urn:b> <urn:p> \"2{integer}"),
    ];
    assert_eq!(lines, expected);
    assert_eq!(
        request(at, &of("PUT"), &[TURTLE], document).await.status,
        204
    );
    assert_eq!(rows(at, "SELECT ?s { ?s <urn:p> ?o }").await, ["urn:a"]);
    let wrong = request(at, &of("PUT"), &[TURTLE], "<urn:a>\n<urn:p> .\n").await;
    assert_eq!(wrong.status, 400);
    assert!(wrong.body.contains("line 2"), "{}", wrong.body);
    let html = ("Content-Type", "text/html");
    assert_eq!(request(at, &of("PUT"), &[html], "").await.status, 415);
    assert_eq!(request(at, &of("DELETE"), &[], "").await.status, 204);
    assert_eq!(request(at, &of("DELETE"), &[], "").await.status, 404);
    let unnamed = request(at, "PUT /store?default", &[TURTLE], document).await;
    assert_eq!(unnamed.status, 201);
    let source = "PUT /store?graph=urn%3Aua-bridge%3Agraph%3Afile%3Aclasses";
    assert_eq!(request(at, source, &[TURTLE], document).await.status, 403);
    assert_eq!(
        request(at, "PUT /store", &[TURTLE], document).await.status,
        400
    );
}

#[tokio::test]
async fn sources_are_handed_to_their_readers() {
    let (endpoint, _) = site(true).await;
    let at = endpoint.address();
    let put = async |path: &str, body: &str| request(at, &format!("PUT {path}"), &[], body).await;
    assert_eq!(put("/sources/mtp/a%20module", "x").await.status, 201);
    assert_eq!(put("/sources/mtp/a%20module", "xy").await.status, 204);
    let wrong = put("/sources/nodeset/x", "").await;
    assert_eq!(wrong.status, 400);
    assert!(wrong.body.contains("line 7"), "{}", wrong.body);
    for path in ["/sources/run/x", "/sources/mtp/", "/sources/x"] {
        assert_eq!(put(path, "x").await.status, 404, "{path}");
    }
    let listed = request(at, "GET /sources", &[], "").await;
    assert_eq!(listed.body.trim(), r#"{"sources":2}"#);
    let remove = "DELETE /sources/mtp/a%20module";
    assert_eq!(request(at, remove, &[], "").await.status, 204);
    assert_eq!(request(at, remove, &[], "").await.status, 404);
}

#[tokio::test]
async fn a_check_of_a_source_adds_nothing() {
    let (endpoint, _) = site(true).await;
    let at = endpoint.address();
    let check = async |body: &str| request(at, "POST /check/mtp/a%20module", &[], body).await;
    let good = check("x").await;
    assert_eq!(good.status, 200);
    assert!(good.body.contains(r#""accepted":true"#), "{}", good.body);
    let bad = check("").await;
    assert_eq!(bad.status, 200);
    assert!(bad.body.contains(r#""line":7"#), "{}", bad.body);
    let listed = request(at, "GET /sources", &[], "").await;
    assert_eq!(listed.body.trim(), r#"{"sources":0}"#);
    assert_eq!(request(at, "GET /check/mtp/x", &[], "").await.status, 405);
    assert_eq!(request(at, "POST /check/run/x", &[], "").await.status, 404);
}

#[tokio::test]
async fn only_users_with_the_role_write_and_no_page_of_another_site() {
    let (endpoint, knowledge) = site(false).await;
    let at = endpoint.address();
    let text = "INSERT DATA { <urn:a> <urn:p> 1 }";
    // base64 of `anna:secret: 1`, and of `anna:wrong`.
    let anna = ("Authorization", "Basic YW5uYTpzZWNyZXQ6IDE=");
    let wrong = ("Authorization", "Basic YW5uYTp3cm9uZw==");
    let before = *knowledge.changes().borrow();
    for headers in [
        &[UPDATE][..],
        &[UPDATE, wrong],
        &[UPDATE, ("Authorization", "Basic %")],
    ] {
        let refused = request(at, "POST /update", headers, text).await;
        assert_eq!(refused.status, 401, "{}", refused.body);
    }
    for line in [
        "PUT /store?default",
        "DELETE /store?default",
        "PUT /sources/mtp/x",
        "DELETE /sources/mtp/x",
        "POST /check/mtp/x",
    ] {
        assert_eq!(request(at, line, &[], "x").await.status, 401, "{line}");
    }
    let elsewhere = ("Origin", "http://evil.example");
    let refused = request(at, "POST /update", &[UPDATE, anna, elsewhere], text).await;
    assert_eq!(refused.status, 403, "{}", refused.body);
    assert_eq!(*knowledge.changes().borrow(), before);
    let own = ("Origin", "http://localhost:3000");
    let done = request(at, "POST /update", &[UPDATE, anna, own], text).await;
    assert_eq!(done.status, 200, "{}", done.body);
    assert_eq!(*knowledge.changes().borrow(), before + 1);
    // Queries need no user.
    assert_eq!(rows(at, "SELECT ?s { ?s <urn:p> ?o }").await, ["urn:a"]);
}

#[tokio::test]
async fn jobs_are_started_listed_and_stopped_by_operators() {
    let (endpoint, _) = site(false).await;
    let at = endpoint.address();
    // otto:x
    let otto = ("Authorization", "Basic b3R0bzp4");
    let job = r#"{"process": "urn:p"}"#;
    let refused = request(at, "POST /jobs", &[], job).await;
    assert_eq!(refused.status, 401, "{}", refused.body);
    let anna = ("Authorization", "Basic YW5uYTpzZWNyZXQ6IDE=");
    assert_eq!(request(at, "POST /jobs", &[anna], job).await.status, 401);
    let evil = ("Origin", "https://evil.example");
    assert_eq!(
        request(at, "POST /jobs", &[otto, evil], job).await.status,
        403
    );
    let started = request(at, "POST /jobs", &[otto], job).await;
    assert_eq!((started.status, started.body.trim()), (201, r#"{"job":1}"#));
    let unknown = request(at, "POST /jobs", &[otto], r#"{"process": "urn:q"}"#).await;
    assert_eq!(unknown.status, 404);
    assert!(
        unknown.body.contains("`urn:q` is no process here"),
        "{}",
        unknown.body
    );
    for body in ["", "urn:p", r#"{"process": 7}"#] {
        assert_eq!(request(at, "POST /jobs", &[otto], body).await.status, 400);
    }
    let listed = request(at, "GET /jobs", &[], "").await;
    assert_eq!(
        (listed.status, listed.body.trim()),
        (200, r#"{"jobs":["urn:p"]}"#)
    );
    assert_eq!(request(at, "DELETE /jobs/1", &[otto], "").await.status, 204);
    for path in ["/jobs/2", "/jobs/x", "/jobs/", "/jobs"] {
        let line = format!("DELETE {path}");
        assert_eq!(request(at, &line, &[otto], "").await.status, 404, "{path}");
    }
    assert_eq!(request(at, "PUT /jobs/1", &[otto], "").await.status, 405);
    assert_eq!(request(at, "POST /jobs", &[otto], job).await.status, 201);
    let busy = request(at, "POST /jobs", &[otto], job).await;
    assert_eq!(busy.status, 503, "{}", busy.body);
    assert_eq!(request(at, "DELETE /jobs/1", &[], "").await.status, 401);
}
