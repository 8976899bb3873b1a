//! Every datagram under `tests/vectors`: decoded as its JSON file describes, and encoded byte for
//! byte. For vectors in [`NOT_READ`] and [`RAW_DATA`], only the parts that are not encrypted and
//! need no metadata.

mod found;
mod not_read;
use crate::rewrite;
mod said;
mod write;

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde_json::Value;
use uadp::{
    DataValue, DecodeError, FieldValue, MessageKind, NetworkMessage, Scalar, StatusCode, Variant,
};

use found::{describe_headers, describe_messages};
use not_read::{NOT_READ, RAW_DATA};
use rewrite::rewrite;
use said::{expected_headers, expected_messages};
use write::{by_block, by_parts, by_variant};

#[test]
fn every_vector_is_read_as_described_and_written_back() {
    let not_read: BTreeSet<&str> = NOT_READ
        .iter()
        .flat_map(|(_, names)| *names)
        .chain(RAW_DATA)
        .copied()
        .collect();
    let mut read = 0;
    let mut failures = Vec::new();
    for (name, json) in vectors() {
        if not_read.contains(&*name) || malformed(&json) {
            continue;
        }
        let datagram = datagram(&name);
        match describe(&datagram) {
            Ok(found) if found != expected(&json) => {
                failures.push(format!(
                    "{name}: read\n {found:?}\nnot\n {:?}",
                    expected(&json)
                ));
            }
            Ok(_) => read += 1,
            Err(error) => failures.push(format!("{name}: {error}")),
        }
        for how in [by_variant, by_parts, by_block] {
            match rewrite(&datagram, how) {
                Ok(written) if written != datagram => {
                    failures.push(format!(
                        "{name}: written\n {written:02x?}\nnot\n {datagram:02x?}"
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
        "{read} vectors read and written, {} proven elsewhere",
        not_read.len()
    );
}

#[test]
fn what_takes_more_than_the_datagram_says_so_and_shows_its_headers() {
    for (what, names) in NOT_READ {
        for name in *names {
            let datagram = datagram(name);
            let network = NetworkMessage::decode(&datagram).unwrap();
            let headers = describe_headers(&network).unwrap();
            assert_eq!(headers, expected_headers(&json(name)), "{name}");
            let errors: Vec<_> = network.messages().map(Result::unwrap_err).collect();
            assert_eq!(errors, [DecodeError::Misread(what)], "{name}");
        }
    }
}

#[test]
fn raw_data_is_told_from_other_fields_and_copied_as_it_is() {
    let what = DecodeError::Misread("encoded as RawData, to be read with its DataSetMetaData");
    for name in RAW_DATA {
        let datagram = datagram(name);
        assert_eq!(describe(&datagram), Ok(expected(&json(name))), "{name}");
        let network = NetworkMessage::decode(&datagram).unwrap();
        for message in network.messages().map(Result::unwrap) {
            assert_eq!(message.fields().unwrap_err(), what, "{name}");
            assert_eq!(message.values().unwrap_err(), what, "{name}");
        }
        assert_eq!(rewrite(&datagram, by_variant), Ok(datagram), "{name}");
    }
}

#[test]
fn malformed_vectors_are_refused() {
    let refused: Vec<_> = vectors()
        .into_iter()
        .filter(|(_, json)| malformed(json))
        .map(|(name, _)| (describe(&datagram(&name)).unwrap_err(), name))
        .map(|(error, name)| (name, error))
        .collect();
    let expected = [
        (
            "asyncua_chunk",
            DecodeError::Misread("a chunk, to be reassembled first"),
        ),
        (
            "asyncua_discovery_request_metadata",
            DecodeError::Misread("a discovery probe"),
        ),
        (
            "asyncua_promoted",
            DecodeError::Truncated {
                field: "Int32",
                expected: 4,
                found: 0,
            },
        ),
        (
            "asyncua_pubid_uint64",
            DecodeError::Reserved {
                field: "PublisherId type",
                value: 6,
            },
        ),
    ];
    assert_eq!(
        refused,
        expected.map(|(name, error)| (name.to_owned(), error))
    );
}

#[test]
fn messages_of_every_kind_stand_side_by_side() {
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
        DecodeError::Misread("encoded as DataValues")
    );
    let second: Vec<_> = messages[1].values().unwrap().map(Result::unwrap).collect();
    let uncertain = DataValue {
        status: Some(StatusCode(0x4000_0000)),
        ..Variant::from(Scalar::Int32(-42)).into()
    };
    let field = FieldValue {
        index: 0,
        value: uncertain,
    };
    assert_eq!(second, [field]);
    assert_eq!(messages[2].kind, MessageKind::KeepAlive);
    assert_eq!(messages[2].header().sequence_number, Some(77));
    assert_eq!(messages[2].writer_id, Some(3));
}

#[test]
fn what_fills_up_a_delta_frame_of_open62541_is_told_from_its_changes() {
    for (name, changed) in [("wire_delta_r1", [3]), ("wire_delta_r2", [3])] {
        let datagram = datagram(name);
        let network = NetworkMessage::decode(&datagram).unwrap();
        let message = network.messages().next().unwrap().unwrap();
        let fields: Vec<_> = message.values().unwrap().map(Result::unwrap).collect();
        assert_eq!(fields.len(), 4, "{name}");
        let changes = fields.iter().filter(|field| !field.is_filler());
        let indexes: Vec<_> = changes.map(|field| field.index).collect();
        assert_eq!(indexes, changed, "{name}");
    }
}

fn describe(datagram: &[u8]) -> Result<(Value, Value), DecodeError> {
    let network = NetworkMessage::decode(datagram)?;
    Ok((describe_headers(&network)?, describe_messages(&network)?))
}

fn expected(json: &Value) -> (Value, Value) {
    (expected_headers(json), expected_messages(json))
}

fn vectors() -> Vec<(String, Value)> {
    let manifest = load("MANIFEST.json");
    let vectors: Vec<_> = manifest
        .as_array()
        .unwrap()
        .iter()
        .map(|entry| entry["name"].as_str().unwrap().to_owned())
        .map(|name| (name.clone(), json(&name)))
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

fn json(name: &str) -> Value {
    load(&format!("{name}.json"))
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
