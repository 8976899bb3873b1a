//! Properties of every message: decoding returns the encoded values, no part of a message is
//! accepted as a complete message, and no bytes cause a panic.

use crate::everything;
use crate::model;
use crate::rewrite;

use everything::read_everything;
use model::{ModelDataValue, ModelVariant, sample, value};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use rewrite::{rewrite, rewrite_message};
use uadp::{
    BuiltinType, DataSetHeader, DataSetMessage, DataValue, DateTime, DecodeError, DiagnosticInfo,
    Extras, FieldEncoder, FieldEncoding, FieldValue, Fields, GroupHeader, Guid, MessageKind,
    Nested, NetworkHeader, NetworkMessage, NetworkMessageEncoder, PublisherId, SecurityHeader,
    Variant,
};

#[derive(Debug, Clone)]
struct Network {
    header: NetworkHeader<'static>,
    publisher_name: Option<String>,
    payload_header: bool,
    promoted: Option<Vec<ModelVariant>>,
    security: Option<Security>,
    messages: Vec<Message>,
}

/// The SecurityHeader of an unsecured message.
#[derive(Debug, Clone)]
struct Security {
    force_key_reset: bool,
    token_id: u32,
    nonce: Vec<u8>,
    footer: Option<Vec<u8>>,
}

#[derive(Debug, Clone)]
struct Message {
    writer_id: u16,
    header: DataSetHeader,
    payload: Payload,
}

#[derive(Debug, Clone)]
enum Payload {
    KeepAlive,
    KeyFrame(Vec<ModelVariant>),
    Event(Vec<ModelVariant>),
    Delta(Vec<(u16, ModelVariant)>),
    Samples(Vec<ModelDataValue>),
    SampleDelta(Vec<(u16, ModelDataValue)>),
    Raw(Vec<u8>),
}

/// An encoded field.
enum Sent<'s> {
    Value(&'s ModelVariant),
    Sample(&'s ModelDataValue),
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

    fn ids(&self) -> Option<Vec<u16>> {
        let ids = self.messages.iter().map(|message| message.writer_id);
        self.payload_header.then(|| ids.collect())
    }

    fn footer(&self) -> &[u8] {
        let footer = self
            .security
            .as_ref()
            .and_then(|header| header.footer.as_deref());
        footer.unwrap_or_default()
    }

    fn encode(&self) -> Vec<u8> {
        self.encode_sized(0)
    }

    /// Encodes the message with a size for each DataSetMessage; 0 for variable sizes.
    fn encode_sized(&self, size: u16) -> Vec<u8> {
        let promoted = self
            .promoted
            .as_deref()
            .map(|values| -> Vec<_> { values.iter().map(ModelVariant::variant).collect() });
        let extras = Extras {
            promoted_fields: promoted.as_deref(),
            security: self.security.as_ref().map(Security::header),
        };
        let (header, ids) = (self.header(), self.ids());
        let mut out = Vec::new();
        let mut encoder =
            NetworkMessageEncoder::with(&mut out, &header, ids.as_deref(), &extras).unwrap();
        if !self.payload_header {
            encoder = encoder.fixed_layout(self.messages.len()).unwrap();
        }
        encoder.configured_size(size);
        for message in &self.messages {
            message.write(&mut encoder);
        }
        encoder.finish_with_footer(self.footer()).unwrap();
        out
    }

    /// Returns the size of the longest DataSetMessage.
    fn longest(&self) -> u16 {
        let sizes = self.messages.iter().map(Message::size);
        sizes.max().unwrap_or_default()
    }

    /// Decodes the messages of [`encode_sized`](Self::encode_sized).
    fn read_sized<'d>(
        &self,
        network: &NetworkMessage<'d>,
        size: u16,
    ) -> Vec<Result<DataSetMessage<'d>, DecodeError>> {
        if self.payload_header || self.messages.len() == 1 {
            return network.messages().collect();
        }
        let datagram = network.datagram().len();
        let start = datagram - network.payload().len() - network.footer().len();
        let size = usize::from(size);
        let offsets = (0..self.messages.len()).map(|position| start + position * size);
        let messages = offsets.map(|offset| network.data_set_message_at(offset, size));
        messages.collect()
    }
}

