//! Steps that are done in rounds.

use super::*;
use crate::execute::sequence::Passed;
use crate::process::{BadEnd, By, Compare, Loop, StepCondition, Test};

/// A loop over steps, which is repeated while a condition about one of them holds.
fn repeated(steps: &[usize], (step, test): (usize, Test), rounds: u32) -> Loop {
    Loop {
        steps: steps.iter().copied().collect(),
        again: vec![vec![StepCondition {
            step,
            test,
            is_negated: false,
        }]],
        rounds,
    }
}

fn runs_below(most: u32) -> Test {
    Test::Result {
        name: "Runs".into(),
        compare: Compare::Less,
        value: most.into(),
    }
}

/// Counts its runs, stirs, and ends.
fn counted(rounds: Loop) -> Process {
    Process {
        work: StepJob::Sequence,
        steps: vec![
            alone(0, "count", "CountType"),
            alone(1, "stir", "StirType"),
            alone(2, "end", "EndType"),
        ],
        loops: vec![rounds],
        ..process()
    }
}

fn vessels() -> Fakes {
    plant(vec![
        offer("one", "Count", "CountType"),
        offer("two", "Stir", "StirType"),
        offer("three", "End", "EndType"),
    ])
}

fn ran(fakes: &Fakes) -> Vec<String> {
    let mut journal = fakes.journal.lock().unwrap().clone();
    journal.retain(|line| line != "closed");
    journal
}

#[tokio::test]
async fn the_steps_of_a_loop_are_repeated_while_its_condition_holds() {
    let process = counted(repeated(&[0, 1], (0, runs_below(3)), 10));
    let (run, fakes, _) = executed(vessels(), &process).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    let round = ["one.Count", "two.Stir"];
    let expected = [&round[..], &round, &round, &["three.End"]].concat();
    assert_eq!(ran(&fakes), expected);
    // Each round is a plan, whose end is in the record.
    assert_eq!(run.plans.len(), 3, "{run:?}");
    assert!(run.plans.iter().all(|plan| plan.outcome == How::Done));
}

#[tokio::test]
async fn a_loop_ends_the_run_after_its_maximum_of_rounds() {
    let process = counted(repeated(&[0, 1], (0, runs_below(3)), 2));
    let (run, fakes, _) = executed(vessels(), &process).await;
    assert_eq!(run.outcome, How::Failed);
    let why = run.reason.unwrap();
    assert!(
        why.contains("the loop of `count` has had 2 rounds"),
        "{why}"
    );
    assert_eq!(ran(&fakes).len(), 4);
    // A condition that cannot be decided begins no round.
    let unknown = Test::Result {
        name: "Mass".into(),
        compare: Compare::Less,
        value: 3.into(),
    };
    let process = counted(repeated(&[0, 1], (0, unknown), 10));
    let (run, fakes, _) = executed(vessels(), &process).await;
    let why = run.reason.unwrap();
    assert!(why.contains("`count` returned no result Mass"), "{why}");
    assert_eq!(ran(&fakes), ["one.Count", "two.Stir"]);
}

#[tokio::test]
async fn a_step_that_fails_is_tried_again_by_the_same_component() {
    let mut fakes = vessels();
    fakes.fails_at = Some("two.Stir");
    let process = counted(repeated(&[1], (1, Test::Ended(BadEnd::Failed)), 3));
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!(run.outcome, How::Failed);
    assert_eq!(
        ran(&fakes),
        ["one.Count", "two.Stir", "two.Stir", "two.Stir"]
    );
    // An end that is not confirmed begins no round: the machine may move.
    let mut fakes = vessels();
    fakes.ends = Some(("two.Stir", Some(Ok(unconfirmed("no answer")))));
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!(run.outcome, How::Unknown, "{run:?}");
    assert_eq!(ran(&fakes), ["one.Count", "two.Stir"]);
}

#[tokio::test]
async fn an_inner_loop_begins_anew_in_each_round_of_the_outer_one() {
    // The inner loop stirs twice; the outer one counts to two.
    let mut process = counted(repeated(&[0, 1], (0, runs_below(2)), 10));
    process.steps[1] = alone(1, "stir", "OtherCountType");
    let odd = [1, 3].map(|runs| {
        vec![StepCondition {
            step: 1,
            test: Test::Result {
                name: "Runs".into(),
                compare: Compare::Equal,
                value: runs.into(),
            },
            is_negated: false,
        }]
    });
    process.loops.push(Loop {
        steps: [1].into(),
        again: odd.into(),
        // The number of rounds in each round of the outer loop.
        rounds: 2,
    });
    let fakes = plant(vec![
        offer("one", "Count", "CountType"),
        offer("two", "Count", "OtherCountType"),
        offer("three", "End", "EndType"),
    ]);
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!((run.outcome, &run.reason), (How::Done, &None));
    let round = ["one.Count", "two.Count", "two.Count"];
    assert_eq!(
        ran(&fakes),
        [&round[..], &round, &["three.End"]].concat(),
        "{run:?}"
    );
}

