//! The action servers of the graph that are executed for the space, and the task of each.

use std::collections::{BTreeMap, HashMap};
use std::num::NonZeroU16;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bridge_core::{ActionFamily, CallRole, ExecutionId, OfferedType, Refusal, ValueNote};
use mappings::{CallKind, FieldMap, Mapping, Overflow, TopicId};
use messages::{ActionCalls, TypeName};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use super::encoding::Encoding;
use super::graph::{ActionGraph, Waits};
use super::pending::AllPending;
use super::serving::{ActionCommand, ActionRequestPart, ServedAction, Serving};
use crate::clock::now;
use crate::policy::Policy;
use crate::port::Execution;
use crate::present::{self, Present};
use crate::{GraphError, PortEvent};

/// The actions of the graph that are executed for the space.
#[derive(Debug, Default)]
pub(super) struct Executors {
    served: HashMap<TopicId, Served>,
    /// Actions that cannot be served with their present settings.
    refused: HashMap<TopicId, Wanted>,
    /// The calls of the served actions: the action that each belongs to, and its part.
    parts: HashMap<TopicId, (TopicId, ActionRequestPart)>,
    /// The running executions, each with its action and part.
    running: HashMap<ExecutionId, (TopicId, ActionRequestPart)>,
    /// Number of running executions that wait for a result.
    held: usize,
    tasks: JoinSet<()>,
    pending: AllPending,
}

#[derive(Debug)]
struct Served {
    wanted: Wanted,
    family: ActionFamily,
    calls: Arc<ActionCalls>,
    commands: mpsc::Sender<ActionCommand>,
    /// Whether the server of the action is present.
    offered: Arc<AtomicBool>,
    /// Time since which the server of the action is missing.
    gone: Option<Instant>,
}

/// An action server and its metadata.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Wanted {
    action: String,
    type_name: TypeName,
    name: String,
    about: String,
    open: bool,
    waits: Waits,
}

impl Executors {
    /// See [`BridgeActions::reconcile`](super::BridgeActions::reconcile).
    pub(super) fn reconcile<G: ActionGraph>(
        &mut self,
        (graph, policy): (&mut G, &mut Policy),
        (present, mut most): (&Present, usize),
        report: &mpsc::Sender<PortEvent>,
    ) -> Vec<PortEvent> {
        while self.tasks.try_join_next().is_some() {}
        present::tell_other_types(policy, present, CallKind::Action);
        let wanted = wanted(policy, present);
        let mut events = self.withdraw_missing(&wanted);
        self.refused
            .retain(|topic, refused| wanted.get(topic) == Some(refused));
        for (topic, wanted) in wanted {
            if let Some(served) = self.served.get_mut(&topic) {
                if served.gone.take().is_some() {
                    events.extend(served.offer(topic));
                    // If the queue is full, the task publishes the statuses at the next change.
                    drop(served.commands.try_send(ActionCommand::TellStatuses));
                }
                continue;
            }
            if self.refused.contains_key(&topic) {
                continue;
            }
            if most == 0 {
                break;
            }
            most -= 1;
            match self.serve((graph, policy.mapping()), (topic, &wanted), report) {
                Ok(offered) => events.extend(offered),
                Err(why) => {
                    policy.told.once(&topic.to_string(), "not executed", || {
                        format!(
                            "the action {} is not offered to other spaces: {why}",
                            wanted.action
                        )
                    });
                    self.refused.insert(topic, wanted);
                }
            }
        }
        events
    }

    /// Withdraws actions with changed settings, and actions with missing servers. The
    /// outcomes of the goals of a missing server can be requested again after its return, for up to
    /// [`KEPT`].
    fn withdraw_missing(&mut self, wanted: &BTreeMap<TopicId, Wanted>) -> Vec<PortEvent> {
        let now = now().monotonic;
        let mut events = Vec::new();
        self.served.retain(|topic, served| {
            let other = wanted.get(topic).is_some_and(|now| served.wanted != *now);
            if wanted.contains_key(topic) && !other {
                return true;
            }
            if served.offered.swap(false, Ordering::AcqRel) {
                events.extend(served.withdraw(*topic));
            }
            let since = *served.gone.get_or_insert(now);
            !other && now.duration_since(since) < KEPT
        });
        let (served, before) = (&self.served, self.parts.len());
        self.parts.retain(|_, (of, _)| served.contains_key(of));
        if self.parts.len() < before {
            // The removed parts may have blocked refused actions.
            self.refused.clear();
        }
        events
    }

    /// Returns whether a topic that an action would occupy belongs to a variable or to a served
    /// action.
    fn is_taken(&self, mapping: &Mapping, topic: TopicId) -> bool {
        let is_behind = |served: &TopicId| {
            let (of, (space, namespace, id)) = (served.triple(), topic.triple());
            let behind = id.checked_sub(of.2);
            (of.0, of.1) == (space, namespace) && behind.is_some_and(|behind| behind <= FAMILY)
        };
        mapping.variable(topic).is_some() || self.served.keys().any(is_behind)
    }

