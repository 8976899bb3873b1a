//! The page of the cell: values, skills and programs as a browser receives them, and the commands
//! of signed-in users.

use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{
    Browser, Cell, Child, METRICS_SERVER, Peer, SERVER_ENDPOINT, StartedChild, UadpSocket,
    eventually, holds_for, http_get, program, resident,
};
use uadp::{DataSetHeader, GroupHeader, NetworkHeader, NetworkMessageEncoder, PublisherId, Scalar};

const SOON: Duration = Duration::from_secs(30);
const PAGE: &str = "127.0.0.1:8090";
const PASSWORD: &str = "correct horse battery";

/// Returns a datagram with one Double of a ROS 1 topic.
fn datagram(id: u16, value: f64) -> Vec<u8> {
    datagram_of(id, Scalar::Double(value))
}

fn datagram_of(id: u16, value: Scalar<'_>) -> Vec<u8> {
    let network = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        group: Some(GroupHeader {
            writer_group_id: Some(2),
            ..GroupHeader::default()
        }),
        ..NetworkHeader::default()
    };
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::new(&mut datagram, &network, Some(&[id])).unwrap();
    let mut frame = message.key_frame(&DataSetHeader::default()).unwrap();
    frame.scalar(value).unwrap();
    frame.finish().unwrap();
    message.finish().unwrap();
    datagram
}

fn page_of_space(cell: &Cell, args: &[&str]) -> Child {
    let page = StartedChild::new("ua-space", &program("ua-space"))
        .args([&["page", "--interface", "lo"], args].concat())
        .in_folder(cell.folder())
        .start();
    eventually("the page is served", SOON, || http_get(PAGE, "/session"));
    page
}

#[test]
fn a_browser_receives_the_visible_values_without_a_server() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let page = page_of_space(&cell, &["--status", "http://127.0.0.1:9"]);
    let browser = Browser::of(PAGE);
    let start = browser.get("/");
    assert_eq!(start.code, 200);
    let policy = start.header("content-security-policy").unwrap_or_default();
    assert!(policy.starts_with("default-src 'none'"), "{start:?}");
    let foreign = Browser {
        host: Some("rebound.example".to_owned()),
        ..Browser::of(PAGE)
    };
    assert_eq!(foreign.get("/").code, 421);
    assert_eq!(browser.post("/sign-in", &json!({})).code, 403);
    assert_eq!(browser.get("/events?view=all").code, 400);

    let group = UadpSocket::join();
    let send = |value: f64| {
        for id in 1..=60 {
            group.send(&datagram(id, value));
        }
    };
    send(1.5);
    let mut values = browser.events("view=values&from=10&count=20");
    let shown = values.until("the values are there", |view| {
        (view["total"] == 60).then(|| view.clone())
    });
    let order = shown["order"].as_array().unwrap();
    assert_eq!(order.len(), 20);
    send(2.5);
    let topic = order[0].as_str().unwrap().to_owned();
    values.until("the next value is there", |view| {
        (view["rows"][&topic]["value"] == "2.5").then_some(())
    });
    let mut one = browser.events("view=topic&topic=ua_1_2_5");
    one.until("the topic is there", |view| {
        (view["row"]["value"] == "2.5" && view["origin"] == "ROS 1").then_some(())
    });
    let mut programs = browser.events("view=programs");
    programs.until("a program that does not answer is red", |view| {
        let all = view["programs"].as_array()?;
        let gone = all
            .iter()
            .find(|row| row["source"] == "http://127.0.0.1:9")?;
        let own = all.iter().find(|row| row["source"] == "this program")?;
        (gone["state"] == "down" && own["state"] == "ready").then_some(())
    });
    drop(page);
}

