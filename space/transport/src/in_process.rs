//! Messages between the programs of a process, beside the network.
//!
//! A [`ProcessHub`] connects the carriers of one process that use the same group. A message that a
//! carrier sends goes to the network as without a hub, and to the inbox of each other carrier of
//! the hub. The copy of that message that the network returns to the process is dropped, so each
//! program receives the message once.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::{Duration, SystemTime};

use crate::carrier::{
    Capacity, Carrier, CarrierChange, OutgoingMessage, Received, SendError, Senders,
};
use crate::ethernet::{Ethernet, EthernetOptions};
use crate::key_rule::KeyRule;
use crate::udp::{Udp, UdpOptions};

/// The carriers of one process that exchange messages without the network.
#[derive(Debug, Clone, Default)]
pub struct ProcessHub(Arc<HubState>);

#[derive(Debug, Default)]
struct HubState {
    members: Mutex<Vec<HubMember>>,
    /// Counts the changes of the members.
    changes: AtomicU64,
}

#[derive(Debug, Clone)]
struct HubMember {
    group: HubGroup,
    inbox: Arc<HubInbox>,
    /// The local address of the sending socket.
    sender: SocketAddr,
}

/// Members with the same group receive each other's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
enum HubGroup {
    Udp {
        address: SocketAddr,
        interface: Option<String>,
    },
    Ethernet(EthernetOptions),
}

/// A network below an [`InProcess`] carrier: it drops the datagrams of the programs of the process
/// that it receives.
trait HubNetwork: Carrier {
    /// Sets the local addresses of the senders of the other programs.
    fn drop_companions(&mut self, companions: Vec<SocketAddr>);

    /// Returns whether a message comes from another program of the process.
    fn is_companion(&self, from: SocketAddr) -> bool;

    /// Returns the local address of the sender.
    fn sender(&self) -> SocketAddr;

    /// Returns the source address of own messages as receivers see it.
    fn seen_source(&self) -> SocketAddr;
}

impl HubNetwork for Udp {
    fn drop_companions(&mut self, companions: Vec<SocketAddr>) {
        Self::drop_companions(self, companions);
    }

    fn is_companion(&self, from: SocketAddr) -> bool {
        Self::is_companion(self, from)
    }

    fn sender(&self) -> SocketAddr {
        self.source()
    }

    fn seen_source(&self) -> SocketAddr {
        Self::seen_source(self)
    }
}

/// Frames of this host are not received from the network, so there are none to drop.
impl HubNetwork for Ethernet {
    fn drop_companions(&mut self, _: Vec<SocketAddr>) {}

    fn is_companion(&self, _: SocketAddr) -> bool {
        false
    }

    fn sender(&self) -> SocketAddr {
        Self::seen_source(self)
    }

    fn seen_source(&self) -> SocketAddr {
        Self::seen_source(self)
    }
}

impl ProcessHub {
    /// Connects a socket with the other sockets of the hub that use the same group and interface.
    /// A unicast socket stays as it is, because no other program of the process receives at it.
    #[must_use]
    pub fn connect(&self, udp: Udp, options: &UdpOptions) -> Box<dyn Carrier> {
        if !options.address.ip().is_multicast() || !options.peers.is_empty() || options.own {
            return Box::new(udp);
        }
        let group = HubGroup::Udp {
            address: options.address,
            interface: options.interface.clone(),
        };
        Box::new(InProcess::new(self, udp, group))
    }

    /// Connects an Ethernet socket with the other sockets of the hub that have the same options.
    #[must_use]
    pub fn connect_ethernet(&self, ethernet: Ethernet) -> Box<dyn Carrier> {
        let group = HubGroup::Ethernet(ethernet.options().clone());
        Box::new(InProcess::new(self, ethernet, group))
    }

    fn members(&self) -> MutexGuard<'_, Vec<HubMember>> {
        let members = self.0.members.lock();
        members.unwrap_or_else(PoisonError::into_inner)
    }

    fn changed(&self) {
        self.0.changes.fetch_add(1, Ordering::Release);
    }

    fn changes(&self) -> u64 {
        self.0.changes.load(Ordering::Acquire)
    }
}

/// A carrier of a [`ProcessHub`], over its network.
struct InProcess<N: HubNetwork> {
    network: N,
    hub: ProcessHub,
    inbox: Arc<HubInbox>,
    /// The inboxes of the other members of the group.
    others: Vec<Arc<HubInbox>>,
    /// The changes of the hub that `others` contains.
    seen: u64,
    /// The source address of own messages for the other members.
    source: SocketAddr,
    /// Whether the network is read before the inbox: they take turns.
    network_first: bool,
}

