//! Calls of other spaces, offered as services of a ROS graph: under their names (`/ua_0_7_105`), or
//! as the mapping sets it.
//!
//! The module [`policy`](crate::policy) chooses the type, and the graph offers the service.
//! Requests go to the Router as [`PortEvent::Ask`], and the responses come back through
//! [`answered`](SpaceCalls::answered).

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use bridge_core::{AskErrorKind, AskId, CallDescription, CallMap, CallResponse, CallRole};
use bytes::Bytes;
use mappings::{CallKind, TopicId};
use messages::{
    Literal, MessagePlan, MessageType, NoFields, Selection, ServiceType, TypeName, Wire,
};
use tokio::sync::{mpsc, oneshot};
use tracing::{debug, info};

use crate::policy::{Policy, call_type};
use crate::{GraphError, PortEvent, ServiceGraph};

/// A ROS graph that can offer services.
pub trait CallGraph: ServiceGraph {
    /// An offered service, which is withdrawn when this is dropped.
    type Server: Send;

    /// Whether a caller can receive the failure of its call, with the reason.
    const TELLS_FAULTS: bool;

    /// Offers a service: each request goes to `asker`.
    ///
    /// # Errors
    /// The reason why the service cannot be offered.
    fn offer(
        &mut self,
        service: &str,
        service_type: &Arc<ServiceType>,
        asker: Asker,
    ) -> Result<Self::Server, GraphError>;
}

/// The calls of other spaces that a port knows, and the open requests of its graph.
#[derive(Debug)]
pub struct SpaceCalls<S> {
    known: BTreeMap<TopicId, Known<S>>,
    /// Services of lost calls, with the time of the loss: callers that wait for a response still
    /// receive the failure.
    leaving: Vec<(Instant, TopicId, S)>,
    /// The calls that clients look for.
    wanted: BTreeSet<TopicId>,
    /// The open requests.
    asked: HashMap<AskId, Asked>,
    said: mpsc::Receiver<Said>,
    say: mpsc::Sender<Said>,
    next: Arc<AtomicU64>,
}

#[derive(Debug)]
struct Known<S> {
    described: Arc<CallDescription>,
    state: State<S>,
}

#[derive(Debug)]
enum State<S> {
    /// To be offered later.
    Waiting,
    /// Not offered: its service type is unknown here, or the limit is reached.
    Refused,
    Offered {
        /// The name, type and field maps under which the call is offered.
        target: Target,
        service_type: Arc<ServiceType>,
        server: S,
    },
}

/// Name, type and field maps under which a call is offered.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Target {
    /// Name of the service.
    name: String,
    /// The type that the mapping sets, if any.
    type_name: Option<TypeName>,
    map: Arc<CallMap>,
    timeout: Duration,
}

impl Target {
    /// Returns the target of the mapping; without it, the name of the topic.
    fn of(topic: TopicId, policy: &Policy) -> Self {
        let call = policy.mapping().call(topic);
        let timeout = call.map_or(ANSWERED_WITHIN, |call| call.timeout);
        match call.and_then(|call| call.binding(policy.own())) {
            Some(binding) => Self {
                name: binding.target.name.clone(),
                type_name: Some(binding.target.type_name.clone()),
                map: Arc::new(CallMap {
                    request: binding.request.clone(),
                    response: binding.response.clone(),
                }),
                timeout,
            },
            None => Self {
                name: format!("/{topic}"),
                type_name: None,
                map: Arc::default(),
                timeout,
            },
        }
    }
}

#[derive(Debug)]
struct Asked {
    topic: TopicId,
    answer: oneshot::Sender<Result<Bytes, AskFault>>,
    /// The type of a response that reports failure, if the caller cannot receive it in any other
    /// way.
    says_no: Option<Arc<MessageType>>,
}

/// Sends requests to one call of another space, on behalf of the callers of its service.
#[derive(Debug, Clone)]
pub struct Asker {
    topic: TopicId,
    /// The timeout of a request for a part of an action; `None` for a service.
    timeout: Option<Duration>,
    say: mpsc::Sender<Said>,
    next: Arc<AtomicU64>,
}

