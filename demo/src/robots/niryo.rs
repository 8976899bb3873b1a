//! The logic of Niryo Ned, without sockets and clock.
//!
//! The arm uses only the topics of the space: the switch of its conveyor, and whether park and
//! bucket are busy. All of these are states that are repeated; the last received value counts.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::pace::LinePace;

/// An input of the arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ArmInput {
    /// The switch of the conveyor is on or off.
    Switch(bool),
    /// TurtleBot3 is at the park, or is not.
    Park(bool),
    /// The bucket contains a cover, or is empty.
    Bucket(bool),
    /// No input: time has passed.
    Nothing,
}

/// The outputs of the arm for the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ArmOutputs {
    pub(crate) conveyor_running: bool,
    pub(crate) in_storage: u32,
    /// Number of covers placed on the conveyor.
    pub(crate) on_conveyor: u32,
    /// Number of covers placed on TurtleBot3.
    pub(crate) on_turtlebot: u32,
}

/// An action of the arm, for the timeline.
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

/// The reason why the arm holds a cover without placing it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum WaitCause {
    /// TurtleBot3 is not at the park.
    ParkFree,
    /// The bucket contains a cover already.
    BucketBusy,
    /// Nothing has been received from TurtleBot3 yet.
    Unknown,
}

/// The arm and its conveyor.
#[derive(Clone, Debug)]
pub(crate) struct Niryo {
    pace: LinePace,
    counts: ArmOutputs,
    arm: Arm,
    cycle: u32,
    switch: Option<bool>,
    park: Option<bool>,
    bucket: Bucket,
}

/// The state of the arm. Times are relative to the start of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Arm {
    /// Waiting for the first state of the switch of the conveyor.
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
    /// Above the place, with a cover in the gripper.
    Holding {
        told: Option<WaitCause>,
    },
    Done,
}

/// The state of the bucket, as known to the arm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Bucket {
    Unknown,
    Free,
    Busy,
    /// The arm has placed a cover. Reports that the bucket is free may be older than that.
    Filled {
        at: Duration,
    },
}

