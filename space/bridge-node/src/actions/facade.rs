//! One action of another space, served in the graph: a task that receives goals from its clients,
//! sends them to the space, and forwards feedback and results.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use bridge_core::{AskErrorKind, Reason};
use bytes::Bytes;
use mappings::TopicId;
use messages::Wire;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};
use tracing::debug;

use super::graph::{
    GraphActionServer, GraphCancelRequest, GraphGoalId, GraphNewGoal, GraphServerEvent, ServedGoal,
};
use super::wire;
use crate::calls::AskFault;
use crate::clock::now;
use crate::{Asker, PortEvent};

/// The senders of the requests of an action, and their timeouts.
#[derive(Debug, Clone)]
pub(super) struct Asks {
    pub(super) wire: Wire,
    pub(super) goal: Asker,
    pub(super) cancel: Asker,
    pub(super) result: Asker,
    /// How long a goal waits for the executor of the action to return.
    pub(super) silence: Duration,
    /// Time since which the executor is lost.
    pub(super) gone: watch::Receiver<Option<Instant>>,
}

/// The task of a served action.
#[derive(Debug)]
pub(super) struct Facade<A> {
    pub(super) asks: Asks,
    pub(super) server: A,
    /// Feedback of all goals of the action.
    pub(super) values: mpsc::Receiver<Bytes>,
    /// The topic of the feedback.
    pub(super) feedback: TopicId,
    pub(super) report: mpsc::Sender<PortEvent>,
}

impl<A: GraphActionServer> Facade<A> {
    /// Serves until the task is aborted. Open goals are then aborted in this graph, and go on in
    /// the space.
    pub(super) async fn run(mut self) {
        let mut goals: HashMap<GraphGoalId, mpsc::Sender<Bytes>> = HashMap::new();
        let mut tasks = JoinSet::new();
        let mut cancels = JoinSet::new();
        let (ends, mut ended) = mpsc::channel::<oneshot::Sender<()>>(MOST_GOALS);
        loop {
            // All branches are cancel-safe.
            tokio::select! {
                event = self.server.recv() => match event {
                    GraphServerEvent::Goal(new) => {
                        goals.retain(|_, feedback| !feedback.is_closed());
                        if let Some(refusal) = refusal(&goals, new.id()) {
                            new.reject(refusal);
                            continue;
                        }
                        let (feedback, told) = mpsc::channel(MOST_FEEDBACK);
                        goals.insert(new.id(), feedback);
                        let told = Told {
                            feedback: told,
                            ends: ends.clone(),
                        };
                        tasks.spawn(drive(self.asks.clone(), new, told));
                    }
                    GraphServerEvent::Cancel(request) if cancels.len() < MOST_CANCELS => {
                        cancels.spawn(cancel(self.asks.clone(), request));
                    }
                    GraphServerEvent::Cancel(request) => request.reject(),
                },
                value = self.values.recv() => match value {
                    Some(value) => self.hand_on(&goals, &value),
                    None => return,
                },
                Some(all) = ended.recv() => {
                    while let Ok(value) = self.values.try_recv() {
                        self.hand_on(&goals, &value);
                    }
                    let _waits = all.send(());
                }
            }
            while tasks.try_join_next().is_some() || cancels.try_join_next().is_some() {}
        }
    }

    /// Forwards feedback to its goal. Ignores feedback of goals that other clients of the action
    /// have sent.
    fn hand_on(&self, goals: &HashMap<GraphGoalId, mpsc::Sender<Bytes>>, value: &[u8]) {
        let Some((id, body)) = wire::split(self.asks.wire, value) else {
            return;
        };
        let Some(goal) = goals.get(&id) else {
            return;
        };
        if let Err(mpsc::error::TrySendError::Full(_)) = goal.try_send(body) {
            // If the queue of reports is full, the loss is not counted.
            drop(self.report.try_send(PortEvent::Lost {
                topic: Some(self.feedback),
                reason: Reason::Overflow,
                why: "goal is queued too long",
                count: 1,
            }));
        }
    }
}

/// Returns the reason why a goal is rejected, if it is.
fn refusal(
    goals: &HashMap<GraphGoalId, mpsc::Sender<Bytes>>,
    id: GraphGoalId,
) -> Option<&'static str> {
    if goals.contains_key(&id) {
        return Some("a goal with this id already exists");
    }
    (goals.len() >= MOST_GOALS).then_some("the limit of open goals is reached")
}

