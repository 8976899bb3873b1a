//! DataSetMetaData: what the fields of a DataSet are called and what is in them.

use super::configuration::KeyValuePair;
use super::list::List;
use super::wire::{Structure, enumeration, structure};
use crate::reader::Reader;
use crate::{
    BuiltinType, ConfigurationVersion, DataSetHeader, DecodeError, EncodeError, Guid,
    LocalizedText, NodeId, QualifiedName,
};

structure! {
    /// The content of a DataSet (OPC 10000-14, 6.2.3.2.3).
    DataSetMetaDataType<'a> {
        /// The types the fields have beyond the builtin ones.
        schema: DataTypeSchemaHeader<'a> = "DataTypeSchemaHeader",
        /// Name of the DataSet.
        name: Option<&'a str> = "Name",
        /// What the DataSet is, for people.
        description: LocalizedText<'a> = "Description",
        /// The fields, in the order of the DataSetMessages.
        fields: List<'a, FieldMetaData<'a>> = "Fields",
        /// The DataSetClass; zero without one.
        data_set_class_id: Guid = "DataSetClassId",
        /// Which DataSetMessages this describes: see [`compare`](ConfigurationVersion::compare).
        configuration_version: ConfigurationVersion = "ConfigurationVersion",
    }

    /// One field of a DataSet (OPC 10000-14, 6.2.3.2.4).
    FieldMetaData<'a> {
        /// Unique in the DataSet.
        name: Option<&'a str> = "Name",
        /// What the field is, for people.
        description: LocalizedText<'a> = "Description",
        /// DataSetFieldFlags (OPC 10000-14, 6.2.3.2.5): bit 0 says that the field is promoted.
        field_flags: u16 = "FieldFlags",
        /// Id of the builtin type that encodes the field: see [`builtin_type`](Self::builtin_type).
        built_in_type: u8 = "BuiltInType",
        /// The DataType; its namespace index is one of the [schema](DataTypeSchemaHeader::namespace_uri).
        data_type: NodeId<'a> = "DataType",
        /// -1 for a scalar, else the number of dimensions or which numbers are allowed (OPC 10000-3, 5.6.2).
        value_rank: i32 = "ValueRank",
        /// Most elements in each dimension, 0 where that is open; null for a scalar.
        array_dimensions: List<'a, u32> = "ArrayDimensions",
        /// Most bytes of a String or ByteString, 0 where that is open.
        max_string_length: u32 = "MaxStringLength",
        /// Identity of the field, which stays when its name or place changes.
        data_set_field_id: Guid = "DataSetFieldId",
        /// More about the field, such as its engineering unit.
        properties: List<'a, KeyValuePair<'a>> = "Properties",
    }

    /// The types data refer to (OPC 10000-14, 6.2.3.2.2, and OPC 10000-5, 12.31).
    DataTypeSchemaHeader<'a> {
        /// Namespaces from index 1 on: see [`namespace_uri`](Self::namespace_uri).
        namespaces: List<'a, Option<&'a str>> = "Namespaces",
        /// Structures and unions, with those nested in them.
        structure_data_types: List<'a, StructureDescription<'a>> = "StructureDataTypes",
        /// Enumerations and option sets.
        enum_data_types: List<'a, EnumDescription<'a>> = "EnumDataTypes",
        /// Types that are a builtin type under another name.
        simple_data_types: List<'a, SimpleTypeDescription<'a>> = "SimpleDataTypes",
    }

    /// A structure or union (OPC 10000-5, 12.33).
    StructureDescription<'a> {
        /// NodeId of the DataType.
        data_type_id: NodeId<'a> = "DataTypeId",
        /// Name of the DataType.
        name: QualifiedName<'a> = "Name",
        /// Its fields.
        structure_definition: StructureDefinition<'a> = "StructureDefinition",
    }

    /// The fields of a structure or union (OPC 10000-3, 8.48).
    StructureDefinition<'a> {
        /// NodeId an ExtensionObject with this structure has; null when it only comes nested.
        default_encoding_id: NodeId<'a> = "DefaultEncodingId",
        /// The DataType this one extends.
        base_data_type: NodeId<'a> = "BaseDataType",
        /// How the fields are laid out.
        structure_type: StructureType = "StructureType",
        /// All fields in the order of the wire, those of the base type among them.
        fields: List<'a, StructureField<'a>> = "Fields",
    }

    /// One field of a structure or union (OPC 10000-3, 8.51).
    StructureField<'a> {
        /// Unique in the structure.
        name: Option<&'a str> = "Name",
        /// What the field is, for people.
        description: LocalizedText<'a> = "Description",
        /// The DataType.
        data_type: NodeId<'a> = "DataType",
        /// -1 for a scalar, else the number of dimensions.
        value_rank: i32 = "ValueRank",
        /// Most elements in each dimension, 0 where that is open; null for a scalar.
        array_dimensions: List<'a, u32> = "ArrayDimensions",
        /// Most bytes of a String or ByteString, 0 where that is open.
        max_string_length: u32 = "MaxStringLength",
        /// May be left out, or may hold a subtype, as the structure type says.
        is_optional: bool = "IsOptional",
    }

    /// An enumeration or option set (OPC 10000-5, 12.34).
    EnumDescription<'a> {
        /// NodeId of the DataType.
        data_type_id: NodeId<'a> = "DataTypeId",
        /// Name of the DataType.
        name: QualifiedName<'a> = "Name",
        /// Its values.
        enum_definition: EnumDefinition<'a> = "EnumDefinition",
        /// Id of the builtin type it is encoded as: Int32 for an enumeration, else that of the option set.
        built_in_type: u8 = "BuiltInType",
    }

    /// The values of an enumeration, or the bits of an option set (OPC 10000-3, 8.50).
    EnumDefinition<'a> {
        /// Value by value, or bit by bit.
        fields: List<'a, EnumField<'a>> = "Fields",
    }

    /// One value of an enumeration, or one bit of an option set (OPC 10000-3, 8.52).
    EnumField<'a> {
        /// The value, or the number of the bit.
        value: i64 = "Value",
        /// Its name, for people.
        display_name: LocalizedText<'a> = "DisplayName",
        /// What it means, for people.
        description: LocalizedText<'a> = "Description",
        /// Its name, unique in the enumeration.
        name: Option<&'a str> = "Name",
    }

    /// A type that is a builtin type under another name (OPC 10000-5, 12.35).
    SimpleTypeDescription<'a> {
        /// NodeId of the DataType.
        data_type_id: NodeId<'a> = "DataTypeId",
        /// Name of the DataType.
        name: QualifiedName<'a> = "Name",
        /// The DataType this one extends.
        base_data_type: NodeId<'a> = "BaseDataType",
        /// Id of the builtin type it is encoded as.
        built_in_type: u8 = "BuiltInType",
    }
}

