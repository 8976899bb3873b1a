//! A plant that is set up with a single command per program: `ua-gds` invites, and each program
//! gets its certificate and trusts the others.

use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use serde_json::{Value, json};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, metrics, program};

use super::{LDS, STATUS, registered};

const GDS: &str = "opc.tcp://127.0.0.1:4841";
const SERVER: &str = "opc.tcp://127.0.0.1:4858";
const STATION_STATUS: &str = "127.0.0.1:9105";
const COMPONENT_STATUS: &str = "127.0.0.1:9106";
/// Timeout of programs that make keys and restart on a loaded machine.
const LATER: Duration = Duration::from_secs(90);

struct Site {
    cell: Cell,
    /// The certificate store of `ua-gds`.
    pki: String,
    _gds: Child,
}

impl Site {
    fn start(cell: Cell) -> Self {
        let pki = cell.folder().join("gds").to_str().unwrap().to_owned();
        let of_store = ["--pki", &pki];
        run(&[&["ca", "init", "--name", "Cell authority"], &of_store[..]].concat());
        let gds = StartedChild::new("ua-gds", &program("ua-gds"))
            .args(["--endpoint", GDS])
            .args(of_store)
            .start();
        Self {
            cell,
            pki,
            _gds: gds,
        }
    }

    /// Runs a command of an administrator.
    fn administrator(&self, verb: &[&str]) -> String {
        run(&[verb, &["--pki", &self.pki]].concat())
    }

    fn invitation(&self, application: &str) -> String {
        self.administrator(&["invite", application])
    }

    fn store(&self, name: &str) -> String {
        self.cell.folder().join(name).to_str().unwrap().to_owned()
    }
}

fn run(args: &[&str]) -> String {
    let done = Command::new(program("ua-gds")).args(args).output().unwrap();
    assert!(done.status.success(), "{args:?}: {done:?}");
    String::from_utf8(done.stdout).unwrap().trim().to_owned()
}

/// Returns the certificate in a program's status.
fn certificate(status: &str) -> Option<Value> {
    Some(metrics(status)?["certificate"].clone())
}

/// Waits until the program has a certificate of the plant; the program restarts meanwhile.
fn has_the_plants(status: &str) -> Value {
    let what = format!("{status} has a certificate of the plant");
    let shown = eventually(&what, LATER, || {
        let shown = certificate(status)?;
        (shown["made_by"] == "Cell authority").then_some(shown)
    });
    let reason = "the Global Discovery Server issued it";
    assert_eq!(shown["reason"], reason, "{shown}");
    shown
}

fn component(site: &Site, invitation: &str) -> Child {
    let example = Path::new(env!("CARGO_MANIFEST_DIR"));
    let example = example.join("../examples/plant/parallel-gripper.yaml");
    let text = fs::read_to_string(example).unwrap();
    let secured = text.replace("security: [None]", "security: [Basic256Sha256]");
    assert_ne!(text, secured);
    let file = site.cell.file("parallel-gripper.yaml", &secured);
    let invitation = site.cell.file("invitation", invitation);
    StartedChild::new("ua-component", &program("ua-component"))
        .args([&file])
        .args(["--lds", "opc.tcp://127.0.0.1:4850", "--interface", "lo"])
        .args(["--metrics", COMPONENT_STATUS])
        .args(["--pki", &site.store("gripper-pki")])
        .args(["--gds", &format!("@{}", invitation.display())])
        .start()
}

/// Starts a station that knows the Global Discovery Server by its certificate and has no token.
fn station(site: &Site) -> Child {
    let invitation = site.invitation("nobody");
    let (pinned, _token) = invitation.split_once(",token=").unwrap();
    StartedChild::new("ua-station", &program("ua-station"))
        .args(["--name", "station-a", "--interface", "lo"])
        .args(["--endpoint", "opc.tcp://127.0.0.1:4850"])
        .args(["--upper-interface", "lo", "--upper-lds", LDS])
        .args(["--upper-endpoint", "opc.tcp://127.0.0.1:4870"])
        .args(["--metrics", STATION_STATUS])
        .args(["--pki", &site.store("station-pki"), "--gds", pinned])
        .start()
}

#[test]
fn programs_that_are_invited_trust_one_another_and_others_wait_for_an_administrator() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let site = Site::start(cell);
    let lds = StartedChild::new("ua-lds", &program("ua-lds"))
        .args(["--metrics", STATUS, "--secured-only"])
        .args(["--pki", &site.store("lds-pki")])
        .env("UA_GDS", site.invitation("UA bridge discovery server"))
        .start();
    let mapping = format!("server: {{endpoint: '{SERVER}'}}\n");
    let mapping = site.cell.file("cell.yaml", &mapping);
    let invitation = site.invitation("urn:ua-bridge:server");
    let server = site.cell.ua_server(&[
        mapping.to_str().unwrap(),
        "--lds",
        LDS,
        "--gds",
        &invitation,
    ]);
    let mut station = station(&site);
    let component = component(&site, &site.invitation("urn:example:gripper"));

    station.wait_for_line("waits for an administrator", LATER);
    let shown = eventually("the station answers", LATER, || certificate(STATION_STATUS));
    assert_eq!(shown["made_by"], "itself", "{shown}");
    let listed = site.administrator(&["requests", "--json"]);
    let all = listed
        .lines()
        .map(|line| serde_json::from_str::<Value>(line).unwrap());
    let waits: Vec<Value> = all.filter(|one| one["state"] == "waits").collect();
    assert_eq!(waits.len(), 1, "{listed}");
    assert_eq!(waits[0]["name"], "station-a");
    site.administrator(&["approve", &waits[0]["request"].to_string()]);

    for status in [STATUS, COMPONENT_STATUS, system_tests::METRICS_SERVER] {
        has_the_plants(status);
    }
    let station_uri = has_the_plants(STATION_STATUS)["application_uri"].clone();
    // Registrations need secured channels, so both sides trust each other.
    for uri in ["urn:ua-bridge:server", station_uri.as_str().unwrap()] {
        eventually(&format!("{uri} is registered"), LATER, || registered(uri));
    }
    eventually("the station has the gripper", LATER, || {
        let servers = metrics(STATION_STATUS)?["servers"].clone();
        let uris = servers.as_array()?.iter().map(|one| &one["uri"]);
        uris.into_iter()
            .find(|uri| **uri == json!("urn:example:gripper"))
            .cloned()
    });
    // The status hides the reason from strangers.
    let pairs = site.store("pairs");
    let _made = site
        .cell
        .asyncua_once("opcua_access.py", &["pairs", &pairs]);
    let ways = ["--ways", "Basic256Sha256/SignAndEncrypt"];
    let tries = ["tries", SERVER, &pairs, "ns=0;i=2258", "Double", "1"];
    let tried = site
        .cell
        .asyncua_once("opcua_access.py", &[&tries[..], &ways].concat());
    assert_eq!(
        tried[0]["connected"], "BadSecurityChecksFailed",
        "{tried:?}"
    );
    // Neither the log nor the store contains a secret.
    let (_, token) = invitation.rsplit_once("token=").unwrap();
    let (_, secret) = token.split_once('-').unwrap();
    for lines in [
        lds.lines(),
        server.lines(),
        component.lines(),
        station.lines(),
    ] {
        assert!(!lines.concat().contains(secret));
    }
}
