use std::path::Path;
use std::sync::{Arc, Mutex};

use http_client::{HttpHost, TlsAuthorities, TlsVerification};
use plant_opcua::pki::{OWN_CERTIFICATE, OWN_KEY, Pki};
use program::{ProgramMachineState, ProgramMethod};
use rustls::pki_types::pem::PemObject as _;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use skills::{
    Authority, Component, DriverSetup, ParameterType, RunOutcome, Skill, SkillDescription,
    SkillOwner, conformance, model,
};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};
use tokio::net::TcpListener;
use tokio::task::JoinSet;
use tokio_rustls::TlsAcceptor;

use super::*;
use crate::Kinds;
use crate::http::{DeviceHost, DeviceRequest};

/// A connection with or without TLS.
trait Stream: AsyncRead + AsyncWrite + Unpin + Send {}

impl<T: AsyncRead + AsyncWrite + Unpin + Send> Stream for T {}

/// A device that answers requests as its fields say, and records them.
#[derive(Debug, Default)]
struct Press {
    seen: Vec<String>,
    /// The status of the response to a start; 0 for no response.
    start: u16,
    /// The states that polling returns in turn; the last is repeated. An empty state is no
    /// response.
    states: Vec<&'static str>,
    stopped: bool,
}

impl Press {
    /// Returns the status and the body of a response; `None` for no response.
    fn answer(&mut self, request: &str, body: &str) -> Option<(u16, String)> {
        self.seen
            .push(format!("{request} {body}").trim().to_owned());
        if request.starts_with("POST /start") {
            let body = r#"{"message": "busy", "gripped": true}"#.to_owned();
            return (self.start > 0).then_some((self.start, body));
        }
        if request.starts_with("POST /stop") {
            self.stopped = true;
            return Some((200, String::new()));
        }
        let state = match self.states.len() {
            0 | 1 => self.states.first().copied().unwrap_or("running"),
            _ => self.states.remove(0),
        };
        let state = if self.stopped { "aborted" } else { state };
        let body = format!(
            r#"{{"job": {{"state": "{state}", "share": 0.5, "why": "no part", "gripped": true}}}}"#
        );
        (!state.is_empty()).then_some((200, body))
    }
}

struct Bench {
    press: Arc<Mutex<Press>>,
    address: String,
    _task: JoinSet<()>,
}

