//! Calls of other programs: requests and their responses.
//!
//! A request is repeated until it is answered, and is executed once; [`uadp::action`] implements
//! both. This module adds the parts that concern the space: the executor of each call and its
//! address (`learn`), the own calls (`execute`), and the payloads of both sides.

mod chunks;
mod execute;
mod executors;
mod learn;
mod own;
mod send;
mod takeover;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{SpaceId, TopicId};
use messages::{ServiceType, Wire};
use uadp::action::{
    ActionAddress, ActionDialect, ActionFields, ActionMessage, ActionOutcome, ActionRequest,
    CallId, CallRefusal, ExecutionId, Refusal, Requestor, RequestorSettings, Responder,
    ResponderSettings, ResponseDrop, Unknown,
};
use uadp::{OwnedPublisherId, StatusCode};

use self::chunks::Chunking;
use self::executors::{CallState, NamespaceExecutor};
use self::own::{Own, RunningRequest};
use super::announcements::PlannedAnnouncements;
use super::names::NameSource;
use super::security::MessageSecurity;
use super::senders::RedundantSenders;
use super::{DropSite, TopicQueues};
use crate::call::{
    AskError, AskErrorKind, AskId, CallCounters, CallDescription, CallMap, CallTypeError,
};
use crate::call_announcement::LASTING_TARGET;
use crate::call_plan::CallPlan;
use crate::counters::{DropCause, Reason};
use crate::fields;
use crate::loop_rule::{Crosses, Side};
use crate::output::Output;
use crate::settings::{Local, Now};

/// The calls of a Router.
#[derive(Debug)]
pub(super) struct RouterCalls {
    /// The origin of time for the requestor and the responder.
    start: Instant,
    requestor: Requestor,
    /// Responses are sent to the group. The address is used for limits per sender.
    responder: Responder<SocketAddr>,
    /// The ActionTargetId of the own calls in this program instance.
    target: u16,
    table: HashMap<TopicId, Call>,
    /// The executors of the calls of each namespace.
    groups: HashMap<(SpaceId, u16), NamespaceExecutor>,
    /// The size in bytes of the known call descriptions.
    weight: usize,
    asked: BTreeMap<CallId, OwnRequest>,
    asks: HashMap<AskId, CallId>,
    executions: BTreeMap<ExecutionId, RunningRequest>,
    /// The outputs for the port in their order. Their number is limited by the number of calls and
    /// requests.
    news: VecDeque<Output>,
    /// Requests and responses that are larger than a datagram.
    chunking: Chunking,
    /// The time of the next announcement of the own calls.
    announce_at: Option<Instant>,
    /// The time of the next check for silent executors.
    look_at: Option<Instant>,
    /// The time of the next action.
    due: Option<Instant>,
}

/// The calls of a Router with the parts of the Router that they use.
pub(super) struct CallTraffic<'r> {
    pub(super) calls: &'r mut Option<Box<RouterCalls>>,
    pub(super) values: &'r mut TopicQueues,
    pub(super) announcements: &'r mut PlannedAnnouncements,
    pub(super) security: &'r MessageSecurity,
    pub(super) senders: &'r RedundantSenders,
    /// Random bytes that distinguish own requests from requests of other programs.
    pub(super) instance: [u8; 16],
}

/// The state of a call.
#[derive(Debug, Default)]
struct Call {
    /// The description of a call of another program.
    known: Option<CallState>,
    /// The local type of the call.
    bound: Option<Bound>,
    /// The state of an own call.
    own: Option<Own>,
    /// The number of own requests without response.
    open: usize,
    counters: CallCounters,
}

/// The local ROS type of a call.
#[derive(Debug)]
struct Bound {
    service: Arc<ServiceType>,
    map: Arc<CallMap>,
    /// `None` while the call is not known.
    plan: Option<Result<Arc<CallPlan>, CallTypeError>>,
}

