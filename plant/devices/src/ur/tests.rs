use skills::{RunOutcome, conformance};

use super::simulator::{ServedRobot, UrSimulator};
use super::*;

struct Bench {
    simulator: UrSimulator,
    serving: ServedRobot,
}

async fn bench() -> Bench {
    bench_at(20.0, None).await
}

async fn bench_at(time_scale: f64, surface: Option<f64>) -> Bench {
    let settings = simulator::UrSimulatorSettings {
        time_scale,
        surface,
        ..simulator::UrSimulatorSettings::default()
    };
    let simulator = UrSimulator::new(settings);
    let serving = ServedRobot::start(&simulator, "127.0.0.1:0", "127.0.0.1:0")
        .await
        .unwrap();
    Bench { simulator, serving }
}

fn to(target: [f64; 6]) -> Vec<(String, skills::SkillValue)> {
    vec![("TargetPosition".to_owned(), target.into())]
}

fn turned(target: [f64; 6]) -> Vec<(String, skills::SkillValue)> {
    vec![("TargetJointPosition".to_owned(), target.into())]
}

impl Bench {
    fn settings(&self) -> UrSettings {
        UrSettings {
            rtde: self.serving.rtde().to_string(),
            secondary: self.serving.secondary().to_string(),
            reach: REACH,
        }
    }

    fn driver(&self, of: &str) -> Arc<dyn Driver> {
        UrRobot::new(self.settings())
            .driver(&[ParameterType::own(of)], &PeerAccess::default())
            .unwrap()
    }

    async fn run(&self, of: &str, target: [f64; 6]) -> RunOutcome {
        conformance::run_once(of, self.driver(of), to(target))
            .await
            .unwrap()
    }
}

#[tokio::test]
async fn its_drivers_are_as_drivers_should_be() {
    for of in [
        "PtpMoveSkillType",
        "LinearMoveSkillType",
        "ForceMoveSkillType",
        "JointPtpMoveSkillType",
    ] {
        let bench = bench().await;
        let mut corners = [[-0.4, 0.3, 0.2], [0.4, 0.3, -0.2], [0.1, -0.5, 0.4]];
        let around = || {
            corners.rotate_left(1);
            let [x, y, z] = corners[0];
            if of == "JointPtpMoveSkillType" {
                return turned([x * 5.0, y * 5.0, z * 5.0, 0.0, x, 0.0]);
            }
            let mut parameters = to([x, y, z, 0.0, x, 0.0]);
            if of == "ForceMoveSkillType" {
                parameters.push(("MaxForce".to_owned(), vec![0.0, 0.0, 30.0].into()));
            }
            parameters
        };
        conformance::check(of, bench.driver(of), around)
            .await
            .unwrap_or_else(|why| panic!("{of}: {why}"));
    }
}

#[tokio::test]
async fn its_tool_arrives_where_it_was_told_to_be() {
    let bench = bench().await;
    let target = [0.2, 0.3, 0.1, 0.0, 0.5, 1.0];
    let outcome = bench.run("LinearMoveSkillType", target).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    let (_, position) = &outcome.results[0];
    let position = position.as_f64s().unwrap();
    assert!(
        position
            .iter()
            .zip(target)
            .all(|(is, wanted)| (is - wanted).abs() < 1e-5),
        "{position:?}"
    );
}

#[tokio::test]
async fn its_joints_arrive_and_turn_by_a_full_turn_at_most() {
    let bench = bench().await;
    let driver = || bench.driver("JointPtpMoveSkillType");
    let target = [0.5, -1.5, 1.0, 0.0, 6.25, -0.25];
    let of = "JointPtpMoveSkillType";
    let outcome = conformance::run_once(of, driver(), turned(target))
        .await
        .unwrap();
    assert!(outcome.succeeded, "{}", outcome.message);
    let (name, joints) = &outcome.results[0];
    assert_eq!(name, "JointPosition");
    let joints = joints.as_f64s().unwrap();
    let mut pairs = joints.iter().zip(target);
    assert!(
        pairs.all(|(is, wanted)| (is - wanted).abs() < 1e-5),
        "{joints:?}"
    );
    let far = turned([0.0, 0.0, 0.0, 0.0, 0.0, 6.3]);
    let refused = conformance::run_once(of, driver(), far).await.unwrap_err();
    assert!(refused.to_string().contains("6.3 rad"), "{refused}");
}

