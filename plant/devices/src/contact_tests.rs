//! The contact point of grippers of different lengths, with the simulators of the devices.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use async_trait::async_trait;
use skills::frame::Frame;
use skills::{
    Authority, Device, Driver, GripPoint, GripType, Job, LocalRun, ParameterType, PartShape,
    PeerAccess, PickAndPlace, RunOutcome, RunnableSkill, Skill, SkillDescription, SkillFault,
    SkillOwner, SkillValue, model,
};

use crate::modbus::server::{LineFaults, ServedDevice};
use crate::{robotiq, schmalz, ur};

/// A grasp or release skill that records where the flange is when it runs.
struct Recording {
    inner: LocalRun,
    grip: Option<GripPoint>,
    robot: ur::simulator::UrSimulator,
    flanges: Arc<Mutex<Vec<[f64; 6]>>>,
}

#[async_trait]
impl RunnableSkill for Recording {
    fn name(&self) -> String {
        self.inner.name()
    }

    fn grip_point(&self) -> Option<GripPoint> {
        self.grip
    }

    async fn run(
        &self,
        parameters: Vec<(String, SkillValue)>,
        within: Duration,
    ) -> Result<RunOutcome, SkillFault> {
        let flange = ur::of_robot(self.robot.pose());
        self.flanges.lock().unwrap().push(flange);
        self.inner.run(parameters, within).await
    }

    async fn halt(&self) -> Result<(), SkillFault> {
        self.inner.halt().await
    }
}

fn run_of(name: &str, device: &dyn Device, authority: &Authority) -> LocalRun {
    let of = model::find(name).unwrap();
    let driver: Arc<dyn Driver> = device
        .driver(&[ParameterType::own(name)], &PeerAccess::default())
        .unwrap();
    let facts = SkillDescription {
        name: name.to_owned(),
        types: vec![ParameterType::own(name)],
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: None,
        rests_in: of.rests_in,
    };
    LocalRun {
        skill: Skill::spawn(facts, driver, authority.clone(), Vec::new()),
        by: SkillOwner::Local("the test"),
    }
}

const PART: PartShape = PartShape::Box([0.04, 0.06, 0.05]);
const PICK: [f64; 6] = [0.4, 0.2, 0.1, 0.0, 0.0, 0.3];
const PLACES: [(&str, [f64; 6]); 2] = [
    ("upright", [0.35, -0.25, 0.12, 0.0, 0.0, 1.2]),
    ("tilted", [0.35, -0.25, 0.2, 0.35, -0.25, 0.6]),
];
/// The changer of the manufacturer.
const CHANGER: [f64; 3] = [0.0, 0.0, 0.047];
/// The required accuracy, m.
const ACCURACY: f64 = 1e-4;

/// A gripper to test, and its geometry.
struct Gripper {
    name: &'static str,
    /// The distance from the plate to the contact point, m.
    length: f64,
    grip_type: GripType,
    /// The height of the contact point above the origin of the part, m.
    above: f64,
    device: Box<dyn Device>,
}

impl Gripper {
    /// Returns the distance between the contact point and where it should be on the part, m.
    fn error(&self, plate: Frame, flange: [f64; 6], part: [f64; 6]) -> f64 {
        // The geometry of the machine, not the grip point that the composite reads.
        let tip = plate.then(&Frame::at([0.0, 0.0, self.length]));
        let contact = Frame::of_pose(flange).then(&tip);
        let expected = Frame::of_pose(part).then(&Frame::at([0.0, 0.0, self.above]));
        contact.distance(&expected)
    }
}

/// The simulated robot and its device.
struct Arm {
    simulator: ur::simulator::UrSimulator,
    device: ur::UrRobot,
}

