//! Replayed, late and unexpected messages.

use std::time::Duration;

use proptest::collection::vec;
use proptest::prelude::*;
use uadp::{CountedBy, OpenerOptions, PublisherId, SecurityError, SecurityMode};

use super::{START, keys, open, open_at, opener, opener_with, sealed, sealed_by};

const ENCRYPT: SecurityMode = SecurityMode::SignAndEncrypt;

#[test]
fn a_replayed_message_is_refused() {
    let mut opener = opener(ENCRYPT);
    assert_eq!(open(&mut opener, &sealed(1, 7)), Ok(false));
    assert_eq!(
        open(&mut opener, &sealed(1, 7)),
        Err(SecurityError::Replayed(7))
    );
    assert_eq!(open(&mut opener, &sealed(1, 8)), Ok(false));
    for sequence in [7, 8] {
        let again = open(&mut opener, &sealed(1, sequence));
        assert_eq!(again, Err(SecurityError::Replayed(sequence)));
    }
}

#[test]
fn messages_may_overtake_each_other_within_the_window() {
    let mut opener = opener(ENCRYPT);
    for sequence in [200, 199, 73, 198, 130, 201, 74] {
        assert_eq!(
            open(&mut opener, &sealed(1, sequence)),
            Ok(false),
            "{sequence}"
        );
    }
    for sequence in [74, 130, 199, 201] {
        let again = open(&mut opener, &sealed(1, sequence));
        assert_eq!(again, Err(SecurityError::Replayed(sequence)));
    }
    let late = SecurityError::TooOld {
        sequence: 73,
        newest: 201,
    };
    assert_eq!(open(&mut opener, &sealed(1, 73)), Err(late));
}

#[test]
fn a_step_of_the_whole_window_forgets_nothing_it_still_shows() {
    for step in [127, 128, 129, 1 << 20] {
        let mut opener = opener(ENCRYPT);
        assert_eq!(open(&mut opener, &sealed(1, 5)), Ok(false));
        assert_eq!(open(&mut opener, &sealed(1, 5 + step)), Ok(false));
        let refused = match step {
            127 => SecurityError::Replayed(5),
            _ => SecurityError::TooOld {
                sequence: 5,
                newest: 5 + step,
            },
        };
        assert_eq!(open(&mut opener, &sealed(1, 5)), Err(refused), "{step}");
        assert_eq!(open(&mut opener, &sealed(1, 4 + step)), Ok(false), "{step}");
    }
}

#[test]
fn a_step_forward_the_standard_calls_invalid_is_refused() {
    let mut opener = opener(ENCRYPT);
    let farthest = 1 + (1 << 30);
    assert_eq!(open(&mut opener, &sealed(1, 1)), Ok(false));
    let far = SecurityError::TooFarAhead {
        sequence: farthest + 1,
        newest: 1,
    };
    assert_eq!(open(&mut opener, &sealed(1, farthest + 1)), Err(far));
    assert_eq!(open(&mut opener, &sealed(1, farthest)), Ok(false));
}

#[test]
fn the_sequence_number_does_not_start_over_under_one_key() {
    let mut opener = opener(ENCRYPT);
    assert_eq!(open(&mut opener, &sealed(1, u32::MAX)), Ok(false));
    for sequence in [0, 1] {
        let late = SecurityError::TooOld {
            sequence,
            newest: u32::MAX,
        };
        assert_eq!(open(&mut opener, &sealed(1, sequence)), Err(late));
    }
}

#[test]
fn publishers_writer_groups_and_keys_are_counted_apart() {
    let mut opener = opener(ENCRYPT);
    opener.update_keys(1, [keys(1), keys(2)]).unwrap();
    let publishers = [
        PublisherId::Byte(2),
        PublisherId::UInt16(2),
        PublisherId::UInt32(2),
        PublisherId::UInt64(2),
        PublisherId::String("2"),
        PublisherId::String("cell 4"),
    ];
    let mut each = |expected: Result<bool, ()>| {
        for publisher in publishers {
            for group in [None, Some(5), Some(6)] {
                for token in [1, 2] {
                    let datagram = sealed_by(publisher, group, token, 1);
                    let result = open(&mut opener, &datagram).map_err(|error| {
                        assert_eq!(error, SecurityError::Replayed(1));
                    });
                    assert_eq!(result, expected, "{publisher:?} {group:?} {token}");
                }
            }
        }
    };
    each(Ok(false));
    each(Err(()));
}

