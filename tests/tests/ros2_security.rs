//! bridge-ros2 with DDS Security, with the enclaves of SROS2.
//!
//! Tests that need DDS Security are skipped if the bridge was built without it (`bridge-ros2
//! --version`); `cargo xtask` builds the bridge with it.

mod kinds;
mod node;

use std::{
    fs,
    os::unix::fs::PermissionsExt as _,
    time::{Duration, Instant},
};

use system_tests::{
    Cell, Child, Governance, HERE, Keystore, METRICS_ROS2, Peer, StartedChild, TopicTriple, UaSide,
    WireEffect, Wiretap, drops, eventually, has_security, metrics,
};
use uadp::Scalar;

const SOON: Duration = Duration::from_secs(30);
const STRING: &str = "std_msgs/String";
/// A value of the space, and a value of the domain.
const THERE: (TopicTriple, &str) = ((1, 2, 10), "/ua_1_2_10");
const BACK: (TopicTriple, &str) = ((2, 2, 20), "/ua_2_2_20");

type Secured = fn(&Cell, &Keystore, &[&str]) -> StartedChild;

fn sends<'a>(topic: &'a str, text: &'a str) -> [&'a str; 9] {
    [
        "pub", topic, STRING, "--text", text, "--count", "0", "--rate", "10",
    ]
}

/// Writes the value repeatedly until it reaches the reader.
fn reaches(ua: &mut UaSide, text: &str, reader: &Child) {
    let mut written: Option<Instant> = None;
    eventually(&format!("the reader has `{text}`"), SOON, || {
        if written.is_none_or(|at| at.elapsed() > Duration::from_millis(100)) {
            ua.write(THERE.0, Scalar::String(Some(text)));
            written = Some(Instant::now());
        }
        let values = reader.values();
        let mut texts = values.iter().map(|value| &value["data"]);
        texts.any(|found| found == text).then_some(())
    });
}

fn answering(bridge: StartedChild) -> Child {
    let bridge = bridge.start();
    eventually("the bridge answers", SOON, || metrics(METRICS_ROS2));
    bridge
}

/// Returns whether the text is in any packet, with a byte per character as in CDR.
fn is_in(packets: &[Vec<u8>], text: &str) -> bool {
    packets.iter().any(|packet| {
        let mut windows = packet.windows(text.len());
        windows.any(|window| window == text.as_bytes())
    })
}

