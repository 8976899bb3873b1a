mod facts;
mod tools;

use std::time::Duration;

use skills::ParameterType;

use self::facts::{KNOWN, Known, Mounted, Preferring};
use super::*;
use crate::process::{GivenParameter, ProcessStep, ResultOf, StepJob};

const GRASP: &str = "urn:example:capability:grasp";
const RELEASE: &str = "urn:example:capability:release";
const MOVE: &str = "urn:example:capability:move";

fn need(role: SkillRole, capability: &str) -> Need {
    Need {
        role,
        capability: Some(capability.into()),
        skill_type: role.skill_type(),
    }
}

#[test]
fn reach_attached_tools_and_the_rules_of_the_user_decide_with_a_reason_for_each() {
    let offers = [
        robot("a-short"),
        robot("short"),
        robot("b-robot"),
        gripper("fingers"),
        gripper("vacuum"),
    ]
    .concat();
    let planned = |attached, prefer: &[&str]| {
        let facts = Preferring {
            attached,
            prefer: prefer
                .iter()
                .map(|name| format!("urn:example:{name}"))
                .collect(),
        };
        super::plan(&process(), &offers, Situation::default(), &facts)
    };
    let plain = planned("", &[]);
    assert_eq!(
        plain.chosen(SkillRole::Ptp),
        Some("urn:example:a-short#Ptp")
    );
    assert_eq!(
        plain.chosen(SkillRole::Grasp),
        Some("urn:example:fingers#Grasp")
    );
    assert_eq!(
        why(&plain, SkillRole::Ptp, "short#Ptp"),
        "1.000, 1.000, 1.000 m is 1.732 m from its base, and it reaches 0.5 m"
    );
    let ruled = planned("", &["short", "b-robot", "vacuum"]);
    assert_eq!(
        ruled.chosen(SkillRole::Ptp),
        Some("urn:example:b-robot#Ptp")
    );
    assert_eq!(
        ruled.chosen(SkillRole::Grasp),
        Some("urn:example:vacuum#Grasp")
    );
    assert_eq!(
        why(&ruled, SkillRole::Linear, "a-short#Lin"),
        "it would fit, but b-robot.Lin is preferred"
    );
    let attached = planned("fingers", &["vacuum"]);
    assert_eq!(
        attached.chosen(SkillRole::Grasp),
        Some("urn:example:fingers#Grasp")
    );
    assert_eq!(
        why(&attached, SkillRole::Release, "vacuum#Release"),
        "it would fit, but fingers.Release is attached to a robot"
    );
}

#[test]
fn a_robot_and_a_gripper_that_are_not_attached_to_each_other_do_no_work_together() {
    let offers = [
        robot("a-robot"),
        robot("b-robot"),
        gripper("a-fingers"),
        gripper("vacuum"),
    ]
    .concat();
    let planned = |pairs| {
        let facts = Mounted(pairs);
        super::plan(&process(), &offers, Situation::default(), &facts)
    };
    let chosen = |plan: &Plan| {
        [SkillRole::Linear, SkillRole::Release].map(|role| plan.chosen(role).map(str::to_owned))
    };
    let of = |robot: &str, gripper: &str| {
        [format!("{robot}#Lin"), format!("{gripper}#Release")]
            .map(|skill| Some(format!("urn:example:{skill}")))
    };
    let both = planned(&[("a-robot", "vacuum"), ("b-robot", "a-fingers")]);
    assert_eq!(chosen(&both), of("a-robot", "vacuum"));
    assert_eq!(
        why(&both, SkillRole::Grasp, "a-fingers#Grasp"),
        "no tool is attached to the changer of a-robot"
    );
    // The robot without a gripper is not chosen, although its name comes first.
    let one = planned(&[("b-robot", "a-fingers")]);
    assert_eq!(chosen(&one), of("b-robot", "a-fingers"));
    assert_eq!(
        why(&one, SkillRole::Ptp, "a-robot#Ptp"),
        "no tool is attached to the changer of a-robot"
    );
    assert!(!planned(&[]).is_complete());
}

fn situation(fallen: &[Fallen]) -> Situation<'_> {
    Situation {
        fallen,
        ..Situation::default()
    }
}

