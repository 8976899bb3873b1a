use uadp::{BuiltinType, Scalar};

use crate::{SourceError, TypeName};

/// Receives the fields of a message, in the order of
/// [`MessagePlan::leaves`](crate::MessagePlan::leaves).
///
/// A field is one of these sequences of calls:
///
/// - `scalar`
/// - `packed_array`
/// - `array` and then the announced number of calls of `element`
/// - the begin and end of a structure
/// - `structures` and then the announced number of structures
pub trait FieldSink {
    /// Reason for which a value is refused.
    type Error;

    /// Receives a single value.
    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), Self::Error>;

    /// Receives several fields of a single number each: `bytes` are the values, little endian,
    /// without gaps.
    ///
    /// Returns whether the fields were accepted; otherwise each field is passed to `scalar`. A sink
    /// without an advantage from this method need not implement it.
    fn scalars(&mut self, builtin: BuiltinType, bytes: &[u8]) -> Result<bool, Self::Error> {
        let _ = (builtin, bytes);
        Ok(false)
    }

    /// Receives an array of numbers or Booleans, which may be empty: `bytes` are `count` elements,
    /// little endian, without gaps.
    fn packed_array(
        &mut self,
        element: BuiltinType,
        count: usize,
        bytes: &[u8],
    ) -> Result<(), Self::Error>;

    /// Opens an array of `count` strings, DateTimes or (durations) Doubles.
    ///
    /// Inside a structure it may also be of ExtensionObject: the array of `count` messages of a
    /// message in an array. It is followed not by elements but by the fields of each message
    /// inline, in sequence, without `begin_structure` and `end_structure`: a structure of
    /// OPC UA contains structures by value.
    fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), Self::Error>;

    /// Receives an element of the array opened last.
    fn element(&mut self, value: Scalar<'_>) -> Result<(), Self::Error>;

    /// Opens an array of `count` structures of the message type `of`.
    ///
    /// The fields of the message follow inline, in order. The fields of a nested message are passed
    /// like the message's own fields, and nested arrays of messages as described in
    /// [`FieldSink::array`].
    fn structures(&mut self, of: &TypeName, count: usize) -> Result<(), Self::Error>;

    /// Begins the next structure of an array, or a field that is a structure.
    fn begin_structure(&mut self, of: &TypeName) -> Result<(), Self::Error>;

    /// Ends the structure.
    fn end_structure(&mut self) -> Result<(), Self::Error>;
}

/// Supplies the fields of a message, in the order of
/// [`MessagePlan::leaves`](crate::MessagePlan::leaves): the mirror of [`FieldSink`].
///
/// An implementation returns exactly the requested builtin type or an error; it may convert values.
/// A null array or text counts as empty.
pub trait FieldSupplier<'a> {
    /// Returns the next field, or inside a structure the next value, as a scalar of `expected`.
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError>;

    /// Appends the next `count` fields, of a single number each, to `out`, little endian, without
    /// gaps.
    ///
    /// Returns false if no field was consumed; then each field is requested with `scalar`, which
    /// reports the error. A source without an advantage from this method need not implement it.
    fn scalars(&mut self, expected: BuiltinType, count: u16, out: &mut Vec<u8>) -> bool {
        let _ = (expected, count, out);
        false
    }

    /// Returns the next field as an array of fixed-size elements: their count, and the elements
    /// little endian without gaps.
    fn packed_array(&mut self, expected: BuiltinType) -> Result<(usize, &'a [u8]), SourceError>;

    /// Opens the next field as an array, to be read by [`FieldSupplier::element`], and returns its
    /// length.
    ///
    /// ExtensionObject occurs only inside a structure: see [`FieldSink::array`].
    fn array(&mut self, expected: BuiltinType) -> Result<usize, SourceError>;

    /// Returns the next element of the array opened last.
    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError>;

    /// Opens the next field as an array of structures and returns its length.
    fn structures(&mut self) -> Result<usize, SourceError>;

    /// Begins the next field, which is a structure. A source without structures need not
    /// implement it.
    fn structure(&mut self) -> Result<(), SourceError> {
        Err(SourceError::Missing)
    }

    /// Begins the next structure of an array.
    fn begin_structure(&mut self) -> Result<(), SourceError>;

    /// Ends the structure; fails if it holds more values than were read.
    fn end_structure(&mut self) -> Result<(), SourceError>;

    /// Fails if a field is left over.
    fn finish(&mut self) -> Result<(), SourceError>;
}

/// A [`FieldSupplier`] without fields, for messages of constants alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoFields;

impl<'a> FieldSupplier<'a> for NoFields {
    fn scalar(&mut self, _expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        Err(SourceError::Missing)
    }

    fn packed_array(&mut self, _expected: BuiltinType) -> Result<(usize, &'a [u8]), SourceError> {
        Err(SourceError::Missing)
    }

    fn array(&mut self, _expected: BuiltinType) -> Result<usize, SourceError> {
        Err(SourceError::Missing)
    }

    fn element(&mut self, _expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        Err(SourceError::Missing)
    }

    fn structures(&mut self) -> Result<usize, SourceError> {
        Err(SourceError::Missing)
    }

    fn begin_structure(&mut self) -> Result<(), SourceError> {
        Err(SourceError::Missing)
    }

    fn end_structure(&mut self) -> Result<(), SourceError> {
        Err(SourceError::Missing)
    }

    fn finish(&mut self) -> Result<(), SourceError> {
        Ok(())
    }
}
