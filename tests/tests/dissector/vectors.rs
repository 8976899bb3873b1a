//! Compares tshark's view of the vectors' datagrams with the JSON description of each vector.

use std::path::PathBuf;

use serde_json::Value;
use system_tests::{Dissected, hex, is_true};
use uadp::{BuiltinType, NetworkMessage};

use crate::dissector::time::ticks;

/// A datagram with its description, both from `uadp/tests/vectors`.
pub(crate) struct DissectorVector {
    pub(crate) name: String,
    pub(crate) datagram: Vec<u8>,
    pub(crate) json: Value,
}

impl DissectorVector {
    pub(crate) fn load(name: &str) -> Self {
        let digits = read(&format!("{name}.hex"));
        Self {
            name: name.to_owned(),
            datagram: unhex(digits.trim()),
            json: serde_json::from_str(&read(&format!("{name}.json"))).unwrap(),
        }
    }

    pub(crate) fn all() -> Vec<Self> {
        let manifest: Value = serde_json::from_str(&read("MANIFEST.json")).unwrap();
        let entries = manifest.as_array().unwrap().iter();
        entries
            .map(|entry| Self::load(entry["name"].as_str().unwrap()))
            .collect()
    }

    pub(crate) fn is_malformed(&self) -> bool {
        !self.json["malformed"].is_null()
    }

    /// Returns the differences between tshark's view and the JSON.
    pub(crate) fn differences(&self, shown: &Dissected) -> Vec<String> {
        let mut check = Check {
            name: &self.name,
            differences: Vec::new(),
        };
        check.headers(&self.json, shown);
        check.writers(&self.json, shown);
        check.security(&self.json, shown);
        check.discovery(&self.json, shown);
        check.chunk(&self.json["chunk"], shown);
        check.promoted(&self.json["promotedFields"], shown);
        if self.json["securityHeader"]["encrypted"] == true {
            check.encrypted(self, shown);
        } else {
            check.messages(self, shown);
        }
        check.differences
    }
}

fn read(file: &str) -> String {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../uadp/tests/vectors");
    std::fs::read_to_string(folder.join(file)).unwrap()
}

pub(crate) fn unhex(digits: &str) -> Vec<u8> {
    let digits: Vec<u8> = digits
        .chars()
        .map(|digit| u8::try_from(digit.to_digit(16).unwrap()).unwrap())
        .collect();
    digits
        .chunks_exact(2)
        .map(|pair| pair[0] << 4 | pair[1])
        .collect()
}

struct Check<'v> {
    name: &'v str,
    differences: Vec<String>,
}

