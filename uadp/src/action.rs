//! Actions: a Requestor asks, a Responder executes and answers (OPC 10000-14, 5.4.3 and 6.2.11.2).
//!
//! Requests and responses are DataSetMessages under an ActionHeader. Both carry the PublisherId, WriterGroupId and
//! DataSetWriterId of the Responder: what is asked for is an address, whoever asks. Reading borrows from the datagram
//! and allocates nothing, as everywhere in this crate; [`ActionEncoder`] writes into a buffer of the caller. The
//! ActionHeader belongs to the payload: it is encrypted with it, and signed in any case.
//!
//! There are two readings of the standard, an [`ActionDialect`] each. Nothing on the wire tells them apart.
//!
//! [`Requestor`] and [`Responder`] are what makes calls of messages that may get lost: the one repeats, acknowledges and
//! gives up, the other executes once and remembers what it answered. Both take times and messages in and give messages
//! out, and have no socket, clock or randomness of their own. How a Responder's states change follows here from the table
//! of the Requestor's (OPC 10000-14, 6.2.11.2.2); the table of its own was not at hand.
//!
//! # Chunks
//! A request or response has to fit in one NetworkMessage. One in chunks is not read, since the requests of all
//! Requestors carry the PublisherId of the Responder: only the ActionHeader tells whose piece it is, which a
//! [`Reassembler`](crate::Reassembler) does not look at. A whole NetworkMessage cut up, as UA-.NETStandard does it,
//! passes through [`Chunks`](crate::Chunks) and [`Reassembler`](crate::Reassembler) as it is: a
//! [`Whole`](crate::Whole) without DataSetWriter, whose bytes are read with
//! [`NetworkMessage::decode`](crate::NetworkMessage::decode).
//!
//! # Announcing
//! What an Action takes and gives, and what it can be called on, is an
//! [`ActionMetaData`](crate::discovery::ActionMetaData) announcement, and which connections answer Actions is another
//! ([`Announced::ActionResponder`](crate::discovery::Announced)). The standard has no probe for either: a Responder sends
//! the first unasked when it changes (OPC 10000-14, 7.2.4.6.11). What an [`Announcer`](crate::discovery::Announcer)
//! answers beyond that stands at [`set_actions`](crate::discovery::Announcer::set_actions).
//!
//! # Asking
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
pub use outcome::{Outcome, Refusal, Unknown};
pub use requestor::{
    ActionRequest, CallId, CallRefusal, Heard, Requestor, RequestorCounters, RequestorSettings,
    ResponseDrop,
};
pub use responder::{
    ExecutionId, FinishRefusal, RequestDrop, RequestOrigin, Requested, Responder,
    ResponderCounters, ResponderSettings,
};
pub use sending::{ActionAddress, ActionToSend};
