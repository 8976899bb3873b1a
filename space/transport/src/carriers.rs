//! Several carriers as one, with a bridge between them.

use std::collections::{BTreeMap, VecDeque};
use std::io;
use std::net::SocketAddr;
use std::task::{Context, Poll};
use std::time::Duration;

use crate::carrier::{
    Capacity, Carrier, CarrierChange, CarrierState, NetworkArrival, OutgoingMessage, Received,
    SendError, Senders, Traffic,
};

/// Decides about the messages that several carriers receive.
pub trait CarrierRules: std::fmt::Debug + Send {
    /// Records an own message, which is sent on all carriers.
    fn sent(&mut self, message: &[u8]);

    /// Judges a received message.
    fn judge(&mut self, message: &[u8], path: MessagePath) -> Judgement;
}

/// The way by which a message was received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MessagePath {
    /// The number of the carrier.
    pub carrier: usize,
    /// Address of the sender, or of the broker.
    pub from: SocketAddr,
}

/// The result of [`CarrierRules::judge`].
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Judgement {
    /// The reason why the program does not get the message; `None` if it gets the message.
    pub dropped: Option<&'static str>,
    /// The reason why a message of a route is not forwarded.
    pub not_forwarded: Option<&'static str>,
    /// The forwarding of the message to other carriers.
    pub forward: Option<ForwardTo>,
}

/// The forwarding of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ForwardTo {
    /// The numbers of the carriers.
    pub carriers: Vec<usize>,
    /// Whether a newer message of the same topic replaces the message while it waits.
    pub replaceable: bool,
    /// Whether the message is a command, which keeps its exact time and form.
    pub command: bool,
    /// The time after which the message must not be delivered any more.
    pub within: Option<Duration>,
}

/// Several carriers of a program. Own messages are sent on all carriers, and messages of all
/// carriers are received.
///
/// No carrier waits for another: each has its own bounded queue and refuses what does not fit.
#[derive(Debug)]
pub struct Carriers {
    members: Vec<Member>,
    rules: Box<dyn CarrierRules>,
    /// The member that is polled first.
    next: usize,
    /// The member that received the last message.
    last: usize,
    /// Whether the last message was forwarded.
    is_forwarded: bool,
    /// The reason why the last message was not forwarded.
    not_forwarded: Option<&'static str>,
    changes: VecDeque<CarrierChange>,
}

#[derive(Debug)]
struct Member {
    carrier: Box<dyn Carrier>,
    traffic: Traffic,
    dropped: BTreeMap<&'static str, u64>,
}

impl Member {
    fn count(&mut self, reason: &'static str) {
        *self.dropped.entry(reason).or_default() += 1;
    }

    /// Returns whether the address is the source of datagrams of this program.
    fn is_own(&self, from: SocketAddr) -> bool {
        self.carrier.source().is_some_and(|source| {
            source.port() == from.port()
                && (source.ip().is_unspecified() || source.ip() == from.ip())
        })
    }
}

impl Carriers {
    /// Returns the carriers as one. Their order gives their numbers.
    #[must_use]
    pub fn new(carriers: Vec<Box<dyn Carrier>>, rules: Box<dyn CarrierRules>) -> Self {
        let members = carriers.into_iter().map(|carrier| Member {
            carrier,
            traffic: Traffic::default(),
            dropped: BTreeMap::new(),
        });
        Self {
            members: members.collect(),
            rules,
            next: 0,
            last: 0,
            is_forwarded: false,
            not_forwarded: None,
            changes: VecDeque::new(),
        }
    }

    fn numbers(&self) -> impl Iterator<Item = usize> + use<> {
        let (first, count) = (self.next, self.members.len());
        (0..count).map(move |number| (first + number) % count)
    }

    /// Judges a message that a member has received, and forwards it. Returns whether the program
    /// gets it.
    fn admit(&mut self, number: usize, received: Received, buffer: &[u8]) -> bool {
        self.next = number + 1;
        let Some(member) = self.members.get_mut(number) else {
            return false;
        };
        member.traffic.received += 1;
        if member.is_own(received.from) {
            member.count(OWN);
            return false;
        }
        let message = buffer.get(..received.length).unwrap_or_default();
        let path = MessagePath {
            carrier: number,
            from: received.from,
        };
        let Judgement {
            dropped,
            not_forwarded,
            forward,
        } = self.rules.judge(message, path);
        for reason in [dropped, not_forwarded].into_iter().flatten() {
            member.count(reason);
        }
        self.not_forwarded = not_forwarded;
        self.is_forwarded = forward.is_some_and(|forward| self.forward(message, &forward));
        self.last = number;
        dropped.is_none()
    }

