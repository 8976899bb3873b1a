//! Keys of a Security Key Service: ua-server creates, distributes and rotates them, and the bridges
//! use them.

use std::fs;

use serde_json::{Value, json};
use system_tests::{
    Cell, Child, METRICS_ROS1, METRICS_ROS2, METRICS_SERVER, Peer, SERVER_ENDPOINT, eventually,
    http_answer, metrics,
};

use super::{SOON, TOPIC, dropped, path, token};

const METHOD: &str = "Server/PublishSubscribe/GetSecurityKeys";

/// Writes a mapping of a cell with a server that creates the keys with the settings `sks`.
fn mapping(cell: &Cell, sks: &str) -> String {
    let text = format!("security: [{{group: cell, keys: {{sks: {sks}}}}}]\n");
    path(&cell.file("cell.yaml", &text)).to_owned()
}

fn server(cell: &Cell, mapping: &str) -> Child {
    let server = cell.ua_server(&[mapping, "--trust-any-client-certificate"]);
    eventually("the server answers clients", SOON, || {
        cell.asyncua_try("opcua_read.py", &[SERVER_ENDPOINT, "ns=0;i=2258"])
    });
    server
}

/// Creates the certificate store of a program that trusts the server, once the server has a
/// certificate.
fn store(cell: &Cell, program: &str) -> String {
    let store = cell.folder().join(format!("pki-{program}"));
    fs::create_dir_all(store.join("trusted")).unwrap();
    let own = cell.folder().join("pki/own/cert.der");
    fs::copy(own, store.join("trusted/server.der")).unwrap();
    path(&store).to_owned()
}

/// Requests keys with asyncua. Returns the status and the output arguments of the service.
fn asked(cell: &Cell, security: &str, arguments: &Value) -> Value {
    let certificates = cell.folder().join("client");
    let told = cell.asyncua_once(
        "opcua_call.py",
        &[
            SERVER_ENDPOINT,
            "--security",
            security,
            "--certificates",
            path(&certificates),
            METHOD,
            "--value",
            &arguments.to_string(),
        ],
    );
    told.last().cloned().unwrap()
}

