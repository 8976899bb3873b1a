//! Executes Methods of other OPC UA servers, and acknowledges alarms, for callers in the space.
//!
//! Each server has a single client, however many of its Methods are mapped. A Method is offered
//! while the server is connected and the types of its arguments are supported. No call is repeated:
//! a request that was sent when the connection was lost may have been executed.

mod signature;
mod watch;

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bridge_node::{Executed, Execution, ExecutionId, OfferedCall, PortEvent, Refusal, now};
use mappings::{Access, ExecutedBy, Mapping, MethodTarget, TopicId};
use opcua::types::{StatusCode, Variant};
use plant_opcua::client::{CallError, CallOptions, ClientError, OpcUaClient};
use tokio::sync::{mpsc, watch as cell};
use tokio::task::{AbortHandle, JoinSet};
use tracing::info;
use uadp::Fields;

pub(crate) use self::signature::node as local_node;

use self::signature::Signature;
use self::watch::{CallableMethod, News};
use crate::alarms::{Alarms, description_of_acknowledging};
use crate::clients::Clients;
use crate::layout::VariableShape;
use crate::value;

/// The Methods of other servers that the mapping names.
pub(crate) struct ForeignMethods {
    /// The servers by their access data.
    servers: HashMap<Access, Server>,
    wanted: HashMap<TopicId, Arc<MappedMethod>>,
    timeouts: HashMap<TopicId, Duration>,
    /// The Methods that are offered.
    found: HashMap<TopicId, Arc<CallableMethod>>,
    heard: mpsc::Receiver<News>,
    tell: mpsc::Sender<News>,
    /// Events that are not reported yet: refused executions and withdrawn calls.
    events: VecDeque<PortEvent>,
    running: JoinSet<Executed>,
    /// The calls that acknowledge alarms, as they are offered.
    acknowledging: HashMap<TopicId, OfferedCall>,
    alarms: Arc<Alarms>,
    executions: HashMap<tokio::task::Id, (ExecutionId, TopicId)>,
}

/// A Method as the mapping defines it.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct MappedMethod {
    topic: TopicId,
    name: String,
    about: String,
    open: bool,
    target: MethodTarget,
}

/// A server with Methods.
struct Server {
    wanted: cell::Sender<Vec<Arc<MappedMethod>>>,
    watching: AbortHandle,
}

impl Drop for Server {
    fn drop(&mut self) {
        self.watching.abort();
    }
}

impl ForeignMethods {
    /// Starts to look for the Methods of `mapping`, and offers the calls that acknowledge `alarms`.
    pub(crate) fn new(mapping: &Mapping, clients: &mut Clients, alarms: Arc<Alarms>) -> Self {
        let (tell, heard) = mpsc::channel(MOST_NEWS);
        let mut executing = Self {
            servers: HashMap::new(),
            wanted: HashMap::new(),
            timeouts: HashMap::new(),
            found: HashMap::new(),
            heard,
            tell,
            events: VecDeque::new(),
            running: JoinSet::new(),
            acknowledging: HashMap::new(),
            alarms,
            executions: HashMap::new(),
        };
        executing.reload(mapping, clients);
        executing
    }

    /// Switches to the Methods of another mapping. Methods that are unchanged stay undisturbed.
    pub(crate) fn reload(&mut self, mapping: &Mapping, clients: &mut Clients) {
        let mut before = std::mem::take(&mut self.wanted);
        self.timeouts.clear();
        let mut servers: HashMap<Access, Vec<Arc<MappedMethod>>> = HashMap::new();
        for call in mapping.calls() {
            let ExecutedBy::OpcUa(target) = &call.executed else {
                continue;
            };
            let wanted = MappedMethod {
                topic: call.topic,
                name: call.name.clone(),
                about: call.about.clone(),
                open: call.open,
                target: target.clone(),
            };
            let known = before.remove(&call.topic).filter(|one| **one == wanted);
            let wanted = known.unwrap_or_else(|| Arc::new(wanted));
            let access = target.access.clone();
            servers.entry(access).or_default().push(Arc::clone(&wanted));
            self.wanted.insert(call.topic, wanted);
            self.timeouts.insert(call.topic, call.timeout);
        }
        self.offer_acknowledging(mapping);
        let is_wanted = |found: &CallableMethod| {
            let wanted = self.wanted.get(&found.wanted.topic);
            wanted.is_some_and(|wanted| Arc::ptr_eq(wanted, &found.wanted))
        };
        let gone = self.found.extract_if(|_, found| !is_wanted(found));
        self.events
            .extend(gone.map(|(topic, _)| PortEvent::Withdrawn { topic }));
        self.servers
            .retain(|access, _| servers.contains_key(access));
        for (access, wanted) in servers {
            match self.servers.get(&access) {
                Some(server) => drop(server.wanted.send_replace(wanted)),
                None => {
                    let server = self.watch(clients.of(&access), &access, wanted);
                    self.servers.insert(access, server);
                }
            }
        }
    }

