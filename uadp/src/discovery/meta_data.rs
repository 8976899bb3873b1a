//! DataSetMetaData: names and types of the fields of a DataSet.

use super::list::WireArray;
use super::wire::{WireStructure, enumeration, structure};
use crate::reader::ByteReader;
use crate::{
    BuiltinType, ConfigurationVersion, DataSetHeader, DecodeError, EncodeError, Guid,
    LocalizedText, NodeId, QualifiedName, Variant,
};
use alloc::vec::Vec;

structure! {
    /// The content of a DataSet (OPC 10000-14, 6.2.3.2.3).
    DataSetMetaDataType<'a> {
        /// Definitions of field types beyond the builtin types.
        schema: DataTypeSchemaHeader<'a> = "DataTypeSchemaHeader",
        /// Name of the DataSet.
        name: Option<&'a str> = "Name",
        /// Description for people.
        description: LocalizedText<'a> = "Description",
        /// The fields, in the order of the DataSetMessages.
        fields: WireArray<'a, FieldMetaData<'a>> = "Fields",
        /// The DataSetClass; zero if there is no class.
        data_set_class_id: Guid = "DataSetClassId",
        /// Version for the check of DataSetMessages: see
        /// [`compare`](ConfigurationVersion::compare).
        configuration_version: ConfigurationVersion = "ConfigurationVersion",
    }

    /// A field of a DataSet (OPC 10000-14, 6.2.3.2.4).
    FieldMetaData<'a> {
        /// Unique in the DataSet.
        name: Option<&'a str> = "Name",
        /// Description for people.
        description: LocalizedText<'a> = "Description",
        /// DataSetFieldFlags (OPC 10000-14, 6.2.3.2.5): bit 0 marks a promoted field.
        field_flags: u16 = "FieldFlags",
        /// Id of the builtin type that encodes the field: see [`builtin_type`](Self::builtin_type).
        built_in_type: u8 = "BuiltInType",
        /// The DataType; its namespace index refers to the
        /// [schema](DataTypeSchemaHeader::namespace_uri).
        data_type: NodeId<'a> = "DataType",
        /// -1 for a scalar, otherwise the number of dimensions or the permitted numbers
        /// (OPC 10000-3, 5.6.2).
        value_rank: i32 = "ValueRank",
        /// Maximum number of elements in each dimension, 0 for no limit; null for a scalar.
        array_dimensions: WireArray<'a, u32> = "ArrayDimensions",
        /// Maximum bytes of a String or ByteString, 0 for no limit.
        max_string_length: u32 = "MaxStringLength",
        /// Identity of the field, independent of its name and position.
        data_set_field_id: Guid = "DataSetFieldId",
        /// Further properties of the field, such as its engineering unit.
        properties: WireArray<'a, KeyValuePair<'a>> = "Properties",
    }

    /// A property by name (OPC 10000-5, 12.21).
    KeyValuePair<'a> {
        /// The name.
        key: QualifiedName<'a> = "Key",
        /// The value.
        value: Variant<'a> = "Value",
    }

    /// Type definitions (OPC 10000-14, 6.2.3.2.2, and OPC 10000-5, 12.31).
    DataTypeSchemaHeader<'a> {
        /// Namespaces from index 1 on: see [`namespace_uri`](Self::namespace_uri).
        namespaces: WireArray<'a, Option<&'a str>> = "Namespaces",
        /// Structures and unions, including nested types.
        structure_data_types: WireArray<'a, StructureDescription<'a>> = "StructureDataTypes",
        /// Enumerations and option sets.
        enum_data_types: WireArray<'a, EnumDescription<'a>> = "EnumDataTypes",
        /// Aliases of builtin types.
        simple_data_types: WireArray<'a, SimpleTypeDescription<'a>> = "SimpleDataTypes",
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
        /// NodeId of the encoding in an ExtensionObject; null if the structure occurs only nested.
        default_encoding_id: NodeId<'a> = "DefaultEncodingId",
        /// Base DataType.
        base_data_type: NodeId<'a> = "BaseDataType",
        /// Layout of the fields.
        structure_type: StructureType = "StructureType",
        /// All fields in the order of the encoding, including the fields of the base type.
        fields: WireArray<'a, StructureField<'a>> = "Fields",
    }

    /// A field of a structure or union (OPC 10000-3, 8.51).
    StructureField<'a> {
        /// Unique in the structure.
        name: Option<&'a str> = "Name",
        /// Description for people.
        description: LocalizedText<'a> = "Description",
        /// The DataType.
        data_type: NodeId<'a> = "DataType",
        /// -1 for a scalar, otherwise the number of dimensions.
        value_rank: i32 = "ValueRank",
        /// Maximum number of elements in each dimension, 0 for no limit; null for a scalar.
        array_dimensions: WireArray<'a, u32> = "ArrayDimensions",
        /// Maximum bytes of a String or ByteString, 0 for no limit.
        max_string_length: u32 = "MaxStringLength",
        /// The field can be omitted or can hold a subtype, depending on the structure type.
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
        /// Id of the builtin type of the encoding: Int32 for an enumeration, otherwise the type of
        /// the option set.
        built_in_type: u8 = "BuiltInType",
    }

    /// The values of an enumeration, or the bits of an option set (OPC 10000-3, 8.50).
    EnumDefinition<'a> {
        /// The values or bits.
        fields: WireArray<'a, EnumField<'a>> = "Fields",
    }

    /// A value of an enumeration, or a bit of an option set (OPC 10000-3, 8.52).
    EnumField<'a> {
        /// The value, or the number of the bit.
        value: i64 = "Value",
        /// Its name, for people.
        display_name: LocalizedText<'a> = "DisplayName",
        /// Meaning, for people.
        description: LocalizedText<'a> = "Description",
        /// Name, unique in the enumeration.
        name: Option<&'a str> = "Name",
    }

    /// An alias of a builtin type (OPC 10000-5, 12.35).
    SimpleTypeDescription<'a> {
        /// NodeId of the DataType.
        data_type_id: NodeId<'a> = "DataTypeId",
        /// Name of the DataType.
        name: QualifiedName<'a> = "Name",
        /// Base DataType.
        base_data_type: NodeId<'a> = "BaseDataType",
        /// Id of the builtin type of the encoding.
        built_in_type: u8 = "BuiltInType",
    }
}

