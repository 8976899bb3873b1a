//! Unit tests of `reader`.

use super::*;

fn address(port: u16) -> SocketAddr {
    ([127, 0, 0, 1], port).into()
}

fn place(sequence: u16, stamp: i128) -> SequencePosition {
    SequencePosition {
        sequence: Some(sequence),
        stamp: Some(Timestamp::from_unix_nanos(stamp)),
        fine: true,
        sent: None,
        from: address(1),
        is_relayed: false,
        held_back: Duration::ZERO,
        by_clients: false,
    }
}

/// Admits a message for [`Handling::Shown`].
fn admit(
    reader: &mut ReceivedTopicState,
    place: SequencePosition,
    now: Instant,
) -> Result<(u16, ValueRelation), Reason> {
    let admitted = reader.admit(place, None, Handling::Shown, now)?;
    Ok((admitted.missing, admitted.kept))
}

#[expect(
    clippy::disallowed_methods,
    reason = "a test needs some instant to count from"
)]
fn reader() -> (ReceivedTopicState, Instant) {
    let now = Instant::now();
    (ReceivedTopicState::new(Some(address(1)), now), now)
}

#[test]
fn numbers_wrap_and_gaps_are_counted() {
    let (mut reader, now) = reader();
    assert_eq!(
        admit(&mut reader, place(65_534, 1000), now),
        Ok((0, ValueRelation::Alone))
    );
    assert_eq!(
        admit(&mut reader, place(65_535, 2000), now),
        Ok((0, ValueRelation::Alone))
    );
    assert_eq!(
        admit(&mut reader, place(2, 3000), now),
        Ok((2, ValueRelation::Alone)),
        "0 and 1 are missing"
    );
}

#[test]
fn old_and_equal_numbers_are_dropped_unless_the_writer_started_over() {
    let (mut reader, now) = reader();
    assert_eq!(hear(&mut reader, 500, 9000, now), Ok(ValueRelation::Alone));
    assert_eq!(
        admit(&mut reader, place(500, 9000), now),
        Err(Reason::Repeat),
        "sent again under its number"
    );
    assert_eq!(
        admit(&mut reader, place(499, 8000), now),
        Err(Reason::Stale)
    );
    assert_eq!(
        admit(&mut reader, place(0, 10_000), now),
        Ok((0, ValueRelation::Alone)),
        "a newer stamp tells of a restart"
    );
    let moved = SequencePosition {
        from: address(2),
        ..place(0, 9_500)
    };
    assert_eq!(
        reader
            .admit(moved, None, Handling::Event, now)
            .map(|admitted| admitted.missing),
        Ok(0),
        "another address tells of a restart"
    );
}

#[test]
fn a_copy_from_another_socket_of_the_writer_is_not_delivered_again() {
    for handling in [Handling::Event, Handling::AsSource, Handling::State] {
        let (mut reader, now) = reader();
        let admit = |reader: &mut ReceivedTopicState, place: SequencePosition| {
            let admitted = reader.admit(place, None, handling, now)?;
            reader.delivered(place.instance(), (admitted.kept, admitted.lasting), now);
            Ok(admitted.missing)
        };
        assert_eq!(admit(&mut reader, place(7, 1000)), Ok(0));
        let elsewhere = |sequence, stamp| SequencePosition {
            from: address(2),
            ..place(sequence, stamp)
        };
        let copy = elsewhere(7, 1000);
        for _ in 0..2 {
            assert_eq!(
                admit(&mut reader, copy),
                Err(Reason::Repeat),
                "{handling:?}"
            );
        }
        assert_eq!(reader.take_moved(), 1);
        // The numbers of the writer continue.
        assert_eq!(admit(&mut reader, elsewhere(9, 2000)), Ok(1));
        assert_eq!(reader.take_moved(), 0);
    }
}

