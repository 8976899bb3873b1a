//! The fields of DataSets, from metadata in UADP and in JSON.

use std::collections::BTreeMap;

use mappings::TopicId;
use serde_json::{Value, json};
use uadp::discovery::{
    AnnouncedContent, Announcement, ConfigurationVersion, DataSetMetaDataType, FieldMetaData,
    WireArray,
};
use uadp::{BuiltinType, NetworkMessage, NodeId, PublisherId, SecurityHeader, StatusCode};

use super::names;

/// PublisherId, WriterGroupId and DataSetWriterId.
pub(super) type WriterIds = (u16, u16, u16);

/// The fields of the known DataSets.
#[derive(Debug, Default)]
pub(super) struct Descriptions {
    known: BTreeMap<WriterIds, Vec<DataSetField>>,
}

/// A field of a DataSet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct DataSetField {
    pub(super) name: String,
    /// The builtin type; `None` if the values have different types.
    pub(super) builtin: Option<BuiltinType>,
    /// The number of the DataType in namespace 0; `None` in another namespace.
    pub(super) data_type: Option<u32>,
    pub(super) value_rank: i32,
    /// Whether the field is copied into the headers of messages.
    pub(super) promoted: bool,
}

impl Descriptions {
    pub(super) fn of(&self, topic: WriterIds) -> Option<&[DataSetField]> {
        self.known.get(&topic).map(Vec::as_slice)
    }

    /// Records the metadata in a UADP message. Returns its topic and its DataSet.
    pub(super) fn learn(&mut self, message: &NetworkMessage<'_>) -> Option<WriterIds> {
        let (topic, meta_data) = meta_data(message)?;
        let fields = meta_data.fields.iter().map(|field| DataSetField {
            name: field.name.unwrap_or_default().to_owned(),
            builtin: field
                .builtin_type()
                .filter(|of| *of != BuiltinType::Variant),
            data_type: names::standard_number(field.data_type),
            value_rank: field.value_rank,
            promoted: field.is_promoted(),
        });
        self.insert(topic, fields.collect());
        Some(topic)
    }

    fn insert(&mut self, topic: WriterIds, fields: Vec<DataSetField>) {
        if self.known.len() < MAX_KNOWN || self.known.contains_key(&topic) {
            self.known.insert(topic, fields);
        }
    }

    /// Records the `MetaData` of a JSON message, and returns it as a UADP announcement.
    pub(super) fn read(&mut self, topic: WriterIds, json: &Value) -> Option<Vec<u8>> {
        let list = json.get("Fields")?.as_array()?;
        let fields: Vec<DataSetField> = list.iter().map(field).collect::<Option<_>>()?;
        let (publisher, group, writer) = topic;
        let name = json.get("Name").and_then(Value::as_str).unwrap_or_default();
        let name = if name.starts_with("ua_") {
            name.to_owned()
        } else {
            format!("ua_{publisher}_{group}_{writer} {name}")
        };
        let version = json.get("ConfigurationVersion").unwrap_or(&Value::Null);
        let number = |key: &str| {
            let number = version.get(key).and_then(Value::as_u64).unwrap_or_default();
            u32::try_from(number).unwrap_or_default()
        };
        let meta_data: Vec<FieldMetaData<'_>> = fields
            .iter()
            .map(|field| {
                let id = field.builtin.unwrap_or(BuiltinType::Variant).id();
                FieldMetaData {
                    name: Some(&field.name),
                    built_in_type: id,
                    data_type: NodeId::numeric(0, id.into()),
                    value_rank: field.value_rank,
                    ..FieldMetaData::default()
                }
            })
            .collect();
        let announcement = Announcement {
            sequence_number: 0,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id: writer,
                meta_data: DataSetMetaDataType {
                    name: Some(name.trim_end()),
                    fields: WireArray::new(&meta_data),
                    configuration_version: ConfigurationVersion {
                        major: number("MajorVersion"),
                        minor: number("MinorVersion"),
                    },
                    ..DataSetMetaDataType::default()
                },
                status: StatusCode::GOOD,
            },
        };
        let mut bytes = Vec::new();
        announcement
            .encode(
                PublisherId::UInt16(publisher),
                SecurityHeader::NONE,
                &mut bytes,
            )
            .ok()?;
        self.insert(topic, fields);
        Some(bytes)
    }
}

fn field(json: &Value) -> Option<DataSetField> {
    let number = json.get("BuiltInType").and_then(Value::as_u64);
    let builtin = number.and_then(|id| BuiltinType::from_id(u8::try_from(id).ok()?));
    let rank = json.get("ValueRank").and_then(Value::as_i64).unwrap_or(-1);
    Some(DataSetField {
        name: json.get("Name")?.as_str()?.to_owned(),
        builtin: builtin.filter(|of| *of != BuiltinType::Variant),
        data_type: json.get("DataType").and_then(names::standard_type),
        value_rank: i32::try_from(rank).ok()?,
        promoted: false,
    })
}

/// Returns the metadata in a UADP message as the `MetaData` of a JSON message.
pub(super) fn to_json(message: &NetworkMessage<'_>) -> Option<(WriterIds, Value)> {
    let (topic, meta_data) = meta_data(message)?;
    let fields: Vec<Value> = meta_data
        .fields
        .iter()
        .map(|field| {
            json!({
                "Name": field.name,
                "FieldFlags": field.field_flags,
                "BuiltInType": field.built_in_type,
                "DataType": json_values::node_ids::text(field.data_type),
                "ValueRank": field.value_rank,
                "ArrayDimensions": field.array_dimensions.iter().collect::<Vec<u32>>(),
                "MaxStringLength": field.max_string_length,
                "DataSetFieldId": field.data_set_field_id.to_string(),
            })
        })
        .collect();
    let ConfigurationVersion { major, minor } = meta_data.configuration_version;
    let shown = json!({
        "Name": meta_data.name,
        "Fields": fields,
        "ConfigurationVersion": {"MajorVersion": major, "MinorVersion": minor},
    });
    Some((topic, shown))
}

/// Returns the metadata in a UADP message, if it names a topic of the space.
fn meta_data<'a>(message: &NetworkMessage<'a>) -> Option<(WriterIds, DataSetMetaDataType<'a>)> {
    if message.is_sealed() || message.is_chunk() {
        return None;
    }
    let announced = Announcement::decode(message).ok()?.announced;
    let AnnouncedContent::DataSetMetaData {
        meta_data,
        status: StatusCode::GOOD,
        ..
    } = announced
    else {
        return None;
    };
    let name = meta_data.name?.split(' ').next()?;
    let topic = name.parse::<TopicId>().ok()?.triple();
    (crate::address::publisher(message) == Some(topic.0)).then_some((topic, meta_data))
}

const MAX_KNOWN: usize = 65_536;