enumeration! {
    /// How the fields of a structure are laid out (OPC 10000-3, 8.49).
    StructureType {
        /// One after the other.
        STRUCTURE = 0,
        /// Behind a mask that says which optional ones are there.
        STRUCTURE_WITH_OPTIONAL_FIELDS = 1,
        /// One of them, behind a number that says which.
        UNION = 2,
        /// One after the other, those that are "optional" as ExtensionObjects or Variants.
        STRUCTURE_WITH_SUBTYPED_VALUES = 3,
        /// One of them, as in a union, with subtypes as above.
        UNION_WITH_SUBTYPED_VALUES = 4,
    }
}

/// How DataSetMetaData and a DataSetMessage fit together (OPC 10000-14, 6.2.3.2.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum VersionMatch {
    /// The message is of the version described, or says nothing else.
    Same,
    /// Fields were added at the end since, or are still to come: those that both know are the same.
    Minor,
    /// The metadata are not those of the message, which is not to be decoded with them.
    Major,
    /// The message does not say its version.
    Unsaid,
}

impl<'a> DataSetMetaDataType<'a> {
    /// The field at a place of the DataSetMessages.
    #[must_use]
    pub fn field(&self, index: usize) -> Option<FieldMetaData<'a>> {
        self.fields.get(index)
    }

    /// The first field of a name, and its place.
    #[must_use]
    pub fn field_by_name(&self, name: &str) -> Option<(usize, FieldMetaData<'a>)> {
        let mut fields = self.fields.iter().enumerate();
        fields.find(|(_, field)| field.name == Some(name))
    }

    /// The first field with a DataSetFieldId, and its place.
    #[must_use]
    pub fn field_by_id(&self, id: Guid) -> Option<(usize, FieldMetaData<'a>)> {
        let mut fields = self.fields.iter().enumerate();
        fields.find(|(_, field)| field.data_set_field_id == id)
    }
}

