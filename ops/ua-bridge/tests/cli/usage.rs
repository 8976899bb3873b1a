//! Arguments, the formats of input and output, and refused JSON.

use serde_json::{Value, json};

use crate::program::{file, named, run, run_on};
use crate::vectors::DatagramVector;

#[test]
fn help_and_version_are_told_and_other_words_refused() {
    let help = run(&["--help"]).quiet();
    assert!(help.contains("decode") && help.contains("encode"), "{help}");
    for verb in ["decode", "encode"] {
        let help = run(&[verb, "--help"]).quiet();
        assert!(
            help.contains("--keys") && help.contains("--raw-reading"),
            "{help}"
        );
    }
    let version = run(&["--version"]).quiet();
    assert_eq!(version, format!("ua-space {}\n", env!("CARGO_PKG_VERSION")));
    for words in [
        &[][..],
        &["decode"],
        &["encode", "--port", "4840", "x"],
        &["decode", "--port", "none", "x"],
        &["decode", "--raw-reading", "other", "x"],
        &["peel", "x"],
    ] {
        let ended = run(words);
        assert_eq!((ended.code, ended.stdout.as_str()), (64, ""), "{words:?}");
        assert!(!ended.stderr.is_empty());
    }
}

#[test]
fn a_file_that_is_not_there_is_told_with_74() {
    for verb in ["decode", "encode"] {
        let ended = run(&[verb, "/nowhere/datagram"]);
        assert_eq!((ended.code, ended.stdout.as_str()), (74, ""));
        assert!(
            ended.stderr.starts_with("cannot read /nowhere/datagram: "),
            "{}",
            ended.stderr
        );
    }
}

#[cfg(target_os = "linux")]
#[test]
fn an_output_that_takes_nothing_is_told_with_74() {
    let full = std::fs::OpenOptions::new()
        .write(true)
        .open("/dev/full")
        .unwrap();
    let datagram = file("full.hex", DatagramVector::load("pubid_byte").hex);
    let output = named("ua-space")
        .args(["decode", &datagram])
        .stdout(full)
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(74));
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(said.starts_with("cannot write the output: "), "{said}");
}

#[test]
fn a_datagram_is_read_as_hexadecimal_text_and_as_its_bytes() {
    let vector = DatagramVector::load("wire_tutorial_layout");
    let wanted = run_on(&["decode", "-"], vector.hex.as_bytes()).quiet();
    let bytes = vector.bytes();
    let words: Vec<_> = bytes.iter().map(|byte| format!("0x{byte:02X}")).collect();
    let (head, tail) = words.split_at(7);
    let text = format!(
        "# two lines\n{}, # headers\n\n{}\n",
        head.join(", "),
        tail.join(", ")
    );
    assert_eq!(run_on(&["decode", "-"], text.as_bytes()).quiet(), wanted);
    assert_eq!(run_on(&["decode", "-"], &bytes).quiet(), wanted);
    let raw = file("tutorial.bin", &bytes);
    assert_eq!(run(&["decode", &raw]).quiet(), wanted);
}

#[test]
fn what_holds_no_datagram_is_refused() {
    for (content, said) in [
        ("", "empty"),
        (" \n", "empty"),
        ("# nothing", "no hexadecimal digits"),
        ("f1 0g", "line 1, column 5: `g` is no hexadecimal digit"),
        (
            "{\"uadpVersion\": 1}",
            "this is JSON; `ua-space encode` makes datagrams of it",
        ),
    ] {
        let ended = run_on(&["decode", "-"], content.as_bytes());
        assert_eq!((ended.code, ended.stdout.as_str()), (65, ""), "{content}");
        assert_eq!(ended.stderr, format!("stdin: {said}\n"));
    }
}

#[test]
fn several_datagrams_are_written_a_line_each_and_read_so() {
    let names = ["pubid_byte", "delta_variant", "composite_probe_endpoints"];
    let vectors = names.map(DatagramVector::load);
    let wanted: String = vectors
        .iter()
        .map(|vector| format!("{}\n", vector.hex))
        .collect();
    let array = json!(
        vectors
            .iter()
            .map(|vector| &vector.json)
            .collect::<Vec<_>>()
    )
    .to_string();
    let lines = vectors
        .each_ref()
        .map(|vector| vector.json.to_string())
        .join("\n");
    for json in [array, lines] {
        assert_eq!(run_on(&["encode", "-"], json.as_bytes()).quiet(), wanted);
        let raw = file("several.json", &json);
        let bytes: Vec<_> = vectors.iter().flat_map(DatagramVector::bytes).collect();
        let output = named("ua-space")
            .args(["encode", "--raw", &raw])
            .output()
            .unwrap();
        assert_eq!(output.stdout, bytes);
    }
    let shown = run_on(&["decode", "--lines", "-"], wanted.as_bytes()).quiet();
    assert_eq!(shown.lines().count(), 3);
    assert_eq!(run_on(&["encode", "-"], shown.as_bytes()).quiet(), wanted);
    let array = run_on(&["decode", "--lines", "--array", "-"], wanted.as_bytes()).quiet();
    assert_eq!(serde_json::from_str::<Vec<Value>>(&array).unwrap().len(), 3);
    assert_eq!(run_on(&["encode", "-"], array.as_bytes()).quiet(), wanted);
}

