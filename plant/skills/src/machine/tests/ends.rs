//! The ends of runs: results, failures, lost drivers, and reports that come too late.

use super::*;

#[test]
fn a_transition_is_published_before_the_work_starts_and_an_outcome_before_its_transition() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    bench.pass(millis(412));
    bench.report(run, Line::Step("Close".to_owned()));
    bench.machine.progress(run, 0.5);
    bench.end(run, done());
    assert_eq!(
        bench.story(),
        [
            "HaltedToReady",
            "parameters",
            "ReadyToRunning",
            "run 1",
            "called",
            "reply 0: 1",
            "step Close",
            "progress 0.5",
            "outcome 1 done",
            "RunningToReady",
        ]
    );
    let outcome = bench.outcome(run);
    assert_eq!(
        outcome.results,
        [("Gripped".to_owned(), SkillValue::Boolean(true))]
    );
    assert_eq!(outcome.trace, ["0.412 Close"]);
    let shown = bench.machine.snapshot();
    assert_eq!(
        (shown.progress, shown.step.as_str(), shown.since),
        (1.0, "", SystemTime::UNIX_EPOCH + millis(412))
    );
}

#[test]
fn a_run_rests_where_its_type_defines_it() {
    for (rests_in, state) in [
        (Rest::Ready, ProgramMachineState::Ready),
        (Rest::Halted, ProgramMachineState::Halted),
    ] {
        let mut bench = Bench::new(Setup { rests_in, ..HERE });
        let run = bench.run();
        bench.end(run, done());
        assert_eq!(bench.state(), state);
        assert!(!bench.machine.snapshot().needs_reset);
    }
}

/// A driver that is lost in a run has not stopped its machine, nor has a driver that panics.
#[test]
fn a_lost_driver_leaves_an_unknown_outcome_and_only_reset_makes_the_skill_ready() {
    type End = fn(&mut Bench, RunId);
    let ends: [(End, &str, bool); 4] = [
        (
            |bench, run| bench.end(run, failed("no part")),
            "no part",
            false,
        ),
        (
            |bench, run| {
                bench.report(run, Line::Unknown("the robot is lost".to_owned()));
                bench.end(run, failed("the robot is lost"));
            },
            "the robot is lost",
            true,
        ),
        (
            |bench, run| {
                let panic = "a wire is loose".to_owned();
                bench.end(run, Err(RunFailure::Panicked { panic }));
            },
            "the driver broke down: a wire is loose; the outcome is unknown, check the machine",
            true,
        ),
        (
            |bench, run| bench.end(run, aborted()),
            "the work was broken off; the outcome is unknown, check the machine",
            true,
        ),
    ];
    for (end, message, unknown) in ends {
        let mut bench = Bench::new(HERE);
        let run = bench.run();
        end(&mut bench, run);
        let outcome = bench.outcome(run);
        assert_eq!(
            (outcome.message.as_str(), outcome.unknown, outcome.succeeded),
            (message, unknown, false)
        );
        assert_eq!(bench.state(), ProgramMachineState::Halted);
        assert!(bench.ask(ProgramMethod::Start).is_err());
        let execute = bench.execute();
        assert_eq!(
            bench.answer(execute).unwrap().is_err(),
            unknown,
            "{message}"
        );
        if unknown {
            bench.ask(ProgramMethod::Reset).unwrap();
            assert_eq!(bench.ask(ProgramMethod::Start), Ok(2));
        }
    }
}

/// A composite reports a pending Halt of its part, and then the same text as its unknown end.
#[test]
fn an_unknown_end_counts_even_if_its_reason_is_shown_as_pending_already() {
    let mut bench = Bench::new(ELSEWHERE);
    let run = bench.run();
    let halt = bench.call(ProgramMethod::Halt);
    let why = "gripper.Grasp goes on".to_owned();
    bench.report(run, Line::Pending(why.clone()));
    bench.pass(seconds(1));
    assert_eq!(bench.answer(halt), Some(Ok(1)));
    bench.report(run, Line::Unknown(why.clone()));
    bench.end(run, failed(&why));
    assert!(bench.outcome(run).unknown);
    assert!(bench.machine.snapshot().needs_reset);
}

#[test]
fn a_driver_that_finds_the_end_of_its_work_after_all_succeeds_and_needs_no_reset() {
    for rests_in in [Rest::Ready, Rest::Halted] {
        let mut bench = Bench::new(Setup { rests_in, ..HERE });
        let run = bench.run();
        bench.report(run, Line::Unknown("no answer yet".to_owned()));
        bench.end(run, done());
        let outcome = bench.outcome(run);
        assert_eq!((outcome.succeeded, outcome.unknown), (true, false));
        assert!(!bench.machine.snapshot().needs_reset, "{rests_in:?}");
    }
}

#[test]
fn reports_of_a_run_that_was_halted_are_ignored_and_counted() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    let halt = bench.call(ProgramMethod::Halt);
    // The work blocks its thread: it is neither stopped nor aborted.
    bench.pass(seconds(2));
    assert_eq!(bench.answer(halt), Some(Ok(1)));
    let before = bench.outcome(run);
    bench.story();
    bench.report(run, Line::Step("Close".to_owned()));
    bench.report(run, Line::Unknown("lost".to_owned()));
    bench.machine.progress(run, 0.7);
    bench.drain();
    assert_eq!(bench.machine.ignored(), 3);
    let refusal = bench.ask(ProgramMethod::Reset).unwrap_err();
    assert_eq!(refusal.text, "the work of run 1 has not come to an end");
    bench.story();
    bench.end(run, done());
    assert_eq!(bench.machine.ignored(), 4);
    assert_eq!(bench.story(), Vec::<String>::new());
    assert_eq!(bench.outcome(run), before);
    assert_eq!(bench.state(), ProgramMachineState::Halted);
    // Its end makes room for the next run, whose reports are not those of the first.
    bench.ask(ProgramMethod::Reset).unwrap();
    bench.ask(ProgramMethod::Start).unwrap();
    bench.end(run, done());
    assert_eq!(bench.machine.ignored(), 5);
    assert_eq!(bench.state(), ProgramMachineState::Running);
}

#[test]
fn work_that_is_done_while_suspended_ends_its_run_at_resume() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    bench.ask(ProgramMethod::Suspend).unwrap();
    bench.end(run, done());
    assert_eq!(bench.state(), ProgramMachineState::Suspended);
    bench.story();
    bench.ask(ProgramMethod::Resume).unwrap();
    let story = bench.story();
    assert_eq!(
        story[..3],
        ["SuspendedToRunning", "outcome 1 done", "RunningToReady"]
    );

    // Suspended work that fails ends its run at once, and suspended work that is done and then
    // halted is no success.
    bench.ask(ProgramMethod::Start).unwrap();
    bench.ask(ProgramMethod::Suspend).unwrap();
    bench.end(bench.newest(), failed("the part is lost"));
    assert_eq!(bench.state(), ProgramMachineState::Halted);
    let run = bench.run();
    bench.ask(ProgramMethod::Suspend).unwrap();
    bench.end(run, done());
    bench.ask(ProgramMethod::Halt).unwrap();
    assert_eq!(bench.outcome(run).message, "halted by session 1");
    assert_eq!(bench.state(), ProgramMachineState::Halted);
}

#[test]
fn a_long_trace_is_shortened() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    for number in 0..300 {
        bench.report(run, Line::Note(format!("{number} {}", "x".repeat(300))));
    }
    bench.end(run, done());
    let trace = &bench.outcome(run).trace;
    assert_eq!(trace.len(), 256);
    assert_eq!(trace[255].len(), "0.000 ".len() + 240);
}
