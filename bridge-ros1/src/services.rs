//! Services of the graph as values of the space: calls made for values that arrive, calls made by the clock, and what
//! they bring.
//!
//! Each variable that calls and each service that is polled has a task of its own, so that no call holds up another or
//! the port.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bridge_node::{PortEvent, timestamp};
use bytes::Bytes;
use mappings::{Mapping, Overflow, ServiceRole, SpaceId, TopicId, Trigger, Variable};
use messages::{Literal, Selection, ServiceType, TypeName};
use tcpros::{Node, ServiceClient, ServiceClientOptions};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tracing::warn;

use crate::caller::{Caller, Outcome, Source};
use crate::definitions::{Definitions, constant};
use crate::pending::Pending;

/// The calls of one bridge.
#[derive(Debug)]
pub(crate) struct Services {
    callers: HashMap<TopicId, Callee>,
    /// Which values are made of the answers.
    takers: HashMap<Source, Vec<TopicId>>,
    /// Polls whose last call was answered.
    answering: HashSet<Source>,
    outcomes: mpsc::Receiver<Outcome>,
    report: mpsc::Sender<Outcome>,
    tasks: JoinSet<()>,
}

/// What the values of one variable call.
#[derive(Debug)]
struct Callee {
    pending: Arc<Pending>,
    /// Where the request is the same each time: that request, and the value that calls, if not any does.
    constant: Option<(Bytes, Option<Vec<u8>>)>,
}

/// A service as a binding has it.
struct Target<'m> {
    service: &'m str,
    service_type: Arc<ServiceType>,
    timeout: Duration,
}

/// What makes two polls the same.
type Poll<'m> = (&'m str, &'m TypeName, &'m Selection, Duration, Duration);

impl Services {
    /// Starts what the mapping ties to services. Reports the types of the values; a binding that cannot be served is
    /// told of.
    pub(crate) fn start(
        node: &Node,
        own: SpaceId,
        mapping: &Mapping,
        definitions: &mut Definitions,
    ) -> (Self, Vec<PortEvent>) {
        // What the port has not taken yet delays the next calls: no more than these wait.
        let (report, outcomes) = mpsc::channel(64);
        let mut services = Self {
            callers: HashMap::new(),
            takers: HashMap::new(),
            answering: HashSet::new(),
            outcomes,
            report,
            tasks: JoinSet::new(),
        };
        let mut events = Vec::new();
        let mut polls: Vec<Poll<'_>> = Vec::new();
        for (variable, binding) in mapping.services(own) {
            let bound = match &binding.role {
                ServiceRole::Call { .. } => {
                    services.open_call(node, variable, &binding.role, definitions)
                }
                ServiceRole::Answer { of, selection } => {
                    services.take_answers(mapping, variable, (*of, selection), definitions)
                }
                ServiceRole::Poll { .. } => {
                    services.open_poll(node, variable, (&binding.role, &mut polls), definitions)
                }
            };
            match bound {
                Ok(event) => events.push(event),
                Err(error) => warn!(
                    topic = %variable.topic,
                    name = variable.name,
                    "no service is called for this value: {error}"
                ),
            }
        }
        (services, events)
    }