#[test]
fn a_datagram_that_comes_after_the_end_of_its_writer_is_handed_on_once() {
    for handling in [Handling::Event, Handling::AsSource, Handling::Shown] {
        let (mut reader, now) = reader();
        let admit = |reader: &mut ReceivedTopicState, place: SequencePosition| {
            let admitted = reader.admit(place, None, handling, now)?;
            reader.delivered(place.instance(), (admitted.kept, admitted.lasting), now);
            Ok(admitted.kept)
        };
        assert_eq!(admit(&mut reader, place(7, 1000)), Ok(ValueRelation::Alone));
        assert_eq!(admit(&mut reader, place(8, 2000)), Ok(ValueRelation::Alone));
        assert!(reader.leave());
        // Both datagrams were delayed by the network.
        assert_eq!(admit(&mut reader, place(7, 1000)), Err(Reason::Stale));
        assert_eq!(admit(&mut reader, place(8, 2000)), Err(Reason::Repeat));
        // The next writer starts with a clock that was set back.
        assert_eq!(admit(&mut reader, place(0, 500)).err(), None);
    }
}

#[test]
fn states_that_a_broker_delivers_again_after_a_silence_are_no_restart() {
    let (mut reader, now) = reader();
    let coarse = |sequence: u16, stamp: i128| SequencePosition {
        fine: false,
        is_relayed: true,
        ..place(sequence, stamp)
    };
    let hear = |reader: &mut ReceivedTopicState,
                place: SequencePosition|
     -> Result<ValueRelation, Reason> {
        let (_, kept) = admit(reader, place, now)?;
        reader.delivered(place.instance(), (kept, false), now);
        Ok(kept)
    };
    for sequence in 1..=50 {
        let place = coarse(sequence, i128::from(sequence) * 1000);
        assert_eq!(hear(&mut reader, place), Ok(ValueRelation::Alone));
    }
    assert!(reader.fell_silent(now + PERIOD, PERIOD));
    for sequence in 31..50 {
        let place = coarse(sequence, i128::from(sequence) * 1000);
        assert_eq!(hear(&mut reader, place), Err(Reason::Stale));
    }
    let last = coarse(50, 50_000);
    assert_eq!(hear(&mut reader, last), Err(Reason::Duplicate));
    assert_eq!(
        hear(&mut reader, coarse(51, 51_000)),
        Ok(ValueRelation::Alone)
    );
    // A restart shows by a newer stamp, by a number far behind, or without a broker.
    assert!(!reader.leave());
    assert_eq!(
        hear(&mut reader, coarse(40, 52_000)),
        Ok(ValueRelation::Alone)
    );
    assert!(!reader.leave());
    assert_eq!(hear(&mut reader, coarse(0, 500)), Ok(ValueRelation::Alone));
    assert!(!reader.leave());
    let without_broker = SequencePosition {
        is_relayed: false,
        ..coarse(65_535, 400)
    };
    assert_eq!(hear(&mut reader, without_broker), Ok(ValueRelation::Alone));
}

#[test]
fn a_repeated_key_frame_is_known_by_its_stamp() {
    let (mut reader, now) = reader();
    let first = place(1, 1000);
    assert_eq!(
        admit(&mut reader, first, now),
        Ok((0, ValueRelation::Alone))
    );
    reader.delivered(first.instance(), (ValueRelation::Alone, false), now);
    assert_eq!(admit(&mut reader, place(2, 1000), now), Err(Reason::Repeat));
    assert_eq!(
        admit(&mut reader, place(3, 2000), now),
        Ok((0, ValueRelation::Alone)),
        "another sample"
    );
    let (mut coarse, now) = self::reader();
    let stamp_without_picoseconds = SequencePosition {
        fine: false,
        ..place(1, 1000)
    };
    assert_eq!(
        admit(&mut coarse, stamp_without_picoseconds, now),
        Ok((0, ValueRelation::Alone))
    );
    coarse.delivered(
        stamp_without_picoseconds.instance(),
        (ValueRelation::Alone, false),
        now,
    );
    let next = SequencePosition {
        sequence: Some(2),
        ..stamp_without_picoseconds
    };
    assert_eq!(
        admit(&mut coarse, next, now),
        Ok((0, ValueRelation::Alone)),
        "a coarse stamp may be shared by two samples"
    );
}

