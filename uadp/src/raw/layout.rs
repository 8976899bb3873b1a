//! Metadata of the fields, and the sizes that follow from it.

use super::{Form, RawDialect, SCALAR, WORD};
use crate::{BuiltinType, NodeId};

/// Field metadata of a DataSet in the order of the fields, for RawData (OPC 10000-14, 6.2.3.2.3).
///
/// A DataSetMessage of RawData does not describe its fields (OPC 10000-14, 7.2.4.5.11): they are
/// encoded in sequence like the fields of a structure (OPC 10000-6, 5.2.6), and structures have no
/// ExtensionObject envelope. A value shorter than the maximum of its metadata is followed by zero
/// bytes, so that every field has a fixed offset. Peers differ in the details, so decoding and
/// encoding take a [`RawDialect`].
///
/// Values without a maximum in the metadata (a MaxStringLength of 0, no ArrayDimensions or a
/// dimension of 0) are not padded, and the fields behind them have no fixed offset. If all maxima
/// are known, [`fixed_size`](Self::fixed_size) and [`field_offset`](Self::field_offset) return the
/// offsets of the fields, so that a message can be patched in place.
///
/// # Reading
/// ```
/// use uadp::{Array, BuiltinType, RawDialect, RawField, RawLayout, Scalar, Variant};
///
/// let fields = [
///     RawField::new(BuiltinType::Int32),
///     RawField::new(BuiltinType::String).with_max_string_length(6),
///     RawField::new(BuiltinType::UInt16).with_dimensions(&[3]),
/// ];
/// let layout = RawLayout::new(&fields)?;
/// assert_eq!(layout.fixed_size(RawDialect::Standard), Some(24));
/// assert_eq!(layout.field_offset(2, RawDialect::Standard), Some(14));
///
/// let payload = [
///     42, 0, 0, 0, // Int32
///     4, 0, 0, 0, b'c', b'e', b'l', b'l', 0, 0, // String of 4 bytes in a place of 6
///     2, 0, 0, 0, 7, 0, 8, 0, 0, 0, // two UInt16 in a place of three
/// ];
/// let values: Result<Vec<_>, _> = layout.read(&payload, RawDialect::Standard).collect();
/// let array = Array::new(BuiltinType::UInt16, 2, &[7, 0, 8, 0])?;
/// let expected = [Scalar::Int32(42).into(), Scalar::String(Some("cell")).into(), Variant::Array(array)];
/// assert_eq!(values?, expected.map(Into::into));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Writing
/// ```
/// use uadp::{BuiltinType, DataSetHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder};
/// use uadp::{RawDialect, RawField, RawLayout, Scalar, Variant};
/// let fields = [RawField::new(BuiltinType::Boolean), RawField::new(BuiltinType::Double)];
/// let layout = RawLayout::new(&fields)?;
/// let values = [Scalar::Boolean(true), Scalar::Double(2.5)].map(Variant::from);
/// let mut payload = Vec::new();
/// layout.write(&mut payload, RawDialect::Standard, values)?;
///
/// let mut datagram = Vec::new();
/// let mut message = NetworkMessageEncoder::new(&mut datagram, &NetworkHeader::default(), None)?;
/// message.raw_key_frame(&DataSetHeader::default(), |buf| {
///     buf.extend_from_slice(&payload);
///     Ok(())
/// })?;
/// message.finish()?;
///
/// let message = NetworkMessage::decode(&datagram)?;
/// for message in message.messages() {
///     let read: Result<Vec<_>, _> = layout.read(message?.payload(), RawDialect::Standard).collect();
///     assert_eq!(read?, values.map(Into::into));
/// }
///
/// let wrong = [Scalar::Boolean(true), Scalar::Float(2.5)].map(Variant::from);
/// let error = layout.write(&mut payload, RawDialect::Standard, wrong).unwrap_err();
/// assert_eq!(error.to_string(), "field 1: Float where Double is expected");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawLayout<'a> {
    fields: &'a [RawField<'a>],
}

