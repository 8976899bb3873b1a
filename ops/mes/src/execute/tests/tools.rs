//! The tools that steps attach and detach.

use super::*;
use crate::process::{BadEnd, Compare, Loop, StepCondition, Test};

const OTHER: &str = "urn:example:other";

fn named(tool: &str) -> GivenParameter {
    GivenParameter {
        name: "ToolAppUri".into(),
        value: tool.into(),
        unit: None,
        result: None,
        query: None,
    }
}

fn attach(number: usize, name: &str, tool: &str) -> ProcessStep {
    ProcessStep {
        parameters: vec![named(tool)],
        ..alone(number, name, "ChangeToolSkillType")
    }
}

/// A grasp by the attached tool.
fn grasp(number: usize) -> ProcessStep {
    ProcessStep {
        by: By::AttachedTool,
        ..alone(number, "grasp", "GraspSkillType")
    }
}

fn runs(compare: Compare, count: i32, is_negated: bool) -> Vec<Vec<StepCondition>> {
    vec![vec![StepCondition {
        step: 0,
        test: Test::Result {
            name: "Runs".into(),
            compare,
            value: count.into(),
        },
        is_negated,
    }]]
}

/// A sequence that counts first.
fn sequence(steps: Vec<ProcessStep>) -> Process {
    let count = alone(0, "count", "CountType");
    Process {
        work: StepJob::Sequence,
        steps: std::iter::once(count).chain(steps).collect(),
        ..process()
    }
}

/// A changer and two grippers.
fn changing() -> Fakes {
    let mut offers = [gripper("gripper"), gripper("other")].concat();
    offers.push(offer("one", "Count", "CountType"));
    offers.push(offer("changer", "Change", "ChangeToolSkillType"));
    offers.push(offer("changer", "Detach", "DetachToolSkillType"));
    offers.push(offer("changer", "Swap", "SwapType"));
    offers.push(offer("one", "Find", "FindType"));
    plant(offers)
}

fn ran(fakes: &Fakes) -> Vec<String> {
    let mut journal = fakes.journal.lock().unwrap().clone();
    journal.retain(|line| line != "closed");
    journal
}

#[tokio::test]
async fn a_step_is_done_by_the_tool_that_conditional_steps_have_attached() {
    for by in [By::Any, By::AttachedTool] {
        for (compare, expected) in [
            (Compare::Equal, "gripper.Grasp"),
            (Compare::Greater, "other.Grasp"),
        ] {
            let mut process = sequence(vec![
                attach(1, "attach", OTHER),
                attach(2, "attach another", GRIPPER),
                ProcessStep { by, ..grasp(3) },
            ]);
            process.steps[2].when = runs(compare, 1, false);
            let (run, fakes, _) = executed(changing(), &process).await;
            assert_eq!((run.outcome, &run.reason), (How::Done, &None));
            assert_eq!(ran(&fakes).last().map(String::as_str), Some(expected));
        }
    }
}

#[tokio::test]
async fn each_alternative_has_a_tool_and_steps_of_its_own() {
    for (compare, expected) in [
        (Compare::Equal, ["changer.Change 1", "gripper.Grasp"]),
        (Compare::Greater, ["changer.Change 1", "other.Grasp"]),
    ] {
        // Only the tool of each alternative can do its steps.
        let own = |number, of: &str| ProcessStep {
            by: By::AttachedTool,
            ..alone(number, of, of)
        };
        let mut process = sequence(vec![
            attach(1, "one", GRIPPER),
            attach(2, "two", OTHER),
            own(3, "SuckType"),
            own(4, "HoldType"),
            grasp(5),
        ]);
        for (number, is_negated) in [(1, false), (2, true), (3, false), (4, true)] {
            process.steps[number].when = runs(compare, 1, is_negated);
        }
        let fakes = changing();
        let more = [
            offer("gripper", "Suck", "SuckType"),
            offer("other", "Hold", "HoldType"),
        ];
        fakes.offers.lock().unwrap().extend(more);
        let (run, fakes, _) = executed(fakes, &process).await;
        assert_eq!((run.outcome, &run.reason), (How::Done, &None));
        let ran = ran(&fakes);
        assert_eq!([&*ran[1], &*ran[3]], expected, "{ran:?}");
    }
}

