use skills::conformance;

use super::simulator::{RobotiqSettings, RobotiqSimulator};
use super::*;
use crate::modbus::server::{LineFaults, ServedDevice};

struct Bench {
    simulator: RobotiqSimulator,
    serving: ServedDevice,
    faults: LineFaults,
}

async fn bench(line: &str, object: Option<f64>) -> Bench {
    let simulator = RobotiqSimulator::new(RobotiqSettings {
        object,
        time_scale: 10.0,
    });
    let faults = LineFaults::default();
    let registers = Arc::new(simulator.clone());
    let serving = ServedDevice::start(&line.parse().unwrap(), UNIT, registers, faults.clone())
        .await
        .unwrap();
    Bench {
        simulator,
        serving,
        faults,
    }
}

impl Bench {
    fn driver(&self, of: &str) -> Arc<dyn Driver> {
        let gripper = RobotiqGripper::new(self.serving.line().clone(), UNIT);
        gripper
            .driver(&[ParameterType::own(of)], &PeerAccess::default())
            .unwrap()
    }

    async fn run(&self, of: &str) -> (bool, String) {
        let driver = self.driver(of);
        let outcome = conformance::run_once(of, driver, Vec::new()).await.unwrap();
        (outcome.succeeded, outcome.message)
    }
}

const LINES: [&str; 3] = [
    "tcp://127.0.0.1:0",
    "rtu+tcp://127.0.0.1:0",
    "serial:/dev/ptmx",
];

#[tokio::test]
async fn its_drivers_are_as_drivers_should_be_over_every_line() {
    for line in LINES {
        for (of, from) in [("GraspSkillType", 0), ("ReleaseSkillType", 255)] {
            let bench = bench(line, Some(0.03)).await;
            let fingers = bench.simulator.clone();
            let parameters = || {
                fingers.put(from);
                Vec::new()
            };
            conformance::check(of, bench.driver(of), parameters)
                .await
                .unwrap_or_else(|why| panic!("{of} over {line}: {why}"));
        }
    }
}

#[tokio::test]
async fn it_says_whether_something_is_between_its_fingers_and_where_they_stopped() {
    let full = bench(LINES[0], Some(0.0425)).await;
    assert_eq!(full.run("GraspSkillType").await, (true, String::new()));
    // Half of the stroke.
    assert_eq!(full.simulator.position(), 128);
    assert!(full.run("ReleaseSkillType").await.0);
    assert_eq!(full.simulator.position(), 0);
    let empty = bench(LINES[0], None).await;
    let nothing = "nothing is between the fingers".to_owned();
    assert_eq!(empty.run("GraspSkillType").await, (false, nothing));
}

#[tokio::test]
async fn its_fingers_go_to_a_width_and_stop_at_what_is_between_them() {
    let bench = bench(LINES[0], Some(0.04)).await;
    let of = "MoveGripperSkillType";
    let to = |width: f64| vec![("Width".to_owned(), width.into())];
    let run = async |width| {
        let outcome = conformance::run_once(of, bench.driver(of), to(width)).await?;
        let gripped = outcome.results.iter().find(|(name, _)| name == "Gripped");
        let width = outcome.results.iter().find(|(name, _)| name == "Width");
        let (width, gripped) = (
            width.unwrap().1.as_f64().unwrap(),
            gripped.unwrap().1.as_bool(),
        );
        Ok::<_, conformance::ConformanceError>(((width * 1000.0).round(), gripped.unwrap()))
    };
    assert_eq!(run(0.06).await, Ok((60.0, false)));
    assert_eq!(run(0.02).await, Ok((40.0, true)));
    let refused = run(0.1).await.unwrap_err();
    assert_eq!(
        refused.to_string(),
        "BadInvalidArgument: Width is 0.1 m, and the fingers open 0.085 m"
    );
    let mut widths = [0.06, 0.08];
    let parameters = || {
        widths.rotate_left(1);
        to(widths[0])
    };
    conformance::check(of, bench.driver(of), parameters)
        .await
        .unwrap();
}

