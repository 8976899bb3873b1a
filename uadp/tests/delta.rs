//! Delta frames change the values of a key frame.

use std::path::PathBuf;

use serde_json::Value;
use uadp::MessageKind::KeyFrame;
use uadp::{DeltaNull, MergedFrame, NetworkMessage};

#[test]
fn the_delta_frames_of_open62541_are_taken_and_their_filler_wipes_nothing() {
    let mut fields: Vec<Value> = Vec::new();
    let mut values = Vec::new();
    for round in 0..6 {
        let name = format!("wire_delta_r{round}");
        let datagram = datagram(&name);
        let network = NetworkMessage::decode(&datagram).unwrap();
        let message = network.messages().next().unwrap().unwrap();
        let said = &description(&name)["dataSetMessages"][0];
        let entries = said["fields"].as_array().unwrap();
        let value = |entry: &Value| entry["value"]["Value"].clone();
        if message.kind == KeyFrame {
            fields = entries.iter().map(value).collect();
        } else {
            let index = |entry: &Value| u16::try_from(entry["index"].as_u64().unwrap()).unwrap();
            let entries = entries.iter().map(|entry| (index(entry), value(entry)));
            let merged = DeltaNull::Filler.merge(&mut fields, entries, Value::is_null);
            assert_eq!(merged.applied + merged.filler, 4, "{name}");
        }
        values.push(Value::Array(fields.clone()));
    }
    let expected = serde_json::json!([
        [true, "cell", 2.5, 20_260_517],
        [true, "cell", 2.5, 20_260_518],
        [true, "cell", 2.5, 20_260_519],
        [true, "cell", 5.0, 20_260_520],
        [true, "cell", 5.0, 20_260_521],
        [true, "cell", 5.0, 20_260_522],
    ]);
    assert_eq!(Value::Array(values), expected);
}

#[test]
fn by_the_tables_a_null_in_a_delta_frame_is_a_value() {
    let is_null = |value: &Option<u8>| value.is_none();
    let entries = [(0, None), (2, None), (9, Some(1))];
    let mut fields = [Some(1), Some(2), Some(3)];
    let merged = DeltaNull::Value.merge(&mut fields, entries, is_null);
    assert_eq!(fields, [None, Some(2), None]);
    assert_eq!(
        merged,
        MergedFrame {
            applied: 2,
            filler: 0,
            unknown: 1
        }
    );
    let mut fields = [Some(1), Some(2), Some(3)];
    let merged = DeltaNull::Filler.merge(&mut fields, entries, is_null);
    assert_eq!(fields, [Some(1), Some(2), None]);
    assert_eq!(merged.filler, 1);
}

fn vector(name: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "tests/vectors", name]
        .iter()
        .collect()
}

fn datagram(name: &str) -> Vec<u8> {
    let hex = std::fs::read_to_string(vector(name).with_extension("hex")).unwrap();
    let digits: Vec<u32> = hex.chars().filter_map(|c| c.to_digit(16)).collect();
    let pairs = digits
        .chunks(2)
        .map(|pair| pair.iter().fold(0, |byte, digit| byte << 4 | digit));
    pairs.map(|byte| u8::try_from(byte).unwrap()).collect()
}

fn description(name: &str) -> Value {
    let text = std::fs::read_to_string(vector(name).with_extension("json")).unwrap();
    serde_json::from_str(&text).unwrap()
}
