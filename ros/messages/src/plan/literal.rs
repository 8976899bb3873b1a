//! Constants of a template: conversion of texts to values of their fields.

use uadp::{BuiltinType, DateTime, Scalar};

use super::PlanStep;
use crate::definition::{ClockType, Constant, Number, Primitive};
use crate::resolve::{MessageShape, ShapeKind};
use crate::{FieldSupplier, MessageType, PlanError, SourceError, TypeName, millis_to_duration};

/// A value as written by users.
///
/// A number is decimal, or hexadecimal after `0x`. A Boolean is `true` or `false`. A duration has
/// its unit: `500ms`, `2s`, `1.5min`, `1h`. The name of a constant of the message, or of an
/// enclosing message, stands for its value.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Literal {
    /// The value of a field that is not an array.
    One(String),
    /// The elements of a field that is an array, including bytes.
    List(Vec<String>),
}

/// Returns the value of a constant as written in a mapping; `None` if it does not fit the type.
#[must_use]
pub fn constant(builtin: BuiltinType, text: &str) -> Option<Scalar<'_>> {
    Some(match builtin {
        BuiltinType::Boolean => Scalar::Boolean(text.parse().ok()?),
        BuiltinType::SByte => Scalar::SByte(text.parse().ok()?),
        BuiltinType::Byte => Scalar::Byte(text.parse().ok()?),
        BuiltinType::Int16 => Scalar::Int16(text.parse().ok()?),
        BuiltinType::UInt16 => Scalar::UInt16(text.parse().ok()?),
        BuiltinType::Int32 => Scalar::Int32(text.parse().ok()?),
        BuiltinType::UInt32 => Scalar::UInt32(text.parse().ok()?),
        BuiltinType::Int64 => Scalar::Int64(text.parse().ok()?),
        BuiltinType::UInt64 => Scalar::UInt64(text.parse().ok()?),
        BuiltinType::Float => Scalar::Float(text.parse().ok()?),
        BuiltinType::Double => Scalar::Double(text.parse().ok()?),
        BuiltinType::String => Scalar::String(Some(text)),
        // The only constant time is 0, the null DateTime.
        BuiltinType::DateTime if text == "0" => Scalar::DateTime(DateTime::default()),
        BuiltinType::DateTime
        | BuiltinType::Guid
        | BuiltinType::ByteString
        | BuiltinType::XmlElement
        | BuiltinType::NodeId
        | BuiltinType::ExpandedNodeId
        | BuiltinType::StatusCode
        | BuiltinType::QualifiedName
        | BuiltinType::LocalizedText
        | BuiltinType::ExtensionObject
        | BuiltinType::DataValue
        | BuiltinType::Variant
        | BuiltinType::DiagnosticInfo => return None,
    })
}

/// A constant and its field.
pub(super) struct GivenConstant<'m> {
    message: &'m TypeName,
    path: &'m str,
    literal: &'m Literal,
    /// The constants that may be named, innermost first.
    names: Vec<&'m Constant>,
}

impl<'m> GivenConstant<'m> {
    pub(super) fn new(message: &'m MessageType, path: &'m str, literal: &'m Literal) -> Self {
        let mut around: Vec<&MessageShape> = vec![&message.shape];
        for part in path.split('.') {
            let inner = around.last().and_then(|shape| {
                let field = shape.fields.iter().find(|field| field.name == part)?;
                match &field.kind {
                    ShapeKind::Message(inner) => Some(&**inner),
                    ShapeKind::Primitive(_) | ShapeKind::Sequence => None,
                }
            });
            around.extend(inner);
        }
        let names = around.iter().rev().flat_map(|shape| &shape.constants);
        Self {
            message: message.name(),
            path,
            literal,
            names: names.collect(),
        }
    }

