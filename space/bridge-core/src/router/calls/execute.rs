//! Calls of this program: announced, and executed by the local side.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{PubSub, SpaceId, TopicId};
use messages::MessageType;
use uadp::action::{
    ActionFields, ActionMessage, ActionOutcome, ExecutionId, FinishRefusal, Refusal, RequestDrop,
    RequestOrigin, RequiredAction,
};
use uadp::{Fields, StatusCode};

use super::super::DropSite;
use super::super::values::TopicQueues;
use super::CallTraffic;
use super::own::{Own, RunningRequest};
use crate::call::{
    CallDescription, CallExecution, CallField, CallTypeError, Executed, OfferedCall, OfferedType,
};
use crate::call_announcement::{CallAnnouncement, CallTypes, LASTING_TARGET};
use crate::call_plan::ExecutedPlan;
use crate::counters::{DropCause, Reason};
use crate::late;
use crate::loop_rule::{Crosses, Side};
use crate::network::number_of;
use crate::output::Output;
use crate::settings::Now;

impl CallTraffic<'_> {
    /// Adds or changes a call that the local side executes, and announces it. Calls of namespaces
    /// that this program does not own are ignored.
    pub(in super::super) fn offer(&mut self, topic: TopicId, offered: OfferedCall, now: Now) {
        let OfferedCall { description, open } = offered;
        self.offer_as(topic, (&description, None), (open, None), now);
    }

    /// Adds a ROS service of the local side as [`offer`](Self::offer) does. Requests and responses
    /// are ROS messages in the local encoding.
    ///
    /// # Errors
    /// Returns the reason if the type cannot be executed, or if the payloads of the local side are
    /// fields.
    pub(in super::super) fn offer_type(
        &mut self,
        topic: TopicId,
        offered: &OfferedType,
        now: Now,
    ) -> Result<(), CallTypeError> {
        let Some(wire) = self.wire() else {
            return Err(CallTypeError::NoRosTypes);
        };
        let service = &offered.service_type;
        let plan = ExecutedPlan::compile(service, (wire, &mut self.values.plans))?;
        let fields = |message: &MessageType| {
            let leaves = message.leaves().iter();
            leaves.map(CallField::of).collect()
        };
        let about = match &offered.about[..] {
            "" => service.name().to_string(),
            about => format!("{}; {about}", service.name()),
        };
        let description = CallDescription {
            name: offered.name.clone(),
            about,
            role: offered.role,
            request: fields(service.request()),
            response: fields(service.response()),
        };
        let types = CallTypes {
            request: service.request(),
            response: service.response(),
        };
        let how = (offered.open, Some(Arc::new(plan)));
        self.offer_as(topic, (&description, Some(types)), how, now);
        Ok(())
    }

    fn offer_as(
        &mut self,
        topic: TopicId,
        (description, types): (&CallDescription, Option<CallTypes<'_>>),
        (open, plan): (bool, Option<Arc<ExecutedPlan>>),
        now: Now,
    ) {
        if !self.values.is_home(topic) {
            return self
                .values
                .count(DropSite::topic(topic), Reason::Looped, 1, String::new);
        }
        let mapping = Arc::clone(&self.values.mapping);
        let namespaces = mapping.namespaces();
        let period = self.values.mapping.pubsub().metadata_period;
        let calls = self.calls_mut(now);
        let call = calls.table.entry(topic).or_default();
        let before = call.own.take().and_then(|own| own.announcement);
        let name = description.name.clone();
        let (_, _, writer_id) = topic.triple();
        let said = (description, types, namespaces, calls.target);
        let made = CallAnnouncement::new(topic, said, before.as_ref(), now.utc);
        let (announcement, fault) = match made {
            Ok(announcement) => (Some(announcement), None),
            Err(error) => (None, Some(error)),
        };
        call.own = Some(Own {
            name,
            open,
            plan,
            announcement,
        });
        calls.announce_at.get_or_insert(now.monotonic + period);
        calls.reckon();
        self.announcements.plan_call(topic, now);
        if let Some(error) = fault {
            self.count_call(topic, None, Reason::MetaData, || {
                format!("cannot announce the arguments of call {writer_id}: {error}")
            });
        }
    }

    /// Removes an own call. Running executions continue.
    pub(in super::super) fn withdraw_own(&mut self, topic: TopicId) {
        let calls = self.calls.as_mut();
        if let Some(call) = calls.and_then(|calls| calls.table.get_mut(&topic)) {
            call.own = None;
        }
    }

    /// Plans the announcements of all own calls.
    pub(in super::super) fn announce_calls(&mut self, now: Now) {
        let period = self.values.mapping.pubsub().metadata_period;
        let Some(calls) = &mut self.calls else {
            return;
        };
        let own = calls.table.iter().filter(|(_, call)| call.own.is_some());
        let own: Vec<TopicId> = own.map(|(topic, _)| *topic).collect();
        calls.announce_at = (!own.is_empty()).then(|| now.monotonic + period);
        for topic in own {
            self.announcements.plan_call(topic, now);
        }
    }

    /// Announces the own calls of a namespace, in response to a probe for them.
    pub(in super::super) fn announce_calls_of(&mut self, namespace: u16, now: Now) {
        let calls = self.calls.iter().flat_map(|calls| calls.own());
        for topic in calls.filter(|topic| topic.triple().1 == namespace) {
            self.announcements.plan_call(topic, now);
        }
    }

    /// Handles a request, and passes it to the local side if it is for an own call and may be
    /// executed.
    pub(in super::super) fn handle_request(
        &mut self,
        topic: TopicId,
        request: &ActionMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) {
        if !self.values.may_cross(Side::Ua, Crosses::Request, topic)
            || self.values.is_withheld(topic)
        {
            return self.count_call(topic, Some(from), Reason::NotAsked, String::new);
        }
        if self.values.is_muted() {
            // Another bridge answers it.
            return self.count_call(
                topic,
                Some(from),
                (Reason::Takeover, "standby"),
                String::new,
            );
        }
        let (_, namespace, _) = topic.triple();
        let origin = self.origin(namespace, from);
        let is_redundant = self.values.redundant.is_some();
        // A sender with the keys of the group is trusted at any address.
        let known = origin.group != STRANGERS;
        let group = self.values.mapping.pubsub().address;
        let waited = self.values.waited(now);
        // A caller gives up an executor that is silent for this time.
        let silence = self.values.mapping.pubsub().receive_timeout;
        let Some(calls) = &mut self.calls else {
            let values = &mut self.values;
            return values.count(DropSite::sender(from), Reason::NotAsked, 1, String::new);
        };
        let since = calls.since_start(now);
        let own = calls.table.get(&topic).and_then(|call| call.own.as_ref());
        let judged = if is_redundant && request.target_id == LASTING_TARGET {
            Err(without_target(from))
        } else {
            may_be_executed(own, request, (from, group), known)
        };
        let verdict = judged.as_ref().map(|_| ()).map_err(|refused| refused.0);
        let requested = calls
            .responder
            .handle_judged(request, (origin, verdict), since);
        match requested {
            Ok(RequiredAction::Execute(id)) if !calls.is_of_this_life(request) => {
                self.leave_to_earlier_life((topic, id), from, now);
            }
            Ok(RequiredAction::Execute(id)) if waited >= hint(request).min(silence) => {
                self.leave_given_up((topic, id), (from, waited), now);
            }
            Ok(RequiredAction::Execute(id)) => {
                if let Ok((fields, plan)) = judged {
                    let read = self.read_request(plan.as_deref(), fields);
                    self.execute((topic, id), (request, read, plan), now);
                }
            }
            Ok(RequiredAction::Declined(_)) => {
                if let Err((_, case, detail)) = judged {
                    let cause = (Reason::CallRefused, case);
                    self.count_call(topic, Some(from), cause, || detail);
                }
            }
            Ok(RequiredAction::Refused(..)) => {
                let cause = (Reason::CallRefused, "busy");
                self.count_call(topic, Some(from), cause, || {
                    "the limit of simultaneous executions is reached".to_owned()
                });
            }
            Ok(RequiredAction::Abandoned(execution)) => {
                if calls.executions.contains_key(&execution) {
                    calls.news.push_back(Output::Abandoned { execution, topic });
                }
            }
            Ok(RequiredAction::Repeated(_) | RequiredAction::Closed(_)) => {}
            // A repetition of a refused request, or its acknowledgement. The refusal itself is
            // already counted.
            Err(RequestDrop::Refused) => {
                self.count_call(topic, Some(from), Reason::NotAsked, String::new);
            }
            Err(why) => {
                let cause = (Reason::CallRefused, "request");
                self.count_call(topic, Some(from), cause, || why.to_string());
            }
        }
    }

    /// Does not execute a request that was sent to an earlier instance of this program, which may
    /// have executed it with an unknown result.
    fn leave_to_earlier_life(
        &mut self,
        (topic, id): (TopicId, ExecutionId),
        from: SocketAddr,
        now: Now,
    ) {
        let is_redundant = self.values.redundant.is_some();
        if let Some(calls) = &mut self.calls {
            let lost = ActionOutcome::Unknown(uadp::action::Unknown::Lost);
            // The requestor receives the outcome when it repeats the request.
            let since = calls.since_start(now);
            let _told = calls.responder.finish(id, lost, since).is_ok();
        }
        let cause = (Reason::CallRefused, "earlier life");
        self.count_call(topic, Some(from), cause, || {
            if is_redundant {
                "not executed: the request was sent to the bridge that was active before".to_owned()
            } else {
                "not executed: the request was sent before this program was restarted".to_owned()
            }
        });
    }

    /// Does not execute a request that waited for this program longer than its caller waits. Its
    /// repetitions are refused, too.
    fn leave_given_up(
        &mut self,
        (topic, id): (TopicId, ExecutionId),
        (from, waited): (SocketAddr, Duration),
        now: Now,
    ) {
        if let Some(calls) = &mut self.calls {
            let since = calls.since_start(now);
            let refused = calls.responder.refuse(id, Refusal::NotExecutable, since);
            let _told = refused.is_ok();
        }
        let cause = late::cause(late::WAITED);
        self.count_call(topic, Some(from), cause, || late::waited(waited));
    }

    /// Returns whether the sender may request any own call in the namespace, so that memory may be
    /// used for the chunks of a request.
    pub(in super::super) fn may_request(&self, namespace: u16, from: SocketAddr) -> bool {
        let calls = self.calls.iter().flat_map(|calls| &calls.table);
        let is_open = |(topic, call): (&TopicId, &super::Call)| {
            topic.triple().1 == namespace && call.own.as_ref().is_some_and(|own| own.open)
        };
        self.origin(namespace, from).group != STRANGERS || calls.into_iter().any(is_open)
    }

    /// Returns the origin of a request, to which its memory is charged. Members of a secured group,
    /// which have its keys, and programs of this host are distinguished by address and port. All
    /// ports of another host share a limit.
    fn origin(&self, namespace: u16, from: SocketAddr) -> RequestOrigin<SocketAddr> {
        match self.security.group_of(namespace) {
            Some(at) => RequestOrigin {
                group: SECURED.saturating_add(at),
                sender: from,
            },
            None if self
                .values
                .arrival
                .map_or_else(|| from.ip().is_loopback(), |relay| relay.authorized) =>
            {
                RequestOrigin {
                    group: LOOPBACK,
                    sender: from,
                }
            }
            None => RequestOrigin {
                group: STRANGERS,
                sender: SocketAddr::new(from.ip(), 0),
            },
        }
    }

    /// Returns the request in the local encoding.
    fn read_request(
        &mut self,
        plan: Option<&ExecutedPlan>,
        fields: &[u8],
    ) -> Result<Vec<u8>, (DropCause, String)> {
        let mut request = self.values.buffer();
        match plan {
            Some(plan) => plan.request(fields, &mut request)?,
            None => request.extend_from_slice(fields),
        }
        Ok(request)
    }

    fn execute(
        &mut self,
        (topic, id): (TopicId, ExecutionId),
        (request, read, plan): (&ActionMessage<'_>, ReadRequest, Option<Arc<ExecutedPlan>>),
        now: Now,
    ) {
        let waited = self.values.waited(now);
        let Some(calls) = &mut self.calls else {
            return;
        };
        let block = match read {
            Ok(block) => block,
            Err((cause, detail)) => {
                let since = calls.since_start(now);
                // The requestor receives the refusal when it repeats the request.
                let refused = calls.responder.refuse(id, Refusal::InvalidArgument, since);
                let _told = refused.is_ok();
                return self.count_call(topic, None, cause, || detail);
            }
        };
        let deadline = now.monotonic + hint(request).saturating_sub(waited);
        let start_by = match self.values.redundant {
            Some(_) => deadline.min(now.monotonic + START_WITHIN),
            None => deadline,
        };
        let running = RunningRequest {
            topic,
            deadline,
            plan,
        };
        calls.executions.insert(id, running);
        if let Some(call) = calls.table.get_mut(&topic) {
            call.counters.executed += 1;
        }
        let (number, _) = number_of(request.action.requestor_id);
        calls.news.push_back(Output::Execute(CallExecution {
            id,
            topic,
            request: block,
            requestor: u16::try_from(number).ok().and_then(SpaceId::new),
            deadline,
            start_by,
        }));
    }

    /// Ends an execution with its outcome, which is sent to the requestor.
    pub(in super::super) fn executed(
        &mut self,
        execution: ExecutionId,
        outcome: Executed,
        now: Now,
    ) {
        let Some(calls) = &mut self.calls else {
            return;
        };
        let Some(RunningRequest { topic, plan, .. }) = calls.executions.remove(&execution) else {
            return;
        };
        let since = calls.since_start(now);
        let (_, namespace, _) = topic.triple();
        let (outcome, fault) = match (outcome, plan) {
            (Executed::Answered(message), Some(plan)) => match plan.response(&message, namespace) {
                Ok(fields) => (Executed::Answered(fields), None),
                Err(fault) => (Executed::Failed(BAD_ENCODING_ERROR), Some(fault)),
            },
            (outcome, _) => (outcome, None),
        };
        let told = match &outcome {
            Executed::Answered(fields) => {
                match Fields::parse(fields).and_then(|of| of.checked_bytes()) {
                    Ok(fields) => ActionOutcome::Answered {
                        status: StatusCode::GOOD,
                        fields: ActionFields::Variants(fields),
                    },
                    Err(_) => ActionOutcome::Answered {
                        status: BAD_ENCODING_ERROR,
                        fields: ActionFields::NONE,
                    },
                }
            }
            Executed::Failed(status) => ActionOutcome::Answered {
                status: *status,
                fields: ActionFields::NONE,
            },
            Executed::Refused(refusal) => ActionOutcome::Refused(*refusal),
            Executed::Lost => ActionOutcome::Unknown(uadp::action::Unknown::Lost),
        };
        let finished = calls.responder.finish(execution, told, since);
        calls.reckon();
        if let Some((cause, detail)) = fault {
            self.count_call(topic, None, cause, || detail);
        }
        match finished {
            Ok(()) => {}
            // An abandoned execution ends as requested.
            Err(FinishRefusal::Abandoned) => {
                self.count_call(topic, None, Reason::NotAsked, String::new);
            }
            Err(FinishRefusal::TooBig) => self.count_call(topic, None, Reason::TooBig, || {
                "the response does not fit into a datagram".to_owned()
            }),
            Err(why) => {
                let cause = (Reason::CallRefused, "response");
                self.count_call(topic, None, cause, || why.to_string());
            }
        }
    }
}

impl super::RouterCalls {
    /// Sends the announcement of an own call.
    pub(in super::super) fn announce(
        &self,
        values: &mut TopicQueues,
        topic: TopicId,
        sequence: u16,
        now: Now,
    ) {
        if values.is_withheld(topic) {
            return;
        }
        let own = self.table.get(&topic).and_then(|call| call.own.as_ref());
        let Some(announcement) = own.and_then(|own| own.announcement.as_ref()) else {
            return;
        };
        let mut bytes = values.buffer();
        let body_at = announcement.write((sequence, self.target), &mut bytes);
        values.send_announcement(topic, sequence, (bytes, body_at), now);
    }

    /// Returns whether a request is for this instance of the program. After the announcement of a
    /// new instance, requestors use its new ActionTargetId.
    fn is_of_this_life(&self, request: &ActionMessage<'_>) -> bool {
        [self.target, LASTING_TARGET].contains(&request.target_id)
    }

    /// Removes executions that did not end for a long time after their deadline.
    pub(super) fn forget_executions(&mut self, now: Instant) {
        self.executions
            .retain(|_, running| running.deadline + FORGOTTEN > now);
    }
}

/// A request in the local encoding, or the reason why it cannot be converted.
type ReadRequest = Result<Vec<u8>, (DropCause, String)>;
/// The fields of a request, and the plan to read them if the local side uses ROS messages.
type Executable<'a> = (&'a [u8], Option<Arc<ExecutedPlan>>);