impl Security {
    fn header(&self) -> SecurityHeader<'_> {
        let size = self.footer.as_ref().map(|footer| footer.len() as u16);
        SecurityHeader {
            force_key_reset: self.force_key_reset,
            token_id: self.token_id,
            nonce: &self.nonce,
            footer_size: size,
            ..SecurityHeader::NONE
        }
    }
}

impl Message {
    fn write(&self, network: &mut NetworkMessageEncoder<'_>) {
        let header = &self.header;
        match &self.payload {
            Payload::KeepAlive => network.keep_alive(header).unwrap(),
            Payload::KeyFrame(values) => write_fields(network.key_frame(header).unwrap(), values),
            Payload::Event(values) => write_fields(network.event(header).unwrap(), values),
            Payload::Delta(changes) => {
                let mut out = network.delta_frame(header).unwrap();
                for (index, value) in changes {
                    write_field(out.field(*index).unwrap(), value);
                }
                out.finish().unwrap();
            }
            Payload::Samples(samples) => {
                let mut out = network.data_values(header).unwrap();
                for sample in samples {
                    out.value(&sample.data_value()).unwrap();
                }
                out.finish().unwrap();
            }
            Payload::SampleDelta(changes) => {
                let mut out = network.delta_data_values(header).unwrap();
                for (index, sample) in changes {
                    out.changed(*index, &sample.data_value()).unwrap();
                }
                out.finish().unwrap();
            }
            Payload::Raw(bytes) => {
                let copy = |out: &mut Vec<u8>| {
                    out.extend_from_slice(bytes);
                    Ok(())
                };
                network.raw_key_frame(header, copy).unwrap();
            }
        }
    }

    /// Returns its size without padding.
    fn size(&self) -> u16 {
        let mut out = Vec::new();
        let header = NetworkHeader::default();
        let mut network = NetworkMessageEncoder::new(&mut out, &header, None).unwrap();
        self.write(&mut network);
        network.finish().unwrap();
        (out.len() - 1) as u16
    }

    /// Checks that the decoded message equals this message.
    fn check(&self, found: &DataSetMessage<'_>) -> Result<(), TestCaseError> {
        prop_assert_eq!(found.header(), self.header);
        let kind = (found.kind, found.encoding());
        prop_assert_eq!(kind, self.payload.kind());
        if let Payload::Raw(bytes) = &self.payload {
            prop_assert!(found.payload().starts_with(bytes));
            let padding = &found.payload()[bytes.len()..];
            prop_assert!(padding.iter().all(|byte| *byte == 0));
            return Ok(());
        }
        let sent = self.payload.sent();
        let values: Vec<_> = found.values().unwrap().map(Result::unwrap).collect();
        prop_assert_eq!(values.len(), sent.len());
        for (value, (index, sent)) in values.iter().zip(&sent) {
            prop_assert_eq!(value.index, *index);
            prop_assert!(sent.is(value), "{:?} of {:?}", value, self);
        }
        if kind.1 == FieldEncoding::Variant && kind.0 != MessageKind::DeltaFrame {
            let fields = found.fields().unwrap();
            prop_assert_eq!(fields.len(), sent.len());
            let block = fields.checked_bytes().unwrap();
            prop_assert!(fields.bytes().starts_with(block));
            for (variant, value) in fields.map(Result::unwrap).zip(&values) {
                prop_assert_eq!(
                    variant.builtin_type(),
                    value.value.value.unwrap().builtin_type()
                );
            }
        }
        Ok(())
    }
}

