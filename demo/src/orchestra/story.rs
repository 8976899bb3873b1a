//! The state of the line, derived from the events of all processes: arrived covers, blocked steps
//! and delays of values.

use std::collections::BTreeMap;

use crate::event::{ChildEvent, LineValue, Stamped, SupervisorEvent};
use crate::line::LineValueName;
use crate::pace::Speed;
use crate::robots::niryo::{NiryoEvent, WaitCause};
use crate::robots::turtlebot::TurtlebotEvent;

/// The state of the line. Events of different processes may arrive in any order.
#[derive(Debug)]
pub(crate) struct LineStory {
    covers: u32,
    speed: Speed,
    /// Time of the first call of the switch: second 0.
    began_at: Option<i64>,
    switched_off_at: Option<i64>,
    conveyor_stopped_at: Option<i64>,
    placed_on_conveyor: BTreeMap<u32, i64>,
    placed_on_turtlebot: BTreeMap<u32, i64>,
    left_park: BTreeMap<u32, i64>,
    unloaded: u32,
    server: BTreeMap<LineValueName, Vec<(i64, LineValue)>>,
    awaited: Vec<LineValueName>,
    awaits_switch: bool,
    /// Nanoseconds from each call of the switch to its response.
    switch_answered: Vec<i64>,
    connected: bool,
    arm: &'static str,
    turtlebot: &'static str,
}

impl LineStory {
    pub(crate) const fn new(covers: u32, speed: Speed) -> Self {
        Self {
            covers,
            speed,
            began_at: None,
            switched_off_at: None,
            conveyor_stopped_at: None,
            placed_on_conveyor: BTreeMap::new(),
            placed_on_turtlebot: BTreeMap::new(),
            left_park: BTreeMap::new(),
            unloaded: 0,
            server: BTreeMap::new(),
            awaited: Vec::new(),
            awaits_switch: false,
            switch_answered: Vec::new(),
            connected: false,
            arm: "has not been told whether its conveyor is to run",
            turtlebot: "stands at the park",
        }
    }

    pub(crate) fn observe(&mut self, stamped: &Stamped) {
        let at = stamped.at_ns;
        match &stamped.event {
            ChildEvent::Master(_) | ChildEvent::Node(_) | ChildEvent::Machine(_) => {}
            ChildEvent::Niryo(event) => self.observe_niryo(*event, at),
            ChildEvent::Turtlebot(event) => self.observe_turtlebot(*event, at),
            ChildEvent::Supervisor(SupervisorEvent::Connected) => self.connected = true,
            ChildEvent::Supervisor(SupervisorEvent::Awaits { names }) => {
                self.awaited.clone_from(names)
            }
            ChildEvent::Supervisor(SupervisorEvent::AwaitsSwitch) => self.awaits_switch = true,
            ChildEvent::Supervisor(SupervisorEvent::Switched {
                on,
                answered_after_ns,
            }) => {
                self.began_at.get_or_insert(at);
                self.switch_answered.push(*answered_after_ns);
                if !on {
                    self.switched_off_at.get_or_insert(at);
                }
            }
            ChildEvent::Supervisor(SupervisorEvent::Saw { name, value }) => {
                self.awaited.retain(|awaited| awaited != name);
                self.server.entry(*name).or_default().push((at, *value));
            }
        }
    }

    fn observe_niryo(&mut self, event: NiryoEvent, at: i64) {
        self.arm = match event {
            NiryoEvent::ConveyorStarted => "is at work",
            NiryoEvent::ConveyorStopped { .. } => {
                self.conveyor_stopped_at.get_or_insert(at);
                "is at work"
            }
            NiryoEvent::Picked { .. } => "holds a cover",
            NiryoEvent::PlacedOnConveyor { total } => {
                self.placed_on_conveyor.insert(total, at);
                "has placed a cover on the conveyor"
            }
            NiryoEvent::PlacedOnTurtlebot { total } => {
                self.placed_on_turtlebot.insert(total, at);
                "has placed a cover on TurtleBot3"
            }
            NiryoEvent::Waits { cause } => waits(cause),
            NiryoEvent::StorageEmpty => "has placed all covers",
        };
    }

    fn observe_turtlebot(&mut self, event: TurtlebotEvent, at: i64) {
        self.turtlebot = match event {
            TurtlebotEvent::CoverInBucket { .. } => "has a cover in its bucket",
            TurtlebotEvent::LeavesPark { placed } => {
                self.left_park.insert(placed, at);
                "is on its way to the worker"
            }
            TurtlebotEvent::Unloaded { total } => {
                self.unloaded = self.unloaded.max(total);
                "is on its way back to the park"
            }
            TurtlebotEvent::BackAtPark => "stands at the park",
        };
    }