/// A field of a DataSet (FieldMetaData: OPC 10000-14, 6.2.3.2.4) or of a structure (StructureField:
/// OPC 10000-3, 8.51).
///
/// An enumeration is an Int32. NodeId, ExpandedNodeId, QualifiedName, LocalizedText, XmlElement,
/// DiagnosticInfo and DataValue are not allowed, nor is Variant, which stands for abstract types
/// (OPC 10000-14, 7.2.4.5.11 and 6.2.3.2.4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawField<'a> {
    /// BuiltInType; ExtensionObject for a structure.
    pub builtin: BuiltinType,
    /// ValueRank: -1 for a single value, otherwise the number of dimensions.
    pub value_rank: i32,
    /// ArrayDimensions: maximum number of elements of each dimension, 0 if unknown. Either empty or
    /// an entry per dimension.
    pub array_dimensions: &'a [u32],
    /// MaxStringLength: maximum bytes of a String or ByteString, 0 if unknown. Ignored for other
    /// types.
    pub max_string_length: u32,
    /// Definition of the structure, for ExtensionObject only.
    pub structure: Option<&'a RawStructure<'a>>,
    /// IsOptional, in a [`RawStructureType::StructureWithOptionalFields`] only.
    pub optional: bool,
}

/// A structure DataType with its StructureDefinition (OPC 10000-3, 8.48).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawStructure<'a> {
    type_id: NodeId<'a>,
    structure_type: RawStructureType,
    fields: &'a [RawField<'a>],
    optional: u32,
    depth: usize,
    /// Bytes with all padding; `None` if variable.
    padded: Option<usize>,
    /// Bytes without padding; `None` if variable.
    plain: Option<usize>,
    /// Minimum number of bytes in either form.
    least: usize,
}

/// StructureType of a StructureDefinition (OPC 10000-3, 8.49). Types with subtyped values are not
/// allowed in RawData.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RawStructureType {
    /// All fields in sequence.
    Structure,
    /// An EncodingMask marks the present optional fields (OPC 10000-6, 5.2.7).
    StructureWithOptionalFields,
    /// A SwitchField selects the present field (OPC 10000-6, 5.2.8).
    Union,
}

/// Error of a layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("field {field}: {fault}")]
pub struct RawLayoutError {
    /// Index of the field.
    pub field: usize,
    /// Fault of the field.
    pub fault: RawLayoutFault,
}

/// Fault of a field of a layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RawLayoutFault {
    /// The standard does not allow the type in RawData.
    #[error("{0} is not allowed in RawData")]
    Type(BuiltinType),
    /// The field is an ExtensionObject without a structure definition.
    #[error("an ExtensionObject without its structure")]
    NoStructure,
    /// The field has a structure definition and another type.
    #[error("{0} with a structure")]
    NotAStructure(BuiltinType),
    /// The ValueRank permits both scalars and arrays, or is not defined by the standard.
    #[error("ValueRank {0} is neither -1 nor a number of dimensions")]
    ValueRank(i32),
    /// The number of ArrayDimensions is neither 0 nor the number of dimensions.
    #[error("{found} ArrayDimensions with ValueRank {value_rank}")]
    ArrayDimensions {
        /// ValueRank.
        value_rank: i32,
        /// Number of ArrayDimensions.
        found: usize,
    },
    /// The field is optional in a type without optional fields, or there are more than 32 optional
    /// fields.
    #[error("too many optional fields")]
    Optional,
    /// Structures are nested deeper than [`RawStructure::MAX_DEPTH`].
    #[error("structures nested too deep")]
    TooDeep,
    /// The structure has no fields. It would have no size, so any number of them would fit in a
    /// message.
    #[error("a structure without fields")]
    NoFields,
    /// The fields up to this field exceed 2^31-1 bytes.
    #[error("more than 2^31-1 bytes")]
    TooBig,
}

/// Encoding of a single value or of an array element.
pub(super) enum Element<'a> {
    Fixed(usize),
    Text,
    Structure(&'a RawStructure<'a>),
}