    /// Offers the calls of the mapping that acknowledge alarms, and withdraws the others.
    fn offer_acknowledging(&mut self, mapping: &Mapping) {
        let calls = mapping.calls().iter();
        let calls = calls.filter(|call| call.executed == ExecutedBy::Acknowledging);
        let offered = calls.map(|call| {
            let description = description_of_acknowledging(call);
            let open = call.open;
            (call.topic, OfferedCall { description, open })
        });
        let mut before = std::mem::replace(&mut self.acknowledging, offered.collect());
        for (topic, offered) in &self.acknowledging {
            let (topic, offered) = (*topic, offered.clone());
            if before.remove(&topic).as_ref() != Some(&offered) {
                self.events.push_back(PortEvent::Offer { topic, offered });
            }
        }
        let gone = before.into_keys();
        self.events
            .extend(gone.map(|topic| PortEvent::Withdrawn { topic }));
    }

    fn watch(
        &self,
        client: OpcUaClient,
        access: &Access,
        wanted: Vec<Arc<MappedMethod>>,
    ) -> Server {
        let (wanted, receiver) = cell::channel(wanted);
        let watching = watch::run(
            client,
            access.endpoint.to_string(),
            receiver,
            self.tell.clone(),
        );
        Server {
            wanted,
            watching: tokio::spawn(watching).abort_handle(),
        }
    }

    /// Waits for the next event. Cancel-safe.
    pub(crate) async fn next(&mut self) -> PortEvent {
        loop {
            if let Some(event) = self.events.pop_front() {
                return event;
            }
            tokio::select! {
                Some(news) = self.heard.recv() => self.take(news),
                Some(ended) = self.running.join_next_with_id() => {
                    let (id, outcome) = match ended {
                        Ok((id, outcome)) => (id, outcome),
                        Err(error) => (error.id(), Executed::Lost),
                    };
                    if let Some((execution, _)) = self.executions.remove(&id) {
                        return PortEvent::Executed { execution, outcome };
                    }
                }
            }
        }
    }

    fn take(&mut self, news: News) {
        match news {
            News::Found(found) => {
                let topic = found.wanted.topic;
                let wanted = self.wanted.get(&topic);
                if wanted.is_none_or(|wanted| !Arc::ptr_eq(wanted, &found.wanted)) {
                    return;
                }
                let description = found.signature.description(&found.wanted);
                let open = found.wanted.open;
                info!(%topic, name = found.wanted.name, url = %found.wanted.target.access.endpoint, "a Method can be called");
                self.found.insert(topic, Arc::new(found));
                let offered = OfferedCall { description, open };
                self.events.push_back(PortEvent::Offer { topic, offered });
            }
            News::Lost(topic) => {
                if self.found.remove(&topic).is_some() {
                    self.events.push_back(PortEvent::Withdrawn { topic });
                }
            }
        }
    }

    /// Calls the Method. Returns false if the event queue is full, so that the outcome could not be
    /// reported.
    pub(crate) fn execute(&mut self, execution: &Execution) -> bool {
        if self.events.len() >= MOST_EXECUTIONS {
            return false;
        }
        if self.acknowledging.contains_key(&execution.topic) {
            let (execution, outcome) = (execution.id, self.acknowledge(execution));
            self.events
                .push_back(PortEvent::Executed { execution, outcome });
        } else if let Err(refusal) = self.begin(execution) {
            self.events.push_back(PortEvent::Executed {
                execution: execution.id,
                outcome: Executed::Refused(refusal),
            });
        }
        true
    }

    /// Acknowledges an alarm, unless the caller has stopped waiting.
    fn acknowledge(&self, execution: &Execution) -> Executed {
        let now = now().monotonic;
        if execution.deadline <= now || execution.start_by < now {
            return Executed::Refused(Refusal::NotExecutable);
        }
        self.alarms.execute(execution)
    }

    fn begin(&mut self, execution: &Execution) -> Result<(), Refusal> {
        let Execution {
            id,
            topic,
            request,
            deadline,
            start_by,
            ..
        } = execution;
        let found = self.found.get(topic).ok_or(Refusal::NotExecutable)?;
        let same = self.executions.values().filter(|(_, of)| of == topic);
        if self.executions.len() >= MOST_EXECUTIONS || same.count() >= MOST_OF_ONE {
            return Err(Refusal::Busy);
        }
        let arguments = arguments(request, &found.signature)?;
        let left = deadline.saturating_duration_since(now().monotonic);
        let longest = self.timeouts.get(topic).copied().unwrap_or(left);
        let within = left.min(longest);
        if within.is_zero() {
            return Err(Refusal::NotExecutable);
        }
        let call = call(Arc::clone(found), arguments, (within, *start_by));
        let task = self.running.spawn(call);
        self.executions.insert(task.id(), (*id, *topic));
        Ok(())
    }
}

