//! A sink that records fields, and a source that replays them.
use std::fmt;

use messages::{FieldSink, FieldSupplier, SourceError, TypeName};
use uadp::{BuiltinType, DateTime, Scalar};

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum RecordedValue {
    /// Numbers and Booleans by their bytes, so that a NaN equals itself.
    Fixed(BuiltinType, Vec<u8>),
    Text(String),
    Bytes(Vec<u8>),
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum RecordedEvent {
    Scalar(RecordedValue),
    Packed(BuiltinType, usize, Vec<u8>),
    Array(BuiltinType, usize),
    Element(RecordedValue),
    Structures(String, usize),
    Begin(String),
    End,
}

impl RecordedValue {
    pub(crate) fn of(scalar: Scalar<'_>) -> Self {
        let builtin = scalar.builtin_type();
        match scalar {
            Scalar::Boolean(v) => Self::Fixed(builtin, vec![u8::from(v)]),
            Scalar::SByte(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::Byte(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::Int16(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::UInt16(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::Int32(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::UInt32(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::Int64(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::UInt64(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::Float(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::Double(v) => Self::Fixed(builtin, v.to_le_bytes().to_vec()),
            Scalar::DateTime(v) => Self::Fixed(builtin, v.0.to_le_bytes().to_vec()),
            Scalar::String(v) => Self::Text(v.unwrap_or_default().to_owned()),
            Scalar::ByteString(v) => Self::Bytes(v.unwrap_or_default().to_vec()),
            other => panic!("{other:?} is no value of a ROS message"),
        }
    }

    pub(crate) fn builtin(&self) -> BuiltinType {
        match self {
            Self::Fixed(builtin, _) => *builtin,
            Self::Text(_) => BuiltinType::String,
            Self::Bytes(_) => BuiltinType::ByteString,
        }
    }

    pub(crate) fn scalar(&self) -> Scalar<'_> {
        match self {
            Self::Text(text) => Scalar::String(Some(text)),
            Self::Bytes(bytes) => Scalar::ByteString(Some(bytes)),
            Self::Fixed(BuiltinType::Boolean, bytes) => Scalar::Boolean(bytes[0] != 0),
            Self::Fixed(BuiltinType::SByte, bytes) => Scalar::SByte(i8::from_le_bytes([bytes[0]])),
            Self::Fixed(BuiltinType::Byte, bytes) => Scalar::Byte(bytes[0]),
            Self::Fixed(BuiltinType::Int16, bytes) => {
                Scalar::Int16(i16::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::UInt16, bytes) => {
                Scalar::UInt16(u16::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::Int32, bytes) => {
                Scalar::Int32(i32::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::UInt32, bytes) => {
                Scalar::UInt32(u32::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::Int64, bytes) => {
                Scalar::Int64(i64::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::UInt64, bytes) => {
                Scalar::UInt64(u64::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::Float, bytes) => {
                Scalar::Float(f32::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::Double, bytes) => {
                Scalar::Double(f64::from_le_bytes(chunk(bytes)))
            }
            Self::Fixed(BuiltinType::DateTime, bytes) => {
                Scalar::DateTime(DateTime(i64::from_le_bytes(chunk(bytes))))
            }
            Self::Fixed(other, _) => panic!("{other:?} is no number"),
        }
    }
}

fn chunk<const N: usize>(bytes: &[u8]) -> [u8; N] {
    bytes.try_into().unwrap()
}

impl fmt::Display for RecordedValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.scalar() {
            Scalar::Boolean(v) => write!(f, "{v}"),
            Scalar::SByte(v) => write!(f, "{v}"),
            Scalar::Byte(v) => write!(f, "{v}"),
            Scalar::Int16(v) => write!(f, "{v}"),
            Scalar::UInt16(v) => write!(f, "{v}"),
            Scalar::Int32(v) => write!(f, "{v}"),
            Scalar::UInt32(v) => write!(f, "{v}"),
            Scalar::Int64(v) => write!(f, "{v}"),
            Scalar::UInt64(v) => write!(f, "{v}"),
            Scalar::Float(v) => write!(f, "{v:?}"),
            Scalar::Double(v) => write!(f, "{v:?}"),
            Scalar::DateTime(v) => write!(f, "{}", v.0),
            Scalar::String(v) => f.write_str(v.unwrap_or_default()),
            Scalar::ByteString(v) => v
                .unwrap_or_default()
                .iter()
                .try_for_each(|byte| write!(f, "{byte:02x}")),
            other => panic!("{other:?} is no value of a ROS message"),
        }
    }
}

impl fmt::Display for RecordedEvent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scalar(value) => write!(f, "scalar {} {value}", value.builtin().name()),
            Self::Element(value) => write!(f, "element {} {value}", value.builtin().name()),
            Self::Array(builtin, count) => write!(f, "array {} {count}", builtin.name()),
            Self::Packed(builtin, count, bytes) => {
                write!(f, "packed {} {count}", builtin.name())?;
                let size = builtin.fixed_size().unwrap();
                assert_eq!(bytes.len(), count * size);
                bytes.chunks(size).try_for_each(|each| {
                    write!(f, " {}", RecordedValue::Fixed(*builtin, each.to_vec()))
                })
            }
            Self::Structures(of, count) => write!(f, "structures {of} {count}"),
            Self::Begin(of) => write!(f, "begin {of}"),
            Self::End => f.write_str("end"),
        }
    }
}

#[derive(Default)]
pub(crate) struct Recorder {
    pub(crate) events: Vec<RecordedEvent>,
}

impl Recorder {
    fn push(&mut self, event: RecordedEvent) -> Result<(), ()> {
        self.events.push(event);
        Ok(())
    }
}

impl FieldSink for Recorder {
    type Error = ();

    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), ()> {
        self.push(RecordedEvent::Scalar(RecordedValue::of(value)))
    }
    fn packed_array(&mut self, element: BuiltinType, count: usize, bytes: &[u8]) -> Result<(), ()> {
        self.push(RecordedEvent::Packed(element, count, bytes.to_vec()))
    }
    fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), ()> {
        self.push(RecordedEvent::Array(element, count))
    }
    fn element(&mut self, value: Scalar<'_>) -> Result<(), ()> {
        self.push(RecordedEvent::Element(RecordedValue::of(value)))
    }
    fn structures(&mut self, of: &TypeName, count: usize) -> Result<(), ()> {
        self.push(RecordedEvent::Structures(of.to_string(), count))
    }
    fn begin_structure(&mut self, of: &TypeName) -> Result<(), ()> {
        self.push(RecordedEvent::Begin(of.to_string()))
    }
    fn end_structure(&mut self) -> Result<(), ()> {
        self.push(RecordedEvent::End)
    }
}

/// Replays recorded events.
pub(crate) struct EventPlayer<'e>(pub(crate) std::slice::Iter<'e, RecordedEvent>);

impl<'e> EventPlayer<'e> {
    pub(crate) fn new(events: &'e [RecordedEvent]) -> Self {
        Self(events.iter())
    }

    fn wrong(found: Option<&RecordedEvent>) -> SourceError {
        found.map_or(SourceError::Missing, |event| {
            SourceError::Malformed(format!("found {event}"))
        })
    }
}

impl<'e> FieldSupplier<'e> for EventPlayer<'e> {
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'e>, SourceError> {
        match self.0.next() {
            Some(RecordedEvent::Scalar(value)) if value.builtin() == expected => Ok(value.scalar()),
            other => Err(Self::wrong(other)),
        }
    }
    fn packed_array(&mut self, expected: BuiltinType) -> Result<(usize, &'e [u8]), SourceError> {
        match self.0.next() {
            Some(RecordedEvent::Packed(builtin, count, bytes)) if *builtin == expected => {
                Ok((*count, bytes))
            }
            other => Err(Self::wrong(other)),
        }
    }
    fn array(&mut self, expected: BuiltinType) -> Result<usize, SourceError> {
        match self.0.next() {
            Some(RecordedEvent::Array(builtin, count)) if *builtin == expected => Ok(*count),
            other => Err(Self::wrong(other)),
        }
    }
    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'e>, SourceError> {
        match self.0.next() {
            Some(RecordedEvent::Element(value)) if value.builtin() == expected => {
                Ok(value.scalar())
            }
            other => Err(Self::wrong(other)),
        }
    }
    fn structures(&mut self) -> Result<usize, SourceError> {
        match self.0.next() {
            Some(RecordedEvent::Structures(_, count)) => Ok(*count),
            other => Err(Self::wrong(other)),
        }
    }
    fn structure(&mut self) -> Result<(), SourceError> {
        self.begin_structure()
    }
    fn begin_structure(&mut self) -> Result<(), SourceError> {
        match self.0.next() {
            Some(RecordedEvent::Begin(_)) => Ok(()),
            other => Err(Self::wrong(other)),
        }
    }
    fn end_structure(&mut self) -> Result<(), SourceError> {
        match self.0.next() {
            Some(RecordedEvent::End) => Ok(()),
            other => Err(Self::wrong(other)),
        }
    }
    fn finish(&mut self) -> Result<(), SourceError> {
        match self.0.len() {
            0 => Ok(()),
            left => Err(SourceError::LeftOver(left)),
        }
    }
}
