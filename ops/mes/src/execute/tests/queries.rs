//! Parameters that are given by queries.

use super::stops::StopAt;
use super::*;
use crate::process::{BadEnd, StepCondition, Test};

/// Returns a parameter that a query gives.
fn queried(name: &str, query: &str) -> Vec<GivenParameter> {
    vec![GivenParameter {
        name: name.into(),
        value: serde_json::Value::Null,
        unit: None,
        result: None,
        query: Some(ParameterQuery {
            name: query.into(),
            sparql: "SELECT ?w {}".into(),
        }),
    }]
}

/// Grasps with a width that a query gives.
fn by_query() -> Process {
    let mut process = grasps();
    process.steps[0].parameters = queried("Width", "grasp width");
    process
}

fn finding(found: &[Result<serde_json::Value, ValueQueryFault>]) -> Fakes {
    Fakes {
        found: Mutex::new(found.to_vec().into()),
        ..plant([gripper("gripper"), gripper("other")].concat())
    }
}

#[tokio::test]
async fn a_query_is_evaluated_for_the_plan_and_again_when_its_step_begins() {
    let found = [Ok(31.into()), Ok(32.into())];
    let (run, fakes, _) = executed(finding(&found), &by_query()).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    let journal = fakes.journal.lock().unwrap();
    assert_eq!(journal[0], "gripper.Grasp 1", "it has the parameter");
    assert!(
        fakes.found.lock().unwrap().is_empty(),
        "once for all skills of the plan"
    );
}

#[tokio::test]
async fn a_query_without_a_value_ends_the_run_before_its_step() {
    let fault = || {
        Err(ValueQueryFault::SeveralRows {
            first: "30".to_owned(),
            second: "31".to_owned(),
        })
    };
    let cases: [(&[_], usize); 2] = [(&[fault()], 0), (&[Ok(31.into()), fault()], 1)];
    for (found, plans) in cases {
        let (run, fakes, _) = executed(finding(found), &by_query()).await;
        assert_eq!((run.outcome, run.plans.len()), (How::Failed, plans));
        let reason = run.reason.unwrap();
        let expected = "step 0: Width (query `grasp width`): it has several rows";
        assert!(reason.contains(expected), "{reason}");
        let journal = fakes.journal.lock().unwrap();
        assert!(
            journal.iter().all(|line| line == "closed"),
            "nothing ran: {journal:?}"
        );
    }
}

#[tokio::test]
async fn a_dry_run_names_the_query_without_a_value() {
    let fakes = Arc::new(finding(&[Err(ValueQueryFault::NoRow)]));
    let plan = dry_run(&fakes, &by_query()).await;
    assert!(!plan.is_complete());
    let expected = "Width (query `grasp width`): it has no row";
    assert!(plan.missing().contains(expected), "{}", plan.missing());
}

/// Runs a process, and stops it when a query does not end and this step has run.
async fn stopped_in_query(fakes: Fakes, process: Process, other: Option<&str>) -> Vec<String> {
    let fakes = Arc::new(fakes);
    let as_plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let teller = StopAt("", watch::channel(false).0);
    let mut queries = fakes.silent_queries.subscribe();
    let stop = async {
        queries.wait_for(|queries| *queries > 0).await.unwrap();
        let has_run = |other: &str| {
            let kept = fakes.kept.lock().unwrap();
            let mut ran = kept.last().into_iter().flat_map(|run| &run.plans);
            ran.any(|plan| {
                plan.ran
                    .iter()
                    .any(|ran| ran.step == other && !ran.is_running())
            })
        };
        while other.is_some_and(|other| !has_run(other)) {
            tokio::task::yield_now().await;
        }
        teller.1.send_replace(true);
    };
    let both = async { tokio::join!(execute(&as_plant, &process, 1, &teller), stop) };
    let both = tokio::time::timeout(Duration::from_secs(5), both).await;
    let (run, ()) = both.unwrap();
    assert_eq!(run.reason.as_deref(), Some("stopped"));
    fakes.journal.lock().unwrap().clone()
}

#[tokio::test]
async fn a_stop_does_not_wait_for_a_query_of_the_plan() {
    let journal = stopped_in_query(finding(&[]), by_query(), None).await;
    assert!(journal.is_empty(), "{journal:?}");
}

#[tokio::test]
async fn other_steps_run_while_a_query_is_evaluated_and_a_stop_starts_nothing() {
    let mut process = by_query();
    process.steps[1] = alone(1, "move", "LinearMoveSkillType");
    process.steps[1].after = Some(vec![]);
    let journal = stopped_in_query(finding(&[Ok(31.into())]), process, Some("move")).await;
    assert_eq!(journal, ["robot.Lin", "closed"]);
}

