//! Every datagram under `tests/vectors`: read as its JSON says and written back byte for byte, or refused for the
//! reason that stands in [`NOT_READ`].

#![expect(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::cast_possible_truncation,
    clippy::wildcard_enum_match_arm,
    reason = "test code"
)]

mod found;
mod not_read;
mod said;
mod write;

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde_json::Value;
use uadp::{DecodeError, MessageKind, NetworkMessage, Scalar, Variant};

use found::describe;
use not_read::NOT_READ;
use said::expected;
use write::{by_block, by_parts, by_variant, rewrite};

/// Heartbeats that end before their FieldCount: contested, read like any other and written with it.
const WITHOUT_FIELD_COUNT: &[&str] = &["heartbeat_keyframe", "wire_heartbeat"];

#[test]
fn every_vector_is_read_as_described_and_written_back() {
    let skipped: BTreeSet<&str> = NOT_READ
        .iter()
        .flat_map(|(_, names)| *names)
        .copied()
        .collect();
    let mut read = 0;
    let mut failures = Vec::new();
    for (name, json) in vectors() {
        if skipped.contains(&*name) || malformed(&json) {
            continue;
        }
        let datagram = datagram(&name);
        match describe(&datagram) {
            Ok(found) if found != expected(&json) => {
                failures.push(format!("{name}: read\n {found}\nnot\n {}", expected(&json)));
            }
            Ok(_) => read += 1,
            Err(error) => {
                failures.push(format!("{name}: {error}"));
                continue;
            }
        }
        let mut same = datagram.clone();
        if WITHOUT_FIELD_COUNT.contains(&&*name) {
            same.extend([0, 0]);
        }
        for how in [by_variant, by_parts, by_block] {
            match rewrite(&datagram, how) {
                Ok(written) if written != same => {
                    failures.push(format!(
                        "{name}: written\n {written:02x?}\nnot\n {same:02x?}"
                    ));
                }
                Ok(_) => {}
                Err(error) => failures.push(format!("{name}: {error}")),
            }
        }
    }
    assert!(
        failures.is_empty(),
        "{} failures:\n{}",
        failures.len(),
        failures.join("\n")
    );
    println!(
        "{read} vectors read and written, {} not read yet",
        skipped.len()
    );
}

#[test]
fn what_is_not_read_is_refused_by_its_name() {
    let listed: BTreeSet<String> = vectors().into_iter().map(|(name, _)| name).collect();
    for (reason, names) in NOT_READ {
        for name in *names {
            assert!(listed.contains(*name), "{name} is no vector");
            let error = describe(&datagram(name)).unwrap_err();
            assert_eq!(error, DecodeError::Unsupported(reason), "{name}");
        }
    }
}

#[test]
fn malformed_vectors_are_refused() {
    let mut count = 0;
    for (name, json) in vectors() {
        if malformed(&json) {
            assert!(describe(&datagram(&name)).is_err(), "{name} was read");
            count += 1;
        }
    }
    assert_eq!(count, 4);
    assert_eq!(
        describe(&datagram("asyncua_pubid_uint64")).unwrap_err(),
        DecodeError::Reserved {
            field: "PublisherId type",
            value: 6
        }
    );
}

#[test]
fn a_message_that_is_not_read_does_not_hide_its_neighbours() {
    let datagram = datagram("payload_mixed_types");
    let message = NetworkMessage::decode(&datagram).unwrap();
    let messages: Vec<_> = message.messages().map(Result::unwrap).collect();
    assert_eq!(messages.len(), 3);
    let first: Vec<_> = messages[0].fields().unwrap().map(Result::unwrap).collect();
    assert_eq!(
        first,
        [
            Scalar::Double(1.5).into(),
            Variant::Scalar(Scalar::String(Some("text")))
        ]
    );
    assert_eq!(
        messages[1].fields().unwrap_err(),
        DecodeError::Unsupported("DataValue field encoding")
    );
    assert_eq!(messages[2].kind, MessageKind::KeepAlive);
    assert_eq!(messages[2].header.sequence_number, Some(77));
    assert_eq!(messages[2].writer_id, Some(3));
}

fn vectors() -> Vec<(String, Value)> {
    let manifest = load("MANIFEST.json");
    let vectors: Vec<_> = manifest
        .as_array()
        .unwrap()
        .iter()
        .map(|entry| entry["name"].as_str().unwrap().to_owned())
        .map(|name| (name.clone(), load(&format!("{name}.json"))))
        .collect();
    let files = std::fs::read_dir(folder()).unwrap();
    let hex =
        files.filter(|file| file.as_ref().unwrap().path().extension() == Some("hex".as_ref()));
    assert_eq!(
        hex.count(),
        vectors.len(),
        "MANIFEST.json does not list every datagram"
    );
    vectors
}

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/vectors")
}

fn load(file: &str) -> Value {
    serde_json::from_str(&std::fs::read_to_string(folder().join(file)).unwrap()).unwrap()
}

fn datagram(name: &str) -> Vec<u8> {
    let hex = std::fs::read_to_string(folder().join(format!("{name}.hex"))).unwrap();
    let digits: Vec<u8> = hex
        .trim()
        .chars()
        .map(|c| u8::try_from(c.to_digit(16).unwrap()).unwrap())
        .collect();
    digits
        .chunks_exact(2)
        .map(|pair| pair[0] << 4 | pair[1])
        .collect()
}

fn malformed(json: &Value) -> bool {
    json.get("malformed").is_some_and(|why| !why.is_null())
}
