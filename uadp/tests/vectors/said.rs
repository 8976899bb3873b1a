//! Content of the JSON files, in the form in which `found` describes a datagram.

use serde_json::{Value, json};
use uadp::BuiltinType;

use crate::vectors::found::base64;

/// Returns the expected headers of a NetworkMessage and of its chunk.
pub(crate) fn expected_headers(json: &Value) -> Value {
    assert_eq!(json["uadpVersion"], 1);
    let promoted = json["promotedFields"].as_array();
    json!({
        "publisherId": match &json["publisherId"] {
            Value::Null => Value::Null,
            id => json!([id["type"], text_or_number(&id["value"])]),
        },
        "dataSetClassId": json["dataSetClassId"],
        "groupHeader": json["groupHeader"],
        "dataSetWriterIds": json["dataSetWriterIds"],
        "timestamp": json["timestamp"]["ticks100ns"],
        "picoSeconds": json["picoSeconds"],
        "promotedFields": promoted.map(|fields| -> Vec<_> {
            fields.iter().map(expected_variant).collect()
        }),
        "securityHeader": expected_security(&json["securityHeader"]),
        "networkMessageType": json["networkMessageType"],
        "chunk": match &json["chunk"] {
            Value::Null => Value::Null,
            chunk => {
                let mut chunk = chunk.clone();
                chunk["dataSetWriterId"] = json["dataSetWriterIds"][0].clone();
                chunk
            }
        },
    })
}

fn expected_security(json: &Value) -> Value {
    if json.is_null() {
        return Value::Null;
    }
    let footer = json["footerEnabled"] == true;
    json!({
        "signed": json["signed"],
        "encrypted": json["encrypted"],
        "forceKeyReset": json["forceKeyReset"] == true,
        "securityTokenId": json["securityTokenId"],
        "nonce": json["nonce"],
        "footerSize": footer.then(|| json["footerSize"].clone()),
        "footer": if footer { json["footer"].clone() } else { json!("") },
    })
}

/// Returns the expected DataSetMessages, without the fields of RawData messages.
pub(crate) fn expected_messages(json: &Value) -> Value {
    let messages = json["dataSetMessages"].as_array().unwrap();
    messages.iter().map(expected_message).collect()
}

fn expected_message(json: &Value) -> Value {
    let mut out = json.as_object().unwrap().clone();
    out.remove("metaData");
    if let Some(timestamp) = out.get_mut("timestamp") {
        *timestamp = timestamp["ticks100ns"].take();
    }
    if json["fieldEncoding"] == "RawData" {
        out.remove("fields");
        return Value::Object(out);
    }
    let fields = json["fields"].as_array().unwrap().iter();
    out["fields"] = fields.map(expected_field).collect();
    Value::Object(out)
}

fn expected_field(json: &Value) -> Value {
    let mut value = expected_variant(&json["value"]);
    for (key, said) in json["value"].as_object().unwrap() {
        match &**key {
            "UaType" | "Value" | "Dimensions" => {}
            "Status" | "StatusCode" => value["status"] = said["Code"].clone(),
            "SourceTimestamp" => value["sourceTimestamp"] = json!(ticks(said.as_str().unwrap())),
            "ServerTimestamp" => value["serverTimestamp"] = json!(ticks(said.as_str().unwrap())),
            "SourcePicoseconds" => value["sourcePicoseconds"] = said.clone(),
            "ServerPicoseconds" => value["serverPicoseconds"] = said.clone(),
            other => panic!("{other} of a field"),
        }
    }
    match json.get("index") {
        Some(index) => json!({ "index": index, "value": value }),
        None => value,
    }
}

fn expected_variant(json: &Value) -> Value {
    let Some(id) = json.get("UaType") else {
        return json!({});
    };
    let builtin = BuiltinType::from_id(u8::try_from(id.as_u64().unwrap()).unwrap()).unwrap();
    let value = match &json["Value"] {
        Value::Array(elements) => elements
            .iter()
            .map(|element| expected_scalar(builtin, element))
            .collect(),
        scalar => expected_scalar(builtin, scalar),
    };
    let mut out = json!({ "type": builtin.name(), "value": value });
    if let Some(dimensions) = json.get("Dimensions") {
        out["dimensions"] = dimensions.clone();
    }
    out
}

