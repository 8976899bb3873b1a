//! Keys and metadata from files.

use serde_json::{Value, json};

use crate::program::{file, run};
use crate::vectors::DatagramVector;

/// Writes the files of one secured vector, its datagram and its keys, and returns their paths.
fn files(name: &str, keys: &Value) -> (String, String) {
    let vector = DatagramVector::load("wire_encrypt_aes128_r0");
    (
        file(&format!("{name}.hex"), vector.hex),
        file(&format!("{name}.keys.json"), keys.to_string()),
    )
}

fn good_keys() -> Value {
    DatagramVector::load("wire_encrypt_aes128_r0").json["security"].clone()
}

fn fields(shown: &str) -> Value {
    let shown: Value = serde_json::from_str(shown).unwrap();
    shown["dataSetMessages"][0]["fields"].clone()
}

#[test]
fn keys_open_what_is_encrypted() {
    let (datagram, keys) = files("opened", &good_keys());
    let shown = run(&["decode", &datagram, "--keys", &keys]).quiet();
    assert_eq!(
        fields(&shown)[0]["value"],
        json!({ "UaType": 12, "Value": "cell" })
    );
}

#[test]
fn another_key_is_told_from_no_key() {
    let mut wrong = good_keys();
    wrong["signingKey"] = json!("ff".repeat(32));
    let (datagram, keys) = files("wrong", &wrong);
    let ended = run(&["decode", &datagram, "--keys", &keys]);
    assert_eq!(ended.code, 65);
    assert_eq!(
        ended.stderr,
        format!(
            "{datagram}: the signature is wrong: {keys} has other keys of SecurityTokenId 1, or the datagram was \
             changed\n"
        )
    );
    assert!(
        ended.stdout.contains("\"securityHeader\""),
        "{}",
        ended.stdout
    );
    assert!(
        !ended.stdout.contains("dataSetMessages"),
        "{}",
        ended.stdout
    );

    let mut other = good_keys();
    other["securityTokenId"] = json!(7);
    let (datagram, keys) = files("other_token", &other);
    let ended = run(&["decode", &datagram, "--keys", &keys]);
    assert_eq!(ended.code, 65);
    assert_eq!(
        ended.stderr,
        format!("{datagram}: no keys of SecurityTokenId 1 for this publisher in {keys}\n")
    );
}

#[test]
fn an_encrypting_key_that_is_wrong_shows_as_a_signature_that_is_right_and_bytes_that_are_not() {
    // The signature is over the ciphertext.
    let mut wrong = good_keys();
    wrong["encryptingKey"] = json!("ff".repeat(16));
    let (datagram, keys) = files("wrong_cipher", &wrong);
    let ended = run(&["decode", &datagram, "--keys", &keys]);
    assert_eq!(ended.code, 65);
    assert!(
        ended
            .stderr
            .contains("in DataSetMessage of DataSetWriterId 1"),
        "{}",
        ended.stderr
    );
}

#[test]
fn of_several_keys_those_of_the_publisher_and_group_are_used() {
    let with = |selectors: Value, wrong: bool| {
        let mut keys = good_keys();
        for (key, value) in selectors.as_object().unwrap() {
            keys[key] = value.clone();
        }
        if wrong {
            keys["signingKey"] = json!("00".repeat(32));
        }
        keys
    };
    let others = [
        with(
            json!({ "publisherId": { "type": "UInt16", "value": 1 } }),
            false,
        ),
        with(
            json!({ "publisherId": { "type": "Byte", "value": 2234 } }),
            false,
        ),
        with(json!({ "publisherId": 2234, "writerGroupId": 1 }), false),
        with(json!({ "publisherId": 2234 }), true),
    ];
    let right = with(
        json!({ "publisherId": { "type": "UInt16", "value": 2234 }, "writerGroupId": 100 }),
        false,
    );
    let (datagram, keys) = files("others", &json!(others));
    assert_eq!(run(&["decode", &datagram, "--keys", &keys]).code, 65);
    let all: Vec<_> = others.into_iter().chain([right]).collect();
    let (datagram, keys) = files("all", &json!(all));
    let shown = run(&["decode", &datagram, "--keys", &keys]).quiet();
    assert_eq!(fields(&shown)[0]["value"]["Value"], "cell");
}

