//! Pick and place with the tool that is attached, and with objects that others know.

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use tokio::sync::watch;

use super::{ClientOptions, Detector, Needs, PeerAccess, Remote, SkillClient, plate_between};
use crate::choosing::Attachment;
use crate::component::{Component, Device, DriverFault, DriverSetup, Partner};
use crate::conformance;
use crate::driver::{Driver, RunResults, Work};
use crate::driver_error::DriverError;
use crate::parameters::ParameterType;
use crate::server::{ComponentServer, ServeSettings};
use crate::shown::RunOutcome;
use crate::tool_state::ToolState;
use crate::value::SkillValue;

const ROBOT: &str = include_str!("../../../../examples/plant/robot.yaml");
const FINGERS: &str = include_str!("../../../../examples/plant/parallel-gripper.yaml");
const CHANGER: &str = "component: changer
application_uri: urn:test:changer
namespace: 30
skills:
  - {name: Attach, type: AttachToolSkillType, driver: simulated}
";
const CUP: &str = "component: cup
application_uri: urn:test:cup
namespace: 31
skills:
  - name: Grasp
    type: GraspSkillType
    driver: {simulated: {duration: 10 ms}}
    grip_point: {offset: [0, 0, 0.1868, 0, 0, 0], type: vacuum}
  - {name: Release, type: ReleaseSkillType, driver: {simulated: {duration: 10 ms}}}
";
const CAMERA: &str = "component: camera
application_uri: urn:test:camera
namespace: 32
skills:
  - {name: Locate, type: LocateObjectSkillType, driver: device}
";
const HANDLING: &str = "component: handling
application_uri: urn:test:handling
namespace: 33
world:
  box: {pose: [0.4, 0.2, 0.1, 0, 0, 0], box: [0.04, 0.06, 0.05], mass: 0.2}
  ball: {pose: [0.4, 0.2, 0.1, 0, 0, 0], sphere: 0.03}
skills:
  - {name: Place, type: PickAndPlaceSkillType, driver: pick_and_place}
";

const SOON: Duration = Duration::from_secs(60);
/// The number of skills of all components.
const SKILLS: usize = 8;

/// A tool changer that the test switches.
#[derive(Debug)]
struct Switched(watch::Receiver<ToolState>);

impl Device for Switched {
    fn driver(&self, _: &[ParameterType], _: &PeerAccess) -> Result<Arc<dyn Driver>, DriverFault> {
        Err(DriverFault("the test changes no tools".to_owned()))
    }

    fn tool_changer(&self) -> Option<watch::Receiver<ToolState>> {
        Some(self.0.clone())
    }
}

/// A camera that sees a bolt.
#[derive(Debug, Clone)]
struct Camera;

impl Device for Camera {
    fn driver(&self, _: &[ParameterType], _: &PeerAccess) -> Result<Arc<dyn Driver>, DriverFault> {
        Ok(Arc::new(Self))
    }
}

#[async_trait]
impl Driver for Camera {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        match work.parameters().text("ObjectId") {
            Some("bolt") => Ok(vec![
                ("Pose".to_owned(), [0.3, 0.3, 0.1, 0.0, 0.0, 0.0].into()),
                ("Box".to_owned(), vec![0.0; 3].into()),
                ("Cylinder".to_owned(), vec![0.01, 0.04].into()),
                ("Mass".to_owned(), 0.01.into()),
            ]),
            other => {
                let why = format!("no {} is seen", other.unwrap_or_default());
                Err(DriverError::reported(why))
            }
        }
    }
}

fn serve(text: &str, device: Option<Arc<dyn Device>>) -> ComponentServer {
    let component = Component::from_yaml(text, Path::new(""))
        .unwrap_or_else(|findings| panic!("{}", findings.render("x", text)));
    let component = Component {
        device,
        ..component
    };
    let settings = ServeSettings::default();
    let server = ComponentServer::build(&component, &settings, |_, _| Vec::new()).unwrap();
    server.start();
    server
}

struct Cell {
    robot: ComponentServer,
    fingers: ComponentServer,
    cup: ComponentServer,
    others: Vec<ComponentServer>,
    tool: watch::Sender<ToolState>,
    driver: Arc<dyn Driver>,
    options: ClientOptions,
}