impl<'a> DataTypeSchemaHeader<'a> {
    /// Name of a namespace index in the NodeIds and QualifiedNames of the metadata. 0 is the namespace of OPC UA,
    /// which is not in the list (OPC 10000-5, 12.31).
    #[must_use]
    pub fn namespace_uri(&self, index: u16) -> Option<&'a str> {
        match index.checked_sub(1) {
            None => Some("http://opcfoundation.org/UA/"),
            Some(index) => self.namespaces.get(index.into()).flatten(),
        }
    }

    /// The structure or union of a DataType.
    #[must_use]
    pub fn structure(&self, data_type: NodeId<'_>) -> Option<StructureDescription<'a>> {
        let mut structures = self.structure_data_types.iter();
        structures.find(|structure| structure.data_type_id == data_type)
    }

    /// The enumeration or option set of a DataType.
    #[must_use]
    pub fn enumeration(&self, data_type: NodeId<'_>) -> Option<EnumDescription<'a>> {
        let mut enumerations = self.enum_data_types.iter();
        enumerations.find(|enumeration| enumeration.data_type_id == data_type)
    }

    /// What is behind the other name of a builtin type.
    #[must_use]
    pub fn simple_type(&self, data_type: NodeId<'_>) -> Option<SimpleTypeDescription<'a>> {
        let mut simple_types = self.simple_data_types.iter();
        simple_types.find(|simple_type| simple_type.data_type_id == data_type)
    }
}

impl FieldMetaData<'_> {
    /// The builtin type that encodes the field; `None` for an id that is none.
    #[must_use]
    pub const fn builtin_type(&self) -> Option<BuiltinType> {
        BuiltinType::from_id(self.built_in_type)
    }

    /// True when the field also stands in the header of the NetworkMessage (OPC 10000-14, 6.2.3.2.5).
    #[must_use]
    pub const fn is_promoted(&self) -> bool {
        self.field_flags & PROMOTED_FIELD != 0
    }
}

impl<'a> EnumDefinition<'a> {
    /// The value or bit of a number.
    #[must_use]
    pub fn field(&self, value: i64) -> Option<EnumField<'a>> {
        self.fields.iter().find(|field| field.value == value)
    }
}

/// ConfigurationVersionDataType (OPC 10000-14, 6.2.3.2.6).
impl<'a> Structure<'a> for ConfigurationVersion {
    const NULL: Self = Self { major: 0, minor: 0 };
    const MIN_SIZE: usize = 8;

    fn read(reader: &mut Reader<'a>, _: &'static str) -> Result<Self, DecodeError> {
        Ok(Self {
            major: reader.u32("MajorVersion")?,
            minor: reader.u32("MinorVersion")?,
        })
    }

    fn write(&self, out: &mut Vec<u8>, _: &'static str) -> Result<(), EncodeError> {
        out.extend_from_slice(&self.major.to_le_bytes());
        out.extend_from_slice(&self.minor.to_le_bytes());
        Ok(())
    }
}

impl ConfigurationVersion {
    /// Holds the version the metadata have against the one in the header of a DataSetMessage.
    ///
    /// A minor version alone tells only what is equal: what differs in it may be a major change.
    #[must_use]
    pub const fn compare(self, message: &DataSetHeader) -> VersionMatch {
        match (message.major_version, message.minor_version) {
            (None, None) => VersionMatch::Unsaid,
            (Some(major), _) if major != self.major => VersionMatch::Major,
            (_, Some(minor)) if minor == self.minor => VersionMatch::Same,
            (Some(_), None) => VersionMatch::Same,
            (Some(_), Some(_)) => VersionMatch::Minor,
            (None, Some(_)) => VersionMatch::Major,
        }
    }
}

const PROMOTED_FIELD: u16 = 1;
