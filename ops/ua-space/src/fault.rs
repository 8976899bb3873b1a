//! What is wrong with a datagram, and at which byte.
//!
//! A decoding error names the field and not where it stands. That is found by reading again with other bytes behind a
//! place: reading goes strictly from left to right, so as long as they are behind the fault they change nothing.

use std::fmt;

use uadp::DecodeError;

/// The first fault of a part of a datagram.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Fault {
    pub(crate) place: Place,
    pub(crate) error: DecodeError,
    /// Bytes before it.
    pub(crate) offset: usize,
}

/// In which part of the datagram the fault is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Place {
    Headers,
    PromotedField(usize),
    Chunk,
    Discovery,
    /// What stands around the DataSetMessages.
    Payload,
    Message(MessagePlace),
}

/// Which DataSetMessage, and which of its fields if not its header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MessagePlace {
    pub(crate) writer_id: Option<u16>,
    pub(crate) field: Option<usize>,
}

/// Why reading stopped: after how many parts, and the error.
pub(crate) type Stop = (Option<usize>, DecodeError);

/// Bytes before what makes reading `bytes` stop. `read` tells where it stops in others like them.
///
/// At most some 40 of those are read.
pub(crate) fn offset(bytes: &[u8], stop: Stop, read: impl Fn(&[u8]) -> Option<Stop>) -> usize {
    let (_, error) = stop;
    let shorter = |end: usize| read(bytes.get(..end)?);
    if let DecodeError::Truncated { found, .. } = error
        && shorter(bytes.len().saturating_sub(1)) != Some(stop)
    {
        // How many bytes were left says where they were missed; else what was read ends before the bytes do.
        return bytes.len().saturating_sub(found);
    }
    if let DecodeError::TrailingBytes(left) = error {
        return bytes.len().saturating_sub(left);
    }
    if let DecodeError::Reserved { field, .. } = error
        && field == "field encoding"
    {
        // Bits of the first byte, looked at after those of the second.
        return 0;
    }
    let end = end(bytes, stop, &read);
    let last = end.saturating_sub(1);
    // Without its last byte, what is at fault is cut off: that says where it starts.
    if let Some((_, DecodeError::Truncated { found, .. })) = shorter(last) {
        return last.saturating_sub(found);
    }
    end.saturating_sub(width(error))
}

/// Where what is at fault ends: what stands behind makes no difference. The length does not change, as counts are
/// held against it.
fn end(bytes: &[u8], stop: Stop, read: &impl Fn(&[u8]) -> Option<Stop>) -> usize {
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
        match stays {
            true => end = middle,
            false => before = middle,
        }
    }
    end
}

/// Bytes of what is at fault, where nothing else tells.
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

/// Where an error stands that came after so many fields: what is behind the last one is in none.
pub(crate) const fn in_field(field: usize, error: DecodeError) -> Stop {
    if let DecodeError::TrailingBytes(_) = error {
        return (None, error);
    }
    (Some(field), error)
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "offset {}, ", self.offset)?;
        let mut field = None;
        match self.place {
            Place::Headers | Place::Payload => {}
            Place::PromotedField(index) => {
                write!(f, "in the PromotedFields, ")?;
                field = Some(index);
            }
            Place::Chunk => write!(f, "in the chunk, ")?,
            Place::Discovery => write!(f, "in the discovery message, ")?,
            Place::Message(message) => {
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

/// The standard's name of what is at fault, and what is wrong with it.
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
    fn read(bytes: &[u8]) -> Option<Stop> {
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
