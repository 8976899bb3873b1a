//! Actions that a program executes itself, without a ROS graph: those of a port that speaks in fields.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::task::{Context, Poll};

use bridge_core::{
    ActionFamily, CallDescription, CallField, CallRole, ExecutionId, Offered, Refusal,
    ValueDescription,
};
use bytes::Bytes;
use mappings::{Overflow, TopicId};
use messages::{Leaf, Rank, TypeName};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use uadp::BuiltinType;

use super::MOST_REPORTS;
use super::encoding::Encoding;
use super::executors::{EVENTS, MOST_COMMANDS, MOST_HELD, beside};
use super::graph::ActionClient;
use super::pending::Pending;
use super::serving::{Action, Command, Part, Serving};
use crate::PortEvent;
use crate::clock::now;
use crate::port::Execution;

/// What an action takes and gives, in fields.
#[derive(Debug, Clone)]
pub struct OwnAction {
    /// Of its goals; the four identifiers behind it are its own too ([`ActionFamily::behind`]).
    pub topic: TopicId,
    /// Its name for people, as `gripper.Grasp.Goal`; its parts have something behind it.
    pub name: String,
    /// What it is, for people; begins with a ROS type where it is one, as in `ua_msgs/Grasp; GraspSkillType`.
    pub about: String,
    /// Whether goals from other hosts are taken too; else only those from a loopback address.
    pub open: bool,
    /// The fields of a goal, without its id: each is called `goal.<name>`.
    pub goal: Vec<CallField>,
    /// The fields of a result: each is called `result.<name>`.
    pub result: Vec<CallField>,
    /// The fields of feedback: each is called `feedback.<name>`.
    pub feedback: Vec<Leaf>,
    /// A block of the fields of a result with nothing in them.
    pub empty_result: Bytes,
}

/// The actions of one program. Goals, feedback and results are blocks of the fields that the action says.
#[derive(Debug)]
pub struct OwnActions {
    commands: HashMap<TopicId, mpsc::Sender<Command>>,
    /// The calls of each: of which, and what.
    parts: HashMap<TopicId, (TopicId, Part)>,
    /// What is executed of them.
    running: HashMap<ExecutionId, (TopicId, Part)>,
    /// How many of that wait for a result.
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
    /// Offers an action, whose goals go to `client`, in the place of what was offered as it. Reports its calls and values. Needs a tokio runtime. `None` where there are
    /// no identifiers behind that of its goals.
    pub fn add<C: ActionClient>(
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
        // Those that others took the place of.
        while self.tasks.try_join_next().is_some() {}
        let serving = Action {
            encoding,
            topic,
            feedback,
            status,
            offered: Arc::new(AtomicBool::new(true)),
            report: self.report.clone(),
            // Its program shows the skills behind the goals.
            pending: Pending::default(),
        };
        self.tasks.spawn(Serving::new(serving, client).run(told));
        let parts = [
            (topic, Part::Goal),
            (cancel, Part::Cancel),
            (result, Part::Result),
        ];
        let parts = parts.map(|(of, part)| (of, (topic, part)));
        self.parts.extend(parts);
        self.commands.insert(topic, commands);
        Some(events)
    }

    /// Whether it executes that call: a part of an action.
    #[must_use]
    pub fn serves(&self, topic: TopicId) -> bool {
        self.parts.contains_key(&topic)
    }

    /// Executes a request for a part of an action. What becomes of it comes from [`recv`](Self::recv).
    ///
    /// # Errors
    /// Why it is not executed.
    pub fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        let part = self.parts.get(&execution.topic);
        let (action, part) = *part.ok_or(Refusal::NotExecutable)?;
        let commands = self.commands.get(&action).ok_or(Refusal::NotExecutable)?;
        if part == Part::Result && self.held >= MOST_HELD {
            return Err(Refusal::Busy);
        }
        let id = execution.id;
        let told = commands.try_send(Command::Execute(part, execution));
        told.map_err(|_| Refusal::Busy)?;
        self.held += usize::from(part == Part::Result);
        self.running.insert(id, (action, part));
        Ok(())
    }

    /// The caller of an execution has given it up. An accepted goal goes on. A goal whose run has not begun is cancelled.
    pub fn abandoned(&mut self, execution: ExecutionId) {
        let running = self.running.get(&execution);
        if let Some(commands) = running.and_then(|(action, _)| self.commands.get(action)) {
            let commands = commands.clone();
            // It waits for its turn and is not lost. There are as many as executions at most.
            self.tasks.spawn(async move {
                let _is_over = commands.send(Command::Abandoned(execution)).await.is_err();
            });
        }
    }

    /// What came of executions, and what goals report. Cancel-safe; pends without any.
    pub async fn recv(&mut self) -> PortEvent {
        std::future::poll_fn(|cx| self.poll_recv(cx)).await
    }

    fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        // Never `None` while we hold a sender ourselves.
        let Poll::Ready(Some(event)) = self.reports.poll_recv(cx) else {
            return Poll::Pending;
        };
        if let PortEvent::Executed { execution, .. } = &event
            && let Some((_, Part::Result)) = self.running.remove(execution)
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
            rank: Rank::Scalar,
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
                // Without a type nobody in a graph would take note of what the fields are.
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
            // Last, since it is by this one that the others are found.
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
            let offered = Offered { description, open };
            PortEvent::Offer { topic, offered }
        });
        calls.into()
    }
}

/// 16 bytes that tell a goal.
const GOAL_ID: &str = "goal_id";