impl Payload {
    const fn kind(&self) -> (MessageKind, FieldEncoding) {
        match self {
            Self::KeepAlive => (MessageKind::KeepAlive, FieldEncoding::Variant),
            Self::KeyFrame(_) => (MessageKind::KeyFrame, FieldEncoding::Variant),
            Self::Event(_) => (MessageKind::Event, FieldEncoding::Variant),
            Self::Delta(_) => (MessageKind::DeltaFrame, FieldEncoding::Variant),
            Self::Samples(_) => (MessageKind::KeyFrame, FieldEncoding::DataValue),
            Self::SampleDelta(_) => (MessageKind::DeltaFrame, FieldEncoding::DataValue),
            Self::Raw(_) => (MessageKind::KeyFrame, FieldEncoding::RawData),
        }
    }

    /// Returns the fields and their indexes.
    fn sent(&self) -> Vec<(u16, Sent<'_>)> {
        match self {
            Self::KeepAlive | Self::Raw(_) => Vec::new(),
            Self::KeyFrame(values) | Self::Event(values) => {
                (0..).zip(values.iter().map(Sent::Value)).collect()
            }
            Self::Samples(samples) => (0..).zip(samples.iter().map(Sent::Sample)).collect(),
            Self::Delta(changes) => {
                let sent = changes.iter();
                sent.map(|(index, value)| (*index, Sent::Value(value)))
                    .collect()
            }
            Self::SampleDelta(changes) => {
                let sent = changes.iter();
                sent.map(|(index, sample)| (*index, Sent::Sample(sample)))
                    .collect()
            }
        }
    }
}

impl Sent<'_> {
    fn is(&self, found: &FieldValue<'_>) -> bool {
        match (self, found.value.value) {
            (Sent::Value(value), Some(variant)) => {
                let rest = DataValue {
                    value: None,
                    ..found.value
                };
                value.is(&variant) && rest == DataValue::default()
            }
            (Sent::Value(_), None) => false,
            (Sent::Sample(sample), _) => sample.is(&found.value),
        }
    }
}

fn write_fields(mut out: FieldEncoder<'_>, values: &[ModelVariant]) {
    for value in values {
        write_field(&mut out, value);
    }
    out.finish().unwrap();
}

/// Writes a field. Arrays are written element by element, as by a caller without their encoding.
fn write_field(out: &mut FieldEncoder<'_>, value: &ModelVariant) {
    let elements = match value {
        ModelVariant::Null => return out.null().unwrap(),
        ModelVariant::Scalar(seed) => return out.scalar(seed.scalar()).unwrap(),
        ModelVariant::Matrix(..) => return out.variant(&value.variant()).unwrap(),
        ModelVariant::Array(elements) => elements,
    };
    let Some(seeds) = &elements.seeds else {
        return out.variant(&value.variant()).unwrap();
    };
    out.array(elements.builtin, seeds.len()).unwrap();
    for seed in seeds {
        out.element(seed.scalar()).unwrap();
    }
}

/// Writes all fields in sequence, as they were read.
fn as_read(out: &mut FieldEncoder<'_>, fields: Fields<'_>) {
    for field in fields {
        out.variant(&field.unwrap()).unwrap();
    }
}

