use std::path::Path;

use plant_opcua::types::Variant;
use program::{ProgramMachineState, ProgramMethod};

use super::*;
use crate::value::SkillValue;
use crate::variant::from_variant;

const EXAMPLES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../examples/plant");

fn example(name: &str) -> Component {
    let folder = Path::new(EXAMPLES);
    let text = std::fs::read_to_string(folder.join(name)).unwrap();
    Component::from_yaml(&text, folder)
        .unwrap_or_else(|found| panic!("{}", found.render(name, &text)))
}

fn served(component: &Component) -> Result<ComponentServer, ServeFault> {
    ComponentServer::build(component, &ServeSettings::default(), |_, _| Vec::new())
}

fn findings(yaml: &str) -> String {
    let component = Component::from_yaml(yaml, Path::new(EXAMPLES)).unwrap();
    match served(&component) {
        Err(ServeFault::Findings(findings)) => findings.render("x.yaml", yaml),
        Err(fault) => fault.to_string(),
        Ok(_) => String::new(),
    }
}

#[tokio::test]
async fn skills_stand_at_their_numbers_and_show_what_happens() {
    let component = served(&example("parallel-gripper.yaml")).unwrap();
    let server = &component.server;
    let value = |id: u32| {
        server
            .value(&NodeId::new(1, id))
            .and_then(|value| value.value)
    };
    let name = |id: u32| {
        server
            .browse_name(&NodeId::new(1, id))
            .map(|name| name.name.as_ref().to_owned())
    };
    assert_eq!(name(1).as_deref(), Some("parallel-gripper"));
    let ids = [100, 101, 103, 104, 105, 106, 107, 108, 109, 200];
    let names: Vec<String> = ids.into_iter().filter_map(name).collect();
    let expected = [
        "Grasp",
        "CurrentState",
        "ParameterSet",
        "FinalResultData",
        "Start",
        "Halt",
        "Suspend",
        "Resume",
        "Reset",
        "Release",
    ];
    assert_eq!(names, expected);

    let skill = &component.skills()[0];
    let me = SkillOwner::Session(1);
    skill.call(me.clone(), ProgramMethod::Reset).await.unwrap();
    skill.write(&me, "Force", 12.0.into()).unwrap();
    skill.call(me, ProgramMethod::Start).await.unwrap();
    let state = |value: Option<Variant>| value.map(|value| value.to_string());
    assert!(
        state(value(101)).is_some_and(|text| text.contains("Running")),
        "{:?}",
        value(101)
    );
    let mut watch = skill.watch();
    let ended = watch.wait_for(|shown| shown.state == ProgramMachineState::Ready);
    tokio::time::timeout(Duration::from_secs(5), ended)
        .await
        .unwrap()
        .unwrap();
    assert!(state(value(101)).is_some_and(|text| text.contains("Ready")));
    let children = server.children(&NodeId::new(1, 104));
    let result = |name: &str| {
        let child = children
            .iter()
            .find(|child| child.browse_name.name.as_ref() == name)?;
        server
            .value(&child.node_id)?
            .value
            .as_ref()
            .and_then(from_variant)
    };
    assert_eq!(result("Succeeded"), Some(SkillValue::Boolean(true)));
    assert_eq!(result("Gripped"), Some(SkillValue::Boolean(true)));
    assert_eq!(result("Run"), Some(SkillValue::UInt32(1)));
    component.stop().await;
}

