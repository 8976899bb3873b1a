//! Unit tests of `writer`.

use uadp::DateTime;

use super::*;

fn sample() -> EncodedSample {
    EncodedSample {
        bytes: vec![0; 20],
        timestamp_at: 2,
        payload_at: 14,
        sequence_at: 16,
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "a test needs some instant to count from"
)]
fn writer() -> (SentTopicState, Instant) {
    let now = Instant::now();
    (SentTopicState::new(now), now)
}

fn keep(writer: &mut SentTopicState, publisher: Option<PublisherKey>, now: Instant) -> bool {
    let mut sample = sample();
    if let (Some(PublisherKey(key)), Some(byte)) = (publisher, sample.bytes.last_mut()) {
        *byte = u8::try_from(key).unwrap();
    }
    let gave_way = writer.keep((publisher, true), &SampleMessage::Datagram(sample));
    writer.sent(now);
    gave_way
}

/// Returns the sequence number and the last byte of each repetition.
fn round(writer: &mut SentTopicState) -> Vec<(u16, u8)> {
    std::iter::from_fn(|| writer.repeat(Vec::new))
        .map(|message| match message {
            SampleMessage::Datagram(again) => (again.sequence(), *again.bytes.last().unwrap()),
            SampleMessage::Large(_) => unreachable!("none was kept"),
        })
        .collect()
}

#[test]
fn the_last_sample_of_each_latched_publisher_is_repeated_until_it_leaves() {
    let (mut writer, now) = writer();
    for publisher in [1, 2, 3, 1] {
        keep(&mut writer, Some(PublisherKey(publisher)), now);
    }
    writer.begin_round(now);
    assert_eq!(round(&mut writer), [(0, 2), (1, 3), (2, 1)]);
    writer.forget(PublisherKey(3));
    writer.begin_round(now);
    assert_eq!(round(&mut writer), [(3, 2), (4, 1)]);
    assert!(!writer.repeats());
}

#[test]
fn publishers_come_and_go_within_a_round_and_none_is_left_out() {
    let (mut writer, now) = writer();
    for publisher in 1..=4 {
        keep(&mut writer, Some(PublisherKey(publisher)), now);
    }
    writer.begin_round(now);
    assert!(writer.repeat(Vec::new).is_some());
    assert!(writer.repeat(Vec::new).is_some());
    writer.forget(PublisherKey(1));
    keep(&mut writer, Some(PublisherKey(2)), now);
    let rest: Vec<u8> = round(&mut writer)
        .into_iter()
        .map(|(_, byte)| byte)
        .collect();
    assert_eq!(rest, [3, 4, 2]);
}

#[test]
fn of_too_many_latched_publishers_the_one_that_spoke_first_gives_way() {
    let (mut writer, now) = writer();
    let all = u32::try_from(MAX_KEPT).unwrap();
    assert!(!(0..all).any(|publisher| keep(&mut writer, Some(PublisherKey(publisher)), now)));
    assert!(keep(&mut writer, Some(PublisherKey(all)), now));
    writer.begin_round(now);
    assert_eq!(round(&mut writer).first(), Some(&(0, 1)));
}

#[test]
fn a_large_value_is_repeated_seldom_and_from_the_same_buffer() {
    let (mut writer, now) = writer();
    let large = Arc::new(EncodedSample {
        bytes: vec![0; 20_000_000],
        ..sample()
    });
    writer.keep((None, true), &SampleMessage::Large(Arc::clone(&large)));
    writer.sent(now);
    let minute = SECOND * 60;
    assert_eq!(
        writer.due(SECOND, minute),
        Some((now + SECOND * 2, Idle::Repeat))
    );
    writer.begin_round(now);
    assert!(writer.repeat(Vec::new).is_none(), "it is still being sent");
    let place = large.bytes.as_ptr();
    drop(large);
    writer.begin_round(now);
    let Some(SampleMessage::Large(again)) = writer.repeat(Vec::new) else {
        unreachable!("a large one was kept")
    };
    assert_eq!(again.bytes.as_ptr(), place);
}

const SECOND: Duration = Duration::from_secs(1);

#[test]
fn a_repetition_has_a_number_of_its_own_and_the_same_value() {
    let (mut writer, now) = writer();
    assert_eq!(writer.next_sequence(), 0);
    keep(&mut writer, None, now);
    writer.begin_round(now + SECOND);
    assert_eq!(round(&mut writer), [(1, 0)]);
    assert_eq!(writer.expected_sequence(), 2);
}

#[test]
fn values_are_repeated_with_keep_alives_between_when_those_are_more_frequent() {
    let (mut writer, now) = writer();
    assert_eq!(
        writer.due(SECOND, SECOND),
        None,
        "nothing to repeat before the first value"
    );
    keep(&mut writer, None, now);
    assert_eq!(
        writer.due(SECOND, SECOND),
        Some((now + SECOND, Idle::Repeat))
    );
    assert_eq!(
        writer.due(SECOND * 2, SECOND),
        Some((now + SECOND, Idle::KeepAlive))
    );
    writer.spoke(now + SECOND);
    assert_eq!(
        writer.due(SECOND * 2, SECOND),
        Some((now + SECOND * 2, Idle::Repeat))
    );
}

#[test]
fn events_are_not_repeated_and_a_topic_without_producer_falls_silent() {
    let (mut writer, now) = writer();
    writer.sent(now);
    assert_eq!(
        writer.due(SECOND, SECOND),
        Some((now + SECOND, Idle::KeepAlive))
    );
    writer.set_live(false);
    assert_eq!(writer.due(SECOND, SECOND), None);
    writer.sent(now);
    assert!(
        writer.due(SECOND, SECOND).is_some(),
        "a sample shows that it has one again"
    );
}

#[test]
fn two_samples_never_share_a_stamp_and_a_clock_set_back_is_followed() {
    let (mut writer, _) = writer();
    let at = |nanos: i128| Timestamp::from_unix_nanos(1_700_000_000_000_000_000 + nanos);
    let stamps = [5, 5, 3, 900].map(|nanos| writer.stamp(at(nanos)));
    assert_eq!(stamps, [at(5), at(6), at(7), at(900)]);
    let an_hour_back = at(-3_600_000_000_000);
    assert_eq!(writer.stamp(an_hour_back), an_hour_back);
}

#[test]
fn the_send_time_is_written_where_the_header_has_it() {
    let mut encoded = sample();
    encoded.stamp(Timestamp {
        time: DateTime(0x0102),
        picoseconds: 0x0304,
    });
    assert_eq!(encoded.bytes[2..12], [2, 1, 0, 0, 0, 0, 0, 0, 4, 3]);
}