#[test]
fn json_that_is_no_datagram_is_refused_with_its_place() {
    let field = |value: Value| json!({ "dataSetMessages": [{ "fields": [{ "value": value }] }] });
    for (json, said) in [
        ("".to_owned(), "holds no datagram"),
        (
            "{".to_owned(),
            "EOF while parsing an object at line 1 column 1",
        ),
        (
            "{\n \"publisherid\": 1}".to_owned(),
            "unknown field `publisherid` at line 2 column 14",
        ),
        (
            "{\"groupHeader\": {\"writerGroupId\": 65536}}".to_owned(),
            "invalid value: integer `65536`, expected u16 at line 1 column 39",
        ),
        (
            field(json!({ "UaType": 4, "Value": 40_000 })).to_string(),
            "dataSetMessages[0].fields[0].Value: expected Int16, found 40000",
        ),
        (
            field(json!({ "UaType": 12, "Value": ["a", 1] })).to_string(),
            "dataSetMessages[0].fields[0].Value[1]: expected a text or null, found 1",
        ),
        (
            field(json!({ "UaType": 26, "Value": 1 })).to_string(),
            "dataSetMessages[0].fields[0]: unknown UaType 26: expected 0 to 25",
        ),
        (
            field(json!({ "Value": 1 })).to_string(),
            "dataSetMessages[0].fields[0]: a Value needs its UaType",
        ),
        (
            field(json!({ "UaType": 6, "Value": 1, "Status": { "Code": 0 } })).to_string(),
            "dataSetMessages[0].fields[0]: Status and timestamps belong to a DataValue, not to a Variant",
        ),
        (
            field(json!({ "UaType": 6, "Value": [1, 2, 3], "Dimensions": [2, 2] })).to_string(),
            "dataSetMessages[0].fields[0].Dimensions: array dimensions do not fit its 3 elements",
        ),
        (
            field(json!({ "UaType": 22, "Value": { "UaTypeId": "i=884", "Low": 1 } })).to_string(),
            "dataSetMessages[0].fields[0].Value: the structure lacks the field `High`",
        ),
        (
            json!({ "publisherId": { "type": "Byte", "value": 256 } }).to_string(),
            "publisherId.value: expected a Byte, found 256",
        ),
        (
            json!({ "dataSetWriterIds": [1, 2], "dataSetMessages": [{}] }).to_string(),
            "dataSetWriterIds: 2 ids for 1 dataSetMessages",
        ),
        (
            json!({ "dataSetMessages": [{ "type": "deltaFrame", "fields": [{ "value": {} }] }] })
                .to_string(),
            "dataSetMessages[0].fields[0]: a field of a delta frame wants its index",
        ),
        (
            json!({ "dataSetMessages": [{ "type": "event", "fieldEncoding": "RawData" }] })
                .to_string(),
            "dataSetMessages[0]: a Event is never encoded as RawData",
        ),
    ] {
        let ended = run_on(&["encode", "-"], json.as_bytes());
        assert_eq!((ended.code, ended.stdout.as_str()), (65, ""), "{json}");
        assert_eq!(ended.stderr, format!("stdin: {said}\n"));
    }
}

