//! What the DataSetMetaData says of the fields, and the sizes that follow from it.

use super::{Form, RawDialect, SCALAR, WORD};
use crate::{BuiltinType, NodeId};

/// What a receiver of RawData knows of the fields of a DataSet, in their order (OPC 10000-14, 6.2.3.2.3).
///
/// A DataSetMessage of RawData says nothing about its fields (OPC 10000-14, 7.2.4.5.11): they stand back to back like
/// the fields of a structure (OPC 10000-6, 5.2.6), structures without the envelope of an ExtensionObject. What is
/// shorter than its metadata allows is followed by zero bytes, so that every field keeps its place. Peers differ in
/// how, which is why reading and writing take a [`RawDialect`].
///
/// What the metadata gives no maximum for (a MaxStringLength of 0, no ArrayDimensions or one of 0) is not padded, and
/// the fields behind it have no place of their own. With all maxima known, [`fixed_size`](Self::fixed_size) and
/// [`field_offset`](Self::field_offset) say where every field stands, for patching a message in place.
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

/// One field of a DataSet (FieldMetaData: OPC 10000-14, 6.2.3.2.4) or of a structure (StructureField:
/// OPC 10000-3, 8.51).
///
/// An enumeration is an Int32. Not allowed are NodeId, ExpandedNodeId, QualifiedName, LocalizedText, XmlElement,
/// DiagnosticInfo and DataValue, nor Variant, which stands for abstract types (OPC 10000-14, 7.2.4.5.11 and 6.2.3.2.4).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawField<'a> {
    /// BuiltInType; ExtensionObject for a structure.
    pub builtin: BuiltinType,
    /// ValueRank: -1 for a single value, else the number of dimensions.
    pub value_rank: i32,
    /// ArrayDimensions: most elements of each dimension, 0 where that is unknown. Either empty or one per dimension.
    pub array_dimensions: &'a [u32],
    /// MaxStringLength: most bytes of a String or ByteString, 0 where that is unknown. Ignored for other types.
    pub max_string_length: u32,
    /// What the structure is made of, for ExtensionObject and only for that.
    pub structure: Option<&'a RawStructure<'a>>,
    /// IsOptional, in a [`RawStructureType::StructureWithOptionalFields`] only.
    pub optional: bool,
}

/// A structure DataType: what its StructureDefinition says (OPC 10000-3, 8.48).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawStructure<'a> {
    type_id: NodeId<'a>,
    structure_type: RawStructureType,
    fields: &'a [RawField<'a>],
    optional: u32,
    depth: usize,
    /// Bytes with all padding; `None` where they vary.
    padded: Option<usize>,
    /// Bytes without padding; `None` where they vary.
    plain: Option<usize>,
    /// Fewest bytes, padded or not.
    least: usize,
}

/// StructureType of a StructureDefinition (OPC 10000-3, 8.49). Those with subtyped values are not allowed in RawData.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum RawStructureType {
    /// All fields one after the other.
    Structure,
    /// An EncodingMask says which of the optional fields are there (OPC 10000-6, 5.2.7).
    StructureWithOptionalFields,
    /// A SwitchField says which one field is there (OPC 10000-6, 5.2.8).
    Union,
}

/// Why fields are no layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("field {field}: {fault}")]
pub struct RawLayoutError {
    /// Position in the fields given, from 0.
    pub field: usize,
    /// What is wrong with it.
    pub fault: RawLayoutFault,
}

/// What is wrong with a field of a layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RawLayoutFault {
    /// The standard does not allow the type in RawData.
    #[error("{0} is not allowed in RawData")]
    Type(BuiltinType),
    /// A structure of which nobody says what it is made of.
    #[error("an ExtensionObject without its structure")]
    NoStructure,
    /// Another type with a structure.
    #[error("{0} with a structure")]
    NotAStructure(BuiltinType),
    /// A ValueRank which leaves open whether the value is an array, or is none of the standard's.
    #[error("ValueRank {0} is neither -1 nor a number of dimensions")]
    ValueRank(i32),
    /// As many ArrayDimensions as there are dimensions, or none at all.
    #[error("{found} ArrayDimensions with ValueRank {value_rank}")]
    ArrayDimensions {
        /// ValueRank.
        value_rank: i32,
        /// Number of ArrayDimensions.
        found: usize,
    },
    /// An optional field where all fields have to be there, or more than 32 of them.
    #[error("an optional field too many")]
    Optional,
    /// Structures are nested deeper than [`RawStructure::MAX_DEPTH`].
    #[error("structures nested too deep")]
    TooDeep,
    /// A structure without fields has no size, so any number of them would fit in any message.
    #[error("a structure without fields")]
    NoFields,
    /// Up to here the fields take more than 2^31-1 bytes.
    #[error("more than 2^31-1 bytes")]
    TooBig,
}

/// What a value, or each element of an array, is made of.
pub(super) enum Element<'a> {
    Fixed(usize),
    Text,
    Structure(&'a RawStructure<'a>),
}

impl<'a> RawLayout<'a> {
    /// Layout of the fields of a DataSet.
    ///
    /// # Errors
    /// Names the first field which is not allowed.
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