#[cfg(unix)]
#[test]
fn keys_that_others_may_read_are_used_with_a_warning() {
    use std::os::unix::fs::PermissionsExt as _;

    let (datagram, keys) = files("wide", &good_keys());
    std::fs::set_permissions(&keys, std::fs::Permissions::from_mode(0o644)).unwrap();
    let ended = run(&["decode", &datagram, "--keys", &keys]);
    assert_eq!(ended.code, 0);
    assert_eq!(
        ended.stderr,
        format!("{keys}: mode 0644 lets others read the keys; chmod 600 {keys}\n")
    );
}

#[test]
fn keys_that_are_none_are_refused_with_the_reason() {
    let wrong = |key: &str, value: Value| {
        let mut keys = good_keys();
        keys[key] = value;
        keys
    };
    for (keys, said) in [
        (
            wrong("encryptingKey", json!("a0")),
            "key 0: 37 bytes of key data, 52 expected for PubSubAes128Ctr",
        ),
        (
            wrong("signingKey", json!("xy")),
            "key 0: signingKey: line 1, column 1: `x` is no hexadecimal digit",
        ),
        (
            wrong("policy", json!("None")),
            "key 0: `None` is no SecurityPolicy of PubSub",
        ),
        (wrong("extra", json!(1)), "unknown field `extra`"),
        (json!([{}]), "missing field `policy`"),
    ] {
        let (datagram, file) = files("refused", &keys);
        let ended = run(&["decode", &datagram, "--keys", &file]);
        assert_eq!(ended.code, 65);
        assert!(
            ended.stderr.starts_with(&format!("{file}: {said}")),
            "{}",
            ended.stderr
        );
    }
    let (datagram, _) = files("refused", &good_keys());
    let ended = run(&["decode", &datagram, "--keys", "/nowhere/keys.json"]);
    assert_eq!(ended.code, 74);
    assert!(
        ended.stderr.starts_with("cannot read /nowhere/keys.json: "),
        "{}",
        ended.stderr
    );
}

#[test]
fn a_secured_datagram_is_not_written_without_its_keys() {
    let vector = DatagramVector::load("wire_encrypt_aes128_r0");
    let json = file("secured.json", vector.json.to_string());
    let ended = run(&["encode", &json]);
    assert_eq!(ended.code, 65);
    assert_eq!(
        ended.stderr,
        format!("{json}: securityHeader: the message is secured: give its keys with --keys\n")
    );
}

#[test]
fn raw_data_is_read_in_the_way_that_is_asked_for() {
    // The length of an array of four Int32 is a UInt32 in the standard reading and an Int32 in the
    // open62541 reading; the bytes are equal.
    let vector = DatagramVector::load("raw_array_1d");
    let metadata = &vector.json["dataSetMessages"][0]["metaData"];
    let metadata = file("raw_array_1d.reading", metadata.to_string());
    let hex = file("raw_array_1d.hex", &vector.hex);
    for reading in ["standard", "open62541"] {
        let words = [
            "decode",
            &hex,
            "--metadata",
            &metadata,
            "--raw-reading",
            reading,
        ];
        let shown = run(&words).quiet();
        assert_eq!(
            fields(&shown)[1]["value"]["Value"],
            json!([1000, 2000, 3000, 4000])
        );
    }
    // For a matrix the standard encodes the number of dimensions as well.
    let vector = DatagramVector::load("raw_matrix_2d");
    let metadata = &vector.json["dataSetMessages"][0]["metaData"];
    let metadata = file("raw_matrix_2d.reading", metadata.to_string());
    let hex = file("raw_matrix_2d.hex", &vector.hex);
    let shown = run(&[
        "decode",
        &hex,
        "--metadata",
        &metadata,
        "--raw-reading",
        "open62541",
    ])
    .quiet();
    assert_eq!(fields(&shown)[0]["value"]["Dimensions"], json!([2, 3]));
    let ended = run(&["decode", &hex, "--metadata", &metadata]);
    assert_eq!(ended.code, 65);
    assert!(
        ended.stderr.starts_with(&format!(
            "{hex}: offset 15, in DataSetMessage of DataSetWriterId 62541, field 0 (dimension): 3 does not fit"
        )),
        "{}",
        ended.stderr
    );
}

