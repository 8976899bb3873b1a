//! Detection of new messages, and of restarted writers.

use uadp::MessageKind::{DeltaFrame, Event, KeepAlive, KeyFrame};
use uadp::PubSubState::Operational;
use uadp::{Accepted, Arrival, DateTime, ReaderDrop, ReaderSettings, Timestamp};

use crate::state::{in_group, message, ms, settings, stamped, start_reader};

#[test]
fn the_next_message_is_accepted_and_a_gap_is_counted() {
    let mut reader = start_reader(settings());
    for (number, missed) in [(65534, 0), (65535, 0), (0, 0), (3, 2), (4, 0), (1004, 999)] {
        let accepted = reader.receive(&message(KeyFrame, number), ms(1)).unwrap();
        assert_eq!(accepted.missed, missed, "number {number}");
    }
    assert_eq!(reader.counters().missed, 1001);
    assert_eq!(reader.counters().accepted, 6);
}

#[test]
fn a_replayed_message_is_refused() {
    let mut reader = start_reader(settings());
    for number in 10..14 {
        reader.receive(&message(KeyFrame, number), ms(1)).unwrap();
    }
    for number in 10..14 {
        let refused = reader.receive(&message(KeyFrame, number), ms(2));
        assert_eq!(refused, Err(ReaderDrop::Duplicate), "number {number}");
    }
    assert_eq!(reader.counters().duplicates, 4);
}

#[test]
fn a_late_message_is_dropped_and_said_to_be_late() {
    let mut reader = start_reader(settings());
    for number in [10, 13] {
        reader.receive(&message(KeyFrame, number), ms(1)).unwrap();
    }
    let late = reader.receive(&message(KeyFrame, 12), ms(2));
    assert_eq!(late, Err(ReaderDrop::Stale { behind: 1 }));
    let old = reader.receive(&message(KeyFrame, 65000), ms(2));
    assert_eq!(old, Err(ReaderDrop::Stale { behind: 549 }));
    let invalid = reader.receive(&message(KeyFrame, 30013), ms(2));
    assert_eq!(invalid, Err(ReaderDrop::OutOfWindow));
    assert_eq!(reader.counters().stale, 2);
    assert_eq!(reader.counters().out_of_window, 1);
}

#[test]
fn a_reader_of_events_takes_late_ones_once() {
    let mut reader = start_reader(ReaderSettings {
        accept_late: true,
        ..settings()
    });
    for number in [100, 103] {
        reader.receive(&message(Event, number), ms(1)).unwrap();
    }
    for number in [101, 102] {
        let accepted = reader.receive(&message(Event, number), ms(2)).unwrap();
        assert!(accepted.late);
        let again = reader.receive(&message(Event, number), ms(2));
        assert_eq!(again, Err(ReaderDrop::Duplicate));
    }
    // The reader remembers 64 numbers.
    assert!(reader.receive(&message(Event, 40), ms(2)).unwrap().late);
    let too_late = reader.receive(&message(Event, 39), ms(2));
    assert_eq!(too_late, Err(ReaderDrop::Stale { behind: 64 }));
    assert_eq!(reader.counters().late, 3);
    assert_eq!(reader.counters().missed, 2);
}

#[test]
fn a_keep_alive_tells_of_messages_lost_before_it() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeyFrame, 5), ms(1)).unwrap();
    // 6 is the next number: nothing is lost, independent of the number of keep-alives.
    for _ in 0..3 {
        let accepted = reader.receive(&message(KeepAlive, 6), ms(1)).unwrap();
        assert_eq!(accepted, Accepted::default());
    }
    // 9 is the next number: 6, 7 and 8 are lost.
    let accepted = reader.receive(&message(KeepAlive, 9), ms(1)).unwrap();
    assert_eq!(accepted.missed, 3);
    let late = reader.receive(&message(KeyFrame, 8), ms(1));
    assert_eq!(late, Err(ReaderDrop::Stale { behind: 0 }));
    let old = reader.receive(&message(KeepAlive, 8), ms(1));
    assert_eq!(old, Err(ReaderDrop::Stale { behind: 1 }));
    let next = reader.receive(&message(KeyFrame, 9), ms(1)).unwrap();
    assert_eq!(next.missed, 0);
    assert_eq!(reader.counters().keep_alives, 4);
}

#[test]
fn a_first_keep_alive_says_which_number_to_count_from() {
    let mut reader = start_reader(settings());
    reader.receive(&message(KeepAlive, 0), ms(1)).unwrap();
    let accepted = reader.receive(&message(KeyFrame, 2), ms(1)).unwrap();
    assert_eq!(accepted.missed, 2);
}

#[test]
fn without_any_sequence_number_every_message_is_new() {
    let mut reader = start_reader(settings());
    for _ in 0..3 {
        let accepted = reader.receive(&Arrival::of_kind(KeyFrame), ms(1));
        assert_eq!(accepted, Ok(Accepted::default()));
    }
}

#[test]
fn the_number_of_the_network_message_tells_duplicates_but_no_losses() {
    let mut reader = start_reader(settings());
    for arrival in [in_group(7, 0), in_group(7, 2), in_group(12, 1)] {
        let accepted = reader.receive(&arrival, ms(1)).unwrap();
        assert_eq!(accepted.missed, 0, "{arrival:?}");
    }
    for arrival in [in_group(12, 1), in_group(12, 0), in_group(7, 3)] {
        let refused = reader.receive(&arrival, ms(1));
        assert_eq!(refused, Err(ReaderDrop::Duplicate), "{arrival:?}");
    }
    let old = reader.receive(&in_group(9, 0), ms(1));
    assert_eq!(old, Err(ReaderDrop::Stale { behind: 3 }));
}