enumeration! {
    /// Layout of the fields of a structure (OPC 10000-3, 8.49).
    StructureType {
        /// The fields in sequence.
        STRUCTURE = 0,
        /// A mask of the present optional fields, then the fields.
        STRUCTURE_WITH_OPTIONAL_FIELDS = 1,
        /// A number that selects a field, then this field.
        UNION = 2,
        /// The fields in sequence; "optional" fields are encoded as ExtensionObjects or Variants.
        STRUCTURE_WITH_SUBTYPED_VALUES = 3,
        /// A union with "optional" fields that can hold subtypes, encoded as above.
        UNION_WITH_SUBTYPED_VALUES = 4,
    }
}

/// Compatibility of DataSetMetaData and a DataSetMessage (OPC 10000-14, 6.2.3.2.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum VersionMatch {
    /// The versions are equal as far as the message contains its version.
    Same,
    /// The versions differ in fields at the end; fields in both versions are the same.
    Minor,
    /// The metadata do not describe the message, and must not be used to decode it.
    Major,
    /// The message does not contain its version.
    Unsaid,
}

impl<'a> DataSetMetaDataType<'a> {
    /// Returns the field at a position in the DataSetMessages.
    #[must_use]
    pub fn field(&self, index: usize) -> Option<FieldMetaData<'a>> {
        self.fields.get(index)
    }

    /// Returns the first field with a name, and its position.
    #[must_use]
    pub fn field_by_name(&self, name: &str) -> Option<(usize, FieldMetaData<'a>)> {
        let mut fields = self.fields.iter().enumerate();
        fields.find(|(_, field)| field.name == Some(name))
    }

    /// Returns the first field with a DataSetFieldId, and its position.
    #[must_use]
    pub fn field_by_id(&self, id: Guid) -> Option<(usize, FieldMetaData<'a>)> {
        let mut fields = self.fields.iter().enumerate();
        fields.find(|(_, field)| field.data_set_field_id == id)
    }
}

impl<'a> DataTypeSchemaHeader<'a> {
    /// Returns the URI of a namespace index in the NodeIds and QualifiedNames of the metadata.
    /// Index 0 is the namespace of OPC UA, which is not in the list (OPC 10000-5, 12.31).
    #[must_use]
    pub fn namespace_uri(&self, index: u16) -> Option<&'a str> {
        match index.checked_sub(1) {
            None => Some("http://opcfoundation.org/UA/"),
            Some(index) => self.namespaces.get(index.into()).flatten(),
        }
    }

    /// Returns the structure or union of a DataType.
    #[must_use]
    pub fn structure(&self, data_type: NodeId<'_>) -> Option<StructureDescription<'a>> {
        let mut structures = self.structure_data_types.iter();
        structures.find(|structure| structure.data_type_id == data_type)
    }

    /// Returns the enumeration or option set of a DataType.
    #[must_use]
    pub fn enumeration(&self, data_type: NodeId<'_>) -> Option<EnumDescription<'a>> {
        let mut enumerations = self.enum_data_types.iter();
        enumerations.find(|enumeration| enumeration.data_type_id == data_type)
    }

    /// Returns the builtin type alias of a DataType.
    #[must_use]
    pub fn simple_type(&self, data_type: NodeId<'_>) -> Option<SimpleTypeDescription<'a>> {
        let mut simple_types = self.simple_data_types.iter();
        simple_types.find(|simple_type| simple_type.data_type_id == data_type)
    }
}

impl FieldMetaData<'_> {
    /// Returns the builtin type that encodes the field, or `None` for an invalid id.
    #[must_use]
    pub const fn builtin_type(&self) -> Option<BuiltinType> {
        BuiltinType::from_id(self.built_in_type)
    }

    /// Returns true if the field is also in the header of the NetworkMessage (OPC 10000-14,
    /// 6.2.3.2.5).
    #[must_use]
    pub const fn is_promoted(&self) -> bool {
        self.field_flags & PROMOTED_FIELD != 0
    }
}

impl<'a> EnumDefinition<'a> {
    /// Returns the value or bit with a number.
    #[must_use]
    pub fn field(&self, value: i64) -> Option<EnumField<'a>> {
        self.fields.iter().find(|field| field.value == value)
    }
}

/// ConfigurationVersionDataType (OPC 10000-14, 6.2.3.2.6).
impl<'a> WireStructure<'a> for ConfigurationVersion {
    const NULL: Self = Self { major: 0, minor: 0 };
    const MIN_SIZE: usize = 8;

    fn read(reader: &mut ByteReader<'a>, _: &'static str) -> Result<Self, DecodeError> {
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
    /// Compares the version of the metadata with the version in the header of a DataSetMessage.
    ///
    /// A minor version alone proves only equality: a different minor version may come with a
    /// different major version.
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
