//! NodeSets that `ua-mes` fetches by their namespaces from an HTTP server of Python.

use std::fs;
use std::path::PathBuf;

use nix::sys::signal::Signal;
use serde_json::Value;
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};

use super::{SOON, get, list, space};

/// NodeSets of the types of a plant: `machines.xml` requires `devices.xml`.
const NODESETS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/nodesets");
const MACHINES: &str = "urn:ua-bridge:test:machines";
const DEVICES: &str = "urn:ua-bridge:test:devices";
const OPC_UA: &str = "http://opcfoundation.org/UA/";
/// The base64 of `anna:secret`.
const USER: &str = "Basic YW5uYTpzZWNyZXQ=";

fn node_set(namespace: &str, required: &[&str]) -> String {
    let required = required.iter();
    let required: String = required
        .map(|other| format!("<RequiredModel ModelUri=\"{other}\"/>"))
        .collect();
    format!(
        "<UANodeSet><NamespaceUris><Uri>{namespace}</Uri></NamespaceUris>\
         <Models><Model ModelUri=\"{namespace}\">{required}</Model></Models></UANodeSet>"
    )
}

/// A MES with `machines.xml`, and a folder with the files of a server.
struct Site<'c> {
    cell: &'c Cell,
    served: PathBuf,
}

impl<'c> Site<'c> {
    fn new(cell: &'c Cell) -> Self {
        let served = cell.folder().join("served");
        fs::create_dir(&served).unwrap();
        fs::copy(
            format!("{NODESETS}/devices.xml"),
            served.join("devices.xml"),
        )
        .unwrap();
        fs::write(served.join("ua.xml"), node_set(OPC_UA, &[])).unwrap();
        Self { cell, served }
    }

    fn mes(&self, url: &str) -> StartedChild {
        let text = format!(
            "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
             nodesets: ['{NODESETS}/machines.xml']\nnodeset_folder: '{url}'\n"
        );
        let path = self.cell.file("mes.yaml", &text);
        StartedChild::new("ua-mes", &program("ua-mes")).args([
            path.to_str().unwrap(),
            "--interface",
            "lo",
            "--lds",
            "none",
        ])
    }

    /// Starts the server at a port.
    fn server(&self, port: &str, args: &[&str]) -> Child {
        let folder = self.served.to_str().unwrap();
        let args = [&[folder, port], args].concat();
        self.cell.asyncua("nodeset_server.py", &args)
    }
}

/// Returns the reasons that the MES gives for missing NodeSets.
fn findings() -> Option<Vec<String>> {
    let status = get("/status")?;
    let findings = list(&status, "findings").iter();
    let whats = findings.map(|found| found["what"].as_str().unwrap_or_default().to_owned());
    Some(whats.collect())
}

/// Waits for a finding that contains these texts, and returns it.
fn finding(texts: &[&str]) -> String {
    eventually(&format!("a finding has {texts:?}"), SOON, || {
        let is_meant = |what: &String| texts.iter().all(|text| what.contains(text));
        findings()?.into_iter().find(is_meant)
    })
}

/// Waits until the graph has the NodeSets of these namespaces, and there are no findings.
fn are_there(namespaces: &[&str]) {
    eventually("the NodeSets are there without findings", SOON, || {
        let status = get("/status")?;
        let graphs = list(&status, "graphs");
        let is_there = |name: &&str| graphs.iter().any(|graph| graph["name"] == **name);
        let are_there = namespaces.iter().all(is_there);
        (are_there && findings()?.is_empty()).then_some(())
    });
}

/// Returns the requests that the server has received, with their users.
fn requests(server: &Child) -> Vec<(String, Option<String>)> {
    let lines = server.json_lines();
    let requests = lines.iter().filter_map(|line| {
        let user = line["user"].as_str().map(str::to_owned);
        Some((line["path"].as_str()?.to_owned(), user))
    });
    requests.collect()
}

fn add(cell: &Cell, name: &str, text: &str) {
    let file = cell.file(name, text);
    let (added, told) = space(&["source", "add", file.to_str().unwrap()]);
    assert!(added, "{told}");
}

