//! The structure that clients send and get of an application (OPC 10000-12, 6.6.5).

use std::sync::LazyLock;

use opcua::types::{
    ApplicationType, BinaryDecodable, BinaryEncodable, ExpandedMessageInfo, ExpandedNodeId,
    LocalizedText, NodeId, StaticTypeLoader, TypeLoaderInstance, UAString, UaNullable,
    XmlDecodable, XmlEncodable, XmlType, binary_decode_to_enc,
};

/// The namespace of the Directory.
pub(crate) const NAMESPACE: &str = "http://opcfoundation.org/UA/GDS/";

/// ApplicationRecordDataType.
#[derive(
    Debug,
    Clone,
    PartialEq,
    Default,
    BinaryEncodable,
    BinaryDecodable,
    XmlEncodable,
    XmlDecodable,
    XmlType,
    UaNullable,
)]
pub(crate) struct ApplicationRecord {
    pub(crate) application_id: NodeId,
    pub(crate) application_uri: UAString,
    pub(crate) application_type: ApplicationType,
    pub(crate) application_names: Option<Vec<LocalizedText>>,
    pub(crate) product_uri: UAString,
    pub(crate) discovery_urls: Option<Vec<UAString>>,
    pub(crate) server_capabilities: Option<Vec<UAString>>,
}

impl ExpandedMessageInfo for ApplicationRecord {
    fn full_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, BINARY)
    }

    fn full_json_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, JSON)
    }

    fn full_xml_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, XML)
    }

    fn full_data_type_id(&self) -> ExpandedNodeId {
        ExpandedNodeId::new_with_namespace(NAMESPACE, DATA_TYPE)
    }
}

/// Reads it in what clients send.
pub(crate) struct Types;

impl StaticTypeLoader for Types {
    fn instance() -> &'static TypeLoaderInstance {
        static TYPES: LazyLock<TypeLoaderInstance> = LazyLock::new(|| {
            let mut types = TypeLoaderInstance::new();
            types.add_binary_type(DATA_TYPE, BINARY, binary_decode_to_enc::<ApplicationRecord>);
            types
        });
        &TYPES
    }

    fn namespace() -> &'static str {
        NAMESPACE
    }
}

const DATA_TYPE: u32 = 1;
const BINARY: u32 = 134;
const XML: u32 = 127;
const JSON: u32 = 8001;
