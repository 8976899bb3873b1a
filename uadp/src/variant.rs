//! Variant: a value with its type, or an array of values in one or more dimensions.

use crate::nested::Depth;
use crate::reader::ByteReader;
use crate::scalar::Scalar;
use crate::{BuiltinType, DecodeError, EncodeError, writer};
use alloc::vec::Vec;

/// Value of a field (OPC 10000-6, 5.2.2.16).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Variant<'a> {
    /// No value and no type: encoding byte 0.
    Null,
    /// A single value.
    Scalar(Scalar<'a>),
    /// A one-dimensional array, which may be null or empty.
    Array(Array<'a>),
    /// An array with dimensions.
    Matrix(Matrix<'a>),
}

/// A multi-dimensional array (OPC 10000-6, 5.2.2.16). The number of elements is the product of the
/// dimensions.
///
/// A matrix with fewer than two dimensions, or without elements, is encoded as an [`Array`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Matrix<'a> {
    elements: Array<'a>,
    dimensions: &'a [[u8; 4]],
}

/// A one-dimensional array. Its elements were checked when it was created.
///
/// Equality compares the encoded elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Array<'a> {
    element: BuiltinType,
    null: bool,
    len: usize,
    bytes: &'a [u8],
}

/// Iterator over the elements of an [`Array`].
///
/// Elements that contain values are skipped through to find the next element.
#[derive(Debug, Clone)]
pub struct Elements<'a> {
    element: BuiltinType,
    left: usize,
    reader: ByteReader<'a>,
}

impl<'a> Variant<'a> {
    /// Returns the type of the value or of the elements, or `None` for the null Variant.
    #[must_use]
    pub const fn builtin_type(&self) -> Option<BuiltinType> {
        match self {
            Self::Null => None,
            Self::Scalar(scalar) => Some(scalar.builtin_type()),
            Self::Array(array) => Some(array.element),
            Self::Matrix(matrix) => Some(matrix.elements.element),
        }
    }

    #[inline]
    pub(crate) fn read(reader: &mut ByteReader<'a>) -> Result<Self, DecodeError> {
        Self::read_at(reader, Depth::FULL)
    }

    /// Decodes a nested Variant as [`read`](Self::read).
    #[inline]
    pub(crate) fn read_at(reader: &mut ByteReader<'a>, depth: Depth) -> Result<Self, DecodeError> {
        let encoding = reader.u8("Variant")?;
        let builtin = match BuiltinType::from_id(encoding & TYPE_ID) {
            Some(builtin) => builtin,
            None => match Self::without_type(encoding)? {
                Some(builtin) => builtin,
                None => return Ok(Self::Null),
            },
        };
        match encoding & !TYPE_ID {
            0 if builtin == BuiltinType::Variant => Err(VARIANT_IN_VARIANT),
            0 => Scalar::read_at(builtin, reader, depth).map(Self::Scalar),
            ARRAY => Array::read_at(builtin, reader, depth).map(Self::Array),
            MATRIX => Matrix::read_at(builtin, reader, depth).map(Self::Matrix),
            _ => Err(DecodeError::Reserved {
                field: "Variant encoding",
                value: encoding.into(),
            }),
        }
    }

    /// Skips and checks a Variant.
    #[inline]
    pub(crate) fn skip_at(reader: &mut ByteReader<'a>, depth: Depth) -> Result<(), DecodeError> {
        let encoding = reader.rest().first().copied().unwrap_or_default();
        let size = match (encoding, BuiltinType::from_id(encoding)) {
            (0, _) => Some(0),
            (_, Some(builtin)) => builtin.fixed_size(),
            (_, None) => None,
        };
        match size {
            Some(size) if reader.bytes(1 + size, "Variant").is_ok() => Ok(()),
            _ => Self::read_at(reader, depth).map(|_| ()),
        }
    }

    /// Returns the type of a Variant with an unassigned type id, or `None` for the null Variant.
    #[cold]
    fn without_type(encoding: u8) -> Result<Option<BuiltinType>, DecodeError> {
        match encoding {
            0 => Ok(None),
            // Decoders treat values of unassigned types as ByteStrings (OPC 10000-6, 5.2.2.16).
            _ if matches!(encoding & TYPE_ID, 26..=31) => Ok(Some(BuiltinType::ByteString)),
            _ => Err(DecodeError::Reserved {
                field: "Variant encoding",
                value: encoding.into(),
            }),
        }
    }

    #[inline]
    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        match self {
            Self::Null => {
                out.push(0);
                Ok(())
            }
            Self::Scalar(scalar) => scalar.write::<true>(out),
            Self::Array(array) => {
                out.push(array.element.id() | ARRAY);
                array.write(out)
            }
            Self::Matrix(matrix) => {
                let form = if matrix.has_dimensions() {
                    MATRIX
                } else {
                    ARRAY
                };
                out.push(matrix.elements.element.id() | form);
                matrix.write(out)
            }
        }
    }
}

