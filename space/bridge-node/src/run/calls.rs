//! Events and outputs between the port and the Router that concern calls, and values that a program
//! describes without a mapping.

use std::sync::Arc;

use bridge_core::{CallDescription, CallMap, Executed, OfferedType, Refusal};
use bytes::Bytes;
use mappings::TopicId;
use messages::ServiceType;
use tracing::{debug, info, warn};
use transport::OutgoingMessage;

use super::{Shell, not_sent};
use crate::clock::now;
use crate::port::{Execution, Port, PortEvent};

impl<P: Port> Shell<P> {
    /// Handles the events of the port that concern calls, and values that the port describes
    /// itself.
    pub(super) fn call_event(&mut self, event: PortEvent) {
        match event {
            PortEvent::Described { topic, description } => {
                self.router.describe_value(topic, description, now());
            }
            PortEvent::BoundAs {
                topic,
                message_type,
                note,
            } => {
                let bound = self.router.bind_as(topic, (&message_type, note), now());
                if let Err(error) = bound {
                    let name = self.router.name_of(topic);
                    warn!(%topic, %error, name, "cannot bridge the value of the action");
                }
            }
            PortEvent::CallBound {
                topic,
                service_type,
                map,
            } => self.bind_call(topic, (&service_type, &map)),
            PortEvent::CallUnbound { topic } => self.router.unbind_call(topic),
            PortEvent::CallWanted { topic } => self.router.want_call(topic, now()),
            PortEvent::Ask {
                ask,
                topic,
                request,
                timeout,
            } => self.router.ask(ask, (topic, &request), timeout, now()),
            PortEvent::AskGivenUp { ask } => self.router.give_up(ask, now()),
            PortEvent::Offer { topic, offered } => self.router.offer(topic, offered, now()),
            PortEvent::OfferTyped { topic, offered } => self.offer_typed(topic, &offered),
            PortEvent::Withdrawn { topic } => self.router.withdraw(topic, now()),
            PortEvent::Executed { execution, outcome } => {
                self.router.executed(execution, outcome, now());
            }
            // The caller handles them.
            PortEvent::Sample { .. }
            | PortEvent::Qualified { .. }
            | PortEvent::Bound { .. }
            | PortEvent::Unbound { .. }
            | PortEvent::Left { .. }
            | PortEvent::Live { .. }
            | PortEvent::Lost { .. }
            | PortEvent::Dropped { .. }
            | PortEvent::Unmatched { .. }
            | PortEvent::CallFailed { .. }
            | PortEvent::Ended(_) => {}
        }
    }

    fn bind_call(
        &mut self,
        topic: TopicId,
        (service_type, map): (&Arc<ServiceType>, &Arc<CallMap>),
    ) {
        let bound = self.router.bind_call(topic, (service_type, map), now());
        let service_type = service_type.name();
        let name = self.router.name_of(topic);
        match bound {
            Ok(()) => debug!(%topic, %service_type, name, "knows the types of the call"),
            Err(why) => warn!(%topic, %service_type, name, "the call is not available here: {why}"),
        }
    }

    fn offer_typed(&mut self, topic: TopicId, offered: &OfferedType) {
        let service_type = offered.service_type.name();
        match self.router.offer_type(topic, offered, now()) {
            Ok(()) => {
                info!(%topic, %service_type, name = offered.name, "executing the calls of the space with this service")
            }
            Err(why) => {
                warn!(%topic, %service_type, name = offered.name, "not executing the calls of the space with this service: {why}")
            }
        }
    }

    /// Sends a request or a response.
    pub(super) fn send_action(&mut self, topic: TopicId, bytes: Vec<u8>) {
        let message = OutgoingMessage {
            within: self.carrier.within(),
            ..OutgoingMessage::new(&bytes)
        };
        if let Err(error) = self.send(&message) {
            self.router
                .not_called(topic, not_sent(error), &error.to_string());
        }
        self.router.recycle(bytes);
    }

    /// Passes a call of another program to the port.
    pub(super) fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        debug!(%topic, name = description.name, "another program offers a call");
        self.observe(|observer| observer.call_known(topic, description));
        if self.router.is_standby() {
            // The active bridge offers it: two servers of one name would both get each request.
            return;
        }
        self.port.call_known(topic, description);
    }

    /// Offers the calls of other programs on the local side, or withdraws them, after a change of
    /// the role.
    pub(super) fn offer_calls_of_others(&mut self, offers: bool) {
        let known: Vec<(TopicId, Arc<CallDescription>)> = self
            .router
            .calls()
            .filter_map(|(topic, _)| {
                let description = self.router.described_call(topic)?;
                Some((topic, Arc::clone(description)))
            })
            .collect();
        for (topic, description) in known {
            if offers {
                self.port.call_known(topic, &description)
            } else {
                self.port.call_gone(topic)
            }
        }
    }

    /// Removes a call of another program from the port.
    pub(super) fn call_gone(&mut self, topic: TopicId) {
        debug!(%topic, name = self.router.name_of(topic), "a program withdrew its call");
        self.observe(|observer| observer.call_gone(topic));
        self.port.call_gone(topic);
    }

    /// Lets the port execute a request.
    pub(super) fn execute(&mut self, execution: bridge_core::CallExecution) {
        let bridge_core::CallExecution {
            id,
            topic,
            request,
            requestor,
            deadline,
            start_by,
        } = execution;
        let execution = Execution {
            id,
            topic,
            request: Bytes::from(request),
            requestor,
            deadline,
            start_by,
        };
        if self.dry_run || !self.port.execute(execution) {
            let refused = Executed::Refused(Refusal::NotExecutable);
            self.router.executed(id, refused, now());
        }
    }

    /// Reports a namespace that another program writes, or that is free again.
    pub(super) fn taken(&mut self, namespace: u16, by: Option<std::net::SocketAddr>, name: &str) {
        if let Some(by) = by {
            let why = self.why_taken(namespace, by, name);
            warn!("{why}");
            self.taken.insert(namespace, why);
        } else {
            info!(namespace, "the namespace is free: publishing in it");
            self.taken.remove(&namespace);
        }
        self.port.taken(namespace, by);
    }

    /// Returns why this program publishes nothing in a namespace that another program writes;
    /// `name` is empty if the other program does not announce which namespaces it carries.
    fn why_taken(&self, namespace: u16, by: std::net::SocketAddr, name: &str) -> String {
        let (own, program) = (self.own, self.program);
        if name.is_empty() {
            return format!(
                "namespace {namespace} of space {own} is in use from {by}: this program publishes nothing \
                 in it; give this program another namespace, or stop the other program"
            );
        }
        format!(
            "namespace {namespace} of space {own} is carried by {name} ({by}) and by this {program}: this \
             program carries nothing in it; list it in --namespaces of one of them only"
        )
    }
}
