//! Tests of the task of a skill: the order of simultaneous inputs, and parts that panic.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use async_trait::async_trait;
use futures_util::FutureExt;
use program::ProgramMethod;
use tokio::sync::Semaphore;
use tokio::time::timeout;

use super::*;
use crate::authority::SkillOwner;
use crate::description::SkillDescription;
use crate::driver::Driver;
use crate::driver_error::InvalidParameter;
use crate::lock::lock;
use crate::machine::Given;
use crate::model;
use crate::outcomes::NewestOutcomes;
use crate::parameters::{ParameterType, Parameters, SkillParameter};
use crate::shown::{RunOutcome, SkillEvent, is_work};
use crate::skill::Skill;
use crate::value::SkillValue;

const ME: SkillOwner = SkillOwner::Session(1);
/// Time limit of a wait.
const PATIENCE: Duration = Duration::from_secs(5);

fn facts() -> SkillDescription {
    let of = model::find("GraspSkillType").unwrap();
    SkillDescription {
        name: "Grasp".to_owned(),
        types: vec![ParameterType::own(of.name)],
        parameters: of.parameters(),
        results: of.results(),
        capabilities: Vec::new(),
        timeout: None,
        rests_in: of.rests_in,
    }
}

fn skill(
    driver: impl Driver,
    authority: &Authority,
    observers: Vec<Box<dyn SkillObserver>>,
) -> Skill {
    Skill::spawn(facts(), Arc::new(driver), authority.clone(), observers)
}

async fn start(skill: &Skill) {
    skill.call(ME, ProgramMethod::Reset).await.unwrap();
    skill.call(ME, ProgramMethod::Start).await.unwrap();
}

async fn ended(skill: &Skill) -> Arc<RunOutcome> {
    let mut watch = skill.watch();
    let shown = watch.wait_for(|shown| shown.run == 1 && !is_work(shown.state));
    let shown = timeout(PATIENCE, shown)
        .await
        .expect("the run ends in time");
    assert!(shown.is_ok(), "the run ends");
    skill.outcome(1).expect("the run has an outcome")
}

/// A driver that stops at Halt.
struct Obedient;

#[async_trait]
impl Driver for Obedient {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        work.stopped().await;
        Err(DriverError::Stopped)
    }
}

fn call(actor: &mut Actor, method: ProgramMethod, readies: bool) -> CallAnswer {
    let (reply, answer) = oneshot::channel();
    let given = Given {
        readies,
        ..Given::default()
    };
    actor.machine.call(SkillCallRequest {
        by: ME,
        method,
        given,
        reply,
    });
    actor.carry_out();
    answer
}

type CallAnswer = oneshot::Receiver<Result<u32, SkillRefusal>>;

/// The work ends, and the task of the skill finds the end and the deadline of the stop together.
#[tokio::test]
async fn an_end_that_has_arrived_comes_before_a_deadline() {
    let outcomes = NewestOutcomes::default();
    let parts = MachineParts {
        facts: Arc::new(facts()),
        driver: Arc::new(Obedient),
        authority: Authority::new(),
        pending: Arc::default(),
        outcomes: outcomes.clone(),
        successor: Arc::default(),
        first_run: 1,
    };
    let (mut actor, _shown) = Actor::new(parts, Vec::new());
    let started = call(&mut actor, ProgramMethod::Start, true);
    assert_eq!(started.await.unwrap(), Ok(1));
    let halted = call(&mut actor, ProgramMethod::Halt, false);
    while !actor.task.as_ref().unwrap().task.is_finished() {
        tokio::task::yield_now().await;
    }
    let until = actor.machine.poll_deadline().expect("the stop has a limit");
    let now = Moment {
        monotonic: until,
        wall: clock(),
    };
    actor.handle_deadline(now).await;
    actor.carry_out();
    assert_eq!(halted.await.unwrap(), Ok(1));
    let outcome = outcomes.of(1).unwrap();
    assert_eq!(
        (outcome.message.as_str(), outcome.unknown),
        ("halted by session 1", false)
    );
}

/// A driver that ends at once. Its work is used elsewhere after its end.
#[derive(Clone, Default)]
struct Shared(Arc<Mutex<Option<Work>>>);

