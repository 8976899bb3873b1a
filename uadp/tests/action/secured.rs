//! Actions with message security, and in chunks.

use std::time::Duration;

use uadp::action::{ActionCall, ActionEncoder, ActionHeader, ActionKind, ActionStart, ActionState};
use uadp::{
    ChunkBudget, ChunkEncoder, DataSetHeader, DecodeError, Extras, NetworkHeader, NetworkMessage,
    NetworkMessageType, Opener, PublisherId, Reassembler, Scalar, Sealer, SecurityError,
    SecurityMode, SecurityPolicy, TokenKeys, Whole,
};

use super::vectors::vector;
use super::{STANDARD, read};

fn keys() -> TokenKeys {
    let key_data: Vec<u8> = (0..52).collect();
    TokenKeys::from_bytes(SecurityPolicy::PubSubAes128Ctr, &key_data).unwrap()
}

/// Returns a request with a secret in its CorrelationData and another secret in its field.
fn sealed(mode: SecurityMode) -> Vec<u8> {
    let mut sealer = Sealer::new(mode);
    sealer.update_keys(1, [keys()]).unwrap();
    let seal = sealer.seal([1, 2, 3, 4]).unwrap();
    let mut action = ActionHeader::new(ActionKind::Request);
    action.correlation_data = Some(b"correlation");
    let start = ActionStart {
        network: NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(2)),
            ..NetworkHeader::default()
        },
        action,
        dialect: STANDARD,
        extras: Extras {
            security: Some(seal.header()),
            ..Extras::default()
        },
    };
    let call = ActionCall {
        target_id: 7,
        request_id: 1,
        state: ActionState::Executing,
    };
    let mut out = Vec::new();
    let mut encoder = ActionEncoder::new(&mut out, &start, &[61]).unwrap();
    let mut fields = encoder.variants(&DataSetHeader::default(), call).unwrap();
    fields.scalar(Scalar::String(Some("argument"))).unwrap();
    fields.finish().unwrap();
    encoder.finish_sealed(seal).unwrap();
    out
}

fn contains(bytes: &[u8], part: &[u8]) -> bool {
    bytes.windows(part.len()).any(|window| window == part)
}

#[test]
fn the_action_header_is_encrypted_with_the_fields() {
    let datagram = sealed(SecurityMode::SignAndEncrypt);
    assert!(!contains(&datagram, b"correlation") && !contains(&datagram, b"argument"));
    let network = NetworkMessage::decode(&datagram).unwrap();
    assert!(network.is_action() && network.is_sealed());
    let unread = network.actions(STANDARD).err();
    let why = DecodeError::Misread("secured, to be opened with its keys first");
    assert_eq!(unread, Some(why));

    let mut opener = Opener::new(SecurityMode::SignAndEncrypt);
    opener.update_keys(1, [keys()]).unwrap();
    let mut scratch = Vec::new();
    let opened = opener.open(&network, Duration::ZERO, &mut scratch).unwrap();
    let mut actions = opened.message.actions(STANDARD).unwrap();
    let request = actions.next().unwrap().unwrap();
    assert_eq!(request.action.correlation_data, Some(&b"correlation"[..]));
    let field = request.fields.variants().unwrap().next().unwrap();
    assert_eq!(field, Ok(Scalar::String(Some("argument")).into()));
}

#[test]
fn a_changed_action_header_breaks_the_signature() {
    let datagram = sealed(SecurityMode::Sign);
    let at = NetworkMessage::decode(&datagram).unwrap().payload_offset();
    assert!(contains(&datagram, b"correlation"), "only signed");
    let mut forged = datagram.clone();
    forged[at + 6] ^= 1;
    let mut opener = Opener::new(SecurityMode::Sign);
    opener.update_keys(1, [keys()]).unwrap();
    let mut scratch = Vec::new();
    let network = NetworkMessage::decode(&forged).unwrap();
    let refused = opener.open(&network, Duration::ZERO, &mut scratch).err();
    assert_eq!(refused, Some(SecurityError::Signature));
    let network = NetworkMessage::decode(&datagram).unwrap();
    assert!(opener.open(&network, Duration::ZERO, &mut scratch).is_ok());
}

#[test]
fn a_whole_action_message_travels_in_chunks_but_not_a_part_of_one() {
    let request = vector("request");
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: None,
        message_sequence_number: 9,
        bytes: &request,
    };
    let header = NetworkHeader {
        publisher_id: Some(PublisherId::UInt16(1)),
        ..NetworkHeader::default()
    };
    let budget = ChunkBudget {
        network_message: 40,
        trailer: 0,
    };
    let mut chunks = ChunkEncoder::new(&header, &Extras::default(), whole, budget).unwrap();
    let mut reassembler = Reassembler::default();
    let mut found = 0;
    let mut buffer = Vec::new();
    while let Some(chunk) = chunks.append(&mut buffer, &Extras::default()) {
        let datagram = buffer.split_off(chunk.unwrap().start);
        let received = NetworkMessage::decode(&datagram).unwrap();
        if let Some(whole) = reassembler.receive(&received, Duration::ZERO).unwrap() {
            assert_eq!(read(whole.bytes, STANDARD)[0].request_id, 0x1234);
            found += 1;
        }
    }
    assert_eq!(found, 1);

    let part = [
        0xD1, 0x80, 0x21, 2, 61, 0, 1, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0, 1,
    ];
    let part = NetworkMessage::decode(&part).unwrap();
    let unsupported = DecodeError::Unsupported("a chunk with an ActionHeader");
    assert_eq!(part.chunk(), Err(unsupported));
    assert!(matches!(
        part.actions(STANDARD),
        Err(DecodeError::Misread(_))
    ));
}
