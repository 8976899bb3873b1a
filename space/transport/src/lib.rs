//! Carriers of NetworkMessages: datagrams over UDP multicast and unicast, and Ethernet frames.
//!
//! This crate sends and receives bytes and does not interpret them. A [`Carrier`] is a PubSub
//! network. A [`Udp`] is a multicast
//! group (or a unicast address) on a network interface. As in OPC 10000-14, 7.3.2 (UADP over UDP),
//! the address is used for receiving and sending. An [`Ethernet`] carries UADP without IP
//! (OPC 10000-14, 7.3.3). With the feature `shm` a `SharedMemory` connects programs of one host
//! without a network.

mod batch;
mod carrier;
mod carriers;
mod ethernet;
mod filter;
mod in_process;
mod interface;
mod key_rule;
#[cfg(feature = "shm")]
mod shared_memory;
mod udp;
mod watch;

pub use carrier::{
    BUFFER, Capacity, Carrier, CarrierChange, CarrierState, NetworkArrival, OutgoingMessage,
    Received, SendError, Senders, Traffic,
};
pub use carriers::{CarrierRules, Carriers, ForwardTo, Judgement, MessagePath};
pub use ethernet::{Ethernet, EthernetError, EthernetOptions, VlanTag};
pub use in_process::ProcessHub;
pub use interface::{Interface, InterfaceError, interfaces};
pub use key_rule::{ByteTest, KeyRule};
#[cfg(feature = "shm")]
pub use shared_memory::{SharedMemory, SharedMemoryError};
pub use udp::{Udp, UdpOpenError, UdpOptions};
pub use watch::{HeldInterfaces, InterfaceChange, InterfaceFinding, LOOK};
