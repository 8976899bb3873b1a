//! Tests of both robots on the same line, connected by a slow space that loses messages.

use std::collections::VecDeque;
use std::time::Duration;

use super::niryo::{ArmInput, Niryo, NiryoEvent};
use super::turtlebot::{Turtlebot, TurtlebotEvent};
use crate::pace::{LinePace, Speed};

/// The outcome of a run of the line.
#[derive(Debug, Default)]
struct Outcome {
    by_conveyor: u32,
    by_turtlebot: u32,
    /// Time at which the last cover arrived.
    finished: Duration,
    most_in_bucket: u32,
    last_cycle: Duration,
}

/// States in transit between the robots.
struct Channel<T> {
    delay: Duration,
    under_way: VecDeque<(Duration, T)>,
}

impl<T> Channel<T> {
    fn due(&mut self, now: Duration) -> Option<T> {
        let (at, _) = self.under_way.front()?;
        if *at > now {
            return None;
        }
        self.under_way.pop_front().map(|(_, value)| value)
    }

    fn send(&mut self, value: T, now: Duration) {
        self.under_way.push_back((now + self.delay, value));
    }
}

/// Simulates the line in steps of 10 ms. Every `keep`th of the repeated reports arrives, the others
/// are lost.
fn play(covers: u32, off_at: u64, delay: Duration, keep: u32) -> Outcome {
    let pace = LinePace::at(Speed::new(1.0).unwrap());
    let (mut niryo, mut turtlebot) = (Niryo::new(covers, pace), Turtlebot::new(pace));
    let mut counts = Channel {
        delay,
        under_way: VecDeque::new(),
    };
    let mut status = Channel {
        delay,
        under_way: VecDeque::new(),
    };
    let mut outcome = Outcome::default();
    let mut picked_at = Duration::ZERO;
    for tick in 0..100_000_u32 {
        let now = Duration::from_millis(10) * tick;
        let on = now < Duration::from_secs(off_at);
        let mut told = niryo.handle(ArmInput::Switch(on), now);
        if tick.is_multiple_of(50) && (tick / 50).is_multiple_of(keep) {
            counts.send(niryo.counts().on_turtlebot, now);
            status.send(turtlebot.status(), now);
        }
        while let Some(status) = status.due(now) {
            told.extend(niryo.handle(ArmInput::Park(status.park_busy), now));
            told.extend(niryo.handle(ArmInput::Bucket(status.bucket_busy), now));
        }
        let mut done = turtlebot.handle(None, now);
        while let Some(count) = counts.due(now) {
            done.extend(turtlebot.handle(Some(count), now));
        }
        for event in told {
            match event {
                NiryoEvent::Picked { .. } => picked_at = now,
                NiryoEvent::PlacedOnConveyor { total } => {
                    outcome.by_conveyor = total;
                    outcome.finished = now;
                }
                NiryoEvent::PlacedOnTurtlebot { total } => {
                    outcome.last_cycle = now.saturating_sub(picked_at);
                    let in_bucket = total - outcome.by_turtlebot;
                    outcome.most_in_bucket = outcome.most_in_bucket.max(in_bucket);
                }
                NiryoEvent::ConveyorStarted
                | NiryoEvent::ConveyorStopped { .. }
                | NiryoEvent::Waits { .. }
                | NiryoEvent::StorageEmpty => {}
            }
        }
        for event in done {
            if let TurtlebotEvent::Unloaded { total } = event {
                outcome.by_turtlebot = total;
                outcome.finished = now;
            }
        }
        if outcome.by_conveyor + outcome.by_turtlebot == covers {
            return outcome;
        }
    }
    panic!("the line is stuck after 1000 s: {outcome:?}");
}

#[test]
fn the_default_story_is_that_of_the_paper() {
    let outcome = play(4, 25, Duration::from_millis(10), 1);
    assert_eq!((outcome.by_conveyor, outcome.by_turtlebot), (2, 2));
    assert!(
        outcome.last_cycle > Duration::from_secs(10),
        "the last cycle waits: {outcome:?}"
    );
    assert!(outcome.finished < Duration::from_secs(76), "{outcome:?}");
}

#[test]
fn the_line_finishes_whenever_the_conveyor_stops() {
    for off_at in 0..60 {
        let outcome = play(4, off_at, Duration::from_millis(10), 1);
        assert_eq!(
            outcome.by_conveyor + outcome.by_turtlebot,
            4,
            "off at {off_at}"
        );
        assert!(outcome.most_in_bucket <= 1, "off at {off_at}: {outcome:?}");
    }
}

#[test]
fn the_line_finishes_with_slow_values_and_one_cover_in_the_bucket_at_a_time() {
    for off_at in [0, 10, 25, 26] {
        let outcome = play(6, off_at, Duration::from_secs(4), 1);
        assert_eq!(outcome.by_conveyor + outcome.by_turtlebot, 6);
        assert!(outcome.most_in_bucket <= 1, "off at {off_at}: {outcome:?}");
    }
}

#[test]
fn the_line_finishes_when_most_reports_are_lost() {
    for keep in [2, 7, 19] {
        let outcome = play(5, 12, Duration::from_millis(10), keep);
        assert_eq!(
            outcome.by_conveyor + outcome.by_turtlebot,
            5,
            "one report of {keep}"
        );
    }
}

#[test]
fn a_single_cover_and_none_left_end_the_line_too() {
    assert_eq!(play(1, 25, Duration::from_millis(10), 1).by_conveyor, 1);
    assert_eq!(play(1, 0, Duration::from_millis(10), 1).by_turtlebot, 1);
}
