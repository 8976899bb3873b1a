//! The JSON of a datagram, key by key. What is absent or null is not on the wire. There are no flags: they follow from
//! what is there.

use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// One NetworkMessage (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct Datagram {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) time: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) source: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) destination: Option<String>,
    /// Why it could not be read to the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) malformed: Option<String>,
    /// All bytes, where not even the headers could be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) datagram_hex: Option<String>,
    /// What was put together from chunks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) reassembled: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uadp_version: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) network_message_type: Option<NetworkMessageType>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) publisher_id: Option<PublisherId>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_class_id: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) group_header: Option<GroupHeader>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_ids: Option<Vec<u16>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) timestamp: Option<Timestamp>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) pico_seconds: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) promoted_fields: Option<Vec<FieldValue>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) security_header: Option<SecurityHeader>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) action_header: Option<ActionHeader>,
    /// What stands behind the headers, while it is encrypted or its signature was not verified.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sealed: Option<Sealed>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) chunk: Option<Chunk>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) probe: Option<Probe>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) announcement: Option<Announcement>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_messages: Option<Vec<DataSetMessage>>,
    /// Whence the datagram, in files of test vectors; nothing of it is written.
    #[serde(skip_serializing)]
    pub(crate) name: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) producer: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) length: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) notes: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) asyncua_self_decode: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) open62541_self_decode: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) json_source: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) contested: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) security: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) trailing_bytes: IgnoredAny,
    #[serde(skip_serializing)]
    pub(crate) discovery: IgnoredAny,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum NetworkMessageType {
    DataSet,
    DiscoveryProbe,
    DiscoveryAnnouncement,
}

/// `value` is a text where it does not fit in the number of a JSON reader: UInt64 and String.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PublisherId {
    #[serde(rename = "type")]
    pub(crate) id_type: PublisherIdType,
    pub(crate) value: Value,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum PublisherIdType {
    Byte,
    UInt16,
    UInt32,
    UInt64,
    String,
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct GroupHeader {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) writer_group_id: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) group_version: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) network_message_number: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sequence_number: Option<u16>,
}

/// A DateTime of a header. Where both are there the ticks count.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Timestamp {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) ticks100ns: Option<i64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) iso: Option<String>,
}

/// The SecurityHeader (OPC 10000-14, 7.2.4.4.3) and the SecurityFooter.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct SecurityHeader {
    pub(crate) signed: bool,
    pub(crate) encrypted: bool,
    pub(crate) footer_enabled: bool,
    pub(crate) force_key_reset: bool,
    pub(crate) security_token_id: u32,
    /// Hexadecimal.
    pub(crate) nonce: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) footer_size: Option<u16>,
    /// Hexadecimal.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) footer: Option<String>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Sealed {
    /// Payload, footer and signature.
    pub(crate) hex: String,
    /// The payload is a chunk.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) chunk: bool,
    /// The payload starts with an ActionHeader.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) action: bool,
}

/// What belongs to all requests or responses of a NetworkMessage (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct ActionHeader {
    #[serde(rename = "type")]
    pub(crate) kind: ActionKind,
    /// How the requests or responses are laid out.
    #[serde(default, skip_serializing_if = "ActionDialect::is_standard")]
    pub(crate) dialect: ActionDialect,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) response_address: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) correlation_data_hex: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) requestor_id: Option<PublisherId>,
    /// In milliseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) timeout_hint: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ActionKind {
    Request,
    Response,
}

/// By the text of the standard, or without DataSetMessage headers as UA-.NETStandard has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ActionDialect {
    #[default]
    Standard,
    UaNetStandard,
}

impl ActionDialect {
    #[expect(
        clippy::trivially_copy_pass_by_ref,
        reason = "what serde calls is given a reference"
    )]
    const fn is_standard(&self) -> bool {
        matches!(self, Self::Standard)
    }
}

/// What a request or response says of itself (OPC 10000-14, 7.2.4.5.9 and 7.2.4.5.10).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct Action {
    pub(crate) target_id: u16,
    pub(crate) request_id: u16,
    pub(crate) state: ActionState,
    /// Of RawData.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) field_count: Option<u16>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ActionState {
    Idle,
    Executing,
    Done,
}

/// A piece of a message (OPC 10000-14, 7.2.4.4.4).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct Chunk {
    pub(crate) message_sequence_number: u16,
    pub(crate) chunk_offset: u32,
    pub(crate) total_size: u32,
    pub(crate) chunk_data_hex: String,
}

