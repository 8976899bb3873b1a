//! Properties of every Action message, and rejected input.

use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;
use uadp::action::{
    ActionCall, ActionDialect, ActionEncoder, ActionEncoding, ActionFields, ActionHeader,
    ActionKind, ActionStart, ActionState,
};
use uadp::{
    DataSetHeader, DataSetMessage, DateTime, DecodeError, EncodeError, Extras, GroupHeader,
    NetworkHeader, NetworkMessage, PublisherId, Scalar, SecurityHeader,
};

use super::vectors::{all, dialect, vector};
use super::{STANDARD, read, rewrite};

/// Returns the first error of a datagram.
fn fault(datagram: &[u8], dialect: ActionDialect) -> Option<DecodeError> {
    let network = match NetworkMessage::decode(datagram) {
        Ok(network) => network,
        Err(error) => return Some(error),
    };
    let actions = match network.actions(dialect) {
        Ok(actions) => actions,
        Err(error) => return Some(error),
    };
    for message in actions {
        let fields = match message {
            Ok(message) => message.fields,
            Err(error) => return Some(error),
        };
        if let ActionFields::Variants(_) = fields {
            match fields.variants() {
                Ok(mut fields) => {
                    if let Some(Err(error)) = fields.find(Result::is_err) {
                        return Some(error);
                    }
                }
                Err(error) => return Some(error),
            }
        }
    }
    None
}

/// Returns the vector with a byte replaced.
fn with(name: &str, at: usize, byte: u8) -> Vec<u8> {
    let mut bytes = vector(name);
    bytes[at] = byte;
    bytes
}

#[test]
fn no_part_of_a_message_passes_for_the_whole() {
    for (name, bytes) in all() {
        assert_eq!(fault(&bytes, dialect(name)), None, "{name}");
        // The length of RawData behind the FieldCount is not encoded.
        let whole = match name {
            "raw_data" => bytes.len() - 12,
            "netstandard_raw_response" => bytes.len() - 4,
            _ => bytes.len(),
        };
        for len in 0..whole {
            assert!(
                fault(&bytes[..len], dialect(name)).is_some(),
                "{name}: {len}"
            );
        }
    }
}

#[test]
fn reserved_values_are_refused_by_name() {
    let reserved = |field, value| Some(DecodeError::Reserved { field, value });
    let read = |bytes: Vec<u8>| fault(&bytes, STANDARD);
    // In the response, ActionFlags are at 11, the DataSetMessage at 22, its ActionState at 30.
    assert_eq!(
        read(with("response", 11, 0x2C)),
        reserved("ActionFlags", 0x20)
    );
    assert_eq!(read(with("response", 30, 3)), reserved("ActionState", 3));
    assert_eq!(
        read(with("response", 19, 6)),
        reserved("RequestorId", 6),
        "Int32 is no type of a PublisherId"
    );
    let kind = "DataSetMessage type under an ActionHeader";
    for other in [0, 1, 2, 3, 5] {
        assert_eq!(
            read(with("response", 23, other)),
            reserved(kind, other.into())
        );
    }
    assert_eq!(
        read(with("response", 11, 0x0D)),
        reserved(kind, 6),
        "flags of a request"
    );
    assert_eq!(
        read(with("response", 22, 0x95)),
        reserved("field encoding of an Action", 2),
        "DataValues"
    );
    assert_eq!(
        read(with("response", 22, 0x90)),
        Some(DecodeError::Misread("marked as invalid by its sender"))
    );
    assert_eq!(
        read(with("response", 2, 0x24)),
        reserved("ActionHeader of a discovery message", 0x24)
    );
    let null = [vec![0xD1, 0x80, 0x20, 2, 1, 61, 0, 4], vec![0xFF; 4]].concat();
    assert_eq!(read(null), reserved("CorrelationData length", u32::MAX));
}

#[test]
fn an_action_names_its_responder() {
    let nameless = DecodeError::Reserved {
        field: "UADPFlags of an Action message",
        value: 0,
    };
    let without_writer = [0x91, 0x80, 0x20, 2, 1, 0x81, 5, 7, 0, 1, 0, 1, 0, 0];
    let without_publisher = [0xC1, 0x80, 0x20, 1, 61, 0, 1, 0x81, 5, 7, 0, 1, 0, 1, 0, 0];
    for datagram in [&without_writer[..], &without_publisher] {
        assert_eq!(fault(datagram, STANDARD), Some(nameless));
    }
}

