//! Tests of the requests and results of skills that the space executes.

use std::path::Path;

use skills::{Builtin, SkillValue, model};
use uadp::{BuiltinType, Fields};

use super::*;
use crate::fields;

fn example(name: &str) -> Component {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/plant");
    let text = std::fs::read_to_string(folder.join(name)).unwrap();
    Component::from_yaml(&text, &folder).unwrap()
}

fn driver(component: &Component, number: usize) -> SpaceDriver {
    let DriverSetup::Space(work) = &component.skills[number].driver else {
        panic!("{:?}", component.skills[number].driver)
    };
    let topic = work.topic.parse().unwrap();
    SpaceDriver {
        work: SpaceWork::clone(work),
        topic,
        asks: Asking::new().asks(topic),
    }
}

fn parameters(of: &str, given: Vec<(&str, SkillValue)>) -> Parameters {
    let declared = model::find(of).unwrap().parameters();
    let given = given
        .into_iter()
        .map(|(name, value)| (name.to_owned(), value));
    Parameters::complete(&declared, given.collect()).unwrap()
}

/// Returns the fields of an encoded request.
fn asked(block: &[u8]) -> Vec<Option<SkillValue>> {
    let fields = Fields::parse(block).unwrap();
    fields
        .map(|field| fields::value(&field.unwrap()).unwrap_or(None))
        .collect()
}

fn scalar(name: &str, builtin: BuiltinType) -> CallField {
    CallField::scalar(name, builtin)
}

#[test]
fn a_goal_is_made_of_constants_parameters_and_nothing_where_nothing_is_said() {
    let driver = driver(&example("niryo-ned.yaml"), 0);
    let takes = [
        scalar("goal_id", BuiltinType::ByteString),
        scalar("goal.cmd.cmd_type", BuiltinType::Int32),
        scalar("goal.cmd.position.x", BuiltinType::Double),
        scalar("goal.cmd.position.y", BuiltinType::Double),
        scalar("goal.cmd.position.z", BuiltinType::Double),
        scalar("goal.cmd.rpy.roll", BuiltinType::Double),
        scalar("goal.cmd.rpy.pitch", BuiltinType::Double),
        scalar("goal.cmd.rpy.yaw", BuiltinType::Double),
        scalar("goal.cmd.trajectory.header.frame_id", BuiltinType::String),
        scalar("goal.cmd.trajectory.header.stamp", BuiltinType::DateTime),
        CallField::array("goal.cmd.list_poses", BuiltinType::ExtensionObject),
        CallField::array("goal.cmd.args", BuiltinType::Double),
    ];
    let target = [0.25, 0.5, 0.75, 1.0, 1.25, 1.5];
    let given = parameters(
        "PtpMoveSkillType",
        vec![("TargetPosition", SkillValue::from(target))],
    );
    let block = driver.request(&takes, &given, Some([7; 16])).unwrap();
    let fields = asked(&block);
    assert_eq!(fields.len(), takes.len());
    assert_eq!(fields[1], Some(SkillValue::Int32(1)));
    for (place, value) in target.iter().enumerate() {
        assert_eq!(fields[2 + place], Some(SkillValue::Double(*value)));
    }
    assert_eq!(fields[8], Some("".into()));
    assert_eq!(
        fields[11],
        Some(SkillValue::Array(Builtin::Double, Vec::new()))
    );
    let wrong = driver
        .request(&takes[..3], &given, Some([7; 16]))
        .unwrap_err();
    assert!(wrong.contains("no field `cmd.position.y`"), "{wrong}");
}

#[test]
fn parameters_go_by_name_and_in_the_types_that_are_asked_for() {
    let component = example("niryo-ned.yaml");
    let mut driver = driver(&component, 4);
    driver.work.request.clear();
    let takes = [
        scalar("ON", BuiltinType::Boolean),
        scalar("speed", BuiltinType::Int16),
        scalar("extra", BuiltinType::Int32).optional(),
    ];
    let given = parameters("RunConveyorSkillType", Vec::new());
    let block = driver.request(&takes, &given, None).unwrap();
    assert_eq!(
        asked(&block),
        [Some(true.into()), Some(SkillValue::Int16(0)), None]
    );
    let move_to = [scalar("target_position", BuiltinType::Double)];
    let target = parameters(
        "PtpMoveSkillType",
        vec![("TargetPosition", SkillValue::from([1.0; 6]))],
    );
    let wrong = driver.request(&move_to, &target, None).unwrap_err();
    assert!(
        wrong.starts_with("target_position: "),
        "six are not one: {wrong}"
    );
}

#[test]
fn an_answer_says_whether_the_work_is_done_and_what_came_out() {
    let component = example("niryo-ned.yaml");
    let grasp = driver(&component, 2);
    let none = parameters("GraspSkillType", Vec::new());
    let answer = |status: i64| {
        SpaceAnswer::of(vec![
            ("result.status".to_owned(), status.into()),
            ("result.message".to_owned(), "said".into()),
        ])
    };
    let done = grasp.outcome(&answer(1), "result.", &none).unwrap();
    assert_eq!(done[0], ("Gripped".to_owned(), true.into()));
    let failed = grasp.outcome(&answer(-52), "result.", &none).unwrap_err();
    assert_eq!(failed, "said (status is -52)");
    let mut plain = driver(&component, 4);
    plain.work.succeeds.clear();
    let no = SpaceAnswer::of(vec![("success".to_owned(), false.into())]);
    assert_eq!(
        plain.outcome(&no, "", &none),
        Err("success is false".to_owned())
    );
}

#[test]
fn the_examples_are_read_and_served() {
    for name in ["niryo-ned.yaml", "turtlebot3.yaml", "moveit-arm.yaml"] {
        let component = example(name);
        let mut asking = Asking::new();
        let made = with_drivers(&component, &mut asking, &mut Topics::default());
        let given = |skill: &skills::SkillSetup| matches!(skill.driver, DriverSetup::Given(_));
        assert!(made.skills.iter().all(given), "{name}");
    }
}