#[test]
fn events_are_shown_live_and_from_a_recording() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let file = cell.folder().join("events.pcapng");
    let name = file.to_str().unwrap();
    let mut page = page_of_space(&cell, &[]);
    let group = UadpSocket::join();
    // The probes of the page are messages too.
    let mut recording = StartedChild::new("ua-space", &program("ua-space"))
        .args(["record", name, "--count", "40", "--interface", "lo"])
        .start();
    let mut value = false;
    let mut change = || {
        value = !value;
        group.send(&datagram_of(10, Scalar::Boolean(value)));
    };
    eventually("changes are recorded", SOON, || {
        change();
        (!recording.runs()).then_some(())
    });
    // Adds the texts of new events, and returns whether both values are among them.
    let has_both = |view: &Value, texts: &mut Vec<String>| {
        let events = view["events"].as_array().into_iter().flatten();
        let new = events.filter_map(|one| one["text"].as_str().map(str::to_owned));
        texts.extend(new);
        let has = |text: &str| texts.iter().any(|one| one == text);
        (has("true") && has("false")).then_some(())
    };
    let (mut texts, mut is_named) = (Vec::new(), false);
    let mut live = Browser::of(PAGE).events("view=events");
    live.until("the changes are events", |view| {
        change();
        is_named |= view["names"]["ua_1_2_10"][0] == "ROS 1";
        assert!(view["recording"].is_null(), "{view}");
        has_both(view, &mut texts).filter(|()| is_named)
    });
    page.end();

    let _page = page_of_space(&cell, &["--recording", name]);
    texts.clear();
    let mut recorded = Browser::of(PAGE).events("view=events");
    recorded.until("the events of the recording are shown", |view| {
        let is_recording = view["recording"] == "events.pcapng";
        has_both(view, &mut texts).filter(|()| is_recording)
    });
    // The group is not shown.
    let total = |view: &Value| view["total"].as_u64();
    holds_for(
        "only the recording is shown",
        Duration::from_secs(1),
        || {
            group.send(&datagram(11, 1.0));
            let mut values = Browser::of(PAGE).events("view=values&count=10");
            values.until("the values are there", total) == 1
        },
    );
}

#[test]
fn browsers_that_never_read_cost_bounded_memory() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let page = page_of_space(&cell, &[]);
    let browser = Browser::of(PAGE);
    let group = UadpSocket::join();
    let mut sent = 0.0;
    let mut send_all = || {
        sent += 1.0;
        for id in 1..=100 {
            group.send(&datagram(id, sent));
        }
    };
    send_all();
    browser
        .events("view=values&count=100")
        .until("the values are there", |view| {
            (view["total"] == 100).then_some(())
        });
    let before = resident(page.id());
    let idle: Vec<_> = (0..100)
        .map(|_| browser.events("view=values&count=100"))
        .collect();
    let mut reader = browser.events("view=values&count=100");
    // A reader receives new values while the others do not read.
    for round in 0..20 {
        send_all();
        let wanted = f64::from(round + 2).to_string();
        reader.until("the next values are there", |view| {
            let rows = view["rows"].as_object()?;
            rows.values()
                .any(|row| row["value"] == wanted.as_str())
                .then_some(())
        });
    }
    let grown = resident(page.id()).saturating_sub(before);
    assert!(
        grown < 40 << 20,
        "{grown} bytes for {} browsers",
        idle.len()
    );
}

/// Adds a user of the server.
fn add_user(cell: &Cell, name: &str, role: &str) {
    add_user_in(&cell.folder().join("pki"), name, role);
}

/// Adds a user to a certificate store.
fn add_user_in(pki: &Path, name: &str, role: &str) {
    let mut child = Command::new(program("ua-server"))
        .args(["user", "add", name, "--role", role, "--pki"])
        .arg(pki)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(PASSWORD.as_bytes()).unwrap();
    drop(stdin);
    assert!(child.wait().unwrap().success());
}

fn signed_in(name: &str) -> Browser {
    let mut browser = Browser::of(METRICS_SERVER);
    let answer = browser.post("/sign-in", &json!({ "user": name, "password": PASSWORD }));
    assert_eq!(answer.code, 200, "{answer:?}");
    let cookie = answer.header("set-cookie").unwrap();
    assert!(cookie.contains("HttpOnly; SameSite=Strict"), "{cookie}");
    browser.cookie = cookie.split(';').next().unwrap().to_owned();
    browser.csrf = answer.json()["csrf"].as_str().unwrap().to_owned();
    browser
}

