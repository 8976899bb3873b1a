//! The parser of `.msg` texts: genmsg's rules for ROS 1, rosidl's for ROS 2.

use std::collections::BTreeSet;

use uadp::BuiltinType;

use crate::name::is_identifier;
use crate::{DefinitionError, Dialect, TypeName};

/// Maximum number of fields of a message.
pub(crate) const MOST_FIELDS: usize = 4096;

/// A type that is not a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Primitive {
    Number(Number),
    Clock(ClockType),
    Text(StringType),
}

/// A type with the same bytes, little endian, as its OPC UA value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Number {
    Bool,
    Int8,
    UInt8,
    Int16,
    UInt16,
    Int32,
    UInt32,
    Int64,
    UInt64,
    Float32,
    Float64,
}

/// Two words of 32 bits: seconds and nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ClockType {
    /// ROS 1 `time`: unsigned seconds.
    Time1,
    /// `builtin_interfaces/Time`: signed seconds.
    Time2,
    /// ROS 1 `duration`: signed nanoseconds.
    Duration1,
    /// `builtin_interfaces/Duration`: unsigned nanoseconds.
    Duration2,
}

/// `string`, or `wstring` if `wide`; the bound is in bytes or UTF-16 units.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StringType {
    pub(crate) wide: bool,
    pub(crate) bound: u32,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum FieldType {
    Primitive(Primitive),
    Message(TypeName),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Arity {
    One,
    Fixed(u32),
    Sequence { bound: Option<u32> },
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct FieldDefinition {
    pub(crate) name: String,
    /// The type as written, which is input of the md5.
    pub(crate) written: String,
    pub(crate) kind: FieldType,
    pub(crate) arity: Arity,
}

impl FieldDefinition {
    /// Returns the type in the notation of `.msg` files, with the package: `package/Name`.
    pub(crate) fn spelling(&self) -> String {
        let bounded = |word: &str, bound: u32| match bound {
            u32::MAX => word.to_owned(),
            bound => format!("{word}<={bound}"),
        };
        let base = match &self.kind {
            FieldType::Message(name) => name.to_string(),
            FieldType::Primitive(Primitive::Text(text)) if text.wide => {
                bounded("wstring", text.bound)
            }
            FieldType::Primitive(Primitive::Text(text)) => bounded("string", text.bound),
            FieldType::Primitive(Primitive::Number(_) | Primitive::Clock(_)) => {
                let written = self.written.split('[').next().unwrap_or_default();
                written.to_owned()
            }
        };
        match self.arity {
            Arity::One => base,
            Arity::Fixed(length) => format!("{base}[{length}]"),
            Arity::Sequence { bound: None } => format!("{base}[]"),
            Arity::Sequence { bound: Some(bound) } => format!("{base}[<={bound}]"),
        }
    }
}

/// A constant of a message type: `uint8 RED=1`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Constant {
    /// The name, such as `RED`.
    pub name: String,
    /// The type of the value.
    pub builtin: BuiltinType,
    /// The value as in the definition; a ROS 2 text is without its quotes.
    pub value: String,
    /// The line that is input of the md5.
    pub(crate) line: String,
}

#[derive(Clone, Debug)]
pub(crate) struct MessageDefinition {
    pub(crate) name: TypeName,
    pub(crate) text: String,
    pub(crate) constants: Vec<Constant>,
    pub(crate) fields: Vec<FieldDefinition>,
}

/// A line of a definition in another language: the type in the notation of `.msg` files, and the
/// value if it is a constant.
#[derive(Clone, Debug)]
pub(crate) struct DefinitionLine {
    /// Line number in its text, from 1.
    pub(crate) number: usize,
    pub(crate) written: String,
    pub(crate) name: String,
    pub(crate) value: Option<String>,
}

impl DefinitionLine {
    fn text(&self) -> String {
        match &self.value {
            None => format!("{} {}", self.written, self.name),
            Some(value) => format!("{} {}={value}", self.written, self.name),
        }
    }
}

impl MessageDefinition {
    /// Creates a definition from the constants and fields of a text in another language. The text
    /// of the definition is that of the equivalent `.msg` file.
    pub(crate) fn of_lines(
        dialect: Dialect,
        name: &TypeName,
        constants: Vec<DefinitionLine>,
        fields: Vec<DefinitionLine>,
    ) -> Result<Self, DefinitionError> {
        let mut named = BTreeSet::new();
        let mut made = Self {
            name: name.clone(),
            text: String::new(),
            constants: Vec::new(),
            fields: Vec::new(),
        };
        for line in constants.into_iter().chain(fields) {
            let DefinitionLine {
                number,
                written,
                name: of,
                value,
            } = &line;
            let added = match value {
                None => made.field(dialect, (written, of), &mut named),
                Some(value) => made.constant(dialect, value, (written, of, value)),
            };
            let text = line.text();
            added.map_err(|reason| DefinitionError::Syntax {
                name: name.clone(),
                line: *number,
                reason,
                text: text.chars().take(200).collect(),
            })?;
            made.text.push_str(&text);
            made.text.push('\n');
        }
        Ok(made)
    }

    pub(crate) fn parse(
        dialect: Dialect,
        name: &TypeName,
        text: &str,
    ) -> Result<Self, DefinitionError> {
        let mut named = BTreeSet::new();
        let mut parsed = Self {
            name: name.clone(),
            text: text.to_owned(),
            constants: Vec::new(),
            fields: Vec::new(),
        };
        for (number, line) in text.lines().enumerate() {
            parsed
                .line(dialect, line, &mut named)
                .map_err(|reason| DefinitionError::Syntax {
                    name: name.clone(),
                    line: number + 1,
                    reason,
                    text: line.trim().chars().take(200).collect(),
                })?;
        }
        Ok(parsed)
    }

    /// Parses a line. `named`: the names of the previous fields.
    fn line(
        &mut self,
        dialect: Dialect,
        line: &str,
        named: &mut BTreeSet<String>,
    ) -> Result<(), &'static str> {
        let clean = without_comment(dialect, line);
        if clean.is_empty() {
            return Ok(());
        }
        let (written, rest) = clean
            .split_once(char::is_whitespace)
            .ok_or("expected a type and a name")?;
        let rest = rest.trim_start();
        // rosidl treats `char` of `.msg` as `uint8`, and the `char` of IDL as a type of its own.
        let byte = written
            .strip_prefix("char")
            .filter(|arity| {
                dialect == Dialect::Ros2 && (arity.is_empty() || arity.starts_with('['))
            })
            .map(|arity| format!("uint8{arity}"));
        let written = byte.as_deref().unwrap_or(written);
        match rest.split_once('=') {
            Some((name, value)) if is_identifier(name.trim_end()) => {
                self.constant(dialect, line, (written, name.trim_end(), value.trim()))
            }
            _ => self.field(dialect, (written, rest), named),
        }
    }

    fn constant(
        &mut self,
        dialect: Dialect,
        line: &str,
        (written, name, value): (&str, &str, &str),
    ) -> Result<(), &'static str> {
        let (kind, arity) = parse_type(dialect, &self.name, written)?;
        let FieldType::Primitive(primitive) = kind else {
            return Err("a constant needs a primitive type");
        };
        if arity != Arity::One {
            return Err("a constant cannot be an array");
        }
        // genmsg uses the whole line after the first `=`, including a `#`, as the text of a string.
        let value = match (dialect, primitive) {
            (Dialect::Ros1, Primitive::Text(_)) => line
                .split_once('=')
                .map_or(value, |(_, value)| value.trim()),
            _ => value,
        };
        if value.is_empty() && !matches!(primitive, Primitive::Text(_)) {
            return Err("a value expected");
        }
        let quoted = ['"', '\'']
            .into_iter()
            .filter(|_| dialect == Dialect::Ros2 && matches!(primitive, Primitive::Text(_)))
            .find_map(|quote| value.strip_prefix(quote)?.strip_suffix(quote));
        self.constants.push(Constant {
            name: name.to_owned(),
            builtin: primitive.builtin(),
            value: quoted.unwrap_or(value).to_owned(),
            line: format!("{written} {name}={value}"),
        });
        Ok(())
    }

    fn field(
        &mut self,
        dialect: Dialect,
        (written, rest): (&str, &str),
        named: &mut BTreeSet<String>,
    ) -> Result<(), &'static str> {
        let (name, default) = rest.split_once(char::is_whitespace).unwrap_or((rest, ""));
        if !is_identifier(name) {
            return Err("expected a field name: letters, digits and `_`, beginning with a letter");
        }
        if !default.is_empty() && dialect == Dialect::Ros1 {
            return Err("ROS 1 fields have no default value");
        }
        if self.fields.len() >= MOST_FIELDS {
            return Err("more than 4096 fields");
        }
        if !named.insert(name.to_owned()) {
            return Err("the field is defined twice");
        }
        let (kind, arity) = parse_type(dialect, &self.name, written)?;
        self.fields.push(FieldDefinition {
            name: name.to_owned(),
            written: written.to_owned(),
            kind,
            arity,
        });
        Ok(())
    }
}

