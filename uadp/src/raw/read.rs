//! Decoding: each field is checked when it is decoded, and borrowed from the payload.

use super::layout::{Element, to_usize};
use super::{Form, RawArray, RawDialect, RawField, RawLayout, RawStructure, RawStructureType};
use super::{RawValue, SCALAR, WORD};
use crate::reader::ByteReader;
use crate::{Array, DecodeError, ExtensionBody, ExtensionObject, Matrix, Scalar, Variant};

/// Iterator over the fields of a RawData payload.
///
/// The iterator ends after the first `Err`. Zero bytes behind the last field are the padding to a
/// ConfiguredSize (OPC 10000-14, 6.3.1.3.3) and are skipped; other bytes cause a final
/// [`DecodeError::TrailingBytes`].
#[derive(Debug, Clone)]
pub struct RawFields<'a> {
    fields: core::slice::Iter<'a, RawField<'a>>,
    form: Form,
    reader: ByteReader<'a>,
}

/// Iterator over the present fields of a structure, each with its index in
/// [`RawStructure::fields`].
///
/// The iterator ends after the first `Err`; bytes behind the last field cause a final
/// [`DecodeError::TrailingBytes`].
#[derive(Debug, Clone)]
pub struct RawMembers<'a> {
    walk: StructureWalk<'a>,
    done: bool,
}

/// Iteration over the fields of a structure.
#[derive(Debug, Clone)]
pub(super) struct StructureWalk<'a> {
    structure: &'a RawStructure<'a>,
    form: Form,
    next: usize,
    /// EncodingMask, shifted to the next optional field; or SwitchField.
    head: u32,
    reader: ByteReader<'a>,
}

/// A field of a structure during the iteration.
pub(super) struct Member<'a> {
    index: usize,
    pub(super) field: &'a RawField<'a>,
    /// `None` for an absent optional field.
    pub(super) value: Option<RawValue<'a>>,
}

/// Bytes to decode: a padded range, or all remaining bytes.
struct UnreadBytes<'a> {
    padded: bool,
    reader: ByteReader<'a>,
}

/// Length or dimensions of an array.
struct Extent<'a> {
    null: bool,
    count: usize,
    dimensions: &'a [[u8; 4]],
}

impl<'a> RawLayout<'a> {
    /// Returns the fields of a payload, which is
    /// [`DataSetMessage::payload`](crate::DataSetMessage::payload) of a key frame of RawData. A
    /// payload without bytes is a heartbeat and has no fields.
    ///
    /// A payload of another dialect or metadata version may be decoded to wrong values without an
    /// error. The following checks can reveal it: padding bytes are zero, lengths are within their
    /// maximum, and no bytes are left.
    #[must_use]
    pub fn read<'p>(&self, payload: &'p [u8], dialect: RawDialect) -> RawFields<'p>
    where
        'a: 'p,
    {
        let fields = match payload {
            [] => [].iter(),
            _ => self.fields().iter(),
        };
        RawFields {
            fields,
            form: Form::of(dialect),
            reader: ByteReader::new(payload),
        }
    }
}

impl<'a> Iterator for RawFields<'a> {
    type Item = Result<RawValue<'a>, DecodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        let Some(field) = self.fields.next() else {
            let padding = core::mem::replace(&mut self.reader, ByteReader::new(&[])).rest();
            return if padding.iter().all(|byte| *byte == 0) {
                None
            } else {
                Some(Err(DecodeError::TrailingBytes(padding.len())))
            };
        };
        let value = read_field(field, self.form, &mut self.reader);
        if value.is_err() {
            self.fields = [].iter();
            self.reader = ByteReader::new(&[]);
        }
        Some(value)
    }
}

impl core::iter::FusedIterator for RawFields<'_> {}

impl<'a> RawStructure<'a> {
    /// Returns the fields of a body that was decoded as this structure.
    ///
    /// # Errors
    /// Fails if the EncodingMask or SwitchField is truncated or invalid for the structure.
    pub fn members<'p>(
        &'p self,
        body: &'p [u8],
        dialect: RawDialect,
    ) -> Result<RawMembers<'p>, DecodeError>
    where
        'a: 'p,
    {
        let walk = StructureWalk::new(self, Form::of(dialect).nested(), ByteReader::new(body))?;
        Ok(RawMembers { walk, done: false })
    }
}

impl<'a> RawMembers<'a> {
    fn step(&mut self) -> Result<Option<(usize, RawValue<'a>)>, DecodeError> {
        while let Some(member) = self.walk.step()? {
            if let Some(value) = member.value {
                return Ok(Some((member.index, value)));
            }
        }
        match self.walk.reader.remaining() {
            0 => Ok(None),
            left => Err(DecodeError::TrailingBytes(left)),
        }
    }
}

impl<'a> Iterator for RawMembers<'a> {
    type Item = Result<(usize, RawValue<'a>), DecodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let member = self.step().transpose();
        self.done = !matches!(member, Some(Ok(_)));
        member
    }
}

impl core::iter::FusedIterator for RawMembers<'_> {}