#[test]
fn values_cross_both_ways_with_secured_peers_and_nothing_of_them_is_readable_on_the_wire() {
    let Some(cell) = Cell::secured(&[Peer::CycloneC, Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let mut ua = UaSide::join();
    let mut tap = Wiretap::tap();
    let mut bridge = answering(cell.secured_bridge(&keystore, &[]));
    bridge.wait_for_line("DDS Security is on, enclave /bridge", SOON);
    let makers: [(Secured, &str); 2] = [
        (Cell::secured_cyclone, "cyclone"),
        (Cell::secured_fastdds, "fast"),
    ];
    for (maker, name) in makers {
        // The lengths are no multiples of 4, which the vendors pad differently.
        let (there, back) = (format!("there {name}"), format!("and back {name}"));
        let reader = maker(&cell, &keystore, &["sub", THERE.1, STRING])
            .start()
            .ready(SOON);
        reaches(&mut ua, &there, &reader);
        let _writer = maker(&cell, &keystore, &sends(BACK.1, &back)).start();
        ua.hear_scalar(BACK.0, Scalar::String(Some(&back)));
        let packets = tap.heard();
        assert!(is_in(&packets, "RTPS"), "the wire is heard");
        for secret in [&there, &back, THERE.1, BACK.1] {
            assert!(
                !is_in(&packets, secret.trim_start_matches('/')),
                "{secret} can be read"
            );
        }
    }
}

/// GUIDs of secured peers do not show their participant, and each vendor relates replies to
/// requests in its own way.
#[test]
fn services_of_secured_peers_of_both_makers_answer() {
    const CELL: &str = "
spaces:
  - {id: 2}
namespaces:
  2: urn:test
variables:
  - {node: ns=2;i=1, name: Light, type: Boolean, origin: 0, ros: {space: 2, call: /light, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=2, name: Lit, origin: 2, ros: {answer: ns=2;i=1, field: message}}
  - {node: ns=2;i=3, name: Fan, type: Boolean, origin: 0, ros: {space: 2, call: /fan, type: std_srvs/SetBool, field: data}}
  - {node: ns=2;i=4, name: Turned, origin: 2, ros: {answer: ns=2;i=3, field: message}}
";
    let Some(cell) = Cell::secured(&[Peer::CycloneC, Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let file = cell.file("cell.yaml", CELL);
    let mut ua = UaSide::join();
    let _bridge = answering(cell.secured_bridge(&keystore, &[file.to_str().unwrap()]));
    let _light = cell
        .secured_cyclone(&keystore, &["serve", "/light", "--text", "by cyclone"])
        .start()
        .ready(SOON);
    // A response in CDR: true, and a text of seven characters.
    let reply = "0100000008000000627920666173740000";
    let fan = ["serve", "/fan", "std_srvs/SetBool", "--hex", reply];
    let _fan = cell.secured_fastdds(&keystore, &fan).start().ready(SOON);
    for (asked, answered, text) in [(1, 2, "by cyclone"), (3, 4, "by fast")] {
        ua.write((0, 2, asked), Scalar::Boolean(true));
        ua.hear_scalar((2, 2, answered), Scalar::String(Some(text)));
    }
}

#[test]
fn secured_peers_get_each_others_keys_although_datagrams_are_lost() {
    let Some(cell) = Cell::secured(&[Peer::CycloneC]) else {
        return;
    };
    let host = cell.host(WireEffect {
        loss: 0.1,
        delay: Duration::from_millis(5),
    });
    let keystore = Keystore::make(&cell, "keystore");
    let mut ua = UaSide::join();
    let _bridge = answering(cell.secured_bridge(&keystore, &["--ros-interface", HERE]));
    for number in 0..3 {
        let (there, back) = (format!("there {number}"), format!("back {number}"));
        let on_host = |args: &[&str]| cell.secured_cyclone_on(&host, &keystore, args);
        let reader = on_host(&["sub", THERE.1, STRING]).start().ready(SOON);
        reaches(&mut ua, &there, &reader);
        let _writer = on_host(&sends(BACK.1, &back)).start();
        ua.hear_scalar(BACK.0, Scalar::String(Some(&back)));
    }
}

#[test]
fn who_is_not_of_the_enclave_gets_and_gives_nothing_and_is_told_of() {
    let Some(cell) = Cell::secured(&[Peer::CycloneC]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let others = Keystore::make(&cell, "others");
    let mut ua = UaSide::join();
    let mut bridge = answering(cell.secured_bridge(&keystore, &[]));

    let mut tap = Wiretap::tap();
    let open = cell.cyclone_c(&["sub", THERE.1, STRING]);
    let _open_writer = cell.cyclone_c(&sends(BACK.1, "in the open"));
    let _open_reader = cell.cyclone_c(&["sub", BACK.1, STRING]);
    bridge.wait_for_line("is rejected: it has no DDS Security", SOON);
    let stranger = cell
        .secured_cyclone(&others, &["sub", THERE.1, STRING])
        .start()
        .ready(SOON);
    let _strange_writer = cell
        .secured_cyclone(&others, &sends(BACK.1, "of a stranger"))
        .start();
    bridge.wait_for_line("it did not authenticate", SOON);

    // Values of the peers in the enclave cross throughout.
    let reader = cell
        .secured_cyclone(&keystore, &["sub", THERE.1, STRING])
        .start()
        .ready(SOON);
    let _writer = cell
        .secured_cyclone(&keystore, &sends(BACK.1, "of the enclave"))
        .start();
    reaches(&mut ua, "for the enclave", &reader);
    ua.hear(BACK.0, "the first value", |fields| {
        assert!(
            matches!(
                fields,
                [uadp::Variant::Scalar(Scalar::String(Some(
                    "of the enclave"
                )))]
            ),
            "{fields:?}"
        );
        Some(())
    });
    assert_eq!(open.values(), Vec::<serde_json::Value>::new());
    assert_eq!(stranger.values(), Vec::<serde_json::Value>::new());
    eventually("what is sent in the open can be read", SOON, || {
        is_in(&tap.heard(), "in the open").then_some(())
    });
    let status = metrics(METRICS_ROS2).unwrap();
    assert!(
        drops(&status) >= 4,
        "two in the open, two of another authority: {status}"
    );
}

/// Returns the exit code and the output of a bridge that must refuse to run.
fn refusal(started: StartedChild) -> (Option<i32>, String) {
    let mut bridge = started.start();
    let code = bridge.wait_for_end(SOON).code();
    (code, bridge.lines().join("\n"))
}

#[test]
fn an_enclave_that_is_not_in_order_is_refused_with_the_file_to_mend() {
    let Some(cell) = Cell::secured(&[]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let others = Keystore::make(&cell, "others");
    let enclave = keystore.enclave("bridge");
    let refused = |why: &[&str]| {
        let (code, lines) = refusal(cell.secured_bridge(&keystore, &[]));
        assert_eq!(code, Some(78), "{lines}");
        for text in why {
            assert!(lines.contains(text), "no `{text}` in {lines}");
        }
    };
    let with = |file: &str, from: &std::path::Path, why: &[&str]| {
        let (path, kept) = (enclave.join(file), enclave.join("kept"));
        fs::rename(&path, &kept).unwrap();
        fs::copy(from, &path).unwrap();
        refused(why);
        fs::rename(&kept, &path).unwrap();
    };
    let theirs = others.enclave("bridge");
    let own = keystore.enclave("peer");
    with(
        "governance.p7s",
        &theirs.join("governance.p7s"),
        &["governance.p7s", "signature", "sign it again"],
    );
    with(
        "permissions.p7s",
        &theirs.join("permissions.p7s"),
        &["permissions.p7s", "signature"],
    );
    // Signed permissions of another enclave: RustDDS finds no grant for the bridge in them.
    with(
        "permissions.p7s",
        &own.join("permissions.p7s"),
        &["cannot join domain 2 with the enclave"],
    );
    with(
        "identity_ca.cert.pem",
        &theirs.join("identity_ca.cert.pem"),
        &["cert.pem", "not signed by identity_ca"],
    );
    with(
        "key.pem",
        &theirs.join("key.pem"),
        &["key.pem", "does not match cert.pem"],
    );
    with("key.pem", &own.join("cert.pem"), &["key.pem", "PKCS#8"]);
    with(
        "cert.pem",
        &own.join("key.pem"),
        &["cert.pem", "not a PEM certificate"],
    );

    // Also where the bridge may run unsecured: invalid files show the intent to be secured.
    let revoked = enclave.join("crl.pem");
    fs::write(&revoked, "").unwrap();
    refused(&["crl.pem", "create a new keystore"]);
    let permissive = cell.secured_bridge(&keystore, &[]);
    let (code, lines) = refusal(permissive.env("ROS_SECURITY_STRATEGY", "Permissive"));
    assert!(code == Some(78) && lines.contains("crl.pem"), "{lines}");
    fs::remove_file(revoked).unwrap();

    keystore.govern(&Governance::all("SIGNED"));
    refused(&["cannot join domain 2 with the enclave", "SIGNED"]);
    keystore.govern(&Governance::SROS2);
    keystore.certify("bridge", -1);
    refused(&["cert.pem", "expired on"]);
    keystore.certify("bridge", 10);
    fs::remove_file(enclave.join("permissions.p7s")).unwrap();
    refused(&["lacks permissions.p7s", "create_enclave"]);
}

#[test]
fn a_key_others_can_read_is_told_of() {
    let Some(cell) = Cell::secured(&[]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    let key = keystore.enclave("bridge").join("key.pem");
    fs::set_permissions(key, fs::Permissions::from_mode(0o644)).unwrap();
    let mut bridge = answering(cell.secured_bridge(&keystore, &[]));
    bridge.wait_for_line(
        "other users of this host can read this key (mode 644)",
        SOON,
    );
}

/// With either build: without DDS Security, only this behaviour can be tested.
#[test]
fn a_bridge_that_cannot_be_secured_does_not_run_in_the_clear_unless_it_may() {
    let Some(cell) = Cell::with(&[]) else {
        return;
    };
    let bridge = |strategy: &str| {
        cell.bridge_ros2_started(&[])
            .env("ROS_SECURITY_ENABLE", "true")
            .env("ROS_SECURITY_STRATEGY", strategy)
            .env("ROS_SECURITY_KEYSTORE", cell.folder().join("nowhere"))
    };
    let why = if has_security() {
        "does not exist: create it with `ros2 security"
    } else {
        "built without DDS Security"
    };
    let (code, lines) = refusal(bridge("Enforce"));
    assert_eq!(code, Some(78), "{lines}");
    assert!(
        lines.contains("DDS Security cannot be set up") && lines.contains(why),
        "{lines}"
    );

    let (code, lines) = refusal(bridge("enforce"));
    assert_eq!(code, Some(78), "{lines}");
    assert!(lines.contains("Enforce or Permissive"), "{lines}");

    let mut open = answering(bridge("Permissive"));
    let warned = open.wait_for_line("WITHOUT security", SOON);
    assert!(warned.contains(why), "{warned}");
    open.wait_for_line("DDS Security is off", SOON);
}
