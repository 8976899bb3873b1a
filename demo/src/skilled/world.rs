//! The world of the line: the location of each cover. It is derived from the actions of the
//! machines, not from requests to them, so it proves whether the line has done its work.

use std::time::Duration;

use super::fact::MachineEvent;

/// Pose of the covers in the storage, in m and rad in the frame of the arm.
pub(super) const STORAGE: [f64; 6] = [0.25, 0.2, 0.1, 0.0, 0.0, 0.0];
/// Pose of the start of the conveyor.
pub(super) const BELT: [f64; 6] = [0.25, -0.2, 0.1, 0.0, 0.0, 0.0];
/// Pose of the bucket of the mobile robot at the park.
pub(super) const BUCKET: [f64; 6] = [-0.25, 0.0, 0.15, 0.0, 0.0, 0.0];
/// Pose of the mobile robot during loading: x and y in m and the heading, in the frame of the map.
pub(super) const PARK: [f64; 3] = [0.0, 0.0, 0.0];
/// Pose of the mobile robot at the worker.
pub(super) const WORKER: [f64; 3] = [2.0, 1.0, 0.0];

/// The locations of the covers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct CoverLocations {
    in_storage: u32,
    is_held: bool,
    belt_runs: bool,
    /// Nanoseconds that the belt takes to move a cover from its start to its end.
    transport: i64,
    /// Time at which each cover was placed on the belt, shifted by the time for which the belt
    /// stood still.
    on_belt: Vec<i64>,
    base_at_park: bool,
    in_bucket: u32,
    by_conveyor: u32,
    by_turtlebot: u32,
    taken_back: u32,
    /// Covers on the floor, released at a location without a support.
    fallen: u32,
}

impl CoverLocations {
    /// Creates a world with all covers in the storage, the conveyor stopped and the mobile robot at
    /// the park. `transport` is the time that the conveyor takes.
    pub(super) fn new(covers: u32, transport: Duration) -> Self {
        Self {
            in_storage: covers,
            is_held: false,
            belt_runs: false,
            transport: i64::try_from(transport.as_nanos()).unwrap_or(i64::MAX),
            on_belt: Vec::new(),
            base_at_park: true,
            in_bucket: 0,
            by_conveyor: 0,
            by_turtlebot: 0,
            taken_back: 0,
            fallen: 0,
        }
    }

    /// Processes an action of a machine at a time in nanoseconds since 1970.
    pub(super) fn see(&mut self, event: MachineEvent, at_ns: i64) {
        self.pass(at_ns);
        match event {
            MachineEvent::Grasps { at } => self.grasp(at),
            MachineEvent::Releases { at } => self.release(at, at_ns),
            MachineEvent::Belt { runs } => self.belt_runs = runs,
            MachineEvent::Leaves => self.base_at_park = false,
            MachineEvent::Arrives { at } => {
                let [x, y, _] = PARK;
                self.base_at_park = near(&at, &[x, y]);
                let [x, y, _] = WORKER;
                if near(&at, &[x, y]) {
                    self.by_turtlebot += std::mem::take(&mut self.in_bucket);
                }
            }
        }
    }

    /// Lets time pass: covers at the end of a running conveyor arrive.
    pub(super) fn pass(&mut self, now_ns: i64) {
        if self.belt_runs {
            let transport = self.transport;
            let before = self.on_belt.len();
            self.on_belt.retain(|placed| now_ns - placed < transport);
            let arrived = before - self.on_belt.len();
            self.by_conveyor += u32::try_from(arrived).unwrap_or(u32::MAX);
        }
    }

    fn grasp(&mut self, at: [f64; 3]) {
        if self.is_held {
            return;
        }
        if is_at(at, STORAGE) && self.in_storage > 0 {
            self.in_storage -= 1;
            self.is_held = true;
        } else if is_at(at, BELT) && !self.belt_runs && self.on_belt.pop().is_some() {
            self.taken_back += 1;
            self.is_held = true;
        }
    }

    fn release(&mut self, at: [f64; 3], at_ns: i64) {
        if !std::mem::take(&mut self.is_held) {
            return;
        }
        if is_at(at, BELT) {
            self.on_belt.push(at_ns);
        } else if is_at(at, BUCKET) && self.base_at_park {
            self.in_bucket += 1;
        } else {
            self.fallen += 1;
        }
    }

    /// Returns whether the arm has a cover in its gripper.
    pub(super) const fn is_held(&self) -> bool {
        self.is_held
    }

