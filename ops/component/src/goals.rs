//! A skill as an action of the space: a goal starts a run, its feedback is how far that is, and cancelling halts it.
//!
//! A goal resets a skill that is Halted: who sends goals knows no Reset, and every run ends in Halted that does not succeed.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bridge_node::actions::{
    ActionClient, CancelAnswer, CancelWhat, GoalEvent, GoalId, OwnAction, SentGoal,
};
use bridge_node::{CallFault, Ran, now};
use bytes::Bytes;
use mappings::TopicId;
use program::{Method, State};
use skills::{Facts, Observer, Outcome, Owner, Parameters, Shown, Told, Value};
use tokio::sync::broadcast;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};

use crate::definition;
use crate::executor::Executor;
use crate::fields;

/// What a skill is as an action. `name` is that of the skill in its component.
pub(crate) fn action(topic: TopicId, (component, open): (&str, bool), facts: &Facts) -> OwnAction {
    let of = facts.types.first();
    let of = of.map(|of| format!("{} nsu={}", of.name, of.namespace));
    // A Program that is no skill is run as one of the type that all are of.
    let ros = definition::action_type(&facts.types).unwrap_or_else(definition::of_all);
    OwnAction {
        topic,
        name: format!("{component}.{}.Goal", facts.name),
        about: format!("{ros}; {}", of.unwrap_or_default()),
        open,
        goal: definition::goal_fields(&facts.parameters),
        result: definition::result_fields(&facts.results),
        feedback: definition::feedback_fields(),
        empty_result: result(facts, (0, &[])),
    }
}

/// The fields of a result. What is not given has nothing in it.
fn result(facts: &Facts, (run, given): (u32, &[(String, Value)])) -> Bytes {
    let values = facts.results.iter().map(|declared| {
        let found = given.iter().find(|(name, _)| *name == declared.name);
        found.map_or_else(|| definition::nothing(declared), |(_, value)| value.clone())
    });
    let values: Vec<Value> = [Value::from(run)].into_iter().chain(values).collect();
    Bytes::from(fields::block(&values))
}

/// What a skill says of its runs.
#[derive(Debug, Clone)]
enum Heard {
    Stands {
        run: u32,
        feedback: [Value; 4],
        /// No more than its progress is another.
        passing: bool,
    },
    Ended(Arc<Outcome>),
    /// Nothing more is known of them.
    Lost(String),
}

/// Hears what happens to a skill, for its goals.
#[derive(Debug, Clone)]
pub(crate) struct Reporter(broadcast::Sender<Heard>);

impl Reporter {
    pub(crate) fn new() -> Self {
        Self(broadcast::channel(MOST_HEARD).0)
    }
}

impl Observer for Reporter {
    fn told(&self, what: Told<'_>, shown: &Shown) {
        let heard = match what {
            Told::Transition(_) | Told::Step | Told::Pending(_) => stands(shown, false),
            Told::Progress => stands(shown, true),
            Told::Outcome(outcome) => Heard::Ended(Arc::new(outcome.clone())),
            Told::Parameters(_) | Told::Called => return,
        };
        // Without any goal nobody hears it.
        let _heard_by = self.0.send(heard);
    }

    fn lost(&self, why: &str) {
        let _heard_by = self.0.send(Heard::Lost(why.to_owned()));
    }
}

fn stands(shown: &Shown, passing: bool) -> Heard {
    let feedback = [
        shown.state.name().into(),
        shown.progress.into(),
        shown.step.as_str().into(),
        shown.run.into(),
    ];
    Heard::Stands {
        run: shown.run,
        feedback,
        passing,
    }
}

/// Has goals done by a skill.
#[derive(Debug)]
pub(crate) struct Doer {
    skill: Executor,
    reporter: Reporter,
    doing: Arc<Mutex<Doing>>,
}

/// The goals of a skill.
#[derive(Debug, Default)]
struct Doing {
    current: Option<Current>,
    /// Goals whose runs are about to begin, and whether each is cancelled meanwhile.
    beginning: HashMap<GoalId, bool>,
}