/// A message of the services of a port to the port.
#[derive(Debug)]
enum Said {
    Ask {
        ask: AskId,
        topic: TopicId,
        request: Bytes,
        timeout: Option<Duration>,
        answer: oneshot::Sender<Result<Bytes, AskFault>>,
    },
    GivenUp(AskId),
}

/// Reports that a caller does not wait for a response any more, unless the response has arrived.
/// Its place in the queue is reserved together with the place of the request.
struct GiveUp {
    ask: AskId,
    place: Option<mpsc::OwnedPermit<Said>>,
}

impl Drop for GiveUp {
    fn drop(&mut self) {
        if let Some(place) = self.place.take() {
            drop(place.send(Said::GivenUp(self.ask)));
        }
    }
}

/// The reason why a request has no response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct AskFault {
    /// Whether the request was executed, as far as that is known.
    pub(crate) kind: AskErrorKind,
    /// Text for the user.
    pub(crate) text: String,
}

impl Asker {
    /// Sets the timeout of requests.
    #[must_use]
    pub fn within(self, timeout: Duration) -> Self {
        let timeout = Some(timeout);
        Self { timeout, ..self }
    }

    /// Sends a request in the wire format of the ROS; the response has the same format. Dropping
    /// the future gives up the request. Ends in bounded time, as every call of the space does.
    ///
    /// # Errors
    /// The reason why there is no response, as text for the user.
    pub fn ask(
        &self,
        request: Bytes,
    ) -> impl Future<Output = Result<Bytes, String>> + Send + use<> {
        let answer = self.ask_for(request);
        async move { answer.await.map_err(|fault| fault.text) }
    }

    /// Sends a request as [`ask`](Self::ask) does. The error also holds whether the request was
    /// executed.
    pub(crate) fn ask_for(
        &self,
        request: Bytes,
    ) -> impl Future<Output = Result<Bytes, AskFault>> + Send + use<> {
        let asked = self.send(request);
        async move {
            let (mut give_up, answer) = asked?;
            let answer = answer.await;
            give_up.place = None;
            answer.unwrap_or_else(|_| {
                Err(AskFault {
                    kind: AskErrorKind::Unknown,
                    text: "the call was withdrawn".to_owned(),
                })
            })
        }
    }

    fn send(
        &self,
        request: Bytes,
    ) -> Result<(GiveUp, oneshot::Receiver<Result<Bytes, AskFault>>), AskFault> {
        let ask = AskId(self.next.fetch_add(1, Ordering::Relaxed));
        let place = || {
            let place = self.say.clone().try_reserve_owned();
            place.map_err(|_| AskFault {
                kind: AskErrorKind::Refused,
                text: format!("more than {MOST_ASKED} calls of the space are in progress"),
            })
        };
        let (question, later) = (place()?, place()?);
        let (answer, answered) = oneshot::channel();
        let (topic, timeout) = (self.topic, self.timeout);
        drop(question.send(Said::Ask {
            ask,
            topic,
            request,
            timeout,
            answer,
        }));
        let place = Some(later);
        Ok((GiveUp { ask, place }, answered))
    }
}

impl<S: Send> Default for SpaceCalls<S> {
    fn default() -> Self {
        let (say, said) = mpsc::channel(MOST_ASKED);
        Self {
            known: BTreeMap::new(),
            leaving: Vec::new(),
            wanted: BTreeSet::new(),
            asked: HashMap::new(),
            said,
            say,
            next: Arc::default(),
        }
    }
}

impl<S: Send> SpaceCalls<S> {
    /// Adds or updates a call of another space. It is offered by
    /// [`offer_waiting`](Self::offer_waiting).
    pub fn known(&mut self, topic: TopicId, described: Arc<CallDescription>) {
        match self.known.get_mut(&topic) {
            Some(known) if known.described == described => {}
            Some(known) => {
                known.described = described;
                known.state = State::Waiting;
            }
            None => {
                let state = State::Waiting;
                self.known.insert(topic, Known { described, state });
            }
        }
    }