    pub(super) const fn by_conveyor(&self) -> u32 {
        self.by_conveyor
    }

    pub(super) const fn by_turtlebot(&self) -> u32 {
        self.by_turtlebot
    }

    /// Returns the number of covers that were taken from a stopped conveyor.
    pub(super) const fn taken_back(&self) -> u32 {
        self.taken_back
    }

    pub(super) const fn delivered(&self) -> u32 {
        self.by_conveyor + self.by_turtlebot
    }

    /// Returns the number of covers in the storage.
    pub(super) const fn in_storage(&self) -> u32 {
        self.in_storage
    }

    /// Describes the locations of the covers that have not arrived, for people.
    pub(super) fn standing(&self) -> String {
        format!(
            "{} of the covers have arrived by conveyor and {} by TurtleBot3; {} are in the storage, {} in the gripper, {} on the \
             conveyor, {} in the bucket, {} on the floor",
            self.by_conveyor,
            self.by_turtlebot,
            self.in_storage,
            u32::from(self.is_held),
            self.on_belt.len(),
            self.in_bucket,
            self.fallen
        )
    }
}

fn is_at([x, y, z]: [f64; 3], [to_x, to_y, to_z, ..]: [f64; 6]) -> bool {
    near(&[x, y, z], &[to_x, to_y, to_z])
}

fn near(at: &[f64], to: &[f64]) -> bool {
    at.iter().zip(to).all(|(a, b)| (a - b).abs() < 0.01)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;

    fn at([x, y, z, ..]: [f64; 6]) -> [f64; 3] {
        [x, y, z]
    }

    fn world(events: &[(i64, MachineEvent)]) -> CoverLocations {
        let mut world = CoverLocations::new(2, Duration::from_secs(3));
        for (seconds, event) in events {
            world.see(*event, seconds * SECOND);
        }
        world
    }

    #[test]
    fn a_cover_on_a_running_conveyor_arrives_when_it_has_come_to_the_end() {
        let mut world = world(&[
            (0, MachineEvent::Belt { runs: true }),
            (1, MachineEvent::Grasps { at: at(STORAGE) }),
            (2, MachineEvent::Releases { at: at(BELT) }),
        ]);
        world.pass(4 * SECOND);
        assert_eq!(world.delivered(), 0);
        world.pass(5 * SECOND);
        assert_eq!((world.by_conveyor(), world.in_storage()), (1, 1));
    }

    #[test]
    fn a_cover_on_a_dead_conveyor_stays_there_and_can_be_taken_back() {
        let mut world = world(&[
            (0, MachineEvent::Belt { runs: true }),
            (1, MachineEvent::Grasps { at: at(STORAGE) }),
            (2, MachineEvent::Belt { runs: false }),
            (3, MachineEvent::Releases { at: at(BELT) }),
        ]);
        world.pass(100 * SECOND);
        assert_eq!(world.delivered(), 0);
        world.see(MachineEvent::Grasps { at: at(BELT) }, 101 * SECOND);
        world.see(MachineEvent::Releases { at: at(BUCKET) }, 102 * SECOND);
        world.see(MachineEvent::Leaves, 103 * SECOND);
        assert_eq!((world.taken_back(), world.delivered()), (1, 0));
        let [x, y, _] = WORKER;
        world.see(MachineEvent::Arrives { at: [x, y] }, 104 * SECOND);
        assert_eq!((world.by_turtlebot(), world.by_conveyor()), (1, 0));
    }

    #[test]
    fn what_is_released_over_an_empty_park_or_elsewhere_falls() {
        let world = world(&[
            (0, MachineEvent::Grasps { at: at(STORAGE) }),
            (1, MachineEvent::Leaves),
            (2, MachineEvent::Releases { at: at(BUCKET) }),
            (3, MachineEvent::Grasps { at: at(STORAGE) }),
            (4, MachineEvent::Releases { at: [0.0; 3] }),
        ]);
        assert_eq!(world.delivered(), 0);
        assert!(
            world.standing().ends_with("2 on the floor"),
            "{}",
            world.standing()
        );
    }

    #[test]
    fn a_gripper_that_closes_where_nothing_is_holds_nothing() {
        let world = world(&[
            (0, MachineEvent::Grasps { at: [0.0; 3] }),
            (1, MachineEvent::Releases { at: at(BELT) }),
        ]);
        assert!(!world.is_held());
        assert_eq!(world, CoverLocations::new(2, Duration::from_secs(3)));
    }
}