/// A request of the local side.
#[derive(Debug)]
struct OwnRequest {
    ask: AskId,
    topic: TopicId,
    /// The plan for its response, if the local side uses ROS messages.
    plan: Option<Arc<CallPlan>>,
}

impl RouterCalls {
    fn new(
        (own, instance): (SpaceId, [u8; 16]),
        target: u16,
        receive_timeout: Duration,
        start: Instant,
    ) -> Self {
        let settings = RequestorSettings {
            receive_timeout,
            max_bytes: 4 * MAX_BLOCK,
            large: LARGE,
            ..RequestorSettings::default()
        };
        Self {
            start,
            requestor: Requestor::new(OwnedPublisherId::UInt16(own.into()), instance, settings),
            responder: Responder::new(ResponderSettings {
                max_executing: MAX_EXECUTING,
                max_executing_per_sender: MAX_EXECUTING / 2,
                max_answer: MAX_BLOCK,
                max_bytes: 4 * MAX_BLOCK,
                max_bytes_per_sender: 2 * MAX_BLOCK,
                ..ResponderSettings::default()
            }),
            target,
            table: HashMap::new(),
            groups: HashMap::new(),
            weight: 0,
            asked: BTreeMap::new(),
            asks: HashMap::new(),
            executions: BTreeMap::new(),
            news: VecDeque::new(),
            chunking: Chunking::default(),
            announce_at: None,
            look_at: None,
            due: None,
        }
    }

    pub(super) const fn set_receive_timeout(&mut self, receive_timeout: Duration) {
        self.requestor.set_receive_timeout(receive_timeout);
    }

    fn since_start(&self, now: Now) -> Duration {
        now.monotonic.saturating_duration_since(self.start)
    }

    fn reckon(&mut self) {
        let requests = self.requestor.poll_timeout();
        let next = requests.into_iter().chain(self.responder.poll_timeout());
        let next = next.map(|due| self.start + due);
        self.due = next.chain(self.announce_at).chain(self.look_at).min();
    }

    pub(super) const fn due(&self) -> Option<Instant> {
        self.due
    }

    /// Returns the counters of each call.
    pub(super) fn counters(&self) -> impl Iterator<Item = (TopicId, &CallCounters)> {
        let all = self.table.iter();
        all.map(|(topic, call)| (*topic, &call.counters))
    }

    /// Returns the description of a call of another program, if the call has an executor.
    pub(super) fn described(&self, topic: TopicId) -> Option<&Arc<CallDescription>> {
        let known = self.table.get(&topic)?.known.as_ref()?;
        (!known.gone).then_some(&known.description)
    }

    /// Returns the display name of an own call, or of a call of another program. It may be empty.
    pub(super) fn name_of(&self, topic: TopicId) -> Option<(&str, NameSource)> {
        let call = self.table.get(&topic)?;
        if let Some(own) = &call.own {
            return Some((own.name.as_str(), NameSource::Own));
        }
        let known = call.known.as_ref()?;
        Some((known.description.name.as_str(), NameSource::Announcement))
    }

    /// Returns whether a chunk of a request or response waits for the pace.
    pub(super) fn is_chunking(&self) -> bool {
        !self.chunking.is_empty()
    }

    /// Returns the own calls.
    pub(super) fn own(&self) -> impl Iterator<Item = TopicId> {
        let own = self.table.iter().filter(|(_, call)| call.own.is_some());
        own.map(|(topic, _)| *topic)
    }

    fn topic_of(&self, id: CallId) -> Option<TopicId> {
        self.asked.get(&id).map(|asked| asked.topic)
    }

    /// Removes a completed request.
    fn close(&mut self, id: CallId) -> Option<OwnRequest> {
        let asked = self.asked.remove(&id)?;
        self.asks.remove(&asked.ask);
        if let Some(call) = self.table.get_mut(&asked.topic) {
            call.open = call.open.saturating_sub(1);
        }
        Some(asked)
    }
}