impl<'a> RawLayout<'a> {
    /// Creates the layout of the fields of a DataSet.
    ///
    /// # Errors
    /// The first invalid field.
    pub fn new(fields: &'a [RawField<'a>]) -> Result<Self, RawLayoutError> {
        let mut total = 0_usize;
        for (field, metadata) in fields.iter().enumerate() {
            let error = |fault| RawLayoutError { field, fault };
            metadata.check().map_err(error)?;
            if metadata.optional {
                return Err(error(RawLayoutFault::Optional));
            }
            total = total.saturating_add(metadata.size(Form::Standard).unwrap_or_default());
            if total > MAX_SIZE {
                return Err(error(RawLayoutFault::TooBig));
            }
        }
        Ok(Self { fields })
    }

    /// Returns the fields.
    #[must_use]
    pub const fn fields(&self) -> &'a [RawField<'a>] {
        self.fields
    }

    /// Returns the bytes of every payload, or `None` if the size varies because a maximum is
    /// unknown.
    ///
    /// In the dialect of open62541 the size applies to encoded payloads; a decoded payload may have
    /// shorter arrays.
    #[must_use]
    pub fn fixed_size(&self, dialect: RawDialect) -> Option<usize> {
        fixed_size(self.fields, dialect)
    }

    /// Returns the offset of a field in every payload, in bytes. Returns `None` if the offset
    /// varies or the field does not exist. The limitation of [`fixed_size`](Self::fixed_size)
    /// applies.
    ///
    /// The offset of a text or array is the offset of its length, not of its content.
    #[must_use]
    pub fn field_offset(&self, field: usize, dialect: RawDialect) -> Option<usize> {
        self.fields.get(field)?;
        fixed_size(self.fields.get(..field)?, dialect)
    }
}

