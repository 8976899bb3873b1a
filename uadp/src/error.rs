//! What makes reading or writing fail, with the offending value.

use crate::{BuiltinType, RawWriteError};

/// Why bytes are not a UADP message this crate reads.
///
/// [`Unsupported`](Self::Unsupported) is our limit; every other variant is the sender's fault or a cut datagram.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The bytes end before the named item does.
    #[error("{field} is cut off: {expected} bytes expected, {found} left")]
    Truncated {
        /// What was to be read, as the standard's tables name it.
        field: &'static str,
        /// Bytes it takes.
        expected: usize,
        /// Bytes there are.
        found: usize,
    },
    /// A value the standard reserves; receivers skip the message (OPC 10000-14, 7.2.4.4.2 and 7.2.4.5.4).
    #[error("{field} has the reserved value {value:#x}")]
    Reserved {
        /// The field of the standard's tables.
        field: &'static str,
        /// What stood there, reserved bits only where the field is a set of flags.
        value: u32,
    },
    /// Allowed by the standard, not read by this crate.
    #[error("{0} not supported")]
    Unsupported(&'static str),
    /// Not this way: the message is what the text says. Nobody's fault but the caller's.
    #[error("the message is {0}")]
    Misread(&'static str),
    /// A count that not even the smallest elements could reach in the bytes that are left.
    #[error("{field} {value} does not fit in the bytes left")]
    Limit {
        /// The counting field.
        field: &'static str,
        /// The count.
        value: u32,
    },
    /// Dimensions whose product is not the number of elements (OPC 10000-6, 5.2.2.16).
    #[error("array dimensions do not fit its {elements} elements")]
    Dimensions {
        /// Elements there are.
        elements: usize,
    },
    /// Values nested in values beyond [`MAX_NESTING`](crate::MAX_NESTING).
    #[error("values nested deeper than {MAX_NESTING} levels", MAX_NESTING = crate::MAX_NESTING)]
    TooDeep,
    /// So many bytes stand after the end of the message and are not zero padding.
    #[error("{0} bytes after the end of the message")]
    TrailingBytes(usize),
    /// The named text is not UTF-8.
    #[error("{0} is not UTF-8")]
    Text(&'static str),
}

impl DecodeError {
    /// What it is about, as the standard's tables name it, whatever stood there: the same for all errors of a kind.
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

/// Why a message could not be written. The buffer then holds an unfinished message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The value does not fit in the length field the standard gives it.
    #[error("{what} of {len} is too big")]
    TooBig {
        /// What is too big.
        what: &'static str,
        /// Its length: bytes of a text or message, else a count.
        len: usize,
    },
    /// The payload header names another number of DataSetMessages than were written.
    #[error("{announced} DataSetMessages announced, {written} written")]
    MessageCount {
        /// DataSetWriterIds in the payload header, or one without it.
        announced: usize,
        /// DataSetMessages finished.
        written: usize,
    },
    /// A call that has no place here, such as a field while an array is open.
    #[error("{0}")]
    Misplaced(&'static str),
    /// An element of another type than its array.
    #[error("{found:?} in an array of {expected:?}")]
    ElementType {
        /// Element type the array was opened with.
        expected: BuiltinType,
        /// Type of the value given.
        found: BuiltinType,
    },
    /// The bytes of a packed array are not `count` elements of a fixed-size type.
    #[error("{bytes} bytes are not {count} elements of {element:?}")]
    PackedSize {
        /// Element type.
        element: BuiltinType,
        /// Elements announced.
        count: usize,
        /// Bytes given.
        bytes: usize,
    },
    /// A value that the layout of RawData does not take.
    #[error(transparent)]
    Raw(#[from] RawWriteError),
    /// Structures are nested deeper than [`FieldEncoder::MAX_DEPTH`](crate::FieldEncoder::MAX_DEPTH).
    #[error("structures nested too deep")]
    TooDeep,
}
