//! Arrays of structures and values that are decoded element by element, or encoded from a slice.

use alloc::vec::Vec;
use core::fmt;
use core::marker::PhantomData;

use super::wire::WireStructure;
use crate::reader::ByteReader;
use crate::{DecodeError, EncodeError, writer};

/// An array of a message (OPC 10000-6, 5.2.5), which may be null.
///
/// A decoded array consists of the checked bytes of its elements: it allocates nothing, and each
/// iteration decodes the elements again. An array to encode borrows a slice. Equality compares the
/// elements; the null array equals only the null array.
pub struct WireArray<'a, T> {
    elements: Elements<'a, T>,
}

enum Elements<'a, T> {
    Null,
    Wire {
        count: usize,
        bytes: &'a [u8],
        element: PhantomData<fn() -> T>,
    },
    Slice(&'a [T]),
}

/// Iterator over the elements of a [`WireArray`].
pub struct ListIter<'a, T> {
    step: Step<'a, T>,
}

enum Step<'a, T> {
    Wire {
        left: usize,
        reader: ByteReader<'a>,
        element: PhantomData<fn() -> T>,
    },
    Slice(core::slice::Iter<'a, T>),
}

impl<'a, T> WireArray<'a, T> {
    /// Creates the null array, which differs from the empty array.
    #[must_use]
    pub const fn null() -> Self {
        Self {
            elements: Elements::Null,
        }
    }

    /// Creates an array of the elements of a slice.
    #[must_use]
    pub const fn new(elements: &'a [T]) -> Self {
        Self {
            elements: Elements::Slice(elements),
        }
    }

    /// Returns the number of elements, 0 for the null array.
    #[must_use]
    pub const fn len(&self) -> usize {
        match self.elements {
            Elements::Null => 0,
            Elements::Wire { count, .. } => count,
            Elements::Slice(elements) => elements.len(),
        }
    }

    /// Returns true for the null array and the empty array.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns true for the null array (length -1 on the wire).
    #[must_use]
    pub const fn is_null(&self) -> bool {
        matches!(self.elements, Elements::Null)
    }

    /// Returns an iterator over the elements.
    #[must_use]
    pub fn iter(&self) -> ListIter<'a, T> {
        ListIter {
            step: match self.elements {
                Elements::Null => Step::Slice([].iter()),
                Elements::Wire { count, bytes, .. } => Step::Wire {
                    left: count,
                    reader: ByteReader::new(bytes),
                    element: PhantomData,
                },
                Elements::Slice(elements) => Step::Slice(elements.iter()),
            },
        }
    }
}

#[expect(
    private_bounds,
    reason = "the builtin types and structures of this crate are all elements there are"
)]
impl<'a, T: WireStructure<'a>> WireArray<'a, T> {
    /// Returns the element at an index. In a decoded array, all elements before the index are
    /// decoded too.
    #[must_use]
    pub fn get(&self, index: usize) -> Option<T> {
        match self.elements {
            Elements::Null => None,
            Elements::Wire { .. } => self.iter().nth(index),
            Elements::Slice(elements) => elements.get(index).copied(),
        }
    }
}

impl<'a, T: WireStructure<'a>> WireStructure<'a> for WireArray<'a, T> {
    const NULL: Self = Self::null();
    const MIN_SIZE: usize = 4;

    fn read(reader: &mut ByteReader<'a>, what: &'static str) -> Result<Self, DecodeError> {
        let Some(count) = reader.length(what)? else {
            return Ok(Self::null());
        };
        let least = count.checked_mul(T::MIN_SIZE);
        if least.is_none_or(|least| least > reader.remaining()) {
            return Err(DecodeError::Limit {
                field: what,
                value: u32::try_from(count).unwrap_or(u32::MAX),
            });
        }
        let before = *reader;
        for _ in 0..count {
            T::read(reader, what)?;
        }
        Ok(Self {
            elements: Elements::Wire {
                count,
                bytes: reader.since(&before),
                element: PhantomData,
            },
        })
    }

    fn write(&self, out: &mut Vec<u8>, what: &'static str) -> Result<(), EncodeError> {
        match self.elements {
            Elements::Null => out.extend_from_slice(&writer::NULL_LENGTH),
            Elements::Wire { count, bytes, .. } => {
                out.extend_from_slice(&writer::int32_length(count, what)?);
                out.extend_from_slice(bytes);
            }
            Elements::Slice(elements) => {
                out.extend_from_slice(&writer::int32_length(elements.len(), what)?);
                for element in elements {
                    element.write(out, what)?;
                }
            }
        }
        Ok(())
    }
}

impl<T> Clone for WireArray<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for WireArray<'_, T> {}

impl<T> Clone for Elements<'_, T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Elements<'_, T> {}

/// The null array.
impl<T> Default for WireArray<'_, T> {
    fn default() -> Self {
        Self::null()
    }
}

impl<'a, T> From<&'a [T]> for WireArray<'a, T> {
    fn from(elements: &'a [T]) -> Self {
        Self::new(elements)
    }
}

impl<'a, T, const N: usize> From<&'a [T; N]> for WireArray<'a, T> {
    fn from(elements: &'a [T; N]) -> Self {
        Self::new(elements)
    }
}

impl<'a, T: WireStructure<'a> + PartialEq> PartialEq for WireArray<'a, T> {
    fn eq(&self, other: &Self) -> bool {
        self.is_null() == other.is_null()
            && self.len() == other.len()
            && self.iter().eq(other.iter())
    }
}

impl<'a, T: WireStructure<'a> + fmt::Debug> fmt::Debug for WireArray<'a, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.elements {
            Elements::Null => f.write_str("null"),
            Elements::Wire { .. } | Elements::Slice(_) => f.debug_list().entries(self).finish(),
        }
    }
}

impl<'a, T: WireStructure<'a>> IntoIterator for WireArray<'a, T> {
    type Item = T;
    type IntoIter = ListIter<'a, T>;

    fn into_iter(self) -> ListIter<'a, T> {
        self.iter()
    }
}

impl<'a, T: WireStructure<'a>> IntoIterator for &WireArray<'a, T> {
    type Item = T;
    type IntoIter = ListIter<'a, T>;

    fn into_iter(self) -> ListIter<'a, T> {
        self.iter()
    }
}

impl<'a, T: WireStructure<'a>> Iterator for ListIter<'a, T> {
    type Item = T;

    fn next(&mut self) -> Option<T> {
        match &mut self.step {
            Step::Wire { left, reader, .. } => {
                *left = left.checked_sub(1)?;
                // The elements were checked when the list was decoded, so this does not fail.
                T::read(reader, "array").ok()
            }
            Step::Slice(elements) => elements.next().copied(),
        }
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = match &self.step {
            Step::Wire { left, .. } => *left,
            Step::Slice(elements) => elements.len(),
        };
        (left, Some(left))
    }
}

impl<'a, T: WireStructure<'a>> ExactSizeIterator for ListIter<'a, T> {}

impl<T> Clone for ListIter<'_, T> {
    fn clone(&self) -> Self {
        let step = match &self.step {
            Step::Wire { left, reader, .. } => Step::Wire {
                left: *left,
                reader: *reader,
                element: PhantomData,
            },
            Step::Slice(elements) => Step::Slice(elements.clone()),
        };
        Self { step }
    }
}

impl<T> fmt::Debug for ListIter<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let left = match &self.step {
            Step::Wire { left, .. } => *left,
            Step::Slice(elements) => elements.len(),
        };
        f.debug_struct("ListIter")
            .field("left", &left)
            .finish_non_exhaustive()
    }
}
