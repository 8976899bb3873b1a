//! A packet socket for NetworkMessages in Ethernet frames (OPC 10000-14, 7.3.3).

mod filter;
mod frame;
mod port;

use std::collections::BTreeMap;
use std::io::{self, Read as _};
use std::net::{Ipv4Addr, SocketAddr};
use std::os::fd::AsRawFd as _;
use std::task::{Context, Poll, ready};

use nix::sys::socket::sockopt::{IpMtu, Priority, ReceiveTimestampns};
use nix::sys::socket::{bind, getsockopt, setsockopt};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, Socket, Type};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;
use tracing::{debug, info};

use crate::batch::{self, Batch};
use crate::carrier::{
    Capacity, Carrier, CarrierChange, OutgoingMessage, Received, SendError, Senders,
};
use crate::interface::{InterfaceError, speed};
use crate::udp::{SEND_BUFFER, send_error};
pub use frame::VlanTag;
use frame::{ETHERTYPE, EthernetFrame, FrameFault, FrameHeader};
use port::EthernetPort;

/// A socket that receives and sends Ethernet frames of a PubSub connection.
///
/// Frames that this host sends are not received, also those of other programs.
#[derive(Debug)]
pub struct Ethernet {
    options: EthernetOptions,
    sockets: Sockets,
    /// The interface at the time when the sockets were created.
    port: EthernetPort,
    /// The reason why the interface cannot be used at present.
    lost: Option<String>,
    /// The first bytes of sent frames.
    header: Vec<u8>,
    /// Received frames that were not yet taken.
    batch: Batch,
    faults: BTreeMap<FrameFault, u64>,
}

/// Addresses and options of an [`Ethernet`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EthernetOptions {
    /// Name of the network interface.
    pub interface: String,
    /// MAC address that frames are sent to: a group that IPv4 multicast uses too (01-00-5E), or
    /// another host. Frames to the own address are always received.
    pub address: [u8; 6],
    /// VLAN and priority of sent frames. Frames of the same VLAN are received, with any priority.
    pub tag: Option<VlanTag>,
    /// Size of the receive buffer in bytes. The system may grant less.
    pub receive_buffer: usize,
}

/// Reason why no frames can be sent and received.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EthernetError {
    /// The requested interface does not exist.
    #[error(transparent)]
    Interface(#[from] InterfaceError),
    /// The interface has no MAC address.
    #[error("the network interface `{0}` carries no Ethernet frames: name one such as eth0")]
    NoEthernet(String),
    /// The interface has no link.
    #[error("the network interface {0} is down")]
    Down(String),
    /// The program may not open packet sockets.
    #[error(
        "Ethernet frames on {0} need the capability CAP_NET_RAW: under systemd, `systemctl edit` the unit and add \
         AmbientCapabilities=CAP_NET_RAW, CapabilityBoundingSet=CAP_NET_RAW and RestrictAddressFamilies=AF_PACKET \
         to [Service]; otherwise `sudo setcap cap_net_raw+ep` the program"
    )]
    NotPermitted(String),
    /// The group cannot be joined.
    #[error("cannot receive the group on {interface}: {source}; is IPv4 enabled on the interface?")]
    Join {
        /// Name of the interface.
        interface: String,
        /// Error of the system.
        source: io::Error,
    },
    /// Another error of the system.
    #[error("cannot {what} for Ethernet frames on {interface}: {source}")]
    Socket {
        /// Operation that failed.
        what: &'static str,
        /// Name of the interface.
        interface: String,
        /// Error of the system.
        source: io::Error,
    },
}

impl EthernetOptions {
    /// Returns the default options: no tag, 4 MiB receive buffer.
    #[must_use]
    pub const fn new(interface: String, address: [u8; 6]) -> Self {
        Self {
            interface,
            address,
            tag: None,
            receive_buffer: 4 << 20,
        }
    }

    fn vlan(&self) -> Option<u16> {
        self.tag.and_then(VlanTag::vlan)
    }

