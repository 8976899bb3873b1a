//! The fields of a writer's DataSet: their names, and the information for reading RawData
//! (OPC 10000-14, 7.2.4.5.11).

use std::net::{Ipv4Addr, SocketAddr};

use mappings::Variable;
use messages::ArrayRank;
use uadp::discovery::{DataSetMetaDataType, VersionMatch};
use uadp::{BuiltinType, ConfigurationVersion, DataSetHeader, RawField};

use crate::call::split_name;
use crate::description::{DescriptionFault, MAX_FIELDS, MAX_NAME};
use crate::learned::Weight;

/// The fields of a DataSet, as announced by its writer or as defined in the mapping.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct DataSetLayout {
    from: SocketAddr,
    version: ConfigurationVersion,
    /// The display name; may be empty.
    name: String,
    fields: Vec<Field>,
}

#[derive(Debug, PartialEq, Eq)]
struct Field {
    name: String,
    builtin: BuiltinType,
    value_rank: i32,
    array_dimensions: Vec<u32>,
    max_string_length: u32,
}

impl DataSetLayout {
    /// Reads the announcement of the sender at the address `from`.
    ///
    /// # Errors
    /// Returns the reason if the announcement cannot be used.
    pub(crate) fn read(
        meta_data: &DataSetMetaDataType<'_>,
        from: SocketAddr,
    ) -> Result<Self, DescriptionFault> {
        if meta_data.fields.len() > MAX_FIELDS {
            return Err(DescriptionFault::Fields(MAX_FIELDS));
        }
        let fields = meta_data.fields.iter().map(|field| {
            let name = field.name.unwrap_or_default();
            if name.len() > MAX_NAME {
                return Err(DescriptionFault::FieldName);
            }
            let Some(builtin) = field.builtin_type() else {
                return Err(DescriptionFault::Builtin(field.built_in_type));
            };
            if field.array_dimensions.len() > MAX_DIMENSIONS {
                return Err(DescriptionFault::Dimensions(MAX_DIMENSIONS));
            }
            Ok(Field {
                name: name.to_owned(),
                builtin,
                value_rank: field.value_rank,
                array_dimensions: field.array_dimensions.iter().collect(),
                max_string_length: field.max_string_length,
            })
        });
        let (_, name) = meta_data.name.and_then(split_name).unzip();
        let name = name.filter(|name| name.len() <= MAX_NAME);
        Ok(Self {
            from,
            version: meta_data.configuration_version,
            name: name.unwrap_or_default().to_owned(),
            fields: fields.collect::<Result<_, _>>()?,
        })
    }

    /// Returns the fields of a mapped value. Only arrays with a fixed length in ROS have a length.
    pub(crate) fn mapped(variable: &Variable) -> Self {
        let fields = variable.fields.iter().map(|leaf| {
            let (value_rank, array_dimensions) = match leaf.rank {
                ArrayRank::Scalar => (-1, Vec::new()),
                ArrayRank::Array { fixed } => (1, fixed.into_iter().collect()),
            };
            let declared = variable.value_type.map(|(builtin, _)| builtin);
            Field {
                name: leaf.path.clone(),
                builtin: declared.unwrap_or(leaf.builtin),
                value_rank,
                array_dimensions,
                max_string_length: 0,
            }
        });
        Self {
            from: (Ipv4Addr::UNSPECIFIED, 0).into(),
            version: ConfigurationVersion::default(),
            name: variable.name.clone(),
            fields: fields.collect(),
        }
    }

    /// Returns the display name, which is empty if the writer announced none.
    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    /// Returns whether the sender at the address announced this layout.
    pub(crate) fn is_of(&self, from: SocketAddr) -> bool {
        self.from == from
    }

    /// Returns whether messages with this header have these fields. Headers without a version
    /// match.
    pub(crate) fn is_current(&self, header: &DataSetHeader) -> bool {
        self.version.compare(header) != VersionMatch::Major
    }

    /// Returns the index of the field with the name.
    pub(crate) fn place_of(&self, name: &str) -> Option<u16> {
        let at = self.fields.iter().position(|field| field.name == name)?;
        u16::try_from(at).ok()
    }

    /// Returns the information for reading RawData. Structures have no definition, because it is
    /// not stored.
    pub(crate) fn raw_fields(&self) -> Vec<RawField<'_>> {
        let fields = self.fields.iter().map(|field| RawField {
            value_rank: field.value_rank,
            array_dimensions: &field.array_dimensions,
            max_string_length: field.max_string_length,
            ..RawField::new(field.builtin)
        });
        fields.collect()
    }
}

impl Weight for DataSetLayout {
    fn weight(&self) -> usize {
        let inner = self
            .fields
            .iter()
            .map(|field| field.name.len() + size_of_val(&*field.array_dimensions));
        inner.sum::<usize>()
            + self.name.len()
            + self.fields.len() * size_of::<Field>()
            + size_of::<Self>()
    }
}

/// A plausibility limit, because OPC UA does not limit the number of dimensions.
const MAX_DIMENSIONS: usize = 16;
