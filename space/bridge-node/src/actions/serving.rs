//! One action server of the graph, executed for the space: a task that sends goals and answers
//! requests about them.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bridge_core::{Executed, ExecutionId, Refusal};
use bytes::Bytes;
use mappings::TopicId;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::{MissedTickBehavior, timeout_at};
use tracing::{debug, info};
use uadp::StatusCode;

use super::encoding::Encoding;
use super::graph::{
    GraphActionClient, GraphCancelResponse, GraphCancelSelection, GraphGoalEvent, GraphGoalId,
    NO_GOAL, SentGoal,
};
use super::pending::{Hex, WithdrawnGoals};
use super::table::{CancelProgress, GivenUp, GoalDecision, Goals, ResultDecision};
use super::wire::CancelSelection;
use crate::PortEvent;
use crate::clock::now;
use crate::executing::TOO_LATE;
use crate::port::Execution;
use crate::services::{CallFault, MayHaveRun};

/// The part of an action that a request is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ActionRequestPart {
    Goal,
    Cancel,
    Result,
}

/// A command to the task of an action.
#[derive(Debug)]
pub(super) enum ActionCommand {
    Execute(ActionRequestPart, Execution),
    Abandoned(ExecutionId),
    /// Publishes the goal statuses, because they can be delivered from this moment on.
    TellStatuses,
}

/// The parameters of an action, and the destinations of its values.
#[derive(Debug)]
pub(super) struct ServedAction {
    pub(super) encoding: Encoding,
    /// Topic of the goals.
    pub(super) topic: TopicId,
    pub(super) feedback: TopicId,
    pub(super) status: TopicId,
    /// Whether the values are delivered: the server of the action is present.
    pub(super) offered: Arc<AtomicBool>,
    pub(super) report: mpsc::Sender<PortEvent>,
    /// The goals with a pending cancellation.
    pub(super) pending: WithdrawnGoals,
}

/// The task of an executed action.
pub(super) struct Serving<C> {
    action: ServedAction,
    client: Arc<C>,
    goals: Goals,
    /// Events of goals, and outcomes of requests to cancel.
    news: mpsc::Receiver<News>,
    tell: mpsc::Sender<News>,
    tasks: JoinSet<()>,
    /// Goals that the server was asked to cancel, each with the further requests to cancel it.
    cancels: HashMap<GraphGoalId, Vec<ExecutionId>>,
}

enum News {
    Goal(GraphGoalId, GraphGoalEvent),
    /// The response to a request to cancel a single goal, or several goals.
    Cancelled(
        ExecutionId,
        Option<GraphGoalId>,
        Result<GraphCancelResponse, CallFault>,
    ),
}

impl<C: GraphActionClient> Serving<C> {
    pub(super) fn new(action: ServedAction, client: C) -> Self {
        let (tell, news) = mpsc::channel(MOST_NEWS);
        Self {
            action,
            client: Arc::new(client),
            goals: Goals::default(),
            news,
            tell,
            tasks: JoinSet::new(),
            cancels: HashMap::new(),
        }
    }