    /// Returns a group of IPv4 multicast with the address; `None` for the address of a host.
    const fn group(&self) -> Option<Ipv4Addr> {
        match self.address {
            [0x01, 0x00, 0x5E, high, middle, low] => Some(Ipv4Addr::new(239, high, middle, low)),
            _ => None,
        }
    }
}

impl Ethernet {
    /// Opens the sockets and logs the interface.
    ///
    /// Must be called within a tokio runtime.
    ///
    /// # Errors
    /// [`EthernetError`] with the interface that caused it.
    pub fn open(options: &EthernetOptions) -> Result<Self, EthernetError> {
        let port = EthernetPort::find(&options.interface)?;
        let sockets = Sockets::open(options, &port)?;
        info!(
            interface = %port.name,
            vlan = options.vlan(),
            "sending and receiving Ethernet frames"
        );
        Ok(Self {
            header: header(options, &port),
            options: options.clone(),
            sockets,
            port,
            lost: None,
            batch: Batch::default(),
            faults: BTreeMap::new(),
        })
    }

    /// Returns the options.
    pub(crate) const fn options(&self) -> &EthernetOptions {
        &self.options
    }

    /// Returns the address of this host as other hosts see it.
    pub(crate) fn seen_source(&self) -> SocketAddr {
        frame::sender(self.port.address)
    }

    /// Recreates the sockets if the interface was recreated, has another address, or is available
    /// again. Returns its name then, and `None` if the sockets are still valid.
    fn reopen_if_changed(&mut self) -> Result<Option<String>, EthernetError> {
        let port = EthernetPort::find(&self.options.interface)?;
        if !port.is_up {
            return Err(EthernetError::Down(port.name));
        }
        if self.lost.is_none() && port == self.port {
            return Ok(None);
        }
        self.sockets = Sockets::open(&self.options, &port)?;
        self.header = header(&self.options, &port);
        self.batch.clear();
        let name = port.name.clone();
        self.port = port;
        Ok(Some(name))
    }

    /// Takes the next message of the received frames, and counts faulty frames.
    fn take(&mut self, buffer: &mut Vec<u8>) -> Option<Received> {
        while let Some(received) = self.batch.take(buffer) {
            let bytes = buffer.get(..received.length).unwrap_or_default();
            match EthernetFrame::decode(bytes, [self.options.address, self.port.address]) {
                Ok(EthernetFrame { source, message }) => {
                    let length = message.len();
                    let start = received.length.saturating_sub(length);
                    buffer.copy_within(start..received.length, 0);
                    return Some(Received {
                        length,
                        from: frame::sender(source),
                        stamp: received.stamp,
                    });
                }
                Err(fault) => *self.faults.entry(fault).or_default() += 1,
            }
        }
        None
    }

    /// Receives the next message. Faulty frames end the turn, so that they leave time for other
    /// work.
    fn receive(&mut self, buffer: &mut Vec<u8>) -> Turn {
        for _ in 0..FILLS {
            if let Some(received) = self.take(buffer) {
                return Turn::Received(Ok(received));
            }
            match self.fill() {
                Ok(true) => {}
                Ok(false) => {
                    let last = self.take(buffer);
                    return last.map_or(Turn::Empty, |received| Turn::Received(Ok(received)));
                }
                Err(error) => return Turn::Received(Err(error)),
            }
        }
        Turn::Faulty
    }

    /// Receives the frames that wait in the socket. Returns whether more may wait.
    fn fill(&mut self) -> io::Result<bool> {
        let (batch, socket) = (&mut self.batch, &self.sockets.frames);
        let filled = socket.try_io(Interest::READABLE, |socket| {
            // `WouldBlock` clears the readiness: no frame waits behind a batch that is not full.
            match batch.fill(socket.as_raw_fd())? {
                true => Ok(()),
                false => Err(io::ErrorKind::WouldBlock.into()),
            }
        });
        match filled {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => Ok(false),
            // The kernel reports once that the interface went down: `follow` reports it.
            Err(error) if error.kind() == io::ErrorKind::NetworkDown => Ok(true),
            Err(error) => Err(error),
        }
    }
}

