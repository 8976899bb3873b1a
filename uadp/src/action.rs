//! Actions: a Requestor sends requests, a Responder executes them and sends responses
//! (OPC 10000-14, 5.4.3 and 6.2.11.2).
//!
//! Requests and responses are DataSetMessages behind an ActionHeader. Both carry the PublisherId,
//! WriterGroupId and DataSetWriterId of the Responder, so these ids address the Action and do not
//! identify the sender. Decoding borrows from the datagram and allocates nothing; [`ActionEncoder`]
//! writes into a buffer of the caller. The ActionHeader is part of the payload: it is always
//! signed, and encrypted if the payload is.
//!
//! Each of the two readings of the standard is an [`ActionDialect`]. The messages do not show which
//! dialect they use.
//!
//! [`Requestor`] and [`Responder`] make calls over a network that loses messages. The Requestor
//! repeats, acknowledges and gives up requests; the Responder executes each request once and
//! remembers its response. Both take times and messages as input and return messages; they have no
//! socket, clock or randomness. The state transitions of the Responder are derived from the state
//! table of the Requestor (OPC 10000-14, 6.2.11.2.2), because the Responder's own table was not
//! available.
//!
//! # Chunks
//! A request or response has to fit in one NetworkMessage. Chunked requests and responses are not
//! decoded: the requests of all Requestors carry the PublisherId of the Responder, so only the
//! ActionHeader identifies the message of a chunk, and a [`Reassembler`](crate::Reassembler) does
//! not read it. UA-.NETStandard splits the encoded NetworkMessage instead. Such messages pass
//! through [`ChunkEncoder`](crate::ChunkEncoder) and [`Reassembler`](crate::Reassembler) unchanged,
//! as a [`Whole`](crate::Whole) without DataSetWriter.
//! [`NetworkMessage::decode`](crate::NetworkMessage::decode) decodes its bytes.
//!
//! # Announcing
//! An [`ActionMetaData`](crate::discovery::ActionMetaData) announcement describes the arguments,
//! results and targets of an Action. A second announcement lists the connections with Action
//! Responders ([`AnnouncedContent::ActionResponder`](crate::discovery::AnnouncedContent)). The
//! standard has no probe for either: a Responder sends the first unprompted when it changes (OPC
//! 10000-14,
//! 7.2.4.6.11). [`set_actions`](crate::discovery::Announcer::set_actions) lists the further probes
//! that an [`Announcer`](crate::discovery::Announcer) responds to.
//!
//! # Encoding and decoding a request
//! ```
//! use uadp::action::{
//!     ActionCall, ActionDialect, ActionEncoder, ActionHeader, ActionKind, ActionStart, ActionState,
//! };
//! use uadp::{
//!     DataSetHeader, Extras, GroupHeader, NetworkHeader, NetworkMessage, PublisherId, Scalar,
//! };
//!
//! let start = ActionStart {
//!     network: NetworkHeader {
//!         publisher_id: Some(PublisherId::UInt16(2)), // of the Responder
//!         group: Some(GroupHeader { writer_group_id: Some(5), ..GroupHeader::default() }),
//!         ..NetworkHeader::default()
//!     },
//!     action: ActionHeader {
//!         correlation_data: Some(&[7]),
//!         requestor_id: Some(PublisherId::UInt16(1)),
//!         timeout_hint: Some(2500.0),
//!         ..ActionHeader::new(ActionKind::Request)
//!     },
//!     dialect: ActionDialect::Standard,
//!     extras: Extras::default(),
//! };
//! let call = ActionCall { target_id: 1, request_id: 4711, state: ActionState::Executing };
//! let mut datagram = Vec::new();
//! let mut message = ActionEncoder::new(&mut datagram, &start, &[61])?;
//! let mut fields = message.variants(&DataSetHeader::default(), call)?;
//! fields.scalar(Scalar::Double(2.5))?;
//! fields.finish()?;
//! message.finish()?;
//!
//! let received = NetworkMessage::decode(&datagram)?;
//! assert!(received.is_action());
//! for request in received.actions(ActionDialect::Standard)? {
//!     let request = request?;
//!     assert_eq!((request.writer_id, request.call()), (61, call));
//!     assert_eq!(request.action.requestor_id, Some(PublisherId::UInt16(1)));
//!     for argument in request.fields.variants()? {
//!         assert_eq!(argument?, Scalar::Double(2.5).into());
//!     }
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod encoder;
mod header;
mod message;
mod outcome;
mod requestor;
mod responder;
mod sending;
mod timers;

pub use encoder::{ActionCall, ActionEncoder, ActionStart};
pub use header::{ActionHeader, ActionKind};
pub use message::{
    ActionDialect, ActionEncoding, ActionFields, ActionMessage, ActionState, Actions,
};
pub use outcome::{ActionOutcome, Refusal, Unknown};
pub use requestor::{
    ActionRequest, CallId, CallRefusal, Requestor, RequestorCounters, RequestorSettings,
    ResponseDrop, ResponseMeaning,
};
pub use responder::{
    ExecutionId, FinishRefusal, RequestDrop, RequestOrigin, RequiredAction, Responder,
    ResponderCounters, ResponderSettings,
};
pub use sending::{ActionAddress, ActionToSend};