/// Decodes the arguments from the fields of a request.
fn arguments(request: &[u8], signature: &Signature) -> Result<Vec<Variant>, Refusal> {
    let wrong = |_| Refusal::InvalidArgument;
    let fields = Fields::parse(request).map_err(wrong)?;
    if fields.len() != signature.takes.len() {
        return Err(Refusal::InvalidArgument);
    }
    let arguments = fields.zip(&signature.takes).map(|(field, wanted)| {
        let field = field.map_err(wrong)?;
        let fits = VariableShape::of(wanted).fits(&field);
        fits.then(|| value::from_field(&field))
            .ok_or(Refusal::InvalidArgument)
    });
    arguments.collect()
}

async fn call(
    found: Arc<CallableMethod>,
    arguments: Vec<Variant>,
    (within, start_by): (Duration, Instant),
) -> Executed {
    if start_by < now().monotonic {
        // The program was stopped, and another redundant server may have taken over.
        return Executed::Refused(Refusal::NotExecutable);
    }
    let CallableMethod {
        wanted,
        client,
        connects,
        signature,
    } = &*found;
    let options = CallOptions {
        within,
        connection: Some(*connects),
    };
    let method = (&signature.object, &signature.method);
    let called = client.call_within(method, arguments, options).await;
    let outcome = match &called {
        Ok(outputs) => answered(outputs, signature),
        Err(error) => not_answered(error),
    };
    if let Err(error) = called {
        info!(topic = %wanted.topic, url = %wanted.target.access.endpoint, ?outcome, "cannot call a Method of another server: {error}");
    }
    outcome
}

fn answered(outputs: &[Variant], signature: &Signature) -> Executed {
    let fits = outputs.len() == signature.gives.len()
        && signature
            .gives
            .iter()
            .zip(outputs)
            .all(|(wanted, output)| VariableShape::of(wanted).accepts(output));
    let block = value::fields_block(outputs);
    match block {
        Ok(block) if fits => Executed::Answered(block),
        // The Method was executed, but its outputs cannot be decoded.
        Ok(_) | Err(_) => Executed::Failed(status(StatusCode::BadDecodingError)),
    }
}

fn not_answered(error: &CallError) -> Executed {
    match error {
        CallError::Refused {
            status: said,
            arguments,
        } => {
            // A Method that was executed may return this status too, but then without a bad
            // argument status.
            let of_arguments = arguments.iter().any(|status| status.is_bad());
            match refusal(*said) {
                Some(refusal) => Executed::Refused(refusal),
                None if *said == StatusCode::BadInvalidArgument && of_arguments => {
                    Executed::Refused(Refusal::InvalidArgument)
                }
                None => Executed::Failed(status(*said)),
            }
        }
        CallError::Client(ClientError::NotConnected(_)) => {
            Executed::Refused(Refusal::NotExecutable)
        }
        CallError::Client(ClientError::Status(said)) => match refusal(*said) {
            Some(refusal) => Executed::Refused(refusal),
            // The status of the whole request, such as a response that is too large. The Method may
            // have been executed.
            None => Executed::Lost,
        },
        CallError::Client(ClientError::Lost(_) | ClientError::Answer(_)) => Executed::Lost,
    }
}

/// Returns the refusal for a status that proves that the Method was not called (OPC 10000-4,
/// 5.12.2; for sessions 7.39.2).
const fn refusal(status: StatusCode) -> Option<Refusal> {
    Some(match status {
        StatusCode::BadMethodInvalid
        | StatusCode::BadNodeIdUnknown
        | StatusCode::BadNodeIdInvalid => Refusal::NoSuchAction,
        StatusCode::BadNotExecutable
        | StatusCode::BadSessionIdInvalid
        | StatusCode::BadSessionNotActivated
        | StatusCode::BadServerHalted => Refusal::NotExecutable,
        StatusCode::BadUserAccessDenied | StatusCode::BadSecurityModeInsufficient => {
            Refusal::NotAllowed
        }
        StatusCode::BadTooManyOperations => Refusal::Busy,
        StatusCode::BadArgumentsMissing | StatusCode::BadTooManyArguments => {
            Refusal::InvalidArgument
        }
        StatusCode::BadRequestTooLarge => Refusal::TooBig,
        _ => return None,
    })
}

fn status(status: StatusCode) -> uadp::StatusCode {
    uadp::StatusCode(status.bits())
}

/// Largest number of simultaneous executions of all Methods.
const MOST_EXECUTIONS: usize = 1_024;
/// Largest number of simultaneous executions of a single Method.
const MOST_OF_ONE: usize = 256;
/// Largest number of news of the watchers that wait for the run loop.
const MOST_NEWS: usize = 64;
