//! Values of parameters and results: the builtin types of OPC UA that skills support.

use std::fmt;

use serde_json::Value as Json;

macro_rules! builtins {
    ($($(#[$doc:meta])* $name:ident = $id:literal,)*) => {
        /// A builtin type (OPC 10000-6, 5.1.2); the numbers are its identifiers in namespace 0.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum Builtin { $($(#[$doc])* $name = $id,)* }

        impl Builtin {
            /// All builtin types, by their numbers.
            pub const ALL: &'static [Self] = &[$(Self::$name),*];

            /// Returns the name, as `Double`.
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self { $(Self::$name => stringify!($name)),* }
            }

            /// Returns the numeric identifier of the data type in namespace 0.
            #[must_use]
            pub const fn id(self) -> u8 {
                match self { $(Self::$name => $id),* }
            }
        }
    };
}

builtins! {
    /// true or false
    Boolean = 1,
    /// 8 bits with a sign
    SByte = 2,
    /// 8 bits
    Byte = 3,
    /// 16 bits with a sign
    Int16 = 4,
    /// 16 bits
    UInt16 = 5,
    /// 32 bits with a sign
    Int32 = 6,
    /// 32 bits
    UInt32 = 7,
    /// 64 bits with a sign
    Int64 = 8,
    /// 64 bits
    UInt64 = 9,
    /// IEEE 754, 32 bits
    Float = 10,
    /// IEEE 754, 64 bits
    Double = 11,
    /// UTF-8
    String = 12,
}

impl Builtin {
    /// Returns the type with this identifier in namespace 0, if it is supported.
    #[must_use]
    pub fn of_id(id: u32) -> Option<Self> {
        Self::ALL
            .iter()
            .copied()
            .find(|builtin| u32::from(builtin.id()) == id)
    }
}

/// The reason why a value does not have an expected shape.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ValueError {
    /// A JSON value is not an array.
    #[error("expected an array of {}", .0.name())]
    NoArray(Builtin),
    /// A JSON value is not in the range of the type.
    #[error("expected {}, found {found}", .expected.name())]
    Json {
        /// The expected type.
        expected: Builtin,
        /// The start of the JSON text.
        found: String,
    },
    /// A value has another shape.
    #[error("expected {expected}, found {found}")]
    Shape {
        /// The expected shape.
        expected: ValueShape,
        /// The shape of the value.
        found: ValueShape,
    },
}

/// A builtin type and its rank: a scalar, or an array of one dimension.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ValueShape {
    /// The type of the value or of each element.
    pub builtin: Builtin,
    /// Whether it is an array.
    pub array: bool,
}

impl ValueShape {
    /// Returns the shape of a scalar.
    #[must_use]
    pub const fn scalar(builtin: Builtin) -> Self {
        Self {
            builtin,
            array: false,
        }
    }

    /// Returns the shape of an array of one dimension.
    #[must_use]
    pub const fn array(builtin: Builtin) -> Self {
        Self {
            builtin,
            array: true,
        }
    }

    /// Reads a JSON value in this shape.
    ///
    /// # Errors
    /// The value has another type. Numbers are never rounded or truncated.
    pub fn read_json(self, json: &Json) -> Result<SkillValue, ValueError> {
        if !self.array {
            return scalar_of_json(self.builtin, json);
        }
        let Json::Array(elements) = json else {
            return Err(ValueError::NoArray(self.builtin));
        };
        let elements = elements
            .iter()
            .map(|element| scalar_of_json(self.builtin, element));
        Ok(SkillValue::Array(
            self.builtin,
            elements.collect::<Result<_, _>>()?,
        ))
    }

    /// Converts a value to this shape if that is possible without loss: the same type, or a number
    /// in a wider type.
    #[must_use]
    pub fn take(self, value: SkillValue) -> Option<SkillValue> {
        if value.shape() == self {
            return Some(value);
        }
        if let SkillValue::Array(_, elements) = value {
            let one = Self::scalar(self.builtin);
            let elements = elements.into_iter().map(|element| one.take(element));
            return match self.array {
                true => Some(SkillValue::Array(
                    self.builtin,
                    elements.collect::<Option<_>>()?,
                )),
                false => None,
            };
        }
        if self.array || matches!(value, SkillValue::String(_) | SkillValue::Boolean(_)) {
            return None;
        }
        scalar_of_json(self.builtin, &value.to_json()).ok()
    }
}

impl fmt::Display for ValueShape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.builtin.name())?;
        f.write_str(if self.array { "[]" } else { "" })
    }
}

/// A value of a builtin type, or an array of such values.
#[derive(Debug, Clone, PartialEq)]
pub enum SkillValue {
    /// true or false
    Boolean(bool),
    /// 8 bits with a sign
    SByte(i8),
    /// 8 bits
    Byte(u8),
    /// 16 bits with a sign
    Int16(i16),
    /// 16 bits
    UInt16(u16),
    /// 32 bits with a sign
    Int32(i32),
    /// 32 bits
    UInt32(u32),
    /// 64 bits with a sign
    Int64(i64),
    /// 64 bits
    UInt64(u64),
    /// IEEE 754, 32 bits
    Float(f32),
    /// IEEE 754, 64 bits
    Double(f64),
    /// UTF-8
    String(String),
    /// An array with elements of this type.
    Array(Builtin, Vec<Self>),
}

