//! A UDP socket for a multicast group or a unicast address.

use std::collections::BTreeMap;
use std::future::poll_fn;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::os::fd::AsRawFd as _;
use std::task::{Context, Poll, ready};

use nix::errno::Errno;
use nix::sys::socket::setsockopt;
use nix::sys::socket::sockopt::ReceiveTimestampns;
use socket2::{Domain, Protocol, Socket, Type};
use tokio::io::Interest;
use tokio::net::UdpSocket;
use tracing::{debug, info};

use crate::batch::{self, Batch};
use crate::carrier::{
    Capacity, Carrier, CarrierChange, OutgoingMessage, Received, SendError, Senders,
};
use crate::filter::{OwnFilter, ProcessSenders};
use crate::interface::{Interface, InterfaceError, interfaces};
use crate::key_rule::KeyRule;
use crate::watch::{InterfaceChange, InterfaceSelection, InterfaceWatch};

/// A UDP socket that receives and sends the datagrams of a PubSub connection.
#[derive(Debug)]
pub struct Udp {
    receiver: UdpSocket,
    /// Sends from a separate port, so that several processes of a host can share the port of the
    /// group and distinguish each other by source address. It is not registered with tokio: no task
    /// waits for it, and each sent datagram would wake the program once more, because it makes the
    /// socket writable again.
    sender: std::net::UdpSocket,
    targets: Vec<SocketAddr>,
    local: SocketAddr,
    options: UdpOptions,
    /// Interface of the sockets; `None` if the interface does not have to be watched.
    watch: Option<InterfaceWatch>,
    /// Received datagrams that were not yet taken.
    batch: Batch,
    /// Drops own datagrams; `None` if own datagrams are received.
    own_filter: Option<OwnFilter>,
    /// The senders of the other programs of this process.
    companions: Vec<SocketAddr>,
}

/// Addresses and options of a [`Udp`].
#[derive(Debug, Clone)]
pub struct UdpOptions {
    /// A multicast group with its port, or a unicast address. A unicast address of this host is
    /// bound for receiving. For an address of another host, datagrams are sent to it and received
    /// on the same port of this host.
    pub address: SocketAddr,
    /// Interface to join and send on, by name or address. `None`: the default interface of the
    /// system.
    pub interface: Option<String>,
    /// Maximum number of routers that a multicast datagram passes; 1 stays in the subnet, 0 in this
    /// host.
    pub ttl: u32,
    /// True if other processes of this host receive the datagrams that are sent to the group.
    pub loopback: bool,
    /// True if own datagrams are received too. False lets the kernel drop them, if it can: own
    /// datagrams may nevertheless be received, for example after a change of the network.
    pub own: bool,
    /// Size of the receive buffer in bytes. The system may grant less, which is logged.
    pub receive_buffer: usize,
    /// Unicast addresses to send to instead of `address`, for networks without multicast.
    pub peers: Vec<SocketAddr>,
}

/// Reason why a socket could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UdpOpenError {
    /// The requested interface does not exist.
    #[error(transparent)]
    Interface(#[from] InterfaceError),
    /// IPv6 groups are not supported.
    #[error("{0}: IPv6 is not supported, give an IPv4 address")]
    Ipv6(SocketAddr),
    /// Another program uses the port and does not share it.
    #[error(
        "UDP port {} is in use by a program that does not share it (find it with `ss -ulpn`); stop it, or \
         give another port",
        .0.port()
    )]
    PortTaken(SocketAddr),
    /// The group could not be joined.
    #[error(
        "cannot join {group} on {interface}: {source}; is the interface up, with multicast on?"
    )]
    Join {
        /// The multicast group.
        group: Ipv4Addr,
        /// Interface for the group.
        interface: String,
        /// Error of the system.
        source: io::Error,
    },
    /// The unicast address to receive on is not an address of this host.
    #[error("no network interface of this host has the address {0}")]
    Gone(SocketAddr),
    /// Another error of the system.
    #[error("cannot {what} for {address}: {source}")]
    Socket {
        /// Operation that failed.
        what: &'static str,
        /// Address of the operation.
        address: SocketAddr,
        /// Error of the system.
        source: io::Error,
    },
}

