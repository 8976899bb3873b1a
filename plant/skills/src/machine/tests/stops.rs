//! Stops: Halt, time limits, work that does not end, cancellations elsewhere, and the close.

use super::*;

fn with_limit(setup: Setup, limit: Duration) -> Bench {
    Bench::new(Setup {
        timeout: Some(limit),
        ..setup
    })
}

#[test]
fn a_run_that_never_ends_is_stopped_aborted_and_unknown_after_its_limit() {
    let mut bench = with_limit(HERE, seconds(60));
    let run = bench.run();
    bench.story();
    bench.pass(seconds(60) - millis(1));
    assert_eq!(bench.story(), Vec::<String>::new());
    bench.pass(millis(1));
    assert_eq!(bench.story(), ["signal Stop"]);
    bench.pass(seconds(1));
    assert_eq!(bench.story(), ["abort"]);
    bench.end(run, aborted());
    assert_eq!(bench.story(), ["outcome 1 unknown", "RunningToHalted"]);
    assert_eq!(
        bench.outcome(run).message,
        "the work was not done within 60s; the outcome is unknown: its work did not stop within 1s and was broken off"
    );
    let execute = bench.execute();
    assert_eq!(
        bench.answer(execute).unwrap().unwrap_err().text,
        "the outcome of run 1 is unknown; Reset makes the skill ready"
    );
    assert_eq!(
        bench.machine.ignored(),
        0,
        "the end of an aborted task is no result"
    );
}

#[test]
fn the_shorter_of_the_limits_of_skill_and_caller_applies_and_suspended_time_does_not_count() {
    for (within, limit) in [(Some(seconds(5)), 5), (Some(seconds(90)), 60), (None, 60)] {
        let mut bench = with_limit(HERE, seconds(60));
        let given = Given {
            within,
            ..ready_first()
        };
        bench.send(ME, ProgramMethod::Start, given);
        let run = bench.newest();
        bench.pass(seconds(limit - 1));
        bench.ask(ProgramMethod::Suspend).unwrap();
        assert_eq!(bench.machine.poll_deadline(), None);
        bench.pass(seconds(600));
        bench.ask(ProgramMethod::Resume).unwrap();
        bench.pass(millis(999));
        assert_eq!(bench.state(), ProgramMachineState::Running);
        bench.pass(millis(1));
        bench.end(run, stopped());
        let message = format!("the work was not done within {limit}s");
        assert_eq!(bench.outcome(run).message, message);
        assert!(!bench.outcome(run).unknown);
    }
}

#[test]
fn a_limit_beyond_the_range_of_the_clock_is_no_limit() {
    let mut bench = with_limit(HERE, Duration::MAX);
    bench.run();
    assert_eq!(bench.machine.poll_deadline(), None);
}

#[test]
fn a_halt_that_the_work_does_not_confirm_is_unknown_and_start_is_refused_until_reset() {
    for is_aborted in [true, false] {
        let mut bench = Bench::new(HERE);
        let run = bench.run();
        bench.story();
        let halt = bench.call(ProgramMethod::Halt);
        bench.pass(seconds(1));
        assert_eq!(bench.story(), ["signal Stop", "abort"]);
        assert_eq!(bench.answer(halt), None);
        match is_aborted {
            true => bench.end(run, aborted()),
            false => bench.pass(millis(100)),
        }
        assert_eq!(bench.answer(halt), Some(Ok(1)));
        assert!(bench.outcome(run).unknown);
        assert_eq!(bench.state(), ProgramMachineState::Halted);
        for _ in 0..2 {
            let execute = bench.execute();
            assert!(bench.answer(execute).unwrap().is_err());
            assert!(bench.ask(ProgramMethod::Start).is_err());
        }
        // Without the end of the work, there is no Reset either.
        assert_eq!(bench.ask(ProgramMethod::Reset).is_ok(), is_aborted);
        bench.end(run, aborted());
        if !is_aborted {
            bench.ask(ProgramMethod::Reset).unwrap();
        }
        assert_eq!(bench.ask(ProgramMethod::Start), Ok(2));
        assert_eq!(bench.runs.len(), 2);
    }
}

/// The result of a run whose end and time limit, or whose end and Halt, come at the same time.
#[test]
fn work_that_ends_at_the_time_of_its_stop_is_done_whichever_comes_first() {
    for (limit_first, rests_in) in [
        (true, Rest::Ready),
        (false, Rest::Ready),
        (true, Rest::Halted),
        (false, Rest::Halted),
    ] {
        let setup = Setup { rests_in, ..HERE };
        let mut bench = with_limit(setup, seconds(60));
        let run = bench.run();
        bench.elapsed += seconds(60);
        if limit_first {
            bench.pass(Duration::ZERO);
        }
        bench.end(run, done());
        bench.pass(Duration::ZERO);
        assert!(bench.outcome(run).succeeded, "{limit_first}");
        assert_eq!(bench.machine.poll_deadline(), None);

        let run = bench.run();
        let halt = bench.call(ProgramMethod::Halt);
        bench.end(run, done());
        assert_eq!(bench.answer(halt), Some(Ok(2)));
        assert!(bench.outcome(run).succeeded);
        assert_eq!(bench.state(), ProgramMachineState::Halted);
    }
}

