//! Datagrams encoded by hand.

use std::time::Duration;

use uadp::action::{
    ActionDialect, ActionEncoding, ActionFields, ActionHeader, ActionKind, ActionState,
};
use uadp::{
    BuiltinType, NetworkMessage, PublisherId, RawDialect, RawField, RawLayout, RawValue, Scalar,
    StatusCode, Variant,
};

use super::{STANDARD, read, rewrite};

const TEXT: &str = include_str!("vectors.txt");
const ONE_SHOT: ActionDialect = ActionDialect::UaNetStandard(ActionEncoding::Variant);
const ONE_SHOT_RAW: ActionDialect = ActionDialect::UaNetStandard(ActionEncoding::RawData);

/// Returns all vectors by name.
pub(super) fn all() -> Vec<(&'static str, Vec<u8>)> {
    let mut vectors: Vec<(&str, Vec<u8>)> = Vec::new();
    for line in TEXT.lines() {
        let line = line.split(';').next().unwrap().trim();
        if let Some(name) = line.strip_prefix('[').and_then(|it| it.strip_suffix(']')) {
            vectors.push((name, Vec::new()));
            continue;
        }
        for byte in line.split_whitespace() {
            let byte = u8::from_str_radix(byte, 16).unwrap();
            vectors.last_mut().unwrap().1.push(byte);
        }
    }
    vectors
}

pub(super) fn vector(name: &str) -> Vec<u8> {
    let mut vectors = all().into_iter();
    vectors.find(|(of, _)| *of == name).unwrap().1
}

pub(super) fn dialect(name: &str) -> ActionDialect {
    match name {
        "netstandard_request" => ONE_SHOT,
        "netstandard_raw_response" => ONE_SHOT_RAW,
        _ => STANDARD,
    }
}

fn variants(fields: ActionFields<'_>) -> Vec<Variant<'_>> {
    fields.variants().unwrap().map(Result::unwrap).collect()
}

#[test]
fn a_request_says_who_asks_whom_for_what_and_for_how_long() {
    let bytes = vector("request");
    let [request] = read(&bytes, STANDARD).try_into().unwrap();
    assert_eq!(
        request.action,
        ActionHeader {
            kind: ActionKind::Request,
            response_address: Some("opc.udp://239.0.0.1:4840"),
            correlation_data: Some(&[0xC0, 0xFF, 0xEE]),
            requestor_id: Some(PublisherId::UInt16(1)),
            timeout_hint: Some(2500.0),
        }
    );
    assert_eq!(request.action.timeout(), Some(Duration::from_millis(2500)));
    assert_eq!(request.publisher_id, PublisherId::UInt16(2));
    assert_eq!(request.writer_group_id, Some(5));
    assert_eq!((request.writer_id, request.target_id), (61, 7));
    assert_eq!(
        (request.request_id, request.state),
        (0x1234, ActionState::Executing)
    );
    let fields = [
        Variant::Scalar(Scalar::Double(2.5)),
        Variant::Scalar(Scalar::String(Some("hi"))),
    ];
    assert_eq!(variants(request.fields), fields);
}

#[test]
fn a_response_has_the_status_in_its_data_set_message_header() {
    let bytes = vector("response");
    let [response] = read(&bytes, STANDARD).try_into().unwrap();
    assert_eq!(response.action.kind, ActionKind::Response);
    assert_eq!(response.state, ActionState::Done);
    let status = response.header().status.map(StatusCode::from_status);
    assert_eq!(status, Some(StatusCode(0x80AB_0000)));
    assert_eq!(
        variants(response.fields),
        [Variant::Scalar(Scalar::Int32(42))]
    );
}

#[test]
fn an_acknowledgement_has_no_fields() {
    let bytes = vector("idle");
    let [idle] = read(&bytes, STANDARD).try_into().unwrap();
    assert_eq!(
        (idle.state, idle.fields),
        (ActionState::Idle, ActionFields::NONE)
    );
    assert_eq!(idle.action.correlation_data, Some(&[][..]));
    assert_eq!((idle.writer_group_id, idle.action.timeout()), (None, None));
}

#[test]
fn raw_data_stands_behind_its_field_count() {
    let bytes = vector("raw_data");
    let [request] = read(&bytes, STANDARD).try_into().unwrap();
    let ActionFields::RawData {
        count: Some(2),
        payload,
    } = request.fields
    else {
        panic!("{:?}", request.fields)
    };
    assert!(request.fields.variants().is_err());
    let fields = [BuiltinType::Double, BuiltinType::Int32].map(RawField::new);
    let layout = RawLayout::new(&fields).unwrap();
    let values: Vec<_> = layout.read(payload, RawDialect::Standard).collect();
    let expected = [Scalar::Double(2.5), Scalar::Int32(42)];
    assert_eq!(
        values,
        expected.map(|value| Ok(RawValue::Variant(value.into())))
    );
    assert_eq!(
        request.action.requestor_id,
        Some(PublisherId::String("cell 4"))
    );
}

#[test]
fn two_requests_are_told_apart_by_their_sizes() {
    let bytes = vector("two_requests");
    let requests = read(&bytes, STANDARD);
    let ids: Vec<_> = requests
        .iter()
        .map(|it| (it.writer_id, it.target_id, it.request_id))
        .collect();
    assert_eq!(ids, [(61, 7, 1), (62, 8, 2)]);
    for request in &requests {
        assert_eq!(request.action.correlation_data, Some(&[0x77][..]));
    }
}

#[test]
fn the_action_header_follows_the_security_header() {
    let bytes = vector("signed_header");
    let network = NetworkMessage::decode(&bytes).unwrap();
    assert_eq!(network.payload().first(), Some(&1), "ActionFlags");
    assert_eq!(read(&bytes, STANDARD).len(), 1);
}

#[test]
fn the_one_shot_dialect_has_no_data_set_message_header() {
    let bytes = vector("netstandard_request");
    let [request] = read(&bytes, ONE_SHOT).try_into().unwrap();
    assert_eq!((request.target_id, request.request_id), (7, 0x1234));
    assert_eq!(
        variants(request.fields),
        [Variant::Scalar(Scalar::Int32(42))]
    );
    assert_eq!(request.action.timeout(), None, "0 is no deadline");

    let bytes = vector("netstandard_raw_response");
    let [response] = read(&bytes, ONE_SHOT_RAW).try_into().unwrap();
    let payload = &[0x2A, 0, 0, 0][..];
    assert_eq!(
        response.fields,
        ActionFields::RawData {
            count: None,
            payload
        }
    );
    assert_eq!(response.header().status, None);
}

#[test]
fn every_vector_is_written_again_as_it_was() {
    let vectors = all();
    assert_eq!(vectors.len(), 8);
    for (name, bytes) in vectors {
        let written = rewrite(&bytes, dialect(name)).unwrap();
        assert_eq!(written, bytes, "{name}");
    }
}