fn plan(process: &Process, offers: &[Offer], fallen: &[Fallen]) -> Plan {
    super::plan(process, offers, situation(fallen), &KNOWN)
}

/// A process that picks a part and places it.
fn process() -> Process {
    let moves = || [need(SkillRole::Ptp, MOVE), need(SkillRole::Linear, MOVE)];
    let step = |name: &str, last| ProcessStep {
        name: name.into(),
        needs: moves().into_iter().chain([last]).collect(),
        ..ProcessStep::default()
    };
    Process {
        iri: "urn:example:process:move-part".into(),
        name: "Move a part".into(),
        work: StepJob::PickAndPlace(skills::Job {
            pick: [0.0; 6],
            place: [1.0; 6],
            approach: 0.05,
            shape: None,
        }),
        steps: vec![
            step("pick", need(SkillRole::Grasp, GRASP)),
            step("place", need(SkillRole::Release, RELEASE)),
        ],
        loops: vec![],
        within: Duration::from_secs(30),
        wait: Duration::from_secs(30),
    }
}

fn offer(component: &str, name: &str, types: &[&str], capabilities: &[&str]) -> Offer {
    Offer {
        is_skill: true,
        component: format!("urn:example:{component}"),
        skill: format!("urn:example:{component}#{name}"),
        component_name: component.into(),
        name: name.into(),
        types: types
            .iter()
            .map(|name| {
                if name.contains('=') {
                    (*name).to_owned()
                } else {
                    ParameterType::own(name).to_string()
                }
            })
            .collect(),
        capabilities: capabilities.iter().map(|class| (*class).into()).collect(),
        closure: capabilities.iter().map(|class| (*class).into()).collect(),
        endpoint: "opc.tcp://127.0.0.1:1".into(),
        node: "nsu=urn:x;i=100".into(),
        since_ms: 10,
    }
}

fn robot(name: &str) -> Vec<Offer> {
    vec![
        offer(name, "Ptp", &["PtpMoveSkillType", "SkillType"], &[MOVE]),
        offer(name, "Lin", &["LinearMoveSkillType", "SkillType"], &[MOVE]),
    ]
}

fn gripper(name: &str) -> Vec<Offer> {
    vec![
        offer(name, "Grasp", &["GraspSkillType", "SkillType"], &[GRASP]),
        offer(
            name,
            "Release",
            &["ReleaseSkillType", "SkillType"],
            &[RELEASE],
        ),
    ]
}

fn why<'a>(plan: &'a Plan, role: SkillRole, skill: &str) -> &'a str {
    let (_, need) = plan.needs().find(|(_, need)| need.role_is == role).unwrap();
    let skill = format!("urn:example:{skill}");
    need.candidates
        .iter()
        .find(|candidate| candidate.skill == skill)
        .map_or("not looked at", |candidate| &candidate.why)
}

#[test]
fn each_role_is_filled_by_capability_and_type() {
    let offers = [robot("robot"), gripper("gripper")].concat();
    let plan = plan(&process(), &offers, &[]);
    assert!(plan.is_complete(), "{}", plan.missing());
    let chosen: Vec<_> = SkillRole::OF_COMPOSITE
        .iter()
        .map(|role| plan.chosen(*role).unwrap())
        .collect();
    assert_eq!(
        chosen,
        [
            "urn:example:robot#Ptp",
            "urn:example:robot#Lin",
            "urn:example:gripper#Grasp",
            "urn:example:gripper#Release"
        ]
    );
    assert_eq!(
        why(&plan, SkillRole::Ptp, "robot#Lin"),
        "its type is not nsu=urn:ua-bridge:skills;PtpMoveSkillType or below it"
    );
    assert_eq!(
        why(&plan, SkillRole::Grasp, "gripper#Grasp"),
        "it realises urn:example:capability:grasp, its type is GraspSkillType or below it"
    );
    assert_eq!(why(&plan, SkillRole::Grasp, "robot#Ptp"), "not looked at");
}

