//! Values in the forms of OPC 10000-6, 5.4 and Annex H (version 1.04), and of other stacks.
//!
//! `json-values` encodes a single form of each type; received values are converted to it here. A
//! form that neither version has, but whose meaning is certain, is read and noted: `UaDimensions`,
//! the key StatusCode of a DataValue, structures in UaBody, objects for current QualifiedNames, and
//! null for numbers that JSON cannot express.

use json_values::{JsonFieldValue, JsonStatus, JsonStructure, iso_time};
use serde_json::{Map, Value, json};
use uadp::{BuiltinType, DateTime};

use super::descriptions::DataSetField;
use super::names;

#[cfg(test)]
mod tests;

type Converted<T> = Result<T, &'static str>;

/// Converts the values of a DataSetMessage.
#[derive(Debug, Default)]
pub(super) struct ValueForms {
    /// Whether the present value is in the form of version 1.05, which has UaType.
    is_current: bool,
    is_nonstandard: bool,
    /// The number of Variants and DataValues around the present value.
    depth: usize,
}

impl ValueForms {
    /// Returns the fault to count if a value had a form that the standard does not have.
    pub(super) fn fault(&self) -> Option<&'static str> {
        self.is_nonstandard.then_some("nonstandard_json")
    }

    /// Converts a field of a payload: a Variant with its type, a DataValue, or a plain value with
    /// the type of the metadata. The timestamps of a DataValue are left out.
    ///
    /// # Errors
    /// `undescribed_json` for a value of unknown type, `malformed_json` and `wrong_json_value` for
    /// a value that is not of its type.
    pub(super) fn field(
        &mut self,
        json: &Value,
        field: Option<&DataSetField>,
    ) -> Converted<JsonFieldValue> {
        let described = field.and_then(|field| field.builtin);
        let is_structure = described == Some(BuiltinType::ExtensionObject);
        let has_members = is_structure || described == Some(BuiltinType::DataValue);
        let rank = field.map_or(SCALAR, |field| field.value_rank);
        if let Some(whole) = json.as_object() {
            let converted = if let Some(typed) = self.typed(whole, rank) {
                Some(typed?)
            } else if has_members || !is_data_value(whole) {
                None
            } else if let Some(value) = whole.get("Value") {
                // A DataValue of version 1.04, or one without the type that the metadata has.
                Some(self.nested(|forms| forms.field(value, field))?)
            } else {
                Some(JsonFieldValue::default())
            };
            if let Some(value) = converted {
                let status = self.status_of(whole)?;
                return Ok(JsonFieldValue { status, ..value });
            }
        }
        let builtin = match (field.map(|field| field.builtin), json) {
            (_, Value::Null) => return Ok(JsonFieldValue::default()),
            (Some(Some(builtin)), _) => builtin,
            (_, Value::Bool(_)) => BuiltinType::Boolean,
            (_, Value::String(_)) => BuiltinType::String,
            // The type of a number or structure is unknown.
            _ => return Err("undescribed_json"),
        };
        let data_type = field.and_then(|field| field.data_type);
        let value = if let Some(elements) = json.as_array() {
            elements
                .iter()
                .map(|element| self.element(builtin, element, data_type))
                .collect::<Converted<Value>>()?
        } else {
            self.element(builtin, json, data_type)?
        };
        Ok(JsonFieldValue {
            ua_type: Some(builtin.id()),
            value: Some(value),
            ..JsonFieldValue::default()
        })
    }

    /// Converts a value within another one. Each level copies the value, so their number is
    /// limited.
    fn nested<T>(&mut self, convert: impl FnOnce(&mut Self) -> Converted<T>) -> Converted<T> {
        if self.depth >= MAX_DEPTH {
            return Err("wrong_json_value");
        }
        self.depth += 1;
        let converted = convert(self);
        self.depth -= 1;
        converted
    }

    /// Converts a Variant or DataValue with its type: UaType and Value, or Type and Body. Returns
    /// `None` for other objects. Only the compact form of version 1.05 leaves out a default value,
    /// so an object with a Type and no Body is something else.
    fn typed(
        &mut self,
        whole: &Map<String, Value>,
        rank: i32,
    ) -> Option<Converted<JsonFieldValue>> {
        let (kind, value, is_current) = match whole.get("UaType") {
            Some(kind) => (kind, whole.get("Value"), true),
            None => (whole.get("Type")?, Some(whole.get("Body")?), false),
        };
        let before = std::mem::replace(&mut self.is_current, is_current);
        let converted = self.variant(kind, value, whole, rank);
        self.is_current = before;
        Some(converted)
    }

    fn variant(
        &mut self,
        kind: &Value,
        value: Option<&Value>,
        whole: &Map<String, Value>,
        rank: i32,
    ) -> Converted<JsonFieldValue> {
        let kind = kind.as_u64().and_then(|id| u8::try_from(id).ok());
        let kind = kind.ok_or("malformed_json")?;
        let Some(builtin) = BuiltinType::from_id(kind) else {
            // 0 is a null Variant; other numbers are refused.
            return Ok(JsonFieldValue {
                ua_type: Some(kind),
                value: value.cloned(),
                ..JsonFieldValue::default()
            });
        };
        let is_null = matches!(value, None | Some(Value::Null));
        if is_null && builtin == BuiltinType::Variant {
            return Ok(JsonFieldValue::default());
        }
        let null_array = value.is_none() && rank > 0;
        let converted = match value {
            None if null_array => Value::Null,
            // The encoder left a default value out (5.4.1).
            None => default_of(builtin),
            Some(Value::Array(elements)) => elements
                .iter()
                .map(|element| self.scalar(builtin, element))
                .collect::<Converted<Value>>()?,
            // A Variant directly in a Variant has no encoding.
            Some(_) if builtin == BuiltinType::Variant => return Err("wrong_json_value"),
            Some(value) => self.scalar(builtin, value)?,
        };
        self.is_nonstandard |= whole.contains_key("UaDimensions");
        let dimensions = ["Dimensions", "UaDimensions"]
            .iter()
            .find_map(|key| whole.get(*key));
        let dimensions = dimensions.filter(|of| !of.is_null());
        let dimensions = dimensions.map(|of| dimensions_of(of).ok_or("malformed_json"));
        let dimensions = dimensions.transpose()?;
        Ok(JsonFieldValue {
            ua_type: Some(kind),
            value: Some(converted),
            dimensions: dimensions.filter(|of| of.len() > 1),
            null_array,
            ..JsonFieldValue::default()
        })
    }

    /// Converts a plain value, or an element of an array, of a field.
    fn element(
        &mut self,
        builtin: BuiltinType,
        json: &Value,
        data_type: Option<u32>,
    ) -> Converted<Value> {
        if builtin == BuiltinType::ExtensionObject {
            self.structure(json, data_type)
        } else {
            self.scalar(builtin, json)
        }
    }

    /// Converts a value of a type.
    fn scalar(&mut self, builtin: BuiltinType, json: &Value) -> Converted<Value> {
        Ok(match (builtin, json) {
            // Number types have no null. JavaScript writes null for NaN and infinities, so the only
            // certain thing is that there is no usable number.
            (BuiltinType::Float | BuiltinType::Double, Value::Null) => {
                self.is_nonstandard = true;
                json!("NaN")
            }
            (
                BuiltinType::Boolean
                | BuiltinType::SByte
                | BuiltinType::Byte
                | BuiltinType::Int16
                | BuiltinType::UInt16
                | BuiltinType::Int32
                | BuiltinType::UInt32
                | BuiltinType::Int64
                | BuiltinType::UInt64
                | BuiltinType::Float
                | BuiltinType::Double
                | BuiltinType::String
                | BuiltinType::XmlElement
                | BuiltinType::ByteString,
                _,
            ) => json.clone(),
            (_, Value::Null) => default_of(builtin),
            (BuiltinType::Guid, _) => json.clone(),
            (BuiltinType::DateTime, _) => date_time(json),
            (BuiltinType::NodeId, _) => names::node_id(json, false),
            (BuiltinType::ExpandedNodeId, _) => names::node_id(json, true),
            (BuiltinType::StatusCode, _) => status(json),
            (BuiltinType::QualifiedName, _) => {
                self.is_nonstandard |= self.is_current && json.is_object();
                names::qualified_name(json)
            }
            (BuiltinType::LocalizedText, Value::String(_)) => {
                self.is_nonstandard |= self.is_current;
                json!({ "Text": json })
            }
            (BuiltinType::LocalizedText, _) => json.clone(),
            (BuiltinType::ExtensionObject, _) => self.structure(json, None)?,
            (BuiltinType::DataValue, _) => object(self.nested(|forms| forms.data_value(json))?),
            (BuiltinType::Variant, _) => object(self.nested(|forms| forms.field(json, None))?),
            (BuiltinType::DiagnosticInfo, _) => diagnostic_info(json),
        })
    }

    /// Converts a DataValue: flat in version 1.05, with a Variant as Value in version 1.04.
    fn data_value(&mut self, json: &Value) -> Converted<JsonFieldValue> {
        let whole = json.as_object().ok_or("wrong_json_value")?;
        let value = match self.typed(whole, SCALAR) {
            Some(typed) => typed?,
            None if !whole.is_empty() && !is_data_value(whole) => return Err("wrong_json_value"),
            None => match whole.get("Value") {
                Some(value) => self.nested(|forms| forms.field(value, None))?,
                None => JsonFieldValue::default(),
            },
        };
        let time = |key: &str| {
            let text = date_time(whole.get(key)?);
            text.as_str().map(str::to_owned)
        };
        let picoseconds = |keys: [&str; 2]| {
            let number = keys.iter().find_map(|key| whole.get(*key))?.as_u64();
            number.and_then(|number| u16::try_from(number).ok())
        };
        Ok(JsonFieldValue {
            status: self.status_of(whole)?,
            source_timestamp: time("SourceTimestamp"),
            source_picoseconds: picoseconds(["SourcePicoseconds", "SourcePicoSeconds"]),
            server_timestamp: time("ServerTimestamp"),
            server_picoseconds: picoseconds(["ServerPicoseconds", "ServerPicoSeconds"]),
            ..value
        })
    }

    /// Converts a structure: its fields with UaTypeId, a body of version 1.04, an encoded body, or
    /// the fields alone with the type of the metadata.
    fn structure(&mut self, json: &Value, data_type: Option<u32>) -> Converted<Value> {
        let Some(whole) = json.as_object() else {
            return Ok(json.clone());
        };
        if whole.is_empty() {
            // The default value of the verbose form.
            return Ok(Value::Null);
        }
        if whole.contains_key("BodyBase64") {
            return Ok(json.clone());
        }
        let (type_id, encoding, body) = if let Some(type_id) = whole.get("UaTypeId") {
            (type_id, whole.get("UaEncoding"), whole.get("UaBody"))
        } else if let (Some(type_id), Some(body)) = (whole.get("TypeId"), whole.get("Body")) {
            if body.is_null() {
                return Ok(Value::Null);
            }
            (type_id, whole.get("Encoding"), Some(body))
        } else {
            return self.known(data_type, whole);
        };
        let standard = names::standard_type(type_id);
        let body = body.filter(|body| !body.is_null());
        match (encoding.and_then(Value::as_u64), body) {
            (None | Some(0), Some(Value::Object(fields))) => {
                self.is_nonstandard |= whole.contains_key("UaBody");
                self.known(standard, fields)
            }
            (None, None) => {
                let mut fields = whole.clone();
                fields.remove("UaTypeId");
                self.known(standard, &fields)
            }
            (encoding, body) => Ok(json!({
                "UaTypeId": names::node_id(type_id, false),
                "UaEncoding": encoding,
                "UaBody": body,
            })),
        }
    }

    /// Converts the fields of a structure of the standard. Fields of other structures are unknown.
    fn known(&mut self, id: Option<u32>, fields: &Map<String, Value>) -> Converted<Value> {
        let structure = id.and_then(JsonStructure::by_type_or_encoding);
        let structure = structure.ok_or("undescribed_json")?;
        let mut convert = |builtin, value: Option<&Value>| match value {
            None => Ok(default_of(builtin)),
            Some(value) => self.scalar(builtin, value),
        };
        let mut fields = structure.map_fields(fields, &mut convert)?;
        let type_id = format!("i={}", structure.data_type);
        fields.insert("UaTypeId".to_owned(), type_id.into());
        Ok(fields.into())
    }

    /// Returns the status of a DataValue; `None` without one.
    fn status_of(&mut self, whole: &Map<String, Value>) -> Converted<Option<JsonStatus>> {
        self.is_nonstandard |= whole.contains_key("StatusCode");
        let keys = ["Status", "StatusCode"];
        let Some(json) = keys.iter().find_map(|key| whole.get(*key)) else {
            return Ok(None);
        };
        let code = status_number(json).ok_or("wrong_json_value")?;
        Ok(Some(JsonStatus { code, symbol: None }))
    }
}