    fn serve<G: ActionGraph>(
        &mut self,
        (graph, mapping): (&mut G, &Mapping),
        (topic, wanted): (TopicId, &Wanted),
        report: &mpsc::Sender<PortEvent>,
    ) -> Result<Vec<PortEvent>, GraphError> {
        if self.served.len() >= MOST_SERVED {
            return Err(GraphError::Full {
                most: MOST_SERVED,
                ends: "actions",
            });
        }
        let (_, _, id) = topic.triple();
        let family = ActionFamily::behind(id);
        let family = family.ok_or(GraphError::NoFamily)?;
        let of = |id| beside(topic, id).ok_or(GraphError::NoFamily);
        let (cancel, result) = (of(family.cancel)?, of(family.result)?);
        let (feedback, status) = (of(family.feedback)?, of(family.status)?);
        let all = [topic, cancel, result, feedback, status];
        if let Some(taken) = all.into_iter().find(|of| self.is_taken(mapping, *of)) {
            return Err(GraphError::TopicTaken {
                first: topic,
                last: status,
                taken,
            });
        }
        let calls = graph.action_calls(&wanted.type_name)?;
        let client = graph.action_client(&wanted.action, &wanted.type_name, wanted.waits)?;
        let (commands, told) = mpsc::channel(MOST_COMMANDS);
        let offered = Arc::new(AtomicBool::new(false));
        let encoding = Encoding::Ros(G::WIRE, Arc::clone(&calls));
        let action = ServedAction {
            encoding: encoding.clone(),
            topic,
            feedback,
            status,
            offered: Arc::clone(&offered),
            report: report.clone(),
            pending: self.pending.of(topic),
        };
        self.tasks.spawn(Serving::new(action, client).run(told));
        let served = Served {
            wanted: wanted.clone(),
            family,
            calls,
            commands,
            offered,
            gone: None,
        };
        let mut events = served.offer(topic);
        events.push(PortEvent::Sample {
            topic: status,
            payload: encoding.statuses(&[]),
            received: now().utc,
            latched_by: None,
        });
        for (of, part) in [
            (topic, ActionRequestPart::Goal),
            (cancel, ActionRequestPart::Cancel),
            (result, ActionRequestPart::Result),
        ] {
            self.parts.insert(of, (topic, part));
        }
        self.served.insert(topic, served);
        Ok(events)
    }

    /// Checks all actions again, because definitions may have changed.
    pub(super) fn look_again<G: ActionGraph>(&mut self, graph: &mut G) -> Vec<PortEvent> {
        self.refused.clear();
        let other = self.served.extract_if(|_, served| {
            let now = graph.action_calls(&served.wanted.type_name);
            now.is_ok_and(|now| !is_same(&now, &served.calls))
        });
        let events = other.flat_map(|(topic, served)| served.withdraw(topic));
        let events = events.collect();
        let served = &self.served;
        self.parts.retain(|_, (of, _)| served.contains_key(of));
        events
    }

    /// Returns whether a call is a part of an executed action.
    pub(super) fn serves(&self, topic: TopicId) -> bool {
        self.parts.contains_key(&topic)
    }

    /// Passes a request to the task of its action.
    pub(super) fn execute(&mut self, execution: Execution) -> Result<(), Refusal> {
        let part = self.parts.get(&execution.topic);
        let (action, part) = *part.ok_or(Refusal::NotExecutable)?;
        let served = self.served.get(&action).ok_or(Refusal::NotExecutable)?;
        if part == ActionRequestPart::Result && self.held >= MOST_HELD {
            return Err(Refusal::Busy);
        }
        let id = execution.id;
        let command = ActionCommand::Execute(part, execution);
        let told = served.commands.try_send(command);
        told.map_err(|_| Refusal::Busy)?;
        self.held += usize::from(part == ActionRequestPart::Result);
        self.running.insert(id, (action, part));
        Ok(())
    }

    /// See [`BridgeActions::pending`](super::BridgeActions::pending).
    pub(super) fn pending(&self) -> Vec<String> {
        self.pending.lines(now().monotonic)
    }

    /// Removes an execution that has ended.
    pub(super) fn ended(&mut self, execution: ExecutionId) {
        if let Some((_, ActionRequestPart::Result)) = self.running.remove(&execution) {
            self.held -= 1;
        }
    }