impl Arm {
    /// Picks and places the part. Returns where the flange was at the grasp and at the release.
    async fn pick_and_place(
        &self,
        gripper: &Gripper,
        plate: Frame,
        place: [f64; 6],
    ) -> Vec<[f64; 6]> {
        let (of_arm, of_gripper) = (Authority::new(), Authority::new());
        let flanges = Arc::new(Mutex::new(Vec::new()));
        let recording = |of: &str| {
            Arc::new(Recording {
                inner: run_of(of, gripper.device.as_ref(), &of_gripper),
                grip: Some(GripPoint {
                    offset: [0.0, 0.0, gripper.length, 0.0, 0.0, 0.0],
                    grip_type: Some(gripper.grip_type),
                    opening: Some((0.0, 0.085)),
                }),
                robot: self.simulator.clone(),
                flanges: Arc::clone(&flanges),
            })
        };
        let composite = PickAndPlace {
            ptp: Arc::new(run_of("PtpMoveSkillType", &self.device, &of_arm)),
            linear: Arc::new(run_of("LinearMoveSkillType", &self.device, &of_arm)),
            grasp: recording("GraspSkillType"),
            release: recording("ReleaseSkillType"),
            plate,
            within: Duration::from_secs(60),
        };
        let job = Job {
            pick: PICK,
            place,
            approach: 0.05,
            shape: Some(PART),
        };
        let teller = |_step: &'static str| {};
        composite.run(&job, &teller).await.unwrap();
        let flanges = flanges.lock().unwrap().clone();
        assert_eq!(flanges.len(), 2);
        flanges
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn grippers_of_two_lengths_touch_the_part_at_the_same_point() {
    let settings = ur::simulator::UrSimulatorSettings {
        time_scale: 50.0,
        ..ur::simulator::UrSimulatorSettings::default()
    };
    let robot = ur::simulator::UrSimulator::new(settings);
    let served = ur::simulator::ServedRobot::start(&robot, "127.0.0.1:0", "127.0.0.1:0")
        .await
        .unwrap();
    let arm = Arm {
        simulator: robot,
        device: ur::UrRobot::new(ur::UrSettings {
            rtde: served.rtde().to_string(),
            secondary: served.secondary().to_string(),
            reach: ur::REACH,
        }),
    };
    let fingers = robotiq::simulator::RobotiqSimulator::new(robotiq::simulator::RobotiqSettings {
        object: Some(0.04),
        time_scale: 20.0,
    });
    let line = "tcp://127.0.0.1:0".parse().unwrap();
    let faults = LineFaults::default();
    let modbus = ServedDevice::start(&line, robotiq::UNIT, Arc::new(fingers), faults)
        .await
        .unwrap();
    let cup = schmalz::simulator::SchmalzSimulator::new(schmalz::simulator::SchmalzSettings {
        time_scale: 20.0,
        ..schmalz::simulator::SchmalzSettings::default()
    });
    let master = schmalz::simulator::ServedMaster::start(&cup, "127.0.0.1:0")
        .await
        .unwrap();
    let address = master.address().to_string();
    let timing = schmalz::SchmalzTiming::default();
    let grippers = [
        Gripper {
            name: "Robotiq 2F-85",
            length: 0.2028,
            grip_type: GripType::Parallel,
            above: 0.0,
            device: Box::new(robotiq::RobotiqGripper::new(
                modbus.line().clone(),
                robotiq::UNIT,
            )),
        },
        Gripper {
            name: "Schmalz ECBPi",
            length: 0.1868,
            grip_type: GripType::Vacuum,
            above: 0.025,
            device: Box::new(schmalz::SchmalzGripper::new(
                &address,
                "master1port1",
                timing,
            )),
        },
    ];
    println!("| gripper | length | plate | place | error at pick | error at place |");
    for gripper in &grippers {
        let Gripper { name, length, .. } = gripper;
        for (plate_name, plate) in [
            ("flange", Frame::IDENTITY),
            ("tool changer", Frame::at(CHANGER)),
        ] {
            for (place_name, place) in PLACES {
                let flanges = arm.pick_and_place(gripper, plate, place).await;
                let errors: Vec<f64> = flanges
                    .iter()
                    .zip([PICK, place])
                    .map(|(flange, part)| gripper.error(plate, *flange, part))
                    .collect();
                println!(
                    "| {name} | {length} m | {plate_name} | {place_name} | {:.4} mm | {:.4} mm |",
                    errors[0] * 1e3,
                    errors[1] * 1e3
                );
                assert!(errors.iter().all(|error| *error < ACCURACY), "{errors:?}");
            }
        }
    }
}
