use skills::{Authority, Facts, LocalRun, Owner, Skill, conformance, model};

use super::simulator::{Docked, Following, Simulator};
use super::*;
use crate::modbus::server::{Faults, Serving};
use crate::ur;

const DOCKS: [[f64; 6]; 2] = [
    [0.3, 0.3, 0.2, 0.0, 0.0, 0.0],
    [-0.3, 0.3, 0.2, 0.0, 0.0, 0.5],
];
const URIS: [&str; 2] = ["urn:test:parallel", "urn:test:vacuum"];

struct Bench {
    changer: Changer,
    simulator: Simulator,
    robot: ur::simulator::Simulator,
    _served: (Serving, ur::simulator::Serving, Following),
}

fn skill(name: &str, driver: Arc<dyn Driver>, authority: &Authority) -> Arc<dyn Runs> {
    let of = model::find(name).unwrap();
    let facts = Facts {
        name: name.to_owned(),
        types: vec![TypeName::own(name)],
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: None,
        rests_in: of.rests_in,
    };
    let skill = Skill::spawn(facts, driver, authority.clone(), Vec::new());
    Arc::new(LocalRun {
        skill,
        by: Owner::Local("changer"),
    })
}

async fn bench() -> Bench {
    let settings = ur::simulator::Settings {
        time_scale: 50.0,
        ..ur::simulator::Settings::default()
    };
    let robot = ur::simulator::Simulator::new(settings);
    let robot_served = ur::simulator::Serving::start(&robot, "127.0.0.1:0", "127.0.0.1:0")
        .await
        .unwrap();
    let device = ur::Robot::new(ur::Settings {
        rtde: robot_served.rtde().to_string(),
        secondary: robot_served.secondary().to_string(),
        reach: ur::REACH,
    });
    let authority = Authority::new();
    let moves = |of: &str| {
        skill(
            of,
            device
                .driver(&[TypeName::own(of)], &PeerAccess::default())
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
        .collect();
    let simulator = Simulator::new(docked);
    let following = simulator.follow(&robot_served.rtde().to_string());
    let registers = Arc::new(simulator.clone());
    let line = "tcp://127.0.0.1:0".parse().unwrap();
    let serving = Serving::start(&line, 1, registers, Faults::default())
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
    let settings = Settings {
        converter,
        tools: tools.collect(),
        within: Duration::from_secs(20),
    };
    Bench {
        changer: Changer::new(settings, mover),
        simulator,
        robot,
        _served: (serving, robot_served, following),
    }
}

fn given(uri: &str) -> Vec<(String, Value)> {
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
    async fn run(&self, of: &str, uri: Option<&str>) -> Result<(bool, String), String> {
        let driver = self
            .changer
            .driver(&[TypeName::own(of)], &PeerAccess::default())
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
    assert_eq!(bench.simulator.reading(), Reading::Tool(1));
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
    assert_eq!(bench.simulator.reading(), Reading::Tool(2));
    assert_eq!(bench.run("DetachToolSkillType", None).await, done);
    assert_eq!(bench.simulator.reading(), Reading::NoTool);
    let mut elsewhere = given(URIS[0]);
    elsewhere[1].1 = DOCKS[1].into();
    let driver = bench
        .changer
        .driver(
            &[TypeName::own("AttachToolSkillType")],
            &PeerAccess::default(),
        )
        .unwrap();
    let refused = conformance::run_once("AttachToolSkillType", driver, elsewhere)
        .await
        .unwrap_err();
    assert!(
        refused.starts_with("BadInvalidArgument: ToolPosition is not where"),
        "{refused}"
    );
    let unknown = bench
        .run("ChangeToolSkillType", Some("urn:test:hammer"))
        .await
        .unwrap_err();
    assert_eq!(
        unknown,
        "BadInvalidArgument: ToolAppUri is one of urn:test:parallel, urn:test:vacuum"
    );
}

#[tokio::test]
async fn its_drivers_are_as_drivers_should_be() {
    let bench = bench().await;
    let driver = bench
        .changer
        .driver(
            &[TypeName::own("ChangeToolSkillType")],
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
    while bench.simulator.reading() != Reading::Intermediate {
        assert!(Instant::now() < until);
        sleep(Duration::from_millis(10)).await;
    }
    let told = bench.run("DetachToolSkillType", None).await.unwrap();
    let expected =
        "nothing is moved: its ring is between open and locked, and somebody has to look at it";
    assert_eq!(told, (false, expected.to_owned()));
}
