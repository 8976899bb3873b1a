//! Tests of a skill with a driver, without a server.

use std::sync::atomic::{AtomicU32, Ordering};
use tokio::time::Instant;

use async_trait::async_trait;
use program::{ProgramMachineState, Rest};
use tokio::sync::Semaphore;

use super::*;
use crate::driver::{RunResults, Work};
use crate::driver_error::DriverError;
use crate::model;
use crate::parameters::ParameterType;
use crate::shown::{SkillEvent, Transitioned};

const ME: SkillOwner = SkillOwner::Session(1);
const OTHER: SkillOwner = SkillOwner::Session(2);
const HALT_TIMEOUT: Duration = Duration::from_secs(10);

/// A driver that behaves as `how` defines. A permit of `gate` lets waiting work end.
struct Scripted {
    how: How,
    gate: Arc<Semaphore>,
    began: AtomicU32,
}

enum How {
    AtOnce,
    WhenLet,
    Panics,
    Fails,
    /// Neither ends nor reacts to the stop signal.
    Deaf,
    /// Ends when it is stopped, and reports that its end is unknown.
    Lost,
    /// Ends when it is stopped and a permit is there.
    StopsWhenLet,
    /// Blocks its thread.
    Blocks(Duration),
    /// Is done elsewhere and reports this when it is stopped. It ends as stopped at the next
    /// permit.
    Elsewhere(Elsewhere),
}

#[derive(Clone, Copy)]
enum Elsewhere {
    Cancels,
    Refuses,
}

#[async_trait]
impl Driver for Scripted {
    fn can_suspend(&self) -> bool {
        matches!(self.how, How::WhenLet | How::Lost)
    }

    fn halt_timeout(&self) -> Option<Duration> {
        match self.how {
            How::Elsewhere(_) => Some(HALT_TIMEOUT),
            How::AtOnce
            | How::WhenLet
            | How::Panics
            | How::Fails
            | How::Deaf
            | How::Lost
            | How::StopsWhenLet
            | How::Blocks(_) => None,
        }
    }

    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        self.began.fetch_add(1, Ordering::SeqCst);
        match self.how {
            How::AtOnce => {}
            How::WhenLet => {
                tokio::select! {
                    permit = self.gate.acquire() => permit.unwrap().forget(),
                    () = work.stopped() => return Err(DriverError::Stopped),
                }
            }
            How::Panics => panic!("a wire is loose"),
            How::Fails => return Err(DriverError::reported("nothing is there")),
            How::Deaf => std::future::pending().await,
            How::Lost => {
                work.stopped().await;
                work.unknown("the robot is lost").await;
                return Err(DriverError::reported("the robot is lost"));
            }
            How::StopsWhenLet => {
                work.stopped().await;
                self.gate.acquire().await.unwrap().forget();
                return Err(DriverError::Stopped);
            }
            How::Blocks(time) => block(time),
            How::Elsewhere(how) => {
                work.stopped().await;
                match how {
                    Elsewhere::Cancels => work.pending("the goal has not ended").await,
                    Elsewhere::Refuses => work.cancel_refused("the robot goes on").await,
                }
                self.gate.acquire().await.unwrap().forget();
                return Err(DriverError::Stopped);
            }
        }
        Ok(vec![("Gripped".to_owned(), true.into())])
    }
}

#[expect(
    clippy::disallowed_methods,
    reason = "a driver that does not give its thread back is what it is about"
)]
fn block(time: Duration) {
    std::thread::sleep(time);
}

#[derive(Default)]
struct Seen {
    transitions: Vec<(u32, u32)>,
    story: Vec<String>,
}

struct Log(Arc<Mutex<Seen>>);

impl SkillObserver for Log {
    fn told(&self, what: SkillEvent<'_>, shown: &SkillSnapshot) {
        let mut seen = lock(&self.0);
        match what {
            SkillEvent::Parameters(_) => seen.story.push("parameters".to_owned()),
            SkillEvent::Transition(Transitioned {
                transition, run, ..
            }) => {
                assert_eq!(shown.state, transition.to);
                seen.transitions.push((transition.number, *run));
                seen.story.push(transition.name.to_owned());
            }
            SkillEvent::Step => seen.story.push(format!("step {}", shown.step)),
            SkillEvent::Pending(why) => seen.story.push(format!("pending {why}")),
            SkillEvent::Outcome(outcome) => {
                seen.story.push(format!("outcome {}", outcome.succeeded))
            }
            SkillEvent::Progress | SkillEvent::Called => {}
        }
    }
}

