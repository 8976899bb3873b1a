//! Encodes the fields of requests and goals: values of skills, and structures of them.

use bridge_node::{CallField, CallStructure};
use messages::ArrayRank;
use serde_json::Value as Json;
use skills::{Builtin, SkillValue, ValueError, ValueShape};
use uadp::BuiltinType;

use crate::fields;

/// The reason why a value is not encoded.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(crate) enum FieldEncodeError {
    /// The fields of the message are not known.
    #[error("the executor does not announce its fields")]
    NotAnnounced,
    /// A component has no values of the type.
    #[error("a {0:?} cannot be written in a component")]
    Unwritable(BuiltinType),
    /// The value has another type.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// An element of a list is wrong.
    #[error("[{at}]: {error}")]
    Element {
        /// The index of the element.
        at: usize,
        /// The reason.
        error: Box<Self>,
    },
    /// A field of a message is wrong.
    #[error("{name}: {error}")]
    Field {
        /// The name of the field.
        name: String,
        /// The reason.
        error: Box<Self>,
    },
    /// A message of this type is not given by its fields.
    #[error("a map with fields of {0} is needed")]
    NoMap(String),
    /// The message has no such field.
    #[error("{message} has no field `{field}`")]
    NoField {
        /// The type of the message.
        message: String,
        /// The name of the field.
        field: String,
    },
    /// A field without a default value is missing.
    #[error("it must be set")]
    Unset,
    /// Messages are not given as a list.
    #[error("a list of messages is needed")]
    NoList,
    /// An array of fixed length has another number of values.
    #[error("it has {length} values, and {given} are given")]
    Length {
        /// The length of the array.
        length: u32,
        /// The number of given values.
        given: usize,
    },
    /// A list is too long.
    #[error("{0} elements are too many")]
    TooMany(usize),
    /// A message is too large.
    #[error("it is larger than {MOST_BYTES} bytes")]
    TooLarge,
}

impl FieldEncodeError {
    fn at(self, at: usize) -> Self {
        let error = Box::new(self);
        Self::Element { at, error }
    }
}

/// Encodes a value as a Variant of the type of a field. `namespace` is the namespace of the call,
/// in which the types of its structures are.
pub(crate) fn encoded(
    field: &CallField,
    value: &Json,
    namespace: u16,
) -> Result<Vec<u8>, FieldEncodeError> {
    if let Some(structure) = &field.structure {
        return structures(field.rank, structure, value, namespace);
    }
    let none = || {
        if field.builtin == BuiltinType::ExtensionObject {
            FieldEncodeError::NotAnnounced
        } else {
            FieldEncodeError::Unwritable(field.builtin)
        }
    };
    let builtin = Builtin::of_id(u32::from(field.builtin as u8)).ok_or_else(none)?;
    let array = field.rank != ArrayRank::Scalar;
    let shape = ValueShape { builtin, array };
    let value = match value.as_array() {
        Some(elements) => elements
            .iter()
            .map(|element| typed(builtin, element))
            .collect(),
        None => typed(builtin, value),
    };
    let value = shape.read_json(&value)?;
    if let SkillValue::Array(_, elements) = &value {
        has_length(field.rank, elements.len())?;
    }
    let one = fields::block(&[value]);
    Ok(one.get(2..).unwrap_or_default().to_vec())
}

/// Converts a constant, or a number without a fraction, into JSON of that type.
fn typed(builtin: Builtin, value: &Json) -> Json {
    let whole = |text: &str| serde_json::from_str::<Json>(text).ok();
    match (builtin, value) {
        (Builtin::String, _) => value.clone(),
        (_, Json::String(text)) => whole(text).unwrap_or_else(|| value.clone()),
        (Builtin::Double | Builtin::Float, _) => value.clone(),
        (_, Json::Number(number)) => match number.as_f64() {
            Some(float) if number.is_f64() && float.fract() == 0.0 => {
                whole(&format!("{float:.0}")).unwrap_or_else(|| value.clone())
            }
            Some(_) | None => value.clone(),
        },
        (_, Json::Bool(_) | Json::Null | Json::Array(_) | Json::Object(_)) => value.clone(),
    }
}