impl Carrier for Udp {
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        Self::try_send(self, message.bytes)
    }

    fn try_send_all(&mut self, messages: &[OutgoingMessage<'_>]) -> BTreeMap<usize, SendError> {
        Self::try_send_all(self, messages)
    }

    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        self.poll_datagram(cx, |batch| batch.take(buffer))
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        self.try_datagram(|batch| batch.take(buffer))
    }

    fn follow(&mut self) -> Option<CarrierChange> {
        Some(match Self::follow(self)? {
            InterfaceChange::Lost(why) => CarrierChange::Lost(why),
            InterfaceChange::Back(interface) => CarrierChange::Back(interface.to_string()),
        })
    }

    fn lost(&self) -> Option<String> {
        Self::lost(self).map(str::to_owned)
    }

    fn source(&self) -> Option<SocketAddr> {
        Some(Self::source(self))
    }

    fn interface(&self) -> String {
        Self::interface(self)
    }

    fn senders(&self) -> Senders {
        Senders::Addresses
    }

    fn capacity(&self) -> Capacity {
        Self::capacity(self)
    }

    fn drop_by(&mut self, rules: Vec<KeyRule>) {
        Self::drop_by(self, rules);
    }
}

impl UdpOptions {
    /// Returns the default options for `address`: TTL 1, multicast loopback without own datagrams,
    /// 4 MiB receive buffer, no peers.
    #[must_use]
    pub const fn new(address: SocketAddr) -> Self {
        Self {
            address,
            interface: None,
            ttl: 1,
            loopback: true,
            own: false,
            receive_buffer: 4 << 20,
            peers: Vec::new(),
        }
    }
}

impl Udp {
    /// Opens the socket, joins a multicast group, and logs group and interface.
    ///
    /// Must be called within a tokio runtime.
    ///
    /// # Errors
    /// [`UdpOpenError`] with the interface, port or group that caused it.
    pub fn open(options: &UdpOptions) -> Result<Self, UdpOpenError> {
        let address = options.address;
        let IpAddr::V4(ip) = address.ip() else {
            return Err(UdpOpenError::Ipv6(address));
        };
        let interface = options
            .interface
            .as_deref()
            .map(Interface::find)
            .transpose()?;
        let receiver = receiver(options, ip, interface.as_ref())?;
        let (sender, local) = sender(options, interface.as_ref())?;
        let shown = interface
            .as_ref()
            .map_or_else(|| "the default interface".to_owned(), ToString::to_string);
        if ip.is_multicast() {
            info!(group = %address, interface = %shown, ttl = options.ttl, "joined the multicast group");
        } else {
            info!(address = %address, interface = %shown, "listening for unicast datagrams");
        }
        let targets = if options.peers.is_empty() {
            vec![address]
        } else {
            options.peers.clone()
        };
        let own_filter = (!options.own).then(|| {
            let mut filter = OwnFilter::default();
            // The addresses that cannot be listed at present are added by `follow`.
            let senders = ProcessSenders {
                own: local,
                companions: &[],
            };
            filter.set(&receiver, senders, &interfaces().unwrap_or_default());
            filter
        });
        Ok(Self {
            receiver,
            sender,
            targets,
            local,
            options: options.clone(),
            watch: options.wanted().and_then(InterfaceWatch::start),
            batch: Batch::default(),
            own_filter,
            companions: Vec::new(),
        })
    }

    /// Checks the interface of the sockets. Recreates the sockets if the interface was recreated,
    /// has another address, or is available again. Call it every [`LOOK`](crate::LOOK). The
    /// [`source`](Self::source) may change, and received datagrams that were not yet taken are
    /// lost.
    pub fn follow(&mut self) -> Option<InterfaceChange> {
        // If the system cannot list its interfaces, their state is unknown.
        let present = interfaces().ok()?;
        let (options, receiver) = (&self.options, &self.receiver);
        let mut made = None;
        let change = self.watch.as_mut().and_then(|watch| {
            watch.see(&present, |interface| {
                made = Some(anew(options, receiver, interface)?);
                Ok(())
            })
        });
        let is_new = made.is_some();
        if let Some((receiver, (sender, local))) = made {
            if let Some(receiver) = receiver {
                self.receiver = receiver;
            }
            (self.sender, self.local) = (sender, local);
            self.batch.clear();
        }
        if let Some(filter) = &mut self.own_filter {
            let senders = ProcessSenders {
                own: self.local,
                companions: &self.companions,
            };
            if is_new {
                filter.set(&self.receiver, senders, &present);
            } else {
                filter.update(&self.receiver, senders, &present);
            }
        }
        change
    }

    /// Sets the senders of the other programs of this process; their datagrams are dropped like own
    /// datagrams. Without `own` datagrams only.
    pub(crate) fn drop_companions(&mut self, companions: Vec<SocketAddr>) {
        self.companions = companions;
        self.update_filter();
    }