    pub(super) fn typed(&self, what: &PlanStep) -> Result<Typed, PlanError> {
        match (what, self.literal) {
            (PlanStep::One(primitive), Literal::One(text)) => {
                Ok(Typed::One(self.value(*primitive, text)?))
            }
            (PlanStep::Bytes(_), Literal::List(texts)) => Ok(Typed::One(LiteralValue::Bytes(
                self.packed(Number::UInt8, texts)?,
            ))),
            (PlanStep::Packed(number, _), Literal::List(texts)) => {
                Ok(Typed::Packed(texts.len(), self.packed(*number, texts)?))
            }
            (PlanStep::Many(primitive, _), Literal::List(texts)) => {
                let values = texts.iter().map(|text| self.value(*primitive, text));
                Ok(Typed::Many(values.collect::<Result<_, _>>()?))
            }
            (PlanStep::One(primitive), Literal::List(_)) => {
                Err(self.fault("a list", &self.expected(*primitive)))
            }
            (
                PlanStep::Bytes(_) | PlanStep::Packed(..) | PlanStep::Many(..),
                Literal::One(text),
            ) => Err(self.fault(text, "a list, as [1, 2]")),
            (PlanStep::Messages { .. } | PlanStep::Skip { .. } | PlanStep::Run(..), literal) => {
                let text = match literal {
                    Literal::One(text) => text,
                    Literal::List(_) => "a list",
                };
                Err(self.fault(
                    text,
                    "possible here: [] is the only constant of an array of messages",
                ))
            }
        }
    }

    fn value(&self, primitive: Primitive, text: &str) -> Result<LiteralValue, PlanError> {
        parse(primitive, self.said(primitive, text))
            .ok_or_else(|| self.fault(text, &self.expected(primitive)))
    }

    fn packed(&self, number: Number, texts: &[String]) -> Result<Vec<u8>, PlanError> {
        let primitive = Primitive::Number(number);
        let mut packed = Vec::with_capacity(texts.len() * number.size());
        for text in texts {
            let (_, bytes) = self::number(number, self.said(primitive, text))
                .ok_or_else(|| self.fault(text, &self.expected(primitive)))?;
            packed.extend(bytes);
        }
        Ok(packed)
    }

    /// Returns the text, or the value of the constant that it names.
    fn said<'t>(&'t self, primitive: Primitive, text: &'t str) -> &'t str {
        let named = self.names.iter().find(|constant| {
            let texts = constant.builtin == BuiltinType::String;
            constant.name == text && texts == matches!(primitive, Primitive::Text(_))
        });
        named.map_or(text, |constant| &constant.value)
    }

    /// Returns the expected value with its article.
    fn expected(&self, primitive: Primitive) -> String {
        let told = match primitive {
            Primitive::Number(number) => expected(number).to_owned(),
            Primitive::Clock(ClockType::Time1 | ClockType::Time2) => {
                return "possible here: a time cannot be a constant".to_owned();
            }
            Primitive::Clock(ClockType::Duration1 | ClockType::Duration2) => {
                "a duration with its unit, such as 500ms or 2s".to_owned()
            }
            Primitive::Text(_) => "a text".to_owned(),
        };
        let names = self
            .names
            .iter()
            .filter(|constant| parse(primitive, &constant.value).is_some())
            .filter(|_| matches!(primitive, Primitive::Number(_)))
            .map(|constant| constant.name.as_str());
        let names: Vec<&str> = names.take(TOLD).collect();
        if names.is_empty() {
            told
        } else {
            format!("{told} or one of {}", names.join(", "))
        }
    }

    fn fault(&self, text: &str, expected: &str) -> PlanError {
        PlanError::Constant {
            name: self.message.clone(),
            path: self.path.to_owned(),
            text: short(text),
            expected: expected.to_owned(),
        }
    }
}

/// Returns at most 64 characters of a text; `...` marks a cut.
fn short(text: &str) -> String {
    let mut short: String = text.chars().take(64).collect();
    if short.len() < text.len() {
        short.push_str("...");
    }
    short
}

/// Maximum number of constant names in an error.
const TOLD: usize = 12;

const fn expected(number: Number) -> &'static str {
    match number {
        Number::Bool => "true or false",
        Number::Int8 => "a number from -128 to 127",
        Number::UInt8 => "a number from 0 to 255",
        Number::Int16 => "a number from -32768 to 32767",
        Number::UInt16 => "a number from 0 to 65535",
        Number::Int32 => "a number from -2147483648 to 2147483647",
        Number::UInt32 => "a number from 0 to 4294967295",
        Number::Int64 => "a whole number of 64 bits",
        Number::UInt64 => "a whole number of 64 bits, not negative",
        Number::Float32 => "a number within the range of a float32",
        Number::Float64 => "a number",
    }
}

