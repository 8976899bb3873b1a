//! Converts definitions to a message type: dependencies, md5, full text, flattened fields.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

use md5::{Digest, Md5};
use uadp::BuiltinType;

use crate::definition::{
    Arity, ClockType, Constant, FieldType, MOST_FIELDS, MessageDefinition, Number, Primitive,
};
use crate::{ArrayRank, DefinitionError, Dialect, Leaf, MessageType, TypeName};

const DEEPEST: usize = 32;
const BIGGEST: usize = 64 << 20;

/// A message with its nested messages, as the plan compiler traverses it.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct MessageShape {
    pub(crate) name: TypeName,
    pub(crate) fields: Vec<ShapeField>,
    pub(crate) constants: Vec<Constant>,
    /// Number of flattened fields, including the fields of array elements.
    weight: usize,
    /// Minimum size in bytes on any wire, counting 1 for an empty message.
    size: usize,
    /// Levels of nested messages, including itself.
    height: usize,
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) struct ShapeField {
    pub(crate) name: String,
    pub(crate) kind: ShapeKind,
    pub(crate) arity: Arity,
}

#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ShapeKind {
    Primitive(Primitive),
    Message(Arc<MessageShape>),
    /// `seq` of a ROS 1 Header.
    Sequence,
}

impl Primitive {
    pub(crate) const fn builtin(self) -> BuiltinType {
        match self {
            Self::Number(number) => number.builtin(),
            Self::Clock(clock) => clock.builtin(),
            Self::Text(_) => BuiltinType::String,
        }
    }

    /// Returns the size of a value on the wire; for a string only the size of its length.
    pub(crate) const fn size(self) -> usize {
        match self {
            Self::Number(number) => number.size(),
            Self::Clock(_) => 8,
            Self::Text(_) => 4,
        }
    }
}

impl Number {
    pub(crate) const fn builtin(self) -> BuiltinType {
        match self {
            Self::Bool => BuiltinType::Boolean,
            Self::Int8 => BuiltinType::SByte,
            Self::UInt8 => BuiltinType::Byte,
            Self::Int16 => BuiltinType::Int16,
            Self::UInt16 => BuiltinType::UInt16,
            Self::Int32 => BuiltinType::Int32,
            Self::UInt32 => BuiltinType::UInt32,
            Self::Int64 => BuiltinType::Int64,
            Self::UInt64 => BuiltinType::UInt64,
            Self::Float32 => BuiltinType::Float,
            Self::Float64 => BuiltinType::Double,
        }
    }

    pub(crate) const fn size(self) -> usize {
        match self {
            Self::Bool | Self::Int8 | Self::UInt8 => 1,
            Self::Int16 | Self::UInt16 => 2,
            Self::Int32 | Self::UInt32 | Self::Float32 => 4,
            Self::Int64 | Self::UInt64 | Self::Float64 => 8,
        }
    }
}

impl ClockType {
    pub(crate) const fn builtin(self) -> BuiltinType {
        match self {
            Self::Time1 | Self::Time2 => BuiltinType::DateTime,
            Self::Duration1 | Self::Duration2 => BuiltinType::Double,
        }
    }
}

/// Looks up names in several sets of definitions; the first set with the name takes precedence.
pub(crate) struct TypeResolver<'r> {
    dialect: Dialect,
    sets: &'r [&'r BTreeMap<TypeName, Arc<MessageDefinition>>],
    shapes: BTreeMap<TypeName, Arc<MessageShape>>,
    md5s: BTreeMap<TypeName, String>,
}

