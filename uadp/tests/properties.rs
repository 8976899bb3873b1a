//! What holds for every message: it comes back as it was written, no part of it passes for the whole, and no bytes
//! whatsoever make the reader panic.

#![expect(clippy::unwrap_used, clippy::indexing_slicing, reason = "test code")]

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use uadp::{
    Array, BuiltinType, DataSetHeader, DateTime, DecodeError, ExpandedNodeId, ExtensionBody,
    ExtensionObject, GroupHeader, Guid, Identifier, LocalizedText, MessageKind, NetworkHeader,
    NetworkMessage, NetworkMessageEncoder, NodeId, PublisherId, QualifiedName, Scalar, StatusCode,
    Variant,
};

/// Owned text and bytes, from which a [`Scalar`] of any type borrows.
#[derive(Debug, Clone)]
struct Seed {
    builtin: BuiltinType,
    number: u64,
    wide: [u8; 16],
    text: Option<String>,
    other_text: Option<String>,
    bytes: Option<Vec<u8>>,
    choice: u8,
}

impl Seed {
    fn node_id(&self) -> NodeId<'_> {
        let [a, b, ..] = self.wide;
        let namespace = match self.choice & 3 {
            0 => 0,
            1 => u16::from(a),
            _ => u16::from_le_bytes([a, b]),
        };
        let identifier = match self.choice >> 2 & 7 {
            0 => Identifier::Numeric((self.number & 0xFF) as u32),
            1 => Identifier::Numeric((self.number & 0xFFFF) as u32),
            2 | 3 => Identifier::Numeric((self.number & 0xFFFF_FFFF) as u32),
            4 => Identifier::Guid(Guid(self.wide)),
            5 => Identifier::Opaque(self.bytes.as_deref()),
            _ => Identifier::String(self.text.as_deref()),
        };
        NodeId {
            namespace,
            identifier,
        }
    }

    fn scalar(&self) -> Scalar<'_> {
        let [a, b, c, d, e, f, g, h] = self.number.to_le_bytes();
        let eight = self.number.to_le_bytes();
        match self.builtin {
            BuiltinType::Boolean => Scalar::Boolean(a & 1 == 1),
            BuiltinType::SByte => Scalar::SByte(i8::from_le_bytes([a])),
            BuiltinType::Byte => Scalar::Byte(a),
            BuiltinType::Int16 => Scalar::Int16(i16::from_le_bytes([a, b])),
            BuiltinType::UInt16 => Scalar::UInt16(u16::from_le_bytes([a, b])),
            BuiltinType::Int32 => Scalar::Int32(i32::from_le_bytes([a, b, c, d])),
            BuiltinType::UInt32 => Scalar::UInt32(u32::from_le_bytes([e, f, g, h])),
            BuiltinType::Int64 => Scalar::Int64(i64::from_le_bytes(eight)),
            BuiltinType::UInt64 => Scalar::UInt64(self.number),
            BuiltinType::Float => Scalar::Float(f32::from_le_bytes([a, b, c, d])),
            BuiltinType::Double => Scalar::Double(f64::from_le_bytes(eight)),
            BuiltinType::String => Scalar::String(self.text.as_deref()),
            BuiltinType::DateTime => Scalar::DateTime(DateTime(i64::from_le_bytes(eight))),
            BuiltinType::Guid => Scalar::Guid(Guid(self.wide)),
            BuiltinType::ByteString => Scalar::ByteString(self.bytes.as_deref()),
            BuiltinType::XmlElement => Scalar::XmlElement(self.text.as_deref()),
            BuiltinType::NodeId => Scalar::NodeId(self.node_id()),
            BuiltinType::ExpandedNodeId => Scalar::ExpandedNodeId(ExpandedNodeId {
                node_id: self.node_id(),
                namespace_uri: self.other_text.as_deref(),
                server_index: u32::from(a & 3),
            }),
            BuiltinType::StatusCode => {
                Scalar::StatusCode(StatusCode(u32::from_le_bytes([a, b, c, d])))
            }
            BuiltinType::QualifiedName => Scalar::QualifiedName(QualifiedName {
                namespace: u16::from_le_bytes([a, b]),
                name: self.text.as_deref(),
            }),
            BuiltinType::LocalizedText => Scalar::LocalizedText(LocalizedText {
                locale: self.other_text.as_deref(),
                text: self.text.as_deref(),
            }),
            BuiltinType::ExtensionObject
            | BuiltinType::DataValue
            | BuiltinType::Variant
            | BuiltinType::DiagnosticInfo => Scalar::ExtensionObject(ExtensionObject {
                type_id: self.node_id(),
                body: match (&self.bytes, &self.other_text) {
                    (Some(bytes), _) => ExtensionBody::Binary(bytes),
                    (None, Some(text)) => ExtensionBody::Xml(text),
                    (None, None) => ExtensionBody::None,
                },
            }),
        }
    }
}