/// The constant of a field.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Typed {
    One(LiteralValue),
    /// Number of elements, and the elements little endian without gaps.
    Packed(usize, Vec<u8>),
    Many(Vec<LiteralValue>),
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum LiteralValue {
    Fixed(Scalar<'static>),
    Text(String),
    Bytes(Vec<u8>),
}

impl LiteralValue {
    fn scalar(&self) -> Scalar<'_> {
        match self {
            Self::Fixed(scalar) => *scalar,
            Self::Text(text) => Scalar::String(Some(text)),
            Self::Bytes(bytes) => Scalar::ByteString(Some(bytes)),
        }
    }
}

impl Typed {
    pub(super) fn source(&self) -> LiteralSource<'_> {
        LiteralSource {
            typed: self,
            next: 0,
        }
    }
}

/// Supplies a constant like a received value.
pub(super) struct LiteralSource<'t> {
    typed: &'t Typed,
    /// Index of the next element.
    next: usize,
}

impl<'t> FieldSupplier<'t> for LiteralSource<'t> {
    fn scalar(&mut self, _expected: BuiltinType) -> Result<Scalar<'t>, SourceError> {
        match self.typed {
            Typed::One(value) => Ok(value.scalar()),
            Typed::Packed(..) | Typed::Many(_) => Err(SourceError::Missing),
        }
    }

    fn packed_array(&mut self, _expected: BuiltinType) -> Result<(usize, &'t [u8]), SourceError> {
        match self.typed {
            Typed::Packed(count, bytes) => Ok((*count, bytes)),
            Typed::One(_) | Typed::Many(_) => Err(SourceError::Missing),
        }
    }

    fn array(&mut self, _expected: BuiltinType) -> Result<usize, SourceError> {
        match self.typed {
            Typed::Many(values) => Ok(values.len()),
            Typed::One(_) | Typed::Packed(..) => Err(SourceError::Missing),
        }
    }

    fn element(&mut self, _expected: BuiltinType) -> Result<Scalar<'t>, SourceError> {
        let Typed::Many(values) = self.typed else {
            return Err(SourceError::Missing);
        };
        let value = values.get(self.next).ok_or(SourceError::Missing)?;
        self.next += 1;
        Ok(value.scalar())
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

fn parse(primitive: Primitive, text: &str) -> Option<LiteralValue> {
    match primitive {
        Primitive::Number(number) => Some(LiteralValue::Fixed(self::number(number, text)?.0)),
        Primitive::Clock(ClockType::Duration1 | ClockType::Duration2) => {
            Some(LiteralValue::Fixed(Scalar::Double(millis(text)?)))
        }
        Primitive::Clock(ClockType::Time1 | ClockType::Time2) => None,
        Primitive::Text(_) => Some(LiteralValue::Text(text.to_owned())),
    }
}

/// Returns a number and its bytes, little endian.
fn number(number: Number, text: &str) -> Option<(Scalar<'static>, Vec<u8>)> {
    macro_rules! whole {
        ($variant:ident, $type:ty) => {{
            let value = <$type>::try_from(whole(text)?).ok()?;
            Some((Scalar::$variant(value), value.to_le_bytes().to_vec()))
        }};
    }
    match number {
        Number::Bool => {
            let value = match text {
                "true" | "True" | "TRUE" | "1" => true,
                "false" | "False" | "FALSE" | "0" => false,
                _ => return None,
            };
            Some((Scalar::Boolean(value), vec![u8::from(value)]))
        }
        Number::Int8 => whole!(SByte, i8),
        Number::UInt8 => whole!(Byte, u8),
        Number::Int16 => whole!(Int16, i16),
        Number::UInt16 => whole!(UInt16, u16),
        Number::Int32 => whole!(Int32, i32),
        Number::UInt32 => whole!(UInt32, u32),
        Number::Int64 => whole!(Int64, i64),
        Number::UInt64 => whole!(UInt64, u64),
        Number::Float32 => {
            #[expect(
                clippy::cast_possible_truncation,
                reason = "the nearest float32; one beyond its range is infinite and refused"
            )]
            let value = float(text)? as f32;
            let fits = value.is_finite() || !float(text)?.is_finite();
            fits.then(|| (Scalar::Float(value), value.to_le_bytes().to_vec()))
        }
        Number::Float64 => {
            let value = float(text)?;
            Some((Scalar::Double(value), value.to_le_bytes().to_vec()))
        }
    }
}