impl<'r> TypeResolver<'r> {
    pub(crate) fn new(
        dialect: Dialect,
        sets: &'r [&'r BTreeMap<TypeName, Arc<MessageDefinition>>],
    ) -> Self {
        Self {
            dialect,
            sets,
            shapes: BTreeMap::new(),
            md5s: BTreeMap::new(),
        }
    }

    pub(crate) fn message_type(
        &mut self,
        name: &TypeName,
        definition: Option<&str>,
    ) -> Result<MessageType, DefinitionError> {
        let shape = match (self.dialect, self.time(name)) {
            (Dialect::Ros2, Some(primitive)) => {
                self.find(name, None)?;
                let data = ShapeField {
                    name: "data".to_owned(),
                    kind: ShapeKind::Primitive(primitive),
                    arity: Arity::One,
                };
                Arc::new(MessageShape {
                    name: name.clone(),
                    fields: vec![data],
                    constants: Vec::new(),
                    weight: 1,
                    size: 8,
                    height: 1,
                })
            }
            _ => self.shape(name, &mut Vec::new())?,
        };
        // After the shape, which has proven that no type contains itself.
        let md5 = match self.dialect {
            Dialect::Ros1 => self.md5(name)?,
            Dialect::Ros2 => String::new(),
        };
        let definition = match definition {
            Some(text) => text.to_owned(),
            None => self.full_text(name)?,
        };
        let mut leaves = Vec::new();
        flatten(&shape, "", &mut leaves);
        Ok(MessageType {
            name: name.clone(),
            dialect: self.dialect,
            md5,
            definition,
            leaves,
            shape,
        })
    }

    fn time(&self, name: &TypeName) -> Option<Primitive> {
        match self.dialect {
            Dialect::Ros2 if name.is("builtin_interfaces", "Time") => {
                Some(Primitive::Clock(ClockType::Time2))
            }
            Dialect::Ros2 if name.is("builtin_interfaces", "Duration") => {
                Some(Primitive::Clock(ClockType::Duration2))
            }
            Dialect::Ros1 | Dialect::Ros2 => None,
        }
    }

    fn find(
        &self,
        name: &TypeName,
        needed_by: Option<&TypeName>,
    ) -> Result<&'r Arc<MessageDefinition>, DefinitionError> {
        self.sets
            .iter()
            .find_map(|set| set.get(name))
            .ok_or_else(|| DefinitionError::Unknown {
                name: name.clone(),
                needed_by: needed_by.cloned(),
            })
    }

    /// Returns the shape of a type. `above`: the enclosing types.
    fn shape(
        &mut self,
        name: &TypeName,
        above: &mut Vec<TypeName>,
    ) -> Result<Arc<MessageShape>, DefinitionError> {
        if above.contains(name) {
            return Err(DefinitionError::Cyclic { name: name.clone() });
        }
        let too_deep = |height: usize| above.len() + height > DEEPEST;
        if let Some(shape) = self.shapes.get(name) {
            return if too_deep(shape.height) {
                Err(DefinitionError::TooDeep { name: name.clone() })
            } else {
                Ok(Arc::clone(shape))
            };
        }
        if too_deep(1) {
            return Err(DefinitionError::TooDeep { name: name.clone() });
        }
        let definition = self.find(name, above.last())?;
        above.push(name.clone());
        let mut shape = MessageShape {
            name: name.clone(),
            fields: Vec::new(),
            constants: definition.constants.clone(),
            weight: 0,
            size: 0,
            height: 1,
        };
        for field in &definition.fields {
            let kind = match &field.kind {
                _ if self.is_sequence(definition, &field.name) => ShapeKind::Sequence,
                FieldType::Primitive(primitive) => ShapeKind::Primitive(*primitive),
                FieldType::Message(inner) => match self.time(inner) {
                    Some(primitive) => ShapeKind::Primitive(primitive),
                    None => ShapeKind::Message(self.shape(inner, above)?),
                },
            };
            shape.push(ShapeField {
                name: field.name.clone(),
                kind,
                arity: field.arity,
            })?;
        }
        above.pop();
        shape.size = shape.size.max(1);
        let shape = Arc::new(shape);
        self.shapes.insert(name.clone(), Arc::clone(&shape));
        Ok(shape)
    }

    fn is_sequence(&self, definition: &MessageDefinition, field: &str) -> bool {
        self.dialect == Dialect::Ros1 && definition.name.is("std_msgs", "Header") && field == "seq"
    }

    /// Returns the md5 as genmsg does: constants first, then the fields, with the md5 of a message
    /// in place of its type.
    fn md5(&mut self, name: &TypeName) -> Result<String, DefinitionError> {
        if let Some(known) = self.md5s.get(name) {
            return Ok(known.clone());
        }
        let text = self.md5_text(name)?;
        let sum = hex(&Md5::digest(text));
        self.md5s.insert(name.clone(), sum.clone());
        Ok(sum)
    }

    /// Returns the input of the md5 of a type. The inputs of request and response form the md5 of a
    /// service.
    pub(crate) fn md5_text(&mut self, name: &TypeName) -> Result<String, DefinitionError> {
        let definition = self.find(name, None)?;
        let mut text = String::new();
        for constant in &definition.constants {
            text.push_str(&constant.line);
            text.push('\n');
        }
        for field in &definition.fields {
            let written = match &field.kind {
                FieldType::Primitive(_) => field.written.clone(),
                FieldType::Message(inner) => self.md5(inner)?,
            };
            text.push_str(&written);
            text.push(' ');
            text.push_str(&field.name);
            text.push('\n');
        }
        Ok(text.trim().to_owned())
    }

    /// Returns the text with the texts of all needed types, in the order of `gendeps --cat`.
    fn full_text(&self, name: &TypeName) -> Result<String, DefinitionError> {
        let mut needed = Vec::new();
        self.dependencies(name, &mut needed)?;
        let mut text = self.find(name, None)?.text.clone();
        for name in needed {
            let definition = self.find(&name, None)?;
            // Writing to a String cannot fail.
            write!(text, "\n{:=<80}\nMSG: {name}\n{}", "", definition.text).unwrap_or_default();
        }
        Ok(text)
    }

    /// Collects the types that a type needs, depth first, each once.
    fn dependencies(
        &self,
        name: &TypeName,
        found: &mut Vec<TypeName>,
    ) -> Result<(), DefinitionError> {
        if self.time(name).is_some() {
            return Ok(());
        }
        for field in &self.find(name, None)?.fields {
            if let FieldType::Message(inner) = &field.kind
                && !found.contains(inner)
            {
                found.push(inner.clone());
                self.dependencies(inner, found)?;
            }
        }
        Ok(())
    }
}

