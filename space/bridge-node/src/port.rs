//! The local side that a bridge program provides to the run loop.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bridge_core::{
    Application, AskId, CallDescription, CallMap, CallResponse, ConfirmedArrival, Executed,
    ExecutionId, Handover, OfferedCall, OfferedType, PublisherKey, Reason, Router, TopicMetaData,
    ValueDescription, ValueNote, ValueRelation, Verdict,
};
use bytes::Bytes;
use mappings::{Mapping, TopicId};
use messages::{MessageType, Selection, ServiceType};
use serde::Serialize;
use type_files::TypePaths;
use uadp::{BuiltinType, Timestamp};

use crate::awaited::AwaitedPeers;

/// The local side of a bridge: a ROS 1 graph, a DDS domain, or an OPC UA address space.
///
/// The run loop polls [`recv`](Self::recv) beside the socket, and passes on the output of the
/// Router. Topic names are resolved once, when a port subscribes; the samples carry the
/// [`TopicId`].
pub trait Port: Send + 'static {
    /// Returns the next event of this side. Cancel-safe: dropping the future loses nothing. Pends
    /// while there is no event.
    fn recv(&mut self) -> impl Future<Output = PortEvent> + Send;

    /// Publishes a sample of another space. Never waits.
    ///
    /// `payload` is a ROS 1 message body without its length, a CDR message with its 4 byte
    /// encapsulation header, or a block of OPC UA fields, as the [`Local`](bridge_core::Local) of
    /// the port sets it.
    ///
    /// # Errors
    /// A short reason under which the sample is counted as dropped.
    fn publish(&mut self, sample: LocalDelivery) -> Result<(), &'static str>;

    /// Returns the handover of the last [published](Self::publish) value of a topic that is
    /// confirmed.
    fn handover(&self, topic: TopicId) -> Handover {
        let _shown_at_once = topic;
        Handover::Done
    }

    /// Notes the verdict for a reported sample. The result of a sample that is not dropped follows
    /// by [`left`](Self::left) or [`drained`](Self::drained); earlier calls of these are about
    /// earlier samples. [`Router::unsent`] returns which samples wait.
    fn handled(&mut self, topic: TopicId, verdict: Verdict, router: &Router) {
        let _nobody_waits = (topic, verdict, router);
    }

    /// Notes that a datagram with a sample of this side was sent to the group, or the reason why it
    /// is not sent. The sample may be a repetition, or one of the chunks of a large sample.
    fn left(&mut self, topic: TopicId, sent: Result<(), Reason>, router: &Router) {
        let _nobody_waits = (topic, sent, router);
    }

    /// Notes that the outputs of all handled events were carried out. A handled sample that has
    /// not [`left`](Self::left) waits for its turn or was dropped; if this program is muted because
    /// another program is active, it is not sent.
    fn drained(&mut self, is_muted: bool, router: &Router) {
        let _nobody_waits = (is_muted, router);
    }

    /// Receives the outcome of the newest value of a topic of this side that bridges confirm.
    fn settled(&mut self, topic: TopicId, arrival: &ConfirmedArrival) {
        let _nobody_waits = (topic, arrival);
    }

    /// Requests the local type of a value of another space, after the Router has received the value
    /// or its description by the writer. The port chooses a type (mapping, then a local subscriber,
    /// then the description, then the standard type of the value) and reports [`PortEvent::Bound`],
    /// at once or when a subscriber arrives. Called again while values arrive.
    fn wanted(
        &mut self,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&TopicMetaData>,
    );

    /// Notes that a topic of another space had no good value for its receive timeout, or has one
    /// again. Either its writer is silent, or all its values are dropped, possibly by
    /// [`publish`](Self::publish).
    fn silent(&mut self, topic: TopicId, silent: bool);

    /// Notes that one of the concurrent values of a topic is not available to late joiners any
    /// more: the value delivered with this [`instance`](LocalDelivery::instance). No effect for a
    /// side that keeps only the last value.
    fn retired(&mut self, topic: TopicId, instance: Timestamp) {
        let _one_value = (topic, instance);
    }

    /// Drops the published values that wait on this side or are stored for late joiners, because
    /// another bridge publishes from this moment on. With `at_once` they are old, and no present
    /// subscriber may receive them either. Waiting values are reported as [`PortEvent::Lost`].
    fn drop_waiting(&mut self, at_once: bool) {
        let _nothing_waits = at_once;
    }

    /// Notes that this program is the active one of the redundant programs of its space, or is not
    /// any more.
    fn role_changed(&mut self, is_active: bool) {
        let _alone = is_active;
    }

    /// Notes the addresses of this host that have lost their link, repeatedly while it lasts; an
    /// empty list when all links are back. What is sent meanwhile is not to arrive late.
    fn links_lost(&mut self, lost: &[IpAddr]) {
        let _no_connections = lost;
    }

    /// Notes that a call of another program is available or has changed.
    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        let _not_served = (topic, description);
    }

    /// Notes that a call has no executor any more. Open requests are still answered.
    fn call_gone(&mut self, topic: TopicId) {
        let _not_served = topic;
    }

    /// Receives the outcome of a request that was reported as [`PortEvent::Ask`].
    fn answered(&mut self, ask: AskId, topic: TopicId, answer: CallResponse<Bytes>) {
        let _never_asked = (ask, topic, answer);
    }

    /// Executes a request for a call that was reported as [`PortEvent::Offer`]. The outcome is
    /// reported as [`PortEvent::Executed`]. Never waits. Returns false if the request is not
    /// executed; then no outcome is reported.
    fn execute(&mut self, execution: Execution) -> bool {
        let _never_offered = execution;
        false
    }

    /// Notes that the caller has given up an execution. It is still to be reported as executed.
    fn abandoned(&mut self, execution: ExecutionId, topic: TopicId) {
        let _goes_on = (execution, topic);
    }

    /// Notes that another participant writes a namespace of ours, so that we do not send in it; or,
    /// with `None`, that the conflict has ended. The program is not ready during a conflict, and a
    /// message is logged.
    fn taken(&mut self, namespace: u16, by: Option<SocketAddr>) {
        let _told_by_the_shell = (namespace, by);
    }

    /// Replaces the mapping. Entries that are the same in both mappings stay undisturbed. Entries
    /// of the old mapping only are given up ([`PortEvent::Unbound`]), and entries of the new
    /// mapping only are added. Returns the keys of the mapping that cannot change while the program
    /// runs, each with the reason, as text for the user. `types` are the definitions of its
    /// `type_paths`, which may have changed although the mapping has not.
    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String>;

    /// Receives the counters of the Router every second, for sides that show them.
    fn counted(&mut self, router: &Router) {
        let _shown_by_the_shell = router;
    }

    /// Returns the reason why this side cannot work at the moment, such as a ROS master that does
    /// not answer, as text for the user.
    fn hindrance(&self) -> Option<String> {
        None
    }

    /// Returns the ServiceLevel of an OPC UA server among redundant servers, which the others show.
    fn service_level(&self) -> Option<u8> {
        None
    }

    /// Adds the peers of this side that the mapping needs and that are missing, such as a topic
    /// without a publisher. Called by the run loop each second.
    fn add_awaited(&self, missing: &mut AwaitedPeers) {
        let _needs_no_peers = missing;
    }

    /// Returns the servers that this side is connected to, or tries to connect to.
    fn links(&self) -> Vec<LinkState> {
        Vec::new()
    }

    /// Describes the OPC UA certificate of this side, for `/status`.
    fn certificate(&self) -> Option<serde_json::Value> {
        None
    }

    /// Prepares for the end of the program: executions elsewhere that have to end with the program
    /// are cancelled. The run loop continues until nothing is [pending](Self::pending), 5 s at
    /// most. Never waits.
    fn closing(&mut self) {}

    /// Lists goals and runs with a pending cancellation, a line each. Their outcome is not known
    /// yet.
    fn pending(&self) -> Vec<String> {
        Vec::new()
    }

    /// Returns the description of the program for discovery of the applications in the group.
    /// `None` if the program is not a server; the run loop then describes it.
    fn application(&self) -> Option<Application> {
        None
    }

    /// Returns the topics and calls of other programs that this side uses when it starts. Values,
    /// descriptions and calls of other namespaces are then dropped by their headers, except for
    /// calls that are wanted later ([`PortEvent::CallWanted`]). `None` if it may use any of them.
    fn used_topics(&self) -> Option<Vec<TopicId>> {
        None
    }

    /// Returns the addresses of this host that this side has used since its start and cannot
    /// change; an empty list stands for all addresses. `None` if its library follows changes.
    fn addresses(&self) -> Option<&[IpAddr]> {
        None
    }

    /// Withdraws every registration and ends. Bounded by 2 s.
    fn shutdown(self) -> impl Future<Output = ()> + Send;
}

