//! Single values and arrays as plain JSON.

use serde_json::{Value, json};
use uadp::{Array, DecodeError, Scalar};

use crate::values::show_scalar;

pub(super) fn scalar(value: Scalar<'_>) -> Result<Value, DecodeError> {
    #[expect(
        clippy::wildcard_enum_match_arm,
        reason = "all others as `decode` has them"
    )]
    match value {
        Scalar::Int64(value) => Ok(json!(value)),
        Scalar::UInt64(value) => Ok(json!(value)),
        Scalar::LocalizedText(value) => Ok(json!(value.text)),
        other => show_scalar(other),
    }
}

pub(super) fn elements(array: Array<'_>) -> Result<Value, DecodeError> {
    array.iter().map(scalar).collect()
}
