//! The interface of a PubSub network, such as UDP multicast or an MQTT broker.

use std::collections::BTreeMap;
use std::fmt;
use std::future::poll_fn;
use std::io;
use std::net::SocketAddr;
use std::task::{Context, Poll};
use std::time::{Duration, SystemTime};

use crate::key_rule::KeyRule;

/// Sends and receives the NetworkMessages of a PubSub connection.
///
/// A carrier may lose, double and reorder messages. It never blocks a sender: a message that it
/// cannot take is refused with a [`SendError`]. The interpretation of messages, including loops
/// and repetitions, is left to the caller.
pub trait Carrier: fmt::Debug + Send {
    /// Sends a message without waiting.
    ///
    /// # Errors
    /// A [`SendError`]; later messages may be sent nevertheless.
    fn try_send(&mut self, message: &OutgoingMessage<'_>) -> Result<(), SendError>;

    /// Sends messages in their order without waiting, with as few system calls as possible. Returns
    /// the errors of the messages that were not sent, by their index.
    fn try_send_all(&mut self, messages: &[OutgoingMessage<'_>]) -> BTreeMap<usize, SendError> {
        let sent = messages.iter().map(|message| self.try_send(message));
        let errors = sent
            .enumerate()
            .filter_map(|(index, sent)| Some((index, sent.err()?)));
        errors.collect()
    }

    /// Polls for a message. It is written to the start of `buffer`, which grows if needed and must
    /// hold at least [`BUFFER`] bytes. No message is lost if the result is not awaited.
    ///
    /// # Errors
    /// The error of the system; the carrier stays usable.
    fn poll_recv(
        &mut self,
        cx: &mut Context<'_>,
        buffer: &mut Vec<u8>,
    ) -> Poll<io::Result<Received>>;

    /// Returns a message that was already received; `None` if there is none.
    fn try_recv(&mut self, buffer: &mut Vec<u8>) -> Option<io::Result<Received>>;

    /// Follows changes of the network, such as a removed interface or a lost broker. Call it every
    /// [`LOOK`](crate::LOOK).
    fn follow(&mut self) -> Option<CarrierChange>;

    /// Returns the reason why no messages are received and sent.
    fn lost(&self) -> Option<String>;

    /// Returns the source address of own messages, if they are received again. `None` if the
    /// carrier drops them itself.
    fn source(&self) -> Option<SocketAddr>;

    /// Returns the name of the network interface or broker.
    fn interface(&self) -> String;

    /// Returns how far the carrier can tell senders apart.
    fn senders(&self) -> Senders;

    /// Returns the time after which a received message counts as late; `None` if the carrier does
    /// not store messages.
    fn within(&self) -> Option<Duration> {
        None
    }

    /// Returns the largest message in bytes that the network takes, if it is known.
    fn limit(&self) -> Option<usize> {
        None
    }

    /// Returns the properties of the network by which the last message was received.
    fn arrival(&self) -> NetworkArrival {
        NetworkArrival {
            senders: self.senders(),
            within: self.within(),
            is_forwarded: false,
            not_forwarded: None,
        }
    }

    /// Returns the state of the carrier; of each carrier, if there are several.
    fn states(&self) -> Vec<CarrierState> {
        vec![CarrierState {
            network: self.interface(),
            senders: self.senders(),
            lost: self.lost(),
            traffic: None,
            dropped: self.dropped(),
        }]
    }

    /// Returns the capacity of the network, which determines how fast the parts of large messages
    /// are sent.
    fn capacity(&self) -> Capacity {
        Capacity::Unknown
    }

    /// Returns the number of messages that the carrier dropped, by reason.
    fn dropped(&self) -> Vec<(&'static str, u64)> {
        Vec::new()
    }

    /// Lets the network drop messages by rules before they reach the program. It only saves work:
    /// a carrier that cannot do so delivers them. Replaces earlier rules.
    fn drop_by(&mut self, rules: Vec<KeyRule>) {
        drop(rules);
    }

    /// Returns the number of messages since the last call that the program did not receive in time,
    /// as far as the carrier stores them itself.
    fn overflowed(&mut self) -> u64 {
        0
    }

    /// Starts to close the carrier: withdraws everything that the network stores.
    fn close(&mut self) {}

    /// Polls whether the carrier is closed.
    fn poll_closed(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let _at_once = cx;
        Poll::Ready(())
    }
}

/// Size in bytes of a buffer for [`Carrier::poll_recv`]: any UDP datagram fits.
pub const BUFFER: usize = 65_536;

impl dyn Carrier + '_ {
    /// Waits for a message, as [`poll_recv`](Carrier::poll_recv). Cancel-safe.
    ///
    /// # Errors
    /// The error of the system; the carrier stays usable.
    pub async fn recv(&mut self, buffer: &mut Vec<u8>) -> io::Result<Received> {
        poll_fn(|cx| self.poll_recv(cx, buffer)).await
    }

    /// Waits until the carrier is closed, as [`poll_closed`](Carrier::poll_closed).
    pub async fn closed(&mut self) {
        poll_fn(|cx| self.poll_closed(cx)).await;
    }
}

/// A message to send.
#[derive(Debug, Clone, Copy)]
pub struct OutgoingMessage<'a> {
    /// The NetworkMessage.
    pub bytes: &'a [u8],
    /// Whether a newer message of the same topic replaces the message while it waits.
    pub replaceable: bool,
    /// Whether the message is a command, which keeps its exact time and form.
    pub command: bool,
    /// The time after which the message must not be delivered any more.
    pub within: Option<Duration>,
}