/// Returns whether an object without a type is a DataValue: it has a value, a status or times, and
/// nothing else.
fn is_data_value(whole: &Map<String, Value>) -> bool {
    let known = |key: &String| key == "Value" || DATA_VALUE_KEYS.contains(&key.as_str());
    !whole.is_empty() && whole.keys().all(known)
}

/// Reads the dimensions of a matrix; `None` if one is no UInt32.
fn dimensions_of(json: &Value) -> Option<Vec<u32>> {
    let number = |of: &Value| of.as_u64().and_then(|of| u32::try_from(of).ok());
    json.as_array()?.iter().map(number).collect()
}

/// Returns a time within the range of the binary encoding: earlier times are null, later times are
/// the greatest value (5.2.2.5, 5.4.2.6).
fn date_time(json: &Value) -> Value {
    let limited = match json.as_str().and_then(iso_time::parse) {
        Some(time) if time < DateTime(0) => DateTime(0),
        Some(time) if time >= LATEST => DateTime(i64::MAX),
        _ => return json.clone(),
    };
    iso_time::of_date_time(limited).into()
}

/// Returns a StatusCode with its number. Good has none, as an object or null.
fn status(json: &Value) -> Value {
    status_number(json).map_or_else(|| json.clone(), |number| json!({ "Code": number }))
}