impl CallTraffic<'_> {
    fn calls_mut(&mut self, now: Now) -> &mut RouterCalls {
        let (own, instance) = (self.values.settings.own, self.instance);
        let timeout = self.values.mapping.pubsub().receive_timeout;
        let target = self.target();
        self.calls.get_or_insert_with(|| {
            Box::new(RouterCalls::new(
                (own, instance),
                target,
                timeout,
                now.monotonic,
            ))
        })
    }

    fn described_call(&self, topic: TopicId) -> Option<&Arc<CallDescription>> {
        self.calls.as_ref()?.described(topic)
    }

    /// Binds a call to the service type with which the local side requests it. `map` assigns fields
    /// that are not assigned by name. If the call is not known yet, its executor is probed, and the
    /// type is checked when its description arrives.
    ///
    /// # Errors
    /// Returns the reason if the known call does not fit the type. The call stays bound
    /// nevertheless, because its description may change.
    pub(super) fn bind_call(
        &mut self,
        topic: TopicId,
        (service, map): (&Arc<ServiceType>, &Arc<CallMap>),
        now: Now,
    ) -> Result<(), CallTypeError> {
        if self.wire().is_none() || self.values.is_home(topic) {
            return Ok(());
        }
        self.calls_mut(now).table.entry(topic).or_default().bound = Some(Bound {
            service: Arc::clone(service),
            map: Arc::clone(map),
            plan: None,
        });
        let bound = self.compile(topic);
        self.want_call(topic, now);
        bound
    }

    fn wire(&self) -> Option<Wire> {
        match self.values.settings.local {
            Local::Ros1 => Some(Wire::Ros1),
            Local::Cdr => Some(Wire::Cdr),
            Local::Fields => None,
        }
    }

    /// Compiles the plan of a call that is known and bound.
    fn compile(&mut self, topic: TopicId) -> Result<(), CallTypeError> {
        let wire = self.wire();
        let call = self.calls.as_mut();
        let call = call.and_then(|calls| calls.table.get_mut(&topic));
        let Some(Call {
            known: Some(known),
            bound: Some(bound),
            ..
        }) = call
        else {
            return Ok(());
        };
        let Some(wire) = wire else { return Ok(()) };
        let plan = CallPlan::compile(
            &known.description,
            (&bound.service, &bound.map),
            (wire, &mut self.values.plans),
        );
        let outcome = plan.as_ref().map(|_| ()).map_err(Clone::clone);
        bound.plan = Some(plan.map(Arc::new));
        outcome
    }

    /// Unbinds a call. Pending requests are still answered.
    pub(super) fn unbind_call(&mut self, topic: TopicId) {
        let calls = self.calls.as_mut();
        if let Some(call) = calls.and_then(|calls| calls.table.get_mut(&topic)) {
            call.bound = None;
        }
    }

    /// Records that the local side has a client for a call. If the call is not known, its executor
    /// is probed.
    pub(super) fn want_call(&mut self, topic: TopicId, now: Now) {
        self.values.concern.add(topic);
        if self.described_call(topic).is_none() && !self.values.is_home(topic) {
            self.announcements.probe(topic, now);
        }
    }

    /// Sends a request. The outcome is output as [`Output::Answer`] within `timeout` or soon after,
    /// unless the request is [given up](Self::give_up). Each `ask` is used once.
    pub(super) fn ask(
        &mut self,
        ask: AskId,
        (topic, request): (TopicId, &[u8]),
        timeout: Duration,
        now: Now,
    ) {
        let (_, namespace, _) = topic.triple();
        let begun = if self.values.is_muted() {
            Err(takeover::not_asked(self.values.shows_values()))
        } else if self.values.carries(namespace) {
            self.begin(topic, request, timeout, now)
        } else {
            Err(takeover::not_carried(namespace))
        };
        let calls = self.calls_mut(now);
        let call = calls.table.entry(topic).or_default();
        call.counters.asked += 1;
        match begun {
            Ok((id, plan)) => {
                call.open += 1;
                calls.asked.insert(id, OwnRequest { ask, topic, plan });
                calls.asks.insert(ask, id);
                calls.reckon();
            }
            Err((cause, error)) => {
                match error.kind {
                    AskErrorKind::Unknown => call.counters.unknown += 1,
                    AskErrorKind::Refused | AskErrorKind::Failed => call.counters.refused += 1,
                }
                let detail = error.text.clone();
                calls.news.push_back(Output::Answer {
                    ask,
                    topic,
                    answer: Err(error),
                });
                self.count_call(topic, None, cause, || detail);
            }
        }
    }

    fn begin(
        &mut self,
        topic: TopicId,
        request: &[u8],
        timeout: Duration,
        now: Now,
    ) -> Result<Begun, (DropCause, AskError)> {
        let refuse = |refusal: Refusal, case: &'static str, text: String| {
            (
                (Reason::CallRefused, case).into(),
                AskError::refused(refusal, text),
            )
        };
        if !self.values.may_cross(Side::Local, Crosses::Request, topic) {
            let text =
                format!("{topic} is executed by this program and cannot be called from here");
            return Err((
                Reason::Looped.into(),
                AskError::refused(Refusal::NoSuchAction, text),
            ));
        }
        if self.described_call(topic).is_none() {
            self.want_call(topic, now);
            let text = format!(
                "no program offers {topic} at the moment; check that the executing bridge or component runs and uses this network"
            );
            return Err(refuse(Refusal::NoSuchAction, "unknown", text));
        }
        let wire = self.wire();
        let (space, namespace, writer_id) = topic.triple();
        let calls = self.calls_mut(now);
        let since = calls.since_start(now);
        let call = calls.table.entry(topic).or_default();
        if call.open >= MAX_OPEN {
            let text =
                format!("the limit of {MAX_OPEN} simultaneous requests for {topic} is reached");
            return Err(refuse(Refusal::Busy, "open", text));
        }
        let plan = match (wire, &call.bound) {
            (None, _) => None,
            (
                Some(_),
                Some(Bound {
                    plan: Some(plan), ..
                }),
            ) => Some(
                plan.clone()
                    .map_err(|why| refuse(Refusal::InvalidArgument, "type", why.to_string()))?,
            ),
            (Some(_), _) => {
                let text = format!("{topic} has no type here");
                return Err(refuse(Refusal::NotExecutable, "unbound", text));
            }
        };
        let block = plan.as_ref().map(|plan| plan.request(request, namespace));
        let block = block
            .transpose()
            .map_err(|(cause, text)| (cause, AskError::refused(Refusal::InvalidArgument, text)))?;
        let fields = block.as_deref().unwrap_or(request);
        if fields.len() > MAX_BLOCK {
            let text = format!("{} bytes exceed the limit of {MAX_BLOCK}", fields.len());
            return Err((
                Reason::TooBig.into(),
                AskError::refused(Refusal::TooBig, text),
            ));
        }
        let request = ActionRequest {
            address: ActionAddress {
                publisher_id: OwnedPublisherId::UInt16(space),
                writer_group_id: Some(namespace),
                writer_id,
                target_id: call
                    .known
                    .as_ref()
                    .map_or(LASTING_TARGET, |known| known.target),
            },
            dialect: ActionDialect::Standard,
            fields: ActionFields::Variants(fields),
            timeout,
        };
        match calls.requestor.call(request, since) {
            Ok(id) => Ok((id, plan)),
            Err(why @ (CallRefusal::TooManyCalls(_) | CallRefusal::TooManyBytes { .. })) => {
                Err(refuse(Refusal::Busy, "in flight", why.to_string()))
            }
            Err(why) => Err(refuse(Refusal::InvalidArgument, "request", why.to_string())),
        }
    }

    /// Gives up a request. It has no outcome, and its executor is informed.
    pub(super) fn give_up(&mut self, ask: AskId, now: Now) {
        let Some(calls) = &mut self.calls else {
            return;
        };
        let since = calls.since_start(now);
        if let Some(id) = calls.asks.get(&ask).copied() {
            calls.requestor.abandon(id, since);
            calls.close(id);
            calls.reckon();
        }
    }

    /// Records that a request or response could not be sent. It is sent again.
    pub(super) fn not_called(&mut self, topic: TopicId, reason: Reason, detail: &str) {
        self.count_call(topic, None, (reason, "socket"), || detail.to_owned());
    }

    /// Handles a response.
    pub(super) fn handle_response(
        &mut self,
        topic: TopicId,
        response: &ActionMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) {
        if !self.values.may_cross(Side::Ua, Crosses::Response, topic) {
            if self.values.is_redundant_peer(from) {
                return;
            }
            let (_, namespace, _) = topic.triple();
            return self.values.drop_own(Some(namespace), from, now);
        }
        let is_successor = self.senders.is_active(self.security, (topic.space, from));
        let Some(calls) = &mut self.calls else {
            return self
                .values
                .count(DropSite::sender(from), Reason::NotAsked, 1, String::new);
        };
        let since = calls.since_start(now);
        let known = calls.table.get(&topic).and_then(|call| call.known.as_ref());
        let impostor = known.is_some_and(|known| known.from != from) && !is_successor;
        let heard = if impostor {
            Err(ResponseDrop::Elsewhere)
        } else {
            calls.requestor.handle_response(response, since)
        };
        if heard.is_ok() {
            calls.spoke(topic);
        }
        match heard {
            Ok(uadp::action::ResponseMeaning::Done(id, outcome)) => {
                // The program may have restarted, and its announcement may have been lost.
                if let ActionOutcome::Unknown(Unknown::Lost) = outcome {
                    self.announcements.probe(topic, now);
                }
                self.conclude(id, outcome);
            }
            Ok(
                uadp::action::ResponseMeaning::Executing(_)
                | uadp::action::ResponseMeaning::Closed(_),
            ) => {}
            Err(ResponseDrop::Elsewhere) => {
                self.count_call(topic, Some(from), Reason::Forged, || {
                    format!("{from} responds for {topic}, but does not execute it")
                });
            }
            // Responses go to the whole group, including responses to other requestors and repeated
            // responses.
            Err(_) => self.count_call(topic, Some(from), Reason::NotAsked, String::new),
        }
    }

    /// Outputs the outcome of a request.
    fn conclude(&mut self, id: CallId, outcome: ActionOutcome<'_>) {
        let Some(asked) = self.calls.as_mut().and_then(|calls| calls.close(id)) else {
            return;
        };
        let OwnRequest { ask, topic, plan } = asked;
        let mut response = self.values.buffer();
        let (answer, cause) = match outcome {
            ActionOutcome::Answered { status, fields } if status.0 & BAD == 0 => {
                match read(fields, plan.as_deref(), &mut response) {
                    Ok(()) => (Ok(response), None),
                    Err((cause, detail)) => {
                        let text =
                            format!("it was executed, but its response is malformed: {detail}");
                        (failed(BAD_DECODING_ERROR, text), Some((cause, detail)))
                    }
                }
            }
            ActionOutcome::Answered { status, .. } => {
                let text = format!("it was executed and failed: status 0x{:08X}", status.0);
                (failed(status, text), None)
            }
            ActionOutcome::Refused(refusal) => {
                (Err(AskError::refused(refusal, refusal.to_string())), None)
            }
            ActionOutcome::Unknown(why) => (Err(unknown(why)), None),
        };
        if let Some(calls) = &mut self.calls {
            if let Some(call) = calls.table.get_mut(&topic) {
                let counters = &mut call.counters;
                let counter = match &answer {
                    Err(error) if error.kind == AskErrorKind::Refused => &mut counters.refused,
                    Err(error) if error.kind == AskErrorKind::Unknown => &mut counters.unknown,
                    Ok(_) | Err(_) => &mut counters.answered,
                };
                *counter += 1;
            }
            calls.news.push_back(Output::Answer { ask, topic, answer });
        }
        if let Some((cause, detail)) = cause {
            self.count_call(topic, None, cause, || detail);
        }
    }

    /// Outputs requests that were given up without response, and executions with requestors that
    /// stopped waiting.
    pub(super) fn settle(&mut self, now: Now) {
        while let Some((id, why)) = self
            .calls
            .as_mut()
            .and_then(|calls| calls.requestor.poll_given_up())
        {
            let topic = self.calls.as_ref().and_then(|calls| calls.topic_of(id));
            self.conclude(id, ActionOutcome::Unknown(why));
            if let (Some(topic), Unknown::Silent) = (topic, why) {
                self.doubt(topic, now);
            }
        }
        if let Some(calls) = &mut self.calls {
            while let Some(execution) = calls.responder.poll_overdue() {
                if let Some(running) = calls.executions.get(&execution) {
                    let topic = running.topic;
                    calls.news.push_back(Output::Abandoned { execution, topic });
                }
            }
            calls.reckon();
        }
    }

    /// Sends announcements and gives up requests that are due.
    pub(super) fn look_at_calls(&mut self, now: Now) {
        let Some(calls) = &mut self.calls else {
            return;
        };
        if calls.due.is_none_or(|due| due > now.monotonic) {
            return;
        }
        let since = calls.since_start(now);
        calls.requestor.handle_timeout(since);
        calls.responder.handle_timeout(since);
        if calls.announce_at.is_some_and(|at| at <= now.monotonic) {
            self.announce_calls(now);
        }
        self.look_for_silence(now);
        self.settle(now);
    }

    /// Counts a drop of a call as `TopicQueues::count` does for a topic.
    pub(super) fn count_call(
        &mut self,
        topic: TopicId,
        from: Option<SocketAddr>,
        cause: impl Into<DropCause>,
        detail: impl FnOnce() -> String,
    ) {
        let cause = cause.into();
        let call = self.calls.as_mut();
        let counters = match call.and_then(|calls| calls.table.get_mut(&topic)) {
            Some(call) => &mut call.counters.drops,
            None => self.values.topics.others_mut(),
        };
        let total = counters.add(cause, 1);
        let about = DropSite {
            topic: Some(topic),
            from,
        };
        self.values
            .tell_of_drop(about, cause, (total.saturating_sub(1), total), detail);
    }
}

