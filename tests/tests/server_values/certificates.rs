//! Servers with certificates issued by an authority: asyncua is each of the servers, and
//! `ua-server` their client.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::Value;
use system_tests::{Cell, Child, METRICS_SERVER, Peer, eventually, metrics, program};

const SOON: Duration = Duration::from_secs(40);
/// The names of the key pairs: each server has a pair.
const PAIRS: [&str; 6] = ["sound", "gone", "late", "elsewhere", "impostor", "stranger"];

struct Site {
    cell: Cell,
    folder: PathBuf,
    _plcs: Vec<Child>,
    server: Child,
}

/// Starts a client that trusts the authority `plant`, and six servers.
fn site() -> Option<Site> {
    let cell = Cell::with(&[Peer::Python])?;
    let folder = cell.folder().join("pairs");
    let made = cell.asyncua_once("opcua_access.py", &["servers", path(&folder)]);
    assert_eq!(made.len(), 1);
    trust(&cell, path(&folder.join("plant.der")));
    let mut servers = String::new();
    let mut variables = String::new();
    let mut plcs = Vec::new();
    for (at, pair) in PAIRS.into_iter().enumerate() {
        let url = format!("opc.tcp://127.0.0.1:{}", 4850 + at);
        let pairs = ["--only", "Basic256Sha256", "--pairs", path(&folder)];
        let uri = match pair {
            "stranger" => "urn:ua-bridge:system-tests:plc:another",
            _ => "urn:ua-bridge:system-tests:plc",
        };
        let args = [&[&*url], &pairs[..], &["--pair", pair, "--uri", uri]].concat();
        plcs.push(cell.asyncua_started("opcua_plc.py", &args).told().start());
        writeln!(
            servers,
            "  - {{name: {pair}, endpoint: '{url}', security: Basic256Sha256}}"
        )
        .unwrap();
        writeln!(
            variables,
            "  - {{node: ns=2;i={}, name: {pair}, type: Double, origin: 0, from: \
             {{server: {pair}, node: 'nsu=urn:ua-bridge:system-tests:plc;s=Line.Speed'}}}}",
            10 + at
        )
        .unwrap();
    }
    let plcs = plcs.into_iter().map(|plc| plc.ready(SOON)).collect();
    let mapping = format!(
        "namespaces: {{2: 'urn:ua-bridge:system-tests'}}\nservers:\n{servers}variables:\n{variables}"
    );
    let file = cell.file("certificates.yaml", &mapping);
    let server = cell.ua_server(&[path(&file)]);
    Some(Site {
        cell,
        folder,
        _plcs: plcs,
        server,
    })
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn trust(cell: &Cell, what: &str) {
    let pki = cell.folder().join("pki");
    let told = Command::new(program("ua-server"))
        .args(["trust", what, "--pki", path(&pki)])
        .output()
        .unwrap();
    assert!(told.status.success(), "{told:?}");
}

impl Site {
    fn takes(&self, file: &str) {
        trust(&self.cell, path(&self.folder.join(file)));
    }
}

/// Waits until the link to a server satisfies `pick`, and returns its status.
fn link(name: &str, what: &str, pick: impl Fn(&Value) -> bool) -> Value {
    eventually(&format!("{name}: {what}"), SOON, || {
        let told = metrics(METRICS_SERVER)?["servers"].clone();
        let one = told
            .as_array()?
            .iter()
            .find(|one| one["name"] == name)?
            .clone();
        pick(&one).then_some(one)
    })
}

fn is_refused(name: &str, status: &str, help: &str) -> Value {
    link(name, status, |one| {
        let why = one["why"].as_str().unwrap_or_default();
        one["up"] == false && why.contains(status) && why.contains(help)
    })
}

fn is_secured(name: &str) {
    link(name, "secured", |one| {
        one["up"] == true && one["secured"] == true
    });
}

#[test]
fn a_server_is_connected_to_by_its_authority_and_each_fault_has_its_status_and_its_remedy() {
    let Some(mut site) = site() else { return };
    is_refused(
        "sound",
        "BadCertificateRevocationUnknown",
        "ua-server trust FILE.crl --pki",
    );
    site.takes("plant.crl");
    is_secured("sound");
    for (name, status, help) in [
        ("gone", "BadCertificateRevoked", "needs another certificate"),
        ("late", "BadCertificateTimeInvalid", "renew the certificate"),
        ("elsewhere", "BadCertificateHostNameInvalid", "192.0.2.7"),
        ("impostor", "BadCertificateUriInvalid", "plc:another"),
        ("stranger", "BadCertificateChainIncomplete", "\"strange\""),
    ] {
        let told = is_refused(name, status, help);
        assert!(told["certificates_refused"].as_u64() > Some(0), "{told}");
    }
    site.server.wait_for_line("BadCertificateRevoked", SOON);
    // The message has the command to trust the server.
    let told = is_refused(
        "stranger",
        "BadCertificateChainIncomplete",
        "to trust only this certificate: `",
    );
    let why = told["why"].as_str().unwrap();
    let (_, command) = why.rsplit_once("`ua-server trust ").unwrap();
    let (digits, _) = command.split_once(' ').unwrap();
    trust(&site.cell, digits);
    is_secured("stranger");
    // An open connection ends when its certificate is revoked.
    site.takes("plant-now.crl");
    is_refused(
        "sound",
        "BadCertificateRevoked",
        "needs another certificate",
    );
}