impl Cell {
    async fn new() -> Self {
        let options = ClientOptions {
            within: Duration::from_secs(10),
            ..ClientOptions::default()
        };
        let detector = Detector::new(options.clone());
        let fast = ROBOT.replace("{reach: 1.3}", "{reach: 1.3, time_scale: 20}");
        let robot = serve(&fast, None);
        let fingers = serve(&FINGERS.replace("400 ms", "10 ms"), None);
        let cup = serve(CUP, None);
        let (tool, shown) = watch::channel(ToolState {
            plate: [0.0, 0.0, 0.047, 0.0, 0.0, 0.0],
            current: None,
            mover: robot.url().to_owned(),
        });
        let others = vec![
            serve(CHANGER, Some(Arc::new(Switched(shown)))),
            serve(CAMERA, Some(Arc::new(Camera))),
        ];
        let all = [&robot, &fingers, &cup].into_iter().chain(&others);
        for server in all {
            detector.seen(server.url(), server.url());
        }
        let handling = Component::from_yaml(HANDLING, Path::new(""))
            .unwrap_or_else(|findings| panic!("{}", findings.render("x", HANDLING)));
        assert!(handling.looks_for_others());
        let DriverSetup::PickAndPlace(partners) = handling.skills[0].driver.clone() else {
            panic!("another driver");
        };
        let peers = PeerAccess {
            options: options.clone(),
            detector: Some(detector.clone()),
        };
        let mut changes = detector.changes();
        let complete = async {
            while detector.all().len() < SKILLS {
                changes.changed().await.unwrap();
            }
        };
        tokio::time::timeout(SOON, complete).await.unwrap();
        Self {
            robot,
            fingers,
            cup,
            others,
            tool,
            driver: Arc::new(Remote::new(partners, handling.world, peers)),
            options,
        }
    }