impl Carrier for Ethernet {
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        let mut errors = self.try_send_all(&[*message]);
        errors.remove(&0).map_or(Ok(()), Err)
    }

    fn try_send_all(&mut self, messages: &[OutgoingMessage<'_>]) -> BTreeMap<usize, SendError> {
        let mut errors = BTreeMap::new();
        if self.lost.is_some() {
            errors.extend((0..messages.len()).map(|index| (index, SendError::Unreachable)));
            return errors;
        }
        let socket = self.sockets.frames.get_ref();
        let mut sent = 0;
        while let Some(rest @ [_, ..]) = messages.get(sent..) {
            match batch::send_behind(socket, &self.header, rest) {
                Ok(count) => sent += count.max(1),
                Err(error) => {
                    errors.insert(sent, send_error(&error));
                    sent += 1;
                }
            }
        }
        errors
    }

    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        loop {
            match self.receive(buffer) {
                Turn::Received(received) => return Poll::Ready(received),
                Turn::Empty => {}
                Turn::Faulty => {
                    cx.waker().wake_by_ref();
                    return Poll::Pending;
                }
            }
            let _still_ready = ready!(self.sockets.frames.poll_read_ready(cx))?;
        }
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        match self.receive(buffer) {
            Turn::Received(received) => Some(received),
            Turn::Empty | Turn::Faulty => None,
        }
    }

    fn follow(&mut self) -> Option<CarrierChange> {
        match self.reopen_if_changed() {
            Ok(None) => None,
            Ok(Some(interface)) => {
                self.lost = None;
                Some(CarrierChange::Back(interface))
            }
            // If the system cannot list its interfaces, their state is unknown.
            Err(EthernetError::Interface(InterfaceError::List(_))) => None,
            Err(why) => {
                let why = why.to_string();
                let is_known = self.lost.replace(why.clone()).is_some();
                (!is_known).then_some(CarrierChange::Lost(why))
            }
        }
    }

    fn lost(&self) -> Option<String> {
        self.lost.clone()
    }

    fn source(&self) -> Option<SocketAddr> {
        None
    }

    fn interface(&self) -> String {
        self.port.name.clone()
    }

    fn senders(&self) -> Senders {
        Senders::Addresses
    }

    /// Returns the largest payload of a frame, the MTU.
    fn limit(&self) -> Option<usize> {
        Some(self.sockets.mtu())
    }

    fn capacity(&self) -> Capacity {
        speed(&self.port.name).map_or(Capacity::Unknown, Capacity::Wire)
    }

    fn dropped(&self) -> Vec<(&'static str, u64)> {
        let faults = self.faults.iter();
        faults
            .map(|(fault, count)| (fault.reason(), *count))
            .collect()
    }
}

/// Returns the first bytes of sent frames.
fn header(options: &EthernetOptions, port: &EthernetPort) -> Vec<u8> {
    let header = FrameHeader {
        destination: options.address,
        source: port.address,
        tag: options.tag,
    };
    header.encode()
}

/// The result of a turn of receiving.
enum Turn {
    Received(io::Result<Received>),
    /// Nothing waits in the socket.
    Empty,
    /// All frames of the turn were faulty, and more may wait.
    Faulty,
}

#[derive(Debug)]
struct Sockets {
    frames: AsyncFd<Socket>,
    /// A UDP socket that is a member of the IPv4 group with the same MAC address, so that the
    /// interface and switches with IGMP snooping pass the frames. It receives nothing.
    member: Socket,
}