#[test]
fn an_action_is_not_taken_for_data_nor_data_for_an_action() {
    let request = vector("request");
    let network = NetworkMessage::decode(&request).unwrap();
    assert!(network.is_action());
    let as_data: Vec<_> = network.messages().map(Result::err).collect();
    assert_eq!(as_data, [Some(DecodeError::Misread("an Action message"))]);
    let alone = DataSetMessage::decode(Some(61), &[0x81, 5, 7, 0, 1, 0, 1, 0, 0]);
    assert_eq!(
        alone.err(),
        Some(DecodeError::Misread(
            "an Action, to be read with its ActionHeader"
        ))
    );
    let data = [0xD1, 0x00, 2, 1, 61, 0, 1, 0, 0];
    let no_action = Some(DecodeError::Misread("not an Action message"));
    assert_eq!(fault(&data, STANDARD), no_action);
}

#[test]
fn several_one_shot_actions_in_a_message_are_refused() {
    let two = vector("two_requests");
    let one_shot = ActionDialect::UaNetStandard(ActionEncoding::Variant);
    assert!(matches!(
        fault(&two, one_shot),
        Some(DecodeError::Reserved {
            field: "Count of an Action message",
            value: 2
        })
    ));
    let mut out = Vec::new();
    let start = start(one_shot);
    let encoder = ActionEncoder::new(&mut out, &start, &[1, 2]);
    assert!(matches!(encoder, Err(EncodeError::MessageCount { .. })));
}

#[test]
fn a_malformed_message_of_several_leaves_the_next_one_readable() {
    // The ActionState of the first message.
    let bytes = with("two_requests", 29, 9);
    let network = NetworkMessage::decode(&bytes).unwrap();
    let mut actions = network.actions(STANDARD).unwrap();
    assert!(actions.next().unwrap().is_err());
    assert_eq!(actions.next().unwrap().unwrap().request_id, 2);
    assert!(actions.next().is_none());

    for (behind, fault) in [(0, None), (1, Some(DecodeError::TrailingBytes(1)))] {
        let longer = [vector("two_requests"), vec![behind]].concat();
        let network = NetworkMessage::decode(&longer).unwrap();
        let last = network.actions(STANDARD).unwrap().last().unwrap();
        assert_eq!(last.err(), fault, "padding is no fault");
    }
}

#[test]
fn zeros_up_to_the_configured_size_are_no_fields() {
    let call = ActionCall {
        target_id: 7,
        request_id: 1,
        state: ActionState::Executing,
    };
    let mut out = Vec::new();
    let mut encoder = ActionEncoder::new(&mut out, &start(STANDARD), &[61]).unwrap();
    encoder.configured_size(40);
    let mut fields = encoder.variants(&DataSetHeader::default(), call).unwrap();
    fields.scalar(Scalar::Byte(9)).unwrap();
    fields.finish().unwrap();
    let at = encoder.payload_offset();
    encoder.finish().unwrap();
    assert_eq!(out.len(), at + 1 + 40);
    assert_eq!(fault(&out, STANDARD), None);
    let [request] = read(&out, STANDARD).try_into().unwrap();
    assert_eq!(request.fields.variants().unwrap().count(), 1);
}

#[test]
fn the_encoder_writes_nothing_a_reader_would_refuse() {
    let call = ActionCall {
        target_id: 7,
        request_id: 1,
        state: ActionState::Done,
    };
    let invalid = DataSetHeader {
        valid: false,
        ..DataSetHeader::default()
    };
    let with_status = DataSetHeader {
        status: Some(0x8000),
        ..DataSetHeader::default()
    };
    let one_shot = ActionDialect::UaNetStandard(ActionEncoding::Variant);
    let raw = ActionFields::RawData {
        count: None,
        payload: &[1],
    };
    for (dialect, header, fields) in [
        (STANDARD, invalid, ActionFields::NONE),
        (STANDARD, DataSetHeader::default(), raw),
        (one_shot, with_status, ActionFields::NONE),
        (one_shot, DataSetHeader::default(), raw),
    ] {
        let mut out = Vec::new();
        let mut encoder = ActionEncoder::new(&mut out, &start(dialect), &[61]).unwrap();
        let refused = encoder.fields(&header, call, fields);
        assert!(
            matches!(refused, Err(EncodeError::Misplaced(_))),
            "{refused:?}"
        );
    }
    let mut out = Vec::new();
    let nobody = ActionStart {
        network: NetworkHeader::default(),
        ..start(STANDARD)
    };
    let refused = ActionEncoder::new(&mut out, &nobody, &[61]);
    assert!(matches!(refused, Err(EncodeError::Misplaced(_))));
}