/// A server that a side has a link to, by its name in the mapping, with counters since the start.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct LinkState {
    /// Its name in the mapping.
    pub name: String,
    /// Its URL.
    pub url: String,
    /// Whether it is connected.
    pub up: bool,
    /// Whether the connection is signed and encrypted.
    pub secured: bool,
    /// The reason why there is no connection, as text for the user.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// Number of established connections.
    pub connects: u64,
    /// Number of refused certificates of the server, counting each attempt to connect.
    pub certificates_refused: u64,
    /// Number of received values, of any quality.
    pub values: u64,
    /// Number of written values.
    pub written: u64,
    /// Number of values not written: refused by the server, expired in the queue, or replaced by
    /// newer values.
    pub not_written: u64,
    /// Unavailable items by their names in the mapping, with the reasons.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, String>,
}

/// A request for the local side to execute.
pub type Execution = bridge_core::CallExecution<Bytes>;

/// A value of another space on its way to the local side.
#[derive(Debug, Clone)]
pub struct LocalDelivery {
    /// The value's topic.
    pub topic: TopicId,
    /// The payload in the port's encoding.
    pub payload: Bytes,
    /// Time at which the producer's bridge took the value (the DataSetMessage Timestamp, or the
    /// SourceTimestamp of a DataValue), if the writer sends it.
    pub source: Option<Timestamp>,
    /// The status of the message or of its DataValue: the upper 16 bits of an OPC UA StatusCode, 0
    /// for Good.
    pub status: u16,
    /// The DataSetMessage Timestamp, if it identifies this value among the values of the topic.
    pub instance: Option<Timestamp>,
    /// The relation of the value to the other values of its topic.
    pub kept: ValueRelation,
    /// Whether late subscribers receive it: it is a state, not an event.
    pub lasting: bool,
}