/// Reads everything up to the first error. Returns the number of fields.
fn read_all(datagram: &[u8]) -> Result<usize, DecodeError> {
    let network = NetworkMessage::decode(datagram)?;
    for field in network.promoted_fields().into_iter().flatten() {
        field?;
    }
    let mut count = 0;
    for message in network.messages() {
        for field in message?.values()? {
            field?;
            count += 1;
        }
    }
    Ok(count)
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

fn payload() -> impl Strategy<Value = Payload> {
    prop_oneof![
        1 => Just(Payload::KeepAlive),
        3 => vec(value(), 0..5).prop_map(Payload::KeyFrame),
        1 => vec(value(), 0..4).prop_map(Payload::Event),
        2 => vec((any::<u16>(), value()), 0..4).prop_map(Payload::Delta),
        2 => vec(sample(value()), 0..4).prop_map(Payload::Samples),
        1 => vec((any::<u16>(), sample(value())), 0..4).prop_map(Payload::SampleDelta),
    ]
}

fn message(payload: impl Strategy<Value = Payload>) -> impl Strategy<Value = Message> {
    (any::<u16>(), data_set_header(), payload).prop_map(|(writer_id, header, payload)| Message {
        writer_id,
        header,
        payload,
    })
}

fn security() -> impl Strategy<Value = Security> {
    // A footer that starts with 0 would be accepted as padding when a byte is appended.
    let footer = option::of(vec(1..=255_u8, 0..4));
    (any::<bool>(), any::<u32>(), vec(any::<u8>(), 0..9), footer).prop_map(
        |(force_key_reset, token_id, nonce, footer)| Security {
            force_key_reset,
            token_id,
            nonce,
            footer,
        },
    )
}

fn network_header() -> impl Strategy<Value = NetworkHeader<'static>> {
    let publisher_id = prop_oneof![
        any::<u8>().prop_map(PublisherId::Byte),
        any::<u16>().prop_map(PublisherId::UInt16),
        any::<u32>().prop_map(PublisherId::UInt32),
        any::<u64>().prop_map(PublisherId::UInt64),
    ];
    (
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
        )
}

/// Generates any number of messages with a payload header, and a single message without it.
fn network() -> impl Strategy<Value = Network> {
    network_of(payload()).prop_map(|mut network| {
        if !network.payload_header {
            network.messages.truncate(1);
        }
        network
    })
}

fn network_of(payload: impl Strategy<Value = Payload>) -> impl Strategy<Value = Network> {
    (
        network_header(),
        option::weighted(0.2, ".{0,8}"),
        any::<bool>(),
        option::weighted(0.3, vec(value(), 0..3)),
        option::weighted(0.3, security()),
        vec(message(payload), 1..4),
    )
        .prop_map(
            |(header, publisher_name, payload_header, promoted, security, messages)| Network {
                header,
                publisher_name,
                payload_header,
                promoted: promoted.filter(|_| messages.len() == 1),
                security,
                messages,
            },
        )
}