#[tokio::test]
async fn each_round_of_a_loop_uses_the_tool_that_is_attached_then() {
    let mut process = sequence(vec![
        attach(1, "attach", GRIPPER),
        grasp(2),
        alone(3, "count again", "CountType"),
        attach(4, "change", OTHER),
    ]);
    let mut again = runs(Compare::Less, 3, false);
    again[0][0].step = 3;
    process.loops = vec![Loop {
        steps: [2, 3, 4].into(),
        again,
        rounds: 5,
    }];
    let (run, fakes, _) = executed(changing(), &process).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    let mut grasps = ran(&fakes);
    grasps.retain(|line| line.ends_with("Grasp"));
    assert_eq!(grasps, ["gripper.Grasp", "other.Grasp"]);
}

#[tokio::test]
async fn the_tool_that_a_result_names_does_the_later_steps() {
    let mut find = attach(2, "attach", "");
    find.parameters[0].value = serde_json::Value::Null;
    find.parameters[0].result = Some(ResultOf {
        step: 1,
        name: "Tool".into(),
    });
    for by in [By::Any, By::AttachedTool] {
        let steps = vec![
            alone(1, "find", "FindType"),
            find.clone(),
            ProcessStep { by, ..grasp(3) },
        ];
        let (run, fakes, _) = executed(changing(), &sequence(steps)).await;
        assert_eq!((run.outcome, &run.reason), (How::Done, &None));
        assert_eq!(ran(&fakes)[2..], ["changer.Change 1", "other.Grasp"]);
    }
}

#[tokio::test]
async fn the_tool_that_a_skill_reports_is_the_attached_one() {
    let mut fakes = changing();
    let offers = fakes.offers.get_mut().unwrap();
    offers.retain(|offer| offer.name != "Change");
    let swap = offers
        .iter_mut()
        .find(|offer| offer.name == "Swap")
        .unwrap();
    let of = ParameterType::own("ChangeToolSkillType");
    swap.types = vec![of.to_string()];
    let process = sequence(vec![attach(1, "attach", GRIPPER), grasp(2)]);
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    // It names the gripper, and has attached the other one.
    assert_eq!(run.plans.len(), 2);
    assert_eq!(ran(&fakes)[1..], ["changer.Swap 1", "other.Grasp"]);
}

#[tokio::test]
async fn no_tool_is_used_after_its_step_failed() {
    for (by, expected) in [
        (
            By::AttachedTool,
            "the tool that the step `attach` attaches is not known",
        ),
        (
            By::Any,
            "it is not known whether this tool is attached after the step `attach`",
        ),
    ] {
        let mut handles = alone(2, "handle", "CountType");
        handles.when = vec![vec![StepCondition {
            step: 1,
            test: Test::Ended(BadEnd::Failed),
            is_negated: false,
        }]];
        let steps = vec![
            attach(1, "attach", GRIPPER),
            handles,
            ProcessStep { by, ..grasp(3) },
        ];
        let mut fakes = changing();
        fakes.fails_at = Some("changer.Change");
        // Another gripper is a component that can, but it is not the attached tool.
        let offers = fakes.offers.get_mut().unwrap();
        offers.retain(|offer| by == By::AttachedTool || offer.component_name != "other");
        let (run, fakes, _) = executed(fakes, &sequence(steps)).await;
        assert_eq!(run.outcome, How::Failed, "{run:?}");
        let reason = run.reason.unwrap();
        assert!(reason.contains(expected), "{reason}");
        assert_eq!(ran(&fakes), ["one.Count", "changer.Change 1", "one.Count"]);
    }
}

#[tokio::test]
async fn a_tool_that_is_detached_undoes_nothing() {
    let mut process = sequence(vec![
        attach(1, "attach", GRIPPER),
        grasp(2),
        attach(3, "change", OTHER),
        alone(4, "fail", "FailType"),
    ]);
    process.steps[2].compensation = undone_by(2, 5, "ReleaseSkillType");
    let mut fakes = changing();
    fakes
        .offers
        .get_mut()
        .unwrap()
        .push(offer("one", "Fail", "FailType"));
    fakes.fails_at = Some("one.Fail");
    let (run, fakes, _) = executed(fakes, &process).await;
    let reason = run.reason.unwrap();
    let expected =
        "the compensation of `grasp` failed: gripper: the step `change` detaches this tool";
    assert!(reason.contains(expected), "{reason}");
    assert_eq!(ran(&fakes).last().map(String::as_str), Some("one.Fail"));
}

