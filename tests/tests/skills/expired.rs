//! Composites of a secured cell with a partner whose certificate expires.

use std::path::PathBuf;
use std::time::Duration;

use skills::{
    ClientOptions, ParameterType, RunOutcome, RunnableSkill as _, SkillClient, SkillFault,
    SkillHandle, SkillValue,
};
use system_tests::{Cell, Child, Peer, StartedChild, eventually, program};
use tokio::time::{Instant, sleep};

use super::SOON;

const ROBOT: &str = "opc.tcp://127.0.0.1:24840";
const GRIPPER: &str = "opc.tcp://127.0.0.1:10254";
const HANDLING: &str = "opc.tcp://127.0.0.1:12346";
const DAY: i64 = 86_400;
/// Validity of a certificate that a component makes for itself.
const VALIDITY: i64 = 1826 * DAY;

fn store(cell: &Cell, name: &str) -> PathBuf {
    cell.folder().join(format!("{name}.store"))
}

fn part(cell: &Cell, name: &str, endpoint: &str, yaml: &str) -> StartedChild {
    let file = cell.file(&format!("{name}.yaml"), yaml);
    StartedChild::new(name, &program("ua-component"))
        .args([file])
        .args(["--endpoint", endpoint, "--lds", "none", "--interface", "lo"])
        .args(["--trust-any-client-certificate", "--pki"])
        .args([store(cell, name)])
}

fn serves(endpoint: &str) {
    eventually("the component serves", SOON, || {
        std::net::TcpStream::connect(endpoint.trim_start_matches("opc.tcp://")).ok()
    });
}

/// Makes the composite trust a component.
fn trust(cell: &Cell, name: &str) {
    let certificate = store(cell, name).join("own/cert.der");
    let trusted = std::process::Command::new(program("ua-server"))
        .arg("trust")
        .arg(certificate)
        .arg("--pki")
        .arg(store(cell, "handling"))
        .output()
        .unwrap();
    assert!(trusted.status.success(), "{trusted:?}");
}

/// The robot also serves unsecured channels, so that the test sees its runs.
fn robot(cell: &Cell) -> Child {
    let yaml = "{component: robot, application_uri: 'urn:ua-bridge:system-tests:robot', namespace: 6,
        security: [None, Basic256Sha256], skills: [
        {name: Ptp, type: PtpMoveSkillType, driver: {simulated: {reach: 1.3, time_scale: 50}}},
        {name: Linear, type: LinearMoveSkillType, driver: {simulated: {reach: 1.3, time_scale: 50}}}]}";
    let child = part(cell, "robot", ROBOT, yaml).start();
    serves(ROBOT);
    child
}

/// Starts a gripper with a certificate that expires ten days before the other certificates.
fn gripper(cell: &Cell) -> Child {
    let yaml =
        "{component: gripper, application_uri: 'urn:ua-bridge:system-tests:gripper', namespace: 7,
        security: [Basic256Sha256], skills: [
        {name: Grasp, type: GraspSkillType, driver: {simulated: {duration: 2 s}}},
        {name: Release, type: ReleaseSkillType, driver: {simulated: {duration: 50 ms}}}]}";
    let past = cell.wall_clock();
    past.set(-10 * DAY);
    let mut first = part(cell, "gripper", GRIPPER, yaml).by(&past).start();
    serves(GRIPPER);
    first.end();
    let child = part(cell, "gripper", GRIPPER, yaml).start();
    serves(GRIPPER);
    child
}

/// The composite also serves unsecured channels for the test; its partners are secured.
const COMPOSITE: &str = "{component: handling, application_uri: 'urn:ua-bridge:system-tests:handling', namespace: 8,
    security: [None, Basic256Sha256], skills: [{name: Place, type: PickAndPlaceSkillType,
    driver: {pick_and_place: {robot: 'opc.tcp://127.0.0.1:24840', gripper: 'opc.tcp://127.0.0.1:10254', within: 60 s}}}]}";

async fn handle(endpoint: &str, of: &str) -> (SkillClient, SkillHandle) {
    let options = ClientOptions {
        within: SOON,
        ..ClientOptions::default()
    };
    let client = SkillClient::connect(endpoint, &options).await.unwrap();
    let found = client.skills_of(&ParameterType::own(of)).await.unwrap();
    let handle = client.handle(&found[0]);
    (client, handle)
}

async fn place(handle: &SkillHandle) -> Result<RunOutcome, SkillFault> {
    let pose = |y: f64| SkillValue::from([0.4, y, 0.1, 0.0, 0.0, 0.0]);
    let given = vec![
        ("PickPosition".to_owned(), pose(0.2)),
        ("PlacePosition".to_owned(), pose(-0.2)),
    ];
    handle.run(given, Duration::from_secs(120)).await
}

/// Returns the numbers of the newest runs of the robot's skills.
async fn runs_of_the_robot() -> [u32; 2] {
    let mut runs = [0; 2];
    for (run, of) in runs
        .iter_mut()
        .zip(["PtpMoveSkillType", "LinearMoveSkillType"])
    {
        let (client, handle) = handle(ROBOT, of).await;
        *run = handle.state().await.unwrap().run;
        client.close().await;
    }
    runs
}

#[test]
fn a_gripper_whose_certificate_expires_is_refused_between_runs_and_lost_in_a_run() {
    let Some(cell) = Cell::with(&[Peer::Clock]) else {
        return;
    };
    let _robot = robot(&cell);
    let _gripper = gripper(&cell);
    for name in ["robot", "gripper"] {
        trust(&cell, name);
    }
    let clock = cell.wall_clock();
    let _handling = part(&cell, "handling", HANDLING, COMPOSITE)
        .by(&clock)
        .start();
    serves(HANDLING);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let (client, skill) = handle(HANDLING, "PickAndPlaceSkillType").await;
        let done = place(&skill).await.unwrap();
        assert!(done.succeeded, "{}", done.message);

        // Between two runs: nothing moves, and the result has the partner and the remedy.
        clock.set(VALIDITY - 5 * DAY);
        let before = runs_of_the_robot().await;
        let refused = place(&skill).await.unwrap();
        let told = &refused.message;
        assert!(!refused.succeeded && !refused.unknown, "{told}");
        for part in [GRIPPER, EXPIRED, "renew the certificate"] {
            assert!(told.contains(part), "{told}");
        }
        assert_eq!(runs_of_the_robot().await, before, "the robot has moved");

        // In a run: the gripper may hold the part, so the outcome is unknown, with the reason.
        clock.set(0);
        let until = Instant::now() + SOON;
        let expire = async {
            while skill.state().await.unwrap().step != "Grasp" {
                assert!(Instant::now() < until, "the gripper is never at work");
                sleep(Duration::from_millis(20)).await;
            }
            clock.set(VALIDITY - 5 * DAY);
        };
        let (lost, ()) = tokio::join!(place(&skill), expire);
        let lost = lost.unwrap();
        let told = &lost.message;
        assert!(!lost.succeeded && lost.unknown, "{told}");
        let is_told = told.contains("Grasp: gripper.Grasp is lost") && told.contains(EXPIRED);
        assert!(
            is_told && told.ends_with("the robot has retreated"),
            "{told}"
        );
        // Nothing moves before a person has reset the composite.
        let before = runs_of_the_robot().await;
        let again = place(&skill).await;
        let is_refused = matches!(&again, Err(SkillFault::Refused { status, .. })
            if status == "BadInvalidState");
        assert!(is_refused, "{again:?}");
        assert_eq!(runs_of_the_robot().await, before, "the robot has moved");
        client.close().await;
    });
}

const EXPIRED: &str = "BadCertificateTimeInvalid";
