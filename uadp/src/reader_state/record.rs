//! Received sequence numbers of a writer.

use crate::sequence::{Place, REACH, SequenceWindow};
use crate::{Accepted, Arrival, MessageKind, ReaderDrop};

/// Sequence numbers received so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct Record {
    pub(super) of: Numbers,
    window: SequenceWindow,
    /// Position of the last message in its NetworkMessage.
    position: usize,
}

/// Kind of the sequence numbers that identify messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Numbers {
    DataSetMessages,
    NetworkMessages,
}

impl Numbers {
    /// Returns the number that identifies the message, if there is one.
    pub(super) fn of(arrival: &Arrival) -> Option<(Self, u16)> {
        let own = arrival.header.sequence_number;
        let group = arrival.group.sequence_number;
        own.map(|number| (Self::DataSetMessages, number))
            .or_else(|| group.map(|number| (Self::NetworkMessages, number)))
    }
}

impl Record {
    pub(super) fn first(of: Numbers, number: u16, arrival: &Arrival) -> Self {
        Self {
            of,
            window: match is_next_expected(of, arrival) {
                true => SequenceWindow::before(number),
                false => SequenceWindow::at(number),
            },
            position: arrival.position,
        }
    }

    /// Returns the record with the message, and the relation of the message to earlier messages.
    pub(super) fn place(
        mut self,
        number: u16,
        arrival: &Arrival,
        accept_late: bool,
    ) -> Result<(Self, Accepted), ReaderDrop> {
        if is_next_expected(self.of, arrival) {
            return self.expect(number);
        }
        let mut accepted = Accepted::default();
        match self.window.place(number) {
            Place::Newer { missed } => {
                // A missing NetworkMessage may not have contained a message of this writer.
                if self.of == Numbers::DataSetMessages {
                    accepted.missed = missed;
                }
            }
            // Another message of the same NetworkMessage.
            Place::Seen if self.is_same_network_message(number, arrival) => {}
            Place::Seen => return Err(ReaderDrop::Duplicate),
            Place::Behind { by } if accept_late && by < REACH => {
                accepted.late = true;
                self.window.receive(number);
                return Ok((self, accepted));
            }
            Place::Behind { by } => return Err(ReaderDrop::Stale { behind: by }),
            Place::Invalid => return Err(ReaderDrop::OutOfWindow),
        }
        self.window.receive(number);
        self.position = arrival.position;
        Ok((self, accepted))
    }

    fn is_same_network_message(&self, number: u16, arrival: &Arrival) -> bool {
        self.of == Numbers::NetworkMessages
            && self.window.is_last(number)
            && arrival.position > self.position
    }

    /// Records a keep-alive: `next` is the number of the next message.
    fn expect(mut self, next: u16) -> Result<(Self, Accepted), ReaderDrop> {
        let mut accepted = Accepted::default();
        let last = next.wrapping_sub(1);
        match self.window.place(last) {
            Place::Newer { missed } => {
                accepted.missed = missed.saturating_add(1);
                self.window.expect(next);
                Ok((self, accepted))
            }
            _ if self.window.is_last(last) => Ok((self, accepted)),
            Place::Seen | Place::Behind { .. } => Err(ReaderDrop::Stale {
                behind: self.window.distance(last),
            }),
            Place::Invalid => Err(ReaderDrop::OutOfWindow),
        }
    }
}

/// Returns true for keep-alives, which carry the DataSetMessageSequenceNumber of the next message
/// (OPC 10000-14, 7.2.4.5.8).
fn is_next_expected(of: Numbers, arrival: &Arrival) -> bool {
    of == Numbers::DataSetMessages && arrival.kind == MessageKind::KeepAlive
}