impl Doing {
    /// A run has begun or failed to begin. Returns true if its goal was cancelled meanwhile.
    fn begun(&mut self, id: GoalId) -> bool {
        self.beginning.remove(&id).unwrap_or_default()
    }
}

/// The goal whose run is the newest of those that goals began.
#[derive(Debug, Clone, Copy)]
struct Current {
    id: GoalId,
    run: u32,
    cancelled: bool,
}

impl Doer {
    pub(crate) fn new(skill: Executor, reporter: Reporter) -> Self {
        Self {
            skill,
            reporter,
            doing: Arc::default(),
        }
    }
}

impl ActionClient for Doer {
    type Goal = Sent;

    fn send_goal(&self, id: GoalId, body: &[u8]) -> Sent {
        // Before it begins: nothing of it is missed.
        let heard = self.reporter.0.subscribe();
        let (skill, body) = (self.skill.clone(), body.to_vec());
        let doing = Arc::clone(&self.doing);
        lock(&doing).beginning.insert(id, false);
        let begun = tokio::spawn(async move {
            if lock(&doing).beginning.get(&id) == Some(&true) {
                lock(&doing).begun(id);
                return Err("the goal was cancelled before its run began".to_owned());
            }
            let run = begin(&skill, &body).await;
            let cancelled = {
                let mut doing = lock(&doing);
                let cancelled = doing.begun(id);
                if let Ok(run) = &run {
                    let run = *run;
                    doing.current = Some(Current { id, run, cancelled });
                }
                cancelled
            };
            if cancelled && run.is_ok() {
                // The end of the run tells whether it could be halted.
                let _halted = skill.call(OWNER, Method::Halt).await;
            }
            run
        });
        Sent {
            skill: self.skill.clone(),
            doing: Arc::clone(&self.doing),
            heard,
            stage: Stage::Begins(begun),
            events: VecDeque::new(),
            passing: None,
            told: None,
            last: None,
        }
    }

    async fn cancel(&self, what: CancelWhat) -> Result<CancelAnswer, CallFault> {
        let none = |code| {
            Ok(CancelAnswer {
                code,
                goals: Vec::new(),
            })
        };
        let wanted = |current: &Current| match what {
            CancelWhat::All => true,
            CancelWhat::Goal(id) => current.id == id,
        };
        let open = {
            let mut doing = lock(&self.doing);
            let beginning = doing.beginning.iter_mut();
            let meant = beginning.filter(|(id, _)| match what {
                CancelWhat::All => true,
                CancelWhat::Goal(wanted) => **id == wanted,
            });
            let goals: Vec<GoalId> = meant
                .map(|(id, cancelled)| {
                    *cancelled = true;
                    *id
                })
                .collect();
            if !goals.is_empty() {
                return Ok(CancelAnswer { code: NONE, goals });
            }
            let current = doing.current.as_mut().filter(|current| wanted(current));
            let open = current.filter(|current| self.skill.outcome(current.run).is_none());
            open.map(|current| {
                current.cancelled = true;
                *current
            })
        };
        let Some(open) = open else {
            return none(match what {
                CancelWhat::All => NONE,
                CancelWhat::Goal(_) => UNKNOWN_GOAL,
            });
        };
        match self.skill.call(OWNER, Method::Halt).await {
            Ok(_) => Ok(CancelAnswer {
                code: NONE,
                goals: vec![open.id],
            }),
            Err(_) if self.skill.outcome(open.run).is_some() => none(TERMINATED),
            Err(_) => {
                // It goes on.
                let mut doing = lock(&self.doing);
                if let Some(current) = doing.current.as_mut().filter(|now| now.run == open.run) {
                    current.cancelled = false;
                }
                none(REJECTED)
            }
        }
    }
}

