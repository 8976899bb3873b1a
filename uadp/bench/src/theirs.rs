//! The same payloads with `zerodds-opcua-pubsub` in its fastest form: owned values created before
//! the measurement, and a buffer of sufficient size.

use std::hint::black_box;

use zerodds_opcua_gateway::data_value::{Variant, VariantValue};
use zerodds_opcua_pubsub::uadp::{DataSetMessage, GroupHeader, NetworkMessage, PublisherId};
use zerodds_opcua_pubsub::{UaEncode, UaWriter, from_binary};

use crate::ours::{BLOB, EncodedContent};

/// Returns a message to encode; its creation is not measured.
pub(crate) fn message(payload: EncodedContent) -> NetworkMessage {
    let fields = match payload {
        EncodedContent::Double => vec![Variant::scalar(VariantValue::Double(2.5))],
        EncodedContent::Ints => (0..20)
            .map(|n| Variant::scalar(VariantValue::Int32(n)))
            .collect(),
        EncodedContent::Bytes => vec![Variant::scalar(VariantValue::ByteString(BLOB.to_vec()))],
    };
    NetworkMessage {
        publisher_id: Some(PublisherId::UInt16(2)),
        group_header: Some(GroupHeader {
            writer_group_id: Some(5),
            ..GroupHeader::default()
        }),
        ..NetworkMessage::with_messages(vec![DataSetMessage {
            sequence_number: Some(1),
            timestamp: Some(134_234_948_967_890_123),
            status: Some(0),
            ..DataSetMessage::key_frame_variant(10, fields)
        }])
    }
}

/// Encodes into a new buffer, which is the only option of that crate.
#[inline(never)]
pub(crate) fn encode(message: &NetworkMessage) -> UaWriter {
    let mut writer = UaWriter::with_capacity(2048);
    message.encode(&mut writer).unwrap();
    writer
}

/// Decodes into owned values.
#[inline(never)]
pub(crate) fn decode(datagram: &[u8]) {
    let message: NetworkMessage = from_binary(datagram).unwrap();
    black_box(message);
}