#[test]
fn raw_data_without_metadata_is_shown_as_its_bytes() {
    let vector = DatagramVector::load("raw_double");
    let hex = file("raw_double.plain", &vector.hex);
    let shown: Value = serde_json::from_str(&run(&["decode", &hex]).quiet()).unwrap();
    let message = &shown["dataSetMessages"][0];
    assert_eq!(message["rawDataHex"], "182d4454fb210940");
    assert_eq!(message["fields"], json!([]));
}

#[test]
fn metadata_is_chosen_by_publisher_group_and_writer() {
    let vector = DatagramVector::load("raw_double");
    let double = json!([{ "builtInType": 11 }]);
    let entries = json!([
        { "publisherId": 1, "metaData": [{ "builtInType": 8 }] },
        { "writerGroupId": 1, "metaData": [{ "builtInType": 8 }] },
        { "dataSetWriterId": 1, "metaData": [{ "builtInType": 8 }] },
        { "publisherId": { "type": "UInt16", "value": 2234 }, "writerGroupId": 100, "dataSetWriterId": 62541,
          "metaData": double },
        { "metaData": [{ "builtInType": 8 }] },
    ]);
    let hex = file("chosen.hex", &vector.hex);
    for content in [entries, double] {
        let metadata = file("chosen.json", content.to_string());
        let shown = run(&["decode", &hex, "--metadata", &metadata]).quiet();
        assert_eq!(fields(&shown)[0]["value"]["UaType"], 11);
    }
}

#[test]
fn what_an_announcement_says_of_the_fields_is_metadata() {
    let vector = DatagramVector::load("composite_announce_metadata");
    let announced = file("announced.hex", &vector.hex);
    let shown: Value = serde_json::from_str(&run(&["decode", &announced]).quiet()).unwrap();
    let fields = &shown["announcement"]["metaData"];
    assert_eq!(fields[1]["name"], "pose");
    let metadata = file("announced.json", fields.to_string());
    // A Double, three Doubles, and a String of at most 32 bytes.
    let pose = [1.0_f64, 2.0, 3.0].map(f64::to_le_bytes).concat();
    let text = [&[2, 0, 0, 0][..], b"ok", &[0; 30]].concat();
    let payload = [&0.5_f64.to_le_bytes()[..], &[3, 0, 0, 0], &pose, &text].concat();
    // PublisherId 2234, a message of DataSetWriter 1, RawData.
    let head = [0xD1, 0x01, 0xBA, 0x08, 1, 1, 0, 0x03];
    let raw = file("announced.raw", [&head[..], &payload].concat());
    let shown = run(&["decode", &raw, "--metadata", &metadata]).quiet();
    let values: Vec<_> = fields_of(&shown)
        .iter()
        .map(|field| field["value"]["Value"].clone())
        .collect();
    assert_eq!(values, [json!(0.5), json!([1.0, 2.0, 3.0]), json!("ok")]);
}

fn fields_of(shown: &str) -> Vec<Value> {
    fields(shown).as_array().unwrap().clone()
}

#[test]
fn metadata_that_raw_data_cannot_have_is_refused_when_it_is_read() {
    let hex = file(
        "refused_metadata.hex",
        DatagramVector::load("raw_double").hex,
    );
    for (metadata, said) in [
        (
            json!([{ "builtInType": 22 }]),
            "entry 0.metaData[0]: an ExtensionObject without its structure",
        ),
        (
            json!([{ "builtInType": 11 }, { "builtInType": 17 }]),
            "entry 0.metaData[1]: NodeId is not allowed in RawData",
        ),
        (
            json!([{ "builtInType": 26 }]),
            "entry 0.metaData[0].builtInType: 1 to 25 are known",
        ),
        (json!({ "metadata": [] }), "unknown field `metadata`"),
    ] {
        let file = file("refused_metadata.json", metadata.to_string());
        let ended = run(&["decode", &hex, "--metadata", &file]);
        assert_eq!(ended.code, 65);
        assert!(
            ended.stderr.starts_with(&format!("{file}: {said}")),
            "{}",
            ended.stderr
        );
    }
}