#[derive(Debug, Clone)]
enum Field {
    Null,
    Scalar(Seed),
    Array(BuiltinType, Option<Vec<Seed>>),
}

#[derive(Debug, Clone)]
struct Message {
    writer_id: u16,
    header: DataSetHeader,
    /// `None` is a keep-alive.
    fields: Option<Vec<Field>>,
}

#[derive(Debug, Clone)]
struct Network {
    header: NetworkHeader<'static>,
    publisher_name: Option<String>,
    payload_header: bool,
    messages: Vec<Message>,
}

impl Network {
    fn header(&self) -> NetworkHeader<'_> {
        match &self.publisher_name {
            Some(name) => NetworkHeader {
                publisher_id: Some(PublisherId::String(name)),
                ..self.header
            },
            None => self.header,
        }
    }

    fn messages(&self) -> &[Message] {
        if self.payload_header {
            &self.messages
        } else {
            &self.messages[..1]
        }
    }

    fn encode(&self) -> Vec<u8> {
        let ids: Vec<u16> = self
            .messages
            .iter()
            .map(|message| message.writer_id)
            .collect();
        let mut out = Vec::new();
        let ids = self.payload_header.then_some(&*ids);
        let mut encoder = NetworkMessageEncoder::new(&mut out, &self.header(), ids).unwrap();
        for message in self.messages() {
            let Some(fields) = &message.fields else {
                encoder.keep_alive(&message.header).unwrap();
                continue;
            };
            let mut out = encoder.key_frame(&message.header).unwrap();
            for field in fields {
                match field {
                    Field::Null => out.null().unwrap(),
                    Field::Scalar(seed) => out.scalar(seed.scalar()).unwrap(),
                    Field::Array(builtin, None) => {
                        out.variant(&Variant::Array(Array::null(*builtin))).unwrap();
                    }
                    Field::Array(builtin, Some(seeds)) => {
                        out.array(*builtin, seeds.len()).unwrap();
                        for seed in seeds {
                            out.element(seed.scalar()).unwrap();
                        }
                    }
                }
            }
            out.finish().unwrap();
        }
        encoder.finish().unwrap();
        out
    }
}

/// Reads everything; the number of fields.
fn read_all(datagram: &[u8]) -> Result<usize, DecodeError> {
    let mut count = 0;
    for message in NetworkMessage::decode(datagram)?.messages() {
        for field in message?.fields()? {
            if let Variant::Array(array) = field? {
                assert_eq!(array.iter().count(), array.len());
            }
            count += 1;
        }
    }
    Ok(count)
}

/// As [`read_all`], but goes on behind every error.
fn read_on(datagram: &[u8]) {
    let Ok(network) = NetworkMessage::decode(datagram) else {
        return;
    };
    for message in network.messages().flatten() {
        let Ok(fields) = message.fields() else {
            continue;
        };
        let whole = fields.checked_bytes();
        let each: Result<Vec<_>, _> = fields.clone().collect();
        assert_eq!(whole.map(|_| ()), each.map(|_| ()));
        for field in fields.flatten() {
            if let Variant::Array(array) = field {
                assert_eq!(array.iter().count(), array.len());
            }
        }
    }
}

/// Equal as bits: a NaN is the same NaN.
fn same(a: &Scalar<'_>, b: &Scalar<'_>) -> bool {
    match (a, b) {
        (Scalar::Float(a), Scalar::Float(b)) => a.to_bits() == b.to_bits(),
        (Scalar::Double(a), Scalar::Double(b)) => a.to_bits() == b.to_bits(),
        (a, b) => a == b,
    }
}

