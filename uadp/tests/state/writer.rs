//! Schedules of writers.

use uadp::MessageKind::{DeltaFrame, Event, KeepAlive, KeyFrame};
use uadp::PubSubState::{Error, Operational, Paused, PreOperational};
use uadp::{
    ConfigurationVersion, DataSetWriterState, MessageKind, SequenceCounter, WriterSettings,
    WriterSettingsError,
};

use crate::state::ms;

pub(crate) fn start_writer(interval: u64, keep_alive: u64, key_frames: u32) -> DataSetWriterState {
    let settings = WriterSettings::new(ms(interval), ms(keep_alive), key_frames).unwrap();
    let mut writer = DataSetWriterState::new(settings, Operational);
    writer.enable().unwrap();
    assert_eq!(writer.ready(ms(0)), Ok(Operational));
    writer
}

/// Polls at each time, and sends the messages that are due.
fn run(
    writer: &mut DataSetWriterState,
    steps: &[(u64, bool)],
) -> Vec<(u64, MessageKind, Option<u16>)> {
    let mut sent = Vec::new();
    for (now, changed) in steps {
        if let Some(kind) = writer.poll(ms(*now), *changed) {
            sent.push((*now, kind, writer.header().sequence_number));
            writer.sent(kind, ms(*now));
        }
    }
    sent
}

#[test]
fn with_a_key_frame_count_of_one_every_interval_has_a_key_frame() {
    let mut writer = start_writer(100, 100, 1);
    let sent = run(
        &mut writer,
        &[(0, true), (50, true), (100, false), (200, true)],
    );
    assert_eq!(
        sent,
        [
            (0, KeyFrame, Some(0)),
            (100, KeyFrame, Some(1)),
            (200, KeyFrame, Some(2))
        ]
    );
}

#[test]
fn nothing_changed_sends_no_delta_frame_but_a_keep_alive_with_the_next_number() {
    let mut writer = start_writer(100, 250, 10);
    let steps: Vec<_> = (0..=10).map(|i| (i * 50, i == 0 || i == 2)).collect();
    let sent = run(&mut writer, &steps);
    assert_eq!(
        sent,
        [
            (0, KeyFrame, Some(0)),
            (100, DeltaFrame, Some(1)),
            (350, KeepAlive, Some(2))
        ]
    );
    assert_eq!(
        run(&mut writer, &[(550, true), (600, true)]),
        [(600, DeltaFrame, Some(2))]
    );
}

#[test]
fn intervals_that_were_slept_through_count_for_the_key_frame() {
    let mut writer = start_writer(100, 100, 5);
    run(&mut writer, &[(0, true), (100, true)]);
    assert_eq!(
        run(&mut writer, &[(499, true)]),
        [(499, DeltaFrame, Some(2))]
    );
    // The grid is unchanged.
    assert_eq!(writer.poll_timeout(), Some(ms(500)));
    assert_eq!(
        run(&mut writer, &[(500, false)]),
        [(500, KeyFrame, Some(3))]
    );
    assert_eq!(
        run(&mut writer, &[(9999, false)]),
        [(9999, KeyFrame, Some(4))]
    );
}

#[test]
fn a_key_frame_sent_in_place_of_a_delta_frame_counts_as_one() {
    let mut writer = start_writer(100, 100, 2);
    run(&mut writer, &[(0, true)]);
    assert_eq!(writer.poll(ms(100), true), Some(DeltaFrame));
    writer.sent(KeyFrame, ms(100));
    assert_eq!(writer.poll(ms(200), true), Some(DeltaFrame));
    writer.sent(DeltaFrame, ms(200));
    assert_eq!(writer.poll(ms(300), true), Some(KeyFrame));
}

#[test]
fn a_key_frame_that_was_not_sent_is_due_again() {
    let mut writer = start_writer(100, 100, 10);
    assert_eq!(writer.poll(ms(0), true), Some(KeyFrame));
    assert_eq!(writer.poll(ms(0), true), None);
    assert_eq!(writer.poll(ms(100), false), Some(KeyFrame));
    assert_eq!(writer.header().sequence_number, Some(0));
}