/// Returns the line without its comment and outer blanks. In ROS 2 a `#` within quotes of a default
/// value does not start a comment.
fn without_comment(dialect: Dialect, line: &str) -> &str {
    let mut quote = None;
    for (at, c) in line.char_indices() {
        match (quote, c) {
            (None, '#') => return line.get(..at).unwrap_or_default().trim(),
            (None, '"' | '\'') if dialect == Dialect::Ros2 => quote = Some(c),
            (Some(open), c) if open == c => quote = None,
            _ => {}
        }
    }
    // An apostrophe in a comment opens no quote, because the comment was found first. An unclosed
    // quote is text.
    line.trim()
}

fn parse_type(
    dialect: Dialect,
    of: &TypeName,
    written: &str,
) -> Result<(FieldType, Arity), &'static str> {
    let (base, arity) = match written.strip_suffix(']') {
        None => (written, Arity::One),
        Some(inner) => {
            let (base, length) = inner.rsplit_once('[').ok_or("`[` expected")?;
            (base, parse_arity(dialect, length)?)
        }
    };
    let (base, bound) = match base.split_once("<=") {
        None => (base, None),
        Some((base, bound)) if dialect == Dialect::Ros2 => (base, Some(parse_length(bound)?)),
        Some(_) => return Err("only ROS 2 has bounded types"),
    };
    let kind = match primitive(dialect, base, bound) {
        Some(primitive) => FieldType::Primitive(primitive),
        None => FieldType::Message(message_name(dialect, of, base)?),
    };
    if bound.is_some() && !matches!(kind, FieldType::Primitive(Primitive::Text(_))) {
        return Err("only strings can have a bound");
    }
    Ok((kind, arity))
}

