//! A single value of a builtin type.

use crate::nested::{self, DataValue, Depth, DiagnosticInfo, Nested};
use crate::node_id::{ExpandedNodeId, NodeId};
use crate::reader::ByteReader;
use crate::{BuiltinType, DateTime, DecodeError, EncodeError, Guid, StatusCode, Variant, writer};
use alloc::vec::Vec;

/// A single value, borrowed from its datagram.
///
/// `None` is the null String, ByteString or XmlElement, which differs from the empty value.
/// Equality compares values, so a NaN is not equal to itself.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(missing_docs, reason = "the names are those of the builtin types")]
pub enum Scalar<'a> {
    Boolean(bool),
    SByte(i8),
    Byte(u8),
    Int16(i16),
    UInt16(u16),
    Int32(i32),
    UInt32(u32),
    Int64(i64),
    UInt64(u64),
    Float(f32),
    Double(f64),
    String(Option<&'a str>),
    DateTime(DateTime),
    Guid(Guid),
    ByteString(Option<&'a [u8]>),
    XmlElement(Option<&'a str>),
    NodeId(NodeId<'a>),
    ExpandedNodeId(ExpandedNodeId<'a>),
    StatusCode(StatusCode),
    QualifiedName(QualifiedName<'a>),
    LocalizedText(LocalizedText<'a>),
    ExtensionObject(ExtensionObject<'a>),
    DataValue(Nested<'a, DataValue<'a>>),
    /// Only as an element of an array: a Variant does not contain a Variant directly (OPC 10000-6,
    /// 5.2.2.16).
    Variant(Nested<'a, Variant<'a>>),
    DiagnosticInfo(Nested<'a, DiagnosticInfo<'a>>),
}

/// QualifiedName (OPC 10000-6, 5.2.2.13).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct QualifiedName<'a> {
    /// Index into the sender's namespace array.
    pub namespace: u16,
    /// The name; `None` is null.
    pub name: Option<&'a str>,
}

/// LocalizedText (OPC 10000-6, 5.2.2.14). Omitted and null parts are decoded as `None`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct LocalizedText<'a> {
    /// Language tag such as `en-US`.
    pub locale: Option<&'a str>,
    /// The text.
    pub text: Option<&'a str>,
}

/// ExtensionObject (OPC 10000-6, 5.2.2.15): a structure that this crate does not decode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ExtensionObject<'a> {
    /// NodeId of the encoding of the structure's type, not of the type.
    pub type_id: NodeId<'a>,
    /// The encoded structure.
    pub body: ExtensionBody<'a>,
}

/// Body of an [`ExtensionObject`]. A null body with an encoding is decoded as an empty body.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ExtensionBody<'a> {
    /// Encoding 0.
    None,
    /// Encoding 1: the fields in OPC UA binary.
    Binary(&'a [u8]),
    /// Encoding 2: an XML document.
    Xml(&'a str),
}

impl<'a> Scalar<'a> {
    /// Returns the type of the value.
    #[inline]
    #[must_use]
    pub const fn builtin_type(&self) -> BuiltinType {
        match self {
            Self::Boolean(_) => BuiltinType::Boolean,
            Self::SByte(_) => BuiltinType::SByte,
            Self::Byte(_) => BuiltinType::Byte,
            Self::Int16(_) => BuiltinType::Int16,
            Self::UInt16(_) => BuiltinType::UInt16,
            Self::Int32(_) => BuiltinType::Int32,
            Self::UInt32(_) => BuiltinType::UInt32,
            Self::Int64(_) => BuiltinType::Int64,
            Self::UInt64(_) => BuiltinType::UInt64,
            Self::Float(_) => BuiltinType::Float,
            Self::Double(_) => BuiltinType::Double,
            Self::String(_) => BuiltinType::String,
            Self::DateTime(_) => BuiltinType::DateTime,
            Self::Guid(_) => BuiltinType::Guid,
            Self::ByteString(_) => BuiltinType::ByteString,
            Self::XmlElement(_) => BuiltinType::XmlElement,
            Self::NodeId(_) => BuiltinType::NodeId,
            Self::ExpandedNodeId(_) => BuiltinType::ExpandedNodeId,
            Self::StatusCode(_) => BuiltinType::StatusCode,
            Self::QualifiedName(_) => BuiltinType::QualifiedName,
            Self::LocalizedText(_) => BuiltinType::LocalizedText,
            Self::ExtensionObject(_) => BuiltinType::ExtensionObject,
            Self::DataValue(_) => BuiltinType::DataValue,
            Self::Variant(_) => BuiltinType::Variant,
            Self::DiagnosticInfo(_) => BuiltinType::DiagnosticInfo,
        }
    }

    /// Decodes a value in the binary encoding of OPC 10000-6, 5.2.2.
    #[inline]
    pub(crate) fn read(
        builtin: BuiltinType,
        reader: &mut ByteReader<'a>,
    ) -> Result<Self, DecodeError> {
        Self::read_at(builtin, reader, Depth::FULL)
    }

    /// Decodes a nested value as [`read`](Self::read).
    #[inline]
    pub(crate) fn read_at(
        builtin: BuiltinType,
        reader: &mut ByteReader<'a>,
        depth: Depth,
    ) -> Result<Self, DecodeError> {
        Ok(match builtin {
            // The standard defines every byte except 0 as true (OPC 10000-6, 5.2.2.1).
            BuiltinType::Boolean => Self::Boolean(reader.u8("Boolean")? != 0),
            BuiltinType::SByte => Self::SByte(i8::from_le_bytes(reader.array("SByte")?)),
            BuiltinType::Byte => Self::Byte(reader.u8("Byte")?),
            BuiltinType::Int16 => Self::Int16(i16::from_le_bytes(reader.array("Int16")?)),
            BuiltinType::UInt16 => Self::UInt16(reader.u16("UInt16")?),
            BuiltinType::Int32 => Self::Int32(reader.i32("Int32")?),
            BuiltinType::UInt32 => Self::UInt32(reader.u32("UInt32")?),
            BuiltinType::Int64 => Self::Int64(reader.i64("Int64")?),
            BuiltinType::UInt64 => Self::UInt64(u64::from_le_bytes(reader.array("UInt64")?)),
            BuiltinType::Float => Self::Float(f32::from_le_bytes(reader.array("Float")?)),
            BuiltinType::Double => Self::Double(f64::from_le_bytes(reader.array("Double")?)),
            BuiltinType::DateTime => Self::DateTime(DateTime(reader.i64("DateTime")?)),
            BuiltinType::Guid => Self::Guid(Guid(reader.array("Guid")?)),
            BuiltinType::StatusCode => Self::StatusCode(StatusCode(reader.u32("StatusCode")?)),
            BuiltinType::String => Self::String(reader.text("String")?),
            BuiltinType::ByteString => Self::ByteString(reader.byte_string("ByteString")?),
            BuiltinType::XmlElement => Self::XmlElement(reader.text("XmlElement")?),
            BuiltinType::NodeId => Self::NodeId(NodeId::read(reader)?),
            BuiltinType::ExpandedNodeId => Self::ExpandedNodeId(ExpandedNodeId::read(reader)?),
            BuiltinType::QualifiedName => Self::QualifiedName(QualifiedName::read(reader)?),
            BuiltinType::LocalizedText => Self::LocalizedText(LocalizedText::read(reader)?),
            BuiltinType::ExtensionObject => Self::ExtensionObject(ExtensionObject::read(reader)?),
            BuiltinType::DataValue => Self::DataValue(Nested::read(reader, depth.inner()?)?),
            BuiltinType::Variant => Self::Variant(Nested::read(reader, depth.inner()?)?),
            BuiltinType::DiagnosticInfo => {
                Self::DiagnosticInfo(Nested::read(reader, depth.inner()?)?)
            }
        })
    }

    /// Skips and checks `count` values.
    pub(crate) fn skip(
        builtin: BuiltinType,
        count: usize,
        reader: &mut ByteReader<'a>,
        depth: Depth,
    ) -> Result<(), DecodeError> {
        if builtin == BuiltinType::Variant {
            return nested::skip::<Variant<'_>>(count, reader, depth);
        }
        if builtin == BuiltinType::DataValue {
            return nested::skip::<DataValue<'_>>(count, reader, depth);
        }
        if builtin == BuiltinType::DiagnosticInfo {
            return nested::skip::<DiagnosticInfo<'_>>(count, reader, depth);
        }
        for _ in 0..count {
            Self::read_at(builtin, reader, depth)?;
        }
        Ok(())
    }

    /// Appends the value in the binary encoding, after the encoding byte of a Variant if `TAGGED`.
    #[inline]
    pub(crate) fn write<const TAGGED: bool>(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let builtin = self.builtin_type();
        match *self {
            Self::Boolean(v) => writer::fixed::<TAGGED, 1>(out, builtin, [u8::from(v)]),
            Self::SByte(v) => writer::fixed::<TAGGED, 1>(out, builtin, v.to_le_bytes()),
            Self::Byte(v) => writer::fixed::<TAGGED, 1>(out, builtin, [v]),
            Self::Int16(v) => writer::fixed::<TAGGED, 2>(out, builtin, v.to_le_bytes()),
            Self::UInt16(v) => writer::fixed::<TAGGED, 2>(out, builtin, v.to_le_bytes()),
            Self::Int32(v) => writer::fixed::<TAGGED, 4>(out, builtin, v.to_le_bytes()),
            Self::UInt32(v) => writer::fixed::<TAGGED, 4>(out, builtin, v.to_le_bytes()),
            Self::Int64(v) => writer::fixed::<TAGGED, 8>(out, builtin, v.to_le_bytes()),
            Self::UInt64(v) => writer::fixed::<TAGGED, 8>(out, builtin, v.to_le_bytes()),
            Self::Float(v) => writer::fixed::<TAGGED, 4>(out, builtin, v.to_le_bytes()),
            Self::Double(v) => writer::fixed::<TAGGED, 8>(out, builtin, v.to_le_bytes()),
            Self::DateTime(v) => writer::fixed::<TAGGED, 8>(out, builtin, v.0.to_le_bytes()),
            Self::Guid(v) => writer::fixed::<TAGGED, 16>(out, builtin, v.0),
            Self::StatusCode(v) => writer::fixed::<TAGGED, 4>(out, builtin, v.0.to_le_bytes()),
            Self::String(text) => return write_text::<TAGGED>(out, builtin, text),
            Self::XmlElement(text) => return write_text::<TAGGED>(out, builtin, text),
            Self::ByteString(bytes) => {
                write_tag::<TAGGED>(out, builtin);
                return writer::byte_string(out, bytes, "ByteString");
            }
            Self::NodeId(node_id) => {
                write_tag::<TAGGED>(out, builtin);
                return node_id.write(out);
            }
            Self::ExpandedNodeId(node_id) => {
                write_tag::<TAGGED>(out, builtin);
                return node_id.write(out);
            }
            Self::QualifiedName(name) => {
                write_tag::<TAGGED>(out, builtin);
                return name.write(out);
            }
            Self::LocalizedText(text) => {
                write_tag::<TAGGED>(out, builtin);
                return text.write(out);
            }
            Self::ExtensionObject(object) => {
                write_tag::<TAGGED>(out, builtin);
                return object.write(out);
            }
            Self::DataValue(value) => write_bytes::<TAGGED>(out, builtin, value.bytes()),
            Self::Variant(_) if TAGGED => {
                return Err(EncodeError::Misplaced("a Variant directly in a Variant"));
            }
            Self::Variant(value) => out.extend_from_slice(value.bytes()),
            Self::DiagnosticInfo(value) => write_bytes::<TAGGED>(out, builtin, value.bytes()),
        }
        Ok(())
    }
}

#[inline]
fn write_tag<const TAGGED: bool>(out: &mut Vec<u8>, builtin: BuiltinType) {
    if TAGGED {
        out.push(builtin.id());
    }
}

fn write_bytes<const TAGGED: bool>(out: &mut Vec<u8>, builtin: BuiltinType, bytes: &[u8]) {
    write_tag::<TAGGED>(out, builtin);
    out.extend_from_slice(bytes);
}

fn write_text<const TAGGED: bool>(
    out: &mut Vec<u8>,
    builtin: BuiltinType,
    text: Option<&str>,
) -> Result<(), EncodeError> {
    write_tag::<TAGGED>(out, builtin);
    writer::byte_string(out, text.map(str::as_bytes), builtin.name())
}

impl<'a> QualifiedName<'a> {
    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Ok(Self {
            namespace: reader.u16("QualifiedName NamespaceIndex")?,
            name: reader.text("QualifiedName Name")?,
        })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        out.extend_from_slice(&self.namespace.to_le_bytes());
        writer::byte_string(out, self.name.map(str::as_bytes), "QualifiedName Name")
    }
}

impl<'a> LocalizedText<'a> {
    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let mask = reader.u8("LocalizedText")?;
        let reserved = mask & !(HAS_LOCALE | HAS_TEXT);
        if reserved != 0 {
            return Err(DecodeError::Reserved {
                field: "LocalizedText encoding mask",
                value: reserved.into(),
            });
        }
        let locale = match mask & HAS_LOCALE {
            0 => None,
            _ => reader.text("LocalizedText Locale")?,
        };
        let text = match mask & HAS_TEXT {
            0 => None,
            _ => reader.text("LocalizedText Text")?,
        };
        Ok(Self { locale, text })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let mut mask = 0;
        if self.locale.is_some() {
            mask |= HAS_LOCALE;
        }
        if self.text.is_some() {
            mask |= HAS_TEXT;
        }
        out.push(mask);
        if let Some(locale) = self.locale {
            writer::byte_string(out, Some(locale.as_bytes()), "LocalizedText Locale")?;
        }
        if let Some(text) = self.text {
            writer::byte_string(out, Some(text.as_bytes()), "LocalizedText Text")?;
        }
        Ok(())
    }
}

impl<'a> ExtensionObject<'a> {
    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        let type_id = NodeId::read(reader)?;
        let body = match reader.u8("ExtensionObject encoding")? {
            NO_BODY => ExtensionBody::None,
            BINARY_BODY => ExtensionBody::Binary(
                reader
                    .byte_string("ExtensionObject body")?
                    .unwrap_or_default(),
            ),
            XML_BODY => {
                ExtensionBody::Xml(reader.text("ExtensionObject body")?.unwrap_or_default())
            }
            encoding => {
                return Err(DecodeError::Reserved {
                    field: "ExtensionObject encoding",
                    value: encoding.into(),
                });
            }
        };
        Ok(Self { type_id, body })
    }

    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        self.type_id.write(out)?;
        match self.body {
            ExtensionBody::None => {
                out.push(NO_BODY);
                Ok(())
            }
            ExtensionBody::Binary(body) => {
                out.push(BINARY_BODY);
                writer::byte_string(out, Some(body), "ExtensionObject body")
            }
            ExtensionBody::Xml(body) => {
                out.push(XML_BODY);
                writer::byte_string(out, Some(body.as_bytes()), "ExtensionObject body")
            }
        }
    }
}

const HAS_LOCALE: u8 = 1;
const HAS_TEXT: u8 = 2;
const NO_BODY: u8 = 0;
/// Encoding byte of an ExtensionObject with an OPC UA binary body.
pub(crate) const BINARY_BODY: u8 = 1;
const XML_BODY: u8 = 2;