    /// Handles a caller that gives up an execution.
    pub(super) fn abandoned(&mut self, execution: ExecutionId) {
        let running = self.running.get(&execution);
        if let Some(served) = running.and_then(|(action, _)| self.served.get(action)) {
            let commands = served.commands.clone();
            // The command waits for a place in the queue instead of being dropped, because a goal
            // may have to be withdrawn. The number of waiting commands is bounded by the number of
            // executions.
            self.tasks.spawn(async move {
                let _is_over = commands
                    .send(ActionCommand::Abandoned(execution))
                    .await
                    .is_err();
            });
        }
    }
}

impl Served {
    /// Offers the three calls and the two values of the action.
    fn offer(&self, topic: TopicId) -> Vec<PortEvent> {
        self.offered.store(true, Ordering::Release);
        let (_, _, goal) = topic.triple();
        let ActionFamily {
            cancel,
            result,
            feedback,
            status,
        } = self.family;
        let Wanted {
            name, about, open, ..
        } = &self.wanted;
        let named = |part: &str| match &name[..] {
            "" => String::new(),
            name => format!("{name}{part}"),
        };
        let call = |id, service_type: &Arc<messages::ServiceType>, (part, role)| {
            let offered = OfferedType {
                service_type: Arc::clone(service_type),
                name: named(part),
                about: about.clone(),
                role,
                open: *open,
            };
            let topic = beside(topic, id)?;
            Some(PortEvent::OfferTyped { topic, offered })
        };
        let value = |id, message_type: &Arc<messages::MessageType>, (part, overflow)| {
            Some(PortEvent::BoundAs {
                topic: beside(topic, id)?,
                message_type: Arc::clone(message_type),
                note: ValueNote {
                    name: named(part),
                    about: about.clone(),
                    overflow,
                    map: FieldMap::default(),
                },
            })
        };
        let calls = &self.calls;
        let events = [
            value(feedback, calls.feedback(), (".Feedback", EVENTS)),
            value(status, calls.status(), (".Status", Overflow::KeepLatest)),
            call(
                cancel,
                calls.cancel(),
                (".Cancel", CallRole::Cancel { of: goal }),
            ),
            call(
                result,
                calls.result(),
                (".Result", CallRole::Result { of: goal }),
            ),
            call(goal, calls.goal(), ("", CallRole::Goal(self.family))),
        ];
        events.into_iter().flatten().collect()
    }

    fn withdraw(&self, topic: TopicId) -> Vec<PortEvent> {
        let (_, _, goal) = topic.triple();
        let ActionFamily {
            cancel,
            result,
            feedback,
            status,
        } = self.family;
        let all = [goal, cancel, result, feedback, status];
        let topics = all.into_iter().filter_map(|id| beside(topic, id));
        topics.map(|topic| PortEvent::Withdrawn { topic }).collect()
    }
}

/// Returns the topic of another DataSetWriterId in the same namespace.
pub(super) fn beside(topic: TopicId, id: u16) -> Option<TopicId> {
    let (space, namespace, _) = topic.triple();
    TopicId::new(space, namespace, id)
}

/// Returns whether both are the same on the wire.
pub(super) fn is_same(one: &ActionCalls, other: &ActionCalls) -> bool {
    one.goal().is_same(other.goal())
        && one.result().is_same(other.result())
        && one.feedback().is_same(other.feedback())
}

/// Returns the present action servers that are to be offered, by topic.
fn wanted(policy: &Policy, present: &Present) -> BTreeMap<TopicId, Wanted> {
    let silence = policy.mapping().pubsub().receive_timeout;
    let found = present::found(policy, present, CallKind::Action);
    let wanted = found.map(|found| {
        let (name, about, open) = found.said();
        let answer = found.call.map_or(ANSWER, |call| call.timeout);
        let wanted = Wanted {
            action: found.target.to_owned(),
            type_name: found.type_name.clone(),
            name,
            about,
            open,
            waits: Waits { answer, silence },
        };
        (found.topic, wanted)
    });
    wanted.collect()
}

/// Feedback messages are events: up to 100 of them are queued.
pub(super) const EVENTS: Overflow = Overflow::DropOldest(match NonZeroU16::new(100) {
    Some(waiting) => waiting,
    None => NonZeroU16::MIN,
});
/// Time limit for the decision of an action server about a goal, unless the mapping sets it.
const ANSWER: Duration = Duration::from_secs(30);
/// Number of identifiers that an action occupies behind its own.
const FAMILY: u16 = 4;
/// The maximal number of actions offered to other spaces: any node in a graph can invent names.
const MOST_SERVED: usize = 256;
/// The maximal number of queued requests of one action; a further request is refused as busy.
pub(super) const MOST_COMMANDS: usize = 256;
/// The maximal number of requests that wait for results, over all actions: other requests keep free
/// places.
pub(super) const MOST_HELD: usize = 512;
/// How long the goals of a missing server are kept, so that their outcomes can be requested after
/// its return.
const KEPT: Duration = Duration::from_secs(15 * 60);