/// Begins a run: gives its number.
async fn begin(skill: &Executor, body: &[u8]) -> Result<u32, String> {
    let given =
        parameters(skill.facts(), body).map_err(|why| format!("BadInvalidArgument: {why}"))?;
    // Looked at before anything moves; Start looks again.
    let complete = Parameters::complete(&skill.facts().parameters, given.clone());
    complete.map_err(|refusal| refusal.to_string())?;
    let shown = skill.shown();
    if shown.needs_reset {
        return Err(format!(
            "BadInvalidState: the outcome of run {} is unknown; Reset makes the skill ready",
            shown.run
        ));
    }
    if shown.state == State::Halted {
        skill.call(OWNER, Method::Reset).await?;
    }
    skill.start_with(OWNER, given).await
}

/// The parameters of a goal. What is null is not given, and neither is what is zero or empty and has a default: a message of
/// ROS has no fields that are not there.
fn parameters(facts: &Facts, body: &[u8]) -> Result<Vec<(String, Value)>, String> {
    let values = fields::values(body)?;
    let declared = &facts.parameters;
    if values.len() > declared.len() {
        return Err(format!(
            "the goal has {} fields, and the skill {} parameters",
            values.len(),
            declared.len()
        ));
    }
    let given = declared.iter().zip(values);
    let given = given.filter_map(|(parameter, value)| {
        let value = value?;
        let left_out = parameter.default.is_some() && definition::is_nothing(&value);
        (!left_out).then(|| (parameter.name.clone(), value))
    });
    Ok(given.collect())
}

/// A goal that was sent.
#[derive(Debug)]
pub(crate) struct Sent {
    skill: Executor,
    doing: Arc<Mutex<Doing>>,
    heard: broadcast::Receiver<Heard>,
    stage: Stage,
    events: VecDeque<GoalEvent>,
    /// Progress that is not told yet, since the last was a moment ago.
    passing: Option<[Value; 4]>,
    /// When feedback was told last, and what: a run that stands still is heard all the same by who came late.
    told: Option<Instant>,
    last: Option<[Value; 4]>,
}

#[derive(Debug)]
enum Stage {
    Begins(JoinHandle<Result<u32, String>>),
    Runs(u32),
    /// It has ended, which is told then.
    Cancelled(Arc<Outcome>, Instant),
    Ended,
}

impl SentGoal for Sent {
    async fn recv(&mut self) -> Option<GoalEvent> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Some(event);
            }
            match &mut self.stage {
                Stage::Begins(begun) => {
                    let begun = begun.await;
                    self.begun(begun.unwrap_or_else(|_| Err("the component ends".to_owned())));
                }
                Stage::Runs(run) => {
                    let run = *run;
                    let pause = match self.passing {
                        Some(_) => BETWEEN_PROGRESS,
                        None => REPEATED,
                    };
                    let next = self.told.map(|told| told + pause);
                    // Both are cancel-safe.
                    tokio::select! {
                        heard = self.heard.recv() => self.heard(run, heard),
                        () = at(next) => self.tell(None),
                    }
                }
                Stage::Cancelled(outcome, until) => {
                    let outcome = Arc::clone(outcome);
                    sleep_until(*until).await;
                    self.end(&outcome);
                }
                Stage::Ended => return None,
            }
        }
    }
}

/// Ready at that time; never without one.
async fn at(time: Option<Instant>) {
    match time {
        Some(time) => sleep_until(time).await,
        None => std::future::pending().await,
    }
}

impl Sent {
    fn begun(&mut self, begun: Result<u32, String>) {
        match begun {
            Ok(run) => {
                self.stage = Stage::Runs(run);
                self.events.push_back(GoalEvent::Accepted(now().utc));
                self.events.push_back(GoalEvent::Status(EXECUTING));
            }
            Err(why) => {
                self.stage = Stage::Ended;
                self.events.push_back(GoalEvent::Rejected(why));
            }
        }
    }