#[async_trait]
impl Driver for Shared {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        *lock(&self.0) = Some(work.clone());
        work.step("first").await;
        Ok(Vec::new())
    }
}

/// Reports a step for each step, up to a number far beyond the queue.
struct Flood {
    work: Arc<Mutex<Option<Work>>>,
    steps: Arc<AtomicUsize>,
}

impl SkillObserver for Flood {
    fn told(&self, what: SkillEvent<'_>, _shown: &SkillSnapshot) {
        let is_step = matches!(what, SkillEvent::Step);
        if is_step && self.steps.fetch_add(1, Ordering::SeqCst) < 10_000 {
            let work = lock(&self.work).clone().expect("the run has begun");
            work.step("another")
                .now_or_never()
                .expect("there is space for one report");
        }
    }
}

#[tokio::test]
async fn reports_without_end_do_not_delay_the_end_of_the_work() {
    let driver = Shared::default();
    let steps = Arc::new(AtomicUsize::new(0));
    let flood = Flood {
        work: Arc::clone(&driver.0),
        steps: Arc::clone(&steps),
    };
    let skill = skill(driver, &Authority::new(), vec![Box::new(flood)]);
    start(&skill).await;
    assert!(ended(&skill).await.succeeded);
    let steps = steps.load(Ordering::SeqCst);
    assert!((1..=2 * MOST_STEPS).contains(&steps), "{steps} steps");
}

/// A driver that panics before its run, in one of the two checks.
struct Careless {
    prepares: bool,
}

#[async_trait]
impl Driver for Careless {
    fn prepared(
        &self,
        _declared: &[SkillParameter],
        given: Vec<(String, SkillValue)>,
    ) -> Vec<(String, SkillValue)> {
        assert!(!self.prepares, "a table is empty");
        given
    }

    fn check(&self, _parameters: &Parameters) -> Result<(), InvalidParameter> {
        panic!("a table is empty")
    }

    async fn run(&self, _work: Work) -> Result<RunResults, DriverError> {
        Ok(Vec::new())
    }
}

#[tokio::test]
async fn a_driver_that_panics_in_a_check_refuses_the_start() {
    for prepares in [true, false] {
        let authority = Authority::new();
        let skill = skill(Careless { prepares }, &authority, Vec::new());
        let by = SkillOwner::Local("mes");
        for _ in 0..2 {
            let refused = skill.execute(by.clone(), Vec::new(), None).await;
            assert_eq!(
                refused.unwrap_err().to_string(),
                "BadInvalidArgument: the driver broke down while it checked the parameters: a table is empty"
            );
        }
        assert_eq!(*authority.holder().borrow(), None);
        assert!(authority.reserve(), "the component is free");
    }
}

/// Panics at a step of a run.
struct Fragile;

impl SkillObserver for Fragile {
    fn told(&self, what: SkillEvent<'_>, _shown: &SkillSnapshot) {
        assert!(!matches!(what, SkillEvent::Step), "the disk is full");
    }
}

/// Reports a step, and works until it is stopped.
struct Steady(Arc<Semaphore>);

#[async_trait]
impl Driver for Steady {
    async fn run(&self, work: Work) -> Result<RunResults, DriverError> {
        work.step("first").await;
        work.stopped().await;
        self.0.add_permits(1);
        Err(DriverError::Stopped)
    }
}

#[tokio::test]
async fn an_observer_that_panics_ends_the_run_as_unknown_and_releases_the_component() {
    let (authority, stops) = (Authority::new(), Arc::new(Semaphore::new(0)));
    let skill = skill(
        Steady(Arc::clone(&stops)),
        &authority,
        vec![Box::new(Fragile)],
    );
    start(&skill).await;
    let outcome = ended(&skill).await;
    assert!(outcome.unknown && !outcome.succeeded);
    assert_eq!(
        outcome.message,
        "the skill broke down; the outcome is unknown, check the machine"
    );
    assert!(skill.shown().needs_reset);
    assert_eq!(authority.begin("Lift"), Ok(()), "the component is free");
    let refused = skill.call(ME, ProgramMethod::Reset).await.unwrap_err();
    assert_eq!(refused, SkillRefusal::closed());
    let stopped = timeout(PATIENCE, stops.acquire()).await;
    assert!(stopped.is_ok(), "the work is stopped");
}