#[test]
fn no_more_publishers_are_followed_than_allowed() {
    let options = OpenerOptions {
        max_streams: 2,
        forget_after: Some(Duration::from_secs(10)),
        ..OpenerOptions::default()
    };
    let mut opener = opener_with(options, ENCRYPT);
    let of = |publisher, sequence| sealed_by(PublisherId::UInt16(publisher), None, 1, sequence);
    let second = Duration::from_secs(1);
    assert_eq!(open_at(&mut opener, &of(1, 1), START), Ok(false));
    assert_eq!(open_at(&mut opener, &of(2, 1), START + second), Ok(false));
    let before = format!("{opener:?}");
    let third = open_at(&mut opener, &of(3, 1), START + 9 * second);
    assert_eq!(third, Err(SecurityError::TooManyPublishers));
    assert_eq!(format!("{opener:?}"), before);
    assert_eq!(
        open_at(&mut opener, &of(2, 2), START + 9 * second),
        Ok(false)
    );
    assert_eq!(
        open_at(&mut opener, &of(3, 1), START + 10 * second),
        Ok(false)
    );
    let first = open_at(&mut opener, &of(1, 2), START + 10 * second);
    assert_eq!(first, Err(SecurityError::TooManyPublishers));
    let replayed = open_at(&mut opener, &of(2, 1), START + 10 * second);
    assert_eq!(replayed, Err(SecurityError::Replayed(1)));
}

#[test]
fn a_publisher_silent_for_long_may_count_anew_where_that_is_allowed() {
    let second = Duration::from_secs(1);
    let options = OpenerOptions {
        forget_after: Some(10 * second),
        ..OpenerOptions::default()
    };
    let late = Err(SecurityError::TooOld {
        sequence: 1,
        newest: 500,
    });
    let mut opener = opener_with(options, ENCRYPT);
    assert_eq!(open_at(&mut opener, &sealed(1, 500), 5 * second), Ok(false));
    assert_eq!(
        open_at(&mut opener, &sealed(1, 1), START),
        late,
        "time goes back"
    );
    assert_eq!(open_at(&mut opener, &sealed(1, 1), 14 * second), late);
    assert_eq!(open_at(&mut opener, &sealed(1, 1), 15 * second), Ok(false));
    let again = open_at(&mut opener, &sealed(1, 1), 15 * second);
    assert_eq!(again, Err(SecurityError::Replayed(1)));

    let mut strict = super::opener(ENCRYPT);
    assert_eq!(open(&mut strict, &sealed(1, 500)), Ok(false));
    assert_eq!(open_at(&mut strict, &sealed(1, 1), Duration::MAX), late);
}

#[test]
fn a_publisher_that_counts_is_held_to_it_even_where_others_need_not() {
    let options = OpenerOptions {
        accept_constant_sequence: true,
        ..OpenerOptions::default()
    };
    let mut opener = opener_with(options, ENCRYPT);
    assert_eq!(open(&mut opener, &sealed(1, 1)), Ok(false));
    assert_eq!(open(&mut opener, &sealed(1, 2)), Ok(false));
    for sequence in [1, 2] {
        let again = open(&mut opener, &sealed(1, sequence));
        assert_eq!(again, Err(SecurityError::Replayed(sequence)));
    }
}

proptest! {
    #[test]
    fn each_sequence_number_is_accepted_at_most_once_and_every_recent_one_is(
        numbers in vec(1..400_u32, 1..80),
    ) {
        let mut opener = opener(ENCRYPT);
        let mut accepted: Vec<u32> = Vec::new();
        for number in numbers {
            let newest = accepted.iter().copied().max().unwrap_or(number);
            let expected = if newest >= number + 128 {
                Err(SecurityError::TooOld { sequence: number, newest })
            } else if accepted.contains(&number) {
                Err(SecurityError::Replayed(number))
            } else {
                accepted.push(number);
                Ok(false)
            };
            prop_assert_eq!(open(&mut opener, &sealed(1, number)), expected);
        }
    }
}

#[test]
fn senders_that_share_a_publisher_id_are_told_apart_by_their_nonces() {
    let by = |random: u8, sequence: u32| {
        let keys = keys(1);
        let nonce = super::nonce([random; 4], sequence);
        let seal = uadp::Seal::with_nonce(&keys, 1, ENCRYPT, nonce);
        let mut datagram = Vec::new();
        let header = super::header(PublisherId::UInt16(2), Some(5));
        super::write(&mut datagram, &header, seal).unwrap();
        datagram
    };
    let options = OpenerOptions {
        counted_by: CountedBy::Sender,
        max_streams: 2,
        ..OpenerOptions::default()
    };
    let mut opener = opener_with(options, ENCRYPT);
    assert_eq!(open(&mut opener, &by(1, 5000)), Ok(false));
    // Another run starts at 1.
    assert_eq!(open(&mut opener, &by(2, 1)), Ok(false));
    assert_eq!(open(&mut opener, &by(2, 2)), Ok(false));
    for (random, sequence) in [(1, 5000), (2, 1), (2, 2)] {
        let again = open(&mut opener, &by(random, sequence));
        assert_eq!(again, Err(SecurityError::Replayed(sequence)));
    }
    let full = open(&mut opener, &by(3, 1));
    assert_eq!(full, Err(SecurityError::TooManyPublishers));

    let mut opener = opener_with(OpenerOptions::default(), ENCRYPT);
    assert_eq!(open(&mut opener, &by(1, 5000)), Ok(false));
    let restarted = open(&mut opener, &by(2, 1));
    assert!(matches!(restarted, Err(SecurityError::TooOld { .. })));
}