fn builtin() -> impl Strategy<Value = BuiltinType> {
    (1u8..=22).prop_map(|id| BuiltinType::from_id(id).unwrap())
}

fn seed(builtin: impl Strategy<Value = BuiltinType>) -> impl Strategy<Value = Seed> {
    (
        builtin,
        any::<u64>(),
        any::<[u8; 16]>(),
        option::of(".{0,6}"),
        option::of(".{0,3}"),
        option::of(vec(any::<u8>(), 0..9)),
        any::<u8>(),
    )
        .prop_map(
            |(builtin, number, wide, text, other_text, bytes, choice)| Seed {
                builtin,
                number,
                wide,
                text,
                other_text,
                bytes,
                choice,
            },
        )
}

fn field() -> impl Strategy<Value = Field> {
    prop_oneof![
        1 => Just(Field::Null),
        6 => seed(builtin()).prop_map(Field::Scalar),
        3 => builtin().prop_flat_map(|builtin| {
            option::weighted(0.9, vec(seed(Just(builtin)), 0..4))
                .prop_map(move |seeds| Field::Array(builtin, seeds))
        }),
    ]
}

fn data_set_header() -> impl Strategy<Value = DataSetHeader> {
    (
        any::<bool>(),
        option::of(any::<u16>()),
        option::of(any::<i64>()),
        option::of(0..=9999u16),
        option::of(any::<u16>()),
        option::of(any::<u32>()),
        option::of(any::<u32>()),
    )
        .prop_map(
            |(valid, sequence_number, timestamp, picoseconds, status, major, minor)| {
                DataSetHeader {
                    valid,
                    sequence_number,
                    timestamp: timestamp.map(DateTime),
                    picoseconds,
                    status,
                    major_version: major,
                    minor_version: minor,
                }
            },
        )
}

fn message() -> impl Strategy<Value = Message> {
    (
        any::<u16>(),
        data_set_header(),
        option::weighted(0.9, vec(field(), 0..6)),
    )
        .prop_map(|(writer_id, header, fields)| Message {
            writer_id,
            header,
            fields,
        })
}

fn group_header() -> impl Strategy<Value = GroupHeader> {
    (
        option::of(any::<u16>()),
        option::of(any::<u32>()),
        option::of(any::<u16>()),
        option::of(any::<u16>()),
    )
        .prop_map(
            |(writer_group_id, group_version, network_message_number, sequence_number)| {
                GroupHeader {
                    writer_group_id,
                    group_version,
                    network_message_number,
                    sequence_number,
                }
            },
        )
}

fn network() -> impl Strategy<Value = Network> {
    let publisher_id = prop_oneof![
        any::<u8>().prop_map(PublisherId::Byte),
        any::<u16>().prop_map(PublisherId::UInt16),
        any::<u32>().prop_map(PublisherId::UInt32),
        any::<u64>().prop_map(PublisherId::UInt64),
    ];
    let header = (
        option::of(publisher_id),
        option::of(any::<[u8; 16]>()),
        option::of(group_header()),
        option::of(any::<i64>()),
        option::of(0..=9999u16),
    )
        .prop_map(
            |(publisher_id, class_id, group, timestamp, picoseconds)| NetworkHeader {
                publisher_id,
                data_set_class_id: class_id.map(Guid),
                group,
                timestamp: timestamp.map(DateTime),
                picoseconds,
            },
        );
    (
        header,
        option::weighted(0.2, ".{0,8}"),
        any::<bool>(),
        vec(message(), 1..4),
    )
        .prop_map(
            |(header, publisher_name, payload_header, messages)| Network {
                header,
                publisher_name,
                payload_header,
                messages,
            },
        )
}

