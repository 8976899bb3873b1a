//! The order and the conditions of steps.

use tokio::sync::Barrier;

use super::*;
use crate::process::{BadEnd, Compare, StepCondition, Test};

/// A sequence of these steps, each without an order of its own.
fn sequence(steps: Vec<ProcessStep>) -> Process {
    Process {
        work: StepJob::Sequence,
        steps,
        within: Duration::from_secs(5),
        ..process()
    }
}

fn when(step: usize, test: Test, is_negated: bool) -> Vec<Vec<StepCondition>> {
    vec![vec![StepCondition {
        step,
        test,
        is_negated,
    }]]
}

fn ran(fakes: &Fakes) -> Vec<String> {
    let mut journal = fakes.journal.lock().unwrap().clone();
    journal.retain(|line| line != "closed");
    journal
}

#[tokio::test]
async fn steps_that_do_not_wait_for_each_other_run_in_parallel() {
    let offers = ["one", "two"].map(|name| offer(name, "Meet", &format!("{name}Type")));
    let mut fakes = plant([&offers[..], &[offer("three", "End", "EndType")]].concat());
    // In turn, neither of the two would end.
    fakes.meets = Some(Arc::new(Barrier::new(2)));
    let mut steps = vec![
        alone(0, "one", "oneType"),
        alone(1, "two", "twoType"),
        alone(2, "three", "EndType"),
    ];
    steps[1].after = Some(vec![]);
    steps[2].after = Some(vec![0, 1]);
    let (run, fakes, _) = executed(fakes, &sequence(steps)).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    let ran = ran(&fakes);
    assert_eq!((ran.len(), ran[2].as_str()), (3, "three.End"), "{ran:?}");
    let ended = run.plans[0].ran.iter();
    assert!(ended.clone().all(|ran| ran.outcome == How::Done), "{run:?}");
    let names: Vec<_> = ended.map(|ran| ran.step.as_str()).collect();
    assert_eq!(names, ["one", "two", "three"]);
}

#[tokio::test]
async fn a_failed_branch_lets_the_other_end_and_begins_nothing_more() {
    let mut fakes = plant(vec![
        offer("one", "Fill", "FillType"),
        offer("two", "Stir", "StirType"),
        offer("three", "End", "EndType"),
    ]);
    fakes.fails_at = Some("one.Fill");
    let mut steps = vec![
        alone(0, "fill", "FillType"),
        alone(1, "stir", "StirType"),
        alone(2, "end", "EndType"),
    ];
    steps[1].after = Some(vec![]);
    steps[2].after = Some(vec![0, 1]);
    let (run, fakes, _) = executed(fakes, &sequence(steps)).await;
    assert_eq!(run.outcome, How::Failed);
    assert_eq!(ran(&fakes), ["one.Fill", "two.Stir"]);
    let outcomes: Vec<_> = run.plans[0].ran.iter().map(|ran| ran.outcome).collect();
    assert_eq!(outcomes, [How::Failed, How::Done], "{run:?}");
}

#[tokio::test]
async fn a_step_is_skipped_unless_its_conditions_hold() {
    for (compare, is_negated, expected) in [
        (
            Compare::Greater,
            false,
            vec!["gripper.Grasp", "three.Open", "three.End"],
        ),
        (Compare::Greater, true, vec!["gripper.Grasp", "three.End"]),
        (Compare::Less, false, vec!["gripper.Grasp", "three.End"]),
    ] {
        let mut offers = gripper("gripper");
        offers.push(offer("three", "Open", "OpenType"));
        offers.push(offer("three", "End", "EndType"));
        let mut steps = vec![
            alone(0, "grip", "GraspSkillType"),
            alone(1, "open", "OpenType"),
            alone(2, "end", "EndType"),
        ];
        let width = Test::Result {
            name: "Width".into(),
            compare,
            value: 0.02.into(),
        };
        steps[1].when = when(0, width, is_negated);
        let (run, fakes, _) = executed(plant(offers), &sequence(steps)).await;
        assert_eq!((run.outcome, &run.reason), (How::Done, &None));
        assert_eq!(ran(&fakes), expected);
    }
    // A result that does not exist decides nothing.
    let mut offers = gripper("gripper");
    offers.push(offer("three", "Open", "OpenType"));
    let mut steps = vec![
        alone(0, "grip", "GraspSkillType"),
        alone(1, "open", "OpenType"),
    ];
    let test = Test::Result {
        name: "Mass".into(),
        compare: Compare::Less,
        value: 1.into(),
    };
    steps[1].when = when(0, test, false);
    let (run, fakes, _) = executed(plant(offers), &sequence(steps)).await;
    assert_eq!(run.outcome, How::Failed);
    assert!(
        run.reason
            .unwrap()
            .contains("`grip` returned no result Mass")
    );
    assert_eq!(ran(&fakes), ["gripper.Grasp"]);
}