fn fixed_size(fields: &[RawField<'_>], dialect: RawDialect) -> Option<usize> {
    let form = Form::of(dialect);
    fields
        .iter()
        .try_fold(0_usize, |sum, field| sum.checked_add(field.size(form)?))
}

impl<'a> RawField<'a> {
    /// Creates a single value of unknown maximum length.
    #[must_use]
    pub const fn new(builtin: BuiltinType) -> Self {
        Self {
            builtin,
            value_rank: SCALAR,
            array_dimensions: &[],
            max_string_length: 0,
            structure: None,
            optional: false,
        }
    }

    /// Creates a single structure.
    #[must_use]
    pub const fn structure(structure: &'a RawStructure<'a>) -> Self {
        Self {
            structure: Some(structure),
            ..Self::new(BuiltinType::ExtensionObject)
        }
    }

    /// Sets the MaxStringLength, in bytes.
    #[must_use]
    pub const fn with_max_string_length(self, max_string_length: u32) -> Self {
        Self {
            max_string_length,
            ..self
        }
    }

    /// Sets the ArrayDimensions, and the ValueRank to their number.
    #[must_use]
    pub fn with_dimensions(self, array_dimensions: &'a [u32]) -> Self {
        Self {
            value_rank: i32::try_from(array_dimensions.len()).unwrap_or(i32::MAX),
            array_dimensions,
            ..self
        }
    }

    /// Makes the field of a structure optional.
    #[must_use]
    pub const fn as_optional(self) -> Self {
        Self {
            optional: true,
            ..self
        }
    }

    fn check(&self) -> Result<(), RawLayoutFault> {
        match (self.element(), self.structure) {
            (Some(Element::Structure(_)), _) | (Some(_), None) => {}
            (_, Some(_)) => return Err(RawLayoutFault::NotAStructure(self.builtin)),
            (None, None) if self.builtin == BuiltinType::ExtensionObject => {
                return Err(RawLayoutFault::NoStructure);
            }
            (None, None) => return Err(RawLayoutFault::Type(self.builtin)),
        }
        let dimensions = self.array_dimensions.len();
        let rank = match self.value_rank {
            SCALAR => 0,
            rank => usize::try_from(rank)
                .ok()
                .filter(|rank| *rank > 0)
                .ok_or(RawLayoutFault::ValueRank(rank))?,
        };
        if dimensions != 0 && dimensions != rank {
            return Err(RawLayoutFault::ArrayDimensions {
                value_rank: self.value_rank,
                found: dimensions,
            });
        }
        let one = self.element_size(Form::Standard).unwrap_or_default();
        let all = self.size(Form::Standard).unwrap_or_default();
        if one.max(all) > MAX_SIZE {
            Err(RawLayoutFault::TooBig)
        } else {
            Ok(())
        }
    }

    /// Returns `None` for a type that is not allowed in RawData.
    pub(super) const fn element(&self) -> Option<Element<'a>> {
        match (self.builtin, self.structure) {
            (BuiltinType::String | BuiltinType::ByteString, _) => Some(Element::Text),
            (BuiltinType::ExtensionObject, Some(structure)) => Some(Element::Structure(structure)),
            (builtin, _) => match builtin.fixed_size() {
                Some(size) => Some(Element::Fixed(size)),
                None => None,
            },
        }
    }

    /// Returns the number of dimensions, 0 for a single value.
    pub(super) fn rank(&self) -> usize {
        usize::try_from(self.value_rank).unwrap_or_default()
    }

    /// Returns the maximum number of elements of a dimension, if the form uses it.
    pub(super) fn most_elements(&self, form: Form, dimension: usize) -> Option<u32> {
        match form {
            Form::Plain => None,
            Form::Standard | Form::Open62541 => {
                let most = self.array_dimensions.get(dimension).copied();
                most.filter(|most| *most != 0)
            }
        }
    }

    /// Returns the size to which a text is padded, in bytes.
    pub(super) fn text_room(&self, form: Form) -> Option<usize> {
        (form.pads_texts() && self.max_string_length != 0).then(|| to_usize(self.max_string_length))
    }

    /// Returns the bytes of the value or of an element, or `None` if variable.
    pub(super) fn element_size(&self, form: Form) -> Option<usize> {
        match self.element()? {
            Element::Fixed(size) => Some(size),
            Element::Text => self.text_room(form).map(|room| room.saturating_add(WORD)),
            Element::Structure(structure) => structure.size(form.nested()),
        }
    }

    /// Returns the minimum number of bytes of the value or of an element.
    pub(super) fn least_element_size(&self) -> usize {
        match self.element() {
            Some(Element::Fixed(size)) => size,
            Some(Element::Structure(structure)) => structure.least,
            Some(Element::Text) | None => WORD,
        }
    }

    /// Returns the number of bytes before the elements of an array.
    fn header_size(&self, form: Form) -> usize {
        let dimensions = self.rank().saturating_mul(WORD);
        match (self.value_rank, form) {
            (SCALAR, _) => 0,
            (1, _) | (_, Form::Open62541) => dimensions,
            (_, Form::Standard | Form::Plain) => dimensions.saturating_add(WORD),
        }
    }

    /// Returns the bytes of the maximum number of elements of an array, if known.
    fn elements_size(&self, form: Form) -> Option<usize> {
        if self.array_dimensions.is_empty() || self.array_dimensions.contains(&0) {
            return None;
        }
        let dimensions = self.array_dimensions.iter().copied().map(to_usize);
        let count = dimensions.fold(1, usize::saturating_mul);
        Some(count.saturating_mul(self.element_size(form)?))
    }

    /// Returns the size to which the elements of an array are padded, in bytes.
    pub(super) fn array_room(&self, form: Form) -> Option<usize> {
        match form {
            Form::Standard => self.elements_size(form),
            Form::Open62541 | Form::Plain => None,
        }
    }

    /// Returns the bytes of the field, or `None` if variable.
    pub(super) fn size(&self, form: Form) -> Option<usize> {
        match (self.value_rank, form) {
            (SCALAR, _) => self.element_size(form),
            (_, Form::Standard | Form::Open62541) => {
                let elements = self.elements_size(form)?;
                Some(elements.saturating_add(self.header_size(form)))
            }
            (_, Form::Plain) => None,
        }
    }

    /// Returns the bytes of an absent optional field.
    pub(super) fn absent_room(&self, form: Form) -> Option<usize> {
        match form {
            Form::Standard => self.size(form),
            Form::Open62541 | Form::Plain => None,
        }
    }

    fn least_size(&self) -> usize {
        match self.value_rank {
            SCALAR => self.least_element_size(),
            _ => WORD,
        }
    }
}

