//! Encodes the fields of a key frame, including structures.

use crate::encoder::{HeaderOffsets, PayloadProgress};
use crate::scalar::{BINARY_BODY, Scalar};
use crate::{BuiltinType, DataValue, EncodeError, NodeId, Variant, variant, writer};
use alloc::vec::Vec;

/// Appends the fields of a key frame or event as Variants (OPC 10000-14, 7.2.4.5.5 and 7.2.4.5.7).
///
/// Between [`begin_structure`](Self::begin_structure) and [`end_structure`](Self::end_structure)
/// the same methods write the fields of the structure, without the encoding byte of a Variant
/// (OPC 10000-6, 5.2.6).
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct FieldEncoder<'m> {
    buf: &'m mut Vec<u8>,
    progress: &'m mut PayloadProgress,
    offsets: HeaderOffsets,
    /// Offset of the FieldCount.
    count_at: usize,
    fields: usize,
    /// Number of missing elements of an open array, and their type.
    wanted: u32,
    element: BuiltinType,
    depth: usize,
    /// The open structures, outermost first; the first `depth` entries are in use.
    outer: [Outer; MAX_DEPTH],
}

/// Appends the fields of a delta frame as Variants (OPC 10000-14, 7.2.4.5.6).
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct DeltaEncoder<'m> {
    fields: FieldEncoder<'m>,
    indexes: usize,
}

/// Appends the fields of a key frame or delta frame as DataValues.
#[derive(Debug)]
#[must_use = "a message is complete with `finish`"]
pub struct DataValueEncoder<'m> {
    fields: FieldEncoder<'m>,
    delta: bool,
}

/// State outside of an open structure.
#[derive(Debug, Clone, Copy)]
struct Outer {
    /// Offset of the length of the structure's body.
    length_at: u32,
    /// Number of missing elements behind the structure.
    wanted: u32,
}

const MAX_DEPTH: usize = 8;

impl<'m> FieldEncoder<'m> {
    /// Maximum nesting depth of structures.
    pub const MAX_DEPTH: usize = MAX_DEPTH;

    /// Creates an encoder. The buffer ends with the space for the FieldCount.
    #[inline]
    pub(crate) fn new(
        buf: &'m mut Vec<u8>,
        progress: &'m mut PayloadProgress,
        offsets: HeaderOffsets,
    ) -> Self {
        let count_at = buf.len().saturating_sub(2);
        Self {
            buf,
            progress,
            offsets,
            count_at,
            fields: 0,
            wanted: 0,
            element: BuiltinType::ExtensionObject,
            depth: 0,
            outer: [Outer {
                length_at: 0,
                wanted: 0,
            }; MAX_DEPTH],
        }
    }

    /// Returns the offset of the DataSetMessageSequenceNumber (UInt16) in the buffer.
    #[inline]
    #[must_use]
    pub const fn sequence_offset(&self) -> Option<usize> {
        self.offsets.sequence_number
    }

    /// Returns the offset of the Timestamp (Int64) of the DataSetMessage in the buffer.
    #[inline]
    #[must_use]
    pub const fn timestamp_offset(&self) -> Option<usize> {
        self.offsets.timestamp
    }

    /// Appends a field without a value.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] inside a structure or in an incomplete array.
    pub fn null(&mut self) -> Result<(), EncodeError> {
        self.variant(&Variant::Null)
    }

    /// Appends a field with a single value; inside a structure, its next field.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] in an incomplete array; [`EncodeError::TooBig`] for a text or
    /// byte string of more than 2^31-1 bytes.
    #[inline]
    pub fn scalar(&mut self, value: Scalar<'_>) -> Result<(), EncodeError> {
        self.begin_value()?;
        match self.depth {
            0 => value.write::<true>(self.buf),
            _ => value.write::<false>(self.buf),
        }
    }

