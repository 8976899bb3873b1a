//! Access control: users, roles, certificates, and the commands that manage them, checked with
//! asyncua.

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::{fs, io::Write as _};

use serde_json::{Value, json};
use system_tests::{
    Cell, Child, Executes, Executor, HERE, Peer, SERVER_ENDPOINT, eventually, program,
};

use super::SOON;

const SETPOINT: &str = "ns=2;i=30";
const LIMIT: &str = "ns=2;i=31";
pub(super) const PASSWORD: &str = "correct horse battery";
const SECURED: &str = "Basic256Sha256/Sign,Basic256Sha256/SignAndEncrypt,Aes128_Sha256_RsaOaep/Sign,\
    Aes128_Sha256_RsaOaep/SignAndEncrypt,Aes256_Sha256_RsaPss/Sign,Aes256_Sha256_RsaPss/SignAndEncrypt";

/// A mapping without security settings.
const MAPPING: &str = "
namespaces:
  2: urn:ua-bridge:system-tests
variables:
  - {node: ns=2;i=30, name: setpoint, type: Double, origin: 0, range: [0, 10]}
  - {node: ns=2;i=31, name: limit, type: Double, origin: 0, permissions: {write: engineer}}
";

pub(super) struct AccessSite {
    pub(super) cell: Cell,
    pub(super) server: Child,
}

impl AccessSite {
    pub(super) fn with(mapping: &str, args: &[&str]) -> Option<Self> {
        Some(Self::of(Cell::with(&[Peer::Python])?, mapping, args))
    }

    fn of(cell: Cell, mapping: &str, args: &[&str]) -> Self {
        let pairs = cell.folder().join("pairs");
        let made = cell.asyncua_once("opcua_access.py", &["pairs", path(&pairs)]);
        assert_eq!(made.len(), 1);
        let file = cell.file("access.yaml", mapping);
        let server = cell.ua_server(&[&[path(&file)], args].concat());
        let site = Self { cell, server };
        eventually("the server answers clients", SOON, || {
            site.cell
                .asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
        });
        site
    }

    /// Runs a command with a line for its standard input.
    fn verb(&self, args: &[&str], line: &str) -> Output {
        verb(&self.cell, args, line)
    }

    pub(super) fn told(&self, args: &[&str], line: &str) -> String {
        let output = self.verb(args, line);
        let told = String::from_utf8(output.stdout).unwrap();
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{args:?}: {error}");
        told
    }

    pub(super) fn tries(&self, node: &str, ways: &str, users: &str, more: &[&str]) -> Vec<Value> {
        let folder = self.cell.folder().join("pairs");
        let fixed = ["tries", SERVER_ENDPOINT, path(&folder), node, "Double", "5"];
        let named = [
            "--ways",
            ways,
            "--users",
            users,
            "--user",
            "anna",
            "--password",
            PASSWORD,
        ];
        let args = [&fixed[..], &named[..], more].concat();
        self.cell.asyncua_once("opcua_access.py", &args)
    }

    /// Returns the outcome of a single try.
    fn tried(&self, node: &str, way: &str, user: &str) -> Value {
        self.tries(node, way, user, &[]).remove(0)
    }

    pub(super) fn pair(&self, name: &str) -> String {
        let file = self
            .cell
            .folder()
            .join(format!("pairs/{name}_certificate.der"));
        path(&file).to_owned()
    }
}