#[test]
fn the_end_of_stopped_work_counts_at_the_last_moment_and_is_ignored_after_it() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    let halt = bench.call(ProgramMethod::Halt);
    bench.elapsed += seconds(1);
    bench.end(run, stopped());
    bench.pass(Duration::ZERO);
    assert_eq!(bench.answer(halt), Some(Ok(1)));
    assert!(!bench.outcome(run).unknown);

    let run = bench.run();
    bench.call(ProgramMethod::Halt);
    bench.pass(seconds(1));
    bench.end(run, done());
    assert_eq!(bench.machine.ignored(), 1);
    assert!(bench.outcome(run).unknown, "an aborted run has no result");
    assert_eq!(bench.state(), ProgramMachineState::Halted);
}

#[test]
fn a_reset_of_suspended_work_without_a_known_end_halts() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    bench.ask(ProgramMethod::Suspend).unwrap();
    let reset = bench.call(ProgramMethod::Reset);
    bench.report(run, Line::Unknown("the robot is lost".to_owned()));
    bench.end(run, failed("the robot is lost"));
    assert!(bench.answer(reset).unwrap().is_err());
    assert!(bench.outcome(run).unknown);
    assert_eq!(bench.state(), ProgramMachineState::Halted);
    bench.ask(ProgramMethod::Reset).unwrap();
}

#[test]
fn a_reset_whose_cancellation_is_refused_leaves_the_run_suspended() {
    let mut bench = Bench::new(ELSEWHERE);
    let run = bench.run();
    bench.ask(ProgramMethod::Suspend).unwrap();
    for _ in 0..2 {
        let reset = bench.call(ProgramMethod::Reset);
        bench.report(run, Line::Refused("the robot goes on".to_owned()));
        let refusal = bench.answer(reset).unwrap().unwrap_err();
        assert_eq!(
            refusal.to_string(),
            "BadRequestNotAllowed: the robot goes on"
        );
        assert_eq!(bench.state(), ProgramMachineState::Suspended);
    }
    // The work goes on with the run.
    bench.story();
    bench.ask(ProgramMethod::Resume).unwrap();
    assert!(bench.story().contains(&"signal Go".to_owned()));
    bench.end(run, done());
    assert!(!bench.outcome(run).unknown);
    assert_eq!(bench.state(), ProgramMachineState::Ready);
}

/// Aborted work that blocks its thread gets no Go: its run ends at once, and cannot be resumed.
#[test]
fn a_reset_of_suspended_work_that_does_not_end_halts_with_an_unknown_outcome() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    bench.ask(ProgramMethod::Suspend).unwrap();
    let reset = bench.call(ProgramMethod::Reset);
    bench.story();
    bench.pass(seconds(1));
    bench.pass(millis(100));
    assert_eq!(
        bench.story(),
        [
            "abort",
            "outcome 1 unknown",
            "SuspendedToHalted",
            "called",
            "reply 2: BadInvalidState"
        ]
    );
    assert_eq!(
        bench.answer(reset).unwrap().unwrap_err().text,
        "the outcome of run 1 is unknown; Reset makes the skill ready"
    );
    assert!(bench.ask(ProgramMethod::Resume).is_err());
    let refusal = bench.ask(ProgramMethod::Reset).unwrap_err();
    assert_eq!(refusal.text, "the work of run 1 has not come to an end");
    bench.story();
    bench.end(run, aborted());
    assert_eq!(bench.story(), Vec::<String>::new());
    bench.ask(ProgramMethod::Reset).unwrap();
    assert_eq!(bench.ask(ProgramMethod::Start), Ok(2));
}

#[test]
fn work_elsewhere_is_halted_when_it_has_ended() {
    let mut bench = Bench::new(ELSEWHERE);
    let run = bench.run();
    bench.story();
    let halt = bench.call(ProgramMethod::Halt);
    bench.report(run, Line::Pending("the goal has not ended".to_owned()));
    bench.pass(seconds(1));
    assert_eq!(bench.answer(halt), Some(Ok(1)));
    assert_eq!(bench.state(), ProgramMachineState::Running);
    let second = bench.call(ProgramMethod::Halt);
    assert_eq!(
        bench.answer(second),
        Some(Ok(1)),
        "the cancellation is in progress"
    );
    assert_eq!(
        bench.story(),
        [
            "signal Stop",
            "pending the goal has not ended",
            "pending the goal has not ended",
            "called",
            "reply 1: 1",
            "called",
            "reply 2: 1",
        ]
    );
    bench.pass(seconds(3_600));
    assert_eq!(
        bench.story(),
        Vec::<String>::new(),
        "work elsewhere is not aborted"
    );
    bench.end(run, stopped());
    assert_eq!(bench.story(), ["outcome 1 failed", "RunningToHalted"]);
    let shown = bench.machine.snapshot();
    assert_eq!((shown.needs_reset, shown.pending.clone()), (false, None));
}

