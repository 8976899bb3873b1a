//! What a bridge program brings to the shell: its own side of the bridge.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use bridge_core::{
    Answered, Application, Arrival, AskId, CallDescription, CallMap, Described, Executed,
    ExecutionId, Handover, Kept, Offered, OfferedType, PublisherKey, Reason, Router,
    ValueDescription, ValueNote,
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
/// The shell polls [`recv`](Self::recv) beside the socket, and hands over what the Router lets
/// pass. Topic names are resolved once, when a port subscribes; the samples carry the [`TopicId`].
pub trait Port: Send + 'static {
    /// The next thing that happened on this side. Cancel-safe: dropping the future loses nothing.
    /// Pends while there is nothing.
    fn recv(&mut self) -> impl Future<Output = PortEvent> + Send;

    /// Publishes a sample of another space. Never waits.
    ///
    /// `payload` is a ROS 1 message body without its length, a CDR with its 4 byte encapsulation
    /// header, or a block of OPC UA fields, as the port's [`Local`](bridge_core::Local) says.
    ///
    /// # Errors
    /// A short reason under which the sample is counted as dropped.
    fn publish(&mut self, sample: Delivery) -> Result<(), &'static str>;

    /// Returns the handover of the last [published](Self::publish) value of a topic that is
    /// confirmed.
    fn handover(&self, topic: TopicId) -> Handover {
        let _shown_at_once = topic;
        Handover::Done
    }

    /// Receives the outcome of the newest value of a topic of this side that bridges confirm.
    fn settled(&mut self, topic: TopicId, arrival: &Arrival) {
        let _nobody_waits = (topic, arrival);
    }

    /// The Router heard a value of another space whose local type is not known yet, or what its
    /// writer says it is. The port finds a type (mapping, then a local subscriber's, then what is
    /// described, then the standard type of the value) and answers with [`PortEvent::Bound`], now
    /// or when a subscriber comes; it is asked again while values arrive.
    fn wanted(
        &mut self,
        topic: TopicId,
        shape: &[(BuiltinType, bool)],
        described: Option<&Described>,
    );

    /// A topic of another space has had no good value for its receive timeout, or has one again:
    /// its writer is not heard, or all it sends is dropped, be it by [`publish`](Self::publish).
    fn silent(&mut self, topic: TopicId, silent: bool);

    /// Of the values a topic has side by side, one is no longer there for who comes late: the one
    /// delivered with that [`instance`](Delivery::instance). Nothing to do for a side that keeps
    /// the last value only.
    fn retired(&mut self, topic: TopicId, instance: Timestamp) {
        let _one_value = (topic, instance);
    }

    /// A call of another program can be asked for from now on, or is another than before.
    fn call_known(&mut self, topic: TopicId, description: &Arc<CallDescription>) {
        let _not_served = (topic, description);
    }

    /// Nobody executes a call any longer. What was asked is still answered.
    fn call_gone(&mut self, topic: TopicId) {
        let _not_served = topic;
    }

    /// What became of a request that was reported as [`PortEvent::Ask`].
    fn answered(&mut self, ask: AskId, topic: TopicId, answer: Answered<Bytes>) {
        let _never_asked = (ask, topic, answer);
    }

    /// Executes a request for a call that was reported as [`PortEvent::Offer`]: what it came to is
    /// reported as [`PortEvent::Executed`]. Never waits. False where it is not executed, for which
    /// nothing is to be reported.
    fn execute(&mut self, execution: Execution) -> bool {
        let _never_offered = execution;
        false
    }

    /// Who asked for an execution does not want it any longer. It is to be reported as executed all
    /// the same.
    fn abandoned(&mut self, execution: ExecutionId, topic: TopicId) {
        let _goes_on = (execution, topic);
    }

    /// Somebody else writes a namespace of ours, and nothing of ours is sent in it; or, without
    /// anybody, no longer. The program is not ready meanwhile, and that is told.
    fn taken(&mut self, namespace: u16, by: Option<SocketAddr>) {
        let _told_by_the_shell = (namespace, by);
    }

    /// Another mapping takes the place of the one there is. What both say alike goes on
    /// undisturbed; what only the old one says is given up ([`PortEvent::Unbound`]), and what only
    /// the new one says taken up. Returns what is not changed while the program runs, by its keys
    /// in the mapping and with the reason, for people. `types` are the definitions of its
    /// `type_paths`, which may be others although the mapping is the same.
    fn reload(&mut self, mapping: &Arc<Mapping>, types: &Arc<TypePaths>) -> Vec<String>;

    /// What the Router has counted by now, told every second: for sides that show it.
    fn counted(&mut self, router: &Router) {
        let _shown_by_the_shell = router;
    }

    /// What keeps this side from doing its work now, such as a ROS master that does not answer: for
    /// people.
    fn hindrance(&self) -> Option<String> {
        None
    }

    /// Adds the peers of this side that the mapping needs and that are missing, such as a topic
    /// without a publisher. The run loop asks each second.
    fn add_awaited(&self, missing: &mut AwaitedPeers) {
        let _needs_no_peers = missing;
    }

    /// The other servers that this side is connected to, or tries to be.
    fn links(&self) -> Vec<LinkState> {
        Vec::new()
    }

    /// Describes the OPC UA certificate of this side, for `/status`.
    fn certificate(&self) -> Option<serde_json::Value> {
        None
    }

    /// The program is to end: what this side works on elsewhere is to be cancelled as far as it
    /// ends with the program. The shell goes on until nothing is [pending](Self::pending), 5 s at
    /// most. Never waits.
    fn closing(&mut self) {}

    /// Lists goals and runs with a pending cancellation, a line each: they are being cancelled, and
    /// their end is not known.
    fn pending(&self) -> Vec<String> {
        Vec::new()
    }

    /// What the program tells whoever asks the group which applications there are. `None` of one
    /// that is no server: what it is says the shell.
    fn application(&self) -> Option<Application> {
        None
    }

    /// The addresses of this host that this side has taken for good when it started, all there were
    /// where the list is empty: its library cannot go over to others. `None` where it goes by
    /// itself.
    fn addresses(&self) -> Option<&[IpAddr]> {
        None
    }

    /// Withdraws every registration and ends. Bounded by 2 s.
    fn shutdown(self) -> impl Future<Output = ()> + Send;
}

