//! The kernel's filter for own datagrams.
//!
//! The kernel delivers each multicast datagram to all members of the group, including its sender.
//! A filter of classic BPF on the receiving socket drops own datagrams before they wake the
//! program. It only saves work: the caller's loop rule does not depend on it, and applies to
//! everything that the filter does not match, such as a forged datagram from another address.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use socket2::{SockFilter, SockRef};
use tokio::net::UdpSocket;
use tracing::debug;

use crate::interface::Interface;

/// The filter of a receiving socket for the datagrams of a sending socket.
#[derive(Debug, Default)]
pub(crate) struct OwnFilter {
    set: Option<Sources>,
    /// True if the kernel has refused a filter, which is logged once.
    refused: bool,
}

/// The source addresses of own datagrams. A sender that is bound to no address uses the address of
/// the interface through which a datagram leaves. A datagram of another host with the same port is
/// not matched.
#[derive(Debug, PartialEq, Eq)]
struct Sources {
    port: u16,
    addresses: Vec<Ipv4Addr>,
}

impl OwnFilter {
    /// Sets the filter of a new receiver or a new sender.
    pub(crate) fn set(&mut self, receiver: &UdpSocket, sender: SocketAddr, present: &[Interface]) {
        self.set = None;
        self.update(receiver, sender, present);
    }

    /// Sets the filter again if the addresses of this host have changed.
    pub(crate) fn update(
        &mut self,
        receiver: &UdpSocket,
        sender: SocketAddr,
        present: &[Interface],
    ) {
        let sources = Sources::of(sender, present);
        if self.refused || self.set.as_ref() == Some(&sources) {
            return;
        }
        match sources.attach(receiver) {
            Ok(()) => self.set = Some(sources),
            Err(error) => {
                self.refused = true;
                // A previous filter could drop datagrams of another program that gets an old port.
                drop(SockRef::from(receiver).detach_filter());
                debug!(
                    %error,
                    "the kernel does not filter own datagrams: each is received and dropped here"
                );
            }
        }
    }
}

impl Sources {
    fn of(sender: SocketAddr, present: &[Interface]) -> Self {
        let addresses = match sender.ip() {
            IpAddr::V4(bound) if !bound.is_unspecified() => vec![bound],
            IpAddr::V4(_) | IpAddr::V6(_) => {
                let own = present.iter().map(|interface| interface.address);
                own.collect()
            }
        };
        Self {
            port: sender.port(),
            addresses,
        }
    }

    /// Attaches the filter, which replaces the previous filter of the socket.
    fn attach(&self, receiver: &UdpSocket) -> io::Result<()> {
        let program = self.program().ok_or_else(|| {
            let many = self.addresses.len();
            io::Error::other(format!("this host has {many} addresses"))
        })?;
        SockRef::from(receiver).attach_filter(&program)
    }

    /// Returns the filter; `None` if there are too many addresses for its jumps.
    fn program(&self) -> Option<Vec<SockFilter>> {
        let count = u8::try_from(self.addresses.len()).ok()?;
        let past_addresses = count.checked_add(1)?;
        let mut program = vec![
            SockFilter::new(LOAD_HALF, 0, 0, SOURCE_PORT),
            SockFilter::new(JUMP_IF_EQUAL, 0, past_addresses, u32::from(self.port)),
            SockFilter::new(LOAD_WORD, 0, 0, SOURCE_ADDRESS),
        ];
        let to_drop = (0..count).rev().map(|behind| behind + 1);
        for (address, to_drop) in self.addresses.iter().zip(to_drop) {
            program.push(SockFilter::new(
                JUMP_IF_EQUAL,
                to_drop,
                0,
                u32::from(*address),
            ));
        }
        program.push(SockFilter::new(RETURN, 0, 0, ACCEPT));
        program.push(SockFilter::new(RETURN, 0, 0, DROP));
        Some(program)
    }
}

