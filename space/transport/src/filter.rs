//! The kernel's filter for datagrams of this process, and for those that the program does not use.
//!
//! The kernel delivers each multicast datagram to all members of the group, including its sender.
//! A filter of classic BPF on the receiving socket drops own datagrams, and those of the other
//! programs of the process, before they wake the program. It applies the [`KeyRule`]s too, so that
//! a program of a group with hundreds of others does not wake for each of their datagrams. It only
//! saves work: the caller's rules do not depend on it, and apply to everything that the filter does
//! not match, such as a forged datagram from another address.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use socket2::{SockFilter, SockRef};
use tokio::net::UdpSocket;
use tracing::debug;

use crate::interface::Interface;
use crate::key_rule::{ACCEPT, DROP, JUMP, JUMP_IF_EQUAL, KeyRule, LOAD_HALF, RETURN};

/// The filter of a receiving socket for the datagrams of the sending sockets of the process.
#[derive(Debug, Default)]
pub(crate) struct OwnFilter {
    set: Option<Attached>,
    /// The sources of the other programs of the process.
    companions: Vec<OwnSource>,
    rules: Vec<KeyRule>,
    /// True if the kernel has refused a filter, which is logged once.
    refused: bool,
}

/// The content of a filter.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Attached {
    sources: Vec<OwnSource>,
    rules: Vec<KeyRule>,
}

/// The source addresses of the datagrams of a sending socket. A sender that is bound to no address
/// uses the address of the interface through which a datagram leaves. A datagram of another host
/// with the same port is not matched.
#[derive(Debug, Clone, PartialEq, Eq)]
struct OwnSource {
    port: u16,
    addresses: Vec<Ipv4Addr>,
}

/// The sending sockets of the process, by their local addresses.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ProcessSenders<'a> {
    /// The sender that belongs to the receiving socket.
    pub(crate) own: SocketAddr,
    /// The senders of the other programs of the process.
    pub(crate) companions: &'a [SocketAddr],
}

impl OwnFilter {
    /// Sets the filter of a new receiver or a new sender.
    pub(crate) fn set(
        &mut self,
        receiver: &UdpSocket,
        senders: ProcessSenders<'_>,
        present: &[Interface],
    ) {
        self.set = None;
        self.update(receiver, senders, present);
    }

    /// Sets the rules for other datagrams, which the next [`update`](Self::update) applies.
    pub(crate) fn set_rules(&mut self, rules: Vec<KeyRule>) {
        let wanted: usize = rules.iter().map(|rule| rule.wanted.len()).sum();
        // The kernel bounds the size of a filter.
        self.rules = match wanted <= MOST_WANTED {
            true => rules,
            false => Vec::new(),
        };
    }