/// A server that a side has a link to, by its name in the mapping, and what came and went over it
/// since the start.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct LinkState {
    /// What the mapping calls it.
    pub name: String,
    /// Where it is.
    pub url: String,
    /// Whether there is a connection.
    pub up: bool,
    /// Whether it is signed and encrypted.
    pub secured: bool,
    /// Why there is no connection, for people.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub why: Option<String>,
    /// How often there has been a connection.
    pub connects: u64,
    /// How often the certificate of the server was refused, each attempt to connect counted.
    pub certificates_refused: u64,
    /// Values that came, of whatever quality.
    pub values: u64,
    /// Values that were written there.
    pub written: u64,
    /// Values that were not: the server refused them, they waited too long, or they gave way to
    /// newer ones.
    pub not_written: u64,
    /// What cannot be had there, by its name in the mapping, and why.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub faults: BTreeMap<String, String>,
}

/// A request for the local side to execute.
pub type Execution = bridge_core::Execution<Bytes>;

/// One value of another space on its way to the local side.
#[derive(Debug, Clone)]
pub struct Delivery {
    /// Which value.
    pub topic: TopicId,
    /// Its bytes in the port's encoding.
    pub payload: Bytes,
    /// When its producer's bridge took it (the DataSetMessage Timestamp, or the SourceTimestamp of
    /// a DataValue), where the writer says so.
    pub source: Option<Timestamp>,
    /// The status of the message or of its DataValue: the upper 16 bits of an OPC UA StatusCode, 0
    /// for Good.
    pub status: u16,
    /// The DataSetMessage Timestamp, where it tells this value from all others of the topic.
    pub instance: Option<Timestamp>,
    /// What the value is to the others of its topic.
    pub kept: Kept,
    /// Whether subscribers that come late get it: it is a state, and no event.
    pub lasting: bool,
}