    /// The fields.
    #[must_use]
    pub const fn fields(&self) -> &'a [RawField<'a>] {
        self.fields
    }

    /// Bytes of every payload; `None` where they vary, as something has no known maximum.
    ///
    /// In the dialect of open62541 this holds for what is written, not for a shorter array that is read.
    #[must_use]
    pub fn fixed_size(&self, dialect: RawDialect) -> Option<usize> {
        fixed_size(self.fields, dialect)
    }

    /// Bytes from the start of the payload to a field, the same in every payload; `None` where they vary, and for a
    /// field that is none. [`fixed_size`](Self::fixed_size) says more on it.
    ///
    /// At the offset of a text or array stands its length, not its content.
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
    /// A single value of unknown maximum length.
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

    /// A single structure.
    #[must_use]
    pub const fn structure(structure: &'a RawStructure<'a>) -> Self {
        Self {
            structure: Some(structure),
            ..Self::new(BuiltinType::ExtensionObject)
        }
    }

    /// With a MaxStringLength, in bytes.
    #[must_use]
    pub const fn with_max_string_length(self, max_string_length: u32) -> Self {
        Self {
            max_string_length,
            ..self
        }
    }

    /// An array of these ArrayDimensions, its ValueRank their number.
    #[must_use]
    pub fn with_dimensions(self, array_dimensions: &'a [u32]) -> Self {
        Self {
            value_rank: i32::try_from(array_dimensions.len()).unwrap_or(i32::MAX),
            array_dimensions,
            ..self
        }
    }

    /// An optional field of a structure.
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
        match one.max(all) > MAX_SIZE {
            true => Err(RawLayoutFault::TooBig),
            false => Ok(()),
        }
    }

    /// `None` for what is not allowed in RawData.
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

    /// Number of dimensions, 0 for a single value.
    pub(super) fn rank(&self) -> usize {
        usize::try_from(self.value_rank).unwrap_or_default()
    }

    /// Most elements of a dimension, where the form minds.
    pub(super) fn most_elements(&self, form: Form, dimension: usize) -> Option<u32> {
        match form {
            Form::Plain => None,
            Form::Standard | Form::Open62541 => {
                let most = self.array_dimensions.get(dimension).copied();
                most.filter(|most| *most != 0)
            }
        }
    }

    /// Bytes a text is padded to.
    pub(super) fn text_room(&self, form: Form) -> Option<usize> {
        (form.pads_texts() && self.max_string_length != 0).then(|| to_usize(self.max_string_length))
    }

    /// Bytes of the value, or of one element; `None` where they vary.
    pub(super) fn element_size(&self, form: Form) -> Option<usize> {
        match self.element()? {
            Element::Fixed(size) => Some(size),
            Element::Text => self.text_room(form).map(|room| room.saturating_add(WORD)),
            Element::Structure(structure) => structure.size(form.nested()),
        }
    }

    /// Fewest bytes of the value, or of one element.
    pub(super) fn least_element_size(&self) -> usize {
        match self.element() {
            Some(Element::Fixed(size)) => size,
            Some(Element::Structure(structure)) => structure.least,
            Some(Element::Text) | None => WORD,
        }
    }

    /// Bytes in front of the elements of an array.
    fn header_size(&self, form: Form) -> usize {
        let dimensions = self.rank().saturating_mul(WORD);
        match (self.value_rank, form) {
            (SCALAR, _) => 0,
            (1, _) | (_, Form::Open62541) => dimensions,
            (_, Form::Standard | Form::Plain) => dimensions.saturating_add(WORD),
        }
    }

    /// Bytes of all elements an array can have, where their number is known.
    fn elements_size(&self, form: Form) -> Option<usize> {
        if self.array_dimensions.is_empty() || self.array_dimensions.contains(&0) {
            return None;
        }
        let dimensions = self.array_dimensions.iter().copied().map(to_usize);
        let count = dimensions.fold(1, usize::saturating_mul);
        Some(count.saturating_mul(self.element_size(form)?))
    }

    /// Bytes the elements of an array are padded to.
    pub(super) fn array_room(&self, form: Form) -> Option<usize> {
        match form {
            Form::Standard => self.elements_size(form),
            Form::Open62541 | Form::Plain => None,
        }
    }

    /// Bytes of the field, `None` where they vary.
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

    /// Bytes of an optional field which is not there.
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
    /// How deep structures may stand in structures.
    pub const MAX_DEPTH: usize = 8;

    /// A structure. `type_id` is its DefaultEncodingId, the NodeId of the binary encoding.
    ///
    /// # Errors
    /// Names the first field which is not allowed.
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

    /// NodeId of the binary encoding.
    #[must_use]
    pub const fn type_id(&self) -> NodeId<'a> {
        self.type_id
    }

    /// Which of the fields are there.
    #[must_use]
    pub const fn structure_type(&self) -> RawStructureType {
        self.structure_type
    }

    /// The fields.
    #[must_use]
    pub const fn fields(&self) -> &'a [RawField<'a>] {
        self.fields
    }

    /// Number of optional fields, 32 at most.
    pub(super) const fn optional(&self) -> u32 {
        self.optional
    }

    /// Bytes in one form of those which structures stand in; `None` where they vary.
    pub(super) const fn size(&self, form: Form) -> Option<usize> {
        match form {
            Form::Standard => self.padded,
            Form::Open62541 | Form::Plain => self.plain,
        }
    }

    /// Bytes the chosen field of a Union is padded to.
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
            self.plain = match field.optional {
                true => None,
                false => plain.map(|(sum, size)| sum.saturating_add(size)),
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

    /// The EncodingMask or SwitchField.
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

/// The longest ByteString of a chunked message; no sizes computed here overflow below it.
const MAX_SIZE: usize = 0x7FFF_FFFF;