impl<N: HubNetwork> fmt::Debug for InProcess<N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("InProcess")
            .field("network", &self.network)
            .field("others", &self.others.len())
            .finish_non_exhaustive()
    }
}

impl<N: HubNetwork> InProcess<N> {
    fn new(hub: &ProcessHub, network: N, group: HubGroup) -> Self {
        let inbox = Arc::<HubInbox>::default();
        hub.members().push(HubMember {
            group,
            inbox: Arc::clone(&inbox),
            sender: network.sender(),
        });
        hub.changed();
        let source = network.seen_source();
        let mut carrier = Self {
            network,
            hub: hub.clone(),
            inbox,
            others: Vec::new(),
            seen: 0,
            source,
            network_first: false,
        };
        carrier.follow_members();
        carrier
    }

    /// Follows the changes of the members.
    fn follow_members(&mut self) {
        let changes = self.hub.changes();
        if changes == self.seen {
            return;
        }
        self.seen = changes;
        let mut senders = Vec::new();
        self.others.clear();
        let members = self.hub.members();
        let own = members.iter().find(|member| self.is_own(member));
        let group = own.map(|own| &own.group);
        for member in members.iter() {
            if !self.is_own(member) && Some(&member.group) == group {
                self.others.push(Arc::clone(&member.inbox));
                senders.push(member.sender);
            }
        }
        drop(members);
        self.network.drop_companions(senders);
    }

    fn is_own(&self, member: &HubMember) -> bool {
        Arc::ptr_eq(&member.inbox, &self.inbox)
    }

    /// Sets the sender of this member if it has changed.
    fn follow_sender(&mut self) {
        self.source = self.network.seen_source();
        let sender = self.network.sender();
        let mut members = self.hub.members();
        let own = members.iter_mut().find(|member| self.is_own(member));
        if let Some(own) = own.filter(|own| own.sender != sender) {
            own.sender = sender;
            self.hub.changed();
        }
    }

    /// Passes a sent message to the other members.
    fn pass(&self, message: &OutgoingMessage<'_>) {
        for other in &self.others {
            other.put(message.bytes, self.source);
        }
    }
}

impl<N: HubNetwork> Drop for InProcess<N> {
    fn drop(&mut self) {
        let inbox = &self.inbox;
        let mut members = self.hub.members();
        members.retain(|member| !Arc::ptr_eq(&member.inbox, inbox));
        drop(members);
        self.hub.changed();
    }
}

impl<N: HubNetwork> Carrier for InProcess<N> {
    /// A message that the network refuses reaches no member either: the caller reports it as not
    /// sent.
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        self.follow_members();
        self.network.try_send(message)?;
        self.pass(message);
        Ok(())
    }

    fn try_send_all(&mut self, messages: &[OutgoingMessage<'_>]) -> BTreeMap<usize, SendError> {
        self.follow_members();
        let errors = self.network.try_send_all(messages);
        for (index, message) in messages.iter().enumerate() {
            if !errors.contains_key(&index) {
                self.pass(message);
            }
        }
        errors
    }

    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        if let Some(received) = self.try_recv(buffer) {
            return Poll::Ready(received);
        }
        // A message that arrives from here on wakes the task.
        if let Some(received) = self.inbox.take_or_wait(buffer, cx.waker()) {
            self.network_first = true;
            return Poll::Ready(Ok(received));
        }
        for _ in 0..DROPPED_AT_ONCE {
            match self.network.poll_recv(cx, buffer) {
                Poll::Ready(Ok(received)) if self.network.is_companion(received.from) => {}
                other @ (Poll::Ready(_) | Poll::Pending) => return other,
            }
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        self.follow_members();
        if !self.network_first
            && let Some(received) = self.inbox.take(buffer)
        {
            self.network_first = true;
            return Some(Ok(received));
        }
        for _ in 0..DROPPED_AT_ONCE {
            match self.network.try_recv(buffer) {
                Some(Ok(received)) if self.network.is_companion(received.from) => {}
                Some(received) => {
                    self.network_first = false;
                    return Some(received);
                }
                None => break,
            }
        }
        self.inbox.take(buffer).map(Ok)
    }

    fn follow(&mut self) -> Option<CarrierChange> {
        let change = self.network.follow();
        self.follow_sender();
        self.follow_members();
        change
    }

    fn lost(&self) -> Option<String> {
        self.network.lost()
    }

    fn source(&self) -> Option<SocketAddr> {
        self.network.source()
    }

    fn interface(&self) -> String {
        self.network.interface()
    }

    fn capacity(&self) -> Capacity {
        self.network.capacity()
    }

    fn senders(&self) -> Senders {
        self.network.senders()
    }

    fn within(&self) -> Option<Duration> {
        self.network.within()
    }

    fn limit(&self) -> Option<usize> {
        self.network.limit()
    }

    fn dropped(&self) -> Vec<(&'static str, u64)> {
        self.network.dropped()
    }

    fn drop_by(&mut self, rules: Vec<KeyRule>) {
        self.network.drop_by(rules);
    }

    fn overflowed(&mut self) -> u64 {
        self.network.overflowed() + self.inbox.full.swap(0, Ordering::Relaxed)
    }

    fn close(&mut self) {
        self.network.close();
    }

    fn poll_closed(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        self.network.poll_closed(cx)
    }
}