    pub(crate) const fn began(&self) -> bool {
        self.began_at.is_some()
    }

    /// Converts a time to seconds of the scenario, after it has started.
    pub(crate) fn seconds(&self, at_ns: i64) -> Option<f64> {
        Some(self.speed.story_seconds(at_ns - self.began_at?))
    }

    pub(crate) const fn covers(&self) -> u32 {
        self.covers
    }

    pub(crate) fn by_conveyor(&self) -> u32 {
        last(&self.placed_on_conveyor)
    }

    pub(crate) const fn by_turtlebot(&self) -> u32 {
        self.unloaded
    }

    pub(crate) fn delivered(&self) -> u32 {
        self.by_conveyor() + self.by_turtlebot()
    }

    pub(crate) fn finished(&self) -> bool {
        self.delivered() == self.covers
    }

    /// Returns whether all covers have arrived and the server has the final counts.
    pub(crate) fn settled(&self) -> bool {
        let at_server = |name, count| {
            let last = self.server.get(&name).and_then(|values| values.last());
            last.is_some_and(|(_, value)| *value == LineValue::Number(count))
        };
        self.finished()
            && at_server(LineValueName::CoversOnConveyor, self.by_conveyor())
            && at_server(
                LineValueName::CoversOnTurtleBot3,
                last(&self.placed_on_turtlebot),
            )
    }

    /// Returns the time at which the supervisor switched the conveyor off, in seconds of the
    /// scenario.
    pub(crate) fn conveyor_off_at(&self) -> Option<f64> {
        self.seconds(self.switched_off_at?)
    }

    /// Returns the nanoseconds from the stop of the conveyor at Niryo Ned to the corresponding
    /// value at the server.
    pub(crate) fn server_saw_off_after(&self) -> Option<i64> {
        let stopped = self.conveyor_stopped_at?;
        let values = self.server.get(&LineValueName::ConveyorRunning)?;
        let off =
            |(at, value): &&(i64, LineValue)| *value == LineValue::Boolean(false) && *at >= stopped;
        values.iter().find(off).map(|(at, _)| at - stopped)
    }

    /// Returns the nanoseconds from each call of the switch to its response.
    pub(crate) fn switch_answered_after(&self) -> &[i64] {
        &self.switch_answered
    }

    /// Returns the nanoseconds from each placed cover to the count at the server.
    pub(crate) fn place_to_counter(&self) -> Vec<i64> {
        [
            (&self.placed_on_conveyor, LineValueName::CoversOnConveyor),
            (&self.placed_on_turtlebot, LineValueName::CoversOnTurtleBot3),
        ]
        .into_iter()
        .flat_map(|(placed, name)| {
            let seen = self
                .server
                .get(&name)
                .map(Vec::as_slice)
                .unwrap_or_default();
            placed.iter().filter_map(move |(count, placed_at)| {
                let value = LineValue::Number(*count);
                seen.iter()
                    .find(|(_, seen)| *seen == value)
                    .map(|(at, _)| at - placed_at)
            })
        })
        .collect()
    }

    /// Returns the nanoseconds from each cover placed on TurtleBot3 to its departure.
    pub(crate) fn place_to_move(&self) -> Vec<i64> {
        let left = |(count, placed): (&u32, &i64)| Some(self.left_park.get(count)? - placed);
        self.placed_on_turtlebot.iter().filter_map(left).collect()
    }

    /// Describes the current state, to explain why the line does not continue.
    pub(crate) fn standing(&self) -> String {
        if !self.connected {
            return "no OPC UA session with the server".to_owned();
        }
        if !self.began() && self.awaits_switch {
            return "the server has no Method Conveyor.Switch (a service of Niryo Ned)".to_owned();
        }
        if !self.began() {
            let missing: Vec<String> = self
                .awaited
                .iter()
                .map(|name| format!("{name} (from {})", name.producer()))
                .collect();
            return format!("the server has no value of {}", missing.join(", "));
        }
        format!(
            "{} of {} covers have arrived; Niryo Ned {}; TurtleBot3 {}",
            self.delivered(),
            self.covers,
            self.arm,
            self.turtlebot
        )
    }
}