impl Sockets {
    fn open(options: &EthernetOptions, port: &EthernetPort) -> Result<Self, EthernetError> {
        let at = |what| {
            move |source| EthernetError::Socket {
                what,
                interface: port.name.clone(),
                source,
            }
        };
        // A socket for one EtherType gets the frames of unknown VLANs without their VLAN.
        let protocol = match options.vlan() {
            None => ETHERTYPE,
            Some(_) => ALL_TYPES,
        };
        let protocol = Protocol::from(i32::from(protocol.to_be()));
        let socket = Socket::new(Domain::PACKET, Type::RAW, Some(protocol)).map_err(|error| {
            let is_denied = error.kind() == io::ErrorKind::PermissionDenied
                || error.raw_os_error() == Some(EAFNOSUPPORT);
            match is_denied {
                true => EthernetError::NotPermitted(port.name.clone()),
                false => at("make a socket")(error),
            }
        })?;
        socket
            .attach_filter(&filter::program(options.vlan(), port.index()))
            .map_err(at("set the filter"))?;
        socket
            .set_nonblocking(true)
            .map_err(at("set non-blocking mode"))?;
        socket
            .set_recv_buffer_size(options.receive_buffer)
            .map_err(at("set the receive buffer"))?;
        socket
            .set_send_buffer_size(SEND_BUFFER)
            .map_err(at("set the send buffer"))?;
        if let Err(error) = setsockopt(&socket, ReceiveTimestampns, &true) {
            debug!(%error, "the kernel does not stamp frames: delays end at this program");
        }
        if let Some(tag) = options.tag
            && let Err(error) = setsockopt(&socket, Priority, &i32::from(tag.priority()))
        {
            debug!(%error, "the priority selects no queue of the interface");
        }
        bind(socket.as_raw_fd(), &port.link)
            .map_err(io::Error::from)
            .map_err(at("bind"))?;
        drain(&socket);
        let member = member(options, port)?;
        let frames = registered(socket).map_err(at("register the socket"))?;
        Ok(Self { frames, member })
    }

    /// Returns the MTU of the interface, or that of plain Ethernet if it is not known.
    fn mtu(&self) -> usize {
        let mtu = getsockopt(&self.member, IpMtu).ok();
        mtu.and_then(|mtu| usize::try_from(mtu).ok())
            .unwrap_or(USUAL_MTU)
    }
}

#[expect(
    deprecated,
    reason = "the replacement is unsafe, for types that change or close their descriptor; a Socket does neither"
)]
fn registered(socket: Socket) -> io::Result<AsyncFd<Socket>> {
    AsyncFd::with_interest(socket, Interest::READABLE)
}

/// Discards frames of other interfaces, which may have arrived before the socket was bound.
fn drain(socket: &Socket) {
    let mut socket = socket;
    for _ in 0..MOST_DRAINED {
        match socket.read(&mut [0]) {
            Ok(_) => {}
            // An interface that is down is reported once, before the frames.
            Err(error) if error.kind() == io::ErrorKind::NetworkDown => {}
            Err(_) => return,
        }
    }
}

/// Returns the UDP socket of [`Sockets::member`].
fn member(options: &EthernetOptions, port: &EthernetPort) -> Result<Socket, EthernetError> {
    let at = |what| {
        move |source| EthernetError::Socket {
            what,
            interface: port.name.clone(),
            source,
        }
    };
    let socket =
        Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP)).map_err(at("make a socket"))?;
    socket
        .bind_device(Some(port.name.as_bytes()))
        .map_err(at("choose the interface"))?;
    let group = options.group();
    if let Some(group) = group {
        let index = InterfaceIndexOrAddress::Index(port.index());
        socket
            .join_multicast_v4_n(&group, &index)
            .map_err(|source| EthernetError::Join {
                interface: port.name.clone(),
                source,
            })?;
    }
    // The MTU can be read from a connected socket only. Nothing is sent.
    let towards = SocketAddr::from((group.unwrap_or(ANY_GROUP), DISCARD));
    if let Err(error) = socket.connect(&towards.into()) {
        debug!(%error, interface = %port.name, "the MTU is not known: frames have up to 1500 bytes");
    }
    Ok(socket)
}

/// The number of receiving calls after which faulty frames leave time for other work.
const FILLS: usize = 4;
const MOST_DRAINED: usize = 10_000;
/// The protocol of sockets that receive the frames of all protocols (`ETH_P_ALL`).
const ALL_TYPES: u16 = 0x0003;
const USUAL_MTU: usize = 1500;
const ANY_GROUP: Ipv4Addr = Ipv4Addr::new(239, 0, 0, 1);
/// The port of the discard protocol.
const DISCARD: u16 = 9;
/// The error number of Linux for an address family that the program may not use.
const EAFNOSUPPORT: i32 = 97;
