//! Requests and responses that are larger than a datagram: split into chunks, and sent at the pace
//! of all chunks.

use std::collections::{BTreeMap, VecDeque};

use mappings::TopicId;
use uadp::action::{ActionKind, ActionToSend};
use uadp::{
    ChunkBudget, ChunkEncoder, ChunkError, Extras, GroupHeader, NetworkHeader, NetworkMessageType,
    PublisherId, Whole,
};

/// The messages to send in chunks. Each request or response is queued at most once, so the queue is
/// limited by the state of the Requestor and the Responder.
#[derive(Debug, Default)]
pub(super) struct Chunking {
    /// Messages in the order in which they were due. They are sent one after another, because a
    /// receiver stores few incomplete messages per sender.
    waiting: VecDeque<Large>,
    /// The last assigned MessageSequenceNumber.
    next: u16,
    /// The first transmissions for repetitions, and their messages in the order of assignment.
    first: BTreeMap<Of, FirstTransmission>,
    given: VecDeque<Of>,
    /// Whether the queue has given way to a chunk of a value after its last chunk.
    pub(super) gave_way: bool,
}

/// Identifies a message by the number of its call.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Of {
    Request(u64),
    Response(u64),
}

/// The first transmission of a message.
#[derive(Clone, Copy, Debug)]
struct FirstTransmission {
    /// Its MessageSequenceNumber.
    number: u16,
    /// Its times, if its repetitions have them too.
    times: Option<FirstTimes>,
}

/// The times of the first transmission of a message. Its repetitions have them too, so that the
/// chunks of all transmissions are equal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FirstTimes {
    /// The headers with the time of sending.
    pub(super) header: NetworkHeader<'static>,
    /// The time in ms for which the requestor still waited, which is the TimeoutHint.
    pub(super) left: Option<f64>,
}

/// A message that is sent in chunks.
#[derive(Debug)]
struct Large {
    topic: TopicId,
    of: Of,
    first: FirstTransmission,
    bytes: Vec<u8>,
    offset: usize,
}

impl Of {
    pub(super) const fn message(action: &ActionToSend<'_>) -> Self {
        match action.action.kind {
            ActionKind::Request => Self::Request(action.call),
            ActionKind::Response => Self::Response(action.call),
        }
    }
}

impl Chunking {
    pub(super) fn is_empty(&self) -> bool {
        self.waiting.is_empty()
    }

    /// Queues a message, unless a message of the same call is still queued. A repetition has the
    /// MessageSequenceNumber of the first transmission, so that its chunks replace lost chunks
    /// (OPC 10000-14, 7.2.4.4.4).
    pub(super) fn push(&mut self, topic: TopicId, of: Of, bytes: Vec<u8>) {
        if self.waiting.iter().any(|large| large.of == of) {
            return;
        }
        let first = match self.first.get(&of) {
            Some(first) => *first,
            None => self.give(of, None),
        };
        self.waiting.push_back(Large {
            topic,
            of,
            first,
            bytes,
            offset: 0,
        });
    }

    /// Returns the times of the first transmission of a message, which are these ones if there was
    /// none.
    pub(super) fn first_times(&mut self, of: Of, times: FirstTimes) -> FirstTimes {
        match self.first.get_mut(&of) {
            Some(first) => *first.times.get_or_insert(times),
            None => {
                self.give(of, Some(times));
                times
            }
        }
    }

    fn give(&mut self, of: Of, times: Option<FirstTimes>) -> FirstTransmission {
        if self.given.len() >= MOST_NUMBERS
            && let Some(oldest) = self.given.pop_front()
        {
            self.first.remove(&oldest);
        }
        self.next = self.next.wrapping_add(1);
        let first = FirstTransmission {
            number: self.next,
            times,
        };
        self.first.insert(of, first);
        self.given.push_back(of);
        first
    }

    /// Appends the next chunk. `start` are its headers if it does not have those of the first
    /// transmission.
    pub(super) fn write(
        &mut self,
        most: usize,
        start: &NetworkHeader<'static>,
        out: &mut Vec<u8>,
    ) -> Option<(TopicId, Result<(), ChunkError>)> {
        let large = self.waiting.front_mut()?;
        let topic = large.topic;
        let written = large.write(most, start, out);
        if written.is_err() || large.offset >= large.bytes.len() {
            self.waiting.pop_front();
        }
        Some((topic, written))
    }
}

impl Large {
    /// Appends the next chunk. The whole NetworkMessage is split, because it contains the
    /// ActionHeader (OPC 10000-14, 7.2.4.4.4).
    fn write(
        &mut self,
        most: usize,
        start: &NetworkHeader<'static>,
        out: &mut Vec<u8>,
    ) -> Result<(), ChunkError> {
        let start = self.first.times.map_or(*start, |times| times.header);
        let (space, namespace, _) = self.topic.triple();
        let header = NetworkHeader {
            publisher_id: Some(PublisherId::UInt16(space)),
            group: Some(GroupHeader {
                writer_group_id: Some(namespace),
                ..GroupHeader::default()
            }),
            ..start
        };
        let whole = Whole {
            message_type: NetworkMessageType::DataSet,
            writer_id: None,
            message_sequence_number: self.first.number,
            bytes: &self.bytes,
        };
        let budget = ChunkBudget {
            network_message: most,
            trailer: 0,
        };
        let extras = Extras::default();
        let mut chunks =
            ChunkEncoder::new(&header, &extras, whole, budget)?.resumed_at(self.offset);
        chunks.append(out, &extras).transpose()?;
        self.offset = chunks.offset();
        Ok(())
    }
}

/// The maximum number of stored first transmissions. It exceeds the number of calls that wait
/// for a response at the same time.
const MOST_NUMBERS: usize = 2_048;