    /// Appends fields with a single value each, all of `builtin`, a type of fixed size; inside a
    /// structure, its next fields. `bytes` are the encoded values: little-endian and contiguous.
    ///
    /// # Errors
    /// [`EncodeError::PackedSize`] if `bytes` is not a multiple of the value size or the type has
    /// no fixed size; [`EncodeError::Misplaced`] in an incomplete array.
    #[inline]
    pub fn scalars(&mut self, builtin: BuiltinType, bytes: &[u8]) -> Result<(), EncodeError> {
        let size = builtin.fixed_size().unwrap_or_default();
        if size == 0 || !bytes.len().is_multiple_of(size) {
            return Err(EncodeError::PackedSize {
                element: builtin,
                count: 1,
                bytes: bytes.len(),
            });
        }
        if self.depth > 0 {
            self.begin_value()?;
            self.buf.extend_from_slice(bytes);
            return Ok(());
        }
        if self.wanted != 0 {
            return Err(ELEMENTS_WANTED);
        }
        let count = bytes.len() / size;
        self.fields += count;
        self.buf.reserve(bytes.len() + count);
        match size {
            8 => push_tagged::<8>(self.buf, builtin.id(), bytes),
            4 => push_tagged::<4>(self.buf, builtin.id(), bytes),
            2 => push_tagged::<2>(self.buf, builtin.id(), bytes),
            _ => {
                for value in bytes.chunks_exact(size) {
                    self.buf.push(builtin.id());
                    self.buf.extend_from_slice(value);
                }
            }
        }
        Ok(())
    }

    /// Appends a field from a Variant.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] inside a structure or in an incomplete array;
    /// [`EncodeError::TooBig`] as for [`scalar`](Self::scalar).
    #[inline]
    pub fn variant(&mut self, value: &Variant<'_>) -> Result<(), EncodeError> {
        if self.depth != 0 {
            return Err(EncodeError::Misplaced("Variant inside a structure"));
        }
        self.begin_value()?;
        value.write(self.buf)
    }

    /// Appends an array of `count` fixed-size elements. `bytes` are the encoded elements:
    /// little-endian and contiguous.
    ///
    /// # Errors
    /// [`EncodeError::PackedSize`] if `bytes` has another size or the type has no fixed size;
    /// [`EncodeError::Misplaced`] in an incomplete array.
    #[inline]
    pub fn packed_array(
        &mut self,
        element: BuiltinType,
        count: usize,
        bytes: &[u8],
    ) -> Result<(), EncodeError> {
        let size = element
            .fixed_size()
            .and_then(|size| size.checked_mul(count));
        if size != Some(bytes.len()) {
            return Err(EncodeError::PackedSize {
                element,
                count,
                bytes: bytes.len(),
            });
        }
        self.begin_array(element, count)?;
        self.buf.extend_from_slice(bytes);
        Ok(())
    }