    /// Attaches a tool, and waits until the changer shows it.
    async fn attach(&self, tool: Option<&str>) {
        let current = tool.map(str::to_owned);
        self.tool
            .send_modify(|state| state.current.clone_from(&current));
        let changer = self.others[0].url();
        let client = SkillClient::connect(changer, &self.options).await.unwrap();
        let shown = async {
            loop {
                let found = client.skills().await.unwrap();
                let state = found[0].tool_state.clone().unwrap();
                if state.current == current {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        tokio::time::timeout(SOON, shown).await.unwrap();
        client.close().await;
    }

    async fn run(
        &self,
        given: &[(&str, &str)],
    ) -> Result<RunOutcome, conformance::ConformanceError> {
        let place = SkillValue::from([0.4, -0.2, 0.1, 0.0, 0.0, 0.0]);
        let mut parameters = vec![("PlacePosition".to_owned(), place)];
        let texts = given
            .iter()
            .map(|(name, value)| ((*name).to_owned(), SkillValue::from(*value)));
        parameters.extend(texts);
        let driver = Arc::clone(&self.driver);
        let ran = conformance::run_once("PickAndPlaceSkillType", driver, parameters);
        tokio::time::timeout(Duration::from_secs(120), ran)
            .await
            .unwrap()
    }

    /// Returns the numbers of the last runs: the robot, the fingers, the cup.
    fn runs(&self) -> [u32; 3] {
        [&self.robot, &self.fingers, &self.cup].map(|server| {
            let runs = server.skills().iter().map(|skill| skill.shown().run);
            runs.max().unwrap_or_default()
        })
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_skill_uses_the_tool_that_is_attached_for_objects_that_are_listed_or_located() {
    let cell = Cell::new().await;
    let object = |id: &'static str| [("ObjectId", id)];
    cell.attach(Some("urn:test:cup")).await;
    let outcome = cell.run(&object("box")).await.unwrap();
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(cell.runs()[1..], [0, 1]);
    let noted = |what: &str| outcome.trace.iter().any(|line| line.contains(what));
    assert!(
        noted("urn:test:cup is attached to urn:test:changer") && noted("it is the only candidate"),
        "{:?}",
        outcome.trace
    );
    // The flange is above the top of the box by the plate and the cup.
    let robot = cell.robot.skills()[1].shown();
    let target = robot.parameters.six("TargetPosition").unwrap();
    let above = 0.1 + 0.025 + 0.1868 + 0.047 + 0.05;
    assert!((target[2] - above).abs() < 1e-9, "{target:?}");

    cell.attach(Some("urn:example:gripper")).await;
    let outcome = cell.run(&object("bolt")).await.unwrap();
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(cell.runs()[1..], [1, 1]);
    for server in cell.others {
        server.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_moves_without_the_object_a_tool_or_a_fitting_grasp() {
    let cell = Cell::new().await;
    cell.attach(Some("urn:test:cup")).await;
    let none = cell.run(&[]).await.unwrap_err().to_string();
    assert!(none.starts_with("BadInvalidArgument: ObjectId"), "{none}");
    let wrong = [("ToolSkillControllerEndpoint", "cup"), ("ObjectId", "box")];
    let wrong = cell.run(&wrong).await.unwrap_err().to_string();
    assert!(wrong.contains("an endpoint, an ApplicationUri"), "{wrong}");
    let unknown = [("ObjectId", "nut")];
    let other = [
        ("ObjectId", "box"),
        ("ToolSkillControllerEndpoint", "urn:example:gripper"),
    ];
    type Case<'a> = (&'a [(&'a str, &'a str)], Option<&'a str>, &'a str);
    let cases: [Case<'_>; 5] = [
        (
            &unknown,
            Some("urn:test:cup"),
            "camera.Locate: no nut is seen",
        ),
        (&[("ObjectId", "ball")], Some("urn:test:cup"), "no flat top"),
        (&[("ObjectId", "box")], Some(""), "no tool is attached"),
        (
            &[("ObjectId", "box")],
            None,
            "the tool at urn:test:changer is unknown",
        ),
        (
            &other,
            Some("urn:test:cup"),
            "is not attached to urn:test:changer",
        ),
    ];
    for (given, tool, expected) in cases {
        cell.attach(tool).await;
        let outcome = cell.run(given).await.unwrap();
        assert!(
            !outcome.succeeded && outcome.message.contains(expected),
            "{expected}: {}",
            outcome.message
        );
    }
    assert_eq!(cell.runs(), [0, 0, 0]);
    for server in cell.others {
        server.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_robot_that_reaches_the_positions_is_chosen_with_a_reason_for_each_other() {
    let named = |uri: &str, more: &str| {
        let yaml = ROBOT.replace("urn:example:robot", uri);
        serve(&format!("{yaml}{more}\n"), None)
    };
    let zones = "zones: [{name: table, box: [-0.5, -0.5, 0, 0.5, 0.5, 0.5]}]";
    let robots = [
        named("urn:test:short", "reach: 0.3"),
        named("urn:test:table", zones),
        named("urn:test:far", "reach: 1.2"),
    ];
    let options = ClientOptions {
        within: Duration::from_secs(10),
        ..ClientOptions::default()
    };
    let detector = Detector::new(options.clone());
    for server in &robots {
        detector.seen(server.url(), server.url());
    }
    let mut changes = detector.changes();
    let complete = async {
        while detector.all().len() < 2 * robots.len() {
            changes.changed().await.unwrap();
        }
    };
    tokio::time::timeout(SOON, complete).await.unwrap();
    let peers = PeerAccess {
        options,
        detector: Some(detector),
    };
    let choose = async |at: [f64; 3], prefer: &[&str], given: Option<&str>| {
        let prefer: Vec<String> = prefer.iter().map(|uri| (*uri).to_owned()).collect();
        let positions = [[0.2, 0.0, 0.1], at];
        let needs = Needs {
            positions: &positions,
            prefer: &prefer,
        };
        let given = given.map(|uri| Partner::Called(uri.to_owned()));
        peers.robot(given.as_ref(), &needs).await
    };
    let out_of_zone = "0.900, 0.000, 0.100 m is in none of its zones: table";
    let too_far = "0.900, 0.000, 0.100 m is 0.906 m from its base, and it reaches 0.3 m";
    let mut chosen = choose([0.9, 0.0, 0.1], &[], None).await.unwrap();
    chosen.others.sort();
    assert_eq!(chosen.endpoint, robots[2].url());
    assert_eq!(chosen.reason, "it is the only candidate that fits");
    let others = [
        format!("urn:test:short: {too_far}"),
        format!("urn:test:table: {out_of_zone}"),
    ];
    assert_eq!(chosen.others, others);

    let several = choose([0.4, 0.2, 0.1], &[], None).await.unwrap_err();
    let several = several.to_string();
    assert!(several.contains("several robots are found"), "{several}");
    assert!(!several.contains("urn:test:short"), "{several}");
    let prefer = ["urn:test:short", "urn:test:table"];
    let chosen = choose([0.4, 0.2, 0.1], &prefer, None).await.unwrap();
    assert_eq!(chosen.endpoint, robots[1].url());
    assert_eq!(chosen.reason, "it is preferred");
    let less = "urn:test:far: it would fit, but urn:test:table is preferred".to_owned();
    assert!(chosen.others.contains(&less), "{:?}", chosen.others);

    let none = choose([1.5, 0.0, 0.1], &prefer, None).await.unwrap_err();
    let none = none.to_string();
    assert!(none.contains("no robot fits: "), "{none}");
    let named = choose([0.9, 0.0, 0.1], &[], Some("urn:test:short")).await;
    assert!(named.unwrap_err().to_string().contains(too_far));

    // Neither its reach nor its tool shows which robot carries the tool changer.
    let far = [[0.9, 0.0, 0.1]];
    let any = peers.carrier(None, &far).await.unwrap_err().to_string();
    assert!(any.contains("several robots are found"), "{any}");
    let short = Partner::Called("urn:test:short".to_owned());
    let short = peers.carrier(Some(&short), &far).await.unwrap_err();
    assert!(short.to_string().contains(too_far), "{short}");

    // The robot itself refuses the target, too.
    let skill = &robots[0].skills()[0];
    let target = SkillValue::from([0.9, 0.0, 0.1, 0.0, 0.0, 0.0]);
    let given = vec![("TargetPosition".to_owned(), target)];
    let me = crate::authority::SkillOwner::Session(1);
    let refused = skill.execute(me, given, None).await.unwrap_err();
    assert_eq!(refused.text, format!("TargetPosition: {too_far}"));
    for server in robots {
        server.stop().await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_gripper_at_the_tool_changer_of_another_robot_is_not_used() {
    let cell = Cell::new().await;
    let other = "which is at another robot, opc.tcp://127.0.0.1:9";
    for (mover, expected) in [
        ("opc.tcp://127.0.0.1:9", other),
        ("", "which does not show its robot"),
    ] {
        cell.tool
            .send_modify(|state| state.mover = mover.to_owned());
        cell.attach(Some("urn:test:cup")).await;
        let given = [
            ("ObjectId", "box"),
            ("ToolSkillControllerEndpoint", "urn:test:cup"),
        ];
        let outcome = cell.run(&given).await.unwrap();
        let expected = format!("urn:test:cup is attached to urn:test:changer, {expected}");
        assert!(
            !outcome.succeeded && outcome.message.contains(&expected),
            "{}",
            outcome.message
        );
        cell.attach(None).await;
    }
    assert_eq!(cell.runs(), [0, 0, 0]);
    // The other gripper is the only one that may be at the flange.
    cell.attach(Some("urn:test:cup")).await;
    let outcome = cell.run(&[("ObjectId", "box")]).await.unwrap();
    assert!(outcome.succeeded, "{}", outcome.message);
    assert_eq!(cell.runs()[1..], [1, 0]);
    for server in cell.others {
        server.stop().await;
    }
}

#[test]
fn the_plate_is_that_of_the_changer_between_robot_and_gripper() {
    let plate = [0.0, 0.0, 0.047, 0.0, 0.0, 0.0];
    let at = |current: Option<&str>| {
        let state = ToolState {
            plate,
            current: current.map(str::to_owned),
            mover: "opc.tcp://one:4840".to_owned(),
        };
        [("urn:test:changer".to_owned(), state)]
    };
    let one = ("urn:test:one", "opc.tcp://one:4840/");
    let two = ("urn:test:two", "opc.tcp://two:4840");
    let of = |current, robot, gripper| {
        let found = plate_between(&at(current), robot, gripper);
        found.map_err(|why| why.to_string())
    };
    assert_eq!(of(Some("urn:cup"), one, "urn:cup"), Ok(plate));
    assert_eq!(of(Some("urn:cup"), two, "urn:fingers"), Ok([0.0; 6]));
    for (current, robot, gripper, expected) in [
        (
            Some("urn:cup"),
            one,
            "urn:fingers",
            "urn:fingers is not attached",
        ),
        (Some(""), one, "urn:cup", "no tool is attached"),
        (None, one, "urn:cup", "is unknown"),
        (Some("urn:cup"), two, "urn:cup", "which is at another robot"),
    ] {
        let why = of(current, robot, gripper).unwrap_err();
        assert!(why.contains(expected), "{why}");
    }
}

#[test]
fn the_endpoint_of_a_robot_that_carries_a_tool_may_end_with_a_slash() {
    let state = ToolState {
        current: Some("urn:test:cup".to_owned()),
        mover: "opc.tcp://robot:4840".to_owned(),
        ..ToolState::default()
    };
    let of = |component, endpoint| state.attachment(component, Some(endpoint));
    let (robot, cup) = ("urn:test:robot", "urn:test:cup");
    assert_eq!(of(robot, "opc.tcp://robot:4840/"), Attachment::CarriesTool);
    assert_eq!(of(robot, "opc.tcp://robot:4840"), Attachment::CarriesTool);
    assert_eq!(of(robot, "opc.tcp://other:4840"), Attachment::None);
    assert_eq!(of(cup, "opc.tcp://cup:4840"), Attachment::AtRobot);
    let without = ToolState {
        current: Some(String::new()),
        ..state
    };
    let endpoint = Some("opc.tcp://robot:4840");
    assert_eq!(without.attachment(robot, endpoint), Attachment::None);
}
