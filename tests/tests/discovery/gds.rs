//! The Global Discovery Server: asyncua registers applications and requests certificates, which
//! another library checks. Administrators create, issue, revoke and list with `ua-gds ca`.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};

use super::SOON;

const GDS: &str = "opc.tcp://127.0.0.1:4841";
const PASSWORD: &str = "correct horse";
/// Timeout of a peer's script on a loaded machine.
const LATER: Duration = Duration::from_secs(40);
const URI: &str = "urn:ua-bridge:system-tests:robot";

struct Site {
    cell: Cell,
    gds: Child,
}

/// Starts a server with an authority, an administrator `sara`, and a trusted client.
fn site() -> Option<Site> {
    let cell = Cell::with(&[Peer::Python])?;
    let pki = cell.folder().join("gds");
    let pki = path(&pki);
    let made = run(&cell, "ua-gds", &["ca", "init", "--name", "Cell authority"]);
    assert!(text(&made.stdout).contains("Cell authority"), "{made:?}");
    let again = run(&cell, "ua-gds", &["ca", "init"]);
    assert!(!again.status.success() && text(&again.stderr).contains("already"));
    let made = cell.asyncua_once("opcua_gds.py", &["make", GDS, path(&pairs(&cell))]);
    assert_eq!(made.len(), 1);
    let client = pairs(&cell).join("client_certificate.der");
    run(&cell, "ua-server", &["trust", path(&client)]);
    let password = cell.file("password", &format!("{PASSWORD}\n"));
    for (name, role) in [("sara", "security_admin"), ("otto", "operator")] {
        let made = Command::new(program("ua-server"))
            .args(["user", "add", name, "--role", role, "--pki", pki])
            .stdin(fs::File::open(&password).unwrap())
            .output()
            .unwrap();
        assert!(made.status.success(), "{made:?}");
    }
    let gds = StartedChild::new("ua-gds", &program("ua-gds"))
        .args(["--endpoint", GDS, "--pki", pki])
        .start();
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[GDS, "ns=0;i=2258"])
    });
    Some(Site { cell, gds })
}

