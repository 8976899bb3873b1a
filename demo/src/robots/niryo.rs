//! The business program of Niryo Ned, without sockets and clock.
//!
//! The arm knows of the rest of the line only what the topics of the space say: the switch of its conveyor, and
//! whether park and bucket are busy. All of these are states, heard as often as they are repeated; what counts is the
//! last one heard.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::pace::Pace;

/// What the arm hears.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Heard {
    /// The switch of the conveyor is on or off.
    Switch(bool),
    /// TurtleBot3 stands at the park, or does not.
    Park(bool),
    /// There is a cover in the bucket, or there is none.
    Bucket(bool),
    /// Nothing: time has passed.
    Nothing,
}

/// What the arm tells the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Counts {
    pub(crate) conveyor_running: bool,
    pub(crate) in_storage: u32,
    /// Covers placed on the conveyor so far.
    pub(crate) on_conveyor: u32,
    /// Covers placed on TurtleBot3 so far.
    pub(crate) on_turtlebot: u32,
}

/// What the arm does, for the timeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "niryo", rename_all = "snake_case")]
pub(crate) enum NiryoEvent {
    ConveyorStarted,
    ConveyorStopped { holding_cover: bool },
    Picked { left: u32 },
    PlacedOnConveyor { total: u32 },
    PlacedOnTurtlebot { total: u32 },
    Waits { cause: WaitCause },
    StorageEmpty,
}

/// Why the arm holds a cover and does not place it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum WaitCause {
    /// TurtleBot3 is not at the park.
    ParkFree,
    /// The bucket has a cover already.
    BucketBusy,
    /// Nothing has been heard of TurtleBot3 yet.
    Unknown,
}

/// The arm and its conveyor.
#[derive(Clone, Debug)]
pub(crate) struct Niryo {
    pace: Pace,
    counts: Counts,
    arm: Arm,
    cycle: u32,
    switch: Option<bool>,
    park: Option<bool>,
    bucket: Bucket,
}

/// Times are since the program's start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Arm {
    /// Until the switch of the conveyor has been heard once.
    Awaiting,
    Resting {
        until: Duration,
    },
    Picking {
        until: Duration,
    },
    Carrying {
        until: Duration,
    },
    /// Over the place with a cover in the gripper.
    Holding {
        told: Option<WaitCause>,
    },
    Done,
}

/// What the arm knows of the bucket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Bucket {
    Unknown,
    Free,
    Busy,
    /// We have placed a cover. Reports that it is free may be older than that.
    Filled {
        at: Duration,
    },
}

impl Niryo {
    pub(crate) const fn new(covers: u32, pace: Pace) -> Self {
        Self {
            pace,
            counts: Counts {
                conveyor_running: false,
                in_storage: covers,
                on_conveyor: 0,
                on_turtlebot: 0,
            },
            arm: Arm::Awaiting,
            cycle: 0,
            switch: None,
            park: None,
            bucket: Bucket::Unknown,
        }
    }

    pub(crate) fn handle(&mut self, heard: Heard, now: Duration) -> Vec<NiryoEvent> {
        let mut events = Vec::new();
        match heard {
            Heard::Switch(on) => self.hear_switch(on, now, &mut events),
            Heard::Park(busy) => self.hear_park(busy),
            Heard::Bucket(busy) => self.hear_bucket(busy, now),
            Heard::Nothing => {}
        }
        while let Some(event) = self.step(now) {
            events.extend(event);
        }
        events
    }

    pub(crate) const fn counts(&self) -> Counts {
        self.counts
    }

    /// When to come back if nothing is heard.
    pub(crate) const fn timeout(&self) -> Option<Duration> {
        match self.arm {
            Arm::Resting { until } | Arm::Picking { until } | Arm::Carrying { until } => {
                Some(until)
            }
            Arm::Awaiting | Arm::Holding { .. } | Arm::Done => None,
        }
    }

    fn hear_switch(&mut self, on: bool, now: Duration, events: &mut Vec<NiryoEvent>) {
        self.switch = Some(on);
        if self.arm == Arm::Awaiting {
            self.arm = Arm::Resting {
                until: now + self.pace.first_rest,
            };
        }
        // The cable: the conveyor follows its switch at once.
        if self.counts.conveyor_running != on {
            self.counts.conveyor_running = on;
            let holding_cover = matches!(self.arm, Arm::Carrying { .. } | Arm::Holding { .. });
            events.push(if on {
                NiryoEvent::ConveyorStarted
            } else {
                NiryoEvent::ConveyorStopped { holding_cover }
            });
        }
    }

    fn hear_park(&mut self, busy: bool) {
        self.park = Some(busy);
        if !busy && matches!(self.bucket, Bucket::Filled { .. }) {
            // It has left, so it has seen the cover; it will say when the bucket is free.
            self.bucket = Bucket::Busy;
        }
    }

    fn hear_bucket(&mut self, busy: bool, now: Duration) {
        self.bucket = match (self.bucket, busy) {
            (_, true) => Bucket::Busy,
            (Bucket::Filled { at }, false) if now < at + self.pace.report_age => self.bucket,
            (_, false) => Bucket::Free,
        };
    }

