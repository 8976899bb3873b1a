//! Messages that are rejected for their content.

use uadp::{
    DataSetHeader, Extras, KeyError, NetworkMessage, NetworkMessageEncoder, Opener, PublisherId,
    Seal, SealError, Sealer, SecurityError, SecurityHeader, SecurityMode, SecurityPolicy,
    TokenKeys,
};

use super::{header, keys, nonce, open, opener, sealed, write};

#[test]
fn unsecured_messages_are_refused() {
    let plain = [0x11, 2, 0x01];
    let empty_header = [0x91, 0x10, 2, 0, 0, 0, 0, 0, 0, 0x01];
    for datagram in [&plain[..], &empty_header] {
        for mode in [SecurityMode::Sign, SecurityMode::SignAndEncrypt] {
            assert_eq!(
                open(&mut opener(mode), datagram),
                Err(SecurityError::Unsecured)
            );
        }
    }
}

#[test]
fn a_message_is_opened_but_once() {
    let datagram = sealed(1, 1);
    let mut opener = opener(SecurityMode::SignAndEncrypt);
    let message = NetworkMessage::decode(&datagram).unwrap();
    let mut scratch = Vec::new();
    let opened = opener.open(&message, super::START, &mut scratch).unwrap();
    let mut scratch = Vec::new();
    let again = opener.open(&opened.message, super::START, &mut scratch);
    assert_eq!(again.map(|_| ()), Err(SecurityError::Unsecured));
}

#[test]
fn signed_messages_are_refused_where_encryption_is_asked_for_and_not_the_other_way_round() {
    let keys = keys(1);
    let mut signed = Vec::new();
    let seal = Seal::with_nonce(&keys, 1, SecurityMode::Sign, nonce([0; 4], 1));
    write(&mut signed, &header(PublisherId::UInt16(2), Some(5)), seal).unwrap();
    let encrypted = sealed(1, 2);
    let mut strict = opener(SecurityMode::SignAndEncrypt);
    assert_eq!(open(&mut strict, &signed), Err(SecurityError::Unencrypted));
    assert_eq!(open(&mut strict, &encrypted), Ok(false));
    let mut readable = opener(SecurityMode::Sign);
    assert_eq!(open(&mut readable, &signed), Ok(false));
    assert_eq!(open(&mut readable, &encrypted), Ok(false));
}

/// Returns a message with any SecurityHeader, followed by these bytes only.
fn with_security(security: SecurityHeader<'_>, rest: &[u8]) -> Vec<u8> {
    let extras = Extras {
        security: Some(security),
        ..Extras::default()
    };
    let header = header(PublisherId::UInt16(2), Some(5));
    let mut datagram = Vec::new();
    drop(NetworkMessageEncoder::with(&mut datagram, &header, Some(&[10]), &extras).unwrap());
    datagram.extend(rest);
    datagram
}

#[test]
fn headers_no_sealer_writes_are_refused() {
    let sound = SecurityHeader {
        signed: true,
        encrypted: true,
        token_id: 1,
        nonce: &[0; 8],
        ..SecurityHeader::default()
    };
    let mut opener = opener(SecurityMode::Sign);
    let mut refuse = |security, rest: &[u8]| open(&mut opener, &with_security(security, rest));
    let unsigned = SecurityHeader {
        signed: false,
        ..sound
    };
    assert_eq!(refuse(unsigned, &[0; 40]), Err(SecurityError::Unsigned));
    for len in [0, 7, 9, 255] {
        let security = SecurityHeader {
            nonce: &[0; 255][..len],
            ..sound
        };
        assert_eq!(
            refuse(security, &[0; 40]),
            Err(SecurityError::NonceLength(len))
        );
    }
    assert_eq!(
        refuse(sound, &[0; 31]),
        Err(SecurityError::Truncated {
            expected: 32,
            found: 31
        })
    );
    let footer = SecurityHeader {
        footer_size: Some(9),
        ..sound
    };
    assert_eq!(
        refuse(footer, &[0; 40]),
        Err(SecurityError::Truncated {
            expected: 41,
            found: 40
        })
    );
    assert_eq!(refuse(footer, &[0; 41]), Err(SecurityError::Signature));
    for token_id in [0, 2, u32::MAX] {
        let security = SecurityHeader { token_id, ..sound };
        assert_eq!(
            refuse(security, &[0; 40]),
            Err(SecurityError::UnknownToken(token_id))
        );
    }
}

