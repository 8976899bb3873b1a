//! Kinds of protection: each kind everywhere, and mixed kinds.

use std::time::Duration;

use system_tests::{
    Cell, Child, Governance, Keystore, Peer, TopicTriple, UaSide, Wiretap, eventually,
};
use uadp::Scalar;

use crate::ros2_security::{BACK, SOON, STRING, Secured, THERE, answering, is_in, reaches, sends};

/// A vendor, and the value that its peer writes.
const MAKERS: [(Secured, TopicTriple, &str); 2] = [
    (Cell::secured_cyclone, (2, 2, 20), "/ua_2_2_20"),
    (Cell::secured_fastdds, (2, 2, 21), "/ua_2_2_21"),
];

/// Checks that values cross in both directions with both vendors, and are readable on the wire if
/// nothing is encrypted.
fn values_cross(governance: Governance) {
    let Some(cell) = Cell::secured(&[Peer::CycloneC, Peer::FastDds]) else {
        return;
    };
    let keystore = Keystore::make(&cell, "keystore");
    keystore.govern(&governance);
    let mut ua = UaSide::join();
    let mut tap = Wiretap::tap();
    let _bridge = answering(cell.secured_bridge(&keystore, &[]));
    // Started in sequence: in rare cases, Debian's Fast DDS ends if two peers appear at the same
    // moment.
    let _relays = MAKERS.map(|(maker, _, topic)| -> Child {
        let relay = ["relay", THERE.1, topic, "--type", STRING];
        maker(&cell, &keystore, &relay).start().ready(SOON)
    });
    for (_, triple, _) in MAKERS {
        eventually("what is written comes back", SOON, || {
            ua.write(THERE.0, Scalar::String(Some("is anybody there?")));
            let heard = ua.triples_for(Duration::from_millis(50));
            heard.contains(&triple).then_some(())
        });
    }
    // Texts of all lengths modulo 4, because the vendors pad differently.
    let texts = ["", "+", "++", "+++"].map(|more| format!("of a length {more}"));
    for (_, triple, _) in MAKERS {
        for text in &texts {
            ua.write(THERE.0, Scalar::String(Some(text)));
            ua.hear_scalar(triple, Scalar::String(Some(text)));
        }
    }
    let encrypted = [governance.rtps, governance.metadata, governance.data]
        .iter()
        .any(|kind| kind.starts_with("ENCRYPT"));
    let packets = tap.heard();
    assert!(is_in(&packets, "RTPS"), "the wire is heard");
    for text in &texts {
        assert_eq!(is_in(&packets, text), !encrypted, "{governance:?}");
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

/// Cyclone DDS then announces its topics in datagrams that any participant could have sent.
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
    bridge.wait_for_line("nodes of Cyclone DDS are not discovered", SOON);
    let reader = cell.secured_fastdds(&keystore, &["sub", THERE.1, STRING]);
    reaches(&mut ua, "there", &reader.start());
    let _writer = cell
        .secured_fastdds(&keystore, &sends(BACK.1, "and back"))
        .start();
    ua.hear_scalar(BACK.0, Scalar::String(Some("and back")));
}
