//! Requests and responses of Actions.

use std::path::PathBuf;

use system_tests::{CaptureFile, Cell, Peer};
use uadp::action::ActionDialect;
use uadp::{NetworkMessage, PublisherId, SecurityHeader, discovery};

use crate::dissector::messages::assert_shown;

/// Reads the bytes of `uadp/tests/action/vectors.txt` by name.
fn vectors() -> Vec<(String, Vec<u8>)> {
    let file = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../uadp/tests/action/vectors.txt");
    let text = std::fs::read_to_string(file).unwrap();
    let mut vectors: Vec<(String, Vec<u8>)> = Vec::new();
    for line in text.lines() {
        let line = line.split(';').next().unwrap().trim();
        match line.strip_prefix('[') {
            Some(name) => vectors.push((name.trim_end_matches(']').to_owned(), Vec::new())),
            None => vectors.last_mut().map_or((), |(_, bytes)| {
                let byte = |digits| u8::from_str_radix(digits, 16).unwrap();
                bytes.extend(line.split_whitespace().map(byte));
            }),
        }
    }
    vectors
}

fn vector(name: &str) -> Vec<u8> {
    let mut vectors = vectors().into_iter();
    vectors.find(|(of, _)| of == name).unwrap().1
}

#[test]
fn a_request_and_its_response_are_shown_field_by_field() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let names = [
        "request",
        "response",
        "raw_data",
        "two_requests",
        "idle",
        "signed_header",
    ];
    let shown = cell.dissect(&CaptureFile::of(names.map(vector)), &[]);
    for (shown, name) in shown.iter().zip(names) {
        assert!(!shown.has("uadp.dissector_bug"), "{name}");
        assert!(
            !shown.has("uadp.malformed"),
            "{name}: {:?}",
            shown.expert_infos()
        );
    }
    assert_shown(
        &shown[0],
        &[
            ("topic", "ua_2_5_61"),
            ("action.flags", "0x1f"),
            ("action.response_address", "opc.udp://239.0.0.1:4840"),
            ("action.correlation_data", "c0:ff:ee"),
            ("action.requestor_id", "1"),
            ("action.timeout_hint", "2500"),
            ("dataset.kind", "5"),
            ("action.target_id", "7"),
            ("action.request_id", "4660"),
            ("action.state", "1"),
            ("dataset.field_count", "2"),
            ("field.double", "2.5"),
            ("field.string", "hi"),
        ],
    );
    assert_shown(
        &shown[1],
        &[
            ("dataset.kind", "6"),
            ("dataset.status", "0x80ab"),
            ("action.request_id", "4660"),
            ("action.state", "2"),
            ("field.int32", "42"),
        ],
    );
    assert_shown(
        &shown[2],
        &[
            ("action.requestor_id.string", "cell 4"),
            ("dataset.field_count", "2"),
            ("dataset.raw_data", "00:00:00:00:00:00:04:40:2a:00:00:00"),
        ],
    );
    assert_eq!(shown[3].all("uadp.action.target_id"), ["7", "8"]);
    assert_eq!(shown[3].all("uadp.action.request_id"), ["1", "2"]);
    assert_shown(
        &shown[4],
        &[("action.state", "0"), ("dataset.field_count", "0")],
    );
    assert_shown(
        &shown[5],
        &[("security.token_id", "0"), ("action.flags", "0x01")],
    );
}

#[test]
fn one_shot_actions_are_shown_on_demand() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let capture = CaptureFile::of([vector("netstandard_request")]);
    let shown = cell.dissect(&capture, &["-o", "uadp.one_shot_actions:TRUE"]);
    assert!(
        !shown[0].has("uadp.malformed"),
        "{:?}",
        shown[0].expert_infos()
    );
    assert_shown(
        &shown[0],
        &[
            ("dataset.kind", "5"),
            ("action.target_id", "7"),
            ("action.request_id", "4660"),
            ("field.int32", "42"),
        ],
    );
}

#[test]
fn what_our_reader_refuses_of_an_action_is_malformed() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let mut datagrams = Vec::new();
    for (name, whole) in vectors() {
        if name.starts_with("netstandard") {
            continue;
        }
        datagrams.extend((1..=whole.len()).map(|len| whole[..len].to_vec()));
        for at in 0..whole.len() {
            for bit in [0, 1, 3, 6] {
                let mut changed = whole.clone();
                changed[at] ^= 1 << bit;
                datagrams.push(changed);
            }
        }
    }
    let shown = cell.dissect(&CaptureFile::of(datagrams.clone()), &[]);
    let mut counts = [0, 0];
    for (datagram, shown) in datagrams.iter().zip(&shown) {
        assert!(!shown.has("uadp.dissector_bug"), "{datagram:02x?}");
        let Some(refused) = refused(datagram) else {
            continue;
        };
        let malformed = shown.has("uadp.malformed");
        counts[usize::from(malformed)] += 1;
        assert_eq!(
            refused,
            malformed,
            "{datagram:02x?}: {:?}",
            shown.expert_infos()
        );
    }
    assert!(counts.iter().all(|count| *count > 100), "{counts:?}");
}

/// Returns whether our reader refuses an Action message; `None` for other or unreadable messages.
fn refused(datagram: &[u8]) -> Option<bool> {
    let message = NetworkMessage::decode(datagram).ok()?;
    if !message.is_action() || message.is_sealed() || message.is_chunk() {
        return None;
    }
    let Ok(actions) = message.actions(ActionDialect::Standard) else {
        return Some(true);
    };
    for action in actions {
        let fields = match action {
            Ok(action) => action.fields,
            // The dissector shows such a message as it is, not as malformed.
            Err(uadp::DecodeError::Misread(_)) => return None,
            Err(_) => return Some(true),
        };
        if let Ok(fields) = fields.variants() {
            for field in fields {
                if field.is_err() {
                    return Some(true);
                }
            }
        }
    }
    Some(false)
}

#[test]
fn an_announced_action_is_shown_with_its_targets_and_metadata() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let target = |id, name| discovery::ActionTargetDataType {
        action_target_id: id,
        name: Some(name),
        ..discovery::ActionTargetDataType::default()
    };
    let targets = [target(1, "left"), target(2, "right")];
    let meta_data = discovery::DataSetMetaDataType {
        name: Some("home"),
        ..discovery::DataSetMetaDataType::default()
    };
    let action = discovery::ActionMetaData {
        writer_id: 61,
        action_targets: discovery::WireArray::new(&targets),
        request: meta_data,
        response: meta_data,
        ..discovery::ActionMetaData::default()
    };
    let announcement = discovery::Announcement {
        sequence_number: 3,
        announced: discovery::AnnouncedContent::ActionMetaData(action),
    };
    let mut datagram = Vec::new();
    announcement
        .encode(PublisherId::UInt16(2), SecurityHeader::NONE, &mut datagram)
        .unwrap();
    let shown = crate::dissector::dissected(&cell, &datagram);
    assert!(!shown.has("uadp.malformed"), "{:?}", shown.expert_infos());
    assert_shown(
        &shown,
        &[("announcement.type", "7"), ("dataset_writer_id", "61")],
    );
    assert_eq!(shown.all("uadp.action.target_name"), ["left", "right"]);
    assert_eq!(shown.all("uadp.metadata.name"), ["home", "home"]);
}