struct Bench {
    skill: Skill,
    driver: Arc<Scripted>,
    gate: Arc<Semaphore>,
    seen: Arc<Mutex<Seen>>,
}

fn facts(type_name: &str, timeout: Option<Duration>) -> SkillDescription {
    let skill_type = model::find(type_name).unwrap();
    SkillDescription {
        name: "Grasp".to_owned(),
        types: skill_type
            .chain()
            .map(|of| ParameterType::own(of.name))
            .collect(),
        parameters: skill_type.parameters(),
        results: skill_type.results(),
        capabilities: Vec::new(),
        timeout,
        rests_in: skill_type.rests_in,
    }
}

fn bench_of(how: How, type_name: &str, timeout: Option<Duration>) -> Bench {
    let gate = Arc::new(Semaphore::new(0));
    let driver = Arc::new(Scripted {
        how,
        gate: Arc::clone(&gate),
        began: AtomicU32::new(0),
    });
    let seen = Arc::default();
    let log = Box::new(Log(Arc::clone(&seen)));
    let skill = Skill::spawn(
        facts(type_name, timeout),
        driver.clone(),
        Authority::new(),
        vec![log],
    );
    Bench {
        skill,
        driver,
        gate,
        seen,
    }
}

fn bench(how: How) -> Bench {
    bench_of(how, "GraspSkillType", None)
}

impl Bench {
    async fn call(&self, method: ProgramMethod) -> Result<u32, SkillRefusal> {
        self.skill.call(ME, method).await
    }

    async fn until(&self, state: ProgramMachineState) -> Arc<SkillSnapshot> {
        let mut watch = self.skill.watch();
        let found = tokio::time::timeout(
            Duration::from_secs(5),
            watch.wait_for(|shown| shown.state == state),
        )
        .await;
        found.expect("the state comes in time").unwrap().clone()
    }

    async fn run_to(&self, state: ProgramMachineState) -> Arc<SkillSnapshot> {
        self.call(ProgramMethod::Reset).await.unwrap();
        self.call(ProgramMethod::Start).await.unwrap();
        self.until(state).await
    }

    fn numbers(&self) -> Vec<u32> {
        lock(&self.seen)
            .transitions
            .iter()
            .map(|(number, _)| *number)
            .collect()
    }
}