pub(super) fn verb(cell: &Cell, args: &[&str], line: &str) -> Output {
    let mut child = Command::new(program("ua-server"))
        .args(args)
        .arg("--pki")
        .arg(cell.folder().join("pki"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // A command that reads no password may have ended.
    let _unread = child.stdin.take().unwrap().write_all(line.as_bytes());
    child.wait_with_output().unwrap()
}

pub(super) fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn outcome(tried: &Value) -> [&str; 3] {
    ["connected", "read", "write"].map(|key| tried[key].as_str().unwrap_or("-"))
}

const NEVER: &str = "BadWaitingForInitialData";

#[test]
fn each_policy_takes_each_kind_of_user_and_each_may_do_what_its_role_may() {
    let Some(site) = AccessSite::with(MAPPING, &["--trust-any-client-certificate"]) else {
        return;
    };
    // Without users, every client on this host has the rights of an operator.
    let first = site.tried(SETPOINT, "None", "anonymous");
    assert_eq!(outcome(&first), ["Good", NEVER, "Good"]);
    let first = site.tried(LIMIT, "None", "anonymous");
    assert_eq!(outcome(&first), ["Good", NEVER, "BadUserAccessDenied"]);

    site.told(&["user", "add", "anna", "--role", "operator"], PASSWORD);
    let certificate = site.pair("user");
    site.told(
        &[
            "user",
            "add",
            "plc",
            "--role",
            "engineer",
            "--certificate",
            &certificate,
        ],
        "",
    );
    eventually("anonymous users only read", SOON, || {
        let tried = site.tried(SETPOINT, "None", "anonymous");
        (outcome(&tried) == ["Good", "Good", "BadUserAccessDenied"]).then_some(())
    });
    let users = "anonymous,password,certificate,wrong,nobody,old";
    let ways = SECURED.split(',');
    let tries: Vec<Value> = ways
        .flat_map(|way| site.tries(SETPOINT, way, users, &[]))
        .collect();
    assert_eq!(tries.len(), 36);
    for tried in &tries {
        let wanted = match tried["user"].as_str().unwrap() {
            "anonymous" => ["Good", "Good", "BadUserAccessDenied"],
            "password" | "certificate" => ["Good", "Good", "Good"],
            "old" => ["BadIdentityTokenRejected", "-", "-"],
            _ => ["BadUserAccessDenied", "-", "-"],
        };
        assert_eq!(outcome(tried), wanted, "{tried}");
    }
    // Nodes that only engineers may write.
    let way = "Aes256_Sha256_RsaPss/SignAndEncrypt";
    for (user, write) in [
        ("anonymous", "BadUserAccessDenied"),
        ("password", "BadUserAccessDenied"),
        ("certificate", "Good"),
    ] {
        assert_eq!(site.tried(LIMIT, way, user)["write"], write, "{user}");
    }
    // A user name and password are not sent unencrypted.
    let clear = site.tried(SETPOINT, "None", "password");
    assert_ne!(clear["connected"], "Good", "{clear}");
}

/// Checked with node-opcua, which creates its signatures and secrets with another library.
#[test]
fn node_opcua_comes_in_by_each_policy_and_kind_of_user() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let site = AccessSite::of(cell, MAPPING, &["--trust-any-client-certificate"]);
    site.told(&["user", "add", "anna", "--role", "operator"], PASSWORD);
    let certificate = site.pair("user");
    let engineer = ["user", "add", "plc", "--role", "engineer", "--certificate"];
    site.told(&[&engineer[..], &[&certificate]].concat(), "");
    eventually("anonymous users only read", SOON, || {
        (site.tried(LIMIT, "None", "anonymous")["write"] == "BadUserAccessDenied").then_some(())
    });
    let folder = site.cell.folder().join("pairs");
    let users = "anonymous,password,certificate,wrong,nobody";
    for way in SECURED.split(',') {
        let args = [
            SERVER_ENDPOINT,
            path(&folder),
            LIMIT,
            "5",
            way,
            users,
            "anna",
            PASSWORD,
        ];
        let tries = site.cell.node_opcua_once("access.js", &args);
        assert_eq!(tries.len(), 5, "{way}");
        for tried in &tries {
            let wanted = match tried["user"].as_str().unwrap() {
                "anonymous" | "password" => [&json!("Good"), &json!("BadUserAccessDenied")],
                "certificate" => [&json!("Good"), &json!("Good")],
                _ => [&json!("BadUserAccessDenied"), &Value::Null],
            };
            assert_eq!([&tried["connected"], &tried["write"]], wanted, "{tried}");
        }
    }
}

#[test]
fn who_came_in_wrote_and_was_refused_is_audited() {
    let Some(site) = AccessSite::with(MAPPING, &["--trust-any-client-certificate"]) else {
        return;
    };
    site.told(&["user", "add", "anna", "--role", "operator"], PASSWORD);
    eventually("anna is let in", SOON, || {
        let tried = site.tried(SETPOINT, "Basic256Sha256/SignAndEncrypt", "password");
        (tried["write"] == "Good").then_some(())
    });
    let mut audit = site
        .cell
        .asyncua("opcua_access.py", &["audit", SERVER_ENDPOINT]);
    let way = "Basic256Sha256/SignAndEncrypt";
    for (node, user) in [
        (SETPOINT, "password"),
        (LIMIT, "password"),
        (SETPOINT, "wrong"),
    ] {
        let tried = site.tried(node, way, user);
        assert!(tried["connected"].is_string(), "{tried}");
    }
    let mut told = |kind: &str, user: &str, ended: bool| {
        audit.wait_for_json(&format!("{kind} of {user}: {ended}"), SOON, |line| {
            let same = line.get("EventType")? == kind
                && line["ClientUserId"] == user
                && line["Status"] == ended;
            same.then(|| line.clone())
        })
    };
    let (came, wrote) = ("AuditActivateSessionEventType", "AuditWriteUpdateEventType");
    assert_eq!(
        told(came, "anna", true)["SourceName"],
        "Session/ActivateSession"
    );
    let written = told(wrote, "anna", true);
    assert_eq!(
        [&written["OldValue"], &written["NewValue"]],
        [5.0, 5.0],
        "{written}"
    );
    assert_eq!(written["ServerId"], "urn:ua-bridge:server");
    assert_eq!(told(wrote, "anna", false)["SourceName"], "Attribute/Write");
    let refused = told(came, "anna", false);
    assert!(!refused.to_string().contains("another one"), "{refused}");
}

#[test]
fn more_sessions_than_there_may_be_are_refused_and_those_of_killed_clients_make_room() {
    let mapping =
        format!("{MAPPING}server:\n  limits: {{sessions: 100, sessions_per_address: 100}}\n");
    let Some(site) = AccessSite::with(&mapping, &[]) else {
        return;
    };
    let crowd = |count: &str, more: &[&str]| {
        let args = [&["crowd", SERVER_ENDPOINT, count], more].concat();
        site.cell.asyncua_once("opcua_access.py", &args).remove(0)
    };
    let came = crowd("200", &[]);
    assert_eq!(came["Good"], 100, "{came}");
    // A session that is created before another session is activated takes its place.
    let refused = ["BadTooManySessions", "BadSessionIdInvalid"];
    let refused: u64 = refused.iter().filter_map(|name| came[name].as_u64()).sum();
    assert_eq!(refused, 100, "{came}");
    assert_eq!(crowd("100", &["--vanish"]), json!({"Good": 100}));
    eventually("there is room for as many again", SOON, || {
        (crowd("100", &[]) == json!({"Good": 100})).then_some(())
    });
    assert_eq!(site.tried(SETPOINT, "None", "anonymous")["write"], "Good");
}

#[test]
fn a_client_is_let_in_by_the_command_that_the_log_names_and_refused_by_another() {
    let Some(mut site) = AccessSite::with(MAPPING, &[]) else {
        return;
    };
    let way = "Basic256Sha256/SignAndEncrypt";
    let refused = site.tried(SETPOINT, way, "anonymous");
    assert_eq!(refused["connected"], "BadCertificateUntrusted");

    let told = site
        .server
        .wait_for_line("certificate is not trusted", SOON);
    assert!(told.contains("urn:ua-bridge:system-tests:client"), "{told}");
    let command = told.split('`').nth(1).unwrap();
    let thumbprint = command.strip_prefix("ua-server trust ").unwrap();
    let thumbprint = thumbprint.split(' ').next().unwrap().to_owned();

    let listed = site.told(&["certificates", "--json"], "");
    let listed: Vec<Value> = listed
        .lines()
        .map(|line| serde_json::from_str(line).unwrap())
        .collect();
    let standings: Vec<&Value> = listed.iter().map(|one| &one["standing"]).collect();
    assert_eq!(standings, [&json!("own"), &json!("rejected")]);
    assert!(
        listed[1]["thumbprint"]
            .as_str()
            .unwrap()
            .starts_with(&thumbprint)
    );

    site.told(&["trust", &thumbprint], "");
    assert_eq!(site.tried(SETPOINT, way, "anonymous")["connected"], "Good");
    site.told(&["reject", &thumbprint], "");
    let refused = site.tried(SETPOINT, way, "anonymous");
    assert_eq!(refused["connected"], "BadSecurityChecksFailed");

    let unknown = site.verb(&["trust", "ffffffff"], "");
    assert_eq!(unknown.status.code(), Some(64));
    assert!(String::from_utf8_lossy(&unknown.stderr).contains("ffffffff"));
}

#[test]
fn a_certificate_that_is_over_or_of_another_application_is_refused_with_its_status() {
    let Some(site) = AccessSite::with(MAPPING, &[]) else {
        return;
    };
    for name in ["client", "expired"] {
        site.told(&["trust", &site.pair(name)], "");
    }
    let way = "Basic256Sha256/SignAndEncrypt";
    assert_eq!(
        site.tries(SETPOINT, way, "anonymous", &["--client", "expired"])[0]["connected"],
        "BadCertificateTimeInvalid"
    );
    let other = ["--application-uri", "urn:somebody:else"];
    let tried = site.tries(SETPOINT, way, "anonymous", &other).remove(0);
    assert_eq!(tried["connected"], "BadCertificateUriInvalid", "{tried}");
    assert_eq!(site.tried(SETPOINT, way, "anonymous")["write"], "Good");
}

#[test]
fn a_value_outside_its_range_does_not_go_out() {
    let Some(site) = AccessSite::with(MAPPING, &[]) else {
        return;
    };
    let write = |value: &str| {
        let args = [SERVER_ENDPOINT, SETPOINT, "Double", value];
        site.cell.asyncua_once("opcua_write.py", &args)[0]["status"].clone()
    };
    assert_eq!(write("10.5"), "BadOutOfRange");
    assert_eq!(write("-0.1"), "BadOutOfRange");
    let read = site
        .cell
        .asyncua_once("opcua_read.py", &[SERVER_ENDPOINT, SETPOINT]);
    assert_eq!(read[0]["status"], NEVER);
    assert_eq!(write("10"), "Good");
}

#[test]
fn permissions_and_users_are_others_without_a_restart() {
    let Some(site) = AccessSite::with(MAPPING, &["--trust-any-client-certificate"]) else {
        return;
    };
    let way = "Basic256Sha256/SignAndEncrypt";
    site.told(&["user", "add", "anna", "--role", "operator"], PASSWORD);
    let writes = |node: &'static str, wanted: &'static str| {
        eventually(&format!("{node}: {wanted}"), SOON, || {
            (site.tried(node, way, "password")["write"] == wanted).then_some(())
        });
    };
    writes(SETPOINT, "Good");
    writes(LIMIT, "BadUserAccessDenied");
    let _written = site.cell.file(
        "access.yaml",
        &MAPPING.replace("{write: engineer}", "{write: [operator]}"),
    );
    writes(LIMIT, "Good");
    site.told(&["user", "role", "anna", "observer"], "");
    writes(LIMIT, "BadUserAccessDenied");
    site.told(&["user", "remove", "anna"], "");
    eventually("anna is not let in", SOON, || {
        (site.tried(LIMIT, way, "password")["connected"] == "BadUserAccessDenied").then_some(())
    });
    let listed = site.told(&["user", "list"], "");
    assert_eq!(listed, "");
}

#[test]
fn a_file_of_users_that_others_can_read_keeps_the_server_from_starting() {
    use std::os::unix::fs::PermissionsExt as _;
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let added = verb(
        &cell,
        &["user", "add", "anna", "--role", "operator"],
        PASSWORD,
    );
    assert!(added.status.success());
    let list = cell.folder().join("pki/users/list");
    assert_eq!(
        fs::metadata(&list).unwrap().permissions().mode() & 0o777,
        0o600
    );
    fs::set_permissions(&list, fs::Permissions::from_mode(0o640)).unwrap();
    let mut server = cell.ua_server_started(&[]).start();
    let told = server.wait_for_line("chmod 600", SOON);
    assert!(told.contains("pki/users/list"), "{told}");
    assert_eq!(server.wait_for_end(SOON).code(), Some(78));
}

#[test]
fn what_other_hosts_reach_is_secured_unless_the_mapping_says_otherwise() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let cable = cell.cable();
    cable.lay(HERE);
    let endpoint = format!("opc.tcp://{HERE}:4840");
    for (text, policies) in [("{}", 3), ("server: {security: [None, Basic256Sha256]}", 2)] {
        let file = cell.file("open.yaml", text);
        let mut server = cell.ua_server(&[path(&file), "--endpoint", &endpoint]);
        let offered = eventually("the endpoints are told", SOON, || {
            let args = ["endpoints", &endpoint];
            cell.asyncua_try("opcua_access.py", &args)?.pop()
        });
        let mut offered: Vec<String> = offered["policies"]
            .as_array()
            .unwrap()
            .iter()
            .map(|one| one.as_str().unwrap().to_owned())
            .collect();
        offered.sort();
        offered.dedup();
        assert_eq!(offered.len(), policies, "{offered:?}");
        assert_eq!(offered.contains(&"None".to_owned()), policies == 2);
        server.end();
    }
}