/// Returns the time for which the caller of a request waits.
fn hint(request: &ActionMessage<'_>) -> Duration {
    let hint = request.action.timeout().unwrap_or(TIMEOUT);
    hint.min(MAX_TIMEOUT)
}

/// Returns the fields of a request if it may be executed.
fn may_be_executed<'a>(
    own: Option<&Own>,
    request: &ActionMessage<'a>,
    (from, group): (SocketAddr, SocketAddr),
    known: bool,
) -> Result<Executable<'a>, (Refusal, &'static str, String)> {
    let Some(own) = own else {
        let detail = "this program does not execute the call".to_owned();
        return Err((Refusal::NoSuchAction, "unknown", detail));
    };
    if !own.open && !known {
        let detail = format!(
            "{from} is another host, and the calls are not open to other hosts (`open: true`)"
        );
        return Err((Refusal::NotAllowed, "not allowed", detail));
    }
    let wanted = request.action.response_address.unwrap_or_default();
    if !is_answered_at(wanted, (from, group)) {
        let detail = format!(
            "{from} requests the response at {wanted:?}, but responses are sent to {group}"
        );
        return Err((Refusal::NotAllowed, "response address", detail));
    }
    let fields = request.fields.variants();
    fields
        .and_then(|fields| fields.checked_bytes())
        .map(|fields| (fields, own.plan.clone()))
        .map_err(|error| (Refusal::InvalidArgument, "fields", error.to_string()))
}

