use uadp::{BuiltinType, Scalar};

use crate::{SourceError, TypeName};

/// Takes the fields of a message, in the order of [`Plan::leaves`](crate::Plan::leaves).
///
/// A field is one call of `scalar`; or one of `packed_array`; or `array` and then as many calls of `element` as it said;
/// or one begun and ended structure; or `structures` and then as many of those as it said.
pub trait Sink {
    /// Why a value is refused.
    type Error;

    /// A single value.
    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), Self::Error>;

    /// Several fields of a single number each: `bytes` are the values, little endian, without gaps.
    ///
    /// Returns whether they were taken; where they were not, each comes as a call of `scalar`. A sink for which that is as
    /// good leaves this out.
    fn scalars(&mut self, builtin: BuiltinType, bytes: &[u8]) -> Result<bool, Self::Error> {
        let _ = (builtin, bytes);
        Ok(false)
    }

    /// An array of numbers, Booleans or none: `bytes` are `count` elements, little endian, without gaps.
    fn packed_array(
        &mut self,
        element: BuiltinType,
        count: usize,
        bytes: &[u8],
    ) -> Result<(), Self::Error>;

    /// Opens an array of `count` strings, DateTimes or (durations) Doubles.
    ///
    /// Inside a structure it may also be of ExtensionObject: the array of `count` messages of a message in an array.
    /// What follows are then not elements but the fields of each of them inline, one after the other, without
    /// `begin_structure` and `end_structure`: a structure of OPC UA contains structures by value.
    fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), Self::Error>;

    /// An element of the array opened last.
    fn element(&mut self, value: Scalar<'_>) -> Result<(), Self::Error>;

    /// Opens an array of `count` structures of the message type `of`.
    ///
    /// The fields of the message come inline, in order: those of messages in it as if they were its own, arrays of
    /// messages in it as [`Sink::array`] says.
    fn structures(&mut self, of: &TypeName, count: usize) -> Result<(), Self::Error>;

    /// Begins the next of the structures, or a field that is one.
    fn begin_structure(&mut self, of: &TypeName) -> Result<(), Self::Error>;

    /// Ends it.
    fn end_structure(&mut self) -> Result<(), Self::Error>;
}

/// Gives the fields of a message, in the order of [`Plan::leaves`](crate::Plan::leaves): the mirror of [`Sink`].
///
/// An implementation answers with just the builtin type asked for or errs; whether it converts is its own affair. An
/// array or text that is null counts as empty.
pub trait Source<'a> {
    /// The next field, or inside a structure the next value, as a scalar of `expected`.
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError>;

    /// The next `count` fields, of a single number each: appends the values to `out`, little endian, without gaps.
    ///
    /// Returns whether it did; where it did not, nothing was taken, and each is asked for with `scalar`, which says what is
    /// wrong with it. A source for which that is as good leaves this out.
    fn scalars(&mut self, expected: BuiltinType, count: u16, out: &mut Vec<u8>) -> bool {
        let _ = (expected, count, out);
        false
    }

    /// The next field as an array of fixed-size elements: their count, and the elements little endian without gaps.
    fn packed_array(&mut self, expected: BuiltinType) -> Result<(usize, &'a [u8]), SourceError>;

    /// Opens the next field as an array, to be read by [`Source::element`], and tells its length.
    ///
    /// Of ExtensionObject only inside a structure: see [`Sink::array`].
    fn array(&mut self, expected: BuiltinType) -> Result<usize, SourceError>;

    /// The next element of the array opened last.
    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError>;

    /// Opens the next field as an array of structures and tells its length.
    fn structures(&mut self) -> Result<usize, SourceError>;

    /// Begins the next field, which is one structure. A source that has none leaves this out.
    fn structure(&mut self) -> Result<(), SourceError> {
        Err(SourceError::Missing)
    }

    /// Begins the next of the structures.
    fn begin_structure(&mut self) -> Result<(), SourceError>;

    /// Ends it; errs when it holds more than was read.
    fn end_structure(&mut self) -> Result<(), SourceError>;

    /// Errs when a field is left over.
    fn finish(&mut self) -> Result<(), SourceError>;
}

/// A [`Source`] of no field, for messages of constants alone.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoFields;

impl<'a> Source<'a> for NoFields {
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