// Instructions of classic BPF, see `Documentation/networking/filter.rst` of Linux.
const LOAD_HALF: u16 = 0x28;
const LOAD_WORD: u16 = 0x20;
const JUMP_IF_EQUAL: u16 = 0x15;
const RETURN: u16 = 0x06;
/// The filter of a UDP socket sees a datagram from its UDP header on.
const SOURCE_PORT: u32 = 0;
/// Offset 12 of the IPv4 header, relative to `SKF_NET_OFF`.
const SOURCE_ADDRESS: u32 = 0xFFF0_0000 + 12;
/// The maximum number of bytes to accept.
const ACCEPT: u32 = u32::MAX;
const DROP: u32 = 0;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn interface(address: Ipv4Addr) -> Interface {
        Interface {
            name: "wire0".to_owned(),
            index: 1,
            address,
            up: true,
        }
    }

    /// Returns the senders that a socket with the filter receives.
    fn received(
        sender: impl Fn(SocketAddr) -> SocketAddr,
        present: &[Interface],
        hosts: &[u8],
    ) -> Vec<u8> {
        let receiver = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = receiver.local_addr().unwrap();
        let timeout = Some(Duration::from_secs(10));
        receiver.set_read_timeout(timeout).unwrap();
        let first = std::net::UdpSocket::bind(("127.0.0.2", 0)).unwrap();
        let port = first.local_addr().unwrap().port();
        let own = sender(SocketAddr::from(([127, 0, 0, 2], port)));
        let program = Sources::of(own, present).program().unwrap();
        SockRef::from(&receiver).attach_filter(&program).unwrap();
        for host in hosts {
            let address = (Ipv4Addr::new(127, 0, 0, *host), port);
            let other = (*host != 2).then(|| std::net::UdpSocket::bind(address).unwrap());
            let socket = other.as_ref().unwrap_or(&first);
            socket.send_to(&[*host], to).unwrap();
        }
        // Another port of the own address is another program.
        let last = std::net::UdpSocket::bind(("127.0.0.2", 0)).unwrap();
        last.send_to(&[u8::MAX], to).unwrap();
        let mut senders = Vec::new();
        let mut buffer = [0];
        loop {
            receiver.recv(&mut buffer).unwrap();
            match buffer[0] {
                u8::MAX => return senders,
                host => senders.push(host),
            }
        }
    }

    #[test]
    fn datagrams_of_a_bound_sender_are_dropped_and_those_of_another_host_pass() {
        let senders = received(|own| own, &[], &[2, 3, 4]);
        assert_eq!(senders, [3, 4]);
    }

    #[test]
    fn all_own_addresses_are_dropped_for_a_sender_without_an_address() {
        let own = [2, 4, 6].map(|host| interface(Ipv4Addr::new(127, 0, 0, host)));
        let unbound = |own: SocketAddr| SocketAddr::from((Ipv4Addr::UNSPECIFIED, own.port()));
        assert_eq!(received(unbound, &own, &[2, 3, 4, 5, 6]), [3, 5]);
        // Without addresses, nothing is dropped.
        assert_eq!(received(unbound, &[], &[2, 3]), [2, 3]);
    }

    #[test]
    fn as_many_addresses_as_a_jump_spans_are_dropped() {
        let many = |count: u8| {
            let hosts = (0..count).map(|host| interface(Ipv4Addr::new(127, 0, 0, host)));
            hosts.collect::<Vec<_>>()
        };
        let unbound = |own: SocketAddr| SocketAddr::from((Ipv4Addr::UNSPECIFIED, own.port()));
        assert_eq!(received(unbound, &many(254), &[2, 253, 254]), [254]);
        let sources = Sources::of(SocketAddr::from(([0, 0, 0, 0], 1)), &many(255));
        assert!(sources.program().is_none());
    }

    #[test]
    fn the_filter_follows_the_addresses_and_the_port() {
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_all().build().unwrap();
        let _entered = runtime.enter();
        let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_nonblocking(true).unwrap();
        let receiver = UdpSocket::from_std(socket).unwrap();
        let sender = SocketAddr::from((Ipv4Addr::UNSPECIFIED, 7));
        let [one, two] = [1, 2].map(|host| interface(Ipv4Addr::new(10, 0, 0, host)));
        let mut filter = OwnFilter::default();
        filter.set(&receiver, sender, std::slice::from_ref(&one));
        let set = |filter: &OwnFilter| filter.set.as_ref().unwrap().addresses.clone();
        assert_eq!(set(&filter), [one.address]);
        filter.update(&receiver, sender, &[one.clone(), two.clone()]);
        assert_eq!(set(&filter), [one.address, two.address]);
        filter.update(&receiver, SocketAddr::from((two.address, 8)), &[one]);
        assert_eq!(set(&filter), [two.address]);
    }
}