    /// One step of the arm: `None` when it has to wait, `Some(None)` for a step not worth telling.
    fn step(&mut self, now: Duration) -> Option<Option<NiryoEvent>> {
        match self.arm {
            Arm::Awaiting | Arm::Done => None,
            Arm::Resting { until } if until <= now => {
                if self.counts.in_storage == 0 {
                    self.arm = Arm::Done;
                    return Some(Some(NiryoEvent::StorageEmpty));
                }
                self.arm = Arm::Picking {
                    until: now + self.pace.half_cycle(self.cycle),
                };
                Some(None)
            }
            Arm::Picking { until } if until <= now => {
                self.counts.in_storage = self.counts.in_storage.saturating_sub(1);
                self.arm = Arm::Carrying {
                    until: now + self.pace.half_cycle(self.cycle),
                };
                Some(Some(NiryoEvent::Picked {
                    left: self.counts.in_storage,
                }))
            }
            Arm::Carrying { until } if until <= now => {
                self.arm = Arm::Holding { told: None };
                Some(None)
            }
            Arm::Resting { .. } | Arm::Picking { .. } | Arm::Carrying { .. } => None,
            Arm::Holding { told } => self.place(told, now).map(Some),
        }
    }

    /// Where the cover goes is decided when the arm is there, not before.
    fn place(&mut self, told: Option<WaitCause>, now: Duration) -> Option<NiryoEvent> {
        let event = if self.counts.conveyor_running {
            self.counts.on_conveyor += 1;
            NiryoEvent::PlacedOnConveyor {
                total: self.counts.on_conveyor,
            }
        } else if let Some(cause) = self.turtlebot_not_ready() {
            self.arm = Arm::Holding { told: Some(cause) };
            return (told != Some(cause)).then_some(NiryoEvent::Waits { cause });
        } else {
            self.counts.on_turtlebot += 1;
            self.bucket = Bucket::Filled { at: now };
            NiryoEvent::PlacedOnTurtlebot {
                total: self.counts.on_turtlebot,
            }
        };
        self.cycle += 1;
        self.arm = Arm::Resting {
            until: now + self.pace.rest,
        };
        Some(event)
    }