impl Niryo {
    pub(crate) const fn new(covers: u32, pace: LinePace) -> Self {
        Self {
            pace,
            counts: ArmOutputs {
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

    pub(crate) fn handle(&mut self, heard: ArmInput, now: Duration) -> Vec<NiryoEvent> {
        let mut events = Vec::new();
        match heard {
            ArmInput::Switch(on) => self.hear_switch(on, now, &mut events),
            ArmInput::Park(busy) => self.hear_park(busy),
            ArmInput::Bucket(busy) => self.hear_bucket(busy, now),
            ArmInput::Nothing => {}
        }
        while let Some(event) = self.step(now) {
            events.extend(event);
        }
        events
    }

    pub(crate) const fn counts(&self) -> ArmOutputs {
        self.counts
    }

    /// Returns the time of the next call of `handle` without an input.
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
        // The conveyor is wired to the arm and follows its switch immediately.
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
            // TurtleBot3 has left, so it has seen the cover. It will report when the bucket is
            // free.
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

    /// Runs a step of the arm. Returns `None` if the arm has to wait, and `Some(None)` for a step
    /// without an event.
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

    /// Places the cover. The destination is chosen when the arm arrives, not before.
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
        Niryo::new(covers, LinePace::at(Speed::new(1.0).unwrap()))
    }

    /// Lets time pass until `end`, calling the arm at each of its timeouts.
    fn run_until(niryo: &mut Niryo, end: Duration) -> Vec<(Duration, NiryoEvent)> {
        let mut events = Vec::new();
        while let Some(at) = niryo.timeout().filter(|at| *at <= end) {
            events.extend(
                niryo
                    .handle(ArmInput::Nothing, at)
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
        arm.handle(ArmInput::Park(true), s(1));
        arm.handle(ArmInput::Bucket(false), s(1));
        assert_eq!(arm.timeout(), None);
        assert_eq!(
            arm.handle(ArmInput::Switch(true), s(2)),
            [NiryoEvent::ConveyorStarted]
        );
        assert_eq!(arm.timeout(), Some(s(4)));
    }

    #[test]
    fn a_repeated_switch_is_no_news() {
        let mut arm = niryo(4);
        arm.handle(ArmInput::Switch(true), s(0));
        assert_eq!(arm.handle(ArmInput::Switch(true), s(1)), []);
        assert_eq!(arm.timeout(), Some(s(2)), "the first rest goes on");
    }

    #[test]
    fn with_a_running_conveyor_every_cover_goes_there() {
        let mut arm = niryo(2);
        arm.handle(ArmInput::Switch(true), s(0));
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
        arm.handle(ArmInput::Park(true), s(0));
        arm.handle(ArmInput::Bucket(false), s(0));
        arm.handle(ArmInput::Switch(true), s(0));
        run_until(&mut arm, s(25));
        assert_eq!(arm.counts().on_conveyor, 2);
        assert_eq!(
            arm.handle(ArmInput::Switch(false), s(25)),
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
        arm.handle(ArmInput::Park(false), s(0));
        arm.handle(ArmInput::Bucket(false), s(0));
        arm.handle(ArmInput::Switch(false), s(0));
        let waits = NiryoEvent::Waits {
            cause: WaitCause::ParkFree,
        };
        assert_eq!(run_until(&mut arm, s(60)).last(), Some(&(s(9), waits)));
        assert_eq!(
            arm.handle(ArmInput::Park(false), s(61)),
            [],
            "it says so once"
        );
        assert_eq!(
            arm.handle(ArmInput::Park(true), s(62)),
            [NiryoEvent::PlacedOnTurtlebot { total: 1 }]
        );
    }

    #[test]
    fn a_busy_bucket_makes_it_wait() {
        let mut arm = niryo(1);
        arm.handle(ArmInput::Park(true), s(0));
        arm.handle(ArmInput::Bucket(true), s(0));
        arm.handle(ArmInput::Switch(false), s(0));
        run_until(&mut arm, s(60));
        assert_eq!(arm.counts().on_turtlebot, 0);
        assert_eq!(
            arm.handle(ArmInput::Bucket(false), s(62)),
            [NiryoEvent::PlacedOnTurtlebot { total: 1 }]
        );
    }

    #[test]
    fn not_knowing_turtlebot3_is_no_permission() {
        let mut arm = niryo(1);
        arm.handle(ArmInput::Switch(false), s(0));
        arm.handle(ArmInput::Park(true), s(1));
        let waits = NiryoEvent::Waits {
            cause: WaitCause::Unknown,
        };
        assert_eq!(run_until(&mut arm, s(60)).last(), Some(&(s(9), waits)));
    }

    /// Returns an arm that has just placed its first of two covers on TurtleBot3, at second 9.
    fn after_the_first_on_turtlebot3() -> Niryo {
        let mut arm = niryo(2);
        arm.handle(ArmInput::Park(true), s(0));
        arm.handle(ArmInput::Bucket(false), s(0));
        arm.handle(ArmInput::Switch(false), s(0));
        run_until(&mut arm, s(9));
        assert_eq!(arm.counts().on_turtlebot, 1);
        arm
    }

    #[test]
    fn a_late_report_of_a_free_bucket_brings_no_second_cover_into_it() {
        let mut arm = after_the_first_on_turtlebot3();
        arm.handle(ArmInput::Bucket(false), s(10));
        arm.handle(ArmInput::Park(true), s(10));
        run_until(&mut arm, s(20));
        assert_eq!(arm.counts().on_turtlebot, 1);
    }

    #[test]
    fn a_missed_report_of_a_busy_bucket_does_not_stop_the_line() {
        let mut arm = after_the_first_on_turtlebot3();
        run_until(&mut arm, s(20));
        // All reports of busy and away were lost; this report is much later.
        let events = arm.handle(ArmInput::Bucket(false), s(40));
        assert_eq!(events, [NiryoEvent::PlacedOnTurtlebot { total: 2 }]);
    }

    #[test]
    fn a_bucket_that_comes_back_free_takes_the_next_cover() {
        let mut arm = after_the_first_on_turtlebot3();
        arm.handle(ArmInput::Bucket(true), s(10));
        arm.handle(ArmInput::Park(false), s(11));
        run_until(&mut arm, s(20));
        arm.handle(ArmInput::Bucket(false), s(21));
        assert_eq!(arm.counts().on_turtlebot, 1, "the park is free");
        let events = arm.handle(ArmInput::Park(true), s(28));
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
        arm.handle(ArmInput::Switch(false), s(0));
        run_until(&mut arm, s(60));
        assert_eq!(
            arm.handle(ArmInput::Switch(true), s(61)),
            [
                NiryoEvent::ConveyorStarted,
                NiryoEvent::PlacedOnConveyor { total: 1 }
            ]
        );
    }
}