#[test]
fn nodesets_come_from_a_server_by_their_namespaces_and_outlast_a_restart() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let site = Site::new(&cell);
    let mut wrong = site
        .mes("http://127.0.0.1:8090/sets/")
        .args(["--check"])
        .start();
    assert_eq!(wrong.wait_for_end(SOON).code(), Some(78));
    assert!(
        wrong.to_string().contains("the URL has no {uri}"),
        "{wrong}"
    );

    let store = cell.folder().join("store");
    let url = "http://anna:secret@127.0.0.1:8090/sets/{uri}.xml?key=secret";
    let start = || {
        let store = store.to_str().unwrap();
        site.mes(url).args(["--store", store]).start()
    };
    // The program starts without the server.
    let mes = start();
    let shown = "cannot be fetched from http://127.0.0.1:8090/sets/{uri}.xml: no connection";
    finding(&[MACHINES, DEVICES, shown]);
    let server = site.server("8090", &[]);
    mes.signal(Signal::SIGHUP);
    are_there(&[MACHINES, DEVICES, OPC_UA]);
    let devices = "/sets/urn%3Aua-bridge%3Atest%3Adevices.xml?key=secret";
    let expected = [
        "/sets/http%3A%2F%2Fopcfoundation.org%2FUA%2F.xml?key=secret",
        devices,
    ];
    let expected = expected.map(|path| (path.to_owned(), Some(USER.to_owned())));
    assert_eq!(
        requests(&server),
        expected,
        "each namespace is fetched once"
    );

    // A NodeSet that is added is completed too; neither it nor a query waits for the server.
    add(&cell, "silent.xml", &node_set("urn:a", &["urn:silent"]));
    finding(&["urn:a requires urn:silent, which is fetched from"]);
    eventually("the server is asked", SOON, || {
        let mut asked = requests(&server).into_iter();
        asked.any(|(of, _)| of.contains("silent")).then_some(())
    });
    assert!(get("/ask/components").is_some());
    let (removed, told) = space(&["source", "remove", "nodeset", "urn:a"]);
    assert!(removed, "{told}");
    drop((mes, server));

    let _mes = start();
    are_there(&[MACHINES, DEVICES, OPC_UA]);
}

#[test]
fn what_a_server_does_not_have_is_a_finding() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let site = Site::new(&cell);
    let server = site.server("8090", &[]);
    let mes = site.mes("http://127.0.0.1:8090/sets/{uri}.xml").start();
    are_there(&[MACHINES, DEVICES, OPC_UA]);
    let wanted = ["urn:none", "urn:moved", "urn:late"];
    add(&cell, "a.xml", &node_set("urn:a", &wanted));
    finding(&["urn:a requires urn:none", "the response is 404 Not Found"]);
    finding(&[
        "urn:a requires urn:moved",
        "302 Found, a redirection, which is not followed",
    ]);
    finding(&["urn:a requires urn:late", "404"]);
    let late = node_set("urn:late", &["urn:later"]);
    fs::write(site.served.join("late.xml"), late).unwrap();
    let later = node_set("urn:later", &[]);
    fs::write(site.served.join("later.xml"), later).unwrap();
    add(&cell, "b.xml", &node_set("urn:b", &["urn:later"]));
    eventually("it is fetched", SOON, || {
        let paths = requests(&server);
        paths
            .iter()
            .any(|(path, _)| path.contains("later"))
            .then_some(())
    });
    finding(&["urn:a requires urn:late", "404"]);
    mes.signal(Signal::SIGHUP);
    eventually("the signal fetches what was missing", SOON, || {
        let whats = findings()?;
        let is_late = |what: &String| what.contains("urn:late");
        (!whats.is_empty() && !whats.iter().any(is_late)).then_some(())
    });
}

#[test]
fn an_index_is_fetched_over_tls_from_a_server_with_a_trusted_certificate_only() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let site = Site::new(&cell);
    cell.broker_certificates();
    let file = |name: &str| cell.folder().join(name).to_str().unwrap().to_owned();
    let index = serde_json::json!({ DEVICES: "devices.xml", OPC_UA: "/ua.xml" });
    fs::write(site.served.join("nodesets.json"), index.to_string()).unwrap();
    let pair = [file("broker.pem"), file("broker.key")];
    let args = ["--certificate", &pair[0], "--key", &pair[1]];
    let server = site.server("8443", &args);
    let url = "https://127.0.0.1:8443/nodesets.json";
    let mes = |authorities: &str| site.mes(url).env("SSL_CERT_FILE", authorities).start();

    // This certificate is not that of the authority of the server.
    fs::copy(file("client.pem"), file("other.pem")).unwrap();
    let untrusting = mes(&file("other.pem"));
    finding(&[MACHINES, DEVICES, url, "no secure connection"]);
    let paths = requests(&server);
    assert!(paths.is_empty(), "nothing is requested: {paths:?}");
    drop(untrusting);

    let _mes = mes(&file("ca.pem"));
    are_there(&[MACHINES, DEVICES, OPC_UA]);
    let paths = requests(&server).into_iter().map(|(path, _)| path);
    let paths: Vec<Value> = paths.map(Value::from).collect();
    assert_eq!(paths, ["/nodesets.json", "/ua.xml", "/devices.xml"]);
}
