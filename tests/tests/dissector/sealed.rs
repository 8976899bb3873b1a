//! Messages secured and split by this project's own writers.

use system_tests::{CaptureFile, Cell, Peer, hex};
use uadp::{
    ChunkBudget, ChunkEncoder, Extras, NetworkMessage, NetworkMessageEncoder, NetworkMessageType,
    Scalar, Sealer, SecurityMode, SecurityPolicy, TokenKeys, Whole,
};

use crate::dissector::messages::{assert_shown, header, key_frame, numbered};

fn sealer(mode: SecurityMode) -> Sealer {
    let policy = SecurityPolicy::PubSubAes256Ctr;
    let keys = TokenKeys::from_bytes(policy, &[7; 68]).unwrap();
    let mut sealer = Sealer::new(mode);
    sealer.update_keys(3, [keys]).unwrap();
    sealer
}

/// Encodes a sealed key frame of `ua_2_5_10` with sequence number 3 and a Double.
fn sealed(sealer: &mut Sealer) -> Vec<u8> {
    let mut datagram = Vec::new();
    let seal = sealer.seal([0xA1, 0xA2, 0xA3, 0xA4]).unwrap();
    let extras = Extras {
        security: Some(seal.header()),
        ..Extras::default()
    };
    let mut encoder =
        NetworkMessageEncoder::with(&mut datagram, &header(2, 5), Some(&[10]), &extras).unwrap();
    let mut fields = encoder.key_frame(&numbered(3)).unwrap();
    fields.scalar(Scalar::Double(-0.25)).unwrap();
    fields.finish().unwrap();
    encoder.finish_sealed(seal).unwrap();
    datagram
}

#[test]
fn the_headers_of_what_we_seal_are_shown_and_the_payload_if_it_is_only_signed() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let signed = sealed(&mut sealer(SecurityMode::Sign));
    let mut encrypting = sealer(SecurityMode::SignAndEncrypt);
    let encrypted = [sealed(&mut encrypting), sealed(&mut encrypting)];
    let [first, second] = encrypted;
    let shown = cell.dissect(&CaptureFile::of([signed.clone(), first, second]), &[]);
    let headers = [
        ("topic", "ua_2_5_10"),
        ("security.token_id", "3"),
        ("security.nonce.random", "a1:a2:a3:a4"),
    ];
    for shown in &shown {
        assert_shown(shown, &headers);
        assert!(!shown.has("uadp.malformed"));
    }
    let signature = hex(&signed[signed.len() - 32..]);
    assert_shown(
        &shown[0],
        &[
            ("security.flags", "0x01"),
            ("dataset.sequence_number", "3"),
            ("field.double", "-0.25"),
            ("security.signature", &signature),
        ],
    );
    for (shown, number) in shown[1..].iter().zip(["1", "2"]) {
        assert_shown(
            shown,
            &[
                ("security.flags", "0x03"),
                ("security.nonce.sequence_number", number),
            ],
        );
        assert!(shown.has("uadp.encrypted_payload") && !shown.has("uadp.dataset"));
    }
}

#[test]
fn the_chunks_we_send_become_the_message_they_were() {
    let Some(cell) = Cell::with(&[Peer::Tshark]) else {
        return;
    };
    let image: Vec<u8> = (0..4000_u32).map(|at| at.to_le_bytes()[0]).collect();
    let plain = key_frame(|fields| fields.scalar(Scalar::ByteString(Some(&image))).unwrap());
    let plain = NetworkMessage::decode(&plain).unwrap();
    let whole = Whole {
        message_type: NetworkMessageType::DataSet,
        writer_id: Some(10),
        message_sequence_number: 3,
        bytes: plain.payload(),
    };
    let network = header(2, 5);
    let extras = Extras::default();
    let mut chunks = ChunkEncoder::new(&network, &extras, whole, ChunkBudget::IPV4).unwrap();
    let (mut buffer, mut datagrams) = (Vec::new(), Vec::new());
    while let Some(chunk) = chunks.append(&mut buffer, &extras) {
        datagrams.push(buffer.split_off(chunk.unwrap().start));
    }
    assert_eq!(datagrams.len(), 3);
    let shown = cell.dissect(&CaptureFile::of(datagrams), &[]);
    assert_eq!(shown[1].all("uadp.chunk.offset").len(), 1);
    assert_shown(
        &shown[2],
        &[
            ("topic", "ua_2_5_10"),
            ("dataset.sequence_number", "3"),
            ("field.bytestring", &hex(&image)),
        ],
    );
    assert!(shown[..2].iter().all(|shown| !shown.has("uadp.dataset")));
}
