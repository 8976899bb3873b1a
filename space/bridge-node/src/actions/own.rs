//! Actions that a program executes itself, without a ROS graph, for ports with
//! fields as payloads.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::task::{Context, Poll};

use bridge_core::{
    ActionFamily, CallDescription, CallField, CallRole, ExecutionId, OfferedCall, Refusal,
    ValueDescription,
};
use bytes::Bytes;
use mappings::{Overflow, TopicId};
use messages::{ArrayRank, Leaf, TypeName};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use uadp::BuiltinType;

use super::MOST_REPORTS;
use super::encoding::Encoding;
use super::executors::{EVENTS, MOST_COMMANDS, MOST_HELD, beside};
use super::graph::GraphActionClient;
use super::pending::WithdrawnGoals;
use super::serving::{ActionCommand, ActionRequestPart, ServedAction, Serving};
use crate::PortEvent;
use crate::clock::now;
use crate::port::Execution;

/// The fields of an action and its metadata.
#[derive(Debug, Clone)]
pub struct OwnAction {
    /// Topic of the goals; the four identifiers behind it belong to the action too
    /// ([`ActionFamily::behind`]).
    pub topic: TopicId,
    /// Display name, such as `gripper.Grasp.Goal`; the names of its parts have a suffix.
    pub name: String,
    /// Description for users; starts with the ROS type if there is one, as in `ua_msgs/Grasp;
    /// GraspSkillType`.
    pub about: String,
    /// Whether goals from other hosts are accepted; else only goals from a loopback address.
    pub open: bool,
    /// The fields of a goal, without its id: each is called `goal.<name>`.
    pub goal: Vec<CallField>,
    /// The fields of a result: each is called `result.<name>`.
    pub result: Vec<CallField>,
    /// The fields of feedback: each is called `feedback.<name>`.
    pub feedback: Vec<Leaf>,
    /// A block of the fields of an empty result.
    pub empty_result: Bytes,
}

/// The actions of one program. Goals, feedback and results are blocks of the fields that the action
/// declares.
#[derive(Debug)]
pub struct OwnActions {
    commands: HashMap<TopicId, mpsc::Sender<ActionCommand>>,
    /// The calls of the actions: the action that each belongs to, and its part.
    parts: HashMap<TopicId, (TopicId, ActionRequestPart)>,
    /// The running executions, each with its action and part.
    running: HashMap<ExecutionId, (TopicId, ActionRequestPart)>,
    /// Number of running executions that wait for a result.
    held: usize,
    reports: mpsc::Receiver<PortEvent>,
    report: mpsc::Sender<PortEvent>,
    tasks: JoinSet<()>,
}

impl Default for OwnActions {
    fn default() -> Self {
        let (report, reports) = mpsc::channel(MOST_REPORTS);
        Self {
            commands: HashMap::new(),
            parts: HashMap::new(),
            running: HashMap::new(),
            held: 0,
            reports,
            report,
            tasks: JoinSet::new(),
        }
    }
}

impl OwnActions {
    /// Offers an action that sends its goals to `client`, and replaces an earlier action of the
    /// same topic. Returns the events of its calls and values, or `None` if there are no
    /// identifiers behind the identifier of its goals. Needs a tokio runtime.
    pub fn add<C: GraphActionClient>(
        &mut self,
        action: &OwnAction,
        client: C,
    ) -> Option<Vec<PortEvent>> {
        let topic = action.topic;
        let (_, _, goal) = topic.triple();
        let family = ActionFamily::behind(goal)?;
        let of = |id| beside(topic, id);
        let (cancel, result) = (of(family.cancel)?, of(family.result)?);
        let (feedback, status) = (of(family.feedback)?, of(family.status)?);
        let encoding = Encoding::Fields {
            empty_result: action.empty_result.clone(),
        };
        let mut events = action.values(feedback, status);
        events.extend(action.calls([topic, cancel, result], family));
        events.push(PortEvent::Sample {
            topic: status,
            payload: encoding.statuses(&[]),
            received: now().utc,
            latched_by: None,
        });
        let (commands, told) = mpsc::channel(MOST_COMMANDS);
        // Reap the tasks of replaced actions.
        while self.tasks.try_join_next().is_some() {}
        let serving = ServedAction {
            encoding,
            topic,
            feedback,
            status,
            offered: Arc::new(AtomicBool::new(true)),
            report: self.report.clone(),
            // The program itself shows the skills behind the goals.
            pending: WithdrawnGoals::default(),
        };
        self.tasks.spawn(Serving::new(serving, client).run(told));
        let parts = [
            (topic, ActionRequestPart::Goal),
            (cancel, ActionRequestPart::Cancel),
            (result, ActionRequestPart::Result),
        ];
        let parts = parts.map(|(of, part)| (of, (topic, part)));
        self.parts.extend(parts);
        self.commands.insert(topic, commands);
        Some(events)
    }

