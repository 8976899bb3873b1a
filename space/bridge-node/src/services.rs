//! Services of the graph as values of the space: calls caused by received values, calls made
//! periodically, and the values made of their responses.
//!
//! Each variable that calls and each polled service has a separate task, so that no call delays
//! another call or the port.

mod caller;
mod pending;

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use bridge_core::Handover;
use bytes::Bytes;
use mappings::{Mapping, Overflow, ServiceRole, SpaceId, TopicId, Trigger, Variable};
use messages::{
    Literal, MessagePlan, MessageType, NoFields, Selection, ServiceType, TypeName, Wire,
};
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, JoinSet};
use tracing::warn;
use uadp::{BuiltinType, Timestamp};

pub use self::caller::{CallFault, MayHaveRun, ServiceCall, ServiceOutcome};

use self::caller::{CallCause, ServiceCallTask};
use self::pending::Pending;
use crate::{GraphError, PortEvent};

/// A ROS graph with services, as implemented by a port.
pub trait ServiceGraph {
    /// The client of a service.
    type Client: ServiceCall;

    /// The wire format of its messages.
    const WIRE: Wire;

    /// Returns the service type of a name.
    ///
    /// # Errors
    /// The reason why there is no such type.
    fn service_type(&mut self, name: &TypeName) -> Result<Arc<ServiceType>, GraphError>;

    /// Returns the message type that carries one value of a type and nothing else; `None` if there
    /// is no such message type.
    ///
    /// # Errors
    /// The reason why the definition of the message type is not known.
    fn carrier(
        &mut self,
        builtin: BuiltinType,
        array: bool,
    ) -> Result<Option<Arc<MessageType>>, GraphError>;

    /// Creates a client of a service with a timeout for each call.
    ///
    /// # Errors
    /// The reason why the client cannot be created.
    fn client(
        &mut self,
        service: &str,
        service_type: &ServiceType,
        timeout: Duration,
    ) -> Result<Self::Client, GraphError>;
}

/// The service calls of a bridge.
#[derive(Debug)]
pub struct BridgeServiceCalls {
    callers: HashMap<TopicId, Callee>,
    /// The values that are made of the responses.
    takers: HashMap<CallCause, Vec<TopicId>>,
    /// Sources with an answering service: for a poll, the last call was answered.
    answering: HashSet<CallCause>,
    outcomes: mpsc::Receiver<ServiceOutcome>,
    report: mpsc::Sender<ServiceOutcome>,
    polls: Vec<Polled>,
    /// The number of the next poll.
    next_poll: usize,
    tasks: JoinSet<()>,
    /// The types of the called services: definitions may have changed when a mapping is read again.
    types: HashMap<TypeName, Arc<ServiceType>>,
}

/// The service that the values of one variable call.
#[derive(Debug)]
struct Callee {
    pending: Arc<Pending>,
    /// The request and its trigger, if the request does not depend on the value. The trigger is
    /// the only value that calls; without a trigger, every value calls.
    constant: Option<(Bytes, Option<Vec<u8>>)>,
    task: AbortHandle,
}

/// The service of a binding.
struct Target<'m> {
    service: &'m str,
    service_type: Arc<ServiceType>,
    timeout: Duration,
}

/// A service that is called periodically, for all values that are made of its responses.
#[derive(Debug)]
struct Polled {
    of: usize,
    /// The binding for which the poll was started. Its selection may differ from the selections of
    /// other bindings of the same poll.
    role: ServiceRole,
    task: AbortHandle,
}

impl Polled {
    /// Returns whether another binding can use the same calls.
    fn serves(&self, other: &ServiceRole) -> bool {
        let calls = |role: &ServiceRole| match role {
            ServiceRole::Poll {
                service,
                service_type,
                request,
                every,
                timeout,
                ..
            } => Some((
                service.clone(),
                service_type.clone(),
                request.clone(),
                *every,
                *timeout,
            )),
            ServiceRole::Call { .. } | ServiceRole::Answer { .. } => None,
        };
        calls(&self.role) == calls(other)
    }
}

impl BridgeServiceCalls {
    /// Starts the service calls of the mapping. Reports the types of the values. A binding that
    /// cannot be served is logged.
    pub fn start(
        graph: &mut impl ServiceGraph,
        own: SpaceId,
        mapping: &Mapping,
    ) -> (Self, Vec<PortEvent>) {
        // A full queue of outcomes delays the next calls, so that no more outcomes are queued.
        let (report, outcomes) = mpsc::channel(64);
        let mut services = Self {
            callers: HashMap::new(),
            takers: HashMap::new(),
            answering: HashSet::new(),
            outcomes,
            report,
            polls: Vec::new(),
            next_poll: 0,
            tasks: JoinSet::new(),
            types: HashMap::new(),
        };
        let events = services.reload(graph, own, (&Mapping::default(), mapping));
        (services, events)
    }