#[test]
fn an_operator_writes_a_value_within_its_range() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    add_user(&cell, "anna", "operator");
    add_user(&cell, "otto", "observer");
    let mapping = cell.file(
        "page.yaml",
        "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0, range: [0, 10], unit: m/s}
  - {node: ns=2;i=31, name: limit, type: Double, origin: 0, permissions: {write: engineer}}
",
    );
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    let (anna, otto) = (signed_in("anna"), signed_in("otto"));
    let write = |topic: &str, value: &str| json!({ "topic": topic, "value": value });
    let mut shown = anna.events("view=topic&topic=ua_0_2_30");
    shown.until("the value can be written", |view| {
        (view["write"]["type"] == "Double" && view["row"]["unit"] == "m/s").then_some(())
    });
    assert_eq!(otto.post("/write", &write("ua_0_2_30", "4.5")).code, 403);
    assert_eq!(anna.post("/write", &write("ua_0_2_31", "4.5")).code, 403);
    assert_eq!(anna.post("/write", &write("ua_0_2_30", "11")).code, 409);
    assert_eq!(anna.post("/write", &write("ua_0_2_30", "fast")).code, 400);
    assert_eq!(anna.post("/write", &write("ua_1_2_30", "1")).code, 409);
    let written = anna.post("/write", &write("ua_0_2_30", "4.5"));
    assert_eq!(written.code, 200, "{written:?}");
    shown.until("the value is shown", |view| {
        (view["row"]["value"] == "4.5").then_some(())
    });
}

#[test]
fn users_of_other_hosts_sign_in_by_tls_with_the_certificate_of_the_server() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    add_user(&cell, "anna", "operator");
    let _server = cell.ua_server(&["--page-tls", "127.0.0.1:9443"]);
    let pki = cell.folder().join("pki");
    let certificate = pki.join("own/cert.der");
    let words = ["9443", certificate.to_str().unwrap(), PASSWORD];
    let seen = cell.asyncua_once("page_tls.py", &words);
    let of = |name: &str| {
        let found = seen.iter().find(|line| line["name"] == name);
        found.cloned().unwrap_or(Value::Null)
    };
    assert_eq!(of("clear")["page"], false, "{seen:?}");
    assert_eq!(of("stranger")["trusted"], false, "{seen:?}");
    for (name, code) in [
        ("start", 200),
        ("session", 200),
        ("unknown reader", 401),
        ("other site", 421),
        ("status", 404),
        ("wrong password", 403),
        ("sign-in", 200),
        ("reader", 200),
    ] {
        assert_eq!(of(name)["code"], code, "{name}: {seen:?}");
    }
    assert_eq!(of("session")["text"]["must_sign_in"], true);
    assert_eq!(of("sign-in")["text"]["user"], "anna");
    let cookie = of("sign-in")["cookie"].to_string();
    assert!(cookie.contains("__Host-ua-session="), "{cookie}");
    assert!(cookie.contains("; Secure"), "{cookie}");
    // On this host without TLS, everybody may read as before.
    assert_eq!(
        Browser::of(METRICS_SERVER).get("/session").json()["must_sign_in"],
        false
    );
}

const ALARMS: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: Speed, type: Double, origin: 0, alarm: {high: 5, confirm: true, severity: 700}}
  - {node: ns=2;i=31, name: Guard, type: Boolean, origin: 0, alarm: {normal: true}}
server: {security: [None], anonymous: observer}
";

