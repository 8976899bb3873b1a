//! Random calls, reports and times: the rules hold in each of many lives of a skill.

use std::collections::BTreeSet;

use super::*;

/// A sequence of numbers that depends on its seed only (xorshift64*, Vigna 2016).
struct Numbers(u64);

impl Numbers {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33) % limit
    }

    fn pick<T: Clone>(&mut self, from: &[T]) -> T {
        let at = self.below(from.len() as u64);
        from[usize::try_from(at).unwrap()].clone()
    }

    fn one_in(&mut self, limit: u64) -> bool {
        self.below(limit) == 0
    }
}

/// The rules, as seen by the driver, the callers and the observers.
#[derive(Default)]
struct Rules {
    /// Whether every run has a time limit.
    has_limit: bool,
    /// The run whose work goes on.
    at_work: Option<RunId>,
    is_aborted: bool,
    /// Whether a Halt was accepted and the skill has not been made ready since.
    is_halted: bool,
    /// Whether the driver reported an unknown end of the work that goes on.
    is_unknown: bool,
    /// The runs whose work was done.
    done: BTreeSet<u32>,
    /// The runs whose end their driver did not know, in a run that had not ended.
    unknown: BTreeSet<u32>,
    outcomes: BTreeMap<u32, String>,
    halts: BTreeSet<usize>,
    withdrawn: BTreeSet<usize>,
}

impl Rules {
    fn check(&mut self, bench: &mut Bench) {
        for text in bench.story() {
            let words: Vec<&str> = text.split(' ').collect();
            match words[..] {
                ["run", _] => {
                    assert_eq!(self.at_work, None, "the work before has not ended");
                    assert!(!self.is_halted, "a Halt was accepted");
                    self.at_work = Some(bench.newest());
                    (self.is_aborted, self.is_unknown) = (false, false);
                }
                ["signal", "Go"] => {
                    assert!(!self.is_halted, "a Halt was accepted");
                    assert!(!self.is_aborted, "the work was aborted");
                }
                ["signal", _] => assert!(self.at_work.is_some(), "a signal without work"),
                ["abort"] => {
                    assert!(self.at_work.is_some(), "an abort without work");
                    self.is_aborted = true;
                }
                ["HaltedToReady"] => self.is_halted = false,
                ["outcome", run, end] => {
                    let run: u32 = run.parse().unwrap();
                    let before = self.outcomes.insert(run, end.to_owned());
                    assert_eq!(before, None, "the second outcome of run {run}");
                    assert!(
                        end != "done" || self.done.contains(&run),
                        "run {run} is done?"
                    );
                    let is_known = end != "unknown" && self.unknown.contains(&run);
                    assert!(!is_known, "run {run} ends {end}, and its end is unknown");
                }
                ["reply", call, ref answer @ ..] => {
                    let call: usize = call.trim_end_matches(':').parse().unwrap();
                    let is_accepted = answer[0].parse::<u32>().is_ok();
                    self.is_halted |= is_accepted && self.halts.contains(&call);
                }
                _ => {}
            }
        }
        let open =
            |call: &usize| !bench.answers.contains_key(call) && !self.withdrawn.contains(call);
        let waits = (0..bench.calls.len()).any(|call| open(&call));
        assert!(
            !waits || bench.machine.poll_deadline().is_some(),
            "a call waits without an end"
        );
        let is_running = bench.state() == ProgramMachineState::Running;
        let is_stopped = bench.machine.work.is_halting(bench.now()).is_some();
        assert!(
            !(is_running && self.has_limit)
                || is_stopped
                || bench.machine.poll_deadline().is_some(),
            "a run has lost its time limit"
        );
    }

    fn end(&mut self, bench: &mut Bench, result: WorkEnd) {
        let Some(run) = self.at_work.take() else {
            return;
        };
        let number = run.number();
        match &result {
            Ok(_) => {
                self.done.insert(number);
            }
            Err(RunFailure::Panicked { .. }) if !self.outcomes.contains_key(&number) => {
                self.unknown.insert(number);
            }
            Err(_) if self.is_unknown && !self.outcomes.contains_key(&number) => {
                self.unknown.insert(number);
            }
            Err(_) => {}
        }
        bench.end(run, result);
    }
}

fn setup(numbers: &mut Numbers) -> Setup {
    Setup {
        suspends: !numbers.one_in(3),
        halt_timeout: numbers.one_in(2).then_some(seconds(2)),
        timeout: numbers.one_in(2).then_some(seconds(3)),
        rests_in: match numbers.one_in(3) {
            true => Rest::Halted,
            false => Rest::Ready,
        },
    }
}