    /// Removes a call. Its service is withdrawn, a little later if callers wait for a response.
    pub fn gone(&mut self, topic: TopicId, now: Instant) {
        let Some(known) = self.known.remove(&topic) else {
            return;
        };
        if let State::Offered { server, .. } = known.state {
            let name = &known.described.name;
            info!(%topic, name, "the program that executes the call withdrew it: its service is closed");
            if self.asked.values().any(|asked| asked.topic == topic) {
                self.leaving.push((now, topic, server));
            }
            // Refused calls can take the free place.
            if self.known.len() >= MOST_CALLS {
                self.wait_anew();
            }
        }
    }

    /// Withdraws the services of lost calls, once all waiting callers have received the failure.
    pub fn tidy(&mut self, now: Instant) {
        let asked = &mut self.asked;
        self.leaving.retain(|(since, topic, _)| {
            let age = now.duration_since(*since);
            if age >= ANSWERED_AFTER {
                for (_, asked) in asked.extract_if(|_, asked| asked.topic == *topic) {
                    asked.fail(AskErrorKind::Unknown, GONE);
                }
            }
            age < LEFT_AFTER
        });
    }

    /// Lets refused calls wait to be offered again.
    fn wait_anew(&mut self) {
        for known in self.known.values_mut() {
            if let State::Refused = known.state {
                known.state = State::Waiting;
            }
        }
    }

    /// Checks calls again, because definitions or the mapping may have changed: calls that are not
    /// offered, and calls with a changed type or target.
    pub fn look_again<G: CallGraph<Server = S>>(&mut self, graph: &mut G, policy: &Policy) {
        for (topic, known) in &mut self.known {
            let again = match &known.state {
                State::Waiting | State::Refused => true,
                // A file that is temporarily unreadable changes nothing.
                State::Offered {
                    target,
                    service_type,
                    ..
                } => {
                    let now = graph.service_type(service_type.name());
                    *target != Target::of(*topic, policy)
                        || now.is_ok_and(|now| !now.is_same(service_type))
                }
            };
            if again {
                known.state = State::Waiting;
            }
        }
    }

    /// Returns the offered services.
    pub fn servers(&self) -> impl Iterator<Item = &S> {
        let offered = self.known.values().filter_map(|known| match &known.state {
            State::Offered { server, .. } => Some(server),
            State::Waiting | State::Refused => None,
        });
        offered.chain(self.leaving.iter().map(|(_, _, server)| server))
    }

    /// Returns the known calls that have a name in this space by the mapping, with the name.
    #[must_use]
    pub fn chosen(&self, policy: &Policy) -> Vec<(TopicId, String)> {
        let mapped = policy.mapping().asked_in(policy.own());
        let known = mapped.filter(|(call, _)| {
            call.kind == CallKind::Service && self.known.contains_key(&call.topic)
        });
        known
            .map(|(call, binding)| (call.topic, binding.target.name.clone()))
            .collect()
    }