#[tokio::test]
async fn the_transition_is_told_before_the_work_begins_and_the_outcome_before_its_end() {
    let bench = bench(How::AtOnce);
    let shown = bench.run_to(ProgramMachineState::Ready).await;
    let story = lock(&bench.seen).story.clone();
    let expected = [
        "HaltedToReady",
        "parameters",
        "ReadyToRunning",
        "outcome true",
        "RunningToReady",
    ];
    assert_eq!(story, expected);
    let outcome = shown.outcome.clone().unwrap();
    assert_eq!(
        outcome.results,
        [("Gripped".to_owned(), SkillValue::Boolean(true))]
    );
    assert_eq!((shown.run, shown.progress), (1, 1.0));
    assert_eq!(bench.skill.outcome(1), Some(outcome));
    assert_eq!(bench.skill.outcome(2), None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn ten_thousand_runs_that_end_at_once_never_stick() {
    let bench = bench(How::AtOnce);
    bench.call(ProgramMethod::Reset).await.unwrap();
    let mut watch = bench.skill.watch();
    for run in 1..=10_000 {
        assert_eq!(bench.call(ProgramMethod::Start).await, Ok(run));
        let ended =
            watch.wait_for(|shown| shown.state == ProgramMachineState::Ready && shown.run == run);
        let ended = tokio::time::timeout(Duration::from_secs(5), ended).await;
        assert!(ended.is_ok(), "run {run} does not end");
    }
    assert_eq!(bench.driver.began.load(Ordering::SeqCst), 10_000);
}

#[tokio::test]
async fn of_two_clients_that_race_one_begins_one_run_with_its_own_parameters() {
    let bench = bench(How::WhenLet);
    bench.call(ProgramMethod::Reset).await.unwrap();
    bench.skill.write(&ME, "Force", 7.0.into()).unwrap();
    let refusal = bench
        .skill
        .write(&OTHER, "Force", 900.0.into())
        .unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "BadLocked: session 1 has the lease of this component"
    );
    let (first, second) = tokio::join!(
        bench.call(ProgramMethod::Start),
        bench.skill.call(OTHER, ProgramMethod::Start)
    );
    assert_eq!(first, Ok(1));
    assert_eq!(second.unwrap_err().code, RefusalCode::Locked);
    assert_eq!(bench.skill.shown().parameters.number("Force"), Some(7.0));
    // The authority is checked before everything else.
    let refusal = bench
        .skill
        .call(OTHER, ProgramMethod::Reset)
        .await
        .unwrap_err();
    assert_eq!(refusal.code, RefusalCode::Locked);
    // The run outlives the session; the lease does not.
    bench.skill.authority.release(&ME);
    assert_eq!(bench.skill.shown().state, ProgramMachineState::Running);
    bench.gate.add_permits(1);
    bench.until(ProgramMachineState::Ready).await;
    assert!(bench.skill.outcome(1).unwrap().succeeded);
    // The second client does not inherit the parameters of the first.
    bench.skill.call(OTHER, ProgramMethod::Start).await.unwrap();
    assert_eq!(bench.skill.shown().parameters.number("Force"), Some(20.0));
}

#[tokio::test]
async fn a_type_that_rests_in_halted_ends_there_and_its_success_is_told() {
    let facts = SkillDescription {
        rests_in: Rest::Halted,
        ..facts("GraspSkillType", None)
    };
    let driver = Arc::new(Scripted {
        how: How::AtOnce,
        gate: Arc::new(Semaphore::new(0)),
        began: AtomicU32::new(0),
    });
    let skill = Skill::spawn(facts, driver, Authority::new(), Vec::new());
    for run in 1..=2 {
        assert_eq!(skill.execute(ME, Vec::new(), None).await, Ok(run));
        let mut watch = skill.watch();
        let halted =
            watch.wait_for(|shown| shown.state == ProgramMachineState::Halted && shown.run == run);
        tokio::time::timeout(Duration::from_secs(5), halted)
            .await
            .unwrap()
            .unwrap();
        assert!(skill.outcome_of(run).unwrap().unwrap().succeeded);
    }
    assert_eq!(skill.outcome_of(3).unwrap_err().code, RefusalCode::NotFound);
    assert_eq!(skill.outcome_of(0).unwrap().unwrap().run, 2);
}

#[tokio::test]
async fn execute_makes_ready_and_begins_at_once_or_changes_nothing() {
    let bench = bench(How::WhenLet);
    let wrong = vec![("Force".to_owned(), SkillValue::from("much"))];
    let refusal = bench.skill.execute(ME, wrong, None).await.unwrap_err();
    assert_eq!(refusal.code, RefusalCode::TypeMismatch);
    assert_eq!(bench.numbers(), Vec::<u32>::new());
    assert_eq!(bench.skill.execute(ME, Vec::new(), None).await, Ok(1));
    assert_eq!(bench.skill.outcome_of(1), Ok(None));
    let refusal = bench.skill.execute(ME, Vec::new(), None).await;
    assert_eq!(refusal.unwrap_err().code, RefusalCode::InvalidState);
    let within = Some(Duration::from_millis(20));
    bench.call(ProgramMethod::Halt).await.unwrap();
    assert_eq!(bench.skill.execute(ME, Vec::new(), within).await, Ok(2));
    let shown = bench.until(ProgramMachineState::Halted).await;
    assert_eq!(
        shown.outcome.as_ref().unwrap().message,
        "the work was not done within 20ms"
    );
    assert_eq!(bench.numbers(), [1, 2, 3, 1, 2, 3]);
}

#[tokio::test]
async fn a_full_queue_is_told_of_only_where_nothing_else_is_wrong() {
    let bench = bench(How::Deaf);
    bench.run_to(ProgramMachineState::Running).await;
    // Halt of work that does not react takes a second, in which calls wait.
    let halting = bench.skill.call(ME, ProgramMethod::Halt);
    let mut waiting: Vec<_> = (0..crate::machine::MOST_WAITING)
        .map(|_| Box::pin(bench.skill.call(ME, ProgramMethod::Halt)))
        .collect();
    let mut halting = Box::pin(halting);
    assert!(futures_util::poll!(&mut halting).is_pending());
    tokio::task::yield_now().await;
    for call in &mut waiting {
        assert!(futures_util::poll!(call).is_pending());
    }
    let force = |of: f64| vec![("Force".to_owned(), SkillValue::from(of))];
    let code = async |by, given| {
        let refusal = bench.skill.start_with(by, given).await.unwrap_err();
        refusal.code
    };
    assert_eq!(code(OTHER, force(1e9)).await, RefusalCode::Locked);
    assert_eq!(code(ME, force(1e9)).await, RefusalCode::InvalidArgument);
    assert_eq!(code(ME, force(1.0)).await, RefusalCode::TooManyOperations);
}

#[tokio::test]
async fn a_start_whose_caller_gave_up_during_a_halt_is_not_executed() {
    let bench = bench(How::StopsWhenLet);
    bench.run_to(ProgramMachineState::Running).await;
    let mut halting = Box::pin(bench.call(ProgramMethod::Halt));
    assert!(futures_util::poll!(&mut halting).is_pending());
    {
        let mut start = Box::pin(bench.skill.execute(ME, Vec::new(), None));
        assert!(futures_util::poll!(&mut start).is_pending());
    }
    bench.gate.add_permits(1);
    halting.await.unwrap();
    assert_eq!(bench.call(ProgramMethod::Reset).await, Ok(1));
    assert_eq!(bench.driver.began.load(Ordering::SeqCst), 1);
}

#[tokio::test]
async fn a_space_has_the_lease_while_its_run_goes_on_and_no_longer() {
    let bench = bench(How::WhenLet);
    let space = SkillOwner::Space(2);
    bench
        .skill
        .call(space.clone(), ProgramMethod::Reset)
        .await
        .unwrap();
    assert_eq!(*bench.skill.authority.holder().borrow(), None);
    bench.skill.start_with(space.clone(), vec![]).await.unwrap();
    assert_eq!(*bench.skill.authority.holder().borrow(), Some(space));
    assert_eq!(
        bench.call(ProgramMethod::Halt).await.unwrap_err().code,
        RefusalCode::Locked
    );
    bench.gate.add_permits(1);
    bench.until(ProgramMachineState::Ready).await;
    assert_eq!(*bench.skill.authority.holder().borrow(), None);
    assert!(bench.call(ProgramMethod::Halt).await.is_ok());
}

#[tokio::test]
async fn a_wrong_or_missing_parameter_moves_nothing() {
    let bench = bench_of(How::AtOnce, "PtpMoveSkillType", None);
    bench.call(ProgramMethod::Reset).await.unwrap();
    let refusal = bench.call(ProgramMethod::Start).await.unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "BadArgumentsMissing: TargetPosition must be given"
    );
    let refusal = bench
        .skill
        .write(&ME, "TargetPosition", vec![1.0].into())
        .unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "BadInvalidArgument: TargetPosition has 6 values, and 1 were given"
    );
    let fast = vec![
        ("TargetPosition".to_owned(), [0.1; 6].into()),
        ("MaxVelocity".to_owned(), 99.0.into()),
    ];
    let refusal = bench.skill.start_with(ME, fast).await.unwrap_err();
    assert_eq!(refusal.code, RefusalCode::InvalidArgument);
    assert_eq!(
        (bench.skill.shown().state, bench.skill.shown().run),
        (ProgramMachineState::Ready, 0)
    );
    assert_eq!(bench.driver.began.load(Ordering::SeqCst), 0);
    bench
        .skill
        .write(&ME, "TargetPosition", [0.1; 6].into())
        .unwrap();
    assert_eq!(bench.call(ProgramMethod::Start).await, Ok(1));
}