fn pairs(cell: &Cell) -> std::path::PathBuf {
    cell.folder().join("pairs")
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs a command of a program on the store of the server.
fn run(cell: &Cell, name: &str, args: &[&str]) -> Output {
    let pki = cell.folder().join("gds");
    let mut command = Command::new(program(name));
    command.args(args).args(["--pki", path(&pki)]);
    command.output().unwrap()
}

fn told(cell: &Cell, args: &[&str]) -> String {
    let output = run(cell, "ua-gds", args);
    assert!(output.status.success(), "{args:?}: {output:?}");
    text(&output.stdout)
}

impl Site {
    fn asked(&self, verb: &str, more: &[&str]) -> Value {
        let folder = pairs(&self.cell);
        let args = [&[verb, GDS, path(&folder)], more].concat();
        self.cell.asyncua_once("opcua_gds.py", &args).remove(0)
    }

    fn by_sara(&self, verb: &str) -> Value {
        self.asked(verb, &["--user", "sara", "--password", PASSWORD])
    }
}

#[test]
fn applications_are_registered_found_changed_and_queried() {
    let Some(site) = site() else { return };
    let said = site.by_sara("directory");
    assert_eq!(said["registered"], 3, "{said}");
    assert_eq!(said["again"], "BadEntryExists");
    assert_eq!(said["unfit"], "BadInvalidArgument");
    assert_eq!(said["found"], json!([format!("{URI}-1")]));
    assert_eq!(said["found_names"], json!(["Robot 1"]));
    assert_eq!(
        said["updated"],
        json!(["Welder", ["DA", "HD"], ["opc.tcp://robot.cell:4840"]])
    );
    assert_eq!(
        said["first_page"],
        json!([format!("{URI}-0"), format!("{URI}-1")])
    );
    assert_eq!(said["second_page"], json!([[format!("{URI}-2")], 0]));
    assert_eq!(
        said["filtered"],
        json!([[format!("{URI}-1"), ["opc.tcp://robot.cell:4840"]]])
    );
    assert_eq!(
        said["servers"],
        json!([["Robot 2", "opc.tcp://robot.cell:4840", ["DA"]]])
    );
    assert_eq!(said["gone"], "BadNotFound");
    // Refused: a client of an unencrypted channel, an operator, and an anonymous user.
    let strangers = [
        (&["--way", "None"][..], "BadSecurityModeInsufficient"),
        (
            &[
                "--way",
                "Basic256Sha256/Sign",
                "--user",
                "sara",
                "--password",
                PASSWORD,
            ],
            "BadSecurityModeInsufficient",
        ),
        (
            &["--user", "otto", "--password", PASSWORD],
            "BadUserAccessDenied",
        ),
        (&[], "BadUserAccessDenied"),
    ];
    for (who, wanted) in strangers {
        let said = site.asked("stranger", who);
        assert_eq!(said["register"], wanted, "{who:?}: {said}");
        assert_eq!(said["open"], wanted, "{who:?}: {said}");
        assert_eq!(said["found"], json!([]), "{who:?}: {said}");
    }
}

#[test]
fn a_certificate_is_issued_used_renewed_by_its_owner_and_revoked() {
    let Some(site) = site() else { return };
    let said = site.by_sara("certificates");
    assert_eq!(said["due_before"], true, "{said}");
    assert_eq!(said["foreign_uri"], "BadInvalidArgument");
    assert_eq!(said["forged"], "BadInvalidArgument");
    assert_eq!(
        said["twice"], true,
        "an answer that was lost is given again"
    );
    assert_eq!(
        said["issued"],
        json!({
            "signed": true, "uri": [URI], "hosts": ["robot.cell"], "own_key": true, "no_private_key": true, "is_authority": false
        })
    );
    assert_eq!(said["due_after"], false);
    assert_eq!(said["kept"], json!([true]));
    assert_eq!(said["pair"], json!(["Paired", true]));
    assert_eq!(said["trust_list"], json!([15, [true], [true]]));
    assert_eq!(said["masked"], json!([1, 1, []]));
    assert_eq!(said["status"], "Good");
    assert_eq!(said["revoked"], json!([true, false]));
    assert_eq!(said["status_revoked"], "BadCertificateRevoked");
    assert_eq!(said["list_lives"], true);
    // With its issued certificate, the application is admitted and does for itself the steps that
    // sara did for it.
    let robot = ["--client", "robot", "--application-uri", URI];
    let itself = site.asked("itself", &robot);
    assert_eq!(itself["connected"], "Good", "{itself}");
    assert_eq!(itself["other"], "BadUserAccessDenied");
    assert_eq!(itself["other_host"], "BadInvalidArgument");
    assert_eq!(itself["trusted"], 1);
    assert!(itself["renewed"].is_string());
    // Administrators list the issued certificates and revoke them.
    let listed = told(&site.cell, &["ca", "list"]);
    // Three certificates of the robot and the certificate of the server itself.
    assert_eq!(listed.lines().count(), 4, "{listed}");
    assert_eq!(listed.matches("REVOKED").count(), 1, "{listed}");
    let certificate = pairs(&site.cell).join("robot_certificate.der");
    told(&site.cell, &["ca", "revoke", path(&certificate)]);
    let folder = pairs(&site.cell);
    let args = [&["itself", GDS, path(&folder)], &robot[..]].concat();
    eventually("the application is let in no longer", LATER, || {
        // A script prints nothing if its connection is closed.
        let said = site.cell.asyncua_try("opcua_gds.py", &args)?.remove(0);
        (said["connected"] != "Good").then_some(())
    });
}

#[test]
fn whom_the_authority_issued_a_certificate_is_let_in_while_nothing_is_revoked() {
    let Some(site) = site() else { return };
    // The authority's revocation list entered the server's store at the start of the server, and
    // was never replaced.
    let [key, out] = ["robot_key.pem", "robot_certificate.der"];
    let [key, out] = [key, out].map(|name| pairs(&site.cell).join(name));
    let args = ["ca", "issue", "--application-uri", URI];
    let args = [&args[..], &["--key", path(&key), "--out", path(&out)]].concat();
    told(&site.cell, &args);
    let robot = ["--client", "robot", "--application-uri", URI];
    let said = site.asked("stranger", &robot);
    assert_eq!(said["connected"], "Good", "{said}");
    assert_eq!(said["register"], "BadUserAccessDenied");
}

#[test]
fn people_issue_certificates_for_requests_and_with_keys() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let none = run(&cell, "ua-gds", &["ca", "list"]);
    assert!(text(&none.stderr).contains("ua-gds ca init"), "{none:?}");
    told(&cell, &["ca", "init"]);
    let [key, out] = ["robot.key", "robot.pem"].map(|name| cell.folder().join(name));
    let args = [
        "ca",
        "issue",
        "--application-uri",
        URI,
        "--host",
        "robot.cell",
        "--key",
        path(&key),
        "--out",
        path(&out),
    ];
    let issued = told(&cell, &args);
    assert!(issued.contains(URI), "{issued}");
    let pem = fs::read_to_string(&out).unwrap();
    assert!(pem.starts_with("-----BEGIN CERTIFICATE-----"), "{pem}");
    assert!(fs::read_to_string(&key).unwrap().contains("PRIVATE KEY"));
    let line = told(&cell, &["ca", "list", "--json"]);
    let one: Value = serde_json::from_str(line.trim()).unwrap();
    assert_eq!(one["application_uri"], URI);
    assert_eq!(one["hosts"], json!(["robot.cell"]));
    assert_eq!(one["revoked"], Value::Null);
    told(&cell, &["ca", "revoke", one["serial"].as_str().unwrap()]);
    let line = told(&cell, &["ca", "list", "--json"]);
    let one: Value = serde_json::from_str(line.trim()).unwrap();
    assert!(one["revoked"].is_string(), "{line}");
    let wrong = run(
        &cell,
        "ua-gds",
        &["ca", "issue", path(&out), "--out", path(&out)],
    );
    assert!(
        text(&wrong.stderr).contains("is not a signing request"),
        "{wrong:?}"
    );
}

