//! The JSON objects of a Variant, a DataValue and a StatusCode.

use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A Variant, or a DataValue with status and timestamps. UaType 0 is the null Variant, an absent
/// UaType is a DataValue without value.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "PascalCase", deny_unknown_fields, default)]
pub struct JsonFieldValue {
    /// Number of the builtin type.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ua_type: Option<u8>,
    /// The value; for an array the elements in order, with the last dimension varying fastest.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub value: Option<Value>,
    /// The dimensions of a matrix.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dimensions: Option<Vec<u32>>,
    /// True if the array is null, which differs from an empty array.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub null_array: bool,
    /// The status of a DataValue.
    #[serde(alias = "StatusCode", skip_serializing_if = "Option::is_none")]
    pub status: Option<JsonStatus>,
    /// The time at which the source had the value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source_timestamp: Option<String>,
    /// The part of the source timestamp below its resolution, in units of 10 ps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source_picoseconds: Option<u16>,
    /// The time at which the server received the value.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server_timestamp: Option<String>,
    /// The part of the server timestamp below its resolution, in units of 10 ps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub server_picoseconds: Option<u16>,
}

/// A StatusCode.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "PascalCase", deny_unknown_fields)]
pub struct JsonStatus {
    /// The number of the code.
    pub code: u32,
    /// The name of the code, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub symbol: Option<String>,
}
