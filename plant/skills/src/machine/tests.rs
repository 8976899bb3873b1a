//! Tests of the state of a skill with simulated time: no clock, no task, no driver at work.

mod calls;
mod ends;
mod random;
mod stops;

use std::cell::Cell;
use std::collections::BTreeMap;
use std::rc::Rc;

use async_trait::async_trait;
use program::Rest;

use super::output::SkillNotice;
use super::*;
use crate::driver::{RunResults, Work};
use crate::lock::lock;
use crate::model;
use crate::parameters::ParameterType;
use crate::refusal::RefusalCode;
use crate::value::SkillValue;

const ME: SkillOwner = SkillOwner::Session(1);
const OTHER: SkillOwner = SkillOwner::Session(2);

/// A driver whose work the test does.
struct Idle {
    suspends: bool,
    halt_timeout: Option<Duration>,
}

#[async_trait]
impl Driver for Idle {
    fn can_suspend(&self) -> bool {
        self.suspends
    }

    fn halt_timeout(&self) -> Option<Duration> {
        self.halt_timeout
    }

    async fn run(&self, _work: Work) -> Result<RunResults, DriverError> {
        unreachable!("the test does the work")
    }
}

/// A caller, which may give up.
struct TestCaller {
    number: usize,
    is_wanted: Rc<Cell<bool>>,
}

impl CallReply for TestCaller {
    fn is_wanted(&self) -> bool {
        self.is_wanted.get()
    }
}

/// A skill, its clock, its outputs and the responses to its calls.
struct Bench {
    machine: SkillMachine<TestCaller>,
    authority: Authority,
    pending: Arc<Mutex<PendingParameters>>,
    outcomes: NewestOutcomes,
    successor: Arc<Mutex<Option<Successor>>>,
    start: Instant,
    elapsed: Duration,
    /// Whether clients see that a Reset is needed.
    needs_reset: bool,
    /// The outputs as text.
    log: Vec<String>,
    /// The runs that the driver was to start.
    runs: Vec<RunId>,
    calls: Vec<Rc<Cell<bool>>>,
    answers: BTreeMap<usize, Result<u32, SkillRefusal>>,
}

/// The properties of a skill for a test.
#[derive(Clone, Copy)]
struct Setup {
    suspends: bool,
    halt_timeout: Option<Duration>,
    timeout: Option<Duration>,
    rests_in: Rest,
}

/// Work that is done in this process.
const HERE: Setup = Setup {
    suspends: true,
    halt_timeout: None,
    timeout: None,
    rests_in: Rest::Ready,
};

/// Work that is done elsewhere, and is given up ten seconds after Halt.
const ELSEWHERE: Setup = Setup {
    halt_timeout: Some(Duration::from_secs(10)),
    ..HERE
};

impl Bench {
    fn new(setup: Setup) -> Self {
        let of = model::find("GraspSkillType").unwrap();
        let facts = SkillDescription {
            name: "Grasp".to_owned(),
            types: vec![ParameterType::own(of.name)],
            parameters: of.parameters(),
            results: of.results(),
            capabilities: Vec::new(),
            timeout: setup.timeout,
            rests_in: setup.rests_in,
        };
        let authority = Authority::new();
        let pending = Arc::default();
        let outcomes = NewestOutcomes::default();
        let successor = Arc::default();
        let parts = MachineParts {
            facts: Arc::new(facts),
            driver: driver(setup),
            authority: authority.clone(),
            pending: Arc::clone(&pending),
            outcomes: outcomes.clone(),
            successor: Arc::clone(&successor),
            first_run: 1,
        };
        Self {
            machine: SkillMachine::new(parts, SystemTime::UNIX_EPOCH),
            authority,
            pending,
            outcomes,
            successor,
            start: Instant::now(),
            elapsed: Duration::ZERO,
            needs_reset: false,
            log: Vec::new(),
            runs: Vec::new(),
            calls: Vec::new(),
            answers: BTreeMap::new(),
        }
    }

    fn now(&self) -> Moment {
        Moment {
            monotonic: self.start + self.elapsed,
            wall: SystemTime::UNIX_EPOCH + self.elapsed,
        }
    }

    fn state(&self) -> ProgramMachineState {
        self.machine.snapshot().state
    }

    /// Sends a call. Returns its number.
    fn send(&mut self, by: SkillOwner, method: ProgramMethod, given: Given) -> usize {
        let number = self.calls.len();
        let is_wanted = Rc::new(Cell::new(true));
        self.calls.push(Rc::clone(&is_wanted));
        let call = SkillCallRequest {
            by,
            method,
            given,
            reply: TestCaller { number, is_wanted },
        };
        self.machine.call(call);
        self.drain();
        number
    }

    fn call(&mut self, method: ProgramMethod) -> usize {
        self.send(ME, method, Given::default())
    }

    /// Sends a call that needs no time. Returns its response.
    fn ask(&mut self, method: ProgramMethod) -> Result<u32, SkillRefusal> {
        let number = self.call(method);
        self.answer(number).expect("the call does not wait")
    }

