//! Encoding: checks types and lengths against the layout, and pads values.

use super::layout::{Element, to_usize};
use super::read::StructureWalk;
use super::{Form, RawArray, RawDialect, RawField, RawLayout, RawStructure, RawStructureType};
use super::{RawValue, SCALAR};
use crate::reader::ByteReader;
use crate::{
    Array, BuiltinType, DecodeError, ExtensionBody, ExtensionObject, Scalar, Variant, writer,
};
use alloc::vec::Vec;

/// Reason why values were not encoded, and the field. The buffer is unchanged.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("field {field}: {fault}")]
pub struct RawWriteError {
    /// Index in the layout.
    pub field: usize,
    /// Fault of the value.
    pub fault: RawWriteFault,
}

/// Fault of a value for its field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RawWriteFault {
    /// There are fewer values than fields.
    #[error("no value")]
    NoValue,
    /// There are more values than fields.
    #[error("a value without a field")]
    NoField,
    /// The value has another type than the field, or is the null Variant, which RawData cannot
    /// encode.
    #[error("{} where {expected} is expected", found.map_or("null", BuiltinType::name))]
    Type {
        /// BuiltInType of the field.
        expected: BuiltinType,
        /// Type of the value; `None` for the null Variant.
        found: Option<BuiltinType>,
    },
    /// The value has another number of dimensions than the field.
    #[error("ValueRank {found} where {expected} is expected")]
    ValueRank {
        /// ValueRank of the field.
        expected: i32,
        /// ValueRank of the value.
        found: i32,
    },
    /// The text is longer than its MaxStringLength.
    #[error("{len} bytes where MaxStringLength is {most}")]
    MaxStringLength {
        /// MaxStringLength; 2^31-1 if there is no maximum.
        most: u32,
        /// Bytes of the text.
        len: usize,
    },
    /// A dimension is longer than its ArrayDimensions, or shorter in a dialect without padding.
    #[error("{len} elements where ArrayDimensions says {expected}")]
    ArrayDimensions {
        /// ArrayDimensions of this dimension; 2^31-1 without it.
        expected: u32,
        /// Elements of the dimension.
        len: usize,
    },
    /// The array is null, which the dialect cannot encode.
    #[error("a null array")]
    NullArray,
    /// The structure has another type than the field.
    #[error("a structure of another type")]
    StructureType,
    /// The body of the structure is missing or XML.
    #[error("a structure without a binary body")]
    NoBody,
    /// The body is not a valid body of the structure.
    #[error("not a structure: {0}")]
    Body(DecodeError),
}

/// Source and target form of structure bodies.
#[derive(Clone, Copy)]
struct Forms {
    from: Form,
    to: Form,
}

/// Elements of an array to encode.
enum Items<'a> {
    /// Structure bodies are in the form that the caller specifies.
    Array(Array<'a>),
    /// Structure bodies are in the form that they were decoded from.
    Read(RawArray<'a>),
}

impl RawLayout<'_> {
    /// Appends the payload of a key frame with a value per field: [`Variant`]s or the values of
    /// [`read`](Self::read).
    ///
    /// The body of a structure has to be in the form of the dialect, as [`read`](Self::read) in the
    /// same dialect returns it. [`RawStructure::from_plain`] converts the body of other
    /// ExtensionObjects.
    ///
    /// # Errors
    /// The first field with a value that does not fit. Values are not truncated: a text or array
    /// longer than its field is an error.
    pub fn write<'v, V: Into<RawValue<'v>>>(
        &self,
        buf: &mut Vec<u8>,
        dialect: RawDialect,
        values: impl IntoIterator<Item = V>,
    ) -> Result<(), RawWriteError> {
        let start = buf.len();
        let written = self.write_fields(buf, Form::of(dialect), values.into_iter());
        if written.is_err() {
            buf.truncate(start);
        }
        written
    }

    fn write_fields<'v, V: Into<RawValue<'v>>>(
        &self,
        buf: &mut Vec<u8>,
        form: Form,
        mut values: impl Iterator<Item = V>,
    ) -> Result<(), RawWriteError> {
        for (index, field) in self.fields().iter().enumerate() {
            let error = |fault| RawWriteError {
                field: index,
                fault,
            };
            let value = values.next().ok_or_else(|| error(RawWriteFault::NoValue))?;
            let forms = Forms {
                from: form.nested(),
                to: form,
            };
            write_field(field, forms, value.into(), buf).map_err(error)?;
        }
        match values.next() {
            None => Ok(()),
            Some(_) => Err(RawWriteError {
                field: self.fields().len(),
                fault: RawWriteFault::NoField,
            }),
        }
    }
}

