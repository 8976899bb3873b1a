//! Values of the Properties that say what a number means.

use super::settings::Settings;
use super::wire::structure;
use crate::{Array, BuiltinType, DecodeError, EncodeError, LocalizedText, NodeId, Scalar, Variant};

structure! {
    /// A unit of measure: the Property EngineeringUnits (OPC 10000-8, 5.6.4.3).
    EUInformation<'a> {
        /// Who numbers the units.
        namespace_uri: Option<&'a str> = "NamespaceUri",
        /// Number of the unit.
        unit_id: i32 = "UnitId",
        /// Its symbol, such as `m/s`.
        display_name: LocalizedText<'a> = "DisplayName",
        /// Its name, such as `metre per second`.
        description: LocalizedText<'a> = "Description",
    }

    /// The values that are to be expected: the Property EURange (OPC 10000-8, 5.6.2).
    Range {
        /// The lowest.
        low: f64 = "Low",
        /// The highest.
        high: f64 = "High",
    }

    /// What a value of an enumeration means: an element of the Property EnumValues (OPC 10000-3, 8.39).
    EnumValueType<'a> {
        /// The value.
        value: i64 = "Value",
        /// Its name, for people.
        display_name: LocalizedText<'a> = "DisplayName",
        /// What it means, for people.
        description: LocalizedText<'a> = "Description",
    }
}

impl<'a> Settings<'a> for EUInformation<'a> {
    const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, 889);
    const NAME: &'static str = "EUInformation";
}

impl<'a> Settings<'a> for Range {
    const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, 886);
    const NAME: &'static str = "Range";
}

impl<'a> Settings<'a> for EnumValueType<'a> {
    const ENCODING_ID: NodeId<'static> = NodeId::numeric(0, 8251);
    const NAME: &'static str = "EnumValueType";
}

impl<'a> EnumValueType<'a> {
    /// The value of the Property EnumValues, its elements in `buffer`.
    ///
    /// # Errors
    /// [`EncodeError::TooBig`] for a text that is too long for its length.
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

/// The value of the Property EnumStrings (OPC 10000-3, 5.8.3): the names of 0, 1, 2 and so on, in `buffer`.
///
/// # Errors
/// [`EncodeError::TooBig`] for a text that is too long for its length.
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

fn elements(element: BuiltinType, count: usize, bytes: &[u8]) -> Result<Variant<'_>, EncodeError> {
    // What was just written can be read.
    let array: Result<_, DecodeError> = Array::new(element, count, bytes);
    array
        .map(Variant::Array)
        .map_err(|_| EncodeError::Misplaced("an array that cannot be read back"))
}
