use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use bridge_node::{BoxFuture, Visit};
use http_body_util::{BodyExt as _, Full};
use hyper::Method;
use mappings::{NodeIdText, TopicId};

use super::*;
use crate::operations::{ConditionChange, ConditionState, OperationFault};
use crate::program::ProgramStatus;

/// Users with the role that their name says.
struct Users;

impl Operations for Users {
    fn has_users(&self) -> bool {
        true
    }

    fn sign_in(&self, _user: String, _password: String) -> BoxFuture<bool> {
        Box::pin(async { false })
    }

    fn roles(&self, user: &str) -> Option<String> {
        Some(user.to_owned())
    }

    fn may_operate(&self, _user: &str) -> bool {
        true
    }

    fn may_load(&self, user: &str) -> bool {
        user == "engineer"
    }

    fn call(
        &self,
        _user: String,
        _topic: TopicId,
        _request: Bytes,
    ) -> BoxFuture<Result<Bytes, OperationFault>> {
        Box::pin(async { Err(OperationFault::Denied) })
    }

    fn write(
        &self,
        _user: String,
        _node: &NodeIdText,
        _block: Bytes,
    ) -> BoxFuture<Result<(), OperationFault>> {
        Box::pin(async { Err(OperationFault::Denied) })
    }

    fn conditions(&self) -> Vec<ConditionState> {
        Vec::new()
    }

    fn change_condition(&self, _: &str, _: &ConditionChange) -> Result<(), OperationFault> {
        Err(OperationFault::Denied)
    }
}

/// A page, and a MES that gives one answer after another.
struct Cell {
    page: Arc<Page>,
    /// Returns the head and the body of each request.
    received: JoinHandle<Vec<(String, String)>>,
}

fn cell(answers: &[(u16, &'static str, &'static str)]) -> Cell {
    cell_with(answers, || ())
}

/// Creates a cell with a MES that calls `before` with each request, before it answers.
fn cell_with(
    answers: &[(u16, &'static str, &'static str)],
    before: impl Fn() + Send + 'static,
) -> Cell {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let answers = answers.to_vec();
    let received = thread::spawn(move || {
        let answered = answers.into_iter().map(|(status, media, body)| {
            let (stream, _) = listener.accept().unwrap();
            let mut reader = BufReader::new(stream);
            let mut head = String::new();
            while !head.ends_with("\r\n\r\n") {
                assert_ne!(reader.read_line(&mut head).unwrap(), 0, "{head}");
            }
            let head = head.to_ascii_lowercase();
            let length = head.split("content-length: ").nth(1);
            let length = length.and_then(|rest| rest.lines().next()?.parse().ok());
            let mut sent = vec![0; length.unwrap_or_default()];
            reader.read_exact(&mut sent).unwrap();
            before();
            let answer = format!(
                "HTTP/1.1 {status} x\r\ncontent-type: {media}\r\ncontent-length: {}\r\n\r\n{body}",
                body.len()
            );
            reader.get_mut().write_all(answer.as_bytes()).unwrap();
            (head, String::from_utf8(sent).unwrap())
        });
        answered.collect()
    });
    let page = Page::new("test", Vec::new(), None);
    page.board().set_programs(vec![ProgramStatus {
        source: url,
        status: Ok(json!({ "processes": [] })),
    }]);
    Cell { page, received }
}

/// A page with users that sign in, without a MES.
fn page() -> Arc<Page> {
    let page = Page::new("test", Vec::new(), None);
    page.operate(Arc::new(Users));
    page
}

const QUERY_MEDIA: (&str, &str) = ("content-type", "application/json");
const FILE_MEDIA: (&str, &str) = ("content-type", "application/octet-stream");

