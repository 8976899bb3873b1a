//! The RawData field encoding (OPC 10000-14, 7.2.4.5.11): values back to back, without types.
//!
//! What the DataSetMetaData says of the fields is a layout ([`layout`]), with which payloads are read ([`read`]) and
//! written ([`mod@write`]). Both know three forms in which the same values can stand: the two dialects, and what
//! OPC 10000-6 alone says, which is how open62541 has structures and everybody has ExtensionObjects.

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

/// How a peer lays out RawData. Both sides have to be set to the same.
///
/// Without texts, arrays and structures there is no difference.
///
/// Some releases of UA-.NETStandard write padded texts and arrays without their length; that is not read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
pub enum RawDialect {
    /// By the text of OPC 10000-14, 7.2.4.5.11:
    /// - A String or ByteString, also as an element of an array, is its Int32 length and its bytes, padded to the
    ///   MaxStringLength; a null one is length -1 and padding.
    /// - An array is its Int32 length and its elements, padded to the ArrayDimensions; a null one is length -1 and
    ///   padding.
    /// - A matrix is the number of its dimensions and each of them as Int32 (OPC 10000-6, 5.2.5), then its elements in
    ///   row-major order, padded to the ArrayDimensions. Where the elements of a matrix shorter than its metadata says
    ///   stand is read in two ways by peers, one row behind the other or each row in its place. The two differ unless
    ///   only the outermost dimension is shorter, and such a matrix is neither read nor written.
    /// - Structures are padded inside in the same way. An optional field which is not there is padding of its size
    ///   (OPC 10000-6, 5.2.7), a Union is padded to its biggest field (OPC 10000-6, 5.2.8).
    #[default]
    Standard,
    /// As open62541 1.5 does it:
    /// - Texts as in the standard.
    /// - An array or matrix is one UInt32 per dimension and its elements in row-major order, unpadded; what is shorter
    ///   than its ArrayDimensions is read but not written. There is no null array.
    /// - Inside of structures nothing is padded: OPC 10000-6, 5.2.5 to 5.2.8.
    Open62541,
}

/// Where the bytes of a field stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Standard,
    Open62541,
    /// OPC 10000-6 alone: no padding.
    Plain,
}

impl Form {
    const fn of(dialect: RawDialect) -> Self {
        match dialect {
            RawDialect::Standard => Self::Standard,
            RawDialect::Open62541 => Self::Open62541,
        }
    }

    /// Form of the fields of a structure which stands in this one.
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

/// Int32 length, Int32 dimension, EncodingMask, SwitchField: all take four bytes.
const WORD: usize = 4;
/// ValueRank of a single value.
const SCALAR: i32 = -1;
