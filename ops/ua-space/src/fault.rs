//! Locates the fault of a datagram.
//!
//! A decoding error names the field but not its offset. The offset is found by decoding copies with
//! other bytes after a position: decoding goes strictly from left to right, so bytes after the
//! fault do not change its result.

use std::fmt;

use uadp::DecodeError;

/// The first fault of a part of a datagram.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct DecodeFault {
    pub(crate) place: FaultLocation,
    pub(crate) error: DecodeError,
    /// The number of bytes before the fault.
    pub(crate) offset: usize,
}

/// The part of the datagram with the fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FaultLocation {
    Headers,
    PromotedField(usize),
    Chunk,
    Discovery,
    /// The bytes around the DataSetMessages.
    Payload,
    Message(MessagePlace),
}

/// The DataSetMessage with the fault, and its field unless the fault is in the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MessagePlace {
    pub(crate) writer_id: Option<u16>,
    pub(crate) field: Option<usize>,
}

/// The number of parts read before the error, and the error.
pub(crate) type PartialRead = (Option<usize>, DecodeError);

/// Returns the offset of the fault in `bytes`. `read` returns the stop of similar bytes.
///
/// Calls `read` at most about 40 times.
pub(crate) fn offset(
    bytes: &[u8],
    stop: PartialRead,
    read: impl Fn(&[u8]) -> Option<PartialRead>,
) -> usize {
    let (_, error) = stop;
    let shorter = |end: usize| read(bytes.get(..end)?);
    if let DecodeError::Truncated { found, .. } = error
        && shorter(bytes.len().saturating_sub(1)) != Some(stop)
    {
        // The number of remaining bytes gives the offset of the fault. Otherwise the decoded part
        // ends before the end of the bytes.
        return bytes.len().saturating_sub(found);
    }
    if let DecodeError::TrailingBytes(left) = error {
        return bytes.len().saturating_sub(left);
    }
    if let DecodeError::Reserved { field, .. } = error
        && field == "field encoding"
    {
        // Bits of the first byte, which are checked after the bits of the second byte.
        return 0;
    }
    let end = end(bytes, stop, &read);
    let last = end.saturating_sub(1);
    // Without its last byte, the field at fault is truncated, which gives its start.
    if let Some((_, DecodeError::Truncated { found, .. })) = shorter(last) {
        return last.saturating_sub(found);
    }
    end.saturating_sub(width(error))
}

/// Returns the end of the field at fault: the first position after which the bytes make no
/// difference. The length stays the same, because counts are compared with it.
fn end(bytes: &[u8], stop: PartialRead, read: &impl Fn(&[u8]) -> Option<PartialRead>) -> usize {
    let mut other = bytes.to_vec();
    let (mut before, mut end) = (0, bytes.len());
    while end - before > 1 {
        let middle = before + (end - before) / 2;
        let stays = [0x00, 0xFF].into_iter().all(|filler| {
            if let Some((head, tail)) = other.split_at_mut_checked(middle) {
                head.copy_from_slice(bytes.get(..middle).unwrap_or_default());
                tail.fill(filler);
            }
            read(&other) == Some(stop)
        });
        if stays { end = middle } else { before = middle }
    }
    end
}

/// Returns the number of bytes of the field at fault, by the kind of error.
fn width(error: DecodeError) -> usize {
    if let DecodeError::Limit { field, .. } = error {
        return if field == "FieldCount" { 2 } else { 4 };
    }
    if let DecodeError::Reserved { value, .. } = error
        && value > 0xFF
    {
        return 4;
    }
    1
}

/// Returns the stop of an error after `field` fields. Trailing bytes belong to no field.
pub(crate) const fn in_field(field: usize, error: DecodeError) -> PartialRead {
    if let DecodeError::TrailingBytes(_) = error {
        return (None, error);
    }
    (Some(field), error)
}

impl fmt::Display for DecodeFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "offset {}, ", self.offset)?;
        let mut field = None;
        match self.place {
            FaultLocation::Headers | FaultLocation::Payload => {}
            FaultLocation::PromotedField(index) => {
                write!(f, "in the PromotedFields, ")?;
                field = Some(index);
            }
            FaultLocation::Chunk => write!(f, "in the chunk, ")?,
            FaultLocation::Discovery => write!(f, "in the discovery message, ")?,
            FaultLocation::Message(message) => {
                match message.writer_id {
                    Some(id) => write!(f, "in DataSetMessage of DataSetWriterId {id}, ")?,
                    None => write!(f, "in DataSetMessage, ")?,
                }
                field = message.field;
            }
        }
        let (name, what) = described(self.error);
        match (field, name) {
            (Some(field), Some(name)) => write!(f, "field {field} ({name}): {what}"),
            (Some(field), None) => write!(f, "field {field}: {what}"),
            (None, Some(name)) => write!(f, "{name}: {what}"),
            (None, None) => write!(f, "{what}"),
        }
    }
}

/// Returns the name of the field at fault in the standard, and the description of the error.
fn described(error: DecodeError) -> (Option<&'static str>, String) {
    if let DecodeError::Truncated {
        field,
        expected,
        found,
    } = error
    {
        let bytes = if expected == 1 { "byte" } else { "bytes" };
        return (
            Some(field),
            format!("expected {expected} {bytes}, found {found}"),
        );
    }
    if let DecodeError::Reserved { field, value } = error {
        return (Some(field), format!("the reserved value {value:#x}"));
    }
    if let DecodeError::Limit { field, value } = error {
        return (
            Some(field),
            format!("{value} does not fit in the bytes left"),
        );
    }
    if let DecodeError::Text(field) = error {
        return (Some(field), "not UTF-8".to_owned());
    }
    if let DecodeError::Unsupported(what) = error {
        return (Some(what), "not read by this program".to_owned());
    }
    (None, error.to_string())
}

#[cfg(test)]
mod tests {
    use uadp::{BuiltinType, StructureReader};

    use super::*;

    /// Reads a UInt32, a String and a Boolean array.
    fn read(bytes: &[u8]) -> Option<PartialRead> {
        let mut reader = StructureReader::new(bytes);
        let types = [BuiltinType::UInt32, BuiltinType::String];
        for (builtin, at) in types.into_iter().zip(0..) {
            if let Err(error) = reader.scalar(builtin) {
                return Some((Some(at), error));
            }
        }
        let error = reader.array(BuiltinType::Boolean).err()?;
        Some((Some(2), error))
    }

    fn offset_in(bytes: &[u8]) -> usize {
        offset(bytes, read(bytes).unwrap(), read)
    }

    #[test]
    fn the_offset_is_that_of_the_first_byte_at_fault() {
        let good = [1, 2, 3, 4, 3, 0, 0, 0, b'a', b'b', b'c', 2, 0, 0, 0, 1, 0];
        assert_eq!(read(&good), None);
        for (end, wanted) in [(0, 0), (3, 0), (4, 4), (7, 4), (8, 8), (10, 8), (13, 11)] {
            assert_eq!(offset_in(&good[..end]), wanted, "cut off at {end}");
        }
        let mut not_utf8 = good;
        not_utf8[9] = 0xFF;
        assert_eq!(offset_in(&not_utf8), 8);
        let mut negative = good;
        negative[14] = 0x80;
        assert_eq!(offset_in(&negative), 11);
        let mut too_many = good;
        too_many[11] = 3;
        assert_eq!(offset_in(&too_many), 11);
    }
}