    /// Starts an array; exactly `count` calls of [`element`](Self::element) have to follow.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] in another incomplete array; [`EncodeError::TooBig`] above 2^31-1
    /// elements.
    pub fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), EncodeError> {
        let wanted = u32::try_from(count).map_err(|_| EncodeError::TooBig {
            what: "array",
            len: count,
        })?;
        self.begin_array(element, count)?;
        self.wanted = wanted;
        self.element = element;
        Ok(())
    }

    /// Appends the next element of the open array.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] without an incomplete array; [`EncodeError::ElementType`] if the
    /// value has another type than the array; [`EncodeError::TooBig`] as for
    /// [`scalar`](Self::scalar).
    #[inline]
    pub fn element(&mut self, value: Scalar<'_>) -> Result<(), EncodeError> {
        let left = self.wanted.checked_sub(1).ok_or(NO_ARRAY)?;
        let found = value.builtin_type();
        if found != self.element {
            return Err(EncodeError::ElementType {
                expected: self.element,
                found,
            });
        }
        self.wanted = left;
        value.write::<false>(self.buf)
    }

    /// Starts an array of `count` structures. Each structure is a
    /// [`begin_structure`](Self::begin_structure) and an [`end_structure`](Self::end_structure).
    ///
    /// # Errors
    /// As for [`array`](Self::array).
    pub fn structures(&mut self, count: usize) -> Result<(), EncodeError> {
        self.array(BuiltinType::ExtensionObject, count)
    }

    /// Appends the length of an array of `count` structures by value, inside a structure. The
    /// fields of the structures follow inline (OPC 10000-6, 5.2.6).
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] outside of a structure or in an incomplete array;
    /// [`EncodeError::TooBig`] above 2^31-1 structures.
    pub fn inline_structures(&mut self, count: usize) -> Result<(), EncodeError> {
        if self.depth == 0 {
            return Err(EncodeError::Misplaced(
                "inline structures outside of a structure",
            ));
        }
        self.begin_array(BuiltinType::ExtensionObject, count)
    }

    /// Starts an ExtensionObject with a binary body: the next element of the open array of
    /// structures, or a separate value without an open array. `type_id` is the NodeId of the binary
    /// encoding of the structure.
    ///
    /// # Errors
    /// [`EncodeError::TooDeep`] above [`MAX_DEPTH`](Self::MAX_DEPTH); [`EncodeError::ElementType`]
    /// in an array of another type.
    pub fn begin_structure(&mut self, type_id: NodeId<'_>) -> Result<(), EncodeError> {
        if self.depth == MAX_DEPTH {
            return Err(EncodeError::TooDeep);
        }
        let found = BuiltinType::ExtensionObject;
        match self.wanted.checked_sub(1) {
            Some(left) if self.element == found => self.wanted = left,
            Some(_) => {
                return Err(EncodeError::ElementType {
                    expected: self.element,
                    found,
                });
            }
            None => {
                self.begin_value()?;
                if self.depth == 0 {
                    self.buf.push(found.id());
                }
            }
        }
        type_id.write(self.buf)?;
        self.buf.push(BINARY_BODY);
        let len = self.buf.len();
        let length_at = u32::try_from(len).map_err(|_| EncodeError::TooBig {
            what: "buffer",
            len,
        })?;
        self.buf.extend_from_slice(&[0; 4]);
        if let Some(outer) = self.outer.get_mut(self.depth) {
            *outer = Outer {
                length_at,
                wanted: self.wanted,
            };
        }
        self.depth += 1;
        self.wanted = 0;
        Ok(())
    }

    /// Ends the innermost structure.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] without an open structure or in an incomplete array;
    /// [`EncodeError::TooBig`] for a body of more than 2^31-1 bytes.
    pub fn end_structure(&mut self) -> Result<(), EncodeError> {
        if self.wanted != 0 {
            return Err(ELEMENTS_WANTED);
        }
        let depth = self.depth.checked_sub(1).ok_or(NO_STRUCTURE)?;
        let Outer { length_at, wanted } = self.outer.get(depth).copied().ok_or(NO_STRUCTURE)?;
        let length_at = length_at as usize;
        let len = self.buf.len() - length_at - 4;
        let length = writer::int32_length(len, "ExtensionObject body")?;
        writer::patch(self.buf, length_at, length);
        self.depth = depth;
        self.wanted = wanted;
        // Only an array of ExtensionObjects can be open around a structure.
        self.element = BuiltinType::ExtensionObject;
        Ok(())
    }

    /// Appends all fields at once: copies a block as returned by
    /// [`Fields::bytes`](crate::Fields::bytes) without decoding it.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] after another field, in a delta frame, or if the block has no
    /// complete FieldCount.
    pub fn fields_block(&mut self, block: &[u8]) -> Result<(), EncodeError> {
        self.begin_value()?;
        // In a delta frame the FieldIndex is already written.
        if self.buf.len() != self.count_at + 2 {
            return Err(EncodeError::Misplaced("block of fields after a field"));
        }
        let Some(count) = block.first_chunk() else {
            return Err(EncodeError::Misplaced(
                "block of fields without a FieldCount",
            ));
        };
        self.fields = u16::from_le_bytes(*count).into();
        self.buf.truncate(self.count_at);
        self.buf.extend_from_slice(block);
        Ok(())
    }

    /// Finishes the key frame.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] with an open structure or array; [`EncodeError::TooBig`] above
    /// 65535 fields or, with several DataSetMessages, above 65535 bytes.
    #[inline]
    pub fn finish(self) -> Result<(), EncodeError> {
        if self.wanted != 0 {
            return Err(ELEMENTS_WANTED);
        }
        if self.depth != 0 {
            return Err(EncodeError::Misplaced(
                "end of the message inside a structure",
            ));
        }
        let count = u16::try_from(self.fields).map_err(|_| EncodeError::TooBig {
            what: "FieldCount",
            len: self.fields,
        })?;
        writer::patch(self.buf, self.count_at, count.to_le_bytes());
        self.progress.message_finished(self.buf)
    }

    /// Counts a value that starts a field, except inside a structure.
    #[inline]
    const fn begin_value(&mut self) -> Result<(), EncodeError> {
        if self.wanted != 0 {
            return Err(ELEMENTS_WANTED);
        }
        if self.depth == 0 {
            self.fields += 1;
        }
        Ok(())
    }

    #[inline]
    fn begin_array(&mut self, element: BuiltinType, count: usize) -> Result<(), EncodeError> {
        let [a, b, c, d] = writer::int32_length(count, "array")?;
        self.begin_value()?;
        match self.depth {
            0 => self
                .buf
                .extend_from_slice(&[element.id() | variant::ARRAY, a, b, c, d]),
            _ => self.buf.extend_from_slice(&[a, b, c, d]),
        }
        Ok(())
    }
}

