//! Parameter values, in the format of `rcl_interfaces/msg/ParameterValue`.

use crate::cdr::{CdrReader, CdrWriter, Malformed};

/// The value of a parameter.
#[derive(Debug, Clone, PartialEq, Default)]
#[non_exhaustive]
pub enum ParameterValue {
    /// No value.
    #[default]
    NotSet,
    /// A boolean.
    Bool(bool),
    /// An integer.
    Integer(i64),
    /// A floating-point number.
    Double(f64),
    /// A string.
    String(String),
    /// Bytes.
    ByteArray(Vec<u8>),
    /// Booleans.
    BoolArray(Vec<bool>),
    /// Integers.
    IntegerArray(Vec<i64>),
    /// Floating-point numbers.
    DoubleArray(Vec<f64>),
    /// Strings.
    StringArray(Vec<String>),
}

impl ParameterValue {
    /// Returns the constant of `rcl_interfaces/msg/ParameterType`.
    #[must_use]
    pub const fn kind(&self) -> u8 {
        match self {
            Self::NotSet => 0,
            Self::Bool(_) => 1,
            Self::Integer(_) => 2,
            Self::Double(_) => 3,
            Self::String(_) => 4,
            Self::ByteArray(_) => 5,
            Self::BoolArray(_) => 6,
            Self::IntegerArray(_) => 7,
            Self::DoubleArray(_) => 8,
            Self::StringArray(_) => 9,
        }
    }

    /// Decodes a value. The message contains all fields, of which the kind selects one.
    pub(super) fn read(reader: &mut CdrReader<'_>) -> Result<Self, Malformed> {
        let kind = reader.u8()?;
        let all = [
            Self::NotSet,
            Self::Bool(reader.bool()?),
            Self::Integer(reader.i64()?),
            Self::Double(reader.f64()?),
            Self::String(reader.string()?),
            Self::ByteArray(reader.sequence(CdrReader::u8)?),
            Self::BoolArray(reader.sequence(CdrReader::bool)?),
            Self::IntegerArray(reader.sequence(CdrReader::i64)?),
            Self::DoubleArray(reader.sequence(CdrReader::f64)?),
            Self::StringArray(reader.sequence(CdrReader::string)?),
        ];
        all.into_iter().nth(usize::from(kind)).ok_or(Malformed)
    }

    pub(super) fn write(&self, writer: &mut CdrWriter) {
        writer.u8(self.kind());
        writer.bool(matches!(self, Self::Bool(true)));
        writer.i64(if let Self::Integer(value) = self {
            *value
        } else {
            0
        });
        writer.f64(if let Self::Double(value) = self {
            *value
        } else {
            0.0
        });
        writer.string(if let Self::String(text) = self {
            text
        } else {
            ""
        });
        let bytes = if let Self::ByteArray(all) = self {
            all
        } else {
            &vec![]
        };
        writer.sequence(bytes, |writer, value| writer.u8(*value));
        let bools = if let Self::BoolArray(all) = self {
            all
        } else {
            &vec![]
        };
        writer.sequence(bools, |writer, value| writer.bool(*value));
        let integers = if let Self::IntegerArray(all) = self {
            all
        } else {
            &vec![]
        };
        writer.sequence(integers, |writer, value| writer.i64(*value));
        let doubles = if let Self::DoubleArray(all) = self {
            all
        } else {
            &vec![]
        };
        writer.sequence(doubles, |writer, value| writer.f64(*value));
        let strings = if let Self::StringArray(all) = self {
            all
        } else {
            &vec![]
        };
        writer.sequence(strings, |writer, value| writer.string(value));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_value_is_read_as_written() {
        for (kind, value) in [
            ParameterValue::NotSet,
            ParameterValue::Bool(true),
            ParameterValue::Integer(-7),
            ParameterValue::Double(0.5),
            ParameterValue::String("a".into()),
            ParameterValue::ByteArray(vec![1, 2]),
            ParameterValue::BoolArray(vec![true, false]),
            ParameterValue::IntegerArray(vec![i64::MIN]),
            ParameterValue::DoubleArray(vec![1.0]),
            ParameterValue::StringArray(vec!["a".into(), String::new()]),
        ]
        .into_iter()
        .enumerate()
        {
            assert_eq!(usize::from(value.kind()), kind);
            let mut writer = CdrWriter::new();
            value.write(&mut writer);
            let bytes = writer.finish();
            let mut reader = CdrReader::new(&bytes).unwrap();
            assert_eq!(ParameterValue::read(&mut reader), Ok(value));
        }
    }
}
