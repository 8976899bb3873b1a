//! The builtin types of OPC UA, and their smaller values.

use core::fmt;

/// Builtin type of a value, numbered as in the encoding byte of a Variant (OPC 10000-6, 5.1.2).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
#[expect(missing_docs, reason = "the names are those of the standard's table")]
pub enum BuiltinType {
    Boolean = 1,
    SByte,
    Byte,
    Int16,
    UInt16,
    Int32,
    UInt32,
    Int64,
    UInt64,
    Float,
    Double,
    String,
    DateTime,
    Guid,
    ByteString,
    XmlElement,
    NodeId,
    ExpandedNodeId,
    StatusCode,
    QualifiedName,
    LocalizedText,
    ExtensionObject,
    DataValue,
    Variant,
    DiagnosticInfo,
}

impl BuiltinType {
    /// Returns whether values of the type are integers.
    #[must_use]
    pub const fn is_integer(self) -> bool {
        matches!(
            self,
            Self::SByte
                | Self::Byte
                | Self::Int16
                | Self::UInt16
                | Self::Int32
                | Self::UInt32
                | Self::Int64
                | Self::UInt64
        )
    }

    /// Returns whether values of the type are numbers, which can be scaled and converted to other
    /// numbers.
    #[must_use]
    pub const fn is_number(self) -> bool {
        self.is_integer() || matches!(self, Self::Float | Self::Double)
    }

    /// All builtin types, in the order of the ids.
    pub const ALL: [Self; 25] = [
        Self::Boolean,
        Self::SByte,
        Self::Byte,
        Self::Int16,
        Self::UInt16,
        Self::Int32,
        Self::UInt32,
        Self::Int64,
        Self::UInt64,
        Self::Float,
        Self::Double,
        Self::String,
        Self::DateTime,
        Self::Guid,
        Self::ByteString,
        Self::XmlElement,
        Self::NodeId,
        Self::ExpandedNodeId,
        Self::StatusCode,
        Self::QualifiedName,
        Self::LocalizedText,
        Self::ExtensionObject,
        Self::DataValue,
        Self::Variant,
        Self::DiagnosticInfo,
    ];

    /// Returns the builtin type with an id, or `None` outside 1 to 25.
    #[inline]
    #[must_use]
    pub const fn from_id(id: u8) -> Option<Self> {
        Some(match id {
            1 => Self::Boolean,
            2 => Self::SByte,
            3 => Self::Byte,
            4 => Self::Int16,
            5 => Self::UInt16,
            6 => Self::Int32,
            7 => Self::UInt32,
            8 => Self::Int64,
            9 => Self::UInt64,
            10 => Self::Float,
            11 => Self::Double,
            12 => Self::String,
            13 => Self::DateTime,
            14 => Self::Guid,
            15 => Self::ByteString,
            16 => Self::XmlElement,
            17 => Self::NodeId,
            18 => Self::ExpandedNodeId,
            19 => Self::StatusCode,
            20 => Self::QualifiedName,
            21 => Self::LocalizedText,
            22 => Self::ExtensionObject,
            23 => Self::DataValue,
            24 => Self::Variant,
            25 => Self::DiagnosticInfo,
            _ => return None,
        })
    }

    /// Returns the id in the encoding byte of a Variant, 1 to 25.
    #[inline]
    #[must_use]
    pub const fn id(self) -> u8 {
        self as u8
    }

    /// Returns the name in the standard, such as `UInt16`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Boolean => "Boolean",
            Self::SByte => "SByte",
            Self::Byte => "Byte",
            Self::Int16 => "Int16",
            Self::UInt16 => "UInt16",
            Self::Int32 => "Int32",
            Self::UInt32 => "UInt32",
            Self::Int64 => "Int64",
            Self::UInt64 => "UInt64",
            Self::Float => "Float",
            Self::Double => "Double",
            Self::String => "String",
            Self::DateTime => "DateTime",
            Self::Guid => "Guid",
            Self::ByteString => "ByteString",
            Self::XmlElement => "XmlElement",
            Self::NodeId => "NodeId",
            Self::ExpandedNodeId => "ExpandedNodeId",
            Self::StatusCode => "StatusCode",
            Self::QualifiedName => "QualifiedName",
            Self::LocalizedText => "LocalizedText",
            Self::ExtensionObject => "ExtensionObject",
            Self::DataValue => "DataValue",
            Self::Variant => "Variant",
            Self::DiagnosticInfo => "DiagnosticInfo",
        }
    }

    /// Returns the builtin type with a [`name`](Self::name); the spelling has to be exact.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|builtin| builtin.name() == name)
    }

    /// Returns the encoded size of a value in bytes (OPC 10000-6, 5.2.2), or `None` if variable.
    #[inline]
    #[must_use]
    pub const fn fixed_size(self) -> Option<usize> {
        Some(match self {
            Self::Boolean | Self::SByte | Self::Byte => 1,
            Self::Int16 | Self::UInt16 => 2,
            Self::Int32 | Self::UInt32 | Self::Float | Self::StatusCode => 4,
            Self::Int64 | Self::UInt64 | Self::Double | Self::DateTime => 8,
            Self::Guid => 16,
            Self::String
            | Self::ByteString
            | Self::XmlElement
            | Self::NodeId
            | Self::ExpandedNodeId
            | Self::QualifiedName
            | Self::LocalizedText
            | Self::ExtensionObject
            | Self::DataValue
            | Self::Variant
            | Self::DiagnosticInfo => return None,
        })
    }

    /// Returns the minimum encoded size of a value in bytes. An array length is checked against it
    /// before the elements are decoded.
    pub(crate) fn min_size(self) -> usize {
        let least = if matches!(self, Self::QualifiedName) {
            6
        } else if matches!(self, Self::String | Self::ByteString | Self::XmlElement) {
            4
        } else if matches!(self, Self::ExtensionObject) {
            3
        } else if matches!(self, Self::NodeId | Self::ExpandedNodeId) {
            2
        } else {
            1
        };
        self.fixed_size().unwrap_or(least)
    }
}