    fn heard(&mut self, run: u32, heard: Result<Heard, broadcast::error::RecvError>) {
        match heard {
            Ok(Heard::Stands {
                run: of,
                feedback,
                passing,
            }) if of == run => {
                let recent = self
                    .told
                    .is_some_and(|told| told.elapsed() < BETWEEN_PROGRESS);
                match passing && recent {
                    true => self.passing = Some(feedback),
                    false => self.tell(Some(feedback)),
                }
            }
            Ok(Heard::Ended(outcome)) if outcome.run == run => {
                match !outcome.succeeded && self.is_cancelled(run) {
                    true => {
                        let until = Instant::now() + BEHIND_CANCEL;
                        self.stage = Stage::Cancelled(outcome, until);
                        self.events.push_back(GoalEvent::Status(CANCELING));
                    }
                    false => self.end(&outcome),
                }
            }
            Ok(Heard::Stands { .. } | Heard::Ended(_)) => {}
            Ok(Heard::Lost(why)) => self.lost(why),
            // Too much of it was not taken: its end may have been among that.
            Err(broadcast::error::RecvError::Lagged(_)) => {
                if let Some(outcome) = self.skill.outcome(run) {
                    self.end(&outcome);
                }
            }
            Err(broadcast::error::RecvError::Closed) => match self.skill.outcome(run) {
                Some(outcome) => self.end(&outcome),
                None => self.lost("the component ends".to_owned()),
            },
        }
    }

    fn lost(&mut self, text: String) {
        self.stage = Stage::Ended;
        let ran = Ran::Perhaps;
        self.events.push_back(GoalEvent::Lost { text, ran });
    }

    /// Tells that feedback, or what waits to be told, or the last once more.
    fn tell(&mut self, feedback: Option<[Value; 4]>) {
        let waited = self.passing.take();
        if let Some(feedback) = feedback.or(waited).or_else(|| self.last.clone()) {
            self.told = Some(Instant::now());
            self.last = Some(feedback.clone());
            let body = Bytes::from(fields::block(&feedback));
            self.events.push_back(GoalEvent::Feedback(body));
        }
    }

    fn is_cancelled(&self, run: u32) -> bool {
        let current = lock(&self.doing).current;
        current.is_some_and(|of| of.run == run && of.cancelled)
    }

    fn end(&mut self, outcome: &Outcome) {
        if let Some(passing) = self.passing.take() {
            self.tell(Some(passing));
        }
        let status = match (outcome.succeeded, self.is_cancelled(outcome.run)) {
            (true, _) => SUCCEEDED,
            (false, true) => CANCELED,
            (false, false) => ABORTED,
        };
        self.stage = Stage::Ended;
        self.events.push_back(GoalEvent::Ended {
            status,
            message: outcome.message.clone(),
            result: result(self.skill.facts(), (outcome.run, &outcome.results)),
        });
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each change is whole before the lock is given back.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Goals are nobody's: any client may cancel them, as in ROS.
const OWNER: Owner = Owner::Local("a goal of the space");
/// What of a skill waits for one of its goals to take it.
const MOST_HEARD: usize = 256;
/// Progress alone is told no more often: 20 times a second.
const BETWEEN_PROGRESS: Duration = Duration::from_millis(50);
/// The end of a goal that is cancelled comes so long behind: a client of ROS 2 that has it first is told that it cancelled nothing.
const BEHIND_CANCEL: Duration = Duration::from_millis(200);
/// The last feedback is told again while nothing changes.
const REPEATED: Duration = Duration::from_secs(1);
/// As `action_msgs/GoalStatus` has them.
const EXECUTING: i8 = 2;
const CANCELING: i8 = 3;
const SUCCEEDED: i8 = 4;
const CANCELED: i8 = 5;
const ABORTED: i8 = 6;
/// As `action_msgs/CancelGoal` has them.
const NONE: i8 = 0;
const REJECTED: i8 = 1;
const UNKNOWN_GOAL: i8 = 2;
const TERMINATED: i8 = 3;