/// A certificate that is nine days old and expires in a day, as in a server that was set up and
/// left alone.
#[test]
fn a_server_has_its_certificate_renewed_before_it_is_over_and_hears_what_is_revoked() {
    let Some(site) = site() else { return };
    let cell = &site.cell;
    let (uri, server) = ("urn:ua-bridge:server", "opc.tcp://127.0.0.1:4858");
    let (made, pki) = (cell.folder().join("made"), cell.folder().join("pki"));
    let said = cell.asyncua_once("opcua_access.py", &["aged", path(&made), uri]);
    assert_eq!(said.len(), 1);
    for folder in ["own", "private"] {
        fs::create_dir_all(pki.join(folder)).unwrap();
    }
    let certificate = made.join("aged_certificate.der");
    fs::copy(&certificate, pki.join("own/cert.der")).unwrap();
    fs::copy(made.join("aged_key.pem"), pki.join("private/private.pem")).unwrap();
    let trust = |file: &Path, store: &Path| {
        let trusted = Command::new(program("ua-server"))
            .args(["trust", path(file), "--pki", path(store)])
            .output()
            .unwrap();
        assert!(trusted.status.success(), "{trusted:?}");
    };
    let authority = cell.folder().join("gds/authority");
    for file in ["authority.pem", "authority.crl"] {
        trust(&authority.join(file), &pki);
    }
    trust(&cell.folder().join("gds/own/cert.der"), &pki);
    let mapping = cell.file("cell.yaml", &format!("server: {{endpoint: '{server}'}}\n"));
    let mut child = cell.ua_server(&[path(&mapping), "--gds", GDS]);
    // An unknown application receives no certificate.
    child.wait_for_line("waits for an administrator", LATER);
    let issuers = || {
        let said = cell.asyncua_try("opcua_access.py", &["endpoints", server])?;
        Some(said[0]["issuers"].clone())
    };
    assert_eq!(issuers().unwrap()[0], "aged");
    let key = fs::read(pki.join("private/private.pem")).unwrap();

    let list = fs::read(authority.join("authority.crl")).unwrap();
    told(
        cell,
        &[
            "ca",
            "issue",
            "--application-uri",
            URI,
            "--key",
            path(&made.join("gone.pem")),
            "--out",
            path(&made.join("gone.der")),
        ],
    );
    let issued = told(cell, &["ca", "list", "--json"]);
    let mut issued = issued
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    let gone = issued.find(|one| one["application_uri"] == URI).unwrap();
    told(cell, &["ca", "revoke", gone["serial"].as_str().unwrap()]);
    trust(&certificate, &cell.folder().join("gds"));
    eventually("another certificate is shown", LATER * 2, || {
        (issuers()?[0] == "Cell authority").then_some(())
    });
    assert_eq!(
        fs::read(pki.join("private/private.pem")).unwrap(),
        key,
        "the key stays"
    );
    let lists = fs::read_dir(pki.join("crl")).unwrap();
    let lists: Vec<_> = lists
        .map(|file| fs::read(file.unwrap().path()).unwrap())
        .collect();
    assert_eq!(lists.len(), 1);
    assert_ne!(lists[0], list, "what was revoked since is known");
}