impl<'a> StructureWalk<'a> {
    pub(super) fn new(
        structure: &'a RawStructure<'a>,
        form: Form,
        mut reader: ByteReader<'a>,
    ) -> Result<Self, DecodeError> {
        let head = match structure.structure_type() {
            RawStructureType::Structure => 0,
            RawStructureType::StructureWithOptionalFields => {
                let mask = reader.u32("EncodingMask")?;
                let unassigned = u32::MAX
                    .checked_shl(structure.optional())
                    .unwrap_or_default();
                match mask & unassigned {
                    0 => mask,
                    bits => return Err(reserved("EncodingMask", bits)),
                }
            }
            RawStructureType::Union => {
                let switch = reader.u32("SwitchField")?;
                if to_usize(switch) > structure.fields().len() {
                    return Err(reserved("SwitchField", switch));
                }
                switch
            }
        };
        Ok(Self {
            structure,
            form,
            next: 0,
            head,
            reader,
        })
    }

    /// Returns the EncodingMask or SwitchField, before the first step.
    pub(super) const fn head(&self) -> u32 {
        self.head
    }

    pub(super) const fn remaining(&self) -> usize {
        self.reader.remaining()
    }

    /// Returns the next field; for a Union the selected field only.
    pub(super) fn step(&mut self) -> Result<Option<Member<'a>>, DecodeError> {
        let index = match self.structure.structure_type() {
            RawStructureType::Union => return self.step_union(),
            RawStructureType::Structure | RawStructureType::StructureWithOptionalFields => {
                self.next
            }
        };
        let Some(field) = self.structure.fields().get(index) else {
            return Ok(None);
        };
        self.next += 1;
        let mut present = true;
        if field.optional {
            present = self.head & 1 != 0;
            self.head >>= 1;
        }
        let value = if present {
            Some(read_field(field, self.form, &mut self.reader)?)
        } else {
            if let Some(room) = field.absent_room(self.form) {
                check_zero(self.reader.bytes(room, PADDING)?)?;
            }
            None
        };
        Ok(Some(Member {
            index,
            field,
            value,
        }))
    }

    fn step_union(&mut self) -> Result<Option<Member<'a>>, DecodeError> {
        if core::mem::replace(&mut self.next, 1) != 0 {
            return Ok(None);
        }
        let room = self.structure.union_room(self.form);
        let mut place = UnreadBytes::new(room, &mut self.reader, "Union")?;
        let member = match self.chosen() {
            Some((index, field)) => Some(Member {
                index,
                field,
                value: Some(read_field(field, self.form, &mut place.reader)?),
            }),
            None => None,
        };
        place.leave(&mut self.reader)?;
        Ok(member)
    }

    /// Returns the field that the SwitchField selects.
    fn chosen(&self) -> Option<(usize, &'a RawField<'a>)> {
        let index = to_usize(self.head).checked_sub(1)?;
        Some((index, self.structure.fields().get(index)?))
    }
}

impl<'a> UnreadBytes<'a> {
    /// Takes the next `room` bytes from `reader`; without `room`, copies `reader`.
    fn new(
        room: Option<usize>,
        reader: &mut ByteReader<'a>,
        what: &'static str,
    ) -> Result<Self, DecodeError> {
        Ok(match room {
            Some(room) => Self {
                padded: true,
                reader: ByteReader::new(reader.bytes(room, what)?),
            },
            None => Self {
                padded: false,
                reader: *reader,
            },
        })
    }

    fn leave(self, reader: &mut ByteReader<'a>) -> Result<(), DecodeError> {
        if self.padded {
            return check_zero(self.reader.rest());
        }
        *reader = self.reader;
        Ok(())
    }
}

fn read_field<'a>(
    field: &'a RawField<'a>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<RawValue<'a>, DecodeError> {
    match field.value_rank {
        SCALAR => read_element(field, form, reader).map(|value| Variant::Scalar(value).into()),
        _ => read_array(field, form, reader),
    }
}

/// Decodes a single value or an element of an array.
pub(super) fn read_element<'a>(
    field: &'a RawField<'a>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<Scalar<'a>, DecodeError> {
    match field.element() {
        Some(Element::Fixed(_)) => Scalar::read(field.builtin, reader),
        Some(Element::Text) => read_text(field, form, reader),
        Some(Element::Structure(structure)) => read_structure(structure, form.nested(), reader),
        // A layout never holds such a field.
        None => Err(DecodeError::Unsupported(field.builtin.name())),
    }
}

fn read_text<'a>(
    field: &RawField<'_>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<Scalar<'a>, DecodeError> {
    let name = field.builtin.name();
    let room = field.text_room(form);
    let size = room.map(|room| room.saturating_add(WORD));
    let mut place = UnreadBytes::new(size, reader, name)?;
    let mut ahead = place.reader;
    if let (Some(length), Some(room)) = (ahead.length(name)?, room)
        && length > room
    {
        return Err(limit(name, length));
    }
    let text = Scalar::read(field.builtin, &mut place.reader)?;
    place.leave(reader)?;
    Ok(text)
}

