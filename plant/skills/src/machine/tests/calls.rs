//! Calls: states, callers, parameters, the lease, and calls that wait.

use program::TRANSITIONS;

use super::*;

/// Brings a skill to a state.
fn lead(bench: &mut Bench, state: ProgramMachineState) {
    let way: &[ProgramMethod] = match state {
        ProgramMachineState::Halted => &[],
        ProgramMachineState::Ready => &[ProgramMethod::Reset],
        ProgramMachineState::Running => &[ProgramMethod::Reset, ProgramMethod::Start],
        ProgramMachineState::Suspended => &[
            ProgramMethod::Reset,
            ProgramMethod::Start,
            ProgramMethod::Suspend,
        ],
    };
    for method in way {
        bench.ask(*method).unwrap();
    }
    assert_eq!(bench.state(), state);
    bench.story();
}

/// The effect of each method in each state, and the response. Work that is stopped ends at once.
#[test]
fn of_twenty_calls_eight_are_accepted_and_the_others_change_nothing() {
    let accepted = [
        ("Halted", "Reset", "HaltedToReady"),
        ("Ready", "Start", "parameters, ReadyToRunning, run 1"),
        ("Ready", "Halt", "ReadyToHalted"),
        (
            "Running",
            "Suspend",
            "RunningToSuspended, signal StandStill",
        ),
        (
            "Running",
            "Halt",
            "signal Stop, outcome 1 failed, RunningToHalted",
        ),
        ("Suspended", "Resume", "SuspendedToRunning, signal Go"),
        (
            "Suspended",
            "Halt",
            "signal Stop, outcome 1 failed, SuspendedToHalted",
        ),
        (
            "Suspended",
            "Reset",
            "signal Stop, outcome 1 failed, SuspendedToReady",
        ),
    ];
    let mut taken = 0;
    for state in ProgramMachineState::ALL {
        for method in ProgramMethod::ALL {
            let mut bench = Bench::new(HERE);
            lead(&mut bench, state);
            let executable = bench.machine.snapshot().executable;
            let call = bench.call(method);
            if bench.answer(call).is_none() {
                bench.end(bench.newest(), stopped());
            }
            let story = bench.story().join(", ");
            let name = format!("{method} in {state}");
            let row = accepted
                .iter()
                .find(|(of, by, _)| (*of, *by) == (state.name(), method.name()));
            let mut can = ProgramMethod::ALL.iter().zip(executable);
            let can = can.any(|(of, can)| *of == method && can);
            assert_eq!(can, row.is_some(), "{name}");
            let answer = bench.answer(call).expect("one response");
            match row {
                Some((_, _, effect)) => {
                    let run = answer.unwrap();
                    assert_eq!(
                        story,
                        format!("{effect}, called, reply {call}: {run}"),
                        "{name}"
                    );
                    taken += 1;
                }
                None => {
                    let refusal = answer.unwrap_err();
                    assert_eq!(refusal.code, RefusalCode::InvalidState, "{name}");
                    assert_eq!(
                        story,
                        format!("called, reply {call}: BadInvalidState"),
                        "{name}"
                    );
                    assert_eq!(bench.state(), state, "{name}");
                }
            }
        }
    }
    assert_eq!(taken, accepted.len());
}

#[test]
fn each_of_the_nine_transitions_is_published_once_and_in_order() {
    let mut bench = Bench::new(HERE);
    for method in [
        ProgramMethod::Reset,   // 1
        ProgramMethod::Halt,    // 9
        ProgramMethod::Reset,   // 1
        ProgramMethod::Start,   // 2
        ProgramMethod::Suspend, // 5
        ProgramMethod::Resume,  // 6
        ProgramMethod::Suspend, // 5
        ProgramMethod::Reset,   // 8
        ProgramMethod::Start,   // 2
        ProgramMethod::Suspend, // 5
        ProgramMethod::Halt,    // 7
        ProgramMethod::Reset,   // 1
        ProgramMethod::Start,   // 2
        ProgramMethod::Halt,    // 3
        ProgramMethod::Reset,   // 1
        ProgramMethod::Start,   // 2
    ] {
        let call = bench.call(method);
        if bench.answer(call).is_none() {
            bench.end(bench.newest(), stopped());
        }
        assert!(bench.answer(call).unwrap().is_ok());
    }
    bench.end(bench.newest(), done()); // 4
    let story = bench.story();
    let number = |name: &String| TRANSITIONS.iter().find(|of| of.name == name);
    let numbers: Vec<u32> = story
        .iter()
        .filter_map(number)
        .map(|of| of.number)
        .collect();
    assert_eq!(numbers, [1, 9, 1, 2, 5, 6, 5, 8, 2, 5, 7, 1, 2, 3, 1, 2, 4]);
    assert_eq!(bench.machine.snapshot().run, 4);
}