/// Attaches the tool that a query names, and grasps.
fn by_queried_tool() -> Process {
    let mut process = grasps();
    process.steps[0] = alone(0, "attach", "AttachToolSkillType");
    process.steps[0].parameters = queried("ToolAppUri", "tool");
    process.steps[1] = alone(1, "grasp", "GraspSkillType");
    process
}

fn changing(tools: &[&str]) -> Fakes {
    let found: Vec<_> = tools.iter().map(|tool| Ok((*tool).into())).collect();
    let fakes = finding(&found);
    let changer = offer("changer", "Attach", "AttachToolSkillType");
    fakes.offers.lock().unwrap().push(changer);
    fakes
}

const OTHER: &str = "urn:example:other";

#[tokio::test]
async fn the_tool_that_a_query_names_does_the_later_steps() {
    for (tool, grasp) in [(OTHER, "other.Grasp"), (GRIPPER, "gripper.Grasp")] {
        let (run, fakes, _) = executed(changing(&[tool, tool]), &by_queried_tool()).await;
        assert_eq!((run.outcome, &run.reason), (How::Done, &None));
        let journal = fakes.journal.lock().unwrap();
        assert_eq!(*journal, ["changer.Attach 1", grasp, "closed"]);
    }
}

#[tokio::test]
async fn a_query_that_names_another_tool_than_the_plan_has_leads_to_another_plan() {
    let fakes = changing(&[OTHER, GRIPPER, GRIPPER, GRIPPER]);
    let (run, fakes, _) = executed(fakes, &by_queried_tool()).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 2), "{run:?}");
    let reason = run.plans[0].reason.as_deref().unwrap_or_default();
    let expected =
        "attach: ToolAppUri (query `tool`): its value is \"urn:example:gripper\", and was";
    assert!(reason.contains(expected), "{reason}");
    let journal = fakes.journal.lock().unwrap();
    let expected = ["closed", "changer.Attach 1", "gripper.Grasp", "closed"];
    assert_eq!(*journal, expected);
}

#[tokio::test]
async fn a_later_plan_keeps_the_tool_that_was_attached() {
    let mut fakes = changing(&[OTHER, OTHER]);
    fakes.fails_at = Some("other.Grasp");
    let (run, fakes, _) = executed(fakes, &by_queried_tool()).await;
    let reason = run.reason.unwrap();
    let expected = "it is not of the tool urn:example:other, which the step `attach` attaches";
    assert!(reason.contains(expected), "{reason}");
    assert_eq!(*fakes.silent_queries.borrow(), 0, "the step is over");
}

/// Releases with a width that a query gives, if the grasp has failed, or has not.
fn conditional(is_negated: bool) -> Process {
    let mut process = grasps();
    process.steps[1].parameters = queried("Width", "release width");
    process.steps[1].when = vec![vec![StepCondition {
        step: 0,
        test: Test::Ended(BadEnd::Failed),
        is_negated,
    }]];
    process
}

#[tokio::test]
async fn a_query_of_a_step_with_conditions_needs_a_value_when_the_step_begins() {
    let fault = || Err(ValueQueryFault::NoRow);
    let (run, ..) = executed(finding(&[fault()]), &conditional(false)).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None), "skipped");
    let (run, fakes, _) = executed(finding(&[fault(), fault()]), &conditional(true)).await;
    let reason = run.reason.unwrap();
    let expected = "step 1: Width (query `release width`): it has no row";
    assert!(reason.contains(expected), "{reason}");
    let journal = fakes.journal.lock().unwrap();
    assert_eq!(*journal, ["gripper.Grasp", "closed"]);
}

#[tokio::test]
async fn a_query_of_a_compensation_without_a_value_ends_the_run_before_its_first_step() {
    let mut process = grasps();
    process.steps[0].compensation = undone_by(0, 2, "ReleaseSkillType");
    let undo = process.steps[0].compensation.as_mut().unwrap();
    undo.parameters = queried("Width", "release width");
    let fakes = finding(&[Err(ValueQueryFault::NoRow)]);
    let (run, ..) = executed(fakes, &process).await;
    let reason = run.reason.unwrap();
    let expected = "compensation 0: Width (query `release width`): it has no row";
    assert!(reason.contains(expected), "{reason}");
    assert!(run.plans.is_empty());
}
