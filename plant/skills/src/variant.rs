//! Conversion between values of skills and Variants of OPC UA.

use plant_opcua::types::{Array, NodeId, UAString, Variant, VariantScalarTypeId};

use crate::client::packed::frame;
use crate::value::{Builtin, SkillValue};

/// Converts a value to a Variant.
pub fn to_variant(value: &SkillValue) -> Variant {
    match value {
        SkillValue::Boolean(value) => Variant::Boolean(*value),
        SkillValue::SByte(value) => Variant::SByte(*value),
        SkillValue::Byte(value) => Variant::Byte(*value),
        SkillValue::Int16(value) => Variant::Int16(*value),
        SkillValue::UInt16(value) => Variant::UInt16(*value),
        SkillValue::Int32(value) => Variant::Int32(*value),
        SkillValue::UInt32(value) => Variant::UInt32(*value),
        SkillValue::Int64(value) => Variant::Int64(*value),
        SkillValue::UInt64(value) => Variant::UInt64(*value),
        SkillValue::Float(value) => Variant::Float(*value),
        SkillValue::Double(value) => Variant::Double(*value),
        SkillValue::String(value) => Variant::String(UAString::from(value.as_str())),
        SkillValue::Array(builtin, elements) => {
            let values = elements.iter().map(to_variant).collect();
            Variant::Array(Box::new(Array {
                value_type: scalar_type(*builtin),
                values,
                dimensions: None,
            }))
        }
    }
}

/// Returns names and values as two arrays, as the arguments of methods have them.
pub(crate) fn to_pairs(of: &[(String, SkillValue)]) -> [Variant; 2] {
    let array = |value_type, values| {
        Variant::Array(Box::new(Array {
            value_type,
            values,
            dimensions: None,
        }))
    };
    let names = of
        .iter()
        .map(|(name, _)| Variant::String(UAString::from(name.as_str())));
    let values = of
        .iter()
        .map(|(_, value)| Variant::Variant(Box::new(to_variant(value))));
    [
        array(VariantScalarTypeId::String, names.collect()),
        array(VariantScalarTypeId::Variant, values.collect()),
    ]
}

/// Returns names and values as two arrays. A missing value is an empty Variant.
pub(crate) fn to_optional_pairs(of: &[(String, Option<SkillValue>)]) -> [Variant; 2] {
    let names = of.iter().map(|(name, _)| (name.clone(), false.into()));
    let [names, _] = to_pairs(&names.collect::<Vec<_>>());
    let values = of.iter().map(|(_, value)| {
        let value = value.as_ref().map_or(Variant::Empty, to_variant);
        Variant::Variant(Box::new(value))
    });
    let values = Array {
        value_type: VariantScalarTypeId::Variant,
        values: values.collect(),
        dimensions: None,
    };
    [names, Variant::Array(Box::new(values))]
}

/// Reads pairs from two arrays, with empty Variants as missing values; `None` if their lengths
/// differ or a value is not supported.
pub(crate) fn from_optional_pairs(
    names: &Variant,
    values: &Variant,
) -> Option<Vec<(String, Option<SkillValue>)>> {
    let array = |of: &Variant| {
        if let Variant::Array(array) = of {
            return Some(array.values.clone());
        }
        matches!(of, Variant::Empty).then(Vec::new)
    };
    let (names, values) = (array(names)?, array(values)?);
    if names.len() != values.len() {
        return None;
    }
    let pair = |(name, value): (&Variant, &Variant)| {
        let value = if let Variant::Variant(inner) = value {
            inner
        } else {
            value
        };
        let value = match *value == Variant::Empty {
            true => None,
            false => Some(from_variant(value)?),
        };
        Some((from_variant(name)?.as_str()?.to_owned(), value))
    };
    names.iter().zip(&values).map(pair).collect()
}

/// Reads pairs from two arrays; `None` if their lengths differ or a value is not supported.
pub(crate) fn from_pairs(names: &Variant, values: &Variant) -> Option<Vec<(String, SkillValue)>> {
    let elements = |of: &Variant| {
        if let Variant::Array(array) = of {
            return Some(array.values.clone());
        }
        matches!(of, Variant::Empty).then(Vec::new)
    };
    let (names, values) = (elements(names)?, elements(values)?);
    if names.len() != values.len() {
        return None;
    }
    let pair = |(name, value): (&Variant, &Variant)| {
        let value = if let Variant::Variant(inner) = value {
            from_variant(inner)
        } else {
            from_variant(value)
        };
        Some((from_variant(name)?.as_str()?.to_owned(), value?))
    };
    names.iter().zip(&values).map(pair).collect()
}

