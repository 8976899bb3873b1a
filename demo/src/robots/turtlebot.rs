//! The logic of TurtleBot3, without sockets and clock.
//!
//! Its only input from the line is the number of covers placed on it. That number replaces a sensor
//! in its bucket. It is a state, not an edge, so late or repeated messages do no harm.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::pace::LinePace;

/// The outputs of TurtleBot3 for the line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TurtlebotOutputs {
    /// Whether it is at the park.
    pub(crate) park_busy: bool,
    /// Whether there is a cover in its bucket.
    pub(crate) bucket_busy: bool,
}

/// An action of TurtleBot3, for the timeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "turtlebot", rename_all = "snake_case")]
pub(crate) enum TurtlebotEvent {
    /// `placed` is the received number of covers.
    CoverInBucket {
        placed: u32,
    },
    LeavesPark {
        placed: u32,
    },
    /// `total` covers have been delivered.
    Unloaded {
        total: u32,
    },
    BackAtPark,
}

/// The state of the robot between park and worker.
#[derive(Clone, Debug)]
pub(crate) struct Turtlebot {
    pace: LinePace,
    placed: u32,
    delivered: u32,
    place: TurtlebotActivity,
}

/// The location and the activity. Times are relative to the start of the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TurtlebotActivity {
    Park,
    Loading { until: Duration },
    ToWorker { until: Duration, placed: u32 },
    AtWorker { until: Duration, placed: u32 },
    ToPark { until: Duration },
}

impl Turtlebot {
    /// Creates a robot at the park with an empty bucket.
    pub(crate) const fn new(pace: LinePace) -> Self {
        Self {
            pace,
            placed: 0,
            delivered: 0,
            place: TurtlebotActivity::Park,
        }
    }

    /// Processes the number of covers placed on it; `None` if only time has passed.
    pub(crate) fn handle(&mut self, placed: Option<u32>, now: Duration) -> Vec<TurtlebotEvent> {
        if let Some(placed) = placed {
            self.placed = placed;
        }
        let mut events = Vec::new();
        while let Some(event) = self.step(now) {
            events.push(event);
        }
        events
    }

    pub(crate) const fn status(&self) -> TurtlebotOutputs {
        TurtlebotOutputs {
            park_busy: matches!(
                self.place,
                TurtlebotActivity::Park | TurtlebotActivity::Loading { .. }
            ),
            bucket_busy: self.placed > self.delivered,
        }
    }

    /// Returns the time of the next call of `handle` without an input.
    pub(crate) const fn timeout(&self) -> Option<Duration> {
        match self.place {
            TurtlebotActivity::Park => None,
            TurtlebotActivity::Loading { until }
            | TurtlebotActivity::ToWorker { until, .. }
            | TurtlebotActivity::AtWorker { until, .. }
            | TurtlebotActivity::ToPark { until } => Some(until),
        }
    }