#[test]
fn a_type_never_seen_fits_by_its_supertype_and_a_capability_by_its_superclass() {
    let mut vacuum = gripper("vacuum");
    vacuum[0].types.insert(0, "nsu=urn:vendor;SuckType".into());
    vacuum[0].capabilities = vec!["urn:example:capability:suck".into()];
    vacuum[0].closure = vec!["urn:example:capability:suck".into(), GRASP.into()];
    let offers = [robot("robot"), vacuum].concat();
    let plan = plan(&process(), &offers, &[]);
    assert_eq!(
        plan.chosen(SkillRole::Grasp),
        Some("urn:example:vacuum#Grasp")
    );
    assert!(
        why(&plan, SkillRole::Grasp, "vacuum#Grasp")
            .contains("urn:example:capability:suck, which is below urn:example:capability:grasp")
    );
}

#[test]
fn one_component_fills_all_roles_of_its_group() {
    // The first gripper can only grasp, the second can only release, and the third can do both.
    let grasps = gripper("a-grasps").into_iter().take(1).collect();
    let releases = gripper("a-releases").into_iter().skip(1).collect();
    let offers = [robot("robot"), grasps, releases, gripper("gripper")].concat();
    let both = plan(&process(), &offers, &[]);
    assert_eq!(
        (
            both.chosen(SkillRole::Grasp),
            both.chosen(SkillRole::Release)
        ),
        (
            Some("urn:example:gripper#Grasp"),
            Some("urn:example:gripper#Release")
        )
    );
    assert_eq!(
        why(&both, SkillRole::Grasp, "a-grasps#Grasp"),
        "it would fit, but its component has nothing for release"
    );
    let without = plan(&process(), &offers[..4], &[]);
    assert!(!without.is_complete());
    assert!(without.missing().contains("pick needs urn:example:capability:grasp by a skill of nsu=urn:ua-bridge:skills;GraspSkillType for grasp (a-grasps.Grasp: it would fit, but its component has nothing for release)"), "{}", without.missing());
}

#[test]
fn of_several_the_one_that_is_there_longest_is_taken_and_a_name_before_a_subclass() {
    let mut young = gripper("a-young");
    young.iter_mut().for_each(|offer| offer.since_ms = 20);
    let mut old_by_subclass = gripper("old");
    for offer in &mut old_by_subclass {
        offer.since_ms = 1;
        offer.closure.append(&mut offer.capabilities);
        offer.capabilities = vec!["urn:example:capability:below".into()];
    }
    let offers = [
        robot("robot"),
        young.clone(),
        gripper("gripper"),
        old_by_subclass.clone(),
    ]
    .concat();
    let three = plan(&process(), &offers, &[]);
    assert_eq!(
        three.chosen(SkillRole::Grasp),
        Some("urn:example:gripper#Grasp")
    );
    assert_eq!(
        why(&three, SkillRole::Grasp, "a-young#Grasp"),
        "it would fit, but gripper.Grasp has been there for longer"
    );
    assert_eq!(
        why(&three, SkillRole::Grasp, "old#Grasp"),
        "it would fit, but gripper.Grasp is of just this capability"
    );
    let reversed: Vec<_> = offers.into_iter().rev().collect();
    assert_eq!(
        plan(&process(), &reversed, &[]).chosen(SkillRole::Grasp),
        Some("urn:example:gripper#Grasp"),
        "whatever the order"
    );
}

#[test]
fn what_was_lost_is_not_chosen_until_it_comes_anew() {
    let offers = [robot("robot"), gripper("gripper")].concat();
    let lost = [Fallen {
        component: "urn:example:gripper".into(),
        since_ms: 10,
        skill: None,
        why: "it was lost in plan 1".into(),
    }];
    let without = plan(&process(), &offers, &lost);
    assert_eq!(
        (
            without.is_complete(),
            without.chosen(SkillRole::Grasp),
            without.chosen(SkillRole::Ptp)
        ),
        (false, None, Some("urn:example:robot#Ptp"))
    );
    assert_eq!(
        why(&without, SkillRole::Release, "gripper#Release"),
        "it was lost in plan 1"
    );
    let with_another = [offers.clone(), gripper("vacuum")].concat();
    assert_eq!(
        plan(&process(), &with_another, &lost).chosen(SkillRole::Grasp),
        Some("urn:example:vacuum#Grasp")
    );
    let mut anew = offers;
    anew.iter_mut().for_each(|offer| offer.since_ms = 30);
    assert!(plan(&process(), &anew, &lost).is_complete());
}