    /// Returns whether a carrier has taken the message.
    fn forward(&mut self, bytes: &[u8], forward: &ForwardTo) -> bool {
        let mut is_taken = false;
        let message = OutgoingMessage {
            bytes,
            replaceable: forward.replaceable,
            command: forward.command,
            within: forward.within,
        };
        for number in &forward.carriers {
            let Some(member) = self.members.get_mut(*number) else {
                continue;
            };
            match member.carrier.try_send(&message) {
                Ok(()) => {
                    member.traffic.forwarded += 1;
                    is_taken = true;
                }
                Err(error) => {
                    let reason = not_forwarded(error);
                    member.count(reason);
                    self.not_forwarded = Some(reason);
                }
            }
        }
        is_taken
    }

    /// Writes a received message into the buffer, if there is one.
    fn take(
        &mut self,
        buffer: &mut Vec<u8>,
        mut receive: impl FnMut(&mut dyn Carrier, &mut Vec<u8>) -> Option<io::Result<Received>>,
    ) -> Taken {
        for _ in 0..MOST_DROPPED {
            let mut is_idle = true;
            for number in self.numbers() {
                let Some(member) = self.members.get_mut(number) else {
                    continue;
                };
                let Some(received) = receive(member.carrier.as_mut(), buffer) else {
                    continue;
                };
                is_idle = false;
                match received {
                    Err(error) => {
                        self.next = number + 1;
                        return Taken::Message(Err(error));
                    }
                    Ok(received) if self.admit(number, received, buffer) => {
                        return Taken::Message(Ok(received));
                    }
                    // The buffer is free again: begin with the next member.
                    Ok(_) => break,
                }
            }
            if is_idle {
                return Taken::Nothing;
            }
        }
        Taken::More
    }
}

/// The result of an attempt to receive.
enum Taken {
    Message(io::Result<Received>),
    Nothing,
    /// Many messages in a row were dropped, and more may be there.
    More,
}

impl Carrier for Carriers {
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
        let mut errors = self.try_send_all(&[*message]);
        errors.remove(&0).map_or(Ok(()), Err)
    }

    /// Sends messages on each carrier. A message is not sent if no carrier takes it; the failures
    /// of single carriers are counted.
    fn try_send_all(&mut self, messages: &[OutgoingMessage<'_>]) -> BTreeMap<usize, SendError> {
        for message in messages {
            self.rules.sent(message.bytes);
        }
        let mut failed: BTreeMap<usize, (usize, SendError)> = BTreeMap::new();
        for member in &mut self.members {
            let errors = member.carrier.try_send_all(messages);
            let sent = messages.len().saturating_sub(errors.len());
            member.traffic.sent += u64::try_from(sent).unwrap_or(u64::MAX);
            for (index, error) in errors {
                member.count(not_sent(error));
                failed.entry(index).or_insert((0, error)).0 += 1;
            }
        }
        let all = self.members.len();
        let on_none = failed.into_iter().filter(|(_, (count, _))| *count == all);
        on_none.map(|(index, (_, error))| (index, error)).collect()
    }

    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>> {
        let taken = self.take(buffer, |carrier, buffer| {
            match carrier.poll_recv(cx, buffer) {
                Poll::Ready(received) => Some(received),
                Poll::Pending => None,
            }
        });
        match taken {
            Taken::Message(received) => Poll::Ready(received),
            Taken::Nothing => Poll::Pending,
            Taken::More => {
                cx.waker().wake_by_ref();
                Poll::Pending
            }
        }
    }

    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
        match self.take(buffer, |carrier, buffer| carrier.try_recv(buffer)) {
            Taken::Message(received) => Some(received),
            // The next poll takes the rest.
            Taken::Nothing | Taken::More => None,
        }
    }

    fn follow(&mut self) -> Option<CarrierChange> {
        let changes = self
            .members
            .iter_mut()
            .filter_map(|member| member.carrier.follow());
        self.changes.extend(changes);
        self.changes.pop_front()
    }

    fn lost(&self) -> Option<String> {
        let lost: Option<Vec<String>> = self
            .members
            .iter()
            .map(|member| member.carrier.lost())
            .collect();
        lost.map(|lost| lost.join("; "))
    }

    fn source(&self) -> Option<SocketAddr> {
        None
    }

    fn interface(&self) -> String {
        let members = self.members.iter();
        let names: Vec<String> = members.map(|member| member.carrier.interface()).collect();
        names.join(", ")
    }

    fn senders(&self) -> Senders {
        let members = self.members.iter().map(|member| member.carrier.senders());
        members.min().unwrap_or(Senders::Hidden)
    }

    fn within(&self) -> Option<Duration> {
        let members = self.members.iter();
        members.filter_map(|member| member.carrier.within()).min()
    }

    fn limit(&self) -> Option<usize> {
        let members = self.members.iter();
        members.filter_map(|member| member.carrier.limit()).min()
    }

    fn capacity(&self) -> Capacity {
        let members = self.members.iter();
        let slowest = members
            .map(|member| member.carrier.capacity())
            .reduce(Capacity::slower);
        slowest.unwrap_or(Capacity::Unknown)
    }

    fn arrival(&self) -> NetworkArrival {
        let (is_forwarded, not_forwarded) = (self.is_forwarded, self.not_forwarded);
        let member = self.members.get(self.last).map(|member| &member.carrier);
        NetworkArrival {
            senders: member.map_or_else(|| self.senders(), |carrier| carrier.senders()),
            within: member.and_then(|carrier| carrier.within()),
            is_forwarded,
            not_forwarded,
        }
    }

    fn states(&self) -> Vec<CarrierState> {
        let states = self.members.iter().flat_map(|member| {
            let own = member
                .dropped
                .iter()
                .map(|(reason, count)| (*reason, *count));
            let own: Vec<_> = own.collect();
            member.carrier.states().into_iter().map(move |mut state| {
                state.traffic = Some(member.traffic);
                state.dropped.extend(own.iter().copied());
                state
            })
        });
        states.collect()
    }

    fn overflowed(&mut self) -> u64 {
        let members = self.members.iter_mut();
        members.map(|member| member.carrier.overflowed()).sum()
    }

    fn close(&mut self) {
        for member in &mut self.members {
            member.carrier.close();
        }
    }

    fn poll_closed(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let mut closed = Poll::Ready(());
        for member in &mut self.members {
            if member.carrier.poll_closed(cx).is_pending() {
                closed = Poll::Pending;
            }
        }
        closed
    }
}

