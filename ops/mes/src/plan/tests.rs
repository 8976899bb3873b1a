use std::time::Duration;

use skills::TypeName;

use super::*;
use crate::process::{Job, Step};

const GRASP: &str = "urn:example:capability:grasp";
const RELEASE: &str = "urn:example:capability:release";
const MOVE: &str = "urn:example:capability:move";

fn need(role: Role, capability: &str) -> Need {
    Need {
        role,
        capability: Some(capability.into()),
        skill_type: role.skill_type(),
    }
}

/// A process that picks a part and places it.
fn process() -> Process {
    let moves = || [need(Role::Ptp, MOVE), need(Role::Linear, MOVE)];
    let step = |name: &str, last| Step {
        name: name.into(),
        needs: moves().into_iter().chain([last]).collect(),
    };
    Process {
        iri: "urn:example:process:move-part".into(),
        name: "Move a part".into(),
        work: Job::PickAndPlace(skills::Job {
            pick: [0.0; 6],
            place: [1.0; 6],
            approach: 0.05,
            shape: None,
        }),
        steps: vec![
            step("pick", need(Role::Grasp, GRASP)),
            step("place", need(Role::Release, RELEASE)),
        ],
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
                    TypeName::own(name).to_string()
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

fn why<'a>(plan: &'a Plan, role: Role, skill: &str) -> &'a str {
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
    let chosen: Vec<_> = Role::OF_COMPOSITE
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
        why(&plan, Role::Ptp, "robot#Lin"),
        "its type is not nsu=urn:ua-bridge:skills;PtpMoveSkillType or below it"
    );
    assert_eq!(
        why(&plan, Role::Grasp, "gripper#Grasp"),
        "it realises urn:example:capability:grasp, its type is GraspSkillType or below it"
    );
    assert_eq!(why(&plan, Role::Grasp, "robot#Ptp"), "not looked at");
}

#[test]
fn a_type_never_seen_fits_by_its_supertype_and_a_capability_by_its_superclass() {
    let mut vacuum = gripper("vacuum");
    vacuum[0].types.insert(0, "nsu=urn:vendor;SuckType".into());
    vacuum[0].capabilities = vec!["urn:example:capability:suck".into()];
    vacuum[0].closure = vec!["urn:example:capability:suck".into(), GRASP.into()];
    let offers = [robot("robot"), vacuum].concat();
    let plan = plan(&process(), &offers, &[]);
    assert_eq!(plan.chosen(Role::Grasp), Some("urn:example:vacuum#Grasp"));
    assert!(
        why(&plan, Role::Grasp, "vacuum#Grasp")
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
        (both.chosen(Role::Grasp), both.chosen(Role::Release)),
        (
            Some("urn:example:gripper#Grasp"),
            Some("urn:example:gripper#Release")
        )
    );
    assert_eq!(
        why(&both, Role::Grasp, "a-grasps#Grasp"),
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
    assert_eq!(three.chosen(Role::Grasp), Some("urn:example:gripper#Grasp"));
    assert_eq!(
        why(&three, Role::Grasp, "a-young#Grasp"),
        "it would fit, but gripper.Grasp has been there for longer"
    );
    assert_eq!(
        why(&three, Role::Grasp, "old#Grasp"),
        "it would fit, but gripper.Grasp is of just this capability"
    );
    let reversed: Vec<_> = offers.into_iter().rev().collect();
    assert_eq!(
        plan(&process(), &reversed, &[]).chosen(Role::Grasp),
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
            without.chosen(Role::Grasp),
            without.chosen(Role::Ptp)
        ),
        (false, None, Some("urn:example:robot#Ptp"))
    );
    assert_eq!(
        why(&without, Role::Release, "gripper#Release"),
        "it was lost in plan 1"
    );
    let with_another = [offers.clone(), gripper("vacuum")].concat();
    assert_eq!(
        plan(&process(), &with_another, &lost).chosen(Role::Grasp),
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
        plan(&process(), &offers, &failed).chosen(Role::Grasp),
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
        why(&plan, Role::Grasp, "dosing#Dose"),
        "it is a service of a module, and those are not run from here"
    );
    assert!(!plan.is_complete());
}

#[test]
fn nothing_there_is_told_as_that() {
    let empty = plan(&process(), &[], &[]);
    assert!(empty.missing().starts_with("pick needs urn:example:capability:move by a skill of nsu=urn:ua-bridge:skills;PtpMoveSkillType for ptp (there is none)"), "{}", empty.missing());
}

#[test]
fn steps_without_a_composite_may_be_done_by_different_components() {
    let alone = |step: usize, capability: &str| Step {
        name: format!("step {step}"),
        needs: vec![Need {
            role: Role::Alone(step),
            capability: Some(capability.into()),
            skill_type: None,
        }],
    };
    let process = Process {
        steps: vec![alone(0, GRASP), alone(1, MOVE)],
        work: Job::Sequence(vec![vec![], vec![]]),
        ..process()
    };
    let plan = plan(
        &process,
        &[robot("robot"), gripper("gripper")].concat(),
        &[],
    );
    assert_eq!(
        (plan.chosen(Role::Alone(0)), plan.chosen(Role::Alone(1))),
        (
            Some("urn:example:gripper#Grasp"),
            Some("urn:example:robot#Lin")
        )
    );
}