    fn step(&mut self, now: Duration) -> Option<TurtlebotEvent> {
        if self.timeout().is_some_and(|until| now < until) {
            return None;
        }
        let (place, event) = match self.place {
            TurtlebotActivity::Park if self.status().bucket_busy => (
                TurtlebotActivity::Loading {
                    until: now + self.pace.load,
                },
                TurtlebotEvent::CoverInBucket {
                    placed: self.placed,
                },
            ),
            TurtlebotActivity::Park => return None,
            TurtlebotActivity::Loading { .. } => (
                TurtlebotActivity::ToWorker {
                    until: now + self.pace.drive,
                    placed: self.placed,
                },
                TurtlebotEvent::LeavesPark {
                    placed: self.placed,
                },
            ),
            TurtlebotActivity::ToWorker { placed, .. } => {
                self.place = TurtlebotActivity::AtWorker {
                    until: now + self.pace.unload,
                    placed,
                };
                return self.step(now);
            }
            TurtlebotActivity::AtWorker { placed, .. } => {
                self.delivered = placed;
                (
                    TurtlebotActivity::ToPark {
                        until: now + self.pace.drive,
                    },
                    TurtlebotEvent::Unloaded { total: placed },
                )
            }
            TurtlebotActivity::ToPark { .. } => {
                (TurtlebotActivity::Park, TurtlebotEvent::BackAtPark)
            }
        };
        self.place = place;
        Some(event)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pace::Speed;

    const fn s(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    fn turtlebot() -> Turtlebot {
        Turtlebot::new(LinePace::at(Speed::new(1.0).unwrap()))
    }

    fn run_until(robot: &mut Turtlebot, end: Duration) -> Vec<(Duration, TurtlebotEvent)> {
        let mut events = Vec::new();
        while let Some(at) = robot.timeout().filter(|at| *at <= end) {
            events.extend(robot.handle(None, at).into_iter().map(|event| (at, event)));
        }
        events
    }

    #[test]
    fn it_waits_at_the_park_with_an_empty_bucket() {
        let mut robot = turtlebot();
        assert_eq!(robot.handle(Some(0), s(1)), []);
        assert_eq!(
            robot.status(),
            TurtlebotOutputs {
                park_busy: true,
                bucket_busy: false
            }
        );
        assert_eq!(robot.timeout(), None);
    }

    #[test]
    fn a_cover_in_the_bucket_is_driven_to_the_worker_and_the_robot_comes_back() {
        let mut robot = turtlebot();
        assert_eq!(
            robot.handle(Some(1), s(10)),
            [TurtlebotEvent::CoverInBucket { placed: 1 }]
        );
        assert_eq!(
            robot.status(),
            TurtlebotOutputs {
                park_busy: true,
                bucket_busy: true
            }
        );
        assert_eq!(
            run_until(&mut robot, s(12)),
            [(s(12), TurtlebotEvent::LeavesPark { placed: 1 })]
        );
        assert_eq!(
            robot.status(),
            TurtlebotOutputs {
                park_busy: false,
                bucket_busy: true
            }
        );
        assert_eq!(
            run_until(&mut robot, s(22)),
            [(s(22), TurtlebotEvent::Unloaded { total: 1 })]
        );
        assert_eq!(
            robot.status(),
            TurtlebotOutputs {
                park_busy: false,
                bucket_busy: false
            }
        );
        assert_eq!(
            run_until(&mut robot, s(60)),
            [(s(29), TurtlebotEvent::BackAtPark)]
        );
        assert_eq!(
            robot.status(),
            TurtlebotOutputs {
                park_busy: true,
                bucket_busy: false
            }
        );
    }

    #[test]
    fn a_repeated_count_is_no_second_cover() {
        let mut robot = turtlebot();
        robot.handle(Some(1), s(0));
        for second in 1..60 {
            run_until(&mut robot, s(second));
            robot.handle(Some(1), s(second));
        }
        assert_eq!(
            robot.status(),
            TurtlebotOutputs {
                park_busy: true,
                bucket_busy: false
            }
        );
        assert_eq!(robot.timeout(), None);
    }

    #[test]
    fn a_count_that_rises_on_the_way_is_the_next_trip() {
        let mut robot = turtlebot();
        robot.handle(Some(1), s(0));
        run_until(&mut robot, s(5));
        robot.handle(Some(2), s(5));
        let events: Vec<_> = run_until(&mut robot, s(60))
            .into_iter()
            .map(|(_, e)| e)
            .collect();
        assert_eq!(
            events,
            [
                TurtlebotEvent::Unloaded { total: 1 },
                TurtlebotEvent::BackAtPark,
                TurtlebotEvent::CoverInBucket { placed: 2 },
                TurtlebotEvent::LeavesPark { placed: 2 },
                TurtlebotEvent::Unloaded { total: 2 },
                TurtlebotEvent::BackAtPark,
            ]
        );
    }

    #[test]
    fn counts_missed_while_nothing_was_heard_are_delivered_together() {
        let mut robot = turtlebot();
        robot.handle(Some(2), s(0));
        let events: Vec<_> = run_until(&mut robot, s(60))
            .into_iter()
            .map(|(_, e)| e)
            .collect();
        assert!(
            events.contains(&TurtlebotEvent::Unloaded { total: 2 }),
            "{events:?}"
        );
        assert!(!robot.status().bucket_busy);
    }
}