#[test]
fn messages_of_another_group_are_refused() {
    let mut opener = Opener::new(SecurityMode::SignAndEncrypt);
    assert_eq!(
        open(&mut opener, &sealed(1, 1)),
        Err(SecurityError::UnknownToken(1))
    );
    opener.update_keys(1, [keys(9)]).unwrap();
    assert_eq!(
        open(&mut opener, &sealed(1, 1)),
        Err(SecurityError::Signature)
    );
}

#[test]
fn key_data_has_the_length_of_its_policy() {
    for (policy, length) in [
        (SecurityPolicy::PubSubAes128Ctr, 52),
        (SecurityPolicy::PubSubAes256Ctr, 68),
    ] {
        assert_eq!(policy.key_data_length(), length);
        assert_eq!(SecurityPolicy::from_uri(policy.uri()), Some(policy));
        for found in 0..100 {
            let keys = TokenKeys::from_bytes(policy, &vec![1; found]);
            let expected = (found == length).then_some(policy).ok_or(KeyError::Length {
                policy,
                expected: length,
                found,
            });
            assert_eq!(keys.map(|keys| keys.policy()), expected);
        }
    }
    let none = "http://opcfoundation.org/UA/SecurityPolicy#None";
    assert_eq!(SecurityPolicy::from_uri(none), None);
}

#[test]
fn keys_are_equal_only_in_all_their_parts() {
    let policy = SecurityPolicy::PubSubAes128Ctr;
    let same = TokenKeys::from_bytes(policy, &[7; 52]).unwrap();
    assert_eq!(same, TokenKeys::from_bytes(policy, &[7; 52]).unwrap());
    for at in [0, 31, 32, 47, 48, 51] {
        let mut key_data = [7; 52];
        key_data[at] = 8;
        assert_ne!(same, TokenKeys::from_bytes(policy, &key_data).unwrap());
    }
    let longer = TokenKeys::from_bytes(SecurityPolicy::PubSubAes256Ctr, &[7; 68]).unwrap();
    assert_ne!(same, longer);
}

#[test]
fn debug_shows_no_key_material() {
    let keys = keys(0xAB);
    let mut opener = Opener::new(SecurityMode::Sign);
    opener.update_keys(1, [keys.clone()]).unwrap();
    let mut sealer = Sealer::new(SecurityMode::Sign);
    sealer.update_keys(1, [keys.clone()]).unwrap();
    let shown = [
        format!("{keys:?}"),
        format!("{:?}", sealer.seal([0; 4]).unwrap()),
        format!("{opener:#?}{sealer:#?}"),
    ]
    .concat();
    assert!(shown.contains("PubSubAes128Ctr"));
    for material in ["171", "ab", "AB"] {
        assert!(!shown.contains(material), "{material} in {shown}");
    }
}

#[test]
fn without_keys_nothing_is_sealed() {
    let mut sealer = Sealer::new(SecurityMode::Sign);
    assert_eq!(sealer.seal([0; 4]).map(|_| ()), Err(SealError::NoKeys));
    assert_eq!(sealer.update_keys(0, [keys(1)]), Err(KeyError::TokenId));
    assert_eq!(sealer.update_keys(1, []), Err(KeyError::Count(0)));
    assert_eq!(sealer.current_token_id(), None);
}

#[test]
fn a_message_that_promises_a_signature_is_not_finished_without() {
    let keys = keys(1);
    let seal = Seal::with_nonce(&keys, 1, SecurityMode::Sign, nonce([0; 4], 1));
    let extras = Extras {
        security: Some(seal.header()),
        ..Extras::default()
    };
    let header = header(PublisherId::UInt16(2), None);
    let mut datagram = Vec::new();
    let mut message = NetworkMessageEncoder::with(&mut datagram, &header, None, &extras).unwrap();
    message.keep_alive(&DataSetHeader::default()).unwrap();
    assert!(message.finish().is_err());
}