    /// Serves until the command channel closes. Every waiting request is then answered as lost.
    /// Accepted goals go on. Withdrawn goals are followed until they have ended.
    pub(super) async fn run(mut self, mut commands: mpsc::Receiver<ActionCommand>) {
        let mut ticks = tokio::time::interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            // All branches are cancel-safe.
            let is_over = tokio::select! {
                command = commands.recv() => match command {
                    Some(ActionCommand::Execute(part, execution)) => self.execute(part, execution).await,
                    Some(ActionCommand::Abandoned(execution)) => self.abandoned(execution).await,
                    Some(ActionCommand::TellStatuses) => self.tell_statuses().await,
                    None => Err(Over),
                },
                // Never `None`, because `self` holds a sender.
                Some(news) = self.news.recv() => self.take(news).await,
                // A component may have a thousand actions, most of them without any goal.
                _ = ticks.tick(), if !self.goals.is_empty() => self.tidy().await,
            };
            while self.tasks.try_join_next().is_some() {}
            self.show_pending();
            if is_over.is_err() {
                break;
            }
        }
        for execution in self.goals.all_waiting() {
            if self.finish(execution, Executed::Lost).await.is_err() {
                break;
            }
        }
        while !self.goals.pending().is_empty()
            && let Some(news) = self.news.recv().await
        {
            // No request waits for the report.
            let _is_over = self.take(news).await.is_err();
            self.show_pending();
        }
    }

    async fn take(&mut self, news: News) -> Result<(), Over> {
        match news {
            News::Goal(id, event) => self.goal_event(id, event).await,
            News::Cancelled(execution, id, answer) => {
                let together = id.and_then(|id| self.cancels.remove(&id));
                if let Ok(GraphCancelResponse { code: NONE, goals }) = &answer {
                    goals.iter().for_each(|id| self.goals.cancel_agreed(*id));
                }
                for execution in together.into_iter().flatten() {
                    self.cancelled(execution, answer.clone()).await?;
                }
                self.cancelled(execution, answer).await
            }
        }
    }

    fn show_pending(&self) {
        self.action.pending.show(self.goals.pending());
    }

    async fn execute(&mut self, part: ActionRequestPart, execution: Execution) -> Result<(), Over> {
        if part == ActionRequestPart::Goal && now().monotonic > execution.start_by {
            debug!(action = %self.action.topic, "{TOO_LATE}");
            return self.refuse(execution.id, Refusal::NotExecutable).await;
        }
        match part {
            ActionRequestPart::Goal => self.ask_goal(execution).await,
            ActionRequestPart::Cancel => self.cancel(execution).await,
            ActionRequestPart::Result => self.want_result(execution).await,
        }
    }

    async fn ask_goal(&mut self, execution: Execution) -> Result<(), Over> {
        let Execution {
            id: run,
            request,
            start_by,
            ..
        } = execution;
        let Some((id, body)) = self.action.encoding.split(&request) else {
            return self.refuse(run, Refusal::InvalidArgument).await;
        };
        let id = match id {
            NO_GOAL => new_id(),
            id => id,
        };
        match self.goals.ask(id, run) {
            GoalDecision::Send => {
                let goal = self.client.send_goal(id, &body, start_by);
                self.tasks.spawn(follow(id, goal, self.tell.clone()));
                Ok(())
            }
            GoalDecision::Waits => Ok(()),
            GoalDecision::Withdrawn => self.finish(run, Executed::Lost).await,
            GoalDecision::Answer(answer) => {
                let answer = self.action.encoding.goal_answer(&answer);
                self.finish(run, answered(&answer)).await
            }
            GoalDecision::Full => self.refuse(run, Refusal::Busy).await,
        }
    }

    async fn want_result(&mut self, execution: Execution) -> Result<(), Over> {
        let Execution {
            id: run,
            request,
            deadline,
            ..
        } = execution;
        let Some(id) = self.action.encoding.read_result_request(&request) else {
            return self.refuse(run, Refusal::InvalidArgument).await;
        };
        // Leaves time for the response to arrive.
        let until = deadline.checked_sub(BEFORE_DEADLINE).unwrap_or(deadline);
        match self.goals.want(id, run, until) {
            ResultDecision::Waits => Ok(()),
            ResultDecision::Answer(answer) => self.finish(run, answered(&answer)).await,
            ResultDecision::NoGoal => {
                let outcome = self.no_result(UNKNOWN, "unknown goal");
                self.finish(run, outcome).await
            }
            ResultDecision::Rejected(why) => {
                let outcome = self.no_result(NEVER_RAN, &why);
                self.finish(run, outcome).await
            }
            ResultDecision::Full => self.refuse(run, Refusal::Busy).await,
        }
    }

    /// Returns the response for a goal without a result.
    fn no_result(&self, status: i8, why: &str) -> Executed {
        match self.empty(status, why) {
            Some(answer) => answered(&answer),
            None => Executed::Failed(BAD_UNEXPECTED_ERROR),
        }
    }

    fn empty(&self, status: i8, why: &str) -> Option<Bytes> {
        self.action.encoding.empty_result_answer((status, why))
    }

    async fn cancel(&mut self, execution: Execution) -> Result<(), Over> {
        let Execution {
            id: run,
            request,
            deadline,
            ..
        } = execution;
        let Some(request) = self.action.encoding.read_cancel_request(&request) else {
            return self.refuse(run, Refusal::InvalidArgument).await;
        };
        let what = match request {
            CancelSelection {
                id: NO_GOAL,
                until: None,
            } => vec![GraphCancelSelection::All],
            CancelSelection { id, until: None } => match self.goals.progress(id) {
                CancelProgress::Ended => {
                    let answer = GraphCancelResponse {
                        code: TERMINATED,
                        goals: Vec::new(),
                    };
                    return self.cancelled(run, Ok(answer)).await;
                }
                // Servers refuse a second cancellation of a goal.
                progress @ (CancelProgress::Undecided | CancelProgress::Cancelling) => {
                    if progress == CancelProgress::Undecided {
                        self.withdraw(id).await?;
                    }
                    let answer = GraphCancelResponse {
                        code: NONE,
                        goals: vec![id],
                    };
                    return self.cancelled(run, Ok(answer)).await;
                }
                // A client of the graph itself may have sent the goal.
                CancelProgress::Unknown | CancelProgress::Open => {
                    vec![GraphCancelSelection::Goal(id)]
                }
            },
            CancelSelection {
                id,
                until: Some(until),
            } => {
                let mut goals = self.goals.open_until(until);
                if id != NO_GOAL && !goals.contains(&id) {
                    goals.push(id);
                }
                goals.into_iter().map(GraphCancelSelection::Goal).collect()
            }
        };
        if what == [GraphCancelSelection::All] {
            for id in self.goals.undecided() {
                self.withdraw(id).await?;
            }
        }
        let single = match what[..] {
            [GraphCancelSelection::Goal(id)] => Some(id),
            _ => None,
        };
        if let Some(id) = single {
            match self.cancels.entry(id) {
                Entry::Occupied(mut together) => {
                    together.get_mut().push(run);
                    return Ok(());
                }
                Entry::Vacant(first) => drop(first.insert(Vec::new())),
            }
        }
        let (client, tell) = (Arc::clone(&self.client), self.tell.clone());
        self.tasks.spawn(async move {
            let answer = timeout_at(deadline.into(), cancel_each(&*client, what)).await;
            let answer = answer.unwrap_or_else(|_| Err(late_cancellation()));
            drop(tell.send(News::Cancelled(run, single, answer)).await);
        });
        Ok(())
    }

    /// Withdraws a goal: it is cancelled as soon as its server accepts it. Requests for the goal
    /// end with an unknown outcome.
    async fn withdraw(&mut self, id: GraphGoalId) -> Result<(), Over> {
        let asked = self.goals.withdraw(id, now().monotonic);
        self.cancel_in_time(id);
        self.finish_all(asked, &Executed::Lost).await
    }

    /// Has the client withdraw a goal. The end of the goal shows the effect.
    fn cancel_in_time(&mut self, id: GraphGoalId) {
        info!(action = %self.action.topic, goal = %Hex(id), "the goal was withdrawn before it was accepted; the bridge cancels it as soon as it is accepted");
        let client = Arc::clone(&self.client);
        self.tasks.spawn(async move {
            if let Err(fault) = client.cancel(GraphCancelSelection::Goal(id)).await {
                debug!(goal = %Hex(id), error = fault.text, "cannot cancel the withdrawn goal yet");
            }
        });
    }

    async fn cancelled(
        &mut self,
        run: ExecutionId,
        answer: Result<GraphCancelResponse, CallFault>,
    ) -> Result<(), Over> {
        match answer {
            Ok(answer) => {
                let answer = self.action.encoding.cancel_answer(&answer);
                self.finish(run, answered(&answer)).await
            }
            Err(CallFault { text, ran, .. }) => {
                self.finish(run, failed(ran)).await?;
                self.tell_failure(text).await
            }
        }
    }

    async fn goal_event(&mut self, id: GraphGoalId, event: GraphGoalEvent) -> Result<(), Over> {
        match event {
            GraphGoalEvent::Accepted(stamp) => {
                if let Some((asked, answer)) = self.goals.accepted(id, stamp) {
                    let answer = self.action.encoding.goal_answer(&answer);
                    self.finish_all(asked, &answered(&answer)).await?;
                    self.tell_statuses().await?;
                }
                Ok(())
            }
            GraphGoalEvent::Rejected(why) => match self.goals.rejected(id, why, now().monotonic) {
                Some((asked, answer, waiting)) => {
                    self.report_end(id, "rejected");
                    let none = self.no_result(NEVER_RAN, &answer.message);
                    let answer = self.action.encoding.goal_answer(&answer);
                    self.finish_all(asked, &answered(&answer)).await?;
                    self.finish_all(waiting, &none).await
                }
                None => Ok(()),
            },
            GraphGoalEvent::Status(status) => if self.goals.status(id, status) { self.tell_statuses().await } else { Ok(()) },
            GraphGoalEvent::Feedback(body) => match self.action.encoding.join(id, &body) {
                Some(value) => self.sample(self.action.feedback, value).await,
                None => Ok(()),
            },
            GraphGoalEvent::Ended {
                status,
                message,
                result,
            } => {
                let answer = self
                    .action
                    .encoding
                    .result_answer((status, &message), &result);
                let answer = answer.or_else(|| self.empty(status, &message));
                let end = match status {
                    4 => "succeeded",
                    5 => "canceled",
                    _ => "aborted",
                };
                self.report_end(id, end);
                self.ended(id, (status, answer)).await
            }
            GraphGoalEvent::Lost { text, ran } => self.lost(id, text, ran).await,
            GraphGoalEvent::Overdue(text) => {
                self.withdraw_overdue(id).await?;
                self.tell_failure(text).await
            }
            GraphGoalEvent::CancelRefused if !self.goals.cancel_refused(id) => Ok(()),
            GraphGoalEvent::CancelRefused => {
                self.tell_failure(format!(
                    "the action server refuses to cancel the goal {}, which was withdrawn before it was \
                     accepted: the goal continues; check the robot",
                    Hex(id)
                ))
                .await
            }
        }
    }

    async fn withdraw_overdue(&mut self, id: GraphGoalId) -> Result<(), Over> {
        let asked = self.goals.withdraw(id, now().monotonic);
        self.finish_all(asked, &Executed::Lost).await
    }

    /// Logs the end of a goal that was withdrawn before it was accepted.
    fn report_end(&self, id: GraphGoalId, end: &str) {
        if self.goals.is_withdrawn(id) {
            let action = self.action.topic;
            info!(%action, goal = %Hex(id), end, "the withdrawn goal has ended");
        }
    }

    async fn ended(
        &mut self,
        id: GraphGoalId,
        (status, answer): (i8, Option<Bytes>),
    ) -> Result<(), Over> {
        let outcome = match &answer {
            Some(answer) => answered(answer),
            None => Executed::Failed(BAD_UNEXPECTED_ERROR),
        };
        let ended = (status, answer.unwrap_or_default());
        let (waiting, asked) = self.goals.ended(id, ended, now().monotonic);
        self.finish_all(asked, &Executed::Lost).await?;
        self.finish_all(waiting, &outcome).await?;
        self.tell_statuses().await
    }

    async fn lost(&mut self, id: GraphGoalId, text: String, ran: MayHaveRun) -> Result<(), Over> {
        if ran == MayHaveRun::No {
            self.report_end(id, &format!("not sent: {text}"));
            let (asked, waiting) = self.goals.failed(id, &text, now().monotonic);
            let none = self.no_result(NEVER_RAN, &text);
            self.finish_all(asked, &failed(ran)).await?;
            self.finish_all(waiting, &none).await?;
        } else {
            self.report_end(id, &format!("unknown: {text}"));
            let answer = self.empty(UNKNOWN, &text);
            self.ended(id, (UNKNOWN, answer)).await?;
        }
        self.tell_failure(text).await
    }

    /// Handles a caller that gives up its request.
    async fn abandoned(&mut self, execution: ExecutionId) -> Result<(), Over> {
        if self.goals.give_up(execution) {
            return self.refuse(execution, Refusal::NotExecutable).await;
        }
        match self.goals.give_up_asking(execution, now().monotonic) {
            GivenUp::NotAsked => Ok(()),
            GivenUp::ByOne => self.finish(execution, Executed::Lost).await,
            // The goal would start when no caller expects it any more.
            GivenUp::ByAll(goal) => {
                self.cancel_in_time(goal);
                self.finish(execution, Executed::Lost).await
            }
        }
    }

    async fn tidy(&mut self) -> Result<(), Over> {
        let (late, forgotten) = self.goals.tidy(now().monotonic);
        // The callers repeat their requests.
        let not_yet = Executed::Refused(Refusal::NotExecutable);
        self.finish_all(late, &not_yet).await?;
        if forgotten {
            self.tell_statuses().await
        } else {
            Ok(())
        }
    }

    async fn tell_statuses(&self) -> Result<(), Over> {
        let value = self.action.encoding.statuses(&self.goals.statuses());
        self.sample(self.action.status, value).await
    }

    async fn sample(&self, topic: TopicId, payload: Bytes) -> Result<(), Over> {
        if !self.action.offered.load(Ordering::Acquire) {
            return Ok(());
        }
        self.report(PortEvent::Sample {
            topic,
            payload,
            received: now().utc,
            latched_by: None,
        })
        .await
    }

    async fn refuse(&self, execution: ExecutionId, refusal: Refusal) -> Result<(), Over> {
        self.finish(execution, Executed::Refused(refusal)).await
    }

    async fn finish_all(&self, all: Vec<ExecutionId>, outcome: &Executed) -> Result<(), Over> {
        for execution in all {
            self.finish(execution, outcome.clone()).await?;
        }
        Ok(())
    }

    async fn finish(&self, execution: ExecutionId, outcome: Executed) -> Result<(), Over> {
        self.report(PortEvent::Executed { execution, outcome })
            .await
    }

    async fn tell_failure(&self, detail: String) -> Result<(), Over> {
        let topic = self.action.topic;
        self.report(PortEvent::CallFailed { topic, detail }).await
    }

    /// Waits while the queue of the port is full: events are queued meanwhile, and the client drops
    /// feedback.
    async fn report(&self, event: PortEvent) -> Result<(), Over> {
        let report = &self.action.report;
        report.send(event).await.map_err(|_| Over)
    }
}