/// Returns the default value of a ROS message field, or `None` for a field that is a message.
pub(crate) fn nothing(field: &CallField) -> Option<Vec<u8>> {
    let width = match field.builtin {
        BuiltinType::Boolean | BuiltinType::SByte | BuiltinType::Byte => 1,
        BuiltinType::Int16 | BuiltinType::UInt16 => 2,
        BuiltinType::Int32
        | BuiltinType::UInt32
        | BuiltinType::Float
        // The length of the text.
        | BuiltinType::String
        | BuiltinType::ByteString => 4,
        BuiltinType::Int64
        | BuiltinType::UInt64
        | BuiltinType::Double
        | BuiltinType::DateTime => 8,
        BuiltinType::Guid
        | BuiltinType::XmlElement
        | BuiltinType::NodeId
        | BuiltinType::ExpandedNodeId
        | BuiltinType::StatusCode
        | BuiltinType::QualifiedName
        | BuiltinType::LocalizedText
        | BuiltinType::ExtensionObject
        | BuiltinType::DataValue
        | BuiltinType::Variant
        | BuiltinType::DiagnosticInfo => 0,
    };
    let one = match field.builtin == BuiltinType::DateTime {
        true => UNIX_EPOCH.to_le_bytes().to_vec(),
        false => vec![0; width],
    };
    let id = field.builtin as u8;
    match field.rank {
        ArrayRank::Scalar if width == 0 => None,
        ArrayRank::Scalar => Some([vec![id], one].concat()),
        ArrayRank::Array { fixed: Some(_) } if width == 0 => None,
        ArrayRank::Array { fixed } => {
            let count = fixed.unwrap_or_default();
            if usize::try_from(count).is_ok_and(|count| count > MOST_ELEMENTS) {
                return None;
            }
            let length = i32::try_from(count).ok()?.to_le_bytes().to_vec();
            let elements = one.repeat(usize::try_from(count).ok()?);
            Some([vec![id | ARRAY], length, elements].concat())
        }
    }
}

/// Encodes a ByteString as a Variant.
pub(crate) fn bytes(of: &[u8; 16]) -> Vec<u8> {
    [&[BYTE_STRING][..], &16_i32.to_le_bytes(), of].concat()
}

/// Encodes a block of Variants.
pub(crate) fn block(variants: &[Vec<u8>]) -> Vec<u8> {
    // A call has a few thousand fields at most.
    let count = u16::try_from(variants.len()).unwrap_or(u16::MAX);
    [count.to_le_bytes().to_vec(), variants.concat()].concat()
}

/// Encodes messages as a Variant: a scalar or an array of ExtensionObjects.
fn structures(
    rank: ArrayRank,
    structure: &CallStructure,
    value: &Json,
    namespace: u16,
) -> Result<Vec<u8>, FieldEncodeError> {
    let one = |value: &Json| {
        let body = body(structure, value)?;
        let mut object = vec![STRING_NODE];
        object.extend(namespace.to_le_bytes());
        for (is_body, bytes) in [(false, structure.name.as_bytes()), (true, &body)] {
            if is_body {
                object.push(BINARY_BODY);
            }
            object.extend(length(bytes.len())?);
            object.extend(bytes);
        }
        Ok::<_, FieldEncodeError>(object)
    };
    let id = BuiltinType::ExtensionObject as u8;
    if rank == ArrayRank::Scalar {
        return Ok([vec![id], one(value)?].concat());
    }
    let elements = list(rank, value)?;
    let mut variant = vec![id | ARRAY];
    variant.extend(length(elements.len())?);
    for (at, element) in elements.iter().enumerate() {
        variant.extend(one(element).map_err(|error| error.at(at))?);
    }
    Ok(variant)
}

