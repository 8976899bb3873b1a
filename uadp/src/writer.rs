//! Appends to a buffer, and patches values that are known only at the end of a section.

use crate::{BuiltinType, EncodeError};
use alloc::vec::Vec;

/// Space at the end of a buffer for a few small values. Checking the capacity for every value costs
/// more.
pub(crate) struct ReservedSpace<'b, const CAPACITY: usize> {
    bytes: &'b mut [u8; CAPACITY],
    len: usize,
}

impl<const CAPACITY: usize> ReservedSpace<'_, CAPACITY> {
    /// Returns the number of used bytes.
    #[inline]
    pub(crate) const fn len(&self) -> usize {
        self.len
    }

    /// Appends a value. `CAPACITY` has to suffice for all values.
    #[inline]
    pub(crate) fn put<const N: usize>(&mut self, value: [u8; N]) {
        let place = self.bytes.get_mut(self.len..);
        let place = place.and_then(<[u8]>::first_chunk_mut);
        debug_assert!(place.is_some(), "{CAPACITY} bytes are not enough");
        if let Some(place) = place {
            *place = value;
            self.len += N;
        }
    }
}

/// Appends the bytes that `fill` writes, at most `CAPACITY`.
#[inline]
pub(crate) fn with_room<const CAPACITY: usize, T>(
    out: &mut Vec<u8>,
    fill: impl FnOnce(&mut ReservedSpace<'_, CAPACITY>) -> T,
) -> Option<T> {
    let start = out.len();
    out.extend_from_slice(&[0; CAPACITY]);
    let bytes = out.get_mut(start..)?.first_chunk_mut()?;
    let mut room = ReservedSpace { bytes, len: 0 };
    let filled = fill(&mut room);
    let end = start + room.len;
    out.truncate(end);
    Some(filled)
}

/// Appends a fixed-size value, after the encoding byte of a Variant if `TAGGED`: one reserve, one
/// copy.
#[inline]
pub(crate) fn fixed<const TAGGED: bool, const N: usize>(
    out: &mut Vec<u8>,
    builtin: BuiltinType,
    value: [u8; N],
) {
    if TAGGED {
        // The size fits the longest fixed value, a Guid. The compiler keeps only the used part.
        let mut cell = [0; 17];
        if let Some((tag, rest)) = cell.split_first_mut() {
            *tag = builtin.id();
            if let Some(place) = rest.first_chunk_mut::<N>() {
                *place = value;
            }
        }
        out.extend_from_slice(cell.get(..=N).unwrap_or_default());
    } else {
        out.extend_from_slice(&value);
    }
}

/// Returns the Int32 length of a String, ByteString, body or array.
#[inline]
pub(crate) fn int32_length(len: usize, what: &'static str) -> Result<[u8; 4], EncodeError> {
    match i32::try_from(len) {
        Ok(length) => Ok(length.to_le_bytes()),
        Err(_) => Err(EncodeError::TooBig { what, len }),
    }
}

/// Appends a String or ByteString (OPC 10000-6, 5.2.2.4 and 5.2.2.7); `None` is null.
#[inline]
pub(crate) fn byte_string(
    out: &mut Vec<u8>,
    value: Option<&[u8]>,
    what: &'static str,
) -> Result<(), EncodeError> {
    match value {
        Some(bytes) => {
            let length = int32_length(bytes.len(), what)?;
            out.reserve(length.len() + bytes.len());
            out.extend_from_slice(&length);
            out.extend_from_slice(bytes);
        }
        None => out.extend_from_slice(&NULL_LENGTH),
    }
    Ok(())
}

/// Replaces `N` bytes at `at` that were written before.
#[inline]
pub(crate) fn patch<const N: usize>(out: &mut [u8], at: usize, value: [u8; N]) {
    if let Some(place) = out.get_mut(at..).and_then(<[u8]>::first_chunk_mut) {
        *place = value;
    }
}

/// Returns `bit` if the field is present, otherwise 0.
#[inline]
pub(crate) const fn flag(present: bool, bit: u8) -> u8 {
    if present { bit } else { 0 }
}

/// Length of a null String, ByteString or array.
pub(crate) const NULL_LENGTH: [u8; 4] = (-1_i32).to_le_bytes();