#[tokio::test]
async fn silence_a_protective_stop_and_a_reboot_are_told_and_do_not_last() {
    let bench = bench().await;
    let (near, far) = (
        [0.4, 0.1, 0.4, 0.0, 0.0, 0.0],
        [-0.4, -0.3, 0.3, 0.0, 0.0, 0.0],
    );
    bench.simulator.set_silent(true);
    let told = bench.run("LinearMoveSkillType", near).await.message;
    assert!(told.contains(" is silent for 1s"), "{told}");
    bench.simulator.set_silent(false);
    assert!(bench.run("LinearMoveSkillType", near).await.succeeded);

    let between = |change: fn(&UrSimulator)| {
        let simulator = bench.simulator.clone();
        let running = bench.run("LinearMoveSkillType", far);
        async move {
            let changed = async {
                while simulator.pose()[0] > 0.3 {
                    sleep(Duration::from_millis(2)).await;
                }
                change(&simulator);
            };
            tokio::join!(running, changed).0.message
        }
    };
    let told = between(|robot| robot.set_protective_stop(true)).await;
    assert_eq!(told, PAUSED);
    let told = bench.run("LinearMoveSkillType", near).await.message;
    assert_eq!(told, "the robot does not move: it is in a protective stop");
    bench.simulator.set_protective_stop(false);
    assert!(bench.run("LinearMoveSkillType", near).await.succeeded);
    let told = between(UrSimulator::reboot).await;
    assert!(told.contains(" is lost: "), "{told}");
    assert!(bench.run("LinearMoveSkillType", near).await.succeeded);
    let told = between(|robot| robot.set_silent(true)).await;
    assert!(
        told.ends_with(" is silent for 1s; the outcome is unknown, the stop program is sent"),
        "{told}"
    );
    bench.simulator.set_silent(false);
    assert!(bench.run("LinearMoveSkillType", near).await.succeeded);
}

/// The outcome of a run that a protective stop has paused.
const PAUSED: &str = "the robot does not move: it is in a protective stop, and its program may go on when it is \
     released; the outcome is unknown, the stop program is sent";

#[tokio::test]
async fn a_program_that_a_protective_stop_pauses_is_unknown_because_it_may_go_on() {
    // The way takes about 0.8 s, so that a busy machine stops the robot before its end.
    let bench = bench_at(4.0, None).await;
    let far = [-0.4, -0.3, 0.3, 0.0, 0.0, 0.0];
    let pausing = async {
        let until = Instant::now() + Duration::from_secs(10);
        while bench.simulator.pose()[0] > 0.3 && Instant::now() < until {
            sleep(Duration::from_millis(2)).await;
        }
        bench.simulator.set_protective_stop(true);
    };
    let (outcome, ()) = tokio::join!(bench.run("LinearMoveSkillType", far), pausing);
    assert_eq!(outcome.message, PAUSED);
    assert!(!outcome.succeeded);
    let there = bench.simulator.pose();
    assert!(there[0] > far[0], "it is on its way: {there:?}");
    // The operator releases the robot: it goes on, as the outcome says.
    bench.simulator.set_protective_stop(false);
    bench.simulator.play();
    let until = Instant::now() + Duration::from_secs(10);
    while bench.simulator.pose() != far && Instant::now() < until {
        sleep(Duration::from_millis(2)).await;
    }
    assert_eq!(bench.simulator.pose(), far);
}

#[tokio::test]
async fn a_program_of_somebody_else_is_told_and_not_taken_for_ours() {
    let bench = bench().await;
    let far = [-0.4, -0.3, 0.3, 0.0, 0.0, 0.0];
    let secondary = bench.serving.secondary();
    let simulator = bench.simulator.clone();
    let intruder = async move {
        while simulator.pose()[0] > 0.3 {
            sleep(Duration::from_millis(2)).await;
        }
        let mut stream = TcpStream::connect(secondary).await.unwrap();
        stream
            .write_all(b"def other():\n  sleep(0.01)\nend\n")
            .await
            .unwrap();
        // Open until the run has ended.
        stream
    };
    let (outcome, _open) = tokio::join!(bench.run("LinearMoveSkillType", far), intruder);
    assert!(
        outcome.message.contains("another one took its place"),
        "{}",
        outcome.message
    );
}

#[tokio::test]
async fn what_it_cannot_reach_is_refused_before_anything_is_sent() {
    let bench = bench().await;
    let of = "PtpMoveSkillType";
    let refused =
        conformance::run_once(of, bench.driver(of), to([0.9, 0.0, 0.0, 0.0, 0.0, 0.0])).await;
    let expected =
        "BadInvalidArgument: TargetPosition is 0.900 m from the base, and the robot reaches 0.85 m";
    assert_eq!(refused.unwrap_err().to_string(), expected);
}