#[test]
fn one_skill_that_failed_leaves_the_others_of_its_component() {
    let mut two_hands = gripper("gripper");
    two_hands.push(offer("gripper", "Hold", &["GraspSkillType"], &[GRASP]));
    let offers = [robot("robot"), two_hands].concat();
    let failed = [Fallen {
        component: "urn:example:gripper".into(),
        since_ms: 10,
        skill: Some("urn:example:gripper#Grasp".into()),
        why: "it failed".into(),
    }];
    assert_eq!(
        plan(&process(), &offers, &failed).chosen(SkillRole::Grasp),
        Some("urn:example:gripper#Hold")
    );
}

#[test]
fn a_service_of_a_module_is_told_and_not_chosen() {
    let mut dose = offer("dosing", "Dose", &[], &[GRASP]);
    dose.is_skill = false;
    let offers = [robot("robot"), vec![dose]].concat();
    let plan = plan(&process(), &offers, &[]);
    assert_eq!(
        why(&plan, SkillRole::Grasp, "dosing#Dose"),
        "it is a service in a manifest; `ua-component` with `device: {mtp: ..}` runs it as a skill"
    );
    assert!(!plan.is_complete());
}

#[test]
fn nothing_there_is_told_as_that() {
    let empty = plan(&process(), &[], &[]);
    assert!(empty.missing().starts_with("pick needs urn:example:capability:move by a skill of nsu=urn:ua-bridge:skills;PtpMoveSkillType for ptp (there is none)"), "{}", empty.missing());
}

fn sequence(capabilities: &[&str]) -> Process {
    let steps = capabilities.iter().enumerate();
    let alone = |(number, capability): (usize, &&str)| ProcessStep {
        name: format!("step {number}"),
        needs: vec![Need {
            role: SkillRole::Alone(number),
            capability: Some((*capability).into()),
            skill_type: None,
        }],
        ..ProcessStep::default()
    };
    Process {
        steps: steps.map(alone).collect(),
        work: StepJob::Sequence,
        ..process()
    }
}

fn chosen(plan: &Plan, steps: usize) -> Vec<&str> {
    let chosen = |number| plan.chosen(SkillRole::Alone(number)).unwrap_or("none");
    (0..steps)
        .map(|number| chosen(number).trim_start_matches("urn:example:"))
        .collect()
}

#[test]
fn steps_without_a_composite_may_be_done_by_different_components() {
    let offers = [robot("robot"), gripper("gripper")].concat();
    let plan = plan(&sequence(&[GRASP, MOVE]), &offers, &[]);
    assert_eq!(chosen(&plan, 2), ["gripper#Grasp", "robot#Lin"]);
}

/// A gripper whose grasp has a capability of its own below the capability of all grippers.
fn vacuum(name: &str) -> Vec<Offer> {
    let mut vacuum = gripper(name);
    vacuum[0].capabilities = vec![SUCK.into()];
    vacuum[0].closure = vec![SUCK.into(), GRASP.into()];
    vacuum
}

const SUCK: &str = "urn:example:capability:suck";

#[test]
fn the_component_that_grasped_releases() {
    // Both grippers can release, and the finger gripper comes first by its name.
    let offers = [gripper("finger"), robot("robot"), vacuum("vacuum")].concat();
    let by_vacuum = plan(&sequence(&[SUCK, MOVE, RELEASE]), &offers, &[]);
    let expected = ["vacuum#Grasp", "robot#Lin", "vacuum#Release"];
    assert_eq!(chosen(&by_vacuum, 3), expected);
    // Two parts in two grippers are released in the reverse order.
    let two = plan(&sequence(&[SUCK, GRASP, RELEASE, RELEASE]), &offers, &[]);
    let expected = [
        "vacuum#Grasp",
        "finger#Grasp",
        "finger#Release",
        "vacuum#Release",
    ];
    assert_eq!(chosen(&two, 4), expected);
    // A gripper that cannot release does not grasp.
    let only_grasps = vacuum("vacuum").into_iter().take(1).collect();
    let offers = [gripper("finger"), only_grasps].concat();
    let none = plan(&sequence(&[SUCK, RELEASE]), &offers, &[]);
    assert!(!none.is_complete());
    let expected = "its component has nothing for the step `step 1`";
    assert!(none.missing().contains(expected), "{}", none.missing());
}