impl<'a> From<Scalar<'a>> for Variant<'a> {
    fn from(scalar: Scalar<'a>) -> Self {
        Self::Scalar(scalar)
    }
}

impl<'a> From<Array<'a>> for Variant<'a> {
    fn from(array: Array<'a>) -> Self {
        Self::Array(array)
    }
}

impl<'a> From<Matrix<'a>> for Variant<'a> {
    fn from(matrix: Matrix<'a>) -> Self {
        Self::Matrix(matrix)
    }
}

impl<'a> Matrix<'a> {
    /// Creates a matrix of elements in row-major order. Each dimension is a little-endian Int32,
    /// outermost first.
    ///
    /// # Errors
    /// [`DecodeError::Dimensions`] if the product of the dimensions differs from the number of
    /// elements, or a dimension is negative.
    pub fn new(elements: Array<'a>, dimensions: &'a [[u8; 4]]) -> Result<Self, DecodeError> {
        let elements_wanted = dimensions.iter().try_fold(1_usize, |product, dimension| {
            let dimension = usize::try_from(i32::from_le_bytes(*dimension)).ok()?;
            product.checked_mul(dimension)
        });
        // Empty dimensions are valid for an empty or null array, and for an array with a single
        // element.
        match elements_wanted {
            Some(wanted) if wanted == elements.len => Ok(Self {
                elements,
                dimensions,
            }),
            _ if dimensions.is_empty() && elements.is_empty() => Ok(Self {
                elements,
                dimensions,
            }),
            _ => Err(DecodeError::Dimensions {
                elements: elements.len,
            }),
        }
    }

    /// Returns the elements in row-major order.
    #[inline]
    #[must_use]
    pub const fn elements(&self) -> Array<'a> {
        self.elements
    }

    /// Returns the size of each dimension, outermost first.
    #[must_use]
    pub fn dimensions(&self) -> impl ExactSizeIterator<Item = u32> + Clone + use<'a> {
        self.dimensions.iter().map(|size| u32::from_le_bytes(*size))
    }

    /// Reads the array of elements, then the array of dimensions.
    fn read_at(
        element: BuiltinType,
        reader: &mut ByteReader<'a>,
        depth: Depth,
    ) -> Result<Self, DecodeError> {
        // Only decoding the elements reveals where the dimensions start.
        let depth = match depth {
            Depth::Checked => Depth::FULL,
            left @ Depth::Left(_) => left,
        };
        let elements = Array::read_at(element, reader, depth)?;
        let count = reader.length("ArrayDimensions")?.unwrap_or_default();
        let (dimensions, _) = match count.checked_mul(4) {
            Some(size) => reader.bytes(size, "ArrayDimensions")?.as_chunks(),
            None => {
                return Err(DecodeError::Dimensions {
                    elements: elements.len,
                });
            }
        };
        Self::new(elements, dimensions)
    }

    /// Returns true if ArrayDimensions are encoded: only for two or more dimensions, all of them
    /// non-empty (OPC 10000-6, 5.2.2.16).
    const fn has_dimensions(&self) -> bool {
        self.dimensions.len() >= 2 && !self.elements.is_empty()
    }

    fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        self.elements.write(out)?;
        if !self.has_dimensions() {
            return Ok(());
        }
        let count = writer::int32_length(self.dimensions.len(), "ArrayDimensions")?;
        out.extend_from_slice(&count);
        out.extend_from_slice(self.dimensions.as_flattened());
        Ok(())
    }
}

impl<'a> Array<'a> {
    /// Creates the null array, which differs from the empty array.
    #[must_use]
    pub const fn null(element: BuiltinType) -> Self {
        Self {
            element,
            null: true,
            len: 0,
            bytes: &[],
        }
    }

    /// Creates an array of `len` elements from their contiguous encodings.
    ///
    /// # Errors
    /// Fails if the bytes are not exactly `len` well-formed elements.
    pub fn new(element: BuiltinType, len: usize, bytes: &'a [u8]) -> Result<Self, DecodeError> {
        let mut reader = ByteReader::new(bytes);
        let array = Self::read_elements(element, len, &mut reader, Depth::FULL)?;
        match reader.remaining() {
            0 => Ok(array),
            left => Err(DecodeError::TrailingBytes(left)),
        }
    }

    /// Returns the type of the elements.
    #[inline]
    #[must_use]
    pub const fn element(&self) -> BuiltinType {
        self.element
    }

    /// Returns the number of elements, 0 for the null array.
    #[inline]
    #[must_use]
    pub const fn len(&self) -> usize {
        self.len
    }

