//! The payloads and the measured functions, with `uadp`.

use std::hint::black_box;

use uadp::{
    DataSetHeader, DateTime, GroupHeader, NetworkHeader, NetworkMessage, NetworkMessageEncoder,
    PublisherId, Scalar, Variant,
};

/// Content of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum EncodedContent {
    /// A single Double.
    Double,
    /// 20 Int32.
    Ints,
    /// A ByteString of 1 KiB.
    Bytes,
}

impl EncodedContent {
    pub(crate) const ALL: [Self; 3] = [Self::Double, Self::Ints, Self::Bytes];

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Double => "1 Double",
            Self::Ints => "20 Int32",
            Self::Bytes => "1 KiB ByteString",
        }
    }
}

pub(crate) const BLOB: [u8; 1024] = [0x5A; 1024];

/// Configuration of a writer, which is unknown at compile time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Config {
    header: NetworkHeader<'static>,
    writer_id: u16,
    data_set_header: DataSetHeader,
}

impl Config {
    pub(crate) fn new() -> Self {
        black_box(Self {
            header: NetworkHeader {
                publisher_id: Some(PublisherId::UInt16(2)),
                group: Some(GroupHeader {
                    writer_group_id: Some(5),
                    ..GroupHeader::default()
                }),
                ..NetworkHeader::default()
            },
            writer_id: 10,
            data_set_header: DataSetHeader {
                sequence_number: Some(0),
                timestamp: Some(DateTime(134_234_948_967_890_123)),
                status: Some(0),
                ..DataSetHeader::default()
            },
        })
    }
}

/// Encodes message number `number` to the start of the buffer.
#[inline(never)]
pub(crate) fn encode(
    payload: EncodedContent,
    number: u16,
    config: &Config,
    datagram: &mut Vec<u8>,
) {
    datagram.clear();
    let ids = [config.writer_id];
    let mut message = NetworkMessageEncoder::new(datagram, &config.header, Some(&ids)).unwrap();
    let data_set_header = DataSetHeader {
        sequence_number: Some(number),
        ..config.data_set_header
    };
    let mut fields = message.key_frame(&data_set_header).unwrap();
    match payload {
        EncodedContent::Double => fields.scalar(Scalar::Double(f64::from(number))).unwrap(),
        EncodedContent::Ints => {
            for index in 0..20 {
                fields
                    .scalar(Scalar::Int32(index + i32::from(number)))
                    .unwrap();
            }
        }
        EncodedContent::Bytes => fields.scalar(Scalar::ByteString(Some(&BLOB))).unwrap(),
    }
    fields.finish().unwrap();
    message.finish().unwrap();
}

/// Decodes the headers and every field. Returns a sum of their values.
#[inline(never)]
pub(crate) fn decode(datagram: &[u8]) -> u64 {
    let network = NetworkMessage::decode(datagram).unwrap();
    let mut seen = match network.publisher_id() {
        Some(PublisherId::UInt16(id)) => u64::from(id),
        _ => 0,
    };
    for message in network.messages() {
        let message = message.unwrap();
        seen += u64::from(message.writer_id.unwrap_or_default());
        seen += u64::from(message.sequence_number().unwrap_or_default());
        for field in message.fields().unwrap() {
            seen = seen.wrapping_add(match field.unwrap() {
                Variant::Scalar(Scalar::Double(value)) => value.to_bits(),
                Variant::Scalar(Scalar::Int32(value)) => value.unsigned_abs().into(),
                Variant::Scalar(Scalar::ByteString(Some(bytes))) => {
                    u64::from(*black_box(bytes).last().unwrap())
                }
                _ => 0,
            });
        }
    }
    seen
}
