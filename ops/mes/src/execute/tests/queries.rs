//! Parameters that are given by queries.

use super::*;

/// Grasps with a width that a query gives.
fn by_query() -> Process {
    let mut process = grasps();
    process.steps[0].parameters = vec![GivenParameter {
        name: "Width".into(),
        value: serde_json::Value::Null,
        unit: None,
        result: None,
        query: Some(ParameterQuery {
            name: "grasp width".into(),
            sparql: "SELECT ?w {}".into(),
        }),
    }];
    process
}

fn finding(found: &[Result<serde_json::Value, String>]) -> Fakes {
    Fakes {
        found: Mutex::new(found.to_vec()),
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
    let fault = || Err("it has several rows".to_owned());
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

#[test]
fn a_dry_run_names_the_query_without_a_value() {
    let fakes = Arc::new(finding(&[Err("it has no row".to_owned())]));
    let plan = dry_run(&fakes, &by_query());
    assert!(!plan.is_complete());
    let expected = "Width (query `grasp width`): it has no row";
    assert!(plan.missing().contains(expected), "{}", plan.missing());
}
