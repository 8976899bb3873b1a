//! The packets of the mDNS group, received beside the mDNS daemon: goodbyes without delay.
//!
//! mDNS keeps a withdrawn record for another second (RFC 6762, 10.1), in case another host still
//! has it. The name of a server is its own, so no other host has it, and a second is half of the
//! available time.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use registry::label;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;
use tracing::debug;

use crate::interface::MdnsInterface;
use crate::packet::{DnsName, DnsPacket};

/// A socket for the packets of the mDNS group on one interface. It receives nothing while it
/// cannot be opened.
#[derive(Debug)]
pub(crate) struct GroupSocket {
    interface: MdnsInterface,
    port: u16,
    socket: Option<UdpSocket>,
    packet: Vec<u8>,
}

impl GroupSocket {
    pub(crate) fn open(interface: &MdnsInterface, port: u16) -> Self {
        let mut socket = Self {
            interface: interface.clone(),
            port,
            socket: None,
            packet: vec![0; PACKET],
        };
        socket.reopen();
        socket
    }

    /// Opens the socket again if it was closed by an error.
    pub(crate) fn reopen(&mut self) {
        if self.socket.is_none() {
            match listen(&self.interface, self.port) {
                Ok(socket) => self.socket = Some(socket),
                Err(error) => {
                    debug!(%error, interface = %self.interface, "cannot receive mDNS packets")
                }
            }
        }
    }

    /// Returns whether packets are received.
    pub(crate) const fn is_open(&self) -> bool {
        self.socket.is_some()
    }

    /// Waits for a packet. Returns it with its sender. Cancel-safe.
    pub(crate) async fn recv(&mut self) -> (&[u8], SocketAddr) {
        loop {
            let received = match &self.socket {
                Some(socket) => socket.recv_from(&mut self.packet).await,
                None => std::future::pending().await,
            };
            match received {
                Ok((length, from)) => {
                    return (self.packet.get(..length).unwrap_or_default(), from);
                }
                // Opened again with the next announcement.
                Err(error) => {
                    debug!(%error, interface = %self.interface, "cannot receive mDNS packets");
                    self.socket = None;
                }
            }
        }
    }
}

/// Opens a socket for the packets of the mDNS group on one interface.
fn listen(interface: &MdnsInterface, port: u16) -> std::io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_reuse_port(true)?;
    // Excludes the groups that other programs have joined on other interfaces.
    socket.set_multicast_all_v4(false)?;
    // Binds to the group only: unicast packets to this host are for the program that sent the
    // query.
    socket.bind(&SocketAddrV4::new(GROUP, port).into())?;
    for address in interface.addresses() {
        socket.join_multicast_v4(&GROUP, &address)?;
    }
    socket.set_nonblocking(true)?;
    UdpSocket::from_std(socket.into())
}

/// Returns the instances of the OPC UA service that a packet withdraws.
pub fn goodbyes(packet: &[u8]) -> Vec<String> {
    let packet = DnsPacket::new(packet).filter(|packet| packet.is_response());
    let records = packet.into_iter().flat_map(DnsPacket::records);
    let gone = records.filter(|record| record.is_withdrawn && record.owner.is(&OPCUA_TCP));
    gone.filter_map(|record| instance_of(record.pointer()?))
        .collect()
}

/// Returns the instance of the OPC UA service with this name; `None` for other names, and for
/// instances that cannot be displayed.
pub(crate) fn instance_of(name: DnsName<'_>) -> Option<String> {
    let (instance, service) = name.split_first()??;
    let instance = std::str::from_utf8(instance).ok()?;
    let fits = service.is(&OPCUA_TCP) && label(instance) == instance;
    fits.then(|| instance.to_owned())
}

const GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 251);
/// The largest packet of mDNS (RFC 6762, 17).
const PACKET: usize = 9000;
/// The labels of the service of OPC UA servers over TCP.
pub(crate) const OPCUA_TCP: [&[u8]; 3] = [b"_opcua-tcp", b"_tcp", b"local"];

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a response with a PTR record. Its target points to its owner.
    fn packet(lifetime: u8) -> Vec<u8> {
        [
            &[0, 0, 0x84, 0, 0, 0, 0, 1, 0, 0, 0, 0][..],
            b"\x0a_opcua-tcp\x04_tcp\x05local\0",
            &[0, 12, 0, 1, 0, 0, 0, lifetime, 0, 6],
            b"\x03arm\xc0\x0c",
        ]
        .concat()
    }

    #[test]
    fn a_goodbye_is_heard_and_an_announcement_is_none() {
        assert_eq!(goodbyes(&packet(0)), ["arm"]);
        assert!(goodbyes(&packet(1)).is_empty());
    }

    #[test]
    fn no_packet_is_read_past_its_end_or_for_ever() {
        let whole = packet(0);
        for end in 0..whole.len() {
            assert!(goodbyes(&whole[..end]).is_empty(), "{end}");
            for byte in 0..=255 {
                let mut changed = whole.clone();
                changed[end] = byte;
                assert!(goodbyes(&changed).len() <= 1);
            }
        }
        // A name that points to itself.
        let mut around = whole;
        around.truncate(12);
        around.extend([0xC0, 12]);
        assert!(goodbyes(&around).is_empty());
    }
}