#[tokio::test]
async fn its_values_follow_the_robot_and_come_back_after_a_silence() {
    let bench = bench().await;
    let robot: Arc<dyn Device> = Arc::new(UrRobot::new(bench.settings()));
    let values = crate::sensors::tests::measured(robot);
    let at = |x: f64| {
        move |value: &Result<skills::SkillValue, skills::UnknownValue>| {
            let pose = value.as_ref().ok().and_then(skills::SkillValue::as_f64s);
            pose.is_some_and(|pose| pose.first().is_some_and(|found| (found - x).abs() < 1e-4))
        }
    };
    values.until("TcpPose", at(0.4)).await;
    let outcome = bench
        .run("LinearMoveSkillType", [0.2, 0.3, 0.1, 0.0, 0.5, 1.0])
        .await;
    assert!(outcome.succeeded, "{}", outcome.message);
    values.until("TcpPose", at(0.2)).await;
    values
        .until("SafetyMode", |value| *value == Ok(1.into()))
        .await;
    bench.simulator.set_protective_stop(true);
    values
        .until("SafetyMode", |value| *value == Ok(3.into()))
        .await;
    bench.simulator.set_silent(true);
    values.until("SafetyMode", Result::is_err).await;
    bench.simulator.set_silent(false);
    values
        .until("SafetyMode", |value| *value == Ok(3.into()))
        .await;
}

#[tokio::test]
async fn the_load_is_measured_and_unknown_at_a_controller_without_it() {
    let bench = bench().await;
    let is = |expected: Vec<f64>| {
        move |value: &Result<skills::SkillValue, skills::UnknownValue>| {
            let found = value.as_ref().ok().and_then(skills::SkillValue::as_f64s);
            found.as_ref() == Some(&expected)
        }
    };
    let values = crate::sensors::tests::measured(Arc::new(UrRobot::new(bench.settings())));
    values
        .until("LoadMass", |value| *value == Ok(0.0.into()))
        .await;
    let mut secondary = connected(&bench.settings().secondary).await.unwrap();
    let program = b"set_payload(1.5, [0, 0.01, 0.05])\n";
    secondary.write_all(program).await.unwrap();
    values
        .until("LoadMass", |value| *value == Ok(1.5.into()))
        .await;
    values.until("LoadCenter", is(vec![0.0, 0.01, 0.05])).await;
    values.until("JointSpeeds", is(vec![0.0; 6])).await;
    let temperatures = vec![28.0, 29.5, 29.0, 31.0, 31.5, 32.0];
    values.until("JointTemperatures", is(temperatures)).await;
    let currents = vec![0.0, -2.5, -1.5, -0.25, 0.125, 0.0];
    values.until("JointCurrents", is(currents)).await;

    let settings = simulator::UrSimulatorSettings {
        lacks: &["payload", "payload_cog", "actual_current"],
        ..simulator::UrSimulatorSettings::default()
    };
    let simulator = UrSimulator::new(settings);
    let serving = ServedRobot::start(&simulator, "127.0.0.1:0", "127.0.0.1:0").await;
    let old = Bench {
        simulator,
        serving: serving.unwrap(),
    };
    let values = crate::sensors::tests::measured(Arc::new(UrRobot::new(old.settings())));
    let lacks = |output: &str| {
        let expected = Err(format!("the robot has no output {output}"));
        move |value: &Result<skills::SkillValue, skills::UnknownValue>| {
            value.as_ref().map_err(ToString::to_string).map(drop) == expected
        }
    };
    values.until("LoadMass", lacks("payload")).await;
    values.until("JointCurrents", lacks("actual_current")).await;
    // The other values are measured.
    values
        .until("SafetyMode", |value| *value == Ok(1.into()))
        .await;
}

#[tokio::test]
async fn a_force_move_ends_at_a_contact_and_says_the_force() {
    let bench = bench_at(1.0, Some(0.45)).await;
    let run = async |z: f64| {
        let mut parameters = to([0.4, 0.0, z, 0.0, 0.0, 0.0]);
        parameters.push(("MaxForce".to_owned(), vec![0.0, 0.0, 20.0].into()));
        parameters.push(("MaxVelocity".to_owned(), 0.05.into()));
        let driver = bench.driver("ForceMoveSkillType");
        conformance::run_once("ForceMoveSkillType", driver, parameters)
            .await
            .unwrap()
    };
    let result = |outcome: &RunOutcome, name: &str| {
        let found = outcome.results.iter().find(|(known, _)| known == name);
        found.unwrap().1.clone()
    };
    let free = run(0.47).await;
    assert!(free.succeeded, "{}", free.message);
    assert_eq!(result(&free, "ForceExceeded"), false.into());
    let contact = run(0.3).await;
    assert!(contact.succeeded, "{}", contact.message);
    assert_eq!(result(&contact, "ForceExceeded"), true.into());
    let force = result(&contact, "Force").as_f64s().unwrap();
    assert!(force[2] > 20.0, "{force:?}");
    let position = result(&contact, "Position").as_f64s().unwrap();
    assert!((0.3..0.446).contains(&position[2]), "{position:?}");
    let [_, _, z, ..] = bench.simulator.pose();
    assert!(z > 0.31, "it stands at {z}");
}

