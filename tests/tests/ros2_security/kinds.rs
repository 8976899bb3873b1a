//! Kinds of protection: each of them everywhere, and mixed.

use system_tests::{Cell, Child, Governance, Keystore, Peer, Triple, UaSide, Wiretap};
use uadp::Scalar;

use crate::{BACK, SOON, STRING, Secured, THERE, answering, is_in, reaches, sends};

/// A maker, its name, and the value it writes.
const MAKERS: [(Secured, &str, Triple, &str); 2] = [
    (Cell::secured_cyclone, "cyclone", (2, 2, 20), "/ua_2_2_20"),
    (Cell::secured_fastdds, "fast", (2, 2, 21), "/ua_2_2_21"),
];

/// Values cross both ways with both makers, and can be read on the wire where nothing is encrypted.
fn values_cross(governance: Governance) {
    let Some(cell) = Cell::secured(&[Peer::CycloneC, Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    keystore.govern(&governance);
    let mut ua = UaSide::join();
    let mut tap = Wiretap::tap();
    let _bridge = answering(cell.secured_bridge(&keystore, &[]));
    let peers = MAKERS.map(|(maker, name, triple, topic)| {
        let start = |args: &[&str]| -> Child { maker(&cell, &keystore, args).start() };
        let reader = start(&["sub", THERE.1, STRING]);
        // Of all lengths modulo 4: the makers pad differently.
        let texts = ["", "+", "++", "+++"].map(|more| format!("of {name} {more}"));
        let mut written = vec!["pub", topic, STRING, "--count", "0", "--rate", "50"];
        for text in &texts {
            written.extend(["--text", text]);
        }
        let writer = start(&written);
        (reader, writer, triple, texts)
    });
    for more in ["", "+", "++", "+++"] {
        let there = format!("for all {more}");
        for (reader, ..) in &peers {
            reaches(&mut ua, &there, reader);
        }
    }
    for (_, _, triple, texts) in &peers {
        for text in texts {
            ua.hear_scalar(*triple, Scalar::String(Some(text)));
        }
    }
    let encrypted = [governance.rtps, governance.metadata, governance.data]
        .iter()
        .any(|kind| kind.starts_with("ENCRYPT"));
    let packets = tap.heard();
    for text in ["for all", "of cyclone", "of fast"] {
        assert_eq!(is_in(&packets, text), !encrypted, "{text}: {governance:?}");
    }
}

#[test]
fn values_cross_where_nothing_is_protected() {
    values_cross(Governance::all("NONE"));
}

#[test]
fn values_cross_where_all_is_signed() {
    values_cross(Governance::all("SIGN"));
}

#[test]
fn values_cross_where_all_is_signed_for_each_receiver() {
    values_cross(Governance {
        data: "SIGN",
        ..Governance::all("SIGN_WITH_ORIGIN_AUTHENTICATION")
    });
}

#[test]
fn values_cross_where_all_is_encrypted_datagrams_as_a_whole_too() {
    values_cross(Governance::all("ENCRYPT"));
}

#[test]
fn values_cross_where_all_is_encrypted_for_each_receiver() {
    values_cross(Governance {
        data: "ENCRYPT",
        ..Governance::all("ENCRYPT_WITH_ORIGIN_AUTHENTICATION")
    });
}

#[test]
fn values_cross_where_samples_and_submessages_have_different_keys() {
    values_cross(Governance {
        rtps: "NONE",
        data: "ENCRYPT",
        ..Governance::all("SIGN")
    });
}

/// Cyclone DDS then tells of its topics in datagrams anybody could have sent.
#[test]
fn open_discovery_in_protected_datagrams_is_warned_of_and_works_with_who_protects_them() {
    let Some(cell) = Cell::secured(&[Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    keystore.govern(&Governance {
        discovery: "NONE",
        ..Governance::SROS2
    });
    let mut ua = UaSide::join();
    let mut bridge = answering(cell.secured_bridge(&keystore, &[]));
    bridge.wait_for_line("nodes of Cyclone DDS are not found", SOON);
    let reader = cell.secured_fastdds(&keystore, &["sub", THERE.1, STRING]);
    reaches(&mut ua, "there", &reader.start());
    let _writer = cell
        .secured_fastdds(&keystore, &sends(BACK.1, "and back"))
        .start();
    ua.hear_scalar(BACK.0, Scalar::String(Some("and back")));
}