impl Bench {
    async fn new(start: u16, states: &[&'static str]) -> Self {
        Self::over(None, start, states).await
    }

    /// Creates a device that answers with or without TLS.
    async fn over(tls: Option<TlsAcceptor>, start: u16, states: &[&'static str]) -> Self {
        let press = Arc::new(Mutex::new(Press {
            start,
            states: states.to_vec(),
            ..Press::default()
        }));
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let mut task = JoinSet::new();
        let served = Arc::clone(&press);
        task.spawn(async move {
            let mut clients = JoinSet::new();
            while let Ok((stream, _)) = listener.accept().await {
                let (press, tls) = (Arc::clone(&served), tls.clone());
                clients.spawn(async move {
                    let mut stream: Box<dyn Stream> = match tls {
                        None => Box::new(stream),
                        Some(tls) => match tls.accept(stream).await {
                            Ok(stream) => Box::new(stream),
                            Err(_refused) => return,
                        },
                    };
                    let mut bytes = Vec::new();
                    let mut chunk = [0; 1024];
                    loop {
                        let Ok(count @ 1..) = stream.read(&mut chunk).await else {
                            return;
                        };
                        bytes.extend_from_slice(&chunk[..count]);
                        let text = String::from_utf8_lossy(&bytes).into_owned();
                        let Some((head, body)) = text.split_once("\r\n\r\n") else {
                            continue;
                        };
                        let length = head.lines().find_map(|line| {
                            let (name, value) = line.split_once(": ")?;
                            name.eq_ignore_ascii_case("content-length")
                                .then_some(value)?
                                .parse()
                                .ok()
                        });
                        if body.len() < length.unwrap_or(0) {
                            continue;
                        }
                        let line = head.lines().next().unwrap_or_default();
                        let line = line.trim_end_matches(" HTTP/1.1");
                        let answer = press.lock().unwrap().answer(line, body);
                        let Some((status, body)) = answer else {
                            std::future::pending::<()>().await;
                            return;
                        };
                        let length = body.len();
                        let answer = format!(
                            "HTTP/1.1 {status} X\r\ncontent-length: {length}\r\n\r\n{body}"
                        );
                        // The client may be gone.
                        let _written = stream.write_all(answer.as_bytes()).await;
                        let _flushed = stream.flush().await;
                        return;
                    }
                });
            }
        });
        Self {
            press,
            address,
            _task: task,
        }
    }

    fn driver(&self, http: &str) -> Arc<dyn Driver> {
        let http = http.replace("PRESS", &format!("http://{}", self.address));
        driver(&http).unwrap()
    }

    async fn run(&self, http: &str) -> RunOutcome {
        let force = vec![("Force".to_owned(), SkillValue::from(12.5))];
        conformance::run_once("GraspSkillType", self.driver(http), force)
            .await
            .unwrap()
    }

    fn seen(&self) -> Vec<String> {
        self.press.lock().unwrap().seen.clone()
    }

    fn skill(&self, http: &str) -> Skill {
        let of = model::find("GraspSkillType").unwrap();
        let facts = SkillDescription {
            name: "Grasp".to_owned(),
            types: vec![ParameterType::own("GraspSkillType")],
            parameters: of.parameters(),
            results: of.results(),
            capabilities: Vec::new(),
            timeout: None,
            rests_in: of.rests_in,
        };
        Skill::spawn(facts, self.driver(http), Authority::new(), Vec::new())
    }
}

const BY: SkillOwner = SkillOwner::Local("the test");

async fn start(skill: &Skill) {
    if skill.shown().state == ProgramMachineState::Halted {
        skill.call(BY, ProgramMethod::Reset).await.unwrap();
    }
    skill.start_with(BY, Vec::new()).await.unwrap();
}

fn driver(http: &str) -> Result<Arc<dyn Driver>, String> {
    let text = format!(
        "component: x\napplication_uri: urn:x\nnamespace: 1\nskills:\n  - {{name: Grasp, type: GraspSkillType, driver: {{http: {http}}}}}\n"
    );
    let component = Component::from_yaml_with(&text, Path::new(""), &Kinds)
        .map_err(|findings| findings.render("x.yaml", &text))?;
    let driver = &component.skills[0].driver;
    if let DriverSetup::Given(driver) = driver {
        return Ok(Arc::clone(driver));
    }
    Err(format!("{driver:?}"))
}

const POLLED: &str = "{start: {url: \"PRESS/start/{Force}\", body: {force: \"{Force}\", text: \"{Force} N\", mode: 2}}, \
    poll: {url: PRESS/state, every: 20 ms, done: {/job/state: done}, failed: {/job/state: [error, aborted]}, \
    progress: /job/share, step: /job/state, reason: /job/why}, results: {Gripped: /job/gripped}, stop: PRESS/stop, \
    within: 1 s, halt_timeout: 2 s}";

#[tokio::test]
async fn a_run_is_started_with_its_parameters_and_polled_to_its_results() {
    let bench = Bench::new(202, &["running", "closing", "done"]).await;
    let outcome = bench.run(POLLED).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(outcome.results, [("Gripped".to_owned(), true.into())]);
    assert!(
        outcome.trace.iter().any(|line| line.ends_with(" closing")),
        "{:?}",
        outcome.trace
    );
    let start = "POST /start/12.5 {\"force\":12.5,\"mode\":2,\"text\":\"12.5 N\"}";
    assert_eq!(bench.seen()[0], start);
    assert!(!bench.press.lock().unwrap().stopped);
}

#[tokio::test]
async fn it_is_as_a_driver_should_be() {
    let bench = Bench::new(200, &[]).await;
    let press = Arc::clone(&bench.press);
    let again = move || {
        let mut press = press.lock().unwrap();
        press.stopped = false;
        press.states = vec!["running", "running", "running", "done"];
        Vec::new()
    };
    conformance::check("GraspSkillType", bench.driver(POLLED), again)
        .await
        .unwrap();
}

#[tokio::test]
async fn halt_stops_the_device_also_while_a_response_is_slow() {
    for last in ["running", ""] {
        let bench = Bench::new(200, &["running", last]).await;
        let skill = bench.skill(&POLLED.replace("within: 1 s", "within: 3 s"));
        start(&skill).await;
        let polls = || {
            let seen = bench.seen();
            seen.iter().filter(|line| *line == "GET /state").count()
        };
        while polls() < 2 {
            sleep(Duration::from_millis(2)).await;
        }
        skill.call(BY, ProgramMethod::Halt).await.unwrap();
        assert_eq!(skill.shown().state, ProgramMachineState::Halted);
        let seen = bench.seen();
        assert!(seen.iter().any(|line| line == "POST /stop"), "{seen:?}");
    }
}

#[tokio::test]
async fn without_a_stop_request_halt_is_refused_and_the_run_is_followed_to_its_end() {
    let bench = Bench::new(200, &["running"]).await;
    let without = POLLED.replace("stop: PRESS/stop, ", "");
    let skill = bench.skill(&without.replace("halt_timeout: 2 s", "halt_timeout: 1 ms"));
    start(&skill).await;
    for _ in 0..2 {
        let refused = skill.call(BY, ProgramMethod::Halt).await.unwrap_err();
        let expected = "BadRequestNotAllowed: the YAML has no `stop` request: the work goes on";
        assert_eq!(refused.to_string(), expected);
        assert_eq!(skill.shown().state, ProgramMachineState::Running);
    }
    bench.press.lock().unwrap().states = vec!["done"];
    let mut watch = skill.watch();
    let ended = watch.wait_for(|shown| shown.state == ProgramMachineState::Ready);
    let outcome = ended.await.unwrap().outcome.clone().unwrap();
    assert!(outcome.succeeded && !outcome.unknown, "{outcome:?}");
}

#[tokio::test]
async fn a_request_that_is_withdrawn_before_it_is_sent_is_not_sent() {
    let bench = Bench::new(200, &[]).await;
    let asked = DeviceRequest {
        method: "POST",
        path: "/start",
        body: None,
        within: WITHIN,
    };
    let host = DeviceHost::plain(bench.address.clone());
    let fault = host.ask_unless(asked, || true).await.unwrap_err();
    let why = "Halt came before the request was sent".to_owned();
    assert_eq!(fault, HttpFault::Unreachable(why));
    assert!(bench.seen().is_empty());
}

#[tokio::test]
async fn a_device_behind_tls_is_asked_only_if_its_certificate_is_trusted() {
    let folder = std::env::temp_dir().join(format!("devices-https-{}", std::process::id()));
    let pki = Pki::open(folder.clone()).unwrap();
    let hosts = ["127.0.0.1".to_owned()];
    pki.ensure_own_at("urn:test:press", &hosts).unwrap();
    let own = CertificateDer::from(std::fs::read(folder.join(OWN_CERTIFICATE)).unwrap());
    let key = PrivateKeyDer::from_pem_file(folder.join(OWN_KEY)).unwrap();
    std::fs::remove_dir_all(&folder).unwrap();
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![own.clone()], key)
        .unwrap();
    let acceptor = TlsAcceptor::from(Arc::new(config));
    let bench = Bench::over(Some(acceptor), 200, &[]).await;
    let ask = async |host: &str, trusted: bool| {
        let authorities = TlsAuthorities::of(trusted.then(|| own.clone()));
        let tls = TlsVerification::new(host, &authorities).unwrap();
        let host = DeviceHost::new(HttpHost::secured(bench.address.clone(), tls));
        let asked = DeviceRequest {
            method: "POST",
            path: "/start",
            body: None,
            within: WITHIN,
        };
        host.ask(asked).await
    };
    let answer = ask("127.0.0.1", true).await.unwrap();
    assert_eq!(answer["gripped"], true);
    assert_eq!(bench.seen(), ["POST /start"]);
    for (host, trusted) in [("127.0.0.1", false), ("press.example", true)] {
        let fault = ask(host, trusted).await.unwrap_err();
        let told = fault.to_string();
        assert!(matches!(fault, HttpFault::Unreachable(_)), "{told}");
        assert!(told.starts_with("https://127.0.0.1:"), "{told}");
    }
    assert_eq!(bench.seen(), ["POST /start"], "nothing else was sent");
}

#[tokio::test]
async fn damaged_results_are_an_unknown_outcome() {
    let bench = Bench::new(200, &[]).await;
    let skill = bench.skill("{start: PRESS/start, results: {Gripped: /held}, stop: PRESS/stop}");
    start(&skill).await;
    let mut watch = skill.watch();
    let ended = watch
        .wait_for(|shown| shown.state == ProgramMachineState::Halted)
        .await;
    assert!(ended.unwrap().needs_reset);
    assert!(bench.press.lock().unwrap().stopped);
}

#[test]
fn the_parameters_of_the_stop_request_are_checked_too() {
    let stop = driver("{start: \"http://h/x\", stop: \"http://h/{Speed}\"}").unwrap();
    let refused = stop.check(&Parameters::default()).unwrap_err();
    assert_eq!(refused, template::no_parameter("Speed"));
}

#[tokio::test]
async fn a_failure_has_its_reason_and_a_refused_start_moves_nothing() {
    let failed = Bench::new(200, &["running", "error"]).await;
    let outcome = failed.run(POLLED).await;
    assert_eq!(
        (outcome.succeeded, outcome.message.as_str()),
        (false, "no part")
    );
    let refused = Bench::new(409, &[]).await;
    let outcome = refused.run(POLLED).await;
    assert!(outcome.message.contains("refuses with 409") && outcome.message.contains("busy"));
    assert!(!refused.press.lock().unwrap().stopped);
    let nobody = driver("{start: \"http://127.0.0.1:1/start\"}").unwrap();
    let outcome = conformance::run_once("GraspSkillType", nobody, Vec::new())
        .await
        .unwrap();
    assert!(
        outcome.message.contains("cannot be reached"),
        "{}",
        outcome.message
    );
}

#[tokio::test]
async fn a_start_without_an_answer_is_unknown_and_the_device_is_stopped() {
    for status in [0, 500] {
        let bench = Bench::new(status, &[]).await;
        let outcome = bench.run(POLLED).await;
        assert!(!outcome.succeeded);
        let why = &outcome.message;
        assert!(why.contains("the `stop` request is done"), "{why}");
        assert!(bench.press.lock().unwrap().stopped);
    }
}

#[tokio::test]
async fn a_response_can_be_the_end_of_the_run() {
    let bench = Bench::new(200, &[]).await;
    let outcome = bench
        .run("{start: PRESS/start, results: {Gripped: /gripped}}")
        .await;
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(outcome.results, [("Gripped".to_owned(), true.into())]);
    let outcome = bench
        .run("{start: PRESS/start, results: {Gripped: /held}}")
        .await;
    let expected = "the outcome is unknown: Gripped: the response has no /held; there is no `stop` \
                    request";
    assert_eq!(outcome.message, expected);
}

#[test]
fn wrong_requests_are_findings() {
    for (http, expected) in [
        ("{}", "`start` is missing"),
        ("{start: \"ftp://h/x\"}", "expected http://host"),
        ("{start: \"https://h:0/x\"}", "expected http://host"),
        ("{start: \"http://h:0/x\"}", "expected http://host"),
        ("{start: \"http://a@h/x\"}", "expected http://host"),
        (
            "{start: {url: \"http://h/x\", method: BREW}}",
            "found `BREW`",
        ),
        (
            "{start: \"http://h/x\", poll: {url: \"http://h/y\"}}",
            "`done` is missing",
        ),
        (
            "{start: \"http://h/x\", poll: {url: \"http://h/y\", done: {state: done}}}",
            "a JSON pointer",
        ),
        (
            "{start: \"http://h/x\", results: [a]}",
            "a map from results",
        ),
    ] {
        let Err(told) = driver(http) else {
            panic!("{http} has no finding")
        };
        assert!(
            told.contains(expected) && told.contains("x.yaml:5:"),
            "{http}: {told}"
        );
    }
}