impl<'a> OutgoingMessage<'a> {
    /// Returns a message that is neither replaced nor expires.
    #[must_use]
    pub const fn new(bytes: &'a [u8]) -> Self {
        Self {
            bytes,
            replaceable: false,
            command: false,
            within: None,
        }
    }
}

/// A received message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Received {
    /// Size of the message in bytes.
    pub length: usize,
    /// Address of the sender, or of the broker.
    pub from: SocketAddr,
    /// Time at which the kernel received the message; `None` if it is not known.
    pub stamp: Option<SystemTime>,
}

/// The distinction of senders, from the weakest to the strongest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Senders {
    /// A broker hides the senders, and accepts messages from every client.
    Hidden,
    /// A broker hides the senders, and its access rules decide which client may publish on which
    /// topic.
    Authorized,
    /// Each sender has an address.
    Addresses,
}

/// The properties of the network by which a message was received.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NetworkArrival {
    /// The extent to which the network distinguishes senders.
    pub senders: Senders,
    /// The time after which the message counts as late; `None` if the network does not store
    /// messages.
    pub within: Option<Duration>,
    /// Whether the message was forwarded to another carrier.
    pub is_forwarded: bool,
    /// The reason why a message of a route was not forwarded.
    pub not_forwarded: Option<&'static str>,
}

/// The state of a carrier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CarrierState {
    /// Name of the network interface or broker.
    pub network: String,
    /// The extent to which the carrier distinguishes senders.
    pub senders: Senders,
    /// The reason why no messages are received and sent.
    pub lost: Option<String>,
    /// Numbers of messages; `None` for the only carrier of a program, whose topics have them.
    pub traffic: Option<Traffic>,
    /// Numbers of messages that were dropped, by reason.
    pub dropped: Vec<(&'static str, u64)>,
}

/// Numbers of messages of one of several carriers.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Messages that were received, own messages included.
    pub received: u64,
    /// Own messages that were sent.
    pub sent: u64,
    /// Messages of other carriers that were sent.
    pub forwarded: u64,
}

/// The capacity of a network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Capacity {
    /// The network interface has this speed in bytes per second.
    Wire(u64),
    /// All receivers are on this host. The receive buffer of this program holds this number of
    /// bytes, and the buffers of the other programs probably hold as many.
    Host(u64),
    /// The speed is unknown.
    Unknown,
}

impl Capacity {
    /// Returns the capacity that both networks have.
    pub(crate) fn slower(self, other: Self) -> Self {
        match (self, other) {
            (Self::Host(one), Self::Host(other)) => Self::Host(one.min(other)),
            (Self::Wire(one), Self::Wire(other)) => Self::Wire(one.min(other)),
            (Self::Host(_), slower) | (slower, Self::Host(_)) => slower,
            (Self::Unknown, _) | (_, Self::Unknown) => Self::Unknown,
        }
    }
}

/// Reason why a datagram was not sent. The socket stays usable: the next datagram may be sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum SendError {
    /// The kernel's send buffer is full.
    #[error("the send buffer is full")]
    Busy,
    /// The message exceeds the maximum size of a UDP datagram or Ethernet frame.
    #[error("larger than a UDP datagram or Ethernet frame")]
    TooBig,
    /// There is no route, the interface is down, or a unicast peer refused the datagram.
    #[error("the network is unreachable")]
    Unreachable,
    /// Another error of the system.
    #[error("the operating system refused the datagram")]
    Refused,
}

/// A change of the network of a carrier.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CarrierChange {
    /// Nothing is received and sent, for this reason.
    Lost(String),
    /// Messages are received and sent again, on this interface or broker.
    Back(String),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_networks_the_slower_one_counts() {
        let [host, wire, unknown] = [
            Capacity::Host(4 << 20),
            Capacity::Wire(125_000_000),
            Capacity::Unknown,
        ];
        for (one, other, slower) in [
            (host, Capacity::Host(1 << 20), Capacity::Host(1 << 20)),
            (host, wire, wire),
            (wire, Capacity::Wire(12_500_000), Capacity::Wire(12_500_000)),
            (wire, unknown, unknown),
            (host, unknown, unknown),
        ] {
            assert_eq!(one.slower(other), slower);
            assert_eq!(other.slower(one), slower);
        }
    }
}
