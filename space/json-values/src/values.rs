//! Conversion of values of the builtin types to JSON and back, following OPC 10000-6, 5.4.2.
//!
//! Information that this encoding would lose is kept: a null array has a key of its own, 64-bit
//! integers are texts, DateTimes have seven digits. Lost are the payload of a NaN, and which of
//! several encodings of a NodeId was used.

mod show;
mod write;

pub use show::{show_data_value, show_scalar, show_variant};
pub use write::{data_value_bytes, variant_bytes, write_scalar};

use std::fmt;

use serde_json::Value;

/// A JSON value that cannot be encoded, with its path.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WrongValue {
    path: String,
    what: String,
}

impl WrongValue {
    /// Creates an error without a path.
    pub fn new(what: impl Into<String>) -> Self {
        Self {
            path: String::new(),
            what: what.into(),
        }
    }

    /// Creates an error for a value that is not `what`.
    #[must_use]
    pub fn expected(what: &str, found: &Value) -> Self {
        let mut found = found.to_string();
        if found.chars().count() > SHOWN {
            found = found.chars().take(SHOWN).collect();
            found.push_str("...");
        }
        Self::new(format!("expected {what}, found {found}"))
    }

    /// Prepends a part to the path of the value.
    #[must_use]
    pub fn at(mut self, part: &str) -> Self {
        self.path.insert_str(0, part);
        self
    }
}

impl fmt::Display for WrongValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.path.as_str() {
            "" => f.write_str(&self.what),
            path => write!(f, "{path}: {}", self.what),
        }
    }
}

impl From<uadp::EncodeError> for WrongValue {
    fn from(error: uadp::EncodeError) -> Self {
        Self::new(error.to_string())
    }
}

impl From<uadp::DecodeError> for WrongValue {
    fn from(error: uadp::DecodeError) -> Self {
        Self::new(error.to_string())
    }
}

/// Maximum number of characters of a wrong value in a message.
const SHOWN: usize = 40;