#[test]
fn clients_of_other_makers_get_the_keys_that_they_may_have_over_sessions_nobody_can_listen_to() {
    let Some(cell) = Cell::with(&[Peer::Python, Peer::NodeOpcua]) else {
        return;
    };
    let mapping = mapping(&cell, r#"{key_lifetime: 10min, members: ["urn:*"]}"#);
    let _server = server(&cell, &mapping);
    let keys = asked(&cell, "Basic256Sha256", &json!(["cell", 0, 2]));
    assert_eq!(keys["status"], "Good", "{keys}");
    let value = keys["value"].as_array().unwrap();
    assert_eq!(
        value[0],
        "http://opcfoundation.org/UA/SecurityPolicy#PubSub-Aes256-CTR"
    );
    assert_eq!(value[1], 1);
    let given = value[2].as_array().unwrap();
    assert_eq!(given.len(), 3, "the current one and two to come");
    assert_ne!(given[0], given[1]);
    let next = value[3].as_f64().unwrap();
    assert!(next > 0.0 && next <= 600_000.0, "{next}");
    assert_eq!(value[4], 600_000.0);

    // Refused clients learn nothing but the status.
    for (security, arguments, status) in [
        ("None", json!(["cell", 0, 2]), "BadSecurityModeInsufficient"),
        ("Basic256Sha256", json!(["plant", 0, 2]), "BadNotFound"),
        ("Basic256Sha256", json!(["cell"]), "BadArgumentsMissing"),
        (
            "Basic256Sha256",
            json!([{"Int32": 5}, 0, 2]),
            "BadInvalidArgument",
        ),
    ] {
        let refused = asked(&cell, security, &arguments);
        assert_eq!(refused["status"], status, "{arguments}");
        assert_eq!(refused["value"], json!([]), "{refused}");
    }
    let node = |mode: &str, starting: &str, count: &str| {
        let arguments = [SERVER_ENDPOINT, mode, "cell", starting, count];
        cell.node_opcua_once("keys.js", &arguments).remove(0)
    };
    assert_eq!(
        node("Sign", "0", "1")["status"],
        "BadSecurityModeInsufficient"
    );
    let later = node("SignAndEncrypt", "2", "0");
    assert_eq!(
        (&later["status"], &later["first"]),
        (&json!("Good"), &json!(2))
    );
    assert_eq!(later["keys"].as_array().unwrap().len(), 1);
    let all = node("SignAndEncrypt", "0", "1");
    assert_eq!(
        all["keys"][1], later["keys"][0],
        "the same keys for everybody"
    );
}

#[test]
fn who_is_no_member_of_the_group_gets_no_keys() {
    let Some(cell) = Cell::with(&[Peer::Python]) else {
        return;
    };
    for members in [
        r#"{members: ["urn:ua-bridge:server", "urn:plant:*"]}"#,
        "{}",
    ] {
        let mapping = mapping(&cell, members);
        let mut server = server(&cell, &mapping);
        let refused = asked(&cell, "Basic256Sha256", &json!(["cell", 0, 2]));
        assert_eq!(refused["status"], "BadUserAccessDenied", "{members}");
        let told = server.wait_for_line("refused the keys of a secured group", SOON);
        assert!(told.contains("urn:ua-bridge:system-tests:client"), "{told}");
        server.end();
    }
}

/// Values of ROS 1 as received in ROS 2.
struct Stream {
    heard: Child,
    _rest: Vec<Child>,
}

impl Stream {
    fn count(&self) -> usize {
        self.heard.values().len()
    }

    fn goes_on(&self, what: &str) {
        let before = self.count();
        eventually(what, SOON, || (self.count() > before + 20).then_some(()));
    }
}

/// Starts both bridges with the mapping, and sends numbers from ROS 1 to ROS 2, twenty a second.
fn stream(cell: &Cell, mapping: &str) -> Stream {
    let pki = [store(cell, "ros1"), store(cell, "ros2")];
    let master = cell.roscore();
    let arguments = |pki| ["--security", mapping, "--pki", pki];
    let bridges = (
        cell.bridge_ros1(&arguments(&pki[0])),
        cell.bridge_ros2(&arguments(&pki[1])),
    );
    let mut heard = cell.cyclone("ros2_sub.py", &[&TOPIC[..], &["--domain", "2"]].concat());
    let numbers = [
        "--numbered",
        "4000",
        "--rate",
        "20",
        "--warm-up",
        r#""warm""#,
    ];
    let sends = cell.rospy_started("ros1_pub.py", &[&TOPIC[..], &numbers].concat());
    let mut sends = sends.told().start();
    let value = |line: &Value| line.get("value").cloned();
    heard.wait_for_json("the first string in ROS 2", SOON, value);
    sends.tell("");
    heard.wait_for_json("the first number in ROS 2", SOON, |line| {
        (*line.get("value")? == json!({"data": "0"})).then_some(())
    });
    Stream {
        heard,
        _rest: vec![master, bridges.0, bridges.1, sends],
    }
}

/// Checks that numbers are consecutive, without loss or duplicates.
fn are_whole(values: &[Value]) {
    let numbers: Vec<u64> = values
        .iter()
        .filter_map(|value| value["data"].as_str()?.parse().ok())
        .collect();
    let jump = numbers.windows(2).find(|pair| pair[1] != pair[0] + 1);
    assert_eq!(jump, None, "of {} numbers", numbers.len());
}

#[test]
fn bridges_live_with_the_keys_of_the_service_through_its_rotations_and_without_it() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let mapping = mapping(&cell, "{key_lifetime: 3s}");
    let mut server = server(&cell, &mapping);
    let stream = stream(&cell, &mapping);
    let bridges = [METRICS_ROS1, METRICS_ROS2];
    let begun = token(METRICS_ROS1).unwrap();
    let refused = || {
        bridges.map(|address| {
            ["unknown_key", "no_keys", "signature"].map(|reason| dropped(address, reason))
        })
    };
    // Before any keys existed.
    let before = refused();

    // Rotation under traffic: each program changes to the next key.
    for address in [METRICS_ROS1, METRICS_ROS2, METRICS_SERVER] {
        eventually("the key after the next is used", SOON, || {
            (token(address)? >= begun + 2).then_some(())
        });
    }
    // The service is offline for longer than a key's lifetime: the keys it distributed before are
    // used.
    server.end();
    let away = token(METRICS_ROS1).unwrap();
    for address in bridges {
        eventually("the keys handed out before are used", SOON, || {
            (token(address)? >= away + 2).then_some(())
        });
    }
    server = self::server(&cell, &mapping);
    for address in bridges {
        eventually(
            "the keys of the service that is back are used",
            SOON,
            || (token(address)? > away + 5).then_some(()),
        );
    }
    are_whole(&stream.heard.values());
    assert_eq!(refused(), before);

    // The service is offline for longer than the lifetime of all keys: the last key stays in use.
    server.end();
    let is_overdue = |address: &str| {
        let state = metrics(address)?["groups"]["cell"].clone();
        state["overdue"].as_bool()
    };
    for address in bridges {
        eventually("the keys handed out are used up", 2 * SOON, || {
            is_overdue(address)?.then_some(())
        });
    }
    stream.goes_on("values go on with the last key");
    let last = token(METRICS_ROS1).unwrap();
    let _server = self::server(&cell, &mapping);
    for address in bridges {
        eventually(
            "the keys of the service that is back are used",
            SOON,
            || (!is_overdue(address)? && token(address)? > last).then_some(()),
        );
    }
    stream.goes_on("values go on with the keys of the service that is back");
}

#[test]
fn a_bridge_waits_for_a_service_that_starts_after_it_and_says_what_is_missing() {
    let Some(cell) = Cell::with(&[Peer::Ros1, Peer::Python]) else {
        return;
    };
    let mapping = mapping(&cell, "{}");
    let _master = cell.roscore();
    let store = cell.folder().join("pki-ros1");
    let arguments = ["--security", &mapping, "--pki", path(&store)];
    let mut bridge = cell.bridge_ros1(&arguments);
    bridge.wait_for_line("cannot get keys from the Security Key Service", SOON);
    let (code, told) = http_answer(METRICS_ROS1, "/readyz").unwrap();
    assert_eq!(code, 503, "{told}");
    assert!(told.contains("no keys of the group `cell`"), "{told}");

    let _server = server(&cell, &mapping);
    // The bridge trusts only certificates it was configured to trust, and the message has the
    // command to trust.
    let untrusted = bridge.wait_for_line("BadCertificateUntrusted", SOON);
    let told = ["`ua-server trust", "pki-ros1"];
    assert!(
        told.iter().all(|one| untrusted.contains(one)),
        "{untrusted}"
    );
    self::store(&cell, "ros1");
    eventually("the bridge has keys", SOON, || token(METRICS_ROS1));
    bridge.wait_for_line("the Security Key Service responds again", SOON);
    assert_eq!(http_answer(METRICS_ROS1, "/readyz").unwrap().0, 200);
}
