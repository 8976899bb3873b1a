//! The datagrams that a drain of the Router sends together.

use std::collections::BTreeMap;
use std::time::Duration;

use bridge_core::{Reason, Redundancy};
use mappings::TopicId;
use transport::{OutgoingMessage, SendError};

use super::{Shell, not_sent};
use crate::port::Port;

/// The datagrams of the Router that wait for the next output that is no datagram, or for the end of
/// the drain.
#[derive(Debug, Default)]
pub(crate) struct DatagramOutbox(Vec<Parcel>);

/// A datagram of the Router, with the topics of its messages.
#[derive(Debug)]
pub(super) struct Parcel {
    pub(super) topic: TopicId,
    pub(super) with: Vec<TopicId>,
    pub(super) bytes: Vec<u8>,
    pub(super) replaceable: bool,
    pub(super) command: bool,
    pub(super) within: Option<Duration>,
}

impl Parcel {
    fn message(&self) -> OutgoingMessage<'_> {
        OutgoingMessage {
            bytes: &self.bytes,
            replaceable: self.replaceable,
            command: self.command,
            within: self.within,
        }
    }
}

impl<P: Port> Shell<P> {
    /// Sends a datagram together with the next ones. A large datagram is sent at once: it may be a
    /// part of a message whose other parts are not sent after a failure.
    pub(super) fn post(&mut self, parcel: Parcel) {
        let is_large = parcel.bytes.len() > LARGE;
        if is_large {
            self.flush();
        }
        self.outbox.0.push(parcel);
        if is_large || self.outbox.0.len() >= SENT_AT_ONCE {
            self.flush();
        }
    }

    /// Sends the posted datagrams.
    pub(super) fn flush(&mut self) {
        let mut parcels = std::mem::take(&mut self.outbox.0);
        // The lease may have ended since the datagrams were posted: another bridge is active.
        if self.is_muted() {
            for parcel in parcels.drain(..) {
                self.parcel_left(parcel, Err((Reason::Takeover, MUTED)));
            }
            self.outbox.0 = parcels;
            return;
        }
        let errors = self.send_all(&parcels);
        for (index, parcel) in parcels.drain(..).enumerate() {
            match errors.get(&index) {
                Some(error) => {
                    let detail = error.to_string();
                    self.parcel_left(parcel, Err((not_sent(*error), &detail)));
                }
                None => self.parcel_left(parcel, Ok(())),
            }
        }
        self.outbox.0 = parcels;
    }

    /// Returns whether nothing is sent to the group, because another program is active.
    pub(super) fn is_muted(&self) -> bool {
        let redundancy = self.router.redundancy();
        redundancy.is_some_and(Redundancy::mutes_group)
    }

    fn parcel_left(&mut self, parcel: Parcel, sent: Result<(), (Reason, &str)>) {
        for topic in std::iter::once(parcel.topic).chain(parcel.with) {
            if let Err((reason, detail)) = sent {
                self.router.not_sent(topic, reason, detail);
            }
            let sent = sent.map_err(|(reason, _)| reason);
            self.port.left(topic, sent, &self.router);
        }
        self.router.recycle(parcel.bytes);
    }

    fn send_all(&mut self, parcels: &[Parcel]) -> BTreeMap<usize, SendError> {
        match parcels {
            [] => BTreeMap::new(),
            [one] => {
                let sent = self.send(&one.message());
                sent.err().map(|error| (0, error)).into_iter().collect()
            }
            _ if self.dry_run => BTreeMap::new(),
            many => {
                let messages: Vec<OutgoingMessage<'_>> = many.iter().map(Parcel::message).collect();
                self.carrier.try_send_all(&messages)
            }
        }
    }
}

/// The reason for which a posted datagram is dropped, as text for the user.
const MUTED: &str = "this bridge is not active any more";
/// The maximum number of datagrams that are sent together.
const SENT_AT_ONCE: usize = 32;
/// The size in bytes above which a datagram is sent alone. A datagram of this size fits the MTU of
/// Ethernet.
const LARGE: usize = 1400;