#[test]
fn a_stranger_is_issued_nothing_until_an_administrator_approves_or_it_shows_its_token() {
    let Some(site) = site() else { return };
    let [first, second] = ["first", "second"].map(|name| format!("{URI}:{name}"));
    let asked = |verb: &str, name: &str, uri: &str, token: Option<&str>| {
        let named = ["--client", name, "--application-uri", uri];
        let token: Vec<&str> = token.into_iter().flat_map(|one| ["--token", one]).collect();
        site.asked(verb, &[&named[..], &token].concat())
    };
    for (name, uri) in [("first", &first), ("second", &second), ("thief", &second)] {
        asked("make", name, uri, None);
    }
    let applies = |name: &str, uri: &str, token| asked("applies", name, uri, token);
    let said = applies("first", &first, None);
    assert_eq!(said["other_key"], "BadInvalidArgument", "{said}");
    assert_eq!(said["finished"], "BadRequestNotComplete", "{said}");
    assert_eq!(said["open"], "BadUserAccessDenied", "{said}");
    let line = told(&site.cell, &["requests", "--json"]);
    let waits: Value = serde_json::from_str(line.trim()).unwrap();
    assert_eq!(waits["state"], "waits");
    assert_eq!(waits["application_uri"], first);
    assert_eq!(waits["hosts"], json!(["robot.cell"]));
    told(&site.cell, &["reject", &waits["request"].to_string()]);
    let said = applies("first", &first, None);
    assert_eq!(said["finished"], "BadUserAccessDenied", "{said}");
    told(&site.cell, &["approve", &waits["request"].to_string()]);
    let good = |said: &Value| {
        assert_eq!(said["finished"], "Good", "{said}");
        for key in ["twice", "own_key", "signed"] {
            assert_eq!(said[key], true, "{key}: {said}");
        }
        assert_eq!(said["trusted"], json!([true]), "{said}");
    };
    good(&applies("first", &first, None));

    let invitation = told(&site.cell, &["invite", &second]);
    let token = invitation.trim().rsplit_once(",token=").unwrap().1;
    let denied = |said: Value| assert_eq!(said["started"], "BadUserAccessDenied", "{said}");
    let wrong = format!("{token}0");
    denied(applies("second", &second, Some(&wrong)));
    good(&applies("second", &second, Some(token)));
    denied(applies("thief", &second, Some(token)));
    let stored = site.cell.folder().join("gds/authority/invitations.json");
    let stored = fs::read_to_string(stored).unwrap();
    let (number, secret) = token.split_once('-').unwrap();
    assert!(stored.contains(number) && !stored.contains(secret));
    let said: String = site.gds.lines().join("\n");
    assert!(said.contains(number) && !said.contains(secret), "{said}");
}
