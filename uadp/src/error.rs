//! Errors of decoding and encoding, with the invalid value.

use crate::{BuiltinType, RawWriteError};

/// Reason why bytes cannot be decoded as a UADP message.
///
/// [`Unsupported`](Self::Unsupported) is a limit of this crate, [`Misread`](Self::Misread) an error
/// of the caller; all other variants are errors of the sender or a truncated datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The bytes end within the named field.
    #[error("{field} is cut off: {expected} bytes expected, {found} left")]
    Truncated {
        /// Field, as in the tables of the standard.
        field: &'static str,
        /// Size of the field in bytes.
        expected: usize,
        /// Remaining bytes.
        found: usize,
    },
    /// The value is reserved by the standard; receivers skip the message (OPC 10000-14, 7.2.4.4.2
    /// and 7.2.4.5.4).
    #[error("{field} has the reserved value {value:#x}")]
    Reserved {
        /// Field, as in the tables of the standard.
        field: &'static str,
        /// The value; for flags the reserved bits only.
        value: u32,
    },
    /// The feature is part of the standard, but not supported by this crate.
    #[error("{0} not supported")]
    Unsupported(&'static str),
    /// The message needs another method, because it is of the described kind. This is an error of
    /// the caller.
    #[error("the message is {0}")]
    Misread(&'static str),
    /// The count exceeds the remaining bytes, even with elements of minimum size.
    #[error("{field} {value} does not fit in the bytes left")]
    Limit {
        /// The count field.
        field: &'static str,
        /// The count.
        value: u32,
    },
    /// The product of the dimensions differs from the number of elements (OPC 10000-6, 5.2.2.16).
    #[error("array dimensions do not fit its {elements} elements")]
    Dimensions {
        /// Number of elements.
        elements: usize,
    },
    /// The values are nested deeper than [`MAX_NESTING`](crate::MAX_NESTING).
    #[error("values nested deeper than {MAX_NESTING} levels", MAX_NESTING = crate::MAX_NESTING)]
    TooDeep,
    /// This number of bytes follows the end of the message, and they are not zero padding.
    #[error("{0} bytes after the end of the message")]
    TrailingBytes(usize),
    /// The named text is not UTF-8.
    #[error("{0} is not UTF-8")]
    Text(&'static str),
}

impl DecodeError {
    /// Returns the field or subject of the error, as in the tables of the standard, without its
    /// value. It is equal for all errors of a kind.
    #[must_use]
    pub const fn subject(&self) -> &'static str {
        match self {
            Self::Truncated { field, .. }
            | Self::Reserved { field, .. }
            | Self::Limit { field, .. } => field,
            Self::Unsupported(what) | Self::Misread(what) | Self::Text(what) => what,
            Self::Dimensions { .. } => "array dimensions",
            Self::TooDeep => "nesting",
            Self::TrailingBytes(_) => "trailing bytes",
        }
    }
}

/// Reason why a message could not be encoded. The buffer then holds an incomplete message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The value exceeds the length field of the standard.
    #[error("{what} of {len} is too large")]
    TooBig {
        /// Name of the value.
        what: &'static str,
        /// Length in bytes for a text or message, otherwise a count.
        len: usize,
    },
    /// The number of DataSetMessages differs from the payload header.
    #[error("{announced} DataSetMessages announced, {written} written")]
    MessageCount {
        /// Number of DataSetWriterIds in the payload header; 1 without payload header.
        announced: usize,
        /// Number of finished DataSetMessages.
        written: usize,
    },
    /// The call is not valid in the present state, for example a field within an open array.
    #[error("{0}")]
    Misplaced(&'static str),
    /// The element has another type than its array.
    #[error("{found:?} in an array of {expected:?}")]
    ElementType {
        /// Element type of the array.
        expected: BuiltinType,
        /// Type of the element.
        found: BuiltinType,
    },
    /// The bytes of a packed array are not `count` elements of a fixed-size type.
    #[error("{bytes} bytes are not {count} elements of {element:?}")]
    PackedSize {
        /// Element type.
        element: BuiltinType,
        /// Announced number of elements.
        count: usize,
        /// Number of bytes.
        bytes: usize,
    },
    /// The value does not match the RawData layout.
    #[error(transparent)]
    Raw(#[from] RawWriteError),
    /// Structures are nested deeper than
    /// [`FieldEncoder::MAX_DEPTH`](crate::FieldEncoder::MAX_DEPTH).
    #[error("structures nested too deep")]
    TooDeep,
}
