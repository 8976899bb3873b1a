//! Calls of our own: announced, and executed by the local side.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use mappings::{PubSub, SpaceId, TopicId};
use messages::MessageType;
use uadp::action::{
    ActionFields, ActionMessage, ExecutionId, FinishRefusal, Outcome, Refusal, RequestDrop,
    RequestOrigin, Requested,
};
use uadp::discovery::{Announced, Announcement, DataSetMetaDataType};
use uadp::{Fields, PublisherId, SecurityHeader, StatusCode};

use super::super::announce::BAD_NOT_FOUND;
use super::super::receive::number_of;
use super::super::{About, Router};
use crate::call::{
    CallDescription, CallField, Executed, Execution, Offered, OfferedType, join_name,
};
use crate::call_announcement::{CallAnnouncement, LASTING_TARGET, Types};
use crate::call_plan::ExecutedPlan;
use crate::counters::{Cause, Reason};
use crate::loop_rule::{Side, What};
use crate::output::Output;
use crate::settings::Now;

/// A call of ours.
#[derive(Debug)]
pub(super) struct Own {
    open: bool,
    /// What its bytes are read and written with, where the local side speaks ROS.
    plan: Option<Arc<ExecutedPlan>>,
    announcement: Option<CallAnnouncement>,
}

/// A request that the local side executes.
#[derive(Debug)]
pub(super) struct Running {
    pub(super) topic: TopicId,
    deadline: Instant,
    /// As the request was read, so that a call that is another meanwhile changes nothing.
    plan: Option<Arc<ExecutedPlan>>,
}

impl Router {
    /// The local side executes a call from now on, or it is another than before: it is announced. One of a namespace that is
    /// not ours is not taken.
    pub fn offer(&mut self, topic: TopicId, offered: Offered, now: Now) {
        let Offered { description, open } = offered;
        self.offer_as(topic, (&description, None), (open, None), now);
    }