#[test]
fn the_own_number_goes_before_that_of_the_network_message() {
    let mut reader = start_reader(settings());
    let numbered = |group, own| Arrival {
        header: message(KeyFrame, own).header,
        ..in_group(group, 0)
    };
    reader.receive(&numbered(1, 100), ms(1)).unwrap();
    reader.receive(&numbered(1, 101), ms(1)).unwrap();
    let refused = reader.receive(&numbered(2, 101), ms(1));
    assert_eq!(refused, Err(ReaderDrop::Duplicate));
}

#[test]
fn a_writer_that_starts_over_is_known_by_its_timestamp_at_once() {
    let mut reader = start_reader(settings());
    for (number, ticks) in [(5000, 10), (5001, 20)] {
        reader
            .receive(&stamped(KeyFrame, number, ticks), ms(1))
            .unwrap();
    }
    // A replayed message has its original Timestamp.
    let replayed = reader.receive(&stamped(KeyFrame, 5001, 20), ms(2));
    assert_eq!(replayed, Err(ReaderDrop::Duplicate));
    let replayed = reader.receive(&stamped(KeyFrame, 4000, 5), ms(2));
    assert_eq!(replayed, Err(ReaderDrop::Stale { behind: 1001 }));
    let accepted = reader.receive(&stamped(KeyFrame, 0, 30), ms(3)).unwrap();
    assert!(accepted.restarted);
    assert_eq!(accepted.missed, 0);
    let accepted = reader.receive(&stamped(KeyFrame, 1, 40), ms(4)).unwrap();
    assert!(!accepted.restarted);
    assert_eq!(reader.counters().restarts, 1);
}

#[test]
fn picoseconds_tell_two_stamps_apart() {
    let mut reader = start_reader(settings());
    let fine = |number, picoseconds| Arrival {
        timestamp: Some(Timestamp {
            time: DateTime(10),
            picoseconds,
        }),
        ..message(KeyFrame, number)
    };
    reader.receive(&fine(5000, 7), ms(1)).unwrap();
    assert!(reader.receive(&fine(0, 7), ms(1)).is_err());
    assert!(reader.receive(&fine(0, 8), ms(1)).unwrap().restarted);
}

#[test]
fn a_timestamp_that_is_not_filled_in_says_nothing() {
    let mut reader = start_reader(settings());
    reader.receive(&stamped(KeyFrame, 5000, 0), ms(1)).unwrap();
    let old = reader.receive(&stamped(KeyFrame, 4000, 5), ms(1));
    assert_eq!(old, Err(ReaderDrop::Stale { behind: 1000 }));
}

#[test]
fn without_timestamps_a_writer_that_starts_over_is_heard_after_two_timeouts() {
    for last in [3, 5000, 20_000, 40_000, 65_535] {
        let mut reader = start_reader(settings());
        for number in last - 3..=last {
            reader.receive(&message(KeyFrame, number), ms(0)).unwrap();
        }
        let mut heard = None;
        for (number, at) in (0..).zip((50..3000).step_by(50)) {
            let accepted = reader.receive(&message(KeyFrame, number), ms(at));
            // 5000 messages back, a few messages may be accepted as new by their numbers.
            if accepted.is_ok() {
                heard = heard.or(Some(at));
            } else {
                assert_eq!(heard, None, "dropped after it was heard, last {last}");
            }
        }
        assert!(heard.is_some_and(|at| at <= 2000), "last {last}: {heard:?}");
        assert_eq!(reader.state(), Operational);
    }
}

#[test]
fn without_a_timeout_a_writer_that_starts_over_is_heard_after_ten_seconds() {
    let mut reader = start_reader(ReaderSettings::default());
    reader.receive(&message(KeyFrame, 5000), ms(0)).unwrap();
    let early = reader.receive(&message(KeyFrame, 0), ms(9999));
    assert_eq!(early, Err(ReaderDrop::Stale { behind: 5000 }));
    let accepted = reader.receive(&message(KeyFrame, 1), ms(10_000)).unwrap();
    assert!(accepted.restarted);
    // A slow writer without restart continues, and its delta frames need no key frame.
    let accepted = reader.receive(&message(DeltaFrame, 3), ms(80_000)).unwrap();
    assert!(!accepted.restarted);
    assert_eq!(accepted.missed, 1);
    assert_eq!(reader.poll_timeout(), None);
}

#[test]
fn the_delta_frames_of_a_writer_that_started_over_wait_for_its_key_frame() {
    let mut reader = start_reader(settings());
    reader.receive(&stamped(KeyFrame, 5000, 10), ms(0)).unwrap();
    let delta = reader.receive(&stamped(DeltaFrame, 1, 20), ms(1));
    assert_eq!(delta, Err(ReaderDrop::NeedsKeyFrame));
    reader.receive(&stamped(KeyFrame, 2, 30), ms(2)).unwrap();
    reader.receive(&stamped(DeltaFrame, 3, 40), ms(3)).unwrap();
}