    fn open_call(
        &mut self,
        node: &Node,
        variable: &Variable,
        role: &ServiceRole,
        definitions: &mut Definitions,
    ) -> Result<PortEvent, String> {
        let ServiceRole::Call {
            service,
            service_type,
            request,
            when,
            timeout,
        } = role
        else {
            return Err("it has no call".to_owned());
        };
        let service_type = service_of(definitions, service_type)?;
        let message_type = service_type.request();
        let (bound, constant) = match request {
            Selection::Template { field: None, .. } => {
                let request = constant(message_type, request)?;
                let carrier = carrier(variable, definitions)?;
                let value = match when {
                    Trigger::Any => None,
                    Trigger::Equals(text) => Some(constant(&carrier, &only(text))?.to_vec()),
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
        let of = Source::Value(variable.topic);
        let caller = self.caller(node, &target, of)?;
        let pending = Arc::new(Pending::new(variable.overflow));
        let insist = variable.overflow == Overflow::KeepLatest;
        self.tasks.spawn(caller.serve(Arc::clone(&pending), insist));
        self.callers
            .insert(variable.topic, Callee { pending, constant });
        Ok(bound)
    }

    fn take_answers(
        &mut self,
        mapping: &Mapping,
        variable: &Variable,
        (of, selection): (TopicId, &Selection),
        definitions: &mut Definitions,
    ) -> Result<PortEvent, String> {
        let role = mapping
            .variable(of)
            .and_then(|of| of.service.as_ref())
            .map(|binding| &binding.role);
        let Some(ServiceRole::Call { service_type, .. }) = role else {
            return Err(format!("{of} calls no service"));
        };
        let service_type = service_of(definitions, service_type)?;
        let takers = self.takers.entry(Source::Value(of)).or_default();
        takers.push(variable.topic);
        Ok(bound(variable.topic, &service_type, selection))
    }

    fn open_poll<'m>(
        &mut self,
        node: &Node,
        variable: &Variable,
        (role, polls): (&'m ServiceRole, &mut Vec<Poll<'m>>),
        definitions: &mut Definitions,
    ) -> Result<PortEvent, String> {
        let ServiceRole::Poll {
            service,
            service_type: name,
            request,
            selection,
            every,
            timeout,
        } = role
        else {
            return Err("it has no poll".to_owned());
        };
        let service_type = service_of(definitions, name)?;
        let poll = (service.as_str(), name, request, *every, *timeout);
        let known = polls.iter().position(|known| *known == poll);
        let of = Source::Poll(known.unwrap_or(polls.len()));
        if known.is_none() {
            let request = constant(service_type.request(), request)?;
            let target = Target {
                service,
                service_type: Arc::clone(&service_type),
                timeout: *timeout,
            };
            let caller = self.caller(node, &target, of)?;
            self.tasks.spawn(caller.poll(request, *every));
            polls.push(poll);
        }
        self.takers.entry(of).or_default().push(variable.topic);
        Ok(bound(variable.topic, &service_type, selection))
    }

    fn caller(&self, node: &Node, target: &Target<'_>, of: Source) -> Result<Caller, String> {
        let options = ServiceClientOptions {
            md5sum: Some(target.service_type.md5().to_owned()),
            type_name: Some(target.service_type.name().to_string()),
            persistent: true,
            timeout: target.timeout,
            ..ServiceClientOptions::default()
        };
        let client: ServiceClient = node
            .service_client(target.service, options)
            .map_err(|error| error.to_string())?;
        Ok(Caller::new(client, of, self.report.clone()))
    }

    /// Whether the values of a topic are for a service.
    pub(crate) fn takes(&self, topic: TopicId) -> bool {
        self.callers.contains_key(&topic)
    }

    /// Hands a value to the service of its topic; `None` when it has none. Else says how many older values gave way.
    pub(crate) fn hand_over(&self, topic: TopicId, value: &Bytes) -> Option<u64> {
        let callee = self.callers.get(&topic)?;
        let request = match &callee.constant {
            None => Some(value.clone()),
            // It calls nothing, and of a state it takes the place of one that still does.
            Some((_, Some(wanted))) if wanted != value => None,
            Some((request, _)) => Some(request.clone()),
        };
        Some(callee.pending.push(request))
    }

    /// The end of the next call. Cancel-safe.
    pub(crate) async fn recv(&mut self) -> Outcome {
        match self.outcomes.recv().await {
            Some(outcome) => outcome,
            // Not while we hold a sender ourselves.
            None => std::future::pending().await,
        }
    }

    /// What the end of a call is for the values made of it.
    pub(crate) fn ended(&mut self, outcome: Outcome, now: SystemTime) -> Vec<PortEvent> {
        let Outcome { of, result } = outcome;
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
                let received = timestamp(now);
                events.extend(takers.iter().map(|topic| PortEvent::Sample {
                    topic: *topic,
                    payload: answer.clone(),
                    received,
                    latched_by: None,
                }));
            }
            Err(detail) => {
                let failed = |topic: &TopicId| PortEvent::CallFailed {
                    topic: *topic,
                    detail: detail.clone(),
                };
                match of {
                    // What the service answered before is still its last answer.
                    Source::Value(topic) => events.push(failed(&topic)),
                    Source::Poll(_) => {
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

fn service_of(definitions: &mut Definitions, name: &TypeName) -> Result<Arc<ServiceType>, String> {
    definitions.service(name).map_err(|error| {
        format!(
            "{error}; the connection to a service does not bring its definition, so a folder below ROS_PACKAGE_PATH \
             must have {}/srv/{}.srv",
            name.package(),
            name.name()
        )
    })
}

fn bound(topic: TopicId, service_type: &ServiceType, selection: &Selection) -> PortEvent {
    PortEvent::Bound {
        topic,
        message_type: Arc::clone(service_type.response()),
        selection: selection.clone(),
    }
}

/// The type a value comes as that is only compared.
fn carrier(
    variable: &Variable,
    definitions: &mut Definitions,
) -> Result<Arc<messages::MessageType>, String> {
    let (builtin, array) = variable
        .value_type
        .ok_or("a variable whose value does not go into the request needs a `type`")?;
    let name = definitions
        .standard_type(builtin, array)
        .ok_or_else(|| format!("a value of type {builtin:?} cannot be compared with `when`"))?;
    definitions.get(&name).map_err(|error| error.to_string())
}

/// A std_msgs type with that text as its `data`.
fn only(text: &str) -> Selection {
    Selection::Template {
        field: None,
        rest: BTreeMap::from([("data".to_owned(), Literal::One(text.to_owned()))]),
    }
}
