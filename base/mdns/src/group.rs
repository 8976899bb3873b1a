//! The packets of the mDNS group, received beside the mDNS daemon: goodbyes without delay.
//!
//! mDNS keeps a withdrawn record for another second (RFC 6762, 10.1), in case another host still
//! has it. The name of a server is its own, so no other host has it, and a second is half of the
//! available time.

use std::io::ErrorKind;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use registry::label;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::net::UdpSocket;
use tokio::time::{Duration, timeout};
use tracing::{debug, warn};

use crate::interface::{InterfaceAddress, MdnsInterface};
use crate::packet::{DnsName, DnsPacket, server_query};

/// A socket for the packets of the mDNS group on one interface. It receives nothing while it
/// cannot be opened.
#[derive(Debug)]
pub(crate) struct GroupSocket {
    interface: MdnsInterface,
    port: u16,
    socket: Option<UdpSocket>,
    /// The addresses of the interface when the socket was opened.
    joined: Vec<InterfaceAddress>,
    packet: Vec<u8>,
    /// The last logged fault since a packet was received.
    fault: Option<String>,
}

impl GroupSocket {
    pub(crate) fn open(interface: &MdnsInterface, port: u16) -> Self {
        let mut socket = Self {
            interface: interface.clone(),
            port,
            socket: None,
            joined: Vec::new(),
            packet: vec![0; PACKET],
            fault: None,
        };
        socket.reopen();
        socket
    }

    /// Opens the socket again if it was closed by an error, or if the interface has other
    /// addresses: an interface that is created again has left the group. Returns whether the socket
    /// was opened.
    pub(crate) fn reopen(&mut self) -> bool {
        let mut present = self.interface.indexed_addresses();
        present.sort_unstable();
        if self.socket.is_some() && self.joined == present {
            return false;
        }
        let addresses: Vec<Ipv4Addr> = present.iter().map(|one| one.address).collect();
        self.joined = present;
        match listen(&addresses, self.port) {
            Ok(socket) => self.socket = Some(socket),
            Err(error) => self.close(&error),
        }
        self.is_open()
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
                    self.fault = None;
                    return (self.packet.get(..length).unwrap_or_default(), from);
                }
                // Opened again with the next announcement.
                Err(error) => self.close(&error),
            }
        }
    }

    /// Sends a query for a server with this name to the group. A responder of this name answers it
    /// even if it announced its server before.
    pub(crate) async fn ask(&self, instance: &str) {
        let [service, protocol, domain] = OPCUA_TCP;
        let query = server_query(&[instance.as_bytes(), service, protocol, domain]);
        let (Some(socket), Some(query)) = (&self.socket, query) else {
            return;
        };
        let sent = socket.send_to(&query, SocketAddrV4::new(GROUP, self.port));
        if let Ok(Err(error)) = timeout(SEND_LIMIT, sent).await {
            debug!(%error, interface = %self.interface, "cannot send an mDNS query");
        }
    }

    /// Closes the socket, and logs each cause once.
    fn close(&mut self, error: &std::io::Error) {
        self.socket = None;
        let fault = error.to_string();
        if self.fault.as_ref() != Some(&fault) {
            warn!(
                %error,
                interface = %self.interface,
                "cannot receive mDNS packets; the interface is tried again"
            );
            self.fault = Some(fault);
        }
    }
}

/// The error of Linux for an option of a socket that it does not know.
const ENOPROTOOPT: i32 = 92;

/// Opens a socket for the packets of the mDNS group on the interface with these addresses.
fn listen(addresses: &[Ipv4Addr], port: u16) -> std::io::Result<UdpSocket> {
    let socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    socket.set_reuse_address(true)?;
    socket.set_reuse_port(true)?;
    // Excludes the groups that other programs have joined on other interfaces. Emulators of other
    // processors (qemu-user) do not know the option.
    match socket.set_multicast_all_v4(false) {
        Err(error) if error.raw_os_error() != Some(ENOPROTOOPT) => return Err(error),
        Ok(()) | Err(_) => {}
    }
    // Binds to the group only: unicast packets to this host are for the program that sent the
    // query.
    socket.bind(&SocketAddrV4::new(GROUP, port).into())?;
    // The value for all packets of mDNS (RFC 6762, 11).
    socket.set_multicast_ttl_v4(255)?;
    join(&socket, addresses)?;
    socket.set_nonblocking(true)?;
    UdpSocket::from_std(socket.into())
}

/// Joins the group on the interfaces with these addresses, and sends from one of them. Fails if no
/// interface has joined.
fn join(socket: &Socket, addresses: &[Ipv4Addr]) -> std::io::Result<()> {
    let none = std::io::Error::other("the interface has no IPv4 address");
    let mut result = Err(none);
    for address in addresses {
        match socket.join_multicast_v4(&GROUP, address) {
            Ok(()) => result = socket.set_multicast_if_v4(address),
            // Another address of the interface: a socket joins once for each interface.
            Err(error) if error.kind() == ErrorKind::AddrInUse => result = Ok(()),
            Err(error) => result = result.or(Err(error)),
        }
    }
    result
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
const SEND_LIMIT: Duration = Duration::from_secs(1);
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

    #[tokio::test]
    async fn two_addresses_of_one_interface_join_once_and_an_interface_without_one_is_closed() {
        assert!(listen(&[Ipv4Addr::LOCALHOST, Ipv4Addr::new(127, 0, 0, 2)], 0).is_ok());
        // An address of another host: of several addresses, one is enough.
        let elsewhere = Ipv4Addr::new(192, 0, 2, 7);
        assert!(listen(&[elsewhere, Ipv4Addr::LOCALHOST], 0).is_ok());
        assert!(listen(&[Ipv4Addr::LOCALHOST, elsewhere], 0).is_ok());
        assert!(listen(&[elsewhere], 0).is_err());
        let mut socket = GroupSocket::open(&MdnsInterface::parse("192.0.2.7"), 0);
        assert!(!socket.is_open());
        socket.interface = MdnsInterface::LOOPBACK;
        socket.reopen();
        assert!(socket.is_open());
        socket.interface = MdnsInterface::parse("192.0.2.7");
        socket.reopen();
        assert!(!socket.is_open(), "the address of the interface is gone");
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