/// A step, the step behind it, and the step that handles a bad end of it.
fn handled(end: BadEnd) -> Process {
    let mut steps = vec![
        alone(0, "fill", "FillType"),
        alone(1, "stir", "StirType"),
        alone(2, "rinse", "RinseType"),
    ];
    steps[1].when = when(0, Test::Ended(end), true);
    steps[2].when = when(0, Test::Ended(end), false);
    steps[2].after = Some(vec![0]);
    sequence(steps)
}

fn vessels() -> Fakes {
    plant(vec![
        offer("one", "Fill", "FillType"),
        offer("two", "Stir", "StirType"),
        offer("three", "Rinse", "RinseType"),
    ])
}

#[tokio::test]
async fn a_confirmed_bad_end_is_handled_and_no_other_component_repeats_the_step() {
    let (run, fakes, _) = executed(vessels(), &handled(BadEnd::Failed)).await;
    assert_eq!(run.outcome, How::Done);
    assert_eq!(ran(&fakes), ["one.Fill", "two.Stir"]);

    let mut fakes = vessels();
    fakes.fails_at = Some("one.Fill");
    let spare = offer("four", "Fill", "FillType");
    fakes.offers.lock().unwrap().push(spare);
    let (run, fakes, _) = executed(fakes, &handled(BadEnd::Failed)).await;
    assert_eq!((run.outcome, run.plans.len()), (How::Done, 1), "{run:?}");
    assert!(
        ran(&fakes)[0].ends_with(".Fill"),
        "{fakes:?}",
        fakes = ran(&fakes)
    );

    let mut fakes = vessels();
    fakes.ends = Some((
        "one.Fill",
        Some(Err(SkillFault::TimedOut(Duration::from_secs(20)))),
    ));
    let (run, fakes, _) = executed(fakes, &handled(BadEnd::TimedOut)).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    assert_eq!(ran(&fakes), ["one.Fill", "three.Rinse"]);

    // A failure is no end by its time limit.
    let mut fakes = vessels();
    fakes.fails_at = Some("one.Fill");
    let (run, fakes, _) = executed(fakes, &handled(BadEnd::TimedOut)).await;
    assert_eq!(run.outcome, How::Failed);
    assert_eq!(ran(&fakes), ["one.Fill"]);
}

#[tokio::test]
async fn an_unknown_end_is_handled_by_no_step() {
    let mut fakes = vessels();
    fakes.ends = Some(("one.Fill", Some(Ok(unconfirmed("no answer")))));
    let (run, fakes, _) = executed(fakes, &handled(BadEnd::Failed)).await;
    assert_eq!(run.outcome, How::Unknown, "{run:?}");
    assert_eq!(ran(&fakes), ["one.Fill"]);

    let fakes = vessels();
    *fakes.dies_at.lock().unwrap() = Some("one.Fill");
    let (run, fakes, _) = executed(fakes, &handled(BadEnd::Failed)).await;
    assert_ne!(run.outcome, How::Done, "{run:?}");
    assert_eq!(ran(&fakes), ["one.Fill"]);
}

/// Stops the run when two skills have begun.
struct Stop(Arc<Fakes>);
#[async_trait]
impl JobObserver for Stop {
    async fn step(&self, _step: &'static str) {}

    async fn stopped(&self) {
        while self.0.journal.lock().unwrap().len() < 2 {
            tokio::task::yield_now().await;
        }
    }
}

#[tokio::test]
async fn a_stop_ends_all_branches() {
    let mut fakes = plant(vec![
        offer("one", "Meet", "oneType"),
        offer("two", "Meet", "twoType"),
    ]);
    // They wait for a third that never comes.
    fakes.meets = Some(Arc::new(Barrier::new(3)));
    let mut steps = vec![alone(0, "one", "oneType"), alone(1, "two", "twoType")];
    steps[1].after = Some(vec![]);
    let fakes = Arc::new(fakes);
    let plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let process = sequence(steps);
    let teller = Stop(Arc::clone(&fakes));
    let run = execute(&plant, &process, 1, &teller);
    let run = tokio::time::timeout(Duration::from_secs(20), run)
        .await
        .unwrap();
    assert_eq!(
        (run.outcome, run.reason.as_deref()),
        (How::Failed, Some("stopped"))
    );
    let ended = run.plans[0].ran.iter().map(|ran| ran.outcome);
    assert_eq!(ended.collect::<Vec<_>>(), [How::Stopped, How::Stopped]);
}
