//! The actions of other spaces that are served in the graph, and the task of each.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_core::{ActionFamily, CallDescription, CallMap, CallRole, ValueNote};
use bytes::Bytes;
use mappings::{CallKind, FieldMap, Mapping, Overflow, TopicId};
use messages::{ActionCalls, TypeName, Wire};
use tokio::sync::{mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};
use tracing::info;

use super::executors::{EVENTS, beside, is_same};
use super::facade::{Asks, Facade};
use super::graph::ActionGraph;
use crate::policy::{Policy, action_type};
use crate::port::LocalDelivery;
use crate::{Asker, GraphError, PortEvent};

/// The known actions of other spaces.
#[derive(Debug, Default)]
pub(super) struct Facades {
    known: BTreeMap<TopicId, Known>,
    /// Topics of the values of actions, each with its action.
    values: HashMap<TopicId, TopicId>,
    tasks: JoinSet<()>,
}

#[derive(Debug)]
struct Known {
    described: Arc<CallDescription>,
    family: ActionFamily,
    state: State,
}

#[derive(Debug)]
enum State {
    /// To be offered later.
    Waiting,
    /// Not offered: its type is unknown here, or the limit is reached.
    Refused,
    Offered(Box<Offered>),
}

#[derive(Debug)]
struct Offered {
    target: Target,
    calls: Arc<ActionCalls>,
    feedback: mpsc::Sender<Bytes>,
    /// Time since which the executor of the action is lost.
    gone: watch::Sender<Option<Instant>>,
    task: AbortHandle,
}

impl Drop for Offered {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Name, type and field maps under which an action is offered.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Target {
    name: String,
    /// The type that the mapping sets, if any.
    type_name: Option<TypeName>,
    goal: Arc<CallMap>,
    result: Arc<CallMap>,
    feedback: FieldMap,
    /// Time limit for the decision about a goal.
    timeout: Duration,
}

impl Target {
    /// Returns the target of the mapping; without it, the name of the topic.
    fn of(topic: TopicId, policy: &Policy) -> Self {
        let call = policy.mapping().call(topic);
        let call = call.filter(|call| call.kind == CallKind::Action);
        let timeout = call.map_or(ANSWERED_WITHIN, |call| call.timeout);
        match call.and_then(|call| call.binding(policy.own())) {
            Some(binding) => Self {
                name: binding.target.name.clone(),
                type_name: Some(binding.target.type_name.clone()),
                goal: Arc::new(CallMap {
                    request: binding.request.clone(),
                    response: FieldMap::default(),
                }),
                result: Arc::new(CallMap {
                    request: FieldMap::default(),
                    response: binding.response.clone(),
                }),
                feedback: binding.feedback.clone(),
                timeout,
            },
            None => Self {
                name: format!("/{topic}"),
                type_name: None,
                goal: Arc::default(),
                result: Arc::default(),
                feedback: FieldMap::default(),
                timeout,
            },
        }
    }
}

impl Facades {
    /// See [`BridgeActions::known`](super::BridgeActions::known).
    pub(super) fn known(&mut self, topic: TopicId, described: &Arc<CallDescription>) {
        let CallRole::Goal(family) = described.role else {
            self.forget(topic);
            return;
        };
        match self.known.get(&topic) {
            Some(known) if known.described == *described => {
                if let State::Offered(offered) = &known.state {
                    offered.gone.send_replace(None);
                }
                return;
            }
            None if self.known.len() >= MOST_KNOWN => return,
            Some(_) | None => {}
        }
        self.forget(topic);
        for of in [family.feedback, family.status] {
            if let Some(value) = beside(topic, of) {
                self.values.insert(value, topic);
            }
        }
        let known = Known {
            described: Arc::clone(described),
            family,
            state: State::Waiting,
        };
        self.known.insert(topic, known);
    }

    /// See [`BridgeActions::gone`](super::BridgeActions::gone).
    pub(super) fn gone(&mut self, topic: TopicId, now: Instant) {
        match self.known.get(&topic).map(|known| &known.state) {
            Some(State::Offered(offered)) => {
                offered.gone.send_if_modified(|gone| {
                    let is_new = gone.is_none();
                    gone.get_or_insert(now);
                    is_new
                });
            }
            Some(State::Waiting | State::Refused) => {
                self.forget(topic);
            }
            None => {}
        }
    }

    /// See [`BridgeActions::tidy`](super::BridgeActions::tidy). Reports the calls and values that
    /// are unbound.
    pub(super) fn tidy(&mut self, policy: &Policy, now: Instant) -> Vec<PortEvent> {
        while self.tasks.try_join_next().is_some() {}
        let silence = policy.mapping().pubsub().receive_timeout;
        let over = self
            .known
            .iter()
            .filter(|(_, known)| match &known.state {
                State::Offered(offered) => offered
                    .gone
                    .borrow()
                    .is_some_and(|since| now.duration_since(since) >= silence + LEFT_AFTER),
                State::Waiting | State::Refused => false,
            })
            .map(|(topic, _)| *topic);
        let over: Vec<TopicId> = over.collect();
        let mut events = Vec::new();
        for topic in over {
            if let Some(known) = self.forget(topic) {
                let name = &known.described.name;
                info!(%topic, name, "the program that executes the action withdrew it: its action server is closed");
                events.extend(known.unbind(topic));
            }
        }
        if !events.is_empty() {
            // Refused actions can take the free place.
            self.wait_anew();
        }
        events
    }

