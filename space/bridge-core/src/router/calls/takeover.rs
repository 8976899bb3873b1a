//! Calls of redundant bridges: the announcements of a new active bridge, and the requests and
//! executions of a bridge that is not active any more.
//!
//! A request is never executed twice: each term of an active bridge has an ActionTargetId of its
//! own, which requestors read in its announcements. A request to a former active bridge, which may
//! have executed it, is answered as unknown.

use mappings::TopicId;
use uadp::StatusCode;
use uadp::action::{ActionOutcome, CallId, Refusal, Unknown};

use super::CallTraffic;
use crate::call::{AskError, AskErrorKind};
use crate::call_announcement::{target_of, target_of_term};
use crate::counters::{DropCause, Reason};
use crate::output::Output;
use crate::settings::Now;

impl CallTraffic<'_> {
    /// Returns the ActionTargetId of the own calls in the present term.
    pub(super) fn target(&self) -> u16 {
        match self.values.redundancy() {
            Some(state) => target_of_term(self.instance, state.rank(), state.counts().takeovers),
            None => target_of(self.instance),
        }
    }

    /// Begins a term as the active bridge: announces the own calls before anything else is sent.
    pub(in super::super) fn begin_term(&mut self, now: Now) {
        let target = self.target();
        let Some(calls) = &mut self.calls else {
            return;
        };
        calls.target = target;
        let own = calls.table.iter().filter(|(_, call)| call.own.is_some());
        let mut own: Vec<TopicId> = own.map(|(topic, _)| *topic).collect();
        own.sort_unstable();
        for topic in own.into_iter().take(MOST_AT_ONCE) {
            calls.announce(self.values, topic, 0, now);
        }
        // All of them are announced once more, because an announcement may be lost.
        self.announce_calls(now);
    }

    /// Ends the term as the active bridge. Executions that the local side has not received do not
    /// start. Requests that their executor has not confirmed are not sent any more. Confirmed
    /// requests still wait for their responses.
    pub(in super::super) fn end_term(&mut self, now: Now) {
        let Some(calls) = &mut self.calls else {
            return;
        };
        let since = calls.since_start(now);
        let mut late = Vec::new();
        for _ in 0..calls.news.len() {
            match calls.news.pop_front() {
                Some(Output::Execute(execution)) => late.push(execution),
                other => calls.news.extend(other),
            }
        }
        for execution in late {
            let Some(calls) = &mut self.calls else {
                return;
            };
            calls.executions.remove(&execution.id);
            // The requestor receives the outcome from this program if it is active again.
            let _told = calls
                .responder
                .finish(execution.id, ActionOutcome::Unknown(Unknown::Lost), since)
                .is_ok();
            self.values.recycle(execution.request);
            let cause = (Reason::Takeover, "execution");
            self.count_call(execution.topic, None, cause, String::new);
        }
        let Some(calls) = &mut self.calls else {
            return;
        };
        let asked = calls.asked.keys().copied();
        let unsent: Vec<CallId> = asked
            .filter(|id| !calls.requestor.is_received(*id))
            .collect();
        for id in unsent {
            self.give_up_request(id, now);
        }
    }

    fn give_up_request(&mut self, id: CallId, now: Now) {
        let Some(calls) = &mut self.calls else {
            return;
        };
        let since = calls.since_start(now);
        calls.requestor.abandon(id, since);
        let Some(asked) = calls.close(id) else {
            return;
        };
        calls.reckon();
        if let Some(call) = calls.table.get_mut(&asked.topic) {
            call.counters.unknown += 1;
        }
        // It may have been sent.
        let (cause, error) = not_asked(false);
        calls.news.push_back(Output::Answer {
            ask: asked.ask,
            topic: asked.topic,
            answer: Err(error),
        });
        self.count_call(asked.topic, None, cause, String::new);
    }
}

/// Returns the outcome of a request that this program does not send, because another bridge of the
/// space is active: the other bridge may have received the request of the local side too.
///
/// The clients of a server that shows values at standby are connected to a single server, so that
/// the request is refused.
pub(super) fn not_asked(is_server: bool) -> (DropCause, AskError) {
    if is_server {
        let text = "this server is the standby of a redundant set; call the Method at the server with the higher \
                    ServiceLevel";
        let error = AskError::refused(Refusal::NotExecutable, text);
        return ((Reason::CallRefused, "standby").into(), error);
    }
    let text =
        "this redundant bridge is not active, so it is unknown whether the call was executed";
    (
        (Reason::Takeover, "request").into(),
        unknown(text.to_owned()),
    )
}

/// Returns the outcome of a request that this program does not send, because another bridge of the
/// space carries the namespace: that bridge may have received the request of the local side too.
pub(super) fn not_carried(namespace: u16) -> (DropCause, AskError) {
    let text = format!(
        "another bridge of the space carries namespace {namespace}, so it is unknown whether the call was executed"
    );
    ((Reason::SpaceTaken, "request").into(), unknown(text))
}

const fn unknown(text: String) -> AskError {
    AskError {
        kind: AskErrorKind::Unknown,
        status: BAD_NO_COMMUNICATION,
        text,
    }
}

/// Bad_NoCommunication (OPC 10000-6, A.2).
const BAD_NO_COMMUNICATION: StatusCode = StatusCode(0x8031_0000);
/// The maximum number of calls that are announced in the moment of a takeover.
const MOST_AT_ONCE: usize = 256;