    /// Lets the kernel drop datagrams by rules, if it can. Replaces earlier rules. Without `own`
    /// datagrams only.
    pub fn drop_by(&mut self, rules: Vec<KeyRule>) {
        if let Some(filter) = &mut self.own_filter {
            filter.set_rules(rules);
        }
        self.update_filter();
    }

    fn update_filter(&mut self) {
        if let Some(filter) = &mut self.own_filter {
            let senders = ProcessSenders {
                own: self.local,
                companions: &self.companions,
            };
            // The addresses that cannot be listed at present are added by `follow`.
            filter.update(&self.receiver, senders, &interfaces().unwrap_or_default());
        }
    }

    /// Returns whether a datagram comes from another program of this process. The kernel may pass
    /// such datagrams for a moment after a change, or always if it has refused the filter.
    pub(crate) fn is_companion(&self, from: SocketAddr) -> bool {
        let filter = self.own_filter.as_ref();
        filter.is_some_and(|filter| filter.is_companion(from))
    }

    /// Returns the source address of sent datagrams as receivers probably see it: with the address
    /// of the watched interface if no address is bound.
    pub(crate) fn seen_source(&self) -> SocketAddr {
        match &self.watch {
            Some(watch) if self.local.ip().is_unspecified() => {
                SocketAddr::from((watch.interface().address, self.local.port()))
            }
            _ => self.local,
        }
    }

    /// Returns the reason why no datagrams are received and sent, as detected by
    /// [`follow`](Self::follow).
    #[must_use]
    pub fn lost(&self) -> Option<&str> {
        self.watch.as_ref()?.lost()
    }

    /// Returns the name of the network interface that the sockets use.
    #[must_use]
    pub fn interface(&self) -> String {
        let held = self
            .watch
            .as_ref()
            .map(|watch| watch.interface().name.clone());
        let named = held.or_else(|| self.options.interface.clone());
        named.unwrap_or_else(|| "the default interface".to_owned())
    }

    /// Returns the capacity of the network interface that the sockets use.
    #[must_use]
    pub fn capacity(&self) -> Capacity {
        let held = self.watch.as_ref().map(InterfaceWatch::interface);
        let loopback = held.is_some_and(|interface| interface.address.is_loopback())
            || self.targets.iter().all(|target| target.ip().is_loopback());
        if loopback {
            // The kernel shows twice the requested size, half of which is for its own records.
            let granted = socket2::SockRef::from(&self.receiver).recv_buffer_size();
            return granted.map_or(Capacity::Unknown, |granted| {
                Capacity::Host(u64::try_from(granted / 2).unwrap_or(u64::MAX))
            });
        }
        held.and_then(Interface::speed)
            .map_or(Capacity::Unknown, Capacity::Wire)
    }

    /// Waits for a datagram. Returns its length and sender. Cancel-safe: no datagram is lost when
    /// the future is dropped.
    ///
    /// A datagram larger than `buffer` is truncated; 65 536 bytes suffice for any datagram.
    ///
    /// # Errors
    /// The error of the system; the socket stays usable.
    pub async fn recv(&mut self, buffer: &mut [u8]) -> io::Result<(usize, SocketAddr)> {
        let received = poll_fn(|cx| self.poll_datagram(cx, |batch| batch.copy(buffer))).await?;
        Ok((received.length, received.from))
    }

    /// Polls for a datagram, which `take` takes from the received datagrams.
    pub(crate) fn poll_datagram(
        &mut self,
        cx: &mut Context<'_>,
        mut take: impl FnMut(&mut Batch) -> Option<Received>,
    ) -> Poll<io::Result<Received>> {
        loop {
            if let Some(received) = self.try_datagram(&mut take) {
                return Poll::Ready(received);
            }
            ready!(self.receiver.poll_recv_ready(cx))?;
        }
    }

    /// Returns a datagram that was already received, or `None`. `take` takes it from the received
    /// datagrams.
    pub(crate) fn try_datagram(
        &mut self,
        mut take: impl FnMut(&mut Batch) -> Option<Received>,
    ) -> Option<io::Result<Received>> {
        if let Some(received) = take(&mut self.batch) {
            return Some(Ok(received));
        }
        let (batch, socket) = (&mut self.batch, self.receiver.as_raw_fd());
        let filled = self.receiver.try_io(Interest::READABLE, || {
            // `WouldBlock` clears the readiness: no datagram waits behind a batch that is not
            // full, and a call that finds nothing is saved.
            if batch.fill(socket)? {
                Ok(())
            } else {
                Err(io::ErrorKind::WouldBlock.into())
            }
        });
        match filled {
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => Some(Err(error)),
            _ => take(&mut self.batch).map(Ok),
        }
    }