    /// Sends a Start that makes the skill ready first.
    fn execute(&mut self) -> usize {
        self.send(ME, ProgramMethod::Start, ready_first())
    }

    fn answer(&self, number: usize) -> Option<Result<u32, SkillRefusal>> {
        self.answers.get(&number).cloned()
    }

    /// Starts a run from Halted. Returns it.
    fn run(&mut self) -> RunId {
        let number = self.execute();
        assert!(matches!(self.answer(number), Some(Ok(_))));
        self.newest()
    }

    fn newest(&self) -> RunId {
        *self.runs.last().expect("a run was started")
    }

    fn report(&mut self, run: RunId, line: Line) {
        self.machine.report(run, line, self.now());
        self.drain();
    }

    fn end(&mut self, run: RunId, result: WorkEnd) {
        self.machine.ended(run, result, self.now());
        self.drain();
    }

    /// Lets the time pass, and handles the deadlines at their time.
    fn pass(&mut self, time: Duration) {
        let until = self.elapsed + time;
        while let Some(deadline) = self.machine.poll_deadline()
            && deadline <= self.start + until
        {
            let at = deadline.saturating_duration_since(self.start);
            self.elapsed = self.elapsed.max(at);
            self.machine.handle_deadline(self.now());
            self.drain();
        }
        self.elapsed = until;
    }

    fn close(&mut self) {
        self.machine.close();
        self.drain();
    }

    fn outcome(&self, run: RunId) -> Arc<crate::shown::RunOutcome> {
        let outcome = self.outcomes.of(run.number());
        outcome.expect("the run has an outcome")
    }

    /// Returns the outputs since the last call of this method.
    fn story(&mut self) -> Vec<String> {
        std::mem::take(&mut self.log)
    }

    /// Returns an event as text.
    fn notice(&self, notice: &SkillNotice, shown: &SkillSnapshot) -> String {
        match notice {
            SkillNotice::Parameters(_) => "parameters".to_owned(),
            SkillNotice::Transition(of) => {
                assert_eq!((shown.state, of.run), (of.transition.to, shown.run));
                of.transition.name.to_owned()
            }
            SkillNotice::Step => format!("step {}", shown.step),
            SkillNotice::Pending(why) => format!("pending {why}"),
            SkillNotice::Progress => format!("progress {}", shown.progress),
            SkillNotice::Outcome(of) => {
                let idle = self.authority.idle(self.now().monotonic);
                assert_eq!(idle, None, "the outcome is shown before another run starts");
                let end = match (of.succeeded, of.unknown) {
                    (true, false) => "done",
                    (false, false) => "failed",
                    (false, true) => "unknown",
                    (true, true) => panic!("an unknown outcome is no success: {of:?}"),
                };
                format!("outcome {} {end}", of.run)
            }
            SkillNotice::Called => "called".to_owned(),
        }
    }

    fn drain(&mut self) {
        while let Some(output) = self.machine.poll_output(self.now()) {
            let text = match output {
                SkillOutput::Release { at } => {
                    let now = self.machine.snapshot().needs_reset;
                    assert_eq!(
                        self.needs_reset, now,
                        "clients see first that a Reset is needed"
                    );
                    self.authority.end("Grasp", at);
                    continue;
                }
                SkillOutput::Event(notice, shown) => {
                    self.needs_reset = shown.needs_reset;
                    self.notice(&notice, &shown)
                }
                SkillOutput::Run { run, .. } => {
                    self.runs.push(run);
                    format!("run {}", run.number())
                }
                SkillOutput::Signal(signal) => format!("signal {signal:?}"),
                SkillOutput::Abort => "abort".to_owned(),
                SkillOutput::Reply(caller, answer) => {
                    let text = match &answer {
                        Ok(run) => format!("reply {}: {run}", caller.number),
                        Err(refusal) => format!("reply {}: {}", caller.number, refusal.code.name()),
                    };
                    let before = self.answers.insert(caller.number, answer);
                    assert_eq!(
                        before, None,
                        "the second response to call {}",
                        caller.number
                    );
                    text
                }
            };
            self.log.push(text);
        }
    }
}

fn driver(setup: Setup) -> Arc<dyn Driver> {
    Arc::new(Idle {
        suspends: setup.suspends,
        halt_timeout: setup.halt_timeout,
    })
}

fn ready_first() -> Given {
    Given {
        parameters: Some(Vec::new()),
        within: None,
        readies: true,
    }
}

fn done() -> WorkEnd {
    Ok(vec![("Gripped".to_owned(), SkillValue::Boolean(true))])
}

fn stopped() -> WorkEnd {
    Err(RunFailure::Driver(DriverError::Stopped))
}

fn failed(why: &str) -> WorkEnd {
    Err(RunFailure::Driver(DriverError::reported(why)))
}

fn aborted() -> WorkEnd {
    Err(RunFailure::Aborted)
}

const fn seconds(of: u64) -> Duration {
    Duration::from_secs(of)
}

const fn millis(of: u64) -> Duration {
    Duration::from_millis(of)
}
