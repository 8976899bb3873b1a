//! The same conversion with a tree of owned values between message and fields, as in bridges
//! without a plan.

use messages::{FieldSink, FieldSupplier, MessagePlan, SourceError, TypeName};
use uadp::{BuiltinType, DateTime, FieldEncoder, NodeId, Scalar};

/// A value with all nested values. Arrays of numbers are one buffer, which favours the tree.
#[derive(Debug, Clone)]
enum Value {
    Number(Number),
    Text(String),
    Bytes(Vec<u8>),
    Packed(BuiltinType, usize, Vec<u8>),
    Array(BuiltinType, Vec<Self>),
    Structures(TypeName, Vec<Vec<Self>>),
}

#[derive(Debug, Clone, Copy)]
enum Number {
    Boolean(bool),
    Byte(u8),
    UInt32(u32),
    Float(f32),
    Double(f64),
    DateTime(DateTime),
}

impl Value {
    fn of(scalar: Scalar<'_>) -> Self {
        Self::Number(match scalar {
            Scalar::String(text) => return Self::Text(text.unwrap_or_default().to_owned()),
            Scalar::ByteString(bytes) => return Self::Bytes(bytes.unwrap_or_default().to_vec()),
            Scalar::Boolean(value) => Number::Boolean(value),
            Scalar::Byte(value) => Number::Byte(value),
            Scalar::UInt32(value) => Number::UInt32(value),
            Scalar::Float(value) => Number::Float(value),
            Scalar::Double(value) => Number::Double(value),
            Scalar::DateTime(value) => Number::DateTime(value),
            other => panic!("no message here has {other:?}"),
        })
    }

    fn scalar(&self) -> Scalar<'_> {
        match self {
            Self::Text(text) => Scalar::String(Some(text)),
            Self::Bytes(bytes) => Scalar::ByteString(Some(bytes)),
            Self::Number(Number::Boolean(value)) => Scalar::Boolean(*value),
            Self::Number(Number::Byte(value)) => Scalar::Byte(*value),
            Self::Number(Number::UInt32(value)) => Scalar::UInt32(*value),
            Self::Number(Number::Float(value)) => Scalar::Float(*value),
            Self::Number(Number::Double(value)) => Scalar::Double(*value),
            Self::Number(Number::DateTime(value)) => Scalar::DateTime(*value),
            other => panic!("{other:?} is no single value"),
        }
    }
}

/// The fields of a message.
#[derive(Debug, Default)]
pub(crate) struct MessageTree {
    fields: Vec<Value>,
    inside: bool,
}

impl MessageTree {
    pub(crate) fn read(plan: &MessagePlan, message: &[u8]) -> Self {
        let mut tree = Self::default();
        plan.read(message, &mut tree).unwrap();
        tree
    }

    pub(crate) fn encode(&self, frame: &mut FieldEncoder<'_>) {
        self.fields.iter().for_each(|field| encode(field, frame));
    }

    pub(crate) fn decode(fields: uadp::Fields<'_>) -> Self {
        let mut tree = Self::default();
        for field in fields {
            tree.fields.push(match field.unwrap() {
                uadp::Variant::Scalar(scalar) => Value::of(scalar),
                uadp::Variant::Array(array) => array_of(array),
                other => panic!("no message here has {other:?}"),
            });
        }
        tree
    }

    pub(crate) fn write(&self, plan: &MessagePlan, out: &mut Vec<u8>) {
        let mut walk = Walk {
            fields: self.fields.iter(),
            elements: [].iter(),
        };
        plan.write(&mut walk, out).unwrap();
    }
}

fn array_of(array: uadp::Array<'_>) -> Value {
    match array.element() {
        BuiltinType::String => {
            Value::Array(BuiltinType::String, array.iter().map(Value::of).collect())
        }
        element => Value::Packed(element, array.len(), array.bytes().to_vec()),
    }
}