    /// Returns whether any call waits to be offered.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        let mut known = self.known.values();
        known.any(|known| matches!(known.state, State::Waiting))
    }

    /// Withdraws the services of the calls that are left to other bridges, by their names in this
    /// space. The calls wait to be offered again.
    pub fn leave(&mut self, to_others: impl Fn(TopicId, &str) -> bool) {
        for (topic, known) in &mut self.known {
            if let State::Offered { target, .. } = &known.state
                && to_others(*topic, &target.name)
            {
                known.state = State::Waiting;
            }
        }
    }

    /// Requests the calls of other spaces that the mapping names and that are unknown here.
    pub fn ask_for_mapped(&self, policy: &Policy) -> Vec<PortEvent> {
        let mapped = policy.mapping().asked_in(policy.own());
        let unknown = mapped.filter(|(call, _)| !self.known.contains_key(&call.topic));
        // The topics of an action behind its calls are values.
        let topics = unknown.flat_map(|(call, _)| call.topics().take(CALLS_OF_ACTION));
        topics
            .map(|topic| PortEvent::CallWanted { topic })
            .collect()
    }

    /// Requests the calls that clients in this graph look for, once for as long as the clients
    /// look.
    pub fn looked_for(&mut self, mut topics: BTreeSet<TopicId>) -> Vec<PortEvent> {
        while topics.len() > MOST_CALLS {
            topics.pop_last();
        }
        let known = &self.known;
        let new = topics.difference(&self.wanted);
        let unknown = new.filter(|topic| !known.contains_key(topic));
        let events = unknown.map(|topic| PortEvent::CallWanted { topic: *topic });
        let events = events.collect();
        self.wanted = topics;
        events
    }

    /// Offers at most `most` waiting calls that `may` be offered under their names in this space.
    /// Reports the types of their services.
    pub fn offer_waiting<G: CallGraph<Server = S>>(
        &mut self,
        graph: &mut G,
        policy: &mut Policy,
        may: impl Fn(TopicId, &str) -> bool,
        most: usize,
    ) -> Vec<PortEvent> {
        let mut left = MOST_CALLS.saturating_sub(self.servers().count());
        let waiting = self.known.iter();
        let waiting = waiting.filter(|(_, known)| matches!(known.state, State::Waiting));
        let waiting = waiting.map(|(topic, _)| (*topic, Target::of(*topic, policy)));
        let waiting = waiting.filter(|(topic, target)| may(*topic, &target.name));
        let waiting: Vec<(TopicId, Target)> = waiting.take(most).collect();
        let mut events = Vec::new();
        for (topic, target) in waiting {
            let Some(known) = self.known.get_mut(&topic) else {
                continue;
            };
            if known.described.role != CallRole::Call {
                // A part of an action is not a service by itself.
                known.state = State::Refused;
                continue;
            }
            if left == 0 {
                known.state = State::Refused;
                policy.told.once("", "too many calls", || {
                    format!(
                        "more than {MOST_CALLS} calls of the space: the bridge does not offer the \
                             others as services"
                    )
                });
                continue;
            }
            // A name has at most a single service.
            self.leaving.retain(|(_, left, _)| *left != topic);
            let asker = Asker {
                topic,
                timeout: None,
                say: self.say.clone(),
                next: Arc::clone(&self.next),
            };
            let said = (target.type_name.as_ref(), &*target.map);
            let service_type = call_type(&known.described, said, |name| graph.service_type(name));
            let offered = service_type.and_then(|service_type| {
                let server = graph.offer(&target.name, &service_type, asker)?;
                Ok((service_type, server))
            });
            known.state = match offered {
                Ok((service_type, server)) => {
                    let (service, service_type_name) = (&target.name, service_type.name());
                    let name = &known.described.name;
                    info!(%topic, name, service, service_type = %service_type_name, "offered the call to ROS as a service");
                    left -= 1;
                    events.push(PortEvent::CallBound {
                        topic,
                        service_type: Arc::clone(&service_type),
                        map: Arc::clone(&target.map),
                    });
                    State::Offered {
                        target,
                        service_type,
                        server,
                    }
                }
                Err(why) => {
                    policy.told.once(&topic.to_string(), "no service", || {
                        let name = &known.described.name;
                        format!("the call {name} is not offered as a service: {why}")
                    });
                    State::Refused
                }
            };
        }
        events
    }

    /// Returns the next request of the services. Cancel-safe.
    pub async fn recv<G: CallGraph<Server = S>>(&mut self) -> PortEvent {
        std::future::poll_fn(|cx| self.poll_recv::<G>(cx)).await
    }

    /// Polls for the events of [`recv`](Self::recv), for ports that poll.
    pub fn poll_recv<G: CallGraph<Server = S>>(&mut self, cx: &mut Context<'_>) -> Poll<PortEvent> {
        loop {
            let said = match self.said.poll_recv(cx) {
                Poll::Ready(Some(said)) => said,
                // Never `None`, because `self` holds a sender.
                Poll::Ready(None) | Poll::Pending => return Poll::Pending,
            };
            match said {
                Said::Ask {
                    ask,
                    topic,
                    request,
                    timeout,
                    answer,
                } => {
                    // The request of a service that was withdrawn meanwhile fails when its sender
                    // is dropped.
                    let Some((timeout, says_no)) = self.how_asked::<G>(topic, timeout) else {
                        continue;
                    };
                    let asked = Asked {
                        topic,
                        answer,
                        says_no,
                    };
                    self.asked.insert(ask, asked);
                    return Poll::Ready(PortEvent::Ask {
                        topic,
                        ask,
                        request,
                        timeout,
                    });
                }
                Said::GivenUp(ask) => {
                    if self.asked.remove(&ask).is_some() {
                        return Poll::Ready(PortEvent::AskGivenUp { ask });
                    }
                }
            }
        }
    }

    /// Returns the timeout of a request, and the type of a response that reports failure, if
    /// such a type exists.
    fn how_asked<G: CallGraph<Server = S>>(
        &self,
        topic: TopicId,
        timeout: Option<Duration>,
    ) -> Option<(Duration, Option<Arc<MessageType>>)> {
        if let Some(timeout) = timeout {
            return Some((timeout, None));
        }
        match &self.known.get(&topic)?.state {
            State::Offered {
                target,
                service_type,
                ..
            } => {
                let says_no = (!G::TELLS_FAULTS).then(|| Arc::clone(service_type.response()));
                Some((target.timeout, says_no))
            }
            State::Waiting | State::Refused => None,
        }
    }

    /// Returns the [`Asker`] of a part of an action, which is not a service by itself. Set its
    /// timeout with [`within`](Asker::within).
    #[must_use]
    pub fn asker(&self, topic: TopicId) -> Asker {
        Asker {
            topic,
            timeout: Some(ANSWERED_WITHIN),
            say: self.say.clone(),
            next: Arc::clone(&self.next),
        }
    }

    /// Passes a response to its caller.
    pub fn answered(&mut self, ask: AskId, answer: CallResponse<Bytes>) {
        let Some(asked) = self.asked.remove(&ask) else {
            return;
        };
        match answer {
            Ok(bytes) => drop(asked.answer.send(Ok(bytes))),
            Err(fault) => {
                let text = match fault.kind {
                    AskErrorKind::Refused => format!("not executed: {fault}"),
                    AskErrorKind::Failed | AskErrorKind::Unknown => fault.to_string(),
                };
                asked.fail(fault.kind, &text);
            }
        }
    }
}