impl<'a> RawStructure<'a> {
    /// Maximum nesting depth of structures.
    pub const MAX_DEPTH: usize = 8;

    /// Creates a structure. `type_id` is its DefaultEncodingId, the NodeId of the binary encoding.
    ///
    /// # Errors
    /// The first invalid field.
    pub fn new(
        type_id: NodeId<'a>,
        structure_type: RawStructureType,
        fields: &'a [RawField<'a>],
    ) -> Result<Self, RawLayoutError> {
        let mut structure = Self {
            type_id,
            structure_type,
            fields,
            optional: 0,
            depth: 1,
            padded: Some(0),
            plain: Some(0),
            least: 0,
        };
        for (field, metadata) in fields.iter().enumerate() {
            structure
                .add(metadata)
                .map_err(|fault| RawLayoutError { field, fault })?;
        }
        if fields.is_empty() {
            let fault = RawLayoutFault::NoFields;
            return Err(RawLayoutError { field: 0, fault });
        }
        structure.add_head();
        Ok(structure)
    }

    /// Returns the NodeId of the binary encoding.
    #[must_use]
    pub const fn type_id(&self) -> NodeId<'a> {
        self.type_id
    }

    /// Returns the structure type.
    #[must_use]
    pub const fn structure_type(&self) -> RawStructureType {
        self.structure_type
    }

    /// Returns the fields.
    #[must_use]
    pub const fn fields(&self) -> &'a [RawField<'a>] {
        self.fields
    }

    /// Returns the number of optional fields, at most 32.
    pub(super) const fn optional(&self) -> u32 {
        self.optional
    }

    /// Returns the bytes in a form for structures, or `None` if variable.
    pub(super) const fn size(&self, form: Form) -> Option<usize> {
        match form {
            Form::Standard => self.padded,
            Form::Open62541 | Form::Plain => self.plain,
        }
    }

    /// Returns the size to which the selected field of a Union is padded, in bytes.
    pub(super) fn union_room(&self, form: Form) -> Option<usize> {
        match (self.structure_type, form) {
            (RawStructureType::Union, Form::Standard) => Some(self.padded?.saturating_sub(WORD)),
            _ => None,
        }
    }

    fn add(&mut self, field: &RawField<'_>) -> Result<(), RawLayoutFault> {
        field.check()?;
        if field.optional {
            self.optional += 1;
            let allowed = self.structure_type == RawStructureType::StructureWithOptionalFields;
            if !allowed || self.optional > u32::BITS {
                return Err(RawLayoutFault::Optional);
            }
        }
        if let Some(inner) = field.structure {
            self.depth = self.depth.max(inner.depth + 1);
            if self.depth > Self::MAX_DEPTH {
                return Err(RawLayoutFault::TooDeep);
            }
        }
        let padded = self.padded.zip(field.size(Form::Standard));
        let plain = self.plain.zip(field.size(Form::Plain));
        if self.structure_type == RawStructureType::Union {
            self.padded = padded.map(|(biggest, size)| biggest.max(size));
            self.plain = None;
        } else {
            self.padded = padded.map(|(sum, size)| sum.saturating_add(size));
            self.plain = if field.optional {
                None
            } else {
                plain.map(|(sum, size)| sum.saturating_add(size))
            };
            if !field.optional {
                self.least = self.least.saturating_add(field.least_size());
            }
        }
        match self.padded {
            Some(size) if size > MAX_SIZE - WORD => Err(RawLayoutFault::TooBig),
            _ => Ok(()),
        }
    }

    /// Adds the size of the EncodingMask or SwitchField.
    fn add_head(&mut self) {
        if self.structure_type == RawStructureType::Structure {
            return;
        }
        self.padded = self.padded.map(|size| size + WORD);
        self.plain = self.plain.map(|size| size + WORD);
        self.least = self.least.saturating_add(WORD);
    }
}

pub(super) fn to_usize(value: u32) -> usize {
    usize::try_from(value).unwrap_or(usize::MAX)
}

/// Maximum size of a ByteString of a chunked message. The sizes computed in this module do not
/// overflow below it.
const MAX_SIZE: usize = 0x7FFF_FFFF;