const fn not_sent(error: SendError) -> &'static str {
    match error {
        SendError::Busy => "not_sent_busy",
        SendError::TooBig => "not_sent_too_big",
        SendError::Unreachable => "not_sent_unreachable",
        SendError::Refused => "not_sent_refused",
    }
}

const fn not_forwarded(error: SendError) -> &'static str {
    match error {
        SendError::Busy => "not_forwarded_busy",
        SendError::TooBig => "not_forwarded_too_big",
        SendError::Unreachable => "not_forwarded_unreachable",
        SendError::Refused => "not_forwarded_refused",
    }
}

/// The reason for which own messages that a group returns are dropped.
const OWN: &str = "own";
/// The number of dropped messages after which the caller can do other work.
const MOST_DROPPED: usize = 64;

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv4Addr};
    use std::sync::{Arc, Mutex};

    use super::*;

    /// A network in memory with its end in a test.
    #[derive(Debug, Default)]
    struct Wire {
        incoming: VecDeque<(Vec<u8>, SocketAddr)>,
        /// Whether receiving fails.
        fails: bool,
        outgoing: Vec<Vec<u8>>,
        is_lost: bool,
        change: Option<CarrierChange>,
    }

    #[derive(Debug, Clone, Default)]
    struct MemoryEnd(Arc<Mutex<Wire>>);

    impl Carrier for MemoryEnd {
        fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError> {
            let mut wire = self.0.lock().unwrap();
            if wire.is_lost {
                return Err(SendError::Unreachable);
            }
            wire.outgoing.push(message.bytes.to_vec());
            Ok(())
        }

        fn poll_recv(
            &mut self,
            _: &mut Context<'_>,
            buffer: &mut Vec<u8>,
        ) -> Poll<io::Result<Received>> {
            self.try_recv(buffer).map_or(Poll::Pending, Poll::Ready)
        }

        fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>> {
            let mut wire = self.0.lock().unwrap();
            if wire.fails {
                return Some(Err(io::Error::other("cut")));
            }
            let (bytes, from) = wire.incoming.pop_front()?;
            buffer[..bytes.len()].copy_from_slice(&bytes);
            let length = bytes.len();
            Some(Ok(Received {
                length,
                from,
                stamp: None,
            }))
        }

        fn follow(&mut self) -> Option<CarrierChange> {
            self.0.lock().unwrap().change.take()
        }

        fn lost(&self) -> Option<String> {
            let is_lost = self.0.lock().unwrap().is_lost;
            is_lost.then(|| "cut".to_owned())
        }

        fn source(&self) -> Option<SocketAddr> {
            Some(from(1))
        }

        fn interface(&self) -> String {
            "memory".to_owned()
        }

        fn senders(&self) -> Senders {
            Senders::Addresses
        }
    }

    fn from(port: u16) -> SocketAddr {
        SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), port)
    }

    /// Forwards messages of the first carrier that begin with 1, and drops those with 9.
    #[derive(Debug)]
    struct Ones;

    impl CarrierRules for Ones {
        fn sent(&mut self, _: &[u8]) {}

        fn judge(&mut self, message: &[u8], path: MessagePath) -> Judgement {
            let is_routed = message.first() == Some(&1) && path.carrier == 0;
            Judgement {
                dropped: (message.first() == Some(&9)).then_some("doubled"),
                not_forwarded: None,
                forward: is_routed.then(|| ForwardTo {
                    carriers: vec![1],
                    replaceable: false,
                    command: false,
                    within: None,
                }),
            }
        }
    }

    fn pair() -> (Carriers, MemoryEnd, MemoryEnd) {
        let (a, b) = (MemoryEnd::default(), MemoryEnd::default());
        let both: Vec<Box<dyn Carrier>> = vec![Box::new(a.clone()), Box::new(b.clone())];
        (Carriers::new(both, Box::new(Ones)), a, b)
    }

    fn arrives(end: &MemoryEnd, bytes: &[u8], port: u16) {
        let mut wire = end.0.lock().unwrap();
        wire.incoming.push_back((bytes.to_vec(), from(port)));
    }

    #[test]
    fn own_messages_are_sent_on_all_carriers_and_a_lost_carrier_stops_no_other() {
        let (mut carriers, a, b) = pair();
        b.0.lock().unwrap().is_lost = true;
        assert_eq!(carriers.try_send(&OutgoingMessage::new(&[5])), Ok(()));
        assert_eq!(a.0.lock().unwrap().outgoing, [[5]]);
        assert_eq!(carriers.lost(), None);
        let states = carriers.states();
        assert_eq!(states[1].dropped, [("not_sent_unreachable", 1)]);
        assert_eq!(states[1].lost.as_deref(), Some("cut"));

        a.0.lock().unwrap().is_lost = true;
        assert_eq!(
            carriers.try_send(&OutgoingMessage::new(&[6])),
            Err(SendError::Unreachable)
        );
        assert!(carriers.lost().is_some());
    }

    #[test]
    fn a_message_of_a_route_is_delivered_and_forwarded() {
        let (mut carriers, a, b) = pair();
        let mut buffer = vec![0; 16];
        arrives(&a, &[1, 7], 2);
        arrives(&b, &[1, 8], 2);
        for (number, length) in [(0, 2), (1, 2)] {
            let received = carriers.try_recv(&mut buffer).unwrap().unwrap();
            assert_eq!((carriers.last, received.length), (number, length));
        }
        assert!(carriers.try_recv(&mut buffer).is_none());
        assert_eq!(b.0.lock().unwrap().outgoing, [[1, 7]]);
        assert!(a.0.lock().unwrap().outgoing.is_empty());
        let traffic = carriers.states()[1].traffic.unwrap();
        assert_eq!((traffic.received, traffic.forwarded), (1, 1));
    }

    #[test]
    fn dropped_and_own_messages_are_counted_and_the_next_is_received() {
        let (mut carriers, a, _b) = pair();
        let mut buffer = vec![0; 16];
        arrives(&a, &[9], 2);
        arrives(&a, &[1, 3], 1);
        arrives(&a, &[4], 2);
        carriers.try_recv(&mut buffer).unwrap().unwrap();
        assert_eq!(buffer[0], 4);
        assert_eq!(carriers.states()[0].dropped, [("doubled", 1), ("own", 1)]);
    }

    #[test]
    fn a_busy_carrier_leaves_room_for_the_other() {
        let (mut carriers, a, b) = pair();
        let mut buffer = vec![0; 16];
        for _ in 0..4 {
            arrives(&a, &[2], 2);
        }
        arrives(&b, &[3], 2);
        let mut order = Vec::new();
        while let Some(Ok(_)) = carriers.try_recv(&mut buffer) {
            order.push(buffer[0]);
        }
        assert_eq!(order, [2, 3, 2, 2, 2]);
    }

    #[test]
    fn a_carrier_that_fails_again_and_again_leaves_room_for_the_other() {
        let (mut carriers, a, b) = pair();
        let mut buffer = vec![0; 16];
        a.0.lock().unwrap().fails = true;
        arrives(&b, &[3], 2);
        assert!(carriers.try_recv(&mut buffer).unwrap().is_err());
        assert!(carriers.try_recv(&mut buffer).unwrap().is_ok());
        assert_eq!(buffer[0], 3);
    }

    #[test]
    fn a_change_of_each_carrier_is_reported() {
        let (mut carriers, a, b) = pair();
        for end in [&a, &b] {
            end.0.lock().unwrap().change = Some(CarrierChange::Lost("cut".to_owned()));
        }
        assert!(carriers.follow().is_some());
        assert!(carriers.follow().is_some());
        assert_eq!(carriers.follow(), None);
    }
}
