//! NetworkMessages over an MQTT broker (OPC 10000-14, 7.3.4).
//!
//! [`Mqtt`] is a [`Carrier`](transport::Carrier): the programs of a space use it as they use UDP.
//! It chooses the topic of each message by the ids in its header, keeps discovery messages at the
//! broker, reports the own status, and returns received messages to its caller.
//!
//! A broker stores messages. Therefore:
//! - Values, commands, requests and responses are never retained, sessions end with the
//!   connection, and with MQTT 5 messages expire. Nothing is queued for an absent reader.
//! - Values that the broker confirms (QoS 1) have a connection of their own, so that a broker that
//!   ends it takes no subscription with it.
//! - A message waits at most its time in the own queue. While the broker is away, only the newest
//!   state of each topic waits, and older states that the broker confirms (QoS 1).
//! - A broker that does not answer for [`STALL`] is left with a reset, which discards the messages
//!   that it has not read.
//! - The receiver has to drop late messages; see [`Carrier::within`](transport::Carrier::within).
//! - Retained messages of a publisher that is not Operational are held back.
//!
//! The connection is a task of tokio that reconnects with growing pauses. The MQTT protocol itself
//! is implemented without IO by `mqtt-protocol-core`.

mod address;
mod carrier;
mod cells;
mod connection;
mod echo;
mod json;
mod links;
mod packets;
mod producers;
mod queue;
mod reports;
mod scope;
mod settings;
mod stream;
mod subscriptions;
mod topics;
mod version;

pub use carrier::Mqtt;
pub use cells::{CellStatus, CellWatch};
pub use connection::STALL;
pub use scope::{MessageRole, MessageScope, scope};
pub use settings::{BrokerIdentity, OpenError};