#[test]
fn a_step_is_done_by_the_component_of_another_step_if_the_process_says_so() {
    let offers = [gripper("finger"), vacuum("vacuum")].concat();
    let mut process = sequence(&[SUCK, GRASP, RELEASE, RELEASE]);
    process.steps[2].by = By::SameAs(0);
    let expected = [
        "vacuum#Grasp",
        "finger#Grasp",
        "vacuum#Release",
        "finger#Release",
    ];
    assert_eq!(chosen(&plan(&process, &offers, &[]), 4), expected);
}

#[test]
fn the_attached_tool_does_what_it_can() {
    let change = offer(
        "changer",
        "Change",
        &["ChangeToolSkillType"],
        &["urn:change"],
    );
    let offers = [
        vec![change],
        gripper("finger"),
        robot("robot"),
        gripper("vacuum"),
    ]
    .concat();
    let mut process = sequence(&["urn:change", GRASP, MOVE, RELEASE]);
    process.steps[0].parameters = vec![GivenParameter {
        name: "ToolAppUri".into(),
        value: "urn:example:vacuum".into(),
        unit: None,
        result: None,
        query: None,
    }];
    let attached = plan(&process, &offers, &[]);
    let expected = [
        "changer#Change",
        "vacuum#Grasp",
        "robot#Lin",
        "vacuum#Release",
    ];
    assert_eq!(chosen(&attached, 4), expected);
    assert_eq!(
        why(&attached, SkillRole::Alone(1), "finger#Grasp"),
        "it is not of the tool urn:example:vacuum, which the step `step 0` attaches"
    );
    // A tool that is not there is waited for, if the process says that it does the step.
    process.steps[0].parameters[0].value = "urn:example:absent".into();
    process.steps[1].by = By::AttachedTool;
    assert!(!plan(&process, &offers, &[]).is_complete());
    process.steps.remove(0);
    process
        .steps
        .iter_mut()
        .zip(0..)
        .for_each(|(step, number)| {
            step.needs[0].role = SkillRole::Alone(number);
        });
    let without = plan(&process, &offers, &[]);
    let expected = "no step before it attaches a tool";
    assert!(
        without.missing().contains(expected),
        "{}",
        without.missing()
    );
}

#[test]
fn a_skill_that_cannot_take_the_parameters_of_a_step_is_not_chosen() {
    let offers = [gripper("finger"), gripper("vacuum")].concat();
    let process = sequence(&[GRASP, RELEASE]);
    let known = Known {
        refuses: ("finger", "step 1"),
    };
    let two = super::plan(&process, &offers, Situation::default(), &known);
    assert_eq!(chosen(&two, 2), ["vacuum#Grasp", "vacuum#Release"]);
    let one = super::plan(&process, &offers[..2], Situation::default(), &known);
    assert!(!one.is_complete());
    let expected = "finger.Release: Release has no parameter Nonsense";
    assert!(one.missing().contains(expected), "{}", one.missing());
}

/// A parameter that is a result of a step.
fn result_of(step: usize, name: &str, parameter: &str) -> GivenParameter {
    GivenParameter {
        name: parameter.into(),
        value: serde_json::Value::Null,
        unit: None,
        result: Some(ResultOf {
            step,
            name: name.into(),
        }),
        query: None,
    }
}

#[test]
fn a_skill_without_the_result_that_a_later_step_takes_is_not_chosen() {
    let mut plain = gripper("a-plain");
    plain[0].name = "Hold".into();
    let offers = [plain, gripper("gripper")].concat();
    let mut process = sequence(&[GRASP, RELEASE]);
    process.steps[1].parameters = vec![result_of(0, "GraspWidth", "Width")];
    let found = plan(&process, &offers, &[]);
    assert_eq!(chosen(&found, 2), ["gripper#Grasp", "gripper#Release"]);
    let expected = "Hold has no result GraspWidth; it has none";
    assert_eq!(why(&found, SkillRole::Alone(0), "a-plain#Grasp"), expected);
    // A result of another type is a reason too.
    process.steps[1].parameters[0].name = "Text".into();
    let found = plan(&process, &offers, &[]);
    assert!(!found.is_complete());
    let expected = "Text: GraspWidth is a number, and a text is expected";
    assert_eq!(
        why(&found, SkillRole::Alone(1), "gripper#Release"),
        expected
    );
}