#[test]
fn work_elsewhere_that_does_not_end_is_given_up_by_a_second_halt_after_its_time() {
    let mut bench = Bench::new(ELSEWHERE);
    let run = bench.run();
    bench.call(ProgramMethod::Halt);
    bench.pass(seconds(11) - millis(1));
    bench.ask(ProgramMethod::Halt).unwrap();
    assert_eq!(bench.state(), ProgramMachineState::Running);
    bench.pass(millis(1));
    bench.story();
    let halt = bench.call(ProgramMethod::Halt);
    assert_eq!(bench.story(), ["abort"]);
    // A result that arrives with the abort is too late.
    bench.end(run, done());
    assert_eq!(
        (bench.answer(halt), bench.machine.ignored()),
        (Some(Ok(1)), 1)
    );
    let outcome = bench.outcome(run);
    assert!(outcome.unknown && !outcome.succeeded);
    assert_eq!(
        outcome.message,
        "halted by session 1; the outcome is unknown: cancellation pending: the work has not ended"
    );
    assert!(bench.ask(ProgramMethod::Start).is_err());
    bench.ask(ProgramMethod::Reset).unwrap();
    assert_eq!(bench.ask(ProgramMethod::Start), Ok(2));
}

/// A driver that blocks its thread may still move the machine after its run was given up.
#[test]
fn a_run_that_was_given_up_blocks_the_next_until_its_work_has_ended() {
    let mut bench = Bench::new(ELSEWHERE);
    let run = bench.run();
    bench.call(ProgramMethod::Halt);
    bench.report(run, Line::Unknown("the robot is lost".to_owned()));
    bench.pass(seconds(1));
    let halt = bench.call(ProgramMethod::Halt);
    bench.pass(millis(100));
    assert_eq!(
        bench.answer(halt),
        Some(Ok(1)),
        "the Halt does not wait for more"
    );
    assert_eq!(bench.state(), ProgramMachineState::Halted);
    assert!(bench.ask(ProgramMethod::Reset).is_err());
    bench.end(run, aborted());
    bench.ask(ProgramMethod::Reset).unwrap();
}

#[test]
fn a_run_that_is_being_stopped_is_neither_suspended_nor_resumed() {
    for is_suspended in [true, false] {
        let mut bench = Bench::new(ELSEWHERE);
        let run = bench.run();
        let method = match is_suspended {
            true => {
                bench.ask(ProgramMethod::Suspend).unwrap();
                ProgramMethod::Resume
            }
            false => ProgramMethod::Suspend,
        };
        bench.call(ProgramMethod::Halt);
        bench.pass(seconds(1));
        bench.story();
        assert_eq!(
            bench.ask(method).unwrap_err().to_string(),
            format!("BadInvalidState: {method} is not possible: run 1 is being stopped")
        );
        assert_eq!(
            bench.story(),
            ["called", "reply 2: BadInvalidState"].map(|text| {
                if is_suspended {
                    text.replace('2', "3")
                } else {
                    text.to_owned()
                }
            })
        );
        // Its work gets done all the same: suspended work cannot finish.
        bench.end(run, done());
        assert_eq!(bench.state(), ProgramMachineState::Halted);
        assert_eq!(bench.outcome(run).succeeded, !is_suspended);
    }
}

#[test]
fn a_halt_decides_the_state_after_a_run_that_exceeded_its_limit() {
    for is_halted in [true, false] {
        let mut bench = with_limit(ELSEWHERE, seconds(60));
        let run = bench.run();
        bench.pass(seconds(61));
        let shown = bench.machine.snapshot();
        assert_eq!(shown.state, ProgramMachineState::Running);
        assert!(shown.pending.is_some());
        if is_halted {
            bench.ask(ProgramMethod::Halt).unwrap();
        }
        bench.end(run, done());
        assert!(bench.outcome(run).succeeded);
        let state = match is_halted {
            true => ProgramMachineState::Halted,
            false => ProgramMachineState::Ready,
        };
        assert_eq!(bench.state(), state);
    }
}

#[test]
fn a_limit_that_passes_during_a_pending_halt_changes_nothing() {
    let mut bench = with_limit(ELSEWHERE, seconds(60));
    let run = bench.run();
    bench.call(ProgramMethod::Halt);
    bench.pass(seconds(1));
    bench.story();
    bench.pass(seconds(600));
    assert_eq!(bench.story(), Vec::<String>::new());
    bench.end(run, failed("the goal was canceled"));
    assert_eq!(
        bench.outcome(run).message,
        "halted by session 1; the goal was canceled"
    );
}

