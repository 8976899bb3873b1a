use std::path::Path;

use skills::server::{ComponentServer, PowerOff, ServeSettings};
use skills::{
    Authority, ClientOptions, Component, LocalRun, Skill, SkillDescription, SkillOwner,
    conformance, model,
};

use super::simulator::{Docked, Following, KelvinSimulator};
use super::*;
use crate::modbus::server::{LineFaults, ServedDevice};
use crate::ur;

const DOCKS: [[f64; 6]; 2] = [
    [0.3, 0.3, 0.2, 0.0, 0.0, 0.0],
    [-0.3, 0.3, 0.2, 0.0, 0.0, 0.5],
];
/// A dock without a tool.
const EMPTY: [f64; 6] = [0.0, 0.4, 0.2, 0.0, 0.0, 0.0];
const URIS: [&str; 2] = ["urn:test:parallel", "urn:test:vacuum"];

struct Bench {
    changer: KelvinChanger,
    simulator: KelvinSimulator,
    robot: ur::simulator::UrSimulator,
    _served: (ServedDevice, ur::simulator::ServedRobot, Following),
}

fn skill(name: &str, driver: Arc<dyn Driver>, authority: &Authority) -> Arc<dyn RunnableSkill> {
    let of = model::find(name).unwrap();
    let facts = SkillDescription {
        name: name.to_owned(),
        types: vec![ParameterType::own(name)],
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: None,
        rests_in: of.rests_in,
    };
    let skill = Skill::spawn(facts, driver, authority.clone(), Vec::new());
    Arc::new(LocalRun {
        skill,
        by: SkillOwner::Local("changer"),
    })
}

async fn bench() -> Bench {
    bench_at(50.0).await
}

async fn bench_at(time_scale: f64) -> Bench {
    let settings = ur::simulator::UrSimulatorSettings {
        time_scale,
        ..ur::simulator::UrSimulatorSettings::default()
    };
    let robot = ur::simulator::UrSimulator::new(settings);
    let robot_served = ur::simulator::ServedRobot::start(&robot, "127.0.0.1:0", "127.0.0.1:0")
        .await
        .unwrap();
    let device = ur::UrRobot::new(ur::UrSettings {
        rtde: robot_served.rtde().to_string(),
        secondary: robot_served.secondary().to_string(),
        reach: ur::REACH,
    });
    let authority = Authority::new();
    let moves = |of: &str| {
        skill(
            of,
            device
                .driver(&[ParameterType::own(of)], &PeerAccess::default())
                .unwrap(),
            &authority,
        )
    };
    let mover = Mover::Skills {
        ptp: moves("PtpMoveSkillType"),
        linear: moves("LinearMoveSkillType"),
    };
    let docked = (1..)
        .zip(DOCKS)
        .map(|(number, dock)| Docked { number, dock })
        .chain([Docked {
            number: 0,
            dock: EMPTY,
        }])
        .collect();
    let simulator = KelvinSimulator::new(docked);
    let following = simulator.follow(&robot_served.rtde().to_string());
    let registers = Arc::new(simulator.clone());
    let line = "tcp://127.0.0.1:0".parse().unwrap();
    let serving = ServedDevice::start(&line, 1, registers, LineFaults::default())
        .await
        .unwrap();
    let converter = Converter {
        at: serving.line().clone(),
        unit: 1,
        register: 0,
        divider: DIVIDER,
    };
    let tools = (1..)
        .zip(DOCKS)
        .zip(URIS)
        .map(|((number, dock), uri)| Tool {
            number,
            uri: uri.to_owned(),
            dock,
        });
    let settings = KelvinSettings {
        converter,
        tools: tools.collect(),
        plate: PLATE,
        ready_within: READY_WITHIN,
        within: Duration::from_secs(20),
    };
    Bench {
        changer: KelvinChanger::new(settings, mover),
        simulator,
        robot,
        _served: (serving, robot_served, following),
    }
}

fn given(uri: &str) -> Vec<(String, SkillValue)> {
    let dock = URIS
        .iter()
        .position(|known| *known == uri)
        .map_or([0.0; 6], |at| DOCKS[at]);
    vec![
        ("ToolAppUri".to_owned(), uri.into()),
        ("ToolPosition".to_owned(), dock.into()),
    ]
}

