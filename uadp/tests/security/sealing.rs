//! Round trips of sealed messages, and seals for other messages.

use proptest::collection::vec;
use proptest::prelude::*;
use uadp::{
    BuiltinType, DataSetHeader, EncodeError, Extras, NetworkHeader, NetworkMessage,
    NetworkMessageEncoder, Opener, PublisherId, Seal, Sealer, SecurityHeader, SecurityMode,
    SecurityPolicy, TokenKeys, Variant,
};

use super::{START, header, keys, nonce, sealed, write};

/// Appends a message with a single Byte array.
fn write_bytes(out: &mut Vec<u8>, bytes: &[u8], seal: Seal<'_>) -> Result<(), EncodeError> {
    let extras = Extras {
        security: Some(seal.header()),
        ..Extras::default()
    };
    let header = header(PublisherId::String("cell 4"), Some(5));
    let mut message = NetworkMessageEncoder::with(out, &header, Some(&[10]), &extras)?;
    let mut fields = message.key_frame(&DataSetHeader::default())?;
    fields.packed_array(BuiltinType::Byte, bytes.len(), bytes)?;
    fields.finish()?;
    message.finish_sealed(seal)
}

fn read_bytes(message: &NetworkMessage<'_>) -> Vec<u8> {
    let message = message.messages().next().unwrap().unwrap();
    let field = message.fields().unwrap().next().unwrap().unwrap();
    let Variant::Array(array) = field else {
        unreachable!("an array was written")
    };
    array.bytes().to_vec()
}

proptest! {
    #[test]
    fn what_is_sealed_opens_as_it_was(
        payloads in vec(vec(any::<u8>(), 0..3000), 1..4),
        key_data in vec(any::<u8>(), 68),
        (aes128, encrypt) in any::<(bool, bool)>(),
        footer in proptest::option::of(vec(any::<u8>(), 0..40)),
        random in any::<[u8; 4]>(),
        before in 0..50_usize,
    ) {
        let policy = if aes128 { SecurityPolicy::PubSubAes128Ctr } else { SecurityPolicy::PubSubAes256Ctr };
        let mode = if encrypt { SecurityMode::SignAndEncrypt } else { SecurityMode::Sign };
        let keys = TokenKeys::from_bytes(policy, &key_data[..policy.key_data_length()]).unwrap();
        let mut sealer = Sealer::new(mode);
        sealer.update_keys(3, [keys.clone()]).unwrap();
        let mut opener = Opener::new(mode);
        opener.update_keys(3, [keys]).unwrap();
        let mut scratch = Vec::new();
        for payload in payloads {
            let seal = sealer.seal(random).unwrap();
            let seal = match &footer {
                Some(footer) => seal.footer(footer).unwrap(),
                None => seal,
            };
            let mut out = vec![0xAA; before];
            write_bytes(&mut out, &payload, seal).unwrap();
            prop_assert!(out[..before].iter().all(|byte| *byte == 0xAA));
            let message = NetworkMessage::decode(&out[before..]).unwrap();
            let opened = opener.open(&message, START, &mut scratch).unwrap();
            prop_assert_eq!(read_bytes(&opened.message), payload);
            prop_assert_eq!(opened.message.footer(), footer.as_deref().unwrap_or_default());
        }
    }
}

#[test]
fn the_same_payload_is_never_the_same_ciphertext() {
    let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
    sealer.update_keys(1, [keys(1)]).unwrap();
    let mut payload = || {
        let mut datagram = Vec::new();
        write_bytes(&mut datagram, &[7; 40], sealer.seal([0; 4]).unwrap()).unwrap();
        let message = NetworkMessage::decode(&datagram).unwrap();
        assert!(!message.payload().windows(8).any(|bytes| bytes == [7; 8]));
        message.payload()[..40].to_vec()
    };
    assert_ne!(payload(), payload());
}