#[test]
fn a_refused_cancellation_is_reported_and_the_run_goes_on() {
    let mut bench = with_limit(ELSEWHERE, seconds(60));
    let run = bench.run();
    let why = || Line::Refused("the robot goes on".to_owned());
    for _ in 0..2 {
        let halt = bench.call(ProgramMethod::Halt);
        bench.report(run, why());
        assert_eq!(
            bench.answer(halt).unwrap().unwrap_err().to_string(),
            "BadRequestNotAllowed: the robot goes on"
        );
        assert_eq!(bench.state(), ProgramMachineState::Running);
    }
    let pending = bench.machine.snapshot().pending.clone();
    assert_eq!(pending.as_deref(), Some("the robot goes on"));
    // The executor accepts a Halt first, and refuses it later: the run and its limit go on.
    bench.call(ProgramMethod::Halt);
    bench.pass(seconds(1));
    bench.report(run, why());
    bench.ask(ProgramMethod::Suspend).unwrap();
    bench.ask(ProgramMethod::Resume).unwrap();
    bench.pass(seconds(60));
    bench.end(run, stopped());
    assert_eq!(
        bench.outcome(run).message,
        "the work was not done within 60s"
    );
}

/// The executor refuses a Halt that was accepted after the time limit: the run stays in its stop.
#[test]
fn a_late_run_whose_halt_is_refused_can_be_given_up() {
    for gives_up in [true, false] {
        let mut bench = with_limit(ELSEWHERE, seconds(60));
        let run = bench.run();
        bench.pass(seconds(61));
        bench.ask(ProgramMethod::Halt).unwrap();
        bench.report(run, Line::Refused("the robot goes on".to_owned()));
        assert!(bench.ask(ProgramMethod::Suspend).is_err(), "it is stopped");
        if !gives_up {
            // The refused Halt does not decide the state.
            bench.end(run, done());
            assert_eq!(bench.state(), ProgramMachineState::Ready);
            continue;
        }
        bench.pass(seconds(10));
        let halt = bench.call(ProgramMethod::Halt);
        bench.end(run, aborted());
        assert_eq!(bench.answer(halt), Some(Ok(1)));
        assert!(bench.outcome(run).unknown);
        assert_eq!(bench.state(), ProgramMachineState::Halted);
    }
}

#[test]
fn a_closed_skill_waits_for_work_elsewhere_and_then_gives_it_up() {
    for is_ended in [true, false] {
        let mut bench = Bench::new(ELSEWHERE);
        let run = bench.run();
        bench.close();
        bench.pass(seconds(5));
        assert!(!bench.machine.is_closed());
        match is_ended {
            true => bench.end(run, stopped()),
            false => {
                bench.pass(millis(500));
                bench.end(run, aborted());
            }
        }
        assert!(bench.machine.is_closed());
        assert_eq!(bench.outcome(run).unknown, !is_ended);
        assert_eq!(bench.state(), ProgramMachineState::Halted);
        bench.close();
    }
}

#[test]
fn a_closed_skill_ends_at_once_if_it_does_not_run() {
    let mut bench = Bench::new(HERE);
    bench.close();
    assert!(bench.machine.is_closed());
    let mut bench = Bench::new(HERE);
    bench.ask(ProgramMethod::Reset).unwrap();
    bench.close();
    assert!(bench.machine.is_closed());
    assert_eq!(bench.state(), ProgramMachineState::Halted);
}

/// A refused cancellation does not leave a run without an outcome.
#[test]
fn a_closed_skill_gives_up_work_whose_cancellation_is_refused() {
    for is_ended in [true, false] {
        let mut bench = Bench::new(ELSEWHERE);
        let run = bench.run();
        bench.close();
        bench.report(run, Line::Refused("the robot goes on".to_owned()));
        bench.pass(millis(4_499));
        assert!(!bench.machine.is_closed());
        bench.story();
        if is_ended {
            bench.end(run, done());
            assert_eq!(
                bench.story(),
                ["outcome 1 done", "RunningToReady", "ReadyToHalted"]
            );
        } else {
            bench.pass(millis(1));
            bench.end(run, aborted());
            assert_eq!(
                bench.story(),
                ["abort", "outcome 1 unknown", "RunningToHalted"]
            );
            assert_eq!(
                bench.outcome(run).message,
                "the end of the component; the outcome is unknown: the robot goes on"
            );
        }
        assert!(bench.machine.is_closed());
        let idle = bench.authority.idle(bench.now().monotonic);
        assert_eq!(idle, Some(Duration::ZERO), "the component is released");
    }
}
