//! Values in the encoding of the space: a block of fields is their number (UInt16) and a Variant
//! for each field (OPC 10000-6, 5.2.2.16).

use messages::ArrayRank;
use skills::{Builtin, SkillValue, ValueShape};
use uadp::{BuiltinType, DecodeError, Fields, Scalar, Variant};

/// Encodes a block of values.
pub(crate) fn block(values: &[SkillValue]) -> Vec<u8> {
    // A skill has a few hundred values at most.
    let mut out = Vec::from(
        u16::try_from(values.len())
            .unwrap_or(u16::MAX)
            .to_le_bytes(),
    );
    for value in values {
        variant(value, &mut out);
    }
    out
}

/// Encodes a block without a value: its StatusCode instead.
pub(crate) fn no_value(status: u32) -> Vec<u8> {
    let mut out = vec![1, 0, BuiltinType::StatusCode.id()];
    out.extend(status.to_le_bytes());
    out
}

/// The reason why a field is no value of a skill.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(crate) enum FieldValueError {
    /// The bytes are malformed.
    #[error(transparent)]
    Encoding(#[from] DecodeError),
    /// A skill has no values of the type.
    #[error("{0:?} is nothing that a skill is told")]
    Scalar(BuiltinType),
    /// A skill has no arrays of the type.
    #[error("an array of {0:?} is nothing that a skill is told")]
    Array(BuiltinType),
    /// A skill has no arrays of several dimensions.
    #[error("an array of several dimensions is nothing that a skill is told")]
    Matrix,
}

/// Decodes the values of a block; `None` for a null value.
///
/// # Errors
/// The encoding is malformed, or a type is not supported.
pub(crate) fn values(block: &[u8]) -> Result<Vec<Option<SkillValue>>, FieldValueError> {
    Fields::parse(block)?.map(|field| value(&field?)).collect()
}

/// Returns the type of a field.
pub(crate) fn builtin(of: Builtin) -> BuiltinType {
    match of {
        Builtin::Boolean => BuiltinType::Boolean,
        Builtin::SByte => BuiltinType::SByte,
        Builtin::Byte => BuiltinType::Byte,
        Builtin::Int16 => BuiltinType::Int16,
        Builtin::UInt16 => BuiltinType::UInt16,
        Builtin::Int32 => BuiltinType::Int32,
        Builtin::UInt32 => BuiltinType::UInt32,
        Builtin::Int64 => BuiltinType::Int64,
        Builtin::UInt64 => BuiltinType::UInt64,
        Builtin::Float => BuiltinType::Float,
        Builtin::Double => BuiltinType::Double,
        Builtin::String => BuiltinType::String,
    }
}

/// Returns the rank of a field.
pub(crate) fn rank(of: ValueShape) -> ArrayRank {
    if of.array {
        ArrayRank::Array { fixed: None }
    } else {
        ArrayRank::Scalar
    }
}

fn variant(value: &SkillValue, out: &mut Vec<u8>) {
    let SkillValue::Array(builtin, elements) = value else {
        out.push(value.shape().builtin.id());
        scalar(value, out);
        return;
    };
    out.push(builtin.id() | ARRAY);
    length(elements.len(), out);
    for element in elements {
        scalar(element, out);
    }
}

fn scalar(value: &SkillValue, out: &mut Vec<u8>) {
    match value {
        SkillValue::Boolean(value) => out.push(u8::from(*value)),
        SkillValue::SByte(value) => out.extend(value.to_le_bytes()),
        SkillValue::Byte(value) => out.push(*value),
        SkillValue::Int16(value) => out.extend(value.to_le_bytes()),
        SkillValue::UInt16(value) => out.extend(value.to_le_bytes()),
        SkillValue::Int32(value) => out.extend(value.to_le_bytes()),
        SkillValue::UInt32(value) => out.extend(value.to_le_bytes()),
        SkillValue::Int64(value) => out.extend(value.to_le_bytes()),
        SkillValue::UInt64(value) => out.extend(value.to_le_bytes()),
        SkillValue::Float(value) => out.extend(value.to_le_bytes()),
        SkillValue::Double(value) => out.extend(value.to_le_bytes()),
        SkillValue::String(text) => {
            length(text.len(), out);
            out.extend(text.as_bytes());
        }
        // Arrays contain scalars only.
        SkillValue::Array(..) => {}
    }
}