const PERIOD: Duration = Duration::from_secs(1);

/// Admits and delivers a key frame as the Router does.
fn hear(
    reader: &mut ReceivedTopicState,
    sequence: u16,
    stamp: i128,
    now: Instant,
) -> Result<ValueRelation, Reason> {
    let place = place(sequence, stamp);
    let (_, kept) = admit(reader, place, now)?;
    reader.delivered(place.instance(), (kept, false), now);
    Ok(kept)
}

#[test]
fn of_several_values_repeated_side_by_side_each_is_handed_on_once() {
    let (mut reader, start) = reader();
    let first: Vec<_> = [1000, 2000, 3000]
        .into_iter()
        .zip(1..)
        .map(|(stamp, sequence)| hear(&mut reader, sequence, stamp, start))
        .collect();
    assert_eq!(first, [Ok(ValueRelation::Alone); 3]);
    let mut round = |turn: u16| -> Vec<_> {
        let now = start + PERIOD * u32::from(turn);
        [1000, 2000, 3000]
            .into_iter()
            .zip(turn * 3 + 1..)
            .map(|(stamp, sequence)| hear(&mut reader, sequence, stamp, now))
            .collect()
    };
    let kept_again = [
        Ok(ValueRelation::Again),
        Ok(ValueRelation::Again),
        Err(Reason::Repeat),
    ];
    assert_eq!(
        round(1),
        kept_again,
        "the older ones were not given up after all"
    );
    for turn in 2..20 {
        assert_eq!(round(turn), [Err(Reason::Repeat); 3]);
    }
}

#[test]
fn who_comes_late_gets_all_values_wherever_in_the_round_it_begins() {
    let (mut reader, now) = reader();
    let heard: Vec<_> = [2000, 3000, 1000, 2000, 3000, 1000]
        .into_iter()
        .zip(7..)
        .map(|(stamp, sequence)| hear(&mut reader, sequence, stamp, now))
        .collect();
    let repeat = Err(Reason::Repeat);
    let expected = [
        Ok(ValueRelation::Alone),
        Ok(ValueRelation::Alone),
        Ok(ValueRelation::Beside),
        Ok(ValueRelation::Again),
        repeat,
        repeat,
    ];
    assert_eq!(heard, expected);
}

#[test]
fn a_value_that_is_no_longer_repeated_is_retired_and_one_value_is_a_state_again() {
    let (mut reader, start) = reader();
    let mut sequence = 0;
    let mut retired = Vec::new();
    for turn in 0..12_u32 {
        let now = start + PERIOD * turn;
        // From turn 4 an update replaces the first value; from turn 8 the second value is not
        // repeated.
        let first = if turn < 4 { 1000 } else { 3000 };
        for stamp in [first, 2000].into_iter().filter(|s| turn < 8 || *s != 2000) {
            sequence += 1;
            let _what = hear(&mut reader, sequence, stamp, now);
            while let Some(gone) = reader.retire(now, PERIOD * 3) {
                retired.push((turn, gone.unix_nanos()));
            }
        }
    }
    assert_eq!(retired, [(6, 1000), (10, 2000)]);
    let next = hear(&mut reader, sequence + 1, 4000, start + PERIOD * 12);
    assert_eq!(next, Ok(ValueRelation::Alone));
}