/// The port is closed.
struct Over;

/// Forwards the events of a goal.
async fn follow<G: SentGoal>(id: GraphGoalId, mut goal: G, tell: mpsc::Sender<News>) {
    let mut is_open = true;
    while is_open {
        let event = goal.recv().await.unwrap_or_else(|| GraphGoalEvent::Lost {
            text: "no further message about the goal was received".to_owned(),
            ran: MayHaveRun::Perhaps,
        });
        is_open = match &event {
            GraphGoalEvent::Accepted(_)
            | GraphGoalEvent::Status(_)
            | GraphGoalEvent::Feedback(_)
            | GraphGoalEvent::Overdue(_)
            | GraphGoalEvent::CancelRefused => true,
            GraphGoalEvent::Ended { .. }
            | GraphGoalEvent::Rejected(_)
            | GraphGoalEvent::Lost { .. } => false,
        };
        if tell.send(News::Goal(id, event)).await.is_err() {
            return;
        }
    }
}

/// Cancels goals one after the other. If any goal is being cancelled, the response reports success.
async fn cancel_each<C: GraphActionClient>(
    client: &C,
    what: Vec<GraphCancelSelection>,
) -> Result<GraphCancelResponse, CallFault> {
    let mut all = GraphCancelResponse {
        code: NONE,
        goals: Vec::new(),
    };
    let mut worst = NONE;
    let mut fault = None;
    for what in what {
        match client.cancel(what).await {
            Ok(GraphCancelResponse { code: NONE, goals }) => all.goals.extend(goals),
            Ok(GraphCancelResponse { code, .. }) => worst = code,
            Err(why) => fault = Some(why),
        }
    }
    match fault {
        Some(fault) if all.goals.is_empty() => Err(fault),
        Some(_) | None => {
            if all.goals.is_empty() {
                all.code = worst;
            }
            Ok(all)
        }
    }
}