const fn waits(cause: WaitCause) -> &'static str {
    match cause {
        WaitCause::ParkFree => "holds a cover and waits: TurtleBot3 is not at the park",
        WaitCause::BucketBusy => "holds a cover and waits: the bucket is busy",
        WaitCause::Unknown => "holds a cover and waits: it has not heard of TurtleBot3",
    }
}

fn last(counts: &BTreeMap<u32, i64>) -> u32 {
    counts.last_key_value().map_or(0, |(count, _)| *count)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(events: &[(i64, ChildEvent)]) -> LineStory {
        let mut story = LineStory::new(2, Speed::new(1.0).unwrap());
        for (at_ns, event) in events {
            story.observe(&Stamped {
                at_ns: *at_ns,
                event: event.clone(),
            });
        }
        story
    }

    fn saw(name: LineValueName, value: LineValue) -> ChildEvent {
        SupervisorEvent::Saw { name, value }.into()
    }

    fn switched(on: bool) -> ChildEvent {
        let answered_after_ns = 7;
        SupervisorEvent::Switched {
            on,
            answered_after_ns,
        }
        .into()
    }

    #[test]
    fn a_cover_on_turtlebot3_has_not_arrived_before_it_is_unloaded() {
        let mut events = vec![
            (1, NiryoEvent::PlacedOnConveyor { total: 1 }.into()),
            (2, NiryoEvent::PlacedOnTurtlebot { total: 1 }.into()),
        ];
        assert_eq!(told(&events).delivered(), 1);
        events.push((3, TurtlebotEvent::Unloaded { total: 1 }.into()));
        let story = told(&events);
        assert!(story.finished() && !story.settled());
        events.push((
            4,
            saw(LineValueName::CoversOnConveyor, LineValue::Number(1)),
        ));
        events.push((
            5,
            saw(LineValueName::CoversOnTurtleBot3, LineValue::Number(1)),
        ));
        assert!(told(&events).settled());
    }

    #[test]
    fn delays_do_not_depend_on_the_order_in_which_events_are_read() {
        let mut events = vec![
            (100, NiryoEvent::PlacedOnConveyor { total: 1 }.into()),
            (
                130,
                saw(LineValueName::CoversOnConveyor, LineValue::Number(1)),
            ),
            (200, NiryoEvent::PlacedOnTurtlebot { total: 1 }.into()),
            (
                270,
                saw(LineValueName::CoversOnTurtleBot3, LineValue::Number(1)),
            ),
            (900, TurtlebotEvent::LeavesPark { placed: 1 }.into()),
        ];
        for _ in 0..2 {
            let story = told(&events);
            assert_eq!(story.place_to_counter(), [30, 70]);
            assert_eq!(story.place_to_move(), [700]);
            events.reverse();
        }
    }

    #[test]
    fn the_conveyor_standing_still_at_first_is_not_the_stop() {
        let story = told(&[
            (
                10,
                saw(LineValueName::ConveyorRunning, LineValue::Boolean(false)),
            ),
            (20, switched(true)),
            (
                30,
                saw(LineValueName::ConveyorRunning, LineValue::Boolean(true)),
            ),
            (25_000_000_020, switched(false)),
            (
                25_000_000_100,
                NiryoEvent::ConveyorStopped {
                    holding_cover: true,
                }
                .into(),
            ),
            (
                25_000_000_400,
                saw(LineValueName::ConveyorRunning, LineValue::Boolean(false)),
            ),
        ]);
        assert_eq!(story.server_saw_off_after(), Some(300));
        assert_eq!(story.conveyor_off_at(), Some(25.0));
        assert_eq!(story.switch_answered_after(), [7, 7]);
    }

    #[test]
    fn who_is_waited_for_is_named() {
        let awaits = SupervisorEvent::Awaits {
            names: vec![LineValueName::ParkBusy, LineValueName::BucketBusy],
        };
        let story = told(&[
            (1, SupervisorEvent::Connected.into()),
            (2, awaits.into()),
            (3, saw(LineValueName::BucketBusy, LineValue::Boolean(false))),
        ]);
        assert_eq!(
            story.standing(),
            "the server has no value of ParkBusy (from TurtleBot3)"
        );
        let story = told(&[
            (1, SupervisorEvent::Connected.into()),
            (2, SupervisorEvent::AwaitsSwitch.into()),
        ]);
        assert_eq!(
            story.standing(),
            "the server has no Method Conveyor.Switch (a service of Niryo Ned)"
        );
    }
}