fn read_structure<'a>(
    structure: &'a RawStructure<'a>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<Scalar<'a>, DecodeError> {
    let before = *reader;
    let mut walk = StructureWalk::new(structure, form, before)?;
    while walk.step()?.is_some() {}
    *reader = walk.reader;
    Ok(Scalar::ExtensionObject(ExtensionObject {
        type_id: structure.type_id(),
        body: ExtensionBody::Binary(reader.since(&before)),
    }))
}

fn read_array<'a>(
    field: &'a RawField<'a>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<RawValue<'a>, DecodeError> {
    let extent = match field.value_rank {
        1 => read_length(field, form, reader)?,
        _ => read_dimensions(field, form, reader)?,
    };
    let mut place = UnreadBytes::new(field.array_room(form), reader, "array")?;
    let value = read_elements(field, form, &extent, &mut place.reader)?;
    place.leave(reader)?;
    Ok(value)
}

fn read_length<'a>(
    field: &RawField<'_>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<Extent<'a>, DecodeError> {
    const NAME: &str = "array length";
    let length = reader.length(NAME)?;
    if length.is_none() && form == Form::Open62541 {
        return Err(reserved(NAME, u32::MAX));
    }
    let count = length.unwrap_or_default();
    if field
        .most_elements(form, 0)
        .is_some_and(|most| count > to_usize(most))
    {
        return Err(limit(NAME, count));
    }
    Ok(Extent {
        null: length.is_none(),
        count,
        dimensions: &[],
    })
}

fn read_dimensions<'a>(
    field: &RawField<'_>,
    form: Form,
    reader: &mut ByteReader<'a>,
) -> Result<Extent<'a>, DecodeError> {
    let rank = field.rank();
    if form != Form::Open62541 {
        const NAME: &str = "number of dimensions";
        let found = reader.u32(NAME)?;
        if to_usize(found) != rank {
            return Err(reserved(NAME, found));
        }
    }
    let (dimensions, _) = reader
        .bytes(rank.saturating_mul(WORD), "dimensions")?
        .as_chunks();
    let mut count = 1_usize;
    for (index, dimension) in dimensions.iter().enumerate() {
        let dimension = i32::from_le_bytes(*dimension);
        let Ok(size) = usize::try_from(dimension) else {
            return Err(reserved("dimension", dimension.cast_unsigned()));
        };
        if field
            .most_elements(form, index)
            .is_some_and(|most| size > to_usize(most))
        {
            return Err(limit("dimension", size));
        }
        count = count.saturating_mul(size);
    }
    if count != 0 && field.array_room(form).is_some() && !rows_are_full(field, dimensions) {
        return Err(DecodeError::Unsupported(SHORT_ROWS));
    }
    Ok(Extent {
        null: false,
        count,
        dimensions,
    })
}

/// Returns true if all dimensions except the outermost have their maximum size.
fn rows_are_full(field: &RawField<'_>, dimensions: &[[u8; 4]]) -> bool {
    let mut inner = dimensions.iter().zip(field.array_dimensions).skip(1);
    inner.all(|(size, most)| u32::from_le_bytes(*size) == *most)
}

fn read_elements<'a>(
    field: &'a RawField<'a>,
    form: Form,
    extent: &Extent<'a>,
    reader: &mut ByteReader<'a>,
) -> Result<RawValue<'a>, DecodeError> {
    let Extent {
        null,
        count,
        dimensions,
    } = *extent;
    let least = count.saturating_mul(field.least_element_size());
    if least > reader.remaining() {
        return Err(limit("array length", count));
    }
    let before = *reader;
    match field.element() {
        Some(Element::Fixed(_)) => {
            reader.bytes(least, "array")?;
        }
        Some(Element::Text | Element::Structure(_)) | None => {
            for _ in 0..count {
                read_element(field, form, reader)?;
            }
        }
    }
    let bytes = reader.since(&before);
    if field.structure.is_some() || field.text_room(form).is_some() {
        return Ok(RawValue::Array(RawArray {
            field,
            form,
            null,
            len: count,
            dimensions,
            bytes,
        }));
    }
    let array = if null {
        Array::null(field.builtin)
    } else {
        Array::new(field.builtin, count, bytes)?
    };
    Ok(match field.value_rank {
        1 => Variant::Array(array).into(),
        _ => Variant::Matrix(Matrix::new(array, dimensions)?).into(),
    })
}

/// Checks that padding within the payload is zero.
fn check_zero(padding: &[u8]) -> Result<(), DecodeError> {
    match padding.iter().find(|byte| **byte != 0) {
        Some(byte) => Err(reserved(PADDING, (*byte).into())),
        None => Ok(()),
    }
}

const fn reserved(field: &'static str, value: u32) -> DecodeError {
    DecodeError::Reserved { field, value }
}

fn limit(field: &'static str, length: usize) -> DecodeError {
    DecodeError::Limit {
        field,
        value: u32::try_from(length).unwrap_or(u32::MAX),
    }
}

const PADDING: &str = "RawData padding";
const SHORT_ROWS: &str = "padded RawData matrix with rows shorter than its ArrayDimensions";
