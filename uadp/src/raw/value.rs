//! Decoded values of RawData fields.

use super::read::read_element;
use super::{Form, RawField};
use crate::reader::ByteReader;
use crate::{BuiltinType, Scalar, Variant};

/// Value of a field.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RawValue<'a> {
    /// A single value, or an array or matrix of contiguous elements.
    ///
    /// A structure is an ExtensionObject. Its body is the encoded fields, including padding.
    /// [`RawStructure::members`](super::RawStructure::members) decodes them, and
    /// [`RawStructure::to_plain`](super::RawStructure::to_plain) converts them to the body of
    /// OPC 10000-6.
    Variant(Variant<'a>),
    /// An array or matrix of structures or padded texts.
    Array(RawArray<'a>),
}

/// An array or matrix of structures or padded texts, which an [`Array`](crate::Array) cannot
/// borrow. The elements were checked by the decoder.
///
/// Equality compares the elements and dimensions.
#[derive(Debug, Clone, Copy)]
pub struct RawArray<'a> {
    pub(super) field: &'a RawField<'a>,
    pub(super) form: Form,
    pub(super) null: bool,
    pub(super) len: usize,
    /// Empty for a one-dimensional array.
    pub(super) dimensions: &'a [[u8; 4]],
    pub(super) bytes: &'a [u8],
}

/// Iterator over the elements of a [`RawArray`].
#[derive(Debug, Clone)]
pub struct RawElements<'a> {
    field: &'a RawField<'a>,
    form: Form,
    left: usize,
    reader: ByteReader<'a>,
}

impl<'a> RawValue<'a> {
    /// Returns the type of the value or of the elements, or `None` for the null Variant, which is
    /// never decoded.
    #[must_use]
    pub const fn builtin_type(&self) -> Option<BuiltinType> {
        match self {
            Self::Variant(variant) => variant.builtin_type(),
            Self::Array(array) => Some(array.element()),
        }
    }

    /// Returns the value as a Variant, or `None` for an array of structures or padded texts.
    #[must_use]
    pub const fn variant(self) -> Option<Variant<'a>> {
        match self {
            Self::Variant(variant) => Some(variant),
            Self::Array(_) => None,
        }
    }
}

impl<'a> From<Variant<'a>> for RawValue<'a> {
    fn from(variant: Variant<'a>) -> Self {
        Self::Variant(variant)
    }
}

impl<'a> RawArray<'a> {
    /// Returns the type of the elements: String, ByteString or ExtensionObject.
    #[must_use]
    pub const fn element(&self) -> BuiltinType {
        self.field.builtin
    }

    /// Returns the number of elements, 0 for the null array.
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

    /// Returns the size of each dimension of a matrix, outermost first; empty for a one-dimensional
    /// array.
    #[must_use]
    pub fn dimensions(&self) -> impl ExactSizeIterator<Item = u32> + Clone + use<'a> {
        self.dimensions.iter().map(|size| u32::from_le_bytes(*size))
    }

    /// Returns an iterator over the elements; row-major for a matrix.
    #[must_use]
    pub const fn iter(&self) -> RawElements<'a> {
        RawElements {
            field: self.field,
            form: self.form,
            left: self.len,
            reader: ByteReader::new(self.bytes),
        }
    }
}

impl PartialEq for RawArray<'_> {
    fn eq(&self, other: &Self) -> bool {
        self.element() == other.element()
            && self.null == other.null
            && self.dimensions == other.dimensions
            && self.iter().eq(other.iter())
    }
}

impl<'a> IntoIterator for RawArray<'a> {
    type Item = Scalar<'a>;
    type IntoIter = RawElements<'a>;

    fn into_iter(self) -> RawElements<'a> {
        self.iter()
    }
}

impl<'a> IntoIterator for &RawArray<'a> {
    type Item = Scalar<'a>;
    type IntoIter = RawElements<'a>;

    fn into_iter(self) -> RawElements<'a> {
        self.iter()
    }
}

impl<'a> Iterator for RawElements<'a> {
    type Item = Scalar<'a>;

    fn next(&mut self) -> Option<Scalar<'a>> {
        self.left = self.left.checked_sub(1)?;
        // The elements were checked when the array was decoded, so this does not fail.
        read_element(self.field, self.form, &mut self.reader).ok()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (self.left, Some(self.left))
    }
}

impl ExactSizeIterator for RawElements<'_> {}