#[test]
fn events_are_due_at_once_or_with_the_next_interval() {
    let mut writer = start_writer(0, 1000, 0);
    assert_eq!(writer.poll_timeout(), Some(ms(1000)));
    let sent = run(
        &mut writer,
        &[
            (5, false),
            (7, true),
            (8, true),
            (1007, false),
            (1008, false),
        ],
    );
    assert_eq!(
        sent,
        [
            (7, Event, Some(0)),
            (8, Event, Some(1)),
            (1008, KeepAlive, Some(2))
        ]
    );
    let mut writer = start_writer(100, 1000, 0);
    assert_eq!(
        run(&mut writer, &[(0, false), (30, true), (100, true)]),
        [(100, Event, Some(0))]
    );
}

#[test]
fn settings_the_standard_does_not_allow_are_refused() {
    let new = |interval, keep_alive, key_frames| {
        WriterSettings::new(ms(interval), ms(keep_alive), key_frames).map(|_| ())
    };
    let keep_alive = |interval, keep_alive| {
        Err(WriterSettingsError::KeepAliveTime {
            keep_alive_time: ms(keep_alive),
            publishing_interval: ms(interval),
        })
    };
    assert_eq!(new(100, 99, 1), keep_alive(100, 99));
    assert_eq!(new(0, 0, 0), keep_alive(0, 0));
    assert_eq!(new(0, 10, 1), Err(WriterSettingsError::KeyFrameCount(1)));
    assert_eq!(new(100, 100, 1), Ok(()));
    assert_eq!(new(0, 1, 0), Ok(()));
}

#[test]
fn changed_metadata_is_announced_once_and_a_key_frame_follows() {
    let mut writer = start_writer(100, 100, 100);
    run(&mut writer, &[(0, true), (100, true)]);
    assert!(!writer.take_announcement());
    writer.change_metadata(500);
    assert_eq!(writer.header().major_version, Some(500));
    assert_eq!(writer.header().minor_version, Some(500));
    assert!(writer.take_announcement());
    assert!(!writer.take_announcement());
    assert_eq!(
        run(&mut writer, &[(200, false)]),
        [(200, KeyFrame, Some(2))]
    );
    writer.extend_metadata(600);
    assert_eq!(
        writer.version(),
        ConfigurationVersion {
            major: 500,
            minor: 600
        }
    );
    assert_eq!(run(&mut writer, &[(300, true)]), [(300, KeyFrame, Some(3))]);
}

#[test]
fn a_writer_sends_in_operational_only_and_goes_on_with_its_numbers() {
    let settings = WriterSettings::new(ms(100), ms(100), 1).unwrap();
    let mut writer = DataSetWriterState::new(settings, Operational);
    assert_eq!(writer.poll_timeout(), None);
    writer.enable().unwrap();
    assert_eq!(writer.poll(ms(0), true), None);
    assert_eq!(writer.poll_timeout(), None);
    writer.ready(ms(40)).unwrap();
    assert_eq!(writer.poll_timeout(), Some(ms(40)));
    assert_eq!(run(&mut writer, &[(40, true)]), [(40, KeyFrame, Some(0))]);
    assert_eq!(writer.set_parent(Paused), Paused);
    assert_eq!(writer.poll(ms(500), true), None);
    assert_eq!(writer.set_parent(Operational), PreOperational);
    writer.ready(ms(600)).unwrap();
    assert_eq!(run(&mut writer, &[(600, true)]), [(600, KeyFrame, Some(1))]);
    writer.fail().unwrap();
    assert_eq!(writer.state(), Error);
    assert_eq!(writer.poll(ms(800), true), None);
    writer.resolve(ms(900)).unwrap();
    assert_eq!(run(&mut writer, &[(900, true)]), [(900, KeyFrame, Some(2))]);
    writer.disable().unwrap();
    assert_eq!(writer.poll(ms(1000), true), None);
}

#[test]
fn a_writer_can_go_on_where_an_earlier_one_stopped() {
    let version = ConfigurationVersion { major: 7, minor: 8 };
    let mut first = start_writer(100, 100, 1);
    run(&mut first, &[(0, true), (100, true)]);
    let mut second = start_writer(100, 100, 1).resuming(first.sequence(), version);
    assert_eq!(second.version(), version);
    assert_eq!(run(&mut second, &[(0, true)]), [(0, KeyFrame, Some(2))]);
    let end = SequenceCounter::starting_at(65535);
    let mut last = start_writer(100, 100, 1).resuming(end, version);
    let sent = run(&mut last, &[(0, true), (100, true)]);
    assert_eq!(sent, [(0, KeyFrame, Some(65535)), (100, KeyFrame, Some(0))]);
}
