//! Conversion between the fields of a ROS message and the fields of a DataSetMessage.
//!
//! `messages` runs its plans with a sink and a source and is independent of UADP. This module has
//! the sink that writes to a [`FieldEncoder`], and the source that reads [`Fields`]. A message in
//! an array of messages is an ExtensionObject with a binary body. Its TypeId is a string NodeId
//! with the name of the ROS type in the namespace of the topic.

use messages::{
    FieldSink, FieldSupplier, MessageFault, MessagePlan, ReadError, SourceError, TypeName,
    ValueFault, WriteError, WriteFault,
};
use uadp::{
    Array, BuiltinType, DecodeError, Elements, EncodeError, ExtensionBody, FieldEncoder, Fields,
    NodeId, Scalar, StructureReader, Variant,
};

use crate::counters::{DropCause, Reason};

/// A payload of the local side with its format.
pub(crate) enum LocalPayload<'a> {
    /// A block of fields to copy.
    Block(&'a [u8]),
    /// A ROS message with its plan.
    Ros(&'a MessagePlan, &'a [u8]),
}

/// Writes the fields of a local payload into a key frame.
pub(crate) fn read(
    payload: &LocalPayload<'_>,
    namespace: u16,
    frame: &mut FieldEncoder<'_>,
) -> Result<(), (DropCause, String)> {
    match payload {
        LocalPayload::Block(block) => {
            // Checked before sending, because subscribers cannot read a datagram with an invalid
            // block.
            Fields::parse(block)
                .and_then(|fields| fields.checked_bytes())
                .map_err(undecodable)?;
            frame
                .fields_block(block)
                .map_err(|error| (Reason::TooBig.into(), error.to_string()))
        }
        LocalPayload::Ros(plan, bytes) => {
            encode_fields(plan, bytes, namespace, frame).map_err(|error| match &error {
                ReadError::Malformed { fault, .. } => {
                    ((Reason::Malformed, case(*fault)).into(), error.to_string())
                }
                ReadError::Value { fault, .. } => (
                    (Reason::Mismatch, value_case(fault)).into(),
                    error.to_string(),
                ),
                ReadError::Sink { source, .. } => (Reason::TooBig.into(), source.to_string()),
            })
        }
    }
}

/// Writes the fields of a ROS message into a frame in the same way as the
/// [`Router`](crate::Router). `namespace` is the namespace of the TypeIds of structures.
///
/// # Errors
/// The message does not match the type of the plan, or is too long for UADP. Discard the frame in
/// this case.
pub fn encode_fields(
    plan: &MessagePlan,
    message: &[u8],
    namespace: u16,
    frame: &mut FieldEncoder<'_>,
) -> Result<(), ReadError<EncodeError>> {
    plan.read(message, &mut FrameSink { frame, namespace })
}

/// Appends the ROS message of the fields to `out` in the same way as the [`Router`](crate::Router).
///
/// # Errors
/// The fields do not match the plan; `out` is then unchanged.
pub fn decode_fields(
    plan: &MessagePlan,
    fields: Fields<'_>,
    out: &mut Vec<u8>,
) -> Result<(), WriteError> {
    plan.write(&mut FieldSource::new(fields), out)
}

/// Appends the ROS message of the fields.
pub(crate) fn write(
    plan: &MessagePlan,
    fields: Fields<'_>,
    out: &mut Vec<u8>,
) -> Result<(), (DropCause, String)> {
    decode_fields(plan, fields, out).map_err(|error| {
        let cause = (Reason::Mismatch, write_case(&error.fault)).into();
        (cause, error.to_string())
    })
}

/// Appends the unchanged fields after a check that they can be read.
pub(crate) fn copy(fields: &Fields<'_>, out: &mut Vec<u8>) -> Result<(), (DropCause, String)> {
    let block = fields.checked_bytes().map_err(undecodable)?;
    out.extend_from_slice(block);
    Ok(())
}

pub(crate) fn undecodable(error: DecodeError) -> (DropCause, String) {
    let cause = (Reason::Malformed, error.subject()).into();
    (cause, error.to_string())
}

const fn case(fault: MessageFault) -> &'static str {
    match fault {
        MessageFault::Truncated => "truncated",
        MessageFault::Text => "text",
        MessageFault::Terminator => "terminator",
        MessageFault::Bound { .. } => "bound",
        MessageFault::TrailingBytes(_) => "trailing bytes",
        MessageFault::Encapsulation(_) => "encapsulation",
        MessageFault::WithoutBytes(_) => "without bytes",
    }
}

const fn value_case(fault: &ValueFault) -> &'static str {
    match fault {
        ValueFault::Absent { .. } => "absent",
        ValueFault::NoName(_) => "no name",
        ValueFault::OutOfRange { .. } => "out of range",
        ValueFault::NoNumber => "no number",
    }
}