fn answered(answer: &Bytes) -> Executed {
    Executed::Answered(answer.to_vec())
}

const fn failed(ran: MayHaveRun) -> Executed {
    match ran {
        MayHaveRun::No => Executed::Refused(Refusal::NotExecutable),
        MayHaveRun::Perhaps => Executed::Lost,
        MayHaveRun::Yes => Executed::Failed(BAD_UNEXPECTED_ERROR),
    }
}

/// Returns a random id.
fn new_id() -> GraphGoalId {
    use std::hash::{BuildHasher, RandomState};
    let random = || RandomState::new().hash_one(now().utc.unix_nanos());
    let mut id = NO_GOAL;
    let (first, second) = id.split_at_mut(8);
    first.copy_from_slice(&random().to_le_bytes());
    second.copy_from_slice(&random().to_le_bytes());
    id
}

/// How long before its deadline a request for a result is refused, so that its caller repeats it.
const BEFORE_DEADLINE: Duration = Duration::from_secs(1);
/// Interval of the checks for requests that wait too long.
const TICK: Duration = Duration::from_millis(250);
/// The maximal number of queued events of goals.
const MOST_NEWS: usize = 64;
/// `action_msgs/GoalStatus`, STATUS_UNKNOWN.
const UNKNOWN: i8 = 0;
/// Status of a goal that was rejected or never sent. `action_msgs/GoalStatus` has no status for it,
/// because a server of ROS 2 does not keep such a goal.
const NEVER_RAN: i8 = -1;
/// `action_msgs/CancelGoal`, ERROR_NONE and ERROR_GOAL_TERMINATED.
const NONE: i8 = 0;
const TERMINATED: i8 = 3;
/// Bad_UnexpectedError (OPC 10000-6, A.2): the server reports a failure.
const BAD_UNEXPECTED_ERROR: StatusCode = StatusCode(0x8001_0000);

/// Returns the fault of a cancellation without a response before its deadline.
fn late_cancellation() -> CallFault {
    CallFault {
        text: "the server did not respond to the cancellation in time".to_owned(),
        may_pass: true,
        ran: MayHaveRun::Perhaps,
    }
}