/// The messages of the other programs of the process that were not yet received.
#[derive(Debug, Default)]
struct HubInbox {
    queue: Mutex<HubQueue>,
    /// The number of messages that were dropped because the inbox was full, and not yet reported.
    full: AtomicU64,
}

#[derive(Debug, Default)]
struct HubQueue {
    messages: VecDeque<HubMessage>,
    /// The number of bytes of all messages.
    bytes: usize,
    /// Buffers for reuse.
    spare: Vec<Vec<u8>>,
    /// Wakes the receiver, if it waits.
    waker: Option<Waker>,
}

#[derive(Debug)]
struct HubMessage {
    bytes: Vec<u8>,
    from: SocketAddr,
    /// Time of the arrival, as the kernel stamps datagrams.
    stamp: SystemTime,
}

impl HubInbox {
    fn queue(&self) -> MutexGuard<'_, HubQueue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a message, or counts it as dropped if the inbox is full, as a socket does.
    #[expect(
        clippy::disallowed_methods,
        reason = "it stands for the stamp of the kernel"
    )]
    fn put(&self, bytes: &[u8], from: SocketAddr) {
        let mut queue = self.queue();
        if queue.messages.len() >= MOST_MESSAGES || queue.bytes + bytes.len() > MOST_BYTES {
            self.full.fetch_add(1, Ordering::Relaxed);
            return;
        }
        let mut copy = queue.spare.pop().unwrap_or_default();
        copy.extend_from_slice(bytes);
        queue.bytes += bytes.len();
        queue.messages.push_back(HubMessage {
            bytes: copy,
            from,
            stamp: SystemTime::now(),
        });
        let waker = queue.waker.take();
        drop(queue);
        if let Some(waker) = waker {
            waker.wake();
        }
    }

    /// Copies the oldest message to the start of `buffer`.
    fn take(&self, buffer: &mut Vec<u8>) -> Option<Received> {
        self.queue().take(buffer)
    }

    /// As [`take`](Self::take), or registers `waker` for the next message.
    fn take_or_wait(&self, buffer: &mut Vec<u8>, waker: &Waker) -> Option<Received> {
        let mut queue = self.queue();
        let taken = queue.take(buffer);
        if taken.is_none() {
            match &mut queue.waker {
                Some(registered) => registered.clone_from(waker),
                none => *none = Some(waker.clone()),
            }
        }
        taken
    }
}

impl HubQueue {
    fn take(&mut self, buffer: &mut Vec<u8>) -> Option<Received> {
        let HubMessage {
            mut bytes,
            from,
            stamp,
        } = self.messages.pop_front()?;
        let length = bytes.len();
        self.bytes = self.bytes.saturating_sub(length);
        if buffer.len() < length {
            buffer.resize(length, 0);
        }
        if let Some(start) = buffer.get_mut(..length) {
            start.copy_from_slice(&bytes);
        }
        if self.spare.len() < MOST_SPARE && bytes.capacity() <= LARGEST_SPARE {
            bytes.clear();
            self.spare.push(bytes);
        }
        Some(Received {
            length,
            from,
            stamp: Some(stamp),
        })
    }
}

/// The limits of an inbox; the bytes are those of the receive buffer of a socket.
const MOST_MESSAGES: usize = 16_384;
const MOST_BYTES: usize = 4 << 20;
/// The limits of the buffers for reuse.
const MOST_SPARE: usize = 64;
const LARGEST_SPARE: usize = 4096;
/// The number of datagrams of other programs that are dropped in a row: more than a socket holds,
/// so that the heartbeat of a redundant bridge behind them is received before a takeover.
const DROPPED_AT_ONCE: usize = 16_384;

#[cfg(test)]
mod tests;
