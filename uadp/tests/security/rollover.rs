//! Key changes on both sides.

use uadp::{NetworkMessage, Opener, PublisherId, SealError, Sealer, SecurityError, SecurityMode};

use super::{START, header, keys, open, opener, sealed, write};

const ENCRYPT: SecurityMode = SecurityMode::SignAndEncrypt;

/// Returns true if the message made its key current.
fn changes_key(opener: &mut Opener, datagram: &[u8]) -> bool {
    let message = NetworkMessage::decode(datagram).unwrap();
    let mut scratch = Vec::new();
    opener
        .open(&message, START, &mut scratch)
        .unwrap()
        .key_changed
}

#[test]
fn a_message_with_the_next_key_makes_it_current() {
    let mut opener = opener(ENCRYPT);
    opener.update_keys(1, [keys(1), keys(2), keys(3)]).unwrap();
    assert!(!changes_key(&mut opener, &sealed(1, 1)));
    assert_eq!(opener.next_token_id(), Some(2));
    assert!(changes_key(&mut opener, &sealed(2, 1)));
    assert!(!changes_key(&mut opener, &sealed(2, 2)));
    assert_eq!(opener.current_token_id(), Some(2));
    assert!(changes_key(&mut opener, &sealed(3, 1)));
    assert_eq!(opener.next_token_id(), None);
}

#[test]
fn a_forged_message_with_the_next_key_changes_nothing() {
    let mut opener = opener(ENCRYPT);
    opener.update_keys(1, [keys(1), keys(2)]).unwrap();
    let mut forged = sealed(2, 1);
    *forged.last_mut().unwrap() ^= 1;
    assert_eq!(open(&mut opener, &forged), Err(SecurityError::Signature));
    assert_eq!(opener.current_token_id(), Some(1));
}

#[test]
fn a_past_key_is_good_as_long_as_it_is_kept() {
    let mut opener = opener(ENCRYPT);
    opener
        .update_keys(1, [keys(1), keys(2), keys(3), keys(4)])
        .unwrap();
    for token in [1, 2, 3] {
        assert_eq!(open(&mut opener, &sealed(token, 1)), Ok(false));
    }
    assert_eq!(open(&mut opener, &sealed(1, 2)), Ok(false));
    assert_eq!(opener.current_token_id(), Some(3), "no way back");
    assert_eq!(
        open(&mut opener, &sealed(1, 2)),
        Err(SecurityError::Replayed(2))
    );
    assert_eq!(open(&mut opener, &sealed(4, 1)), Ok(false));
    assert_eq!(
        open(&mut opener, &sealed(1, 3)),
        Err(SecurityError::RetiredToken(1))
    );
    assert_eq!(open(&mut opener, &sealed(2, 2)), Ok(false));
}

#[test]
fn a_key_given_again_does_not_open_its_messages_again() {
    let mut opener = opener(ENCRYPT);
    opener.update_keys(1, [keys(1), keys(2)]).unwrap();
    assert_eq!(open(&mut opener, &sealed(1, 1)), Ok(false));
    assert_eq!(open(&mut opener, &sealed(2, 1)), Ok(false));
    opener.update_keys(1, [keys(1), keys(2), keys(3)]).unwrap();
    for token in [1, 2] {
        let again = open(&mut opener, &sealed(token, 1));
        assert_eq!(again, Err(SecurityError::Replayed(1)));
    }
    opener
        .update_keys(3, [keys(3), keys(4), keys(5), keys(6)])
        .unwrap();
    assert_eq!(open(&mut opener, &sealed(6, 1)), Ok(false));
    opener
        .update_keys(1, [keys(1), keys(2), keys(3), keys(4), keys(5), keys(6)])
        .unwrap();
    assert_eq!(
        open(&mut opener, &sealed(1, 1)),
        Err(SecurityError::RetiredToken(1))
    );
}

#[test]
fn a_subscriber_that_starts_late_takes_the_keys_it_missed() {
    let mut opener = Opener::new(ENCRYPT);
    opener.update_keys(3, [keys(3), keys(4)]).unwrap();
    assert_eq!(
        open(&mut opener, &sealed(2, 1)),
        Err(SecurityError::UnknownToken(2))
    );
    opener.update_keys(2, [keys(2), keys(3)]).unwrap();
    assert_eq!(open(&mut opener, &sealed(2, 1)), Ok(false));
    assert_eq!(opener.current_token_id(), Some(3));
}

#[test]
fn keys_with_none_in_common_take_the_place_of_all() {
    let mut opener = opener(ENCRYPT);
    opener.update_keys(1, [keys(1), keys(2)]).unwrap();
    opener.update_keys(9, [keys(9)]).unwrap();
    assert_eq!(
        open(&mut opener, &sealed(1, 1)),
        Err(SecurityError::RetiredToken(1))
    );
    assert_eq!(open(&mut opener, &sealed(9, 1)), Ok(false));
}