    const fn turtlebot_not_ready(&self) -> Option<WaitCause> {
        match (self.park, self.bucket) {
            (Some(true), Bucket::Free) => None,
            (Some(true), Bucket::Busy | Bucket::Filled { .. }) => Some(WaitCause::BucketBusy),
            (Some(false), _) => Some(WaitCause::ParkFree),
            (None, _) | (_, Bucket::Unknown) => Some(WaitCause::Unknown),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pace::Speed;

    fn niryo(covers: u32) -> Niryo {
        Niryo::new(covers, Pace::at(Speed::new(1.0).unwrap()))
    }

    /// Lets the time pass up to `end`, waking the arm when it asks for it.
    fn run_until(niryo: &mut Niryo, end: Duration) -> Vec<(Duration, NiryoEvent)> {
        let mut events = Vec::new();
        while let Some(at) = niryo.timeout().filter(|at| *at <= end) {
            events.extend(
                niryo
                    .handle(Heard::Nothing, at)
                    .into_iter()
                    .map(|event| (at, event)),
            );
        }
        events
    }

    const fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    #[test]
    fn it_does_not_begin_before_the_switch_is_heard() {
        let mut arm = niryo(4);
        arm.handle(Heard::Park(true), s(1));
        arm.handle(Heard::Bucket(false), s(1));
        assert_eq!(arm.timeout(), None);
        assert_eq!(
            arm.handle(Heard::Switch(true), s(2)),
            [NiryoEvent::ConveyorStarted]
        );
        assert_eq!(arm.timeout(), Some(s(4)));
    }

    #[test]
    fn a_repeated_switch_is_no_news() {
        let mut arm = niryo(4);
        arm.handle(Heard::Switch(true), s(0));
        assert_eq!(arm.handle(Heard::Switch(true), s(1)), []);
        assert_eq!(arm.timeout(), Some(s(2)), "the first rest goes on");
    }

    #[test]
    fn with_a_running_conveyor_every_cover_goes_there() {
        let mut arm = niryo(2);
        arm.handle(Heard::Switch(true), s(0));
        let events = run_until(&mut arm, s(100));
        assert_eq!(
            events,
            [
                (Duration::from_millis(5500), NiryoEvent::Picked { left: 1 }),
                (s(9), NiryoEvent::PlacedOnConveyor { total: 1 }),
                (
                    Duration::from_millis(14_500),
                    NiryoEvent::Picked { left: 0 }
                ),
                (s(17), NiryoEvent::PlacedOnConveyor { total: 2 }),
                (s(20), NiryoEvent::StorageEmpty),
            ]
        );
    }

    #[test]
    fn a_cover_held_while_the_conveyor_stops_goes_to_turtlebot3() {
        let mut arm = niryo(4);
        arm.handle(Heard::Park(true), s(0));
        arm.handle(Heard::Bucket(false), s(0));
        arm.handle(Heard::Switch(true), s(0));
        run_until(&mut arm, s(25));
        assert_eq!(arm.counts().on_conveyor, 2);
        assert_eq!(
            arm.handle(Heard::Switch(false), s(25)),
            [NiryoEvent::ConveyorStopped {
                holding_cover: true
            }]
        );
        let events = run_until(&mut arm, s(27));
        assert_eq!(
            events,
            [(s(27), NiryoEvent::PlacedOnTurtlebot { total: 1 })]
        );
        assert!(!arm.counts().conveyor_running);
        assert_eq!(arm.counts().on_conveyor, 2);
    }

    #[test]
    fn with_an_empty_park_it_waits_until_turtlebot3_stands_there() {
        let mut arm = niryo(1);
        arm.handle(Heard::Park(false), s(0));
        arm.handle(Heard::Bucket(false), s(0));
        arm.handle(Heard::Switch(false), s(0));
        let waits = NiryoEvent::Waits {
            cause: WaitCause::ParkFree,
        };
        assert_eq!(run_until(&mut arm, s(60)).last(), Some(&(s(9), waits)));
        assert_eq!(arm.handle(Heard::Park(false), s(61)), [], "it says so once");
        assert_eq!(
            arm.handle(Heard::Park(true), s(62)),
            [NiryoEvent::PlacedOnTurtlebot { total: 1 }]
        );
    }

    #[test]
    fn a_busy_bucket_makes_it_wait() {
        let mut arm = niryo(1);
        arm.handle(Heard::Park(true), s(0));
        arm.handle(Heard::Bucket(true), s(0));
        arm.handle(Heard::Switch(false), s(0));
        run_until(&mut arm, s(60));
        assert_eq!(arm.counts().on_turtlebot, 0);
        assert_eq!(
            arm.handle(Heard::Bucket(false), s(62)),
            [NiryoEvent::PlacedOnTurtlebot { total: 1 }]
        );
    }

    #[test]
    fn not_knowing_turtlebot3_is_no_permission() {
        let mut arm = niryo(1);
        arm.handle(Heard::Switch(false), s(0));
        arm.handle(Heard::Park(true), s(1));
        let waits = NiryoEvent::Waits {
            cause: WaitCause::Unknown,
        };
        assert_eq!(run_until(&mut arm, s(60)).last(), Some(&(s(9), waits)));
    }

    /// An arm that has just placed its first of two covers on TurtleBot3, at second 9.
    fn after_the_first_on_turtlebot3() -> Niryo {
        let mut arm = niryo(2);
        arm.handle(Heard::Park(true), s(0));
        arm.handle(Heard::Bucket(false), s(0));
        arm.handle(Heard::Switch(false), s(0));
        run_until(&mut arm, s(9));
        assert_eq!(arm.counts().on_turtlebot, 1);
        arm
    }

    #[test]
    fn a_late_report_of_a_free_bucket_brings_no_second_cover_into_it() {
        let mut arm = after_the_first_on_turtlebot3();
        arm.handle(Heard::Bucket(false), s(10));
        arm.handle(Heard::Park(true), s(10));
        run_until(&mut arm, s(20));
        assert_eq!(arm.counts().on_turtlebot, 1);
    }

    #[test]
    fn a_missed_report_of_a_busy_bucket_does_not_stop_the_line() {
        let mut arm = after_the_first_on_turtlebot3();
        run_until(&mut arm, s(20));
        // All that said busy and away was lost; this is long after.
        let events = arm.handle(Heard::Bucket(false), s(40));
        assert_eq!(events, [NiryoEvent::PlacedOnTurtlebot { total: 2 }]);
    }

    #[test]
    fn a_bucket_that_comes_back_free_takes_the_next_cover() {
        let mut arm = after_the_first_on_turtlebot3();
        arm.handle(Heard::Bucket(true), s(10));
        arm.handle(Heard::Park(false), s(11));
        run_until(&mut arm, s(20));
        arm.handle(Heard::Bucket(false), s(21));
        assert_eq!(arm.counts().on_turtlebot, 1, "the park is free");
        let events = arm.handle(Heard::Park(true), s(28));
        assert_eq!(events, [NiryoEvent::PlacedOnTurtlebot { total: 2 }]);
        assert_eq!(
            run_until(&mut arm, s(40)).last(),
            Some(&(s(31), NiryoEvent::StorageEmpty))
        );
        assert_eq!(arm.timeout(), None);
    }

    #[test]
    fn a_conveyor_that_runs_again_is_used_again() {
        let mut arm = niryo(1);
        arm.handle(Heard::Switch(false), s(0));
        run_until(&mut arm, s(60));
        assert_eq!(
            arm.handle(Heard::Switch(true), s(61)),
            [
                NiryoEvent::ConveyorStarted,
                NiryoEvent::PlacedOnConveyor { total: 1 }
            ]
        );
    }
}
