//! Requests and responses of Actions.

use std::path::PathBuf;

use serde_json::{Value, json};
use uadp::action::{
    ActionCall, ActionDialect, ActionEncoder, ActionFields, ActionHeader, ActionKind, ActionStart,
    ActionState,
};
use uadp::{
    DataSetHeader, Extras, NetworkHeader, PublisherId, Sealer, SecurityMode, SecurityPolicy,
    TokenKeys,
};

use crate::program::run_on;

/// Hexadecimal digits of `uadp/tests/action/vectors.txt` by name.
fn vectors() -> Vec<(String, String)> {
    let file =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../uadp/tests/action/vectors.txt");
    let text = std::fs::read_to_string(file).unwrap();
    let mut vectors: Vec<(String, String)> = Vec::new();
    for line in text.lines() {
        let line = line.split(';').next().unwrap().trim();
        match line.strip_prefix('[') {
            Some(name) => vectors.push((name.trim_end_matches(']').to_owned(), String::new())),
            None => vectors
                .last_mut()
                .map_or((), |(_, digits)| digits.push_str(&line.replace(' ', ""))),
        }
    }
    vectors
}

fn vector(name: &str) -> String {
    let mut vectors = vectors().into_iter();
    vectors.find(|(of, _)| of == name).unwrap().1
}

fn decoded(digits: &str) -> Value {
    let shown = run_on(&["decode", "-"], digits.as_bytes()).quiet();
    serde_json::from_str(&shown).unwrap()
}

#[test]
fn a_request_is_shown_with_its_action_header() {
    let shown = decoded(&vector("request"));
    assert_eq!(
        shown["actionHeader"],
        json!({
            "type": "request",
            "responseAddress": "opc.udp://239.0.0.1:4840",
            "correlationDataHex": "c0ffee",
            "requestorId": {"type": "UInt16", "value": 1},
            "timeoutHint": 2500.0,
        })
    );
    let message = &shown["dataSetMessages"][0];
    assert_eq!(message["type"], "actionRequest");
    assert_eq!(
        message["action"],
        json!({"targetId": 7, "requestId": 0x1234, "state": "executing"})
    );
    assert_eq!(message["fields"].as_array().unwrap().len(), 2);
    assert_eq!(message["fields"][0]["value"]["Value"], 2.5);
}

#[test]
fn a_response_is_shown_with_its_status() {
    let shown = decoded(&vector("response"));
    let message = &shown["dataSetMessages"][0];
    assert_eq!(message["type"], "actionResponse");
    assert_eq!(
        (&message["status16"], &message["action"]["state"]),
        (&json!(0x80AB), &json!("done"))
    );
}

#[test]
fn the_one_shot_form_is_recognised() {
    let shown = decoded(&vector("netstandard_request"));
    assert_eq!(shown["actionHeader"]["dialect"], "uaNetStandard");
    assert_eq!(shown["dataSetMessages"][0]["action"]["requestId"], 0x1234);
}

#[test]
fn what_is_shown_of_an_action_is_written_again_as_it_was() {
    let mut written = 0;
    for (name, digits) in vectors() {
        // RawData of a peer that does not announce the encoding is decoded as wrong Variants.
        if name == "netstandard_raw_response" {
            continue;
        }
        let shown = decoded(&digits).to_string();
        let again = run_on(&["encode", "-"], shown.as_bytes()).quiet();
        let again = again.trim().replace(' ', "");
        assert!(
            again.eq_ignore_ascii_case(&digits),
            "{name}: {again} of {digits}"
        );
        written += 1;
    }
    assert_eq!(written, 7);
}

#[test]
fn what_is_wrong_with_an_action_is_told_with_its_place() {
    let digits = vector("response").replace("3412020100", "3412070100");
    let ended = run_on(&["decode", "-"], digits.as_bytes());
    assert_eq!(ended.code, 65, "{}", ended.stderr);
    let place =
        "offset 30, in DataSetMessage of DataSetWriterId 61, ActionState: the reserved value 0x7";
    assert!(ended.stderr.contains(place), "{}", ended.stderr);
}

#[test]
fn an_action_that_is_not_opened_is_written_again_as_it_was() {
    let keys = TokenKeys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &[7; 52]).unwrap();
    let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
    sealer.update_keys(3, [keys]).unwrap();
    let seal = sealer.seal([1, 2, 3, 4]).unwrap();
    let start = ActionStart {
        network: NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(2)),
            ..NetworkHeader::default()
        },
        action: ActionHeader::new(ActionKind::Request),
        dialect: ActionDialect::Standard,
        extras: Extras {
            security: Some(seal.header()),
            ..Extras::default()
        },
    };
    let call = ActionCall {
        target_id: 7,
        request_id: 1,
        state: ActionState::Executing,
    };
    let mut datagram = Vec::new();
    let mut encoder = ActionEncoder::new(&mut datagram, &start, &[61]).unwrap();
    encoder
        .fields(&DataSetHeader::default(), call, ActionFields::NONE)
        .unwrap();
    encoder.finish_sealed(seal).unwrap();
    let digits: String = datagram.iter().map(|byte| format!("{byte:02x}")).collect();

    // The output marks the message as sealed.
    let shown = run_on(&["decode", "-"], digits.as_bytes()).stdout;
    let shown: Value = serde_json::from_str(&shown).unwrap();
    assert_eq!(shown["sealed"]["action"], true);
    let again = run_on(&["encode", "-"], shown.to_string().as_bytes()).quiet();
    assert_eq!(again.trim().replace(' ', ""), digits);
}