impl Bench {
    async fn run(
        &self,
        of: &str,
        uri: Option<&str>,
    ) -> Result<(bool, String), conformance::ConformanceError> {
        let driver = self
            .changer
            .driver(&[ParameterType::own(of)], &PeerAccess::default())
            .unwrap();
        let given = uri.map(given).unwrap_or_default();
        let outcome = conformance::run_once(of, driver, given).await?;
        Ok((outcome.succeeded, outcome.message))
    }
}

#[tokio::test]
async fn tools_are_taken_changed_and_put_back() {
    let bench = bench().await;
    let done = Ok((true, String::new()));
    assert_eq!(bench.run("AttachToolSkillType", Some(URIS[0])).await, done);
    assert_eq!(bench.simulator.reading(), ChangerReading::Tool(1));
    // A tool that is already attached causes no motion.
    let at = bench.robot.pose();
    assert_eq!(bench.run("ChangeToolSkillType", Some(URIS[0])).await, done);
    assert_eq!(bench.robot.pose(), at);
    let told = "nothing is moved: tool 1 has to be detached first".to_owned();
    assert_eq!(
        bench.run("AttachToolSkillType", Some(URIS[1])).await,
        Ok((false, told))
    );
    assert_eq!(bench.run("ChangeToolSkillType", Some(URIS[1])).await, done);
    assert_eq!(bench.simulator.reading(), ChangerReading::Tool(2));
    assert_eq!(bench.run("DetachToolSkillType", None).await, done);
    assert_eq!(bench.simulator.reading(), ChangerReading::NoTool);
    let unknown = bench
        .run("ChangeToolSkillType", Some("urn:test:hammer"))
        .await
        .unwrap_err();
    assert_eq!(
        unknown.to_string(),
        "BadInvalidArgument: ToolAppUri is one of urn:test:parallel, urn:test:vacuum"
    );
}

#[tokio::test]
async fn its_drivers_are_as_drivers_should_be() {
    let bench = bench().await;
    let driver = bench
        .changer
        .driver(
            &[ParameterType::own("ChangeToolSkillType")],
            &PeerAccess::default(),
        )
        .unwrap();
    let mut uris = URIS;
    let parameters = || {
        uris.rotate_left(1);
        // A run that was stopped on the way leaves the ring in an unknown position.
        bench.robot.reset([0.0, 0.3, 0.5, 0.0, 0.0, 0.0]);
        given(uris[0])
    };
    conformance::check("ChangeToolSkillType", driver, parameters)
        .await
        .unwrap();
}

#[tokio::test]
async fn a_cut_wire_and_a_robot_that_does_not_move_are_told_with_what_is_at_the_changer() {
    let bench = bench().await;
    bench.simulator.set_cut(true);
    let (succeeded, told) = bench.run("DetachToolSkillType", None).await.unwrap();
    assert!(
        !succeeded && told.ends_with(" V is no voltage of the tool changer"),
        "{told}"
    );
    bench.simulator.set_cut(false);
    bench.robot.set_protective_stop(true);
    let told = bench
        .run("AttachToolSkillType", Some(URIS[0]))
        .await
        .unwrap()
        .1;
    let expected = "BackDoor: PtpMoveSkillType failed: the robot does not move: it is in a protective stop; no tool is attached";
    assert_eq!(told, expected);
}

#[tokio::test]
async fn a_ring_that_is_half_way_is_left_to_people() {
    let bench = bench().await;
    let [x, y, z, a, b, c] = DOCKS[0];
    bench.robot.reset(ur::to_robot([x, y, z, a, b, c - 0.5]));
    let until = Instant::now() + Duration::from_secs(5);
    while bench.simulator.reading() != ChangerReading::Intermediate {
        assert!(Instant::now() < until);
        sleep(Duration::from_millis(10)).await;
    }
    let told = bench.run("DetachToolSkillType", None).await.unwrap();
    let expected =
        "nothing is moved: its ring is between open and locked, and somebody has to look at it";
    assert_eq!(told, (false, expected.to_owned()));
}