impl Check<'_> {
    fn same<S: AsRef<str>, E: AsRef<str>>(&mut self, field: &str, shown: &[S], expected: &[E]) {
        let shown: Vec<&str> = shown.iter().map(AsRef::as_ref).collect();
        let expected: Vec<&str> = expected.iter().map(AsRef::as_ref).collect();
        if shown != expected {
            self.differences.push(format!(
                "{}: {field} is {shown:?}, not {expected:?}",
                self.name
            ));
        }
    }

    /// Compares a number or text of the JSON, which may be null or missing.
    fn optional(&mut self, field: &str, expected: &Value, shown: &Dissected) {
        let expected: Vec<String> = plain(expected).into_iter().collect();
        self.same(field, &shown.all(field), &expected);
    }

    fn time(&mut self, field: &str, expected: Option<i64>, shown: &Dissected) {
        let shown: Vec<String> = shown
            .all(field)
            .iter()
            .map(|text| ticks(text).to_string())
            .collect();
        let expected: Vec<String> = expected.iter().map(i64::to_string).collect();
        self.same(field, &shown, &expected);
    }

    fn headers(&mut self, json: &Value, shown: &Dissected) {
        if let Some(id) = json["publisherId"].as_object() {
            let types = ["Byte", "UInt16", "UInt32", "UInt64", "String"];
            let of_type = types.iter().position(|name| id["type"] == *name).unwrap();
            // Without ExtendedFlags1, the PublisherId is a Byte.
            let shown_type = shown.one("uadp.publisher_id.type");
            self.same(
                "publisher_id.type",
                &[shown_type.unwrap_or_else(|| "0".to_owned())],
                &[of_type.to_string()],
            );
            let field = ["uadp.publisher_id", "uadp.publisher_id.string"][of_type / 4];
            self.optional(field, &id["value"], shown);
        } else {
            assert!(!shown.has("uadp.publisher_id"));
            assert!(!shown.has("uadp.publisher_id.string"));
        }
        let class_id: Vec<String> = json["dataSetClassId"]
            .as_str()
            .into_iter()
            .map(str::to_lowercase)
            .collect();
        self.same(
            "data_set_class_id",
            &shown.all("uadp.data_set_class_id"),
            &class_id,
        );
        let group = &json["groupHeader"];
        for (field, key) in [
            ("uadp.writer_group_id", "writerGroupId"),
            ("uadp.group_version", "groupVersion"),
            ("uadp.network_message_number", "networkMessageNumber"),
            ("uadp.sequence_number", "sequenceNumber"),
        ] {
            self.optional(field, &group[key], shown);
        }
        let timestamp = json["timestamp"]["ticks100ns"].as_i64();
        self.time("uadp.timestamp", timestamp, shown);
        self.optional("uadp.picoseconds", &json["picoSeconds"], shown);
    }

    fn writers(&mut self, json: &Value, shown: &Dissected) {
        let Some(ids) = json["dataSetWriterIds"].as_array() else {
            assert!(!shown.has("uadp.topic"));
            return;
        };
        let ids: Vec<String> = ids.iter().map(Value::to_string).collect();
        self.same(
            "dataset_writer_id",
            &shown.all("uadp.dataset_writer_id"),
            &ids,
        );
        let group = plain(&json["groupHeader"]["writerGroupId"]);
        let publisher = &json["publisherId"];
        let publisher = plain(&publisher["value"]).filter(|_| publisher["type"] != "String");
        let topics: Vec<String> = match (publisher, group) {
            (Some(publisher), Some(group)) => ids
                .iter()
                .map(|id| format!("ua_{publisher}_{group}_{id}"))
                .collect(),
            _ => Vec::new(),
        };
        self.same("topic", &shown.all("uadp.topic"), &topics);
    }

    fn security(&mut self, json: &Value, shown: &Dissected) {
        let header = &json["securityHeader"];
        assert_eq!(header.is_object(), shown.has("uadp.security"));
        if header.is_null() {
            return;
        }
        for (field, key) in [
            ("uadp.security.signed", "signed"),
            ("uadp.security.encrypted", "encrypted"),
            ("uadp.security.footer_enabled", "footerEnabled"),
            ("uadp.security.force_key_reset", "forceKeyReset"),
        ] {
            let expected = header[key].as_bool().unwrap_or_default().to_string();
            self.same(field, &[shown.is_set(field).to_string()], &[expected]);
        }
        self.optional("uadp.security.token_id", &header["securityTokenId"], shown);
        self.optional("uadp.security.footer_size", &header["footerSize"], shown);
        self.bytes("uadp.security.footer", header["footer"].as_str(), shown);
        let nonce = header["nonce"].as_str().filter(|nonce| !nonce.is_empty());
        self.bytes("uadp.security.nonce", nonce, shown);
        let random = nonce.map(|nonce| &nonce[..8]);
        self.bytes("uadp.security.nonce.random", random, shown);
        let sequence: Vec<String> = nonce
            .map(|nonce| u32::from_le_bytes(unhex(&nonce[8..]).try_into().unwrap()).to_string())
            .into_iter()
            .collect();
        let field = "uadp.security.nonce.sequence_number";
        self.same(field, &shown.all(field), &sequence);
    }

    /// Compares bytes with hex digits of the JSON.
    fn bytes(&mut self, field: &str, expected: Option<&str>, shown: &Dissected) {
        let expected: Vec<String> = expected
            .map(|digits| hex(&unhex(digits)))
            .into_iter()
            .collect();
        self.same(field, &shown.all(field), &expected);
    }

    fn encrypted(&mut self, vector: &DissectorVector, shown: &Dissected) {
        let at = |key: &str| -> usize {
            let security = &vector.json["security"];
            security[key].as_u64().unwrap().try_into().unwrap()
        };
        let (rest, signature) = vector.datagram.split_at(at("signatureOffset"));
        let payload = &rest[at("payloadOffset")..];
        for (field, bytes) in [
            ("uadp.encrypted_payload", payload),
            ("uadp.security.signature", signature),
        ] {
            self.same(field, &shown.all(field), &[hex(bytes)]);
        }
        assert!(!shown.has("uadp.dataset"));
    }

    fn discovery(&mut self, json: &Value, shown: &Dissected) {
        let kind = match json["networkMessageType"].as_str() {
            None => "0",
            Some("discoveryAnnouncement") => "2",
            Some(_) => "1",
        };
        self.same("message_type", &shown.all("uadp.message_type"), &[kind]);
        let probe = &json["probe"];
        let announcement = &json["announcement"];
        for (field, expected) in [
            ("uadp.probe.information_type", &probe["informationType"]),
            ("uadp.announcement.type", &announcement["type"]),
            (
                "uadp.announcement.sequence_number",
                &announcement["sequenceNumber"],
            ),
        ] {
            self.optional(field, expected, shown);
        }
        if announcement["type"] == 2 {
            let status = announcement["statusCode"].as_u64().unwrap();
            let field = "uadp.announcement.status";
            self.same(field, &shown.all(field), &[format!("{status:#010x}")]);
            self.optional(
                "uadp.dataset_writer_id",
                &announcement["dataSetWriterId"],
                shown,
            );
        }
        for ids in [probe, announcement].map(|body| body["dataSetWriterIds"].as_array()) {
            let ids: Vec<String> = ids.into_iter().flatten().map(Value::to_string).collect();
            if !ids.is_empty() {
                self.same(
                    "dataset_writer_id",
                    &shown.all("uadp.dataset_writer_id"),
                    &ids,
                );
            }
        }
    }

    fn chunk(&mut self, chunk: &Value, shown: &Dissected) {
        for (field, key) in [
            (
                "uadp.chunk.message_sequence_number",
                "messageSequenceNumber",
            ),
            ("uadp.chunk.offset", "chunkOffset"),
            ("uadp.chunk.total_size", "totalSize"),
        ] {
            self.optional(field, &chunk[key], shown);
        }
        self.bytes("uadp.chunk.data", chunk["chunkDataHex"].as_str(), shown);
    }

    fn promoted(&mut self, fields: &Value, shown: &Dissected) {
        let Some(fields) = fields.as_array() else {
            return;
        };
        let promoted = shown.parts("uadp.promoted_fields");
        let items = promoted[0].parts("uadp.field");
        assert_eq!(items.len(), fields.len(), "{}", self.name);
        for (item, field) in items.iter().zip(fields) {
            self.variant(field, item);
        }
    }

    fn messages(&mut self, vector: &DissectorVector, shown: &Dissected) {
        let expected = vector.json["dataSetMessages"].as_array();
        let expected: Vec<&Value> = expected.into_iter().flatten().collect();
        // A reassembled message is described by its chunks and has no description itself.
        if !vector.json["chunk"].is_null() {
            return;
        }
        let messages = shown.parts("uadp.dataset");
        assert_eq!(messages.len(), expected.len(), "{}", vector.name);
        for (number, (json, shown)) in expected.into_iter().zip(&messages).enumerate() {
            self.message_header(json, shown);
            if json["fieldEncoding"] == "RawData" {
                let message = NetworkMessage::decode(&vector.datagram).unwrap();
                let message = message.messages().nth(number).unwrap().unwrap();
                let raw = hex(message.payload());
                let field = "uadp.dataset.raw_data";
                self.same(field, &shown.all(field), &[raw]);
            } else {
                self.fields(json["fields"].as_array().unwrap(), shown);
            }
        }
    }

    fn message_header(&mut self, json: &Value, shown: &Dissected) {
        let kinds = ["keyFrame", "deltaFrame", "event", "keepAlive"];
        let kind = kinds.iter().position(|kind| json["type"] == *kind).unwrap();
        self.same("kind", &shown.all("uadp.dataset.kind"), &[kind.to_string()]);
        let encodings = ["Variant", "RawData", "DataValue"];
        let encoding = encodings
            .iter()
            .position(|name| json["fieldEncoding"] == *name)
            .unwrap();
        self.same(
            "field_encoding",
            &shown.all("uadp.dataset.field_encoding"),
            &[encoding.to_string()],
        );
        let valid = shown.is_set("uadp.dataset.valid");
        assert_eq!(json["valid"], valid, "{}", self.name);
        for (field, key) in [
            ("uadp.dataset.sequence_number", "sequenceNumber"),
            ("uadp.dataset.picoseconds", "picoSeconds"),
            ("uadp.dataset.major_version", "majorVersion"),
            ("uadp.dataset.minor_version", "minorVersion"),
        ] {
            self.optional(field, &json[key], shown);
        }
        let status: Vec<String> = json["status16"]
            .as_u64()
            .map(|status| format!("{status:#06x}"))
            .into_iter()
            .collect();
        self.same("status", &shown.all("uadp.dataset.status"), &status);
        let timestamp = json["timestamp"]["ticks100ns"].as_i64();
        self.time("uadp.dataset.timestamp", timestamp, shown);
    }

    fn fields(&mut self, expected: &[Value], shown: &Dissected) {
        let fields = shown.parts("uadp.field");
        assert_eq!(fields.len(), expected.len(), "{}", self.name);
        for ((json, shown), number) in expected.iter().zip(&fields).zip(0..) {
            let index = json["index"].as_u64().unwrap_or(number);
            self.same(
                "index",
                &shown.all("uadp.field.index"),
                &[index.to_string()],
            );
            let value = &json["value"];
            self.variant(value, shown);
            let status = [&value["Status"]["Code"], &value["StatusCode"]["Code"]];
            let status: Vec<String> = status
                .into_iter()
                .filter_map(Value::as_u64)
                .map(|code| format!("{code:#010x}"))
                .collect();
            self.same("status", &shown.all("uadp.field.status"), &status);
            for (field, key) in [
                ("uadp.field.source_timestamp", "SourceTimestamp"),
                ("uadp.field.server_timestamp", "ServerTimestamp"),
            ] {
                self.time(field, value[key].as_str().map(ticks), shown);
            }
            for (field, key) in [
                ("uadp.field.source_picoseconds", "SourcePicoseconds"),
                ("uadp.field.server_picoseconds", "ServerPicoseconds"),
            ] {
                self.optional(field, &value[key], shown);
            }
        }
    }

    /// Compares a value of the JSON, `{"UaType": .., "Value": ..}`; `{}` is the null Variant.
    fn variant(&mut self, json: &Value, shown: &Dissected) {
        let Some(builtin) = json["UaType"].as_u64() else {
            return;
        };
        // Only the type of the item itself: nested values have types, too.
        let encoding = shown.child("uadp.field.variant_encoding_tree").unwrap();
        self.same(
            "type",
            &encoding.all("uadp.field.type"),
            &[builtin.to_string()],
        );
        let dimensions: Vec<String> = json["Dimensions"]
            .as_array()
            .into_iter()
            .flatten()
            .map(Value::to_string)
            .collect();
        self.same("dimension", &shown.all("uadp.field.dimension"), &dimensions);
        let value = &json["Value"];
        match (builtin, value.as_array()) {
            (24, Some(elements)) => {
                let items = shown.parts("uadp.field.variant");
                assert_eq!(items.len(), elements.len(), "{}", self.name);
                for (element, item) in elements.iter().zip(&items) {
                    self.variant(element, item);
                }
            }
            (21, Some(elements)) => self.texts(&elements.iter().collect::<Vec<_>>(), shown),
            (21, None) => self.texts(&[value], shown),
            (_, Some(elements)) => {
                self.values(builtin, &elements.iter().collect::<Vec<_>>(), shown)
            }
            (_, None) => self.values(builtin, &[value], shown),
        }
    }

    fn texts(&mut self, expected: &[&Value], shown: &Dissected) {
        for (field, key) in [
            ("uadp.field.localizedtext.locale", "Locale"),
            ("uadp.field.localizedtext.text", "Text"),
        ] {
            let expected: Vec<&str> = expected
                .iter()
                .filter_map(|text| text[key].as_str())
                .collect();
            self.same(field, &shown.all(field), &expected);
        }
    }

    fn values(&mut self, builtin: u64, expected: &[&Value], shown: &Dissected) {
        let builtin = BuiltinType::from_id(builtin.try_into().unwrap()).unwrap();
        let field = format!("uadp.field.{}", builtin.name().to_lowercase());
        // The null ExtensionObject has neither type nor body.
        let (nulls, expected): (Vec<&Value>, Vec<&Value>) = expected
            .iter()
            .partition(|json| json.is_null() && builtin != BuiltinType::ExtensionObject);
        // The JSON does not distinguish a null array from an empty array.
        if !(nulls.is_empty() && expected.is_empty()) {
            let shown_nulls = shown.all("uadp.field.null").len();
            assert_eq!(shown_nulls, nulls.len(), "{}", self.name);
        }
        let shown = shown.all(&field);
        if shown.len() != expected.len() {
            self.differences.push(format!(
                "{}: {field} is {shown:?}, not {expected:?}",
                self.name
            ));
        }
        for (shown, expected) in shown.iter().zip(expected) {
            if !same_value(builtin, shown, expected) {
                self.differences
                    .push(format!("{}: {field} is {shown}, not {expected}", self.name));
            }
        }
    }
}

