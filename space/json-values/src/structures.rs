//! Structures of the standard that are shown with their fields; other structures are shown as
//! bytes.

use serde_json::{Map, Value};
use uadp::{BuiltinType, StructureReader};

use crate::values::{WrongValue, show_scalar, write_scalar};

/// The type of a structure and its fields, in order.
#[derive(Debug)]
pub struct JsonStructure {
    /// NodeId of the type in namespace 0.
    pub data_type: u32,
    /// NodeId of its binary encoding in namespace 0.
    pub encoding: u32,
    /// NodeId of its JSON encoding in namespace 0.
    json_encoding: u32,
    fields: &'static [(&'static str, StructurePartType)],
}

#[derive(Debug)]
enum StructurePartType {
    Value(BuiltinType),
    Inline(&'static [(&'static str, Self)]),
}

impl JsonStructure {
    /// Returns the structure with this NodeId of its binary encoding.
    #[must_use]
    pub fn by_encoding(encoding: u32) -> Option<&'static Self> {
        KNOWN.iter().find(|known| known.encoding == encoding)
    }

    /// Returns the structure with this NodeId of its type.
    #[must_use]
    pub fn by_data_type(data_type: u32) -> Option<&'static Self> {
        KNOWN.iter().find(|known| known.data_type == data_type)
    }

    /// Returns the structure with this NodeId of its type, or of its binary or JSON encoding. The
    /// numbers of namespace 0 are unique.
    #[must_use]
    pub fn by_type_or_encoding(id: u32) -> Option<&'static Self> {
        KNOWN
            .iter()
            .find(|known| [known.data_type, known.encoding, known.json_encoding].contains(&id))
    }

    /// Converts each field with its type. A missing field is `None`; unknown keys are kept.
    ///
    /// # Errors
    /// The first error of `convert`.
    pub fn map_fields<E>(
        &self,
        json: &Map<String, Value>,
        convert: &mut impl FnMut(BuiltinType, Option<&Value>) -> Result<Value, E>,
    ) -> Result<Map<String, Value>, E> {
        map_fields(self.fields, json, convert)
    }

    /// Returns the fields of a body; `None` if the body has other fields, or encoding the fields
    /// gives other bytes.
    #[must_use]
    pub fn show(&self, body: &[u8]) -> Option<Map<String, Value>> {
        let mut reader = StructureReader::new(body);
        let mut shown = show_fields(self.fields, &mut reader)?;
        shown.insert(
            "UaTypeId".to_owned(),
            format!("i={}", self.data_type).into(),
        );
        let mut again = Vec::new();
        self.write(&shown, &mut again).ok()?;
        (again == body).then_some(shown)
    }

    /// Appends the body.
    ///
    /// # Errors
    /// A [`WrongValue`] for a missing, unknown or wrong field.
    pub fn write(&self, json: &Map<String, Value>, out: &mut Vec<u8>) -> Result<(), WrongValue> {
        write_fields(self.fields, &["UaTypeId"], json, out)
    }
}

fn map_fields<E, C: FnMut(BuiltinType, Option<&Value>) -> Result<Value, E>>(
    fields: &[(&str, StructurePartType)],
    json: &Map<String, Value>,
    convert: &mut C,
) -> Result<Map<String, Value>, E> {
    let mut mapped = json.clone();
    let empty = Map::new();
    for (name, part) in fields {
        let value = json.get(*name);
        let converted = match (part, value) {
            (StructurePartType::Value(builtin), value) => convert(*builtin, value)?,
            (StructurePartType::Inline(fields), None | Some(Value::Null)) => {
                map_fields(fields, &empty, convert)?.into()
            }
            (StructurePartType::Inline(fields), Some(Value::Object(inner))) => {
                map_fields(fields, inner, convert)?.into()
            }
            (StructurePartType::Inline(_), Some(other)) => other.clone(),
        };
        mapped.insert((*name).to_owned(), converted);
    }
    Ok(mapped)
}

fn show_fields(
    fields: &[(&str, StructurePartType)],
    reader: &mut StructureReader<'_>,
) -> Option<Map<String, Value>> {
    let mut shown = Map::new();
    for (name, part) in fields {
        let value = match part {
            StructurePartType::Value(builtin) => show_scalar(reader.scalar(*builtin).ok()?).ok()?,
            StructurePartType::Inline(fields) => show_fields(fields, reader)?.into(),
        };
        shown.insert((*name).to_owned(), value);
    }
    Some(shown)
}

fn write_fields(
    fields: &[(&str, StructurePartType)],
    besides: &[&str],
    json: &Map<String, Value>,
    out: &mut Vec<u8>,
) -> Result<(), WrongValue> {
    let named = |key: &str| besides.contains(&key) || fields.iter().any(|(name, _)| *name == key);
    if let Some(key) = json.keys().find(|key| !named(key)) {
        return Err(WrongValue::new(format!(
            "the structure has no field `{key}`"
        )));
    }
    for (name, part) in fields {
        let missing = || WrongValue::new(format!("the structure lacks the field `{name}`"));
        let value = json.get(*name).ok_or_else(missing)?;
        let written = match part {
            StructurePartType::Value(builtin) => write_scalar(*builtin, value, out),
            StructurePartType::Inline(fields) => match value.as_object() {
                Some(json) => write_fields(fields, &[], json, out),
                None => Err(WrongValue::expected("an object", value)),
            },
        };
        written.map_err(|wrong| wrong.at(&format!(".{name}")))?;
    }
    Ok(())
}

/// Numbers of OPC 10000-6, Annex A (NodeIds).
const KNOWN: [JsonStructure; 3] = [
    JsonStructure {
        data_type: 884,
        encoding: 886,
        json_encoding: 15375,
        fields: RANGE,
    },
    JsonStructure {
        data_type: 887,
        encoding: 889,
        json_encoding: 15376,
        fields: EU_INFORMATION,
    },
    JsonStructure {
        data_type: 18814,
        encoding: 18823,
        json_encoding: 19072,
        fields: THREE_D_FRAME,
    },
];

const RANGE: &[(&str, StructurePartType)] = &[
    ("Low", StructurePartType::Value(BuiltinType::Double)),
    ("High", StructurePartType::Value(BuiltinType::Double)),
];

const EU_INFORMATION: &[(&str, StructurePartType)] = &[
    (
        "NamespaceUri",
        StructurePartType::Value(BuiltinType::String),
    ),
    ("UnitId", StructurePartType::Value(BuiltinType::Int32)),
    (
        "DisplayName",
        StructurePartType::Value(BuiltinType::LocalizedText),
    ),
    (
        "Description",
        StructurePartType::Value(BuiltinType::LocalizedText),
    ),
];

const THREE_D_FRAME: &[(&str, StructurePartType)] = &[
    (
        "CartesianCoordinates",
        StructurePartType::Inline(&[
            ("X", StructurePartType::Value(BuiltinType::Double)),
            ("Y", StructurePartType::Value(BuiltinType::Double)),
            ("Z", StructurePartType::Value(BuiltinType::Double)),
        ]),
    ),
    (
        "Orientation",
        StructurePartType::Inline(&[
            ("A", StructurePartType::Value(BuiltinType::Double)),
            ("B", StructurePartType::Value(BuiltinType::Double)),
            ("C", StructurePartType::Value(BuiltinType::Double)),
        ]),
    ),
];