proptest! {
    #[test]
    fn the_headers_come_back_as_they_were_written(sent in network()) {
        let datagram = sent.encode();
        let network = NetworkMessage::decode(&datagram).unwrap();
        prop_assert_eq!(network.header(), sent.header());
        let ids: Option<Vec<u16>> = network.writer_ids().map(Iterator::collect);
        prop_assert_eq!(ids, sent.ids());
        prop_assert_eq!(network.security(), sent.security.as_ref().map(Security::header));
        prop_assert_eq!(network.footer(), sent.footer());
        prop_assert!(!network.is_sealed() && !network.is_chunk());
        let found = network.promoted_fields().map(|fields| fields.map(Result::unwrap).collect());
        let found: Option<Vec<_>> = found;
        prop_assert_eq!(found.is_some(), sent.promoted.is_some());
        let (found, sent) = (found.unwrap_or_default(), sent.promoted.unwrap_or_default());
        prop_assert_eq!(found.len(), sent.len());
        for (found, sent) in found.iter().zip(&sent) {
            prop_assert!(sent.is(found), "{:?} of {:?}", found, sent);
        }
    }

    #[test]
    fn a_message_comes_back_as_it_was_written(sent in network()) {
        let datagram = sent.encode();
        let network = NetworkMessage::decode(&datagram).unwrap();
        let found: Vec<_> = network.messages().map(Result::unwrap).collect();
        prop_assert_eq!(found.len(), sent.messages.len());
        for (found, message) in found.iter().zip(&sent.messages) {
            prop_assert_eq!(found.writer_id, sent.payload_header.then_some(message.writer_id));
            message.check(found)?;
        }
    }

    #[test]
    fn a_message_of_configured_size_comes_back_without_its_padding(
        sent in network_of(prop_oneof![
            4 => payload(),
            1 => vec(any::<u8>(), 0..9).prop_map(Payload::Raw),
        ]),
        slack in 0..9_u16,
    ) {
        let size = sent.longest() + slack;
        let datagram = sent.encode_sized(size);
        let network = NetworkMessage::decode(&datagram).unwrap();
        let found = sent.read_sized(&network, size);
        prop_assert_eq!(found.len(), sent.messages.len());
        for (found, sent) in found.into_iter().zip(&sent.messages) {
            sent.check(&found.unwrap())?;
        }
    }

    #[test]
    fn a_message_too_long_for_its_configured_size_is_invalid_and_no_other(
        sent in network_of(payload()),
        size in 1..100_u16,
    ) {
        let datagram = sent.encode_sized(size);
        let network = NetworkMessage::decode(&datagram).unwrap();
        for (found, sent) in sent.read_sized(&network, size).into_iter().zip(&sent.messages) {
            let found = found.unwrap();
            if sent.size() <= size {
                sent.check(&found)?;
            } else {
                prop_assert!(!found.is_valid());
                prop_assert_eq!(found.payload().len(), usize::from(size) - 1);
            }
        }
    }

    #[test]
    fn what_was_read_is_written_as_it_was(sent in network()) {
        let datagram = sent.encode();
        prop_assert_eq!(rewrite(&datagram, as_read), Ok(datagram));
    }

    #[test]
    fn what_was_read_of_a_fixed_layout_is_written_as_it_was(sent in network_of(payload())) {
        let fixed = Network { payload_header: false, promoted: None, security: None, ..sent };
        let size = fixed.longest();
        let datagram = fixed.encode_sized(size);
        let network = NetworkMessage::decode(&datagram).unwrap();
        let mut out = Vec::new();
        let encoder = NetworkMessageEncoder::new(&mut out, &network.header(), None).unwrap();
        let mut encoder = encoder.fixed_layout(fixed.messages.len()).unwrap();
        encoder.configured_size(size);
        for message in fixed.read_sized(&network, size) {
            rewrite_message(&message.unwrap(), &mut encoder, as_read).unwrap();
        }
        encoder.finish().unwrap();
        prop_assert_eq!(out, datagram);
    }

    #[test]
    fn no_part_of_a_message_passes_for_the_whole(mut sent in network()) {
        // An invalid message ends at its header, and a key frame truncated behind its header is a
        // heartbeat.
        for message in &mut sent.messages {
            message.header.valid = true;
        }
        let datagram = sent.encode();
        let mut empty = sent.clone();
        let heartbeat = match &mut empty.messages[..] {
            [Message { payload: Payload::KeyFrame(values), .. }] => {
                values.clear();
                Some(empty.encode().len() - 2)
            }
            [Message { payload: Payload::Samples(samples), .. }] => {
                samples.clear();
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
    fn bytes_behind_a_message_are_noticed(mut sent in network(), tail in 1..=255u8) {
        for message in &mut sent.messages {
            message.header.valid = true;
        }
        let mut datagram = sent.encode();
        datagram.push(tail);
        prop_assert_eq!(read_all(&datagram), Err(DecodeError::TrailingBytes(1)));
    }

    #[test]
    fn random_bytes_do_not_panic(datagram in vec(any::<u8>(), 0..200)) {
        read_everything(&datagram);
    }

    #[test]
    fn random_headers_do_not_panic(
        flags in any::<[u8; 2]>(),
        rest in vec(any::<u8>(), 0..100),
    ) {
        let datagram = [&[0x81 | flags[0], 0x80 | flags[1] & 0x7B, 0x03 & flags[0]], &rest[..]];
        read_everything(&datagram.concat());
    }

    #[test]
    fn random_messages_do_not_panic(flags in any::<u8>(), message in vec(any::<u8>(), 0..200)) {
        read_everything(&[&[0x01, 0x01 | flags], &message[..]].concat());
    }

    #[test]
    fn changed_bytes_do_not_panic(
        sent in network_of(payload()),
        changes in vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let mut datagram = sent.encode();
        for (at, byte) in changes {
            let at = at.index(datagram.len());
            datagram[at] = byte;
        }
        read_everything(&datagram);
    }

    #[test]
    fn a_message_lies_where_it_is_looked_for_or_nowhere(
        datagram in vec(any::<u8>(), 0..60),
        offset in any::<prop::sample::Index>(),
        size in any::<prop::sample::Index>(),
    ) {
        let datagram = [&[0x01], &datagram[..]].concat();
        let network = NetworkMessage::decode(&datagram).unwrap();
        let (offset, size) = (offset.index(70), size.index(70));
        let expected = datagram.get(offset..offset + size).filter(|_| offset > 0);
        match network.data_set_message_at(offset, size) {
            Ok(message) => prop_assert!(expected.unwrap().ends_with(message.payload())),
            Err(DecodeError::Truncated { field: "DataSetMessage", .. }) => {
                prop_assert_eq!(expected, None);
            }
            Err(_) => prop_assert!(expected.is_some()),
        }
    }

    #[test]
    fn a_value_is_passed_over_as_it_is_read(
        sent in value(),
        changes in vec((any::<prop::sample::Index>(), any::<u8>()), 0..3),
        len in any::<prop::sample::Index>(),
    ) {
        let mut bytes = Vec::new();
        Nested::variant(&sent.variant(), &mut bytes).unwrap();
        bytes.extend([1, 2]);
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        bytes.truncate(len.index(bytes.len() + 1));
        let block = [&[1, 0], &bytes[..]].concat();
        // The value is read as a field, and skipped as an element.
        let read = Fields::parse(&block).map(|mut fields| fields.next());
        let passed = Nested::<Variant<'_>>::new(&bytes);
        match (read, passed) {
            (Ok(Some(Ok(read))), Ok(passed)) => {
                let mut again = Vec::new();
                prop_assert_eq!(&passed.get().map(|value| format!("{value:?}")), &Ok(format!("{read:?}")));
                let again = Nested::variant(&read, &mut again).unwrap();
                prop_assert_eq!(again.get().map(|_| ()), Ok(()));
            }
            (Ok(Some(Ok(_))), Err(DecodeError::TrailingBytes(left))) => {
                let whole = Nested::<Variant<'_>>::new(&bytes[..bytes.len() - left]);
                prop_assert!(whole.is_ok());
            }
            (Ok(Some(Err(read))), Err(passed)) => prop_assert_eq!(read, passed),
            (Err(DecodeError::Limit { .. }), Err(_)) => prop_assert!(bytes.is_empty()),
            (read, passed) => prop_assert!(false, "{:?} {:?}", read, passed),
        }
    }

    #[test]
    fn what_bytes_mean_is_written_in_one_way(bytes in vec(any::<u8>(), 0..60)) {
        let mut buffers = [(); 4].map(|()| Vec::new());
        let [first, second, third, fourth] = &mut buffers;
        if let Ok(value) = Nested::<DataValue<'_>>::new(&bytes) {
            let once = Nested::data_value(&value.get().unwrap(), first).unwrap();
            let twice = Nested::data_value(&once.get().unwrap(), second).unwrap();
            prop_assert_eq!(once, twice);
        }
        if let Ok(info) = Nested::<DiagnosticInfo<'_>>::new(&bytes) {
            let once = Nested::diagnostic_info(&info.get().unwrap(), third).unwrap();
            let twice = Nested::diagnostic_info(&once.get().unwrap(), fourth).unwrap();
            prop_assert_eq!(once, twice);
        }
    }
}

#[test]
fn every_builtin_type_is_made_up() {
    use proptest::strategy::ValueTree;
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mut left = BuiltinType::ALL.to_vec();
    for _ in 0..2000 {
        let value = value().new_tree(&mut runner).unwrap().current();
        let found = value.variant().builtin_type();
        left.retain(|builtin| Some(*builtin) != found);
    }
    assert_eq!(left, []);
}
