//! A skill as an action of the space: a goal starts a run, its feedback is the progress of the run,
//! and cancelling halts the run.
//!
//! A goal resets a skill that is Halted, because clients of actions have no Reset, and every run
//! that fails ends in Halted. After an unknown outcome it does not: the machine may move.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bridge_node::actions::{
    GraphActionClient, GraphCancelResponse, GraphCancelSelection, GraphGoalEvent, GraphGoalId,
    OwnAction, SentGoal,
};
use bridge_node::{CallFault, MayHaveRun, now};
use bytes::Bytes;
use mappings::TopicId;
use program::{ProgramMachineState, ProgramMethod};
use skills::{
    Parameters, RunOutcome, SkillDescription, SkillEvent, SkillObserver, SkillOwner, SkillSnapshot,
    SkillValue,
};
use tokio::sync::broadcast;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};
use tracing::warn;

use crate::definition;
use crate::executor::{SkillExecutor, SkillRequestError};
use crate::fields;

/// Returns the action of a skill. The first part of the tuple is the name of the component.
pub(crate) fn action(
    topic: TopicId,
    (component, open): (&str, bool),
    facts: &SkillDescription,
) -> OwnAction {
    let of = facts.types.first();
    let of = of.map(|of| format!("{} nsu={}", of.name, of.namespace));
    // A Program that is not a skill has the action of the base type of all skills.
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

/// Encodes the fields of a result. Missing values are empty.
fn result(facts: &SkillDescription, (run, given): (u32, &[(String, SkillValue)])) -> Bytes {
    let values = facts.results.iter().map(|declared| {
        let found = given.iter().find(|(name, _)| *name == declared.name);
        found.map_or_else(|| definition::nothing(declared), |(_, value)| value.clone())
    });
    let values: Vec<SkillValue> = [SkillValue::from(run)].into_iter().chain(values).collect();
    Bytes::from(fields::block(&values))
}

/// A notification of a skill about its runs.
#[derive(Debug, Clone)]
enum Heard {
    Stands {
        run: u32,
        feedback: [SkillValue; 4],
        /// True if only the progress has changed.
        passing: bool,
    },
    Ended(Arc<RunOutcome>),
    /// The state of the runs is unknown from now on.
    Lost(String),
}

/// Observes a skill for its goals.
#[derive(Debug, Clone)]
pub(crate) struct Reporter(broadcast::Sender<Heard>);

impl Reporter {
    pub(crate) fn new() -> Self {
        Self(broadcast::channel(MOST_HEARD).0)
    }
}

impl SkillObserver for Reporter {
    fn told(&self, what: SkillEvent<'_>, shown: &SkillSnapshot) {
        let heard = match what {
            SkillEvent::Transition(_) | SkillEvent::Step | SkillEvent::Pending(_) => {
                stands(shown, false)
            }
            SkillEvent::Progress => stands(shown, true),
            SkillEvent::Outcome(outcome) => Heard::Ended(Arc::new(outcome.clone())),
            SkillEvent::Parameters(_) | SkillEvent::Called => return,
        };
        // Without goals there is no receiver.
        let _heard_by = self.0.send(heard);
    }

    fn lost(&self, why: &str) {
        let _heard_by = self.0.send(Heard::Lost(why.to_owned()));
    }
}

fn stands(shown: &SkillSnapshot, passing: bool) -> Heard {
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

/// Executes goals with a skill.
#[derive(Debug)]
pub(crate) struct Doer {
    skill: SkillExecutor,
    reporter: Reporter,
    doing: Arc<Mutex<Doing>>,
}

/// The goals of a skill.
#[derive(Debug, Default)]
struct Doing {
    current: Option<Current>,
    /// Goals with a run that is about to start, and if each goal was cancelled in the meantime.
    beginning: HashMap<GraphGoalId, bool>,
}

impl Doing {
    /// Handles that a run has started or failed to start. Returns true if its goal was cancelled in
    /// the meantime.
    fn begun(&mut self, id: GraphGoalId) -> bool {
        self.beginning.remove(&id).unwrap_or_default()
    }

    /// Handles that a run continues, because the skill refused to halt it.
    fn resume(&mut self, run: u32) {
        if let Some(current) = self.current.as_mut().filter(|current| current.run == run) {
            current.cancelled = false;
        }
    }

    /// Returns true if a goal was cancelled before its run started.
    fn is_cancelled(&self, id: GraphGoalId) -> bool {
        self.beginning.get(&id).copied().unwrap_or_default()
    }
}

/// The goal with the latest run among the runs that goals started.
#[derive(Debug, Clone, Copy)]
struct Current {
    id: GraphGoalId,
    run: u32,
    cancelled: bool,
}

impl Doer {
    pub(crate) fn new(skill: SkillExecutor, reporter: Reporter) -> Self {
        Self {
            skill,
            reporter,
            doing: Arc::default(),
        }
    }
}

impl GraphActionClient for Doer {
    type Goal = SentSkillGoal;

    fn send_goal(
        &self,
        id: GraphGoalId,
        body: &[u8],
        start_by: std::time::Instant,
    ) -> SentSkillGoal {
        // The subscription starts before the run, so that no notification is missed.
        let heard = self.reporter.0.subscribe();
        let (skill, body) = (self.skill.clone(), body.to_vec());
        let doing = Arc::clone(&self.doing);
        lock(&doing).beginning.insert(id, false);
        let begun = tokio::spawn(async move {
            let of = Arc::clone(&doing);
            let condition =
                Arc::new(move || !lock(&of).is_cancelled(id) && now().monotonic <= start_by);
            let begun = match now().monotonic > start_by {
                true => Err(BeginFault::NotStarted(SkillRequestError::Late)),
                false => begin(&skill, &body, condition).await,
            };
            let cancelled = {
                let mut doing = lock(&doing);
                let cancelled = doing.begun(id);
                if let Ok(run) = begun {
                    doing.current = Some(Current { id, run, cancelled });
                }
                cancelled
            };
            settle(&skill, &doing, (begun, cancelled)).await
        });
        SentSkillGoal {
            id,
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

    async fn cancel(&self, what: GraphCancelSelection) -> Result<GraphCancelResponse, CallFault> {
        let none = |code| {
            Ok(GraphCancelResponse {
                code,
                goals: Vec::new(),
            })
        };
        let wanted = |current: &Current| match what {
            GraphCancelSelection::All => true,
            GraphCancelSelection::Goal(id) => current.id == id,
        };
        let open = {
            let mut doing = lock(&self.doing);
            let beginning = doing.beginning.iter_mut();
            let meant = beginning.filter(|(id, _)| match what {
                GraphCancelSelection::All => true,
                GraphCancelSelection::Goal(wanted) => **id == wanted,
            });
            let goals: Vec<GraphGoalId> = meant
                .map(|(id, cancelled)| {
                    *cancelled = true;
                    *id
                })
                .collect();
            if !goals.is_empty() {
                return Ok(GraphCancelResponse { code: NONE, goals });
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
                GraphCancelSelection::All => NONE,
                GraphCancelSelection::Goal(_) => UNKNOWN_GOAL,
            });
        };
        match self.skill.call(OWNER, ProgramMethod::Halt).await {
            Ok(_) => Ok(GraphCancelResponse {
                code: NONE,
                goals: vec![open.id],
            }),
            Err(_) if self.skill.outcome(open.run).is_some() => none(TERMINATED),
            Err(_) => {
                lock(&self.doing).resume(open.run);
                none(REJECTED)
            }
        }
    }
}

/// The reason why the start of a goal's run is not confirmed.
#[derive(Debug)]
enum BeginFault {
    /// No run was started.
    NotStarted(SkillRequestError),
    /// A run may have started.
    Unknown(SkillRequestError),
}

/// The start of a goal's run.
#[derive(Debug)]
enum GoalStart {
    /// The run with this number was started.
    Started(u32),
    /// The run with this number was started. The goal was cancelled meanwhile, and the skill does
    /// not confirm the Halt.
    NotHalted(u32),
    /// The goal was cancelled before its run started.
    Cancelled,
    /// No run was started, for this reason.
    Rejected(String),
    /// A run may have started. The text is the reason.
    Unknown(String),
}

/// Halts the skill if its goal was cancelled while the run was started, and returns the result of
/// both.
async fn settle(
    skill: &SkillExecutor,
    doing: &Mutex<Doing>,
    (begun, cancelled): (Result<u32, BeginFault>, bool),
) -> GoalStart {
    match begun {
        Ok(run) if cancelled => match skill.call(OWNER, ProgramMethod::Halt).await {
            Ok(_) => GoalStart::Started(run),
            Err(_) if skill.outcome(run).is_some() => GoalStart::Started(run),
            Err(error) => {
                let name = &skill.facts().name;
                warn!(skill = name, run, %error, "cannot halt the run of a cancelled goal");
                // The skill may have executed a Halt without a response.
                if !error.is_unknown(ProgramMethod::Halt) {
                    lock(doing).resume(run);
                }
                GoalStart::NotHalted(run)
            }
        },
        Ok(run) => GoalStart::Started(run),
        Err(BeginFault::NotStarted(_)) if cancelled => GoalStart::Cancelled,
        Err(BeginFault::NotStarted(error)) => GoalStart::Rejected(error.to_string()),
        Err(BeginFault::Unknown(error)) if cancelled => {
            let halted = match skill.call(OWNER, ProgramMethod::Halt).await {
                Ok(_) => "the goal was cancelled, and the skill was halted".to_owned(),
                Err(error) => format!("the goal was cancelled, and Halt failed: {error}"),
            };
            GoalStart::Unknown(format!("{}; {halted}", unknown_start(&error)))
        }
        Err(BeginFault::Unknown(error)) => GoalStart::Unknown(unknown_start(&error)),
    }
}

fn unknown_start(error: &SkillRequestError) -> String {
    format!("it is unknown whether the run was started, so the machine may move: {error}")
}

/// Starts a run and returns its number. The condition is checked just before the start.
async fn begin(
    skill: &SkillExecutor,
    body: &[u8],
    condition: Arc<impl Fn() -> bool + Send + Sync + 'static>,
) -> Result<u32, BeginFault> {
    let ready = match condition() {
        true => prepare(skill, body).await,
        false => Err(SkillRequestError::NotStarted),
    };
    let given = ready.map_err(BeginFault::NotStarted)?;
    let condition = Box::new(move || condition());
    let started = skill.start_with(OWNER, given, condition).await;
    started.map_err(|error| match error.hides_start() {
        true => BeginFault::Unknown(error),
        false => BeginFault::NotStarted(error),
    })
}

/// Makes the skill ready for a goal, and returns the parameters of the goal.
async fn prepare(
    skill: &SkillExecutor,
    body: &[u8],
) -> Result<Vec<(String, SkillValue)>, SkillRequestError> {
    let given = parameters(skill.facts(), body)?;
    // The parameters are checked before the machine moves; Start checks them again.
    Parameters::complete(&skill.facts().parameters, given.clone())?;
    let shown = skill.shown();
    if shown.needs_reset {
        return Err(SkillRequestError::NeedsReset(shown.run));
    }
    if shown.state == ProgramMachineState::Halted {
        skill.make_ready(OWNER).await?;
    }
    Ok(given)
}

/// Decodes the parameters of a goal. Null values are not set. Zero or empty values of parameters
/// with a default are not set either, because all fields of a ROS message have a value.
fn parameters(
    facts: &SkillDescription,
    body: &[u8],
) -> Result<Vec<(String, SkillValue)>, SkillRequestError> {
    let values = fields::values(body)?;
    let declared = &facts.parameters;
    if values.len() > declared.len() {
        return Err(SkillRequestError::Count {
            of: "goal",
            given: values.len(),
            declared: declared.len(),
        });
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
pub(crate) struct SentSkillGoal {
    id: GraphGoalId,
    skill: SkillExecutor,
    doing: Arc<Mutex<Doing>>,
    heard: broadcast::Receiver<Heard>,
    stage: Stage,
    events: VecDeque<GraphGoalEvent>,
    /// Progress that is held back, because the previous feedback was sent a moment ago.
    passing: Option<[SkillValue; 4]>,
    /// Time of the last feedback, and its values in `last`. Feedback is repeated, so that late
    /// subscribers receive it while nothing changes.
    told: Option<Instant>,
    last: Option<[SkillValue; 4]>,
}

#[derive(Debug)]
enum Stage {
    Begins(JoinHandle<GoalStart>),
    Runs(u32),
    /// The run has ended; the end is reported at this time.
    Cancelled(Arc<RunOutcome>, Instant),
    /// No run was started; the cancellation is reported at this time.
    NeverStarted(Instant),
    Ended,
}

impl SentGoal for SentSkillGoal {
    async fn recv(&mut self) -> Option<GraphGoalEvent> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Some(event);
            }
            match &mut self.stage {
                Stage::Begins(begun) => {
                    let begun = begun.await;
                    let begun = begun.unwrap_or_else(|_| {
                        lock(&self.doing).begun(self.id);
                        GoalStart::Unknown(
                            "the start of the run was aborted, so the machine may move".to_owned(),
                        )
                    });
                    self.begun(begun);
                }
                Stage::Runs(run) => {
                    let run = *run;
                    let pause = match self.passing {
                        Some(_) => BETWEEN_PROGRESS,
                        None => REPEATED,
                    };
                    let next = self.told.map(|told| told + pause);
                    // Both futures are cancel-safe.
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
                Stage::NeverStarted(until) => {
                    sleep_until(*until).await;
                    let message = "the goal was cancelled before its run started";
                    self.ended(CANCELED, message, (0, &[]));
                }
                Stage::Ended => return None,
            }
        }
    }
}

/// Waits until a time; pends without a time.
async fn at(time: Option<Instant>) {
    match time {
        Some(time) => sleep_until(time).await,
        None => std::future::pending().await,
    }
}

impl SentSkillGoal {
    fn begun(&mut self, begun: GoalStart) {
        match begun {
            GoalStart::Started(run) => self.started(run),
            GoalStart::NotHalted(run) => {
                self.started(run);
                self.events.push_back(GraphGoalEvent::CancelRefused);
            }
            GoalStart::Cancelled => {
                self.stage = Stage::NeverStarted(Instant::now() + BEHIND_CANCEL);
                self.events.push_back(GraphGoalEvent::Accepted(now().utc));
                self.events.push_back(GraphGoalEvent::Status(CANCELING));
            }
            GoalStart::Rejected(why) => {
                self.stage = Stage::Ended;
                self.events.push_back(GraphGoalEvent::Rejected(why));
            }
            GoalStart::Unknown(why) => self.lost(why),
        }
    }

    fn started(&mut self, run: u32) {
        self.stage = Stage::Runs(run);
        self.events.push_back(GraphGoalEvent::Accepted(now().utc));
        self.events.push_back(GraphGoalEvent::Status(EXECUTING));
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
                        self.events.push_back(GraphGoalEvent::Status(CANCELING));
                    }
                    false => self.end(&outcome),
                }
            }
            Ok(Heard::Stands { .. } | Heard::Ended(_)) => {}
            Ok(Heard::Lost(why)) => self.lost(why),
            // Notifications were lost, which may include the end of the run.
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
        let ran = MayHaveRun::Perhaps;
        self.events.push_back(GraphGoalEvent::Lost { text, ran });
    }

    /// Sends this feedback, or else the held-back progress, or else the last feedback again.
    fn tell(&mut self, feedback: Option<[SkillValue; 4]>) {
        let waited = self.passing.take();
        if let Some(feedback) = feedback.or(waited).or_else(|| self.last.clone()) {
            self.told = Some(Instant::now());
            self.last = Some(feedback.clone());
            let body = Bytes::from(fields::block(&feedback));
            self.events.push_back(GraphGoalEvent::Feedback(body));
        }
    }

    fn is_cancelled(&self, run: u32) -> bool {
        let current = lock(&self.doing).current;
        current.is_some_and(|of| of.run == run && of.cancelled)
    }

    fn end(&mut self, outcome: &RunOutcome) {
        if let Some(passing) = self.passing.take() {
            self.tell(Some(passing));
        }
        if outcome.unknown {
            return self.lost(outcome.message.clone());
        }
        let status = match (outcome.succeeded, self.is_cancelled(outcome.run)) {
            (true, _) => SUCCEEDED,
            (false, true) => CANCELED,
            (false, false) => ABORTED,
        };
        self.ended(status, &outcome.message, (outcome.run, &outcome.results));
    }

    fn ended(&mut self, status: i8, message: &str, results: (u32, &[(String, SkillValue)])) {
        self.stage = Stage::Ended;
        self.events.push_back(GraphGoalEvent::Ended {
            status,
            message: message.to_owned(),
            result: result(self.skill.facts(), results),
        });
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // Each change is complete before the lock is released.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Goals have no owner: any client may cancel them, as in ROS.
const OWNER: SkillOwner = SkillOwner::Local("a goal of the space");
/// Largest number of notifications that wait for a goal.
const MOST_HEARD: usize = 256;
/// Shortest interval between two feedbacks of progress only: 20 a second.
const BETWEEN_PROGRESS: Duration = Duration::from_millis(50);
/// Delay of the end of a cancelled goal. A ROS 2 client that receives the end before the cancel
/// response is informed that it cancelled nothing.
const BEHIND_CANCEL: Duration = Duration::from_millis(200);
/// Interval in which the last feedback is repeated while nothing changes.
const REPEATED: Duration = Duration::from_secs(1);
/// Statuses of `action_msgs/GoalStatus`.
const EXECUTING: i8 = 2;
const CANCELING: i8 = 3;
const SUCCEEDED: i8 = 4;
const CANCELED: i8 = 5;
const ABORTED: i8 = 6;
/// Return codes of `action_msgs/CancelGoal`.
const NONE: i8 = 0;
const REJECTED: i8 = 1;
const UNKNOWN_GOAL: i8 = 2;
const TERMINATED: i8 = 3;

#[cfg(test)]
mod tests;
