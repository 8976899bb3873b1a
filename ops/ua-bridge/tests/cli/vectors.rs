//! Decodes every datagram of `uadp/tests/vectors` to JSON, and encodes it again.

use std::fs;
use std::path::PathBuf;

use serde_json::{Map, Value};

use crate::normal::normal;
use crate::program::{ProgramEnd, file, run, run_on};

/// Vectors with JSON that does not encode to their datagram, each with the reason.
const NOT_WRITTEN: &[(&str, &str)] = &[
    ("asyncua_raw", "the JSON does not say what the RawData is"),
    (
        "composite_announce_metadata_unknown_writer",
        "the JSON does not say what stands in the place of the metadata",
    ),
    (
        "heartbeat_keyframe",
        "it lacks the FieldCount, which we write",
    ),
    (
        "variant_array_null",
        "the JSON does not say that the array is null",
    ),
    ("wire_heartbeat", "it lacks the FieldCount, which we write"),
];

#[test]
fn every_vector_is_shown_as_its_json() {
    let mut shown = 0;
    let mut wrong = Vec::new();
    for vector in vectors() {
        if vector.is_malformed() {
            continue;
        }
        let ended = vector.decode();
        if (ended.code, ended.stderr.as_str()) != (0, "") {
            wrong.push(format!("{}: {}", vector.name, ended.stderr));
            continue;
        }
        let mut found = normal(serde_json::from_str(&ended.stdout).unwrap());
        let wanted = normal(vector.json.clone());
        if wanted
            .pointer("/announcement")
            .is_some_and(|said| said.get("bodyHex").is_none())
        {
            found["announcement"]
                .as_object_mut()
                .unwrap()
                .remove("bodyHex");
        }
        if found == wanted {
            shown += 1;
        } else {
            wrong.push(format!("{}:\n {found}\nnot\n {wanted}", vector.name));
        }
    }
    assert!(
        wrong.is_empty(),
        "{} of them:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
    assert_eq!(shown, 195 - 4, "195 vectors, 4 of them malformed");
}

#[test]
fn the_json_of_every_vector_makes_its_datagram() {
    let mut wrong = Vec::new();
    for vector in vectors() {
        let exception = NOT_WRITTEN.iter().find(|(name, _)| *name == vector.name);
        if vector.is_malformed() {
            continue;
        }
        let mut json = vector.json.clone();
        if let Some(metadata) = vector.metadata() {
            json["dataSetMessages"][0]["metaData"] = metadata;
        }
        let written = vector.encode(&json.to_string());
        let same = written.code == 0 && written.stdout.trim_end() == vector.hex;
        match (same, exception) {
            (true, None) | (false, Some(_)) => {}
            (true, Some((_, why))) => {
                wrong.push(format!("{} is written, although {why}", vector.name))
            }
            (false, None) => wrong.push(format!(
                "{}: {}{}not\n{}",
                vector.name, written.stderr, written.stdout, vector.hex
            )),
        }
    }
    assert!(
        wrong.is_empty(),
        "{} of them:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}

#[test]
fn what_was_shown_makes_the_datagram_again() {
    let mut wrong = Vec::new();
    for vector in vectors() {
        // The encoder adds the missing FieldCount.
        if vector.is_malformed() || vector.name.contains("heartbeat") {
            continue;
        }
        let written = vector.encode(&vector.decode().stdout);
        if written.stdout.trim_end() != vector.hex {
            wrong.push(format!(
                "{}: {}{}not\n{}",
                vector.name, written.stderr, written.stdout, vector.hex
            ));
        }
    }
    assert!(
        wrong.is_empty(),
        "{} of them:\n{}",
        wrong.len(),
        wrong.join("\n")
    );
}

#[test]
fn secured_vectors_are_kept_as_they_are_without_keys() {
    let mut count = 0;
    for vector in vectors()
        .into_iter()
        .filter(|vector| vector.json.get("security").is_some())
    {
        let ended = run_on(&["decode", "-"], vector.hex.as_bytes());
        assert_eq!(ended.code, 0, "{}", ended.stderr);
        assert_eq!(
            ended.stderr,
            "stdin: 1 secured, and shown as they are without --keys\n"
        );
        let again = run_on(&["encode", "-"], ended.stdout.as_bytes()).quiet();
        assert_eq!(again.trim_end(), vector.hex);
        count += 1;
    }
    assert_eq!(count, 6);
}

#[test]
fn names_of_status_codes_are_those_of_the_vectors() {
    let mut count = 0;
    for vector in vectors() {
        let said = symbols(&vector.json);
        if vector.is_malformed() || said.is_empty() {
            continue;
        }
        let shown: Value = serde_json::from_str(&vector.decode().stdout).unwrap();
        for (code, symbol) in symbols(&shown) {
            assert_eq!(said.get(&code), Some(&symbol), "{}", vector.name);
            count += 1;
        }
    }
    assert!(count >= 10, "{count}");
}

/// Returns the symbols of status codes, by code.
fn symbols(json: &Value) -> Map<String, Value> {
    match json {
        Value::Object(object) => {
            let mut found: Map<_, _> = object.values().flat_map(symbols).collect();
            if let (Some(code), Some(symbol)) = (object.get("Code"), object.get("Symbol")) {
                found.insert(code.to_string(), symbol.clone());
            }
            found
        }
        Value::Array(parts) => parts.iter().flat_map(symbols).collect(),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => Map::new(),
    }
}

/// A datagram and its content.
pub(crate) struct DatagramVector {
    pub(crate) name: String,
    /// One line of hexadecimal digits without a line end.
    pub(crate) hex: String,
    pub(crate) json: Value,
}

impl DatagramVector {
    pub(crate) fn load(name: &str) -> Self {
        let text = |suffix| fs::read_to_string(folder().join(format!("{name}.{suffix}"))).unwrap();
        Self {
            name: name.to_owned(),
            hex: text("hex").trim_end().to_owned(),
            json: serde_json::from_str(&text("json")).unwrap(),
        }
    }

    pub(crate) fn bytes(&self) -> Vec<u8> {
        let digits = self.hex.as_bytes().chunks(2);
        digits
            .map(|pair| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap())
            .collect()
    }

    /// Decodes the datagram with the keys and metadata of the vector.
    fn decode(&self) -> ProgramEnd {
        let hex = file(&format!("{}.hex", self.name), &self.hex);
        self.with_files("decode", &hex)
    }

    /// Encodes JSON with the keys and metadata of this vector.
    fn encode(&self, json: &str) -> ProgramEnd {
        let json = file(&format!("{}.json", self.name), json);
        self.with_files("encode", &json)
    }

    fn with_files(&self, verb: &str, input: &str) -> ProgramEnd {
        let mut words = vec![verb, input, "--raw-reading", "open62541"];
        let keys = self
            .json
            .get("security")
            .map(|keys| file(&format!("{}.keys", self.name), keys.to_string()));
        if let Some(keys) = &keys {
            words.extend(["--keys", keys]);
        }
        let metadata = self
            .metadata()
            .map(|metadata| file(&format!("{}.metadata", self.name), metadata.to_string()));
        if let Some(metadata) = &metadata {
            words.extend(["--metadata", metadata]);
        }
        run(&words)
    }

    /// Returns the metadata for the decoding of the RawData.
    fn metadata(&self) -> Option<Value> {
        let messages = self.json.get("dataSetMessages")?.as_array()?;
        let mut metadata = messages.first()?.get("metaData")?.clone();
        if self.name == "raw_structure_range" {
            // The vector states that the type is a structure, but does not name it.
            metadata[0]["dataType"] = "i=884".into();
        }
        Some(metadata)
    }

    pub(crate) fn is_malformed(&self) -> bool {
        self.json.get("malformed").is_some_and(|why| !why.is_null())
    }
}

pub(crate) fn vectors() -> Vec<DatagramVector> {
    let manifest = fs::read_to_string(folder().join("MANIFEST.json")).unwrap();
    let manifest: Vec<Value> = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest.len(), 195);
    manifest
        .iter()
        .map(|entry| DatagramVector::load(entry["name"].as_str().unwrap()))
        .collect()
}

fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../uadp/tests/vectors")
}

#[test]
fn the_exceptions_are_vectors() {
    for (name, _) in NOT_WRITTEN {
        assert!(folder().join(format!("{name}.json")).exists(), "{name}");
    }
}
