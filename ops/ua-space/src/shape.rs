//! The JSON of a datagram, key by key. Absent or null keys are not on the wire. There are no keys
//! for flags, because the flags follow from the present keys.

use json_values::JsonFieldValue;
use serde::de::IgnoredAny;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// A NetworkMessage (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct DatagramJson {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) time: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) source: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) destination: Option<String>,
    /// The fault at which reading stopped.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) malformed: Option<String>,
    /// All bytes, if even the headers could not be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) datagram_hex: Option<String>,
    /// The properties of a message that was reassembled from chunks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) reassembled: Option<Value>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) uadp_version: Option<u8>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) network_message_type: Option<NetworkMessageTypeJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) publisher_id: Option<PublisherIdJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_class_id: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) group_header: Option<GroupHeaderJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_ids: Option<Vec<u16>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) timestamp: Option<TimestampJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) pico_seconds: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) promoted_fields: Option<Vec<JsonFieldValue>>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) security_header: Option<SecurityHeaderJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) action_header: Option<ActionHeaderJson>,
    /// The bytes after the headers, while they are encrypted or their signature is not verified.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sealed: Option<Sealed>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) chunk: Option<ChunkJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) probe: Option<ProbeJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) announcement: Option<AnnouncementJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_messages: Option<Vec<DataSetMessageJson>>,
    /// The origin of the datagram in files of test vectors; these keys are not written.
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
pub(crate) enum NetworkMessageTypeJson {
    DataSet,
    DiscoveryProbe,
    DiscoveryAnnouncement,
}

/// A PublisherId. `value` is a text for String, and for UInt64, because JSON readers may not keep
/// all digits of a 64-bit number.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct PublisherIdJson {
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
pub(crate) struct GroupHeaderJson {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) writer_group_id: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) group_version: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) network_message_number: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sequence_number: Option<u16>,
}

/// A DateTime of a header. If both keys are present, the ticks are used.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct TimestampJson {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) ticks100ns: Option<i64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) iso: Option<String>,
}

/// The SecurityHeader (OPC 10000-14, 7.2.4.4.3) and the SecurityFooter.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct SecurityHeaderJson {
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
    /// Payload, footer and signature, in hexadecimal.
    pub(crate) hex: String,
    /// True if the payload is a chunk.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) chunk: bool,
    /// True if the payload starts with an ActionHeader.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub(crate) action: bool,
}

/// The header of all requests or responses of a NetworkMessage (OPC 10000-14, 7.2.4.4.2).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct ActionHeaderJson {
    #[serde(rename = "type")]
    pub(crate) kind: ActionKindJson,
    /// The layout of the requests or responses.
    #[serde(default, skip_serializing_if = "ActionDialectJson::is_standard")]
    pub(crate) dialect: ActionDialectJson,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) response_address: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) correlation_data_hex: Option<String>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) requestor_id: Option<PublisherIdJson>,
    /// In milliseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) timeout_hint: Option<f64>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ActionKindJson {
    Request,
    Response,
}

/// The layout of the standard, or the layout of UA-.NETStandard without DataSetMessage headers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ActionDialectJson {
    #[default]
    Standard,
    UaNetStandard,
}

impl ActionDialectJson {
    #[expect(
        clippy::trivially_copy_pass_by_ref,
        reason = "what serde calls is given a reference"
    )]
    const fn is_standard(&self) -> bool {
        matches!(self, Self::Standard)
    }
}

/// The header of a request or response (OPC 10000-14, 7.2.4.5.9 and 7.2.4.5.10).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct ActionJson {
    pub(crate) target_id: u16,
    pub(crate) request_id: u16,
    pub(crate) state: ActionStateJson,
    /// Number of fields, for RawData.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) field_count: Option<u16>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase")]
pub(crate) enum ActionStateJson {
    Idle,
    Executing,
    Done,
}

/// A chunk of a message (OPC 10000-14, 7.2.4.4.4).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct ChunkJson {
    pub(crate) message_sequence_number: u16,
    pub(crate) chunk_offset: u32,
    pub(crate) total_size: u32,
    pub(crate) chunk_data_hex: String,
}

/// A discovery probe (OPC 10000-14, 7.2.4.6.12).
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct ProbeJson {
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

/// A discovery announcement (OPC 10000-14, 7.2.4.6.3).
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct AnnouncementJson {
    #[serde(rename = "type")]
    pub(crate) announcement_type: u8,
    pub(crate) sequence_number: u16,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_id: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) data_set_writer_ids: Option<Vec<u16>>,
    /// Number of endpoints in the body.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) endpoints: Option<usize>,
    /// The URLs in the body; only the body is written.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) endpoint_urls: Vec<String>,
    /// Number of connections in the body. If absent, the body is one connection and a StatusCode,
    /// as other stacks send it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) connections: Option<usize>,
    /// The name in the body; only the body is written.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) meta_data_name: Option<String>,
    /// The fields in the body; only the body is written.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub(crate) meta_data: Vec<FieldMetaData>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) status_code: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) status_codes: Option<Vec<u32>>,
    /// The bytes of the structures, without the values shown in other keys.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) body_hex: Option<String>,
}

/// A DataSetMessage (OPC 10000-14, 7.2.4.5.4).
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields, default)]
pub(crate) struct DataSetMessageJson {
    /// The fault at which reading stopped; the fields before it are included.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) malformed: Option<String>,
    pub(crate) valid: bool,
    #[serde(rename = "type")]
    pub(crate) kind: MessageKindJson,
    pub(crate) field_encoding: FieldEncodingJson,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) sequence_number: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) timestamp: Option<TimestampJson>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) pico_seconds: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) status16: Option<u16>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) major_version: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) minor_version: Option<u32>,
    /// The header of a request or response.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) action: Option<ActionJson>,
    /// Size in bytes to which the message is padded with zeros.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) configured_size: Option<u16>,
    /// All bytes of an invalid message, if the other keys do not represent them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) message_hex: Option<String>,
    /// The bytes of RawData without metadata.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) raw_data_hex: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) meta_data: Option<Vec<FieldMetaData>>,
    pub(crate) fields: Vec<FieldJson>,
}

impl Default for DataSetMessageJson {
    fn default() -> Self {
        Self {
            malformed: None,
            valid: true,
            kind: MessageKindJson::KeyFrame,
            field_encoding: FieldEncodingJson::Variant,
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
pub(crate) enum MessageKindJson {
    KeyFrame,
    DeltaFrame,
    Event,
    KeepAlive,
    ActionRequest,
    ActionResponse,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) enum FieldEncodingJson {
    Variant,
    RawData,
    DataValue,
}

/// The part of FieldMetaData that reading a RawData field needs (OPC 10000-14, 6.2.3.2.4).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "camelCase", deny_unknown_fields)]
pub(crate) struct FieldMetaData {
    /// The name for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) name: Option<String>,
    pub(crate) built_in_type: u8,
    /// -1 for a scalar, above that the number of dimensions.
    #[serde(default = "scalar_rank")]
    pub(crate) value_rank: i32,
    #[serde(default)]
    pub(crate) array_dimensions: Vec<u32>,
    #[serde(default)]
    pub(crate) max_string_length: u32,
    /// The NodeId of the DataType of a structure; only the known structures are supported.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) data_type: Option<String>,
}

const fn scalar_rank() -> i32 {
    -1
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FieldJson {
    /// The index of a field in a delta frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) index: Option<u16>,
    pub(crate) value: JsonFieldValue,
}