/// Converts a Variant to a value; `None` for other types, arrays of several dimensions and empty
/// Variants. A 3DFrame becomes the six numbers of a position.
#[expect(
    clippy::wildcard_enum_match_arm,
    reason = "of the types of OPC UA those that a skill can be told in are named"
)]
pub fn from_variant(variant: &Variant) -> Option<SkillValue> {
    Some(match variant {
        Variant::Boolean(value) => SkillValue::Boolean(*value),
        Variant::SByte(value) => SkillValue::SByte(*value),
        Variant::Byte(value) => SkillValue::Byte(*value),
        Variant::Int16(value) => SkillValue::Int16(*value),
        Variant::UInt16(value) => SkillValue::UInt16(*value),
        Variant::Int32(value) => SkillValue::Int32(*value),
        Variant::UInt32(value) => SkillValue::UInt32(*value),
        Variant::Int64(value) => SkillValue::Int64(*value),
        Variant::UInt64(value) => SkillValue::UInt64(*value),
        Variant::Float(value) => SkillValue::Float(*value),
        Variant::Double(value) => SkillValue::Double(*value),
        Variant::String(value) => SkillValue::String(value.as_ref().to_owned()),
        Variant::Array(array) => {
            if array
                .dimensions
                .as_ref()
                .is_some_and(|dimensions| dimensions.len() > 1)
            {
                return None;
            }
            let builtin = Builtin::ALL
                .iter()
                .copied()
                .find(|one| scalar_type(*one) == array.value_type)?;
            let elements: Option<Vec<SkillValue>> = array.values.iter().map(from_variant).collect();
            let elements =
                elements.filter(|all| all.iter().all(|one| one.shape().builtin == builtin))?;
            SkillValue::Array(builtin, elements)
        }
        Variant::ExtensionObject(_) => return frame(variant),
        _ => return None,
    })
}

/// Returns the builtin type of a data type that is a builtin type.
pub(crate) fn builtin_of(data_type: &NodeId) -> Option<Builtin> {
    let id = (data_type.namespace == 0).then(|| data_type.as_u32())??;
    Builtin::of_id(id)
}

fn scalar_type(builtin: Builtin) -> VariantScalarTypeId {
    match builtin {
        Builtin::Boolean => VariantScalarTypeId::Boolean,
        Builtin::SByte => VariantScalarTypeId::SByte,
        Builtin::Byte => VariantScalarTypeId::Byte,
        Builtin::Int16 => VariantScalarTypeId::Int16,
        Builtin::UInt16 => VariantScalarTypeId::UInt16,
        Builtin::Int32 => VariantScalarTypeId::Int32,
        Builtin::UInt32 => VariantScalarTypeId::UInt32,
        Builtin::Int64 => VariantScalarTypeId::Int64,
        Builtin::UInt64 => VariantScalarTypeId::UInt64,
        Builtin::Float => VariantScalarTypeId::Float,
        Builtin::Double => VariantScalarTypeId::Double,
        Builtin::String => VariantScalarTypeId::String,
    }
}

#[cfg(test)]
mod tests {
    use plant_opcua::types::{
        ExtensionObject, Range, ThreeDCartesianCoordinates, ThreeDFrame, ThreeDOrientation,
    };

    use super::*;

    #[test]
    fn a_value_is_the_same_after_its_way_through_opc_ua() {
        for value in [
            SkillValue::from(true),
            SkillValue::UInt16(65_535),
            SkillValue::from("x"),
            SkillValue::from([0.5; 6]),
            SkillValue::Array(Builtin::String, Vec::new()),
        ] {
            assert_eq!(from_variant(&to_variant(&value)), Some(value));
        }
        assert_eq!(from_variant(&Variant::Empty), None);
        let frame = ThreeDFrame {
            cartesian_coordinates: ThreeDCartesianCoordinates {
                x: 0.1,
                y: 0.2,
                z: 0.3,
            },
            orientation: ThreeDOrientation {
                a: 1.0,
                b: 2.0,
                c: 3.0,
            },
        };
        let frame = Variant::from(ExtensionObject::from_message(frame));
        let six = SkillValue::from([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]);
        assert_eq!(from_variant(&frame), Some(six));
        let range = Range {
            low: 0.0,
            high: 1.0,
        };
        let range = Variant::from(ExtensionObject::from_message(range));
        assert_eq!(from_variant(&range), None, "it is no position");
        let mixed = Array {
            value_type: VariantScalarTypeId::Double,
            values: vec![Variant::Double(1.0), Variant::Int32(1)],
            dimensions: None,
        };
        assert_eq!(from_variant(&Variant::Array(Box::new(mixed))), None);
        assert_eq!(builtin_of(&NodeId::new(0, 10_u32)), Some(Builtin::Float));
    }

    #[test]
    fn pairs_are_the_same_after_their_way_and_others_are_none() {
        let all = vec![
            ("Force".to_owned(), SkillValue::from(0.5)),
            ("Target".to_owned(), [0.5; 6].into()),
        ];
        let [names, values] = to_pairs(&all);
        assert_eq!(from_pairs(&names, &values), Some(all));
        assert_eq!(
            from_pairs(&Variant::Empty, &Variant::Empty),
            Some(Vec::new())
        );
        assert_eq!(from_pairs(&names, &Variant::Empty), None);
        let some = vec![
            ("Force".to_owned(), Some(SkillValue::from(0.5))),
            ("Product".to_owned(), None),
        ];
        let [names, values] = to_optional_pairs(&some);
        assert_eq!(from_optional_pairs(&names, &values), Some(some));
        assert_eq!(from_optional_pairs(&names, &Variant::Empty), None);
    }
}