    fn forget(&mut self, topic: TopicId) -> Option<Known> {
        let known = self.known.remove(&topic)?;
        self.values.retain(|_, of| *of != topic);
        Some(known)
    }

    fn wait_anew(&mut self) {
        for known in self.known.values_mut() {
            if let State::Refused = known.state {
                known.state = State::Waiting;
            }
        }
    }

    /// Returns the known actions that have a name in this space by the mapping, with the name.
    pub(super) fn chosen(&self, policy: &Policy) -> Vec<(TopicId, String)> {
        let mapped = policy.mapping().asked_in(policy.own());
        let known = mapped.filter(|(call, _)| {
            call.kind == CallKind::Action && self.known.contains_key(&call.topic)
        });
        known
            .map(|(call, binding)| (call.topic, binding.target.name.clone()))
            .collect()
    }

    pub(super) fn is_waiting(&self) -> bool {
        let mut known = self.known.values();
        known.any(|known| matches!(known.state, State::Waiting))
    }

    pub(super) fn leave(&mut self, to_others: impl Fn(TopicId, &str) -> bool) {
        for (topic, known) in &mut self.known {
            if let State::Offered(offered) = &known.state
                && to_others(*topic, &offered.target.name)
            {
                known.state = State::Waiting;
            }
        }
    }

    /// Returns the served actions by their names in this space.
    pub(super) fn offered(&self) -> BTreeMap<TopicId, &str> {
        let offered = self.known.iter();
        let offered = offered.filter_map(|(topic, known)| match &known.state {
            State::Offered(offered) => Some((*topic, offered.target.name.as_str())),
            State::Waiting | State::Refused => None,
        });
        offered.collect()
    }

    /// See [`BridgeActions::offer_waiting`](super::BridgeActions::offer_waiting).
    pub(super) fn offer_waiting<G: ActionGraph>(
        &mut self,
        (graph, policy): (&mut G, &mut Policy),
        (asker, report): (impl Fn(TopicId) -> Asker, &mpsc::Sender<PortEvent>),
        may: impl Fn(TopicId, &str) -> bool,
        most: usize,
    ) -> Vec<PortEvent> {
        let mut left = MOST_OFFERED.saturating_sub(self.offered().len());
        let waiting = self.known.iter();
        let waiting = waiting.filter(|(_, known)| matches!(known.state, State::Waiting));
        let waiting = waiting.map(|(topic, _)| (*topic, Target::of(*topic, policy)));
        let waiting = waiting.filter(|(topic, target)| may(*topic, &target.name));
        let waiting: Vec<(TopicId, Target)> = waiting.take(most).collect();
        let mut events = Vec::new();
        for (topic, target) in waiting {
            let tasks = &mut self.tasks;
            let Some(known) = self.known.get_mut(&topic) else {
                continue;
            };
            if left == 0 {
                known.state = State::Refused;
                policy.told.once("", "too many actions", || {
                    format!(
                        "more than {MOST_OFFERED} actions of the space: the bridge does not offer the others"
                    )
                });
                continue;
            }
            let waits = policy.mapping().pubsub().receive_timeout;
            let with = (&asker, report, waits, tasks);
            let offered = match known.variable(topic, policy.mapping()) {
                Some(topic) => Err(GraphError::IsVariable { topic }),
                None => known.offer(graph, (topic, target), with),
            };
            match offered {
                Ok(bound) => {
                    left -= 1;
                    events.extend(bound);
                }
                Err(why) => {
                    let name = &known.described.name;
                    policy.told.once(&topic.to_string(), "no action", || {
                        format!("the action {name} is not offered: {why}")
                    });
                    known.state = State::Refused;
                }
            }
        }
        events
    }

    /// Checks actions again, because definitions or the mapping may have changed.
    pub(super) fn look_again<G: ActionGraph>(&mut self, graph: &mut G, policy: &Policy) {
        for (topic, known) in &mut self.known {
            let again = match &known.state {
                State::Waiting | State::Refused => true,
                // A file that is temporarily unreadable changes nothing.
                State::Offered(offered) => {
                    let now = graph.action_calls(offered.calls.goal().name());
                    offered.target != Target::of(*topic, policy)
                        || now.is_ok_and(|now| !is_same(&now, &offered.calls))
                }
            };
            if again {
                known.state = State::Waiting;
            }
        }
    }

    /// Returns whether the values of a topic belong to an action. A variable of the mapping does
    /// not, because any publisher can claim it for an action.
    pub(super) fn takes(&self, policy: &Policy, topic: TopicId) -> bool {
        self.values.contains_key(&topic) && policy.mapping().variable(topic).is_none()
    }