#[test]
fn a_seal_goes_only_on_the_message_it_was_made_for() {
    let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
    sealer.update_keys(1, [keys(1)]).unwrap();
    let mut finish = |extras: fn(SecurityHeader<'_>) -> SecurityHeader<'_>| {
        let seal = sealer.seal([1; 4]).unwrap();
        let extras = Extras {
            security: Some(extras(seal.header())),
            ..Extras::default()
        };
        let mut out = Vec::new();
        let header = NetworkHeader::default();
        let mut message = NetworkMessageEncoder::with(&mut out, &header, None, &extras).unwrap();
        message.keep_alive(&DataSetHeader::default()).unwrap();
        message.finish_sealed(seal)
    };
    assert_eq!(finish(|security| security), Ok(()));
    let other = Err(EncodeError::Misplaced("a seal of another SecurityHeader"));
    assert_eq!(
        finish(|security| SecurityHeader {
            token_id: 2,
            ..security
        }),
        other
    );
    assert_eq!(
        finish(|security| SecurityHeader {
            encrypted: false,
            ..security
        }),
        other
    );
    assert_eq!(
        finish(|security| SecurityHeader {
            nonce: &[0; 8],
            ..security
        }),
        other
    );
    assert_eq!(
        finish(|security| SecurityHeader {
            force_key_reset: true,
            ..security
        }),
        other
    );
    assert_eq!(
        finish(|security| SecurityHeader {
            footer_size: Some(0),
            ..security
        }),
        other
    );
    let without = Err(EncodeError::Misplaced("a seal without SecurityHeader"));
    assert_eq!(finish(|_| SecurityHeader::NONE), without);
}

#[test]
fn a_message_with_a_data_set_message_missing_is_not_sealed() {
    let keys = keys(1);
    let seal = Seal::with_nonce(&keys, 1, SecurityMode::Sign, nonce([0; 4], 1));
    let extras = Extras {
        security: Some(seal.header()),
        ..Extras::default()
    };
    let mut out = Vec::new();
    let header = NetworkHeader::default();
    let message = NetworkMessageEncoder::with(&mut out, &header, None, &extras).unwrap();
    assert_eq!(
        message.finish_sealed(seal),
        Err(EncodeError::MessageCount {
            announced: 1,
            written: 0
        })
    );
}

#[test]
fn chunks_and_discovery_messages_are_sealed_like_any_other() {
    let keys = keys(1);
    let mode = SecurityMode::SignAndEncrypt;
    // A chunk of PublisherId 2 and DataSetWriterId 10, and a discovery probe.
    for headers in [&[0xD1, 0x90, 0x01, 2, 10, 0][..], &[0x91, 0x90, 0x04, 2]] {
        let seal = Seal::with_nonce(&keys, 1, mode, nonce([0; 4], 1));
        let mut written = vec![0xAA; 3];
        written.extend(headers);
        written.extend([0x03, 1, 0, 0, 0, 8]);
        written.extend(seal.header().nonce);
        let payload = [1, 0, 0, 0, 0, 0, 3, 0, 0, 0, b'a', b'b', b'c'];
        written.extend(payload);
        seal.apply(&mut written, 3).unwrap();
        let message = NetworkMessage::decode(&written[3..]).unwrap();
        let mut opener = super::opener(mode);
        let mut scratch = Vec::new();
        let opened = opener.open(&message, START, &mut scratch).unwrap();
        assert_eq!(opened.message.payload(), payload);
        if message.is_chunk() {
            assert_eq!(opened.message.chunk().unwrap().data, b"abc");
        }
    }
}

#[test]
fn bytes_that_are_no_open_message_take_no_seal() {
    let keys = keys(1);
    let seal = || Seal::with_nonce(&keys, 1, SecurityMode::SignAndEncrypt, nonce([0; 4], 1));
    let without = Err(EncodeError::Misplaced("a seal without SecurityHeader"));
    for bytes in [&[][..], &[0x00], &[0x01, 0x01]] {
        let mut buf = bytes.to_vec();
        for start in [0, 1, 9] {
            assert_eq!(seal().apply(&mut buf, start), without);
            assert_eq!(buf, bytes);
        }
    }
    let mut other = sealed(1, 2);
    assert_eq!(
        seal().apply(&mut other, 0),
        Err(EncodeError::Misplaced("a seal of another SecurityHeader"))
    );
    let too_long = vec![0; 65_536];
    assert_eq!(
        seal().footer(&too_long).map(|_| ()),
        Err(EncodeError::TooBig {
            what: "SecurityFooter",
            len: 65_536
        })
    );
}

#[test]
fn several_messages_in_one_buffer_are_sealed_each_by_itself() {
    let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
    sealer.update_keys(1, [keys(1)]).unwrap();
    let mut buf = Vec::new();
    let mut ends = vec![0];
    for _ in 0..3 {
        let seal = sealer.seal([0; 4]).unwrap();
        write(&mut buf, &header(PublisherId::UInt16(2), None), seal).unwrap();
        ends.push(buf.len());
    }
    let mut opener = super::opener(SecurityMode::SignAndEncrypt);
    for range in ends.windows(2) {
        assert_eq!(
            super::open(&mut opener, &buf[range[0]..range[1]]),
            Ok(false)
        );
    }
}

#[test]
fn a_message_secured_on_its_way_out_is_as_one_that_was_written_so() {
    for mode in [SecurityMode::Sign, SecurityMode::SignAndEncrypt] {
        let keys = keys(1);
        let seal = || Seal::with_nonce(&keys, 1, mode, nonce([1, 2, 3, 4], 9));
        let header = header(PublisherId::UInt16(2), Some(5));
        let mut expected = Vec::new();
        write(&mut expected, &header, seal()).unwrap();
        // Unsecured messages, without and with a SecurityHeader.
        for security in [None, Some(SecurityHeader::NONE)] {
            let extras = Extras {
                security,
                ..Extras::default()
            };
            let mut clear = Vec::new();
            let mut message =
                NetworkMessageEncoder::with(&mut clear, &header, Some(&[10]), &extras).unwrap();
            let mut fields = message.key_frame(&DataSetHeader::default()).unwrap();
            fields.scalar(uadp::Scalar::Int32(42)).unwrap();
            fields.finish().unwrap();
            message.finish().unwrap();
            let mut out = vec![0xAA];
            seal().secure(&clear, &mut out).unwrap();
            assert_eq!(out[1..], expected, "{mode:?} {security:?}");
            assert!(out.len() - 1 <= clear.len() + Seal::OVERHEAD);
        }
        // Sealed messages and other bytes are rejected, and the buffer is unchanged.
        for bad in [&expected[..], &[], &[0xF1], b"no message"] {
            let mut out = vec![0xAA];
            assert!(seal().secure(bad, &mut out).is_err());
            assert_eq!(out, [0xAA]);
        }
    }
}

#[test]
fn a_message_without_extended_flags_can_be_secured_too() {
    // PublisherId 2 as Byte, and an empty DataSetMessage.
    let clear = [0x11, 2, 0x01, 0, 0];
    let mut sealer = Sealer::new(SecurityMode::SignAndEncrypt);
    sealer.update_keys(1, [keys(1)]).unwrap();
    let mut out = Vec::new();
    let seal = sealer.seal([5; 4]).unwrap();
    seal.secure(&clear, &mut out).unwrap();
    assert_eq!(out.len(), clear.len() + Seal::OVERHEAD);
    let mut opener = Opener::new(SecurityMode::SignAndEncrypt);
    opener.update_keys(1, [keys(1)]).unwrap();
    let message = NetworkMessage::decode(&out).unwrap();
    let mut scratch = Vec::new();
    let opened = opener.open(&message, START, &mut scratch).unwrap();
    assert_eq!(opened.message.publisher_id(), Some(PublisherId::Byte(2)));
    assert_eq!(opened.message.payload(), &clear[2..]);
}