#[test]
fn an_operator_acknowledges_and_confirms_an_alarm() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    add_user(&cell, "anna", "operator");
    add_user(&cell, "otto", "observer");
    let mapping = cell.file("alarms.yaml", ALARMS);
    let _server = cell.ua_server(&[mapping.to_str().unwrap()]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    let (anna, otto) = (signed_in("anna"), signed_in("otto"));
    let mut shown = otto.events("view=alarms");
    let first = |view: &Value| view["conditions"].get(0).cloned();
    shown.until("the conditions are listed, none of them open", |view| {
        (view["open"] == 0 && view["conditions"].as_array()?.len() == 2).then_some(())
    });
    let set = |value: &str| {
        let written = anna.post("/write", &json!({ "topic": "ua_0_2_30", "value": value }));
        assert_eq!(written.code, 200, "{written:?}");
    };
    set("7");
    let active = shown.until("the alarm is active and first", |view| {
        let one = first(view)?;
        (view["open"] == 1 && one["is_active"] == true && one["level"] == "High").then_some(one)
    });
    assert_eq!(
        (&active["name"], &active["severity"]),
        (&json!("Speed"), &json!(700))
    );
    assert_eq!(active["is_acknowledged"], false);
    let change = |action: &str, event: &Value| {
        json!({
            "condition": active["condition"], "event": event, "action": action,
            "comment": "I look after it",
        })
    };
    let acknowledge = change("acknowledge", &active["event"]);
    assert_eq!(otto.post("/condition", &acknowledge).code, 403);
    let stranger = Browser::of(METRICS_SERVER);
    assert_eq!(stranger.post("/condition", &acknowledge).code, 401);
    let forged = Browser {
        csrf: "00".to_owned(),
        ..signed_in("anna")
    };
    assert_eq!(forged.post("/condition", &acknowledge).code, 403);
    let older = change("acknowledge", &json!("00112233445566778899aabbccddeeff"));
    assert_eq!(anna.post("/condition", &older).code, 409);
    let done = anna.post("/condition", &acknowledge);
    assert_eq!(done.code, 200, "{done:?}");
    let acknowledged = shown.until("it is acknowledged", |view| {
        let one = first(view)?;
        (one["is_acknowledged"] == true && one["is_confirmed"] == false).then_some(one)
    });
    assert_eq!(
        (&acknowledged["user"], &acknowledged["comment"]),
        (&json!("anna"), &json!("I look after it"))
    );
    assert_eq!(
        anna.post("/condition", &acknowledge).code,
        409,
        "it is not done twice"
    );
    // An OPC UA client sees the same state.
    let nodes = ["AckedState.Id", "ConfirmedState.Id", "ClientUserId"];
    let read = nodes.map(|path| {
        let node = format!("ns=1;s=ua_0_2_30.alarm|{path}");
        cell.asyncua_once("opcua_read.py", &[SERVER_ENDPOINT, &node])[0]["value"].clone()
    });
    assert_eq!(read, [json!(true), json!(false), json!("anna")]);
    set("1");
    let normal = shown.until("the value is normal", |view| {
        let one = first(view)?;
        (one["is_active"] == false && view["open"] == 1).then_some(one)
    });
    let confirmed = anna.post("/condition", &change("confirm", &normal["event"]));
    assert_eq!(confirmed.code, 200, "{confirmed:?}");
    shown.until("nothing is open", |view| (view["open"] == 0).then_some(()));
}