#[tokio::test]
async fn a_tool_that_another_branch_detaches_finishes_its_step_first() {
    let branches = |grasps: usize| {
        let mut steps = [
            grasp(grasps),
            alone(5 - grasps, "detach", "DetachToolSkillType"),
        ];
        steps.sort_by_key(|step| step.needs[0].role);
        let [one, mut two] = steps;
        two.after = Some(vec![1]);
        sequence(vec![attach(1, "attach", GRIPPER), one, two])
    };
    let (run, fakes, _) = executed(changing(), &branches(2)).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    assert_eq!(ran(&fakes)[2..], ["gripper.Grasp", "changer.Detach"]);
    // The step that detaches the tool would come first.
    let (run, fakes, _) = executed(changing(), &branches(3)).await;
    assert_eq!(run.outcome, How::Failed);
    let reason = run.reason.unwrap();
    let expected = "the step `detach` detaches this tool at any time";
    assert!(reason.contains(expected), "{reason}");
    assert_eq!(ran(&fakes), Vec::<String>::new());
}

fn shown(tool: &str) -> ShownTools {
    ShownTools {
        attached: [("urn:example:changer".to_owned(), Some(tool.to_owned()))].into(),
        tools: [GRIPPER, OTHER].map(str::to_owned).into(),
    }
}

#[tokio::test]
async fn a_tool_whose_step_is_skipped_does_nothing() {
    for (compare, expected) in [
        (Compare::Equal, "gripper.Grasp"),
        (Compare::Greater, "other.Grasp"),
    ] {
        let grasp = ProcessStep {
            by: By::Any,
            ..grasp(2)
        };
        let mut process = sequence(vec![attach(1, "attach", GRIPPER), grasp]);
        process.steps[1].when = runs(compare, 1, false);
        let fakes = Fakes {
            tools: shown(OTHER),
            ..changing()
        };
        let (run, fakes, _) = executed(fakes, &process).await;
        assert_eq!((run.outcome, &run.reason), (How::Done, &None));
        assert_eq!(ran(&fakes).last().map(String::as_str), Some(expected));
    }
}

#[tokio::test]
async fn an_attached_tool_that_is_not_reported_is_not_known() {
    let mut fakes = changing();
    fakes.ends = Some((
        "changer.Change",
        Some(Ok(RunOutcome {
            succeeded: true,
            results: vec![("Tool".to_owned(), "".into())],
            ..failed("")
        })),
    ));
    let process = sequence(vec![attach(1, "attach", GRIPPER), grasp(2)]);
    let (run, _, _) = executed(fakes, &process).await;
    let reason = run.reason.unwrap();
    let expected = "the tool that the step `attach` attaches is not known";
    assert!(reason.contains(expected), "{reason}");
}

#[tokio::test]
async fn a_step_that_detaches_attaches_nothing() {
    let mut fakes = changing();
    fakes.ends = Some((
        "changer.Detach",
        Some(Ok(RunOutcome {
            succeeded: true,
            results: vec![("Tool".to_owned(), GRIPPER.into())],
            ..failed("")
        })),
    ));
    let process = sequence(vec![
        attach(1, "attach", GRIPPER),
        alone(2, "detach", "DetachToolSkillType"),
        ProcessStep {
            by: By::Any,
            ..grasp(3)
        },
    ]);
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    assert_eq!(ran(&fakes).last().map(String::as_str), Some("other.Grasp"));
}

#[tokio::test]
async fn a_tool_that_gets_its_power_when_it_is_attached_does_the_step() {
    let mut fakes = changing();
    let offers = fakes.offers.get_mut().unwrap();
    offers.retain(|offer| offer.component != GRIPPER);
    fakes.powers = Some(("changer.Change", gripper("gripper")));
    let grasp = ProcessStep {
        by: By::Any,
        ..grasp(2)
    };
    let process = sequence(vec![attach(1, "attach", GRIPPER), grasp]);
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    assert_eq!(ran(&fakes)[1..], ["changer.Change 1", "gripper.Grasp"]);
}