/// Appends tagged values. With a constant size, each value compiles to a few moves.
#[inline]
fn push_tagged<const N: usize>(buf: &mut Vec<u8>, id: u8, bytes: &[u8]) {
    let (values, _) = bytes.as_chunks::<N>();
    for value in values {
        buf.push(id);
        buf.extend_from_slice(value);
    }
}

impl<'m> DeltaEncoder<'m> {
    pub(crate) const fn new(fields: FieldEncoder<'m>) -> Self {
        Self { fields, indexes: 0 }
    }

    /// Starts the changed field at an index in the DataSetMetaData; exactly a single value has to
    /// be written to it.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] if the previous field does not have exactly a single value.
    pub fn field(&mut self, index: u16) -> Result<&mut FieldEncoder<'m>, EncodeError> {
        self.check()?;
        self.fields.buf.extend_from_slice(&index.to_le_bytes());
        self.indexes += 1;
        Ok(&mut self.fields)
    }

    /// Finishes the delta frame.
    ///
    /// # Errors
    /// As for [`field`](Self::field) and [`FieldEncoder::finish`].
    pub fn finish(self) -> Result<(), EncodeError> {
        self.check()?;
        self.fields.finish()
    }

    const fn check(&self) -> Result<(), EncodeError> {
        let open = self.fields.wanted != 0 || self.fields.depth != 0;
        if open || self.fields.fields != self.indexes {
            return Err(EncodeError::Misplaced(
                "a changed field without exactly one value",
            ));
        }
        Ok(())
    }
}

impl<'m> DataValueEncoder<'m> {
    pub(crate) const fn new(fields: FieldEncoder<'m>, delta: bool) -> Self {
        Self { fields, delta }
    }

    /// Appends the next field of a key frame.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] in a delta frame; [`EncodeError::TooBig`] as for
    /// [`FieldEncoder::scalar`].
    pub fn value(&mut self, value: &DataValue<'_>) -> Result<(), EncodeError> {
        if self.delta {
            return Err(EncodeError::Misplaced(
                "a value without index in a delta frame",
            ));
        }
        self.fields.begin_value()?;
        value.write(self.fields.buf)
    }

    /// Appends a changed field of a delta frame, by its index in the DataSetMetaData.
    ///
    /// # Errors
    /// [`EncodeError::Misplaced`] in a key frame; [`EncodeError::TooBig`] as for
    /// [`FieldEncoder::scalar`].
    pub fn changed(&mut self, index: u16, value: &DataValue<'_>) -> Result<(), EncodeError> {
        if !self.delta {
            return Err(EncodeError::Misplaced("an index in a key frame"));
        }
        self.fields.begin_value()?;
        self.fields.buf.extend_from_slice(&index.to_le_bytes());
        value.write(self.fields.buf)
    }

    /// Finishes the frame.
    ///
    /// # Errors
    /// As for [`FieldEncoder::finish`].
    pub fn finish(self) -> Result<(), EncodeError> {
        self.fields.finish()
    }
}

const ELEMENTS_WANTED: EncodeError = EncodeError::Misplaced("an open array wants more elements");
const NO_ARRAY: EncodeError = EncodeError::Misplaced("element without an open array");
const NO_STRUCTURE: EncodeError =
    EncodeError::Misplaced("end of a structure none of which is open");