    /// As [`offer`](Self::offer), for a ROS service of the local side: its requests are handed out, and its responses taken, as
    /// its messages in the local encoding.
    ///
    /// # Errors
    /// Why the type cannot be executed, for people. A local side that speaks in fields has none.
    pub fn offer_type(
        &mut self,
        topic: TopicId,
        offered: &OfferedType,
        now: Now,
    ) -> Result<(), String> {
        let Some(wire) = self.wire() else {
            return Err("the local side has no ROS types".to_owned());
        };
        let service = &offered.service_type;
        let plan = ExecutedPlan::compile(service, (wire, &mut self.plans))?;
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
        let types = Types {
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
        (description, types): (&CallDescription, Option<Types<'_>>),
        (open, plan): (bool, Option<Arc<ExecutedPlan>>),
        now: Now,
    ) {
        if !self.is_home(topic) {
            return self.count(About::topic(topic), Reason::Looped, 1, String::new);
        }
        let mapping = Arc::clone(&self.mapping);
        let namespaces = mapping.namespaces();
        let period = self.mapping.pubsub().metadata_period;
        let calls = self.calls_mut(now);
        let call = calls.table.entry(topic).or_default();
        let before = call.own.take().and_then(|own| own.announcement);
        let (_, _, writer_id) = topic.triple();
        let said = (description, types, namespaces, calls.target);
        let made = CallAnnouncement::new(topic, said, before.as_ref(), now.utc);
        let (announcement, fault) = match made {
            Ok(announcement) => (Some(announcement), None),
            Err(error) => (None, Some(error)),
        };
        call.own = Some(Own {
            open,
            plan,
            announcement,
        });
        calls.announce_at.get_or_insert(now.monotonic + period);
        calls.reckon();
        self.plan_action(topic, now);
        if let Some(error) = fault {
            self.count_call(topic, None, Reason::MetaData, || {
                format!("what call {writer_id} takes and gives cannot be announced: {error}")
            });
        }
    }

    /// The local side no longer executes a call, or no longer has a value, of its own: that is announced. Requests that are
    /// executed go on.
    pub fn withdraw(&mut self, topic: TopicId, now: Now) {
        if !self.is_home(topic) {
            return;
        }
        let calls = self.calls.as_mut();
        if let Some(call) = calls.and_then(|calls| calls.table.get_mut(&topic)) {
            call.own = None;
        }
        self.unbind(topic, now);
        self.forget_described(topic);
        let withheld = self.is_withheld(topic);
        if !withheld {
            self.announce_none(topic);
        }
    }

    /// As [`withdraw`](Self::withdraw), for all calls of ours and all values that no mapping says: the program ends.
    pub fn withdraw_all(&mut self, now: Now) {
        let calls = self.calls.iter().flat_map(|calls| &calls.table);
        let calls = calls.filter(|(_, call)| call.own.is_some());
        let said = self.topics.iter().filter(|(_, entry)| entry.said.is_some());
        let topics = calls
            .map(|(topic, _)| *topic)
            .chain(said.map(|(topic, _)| *topic));
        let topics: Vec<TopicId> = topics.collect();
        for topic in topics {
            self.withdraw(topic, now);
        }
    }

    /// Says that there is nothing under that name.
    fn announce_none(&mut self, topic: TopicId) {
        let (space, _, writer_id) = topic.triple();
        let announcement = Announcement {
            sequence_number: 0,
            announced: Announced::DataSetMetaData {
                writer_id,
                meta_data: DataSetMetaDataType {
                    name: Some(&join_name(topic, "")),
                    ..DataSetMetaDataType::default()
                },
                status: BAD_NOT_FOUND,
            },
        };
        let mut bytes = self.buffer();
        let publisher = PublisherId::UInt16(space);
        if announcement
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.tell(Output::Discovery { bytes });
        }
    }

    /// Plans to announce all calls of ours.
    pub(in super::super) fn announce_calls(&mut self, now: Now) {
        let period = self.mapping.pubsub().metadata_period;
        let Some(calls) = &mut self.calls else {
            return;
        };
        let own = calls.table.iter().filter(|(_, call)| call.own.is_some());
        let own: Vec<TopicId> = own.map(|(topic, _)| *topic).collect();
        calls.announce_at = (!own.is_empty()).then(|| now.monotonic + period);
        for topic in own {
            self.plan_action(topic, now);
        }
    }

    /// Announces a call of ours.
    pub(in super::super) fn announce_call(&mut self, topic: TopicId, sequence: u16, now: Now) {
        if self.is_withheld(topic) {
            return;
        }
        let mut bytes = self.buffer();
        let call = self.calls.as_mut();
        let call = call.and_then(|calls| calls.table.get_mut(&topic));
        let own = call.and_then(|call| call.own.as_ref());
        let Some(announcement) = own.and_then(|own| own.announcement.as_ref()) else {
            return;
        };
        let body_at = announcement.write(sequence, &mut bytes);
        self.send_announcement(topic, sequence, (bytes, body_at), now);
    }

    /// A request: for the local side, if it is one of ours and may be executed.
    pub(super) fn handle_request(
        &mut self,
        topic: TopicId,
        request: &ActionMessage<'_>,
        from: SocketAddr,
        now: Now,
    ) {
        if !self.may_cross(Side::Ua, What::Request, topic) || self.is_withheld(topic) {
            return self.count_call(topic, Some(from), Reason::NotAsked, String::new);
        }
        let (_, namespace, _) = topic.triple();
        let origin = self.origin(namespace, from);
        // A sender that has the keys is known, whatever its address.
        let known = origin.group != STRANGERS;
        let group = self.mapping.pubsub().address;
        let Some(calls) = &mut self.calls else {
            return self.count(About::sender(from), Reason::NotAsked, 1, String::new);
        };
        let since = calls.since_start(now);
        let own = calls.table.get(&topic).and_then(|call| call.own.as_ref());
        let judged = may_be_executed(own, request, (from, group), known);
        let verdict = judged.as_ref().map(|_| ()).map_err(|refused| refused.0);
        let requested = calls
            .responder
            .handle_judged(request, (origin, verdict), since);
        match requested {
            // A life of this program before may have executed it, of which nothing is known.
            Ok(Requested::Execute(id)) if !calls.is_of_this_life(request) => {
                let lost = Outcome::Unknown(uadp::action::Unknown::Lost);
                // Whom it is told is who asks for it again.
                let _told = calls.responder.finish(id, lost, since).is_ok();
                let cause = (Reason::CallRefused, "earlier life");
                self.count_call(topic, Some(from), cause, || {
                    "what was asked of this program before it was started anew is not executed"
                        .to_owned()
                });
            }
            Ok(Requested::Execute(id)) => {
                if let Ok((fields, plan)) = judged {
                    let read = self.read_request(plan.as_deref(), fields);
                    self.execute((topic, id), (request, read, plan), now);
                }
            }
            Ok(Requested::Declined(_)) => {
                if let Err((_, case, detail)) = judged {
                    let cause = (Reason::CallRefused, case);
                    self.count_call(topic, Some(from), cause, || detail);
                }
            }
            Ok(Requested::Refused(..)) => {
                let cause = (Reason::CallRefused, "busy");
                self.count_call(topic, Some(from), cause, || {
                    "as many requests as can be are executed already".to_owned()
                });
            }
            Ok(Requested::Abandoned(execution)) => {
                if calls.executions.contains_key(&execution) {
                    calls.news.push_back(Output::Abandoned { execution, topic });
                }
            }
            Ok(Requested::Repeated(_) | Requested::Closed(_)) => {}
            // A repetition of a refused request, or its acknowledgement: the refusal itself is counted.
            Err(RequestDrop::Refused) => {
                self.count_call(topic, Some(from), Reason::NotAsked, String::new);
            }
            Err(why) => {
                let cause = (Reason::CallRefused, "request");
                self.count_call(topic, Some(from), cause, || why.to_string());
            }
        }
    }

    /// Returns whether any call of ours in the namespace may be requested from there, so that room may be taken for the chunks
    /// of a request.
    pub(in super::super) fn may_request(&self, namespace: u16, from: SocketAddr) -> bool {
        let calls = self.calls.iter().flat_map(|calls| &calls.table);
        let is_open = |(topic, call): (&TopicId, &super::Call)| {
            topic.triple().1 == namespace && call.own.as_ref().is_some_and(|own| own.open)
        };
        self.origin(namespace, from).group != STRANGERS || calls.into_iter().any(is_open)
    }

    /// Returns whose room a request takes up. The members of a secured group are known by their keys and the programs of this
    /// host by their ports. A stranger has one room for all ports of its host.
    fn origin(&self, namespace: u16, from: SocketAddr) -> RequestOrigin<SocketAddr> {
        let guard = self.guard.as_ref();
        let secured = guard.and_then(|guard| guard.group_of(namespace));
        match secured {
            Some(at) => RequestOrigin {
                group: SECURED.saturating_add(at),
                sender: from,
            },
            None if from.ip().is_loopback() => RequestOrigin {
                group: LOOPBACK,
                sender: from,
            },
            None => RequestOrigin {
                group: STRANGERS,
                sender: SocketAddr::new(from.ip(), 0),
            },
        }
    }

    /// The request as the local side has it.
    fn read_request(
        &mut self,
        plan: Option<&ExecutedPlan>,
        fields: &[u8],
    ) -> Result<Vec<u8>, (Cause, String)> {
        let mut request = self.buffer();
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
        let Some(calls) = &mut self.calls else {
            return;
        };
        let block = match read {
            Ok(block) => block,
            Err((cause, detail)) => {
                let since = calls.since_start(now);
                // Whom it is told is who asks for it again.
                let refused = calls.responder.refuse(id, Refusal::InvalidArgument, since);
                let _told = refused.is_ok();
                return self.count_call(topic, None, cause, || detail);
            }
        };
        let hint = request.action.timeout().unwrap_or(TIMEOUT);
        let deadline = now.monotonic + hint.min(MAX_TIMEOUT);
        let running = Running {
            topic,
            deadline,
            plan,
        };
        calls.executions.insert(id, running);
        if let Some(call) = calls.table.get_mut(&topic) {
            call.counters.executed += 1;
        }
        let (number, _) = number_of(request.action.requestor_id);
        calls.news.push_back(Output::Execute(Execution {
            id,
            topic,
            request: block,
            requestor: u16::try_from(number).ok().and_then(SpaceId::new),
            deadline,
        }));
    }

    /// What an execution came to; who asked is told.
    pub fn executed(&mut self, execution: ExecutionId, outcome: Executed, now: Now) {
        let Some(calls) = &mut self.calls else {
            return;
        };
        let Some(Running { topic, plan, .. }) = calls.executions.remove(&execution) else {
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
                    Ok(fields) => Outcome::Answered {
                        status: StatusCode::GOOD,
                        fields: ActionFields::Variants(fields),
                    },
                    Err(_) => Outcome::Answered {
                        status: BAD_ENCODING_ERROR,
                        fields: ActionFields::NONE,
                    },
                }
            }
            Executed::Failed(status) => Outcome::Answered {
                status: *status,
                fields: ActionFields::NONE,
            },
            Executed::Refused(refusal) => Outcome::Refused(*refusal),
            Executed::Lost => Outcome::Unknown(uadp::action::Unknown::Lost),
        };
        let finished = calls.responder.finish(execution, told, since);
        calls.reckon();
        if let Some((cause, detail)) = fault {
            self.count_call(topic, None, cause, || detail);
        }
        match finished {
            Ok(()) => {}
            // It is what was asked for.
            Err(FinishRefusal::Abandoned) => {
                self.count_call(topic, None, Reason::NotAsked, String::new);
            }
            Err(FinishRefusal::TooBig) => self.count_call(topic, None, Reason::TooBig, || {
                "a response that does not fit a datagram".to_owned()
            }),
            Err(why) => {
                let cause = (Reason::CallRefused, "response");
                self.count_call(topic, None, cause, || why.to_string());
            }
        }
    }
}