    /// Sets the filter again if the senders, the rules or the addresses of this host have changed.
    pub(crate) fn update(
        &mut self,
        receiver: &UdpSocket,
        senders: ProcessSenders<'_>,
        present: &[Interface],
    ) {
        let source = |sender: &SocketAddr| OwnSource::of(*sender, present);
        self.companions = senders.companions.iter().map(source).collect();
        let mut sources = vec![source(&senders.own)];
        sources.extend_from_slice(&self.companions);
        let mut wanted = Attached {
            sources,
            rules: self.rules.clone(),
        };
        if self.refused || self.set.as_ref() == Some(&wanted) {
            return;
        }
        let attached = attach(&wanted, receiver).or_else(|error| {
            if wanted.rules.is_empty() {
                return Err(error);
            }
            // The kernel may refuse a long filter.
            debug!(%error, "the kernel does not filter by namespace");
            self.rules.clear();
            wanted.rules.clear();
            attach(&wanted, receiver)
        });
        match attached {
            Ok(()) => self.set = Some(wanted),
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

    /// Returns whether a datagram comes from another program of the process.
    pub(crate) fn is_companion(&self, from: SocketAddr) -> bool {
        self.companions.iter().any(|source| source.contains(from))
    }
}

impl OwnSource {
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

    fn contains(&self, from: SocketAddr) -> bool {
        let is_own = |address: &Ipv4Addr| from.ip() == IpAddr::V4(*address);
        from.port() == self.port && self.addresses.iter().any(is_own)
    }

    /// Returns the part of the filter that drops the datagrams of this source. Other datagrams
    /// reach the instruction behind it. `None` if there are too many addresses for its jumps.
    fn program(&self) -> Option<Vec<SockFilter>> {
        let count = u8::try_from(self.addresses.len()).ok()?;
        let past_drop = count.checked_add(3)?;
        let mut program = vec![
            SockFilter::new(LOAD_HALF, 0, 0, SOURCE_PORT),
            SockFilter::new(JUMP_IF_EQUAL, 0, past_drop, u32::from(self.port)),
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
        program.push(SockFilter::new(JUMP, 0, 0, 1));
        program.push(SockFilter::new(RETURN, 0, 0, DROP));
        Some(program)
    }
}

/// Returns the filter that drops the datagrams of all sources, and those that rules drop.
fn program(sources: &[OwnSource], rules: &[KeyRule]) -> Option<Vec<SockFilter>> {
    let parts: Option<Vec<Vec<SockFilter>>> = sources.iter().map(OwnSource::program).collect();
    let mut program: Vec<SockFilter> = parts?.into_iter().flatten().collect();
    program.extend(rules.iter().flat_map(KeyRule::program));
    program.push(SockFilter::new(RETURN, 0, 0, ACCEPT));
    Some(program)
}

/// Attaches the filter, which replaces the previous filter of the socket.
fn attach(wanted: &Attached, receiver: &UdpSocket) -> io::Result<()> {
    let Attached { sources, rules } = wanted;
    let program = program(sources, rules).ok_or_else(|| {
        let many = sources.iter().map(|source| source.addresses.len()).max();
        io::Error::other(format!(
            "this host has {} addresses",
            many.unwrap_or_default()
        ))
    })?;
    SockRef::from(receiver).attach_filter(&program)
}

/// The largest number of wanted keys in a filter: with its other parts, half of the instructions
/// that the kernel accepts.
const MOST_WANTED: usize = 512;
const LOAD_WORD: u16 = 0x20;
/// The filter of a UDP socket sees a datagram from its UDP header on.
const SOURCE_PORT: u32 = 0;
/// Offset 12 of the IPv4 header, relative to `SKF_NET_OFF`.
const SOURCE_ADDRESS: u32 = 0xFFF0_0000 + 12;

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
        let program = program(&[OwnSource::of(own, present)], &[]).unwrap();
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
        assert_eq!(received(unbound, &many(252), &[2, 251, 252]), [252]);
        let source = OwnSource::of(SocketAddr::from(([0, 0, 0, 0], 1)), &many(253));
        assert!(program(&[source], &[]).is_none());
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
        let alone = |own| ProcessSenders {
            own,
            companions: &[],
        };
        let mut filter = OwnFilter::default();
        filter.set(&receiver, alone(sender), std::slice::from_ref(&one));
        let set = |filter: &OwnFilter| filter.set.as_ref().unwrap().sources[0].addresses.clone();
        assert_eq!(set(&filter), [one.address]);
        filter.update(&receiver, alone(sender), &[one.clone(), two.clone()]);
        assert_eq!(set(&filter), [one.address, two.address]);
        let bound = SocketAddr::from((two.address, 8));
        filter.update(&receiver, alone(bound), &[one]);
        assert_eq!(set(&filter), [two.address]);
    }

    #[test]
    fn datagrams_of_all_programs_of_the_process_are_dropped_and_no_others() {
        let receiver = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let to = receiver.local_addr().unwrap();
        let timeout = Some(Duration::from_secs(10));
        receiver.set_read_timeout(timeout).unwrap();
        let senders = [(); 4].map(|()| std::net::UdpSocket::bind("127.0.0.2:0").unwrap());
        let all = senders
            .each_ref()
            .map(|sender| sender.local_addr().unwrap());
        let sources: Vec<OwnSource> = all[..3]
            .iter()
            .map(|all| OwnSource::of(*all, &[]))
            .collect();
        let program = program(&sources, &[]).unwrap();
        SockRef::from(&receiver).attach_filter(&program).unwrap();
        for (number, sender) in (0_u8..).zip(&senders) {
            sender.send_to(&[number], to).unwrap();
        }
        let mut buffer = [u8::MAX];
        receiver.recv(&mut buffer).unwrap();
        assert_eq!(buffer, [3]);
        let filter = OwnFilter {
            companions: sources[1..].to_vec(),
            ..OwnFilter::default()
        };
        let companions = all.map(|from| filter.is_companion(from));
        assert_eq!(companions, [false, true, true, false]);
        let elsewhere = SocketAddr::from(([127, 0, 0, 3], all[1].port()));
        assert!(!filter.is_companion(elsewhere));
    }
}