#[tokio::test]
async fn a_robot_that_is_lost_while_the_ring_turns_leaves_the_outcome_unknown() {
    let bench = bench_at(10.0).await;
    let (converter, robot, following) = bench._served;
    let attach = async || {
        let types = [ParameterType::own("AttachToolSkillType")];
        let driver = bench.changer.driver(&types, &PeerAccess::default());
        let given = given(URIS[0]);
        let ran = conformance::run_once("AttachToolSkillType", driver.unwrap(), given);
        ran.await.unwrap()
    };
    let lose = async {
        let until = Instant::now() + Duration::from_secs(20);
        while bench.simulator.reading() != ChangerReading::Intermediate {
            assert!(Instant::now() < until);
            sleep(Duration::from_millis(2)).await;
        }
        drop((robot, following));
    };
    let (outcome, ()) = tokio::join!(attach(), lose);
    let told = &outcome.message;
    assert!(!outcome.succeeded && outcome.unknown, "{told}");
    assert!(told.contains("Lock: "), "{told}");
    let between = "its ring is between open and locked";
    assert!(told.ends_with(between), "{told}");
    assert_eq!(bench.changer.shown.borrow().current, None);
    // Another run moves nothing, and a person has to look at the changer.
    let again = attach().await;
    let expected = format!("nothing is moved: {between}, and somebody has to look at it");
    assert_eq!((again.unknown, again.message), (false, expected));
    drop(converter);
}

#[tokio::test]
async fn a_tool_is_taken_and_put_where_the_tool_position_says_and_then_where_it_was_put() {
    let mut bench = bench().await;
    let mut settings = (*bench.changer.settings).clone();
    // The YAML has another dock than the cell.
    settings.tools[0].dock = [0.1, 0.5, 0.3, 0.0, 0.0, 0.0];
    bench.changer = KelvinChanger::new(settings, bench.changer.mover.clone());
    let run = async |of: &str, given: Vec<(String, SkillValue)>| {
        let types = [ParameterType::own(of)];
        let driver = bench.changer.driver(&types, &PeerAccess::default());
        conformance::run_once(of, driver.unwrap(), given)
            .await
            .unwrap()
    };
    let at = |dock: [f64; 6]| ("ToolPosition".to_owned(), SkillValue::from(dock));
    let tool = || ("ToolAppUri".to_owned(), SkillValue::from(URIS[0]));
    let outcome = run("AttachToolSkillType", vec![tool(), at(DOCKS[0])]).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(bench.simulator.reading(), ChangerReading::Tool(1));
    let shown = bench.changer.shown.borrow().clone();
    assert_eq!(shown.current.as_deref(), Some(URIS[0]));

    let far = run(
        "DetachToolSkillType",
        vec![at([2.0, 0.0, 0.2, 0.0, 0.0, 0.0])],
    )
    .await;
    assert!(
        !far.succeeded && far.message.contains("the robot reaches 0.85 m"),
        "{}",
        far.message
    );
    assert_eq!(bench.simulator.reading(), ChangerReading::Tool(1));
    let outcome = run("DetachToolSkillType", vec![at(EMPTY)]).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(bench.simulator.reading(), ChangerReading::NoTool);
    let outcome = run("AttachToolSkillType", vec![tool()]).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(bench.simulator.reading(), ChangerReading::Tool(1));
}

#[tokio::test]
async fn a_tilted_tool_position_is_refused_before_anything_moves() {
    let bench = bench().await;
    let at = bench.robot.pose();
    let down = std::f64::consts::PI;
    for (angles, is_dock) in [([down, 0.0, 1.0], true), ([0.3, 0.0, 0.0], false)] {
        let [a, b, c] = angles;
        let pose = [2.0, 0.0, 0.2, a, b, c];
        let given = vec![("ToolPosition".to_owned(), SkillValue::from(pose))];
        let types = [ParameterType::own("DetachToolSkillType")];
        let driver = bench.changer.driver(&types, &PeerAccess::default());
        let ran = conformance::run_once("DetachToolSkillType", driver.unwrap(), given).await;
        let refused = ran.err().map(|why| why.to_string());
        let is_tilted = refused.is_some_and(|why| why.contains("the axis of the flange"));
        assert_eq!(is_tilted, !is_dock);
    }
    assert_eq!(bench.robot.pose(), at);
}