#[test]
fn reading_and_refusing_allocate_nothing() {
    let vectors = all();
    let allocations = allocation_counter::measure(|| {
        for (name, bytes) in &vectors {
            for len in 0..=bytes.len() {
                std::hint::black_box(fault(&bytes[..len], dialect(name)));
            }
        }
    });
    assert_eq!(allocations.count_total, 0);
}

fn start(dialect: ActionDialect) -> ActionStart<'static> {
    ActionStart {
        network: NetworkHeader {
            publisher_id: Some(PublisherId::Byte(2)),
            ..NetworkHeader::default()
        },
        action: ActionHeader::new(ActionKind::Request),
        dialect,
        extras: Extras::default(),
    }
}

#[derive(Debug, Clone)]
struct Sent {
    writer_id: u16,
    header: DataSetHeader,
    call: ActionCall,
    fields: Vec<u8>,
    raw: bool,
}

#[derive(Debug, Clone)]
struct Case {
    kind: ActionKind,
    address: Option<String>,
    correlation: Option<Vec<u8>>,
    requestor: Option<(u8, u64, String)>,
    timeout: Option<f64>,
    group: Option<GroupHeader>,
    timestamp: Option<i64>,
    security: bool,
    one_shot: bool,
    messages: Vec<Sent>,
}

fn id(kind: u8, number: u64, text: &str) -> PublisherId<'_> {
    let [a, b, c, d, ..] = number.to_le_bytes();
    match kind % 5 {
        0 => PublisherId::Byte(a),
        1 => PublisherId::UInt16(u16::from_le_bytes([a, b])),
        2 => PublisherId::UInt32(u32::from_le_bytes([a, b, c, d])),
        3 => PublisherId::UInt64(number),
        _ => PublisherId::String(text),
    }
}

fn sent() -> impl Strategy<Value = Sent> {
    let state = prop_oneof![
        Just(ActionState::Idle),
        Just(ActionState::Executing),
        Just(ActionState::Done)
    ];
    let header = (
        option::of(any::<u16>()),
        option::of(any::<i64>()),
        option::of(any::<u16>()),
        option::of(any::<u32>()),
    )
        .prop_map(
            |(sequence_number, timestamp, status, version)| DataSetHeader {
                sequence_number,
                timestamp: timestamp.map(DateTime),
                status,
                major_version: version,
                ..DataSetHeader::default()
            },
        );
    (
        any::<u16>(),
        header,
        (any::<u16>(), any::<u16>(), state),
        vec(any::<u8>(), 0..20),
        any::<bool>(),
    )
        .prop_map(
            |(writer_id, header, (target_id, request_id, state), fields, raw)| Sent {
                writer_id,
                header,
                call: ActionCall {
                    target_id,
                    request_id,
                    state,
                },
                fields,
                raw,
            },
        )
}

fn case() -> impl Strategy<Value = Case> {
    let group = option::of(
        (option::of(any::<u16>()), option::of(any::<u16>())).prop_map(
            |(writer_group_id, sequence_number)| GroupHeader {
                writer_group_id,
                sequence_number,
                ..GroupHeader::default()
            },
        ),
    );
    (
        (
            any::<bool>(),
            option::of(".{0,30}"),
            option::of(vec(any::<u8>(), 0..40)),
        ),
        option::of((any::<u8>(), any::<u64>(), ".{0,10}")),
        option::of(any::<f64>()),
        (
            group,
            option::of(any::<i64>()),
            any::<bool>(),
            any::<bool>(),
        ),
        vec(sent(), 1..4),
    )
        .prop_map(
            |((request, address, correlation), requestor, timeout, rest, messages)| {
                let (group, timestamp, security, one_shot) = rest;
                Case {
                    kind: if request {
                        ActionKind::Request
                    } else {
                        ActionKind::Response
                    },
                    address,
                    correlation,
                    requestor,
                    timeout,
                    group,
                    timestamp,
                    security,
                    one_shot,
                    messages,
                }
            },
        )
}