    /// Returns whether a call is executed here as a part of an action.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        self.parts.contains_key(&topic)
    }

    /// Executes a request for a part of an action. The outcome is reported by [`recv`](Self::recv).
    ///
    /// # Errors
    /// The reason why the request is refused.
    pub fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        let part = self.parts.get(&execution.topic);
        let (action, part) = *part.ok_or(Refusal::NotExecutable)?;
        let commands = self.commands.get(&action).ok_or(Refusal::NotExecutable)?;
        if part == ActionRequestPart::Result && self.held >= MOST_HELD {
            return Err(Refusal::Busy);
        }
        let id = execution.id;
        let told = commands.try_send(ActionCommand::Execute(part, execution));
        told.map_err(|_| Refusal::Busy)?;
        self.held += usize::from(part == ActionRequestPart::Result);
        self.running.insert(id, (action, part));
        Ok(())
    }

    /// Handles a caller that gives up an execution. An accepted goal goes on. A goal is cancelled
    /// if its run has not started.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        let running = self.running.get(&execution);
        if let Some(commands) = running.and_then(|(action, _)| self.commands.get(action)) {
            let commands = commands.clone();
            // The command waits for a place in the queue instead of being dropped. The number of
            // waiting commands is bounded by the number of executions.
            self.tasks.spawn(async move {
                let _is_over = commands
                    .send(ActionCommand::Abandoned(execution))
                    .await
                    .is_err();
            });
        }
    }

    /// Returns the next outcome of an execution or report of a goal. Cancel-safe; pends while there
    /// is no event.
    pub async fn recv(&mut self) -> PortEvent {
        std::future::poll_fn(|cx| self.poll_recv(cx)).await
    }

    fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        // Never `None`, because `self` holds a sender.
        let Poll::Ready(Some(event)) = self.reports.poll_recv(cx) else {
            return Poll::Pending;
        };
        if let PortEvent::Executed { execution, .. } = &event
            && let Some((_, ActionRequestPart::Result)) = self.running.remove(execution)
        {
            self.held -= 1;
        }
        Poll::Ready(event)
    }
}

impl OwnAction {
    fn values(&self, feedback: TopicId, status: TopicId) -> Vec<PortEvent> {
        let leaf = |path: &str, builtin| Leaf {
            path: path.to_owned(),
            builtin,
            rank: ArrayRank::Scalar,
        };
        let id = [leaf(GOAL_ID, BuiltinType::ByteString)];
        let of_feedback = self.feedback.iter().map(|field| Leaf {
            path: format!("feedback.{}", field.path),
            ..field.clone()
        });
        let statuses = ["goal_ids", "statuses"];
        let statuses = statuses.map(|name| leaf(name, BuiltinType::ByteString));
        let values = [
            (
                (feedback, ".Feedback", "_FeedbackValue"),
                id.into_iter().chain(of_feedback).collect(),
                EVENTS,
            ),
            (
                (status, ".Status", "_StatusValue"),
                Vec::from(statuses),
                Overflow::KeepLatest,
            ),
        ];
        let own_type = self.about.split(';').next().unwrap_or_default();
        let own_type: Option<TypeName> = own_type.trim().parse().ok();
        let values = values
            .into_iter()
            .map(|((topic, part, suffix), fields, overflow)| {
                // A node of a graph ignores values without a type.
                let message_type = own_type.as_ref().and_then(|of| {
                    TypeName::new(of.package(), &format!("{}{suffix}", of.name())).ok()
                });
                let description = ValueDescription {
                    name: format!("{}{part}", self.name),
                    message_type,
                    about: String::new(),
                    fields,
                    overflow,
                };
                let described = PortEvent::Described { topic, description };
                [described, PortEvent::Live { topic, live: true }]
            });
        values.flatten().collect()
    }

    fn calls(&self, topics: [TopicId; 3], family: ActionFamily) -> Vec<PortEvent> {
        let [goal, cancel, result] = topics;
        let (_, _, of) = goal.triple();
        let id = || CallField::scalar(GOAL_ID, BuiltinType::ByteString).optional();
        let stamp = || CallField::scalar("stamp", BuiltinType::DateTime);
        let within = |what: &str, fields: &[CallField]| -> Vec<CallField> {
            let named = fields.iter().map(|field| CallField {
                name: format!("{what}.{}", field.name),
                ..field.clone()
            });
            named.collect()
        };
        let message = || CallField::scalar("message", BuiltinType::String);
        let sends = (
            [vec![id()], within("goal", &self.goal)].concat(),
            vec![
                CallField::scalar("accepted", BuiltinType::Boolean),
                CallField::scalar(GOAL_ID, BuiltinType::ByteString),
                stamp(),
                message(),
            ],
        );
        let cancels = (
            vec![id(), stamp().optional()],
            vec![
                CallField::scalar("return_code", BuiltinType::SByte),
                CallField::scalar("goal_ids", BuiltinType::ByteString),
            ],
        );
        let status = vec![CallField::scalar("status", BuiltinType::SByte), message()];
        let waits = (
            vec![CallField::scalar(GOAL_ID, BuiltinType::ByteString)],
            [status, within("result", &self.result)].concat(),
        );
        let calls = [
            (cancel, ".Cancel", CallRole::Cancel { of }, cancels),
            (result, ".Result", CallRole::Result { of }, waits),
            // The call of the goals comes last, because the other calls and values are found
            // through it.
            (goal, "", CallRole::Goal(family), sends),
        ];
        let calls = calls.map(|(topic, part, role, (request, response))| {
            let description = CallDescription {
                name: format!("{}{part}", self.name),
                about: self.about.clone(),
                role,
                request,
                response,
            };
            let open = self.open;
            let offered = OfferedCall { description, open };
            PortEvent::Offer { topic, offered }
        });
        calls.into()
    }
}

/// Name of the field with the 16 bytes that identify a goal.
const GOAL_ID: &str = "goal_id";