fn encode(value: &Value, frame: &mut FieldEncoder<'_>) {
    match value {
        Value::Number(_) | Value::Text(_) | Value::Bytes(_) => {
            frame.scalar(value.scalar()).unwrap()
        }
        Value::Packed(element, count, bytes) => {
            frame.packed_array(*element, *count, bytes).unwrap()
        }
        Value::Array(element, values) => {
            frame.array(*element, values.len()).unwrap();
            for value in values {
                frame.element(value.scalar()).unwrap();
            }
        }
        Value::Structures(of, structures) => {
            frame.structures(structures.len()).unwrap();
            for fields in structures {
                frame
                    .begin_structure(NodeId::string(2, of.as_str()))
                    .unwrap();
                fields.iter().for_each(|field| encode(field, frame));
                frame.end_structure().unwrap();
            }
        }
    }
}

impl MessageTree {
    fn push(&mut self, value: Value) {
        match self.fields.last_mut() {
            Some(Value::Structures(_, structures)) if self.inside => {
                structures.last_mut().unwrap().push(value);
            }
            _ => self.fields.push(value),
        }
    }
}

impl FieldSink for MessageTree {
    type Error = ();

    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), ()> {
        self.push(Value::of(value));
        Ok(())
    }

    fn packed_array(&mut self, element: BuiltinType, count: usize, bytes: &[u8]) -> Result<(), ()> {
        self.push(Value::Packed(element, count, bytes.to_vec()));
        Ok(())
    }

    fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), ()> {
        self.push(Value::Array(element, Vec::with_capacity(count)));
        Ok(())
    }

    fn element(&mut self, value: Scalar<'_>) -> Result<(), ()> {
        if let Some(Value::Array(_, values)) = self.fields.last_mut() {
            values.push(Value::of(value));
        }
        Ok(())
    }

    fn structures(&mut self, of: &TypeName, count: usize) -> Result<(), ()> {
        self.push(Value::Structures(of.clone(), Vec::with_capacity(count)));
        Ok(())
    }

    fn begin_structure(&mut self, _: &TypeName) -> Result<(), ()> {
        if let Some(Value::Structures(_, structures)) = self.fields.last_mut() {
            structures.push(Vec::new());
        }
        self.inside = true;
        Ok(())
    }

    fn end_structure(&mut self) -> Result<(), ()> {
        self.inside = false;
        Ok(())
    }
}

struct Walk<'t> {
    fields: std::slice::Iter<'t, Value>,
    elements: std::slice::Iter<'t, Value>,
}

impl<'t> FieldSupplier<'t> for Walk<'t> {
    fn scalar(&mut self, _: BuiltinType) -> Result<Scalar<'t>, SourceError> {
        self.fields
            .next()
            .map(Value::scalar)
            .ok_or(SourceError::Missing)
    }

    fn packed_array(&mut self, _: BuiltinType) -> Result<(usize, &'t [u8]), SourceError> {
        match self.fields.next() {
            Some(Value::Packed(_, count, bytes)) => Ok((*count, bytes)),
            _ => Err(SourceError::Missing),
        }
    }

    fn array(&mut self, _: BuiltinType) -> Result<usize, SourceError> {
        match self.fields.next() {
            Some(Value::Array(_, values)) => {
                self.elements = values.iter();
                Ok(values.len())
            }
            _ => Err(SourceError::Missing),
        }
    }

    fn element(&mut self, _: BuiltinType) -> Result<Scalar<'t>, SourceError> {
        self.elements
            .next()
            .map(Value::scalar)
            .ok_or(SourceError::Missing)
    }

    fn structures(&mut self) -> Result<usize, SourceError> {
        Err(SourceError::Missing)
    }

    fn begin_structure(&mut self) -> Result<(), SourceError> {
        Err(SourceError::Missing)
    }

    fn end_structure(&mut self) -> Result<(), SourceError> {
        Err(SourceError::Missing)
    }

    fn finish(&mut self) -> Result<(), SourceError> {
        Ok(())
    }
}