#[test]
fn a_clock_that_is_set_back_makes_no_older_value_of_a_newer_one() {
    let (mut reader, now) = reader();
    let sent_at = |sequence, stamp: i128, sent: i128| SequencePosition {
        sent: Some(Timestamp::from_unix_nanos(sent)),
        ..place(sequence, stamp)
    };
    let (second, soon) = (1_000_000_000, 50_000);
    let mut hear = |place: SequencePosition| {
        let (_, kept) = admit(&mut reader, place, now)?;
        reader.delivered(place.instance(), (kept, false), now);
        Ok(kept)
    };
    let first = hear(sent_at(1, 1000 * second, 1000 * second + soon));
    assert_eq!(first, Ok(ValueRelation::Alone));
    let set_back = hear(sent_at(2, 900 * second, 900 * second + soon));
    assert_eq!(set_back, Ok(ValueRelation::Alone));
    let next = hear(sent_at(3, 901 * second, 901 * second + soon));
    assert_eq!(next, Ok(ValueRelation::Alone));
    let repeated = hear(sent_at(4, 901 * second, 902 * second));
    assert_eq!(repeated, Err(Reason::Repeat));
    // A sample that was taken earlier and sent later is another value, as for several latched
    // publishers.
    let beside = hear(sent_at(5, 890 * second, 903 * second));
    assert_eq!(beside, Ok(ValueRelation::Beside));
}

#[test]
fn nothing_is_retired_while_the_writer_says_nothing_at_all() {
    let (mut reader, start) = reader();
    for (sequence, stamp) in (0..).zip([1000, 2000, 1000, 2000]) {
        let _what = hear(&mut reader, sequence, stamp, start);
    }
    let later = start + PERIOD * 60;
    assert_eq!(hear(&mut reader, 4, 1000, later), Err(Reason::Repeat));
    let gone = reader.retire(later, PERIOD * 3);
    assert_eq!(gone.map(Timestamp::unix_nanos), Some(2000));
    assert_eq!(reader.retire(later, PERIOD * 3), None);
}

#[test]
fn a_fast_topic_beside_a_latched_value_does_not_push_that_out() {
    let (mut reader, now) = reader();
    let mut sequence = 0_u16;
    let mut stamp = 1000;
    let mut heard_anew = 0;
    for turn in 0..2000 {
        sequence += 1;
        if turn % 100 == 0 {
            let of_latched = hear(&mut reader, sequence, 1000, now);
            heard_anew += usize::from(of_latched != Err(Reason::Repeat));
        } else {
            stamp += 1;
            assert!(hear(&mut reader, sequence, stamp, now).is_ok());
        }
    }
    // Delivered at first, and again when the topic turns out to have several values.
    assert!(heard_anew <= 2, "{heard_anew}");
}

#[test]
fn silence_is_told_once_and_ends_with_the_next_message() {
    let (mut reader, start) = reader();
    let timeout = Duration::from_secs(3);
    let early = start + Duration::from_millis(2999);
    assert!(!reader.fell_silent(early, timeout));
    assert!(reader.fell_silent(start + timeout, timeout));
    assert!(!reader.fell_silent(start + timeout * 2, timeout));
    assert_eq!(reader.due(timeout), None);
    assert!(reader.lives(start + timeout * 3));
    assert!(!reader.lives(start + timeout * 3));
    assert!(reader.fell_silent(start + timeout * 4, timeout));
    assert_eq!(reader.loss(), None);
}

#[test]
fn who_only_repeats_itself_on_two_ways_lives_and_who_is_not_understood_does_not() {
    let (mut reader, start) = reader();
    let timeout = Duration::from_secs(3);
    reader.dropped(Reason::Duplicate);
    assert!(!reader.lives(start + timeout), "it never was silent");
    assert!(!reader.fell_silent(start + timeout, timeout));
    reader.dropped(Reason::Overflow);
    assert!(!reader.lives(start + timeout * 2));
    assert!(!reader.fell_silent(start + timeout * 2, timeout));
    reader.dropped(Reason::Mismatch);
    reader.dropped(Reason::Duplicate);
    reader.heard(start + timeout * 3);
    assert!(!reader.lives(start + timeout * 3));
    assert!(reader.fell_silent(start + timeout * 3, timeout));
    assert_eq!(reader.loss(), Some(Reason::Mismatch));
    assert!(!reader.lives(start + timeout * 4));
    assert!(!reader.may_be(address(2), start + timeout * 4, timeout * 2));
    assert!(reader.is_good(start + timeout * 4));
}