#[test]
fn the_second_of_two_callers_is_refused_with_the_name_of_the_owner() {
    let mut bench = Bench::new(HERE);
    bench.run();
    for method in [ProgramMethod::Halt, ProgramMethod::Suspend] {
        let call = bench.send(OTHER, method, Given::default());
        let refusal = bench.answer(call).unwrap().unwrap_err();
        assert_eq!(
            refusal.to_string(),
            "BadLocked: session 1 has the lease of this component"
        );
    }
    assert_eq!(bench.state(), ProgramMachineState::Running);
    let last = bench
        .machine
        .snapshot()
        .diagnostic
        .last_call
        .clone()
        .unwrap();
    assert_eq!((last.by, last.refused.is_some()), (OTHER, true));
}

#[test]
fn a_lease_that_ends_in_the_middle_of_a_run_leaves_the_run_to_the_next_owner() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    bench.story();
    bench.pass(seconds(3_600));
    let idle = bench
        .authority
        .release_idle(seconds(60), bench.now().monotonic);
    assert_eq!(idle, None, "a lease is not idle in a run");
    // The session of the owner closes.
    bench.authority.release(&ME);
    assert_eq!(bench.story(), Vec::<String>::new());
    assert_eq!(bench.state(), ProgramMachineState::Running);
    let halt = bench.send(OTHER, ProgramMethod::Halt, Given::default());
    bench.end(run, stopped());
    assert_eq!(bench.answer(halt), Some(Ok(1)));
    assert_eq!(bench.outcome(run).message, "halted by session 2");
    let start = bench.execute();
    assert_eq!(
        bench.answer(start).unwrap().unwrap_err().code,
        RefusalCode::Locked,
        "the next owner has the lease"
    );
}

#[test]
fn a_wrong_parameter_or_a_running_neighbour_moves_nothing() {
    let mut bench = Bench::new(HERE);
    let wrong = Given {
        parameters: Some(vec![("Force".to_owned(), SkillValue::from("much"))]),
        ..ready_first()
    };
    let call = bench.send(ME, ProgramMethod::Start, wrong);
    assert_eq!(
        bench.answer(call).unwrap().unwrap_err().code,
        RefusalCode::TypeMismatch
    );
    bench.authority.begin("Lift").unwrap();
    let call = bench.execute();
    assert_eq!(
        bench.answer(call).unwrap().unwrap_err().text,
        "Lift of this component runs, and it does one thing at a time"
    );
    assert_eq!(
        bench.story(),
        [
            "called",
            "reply 0: BadTypeMismatch",
            "called",
            "reply 1: BadInvalidState"
        ]
    );
    bench.authority.end("Lift", bench.now().monotonic);
    bench.run();
}

#[test]
fn a_run_has_the_parameters_that_its_own_caller_wrote() {
    let mut bench = Bench::new(HERE);
    bench.ask(ProgramMethod::Reset).unwrap();
    lock(&bench.pending).write(&OTHER, "Force", 9.0.into());
    lock(&bench.pending).write(&ME, "Force", 7.0.into());
    bench.ask(ProgramMethod::Start).unwrap();
    let force = |bench: &Bench| bench.machine.snapshot().parameters.number("Force");
    assert_eq!(force(&bench), Some(7.0));
    bench.end(bench.newest(), done());
    // A second run of the same caller has the same parameters, another caller the defaults.
    bench.ask(ProgramMethod::Start).unwrap();
    assert_eq!(force(&bench), Some(7.0));
    bench.end(bench.newest(), done());
    bench.authority.release(&ME);
    bench.send(OTHER, ProgramMethod::Start, Given::default());
    assert_eq!(force(&bench), Some(20.0));
}

#[test]
fn calls_wait_for_a_stop_and_are_executed_in_their_order() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    bench.story();
    let halt = bench.call(ProgramMethod::Halt);
    let start = bench.execute();
    let second = bench.execute();
    assert_eq!(bench.story(), ["signal Stop"]);
    bench.end(run, stopped());
    let answers = [halt, start, second].map(|call| bench.answer(call).unwrap());
    assert_eq!(answers[0], Ok(1));
    assert_eq!(answers[1], Ok(2));
    assert_eq!(
        answers[2].as_ref().unwrap_err().code,
        RefusalCode::InvalidState
    );
    assert_eq!(
        bench.story().join(", "),
        format!(
            "outcome 1 failed, RunningToHalted, called, reply {halt}: 1, \
         HaltedToReady, parameters, ReadyToRunning, run 2, called, reply {start}: 2, \
         called, reply {second}: BadInvalidState"
        )
    );
}

