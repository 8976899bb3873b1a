//! Structures in arrays, with fields defined in the announcement of a topic or call.

use serde_json::{Map, Value};
use uadp::discovery::{DataTypeSchemaHeader, StructureField, StructureType};
use uadp::{BuiltinType, DecodeError, ExtensionBody, NodeId, NodeIdValue, Scalar, StructureReader};

use super::scalars;

/// The fields of a structure, including nested structures.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct StructureFields(Vec<StructurePart>);

#[derive(Debug, Clone, PartialEq, Eq)]
struct StructurePart {
    name: String,
    kind: ReadFieldKind,
    is_array: bool,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum ReadFieldKind {
    Builtin(BuiltinType),
    Structure(StructureFields),
}

impl StructureFields {
    /// Returns the structure of a DataType; `None` if the schema does not define it or it exceeds a
    /// limit. `room` is the remaining number of fields, including the fields of nested structures,
    /// because a short schema can define any number of them.
    pub(super) fn of(
        schema: &DataTypeSchemaHeader<'_>,
        data_type: NodeId<'_>,
        room: &mut usize,
    ) -> Option<Self> {
        Self::within(schema, data_type, (MOST_NESTED, room))
    }

    fn within(
        schema: &DataTypeSchemaHeader<'_>,
        data_type: NodeId<'_>,
        (depth, room): (usize, &mut usize),
    ) -> Option<Self> {
        let depth = depth.checked_sub(1)?;
        let found = schema.structure(data_type)?.structure_definition;
        if found.structure_type != StructureType::STRUCTURE {
            return None;
        }
        *room = room.checked_sub(found.fields.len())?;
        let parts = found.fields.iter().map(|field| {
            Some(StructurePart {
                name: field.name.unwrap_or_default().to_owned(),
                kind: match builtin(&field) {
                    Some(builtin) => ReadFieldKind::Builtin(builtin),
                    None => ReadFieldKind::Structure(Self::within(
                        schema,
                        field.data_type,
                        (depth, room),
                    )?),
                },
                is_array: match field.value_rank {
                    -1 => false,
                    1 => true,
                    _ => return None,
                },
            })
        });
        parts.collect::<Option<Vec<_>>>().map(Self)
    }

    /// Returns the approximate size in bytes.
    pub(super) fn weight(&self) -> usize {
        let of = |part: &StructurePart| {
            let inner = match &part.kind {
                ReadFieldKind::Builtin(_) => 0,
                ReadFieldKind::Structure(structure) => structure.weight(),
            };
            size_of::<StructurePart>() + part.name.len() + inner
        };
        self.0.iter().map(of).sum()
    }

    /// Returns the fields of a value; `None` if the value is not a structure in the binary
    /// encoding.
    ///
    /// # Errors
    /// [`DecodeError`] if the value does not match the announcement.
    pub(super) fn show(&self, value: Scalar<'_>) -> Result<Option<Value>, DecodeError> {
        let Scalar::ExtensionObject(object) = value else {
            return Ok(None);
        };
        let ExtensionBody::Binary(body) = object.body else {
            return Ok(None);
        };
        let mut room = MOST_VALUES;
        self.read(&mut StructureReader::new(body), &mut room)
            .map(Some)
    }

    fn read(&self, body: &mut StructureReader<'_>, room: &mut usize) -> Result<Value, DecodeError> {
        const TOO_MUCH: DecodeError = DecodeError::Misread("more structures than are shown");
        *room = room.checked_sub(1).ok_or(TOO_MUCH)?;
        let mut shown = Map::new();
        for part in &self.0 {
            let value = match (&part.kind, part.is_array) {
                (ReadFieldKind::Builtin(builtin), false) => {
                    scalars::scalar(body.scalar(*builtin)?)?
                }
                (ReadFieldKind::Builtin(builtin), true) => {
                    scalars::elements(body.array(*builtin)?)?
                }
                (ReadFieldKind::Structure(structure), false) => structure.read(body, room)?,
                (ReadFieldKind::Structure(structure), true) => {
                    (0..body.length()?.unwrap_or_default())
                        .map(|_| structure.read(body, room))
                        .collect::<Result<_, _>>()?
                }
            };
            shown.insert(part.name.clone(), value);
        }
        Ok(Value::Object(shown))
    }
}

/// Returns the builtin type of a field if its DataType is a builtin type.
fn builtin(field: &StructureField<'_>) -> Option<BuiltinType> {
    match (field.data_type.namespace, field.data_type.identifier) {
        (0, NodeIdValue::Numeric(number)) => BuiltinType::from_id(number.try_into().ok()?),
        _ => None,
    }
}

/// Maximum depth of nested structures.
const MOST_NESTED: usize = 16;
/// Maximum number of structures shown of a value.
const MOST_VALUES: usize = 1 << 16;