impl SkillValue {
    /// Returns the type of the value.
    #[must_use]
    pub fn shape(&self) -> ValueShape {
        let builtin = match self {
            Self::Boolean(_) => Builtin::Boolean,
            Self::SByte(_) => Builtin::SByte,
            Self::Byte(_) => Builtin::Byte,
            Self::Int16(_) => Builtin::Int16,
            Self::UInt16(_) => Builtin::UInt16,
            Self::Int32(_) => Builtin::Int32,
            Self::UInt32(_) => Builtin::UInt32,
            Self::Int64(_) => Builtin::Int64,
            Self::UInt64(_) => Builtin::UInt64,
            Self::Float(_) => Builtin::Float,
            Self::Double(_) => Builtin::Double,
            Self::String(_) => Builtin::String,
            Self::Array(builtin, _) => return ValueShape::array(*builtin),
        };
        ValueShape::scalar(builtin)
    }

    /// Converts the value to JSON. Numbers that JSON does not have are the texts `NaN`, `Infinity`
    /// and `-Infinity` (OPC 10000-6, 5.4.2.4).
    #[must_use]
    pub fn to_json(&self) -> Json {
        match self {
            Self::Boolean(value) => (*value).into(),
            Self::SByte(value) => (*value).into(),
            Self::Byte(value) => (*value).into(),
            Self::Int16(value) => (*value).into(),
            Self::UInt16(value) => (*value).into(),
            Self::Int32(value) => (*value).into(),
            Self::UInt32(value) => (*value).into(),
            Self::Int64(value) => (*value).into(),
            Self::UInt64(value) => (*value).into(),
            Self::Float(value) => real(f64::from(*value)),
            Self::Double(value) => real(*value),
            Self::String(value) => value.clone().into(),
            Self::Array(_, elements) => elements.iter().map(Self::to_json).collect(),
        }
    }

    /// Converts a JSON value: numbers become Doubles, and arrays of numbers arrays of Doubles. A
    /// skill converts them to the declared type. `None` for other values.
    #[must_use]
    pub fn of_json(json: &Json) -> Option<Self> {
        match json {
            Json::Bool(value) => Some(Self::from(*value)),
            Json::Number(number) => number.as_f64().map(Self::from),
            Json::String(text) => Some(Self::from(text.as_str())),
            Json::Array(elements) => {
                let numbers: Option<Vec<f64>> = elements.iter().map(Json::as_f64).collect();
                numbers.map(Self::from)
            }
            Json::Null | Json::Object(_) => None,
        }
    }

    /// Returns a scalar number of any type as Double.
    #[must_use]
    pub fn as_f64(&self) -> Option<f64> {
        match self {
            Self::Boolean(_) | Self::String(_) | Self::Array(..) => None,
            Self::Float(value) => Some(f64::from(*value)),
            Self::Double(value) => Some(*value),
            Self::SByte(_)
            | Self::Byte(_)
            | Self::Int16(_)
            | Self::UInt16(_)
            | Self::Int32(_)
            | Self::UInt32(_)
            | Self::Int64(_)
            | Self::UInt64(_) => self.to_json().as_f64(),
        }
    }

    /// Returns an array of numbers as Double.
    #[must_use]
    pub fn as_f64s(&self) -> Option<Vec<f64>> {
        let Self::Array(_, elements) = self else {
            return None;
        };
        elements.iter().map(Self::as_f64).collect()
    }

    /// Returns a text.
    #[must_use]
    pub fn as_str(&self) -> Option<&str> {
        let Self::String(text) = self else {
            return None;
        };
        Some(text)
    }

    /// Returns a Boolean.
    #[must_use]
    pub fn as_bool(&self) -> Option<bool> {
        let Self::Boolean(value) = self else {
            return None;
        };
        Some(*value)
    }

    /// Returns whether the value contains a number that is NaN or infinite, which must not be sent
    /// to a machine.
    #[must_use]
    pub fn is_unreal(&self) -> bool {
        if let Self::Array(_, elements) = self {
            return elements.iter().any(Self::is_unreal);
        }
        self.as_f64().is_some_and(|value| !value.is_finite())
    }
}

/// Writes the value as JSON.
impl fmt::Display for SkillValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.to_json())
    }
}

macro_rules! from {
    ($($type:ty => $variant:ident),* $(,)?) => {$(
        impl From<$type> for SkillValue {
            fn from(value: $type) -> Self {
                Self::$variant(value.into())
            }
        }
    )*};
}

from! { bool => Boolean, i32 => Int32, u32 => UInt32, f32 => Float, f64 => Double, String => String, &str => String }

impl From<Vec<f64>> for SkillValue {
    fn from(values: Vec<f64>) -> Self {
        Self::Array(
            Builtin::Double,
            values.into_iter().map(Self::Double).collect(),
        )
    }
}