const fn write_case(fault: &WriteFault) -> &'static str {
    match fault {
        WriteFault::Source(SourceError::Missing) => "missing",
        WriteFault::Source(SourceError::Type { .. }) => "type",
        WriteFault::Source(SourceError::LeftOver(_)) => "left over",
        WriteFault::Source(SourceError::Malformed(_)) => "malformed",
        WriteFault::Source(SourceError::Value(fault)) => value_case(fault),
        WriteFault::Length { .. } => "length",
        WriteFault::Bound { .. } => "bound",
        WriteFault::Part => "part",
        WriteFault::Order => "order",
        WriteFault::Nul => "nul",
        WriteFault::WithoutValue(_) => "without value",
        WriteFault::Duration => "duration",
    }
}

/// Returns the builtin type of a field, and whether it is an array.
pub(crate) fn shape(field: &Variant<'_>) -> (BuiltinType, bool) {
    match field {
        Variant::Null => (BuiltinType::Variant, false),
        Variant::Scalar(scalar) => (scalar.builtin_type(), false),
        Variant::Array(array) => (array.element(), true),
        Variant::Matrix(matrix) => (matrix.elements().element(), true),
    }
}

/// The sink of a plan that writes to a key frame.
struct FrameSink<'f, 'm> {
    frame: &'f mut FieldEncoder<'m>,
    /// The namespace of the TypeIds of structures.
    namespace: u16,
}

impl FieldSink for FrameSink<'_, '_> {
    type Error = EncodeError;

    fn scalar(&mut self, value: Scalar<'_>) -> Result<(), EncodeError> {
        self.frame.scalar(value)
    }

    #[inline]
    fn scalars(&mut self, builtin: BuiltinType, bytes: &[u8]) -> Result<bool, EncodeError> {
        self.frame.scalars(builtin, bytes).map(|()| true)
    }

    fn packed_array(
        &mut self,
        element: BuiltinType,
        count: usize,
        bytes: &[u8],
    ) -> Result<(), EncodeError> {
        self.frame.packed_array(element, count, bytes)
    }

    fn array(&mut self, element: BuiltinType, count: usize) -> Result<(), EncodeError> {
        if element == BuiltinType::ExtensionObject {
            // Messages in a message of an array are encoded inline.
            self.frame.inline_structures(count)
        } else {
            self.frame.array(element, count)
        }
    }

    fn element(&mut self, value: Scalar<'_>) -> Result<(), EncodeError> {
        self.frame.element(value)
    }

    fn structures(&mut self, _of: &TypeName, count: usize) -> Result<(), EncodeError> {
        self.frame.structures(count)
    }

    fn begin_structure(&mut self, of: &TypeName) -> Result<(), EncodeError> {
        self.frame
            .begin_structure(NodeId::string(self.namespace, of.as_str()))
    }

    fn end_structure(&mut self) -> Result<(), EncodeError> {
        self.frame.end_structure()
    }
}

/// The source of a plan that reads the fields of a key frame.
struct FieldSource<'a> {
    fields: Fields<'a>,
    /// The remaining elements of the last opened array.
    elements: Option<Elements<'a>>,
    /// The remaining structures of the last opened array of structures.
    structures: Option<Elements<'a>>,
    /// The open structure.
    structure: Option<StructureReader<'a>>,
}

impl<'a> FieldSource<'a> {
    const fn new(fields: Fields<'a>) -> Self {
        Self {
            fields,
            elements: None,
            structures: None,
            structure: None,
        }
    }

    fn field(&mut self) -> Result<Variant<'a>, SourceError> {
        self.fields
            .next()
            .ok_or(SourceError::Missing)?
            .map_err(malformed)
    }

    fn open_structure(&mut self, value: Scalar<'a>) -> Result<(), SourceError> {
        let Scalar::ExtensionObject(object) = value else {
            return Err(unexpected(
                BuiltinType::ExtensionObject,
                false,
                &Variant::Scalar(value),
            ));
        };
        let ExtensionBody::Binary(body) = object.body else {
            return Err(SourceError::Malformed(
                "a structure without a binary body".to_owned(),
            ));
        };
        self.structure = Some(StructureReader::new(body));
        Ok(())
    }

    /// Returns the next field, or the next value of the open structure, as an array.
    fn next_array(&mut self, expected: BuiltinType) -> Result<Array<'a>, SourceError> {
        if let Some(structure) = &mut self.structure {
            return structure.array(expected).map_err(malformed);
        }
        match self.field()? {
            Variant::Array(array) if array.element() == expected => Ok(array),
            // ROS arrays have one dimension: the elements in row-major order.
            Variant::Matrix(matrix) if matrix.elements().element() == expected => {
                Ok(matrix.elements())
            }
            other @ (Variant::Null
            | Variant::Scalar(_)
            | Variant::Array(_)
            | Variant::Matrix(_)) => Err(unexpected(expected, true, &other)),
        }
    }
}

