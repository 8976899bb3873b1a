//! Calls: asking for those of other programs, and executing our own.

use std::sync::Arc;
use std::time::Duration;

use mappings::TopicId;
use messages::ServiceType;
use uadp::action::{ExecutionId, Refusal};

use super::Router;
use crate::call::{AskError, AskId, CallDescription, Executed, Offered, ValueDescription};
use crate::counters::Reason;
use crate::loop_rule::Owned;
use crate::output::Output;
use crate::settings::Now;

impl Router {
    /// Says which namespaces of the space this program alone writes.
    pub fn set_owned(&mut self, owned: Owned, now: Now) {
        let _ = now;
        self.owned = owned;
    }

    /// Gives it random bytes.
    pub fn set_instance(&mut self, instance: [u8; 16]) {
        let _ = (instance, self);
    }

    /// Claims.
    pub fn claim(&mut self, now: Now) {
        let _ = (now, self);
    }

    pub(super) fn contend(&mut self, namespace: u16, from: std::net::SocketAddr, now: Now) {
        let _ = (namespace, from, now, self);
    }

    /// Describes.
    pub fn describe_value(&mut self, topic: TopicId, description: ValueDescription, now: Now) {
        let _ = (topic, description, now, self);
    }

    /// Binds.
    ///
    /// # Errors
    /// It does not fit.
    pub fn bind_call(
        &mut self,
        topic: TopicId,
        service: &Arc<ServiceType>,
        now: Now,
    ) -> Result<(), String> {
        let _ = (topic, service, now, self);
        Ok(())
    }

    /// Unbinds.
    pub fn unbind_call(&mut self, topic: TopicId) {
        let _ = (topic, self);
    }

    /// Wants.
    pub fn want_call(&mut self, topic: TopicId, now: Now) {
        let _ = (topic, now, self);
    }

    /// Asks.
    pub fn ask(&mut self, ask: AskId, topic: TopicId, request: &[u8], timeout: Duration, now: Now) {
        let _ = (request, timeout, now);
        let answer = Err(AskError::refused(Refusal::NoSuchAction, "not built yet"));
        self.tell(Output::Answer { ask, topic, answer });
    }

    /// Gives up.
    pub fn give_up(&mut self, ask: AskId, now: Now) {
        let _ = (ask, now, self);
    }

    /// What it is.
    #[must_use]
    pub fn described_call(&self, topic: TopicId) -> Option<&Arc<CallDescription>> {
        let _ = (topic, self);
        None
    }

    /// Offers.
    pub fn offer(&mut self, topic: TopicId, offered: Offered, now: Now) {
        let _ = (topic, offered, now, self);
    }

    /// Withdraws.
    pub fn withdraw(&mut self, topic: TopicId, now: Now) {
        let _ = (topic, now, self);
    }

    /// Executed.
    pub fn executed(&mut self, execution: ExecutionId, outcome: Executed, now: Now) {
        let _ = (execution, outcome, now, self);
    }

    /// Not called.
    pub fn not_called(&mut self, topic: TopicId, reason: Reason, detail: &str) {
        let _ = (topic, reason, detail, self);
    }
}