    /// Returns the known types of the services that the mapping calls. A type stays as it was
    /// while its file is temporarily unreadable.
    fn called_types(
        &self,
        graph: &mut impl ServiceGraph,
        own: SpaceId,
        mapping: &Mapping,
    ) -> HashMap<TypeName, Arc<ServiceType>> {
        let mut types = HashMap::new();
        for (variable, _) in mapping.services(own) {
            let Some(name) = called_type(mapping, variable.topic) else {
                continue;
            };
            if types.contains_key(name) {
                continue;
            }
            let found = graph.service_type(name).ok();
            if let Some(found) = found.or_else(|| self.types.get(name).cloned()) {
                types.insert(name.clone(), found);
            }
        }
        types
    }

    /// Stops the service calls of `before` only and starts the service calls of `after` only; calls
    /// that are the same in both mappings continue. Reports the values that are given up, then the
    /// types of the new values. A binding that cannot be served is logged.
    pub fn reload(
        &mut self,
        graph: &mut impl ServiceGraph,
        own: SpaceId,
        (before, after): (&Mapping, &Mapping),
    ) -> Vec<PortEvent> {
        // Reap the tasks that were aborted earlier.
        while self.tasks.try_join_next().is_some() {}
        let types = self.called_types(graph, own, after);
        let alike = |name: &TypeName| match (self.types.get(name), types.get(name)) {
            (Some(was), Some(is)) => was.is_same(is),
            (None, None) => true,
            (Some(_), None) | (None, Some(_)) => false,
        };
        let defined = |topic: TopicId| called_type(after, topic).is_none_or(alike);
        let kept: HashSet<TopicId> = after
            .services(own)
            .map(|(variable, _)| variable.topic)
            .filter(|topic| is_same(*topic, (before, after)) && defined(*topic))
            .collect();
        let kept = |topic: TopicId| kept.contains(&topic);
        self.types = types;
        let mut events = Vec::new();
        for (variable, binding) in before.services(own) {
            if !kept(variable.topic) {
                self.close(variable.topic, &binding.role);
                let topic = variable.topic;
                events.push(PortEvent::Unbound { topic });
            }
        }
        for (variable, binding) in after.services(own) {
            if !kept(variable.topic) {
                events.extend(self.open(graph, after, variable, &binding.role));
            }
        }
        events
    }

    fn open(
        &mut self,
        graph: &mut impl ServiceGraph,
        mapping: &Mapping,
        variable: &Variable,
        role: &ServiceRole,
    ) -> Vec<PortEvent> {
        let bound = match role {
            ServiceRole::Call { .. } => self.open_call(graph, variable, role),
            ServiceRole::Answer { of, selection } => {
                self.take_answers(graph, mapping, variable, (*of, selection))
            }
            ServiceRole::Poll { .. } => self.open_poll(graph, variable, role),
        };
        let topic = variable.topic;
        match bound {
            Ok(event) => {
                let mut takers = self.takers.iter();
                let answered = takers
                    .any(|(of, takers)| takers.contains(&topic) && self.answering.contains(of));
                let live = answered.then_some(PortEvent::Live { topic, live: true });
                std::iter::once(event).chain(live).collect()
            }
            Err(error) => {
                warn!(%topic, name = variable.name, "calls no service for this value: {error}");
                Vec::new()
            }
        }
    }

    /// Ends the calls of a value, or the values made of responses. A running call is aborted.
    fn close(&mut self, topic: TopicId, role: &ServiceRole) {
        match role {
            ServiceRole::Call { .. } => {
                if let Some(callee) = self.callers.remove(&topic) {
                    callee.task.abort();
                }
                self.takers.remove(&CallCause::Value(topic));
                self.answering.remove(&CallCause::Value(topic));
            }
            ServiceRole::Answer { .. } | ServiceRole::Poll { .. } => {
                self.takers.retain(|_, takers| {
                    takers.retain(|taker| *taker != topic);
                    !takers.is_empty()
                });
                let takers = &self.takers;
                for poll in self
                    .polls
                    .extract_if(.., |poll| !takers.contains_key(&CallCause::Poll(poll.of)))
                {
                    poll.task.abort();
                    self.answering.remove(&CallCause::Poll(poll.of));
                }
            }
        }
    }