impl super::Calls {
    /// Whether a request was meant for this life of the program: one that was started anew is asked by another target once
    /// it has said so.
    fn is_of_this_life(&self, request: &ActionMessage<'_>) -> bool {
        [self.target, LASTING_TARGET].contains(&request.target_id)
    }

    /// Forgets executions of which nothing was heard long after their deadline.
    pub(super) fn forget_executions(&mut self, now: Instant) {
        self.executions
            .retain(|_, running| running.deadline + FORGOTTEN > now);
    }
}

/// A request as the local side has it, or why it has it not.
type ReadRequest = Result<Vec<u8>, (Cause, String)>;
/// The fields of a request, and what they are read with where the local side speaks ROS.
type Executable<'a> = (&'a [u8], Option<Arc<ExecutedPlan>>);

/// The fields of a request that may be executed.
fn may_be_executed<'a>(
    own: Option<&Own>,
    request: &ActionMessage<'a>,
    (from, group): (SocketAddr, SocketAddr),
    known: bool,
) -> Result<Executable<'a>, (Refusal, &'static str, String)> {
    let Some(own) = own else {
        let detail = "it is no call of this program".to_owned();
        return Err((Refusal::NoSuchAction, "unknown", detail));
    };
    if !own.open && !known {
        let detail = format!("{from} is another host, and calls are not open to others");
        return Err((Refusal::NotAllowed, "not allowed", detail));
    }
    let wanted = request.action.response_address.unwrap_or_default();
    if !is_answered_at(wanted, (from, group)) {
        let detail = format!("{from} wants the answer at {wanted:?}, and answers go to {group}");
        return Err((Refusal::NotAllowed, "response address", detail));
    }
    let fields = request.fields.variants();
    fields
        .and_then(|fields| fields.checked_bytes())
        .map(|fields| (fields, own.plan.clone()))
        .map_err(|error| (Refusal::InvalidArgument, "fields", error.to_string()))
}

/// Whether who wants its answer at that ResponseAddress (OPC 10000-14, 7.2.4.4.2) gets it by what is sent to the group: the
/// group's own address is meant, none, or one of the host that asks. To answer where anybody says would attack whom it names.
fn is_answered_at(wanted: &str, (from, group): (SocketAddr, SocketAddr)) -> bool {
    let wanted = wanted.trim();
    let at = PubSub::parse_address(wanted);
    wanted.is_empty() || at.is_some_and(|at| at == group || at.ip() == from.ip())
}

/// Group of the requests of other hosts in clear.
const STRANGERS: usize = 0;
/// Group of the requests of this host in clear.
const LOOPBACK: usize = 1;
/// Group of the requests of the first secured group.
const SECURED: usize = 2;
/// Bad_EncodingError (OPC 10000-6, A.2).
const BAD_ENCODING_ERROR: StatusCode = StatusCode(0x8006_0000);
/// As a Responder has them.
const TIMEOUT: Duration = Duration::from_secs(60);
const MAX_TIMEOUT: Duration = Duration::from_secs(3600);
/// So long after its deadline an execution is not answered any more.
const FORGOTTEN: Duration = Duration::from_secs(60);