#[test]
fn loops_within_loops_have_a_maximum_of_rounds_in_all() {
    let has_failed = |is_negated| {
        vec![vec![StepCondition {
            step: 1,
            test: Test::Ended(BadEnd::Failed),
            is_negated,
        }]]
    };
    // The inner loop goes on after a failure, the outer one after the last inner round.
    let mut process = counted(Loop {
        steps: [0, 1].into(),
        again: has_failed(true),
        rounds: Loop::MOST_ROUNDS,
    });
    process.loops.push(Loop {
        steps: [1].into(),
        again: has_failed(false),
        rounds: Loop::MOST_ROUNDS,
    });
    let mut progress = RunProgress::default();
    let mut rounds = 0;
    let why = loop {
        let end = match rounds % 10 {
            9 => Passed::Skipped,
            _ => Passed::Ended(BadEnd::Failed),
        };
        progress.passed.insert(0, Passed::Skipped);
        progress.passed.insert(1, end);
        match progress.next_round(&process) {
            Ok(is_due) => assert!(is_due, "round {rounds}"),
            Err(why) => break why,
        }
        rounds += 1;
    };
    assert_eq!(rounds, Loop::MOST_ROUNDS_OF_RUN);
    let why = why.to_string();
    assert!(why.contains("2000 rounds in all"), "{why}");
}

#[tokio::test]
async fn each_round_of_a_loop_is_compensated() {
    let mut fakes = vessels();
    let undo = offer("one", "Undo", "UndoType");
    fakes.offers.lock().unwrap().push(undo);
    fakes.fails_at = Some("three.End");
    let mut process = counted(repeated(&[0], (0, runs_below(2)), 10));
    process.steps[0].compensation = Some(Box::new(ProcessStep {
        by: By::SameAs(0),
        ..alone(3, "undo", "UndoType")
    }));
    let (run, fakes, _) = executed(fakes, &process).await;
    assert_eq!(run.outcome, How::Failed);
    let why = run.reason.unwrap();
    assert!(why.ends_with("compensated: `count`, `count`"), "{why}");
    let ran = ran(&fakes);
    assert_eq!(ran[..2], ["one.Count", "one.Count"]);
    assert_eq!(ran[ran.len() - 2..], ["one.Undo", "one.Undo"]);
}

#[tokio::test]
async fn a_component_of_an_earlier_round_stays_reserved_for_its_compensation() {
    let mut fakes = vessels();
    fakes.fails_at = Some("three.End");
    let undo = offer("one", "Undo", "UndoType");
    fakes.offers.lock().unwrap().push(undo);
    let mut process = counted(repeated(&[0], (0, runs_below(2)), 10));
    process.steps[0].compensation = Some(Box::new(ProcessStep {
        by: By::SameAs(0),
        ..alone(3, "undo", "UndoType")
    }));
    let fakes = Arc::new(fakes);
    let reserved = Mutex::new(Vec::new());
    // During the first round, `four` takes the place of `one`, which can only undo then.
    let teller = |step: &'static str| {
        let mut offers = fakes.offers.lock().unwrap();
        if step == "Step" && offers.iter().all(|offer| offer.component_name != "four") {
            offers.retain(|offer| (&*offer.component_name, &*offer.name) != ("one", "Count"));
            offers.push(offer("four", "Count", "CountType"));
            offers.push(offer("four", "Undo", "UndoType"));
        }
        if step == "Compensate" {
            let leases = fakes.leases.lock().unwrap();
            reserved
                .lock()
                .unwrap()
                .push(leases.contains_key("urn:example:one"));
        }
    };
    let plant: Arc<dyn Plant> = Arc::new(Arc::clone(&fakes));
    let run = execute(&plant, &process, 1, &teller).await;
    assert_eq!(run.outcome, How::Failed);
    let ran = ran(&fakes);
    let rounds = ["one.Count", "four.Count", "four.Count"];
    assert_eq!(ran[..3], rounds, "{run:?}");
    let undone = ["four.Undo", "four.Undo", "one.Undo"];
    assert_eq!(ran[ran.len() - 3..], undone, "{run:?}");
    assert_eq!(*reserved.lock().unwrap(), [true; 3]);
}