    /// Passes feedback to the task of its action.
    pub(super) fn publish(&self, value: &LocalDelivery) -> Result<(), &'static str> {
        let known = self.values.get(&value.topic);
        let known = known.and_then(|of| Some((*of, self.known.get(of)?)));
        let Some((of, known)) = known else {
            return Ok(());
        };
        match &known.state {
            State::Offered(offered) if beside(of, known.family.feedback) == Some(value.topic) => {
                let told = offered.feedback.try_send(value.payload.clone());
                told.map_err(|_| "action events are queued too long")
            }
            // Statuses of goals are not forwarded: the server in this graph reports the statuses of
            // its own goals.
            State::Offered(_) | State::Waiting | State::Refused => Ok(()),
        }
    }
}

/// Parameters of a facade: the function that returns an [`Asker`], the channel for reports, the
/// timeout of a lost executor, and the task set.
type With<'w, F> = (
    &'w F,
    &'w mpsc::Sender<PortEvent>,
    Duration,
    &'w mut JoinSet<()>,
);

impl Known {
    /// Returns the value of the family that the mapping declares as a variable, if any.
    fn variable(&self, topic: TopicId, mapping: &Mapping) -> Option<TopicId> {
        let values = [self.family.feedback, self.family.status];
        let mut values = values.into_iter().filter_map(|id| beside(topic, id));
        values.find(|value| mapping.variable(*value).is_some())
    }

    /// Starts to serve the action. Reports the types of its calls and values.
    fn offer<G: ActionGraph, F: Fn(TopicId) -> Asker>(
        &mut self,
        graph: &mut G,
        (topic, target): (TopicId, Target),
        (asker, report, silence, tasks): With<'_, F>,
    ) -> Result<Vec<PortEvent>, GraphError> {
        let said = (target.type_name.as_ref(), &*target.goal);
        let calls = action_type(&self.described, said, |name| graph.action_calls(name))?;
        let of = |id| beside(topic, id).ok_or(GraphError::NoFamily);
        let (cancel, result) = (of(self.family.cancel)?, of(self.family.result)?);
        let (feedback, status) = (of(self.family.feedback)?, of(self.family.status)?);
        let type_name = calls.goal().name().clone();
        let server = graph.serve_action(&target.name, &type_name)?;
        let (gone, is_gone) = watch::channel(None);
        let (tell, values) = mpsc::channel(MOST_VALUES);
        let facade = Facade {
            asks: Asks {
                wire: G::WIRE,
                goal: asker(topic).within(target.timeout),
                cancel: asker(cancel),
                result: asker(result),
                silence,
                gone: is_gone,
            },
            server,
            values,
            feedback,
            report: report.clone(),
        };
        let task = tasks.spawn(facade.run());
        let (action, action_type) = (&target.name, &type_name);
        let name = &self.described.name;
        info!(%topic, name, action, %action_type, "offered the action to ROS");
        let call = |topic, service_type: &Arc<_>, map: &Arc<CallMap>| PortEvent::CallBound {
            topic,
            service_type: Arc::clone(service_type),
            map: Arc::clone(map),
        };
        let value = |topic, message_type: &Arc<_>, (overflow, map)| PortEvent::BoundAs {
            topic,
            message_type: Arc::clone(message_type),
            note: ValueNote {
                name: String::new(),
                about: String::new(),
                overflow,
                map,
            },
        };
        let by_name = Arc::default();
        let outcome = match G::WIRE {
            Wire::Ros1 => calls.result(),
            Wire::Cdr => calls.outcome(),
        };
        let events = vec![
            call(topic, calls.goal(), &target.goal),
            call(cancel, calls.cancel(), &by_name),
            call(result, outcome, &target.result),
            value(
                feedback,
                calls.feedback(),
                (EVENTS, target.feedback.clone()),
            ),
            value(
                status,
                calls.status(),
                (Overflow::KeepLatest, FieldMap::default()),
            ),
        ];
        self.state = State::Offered(Box::new(Offered {
            target,
            calls,
            feedback: tell,
            gone,
            task,
        }));
        Ok(events)
    }

    /// Returns the events that unbind the calls and values of the action.
    fn unbind(&self, topic: TopicId) -> Vec<PortEvent> {
        let of = |id| beside(topic, id);
        let calls = [Some(topic), of(self.family.cancel), of(self.family.result)];
        let calls = calls.into_iter().flatten();
        let values = [self.family.feedback, self.family.status];
        let values = values.into_iter().filter_map(of);
        calls
            .map(|topic| PortEvent::CallUnbound { topic })
            .chain(values.map(|topic| PortEvent::Unbound { topic }))
            .collect()
    }
}

/// The maximal number of known actions of other spaces: any publisher in the space can announce
/// actions.
const MOST_KNOWN: usize = 1024;
/// The maximal number of actions served here.
const MOST_OFFERED: usize = 256;
/// The maximal number of queued feedback messages of one action.
const MOST_VALUES: usize = 256;
/// How long a server stays after its goals were given up, so that it can report their ends.
const LEFT_AFTER: Duration = Duration::from_secs(2);
/// Time limit for the decision about a goal, unless the mapping sets it.
const ANSWERED_WITHIN: Duration = Duration::from_secs(30);