    /// Sends a datagram to the group (or to each peer) without waiting.
    ///
    /// # Errors
    /// The first [`SendError`] of its targets; the datagram is still sent to the other targets.
    pub fn try_send(&self, datagram: &[u8]) -> Result<(), SendError> {
        let mut result = Ok(());
        for target in &self.targets {
            // A datagram socket is nearly always writable, and a full buffer is reported as an
            // error.
            let sent = socket2::SockRef::from(&self.sender).send_to(datagram, &(*target).into());
            if let Err(error) = sent
                && result.is_ok()
            {
                result = Err(send_error(&error));
            }
        }
        result
    }

    /// Sends messages as [`try_send`](Self::try_send), several in one system call. Returns the
    /// first [`SendError`] of each message that was not sent to all targets, by its index.
    pub(crate) fn try_send_all(
        &self,
        messages: &[OutgoingMessage<'_>],
    ) -> BTreeMap<usize, SendError> {
        let mut errors = BTreeMap::new();
        for target in &self.targets {
            let mut sent = 0;
            while let Some(rest @ [_, ..]) = messages.get(sent..) {
                match batch::send(&self.sender, *target, rest) {
                    Ok(count) => sent += count.max(1),
                    Err(error) => {
                        errors.entry(sent).or_insert_with(|| send_error(&error));
                        sent += 1;
                    }
                }
            }
        }
        errors
    }

    /// Returns the source address of sent datagrams as known before sending. The IP address may be
    /// unspecified if no interface was configured.
    #[must_use]
    pub const fn source(&self) -> SocketAddr {
        self.local
    }
}

impl UdpOptions {
    /// Returns the interface to watch. Without a group and an interface name, the sockets are not
    /// bound to an interface.
    fn wanted(&self) -> Option<InterfaceSelection> {
        match &self.interface {
            Some(wanted) => Some(InterfaceSelection::Named(wanted.clone())),
            None if self.address.ip().is_multicast() => {
                Some(InterfaceSelection::Towards(self.address))
            }
            None => None,
        }
    }
}

type Sender = (std::net::UdpSocket, SocketAddr);

/// Returns new sockets for a changed interface. A receiver that is bound to a present address is
/// kept, because its port cannot be bound twice.
fn anew(
    options: &UdpOptions,
    receiver: &UdpSocket,
    interface: &Interface,
) -> Result<(Option<UdpSocket>, Sender), UdpOpenError> {
    let address = options.address;
    let IpAddr::V4(ip) = address.ip() else {
        return Err(UdpOpenError::Ipv6(address));
    };
    // Without an interface name, the system selects the interface for each datagram.
    let interface = options.interface.is_some().then_some(interface);
    let bound = receiver.local_addr().map(|bound| bound.ip()).ok();
    let bound_to_own = bound == Some(address.ip());
    let stays = bound_to_own
        || bound.is_some_and(|bound| {
            bound.is_unspecified() || interface.is_some_and(|interface| bound == interface.address)
        });
    let receiver = if stays && !ip.is_multicast() {
        let present = interfaces().map_err(InterfaceError::List)?;
        let is_here = ip.is_loopback() || present.iter().any(|interface| interface.address == ip);
        if bound_to_own && !is_here {
            return Err(UdpOpenError::Gone(address));
        }
        None
    } else {
        Some(self::receiver(options, ip, interface)?)
    };
    Ok((receiver, sender(options, interface)?))
}

pub(crate) fn send_error(error: &io::Error) -> SendError {
    let unreachable = [
        io::ErrorKind::NetworkUnreachable,
        io::ErrorKind::HostUnreachable,
        io::ErrorKind::NetworkDown,
        io::ErrorKind::ConnectionRefused,
    ];
    if error.kind() == io::ErrorKind::WouldBlock || error.raw_os_error() == Some(ENOBUFS) {
        SendError::Busy
    } else if unreachable.contains(&error.kind()) {
        SendError::Unreachable
    } else if error.raw_os_error() == Some(EMSGSIZE) {
        SendError::TooBig
    } else {
        SendError::Refused
    }
}

/// The error number of Linux for "message too long", for which std has no `ErrorKind`.
const EMSGSIZE: i32 = 90;
/// The error number of Linux for a full queue of the network interface.
const ENOBUFS: i32 = 105;

fn receiver(
    options: &UdpOptions,
    ip: Ipv4Addr,
    interface: Option<&Interface>,
) -> Result<UdpSocket, UdpOpenError> {
    let address = options.address;
    let at = |what| {
        move |source| UdpOpenError::Socket {
            what,
            address,
            source,
        }
    };
    let socket =
        Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).map_err(at("make a socket"))?;
    if ip.is_multicast() {
        // All programs of a host receive on the same port of the group.
        socket
            .set_reuse_address(true)
            .map_err(at("share the port"))?;
    }
    socket
        .set_nonblocking(true)
        .map_err(at("set non-blocking mode"))?;
    // The kernel stamps the datagrams for measurements of delays, where it can.
    if let Err(error) = setsockopt(&socket, ReceiveTimestampns, &true) {
        debug!(%error, "the kernel does not stamp datagrams: delays end at this program");
    }
    socket
        .set_recv_buffer_size(options.receive_buffer)
        .map_err(at("set the receive buffer"))?;
    // The socket is bound to the group address, so that it does not receive datagrams of other
    // groups at this port.
    let bound = socket.bind(&address.into()).or_else(|error| {
        // A unicast address of another host: datagrams are sent to it, and received on the same
        // port of this host.
        if ip.is_multicast() || error.kind() != io::ErrorKind::AddrNotAvailable {
            return Err(error);
        }
        let here = interface.map_or(Ipv4Addr::UNSPECIFIED, |interface| interface.address);
        socket.bind(&SocketAddr::from((here, address.port())).into())
    });
    bound.map_err(|source| {
        if source.kind() == io::ErrorKind::AddrInUse {
            UdpOpenError::PortTaken(address)
        } else {
            UdpOpenError::Socket {
                what: "bind",
                address,
                source,
            }
        }
    })?;
    if ip.is_multicast() {
        join(&socket, ip, interface)?;
    }
    let granted = socket.recv_buffer_size().unwrap_or_default();
    if granted < options.receive_buffer {
        info!(
            wanted = options.receive_buffer,
            granted,
            "the operating system grants a smaller receive buffer than wanted: bursts may be lost; raise net.core.rmem_max"
        );
    }
    UdpSocket::from_std(socket.into()).map_err(at("register the socket"))
}