/// An event that a port reports.
#[derive(Debug)]
pub enum PortEvent {
    /// The local type of a topic is known or has changed: values can be transcoded from this event
    /// on.
    Bound {
        /// The value's topic.
        topic: TopicId,
        /// Its message type in the port's dialect.
        message_type: Arc<MessageType>,
        /// The part of the message that is the value.
        selection: Selection,
    },
    /// Binds a value, as `Bound` does, that no mapping names, by the names of its fields.
    BoundAs {
        /// The value's topic.
        topic: TopicId,
        /// Its message type in the port's dialect.
        message_type: Arc<MessageType>,
        /// Its metadata and queue settings.
        note: ValueNote,
    },
    /// The local side has dropped a topic, or will bind it to something else, because the mapping
    /// has changed.
    Unbound {
        /// The value's topic.
        topic: TopicId,
    },
    /// A message was received on a topic of our own space.
    Sample {
        /// The value's topic; a message that several variables select from is reported once for
        /// each.
        topic: TopicId,
        /// The message as received.
        payload: Bytes,
        /// Time of reception.
        received: Timestamp,
        /// The key of the publisher, if that publisher latches: constant while the publisher
        /// exists, and unique among the publishers of the topic.
        latched_by: Option<PublisherKey>,
    },
    /// A sample, as `Sample`, of a side that knows the quality of its values.
    Qualified {
        /// The value's topic.
        topic: TopicId,
        /// The payload in the port's encoding.
        payload: Bytes,
        /// Time at which the value was taken.
        taken: Timestamp,
        /// The upper 16 bits of its OPC UA StatusCode; 0 for Good.
        status: u16,
    },
    /// A latched publisher has left for good: its last message is not available to late joiners any
    /// more.
    Left {
        /// The value's topic.
        topic: TopicId,
        /// The publisher key of its samples.
        publisher: PublisherKey,
    },
    /// A topic of our own space has gained its first producer, or lost its last producer.
    Live {
        /// The value's topic.
        topic: TopicId,
        /// Whether it has a publisher.
        live: bool,
    },
    /// Something other than a sample of a value was dropped.
    Dropped {
        /// The counter.
        reason: Reason,
        /// The dropped item, in two or three words.
        why: &'static str,
        /// The number of dropped items.
        count: u64,
    },
    /// Samples were lost before the Router saw them, such as in a bounded queue that was full.
    Lost {
        /// The value's topic, if it is known.
        topic: Option<TopicId>,
        /// The counter.
        reason: Reason,
        /// The reason, in two or three words; the counter's label.
        why: &'static str,
        /// The number of lost samples.
        count: u64,
    },
    /// A publisher or subscriber of the topic has settings that are incompatible with ours, so that
    /// no messages pass between them. Counted; the port logs it.
    Unmatched {
        /// The value's topic.
        topic: TopicId,
    },
    /// A call failed: a value could not be passed to its service, no service answered with it, or
    /// an execution for another space failed.
    CallFailed {
        /// The topic of the value or call.
        topic: TopicId,
        /// The failure, for the log.
        detail: String,
    },
    /// The description of a value of our own space, if the port uses fields and no mapping
    /// describes the value.
    Described {
        /// The value's topic.
        topic: TopicId,
        /// The description.
        description: ValueDescription,
    },
    /// The local side starts to send requests to a call under this type.
    CallBound {
        /// The call's topic.
        topic: TopicId,
        /// Its type in the port's dialect.
        service_type: Arc<ServiceType>,
        /// The fields that are not mapped by name.
        map: Arc<CallMap>,
    },
    /// The local side has stopped sending requests to a call, or will use another type.
    CallUnbound {
        /// The call's topic.
        topic: TopicId,
    },
    /// The local side has a potential caller of a call: its description is requested from its
    /// executor.
    CallWanted {
        /// The call's topic.
        topic: TopicId,
    },
    /// A request of the local side.
    Ask {
        /// The id of the request.
        ask: AskId,
        /// The call's topic.
        topic: TopicId,
        /// The payload in the port's encoding.
        request: Bytes,
        /// How long to wait for the response.
        timeout: Duration,
    },
    /// The caller has given up: the request is not answered any more, and its executor is notified.
    AskGivenUp {
        /// The id of the request.
        ask: AskId,
    },
    /// The local side executes a call of its own from this event on, or its description has
    /// changed.
    Offer {
        /// The call's topic, in a namespace that the program owns.
        topic: TopicId,
        /// The description of the call.
        offered: OfferedCall,
    },
    /// Offers a call, as `Offer` does, for a ROS service: requests and responses are ROS messages.
    OfferTyped {
        /// The call's topic, in a namespace that the program owns.
        topic: TopicId,
        /// The type and description of the call.
        offered: OfferedType,
    },
    /// The local side has stopped executing a call of its own, or has dropped a value of its own.
    Withdrawn {
        /// The topic of the call or value.
        topic: TopicId,
    },
    /// The outcome of an execution.
    Executed {
        /// The id of the execution.
        execution: ExecutionId,
        /// Its outcome.
        outcome: Executed,
    },
    /// The port cannot continue, for example because a ROS 1 node was shut down by another node of
    /// the same name. The program ends with this message.
    Ended(String),
}