impl RawStructure<'_> {
    /// Appends the body of an ExtensionObject (OPC 10000-6, 5.2.6 to 5.2.8), converted from a
    /// RawData body.
    ///
    /// # Errors
    /// [`RawWriteFault::Body`] if `body` is not a body of this structure. The buffer is then
    /// unchanged.
    pub fn to_plain(
        &self,
        body: &[u8],
        dialect: RawDialect,
        buf: &mut Vec<u8>,
    ) -> Result<(), RawWriteFault> {
        let from = Form::of(dialect).nested();
        let to = Form::Plain;
        self.rewrite(body, Forms { from, to }, buf)
    }

    /// Appends the RawData body, converted from the body of an ExtensionObject (OPC 10000-6, 5.2.6
    /// to 5.2.8).
    ///
    /// # Errors
    /// [`RawWriteFault::Body`] if `body` is not a body of this structure. Also fails if a text or
    /// array exceeds its field. The buffer is then unchanged.
    pub fn from_plain(
        &self,
        body: &[u8],
        dialect: RawDialect,
        buf: &mut Vec<u8>,
    ) -> Result<(), RawWriteFault> {
        let from = Form::Plain;
        let to = Form::of(dialect).nested();
        self.rewrite(body, Forms { from, to }, buf)
    }

    fn rewrite(&self, body: &[u8], forms: Forms, buf: &mut Vec<u8>) -> Result<(), RawWriteFault> {
        let start = buf.len();
        let written = write_structure(self, forms, body, buf);
        if written.is_err() {
            buf.truncate(start);
        }
        written
    }
}

fn write_field(
    field: &RawField<'_>,
    forms: Forms,
    value: RawValue<'_>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    let found = value.builtin_type();
    if found != Some(field.builtin) {
        return Err(RawWriteFault::Type {
            expected: field.builtin,
            found,
        });
    }
    let found = value_rank(&value);
    if found != field.value_rank {
        return Err(RawWriteFault::ValueRank {
            expected: field.value_rank,
            found,
        });
    }
    match value {
        // The null Variant is rejected above by its type.
        RawValue::Variant(Variant::Null) => Ok(()),
        RawValue::Variant(Variant::Scalar(value)) => write_element(field, forms, value, buf),
        RawValue::Variant(Variant::Array(array)) => {
            write_array(field, forms, &Items::Array(array), core::iter::empty(), buf)
        }
        RawValue::Variant(Variant::Matrix(matrix)) => {
            let items = Items::Array(matrix.elements());
            write_array(field, forms, &items, matrix.dimensions(), buf)
        }
        RawValue::Array(array) => {
            let from = array.form.nested();
            let items = Items::Read(array);
            let forms = Forms { from, ..forms };
            write_array(field, forms, &items, array.dimensions(), buf)
        }
    }
}

fn value_rank(value: &RawValue<'_>) -> i32 {
    let dimensions = match value {
        RawValue::Variant(Variant::Null | Variant::Scalar(_)) => return SCALAR,
        RawValue::Variant(Variant::Array(_)) => 1,
        RawValue::Variant(Variant::Matrix(matrix)) => matrix.dimensions().len(),
        RawValue::Array(array) => array.dimensions().len().max(1),
    };
    i32::try_from(dimensions).unwrap_or(i32::MAX)
}

fn write_element(
    field: &RawField<'_>,
    forms: Forms,
    value: Scalar<'_>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    if let Scalar::String(text) = value {
        return write_text(field, forms.to, text.map(str::as_bytes), buf);
    }
    if let Scalar::ByteString(bytes) = value {
        return write_text(field, forms.to, bytes, buf);
    }
    if let (Scalar::ExtensionObject(object), Some(structure)) = (value, field.structure) {
        return write_object(structure, forms, object, buf);
    }
    // The remaining types have a fixed size, and their encoding does not fail.
    value.write::<false>(buf).map_err(|_| RawWriteFault::Type {
        expected: field.builtin,
        found: Some(value.builtin_type()),
    })
}

fn write_text(
    field: &RawField<'_>,
    form: Form,
    text: Option<&[u8]>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    let room = field.text_room(form);
    let len = text.map_or(0, <[u8]>::len);
    let too_long = RawWriteFault::MaxStringLength {
        most: room.map_or(INT32_MAX, |_| field.max_string_length),
        len,
    };
    if room.is_some_and(|room| len > room) {
        return Err(too_long);
    }
    writer::byte_string(buf, text, field.builtin.name()).map_err(|_| too_long)?;
    let padding = room.unwrap_or_default().saturating_sub(len);
    pad(buf, padding);
    Ok(())
}

fn write_object(
    structure: &RawStructure<'_>,
    forms: Forms,
    object: ExtensionObject<'_>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    if object.type_id != structure.type_id() {
        return Err(RawWriteFault::StructureType);
    }
    let ExtensionBody::Binary(body) = object.body else {
        return Err(RawWriteFault::NoBody);
    };
    let to = forms.to.nested();
    write_structure(structure, Forms { to, ..forms }, body, buf)
}