/// Values that the vectors do not contain, and their alternative forms.
#[test]
fn values_survive_the_way_there_and_back() {
    let fields = json!([
        { "UaType": 10, "Value": 0.1 },
        { "UaType": 10, "Value": 3.4028235e38 },
        { "UaType": 11, "Value": -0.0 },
        { "UaType": 11, "Value": 5e-324 },
        { "UaType": 11, "Value": 3.1415926518420854 },
        { "UaType": 11, "Value": "-Infinity" },
        { "UaType": 8, "Value": "-9223372036854775808" },
        { "UaType": 9, "Value": "18446744073709551615" },
        { "UaType": 13, "Value": "-027000-02-28T00:00:00.0000001Z" },
        { "UaType": 12, "Value": [], "NullArray": true },
        { "UaType": 17, "Value": "ns=3;s" },
        { "UaType": 18, "Value": "svr=2;nsu=urn:a%3Bb;ns=4;i=7" },
        { "UaType": 20, "Value": "0:3:x" },
        { "UaType": 20, "Value": { "Name": null, "NamespaceIndex": 2 } },
        { "UaType": 21, "Value": { "Locale": null, "Text": "only" } },
        { "UaType": 22, "Value": { "UaTypeId": "ns=2;i=7", "UaEncoding": 0 } },
        { "UaType": 22, "Value": { "UaTypeId": "ns=2;i=7", "UaEncoding": 2, "UaBody": "<a/>" } },
        { "UaType": 22, "Value": { "UaTypeId": "i=886", "UaEncoding": 1, "UaBody": "AAAA" } },
        { "UaType": 23, "Value": { "UaType": 0, "Status": { "Code": 2_147_483_648_u32, "Symbol": "Bad" } } },
        { "UaType": 23, "Value": { "Status": { "Code": 1 } } },
        { "UaType": 24, "Value": [{}, { "UaType": 24, "Value": [{ "UaType": 1, "Value": true }] }] },
        { "UaType": 25, "Value": {
            "SymbolicId": 1, "LocalizedText": -2, "AdditionalInfo": null, "InnerStatusCode": { "Code": 5 },
            "InnerDiagnosticInfo": { "Locale": 3 },
        } },
    ]);
    let fields: Vec<_> = fields
        .as_array()
        .unwrap()
        .iter()
        .map(|value| json!({ "value": value }))
        .collect();
    let json = json!({ "dataSetMessages": [{ "fields": fields }] });
    let hex = run_on(&["encode", "-"], json.to_string().as_bytes()).quiet();
    let shown = run_on(&["decode", "-"], hex.as_bytes()).quiet();
    let shown: Value = serde_json::from_str(&shown).unwrap();
    for (found, wanted) in shown["dataSetMessages"][0]["fields"]
        .as_array()
        .unwrap()
        .iter()
        .zip(fields)
    {
        assert_eq!(*found, wanted);
    }
    let again = run_on(&["encode", "-"], shown.to_string().as_bytes()).quiet();
    assert_eq!(again, hex);
}

#[test]
fn other_forms_of_the_same_values_are_taken() {
    for (one, other) in [
        (
            json!({ "UaType": 8, "Value": 5 }),
            json!({ "UaType": 8, "Value": "5" }),
        ),
        (
            json!({ "UaType": 11, "Value": 5 }),
            json!({ "UaType": 11, "Value": 5.0 }),
        ),
        (
            json!({ "UaType": 19, "Value": 7 }),
            json!({ "UaType": 19, "Value": { "Code": 7 } }),
        ),
        (
            json!({ "UaType": 20, "Value": "x" }),
            json!({ "UaType": 20, "Value": { "Name": "x" } }),
        ),
        (json!({ "UaType": 0 }), json!({})),
        (
            json!({ "UaType": 22, "Value": { "TypeId": "i=886", "BodyBase64": "AAAAAAAAAAAAAAAAAABZQA==" } }),
            json!({ "UaType": 22, "Value": { "UaTypeId": "i=884", "Low": 0, "High": 100 } }),
        ),
    ] {
        let hex = |value: &Value| {
            let json = json!({ "dataSetMessages": [{ "fields": [{ "value": value }] }] });
            run_on(&["encode", "-"], json.to_string().as_bytes()).quiet()
        };
        assert_eq!(hex(&one), hex(&other), "{one} and {other}");
    }
}

#[test]
fn padding_to_a_configured_size_is_kept() {
    let json = json!({
        "dataSetWriterIds": [1, 2, 3],
        "dataSetMessages": [
            { "configuredSize": 20, "fields": [{ "value": { "UaType": 6, "Value": 0 } }] },
            { "fields": [{ "value": { "UaType": 6, "Value": 0 } }] },
            { "configuredSize": 9, "type": "keepAlive", "sequenceNumber": 0 },
        ],
    });
    let hex = run_on(&["encode", "-"], json.to_string().as_bytes()).quiet();
    let shown: Value =
        serde_json::from_str(&run_on(&["decode", "-"], hex.as_bytes()).quiet()).unwrap();
    let sizes: Vec<_> = shown["dataSetMessages"]
        .as_array()
        .unwrap()
        .iter()
        .map(|message| message["configuredSize"].clone())
        .collect();
    assert_eq!(sizes, [json!(20), Value::Null, json!(9)]);
    assert_eq!(
        run_on(&["encode", "-"], shown.to_string().as_bytes()).quiet(),
        hex
    );
}

#[test]
fn a_message_that_is_not_valid_is_kept_whatever_it_holds() {
    // A cleared valid bit, then flags that no message has, followed by a valid message.
    let hex = "f101020001050002 0a000b00 04000800 20ffeedd 010100062a000000".replace(' ', "");
    let shown = run_on(&["decode", "-"], hex.as_bytes()).quiet();
    let json: Value = serde_json::from_str(&shown).unwrap();
    let messages = &json["dataSetMessages"];
    assert_eq!(messages[0]["valid"], false);
    assert_eq!(messages[0]["messageHex"], "20ffeedd");
    assert_eq!(messages[0]["fields"], json!([]));
    assert_eq!(messages[1]["fields"][0]["value"]["Value"], 42);
    assert_eq!(
        run_on(&["encode", "-"], shown.as_bytes())
            .quiet()
            .trim_end(),
        hex
    );
}