fn expected_scalar(builtin: BuiltinType, json: &Value) -> Value {
    if json.is_null() {
        return Value::Null;
    }
    match builtin {
        BuiltinType::Int64 | BuiltinType::UInt64 => text_or_number(json),
        BuiltinType::Float => json!(
            json.as_f64()
                .map_or(f32::NAN, |value| value as f32)
                .to_string()
        ),
        BuiltinType::Double => json!(json.as_f64().unwrap_or(f64::NAN).to_string()),
        BuiltinType::DateTime => json!(ticks(json.as_str().unwrap())),
        BuiltinType::StatusCode => json["Code"].clone(),
        BuiltinType::QualifiedName if json.is_object() => {
            json!(format!(
                "{}:{}",
                json["NamespaceIndex"],
                json["Name"].as_str().unwrap()
            ))
        }
        BuiltinType::ExtensionObject => expected_structure(json),
        BuiltinType::Variant => expected_variant(json),
        _ => json.clone(),
    }
}

fn expected_structure(json: &Value) -> Value {
    if let Some(body) = json.get("BodyBase64") {
        assert_eq!(
            json["TypeId"], "i=886",
            "asyncua writes the NodeId of the encoding"
        );
        assert_eq!(*body, json!("AAAAAAAAAAAAAAAAAABZQA=="));
        return json!({ "type": "i=884", "numbers": ["0", "100"] });
    }
    let numbers = |keys: &[&str]| -> Vec<String> {
        let at = |key: &&str| json.pointer(key).unwrap().as_f64().unwrap().to_string();
        keys.iter().map(at).collect()
    };
    match json["UaTypeId"].as_str().unwrap() {
        "i=884" => json!({ "type": "i=884", "numbers": numbers(&["/Low", "/High"]) }),
        "i=18814" => json!({ "type": "i=18814", "numbers": numbers(&[
            "/CartesianCoordinates/X", "/CartesianCoordinates/Y", "/CartesianCoordinates/Z",
            "/Orientation/A", "/Orientation/B", "/Orientation/C",
        ]) }),
        "i=887" => json!({
            "type": "i=887", "uri": json["NamespaceUri"], "unit": json["UnitId"],
            "texts": [json["DisplayName"], json["Description"]],
        }),
        type_id => {
            json!({ "type": type_id, "body": base64(json["UaBody"].as_str().unwrap().as_bytes()) })
        }
    }
}

fn text_or_number(json: &Value) -> Value {
    match json {
        Value::String(text) => json!(text),
        number => json!(number.to_string()),
    }
}

/// Returns the ticks of a DateTime in the form `2026-05-17T12:34:56.7890123Z`.
fn ticks(iso: &str) -> i64 {
    let number = |from: usize, to: usize| iso[from..to].parse::<i64>().unwrap();
    let (year, month, day) = (number(0, 4), number(5, 7), number(8, 10));
    let leap_days = |year: i64| year / 4 - year / 100 + year / 400;
    let is_leap = leap_days(year) - leap_days(year - 1);
    let before = [0, 31, 59, 90, 120, 151, 181, 212, 243, 273, 304, 334];
    let in_year =
        before[usize::try_from(month - 1).unwrap()] + if month > 2 { is_leap } else { 0 } + day - 1;
    let days = (year - 1601) * 365 + leap_days(year - 1) - leap_days(1600) + in_year;
    let seconds = days * 86_400 + number(11, 13) * 3600 + number(14, 16) * 60 + number(17, 19);
    let fraction = iso[19..].trim_start_matches('.').trim_end_matches('Z');
    seconds * 10_000_000 + format!("{fraction:0<7}").parse::<i64>().unwrap()
}

#[test]
fn the_reading_of_iso_times_used_here_is_right() {
    assert_eq!(ticks("1601-01-01T00:00:00Z"), 0);
    assert_eq!(
        ticks("2026-05-17T12:34:56.7890123Z"),
        134_234_948_967_890_123
    );
}