/// Reads a StatusCode: a number, or an object with a Code. Good is null or an empty object too, or
/// has its Symbol alone.
pub(super) fn status_number(json: &Value) -> Option<u32> {
    let number = match json.as_object() {
        None if json.is_null() => return Some(0),
        None => json,
        Some(whole) => match whole.get("Code") {
            Some(code) => code,
            None => {
                let is_good = whole
                    .iter()
                    .all(|(key, of)| key == "Symbol" && of == "Good");
                return is_good.then_some(0);
            }
        },
    };
    u32::try_from(number.as_u64()?).ok()
}

/// Removes the null members, which the verbose form writes.
fn diagnostic_info(json: &Value) -> Value {
    let Some(whole) = json.as_object() else {
        return json.clone();
    };
    let members = whole.iter().filter(|(_, value)| !value.is_null());
    let convert = |(key, value): (&String, &Value)| {
        let value = match key.as_str() {
            "InnerStatusCode" => status(value),
            "InnerDiagnosticInfo" => diagnostic_info(value),
            _ => value.clone(),
        };
        (key.clone(), value)
    };
    members.map(convert).collect::<Map<_, _>>().into()
}

/// Returns the default value of a type (5.1.2), in the form of `json-values`.
fn default_of(builtin: BuiltinType) -> Value {
    match builtin {
        BuiltinType::Boolean => json!(false),
        BuiltinType::SByte
        | BuiltinType::Byte
        | BuiltinType::Int16
        | BuiltinType::UInt16
        | BuiltinType::Int32
        | BuiltinType::UInt32
        | BuiltinType::Int64
        | BuiltinType::UInt64
        | BuiltinType::Float
        | BuiltinType::Double => json!(0),
        BuiltinType::String
        | BuiltinType::XmlElement
        | BuiltinType::ByteString
        | BuiltinType::ExtensionObject => Value::Null,
        BuiltinType::DateTime => json!(iso_time::of_date_time(DateTime(0))),
        BuiltinType::Guid => json!("00000000-0000-0000-0000-000000000000"),
        BuiltinType::NodeId | BuiltinType::ExpandedNodeId => json!("i=0"),
        BuiltinType::StatusCode => json!({ "Code": 0 }),
        BuiltinType::QualifiedName => json!({ "Name": null }),
        BuiltinType::LocalizedText
        | BuiltinType::DataValue
        | BuiltinType::Variant
        | BuiltinType::DiagnosticInfo => json!({}),
    }
}

/// Converts a shape to JSON, without a copy of its value. It has text keys only, so this does not
/// fail.
fn object(mut shape: JsonFieldValue) -> Value {
    let value = shape.value.take();
    let mut json = serde_json::to_value(shape).unwrap_or_default();
    if let (Some(value), Some(whole)) = (value, json.as_object_mut()) {
        whole.insert("Value".to_owned(), value);
    }
    json
}

const SCALAR: i32 = -1;
/// The most Variants and DataValues around a value.
const MAX_DEPTH: usize = 8;
/// 9999-12-31T23:59:59Z, from which on a time is the greatest value.
const LATEST: DateTime = DateTime(2_650_467_743_990_000_000);
/// The keys of a DataValue of both versions, without the value.
const DATA_VALUE_KEYS: [&str; 8] = [
    "Status",
    "StatusCode",
    "SourceTimestamp",
    "SourcePicoseconds",
    "SourcePicoSeconds",
    "ServerTimestamp",
    "ServerPicoseconds",
    "ServerPicoSeconds",
];