    /// Returns true for the null array and the empty array.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Returns true for the null array (length -1 on the wire).
    #[must_use]
    pub const fn is_null(&self) -> bool {
        self.null
    }

    /// Returns the encoded elements without the length: little-endian and contiguous.
    #[inline]
    #[must_use]
    pub const fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    /// Returns an iterator over the elements.
    #[inline]
    #[must_use]
    pub const fn iter(&self) -> Elements<'a> {
        Elements {
            element: self.element,
            left: self.len,
            reader: ByteReader::new(self.bytes),
        }
    }

    /// Reads an Int32 length and the elements (OPC 10000-6, 5.2.5).
    pub(crate) fn read(
        element: BuiltinType,
        reader: &mut ByteReader<'a>,
    ) -> Result<Self, DecodeError> {
        Self::read_at(element, reader, Depth::FULL)
    }

    fn read_at(
        element: BuiltinType,
        reader: &mut ByteReader<'a>,
        depth: Depth,
    ) -> Result<Self, DecodeError> {
        match reader.length("array length")? {
            Some(len) => Self::read_elements(element, len, reader, depth),
            None => Ok(Self::null(element)),
        }
    }

    fn read_elements(
        element: BuiltinType,
        len: usize,
        reader: &mut ByteReader<'a>,
        depth: Depth,
    ) -> Result<Self, DecodeError> {
        let limit = DecodeError::Limit {
            field: "array length",
            value: u32::try_from(len).unwrap_or(u32::MAX),
        };
        let least = len.checked_mul(element.min_size()).ok_or(limit)?;
        if least > reader.remaining() {
            return Err(limit);
        }
        let bytes = if element.fixed_size().is_some() {
            reader.bytes(least, "array")?
        } else if depth == Depth::Checked {
            reader.take_rest()
        } else {
            let before = *reader;
            Scalar::skip(element, len, reader, depth)?;
            reader.since(&before)
        };
        Ok(Self {
            element,
            null: false,
            len,
            bytes,
        })
    }

    /// Appends the Int32 length and the elements.
    pub(crate) fn write(&self, out: &mut Vec<u8>) -> Result<(), EncodeError> {
        let length = if self.null {
            writer::NULL_LENGTH
        } else {
            writer::int32_length(self.len, "array")?
        };
        out.reserve(length.len() + self.bytes.len());
        out.extend_from_slice(&length);
        out.extend_from_slice(self.bytes);
        Ok(())
    }
}

impl<'a> IntoIterator for Array<'a> {
    type Item = Scalar<'a>;
    type IntoIter = Elements<'a>;

    fn into_iter(self) -> Elements<'a> {
        self.iter()
    }
}

impl<'a> IntoIterator for &Array<'a> {
    type Item = Scalar<'a>;
    type IntoIter = Elements<'a>;

    fn into_iter(self) -> Elements<'a> {
        self.iter()
    }
}

impl<'a> Iterator for Elements<'a> {
    type Item = Scalar<'a>;

    #[inline]
    fn next(&mut self) -> Option<Scalar<'a>> {
        self.left = self.left.checked_sub(1)?;
        let depth = match self.left {
            0 => Depth::Checked,
            _ => Depth::FULL,
        };
        // The elements were checked when the array was created, so this does not fail.
        Scalar::read_at(self.element, &mut self.reader, depth).ok()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (self.left, Some(self.left))
    }
}

impl ExactSizeIterator for Elements<'_> {}

const VARIANT_IN_VARIANT: DecodeError = DecodeError::Reserved {
    field: "Variant directly in a Variant",
    value: 24,
};

/// Bits 0 to 5 of the encoding byte.
const TYPE_ID: u8 = 0x3F;
/// Bit 7: the value is an array.
pub(crate) const ARRAY: u8 = 0x80;
/// Bits 7 and 6: dimensions follow the elements.
pub(crate) const MATRIX: u8 = 0xC0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dimensions_are_written_of_two_or_more_that_hold_elements() {
        let written = |elements: &[u8], dimensions: &[i32]| {
            let dimensions: Vec<_> = dimensions.iter().map(|size| size.to_le_bytes()).collect();
            let elements = Array::new(BuiltinType::Byte, elements.len(), elements).unwrap();
            let matrix = Matrix::new(elements, &dimensions).unwrap();
            let mut out = Vec::new();
            Variant::from(matrix).write(&mut out).unwrap();
            out
        };
        let two = [
            &[0xC3, 2, 0, 0, 0, 7, 8][..],
            &[2, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0],
        ];
        assert_eq!(written(&[7, 8], &[1, 2]), two.concat());
        assert_eq!(written(&[7, 8], &[2]), [0x83, 2, 0, 0, 0, 7, 8]);
        assert_eq!(written(&[], &[0, 3]), [0x83, 0, 0, 0, 0]);
    }
}