impl Case {
    fn dialect(&self) -> ActionDialect {
        match (self.one_shot, self.messages[0].raw) {
            (false, _) => STANDARD,
            (true, false) => ActionDialect::UaNetStandard(ActionEncoding::Variant),
            (true, true) => ActionDialect::UaNetStandard(ActionEncoding::RawData),
        }
    }

    fn messages(&self) -> &[Sent] {
        if self.one_shot {
            &self.messages[..1]
        } else {
            &self.messages
        }
    }

    fn action(&self) -> ActionHeader<'_> {
        ActionHeader {
            kind: self.kind,
            response_address: self.address.as_deref(),
            correlation_data: self.correlation.as_deref(),
            requestor_id: self
                .requestor
                .as_ref()
                .map(|(kind, number, text)| id(*kind, *number, text)),
            timeout_hint: self.timeout,
        }
    }

    fn write(&self) -> Vec<u8> {
        let start = ActionStart {
            network: NetworkHeader {
                publisher_id: Some(PublisherId::UInt16(2)),
                group: self.group,
                timestamp: self.timestamp.map(DateTime),
                ..NetworkHeader::default()
            },
            action: self.action(),
            dialect: self.dialect(),
            extras: Extras {
                security: self.security.then_some(SecurityHeader::NONE),
                ..Extras::default()
            },
        };
        let ids: Vec<_> = self.messages().iter().map(|it| it.writer_id).collect();
        let mut out = Vec::new();
        let mut encoder = ActionEncoder::new(&mut out, &start, &ids).unwrap();
        for sent in self.messages() {
            let header = if self.one_shot {
                DataSetHeader::default()
            } else {
                sent.header
            };
            if sent.raw {
                encoder
                    .raw_data(&header, sent.call, 3, |buf| {
                        buf.extend_from_slice(&sent.fields);
                        Ok(())
                    })
                    .unwrap();
                continue;
            }
            let mut fields = encoder.variants(&header, sent.call).unwrap();
            for byte in &sent.fields {
                fields.scalar(Scalar::Byte(*byte)).unwrap();
            }
            fields.finish().unwrap();
        }
        encoder.finish().unwrap();
        out
    }
}

proptest! {
    #[test]
    fn what_is_written_is_read_and_written_the_same(case in case()) {
        let bytes = case.write();
        let messages = read(&bytes, case.dialect());
        prop_assert_eq!(messages.len(), case.messages().len());
        for (read, sent) in messages.iter().zip(case.messages()) {
            let (a, b) = (read.action, case.action());
            prop_assert_eq!(a.timeout_hint.map(f64::to_bits), b.timeout_hint.map(f64::to_bits));
            prop_assert_eq!(
                (a.kind, a.response_address, a.correlation_data, a.requestor_id),
                (b.kind, b.response_address, b.correlation_data, b.requestor_id)
            );
            prop_assert_eq!((read.writer_id, read.call()), (sent.writer_id, sent.call));
            if !case.one_shot {
                prop_assert_eq!(read.header(), sent.header);
            }
            match read.fields {
                ActionFields::Variants(_) => {
                    let fields = read.fields.variants().unwrap();
                    prop_assert_eq!(fields.len(), sent.fields.len());
                    for (field, byte) in fields.zip(&sent.fields) {
                        prop_assert_eq!(field.unwrap(), Scalar::Byte(*byte).into());
                    }
                }
                ActionFields::RawData { count, payload } => {
                    prop_assert_eq!(count, (!case.one_shot).then_some(3));
                    prop_assert_eq!(payload, sent.fields.as_slice());
                }
            }
        }
        prop_assert_eq!(rewrite(&bytes, case.dialect()).unwrap(), bytes);
    }

    #[test]
    fn no_changed_message_makes_the_reader_panic(
        case in case(),
        changes in vec((any::<prop::sample::Index>(), any::<u8>()), 1..5),
    ) {
        let mut bytes = case.write();
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        for dialect in [
            STANDARD,
            ActionDialect::UaNetStandard(ActionEncoding::Variant),
            ActionDialect::UaNetStandard(ActionEncoding::RawData),
        ] {
            fault(&bytes, dialect);
        }
    }
}
