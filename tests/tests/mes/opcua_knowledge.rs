//! The knowledge for clients of OPC UA: its methods, and the rights of their users.

use std::process::Command;

use serde_json::{Value, json};
use system_tests::{Cell, Peer, StartedChild, eventually, program};

use super::{MANIFEST, SOON, get, list};

const ENDPOINT: &str = "opc.tcp://127.0.0.1:48401";
pub(super) const PASSWORD: &str = "correct horse battery";

pub(super) fn add_user(cell: &Cell, name: &str, role: &str) {
    let password = cell.file("password", &format!("{PASSWORD}\n"));
    let made = Command::new(program("ua-server"))
        .args(["user", "add", name, "--role", role, "--pki"])
        .arg(cell.folder().join("pki"))
        .stdin(std::fs::File::open(password).unwrap())
        .output()
        .unwrap();
    assert!(made.status.success(), "{made:?}");
}

/// Makes all calls as a user, or as an anonymous user, and returns the results.
fn calls(cell: &Cell, user: Option<&str>) -> Vec<Value> {
    let pairs = cell.folder().join("client");
    let mut args = vec![ENDPOINT, "--manifest", MANIFEST];
    if let Some(user) = user {
        args.extend(["--security", "Basic256Sha256", "--user", user]);
        args.extend(["--password", PASSWORD, "--certificates"]);
        args.push(pairs.to_str().unwrap());
    }
    cell.asyncua_once("opcua_knowledge.py", &args)
}

#[test]
fn an_opcua_client_queries_the_knowledge_and_changes_it_as_an_engineer() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    let text = format!(
        "mes: mes\napplication_uri: urn:example:mes\nnamespace: 50\nendpoint: {ENDPOINT}\n\
         security: [None, Basic256Sha256]\n"
    );
    let path = cell.file("mes.yaml", &text);
    add_user(&cell, "otto", "operator");
    add_user(&cell, "anna", "engineer");
    let pki = cell.folder().join("pki");
    let _mes = StartedChild::new("mes", &program("ua-mes"))
        .args([path.to_str().unwrap(), "--interface", "lo", "--lds", "none"])
        .args(["--trust-any-client-certificate", "--pki"])
        .args([pki.to_str().unwrap()])
        .start();
    eventually("the MES answers", SOON, || get("/status"));
    for user in [None, Some("otto")] {
        let all = calls(&cell, user);
        let denied: Vec<&str> = all
            .iter()
            .filter_map(|one| one["status"].as_str())
            .collect();
        assert_eq!(denied, ["BadUserAccessDenied"; 4], "{user:?}: {all:?}");
        assert_eq!(all[0]["outputs"][0], "o\r\n", "{user:?} reads: {all:?}");
    }
    let sources = || get("/sources").unwrap()["sources"].clone();
    let before = sources();
    let all = calls(&cell, Some("anna"));
    let [_, update, cut, wrong, ask, refused, loaded, imported] = all.as_slice() else {
        panic!("{all:?}")
    };
    assert_eq!(update["outputs"], json!([3, "", "", 0]));
    let csv = "text/csv; charset=utf-8";
    let expected = json!(["o\r\n1\r\n2\r\n", csv, 2, true, "", "", 0]);
    assert_eq!(cut["outputs"], expected, "two of three rows");
    let outputs = &wrong["outputs"];
    assert_eq!((&outputs[4], &outputs[6]), (&json!("malformed"), &json!(2)));
    let answer: Value = serde_json::from_str(ask["outputs"][0].as_str().unwrap()).unwrap();
    assert_eq!(answer["boolean"], true);
    let outputs = &refused["outputs"];
    assert_eq!(
        (&outputs[3], &outputs[5]),
        (&json!("source"), &json!(2)),
        "{refused}"
    );
    for loaded in [loaded, imported] {
        assert_eq!(
            (&loaded["outputs"][0], &loaded["outputs"][3]),
            (&json!(true), &json!(""))
        );
    }
    let named = |all: &Value, name: &str| {
        list(&json!({ "all": all }), "all")
            .iter()
            .any(|one| one["name"] == name)
    };
    for name in ["b.ttl", "stage"] {
        assert!(
            !named(&before, name) && named(&sources(), name),
            "{name}: {}",
            sources()
        );
    }
}