impl From<[f64; 6]> for SkillValue {
    fn from(values: [f64; 6]) -> Self {
        values.to_vec().into()
    }
}

fn real(value: f64) -> Json {
    match serde_json::Number::from_f64(value) {
        Some(number) => Json::Number(number),
        None if value.is_nan() => "NaN".into(),
        None if value > 0.0 => "Infinity".into(),
        None => "-Infinity".into(),
    }
}

fn scalar_of_json(builtin: Builtin, json: &Json) -> Result<SkillValue, ValueError> {
    let whole = json.as_i64();
    let natural = json.as_u64();
    let value = match builtin {
        Builtin::Boolean => json.as_bool().map(SkillValue::Boolean),
        Builtin::SByte => whole.and_then(|n| n.try_into().ok()).map(SkillValue::SByte),
        Builtin::Byte => natural
            .and_then(|n| n.try_into().ok())
            .map(SkillValue::Byte),
        Builtin::Int16 => whole.and_then(|n| n.try_into().ok()).map(SkillValue::Int16),
        Builtin::UInt16 => natural
            .and_then(|n| n.try_into().ok())
            .map(SkillValue::UInt16),
        Builtin::Int32 => whole.and_then(|n| n.try_into().ok()).map(SkillValue::Int32),
        Builtin::UInt32 => natural
            .and_then(|n| n.try_into().ok())
            .map(SkillValue::UInt32),
        Builtin::Int64 => whole.map(SkillValue::Int64),
        Builtin::UInt64 => natural.map(SkillValue::UInt64),
        Builtin::Float => real_of_json(json).and_then(narrow).map(SkillValue::Float),
        Builtin::Double => real_of_json(json).map(SkillValue::Double),
        Builtin::String => json
            .as_str()
            .map(|text| SkillValue::String(text.to_owned())),
    };
    value.ok_or_else(|| ValueError::Json {
        expected: builtin,
        found: shown(json),
    })
}

/// Returns at most 40 characters of a JSON text.
fn shown(json: &Json) -> String {
    let text = json.to_string();
    let mut short: String = text.chars().take(40).collect();
    if short.len() < text.len() {
        short.push_str("...");
    }
    short
}

fn real_of_json(json: &Json) -> Option<f64> {
    match json.as_str() {
        Some("NaN") => Some(f64::NAN),
        Some("Infinity") => Some(f64::INFINITY),
        Some("-Infinity") => Some(f64::NEG_INFINITY),
        Some(_) => None,
        None => json.as_f64(),
    }
}

/// Returns the nearest Float; `None` if it would be infinite.
fn narrow(value: f64) -> Option<f32> {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "rounding to the nearest is what a Float is given for"
    )]
    let narrow = value as f32;
    (narrow.is_finite() || !value.is_finite()).then_some(narrow)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_is_the_same_after_its_way_through_json() {
        let values = [
            SkillValue::from(true),
            SkillValue::SByte(-7),
            SkillValue::UInt64(u64::MAX),
            SkillValue::Int64(i64::MIN),
            SkillValue::Float(0.1),
            SkillValue::from(1.5),
            SkillValue::from("ja \"so\""),
            SkillValue::from([0.1, 0.2, 0.3, 0.0, -1.5, 1e300]),
            SkillValue::Array(Builtin::String, Vec::new()),
            SkillValue::from(f64::INFINITY),
        ];
        for value in values {
            assert_eq!(value.shape().read_json(&value.to_json()), Ok(value));
        }
    }

    #[test]
    fn numbers_that_do_not_fit_are_refused_and_never_cut() {
        let read = |builtin, text: &str| {
            ValueShape::scalar(builtin).read_json(&serde_json::from_str(text).unwrap())
        };
        assert!(read(Builtin::Byte, "256").is_err());
        assert!(read(Builtin::UInt16, "-1").is_err());
        assert!(read(Builtin::Int32, "1.5").is_err());
        assert!(read(Builtin::Float, "1e300").is_err());
        assert_eq!(read(Builtin::Double, "3"), Ok(SkillValue::Double(3.0)));
        assert_eq!(
            read(Builtin::Boolean, "1").unwrap_err().to_string(),
            "expected Boolean, found 1"
        );
    }

    #[test]
    fn a_narrower_number_is_taken_where_a_wider_one_is_wanted() {
        let double = ValueShape::scalar(Builtin::Double);
        assert_eq!(
            double.take(SkillValue::Float(0.5)),
            Some(SkillValue::Double(0.5))
        );
        assert_eq!(double.take(SkillValue::from("0.5")), None);
        assert_eq!(double.take(SkillValue::from(vec![0.5])), None);
        let doubles = ValueShape::array(Builtin::Double);
        let floats = SkillValue::Array(Builtin::Float, vec![SkillValue::Float(0.5)]);
        assert_eq!(doubles.take(floats), Some(SkillValue::from(vec![0.5])));
        assert_eq!(
            ValueShape::scalar(Builtin::Byte).take(SkillValue::Int32(300)),
            None
        );
    }
}