/// Returns the known name that is most similar to `name`, if any is close.
pub(crate) fn suggest<'k>(
    name: &TypeName,
    known: impl Iterator<Item = &'k TypeName>,
) -> Option<TypeName> {
    let wanted = name.to_string();
    let furthest = name.name().len() / 3;
    let (_, nearest) = known
        .filter_map(|known| {
            if known.name().eq_ignore_ascii_case(name.name()) {
                return Some((1, known));
            }
            let known_text = known.to_string();
            // A lower bound of the number of different letters.
            let longer = known_text.len().abs_diff(wanted.len());
            let distance = (longer <= furthest).then(|| distance(&wanted, &known_text))?;
            Some((distance, known))
        })
        .filter(|(distance, _)| *distance <= furthest)
        .min_by_key(|(distance, _)| *distance)?;
    Some(nearest.clone())
}

/// Returns lower case hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(bytes.len() * 2);
    for byte in bytes {
        // Writing to a String cannot fail.
        write!(text, "{byte:02x}").unwrap_or_default();
    }
    text
}

impl MessageShape {
    fn push(&mut self, field: ShapeField) -> Result<(), DefinitionError> {
        let (weight, element) = match &field.kind {
            ShapeKind::Primitive(primitive) => (1, primitive.size()),
            ShapeKind::Sequence => (1, 4),
            ShapeKind::Message(inner) => {
                self.height = self.height.max(inner.height + 1);
                (inner.weight + 1, inner.size)
            }
        };
        let size = match field.arity {
            Arity::One => Some(element),
            Arity::Fixed(count) => usize::try_from(count)
                .ok()
                .and_then(|count| element.checked_mul(count)),
            Arity::Sequence { .. } => Some(4),
        };
        let too_big = |what| DefinitionError::TooBig {
            name: self.name.clone(),
            what,
        };
        self.size = size
            .and_then(|size| self.size.checked_add(size))
            .filter(|size| *size <= BIGGEST)
            .ok_or_else(|| too_big("fixed arrays of more than 64 MiB"))?;
        self.weight = Some(self.weight + weight)
            .filter(|weight| *weight <= MOST_FIELDS)
            .ok_or_else(|| too_big("more than 4096 fields"))?;
        self.fields.push(field);
        Ok(())
    }
}

pub(crate) fn flatten(shape: &MessageShape, prefix: &str, leaves: &mut Vec<Leaf>) {
    for field in &shape.fields {
        let path = format!("{prefix}{}", field.name);
        match (&field.kind, field.arity) {
            (ShapeKind::Sequence, _) => {}
            (ShapeKind::Message(inner), Arity::One) => flatten(inner, &format!("{path}."), leaves),
            (ShapeKind::Message(_), arity) => leaves.push(Leaf {
                path,
                builtin: BuiltinType::ExtensionObject,
                rank: rank(arity),
            }),
            (
                ShapeKind::Primitive(Primitive::Number(Number::UInt8)),
                Arity::Fixed(_) | Arity::Sequence { .. },
            ) => {
                leaves.push(Leaf {
                    path,
                    builtin: BuiltinType::ByteString,
                    rank: ArrayRank::Scalar,
                });
            }
            (ShapeKind::Primitive(primitive), arity) => leaves.push(Leaf {
                path,
                builtin: primitive.builtin(),
                rank: rank(arity),
            }),
        }
    }
}

fn rank(arity: Arity) -> ArrayRank {
    match arity {
        Arity::One => ArrayRank::Scalar,
        Arity::Fixed(length) => ArrayRank::Array {
            fixed: Some(length),
        },
        Arity::Sequence { .. } => ArrayRank::Array { fixed: None },
    }
}

/// Returns the number of letters to change, add or remove.
fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut diagonal = i;
        let mut left = i + 1;
        if let Some(first) = row.first_mut() {
            *first = left;
        }
        for (cell, to) in row.iter_mut().skip(1).zip(&b) {
            let best = (diagonal + usize::from(from != *to))
                .min(left + 1)
                .min(*cell + 1);
            diagonal = std::mem::replace(cell, best);
            left = best;
        }
    }
    row.last().copied().unwrap_or_default()
}