#[tokio::test]
async fn parameters_of_a_run_are_kept_while_it_goes_on() {
    let bench = bench(How::WhenLet);
    bench.run_to(ProgramMachineState::Running).await;
    let refusal = bench.skill.write(&ME, "Force", 1.0.into()).unwrap_err();
    assert_eq!(refusal.code, RefusalCode::InvalidState);
    assert_eq!(bench.skill.shown().parameters.number("Force"), Some(20.0));
}

#[tokio::test]
async fn a_driver_that_breaks_down_or_fails_leaves_a_halted_skill_that_says_why() {
    for (how, why) in [
        (
            How::Panics,
            "the driver broke down: a wire is loose; the outcome is unknown, check the machine",
        ),
        (How::Fails, "nothing is there"),
    ] {
        let panics = matches!(how, How::Panics);
        let bench = bench(how);
        let shown = bench.run_to(ProgramMachineState::Halted).await;
        let outcome = shown.outcome.clone().unwrap();
        assert_eq!(
            (outcome.run, outcome.succeeded, outcome.message.as_str()),
            (1, false, why)
        );
        assert_eq!(outcome.unknown, panics, "{why}");
        assert_eq!(bench.numbers(), [1, 2, 3]);
        assert!(
            bench.call(ProgramMethod::Reset).await.is_ok(),
            "it can be used again"
        );
    }
}