#[tokio::test]
async fn a_tool_that_another_run_uses_is_waited_for() {
    let mut fakes = changing();
    fakes
        .leases
        .get_mut()
        .unwrap()
        .insert(GRIPPER.to_owned(), "another run".to_owned());
    let process = sequence(vec![attach(1, "attach", GRIPPER)]);
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!(run.outcome, How::Failed);
    let reason = run.reason.unwrap();
    let expected = "the run another run uses urn:example:gripper";
    assert!(reason.contains(expected), "{reason}");
    assert_eq!(ran(&fakes), Vec::<String>::new());
}

#[tokio::test]
async fn a_robot_that_carries_a_changer_is_waited_for_while_another_run_uses_it() {
    let mut fakes = changing();
    let arm = "urn:example:arm";
    fakes.mover = Some(arm);
    let offers = fakes.offers.get_mut().unwrap();
    offers.push(offer("arm", "Ptp", "armType"));
    let leases = fakes.leases.get_mut().unwrap();
    leases.insert(arm.to_owned(), "another run".to_owned());
    // No step of the process uses the robot itself.
    let process = sequence(vec![attach(1, "attach", GRIPPER)]);
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!(run.outcome, How::Failed);
    let reason = run.reason.unwrap();
    let expected = "the run another run uses urn:example:arm";
    assert!(reason.contains(expected), "{reason}");
    assert_eq!(ran(&fakes), Vec::<String>::new());
}

#[tokio::test]
async fn a_changer_has_its_robot_alone_once_the_robot_has_ended_its_step() {
    for (mover, expected) in [
        (
            Some("urn:example:arm"),
            ["arm.Meet", "two.Meet", "arm released", "changer.Change 1"].as_slice(),
        ),
        (None, &["arm.Meet", "changer.Change 1", "two.Meet"]),
    ] {
        let mut fakes = changing();
        let offers = ["arm", "two"].map(|name| offer(name, "Meet", &format!("{name}Type")));
        fakes.offers.get_mut().unwrap().extend(offers);
        // The step of the arm ends after the last step has begun.
        fakes.meets = Some(Arc::new(tokio::sync::Barrier::new(2)));
        fakes.mover = mover;
        let mut steps = vec![
            alone(0, "move", "armType"),
            attach(1, "attach", GRIPPER),
            alone(2, "meet", "twoType"),
        ];
        for step in &mut steps {
            step.after = Some(vec![]);
        }
        let process = Process {
            work: StepJob::Sequence,
            steps,
            ..process()
        };
        let (run, fakes, _) = executed(fakes, &process).await;
        assert_eq!((run.outcome, &run.reason), (How::Done, &None));
        assert_eq!(ran(&fakes), expected);
    }
}

#[tokio::test]
async fn no_tool_is_waited_for_that_no_component_can_replace() {
    let mut handles = alone(2, "handle", "CountType");
    handles.when = vec![vec![StepCondition {
        step: 1,
        test: Test::Ended(BadEnd::Failed),
        is_negated: false,
    }]];
    let grasp = ProcessStep {
        by: By::Any,
        ..grasp(3)
    };
    let mut process = sequence(vec![attach(1, "attach", GRIPPER), handles, grasp]);
    // Longer than the time limit of the test.
    process.wait = Duration::from_secs(3600);
    let mut fakes = changing();
    fakes.fails_at = Some("changer.Change");
    let offers = fakes.offers.get_mut().unwrap();
    offers.retain(|offer| offer.component != OTHER);
    let (run, _, _) = executed(fakes, &process).await;
    let reason = run.reason.unwrap();
    let expected = "not known whether this tool is attached after the step `attach`";
    assert!(reason.contains(expected), "{reason}");
}

#[tokio::test]
async fn each_round_may_be_planned_for_another_tool() {
    let grasp = ProcessStep {
        by: By::Any,
        ..grasp(2)
    };
    let mut process = sequence(vec![attach(1, "attach", GRIPPER), grasp]);
    let failed_at = |step| StepCondition {
        step,
        test: Test::Ended(BadEnd::Failed),
        is_negated: false,
    };
    process.loops = vec![Loop {
        steps: [1, 2].into(),
        again: vec![vec![failed_at(1), failed_at(2)]],
        rounds: 3,
    }];
    let mut fakes = changing();
    fakes.fails_at = Some("changer.Change");
    fakes.ends = Some(("other.Grasp", Some(Ok(failed("nothing was gripped")))));
    let (run, _, _) = executed(fakes, &process).await;
    let reason = run.reason.unwrap();
    assert!(reason.contains("has had 3 rounds"), "{reason}");
}