/// The channels through which a goal receives feedback.
struct Told {
    feedback: mpsc::Receiver<Bytes>,
    /// Requests delivery of all feedback received so far.
    ends: mpsc::Sender<oneshot::Sender<()>>,
}

/// Drives a goal to its end.
async fn drive<N: GraphNewGoal>(asks: Asks, new: N, told: Told) {
    let id = new.id();
    let Some(goal) = begin(&asks, id, new).await else {
        return;
    };
    goal.execute();
    let End {
        status,
        message,
        result,
    } = follow(&asks, id, &goal, told).await;
    if let Err(why) = goal.end(status, &message, result.as_deref()) {
        debug!(%why, "cannot report the end of a goal");
    }
}

/// Sends a goal to its executor, and accepts it in this graph once the executor has accepted it.
async fn begin<N: GraphNewGoal>(asks: &Asks, id: GraphGoalId, new: N) -> Option<N::Goal> {
    let Some(request) = wire::join(asks.wire, id, new.body()) else {
        new.reject("the goal is malformed");
        return None;
    };
    if let Err(why) = send(asks, id, request).await {
        debug!(%why, "the goal from another space was not accepted");
        new.reject(&why.to_string());
        return None;
    }
    let accepted = new.accept().await;
    accepted
        .inspect_err(|why| debug!(%why, "an accepted goal continues without its client"))
        .ok()
}

/// Forwards feedback until the goal has ended. Feedback reported before the end is forwarded before
/// it.
async fn follow(asks: &Asks, id: GraphGoalId, goal: &impl ServedGoal, told: Told) -> End {
    let Told { mut feedback, ends } = told;
    let mut end = Box::pin(wait(asks, id));
    let end = loop {
        tokio::select! {
            biased;
            Some(body) = feedback.recv() => hand_to(goal, &body),
            end = &mut end => break end,
        }
    };
    // Feedback from before the end may still be queued in the task that assigns it to goals.
    let (all, handed_on) = oneshot::channel();
    if ends.send(all).await.is_ok() {
        drop(handed_on.await);
    }
    while let Ok(body) = feedback.try_recv() {
        hand_to(goal, &body);
    }
    end
}

fn hand_to(goal: &impl ServedGoal, feedback: &[u8]) {
    if let Err(why) = goal.feedback(feedback) {
        debug!(%why, "cannot publish feedback");
    }
}

/// The reason why a goal was not accepted.
#[derive(Debug, thiserror::Error)]
enum GoalNotAccepted {
    /// The executor rejected the goal, with this message.
    #[error("{0}")]
    Rejected(String),
    #[error("the response to the goal is malformed")]
    Malformed,
    /// There is no response, for this reason.
    #[error("{0}")]
    NoAnswer(String),
}

/// Sends a goal. Sends it a second time if it is unknown whether the first request arrived, because
/// goals with the same id are the same goal, or if it was refused and the executor has returned.
async fn send(asks: &Asks, id: GraphGoalId, request: Bytes) -> Result<(), GoalNotAccepted> {
    let ask = || asks.goal.ask_for(request.clone());
    let answer = match ask().await {
        Err(fault) if fault.kind == AskErrorKind::Unknown || comes_back(asks, &fault).await => {
            ask().await
        }
        answer => answer,
    };
    let unknown = match answer {
        Ok(answer) => match wire::read_goal_answer(asks.wire, &answer) {
            Some(answer) if answer.accepted => return Ok(()),
            Some(answer) => return Err(GoalNotAccepted::Rejected(answer.message)),
            None => GoalNotAccepted::Malformed,
        },
        Err(AskFault {
            kind: AskErrorKind::Refused,
            text,
        }) => return Err(GoalNotAccepted::NoAnswer(text)),
        Err(AskFault { text, .. }) => GoalNotAccepted::NoAnswer(text),
    };
    // The goal may be running without any client that knows of it.
    let request = wire::CancelSelection { id, until: None };
    let request = wire::cancel_request(asks.wire, request);
    let cancel = asks.cancel.clone().within(CANCEL_WITHIN);
    drop(cancel.ask_for(request).await);
    Err(unknown)
}

/// Returns whether a goal was refused because the executor was lost, and the executor returns
/// before the timeout: a restarted server is lost for a moment.
async fn comes_back(asks: &Asks, fault: &AskFault) -> bool {
    if fault.kind != AskErrorKind::Refused {
        return false;
    }
    // The loss of the executor is noticed within moments of the refusal.
    sleep(FIRST_PAUSE).await;
    let is_gone = asks.gone.borrow().is_some();
    is_gone && returns(asks).await
}