fn whole(text: &str) -> Option<i128> {
    let (sign, digits) = match text.strip_prefix('-') {
        Some(digits) => (-1, digits),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    let (radix, digits) = match digits.strip_prefix("0x") {
        Some(digits) => (16, digits),
        None => (10, digits),
    };
    let plain = digits.starts_with(|c: char| c.is_ascii_hexdigit());
    let value = i128::from_str_radix(digits, radix).ok();
    Some(sign * value.filter(|_| plain)?)
}

/// Parses a number; a number that overflows to infinity is invalid.
fn float(text: &str) -> Option<f64> {
    match text {
        ".inf" | "inf" | "+.inf" => Some(f64::INFINITY),
        "-.inf" | "-inf" => Some(f64::NEG_INFINITY),
        ".nan" | "nan" => Some(f64::NAN),
        _ => text.parse().ok().filter(|value: &f64| value.is_finite()),
    }
}

/// Parses a duration that fits a ROS duration, in milliseconds.
fn millis(text: &str) -> Option<f64> {
    const UNITS: [(&str, f64); 4] = [("ms", 1.0), ("s", 1e3), ("min", 60e3), ("h", 3600e3)];
    if text == "0" {
        return Some(0.0);
    }
    let (number, unit) = text.split_at_checked(text.find(|c: char| c.is_ascii_alphabetic())?)?;
    let (_, factor) = UNITS.iter().find(|(name, _)| *name == unit)?;
    let millis = float(number)? * factor;
    millis_to_duration(millis).map(|_| millis)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_within_the_range_of_its_field_or_refused() {
        for (kind, good, bad) in [
            (Number::Int8, ["-128", "127"], ["-129", "128"]),
            (Number::UInt8, ["0", "0xff"], ["-1", "256"]),
            (Number::UInt16, ["+7", "65535"], ["65536", "1.0"]),
            (
                Number::Int64,
                ["-9223372036854775808", "9223372036854775807"],
                ["9223372036854775808", "1e3"],
            ),
            (
                Number::UInt64,
                ["0", "18446744073709551615"],
                ["18446744073709551616", "--1"],
            ),
            (Number::Bool, ["true", "False"], ["yes", ""]),
            (Number::Float32, ["1e38", ".inf"], ["1e39", "0x10"]),
            (Number::Float64, ["-1.5e300", ".nan"], ["1e309", "x"]),
        ] {
            for text in good {
                let (scalar, bytes) = number(kind, text).unwrap();
                assert_eq!(scalar.builtin_type(), kind.builtin(), "{text}");
                assert_eq!(bytes.len(), kind.size(), "{text}");
            }
            for text in bad {
                assert_eq!(number(kind, text), None, "{kind:?} {text}");
            }
        }
    }

    #[test]
    fn a_long_text_is_told_with_where_it_was_cut() {
        let long = "ä".repeat(64);
        assert_eq!(short(&long), long);
        assert_eq!(short(&format!("{long}x")), format!("{long}..."));
    }

    #[test]
    fn a_duration_has_its_unit() {
        assert_eq!(millis("500ms"), Some(500.0));
        assert_eq!(millis("1.5s"), Some(1500.0));
        assert_eq!(millis("-2min"), Some(-120_000.0));
        assert_eq!(millis("0"), Some(0.0));
        for text in ["", "5", "5 s", "s", "5d", "1e3s", "596524h", "-596524h"] {
            assert_eq!(millis(text), None, "{text}");
        }
    }
}