/// Checks the body and writes it in the target form.
fn write_structure(
    structure: &RawStructure<'_>,
    forms: Forms,
    body: &[u8],
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    let mut walk = StructureWalk::new(structure, forms.from, ByteReader::new(body))
        .map_err(RawWriteFault::Body)?;
    if structure.structure_type() != RawStructureType::Structure {
        buf.extend_from_slice(&walk.head().to_le_bytes());
    }
    let start = buf.len();
    while let Some(member) = walk.step().map_err(RawWriteFault::Body)? {
        let field = member.field;
        match member.value {
            Some(value) => write_field(field, forms, value, buf)?,
            None => pad(buf, field.absent_room(forms.to).unwrap_or_default()),
        }
    }
    if walk.remaining() != 0 {
        let trailing = DecodeError::TrailingBytes(walk.remaining());
        return Err(RawWriteFault::Body(trailing));
    }
    if let Some(room) = structure.union_room(forms.to) {
        pad_from(buf, start, room);
    }
    Ok(())
}

fn write_array(
    field: &RawField<'_>,
    forms: Forms,
    items: &Items<'_>,
    dimensions: impl ExactSizeIterator<Item = u32>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    match field.value_rank {
        1 => write_length(field, forms.to, items, buf)?,
        _ => write_dimensions(field, forms.to, items, dimensions, buf)?,
    }
    let start = buf.len();
    match (items, field.element()) {
        (Items::Array(array), Some(Element::Fixed(_))) => buf.extend_from_slice(array.bytes()),
        (Items::Array(array), _) => {
            for item in array {
                write_element(field, forms, item, buf)?;
            }
        }
        (Items::Read(array), _) => {
            for item in array {
                write_element(field, forms, item, buf)?;
            }
        }
    }
    if let Some(room) = field.array_room(forms.to) {
        pad_from(buf, start, room);
    }
    Ok(())
}

fn write_length(
    field: &RawField<'_>,
    form: Form,
    items: &Items<'_>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    if !items.is_null() {
        let length = dimension(field, form, 0, items.len())?;
        buf.extend_from_slice(&length.to_le_bytes());
        return Ok(());
    }
    match form {
        Form::Standard | Form::Plain => {
            buf.extend_from_slice(&writer::NULL_LENGTH);
            Ok(())
        }
        Form::Open62541 => Err(RawWriteFault::NullArray),
    }
}

fn write_dimensions(
    field: &RawField<'_>,
    form: Form,
    items: &Items<'_>,
    dimensions: impl ExactSizeIterator<Item = u32>,
    buf: &mut Vec<u8>,
) -> Result<(), RawWriteFault> {
    if form != Form::Open62541 {
        buf.extend_from_slice(&field.value_rank.to_le_bytes());
    }
    // Short rows have no defined position, so all inner dimensions must have their maximum size.
    let full_rows = items.len() != 0 && field.array_room(form).is_some();
    for (index, size) in dimensions.enumerate() {
        let form = if full_rows && index != 0 {
            Form::Open62541
        } else {
            form
        };
        let size = dimension(field, form, index, to_usize(size))?;
        buf.extend_from_slice(&size.to_le_bytes());
    }
    Ok(())
}

/// Returns the size of a dimension if it fits: equal to the metadata for open62541, otherwise at
/// most the metadata.
fn dimension(
    field: &RawField<'_>,
    form: Form,
    index: usize,
    len: usize,
) -> Result<u32, RawWriteFault> {
    let known = field.most_elements(form, index);
    let expected = known.unwrap_or(INT32_MAX);
    let short = known.is_some() && form == Form::Open62541 && len < to_usize(expected);
    match u32::try_from(len) {
        Ok(size) if size <= expected && !short => Ok(size),
        _ => Err(RawWriteFault::ArrayDimensions { expected, len }),
    }
}

impl Items<'_> {
    const fn is_null(&self) -> bool {
        match self {
            Self::Array(array) => array.is_null(),
            Self::Read(array) => array.is_null(),
        }
    }

    const fn len(&self) -> usize {
        match self {
            Self::Array(array) => array.len(),
            Self::Read(array) => array.len(),
        }
    }
}

fn pad(buf: &mut Vec<u8>, bytes: usize) {
    buf.resize(buf.len().saturating_add(bytes), 0);
}

/// Pads the buffer to `room` bytes from `start` on.
fn pad_from(buf: &mut Vec<u8>, start: usize, room: usize) {
    let end = start.saturating_add(room);
    buf.resize(buf.len().max(end), 0);
}

/// Maximum length of texts and arrays.
const INT32_MAX: u32 = 0x7FFF_FFFF;