fn plain(json: &Value) -> Option<String> {
    match json {
        Value::Null => None,
        Value::String(text) => Some(text.clone()),
        other => Some(other.to_string()),
    }
}

fn same_value(builtin: BuiltinType, shown: &str, json: &Value) -> bool {
    match builtin {
        BuiltinType::Boolean => json == is_true(shown),
        // Wireshark prints 15 digits of a Double and 6 of a Float.
        BuiltinType::Double => same_number(shown, json, 1e-14),
        BuiltinType::Float => same_number(shown, json, 1e-5),
        BuiltinType::DateTime => ticks(shown) == ticks(json.as_str().unwrap()),
        BuiltinType::Guid => shown == json.as_str().unwrap().to_lowercase(),
        BuiltinType::ByteString => shown == hex(&base64(json.as_str().unwrap())),
        BuiltinType::StatusCode => shown == format!("{:#010x}", json["Code"].as_u64().unwrap()),
        BuiltinType::QualifiedName if json.is_object() => {
            shown
                == format!(
                    "{}:{}",
                    json["NamespaceIndex"],
                    json["Name"].as_str().unwrap()
                )
        }
        // The dissector shows the bodies of structures as bytes.
        BuiltinType::ExtensionObject => true,
        _ => Some(shown) == plain(json).as_deref(),
    }
}

fn same_number(shown: &str, json: &Value, tolerance: f64) -> bool {
    let shown: f64 = shown.parse().unwrap();
    match json.as_f64() {
        None => shown.is_nan() && json == "NaN",
        Some(expected) => (shown - expected).abs() <= expected.abs() * tolerance,
    }
}

fn base64(text: &str) -> Vec<u8> {
    let digits = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let value = |digit: &u8| digits.iter().position(|other| other == digit);
    let values: Vec<u32> = text
        .as_bytes()
        .iter()
        .filter_map(value)
        .map(|value| u32::try_from(value).unwrap())
        .collect();
    values
        .chunks(4)
        .flat_map(|group| {
            let bits = (0..4).fold(0, |bits, at| bits << 6 | group.get(at).unwrap_or(&0));
            bits.to_be_bytes()[1..group.len()].to_vec()
        })
        .collect()
}