/// What a port reports.
#[derive(Debug)]
pub enum PortEvent {
    /// The local type of a topic is known, for the first time or anew: values can be transcoded
    /// from now on.
    Bound {
        /// Which value.
        topic: TopicId,
        /// Its message type in the port's dialect.
        message_type: Arc<MessageType>,
        /// The part of the message that is the value.
        selection: Selection,
    },
    /// As `Bound`, for a value that no mapping names and that is bound by the names of its fields.
    BoundAs {
        /// Which value.
        topic: TopicId,
        /// Its message type in the port's dialect.
        message_type: Arc<MessageType>,
        /// What is said of it, and how it queues.
        note: ValueNote,
    },
    /// The local side no longer has a topic, or will bind it to something else: the mapping has
    /// changed.
    Unbound {
        /// Which value.
        topic: TopicId,
    },
    /// A message was received on a topic of our own space.
    Sample {
        /// Which value; a message that several variables select from is reported once for each.
        topic: TopicId,
        /// The message as it came.
        payload: Bytes,
        /// When it came.
        received: Timestamp,
        /// Who published it, if that publisher latches: the same for as long as it is there, and
        /// for no other of the topic.
        latched_by: Option<PublisherKey>,
    },
    /// As `Sample`, of a side that knows the quality of its values.
    Qualified {
        /// Which value.
        topic: TopicId,
        /// It, in the port's encoding.
        payload: Bytes,
        /// When it was taken.
        taken: Timestamp,
        /// The upper 16 bits of its OPC UA StatusCode; 0 for Good.
        status: u16,
    },
    /// A latched publisher has gone for good: its last message is not for late joiners any more.
    Left {
        /// Which value.
        topic: TopicId,
        /// What its samples were reported under.
        publisher: PublisherKey,
    },
    /// A topic of our own space has a producer now, or has none any more.
    Live {
        /// Which value.
        topic: TopicId,
        /// Whether anybody publishes it.
        live: bool,
    },
    /// Something was dropped that is no sample of a value.
    Dropped {
        /// The counter.
        reason: Reason,
        /// What it was, in two or three words.
        why: &'static str,
        /// How many.
        count: u64,
    },
    /// Samples were lost before the Router saw them, such as in a bounded queue that was full.
    Lost {
        /// Which value, if it is known.
        topic: Option<TopicId>,
        /// The counter.
        reason: Reason,
        /// Why, in two or three words; the counter's label.
        why: &'static str,
        /// How many.
        count: u64,
    },
    /// A publisher or subscriber of the topic asks for or offers what excludes ours, so that
    /// nothing passes between them. Counted; the port tells of it.
    Unmatched {
        /// Which value.
        topic: TopicId,
    },
    /// A value could not be handed to the service it is for, or no service answered with it.
    CallFailed {
        /// Which value.
        topic: TopicId,
        /// What went wrong, for the log.
        detail: String,
    },
    /// What a value of our own space is, where the port speaks in fields and no mapping says it.
    Described {
        /// Which value.
        topic: TopicId,
        /// What it is.
        description: ValueDescription,
    },
    /// The local side asks for a call under that type from now on.
    CallBound {
        /// Which call.
        topic: TopicId,
        /// Its type in the port's dialect.
        service_type: Arc<ServiceType>,
        /// What is not made of the field of the same name.
        map: Arc<CallMap>,
    },
    /// The local side no longer asks for a call, or will under another type.
    CallUnbound {
        /// Which call.
        topic: TopicId,
    },
    /// The local side has somebody who would ask for a call: what it is is asked of who executes
    /// it.
    CallWanted {
        /// Which call.
        topic: TopicId,
    },
    /// A request of the local side.
    Ask {
        /// Tells it from all others.
        ask: AskId,
        /// For which call.
        topic: TopicId,
        /// It, in the port's encoding.
        request: Bytes,
        /// How long the answer is waited for.
        timeout: Duration,
    },
    /// Who asked is gone: the request is not answered any more, and whoever executes it is told so.
    AskGivenUp {
        /// Which request.
        ask: AskId,
    },
    /// The local side executes a call of its own from now on, or it is another than before.
    Offer {
        /// Which call: of a namespace that the program owns.
        topic: TopicId,
        /// What it is.
        offered: Offered,
    },
    /// As `Offer`, for a ROS service: requests are handed out, and responses taken, as its
    /// messages.
    OfferTyped {
        /// Which call: of a namespace that the program owns.
        topic: TopicId,
        /// What it is.
        offered: OfferedType,
    },
    /// The local side no longer executes a call, or no longer has a value, of its own.
    Withdrawn {
        /// Which.
        topic: TopicId,
    },
    /// What an execution came to.
    Executed {
        /// Which.
        execution: ExecutionId,
        /// Its outcome.
        outcome: Executed,
    },
    /// The port cannot go on, such as a ROS 1 node that was told to shut down because another took
    /// its name. The program ends with this message.
    Ended(String),
}