    fn open_call<G: ServiceGraph>(
        &mut self,
        graph: &mut G,
        variable: &Variable,
        role: &ServiceRole,
    ) -> Result<PortEvent, GraphError> {
        let ServiceRole::Call {
            service,
            service_type,
            request,
            when,
            timeout,
        } = role
        else {
            return Err(GraphError::OtherRole { expected: "call" });
        };
        let service_type = graph.service_type(service_type)?;
        let message_type = service_type.request();
        let (bound, constant) = match request {
            Selection::Template { fields, .. } if fields.is_empty() => {
                let request = constant::<G>(message_type, request)?;
                let carrier = carrier(graph, variable)?;
                let value = match when {
                    Trigger::Any => None,
                    Trigger::Equals(text) => Some(constant::<G>(&carrier, &only(text))?.to_vec()),
                };
                let event = PortEvent::Bound {
                    topic: variable.topic,
                    message_type: carrier,
                    selection: Selection::Whole,
                };
                (event, Some((request, value)))
            }
            Selection::Whole
            | Selection::Field(_)
            | Selection::Fields(_)
            | Selection::Structure(_)
            | Selection::Value { .. }
            | Selection::Template { .. }
            | Selection::Bytes => {
                let event = PortEvent::Bound {
                    topic: variable.topic,
                    message_type: Arc::clone(message_type),
                    selection: request.clone(),
                };
                (event, None)
            }
        };
        let target = Target {
            service,
            service_type: Arc::clone(&service_type),
            timeout: *timeout,
        };
        let of = CallCause::Value(variable.topic);
        let caller = self.caller(graph, &target, of)?;
        let pending = Arc::new(Pending::new(variable.overflow));
        let insist = variable.overflow == Overflow::KeepLatest;
        let task = self.tasks.spawn(caller.serve(Arc::clone(&pending), insist));
        let callee = Callee {
            pending,
            constant,
            task,
        };
        self.callers.insert(variable.topic, callee);
        Ok(bound)
    }

    fn take_answers(
        &mut self,
        graph: &mut impl ServiceGraph,
        mapping: &Mapping,
        variable: &Variable,
        (of, selection): (TopicId, &Selection),
    ) -> Result<PortEvent, GraphError> {
        let role = mapping
            .variable(of)
            .and_then(|of| of.service.as_ref())
            .map(|binding| &binding.role);
        let Some(ServiceRole::Call { service_type, .. }) = role else {
            return Err(GraphError::CallsNothing { of });
        };
        let service_type = graph.service_type(service_type)?;
        let takers = self.takers.entry(CallCause::Value(of)).or_default();
        takers.push(variable.topic);
        Ok(bound(variable.topic, &service_type, selection))
    }

    fn open_poll<G: ServiceGraph>(
        &mut self,
        graph: &mut G,
        variable: &Variable,
        role: &ServiceRole,
    ) -> Result<PortEvent, GraphError> {
        let ServiceRole::Poll {
            service,
            service_type: name,
            request,
            selection,
            every,
            timeout,
        } = role
        else {
            return Err(GraphError::OtherRole { expected: "poll" });
        };
        let service_type = graph.service_type(name)?;
        let known = self.polls.iter().find(|known| known.serves(role));
        let number = known.map_or(self.next_poll, |known| known.of);
        let of = CallCause::Poll(number);
        if known.is_none() {
            let request = constant::<G>(service_type.request(), request)?;
            let target = Target {
                service,
                service_type: Arc::clone(&service_type),
                timeout: *timeout,
            };
            let caller = self.caller(graph, &target, of)?;
            self.next_poll += 1;
            let polled = Polled {
                of: number,
                role: role.clone(),
                task: self.tasks.spawn(caller.poll(request, *every)),
            };
            self.polls.push(polled);
        }
        self.takers.entry(of).or_default().push(variable.topic);
        Ok(bound(variable.topic, &service_type, selection))
    }

    fn caller<G: ServiceGraph>(
        &self,
        graph: &mut G,
        target: &Target<'_>,
        of: CallCause,
    ) -> Result<ServiceCallTask<G::Client>, GraphError> {
        let client = graph.client(target.service, &target.service_type, target.timeout)?;
        Ok(ServiceCallTask::new(client, of, self.report.clone()))
    }

    /// Returns whether the values of a topic are for a service.
    #[must_use]
    pub fn takes(&self, topic: TopicId) -> bool {
        self.callers.contains_key(&topic)
    }

    /// Returns the handover of the newest value of a topic that calls a service; `None` for other
    /// topics.
    #[must_use]
    pub fn handover(&self, topic: TopicId) -> Option<Handover> {
        let callee = self.callers.get(&topic)?;
        Some(callee.pending.handover())
    }

    /// Queues a value for the service of its topic. Returns the number of older values that were
    /// dropped, or `None` if the topic has no service.
    #[must_use]
    pub fn hand_over(&self, topic: TopicId, value: &Bytes) -> Option<u64> {
        let callee = self.callers.get(&topic)?;
        let request = match &callee.constant {
            None => Some(value.clone()),
            // The value calls nothing. In a queue that keeps the latest value, it replaces a value
            // that would still call.
            Some((_, Some(wanted))) if wanted != value => None,
            Some((request, _)) => Some(request.clone()),
        };
        Some(callee.pending.push(request))
    }