#[test]
fn who_may_not_call_is_told_so_nothing_is_executed_and_calls_are_audited() {
    let mapping = "
namespaces:
  2: urn:ua-bridge:system-tests
spaces:
  - id: 1
calls:
  - node: ns=2;i=61
    name: Grip
    origin: 1
    permissions: {call: engineer}
    ros: {service: /grip, type: std_srvs/Trigger}
";
    let Some(site) = AccessSite::with(mapping, &["--trust-any-client-certificate"]) else {
        return;
    };
    let executor = Executor::start((1, 2, 61), "Grip", Executes::AtOnce, 1);
    site.told(&["user", "add", "anna", "--role", "operator"], PASSWORD);
    let certificates = site.cell.folder().join("caller");
    let secured = [
        "--security",
        "Basic256Sha256",
        "--certificates",
        path(&certificates),
    ];
    let anna = [&secured[..], &["--user", "anna", "--password", PASSWORD]].concat();
    let called = |who: &[&str]| {
        let args = [SERVER_ENDPOINT, "UaSpace/Calls/Grip", "--value", "[]"];
        let told = site
            .cell
            .asyncua_try("opcua_call.py", &[&args[..], who].concat())?;
        Some(told.last()?["status"].clone())
    };
    let becomes = |who: &[&str], wanted: &str| {
        eventually(&format!("a call of {who:?} is {wanted}"), SOON * 2, || {
            (called(who)? == wanted).then_some(())
        });
    };
    let mut audit = site
        .cell
        .asyncua("opcua_access.py", &["audit", SERVER_ENDPOINT]);
    let mut told = |user: &str, done: bool| {
        audit.wait_for_json(&format!("a call of {user}: {done}"), SOON, |line| {
            let same = line.get("EventType")? == "AuditUpdateMethodEventType"
                && line["ClientUserId"] == user
                && line["Status"] == done;
            same.then(|| line.clone())
        })
    };
    let refused = "BadUserAccessDenied";
    becomes(&anna, refused);
    becomes(&secured, refused);
    assert_eq!(executor.executed(), 0);
    let audited = told("anna", false);
    let method = audited["MethodId"].as_str().unwrap();
    assert!(
        method.contains("Identifier=61, NamespaceIndex=2"),
        "{audited}"
    );

    site.told(&["user", "role", "anna", "engineer"], "");
    becomes(&anna, "Good");
    assert_eq!(executor.executed(), 1);
    assert_eq!(told("anna", true)["SourceName"], "Attribute/Call");
}