impl<'a> FieldSupplier<'a> for FieldSource<'a> {
    fn scalar(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        if let Some(structure) = &mut self.structure {
            return structure.scalar(expected).map_err(malformed);
        }
        match self.field()? {
            Variant::Scalar(scalar) if scalar.builtin_type() == expected => Ok(scalar),
            other @ (Variant::Null
            | Variant::Scalar(_)
            | Variant::Array(_)
            | Variant::Matrix(_)) => Err(unexpected(expected, false, &other)),
        }
    }

    #[inline]
    fn scalars(&mut self, expected: BuiltinType, count: u16, out: &mut Vec<u8>) -> bool {
        if let Some(structure) = &mut self.structure {
            let taken = structure.take_scalars(expected, count);
            out.extend_from_slice(taken.unwrap_or_default());
            return taken.is_some();
        }
        let (Some(taken), Some(size)) = (
            self.fields.take_scalars(expected, count),
            expected.fixed_size(),
        ) else {
            return false;
        };
        out.reserve(taken.len());
        match size {
            8 => push_untagged::<9>(out, taken),
            4 => push_untagged::<5>(out, taken),
            2 => push_untagged::<3>(out, taken),
            _ => taken
                .chunks_exact(1 + size)
                .for_each(|value| out.extend_from_slice(value.get(1..).unwrap_or_default())),
        }
        true
    }

    fn packed_array(&mut self, expected: BuiltinType) -> Result<(usize, &'a [u8]), SourceError> {
        let array = self.next_array(expected)?;
        Ok((array.len(), array.bytes()))
    }

    fn array(&mut self, expected: BuiltinType) -> Result<usize, SourceError> {
        if let (Some(structure), BuiltinType::ExtensionObject) = (&mut self.structure, expected) {
            // Messages in a message of an array are encoded inline, so only their number is read
            // here.
            return structure
                .length()
                .map_err(malformed)
                .map(Option::unwrap_or_default);
        }
        let array = self.next_array(expected)?;
        self.elements = Some(array.iter());
        Ok(array.len())
    }

    fn element(&mut self, expected: BuiltinType) -> Result<Scalar<'a>, SourceError> {
        let element = self
            .elements
            .as_mut()
            .and_then(Iterator::next)
            .ok_or(SourceError::Missing)?;
        if element.builtin_type() == expected {
            return Ok(element);
        }
        Err(unexpected(expected, false, &Variant::Scalar(element)))
    }

    fn structures(&mut self) -> Result<usize, SourceError> {
        let array = self.next_array(BuiltinType::ExtensionObject)?;
        self.structures = Some(array.iter());
        Ok(array.len())
    }

    fn structure(&mut self) -> Result<(), SourceError> {
        match self.field()? {
            Variant::Scalar(one) => self.open_structure(one),
            other @ (Variant::Null | Variant::Array(_) | Variant::Matrix(_)) => {
                Err(unexpected(BuiltinType::ExtensionObject, false, &other))
            }
        }
    }

    fn begin_structure(&mut self) -> Result<(), SourceError> {
        let next = self
            .structures
            .as_mut()
            .and_then(Iterator::next)
            .ok_or(SourceError::Missing)?;
        self.open_structure(next)
    }

    fn end_structure(&mut self) -> Result<(), SourceError> {
        match self
            .structure
            .take()
            .map_or(0, |structure| structure.remaining())
        {
            0 => Ok(()),
            left => Err(SourceError::Malformed(format!(
                "{left} bytes too many in a structure"
            ))),
        }
    }

    fn finish(&mut self) -> Result<(), SourceError> {
        match self.fields.by_ref().count() {
            0 => Ok(()),
            left => Err(SourceError::LeftOver(left)),
        }
    }
}

/// Appends values without their encoding bytes. The constant size `N`, which includes the encoding
/// byte, compiles to a few move instructions per value.
#[inline]
fn push_untagged<const N: usize>(out: &mut Vec<u8>, variants: &[u8]) {
    let (variants, _) = variants.as_chunks::<N>();
    for variant in variants {
        out.extend_from_slice(variant.get(1..).unwrap_or_default());
    }
}

fn malformed(error: DecodeError) -> SourceError {
    SourceError::Malformed(error.to_string())
}

fn unexpected(expected: BuiltinType, expected_array: bool, found: &Variant<'_>) -> SourceError {
    let found_array = matches!(found, Variant::Array(_));
    SourceError::Type {
        expected,
        expected_array,
        found: found.builtin_type(),
        found_array,
    }
}
