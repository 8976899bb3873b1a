//! A requestor of calls in a space, built on the codec alone.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use socket2::SockRef;
use uadp::action::{
    ActionAddress, ActionDialect, ActionFields, ActionOutcome, ActionRequest, CallId, Requestor,
    RequestorSettings, ResponseMeaning,
};
use uadp::{Extras, NetworkHeader, NetworkMessage, OwnedPublisherId};

use crate::{GROUP, TopicTriple, UadpSocket};

/// A requestor with the PublisherId of a space.
pub struct CodecAsker {
    socket: UadpSocket,
    requestor: Requestor,
    start: Instant,
}

/// The end of a call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CallEnd {
    /// Executed; the bytes of the response fields.
    Answered(Vec<u8>),
    /// Refused without execution.
    Refused,
    /// Unknown whether the call was executed.
    Unknown,
}

impl CodecAsker {
    /// Creates a requestor for `space`. Requestors with the same `instance` send the same
    /// CorrelationData.
    #[must_use]
    pub fn new(space: u16, instance: u8) -> Self {
        let id = OwnedPublisherId::UInt16(space);
        Self {
            socket: UadpSocket::join(),
            requestor: Requestor::new(id, [instance; 16], RequestorSettings::default()),
            start: Instant::now(),
        }
    }

    /// Starts a call with fields as Variants, preceded by their count.
    ///
    /// # Panics
    /// Panics if the requestor refuses the call.
    pub fn call(
        &mut self,
        (space, namespace, id): TopicTriple,
        fields: &[u8],
        timeout: Duration,
    ) -> CallId {
        let request = ActionRequest {
            address: ActionAddress {
                publisher_id: OwnedPublisherId::UInt16(space),
                writer_group_id: Some(namespace),
                writer_id: id,
                target_id: 1,
            },
            dialect: ActionDialect::Standard,
            fields: ActionFields::Variants(fields),
            timeout,
        };
        self.requestor.call(request, self.start.elapsed()).unwrap()
    }

    /// Sends and receives for a turn of at most 5 ms, and returns the calls that have ended.
    ///
    /// # Panics
    /// Panics if the group cannot be read or written.
    pub fn turn(&mut self) -> Vec<(CallId, CallEnd)> {
        let now = self.start.elapsed();
        self.requestor.handle_timeout(now);
        while let Some(request) = self.requestor.poll_transmit(now) {
            let mut datagram = Vec::new();
            let (header, extras) = (NetworkHeader::default(), Extras::default());
            let encoder = request.encode(&mut datagram, &header, &extras).unwrap();
            encoder.finish().unwrap();
            self.socket.send(&datagram);
        }
        let mut ended = Vec::new();
        if let Some(datagram) = self.socket.receive(TURN) {
            self.hear(&datagram, &mut ended);
        }
        while let Some((call, _)) = self.requestor.poll_given_up() {
            ended.push((call, CallEnd::Unknown));
        }
        ended
    }

    /// Returns the number of dropped responses: unknown or late.
    #[must_use]
    pub const fn dropped(&self) -> u64 {
        self.requestor.counters().dropped
    }

    fn hear(&mut self, datagram: &[u8], ended: &mut Vec<(CallId, CallEnd)>) {
        let Ok(message) = NetworkMessage::decode(datagram) else {
            return;
        };
        let Ok(messages) = message.actions(ActionDialect::Standard) else {
            return;
        };
        for message in messages.flatten() {
            let now = self.start.elapsed();
            if let Ok(ResponseMeaning::Done(call, outcome)) =
                self.requestor.handle_response(&message, now)
            {
                ended.push((
                    call,
                    match outcome {
                        ActionOutcome::Answered { fields, .. } => {
                            CallEnd::Answered(fields.bytes().to_vec())
                        }
                        ActionOutcome::Refused(_) => CallEnd::Refused,
                        ActionOutcome::Unknown(_) => CallEnd::Unknown,
                    },
                ));
            }
        }
    }
}

/// Sends a datagram to the group from a loopback address that differs from the address of all other
/// senders.
///
/// # Panics
/// Panics if the datagram cannot be sent.
pub fn send_from(address: Ipv4Addr, datagram: &[u8]) {
    let socket = UdpSocket::bind(SocketAddr::from((address, 0))).unwrap();
    let options = SockRef::from(&socket);
    options.set_multicast_if_v4(&Ipv4Addr::LOCALHOST).unwrap();
    options.set_multicast_loop_v4(true).unwrap();
    socket.send_to(datagram, GROUP).unwrap();
}

/// Time of listening between two checks for due work.
const TURN: Duration = Duration::from_millis(5);