proptest! {
    #[test]
    fn a_message_comes_back_as_it_was_written(sent in network()) {
        let datagram = sent.encode();
        let network = NetworkMessage::decode(&datagram).unwrap();
        prop_assert_eq!(network.header(), &sent.header());
        let ids: Option<Vec<u16>> = network.writer_ids().map(Iterator::collect);
        let sent_ids = sent.messages().iter().map(|message| message.writer_id).collect();
        prop_assert_eq!(ids, sent.payload_header.then_some(sent_ids));
        prop_assert_eq!(network.messages().count(), sent.messages().len());
        for (message, sent_message) in network.messages().map(Result::unwrap).zip(sent.messages()) {
            prop_assert_eq!(message.writer_id, sent.payload_header.then_some(sent_message.writer_id));
            prop_assert_eq!(message.header, sent_message.header);
            let kind = match sent_message.fields {
                Some(_) => MessageKind::KeyFrame,
                None => MessageKind::KeepAlive,
            };
            prop_assert_eq!(message.kind, kind);
            let fields = message.fields().unwrap();
            let sent_fields = sent_message.fields.as_deref().unwrap_or_default();
            prop_assert_eq!(fields.len(), sent_fields.len());
            prop_assert_eq!(fields.clone().count(), sent_fields.len());
            prop_assert_eq!(fields.checked_bytes().unwrap(), fields.bytes());
            for (field, sent) in fields.map(Result::unwrap).zip(sent_fields) {
                match (field, sent) {
                    (Variant::Null, Field::Null) => {}
                    (Variant::Scalar(got), Field::Scalar(seed)) => {
                        prop_assert!(same(&got, &seed.scalar()), "{:?} of {:?}", got, seed);
                    }
                    (Variant::Array(array), Field::Array(builtin, seeds)) => {
                        prop_assert_eq!(array.element(), *builtin);
                        prop_assert_eq!(array.is_null(), seeds.is_none());
                        let seeds = seeds.as_deref().unwrap_or_default();
                        prop_assert_eq!(array.len(), seeds.len());
                        for (got, seed) in array.iter().zip(seeds) {
                            prop_assert!(same(&got, &seed.scalar()), "{:?} of {:?}", got, seed);
                        }
                    }
                    (got, sent) => prop_assert!(false, "{:?} of {:?}", got, sent),
                }
            }
        }
    }

    #[test]
    fn a_message_cut_short_does_not_pass_for_a_whole_one(mut sent in network()) {
        // Nothing behind a cleared valid bit is looked at, and a key frame cut behind its header is a heartbeat.
        for message in &mut sent.messages {
            message.header.valid = true;
        }
        let datagram = sent.encode();
        let last = sent.messages().last().unwrap();
        let single = sent.messages().len() == 1;
        let heartbeat = match (&last.fields, single) {
            (Some(fields), true) => {
                let mut empty = sent.clone();
                empty.messages.truncate(1);
                empty.messages[0].fields = Some(Vec::new());
                prop_assert!(fields.is_empty() || empty.encode().len() < datagram.len());
                Some(empty.encode().len() - 2)
            }
            _ => None,
        };
        prop_assert!(read_all(&datagram).is_ok());
        for len in 0..datagram.len() {
            let result = read_all(&datagram[..len]);
            if heartbeat == Some(len) {
                prop_assert_eq!(result, Ok(0));
            } else {
                prop_assert!(result.is_err(), "{} of {} bytes: {:?}", len, datagram.len(), result);
            }
        }
    }

    #[test]
    fn bytes_behind_a_message_are_noticed(sent in network(), tail in 1..=255u8) {
        let valid = sent.messages().iter().all(|message| message.header.valid);
        let mut datagram = sent.encode();
        datagram.push(tail);
        if valid {
            prop_assert_eq!(read_all(&datagram), Err(DecodeError::TrailingBytes(1)));
        }
    }

    #[test]
    fn random_bytes_do_not_panic(datagram in vec(any::<u8>(), 0..200)) {
        read_on(&datagram);
    }

    #[test]
    fn random_fields_do_not_panic(fields in vec(any::<u8>(), 0..200)) {
        let mut datagram = vec![0x01, 0x01];
        datagram.extend(fields);
        read_on(&datagram);
    }

    #[test]
    fn changed_bytes_do_not_panic(
        sent in network(),
        changes in vec((any::<proptest::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let mut datagram = sent.encode();
        for (at, byte) in changes {
            let at = at.index(datagram.len());
            datagram[at] = byte;
        }
        read_on(&datagram);
    }
}
