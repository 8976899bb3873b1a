//! The knowledge for users of other hosts, by TLS.

use serde_json::Value;
use system_tests::{Cell, Peer, StartedChild, eventually, program};

use super::opcua_knowledge::{PASSWORD, add_user};
use super::{SOON, get};

#[test]
fn users_of_other_hosts_query_and_engineers_change_the_knowledge_by_tls() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let text = "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\n\
                endpoint: opc.tcp://localhost:48401\nsparql_tls: 127.0.0.1:8443\n";
    let path = cell.file("mes.yaml", text);
    add_user(&cell, "otto", "observer");
    add_user(&cell, "anna", "engineer");
    let pki = cell.folder().join("pki");
    let _mes = StartedChild::new("mes", &program("ua-mes"))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .args(["--pki", pki.to_str().unwrap()])
        .start();
    let certificate = pki.join("own/cert.der");
    eventually("the MES answers", SOON, || {
        get("/status").filter(|_| certificate.is_file())
    });
    eventually("the MES answers by TLS", SOON, || {
        std::net::TcpStream::connect("127.0.0.1:8443").ok()
    });
    let words = ["8443", certificate.to_str().unwrap(), PASSWORD];
    let seen = cell.asyncua_once("mes_tls.py", &words);
    let of = |name: &str| {
        let found = seen.iter().find(|line| line["name"] == name);
        found.cloned().unwrap_or(Value::Null)
    };
    assert_eq!(of("clear")["answered"], false, "{seen:?}");
    assert_eq!(of("stranger")["trusted"], false, "{seen:?}");
    for (version, expected) in [("TLS 1.2", "TLSv1.2"), ("TLS 1.3", "TLSv1.3")] {
        assert_eq!(of(version)["version"], expected, "{seen:?}");
    }
    // The server refuses, not the library of the client.
    let refused = of("TLS 1.1")["reason"].to_string();
    assert!(refused.contains("_ALERT_"), "{seen:?}");
    for (name, code) in [
        ("nobody", 401),
        ("wrong password", 401),
        ("other name", 421),
        ("reader", 200),
        ("reader writes", 401),
        ("engineer writes", 200),
        ("engineer puts", 201),
        ("reader queries", 200),
        ("reader gets", 200),
    ] {
        assert_eq!(of(name)["code"], code, "{name}: {seen:?}");
    }
    assert_eq!(of("reader queries")["text"], "o\r\nremote\r\n");
    let put = of("reader gets")["text"].to_string();
    assert!(put.contains("<urn:b> <urn:p>"), "{put}");
    let changes = seen.iter().filter(|line| {
        let name = line["name"].as_str().unwrap_or_default();
        name.starts_with("reader: ")
    });
    let codes: Vec<_> = changes.map(|line| line["code"].as_u64()).collect();
    assert_eq!(codes, [Some(401); 7], "{seen:?}");
    let before = of("reader gets")["text"].clone();
    assert_eq!(of("reader gets it again")["text"], before, "{seen:?}");
    // One wrong password was sent before the 30 guesses, and a minute has 20.
    let guesses = |code: u64| {
        let all = seen.iter().filter(|line| {
            let name = line["name"].as_str().unwrap_or_default();
            name.starts_with("guess ") && line["code"] == code
        });
        all.count()
    };
    let (wrong, busy, locked) = (guesses(401), guesses(503), guesses(429));
    // The others were refused without a check.
    assert_eq!((wrong, busy + locked), (19, 11), "{seen:?}");
    assert_eq!(of("locked")["code"], 429, "{seen:?}");
    // On this host without TLS, all programs may read as before.
    assert!(get("/ask/sources").is_some());
    let counted = get("/status").unwrap()["refused_passwords"].clone();
    assert_eq!(
        counted,
        serde_json::json!({"wrong": 20, "too_many": locked + 1}),
        "one wrong password before the guesses, and a request with the right one after them"
    );
}