#[test]
fn another_key_under_the_same_token_counts_from_the_start() {
    let mut sealer = Sealer::new(ENCRYPT);
    sealer.update_keys(1, [keys(1)]).unwrap();
    let mut opener = Opener::new(ENCRYPT);
    opener.update_keys(1, [keys(1)]).unwrap();
    for byte in [1, 2] {
        sealer.update_keys(1, [keys(byte)]).unwrap();
        opener.update_keys(1, [keys(byte)]).unwrap();
        for sequence in 1..=3 {
            let seal = sealer.seal([0; 4]).unwrap();
            let mut datagram = Vec::new();
            write(&mut datagram, &header(PublisherId::Byte(1), None), seal).unwrap();
            assert_eq!(open(&mut opener, &datagram), Ok(false));
            assert_eq!(sealer.sequence_number(), sequence);
        }
    }
}

#[test]
fn each_key_of_a_publisher_counts_from_1_and_is_never_taken_up_again() {
    let mut sealer = Sealer::new(ENCRYPT);
    sealer.update_keys(5, [keys(5), keys(6)]).unwrap();
    let sequence = |sealer: &mut Sealer| {
        let seal = sealer.seal([9, 8, 7, 6]).unwrap();
        let security = seal.header();
        assert_eq!(security.nonce[..4], [9, 8, 7, 6]);
        let sequence: [u8; 4] = security.nonce[4..].try_into().unwrap();
        (security.token_id, u32::from_le_bytes(sequence))
    };
    assert_eq!([(); 2].map(|()| sequence(&mut sealer)), [(5, 1), (5, 2)]);
    sealer.update_keys(5, [keys(5), keys(6)]).unwrap();
    assert_eq!(sequence(&mut sealer), (5, 3), "the key is the same");
    assert!(!sealer.move_to(5), "it is there already");
    assert!(!sealer.move_to(7), "it has no such key");
    assert!(sealer.move_to(6));
    assert_eq!(sequence(&mut sealer), (6, 1));
    assert!(!sealer.next_key());
    assert!(!sealer.move_to(5), "no way back");
    sealer.update_keys(5, [keys(5), keys(6), keys(7)]).unwrap();
    assert_eq!(sequence(&mut sealer), (6, 2), "the service is behind");
    sealer.update_keys(7, [keys(7)]).unwrap();
    assert_eq!(sequence(&mut sealer), (7, 1));
}

#[test]
fn the_token_id_behind_the_highest_is_1() {
    let mut sealer = Sealer::new(ENCRYPT);
    sealer.update_keys(u32::MAX, [keys(0xFF), keys(1)]).unwrap();
    let mut opener = Opener::new(ENCRYPT);
    opener.update_keys(u32::MAX, [keys(0xFF), keys(1)]).unwrap();
    assert!(!changes_key(&mut opener, &sealed(u32::MAX, 1)));
    assert!(changes_key(&mut opener, &sealed(1, 1)));
    assert!(sealer.next_key());
    assert_eq!(sealer.current_token_id(), Some(1));
    assert_eq!(opener.current_token_id(), Some(1));
}

#[test]
fn at_the_end_of_the_sequence_numbers_a_new_key_is_needed() {
    let mut sealer = Sealer::new(ENCRYPT);
    sealer.update_keys(1, [keys(1), keys(2)]).unwrap();
    sealer.continue_after(u32::MAX - 1);
    sealer.continue_after(3);
    assert!(sealer.seal([0; 4]).is_ok());
    for _ in 0..2 {
        assert_eq!(
            sealer.seal([0; 4]).map(|_| ()),
            Err(SealError::Exhausted(1))
        );
    }
    assert!(sealer.next_key());
    assert_eq!(sealer.sequence_number(), 0);
    assert!(sealer.seal([0; 4]).is_ok());
}

#[test]
fn new_keys_are_asked_for_until_the_key_changes() {
    let mut sealer = Sealer::new(ENCRYPT);
    sealer.update_keys(1, [keys(1), keys(2)]).unwrap();
    let mut opener = Opener::new(ENCRYPT);
    opener.update_keys(1, [keys(1), keys(2)]).unwrap();
    let mut asks = |sealer: &mut Sealer| {
        let mut datagram = Vec::new();
        let seal = sealer.seal([0; 4]).unwrap();
        write(&mut datagram, &header(PublisherId::Byte(1), None), seal).unwrap();
        let message = NetworkMessage::decode(&datagram).unwrap();
        let mut scratch = Vec::new();
        let opened = opener.open(&message, START, &mut scratch).unwrap();
        opened.force_key_reset
    };
    assert!(!asks(&mut sealer));
    sealer.force_key_reset();
    assert!(asks(&mut sealer) && asks(&mut sealer));
    assert!(sealer.next_key());
    assert!(!asks(&mut sealer));
}
