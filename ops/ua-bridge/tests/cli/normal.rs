//! Converts the JSON of a vector and the JSON of `decode` to one style, without keys that do not
//! describe the datagram.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use serde_json::{Value, json};

/// Keys about a vector that do not describe the content of its datagram.
const ASIDE: &[&str] = &[
    "name",
    "producer",
    "length",
    "notes",
    "asyncuaSelfDecode",
    "open62541SelfDecode",
    "jsonSource",
    "contested",
    "security",
    "trailingBytes",
    // In prose; captures show the whole message.
    "reassembled",
];

/// Normalizes the JSON of a datagram.
pub(crate) fn normal(mut json: Value) -> Value {
    let object = json.as_object_mut().unwrap();
    object.retain(|key, value| !ASIDE.contains(&key.as_str()) && !value.is_null());
    if let Some(header) = object
        .get_mut("securityHeader")
        .and_then(Value::as_object_mut)
    {
        for key in ["footerEnabled", "forceKeyReset"] {
            header.entry(key).or_insert(json!(false));
        }
    }
    for message in object
        .get_mut("dataSetMessages")
        .and_then(Value::as_array_mut)
        .into_iter()
        .flatten()
    {
        let message = message.as_object_mut().unwrap();
        // Metadata from the user, and the bytes of RawData shown without metadata.
        message.remove("metaData");
        message.remove("rawDataHex");
    }
    if let Some(announcement) = object
        .get_mut("announcement")
        .and_then(Value::as_object_mut)
    {
        for key in READABLE {
            announcement.remove(*key);
        }
        // `decode` shows the status of a connection, which the vector omits.
        if announcement["type"] == 4 {
            announcement.remove("statusCode");
        }
    }
    parts(&mut json);
    json
}

/// Keys of an announcement that `decode` shows besides `bodyHex`; the vectors have only some of
/// them.
const READABLE: &[&str] = &["metaDataName", "metaData", "endpointUrls"];

/// Normalizes each nested object.
fn parts(json: &mut Value) {
    match json {
        Value::Array(elements) => elements.iter_mut().for_each(parts),
        Value::Object(object) => {
            // Readable time; the ticks beside it are compared.
            if object.contains_key("ticks100ns") {
                object.remove("iso");
            }
            if object.contains_key("Code") {
                object.remove("Symbol");
            }
            if let Some(status) = object.remove("StatusCode") {
                object.insert("Status".to_owned(), status);
            }
            // The vectors do not distinguish null arrays from empty arrays.
            object.remove("NullArray");
            object.values_mut().for_each(parts);
            if let Some(value) = value_in_one_style(json) {
                *json = value;
            }
        }
        Value::String(text) => {
            if let Some(shorter) = without_zeros(text) {
                *text = shorter;
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) => {}
    }
}

fn value_in_one_style(json: &Value) -> Option<Value> {
    // asyncua names the encoding instead of the type, and shows the bytes.
    if let Some(body) = json.get("BodyBase64") {
        assert_eq!(
            (&json["TypeId"], body),
            (&json!("i=886"), &json!("AAAAAAAAAAAAAAAAAABZQA=="))
        );
        return Some(json!({ "UaTypeId": "i=884", "Low": 0.0, "High": 100.0 }));
    }
    if let Some(name) = json.get("Name") {
        return Some(json!(format!(
            "{}:{}",
            json["NamespaceIndex"],
            name.as_str()?
        )));
    }
    // open62541 writes the bytes of a body as text.
    if json["UaBody"] == "\u{1}\u{2}\u{3}\u{4}\u{5}" {
        let body = BASE64.encode([1, 2, 3, 4, 5]);
        return Some(json!({ "UaTypeId": json["UaTypeId"], "UaEncoding": 1, "UaBody": body }));
    }
    // A single dimension equals the length of the array.
    let dimensions = json.get("Dimensions")?.as_array()?;
    if let [length] = dimensions.as_slice() {
        assert_eq!(length.as_u64()?, json["Value"].as_array()?.len() as u64);
        return Some(json!({ "UaType": json["UaType"], "Value": json["Value"] }));
    }
    None
}

/// Returns a time without the zeros at the end of its fraction.
fn without_zeros(text: &str) -> Option<String> {
    let (whole, fraction) = text.strip_suffix('Z')?.split_once('.')?;
    let digits = fraction.trim_end_matches('0');
    let is_time = whole.len() == 19 && whole.as_bytes()[10] == b'T';
    let point = if digits.is_empty() { "" } else { "." };
    is_time.then(|| format!("{whole}{point}{digits}Z"))
}