/// Receives the programs for a robot, and forwards them when it is told to.
async fn late(robot: std::net::SocketAddr) -> (String, tokio::sync::oneshot::Sender<()>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (forward, told) = tokio::sync::oneshot::channel();
    tokio::spawn(async move {
        let (mut from, _) = listener.accept().await.unwrap();
        told.await.unwrap();
        let mut to = TcpStream::connect(robot).await.unwrap();
        let (mut reads, _writes) = from.split();
        tokio::io::copy(&mut reads, &mut to).await.unwrap();
        // Open while the robot reads the programs.
        std::future::pending::<()>().await;
    });
    (address, forward)
}

#[tokio::test]
async fn a_program_that_is_taken_too_late_is_unknown_and_does_not_move_the_robot() {
    let bench = bench_at(1.0, None).await;
    let (secondary, forward) = late(bench.serving.secondary()).await;
    let settings = UrSettings {
        secondary,
        ..bench.settings()
    };
    let driver = UrRobot::new(settings)
        .driver(
            &[ParameterType::own("LinearMoveSkillType")],
            &PeerAccess::default(),
        )
        .unwrap();
    let target = to([-0.4, 0.1, 0.4, 0.0, 0.0, 0.0]);
    let outcome = conformance::run_once("LinearMoveSkillType", driver, target)
        .await
        .unwrap();
    let why = "is it in remote control?; the outcome is unknown, the stop program is sent";
    assert!(outcome.message.ends_with(why), "{}", outcome.message);
    assert!(outcome.unknown, "{outcome:?}");
    let before = bench.simulator.pose();
    let started = bench.simulator.register(24);
    forward.send(()).unwrap();
    let limit = Instant::now() + Duration::from_secs(5);
    while bench.simulator.register(24) == started {
        assert!(Instant::now() < limit, "the robot takes no program");
        sleep(Duration::from_millis(5)).await;
    }
    // A move would take two seconds. The stop program ends it, however busy the machine is.
    let way = |to: [f64; 6]| -> f64 {
        let parts = before.iter().zip(to).take(3);
        parts.map(|(a, b)| (a - b).abs()).sum()
    };
    let mut pose = bench.simulator.pose();
    loop {
        sleep(Duration::from_millis(200)).await;
        let later = bench.simulator.pose();
        let mut moved = later.iter().zip(pose).map(|(a, b)| (a - b).abs());
        if moved.all(|moved| moved < 1e-9) {
            break;
        }
        assert!(Instant::now() < limit, "the robot moves on");
        pose = later;
    }
    let whole = way([-0.4, 0.1, 0.4, 0.0, 0.0, 0.0]);
    assert!(way(pose) < whole / 2.0, "{pose:?} on the way of {whole} m");
}

/// A run that brakes a robot of which another client has the speed slider.
struct Brakes {
    settings: Arc<UrSettings>,
    robot: UrSimulator,
    silent: bool,
}

#[async_trait]
impl Driver for Brakes {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        let motion = Motion {
            settings: Arc::clone(&self.settings),
            kind: Kind::Linear,
        };
        let _other = Session::open(&self.settings, HERTZ).await?;
        let mut session = Session::open(&self.settings, HERTZ).await?;
        self.robot.set_silent(self.silent);
        session.brake((&motion, &work), Some(1.0)).await?;
        Ok(Vec::new())
    }
}

#[tokio::test]
async fn a_robot_that_is_lost_while_it_brakes_is_unknown() {
    for (silent, is_there, why) in [
        (
            true,
            true,
            "is not seen to stop within 700ms; the outcome is unknown, the stop program is sent",
        ),
        (
            false,
            true,
            "tells it that already; the outcome is unknown, the stop program is sent",
        ),
        (
            false,
            false,
            "; the outcome is unknown, the stop program is not sent",
        ),
    ] {
        let bench = bench().await;
        let mut settings = bench.settings();
        if !is_there {
            settings.secondary = "127.0.0.1:1".to_owned();
        }
        let driver = Arc::new(Brakes {
            settings: Arc::new(settings),
            robot: bench.simulator.clone(),
            silent,
        });
        let target = to([0.4, 0.1, 0.4, 0.0, 0.0, 0.0]);
        let outcome = conformance::run_once("LinearMoveSkillType", driver, target)
            .await
            .unwrap();
        assert!(outcome.message.ends_with(why), "{}", outcome.message);
        let told = outcome.trace.iter().any(|line| line.ends_with(why));
        assert!(told, "{:?}", outcome.trace);
    }
}