/// Returns whether a response to the group reaches the ResponseAddress (OPC 10000-14, 7.2.4.4.2).
/// The address must be empty, the address of the group, or on the host of the requestor. Responses
/// to arbitrary addresses could be misused for attacks on other hosts.
fn is_answered_at(wanted: &str, (from, group): (SocketAddr, SocketAddr)) -> bool {
    let wanted = wanted.trim();
    let at = PubSub::parse_address(wanted);
    wanted.is_empty() || at.is_some_and(|at| at == group || at.ip() == from.ip())
}

/// The group of unsecured requests from other hosts.
const STRANGERS: usize = 0;
/// The group of unsecured requests from this host.
const LOOPBACK: usize = 1;
/// The group of requests in the first secured group.
const SECURED: usize = 2;
/// Bad_EncodingError (OPC 10000-6, A.2).
const BAD_ENCODING_ERROR: StatusCode = StatusCode(0x8006_0000);
/// The default and the maximum timeout, as in a Responder.
const TIMEOUT: Duration = Duration::from_secs(60);
const MAX_TIMEOUT: Duration = Duration::from_secs(3600);
/// The time within which the local side starts an execution of a redundant bridge: less than the
/// time of a takeover.
const START_WITHIN: Duration = Duration::from_millis(50);
/// The time after its deadline at which an execution is removed.
const FORGOTTEN: Duration = Duration::from_secs(60);

/// Returns the refusal of a request without an announced ActionTargetId, its case and a text.
fn without_target(from: SocketAddr) -> (Refusal, &'static str, String) {
    let text = format!(
        "{from} sent a request with the ActionTargetId {LASTING_TARGET}, and redundant bridges execute only \
         requests with their announced ActionTargetId"
    );
    (Refusal::NotExecutable, "no ActionTargetId", text)
}
