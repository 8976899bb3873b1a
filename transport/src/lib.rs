//! Datagrams over UDP multicast and unicast.
//!
//! What a datagram means is nobody's business here: bytes go in and come out. One [`Udp`] is one group (or one
//! unicast address) on one interface, as OPC 10000-14 7.3.2 (UADP over UDP) has it: the address is where is listened
//! and where is sent.

mod interface;
mod udp;
mod watch;

pub use interface::{Interface, InterfaceError, interfaces};
pub use udp::{OpenError, Options, SendError, Udp};
pub use watch::{Change, Finding, Held, LOOK};
