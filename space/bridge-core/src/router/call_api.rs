//! The inputs and queries of a Router that concern calls. [`CallTraffic`] does the work.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use mappings::{SpaceId, TopicId};
use messages::ServiceType;
use uadp::action::{ActionDialect, ActionKind, ExecutionId};
use uadp::discovery::{AnnouncedContent, Announcement, DataSetMetaDataType};
use uadp::{NetworkMessage, PublisherId, SecurityHeader};

use super::announce::BAD_NOT_FOUND;
use super::calls::CallTraffic;
use super::{DropSite, Router};
use crate::call::{
    AskId, CallCounters, CallDescription, CallMap, CallTypeError, Executed, OfferedCall,
    OfferedType, join_name,
};
use crate::counters::Reason;
use crate::late;
use crate::output::Output;
use crate::settings::Now;

impl Router {
    /// Returns the calls with the parts of the Router that they use.
    pub(super) fn call_traffic(&mut self) -> CallTraffic<'_> {
        CallTraffic {
            calls: &mut self.calls,
            values: &mut self.values,
            announcements: &mut self.announcements,
            security: &self.security,
            senders: &self.redundant_senders,
            instance: self.instance,
        }
    }

    /// Returns the calls after a check of the lease. Without the check, a redundant bridge that was
    /// stopped for some time would send requests and start executions as if it were still active.
    fn checked_call_traffic(&mut self, now: Now) -> CallTraffic<'_> {
        self.check_lease(now);
        self.call_traffic()
    }

    /// Sets the random bytes of this program instance. They are used to seal messages in secured
    /// groups, and to distinguish own requests from requests of other programs of the space and of
    /// earlier instances. Call it before the first call is known.
    pub fn set_instance(&mut self, instance: [u8; 16]) {
        self.instance = instance;
        self.security.set_instance(instance);
    }

    /// Returns the counters of each call that is known, requested or executed, in no particular
    /// order.
    pub fn calls(&self) -> impl Iterator<Item = (TopicId, &CallCounters)> {
        self.calls.iter().flat_map(|calls| calls.counters())
    }

    /// Returns the description of a call of another program, if the call has an executor.
    #[must_use]
    pub fn described_call(&self, topic: TopicId) -> Option<&Arc<CallDescription>> {
        self.calls.as_ref()?.described(topic)
    }

    /// Binds a call to the service type with which the local side requests it. `map` assigns fields
    /// that are not assigned by name. If the call is not known yet, its executor is probed, and the
    /// type is checked when its description arrives.
    ///
    /// # Errors
    /// Returns the reason if the known call does not fit the type. The call stays bound
    /// nevertheless, because its description may change.
    pub fn bind_call(
        &mut self,
        topic: TopicId,
        target: (&Arc<ServiceType>, &Arc<CallMap>),
        now: Now,
    ) -> Result<(), CallTypeError> {
        self.call_traffic().bind_call(topic, target, now)
    }

    /// Unbinds a call. Pending requests are still answered.
    pub fn unbind_call(&mut self, topic: TopicId) {
        self.call_traffic().unbind_call(topic);
    }

    /// Records that the local side has a client for a call. If the call is not known, its executor
    /// is probed.
    pub fn want_call(&mut self, topic: TopicId, now: Now) {
        self.call_traffic().want_call(topic, now);
    }

    /// Sends a request. The outcome is output as [`Output::Answer`] within `timeout` or soon after,
    /// unless the request is [given up](Self::give_up). Each `ask` is used once.
    pub fn ask(&mut self, ask: AskId, request: (TopicId, &[u8]), timeout: Duration, now: Now) {
        self.checked_call_traffic(now)
            .ask(ask, request, timeout, now);
    }

    /// Gives up a request. It has no outcome, and its executor is informed.
    pub fn give_up(&mut self, ask: AskId, now: Now) {
        self.call_traffic().give_up(ask, now);
    }

    /// Records that a request or response could not be sent. It is sent again.
    pub fn not_called(&mut self, topic: TopicId, reason: Reason, detail: &str) {
        self.call_traffic().not_called(topic, reason, detail);
    }

    /// Adds or changes a call that the local side executes, and announces it. Calls of namespaces
    /// that this program does not own are ignored.
    pub fn offer(&mut self, topic: TopicId, offered: OfferedCall, now: Now) {
        self.call_traffic().offer(topic, offered, now);
    }

    /// Adds a ROS service of the local side as [`offer`](Self::offer) does. Requests and responses
    /// are ROS messages in the local encoding.
    ///
    /// # Errors
    /// Returns the reason if the type cannot be executed, or if the payloads of the local side are
    /// fields.
    pub fn offer_type(
        &mut self,
        topic: TopicId,
        offered: &OfferedType,
        now: Now,
    ) -> Result<(), CallTypeError> {
        self.call_traffic().offer_type(topic, offered, now)
    }

    /// Ends an execution with its outcome, which is sent to the requestor.
    pub fn executed(&mut self, execution: ExecutionId, outcome: Executed, now: Now) {
        self.call_traffic().executed(execution, outcome, now);
    }

    /// Removes an own call or value that the local side does not have any more, and announces the
    /// removal. Running executions continue.
    pub fn withdraw(&mut self, topic: TopicId, now: Now) {
        if !self.values.is_home(topic) {
            return;
        }
        self.call_traffic().withdraw_own(topic);
        self.unbind(topic, now);
        self.announcements.forget(&mut self.values, topic);
        let withheld = self.values.is_withheld(topic);
        if !withheld {
            self.announce_none(topic);
        }
    }

    /// Removes all own calls, and all own values that are not in the mapping, before the end of the
    /// program. Each is removed as in [`withdraw`](Self::withdraw).
    pub fn withdraw_all(&mut self, now: Now) {
        let calls = self.calls.iter().flat_map(|calls| calls.own());
        let said = self
            .values
            .topics
            .iter()
            .filter(|(_, entry)| entry.said.is_some());
        let topics = calls.chain(said.map(|(topic, _)| topic));
        let topics: Vec<TopicId> = topics.collect();
        for topic in topics {
            self.withdraw(topic, now);
        }
    }

    /// Announces that the topic does not exist.
    fn announce_none(&mut self, topic: TopicId) {
        let (space, _, writer_id) = topic.triple();
        let announcement = Announcement {
            sequence_number: 0,
            announced: AnnouncedContent::DataSetMetaData {
                writer_id,
                meta_data: DataSetMetaDataType {
                    name: Some(&join_name(topic, "")),
                    ..DataSetMetaDataType::default()
                },
                status: BAD_NOT_FOUND,
            },
        };
        let mut bytes = self.values.buffer();
        let publisher = PublisherId::UInt16(space);
        if announcement
            .encode(publisher, SecurityHeader::NONE, &mut bytes)
            .is_ok()
        {
            self.values.tell(Output::Discovery { bytes });
        }
    }

    /// Handles the requests and responses in a message from or to the Publisher of `space`.
    pub(super) fn handle_actions(
        &mut self,
        message: &NetworkMessage<'_>,
        (space, from): (SpaceId, SocketAddr),
        now: Now,
    ) {
        let actions = match message.actions(ActionDialect::Standard) {
            Ok(actions) => actions,
            Err(error) => return self.values.drop_undecoded(None, from, &error),
        };
        for action in actions {
            let action = match action {
                Ok(action) => action,
                Err(error) => {
                    self.values.drop_undecoded(None, from, &error);
                    continue;
                }
            };
            let namespace = action.writer_group_id.unwrap_or_default();
            let topic = TopicId::new(u16::from(space.get()), namespace, action.writer_id);
            if self.values.part.is_some() && !self.values.carries(namespace) {
                continue;
            }
            match (topic, action.action.kind) {
                (None, _) => {
                    self.values
                        .count(DropSite::sender(from), Reason::NotInSpace, 1, String::new)
                }
                (Some(topic), ActionKind::Request) if self.values.is_untimed(&message.header()) => {
                    let cause = late::cause(late::UNTIMED);
                    self.call_traffic()
                        .count_call(topic, Some(from), cause, || late::NO_TIME.to_owned());
                }
                (Some(topic), ActionKind::Request)
                    if self
                        .values
                        .is_given_up(&message.header(), action.action.timeout(), now) =>
                {
                    let cause = late::cause(late::GIVEN_UP);
                    self.call_traffic()
                        .count_call(topic, Some(from), cause, || {
                            "its caller has stopped waiting".to_owned()
                        });
                }
                (Some(topic), ActionKind::Request) => {
                    self.checked_call_traffic(now)
                        .handle_request(topic, &action, from, now);
                }
                (Some(_), ActionKind::Response)
                    if self.is_confirmation(&action, (space, from), now) => {}
                (Some(topic), ActionKind::Response) => {
                    self.call_traffic()
                        .handle_response(topic, &action, from, now);
                }
            }
        }
        self.call_traffic().settle(now);
    }

    /// Returns whether a chunk of a request or response waits for the pace.
    pub(super) fn is_chunking(&self) -> bool {
        self.calls.as_ref().is_some_and(|calls| calls.is_chunking())
    }
}