/// Encodes the fields of a message. Fields that are not given have the default values of ROS.
fn body(structure: &CallStructure, value: &Json) -> Result<Vec<u8>, FieldEncodeError> {
    let empty = serde_json::Map::new();
    let given = match value {
        Json::Null => &empty,
        Json::Object(given) => given,
        Json::Bool(_) | Json::Number(_) | Json::String(_) | Json::Array(_) => {
            return Err(FieldEncodeError::NoMap(structure.name.clone()));
        }
    };
    let is_field = |name: &String| structure.fields.iter().any(|field| field.name == *name);
    if let Some(unknown) = given.keys().find(|name| !is_field(name)) {
        return Err(FieldEncodeError::NoField {
            message: structure.name.clone(),
            field: unknown.clone(),
        });
    }
    let mut body = Vec::new();
    for field in &structure.fields {
        let value = given.get(&field.name);
        let bytes = match &field.structure {
            Some(inner) => inline(field.rank, inner, value),
            None => match value {
                // Without the EncodingMask a Variant is encoded as a field of a structure.
                Some(value) => encoded(field, value, 0).map(|variant| untagged(&variant)),
                None => nothing(field)
                    .map(|variant| untagged(&variant))
                    .ok_or(FieldEncodeError::Unset),
            },
        };
        body.extend(bytes.map_err(|error| FieldEncodeError::Field {
            name: field.name.clone(),
            error: Box::new(error),
        })?);
        has_room(body.len())?;
    }
    Ok(body)
}

/// Encodes messages within a message.
fn inline(
    rank: ArrayRank,
    structure: &CallStructure,
    value: Option<&Json>,
) -> Result<Vec<u8>, FieldEncodeError> {
    let ArrayRank::Array { fixed } = rank else {
        return body(structure, value.unwrap_or(&Json::Null));
    };
    let count = usize::try_from(fixed.unwrap_or_default()).unwrap_or(usize::MAX);
    if count > MOST_ELEMENTS {
        return Err(FieldEncodeError::TooMany(count));
    }
    let empty = Json::Array(vec![Json::Null; count]);
    let value = value.unwrap_or(&empty);
    let elements = list(rank, value)?;
    let mut bytes = length(elements.len())?.to_vec();
    for (at, element) in elements.iter().enumerate() {
        bytes.extend(body(structure, element).map_err(|error| error.at(at))?);
        has_room(bytes.len())?;
    }
    Ok(bytes)
}

fn list(rank: ArrayRank, value: &Json) -> Result<&Vec<Json>, FieldEncodeError> {
    let elements = value.as_array().ok_or(FieldEncodeError::NoList)?;
    has_length(rank, elements.len())?;
    Ok(elements)
}

fn has_length(rank: ArrayRank, given: usize) -> Result<(), FieldEncodeError> {
    match rank {
        ArrayRank::Array {
            fixed: Some(length),
        } if u32::try_from(given) != Ok(length) => Err(FieldEncodeError::Length { length, given }),
        ArrayRank::Array { .. } | ArrayRank::Scalar => Ok(()),
    }
}

/// Checks the size of a message. Arrays of fixed length in each other multiply their lengths.
fn has_room(size: usize) -> Result<(), FieldEncodeError> {
    match size <= MOST_BYTES {
        true => Ok(()),
        false => Err(FieldEncodeError::TooLarge),
    }
}

fn length(of: usize) -> Result<[u8; 4], FieldEncodeError> {
    let length = i32::try_from(of).map_err(|_| FieldEncodeError::TooMany(of))?;
    Ok(length.to_le_bytes())
}

fn untagged(variant: &[u8]) -> Vec<u8> {
    variant.get(1..).unwrap_or_default().to_vec()
}

/// Encodes no time as a Variant.
pub(crate) fn no_time() -> Vec<u8> {
    [&[DATE_TIME][..], &UNIX_EPOCH.to_le_bytes()].concat()
}