#[test]
fn an_operator_starts_a_skill_and_others_are_refused() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    add_user(&cell, "anna", "operator");
    add_user(&cell, "otto", "observer");
    let server = cell.ua_server(&[]);
    let yaml =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/plant/parallel-gripper.yaml");
    let _component = StartedChild::new("ua-component", &program("ua-component"))
        .args([yaml.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .args(["--pki".into(), cell.folder().join("component-pki")])
        .start();
    let stranger = Browser::of(METRICS_SERVER);
    let mut skills = stranger.events("view=skills");
    let mut grasp = |what: &str, is: &dyn Fn(&Value) -> bool| {
        skills.until(what, |view| {
            let all = view["skills"].as_array()?;
            let grasp = all.iter().find(|skill| skill["skill"] == "Grasp")?;
            is(grasp).then(|| grasp.clone())
        })
    };
    let tile = grasp("the skill has its calls", &|grasp| {
        grasp["calls"]["Start"]["topic"].is_string() && grasp["state"].is_string()
    });
    assert_eq!(tile["type"], "GraspSkillType");
    let start = tile["calls"]["Start"]["topic"].as_str().unwrap().to_owned();
    let call = json!({ "topic": start, "fields": { "Force": "12.5" } });
    assert_eq!(stranger.post("/call", &call).code, 401);
    let wrong = json!({ "user": "anna", "password": "x" });
    assert_eq!(stranger.post("/sign-in", &wrong).code, 403);
    assert_eq!(signed_in("otto").post("/call", &call).code, 403);
    let anna = signed_in("anna");
    assert_eq!(anna.get("/session").json()["may_operate"], true);
    let forged = Browser {
        csrf: String::new(),
        cookie: anna.cookie.clone(),
        ..Browser::of(METRICS_SERVER)
    };
    assert_eq!(forged.post("/call", &call).code, 403);
    let hard = json!({ "topic": start, "fields": { "Force": "hard" } });
    assert_eq!(anna.post("/call", &hard).code, 400);
    if tile["state"] == "Halted" {
        let reset = tile["calls"]["Reset"]["topic"].clone();
        let answer = anna.post("/call", &json!({ "topic": reset }));
        assert_eq!(answer.code, 200, "{answer:?}");
        grasp("the skill is ready", &|grasp| grasp["state"] == "Ready");
    }
    let answer = anna.post("/call", &call);
    assert_eq!(answer.code, 200, "{answer:?}");
    let ended = grasp("the run has ended", &|grasp| {
        grasp["state"] == "Ready" && grasp["result"]["succeeded"] == true
    });
    assert_eq!(ended["result"]["results"]["Gripped"], "true");
    assert_eq!(anna.post("/sign-out", &json!({})).code, 200);
    assert_eq!(anna.post("/call", &call).code, 401);
    let log = server.lines().join("\n");
    for line in [
        "signed in on the page",
        "refused to sign in on the page",
        "called from the page",
    ] {
        assert!(log.contains(line), "{line}: {log}");
    }
}

#[test]
fn the_mes_is_queried_on_the_page_and_an_engineer_loads_a_file() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    add_user(&cell, "erna", "engineer");
    add_user(&cell, "otto", "operator");
    let text = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                endpoint: opc.tcp://127.0.0.1:48401\nsecurity: [None]\n";
    let of_mes = cell.folder().join("mes-pki");
    let _mes = StartedChild::new("ua-mes", &program("ua-mes"))
        .args([cell.file("mes.yaml", text).to_str().unwrap(), "--pki"])
        .args([
            of_mes.to_str().unwrap(),
            "--interface",
            "lo",
            "--lds",
            "none",
        ])
        .start();
    let mapping = cell.file("page.yaml", "namespaces: {2: urn:ua-bridge:system-tests}\nvariables:\n  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0}\n");
    let of_server = [
        mapping.to_str().unwrap(),
        "--status",
        "http://127.0.0.1:8087",
    ];
    let server = cell.ua_server(&of_server);

    let stranger = Browser::of(METRICS_SERVER);
    let mut view = stranger.events("view=knowledge");
    view.until("the MES is known", |view| {
        (view["mes"] == true).then_some(())
    });
    let questions = stranger.get("/knowledge/questions").json();
    let mut named = questions["questions"].as_array().unwrap().iter();
    assert!(named.any(|question| question["name"] == "state-of"));
    let ask = |query: &str| stranger.post("/knowledge/query", &json!({ "query": query }));
    let about = "SELECT ?p ?o { <urn:a> ?p ?o }";
    assert_eq!(ask(about).json()["total"], 0);
    assert_eq!(ask("SELECT {").code, 400);

    let file = "<urn:a> <urn:p> <urn:b> , 7 .";
    let load = "/knowledge/load?name=a.ttl";
    assert_eq!(stranger.upload(load, "", file).code, 401);
    assert_eq!(signed_in("otto").upload(load, "", file).code, 403);
    let erna = signed_in("erna");
    let faulty = erna.upload(load, "", "<urn:a>\n<urn:p> .").json();
    assert_eq!(
        (&faulty["loaded"], &faulty["accepted"]),
        (&json!(false), &json!(false))
    );
    assert_eq!(faulty["findings"][0]["line"], 2, "{faulty}");
    let checked = erna.upload("/knowledge/check?name=a.ttl", "", file).json();
    assert_eq!(checked["accepted"], true, "{checked}");
    assert_eq!(ask(about).json()["total"], 0, "nothing is loaded yet");
    assert_eq!(erna.upload(load, "", file).json()["loaded"], true);
    assert_eq!(ask(about).json()["total"], 2);
    let graph = ask("CONSTRUCT { ?s ?p ?o } WHERE { ?s <urn:p> ?o . ?s ?p ?o }").json();
    assert_eq!(
        (&graph["kind"], &graph["total"]),
        (&json!("construct"), &json!(2))
    );
    assert_eq!(graph["rows"][0][0]["value"], "urn:a", "{graph}");

    // Users of the MES decide once it has any.
    add_user_in(&of_mes, "erna", "engineer");
    let file = "<urn:a> <urn:p> 8 .";
    assert_eq!(erna.upload(load, "", file).json()["needs_password"], true);
    // wrong
    let wrong = erna.upload(load, "x-mes-password: d3Jvbmc=\r\n", file);
    assert_eq!(wrong.json()["needs_password"], true, "{wrong:?}");
    // correct horse battery
    let password = "x-mes-password: Y29ycmVjdCBob3JzZSBiYXR0ZXJ5\r\n";
    let loaded = erna.upload(load, password, file).json();
    assert_eq!(
        (&loaded["loaded"], &loaded["replaces"]),
        (&json!(true), &json!(true))
    );
    assert_eq!(ask(about).json()["total"], 1);
    let log = server.lines().join("\n");
    for line in [
        "refused to load a source on the page",
        "source sent from the page",
    ] {
        assert!(log.contains(line), "{line}: {log}");
    }
}