#[tokio::test]
async fn another_tool_than_the_wanted_one_is_named_and_stays_attached() {
    let mut bench = bench().await;
    let mut settings = (*bench.changer.settings).clone();
    // The tools in the docks were exchanged.
    settings.tools[0].dock = DOCKS[1];
    bench.changer = KelvinChanger::new(settings, bench.changer.mover.clone());
    let given = vec![("ToolAppUri".to_owned(), SkillValue::from(URIS[0]))];
    let types = [ParameterType::own("AttachToolSkillType")];
    let driver = bench.changer.driver(&types, &PeerAccess::default());
    let ran = conformance::run_once("AttachToolSkillType", driver.unwrap(), given).await;
    let outcome = ran.unwrap();
    let expected = "the tool changer has tool 2 in the place of tool 1; tool 2 is attached";
    assert_eq!(
        (outcome.succeeded, outcome.message.as_str()),
        (false, expected)
    );
    let shown = bench.changer.shown.borrow().current.clone();
    assert_eq!(shown.as_deref(), Some(URIS[1]));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_locked_tool_is_awaited_and_switched_off_before_it_is_put_back() {
    let mut bench = bench().await;
    let settings = KelvinSettings {
        ready_within: Duration::from_millis(300),
        ..(*bench.changer.settings).clone()
    };
    bench.changer = KelvinChanger::new(settings, bench.changer.mover.clone());
    let options = ClientOptions {
        within: Duration::from_secs(10),
        ..ClientOptions::default()
    };
    let peers = PeerAccess {
        detector: Some(skills::Detector::new(options.clone())),
        options,
    };
    let run = async |changer: &KelvinChanger, of: &str, given: Vec<(String, SkillValue)>| {
        let driver = changer.driver(&[ParameterType::own(of)], &peers);
        conformance::run_once(of, driver.unwrap(), given)
            .await
            .unwrap()
    };
    let late = run(&bench.changer, "AttachToolSkillType", given(URIS[0])).await;
    let expected = "is locked, and its component urn:test:parallel is not ready within 300ms";
    assert!(
        !late.succeeded && late.message.contains(expected),
        "{}",
        late.message
    );

    let text = format!(
        "component: fingers\napplication_uri: {}\nnamespace: 9\nskills:\n  - {{name: Grasp, type: GraspSkillType, driver: simulated}}\n",
        URIS[0]
    );
    let component = Component::from_yaml(&text, Path::new("")).unwrap();
    let readings = Arc::new(Mutex::new(Vec::new()));
    let (seen, simulator) = (Arc::clone(&readings), bench.simulator.clone());
    let settings = ServeSettings {
        power_off: Some(PowerOff(Arc::new(move |_| {
            seen.lock().unwrap().push(simulator.reading());
        }))),
        ..ServeSettings::default()
    };
    let server = ComponentServer::build(&component, &settings, |_, _| Vec::new()).unwrap();
    server.start();
    let patient = KelvinSettings {
        ready_within: Duration::from_secs(30),
        ..(*bench.changer.settings).clone()
    };
    bench.changer = KelvinChanger::new(patient, bench.changer.mover.clone());
    let detector = peers.detector.clone().unwrap();
    let attach = run(&bench.changer, "AttachToolSkillType", given(URIS[0]));
    let (attached, ()) = tokio::join!(attach, async { detector.seen("fingers", server.url()) });
    assert!(attached.succeeded, "{}", attached.message);
    let noted = |what: &str| attached.trace.iter().any(|line| line.contains(what));
    assert!(noted("urn:test:parallel is ready"), "{:?}", attached.trace);
    let outcome = run(&bench.changer, "DetachToolSkillType", Vec::new()).await;
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(*readings.lock().unwrap(), [ChangerReading::Tool(1)]);
    assert_eq!(bench.simulator.reading(), ChangerReading::NoTool);
    server.stop().await;
}