fn join(
    socket: &Socket,
    group: Ipv4Addr,
    interface: Option<&Interface>,
) -> Result<(), UdpOpenError> {
    let on = interface.map_or(Ipv4Addr::UNSPECIFIED, |interface| interface.address);
    socket
        .join_multicast_v4(&group, &on)
        .map_err(|source| UdpOpenError::Join {
            group,
            interface: interface
                .map_or_else(|| "the default interface".to_owned(), ToString::to_string),
            source,
        })?;
    // Off, so that the socket does not receive groups that other programs of this host have joined
    // on other interfaces. Emulators of other processors (qemu-user) do not know the option.
    socket
        .set_multicast_all_v4(false)
        .or_else(|error| {
            let is_unknown = error.kind() == io::ErrorKind::Unsupported
                || error.raw_os_error().map(Errno::from_raw) == Some(Errno::ENOPROTOOPT);
            if is_unknown { Ok(()) } else { Err(error) }
        })
        .map_err(|source| UdpOpenError::Join {
            group,
            interface: on.to_string(),
            source,
        })
}

/// Returns the sending socket and its local address.
fn sender(options: &UdpOptions, interface: Option<&Interface>) -> Result<Sender, UdpOpenError> {
    let address = options.address;
    let at = |what| {
        move |source| UdpOpenError::Socket {
            what,
            address,
            source,
        }
    };
    let socket =
        Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).map_err(at("make a socket"))?;
    socket
        .set_nonblocking(true)
        .map_err(at("set non-blocking mode"))?;
    // The chunks of a large message are sent in bursts without waiting for space in the buffer. The
    // system may grant less.
    socket
        .set_send_buffer_size(SEND_BUFFER)
        .map_err(at("set the send buffer"))?;
    socket
        .set_multicast_ttl_v4(options.ttl)
        .map_err(at("set the TTL"))?;
    socket
        .set_multicast_loop_v4(options.loopback)
        .map_err(at("set multicast loopback"))?;
    let from = interface.map_or(Ipv4Addr::UNSPECIFIED, |interface| interface.address);
    if interface.is_some() {
        socket
            .set_multicast_if_v4(&from)
            .map_err(at("choose the interface"))?;
    }
    socket
        .bind(&SocketAddr::from((from, 0)).into())
        .map_err(at("bind the sender"))?;
    let socket = std::net::UdpSocket::from(socket);
    let local = socket.local_addr().map_err(at("read the local address"))?;
    Ok((socket, local))
}

/// Size of the send buffer in bytes.
pub(crate) const SEND_BUFFER: usize = 1 << 20;

#[cfg(test)]
mod tests;
