//! Conversion of constants of the mapping to fields of a request.

use std::fmt::Display;

use messages::{ArrayRank, Literal, constant};
use uadp::{BuiltinType, FieldEncoder, Scalar};

use crate::block;
use crate::counters::DropCause;

/// The block with a single null field, for a field without a value.
pub(crate) const NULL: [u8; 3] = [1, 0, 0];

/// Reason for which a constant of the mapping does not fit its field.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConstantFault {
    /// A field of bytes has another constant than a list of bytes.
    #[error("{field} takes bytes: give a list of numbers from 0 to 255")]
    NotBytes {
        /// The field with its type.
        field: String,
    },
    /// The array of the field has a fixed length, and the list has another.
    #[error("{field} has another number of elements")]
    Length {
        /// The field with its type.
        field: String,
    },
    /// A list for a scalar.
    #[error("{field} does not take a list")]
    List {
        /// The field with its type.
        field: String,
    },
    /// A single value for an array.
    #[error("{field} takes a list, such as [1, 2]")]
    Single {
        /// The field with its type.
        field: String,
    },
    /// A text that is no value of the type of the field.
    #[error("`{text}` is not a valid value of {field}")]
    Value {
        /// The text in the mapping.
        text: String,
        /// The field with its type.
        field: String,
    },
    /// The value cannot be encoded.
    #[error("{0}")]
    Encoding(String),
}

/// Returns the block with a single field of the given name, type and value. The value is a number,
/// text or Boolean, bytes as a list of numbers, or an array of these.
///
/// # Errors
/// Returns the reason if the value does not fit the type of the field.
pub(crate) fn block(
    field: &impl Display,
    (builtin, rank): (BuiltinType, ArrayRank),
    literal: &Literal,
) -> Result<Vec<u8>, ConstantFault> {
    let name = || field.to_string();
    let texts = match (literal, rank, builtin) {
        (Literal::One(text), ArrayRank::Scalar, _) => std::slice::from_ref(text),
        (Literal::List(texts), ArrayRank::Scalar, BuiltinType::ByteString) => {
            let numbers = texts.iter().map(|text| text.parse::<u8>());
            let bytes: Vec<u8> = numbers
                .collect::<Result<_, _>>()
                .map_err(|_| ConstantFault::NotBytes { field: name() })?;
            return encode(|frame| frame.scalar(Scalar::ByteString(Some(&bytes))));
        }
        (Literal::List(texts), ArrayRank::Array { fixed }, _)
            if fixed.is_none_or(|fixed| usize::try_from(fixed) == Ok(texts.len())) =>
        {
            texts
        }
        (Literal::List(_), ArrayRank::Array { .. }, _) => {
            return Err(ConstantFault::Length { field: name() });
        }
        (Literal::List(_), ArrayRank::Scalar, _) => {
            return Err(ConstantFault::List { field: name() });
        }
        (Literal::One(_), ArrayRank::Array { .. }, _) => {
            return Err(ConstantFault::Single { field: name() });
        }
    };
    let values = texts.iter().map(|text| {
        constant(builtin, text).ok_or_else(|| ConstantFault::Value {
            text: text.clone(),
            field: name(),
        })
    });
    let values: Vec<Scalar<'_>> = values.collect::<Result<_, _>>()?;
    encode(|frame| match rank {
        ArrayRank::Scalar => values.iter().try_for_each(|value| frame.scalar(*value)),
        ArrayRank::Array { .. } => {
            frame.array(builtin, values.len())?;
            values.iter().try_for_each(|value| frame.element(*value))
        }
    })
}

fn encode(
    write: impl FnOnce(&mut FieldEncoder<'_>) -> Result<(), uadp::EncodeError>,
) -> Result<Vec<u8>, ConstantFault> {
    let written = block::block(|frame| write(frame).map_err(block::too_big));
    written.map_err(|(_, why): (DropCause, String)| ConstantFault::Encoding(why))
}

#[cfg(test)]
mod tests {
    use uadp::{Fields, Variant};

    use super::*;

    #[test]
    fn a_constant_is_a_field_of_the_type_of_its_call() {
        let speed = (BuiltinType::Int32, ArrayRank::Scalar);
        let bytes = block(&"`speed`", speed, &Literal::One("100".to_owned())).unwrap();
        let mut fields = Fields::parse(&bytes).unwrap();
        let field = fields.next().unwrap().unwrap();
        assert_eq!(field, Variant::Scalar(Scalar::Int32(100)));
        assert!(fields.next().is_none());
        let why = block(&"`speed`", speed, &Literal::One("fast".to_owned())).unwrap_err();
        let why = why.to_string();
        assert!(why.contains("`fast`") && why.contains("`speed`"), "{why}");
        block(&"`speed`", speed, &Literal::List(vec!["1".to_owned()])).unwrap_err();
        let list = (BuiltinType::Double, ArrayRank::Array { fixed: None });
        let literal = Literal::List(vec!["0.5".to_owned(), "1".to_owned()]);
        let bytes = block(&"`joints`", list, &literal).unwrap();
        let Variant::Array(array) = Fields::parse(&bytes).unwrap().next().unwrap().unwrap() else {
            unreachable!("an array was written");
        };
        assert!(array.iter().eq([Scalar::Double(0.5), Scalar::Double(1.0)]));
    }
}