#[tokio::test]
async fn a_type_of_another_maker_has_what_its_supertypes_have_and_more() {
    let component = served(&example("vacuum-gripper.yaml")).unwrap();
    let facts = component.skills()[0].facts();
    let types: Vec<&str> = facts.types.iter().map(|of| of.name.as_str()).collect();
    assert_eq!(
        types,
        [
            "VacuumGraspSkillType",
            "GraspSkillType",
            "GripperSkillType",
            "SkillType"
        ]
    );
    assert_eq!(facts.types[0].namespace, "urn:example:vacuum");
    let parameters: Vec<(&str, Option<&SkillValue>)> = facts
        .parameters
        .iter()
        .map(|of| (of.name.as_str(), of.default.as_ref()))
        .collect();
    let expected = [
        ("Force", Some(&SkillValue::Double(20.0))),
        ("Vacuum", Some(&SkillValue::Double(60.0))),
    ];
    assert_eq!(parameters, expected);
    assert_eq!(facts.parameters[0].unit.as_deref(), Some("N"));
    component.stop().await;
    let robot = served(&example("robot.yaml")).unwrap();
    assert_eq!(robot.skills().len(), 2);
    robot.stop().await;
}

#[tokio::test]
async fn types_that_are_not_there_or_do_not_fit_are_told_at_once_with_their_places() {
    let head = "component: x\napplication_uri: urn:x\nnamespace: 9\nnodesets: [vacuum-gripper.xml]\nskills:\n";
    let skill =
        |name: &str, of: &str| format!("  - {{name: {name}, type: \"{of}\", driver: simulated}}\n");
    let yaml = [
        head.to_owned(),
        skill("A", "GraspSkilType"),
        skill("B", "MoveSkillType"),
        skill("C", "nsu=urn:example:vacuum;Nothing"),
        skill("D", "PickAndPlaceSkillType"),
        skill("E", "ISkillControllerType"),
    ];
    let told = findings(&yaml.concat());
    for expected in [
        "error[P020]: there is no type nsu=urn:ua-bridge:skills;GraspSkilType\n --> x.yaml:6:",
        "did you mean `GraspSkillType`?",
        "error[P022]: `simulated` does the work of",
        " --> x.yaml:7:",
        "the NodeSet with the type stands under `nodesets`",
        " --> x.yaml:9:",
        "error[P020]: nsu=urn:ua-bridge:skills;ISkillControllerType is no subtype of SkillType",
    ] {
        assert!(told.contains(expected), "{expected}\nis not in\n{told}");
    }
    let abstract_type = format!("{head}{}", skill("A", "GripperSkillType"));
    assert!(
        findings(&abstract_type).contains("`simulated` does the work of"),
        "{}",
        findings(&abstract_type)
    );
    let missing = head.replace("vacuum-gripper.xml", "nowhere.xml") + &skill("A", "GraspSkillType");
    assert!(
        findings(&missing).contains("nowhere.xml"),
        "{}",
        findings(&missing)
    );
}
#[tokio::test]
async fn drivers_are_replaced_all_or_none() {
    let mut component = example("parallel-gripper.yaml");
    let mut served = served(&component).unwrap();
    let names: Vec<String> = ["Grasp", "Release"].map(str::to_owned).into();
    component.skills[1].driver = crate::component::DriverSetup::Device;
    component.skills[0].timeout = Some(Duration::from_millis(1));
    let fault = served.replace_drivers(&component, &names).unwrap_err();
    assert!(fault.to_string().contains("no `device`"), "{fault}");
    let grasp = served.skills()[0].clone();
    let me = SkillOwner::Session(1);
    let ends = async |run: u32| {
        let mut watch = grasp.watch();
        let ended = watch.wait_for(|shown| {
            let outcome = shown.outcome.as_ref();
            outcome.is_some_and(|outcome| outcome.run == run)
        });
        let ended = tokio::time::timeout(Duration::from_secs(30), ended).await;
        ended.unwrap().unwrap().outcome.clone().unwrap()
    };
    let run = grasp.execute(me.clone(), Vec::new(), None).await.unwrap();
    assert!(ends(run).await.succeeded, "the limit is not replaced");
    served.replace_drivers(&component, &names[..1]).unwrap();
    let run = grasp.execute(me, Vec::new(), None).await.unwrap();
    let outcome = ends(run).await;
    assert!(outcome.message.contains("within 1ms"), "{outcome:?}");
    served.stop().await;
}