/// Sends a request to the page. Returns the status and the body.
async fn send(
    page: &Arc<Page>,
    (method, path): (Method, &str),
    headers: &[(&'static str, &str)],
    body: impl Into<Bytes>,
) -> (u16, Value) {
    let mut request = Request::builder().method(method).uri(path);
    request = request.header("host", "127.0.0.1:9100");
    for (name, value) in headers {
        request = request.header(*name, *value);
    }
    let request = request.body(Full::new(body.into())).unwrap();
    let visit = Visit::from("127.0.0.1:5000".parse::<SocketAddr>().unwrap());
    match Arc::clone(page).respond(request, &visit).await {
        Ok(response) => {
            let status = response.status().as_u16();
            let bytes = response.into_body().collect().await.unwrap().to_bytes();
            (status, serde_json::from_slice(&bytes).unwrap())
        }
        Err(RefusedRequest(status, why)) => (status.as_u16(), json!({ "error": why })),
    }
}

/// Sends a file on behalf of a user.
async fn send_file(
    page: &Arc<Page>,
    (user, path): (&str, &str),
    more: &[(&'static str, &str)],
    contents: impl Into<Bytes>,
) -> (u16, Value) {
    let now = page.at().since;
    let tokens = ["token".to_owned(), "own".to_owned()];
    page.sessions().open(user, tokens, now);
    let cookie = ("cookie", "ua-session-9100=token");
    let headers = [&[FILE_MEDIA, cookie, ("x-csrf-token", "own")], more].concat();
    send(page, (Method::POST, path), &headers, contents).await
}

#[tokio::test]
async fn a_reader_without_a_user_gets_the_answer_of_a_query_as_a_table() {
    let body =
        r#"{"head":{"vars":["s"]},"results":{"bindings":[{"s":{"type":"uri","value":"urn:a"}}]}}"#;
    let results = (200, "application/sparql-results+json", body);
    let Cell { page, received } = cell(&[results, results]);
    let query = (Method::POST, QUERY);
    let asked = r#"{"query":"SELECT ?s { ?s ?p ?o }"}"#;
    let (status, table) = send(&page, query.clone(), &[QUERY_MEDIA], asked).await;
    assert_eq!(
        (status, &table["rows"][0][0]["value"]),
        (200, &json!("urn:a"))
    );
    let named = r#"{"question":"skills-for","parameters":{"for_x":"urn:a b","y":""}}"#;
    assert_eq!(send(&page, query, &[QUERY_MEDIA], named).await.0, 200);
    let received = received.join().unwrap();
    assert!(received[0].0.starts_with("post /sparql "), "{received:?}");
    assert_eq!(received[0].1, "SELECT ?s { ?s ?p ?o }");
    let line = "get /ask/skills-for?for_x=urn%3aa%20b ";
    assert!(received[1].0.starts_with(line), "{received:?}");
}

#[tokio::test]
async fn the_reason_of_a_refused_query_reaches_the_reader() {
    let answer = r#"{"error":"malformed","message":"line 1: no closing brace"}"#;
    let Cell { page, .. } = cell(&[(400, "application/json", answer)]);
    let query = (Method::POST, QUERY);
    let asked = r#"{"query":"SELECT {"}"#;
    let refused = send(&page, query.clone(), &[QUERY_MEDIA], asked).await;
    assert_eq!(
        refused,
        (400, json!({ "error": "line 1: no closing brace" }))
    );
    // A page of another site sends no such request.
    let elsewhere = ("origin", "http://evil.example");
    let refused = send(&page, query, &[QUERY_MEDIA, elsewhere], asked).await;
    assert_eq!(refused.0, 403);
}

#[tokio::test]
async fn without_a_mes_the_option_is_named() {
    let page = Page::new("test", Vec::new(), None);
    for path in [QUESTIONS, "/knowledge/plan?process=urn:p", PICTURES] {
        let (status, body) = send(&page, (Method::GET, path), &[], "").await;
        let why = body["error"].as_str().unwrap();
        assert!(status == 404 && why.contains("--status"), "{path}: {why}");
    }
}

#[tokio::test]
async fn another_site_causes_no_plan() {
    let page = Page::new("test", Vec::new(), None);
    for (site, expected) in [
        ("same-origin", 404),
        ("cross-site", 403),
        ("same-site", 403),
    ] {
        let plan = "/knowledge/plan?process=urn:p";
        for path in [QUESTIONS, plan, PICTURES, PICTURE] {
            let from = [("sec-fetch-site", site)];
            let (status, _) = send(&page, (Method::GET, path), &from, "").await;
            assert_eq!(status, expected, "{path} from {site}");
        }
    }
}

/// Returns a request of a browser for a path.
async fn respond(page: &Arc<Page>, path: &str) -> Result<Response<PageBody>, RefusedRequest> {
    let request = Request::get(path).header("host", "127.0.0.1:9100");
    let request = request.body(Full::new(Bytes::new())).unwrap();
    let visit = Visit::from("127.0.0.1:5000".parse::<SocketAddr>().unwrap());
    Arc::clone(page).respond(request, &visit).await
}

#[tokio::test]
async fn a_reader_lists_the_pictures_of_modules_and_gets_one_as_a_drawing() {
    let list = r#"{"pictures":[{"name":"Overview","picture":"urn:m/picture/p"}]}"#;
    let svg = "<svg xmlns=\"http://www.w3.org/2000/svg\"/>";
    let Cell { page, received } =
        cell(&[(200, "application/json", list), (200, "image/svg+xml", svg)]);
    let (status, listed) = send(&page, (Method::GET, PICTURES), &[], "").await;
    assert_eq!(
        (status, &listed["pictures"][0]["name"]),
        (200, &json!("Overview"))
    );
    // The IRI goes to the MES as one part of the path, whatever it contains.
    let path = "/knowledge/picture?picture=urn%3Am%2Fp%3F%22%3E%3Cscript%3E%0D%0AX%3A+1%2F..%2Fask";
    let response = respond(&page, path).await.ok().unwrap();
    let headers = response.headers();
    assert_eq!(headers["content-type"], "image/svg+xml");
    assert_eq!(headers["x-content-type-options"], "nosniff");
    let policy = headers["content-security-policy"].to_str().unwrap();
    assert!(
        policy.contains("default-src 'none'") && policy.contains("sandbox"),
        "{policy}"
    );
    let body = response.into_body().collect().await.unwrap().to_bytes();
    assert_eq!(body, svg);
    let received = received.join().unwrap();
    assert!(received[0].0.starts_with("get /pictures http/1.1"));
    let line = received[1].0.lines().next().unwrap();
    let sent = "urn%3am%2fp%3f%22%3e%3cscript%3e%0d%0ax%3a%201%2f..%2fask";
    assert_eq!(line, format!("get /picture/{sent} http/1.1"));
}

#[tokio::test]
async fn a_picture_that_is_unknown_too_large_or_no_drawing_is_refused() {
    let unknown = r#"{"error":"unknown","message":"there is no picture `urn:p`"}"#;
    let large = r#"{"error":"result_limit","message":"the picture `urn:p` is too large"}"#;
    let Cell { page, .. } = cell(&[
        (404, "application/json", unknown),
        (507, "application/json", large),
        (200, "text/html", "<script>alert(1)</script>"),
    ]);
    let picture = (Method::GET, "/knowledge/picture?picture=urn:p");
    for (status, why) in [
        (404, "there is no picture `urn:p`"),
        (507, "the picture `urn:p` is too large"),
        (502, "it is no drawing of the type image/svg+xml"),
    ] {
        let (refused, body) = send(&page, picture.clone(), &[], "").await;
        let said = body["error"].as_str().unwrap();
        assert!(refused == status && said.contains(why), "{refused} {said}");
    }
    let (status, body) = send(&page, (Method::GET, PICTURE), &[], "").await;
    let why = json!({ "error": "name the picture as ?picture=IRI" });
    assert_eq!((status, body), (400, why));
}

#[tokio::test]
async fn behind_a_proxy_only_users_query() {
    let proxy = "https://cell.example".parse().unwrap();
    let page = Page::new("test", Vec::new(), Some(proxy));
    let asked = r#"{"query":"ASK {}"}"#;
    let (status, _) = send(&page, (Method::POST, QUERY), &[QUERY_MEDIA], asked).await;
    assert_eq!(status, 401);
    for path in [QUESTIONS, PICTURES, PICTURE] {
        assert_eq!(send(&page, (Method::GET, path), &[], "").await.0, 401);
    }
}

#[tokio::test]
async fn only_engineers_send_files_and_only_from_the_page() {
    let page = page();
    let path = "/knowledge/load?name=a.aml";
    let load = (Method::POST, path);
    let stranger = send(&page, load.clone(), &[FILE_MEDIA], "x").await;
    assert_eq!(stranger, (401, json!({ "error": "sign in first" })));
    let (status, body) = send_file(&page, ("operator", path), &[], "x").await;
    let why = body["error"].as_str().unwrap();
    assert!(status == 403 && why.contains("the role engineer"), "{why}");
    // The session of the engineer is open, and each request lacks something.
    assert_eq!(send_file(&page, ("engineer", path), &[], "x").await.0, 404);
    let cookie = ("cookie", "ua-session-9100=token");
    let token = ("x-csrf-token", "own");
    for headers in [
        &[FILE_MEDIA, cookie][..],
        &[FILE_MEDIA, cookie, ("x-csrf-token", "other")],
        &[("content-type", "text/plain"), cookie, token],
        &[FILE_MEDIA, cookie, token, ("origin", "http://evil.example")],
    ] {
        let (status, body) = send(&page, load.clone(), headers, "x").await;
        assert_eq!(status, 403, "{headers:?}: {body}");
    }
    let readonly = Page::new("ua-space page", Vec::new(), None);
    let (status, body) = send(&readonly, load, &[FILE_MEDIA], "x").await;
    assert_eq!(status, 403);
    assert_eq!(
        body["error"],
        "ua-space page has no users: the page is read-only"
    );
}

#[tokio::test]
async fn a_file_that_is_too_large_or_no_source_is_refused() {
    let page = page();
    let by = ("engineer", "/knowledge/load?name=a.aml");
    let announced = (LARGEST_FILE + 1).to_string();
    let length = ("content-length", announced.as_str());
    let (status, body) = send_file(&page, by, &[length], "").await;
    let why = body["error"].as_str().unwrap();
    assert!(status == 413 && why.contains("32 MiB"), "{why}");
    let sent = send_file(&page, by, &[], vec![b' '; LARGEST_FILE + 1]).await;
    assert_eq!(sent.0, 413, "its length is not announced");
    for name in ["", "picture.png", "page.xml"] {
        let path = format!("/knowledge/check?name={name}");
        let (status, _) = send_file(&page, ("engineer", &path), &[], "x").await;
        assert_eq!(status, 400, "{name}");
    }
}

const JSON: &str = "application/json";

#[tokio::test]
async fn a_file_is_loaded_after_it_was_accepted() {
    let accepted = (
        200,
        JSON,
        r#"{"accepted":true,"findings":[{"line":3,"what":"w"}]}"#,
    );
    let Cell { page, received } = cell(&[accepted, accepted, (201, "", "")]);
    page.operate(Arc::new(Users));
    let by = ("engineer", "/knowledge/check?name=a+b.aml");
    let (status, checked) = send_file(&page, by, &[], "<CAEXFile/>").await;
    assert_eq!((status, &checked["loaded"]), (200, &json!(false)));
    assert_eq!(checked["findings"][0]["line"], 3);
    let by = ("engineer", "/knowledge/load?name=a+b.aml");
    let (status, loaded) = send_file(&page, by, &[], "<CAEXFile/>").await;
    assert_eq!((status, &loaded["loaded"]), (200, &json!(true)));
    let received = received.join().unwrap();
    let lines: Vec<_> = received
        .iter()
        .map(|(head, _)| head.lines().next())
        .collect();
    assert_eq!(
        lines,
        [
            Some("post /check/mtp/a%20b.aml http/1.1"),
            Some("post /check/mtp/a%20b.aml http/1.1"),
            Some("put /sources/mtp/a%20b.aml http/1.1"),
        ]
    );
    assert!(received.iter().all(|(_, body)| body == "<CAEXFile/>"));
}

#[tokio::test]
async fn a_file_whose_browser_has_left_is_checked_and_not_loaded() {
    let accepted = (200, JSON, r#"{"accepted":true,"findings":[]}"#);
    let (seen, mut requests) = tokio::sync::mpsc::channel(1);
    let (answers, wait) = std::sync::mpsc::channel::<()>();
    let before = move || {
        seen.blocking_send(()).unwrap();
        wait.recv().unwrap();
    };
    let Cell { page, .. } = cell_with(&[accepted, (201, "", "")], before);
    page.operate(Arc::new(Users));
    let browser = tokio::spawn({
        let page = Arc::clone(&page);
        let by = ("engineer", "/knowledge/load?name=a.ttl");
        async move { send_file(&page, by, &[], "<urn:a> <urn:p> 1 .").await }
    });
    requests.recv().await.unwrap();
    browser.abort();
    assert!(browser.await.unwrap_err().is_cancelled());
    assert_eq!(page.places.files.available_permits(), 1, "the check ended");
    answers.send(()).unwrap();
    // The place is free when the outcome has been logged.
    let all = page.places.files.acquire_many(2);
    let all = tokio::time::timeout(Duration::from_secs(20), all).await;
    assert!(all.unwrap().is_ok());
    assert!(requests.try_recv().is_err(), "the file was loaded");
}

#[tokio::test]
async fn a_file_with_faults_is_not_loaded() {
    let faulty =
        r#"{"accepted":false,"findings":[{"line":2,"what":"line 2: no IRI","refused":true}]}"#;
    let Cell { page, received } = cell(&[(200, JSON, faulty)]);
    page.operate(Arc::new(Users));
    let by = ("engineer", "/knowledge/load?name=a.ttl");
    let (status, answer) = send_file(&page, by, &[], "<urn:a>\n<urn:p> .").await;
    assert_eq!((status, &answer["loaded"]), (200, &json!(false)));
    assert_eq!(answer["findings"][0]["line"], 2);
    // The MES has received the check alone.
    assert_eq!(received.join().unwrap().len(), 1);
}

#[tokio::test]
async fn a_mes_with_users_of_its_own_gets_the_password_of_the_user() {
    let refused = (
        401,
        JSON,
        r#"{"error":"user","message":"a password is needed"}"#,
    );
    let accepted = (200, JSON, r#"{"accepted":true,"findings":[]}"#);
    let mut answers = vec![refused, accepted];
    answers.extend([refused; 5]);
    let Cell { page, received } = cell(&answers);
    page.operate(Arc::new(Users));
    let by = ("engineer", "/knowledge/check?name=a.aml");
    let (status, answer) = send_file(&page, by, &[], "x").await;
    assert_eq!((status, &answer["needs_password"]), (200, &json!(true)));
    // secret
    let password = ("x-mes-password", "c2VjcmV0");
    let (_, answer) = send_file(&page, by, &[password], "x").await;
    assert_eq!(answer["accepted"], true);
    for _ in 0..5 {
        let (_, answer) = send_file(&page, by, &[password], "x").await;
        assert_eq!(answer["needs_password"], true);
    }
    let (status, _) = send_file(&page, by, &[password], "x").await;
    assert_eq!(status, 429, "the password is not guessed");
    let received = received.join().unwrap();
    assert!(
        !received[0].0.contains("authorization"),
        "{}",
        received[0].0
    );
    // engineer:secret, in lower case like the whole head
    let basic = "authorization: basic zw5naw5lzxi6c2vjcmv0\r\n";
    assert!(received[1].0.contains(basic), "{}", received[1].0);
}