/// What is asked for (OPC 10000-14, 7.2.4.6.12).
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct Probe {
    pub(crate) probe_type: u8,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) information_type: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_ids: Option<Vec<u16>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) writer_group_id: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) transport_profile_uris: Option<Vec<Option<String>>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) include_writer_groups: Option<bool>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) include_data_set_writers: Option<bool>,
}

/// What is announced (OPC 10000-14, 7.2.4.6.3).
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct Announcement {
    #[serde(rename = "type")]
    pub(crate) announcement_type: u8,
    pub(crate) sequence_number: u16,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_id: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_ids: Option<Vec<u16>>,
    /// How many there are in the body.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) endpoints: Option<usize>,
    /// As in the body, which counts.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) endpoint_urls: Vec<String>,
    /// How many there are in the body; without it that is one and a StatusCode, as other stacks have it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) connections: Option<usize>,
    /// As in the body, which counts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) meta_data_name: Option<String>,
    /// As in the body, which counts.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) meta_data: Vec<FieldMetaData>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) status_code: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) status_codes: Option<Vec<u32>>,
    /// The structures as they stand, without what is shown around them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) body_hex: Option<String>,
}

/// One DataSetMessage (OPC 10000-14, 7.2.4.5.4).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct DataSetMessage {
    /// Why it could not be read to the end; the fields before are there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) malformed: Option<String>,
    pub(crate) valid: bool,
    #[serde(rename = "type")]
    pub(crate) kind: MessageKind,
    pub(crate) field_encoding: FieldEncoding,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sequence_number: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) timestamp: Option<Timestamp>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) pico_seconds: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) status16: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) major_version: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) minor_version: Option<u32>,
    /// Of a request or response.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) action: Option<Action>,
    /// Bytes it is padded to with zeros.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) configured_size: Option<u16>,
    /// All bytes of a message that is not valid, where the other keys do not tell them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) message_hex: Option<String>,
    /// RawData as it stands, where no metadata says what it holds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) raw_data_hex: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) meta_data: Option<Vec<FieldMetaData>>,
    pub(crate) fields: Vec<Field>,
}

impl Default for DataSetMessage {
    fn default() -> Self {
        Self {
            malformed: None,
            valid: true,
            kind: MessageKind::KeyFrame,
            field_encoding: FieldEncoding::Variant,
            sequence_number: None,
            timestamp: None,
            pico_seconds: None,
            status16: None,
            major_version: None,
            minor_version: None,
            action: None,
            configured_size: None,
            message_hex: None,
            raw_data_hex: None,
            meta_data: None,
            fields: Vec::new(),
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum MessageKind {
    KeyFrame,
    DeltaFrame,
    Event,
    KeepAlive,
    ActionRequest,
    ActionResponse,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum FieldEncoding {
    Variant,
    RawData,
    DataValue,
}

/// What a reader has to know of a RawData field: a part of its FieldMetaData (OPC 10000-14, 6.2.3.2.4).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct FieldMetaData {
    /// For people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    pub(crate) built_in_type: u8,
    /// -1 is one value, above that the number of dimensions.
    #[serde(default = "scalar_rank")]
    pub(crate) value_rank: i32,
    #[serde(default)]
    pub(crate) array_dimensions: Vec<u32>,
    #[serde(default)]
    pub(crate) max_string_length: u32,
    /// NodeId of a structure's type; only those of the known structures.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) data_type: Option<String>,
}

const fn scalar_rank() -> i32 {
    -1
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Field {
    /// Of a delta frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) index: Option<u16>,
    pub(crate) value: FieldValue,
}

/// A Variant, and where it is a DataValue its quality and times. UaType 0 is the null Variant, no UaType is no value.
#[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "PascalCase", deny_unknown_fields, default)]
pub(crate) struct FieldValue {
    /// Number of the builtin type.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) ua_type: Option<u8>,
    /// The elements one after the other, the last dimension first, where it is an array.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) value: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) dimensions: Option<Vec<u32>>,
    /// The array is null, which is not an empty one.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub(crate) null_array: bool,
    #[serde(alias = "StatusCode", skip_serializing_if = "Option::is_none")]
    pub(crate) status: Option<Status>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) source_timestamp: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) source_picoseconds: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) server_timestamp: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) server_picoseconds: Option<u16>,
}

#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "PascalCase", deny_unknown_fields)]
pub(crate) struct Status {
    pub(crate) code: u32,
    /// Its name, for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) symbol: Option<String>,
}
