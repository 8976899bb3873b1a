use std::path::Path;
use std::sync::Arc;

use program::{ProgramMachineState, ProgramMethod};

use super::*;
use crate::component::{Component, Partner, Partners};
use crate::conformance;
use crate::runs::RunnableSkill;
use crate::server::{ComponentServer, ServeSettings};
use crate::value::{Builtin, SkillValue, ValueShape};

const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/plant");

pub(super) fn serve(name: &str, changes: &[(&str, &str)]) -> ComponentServer {
    let folder = Path::new(EXAMPLES);
    let text = std::fs::read_to_string(folder.join(name)).unwrap();
    let text = changes
        .iter()
        .fold(text, |text, (from, to)| text.replace(from, to));
    let component = Component::from_yaml(&text, folder).unwrap();
    let server =
        ComponentServer::build(&component, &ServeSettings::default(), |_, _| Vec::new()).unwrap();
    server.start();
    server
}

pub(super) async fn client(server: &ComponentServer) -> SkillClient {
    let patient = ClientOptions {
        within: Duration::from_secs(10),
        ..ClientOptions::default()
    };
    SkillClient::connect(server.url(), &patient).await.unwrap()
}

fn of(name: &str) -> ParameterType {
    ParameterType::own(name)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_skill_of_another_maker_is_found_by_the_type_it_is_a_subtype_of_and_run() {
    let server = serve("vacuum-gripper.yaml", &[("300 ms", "30 ms")]);
    let client = client(&server).await;
    let all = client.skills().await.unwrap();
    let names: Vec<&str> = all.iter().map(|found| found.name.as_str()).collect();
    assert_eq!(names, ["VacuumGrasp", "BlowOff"]);
    let found = client.skills_of(&of("GraspSkillType")).await.unwrap();
    assert_eq!(found, all[..1]);
    let grasp = &found[0];
    assert_eq!(
        (grasp.component.as_str(), grasp.namespace, grasp.number),
        ("vacuum-gripper", Some(8), Some(1))
    );
    assert_eq!(grasp.node, "nsu=urn:example:vacuum-gripper;i=100");
    let types: Vec<String> = grasp
        .types
        .iter()
        .map(|of| format!("{} {}", of.name, of.identifier))
        .collect();
    assert_eq!(
        types,
        [
            "nsu=urn:example:vacuum;VacuumGraspSkillType i=1",
            "nsu=urn:ua-bridge:skills;GraspSkillType i=1200",
            "nsu=urn:ua-bridge:skills;GripperSkillType i=1100",
            "nsu=urn:ua-bridge:skills;SkillType i=1000",
        ]
    );
    let parameters: Vec<(&str, ValueShape, Option<&str>)> = grasp
        .parameters
        .iter()
        .map(|of| (of.name.as_str(), of.shape, of.unit.as_deref()))
        .collect();
    let double = ValueShape::scalar(Builtin::Double);
    assert_eq!(parameters.len(), 2);
    assert!(
        parameters.contains(&("Force", double, Some("N")))
            && parameters.contains(&("Vacuum", double, None))
    );
    assert_eq!(
        grasp.capabilities,
        ["urn:example:capability:hold-by-vacuum"]
    );

    let handle = client.handle(grasp);
    let given = vec![("Force".to_owned(), SkillValue::from(7.0))];
    let outcome = handle.run(given, Duration::from_secs(10)).await.unwrap();
    assert_eq!((outcome.run, outcome.succeeded), (1, true));
    assert_eq!(
        outcome.results,
        [("Gripped".to_owned(), SkillValue::from(true))]
    );
    assert_eq!(
        server.skills()[0].shown().parameters.number("Force"),
        Some(7.0)
    );
    assert!(
        client
            .skills_of(&of("MoveSkillType"))
            .await
            .unwrap()
            .is_empty()
    );
    assert!(
        client
            .skills_of(&of("NoSkillType"))
            .await
            .unwrap()
            .is_empty()
    );
    client.close().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_lease_ends_with_its_session_and_a_refusal_has_its_code() {
    let server = serve("parallel-gripper.yaml", &[]);
    let (first, second) = (client(&server).await, client(&server).await);
    let grasp = |client: &SkillClient, found: &[FoundSkill]| client.handle(&found[0]);
    let found = first.skills().await.unwrap();
    let (mine, theirs) = (
        grasp(&first, &found),
        grasp(&second, &second.skills().await.unwrap()),
    );
    mine.call(ProgramMethod::Reset).await.unwrap();
    let status = |fault: SkillFault| match &fault {
        SkillFault::Refused { status, .. } => status.clone(),
        SkillFault::Lost(_)
        | SkillFault::TimedOut(_)
        | SkillFault::NotHalted(_)
        | SkillFault::Unexpected(_) => panic!("{fault}"),
    };
    assert_eq!(
        status(theirs.call(ProgramMethod::Start).await.unwrap_err()),
        "BadLocked"
    );
    let locked = theirs
        .start(vec![("Force".to_owned(), 1.0.into())])
        .await
        .unwrap_err();
    assert_eq!(status(locked), "BadLocked");
    assert_eq!(
        status(mine.call(ProgramMethod::Resume).await.unwrap_err()),
        "BadInvalidState"
    );
    let weak = mine
        .start(vec![("Force".to_owned(), (-1.0).into())])
        .await
        .unwrap_err();
    assert_eq!(status(weak), "BadInvalidArgument");
    let strange = mine
        .start(vec![("Strength".to_owned(), 1.0.into())])
        .await
        .unwrap_err();
    assert_eq!(status(strange), "BadInvalidArgument");
    let state = mine.state().await.unwrap().state;
    assert_eq!(state, ProgramMachineState::Ready);
    // The run continues after its session has closed, and its outcome is available to the next
    // session.
    mine.start(vec![("Force".to_owned(), 9.0.into())])
        .await
        .unwrap();
    first.close().await;
    let taken = async {
        while theirs
            .call(ProgramMethod::Reset)
            .await
            .is_err_and(|fault| status(fault) == "BadLocked")
        {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(5), taken)
        .await
        .unwrap();
    let mut watch = server.skills()[0].watch();
    let done = watch.wait_for(|shown| {
        shown
            .outcome
            .as_ref()
            .is_some_and(|outcome| outcome.run == 1)
    });
    tokio::time::timeout(Duration::from_secs(5), done)
        .await
        .unwrap()
        .unwrap();
    let again = theirs
        .run(Vec::new(), Duration::from_secs(10))
        .await
        .unwrap();
    assert_eq!((again.run, again.succeeded), (2, true));
    assert_eq!(
        server.skills()[0].shown().parameters.number("Force"),
        Some(20.0),
        "what the first wrote is forgotten"
    );
    second.close().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_detector_finds_a_type_and_its_subtypes_in_all_servers_and_waits_for_those_to_come() {
    let soon = Duration::from_secs(10);
    let detector = Detector::new(ClientOptions {
        within: soon,
        ..ClientOptions::default()
    });
    let fingers = serve("parallel-gripper.yaml", &[("400 ms", "10 ms")]);
    detector.seen("fingers", fingers.url());
    let grasp = of("GraspSkillType");
    let first = detector.one(&grasp, soon, |_| true).await.unwrap();
    assert_eq!(
        (
            first.skill.component.as_str(),
            first.application_uri.as_str()
        ),
        ("parallel-gripper", "urn:example:gripper")
    );
    // A client that does not know the vacuum gripper finds it by its capability or by its
    // identity.
    let by_vacuum = |one: &Detected| {
        let mut capabilities = one.skill.capabilities.iter();
        capabilities.any(|iri| iri.ends_with(":hold-by-vacuum"))
    };
    let none = detector.one(&grasp, Duration::from_millis(50), by_vacuum);
    assert!(matches!(none.await, Err(SkillFault::Unexpected(_))));
    let waits = detector.one(&grasp, soon, by_vacuum);
    let vacuum = serve("vacuum-gripper.yaml", &[("300 ms", "10 ms")]);
    detector.seen("vacuum", vacuum.url());
    let second = waits.await.unwrap();
    assert_eq!(second.skill.types[0].name.name, "VacuumGraspSkillType");
    assert_eq!(detector.of_type(&grasp), [first.clone(), second.clone()]);
    assert!(detector.of_type(&of("MotionSkillType")).is_empty());

    let (client, handle) = detector.open(&second).await.unwrap();
    let outcome = handle.run(Vec::new(), soon).await.unwrap();
    assert!(outcome.succeeded);
    client.close().await;
    let mut changes = detector.changes();
    detector.gone("vacuum");
    assert!(changes.has_changed().unwrap());
    changes.mark_unchanged();
    detector.gone("vacuum");
    assert!(!changes.has_changed().unwrap(), "it was gone already");
    assert_eq!(detector.of_type(&grasp), [first]);
    vacuum.stop().await;
    fingers.stop().await;
}

const EARLIER: &str = r#"<?xml version="1.0" encoding="utf-8"?>
<UANodeSet xmlns="http://opcfoundation.org/UA/2011/03/UANodeSet.xsd">
  <NamespaceUris><Uri>https://fortiss.org/UA/Device/</Uri></NamespaceUris>
  <Models><Model ModelUri="https://fortiss.org/UA/Device/" /></Models>
  <UAObjectType NodeId="ns=1;i=1" BrowseName="1:SkillType" IsAbstract="true">
    <DisplayName>SkillType</DisplayName>
    <References><Reference ReferenceType="i=45" IsForward="false">i=2391</Reference></References>
  </UAObjectType>
  <UAObjectType NodeId="ns=1;i=2" BrowseName="1:GraspGripperSkillType">
    <DisplayName>GraspGripperSkillType</DisplayName>
    <References><Reference ReferenceType="i=45" IsForward="false">ns=1;i=1</Reference></References>
  </UAObjectType>
  <UAObjectType NodeId="ns=1;i=3" BrowseName="1:VacuumGraspSkillType">
    <DisplayName>VacuumGraspSkillType</DisplayName>
    <References><Reference ReferenceType="i=45" IsForward="false">ns=1;i=2</Reference></References>
  </UAObjectType>
</UANodeSet>"#;

fn earlier_server() -> plant_opcua::server::OpcUaServer {
    use plant_opcua::server::{InstanceSpec, ServerBuilder, ServerConfig};
    use plant_opcua::types::{NodeId, ObjectId, ObjectTypeId, QualifiedName};
    let endpoint = "opc.tcp://127.0.0.1:0".parse().unwrap();
    let config = ServerConfig::new("urn:example:earlier", "earlier", endpoint);
    let builder = ServerBuilder::new(config).nodeset_str("earlier", EARLIER);
    let server = builder.build().unwrap();
    let of = server.find_type("https://fortiss.org/UA/Device/", "VacuumGraspSkillType");
    let types = [of.unwrap(), ObjectTypeId::ProgramStateMachineType.into()];
    for (id, (type_id, name)) in (1_u32..).zip(types.into_iter().zip(["Grasp", "Wash"])) {
        let mut next = 1_000 * id;
        let spec = InstanceSpec::new(
            type_id,
            NodeId::new(1, id),
            QualifiedName::new(1, name),
            ObjectId::ObjectsFolder.into(),
        );
        let made = server.instantiate(&spec, &mut |_| {
            next += 1;
            NodeId::new(1, next)
        });
        made.unwrap();
    }
    server.start();
    server
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn skills_of_the_earlier_system_are_found_by_both_names_and_plain_programs_beside_them() {
    let server = earlier_server();
    let client = SkillClient::connect(server.url(), &ClientOptions::default())
        .await
        .unwrap();
    let earlier = "nsu=https://fortiss.org/UA/Device/;GraspGripperSkillType";
    let mut found = Vec::new();
    for wanted in ["GraspSkillType", "SkillType", earlier] {
        found = client.skills_of(&wanted.parse().unwrap()).await.unwrap();
        assert_eq!(found.len(), 1, "{wanted}");
    }
    let types: Vec<&str> = found[0]
        .types
        .iter()
        .map(|of| of.name.name.as_str())
        .collect();
    assert_eq!(
        types,
        [
            "VacuumGraspSkillType",
            "GraspGripperSkillType",
            "SkillType",
            "GraspSkillType",
            "GripperSkillType",
            "SkillType"
        ]
    );
    assert!(
        client
            .skills_of(&of("ReleaseSkillType"))
            .await
            .unwrap()
            .is_empty()
    );
    let all = client.programs().await.unwrap();
    let names: Vec<&str> = all.iter().map(|found| found.name.as_str()).collect();
    assert_eq!(names, ["Grasp", "Wash"]);
    assert_eq!(all[1].types[0].name.name, "ProgramStateMachineType");
    client.close().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_begins_in_one_call_and_its_outcome_is_read_by_its_number_by_anybody() {
    let server = serve("parallel-gripper.yaml", &[("400 ms", "30 ms")]);
    let (first, second) = (client(&server).await, client(&server).await);
    let found = first.skills().await.unwrap();
    let (mine, theirs) = (first.handle(&found[0]), second.handle(&found[0]));
    let code = |fault: SkillFault| match &fault {
        SkillFault::Refused { status, .. } => status.clone(),
        SkillFault::Lost(_)
        | SkillFault::TimedOut(_)
        | SkillFault::NotHalted(_)
        | SkillFault::Unexpected(_) => panic!("{fault}"),
    };
    // A refused call leaves a Halted skill Halted.
    let force = |force: f64| vec![("Force".to_owned(), SkillValue::from(force))];
    let strong = mine.execute(force(1e9), None).await.unwrap_err();
    assert_eq!(code(strong), "BadInvalidArgument");
    assert_eq!(
        mine.state().await.unwrap().state,
        ProgramMachineState::Halted
    );
    let unknown = theirs.outcome_of(1).await.unwrap_err();
    assert_eq!(code(unknown), "BadNotFound");

    assert_eq!(mine.execute(force(7.0), None).await, Ok(1));
    let again = mine.execute(force(8.0), None).await.unwrap_err();
    assert_eq!(code(again), "BadInvalidState");
    let other = theirs.execute(force(8.0), None).await.unwrap_err();
    assert_eq!(code(other), "BadLocked");
    first.close().await;
    let outcome = theirs.wait(1, Duration::from_secs(5)).await.unwrap();
    assert_eq!((outcome.run, outcome.succeeded), (1, true));
    assert_eq!(
        outcome.results,
        [("Gripped".to_owned(), SkillValue::from(true))]
    );
    assert_eq!(outcome.trace.len(), 1);
    assert!(outcome.trace[0].ends_with(" Close"), "{:?}", outcome.trace);
    let taken = async {
        loop {
            match theirs
                .execute(force(8.0), Some(Duration::from_millis(5)))
                .await
            {
                Ok(run) => return run,
                Err(fault) => assert_eq!(code(fault), "BadLocked"),
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    let run = tokio::time::timeout(Duration::from_secs(5), taken)
        .await
        .unwrap();
    let outcome = theirs.wait(run, Duration::from_secs(5)).await.unwrap();
    assert_eq!(
        (run, outcome.succeeded, outcome.message.as_str()),
        (2, false, "the work was not done within 5ms")
    );
    assert!(theirs.outcome_of(1).await.unwrap().unwrap().succeeded);
    second.close().await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_composite_runs_the_skills_of_two_servers_and_gives_their_leases_back() {
    let robot = serve(
        "robot.yaml",
        &[("{reach: 1.3}", "{reach: 1.3, time_scale: 20}")],
    );
    let gripper = serve("parallel-gripper.yaml", &[("400 ms", "20 ms")]);
    let partners = Partners {
        prefer: Vec::new(),
        robot: Some(Partner::At(robot.url().to_owned())),
        gripper: Some(Partner::Called("urn:example:gripper".to_owned())),
        plate: None,
        within: Duration::from_secs(20),
    };
    let parameters = vec![
        (
            "PickPosition".to_owned(),
            SkillValue::from([0.4, 0.2, 0.1, 0.0, 0.0, 0.0]),
        ),
        (
            "PlacePosition".to_owned(),
            SkillValue::from([0.4, -0.2, 0.1, 0.0, 0.0, 0.0]),
        ),
    ];
    let detector = Detector::new(ClientOptions::default());
    detector.seen("gripper", gripper.url());
    let peers = PeerAccess {
        detector: Some(detector),
        ..PeerAccess::default()
    };
    let driver = Arc::new(Remote::new(partners, Arc::default(), peers));
    let outcome =
        conformance::run_once("PickAndPlaceSkillType", driver.clone(), parameters.clone())
            .await
            .unwrap();
    assert!(outcome.succeeded, "{}", outcome.message);
    let traced = |what: &str| outcome.trace.iter().any(|line| line.ends_with(what));
    assert!(traced(" MovePick"), "{:?}", outcome.trace);
    assert!(
        traced("robot.LinearMove run 1 is done"),
        "{:?}",
        outcome.trace
    );
    let free = |server: &ComponentServer| server.authority().holder();
    for mut holder in [free(&robot), free(&gripper)] {
        let freed = holder.wait_for(Option::is_none);
        tokio::time::timeout(Duration::from_secs(5), freed)
            .await
            .unwrap()
            .unwrap();
    }
    // A person has locked a component. That person is not disturbed, and nothing moves.
    let other = client(&gripper).await;
    let theirs = other.handle(&other.skills().await.unwrap()[0]);
    assert!(theirs.lock("a person").await.unwrap());
    let before = robot.skills()[0].shown().run;
    let outcome =
        conformance::run_once("PickAndPlaceSkillType", driver.clone(), parameters.clone())
            .await
            .unwrap();
    assert!(
        !outcome.succeeded && outcome.message.starts_with("BadLocked: parallel-gripper"),
        "{}",
        outcome.message
    );
    assert_eq!(robot.skills()[0].shown().run, before);
    other.close().await;
    gripper.stop().await;
    let outcome = conformance::run_once("PickAndPlaceSkillType", driver, parameters)
        .await
        .unwrap();
    assert!(
        !outcome.succeeded && outcome.message.contains("opc.tcp://"),
        "{}",
        outcome.message
    );
    robot.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_mirror_refuses_calls_until_it_knows_the_skill_and_then_has_its_last_outcome() {
    let server = serve("vacuum-gripper.yaml", &[("300 ms", "30 ms")]);
    let client = client(&server).await;
    let found = client.skills_of(&of("GraspSkillType")).await.unwrap();
    let within = Duration::from_secs(10);
    let ran = client.handle(&found[0]).run(Vec::new(), within).await;
    let ran = ran.unwrap();
    let watchable = Watchable::of(client).await.unwrap();
    let place = watchable.found().position(|one| one.node == found[0].node);
    let mirrors = Mirrors::begin(&watchable, 1, |_, _| Vec::new());
    let mirror = &mirrors.skills()[place.unwrap()];
    let start = mirror.call(ProgramMethod::Start, Vec::new());
    let (reset, start) = tokio::join!(mirror.make_ready(), start);
    for early in [reset, start] {
        let text = early.unwrap_err().to_string();
        assert!(
            text.contains("the state of the skill is not known yet"),
            "{text}"
        );
    }
    let known = async {
        while mirror.shown().outcome.is_none() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(within, known).await.unwrap();
    let shown = mirror.shown();
    assert_eq!(
        (shown.state, shown.needs_reset),
        (ProgramMachineState::Ready, false)
    );
    assert_eq!(mirror.outcome(shown.run).unwrap().results, ran.results);
    drop(mirrors);
    server.stop().await;
}