#[test]
fn a_waiting_start_or_resume_whose_caller_gave_up_is_not_executed() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    let halt = bench.call(ProgramMethod::Halt);
    let start = bench.execute();
    let resume = bench.call(ProgramMethod::Resume);
    for call in [halt, start, resume] {
        bench.calls[call].set(false);
    }
    bench.end(run, stopped());
    assert_eq!(bench.runs.len(), 1);
    assert_eq!(bench.state(), ProgramMachineState::Halted);
    assert_eq!((bench.answer(start), bench.answer(resume)), (None, None));
    assert_eq!(bench.answer(halt), Some(Ok(1)), "a Halt needs no caller");

    // A Halt that waits takes effect without its caller.
    bench.ask(ProgramMethod::Reset).unwrap();
    bench.ask(ProgramMethod::Start).unwrap();
    bench.ask(ProgramMethod::Suspend).unwrap();
    let reset = bench.call(ProgramMethod::Reset);
    let halt = bench.call(ProgramMethod::Halt);
    bench.calls[halt].set(false);
    bench.end(bench.newest(), stopped());
    assert_eq!(bench.answer(reset), Some(Ok(2)));
    assert_eq!(bench.state(), ProgramMachineState::Halted);
}

#[test]
fn a_full_queue_refuses_only_calls_that_nothing_else_refuses() {
    let mut bench = Bench::new(HERE);
    bench.run();
    bench.call(ProgramMethod::Halt);
    for _ in 0..MOST_WAITING {
        let call = bench.call(ProgramMethod::Halt);
        assert_eq!(bench.answer(call), None);
    }
    let mut code = |by, force: f64| {
        let given = Given {
            parameters: Some(vec![("Force".to_owned(), force.into())]),
            ..Given::default()
        };
        let call = bench.send(by, ProgramMethod::Start, given);
        bench.answer(call).unwrap().unwrap_err().code
    };
    assert_eq!(code(OTHER, 1e9), RefusalCode::Locked);
    assert_eq!(code(ME, 1e9), RefusalCode::InvalidArgument);
    assert_eq!(code(ME, 1.0), RefusalCode::TooManyOperations);
    bench.end(bench.newest(), stopped());
    assert_eq!(bench.answers.len(), bench.calls.len());
}

#[test]
fn a_skill_without_suspend_refuses_it_as_not_supported_while_running_only() {
    let mut bench = Bench::new(Setup {
        suspends: false,
        ..HERE
    });
    let code = |bench: &mut Bench| bench.ask(ProgramMethod::Suspend).unwrap_err().code;
    assert_eq!(code(&mut bench), RefusalCode::InvalidState);
    bench.run();
    assert_eq!(code(&mut bench), RefusalCode::NotSupported);
}

#[test]
fn a_replaced_driver_does_the_next_run_and_not_the_run_in_progress() {
    let mut bench = Bench::new(HERE);
    let first = bench.run();
    *lock(&bench.successor) = Some(Successor {
        driver: driver(Setup {
            suspends: false,
            ..ELSEWHERE
        }),
        timeout: Some(seconds(5)),
    });
    bench.ask(ProgramMethod::Suspend).unwrap();
    bench.ask(ProgramMethod::Resume).unwrap();
    bench.pass(seconds(60));
    bench.end(first, done());
    assert!(bench.outcome(first).succeeded);
    let second = bench.run();
    let refusal = bench.ask(ProgramMethod::Suspend).unwrap_err();
    assert_eq!(refusal.code, RefusalCode::NotSupported);
    bench.pass(seconds(6));
    bench.end(second, stopped());
    assert_eq!(
        bench.outcome(second).message,
        "the work was not done within 5s"
    );
}

#[test]
fn a_closed_skill_halts_its_run_and_refuses_waiting_and_later_calls() {
    let mut bench = Bench::new(HERE);
    let run = bench.run();
    let halt = bench.call(ProgramMethod::Halt);
    let waits = bench.execute();
    bench.close();
    let shutdown = Some(Err(SkillRefusal::closed()));
    assert_eq!(bench.answer(waits), shutdown);
    assert!(!bench.machine.is_closed(), "the run has not ended");
    let later = bench.execute();
    assert_eq!(bench.answer(later), shutdown);
    bench.end(run, stopped());
    assert_eq!(bench.answer(halt), Some(Ok(1)));
    assert!(bench.machine.is_closed());
    assert_eq!(bench.state(), ProgramMachineState::Halted);
    assert_eq!(bench.runs.len(), 1);
}