fn length(of: usize, out: &mut Vec<u8>) {
    out.extend(i32::try_from(of).unwrap_or(i32::MAX).to_le_bytes());
}

/// Converts the value of a field; `None` for null.
///
/// # Errors
/// Returns the errors of [`values`].
pub(crate) fn value(field: &Variant<'_>) -> Result<Option<SkillValue>, FieldValueError> {
    match field {
        Variant::Null => Ok(None),
        Variant::Scalar(scalar) => single(scalar).map(Some),
        Variant::Array(array) => {
            let of = Builtin::of_id(u32::from(array.element() as u8));
            let of = of.ok_or_else(|| FieldValueError::Array(array.element()))?;
            let elements: Result<Vec<SkillValue>, _> =
                array.iter().map(|element| single(&element)).collect();
            Ok(Some(SkillValue::Array(of, elements?)))
        }
        Variant::Matrix(_) => Err(FieldValueError::Matrix),
    }
}

#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "of the types of the space those that a skill can be told in are named"
)]
fn single(scalar: &Scalar<'_>) -> Result<SkillValue, FieldValueError> {
    Ok(match scalar {
        Scalar::Boolean(value) => SkillValue::Boolean(*value),
        Scalar::SByte(value) => SkillValue::SByte(*value),
        Scalar::Byte(value) => SkillValue::Byte(*value),
        Scalar::Int16(value) => SkillValue::Int16(*value),
        Scalar::UInt16(value) => SkillValue::UInt16(*value),
        Scalar::Int32(value) => SkillValue::Int32(*value),
        Scalar::UInt32(value) => SkillValue::UInt32(*value),
        Scalar::Int64(value) => SkillValue::Int64(*value),
        Scalar::UInt64(value) => SkillValue::UInt64(*value),
        Scalar::Float(value) => SkillValue::Float(*value),
        Scalar::Double(value) => SkillValue::Double(*value),
        Scalar::String(text) => SkillValue::String(text.unwrap_or_default().to_owned()),
        other => return Err(FieldValueError::Scalar(other.builtin_type())),
    })
}

const ARRAY: u8 = 0x80;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_the_same_after_their_way_through_the_space() {
        let all = vec![
            SkillValue::from(true),
            SkillValue::SByte(-1),
            SkillValue::Byte(200),
            SkillValue::Int16(-300),
            SkillValue::UInt16(60_000),
            SkillValue::from(-70_000),
            SkillValue::from(70_000_u32),
            SkillValue::Int64(i64::MIN),
            SkillValue::UInt64(u64::MAX),
            SkillValue::from(0.5_f32),
            SkillValue::from(0.1),
            SkillValue::from("J\u{f8}rg"),
            SkillValue::from([0.25; 6]),
            SkillValue::Array(Builtin::String, vec!["a".into(), "".into()]),
            SkillValue::Array(Builtin::Boolean, Vec::new()),
        ];
        let read = values(&block(&all)).unwrap();
        assert_eq!(read, all.into_iter().map(Some).collect::<Vec<_>>());
    }

    #[test]
    fn what_is_null_is_not_given_and_what_is_no_value_of_a_skill_is_told() {
        assert_eq!(values(&[1, 0, 0]), Ok(vec![None]));
        // A StatusCode.
        assert!(
            values(&[1, 0, 19, 0, 0, 0, 0])
                .unwrap_err()
                .to_string()
                .contains("StatusCode")
        );
        assert!(values(&[1]).is_err());
    }

    #[test]
    fn each_type_has_the_number_of_the_field_type() {
        for of in Builtin::ALL {
            assert_eq!(builtin(*of) as u8, of.id());
        }
    }
}