#[tokio::test]
async fn silence_damaged_frames_and_a_reboot_are_told_and_do_not_last() {
    for line in LINES {
        let bench = bench(line, Some(0.03)).await;
        bench.faults.set_silent(true);
        let began = Instant::now();
        let (succeeded, why) = bench.run("GraspSkillType").await;
        assert!(
            !succeeded && why.starts_with("no answer from unit 9 at "),
            "{line}: {why}"
        );
        assert!(began.elapsed() < Duration::from_secs(1), "{line}");
        bench.faults.set_silent(false);

        bench.faults.damage(1);
        let (succeeded, why) = bench.run("GraspSkillType").await;
        assert!(!succeeded, "{line}: {why}");
        // An RTU receiver waits for a frame with a valid checksum.
        assert!(
            why.contains("is damaged: ") || why.starts_with("no answer"),
            "{line}: {why}"
        );
        assert!(bench.run("GraspSkillType").await.0, "{line}");

        bench.simulator.put(0);
        bench.run("ReleaseSkillType").await;
        let driver = bench.driver("GraspSkillType");
        let running = conformance::run_once("GraspSkillType", driver, Vec::new());
        let rebooted = async {
            let until = Instant::now() + Duration::from_secs(5);
            while bench.simulator.position() < 20 {
                assert!(Instant::now() < until, "{line}: the fingers do not move");
                sleep(Duration::from_millis(2)).await;
            }
            bench.simulator.reboot();
        };
        let (outcome, ()) = tokio::join!(running, rebooted);
        let outcome = outcome.unwrap();
        assert!(
            outcome.message.contains("lost its activation"),
            "{line}: {}",
            outcome.message
        );
        assert!(bench.run("GraspSkillType").await.0, "{line}");
    }
}

#[tokio::test]
async fn a_gripper_that_is_not_there_or_refuses_is_told_by_its_line() {
    let bench = bench(LINES[0], None).await;
    let line = bench.serving.line().clone();
    drop(bench);
    let driver = RobotiqGripper::new(line.clone(), UNIT).driver(
        &[ParameterType::own("GraspSkillType")],
        &PeerAccess::default(),
    );
    let outcome = conformance::run_once("GraspSkillType", driver.unwrap(), Vec::new())
        .await
        .unwrap();
    let expected = format!("{line} cannot be reached: ");
    assert!(
        outcome.message.starts_with(&expected),
        "{}",
        outcome.message
    );
}

#[test]
fn the_force_is_told_in_the_unit_of_the_gripper() {
    let of = skills::model::find("GraspSkillType").unwrap().parameters();
    let given = |newton: f64| {
        let given = vec![("Force".to_owned(), newton.into())];
        force(&Parameters::complete(&of, given).unwrap())
    };
    assert_eq!(
        [0.0, 20.0, 127.5, 235.0, 9000.0].map(given),
        [0, 0, 128, 255, 255]
    );
}

#[tokio::test]
async fn its_values_follow_the_fingers_beside_its_skills() {
    let bench = bench(LINES[0], Some(0.04)).await;
    let gripper: Arc<dyn Device> =
        Arc::new(RobotiqGripper::new(bench.serving.line().clone(), UNIT));
    let values = crate::sensors::tests::measured(gripper);
    values
        .until("Active", |value| *value == Ok(false.into()))
        .await;
    assert_eq!(bench.run("GraspSkillType").await, (true, String::new()));
    values
        .until("Active", |value| *value == Ok(true.into()))
        .await;
    values
        .until("ObjectDetected", |value| *value == Ok(true.into()))
        .await;
    values
        .until("Width", |value| {
            let width = value.as_ref().ok().and_then(SkillValue::as_f64);
            width.is_some_and(|width| (width - 0.04).abs() < 0.001)
        })
        .await;
    bench.faults.set_silent(true);
    values.until("Width", Result::is_err).await;
}