/// EncodingMasks of OPC 10000-6, 5.2.2.16.
pub(crate) const NULL: u8 = 0;
const ARRAY: u8 = 0x80;
const BYTE_STRING: u8 = 15;
const DATE_TIME: u8 = 13;
/// A NodeId with a text (OPC 10000-6, 5.2.2.9).
const STRING_NODE: u8 = 3;
/// An ExtensionObject with a binary body (OPC 10000-6, 5.2.2.15).
const BINARY_BODY: u8 = 1;
/// Maximum number of elements of an array of fixed length that are set to default values.
const MOST_ELEMENTS: usize = 65_536;
/// Maximum size of a message within a message.
const MOST_BYTES: usize = 16 << 20;
/// 1970 as a DateTime, which stands for no time in ROS messages.
const UNIX_EPOCH: i64 = 116_444_736_000_000_000;

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use serde_json::json;
    use uadp::{ExtensionBody, Fields, NodeId, Scalar, StructureReader, Variant};

    use super::*;

    /// `{string name, float64 weight, Point at, Point[] way}` in arrays of a request.
    fn constraints() -> CallField {
        let point = Arc::new(CallStructure {
            name: "geometry_msgs/Point".to_owned(),
            fields: ["x", "y"]
                .map(|name| CallField::scalar(name, BuiltinType::Double))
                .to_vec(),
        });
        let points = |field: CallField| CallField {
            structure: Some(Arc::clone(&point)),
            ..field
        };
        let constraint = CallStructure {
            name: "moveit_msgs/Constraint".to_owned(),
            fields: vec![
                CallField::scalar("name", BuiltinType::String),
                CallField::scalar("weight", BuiltinType::Double),
                points(CallField::scalar("at", BuiltinType::ExtensionObject)),
                points(CallField::array("way", BuiltinType::ExtensionObject)),
            ],
        };
        CallField {
            structure: Some(Arc::new(constraint)),
            ..CallField::array("constraints", BuiltinType::ExtensionObject)
        }
    }

    #[test]
    fn messages_in_arrays_are_written_with_default_values_for_all_else() {
        let value = json!([{"name": "tip", "way": [{"y": "2.5"}, {}]}, {"weight": 1}]);
        let variant = encoded(&constraints(), &value, 7).unwrap();
        let block = block(&[variant]);
        let mut fields = Fields::parse(&block).unwrap();
        let Some(Ok(Variant::Array(array))) = fields.next() else {
            panic!("no array")
        };
        let mut objects = array.iter();
        let mut reader = |name: &str| {
            let Some(Scalar::ExtensionObject(object)) = objects.next() else {
                panic!("no object")
            };
            assert_eq!(object.type_id, NodeId::string(7, name));
            let ExtensionBody::Binary(body) = object.body else {
                panic!("{:?}", object.body)
            };
            body.to_vec()
        };
        let first = reader("moveit_msgs/Constraint");
        let mut expected = vec![3, 0, 0, 0];
        expected.extend(b"tip");
        for number in [0.0, 0.0, 0.0] {
            expected.extend(f64::to_le_bytes(number));
        }
        expected.extend([2, 0, 0, 0]);
        for number in [0.0, 2.5, 0.0, 0.0] {
            expected.extend(f64::to_le_bytes(number));
        }
        assert_eq!(first, expected);
        let second = reader("moveit_msgs/Constraint");
        let mut weight = StructureReader::new(&second);
        assert_eq!(weight.length().unwrap(), Some(0), "an empty name");
        assert_eq!(second.len(), 4 + 3 * 8 + 4);
        assert!(objects.next().is_none());
    }

    #[test]
    fn fixed_arrays_in_each_other_are_refused_before_they_fill_the_memory() {
        let fixed = |name: &str, of: BuiltinType, structure| CallField {
            rank: ArrayRank::Array {
                fixed: Some(60_000),
            },
            structure,
            ..CallField::array(name, of)
        };
        let inner = CallStructure {
            name: "a/Inner".to_owned(),
            fields: vec![fixed("values", BuiltinType::Double, None)],
        };
        let outer = CallStructure {
            name: "a/Outer".to_owned(),
            fields: vec![fixed(
                "parts",
                BuiltinType::ExtensionObject,
                Some(Arc::new(inner)),
            )],
        };
        let field = CallField {
            structure: Some(Arc::new(outer)),
            ..CallField::scalar("goal", BuiltinType::ExtensionObject)
        };
        let why = encoded(&field, &json!({}), 7).unwrap_err().to_string();
        assert!(why.contains("larger than"), "{why}");
    }

    #[test]
    fn a_wrong_field_is_named_with_its_path() {
        let wrong = |value: Json| {
            let error = encoded(&constraints(), &value, 7).unwrap_err();
            error.to_string()
        };
        assert_eq!(
            wrong(json!([{}, {"way": [{"z": 1}]}])),
            "[1]: way: [0]: geometry_msgs/Point has no field `z`"
        );
        assert_eq!(wrong(json!({"name": "x"})), "a list of messages is needed");
        let why = wrong(json!([{"weight": "heavy"}]));
        assert!(why.starts_with("[0]: weight: "), "{why}");
        let unknown = CallField::array("poses", BuiltinType::ExtensionObject);
        assert_eq!(
            encoded(&unknown, &json!([{}]), 7).unwrap_err().to_string(),
            "the executor does not announce its fields"
        );
    }
}
