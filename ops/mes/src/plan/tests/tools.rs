//! Tools that steps attach.

use super::*;
use crate::process::StepCondition;

/// Changes the tool, grasps, moves and releases.
fn changing(tool: &str) -> Process {
    let mut process = sequence(&["urn:change", GRASP, MOVE, RELEASE]);
    process.steps[0].parameters = attached(tool);
    process
}

fn attached(tool: &str) -> Vec<GivenParameter> {
    vec![GivenParameter {
        name: TOOL.into(),
        value: tool.into(),
        unit: None,
        result: None,
        query: None,
    }]
}

fn offers() -> Vec<Offer> {
    let types = ["ChangeToolSkillType"];
    let change = offer("changer", "Change", &types, &["urn:change"]);
    let tools = [gripper("finger"), robot("robot"), gripper("vacuum")];
    std::iter::once(change).chain(tools.concat()).collect()
}

#[test]
fn the_attached_tool_does_what_it_can() {
    let offers = offers();
    let mut process = changing("urn:example:vacuum");
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
    for (step, number) in process.steps.iter_mut().zip(0..) {
        step.needs[0].role = SkillRole::Alone(number);
    }
    let without = plan(&process, &offers, &[]).missing();
    let expected = "no step before it attaches a tool";
    assert!(without.contains(expected), "{without}");
}

#[test]
fn a_tool_that_another_run_uses_stays_attached() {
    let used = BTreeMap::from([("urn:example:vacuum".to_owned(), "urn:run:1".to_owned())]);
    let situation = Situation {
        used: Some(&used),
        ..Situation::default()
    };
    let process = changing("urn:example:vacuum");
    let found = super::super::plan(&process, &offers(), situation, &KNOWN);
    let grasp = chosen(&found, 2)[1];
    assert_eq!(grasp, "none", "the other gripper is not attached");
}

#[test]
fn a_step_that_was_skipped_or_failed_attaches_no_tool() {
    // The second step attaches another tool, if its condition holds.
    let mut process = sequence(&["urn:change", "urn:change", GRASP]);
    process.steps[0].parameters = attached("urn:example:vacuum");
    process.steps[1].parameters = attached("urn:example:finger");
    process.steps[1].when = vec![vec![StepCondition {
        step: 0,
        test: crate::process::Test::Ended(BadEnd::Failed),
        is_negated: true,
    }]];
    process.steps[2].by = By::AttachedTool;
    let with = |passed: &[(usize, Passed)]| {
        let passed = passed.iter().copied().collect();
        let situation = Situation {
            passed: Some(&passed),
            ..Situation::default()
        };
        super::super::plan(&process, &offers(), situation, &KNOWN)
    };
    assert_eq!(chosen(&with(&[]), 3)[2], "finger#Grasp");
    let skipped = with(&[(1, Passed::Skipped)]);
    assert_eq!(chosen(&skipped, 3)[2], "vacuum#Grasp");
    let failed = with(&[(1, Passed::Ended(BadEnd::Failed))]);
    assert_eq!(chosen(&failed, 3)[2], "none", "the tool is unknown");
    let neither = with(&[(0, Passed::Skipped), (1, Passed::Skipped)]);
    let expected = "no step before it attaches a tool";
    assert!(
        neither.missing().contains(expected),
        "{}",
        neither.missing()
    );
}