/// Returns whether the executor is present, or returns before the timeout.
async fn returns(asks: &Asks) -> bool {
    let mut gone = asks.gone.clone();
    let Some(since) = *gone.borrow_and_update() else {
        return true;
    };
    let left = (since + asks.silence).saturating_duration_since(now().monotonic);
    let back = timeout(left, gone.wait_for(Option::is_none));
    back.await.is_ok_and(|told| told.is_ok())
}

/// The outcome of a goal.
struct End {
    status: i8,
    message: String,
    result: Option<Bytes>,
}

impl End {
    const fn aborted(message: String) -> Self {
        Self {
            status: ABORTED,
            message,
            result: None,
        }
    }
}

/// Waits for the end of a goal, or until its executor is lost for too long.
async fn wait(asks: &Asks, id: GraphGoalId) -> End {
    let request = wire::result_request(asks.wire, id);
    let result = asks.result.clone().within(RESULT_WITHIN);
    let mut pause = FIRST_PAUSE;
    loop {
        let fault = match result.ask_for(request.clone()).await {
            Ok(answer) => {
                return match wire::read_outcome(asks.wire, &answer) {
                    Some(outcome) if outcome.status == UNKNOWN => End::aborted(or(
                        outcome.message,
                        "the executor of the action has lost the goal",
                    )),
                    Some(outcome) => End {
                        status: outcome.status,
                        message: outcome.message,
                        result: Some(outcome.result),
                    },
                    None => End::aborted("the result is malformed".to_owned()),
                };
            }
            Err(fault) => fault,
        };
        // An executor that returns answers for its goals: its action may have been withdrawn for a
        // moment only, and after a restart it does not know them.
        if !returns(asks).await {
            return End::aborted(format!(
                "the executor of the action is lost; the goal may go on, so check the robot: {}",
                fault.text
            ));
        }
        match fault.kind {
            AskErrorKind::Failed => return End::aborted(fault.text),
            // The request reached its time limit, or the executor is silent for the moment.
            AskErrorKind::Refused | AskErrorKind::Unknown => sleep(pause).await,
        }
        pause = (pause * 2).min(LAST_PAUSE);
    }
}

fn or(text: String, otherwise: &str) -> String {
    match &text[..] {
        "" => otherwise.to_owned(),
        _ => text,
    }
}

/// Requests to cancel a goal. A goal that is unknown to the executor may be on its way.
async fn cancel<C: GraphCancelRequest>(asks: Asks, request: C) {
    let id = request.id();
    let agreed = timeout(CANCEL_WITHIN, async {
        while let Some(code) = ask_to_cancel(&asks, id).await {
            if code != NO_SUCH_GOAL {
                return code == AGREED;
            }
            sleep(FIRST_PAUSE).await;
        }
        false
    });
    if !agreed.await.unwrap_or(false) {
        request.reject();
    } else if let Err(why) = request.accept() {
        debug!(%why, "ended a goal whose cancellation is in progress");
    }
}

/// Returns the code of the response; `None` without a response.
async fn ask_to_cancel(asks: &Asks, id: GraphGoalId) -> Option<i8> {
    let request = wire::CancelSelection { id, until: None };
    let request = wire::cancel_request(asks.wire, request);
    let cancel = asks.cancel.clone().within(CANCEL_WITHIN);
    let answer = cancel.ask_for(request).await.ok()?;
    Some(wire::read_cancel_answer(asks.wire, &answer)?.code)
}

/// The maximal number of open goals of one action.
const MOST_GOALS: usize = 1000;
/// The maximal number of concurrent requests to cancel.
const MOST_CANCELS: usize = 64;
/// The maximal number of queued feedback messages of a goal.
const MOST_FEEDBACK: usize = 100;
/// Timeout of a single request for a result.
const RESULT_WITHIN: Duration = Duration::from_secs(30);
/// Time limit for cancelling a goal: an action server of ROS 2 answers its client within 5 s.
const CANCEL_WITHIN: Duration = Duration::from_secs(4);
/// Pauses between repeated requests, doubling from the first to the last.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LAST_PAUSE: Duration = Duration::from_secs(1);
/// `action_msgs/GoalStatus`, STATUS_UNKNOWN and STATUS_ABORTED.
const UNKNOWN: i8 = 0;
const ABORTED: i8 = 6;
/// `action_msgs/CancelGoal`, ERROR_NONE and ERROR_UNKNOWN_GOAL_ID.
const AGREED: i8 = 0;
const NO_SUCH_GOAL: i8 = 2;