fn parse_arity(dialect: Dialect, length: &str) -> Result<Arity, &'static str> {
    if length.is_empty() {
        return Ok(Arity::Sequence { bound: None });
    }
    match length.strip_prefix("<=") {
        Some(bound) if dialect == Dialect::Ros2 => Ok(Arity::Sequence {
            bound: Some(parse_length(bound)?),
        }),
        Some(_) => Err("only ROS 2 has bounded arrays"),
        None => Ok(Arity::Fixed(parse_length(length)?)),
    }
}

fn parse_length(text: &str) -> Result<u32, &'static str> {
    let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
    text.parse()
        .ok()
        .filter(|_| digits)
        .ok_or("expected a length of at most 4294967295")
}

fn primitive(dialect: Dialect, base: &str, bound: Option<u32>) -> Option<Primitive> {
    let ros1 = dialect == Dialect::Ros1;
    Some(match base {
        "bool" => Primitive::Number(Number::Bool),
        "int8" => Primitive::Number(Number::Int8),
        "byte" if ros1 => Primitive::Number(Number::Int8),
        "uint8" | "char" | "byte" => Primitive::Number(Number::UInt8),
        "int16" => Primitive::Number(Number::Int16),
        "uint16" => Primitive::Number(Number::UInt16),
        "int32" => Primitive::Number(Number::Int32),
        "uint32" => Primitive::Number(Number::UInt32),
        "int64" => Primitive::Number(Number::Int64),
        "uint64" => Primitive::Number(Number::UInt64),
        "float32" => Primitive::Number(Number::Float32),
        "float64" => Primitive::Number(Number::Float64),
        "string" => Primitive::Text(StringType {
            wide: false,
            bound: bound.unwrap_or(u32::MAX),
        }),
        "wstring" if !ros1 => Primitive::Text(StringType {
            wide: true,
            bound: bound.unwrap_or(u32::MAX),
        }),
        "time" if ros1 => Primitive::Clock(ClockType::Time1),
        "duration" if ros1 => Primitive::Clock(ClockType::Duration1),
        _ => return None,
    })
}