impl Asked {
    fn fail(self, kind: AskErrorKind, why: &str) {
        debug!(topic = %self.topic, why, "a call failed");
        let no = self.says_no.and_then(|response| no(&response, why));
        // The caller may have given up.
        let text = why.to_owned();
        drop(self.answer.send(no.ok_or(AskFault { kind, text })));
    }
}

/// Encodes the response that reports failure with the reason, for services of a ROS without call
/// errors. The response type has to consist of `success` and `message` only, as in
/// `std_srvs/Trigger`.
fn no(response: &Arc<MessageType>, why: &str) -> Option<Bytes> {
    let paths: Vec<&str> = response
        .leaves()
        .iter()
        .map(|leaf| leaf.path.as_str())
        .collect();
    if paths != ["success", "message"] {
        return None;
    }
    let one = |text: &str| Literal::One(text.to_owned());
    let template = Selection::Template {
        fields: Vec::new(),
        rest: BTreeMap::from([
            ("success".to_owned(), one("false")),
            ("message".to_owned(), one(why)),
        ]),
    };
    let plan = MessagePlan::compile(response, &template, Wire::Cdr).ok()?;
    let mut bytes = Vec::new();
    plan.write(&mut NoFields, &mut bytes).ok()?;
    Some(bytes.into())
}

/// The calls of an action: goal, cancel and result.
const CALLS_OF_ACTION: usize = 3;
/// The maximal number of calls offered as services: any publisher in the space can announce calls.
const MOST_CALLS: usize = 1024;
/// The failure text for waiting callers of a lost call.
const GONE: &str = "the executor of the call is lost; it is unknown whether the call was executed";
/// How long after the loss of a call the waiting callers receive the failure: the Router may still
/// receive a response.
const ANSWERED_AFTER: Duration = Duration::from_secs(1);
/// How long the service of a lost call stays, so that its callers can receive the failure.
const LEFT_AFTER: Duration = Duration::from_secs(2);
/// Time limit of a call: services of ROS have no deadline of their own.
const ANSWERED_WITHIN: Duration = Duration::from_secs(30);
/// The maximal number of open requests of all services.
const MOST_ASKED: usize = 512;