    /// Returns the outcome of the next call. Cancel-safe.
    pub async fn recv(&mut self) -> ServiceOutcome {
        match self.outcomes.recv().await {
            Some(outcome) => outcome,
            // Never `None`, because `self` holds a sender.
            None => std::future::pending().await,
        }
    }

    /// Polls for the outcome of [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv(&mut self, cx: &mut Context<'_>) -> Poll<ServiceOutcome> {
        match self.outcomes.poll_recv(cx) {
            Poll::Ready(Some(outcome)) => Poll::Ready(outcome),
            // Never `None`, because `self` holds a sender.
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }

    /// Returns the events that the outcome of a call causes for the values made of it.
    #[must_use]
    pub fn ended(&mut self, outcome: ServiceOutcome, received: Timestamp) -> Vec<PortEvent> {
        let ServiceOutcome { of, result } = outcome;
        let takers = self.takers.get(&of).map_or(&[][..], Vec::as_slice);
        let mut events = Vec::new();
        let mut live = |live: bool| {
            events.extend(takers.iter().map(|topic| PortEvent::Live {
                topic: *topic,
                live,
            }));
        };
        match result {
            Ok(answer) => {
                if self.answering.insert(of) {
                    live(true);
                }
                events.extend(takers.iter().map(|topic| PortEvent::Sample {
                    topic: *topic,
                    payload: answer.clone(),
                    received,
                    latched_by: None,
                }));
            }
            Err(fault) => {
                let failed = |topic: &TopicId| PortEvent::CallFailed {
                    topic: *topic,
                    detail: fault.to_string(),
                };
                match of {
                    // The last response of the service stays valid.
                    CallCause::Value(topic) => events.push(failed(&topic)),
                    CallCause::Poll(_) => {
                        if self.answering.remove(&of) {
                            live(false);
                        }
                        events.extend(takers.iter().map(failed));
                    }
                }
            }
        }
        events
    }
}

/// Returns whether a value has the same service binding in both mappings.
fn is_same(topic: TopicId, (before, after): (&Mapping, &Mapping)) -> bool {
    let tie = |mapping: &Mapping| {
        let variable = mapping.variable(topic)?;
        let service = variable.service.clone()?;
        Some((service, variable.value_type, variable.overflow))
    };
    let (was, is) = (tie(before), tie(after));
    let of = match is.as_ref().map(|(service, ..)| &service.role) {
        Some(ServiceRole::Answer { of, .. }) => Some(*of),
        Some(ServiceRole::Call { .. } | ServiceRole::Poll { .. }) | None => None,
    };
    was.is_some() && was == is && of.is_none_or(|of| is_same(of, (before, after)))
}

/// Returns the type of the service that a variable is tied to.
fn called_type(mapping: &Mapping, topic: TopicId) -> Option<&TypeName> {
    match &mapping.variable(topic)?.service.as_ref()?.role {
        ServiceRole::Call { service_type, .. } | ServiceRole::Poll { service_type, .. } => {
            Some(service_type)
        }
        // The type of the call that the response belongs to. A poll or another response has no
        // responses of its own.
        ServiceRole::Answer { of, .. } => match &mapping.variable(*of)?.service.as_ref()?.role {
            ServiceRole::Call { service_type, .. } => Some(service_type),
            ServiceRole::Poll { .. } | ServiceRole::Answer { .. } => None,
        },
    }
}

fn bound(topic: TopicId, service_type: &ServiceType, selection: &Selection) -> PortEvent {
    PortEvent::Bound {
        topic,
        message_type: Arc::clone(service_type.response()),
        selection: selection.clone(),
    }
}

/// Returns the message type of a value that is only compared, not sent.
fn carrier(
    graph: &mut impl ServiceGraph,
    variable: &Variable,
) -> Result<Arc<MessageType>, GraphError> {
    let (builtin, array) = variable.value_type.ok_or(GraphError::NoValueType)?;
    graph
        .carrier(builtin, array)?
        .ok_or(GraphError::NotComparable { builtin })
}

/// Encodes the message of a template without values.
fn constant<G: ServiceGraph>(
    message_type: &Arc<MessageType>,
    template: &Selection,
) -> Result<Bytes, GraphError> {
    let plan = MessagePlan::compile(message_type, template, G::WIRE)?;
    let mut bytes = Vec::new();
    plan.write(&mut NoFields, &mut bytes)?;
    Ok(bytes.into())
}

/// Returns a std_msgs template with `text` as its `data`.
fn only(text: &str) -> Selection {
    Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::from([("data".to_owned(), Literal::One(text.to_owned()))]),
    }
}