fn call(bench: &mut Bench, rules: &mut Rules, numbers: &mut Numbers) {
    let owners = [ME, OTHER, SkillOwner::Space(3), SkillOwner::Local("mes")];
    let by = match numbers.one_in(6) {
        true => numbers.pick(&owners),
        false => ME,
    };
    let method = numbers.pick(&ProgramMethod::ALL);
    let given = match method == ProgramMethod::Start && numbers.one_in(2) {
        true => Given {
            within: numbers.one_in(2).then_some(seconds(1)),
            ..ready_first()
        },
        false => Given::default(),
    };
    if method == ProgramMethod::Halt {
        rules.halts.insert(bench.calls.len());
    }
    let number = bench.send(by, method, given);
    let gives_up = bench.answer(number).is_none() && numbers.one_in(4);
    if gives_up {
        bench.calls[number].set(false);
        rules.withdrawn.insert(number);
    }
}

fn report(bench: &mut Bench, rules: &mut Rules, numbers: &mut Numbers) {
    let text = format!("report {}", numbers.below(3));
    let line = match numbers.below(6) {
        0 => Line::Pending(text),
        1 => Line::Refused(text),
        2 => Line::Unknown(text),
        3 => Line::Note(text),
        _ => Line::Step(text),
    };
    // Reports of earlier runs come too.
    let earlier = bench.runs.first().copied().filter(|_| numbers.one_in(8));
    let Some(run) = earlier.or(rules.at_work) else {
        return;
    };
    if rules.at_work == Some(run) {
        rules.is_unknown |= matches!(line, Line::Unknown(_));
        // The executor lets the run go on, whatever was accepted before.
        rules.is_halted &= !matches!(line, Line::Refused(_));
    }
    bench.report(run, line);
}

fn end(bench: &mut Bench, rules: &mut Rules, numbers: &mut Numbers) {
    let result = match numbers.below(5) {
        _ if rules.is_aborted && !numbers.one_in(4) => aborted(),
        0 => failed("no part"),
        1 => Err(RunFailure::Panicked {
            panic: "a wire is loose".to_owned(),
        }),
        2 => stopped(),
        _ => done(),
    };
    rules.end(bench, result);
}

/// A run exceeds its limit, a Halt is accepted, and the executor refuses it.
fn refuse_late(bench: &mut Bench, rules: &mut Rules) {
    bench.pass(seconds(4));
    rules.check(bench);
    rules.halts.insert(bench.calls.len());
    bench.call(ProgramMethod::Halt);
    rules.check(bench);
    if let Some(run) = rules.at_work {
        rules.is_halted = false;
        bench.report(run, Line::Refused("the robot goes on".to_owned()));
    }
}

/// One life of a skill: calls, reports and times in a random order, and then its end.
fn live(seed: u64) -> (usize, u64) {
    let mut numbers = Numbers(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    let setup = setup(&mut numbers);
    let mut bench = Bench::new(setup);
    let mut rules = Rules {
        has_limit: setup.timeout.is_some(),
        ..Rules::default()
    };
    for _ in 0..400 {
        match numbers.below(10) {
            0..4 => call(&mut bench, &mut rules, &mut numbers),
            4..6 => report(&mut bench, &mut rules, &mut numbers),
            6 => end(&mut bench, &mut rules, &mut numbers),
            7 if numbers.one_in(4) => bench.authority.release(&ME),
            7 if numbers.one_in(16) => refuse_late(&mut bench, &mut rules),
            _ => {
                let time = millis(numbers.pick(&[0, 50, 100, 500, 1_000, 2_500]));
                bench.pass(time);
            }
        }
        rules.check(&mut bench);
    }
    bench.close();
    rules.check(&mut bench);
    bench.pass(seconds(60));
    rules.check(&mut bench);
    assert!(bench.machine.is_closed(), "the skill ends within a minute");
    let mut unanswered = (0..bench.calls.len()).filter(|call| !bench.answers.contains_key(call));
    assert!(unanswered.all(|call| rules.withdrawn.contains(&call)));
    (bench.runs.len(), bench.machine.ignored())
}

#[test]
fn the_rules_hold_in_every_order_of_calls_reports_and_times() {
    let (mut runs, mut ignored) = (0, 0);
    for seed in 1..=300 {
        let life = std::panic::catch_unwind(|| live(seed));
        let (its_runs, its_ignored) = life.unwrap_or_else(|_| panic!("seed {seed}"));
        runs += its_runs;
        ignored += its_ignored;
    }
    // The lives have what the rules are about.
    assert!(runs > 2_000, "{runs} runs");
    assert!(ignored > 100, "{ignored} ignored reports");
}