/// A request and the plan for its response.
type Begun = (CallId, Option<Arc<CallPlan>>);

/// Appends a response in the local encoding.
fn read(
    fields: ActionFields<'_>,
    plan: Option<&CallPlan>,
    out: &mut Vec<u8>,
) -> Result<(), (DropCause, String)> {
    let variants = fields.variants().map_err(fields::undecodable)?;
    match plan {
        Some(plan) => plan.response(variants.bytes(), out),
        None => fields::copy(&variants, out),
    }
}

fn failed(status: StatusCode, text: String) -> Result<Vec<u8>, AskError> {
    Err(AskError {
        kind: AskErrorKind::Failed,
        status,
        text,
    })
}

fn unknown(why: Unknown) -> AskError {
    AskError {
        kind: AskErrorKind::Unknown,
        status: why.status_code(),
        text: format!("it is unknown whether it was executed: {why}"),
    }
}

/// The severity of a Bad StatusCode (OPC 10000-4, 7.39.1).
const BAD: u32 = 0x8000_0000;
/// Bad_DecodingError (OPC 10000-6, A.2).
const BAD_DECODING_ERROR: StatusCode = StatusCode(0x8007_0000);
/// The maximum number of requests for a call without response.
const MAX_OPEN: usize = 256;
/// The maximum number of concurrent executions, including calls that wait for the results of
/// actions.
const MAX_EXECUTING: usize = 1_024;
/// The size in bytes of the fields from which a request may not fit into a datagram: the smallest
/// `max_datagram` without headers.
const LARGE: usize = 128;
/// The maximum size in bytes of the fields of a request or response. Fields larger than a datagram
/// are sent in chunks.
const MAX_BLOCK: usize = 16 << 20;