/// The compensation of the step with a number in a process of two steps.
fn compensation(number: usize, capability: &str) -> Option<Box<ProcessStep>> {
    let role = SkillRole::Alone(2 + number);
    let need = Need {
        role,
        capability: Some(capability.into()),
        skill_type: None,
    };
    Some(Box::new(ProcessStep {
        name: format!("compensation of step {number}"),
        needs: vec![need],
        by: By::SameAs(number),
        ..ProcessStep::default()
    }))
}

#[test]
fn a_component_that_cannot_undo_its_step_is_not_chosen() {
    let grasps = gripper("a-grasps").into_iter().take(1).collect();
    let offers = [grasps, gripper("gripper"), robot("robot")].concat();
    let mut process = sequence(&[GRASP, MOVE]);
    let without = plan(&process, &offers, &[]);
    assert_eq!(chosen(&without, 1), ["a-grasps#Grasp"]);
    process.steps[0].compensation = compensation(0, RELEASE);
    let with = plan(&process, &offers, &[]);
    assert!(with.is_complete(), "{}", with.missing());
    assert_eq!(
        chosen(&with, 3),
        ["gripper#Grasp", "robot#Lin", "gripper#Release"]
    );
    let expected =
        "it would fit, but its component has nothing for the step `compensation of step 0`";
    assert_eq!(why(&with, SkillRole::Alone(0), "a-grasps#Grasp"), expected);
}

#[test]
fn a_step_that_is_done_keeps_its_component_in_the_next_plan() {
    let offers = [gripper("a"), gripper("b"), robot("robot")].concat();
    let process = sequence(&[GRASP, MOVE, RELEASE]);
    let kept = [KeptStep {
        number: 0,
        offer: offers[2].clone(),
    }];
    let with = |offers: &[Offer]| {
        let situation = Situation {
            kept: &kept,
            ..Situation::default()
        };
        super::plan(&process, offers, situation, &KNOWN)
    };
    let next = with(&offers);
    assert_eq!(chosen(&next, 3), ["b#Grasp", "robot#Lin", "b#Release"]);
    let expected = "b has done the step `step 0`, and has to do this one too";
    assert_eq!(why(&next, SkillRole::Alone(2), "a#Release"), expected);
    // The component was lost meanwhile, and may not hold the part any more.
    let mut anew = offers.clone();
    anew[2].since_ms = 99;
    anew[3].since_ms = 99;
    let next = with(&anew);
    assert_eq!(chosen(&next, 3), ["b#Grasp", "robot#Lin", "none"]);
    assert!(!next.is_complete() && next.is_hopeless());
    let expected = "its component was lost after it had done the step `step 0`";
    assert_eq!(why(&next, SkillRole::Alone(2), "b#Release"), expected);
    // A missing robot may come.
    let next = with(&offers[..4]);
    assert!(!next.is_complete() && !next.is_hopeless());
}

#[test]
fn a_component_that_another_run_uses_is_not_chosen_and_an_attached_tool_stays_attached() {
    let offers = [gripper("a"), gripper("b")].concat();
    let used = BTreeMap::from([("urn:example:a".to_owned(), "urn:run:1".to_owned())]);
    let with = |process: &Process| {
        let situation = Situation {
            used: Some(&used),
            ..Situation::default()
        };
        super::plan(process, &offers, situation, &KNOWN)
    };
    let found = with(&sequence(&[GRASP, RELEASE]));
    assert_eq!(chosen(&found, 2), ["b#Grasp", "b#Release"]);
    let expected = "it would fit, but the run urn:run:1 uses its component";
    assert_eq!(why(&found, SkillRole::Alone(0), "a#Grasp"), expected);
    let mut process = sequence(&["urn:change", GRASP]);
    process.steps[0].needs[0].skill_type = Some(ParameterType::own("ChangeToolSkillType"));
    process.steps[0].parameters = vec![GivenParameter {
        name: "ToolAppUri".into(),
        value: "urn:example:a".into(),
        unit: None,
        result: None,
        query: None,
    }];
    let found = with(&process);
    assert_eq!(
        chosen(&found, 2)[1],
        "none",
        "the other gripper is not attached"
    );
}