#[tokio::test]
async fn a_driver_that_does_not_hear_is_broken_off() {
    let bench = bench(How::Deaf);
    bench.run_to(ProgramMachineState::Running).await;
    let asked = Instant::now();
    bench.call(ProgramMethod::Halt).await.unwrap();
    assert!(asked.elapsed() < Duration::from_secs(2));
    let shown = bench.until(ProgramMachineState::Halted).await;
    let message = &shown.outcome.as_ref().unwrap().message;
    assert!(message.ends_with("was broken off"), "{message}");
    bench.call(ProgramMethod::Reset).await.unwrap();
    assert_eq!(bench.call(ProgramMethod::Start).await, Ok(2));
}

#[tokio::test]
async fn stopped_work_without_a_known_end_needs_a_reset() {
    let limit = Some(Duration::from_millis(20));
    for (how, limit, why) in [
        (How::Lost, None, "halted by session 1; the robot is lost"),
        (
            How::Deaf,
            None,
            "halted by session 1; the outcome is unknown: its work did not stop within 1s and was broken off",
        ),
        (
            How::Lost,
            limit,
            "the work was not done within 20ms; the robot is lost",
        ),
        (
            How::Deaf,
            limit,
            "the work was not done within 20ms; the outcome is unknown: its work did not stop within 1s and was broken off",
        ),
    ] {
        let bench = bench_of(how, "GraspSkillType", limit);
        bench.run_to(ProgramMachineState::Running).await;
        if limit.is_none() {
            bench.call(ProgramMethod::Halt).await.unwrap();
        }
        let shown = bench.until(ProgramMachineState::Halted).await;
        assert!(shown.needs_reset);
        assert_eq!(bench.skill.outcome(1).unwrap().message, why);
        let refused = bench.skill.execute(ME, Vec::new(), None).await.unwrap_err();
        assert_eq!(refused.code, RefusalCode::InvalidState, "{refused}");
        let refused = bench.call(ProgramMethod::Start).await.unwrap_err();
        let expected = "the outcome of run 1 is unknown; Reset makes the skill ready";
        assert!(refused.to_string().contains(expected), "{refused}");
        bench.call(ProgramMethod::Reset).await.unwrap();
        assert!(!bench.skill.shown().needs_reset);
        assert_eq!(bench.skill.execute(ME, Vec::new(), None).await, Ok(2));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_still_blocks_is_not_started_anew() {
    let bench = bench(How::Blocks(Duration::from_secs(2)));
    bench.run_to(ProgramMachineState::Running).await;
    bench.call(ProgramMethod::Halt).await.unwrap();
    let refusal = bench.call(ProgramMethod::Reset).await.unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "BadInvalidState: the work of run 1 has not come to an end"
    );
    assert_eq!(bench.skill.shown().state, ProgramMachineState::Halted);
    let free = async {
        while bench.call(ProgramMethod::Reset).await.is_err() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(5), free)
        .await
        .unwrap();
    assert_eq!(bench.skill.shown().state, ProgramMachineState::Ready);
}

#[tokio::test]
async fn a_run_that_takes_too_long_fails() {
    let bench = bench_of(
        How::WhenLet,
        "GraspSkillType",
        Some(Duration::from_millis(20)),
    );
    let shown = bench.run_to(ProgramMachineState::Halted).await;
    assert_eq!(
        shown.outcome.as_ref().unwrap().message,
        "the work was not done within 20ms"
    );
    // Suspended time does not count.
    bench.call(ProgramMethod::Reset).await.unwrap();
    bench.call(ProgramMethod::Start).await.unwrap();
    bench.call(ProgramMethod::Suspend).await.unwrap();
    tokio::time::sleep(Duration::from_millis(40)).await;
    assert_eq!(bench.skill.shown().state, ProgramMachineState::Suspended);
    bench.gate.add_permits(1);
    bench.call(ProgramMethod::Resume).await.unwrap();
    bench.until(ProgramMachineState::Ready).await;
}

#[tokio::test]
async fn at_the_end_of_the_component_what_runs_is_halted() {
    let bench = bench(How::WhenLet);
    bench.run_to(ProgramMachineState::Running).await;
    bench.skill.close().await;
    let outcome = bench.skill.outcome(1).unwrap();
    assert_eq!(outcome.message, "halted by the end of the component");
    assert_eq!(bench.skill.shown().state, ProgramMachineState::Halted);
    assert_eq!(
        bench.call(ProgramMethod::Reset).await.unwrap_err().code,
        RefusalCode::Shutdown
    );
}

#[tokio::test]
async fn work_elsewhere_is_halted_when_it_has_ended() {
    let bench = bench(How::Elsewhere(Elsewhere::Cancels));
    bench.run_to(ProgramMachineState::Running).await;
    bench.call(ProgramMethod::Halt).await.unwrap();
    let shown = bench.skill.shown();
    assert_eq!(shown.state, ProgramMachineState::Running);
    assert_eq!(shown.pending.as_deref(), Some("the goal has not ended"));
    // A second Halt: the cancellation is in progress.
    bench.call(ProgramMethod::Halt).await.unwrap();
    assert_eq!(bench.skill.shown().state, ProgramMachineState::Running);
    bench.gate.add_permits(1);
    let shown = bench.until(ProgramMachineState::Halted).await;
    assert_eq!((shown.pending.as_deref(), shown.needs_reset), (None, false));
    assert_eq!(bench.numbers(), [1, 2, 3]);
    let story = lock(&bench.seen).story.join(", ");
    assert!(
        story.contains("pending the goal has not ended, pending"),
        "{story}"
    );
}

#[tokio::test]
async fn a_refused_cancellation_is_shown_as_refused() {
    let bench = bench(How::Elsewhere(Elsewhere::Refuses));
    bench.run_to(ProgramMachineState::Running).await;
    let refused = bench.call(ProgramMethod::Halt).await.unwrap_err();
    assert_eq!(refused.code, RefusalCode::RequestNotAllowed, "{refused}");
    let shown = bench.skill.shown();
    assert_eq!(shown.state, ProgramMachineState::Running);
    assert_eq!(shown.pending.as_deref(), Some("the robot goes on"));
}

#[tokio::test]
async fn a_replaced_driver_does_the_next_run_and_not_the_run_in_progress() {
    let bench = bench(How::WhenLet);
    bench.run_to(ProgramMachineState::Running).await;
    let limit = Duration::from_millis(50);
    let gate = Arc::new(Semaphore::new(0));
    let next = Arc::new(Scripted {
        how: How::Elsewhere(Elsewhere::Cancels),
        gate: Arc::clone(&gate),
        began: AtomicU32::new(0),
    });
    bench.skill.replace(next.clone(), Some(limit));
    bench.call(ProgramMethod::Suspend).await.unwrap();
    bench.call(ProgramMethod::Resume).await.unwrap();
    bench.gate.add_permits(1);
    let first = bench.until(ProgramMachineState::Ready).await;
    assert!(
        first
            .outcome
            .as_ref()
            .is_some_and(|outcome| outcome.succeeded)
    );
    assert_eq!(next.began.load(Ordering::SeqCst), 0);

    bench.call(ProgramMethod::Start).await.unwrap();
    let refused = bench.call(ProgramMethod::Suspend).await.unwrap_err();
    assert_eq!(refused.code, RefusalCode::NotSupported, "{refused}");
    gate.add_permits(1);
    let second = bench.until(ProgramMachineState::Halted).await;
    let outcome = second.outcome.clone().unwrap();
    assert!(outcome.message.contains("within 50ms"), "{outcome:?}");
    let began = [&bench.driver, &next].map(|driver| driver.began.load(Ordering::SeqCst));
    assert_eq!(began, [1, 1]);
}
