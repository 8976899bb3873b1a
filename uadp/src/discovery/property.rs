//! Values of Properties that describe a number.

use super::settings::SettingsStructure;
use super::wire::structure;
use crate::{Array, BuiltinType, DecodeError, EncodeError, LocalizedText, NodeId, Scalar, Variant};
use alloc::vec::Vec;

structure! {
    /// A unit of measure: the Property EngineeringUnits (OPC 10000-8, 5.6.4.3).
    EUInformation<'a> {
        /// Namespace of the unit ids.
        namespace_uri: Option<&'a str> = "NamespaceUri",
        /// Number of the unit.
        unit_id: i32 = "UnitId",
        /// Its symbol, such as `m/s`.
        display_name: LocalizedText<'a> = "DisplayName",
        /// Its name, such as `metre per second`.
        description: LocalizedText<'a> = "Description",
    }

    /// Expected range of values: the Property EURange (OPC 10000-8, 5.6.2).
    Range {
        /// Lowest value.
        low: f64 = "Low",
        /// Highest value.
        high: f64 = "High",
    }

    /// Meaning of an enumeration value: an element of the Property EnumValues (OPC 10000-3, 8.39).
    EnumValueType<'a> {
        /// The value.
        value: i64 = "Value",
        /// Its name, for people.
        display_name: LocalizedText<'a> = "DisplayName",
        /// Meaning, for people.
        description: LocalizedText<'a> = "Description",
    }
}

impl<'a> SettingsStructure<'a> for EUInformation<'a> {
    const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, 889);
    const NAME: &'static str = "EUInformation";
}

impl<'a> SettingsStructure<'a> for Range {
    const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, 886);
    const NAME: &'static str = "Range";
}

impl<'a> SettingsStructure<'a> for EnumValueType<'a> {
    const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, 8251);
    const NAME: &'static str = "EnumValueType";
}

impl<'a> EnumValueType<'a> {
    /// Returns the value of the Property EnumValues, with its elements in `buffer`.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] for a text that exceeds its length field.
    pub fn array<'b>(values: &[Self], buffer: &'b mut Vec<u8>) -> Result<Variant<'b>, EncodeError> {
        buffer.clear();
        let mut body = Vec::new();
        for value in values {
            let object = value.write_object(&mut body)?;
            Scalar::ExtensionObject(object).write::<false>(buffer)?;
        }
        elements(BuiltinType::ExtensionObject, values.len(), buffer)
    }
}

/// Returns the value of the Property EnumStrings (OPC 10000-3, 5.8.3) in `buffer`: the names of 0,
/// 1, 2 and so on.
///
/// # Errors
/// [`EncodeError::TooBig`] for a text that exceeds its length field.
pub fn enum_strings<'b>(
    names: &[LocalizedText<'_>],
    buffer: &'b mut Vec<u8>,
) -> Result<Variant<'b>, EncodeError> {
    buffer.clear();
    for name in names {
        Scalar::LocalizedText(*name).write::<false>(buffer)?;
    }
    elements(BuiltinType::LocalizedText, names.len(), buffer)
}

/// Returns an array of Strings in `buffer`, as the value of a Property.
///
/// # Errors
/// [`EncodeError::TooBig`] for a text that exceeds its length field.
pub fn strings<'b>(texts: &[&str], buffer: &'b mut Vec<u8>) -> Result<Variant<'b>, EncodeError> {
    buffer.clear();
    for text in texts {
        Scalar::String(Some(text)).write::<false>(buffer)?;
    }
    elements(BuiltinType::String, texts.len(), buffer)
}

fn elements(element: BuiltinType, count: usize, bytes: &[u8]) -> Result<Variant<'_>, EncodeError> {
    // The bytes were written above, so they are valid.
    let array: Result<_, DecodeError> = Array::new(element, count, bytes);
    array
        .map(Variant::Array)
        .map_err(|_| EncodeError::Misplaced("an array that cannot be decoded again"))
}