impl fmt::Display for BuiltinType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A Guid in its encoding of 16 bytes: Data1 to Data3 little-endian, Data4 in order (OPC 10000-6,
/// 5.2.2.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// Creates a Guid from the four fields of OPC 10000-6, 5.1.3.
    #[must_use]
    pub const fn from_fields(data1: u32, data2: u16, data3: u16, data4: [u8; 8]) -> Self {
        let [a, b, c, d] = data1.to_le_bytes();
        let [e, f] = data2.to_le_bytes();
        let [g, h] = data3.to_le_bytes();
        let [i, j, k, l, m, n, o, p] = data4;
        Self([a, b, c, d, e, f, g, h, i, j, k, l, m, n, o, p])
    }
}

/// Formats the Guid as in OPC 10000-6, 5.1.3: `72962B91-FA75-4AE6-8D28-B404DC7DAF63`.
impl fmt::Display for Guid {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e, g, h, i, j, k, l, m, n, o, p, q] = self.0;
        let data1 = u32::from_le_bytes([a, b, c, d]);
        let data2 = u16::from_le_bytes([e, g]);
        let data3 = u16::from_le_bytes([h, i]);
        let tail = u64::from_be_bytes([0, 0, l, m, n, o, p, q]);
        write!(
            f,
            "{data1:08X}-{data2:04X}-{data3:04X}-{j:02X}{k:02X}-{tail:012X}"
        )
    }
}

/// A StatusCode of 32 bits; the two highest bits are the severity (OPC 10000-4, 7.39).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct StatusCode(pub u32);

impl StatusCode {
    /// Good, 0.
    pub const GOOD: Self = Self(0);

    /// Returns the StatusCode of a DataSetMessage header, which contains the upper 16 bits
    /// (OPC 10000-14, 7.2.4.5.4).
    #[must_use]
    pub const fn from_status(status: u16) -> Self {
        Self((status as u32) << 16)
    }

    /// Returns the upper 16 bits, as in a DataSetMessage header.
    #[must_use]
    pub const fn status(self) -> u16 {
        let [_, _, low, high] = self.0.to_le_bytes();
        u16::from_le_bytes([low, high])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_and_names_lead_back_to_their_type() {
        for (builtin, id) in BuiltinType::ALL.into_iter().zip(1u8..) {
            assert_eq!(builtin.id(), id);
            assert_eq!(BuiltinType::from_id(id), Some(builtin));
            assert_eq!(BuiltinType::from_name(builtin.name()), Some(builtin));
        }
        assert_eq!(BuiltinType::from_id(0), None);
        assert_eq!(BuiltinType::from_id(26), None);
        assert_eq!(BuiltinType::from_name("double"), None);
    }

    #[test]
    fn a_guid_prints_its_first_three_fields_as_numbers() {
        let guid = Guid::from_fields(
            0x7296_2B91,
            0xFA75,
            0x4AE6,
            [0x8D, 0x28, 0xB4, 0x04, 0xDC, 0x7D, 0xAF, 0x63],
        );
        assert_eq!(guid.to_string(), "72962B91-FA75-4AE6-8D28-B404DC7DAF63");
        assert_eq!(guid.0[..4], [0x91, 0x2B, 0x96, 0x72]);
    }

    #[test]
    fn a_header_status_is_the_upper_half_of_the_status_code() {
        assert_eq!(StatusCode::from_status(0x8034), StatusCode(0x8034_0000));
        assert_eq!(StatusCode(0x8034_1234).status(), 0x8034);
    }
}