fn message_name(dialect: Dialect, of: &TypeName, base: &str) -> Result<TypeName, &'static str> {
    let bad = |_| "expected a type: a primitive, `Name` or `package/Name`";
    if base.contains('/') {
        return base.parse().map_err(bad);
    }
    let package = if dialect == Dialect::Ros1 && base == "Header" {
        "std_msgs"
    } else {
        of.package()
    };
    TypeName::new(package, base).map_err(bad)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(dialect: Dialect, text: &str) -> Result<MessageDefinition, DefinitionError> {
        MessageDefinition::parse(dialect, &"pkg/T".parse().unwrap(), text)
    }

    fn fields(dialect: Dialect, text: &str) -> Vec<(String, FieldType, Arity)> {
        parse(dialect, text)
            .unwrap()
            .fields
            .into_iter()
            .map(|field| (field.name, field.kind, field.arity))
            .collect()
    }

    fn message(name: &str) -> FieldType {
        FieldType::Message(name.parse().unwrap())
    }

    #[test]
    fn ros_1_texts_follow_genmsg() {
        let text = "# only a comment\n\nHeader header # trailing\r\nbyte[3] b\nchar c\ntime t\nPeer[] peers\nother/msg/Thing thing\n";
        assert_eq!(
            fields(Dialect::Ros1, text),
            [
                ("header".to_owned(), message("std_msgs/Header"), Arity::One),
                (
                    "b".to_owned(),
                    FieldType::Primitive(Primitive::Number(Number::Int8)),
                    Arity::Fixed(3)
                ),
                (
                    "c".to_owned(),
                    FieldType::Primitive(Primitive::Number(Number::UInt8)),
                    Arity::One
                ),
                (
                    "t".to_owned(),
                    FieldType::Primitive(Primitive::Clock(ClockType::Time1)),
                    Arity::One
                ),
                (
                    "peers".to_owned(),
                    message("pkg/Peer"),
                    Arity::Sequence { bound: None }
                ),
                ("thing".to_owned(), message("other/Thing"), Arity::One),
            ]
        );
    }

    #[test]
    fn ros_2_texts_follow_rosidl() {
        let text = "string<=10 name 'a # b' # c\nint32[<=5] few [1, 2]\nwstring<=3[<=2] wide\nHeader header\nbyte b 7\nint32 X = -1\nstring S=\"x=y\"\n";
        assert_eq!(
            fields(Dialect::Ros2, text),
            [
                (
                    "name".to_owned(),
                    FieldType::Primitive(Primitive::Text(StringType {
                        wide: false,
                        bound: 10
                    })),
                    Arity::One
                ),
                (
                    "few".to_owned(),
                    FieldType::Primitive(Primitive::Number(Number::Int32)),
                    Arity::Sequence { bound: Some(5) }
                ),
                (
                    "wide".to_owned(),
                    FieldType::Primitive(Primitive::Text(StringType {
                        wide: true,
                        bound: 3
                    })),
                    Arity::Sequence { bound: Some(2) }
                ),
                ("header".to_owned(), message("pkg/Header"), Arity::One),
                (
                    "b".to_owned(),
                    FieldType::Primitive(Primitive::Number(Number::UInt8)),
                    Arity::One
                ),
            ]
        );
    }

    #[test]
    fn a_ros_1_string_constant_keeps_its_hash() {
        let parsed = parse(
            Dialect::Ros1,
            "string S = it's # all = text \nuint8 A=1 # one\nfloat32 F=-1.5e3",
        )
        .unwrap();
        let lines: Vec<_> = parsed
            .constants
            .iter()
            .map(|constant| constant.line.as_str())
            .collect();
        assert_eq!(
            lines,
            [
                "string S=it's # all = text",
                "uint8 A=1",
                "float32 F=-1.5e3"
            ]
        );
    }

    #[test]
    fn a_line_that_does_not_parse_is_named_with_its_number() {
        for (dialect, line, reason) in [
            (Dialect::Ros1, "int32", "expected a type and a name"),
            (
                Dialect::Ros1,
                "int32 9lives",
                "expected a field name: letters, digits and `_`, beginning with a letter",
            ),
            (
                Dialect::Ros1,
                "int32 x 5",
                "ROS 1 fields have no default value",
            ),
            (Dialect::Ros1, "string<=4 x", "only ROS 2 has bounded types"),
            (
                Dialect::Ros1,
                "int8[<=4] x",
                "only ROS 2 has bounded arrays",
            ),
            (
                Dialect::Ros1,
                "int32[99999999999999999999999] x",
                "expected a length of at most 4294967295",
            ),
            (
                Dialect::Ros1,
                "int32[-1] x",
                "expected a length of at most 4294967295",
            ),
            (
                Dialect::Ros1,
                "int32[+1] x",
                "expected a length of at most 4294967295",
            ),
            (Dialect::Ros1, "int32] x", "`[` expected"),
            (
                Dialect::Ros1,
                "a/b/c x",
                "expected a type: a primitive, `Name` or `package/Name`",
            ),
            (
                Dialect::Ros1,
                "Thing X=1",
                "a constant needs a primitive type",
            ),
            (Dialect::Ros1, "int8[] X=1", "a constant cannot be an array"),
            (Dialect::Ros1, "int8 X=", "a value expected"),
            (Dialect::Ros2, "int32<=4 x", "only strings can have a bound"),
        ] {
            let text = format!("bool first\n{line}\n");
            let wanted = DefinitionError::Syntax {
                name: "pkg/T".parse().unwrap(),
                line: 2,
                reason,
                text: line.to_owned(),
            };
            assert_eq!(parse(dialect, &text).unwrap_err(), wanted, "{line}");
        }
        assert!(
            parse(Dialect::Ros1, "int8 x\nint8 x")
                .unwrap_err()
                .to_string()
                .contains("defined twice")
        );
    }
}
