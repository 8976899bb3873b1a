//! The RawData field encoding (OPC 10000-14, 7.2.4.5.11): values in sequence, without types.
//!
//! A layout ([`layout`]) holds the DataSetMetaData of the fields; payloads are decoded ([`read`])
//! and encoded ([`mod@write`]) with it. Both support three forms of the same values: the two
//! dialects, and the plain form of OPC 10000-6, which open62541 uses for structures and all stacks
//! use for ExtensionObjects.

mod layout;
mod read;
mod value;
mod write;

pub use layout::{
    RawField, RawLayout, RawLayoutError, RawLayoutFault, RawStructure, RawStructureType,
};
pub use read::{RawFields, RawMembers};
pub use value::{RawArray, RawElements, RawValue};
pub use write::{RawWriteError, RawWriteFault};

/// Layout of RawData on the wire. Both sides have to use the same dialect.
///
/// The dialects differ only for texts, arrays and structures.
///
/// Some releases of UA-.NETStandard write padded texts and arrays without their length; this form
/// is not supported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum RawDialect {
    /// Layout of OPC 10000-14, 7.2.4.5.11:
    /// - A String or ByteString, also as an element of an array, is its Int32 length and its bytes,
    ///   padded to the MaxStringLength; a null value is length -1 and padding.
    /// - An array is its Int32 length and its elements, padded to the ArrayDimensions; a null array
    ///   is length -1 and padding.
    /// - A matrix is the number of its dimensions and the size of each dimension as Int32
    ///   (OPC 10000-6, 5.2.5), then its elements in row-major order, padded to the ArrayDimensions.
    ///   Peers differ in the position of the rows of a matrix that is shorter than its metadata:
    ///   rows in sequence, or each row at its maximum offset. The positions are equal if only the
    ///   outermost dimension is shorter. Other short matrices are neither decoded nor encoded.
    /// - Structures are padded inside in the same way. An absent optional field is padding of its
    ///   size (OPC 10000-6, 5.2.7), a Union is padded to its largest field (OPC 10000-6, 5.2.8).
    #[default]
    Standard,
    /// Layout of open62541 1.5:
    /// - Texts are encoded as in the standard.
    /// - An array or matrix is a UInt32 per dimension and its elements in row-major order,
    ///   unpadded. An array shorter than its ArrayDimensions is decoded but not encoded. There is
    ///   no null array.
    /// - Structures are not padded inside: OPC 10000-6, 5.2.5 to 5.2.8.
    Open62541,
}

/// Byte layout of a field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Standard,
    Open62541,
    /// OPC 10000-6 without padding.
    Plain,
}

impl Form {
    const fn of(dialect: RawDialect) -> Self {
        match dialect {
            RawDialect::Standard => Self::Standard,
            RawDialect::Open62541 => Self::Open62541,
        }
    }

    /// Returns the form of the fields of a structure within this form.
    const fn nested(self) -> Self {
        match self {
            Self::Standard => Self::Standard,
            Self::Open62541 | Self::Plain => Self::Plain,
        }
    }

    const fn pads_texts(self) -> bool {
        match self {
            Self::Standard | Self::Open62541 => true,
            Self::Plain => false,
        }
    }
}

/// Size of an Int32 length, an Int32 dimension, an EncodingMask or a SwitchField: 4 bytes.
const WORD: usize = 4;
/// ValueRank of a single value.
const SCALAR: i32 = -1;
